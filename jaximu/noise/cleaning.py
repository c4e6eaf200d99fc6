"""What is no noise of a sensor at rest: outliers, gaps, steps of its level and periodic lines, found and taken out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
import scipy

from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.ground.distributions import normal_isf, robust_sigma
from jaximu.recordings.recording import runs_of

BRIDGED = 5
"""Samples missing in a row that are filled in: a few in a thousand change no term, but would break long averages."""
_BESIDE = 256
"""Samples on either side of a gap, at the least, whose level it is filled about: what scatters there is no level."""
_SPIKE = 7.0
"""Standard deviations off its neighbours from which a sample is an outlier: Gaussian noise has none in 10¹¹."""
_MOST_SPIKES = 0.01
"""Share of the samples up to which outliers are errors; more of them are a property of the noise."""
FALSE_LINE = 1e-6
"""Probability that noise alone shows a line somewhere on an axis."""
_MOST_LINES = 20
_MEANS = 200
"""Means over a recording between which a step of the level shows."""
_NEAR = 6
"""Means to each side among which a step stands out alone: a warm-up's changes are alike there."""
_MOST_STEPS = 5
"""Steps that are single events; more of them are the noise of the sensor."""


@dataclass(frozen=True)
class PeriodicLine:
    """A periodic part of the signal that was taken out: frequency (Hz, after aliasing) and amplitude (signal unit)."""

    frequency: float
    amplitude: float


def without_outliers(values: FloatArray) -> tuple[FloatArray, int]:
    """Return the samples with outliers as NaN, and how many there were.

    A sample is suspected where it is far off the mean of its two neighbours by the scale of most such differences
    (1.4826 times the median of their sizes, D. Hoaglin et al., Understanding Robust and Exploratory Data Analysis,
    1983), and is one if it and not its neighbour is far off the median of those around. Where they are more than one in
    a hundred, they stay.
    """
    middle = values[1:-1] - (values[:-2] + values[2:]) / 2
    sizes = abs(middle[~np.isnan(middle)])
    if not len(sizes):
        return values, 0
    scale = robust_sigma(sizes)
    steps = sizes[sizes > 1e-12 * sizes.max()]
    if not len(steps):
        return values, 0
    if scale < 1e-12 * sizes.max() or len(steps) < 0.9 * len(sizes):
        # quantised: most differences are equal or none, and their median is a matter of a step
        scale = max(scale, float(np.quantile(sizes, 0.99)) / 2.576, float(steps.min()))
    suspected = 1 + np.flatnonzero(abs(middle) > _SPIKE / 2 * scale)  # of two spikes in a row each shows half
    if not len(suspected) or len(suspected) > 5 * _MOST_SPIKES * len(values):
        return values, 0
    near = np.unique((suspected[:, None] + np.arange(-2, 3)).clip(0, len(values) - 1))
    around = (near[:, None] + np.arange(-8, 9)).clip(0, len(values) - 1)
    level = np.nanmedian(values[around], axis=1)
    usual = 1.4826 * np.nanmedian(abs(values[around] - level[:, None]), axis=1)
    # where the signal itself wanders, as a walk does, the scatter around says how far a sample may be
    far = near[abs(values[near] - level) > _SPIKE * np.maximum(scale / np.sqrt(1.5), usual)]
    if len(far) > _MOST_SPIKES * len(values):
        return values, 0
    if len(far):
        values = values.copy()
        values[far] = np.nan
    return values, len(far)


@dataclass(frozen=True)
class LevelStep:
    """A step of the level that was taken out: seconds after the first sample, and size (signal unit)."""

    time: float
    size: float


def without_steps(values: FloatArray, rate: float) -> tuple[FloatArray, tuple[LevelStep, ...]]:
    """Return the samples (n,) less the steps of their level, in the order of time.

    Where a step is, means over a two-hundredth of the recording on both sides of one such part differ by more than any
    two others do by chance, drift and walk included, and by more than those nearby, most of it at once.
    """
    size = len(values) // _MEANS
    level, steps = values, list[LevelStep]()
    limit = float(normal_isf(FALSE_LINE / (2 * _MEANS)))
    while size >= 10:
        means = _block_means(level, size)
        change = _changes(means, 1)
        at = int(abs(change).argmax())  # the mean before the one in which it steps
        near = np.concatenate([change[max(0, at - _NEAR) : max(0, at - 1)], change[at + 2 : at + _NEAR + 1]])
        usual = robust_sigma(change)
        if not abs(change[at]) > limit * max(usual, np.sqrt(np.mean(near**2))) or not 2 < at < _MEANS - _NEAR:
            break
        if usual == 0 or len(steps) == _MOST_STEPS:
            return values, ()
        off = (level[at * size : (at + 3) * size] - (means[at] + means[at + 2]) / 2) * np.sign(change[at])
        first = at * size + int(np.nancumsum(off).argmin()) + 1
        spans = {
            span: _changes(means, span) for span in (2 ** np.arange(7)).tolist() if span - 1 <= at < _MEANS - span - 1
        }
        span = min(spans, key=lambda span: robust_sigma(spans[span]))  # white noise wants long means, a walk short ones
        step = float(spans[span][at - span + 1])
        sides = level[first - size // 4 : first], level[first : first + size // 4]
        if (np.nanmean(sides[1]) - np.nanmean(sides[0])) / step < 2 / 3:
            break  # it takes its time
        level = level - step * (np.arange(len(level)) >= first)
        steps.append(LevelStep(first / rate, step))
    return level, tuple(sorted(steps, key=lambda step: step.time))


def _block_means(values: FloatArray, size: int) -> FloatArray:
    """Return means (`_MEANS`,) of so many samples; a straight line over those that are missing altogether."""
    blocks = values[: size * _MEANS].reshape(_MEANS, size)
    there = np.isfinite(blocks)
    count = there.sum(axis=1)
    means = np.where(there, blocks, 0.0).sum(axis=1) / np.maximum(1, count)
    index = np.arange(_MEANS)
    return np.interp(index, index[count > 0], means[count > 0])


def _changes(means: FloatArray, span: int) -> FloatArray:
    """Return by how much the mean of `span` means is above that of as many before, one between them left out."""
    total = np.cumulative_sum(means, include_initial=True)
    sums = total[span:] - total[:-span]
    return (sums[span + 1 :] - sums[: -span - 1]) / span


def fillable(index: IntArray) -> slice:
    """Return the longest part of samples at places (n,) of an even grid that has no gap longer than what lies before it
    in the part.
    """
    parts, first = [], 0
    for last in np.flatnonzero(np.diff(index) > 1):
        if index[last + 1] - index[last] > index[last] - index[first] + 2:
            parts.append(slice(first, last + 1))
            first = last + 1
    return max((*parts, slice(first, len(index))), key=lambda part: index[part][-1] - index[part][0])


def filled(values: FloatArray, longest: int | None = None) -> FloatArray:
    """Return the samples with gaps of up to `longest` filled by the samples before them, mirrored about a straight
    line between the levels on both sides, every other time with the sign turned round: their spectrum is that of the
    noise, as a straight line's is not, and nothing is counted twice.
    """
    lost = np.isnan(values)
    if not lost.any():
        return values
    values = values.copy()
    for number, (first, last) in enumerate(runs_of(lost)):
        size = last - first
        if (longest is not None and size > longest) or first == 0 or last == len(values):
            continue
        before = values[max(0, first - max(size, _BESIDE)) : first]  # filled already
        after = values[last : last + max(size, _BESIDE)]
        before, after = before[~np.isnan(before)], after[~np.isnan(after)]
        if not len(before) or not len(after):
            continue
        level = before.mean()
        level_after = after.mean()
        scatter = (-1) ** number * np.resize(before[::-1] - level, size)
        values[first:last] = level + (level_after - level) * np.arange(1, size + 1) / (size + 1) + scatter
    return values


def periodic_lines(
    values: FloatArray, rate: float, highest: float | None = None
) -> tuple[tuple[PeriodicLine, ...], list[tuple[float, float]], FloatArray | None]:
    """Return the periodic lines up to a frequency, the bands (Hz) around them, and their sum over time (n,).

    Ordinates of the Hann-tapered periodogram of noise are exponential about its spectrum, and the median of those
    around is ln 2 of that. A line stands above what the largest of all reaches by chance. Each is subtracted at the
    frequency where its tapered amplitude is largest (the estimate of least variance: D. Rife and R. Boorstyn, IEEE
    Trans. Inf. Theory 20, 1974), and what remains is searched again.
    """
    samples = len(values)
    lines = []
    spans = []
    periodic = None
    rest, _ = without_line(values)
    for _ in range(4):
        peaks = _peaks(rest, None if highest is None else round(highest / rate * samples))
        news = False
        for low, peak, high in peaks:
            touching = [i for i, (a, b) in enumerate(spans) if low <= b + 6 and high >= a - 6]
            if touching:  # what subtraction left of a line that is not quite steady
                a, b = spans[touching[0]]
                spans[touching[0]] = (min(a, low), max(b, high))
                continue
            if len(lines) == _MOST_LINES:
                break
            line, wave = _wave(rest, peak, rate)
            lines.append(line)
            spans.append((low, high))
            rest -= wave
            periodic = wave if periodic is None else periodic + wave
            news = True
        if not news:
            break
    order = np.argsort([line.frequency for line in lines])
    bands = [((a - 3) * rate / samples, (b + 3) * rate / samples) for a, b in spans]
    return tuple(lines[i] for i in order), bands, periodic


def without_line(values: FloatArray) -> tuple[FloatArray, float]:
    """Return samples (n,) less the straight line through them, and its slope a sample."""
    samples = len(values)
    index = np.arange(samples) - (samples - 1) / 2
    centred = values - values.mean()
    slope = 12 * np.dot(index, centred) / (samples * (samples**2 - 1.0))
    return centred - slope * index, float(slope)


def _peaks(values: FloatArray, last: int | None) -> list[tuple[int, int, int]]:
    """Return first, highest and last of the ordinates of every peak of the tapered periodogram, the highest peak first.

    The ordinate `last` is the highest that is looked at.
    """
    raw = np.asarray(scipy.fft.rfft(values))[: None if last is None else last + 2]
    tapered = raw[1:-1] / 2 - (raw[:-2] + raw[2:]) / 4  # Hann's taper; ordinates 1 …
    power = tapered.real**2 + tapered.imag**2
    edges = _median_edges(len(power))
    if len(edges) < 3:
        return []
    median = np.array([np.median(power[a:b]) for a, b in pairwise(edges)])
    if not (median > 0).all():
        return []
    factor = np.log(len(power) / FALSE_LINE) / np.log(2)
    first = int(np.sqrt((edges[0] + 1.0) * (edges[1] + 1.0)))
    crude = median.repeat(np.diff(edges)) * (0.4 * factor)
    high = edges[0] + np.flatnonzero(power[edges[0] : edges[-1]] > crude)
    high = high[high >= first]
    if not len(high):
        return []
    middle = np.log(np.sqrt((edges[:-1] + 1.0) * edges[1:]))
    high = high[power[high] > factor * np.exp(np.interp(np.log(high + 1.0), middle, np.log(median)))]
    peaks = []
    for group in np.split(high, 1 + np.flatnonzero(np.diff(high) > 6)):
        if len(group):
            low, last = _skirts(power, int(group[0]), int(group[-1]))
            peaks.append((low + 1, int(group[power[group].argmax()]) + 1, last + 1))
    return sorted(peaks, key=lambda peak: -power[peak[1] - 1])


def _skirts(power: FloatArray, low: int, high: int) -> tuple[int, int]:
    """Widen a peak to where its power falls to twice that around: a line whose frequency wanders has skirts."""
    sides = [power[int(0.7 * low) : int(0.85 * low)], power[int(1.18 * high) : int(1.4 * high)]]
    if not (levels := [np.median(side) / np.log(2) for side in sides if len(side) >= 16]):
        return low, high
    limit = 2 * np.exp(np.log(levels).mean())
    first, last = low, high
    while low > 0.85 * first and low > 8 and power[low - 8 : low].mean() > limit:
        low -= 4
    while high < 1.18 * last and high + 9 < len(power) and power[high + 1 : high + 9].mean() > limit:
        high += 4
    return low, high


@lru_cache(maxsize=8)
def _median_edges(count: int) -> IntArray:
    """Edges of blocks over which the median is taken: an eighth of an octave, sixty-four ordinates at least."""
    edges = [4]
    while edges[-1] < count:
        edges.append(max(edges[-1] + 64, int(edges[-1] * 1.09)))
    if count - edges[-2] < 64 and len(edges) > 2:
        edges.pop()
    edges[-1] = count
    return np.array(edges)


def lowest(function: Callable[[float], float], bounds: tuple[float, float], tolerance: float) -> float:
    """Return where a function is least between bounds."""
    return float(scipy.optimize.fminbound(function, *bounds, xtol=tolerance))


def _wave(values: FloatArray, peak: int, rate: float) -> tuple[PeriodicLine, FloatArray]:
    samples = len(values)
    index = np.arange(samples)
    circle = -2j * np.pi
    turn = np.exp(circle * peak / samples * index)
    taper = 0.5 - 0.5 * np.cos(2 * np.pi * (index + 0.5) / samples)
    size = max(1, samples // 4096)
    blocks = samples // size
    coarse = (values * turn * taper)[: blocks * size].reshape(blocks, size).sum(axis=1)
    middle = (np.arange(blocks) * size + (size - 1) / 2) / samples

    # where the line is highest
    shift = lowest(lambda at: -abs((coarse * np.exp(circle * at * middle)).sum()), (-1.0, 1.0), 1e-7)
    turn *= np.exp(circle * shift / samples * index)
    phasor = 2 * (values * turn * taper).sum() / taper.sum()
    return PeriodicLine((peak + shift) * rate / samples, float(abs(phasor))), np.asarray((phasor * turn.conj()).real)
