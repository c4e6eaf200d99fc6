"""PX4's calibration parameters `CAL_ACC*`, `CAL_GYRO*` and `CAL_MAG*`, in the list that QGroundControl loads.

accelerometer: u = (y − TC − OFF) ∘ SCALE; gyroscope: u = y − TC − OFF, in the sensor's own axes (PX4-Autopilot,
src/lib/sensor_calibration/Accelerometer.hpp and Gyroscope.hpp, `Correct`); TC is the thermal compensation, zero unless
enabled, which `jaximu.thermal.autopilot` writes without the bias. There is no place for misalignment, nor for a
gyroscope's scale. Magnetometer, in gauss: h = R S (y − OFF), S symmetric with SCALE on its diagonal and ODIAG beside it
(xy, xz, yz), R the rotation ROT (Magnetometer.hpp, `Correct`).
"""

from __future__ import annotations

from jaximu.formats.exports.autopilot import Compass, diagonal
from jaximu.formats.exports.base import Parameters, Written, comments, matrix_text, vector_text

SUFFIX = ".params"
SUMMARY = "PX4: CAL_ACC*, CAL_GYRO* (offset; scale of the accelerometer), CAL_MAG*"
MAGNETIC = True
_GAUSS = 0.01  # to a µT
_REAL, _INTEGER = 9, 6  # MAV_PARAM_TYPE


def write(parameters: Parameters) -> Written:
    """Write offsets and scales of sensor `instance`; its device's ID only if it was stated."""
    parameters.require_si("PX4")
    place = parameters.instance
    found = diagonal(
        parameters, f"CAL_ACC{place}_{{axis}}{{word}}", f"CAL_GYRO{place}_{{axis}}{{word}}", "OFF", "SCALE"
    )
    values, corrections, equation, turned = [*found.values], dict(found.corrections), [found.equation], ""
    devices = [name for name, triad in (("ACC", "accelerometer"), ("GYRO", "gyroscope")) if triad in parameters.triads]
    if parameters.magnetometer is not None:
        compass = Compass.of(parameters.magnetometer, _GAUSS, f"CAL_MAG{place}_ROT")
        parts = {"OFF": compass.offset, "SCALE": compass.diagonal, "ODIAG": compass.off_diagonal}
        values += [(f"CAL_MAG{place}_{axis}{word}", float(each)) for word, part in parts.items()
                   for axis, each in zip("XYZ", part, strict=True)]  # fmt: skip
        corrections["magnetometer"], turned = compass.correction, compass.rotation
        matrix = matrix_text(compass.correction.matrix)
        equation.append(f"h [gauss] = S (y - OFF), S = {matrix}\nOFF = {vector_text(compass.offset)}")
    mine = devices or ["MAG"]  # a magnetometer is a device of its own
    left = [] if parameters.device is not None else [*mine]
    left += ["MAG"] if devices and parameters.magnetometer is not None else []
    rows = [f"1\t1\t{name}\t{value!r}\t{_REAL}" for name, value in values]
    if parameters.device is not None:
        rows += [f"1\t1\tCAL_{each}{place}_ID\t{parameters.device}\t{_INTEGER}" for each in mine]
    head = [comments(parameters), "# Vehicle-Id Component-Id Name Value Type"]
    convention = (
        "PX4 subtracts the offset, then scales, in the sensor's own axes before its rotation; parameters are single "
        "precision (6e-8 of a value). They replace those in the vehicle, so they hold for a calibration made from the "
        "topics sensor_accel, sensor_gyro and sensor_mag, which PX4 has not corrected."
    )
    convention += turned
    if left:
        convention += (
            f" PX4 uses them only where {' and '.join(f'CAL_{each}{place}_ID' for each in left)} are the sensor's: "
            "these are left as they are; state --device to write one device's."
        )
    return Written(
        {"": ("\n".join(head + rows) + "\n").encode()}, convention, "\n".join(filter(None, equation)), corrections
    )
