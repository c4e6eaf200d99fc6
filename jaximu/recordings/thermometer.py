"""The course of a temperature behind a thermometer's steps, holds and noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import scipy

from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.ground.distributions import robust_sigma
from jaximu.recordings.recording import Signal

_CELLS = 1000
"""Parts of a recording over which readings are averaged first: finer than a thermal fit's blocks."""
_COARSE = 1e-3
"""Share of its range that a thermometer may be off in such a part: then no coefficient is off by more than 1 %."""
_SOAK = 4
"""Times the usual stay at a reading beyond which the temperature stands still: then it is more than one reading."""
_FEWEST = 10  # readings that a spline goes through
_WIDTHS = np.geomspace(1e-3, 0.3, 25)
"""Shares of a recording that are tried as the width over which the spline is smooth."""


def course(signal: Signal) -> Signal:
    """Return a temperature (n, 1) as a smoothing spline through its readings, or as it is where these are fine.

    A model over temperature takes steps and noise for a lag or a rate. Equal readings are one, in the middle of their
    rows where the temperature crosses steps, and at their first row where a logger holds each reading.
    """
    time, celsius = signal.time, signal.values[:, 0]
    stays = _Stays(celsius)
    if len(stays.first) < _FEWEST or not np.isfinite(celsius).all():
        return signal
    long, size = stays.rows > max(1, len(time) / _CELLS), float(np.mean(stays.jumps**2))
    share = float(np.sum(stays.rows[long])) / len(time)
    noise = robust_sigma(np.diff(_cells(time, celsius, np.ones(len(time), int))[1], 3)) / np.sqrt(20)
    if np.hypot(noise, np.sqrt(share * size / 12)) < _COARSE * np.ptp(celsius):
        return signal
    if share > 0.5:  # it stays at readings, and may flicker between two as it crosses over
        celsius = scipy.ndimage.median_filter(celsius, 2 * (len(time) // _CELLS) + 1)
        stays = _Stays(celsius)
        long = stays.rows > max(1, len(time) / _CELLS)
    soak = _SOAK * int(np.median(stays.rows[long])) if long.any() else len(time)
    begin = np.flatnonzero((np.arange(len(time)) - np.repeat(stays.first, stays.rows)) % soak == 0)
    count, half = np.diff(begin, append=len(time)), np.min(stays.jumps, initial=np.inf) / 2
    stepped = np.median(stays.jumps) < 3 * half
    at = (time[begin] + time[begin + count - 1]) / 2 if stepped else time[begin]
    at, readings, weights = _cells(at, celsius[begin], count)
    if len(at) < _FEWEST:
        return signal
    smooth = _spline(at, readings, weights)(time)
    if stepped:  # while a reading stays, the temperature is at most half a step off it
        smooth = np.where(np.repeat(long, stays.rows), np.clip(smooth, celsius - half, celsius + half), smooth)
    return replace(signal, values=smooth)


class _Stays:
    """The runs of equal readings (n,): first row and number of rows of each (k,), and jumps (k - 1,) between them."""

    def __init__(self, readings: FloatArray) -> None:
        self.first = np.flatnonzero(np.diff(readings, prepend=np.nan))
        self.rows = np.diff(self.first, append=len(readings))
        self.jumps = np.abs(np.diff(readings[self.first]))


def _cells(time: FloatArray, values: FloatArray, count: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the mean time and value of each part that has readings, which stand for so many rows, and its rows."""
    _, cell = np.unique(np.floor((time - time[0]) / np.ptp(time) * _CELLS), return_inverse=True)
    rows = np.asarray(np.bincount(cell, count), np.float64)
    return np.bincount(cell, count * time) / rows, np.bincount(cell, count * values) / rows, rows


def _spline(time: FloatArray, readings: FloatArray, weights: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return the smoothing spline through readings (k,) of the width that predicts every other one best."""
    size, weights = float(np.ptp(time)), weights / np.mean(weights)

    def spline(rows: slice, width: float) -> Callable[[FloatArray], FloatArray]:
        stiffness = len(time[rows]) * width**4 * size**3
        return scipy.interpolate.make_smoothing_spline(time[rows], readings[rows], weights[rows], stiffness)

    def missed(width: float) -> float:
        parts = [(slice(k, None, 2), slice(1 - k, None, 2)) for k in (0, 1)]
        return sum(float(weights[out] @ (spline(used, width)(time[out]) - readings[out]) ** 2) for used, out in parts)

    return spline(slice(None), min(_WIDTHS, key=missed))
