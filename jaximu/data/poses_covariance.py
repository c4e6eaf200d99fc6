"""The covariance of the conditions, from the noise of what was measured, and the weights that whiten them.

Noise is measured (the scatter at rest, averaged over a pose or a turn) or known from a model, and has an excess: what
the model misses and what does not average out, the same for every pose and every turn. The excess of the mean
accelerometer outputs, of the turns and of the mean gyroscope outputs at rest are variance components, in multiples of
their mean measured covariance.

Weights are computed at a model close to the solution and held fixed while it is sought: an error of 1 % in the model
changes them by 1 %, and the efficiency of the estimate by its square.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from jaximu.data.gravity_direction import unit_vectors
from jaximu.data.gravity_norm import recover_specific_force, recovery_jacobian
from jaximu.data.preintegration import turned_by_rates
from jaximu.estimation.covariance import BlockFactor, Chain, Covariance, mean_root
from jaximu.ground.array_types import Array
from jaximu.ground.rotation import (
    conjugate,
    inverse_matrix,
    rotate,
    rotation_matrix,
    rotation_vectors,
    running_rotations,
)
from jaximu.model.sensor import Imu
from jaximu.recordings.observations import Observations, Turns

__all__ = [
    "IntegratedTurns",
    "Sensitivities",
    "condition_covariance",
    "integrate_turns",
    "sensitivities",
]


class IntegratedTurns(eqx.Module):
    """Turns integrated at one gyroscope calibration.

    rotation: quaternion from the last body frame to the first; running: after every sample. transport: how the last
    body frame's rotation vector reacts to the rate of every sample (s). noise: covariance (rad²) of that rotation
    vector by white noise.
    """

    rotation: Float[Array, "T 4"]
    running: Float[Array, "T S 4"]
    transport: Float[Array, "T S 3 3"]
    noise: Float[Array, "T 3 3"]


class Sensitivities(eqx.Module):
    """How the conditions react to what was measured, to first order (the means at rest react as they are)."""

    norm: Float[Array, "P 3"]  # of a pose's norm to its mean accelerometer output
    after: Float[Array, "T 2 3"]  # of a turn's two components to the mean output of the pose after it
    before: Float[Array, "T 2 3"]  # … and before it
    turn: Float[Array, "T 2 S 3"]  # … and to every sample of the gyroscope during it


def integrate_turns(imu: Imu, turns: Turns) -> IntegratedTurns:
    """Integrate the turns with the gyroscope's gain and bias.

    How the last frame reacts to the rates: `turned_by_rates`. White rate noise of density N in each sample turns the
    end of the turn by R_k K⁻¹ n dt: the sum of R_k K⁻¹ N K⁻ᵀ R_kᵀ dt over the samples, brought to the last frame.
    """
    assert imu.gyroscope is not None
    vectors = rotation_vectors(imu.gyroscope.recover(turns.output), turns.interval)
    running = running_rotations(vectors)
    final = running[..., -1, :]
    back = rotation_matrix(conjugate(final))
    toward = back[:, None] @ rotation_matrix(running)
    inverse = inverse_matrix(imu.gyroscope.gain)
    density = inverse @ turns.noise @ inverse.T
    noise = jnp.einsum("tsij,tslj,ts->til", toward @ density, toward, turns.interval)
    transport = back[:, None] @ turned_by_rates(running, vectors, turns.interval)
    return IntegratedTurns(final, running, transport, noise)


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


def sensitivities(imu: Imu, observations: Observations, integrated: IntegratedTurns) -> Sensitivities:
    """Return the derivatives of the conditions by mean accelerometer outputs and by gyroscope samples."""
    assert imu.gyroscope is not None
    norm, after, before, lever = _pose_sensitivities(imu, observations, integrated.rotation)
    inverse = inverse_matrix(imu.gyroscope.gain)
    return Sensitivities(norm, after, before, (lever[:, None] @ integrated.transport @ inverse).swapaxes(1, 2))


def condition_covariance(imu: Imu, observations: Observations, integrated: IntegratedTurns | None = None) -> Covariance:
    """Propagate the covariances of what was measured into the conditions at the given model.

    Conditions: norms of P poses, two components of each of T turns, three of each mean gyroscope output at rest.
    Components of the excess: poses, turns, means at rest. `integrated`: the turns at this model, where at hand.
    """
    poses, turns, slow = observations.poses, observations.turns, observations.slow
    count, steps = poses.mask.shape[0], turns.mask.shape[0]
    integrated = integrate_turns(imu, turns) if integrated is None else integrated
    norm, after, before, lever = _pose_sensitivities(imu, observations, integrated.rotation)

    pose, step = jnp.arange(count), jnp.arange(steps)
    rows = count + 2 * step[:, None] + jnp.arange(2)
    at_rest = count + 2 * steps + 3 * pose[:, None] + jnp.arange(3)
    size = 4 * count + 2 * steps
    used = jnp.concatenate([poses.mask, jnp.repeat(turns.mask, 2), jnp.repeat(poses.mask, 3)]).astype(norm.dtype)
    # what a pose reaches: its norm, the turn before it and the turn after it, of which the ends have one alone
    before_it, after_it = ((1, 0), (0, 0)), ((0, 1), (0, 0))
    no_axis = ((0, 0),)
    reached = BlockFactor(
        jnp.concatenate([pose[:, None], jnp.pad(rows, before_it), jnp.pad(rows, after_it)], axis=1),
        jnp.concatenate(
            [norm[:, None], jnp.pad(after, (*before_it, *no_axis)), jnp.pad(before, (*after_it, *no_axis))], axis=1
        ),
    ).of_rows(used)
    turned = BlockFactor(rows, lever).of_rows(used)
    means = BlockFactor(at_rest, jnp.broadcast_to(jnp.eye(3), (count, 3, 3))).of_rows(used)
    factors = tuple(
        BlockFactor(each.rows, each.values @ mean_root(covariance, mask))
        for each, covariance, mask in (
            (reached, poses.accelerometer_covariance, poses.mask), (turned, integrated.noise, turns.mask),
            (means, poses.gyroscope_covariance, poses.mask),
        )
    )  # fmt: skip
    group = jnp.repeat(jnp.arange(3), jnp.array([count, 2 * steps, 3 * count]), total_repeat_length=size)

    if slow is None:
        earlier = jnp.concatenate([jnp.zeros_like(after[:1]), after])
        before = jnp.concatenate([before, jnp.zeros_like(before[:1])])
        lever = jnp.concatenate([lever, jnp.zeros_like(lever[:1])])
        real, real_turn = used[:count], jnp.concatenate([used[count : count + 2 * steps : 2], jnp.zeros(1)])
        blank = jnp.zeros_like(norm[:, None])
        own = jnp.concatenate([norm[:, None] * real[:, None, None], before * real_turn[:, None, None]], axis=1)
        shifted = jnp.concatenate([jnp.zeros(1), real_turn[:-1]])
        earlier = jnp.concatenate([blank, earlier * shifted[:, None, None]], axis=1)
        turned = jnp.concatenate([blank, lever * real_turn[:, None, None]], axis=1)
        noise = jnp.concatenate([integrated.noise, jnp.zeros_like(integrated.noise[:1])])
        at_pose, at_turn = (
            mean_root(covariance, mask)
            for covariance, mask in ((poses.accelerometer_covariance, poses.mask), (integrated.noise, turns.mask))
        )
        reached = earlier @ poses.accelerometer_covariance @ earlier.swapaxes(1, 2)
        diagonal = own @ poses.accelerometer_covariance @ own.swapaxes(1, 2)
        diagonal += jnp.concatenate([reached[1:], jnp.zeros_like(reached[:1])]) + turned @ noise @ turned.swapaxes(1, 2)
        rested = jnp.broadcast_to(mean_root(poses.gyroscope_covariance, poses.mask), (count, 3, 3))
        return Chain(
            diagonal,
            own @ poses.accelerometer_covariance @ earlier.swapaxes(1, 2),
            real[:, None, None] * poses.gyroscope_covariance,
            own @ at_pose,
            earlier @ at_pose,
            turned @ at_turn,
            real[:, None, None] * rested,
            used,
            group,
        )

    def spread(total, blocks, covariance):
        """Add to the covariance (n, n) of all conditions what blocks reach of covariances (B, 3, 3)."""
        own = blocks.values @ covariance @ blocks.values.swapaxes(1, 2)
        return total.at[blocks.rows[:, :, None], blocks.rows[:, None, :]].add(own)

    measured = spread(jnp.zeros((size, size)), turned, integrated.noise)
    if slow is None:
        own = jnp.where(poses.mask[:, None, None], poses.gyroscope_covariance, 0.0)
        measured = spread(spread(measured, means, own), reached, poses.accelerometer_covariance)
        return Covariance(measured, factors, used, group)

    intervals = slow.gyroscope.shape[-1]
    parts = (intervals - count) // steps
    inverse = inverse_matrix(imu.gyroscope.gain)  # pyright: ignore[reportOptionalMemberAccess]
    member = (slow.part[..., None] == jnp.arange(parts)).astype(norm.dtype)
    transport = jnp.einsum("tsb,tsij->tbij", member, integrated.transport)
    by_part = (lever[:, None] @ transport @ inverse).swapaxes(1, 2)

    def by_forces(matrix, axis):
        """Return what conditions (n, q) react to an axis' mean forces (P, q) with."""
        values = reached.values[..., axis, None] * matrix[:, None]
        return jnp.zeros((size, matrix.shape[1])).at[reached.rows].add(values)

    def by_rates(matrix, axis):
        """The same to an axis' mean rates (I, q), of all poses and then of the parts of each turn."""
        during = matrix[count:].reshape(steps, parts, -1)
        found = jnp.zeros((size, matrix.shape[1])).at[rows].set(jnp.einsum("tkb,tbq->tkq", by_part[..., axis], during))
        return used[:, None] * found.at[at_rest[:, axis]].set(matrix[:count])

    for axis in range(3):
        measured += by_forces(by_forces(slow.accelerometer[axis], axis).T, axis)
        measured += by_rates(by_rates(slow.gyroscope[axis], axis).T, axis)
    return Covariance(measured, factors, used, group)
