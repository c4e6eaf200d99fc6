"""Shapes without a cause, asked beside named effects: slow change, orientation, a pose that was bumped."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jaximu.diagnosis.evidence import EffectBlock
from jaximu.ground.array_types import FloatArray

__all__ = ["SIZES", "Shapes", "harmonics", "placed"]

SIZES = {"accelerometer": 0.01, "gyroscope": 1e-3}
"""Size of a shape, m/s² and rad/s."""


@dataclass(frozen=True)
class Shapes:
    """Shapes over the observations or samples (o,) of a recording.

    react: returns how the conditions (n, q) react to a shape of a triad's output, (o, k) alike for each axis.
    """

    react: Callable[[str, FloatArray], FloatArray]

    def block(self, triad: str, name: str, shape: FloatArray, **inner: float) -> EffectBlock:
        """Return the question for a shape; one with inner parameters stands at one of many places."""
        columns, size = self.react(triad, shape), SIZES[triad]
        return EffectBlock(name, columns * size, np.full(columns.shape[1], size), "generic", inner, bool(inner))

    def slow_changes(self, share: FloatArray) -> list[EffectBlock]:
        """Return waves of half a period and more over the recording, of which `share` (o,) has gone by."""
        waves = np.cos(np.pi * share[:, None] * np.arange(1, 6))
        return [self.block(triad, f"slow change of the {triad}", waves) for triad in SIZES]

    def orientations(self, up: FloatArray, at_rest: NDArray[np.bool_] | None = None) -> list[EffectBlock]:
        """Return harmonics of the direction up (o, 3); of the gyroscope those in observations at rest (o,) or all."""
        second, third = harmonics(up)
        words, shape = "the gyroscope depends on orientation", second
        if at_rest is not None:
            words = "the gyroscope at rest depends on orientation"
            shape = np.concatenate([up, second], axis=1) * at_rest[:, None]
        return [
            self.block("accelerometer", "the accelerometer depends on orientation (second harmonics)", second),
            self.block("accelerometer", "the accelerometer depends on orientation (third harmonics)", third),
            self.block("gyroscope", words, shape),
        ]

    def bumped(self, poses: NDArray[np.int64], among: NDArray[np.int64]) -> list[EffectBlock]:
        """Return each pose by itself, its force being off; among (o,): the observations' numbers."""
        blocks, size = [], SIZES["accelerometer"]
        for pose in poses:
            columns = size * self.react("accelerometer", np.equal(among, pose)[:, None].astype(float))
            blocks.append(EffectBlock("data.bumped_pose", columns, np.full(3, size), "data", {"pose": int(pose)}, True))
        return blocks


def placed(triad: str, shape: FloatArray, used: NDArray[np.bool_]) -> FloatArray:
    """Return the reaction (6 o, 3 k) of mean outputs, accelerometer and gyroscope of one observation after another.

    **Arguments:** `used` (o,): observations in which the triad counts.
    """
    first = 3 * list(SIZES).index(triad)
    columns = np.zeros((len(shape), 6, shape.shape[1], 3))
    for axis in range(3):
        columns[used, first + axis, :, axis] = shape[used]
    return columns.reshape(6 * len(shape), -1)


def harmonics(up: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Real spherical harmonics (n, 5) of degree two and (n, 7) of degree three, up to factors."""
    x, y, z = up.T
    second = [x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1]
    third = [
        y * (3 * x * x - y * y),
        x * y * z,
        y * (5 * z * z - 1),
        z * (5 * z * z - 3),
        x * (5 * z * z - 1),
        z * (x * x - y * y),
        x * (x * x - 3 * y * y),
    ]
    return np.stack(second, axis=1), np.stack(third, axis=1)
