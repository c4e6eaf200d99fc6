"""PX4's calibration parameters `CAL_ACC*` and `CAL_GYRO*`, in the list that QGroundControl loads.

accelerometer: u = (y − OFF) ∘ SCALE; gyroscope: u = y − OFF, in the sensor's own axes (PX4-Autopilot,
src/lib/sensor_calibration/Accelerometer.hpp and Gyroscope.hpp, `Correct`). There is no place for misalignment, nor for
a gyroscope's scale.
"""

from __future__ import annotations

import numpy as np

from jaximu.formats.exports.base import Correction, Linear, Parameters, Written, comments, vector_text

SUFFIX = ".params"
SUMMARY = "PX4: CAL_ACC*, CAL_GYRO* (offset; scale of the accelerometer)"
_REAL, _INTEGER = 9, 6  # MAV_PARAM_TYPE


def diagonal(triad: Linear) -> np.ndarray:
    """(3,) the scale s that leaves the least mean square error of s ∘ K u against u, u in every direction alike."""
    return np.diag(triad.gain) / np.sum(triad.gain**2, axis=1)


def write(parameters: Parameters) -> Written:
    """Write offsets and scales of sensor `instance`; its device's ID only if it was stated."""
    parameters.require_si("PX4")
    accelerometer, gyroscope, place = parameters.accelerometer, parameters.gyroscope, parameters.instance
    scale = diagonal(accelerometer)
    values: list[tuple[str, float]] = []
    values += [(f"CAL_ACC{place}_{axis}OFF", each) for axis, each in zip("XYZ", accelerometer.bias, strict=True)]
    values += [(f"CAL_ACC{place}_{axis}SCALE", each) for axis, each in zip("XYZ", scale, strict=True)]
    corrections = {"accelerometer": Correction(np.diag(scale), accelerometer.bias)}
    equation = f"a = (y - OFF) * SCALE, axis by axis\nOFF = {vector_text(accelerometer.bias)}"
    equation += f"\nSCALE = {vector_text(scale)}"
    if gyroscope is not None:
        values += [(f"CAL_GYRO{place}_{axis}OFF", each) for axis, each in zip("XYZ", gyroscope.bias, strict=True)]
        corrections["gyroscope"] = Correction(np.eye(3), gyroscope.bias)
        equation += f"\nw = y - OFF\nOFF = {vector_text(gyroscope.bias)}"
    rows = [f"1\t1\t{name}\t{float(value)!r}\t{_REAL}" for name, value in values]
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
    return Written({"": ("\n".join(head + rows) + "\n").encode()}, convention, equation, corrections)
