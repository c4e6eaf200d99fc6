"""`data.knock`: a unit that lay still was knocked, or moved, for a moment."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaximu.ground.distributions import robust_sigma
from jaximu.mistakes.base import Samples, Sensor
from jaximu.recordings.finding import Finding
from jaximu.recordings.recording import runs_of

TITLES = {"data.knock": "knocked at rest"}

_TIMES = 5.5
"""Times the usual scatter of a quarter second that noise never reaches: thirty times its variance."""
_STANDS_OUT = 8.0
"""Standard deviations, of the logarithm of the scatter, that a knock stands out by."""
_AROUND = 1.0
"""Seconds before and after a knock in which a unit may still swing."""
_MOST = 0.05
"""Share of a recording beyond which the unit was not at rest."""


def find(samples: Samples) -> Iterator[Finding]:
    """Return the stretches in which a unit that rests else was knocked: no part of its noise."""
    if not samples.rested:
        return
    spans = np.concatenate([_knocks(sensor) for sensor in samples.sensors.values()])
    if not len(spans):
        return
    without = {}
    for name, sensor in samples.sensors.items():
        edges = np.searchsorted(sensor.time, spans + [-_AROUND, _AROUND])
        marked = np.zeros(len(sensor) + 1, np.int64)
        np.add.at(marked, edges[:, 0], 1)
        np.add.at(marked, edges[:, 1], -1)
        without[name] = np.flatnonzero(np.cumsum(marked)[:-1] > 0)
    if any(len(rows) > _MOST * len(samples.sensors[name]) for name, rows in without.items()):
        return
    first = samples.first
    rows = without[first.name]
    starts = rows[np.concatenate([[True], np.diff(rows) > 1])]
    yield Finding(
        "data.knock",
        first.rows(starts),
        f"The unit rests, but was knocked{'' if len(starts) == 1 else f' {len(starts)} times'}, first about "
        f"{spans[:, 0].min():.1f} s in: {len(rows) / first.rate:.3g} s are left out.",
        without=without,
    )


def _knocks(sensor: Sensor) -> np.ndarray:
    """Return start and stop (k, 2), s, of the quarter seconds in which most samples are far off their middle."""
    first, size = sensor.blocks[0], sensor.block_size
    parts = sensor.values[: len(first) * size].reshape(len(first), size, 3)
    scatter = np.median(np.abs(parts - np.median(parts, axis=1, keepdims=True)), axis=1)
    excess = np.log(np.maximum(scatter, np.maximum(sensor.step, 1e-300) / 2))
    excess -= np.median(excess, axis=0)
    spread = robust_sigma(excess, axis=0)  # of filtered noise it is larger than of white
    runs = runs_of(np.any(excess > np.maximum(np.log(_TIMES), _STANDS_OUT * spread), axis=1))
    stop = np.minimum(runs[:, 1] * size, len(sensor) - 1)
    return np.stack([sensor.time[first[runs[:, 0]]], sensor.time[stop]], axis=1)
