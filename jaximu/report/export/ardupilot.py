"""ArduPilot's parameters `INS_ACC*`, `INS_GYR*` and `COMPASS_*`, in the list that Mission Planner and MAVProxy load.

accelerometer: u = (y − OFFS) ∘ SCAL; gyroscope: u = y − OFFS, after the sensor's rotation and before the board's
(ArduPilot, libraries/AP_InertialSensor/AP_InertialSensor_Backend.cpp, `_rotate_and_correct_accel`). There is no place
for misalignment, nor for a gyroscope's scale. Magnetometer, in milligauss: h = S (y + OFS), S symmetric with DIA on its
diagonal and ODI beside it (xy, xz, yz), after its rotation ORIENT (AP_Compass_Backend.cpp, `correct_field`).
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError
from jaximu.recordings.readers.parameters import ParameterFile
from jaximu.report.export.autopilot import Firmware, cubic, need_temperature, rotation_of
from jaximu.report.export.base import ExportedUnit, Written, comments, text_file

SUFFIX = ".param"
SUMMARY = "ArduPilot: INS_ACC*, INS_GYR* (offset; scale of the accelerometer), COMPASS_*"
MAGNETIC = True


class ArduPilot(Firmware):
    """ArduPilot since it has `INS_ACC_ID`: R is AHRS_ORIENTATION's, which comes last.

    Its number is MAVLink's, and 41 to 43 more; 100 to 102 are angles of the user's (AP_Math/rotations.h; the angles are
    those of AP_Math/tests/test_rotations.cpp). t(T) = p(T) − p(INS_ACCn_CALTEMP), p of the INS_TCALn_ parameters, both
    temperatures held in its range (AP_InertialSensor_tempcal.cpp, `correct_sensor`). Logs hold corrected values alone.
    """

    name, sensors, logs_numbers = "ArduPilot", 3, True
    rotations: ClassVar = {38: (90.0, 68.8, 293.3), 41: (0.0, 7.0, 0.0), 42: (45.0, 0.0, 0.0), 43: (315.0, 0.0, 0.0)}
    custom: ClassVar = {100: ("AHRS_CUSTOM_", "PIT"), 101: ("CUST_ROT1_", "PITCH"), 102: ("CUST_ROT2_", "PITCH")}
    reference = 35.0  # °C
    short: ClassVar = {"accelerometer": "ACC", "gyroscope": "GYR", "magnetometer": "COMPASS"}
    patterns: ClassVar = {
        "accelerometer": "INS_{sensor}{number}{word}_{axis}",
        "gyroscope": "INS_{sensor}{number}{word}_{axis}",
        "magnetometer": "{sensor}_{word}{number}_{axis}",
    }
    identity, orientation = "INS_{sensor}{number}_ID", "{sensor}_ORIENT{number}"
    offset, scale, matrix, unit, rotated = "OFFS", "SCAL", ("OFS", "DIA", "ODI"), ("mGauss", 10.0), True

    def label(self, number: int) -> str:
        """INS_ACC, INS_ACC2, INS_ACC3."""
        return str(number + 1) if number else ""

    def rotation(self, file: ParameterFile, triad: str, number: int) -> FloatArray:
        """That of the board; a sensor's own comes before its offsets."""
        index = file.value("AHRS_ORIENTATION")
        if index in self.custom:
            stem, pitch = self.custom[int(index)]
            return rotation_of(*file.vector(f"{stem}{angle}" for angle in ("ROLL", pitch, "YAW")))
        return self.numbered(file, "AHRS_ORIENTATION", index)

    def thermal(self, file: ParameterFile, triad: str, number: int, celsius: float | None) -> FloatArray:
        """p(T) − p(T_cal), p = 1e-6 (c1 d + c2 d² + c3 d³), d = T − 35 °C."""
        stem = f"INS_TCAL{number + 1}_"
        short = self.short[triad]
        if file.value(f"{stem}ENABLE", 0.0) != 1:
            return np.zeros(3)
        celsius = need_temperature(file, f"{stem}ENABLE", celsius)
        powers = [file.vector(f"{stem}{short}{power}_{axis}" for axis in "XYZ") for power in range(1, 4)]
        ends = file.vector(f"{stem}T{end}" for end in ("MIN", "MAX"))
        coefficients = 1e-6 * np.array([np.zeros(3), *powers])
        then = file.value(f"INS_{short}{number + 1}_CALTEMP")
        return cubic(coefficients, self.reference, celsius, *ends) - cubic(coefficients, self.reference, then, *ends)


FIRMWARE = ArduPilot()


def write(parameters: ExportedUnit) -> Written:
    """Write offsets and scales of sensor `instance` (0, 1 or 2)."""
    parameters = parameters.for_autopilot("ArduPilot")
    number = parameters.instance or 0
    if number not in range(FIRMWARE.sensors):
        raise InputError(f"--instance: ArduPilot names its sensors 0, 1 and 2 here, not {number}.")
    values, equation, corrections, rotation = FIRMWARE.values(parameters)
    convention = (
        "ArduPilot subtracts the offset, then scales, in the sensor's axes; parameters are single precision (6e-8 of a "
        "value), and it refuses scales outside 0.8 to 1.2. "
    )
    convention += parameters.composition or (
        "A DataFlash log holds values that the parameters in force have corrected already (IMU, ACC and GYR alike): "
        "give them (--in-force), unless INS_*OFFS were 0, INS_*SCAL 1 and AHRS_ORIENTATION 0 while recording."
    )
    text = text_file([comments(parameters), *(f"{name},{value!r}" for name, value in values.items())])
    return Written(text, convention + rotation, equation, corrections, parameters=parameters, values=values)
