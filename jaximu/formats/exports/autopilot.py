"""What the autopilots' parameters have in common: offsets, the accelerometer's scale, a magnetometer's matrix."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

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


def signed_axes(triad: Linear) -> np.ndarray:
    """(3, 3) the signed permutation P that is nearest to the direction of the axes: a field u is seen as about Pᵀu."""
    share = (triad.gain / np.linalg.norm(triad.gain, axis=1, keepdims=True)).T
    rows, columns = scipy.optimize.linear_sum_assignment(-np.abs(share))
    axes = np.zeros((3, 3))
    axes[rows, columns] = np.sign(share[rows, columns])
    return axes


def symmetric_matrix(triad: Linear, axes: np.ndarray) -> np.ndarray:
    """(3, 3) the symmetric S with the least mean square error of S K u against axesᵀ u, u in every direction alike.

    Its normal equation is S A + A S = axesᵀ Kᵀ + K axes with A = K Kᵀ.
    """
    known = triad.gain @ axes
    found = scipy.linalg.solve_continuous_lyapunov(triad.gain @ triad.gain.T, known + known.T)
    return 0.5 * (found + found.T)


@dataclass(frozen=True)
class Compass:
    """A magnetometer in an autopilot's terms: h = S (y − offset) in its own axes, `axes` to be set as its rotation.

    offset (3,), in the autopilot's unit; diagonal (3,) and off-diagonal xy, xz, yz (3,) of S; words on the rotation.
    """

    offset: np.ndarray
    diagonal: np.ndarray
    off_diagonal: np.ndarray
    correction: Correction
    rotation: str

    @classmethod
    def of(cls, triad: Linear, unit: float, rotation: str) -> Compass:
        """Take the linear part of a magnetometer in µT; unit: the autopilot's to a µT, rotation: its parameter."""
        axes = signed_axes(triad)
        matrix = symmetric_matrix(triad, axes)
        words = ""
        if not np.array_equal(axes, np.eye(3)):
            names = [("+" if sum(column) > 0 else "-") + "xyz"[int(np.flatnonzero(column)[0])] for column in axes.T]
            words = f" The magnetometer's x, y, z lie along {', '.join(names)} of the unit: set {rotation} to say so."
        places = matrix[[0, 0, 1], [1, 2, 2]]
        correction = Correction(matrix, triad.bias, frame=axes.T)
        return cls(unit * triad.bias, np.diag(matrix), places, correction, words)


def diagonal(parameters: Parameters, accel: str, gyro: str, offset: str, scale: str) -> Diagonal:
    """Offsets and scales under the names `accel` and `gyro`, patterns of {word} (`offset` or `scale`) and {axis}."""
    if "accelerometer" not in parameters.triads:
        return Diagonal([], "", {})
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
