"""PX4's calibration parameters `CAL_ACC*`, `CAL_GYRO*` and `CAL_MAG*`, in the list that QGroundControl loads.

accelerometer: u = (y − TC − OFF) ∘ SCALE; gyroscope: u = y − TC − OFF, in the sensor's own axes (PX4-Autopilot,
src/lib/sensor_calibration/Accelerometer.hpp and Gyroscope.hpp, `Correct`); TC is the thermal compensation, zero unless
enabled, which `jaximu.report.export.thermal_autopilot` writes without the bias. There is no place for misalignment, nor
for a gyroscope's scale. Magnetometer, in gauss: h = R S (y − OFF), S symmetric with SCALE on its diagonal and ODIAG
beside it (xy, xz, yz), R the rotation ROT (Magnetometer.hpp, `Correct`).
"""

from __future__ import annotations

from jaximu.report.export.autopilot import Autopilot
from jaximu.report.export.base import ExportedUnit, Written, comments, text_file

SUFFIX = ".params"
SUMMARY = "PX4: CAL_ACC*, CAL_GYRO* (offset; scale of the accelerometer), CAL_MAG*"
MAGNETIC = True
_REAL, _INTEGER = 9, 6  # MAV_PARAM_TYPE
_SENSORS = {"accelerometer": "ACC", "gyroscope": "GYRO", "magnetometer": "MAG"}


def write(parameters: ExportedUnit) -> Written:
    """Write offsets and scales of sensor `instance`; its device's ID only if it was stated."""
    parameters = parameters.for_autopilot("PX4")
    parameters.require_si("PX4")
    number = parameters.instance
    tool = Autopilot(
        {name: f"CAL_{sensor}{number}_{{axis}}{{word}}" for name, sensor in _SENSORS.items()},
        "OFF",
        "SCALE",
        ("OFF", "SCALE", "ODIAG"),
        f"CAL_MAG{number}_ROT",
        ("gauss", 0.01),
        rotated=False,
    )
    values, equation, corrections, rotation = tool.values(parameters)
    devices = [_SENSORS[name] for name in ("accelerometer", "gyroscope") if name in parameters.triads]
    mine = devices or ["MAG"]  # a magnetometer is a device of its own
    left = [] if parameters.device is not None else [*mine]
    left += ["MAG"] if devices and "magnetometer" in parameters.triads else []
    rows = [f"1\t1\t{name}\t{value!r}\t{_REAL}" for name, value in values]
    if parameters.device is not None:
        rows += [f"1\t1\tCAL_{sensor}{number}_ID\t{parameters.device}\t{_INTEGER}" for sensor in mine]
    head = [comments(parameters), "# Vehicle-Id Component-Id Name Value Type"]
    convention = (
        "PX4 subtracts the offset, then scales, in the sensor's own axes before its rotation; parameters are single "
        "precision (6e-8 of a value). They replace those in the vehicle, so they hold for a calibration made from the "
        "topics sensor_accel, sensor_gyro and sensor_mag, which PX4 has not corrected."
    )
    convention += rotation
    if left:
        convention += (
            f" PX4 uses them only where {' and '.join(f'CAL_{sensor}{number}_ID' for sensor in left)} are the sensor's:"
            " these are left as they are; state --device to write one device's."
        )
    return Written(text_file([*head, *rows]), convention, equation, corrections, parameters=parameters)
