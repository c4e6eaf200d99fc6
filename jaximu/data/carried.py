"""Turns integrated once: the rotation at one gyroscope calibration, and how it moves with the parameters.

The rate ω = A y + c, A = K⁻¹ and c = −K⁻¹ b, is linear in (A, c), so with P_k the rotation up to sample k a change of
(A, c) turns the last frame by R(P_S)ᵀ Σ R(P_k) J_r(θ_k) (δA y_k + δc) dt_k: twelve numbers a component, summed once
over the samples (pre-integration; Forster et al., IEEE Transactions on Robotics 33, 2017, sec. VI, with all of K and
not the bias alone).

Samples can be taken by blocks: to second order a block of rotation vectors θ_i = A u_i + c t_i (u = y dt) is
Σ θ_i + ½ Σ_{i<j} θ_i × θ_j = A U + c T + ½ (cof(A) Σ u_i × u_j + A Σ (u_i t_j − t_i u_j) × c), sums that no parameter
enters (Bortz's coning correction; Savage, Journal of Guidance, Control, and Dynamics 21, 1998). Coning within a sample,
half of μ_k × δ_k with sums μ and differences δ of its neighbours (`jaximu.ground.rotation.rotation_vectors`), is of the
same form and joins the sums. Slopes leave the quadratic terms out but for ½ A Σ (u_i t_j − t_i u_j) × δc, which tells
where in the block its time lies.

Everything here is by component: a vector is a list of three arrays, a matrix a list of rows, and arrays have trailing
axes only for turns (and units), after one for samples where there is one. A CPU then computes turns side by side, ten
times faster than with the components last.
"""

from math import factorial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaximu.ground.array_types import Array
from jaximu.ground.rotation import MEAN_RATES

__all__ = [
    "Carried",
    "Matrix",
    "SampleBlocks",
    "Vector",
    "carry",
    "compress",
    "cross",
    "matmul",
    "matvec",
    "moved",
    "product",
    "right_jacobian_rows",
    "rotate_samples",
    "rotate_through",
    "rotation_rows",
    "transpose",
    "turn",
]

Vector = list[Array]
Matrix = list[list[Array]]


class SampleBlocks(NamedTuple):
    """Samples, or sums over blocks of samples; no parameter enters. Every array is (B, ...), the rest turns."""

    moments: Vector  # Σ y dt (three), Σ dt
    coning: Vector  # Σ_{i<j} u_i × u_j + Σ_k μ_k × δ_k
    first: Vector  # the same of u t − t u


class Carried(NamedTuple):
    """What is left of turns integrated at A and c: arrays (...) of turns."""

    rotation: Vector  # quaternion from the last body frame to the first
    reach: list[Matrix]  # [i][j][k]: of the last frame's rotation vector, component i, by row j of (A | c), column k
    covariance: Matrix  # rad², of that rotation vector by white noise
    linear: Matrix  # (A | c), by rows: where the rotation is exact


def transpose(matrix: Matrix) -> Matrix:
    """Return the transpose."""
    return [list(row) for row in zip(*matrix, strict=True)]


def matvec(matrix: Matrix, vector: Vector) -> Vector:
    """Return the product of a matrix and a vector."""
    return [_dot(row, vector) for row in matrix]


def matmul(first: Matrix, second: Matrix) -> Matrix:
    """Return the product of two matrices."""
    columns = transpose(second)
    return [[_dot(row, column) for column in columns] for row in first]


def _dot(first: Vector, second: Vector) -> Array:
    total = first[0] * second[0]
    for a, b in zip(first[1:], second[1:], strict=True):
        total = total + a * b
    return total


def cross(first: Vector, second: Vector) -> Vector:
    """Return the cross product."""
    (a, b, c), (x, y, z) = first, second
    return [b * z - c * y, c * x - a * z, a * y - b * x]


def compress(moments: Vector, size: int) -> SampleBlocks:
    """Sum samples, y dt and dt of each (S, ...), up in blocks of `size`, which divides S."""
    p, q = (2 * each for each in MEAN_RATES)

    def body(_, block):
        coning, first, total = [jnp.zeros_like(block[0][0])] * 3, [jnp.zeros_like(block[0][0])] * 3, None
        for k in range(1, size + 1):
            *u, t = sample = [each[k] for each in block]
            left, right = ([each[k + side] for each in block] for side in (-1, 1))
            pairs = [([p * a - q * (b + c) for a, b, c in zip(sample, left, right, strict=True)],
                      [c - b for b, c in zip(left, right, strict=True)])]  # fmt: skip
            pairs += [] if total is None else [(total, sample)]
            for (*x, s), (*y, r) in pairs:
                coning = [a + b for a, b in zip(coning, cross(x, y), strict=True)]
                first = [a + b * r - s * c for a, b, c in zip(first, x, y, strict=True)]
            total = [*u, t] if total is None else [a + b for a, b in zip(total, sample, strict=True)]
        assert total is not None
        return None, SampleBlocks(total, coning, first)

    def with_neighbours(each):  # (B, size + 2, ...)
        blocks = each.reshape(-1, size, *each.shape[1:])
        edge = jnp.zeros_like(blocks[:1, :1])
        before = jnp.concatenate([edge, blocks[:-1, -1:]])
        return jnp.concatenate([before, blocks, jnp.concatenate([blocks[1:, :1], edge])], axis=1)

    return jax.lax.scan(body, None, [with_neighbours(each) for each in moments])[1]


_TERMS = 7
"""Of the power series below in θ²: exact to rounding for θ up to 1 rad, to 1e-9 up to 2 rad, quicker than sine, cosine
and a square root, which a CPU does not compute side by side."""


def _series(start: int, step: float):
    """Coefficients of Σ (−1)^k step^k x^k / (2k + start)!."""
    return [(-step) ** k / factorial(2 * k + start) for k in range(_TERMS)]


_COSINE_HALF, _SINE_HALF = _series(0, 0.25), [each / 2 for each in _series(1, 0.25)]  # cos(θ/2) and sin(θ/2) / θ
_FIRST, _SECOND = _series(2, 1.0), _series(3, 1.0)  # (1 − cos θ) / θ² and (θ − sin θ) / θ³


def _sum(coefficients: list[float], squared: Array) -> Array:
    total = jnp.full_like(squared, coefficients[-1])
    for each in reversed(coefficients[:-1]):
        total = total * squared + each
    return total


def product(p: Vector, q: Vector) -> Vector:
    """Return the Hamilton product p ⊗ q."""
    (w, x, y, z), (a, b, c, d) = p, q
    return [
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    ]


def turn(quaternion: Vector, vector: Vector) -> Vector:
    """Return quaternion ⊗ exp(vector), exact for rotation vectors of up to 1 rad (see `_TERMS`)."""
    squared = _dot(vector, vector)
    sine = _sum(_SINE_HALF, squared)
    return product(quaternion, [_sum(_COSINE_HALF, squared), *(sine * each for each in vector)])


def rotation_rows(quaternion: Vector) -> Matrix:
    """Return the rotation matrix of a unit quaternion."""
    w, x, y, z = quaternion
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def right_jacobian_rows(vector: Vector) -> Matrix:
    """Return `jaximu.ground.rotation.right_jacobian` of rotation vectors of up to 1 rad."""
    squared = _dot(vector, vector)
    first, second = _sum(_FIRST, squared), _sum(_SECOND, squared)
    x, y, z = vector
    return [
        [1 - second * (y * y + z * z), first * z + second * x * y, -first * y + second * x * z],
        [-first * z + second * x * y, 1 - second * (x * x + z * z), first * x + second * y * z],
        [first * y + second * x * z, -first * x + second * y * z, 1 - second * (x * x + y * y)],
    ]


def _cofactors(matrix: Matrix) -> Matrix:
    a, b, c = matrix
    return [cross(b, c), cross(c, a), cross(a, b)]


def _advance(inverse: Matrix, offset: Vector, cofactors: Matrix, quaternion: Vector, block: SampleBlocks):
    """Return the rotation after a block, and the block's rotation vector."""
    *u, t = block.moments
    vector = [each + c * t for each, c in zip(matvec(inverse, u), offset, strict=True)]
    second = matvec(cofactors, block.coning)
    tilted = cross(matvec(inverse, block.first), offset)
    vector = [v + (a + b) / 2 for v, a, b in zip(vector, second, tilted, strict=True)]
    return turn(quaternion, vector), vector


def _identity(blocks: SampleBlocks) -> Vector:
    one = jnp.ones_like(blocks.moments[0][0])
    return [one, *[jnp.zeros_like(one)] * 3]


def _normalised(quaternion: Vector) -> Vector:
    length = jnp.sqrt(_dot(quaternion, quaternion))
    return [each / length for each in quaternion]


def rotate_through(inverse: Matrix, offset: Vector, blocks: SampleBlocks) -> Vector:
    """Return the rotation of each turn, a unit quaternion from the last body frame to the first."""
    cofactors = _cofactors(inverse)

    def body(quaternion, block):
        return _advance(inverse, offset, cofactors, quaternion, block)[0], None

    return _normalised(jax.lax.scan(body, _identity(blocks), blocks)[0])


def rotate_samples(inverse: Matrix, offset: Vector, moments: Vector) -> Vector:
    """Return what `rotate_through` does of blocks of one sample, from the samples, y dt and dt of each (S, ...)."""
    p, q = MEAN_RATES

    def body(state, following):
        quaternion, before, vector = state
        *u, t = following
        after = [each + c * t for each, c in zip(matvec(inverse, u), offset, strict=True)]
        mean = [p * v - q * (a + b) for v, a, b in zip(vector, before, after, strict=True)]
        change = [b - a for a, b in zip(before, after, strict=True)]
        turned = [v + each for v, each in zip(vector, cross(mean, change), strict=True)]
        return (turn(quaternion, turned), vector, after), None

    zero = jnp.zeros_like(inverse[0][0] * moments[0][0])
    state = [zero + 1, zero, zero, zero], [zero] * 3, [zero] * 3
    state, _ = jax.lax.scan(body, state, moments)  # each sample is turned by when the next is known
    (quaternion, *_), _ = body(state, [zero] * 4)
    return _normalised(quaternion)


def carry(inverse: Matrix, offset: Vector, blocks: SampleBlocks, density: Matrix, size: int = 1) -> Carried:
    """Integrate turns at A and c: rotation, its derivatives, and its noise.

    `density` is of the rate's white noise, A N Aᵀ in (rad/s)² s, which every sample adds rotated as at its end; over a
    block of `size` samples R N Rᵀ is taken to change evenly, and noise alike on all axes needs no such care.
    """
    early, late = (size - 1) / (2 * size), (size + 1) / (2 * size)
    cofactors = _cofactors(inverse)

    def noise(rotation):
        rows = matmul(matmul(rotation, density), transpose(rotation))
        return [rows[i][j] for i, j in _LOWER]

    def body(state, block):
        quaternion, before, sums, spread = state
        quaternion, vector = _advance(inverse, offset, cofactors, quaternion, block)
        rotation = rotation_rows(quaternion)
        transport = matmul(rotation, right_jacobian_rows(vector))
        moments = block.moments
        sums = [[[total + transport[i][j] * m for total, m in zip(sums[i][j], moments, strict=True)]
                 for j in range(3)] for i in range(3)]  # fmt: skip
        tilt = [each / 2 for each in matvec(inverse, block.first)]
        sums = [[[*row[:3], row[3] + turned] for row, turned in zip(rows, cross(transport[i], tilt), strict=True)]
                for i, rows in enumerate(sums)]  # fmt: skip
        after = noise(rotation)
        spread = [s + moments[3] * (early * a + late * b) for s, a, b in zip(spread, before, after, strict=True)]
        return (quaternion, after, sums, spread), None

    identity = _identity(blocks)
    one, zero = identity[0], identity[1]
    start = noise([[one if i == j else zero for j in range(3)] for i in range(3)])
    state = identity, [s + zero for s in start], [[[zero] * 4 for _ in range(3)] for _ in range(3)], [zero] * 6
    quaternion, _, sums, spread = jax.lax.scan(body, state, blocks)[0]
    quaternion = _normalised(quaternion)
    back = transpose(rotation_rows(quaternion))
    reach = [[[_dot(back[i], [sums[m][j][k] for m in range(3)]) for k in range(4)] for j in range(3)]
             for i in range(3)]  # fmt: skip
    linear = [[*row, c] for row, c in zip(inverse, offset, strict=True)]
    return Carried(quaternion, reach, matmul(matmul(back, _symmetric(spread)), transpose(back)), linear)


def moved(carried: Carried, inverse: Matrix, offset: Vector) -> tuple[Vector, Array]:
    """Return the rotation at other A and c, to first order in how far they are, and the square of its angle (rad²)."""
    change = [[new - old for new, old in zip([*row, c], at, strict=True)]
              for row, c, at in zip(inverse, offset, carried.linear, strict=True)]  # fmt: skip
    vector = [sum(_dot(row, by) for row, by in zip(rows, change, strict=True)) for rows in carried.reach]
    return turn(carried.rotation, vector), _dot(vector, vector)


_LOWER = [(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)]


def _symmetric(lower: Vector) -> Matrix:
    a, b, c, d, e, f = lower
    return [[a, b, d], [b, c, e], [d, e, f]]
