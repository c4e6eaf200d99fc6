"""`data.mixed_devices`: rows, or columns, of two devices in one recording."""

from __future__ import annotations

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.mistakes.base import Samples, runs_of
from jaximu.mistakes.lost_samples import steps
from jaximu.recordings.finding import Finding

__all__ = ["TITLES", "find"]

TITLES = {"data.mixed_devices": "sensors of different devices", "data.units": "change of unit"}

_RELATED = 0.4
"""Share of the turning of gravity that some gyroscope of this motion, however mounted, must explain."""
_SHIFT = 12.0
"""Standard deviations of the means at rest by which another device's bias must differ."""


def find(samples: Samples) -> list[Finding]:
    """Return two sensors that never moved together, or one device's rows after another's."""
    return _unrelated(samples) or _changed(samples)


def _unrelated(samples: Samples) -> list[Finding]:
    blocks = samples.turning
    if blocks is None:
        return []
    seen, force, turned, time = blocks.change, blocks.force, blocks.turned(), blocks.centre[:-1]
    moving = np.linalg.norm(seen, axis=1) > 0.5
    turning_gyroscope = np.linalg.norm(turned, axis=1) > 0.05
    rests = samples.rests
    if moving.sum() < 20 or turning_gyroscope.sum() < 20 or len(seen) < 100 or not samples.posed:
        return []
    # a vehicle's specific force does not turn with it: only turns from pose to pose count, and slow ones, in which
    # the norm stays that of gravity
    norm = np.linalg.norm(force, axis=1)
    later = np.clip(np.searchsorted(rests[:, 0], time), 1, len(rests) - 1)
    between = (rests[later, 0] - rests[later - 1, 1] < 10.0) & (time > rests[0, 0]) & (time < rests[-1, 1])
    usable = (np.abs(norm / np.median(norm) - 1) < 0.08) & between
    if (moving & usable).sum() < 20:
        return []
    found = samples.clocks
    if found is None or found.explained > _RELATED:
        return []
    best = found.explained
    return [Finding(
        "data.mixed_devices", (),
        f"The gyroscope, however it is mounted and delayed, explains {100 * best:.0f} % of how gravity turns in the "
        "accelerometer: the two did not move together. Their columns come from different recordings or devices.",
        rivals=("data.clocks",), spoils=True, refuses="gyroscope",
    )]  # fmt: skip


def _rests(samples: Samples) -> FloatArray:
    """(k, 2) start and stop, s, of the rests of both sensors, by the noise of their time: devices differ in it."""
    still = []
    accelerometer = samples.accelerometer
    assert accelerometer is not None
    for sensor in samples.sensors.values():
        first, mean, variance = sensor.blocks
        total = variance.sum(axis=1)
        chunk = 80
        floors = [np.quantile(total[k : k + chunk], 0.25) for k in range(0, max(1, len(total) - chunk // 2), chunk)]
        floor = np.array(floors)[np.minimum(np.arange(len(total)) // chunk, len(floors) - 1)]
        # a fast phase without any rest is not the noise of another device
        floor = np.clip(floor, 1e-30, 25 * np.percentile(total, 5) + 1e-30)
        calm = total <= 5 * floor
        moved = np.linalg.norm(np.diff(mean, axis=0), axis=1) > 6 * np.sqrt(np.minimum(floor[1:], floor[:-1]))
        calm[1:] &= ~moved
        calm[:-1] &= ~moved
        size = first[1] - first[0] if len(first) > 1 else len(sensor)
        flags = calm[np.minimum(np.arange(len(sensor)) // size, len(calm) - 1)]
        at = np.clip(np.searchsorted(sensor.time, accelerometer.time), 0, len(sensor) - 1)
        still.append(flags[at])
    runs = runs_of(np.all(still, axis=0))
    time = accelerometer.time
    spans = np.stack([time[runs[:, 0]], time[np.minimum(runs[:, 1], len(time) - 1)]], axis=1)
    return spans[spans[:, 1] - spans[:, 0] >= 0.7]


def _changed(samples: Samples) -> list[Finding]:
    """A row from which on biases are others in both sensors at once, or biases and noise."""
    accelerometer, gyroscope = samples.accelerometer, samples.gyroscope
    if accelerometer is None or gyroscope is None or len(accelerometer) < 200:
        return []
    rests = _rests(samples)
    if len(rests) < 8:
        return []
    means, noises = [], []
    for sensor in (accelerometer, gyroscope):
        edges = np.searchsorted(sensor.time, rests + [[0.1, -0.1]])
        means.append(np.stack([sensor.values[a : max(b, a + 1)].mean(axis=0) for a, b in edges]))
        size = np.stack([np.sqrt(np.mean(sensor.curvature[a : max(b, a + 1)] ** 2, axis=0)) for a, b in edges])
        noises.append(np.log(np.maximum(size, 1e-12)))
    norm = np.log(np.maximum(np.linalg.norm(means[0], axis=1), 1e-9))[:, None]
    rate, noise = means[1], np.hstack(noises)
    places = range(3, len(rests) - 2)
    unit = [_apart(norm, k) for k in places]
    place = places[int(np.argmax(unit))]
    factor = float(np.exp(np.median(norm[place:]) - np.median(norm[:place])))
    if not 0.6 < factor < 1.6 and max(unit) > _SHIFT:
        return [Finding(
            "data.units", accelerometer.rows([int(np.searchsorted(accelerometer.time, rests[place - 1, 1]))]),
            f"From about {rests[place, 0]:.1f} s on, the accelerometer's norm at rest is {factor:.3g} times what it "
            "was before: the unit changes within the file. Cut it there.", spoils=True, refuses="accelerometer",
        )]  # fmt: skip
    apart = [_apart(rate, k) for k in places]
    place = places[int(np.argmax(apart))]
    if max(apart) < _SHIFT:
        return []
    # somewhere about that rest both sensors step in one sample, or the noise changes with it
    start = max(0, place - 2)
    window = slice(*np.searchsorted(gyroscope.time, [rests[start, 0] - 0.5, rests[min(place + 1, len(rests) - 1), 1]]))
    noisier = max(_apart(noise, k) for k in range(max(3, place - 1), min(place + 2, len(rests) - 2)))
    row = int(np.searchsorted(accelerometer.time, (rests[place - 1, 1] + rests[place, 0]) / 2))
    sudden = False
    if samples.shared:
        both = np.minimum(steps(accelerometer), steps(gyroscope))[window]
        sudden = len(both) > 0 and float(both.max()) > 8.0
        row = window.start + int(np.argmax(both)) + 1 if sudden else row
    if not sudden and noisier < 5.0:
        return []
    return [Finding(
        "data.mixed_devices", accelerometer.rows([row]),
        f"From about {accelerometer.time[row]:.1f} s on, the gyroscope's bias and "
        + ("the noise of both sensors" if noisier > 5.0 else "the accelerometer's output")
        + " are others: the rows before and after come from different devices, or settings. Cut the recording there.",
        spoils=True,
    )]  # fmt: skip


def _apart(values: FloatArray, place: int) -> float:
    """How far the medians before and after a place lie apart, in robust standard deviations of one rest."""
    before, after = values[:place], values[place:]
    middle = np.median(before, axis=0), np.median(after, axis=0)
    spread = [1.4826 * np.median(np.abs(part - m), axis=0) for part, m in zip((before, after), middle, strict=True)]
    scale = np.maximum(np.maximum(*spread), 1e-9 * np.maximum(np.max(np.abs(values), axis=0), 1e-300))
    return float(np.max(np.abs(middle[1] - middle[0]) / scale))
