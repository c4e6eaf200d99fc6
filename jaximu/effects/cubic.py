"""Odd scale-factor nonlinearity: an output in proportion to the cube of each axis's input."""

from jaximu.effects.base import Effect

__all__ = ["EFFECTS", "AccelCubic", "GyroCubic"]


class AccelCubic(Effect):
    """c_i f_i³ on each axis. With inputs of +1 g and −1 g alone it cannot be told from scale."""

    name = "accel.cubic"
    common_name = "cubic nonlinearity"
    formula = "c_i f_i³"
    unit = "output/(m/s^2)^3"
    size = 3
    scope = "device"
    needs = ("specific_force",)
    excited_by = "orientations at rest off the axes"
    look_alikes = ()
    source = "IEEE Std 1293-2018, third-order coefficient K3"
    typical = 1e-5

    def term(self, stimulus):
        return self.coefficients * stimulus.need("specific_force", self.name) ** 3


class GyroCubic(Effect):
    """c_i ω_i³ on each axis. With turns of one rate alone it cannot be told from scale."""

    name = "gyro.cubic"
    common_name = "cubic nonlinearity"
    formula = "c_i ω_i³"
    unit = "output/(rad/s)^3"
    size = 3
    scope = "device"
    needs = ("angular_rate",)
    excited_by = "turns at several rates"
    look_alikes = ()
    source = "IEEE Std 528-2019, scale factor nonlinearity"
    typical = 1e-4

    def term(self, stimulus):
        return self.coefficients * stimulus.need("angular_rate", self.name) ** 3


EFFECTS = (AccelCubic, GyroCubic)
