"""`data.mixed_devices`: rows, or columns, of two devices in one recording."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import robust_sigma
from jaximu.ground.vectors import lengths_of
from jaximu.mistakes.base import Samples, Sensor, leave_out_both, spans_of
from jaximu.mistakes.lost_samples import steps
from jaximu.recordings.alignment import carried, of_each, turning
from jaximu.recordings.finding import Finding

TITLES = {
    "data.mixed_devices": "sensors of different devices",
    "data.range": "another range",
    "data.units": "change of unit",
}

_RELATED = 0.6
"""Share of the turning of gravity that some gyroscope of this motion, however mounted, must explain: nine numbers
suit a few turns of another one to 0.4."""
_CLEARLY = 0.9
"""Share from which on there is nothing to ask."""
_FEWEST_TURNS, _LOST, _SURELY = 5, np.radians(45), np.radians(12)
"""Turns from rest to rest that must be whole, and the error, of three in four, beyond which gravity is lost over them
in any arrangement, and below which another scale carries it, among the many that are tried."""
_ANOTHER_SCALE = 3.0
"""Factor between angles from which on the scale of a gyroscope is another one."""
_SHIFT = 12.0
"""Standard deviations of the means at rest by which another device's bias must differ."""


def find(samples: Samples) -> Iterator[Finding]:
    """Return two sensors that never moved together, or one device's rows after another's."""
    yield from _unrelated(samples) or _changed(samples)


def _unrelated(samples: Samples) -> list[Finding]:
    if samples.both is None or not samples.posed:
        return []
    clocks = samples.clocks
    explained = 0.0 if clocks is None else clocks.explained
    if explained <= _CLEARLY:  # a line of lags may miss what no lag explains
        explained = max(explained, turning(*samples.outputs).explained)
    if explained > _CLEARLY:
        return []
    # accelerations on the way hide how gravity turns, and do not matter from rest to rest
    whole = carried(*samples.outputs, rests=samples.rests)
    if whole.turns < _FEWEST_TURNS:
        return []
    factor = abs(whole.factor)
    if whole.error < _SURELY and not 1 / _ANOTHER_SCALE < factor < _ANOTHER_SCALE:
        return [
            Finding(
                "data.range",
                (),
                f"The gyroscope reads {1 / factor:.2g} times the angles by which gravity turns in the accelerometer "
                f"from rest to rest, in {whole.turns} turns: its scale or unit is wrong. Check --gyro-scale, or the "
                "unit in the column name.",
                spoils=True,
                refuses="gyroscope",
            )
        ]
    if explained > _RELATED or whole.error < _LOST:
        return []
    return [
        Finding(
            "data.mixed_devices",
            (),
            f"The gyroscope, however it is mounted and delayed, explains {100 * explained:.0f} % of how "
            "gravity turns in the accelerometer: the two did not move together. Their columns come from different "
            "recordings or devices, or the gyroscope failed.",
            rivals=("data.clocks",),
            spoils=True,
            refuses="gyroscope",
        )
    ]


def _rests(accelerometer: Sensor, gyroscope: Sensor) -> FloatArray:
    """(k, 2) start and stop, s, of the rests of both sensors, by the noise of their time: devices differ in it."""
    still = np.ones(len(accelerometer), bool)
    for sensor in (accelerometer, gyroscope):
        _, mean, variance = sensor.blocks
        total = variance.sum(axis=1)
        chunk = 80
        floors = [np.quantile(total[k : k + chunk], 0.25) for k in range(0, max(1, len(total) - chunk // 2), chunk)]
        floor = np.array(floors)[np.minimum(np.arange(len(total)) // chunk, len(floors) - 1)]
        # a fast phase without any rest is not the noise of another device
        floor = np.clip(floor, 1e-30, 25 * np.percentile(total, 5) + 1e-30)
        calm = total <= 5 * floor
        leave_out_both(calm, lengths_of(np.diff(mean, axis=0)) > 6 * np.sqrt(np.minimum(floor[1:], floor[:-1])))
        still &= sensor.by_sample(calm)[sensor.next_to(accelerometer.time)]
    return spans_of(still, accelerometer.time, 0.7)


def _changed(samples: Samples) -> Iterator[Finding]:
    """A row from which on biases are others in both sensors at once, or biases and noise."""
    if samples.both is None:
        return
    accelerometer, gyroscope = samples.both
    if len(accelerometer) < 200:
        return
    rests = _rests(accelerometer, gyroscope)
    if len(rests) < 8:
        return
    means, noises = [], []
    for sensor in (accelerometer, gyroscope):
        edges = np.searchsorted(sensor.time, rests + [[0.1, -0.1]])
        means.append(of_each(np.mean, sensor.values, edges))
        noises.append(np.log(np.maximum(np.sqrt(of_each(np.mean, sensor.curvature**2, edges)), 1e-12)))
    norm = np.log(np.maximum(lengths_of(means[0]), 1e-9))[:, None]
    rate, noise = means[1], np.hstack(noises)
    distance, rest = _furthest(norm, 3, len(rests) - 2)
    factor = np.exp(np.median(norm[rest:]) - np.median(norm[:rest]))
    if not 0.6 < factor < 1.6 and distance > _SHIFT:
        yield Finding(
            "data.units",
            accelerometer.rows([int(np.searchsorted(accelerometer.time, rests[rest - 1, 1]))]),
            f"From about {rests[rest, 0]:.1f} s on, the accelerometer's norm at rest is {factor:.3g} times what it "
            "was before: the unit changes within the file, or the range does. Cut it there.",
            spoils=True,
            refuses="accelerometer",
        )
        return
    distance, rest = _furthest(rate, 3, len(rests) - 2)
    if distance < _SHIFT:
        return
    # somewhere about that rest both sensors step in one sample, or the noise changes with it
    window = slice(*np.searchsorted(gyroscope.time, [rests[rest - 2, 0] - 0.5, rests[rest + 1, 1]]))
    noisier, _ = _furthest(noise, max(3, rest - 1), min(rest + 2, len(rests) - 2))
    row = int(np.searchsorted(accelerometer.time, (rests[rest - 1, 1] + rests[rest, 0]) / 2))
    sudden = False
    if samples.shared:
        both = np.minimum(steps(accelerometer), steps(gyroscope))[window]
        sudden = len(both) > 0 and both.max() > 8.0
        row = window.start + int(np.argmax(both)) + 1 if sudden else row
    if not sudden and noisier < 5.0:
        return
    yield Finding(
        "data.mixed_devices",
        accelerometer.rows([row]),
        f"From about {accelerometer.time[row]:.1f} s on, the gyroscope's bias and "
        + ("the noise of both sensors" if noisier > 5.0 else "the accelerometer's output")
        + " are others: the rows before and after come from different devices or settings, or it was switched "
        "off in between. Cut the recording there.",
        spoils=True,
    )


def _furthest(values: FloatArray, first: int, stop: int) -> tuple[float, int]:
    """The largest distance of the medians before and after one of the rests from `first` on, and the rest."""
    distance = [_apart(values[:rest], values[rest:]) for rest in range(first, stop)]
    return max(distance), first + int(np.argmax(distance))


def _apart(before: FloatArray, after: FloatArray) -> float:
    """How far the medians of rests before and after lie apart, in robust standard deviations of one rest."""
    middle = np.median(before, axis=0), np.median(after, axis=0)
    spread = [robust_sigma(part - m, axis=0) for part, m in zip((before, after), middle, strict=True)]
    scale = np.maximum(np.maximum(*spread), 1e-9 * np.maximum(np.max(np.abs([*before, *after]), axis=0), 1e-300))
    return float(np.max(np.abs(middle[1] - middle[0]) / scale))
