"""`data.clipping` and `data.saturation`: a range too small for the motion, with a hard or with a soft limit."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaximu.ground.array_types import BoolArray, FloatArray
from jaximu.ground.quantities import size
from jaximu.mistakes.base import HUNG, Samples, Sensor
from jaximu.recordings.finding import Finding, Rows
from jaximu.recordings.recording import runs_of

TITLES = {"data.clipping": "clipped output", "data.saturation": "saturated turns"}

_FLAT = 0.36
"""Time within 5 % of an excursion's top over that above its half: 0.3 for a smooth turn, 0.6 and more when cut off."""
_ALIKE = 0.1
"""By how much that must differ among turns that were cut off: those of a table, which holds its rate, are all alike."""
_CURE = (
    "for this motion. The turns and poses concerned are left out; choose a larger range, or turn more slowly.",
    "for this field. These samples are left out; choose a larger range, or take away what magnetises the unit.",
)
"""What to do about it: of an accelerometer or gyroscope, of a magnetometer."""
_BY_CHANCE = 0.3
"""Share of samples like the one before up to which noise and steps make them alike."""
_FEWEST = 10
"""Excursions near the limit from which on it is a soft one."""


def find(samples: Samples) -> Iterator[Finding]:
    """Return the axes whose values stop at a limit, or crowd below one."""
    for name, sensor in samples.sensors.items():
        yield from _clipped(sensor) or (_saturated(samples, sensor) if name == "gyroscope" else [])


def _clipped(sensor: Sensor) -> list[Finding]:
    """Return the ends of the range at which a sensor's axes stop."""
    extremes = sensor.extremes
    axes = []
    ends = []
    limits, rows, all_out = [], np.zeros(len(sensor), bool), at_limits(sensor)
    for axis, extreme in zip(np.repeat(range(3), 2), extremes.T.ravel(), strict=True):
        values = sensor.values[:, axis]
        if np.ptp(values) <= 0 or sensor.coarse[axis] is not None:
            continue
        # rates of two axes, or of both ends of one, that stop at the same value to the last digit stop at the range
        alike = np.argwhere(np.isclose(np.abs(extremes), abs(extreme), rtol=1e-9, atol=0.0))
        longest = [np.max(np.diff(runs_of(sensor.values[:, k] == extremes[end, k]))) for end, k in alike]
        shared = sensor.name == "gyroscope" and sum(length > 1 for length in longest) > 1 and _crowded(values, extreme)
        runs = runs_of(values == extreme) if shared else stops(values, extreme)
        # a sensor that gave one row over and over, in which not every axis is at a limit, hung
        runs = runs[[b - a < HUNG or bool(all_out[a]) or bool(np.any(sensor.difference[a : b - 1])) for a, b in runs]]
        if len(runs):
            axes.append("xyz"[axis])
            ends.append(runs)
            shown = extreme * sensor.signal.nominal_scale[axis] + sensor.signal.nominal_offset[axis]
            limits.append(size(float(shown), sensor.signal.unit, 4))
            rows |= values == extreme
    if not ends:
        return []
    every = np.concatenate(ends)
    lengths = np.diff(every)
    return [
        Finding(
            "data.clipping",
            sensor.rows(np.sort(every[:, 0])),
            f"{sensor.name} {', '.join(dict.fromkeys(axes))}: {np.sum(lengths)} samples stop at "
            f"{' or '.join(dict.fromkeys(limits))}, up to {np.max(lengths)} in a row: its range is too small "
            + _CURE[sensor.name == "magnetometer"],
            without={sensor.name: np.flatnonzero(rows)},
        )
    ]


def at_limits(sensor: Sensor) -> BoolArray:
    """Return the rows (n,) in which every axis is at an end of what it reads in the recording."""
    return np.all((sensor.extremes[:, None] == sensor.values).any(axis=0), axis=1)


def _crowded(values: FloatArray, extreme: float) -> bool:
    """Whether no fewer samples lie at an extreme than at the level inside of it: those of rounded noise are rarer."""
    inside = values[(values > values.min()) & (values < values.max())]
    beside = inside.max(initial=-np.inf) if extreme == values.max() else inside.min(initial=np.inf)
    return len(inside) > 0 and bool(np.sum(values == extreme) >= np.sum(values == beside))


def stops(values: FloatArray, extreme: float) -> Rows:
    """Return runs (k, 2) of at least three samples at an extreme, where far more lie than at the levels next to it."""
    every = runs_of(values == extreme)
    lengths = np.diff(every)[:, 0]
    brief = np.max(lengths, initial=0) < 3 and np.sum(lengths) >= 10  # peaks of a sample or two at a low rate
    runs = every if brief else every[lengths >= 3]
    if not len(runs):
        return runs
    lengths = np.diff(runs)
    near = np.unique(values)
    near = near[-4:-1] if extreme == near[-1] else near[1:4]
    usual = max((int(np.sum(values == level)) for level in near), default=0)
    # one value held from one sample on to the end, or from the start, is a stuck axis
    whole = len(runs) == 1 and (runs[0, 0] == 0 or runs[0, 1] == len(values))
    # where other values are held as long, holding is this signal's way (a simulation without noise, say), unless they
    # are held by chance: coarse steps at rest
    inside = (values[1:] != values.max()) & (values[1:] != values.min())
    holds = (np.diff(values) == 0) & inside
    alone = np.max(np.diff(runs_of(holds)), initial=0) < np.max(lengths) / 2 or np.mean(holds) < _BY_CHANCE
    many = np.sum(lengths) >= max(6, (8 if brief else 4) * usual)
    return runs if many and (alone or brief) and not whole else runs[:0]


def _saturated(samples: Samples, sensor: Sensor) -> Iterator[Finding]:
    """Excursions of all axes that end just below one limit, and are the flatter the nearer they come to it."""
    quiet = samples.quiet_at(sensor)
    bias = np.median(sensor.values[quiet], axis=0) if quiet.any() else np.zeros(3)
    size = np.abs(sensor.values - bias)
    limit = np.sort(size.max(axis=1))[-max(3, len(size) // 5000)]
    if limit < 0.2 or limit < 100 * np.max(sensor.noise):
        return
    tops, flat, places = [], [], []
    for axis in range(3):
        for a, b in runs_of(size[:, axis] > 0.4 * limit):
            part = size[a:b, axis]
            if len(part) < 8:
                continue
            top = np.sort(part)[-max(1, len(part) // 20)]  # without the noise of single samples
            if top > 0.55 * limit:
                tops.append(top / limit)
                flat.append(np.sum(part > 0.95 * top) / max(1, np.sum(part > 0.5 * top)))
                places.append(a)
    if len(tops) < 3:
        return
    tops, flat = np.array(tops), np.array(flat)
    upper, middle, lower = tops > 0.85, (tops > 0.6) & (tops <= 0.85), tops < 0.75
    # hard: several excursions end flat at the limit itself, and hardly any below it
    crowd, elsewhere = (tops > 0.95) & (flat > 0.5), (tops < 0.9) & (flat > 0.5)
    hard = crowd.sum() >= 3 and elsewhere.sum() <= 0.34 * crowd.sum() and np.median(flat[crowd]) < 0.92
    hard = hard and np.ptp(flat[crowd]) > _ALIKE
    # soft: many come near it, and are the flatter the nearer they come; of a smooth motion the largest are the sharpest
    typical = np.median(flat[upper]) if upper.any() else 0.0
    soft = (
        upper.sum() >= max(_FEWEST, 0.25 * middle.sum())
        and lower.sum() > 2
        and _FLAT < typical < 0.9
        and np.quantile(flat[upper], 0.2) > 0.8 * _FLAT
        and typical > np.median(flat[lower]) - 0.005
    )
    if not hard and not soft:
        return
    # behind a hard limit the tops lie at it; a soft one spreads them
    hard = hard and (not soft or np.mean(tops[upper] > 0.965) > 0.75)
    shown, taken = f"{np.degrees(limit):.4g} °/s", crowd if hard else upper
    flattened = (
        f"{int(taken.sum())} quick turns end flat just below {shown}: the output was clipped there and smoothed "
        "afterwards. These turns are left out; choose a larger range, or turn more slowly."
    )
    compressed = (
        f"the tops of {int(taken.sum())} quick turns crowd below {shown}, and are the flatter the nearer they come to "
        "it: the output saturates, and slower turns are compressed, too. Choose a larger range, or turn more slowly, "
        "and record again."
    )
    rows, text = sensor.rows(np.sort(np.array(places)[taken])), f"gyroscope: {flattened if hard else compressed}"
    clipped = {"gyroscope": np.flatnonzero((size > 0.9 * limit).any(axis=1))} if hard else {}
    yield Finding("data.saturation", rows, text, spoils=not hard, without=clipped)
