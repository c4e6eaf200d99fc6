"""The compiled part of a fleet's fit: Gauss–Newton passes for many units side by side.

The problem is that of `jaximu.data.joint` with the weights of `jaximu.data.poses_covariance`, in a form whose cost does
not grow with the square of the poses: the conditions in order of time, (norm of pose k, two components of turn k), have
a block tridiagonal covariance, because only neighbouring turns share a pose. Its Cholesky factor is two recursions over
the poses; a third gives those blocks of the inverse that the excess asks for (Takahashi's recursion; Erisman and
Tinney, Communications of the ACM 18, 1975).

A pass weights and linearises at z, makes one step, and improves the excess. The first pass integrates turns by blocks
of samples with their derivatives, the second by blocks, the third once more with derivatives and sample by sample.
Those that follow touch no sample: they move the rotations of the third to first order, and only where a turn has moved
by more than a milliradian is its unit integrated anew. What is left of the residual is then exact, and slopes a few
ten-thousandths off move the answer by less than a thousandth of its standard deviation. A unit that stands still is
left alone, so no unit's result depends on its neighbours.

Arrays have the units as their last axis: every operation is on whole rows of them.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular

from jaximu.data.carried import (
    Carried,
    Matrix,
    Vector,
    carry,
    compress,
    cross,
    matmul,
    matvec,
    moved,
    rotate_samples,
    rotate_through,
    rotation_rows,
    transpose,
)
from jaximu.data.poses import COARSE_EXCESS
from jaximu.estimation.problem import TOLERANCE, Parameters
from jaximu.ground.array_types import Array
from jaximu.recordings.observations import Observations

__all__ = ["Lanes", "fit_lanes"]

_EXACT = 2  # the pass from which on rotations are those of all samples
_FAR = 1e-3  # rad that a turn may move by its slopes: what is left out is a millionth
_SHARE = (0.3, 1.0)
"""Of the change of an excess that is taken, by the secant through two passes: scoring alone may jump to and fro."""
_STILL = 0.1
"""Standard deviations: a step below it is the last. Slopes and weights change by some 1e-5 along it, and what it leaves
is that share of it."""
_SETTLED = 0.03  # change of one plus the excess


class Lanes(NamedTuple):
    """What a fit ends with, the units first; z, covariance and reach of gravity in typical sizes."""

    z: Array
    covariance: Array
    gravity: Array  # the parameters' reaction to gravity, per m/s²
    information: Array  # JᵀJ
    excess: Array
    rms: Array  # of the norm of gravity (m/s²), of carried gravity (degrees), of the rate at rest (rad/s)
    passes: Array
    converged: Array
    finite: Array


class _Seen(NamedTuple):
    """Observations by component, units last. P poses, T = P − 1 turns; see `jaximu.recordings.observations`."""

    mean_a: Vector
    covariance_a: Matrix
    mean_g: Vector
    covariance_g: Matrix
    pose: Array  # 1 for a pose, 0 for padding
    turn: Array
    basis: Matrix
    noise: Matrix
    gravity: Array


def _components(array: Array, axes: int):
    """Split the last `axes` axes (3 each, or 2) off as lists; what is left has the units last."""
    array = jnp.moveaxis(array, 0, -1)
    if axes == 1:
        return [array[..., i, :] for i in range(array.shape[-2])]
    return [[array[..., i, j, :] for j in range(array.shape[-2])] for i in range(array.shape[-3])]


def _seen(batch: Observations) -> _Seen:
    poses, turns = batch.poses, batch.turns
    return _Seen(
        _components(poses.accelerometer_mean, 1), _components(poses.accelerometer_covariance, 2),
        _components(poses.gyroscope_mean, 1), _components(poses.gyroscope_covariance, 2),
        poses.mask.T.astype(float), turns.mask.T.astype(float), _components(turns.basis, 2),
        _components(turns.noise, 2), batch.gravity,
    )  # fmt: skip


def _mean(matrix: Matrix, mask: Array) -> Matrix:
    """Mean over the first axis of what is not padding."""
    count = jnp.maximum(jnp.sum(mask, axis=0), 1.0)
    return [[jnp.sum(mask * each, axis=0) / count for each in row] for row in matrix]


def _plus(first: Matrix, second: Matrix) -> Matrix:
    return [[a + b for a, b in zip(*rows, strict=True)] for rows in zip(first, second, strict=True)]


def _scaled(factor: Array, matrix: Matrix) -> Matrix:
    return [[factor * each for each in row] for row in matrix]


def _trace(first: Matrix, second: Matrix) -> Array:
    """Trace of ABᵀ."""
    return sum(a * b for rows in zip(first, second, strict=True) for a, b in zip(*rows, strict=True))  # pyright: ignore[reportReturnType]


def _cholesky(matrix: Matrix) -> Matrix:
    """Lower factor of a 3×3 matrix, zeros above the diagonal."""
    a = jnp.sqrt(matrix[0][0])
    b, d = matrix[1][0] / a, matrix[2][0] / a
    c = jnp.sqrt(matrix[1][1] - b * b)
    e = (matrix[2][1] - d * b) / c
    zero = jnp.zeros_like(a)
    return [[a, zero, zero], [b, c, zero], [d, e, jnp.sqrt(matrix[2][2] - d * d - e * e)]]


def _inverse_lower(lower: Matrix) -> Matrix:
    (a, zero, _), (b, c, _), (d, e, f) = lower
    p, q, r = 1 / a, 1 / c, 1 / f
    s, t = -b * p * q, -e * q * r
    return [[p, zero, zero], [s, q, zero], [-(d * p + e * s) * r, t, r]]


def _inverse(matrix: Matrix) -> Matrix:
    (a, b, c), (d, e, f), (g, h, i) = matrix
    cofactors = [[e * i - f * h, c * h - b * i, b * f - c * e],
                 [f * g - d * i, a * i - c * g, c * d - a * f],
                 [d * h - e * g, b * g - a * h, a * e - b * d]]  # fmt: skip
    determinant = a * cofactors[0][0] + b * cofactors[1][0] + c * cofactors[2][0]
    return _scaled(1 / determinant, cofactors)


class _Triads(NamedTuple):
    """The parameters at z: A = K⁻¹ of both triads, c = −K⁻¹ b of the gyroscope, and both biases."""

    inverse_a: Matrix
    bias_a: Vector
    inverse_g: Matrix
    offset_g: Vector
    bias_g: Vector


def _triads(parameters: Parameters, z: Array) -> _Triads:
    flat = list(np.asarray(parameters.reference))
    for place, (index, size) in enumerate(zip(parameters.index, np.asarray(parameters.size), strict=True)):
        flat[index] = flat[index] + float(size) * z[place]
    flat = [each + jnp.zeros_like(z[0]) for each in flat]
    inverse_a, inverse_g = (_inverse([flat[k : k + 3] for k in range(first, first + 9, 3)]) for first in (0, 12))
    bias_g = flat[21:24]
    return _Triads(inverse_a, flat[9:12], inverse_g, [-each for each in matvec(inverse_g, bias_g)], bias_g)


class _Linear(NamedTuple):
    """The conditions at z, unwhitened and linearised. Padding has no reaction, and residual and Jacobian of zero."""

    norm: Vector  # reaction of a pose's norm to its mean output, (P, U) each
    after: Matrix  # … of a turn's two components to the output of the pose after it, (T, U)
    before: Matrix  # … before it
    lever: Matrix  # … to a rotation of its last frame
    rows: Array  # (P, 3, p + 1, U): of norm and turn, the Jacobian's columns (typical sizes) and the residual
    force: Vector  # specific force of each pose


def _linearise(parameters: Parameters, seen: _Seen, at: _Triads, carried: Carried | None) -> _Linear:
    size = np.asarray(parameters.size)
    lower = [(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)]
    inverse = at.inverse_a
    force = matvec(inverse, [y - b for y, b in zip(seen.mean_a, at.bias_a, strict=True)])
    square = sum(each * each for each in force)
    norm = [-seen.pose / seen.gravity * each for each in matvec(transpose(inverse), force)]
    # a change of K and b is one of the output, −δK f − δb
    columns = [-norm[i] * force[j] for i, j in lower] + [-each for each in norm]
    residual = seen.pose * (seen.gravity**2 - square) / (2 * seen.gravity)
    none = jnp.zeros_like(residual)
    if carried is None:
        rows = jnp.stack([*(s * c for s, c in zip(size, columns, strict=True)), residual], axis=1)
        return _Linear(norm, [], [], [], rows[:, None], force)
    columns += [none] * 12
    rows = [[*columns, residual]]

    length = jnp.sqrt(square)
    unit = [each / length for each in force]
    along = matvec(transpose(inverse), unit)
    direction = [[(inverse[i][j] - unit[i] * along[j]) / length for j in range(3)] for i in range(3)]
    back = transpose(rotation_rows(carried.rotation))
    predicted = matvec(back, [each[:-1] for each in unit])
    masked = _scaled(seen.turn, seen.basis)
    after = matmul(masked, [[each[1:] for each in row] for row in direction])
    before = _scaled(-seen.turn, matmul(matmul(seen.basis, back), [[each[:-1] for each in row] for row in direction]))
    lever = [cross(predicted, row) for row in masked]
    error = [u[1:] - p for u, p in zip(unit, predicted, strict=True)]
    for a in range(2):
        columns = [-(after[a][i] * force[j][1:] + before[a][i] * force[j][:-1]) for i, j in lower]
        columns += [-(after[a][i] + before[a][i]) for i in range(3)]
        by_linear = [[sum(lever[a][i] * carried.reach[i][j][k] for i in range(3)) for k in range(4)] for j in range(3)]
        # by (A | c), then by (K, b): δA = −A δK A, δc = −A δK c − A δb
        through = matmul(transpose(at.inverse_g), by_linear)  # pyright: ignore[reportArgumentType]
        right = [[*at.inverse_g[n], at.offset_g[n]] for n in range(3)]
        columns += [-sum(through[m][k] * right[n][k] for k in range(4)) for m in range(3) for n in range(3)]  # pyright: ignore[reportOperatorIssue]
        columns += [-through[m][3] for m in range(3)]
        columns.append(sum(masked[a][i] * error[i] for i in range(3)))  # pyright: ignore[reportArgumentType]
        rows.append([jnp.pad(each, [(0, 1), (0, 0)]) for each in columns])
    size = [*size, 1.0]
    stacked = jnp.stack([jnp.stack([s * c for s, c in zip(size, row, strict=True)], axis=1) for row in rows], axis=1)
    return _Linear(norm, after, before, lever, stacked, force)


def _later(values: Array) -> Array:
    """Shift turns (T, ...) to the pose after each, (P, ...)."""
    return jnp.concatenate([jnp.zeros_like(values[:1]), values])


def _earlier(values: Array) -> Array:
    """Shift turns (T, ...) to the pose before each, (P, ...)."""
    return jnp.concatenate([values, jnp.zeros_like(values[:1])])


class _WhitenedLanes(NamedTuple):
    """C = L Lᵀ of the conditions: L⁻¹ rows, C⁻¹ rows, and the blocks (k, k) and (k, k − 1) of C⁻¹."""

    rows: Array  # (P, 3, p + 1, U)
    solved: Array
    own: Matrix  # (P, U)
    last: Matrix


def _whiten(linear: _Linear, poses: Matrix, turns: Matrix, used: tuple[Array, Array]) -> _WhitenedLanes:
    """Factorise and solve; `poses` and `turns` are covariances of mean outputs and of turns (rad²)."""
    mask_pose, mask_turn = used
    spread = [matvec(poses, row) for row in (linear.norm, *_shifted(linear.before, _earlier))]
    own = [[sum(a * b for a, b in zip(row, other, strict=True)) for other in spread]
           for row in (linear.norm, *_shifted(linear.before, _earlier))]  # fmt: skip
    later = _shifted(linear.after, _later)
    last = [[sum(a * b for a, b in zip(row, other, strict=True)) for row in later] for other in spread]
    after_poses = [[each[1:] for each in row] for row in poses]
    of_turn = _plus(matmul(matmul(linear.after, after_poses), transpose(linear.after)),
                    matmul(matmul(linear.lever, turns), transpose(linear.lever)))  # fmt: skip
    padding = [1 - mask_pose, _earlier(mask_turn), _earlier(mask_turn)]
    padding[1:] = [1 - each for each in padding[1:]]
    for i in range(3):
        own[i][i] = own[i][i] + padding[i]
        for j in range(3):
            if i and j:
                own[i][j] = own[i][j] + _earlier(of_turn[i - 1][j - 1])

    def forward(state, item):
        inverse_before, rows_before = state
        own, last, rows = item
        # columns 1 and 2 of the block below the diagonal; the norm before has no part in this block
        below = [[sum(last[i][m - 1] * inverse_before[j][m] for m in range(1, j + 1)) for j in (1, 2)]
                 for i in range(3)]  # fmt: skip
        left = [[own[i][j] - sum(a * b for a, b in zip(below[i], below[j], strict=True)) for j in range(3)]
                for i in range(3)]  # fmt: skip
        inverse = _inverse_lower(_cholesky(left))
        rest = [rows[i] - below[i][0] * rows_before[1] - below[i][1] * rows_before[2] for i in range(3)]
        rows = jnp.stack([sum(inverse[i][j] * rest[j] for j in range(i + 1)) for i in range(3)])  # pyright: ignore[reportArgumentType]
        return (inverse, rows), (inverse, below, rows)

    zero = jnp.zeros_like(own[0][0][0])  # pyright: ignore[reportIndexIssue]
    identity = [[zero + (i == j) for j in range(3)] for i in range(3)]
    _, (inverse, below, rows) = jax.lax.scan(
        forward, (identity, jnp.zeros_like(linear.rows[0])), (own, last, linear.rows)
    )

    def backward(state, item):
        below_next, solved_next, own_next = state
        inverse, below, rows = item
        rest = [rows[0], *(rows[j] - sum(below_next[i][j - 1] * solved_next[i] for i in range(3)) for j in (1, 2))]
        solved = jnp.stack([sum(inverse[i][j] * rest[i] for i in range(j, 3)) for j in range(3)])  # pyright: ignore[reportArgumentType]
        step = [[sum(below_next[i][j - 1] * inverse[j][m] for j in range(max(m, 1), 3)) for m in range(3)]
                for i in range(3)]  # fmt: skip
        down = matmul(own_next, step)
        square = matmul(transpose(inverse), inverse)
        own = _plus(square, matmul(transpose(step), down))
        return (below, solved, own), (solved, own, _scaled(jnp.asarray(-1.0), down))

    nothing = [[zero] * 3 for _ in range(3)]
    start = ([[zero] * 2 for _ in range(3)], jnp.zeros_like(linear.rows[0]), nothing)
    _, (solved, own, next_by_own) = jax.lax.scan(backward, start, (inverse, below, rows), reverse=True)
    return _WhitenedLanes(rows, solved, own, [[_later(each[:-1]) for each in row] for row in next_by_own])


def _shifted(matrix: Matrix, shift) -> Matrix:
    return [[shift(each) for each in row] for row in matrix]


def _gram(rows: Array) -> Array:
    """Return (U, q, q) of rows (P, c, q, U)."""
    rows = rows.reshape(-1, *rows.shape[2:])
    return jnp.einsum("nau,nbu->uab", rows, rows)


class _Part(NamedTuple):
    """Of one kind of excess V = F Fᵀ: the Gram matrix of FᵀC⁻¹(J, r), tr C⁻¹V, and tr C⁻¹V C⁻¹V."""

    gram: Array
    trace: Array
    information: Array


def _accelerometer_part(linear: _Linear, white: _WhitenedLanes, factor: Matrix) -> tuple[_Part, Matrix]:
    """The excess of accelerometer means, of which each pose has the covariance F Fᵀ, and its reactions times F.

    The information leaves out what far poses have to do with each other; it only sets the length of a step.
    """
    later, earlier = _shifted(linear.after, _later), _shifted(linear.before, _earlier)
    # reactions of (norm, turn after the pose) and of the turn before it: 5 × 3, the last two in the block before
    reaction = matmul([linear.norm, *earlier, *later], factor)
    solved = [*(white.solved[:, i] for i in range(3)), *(_later(white.solved[:-1, i]) for i in (1, 2))]
    through = jnp.stack(
        [sum(reaction[r][c][:, None] * solved[r] for r in range(5)) for c in range(3)],
        axis=1,  # pyright: ignore[reportArgumentType]
    )
    local = _local(white)
    inner = matmul(matmul(transpose(reaction), local), reaction)
    trace = sum(jnp.sum(inner[c][c], axis=0) for c in range(3))
    return _Part(_gram(through), trace, jnp.sum(_trace(inner, inner), axis=0)), matmul(local, reaction)  # pyright: ignore[reportArgumentType]


def _local(white: _WhitenedLanes) -> Matrix:
    """Blocks of C⁻¹ of a pose's norm, its turn and the turn before: (5, 5)."""
    own, last = white.own, white.last
    before = [[_later(own[i][j][:-1]) for j in (1, 2)] for i in (1, 2)]
    rows = [[*own[i], last[i][1], last[i][2]] for i in range(3)]
    return rows + [[last[0][j], last[1][j], last[2][j], *before[j - 1]] for j in (1, 2)]


def _turn_part(linear: _Linear, white: _WhitenedLanes, factor: Matrix, reached: Matrix) -> tuple[_Part, Array]:
    """The excess of turns, of which each has the covariance F Fᵀ; and its information with the accelerometer's."""
    reaction = matmul(linear.lever, factor)
    through = jnp.stack(
        [reaction[0][c][:, None] * white.solved[:-1, 1] + reaction[1][c][:, None] * white.solved[:-1, 2]
         for c in range(3)], axis=1)  # fmt: skip
    own = [[white.own[i][j][:-1] for j in (1, 2)] for i in (1, 2)]
    inner = matmul(matmul(transpose(reaction), own), reaction)
    trace = sum(jnp.sum(inner[c][c], axis=0) for c in range(3))
    shared = sum(
        jnp.sum(_trace(both, both), axis=0)
        for both in (matmul(transpose(reaction), [[each[:-1] for each in reached[i]] for i in (1, 2)]),
                     matmul(transpose(reaction), [[each[1:] for each in reached[i]] for i in (3, 4)]))
    )  # fmt: skip
    return _Part(_gram(through), trace, jnp.sum(_trace(inner, inner), axis=0)), shared  # pyright: ignore[reportArgumentType]


class _LanesPass(NamedTuple):
    z: Array  # (p, U)
    excess: Array  # (3, U)
    information: Array  # (U, p, p)
    covariance: Array
    gravity: Array  # (U, p)
    rms: Array  # (3, U)
    step: Array  # largest of a parameter's, standard deviations (U,)


def _joint_pass(parameters: Parameters, seen: _Seen, carried: Carried, at: _Triads, z, excess, tolerance) -> _LanesPass:
    linear = _linearise(parameters, seen, at, carried)
    unit_a, unit_t = _mean(seen.covariance_a, seen.pose), _mean(carried.covariance, seen.turn)
    unit_g = _mean(seen.covariance_g, seen.pose)
    white = _whiten(
        linear,
        _plus(seen.covariance_a, _scaled(excess[0], unit_a)),
        _plus(carried.covariance, _scaled(excess[1], unit_t)),
        (seen.pose, seen.turn),
    )
    # at rest: the bias alone, and poses are independent
    weight = _scaled(seen.pose, _inverse(_plus(seen.covariance_g, _scaled(excess[2], unit_g))))
    size = np.asarray(parameters.size)[-3:]
    error = [y - b for y, b in zip(seen.mean_g, at.bias_g, strict=True)]
    rest_square = jnp.stack([jnp.stack([size[i] * size[j] * jnp.sum(weight[i][j], axis=0) for j in range(3)])
                             for i in range(3)])  # fmt: skip
    rest_slope = jnp.stack([-size[i] * jnp.sum(each, axis=0) for i, each in enumerate(matvec(weight, error))])

    gram = _gram(white.rows)
    square = gram[:, :-1, :-1].at[:, -3:, -3:].add(jnp.moveaxis(rest_square, -1, 0))
    slope = gram[:, :-1, -1].at[:, -3:].add(rest_slope.T)
    step, covariance = _newton(square, slope, z, tolerance)

    better = _scored(linear, white, (unit_a, unit_t, unit_g), weight, error, size, step, covariance, excess)
    reach = _gravity_reach(white.solved[:, 0, :-1], linear, seen, covariance)
    turned = _turn_rms(linear, seen, step)
    static = sum((s * d - e) ** 2 for e, s, d in zip(error, size, step[-3:], strict=True))
    scale = jnp.sqrt(sum(each**2 for row in _inverse(at.inverse_g) for each in row) / 3)
    rms = jnp.stack([_norm_rms(linear, seen, step), turned, jnp.sqrt(_average(static, seen.pose)) / scale])
    return _LanesPass(z + step, better, square, covariance, reach, rms, _in_sigmas(step, covariance))


def _scored(linear, white, units, weight, error, size, step, covariance, excess) -> Array:
    """Return the three excesses after a step of scoring (maximum restricted likelihood)."""
    accelerometer, reached = _accelerometer_part(linear, white, _cholesky(units[0]))
    turn, shared = _turn_part(linear, white, _cholesky(units[1]), reached)
    factor = _cholesky(units[2])
    error = [e - s * d for e, s, d in zip(error, size, step[-3:], strict=True)]
    through = matmul(transpose(factor), weight)
    left = matvec(through, error)
    inner = matmul(through, factor)
    spread = matmul(transpose(through), through)
    spread = jnp.stack([jnp.stack([size[i] * size[j] * jnp.sum(spread[i][j], axis=0) for j in range(3)])
                        for i in range(3)])  # fmt: skip
    fitted = jnp.sum(jnp.moveaxis(covariance[:, -3:, -3:], 0, -1) * spread, axis=(0, 1))
    rest_trace = sum(jnp.sum(inner[c][c], axis=0) for c in range(3))
    rest_slope_excess = sum(jnp.sum(each**2, axis=0) for each in left) - rest_trace + fitted
    (slope_a, first), (slope_t, second) = (_slopes(part, step, covariance) for part in (accelerometer, turn))
    # cut off where leaving out far poses would make it more than there is
    shared = jnp.minimum(shared, 0.9 * jnp.sqrt(first * second))
    determinant = first * second - shared**2
    changes = jnp.stack([
        (second * slope_a - shared * slope_t) / determinant,
        (first * slope_t - shared * slope_a) / determinant,
        rest_slope_excess / (jnp.sum(_trace(inner, inner), axis=0) * (1 - fitted / rest_trace)),
    ])  # fmt: skip
    return jnp.where(jnp.isfinite(changes), jnp.maximum(excess + changes, 0.0), excess)


def _accelerometer_pass(parameters: Parameters, seen: _Seen, at: _Triads, z, excess, tolerance) -> _LanesPass:
    """The accelerometer alone: poses are independent, and each has one condition."""
    linear = _linearise(parameters, seen, at, None)
    unit = _mean(seen.covariance_a, seen.pose)
    measured, extra = (
        sum(a * b for a, b in zip(linear.norm, matvec(each, linear.norm), strict=True))
        for each in (seen.covariance_a, unit)
    )
    weight = seen.pose / (measured + excess[0] * extra + 1 - seen.pose)
    rows = linear.rows[:, 0]
    solved = weight[:, None] * rows
    gram = jnp.einsum("nau,nbu->uab", rows, solved)
    square = gram[:, :-1, :-1]
    step, covariance = _newton(square, gram[:, :-1, -1], z, tolerance)
    through = solved * jnp.sqrt(extra)[:, None]
    relative = weight * extra
    part = _Part(_gram(through[:, None]), jnp.sum(relative, axis=0), jnp.sum(relative**2, axis=0))
    slope, information = _slopes(part, step, covariance)
    change = slope / information
    better = jnp.where(jnp.isfinite(change), jnp.maximum(excess[0] + change, 0.0), excess[0])
    reach = _gravity_reach(solved[:, :-1], linear, seen, covariance)
    none = jnp.zeros_like(change)
    rms = jnp.stack([_norm_rms(linear, seen, step), none, none])
    return _LanesPass(z + step, excess.at[0].set(better), square, covariance, reach, rms, _in_sigmas(step, covariance))


def _newton(square: Array, slope: Array, z: Array, tolerance: Array) -> tuple[Array, Array]:
    """Return the step (p, U) and the covariance (U, p, p) with the data sheet's tolerance."""
    count = len(z)
    factor = jnp.linalg.cholesky(square + jnp.eye(count) / tolerance**2)
    inverse = solve_triangular(factor, jnp.broadcast_to(jnp.eye(count), factor.shape), lower=True)
    covariance = jnp.einsum("uia,uib->uab", inverse, inverse)
    return -jnp.einsum("uab,ub->au", covariance, slope + z.T / tolerance**2), covariance


def _slopes(part: _Part, step: Array, covariance: Array) -> tuple[Array, Array]:
    """Return twice the restricted likelihood's slope by an excess, qᵀVq − tr PV, and its information, tr PVPV.

    q = C⁻¹(r + J δ) and P = C⁻¹ − C⁻¹J N⁻¹JᵀC⁻¹. The information of C⁻¹ in place of P is made less in the same share as
    the trace, which is exact where V is all of C; it only sets the length of a step.
    """
    weights = jnp.concatenate([step.T, jnp.ones_like(step[:1].T)], axis=1)
    square = jnp.einsum("ua,uab,ub->u", weights, part.gram, weights)
    fitted = jnp.einsum("uab,uab->u", covariance, part.gram[:, :-1, :-1])
    return square - part.trace + fitted, part.information * (1 - fitted / part.trace)


def _gravity_reach(solved: Array, linear: _Linear, seen: _Seen, covariance: Array) -> Array:
    """−(JᵀC⁻¹J)⁻¹ JᵀC⁻¹ ∂r/∂g; `solved` has the norms' rows of C⁻¹J."""
    square = sum(each * each for each in linear.force)
    by_gravity = seen.pose * (1 + square / seen.gravity**2) / 2
    return -jnp.einsum("uab,bu->ua", covariance, jnp.sum(solved * by_gravity[:, None], axis=0))


def _average(values: Array, mask: Array) -> Array:
    return jnp.sum(mask * values, axis=0) / jnp.maximum(jnp.sum(mask, axis=0), 1.0)


def _moved(rows: Array, step: Array) -> Array:
    """Residuals (P, U) after the step, to first order."""
    return rows[:, -1] + jnp.sum(rows[:, :-1] * step, axis=1)


def _norm_rms(linear: _Linear, seen: _Seen, step: Array) -> Array:
    """Of |f| − g, to which the condition −(|f|² − g²) / 2g is the first order."""
    error = _moved(linear.rows[:, 0], step)
    return jnp.sqrt(_average((jnp.sqrt(seen.gravity**2 - 2 * seen.gravity * error) - seen.gravity) ** 2, seen.pose))


def _turn_rms(linear: _Linear, seen: _Seen, step: Array) -> Array:
    square = _moved(linear.rows[:, 1], step) ** 2 + _moved(linear.rows[:, 2], step) ** 2
    return jnp.degrees(jnp.sqrt(_average(square[:-1], seen.turn)))


def _in_sigmas(step: Array, covariance: Array) -> Array:
    return jnp.max(jnp.abs(step) / jnp.sqrt(jnp.diagonal(covariance, axis1=1, axis2=2).T), axis=0)


def fit_lanes(gyroscope: bool, block: int, parameters: Parameters, batch: Observations, limit: Array) -> Lanes:
    """Fit units, the leading axis of `batch`, in SI units, in at most `limit` passes.

    Samples of a turn are padded to a multiple of `block`, those that its derivatives take together.
    """
    seen = _seen(batch)
    count = batch.gravity.shape[0]
    zero = jnp.zeros((len(parameters.index), count))
    if gyroscope:
        interval = jnp.transpose(batch.turns.interval, (2, 1, 0))
        moments = [*(interval * jnp.transpose(batch.turns.output[..., i], (2, 1, 0)) for i in range(3)), interval]
        blocks = compress(moments, block)

    def once(number, again, carried, z, excess, tolerance):
        at = _triads(parameters, z)
        if not gyroscope:
            return carried, _accelerometer_pass(parameters, seen, at, z, excess, tolerance)

        def anew():
            density = matmul(matmul(at.inverse_g, seen.noise), transpose(at.inverse_g))
            # slopes and weights need no more than single precision, and rotations are integrated anew
            inverse, offset, halved, density = jax.tree.map(
                lambda leaf: leaf.astype(jnp.float32), (at.inverse_g, at.offset_g, blocks, density)
            )
            found = jax.tree.map(lambda leaf: leaf.astype(float), carry(inverse, offset, halved, density, block))
            return found._replace(linear=[[*row, c] for row, c in zip(at.inverse_g, at.offset_g, strict=True)])

        def first():
            found = anew()
            return found, found.rotation

        def second():
            return carried, rotate_through(at.inverse_g, at.offset_g, blocks)

        def third():
            rotation = rotate_samples(at.inverse_g, at.offset_g, moments)
            return anew()._replace(rotation=rotation), rotation

        def later():
            rotation, squared = moved(carried, at.inverse_g, at.offset_g)
            far = again & (jnp.max(seen.turn * squared, axis=0) > _FAR**2)

            def integrated():
                exact = rotate_samples(at.inverse_g, at.offset_g, moments)
                linear = [[*row, c] for row, c in zip(at.inverse_g, at.offset_g, strict=True)]
                new = carried._replace(rotation=exact, linear=linear), exact
                return jax.tree.map(partial(jnp.where, far), new, (carried, rotation))

            return jax.lax.cond(far.any(), integrated, lambda: (carried, rotation))

        carried, rotation = jax.lax.switch(jnp.minimum(number, _EXACT + 1), [first, second, third, later])
        seen_now = carried._replace(rotation=rotation)
        return carried, _joint_pass(parameters, seen, seen_now, at, z, excess, tolerance)

    def body(state):
        number, again, converged, carried, last, excess, passes, before = state
        # the first pass leans on the data sheet; later ones leave it further behind
        carried, out = once(number, again, carried, last.z, excess, jnp.where(number == 0, 1.0, TOLERANCE))
        change = out.excess - excess
        changed = jnp.max(jnp.abs(change) / (1 + excess), axis=0) > _SETTLED
        settled = (number >= (_EXACT if gyroscope else 1)) & ~changed & (out.step < _STILL)
        finite = jnp.isfinite(out.z).all(axis=0)
        # where the change would be none, if it is linear in the excess; the first passes are too far off to tell
        share = (excess - before[0]) / (before[1] - change)
        share = jnp.where((number > _EXACT) & jnp.isfinite(share), jnp.clip(share, *_SHARE), 1.0)

        def kept(new, old, axis):
            shape = [1] * new.ndim
            shape[axis] = count
            return jnp.where(again.reshape(shape), new, old)

        last = _LanesPass(
            kept(out.z, last.z, 1), kept(out.excess, last.excess, 1), kept(out.information, last.information, 0),
            kept(out.covariance, last.covariance, 0), kept(out.gravity, last.gravity, 0), kept(out.rms, last.rms, 1),
            kept(out.step, last.step, 0),
        )  # fmt: skip
        before = excess, change
        # a result goes with the excess that it was weighted with
        excess = jnp.where(again & ~settled & finite, excess + share * change, excess)
        return (number + 1, again & ~settled & finite, jnp.where(again, settled, converged), carried, last, excess,
                passes + again, before)  # fmt: skip

    coarse = jnp.tile(jnp.asarray(COARSE_EXCESS)[:, None], (1, count))
    line = jnp.zeros((seen.turn.shape[0], count))
    carried = Carried([line] * 4, [[[line] * 4] * 3] * 3, [[line] * 3] * 3, [[zero[0]] * 4] * 3)
    square = jnp.zeros((count, len(zero), len(zero)))
    nothing = _LanesPass(zero, coarse, square, square, zero.T, jnp.zeros((3, count)), jnp.zeros(count))
    all_lanes = jnp.ones(count, bool)
    state = jnp.asarray(0), all_lanes, ~all_lanes, carried, nothing, coarse, jnp.zeros(count, int), (coarse, coarse)
    *_, converged, carried, last, excess, passes, _ = jax.lax.while_loop(
        lambda s: s[1].any() & (s[0] < limit), body, state
    )
    finite = jnp.isfinite(last.z).all(axis=0) & jnp.isfinite(last.covariance).all(axis=(1, 2))
    return Lanes(
        last.z.T, last.covariance, last.gravity, last.information, excess.T, last.rms.T, passes, converged & finite,
        finite,
    )  # fmt: skip
