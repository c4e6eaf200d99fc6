"""Residuals: pure functions of (Imu, observations) and fixed weights, one file each."""

from jaximu.residuals.gravity_direction import gravity_direction, turn_angle_errors
from jaximu.residuals.gravity_norm import gravity_norm
from jaximu.residuals.joint import joint_conditions
from jaximu.residuals.static_gyroscope import static_gyroscope, static_gyroscope_error
from jaximu.residuals.turntable import turntable_error

__all__ = [
    "gravity_direction",
    "gravity_norm",
    "joint_conditions",
    "static_gyroscope",
    "static_gyroscope_error",
    "turn_angle_errors",
    "turntable_error",
]
