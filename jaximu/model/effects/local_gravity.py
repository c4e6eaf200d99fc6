"""Local gravity: it is not what was said."""

from dataclasses import replace

import jax.numpy as jnp

from jaximu.ground.rotation import conjugate, rotate
from jaximu.model.effects.base import SetupEffect


class SetupGravity(SetupEffect):
    """Local gravity is greater by c than was said; at rest the specific force is, too.

    At rest structurally blind: it is the accelerometer's scale. It adds to that scale's uncertainty and cannot be
    fitted beside it, unless known accelerations other than gravity are there to tell them apart.
    """

    name = "setup.gravity"
    common_name = "local gravity"
    formula = "f = f_said + c Rᵀ e_z"
    unit = "m/s^2"
    size = 1
    needs = ("specific_force",)
    excited_by = "nothing at rest: blind inside the accelerometer's scale"
    source = "definition; spread of gravity over the Earth (WGS 84)"
    typical = 0.015

    def act(self, stimulus, quantity):
        force = stimulus.need("specific_force", self.name)
        if stimulus.attitude is None:  # at rest the specific force points up
            squared = jnp.sum(force**2, axis=-1, keepdims=True)
            up = force / jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
        else:
            up = rotate(conjugate(stimulus.attitude), jnp.array([0.0, 0.0, 1.0]))
        return replace(stimulus, specific_force=force + self.coefficients[0] * up)


EFFECTS = (SetupGravity,)
