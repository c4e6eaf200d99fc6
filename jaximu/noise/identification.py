"""The five terms of the Allan variance identified together, with intervals.

Overlapping Allan variances at octaves are fitted by generalised least squares with the covariance that the fitted noise
itself gives them: neighbouring averaging times share most of their data, and lines drawn through slopes by eye ignore
that. This is the generalised method of wavelet moments (S. Guerrier et al., J. Am. Stat. Assoc. 108, 2013) with the
Haar wavelet, whose variance is half of Allan's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.stats
from numpy.typing import ArrayLike, NDArray

from jaximu.errors import InputError, NotPossibleError
from jaximu.noise.deviations import Deviation, averaging_factors, deviation

__all__ = ["TERMS", "Identified", "Term", "identify"]

FloatArray = NDArray[np.float64]
TERMS = "QNBKR"
_SHORTEST = 256
"""Samples below which there are too few averaging times to tell terms apart."""


@dataclass(frozen=True)
class Term:
    """One term of the noise: value and interval, continuous, SI, two-sided (see `jaximu.noise.datasheet.SI_UNITS`)."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Identified:
    """The terms that one axis's data supports (None: not supported), and the deviation they were fitted to.

    misfit: χ² of the fit and its degrees of freedom. excess: where χ² is far too large, the share by which each Allan
    variance is let differ from the terms (a correlated process, a line, a drift beside them), which widens intervals.
    """

    terms: dict[str, Term | None]
    deviation: Deviation
    misfit: tuple[float, int]
    excess: float = 0.0

    def allan_deviation(self, tau: ArrayLike) -> FloatArray:
        """Return the fitted Allan deviation at averaging times (n,), s."""
        tau = np.asarray(tau, float)
        rate = self.deviation.factor[0] / self.deviation.tau[0]
        theta = np.array([0.0 if term is None else term.value**2 for term in self.terms.values()])
        return np.sqrt(_basis(tau * rate, rate, "".join(self.terms)) @ theta)


def identify(
    values: ArrayLike, rate: float, terms: str = TERMS, confidence: float = 0.95
) -> Identified | list[Identified]:
    """Identify the noise of samples at rest: one `Identified` for (n,), a list of them for (axes, n).

    **Arguments:**

    - `values`: equally spaced samples along the last axis, NaN where one is missing. `rate`: Hz.
    - `terms`: those to look for, of Q (quantisation), N (white), B (bias instability), K (rate random walk), R (ramp).
    - `confidence`: of the intervals.

    Which terms the data supports is decided by the Bayesian information criterion over all their combinations. Where
    no combination describes the deviation, χ² far above its degrees of freedom, the intervals are widened by its root
    and mean the size that a term would need, not that it is there. Raises
    `NotPossibleError` for a recording that is too short or has no noise, `InputError` for unknown terms.
    """
    if not terms or set(terms) - set(TERMS) or len(set(terms)) < len(terms):
        raise InputError(f"terms must be some of {', '.join(TERMS)}, found {terms!r}.")
    data = np.asarray(values, float)
    if data.ndim == 2:
        return [_identify(axis, rate, terms, confidence) for axis in data]
    if data.ndim != 1:
        raise InputError(f"values must be (n,) or (axes, n), found shape {data.shape}.")
    return _identify(data, rate, terms, confidence)


def _identify(values: FloatArray, rate: float, terms: str, confidence: float) -> Identified:
    samples = len(values)
    if samples < _SHORTEST:
        raise NotPossibleError(f"{samples} samples are too few to identify noise; record at least {_SHORTEST}.")
    factors = averaging_factors(samples // 4, "overlapping")
    found = _deviation(values, rate, factors, confidence)
    factors = found.factor
    variance = found.value**2
    if not (variance > 0).all():
        raise NotPossibleError("the signal is constant, or quantised to whole steps: there is no noise to identify.")
    basis = _basis(factors.astype(float), rate, terms)
    covariance = np.diag(2 * variance**2 / found.freedom)
    theta = np.zeros(len(terms))
    for _ in range(4):  # the covariance is that of the noise just fitted
        theta, _ = _fit(basis, variance, covariance)
        covariance = _covariance(theta, terms, factors, samples, rate)
    chosen = _select(basis, variance, covariance)
    theta[:] = 0.0
    theta[list(chosen)], _ = _fit(basis[:, chosen], variance, covariance)
    covariance = _covariance(theta, terms, factors, samples, rate)
    values_, misfit = _fit(basis[:, chosen], variance, covariance)
    excess, freedom = 0.0, len(factors) - len(chosen)
    if misfit > scipy.stats.chi2.ppf(0.999, freedom):
        # The terms do not describe this noise, and the short averages, known best, would dictate all others. Every
        # variance may then differ from the terms by a share that makes the misfit what it should be.
        shares = np.geomspace(1e-3, 1.0, 60)
        whole = [covariance + np.diag((share * variance) ** 2) for share in shares]
        fits = [_fit(basis, variance, each)[1] for each in whole]
        place = int(np.argmax(np.array(fits) <= freedom)) if min(fits) <= freedom else len(shares) - 1
        excess, covariance = float(shares[place]), whole[place]
        chosen = _select(basis, variance, covariance)
        values_, _ = _fit(basis[:, chosen], variance, covariance)
    inverse = np.linalg.inv(basis[:, chosen].T @ scipy.linalg.solve(covariance, basis[:, chosen], assume_a="pos"))
    width = scipy.stats.norm.ppf((1 + confidence) / 2) * np.sqrt(np.diag(inverse))
    result: dict[str, Term | None] = dict.fromkeys(terms)
    for place, value, half in zip(chosen, values_, width, strict=True):
        spread = half / max(value, np.finfo(float).tiny)  # on the logarithm: a variance is not negative
        low, high = (np.sqrt(value * np.exp(sign * spread)) for sign in (-1, 1))
        result[terms[place]] = Term(float(np.sqrt(value)), float(low), float(high))
    return Identified(result, found, (float(misfit), freedom), excess)


def _deviation(values: FloatArray, rate: float, factors: NDArray[np.int64], confidence: float) -> Deviation:
    """Return the overlapping Allan deviation over as long averages as gaps leave whole."""
    for last in range(len(factors), 4, -1):
        try:
            return deviation(values, rate, "overlapping", factors[:last], confidence=confidence)
        except NotPossibleError:
            if not np.isnan(values).any():
                raise
    raise NotPossibleError("gaps leave no stretch whole that is long enough to identify noise.")


def _select(basis: FloatArray, variance: FloatArray, covariance: FloatArray) -> tuple[int, ...]:
    """Return the places of the terms whose combination has the least Bayesian information criterion."""
    best, chosen = np.inf, (0,)
    for size in range(1, basis.shape[1] + 1):
        for subset in combinations(range(basis.shape[1]), size):
            part, misfit = _fit(basis[:, subset], variance, covariance)
            if (part > 0).all() and misfit + size * np.log(len(variance)) < best:
                best, chosen = misfit + size * np.log(len(variance)), subset
    return chosen


def _basis(factors: FloatArray, rate: float, terms: Sequence[str]) -> FloatArray:
    """Allan variance (T, terms) of each term of size one, exact for samples: see `jaximu.noise.processes`."""
    tau = factors / rate
    columns = {
        "Q": 3 / tau**2,
        "N": 1 / tau,
        "B": np.full_like(tau, 2 * np.log(2) / np.pi),
        "K": tau / 3 + 1 / (6 * tau * rate**2),
        "R": tau**2 / 2,
    }
    return np.stack([columns[term] for term in terms], axis=-1)


def _fit(basis: FloatArray, variance: FloatArray, covariance: FloatArray) -> tuple[FloatArray, float]:
    """Non-negative generalised least squares: the sizes squared, and χ²."""
    root = np.linalg.cholesky(covariance)
    white = scipy.linalg.solve_triangular(root, np.column_stack([basis, variance]), lower=True)
    scale = np.linalg.norm(white[:, :-1], axis=0)
    solution, residual = scipy.optimize.nnls(white[:, :-1] / scale, white[:, -1])
    return solution / scale, float(residual**2)


def _covariance(theta: FloatArray, terms: str, factors: NDArray[np.int64], samples: int, rate: float) -> FloatArray:
    """Covariance (T, T) of overlapping Allan variances of Gaussian noise with these terms.

    cov(ν_a, ν_b) = 2/max(T_a, T_b) ∫ |H_a|² |H_b|² S² df over both signs of frequency, with T_a = T − 2τ_a the time
    over which a difference is seen and |H_a|² its response to the signal. Frequencies are spaced evenly in their
    logarithm, each shifted by chance within its place, so that the oscillations of long averages do not beat with them.
    """
    frequency, width, response = _responses(tuple(factors.tolist()), samples, rate)
    angle = np.pi * frequency / rate
    sizes = dict(zip(terms, theta, strict=True))
    spectrum = np.zeros(len(frequency))
    spectrum += sizes.get("Q", 0.0) * 4 * np.sin(angle) ** 2 * rate
    spectrum += sizes.get("N", 0.0)
    spectrum += sizes.get("B", 0.0) / (2 * np.pi * frequency)
    spectrum += sizes.get("K", 0.0) / (4 * np.sin(angle) ** 2 * rate**2)
    power = response * spectrum
    seen = np.asarray((samples - 2.0 * factors + 1) / rate, np.float64)
    integral = 2 * (power * width) @ power.T  # both signs of frequency
    found = 2 * integral / np.maximum(seen[:, None], seen)
    ramp = sizes.get("R", 0.0)
    if ramp > 0:  # a ramp's own differences are constant: their product with the noise's
        tau = factors / rate
        level = np.sqrt(ramp / 2) * tau
        found = found + 4 * np.outer(level, level) * _mean_covariance(power, width, seen)
    return found + np.diag(1e-9 * np.diag(found))


@lru_cache(maxsize=8)
def _responses(factors: tuple[int, ...], samples: int, rate: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Frequencies (F,), their widths (F,) and the responses |H|² (T, F) of Allan's differences, all Hz."""
    edges = np.geomspace(0.02 * rate / samples, rate / 2, 20_001)
    width = np.diff(edges)
    frequency = edges[:-1] + np.random.default_rng(0).random(len(width)) * width
    angle = np.pi * frequency / rate
    return frequency, width, np.stack([2 * np.sin(m * angle) ** 4 / (m * np.sin(angle)) ** 2 for m in factors])


def _mean_covariance(power: FloatArray, width: FloatArray, seen: FloatArray) -> FloatArray:
    """Covariance of the differences' means over the time they are seen: their spectra at half a cycle in that time."""
    lowest = np.array([np.interp(0.5, np.cumsum(width) * t, row) for t, row in zip(seen, power, strict=True)])
    return np.sqrt(np.outer(lowest, lowest)) / np.maximum(seen[:, None], seen)
