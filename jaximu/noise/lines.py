"""Spectral lines followed through time: a hidden Markov model of frequency over windows at rest.

The tapered periodogram of noise is exponential about its spectrum. A line of power ρ times the noise multiplies its
ordinate's mean by 1 + ρ, and so the likelihood of an ordinate x by exp(x ρ/(1 + ρ))/(1 + ρ). Frequency runs on the
circle on which samples cannot tell frequencies apart, zero to the rate, as a random walk about a constant drift. The
forward recursion (L. Rabiner, Proc. IEEE 77, 1989) adds the likelihood ratio up over all courses of frequency, each
with its probability beforehand. Where there is no line this sum has a mean of one, so that it exceeds 1/α with a
probability of at most α (Markov's inequality). The likeliest course is Viterbi's.

A line moves if the sum exceeds, 1/α times, what a constant frequency takes of it (L. Wasserman et al., Universal
inference, PNAS 117, 2020), and by more than a window's main lobe. A course that passes zero or half the rate goes on
beyond it: what is then recorded is its alias.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from jaximu.ground.array_types import BoolArray, FloatArray, IntArray
from jaximu.ground.vectors import dot_rows, root_or_zero
from jaximu.noise.cleaning import FALSE_LINE

_OVER = 2
"""Points of the frequency grid an ordinate: a line between two loses 4 % of its size."""
_LOBE = 2
"""Ordinates from the middle of a line to the first zero of Hann's window."""
_SIDE = 8
"""Ordinates beside a line from which the noise is taken."""
_QUARTILE = 0.25
"""Of the ordinates beside a line, the level that lines among them hardly change."""
_POWERS = np.array([1.0, 4.0, 16.0])
"""Powers of a line over the noise that are tried; a stronger one reaches what a window may count for."""
_MOVES = np.array([(0.0, 0.1), (0.0, 0.5), *((drift / 2, 0.5) for drift in range(1, 9))]).T
"""Drifts (ordinates a window's length) and walks about them (ordinates a root of it) that are tried: a line that drifts
by more than its main lobe within a window is no line there."""
_ENOUGH = np.log(1 / FALSE_LINE)
"""Logarithm of a likelihood ratio that noise exceeds with the probability of a false line."""
_CAP = _ENOUGH / 3
"""Most that a single window may count for, which keeps the mean of the sum at one or below: what shows in a few windows
alone, such as a hand's tremor, is not followed."""
_FEWEST = 8
"""Windows below which no course is followed."""
_LONGEST = 1024
"""Samples of the longest window."""
_OFF = 2.0
"""Ordinates of a rest by which a course may be off, and its drift over the rest."""
_MOST = 30
"""Lines of an axis that are followed."""


@dataclass(frozen=True)
class SpectralLine:
    """A spectral line of one axis that was followed over windows at rest.

    times (k,): middles of the windows, s. frequency (k,): Hz, continued beyond zero and half the rate. visible (k,):
    windows that show it. size: amplitude, unit of the samples. rate: of the samples, Hz. resolution: of a window, Hz.
    evidence: logarithm of the likelihood ratio against noise; steady: the most that a constant frequency takes of it.
    """

    axis: int
    times: FloatArray
    frequency: FloatArray
    visible: BoolArray
    size: float
    rate: float
    resolution: float
    evidence: float
    steady: float

    @property
    def recorded(self) -> FloatArray:
        """The frequency (k,) as samples show it: from zero to half the rate."""
        return abs((self.frequency + self.rate / 2) % self.rate - self.rate / 2)

    @property
    def moves(self) -> bool:
        """Whether its frequency changes, and by more than a window resolves."""
        wide = np.ptp(self.frequency[self.visible]) > _LOBE * self.resolution
        return bool(wide and self.evidence - max(self.steady, 0.0) > _ENOUGH)

    @property
    def returns(self) -> bool:
        """Whether it is recorded in the end where it was at the start, as far as windows resolve."""
        first, last = self.recorded[self.visible][[0, -1]]
        return bool(abs(last - first) < _LOBE * self.resolution)

    @property
    def slow(self) -> bool:
        """Whether it comes so close to zero frequency that a window shows it as drift."""
        return bool(self.folds(0.0).size or self.recorded.min() < _LOBE * self.resolution)

    def folds(self, at: float) -> FloatArray:
        """Return times (c,), s, at which it passes a frequency, of the rate: zero, or a half."""
        turns = self.frequency / self.rate - at
        before, after = turns[:-1], turns[1:]
        crossed = np.floor(before) != np.floor(after)
        level = np.maximum(np.floor(before), np.floor(after))[crossed]
        share = (level - before[crossed]) / (after - before)[crossed]
        return self.times[:-1][crossed] + share * np.diff(self.times)[crossed]


def windows_at_rest(time: FloatArray, rests: FloatArray, rate: float) -> tuple[IntArray, int]:
    """Return first samples (k,) of windows of equal length at rest, and that length: half of a usual rest.

    **Arguments:** `time` (n,): stamps, s; `rests` (r, 2): starts and stops, s; `rate`: Hz. Windows with gaps are left
    out.
    """
    spans = time.searchsorted(rests)
    width = int(min(np.median(np.diff(spans)) // 2, _LONGEST)) if len(spans) else 0
    width -= width % 16  # transforms of round lengths are quick
    if width < 4 * _SIDE:
        return np.zeros(0, np.int64), width
    starts = [
        first + (last - first - count * width) // 2 + width * np.arange(count)
        for (first, last), count in zip(spans, np.diff(spans)[:, 0] // width, strict=True)
    ]
    first = np.concatenate(starts).astype(np.int64)
    return first[abs((time[first + width - 1] - time[first]) * rate - (width - 1)) < 1], width


def follow(parts: FloatArray, times: FloatArray, rate: float) -> list[SpectralLine]:
    """Return the lines that windows at rest show, axis by axis, the surest first.

    **Arguments:** `parts` (k, w, a): samples of k windows in a axes; `times` (k,): their middles, s; `rate`: Hz.
    """
    if len(parts) < _FEWEST:
        return []
    return [line for axis in range(parts.shape[2]) for line in _of_axis(parts[:, :, axis], times, rate, axis)]


def spectra(parts: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return windows (k, w) of an axis without a straight line, by Hann's window; their power (k, f); the noise's."""
    width = parts.shape[1]
    slope = np.linspace(-1.0, 1.0, width)
    level = parts - parts.mean(axis=1, keepdims=True)
    tapered = (level - (level @ slope / (slope @ slope))[:, None] * slope) * np.hanning(width + 1)[:-1]
    power = np.abs(np.fft.rfft(tapered, _OVER * width, axis=1)) ** 2
    return tapered, power, _beside(power)


def _of_axis(parts: FloatArray, times: FloatArray, rate: float, axis: int) -> list[SpectralLine]:
    """Follow one line after the other; what a line covers says nothing of the next."""
    (count, width), lobe = parts.shape, _LOBE * _OVER
    tapered, power, noise = spectra(parts)
    total = np.hanning(width + 1).sum()
    if not (noise[:, lobe:] > 1e-20 * (parts**2).mean()).all():
        return []
    ordinates = power / noise
    points = _OVER * width
    fold = np.minimum(np.arange(points), points - np.arange(points))
    gaps = np.diff(times) * rate / width
    hidden = np.zeros(ordinates.shape, bool)
    hidden[:, :lobe] = hidden[:, -lobe:] = True
    odds = (_POWERS / (1 + _POWERS))[:, None, None] * ordinates - np.log1p(_POWERS)[:, None, None]
    odds = np.minimum(odds, _CAP)
    lines = []
    window = np.arange(count)
    while len(lines) < _MOST:
        odds = np.where(hidden, 0.0, odds)
        evidence = _forward(odds[:, :, fold], gaps)
        if (whole := float(scipy.special.logsumexp(evidence) - np.log(evidence.size))) < _ENOUGH:
            break
        strength, move = np.unravel_index(evidence.argmax(), evidence.shape)
        beyond = np.where(hidden, 0.0, np.maximum(ordinates - _CAP, 0.0))  # of a strong line its middle counts most
        course = _likeliest((odds[strength] + np.log1p(beyond))[:, fold], gaps, *_MOVES[:, move])
        at = fold[course % points]
        visible = odds[strength, window, at] > 0
        frequency = course * rate / points
        steady = np.where(abs(np.arange(odds.shape[2]) - at[:, None]) <= lobe, odds, 0.0).sum(axis=1).max()
        size = _size(tapered / total, frequency, times, rate, noise[window, at] / total**2, visible)
        lines.append(SpectralLine(axis, times, frequency, visible, size, rate, rate / width, whole, float(steady)))
        hidden |= _covered(ordinates, at)
    return sorted(lines, key=lambda line: -line.evidence)


def _beside(power: FloatArray) -> FloatArray:
    """Return the spectrum (k, f) of the noise beside each ordinate, of the side that has more.

    Its shape is that of all windows together, and its level that of each. Low ordinates have no whole side below them:
    there it is what an ordinate is itself in a quarter of the windows, which a line that moves leaves, but no more than
    where the others end and a random walk's rise from there, which is as steep as noise gets.
    """
    lobe, side, factor = _LOBE * _OVER, _SIDE * _OVER, -np.log1p(-_QUARTILE)
    level = np.quantile(power[:, lobe:], _QUARTILE, axis=1, keepdims=True) / factor
    scaled = power / np.maximum(level, 1e-300)

    def usual(span: int) -> FloatArray:
        """The level of so many ordinates from each one on, windows together."""
        spans = np.lib.stride_tricks.sliding_window_view(scaled, span, axis=1).swapaxes(0, 1)
        return np.quantile(spans.reshape(len(spans), -1), _QUARTILE, axis=1) / factor

    beside = usual(side)
    last = power.shape[1]
    index = np.arange(last)
    first = 2 * lobe + side
    below, above = index - lobe - side, np.minimum(index + lobe + 1, last - 1)
    after = np.where(above <= last - side, beside[np.minimum(above, last - side)], 0.0)
    shape = np.maximum(beside[np.maximum(below, 0)], after)
    rise = shape[first] * (first / np.maximum(index[:first], 1)) ** 2
    shape[:first] = np.minimum(rise, usual(2 * _OVER + 1)[np.maximum(index[:first] - _OVER, 0)])
    return level * shape


def _forward(odds: FloatArray, gaps: FloatArray) -> FloatArray:
    """Return log likelihood ratios (s, m) by power and move, summed over all courses; `odds` (s, k, n): logarithms."""
    (strengths, count, points), (drift, walk) = odds.shape, _MOVES[:, :, None]
    wave = 2 * np.pi / points * np.arange(points // 2 + 1)
    belief = np.full((strengths, drift.size, points), 1 / points)
    total = np.zeros((strengths, drift.size))
    for index in range(count):
        if index:
            gap = gaps[index - 1]
            step = np.exp(-0.5 * (wave * _OVER * walk) ** 2 * gap - 1j * wave * _OVER * drift * gap)
            belief = np.maximum(np.fft.irfft(np.fft.rfft(belief) * step, points), 0.0)
        top = odds[:, index].max(axis=1)[:, None]
        belief = belief * np.exp(odds[:, index] - top)[:, None]
        mass = belief.sum(axis=2)
        belief /= mass[:, :, None]
        total += np.log(mass) + top
    return total


def _likeliest(odds: FloatArray, gaps: FloatArray, drift: float, walk: float) -> IntArray:
    """Return the likeliest course (k,) on the grid, not folded, of a drift and a walk; `odds` (k, n): logarithms."""
    points = odds.shape[1]
    score = odds[0]
    steps = []
    for gap, gain in zip(gaps, odds[1:], strict=True):
        shift, spread = _OVER * drift * gap, _OVER * walk * np.sqrt(gap)
        step = round(shift) + np.arange(-int(4 * spread) - 1, int(4 * spread) + 2)
        reached = score[(np.arange(points) - step[:, None]) % points] - 0.5 * ((step - shift) / spread)[:, None] ** 2
        best = reached.argmax(axis=0)
        steps.append(step[best])
        score = gain + reached[best, np.arange(points)]
    course = [int(score.argmax())]
    for step in reversed(steps):
        course.append(course[-1] - int(step[course[-1] % points]))
    course = np.array(course[::-1])
    course -= points * int(np.floor(np.median(course) / points + 0.5))
    return course if np.median(course) >= 0 else -course


def _covered(ordinates: FloatArray, at: NDArray[np.intp]) -> BoolArray:
    """Return the ordinates (k, f) that a line reaches: its main lobe, and as far as their median is no noise's.

    Of noise half of the windows exceed a value with the tail of a binomial law; other lines cross in fewer.
    """
    (count, last), ends = ordinates.shape, []
    half = (count + 1) // 2
    for sign in (-1, 1):
        end = _LOBE * _OVER
        while end < last:
            near = ordinates[np.arange(count), (at + sign * (end + 1)).clip(0, last - 1)]
            if scipy.special.betainc(half, count - half + 1, np.exp(-np.sort(near)[-half])) > FALSE_LINE:
                break
            end += 1
        ends.append(end)
    offset = np.arange(last) - at[:, None]
    return (offset >= -ends[0]) & (offset <= ends[1])


def _size(
    tapered: FloatArray,
    frequency: FloatArray,
    times: FloatArray,
    rate: float,
    noise: FloatArray,
    visible: BoolArray,
) -> float:
    """Return the amplitude of a line, its drift within the windows (k, w) undone, and noise taken off its power."""
    time = (np.arange(tapered.shape[1]) - (tapered.shape[1] - 1) / 2) / rate
    phase = 2 * np.pi * (frequency[:, None] * time + np.gradient(frequency, times)[:, None] * time**2 / 2)
    return float(2 * root_or_zero((abs(dot_rows(tapered, np.exp(-1j * phase))) ** 2 - noise)[visible].mean()))


def swing(values: FloatArray, time: FloatArray, line: SpectralLine) -> tuple[float, float]:
    """Return what a line adds to the mean of samples at rest (n,), and the variance beyond that of their noise.

    Its size is known beforehand, its phase is not, and its frequency to what a window resolves: the posterior mean over
    a grid of frequency and drift, of a sinusoid beside a free mean in white noise.
    """
    centred = time - time.mean()
    length = len(time) * (time[1] - time[0])
    drift, middle = np.polyfit(centred, np.interp(time, line.times, line.frequency), 1)
    hidden = _LOBE * line.resolution
    half_range = _OFF / length
    if abs(middle - line.rate * np.round(middle / line.rate)) < hidden:
        half_range = max(half_range, hidden)
    offsets, bends = np.meshgrid(
        np.arange(-half_range, half_range, 1 / (8 * length)), np.linspace(-_OFF, _OFF, 2 * _LOBE * 4 + 1) / length**2
    )
    turns = (middle + offsets.ravel()[:, None]) * centred + (drift + bends.ravel()[:, None]) * centred**2 / 2
    rows = np.stack([np.ones_like(turns), np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)], axis=1)
    level = values.mean()
    noise = float((np.diff(values) ** 2).mean() / 2)
    covariance = np.linalg.inv(rows @ rows.mT / noise + np.diag([0.0, 2.0, 2.0]) / line.size**2)
    score = rows @ (values - level) / noise
    estimate = np.einsum("gij,gj->gi", covariance, score)
    weight = np.einsum("gi,gi->g", estimate, score) / 2 + np.linalg.slogdet(covariance)[1] / 2
    weight = np.exp(weight - scipy.special.logsumexp(weight))
    shift = float(weight @ estimate[:, 0])
    spread = weight @ (covariance[:, 0, 0] + (estimate[:, 0] - shift) ** 2)
    return -shift, max(float(spread) - noise / len(values), 0.0)
