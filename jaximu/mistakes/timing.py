"""`data.gap`, `data.jitter`, `data.bursts` and `data.time_scale`: what the stamps say."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.quantities import counted
from jaximu.ground.units import SENSOR_UNITS
from jaximu.mistakes.base import Samples, Sensor
from jaximu.recordings.finding import Finding
from jaximu.recordings.recording import FASTEST, GAP, Recording

TITLES = {
    "data.bursts": "stamps in bursts",
    "data.time_scale": "time scale",
    "data.gap": "gaps",
    "data.jitter": "jittering stamps",
}

_SLOWEST = 1.0
"""Hz: no log of poses and turns has a lower rate."""
_SUDDEN = 0.3
"""Share of the mean interval below which two samples arrived together."""


def find(samples: Samples) -> list[Finding]:
    """Return what is wrong with each sensor's stamps."""
    findings = []
    for name, sensor in samples.sensors.items():
        if samples.shared and name == "gyroscope":
            first = [finding for finding in findings if finding.name in ("data.bursts", "data.time_scale")]
            if first:  # said once for both
                continue
        findings += _timing(name, sensor)
    return findings


def _timing(name: str, sensor: Sensor) -> Iterator[Finding]:
    interval = sensor.interval
    usual = sensor.period
    mean = np.mean(interval)
    if in_bursts(interval):
        rate, lag = 1 / _clock(sensor.time)[1], np.quantile(interval, 0.99)
        yield Finding(
            "data.bursts",
            sensor.rows(np.flatnonzero(interval > 1.8 * mean)[:5] + 1),
            f"{name}: the stamps come in bursts, {lag * 1e3:.3g} ms apart: they are the times of arrival at the "
            f"host. A steady clock of {rate:.5g} Hz fitted to them replaces them; let the sensor's own clock be "
            "logged if it can be.",
            apply=steady_clock,
        )
        return
    if not _SLOWEST <= 1 / mean <= FASTEST:
        yield Finding(
            "data.time_scale",
            (),
            f"{name}: {len(sensor)} samples in {sensor.time[-1] - sensor.time[0]:.4g} s are {1 / mean:.3g} a "
            "second: the unit of the time column is wrong. Change it in the header or with --columns.",
            spoils=True,
        )
    spread = np.std(interval[interval < 1.5 * usual])
    uneven = spread > 0.1 * usual
    gaps = np.flatnonzero(interval > (2.5 if uneven else GAP) * usual)
    if len(gaps):
        lost = int(np.sum(np.round(interval[gaps] / usual) - 1))
        yield Finding(
            "data.gap",
            sensor.rows(gaps + 1),
            f"{name}: {counted(len(gaps), 'gap')}, {counted(lost, 'sample')} missing, the longest "
            f"{interval.max():.3g} s, after {sensor.time[gaps[np.argmax(interval[gaps])]]:.1f} s. Turns across "
            "long gaps are left out.",
        )
    if uneven:
        even = _smoother_evenly(sensor)
        yield Finding(
            "data.jitter",
            (),
            f"{name}: stamps jitter by {1e3 * spread:.2g} ms from sample to sample, {100 * spread / usual:.0f} % "
            "of "
            + (
                "the interval, and the samples are smooth at even times: a steady clock fitted to the stamps "
                "replaces them."
                if even
                else "the interval. If the sensor samples evenly, its own clock is better than the "
                "logger's: leave the time column out (_ in --columns) and give --rate."
            ),
            apply=_evenly if even else None,
        )


def _even(time: FloatArray) -> FloatArray | None:
    """Stamps (n,) of the samples on a steady clock, gaps counted; None for few, or where they are off by more."""
    if len(time) < 200:
        return None
    interval = np.diff(time)
    breaks = np.flatnonzero(interval > 2.5 * np.median(interval)) + 1
    number = np.arange(len(time), dtype=np.float64)
    slopes = [np.polyfit(number[a:b], time[a:b], 1)[0] for a, b in pairwise([0, *breaks, len(time)]) if b - a > 100]
    if not slopes:
        return None
    period = np.median(slopes)
    for row in breaks:
        delay = time - period * number
        missing = np.round((np.mean(delay[row : row + 20]) - np.mean(delay[max(0, row - 20) : row])) / period)
        number[row:] += max(0.0, missing)
    even, slope = _line(number, time)
    return even if np.max(np.abs(time - even)) < 0.75 * slope else None


def _line(number: FloatArray, time: FloatArray) -> tuple[FloatArray, float]:
    """Stamps (n,) on the straight line fitted to those of numbered samples, and its slope."""
    slope, start = np.polyfit(number, time, 1)
    return start + slope * number, slope


def _evenly(recording: Recording) -> Recording:
    """Return the recording with jittering stamps of its triads replaced by those of a steady clock."""
    changed = {
        name: replace(signal, time=even)
        for name, signal in recording.signals.items()
        if name in SENSOR_UNITS and (even := _even(signal.time)) is not None
    }
    return replace(recording, **changed)


def _smoother_evenly(sensor: Sensor) -> bool:
    """Whether the samples in motion lie on smoother curves by their number than by their stamps."""
    even = _even(sensor.time)
    if even is None:
        return False
    bends = []
    for time in (even, sensor.time):
        bend = np.abs(np.diff(sensor.difference / np.diff(time)[:, None], axis=0)).sum(axis=1) * sensor.period
        moving = np.abs(sensor.difference[1:]).sum(axis=1) > 6 * np.sum(sensor.noise)
        bends.append(np.median(bend[moving]) if moving.sum() > 50 else np.inf)
    return bends[0] < 0.8 * bends[1]


def in_bursts(interval: FloatArray) -> bool:
    """Return whether many samples share nearly one time of arrival, with pauses between."""
    if len(interval) < 32:
        return False
    mean = np.mean(interval)
    # gaps are few and long; pauses between bursts hold most of the time
    mean = min(mean, np.mean(np.minimum(interval, 20 * mean)))
    together = interval < _SUDDEN * mean
    pause = interval > 1.5 * mean
    if together.mean() < 0.3 or pause.sum() < 8:
        return False
    return bool(interval[pause].sum() > 0.6 * interval.sum())


def _clock(time: FloatArray) -> tuple[FloatArray, float]:
    """Stamps of a steady clock fitted to arrival times, in stretches between pauses in the log, and its period.

    Delays are never negative, so the clock goes through the earliest arrivals of each second: one sensor may come in
    bursts and another not.
    """
    index = np.arange(len(time), dtype=float)
    fitted, slope = _line(index, time)
    delay = time - fitted
    # what stays off the line from one sample on is a gap in the log, not a delay
    width = max(8, round(1.0 / max(slope, 1e-9)))
    if np.ptp(delay) > 20 * np.median(np.abs(delay)) + 1e-9:
        steps = np.diff(time)
        edges = np.concatenate([[0], np.flatnonzero(steps > 12 * np.quantile(steps, 0.99)) + 1, [len(time)]])
        parts = [np.polyfit(index[a:b], time[a:b], 1) for a, b in pairwise(edges) if b - a > width]
        if parts:
            slope = np.median([part[0] for part in parts])
            fitted = np.concatenate(
                [np.median(time[a:b] - slope * index[a:b]) + slope * index[a:b] for a, b in pairwise(edges)]
            )
            if np.any(np.diff(fitted) <= 0):
                fitted, slope = _line(index, time)
    early = [part.min() for part in np.array_split(time - fitted, max(1, len(time) // width))]
    return fitted + np.median(early), float(slope)


def steady_clock(recording: Recording) -> Recording:
    """Return the recording with the stamps of sensors that arrive in bursts replaced by those of a steady clock."""
    changed = {
        name: replace(signal, time=_clock(signal.time)[0])
        for name, signal in recording.signals.items()
        if in_bursts(np.diff(signal.time))
    }
    return replace(recording, **changed)
