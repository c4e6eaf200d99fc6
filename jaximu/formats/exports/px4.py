"""PX4's calibration parameters `CAL_ACC*` and `CAL_GYRO*`, in the list that QGroundControl loads.

accelerometer: u = (y − TC − OFF) ∘ SCALE; gyroscope: u = y − TC − OFF, in the sensor's own axes (PX4-Autopilot,
src/lib/sensor_calibration/Accelerometer.hpp and Gyroscope.hpp, `Correct`); TC is the thermal compensation, zero unless
enabled, which `jaximu.thermal.autopilot` writes without the bias. There is no place for misalignment, nor for a
gyroscope's scale.
"""

from __future__ import annotations

from jaximu.formats.exports.autopilot import diagonal
from jaximu.formats.exports.base import Parameters, Written, comments

SUFFIX = ".params"
SUMMARY = "PX4: CAL_ACC*, CAL_GYRO* (offset; scale of the accelerometer)"
_REAL, _INTEGER = 9, 6  # MAV_PARAM_TYPE


def write(parameters: Parameters) -> Written:
    """Write offsets and scales of sensor `instance`; its device's ID only if it was stated."""
    parameters.require_si("PX4")
    place = parameters.instance
    found = diagonal(
        parameters, f"CAL_ACC{place}_{{axis}}{{word}}", f"CAL_GYRO{place}_{{axis}}{{word}}", "OFF", "SCALE"
    )
    rows = [f"1\t1\t{name}\t{value!r}\t{_REAL}" for name, value in found.values]
    if parameters.device is not None:
        rows += [f"1\t1\tCAL_{each}{place}_ID\t{parameters.device}\t{_INTEGER}" for each in ("ACC", "GYRO")]
    head = [comments(parameters), "# Vehicle-Id Component-Id Name Value Type"]
    convention = (
        "PX4 subtracts the offset, then scales, in the sensor's own axes before its rotation; parameters are single "
        "precision (6e-8 of a value). They replace those in the vehicle, so they hold for a calibration made from the "
        "topics sensor_accel and sensor_gyro, which PX4 has not corrected."
    )
    if parameters.device is None:
        convention += (
            f" PX4 uses them only where CAL_ACC{place}_ID and CAL_GYRO{place}_ID are the sensor's: these are left as "
            "they are; state --device to write them."
        )
    return Written({"": ("\n".join(head + rows) + "\n").encode()}, convention, found.equation, found.corrections)
