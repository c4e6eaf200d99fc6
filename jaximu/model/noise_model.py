"""`NoiseModel`: white noise and Gauss–Markov processes fitted to a unit at rest, and the covariances they give.

Whatever is averaged or integrated (pose means, turns) needs one function of the noise: the variance 2 G(h) of its
integral over h seconds. The covariance of two means over [a, b] and [c, d] is

    (G(d − a) + G(c − b) − G(c − a) − G(d − b)) / ((b − a)(d − c)),   G'' the autocovariance,

so slow bias is carried from one interval to the next. The bank is fitted to the periodogram, each of its members by
the periodogram it is expected to give in this very recording, leakage and aliasing included ("debiased Whittle"
likelihood: Sykulski, Olhede, Guillaumin, Lilly, Early, Biometrika 106, 2019). With variances that may not be negative
this is a non-negative least-squares problem, reweighted until its weights are those of its own spectrum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import ArrayLike

from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.ground.page import Result
from jaximu.model.processes import RATIO

_LONGEST = 4.0
"""Longest correlation time, in lengths of the recording: slower than this looks like a random walk in it."""
_FELT = 4.0
"""Hz: means over poses and parts of turns hardly feel what is faster."""
_BENT = 0.05
"""Share by which a band's power may differ from the terms' before they are taken not to follow it."""
_QUICK = 20.0
"""Correlation time (s) above which processes are slow bias: flicker noise, in which all of them are alike to a factor
of two or so, and a random walk, which is the slowest of them."""


@dataclass(frozen=True)
class AxisNoise:
    """The noise of one triad, axes independent, in m/s² or rad/s.

    white (3,): density N², two-sided, SI² · s. quantisation (3,): Q² of the integrated signal (SI · s)².
    variance (3, M) and correlation_time (M,), s: stationary variances, SI², of first-order Gauss–Markov processes.
    duration: s, of the recording it was fitted to; 0 if it was not fitted.
    """

    white: FloatArray
    quantisation: FloatArray
    variance: FloatArray
    correlation_time: FloatArray
    duration: float = 0.0

    @classmethod
    def of_white(cls, density: ArrayLike) -> AxisNoise:
        """Return white noise of density N² (a number or (3,)) and nothing else."""
        return cls(np.broadcast_to(np.asarray(density, float), (3,)), np.zeros(3), np.zeros((3, 0)), np.zeros(0))

    def integrated(self, duration: ArrayLike) -> FloatArray:
        """Return G (..., 3): half the variance of the noise's integral over `duration` (...), s; even in it."""
        h = np.abs(np.asarray(duration, float))[..., None]
        x = h / self.correlation_time  # (..., M)
        slow = self.correlation_time**2 * (x + np.expm1(-x))
        return self.white * h / 2 + self.quantisation * (h > 0) + slow @ self.variance.T

    def covariance(self, start: ArrayLike, stop: ArrayLike) -> FloatArray:
        """Return the covariance (3, n, n), SI², of the means over n intervals, `start` and `stop` (n,), s."""
        a, b = np.asarray(start, float), np.asarray(stop, float)
        across = self.integrated(b[None, :] - a[:, None])
        parts = (
            across
            + across.swapaxes(0, 1)  # of the other ends: the integral's variance is even
            - self.integrated(a[None, :] - a[:, None])
            - self.integrated(b[None, :] - b[:, None])
        )
        return np.asarray(np.moveaxis(parts / ((b - a)[:, None] * (b - a))[..., None], -1, 0), float)

    def whitening(self, start: ArrayLike, stop: ArrayLike) -> FloatArray:
        """Return W (3, n, n), lower triangular, that makes the means over n intervals independent, of variance one."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariance(start, stop))), float)

    def allan_variance(self, tau: ArrayLike) -> FloatArray:
        """Return the Allan variance (n, 3) at averaging times (n,), s: (4 V(τ) − V(2τ)) / 2τ², V = 2G."""
        tau = np.asarray(tau, float)
        return np.asarray((4 * self.integrated(tau) - self.integrated(2 * tau)) / tau[..., None] ** 2, float)

    def drift(self) -> AxisNoise:
        """Return the slow bias alone, without white noise and quantisation."""
        return replace(self, white=np.zeros(3), quantisation=np.zeros(3))

    def split(self, shortest: float) -> tuple[FloatArray, AxisNoise]:
        """Return the density (3,) of what is as good as white over times from `shortest` (s) on, and all the rest."""
        slow = self.correlation_time >= shortest
        fast = 2 * self.variance[:, ~slow] @ self.correlation_time[~slow]
        rest = AxisNoise(
            np.zeros(3), self.quantisation, self.variance[:, slow], self.correlation_time[slow], self.duration
        )
        return self.white + fast, rest


@dataclass(frozen=True, repr=False)
class NoiseModel(Result, page="noise_model"):
    """The noise of a unit: accelerometer (m/s²) and, unless None, gyroscope (rad/s)."""

    accelerometer: AxisNoise
    gyroscope: AxisNoise | None = None
    notes: tuple[str, ...] = ()


def fit_bank(values: FloatArray, rate: float) -> AxisNoise:
    """Fit samples (..., 3, n) at `rate` (Hz); with a leading axis, parts of one noise whose means do not count."""
    parts = values.reshape(-1, 3, values.shape[-1])
    samples = parts.shape[-1]
    edges, times, expected = _expectations(samples, float(rate))
    counts = np.diff(edges)
    mean = np.zeros((3, len(counts)))
    for part in parts:
        transform = np.fft.rfft(part - part.mean(axis=1, keepdims=True), axis=1)[:, 1:]
        power = np.abs(transform) ** 2 / (samples * rate)
        mean += np.add.reduceat(power, edges[:-1], axis=1)[:, : len(counts)] / counts / len(parts)
    sizes = np.stack([_fitted(expected, row, counts * len(parts), edges, samples / rate, times) for row in mean])
    return AxisNoise(sizes[:, 0], sizes[:, 1], sizes[:, 2:], times, samples / rate)


def _fitted(
    expected: FloatArray,
    mean: FloatArray,
    counts: IntArray,
    edges: IntArray,
    duration: float,
    times: FloatArray,
) -> FloatArray:
    """Fit all frequencies if the terms can follow them, else those that poses and turns feel.

    A low-pass filter in the sensor bends the spectrum as no sum of these terms does, and its high frequencies, known
    best, would dictate the low ones.
    """
    mean = np.maximum(mean, max(1e-9 * float(mean.max(initial=0.0)), 1e-24))  # coarse steps may leave no scatter
    sizes = _non_negative(expected, mean, counts, times)
    frequency = (edges[:-1] + edges[1:]) / 2 / duration
    felt = frequency <= _FELT
    if felt.all() or felt.sum() < 8:
        return sizes
    for band in np.array_split(np.flatnonzero(frequency > _FELT / 4), 8):
        ratio = np.average(mean[band] / (sizes @ expected[:, band]), weights=counts[band])
        if abs(np.log(ratio)) > max(_BENT, 4 / np.sqrt(counts[band].sum())):
            return _non_negative(expected[:, felt], mean[felt], counts[felt], times)
    return sizes


def _non_negative(expected: FloatArray, mean: FloatArray, counts: IntArray, times: FloatArray) -> FloatArray:
    """Return sizes s ≥ 0 (terms,) for which the mean power of each bin (bins,) is like expected.T @ s.

    A mean of c ordinates of power S has the variance S²/c: Fisher scoring for their Gamma likelihood. Of processes so
    slow that few ordinates feel them, least squares would make one large and its neighbours zero. They are known
    beforehand to be flicker noise, of one size to a factor of two or so, and a random walk, which the slowest stands
    for: two more unknowns, which the ordinates feel through these processes alone.
    """
    terms = len(expected)
    slow = 2 + np.flatnonzero(times > _QUICK)
    alike = np.zeros((len(slow), terms + 2))
    alike[np.arange(len(slow)), slow] = 1
    alike[:, terms] = -1  # flicker noise
    alike[-1:, terms + 1] = -1  # a random walk
    felt = np.concatenate([expected, np.zeros((2, expected.shape[1]))])
    spectrum, sizes = mean + np.median(mean) * 1e-3, np.zeros(terms)
    for _ in range(60):
        weight = np.sqrt(counts) / spectrum
        columns, target = (felt * weight).T, mean * weight
        if sizes.any():
            flicker = sizes[slow[:-1]].sum() / max(len(slow) - 1, 1)
            level = max(flicker, 1e-3 * sizes[2:].max(initial=0.0))
            columns = np.concatenate([columns, alike / level]) if level else columns
            target = np.concatenate([target, np.zeros(len(columns) - len(target))])
        scale = np.linalg.norm(columns, axis=0)
        scale[scale == 0] = 1
        sizes = (scipy.optimize.nnls(columns / scale, target)[0] / scale)[:terms]
        before, spectrum = spectrum, sizes @ expected
        if np.abs(spectrum / before - 1).max() < 1e-6:
            break
    return sizes


@lru_cache(maxsize=4)
def _expectations(samples: int, rate: float) -> tuple[IntArray, FloatArray, FloatArray]:
    """Edges of the bins of Fourier frequencies, correlation times (M,), and each term's expected power (2 + M, bins).

    The first frequencies are bins of their own, the others about 8 % wide.
    """
    half = samples // 2
    wider = np.geomspace(13, half, 1 + int(12.5 * np.log(half / 13)))
    edges = np.unique(np.concatenate([np.arange(13), np.round(wider)])).astype(np.int64)
    counts = np.diff(edges)
    longest, shortest = _LONGEST * samples / rate, 2 / rate
    times = longest / RATIO ** np.arange(1 + int(np.log(longest / shortest) / np.log(RATIO)))[::-1]
    lag = np.arange(samples)
    share = (1 - lag / samples) / rate

    def binned(power):
        return np.add.reduceat(power[1 : half + 1], edges[:-1]) / counts

    rows = [np.ones(len(counts))]  # white noise of density one
    frequency = np.arange(half + 1) / samples
    rows.append(binned(4 * np.sin(np.pi * frequency) ** 2 * rate))  # quantisation: first differences of white noise
    for time in times:
        # E|X|²/n of n samples of the autocovariance c is Σ (1 − |k|/n) c(k) e^{−iωk}, leakage and aliasing included
        weighted = share * np.exp(-lag / (rate * time))
        rows.append(binned(2 * np.fft.rfft(weighted).real - weighted[0]))
    return edges, np.asarray(times, float), np.stack(rows)
