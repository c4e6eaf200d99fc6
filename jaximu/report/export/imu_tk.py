"""imu_tk's `.calib` files, one for each triad: three rows of the misalignment, of the scale, and the bias.

u = T K' (y − b), as `CalibratedTriad::unbiasNormalize` applies what `CalibratedTriad::load` reads (imu_tk,
include/imu_tk/calibration.h); it subtracts its bias, unlike the paper it implements.
"""

from __future__ import annotations

import numpy as np

from jaximu.model.conventions import ImuTk
from jaximu.report.export.base import ExportedUnit, Written, exact_text

SUFFIX = ".calib"
SUMMARY = "imu_tk: one .calib a triad (…_acc, …_gyro)"


def write(parameters: ExportedUnit) -> Written:
    """Write the accelerometer's and the gyroscope's file; no comments, which imu_tk could not read."""
    parameters.require_own_axes()
    files = {}
    equation = []
    for name, ending in (("accelerometer", "_acc"), ("gyroscope", "_gyro")):
        triad = parameters.triads.get(name)
        if triad is None:
            continue
        view = ImuTk.from_gain(triad.gain, triad.bias)
        misalignment, scale, bias = map(np.asarray, (view.misalignment, view.scale, view.bias))
        parts = (misalignment, np.diag(scale), bias[:, None])
        text = "\n\n".join("\n".join(" ".join(repr(float(cell)) for cell in row) for row in part) for part in parts)
        files[ending] = (text + "\n\n").encode()
        equation.append(
            f"{name}: u = T K (y - b)\nT = {exact_text(misalignment)}\nK = diag {exact_text(scale)}"
            f"\nb = {exact_text(bias)}"
        )
    return Written(
        files,
        "inverse: u = T K (y - b), T with a unit diagonal, K diagonal in SI units per output unit, b in output units. "
        "The body frame is the calibration's, so T is a full matrix where imu_tk's own accelerometer has an "
        "upper-triangular one.",
        "\n".join(equation),
        parameters.corrections(),
    )
