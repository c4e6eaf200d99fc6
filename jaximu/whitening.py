"""The covariance of the residuals, from the noise of what was measured, and the weights that whiten them.

Noise is measured (the scatter at rest, averaged over a pose or a turn) and has an excess: what the model misses and
what does not average out, the same for every pose and every turn. The excess of the mean accelerometer outputs, of the
turns and of the mean gyroscope outputs at rest are estimated, in multiples of their mean measured covariance.

Weights are computed at a model close to the solution and held fixed while it is sought: an error of 1 % in the model
changes them by 1 %, and the efficiency of the estimate by its square.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Bool, Float

from jaximu._types import Array
from jaximu.observations import Observations
from jaximu.residuals.gravity_direction import unit_vectors
from jaximu.residuals.gravity_norm import recover_specific_force, recovery_jacobian
from jaximu.rotation import conjugate, inverse_matrix, right_jacobian, rotate, rotation_matrix, running_rotations
from jaximu.sensor import Imu

__all__ = [
    "ConditionCovariance",
    "Sensitivities",
    "condition_covariance",
    "inverse_cholesky",
    "pose_weights",
    "sensitivities",
    "static_covariances",
    "turn_weights",
    "update_excess",
]


class ConditionCovariance(eqx.Module):
    """Covariance of the joint conditions by its origin: norms of P poses, then two components of each of T turns.

    With a noise model (`Observations.slow`) the three components of each mean gyroscope output at rest follow, because
    slow bias ties them to the turns, and `gyroscope` is there.
    """

    measured: Float[Array, "n n"]
    accelerometer: Float[Array, "n n"]  # of a unit excess in every pose
    turns: Float[Array, "n n"]  # of a unit excess in every turn
    used: Float[Array, " n"]  # 1 for real rows, 0 for padding
    gyroscope: Float[Array, "n n"] | None = None  # of a unit excess in every mean at rest

    def total(self, excess: Float[Array, " 3"]) -> Float[Array, "n n"]:
        """Return the covariance at the given excess, with ones on the diagonal of padding rows."""
        total = self.measured + excess[0] * self.accelerometer + excess[1] * self.turns + jnp.diag(1 - self.used)
        return total if self.gyroscope is None else total + excess[2] * self.gyroscope


class Sensitivities(eqx.Module):
    """How the joint conditions react to what was measured, to first order (the means at rest react as they are)."""

    norm: Float[Array, "P 3"]  # of a pose's norm to its mean accelerometer output
    after: Float[Array, "T 2 3"]  # of a turn's two components to the mean output of the pose after it
    before: Float[Array, "T 2 3"]  # … and before it
    turn: Float[Array, "T 2 S 3"]  # … and to every sample of the gyroscope during it


def _mean(covariance: Float[Array, "k n n"], mask: Bool[Array, " k"]) -> Float[Array, "k n n"]:
    """Return the mean covariance of the real entries, for every entry."""
    weight = mask[:, None, None].astype(covariance.dtype)
    mean = jnp.sum(weight * covariance, axis=0) / jnp.maximum(jnp.sum(weight), 1.0)
    return jnp.broadcast_to(mean, covariance.shape)


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


def _pose_sensitivities(imu: Imu, observations: Observations, rotations: Float[Array, "T 4"]):
    """The norm's and the directions' reaction to mean accelerometer outputs, and each turn's carried direction."""
    poses, turns = observations.poses, observations.turns
    force = recover_specific_force(imu, poses)
    unit = unit_vectors(force)
    jacobian = recovery_jacobian(imu, poses)  # ∂f/∂y
    length = jnp.sqrt(jnp.sum(force**2, axis=-1))[:, None, None]
    direction = (jacobian - unit[..., :, None] * jnp.einsum("pi,pij->pj", unit, jacobian)[:, None, :]) / length
    back = rotation_matrix(conjugate(rotations))
    norm = -jnp.einsum("pi,pij->pj", force, jacobian) / observations.gravity
    after = jnp.einsum("tai,tij->taj", turns.basis, direction[1:])
    before = -jnp.einsum("tai,tij,tjk->tak", turns.basis, back, direction[:-1])
    # A small rotation δ of the last frame moves the carried direction u by −δ × u = u × δ.
    carried = rotate(conjugate(rotations), unit[:-1])
    lever = jnp.cross(carried[:, None, :], turns.basis)  # rows b: b·(u × δ) = (b × u)·δ = −(u × b)·δ
    return norm, after, before, lever


def sensitivities(imu: Imu, observations: Observations) -> Sensitivities:
    """Return the derivatives of the joint conditions by mean accelerometer outputs and by gyroscope samples."""
    turns = observations.turns
    assert imu.gyroscope is not None
    vectors = imu.gyroscope.recover(turns.output) * turns.interval[..., None]
    running = running_rotations(vectors)
    final = running[..., -1, :]
    norm, after, before, lever = _pose_sensitivities(imu, observations, final)
    # a rotation vector off by δ turns the frame after it by J_r δ, which the rest of the turn carries to the last frame
    matrices = rotation_matrix(running) @ right_jacobian(vectors)
    inverse = inverse_matrix(imu.gyroscope.gain)
    lever = jnp.einsum("tai,tij->taj", lever, rotation_matrix(conjugate(final)))
    turn = jnp.einsum("tai,tsij,jk,ts->task", lever, matrices, inverse, turns.interval, optimize="optimal")
    return Sensitivities(norm, after, before, turn)


def condition_covariance(imu: Imu, observations: Observations) -> ConditionCovariance:
    """Propagate the covariances of what was measured into the joint conditions at the given model."""
    poses, turns, slow = observations.poses, observations.turns, observations.slow
    count, steps = poses.mask.shape[0], turns.mask.shape[0]
    rotations, turn_noise = _turn_covariance(imu, observations)
    norm, after, before, lever = _pose_sensitivities(imu, observations, rotations)

    pose, step = jnp.arange(count), jnp.arange(steps)
    rows = count + 2 * step[:, None] + jnp.arange(2)
    at_rest = count + 2 * steps + 3 * pose[:, None] + jnp.arange(3)
    size = count + 2 * steps + (0 if slow is None else 3 * count)
    used = jnp.concatenate([poses.mask, jnp.repeat(turns.mask, 2), jnp.repeat(poses.mask, 3)])[:size]
    used = used.astype(norm.dtype)
    reaction = jnp.zeros((size, count, 3)).at[pose, pose].set(norm)
    reaction = reaction.at[rows, step[:, None] + 1].set(after).at[rows, step[:, None]].set(before)
    reaction = used[:, None, None] * reaction

    def of_poses(covariance):
        flat = jnp.einsum("npi,pij->npj", reaction, jnp.linalg.cholesky(covariance)).reshape(size, 3 * count)
        return flat @ flat.T

    def of_turns(covariance):
        spread = jnp.einsum("tai,tij,tbj->tab", lever, covariance, lever)
        blocks = jnp.zeros((size, size)).at[rows[:, :, None], rows[:, None, :]].set(spread)
        return used[:, None] * used * blocks

    def of_means(covariance):
        blocks = jnp.zeros((size, size)).at[at_rest[:, :, None], at_rest[:, None, :]].set(covariance)
        return used[:, None] * used * blocks

    unit = of_poses(_mean(poses.accelerometer_covariance, poses.mask)), of_turns(_mean(turn_noise, turns.mask))
    if slow is None:
        measured = of_poses(poses.accelerometer_covariance) + of_turns(turn_noise)
        return ConditionCovariance(measured, *unit, used)

    intervals = slow.gyroscope.shape[-1]
    parts = (intervals - count) // steps
    by_part = jnp.sum(
        jnp.where(slow.part[:, None, :, None, None] == jnp.arange(parts)[:, None],
                  sensitivities(imu, observations).turn[..., None, :], 0.0), axis=2)  # fmt: skip
    columns = count + parts * step[:, None, None] + jnp.arange(parts)
    rates = jnp.zeros((size, intervals, 3)).at[rows[:, :, None], columns].set(by_part)
    rates = rates.at[at_rest, pose[:, None]].set(jnp.broadcast_to(jnp.eye(3), (count, 3, 3)))
    rates = used[:, None, None] * rates
    measured = of_turns(turn_noise)
    for axis in range(3):
        measured += reaction[..., axis] @ slow.accelerometer[axis] @ reaction[..., axis].T
        measured += rates[..., axis] @ slow.gyroscope[axis] @ rates[..., axis].T
    return ConditionCovariance(measured, *unit, used, of_means(_mean(poses.gyroscope_covariance, poses.mask)))


def inverse_cholesky(covariance: Float[Array, "... n n"]) -> Float[Array, "... n n"]:
    """Return W with W C Wᵀ = I, lower triangular."""
    factor = jnp.linalg.cholesky(covariance)
    identity = jnp.broadcast_to(jnp.eye(covariance.shape[-1]), covariance.shape)
    return solve_triangular(factor, identity, lower=True)


def pose_weights(covariance: ConditionCovariance, poses: int, excess: Float[Array, " 3"]) -> Float[Array, " P"]:
    """Return one over the standard deviation of each pose's norm residual."""
    return 1 / jnp.sqrt(jnp.diagonal(covariance.total(excess))[:poses])


def turn_weights(covariance: ConditionCovariance, poses: int, excess: Float[Array, " 3"]) -> Float[Array, "T 2 2"]:
    """Return the inverse Cholesky factor of each turn's 2×2 covariance, neighbours' correlation left aside."""
    rows = jnp.arange(poses, poses + 2 * (poses - 1)).reshape(-1, 2)
    return inverse_cholesky(covariance.total(excess)[rows[:, :, None], rows[:, None, :]])


def static_covariances(observations: Observations) -> tuple[Float[Array, "P 3 3"], Float[Array, "P 3 3"]]:
    """Return the covariance of each mean gyroscope output at rest, and of a unit excess."""
    poses = observations.poses
    return poses.gyroscope_covariance, _mean(poses.gyroscope_covariance, poses.mask)


def update_excess(
    residual: Float[Array, " n"],
    jacobian: Float[Array, "n p"],
    parts: tuple[Float[Array, "n n"], ...],
    excess: Float[Array, " k"],
) -> Float[Array, " k"]:
    """Return improved multiples of the parts of the covariance, none below zero, by one step of Fisher scoring.

    With whitened residual r, Jacobian J and whitened parts V_i, the restricted likelihood has the gradient
    ½ (rᵀ M V_i M r − tr M V_i) and the information ½ tr(M V_i M V_j), M = I − J (JᵀJ)⁻¹ Jᵀ (variance components;
    Förstner and Wrobel, Photogrammetric Computer Vision, 2016, sec. 4.2.4).
    """
    basis, _ = jnp.linalg.qr(jacobian)
    rest = residual - basis @ (basis.T @ residual)
    projected = [part - basis @ (basis.T @ part) for part in parts]
    gradient = jnp.stack([rest @ (part @ rest) - jnp.trace(m) for part, m in zip(parts, projected, strict=True)])
    information = jnp.stack([jnp.stack([jnp.sum(a * b.T) for b in projected]) for a in projected])
    # A part without rows (no turns, say) has neither gradient nor information: it stays.
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(information), 1e-30))
    normal = information / scale / scale[:, None] + 1e-9 * jnp.eye(len(parts))
    step = jnp.linalg.solve(normal, gradient / scale) / scale
    return jnp.where(jnp.diagonal(information) > 1e-20, jnp.maximum(excess + step, 0.0), excess)
