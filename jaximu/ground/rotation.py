"""Rotations: quaternions, the exponential map, and the rotation accumulated by a gyroscope.

Quaternions are (..., 4) arrays, scalar first, unit length; `q` takes body vectors to the reference frame
(`rotate(q, v_body) = v_reference`) and grows on the right: after turning by the body rotation vector θ it is
`multiply(q, exponential(θ))`. Samples of a rate become rotation vectors by `rotation_vectors`. Everything is written
element by element, because under `jax.vmap` and `jax.jacfwd` stacks of small matrix products are many times slower on a
CPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Float

from jaximu.ground.array_types import Array
from jaximu.ground.prefixes import running
from jaximu.ground.tracing import array_module

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Number = Float[Array, ""]
Numbers = Float[Array, "..."]
"""One number, and numbers of any shape."""
Vector = Float[Array, "... 3"]
Vectors = Float[Array, "... S 3"]
"""Of S samples."""
Quaternion = Float[Array, "... 4"]
Matrix = Float[Array, "... 3 3"]

UP, IDENTITY = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0, 0.0])
"""The direction of a level frame's z axis, and the quaternion of no rotation."""
MEAN_RATES, POINT_RATES = (7 / 120, 1 / 120), (41 / 1440, 11 / 2880)
"""p and q of coning by samples that are means over their intervals, or points; see `rotation_vectors`."""
_SMALL = 1e-8  # squared angle (rad²) below which a series to second order is exact in double precision


def apply_matrix(matrix: Matrix, vector: Vector) -> Vector:
    """Return `matrix @ vector`, broadcast over leading axes, written element by element."""
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    rows = [matrix[..., i, 0] * x + matrix[..., i, 1] * y + matrix[..., i, 2] * z for i in range(3)]
    return array_module(rows).stack(rows, axis=-1)


def inverse_matrix(matrix: Matrix) -> Matrix:
    """Return the exact inverse of (..., 3, 3) matrices by cofactors."""
    a, b, c = matrix[..., 0, :], matrix[..., 1, :], matrix[..., 2, :]
    columns = [jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)]
    determinant = jnp.sum(a * columns[0], axis=-1)
    return jnp.stack(columns, axis=-1) / determinant[..., None, None]


def rotations_of(quaternions: Any) -> Rotation:
    """Return quaternions (..., 4), one after another, as rotations of SciPy."""
    return scipy.spatial.transform.Rotation.from_quat(np.reshape(quaternions, (-1, 4)), scalar_first=True)


def unit_vectors(vectors: Float[Array, "... m"]) -> Float[Array, "... m"]:
    """Return vectors scaled to length one, with NumPy or under a trace with JAX."""
    squared = (vectors**2).sum(axis=-1, keepdims=True)
    return vectors / array_module(squared).sqrt(squared)


def product(p: Sequence[Any], q: Sequence[Any]) -> tuple[Any, Any, Any, Any]:
    """Return the Hamilton product p ⊗ q of quaternions by component."""
    pw, px, py, pz = p
    qw, qx, qy, qz = q
    return (
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    )


def _parts(array):
    return tuple(array[..., i] for i in range(array.shape[-1]))


def multiply(p: Quaternion, q: Quaternion) -> Quaternion:
    """Return the Hamilton product p ⊗ q."""
    return jnp.stack(product(_parts(p), _parts(q)), axis=-1)


def conjugate(q: Quaternion) -> Quaternion:
    """Return the conjugate, which is the inverse of a unit quaternion."""
    return q * jnp.array([1.0, -1.0, -1.0, -1.0], q.dtype)


def rotation_rows(quaternion: Sequence[Any]) -> list[list[Any]]:
    """Return the rows of the rotation matrix of a unit quaternion, all by component."""
    w, x, y, z = quaternion
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def rotation_matrix(q: Quaternion) -> Matrix:
    """Return the rotation matrix of a unit quaternion: `rotation_matrix(q) @ v == rotate(q, v)`."""
    rows = rotation_rows(_parts(q))
    stack = array_module(rows).stack
    return stack([stack(row, axis=-1) for row in rows], axis=-2)


def rotate(q: Quaternion, vector: Vector) -> Vector:
    """Rotate body vectors into the reference frame."""
    return apply_matrix(rotation_matrix(q), vector)


def _half_angle(rotation_vector):
    """Return cos(θ/2) and sin(θ/2)/θ of rotation vectors, safe (also to differentiate) at zero."""
    squared = jnp.sum(rotation_vector**2, axis=-1)
    small = squared < _SMALL
    angle = jnp.sqrt(jnp.where(small, 1.0, squared))
    cosine = jnp.where(small, 1 - squared / 8, jnp.cos(angle / 2))
    sine = jnp.where(small, 0.5 - squared / 48, jnp.sin(angle / 2) / angle)
    return cosine, sine


def exponential(rotation_vector: Vector) -> Quaternion:
    """Return the unit quaternion of a rotation vector (rad)."""
    cosine, sine = _half_angle(rotation_vector)
    return jnp.concatenate([cosine[..., None], sine[..., None] * rotation_vector], axis=-1)


def logarithm(q: Quaternion) -> Vector:
    """Return the rotation vector (rad, length at most π) of a unit quaternion."""
    q = jnp.where(q[..., :1] < 0, -q, q)
    squared = jnp.sum(q[..., 1:] ** 2, axis=-1)
    small = squared < _SMALL
    sine = jnp.sqrt(jnp.where(small, 1.0, squared))
    cosine = q[..., 0]
    factor = jnp.where(small, 2 / cosine * (1 - squared / (3 * cosine**2)), 2 * jnp.arctan2(sine, cosine) / sine)
    return factor[..., None] * q[..., 1:]


def right_jacobian(rotation_vector: Vector) -> Matrix:
    """Return J_r with exp(θ + δ) = exp(θ) exp(J_r(θ) δ) to first order in δ.

    J_r = I − (1 − cos θ)/θ² [θ]× + (θ − sin θ)/θ³ [θ]×² (Chirikjian, Stochastic Models, Information Theory, and Lie
    Groups, vol. 2, 2012).
    """
    return jnp.stack([jnp.stack(row, axis=-1) for row in _right_jacobian_rows(rotation_vector)], axis=-2)


def _right_jacobian_rows(rotation_vector):
    """The rows of J_r by component, from the half angle, which `exponential` computes as well."""
    squared = jnp.sum(rotation_vector**2, axis=-1)
    small = squared < 1e-4  # the closed form cancels well above the square root of machine precision
    cosine, sine = _half_angle(rotation_vector)  # 1 − cos θ = 2 sin²(θ/2), sin θ = 2 sin(θ/2) cos(θ/2)
    closed = (1 - 2 * cosine * sine) / jnp.where(small, 1.0, squared)
    second = jnp.where(small, 1 / 6 - squared / 120 + squared**2 / 5040, closed)
    return right_jacobian_rows(_parts(rotation_vector), 2 * sine**2, second)


def right_jacobian_rows(vector: Sequence[Any], first: Any, second: Any) -> list[list[Any]]:
    """Return the rows of J_r by component, from (1 − cos θ)/θ² and (θ − sin θ)/θ³."""
    x, y, z = vector
    return [
        [1 - second * (y * y + z * z), first * z + second * x * y, -first * y + second * x * z],
        [-first * z + second * x * y, 1 - second * (x * x + z * z), first * x + second * y * z],
        [first * y + second * x * z, -first * x + second * y * z, 1 - second * (x * x + y * y)],
    ]


def running_rotations(rotation_vectors: Vectors) -> Float[Array, "... S 4"]:
    """Return exp(θ_1) ⊗ … ⊗ exp(θ_k) for every k: the attitude after each sample, relative to the first body frame.

    Exactly, of body rotation vectors (rad); a zero vector is the identity, so padding costs nothing but time.
    """
    whole = running(product, _parts(jnp.moveaxis(exponential(rotation_vectors), -2, 0)))
    length = jnp.sqrt(sum(part**2 for part in whole))
    return jnp.moveaxis(jnp.stack(whole) / length, (0, 1), (-1, -2))


def transport(running: Float[Array, "... S 4"], rotation_vectors: Vectors) -> Float[Array, "... S 3 3"]:
    """Return how a small change of each rotation vector turns all frames after it, in the first frame: R(P_k) J_r(θ_k).

    Laid out component by component: half the time, and sums over the samples become products of matrices.

    **Arguments:** `running`: P_k, as `running_rotations` has it of the vectors (rad).
    """
    jacobian = _right_jacobian_rows(rotation_vectors)
    rows, columns = rotation_rows(_parts(running)), list(zip(*jacobian, strict=True))
    entries = [sum(r * j for r, j in zip(row, column, strict=True)) for row in rows for column in columns]
    by_component = jnp.moveaxis(jnp.stack(entries, axis=-2), -2, -1)
    return by_component.reshape(*rotation_vectors.shape, 3)


def rotation_vectors(
    rates: Vectors, intervals: Float[Array, "... S"], sampled: tuple[float, float] = MEAN_RATES
) -> Vectors:
    """Return the rotation vector of each sample of an angular rate whose axis moves.

    A sample of length h turns by α = ∫ω dt and by coning, ½ ∫∫_{s<t} ω(s) × ω(t) = h³/12 ω × ω' + O(h⁵) (Magnus's
    series). The neighbours tell it: (p α − q (α₋ + α₊)) × (α₊ − α₋), with p and q such that a cone of any frequency,
    ω = (cos θk, sin θk), is right to the order θ⁵. A sample's mean over h is 2 sin(θ/2)/θ of the rate's amplitude, and
    what a cone lacks is (θ − sin θ)/2 a sample: 2p sin θ − 2q sin 2θ = θ/12 (1 + θ²/30), so p = 7/120, q = 1/120.
    Points hold the whole amplitude; their sum lacks θ/24 + θ³/1440: p = 41/1440, q = 11/2880. Without coning the
    attitude is off by h²/12 ∫ω × ω' dt, or half of that with points, whose missing h²/24 ω'' adds up by parts to
    −h²/24 ∫ω × ω' dt between rests.

    Means are the rule: a sensor low-passes ahead of its output, and with an impulse response of variance σ² the share
    of h² is 1/24 + σ²/(2h²): a box's 1/12 for a bandwidth of 0.44 of the output rate; usual are 0.4 to 0.5. A log
    thinned without a filter holds points; taken as means it keeps as much error as without coning, of the other sign.

    **Arguments:** `rates` in rad/s; `intervals` in s, zero for padding, which must follow the samples (before the first
    and after the last is rest); `sampled`: `MEAN_RATES` or `POINT_RATES`.
    """
    p, q = sampled
    vectors = rates * intervals[..., None]
    rest = jnp.zeros_like(vectors[..., :1, :])
    padded = jnp.concatenate([rest, vectors, rest], axis=-2)
    before, after = padded[..., :-2, :], padded[..., 2:, :]
    return vectors + jnp.cross(p * vectors - q * (before + after), after - before)


def _integrate_rk4(rates, intervals):
    """Quaternion Runge–Kutta of fourth order on q̇ = ½ q ⊗ ω with the rate linear between neighbouring samples.

    Sample k is taken to hold over its interval, so the step runs from its first edge to its last; the rate at an edge
    is the mean of the two samples that meet there (Tedaldi, Pretto, Menegatti, ICRA 2014, eq. 13 to 17).
    """
    meeting = (rates[..., :-1, :] + rates[..., 1:, :]) / 2
    followed = (intervals[..., 1:] > 0)[..., None]
    first = jnp.concatenate([rates[..., :1, :], meeting], axis=-2)
    last = jnp.concatenate([jnp.where(followed, meeting, rates[..., :-1, :]), rates[..., -1:, :]], axis=-2)

    def derivative(q, rate):
        return multiply(q, jnp.concatenate([jnp.zeros_like(rate[..., :1]), rate], axis=-1)) / 2

    def advance(q, sample):
        first, middle, last, step = sample
        k1 = derivative(q, first)
        k2 = derivative(q + k1 * step / 2, middle)
        k3 = derivative(q + k2 * step / 2, middle)
        k4 = derivative(q + k3 * step, last)
        return unit_vectors(q + (k1 + 2 * k2 + 2 * k3 + k4) * step / 6), None

    samples = tuple(jnp.moveaxis(array, -2, 0) for array in (first, rates, last, intervals[..., None]))
    start = jnp.zeros((*rates.shape[:-2], 4), rates.dtype).at[..., 0].set(1.0)
    return jax.lax.scan(advance, start, samples)[0]


def integrate_rates(rates: Vectors, intervals: Float[Array, "... S"], method: str = "exponential") -> Quaternion:
    """Return the rotation that angular rates accumulate, a quaternion from the last body frame to the first.

    **Arguments:**

    - `rates`: angular rate (rad/s) in the body frame, sample k its mean over `intervals[k]`.
    - `intervals`: durations (s); zero for padding, which must follow the samples.
    - `method`: `"exponential"`, the product of the samples' rotations, with coning (`rotation_vectors`); or `"rk4"`,
      the quaternion Runge–Kutta of Tedaldi et al. (2014), with the rate linear between samples.
    """
    if method == "exponential":
        return running_rotations(rotation_vectors(rates, intervals))[..., -1, :]
    if method == "rk4":
        return _integrate_rk4(rates, intervals)
    raise ValueError(f"unknown integration method {method!r}: use 'exponential' or 'rk4'")
