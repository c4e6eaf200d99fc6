"""PX4's calibration parameters `CAL_ACC*`, `CAL_GYRO*` and `CAL_MAG*`, in the list that QGroundControl loads.

accelerometer: u = (y − TC − OFF) ∘ SCALE; gyroscope: u = y − TC − OFF, in the sensor's own axes (PX4-Autopilot,
src/lib/sensor_calibration/Accelerometer.hpp and Gyroscope.hpp, `Correct`); TC is the thermal compensation, zero unless
enabled, which `jaximu.report.export.thermal_autopilot` writes without the bias. There is no place for misalignment, nor
for a gyroscope's scale. Magnetometer, in gauss: h = R S (y − OFF), S symmetric with SCALE on its diagonal and ODIAG
beside it (xy, xz, yz), R the rotation ROT (Magnetometer.hpp, `Correct`).
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError
from jaximu.recordings.readers.parameters import ParameterFile
from jaximu.report.export.autopilot import Firmware, cubic, need_temperature, rotation_of
from jaximu.report.export.base import ExportedUnit, Written, comments, text_file

SUFFIX = ".params"
SUMMARY = "PX4: CAL_ACC*, CAL_GYRO* (offset; scale of the accelerometer), CAL_MAG*"
MAGNETIC = True
_REAL, _INTEGER = 9, 6  # MAV_PARAM_TYPE


class PX4(Firmware):
    """PX4 since it has `CAL_ACCn_ROT`: before, it numbered rotations and ordered corrections in other ways.

    R is the level adjustment SENS_BOARD_X_OFF, Y_OFF, Z_OFF after the rotation: that of the board, SENS_BOARD_ROT, or
    of an external sensor, CAL_ACCn_ROT, which is -1 otherwise (Accelerometer.cpp, `set_rotation`, `ParametersUpdate`).
    t is that of the TC_ parameters with the sensor's ID (temperature_compensation, `calc_thermal_offsets_3D`).
    """

    name, sensors, logs_numbers = "PX4", 4, False
    short: ClassVar = {"accelerometer": "ACC", "gyroscope": "GYRO", "magnetometer": "MAG"}
    patterns: ClassVar = dict.fromkeys(short, "CAL_{sensor}{number}_{axis}{word}")
    identity, orientation = "CAL_{sensor}{number}_ID", "CAL_{sensor}{number}_ROT"
    offset, scale, matrix, unit, rotated = "OFF", "SCALE", ("OFF", "SCALE", "ODIAG"), ("gauss", 0.01), False

    def rotation(self, file: ParameterFile, triad: str, number: int) -> FloatArray:
        """The level adjustment after the rotation."""
        parameter = self.parameter(self.orientation, triad, number)
        if parameter not in file.values:
            raise InputError(
                f"{file.path}: has no {parameter}, so the sensor's rotation is not known: a PX4 without it numbers "
                "rotations and orders corrections in other ways."
            )
        if (index := file.value(parameter)) == -1:
            index = file.value(parameter := "SENS_BOARD_ROT")
        level = file.vector(f"SENS_BOARD_{axis}_OFF" for axis in "XYZ")
        return rotation_of(*level) @ self.numbered(file, parameter, index)

    def thermal(self, file: ParameterFile, triad: str, number: int, celsius: float | None) -> FloatArray:
        """X0 + X1 d + X2 d² + X3 d³, d = T − TREF."""
        letter = self.short[triad][0]
        identity = self.identities(file, triad)[number]
        stems = (f"TC_{letter}{at}_" for at in range(self.sensors))
        stem = next((stem for stem in stems if file.value(f"{stem}ID", 0.0) == identity), None)
        if stem is None or file.value(f"TC_{letter}_ENABLE", 0.0) != 1:
            return np.zeros(3)
        celsius = need_temperature(file, f"TC_{letter}_ENABLE", celsius)
        powers = np.array([file.vector(f"{stem}X{power}_{axis}" for axis in range(3)) for power in range(4)])
        about, low, high = file.vector(f"{stem}T{end}" for end in ("REF", "MIN", "MAX"))
        return cubic(powers, about, celsius, low, high)


FIRMWARE = PX4()


def write(parameters: ExportedUnit) -> Written:
    """Write offsets and scales of sensor `instance`; its device's ID only if it was stated."""
    parameters = parameters.for_autopilot("PX4")
    values, equation, corrections, rotation = FIRMWARE.values(parameters)
    identities = {
        name: FIRMWARE.parameter(FIRMWARE.identity, name, parameters.instance or 0) for name in parameters.triads
    }
    mine = [name for name in identities if name != "magnetometer"] or [*identities]  # a magnetometer is another device
    rows = [f"1\t1\t{name}\t{value!r}\t{_REAL}" for name, value in values.items()]
    left = [*identities.values()]
    if parameters.device is not None:
        rows += [f"1\t1\t{identities[name]}\t{parameters.device}\t{_INTEGER}" for name in mine]
        left = [identity for name, identity in identities.items() if name not in mine]
    head = [comments(parameters), "# Vehicle-Id Component-Id Name Value Type"]
    convention = (
        "PX4 subtracts the offset, then scales, in the sensor's own axes before its rotation; parameters are single "
        "precision (6e-8 of a value). "
    )
    convention += parameters.composition or (
        "They replace those in the vehicle, so they hold for a calibration made from the topics sensor_accel, "
        "sensor_gyro and sensor_mag, which PX4 has not corrected; for any other give those in force (--in-force)."
    )
    convention += rotation
    if left:
        convention += (
            f" PX4 uses them only where {' and '.join(left)} are the sensor's: these are left as they are; state "
            "--device to write one device's."
        )
    return Written(text_file([*head, *rows]), convention, equation, corrections, parameters=parameters, values=values)
