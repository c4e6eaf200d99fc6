"""RealSense's motion intrinsics as `rs-imu-calibration.py` keeps them in its `calibration.json`.

corrected = M y − b. The script solves rows [y, −1]·X = corrected and writes the first nine numbers of X row by row as
`scale_and_alignment`, the rest as `bias` (librealsense, tools/rs-imu-calibration): that is M column by column, and a
bias that is subtracted after scaling, in m/s² and rad/s.
"""

from __future__ import annotations

import json

import numpy as np

from jaximu.report.export.base import ExportedUnit, Written, exact_text

SUFFIX = ".json"
SUMMARY = "RealSense: motion intrinsics (calibration.json of rs-imu-calibration)"


def write(parameters: ExportedUnit) -> Written:
    """Write both triads; the identity for a gyroscope that was not calibrated."""
    parameters.require_si("RealSense")
    entry = {}
    equation = []
    for name in ("accelerometer", "gyroscope"):
        triad = parameters.triads.get(name)
        matrix, bias = (np.eye(3), np.zeros(3)) if triad is None else (triad.inverse, triad.inverse @ triad.bias)
        entry[name] = {"scale_and_alignment": matrix.T.ravel().tolist(), "bias": bias.tolist()}
        equation.append(f"{name}: u = M y - b\nM = {exact_text(matrix)}\nb = {exact_text(bias)}")
    text = json.dumps({"device_type": "D435i", "imus": [entry]}, indent=4, sort_keys=True)
    return Written(
        {"": (text + "\n").encode()},
        "inverse: u = M y - b, the bias subtracted after M and in SI units; scale_and_alignment holds M column by "
        "column. The camera itself keeps single precision: 6e-8 of a value. Log with enable_motion_correction off.",
        "\n".join(equation),
        parameters.corrections(),
    )
