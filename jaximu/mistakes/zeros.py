"""`data.zeros`: rows in which a sensor reads nothing at all, as loggers write when a transfer fails."""

from __future__ import annotations

import numpy as np

from jaximu.ground.quantities import counted
from jaximu.mistakes.base import Samples, Sensor
from jaximu.mistakes.held_at_rest import zeroed_at_rest
from jaximu.recordings.finding import Finding, Rows
from jaximu.recordings.recording import runs_of

__all__ = ["TITLES", "find"]

TITLES = {"data.zeros": "rows of zeros"}

_MOST = 0.3
"""Share of rows beyond which a sensor is not interrupted but silent."""


def find(samples: Samples) -> list[Finding]:
    """Return the rows that are zero on all axes of a sensor although neighbouring rows are not."""
    nothing = {name: (sensor.signal.values == 0.0).all(axis=1) for name, sensor in samples.sensors.items()}
    without: dict[str, Rows] = {}
    for name, sensor in samples.sensors.items():
        zero = nothing[name]
        if not zero.any() or zero.mean() > _MOST or not len(sensor):
            continue
        if name == "gyroscope":
            if zeroed_at_rest(samples) is not None:
                continue
            zero = _interrupted(sensor, zero)
            if samples.shared and "accelerometer" in without:
                zero[without["accelerometer"]] |= nothing[name][without["accelerometer"]]
        if zero.any():
            without[name] = np.flatnonzero(zero)
    if not without:
        return []
    first = samples.sensors[min(without, key=lambda name: without[name][0])]
    rows = np.unique(np.concatenate(list(without.values())))
    which = " and ".join(without)
    return [
        Finding(
            "data.zeros",
            first.rows(rows),
            f"{which}: {counted(len(rows), 'row')} read zero on all axes, first after {first.at(int(rows[0]))}: the "
            "logger wrote rows without a measurement. They are left out.",
            without=without,
        )
    ]


def _interrupted(sensor: Sensor, zero: np.ndarray) -> np.ndarray:
    """Keep the runs of zeros whose neighbours differ from zero: a gyroscope at rest may read zero by rounding."""
    kept = np.zeros_like(zero)
    scale = sensor.noise + sensor.step
    for start, stop in runs_of(zero):
        before, after = np.arange(max(0, start - 5), start), np.arange(stop, min(len(zero), stop + 5))
        sides = [np.median(sensor.values[part[~zero[part]]], axis=0) for part in (before, after) if (~zero[part]).any()]
        if not sides:
            continue
        # a rate that goes through zero has other signs on either side
        least = np.where(np.sign(sides[0]) == np.sign(sides[-1]), np.minimum(np.abs(sides[0]), np.abs(sides[-1])), 0.0)
        if np.max(least / np.maximum(scale, 1e-300)) > 6:
            kept[start:stop] = True
    return kept
