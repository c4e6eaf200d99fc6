"""`data.spikes`: single samples, or a few, far from what their neighbours say."""

from __future__ import annotations

import numpy as np

from jaximu.mistakes.base import BRIDGED, Finding, FloatArray, Rows, Samples, Sensor, plural, runs_of

__all__ = ["find"]

_TIMES = 10.0
"""Standard deviations, of the cubic's local misfit, from which a sample is no measurement."""
_BRIEF = 0.04
"""Seconds within which hands turn nothing to and fro."""
_MOST = 3000
"""Places that are looked at: beyond, the signal is not spiked but broken."""


def find(samples: Samples) -> list[Finding]:
    """Return the samples that stand out from both sides."""
    found = []
    for name, sensor in samples.sensors.items():
        rows = _outliers(sensor)
        if not len(rows):
            continue
        size = np.max(np.abs(sensor.curvature[rows]))
        found.append(Finding(
            "data.spikes", sensor.rows(rows),
            f"{name}: {plural(len(rows), 'outlier')} of up to {size:.3g} {sensor.unit} against the neighbours, first "
            f"after {sensor.at(int(rows[0]))}: knocks, or errors of transfer. They are left out; up to "
            f"{BRIDGED} in a row are bridged by interpolation.", without={name: rows},
        ))  # fmt: skip
    return found


def _outliers(sensor: Sensor) -> Rows:
    if len(sensor) < 64:
        return np.zeros(0, np.int64)
    scale = np.maximum(sensor.local, 1.4 * sensor.noise + 0.5 * sensor.step)
    scale = np.maximum(scale, 1e-9 * np.ptp(sensor.values, axis=0))
    ratio = np.max(np.abs(sensor.curvature) / np.maximum(scale, 1e-300), axis=1)
    flagged = ratio > _TIMES
    if not flagged.any():
        return np.zeros(0, np.int64)
    flagged[1:-1] |= flagged[:-2] & flagged[2:]
    clusters = runs_of(flagged)
    if len(clusters) > _MOST:
        return np.zeros(0, np.int64)
    found: list[int] = []
    for start, stop in clusters:
        if stop - start <= 2 * BRIDGED + 3:
            found += _shortest(sensor.values, scale, int(start), int(stop), sensor.rate)
    return np.unique(np.array(found, np.int64))


def _shortest(values: FloatArray, scale: FloatArray, start: int, stop: int, rate: float) -> list[int]:
    """The fewest samples in a row without which the others lie on a smooth curve; none where there are none such."""
    best: tuple[float, list[int]] | None = None
    for length in range(1, BRIDGED + 1):
        # what takes longer may be the motion's own
        times = 3 + 2 * length if length <= _BRIEF * rate else 20
        for first in range(start, stop - length + 1):
            last = first + length - 1
            if first < 5 or last + 5 >= len(values):
                continue
            around = np.concatenate([np.arange(first - 5, first), np.arange(last + 1, last + 6)])
            place = (around - (first + last) / 2) / 5
            matrix = np.vander(place, 4)
            # a cubic through five on either side, which the samples at fault must miss and the others must not
            coefficients, *_ = np.linalg.lstsq(matrix, values[around], rcond=None)
            left = np.abs(values[around] - matrix @ coefficients) / scale[first]
            inside = np.vander((np.arange(first, last + 1) - (first + last) / 2) / 5, 4) @ coefficients
            off = np.max(np.abs(values[first : last + 1] - inside) / scale[first], axis=1)
            worst = float(np.max(left))
            if np.min(off) > max(_TIMES, times * worst) and (best is None or worst < best[0]):
                best = worst, list(range(first, last + 1))
        if best is not None:
            return best[1]
    return []
