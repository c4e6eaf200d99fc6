"""Scale-factor asymmetry: another gain for positive than for negative input."""

import jax.numpy as jnp

from jaximu.effects.base import Effect

__all__ = ["EFFECTS", "AccelAsymmetry", "GyroAsymmetry"]


class AccelAsymmetry(Effect):
    """c_i |f_i| on each axis: the gain is K + c for positive and K − c for negative input."""

    name = "accel.asymmetry"
    formula = "c_i |f_i|"
    unit = "output/(m/s^2)"
    size = 3
    scope = "device"
    needs = ("specific_force",)
    excited_by = "many orientations at rest"
    look_alikes = ("accel.quadratic",)
    source = "IEEE Std 528-2019, scale factor asymmetry"
    typical = 1e-3

    def term(self, stimulus):
        return self.coefficients * jnp.abs(stimulus.need("specific_force", self.name))


class GyroAsymmetry(Effect):
    """c_i |ω_i| on each axis: the gain is K + c in one sense of rotation and K − c in the other."""

    name = "gyro.asymmetry"
    formula = "c_i |ω_i|"
    unit = "output/(rad/s)"
    size = 3
    scope = "device"
    needs = ("angular_rate",)
    excited_by = "turns in both directions, also at one rate"
    look_alikes = ("gyro.quadratic",)
    source = "IEEE Std 528-2019, scale factor asymmetry"
    typical = 1e-3

    def term(self, stimulus):
        return self.coefficients * jnp.abs(stimulus.need("angular_rate", self.name))


EFFECTS = (AccelAsymmetry, GyroAsymmetry)
