"""`data.gap`, `data.jitter`, `data.bursts`, `data.rate_change` and `data.time_scale`: what the stamps say."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.quantities import counted
from jaximu.mistakes.base import Samples, Sensor, off_cubic
from jaximu.recordings.finding import Finding
from jaximu.recordings.recording import FASTEST, Recording
from jaximu.recordings.stamps import UNEVEN, missing_samples, stretches_of_one_rate

TITLES = {
    "data.bursts": "stamps in bursts",
    "data.time_scale": "time scale",
    "data.rate_change": "rate that changes",
    "data.gap": "gaps",
    "data.jitter": "jittering stamps",
}

_SLOWEST = 1.0
"""Hz: no log of poses and turns has a lower rate."""
_SUDDEN = 0.3
"""Share of the mean interval below which two samples arrived together."""
_PAUSE = 1.5
"""Times the mean interval, from which on nothing arrived between two bursts."""
_LASTING = 20
"""Samples over whose mean a steady clock must not be late."""
_SURE = 14.0
"""Nats from which on samples were taken at even times, or at their stamps."""
_FAR = 6.0
"""Times the usual misfit of a sample beyond which it is a spike."""


def find(samples: Samples) -> list[Finding]:
    """Return what is wrong with each sensor's stamps."""
    findings = []
    for name, sensor in samples.sensors.items():
        if samples.shared and name == "gyroscope":
            if any(finding.apply or finding.name == "data.time_scale" for finding in findings):  # said once for both
                continue
        findings += _timing(name, sensor, [*samples.sensors.values()] if samples.shared else [sensor])
    return findings


def _timing(name: str, sensor: Sensor, alike: Sequence[Sensor]) -> Iterator[Finding]:
    interval = sensor.interval
    mean = np.mean(interval)
    if in_bursts(interval):
        rate, lag = (len(interval) / np.ptp(_clock(sensor.time)[0])), np.median(interval[interval > _PAUSE * mean])
        yield Finding(
            "data.bursts",
            sensor.rows(np.flatnonzero(interval > _PAUSE * mean)[:5] + 1),
            f"{name}: the stamps come in bursts, {lag * 1e3:.3g} ms apart: they are the times of arrival at the "
            f"host, or were cut to a coarser clock. A steady clock of {rate:.5g} Hz fitted to them replaces them; let "
            "the sensor's own clock be logged, with all its digits.",
            apply=steady_clock,
        )
        return
    usual = 1 / sensor.period  # a pause lowers the mean
    if not _SLOWEST <= usual <= FASTEST:
        yield Finding(
            "data.time_scale",
            (),
            f"{name}: samples {sensor.period:.4g} s apart are {usual:.3g} a second: the unit of the time column is "
            "wrong. Change it in the header or with --columns.",
            spoils=True,
        )
    if len(stretches := stretches_of_one_rate(sensor.time)) > 1:
        rates = [1 / np.median(interval[part.start : part.stop - 1]) for part in stretches]
        until = [f"{rate:.5g} Hz up to {sensor.time[part.stop]:.6g} s" for rate, part in zip(rates, stretches[:-1])]  # noqa: B905
        yield Finding(
            "data.rate_change",
            sensor.rows(np.array([part.start for part in stretches[1:]])),
            f"{name}: the rate changes: {', '.join(until)}, and {rates[-1]:.5g} Hz from there. Cut the log there, and "
            "keep the logger at one rate.",
        )
        return
    missing = missing_samples(sensor.time)
    gaps = np.flatnonzero(missing)
    if len(gaps):
        yield Finding(
            "data.gap",
            sensor.rows(gaps + 1),
            f"{name}: {counted(len(gaps), 'gap')}, {counted(int(missing.sum()), 'sample')} missing, the longest "
            f"{interval[gaps].max():.3g} s, after {sensor.time[gaps[np.argmax(interval[gaps])]]:.1f} s. Turns across "
            "long gaps are left out.",
        )
    kept = interval[missing == 0]
    if np.std(kept) > UNEVEN * mean:
        yield _jitter(name, sensor, alike, kept)


def _jitter(name: str, sensor: Sensor, alike: Sequence[Sensor], interval: FloatArray) -> Finding:
    """Return what is said of uneven intervals (n,): samples were taken evenly, or at the stamps, as motion shows."""
    even, grid, spread = _even(sensor.time), _grid(interval), np.std(interval)
    evidence = 0.0 if even is None else sum(_taken_evenly(one, even) for one in alike)
    text = (
        f"{name}: stamps jitter by {1e3 * spread:.2g} ms from sample to sample, {100 * spread / interval.mean():.0f} % "
        f"of the interval{f', in steps of {1e3 * grid:.3g} ms, as a logger polls' if grid > spread else ''}"
    )
    apply = None
    if even is not None and evidence > _SURE:
        apply = partial(_evenly, sensor=sensor, even=even)
        text += (
            f", and the samples were taken at even times: a steady clock of {1 / np.median(np.diff(even)):.5g} Hz "
            "fitted to the stamps replaces them."
        )
    elif evidence < -_SURE:
        text += ", and the samples were taken at the times of the stamps, which are used as they are."
    else:
        text += (
            ". If the sensor samples evenly, its own clock is better than the logger's: leave the time column out "
            "(_ in --columns) and give --rate."
        )
    return Finding("data.jitter", (), text, apply=apply)


def _grid(interval: FloatArray) -> float:
    """Return the step that intervals (n,) come in, s; zero where they come in none that is coarse."""
    levels = np.unique(np.round(interval, 6))
    step = np.diff(levels, prepend=0.0).max()
    return float(step) if np.max(np.abs(levels - step * np.round(levels / step))) < 0.01 * step else 0.0


def _even(time: FloatArray) -> FloatArray | None:
    """Stamps (n,) of the samples on a steady clock, gaps counted; None for few, or where they stay off by more."""
    if len(time) < 200:
        return None
    number = np.arange(len(time)) + np.cumulative_sum(missing_samples(time), include_initial=True)
    even, slope = _line(number, time)
    lasting = np.convolve(time - even, np.full(_LASTING, 1 / _LASTING), "valid")
    return even if np.max(np.abs(lasting)) < 0.75 * slope else None


def _line(number: FloatArray, time: FloatArray) -> tuple[FloatArray, float]:
    """Stamps (n,) on the straight line fitted to those of numbered samples, and its slope."""
    slope, start = np.polyfit(number, time, 1)
    return start + slope * number, slope


def _evenly(recording: Recording, sensor: Sensor, even: FloatArray) -> Recording:
    """Return the recording with the stamps of a sensor, and of all that share them, replaced by those of a clock."""
    changed = {
        name: replace(signal, time=even)
        for name, signal in recording.signals.items()
        if np.array_equal(signal.time, sensor.time)
    }
    return replace(recording, **changed)


def _taken_evenly(sensor: Sensor, even: FloatArray) -> float:
    """Return by how many nats the samples in motion were taken at even times (n,) rather than at their stamps.

    Samples taken at the stamps are off smooth curves by the slope times the deviation of their stamps, in the mean over
    neighbours; those taken at even times are not. The slope at a sample, whose noise is that of its neighbours, is
    multiplied with the slope around them.
    """
    values, period = sensor.values, float(np.mean(np.diff(even)))
    deviation = off_cubic((sensor.time - even)[:, None] / period)
    near, wide = np.zeros_like(values), np.zeros_like(values)
    near[1:-1] = (values[2:] - values[:-2]) / 2
    wide[4:-4] = (values[7:-1] + values[8:] - values[1:-7] - values[:-8]) / 14
    misfit, scale = sensor.curvature, np.maximum(sensor.local, 1e-100)
    used = (misfit != 0) & (np.abs(misfit) < _FAR * scale)
    around = np.where(used, wide * deviation / scale**2, 0.0)
    expected, measured = np.sum(around * near * deviation), np.sum(around * misfit)
    variance = np.sum((around * (misfit - measured / expected * near * deviation)) ** 2)
    return float(expected * (expected - 2 * measured) / (2 * variance)) if variance > 0 else 0.0


def in_bursts(interval: FloatArray) -> bool:
    """Return whether many samples share nearly one time of arrival, with pauses between."""
    if len(interval) < 32:
        return False
    mean = np.mean(interval)
    # gaps are few and long; pauses between bursts hold most of the time
    mean = min(mean, np.mean(np.minimum(interval, 20 * mean)))
    together = interval < _SUDDEN * mean
    pause = interval > _PAUSE * mean
    if together.mean() < 0.3 or pause.sum() < 8:
        return False
    return bool(interval[pause].sum() > 0.6 * interval.sum())


def _clock(time: FloatArray) -> tuple[FloatArray, float]:
    """Stamps of a steady clock fitted to arrival times, in stretches between pauses in the log, and one sigma of its
    rate, as a share.

    The bursts' first samples tell the rate. Delays are never negative, so the clock goes through the earliest arrivals
    of each second: one sensor may come in bursts and another not.
    """
    index = np.arange(len(time), dtype=float)
    interval = np.diff(time)
    begins = 1 + np.flatnonzero(interval > _PAUSE * np.mean(np.minimum(interval, 20 * np.mean(interval))))
    slope, start = np.polyfit(index[begins], time[begins], 1)
    fitted = start + slope * index
    delay = time - fitted
    # what stays off the line from one sample on is a gap in the log, not a delay
    width = max(8, round(1.0 / max(slope, 1e-9)))
    if np.ptp(delay) > 20 * np.median(np.abs(delay)) + 1e-9:
        edges = np.concatenate([[0], np.flatnonzero(interval > 12 * np.quantile(interval, 0.99)) + 1, [len(time)]])
        parts = [np.polyfit(index[a:b], time[a:b], 1) for a, b in pairwise(edges) if b - a > width]
        if parts:
            slope = np.median([part[0] for part in parts])
            fitted = np.concatenate(
                [np.median(time[a:b] - slope * index[a:b]) + slope * index[a:b] for a, b in pairwise(edges)]
            )
            if np.any(np.diff(fitted) <= 0):
                fitted, slope = _line(index, time)
    early = [part.min() for part in np.array_split(time - fitted, max(1, len(time) // width))]
    share = np.sqrt(np.var((time - fitted)[begins]) / slope**2 + 1 / 12)  # a burst begins at a whole sample
    return fitted + np.median(early), float(share / np.std(begins) / np.sqrt(len(begins)))


def steady_clock(recording: Recording) -> Recording:
    """Return the recording with the stamps of sensors that arrive in bursts replaced by those of a steady clock."""
    clocks = {
        name: _clock(signal.time) for name, signal in recording.signals.items() if in_bursts(np.diff(signal.time))
    }
    changed = {
        name: replace(recording.signals[name], time=time, clock_sigma=sigma) for name, (time, sigma) in clocks.items()
    }
    return replace(recording, **changed)
