"""How the gyroscope explains what the accelerometer sees turn: axes, signs, scales and clocks of the two.

While a unit is turned by hand the specific force is mostly gravity, which turns in the body against the unit's
rotation: Δf = f × M Δθ over a short time, Δθ the angle that the gyroscope reads and M Δθ the true one. That is linear
in M, which is the identity for right axes, signs and scales.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise, permutations, product
from typing import Any, NamedTuple

import numpy as np
import scipy

from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.ground.differences import interpolated, midpoints
from jaximu.ground.distributions import student_isf
from jaximu.ground.vectors import dot_rows, lengths_of

_BLOCK = 0.2
"""Seconds over which the specific force is averaged."""
_MOVED = 0.03
"""Share of gravity by which the magnitude may be off before a block counts for less: the unit is accelerated."""
_FAR = 0.3
"""rad between blocks beyond which they count for less: the equation is one of small angles."""
_FEWEST = 20
_LAGS = np.arange(-8.0, 8.05, 0.1)  # s
_STEPS = (0.06, 0.03, 0.03, 0.02, 0.02)
"""Seconds to either side over which the turning is differentiated by the lag, pass by pass."""
_PARTS = 12
"""Parts of a recording from whose scatter the uncertainty of a time offset is taken."""
CORRELATED = 0.6
"""Correlation from which on the gyroscope turns as gravity does in the accelerometer."""
_WELL = 0.8
"""Share of the turning that the gyroscope must explain for its stamps to be sought close to where they are."""


_SHEARS = [np.diag([1.0, -1.0, 0.0]), np.diag([0.0, 1.0, -1.0])]
"""A basis (5, 3, 3) of the symmetric matrices without a common scale."""
_SHEARS += [np.eye(3)[[a]].T @ np.eye(3)[[b]] + np.eye(3)[[b]].T @ np.eye(3)[[a]] for a, b in ((0, 1), (0, 2), (1, 2))]


EXPLAINED = 0.5
"""Share of the turning of gravity that a gyroscope must explain for anything to be judged by it."""
_KNOWN = 0.2
"""Standard deviation, of an entry, beyond which the gyroscope's matrix against gravity is not used."""


class Turning(NamedTuple):
    """matrix (3, 3): M, and sigma (3, 3) the standard deviation of each entry. explained: share of the force's turning.

    slope: of M = slope · 1, and correlation: of the force's turning with the gyroscope's, for such an M.
    """

    matrix: FloatArray
    sigma: FloatArray
    explained: float
    slope: float
    correlation: float

    @property
    def clear(self) -> bool:
        """Whether the recording determines how the two sensors' axes lie to each other."""
        return self.explained >= EXPLAINED and float(np.max(self.sigma)) < _KNOWN


def signed_permutation(matrix: FloatArray) -> FloatArray:
    """Return the signed permutation (3, 3) that is nearest to a matrix whose columns may have any length."""
    orders = np.array([*permutations(range(3))])
    entries = _directions(matrix.T).T[orders, range(3)]
    total = np.abs(entries).sum(axis=1)
    best, nearest = (total > total.max() - 1e-12).argmax(), np.zeros((3, 3))
    nearest[orders[best], range(3)] = np.where(entries[best] < 0, -1.0, 1.0)
    return nearest


def turning_best(products: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) R with the largest trace of Rᵀ products: of Σ a bᵀ, the one that turns b into a best.

    G. Wahba, SIAM Review 7 (1965); F. L. Markley, J. Astronaut. Sci. 36 (1988), by singular values.
    """
    u, _, v = np.linalg.svd(products)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v


def rotation_of(matrix: FloatArray) -> FloatArray:
    """Return the orthogonal matrix (3, 3) nearest to one whose columns may have any length."""
    u, _, v = np.linalg.svd(_directions(matrix.T).T)
    return u @ v


def angle_of(rotation: FloatArray) -> float:
    """Return the angle (rad) of a rotation (3, 3)."""
    return float(np.arccos(np.clip((rotation.trace() - 1) / 2, -1.0, 1.0)))


def turned_between(time: FloatArray, rate: FloatArray) -> FloatArray:
    """Return the angle (m - 1, 3) by which rates (m, 3) turn from each stamp to the next, by the trapezoid."""
    return midpoints(rate) * np.diff(time)[:, None]


class BlockMeans(NamedTuple):
    """Means over n + 1 blocks of the specific force, and the angle (m, 3) that the gyroscope has turned by `time` (m,).

    centre: (n + 1,), of the blocks, s. Of n neighbours, force: their mean (n, 3); change: from one to the next (n, 3);
    weight (n,): less where the unit is accelerated or turns far.
    """

    centre: FloatArray
    force: FloatArray
    change: FloatArray
    weight: FloatArray
    time: FloatArray
    angle: FloatArray

    def turned(self, delay: FloatArray | float = 0.0) -> FloatArray:
        """Return the gyroscope's angle (n, 3) from each block to the next, its stamps (n + 1,) `delay` s late."""
        return np.diff(interpolated(self.time, self.angle, self.centre + delay), axis=0)


def gravity_turning(
    force_time: FloatArray, force: FloatArray, rate_time: FloatArray, rate: FloatArray
) -> BlockMeans | None:
    """Return how the specific force (n, 3) turns in blocks, beside the rate (m, 3); None in a short recording."""
    if min(len(force), len(rate)) < 2:
        return None
    span = max(1, round(_BLOCK / np.median(np.diff(force_time))))
    count = len(force) // span
    if count < _FEWEST:
        return None
    mean = force[: count * span].reshape(count, span, 3).mean(axis=1)
    centre = force_time[: count * span].reshape(count, span).mean(axis=1)
    rate = rate - np.median(rate, axis=0)
    angle = np.cumulative_sum(turned_between(rate_time, rate), axis=0, include_initial=True)
    length = lengths_of(mean)
    usual = np.median(length)
    off = np.abs(length - usual) / max(usual, 1e-300)
    off = np.maximum(off[1:], off[:-1])
    change = np.diff(mean, axis=0)
    # by the accelerometer: what the gyroscope says may be wrong by any factor
    far = lengths_of(change) / max(usual, 1e-300)
    weight = 1 / np.sqrt((1 + (off / _MOVED) ** 2) * (1 + (far / _FAR) ** 2))
    # across a gap nobody knows what the unit did
    apart, step = np.diff(centre), np.diff(rate_time)
    weight[apart > 2 * np.median(apart)] = 0.0
    for gap in np.flatnonzero(step > max(_BLOCK, 2.5 * np.median(step))):
        first, last = centre.searchsorted(rate_time[gap : gap + 2])
        weight[max(first - 1, 0) : last] = 0.0
    return BlockMeans(centre, midpoints(mean), change, weight, rate_time, angle)


_TURNED = 0.1
"""Share of its length by which the specific force must change for clocks to be compared."""


def turning(force_time: FloatArray, force: FloatArray, rate_time: FloatArray, rate: FloatArray) -> Turning:
    """Fit how the rate (m, 3) explains the turning of the specific force (n, 3), in whatever units they are.

    A recording that hardly turns has the identity, infinite `sigma` and nothing explained.
    """
    blocks = gravity_turning(force_time, force, rate_time, rate)
    nothing = Turning(np.eye(3), np.full((3, 3), np.inf), 0.0, 1.0, 0.0)
    if blocks is None:
        return nothing
    changes = (blocks.weight[:, None] * blocks.change).ravel()
    columns = _columns(_levers(blocks), blocks.turned())
    alike = columns @ np.eye(3).ravel()
    power, product = float(alike @ alike), float(alike @ changes)
    total = float(changes @ changes)
    if power == 0.0 or total == 0.0:
        return nothing
    values, vectors = np.linalg.eigh(columns.T @ columns)
    kept = values > 1e-6 * values[-1]
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    matrix = inverse @ (columns.T @ changes)
    left = ((changes - columns @ matrix) ** 2).sum()
    variance = np.where(kept.all(), np.diag(inverse), np.inf) * left / max(len(changes) - 9, 1)
    return Turning(
        matrix.reshape(3, 3),
        np.sqrt(variance).reshape(3, 3),
        1 - left / total,
        product / power,
        product / np.sqrt(power * total),
    )


_CARRIED = 2.0
"""Seconds over which the specific force is carried by the rates."""
_WINDOWS = 300
_CLEAR = 10
"""Windows that must turn before a sense of rotation is claimed."""


def turns_backwards(force_time: FloatArray, force: FloatArray, rate_time: FloatArray, rate: FloatArray) -> bool:
    """Whether the rates explain the specific force (n, 3) clearly better with the opposite sense than as they are.

    Carried back to where a window of two seconds began, the force of a unit that is moved about scatters about gravity
    by its accelerations alone if the rates are right. Both senses are compared window by window, so that accelerations
    (a walk's, a foot's) speak for neither; nine windows of ten must speak for the opposite, and by a factor.
    """
    from scipy.spatial.transform import Rotation

    span = max(2, round(_CARRIED / np.median(np.diff(force_time))))
    starts = np.arange(0, len(force) - span + 1, span)
    starts = starts[:: max(1, len(starts) // _WINDOWS)]
    if len(starts) < _CLEAR:
        return False
    rows = starts[:, None] + np.arange(span)
    turn = interpolated(rate_time, rate - np.median(rate, axis=0), force_time[rows])
    steps = turn * np.gradient(force_time)[rows][:, :, None]
    turning = lengths_of(steps).sum(axis=1) > 0.5
    if turning.sum() < _CLEAR:
        return False
    rows, steps = rows[turning], steps[turning]
    scatter = []
    for sense in (1.0, -1.0):
        attitude, carried = Rotation.identity(len(rows)), np.empty((*rows.shape, 3))
        for at in range(span):
            carried[:, at] = attitude.apply(force[rows[:, at]])
            attitude = attitude * Rotation.from_rotvec(sense * steps[:, at])
        scatter.append(np.var(carried, axis=1).sum(axis=1))
    better = np.log(scatter[0] / np.maximum(scatter[1], 1e-300))
    return bool((better > 0).mean() > 0.9 and np.median(better) > np.log(1.5))


_TURN_SECONDS, _TURN_STEPS, _MOST = 10.0, 128, 24
"""Longest turn from rest to rest, s, the steps in which its rotation is put together, and turns that are enough."""
TURN_ANGLE = np.radians(20)
"""Angle by which gravity must turn from rest to rest to show anything."""
_JUMP = 0.15
"""Share of the way from one rest's gravity to the next's that may lie before and behind a jump."""
_FACTORS = 1.15 ** np.arange(-30, 31)
"""Factors by which rates as read may have to be multiplied."""
ARRANGEMENTS = np.stack(
    [
        np.array(signs)[:, None] * np.eye(3)[list(order)]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
)
ARRANGEMENTS = ARRANGEMENTS[np.linalg.det(ARRANGEMENTS) > 0]
"""The rotations (24, 3, 3) that exchange axes and turn them round; the first turns nothing."""
_MOST_TURNS, _ROUGH_ANGLE = 0.75, np.radians(3)
"""Share of the turns whose error counts; difference of such errors that distinguishes nothing."""


class Carried(NamedTuple):
    """How gravity is carried from rest to rest by the gyroscope in its likeliest arrangement and scale.

    factor: by which its rates must be multiplied, negative where its sense is the opposite one. error: what three of
    four turns stay below, rad. turns: how many there are.
    """

    factor: float
    error: float
    turns: int


def carried(
    force_time: FloatArray, force: FloatArray, rate_time: FloatArray, rate: FloatArray, rests: FloatArray
) -> Carried:
    """Carry the specific force (n, 3) of each rest, of `rests` (k, 2) s, to the next one by the rates (m, 3) between.

    What accelerates the unit on the way does not matter, nor how fast it turned. Turns that the gyroscope lacks samples
    of, that take long or in which gravity hardly turns are left out, as are those in which gravity jumps.
    """
    from scipy.spatial.transform import Rotation

    edges = force_time.searchsorted(rests)
    up = _directions(of_each(np.mean, force, edges))
    interval = np.diff(rate_time)
    gap = 2.5 * np.median(interval)
    middle = rests.mean(axis=1)
    whole = [
        stop - start < _TURN_SECONDS
        and rate_time[0] <= a
        and b <= rate_time[-1]
        and interval[slice(*rate_time.searchsorted((start, stop)))].max(initial=0.0) < gap
        for (_, start), (stop, _), a, b in zip(rests, rests[1:], middle, middle[1:], strict=False)
    ]
    turned = dot_rows(up[1:], up[:-1]) < np.cos(TURN_ANGLE)
    kept = [
        not _jumps(force[stop:start], *up[[at, at + 1]]) for at, ((_, stop), (start, _)) in enumerate(pairwise(edges))
    ]
    used = np.flatnonzero(np.array(whole, bool) & turned & np.array(kept, bool))
    used = used[:: -(-len(used) // _MOST) or 1]
    if not len(used):
        return Carried(1.0, np.pi, 0)
    at_rest = np.concatenate([rate[a:b] for a, b in rate_time.searchsorted(rests)])
    rate = rate - np.median(at_rest, axis=0) if len(at_rest) else rate
    angle = np.cumulative_sum(turned_between(rate_time, rate), axis=0, include_initial=True)
    passed = interpolated(rate_time, angle, np.linspace(middle[used], middle[used + 1], _TURN_STEPS + 1))
    steps = passed[1:] - passed[:-1]
    factors = np.concatenate([_FACTORS, -_FACTORS])
    turns = Rotation.from_rotvec((factors[:, None, None, None] * steps).reshape(-1, 3)).as_matrix()
    turns = turns.reshape(len(factors), -1, len(used), 3, 3)
    while turns.shape[1] > 1:
        turns = turns[:, ::2] @ turns[:, 1::2]
    back = turns[:, 0]
    # f' = Q Rᵀ Qᵀ f, with Q from the gyroscope's axes to the accelerometer's
    before, after = (np.einsum("qji,tj->qti", ARRANGEMENTS, part) for part in (up[used], up[used + 1]))
    cosine = np.einsum("qti,stji,qtj->sqt", after, back, before)
    error = np.quantile(np.arccos(cosine.clip(-1.0, 1.0)), _MOST_TURNS, axis=2)
    # of factors that do as well the one nearest to none
    best = error.min(axis=1)
    alike = np.flatnonzero(best < best.min() + _ROUGH_ANGLE)
    factor = factors[alike[(np.abs(np.log(np.abs(factors[alike]))) + 1e-9 * best[alike]).argmin()]]
    return Carried(float(factor), float(best.min()), len(used))


def of_each(statistic: Callable[..., Any], values: FloatArray, edges: IntArray) -> FloatArray:
    """Return a statistic, of NumPy's signature, of the rows of values (n, m) in each of k stretches: (k, m).

    edges: (k, 2) the first row of each stretch and the one after its last; an empty one has one row.
    """
    return np.stack([statistic(values[first : max(last, first + 1)], axis=0) for first, last in edges])


def _directions(vectors: FloatArray) -> FloatArray:
    """Vectors (n, 3) scaled to length one; one of no length stays."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)


def _jumps(force: FloatArray, before: FloatArray, after: FloatArray) -> bool:
    """Whether gravity jumps from one direction (3,) to another within a step of the force (n, 3): rows were cut out."""
    up = _directions(force)
    near = _JUMP * np.linalg.norm(after - before)
    left, reached = (lengths_of(up - direction) < near for direction in (before, after))
    return bool(np.any(left[:-1] & reached[1:]))


def _levers(blocks: BlockMeans) -> FloatArray:
    """The weighted f × e_k (n, 3, 3), k the last index."""
    return np.cross((blocks.weight[:, None] * blocks.force)[:, None], np.eye(3)).swapaxes(1, 2)


def _accelerometer_columns(blocks: BlockMeans, rate: FloatArray) -> FloatArray:
    """The derivatives (3 n, 8) of the weighted change of force, turned by (n, 3), by the accelerometer's errors.

    For f = K g + b with K = 1 + S and a symmetric S, the change is f × θ + S (f × θ) − (S f) × θ − b × θ to first
    order. An S of one size on all axes changes nothing, and a turned one is a turned gyroscope.
    """
    turned = np.cross(blocks.force, rate)
    shears = [turned @ shear - np.cross(blocks.force @ shear, rate) for shear in _SHEARS]
    biases = [np.cross(axis, rate) for axis in np.eye(3)]
    return (blocks.weight[:, None, None] * np.stack([*shears, *biases], axis=2)).reshape(-1, 8)


def _columns(levers: FloatArray, turned: FloatArray) -> FloatArray:
    """The derivatives (3 n, 9) of the weighted f × M Δθ by the entries of M."""
    return (levers[..., None] * turned[:, None, None]).reshape(-1, 9)


class Clocks(NamedTuple):
    """The gyroscope's stamps against the accelerometer's: late by offset + drift · (t − middle) at its time t, s.

    sigma: of the offset; drift_sigma: of the drift (s/s). explained: as in `Turning`, with these stamps.
    """

    offset: float
    sigma: float
    drift: float
    drift_sigma: float
    middle: float
    explained: float

    def late(self, time: FloatArray) -> FloatArray:
        """Return by how much (s) stamps (n,) of the gyroscope are late."""
        return (self.offset + self.drift * (time - self.middle)) / (1 + self.drift)


def clocks(force_time: FloatArray, force: FloatArray, rate_time: FloatArray, rate: FloatArray) -> Clocks | None:
    """Estimate by how much the gyroscope's stamps are late, as a straight line; None where nothing turns.

    Each part of the recording has the lag at which the gyroscope explains its turning best, beside errors of the
    accelerometer's gain and bias. Deviations are taken from the scatter of the parts about the line, and are of 95 %
    intervals by Student over 1.96.
    """
    blocks = gravity_turning(force_time, force, rate_time, rate)
    if blocks is None or len(blocks.change) < 6 * _FEWEST:
        return None
    off = lengths_of(blocks.force - np.median(blocks.force, axis=0))
    if np.quantile(off, 0.99) < _TURNED * np.median(lengths_of(blocks.force)):
        return None
    middle = blocks.centre.mean()
    edges = np.linspace(0, len(blocks.change), min(_PARTS, len(blocks.change) // (2 * _FEWEST)) + 1).astype(int)
    places = np.array([blocks.centre[a:b].mean() for a, b in pairwise(edges)]) - middle
    changes, levers = blocks.weight[:, None] * blocks.change, _levers(blocks)

    line, power = _rough_line(blocks, levers, changes, edges, places), (changes**2).sum()
    for step in _STEPS:
        lag = line[0] + line[1] * (blocks.centre - middle)
        turned = blocks.turned(lag)
        columns = _columns(levers, turned)
        matrix = np.asarray(np.linalg.lstsq(columns, changes.ravel(), rcond=1e-6)[0], float)
        # where the rate hardly changes, errors of the accelerometer would pass for lags
        columns = np.hstack([columns, _accelerometer_columns(blocks, turned @ matrix.reshape(3, 3).T)])
        rest = changes.ravel() - columns @ np.linalg.lstsq(columns, changes.ravel(), rcond=1e-6)[0]
        by_lag = _columns(levers, (blocks.turned(lag + step) - blocks.turned(lag - step)) / (2 * step)) @ matrix
        information, slope = (np.add.reduceat(by_lag * part, 3 * edges[:-1]) for part in (by_lag, rest))
        shifts = (slope / np.maximum(information, 1e-300)).clip(-2 * step, 2 * step)
        good = information > 1e-3 * information.max()
        if good.sum() < 3:
            return None
        design = np.stack([np.ones(int(good.sum())), places[good]], axis=1)
        # turns that are accelerated much err by more than the noise lets them: no part counts for more than twice
        weight = np.minimum(information[good], 2 * np.median(information[good]))
        inverse = np.linalg.inv((design * weight[:, None]).T @ design)
        change = inverse @ (design.T @ (weight * shifts[good]))
        missed = shifts[good] - design @ change
        line = line + change
    freedom = int(good.sum()) - 2
    spread = (weight * missed**2).sum() / freedom
    # parts that agree by chance are no surer than the noise of their samples lets them be
    spread = max(spread * float(student_isf(0.025, freedom) / 1.96) ** 2, (rest**2).mean())
    sigma, drift_sigma = np.sqrt(spread * np.diag(inverse))
    columns = _columns(levers, blocks.turned(line[0] + line[1] * (blocks.centre - middle)))
    explained = 1 - float(_left(columns.T @ columns, columns.T @ changes.ravel(), power)) / max(power, 1e-300)
    return Clocks(float(line[0]), max(float(sigma), 1e-4), float(line[1]), float(drift_sigma), middle, explained)


def _rough_line(
    blocks: BlockMeans, levers: FloatArray, changes: FloatArray, edges: IntArray, places: FloatArray
) -> FloatArray:
    """Return the lag at the middle (s) and by time: none, one of a grid, or a robust line, whichever explains enough.

    levers (n, 3, 3) and changes (n, 3) of the blocks, weighted; edges: of the parts, by block; places: their times, s
    from the middle.
    """

    def sums(lag: float) -> tuple[FloatArray, FloatArray]:
        """Return the normal matrix (P, 9, 9) and vector (P, 9) of each part."""
        columns = _columns(levers, blocks.turned(lag)).reshape(-1, 3, 9)
        both = columns.swapaxes(1, 2) @ np.concatenate([columns, changes[:, :, None]], axis=2)
        both = np.add.reduceat(both, edges[:-1])
        return both[..., :9], both[..., 9]

    line = np.zeros(2)
    power = np.add.reduceat((changes**2).sum(axis=1), edges[:-1])
    enough = (1 - _WELL) * power.sum()
    normal, product = sums(0.0)
    if _left(normal.sum(axis=0), product.sum(axis=0), power.sum()) <= enough:
        return line
    normal, product = (np.array(sums_at_lags) for sums_at_lags in zip(*map(sums, _LAGS), strict=True))
    common = _left(normal.sum(axis=1), product.sum(axis=1), power.sum())
    line[0] = _LAGS[np.argmin(common)]
    if min(common) > enough:
        residuals = _left(normal, product, power)
        best = np.argmin(residuals, axis=0)
        trusted = residuals.min(axis=0) < (1 - _WELL) * power
        if trusted.sum() >= 3:
            robust = scipy.stats.theilslopes(_LAGS[best[trusted]], places[trusted], method="joint")
            line = np.array([robust.intercept, robust.slope])
    return line


def _left(normal: FloatArray, product: FloatArray, power: FloatArray | float) -> FloatArray:
    """Return what the best matrix leaves of the sums of squares `power` (...)."""
    inverse = np.linalg.pinv(normal, rcond=1e-12, hermitian=True)
    return power - np.einsum("...i,...ij,...j->...", product, inverse, product)
