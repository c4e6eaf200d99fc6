"""Shapes without a cause, asked beside named effects: slow change, orientation, a pose that was bumped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaximu.diagnosis.evidence import EffectBlock
from jaximu.estimation.data import Observed
from jaximu.ground.array_types import FloatArray

_SIZES = {"accelerometer": 0.01, "gyroscope": 1e-3}
"""Size of a shape, m/s² and rad/s."""
_CYCLES = 2.0, 20.0
"""Periods in a recording, between which a swing of the bias is asked for; half a period apart, none is missed."""


def shapes_without_cause(observed: Observed) -> list[EffectBlock]:
    """Return shapes without a cause and defects of single observations, not whitened.

    Waves of half a period and more over each recording; harmonics of the direction up, of the gyroscope in observations
    at rest or in all; swings to and fro; smooth functions of temperature; each observation by itself, its force being
    off.
    """
    waves = np.cos(np.pi * observed.share[:, None] * np.arange(1, 6))
    if observed.recording is not None:
        alone = np.equal(observed.recording[:, None], np.unique(observed.recording))
        waves = (waves[:, :, None] * alone[:, None]).reshape(len(waves), -1)
    slow = [_block(observed, triad, f"slow change of the {triad}", waves) for triad in _SIZES]
    blocks = [replace(block, curved="time") for block in slow]
    if observed.up is not None:
        blocks += _orientations(observed, observed.up)
    if observed.duration is not None:
        for cycles in np.arange(_CYCLES[0], min(_CYCLES[1], len(observed.share) / 2), 0.5):
            phase, period = 2 * np.pi * cycles * observed.share, observed.duration / cycles
            wave = np.stack([np.cos(phase), np.sin(phase)], axis=1)
            blocks += [
                _block(observed, triad, f"the {triad}'s bias swings to and fro", wave, period=period)
                for triad in _SIZES
            ]
    if observed.curves is not None:
        blocks += [
            _block(observed, triad, f"the {triad} depends smoothly on temperature", observed.curves) for triad in _SIZES
        ]
    if observed.alone is not None and observed.number is not None:
        size = _SIZES["accelerometer"]
        for number in observed.alone:
            columns = observed.react("accelerometer", np.equal(observed.number, number)[:, None].astype(float))
            blocks.append(
                EffectBlock("data.bumped_pose", size * columns, np.full(3, size), "data", {"pose": int(number)}, True)
            )
    return blocks


def _block(observed: Observed, triad: str, name: str, shape: FloatArray, **inner: float) -> EffectBlock:
    """Return the question for a shape; one with inner parameters stands at one of many places."""
    columns, size = observed.react(triad, shape), _SIZES[triad]
    return EffectBlock(name, columns * size, np.full(columns.shape[1], size), "generic", inner, bool(inner))


def _orientations(observed: Observed, up: FloatArray) -> list[EffectBlock]:
    second, third = harmonics(up)
    words, shape = "the gyroscope depends on orientation", second
    if observed.still is not None:
        words = "the gyroscope at rest depends on orientation"
        shape = np.concatenate([up, second], axis=1) * observed.still[:, None]
    return [
        _block(observed, "accelerometer", "the accelerometer depends on orientation (second harmonics)", second),
        _block(observed, "accelerometer", "the accelerometer depends on orientation (third harmonics)", third),
        _block(observed, "gyroscope", words, shape),
    ]


def imitated_shapes(observed: Observed) -> list[EffectBlock]:
    """Return shapes that named causes may be taken for, asked of what these leave; of carried attitudes alone.

    Higher harmonics, a heading, curves of an axis's own force.
    """
    if observed.attitude is None or observed.up is None:
        return []
    curves = np.asarray(np.polynomial.legendre.legvander(observed.up, 7)[..., 4:], np.float64)
    return [
        _block(observed, "gyroscope", "the gyroscope at rest depends on its heading", observed.attitude),
        _block(
            observed,
            "gyroscope",
            "the gyroscope at rest depends on orientation (third harmonics)",
            harmonics(observed.up)[1],
        ),
        _block(observed, "accelerometer", "the accelerometer's axes are curved (even powers)", curves[..., ::2]),
        _block(observed, "accelerometer", "the accelerometer's axes are curved (odd powers)", curves[..., 1::2]),
    ]


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
