"""`data.lost_samples`: samples that are missing although the stamps go on evenly."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaximu.ground.array_types import BoolArray, FloatArray
from jaximu.mistakes.base import Samples, Sensor, scale_around
from jaximu.recordings.finding import NO_ROWS, Finding, Rows
from jaximu.recordings.recording import Recording

TITLES = {"data.lost_samples": "lost samples"}

_HARM = 4.0
"""The same, from which on a lost sample matters though it cannot be seen."""
_CLEAR = 40.0
"""Squared standard deviations that one lost sample must make in both sensors together to be seen."""
_SAY = 36.0
"""The same of one sensor, from which on it must agree."""
_SURE = 14.0
"""Half the difference of squared misfits, without and with a lost sample, from which it counts as lost."""
_BESIDE = 0.06
"""Seconds on either side of an interval whose samples are compared."""
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
    findings = _singles(common) or _reported(common, _jumps(*common.sensors.values()))
    time = common.first.time

    def rows_of(name: str, rows: Rows) -> Rows:
        return np.searchsorted(samples.sensors[name].time, time[rows])

    return [
        replace(finding, without={name: rows_of(name, rows) for name, rows in finding.without.items()})
        for finding in findings
    ]


def _common(samples: Samples) -> Samples | None:
    """Return the samples that both sensors have at the same stamps: rows may have been left out of one of them."""
    if samples.both is None:
        return None
    accelerometer, gyroscope = samples.both
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


def _evidence(samples: Samples, lost: FloatArray, wanted: Rows, half: int) -> tuple[FloatArray, FloatArray]:
    """For the wanted intervals, what one lost sample would add, squared, over its noise, and that times the step that
    is seen there: (sensors, w) each. The step is that of a cubic through `half` samples on either side, on the times
    that the samples `lost` (n − 1,) already known give them.
    """
    time = np.arange(len(lost) + 1) + np.cumulative_sum(lost, include_initial=True)
    rows = wanted[:, None] + np.arange(1 - half, 1 + half)
    centre = (time[wanted] + time[wanted + 1]) / 2
    side = np.repeat([-0.5, 0.5], half)
    # without what is known of this interval itself
    offset = (time[rows] - centre[:, None] - side * lost[wanted][:, None]) / half
    design = np.stack([offset**0, offset, offset**2, offset**3, np.broadcast_to(side, offset.shape)], axis=2)
    inverse = np.linalg.inv(np.einsum("wji,wjk->wik", design, design) + 1e-12 * np.eye(5))
    power, product = [], []
    for sensor in samples.sensors.values():
        values = sensor.values[rows]
        fitted = np.einsum("wik,wjk,wjm->wim", inverse, design, values)
        step, slope = fitted[:, 4], fitted[:, 1] / half
        residual = values - np.einsum("wji,wim->wjm", design, fitted)
        noise = np.maximum(sensor.noise**2, np.sum(residual**2, axis=1) / (2 * half - 5))
        variance = np.maximum(noise * inverse[:, 4, 4][:, None], 1e-300)
        power.append(np.sum(slope**2 / variance, axis=1))
        product.append(np.sum(slope * step / variance, axis=1))
    return np.array(power), np.array(product)


def _quickly(samples: Samples, wanted: Rows, half: int) -> tuple[FloatArray, FloatArray]:
    """The same for evenly sampled sensors, by filters over what is near the intervals: nothing is known lost yet."""
    near = np.zeros(len(samples.first), bool)
    near[wanted[:, None] + np.arange(1 - half, 1 + half)] = True
    index = np.cumsum(near)[wanted] - half  # of the filters' outputs
    offset = (np.arange(2 * half) - half + 0.5) / half
    design = np.column_stack([np.vander(offset, 4, increasing=True), np.sign(offset) / 2])
    weights = np.linalg.pinv(design)
    basis, _ = np.linalg.qr(design)
    power, product = [], []
    for sensor in samples.sensors.values():
        totals = np.zeros((2, len(wanted)))
        for axis in range(3):
            values = sensor.values[near, axis] - sensor.values[:, axis].mean()
            step, slope = (np.correlate(values, weight, "valid") for weight in (weights[4], weights[1] / half))
            residual = np.correlate(values**2, np.ones(2 * half), "valid")
            for column in basis.T:
                residual -= np.correlate(values, column, "valid") ** 2
            noise = np.maximum(sensor.noise[axis] ** 2, residual / (2 * half - 5))
            variance = np.maximum(noise * float(weights[4] @ weights[4]), 1e-300)
            totals += np.stack([slope**2 / variance, slope * step / variance])[:, index]
        power.append(totals[0])
        product.append(totals[1])
    return np.array(power), np.array(product)


def _pairs(samples: Samples, lost: FloatArray, intervals: Rows, half: int, sure: float) -> Rows:
    """Return intervals near those given that, two by two, make the motion around smooth when a sample is put in."""
    pairs = []
    groups = np.split(intervals, np.flatnonzero(np.diff(intervals) > half) + 1) if len(intervals) else []
    if len(groups) > _MOST_PAIRS:
        return NO_ROWS
    for group in groups:
        centre, width = int(np.mean(group)), half + 3
        if centre - width < 1 or centre + width + 1 >= len(lost) or group[-1] - group[0] > 2 * half:
            continue
        rows = np.arange(centre - width, centre + width + 2)
        middle = np.arange(max(group[0], centre - half) - 1, min(group[-1], centre + half) + 2)
        trials = [(), *((int(a), int(b)) for a in middle for b in middle if a < b <= a + half)]
        losses = np.repeat(lost[rows[:-1]][None], len(trials), axis=0)
        for trial, loss in zip(trials, losses, strict=True):
            for interval in trial:
                loss[interval - rows[0]] += 1
        time = np.arange(len(rows)) + np.cumulative_sum(losses, axis=1, include_initial=True)
        time = (time - time[:, width : width + 1]) / width
        basis, _ = np.linalg.qr(np.stack([time**power for power in range(5)], axis=2))
        cost = np.zeros(len(trials))
        for sensor in samples.sensors.values():
            values = (sensor.values[rows] - sensor.values[rows].mean(axis=0)) / np.maximum(sensor.noise, 1e-300)
            inside = np.einsum("tjk,jm->tkm", basis, values)
            cost += (np.sum(values**2) - np.sum(inside**2, axis=(1, 2))) / 2
        best = np.argmin(cost)
        if best and cost[0] - cost[best] > 2 * sure and cost[best] < 0.25 * cost[0]:
            pairs += trials[best]
    return np.unique(np.array(pairs, np.int64))


def _in_motion(samples: Samples, half: int) -> Rows:
    """Return the intervals around which a sensor changes from sample to sample; none near gaps and ends."""
    first = samples.first
    moving = np.zeros(len(first) - 1, bool)
    for sensor in samples.sensors.values():
        width = 2 * half + 1
        mean = np.abs(sensor.values[width:] - sensor.values[:-width]) / width
        moving[half : half + len(mean)] |= (mean > 0.3 * sensor.noise).any(axis=1)
    for gap in np.flatnonzero(~first.even):
        moving[max(0, gap - half) : gap + half + 1] = False
    moving[: half + 2] = moving[-half - 2 :] = False
    return np.flatnonzero(moving)


class _Losses(NamedTuple):
    """What intervals lost: `lost` (n − 1,) samples in each. Of the wanted ones, (w,) each: whether one lost sample
    would be seen, its squared size over the noise, and the size of the step that is seen there, in samples.
    """

    lost: FloatArray
    clear: BoolArray
    power: FloatArray
    step: FloatArray


def _losses(samples: Samples, wanted: Rows, half: int) -> _Losses | None:
    """Find the lost samples, the clearest first: a place that is known shows its neighbours. None for too few."""
    lost = np.zeros(len(samples.first) - 1)
    sure, least = _SURE, _CLEAR
    powers, products = _quickly(samples, wanted, half)
    for turn in range(_ROUNDS):
        if turn > 0:
            powers, products = _evidence(samples, lost, wanted, half)
        power, product = powers.sum(axis=0), products.sum(axis=0)
        clear = power > least
        step = np.where(clear, product / np.maximum(power, 1e-300), 0.0)
        whole = np.clip(np.round(step), 0, 5)
        # half the difference of the squared misfits without and with them; sensors that have a say must agree
        gain = (2 * whole * product - whole**2 * power) / 2
        one = np.maximum(whole, 1)
        agree = np.all((powers < _SAY) | (np.abs(products / np.maximum(powers, 1e-300) - one) < 0.5 * one), axis=0)
        good = clear & (whole >= 1) & (gain > sure) & agree
        # of neighbours the strongest first: it explains the others
        known = lost[wanted] > 0
        best = np.zeros(len(lost))
        best[wanted[good & ~known]] = gain[good & ~known]
        wide = np.array([np.roll(best, shift) for shift in range(-half, half + 1)]).max(axis=0)
        taken = good & (known | (best[wanted] >= wide[wanted]))
        update = np.zeros(len(lost))
        update[wanted[taken]] = whole[taken]
        settled = np.array_equal(update, lost)
        lost = update
        if settled:  # two near one another hide each other: where something is still off, pairs are tried
            off = (power > 8) & (product > 0.3 * power) & (lost[wanted] == 0)
            pairs = _pairs(samples, lost, wanted[off], half, sure)
            if not len(pairs):
                break
            lost[pairs] += 1
        if turn == 0:
            # motion that is not smooth enough is off either way, and samples are lost one way only
            opposite = wanted[clear & (step < -0.5) & (-product - power / 2 > _SURE)]
            against = 1 + int(np.sum(np.diff(opposite) > half)) if len(opposite) else 0
            if np.sum(lost > 0) < _FEWEST + 4 * against:
                return None
        # where losses are known to be frequent, less evidence will do for one more: the odds are (1 − r) : r before
        often = np.sum(lost[wanted] > 0) / max(int(clear.sum()), 1)
        sure = np.clip(np.log((1 - often) / max(often, 1e-6)) + 5.0, 7.0, _SURE)
        least = 2.6 * sure
    # motion that is not smooth enough makes steps of any size in the other intervals, too
    missing, places = lost[wanted], lost[wanted] > 0
    if np.sum(places) < _FEWEST:
        return None
    scatter = np.mean((product**2 / np.maximum(power, 1e-300))[clear & ~places]) if (clear & ~places).any() else 1.0
    gains = (2 * missing * product - missing**2 * power)[places] / 2
    return _Losses(lost, clear, power, step) if np.median(gains) > _SURE * max(scatter, 1.0) else None


def _singles(samples: Samples) -> list[Finding]:
    """Return the single samples lost in motion."""
    sensor = samples.first
    half = int(np.clip(round(_BESIDE / sensor.period), 4, 24))
    wanted = _in_motion(samples, half)
    losses = _losses(samples, wanted, half) if len(wanted) >= 50 else None
    if losses is None:
        return []
    lost, clear, power, step = losses
    places = np.flatnonzero(lost)
    # where motion is not smooth enough, intervals are off by any share of a sample, not by whole ones alone
    alone = np.ones(len(lost), bool)
    alone[np.clip(places[:, None] + np.arange(-half, half + 1), 0, len(lost) - 1)] = False
    alone = alone[wanted] & (power > 4 * _CLEAR)
    between, against = alone & (np.abs(step - 0.5) < 0.2), alone & (step < -0.7)
    if max(between.sum(), against.sum()) > 0.34 * len(places):
        return []
    rate = len(places) / max(int(clear.sum()), 1)
    later = np.cumulative_sum(lost, include_initial=True) * sensor.period
    # what motion too slow to show a loss may still hide
    hidden = rate * np.sum(~clear & (power > _HARM))

    def apply(recording: Recording) -> Recording:
        changed = {}
        for name, signal in recording.signals.items():
            at = np.clip(np.searchsorted(sensor.time, signal.time + 1e-9, "right") - 1, 0, len(later) - 1)
            changed[name] = replace(signal, time=signal.time + later[at])
        return replace(recording, **changed)

    return [
        Finding(
            "data.lost_samples",
            sensor.rows(places + 1),
            f"In {len(places)} places of the turns both sensors step further than before and after: about "
            f"{100 * rate:.2g} % of the samples were lost, and the rest were stamped as if none were. --repair puts "
            f"the lost time ({later[-1]:.3g} s in the turns) back into the stamps; log the sensor's own stamps or a "
            f"counter." + (f" Some {hidden:.0f} more are too slow to be seen." if hidden > 2 else ""),
            repair="--repair",
            spoils=True,
            partial=True,
            apply=apply,
        )
    ]


# --- many samples at once ---------------------------------------------------------------------------------------------


def steps(sensor: Sensor) -> FloatArray:
    """(n − 1,) how far lines through four samples before and four after an interval miss each other in its middle, in
    multiples of the noise and of what is usual around.
    """
    # value at +0.5 after the last of four samples 0…3 of a least-squares line, and mirrored
    weight = np.array([3.5, 1.0]) @ np.linalg.pinv(np.vander(np.arange(4.0), 2))
    windows = np.lib.stride_tricks.sliding_window_view(sensor.values, 4, axis=0)
    miss = np.zeros_like(sensor.difference)
    miss[3:-3] = windows[4:] @ weight[::-1] - windows[:-4] @ weight
    miss[np.clip(np.flatnonzero(~sensor.even)[:, None] + np.arange(-4, 5), 0, len(miss) - 1)] = 0.0
    scale = np.maximum(scale_around(miss, before=False), 1.8 * sensor.noise)
    return np.max(np.abs(miss) / np.maximum(scale, 1e-300), axis=1)


def _jumps(accelerometer: Sensor, gyroscope: Sensor) -> Rows:
    """Return the intervals at which both sensors jump at once and go on smoothly from there."""
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
        index = a + int(np.argmax(sharp[a:b]))
        if all(_clean(sensor, index) for sensor in (accelerometer, gyroscope)) and _turned(accelerometer, index):
            places.append(index)
    return np.array(places, np.int64)


def _turned(accelerometer: Sensor, index: int) -> bool:
    """Whether the specific force is turned by the jump and keeps its norm: a knock changes the norm."""
    before, after = accelerometer.values[index - 3 : index + 5].reshape(2, 4, 3).mean(axis=1)
    change = np.linalg.norm(after - before)
    return bool(abs(np.linalg.norm(after) - np.linalg.norm(before)) < 0.35 * change and change > 0.25)


def _clean(sensor: Sensor, index: int) -> bool:
    """Whether a sensor moves smoothly up to an interval and from it on, and jumps in it by far more than it bends."""
    before, after = parts = sensor.values[index - 7 : index + 9].reshape(2, 8, 3)
    basis, _ = np.linalg.qr(np.vander(np.arange(8) / 8, 3))
    bend = np.max(np.abs(parts - basis @ (basis.T @ parts)), axis=(0, 1))
    jump = np.abs(after[0] - before[-1] - ((before[-1] - before[-2]) + (after[1] - after[0])) / 2)
    axis = np.argmax(jump / np.maximum(sensor.noise, 1e-300))
    least = 0.02 if sensor.name == "gyroscope" else 0.15
    slope = np.abs((before[-1] - before[-3]) + (after[2] - after[0])) / 4
    if jump[axis] < 2.7 * slope[axis]:  # one or two samples
        return False
    return bool(jump[axis] > max(5 * bend[axis], least, 15 * sensor.noise[axis]))


def _reported(samples: Samples, jumps: Rows) -> Iterator[Finding]:
    sensor = samples.first
    if not 0 < len(jumps) <= max(20, 1e-3 * len(sensor)):
        return
    # wide enough that the turn counts as interrupted
    half = max(3, int(np.ceil(_BESIDE / sensor.period)))
    rows = np.unique(np.clip(jumps[:, None] + np.arange(1 - half, 1 + half), 0, len(sensor) - 1))
    where = ", ".join(sensor.at(jump) for jump in jumps[:3]) + (" …" if len(jumps) > 3 else "")
    yield Finding(
        "data.lost_samples",
        sensor.rows(jumps + 1),
        f"At {where} both sensors jump in the middle of a motion: "
        "samples are missing there although the stamps go on evenly. The turns concerned are left out; how much "
        "time is missing cannot be determined from the samples.",
        rivals=("data.order", "data.duplicate"),
        without=dict.fromkeys(samples.sensors, rows),
    )
