"""`data.wrap`: values that left the range of an integer and came back in at its other end."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.quantities import counted
from jaximu.mistakes.base import Samples, Sensor, with_signal
from jaximu.recordings.finding import Finding, Rows
from jaximu.recordings.recording import Recording

TITLES = {"data.wrap": "integer overflow"}

_AT_THE_OTHER_END = 0.8
"""Share of the samples that overflowed which come back in the half of the range that they did not leave by."""


def find(samples: Samples) -> Iterator[Finding]:
    """Return the axes that jump by their whole range and back."""
    for name, sensor in samples.sensors.items():
        for axis in range(3):
            wrapped = _wrapped(sensor, axis)
            if wrapped is None:
                continue
            turns, full, rows = wrapped
            # in the unit of the output: the recording keeps it
            added = turns * full * sensor.signal.nominal_scale[axis]

            def apply(recording: Recording, name: str = name, axis: int = axis, added: FloatArray = added) -> Recording:
                values = np.array(getattr(recording, name).values)
                values[:, axis] += added
                return with_signal(recording, name, values=values)

            shown = f"{np.degrees(full):.4g} °/s" if name == "gyroscope" else f"{full:.4g} m/s²"
            yield Finding(
                "data.wrap",
                sensor.rows(rows),
                f"{name} {'xyz'[axis]}: {counted(len(rows), 'sample')} jumped by the whole range of {shown} and "
                f"back, first after {sensor.at(rows[0])}: the integer overflowed. --repair adds the range "
                "back; without it these rows are left out.",
                repair="--repair",
                apply=apply,
                without={name: rows},
            )


def _wrapped(sensor: Sensor, axis: int) -> tuple[FloatArray, float, Rows] | None:
    """Return for each row how many ranges to add (n,), the range, and the rows that are off; None where there is none.

    A range differs from a jump of the motion: both ends of it lie at the ends of the range.
    """
    values = sensor.values[:, axis]
    low, high = values.min(), values.max()
    span = high - low
    jump = sensor.difference[:, axis]
    places = np.flatnonzero(np.abs(jump) > 0.6 * span)
    if len(places) < 2 or len(places) > 0.02 * len(values) or span < 100 * sensor.noise[axis]:
        return None
    middle = (low + high) / 2
    ends = np.minimum(np.abs(values[places] - middle), np.abs(values[places + 1] - middle))
    places = places[ends > 0.3 * span]
    if len(places) < 2:
        return None
    before = np.where(np.isin(places - 1, places) | (places < 1), np.nan, jump[np.maximum(places - 1, 0)])
    after = np.where(
        np.isin(places + 1, places) | (places + 1 >= len(jump)), np.nan, jump[np.minimum(places + 1, len(jump) - 1)]
    )
    known = ~(np.isnan(before) & np.isnan(after))
    slope = np.where(known, np.nanmean(np.where(known, [before, after], 0.0), axis=0), 0.0)
    ranges = np.abs(jump[places] - slope)
    full = np.median(ranges)
    off = np.abs(ranges - full) / full
    if not known.any() or np.quantile(off, 0.8) > 0.12 or np.max(off) > 0.4 or full < 0.95 * span:
        return None
    full = _of_an_integer(sensor, axis, full)
    count = np.zeros(len(values))
    count[places + 1] = -np.sign(jump[places])
    turns = np.cumsum(count)
    # it starts and ends within the range, and never goes beyond the next one
    turns -= np.round(np.median(turns))
    rows = np.flatnonzero(turns)
    if turns[-1] != 0 or turns[0] != 0 or np.max(np.abs(turns)) > 1 or len(rows) > 0.4 * len(values):
        return None
    if np.mean((values[rows] - middle) * turns[rows] < 0) < _AT_THE_OTHER_END:  # vibration may jump as far and back
        return None
    # what overflowed lay beyond all that did not, put back: the sensor leaves its range there and nowhere else
    inside = values[turns == 0]
    if not _beyond(values + turns * full, turns, float(inside.min()), float(inside.max()), sensor.noise[axis]):
        return None
    return turns, full, rows


def _beyond(restored: FloatArray, turns: FloatArray, low: float, high: float, noise: float) -> bool:
    """Whether values put back lie beyond the ends, low and high, of those that did not overflow."""
    over = np.concatenate([restored[turns > 0] - high, low - restored[turns < 0]])
    return bool(np.min(over) > -0.01 * (high - low) - 3 * noise and np.max(over) > 3 * noise)


def _of_an_integer(sensor: Sensor, axis: int, full: float) -> float:
    """The range as a power of two of the step, where it is near one."""
    step = 1.0 / sensor.signal.nominal_scale[axis] if sensor.signal.unit == "count" else sensor.step[axis]
    if step <= 0 or not 50 < full / step < 2**25:
        return full
    exact = float(2.0 ** np.round(np.log2(full / step)) * step)
    return exact if abs(exact / full - 1) < 0.05 else full
