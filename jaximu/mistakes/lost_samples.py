"""`data.lost_samples`: samples that are missing although the stamps go on evenly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaximu.mistakes.base import Finding, FloatArray, Rows, Samples, Sensor
from jaximu.recording import Recording

__all__ = ["find", "steps"]

_CLEAR = 40.0
"""Squared standard deviations that one lost sample must make in both sensors together to be told."""
_SAY = 36.0
"""The same of one sensor, from which on it must agree."""
_SURE = 14.0
"""Half the difference of squared misfits, without and with a lost sample, from which it counts as lost."""
_FEWEST = 3
_JUMP = 12.0
"""Times the usual misfit that both sensors must jump by, at once and for good, where much is missing."""


def find(samples: Samples) -> list[Finding]:
    """Return the single samples lost in motion, and the jumps of motion where many were lost."""
    sensors = list(samples.sensors.values())
    if len(sensors) < 2 or not samples.shared or len(sensors[0]) < 256:
        return []
    jumps = _jumps(samples)
    return [*_singles(samples, jumps), *_reported(samples, jumps)]


# --- single samples ---------------------------------------------------------------------------------------------------


def _evidence(sensor: Sensor, lost: FloatArray) -> tuple[FloatArray, FloatArray]:
    """For each interval (n − 1,): what one lost sample would add to it, squared, over its noise; and that times what it
    is longer than its neighbours' mean slope; summed over the axes. `lost`: samples already known to be lost.
    """
    difference = sensor.difference
    single = difference / (1 + lost)[:, None]
    slope = np.zeros_like(difference)
    slope[1:-1] = (single[:-2] + single[2:]) / 2
    excess = np.zeros_like(difference)
    excess[1:-1] = difference[1:-1] - slope[1:-1]
    noise = 5.0 * sensor.noise**2  # of (b − (a + c)/2), white noise in each sample
    # the motion's own curvature, where it is not smooth at this rate
    size = 16
    blocks = max(1, len(excess) // size)
    usual = 1.4826 * np.median(np.abs(excess[: blocks * size]).reshape(blocks, -1, 3), axis=1)
    wide = usual.copy()
    wide[1:], wide[:-1] = np.maximum(wide[1:], usual[:-1]), np.maximum(wide[:-1], usual[1:])
    variance = np.maximum(noise, wide[np.minimum(np.arange(len(excess)) // size, blocks - 1)] ** 2)
    variance = np.maximum(variance, 1e-300)
    even = sensor.even
    regular = np.zeros(len(even), bool)
    regular[1:-1] = even[1:-1] & even[:-2] & even[2:]
    weight = regular[:, None] / variance
    return np.sum(slope**2 * weight, 1), np.sum(slope * excess * weight, 1)


def _singles(samples: Samples, jumps: Rows) -> list[Finding]:
    sensors = list(samples.sensors.values())
    sensor = sensors[0]
    known = np.zeros(len(sensor) - 1)
    places, clear, share = np.zeros(0, np.int64), np.zeros(len(known), bool), np.zeros(len(known))
    power = np.zeros(len(known))
    for _ in range(3):  # a place that is known lets its neighbours be told
        parts = [_evidence(each, known) for each in sensors]
        power, product = (np.sum([part[k] for part in parts], axis=0) for k in (0, 1))
        clear = np.asarray(power > _CLEAR)
        clear[:4] = clear[-4:] = False
        for jump in jumps:
            clear[max(0, jump - 3) : jump + 4] = False
        share = np.where(clear, product / np.maximum(power, 1e-300), 0.0)
        whole = np.clip(np.round(share), 0, 3)
        # half the difference of the squared misfits without and with them; sensors that have a say must agree
        gain = (2 * whole * product - whole**2 * power) / 2
        agree = np.ones(len(known), bool)
        for part in parts:
            agree &= (part[0] < _SAY) | (np.abs(part[1] / np.maximum(part[0], 1e-300) - np.maximum(whole, 1)) < 0.45)
        places = np.flatnonzero(clear & (whole >= 1) & (gain > _SURE) & agree)
        if np.array_equal(np.flatnonzero(known), places):
            break
        known = np.where(np.isin(np.arange(len(known)), places), whole, 0.0)
    if len(places) < _FEWEST:
        return []
    # where motion is not smooth enough, intervals are off by any share of a sample, not by whole ones alone
    alone = clear & (power > 4 * _CLEAR)
    for shift in (-2, -1, 0, 1, 2):
        alone[np.clip(places + shift, 0, len(alone) - 1)] = False
    between, against = alone & (np.abs(share - 0.5) < 0.2), alone & (np.abs(share + 1) < 0.3)
    if max(between.sum(), against.sum()) > 0.34 * len(places):
        return []
    rate = len(places) / max(int(clear.sum()), 1)
    added = np.zeros(len(sensor))
    added[places + 1] = known[places]
    later = np.cumsum(added) * sensor.period

    def apply(recording: Recording) -> Recording:
        changed = {}
        for name, signal in recording.signals.items():
            at = np.clip(np.searchsorted(sensor.time, signal.time + 1e-9, "right") - 1, 0, len(later) - 1)
            changed[name] = replace(signal, time=signal.time + later[at])
        return replace(recording, **changed)

    return [Finding(
        "data.lost_samples", sensor.rows(places + 1),
        f"In {len(places)} places of the turns both sensors step twice as far as before and after: about "
        f"{100 * rate:.2g} % of the samples were lost, and the rest were stamped as if none were. --repair puts the "
        f"lost time ({later[-1]:.3g} s in the turns) back into the stamps; log the sensor's own stamps or a counter.",
        repair="--repair", spoils=True, apply=apply,
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
    usual = 1.4826 * np.median(np.abs(miss[: blocks * size]).reshape(blocks, -1, 3), axis=1)
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
        "is missing cannot be told from the samples.", rivals=("data.order", "data.duplicate"),
        without=dict.fromkeys(samples.sensors, rows),
    )]  # fmt: skip
