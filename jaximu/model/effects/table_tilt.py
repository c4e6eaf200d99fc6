"""Table tilt: the table is not level."""

from dataclasses import replace

import jax.numpy as jnp

from jaximu.ground.rotation import conjugate, exponential, multiply, rotate
from jaximu.model.effects.base import SetupEffect


class SetupTableTilt(SetupEffect):
    """The table is turned by (α_x, α_y) against the level frame, so its poses' "up" is not gravity's.

    Right at rest and on the table's axis: what else the force holds is tilted against the table as gravity is.
    Coefficients: a rotation vector about the level frame's x and y axes (rad); about z there is nothing to feel.
    """

    name = "setup.table_tilt"
    formula = "f = R'ᵀ R f_said, R' = exp(α) R"
    unit = "rad"
    size = 2
    needs = ("specific_force", "attitude")
    excited_by = "the same pose at several table angles (0° and 180°)"
    look_alikes = ("setup.table_axis",)
    source = "definition; IEEE Std 1293-2018, mounting alignment in the 1 g tumble test"
    typical = 1e-3
    known = 0.05

    def act(self, stimulus, quantity):
        force, attitude = self.needed(stimulus)
        tilted = multiply(exponential(jnp.append(self.coefficients, 0.0)), attitude)
        return replace(stimulus, specific_force=rotate(conjugate(tilted), rotate(attitude, force)), attitude=tilted)


EFFECTS = (SetupTableTilt,)
