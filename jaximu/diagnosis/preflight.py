"""Checks on raw samples, before any model: defects of the recording, with row numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaximu.distributions import gamma_mean_sf
from jaximu.recording import Defect, Recording, Signal

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
    """Return what is wrong with a recording's samples: clipping, stuck axes, gaps, jitter, coarse steps, lines; and
    what reading it put right: disorder, repeats, sensors with stamps of their own.
    """
    found = [Finding(each.name, (), str(each)) for each in recording.notes if isinstance(each, Defect)]
    for name in ("accelerometer", "gyroscope"):
        signal: Signal | None = getattr(recording, name)
        if signal is None or len(signal) < 16:
            continue
        found += _timing(name, signal)
        for axis, values in zip("xyz", signal.values.T, strict=True):
            if np.ptp(values) > 0:
                found += _levels(name, axis, signal, values)
        found += _stuck(name, signal)
        found += _lines(name, signal)
    return found


def _timing(name: str, signal: Signal) -> list[Finding]:
    interval = np.diff(signal.time)
    usual = float(np.median(interval))
    spread = float(np.std(interval[interval < 1.5 * usual]))
    uneven = spread > 0.1 * usual
    gaps = np.flatnonzero(interval > (2.5 if uneven else 1.6) * usual)
    found = []
    if len(gaps):
        lost = int(np.sum(np.round(interval[gaps] / usual) - 1))
        found.append(Finding(
            "data.gap", _rows(gaps + 1),
            f"{name}: {len(gaps)} gap(s), {lost} samples missing, the longest {interval.max():.3g} s, after "
            f"{signal.time[gaps[np.argmax(interval[gaps])]]:.1f} s. Turns across gaps are left out.",
        ))  # fmt: skip
    if uneven:
        found.append(Finding(
            "data.jitter", (),
            f"{name}: stamps jitter by {1e3 * spread:.2g} ms from sample to sample, {100 * spread / usual:.0f} % of "
            "the interval. If the sensor samples evenly, its own clock is better than the logger's: leave the time "
            "column out (_ in --columns) and give --rate.",
        ))  # fmt: skip
    return found


def _coarse(values: FloatArray) -> float | None:
    """The step of an axis whose noise is finer than it, else None."""
    steps = np.diff(np.unique(values))
    steps = steps[steps > 1e-9 * max(float(np.ptp(values)), 1e-300)]
    if len(steps) < 2:
        return None
    difference = np.abs(np.diff(values))
    moved = difference[difference > 0]
    step = float(steps.min())
    # at rest most neighbours are equal, and those that are not differ by whole steps
    if np.mean(difference == 0) < 0.4 or np.mean(np.abs(moved / step - np.round(moved / step)) < 0.01) < 0.99:
        return None
    return step


def _levels(name: str, axis: str, signal: Signal, values: FloatArray) -> list[Finding]:
    step = _coarse(values)
    if step is not None:
        return [Finding(
            "data.quantisation", (),
            f"{name} {axis}: its step of {step:.3g} {signal.unit} is coarser than its noise; averages over a pose "
            "gain little. Choose a smaller range, or log unrounded values.",
        )]  # fmt: skip
    found = []
    for extreme, word in ((values.max(), "greatest"), (values.min(), "least")):
        runs = _stops(values, extreme)
        if len(runs):
            total = int(np.sum(runs[:, 1] - runs[:, 0]))
            found.append(Finding(
                "data.clipping", _rows(runs[:, 0]),
                f"{name} {axis}: {total} samples stop at its {word} value {extreme:.6g} {signal.unit}, up to "
                f"{int(np.max(runs[:, 1] - runs[:, 0]))} in a row: its range is too small for this motion.",
            ))  # fmt: skip
    return found


def _stops(values: FloatArray, extreme: float) -> NDArray[np.int64]:
    """Runs (k, 2) of at least three samples at an extreme, where far more lie than at the levels next to it."""
    runs = _runs(values == extreme)
    runs = runs[runs[:, 1] - runs[:, 0] >= 3]
    near = np.unique(values)
    near = near[-4:-1] if extreme == near[-1] else near[1:4]
    usual = max((int(np.sum(values == each)) for each in near), default=0)
    count = int(np.sum(runs[:, 1] - runs[:, 0])) if len(runs) else 0
    # one value held from one sample on to the end, or from the start, is a stuck axis
    whole = len(runs) == 1 and (runs[0, 0] == 0 or runs[0, 1] == len(values))
    # where other values are held as long, holding is this signal's way (a simulation without noise, say)
    inside = (values[1:] != values.max()) & (values[1:] != values.min())
    held = _runs((np.diff(values) == 0) & inside)
    held_longest = int(np.max(held[:, 1] - held[:, 0], initial=0))
    alone = len(runs) > 0 and held_longest < np.max(runs[:, 1] - runs[:, 0]) / 2
    return runs if count >= max(6, 4 * usual) and alone and not whole else runs[:0]


def _stuck(name: str, signal: Signal) -> list[Finding]:
    """An axis that repeats one value for long while the others change; rows that repeat as a whole."""
    change = np.diff(signal.values, axis=0) != 0
    length = max(20, round(_STUCK * signal.rate))
    found = []
    for axis in range(3):
        values = signal.values[:, axis]
        if _coarse(values) is not None:
            continue
        others = change[:, [k for k in range(3) if k != axis]].any(axis=1)
        limits = [tuple(run) for extreme in (values.max(), values.min()) for run in _stops(values, extreme)]
        long = [
            run for run in _runs(~change[:, axis])
            if run[1] - run[0] >= length and others[run[0] : run[1]].mean() > 0.5
            and not any(a <= run[0] and run[1] < b for a, b in limits)
        ]  # fmt: skip
        if long:
            rows = np.array([run[0] for run in long])
            total = sum(run[1] - run[0] for run in long) / signal.rate
            found.append(Finding(
                "data.stuck_axis", _rows(rows),
                f"{name} {'xyz'[axis]}: it repeats one value for {total:.3g} s in all, first after "
                f"{signal.time[rows[0]]:.1f} s, while the other axes move on.",
            ))  # fmt: skip
    same = ~change.any(axis=1)
    alone = float(np.min(np.mean(~change, axis=0)))
    if max(0.02, 0.6 * alone) < np.mean(same) < 1 and all(_coarse(axis) is None for axis in signal.values.T):
        found.append(Finding(
            "data.stuck_axis", _rows(np.flatnonzero(same) + 1),
            f"{name}: {100 * np.mean(same):.0f} % of the rows repeat the row before them: the log is faster than the "
            "sensor, or samples were lost and filled in.",
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
    parts = _detrended(parts)
    scatter = np.var(parts, axis=1).sum(axis=1)
    quiet = parts[scatter <= 2 * np.quantile(scatter, 0.25)]
    if len(quiet) < 12:
        return []
    power = np.mean(np.abs(np.fft.rfft(quiet * np.hanning(width)[:, None], axis=1)) ** 2, axis=0)[4:-2]
    found = []
    for axis in range(3):
        if _coarse(values[:, axis]) is not None or not np.median(power[:, axis]) > 1e-20 * np.mean(
            values[:, axis] ** 2
        ):
            continue  # rounding makes lines of its own
        around = _running_median(power[:, axis], 15)
        around = np.where(around > 0, around, np.median(power[:, axis]))
        peak = int(np.argmax(power[:, axis] / np.maximum(around, 1e-300)))
        # a bin's mean over k blocks is gamma with shape k (windowed blocks do not overlap)
        p_value = gamma_mean_sf(power[peak, axis] / around[peak], len(quiet)) * len(power)
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


def _detrended(parts: FloatArray) -> FloatArray:
    """Take a straight line off each part (k, n, 3)."""
    time = np.linspace(-1.0, 1.0, parts.shape[1])[:, None]
    centred = parts - parts.mean(axis=1, keepdims=True)
    return centred - time * (np.sum(time * centred, axis=1, keepdims=True) / np.sum(time**2))


def _running_median(values: FloatArray, width: int) -> FloatArray:
    """The median over so many neighbours, zeros beyond the ends."""
    padded = np.pad(values, width // 2)
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, width), axis=1)


def _runs(flags: NDArray[np.bool_]) -> NDArray[np.int64]:
    """First and last + 1 (k, 2) of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2)


def _rows(places) -> tuple[int, ...]:
    return tuple(int(place) + 1 for place in places[:_SHOWN])
