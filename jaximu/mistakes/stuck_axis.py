"""`data.stuck_axis`: an axis that repeats one value while others move; a sensor that hung; rows repeated at random."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaximu.ground.array_types import BoolArray
from jaximu.mistakes.base import HUNG, Samples, Sensor
from jaximu.mistakes.clipping import at_limits, stops
from jaximu.mistakes.resampled import held_at
from jaximu.recordings.finding import Finding, Rows
from jaximu.recordings.recording import Signal, runs_of

TITLES = {"data.stuck_axis": "stuck output"}

_STUCK = 0.5
"""Seconds for which an axis may repeat one value while others change."""
_SHORTEST = 0.2
"""Seconds for which a sensor may repeat all of its values, of `HUNG` rows at least."""
_STOOD, _TIMES = 60.0, 20
"""Seconds for which a thermometer that has noise may repeat a reading, if not so many times as long as it usually does:
half of its readings differ from the one before."""
_REVERSED, _LARGER = 0.3, 0.1
"""Shares of a thermometer's changes that go back and that exceed its step, from which on it has noise: white noise has
0.67 and, where its standard deviation is a step, 0.2."""


def find(samples: Samples) -> list[Finding]:
    """Return the axes that are stuck, sensors that hung, and rows that repeat as a whole."""
    findings = [finding for sensor in samples.sensors.values() for finding in _stuck(sensor)]
    return [*findings, *_stuck_thermometer(samples.recording.temperature)]


def _stuck_thermometer(signal: Signal | None) -> Iterator[Finding]:
    """Return where a thermometer that has noise repeats a reading; one without may stand still in a soak."""
    readings = np.zeros(0) if signal is None else signal.values[:, 0]
    edges = np.flatnonzero(np.diff(readings, prepend=np.nan, append=np.nan))
    jumps = np.diff(readings[edges[:-1]])
    if signal is None or len(jumps) < HUNG or np.mean(jumps[1:] * jumps[:-1] < 0) < _REVERSED:
        return
    if np.mean(np.abs(jumps) > 1.5 * np.min(np.abs(jumps))) < _LARGER:
        return
    runs, length = np.stack([edges[:-1], edges[1:] - 1], axis=1), np.diff(edges)
    stuck = runs[(length > _TIMES * np.quantile(length, 0.99)) & (np.diff(signal.time[runs])[:, 0] > _STOOD)]
    if not len(stuck):
        return
    first, rows = stuck[0, 0], _repeating(stuck)
    yield Finding(
        "data.stuck_axis",
        (int(first) + 1,),
        f"temperature: it repeats one reading for {np.sum(np.diff(signal.time[stuck])):.3g} s in all, first "
        f"{readings[first]:.4g} °C after {signal.time[first]:.1f} s, while elsewhere its noise changes it: the "
        "thermometer or its driver hung. These readings are left out; without them nothing shows what the temperature "
        "does there.",
        without={"temperature": rows},
    )


def _stuck(sensor: Sensor) -> list[Finding]:
    change = np.asarray(sensor.difference != 0)
    if not change.any():
        row = ", ".join(f"{value:.6g}" for value in sensor.values[0])
        return [
            Finding(
                "data.stuck_axis",
                (),
                f"{sensor.name}: every row reads {row}. Nothing was measured: check its wiring and its columns, and "
                "record again.",
                spoils=True,
                refuses=sensor.name,
            )
        ]
    axes = [axis for axis in range(3) if sensor.coarse[axis] is None]
    findings = [finding for axis in axes if (finding := _stuck_axis(sensor, change, axis)) is not None]
    if held_at(sensor) is not None or sensor.dead_band is not None:
        return findings
    return [*findings, *_repeated_rows(sensor, change)]


def _stuck_axis(sensor: Sensor, change: BoolArray, axis: int) -> Finding | None:
    """Return where an axis repeats itself, not at an end of its range, while the others move; `change` (n − 1, 3)."""
    values = sensor.values[:, axis]
    others = np.any(change[:, [k for k in range(3) if k != axis]], axis=1)
    candidates = _long(~change[:, axis], max(20, round(_STUCK * sensor.rate)))
    if not len(candidates):
        return None
    limits = np.concatenate([stops(values, extreme) for extreme in (values.max(), values.min())])
    inside = [
        bool(np.mean(others[start:stop]) > 0.5) and not any(a <= start and stop < b for a, b in limits)
        for start, stop in candidates
    ]
    long = candidates[np.array(inside)]
    if not len(long):
        return None
    first, rows = long[:, 0], _repeating(long)
    most = len(rows) > 0.5 * len(sensor)
    # without noise every axis repeats itself at rest, and nothing is wrong with that
    noisy = float(np.mean(~change[:, axis])) < 1.5 * len(rows) / len(sensor) + 0.2
    text = (
        f"{sensor.name} {'xyz'[axis]}: it repeats one value for {len(rows) / sensor.rate:.3g} s in all, first after "
        f"{sensor.at(first[0])}, while the other axes move on."
    )
    if most:
        text += " The axis is dead for most of the recording: check its wiring, and record again."
    elif noisy:
        text += " These rows are left out."
    without = {sensor.name: rows} if noisy and not most else {}
    return Finding("data.stuck_axis", sensor.rows(first), text, spoils=most and noisy, without=without)


def _repeated_rows(sensor: Sensor, change: BoolArray) -> Iterator[Finding]:
    """Return where all axes repeat a row: for long, so that the sensor hung, and now and then; `change` (n − 1, 3)."""
    same = ~change.any(axis=1) & ~at_limits(sensor)[1:]
    coarse = [step is not None for step in sensor.coarse]
    hung = _hung(sensor, same)
    if len(hung) and not all(coarse):
        first, rows = hung[:, 0], _repeating(hung)
        yield Finding(
            "data.stuck_axis",
            sensor.rows(first),
            f"{sensor.name}: all axes repeat one row for {len(rows) / sensor.rate:.3g} s in all, first after "
            f"{sensor.at(first[0])}: the sensor or its driver hung, or samples were lost and filled in. These "
            "rows are left out.",
            without={sensor.name: rows},
        )
        same[rows - 1] = False
    if max(0.02, 0.6 * np.min(np.mean(~change, axis=0))) < np.mean(same) < 1 and not any(coarse):
        rows = np.flatnonzero(same) + 1
        yield Finding(
            "data.stuck_axis",
            sensor.rows(rows),
            f"{sensor.name}: {100 * np.mean(same):.0f} % of the rows repeat the row before them: the log is faster "
            "than the sensor, or samples were lost and filled in.",
        )


def _hung(sensor: Sensor, same: BoolArray) -> Rows:
    """Return the long runs (k, 2) of rows that repeat the row before them, where few others do."""
    long = _long(same, max(HUNG, _SHORTEST * sensor.rate))
    rows = np.sum(np.diff(long))
    others = (same.sum() - rows) / max(len(same) - rows, 1)
    return long if rows < 0.3 * len(same) and others < 0.1 else long[:0]


def _long(same: BoolArray, least: float) -> Rows:
    """Return the runs (k, 2) of True that are so long."""
    runs = runs_of(same)
    return runs[np.diff(runs)[:, 0] >= least]


def _repeating(runs: Rows) -> Rows:
    """Return the rows that repeat the one before, of runs (k, 2) of differences that are zero."""
    return np.concatenate([np.arange(start + 1, stop + 1) for start, stop in runs])
