"""The covariance of the conditions, from the noise of what was measured, and the weights that whiten them.

Noise is measured (the scatter at rest, averaged over a pose or a turn) or known from a model, and has an excess: what
the model misses and what does not average out, the same for every pose and every turn. The excess of the mean
accelerometer outputs, of the turns and of the mean gyroscope outputs at rest are variance components, in multiples of
their mean measured covariance.

Weights are computed at a model close to the solution and held fixed while it is sought: an error of 1 % in the model
changes them by 1 %, and the efficiency of the estimate by its square.
"""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from jaximu.data.preintegration import Turned, turned_by_rates, white_covariance
from jaximu.estimation.covariance import Chain, Covariance, following, in_order, mean_root
from jaximu.ground.array_types import Array
from jaximu.ground.rotation import conjugate, inverse_matrix, rotate, rotation_matrix, unit_vectors
from jaximu.model.sensor import Imu, Triad
from jaximu.recordings.observations import Observations, Turns


class Sensitivities(eqx.Module):
    """How the conditions react to what was measured, to first order (the means at rest react as they are)."""

    norm: Float[Array, "P 3"]  # of a pose's norm to its mean accelerometer output
    after: Float[Array, "T 2 3"]  # of a turn's two components to the mean output of the pose after it
    before: Float[Array, "T 2 3"]  # … and before it
    turn: Float[Array, "T 2 S 3"]  # … and to every sample of the gyroscope during it


def turned_by(gyroscope: Triad, turns: Turns) -> Turned:
    """Return the turns' rotations by the gyroscope's gain and bias."""
    return turned_by_rates(gyroscope.recover(turns.output), turns.interval)


def turn_noise(gyroscope: Triad, turns: Turns, whole: Turned) -> Float[Array, "T 3 3"]:
    """Return the covariance (rad²) of the turns' last frames by the gyroscope's white noise."""
    inverse = inverse_matrix(gyroscope.gain)
    swept = white_covariance(whole.sweep, inverse @ turns.noise @ inverse.T, turns.interval)
    return whole.back @ swept @ whole.back.mT


def _pose_sensitivities(imu: Imu, observations: Observations, rotations: Float[Array, "T 4"]):
    """The norm's and the directions' reaction to mean accelerometer outputs, and each turn's carried direction.

    Effects are not looked at: ∂f/∂y is the inverse of the gain.
    """
    poses, turns = observations.poses, observations.turns
    inverse = imu.accelerometer.inverse()
    force = poses.accelerometer_mean @ inverse[:, :3].T + inverse[:, 3]
    unit, jacobian = unit_vectors(force), inverse[:, :3]
    length = jnp.sqrt((force**2).sum(axis=-1))[:, None, None]
    direction = (jacobian - unit[:, :, None] * (unit @ jacobian)[:, None]) / length
    back = rotation_matrix(conjugate(rotations))
    norm = -(force @ jacobian) / observations.gravity
    after = jnp.einsum("tai,tij->taj", turns.basis, direction[1:])
    before = -jnp.einsum("tai,tij,tjk->tak", turns.basis, back, direction[:-1])
    # A small rotation δ of the last frame moves the carried direction u by −δ × u = u × δ.
    carried = rotate(conjugate(rotations), unit[:-1])
    lever = jnp.cross(carried[:, None, :], turns.basis)  # rows b: b·(u × δ) = (b × u)·δ = −(u × b)·δ
    return norm, after, before, lever


def sensitivities(imu: Imu, observations: Observations, whole: Turned) -> Sensitivities:
    """Return the derivatives of the conditions by mean accelerometer outputs and by gyroscope samples."""
    norm, after, before, lever = _pose_sensitivities(imu, observations, whole.rotation)
    inverse = inverse_matrix(imu.triad("gyroscope").gain)
    return Sensitivities(norm, after, before, (lever[:, None] @ whole.reaction @ inverse).swapaxes(1, 2))


def condition_covariance(imu: Imu, observations: Observations, whole: Turned | None = None) -> Covariance | Chain:
    """Propagate the covariances of what was measured into the conditions at the given model.

    Conditions: norms of P poses, two components of each of T turns, three of each mean gyroscope output at rest.
    Components of the excess: poses, turns, means at rest. A chain, or a whole matrix where slow noise ties all of them.
    `whole`: the turns' rotations at this model, where at hand.
    """
    poses, turns, slow = observations.poses, observations.turns, observations.slow
    gyroscope = imu.triad("gyroscope")
    whole = turned_by(gyroscope, turns) if whole is None else whole
    norm, after, before, lever = _pose_sensitivities(imu, observations, whole.rotation)
    spread = turn_noise(gyroscope, turns, whole)
    real, moved = poses.mask[:, None, None], turns.mask[:, None, None]
    none = jnp.zeros((1, 2, 3))
    # what a pose reaches: its norm and the turn after it, of which the last has none, and the turn before it
    reached = jnp.hstack([real * norm[:, None], jnp.concatenate([moved * before, none])])
    earlier = jnp.pad(jnp.concatenate([none, moved * after]), ((0, 0), (1, 0), (0, 0)))
    by_turn = jnp.pad(jnp.concatenate([moved * lever, none]), ((0, 0), (1, 0), (0, 0)))
    force, rest = (real * noisy for noisy in (poses.accelerometer_covariance, poses.gyroscope_covariance))
    roots = mean_root(force, poses.mask), mean_root(spread, turns.mask), mean_root(rest, poses.mask)
    used = jnp.concatenate([poses.mask, turns.mask.repeat(2), poses.mask.repeat(3)]).astype(norm.dtype)
    counts = len(norm), 2 * len(lever), 3 * len(norm)
    group = jnp.arange(3).repeat(jnp.array(counts), total_repeat_length=sum(counts))
    white = 1.0 if slow is None else 0.0  # slow noise has that of the means in it
    chain = Chain(
        white * (reached @ force @ reached.mT + following(earlier @ force @ earlier.mT))
        + by_turn @ jnp.concatenate([spread, jnp.zeros((1, 3, 3))]) @ by_turn.mT,
        white * reached @ force @ earlier.mT,
        white * rest,
        reached @ roots[0],
        earlier @ roots[0],
        by_turn @ roots[1],
        real * roots[2],
        used,
        group,
    )
    if slow is None:
        return chain

    def by_forces(matrix, axis):
        """Return what conditions (n, q) react to an axis' mean forces (P, q) with."""
        at = reached[..., axis, None] * matrix[:, None] + following(earlier[..., axis, None] * matrix[:, None])
        return in_order(at, jnp.zeros_like(at))

    member = slow.part[..., None] == jnp.arange((slow.gyroscope.shape[-1] - len(norm)) // len(lever))
    by_part = jnp.einsum("tsb,tsij->tbij", member.astype(norm.dtype), whole.reaction)
    by_part = (lever[:, None] @ by_part @ inverse_matrix(gyroscope.gain)).swapaxes(1, 2)

    def by_rates(matrix, axis):
        """The same to an axis' mean rates (I, q), of all poses and then of the parts of each turn."""
        means, during = jnp.split(matrix, [len(norm)])
        during = jnp.einsum("tkb,tbq->tkq", by_part[..., axis], during.reshape(len(lever), -1, matrix.shape[1]))
        at = jnp.pad(during, ((0, 1), (1, 0), (0, 0)))
        return used[:, None] * in_order(at, jnp.eye(3)[axis][:, None] * means[:, None])

    measured = (tied := chain.dense()).measured
    for axis in range(3):
        measured += by_forces(by_forces(slow.accelerometer[axis], axis).T, axis)
        measured += by_rates(by_rates(slow.gyroscope[axis], axis).T, axis)
    return replace(tied, measured=measured)
