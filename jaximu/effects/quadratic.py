"""Even scale-factor nonlinearity: an output in proportion to the square of each axis's input."""

from jaximu.effects.base import Effect

__all__ = ["AccelQuadratic", "GyroQuadratic"]


class AccelQuadratic(Effect):
    """c_i f_i² on each axis (K₂, the second-order coefficient of IEEE Std 1293-2018)."""

    name = "accel.quadratic"
    formula = "c_i f_i²"
    unit = "output/(m/s^2)^2"
    size = 3
    scope = "device"
    excited_by = "many orientations at rest"
    look_alikes = ("accel.asymmetry",)
    source = "IEEE Std 1293-2018, second-order coefficient K2"
    typical = 1e-3

    def term(self, stimulus):
        assert stimulus.specific_force is not None
        return self.coefficients * stimulus.specific_force**2


class GyroQuadratic(Effect):
    """c_i ω_i² on each axis (scale-factor nonlinearity of IEEE Std 528-2019)."""

    name = "gyro.quadratic"
    formula = "c_i ω_i²"
    unit = "output/(rad/s)^2"
    size = 3
    scope = "device"
    excited_by = "turns at several rates, in both directions"
    look_alikes = ("gyro.asymmetry",)
    source = "IEEE Std 528-2019, scale-factor nonlinearity"
    typical = 1e-3

    def term(self, stimulus):
        assert stimulus.angular_rate is not None
        return self.coefficients * stimulus.angular_rate**2
