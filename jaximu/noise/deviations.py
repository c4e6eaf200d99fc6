"""Deviations of the Allan family in JAX, batched over axes and units, with confidence intervals.

Definitions and degrees of freedom: W. J. Riley, Handbook of Frequency Stability Analysis, NIST SP 1065 (2008); the
combined algorithm of C. A. Greenhall and W. J. Riley, Uncertainty of stability variances based on finite differences
(PTTI 2003). "Phase" is the integral of the signal: an angle for a gyroscope, a velocity for an accelerometer.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import chi2_isf
from jaximu.ground.equality import Comparable
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.precision import require_float64

__all__ = ["KINDS", "RESOLUTIONS", "Deviation", "averaging_factors", "degrees_of_freedom", "deviation"]

_LANES = 2048
"""Differences squared at once, each added to its own running sum: such a loop is vectorised, one sum is not."""
_UNROLLED = 4
"""Blocks of them a turn of the innermost loop."""
_SEGMENT = 1 << 16
"""Places of the first point of a difference that are gone through for all averaging times before the next ones: what
short averages need then stays in the processor's cache."""
_SERIES = 1 << 15
"""Samples integrated, or averages compared, at once in NumPy: fewer, and threads wait for the interpreter's lock."""
_GATHERED = 1 << 18
"""Phase points gathered at once to find the exponent of the noise."""
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
      `Deviation.tau` and `factor` hold those taken, once each. The square stays unbiased, and its variance grows by
      less than 0.13 % for white noise, 5/4 (1/k² − 1/m²) of k points and m samples an average (after SP 1065, table
      6), and by less than 0.01 % for flicker and random walk: their differences hardly change from one point to the
      next. White phase noise (quantisation, α > 0) does change: where it rules averages of 64 samples and more, take
      the full one.

    Memory beside the input is that of the phase of one row for each processor. Raises `InputError` for shapes, rates
    and factors that make no sense, `NotPossibleError` where the data is too short or gaps leave fewer than two
    differences.
    """
    require_float64()
    each = _kind(kind)
    if resolution not in RESOLUTIONS:
        raise InputError(f"the resolution must be one of {', '.join(RESOLUTIONS)}, found {resolution!r}.")
    multi = resolution == "multi"
    if multi and kind != "overlapping":
        raise InputError(f"the multi-resolution deviation is the overlapping Allan deviation, not the {kind} one.")
    data = np.asarray(values, float)
    if data.ndim < 1 or data.shape[-1] < 3:
        raise NotPossibleError(f"a deviation needs at least three samples, found shape {data.shape}.")
    if not (np.isfinite(rate) and rate > 0):
        raise InputError(f"the sample rate must be a positive number of Hz, found {rate}.")
    if not 0 < confidence < 1:
        raise InputError(f"the confidence must lie between 0 and 1, found {confidence}.")
    flat = data.reshape(-1, data.shape[-1])
    samples = data.shape[-1] - phase
    with ThreadPoolExecutor(_processors()) as pool:
        sums = np.array(list(pool.map(_sum, flat)))
        gaps = False
        if not np.isfinite(sums).all():  # of a row with a value that is not; a pass over all values less than isnan
            if np.isinf(flat).any():
                raise InputError("the signal holds infinite values.")
            gaps = bool(np.isnan(flat).any())
        if gaps and (each.total or phase):
            what = "the total deviation mirrors the recording at its ends" if each.total else "a phase is one curve"
            raise InputError(f"{what} and cannot be taken over gaps (NaN).")
        chosen = averaging_factors(samples, kind) if factors is None else np.unique(np.asarray(factors, np.int64))
        if not len(chosen) or chosen[0] < 1 or chosen[-1] > _longest(samples, kind):
            raise NotPossibleError(
                f"{samples} samples allow averaging over 1 to {_longest(samples, kind)} of them for the {kind} "
                f"deviation, asked were {np.asarray(factors).tolist()}."
            )
        grid = _grid(chosen, samples, each, multi)
        square, count, alpha = _mean_squares(flat, sums, grid, each, phase, gaps, exponent, pool)
    if (count < 2).any():
        row, column = np.argwhere(count < 2)[0]
        raise NotPossibleError(
            f"gaps leave fewer than two differences at an averaging time of {grid.factor[column] / rate:g} s "
            f"(axis {row})."
        )
    tau = grid.factor / rate
    # an integrated signal is summed here in samples, a given phase in seconds
    value = np.sqrt(square / (6 if each.order == 3 else 2)) / (tau if phase else grid.factor)
    freedom = np.zeros(value.shape)
    for a in np.unique(alpha):
        of_it = [
            _freedom(kind, samples + 1, int(m), int(a), int(k)) if any_of_it else 0.0
            for m, k, any_of_it in zip(grid.factor, grid.lag, (alpha == a).any(axis=0), strict=True)
        ]
        freedom = np.where(alpha == a, of_it, freedom)
    freedom *= np.minimum(1.0, count / np.maximum(1, grid.count))
    tail = (1 - confidence) / 2
    shape = (*data.shape[:-1], len(tau))
    distinct, place = np.unique(freedom, return_inverse=True)
    low, high = (np.sqrt(distinct / chi2_isf(p, distinct))[place] for p in (tail, 1 - tail))
    return Deviation(
        kind, tau, grid.factor, value.reshape(shape), (value * low.reshape(value.shape)).reshape(shape),
        (value * high.reshape(value.shape)).reshape(shape), count.reshape(shape), alpha.reshape(shape),
        freedom.reshape(shape), confidence,
    )  # fmt: skip


def _processors() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _sum(row: FloatArray) -> float:
    with np.errstate(over="ignore", invalid="ignore"):
        return float(row.sum())


@dataclass(frozen=True)
class _Grid:
    """What is summed for each averaging time (T,): `count` differences of points `lag` apart, from place `first` on.

    The points stand at every 1st, 2nd, 4th … phase point, one such level behind the other; `level` is that of each
    averaging time, `places` where each level begins and, last, how long they are together.
    """

    factor: NDArray[np.int64]
    lag: NDArray[np.int64]
    level: NDArray[np.int64]
    first: NDArray[np.int64]
    count: NDArray[np.int64]
    places: tuple[int, ...]


def _grid(factors: NDArray[np.int64], samples: int, kind: _DeviationKind, multi: bool) -> _Grid:
    if not multi:
        level = np.zeros_like(factors)
        length = 3 * samples - 1 if kind.total else samples + 1 + kind.modified
        # a mirrored phase begins samples − 1 points earlier; its differences are centred on the inner points
        first = samples - factors if kind.total else level
        return _Grid(factors, factors, level, first, _full_count(samples, factors, kind), (0, length))
    # the recording's own level at most: two averages and one point more of it
    highest = max(0, (samples // (2 * _FINEST + 1)).bit_length() - 1)
    level = np.array([min(max(0, (int(m) // _FINEST).bit_length() - 1), highest) for m in factors])
    step = 1 << level
    # to the nearest multiple that leaves two differences
    lag = np.minimum((factors + step // 2) // step, ((samples >> level) - 1) // 2)
    even = (lag == 2 * _FINEST) & (samples >> (level + 1) > 2 * _FINEST)  # a factor rounded up to the next level's
    lag, level = np.where(even, _FINEST, lag), level + even
    factor, kept = np.unique(lag << level, return_index=True)
    lag, level = lag[kept], level[kept]
    lengths = [(samples >> each) + 1 for each in range(int(level.max()) + 1)]
    places = np.concatenate([[0], np.cumsum(lengths)])
    count = np.array(lengths)[level] - 2 * lag
    return _Grid(factor, lag, level, places[level], count, tuple(map(int, places)))


def _full_count(samples: int, factors: NDArray[np.int64], kind: _DeviationKind) -> NDArray[np.int64]:
    """Differences there are without gaps."""
    if kind.total:
        return np.full(len(factors), samples - 1)
    span = (kind.order + kind.modified) * factors
    free = samples + 1 + kind.modified - span
    return free if kind.overlapping else (free - 1) // factors + 1


def _mean_squares(
    rows: FloatArray,
    sums: FloatArray,
    grid: _Grid,
    kind: _DeviationKind,
    phase: bool,
    gaps: bool,
    exponent: int | None,
    pool: ThreadPoolExecutor,
) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int64]]:
    """Mean square of the phase differences, how many there are, and the exponent of the noise, each (C, T)."""
    square = np.zeros((len(rows), len(grid.factor)))
    count = np.zeros(square.shape, np.int64)
    alpha = np.full(square.shape, 0 if exponent is None else exponent, np.int64)
    pieces = _pieces(grid) if kind.overlapping else []

    # As many rows at once as there are processors, so that few phases are held, in memory that is used again.
    together = min(_processors(), len(rows))
    length = grid.places[-1]
    rooms = [(_padded(length, np.float64), _padded(length, np.int32) if gaps else None) for _ in range(together)]

    def prepare(row: int) -> tuple[jax.Array, jax.Array | None] | None:
        points, spoiled, levels = _phase(rows[row], sums[row], grid, phase, gaps, *rooms[row % together])
        if exponent is None:
            alpha[row] = _exponents(levels, grid)
        if not kind.overlapping:
            square[row], count[row] = _strided(levels[0], spoiled, grid, kind)
            return None
        _transform(points, levels[0].size, kind)
        with jax.enable_x64(True):  # a thread does not see what its starter switched on for itself alone
            # read where they are, not copied: they are not written to any more
            return jax.device_put(points, may_alias=True), (
                None if spoiled is None else jax.device_put(spoiled, may_alias=True)
            )

    def add(job: tuple[tuple[jax.Array, jax.Array | None], _Piece]) -> tuple[FloatArray, NDArray[np.int64]]:
        (points, spoiled), piece = job
        number = len(piece.places)
        with jax.enable_x64(True):
            total, used = _sum_squares(points, spoiled, piece.table, number, kind.order + kind.modified)
        return np.asarray(total)[:number], piece.count if used is None else np.asarray(used)[:number]

    for start in range(0, len(rows), together):
        group = range(start, min(start + together, len(rows)))
        ready = [(row, each) for row, each in zip(group, pool.map(prepare, group), strict=True) if each is not None]
        jobs = [(row, each, piece) for row, each in ready for piece in pieces]
        for (row, _, piece), found in zip(jobs, pool.map(add, [job[1:] for job in jobs]), strict=True):
            square[row, piece.places] += found[0]
            count[row, piece.places] += found[1]
    square /= np.maximum(count, 1)
    return (square / grid.factor**2 if kind.modified else square), count, alpha


def _phase(
    row: FloatArray,
    total: float,
    grid: _Grid,
    phase: bool,
    gaps: bool,
    whole: FloatArray,
    spoiled: NDArray[np.int32] | None,
) -> tuple[FloatArray, NDArray[np.int32] | None, list[FloatArray]]:
    """The phase of a row in samples, at every level; what is missing before each point; the levels as views.

    The first two are written to the arrays given.
    """
    samples = len(row) - phase
    points = whole[: samples + 1]
    points[0] = 0.0
    if phase:
        points[:] = row
    else:
        lost = np.isnan(row) if gaps else None
        if lost is not None and spoiled is not None:
            spoiled[0] = 0
            np.cumsum(lost, out=spoiled[1 : samples + 1])
            total = float(np.sum(row, where=~lost))
        # about the mean, whose integral is a straight line that no difference sees: the sums stay small
        mean = total / max(1, samples if spoiled is None else samples - int(spoiled[samples]))
        for start in range(0, samples, _SERIES):  # in blocks that stay in the cache
            part = row[start : start + _SERIES] - mean
            if lost is not None:
                part[lost[start : start + _SERIES]] = 0.0
            part[0] += points[start]
            np.cumsum(part, out=points[start + 1 : start + 1 + len(part)])
    for array in (whole,) if spoiled is None else (whole, spoiled):
        for before, place, after in zip(grid.places[:-2], grid.places[1:-1], grid.places[2:], strict=True):
            array[place:after] = array[before:place:2]
        # a modified difference reaches one place over the end of the flags
        array[grid.places[-1] :] = 0
    if spoiled is not None and len(grid.places) == 2:
        spoiled[samples + 1 :] = spoiled[samples]
    starts = zip(grid.places[:-1], grid.places[1:], strict=True)
    levels = [whole[a:b] for a, b in starts] if len(grid.places) > 2 else [points]
    return whole, spoiled, levels


def _padded(length: int, kind: type) -> np.ndarray:
    """An array of zeros, at least a block longer: a length is compiled for once, and an eighth of an octave is one.

    It begins at a multiple of 64 bytes, so that JAX reads it where it is.
    """
    step = 1 << max(0, (length + _LANES).bit_length() - 4)
    size = -(-(length + _LANES) // step) * step
    room = np.zeros(size + 64, kind)
    skipped = -room.ctypes.data % 64 // room.itemsize
    return room[skipped : skipped + size]


def _transform(points: FloatArray, count: int, kind: _DeviationKind) -> None:
    """Make of `count` phase points, in place, those whose differences are the deviation's."""
    inner = points[:count]
    if kind.modified:  # a difference averaged over m places is one of the next order of the running sum, over m
        np.cumsum(inner - inner.mean(), out=points[1 : count + 1])
        points[0] = 0.0
    if kind.total:  # mirrored about both ends; differences are centred on every inner point
        inner, first, last = inner.copy(), inner[0], inner[-1]
        points[: count - 2] = 2 * first - inner[-2:0:-1]
        points[count - 2 : 2 * count - 2] = inner
        points[2 * count - 2 : 3 * count - 4] = 2 * last - inner[-2:0:-1]


def _strided(
    points: FloatArray, spoiled: NDArray[np.int32] | None, grid: _Grid, kind: _DeviationKind
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Sums (T,) of squared differences that do not overlap, of points (n + 1,), and their number."""
    square, count = np.zeros(len(grid.factor)), grid.count.copy()
    for place, m in enumerate(grid.factor):
        difference = np.diff(points[::m], n=kind.order)
        if spoiled is not None:
            lost = spoiled[: len(points) : m]
            difference = difference[lost[kind.order :] == lost[: -kind.order]]
            count[place] = len(difference)
        square[place] = difference @ difference
    return square, count


@dataclass(frozen=True)
class _Piece:
    """Differences that begin in one segment: of which averaging times, how many, and factor, first and last place."""

    places: NDArray[np.int64]
    count: NDArray[np.int64]
    table: NDArray[np.int64]


def _pieces(grid: _Grid) -> list[_Piece]:
    width = -(-len(grid.factor) // 32) * 32  # to compile for few numbers of averaging times
    found = []
    for start in range(0, int(np.max(grid.first + grid.count)), _SEGMENT):
        first = np.maximum(grid.first, start)
        last = np.minimum(grid.first + grid.count, start + _SEGMENT)
        places = np.flatnonzero(last > first)
        if len(places):
            table = np.zeros((3, width), np.int64)
            table[:, : len(places)] = grid.lag[places], first[places], last[places]
            found.append(_Piece(places, (last - first)[places], table))
    return found


def _lanes(array, place):
    return jax.lax.dynamic_slice(array, (place,), (_LANES,))


def _difference(points, place, m, order: int):
    """The differences (_LANES,) of an order, of points m apart, from a place on."""
    weights = [(-1.0) ** (order - k) * math.comb(order, k) for k in range(order + 1)]
    terms = [w * _lanes(points, place + k * m) for k, w in enumerate(weights)]
    return sum(terms[1:], start=terms[0])


@partial(jax.jit, static_argnames="order")
def _sum_squares(points, spoiled, table, number, order: int):
    """Sums (W,) of squared differences of an order of points (L,), and how many have no change of `spoiled` in them.

    table (3, W): factor, first and last place of the first `number` sums, the last one left out. All places of a sum
    are added up in lanes, so that the loop is one pass over contiguous memory.
    """

    def one(index, found):
        m, begin, end = table[0, index], table[1, index], table[2, index]

        def several(turn, lanes):
            for block in range(_UNROLLED):
                lanes = lanes + _difference(points, begin + (turn * _UNROLLED + block) * _LANES, m, order) ** 2
            return lanes

        def checked(block, carried):
            lanes, used = carried
            place = begin + block * _LANES
            good = place + jnp.arange(_LANES) < end
            if spoiled is not None:
                good &= _lanes(spoiled, place + order * m) == _lanes(spoiled, place)
                used = used + good
            return lanes + jnp.where(good, _difference(points, place, m, order) ** 2, 0.0), used

        full = 0 if spoiled is not None else (end - begin) // (_LANES * _UNROLLED)
        lanes = jax.lax.fori_loop(0, full, several, jnp.zeros(_LANES))
        used = None if spoiled is None else jnp.zeros(_LANES, jnp.int32)
        blocks = (end - begin + _LANES - 1) // _LANES
        lanes, used = jax.lax.fori_loop(full * _UNROLLED, blocks, checked, (lanes, used))
        totals, counts = found
        counts = None if used is None else counts.at[index].set(used.sum())
        return totals.at[index].set(lanes.sum()), counts

    nothing = jnp.zeros(table.shape[1]), None if spoiled is None else jnp.zeros(table.shape[1], jnp.int64)
    return jax.lax.fori_loop(0, number, one, nothing)


def _exponents(levels: Sequence[FloatArray], grid: _Grid) -> NDArray[np.int64]:
    """The exponent (T,) of the noise by its phase: means over each factor are differences of every so manieth point."""
    return _rule([levels[level][::k] for level, k in zip(grid.level, grid.lag, strict=True)])


def _rule(phases: Sequence[FloatArray]) -> NDArray[np.int64]:
    """Exponents from the phase at the ends of the averages, for ever longer ones."""
    # those with too few averages take the exponent of the one before
    own = np.array([place for place, ends in enumerate(phases) if len(ends) > 30 or place == 0])
    delta, order, left = np.zeros(len(own)), np.zeros(len(own), np.int64), np.arange(len(own))
    for differenced in range(3):
        correlation = _lag_one([phases[own[each]] for each in left], 1 + differenced)
        usable = correlation > -1
        delta[left] = np.where(usable, correlation / np.where(usable, 1 + correlation, 1.0), -10.0)
        order[left] = differenced
        lengths = np.array([len(phases[own[each]]) for each in left])
        left = left[(delta[left] >= 0.25) & (lengths - 1 - differenced >= 4)]
        if not len(left):
            break
    alpha = np.clip(np.round(-2 * (delta + order)), -4, 2).astype(np.int64)
    return alpha[np.searchsorted(own, np.arange(len(phases)), side="right") - 1]


def _lag_one(phases: Sequence[FloatArray], order: int) -> FloatArray:
    """Lag-1 autocorrelations (K,) of the differences of an order, about their mean, of some points each."""
    # The points are gathered in one small array after the other: it stays in the cache, and is compiled for once.
    room = _padded(_GATHERED, np.float64)
    sums = np.zeros((2, len(phases)))
    table, means, owner, filled = np.zeros((3, 64), np.int64), np.zeros(64), [], 0

    def add() -> None:
        with jax.enable_x64(True):
            points = jax.device_put(room, may_alias=True)
            found = np.asarray(_sum_products(points, table, means, len(owner), order))
        np.add.at(sums.T, owner, found[:, : len(owner)].T)

    for each, ends in enumerate(phases):
        length = len(ends) - order
        weights = [(-1.0) ** (order - 1 - k) * math.comb(order - 1, k) for k in range(order)]
        mean = sum(w * float(ends[length + k] - ends[k]) for k, w in enumerate(weights)) / length
        for start in range(0, length, _GATHERED - 8):
            # with one difference more than are squared here, to go with the last of them
            part = ends[start : min(start + _GATHERED - 8, length) + order + 1]
            if filled + len(part) > _GATHERED or len(owner) == len(means):
                add()
                owner, filled = [], 0
            table[:, len(owner)] = filled, min(_GATHERED - 8, length - start), len(part) - order - 1
            means[len(owner)] = mean
            room[filled : filled + len(part)] = part
            owner.append(each)
            filled += len(part)
    add()
    return np.divide(sums[1], sums[0], out=np.zeros(len(phases)), where=sums[0] > 0)


@partial(jax.jit, static_argnames="order")
def _sum_products(points, table, means, number, order: int):
    """Sums (2, W): squares of differences of an order, less their mean, and products of neighbours.

    table (3, W): first place, number of squares, and number of products of the first `number` sums.
    """

    def one(index, found):
        begin, squares, products = table[0, index], table[1, index], table[2, index]

        def series(place):
            return _difference(points, place, 1, order) - means[index]

        def several(turn, lanes):
            power, product = lanes
            for block in range(_UNROLLED):
                place = begin + (turn * _UNROLLED + block) * _LANES
                here = series(place)
                power, product = power + here**2, product + here * series(place + 1)
            return power, product

        def checked(block, lanes):
            power, product = lanes
            at = block * _LANES + jnp.arange(_LANES)
            here, after = series(begin + block * _LANES), series(begin + block * _LANES + 1)
            return power + jnp.where(at < squares, here**2, 0), product + jnp.where(at < products, here * after, 0)

        full = products // (_LANES * _UNROLLED)
        lanes = jax.lax.fori_loop(0, full, several, (jnp.zeros(_LANES), jnp.zeros(_LANES)))
        blocks = (squares + _LANES - 1) // _LANES
        power, product = jax.lax.fori_loop(full * _UNROLLED, blocks, checked, lanes)
        return found.at[:, index].set(jnp.stack([power.sum(), product.sum()]))

    return jax.lax.fori_loop(0, number, one, jnp.zeros(table[:2].shape))


def degrees_of_freedom(kind: str, points: int, factor: int, exponent: int) -> float:
    """Return the equivalent degrees of freedom of a deviation of `points` phase points (Greenhall and Riley 2003).

    `exponent` is α of S(f) ∝ f^α. The total deviation has those of SP 1065, table 7, for white, flicker and random walk
    noise; for short averages, where the mirrored ends add nothing, and for other noise those of the overlapping one.
    """
    return _freedom(kind, points, factor, exponent, factor)


def _freedom(kind: str, points: int, factor: int, exponent: int, lag: int) -> float:
    """The same with only `lag` differences an averaging time, evenly spaced; as many as samples where they overlap."""
    each = _kind(kind)
    if each.total and factor >= 8 and exponent <= 0:
        slope, offset = {0: (1.50, 0.0), -1: (1.17, 0.22), -2: (0.93, 0.36)}[max(exponent, -2)]
        return max(1.0, slope * (points - 1) / factor - offset)
    d = each.order
    exponent = max(exponent, 1 - 2 * d + 1)  # differences of this order need α + 2d > 1
    # The phase here is the integral itself, not a mean of it over a sample, which the algorithm takes to bound the
    # power of white and flicker phase; it matters for averages of few samples only.
    averaged = each.modified and factor > 1
    filtering = 1.0 if averaged else (np.inf if exponent <= 0 or factor > _FINE else float(factor))
    stride = float(lag) if each.overlapping else 1.0
    length = (factor if averaged else 1) + factor * d  # phase points that one difference spans
    terms = 1 + np.floor(stride * (points - length) / factor)
    terms = max(terms, 1.0)
    if stride > _FINE:  # the sum is smooth in its index: as many terms of a coarser grid give the same
        terms, stride = terms * _FINE / stride, _FINE
    highest = int(min(terms, (d + 1) * stride))
    shape = _correlation(d, exponent, filtering, stride, highest)
    if shape is None:
        return terms
    j = np.arange(1, highest)
    total = 1.0 + (1 - highest / terms) * shape[highest] + 2 * np.sum((1 - j / terms) * shape[1:-1])
    return float(max(1.0, terms / total))


_FINE = 100.0
"""Terms an averaging time beyond which the sums of Greenhall and Riley are taken as integrals."""


@lru_cache(maxsize=1024)
def _correlation(d: int, exponent: int, filtering: float, stride: float, highest: int) -> FloatArray | None:
    """Squared autocorrelation of the differences at 0 … `highest` terms of `stride` an averaging time."""

    def walk(t):  # s_w
        t = np.abs(t)
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithm = np.where(t > 0, np.log(np.where(t > 0, t, 1.0)), 0.0)
        power = exponent + (2 if filtering > _FINE else 0)
        forms = {4: t**0 * 0, 3: t * 0, 2: -t, 1: t**2 * logarithm, 0: t**3, -1: -(t**4) * logarithm, -2: -(t**5),
                 -3: t**6 * logarithm, -4: t**7}  # fmt: skip
        return forms[power]

    def filtered(t):  # s_x
        if filtering > _FINE:
            return walk(t)
        return filtering**2 * (2 * walk(t) - walk(t - 1 / filtering) - walk(t + 1 / filtering))

    def differenced(t):  # s_z: the central difference of order 2d
        weights = {2: (6, -4, 1), 3: (20, -15, 6, -1)}[d]
        sides = (w * (filtered(t - k) + filtered(t + k)) for k, w in enumerate(weights[1:], start=1))
        return weights[0] * filtered(t) + sum(sides)

    z = differenced(np.arange(highest + 1) / stride)
    return None if z[0] == 0 else (z / z[0]) ** 2
