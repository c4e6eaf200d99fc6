"""Even scale-factor nonlinearity: an output in proportion to the square of each axis's input."""

from jaximu.effects.base import Effect

__all__ = ["EFFECTS", "AccelQuadratic", "GyroQuadratic"]


class AccelQuadratic(Effect):
    """c_i f_i² on each axis: the gain grows with the input on one side and shrinks on the other."""

    name = "accel.quadratic"
    common_name = "quadratic nonlinearity"
    formula = "c_i f_i²"
    unit = "output/(m/s^2)^2"
    size = 3
    scope = "device"
    needs = ("specific_force",)
    excited_by = "many orientations at rest"
    look_alikes = ("accel.asymmetry",)
    source = "IEEE Std 1293-2018, second-order coefficient K2"
    typical = 1e-3

    def term(self, stimulus):
        return self.coefficients * stimulus.need("specific_force", self.name) ** 2


class GyroQuadratic(Effect):
    """c_i ω_i² on each axis: the gain grows with the rate in one sense of rotation and shrinks in the other."""

    name = "gyro.quadratic"
    common_name = "quadratic nonlinearity"
    formula = "c_i ω_i²"
    unit = "output/(rad/s)^2"
    size = 3
    scope = "device"
    needs = ("angular_rate",)
    excited_by = "turns at several rates, in both directions"
    look_alikes = ("gyro.asymmetry",)
    source = "IEEE Std 528-2019, scale factor nonlinearity"
    typical = 1e-3

    def term(self, stimulus):
        return self.coefficients * stimulus.need("angular_rate", self.name) ** 2


EFFECTS = (AccelQuadratic, GyroQuadratic)
