"""Reference rotation: the unit is mounted turned against the body whose attitude the reference tells."""

from dataclasses import replace

import jax.numpy as jnp

from jaximu.ground.rotation import conjugate, exponential, multiply, rotate
from jaximu.model.effects.base import SetupEffect

__all__ = ["EFFECTS", "SetupReferenceRotation"]

_TURNED = ("specific_force", "angular_rate", "angular_acceleration")


class SetupReferenceRotation(SetupEffect):
    """The unit's axes are the reference's body axes turned by the rotation vector α, the same at all times.

    Where all of both gains is free it is inside them; by hand the accelerometer's gain is lower triangular, which sets
    the unit's axes, and then it is the mounting.
    """

    name = "setup.reference_rotation"
    formula = "u = exp(α)ᵀ u_said"
    unit = "rad"
    needs = _TURNED[:2]
    excited_by = "rotations about two axes, with a reference"
    source = "definition"
    typical = 1e-3
    known = 0.5
    cause = False

    def act(self, stimulus, quantity):
        for name in self.needs:
            stimulus.need(name, self.name)
        turned = exponential(self.coefficients)
        fields = {name: rotate(jnp.broadcast_to(conjugate(turned), (*given.shape[:-1], 4)), given)
                  for name in _TURNED if (given := getattr(stimulus, name)) is not None}  # fmt: skip
        if stimulus.attitude is not None:
            fields["attitude"] = multiply(stimulus.attitude, jnp.broadcast_to(turned, stimulus.attitude.shape))
        return replace(stimulus, **fields)


EFFECTS = (SetupReferenceRotation,)
