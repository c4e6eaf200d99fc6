"""Values measured again under one covariance: whether they are one value, and the line through them over time.

Differences and residuals are contrasts N x of the values x with N orthonormal and N X = 0, X = [1] for one value and
[1, t] for a line: χ² = (N x)ᵀ (N V Nᵀ)⁻¹ N x is that of generalised least squares, and what all values share (gravity's
error) drops out of it. Where a line does not hold, its values scatter by τ beyond V; τ² brings χ² to its degrees of
freedom ν (Paule and Mandel, 1982), and intervals are Student's with ν. An excess below what the test can see stays
unseen: with three values intervals then rest on the stated uncertainties.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import chi2_sf, student_isf, student_two_sided
from jaximu.ground.document import Json
from jaximu.ground.vectors import sigmas_of

_ROUNDING = 1e-12
"""Of the largest eigenvalue of a correlation matrix: what is below it is no direction of its own."""
_DOUBT = 0.05
"""Probability of values as far off a line below which they scatter beyond their stated uncertainties."""


def _contrasts(columns: FloatArray) -> FloatArray:
    """Return orthonormal rows (n − k, n) that are zero on columns (n, k)."""
    return np.linalg.qr(columns, mode="complete")[0][:, columns.shape[1] :].T


@dataclass(frozen=True)
class Sameness:
    """χ² of values being one and the same, with its degrees of freedom and its probability if they are."""

    statistic: float
    freedom: int
    p_value: float

    def document(self) -> Json:
        """Return it as JSON has it."""
        return {"chi_squared": self.statistic, "degrees_of_freedom": self.freedom, "p_value": self.p_value}


def sameness(values: FloatArray, covariance: FloatArray) -> Sameness:
    """Test whether q quantities are the same in all n measurements: values (n, q), covariance (n q, n q)."""
    count, size = values.shape
    contrasts = np.kron(_contrasts(np.ones((count, 1))), np.eye(size))
    difference = contrasts @ values.ravel()
    spread = contrasts @ covariance @ contrasts.T
    scale = sigmas_of(spread)
    roots, vectors = np.linalg.eigh(spread / scale[:, None] / scale)
    kept = roots > _ROUNDING * roots[-1]
    along = vectors[:, kept].T @ (difference / scale)
    statistic = float((along**2 / roots[kept]).sum())
    freedom = int(kept.sum())
    return Sameness(statistic, freedom, float(chi2_sf(statistic, freedom)))


@dataclass(frozen=True)
class StraightLine:
    """The line through values over time, from the last of them on: level + slope · (time − last).

    covariance (2, 2): of level and slope, scatter included. scatter: τ, of values about the line beyond their stated
    uncertainties; 0 where these suffice. freedom: of Student's distribution of both, infinite without scatter.
    statistic, left: χ² of the straight line and its degrees of freedom; p_value: of that χ² if it holds.
    """

    level: float
    slope: float
    covariance: FloatArray
    scatter: float
    freedom: float
    statistic: float
    left: int
    p_value: float

    @classmethod
    def through(cls, times: FloatArray, values: FloatArray, covariance: FloatArray) -> StraightLine:
        """Fit values (n,) with their covariance (n, n) at times (n,), not all alike, the last of them last."""
        columns = np.stack([np.ones(len(times)), times - times[-1]], axis=1)
        contrasts = _contrasts(columns)
        left = len(times) - 2
        roots, vectors = np.linalg.eigh(contrasts @ covariance @ contrasts.T)
        squares = (vectors.T @ (contrasts @ values)) ** 2
        statistic = float((squares / roots).sum())
        p_value = float(chi2_sf(statistic, left)) if left else 1.0
        variance = _excess(squares, roots, left) if p_value < _DOUBT else 0.0
        weights = np.linalg.inv(covariance + variance * np.eye(len(times)))
        spread = np.asarray(np.linalg.inv(columns.T @ weights @ columns), float)
        level, slope = (spread @ columns.T @ weights @ values).tolist()
        freedom = left if variance else np.inf
        return cls(level, slope, spread, float(np.sqrt(variance)), freedom, statistic, left, p_value)

    @property
    def sigma(self) -> float:
        """Standard deviation of the slope."""
        return float(np.sqrt(self.covariance[1, 1]))

    @property
    def half(self) -> float:
        """Half the 95 % interval of the slope."""
        return float(student_isf(0.025, self.freedom)) * self.sigma

    @property
    def p_of_none(self) -> float:
        """The probability of a slope as steep if there is none."""
        return float(student_two_sided(self.slope / self.sigma, self.freedom))

    def until(self, low: float, high: float, multiple: float) -> float | None:
        """Return after how long, from the last value on, a value to come is within its guard band of a limit.

        The guard band is `multiple` standard uncertainties of the line there, with the scatter about it; 0 where it is
        crossed already, None where it never is.
        """
        ends = [self._until(end, side, multiple) for end, side in ((high, 1.0), (low, -1.0)) if np.isfinite(end)]
        return min((end for end in ends if end is not None), default=None)

    def _until(self, end: float, side: float, multiple: float) -> float | None:
        """Solve (d − s t)² = k² (v + 2 c t + w t²) for the first t ≥ 0; d: distance to the limit, s: slope to it."""
        (level, cross), (_, slope) = self.covariance
        level += self.scatter**2
        distance = side * (end - self.level)
        approach = side * self.slope
        if distance - multiple * np.sqrt(level) <= 0:
            return 0.0
        square = approach**2 - multiple**2 * slope
        linear = -2 * (distance * approach + multiple**2 * cross)
        solutions = np.roots([square, linear, distance**2 - multiple**2 * level])
        times = [float(t.real) for t in solutions if not t.imag and t.real > 0 and distance - approach * t.real >= 0]
        return min(times, default=None)

    def document(self) -> Json:
        """Return the drift as JSON has it, per unit of time."""
        return {
            "value": self.slope,
            "sigma": self.sigma,
            "low": self.slope - self.half,
            "high": self.slope + self.half,
            "p_value": self.p_of_none,
            "scatter": self.scatter,
            "straight": {"chi_squared": self.statistic, "degrees_of_freedom": self.left, "p_value": self.p_value},
        }


def _excess(squares: FloatArray, roots: FloatArray, left: int) -> float:
    """Return τ² at which Σ z²/(λ + τ²) is its degrees of freedom; it is above them at zero."""
    from scipy.optimize import brentq

    most = float(squares.sum()) / left
    excess: Any = brentq(lambda excess: (squares / (roots + excess)).sum() - left, 0.0, most)
    return float(excess)
