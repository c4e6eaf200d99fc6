"""Recordings at rest while the temperature changes, as means over blocks: what a thermal fit works on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from jaximu.estimation.track import TEMPERATURE_WINDOW, TRIADS, Track
from jaximu.ground.array_types import BoolArray, FloatArray, IntArray
from jaximu.ground.differences import midpoints
from jaximu.ground.distributions import rms, robust_sigma
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.quantities import sentence
from jaximu.ground.vectors import column_lengths, lengths_of, means_by_group
from jaximu.mistakes import Prepared, prepared
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.processes import RATIO, correlation_times
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.columns.names import COUNTS_ADVICE
from jaximu.recordings.recording import Recording, Signal, recordings_of, same_outputs, smoothed_slope, steps_of
from jaximu.recordings.thermometer import course

LEAST_RANGE = 3.0
"""K of change below which nothing is said about temperature."""
RATE_BANDWIDTH = 0.578 / TEMPERATURE_WINDOW
"""Hz at which the slope of a line through the window shows 0.71 of a rate of temperature that swings:
3 (sin x − x cos x) / x³ with x = π f window."""
WAYS = 4
"""Ways of the temperature from which on they are left out whole."""
_FOLDS = 8  # parts that are left out in turn, at most
_MOST_BLOCKS = 600
_FEWEST_BLOCKS = 30
_NODES = 8  # of the temperature's path in each block
_COLDEST, _HOTTEST = -40.0, 85.0  # °C
_MOVING = 30.0
"""Variance inside a block over the median block's above which the unit moved."""
_TURNED = 0.35  # m/s², two degrees: a jump between blocks that is a new pose
_OTHER_POSE = 1.0  # m/s² by which the force differs between poses
_STARTUP = 10.0  # standard deviations off its neighbours
_SOONEST = 60  # rows from the start, or from the last bad one, within which garbage belongs to the start-up
_WALKS = (0.0, 0.3, 0.7, 0.95, 1.0)
"""Shares of a random walk in slow noise, the rest flicker, that are tried."""
_RATIOS = np.concatenate([[0.0], np.geomspace(1e-4, 1e4, 161)])
"""Slow variance over the blocks' white variance that is tried."""
_ROUNDING = 1e-18
"""Share of an output's square below which its scatter is rounding."""
_FLICKER = 0.02
"""Least bias instability, in √s of the white noise's density: a tenth of what the quietest consumer sensors have."""
_TURNING = 0.1
"""Share of the range that the temperature must come back by for its way to be another leg."""
_STEADY = 1.5  # times as quick, from which on a way is said to have two rates


@dataclass(frozen=True)
class Leg:
    """A stretch in which the temperature goes one way: its blocks, from where to where (°C), rate where quick (K/s).

    rates: K/s, between which four fifths of the way were gone.
    """

    blocks: IntArray
    begin: float
    end: float
    rate: float
    rates: tuple[float, float]

    @property
    def up(self) -> bool:
        """Whether it warms."""
        return self.end > self.begin

    def __str__(self) -> str:
        low, high = sorted(self.rates, key=abs)
        rates = [self.rate] if abs(high) < _STEADY * abs(low) else [high, low]
        text = f"{self.begin:.0f} → {self.end:.0f} °C at {' to '.join(f'{60 * rate:+.2g}' for rate in rates)} K/min"
        return text.replace("-", "−")


@dataclass(frozen=True)
class RestBlocks:
    """Mean outputs over n blocks of one unit at rest, in one or several poses and recordings.

    start, stop (n,): s, on the clock of the block's recording. log (n,): which recording. rest (n,): which rest, from 0
    on over all recordings; in each the unit lay still. level (n,): which bias; a jump begins another. temperature (n,)
    °C and rate (n,) K/s: means over the blocks. means: by triad (n, 3), SI. nodes: of each recording, where time,
    temperature and its rate are known, and the blocks that they lie in. ambient (n,): °C, where every recording has it.
    dropped: blocks in which the unit moved.
    """

    recordings: tuple[Recording, ...]
    start: FloatArray
    stop: FloatArray
    log: IntArray
    rest: IntArray
    level: IntArray
    temperature: FloatArray
    rate: FloatArray
    means: dict[str, FloatArray]
    nodes: tuple[Track, ...]
    ambient: FloatArray | None
    duration: float
    dropped: int
    notes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.start)

    @property
    def levels(self) -> int:
        """How many biases there are."""
        return int(self.level.max(initial=-1)) + 1

    @property
    def of_level(self) -> FloatArray:
        """Ones (n, levels) where a block has a bias."""
        return np.eye(self.levels)[self.level]

    @property
    def by_recording(self) -> list[IntArray]:
        """The blocks of each recording."""
        return [np.flatnonzero(self.log == log) for log in range(len(self.recordings))]

    @property
    def several_poses(self) -> bool:
        """Whether the unit lay in more than one pose: a rest of its own may also begin with a jump of the bias."""
        return bool(np.ptp(self.by_rest(self.means["accelerometer"]), axis=0).max() > _OTHER_POSE)

    @property
    def range(self) -> tuple[float, float]:
        """Lowest and highest temperature of the blocks, °C."""
        return float(self.temperature.min()), float(self.temperature.max())

    @property
    def time(self) -> FloatArray:
        """Middle of each block, s, recordings one after another."""
        gap, shift, middle = 0.02 * float((self.stop - self.start).sum()), 0.0, np.zeros(len(self))
        for here in self.by_recording:
            if len(here):
                middle[here] = shift + (self.start[here] + self.stop[here]) / 2
                shift = middle[here].max() + gap
        return middle

    def covariance(self, noise: AxisNoise) -> FloatArray:
        """Return the covariance (3, n, n), SI², of the means; recordings are independent."""
        whole = np.zeros((3, len(self), len(self)))
        for here in self.by_recording:
            whole[:, here[:, None], here] = noise.covariance(self.start[here], self.stop[here])
        return whole

    def by_rest(self, values: FloatArray) -> FloatArray:
        """Return the mean of values (n, m) over the rest of each block, (n, m)."""
        return _about(self.rest, values)

    def left(self, name: str, values: FloatArray) -> FloatArray:
        """Return the rms (3,) of a triad's outputs (n, 3) as `compensate` leaves them, jumps included.

        About the mean of each rest, whose gravity nothing tells; of a gyroscope about that of each recording.
        """
        return rms(values - _about(self.rest if name == "accelerometer" else self.log, values), axis=0)

    @property
    def spans(self) -> list[float]:
        """How long each recording is, s."""
        return [float(np.ptp(np.asarray(track.stimulus.time))) for track in self.nodes]

    def tracks(self, force: FloatArray, reference: float) -> list[Track]:
        """Return what the unit went through, recording by recording, at the force (n, 3) of each block's rest.

        Effects count from `reference`, °C. Nodes of no block are at the force of the block before.
        """
        tracks, count = [], len(self)
        for track in self.nodes:
            block = np.asarray(track.observation)
            inside = block < count
            nearest = np.maximum.accumulate(np.where(inside, np.arange(len(block)), inside.argmax()))
            here, still = force[np.minimum(block[nearest], count - 1)], np.zeros((len(block), 3))
            stimulus = replace(
                track.stimulus,
                specific_force=here,
                angular_rate=still,
                angular_acceleration=still,
                temperature_reference=reference,
            )
            tracks.append(Track.padded(stimulus, block, count))
        return tracks

    def legs(self) -> list[Leg]:
        """Return the stretches in which the temperature goes one way; half of a soak belongs to each side."""
        legs = []
        least = _TURNING * (self.range[1] - self.range[0])
        for here in self.by_recording:
            edges = [0, *_turning_points(self.temperature[here], least), len(here)]
            for a, b in pairwise(edges):
                part = here[a:b]
                celsius = self.temperature[part]
                rate = np.sort(self.rate[part])
                moving = abs(rate) >= 0.5 * abs(rate).max()
                gone = abs(rate).cumsum() / abs(rate).sum()
                low, high = (float(rate[min(gone.searchsorted(share), len(rate) - 1)]) for share in (0.1, 0.9))
                legs.append(
                    Leg(part, float(celsius[0]), float(celsius[-1]), float(np.median(rate[moving])), (low, high))
                )
        return legs

    def only(self, keep: BoolArray) -> RestBlocks:
        """Return the blocks that are kept (n,), with the whole path of temperature."""
        numbers = np.full(len(self) + 1, int(keep.sum()))
        numbers[:-1][keep] = np.arange(keep.sum())
        rest, level = (np.unique(part[keep], return_inverse=True)[1] for part in (self.rest, self.level))
        kept = {name: getattr(self, name)[keep] for name in ("start", "stop", "log", "temperature", "rate")}
        return replace(
            self,
            **kept,
            rest=rest,
            level=level,
            means={name: values[keep] for name, values in self.means.items()},
            nodes=tuple(track.renumbered(numbers) for track in self.nodes),
            ambient=None if self.ambient is None else self.ambient[keep],
        )

    def parted(self, edges: Sequence[int]) -> RestBlocks:
        """Return the same with a bias of its own from each of some blocks on."""
        level = self.level.copy()
        for edge in edges:
            same = (self.level == self.level[edge]) & (np.arange(len(self)) >= edge) & (self.log == self.log[edge])
            level[same] = level.max() + 1
        return replace(self, level=np.unique(level, return_inverse=True)[1])


def _about(group: IntArray, values: FloatArray) -> FloatArray:
    """Return the mean of values (n, m) over the group of each, (n, m)."""
    member = np.eye(int(group.max(initial=-1)) + 1)[group]
    return member @ (member.T @ values / member.sum(axis=0)[:, None])


def folds_of(legs: Sequence[Leg]) -> list[IntArray]:
    """Return the blocks that are left out in turn: whole legs where there are enough, else stretches of them."""
    parts = [leg.blocks for leg in legs]
    if len(parts) < WAYS:
        pieces = -(-WAYS // len(parts)) if len(parts) > 1 else WAYS + 1
        parts = [piece for part in parts for piece in np.array_split(part, pieces) if len(piece)]
        return parts[1:-1] if len(legs) == 1 else parts  # the ends of one leg could only be extrapolated to
    while len(parts) > _FOLDS:
        shortest = int(np.argmin([len(a) + len(b) for a, b in pairwise(parts)]))
        parts[shortest : shortest + 2] = [np.concatenate(parts[shortest : shortest + 2])]
    return parts


def _turning_points(celsius: FloatArray, least: float) -> list[int]:
    """Return where the temperature turns by `least` or more: in the middle of the plateau about each extreme."""
    turning, low, high, first = [], 0, 0, 0
    direction = 0
    for k, value in enumerate(celsius):
        low, high = (k if value < celsius[low] else low), (k if value > celsius[high] else high)
        if direction >= 0 and value < celsius[high] - least:
            if direction:
                turning.append(_plateau(celsius, high, first, k, least))
            direction, low, first = -1, k, high
        elif direction <= 0 and value > celsius[low] + least:
            if direction:
                turning.append(_plateau(celsius, low, first, k, least))
            direction, high, first = 1, k, low
    return turning


def _plateau(celsius: FloatArray, extreme: int, first: int, last: int, least: float) -> int:
    near = np.flatnonzero(abs(celsius[first : last + 1] - celsius[extreme]) < 0.3 * least) + first
    return int((near[0] + near[-1]) // 2)


def rest_blocks(recordings: Recording | Sequence[Recording], block: float | None = None) -> RestBlocks:
    """Average recordings of one unit at rest over blocks, with the temperature's path and rate.

    **Arguments:** `block`: length of a block, s; as many as make some six hundred if None. The rate of temperature is
    the slope of a line through `TEMPERATURE_WINDOW` seconds, as when a calibration is applied.

    Rows of a start-up transient are left out, and blocks in which the unit moved. Raises `InputError` for temperatures
    or stamps that are not in their stated unit, `NotPossibleError` where there is no temperature, it does not change,
    or the unit did not rest.
    """
    logs = [_with_finite_temperature(recording) for recording in recordings_of(recordings)]
    same_outputs(logs)
    for recording in logs:
        _require_temperature(recording)
    with prepared(logs, gyroscope=False, gravity=False) as ready:
        blocks = _of_ready(ready, block)
    findings = [note for one in ready for note in one.notes]
    return replace(blocks, notes=tuple(dict.fromkeys((*blocks.notes, *findings))))


def _of_ready(ready: Sequence[Prepared], block: float | None) -> RestBlocks:
    """The blocks of recordings that were looked over."""
    used = [without_startup(one.recording) for one in ready]
    span = sum(float(np.ptp(part.accelerometer.time)) for part in used)
    rate = min(part.accelerometer.rate for part in used)
    if block is None:
        block = max(span / _MOST_BLOCKS, 8 / rate, 1.0)
    elif not (np.isfinite(block) and block >= 2 / rate):
        raise InputError(f"a block of {block:g} s holds less than two samples at {rate:g} Hz: state a longer one.")
    lost = [one.left_out.get("temperature", np.zeros(0)) for one in ready]
    blocks = joined([_cut(recording, block, stamps) for recording, stamps in zip(used, lost, strict=True)])
    if (count := len(blocks)) > 3 * _MOST_BLOCKS:
        raise InputError(
            f"blocks of {block:g} s are {count}, more than {3 * _MOST_BLOCKS}, whose noise cannot be "
            f"handled together: state a block of {span / _MOST_BLOCKS:.2g} s or more."
        )
    names = ", ".join(recording.name for recording in used)
    if count < _FEWEST_BLOCKS or blocks.dropped > count:
        raise NotPossibleError(
            f"{names}: the unit was stationary in {count} of {count + blocks.dropped} blocks of {block:.3g} s, too "
            "few. Record it at rest, in one pose or a few, while the temperature changes slowly up and down."
        )
    low, high = blocks.range
    if high - low < LEAST_RANGE:
        raise NotPossibleError(
            f"{names}: the temperature only goes from {low:.2f} to {high:.2f} °C; {LEAST_RANGE:g} K or more are needed "
            "to see what depends on it. Record the unit at rest while it warms and cools over the range it is used in."
        )
    notes = [note for recording in used for note in recording.notes]
    if high > _HOTTEST or low < _COLDEST:
        extreme = high if high > _HOTTEST else low
        notes.append(
            f"the temperature reaches {extreme:.0f} °C; most sensors are made for {_COLDEST:g} to {_HOTTEST:g} °C. "
            "If it is in °F, state temperature [degF], in the header or with --columns."
        )
    if blocks.dropped:
        notes.append(f"{blocks.dropped} blocks of {block:.3g} s in which the unit moved were left out.")
    return replace(blocks, notes=tuple(dict.fromkeys(notes)))


def joined(parts: Sequence[RestBlocks]) -> RestBlocks:
    """Return the blocks of several recordings as those of one unit; every recording has rests of its own."""

    def whole(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(part, name) for part in parts])

    def counted(name: str, counts: Iterable[int]) -> IntArray:
        """Return indices that each part counts from zero, counted on from part to part."""
        starts = np.cumsum([0, *counts])[:-1]
        return np.concatenate([getattr(part, name) + start for part, start in zip(parts, starts, strict=True)])

    total = sum(map(len, parts))
    blocks = np.split(np.arange(total), np.cumsum(list(map(len, parts)))[:-1])
    return RestBlocks(
        tuple(recording for part in parts for recording in part.recordings),
        whole("start"),
        whole("stop"),
        counted("log", (len(part.nodes) for part in parts)),
        counted("rest", (int(part.rest.max(initial=-1)) + 1 for part in parts)),
        counted("level", (part.levels for part in parts)),
        whole("temperature"),
        whole("rate"),
        {name: np.concatenate([part.means[name] for part in parts]) for name in parts[0].means},
        tuple(
            track.renumbered(np.append(numbers, total))
            for part, numbers in zip(parts, blocks, strict=True)
            for track in part.nodes
        ),
        None if any(part.ambient is None for part in parts) else whole("ambient"),
        parts[0].duration,
        sum(part.dropped for part in parts),
        (),
    )


def _cut(recording: Recording, block: float, lost: FloatArray) -> RestBlocks:
    """Return block means of one recording, and its temperature's path.

    **Arguments:** `lost` (k,): stamps of temperatures that were no measurement; where a block has no others, it goes.
    """
    accelerometer, temperature = recording.accelerometer, course(recording.signals["temperature"])
    half = 0.5 / accelerometer.rate  # a sample stands for the time about its stamp
    begin, end = float(accelerometer.time[0]) - half, float(accelerometer.time[-1]) + half
    nodes = max(int(np.ceil((end - begin) / block * _NODES)), 2)
    edges = begin + block / _NODES * np.arange(nodes + 1)
    time = midpoints(edges)
    count = nodes // _NODES
    good, moved, means = np.ones(count, bool), np.zeros(count, bool), {}
    for name in TRIADS:
        if (signal := recording.signals.get(name)) is None:
            continue
        at = np.floor((signal.time - begin) / block).astype(int)
        inside = (at >= 0) & (at < count)
        at, values = at[inside], signal.si()[inside]
        good &= np.bincount(at, minlength=count) >= max(2, 0.5 * block * signal.rate)
        mean = means_by_group(at, values, count)
        scatter = means_by_group(at, (values - mean[at]) ** 2, count).sum(axis=1)
        moved |= scatter > _MOVING * (np.median(scatter[good]) if good.any() else 0.0)
        means[name] = mean
    parts = begin + block * np.arange(count + 1)
    good &= (np.histogram(lost, parts)[0] == 0) | (np.histogram(temperature.time, parts)[0] > 0)
    keep = np.flatnonzero(good & ~moved)
    means = {name: values[keep] for name, values in means.items()}
    jumps = lengths_of(np.diff(means["accelerometer"], axis=0)) > _TURNED
    celsius = _cells(temperature, edges)
    slope = smoothed_slope(temperature.time, temperature.values[:, 0], TEMPERATURE_WINDOW)
    slope = np.interp(time, temperature.time, slope)

    def by_block(values: FloatArray) -> FloatArray:
        return values[: count * _NODES].reshape(count, _NODES).mean(axis=1)[keep]

    kept = np.full(count + 1, len(keep))
    kept[keep] = np.arange(len(keep))
    start, ambient = np.asarray(begin + block * keep, np.float64), recording.ambient_temperature
    rest = np.concatenate([[0], jumps]).cumsum(dtype=np.int64)[: len(keep)]
    block_of_node = kept[np.minimum(np.arange(nodes) // _NODES, count)]
    return RestBlocks(
        (recording,),
        start,
        np.asarray(start + block, np.float64),
        np.zeros(len(keep), np.int64),
        rest,
        rest,
        by_block(celsius),
        by_block(slope),
        means,
        (Track(Stimulus(temperature=celsius, temperature_rate=slope, time=time), block_of_node),),
        None if ambient is None else by_block(_cells(ambient, edges)),
        float(block),
        int((good & moved).sum()),
        (),
    )


def _cells(signal: Signal, edges: NDArray[np.floating]) -> FloatArray:
    """Return means between edges of the line through a signal's samples, which goes on as it ends."""
    time, values = signal.time, signal.values[:, 0]
    whole = np.cumulative_sum(np.diff(time) * midpoints(values), include_initial=True)
    inside = edges.clip(time[0], time[-1])
    k = (time.searchsorted(inside, side="right") - 1).clip(0, len(time) - 2)
    integral = whole[k] + (inside - time[k]) * (values[k] + np.interp(inside, time, values)) / 2
    integral += (edges - inside) * np.where(edges < inside, values[0], values[-1])
    return np.diff(integral) / np.diff(edges)


def _with_finite_temperature(recording: Recording) -> Recording:
    """Return the recording without the temperatures that are no numbers, and say so."""
    signal = recording.temperature
    if signal is None or np.isfinite(signal.values).all():
        return recording
    kept = np.isfinite(signal.values).all(axis=1)
    note = f"{recording.name}: {int((~kept).sum())} temperatures that are no numbers were left out."
    finite = replace(signal, time=signal.time[kept], values=signal.values[kept])
    return replace(recording, temperature=finite, notes=(*recording.notes, note))


def _require_temperature(recording: Recording) -> None:
    where, temperature = recording.name, recording.temperature
    if temperature is None or len(temperature) < 2:
        remarks = "".join(f" {sentence(note)}" for note in recording.remarks)
        raise NotPossibleError(
            f"{where}: there is no temperature in this recording. Log the sensor's own temperature beside its output, "
            f"as a column such as temperature [degC].{remarks}"
        )
    low, high = float(temperature.values.min()), float(temperature.values.max())
    middle = float(np.median(temperature.values))
    if not -120.0 < middle < 200.0 or np.quantile(temperature.values, 0.9) > 200.0:
        likely = "K: state temperature [K]" if 200.0 <= middle < 400.0 else f"raw counts: {COUNTS_ADVICE}"
        raise InputError(
            f"{where}: the temperature lies between {low:.5g} and {high:.5g} °C, which no sensor survives; it looks "
            f"like {likely}, in the header or with --columns."
        )
    rate = recording.accelerometer.rate
    if not 0.01 < rate < 1e5:
        raise InputError(
            f"{where}: by its stamps it was sampled at {rate:.3g} Hz; they are probably not in the unit stated "
            "(time [us], time [ms] …)."
        )


def without_startup(recording: Recording) -> Recording:
    """Return the recording without the rows at its start that are far off what follows, and say so in its notes.

    A row is far off where some channel misses the straight line through the twelve rows after it by ten times the
    usual miss, and by ten of the channel's own steps.
    """
    signals = [recording.accelerometer, recording.gyroscope, recording.temperature]
    if not (first := max(_startup(signal) for signal in signals if signal is not None)):
        return recording
    stamp = recording.accelerometer.time[first]
    changed = {
        name: replace(signal, time=signal.time[keep], values=signal.values[keep])
        for name, signal in recording.signals.items()
        for keep in [signal.time >= stamp]
    }
    which = "row is" if first == 1 else f"{first} rows are"
    note = f"{recording.name}: the first {which} a start-up transient, far off what follows, and left out."
    return replace(recording, **changed, notes=(*recording.notes, note))


def _startup(signal: Signal) -> int:
    count, ahead = min(400, len(signal) // 3), 12
    if count < 2 * ahead:
        return 0
    values = signal.values[: count + ahead]
    x = np.arange(1, ahead + 1.0)
    # the value at 0 of the least-squares line through x = 1 … ahead
    weights = 1 / ahead - (x - x.mean()) * x.mean() / ((x - x.mean()) ** 2).sum()
    windows = np.lib.stride_tricks.sliding_window_view(values[1:], ahead, axis=0)  # (count, axes, ahead)
    miss = abs(values[:count] - windows[:count] @ weights)
    coarse = [steps_of(axis).min(initial=np.inf) for axis in signal.values.T]  # whose rows mostly miss nothing
    bad = np.flatnonzero((miss > _STARTUP * np.maximum(robust_sigma(miss, axis=0), coarse)).any(axis=1))
    end = 0
    for row in bad:
        if row >= end + _SOONEST:
            break
        end = int(row) + 1
    return end


def own_noise(blocks: RestBlocks, smooth: FloatArray) -> NoiseModel:
    """Fit white noise, flicker and a random walk to what smooth functions of temperature leave of the blocks.

    **Arguments:** `smooth` (n, k): what temperature may do, generously; it is projected off (restricted likelihood), so
    that slow noise is told by what no temperature explains. Some flicker is always taken to be there.

    Raises `NotPossibleError` where these functions could follow every block.
    """
    shortest = blocks.duration
    longest = 4 * max(blocks.spans)
    times = correlation_times(shortest, longest)
    taken = np.hstack([blocks.of_level, smooth / np.maximum(column_lengths(smooth), 1e-300)])
    null = scipy.linalg.null_space(taken.T, rcond=1e-9)
    if not null.shape[1]:
        raise NotPossibleError(
            f"{len(taken)} blocks of {blocks.duration:g} s at rest are too few to distinguish noise from what the "
            "temperature does. Record longer at rest while the temperature changes slowly up and down."
        )
    left = {name: null.T @ means for name, means in blocks.means.items()}
    flicker, walk = np.ones(len(times)), np.zeros(len(times))
    walk[-1] = 1.0  # so slow that it is a random walk here
    nothing = np.zeros(3)
    slow = [
        null.T @ blocks.covariance(AxisNoise(nothing, nothing, np.tile(shape, (3, 1)), times))[0] @ null
        for shape in (flicker, walk)
    ]
    sizes = [max(float(np.trace(covariance)), 1e-300) / len(covariance) for covariance in slow]
    tried: dict[str, list[tuple[FloatArray, ...]]] = {name: [] for name in left}
    for share in _WALKS:
        mixed = [(1 - share) / sizes[0], share / sizes[1]]
        values, vectors = np.linalg.eigh(mixed[0] * slow[0] + mixed[1] * slow[1])
        whole = 1 + _RATIOS[:, None] * np.maximum(values, 0.0)  # (R, m), over the blocks' white variance
        for name, means in left.items():
            power = (vectors.T @ means) ** 2  # (m, 3)
            scale = (power.T[:, None] / whole).mean(axis=-1)  # (3, R)
            scale = np.maximum(scale, _ROUNDING * (blocks.means[name] ** 2).mean() + 1e-30)  # an axis that is still
            cost = len(values) * np.log(scale) + np.log(whole).sum(axis=-1)
            best = np.arange(3), cost.argmin(axis=1)
            variance = (scale[best] * _RATIOS[best[1]])[:, None] * (mixed[0] * flicker + mixed[1] * walk)
            tried[name].append((cost[best], scale[best], variance))
    noise = {}
    for name, fits in tried.items():
        cost, white, variance = (np.stack(values) for values in zip(*fits, strict=True))
        best = cost.argmin(axis=0), np.arange(3)
        usual = _FLICKER**2 * white[best] * shortest * np.log(RATIO) / np.pi
        slowly = np.maximum(variance[best], usual[:, None])
        noise[name] = AxisNoise(white[best] * shortest, nothing, slowly, times, longest / 4)
    return NoiseModel(noise["accelerometer"], noise.get("gyroscope"))
