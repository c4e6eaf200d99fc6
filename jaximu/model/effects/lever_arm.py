"""Lever arm: the accelerometer triad does not sit at the point that the motion is known for."""

import jax.numpy as jnp

from jaximu.model.effects.base import Effect

LEVER_RECOVERY = (
    "exactly where ω̇ is known; else ω̇ is taken by central differences of the samples, which lose (2πfΔt)²/6 of its "
    "part at frequency f: 1 % at a twenty-fifth of the sample rate, 7 % at a tenth"
)


def lever_acceleration(arm, rate, acceleration):
    """Return ω×(ω×r) + ω̇×r (..., 3), m/s²: how a point at r (m) on a rigid body is accelerated against its origin."""
    return jnp.cross(rate, jnp.cross(rate, arm)) + jnp.cross(acceleration, arm)


class AccelLeverArm(Effect):
    """The force at r from the point that `specific_force` belongs to, such as the centre of a rate table."""

    name = "accel.lever_arm"
    formula = "ω×(ω×r) + ω̇×r"
    unit = "m"
    scope = "fixture"
    needs = ("angular_rate", "angular_acceleration")
    excited_by = "a rate table: centripetal force at several rates"
    look_alikes = ("accel.size_effect",)
    source = "rigid-body kinematics"
    typical = 1e-2
    known = 1.0
    refers_to = "input"
    recovery = LEVER_RECOVERY

    def term(self, stimulus):
        return lever_acceleration(self.coefficients, *self.needed(stimulus))


EFFECTS = (AccelLeverArm,)
