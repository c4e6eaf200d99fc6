"""`data.zeros`: rows in which a sensor reads nothing at all, as loggers write when a transfer fails."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaximu.ground.quantities import counted
from jaximu.mistakes.base import Samples, Sensor
from jaximu.mistakes.held_at_rest import zeroed_at_rest
from jaximu.recordings.finding import Finding, Rows
from jaximu.recordings.recording import runs_of

TITLES = {"data.zeros": "rows of zeros"}

_MOST = 0.3
"""Share of rows beyond which a sensor is not interrupted but silent."""
_BESIDE = 2
"""Rows on either side, that a smooth motion has near what it reads between them."""
_BEYOND = 6.0
"""Noise and steps by which the rows beside must lie off zero on an axis, all to one side."""


def find(samples: Samples) -> Iterator[Finding]:
    """Return the rows that are zero on all axes of a sensor although neighbouring rows are not."""
    nothing = {name: (sensor.signal.values == 0.0).all(axis=1) for name, sensor in samples.sensors.items()}
    without: dict[str, Rows] = {}
    for name, sensor in samples.sensors.items():
        zero = nothing[name]
        if not zero.any() or zero.mean() > _MOST:
            continue
        if name == "gyroscope" and zeroed_at_rest(samples) is not None:
            continue
        zero = _interrupted(sensor, zero)
        if name == "gyroscope" and samples.shared and "accelerometer" in without:
            zero[without["accelerometer"]] |= nothing[name][without["accelerometer"]]
        if zero.any():
            without[name] = np.flatnonzero(zero)
    if not without:
        return
    first = samples.sensors[min(without, key=lambda name: without[name][0])]
    rows = np.unique(np.concatenate(list(without.values())))
    which = " and ".join(without)
    yield Finding(
        "data.zeros",
        first.rows(rows),
        f"{which}: {counted(len(rows), 'row')} read zero on all axes, first after {first.at(rows[0])}: a "
        "transfer failed, or the logger filled them in. They are left out.",
        without=without,
    )


def _interrupted(sensor: Sensor, zero: np.ndarray) -> np.ndarray:
    """Keep the runs of zeros that the rows beside them rule out.

    A gyroscope at rest, a turn that is reversed and a fall may read zero by rounding. Then zero lies between the rows
    before and after, on every axis, or within 6 σ of noise and a step of one of them: one in 10⁹ rows does not.
    """
    kept = np.zeros_like(zero)
    scale = sensor.noise + sensor.step
    for start, stop in runs_of(zero):
        near = np.r_[max(0, start - _BESIDE) : start, stop : min(len(zero), stop + _BESIDE)]
        near = sensor.values[near[~zero[near]]]
        if not len(near):
            continue
        least = np.where(np.ptp(np.sign(near), axis=0) == 0, np.min(np.abs(near), axis=0), 0.0)
        if np.max(least / np.maximum(scale, 1e-300)) > _BEYOND:
            kept[start:stop] = True
    return kept
