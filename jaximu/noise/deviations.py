"""Deviations of the Allan family in JAX, batched over axes and units, with confidence intervals.

Definitions and degrees of freedom: W. J. Riley, Handbook of Frequency Stability Analysis, NIST SP 1065 (2008); the
combined algorithm of C. A. Greenhall and W. J. Riley, Uncertainty of stability variances based on finite differences
(PTTI 2003). "Phase" is the integral of the signal: an angle for a gyroscope, a velocity for an accelerometer.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from numpy.typing import ArrayLike, NDArray

from jaximu.errors import InputError, NotPossibleError
from jaximu.precision import require_float64

__all__ = ["KINDS", "Deviation", "averaging_factors", "degrees_of_freedom", "deviation", "power_law"]

FloatArray = NDArray[np.float64]
_BLOCK = 8192
"""Differences that are squared and summed at once."""


@dataclass(frozen=True)
class _Kind:
    order: int  # of the phase difference
    overlapping: bool = True
    modified: bool = False
    total: bool = False


KINDS = {
    "allan": _Kind(2, overlapping=False),
    "overlapping": _Kind(2),
    "modified": _Kind(2, modified=True),
    "hadamard": _Kind(3, overlapping=False),
    "overlapping-hadamard": _Kind(3),
    "total": _Kind(2, total=True),
}
"""Deviations by name: `overlapping` is the overlapping Allan deviation."""


@dataclass(frozen=True)
class Deviation:
    """Deviations at averaging times: values (..., T) with an interval of `confidence`, in the signal's unit.

    tau (T,) s; factor (T,) samples averaged; count (..., T) differences used; exponent (..., T) of the power law
    S(f) ∝ f^α (of the signal) that is taken to rule there; freedom (..., T) equivalent degrees of freedom.
    """

    kind: str
    tau: FloatArray
    factor: NDArray[np.int64]
    value: FloatArray
    low: FloatArray
    high: FloatArray
    count: NDArray[np.int64]
    exponent: NDArray[np.int64]
    freedom: FloatArray
    confidence: float


def averaging_factors(samples: int, kind: str = "overlapping", spacing: str | int = "octave") -> NDArray[np.int64]:
    """Return the numbers of samples to average: octaves (1, 2, 4 …), decades (1, 2, 4, 10, 20, 40 …), or so many spaced
    evenly in their logarithm. The longest leaves at least two differences (one degree of freedom apart from the mean).
    """
    longest = _longest(samples, kind)
    if longest < 1:
        raise NotPossibleError(f"{samples} samples are too few for the {kind} deviation.")
    if spacing == "octave":
        found = 2 ** np.arange(int(np.log2(longest)) + 1)
    elif spacing == "decade":
        found = np.sort(np.concatenate([base * 10 ** np.arange(1 + int(np.log10(longest))) for base in (1, 2, 4)]))
    elif isinstance(spacing, int) and spacing > 0:
        found = np.round(np.geomspace(1, longest, spacing))
    else:
        raise InputError(f"spacing must be 'octave', 'decade' or a number of averaging times, found {spacing!r}.")
    found = np.unique(found.astype(np.int64))
    return found[found <= longest]


def _longest(samples: int, kind: str) -> int:
    each = _kind(kind)
    if each.total:
        return samples // 2
    # two differences at least: phase points less what one difference spans
    return (samples - 1) // (each.order + each.modified) if each.overlapping else samples // (each.order + 1)


def _kind(kind: str) -> _Kind:
    if kind not in KINDS:
        raise InputError(f"the deviation must be one of {', '.join(KINDS)}, found {kind!r}.")
    return KINDS[kind]


def deviation(
    values: ArrayLike,
    rate: float,
    kind: str = "overlapping",
    factors: ArrayLike | None = None,
    *,
    phase: bool = False,
    confidence: float = 0.95,
    exponent: int | None = None,
) -> Deviation:
    """Return a deviation of equally spaced samples (..., n), along the last axis.

    **Arguments:**

    - `values`: the signal, or with `phase=True` its integral. NaN marks a sample of the signal that is missing:
      differences that would reach over it are left out.
    - `rate`: Hz. `kind`: a name of `KINDS`. `factors`: numbers of samples to average, octaves by default.
    - `confidence`: of the interval, from equivalent degrees of freedom. `exponent`: α of the power law S(f) ∝ f^α of
      the signal (0 white noise, −1 flicker, −2 random walk, 2 quantisation), which these depend on; found for each
      averaging time from the data (lag-1 autocorrelation) if None.

    Raises `InputError` for shapes, rates and factors that make no sense, `NotPossibleError` where the data is too short
    or gaps leave fewer than two differences.
    """
    require_float64()
    each = _kind(kind)
    data = np.asarray(values, float)
    if data.ndim < 1 or data.shape[-1] < 3:
        raise NotPossibleError(f"a deviation needs at least three samples, found shape {data.shape}.")
    if not (np.isfinite(rate) and rate > 0):
        raise InputError(f"the sample rate must be a positive number of Hz, found {rate}.")
    if not 0 < confidence < 1:
        raise InputError(f"the confidence must lie between 0 and 1, found {confidence}.")
    if np.isinf(data).any():
        raise InputError("the signal holds infinite values.")
    missing = np.isnan(data)
    gaps = bool(missing.any())
    if gaps and (each.total or phase):
        what = "the total deviation mirrors the recording at its ends" if each.total else "a phase is one curve"
        raise InputError(f"{what} and cannot be taken over gaps (NaN).")
    samples = data.shape[-1] - phase
    chosen = averaging_factors(samples, kind) if factors is None else np.unique(np.asarray(factors, np.int64))
    if not len(chosen) or chosen[0] < 1 or chosen[-1] > _longest(samples, kind):
        raise NotPossibleError(
            f"{samples} samples allow averaging over 1 to {_longest(samples, kind)} of them for the {kind} deviation, "
            f"asked were {np.asarray(factors).tolist()}."
        )
    flat = data.reshape(-1, data.shape[-1])
    lost = missing.reshape(flat.shape)
    points = np.where(lost, 0.0, flat)
    if not phase:
        # about the mean, whose integral is a straight line that no difference sees: the sums stay small
        level = points.sum(axis=1, keepdims=True) / np.maximum(1, (~lost).sum(axis=1, keepdims=True))
        points = np.cumsum(np.where(lost, 0.0, points - level), axis=1) / rate
        points = np.concatenate([np.zeros((len(points), 1)), points], axis=1)
    spoiled = None
    if gaps:
        # what is missing before each phase point: a difference is whole if none is missing between its first and last
        spoiled = np.concatenate([np.zeros((len(lost), 1)), np.cumsum(lost, axis=1)], axis=1)
    square, count = _mean_squares(points, spoiled, chosen, each)
    if (count < 2).any():
        row, column = np.argwhere(count < 2)[0]
        raise NotPossibleError(
            f"gaps leave fewer than two differences at an averaging time of {chosen[column] / rate:g} s (axis {row})."
        )
    tau = chosen / rate
    value = np.sqrt(square / (6 if each.order == 3 else 2)) / tau
    signal = flat if not phase else np.diff(flat, axis=1) * rate
    alpha = (
        np.full(value.shape, exponent, np.int64)
        if exponent is not None
        else np.stack([power_law(series, chosen) for series in signal])
    )
    freedom = np.array(
        [
            [degrees_of_freedom(kind, samples + 1, int(m), int(a)) for m, a in zip(chosen, row, strict=True)]
            for row in alpha
        ]
    )
    freedom *= np.minimum(1.0, count / np.maximum(1, _full_count(samples, chosen, each)))
    tail = (1 - confidence) / 2
    shape = (*data.shape[:-1], len(chosen))
    low = value * np.sqrt(freedom / scipy.stats.chi2.ppf(1 - tail, freedom))
    high = value * np.sqrt(freedom / scipy.stats.chi2.ppf(tail, freedom))
    return Deviation(
        kind, tau, chosen, value.reshape(shape), low.reshape(shape), high.reshape(shape), count.reshape(shape),
        alpha.reshape(shape), freedom.reshape(shape), confidence,
    )  # fmt: skip


def _full_count(samples: int, factors: NDArray[np.int64], kind: _Kind) -> NDArray[np.int64]:
    """Differences there are without gaps."""
    if kind.total:
        return np.full(len(factors), samples - 1)
    span = (kind.order + kind.modified) * factors
    free = samples + 1 + kind.modified - span
    return free if kind.overlapping else (free - 1) // factors + 1


def _mean_squares(points: FloatArray, spoiled: FloatArray | None, factors: NDArray[np.int64], kind: _Kind):
    """Mean square of the phase differences and how many there are, both (C, T)."""
    samples = points.shape[1] - 1
    order, start = kind.order, np.zeros(len(factors), np.int64)
    if kind.modified:  # a difference averaged over m places is one of the next order of the running sum, over m
        points = points - points.mean(axis=1, keepdims=True)
        points = np.concatenate([np.zeros((len(points), 1)), np.cumsum(points, axis=1)], axis=1)
        order += 1
    if kind.total:  # mirrored about both ends; differences are centred on every inner point
        first, last = points[:, :1], points[:, -1:]
        points = np.concatenate([2 * first - points[:, -2:0:-1], points, 2 * last - points[:, -2:0:-1]], axis=1)
        start = samples - factors  # of samples − 1 mirrored points; the first centre is phase point 1
    count = _full_count(samples, factors, kind)
    stride = np.ones_like(factors) if kind.overlapping else factors
    reach = int(np.max(start + (count - 1) * stride + order * factors)) + 1
    padding = max(0, reach + _BLOCK * int(stride.max() if not kind.overlapping else 1) - points.shape[1])
    padded = np.pad(points, [(0, 0), (0, padding)])
    flags = None
    if spoiled is not None:
        flags = np.pad(spoiled, [(0, 0), (0, padding)], mode="edge")
    square, used = _sum_squares(padded, flags, factors, start, count, stride, order, kind.overlapping)
    used = np.asarray(used, np.int64)
    mean = np.asarray(square) / np.maximum(used, 1)
    return (mean / factors**2 if kind.modified else mean), used


@partial(jax.jit, static_argnames=("order", "overlapping"))
def _sum_squares(points, spoiled, factors, start, count, stride, order: int, overlapping: bool):
    """Sums (C, T) of squared differences of an order, of `count` terms `stride` apart from `start`, and their number.

    One averaging time after the other, block by block: memory is bounded by the input.
    """
    weights = [(-1.0) ** k * float(np.prod([(order - j) / (j + 1) for j in range(k)])) for k in range(order + 1)]
    place = jnp.arange(_BLOCK)

    def at(array, first, step):
        if overlapping:
            return jax.lax.dynamic_slice_in_dim(array, first, _BLOCK, axis=1)
        return jnp.take(array, jnp.minimum(first + place * step, array.shape[1] - 1), axis=1)

    def one(arguments):
        m, begin, terms, step = arguments

        def block(number, carried):
            total, used = carried
            first = begin + number * _BLOCK * step
            parts = [w * at(points, first + k * m, step) for k, w in enumerate(weights)]
            difference = sum(parts[1:], start=parts[0])
            good = number * _BLOCK + place < terms
            if spoiled is not None:
                whole = at(spoiled, first + order * m, step) == at(spoiled, first, step)
                good = good & whole
            good = jnp.broadcast_to(good, difference.shape)
            return total + jnp.sum(jnp.where(good, difference, 0.0) ** 2, axis=1), used + jnp.sum(good, axis=1)

        zero = jnp.zeros(points.shape[0])
        blocks = (terms + _BLOCK - 1) // _BLOCK
        return jax.lax.fori_loop(0, blocks, block, (zero, jnp.zeros(points.shape[0], jnp.int64)))

    total, used = jax.lax.map(one, (factors, start, count, stride))
    return total.T, used.T


def power_law(values: ArrayLike, factors: ArrayLike) -> NDArray[np.int64]:
    """Return the exponent α (T,) of the power law S(f) ∝ f^α that rules a signal (n,) averaged over each factor.

    From the lag-1 autocorrelation of the averages, differenced until stationary (SP 1065, 5.5.6); with fewer than
    thirty averages that of the next shorter time. Limited to −4 … 2.
    """
    values = np.asarray(values, float)
    values = np.where(np.isnan(values), np.nanmean(values) if not np.isnan(values).all() else 0.0, values)
    found = []
    for m in np.asarray(factors, np.int64):
        count = len(values) // m
        if count < 30 and found:
            found.append(found[-1])
            continue
        series = values[: count * m].reshape(count, m).mean(axis=1)
        differenced = 0
        while True:
            centred = series - series.mean()
            power = np.sum(centred**2)
            correlation = np.sum(centred[1:] * centred[:-1]) / power if power > 0 else 0.0
            delta = correlation / (1 + correlation) if correlation > -1 else -10.0
            if delta < 0.25 or differenced == 2 or len(series) < 4:
                break
            series, differenced = np.diff(series), differenced + 1
        found.append(int(np.clip(np.round(-2 * (delta + differenced)), -4, 2)))
    return np.array(found, np.int64)


def degrees_of_freedom(kind: str, points: int, factor: int, exponent: int) -> float:
    """Return the equivalent degrees of freedom of a deviation of `points` phase points (Greenhall and Riley 2003).

    `exponent` is α of S(f) ∝ f^α. The total deviation has those of SP 1065, table 7, for white, flicker and random walk
    noise; for short averages, where the mirrored ends add nothing, and for other noise those of the overlapping one.
    """
    each = _kind(kind)
    if each.total and factor >= 8 and exponent <= 0:
        slope, offset = {0: (1.50, 0.0), -1: (1.17, 0.22), -2: (0.93, 0.36)}[max(exponent, -2)]
        return max(1.0, slope * (points - 1) / factor - offset)
    d = each.order
    exponent = max(exponent, 1 - 2 * d + 1)  # differences of this order need α + 2d > 1
    # The phase here is the integral itself, not a mean of it over a sample, which the algorithm takes to bound the
    # power of white and flicker phase; it matters for averages of few samples only.
    averaged = each.modified and factor > 1
    filtering = 1.0 if averaged else (np.inf if exponent <= 0 else float(factor))
    stride = float(factor) if each.overlapping else 1.0
    length = (factor if averaged else 1) + factor * d  # phase points that one difference spans
    terms = 1 + np.floor(stride * (points - length) / factor)
    terms = max(terms, 1.0)
    limit = 100.0
    if stride > limit:  # the sum is smooth in its index: as many terms of a coarser grid give the same
        terms, stride = terms * limit / stride, limit
    highest = int(min(terms, (d + 1) * stride))

    def walk(t):  # s_w
        t = np.abs(t)
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithm = np.where(t > 0, np.log(np.where(t > 0, t, 1.0)), 0.0)
        power = exponent + (2 if filtering > limit else 0)
        forms = {4: t**0 * 0, 3: t * 0, 2: -t, 1: t**2 * logarithm, 0: t**3, -1: -(t**4) * logarithm, -2: -(t**5),
                 -3: t**6 * logarithm, -4: t**7}  # fmt: skip
        return forms[power]

    def filtered(t):  # s_x
        if filtering > limit:
            return walk(t)
        return filtering**2 * (2 * walk(t) - walk(t - 1 / filtering) - walk(t + 1 / filtering))

    def differenced(t):  # s_z: the central difference of order 2d
        weights = {2: (6, -4, 1), 3: (20, -15, 6, -1)}[d]
        sides = (w * (filtered(t - k) + filtered(t + k)) for k, w in enumerate(weights[1:], start=1))
        return weights[0] * filtered(t) + sum(sides)

    j = np.arange(highest + 1)
    z = differenced(j / stride)
    if z[0] == 0:
        return terms
    total = z[0] ** 2 + (1 - highest / terms) * z[highest] ** 2 + 2 * np.sum((1 - j[1:-1] / terms) * z[1:-1] ** 2)
    return float(max(1.0, z[0] ** 2 * terms / total))
