"""`data.lost_samples`: samples that are missing although the stamps go on evenly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.mistakes.base import Samples, Sensor, block_medians
from jaximu.recordings.finding import Finding, Rows
from jaximu.recordings.recording import Recording

__all__ = ["TITLES", "find", "steps"]

TITLES = {"data.lost_samples": "lost samples"}

_HARM = 4.0
"""The same, from which on a lost sample matters though it cannot be seen."""
_CLEAR = 40.0
"""Squared standard deviations that one lost sample must make in both sensors together to be seen."""
_SAY = 36.0
"""The same of one sensor, from which on it must agree."""
_SURE = 14.0
"""Half the difference of squared misfits, without and with a lost sample, from which it counts as lost."""
_FEWEST = 4
_ROUNDS = 16
_MOST_PAIRS = 400
_JUMP = 12.0
"""Times the usual misfit that both sensors must jump by, at once and for good, where much is missing."""


def find(samples: Samples) -> list[Finding]:
    """Return the single samples lost in motion, and the jumps of motion where many were lost."""
    common = _common(samples)
    if common is None:
        return []
    found = _singles(common) or _reported(common, _jumps(common))
    if common is samples:
        return found
    time = next(iter(common.sensors.values())).time
    return [
        replace(finding, without={name: np.searchsorted(samples.sensors[name].time, time[rows])
                                  for name, rows in finding.without.items()})
        for finding in found
    ]  # fmt: skip


def _common(samples: Samples) -> Samples | None:
    """Return the samples that both sensors have at the same stamps: rows may have been left out of one of them."""
    accelerometer, gyroscope = samples.accelerometer, samples.gyroscope
    if accelerometer is None or gyroscope is None:
        return None
    if samples.shared:
        return samples if len(accelerometer) > 256 else None
    _, first, second = np.intersect1d(accelerometer.time, gyroscope.time, assume_unique=True, return_indices=True)
    if len(first) < max(256, 0.8 * max(len(accelerometer), len(gyroscope))):
        return None
    origin, signals = {}, {}
    for sensor, rows in ((accelerometer, first), (gyroscope, second)):
        origin[sensor.name] = sensor.origin[rows]
        signals[sensor.name] = replace(sensor.signal, time=sensor.time[rows], values=sensor.signal.values[rows])
    return Samples(replace(samples.recording, **signals), origin)


# --- single samples ---------------------------------------------------------------------------------------------------


def _evidence(samples: Samples, lost: FloatArray, wanted: Rows, reach: int) -> tuple[FloatArray, FloatArray]:
    """For the wanted intervals, what one lost sample would add, squared, over its noise, and that times the step that
    is seen there: (sensors, w) each. The step is that of a cubic through `reach` samples on either side, on the times
    that the samples `lost` (n − 1,) already known give them.
    """
    count = len(lost) + 1
    time = np.arange(count) + np.concatenate([[0.0], np.cumsum(lost)])
    rows = wanted[:, None] + np.arange(1 - reach, 1 + reach)
    known = lost[wanted]
    centre = (time[wanted] + time[wanted + 1]) / 2
    place = (time[rows] - centre[:, None]) / reach
    after = (np.arange(2 * reach) >= reach) * 1.0
    # without what is known of this interval itself
    place = place - (after - 0.5) * known[:, None] / reach
    design = np.stack([place**0, place, place**2, place**3, np.broadcast_to(after - 0.5, place.shape)], axis=2)
    normal = np.einsum("wji,wjk->wik", design, design)
    inverse = np.linalg.inv(normal + 1e-12 * np.eye(5))
    power, product = [], []
    for sensor in samples.sensors.values():
        values = sensor.values[rows]
        fitted = np.einsum("wik,wjk,wjm->wim", inverse, design, values)
        step, slope = fitted[:, 4], fitted[:, 1] / reach
        left = values - np.einsum("wji,wim->wjm", design, fitted)
        noise = np.maximum(sensor.noise**2, np.sum(left**2, axis=1) / (2 * reach - 5))
        variance = np.maximum(noise * inverse[:, 4, 4][:, None], 1e-300)
        power.append(np.sum(slope**2 / variance, axis=1))
        product.append(np.sum(slope * step / variance, axis=1))
    return np.array(power), np.array(product)


def _quickly(samples: Samples, wanted: Rows, reach: int) -> tuple[FloatArray, FloatArray]:
    """The same for evenly sampled sensors, by filters over what is near the intervals: nothing is known lost yet."""
    near = np.zeros(len(next(iter(samples.sensors.values()))), bool)
    for shift in range(1 - reach, 1 + reach):
        near[wanted + shift] = True
    place_of = np.cumsum(near)[wanted] - 1
    place = np.arange(2 * reach) - reach + 0.5
    after = (place > 0) - 0.5
    design = np.stack([place**0, place / reach, (place / reach) ** 2, (place / reach) ** 3, after], axis=1)
    weights = np.linalg.pinv(design)
    basis, _ = np.linalg.qr(design)
    power, product = [], []
    for sensor in samples.sensors.values():
        totals = np.zeros((2, len(wanted)))
        for axis in range(3):
            values = sensor.values[near, axis] - sensor.values[:, axis].mean()
            step, slope = (np.correlate(values, weights[k], "valid") for k in (4, 1))
            left = np.correlate(values**2, np.ones(2 * reach), "valid")
            for column in basis.T:
                left -= np.correlate(values, column, "valid") ** 2
            noise = np.maximum(sensor.noise[axis] ** 2, np.maximum(left, 0.0) / (2 * reach - 5))
            variance = np.maximum(noise * float(weights[4] @ weights[4]), 1e-300)
            slope = slope / reach
            both = np.stack([slope**2 / variance, slope * step / variance])
            totals += both[:, place_of - (reach - 1)]
        power.append(totals[0])
        product.append(totals[1])
    return np.array(power), np.array(product)


def _pairs(samples: Samples, known: FloatArray, places: Rows, reach: int, sure: float) -> Rows:
    """Return intervals near those given that, two by two, make the motion around smooth when a sample is put in."""
    if not len(places):
        return np.zeros(0, np.int64)
    groups = np.split(places, np.flatnonzero(np.diff(places) > reach) + 1)
    half = reach + 3
    found: list[int] = []
    if len(groups) > _MOST_PAIRS:
        return np.zeros(0, np.int64)
    for group in groups:
        centre = int(np.mean(group))
        if centre - half < 1 or centre + half + 1 >= len(known) or group[-1] - group[0] > 2 * reach:
            continue
        rows = np.arange(centre - half, centre + half + 2)
        middle = np.arange(max(group[0], centre - reach) - 1, min(group[-1], centre + reach) + 2)
        trials = [(), *((int(a), int(b)) for a in middle for b in middle if a < b <= a + reach)]
        losses = np.repeat(known[rows[:-1]][None], len(trials), axis=0)
        for trial, loss in zip(trials, losses, strict=True):
            for place in trial:
                loss[place - rows[0]] += 1
        time = np.arange(len(rows)) + np.hstack([np.zeros((len(trials), 1)), np.cumsum(losses, axis=1)])
        time = (time - time[:, half : half + 1]) / half
        design = np.stack([time**power for power in range(5)], axis=2)
        basis, _ = np.linalg.qr(design)
        cost = np.zeros(len(trials))
        for sensor in samples.sensors.values():
            values = (sensor.values[rows] - sensor.values[rows].mean(axis=0)) / np.maximum(sensor.noise, 1e-300)
            inside = np.einsum("tjk,jm->tkm", basis, values)
            cost += (np.sum(values**2) - np.sum(inside**2, axis=(1, 2))) / 2
        best = int(np.argmin(cost))
        if best and cost[0] - cost[best] > 2 * sure and cost[best] < 0.25 * cost[0]:
            found += trials[best]
    return np.unique(np.array(found, np.int64))


def _singles(samples: Samples) -> list[Finding]:
    sensor = next(iter(samples.sensors.values()))
    count = len(sensor)
    reach = int(np.clip(round(0.06 / sensor.period), 4, 24))
    moving = np.zeros(count - 1, bool)
    for each in samples.sensors.values():  # where something changes from sample to sample
        width = 2 * reach + 1
        mean = np.abs(each.values[width:] - each.values[:-width]) / width
        first = width // 2
        moving[first : first + len(mean)] |= (mean > 0.3 * each.noise).any(axis=1)
    for place in np.flatnonzero(~sensor.even):
        moving[max(0, place - reach) : place + reach + 1] = False
    moving[: reach + 2] = moving[-reach - 2 :] = False
    wanted = np.flatnonzero(moving)
    if len(wanted) < 50:
        return []
    known = np.zeros(count - 1)
    share, clear, power = np.zeros(len(wanted)), np.zeros(len(wanted), bool), np.zeros(len(wanted))
    sure, least = _SURE, _CLEAR
    for turn in range(_ROUNDS):  # a place that is known shows its neighbours
        if turn == 0:
            powers, products = _quickly(samples, wanted, reach)
        else:
            powers, products = _evidence(samples, known, wanted, reach)
        power, product = powers.sum(axis=0), products.sum(axis=0)
        clear = power > least
        share = np.where(clear, product / np.maximum(power, 1e-300), 0.0)
        whole = np.clip(np.round(share), 0, 5)
        # half the difference of the squared misfits without and with them; sensors that have a say must agree
        gain = (2 * whole * product - whole**2 * power) / 2
        agree = np.ones(len(wanted), bool)
        for p, q in zip(powers, products, strict=True):
            agree &= (p < _SAY) | (
                np.abs(q / np.maximum(p, 1e-300) - np.maximum(whole, 1)) < 0.5 * np.maximum(whole, 1)
            )
        found = clear & (whole >= 1) & (gain > sure) & agree
        # of neighbours the strongest first: it explains the others
        again = known[wanted] > 0
        best = np.zeros(count - 1)
        best[wanted[found & ~again]] = gain[found & ~again]
        wide = np.array([np.roll(best, shift) for shift in range(-reach, reach + 1)]).max(axis=0)
        strongest = found & (best[wanted] >= wide[wanted])
        update = np.zeros(count - 1)
        update[wanted[again & found]] = whole[again & found]
        update[wanted[strongest]] = whole[strongest]
        settled = np.array_equal(update, known)
        known = update
        if settled:  # two near one another hide each other: where something is still off, pairs are tried
            pairs = _pairs(
                samples, known, wanted[(power > 8) & (product > 0.3 * power) & (known[wanted] == 0)], reach, sure
            )
            if not len(pairs):
                break
            known[pairs] += 1
        if turn == 0:
            # motion that is not smooth enough is off either way, and samples are lost one way only
            opposite = wanted[clear & (share < -0.5) & (-product - power / 2 > _SURE)]
            against = 1 + int(np.sum(np.diff(opposite) > reach)) if len(opposite) else 0
            if np.sum(known > 0) < _FEWEST + 4 * against:
                return []
        # where losses are known to be frequent, less evidence will do for one more: the odds are (1 − r) : r before
        often = float(np.sum(known[wanted] > 0)) / max(int(clear.sum()), 1)
        sure = float(np.clip(np.log((1 - often) / max(often, 1e-6)) + 5.0, 7.0, _SURE))
        least = 2.6 * sure
    places = np.flatnonzero(known)
    if len(places) < _FEWEST:
        return []
    # where motion is not smooth enough, intervals are off by any share of a sample, not by whole ones alone
    alone = np.ones(count - 1, bool)
    for shift in range(-reach, reach + 1):
        alone[np.clip(places + shift, 0, count - 2)] = False
    alone = alone[wanted] & (power > 4 * _CLEAR)
    between, against = alone & (np.abs(share - 0.5) < 0.2), alone & (share < -0.7)
    if max(between.sum(), against.sum()) > 0.34 * len(places):
        return []
    rate = len(places) / max(int(clear.sum()), 1)
    later = np.concatenate([[0.0], np.cumsum(known)]) * sensor.period
    # what motion too slow to show a loss may still hide
    hidden = rate * float(np.sum(~clear & (power > _HARM)))

    def apply(recording: Recording) -> Recording:
        changed = {}
        for name, signal in recording.signals.items():
            at = np.clip(np.searchsorted(sensor.time, signal.time + 1e-9, "right") - 1, 0, len(later) - 1)
            changed[name] = replace(signal, time=signal.time + later[at])
        return replace(recording, **changed)

    return [Finding(
        "data.lost_samples", sensor.rows(places + 1),
        f"In {len(places)} places of the turns both sensors step further than before and after: about "
        f"{100 * rate:.2g} % of the samples were lost, and the rest were stamped as if none were. --repair puts the "
        f"lost time ({later[-1]:.3g} s in the turns) back into the stamps; log the sensor's own stamps or a counter."
        + (f" Some {hidden:.0f} more are too slow to be seen." if hidden > 2 else ""),
        repair="--repair", spoils=True, partial=True, apply=apply,
    )]  # fmt: skip


# --- many samples at once ---------------------------------------------------------------------------------------------


def steps(sensor: Sensor) -> FloatArray:
    """(n − 1,) how far lines through four samples before and four after an interval miss each other in its middle, in
    multiples of the noise and of what is usual around.
    """
    values = sensor.values
    count = len(values)
    # value at +0.5 after the last of four samples 0…3 of a least-squares line, and mirrored
    design = np.vander(np.arange(4.0), 2)
    weight = np.array([3.5, 1.0]) @ np.linalg.pinv(design)
    before = sum(w * values[k : count - 7 + k] for k, w in enumerate(weight))
    after = sum(w * values[4 + k : count - 3 + k] for k, w in enumerate(weight[::-1]))
    miss = np.zeros((count - 1, 3))
    miss[3:-3] = after - before
    broken = np.flatnonzero(~sensor.even)
    for shift in range(-4, 5):
        miss[np.clip(broken + shift, 0, count - 2)] = 0.0
    size = 16
    blocks = max(1, len(miss) // size)
    usual = 1.4826 * block_medians(np.abs(miss[: blocks * size]), blocks)
    wide = usual.copy()
    wide[1:], wide[:-1] = np.maximum(wide[1:], usual[:-1]), np.maximum(wide[:-1], usual[1:])
    scale = np.maximum(wide[np.minimum(np.arange(len(miss)) // size, blocks - 1)], 1.8 * sensor.noise)
    return np.max(np.abs(miss) / np.maximum(scale, 1e-300), axis=1)


def _jumps(samples: Samples) -> Rows:
    """Return the intervals at which both sensors jump at once and go on smoothly from there."""
    accelerometer, gyroscope = samples.accelerometer, samples.gyroscope
    assert accelerometer is not None and gyroscope is not None
    both = np.minimum(steps(accelerometer), steps(gyroscope))
    candidates = np.flatnonzero(both > _JUMP)
    if not len(candidates):
        return candidates
    # the sharpest of neighbouring intervals: the step itself, in both
    sharp = np.zeros(len(both))
    for sensor in (accelerometer, gyroscope):
        sharp += np.max(np.abs(sensor.difference) / np.maximum(sensor.noise, 1e-300), axis=1)
    groups = np.split(candidates, np.flatnonzero(np.diff(candidates) > 4) + 1)
    places = []
    for group in groups:
        a, b = max(8, group[0] - 3), min(len(both) - 8, group[-1] + 4)
        if b <= a:
            continue
        place = a + int(np.argmax(sharp[a:b]))
        if all(_clean(sensor, place) for sensor in (accelerometer, gyroscope)) and _turned(accelerometer, place):
            places.append(place)
    return np.array(places, np.int64)


def _turned(accelerometer: Sensor, place: int) -> bool:
    """Whether the specific force is turned by the jump and keeps its norm: a knock changes the norm."""
    before, after = (accelerometer.values[rows].mean(axis=0) for rows in
                     (slice(place - 3, place + 1), slice(place + 1, place + 5)))  # fmt: skip
    change = np.linalg.norm(after - before)
    return bool(abs(np.linalg.norm(after) - np.linalg.norm(before)) < 0.35 * change and change > 0.25)


def _clean(sensor: Sensor, place: int) -> bool:
    """Whether a sensor moves smoothly up to an interval and from it on, and jumps in it by far more than it bends."""
    before, after = sensor.values[place - 7 : place + 1], sensor.values[place + 1 : place + 9]
    if len(before) < 8 or len(after) < 8:
        return False
    design = np.vander(np.arange(8) / 8, 3)
    left = np.zeros(3)
    for part in (before, after):
        coefficients, *_ = np.linalg.lstsq(design, part, rcond=None)
        left = np.maximum(left, np.max(np.abs(part - design @ coefficients), axis=0))
    jump = np.abs(after[0] - before[-1] - ((before[-1] - before[-2]) + (after[1] - after[0])) / 2)
    axis = int(np.argmax(jump / np.maximum(sensor.noise, 1e-300)))
    least = 0.02 if sensor.name == "gyroscope" else 0.15
    slope = np.abs((before[-1] - before[-3]) + (after[2] - after[0])) / 4
    if jump[axis] < 2.7 * slope[axis]:  # one or two samples
        return False
    return bool(jump[axis] > max(5 * left[axis], least, 15 * sensor.noise[axis]))


def _reported(samples: Samples, jumps: Rows) -> list[Finding]:
    if not len(jumps):
        return []
    sensor = next(iter(samples.sensors.values()))
    if len(jumps) > max(20, 1e-3 * len(sensor)):
        return []
    # wide enough that the turn counts as interrupted
    reach = max(3, int(np.ceil(0.06 / sensor.period)))
    rows = np.unique(np.clip(jumps[:, None] + np.arange(1 - reach, 1 + reach), 0, len(sensor) - 1))
    where = ", ".join(sensor.at(int(place)) for place in jumps[:3]) + (" …" if len(jumps) > 3 else "")
    return [Finding(
        "data.lost_samples", sensor.rows(jumps + 1),
        f"At {where} both sensors jump in the middle of a motion: "
        "samples are missing there although the stamps go on evenly. The turns concerned are left out; how much time "
        "is missing cannot be determined from the samples.", rivals=("data.order", "data.duplicate"),
        without=dict.fromkeys(samples.sensors, rows),
    )]  # fmt: skip
