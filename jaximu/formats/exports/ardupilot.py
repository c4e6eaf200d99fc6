"""ArduPilot's calibration parameters `INS_ACC*`, `INS_GYR*`, in the list that Mission Planner and MAVProxy load.

accelerometer: u = (y − OFFS) ∘ SCAL; gyroscope: u = y − OFFS, after the sensor's rotation and before the board's
(ArduPilot, libraries/AP_InertialSensor/AP_InertialSensor_Backend.cpp, `_rotate_and_correct_accel`). There is no place
for misalignment, nor for a gyroscope's scale.
"""

from __future__ import annotations

import numpy as np

from jaximu.errors import InputError
from jaximu.formats.exports.base import Correction, Parameters, Written, comments, vector_text
from jaximu.formats.exports.px4 import diagonal

SUFFIX = ".param"
SUMMARY = "ArduPilot: INS_ACC*, INS_GYR* (offset; scale of the accelerometer)"


def write(parameters: Parameters) -> Written:
    """Write offsets and scales of sensor `instance` (0, 1 or 2)."""
    parameters.require_si("ArduPilot")
    if not 0 <= parameters.instance <= 2:
        raise InputError(f"--instance: ArduPilot names its sensors 0, 1 and 2 here, not {parameters.instance}.")
    accelerometer, gyroscope = parameters.accelerometer, parameters.gyroscope
    number = "" if parameters.instance == 0 else str(parameters.instance + 1)
    scale = diagonal(accelerometer)
    values: list[tuple[str, float]] = []
    values += [(f"INS_ACC{number}OFFS_{axis}", each) for axis, each in zip("XYZ", accelerometer.bias, strict=True)]
    values += [(f"INS_ACC{number}SCAL_{axis}", each) for axis, each in zip("XYZ", scale, strict=True)]
    corrections = {"accelerometer": Correction(np.diag(scale), accelerometer.bias)}
    equation = f"a = (y - OFFS) * SCAL, axis by axis\nOFFS = {vector_text(accelerometer.bias)}"
    equation += f"\nSCAL = {vector_text(scale)}"
    if gyroscope is not None:
        values += [(f"INS_GYR{number}OFFS_{axis}", each) for axis, each in zip("XYZ", gyroscope.bias, strict=True)]
        corrections["gyroscope"] = Correction(np.eye(3), gyroscope.bias)
        equation += f"\nw = y - OFFS\nOFFS = {vector_text(gyroscope.bias)}"
    rows = [f"{name},{float(value)!r}" for name, value in values]
    convention = (
        "ArduPilot subtracts the offset, then scales, in the sensor's axes; parameters are single precision (6e-8 of a "
        "value), and it refuses scales outside 0.8 to 1.2. A DataFlash log holds values that the parameters in force "
        "have corrected already (IMU, ACC and GYR alike): the new offset is then OFFS_old + OFFS / SCAL_old, the new "
        "scale SCAL_old * SCAL; set INS_*OFFS to 0 and INS_*SCAL to 1 while recording and none of this is needed."
    )
    return Written({"": ("\n".join([comments(parameters), *rows]) + "\n").encode()}, convention, equation, corrections)
