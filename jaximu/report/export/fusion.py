"""A C header with the constants of x-io's Fusion: what its calibration functions take.

`FusionCalibrationInertial` (newer: `FusionModelInertial`) makes M s (y − b) of an output, s a diagonal matrix, in the
units in which Fusion is fed, g and degrees per second; `FusionCalibrationMagnetic` (`FusionModelMagnetic`) makes
S (y − b), in µT (x-io Technologies, Fusion, FusionCalibration.h). K⁻¹ = M s with a unit diagonal of M.
"""

from __future__ import annotations

import math

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.report.export.base import Correction, ExportedUnit, Written, comments, exact_text, text_file

SUFFIX = ".h"
SUMMARY = "x-io Fusion: misalignment, sensitivity, offset; soft and hard iron"
MAGNETIC = True
_FED = {"accelerometer": ("g", 1 / STANDARD_GRAVITY), "gyroscope": ("deg/s", 180 / math.pi)}


def write(parameters: ExportedUnit) -> Written:
    """Write a constant for each argument, named as Fusion names it."""
    parameters.require_own_axes()
    lines = [comments(parameters, "//"), "#pragma once", '#include "Fusion.h"', ""]
    equation = []
    made = {}
    for name, triad in parameters.triads.items():
        inverse = triad.inverse
        offset = triad.bias
        unit, factor = _FED.get(name, ("uT", 1.0))
        lines.append(f"// {name}: y in {triad.unit}, the answer in {unit}")
        if name in _FED:
            sensitivity = np.diagonal(inverse) * factor
            misalignment = inverse * factor / sensitivity
            lines += [
                _matrix(f"{name}Misalignment", misalignment),
                _vector(f"{name}Sensitivity", sensitivity),
                _vector(f"{name}Offset", offset),
                "",
            ]
            equation.append(
                f"{name}: u [{unit}] = M s (y - b), y in {triad.unit}\nM = {exact_text(misalignment)}\n"
                f"s = diag {exact_text(sensitivity)}\nb = {exact_text(offset)}"
            )
            made[name] = Correction(misalignment * sensitivity / factor, offset)
        else:
            lines += [_matrix("softIronMatrix", inverse), _vector("hardIronOffset", offset), ""]
            equation.append(
                f"{name}: h [uT] = S (y - b), y in {triad.unit}\nS = {exact_text(inverse)}\nb = {exact_text(offset)}"
            )
            made[name] = Correction(inverse, offset)
    return Written(
        text_file(lines),
        "inverse: u = M s (y - b), M with a unit diagonal, s diagonal, in g and deg/s as Fusion is fed; h = S (y - b) "
        "in uT. FusionAxesSwap, where it is used, comes after.",
        "\n".join(equation),
        made,
    )


def _vector(name: str, values: FloatArray) -> str:
    return f"static const FusionVector {name} = {{{_braces(values)}}};"


def _matrix(name: str, values: FloatArray) -> str:
    return f"static const FusionMatrix {name} = {{{{{', '.join(map(_braces, values))}}}}};"


def _braces(values: FloatArray) -> str:
    return "{" + ", ".join(f"{float(value)!r}f" for value in values) + "}"
