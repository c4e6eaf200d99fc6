"""Scale factor over temperature."""

from jaximu.effects.base import Effect

__all__ = ["EFFECTS", "AccelScaleTemperature", "GyroScaleTemperature"]


class AccelScaleTemperature(Effect):
    """A scale factor that changes in proportion to temperature, counted from the reference temperature."""

    name = "accel.scale_temperature"
    common_name = "scale over temperature"
    formula = "c_i (T − T_ref) f_i"
    unit = "output/(m/s^2)/K"
    size = 3
    scope = "device"
    needs = ("temperature", "specific_force")
    excited_by = "poses at several temperatures"
    look_alikes = ("accel.temperature",)
    source = "IEEE Std 528-2019, scale factor temperature sensitivity"
    typical = 1e-4

    def term(self, stimulus):
        return self.coefficients * stimulus.warmth(self.name)[..., None] * stimulus.need("specific_force", self.name)


class GyroScaleTemperature(Effect):
    """A scale factor that changes in proportion to temperature, counted from the reference temperature."""

    name = "gyro.scale_temperature"
    common_name = "scale over temperature"
    formula = "c_i (T − T_ref) ω_i"
    unit = "output/(rad/s)/K"
    size = 3
    scope = "device"
    needs = ("temperature", "angular_rate")
    excited_by = "turns at several temperatures"
    look_alikes = ()
    source = "IEEE Std 528-2019, scale factor temperature sensitivity"
    typical = 1e-4

    def term(self, stimulus):
        return self.coefficients * stimulus.warmth(self.name)[..., None] * stimulus.need("angular_rate", self.name)


EFFECTS = (AccelScaleTemperature, GyroScaleTemperature)
