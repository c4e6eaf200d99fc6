"""`data.stuck_axis`: an axis that repeats one value while others move; rows repeated at random."""

from __future__ import annotations

import numpy as np

from jaximu.mistakes.base import Finding, Samples, Sensor, coarse_step, runs_of
from jaximu.mistakes.clipping import stops
from jaximu.mistakes.resampled import held_at

__all__ = ["TITLES", "find"]

TITLES = {"data.stuck_axis": "stuck output"}

_STUCK = 0.5
"""Seconds for which an axis may repeat one value while others change."""


def find(samples: Samples) -> list[Finding]:
    """Return the axes that are stuck, and rows that repeat as a whole."""
    return [finding for sensor in samples.sensors.values() for finding in _stuck(sensor)]


def _stuck(sensor: Sensor) -> list[Finding]:
    change = sensor.difference != 0
    if not change.any():
        value = ", ".join(f"{each:.6g}" for each in sensor.values[0])
        return [Finding(
            "data.stuck_axis", (),
            f"{sensor.name}: every row reads {value}. Nothing was measured: check its wiring and its columns, and "
            "record again.", spoils=True, refuses=sensor.name,
        )]  # fmt: skip
    length = max(20, round(_STUCK * sensor.rate))
    found = []
    for axis in range(3):
        values = sensor.values[:, axis]
        if coarse_step(sensor, axis) is not None:
            continue
        others = change[:, [k for k in range(3) if k != axis]].any(axis=1)
        candidates = [run for run in runs_of(~change[:, axis]) if run[1] - run[0] >= length]
        if not candidates:
            continue
        limits = [tuple(run) for extreme in (values.max(), values.min()) for run in stops(values, extreme)]
        long = [
            run for run in candidates
            if others[run[0] : run[1]].mean() > 0.5 and not any(a <= run[0] and run[1] < b for a, b in limits)
        ]  # fmt: skip
        if long:
            first = np.array([run[0] for run in long])
            rows = np.concatenate([np.arange(run[0] + 1, run[1] + 1) for run in long])
            total = len(rows) / sensor.rate
            most = len(rows) > 0.5 * len(sensor)
            # without noise every axis repeats itself at rest, and nothing is wrong with that
            noisy = float(np.mean(~change[:, axis])) < 1.5 * len(rows) / len(sensor) + 0.2
            text = (
                f"{sensor.name} {'xyz'[axis]}: it repeats one value for {total:.3g} s in all, first after "
                f"{sensor.at(int(first[0]))}, while the other axes move on."
            )
            if most:
                text += " The axis is dead for most of the recording: check its wiring, and record again."
            elif noisy:
                text += " These rows are left out."
            found.append(Finding("data.stuck_axis", sensor.rows(first), text, spoils=most and noisy,
                                 without={sensor.name: rows} if noisy and not most else {}))  # fmt: skip
    same = ~change.any(axis=1)
    alone = float(np.min(np.mean(~change, axis=0)))
    repeats = max(0.02, 0.6 * alone) < np.mean(same) < 1
    if repeats and held_at(sensor) is None and all(coarse_step(sensor, axis) is None for axis in range(3)):
        rows = np.flatnonzero(same) + 1
        found.append(Finding(
            "data.stuck_axis", sensor.rows(rows),
            f"{sensor.name}: {100 * np.mean(same):.0f} % of the rows repeat the row before them: the log is faster "
            "than the sensor, or samples were lost and filled in.",
        ))  # fmt: skip
    return found
