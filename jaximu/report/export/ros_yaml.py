"""A ROS 2 parameter file: matrix and bias of each triad, row by row; any node applies it in one line."""

from __future__ import annotations

import numpy as np

from jaximu.ground.units import SENSOR_UNITS
from jaximu.report.export.base import ExportedUnit, Written, comments, exact_text, text_file

SUFFIX = ".yaml"
MAGNETIC = True
SUMMARY = "ROS 2 parameters: matrix and bias (y in any unit, counts too)"


def write(parameters: ExportedUnit) -> Written:
    """Write `imu_calibration.<triad>.matrix` (nine numbers), `.bias`, `.g_sensitivity` and what each is in."""
    lines = [
        comments(parameters),
        "# u = matrix (y - bias - g_sensitivity f): u in m/s^2, rad/s or uT, y the raw value in output_unit, f the",
        "# corrected specific force. Matrices row by row. Holds at reference_temperature (degC).",
        "/**:",
        "  ros__parameters:",
        "    imu_calibration:",
    ]
    corrections = parameters.corrections(sensitive=True)
    for name, correction in corrections.items():
        reference = parameters.calibration.imu.triads()[name].temperature_reference
        lines += [
            f"      {name}:",
            f'        output_unit: "{parameters.triads[name].unit}"',
            f'        corrected_unit: "{SENSOR_UNITS[name]}"',
            f"        reference_temperature: {float(reference)!r}",
            f"        matrix: {exact_text(correction.matrix.ravel())}",
            f"        bias: {exact_text(correction.offset)}",
        ]
        if np.any(correction.g_sensitivity):
            lines.append(f"        g_sensitivity: {exact_text(correction.g_sensitivity.ravel())}")
    convention = "inverse: u = matrix (y - bias - g_sensitivity f), bias in output units and subtracted first."
    equation = parameters.equation("matrix", sensitive=True)
    return Written(text_file(lines), convention, equation, corrections, frozenset({"gyro.g_sensitivity"}))
