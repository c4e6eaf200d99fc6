"""Scale ramp: a scale factor that drifts in proportion to time."""

from jaximu.effects.base import Effect

__all__ = ["EFFECTS", "AccelScaleRamp", "GyroScaleRamp"]


class _ScaleRamp(Effect):
    """A scale factor that changes in proportion to time, counted from the reference time (warming up, ageing)."""

    size = 3
    scope = "session"
    source = "IEEE Std 528-2019, scale factor stability"
    typical = 1e-5

    def term(self, stimulus):
        return self.coefficients * stimulus.elapsed(self.name)[..., None] * stimulus.need(self.needs[1], self.name)


class AccelScaleRamp(_ScaleRamp):
    __doc__ = _ScaleRamp.__doc__
    name = "accel.scale_ramp"
    formula = "c_i t f_i"
    unit = "output/(m/s^2)/s"
    needs = ("time", "specific_force")
    excited_by = "many orientations, early and late"
    look_alikes = ("accel.scale_temperature", "accel.scale_step")


class GyroScaleRamp(_ScaleRamp):
    __doc__ = _ScaleRamp.__doc__
    name = "gyro.scale_ramp"
    formula = "c_i t ω_i"
    unit = "output/(rad/s)/s"
    needs = ("time", "angular_rate")
    excited_by = "turns about all axes, early and late"
    look_alikes = ("gyro.scale_temperature", "gyro.scale_step")


EFFECTS = (AccelScaleRamp, GyroScaleRamp)
