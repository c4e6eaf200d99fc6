"""How the gyroscope explains what the accelerometer sees turn: axes, signs, scales and clocks of the two against each other.

While a unit is turned by hand the specific force is mostly gravity, which turns in the body against the unit's rotation:
Δf = f × M Δθ over a short time, Δθ the angle that the gyroscope reads and M Δθ the true one. That is linear in M, which
is the identity for right axes, signs and scales.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Turning", "time_offset", "turning"]

FloatArray = NDArray[np.float64]
_BLOCK = 0.2
"""Seconds over which the specific force is averaged."""
_MOVED = 0.03
"""Share of gravity by which the magnitude may be off before a block counts for less: the unit is accelerated."""
_FAR = 0.3
"""rad between blocks beyond which they count for less: the equation is one of small angles."""
_FEWEST = 20
_LAGS = np.arange(-1.5, 1.55, 0.05)  # s
_PARTS = 12
"""Parts of a recording from whose scatter the uncertainty of a time offset is taken."""


class Turning(NamedTuple):
    """matrix (3, 3): M, and sigma (3, 3) the standard deviation of each entry. explained: share of the force's turning.

    slope: of M = slope · 1, and correlation: of the force's turning with the gyroscope's, for such an M.
    """

    matrix: FloatArray
    sigma: FloatArray
    explained: float
    slope: float
    correlation: float


class _Blocks(NamedTuple):
    centre: FloatArray  # (n + 1,)
    force: FloatArray  # (n, 3), between neighbours
    change: FloatArray  # (n, 3)
    weight: FloatArray  # (n,)
    time: FloatArray
    angle: FloatArray  # (m, 3), the integrated rate at `time`


def _blocks(force_time: FloatArray, force: FloatArray, rate_time: FloatArray, rate: FloatArray) -> _Blocks | None:
    span = max(1, round(_BLOCK / float(np.median(np.diff(force_time)))))
    count = len(force) // span
    if count < _FEWEST or len(rate) < 2:
        return None
    mean = force[: count * span].reshape(count, span, 3).mean(axis=1)
    centre = force_time[: count * span].reshape(count, span).mean(axis=1)
    rate = rate - np.median(rate, axis=0)
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(rate_time)[:, None]
    angle = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    length = np.linalg.norm(mean, axis=1)
    usual = float(np.median(length))
    off = np.abs(length - usual) / max(usual, 1e-300)
    off = np.maximum(off[1:], off[:-1])
    change = np.diff(mean, axis=0)
    # by the accelerometer: what the gyroscope says may be wrong by any factor
    far = np.linalg.norm(change, axis=1) / max(usual, 1e-300)
    weight = 1 / np.sqrt((1 + (off / _MOVED) ** 2) * (1 + (far / _FAR) ** 2))
    return _Blocks(centre, (mean[1:] + mean[:-1]) / 2, change, weight, rate_time, angle)


def _turned(blocks: _Blocks, lag: float) -> FloatArray:
    """The angle (n, 3) that the gyroscope reads between the blocks' centres, its stamps `lag` (s) too late."""
    at = blocks.centre + lag
    return np.diff(np.stack([np.interp(at, blocks.time, each) for each in blocks.angle.T], axis=1), axis=0)


_CROSS = np.zeros((3, 3, 3))
_CROSS[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0
_CROSS[[0, 2, 1], [2, 1, 0], [1, 0, 2]] = -1.0


def turning(force_time: FloatArray, force: FloatArray, rate_time: FloatArray, rate: FloatArray) -> Turning:
    """Fit how the rate (m, 3) explains the turning of the specific force (n, 3), in whatever units they are.

    A recording that hardly turns has the identity, infinite `sigma` and nothing explained.
    """
    blocks = _blocks(force_time, force, rate_time, rate)
    nothing = Turning(np.eye(3), np.full((3, 3), np.inf), 0.0, 1.0, 0.0)
    if blocks is None:
        return nothing
    turned, weight = _turned(blocks, 0.0), blocks.weight[:, None]
    seen = (weight * blocks.change).ravel()
    columns = _columns(blocks, turned)
    alike = columns @ np.eye(3).ravel()
    power, product = float(alike @ alike), float(alike @ seen)
    total = float(seen @ seen)
    if power == 0.0 or total == 0.0:
        return nothing
    normal = columns.T @ columns
    values, vectors = np.linalg.eigh(normal)
    kept = values > 1e-6 * values[-1]
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    matrix = inverse @ (columns.T @ seen)
    left = float(np.sum((seen - columns @ matrix) ** 2))
    variance = np.where(kept.all(), np.diag(inverse), np.inf) * left / max(len(seen) - 9, 1)
    return Turning(
        matrix.reshape(3, 3), np.sqrt(variance).reshape(3, 3), 1 - left / total, product / power,
        product / float(np.sqrt(power * total)),
    )  # fmt: skip


def _columns(blocks: _Blocks, turned: FloatArray) -> FloatArray:
    """The derivatives (3 n, 9) of the weighted f × M Δθ by the entries of M."""
    whole = np.einsum("n,ijk,nj,nl->nikl", blocks.weight, _CROSS, blocks.force, turned)
    return whole.reshape(-1, 9)


def time_offset(
    force_time: FloatArray, force: FloatArray, rate_time: FloatArray, rate: FloatArray
) -> tuple[float, float, float]:
    """Estimate by how much (s) the gyroscope's stamps are late against the accelerometer's, with its standard deviation.

    **Returns:** offset, standard deviation, and how much of the force's turning is explained at the offset. The
    deviation is taken from the scatter over parts of the recording.
    """
    blocks = _blocks(force_time, force, rate_time, rate)
    if blocks is None:
        return 0.0, np.inf, 0.0

    def left(lag: float, part: slice = slice(None), matrix: FloatArray | None = None) -> float:
        columns = _columns(blocks, _turned(blocks, lag)).reshape(-1, 3, 9)[part].reshape(-1, 9)
        seen = (blocks.weight[:, None] * blocks.change)[part].ravel()
        if matrix is None:
            matrix = np.linalg.lstsq(columns, seen, rcond=1e-6)[0]
        return float(np.sum((seen - columns @ matrix) ** 2))

    def lowest(lag: float, step: float, **given) -> tuple[float, float]:
        lags = lag + step * np.arange(-3, 4)
        values = [left(each, **given) for each in lags]
        k = int(np.clip(np.argmin(values), 1, 5))
        low, middle, high = values[k - 1 : k + 2]
        bend = low - 2 * middle + high
        shift = float(np.clip((low - high) / (2 * bend), -1, 1)) if bend > 0 else 0.0
        return float(lags[k] + shift * step), bend / step**2

    lag = float(_LAGS[int(np.argmin([left(each) for each in _LAGS]))])
    for step in (0.02, 0.005):
        lag, _ = lowest(lag, step)
    columns = _columns(blocks, _turned(blocks, lag))
    seen = (blocks.weight[:, None] * blocks.change).ravel()
    matrix = np.linalg.lstsq(columns, seen, rcond=1e-6)[0]
    edges = np.linspace(0, len(blocks.change), _PARTS + 1).astype(int)
    shifts, weights = [], []
    for first, stop in zip(edges[:-1], edges[1:], strict=True):
        place, bend = lowest(lag, 0.005, part=slice(first, stop), matrix=matrix)
        if bend > 0:
            shifts.append(place - lag)
            weights.append(bend)
    if len(shifts) < _PARTS // 2:
        return lag, np.inf, 0.0
    share = np.array(weights) / np.sum(weights)
    sigma = float(np.sqrt(np.sum(share**2 * np.square(shifts)) * len(shifts) / (len(shifts) - 1)))
    explained = 1 - float(np.sum((seen - columns @ matrix) ** 2)) / max(float(seen @ seen), 1e-300)
    return lag, max(sigma, 1e-4), explained
