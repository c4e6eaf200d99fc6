"""Recipes from recordings to a `Calibration`."""

from jaximu.calibration.calibration import (
    Calibration,
    calibrate,
    compensate,
    forces_and_angles,
    load_calibration,
    residual_rms,
)
from jaximu.calibration.fit import METHODS, Fit, fit_hand_held
from jaximu.calibration.nominal import nominal_imu

__all__ = [
    "METHODS",
    "Calibration",
    "Fit",
    "calibrate",
    "compensate",
    "fit_hand_held",
    "forces_and_angles",
    "load_calibration",
    "nominal_imu",
    "residual_rms",
]
