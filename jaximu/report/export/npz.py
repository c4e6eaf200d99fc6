"""Gains, biases, their inverse and the whole covariance as NumPy arrays, readable with `allow_pickle=False`."""

from __future__ import annotations

import io

import numpy as np

from jaximu.report.export.base import ExportedUnit, Written

SUFFIX = ".npz"
MAGNETIC = True
SUMMARY = "NumPy arrays, with the covariance"


def write(parameters: ExportedUnit) -> Written:
    """Write `<triad>_gain`, `_bias`, `_inverse_gain`, `_unit`, and `covariance` with its `parameters` (body axes)."""
    arrays = {}
    for name, triad in parameters.triads.items():
        arrays |= {f"{name}_gain": triad.gain, f"{name}_bias": triad.bias, f"{name}_inverse_gain": triad.inverse}
        arrays[f"{name}_unit"] = np.array(triad.unit)
    calibration = parameters.calibration
    arrays |= {"covariance": calibration.covariance, "parameters": np.array(calibration.names)}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # pyright: ignore[reportArgumentType]
    return Written(
        {"": buffer.getvalue()},
        "forward: y = gain u + bias, so u = inverse_gain (y - bias); covariance in the order of parameters.",
        parameters.equation("inverse_gain"),
        parameters.corrections(),
        uncertainty=True,
    )
