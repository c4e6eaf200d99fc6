"""Checks on raw samples, before any model: defects of the recording, with row numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.signal
import scipy.stats
from numpy.typing import NDArray

from jaximu.recording import Recording, Signal

__all__ = ["Finding", "inspect"]

FloatArray = NDArray[np.float64]
_SHOWN = 5
_STUCK = 0.5
"""Seconds for which an axis may repeat one value while others change."""


@dataclass(frozen=True)
class Finding:
    """A defect of a recording: a `data.…` name, the first rows concerned (counted from 1), a sentence."""

    name: str
    rows: tuple[int, ...]
    text: str

    def document(self) -> dict[str, Any]:
        """Return the finding as `diagnosis.json` has it."""
        return {"name": self.name, "rows": list(self.rows), "text": self.text}


def inspect(recording: Recording) -> list[Finding]:
    """Return what is wrong with a recording's samples: clipping, stuck axes, gaps, jitter, coarse steps, lines."""
    found: list[Finding] = []
    for name in ("accelerometer", "gyroscope"):
        signal: Signal | None = getattr(recording, name)
        if signal is None or len(signal) < 16:
            continue
        found += _timing(name, signal)
        for axis, values in zip("xyz", signal.values.T, strict=True):
            found += _levels(name, axis, signal, values)
        found += _stuck(name, signal)
        found += _lines(name, signal)
    return found


def _timing(name: str, signal: Signal) -> list[Finding]:
    interval = np.diff(signal.time)
    usual = float(np.median(interval))
    gaps = np.flatnonzero(interval > 2.5 * usual)
    found = []
    if len(gaps):
        lost = int(np.sum(np.round(interval[gaps] / usual) - 1))
        found.append(Finding(
            "data.gap", _rows(gaps + 1),
            f"{name}: {len(gaps)} gap(s), {lost} samples missing, the longest {interval.max():.3g} s, after "
            f"{signal.time[gaps[np.argmax(interval[gaps])]]:.1f} s. Turns across gaps are left out.",
        ))  # fmt: skip
    spread = float(np.std(interval[interval < 1.5 * usual]))
    if spread > 0.1 * usual:
        found.append(Finding(
            "data.jitter", (),
            f"{name}: stamps jitter by {1e3 * spread:.2g} ms from sample to sample, {100 * spread / usual:.0f} % of "
            "the interval. If the sensor samples evenly, its own clock is better than the logger's: leave the time "
            "column out (_ in --columns) and give --rate.",
        ))  # fmt: skip
    return found


def _levels(name: str, axis: str, signal: Signal, values: FloatArray) -> list[Finding]:
    found = []
    for extreme, word in ((values.max(), "greatest"), (values.min(), "least")):
        at = values == extreme
        runs = _runs(at)
        long = runs[(runs[:, 1] - runs[:, 0]) >= 3] if len(runs) else runs
        # a limit is a value that many samples stop at, and that stands far off from where the signal rests
        far = abs(extreme - np.median(values)) > 4 * np.quantile(np.abs(values - np.median(values)), 0.5)
        if len(long) and far and at.sum() >= 6:
            found.append(Finding(
                "data.clipping", _rows(long[:, 0]),
                f"{name} {axis}: {int(at.sum())} samples stop at its {word} value {extreme:.6g} {signal.unit}, up to "
                f"{int(np.max(long[:, 1] - long[:, 0]))} in a row: its range is too small for this motion.",
            ))  # fmt: skip
    steps = np.diff(np.unique(values))
    if len(steps):
        step = float(steps.min())
        difference = np.diff(values)
        still = float(np.median(np.abs(difference)))
        if step > 0 and still == 0.0 and np.mean(difference == 0) > 0.6 and len(steps) > 2:
            found.append(Finding(
                "data.quantisation", (),
                f"{name} {axis}: its step of {step:.3g} {signal.unit} is coarser than its noise; averages over a pose "
                "gain little. Choose a smaller range, or log unrounded values.",
            ))  # fmt: skip
    return found


def _stuck(name: str, signal: Signal) -> list[Finding]:
    """An axis that repeats one value for long while the others change."""
    change = np.diff(signal.values, axis=0) != 0
    length = max(20, round(_STUCK * signal.rate))
    found = []
    for axis in range(3):
        others = change[:, [k for k in range(3) if k != axis]].any(axis=1)
        usual = np.mean(~change[:, axis])
        if usual > 0.5 and not usual > 0.999:
            continue  # coarse steps: repeating is its way
        runs = _runs(~change[:, axis])
        long = [run for run in runs if run[1] - run[0] >= length and others[run[0] : run[1]].mean() > 0.5]
        if long:
            rows = np.array([run[0] for run in long])
            total = sum(run[1] - run[0] for run in long) / signal.rate
            found.append(Finding(
                "data.stuck_axis", _rows(rows),
                f"{name} {'xyz'[axis]}: it repeats one value for {total:.3g} s in all, first after "
                f"{signal.time[rows[0]]:.1f} s, while the other axes move on.",
            ))  # fmt: skip
    return found


def _lines(name: str, signal: Signal) -> list[Finding]:
    """Sharp lines in the spectrum of the quieter half of the recording."""
    width = 256
    values = signal.si()
    blocks = len(values) // width
    if blocks < 24:
        return []
    parts = values[: blocks * width].reshape(blocks, width, 3)
    parts = scipy.signal.detrend(parts, axis=1)
    scatter = np.var(parts, axis=1).sum(axis=1)
    quiet = parts[scatter <= 2 * np.quantile(scatter, 0.25)]
    if len(quiet) < 12:
        return []
    power = np.mean(np.abs(np.fft.rfft(quiet * np.hanning(width)[:, None], axis=1)) ** 2, axis=0)[4:-2]
    found = []
    for axis in range(3):
        around = scipy.signal.medfilt(power[:, axis], 15)
        around = np.where(around > 0, around, np.median(power[:, axis]))
        peak = int(np.argmax(power[:, axis] / np.maximum(around, 1e-300)))
        # a bin's mean over k blocks is gamma with shape k (windowed blocks do not overlap)
        p_value = scipy.stats.gamma.sf(power[peak, axis] / around[peak], len(quiet), scale=1 / len(quiet)) * len(power)
        ratio = power[peak, axis] / around[peak]
        if p_value < 1e-6 and ratio > 4:
            frequency = (peak + 4) * signal.rate / width
            amplitude = 2 * np.sqrt(power[peak, axis]) / np.sum(np.hanning(width))
            unit = "m/s²" if name == "accelerometer" else "rad/s"
            found.append(Finding(
                "data.periodic", (),
                f"{name} {'xyz'[axis]}: a line near {frequency:.3g} Hz of about {amplitude:.2g} {unit} at rest, "
                f"{ratio:.0f} times the noise around it: a motor, the mains, or an alias of one.",
            ))  # fmt: skip
    return found


def _runs(flags: NDArray[np.bool_]) -> NDArray[np.int64]:
    """First and last + 1 (k, 2) of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2)


def _rows(places) -> tuple[int, ...]:
    return tuple(int(place) + 1 for place in places[:_SHOWN])
