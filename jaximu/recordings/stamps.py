"""Stamps and the samples missing between them: a stamp that is late makes no gap if the stamps after it are not."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import scipy

from jaximu.ground.array_types import FloatArray

GAP = 1.6
"""Times the usual interval from which on a longer one is a gap."""
UNEVEN = 0.1
"""Share of the usual interval that intervals scatter by where stamps jitter."""
_SPAN = 32
"""Samples over whose time the period is taken where stamps jitter."""
_BESIDE = 20
"""Samples before and after an interval whose lateness is compared where stamps jitter."""
_ROUNDS = 16
_BLOCK, _FEWEST_BLOCKS, _OTHER = 51, 3, 0.2
"""Intervals whose median is looked at (an odd number), blocks of them that a rate lasts, and the logarithm by which
another rate is off."""
_MOST_EVEN = 0.9  # share of the intervals that are about their median where a rate is kept


def stretches_of_one_rate(time: FloatArray) -> list[slice]:
    """The stretches of stamps (n,) between which a logger changes its rate and keeps it; all of any others."""
    whole, interval = [slice(0, len(time))], np.diff(time)
    blocks = len(interval) // _BLOCK
    usual = np.median(interval[: blocks * _BLOCK].reshape(blocks, _BLOCK), axis=1)
    if blocks < 2 * _FEWEST_BLOCKS or not (usual > 0).all():
        return whole
    edges = [0]
    for block in (np.flatnonzero(np.abs(np.diff(np.log(usual))) > _OTHER) + 1).tolist():
        around = interval[(block - 1) * _BLOCK : (block + 1) * _BLOCK]
        nearer = np.abs(around - usual[block - 1]) - np.abs(around - usual[block])  # to the rate after the change
        edges.append((block - 1) * _BLOCK + int(nearer.cumsum().argmin()) + 1)
    stretches = [slice(*pair) for pair in pairwise([*edges, len(time)])]
    for part in stretches:
        here = np.diff(time[part])
        if len(here) < _FEWEST_BLOCKS * _BLOCK or (np.abs(here / np.median(here) - 1) < _OTHER).mean() < _MOST_EVEN:
            return whole
    return stretches


def missing_samples(time: FloatArray) -> FloatArray:
    """(n − 1,) how many samples are missing in each interval between stamps (n,).

    Of even stamps a longer interval is a gap. Of stamps that jitter, or that a logger polled, it is one only where the
    stamps after it stay late by a sample or more: else the next intervals are as much shorter.
    """
    interval = np.diff(time)
    usual = np.median(interval)
    wide = interval > GAP * max(usual, np.minimum(interval, 3 * usual).mean())
    period = interval[~wide].mean()
    even = np.std(interval[~wide]) < UNEVEN * period and interval.min(initial=period) > (2 - GAP) * period
    if even or not wide.any():
        return np.where(wide, np.maximum(np.round(interval / period) - 1, 1.0), 0.0)
    count, span = len(time), min(_SPAN, len(interval))
    period = np.median(time[span:] - time[:-span]) / span
    after = np.arange(1, count)
    first, last = np.maximum(after - _BESIDE, 0), np.minimum(after + _BESIDE, count)
    missing = np.zeros(count - 1)
    for _ in range(_ROUNDS):
        number = np.arange(count) + np.cumulative_sum(missing, include_initial=True)
        total = np.cumulative_sum((time - time[0]) / period - number, include_initial=True)
        later = (total[last] - total[after]) / (last - after) - (total[after] - total[first]) / (after - first)
        change = np.where(wide, np.maximum(np.round(later), -missing), 0.0)
        # the interval after which lateness grows most explains those around it
        size = np.where(change != 0, np.abs(later), 0.0)
        rows = np.flatnonzero((size > 0) & (size == scipy.ndimage.maximum_filter1d(size, 2 * _BESIDE + 1)))
        if not len(rows):
            break
        rows = rows[np.diff(rows, prepend=-count) > _BESIDE]
        missing[rows] += change[rows]
    return missing
