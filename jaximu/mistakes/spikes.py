"""`data.spikes`: single samples, or a few, far from what their neighbours say."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy

from jaximu.ground.array_types import FloatArray
from jaximu.ground.differences import interpolated
from jaximu.ground.distributions import robust_sigma
from jaximu.ground.quantities import counted, size
from jaximu.mistakes.base import BRIDGED, Samples, Sensor
from jaximu.recordings.alignment import turned_between
from jaximu.recordings.finding import NO_ROWS, Finding, Rows
from jaximu.recordings.recording import runs_of

TITLES = {"data.spikes": "outliers"}

_TIMES = 10.0
"""Standard deviations, of the cubic's local misfit, from which a sample is no measurement."""
_BRIEF = 0.04
"""Seconds within which hands turn nothing to and fro."""
_WINDOW, _JUMP = 7, 5.0
"""Readings of a thermometer that say what one of them should be, and K by which none is off without being wrong."""
_MOST = 3000
"""Places that are looked at: beyond, the signal is not spiked but broken."""


_BESIDE = 5
"""Samples on either side of an outlier that say what it should have been."""
_NEAR = 3
"""Samples on either side of it that say how gravity turned: further off the unit is accelerated otherwise."""
_LEAST, _HALF = 4.0, 0.5
"""Standard deviations, of the accelerometer's noise, of a turn that gravity shows; the share of it that may be left."""


def find(samples: Samples) -> Iterator[Finding]:
    """Return the samples that stand out from both sides."""
    for name, sensor in samples.sensors.items():
        if name == "gyroscope" and sensor.dead_band is not None:  # what leaves the band is no outlier
            continue
        rows = _outliers(sensor)
        if sensor is samples.gyroscope and samples.accelerometer is not None and len(rows):
            runs = np.split(rows, 1 + np.flatnonzero(np.diff(rows) > 1))
            moved = [_turned(samples.accelerometer, sensor, run) for run in runs]
            rows = np.concatenate([rows[:0], *(run for run, turned in zip(runs, moved, strict=True) if not turned)])
        if not len(rows):
            continue
        largest = size(float(np.max(np.abs(sensor.curvature[rows]))), sensor.unit)
        yield Finding(
            "data.spikes",
            sensor.rows(rows),
            f"{name}: {counted(len(rows), 'outlier')} of up to {largest} against the neighbours, first "
            f"after {sensor.at(rows[0])}: knocks, or errors of transfer. They are left out; up to "
            f"{BRIDGED} in a row are bridged by interpolation.",
            without={name: rows},
        )
    for name in ("temperature", "ambient_temperature"):
        signal = samples.recording.signals.get(name)
        if signal is None or not len(rows := _wild(signal.si()[:, 0])):
            continue
        text = (
            f"{name.replace('_', ' ')}: {counted(len(rows), 'reading')} far from those before and after, first "
            f"{signal.values[rows[0], 0]:.4g}, as a thermometer gives for an error of transfer. They are left out."
        )
        yield Finding("data.spikes", (int(rows[0]) + 1,), text, without={name: rows})


def _wild(celsius: FloatArray) -> Rows:
    """The rows of temperatures (n,) that leave for a few readings and come back; one reading may be held for rows."""
    change = np.flatnonzero(np.diff(celsius, prepend=np.nan) != 0)
    if len(change) < _WINDOW:
        return NO_ROWS
    values = celsius[change]
    off = values - scipy.ndimage.median_filter(values, _WINDOW, mode="nearest")
    wild = np.abs(off) > max(_JUMP, _TIMES * robust_sigma(off))
    return np.flatnonzero(np.repeat(wild, np.diff(change, append=len(celsius))))


def _outliers(sensor: Sensor) -> Rows:
    if len(sensor) < 64:
        return NO_ROWS
    scale = np.maximum(sensor.local, 1.4 * sensor.noise + 0.5 * sensor.step)
    scale = np.maximum(scale, 1e-9 * np.ptp(sensor.values, axis=0))
    flagged = np.max(np.abs(sensor.curvature) / np.maximum(scale, 1e-300), axis=1) > _TIMES
    if not flagged.any():
        return NO_ROWS
    flagged[1:-1] |= flagged[:-2] & flagged[2:]
    clusters = runs_of(flagged)
    if len(clusters) > _MOST:
        return NO_ROWS
    rows = []
    for start, stop in clusters:
        if stop - start <= 2 * BRIDGED + 3:
            rows += _shortest(sensor.values, scale, int(start), int(stop), sensor.rate)
    return np.unique(np.array(rows, np.int64))


def _shortest(values: FloatArray, scale: FloatArray, start: int, stop: int, rate: float) -> list[int]:
    """The fewest samples in a row without which the others lie on a smooth curve; none where there are none such."""
    best: tuple[float, list[int]] | None = None
    for length in range(1, BRIDGED + 1):
        # what takes longer may be the motion's own
        times = 3 + 2 * length if length <= _BRIEF * rate else 20
        for first in range(start, stop - length + 1):
            last = first + length - 1
            if first < _BESIDE or last + _BESIDE >= len(values):
                continue
            # a cubic through five on either side, which the samples at fault must miss and the others must not
            inside, misfit = _bridged(values, first, last)
            left = np.abs(misfit) / scale[first]
            off = np.max(np.abs(values[first : last + 1] - inside) / scale[first], axis=1)
            worst = np.max(left)
            if np.min(off) > max(_TIMES, times * worst) and (best is None or worst < best[0]):
                best = worst, list(range(first, last + 1))
        if best is not None:
            return best[1]
    return []


def _bridged(values: FloatArray, first: int, last: int) -> tuple[FloatArray, FloatArray]:
    """Return the cubic through the samples beside an outlier at the rows of it, and what they miss it by."""
    around = np.concatenate([np.arange(first - _BESIDE, first), np.arange(last + 1, last + 1 + _BESIDE)])
    matrix, between = (
        np.vander((rows - (first + last) / 2) / _BESIDE, 4) for rows in (around, np.arange(first, last + 1))
    )
    coefficients, *_ = np.linalg.lstsq(matrix, values[around], rcond=None)
    return between @ coefficients, values[around] - matrix @ coefficients


def _turned(accelerometer: Sensor, gyroscope: Sensor, run: Rows) -> bool:
    """Whether gravity turned by what a run of the gyroscope's outliers integrates to: then they are motion.

    The specific force, carried back by the rates as logged and by those bridged, steps across the run by what either
    lacks, beside an acceleration that changes evenly.
    """
    from scipy.spatial.transform import Rotation  # which takes a tenth of a second to import

    first, last = int(run[0]), int(run[-1])
    inside, _ = _bridged(gyroscope.values, first, last)
    rows = np.arange(first - _NEAR, last + 1 + _NEAR)
    time = gyroscope.time[rows]
    force = interpolated(accelerometer.time, accelerometer.values, time)
    logged = gyroscope.values[rows] - np.median(gyroscope.values, axis=0)
    bridged = logged.copy()
    bridged[run - rows[0]] += inside - gyroscope.values[run]
    beside = np.r_[:_NEAR, len(rows) - _NEAR : len(rows)]
    offset = time[beside] - time.mean()
    estimate = np.linalg.pinv(np.stack([offset > 0, offset, np.ones(len(offset))], axis=1))[0]
    steps = []
    for rate in (logged, bridged):
        turns = Rotation.from_rotvec(turned_between(time, rate))
        attitude, carried = Rotation.identity(), [force[0]]
        for turn, later in zip(turns, force[1:], strict=True):
            attitude = attitude * turn
            carried.append(attitude.apply(later))
        steps.append(np.linalg.norm(estimate @ np.array(carried)[beside]))
    noise = np.linalg.norm(estimate) * np.linalg.norm(accelerometer.noise)
    return bool(steps[1] > _LEAST * noise and steps[0] < _HALF * steps[1])
