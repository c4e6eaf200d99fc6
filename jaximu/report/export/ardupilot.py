"""ArduPilot's parameters `INS_ACC*`, `INS_GYR*` and `COMPASS_*`, in the list that Mission Planner and MAVProxy load.

accelerometer: u = (y − OFFS) ∘ SCAL; gyroscope: u = y − OFFS, after the sensor's rotation and before the board's
(ArduPilot, libraries/AP_InertialSensor/AP_InertialSensor_Backend.cpp, `_rotate_and_correct_accel`). There is no place
for misalignment, nor for a gyroscope's scale. Magnetometer, in milligauss: h = S (y + OFS), S symmetric with DIA on its
diagonal and ODI beside it (xy, xz, yz), after its rotation ORIENT (AP_Compass_Backend.cpp, `correct_field`).
"""

from __future__ import annotations

from jaximu.ground.errors import InputError
from jaximu.report.export.autopilot import Autopilot
from jaximu.report.export.base import ExportedUnit, Written, comments, text_file

SUFFIX = ".param"
SUMMARY = "ArduPilot: INS_ACC*, INS_GYR* (offset; scale of the accelerometer), COMPASS_*"
MAGNETIC = True


def write(parameters: ExportedUnit) -> Written:
    """Write offsets and scales of sensor `instance` (0, 1 or 2)."""
    parameters = parameters.for_autopilot("ArduPilot")
    parameters.require_si("ArduPilot")
    if not 0 <= parameters.instance <= 2:
        raise InputError(f"--instance: ArduPilot names its sensors 0, 1 and 2 here, not {parameters.instance}.")
    number = "" if parameters.instance == 0 else str(parameters.instance + 1)
    patterns = {
        "accelerometer": f"INS_ACC{number}{{word}}_{{axis}}",
        "gyroscope": f"INS_GYR{number}{{word}}_{{axis}}",
        "magnetometer": f"COMPASS_{{word}}{number}_{{axis}}",
    }
    tool = Autopilot(
        patterns, "OFFS", "SCAL", ("OFS", "DIA", "ODI"), f"COMPASS_ORIENT{number}", ("mGauss", 10.0), rotated=True
    )
    values, equation, corrections, rotation = tool.values(parameters)
    rows = [f"{name},{value!r}" for name, value in values]
    convention = (
        "ArduPilot subtracts the offset, then scales, in the sensor's axes; parameters are single precision (6e-8 of a "
        "value), and it refuses scales outside 0.8 to 1.2. A DataFlash log holds values that the parameters in force "
        "have corrected already (IMU, ACC and GYR alike): the new offset is then OFFS_old + OFFS / SCAL_old, the new "
        "scale SCAL_old * SCAL; set INS_*OFFS to 0 and INS_*SCAL to 1 while recording and none of this is needed."
    )
    text = text_file([comments(parameters), *rows])
    return Written(text, convention + rotation, equation, corrections, parameters=parameters)
