"""Noise processes: what drives them, how they look when sampled, and their spectrum and Allan variance in theory.

Every process states continuous parameters in SI (two-sided densities) and is turned, exactly, into a discrete linear
system at a sample interval. Sampled values are those of the continuous process at the instant, except white noise,
which has none and is averaged over the interval, N/√Δt. Parameters are numbers, or arrays (..., 3) by sensor axis.
Sources: IEEE Std 952-2020 (terms of the Allan variance), IEEE Std 1139-2022; Brown and Hwang, Introduction to Random
Signals and Applied Kalman Filtering, 2012 (Gauss–Markov processes).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from itertools import pairwise
from typing import ClassVar

import numpy as np
import scipy
from numpy.typing import ArrayLike

from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError
from jaximu.ground.vectors import sigmas_of
from jaximu.model.state_space import LinearSystem, linear_system


@dataclass(frozen=True)
class Process:
    """One random error. Subclasses give `system` (sampled), `density` (spectrum) and `allan_variance`."""

    letter: ClassVar[str] = ""  # of the Allan deviation's term
    per_unit: ClassVar[bool] = False  # drawn once for a unit, not at every power-on

    def __post_init__(self) -> None:
        for name, parameter in asdict(self).items():
            value = np.asarray(parameter, float)
            if not np.isfinite(value).all() or (value < 0).any():
                raise InputError(
                    f"{type(self).__name__}: {name} must be finite and must not be negative, found {value.tolist()}."
                )
            object.__setattr__(self, name, value)

    @property
    def size(self) -> FloatArray:
        """The first parameter as (..., 1), against a last axis of frequencies or states."""
        return np.asarray(getattr(self, fields(self)[0].name), float)[..., None]

    def system(self, interval: float) -> LinearSystem:
        """Return the process sampled every `interval` seconds."""
        raise NotImplementedError

    def density(self, frequency: ArrayLike) -> FloatArray:
        """Return the two-sided power spectral density at frequencies (n,), Hz: shape (..., n), signal unit² · s.

        Zero of what does not fluctuate.
        """
        return 0 * self.size * np.asarray(frequency)

    def allan_variance(self, tau: ArrayLike) -> FloatArray:
        """Return the Allan variance at averaging times (n,), s: shape (..., n), signal unit²."""
        raise NotImplementedError


def _by_series(x: FloatArray, closed: Callable[[FloatArray], FloatArray], terms: Iterable[tuple[float, int]]):
    """A function of x (...) in closed form, which cancels for small x: there by terms of a factor and a power of x."""
    small = x < 0.5
    within = np.where(small, x, 0.0)
    return np.where(small, sum(factor * within**power for factor, power in terms), closed(np.where(small, 1.0, x)))


@dataclass(frozen=True)
class White(Process):
    """White noise of density N: angle (velocity) random walk once integrated. y_k = N/√Δt · w_k."""

    N: ArrayLike  # signal unit · √s

    letter = "N"

    def system(self, interval):
        return linear_system(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros(0), self.size / np.sqrt(interval))

    def density(self, frequency):
        return self.size**2 * np.ones_like(np.asarray(frequency, float))

    def allan_variance(self, tau):
        return self.size**2 / np.asarray(tau)


@dataclass(frozen=True)
class RandomWalk(Process):
    """Random walk of density K, from zero: x_{k+1} = x_k + K √Δt · w_k (rate random walk)."""

    K: ArrayLike  # signal unit / √s

    letter = "K"

    def system(self, interval):
        return linear_system(np.ones((1, 1)), self.size[..., None] * np.sqrt(interval), np.ones(1))

    def density(self, frequency):
        return (self.size / (2 * np.pi * np.asarray(frequency))) ** 2

    def allan_variance(self, tau):
        return self.size**2 * np.asarray(tau) / 3


@dataclass(frozen=True)
class _GaussMarkov(Process):
    q: ArrayLike  # density of the driving noise, signal unit / s^{order − 1/2}
    beta: ArrayLike  # 1/s
    order: ClassVar[int]

    @classmethod
    def _rate(cls, correlation_time: ArrayLike) -> FloatArray:
        time = np.asarray(correlation_time, float)
        if not (time > 0).all():
            raise InputError(f"{cls.__name__}: the correlation time must be positive, found {time.tolist()}.")
        return 1 / time

    def density(self, frequency):
        rate = np.asarray(self.beta)[..., None]
        return self.size**2 / (rate**2 + (2 * np.pi * np.asarray(frequency)) ** 2) ** self.order


@dataclass(frozen=True)
class FirstOrderGaussMarkov(_GaussMarkov):
    """ẋ = −βx + q w, sampled exactly: x_{k+1} = e^{−βΔt} x_k + √(q² (1 − e^{−2βΔt})/2β) · w_k.

    Starts in its stationary spread q/√(2β). β → 0 is the random walk K = q (from zero); β → ∞ with q/β held is white
    noise N = q/β to whatever averages over many 1/β.
    """

    order = 1

    @classmethod
    def of(cls, sigma: ArrayLike, correlation_time: ArrayLike) -> FirstOrderGaussMarkov:
        """Return the process of standard deviation `sigma` and correlation time 1/β (s)."""
        beta = cls._rate(correlation_time)
        return cls(np.asarray(sigma) * np.sqrt(2 * beta), beta)

    def system(self, interval):
        q, beta = np.broadcast_arrays(np.asarray(self.q, float), np.asarray(self.beta, float))
        moving = beta > 0
        safe = np.where(moving, beta, 1.0)
        variance = np.where(moving, -np.expm1(-2 * safe * interval) / (2 * safe), interval)
        start = np.where(moving, q / np.sqrt(2 * safe), 0.0)
        decay = np.exp(-beta * interval)
        drive = q * np.sqrt(variance)
        wide = (..., None, None)
        return linear_system(decay[wide], drive[wide], np.ones(1), root=start[wide])

    def allan_variance(self, tau):
        def closed(x):
            return (1 - (3 - 4 * np.exp(-x) + np.exp(-2 * x)) / (2 * x)) / x**2

        tau = np.asarray(tau, float)
        terms = ((-((-1) ** n) * (2**n - 4) / (2 * math.factorial(n)), n - 3) for n in range(3, 22))
        return self.size**2 * (tau * _by_series(np.asarray(self.beta)[..., None] * tau, closed, terms))


@dataclass(frozen=True)
class SecondOrderGaussMarkov(_GaussMarkov):
    """ẍ = −2βẋ − β²x + q w: critically damped, two states, sampled exactly by the matrix exponential.

    Starts in its stationary spread: x has q/(2 β^{3/2}), ẋ q/(2 β^{1/2}). Sampled it is an ARMA(2, 1).
    """

    order = 2

    @classmethod
    def of(cls, sigma: ArrayLike, correlation_time: ArrayLike) -> SecondOrderGaussMarkov:
        """Return the process of standard deviation `sigma` and 1/β = `correlation_time` (s)."""
        beta = cls._rate(correlation_time)
        return cls(2 * np.asarray(sigma) * beta**1.5, beta)

    def __post_init__(self):
        super().__post_init__()
        if (np.asarray(self.beta) == 0).any():
            raise InputError("SecondOrderGaussMarkov: beta must be positive; at zero the process has no spread.")

    def system(self, interval):
        q, beta = np.broadcast_arrays(np.asarray(self.q, float), np.asarray(self.beta, float))
        transition, drive, root = (np.empty((*q.shape, 2, 2)) for _ in range(3))
        for at in np.ndindex(q.shape):
            rate = np.array([[0.0, 1.0], [-(beta[at] ** 2), -2 * beta[at]]])
            step = scipy.linalg.expm(rate * interval)
            stationary = np.diag([1 / (4 * beta[at] ** 3), 1 / (4 * beta[at])])
            if beta[at] * interval > 1e-2:
                covariance = stationary - step @ stationary @ step.T
            else:  # the difference cancels; Van Loan's integral does not
                block = np.block([[-rate, np.diag([0.0, 1.0])], [np.zeros((2, 2)), rate.T]])
                covariance = step @ scipy.linalg.expm(block * interval)[:2, 2:]
            # Cholesky with the rows scaled to one: the position's spread is far below the velocity's
            scale = sigmas_of(covariance)
            transition[at], root[at] = step, q[at] * np.sqrt(stationary)
            drive[at] = q[at] * scale[:, None] * np.linalg.cholesky(covariance / np.outer(scale, scale))
        return linear_system(transition, drive, np.array([1.0, 0.0]), root=root)

    def allan_variance(self, tau):
        def closed(x):
            # V(τ), the variance of the integral over τ, from the autocovariance σ²(1 + β|t|)e^{−β|t|};
            # (4V(τ) − V(2τ))/2τ²
            once = 2 * x - 3 + np.exp(-x) * (3 + x)
            twice = 4 * x - 3 + np.exp(-2 * x) * (3 + 2 * x)
            return (4 * once - twice) / x**2

        beta = np.asarray(self.beta)[..., None]
        terms = (((-1) ** n * (n - 3) * (2**n - 4) / math.factorial(n), n - 2) for n in range(4, 23))
        return self.size**2 / (4 * beta**3) * _by_series(beta * np.asarray(tau, float), closed, terms)


@dataclass(frozen=True)
class RandomConstant(Process):
    """A bias drawn once for a unit, of standard deviation `sigma`; no Allan variance sees it."""

    sigma: ArrayLike  # signal unit

    per_unit = True

    def system(self, interval):
        return linear_system(np.ones((1, 1)), np.zeros((1, 0)), np.ones(1), root=self.size[..., None])

    def allan_variance(self, tau):
        return 0 * self.size * np.asarray(tau)


@dataclass(frozen=True)
class BiasRepeatability(RandomConstant):
    """A bias drawn at every power-on, of standard deviation `sigma`: only several recordings show it."""

    per_unit = False


@dataclass(frozen=True)
class RateRamp(Process):
    """A drift y = R t from power-on: no chance in it, but a term of the Allan deviation."""

    R: ArrayLike  # signal unit / s

    letter = "R"

    def system(self, interval):
        start = self.size * np.array([0.0, interval])
        transition = np.array([[1.0, 1.0], [0.0, 1.0]])
        return linear_system(transition, np.zeros((2, 0)), np.array([1.0, 0.0]), start=start)

    def allan_variance(self, tau):
        return (self.size * np.asarray(tau)) ** 2 / 2


@dataclass(frozen=True)
class Quantisation(Process):
    """Quantisation noise Q: the integrated signal is read to a step of Q√12, y_k = Q (w_k − w_{k−1})/Δt."""

    Q: ArrayLike  # signal unit · s

    letter = "Q"

    def system(self, interval):
        step = self.size / interval
        return linear_system(np.zeros((1, 1)), -step[..., None], np.ones(1), step, root=step[..., None])

    def density(self, frequency):
        raise NotImplementedError("the spectrum of quantisation noise depends on the sample interval")

    def allan_variance(self, tau):
        return 3 * (self.size / np.asarray(tau)) ** 2


RATIO = 4.0
"""Ratio of neighbouring correlation times in a bank that stands for flicker noise; its spectrum ripples by
2 / cosh(π² / ln 4) = 0.3 %."""
MEMBER_VARIANCE = math.log(RATIO) / math.pi
"""Variance of each process of a bank that stands for flicker noise of B = 1."""
FLICKER_VARIANCE = 2 * math.log(2) / math.pi
"""Allan variance of flicker noise of B = 1: 0.664²."""


def correlation_times(shortest: float, longest: float) -> FloatArray:
    """Return the correlation times (s) of Gauss–Markov processes that together are flicker noise, `RATIO` apart."""
    count = 1 + max(0, math.ceil(np.log(longest / shortest) / np.log(RATIO)))
    return np.asarray(shortest * RATIO ** np.arange(count), float)


@dataclass(frozen=True)
class BiasInstability(Process):
    """Flicker noise B: spectrum B²/(2π|f|), Allan deviation √(2 ln 2/π) B = 0.664 B at any averaging time.

    It is the sum of first-order Gauss–Markov processes whose correlation times are spaced by four, from 0.7 sample
    intervals to at least `longest`, each of variance B² ln 4/π: then the spectra add up to B²/ω. Sampled, its Allan
    deviation is within 2 % of 0.664 B from two sample intervals on (8 % more at one, where point samples alias). The
    sum is generated from one draw a sample instead of one for each process, by the steady filter that predicts it (its
    innovations form), which has the same law exactly.
    """

    B: ArrayLike  # signal unit
    longest: float = 1e5  # s: below 1/(2π longest) the spectrum is flat

    letter = "B"

    def __post_init__(self):
        super().__post_init__()
        if (np.asarray(self.longest) == 0).any():
            raise InputError("BiasInstability: longest must be positive.")

    def bank(self, interval: float) -> FloatArray:
        """Return the correlation times (s)."""
        return correlation_times(0.7 * interval, float(self.longest))

    def system(self, interval):
        transition, gain, output, through, root = _innovations(tuple(self.bank(interval)), interval)
        wide = self.size[..., None]
        return linear_system(transition, wide * gain, output, self.size * through, root=wide * root)

    def density(self, frequency):
        return self.size**2 / (2 * np.pi * np.abs(np.asarray(frequency)))

    def allan_variance(self, tau):
        return FLICKER_VARIANCE * self.size**2 * np.ones_like(np.asarray(tau, float))


@lru_cache(maxsize=64)
def _innovations(correlation_times: tuple[float, ...], interval: float):
    """Return A, the gain L (s, 1), C, the innovation's standard deviation d (1,) and the start's root, for B = 1.

    y_k = C x̂_k + d e_k, x̂_{k+1} = A x̂_k + L e_k, e white of variance one: the bank's spectrum factored. With
    p = Δt/T each member adds σ² sinh p / (cosh p − cos ω); between neighbouring poles a = e^{−p} the sum has one zero
    b = e^{−p'}, so H(z) = d Π(1 − b/z)/Π(1 − a/z), and L are its residues. Differences are taken of the exponents:
    poles and zeros lie as close to one as Δt/T, where a Riccati equation loses its digits. x̂ starts in its stationary
    spread.
    """
    pole = interval / np.sort(correlation_times)
    excess, weight = 2 * np.sinh(pole / 2) ** 2, MEMBER_VARIANCE * np.sinh(pole)  # cosh p − 1, and the numerators

    def imbalance(logarithm: float) -> float:
        return float((weight / (excess - np.exp(logarithm))).sum())

    zeros = []
    for high, low in pairwise(np.log(excess)):
        inset = 1e-12 * (high - low)
        zeros.append(scipy.optimize.brentq(imbalance, low + inset, high - inset, xtol=1e-15))
    zero = 2 * np.arcsinh(np.sqrt(np.exp(zeros) / 2))
    decay = np.exp(-pole)
    nyquist = np.sum(weight / (excess + 2))  # the spectrum at cos ω = −1, where nothing cancels: |H|² there
    deviation = np.sqrt(nyquist) * (1 + decay).prod() / (1 + np.exp(-zero)).prod()
    residues = [(np.expm1(p - zero) / np.expm1(p - np.delete(pole, i))).prod() for i, p in enumerate(pole)]
    gain = deviation * decay * np.array(residues)
    values, vectors = np.linalg.eigh(np.outer(gain, gain) / -np.expm1(-np.add.outer(pole, pole)))
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    return np.diag(decay), gain[:, None], np.ones(len(pole)), np.array([deviation]), root


TERM_PROCESSES = {kind.letter: kind for kind in (Quantisation, White, BiasInstability, RandomWalk, RateRamp)}
"""The process of each term of the Allan deviation, of its size alone."""
