"""The terms of the noise of a sensor at rest identified together from its spectrum, with intervals.

The samples are turned into cosine coefficients (DCT-II). White noise and a random walk become independent ones there,
exactly: the first differences of samples y are sine coefficients −2 sin(πj/2n) c_j of them, and the sine basis
diagonalises both the covariance of a walk's steps (unit) and that of differenced white noise (the second difference
matrix). So no end of the recording leaks into low frequencies, which decide about K, as it does in a periodogram.
Coefficients c_j, at f_j = j/2T, are then Gaussian with the sum of the terms' spectra as variance and the ramp as mean,
and their likelihood is maximised (P. Whittle, J. R. Stat. Soc. B 15, 1953; here exact for N, K and R, and with the
exact variance of each coefficient for Q, B and Gauss–Markov processes, whose coefficients are not quite independent).
Intervals are those of the profile likelihood. The eigenvectors: G. Strang, The discrete cosine transform, SIAM Review
41 (1999); the terms: IEEE Std 952-2020, annex C.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import combinations

import numpy as np
import scipy
from numpy.typing import ArrayLike

from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.ground.distributions import chi2_isf
from jaximu.ground.document import Json
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.vectors import sigmas_of, submatrix
from jaximu.model.processes import MEMBER_VARIANCE, TERM_PROCESSES, BiasInstability, FirstOrderGaussMarkov
from jaximu.noise.cleaning import (
    BRIDGED,
    LevelStep,
    PeriodicLine,
    fillable,
    filled,
    lowest,
    periodic_lines,
    without_line,
    without_outliers,
    without_steps,
)
from jaximu.noise.deviations import Deviation, averaging_factors, deviation, require_samples

TERMS = "QNBKR"
_SHORTEST = 256
"""Samples below which there are too few averaging times to tell terms apart."""
_SINGLE = 192
"""Coefficients at the low end that are taken one by one; above, they are averaged over thirty-seconds of an octave."""
_RAMPED = 8192
"""Coefficients at the low end in which a ramp or a warm-up is sought: they fall as 1/j² and have vanished beyond."""
_PENALTY = {"N": 4.0, "K": 4.0, "Q": 6.0, "R": 9.0, "B": 9.0}
"""What −2 log L must fall by for a term to be taken. The Bayesian criterion's log of the number of octaves is 3; these
are chosen by simulation (benchmarks/noise_terms.py). B and R pay more: over the ten or so coefficients that hold a walk
it may look like either, −2 log L then scatters more than χ² does, and a walk is the simpler process.
"""
_TIE = 6.0
"""What the criterion must be worse by for a combination to be ruled out: it is then twenty times less likely."""
_UNLIKELY = 1e-3
"""Probability of a misfit below which the terms do not describe the noise."""
_OVERWHELMING = 40.0
"""Twice the gain in log likelihood from which a drift is a warm-up and no walk."""
_NO_STRETCH = "gaps leave no stretch whole that is long enough to identify noise."
_CONSTANT = "the signal is constant, or quantised to whole steps: there is no noise to identify."


@dataclass(frozen=True)
class Term:
    """One term of the noise: value and interval, continuous, SI, two-sided (see `jaximu.model.data_sheet.SI_UNITS`)."""

    value: float
    low: float
    high: float

    def document(self, unit: str) -> Json:
        """Return the term as JSON has it."""
        return vars(self) | {"unit": unit}


@dataclass(frozen=True)
class WarmUp:
    """A drift amplitude · exp(−t/time_constant) from the first sample on that was taken out (signal unit, s)."""

    amplitude: float
    time_constant: float


@dataclass(frozen=True)
class GaussMarkov:
    """A first-order Gauss–Markov process: standard deviation (signal unit) and correlation time (s)."""

    sigma: Term
    correlation_time: Term


@dataclass(frozen=True)
class Identified:
    """The terms that one axis's data supports (None: not supported), and the deviation of what they describe.

    The interval of a term begins at zero where others than it describe the data about as well.

    misfit: χ² of the fit, octave by octave of frequency, and its degrees of freedom. excess: where χ² is far too large,
    the share by which the spectrum of each octave is let differ from the terms (a correlated process, a filter, a drift
    beside them), which widens intervals. lines, warm_up, steps and outliers (a number of samples) were found first and
    taken out of the samples, of the deviation too. high_pass: time constant (s) of what took out what is slow before it
    was logged; the terms are those before it. gauss_markov: those asked for. limits: how large the terms that are not
    supported could be beside those that are (SI, the upper end of a two-sided interval).
    """

    terms: dict[str, Term | None]
    deviation: Deviation
    misfit: tuple[float, int]
    limits: dict[str, float]
    excess: float = 0.0
    lines: tuple[PeriodicLine, ...] = ()
    warm_up: WarmUp | None = None
    outliers: int = 0
    steps: tuple[LevelStep, ...] = ()
    high_pass: Term | None = None
    gauss_markov: tuple[GaussMarkov, ...] = ()

    def allan_deviation(self, tau: ArrayLike) -> FloatArray:
        """Return the fitted Allan deviation at averaging times (n,), s."""
        tau = np.asarray(tau, float)
        rate = self.deviation.factor[0] / self.deviation.tau[0]
        theta = np.array([0.0 if term is None else term.value**2 for term in self.terms.values()])
        variance = _basis(tau * rate, rate, "".join(self.terms)) @ theta
        if self.high_pass is not None:
            variance -= _held_back(tau, rate, dict(zip(self.terms, theta, strict=True)), self.high_pass.value)
        for markov in self.gauss_markov:
            process = FirstOrderGaussMarkov.of(markov.sigma.value, markov.correlation_time.value)
            variance += process.allan_variance(tau)
        return np.sqrt(variance)


def identify(
    values: ArrayLike,
    rate: float,
    terms: str = TERMS,
    confidence: float = 0.95,
    gauss_markov: int = 0,
    highest: float | None = None,
) -> Identified | list[Identified]:
    """Identify the noise of samples at rest: one `Identified` for (n,), a list of them for (axes, n).

    **Arguments:**

    - `values`: equally spaced samples along the last axis, NaN where one is missing. `rate`: Hz.
    - `terms`: those to look for, of Q (quantisation), N (white), B (bias instability), K (rate random walk), R (ramp).
    - `confidence`: of the intervals.
    - `gauss_markov`: number of first-order Gauss–Markov processes to fit beside the terms.
    - `highest`: frequency (Hz) above which the spectrum is not used, where a filter acted on it.

    Outliers, periodic lines and an exponential warm-up are found first, taken out and reported; the last only where the
    likelihood says overwhelmingly that it is not a random walk. Which terms the data supports is decided by an
    information criterion over all their combinations. Where no combination describes the spectrum, χ² far above its
    degrees of freedom, the intervals are widened by what the octaves differ by, and mean the size that a term would
    need, not that it is there. Raises `NotPossibleError` for a recording that is too short or has no noise,
    `InputError` for unknown terms.
    """
    if not terms or set(terms) - set(TERMS) or len(set(terms)) < len(terms):
        raise InputError(f"terms must be some of {', '.join(TERMS)}, found {terms!r}.")
    if not 0 <= gauss_markov <= 3:
        raise InputError(f"gauss_markov must be 0 to 3 processes, found {gauss_markov}.")
    data = np.asarray(values, float)
    require_samples(data, rate, confidence)
    if data.ndim not in (1, 2):
        raise InputError(f"values must be (n,) or (axes, n), found shape {data.shape}.")
    axes = [_identify(axis, rate, terms, confidence, gauss_markov, highest) for axis in np.atleast_2d(data)]
    return axes if data.ndim == 2 else axes[0]


def _identify(
    values: FloatArray, rate: float, terms: str, confidence: float, markov: int, highest: float | None
) -> Identified:
    if (samples := len(values)) < _SHORTEST:
        raise NotPossibleError(f"{samples} samples are too few to identify noise; record at least {_SHORTEST}.")
    there = np.flatnonzero(~np.isnan(values))
    if len(there) < _SHORTEST:
        raise NotPossibleError(_NO_STRETCH)
    there = there[fillable(there)]
    if np.ptp(values[there]) == 0:
        raise NotPossibleError(_CONSTANT)
    values = values[there[0] : there[-1] + 1]
    values, outliers = without_outliers(values)
    values, steps = without_steps(values, rate)
    whole = filled(values)  # for the spectrum; the deviation leaves long gaps out
    lines, bands, periodic = periodic_lines(whole, rate, highest)
    if highest is not None:
        bands = [*bands, (highest, rate / 2)]
    if periodic is not None:
        whole, values = whole - periodic, values - periodic
    spectrum = _spectrum(whole, rate, bands)
    if (warm_up := _warm_up(spectrum, terms)) is not None:
        drift = warm_up.amplitude * np.exp(-np.arange(len(whole)) / (rate * warm_up.time_constant))
        values = values - drift
        spectrum = _spectrum(whole - drift, rate, bands)
    measured = _deviation(filled(values, BRIDGED), rate, confidence)
    if not (measured.value > 0).all():
        raise NotPossibleError(_CONSTANT)
    threshold = float(chi2_isf(1 - confidence, 1)) / 2
    # How far the most general model is off, octave by octave, then which of its terms are needed
    general = _Model(spectrum, terms, _times(spectrum, terms, markov)).fit()
    excess, high_pass, offered = 0.0, None, terms
    if general.unlike(1 - confidence) and not markov:
        high_pass = _high_pass(general, threshold)
    if high_pass is not None:
        offered = terms.replace("R", "")
        general = replace(general.model, spectrum=replace(spectrum, high_pass=high_pass.value), terms=offered).fit()
    elif general.unlike(_UNLIKELY):
        # The terms do not describe this noise, and the high frequencies, known best, would dictate all others. Every
        # octave may then differ from the terms by a share that makes the misfit what it should be.
        excess = _excess(general)
    best, doubtful = _select(replace(general.model, excess=excess), offered)
    result = dict.fromkeys(terms) | {
        term: _term(best, index, threshold, open_end=term in doubtful) for index, term in enumerate(best.model.letters)
    }
    if best.model.ramp:
        low, high = _ramp_bounds(best, threshold)
        ends = sorted((abs(low), abs(high)))
        sure = low * high > 0 and "R" not in doubtful
        result["R"] = Term(abs(best.ramp), ends[0] if sure else 0.0, ends[1])
    first = len(best.model.letters)
    processes = tuple(
        GaussMarkov(_term(best, first + 2 * i, threshold), _term(best, first + 2 * i + 1, threshold, power=1.0))
        for i in range(markov)
    )
    limits = {term: _limit(best, term, threshold) for term in offered if result[term] is None}
    quality = replace(best, model=replace(best.model, excess=0.0)).misfit()
    return Identified(result, measured, quality, limits, excess, lines, warm_up, outliers, steps, high_pass, processes)


def _deviation(values: FloatArray, rate: float, confidence: float) -> Deviation:
    """Return the overlapping Allan deviation over as long averages as gaps leave whole."""
    factors = averaging_factors(len(values) // 4, "overlapping")
    for last in range(len(factors), 4, -1):
        try:
            return deviation(values, rate, "overlapping", factors[:last], confidence=confidence)
        except NotPossibleError:
            if not np.isnan(values).any():
                raise
    raise NotPossibleError(_NO_STRETCH)


def _basis(factors: FloatArray, rate: float, terms: Sequence[str]) -> FloatArray:
    """Allan variance (T, terms) of each term of size one, exact for samples: see `jaximu.model.processes`."""
    tau = factors / rate
    sampled = {"K": 1 / (6 * tau * rate**2)}  # of a walk, which its samples follow by steps
    columns = [TERM_PROCESSES[term](1.0).allan_variance(tau) + sampled.get(term, 0.0) for term in terms]
    return np.stack(columns, axis=-1)


def _held_back(tau: FloatArray, rate: float, theta: dict[str, float], time_constant: float) -> FloatArray:
    """Allan variance (T,) of what a high pass takes out of terms whose squares are `theta`.

    4 ∫ S(f) (1 − |H|²) sin⁴(πfτ) / (m sin(πf/rate))² df over m samples, S two-sided.
    """
    frequency = np.geomspace(1e-6 / tau.max(), rate / 2, 1000)
    half = np.pi * frequency / rate
    density = (
        theta.get("N", 0.0)
        + theta.get("B", 0.0) / (2 * np.pi * frequency)
        + theta.get("K", 0.0) / (4 * np.sin(half) ** 2 * rate**2)
        + theta.get("Q", 0.0) * rate * 4 * np.sin(half) ** 2
    )
    density *= 1 - _passed(2 * half * rate, time_constant)
    kernel = np.sin(np.pi * frequency * tau[:, None]) ** 4 / (tau[:, None] * rate * np.sin(half)) ** 2
    return np.asarray(4 * np.trapezoid(density * kernel, frequency))


# Cosine coefficients and the terms' shares in their variance


@dataclass(frozen=True)
class _Spectrum:
    """Squares of cosine coefficients, averaged over bins (B,), as two-sided densities; a bin's nodes (B, 3) stand for
    its frequencies (places j, Gauss–Legendre). cross, gram: means of the coefficients times those of a ramp of slope
    one (B,), and of its squares; what remains after subtraction of `slope` is a coefficient times the ramp.
    """

    samples: int
    rate: float
    count: FloatArray
    power: FloatArray
    node: FloatArray
    octave: IntArray
    coefficient: FloatArray  # (J,) lowest coefficients, by place from 1
    inside: IntArray  # (J,) bin of each, −1 if left out
    slope: float
    high_pass: float | None = None  # time constant (s) of what took out what is slow

    @property
    def angle(self) -> FloatArray:
        """Frequencies of the nodes, rad per sample."""
        return np.pi * self.node / self.samples

    @cached_property
    def columns(self) -> dict[str, FloatArray]:
        """Mean density (B,) of the coefficients of each term of size one."""
        return {term: _column(self, term) for term in "QNBK"}

    def products(self, left: FloatArray, right: FloatArray) -> FloatArray:
        """Means over bins (B,) of products of coefficients given at the lowest places (J,)."""
        kept = self.inside >= 0
        return np.bincount(self.inside[kept], (left * right)[kept], minlength=len(self.count)) / self.count

    def ramp(self) -> FloatArray:
        """Coefficients (J,) of a ramp of slope one per second, √density."""
        # d/dω of Σ sin ω(k + ½) = sin²(ωn/2)/sin(ω/2), at ω = πj/n
        j = np.arange(1, len(self.coefficient) + 1)
        half = np.pi * j / (2 * self.samples)
        sums = np.where(j % 2 == 1, -np.cos(half) / (2 * np.sin(half) ** 2), 0.0)
        return np.sqrt(2 / self.samples) * sums / self.rate**1.5

    def decay(self, time_constant: float) -> FloatArray:
        """Coefficients (J,) of exp(−t/time_constant), √density."""
        # the real part of Σ a^k e^{iω(k + ½)}, a geometric series
        j = np.arange(1, len(self.coefficient) + 1)
        p = 1 / (self.rate * time_constant)
        half = np.pi * j / (2 * self.samples)
        ends = 1 - (-1.0) ** j * np.exp(-p * self.samples)
        sums = -np.expm1(-p) * np.cos(half) * ends / (np.expm1(-p) ** 2 + 4 * np.exp(-p) * np.sin(half) ** 2)
        return np.sqrt(2 / self.samples) * sums / np.sqrt(self.rate)


@lru_cache(maxsize=8)
def _bins(samples: int) -> tuple[IntArray, FloatArray, IntArray]:
    """Edges (B + 1,) of the bins in places j, their nodes (B, 3), and the octave (B,) each belongs to."""
    edges = [*range(1, min(_SINGLE, samples))]
    while edges[-1] < samples:
        edges.append(max(edges[-1] + 1, int(edges[-1] * 2 ** (1 / 32))))
    edges[-1] = samples
    first, last = np.array(edges[:-1]), np.array(edges[1:])
    # Gauss–Legendre, narrowed to have the variance of the whole places in a bin
    root = np.sqrt(3 / 5) * np.array([-1, 0, 1])
    node = (first + last - 1)[:, None] / 2 + np.sqrt((last - first)[:, None] ** 2 - 1.0) / 2 * root
    octave = np.maximum(np.floor(np.log2(first + 0.5)), 2).astype(np.int64) - 2  # places 1 to 7 are one
    return np.array(edges), node, octave


def _spectrum(values: FloatArray, rate: float, bands: Sequence[tuple[float, float]]) -> _Spectrum:
    rest, slope = without_line(values)
    coefficient = np.asarray(scipy.fft.dct(rest, norm="ortho"), np.float64) / np.sqrt(rate)
    return _binned(coefficient, rate, slope * rate, bands)


def _binned(coefficient: FloatArray, rate: float, slope: float, bands: Sequence[tuple[float, float]] = ()) -> _Spectrum:
    """Average the squares of cosine coefficients (n,), √density, of samples less a straight line of `slope` (1/s)."""
    samples = len(coefficient)
    edges, node, octave = _bins(samples)
    keep = np.ones(samples)
    for low, high in bands:
        first, last = (round(2 * samples * f / rate) for f in (low, high))
        keep[max(first, 1) : max(last, 0) + 1] = 0.0
    count = np.add.reduceat(keep, edges[:-1])
    sums = np.add.reduceat(coefficient**2 * keep, edges[:-1])
    used = count > 0
    number = np.where(used, used.cumsum() - 1, -1)
    low = min(samples - 1, _RAMPED)
    inside = number[edges.searchsorted(np.arange(1, low + 1), side="right") - 1]
    inside = np.where(keep[1 : low + 1] > 0, inside, -1)
    return _Spectrum(
        samples,
        rate,
        count[used],
        sums[used] / count[used],
        node[used],
        octave[used],
        coefficient[1 : low + 1],
        inside,
        float(slope),
    )


def _column(spectrum: _Spectrum, term: str) -> FloatArray:
    """Mean density (B,) of the coefficients of a term of size one."""
    rate = spectrum.rate
    half = spectrum.angle / 2
    if term == "Q":  # a second difference matrix but for its corners, which add the two ends
        density = rate * (4 * np.sin(half) ** 2 + 4 / spectrum.samples * np.cos(half) ** 2)
    elif term == "N":
        density = np.ones_like(half)
    elif term == "K":
        density = 1 / (4 * np.sin(half) ** 2 * rate**2)
    else:  # the flicker noise of `jaximu.model.processes`: a bank of Gauss–Markov processes
        bank = BiasInstability(1.0, longest=max(1e5, 100 * spectrum.samples / rate)).bank(1 / rate)
        density = sum((_markov(spectrum, time) for time in bank), start=np.zeros_like(half)) * MEMBER_VARIANCE
    return (density * _passed(spectrum.angle * rate, spectrum.high_pass)) @ _WEIGHT


def _passed(circular: FloatArray, time_constant: float | None) -> FloatArray | float:
    """Share of the power that a first-order high pass leaves at circular frequencies, rad/s; all of it without one."""
    return 1.0 if time_constant is None else 1 / (1 + (circular * time_constant) ** -2)


_WEIGHT = np.array([5, 8, 5]) / 18


def _markov(spectrum: _Spectrum, correlation_time: float) -> FloatArray:
    """Density (B, 3) of the coefficients of a first-order Gauss–Markov process of unit variance.

    Its covariance a^|k−l| applied to cos ω(k + ½) gives the spectrum sinh p/(cosh p − cos ω), p = −ln a, times that,
    less what the sums to infinity on both sides would hold, geometric series both.
    """
    p = min(1 / (spectrum.rate * correlation_time), 50.0)
    half = spectrum.angle / 2
    gap = 2 * np.sinh(p / 2) ** 2 + 2 * np.sin(half) ** 2
    # single places are even or odd; among many the signs cancel
    sign = np.where(spectrum.node == spectrum.node.round(), np.where(spectrum.node % 2 == 0, 1.0, -1.0), 0.0)
    ends = 1 - sign * np.exp(-p * spectrum.samples)
    edge = 4 / spectrum.samples * np.sinh(p / 2) ** 2 * np.cos(half) ** 2 * ends / gap**2
    return (np.sinh(p) / gap - edge) / spectrum.rate


# Likelihood


@dataclass(frozen=True, eq=False)
class _Model:
    """The terms of a spectrum: parameters are the logarithms of the squares of `letters`, then of each Gauss–Markov
    process's variance and correlation time, which start at `times`. With R among the terms the mean is a ramp.
    """

    spectrum: _Spectrum
    terms: str
    times: tuple[float, ...] = ()
    excess: float = 0.0
    extra: FloatArray | None = None  # coefficients (J,) of a further drift

    @property
    def letters(self) -> str:
        return self.terms.replace("R", "")

    @property
    def ramp(self) -> bool:
        return "R" in self.terms

    @cached_property
    def weight(self) -> FloatArray:
        """Effective number (B,) of coefficients: with an excess e, that of an octave of M tells no more than 2/e²."""
        count = self.spectrum.count
        return count / (1 + self.excess**2 * np.bincount(self.spectrum.octave, count)[self.spectrum.octave] / 2)

    @cached_property
    def columns(self) -> FloatArray:
        """Mean density (B, letters) of the coefficients of each letter's term of size one."""
        return np.reshape([self.spectrum.columns[term] for term in self.letters], (-1, len(self.spectrum.count))).T

    @cached_property
    def drift(self) -> FloatArray:
        """Coefficients (J,) of the line that was subtracted, which belongs to the noise unless the mean is a ramp."""
        return (0.0 if self.ramp else self.spectrum.slope) * self.spectrum.ramp()

    @cached_property
    def power(self) -> FloatArray:
        """Mean squares (B,) of the coefficients, with the drift."""
        return self.spectrum.power + self.spectrum.products(2 * self.spectrum.coefficient + self.drift, self.drift)

    @cached_property
    def regressors(self) -> list[FloatArray]:
        """Coefficients (J,) of the drifts in the mean at a size of one."""
        return [*([self.spectrum.ramp()] if self.ramp else []), *([] if self.extra is None else [self.extra])]

    @cached_property
    def cross(self) -> FloatArray:
        """Means (B, drifts) of the coefficients times those of the regressors."""
        low = self.spectrum.coefficient + self.drift
        rows = [self.spectrum.products(low, row) for row in self.regressors]
        return np.reshape(rows, (-1, len(self.spectrum.count))).T

    @cached_property
    def gram(self) -> FloatArray:
        """Means (B, drifts, drifts) of products of the regressors."""
        rows = self.regressors
        products = [self.spectrum.products(a, b) for a in rows for b in rows]
        return np.reshape(products, (len(rows), len(rows), len(self.spectrum.count))).T

    def variance(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Variance (B,), and its derivative (B, parameters) over it."""
        count = self.columns.shape[1]
        parts = [self.columns * np.exp(theta[:count])]
        for i in range(len(self.times)):
            log_variance, log_time = theta[count + 2 * i : count + 2 * i + 2]
            step = 1e-4
            below, above = (_markov(self.spectrum, np.exp(log_time + s)) @ _WEIGHT for s in (-step, step))
            parts.append(np.exp(log_variance) * np.column_stack([(below + above) / 2, (above - below) / (2 * step)]))
        shares = np.hstack(parts)
        processes = [*range(count), *range(count, shares.shape[1], 2)]
        variance = np.maximum(shares[:, processes].sum(axis=1), 1e-300)
        return variance, shares / variance[:, None]

    def sizes(self, variance: FloatArray, fixed: float | None) -> FloatArray:
        """Sizes of the drifts by least squares."""
        weight = self.weight / variance
        gram = np.einsum("b,bij->ij", weight, self.gram)
        cross = weight @ self.cross
        if fixed is None:
            scale = sigmas_of(gram)
            return np.linalg.solve(gram / np.outer(scale, scale), cross / scale) / scale
        return np.concatenate([[fixed], np.linalg.solve(gram[1:, 1:], cross[1:] - gram[1:, 0] * fixed)])

    def residual(self, sizes: FloatArray) -> FloatArray:
        """Mean squares (B,) about the drifts."""
        return np.maximum(self.power - 2 * self.cross @ sizes + np.einsum("bij,i,j->b", self.gram, sizes, sizes), 0.0)

    def start(self) -> FloatArray:
        """Each term as large as no octave forbids."""
        spectrum = self.spectrum
        power = np.bincount(spectrum.octave, spectrum.count * self.power)

        def largest(column: FloatArray) -> float:
            mean = np.bincount(spectrum.octave, spectrum.count * column)
            return np.log(max((power[mean > 0] / mean[mean > 0]).min(), 1e-290))

        theta = [largest(column) for column in self.columns.T]
        for time in self.times:
            theta += [largest(_markov(spectrum, time) @ _WEIGHT), np.log(time)]
        return np.array(theta)

    def solve(self, theta: FloatArray, held: int | None = None, ramp: float | None = None) -> _Fit:
        """Maximise the likelihood by Fisher scoring; `held`: a parameter that stays, `ramp`: the ramp's size if so."""
        free = np.array([i for i in range(len(theta)) if i != held], np.int64)
        damping = 1e-3
        theta = theta.copy()

        def evaluate(at):
            variance, shares = self.variance(at)
            sizes = self.sizes(variance, ramp)
            ratio = self.residual(sizes) / variance
            return shares, sizes, ratio, 0.5 * float(self.weight @ (np.log(variance) + ratio))

        shares, sizes, ratio, loss = evaluate(theta)
        for _ in range(80):
            moving = shares[:, free]
            slope = 0.5 * moving.T @ (self.weight * (ratio - 1))
            fisher = 0.5 * moving.T @ (self.weight[:, None] * moving)
            diagonal = np.diag(fisher)
            live = diagonal > 1e-4  # what has vanished stays so
            if not live.any():
                break
            part = submatrix(fisher, live) + np.diag((damping + 1e-12) * diagonal[live])
            step = np.linalg.solve(part, slope[live]).clip(-2.0, 2.0)
            trial = theta.copy()
            trial[free[live]] += step
            *parts, trial_loss = evaluate(trial)
            if trial_loss <= loss:
                gain = loss - trial_loss
                theta, (shares, sizes, ratio), loss = trial, parts, trial_loss
                damping = max(damping / 10, 1e-9)
                if gain < 1e-7 and abs(step).max() < 1e-2:
                    break
            else:
                damping = max(damping * 10, 1e-6)
                if damping > 1e8 or abs(step).max() < 1e-9:
                    break
        return _Fit(self, theta, sizes, loss, shares, ratio)

    def fit(self) -> _Fit:
        """Maximise the likelihood from the start."""
        return self.solve(self.start())


@dataclass(frozen=True)
class _Fit:
    """Parameters at the maximum of the likelihood: `theta` as in `_Model`, the drifts' sizes, −log L."""

    model: _Model
    theta: FloatArray
    sizes: FloatArray
    loss: float
    shares: FloatArray  # (B, parameters) of the variance; information each holds is Σ w share²/2
    ratio: FloatArray  # (B,) power over variance

    @property
    def ramp(self) -> float:
        """Slope, per second."""
        return self.model.spectrum.slope + float(self.sizes[0])

    @property
    def fisher(self) -> FloatArray:
        """Information about the parameters (k, k)."""
        return 0.5 * self.shares.T @ (self.model.weight[:, None] * self.shares)

    @property
    def by_variance(self) -> FloatArray:
        """Weight of each bin (B,) over its variance."""
        return self.model.weight / self.model.variance(self.theta)[0]

    def held(self, index: int, value: float) -> float:
        """Return by how much −log L is larger at its maximum with one parameter held at a value."""
        theta = self.theta.copy()
        theta[index] = value
        return self.model.solve(theta, index).loss - self.loss

    def information(self) -> FloatArray:
        return 0.5 * self.model.weight @ self.shares**2

    def misfit(self) -> tuple[float, int]:
        """χ² (the deviance of each octave's mean ratio) and its degrees of freedom."""
        weight = self.model.weight
        octave = self.model.spectrum.octave
        total = np.bincount(octave, weight)
        mean = np.bincount(octave, weight * self.ratio)[total > 0] / total[total > 0]
        total = total[total > 0]
        taken = int((self.information() > 0.05).sum()) + len(self.sizes)
        return float((total * (mean - 1 - np.log(mean))).sum()), max(1, len(total) - taken)

    def unlike(self, probability: float) -> bool:
        """Whether the noise is unlike the terms: by chance the misfit is as large with less than a probability."""
        misfit, freedom = self.misfit()
        return bool(misfit > chi2_isf(probability, freedom))


def _times(spectrum: _Spectrum, terms: str, count: int) -> tuple[float, ...]:
    """Correlation times of Gauss–Markov processes to start from, one after the other the best of a grid."""
    times: tuple[float, ...] = ()
    grid = np.geomspace(2 / spectrum.rate, spectrum.samples / spectrum.rate / 6, 16)
    for _ in range(count):
        best = min([_Model(spectrum, terms, (*times, time)).fit() for time in grid], key=lambda fit: fit.loss)
        times = tuple(np.exp(best.theta[len(best.model.letters) + 1 :: 2]).tolist())
    return times


def _select(general: _Model, terms: str) -> tuple[_Fit, frozenset[str]]:
    """Return the fit of the combination of terms with the least information criterion, and terms in it that may be
    others: a combination without one is not ruled out.

    Where none is true, there being an excess, the question is which describes best and no longer which is there: the
    criterion is then Akaike's (H. Akaike, IEEE Trans. Autom. Control 19, 1974), two for every term.
    """
    fits = dict[str, tuple[float, _Fit]]()
    for size in range(0 if general.times else 1, len(terms) + 1):
        for subset in combinations(terms, size):
            if set(subset) == {"R"} and not general.times:
                continue  # a ramp alone has no noise
            fit = replace(general, terms="".join(subset)).fit()
            if (fit.information()[: len(fit.model.letters)] < 0.05).any():
                continue
            criterion = 2 * fit.loss + sum(2.0 if general.excess else _PENALTY[term] for term in subset)
            fits["".join(subset)] = criterion, fit
    if not fits:
        raise NotPossibleError("none of the terms asked for describes any of this signal.")
    best = min(fits, key=lambda letters: fits[letters][0])
    near = [set(letters) for letters, (criterion, _) in fits.items() if criterion < fits[best][0] + _TIE]
    return fits[best][1], frozenset(best).difference(set(best).intersection(*near))


def _excess(general: _Fit) -> float:
    """Return the share by which octaves differ from the most general model, so that its misfit is its freedom."""
    freedom = general.misfit()[1]

    def over(logarithm: float) -> float:
        return replace(general.model, excess=np.exp(logarithm)).fit().misfit()[0] - freedom

    low, high = np.log(1e-3), np.log(2.0)
    return float(np.exp(low if over(low) <= 0 else _root(over, low, high, 0.02)))


def _root(function: Callable[[float], float], low: float, high: float, tolerance: float) -> float:
    """Return where a function that has risen or fallen through zero between `low` and `high` does so, or `high`."""
    if function(low) * function(high) >= 0:
        return high
    return float(scipy.optimize.brentq(function, low, high, xtol=tolerance))


def _bounds(fit: _Fit, index: int, threshold: float) -> tuple[float, float]:
    """Return where the profile of −log L has risen by `threshold`, for a parameter."""
    scale = sigmas_of(fit.fisher)
    inverse = np.linalg.pinv(fit.fisher / np.outer(scale, scale))
    spread = min(np.sqrt(inverse[index, index]) / scale[index], 3.0)
    # a variance known from few coefficients, 2 spread⁻² of them: −2 log L scatters more than χ² (M. S. Bartlett,
    # Proc. R. Soc. A 160, 1937)
    threshold *= 1 + spread**2 / 6
    return _ends(lambda at: fit.held(index, at) - threshold, fit.theta[index], spread, threshold)


def _ramp_bounds(fit: _Fit, threshold: float) -> tuple[float, float]:
    """Return where the profile of −log L has risen by `threshold`, for the slope of the ramp, per second."""
    spread = 1 / float(np.sqrt(fit.by_variance @ fit.model.gram[:, 0, 0]))
    low, high = _ends(
        lambda at: fit.model.solve(fit.theta, ramp=at).loss - fit.loss - threshold, fit.sizes[0], spread, threshold
    )
    return low + fit.model.spectrum.slope, high + fit.model.spectrum.slope


def _ends(rise: Callable[[float], float], centre: float, spread: float, threshold: float) -> tuple[float, float]:
    """Return where a rise, about a parabola of this spread, passes zero on both sides of its lowest point."""

    def end(sign: int) -> float:
        def at(distance: float) -> float:
            return rise(centre + sign * distance * spread)

        far = np.sqrt(2 * threshold) * 1.2
        while at(far) < 0 and far < 200:
            far *= 1.6
        return float(centre + sign * _root(at, 0.0, far, 1e-3) * spread)

    return end(-1), end(1)


def _term(fit: _Fit, index: int, threshold: float, power: float = 0.5, open_end: bool = False) -> Term:
    low, high = np.exp(power * np.array(_bounds(fit, index, threshold)))
    value = np.exp(power * fit.theta[index])
    return Term(float(value), 0.0 if open_end or low <= 1e-3 * value else float(low), float(high))  # open towards zero


def _limit(fit: _Fit, term: str, threshold: float) -> float:
    """How large a term could be beside those of a fit: where the profile of −log L has risen by `threshold`."""
    beside = replace(fit.model, terms="".join(letter for letter in TERMS if letter in fit.model.terms + term)).fit()
    if term == "R":
        return max(map(abs, _ramp_bounds(beside, threshold)))
    index = beside.model.letters.index(term)
    most = beside.model.start()[index]
    root = _root(lambda at: beside.held(index, at) - threshold, max(beside.theta[index], most - 25), most + 12, 1e-2)
    return float(np.exp(root / 2))


def _high_pass(general: _Fit, threshold: float) -> Term | None:
    """Return the time constant (s) of a first-order high pass after which the terms describe what they do not alone.

    A ramp does not come through it. A driver that subtracts a running mean of the output, or that takes its drift out
    with every rest, is one.
    """
    spectrum = general.model.spectrum
    grid = np.log(np.geomspace(_SHORTEST / spectrum.rate, spectrum.samples / spectrum.rate / 3, 16))

    def at(logarithm: float) -> _Fit:
        passed = replace(spectrum, high_pass=np.exp(logarithm))
        return replace(general.model, spectrum=passed, terms=general.model.terms.replace("R", "")).fit()

    def loss(logarithm: float) -> float:
        return at(logarithm).loss

    middle = _lowest_of(loss, grid, general.loss - chi2_isf(_UNLIKELY / len(grid), 1) / 2, 1e-3)
    if middle is None:
        return None
    fit = at(middle)
    if fit.unlike(_UNLIKELY):
        return None

    def end(sign: int) -> float:
        def rise(distance: float) -> float:
            return loss(middle + sign * distance) - fit.loss - threshold

        return middle + sign * _root(rise, 0.0, float(np.ptp(grid)), 1e-3)

    return Term(*np.exp([middle, end(-1), end(1)]).tolist())


def _lowest_of(loss: Callable[[float], float], grid: FloatArray, most: float, tolerance: float) -> float | None:
    """Return where a loss is least, about the best of a grid; None where that is more than `most`."""
    losses = list(map(loss, grid))
    best = int(np.argmin(losses))
    if losses[best] > most:
        return None
    return lowest(loss, (grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]), tolerance)


def _warm_up(spectrum: _Spectrum, terms: str) -> WarmUp | None:
    """Return an exponential drift where the likelihood says overwhelmingly that it is one and no walk or ramp.

    The likelihood without it has all of white noise, flicker, walk and ramp at its disposal, and both count octaves as
    little as the fit with the drift says they may be trusted.
    """
    terms += "".join(term for term in "NBKR" if term not in terms)
    duration = spectrum.samples / spectrum.rate
    without = _Model(spectrum, terms).fit()
    grid = np.geomspace(max(20 / spectrum.rate, duration / 2000), duration / 2, 14)
    low = np.where(spectrum.inside >= 0, (without.by_variance / spectrum.count)[spectrum.inside], 0.0)
    rest = spectrum.coefficient - without.sizes[0] * spectrum.ramp()
    # at the variance without it: an upper bound is not needed to see that there is nothing
    if max((low @ (rest * row)) ** 2 / (low @ row**2) for row in map(spectrum.decay, grid)) < 5:
        return None

    def loss(logarithm: float) -> float:
        return replace(without.model, extra=spectrum.decay(np.exp(logarithm))).fit().loss

    if (best := _lowest_of(loss, np.log(grid), without.loss - _OVERWHELMING / 2, 1e-4)) is None:
        return None
    time = float(np.exp(best))
    fit = replace(without.model, extra=spectrum.decay(time)).fit()
    if fit.unlike(_UNLIKELY):
        excess = _excess(fit)
        fit = replace(fit.model, excess=excess).fit()
        without = replace(without.model, excess=excess).fit()
        if 2 * (without.loss - fit.loss) < _OVERWHELMING:
            return None
    return WarmUp(float(fit.sizes[-1]), time)
