"""Mistakes that people make with recordings, put into any recording: sizes and places from a seed.

Nothing here comes from the checks that are to find them. A mistake takes a `Log` and a generator of random numbers and
returns the changed `Log`, the names under which it may be reported, and the rows (from 1) it put its hands on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from jaximu.recordings.recording import Recording, Signal


@dataclass(frozen=True)
class Log:
    """Rows of a logger: time (n,) s, accel and gyro (n, 3), in SI or counts; what they are in, and others of a kind."""

    time: np.ndarray
    accel: np.ndarray
    gyro: np.ndarray
    recording: Recording | None = field(default=None, repr=False)
    other: Log | None = field(default=None, repr=False)  # of another unit or motion, for mix-ups

    @classmethod
    def of(cls, recording: Recording, other: Recording | None = None) -> Log:
        gyroscope, accelerometer = recording.gyroscope, recording.accelerometer
        assert gyroscope is not None
        count = min(len(accelerometer), len(gyroscope))
        values = accelerometer.si()[:count], gyroscope.si()[:count]
        return cls(accelerometer.time[:count], *values, recording, None if other is None else cls.of(other))

    def to_recording(self) -> Recording:
        return Recording(Signal(self.time, self.accel, "m/s^2"), Signal(self.time, self.gyro, "rad/s"))

    def write(self, path: Path) -> Path:
        header = "time [s],accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2],gyro_x [rad/s],gyro_y [rad/s],gyro_z [rad/s]"
        rows = np.column_stack([self.time, self.accel, self.gyro])
        np.savetxt(path, rows, "%.12g", ",", header=header, comments="")
        return path

    def rows(self, places: np.ndarray) -> Log:
        return replace(self, time=self.time[places], accel=self.accel[places], gyro=self.gyro[places])

    @property
    def period(self) -> float:
        return float(np.median(np.diff(self.time)))

    @property
    def count(self) -> int:
        return len(self.time)

    def moving(self, least: float = 0.3) -> np.ndarray:
        """Whether the unit turns by so much (rad/s), smoothed over 0.2 s."""
        rate = np.linalg.norm(self.gyro - np.median(self.gyro, axis=0), axis=1)
        width = max(1, round(0.2 / self.period))
        return np.convolve(rate, np.ones(width) / width, "same") > least

    def noise(self, triad: str) -> np.ndarray:
        """(3,) of a triad, from neighbouring samples at rest."""
        values = getattr(self, triad)
        still = ~self.moving(0.1)
        difference = np.diff(values, axis=0)[still[1:] & still[:-1]]
        return np.maximum(np.median(np.abs(difference), axis=0) / 0.954, 1e-9)


@dataclass(frozen=True)
class Planted:
    """A log with a mistake in it: names that are right answers, rows changed, what each triad's output was times."""

    log: Log
    names: tuple[str, ...]
    rows: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    accel: np.ndarray = field(default_factory=lambda: np.eye(3))
    gyro: np.ndarray = field(default_factory=lambda: np.eye(3))


Mistake = Callable[[Log, np.random.Generator], Planted]
MISTAKES: dict[str, Mistake] = {}
FILES: dict[str, Mistake] = {}
"""Those that a `Recording` cannot hold: stamps that do not rise."""
APART: dict[str, Mistake] = {}
"""Those that make the two sensors differ: axes, ranges, clocks. A fit of both shows them."""


def mistake(kind: dict[str, Mistake]) -> Callable[[Mistake], Mistake]:
    def add(function: Mistake) -> Mistake:
        kind[function.__name__] = function
        return function

    return add


def chosen(random: np.random.Generator, allowed: np.ndarray, count: int, apart: int = 12) -> np.ndarray:
    """So many places of those allowed, none near another or an end."""
    places = np.flatnonzero(allowed)
    places = places[(places > 30) & (places < len(allowed) - 60)]
    found: list[int] = []
    for place in random.permutation(places):
        if all(abs(place - other) > apart for other in found):
            found.append(int(place))
            if len(found) == count:
                break
    return np.sort(np.array(found, int))


def renumbered(log: Log, kept: np.ndarray) -> Log:
    """The rows kept, with the stamps of a logger that counts on evenly."""
    found = log.rows(kept)
    return replace(found, time=log.time[0] + np.arange(len(found.time)) * log.period)


def everywhere(log: Log) -> np.ndarray:
    return np.ones(log.count, bool)


# --- rows that are no measurement


@mistake(MISTAKES)
def zero_rows(log, random):
    accel, gyro = log.accel.copy(), log.gyro.copy()
    rows = []
    for place in chosen(random, everywhere(log), 6, 40):
        part = np.arange(place, place + random.integers(1, 11))
        rows.append(part)
        which = random.integers(3)
        if which != 1:
            accel[part] = 0.0
        if which != 0:
            gyro[part] = 0.0
    return Planted(replace(log, accel=accel, gyro=gyro), ("data.zeros",), np.concatenate(rows))


@mistake(MISTAKES)
def spikes(log, random):
    triads = {"accel": log.accel.copy(), "gyro": log.gyro.copy()}
    rows = []
    for place in chosen(random, everywhere(log), 30, 25):
        name = ("accel", "gyro")[random.integers(2)]
        part = np.arange(place, place + random.integers(1, 4))
        axis = random.integers(3)
        full = {"accel": 40.0, "gyro": 8.0}[name]
        size = random.choice([-1, 1]) * full * 10.0 ** random.uniform(-1.0, 0.0)
        triads[name][part, axis] += size
        rows.append(part)
    return Planted(replace(log, **triads), ("data.spikes",), np.concatenate(rows))


@mistake(MISTAKES)
def wrap_around(log, random):
    gyro = log.gyro.copy()
    peak = np.max(np.abs(gyro), axis=0)
    axis = int(np.argmax(peak))
    full = 2 * peak[axis] * random.uniform(0.55, 0.85)  # from −full/2 to full/2
    step = full / 2**16
    value = np.round(gyro / step) * step
    wrapped = (value[:, axis] + full / 2) % full - full / 2
    rows = np.flatnonzero(np.abs(wrapped - value[:, axis]) > full / 2)
    gyro[:, axis] = wrapped
    return Planted(replace(log, gyro=gyro), ("data.wrap",), rows)


# --- range


@mistake(MISTAKES)
def clipped(log, random):
    limit = random.uniform(0.35, 0.75) * np.max(np.abs(log.gyro))
    rows = np.flatnonzero((np.abs(log.gyro) > limit).any(axis=1))
    return Planted(replace(log, gyro=np.clip(log.gyro, -limit, limit)), ("data.clipping",), rows)


@mistake(MISTAKES)
def clipped_then_smoothed(log, random):
    limit = random.uniform(0.3, 0.6) * np.max(np.abs(log.gyro))
    rows = np.flatnonzero((np.abs(log.gyro) > limit).any(axis=1))
    width = max(2, round(random.uniform(0.02, 0.05) / log.period))
    gyro = np.clip(log.gyro, -limit, limit)
    gyro = np.stack([np.convolve(axis, np.ones(width) / width, "same") for axis in gyro.T], axis=1)
    return Planted(replace(log, gyro=gyro), ("data.saturation", "data.clipping"), rows)


@mistake(MISTAKES)
def soft_saturation(log, random):
    limit = random.uniform(0.35, 0.6) * np.max(np.abs(log.gyro))
    noise = log.noise("gyro") * random.standard_normal(log.gyro.shape)
    gyro = limit * np.tanh((log.gyro - noise) / limit) + noise
    rows = np.flatnonzero((np.abs(log.gyro) > 0.5 * limit).any(axis=1))
    return Planted(replace(log, gyro=gyro), ("data.saturation", "data.clipping"), rows)


# --- order and time


@mistake(MISTAKES)
def pasted_twice(log, random):
    start = int(random.integers(log.count // 5, log.count // 2))
    size = int(random.integers(50, 600))
    at = int(random.integers(start + size, log.count - size))
    kept = np.concatenate([np.arange(at), np.arange(start, start + size), np.arange(at, log.count)])
    return Planted(renumbered(log, kept), ("data.duplicate",), np.arange(at, at + size))


def lost(share: float) -> Mistake:
    def lose(log, random):
        kept = random.random(log.count) >= share
        kept[:5] = kept[-5:] = True
        places = np.cumsum(kept)[np.flatnonzero(~kept)]
        return Planted(renumbered(log, np.flatnonzero(kept)), ("data.lost_samples",), places)

    return lose


MISTAKES["lost_1_percent"], MISTAKES["lost_5_percent"] = lost(0.01), lost(0.05)


@mistake(MISTAKES)
def lost_in_a_turn(log, random):
    length = max(3, round(random.uniform(0.1, 0.5) / log.period))
    places = chosen(random, log.moving(0.6), 2, 10 * length)
    kept = np.ones(log.count, bool)
    for place in places:
        kept[place : place + length] = False
    rows = np.cumsum(kept)[places - 1]
    return Planted(renumbered(log, np.flatnonzero(kept)), ("data.lost_samples",), rows)


@mistake(MISTAKES)
def bursts(log, random):
    size = random.integers(5, 25)
    delay = np.repeat(np.arange(log.count // size + 1), size)[: log.count]
    last = np.minimum((delay + 1) * size, log.count) - 1
    arrival = log.time[last] + np.abs(random.normal(0, 0.1 * log.period * size, last.max() + 1))[last]
    arrival += (np.arange(log.count) % size) * random.uniform(2e-5, 0.03) * log.period
    arrival = np.maximum.accumulate(arrival + 1e-9 * np.arange(log.count))
    return Planted(replace(log, time=arrival + 1e-7 * np.arange(log.count)), ("data.bursts",))


@mistake(MISTAKES)
def jitter(log, random):
    noise = np.clip(random.normal(0, random.uniform(0.15, 0.25), log.count), -0.45, 0.45) * log.period
    return Planted(replace(log, time=log.time + noise), ("data.jitter",))


@mistake(MISTAKES)
def polled(log, random):
    """A logger wakes on a coarse grid, late at times, and stamps the sensor's last sample with its own clock."""
    step = log.period / 2
    late = random.exponential(random.uniform(0.15, 0.3) * log.period, log.count)
    stamps = np.maximum.accumulate(step * np.ceil((log.time + late) / step))
    return Planted(replace(log, time=stamps + 1e-6 * step * np.arange(log.count)), ("data.jitter",))


@mistake(MISTAKES)
def gap(log, random):
    place = chosen(random, everywhere(log), 1)[0]
    length = round(random.uniform(0.5, 5.0) / log.period)
    kept = np.r_[0:place, min(place + length, log.count - 20) : log.count]
    return Planted(log.rows(kept), ("data.gap",), np.array([place]))


@mistake(MISTAKES)
def stamps_in_milliseconds(log, random):
    return Planted(replace(log, time=log.time * random.choice([1e3, 1e-3, 1e6])), ("data.time_scale",))


# --- drivers and filters


@mistake(MISTAKES)
def zeroed_at_rest(log, random):
    gyro = log.gyro.copy()
    gyro[~log.moving(random.uniform(0.03, 0.06))] = 0.0
    return Planted(replace(log, gyro=gyro), ("data.auto_zero",))


@mistake(MISTAKES)
def high_passed(log, random):
    constant = random.uniform(2.0, 20.0)
    share = log.period / constant
    gyro, mean = np.empty_like(log.gyro), log.gyro[:50].mean(axis=0)
    for k, row in enumerate(log.gyro):
        mean = mean + share * (row - mean)
        gyro[k] = row - mean
    return Planted(replace(log, gyro=gyro), ("data.auto_zero",))


def rounded(value: np.ndarray, step: float) -> np.ndarray:
    return np.round(value / step) * step


@mistake(MISTAKES)
def twelve_bits(log, random):
    which = random.integers(3)
    accel, gyro = log.accel, log.gyro
    if which != 0:
        gyro = rounded(gyro, max(2 * np.radians(2000) / 2**12, 3 * float(np.max(log.noise("gyro")))))
    if which != 1:
        accel = rounded(accel, max(2 * 16 * 9.80665 / 2**12, 3 * float(np.max(log.noise("accel")))))
    return Planted(replace(log, accel=accel, gyro=gyro), ("data.quantisation",))


def filtered(log: Log, corner: float, order: int) -> Log:
    frequency = np.fft.rfftfreq(log.count, log.period)
    response = 1 / (1 + 1j * frequency / corner) ** order

    def each(values):
        padded = values - values[:1]
        return np.fft.irfft(np.fft.rfft(padded, axis=0) * response[:, None], log.count, axis=0) + values[:1]

    return replace(log, accel=each(log.accel), gyro=each(log.gyro))


@mistake(MISTAKES)
def low_passed(log, random):
    half = 0.5 / log.period
    corner = random.choice([c for c in (2.0, 5.0, 10.0) if c < 0.3 * half])
    return Planted(filtered(log, corner, int(random.integers(2, 4))), ("data.bandwidth",))


@mistake(MISTAKES)
def interpolated(log, random):
    every = max(2, round(1 / (random.choice([10.0, 20.0]) * log.period)))
    kept = np.arange(int(random.integers(every)), log.count, every)

    def each(values):
        return np.stack([np.interp(log.time, log.time[kept], axis[kept]) for axis in values.T], axis=1)

    return Planted(replace(log, accel=each(log.accel), gyro=each(log.gyro)), ("data.resampled",))


@mistake(MISTAKES)
def held(log, random):
    every = max(2, round(1 / (20.0 * log.period)))
    source = np.arange(log.count) // every * every
    return Planted(replace(log, accel=log.accel[source], gyro=log.gyro[source]), ("data.resampled",))


# --- not what the column says


@mistake(MISTAKES)
def normalised(log, random):
    accel = log.accel / np.linalg.norm(log.accel, axis=1, keepdims=True) * 9.80665
    return Planted(replace(log, accel=accel), ("data.normalised",))


@mistake(MISTAKES)
def gravity_free(log, random):
    smooth = filtered(log, 1.0, 1).accel
    norm = np.linalg.norm(smooth, axis=1, keepdims=True)
    return Planted(replace(log, accel=log.accel - smooth / norm * 9.80665), ("data.gravity_free", "data.units"))


@mistake(MISTAKES)
def dead_axis(log, random):
    name, axis = ("accel", "gyro")[random.integers(2)], random.integers(3)
    values = getattr(log, name).copy()
    values[:, axis] = log.noise(name)[axis] * random.standard_normal(log.count)
    return Planted(replace(log, **{name: values}), ("data.dead_axis",))


@mistake(MISTAKES)
def copied_axis(log, random):
    name = ("accel", "gyro")[random.integers(2)]
    first, second = random.permutation(3)[:2]
    values = getattr(log, name).copy()
    values[:, second] = random.choice([1.0, -1.0, 0.5]) * values[:, first]
    return Planted(replace(log, **{name: values}), ("data.copied_axis",))


@mistake(MISTAKES)
def gyroscope_of_another_recording(log, random):
    assert log.other is not None
    gyro = np.tile(log.other.gyro, (int(np.ceil(log.count / log.other.count)), 1))[: log.count]
    return Planted(replace(log, gyro=gyro), ("data.mixed_devices", "data.dead_axis"))


@mistake(MISTAKES)
def another_unit_from_a_row_on(log, random):
    place = int(random.uniform(0.3, 0.7) * log.count)
    changed = {}
    for name, scatter in (("accel", 0.3), ("gyro", 0.03)):
        values = getattr(log, name).copy()
        gain = np.eye(3) + random.uniform(-0.02, 0.02, (3, 3))
        noise = random.uniform(1.5, 3.0) * log.noise(name) * random.standard_normal((log.count - place, 3))
        values[place:] = values[place:] @ gain.T + random.uniform(-scatter, scatter, 3) + noise
        changed[name] = values
    return Planted(replace(log, **changed), ("data.mixed_devices",), np.array([place]))


@mistake(MISTAKES)
def stuck_axis(log, random):
    name, axis = ("accel", "gyro")[random.integers(2)], random.integers(3)
    values = getattr(log, name).copy()
    start = int(random.uniform(0.2, 0.7) * log.count)
    stop = start + round(random.uniform(3.0, 12.0) / log.period)
    values[start:stop, axis] = values[start - 1, axis]
    return Planted(replace(log, **{name: values}), ("data.stuck_axis",), np.arange(start, stop))


@mistake(MISTAKES)
def hung(log, random):
    """One sensor or both give one row over and over for a while, and then go on."""
    start = int(random.uniform(0.2, 0.7) * log.count)
    stop = start + round(random.uniform(0.6, 3.0) / log.period)
    changed = {}
    for name in (("accel",), ("gyro",), ("accel", "gyro"))[random.integers(3)]:
        values = getattr(log, name).copy()
        values[start:stop] = values[start - 1]
        changed[name] = values
    return Planted(replace(log, **changed), ("data.stuck_axis",), np.arange(start, stop))


@mistake(MISTAKES)
def hum(log, random):
    name, axis = ("accel", "gyro")[random.integers(2)], random.integers(3)
    values = getattr(log, name).copy()
    frequency = random.uniform(0.2, 0.45) / log.period
    amplitude = random.uniform(1.5, 3.0) * log.noise(name)[axis]
    values[:, axis] += amplitude * np.sin(2 * np.pi * frequency * log.time + random.uniform(0, 6))
    return Planted(replace(log, **{name: values}), ("data.periodic",))


# --- files whose stamps do not rise


@mistake(FILES)
def reversed_rows(log, random):
    return Planted(log.rows(np.arange(log.count)[::-1]), ("data.order",))


@mistake(FILES)
def shuffled_blocks(log, random):
    first, second = np.sort(chosen(random, everywhere(log), 2, 500))
    size = min(200, (second - first) // 2)
    order = np.arange(log.count)
    order[first : first + size], order[second : second + size] = (
        np.arange(second, second + size), np.arange(first, first + size),
    )  # fmt: skip
    return Planted(log.rows(order), ("data.order",))


@mistake(FILES)
def swapped_neighbours(log, random):
    order = np.arange(log.count)
    for place in chosen(random, everywhere(log), 20):
        order[[place, place + 1]] = order[[place + 1, place]]
    return Planted(log.rows(order), ("data.order",))


@mistake(FILES)
def block_twice(log, random):
    start = int(random.integers(log.count // 5, log.count // 2))
    size = int(random.integers(50, 600))
    at = int(random.integers(start + size, log.count))
    return Planted(log.rows(np.r_[0:at, start : start + size, at : log.count]), ("data.duplicate", "data.order"))


@mistake(FILES)
def rows_twice(log, random):
    return Planted(log.rows(np.sort(np.r_[0 : log.count, chosen(random, everywhere(log), 50)])), ("data.duplicate",))


@mistake(FILES)
def shared_stamps(log, random):
    """Bursts with a resolution of a millisecond: many rows share their stamp."""
    size = int(random.integers(3, 8))
    last = np.minimum((np.arange(log.count) // size + 1) * size, log.count) - 1
    return Planted(replace(log, time=np.round(log.time[last], 3)), ("data.bursts",))


# --- two sensors that are not what they should be to each other


def mapped(
    log: Log, names: tuple[str, ...], accel: np.ndarray | None = None, gyro: np.ndarray | None = None
) -> Planted:
    """Outputs times a matrix."""
    accel, gyro = (np.eye(3) if each is None else each for each in (accel, gyro))
    changed = replace(log, accel=log.accel @ accel.T, gyro=log.gyro @ gyro.T)
    return Planted(changed, names, accel=accel, gyro=gyro)


def sign(axis: int) -> np.ndarray:
    return np.diag(np.where(np.arange(3) == axis, -1.0, 1.0))


@mistake(APART)
def gyroscope_negated(log, random):
    return mapped(log, ("data.swapped_axes",), gyro=-np.eye(3))


@mistake(APART)
def gyroscope_axis_negated(log, random):
    return mapped(log, ("data.swapped_axes",), gyro=sign(random.integers(3)))


@mistake(APART)
def gyroscope_axes_swapped(log, random):
    return mapped(log, ("data.swapped_axes",), gyro=np.eye(3)[[[1, 0, 2], [0, 2, 1], [2, 1, 0]][random.integers(3)]])


@mistake(APART)
def gyroscope_axes_cycled(log, random):
    return mapped(log, ("data.swapped_axes",), gyro=np.roll(np.eye(3), random.integers(1, 3), axis=0))


@mistake(APART)
def gyroscope_mounted_a_quarter_turn(log, random):
    matrix = np.roll(np.roll([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], turn := random.integers(3), 0), turn, 1)
    return mapped(log, ("data.swapped_axes",), gyro=matrix)


@mistake(APART)
def gyroscope_mounted_askew(log, random):
    axis = random.standard_normal(3)
    matrix = Rotation.from_rotvec(random.uniform(0.25, 0.6) * axis / np.linalg.norm(axis)).as_matrix()
    return mapped(log, ("setup.mounting",), gyro=matrix)


@mistake(APART)
def both_left_handed(log, random):
    return mapped(log, ("data.swapped_axes",), *[sign(random.integers(3))] * 2)


@mistake(APART)
def accelerometer_axis_negated(log, random):
    return mapped(log, ("data.swapped_axes",), accel=sign(random.integers(3)))


@mistake(APART)
def accelerometer_axes_swapped(log, random):
    return mapped(log, ("data.swapped_axes",), accel=np.eye(3)[[[1, 0, 2], [0, 2, 1], [2, 1, 0]][random.integers(3)]])


@mistake(APART)
def gyroscope_range(log, random):
    return mapped(log, ("data.range",), gyro=(0.25, 0.5, 2.0, 4.0)[random.integers(4)] * np.eye(3))


@mistake(APART)
def accelerometer_range(log, random):
    return mapped(log, ("data.range",), accel=(0.25, 0.5, 2.0, 4.0)[random.integers(4)] * np.eye(3))


@mistake(APART)
def range_of_one_axis(log, random):
    factors = np.ones(3)
    factors[random.integers(3)] = (0.5, 2.0)[random.integers(2)]
    return mapped(log, ("data.range",), **{("accel", "gyro")[random.integers(2)]: np.diag(factors)})


def late(log: Log, delay: float, drift: float) -> Log:
    """The gyroscope's rows so late, by a clock of its own, on the accelerometer's stamps."""
    own = log.time - delay - drift * (log.time - log.time[0])
    return replace(log, gyro=np.stack([np.interp(own, log.time, column) for column in log.gyro.T], axis=1))


@mistake(APART)
def gyroscope_late(log, random):
    delay = random.choice([-1, 1]) * 10 ** random.uniform(-1.3, 0.0)
    return Planted(late(log, delay, 0.0), ("setup.time_offset", "data.clocks"))


@mistake(APART)
def clocks_drift(log, random):
    return Planted(late(log, 0.0, random.choice([-1, 1]) * 10 ** random.uniform(-2.3, -2.0)), ("data.clocks",))
