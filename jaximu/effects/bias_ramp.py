"""Bias ramp: a bias that drifts in proportion to time."""

from jaximu.effects.base import Effect

__all__ = ["EFFECTS", "AccelBiasRamp", "GyroBiasRamp"]


class _BiasRamp(Effect):
    """A bias in proportion to time, counted from the reference time: the rate ramp R of an Allan deviation."""

    formula = "c_i t"
    unit = "output/s"
    size = 3
    scope = "session"
    needs = ("time",)
    excited_by = "time"
    source = "IEEE Std 952-2020, rate ramp"

    def term(self, stimulus):
        return self.coefficients * stimulus.elapsed(self.name)[..., None]


class AccelBiasRamp(_BiasRamp):
    __doc__ = _BiasRamp.__doc__
    name = "accel.bias_ramp"
    look_alikes = ("accel.warm_up", "accel.temperature", "accel.step")
    typical = 1e-4


class GyroBiasRamp(_BiasRamp):
    __doc__ = _BiasRamp.__doc__
    name = "gyro.bias_ramp"
    look_alikes = ("gyro.warm_up", "gyro.temperature", "gyro.step")
    typical = 1e-5


EFFECTS = (AccelBiasRamp, GyroBiasRamp)
