"""The covariance of the residuals, from the noise of what was measured, and the weights that whiten them.

Noise has three parts, each with a variance scale (one when the recording's own noise explains everything): the mean
accelerometer outputs, the turns, and the mean gyroscope outputs at rest. Weights are computed at a model close to the
solution and held fixed while it is sought: an error of 1 % in the model changes them by 1 %, and the efficiency of the
estimate by its square.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from jaximu.observations import Observations
from jaximu.residuals.gravity_direction import unit_vectors
from jaximu.residuals.gravity_norm import recover_specific_force, recovery_jacobian
from jaximu.rotation import conjugate, inverse_matrix, rotate, rotation_matrix, running_rotations
from jaximu.sensor import Imu

__all__ = [
    "ConditionCovariance",
    "condition_covariance",
    "inverse_cholesky",
    "pose_weights",
    "static_weights",
    "turn_weights",
    "variance_scales",
]


class ConditionCovariance(eqx.Module):
    """Covariance of the joint conditions (norms of P poses, then two components of each of T turns), by its origin."""

    accelerometer: Float[Array, "P+2T P+2T"]
    turns: Float[Array, "P+2T P+2T"]
    used: Float[Array, " P+2T"]  # 1 for real rows, 0 for padding

    def total(self, scales: Float[Array, " 3"]) -> Float[Array, "P+2T P+2T"]:
        """Return the covariance at the given scales, with ones on the diagonal of padding rows."""
        both = self.used[:, None] * self.used * (scales[0] * self.accelerometer + scales[1] * self.turns)
        return both + jnp.diag(1 - self.used)


def _turn_covariance(imu: Imu, observations: Observations) -> tuple[Float[Array, "T 4"], Float[Array, "T 3 3"]]:
    """Return each turn's rotation and the covariance (rad²) of its error, a rotation vector in the later body frame.

    White rate noise of density N in each sample turns the end of the turn by R_k K⁻¹ n dt: the sum of
    R_k K⁻¹ N K⁻ᵀ R_kᵀ dt over the samples, brought to the last frame.
    """
    turns = observations.turns
    assert imu.gyroscope is not None
    vectors = imu.gyroscope.recover(turns.output) * turns.interval[..., None]
    running = running_rotations(vectors)
    final = running[..., -1, :]
    inverse = inverse_matrix(imu.gyroscope.gain)
    density = inverse @ turns.noise @ inverse.T
    matrices = rotation_matrix(running)
    first = jnp.einsum("tsij,jk,tslk,ts->til", matrices, density, matrices, turns.interval, optimize="optimal")
    back = rotation_matrix(conjugate(final))
    return final, jnp.einsum("tij,tjk,tlk->til", back, first, back)


def condition_covariance(imu: Imu, observations: Observations) -> ConditionCovariance:
    """Propagate the measured covariances into the joint conditions at the given model."""
    poses, turns = observations.poses, observations.turns
    count, steps = poses.mask.shape[0], turns.mask.shape[0]
    force = recover_specific_force(imu, poses)
    unit = unit_vectors(force)
    jacobian = recovery_jacobian(imu, poses)  # ∂f/∂y
    length = jnp.sqrt(jnp.sum(force**2, axis=-1))[:, None, None]
    direction = (jacobian - unit[..., :, None] * jnp.einsum("pi,pij->pj", unit, jacobian)[:, None, :]) / length
    rotations, turn_noise = _turn_covariance(imu, observations)
    carried = rotate(conjugate(rotations), unit[:-1])
    back = rotation_matrix(conjugate(rotations))

    factor = jnp.linalg.cholesky(poses.accelerometer_covariance)
    pose, step = jnp.arange(count), jnp.arange(steps)
    sensitivity = jnp.zeros((count + 2 * steps, count, 3))
    norm = -jnp.einsum("pi,pij,pjk->pk", force, jacobian, factor) / observations.gravity
    sensitivity = sensitivity.at[pose, pose].set(norm)
    rows = count + 2 * step[:, None] + jnp.arange(2)
    after = jnp.einsum("tai,tij,tjk->tak", turns.basis, direction[1:], factor[1:])
    before = -jnp.einsum("tai,tij,tjk,tkl->tal", turns.basis, back, direction[:-1], factor[:-1])
    sensitivity = sensitivity.at[rows, step[:, None] + 1].set(after)
    sensitivity = sensitivity.at[rows, step[:, None]].set(before)
    flat = sensitivity.reshape(count + 2 * steps, 3 * count)

    # A small rotation δ of the last frame moves the carried direction u by −δ × u = u × δ.
    lever = jnp.cross(carried[:, None, :], turns.basis)  # rows b: b·(u × δ) = (b × u)·δ = −(u × b)·δ
    spread = jnp.einsum("tai,tij,tbj->tab", lever, turn_noise, lever)
    blocks = jnp.zeros_like(flat, shape=(count + 2 * steps,) * 2).at[rows[:, :, None], rows[:, None, :]].set(spread)
    used = jnp.concatenate([poses.mask, jnp.repeat(turns.mask, 2)]).astype(flat.dtype)
    return ConditionCovariance(flat @ flat.T, blocks, used)


def inverse_cholesky(covariance: Float[Array, "... n n"]) -> Float[Array, "... n n"]:
    """Return W with W C Wᵀ = I, lower triangular."""
    factor = jnp.linalg.cholesky(covariance)
    identity = jnp.broadcast_to(jnp.eye(covariance.shape[-1]), covariance.shape)
    return solve_triangular(factor, identity, lower=True)


def pose_weights(covariance: ConditionCovariance, poses: int, scale: Float[Array, ""]) -> Float[Array, " P"]:
    """Return one over the standard deviation of each pose's norm residual."""
    variance = jnp.diagonal(covariance.accelerometer)[:poses]
    return 1 / jnp.sqrt(jnp.where(covariance.used[:poses] > 0, scale * variance, 1.0))


def turn_weights(covariance: ConditionCovariance, poses: int, scales: Float[Array, " 3"]) -> Float[Array, "T 2 2"]:
    """Return the inverse Cholesky factor of each turn's 2×2 covariance, neighbours' correlation left aside."""
    rows = jnp.arange(poses, covariance.used.shape[0]).reshape(-1, 2)
    return inverse_cholesky(covariance.total(scales)[rows[:, :, None], rows[:, None, :]])


def static_weights(observations: Observations, scale: Float[Array, ""]) -> Float[Array, "P 3 3"]:
    """Return the inverse Cholesky factor of each mean gyroscope output at rest."""
    return inverse_cholesky(scale * observations.poses.gyroscope_covariance)


def variance_scales(
    residual: Float[Array, " n"],
    jacobian: Float[Array, "n p"],
    parts: tuple[Float[Array, "n n"], ...],
    scales: Float[Array, " k"],
) -> Float[Array, " k"]:
    """Return improved variance scales of the parts of the noise, at least one each.

    With whitened residual r, Jacobian J and parts V_i (Σ s_i V_i = I on real rows) the scale follows from
    E[rᵀ M s_i V_i M r] = s_i tr(M V_i), M = I − J (JᵀJ)⁻¹ Jᵀ: Helmert's variance components in Förstner's iteration
    (Förstner and Wrobel, 2016, sec. 4.2.4), whose fixed point is the restricted maximum likelihood.
    """
    basis, _ = jnp.linalg.qr(jacobian)
    rest = residual - basis @ (basis.T @ residual)
    updated = []
    for part, scale in zip(parts, scales, strict=True):
        redundancy = jnp.trace(part) - jnp.sum(basis * (part @ basis))
        found = rest @ (part @ rest) / jnp.maximum(redundancy, 1e-9)
        updated.append(jnp.where(redundancy * scale > 0.5, jnp.maximum(scale * found, 1.0), scale))
    return jnp.stack(updated)
