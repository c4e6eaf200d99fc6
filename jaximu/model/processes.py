"""Noise processes: what drives them, how they look when sampled, and their spectrum and Allan variance in theory.

Every process states continuous parameters in SI (two-sided densities) and is turned, exactly, into a discrete linear
system at a sample interval. Sampled values are those of the continuous process at the instant, except white noise,
which has none and is averaged over the interval, N/√Δt. Parameters are numbers, or arrays (..., 3) by sensor axis.
Sources: IEEE Std 952-2020 (terms of the Allan variance), IEEE Std 1139-2022; Brown and Hwang, Introduction to Random
Signals and Applied Kalman Filtering, 2012 (Gauss–Markov processes).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import ClassVar

import numpy as np
import scipy
from numpy.typing import ArrayLike

from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError
from jaximu.model.state_space import LinearSystem, linear_system

__all__ = [
    "BiasInstability",
    "BiasRepeatability",
    "FirstOrderGaussMarkov",
    "Process",
    "Quantisation",
    "RandomConstant",
    "RandomWalk",
    "RateRamp",
    "SecondOrderGaussMarkov",
    "White",
]


@dataclass(frozen=True)
class Process:
    """One random error. Subclasses give `system` (sampled), `density` (spectrum) and `allan_variance`."""

    letter: ClassVar[str] = ""  # of the Allan deviation's term
    per_unit: ClassVar[bool] = False  # drawn once for a unit, not at every power-on

    def __post_init__(self) -> None:
        for each in fields(self):
            value = np.asarray(getattr(self, each.name), float)
            if not np.isfinite(value).all() or (value < 0).any():
                raise InputError(
                    f"{type(self).__name__}: {each.name} must be finite and must not be negative, found "
                    f"{value.tolist()}."
                )
            object.__setattr__(self, each.name, value)

    def system(self, interval: float) -> LinearSystem:
        """Return the process sampled every `interval` seconds."""
        raise NotImplementedError

    def density(self, frequency: ArrayLike) -> FloatArray:
        """Return the two-sided power spectral density at frequencies (n,), Hz: shape (..., n), signal unit² · s."""
        raise NotImplementedError

    def allan_variance(self, tau: ArrayLike) -> FloatArray:
        """Return the Allan variance at averaging times (n,), s: shape (..., n), signal unit²."""
        raise NotImplementedError


def _inverse(cls, correlation_time):
    time = np.asarray(correlation_time, float)
    if not (time > 0).all():
        raise InputError(f"{cls.__name__}: the correlation time must be positive, found {time.tolist()}.")
    return 1 / time


def _column(value: ArrayLike) -> FloatArray:
    """Parameters (...) as (..., 1), against a last axis of frequencies or states."""
    return np.asarray(value, float)[..., None]


@dataclass(frozen=True)
class White(Process):
    """White noise of density N: angle (velocity) random walk once integrated. y_k = N/√Δt · w_k."""

    N: ArrayLike  # signal unit · √s

    letter = "N"

    def system(self, interval):
        through = _column(self.N) / np.sqrt(interval)
        none = np.zeros((0, 0))
        return linear_system(none, np.zeros((0, 1)), np.zeros(0), through, np.zeros(0), none)

    def density(self, frequency):
        return _column(self.N) ** 2 * np.ones_like(np.asarray(frequency, float))

    def allan_variance(self, tau):
        return _column(self.N) ** 2 / np.asarray(tau)


@dataclass(frozen=True)
class RandomWalk(Process):
    """Random walk of density K, from zero: x_{k+1} = x_k + K √Δt · w_k (rate random walk)."""

    K: ArrayLike  # signal unit / √s

    letter = "K"

    def system(self, interval):
        drive = _column(self.K)[..., None] * np.sqrt(interval)
        return linear_system(np.ones((1, 1)), drive, np.ones(1), np.zeros(1), np.zeros(1), np.zeros((1, 0)))

    def density(self, frequency):
        return (_column(self.K) / (2 * np.pi * np.asarray(frequency))) ** 2

    def allan_variance(self, tau):
        return _column(self.K) ** 2 * np.asarray(tau) / 3


@dataclass(frozen=True)
class FirstOrderGaussMarkov(Process):
    """ẋ = −βx + q w, sampled exactly: x_{k+1} = e^{−βΔt} x_k + √(q² (1 − e^{−2βΔt})/2β) · w_k.

    Starts in its stationary spread q/√(2β). β → 0 is the random walk K = q (from zero); β → ∞ with q/β held is white
    noise N = q/β to whatever averages over many 1/β.
    """

    q: ArrayLike  # density of the driving noise, signal unit / √s
    beta: ArrayLike  # 1/s

    @classmethod
    def of(cls, sigma: ArrayLike, correlation_time: ArrayLike) -> FirstOrderGaussMarkov:
        """Return the process of standard deviation `sigma` and correlation time 1/β (s)."""
        beta = _inverse(cls, correlation_time)
        return cls(np.asarray(sigma) * np.sqrt(2 * beta), beta)

    def system(self, interval):
        q, beta = np.broadcast_arrays(np.asarray(self.q, float), np.asarray(self.beta, float))
        moving = beta > 0
        safe = np.where(moving, beta, 1.0)
        variance = np.where(moving, -np.expm1(-2 * safe * interval) / (2 * safe), interval)
        spread = np.where(moving, q / np.sqrt(2 * safe), 0.0)
        decay = np.exp(-beta * interval)
        drive = q * np.sqrt(variance)
        wide = (..., None, None)
        return linear_system(decay[wide], drive[wide], np.ones(1), np.zeros(1), np.zeros(1), spread[wide])

    def density(self, frequency):
        return _column(self.q) ** 2 / (_column(self.beta) ** 2 + (2 * np.pi * np.asarray(frequency)) ** 2)

    def allan_variance(self, tau):
        tau = np.asarray(tau, float)
        x = _column(self.beta) * tau
        # (1 − (3 − 4e^{−x} + e^{−2x})/2x)/x² cancels for small x; there its series is taken
        small = x < 0.5
        series = sum(
            -((-1) ** n) * (2**n - 4) / (2 * math.factorial(n)) * np.where(small, x, 0.0) ** (n - 3)
            for n in range(3, 22)
        )
        safe = np.where(small, 1.0, x)
        exact = (1 - (3 - 4 * np.exp(-safe) + np.exp(-2 * safe)) / (2 * safe)) / safe**2
        over = tau * np.where(small, series, exact)
        return _column(self.q) ** 2 * over


@dataclass(frozen=True)
class SecondOrderGaussMarkov(Process):
    """ẍ = −2βẋ − β²x + q w: critically damped, two states, sampled exactly by the matrix exponential.

    Starts in its stationary spread: x has q/(2 β^{3/2}), ẋ q/(2 β^{1/2}). Sampled it is an ARMA(2, 1).
    """

    q: ArrayLike  # density of the driving noise, signal unit / s^{3/2}
    beta: ArrayLike  # 1/s, positive

    @classmethod
    def of(cls, sigma: ArrayLike, correlation_time: ArrayLike) -> SecondOrderGaussMarkov:
        """Return the process of standard deviation `sigma` and 1/β = `correlation_time` (s)."""
        beta = _inverse(cls, correlation_time)
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
                spread = stationary - step @ stationary @ step.T
            else:  # the difference cancels; Van Loan's integral does not
                block = np.block([[-rate, np.diag([0.0, 1.0])], [np.zeros((2, 2)), rate.T]])
                spread = step @ scipy.linalg.expm(block * interval)[:2, 2:]
            # Cholesky with the rows scaled to one: the position's spread is far below the velocity's
            scale = np.sqrt(np.diag(spread))
            transition[at], root[at] = step, q[at] * np.sqrt(stationary)
            drive[at] = q[at] * scale[:, None] * np.linalg.cholesky(spread / np.outer(scale, scale))
        return linear_system(transition, drive, np.array([1.0, 0.0]), np.zeros(2), np.zeros(2), root)

    def density(self, frequency):
        return _column(self.q) ** 2 / (_column(self.beta) ** 2 + (2 * np.pi * np.asarray(frequency)) ** 2) ** 2

    def allan_variance(self, tau):
        tau = np.asarray(tau, float)
        beta = _column(self.beta)
        # V(τ), the variance of the integral over τ, from the autocovariance σ²(1 + β|t|)e^{−β|t|}; (4V(τ) − V(2τ))/2τ²
        x = beta * tau
        small = x < 0.5
        series = sum(
            (-1) ** n * (n - 3) * (2**n - 4) / math.factorial(n) * np.where(small, x, 0.0) ** (n - 2)
            for n in range(4, 23)
        )
        safe = np.where(small, 1.0, x)
        once = 2 * safe - 3 + np.exp(-safe) * (3 + safe)
        twice = 4 * safe - 3 + np.exp(-2 * safe) * (3 + 2 * safe)
        shape = np.where(small, series, (4 * once - twice) / safe**2)  # cancels for small x
        variance = _column(self.q) ** 2 / (4 * beta**3)
        return variance * shape


@dataclass(frozen=True)
class RandomConstant(Process):
    """A bias drawn once for a unit, of standard deviation `sigma`; no Allan variance sees it."""

    sigma: ArrayLike  # signal unit

    per_unit = True

    def system(self, interval):
        root = _column(self.sigma)[..., None]
        return linear_system(np.ones((1, 1)), np.zeros((1, 0)), np.ones(1), np.zeros(0), np.zeros(1), root)

    def density(self, frequency):
        return 0 * _column(self.sigma) * np.asarray(frequency)

    def allan_variance(self, tau):
        return 0 * _column(self.sigma) * np.asarray(tau)


@dataclass(frozen=True)
class BiasRepeatability(RandomConstant):
    """A bias drawn anew at every power-on, of standard deviation `sigma`: only several recordings show it."""

    per_unit = False


@dataclass(frozen=True)
class RateRamp(Process):
    """A drift y = R t from power-on: no chance in it, but a term of the Allan deviation."""

    R: ArrayLike  # signal unit / s

    letter = "R"

    def system(self, interval):
        start = np.concatenate([0 * _column(self.R), _column(self.R) * interval], axis=-1)
        transition = np.array([[1.0, 1.0], [0.0, 1.0]])
        return linear_system(transition, np.zeros((2, 0)), np.array([1.0, 0.0]), np.zeros(0), start, np.zeros((2, 0)))

    def density(self, frequency):
        return 0 * _column(self.R) * np.asarray(frequency)

    def allan_variance(self, tau):
        return (_column(self.R) * np.asarray(tau)) ** 2 / 2


@dataclass(frozen=True)
class Quantisation(Process):
    """Quantisation noise Q: the integrated signal is read to a step of Q√12, y_k = Q (w_k − w_{k−1})/Δt."""

    Q: ArrayLike  # signal unit · s

    letter = "Q"

    def system(self, interval):
        size = _column(self.Q) / interval
        return linear_system(np.zeros((1, 1)), -size[..., None], np.ones(1), size, np.zeros(1), size[..., None])

    def density(self, frequency):
        raise NotImplementedError("the spectrum of quantisation noise depends on the sample interval")

    def allan_variance(self, tau):
        return 3 * (_column(self.Q) / np.asarray(tau)) ** 2


_RATIO = 4.0
"""Ratio of neighbouring correlation times in the bank that makes flicker noise; its spectrum ripples by
2 / cosh(π² / ln 4) = 0.3 %."""


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
        shortest = 0.7 * interval
        count = 1 + max(0, math.ceil(np.log(float(self.longest) / shortest) / np.log(_RATIO)))
        return np.asarray(shortest * _RATIO ** np.arange(count), np.float64)

    def system(self, interval):
        transition, gain, output, through, root = _innovations(tuple(self.bank(interval)), interval)
        size = _column(self.B)
        wide = size[..., None]
        return linear_system(transition, wide * gain, output, size * through, np.zeros(len(output)), wide * root)

    def density(self, frequency):
        return _column(self.B) ** 2 / (2 * np.pi * np.abs(np.asarray(frequency)))

    def allan_variance(self, tau):
        return 2 * np.log(2) / np.pi * _column(self.B) ** 2 * np.ones_like(np.asarray(tau, float))


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
    variance = np.log(_RATIO) / np.pi
    place, weight = 2 * np.sinh(pole / 2) ** 2, variance * np.sinh(pole)  # cosh p − 1, and the numerators

    def imbalance(logarithm: float) -> float:
        return float(np.sum(weight / (place - np.exp(logarithm))))

    zeros = []
    for high, low in zip(np.log(place[:-1]), np.log(place[1:]), strict=True):
        inset = 1e-12 * (high - low)
        zeros.append(scipy.optimize.brentq(imbalance, low + inset, high - inset, xtol=1e-15))
    zero = 2 * np.arcsinh(np.sqrt(np.exp(zeros) / 2))
    decay = np.exp(-pole)
    nyquist = np.sum(weight / (place + 2))  # the spectrum at cos ω = −1, where nothing cancels: |H|² there
    deviation = np.sqrt(nyquist) * np.prod(1 + decay) / np.prod(1 + np.exp(-zero))
    gain = np.empty(len(pole))
    for i, each in enumerate(pole):
        gain[i] = deviation * decay[i] * np.prod(np.expm1(each - zero) / np.expm1(each - np.delete(pole, i)))
    spread = np.outer(gain, gain) / -np.expm1(-np.add.outer(pole, pole))
    values, vectors = np.linalg.eigh(spread)
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    return np.diag(decay), gain[:, None], np.ones(len(pole)), np.array([deviation]), root
