"""What the autopilots' parameters have in common: offsets, the accelerometer's scale, a magnetometer's matrix."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from jaximu.report.export.base import Correction, ExportedUnit, LinearTriad, matrix_text, vector_text


@dataclass(frozen=True)
class Autopilot:
    """How an autopilot names its parameters.

    patterns: by triad, of {word} and {axis}. offset, scale: the words. matrix: those of the magnetometer's offset, and
    of the diagonal and the rest (xy, xz, yz) of its matrix. rotation: the parameter that turns the magnetometer.
    unit: the name of its unit and how many are a µT. rotated: whether offset and matrix come after the rotation, and
    the offset is then added.
    """

    patterns: Mapping[str, str]
    offset: str
    scale: str
    matrix: tuple[str, str, str]
    rotation: str
    unit: tuple[str, float]
    rotated: bool

    def values(self, parameters: ExportedUnit) -> tuple[list[tuple[str, float]], str, dict[str, Correction], str]:
        """The named values, the equation that applies them, what is left of the correction, and words on the rotation.

        accelerometer: u = (y − offset) ∘ scale; gyroscope: u = y − offset; magnetometer: h = S (y − offset).
        """
        values, equation, corrections, words = [], [], {}, ""
        for name, triad in parameters.triads.items():
            if name == "magnetometer":
                axes = signed_axes(triad)
                matrix, shift = symmetric_matrix(triad, axes), self.unit[1] * triad.bias
                corrections[name] = Correction(matrix, triad.bias, frame=axes.T)
                if self.rotated:
                    matrix, shift = axes @ matrix @ axes.T, -axes @ shift
                parts = (shift, np.diag(matrix), matrix[[0, 0, 1], [1, 2, 2]])
                written = dict(zip(self.matrix, parts, strict=True))
                word, sign = self.matrix[0], "+" if self.rotated else "-"
                equation += [f"h [{self.unit[0]}] = S (y {sign} {word}), S = {matrix_text(matrix)}"]
                equation += [f"{word} = {vector_text(shift)}"]
                if not np.array_equal(axes, np.eye(3)):
                    along = ["+-"[int(sum(column) < 0)] + "xyz"[int(np.flatnonzero(column)[0])] for column in axes.T]
                    words = (
                        f" The magnetometer's x, y, z lie along {', '.join(along)} of the unit: set {self.rotation} to "
                        "say so."
                    )
            elif name == "accelerometer":
                written = {self.offset: triad.bias, self.scale: diagonal_scale(triad)}
                corrections[name] = Correction(np.diag(written[self.scale]), triad.bias)
                equation += [f"a = (y - {self.offset}) * {self.scale}, axis by axis"]
                equation += [f"{word} = {vector_text(part)}" for word, part in written.items()]
            else:
                written = {self.offset: triad.bias}
                corrections[name] = Correction(np.eye(3), triad.bias)
                equation += [f"w = y - {self.offset}", f"{self.offset} = {vector_text(triad.bias)}"]
            values += [
                (self.patterns[name].format(word=word, axis=axis), float(value))
                for word, part in written.items()
                for axis, value in zip("XYZ", part, strict=True)
            ]
        return values, "\n".join(equation), corrections, words


def diagonal_scale(triad: LinearTriad) -> np.ndarray:
    """(3,) the scale s that leaves the least mean square error of s ∘ K u against u, u in every direction alike."""
    return np.diag(triad.gain) / np.sum(triad.gain**2, axis=1)


def signed_axes(triad: LinearTriad) -> np.ndarray:
    """(3, 3) the signed permutation P that is nearest to the direction of the axes: a field u is seen as about Pᵀu."""
    share = (triad.gain / np.linalg.norm(triad.gain, axis=1, keepdims=True)).T
    rows, columns = scipy.optimize.linear_sum_assignment(-np.abs(share))
    axes = np.zeros((3, 3))
    axes[rows, columns] = np.sign(share[rows, columns])
    return axes


def symmetric_matrix(triad: LinearTriad, axes: np.ndarray) -> np.ndarray:
    """(3, 3) the symmetric S with the least mean square error of S K u against axesᵀ u, u in every direction alike.

    Its normal equation is S A + A S = axesᵀ Kᵀ + K axes with A = K Kᵀ.
    """
    known = triad.gain @ axes
    matrix = scipy.linalg.solve_continuous_lyapunov(triad.gain @ triad.gain.T, known + known.T)
    return 0.5 * (matrix + matrix.T)
