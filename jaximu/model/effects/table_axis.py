"""Table axis: the table does not turn about the axis that the fixture says."""

import jax.numpy as jnp

from jaximu.model.effects.base import SetupEffect


class SetupTableAxis(SetupEffect):
    """The table's axes are turned by ε against the fixture's frame, to first order: ω = ω_said + ε × ω_said.

    Structurally blind: ε is a rotation of the gyroscope's frame against the accelerometer's, which its gain contains.
    Only what else is known of the mounting, or its change over several mountings, can tell them apart.
    """

    name = "setup.table_axis"
    formula = "ω = ω_said + ε × ω_said"
    unit = "rad"
    needs = ("angular_rate",)
    excited_by = "nothing: blind inside the gyroscope's misalignment"
    look_alikes = ("setup.table_tilt",)
    source = "definition; small rotation between the turn axes and the fixture"
    typical = 1e-3

    def act(self, stimulus, quantity):
        stimulus.need("angular_rate", self.name)

        def turned(vectors):
            return vectors + jnp.cross(self.coefficients, vectors)

        return stimulus.changed(turned, "angular_rate", "angular_acceleration")


EFFECTS = (SetupTableAxis,)
