"""What the autopilots' parameters have in common: per axis an offset, and of the accelerometer a scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaximu.formats.exports.base import Correction, Linear, Parameters, vector_text


@dataclass(frozen=True)
class Diagonal:
    """The named values, the equation that applies them and what is left of the correction.

    accelerometer: u = (y − offset) ∘ scale; gyroscope: u = y − offset.
    """

    values: list[tuple[str, float]]
    equation: str
    corrections: dict[str, Correction]


def diagonal_scale(triad: Linear) -> np.ndarray:
    """(3,) the scale s that leaves the least mean square error of s ∘ K u against u, u in every direction alike."""
    return np.diag(triad.gain) / np.sum(triad.gain**2, axis=1)


def diagonal(parameters: Parameters, accel: str, gyro: str, offset: str, scale: str) -> Diagonal:
    """Offsets and scales under the names `accel` and `gyro`, patterns of {word} (`offset` or `scale`) and {axis}."""
    accelerometer, gyroscope = parameters.accelerometer, parameters.gyroscope
    factors = diagonal_scale(accelerometer)

    def named(pattern: str, word: str, values: np.ndarray) -> list[tuple[str, float]]:
        return [(pattern.format(word=word, axis=axis), float(each)) for axis, each in zip("XYZ", values, strict=True)]

    values = named(accel, offset, accelerometer.bias) + named(accel, scale, factors)
    equation = f"a = (y - {offset}) * {scale}, axis by axis\n{offset} = {vector_text(accelerometer.bias)}"
    equation += f"\n{scale} = {vector_text(factors)}"
    corrections = {"accelerometer": Correction(np.diag(factors), accelerometer.bias)}
    if gyroscope is not None:
        values += named(gyro, offset, gyroscope.bias)
        equation += f"\nw = y - {offset}\n{offset} = {vector_text(gyroscope.bias)}"
        corrections["gyroscope"] = Correction(np.eye(3), gyroscope.bias)
    return Diagonal(values, equation, corrections)
