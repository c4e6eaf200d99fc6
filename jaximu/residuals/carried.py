"""Turns integrated once: the rotation at one gyroscope calibration, and how it moves with the parameters.

The rate ω = A y + c, A = K⁻¹ and c = −K⁻¹ b, is linear in (A, c), so with P_k the rotation up to sample k a change of
(A, c) turns the last frame by R(P_S)ᵀ Σ R(P_k) J_r(θ_k) (δA y_k + δc) dt_k: twelve numbers a component, summed once
over the samples (pre-integration; Forster et al., IEEE Transactions on Robotics 33, 2017, sec. VI, with all of K and
not the bias alone). A solver then moves without touching samples. What is left out is the square of the turn's change:
a fit integrates anew at its result until that is nothing.

On the way samples can be taken by blocks: to second order a block of rotation vectors θ_i = A u_i + c t_i (u = y dt) is
Σ θ_i + ½ Σ_{i<j} θ_i × θ_j = A U + c T + ½ (cof(A) Σ u_i × u_j + A Σ (u_i t_j − t_i u_j) × c), sums that no parameter
enters (Bortz's coning correction; Savage, Journal of Guidance, Control, and Dynamics 21, 1998). The last integration is
of the samples.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from jaximu._types import Array
from jaximu.observations import Turns
from jaximu.rotation import (
    apply_matrix,
    conjugate,
    exponential,
    inverse_matrix,
    multiply,
    right_jacobian,
    rotation_matrix,
    running_rotations,
)
from jaximu.sensor import Triad

__all__ = ["Blocks", "CarriedTurns", "carry", "carry_blocks", "compress"]


class CarriedTurns(Turns):
    """Turns of which only the integral is left: `output` and `interval` hold no samples."""

    inverse: Float[Array, "3 3"]  # A = K⁻¹ where they were integrated
    offset: Float[Array, " 3"]  # c = −K⁻¹ b
    rotation: Float[Array, "T 4"]  # from the last body frame to the first
    reach: Float[Array, "T 3 3 4"]  # of the last frame's rotation vector by (A | c), A's rows second, its columns last
    covariance: Float[Array, "T 3 3"]  # rad², of that rotation vector by white noise

    def rotations(self, gyroscope: Triad) -> Float[Array, "T 4"]:
        """Return the rotation of each turn at another calibration, to first order in the change of the turn."""
        inverse, offset = _linear(gyroscope)
        moved = jnp.concatenate([inverse - self.inverse, (offset - self.offset)[:, None]], axis=1)
        return multiply(self.rotation, exponential(jnp.sum(self.reach * moved, axis=(-2, -1))))


class Blocks(eqx.Module):
    """Sums over blocks of samples, in which no parameter enters."""

    moments: Float[Array, "T B 4"]  # Σ y dt, Σ dt
    coning: Float[Array, "T B 3"]  # Σ_{i<j} u_i × u_j
    first: Float[Array, "T B 3"]  # Σ_{i<j} (u_i t_j − t_i u_j)


def _linear(gyroscope: Triad) -> tuple[Float[Array, "3 3"], Float[Array, " 3"]]:
    """A and c of ω = A y + c."""
    inverse = inverse_matrix(gyroscope.gain)
    return inverse, -jnp.sum(inverse * gyroscope.bias, axis=-1)


def _moments(turns: Turns) -> Float[Array, "T S 4"]:
    interval = turns.interval[..., None]
    return jnp.concatenate([turns.output * interval, interval], axis=-1)


def compress(turns: Turns) -> Blocks:
    """Sum the samples of turns up in blocks of eight (four where their padded number is no multiple of eight)."""
    moments = _moments(turns)
    steps, samples, _ = moments.shape
    size = 8 if samples % 8 == 0 else 4
    blocks = moments.reshape(steps, samples // size, size, 4)
    before = jnp.cumsum(blocks, axis=2) - blocks
    u, t, before_u, before_t = blocks[..., :3], blocks[..., 3:], before[..., :3], before[..., 3:]
    return Blocks(
        jnp.sum(blocks, axis=2),
        jnp.sum(jnp.cross(before_u, u), axis=2),
        jnp.sum(before_u * t - before_t * u, axis=2),
    )


def carry(gyroscope: Triad, turns: Turns) -> CarriedTurns:
    """Integrate turns at a calibration: rotation, its derivatives by gain and bias, and its noise."""
    moments = _moments(turns)
    inverse, offset = _linear(gyroscope)
    vectors = apply_matrix(inverse, moments[..., :3]) + offset * moments[..., 3:]
    return _integrate(turns, inverse, offset, vectors, moments)


def carry_blocks(gyroscope: Triad, turns: Turns, blocks: Blocks) -> CarriedTurns:
    """Integrate turns by blocks: as `carry`, to second order in the rotation vector of a block."""
    inverse, offset = _linear(gyroscope)
    # the cofactors of A are those of K⁻¹: K's transpose over its determinant
    gain = gyroscope.gain
    cofactors = gain.T / jnp.dot(gain[0], jnp.cross(gain[1], gain[2]))
    moments = blocks.moments
    vectors = apply_matrix(inverse, moments[..., :3]) + offset * moments[..., 3:]
    second = apply_matrix(cofactors, blocks.coning) + jnp.cross(apply_matrix(inverse, blocks.first), offset)
    return _integrate(turns, inverse, offset, vectors + second / 2, moments)


def _integrate(turns: Turns, inverse, offset, vectors, moments) -> CarriedTurns:
    running = running_rotations(vectors)
    final = running[..., -1, :]
    rotation = rotation_matrix(running)
    jacobian = right_jacobian(vectors)
    products = [rotation[..., :, k, None] * jacobian[..., None, k, :] for k in range(3)]
    transport = products[0] + products[1] + products[2]
    steps = vectors.shape[:2]
    # one matrix product a turn: nine components of the transport against four moments, summed over the samples
    first = jnp.einsum("tsm,tsn->tmn", transport.reshape(*steps, 9), moments).reshape(-1, 3, 3, 4)
    back = rotation_matrix(conjugate(final))
    reach = jnp.einsum("tij,tjkl->tikl", back, first)
    density = inverse @ turns.noise @ inverse.T
    # R D Rᵀ summed over the samples is linear in D: sums of R ⊗ R dt
    weighted = rotation * moments[..., 3, None, None]
    pairs = jnp.einsum("tsm,tsn->tmn", weighted.reshape(*steps, 9), rotation.reshape(*steps, 9))
    spread = jnp.einsum("tijlk,jk->til", pairs.reshape(-1, 3, 3, 3, 3), density)
    covariance = jnp.einsum("tij,tjk,tlk->til", back, spread, back)
    none = turns.output[:, :0], turns.interval[:, :0]
    return CarriedTurns(*none, turns.noise, turns.basis, turns.mask, inverse, offset, final, reach, covariance)
