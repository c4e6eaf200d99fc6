"""Static poses and the turns between them, found in a `Recording`. NumPy, host side.

The detector is the windowed variance with an adaptive threshold of Tedaldi, Pretto and Menegatti (ICRA 2014), on the
accelerometer and the gyroscope, with two additions. The noise floor is the recording's own, not a still start's. And a
slow, smooth rotation, whose variance is as low as at rest, is told by its mean rate and by the drift of gravity.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaximu.ground.array_types import BoolArray, FloatArray, IntArray
from jaximu.ground.equality import Comparable
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.quantities import counted
from jaximu.ground.rotation import unit_vectors
from jaximu.ground.tracing import padded_size
from jaximu.ground.units import INERTIAL_QUANTITIES, STANDARD_GRAVITY
from jaximu.ground.vectors import dot_rows, lengths_of, variances_of
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.stimulus import REFERENCE_TEMPERATURE
from jaximu.recordings.observations import POWER_ON, Observations, Poses, SlowNoise, Turns
from jaximu.recordings.recording import PoseMeans, Recording, Signal, floor_of, runs_of

THRESHOLDS = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 100, 200, 400)
_DISTINCT = np.radians(5.0)  # neighbouring poses closer than this count as one that broke in two
_PARTS = 4  # of a turn, over each of which slow bias is taken as constant
_SHORTEST = 0.25  # s; what is correlated over less than this is white noise to poses and turns
_ONSET = np.radians(100.0)  # rad/s³; the rate of a quarter turn in three seconds grows by so much times t² at first
_CHANCE = 3.0  # standard deviations
_SETTLED, _FEWEST_SETTLED = 4.0, 6  # standard deviations of a mean over poses, and poses, that show what dies away
_SWINGS = np.radians(1.0)  # rad/s, rms of mean rates over windows; what lies still does less, and drifts less
_TORN = 10.0  # times what the gyroscope shows, that gravity cannot turn by
_BRIDGED = 3e-4  # rad; error that a gap may bring into a turn
_LONGEST_TURN = 60.0  # s; beyond it, gyroscope drift tells more about itself than about the gain
_STOP_WINDOW, _LEAST_OF_STOP = 1.0, 0.5  # s; and what a stop must have left beside half a window at either end
_PARTED = 0.8  # share of the variance of log variances between two classes; evenly spread values have 0.75
_STEADY = 0.1  # m/s²; how far the mean force over a second of a stop may lie from the stop's
_UPRIGHT, _TURNED = np.radians(25.0), 0.1
"""How far the force on an upright unit may lie from its median, and in which share of the windows farther."""


@dataclass(frozen=True)
class SegmentationOptions:
    """How poses are sought.

    window: s, over which variance and mean are taken. minimum_duration: s, shortest pose. threshold: variance over
    noise floor up to which a window is still; None tries `THRESHOLDS`. fewest: poses without which there is nothing to
    calibrate. rate_limit: rad/s, largest mean rate that may pass as still, before the recording's own spread widens it.
    """

    window: float = 0.25
    minimum_duration: float = 0.8
    threshold: float | None = None
    fewest: int = 2
    rate_limit: float = float(np.radians(0.3))


@dataclass(frozen=True, eq=False)
class Segmentation(Comparable):
    """Poses found in one recording, and how.

    intervals: (P, 2) start and stop (s, on the recording's clock). threshold: the factor used. tried: by factor the
    number of intervals. notes: sentences for the user. torn: numbers of turns whose motion is not in the recording.
    """

    recording: Recording
    intervals: FloatArray
    threshold: float
    tried: Mapping[float, int]
    notes: tuple[str, ...]
    torn: tuple[int, ...] = ()

    def table(self) -> str:
        """Say in one line how many intervals each threshold gave."""
        return ", ".join(f"{count} at {factor:g}x" for factor, count in self.tried.items())


class Moments:
    """Running sums of a signal in SI and of its square, from which mean and variance over any samples follow."""

    def __init__(self, signal: Signal) -> None:
        values = signal.si().T
        self.signal = signal
        self._origin = values.mean(axis=1, keepdims=True)
        values = values - self._origin  # sums of squares lose fewer digits around the mean
        self._sums, self._squares = np.zeros((2, 3, len(signal) + 1))  # an axis a row
        np.cumsum(values, axis=1, out=self._sums[:, 1:])
        np.square(values, out=values).cumsum(axis=1, out=self._squares[:, 1:])

    def between(self, start: FloatArray, stop: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
        """Mean (W, 3) and unbiased variance (W, 3) of the samples from `start` to before `stop`, and their number."""
        first, last = np.searchsorted(self.signal.time, start), np.searchsorted(self.signal.time, stop)
        count = last - first
        safe = np.maximum(count, 2)
        mean, square = ((sums[:, last] - sums[:, first]) / safe for sums in (self._sums, self._squares))
        return (mean + self._origin).T, np.maximum((square - mean**2) * (safe / (safe - 1)), 0.0).T, count


def _windows(moments: Moments, centres: FloatArray, width: float) -> tuple[FloatArray, FloatArray]:
    """Mean (W, 3) and summed variance (W,) over windows around `centres`; a gap is not rest."""
    mean, variance, count = moments.between(centres - width / 2 - 1e-9, centres + width / 2 - 1e-9)
    return mean, np.where(count >= max(3, 0.5 * width * moments.signal.rate), variance.sum(axis=1), np.inf)


def windows_with_samples(time: FloatArray, last: float) -> FloatArray:
    """Return the numbers 0, 1, … (W,) up to `last` of windows, less those further than 8 from every sample where two
    neighbouring samples are over 32 apart. Samples are at times (n,), in windows: the clock may be set forward by
    years.
    """
    pauses = np.flatnonzero(np.diff(time) > 32)
    first = np.concatenate([[0.0], np.floor(time[pauses + 1]) - 8])
    stop = np.concatenate([time[pauses] + 8, [np.inf]]).clip(max=last + 0.5)
    return np.concatenate([np.arange(low, high) for low, high in zip(first, stop, strict=True)])


def _floor(variance: FloatArray, moments: Moments) -> float:
    """The variance of windows at rest: the median of those near the lowest."""
    floor = floor_of(variance[np.isfinite(variance)])
    # Quantised output can be constant at rest; then a step's rounding variance is the least that can be claimed. And
    # simulated output without noise is constant but for the rounding of the running sums.
    total = moments.between(np.array([-np.inf]), np.array([np.inf]))[1].sum()
    return max(floor, moments.signal.rounding_variance, np.finfo(np.float64).eps * len(moments.signal) * total)


def _angles(vectors: FloatArray, others: FloatArray) -> FloatArray:
    """Angle (rad) between each vector and the other of its row, or one for all."""
    return 2 * np.arcsin((lengths_of(unit_vectors(others) - unit_vectors(vectors)) / 2).clip(0, 1))


def _samples(signal: Signal, intervals: FloatArray) -> list[FloatArray]:
    """The samples (3, n) of each interval."""
    return [signal.values[first:last].T for first, last in signal.time.searchsorted(intervals)]


@dataclass(frozen=True, eq=False)
class _Scan:
    """Windows over a recording, a step of an eighth apart.

    width: s; centres (W,): s. means: (W, 3) of each sensor, SI. ratio (W,): variance over the noise floor, of the
    sensor where it is larger. floor: of the last sensor.
    """

    width: float
    centres: FloatArray
    moments: tuple[Moments, ...]
    means: tuple[FloatArray, ...]
    ratio: FloatArray
    floor: float

    @classmethod
    def of(cls, recording: Recording, window: float) -> "_Scan":
        """Scan a recording by windows of so many seconds or a little more. Raises `NotPossibleError` if it is short."""
        signals = [signal for signal in (recording.accelerometer, recording.gyroscope) if signal is not None]
        # A slow logger needs a longer window to hold enough samples for a variance.
        width = max(window, 10 / min(signal.rate for signal in signals))
        start = max(signal.time[0] for signal in signals) + width / 2
        end = min(signal.time[-1] for signal in signals) - width / 2
        if end - start < width:
            raise NotPossibleError(
                f"{recording.name}: the recording lasts {end - start + width:.2f} s, too short to find poses: record "
                "at least nine orientations at rest for two seconds or more each, with turns between them."
            )
        step = width / 8
        centres = start + step * windows_with_samples((signals[0].time - start) / step, (end - start) / step)
        moments = tuple(Moments(signal) for signal in signals)
        means, variances = zip(*(_windows(running, centres, width) for running in moments), strict=True)
        for signal, variance, name in zip(signals, variances, INERTIAL_QUANTITIES, strict=False):
            if not np.isfinite(variance).any():
                raise NotPossibleError(
                    f"{recording.name}: the {name} has too many gaps: nowhere does it keep its rate of "
                    f"{signal.rate:.4g} Hz for long enough to separate rest from motion."
                )
        floors = [_floor(variance, running) for variance, running in zip(variances, moments, strict=True)]
        ratio = np.stack([variance / floor for variance, floor in zip(variances, floors, strict=True)]).max(axis=0)
        return cls(width, centres, moments, means, ratio, floors[-1])


def segment(recording: Recording, options: SegmentationOptions | None = None) -> Segmentation:
    """Find the static poses of a recording.

    Raises `NotPossibleError` when fewer than `fewest` are found, with the number of intervals at each threshold and
    what is missing.
    """
    options = options or SegmentationOptions()
    gyroscope, scan = recording.gyroscope, _Scan.of(recording, options.window)
    width, centres, means, ratio = scan.width, scan.centres, scan.means, scan.ratio
    turning = np.zeros(len(centres)) if gyroscope is None else _turning(means[1], ratio, options.rate_limit)
    sums = np.cumulative_sum(means[0], axis=0, include_initial=True)

    def runs(factor: float) -> tuple[FloatArray, int]:
        # A unit held by hand trembles: where much variance must pass as still, so must the mean rate it brings along.
        first, last = runs_of((ratio < factor) & (turning < max(1.0, np.sqrt(factor / 12)))).T
        # Every window of a run passed as a whole. What motion it may hold at its outer end, where motion sets in
        # gently, grows with the variance that passes: so does what is cut off there, from 1/8 to 3/4 of a window.
        cut = width * min(np.log2(factor) / 8, 0.75)
        if gyroscope is not None:  # a rate of c t² over a part x of a window adds c² x⁵ / 5 w to its variance
            cut = max(cut, min((5 * width * factor * scan.floor / _ONSET**2) ** 0.2, width))
        margin = width / 2 - cut
        intervals = np.stack([centres[first] - margin, centres[last - 1] + margin], axis=1)
        long = np.diff(intervals)[:, 0] >= options.minimum_duration
        directions = (sums[last[long]] - sums[first[long]]) / (last - first)[long, None]
        distinct = int(len(directions) > 0) + int((_angles(directions[:-1], directions[1:]) > _DISTINCT).sum())
        return intervals[long], distinct

    factors = THRESHOLDS if options.threshold is None else (options.threshold,)
    results = [runs(factor) for factor in factors]
    counts = [len(intervals) for intervals, _ in results]
    # The lowest threshold that finds about all orientations there are without breaking poses in two.
    score = np.array(
        [distinct - 0.5 * (count - distinct) for count, (_, distinct) in zip(counts, results, strict=True)]
    )
    best = score.max()  # negative where the same few orientations come back again and again
    chosen = int((score >= best - 0.05 * abs(best)).argmax())
    intervals, notes = _drop_rotating(scan.moments, results[chosen][0])
    if len(intervals) < options.fewest:
        raise NotPossibleError(
            f"{recording.name}: {_why_no_poses(results[chosen][0], centres[-1] - centres[0], means, notes)}"
        )
    intervals = _settled(scan.moments, intervals, options.minimum_duration)
    tried = dict(zip(factors, counts, strict=True))
    torn, remarks = _torn(scan.moments, intervals)
    return Segmentation(recording, intervals, float(factors[chosen]), tried, (*notes, *remarks), torn)


def _settled(moments: Sequence[Moments], intervals: FloatArray, shortest: float) -> FloatArray:
    """Return poses (P, 2) without the beginnings in which a sensor's output still dies away, as behind a filter.

    All poses together show it: a beginning is off the pose's second half against the way that the force turned, or
    along the rate of the turn before, by more than the poses scatter. Twice as long is left out; a pose keeps
    `shortest` seconds at least.
    """
    start, stop = intervals.T
    width = max(shortest / 8, *(2 / running.signal.rate for running in moments))
    steady = [running.between((start + stop) / 2, stop)[0] for running in moments]
    ways = [steady[0][:-1] - steady[0][1:]]
    ways += [
        running.between(stop[:-1], start[1:])[0] - np.median(rest, axis=0)
        for running, rest in zip(moments[1:], steady[1:], strict=True)
    ]
    cut = 0.0
    while len(room := 1 + np.flatnonzero((stop - start)[1:] > 2 * (cut + width))) >= _FEWEST_SETTLED:
        begins = start[room] + cut
        parts = [running.between(begins, begins + width)[0] for running in moments]
        off = [
            dot_rows(part - rest[room], unit_vectors(way[room - 1]))
            for part, rest, way in zip(parts, steady, ways, strict=True)
        ]
        if max(np.mean(one) / max(np.std(one), 1e-9) for one in off) < _SETTLED / np.sqrt(len(room)):
            break
        cut += width
    start[1:] += np.clip(2 * cut, 0.0, np.maximum(stop - start - shortest, 0.0))[1:]
    return np.stack([start, stop], axis=1)


def _torn(moments: Sequence[Moments], intervals: FloatArray) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Which turns' motion is not in the log, and what is said of it: gravity turns by far more than the gyroscope.

    Where only some turns are so, samples were lost in them, which is looked for by a fit.
    """
    force, *rates = (running.between(*intervals.T)[0] for running in moments)
    if not rates:
        return (), ()
    gyroscope, gravity = moments[1].signal, _angles(force[:-1], force[1:])
    shown = np.cumulative_sum(
        lengths_of(gyroscope.si() - np.median(rates[0], axis=0)) * np.diff(gyroscope.edges), include_initial=True
    )
    between = gyroscope.time.searchsorted(intervals.ravel()[1:-1].reshape(-1, 2))
    path = np.diff(shown[between])[:, 0]
    torn, turned = gravity > _TORN * path + _DISTINCT, gravity > _DISTINCT
    if torn.sum() <= turned.sum() / 2:
        return (), ()
    return tuple(np.flatnonzero(torn).tolist()), (
        f"gravity turns by up to {np.degrees(gravity[torn].max()):.0f}° from pose to pose where the gyroscope shows "
        f"{np.degrees(path[torn].max()):.2g}° at most, in {torn.sum()} of {turned.sum()} turns: their motion is not in "
        "the log, as where poses were recorded apart and put together. These turns are left out. Log everything from "
        "the first pose to the last.",
    )


def find_stops(recording: Recording) -> Segmentation | None:
    """Find where a unit rests that stays upright in motion, as in a vehicle that stops; None for any other recording.

    Orientations cannot choose the threshold here, so it is where quiet and moving windows part best (Otsu 1979).

    Raises `NotPossibleError` for a vehicle that never stops for two seconds.
    """
    scan = _Scan.of(recording, _STOP_WINDOW)
    force = scan.means[0]
    turned = (_angles(force, np.median(force, axis=0)) > _UPRIGHT).mean()
    limits = (_STEADY, SegmentationOptions.rate_limit)  # of force and rate; beyond either the unit moves
    off = [lengths_of(mean - np.median(mean, axis=0)) for mean in scan.means]
    moving = np.mean([values > limit for values, limit in zip(off, limits, strict=False)], axis=1).max()
    if turned > _TURNED or moving < _TURNED:
        return None
    threshold, parted = _parting(np.log(scan.ratio[np.isfinite(scan.ratio)]))
    quiet = (scan.ratio < np.exp(threshold)) & (parted > _PARTED)
    steady = np.zeros(len(quiet), bool)
    for first, last in runs_of(quiet):  # what vibrates at rest hides how gently motion sets in
        off = lengths_of(force[first:last] - np.median(force[first:last], axis=0))
        steady[first:last] = off < max(_STEADY, _CHANCE * np.median(off))
    first, last = runs_of(steady).T
    intervals = np.stack([scan.centres[first] + scan.width / 2, scan.centres[last - 1] - scan.width / 2], axis=1)
    intervals, notes = _drop_rotating(scan.moments, intervals[np.diff(intervals)[:, 0] > _LEAST_OF_STOP])
    if not len(intervals):
        raise NotPossibleError(
            f"{recording.name}: no stop was found, at which a vehicle stands still for two seconds or more with less "
            "vibration than in motion. Record a drive with stops of ten seconds or more."
        )
    factor = float(np.exp(threshold))
    return Segmentation(recording, intervals, factor, {factor: len(intervals)}, tuple(notes))


def _parting(values: FloatArray) -> tuple[float, float]:
    """Return where values part best into two classes, and the share of their variance that lies between these."""
    values = np.sort(values)
    sums, share = values.cumsum(), np.arange(1, len(values)) / len(values)
    mean = sums[-1] / len(values)
    between = (share * mean - sums[:-1] / len(values)) ** 2 / (share * (1 - share))
    best = int(between.argmax())
    return float(values[best : best + 2].mean()), float(between[best] / max(values.var(), 1e-300))


def _why_no_poses(intervals: FloatArray, duration: float, means: tuple[FloatArray, ...], notes: Sequence[str]) -> str:
    """Say what a recording without poses is instead, and what to record; `means` (W, 3) of the windows, by sensor."""
    record = (
        "A calibration needs at least nine orientations: hold the unit still for two seconds or more in each, and turn "
        "it between them."
    )
    force, *rates = means
    off = _angles(force, np.median(force, axis=0))
    upright = np.quantile(off, 0.99) < _DISTINCT and np.diff(intervals).sum() > 0.5 * duration
    swing = [np.sqrt(np.mean((rate - np.median(rate, axis=0)) ** 2) * 3) for rate in rates]
    if upright and swing and swing[0] > _SWINGS:
        return f"0 static poses found: the unit swings by {np.degrees(swing[0]):.2g} °/s (rms) throughout. {record}"
    if upright:
        return (
            "1 static pose found: the unit lay in one orientation throughout. That shows its noise (jaximu allan) and, "
            f"with a temperature beside it, its drift (jaximu thermal). {record}"
        )
    poses = counted(0 if notes else len(intervals), "static pose")
    return f"{poses} found. {' '.join([*notes[:1], record])}"


def _turning(rate: FloatArray, ratio: FloatArray, limit: float) -> FloatArray:
    """Each window's mean rate off the bias, over what passes as still: slow rotation has another mean, not variance."""
    quiet = ratio < 4
    if quiet.sum() < 4:
        return np.zeros(len(rate))
    deviation = lengths_of(rate - np.median(rate[quiet], axis=0))
    return deviation / max(limit, 6 * np.median(deviation[quiet]))


def _drop_rotating(moments: Sequence[Moments], intervals: FloatArray) -> tuple[FloatArray, list[str]]:
    """Drop intervals that turn slowly: gravity drifts between their halves, or the mean rate is off all others'.

    A rate about the vertical leaves gravity where it is. One at more than 30° to it that did not move gravity is the
    gyroscope's own, a step of its bias: where most of those that are off are such, none is taken for a turn.
    """
    start, stop = intervals.T
    middle = (start + stop) / 2
    (before, *spread), (after, *later) = moments[0].between(start, middle), moments[0].between(middle, stop)
    length = lengths_of(before)
    noise = np.sqrt(sum(variance.sum(axis=1) / np.maximum(count, 1) for variance, count in (spread, later))) / length
    keep = _angles(before, after) < np.maximum(np.radians(0.2), 6 * noise)
    keep &= np.minimum(spread[1], later[1]) >= 3
    if len(moments) > 1 and keep.sum() > 2:
        means = moments[1].between(start, stop)[0]
        rate = means - np.median(means[keep], axis=0)
        deviation = lengths_of(rate)
        off = keep & (deviation >= max(np.radians(0.1), 8 * np.median(deviation[keep])))
        up, lasting = unit_vectors(before), middle - start
        missing = lengths_of(np.cross(up, rate) * lasting[:, None] - (unit_vectors(after) - up))
        denied = off & (missing > np.maximum(deviation * lasting / 2, 6 * noise))
        if 2 * denied.sum() <= off.sum():
            keep &= ~off
    dropped = intervals[~keep]
    if not len(dropped):
        return intervals, []
    shown = ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in dropped[:3]) + (" …" if len(dropped) > 3 else "")
    return intervals[keep], [
        f"{counted(len(dropped), 'quiet interval')} skipped: the unit turned slowly there ({shown})."
    ]


def rest_statistics(
    signal: Signal, intervals: FloatArray, turning: bool = False
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Noise density (3, 3), output unit² · s, the mean (P, 3) of each interval, and its covariance (P, 3, 3).

    The density is the variance of block means times the block's duration, pooled over all intervals: it takes in what
    a low-pass filter or a vibration adds to neighbouring samples. An interval noisier than the others by half or more
    gets its own share. Steps coarser than the noise shift means, those of a gyroscope (`turning`) all alike.
    """
    columns = _samples(signal, intervals)
    counts = np.array([column.shape[1] for column in columns])
    first = counts.cumsum() - counts
    values = np.concatenate(columns, axis=1)
    mean = np.add.reduceat(values, first, axis=1) / counts
    squares = np.add.reduceat(np.square(values - mean.repeat(counts, axis=1)), first, axis=1)
    variances = (squares / counts).T / np.square(signal.nominal_scale)
    total = variances.sum(axis=1)
    share = total / max(np.median(total), signal.rounding_variance)  # coarse steps may leave no scatter at all
    calm = [column for column, size in zip(columns, share, strict=True) if size < 2] or columns
    (density, _), sway = _density(signal, calm), np.zeros((3, 3))
    rounding = _rounding(signal, columns).T[:, :, None] * np.eye(3)
    if turning:
        density, sway = _without_sway(signal, calm, density)
        rounding = rounding * len(intervals)  # every pose reads the same rate, and rounds it the same way
    duration, factor = (counts / signal.rate)[:, None, None], np.where(share > 1.5, share, 1.0)[:, None, None]
    return density, mean.T, factor * (density / duration + sway / duration**2) + rounding


def _without_sway(signal: Signal, columns: Sequence[FloatArray], density: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a gyroscope's density (3, 3) without the sway of the hand that holds it, and the sway's variance · s².

    A sway keeps its angle within bounds, of variance A²: a mean rate over T is off by the difference of its angle from
    end to end, 2 A²/T², where white noise N leaves N²/T. Means of the n blocks of an interval, L each, scatter about
    their mean by N²/L + 2 A²/L² · (n + 1)/n, for neighbours share an end. Halves and quarters tell the two apart, where
    halves scatter less than the shortest blocks would have it by more than chance. What sways between the ends of a
    turn is left to the excess of the turns.
    """
    shortest, size = signal.samples(_SHORTEST), int(np.quantile([part.shape[1] for part in columns], 0.2)) // 4
    if size < max(shortest, 1):
        return density, np.zeros((3, 3))
    (first, _), (quarter, _), (half, freedom) = (_of_blocks(signal, columns, n) for n in (shortest, size, 2 * size))
    chance = np.sqrt(2 / (3 * max(freedom, 1)))
    before, longer = (_density_ratio(part, half) for part in (first, quarter))
    if not freedom or before * (1 - _CHANCE * chance) < 1:
        return density, np.zeros((3, 3))
    sway = min(max(longer - 1, 0.0), (1 - chance) / 1.5)  # of the halves' density, 1 = white + 3/2 sway
    return (1 - 1.5 * sway) * half, sway * half * (2 * size / signal.rate)


def _across_gravity(signal: Signal, intervals: FloatArray, force: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the covariance (P, 3, 3) of the mean forces (P, 3); along gravity hands that sway add nothing to it.

    A sway by θ moves the force by gθ across gravity and by gθ²/2 along it. Where the scatter along gravity is less than
    `covariance` has it, by more than chance, that part takes its share.
    """
    up = unit_vectors((force - signal.nominal_offset) / signal.nominal_scale)
    onto = (signal.nominal_scale * up)[:, :, None] * (up / signal.nominal_scale)[:, None]
    columns = [part @ column for part, column in zip(onto, _samples(signal, intervals), strict=True)]
    along, freedom = _density(signal, columns)
    expected = (onto @ covariance @ onto.mT * np.diff(intervals)[:, :, None]).mean(axis=0)
    scattered, stated = ((np.diagonal(part) / signal.nominal_scale**2).sum() for part in (along, expected))
    share = float(scattered / stated)
    if not freedom or share > 1 - _CHANCE * np.sqrt(2 / freedom):
        return covariance
    kept = np.eye(3) - (1 - np.sqrt(share)) * onto
    return kept @ covariance @ kept.mT


def _density(signal: Signal, columns: Sequence[FloatArray]) -> tuple[FloatArray, int]:
    """Return the density (3, 3) of the shortest blocks, or of longer ones where it falls by more than chance.

    What a hand trembles averages out within a second or so: blocks of a quarter would take it for white noise, tens of
    times too much of it for the mean of a pose. With it its degrees of freedom for each axis. `columns`: the samples
    (3, n) of each interval at rest.
    """
    size = max(1, signal.samples(_SHORTEST))
    best = _of_blocks(signal, columns, size)
    for factor in (2, 4):
        longer, freedom = _of_blocks(signal, columns, factor * size)
        if freedom and _density_ratio(longer, best[0]) < 1 - _CHANCE * np.sqrt(2 / (3 * freedom)):
            best = longer, freedom
    return best


def _density_ratio(density: FloatArray, other: FloatArray) -> float:
    """How many times a density (3, 3) is another one, over the axes; one without noise has no scatter."""
    return float((np.diagonal(density) / np.maximum(np.diagonal(other), 1e-300)).mean())


def _of_blocks(signal: Signal, columns: Sequence[FloatArray], size: int) -> tuple[FloatArray, int]:
    """Return the density (3, 3) by means of `size` samples, and its degrees of freedom for each axis."""
    quantum = np.diag(np.square(signal.nominal_scale) * signal.rounding_variance / 3 / size)
    number = np.array([column.shape[1] // size for column in columns])
    if np.any(number > 1):
        kept = [column[:, : count * size] for column, count in zip(columns, number, strict=True) if count > 1]
        number = number[number > 1]
        blocks = np.concatenate(kept, axis=1).reshape(3, -1, size).mean(axis=2)
        means = np.add.reduceat(blocks, np.cumsum(number) - number, axis=1) / number
        deviations = (blocks - np.repeat(means, number, axis=1)) * np.sqrt(np.repeat(number / (number - 1), number))
        scatter = deviations @ deviations.T / deviations.shape[1]
    else:  # no interval holds two blocks
        scatter = np.diag(np.median([np.var(column, axis=1) for column in columns], axis=0)) / size
    return (scatter + 1e-3 * quantum) * size / signal.rate, int(np.maximum(number - 1, 0).sum())


def _rounding(signal: Signal, columns: Sequence[FloatArray]) -> FloatArray:
    """(3, P) variance, in output units, by which rounding to steps shifts the means of intervals, given their samples.

    Noise of σ dithers a step q: what is left of the mean's error is q/π · exp(−2π²σ²/q²), of random sign and phase,
    and at most that of rounding itself. Samples of one level, or of two, do not tell the noise.
    """
    step = signal.step * signal.nominal_scale
    rounding = np.maximum(step**2 / 12, 1e-30)[:, None]
    variance, spread = (np.array([size(column, axis=1) for column in columns]).T for size in (np.var, np.ptp))
    quiet = np.maximum(variance / rounding - 1, 0.0) * (spread > 1.5 * step[:, None])  # σ² over q²/12
    return rounding * np.minimum(1.0, 6 / np.pi**2 * np.exp(-(np.pi**2) / 3 * quiet))


def noise_by_model(
    signal: Signal, noise: AxisNoise | None, name: str, start: FloatArray, stop: FloatArray, same: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """White density (3, 3) and covariance (3, n, n) of slow bias over intervals, in output units; `same` (n, n) tells
    which intervals belong to one recording: between power-ons nothing is carried over.

    Raises `InputError` where the model lacks the sensor called `name`, or was made in other units.
    """
    if noise is None:
        raise InputError(f"the recording at rest has no {name}, but the one to calibrate has one.")
    sigma = np.sqrt(np.median(noise.covariance([0.0], [1.0])) * signal.rate)
    if sigma < 1e-3 * np.sqrt(signal.rounding_variance):
        raise InputError(
            f"the recording at rest has a {name} noise of {sigma:.2g} SI units a sample, a thousandth of the step to "
            "which the other recording is rounded: one of the two is in other units than it says."
        )
    white, slow = noise.split(_SHORTEST)
    scale = np.square(signal.nominal_scale)
    return np.diag(white * scale), slow.covariance(start, stop) * scale[:, None, None] * same


_Turn = tuple[FloatArray, FloatArray]
"""Gyroscope output (n, 3) and the seconds (n,) over which each sample holds."""
_NO_TURN: _Turn = np.zeros((0, 3)), np.zeros(0)


def observed_poses(
    segmentations: Segmentation | Sequence[Segmentation],
    gravity: float,
    bucket: tuple[int, int] | None = None,
    noise: NoiseModel | None = None,
) -> Observations:
    """Distil one or several segmented recordings of one unit into padded `Observations`.

    Between recordings there is no turn. Where several are given, each one's gyroscope output is shifted by the
    difference of its mean at rest to the first one's, because the bias changes from power-on to power-on.
    `noise` is a model fitted to the unit at rest; without one the scatter within the poses tells the noise. `bucket`
    overrides the padded numbers of poses and of samples in a turn, to stack units of a fleet.
    """
    parts = [segmentations] if isinstance(segmentations, Segmentation) else list(segmentations)
    rests: list[dict[str, FloatArray]] = []
    turns, densities = [], []
    first_rest: FloatArray | None = None
    for part in parts:
        recording, intervals = part.recording, part.intervals
        accelerometer, gyroscope = recording.accelerometer, recording.gyroscope
        _, force, force_covariance = rest_statistics(accelerometer, intervals)
        density, rate, rate_covariance = np.eye(3), *_no_means(len(intervals))
        between = [_NO_TURN] * (len(intervals) - 1)
        if gyroscope is not None:
            density, rate, rate_covariance = rest_statistics(gyroscope, intervals, turning=True)
            middle = np.median(rate, axis=0)
            first_rest = middle if first_rest is None else first_rest
            shift = middle - first_rest
            rate = rate - shift
            turned = _turns(gyroscope, intervals, shift)
            between = [_NO_TURN if at in part.torn else turn for at, turn in enumerate(turned)]
        rests.append(
            {
                "accelerometer_mean": force,
                "accelerometer_covariance": _across_gravity(accelerometer, intervals, force, force_covariance),
                "gyroscope_mean": rate,
                "gyroscope_covariance": rate_covariance,
                "start": intervals[:, 0],
                "stop": intervals[:, 1],
                "temperature": _temperature(recording, intervals),
                "force": (force - accelerometer.nominal_offset) / accelerometer.nominal_scale,
            }
        )
        densities.append(density)
        turns += [*between, _NO_TURN]  # from the recording's end to the start of the next one
    columns = {name: np.concatenate([rest[name] for rest in rests]) for name in rests[0]}
    offset = parts[0].recording.accelerometer.nominal_offset
    observations = _padded(columns, turns[:-1], np.mean(densities, axis=0), offset, gravity, bucket)
    return observations if noise is None else _with_noise(observations, parts, noise)


def _no_means(count: int) -> tuple[FloatArray, FloatArray]:
    """Means (P, 3) and covariances (P, 3, 3) of a sensor that is not there."""
    return np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1))


def observe_means(means: PoseMeans, gravity: float) -> Observations:
    """Return a table of pose means as padded `Observations` without turns.

    Where no deviations are stated, digits alone tell how far a mean is off, which is the least it can be.
    """
    accelerometer = means.recording.accelerometer
    count = len(accelerometer)
    columns = {
        "start": np.arange(count, dtype=float),
        "stop": np.arange(1.0, count + 1),
        "temperature": np.full(count, REFERENCE_TEMPERATURE),
        "force": accelerometer.si(),
    }
    for name in INERTIAL_QUANTITIES:
        signal, sigma = getattr(means.recording, name), getattr(means, f"{name}_sigma")
        values, covariance = _no_means(count)
        if signal is not None:
            if sigma is None:
                sigma = np.full((count, 3), _written_step(signal) / np.sqrt(12))
            values, covariance = signal.values, sigma[:, :, None] ** 2 * np.eye(3)
        columns |= {f"{name}_mean": values, f"{name}_covariance": covariance}
    return _padded(columns, [], np.eye(3), accelerometer.nominal_offset, gravity)


def _written_step(signal: Signal) -> float:
    """Return the step, in output units, of the digits in which a table is written, in SI, g or °/s."""
    units = {"m/s^2": STANDARD_GRAVITY, "rad/s": np.radians(1.0)}
    for digits in range(9):
        for unit in (1.0, units.get(signal.unit, 1.0)):
            scaled = signal.values / unit * 10.0**digits
            if (abs(scaled - scaled.round()) < 1e-6 * np.maximum(abs(scaled), 1.0)).all():
                return unit * 10.0**-digits
    return 1e-9


def _padded(
    columns: dict[str, FloatArray],
    turns: Sequence[_Turn],
    density: FloatArray,
    offset: FloatArray,
    gravity: float,
    bucket: tuple[int, int] | None = None,
) -> Observations:
    """Pad the fields of poses, nominal specific `force` (P, 3) among them, and the turns between them to a bucket."""
    poses = len(columns["force"])
    longest = max((len(interval) for _, interval in turns), default=1)
    padded, samples = bucket or (padded_size(poses), padded_size(longest, 16))
    output, interval = np.zeros((padded - 1, samples, 3)), np.zeros((padded - 1, samples))
    for index, (values, durations) in enumerate(turns):
        output[index, : len(values)], interval[index, : len(values)] = values, durations
    up = np.array([0.0, 0.0, gravity])
    fills = {
        "accelerometer_mean": offset + up,
        "accelerometer_covariance": np.eye(3),
        "gyroscope_covariance": np.eye(3),
        "temperature": REFERENCE_TEMPERATURE,
        "force": up,
    }
    columns = {
        name: np.concatenate([values, np.broadcast_to(fills.get(name, 0.0), (padded - poses, *values.shape[1:]))])
        for name, values in columns.items()
    }
    across = columns.pop("force")[1:, None, :]
    return Observations(
        poses=Poses(**columns, mask=np.arange(padded) < poses),
        turns=Turns(
            output=output,
            interval=interval,
            noise=density,
            # the right singular vectors of a direction: itself, and two that span the plane across it
            basis=np.linalg.svd(across)[2][:, 1:, :],
            mask=interval.any(axis=1),
        ),
        gravity=np.asarray(gravity),
    )


def _with_noise(observations: Observations, parts: Sequence[Segmentation], noise: NoiseModel) -> Observations:
    """Replace what the poses' scatter tells of the noise by what the model says."""
    poses, turns = observations.poses, observations.turns
    padded, count = len(poses.mask), int(np.sum(poses.mask))
    start, stop = poses.start[:count], poses.stop[:count]
    at_rest = np.arange(count)
    power_on = np.arange(len(parts)).repeat([len(part.intervals) for part in parts])
    signals = parts[0].recording.signals

    def of_poses(covariance: FloatArray) -> FloatArray:
        return variances_of(covariance)[:, :padded].T[:, :, None] * np.eye(3)

    def by_model(
        name: str, start: FloatArray, stop: FloatArray, same: BoolArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """White density and covariance over intervals of which the first are the poses, white noise in theirs.

        And the variance (3, P) by which rounding shifts the means of the poses.
        """
        white, slow = noise_by_model(signals[name], getattr(noise, name), name, start, stop, same)
        slow[:, at_rest, at_rest] += np.diag(white)[:, None] / (stop - start)[:count]
        recorded = [(part.recording.signals[name], part.intervals) for part in parts]
        rounding = [_rounding(signal, _samples(signal, intervals)) for signal, intervals in recorded]
        return white, slow, np.concatenate(rounding, axis=1)

    forces, rates = (np.tile(np.eye(size), (3, 1, 1)) for size in (padded, padded + _PARTS * len(turns.mask)))
    _, slow, rounding = by_model("accelerometer", start, stop, power_on[:, None] == power_on)
    slow[:, at_rest, at_rest] += rounding
    forces[:, :count, :count] = slow
    poses = replace(poses, accelerometer_covariance=of_poses(forces))
    part_of_turn = np.zeros(turns.interval.shape, np.int64)
    if "gyroscope" in signals:
        used = np.flatnonzero(turns.mask[: count - 1])
        elapsed = np.cumsum(turns.interval, axis=1) - turns.interval / 2
        total = np.maximum(np.sum(turns.interval, axis=1, keepdims=True), 1e-9)
        part_of_turn = np.minimum(_PARTS - 1, (_PARTS * elapsed / total).astype(np.int64))
        begin = stop[used, None]
        edges = begin + (start[used + 1, None] - begin) * np.arange(_PARTS + 1) / _PARTS
        first = np.concatenate([start, edges[:, :-1].ravel()])
        last = np.concatenate([stop, edges[:, 1:].ravel()])
        owner = np.concatenate([power_on, power_on[used].repeat(_PARTS)])
        alike = owner[:, None] == owner
        white, slow, rounding = by_model("gyroscope", first, last, alike)
        # a later power-on has another bias: what its means at rest have in common tells nothing of the first one's
        free = np.square(POWER_ON["gyroscope"] * signals["gyroscope"].nominal_scale)
        slow += (alike & (owner > 0)) * free[:, None, None]
        shift = np.sqrt(rounding)
        # every pose of a recording reads the same rate, and rounds it the same way
        slow[:, :count, :count] += shift[:, :, None] * shift[:, None, :] * alike[:count, :count]
        rows = np.concatenate([at_rest, (padded + _PARTS * used[:, None] + np.arange(_PARTS)).ravel()])
        rates[:, rows[:, None], rows] = slow
        poses = replace(poses, gyroscope_covariance=of_poses(rates))
        turns = replace(turns, noise=white)
    return Observations(poses, turns, observations.gravity, SlowNoise(forces, rates, part_of_turn))


def _temperature(recording: Recording, intervals: FloatArray) -> FloatArray:
    signal = recording.temperature
    if signal is None:
        return np.full(len(intervals), REFERENCE_TEMPERATURE)
    return np.interp(intervals.mean(axis=1), signal.time, signal.values[:, 0])


def _across_gaps(gyroscope: Signal) -> FloatArray:
    """(n,) angle, rad, by which a straight line across the gap before each sample may miss what the unit turned by.

    The trapezoid's error over a gap g is g³/12 of the rate's second derivative, here g²/12 times the change of slope
    from before the gap to after it. Zero where there is no gap.
    """
    interval = np.diff(gyroscope.time)
    error = np.zeros(len(gyroscope))
    gaps = np.flatnonzero(interval > 2.5 / gyroscope.rate)
    gaps = gaps[(gaps >= 3) & (gaps < len(gyroscope) - 5)]
    rate, time = gyroscope.si(), gyroscope.time
    before, after = (
        (rate[last] - rate[last - 3]) / (time[last] - time[last - 3])[:, None] for last in (gaps, gaps + 4)
    )
    error[gaps + 1] = np.square(interval[gaps]) / 12 * lengths_of(after - before)
    return error


def _turns(gyroscope: Signal, intervals: FloatArray, shift: FloatArray) -> list[_Turn]:
    """Samples and their durations between neighbouring poses; empty where a turn is too long or has a gap.

    Every sample holds from half way to its neighbour before to half way to the one after. Across a gap of a few samples
    that leaves out what the rate's curvature adds: where this may be more than a little, the turn is left out, too.
    """
    unsure = _across_gaps(gyroscope)
    durations, period = np.diff(gyroscope.edges), 1 / gyroscope.rate
    turns = []
    between = intervals.ravel()[1:-1].reshape(-1, 2)
    for (start, stop), edges in zip(between, gyroscope.time.searchsorted(between), strict=True):
        used = slice(*edges)
        inside = durations[used]
        # differences of turns that the noise cannot hide
        gapless = len(inside) and inside.max() <= max(5 * period, 0.05) and unsure[used].max() <= _BRIDGED
        whole = gapless and stop - start <= _LONGEST_TURN
        turns.append((gyroscope.values[used] - shift, inside) if whole else _NO_TURN)
    return turns
