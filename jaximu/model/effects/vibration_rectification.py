"""Vibration rectification: a steady bias under vibration."""

from jaximu.model.effects.base import BiasEffect, pair


class _VibrationRectification(BiasEffect):
    """A bias in proportion to the mean square of the vibration's acceleration, all directions together.

    An even nonlinearity rectifies what is too quick to appear in the samples.
    """

    formula = "c_i P, P the mean square of the vibration's acceleration"
    unit = "output/(m/s^2)^2"
    needs = ("vibration_power",)
    excited_by = "vibration of several strengths"
    source = "IEEE Std 1293-2018, vibration rectification error"


EFFECTS = AccelVibrationRectification, GyroVibrationRectification = pair(
    _VibrationRectification, "vibration_rectification", (1e-3, 1e-4), "step"
)
