"""Deviations of the Allan family, batched over axes and units, with confidence intervals.

Definitions and degrees of freedom: W. J. Riley, Handbook of Frequency Stability Analysis, NIST SP 1065 (2008); the
combined algorithm of C. A. Greenhall and W. J. Riley, Uncertainty of stability variances based on finite differences
(PTTI 2003). "Phase" is the integral of the signal: an angle for a gyroscope, a velocity for an accelerometer.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.ground.cores import available_cores
from jaximu.ground.distributions import deviation_interval
from jaximu.ground.equality import Comparable
from jaximu.ground.errors import InputError, NotPossibleError

_BLOCK = 1 << 15
"""Differences squared, or averages compared, at once: what short averages need of the phase stays in the cache."""
_FINEST = 32
"""Phase points that the multi-resolution deviation keeps an averaging time, at least."""
RESOLUTIONS = ("full", "multi")
"""Ways to take the overlapping Allan deviation: of every phase point, or of as many as matter."""


@dataclass(frozen=True)
class _DeviationKind:
    order: int  # of the phase difference
    overlapping: bool = True
    modified: bool = False
    total: bool = False


KINDS = {
    "allan": _DeviationKind(2, overlapping=False),
    "overlapping": _DeviationKind(2),
    "modified": _DeviationKind(2, modified=True),
    "hadamard": _DeviationKind(3, overlapping=False),
    "overlapping-hadamard": _DeviationKind(3),
    "total": _DeviationKind(2, total=True),
}
"""Deviations by name: `overlapping` is the overlapping Allan deviation."""


@dataclass(frozen=True, eq=False)
class Deviation(Comparable):
    """Deviations at averaging times: values (..., T) with an interval of `confidence`, in the signal's unit.

    tau (T,) s; factor (T,) samples averaged; count (..., T) differences used; exponent (..., T) of the power law
    S(f) ∝ f^α (of the signal) that is taken to rule there; freedom (..., T) equivalent degrees of freedom.
    """

    kind: str
    tau: FloatArray
    factor: IntArray
    value: FloatArray
    low: FloatArray
    high: FloatArray
    count: IntArray
    exponent: IntArray
    freedom: FloatArray
    confidence: float


def averaging_factors(samples: int, kind: str = "overlapping", spacing: str | int = "octave") -> IntArray:
    """Return the numbers of samples to average: octaves (1, 2, 4 …), decades (1, 2, 4, 10, 20, 40 …), or so many spaced
    evenly in their logarithm. The longest leaves at least two differences (one degree of freedom apart from the mean).
    """
    if (longest := _longest(samples, kind)) < 1:
        raise NotPossibleError(f"{samples} samples are too few for the {kind} deviation.")
    if spacing == "octave":
        factors = 2 ** np.arange(int(np.log2(longest)) + 1)
    elif spacing == "decade":
        factors = np.multiply.outer((1, 2, 4), 10 ** np.arange(1 + int(np.log10(longest)))).ravel()
    elif isinstance(spacing, int) and spacing > 0:
        factors = np.geomspace(1, longest, spacing).round()
    else:
        raise InputError(f"spacing must be 'octave', 'decade' or a number of averaging times, found {spacing!r}.")
    factors = np.unique(factors.astype(np.int64))
    return factors[factors <= longest]


def _longest(samples: int, kind: str) -> int:
    difference = _kind(kind)
    if difference.total:
        return samples // 2
    # two differences at least: phase points less what one difference spans
    if difference.overlapping:
        return (samples - 1) // (difference.order + difference.modified)
    return samples // (difference.order + 1)


def _kind(kind: str) -> _DeviationKind:
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
    resolution: str = "full",
) -> Deviation:
    """Return a deviation of equally spaced samples (..., n), along the last axis.

    **Arguments:**

    - `values`: the signal, or with `phase=True` its integral. NaN marks a sample of the signal that is missing:
      differences that would reach over it are left out.
    - `rate`: Hz. `kind`: a name of `KINDS`. `factors`: numbers of samples to average, octaves by default.
    - `confidence`: of the interval, from equivalent degrees of freedom. `exponent`: α of the power law S(f) ∝ f^α of
      the signal (0 white noise, −1 flicker, −2 random walk, 2 quantisation), which these depend on; found for each
      averaging time from the data (lag-1 autocorrelation) if None.
    - `resolution`: "full", or for the overlapping Allan deviation "multi", faster on long recordings: averages of 64
      samples and more take every second, fourth, … phase point, so that 32 to 64 of them are left an averaging time.
      Factors are rounded to multiples of that step, by 1.6 % at most, but down by up to 3 % where the recording ends;
      `Deviation.tau` and `factor` hold those taken, once each. The square stays unbiased. Where quantisation (α > 0)
      rules averages of 64 samples and more, take the full one.

    Memory beside the input is that of three rows for each processor. Raises `InputError` for shapes, rates
    and factors that make no sense, `NotPossibleError` where the data is too short or gaps leave fewer than two
    differences.
    """
    difference = _kind(kind)
    data = np.asarray(values, float)
    _require_sense(data, rate, difference, phase, confidence)
    rows = data.reshape(-1, data.shape[-1])
    samples = data.shape[-1] - phase
    grid = _wanted_grid(factors, samples, kind, resolution)

    def analysed(row: FloatArray) -> tuple[FloatArray, IntArray, IntArray]:
        points, lost = (row, None) if phase else _integrated(row)
        alpha = _exponents(points, grid.factor) if exponent is None else np.full(len(grid.factor), exponent)
        return *_mean_squares(points, lost, grid, difference), alpha

    with ThreadPoolExecutor(available_cores()) as pool:
        square, count, alpha = map(np.array, zip(*pool.map(analysed, rows), strict=True))
    if (count < 2).any():
        row, column = np.argwhere(count < 2)[0]
        raise NotPossibleError(
            f"gaps leave fewer than two differences at an averaging time of {grid.factor[column] / rate:g} s "
            f"(axis {row})."
        )
    tau = grid.factor / rate
    # an integrated signal is summed here in samples, a given phase in seconds
    value = np.sqrt(square / (6 if difference.order == 3 else 2)) / (tau if phase else grid.factor)
    full = np.vectorize(partial(degrees_of_freedom, kind, samples + 1), [float])(grid.factor, alpha, grid.lag)
    freedom = full * np.minimum(1.0, count / np.maximum(1, grid.count))
    distinct, index = np.unique(freedom, return_inverse=True)
    low, high = deviation_interval(distinct, confidence)[:, index.ravel()].reshape(2, *value.shape)
    shape = (*data.shape[:-1], len(tau))
    value, low, high, count, alpha, freedom = (
        array.reshape(shape) for array in (value, value * low, value * high, count, alpha, freedom)
    )
    return Deviation(kind, tau, grid.factor, value, low, high, count, alpha, freedom, confidence)


def _wanted_grid(factors: ArrayLike | None, samples: int, kind: str, resolution: str) -> _Grid:
    if resolution not in RESOLUTIONS:
        raise InputError(f"the resolution must be one of {', '.join(RESOLUTIONS)}, found {resolution!r}.")
    multi = resolution == "multi"
    if multi and kind != "overlapping":
        raise InputError(f"the multi-resolution deviation is the overlapping Allan deviation, not the {kind} one.")
    chosen = averaging_factors(samples, kind) if factors is None else np.unique(np.asarray(factors, np.int64))
    if not len(chosen) or chosen[0] < 1 or chosen[-1] > _longest(samples, kind):
        raise NotPossibleError(
            f"{samples} samples allow averaging over 1 to {_longest(samples, kind)} of them for the {kind} "
            f"deviation, asked were {np.asarray(factors).tolist()}."
        )
    return _grid(chosen, samples, KINDS[kind], multi)


def require_samples(data: FloatArray, rate: float, confidence: float) -> None:
    """Raise `InputError` for samples, a rate (Hz) or a confidence of which no analysis makes sense."""
    if not (np.isfinite(rate) and rate > 0):
        raise InputError(f"the sample rate must be a positive number of Hz, found {rate}.")
    if not 0 < confidence < 1:
        raise InputError(f"the confidence must lie between 0 and 1, found {confidence}.")
    if np.isinf(data).any():
        raise InputError("the signal holds infinite values.")


def _require_sense(data: FloatArray, rate: float, difference: _DeviationKind, phase: bool, confidence: float) -> None:
    """Raise `InputError` or `NotPossibleError` for a signal or numbers of which no deviation can be taken."""
    if data.ndim < 1 or data.shape[-1] < 3:
        raise NotPossibleError(f"a deviation needs at least three samples, found shape {data.shape}.")
    require_samples(data, rate, confidence)
    if (difference.total or phase) and np.isnan(data).any():
        what = "the total deviation mirrors the recording at its ends" if difference.total else "a phase is one curve"
        raise InputError(f"{what} and cannot be taken over gaps (NaN).")


@dataclass(frozen=True)
class _Grid:
    """For each averaging time (T,): `count` differences of points `lag` apart, from point `first` on.

    The points are every 1st, 2nd, 4th … phase point: every 2^level-th.
    """

    factor: IntArray
    lag: IntArray
    level: IntArray
    first: IntArray
    count: IntArray


def _grid(factors: IntArray, samples: int, kind: _DeviationKind, multi: bool) -> _Grid:
    zero = np.zeros_like(factors)
    if not multi:
        # a mirrored phase begins samples − 1 points earlier; its differences are centred on the inner points
        first = samples - factors if kind.total else zero
        return _Grid(factors, factors, zero, first, _full_count(samples, factors, kind))
    # the recording's own level at most: two averages and one point more of it
    highest = max(0, (samples // (2 * _FINEST + 1)).bit_length() - 1)
    level = np.array([min(max(0, (int(m) // _FINEST).bit_length() - 1), highest) for m in factors])
    step = 1 << level
    # Of k points and m samples an average the variance of the square grows by 5/4 (1/k² − 1/m²), less than 0.13 %, for
    # white noise (after SP 1065, table 6), by less than 0.01 % for flicker and random walk.
    # to the nearest multiple that leaves two differences
    lag = np.minimum((factors + step // 2) // step, ((samples >> level) - 1) // 2)
    even = (lag == 2 * _FINEST) & (samples >> (level + 1) > 2 * _FINEST)  # a factor rounded up to the next level's
    lag, level = np.where(even, _FINEST, lag), level + even
    factor, kept = np.unique(lag << level, return_index=True)
    lag, level = lag[kept], level[kept]
    return _Grid(factor, lag, level, zero[kept], (samples >> level) + 1 - 2 * lag)


def _full_count(samples: int, factors: IntArray, kind: _DeviationKind) -> IntArray:
    if kind.total:
        return np.full(len(factors), samples - 1)
    free = samples + 1 + kind.modified - (kind.order + kind.modified) * factors
    return free if kind.overlapping else (free - 1) // factors + 1


def _integrated(row: FloatArray) -> tuple[FloatArray, NDArray[np.int32] | None]:
    """The phase (n + 1,) of a signal (n,) and how many samples are missing before each of its points, None for none."""
    lost = np.isnan(row)
    # about the mean, whose integral is a straight line that no difference sees: the sums stay small
    mean = np.nansum(row) / max(1, len(row) - lost.sum())
    points = np.zeros(len(row) + 1)
    np.cumsum(np.where(lost, 0.0, row - mean), out=points[1:])
    return points, np.cumulative_sum(lost, dtype=np.int32, include_initial=True) if lost.any() else None


def _mean_squares(
    points: FloatArray, lost: NDArray[np.int32] | None, grid: _Grid, kind: _DeviationKind
) -> tuple[FloatArray, IntArray]:
    """Mean squares (T,) of the differences of phase points (n + 1,), and of how many that miss nothing."""
    order = kind.order
    if kind.modified:  # a difference averaged over m places is one of the next order of the running sum, over m
        points, order = np.cumulative_sum(points - points.mean(), include_initial=True), order + 1
        lost = None if lost is None else np.append(lost, lost[-1])
    if kind.total:  # mirrored about both ends; differences are centred on every inner point
        mirrored = points[-2:0:-1]
        points = np.concatenate([2 * points[0] - mirrored, points, 2 * points[-1] - mirrored])
    square = np.zeros(len(grid.factor))
    count = np.zeros(len(grid.factor), np.int64)
    # short averages need the same points: a block stays in the processor's cache for all of them
    block = _BLOCK if kind.overlapping else len(points)
    for level in np.unique(grid.level):
        chosen = np.flatnonzero(grid.level == level)
        step = 1 << level
        at_level = np.ascontiguousarray(points[::step])
        missing = None if lost is None else lost[::step]
        for start in range(0, len(at_level), block):
            for k in chosen:
                lag = grid.lag[k]
                stride = 1 if kind.overlapping else lag
                begin = max(start, grid.first[k])
                end = min(start + block, grid.first[k] + grid.count[k] * stride)
                if begin >= end:
                    continue
                differences = _differences(at_level, slice(begin, end, stride), lag, order)
                if missing is not None:
                    whole = missing[begin + order * lag : end + order * lag : stride] == missing[begin:end:stride]
                    differences = differences[whole]
                square[k] += _product(differences, differences)
                count[k] += len(differences)
    return square / np.maximum(count, 1) / (grid.factor**2 if kind.modified else 1), count


def _differences(points: FloatArray, places: slice, lag: int, order: int) -> FloatArray:
    """Differences of an order of points `lag` apart, that begin at the places."""
    if order == 0:
        return points[places]
    later = slice(places.start + lag, places.stop + lag, places.step)
    return _differences(points, later, lag, order - 1) - _differences(points, places, lag, order - 1)


def _product(left: FloatArray, right: FloatArray) -> float:
    """Inner product on one core: BLAS would start threads of its own in each of those here."""
    return float(np.einsum("i,i", left, right))


def _exponents(points: FloatArray, factors: IntArray) -> IntArray:
    """The exponents (T,) of the noise by its phase: means over a factor are differences of every so manieth point.

    Those with too few averages take the exponent of the one before.
    """
    alpha = np.zeros(len(factors), np.int64)
    for k, factor in enumerate(factors):
        ends = points[::factor]
        alpha[k] = _exponent(ends) if k == 0 or len(ends) > 30 else alpha[k - 1]
    return alpha


def _exponent(ends: FloatArray) -> int:
    """The exponent of the noise by the phase at the ends of averages: differenced until it is no walk."""
    delta = np.inf
    order = 0
    for order in range(3):
        correlation = _lag_one(ends, 1 + order)
        delta = correlation / (1 + correlation) if correlation > -1 else -10.0
        if delta < 0.25 or len(ends) - order < 5:
            break
    return int(np.clip(np.round(-2 * (delta + order)), -4, 2))


def _lag_one(points: FloatArray, order: int) -> float:
    """Lag-1 autocorrelation of the differences of an order, about their mean."""
    length = len(points) - order
    first, last = (np.diff(part, order - 1)[0] for part in (points[:order], points[-order:]))
    mean = (last - first) / length
    power = product = 0.0
    for start in range(0, length, _BLOCK):
        series = np.diff(points[start : start + _BLOCK + order + 1], order) - mean
        power += _product(series[:_BLOCK], series[:_BLOCK])
        product += _product(series[:-1], series[1:])
    return product / power if power > 0 else 0.0


def degrees_of_freedom(kind: str, points: int, factor: int, exponent: int, lag: int | None = None) -> float:
    """Return the equivalent degrees of freedom of a deviation of `points` phase points (Greenhall and Riley 2003).

    `exponent` is α of S(f) ∝ f^α. The total deviation has those of SP 1065, table 7, for white, flicker and random walk
    noise; for short averages, where the mirrored ends add nothing, and for other noise those of the overlapping one.
    `lag`: differences an averaging time, evenly spaced; as many as samples (`factor`) if None.
    """
    difference = _kind(kind)
    if difference.total and factor >= 8 and exponent <= 0:
        slope, offset = {0: (1.50, 0.0), -1: (1.17, 0.22), -2: (0.93, 0.36)}[max(exponent, -2)]
        return max(1.0, slope * (points - 1) / factor - offset)
    d = difference.order
    exponent = max(exponent, 1 - 2 * d + 1)  # differences of this order need α + 2d > 1
    # The phase here is the integral itself, not a mean of it over a sample, which the algorithm takes to bound the
    # power of white and flicker phase; it matters for averages of few samples only.
    averaged = difference.modified and factor > 1
    filtering = 1.0 if averaged else (np.inf if exponent <= 0 or factor > _FINE else float(factor))
    stride = float(lag or factor) if difference.overlapping else 1.0
    length = (factor if averaged else 1) + factor * d  # phase points that one difference spans
    terms = max(1.0, 1 + np.floor(stride * (points - length) / factor))
    if exponent > 0 and filtering > _FINE:  # white phase: differences share points at whole averages apart only
        middle, *others = _CENTRAL[d]
        shared = [max(0.0, 1 - k * stride / terms) * (w / middle) ** 2 for k, w in enumerate(others, start=1)]
        return terms / (1 + 2 * sum(shared))
    if stride > _FINE:  # the sum is smooth in its index: as many terms of a coarser grid give the same
        terms *= _FINE / stride
        stride = _FINE
    highest = int(min(terms, (d + 1) * stride))
    shape = _correlation(d, exponent, filtering, stride, highest)
    j = np.arange(1, highest)
    total = 1.0 + (1 - highest / terms) * shape[highest] + 2 * ((1 - j / terms) * shape[1:-1]).sum()
    return float(max(1.0, terms / total))


_CENTRAL = {2: (6, -4, 1), 3: (20, -15, 6, -1)}
"""Weights of the central difference of twice an order, from its middle on."""
_FINE = 100.0
"""Terms an averaging time beyond which the sums of Greenhall and Riley are taken as integrals."""


@lru_cache(maxsize=1024)
def _correlation(d: int, exponent: int, filtering: float, stride: float, highest: int) -> FloatArray:
    """Squared autocorrelation of the differences at 0 … `highest` terms of `stride` an averaging time."""

    def walk(t):  # s_w
        t = abs(t)
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithm = np.where(t > 0, np.log(np.where(t > 0, t, 1.0)), 0.0)
        power = exponent + (2 if filtering > _FINE else 0)
        forms = {
            2: -t,
            1: t**2 * logarithm,
            0: t**3,
            -1: -(t**4) * logarithm,
            -2: -(t**5),
            -3: t**6 * logarithm,
            -4: t**7,
        }
        return forms[power]

    def filtered(t):  # s_x
        if filtering > _FINE:
            return walk(t)
        return filtering**2 * (2 * walk(t) - walk(t - 1 / filtering) - walk(t + 1 / filtering))

    def differenced(t):  # s_z: the central difference of order 2d
        middle, *others = _CENTRAL[d]
        sides = (w * (filtered(t - k) + filtered(t + k)) for k, w in enumerate(others, start=1))
        return middle * filtered(t) + sum(sides)

    z = differenced(np.arange(highest + 1) / stride)
    return (z / z[0]) ** 2
