"""Vibration rectification: a steady bias under vibration."""

from jaximu.effects.base import Effect

__all__ = ["EFFECTS", "AccelVibrationRectification", "GyroVibrationRectification"]


class _VibrationRectification(Effect):
    """A bias in proportion to the mean square of the vibration's acceleration, all directions together.

    An even nonlinearity rectifies what is too quick to appear in the samples.
    """

    formula = "c_i P, P the mean square of the vibration's acceleration"
    unit = "output/(m/s^2)^2"
    size = 3
    scope = "device"
    needs = ("vibration_power",)
    excited_by = "vibration of several strengths"
    source = "IEEE Std 1293-2018, vibration rectification error"

    def term(self, stimulus):
        return self.coefficients * stimulus.need("vibration_power", self.name)[..., None]


class AccelVibrationRectification(_VibrationRectification):
    __doc__ = _VibrationRectification.__doc__
    name = "accel.vibration_rectification"
    look_alikes = ("accel.step",)
    typical = 1e-3


class GyroVibrationRectification(_VibrationRectification):
    __doc__ = _VibrationRectification.__doc__
    name = "gyro.vibration_rectification"
    look_alikes = ("gyro.step",)
    typical = 1e-4


EFFECTS = (AccelVibrationRectification, GyroVibrationRectification)
