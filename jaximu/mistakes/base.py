"""The views of a recording's samples that all checks share. NumPy alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from jaximu.ground.array_types import BoolArray, FloatArray, IntArray
from jaximu.ground.distributions import robust_sigma
from jaximu.ground.vectors import dot_rows, lengths_of
from jaximu.recordings.alignment import TURN_ANGLE, BlockMeans, Clocks, clocks, gravity_turning, of_each
from jaximu.recordings.finding import Rows
from jaximu.recordings.recording import Recording, Signal, floor_of, runs_of, steps_of
from jaximu.recordings.stamps import GAP

TITLES = {
    "data.bumped_pose": "bumped pose",
    "data.moving_line": "line that moves",
    "data.moving_pose": "moving pose",
    "data.order": "rows out of order",
    "data.sampling": "turns too quick for the rate",
    "data.swapped_axes": "swapped axes",
    "setup.mounting": "rotated mounting",
}
"""In English, the mistakes that no file of this folder finds: reading a file shows them, or a fit."""

BRIDGED = 3
"""Samples in a row that may be missing in a turn: interpolation across them costs less than the noise does."""
HUNG = 10
"""Rows for which a sensor may repeat all of its values: beyond, it hung, unless all of its axes are at limits."""
_SHOWN = 5
_ZEROS, _BESIDE, _FINER = 0.2, 20, 8
"""Share of zeros from which on a dead band is sought; samples within twice its size that must be there, and how many
times finer than the band their steps must be, or coarse steps would do it."""
_EITHER = 0.02
"""Share of the samples beside a dead band that lie on either side of it: rows of zeros beside a bias have one side."""
_FEW_STEPS = 3.5
"""Steps that the smallest tenth of the changes of a coarse output stay below."""
_BLOCK = 0.25  # s, over which scatter is taken to tell rest from motion
_QUIET = 6.0  # times the floor of the variance up to which a block counts as rest
_SHORTEST_REST = 0.75  # s
_RESTED = 0.9  # share of a recording that is quiet where it was made of a unit at rest
_UNITS = {"accelerometer": "m/s^2", "gyroscope": "rad/s"}
_CURVATURE_NOISE = float(np.sqrt(1 + 34 / 36))  # of a sample's difference from the cubic through its neighbours


class Sensor:
    """The samples of one sensor with what several checks need to know of them. (n, 3) values in SI units."""

    def __init__(self, name: str, signal: Signal, origin: Rows) -> None:
        self.name, self.signal = name, signal
        self.time, self.values = signal.time, signal.si()
        self.unit = _UNITS.get(name, signal.unit)
        self.origin = origin

    def __len__(self) -> int:
        return len(self.time)

    @cached_property
    def interval(self) -> FloatArray:
        """(n − 1,) seconds between neighbouring stamps."""
        return np.diff(self.time)

    @cached_property
    def period(self) -> float:
        """Median seconds between neighbouring stamps."""
        return float(np.median(self.interval))

    @property
    def rate(self) -> float:
        """Samples a second."""
        return 1.0 / self.period

    @cached_property
    def difference(self) -> FloatArray:
        """(n − 1, 3) differences of neighbouring samples."""
        return np.diff(self.values, axis=0)

    @cached_property
    def extremes(self) -> FloatArray:
        """(2, 3) the largest and the smallest value of each axis."""
        return np.stack([self.values.max(axis=0), self.values.min(axis=0)])

    @cached_property
    def even(self) -> BoolArray:
        """(n − 1,) whether an interval is no gap."""
        return np.asarray(self.interval, np.float64) < GAP * max(self.period, np.mean(self.interval))

    @cached_property
    def curvature(self) -> FloatArray:
        """(n, 3) difference of each sample from the cubic through two neighbours on either side; zero at ends, gaps."""
        misfit = off_cubic(self.values)
        misfit[np.clip(np.flatnonzero(~self.even)[:, None] + np.arange(-1, 3), 0, len(misfit) - 1)] = 0.0
        return misfit

    @cached_property
    def local(self) -> FloatArray:
        """(n, 3) robust standard deviation of `curvature` around each sample: of a block of 16 and its neighbours."""
        return scale_around(self.curvature)

    @cached_property
    def noise(self) -> FloatArray:
        """(3,) standard deviation of the noise from sample to sample where it is lowest."""
        return np.maximum(np.quantile(self.local[::16], 0.2, axis=0) / _CURVATURE_NOISE, self.step / np.sqrt(12))

    @cached_property
    def coarse(self) -> tuple[float | None, ...]:
        """The step of each axis whose noise is finer than it, else None."""
        return tuple(coarse_step(self, axis) for axis in range(3))

    @cached_property
    def dead_band(self) -> tuple[float, float] | None:
        """The share of an axis's samples that are exactly zero, and the least size (SI) of the others, where all that
        are smaller are missing although larger ones come in finer steps: of the axis with most zeros.
        """
        axes: list[tuple[float, float]] = []
        for values, scale in zip(self.signal.values.T, self.signal.nominal_scale, strict=True):
            zero = values == 0.0
            if not _ZEROS <= zero.mean() < 1.0:
                continue
            sizes = np.abs(values[~zero])
            least = sizes.min()
            near = values[~zero][sizes < 2 * least] / least
            both = min(np.mean(near > 0), np.mean(near < 0)) > _EITHER
            if len(near) >= _BESIDE and both and len(np.unique(np.round(np.abs(near) * _FINER))) >= _FINER // 2:
                axes.append((float(zero.mean()), least / np.abs(scale)))
        return max(axes) if axes else None

    @property
    def step(self) -> FloatArray:
        """(3,) the least difference of two values of an axis."""
        return self.signal.step

    @cached_property
    def blocks(self) -> tuple[Rows, FloatArray, FloatArray]:
        """First row of each block of a quarter second, and its mean and variance (b, 3)."""
        size = max(4, round(_BLOCK / self.period))
        count = max(1, len(self) // size)
        size = min(size, len(self))
        parts = self.values[: count * size].reshape(count, size, 3)
        return np.arange(count) * size, parts.mean(axis=1), parts.var(axis=1)

    @cached_property
    def quiet(self) -> BoolArray:
        """(n,) whether a sample lies in a block that varies no more than the quietest do."""
        _, mean, variance = self.blocks
        total = variance.sum(axis=1)
        floor = max(floor_of(total), self.signal.rounding_variance)
        calm = total <= _QUIET * floor
        if len(mean) > 2:  # slow, smooth motion varies little within a block, but from block to block
            leave_out_both(calm, np.sum(np.diff(mean, axis=0) ** 2, axis=1) > 36 * floor + 1e-24)
        return self.by_sample(calm)

    @property
    def block_size(self) -> int:
        """Samples of each of `blocks`."""
        first = self.blocks[0]
        return int(first[1]) if len(first) > 1 else len(self)

    def by_sample(self, by_block: BoolArray) -> BoolArray:
        """Return for each sample (n,) what holds for its block (b,); those behind the last one belong to it."""
        return by_block[np.minimum(np.arange(len(self)) // self.block_size, len(by_block) - 1)]

    def next_to(self, times: FloatArray) -> IntArray:
        """Return the row (k,) of the first sample at or after each time (k,), or of the last one."""
        return np.minimum(np.searchsorted(self.time, times), len(self) - 1)

    def rows(self, indices: Any) -> tuple[int, ...]:
        """Return the first few rows concerned as a person counts them in the recording as it was given."""
        return tuple(int(row) + 1 for row in self.origin[list(indices)[:_SHOWN]])

    def at(self, index: int | np.integer) -> str:
        """Return the time of a row."""
        return f"{self.time[index]:.1f} s"


class Samples:
    """A recording as the checks see it. origin: for each sensor, the row that each sample had in the file.

    magnetometer: see its samples alone, which are compared with no other sensor's.
    """

    def __init__(
        self,
        recording: Recording,
        origin: Mapping[str, Rows],
        before: Samples | None = None,
        magnetometer: bool = False,
    ) -> None:
        self.recording = recording
        self.sensors: dict[str, Sensor] = {}
        for name in ("magnetometer",) if magnetometer else ("accelerometer", "gyroscope"):
            signal = recording.signals.get(name)
            if signal is None or len(signal) < 16:
                continue
            same = None if before is None else before.sensors.get(name)
            self.sensors[name] = same if same and same.signal is signal else Sensor(name, signal, origin[name])

    @property
    def first(self) -> Sensor:
        """The accelerometer, or what there is instead."""
        return next(iter(self.sensors.values()))

    @property
    def accelerometer(self) -> Sensor | None:
        """The accelerometer, where it has enough samples."""
        return self.sensors.get("accelerometer")

    @property
    def gyroscope(self) -> Sensor | None:
        """The gyroscope, where it has enough samples."""
        return self.sensors.get("gyroscope")

    @property
    def both(self) -> tuple[Sensor, Sensor] | None:
        """The accelerometer and the gyroscope, where both have enough samples."""
        force, rate = self.accelerometer, self.gyroscope
        return None if force is None or rate is None else (force, rate)

    @property
    def outputs(self) -> tuple[FloatArray, ...]:
        """The stamps and values of the accelerometer, then of the gyroscope, as far as they are there."""
        return tuple(part for sensor in self.sensors.values() for part in (sensor.time, sensor.values))

    @cached_property
    def shared(self) -> bool:
        """Whether both sensors have one row for each stamp."""
        return self.both is not None and np.array_equal(self.both[0].time, self.both[1].time)

    def quiet_at(self, sensor: Sensor) -> BoolArray:
        """(n,) whether the *other* sensor, or the sensor itself where it is alone, is at rest at a sensor's samples."""
        other = self.gyroscope if sensor is self.accelerometer else self.accelerometer
        if other is None or self.shared:
            return (other or sensor).quiet
        return other.quiet[other.next_to(sensor.time)]

    @cached_property
    def turning(self) -> BlockMeans | None:
        """How gravity turns beside the gyroscope's angle; None without a gyroscope or in a short recording."""
        return gravity_turning(*self.outputs) if self.both else None

    @cached_property
    def clocks(self) -> Clocks | None:
        """By how much the gyroscope's stamps are late, None where nothing turns or there is no gyroscope."""
        return clocks(*self.outputs) if self.both else None

    @cached_property
    def rests(self) -> FloatArray:
        """(k, 2) start and stop, s, of the stretches in which the accelerometer rests, and the gyroscope if it can.

        The calmest stretches of free motion are no rests: the force turns in them.
        """
        sensor = self.accelerometer
        spans = np.zeros((0, 2)) if sensor is None else spans_of(sensor.quiet, sensor.time, _SHORTEST_REST)
        if sensor is None or not len(spans):
            return spans
        first, last = np.searchsorted(sensor.time, spans).T
        middle = (first + last) // 2
        halves = [of_each(np.median, sensor.values, np.stack(ends, 1)) for ends in ((first, middle), (middle, last))]
        turned = np.sin(TURN_ANGLE / 2) / 2 * lengths_of(halves[0])
        return spans[lengths_of(halves[1] - halves[0]) < np.maximum(turned, sensor.noise.max())]

    @cached_property
    def rested(self) -> bool:
        """Whether the unit lay still all along, but for moments: what varies then is noise, or a disturbance."""
        still = [max((sensor.dead_band or (0.0,))[0], sensor.quiet.mean()) for sensor in self.sensors.values()]
        return bool(still) and bool(min(still) > _RESTED) and not self.turned

    @cached_property
    def turned(self) -> bool:
        """Whether the unit was turned by 20° or more anywhere between rests."""
        rate = self.gyroscope
        if rate is not None:
            angle = np.cumsum((rate.values - np.median(rate.values, axis=0)) * rate.period, axis=0)
            runs = runs_of(~rate.quiet)
            if np.max(lengths_of(angle[runs[:, 1] - 1] - angle[runs[:, 0]]), initial=0.0) > TURN_ANGLE:
                return True
        return self._reversals is None or self._reversals > 0

    @cached_property
    def posed(self) -> bool:
        """Whether the unit was turned from rest to rest: four times by 20° or more."""
        if self._reversals is None:  # an axis or a unit is wrong, and directions tell nothing
            return len(self.rests) > 8
        return len(self.rests) >= 5 and self._reversals >= 4

    @cached_property
    def _reversals(self) -> int | None:
        """How often gravity lies 20° or more off where it lay in the rest before; None where its size changes."""
        sensor, rests = self.accelerometer, self.rests
        if sensor is None or not len(rests):
            return 0
        means = of_each(np.median, sensor.values, np.searchsorted(sensor.time, rests))
        size = lengths_of(means)
        if np.ptp(size) > 0.5 * np.median(size):
            return None
        cosine = dot_rows(means[1:], means[:-1]) / np.maximum(size[1:] * size[:-1], 1e-300)
        return int(np.sum(cosine < np.cos(TURN_ANGLE)))


def off_cubic(values: FloatArray) -> FloatArray:
    """Return by how much values (n, m) are off the cubic through two neighbours on either side; zero at the ends."""
    misfit = np.zeros_like(values)
    misfit[2:-2] = values[2:-2] - (4 * (values[1:-3] + values[3:-1]) - values[:-4] - values[4:]) / 6
    return misfit


def spans_of(flags: BoolArray, time: FloatArray, shortest: float) -> FloatArray:
    """Return start and stop (k, 2), s, of the runs of True at stamps (n,) that take so many seconds or more."""
    spans = time[np.minimum(runs_of(flags), len(time) - 1)]
    return spans[spans[:, 1] - spans[:, 0] >= shortest]


def leave_out_both(calm: BoolArray, moved: BoolArray) -> None:
    """Mark as not calm, in place, the blocks (b,) on both sides of each step (b - 1,) that moved."""
    calm[1:] &= ~moved
    calm[:-1] &= ~moved


def scale_around(misfit: FloatArray, before: bool = True) -> FloatArray:
    """Return the robust standard deviation (n, 3) around each sample: the largest of a block of 16 and its neighbours.

    **Arguments:** `misfit`: what is no motion (n, 3). `before`: look at the block before as well as at the one after.
    """
    size = 16
    blocks = max(1, len(misfit) // size)
    columns = np.ascontiguousarray(misfit[: blocks * size].T)
    scale = np.stack([robust_sigma(axis.reshape(blocks, -1), axis=1) for axis in columns], axis=1)
    wide = np.maximum(scale, np.concatenate([scale[1:], scale[-2:][:1]]))  # the last one has none after it
    if before:
        wide[1:-1] = np.maximum(wide[1:-1], scale[:-2])
    return wide[np.minimum(np.arange(len(misfit)) // size, blocks - 1)]


def coarse_step(sensor: Sensor, axis: int, quiet: BoolArray | None = None) -> float | None:
    """Return the step of an axis whose noise is finer than it, else None."""
    values, change = sensor.values[:, axis], sensor.difference[:, axis]
    # at rest most neighbours are equal, and those that are not differ by whole steps
    same = change == 0
    equal = np.mean(same)
    if quiet is not None and quiet[1:].sum() > 100:
        equal = max(equal, np.mean(same[quiet[1:]]))
    if equal < 0.4:
        return None
    steps = steps_of(values)
    if len(steps) < 2:
        return None
    step, moved = steps.min(), np.abs(change[~same])
    if np.mean(np.abs(moved / step - np.round(moved / step)) < 0.01) < 0.99:
        return None
    # an axis that is held, at a limit say, repeats itself as well: elsewhere its differences are many steps of its text
    return step if np.quantile(moved, 0.1) < _FEW_STEPS * step else None


def with_signal(recording: Recording, name: str, **changes: Any) -> Recording:
    """Return the recording with one signal changed."""
    return replace(recording, **{name: replace(getattr(recording, name), **changes)})
