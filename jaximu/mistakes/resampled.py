"""`data.resampled`: a log that was interpolated, or held, from a lower rate."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaximu.ground.distributions import rms
from jaximu.mistakes.base import Samples, Sensor
from jaximu.recordings.finding import Finding, Rows

TITLES = {"data.resampled": "resampled output"}


def find(samples: Samples) -> Iterator[Finding]:
    """Return the sensors whose real rate is lower than the log's."""
    for name, sensor in samples.sensors.items():
        if len(sensor) < 200:
            continue
        kept, how = held_at(sensor), "holds each sample until the next one comes"
        if kept is None:
            kept, how = interpolated_at(sensor), "draws straight lines between samples"
        if kept is None:
            continue
        real = (len(kept) - 1) / (sensor.time[kept[-1]] - sensor.time[kept[0]])
        rows = np.setdiff1d(np.arange(len(sensor)), kept)
        yield Finding(
            "data.resampled",
            sensor.rows(rows),
            f"{name}: the log has {sensor.rate:.4g} Hz but {how}: the sensor's real rate is {real:.4g} Hz. The "
            "rows in between are no measurements and are left out; log at the sensor's rate, and choose one of "
            "50 Hz or more.",
            without={name: rows},
        )


def held_at(sensor: Sensor) -> Rows | None:
    """Return the rows at which new values come, where the log holds them for an even number of rows."""
    change = (sensor.difference != 0).any(axis=1)
    if not 0.005 < change.mean() < 0.7 or change.sum() < 50:
        return None
    new = np.concatenate([[0], np.flatnonzero(change) + 1])
    gaps = np.diff(new)
    if np.median(gaps) < 2:
        return None
    return new if _alike(gaps) > 0.85 else None


def _alike(gaps: Rows) -> float:
    """The share of numbers of rows that are the usual one: of rates without a whole ratio two neighbours alternate."""
    usual = np.mean(gaps[np.abs(gaps - np.median(gaps)) <= 1])
    return float(np.mean(np.abs(gaps - usual) <= 1.01))


def interpolated_at(sensor: Sensor) -> Rows | None:
    """Return the rows at the ends of straight lines, where nearly all of the log consists of such lines."""
    if any(step is not None for step in sensor.coarse):
        return None
    bend = np.abs(np.diff(sensor.values, n=2, axis=0))
    scale = rms(bend, axis=0)
    if not np.all(scale > 1e-12 * np.maximum(np.max(np.abs(sensor.values), axis=0), 1e-300)):
        return None
    bent = (bend > np.maximum(1.01 * np.minimum(sensor.step, 0.1 * scale), 1e-3 * scale)).any(axis=1)
    if not 0.01 < bent.mean() < 0.6:
        return None
    knots = np.flatnonzero(bent) + 1
    gaps = np.diff(knots)
    # a knot between two rows bends the line twice
    if np.median(gaps) < 2 and np.mean(gaps == 1) < 0.6:
        knots = knots[np.concatenate([[True], gaps > 1])]
        gaps = np.diff(knots)
    if np.median(gaps) < 2 or _alike(gaps) < 0.8:
        return None
    return np.unique(np.concatenate([[0], knots]))
