"""Units on one rigid body, by hand: each one's poses and turns, and the motion from rest to rest that all share.

Beyond what each unit says by itself, any two agree in three components of every turn and in gravity's direction in
every pose, but for the fixed rotation between them. Of these each other unit adds to the first two components across
gravity a pose and the turn about the vertical, the one component that gravity says nothing of; all others follow from
the units' own conditions. With them the conditions are as many as there are measured numbers less the attitudes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaximu.data.gravity_direction import across
from jaximu.data.poses import EXCESS_NAMES, HandHeldConditions, condense
from jaximu.data.poses_covariance import turn_noise
from jaximu.estimation.covariance import Covariance, mean_root
from jaximu.estimation.data import About, Conditions, OfOneUnit
from jaximu.ground import stored
from jaximu.ground.array_types import Array
from jaximu.ground.rotation import (
    Number,
    conjugate,
    exponential,
    logarithm,
    multiply,
    rotate,
    rotation_matrix,
    unit_vectors,
)
from jaximu.ground.tracing import first, stacked
from jaximu.model.effects.reference_rotation import SetupReferenceRotation
from jaximu.model.sensor import Board, Imu
from jaximu.recordings.observations import Observations

IN_COMMON = "turns, in common"
"""The component of the excess that all units' turns share: what the body does between samples that all take alike."""


class SharedConditions(Conditions):
    """Conditions of U units: each one's own, then gravity's direction and the turns about it against the first's.

    separate: stacked. basis: two directions across gravity in each pose, in the first unit's axes.
    """

    separate: HandHeldConditions
    basis: Float[Array, "P 2 3"]
    magnitude: Number

    def __call__(self, imu: Imu) -> Float[Array, " n"]:
        """Return each unit's conditions, directions (rad), two a pose and other unit, and turns (rad), one each."""
        assert isinstance(imu, Board)
        units = _stacked(imu)
        separate = self.separate.at_magnitude(jnp.broadcast_to(self.magnitude, self.separate.magnitude.shape))
        alone = jax.vmap(lambda conditions, unit: conditions(unit))(separate, units)
        up = unit_vectors(jax.vmap(HandHeldConditions.forces)(separate, units))
        turned = jax.vmap(HandHeldConditions.rotations)(separate, units)
        mounted = exponential(_mountings(imu))[:, None]
        poses, turns = up.shape[1], turned.shape[1]
        others_up = rotate(jnp.broadcast_to(mounted, (*up[1:].shape[:2], 4)), up[1:])
        leaning = jax.vmap(lambda other: across(self.basis, other - up[0]))(others_up)
        mounted = jnp.broadcast_to(mounted, turned[1:].shape)
        others_turned = multiply(multiply(mounted, turned[1:]), conjugate(mounted))
        first_back = jnp.broadcast_to(conjugate(turned[0]), others_turned.shape)
        twisted = (logarithm(multiply(first_back, others_turned)) * up[0, 1:]).sum(axis=-1)
        pose, turn = (mask[1:] & mask[0] for mask in (self.separate.pose, self.separate.turn))
        leaning = jnp.where(pose[..., None], leaning, 0.0).reshape(len(leaning) * poses * 2)
        twisted = jnp.where(turn, twisted, 0.0).reshape(len(twisted) * turns)
        return jnp.concatenate([alone.ravel(), leaning, twisted])


def _stacked(board: Board) -> Imu:
    """Return the units of a board along a leading axis, without effects."""
    return stacked([unit.with_effects() for unit in board.units()])


def _mountings(board: Board) -> Float[Array, "U-1 3"]:
    """Return the rotation vectors from the other units' axes to the first's."""
    return jnp.stack([unit.coefficients(SetupReferenceRotation) for unit in board.others])


@dataclass
class UnitsOnOneBody(OfOneUnit):
    """Observations of U units along a leading axis, cut at the same rests.

    Components of the excess: those of poses and turns, as many times each unit's own noise, alike for all units; and
    what all units' turns have in common, in multiples of the first unit's noise.
    """

    observations: Observations

    effects_inside = True
    excess_names = (*EXCESS_NAMES, IN_COMMON)
    coarse = (0.0,) * 4

    def about_one(self, imu: Imu) -> About:
        """Return the conditions about one board."""
        conditions, covariance = stored.call(_about, "units on one body", imu, self.observations)
        return About(conditions, covariance, np.zeros((len(covariance.used), 0)))


def _about(board: Board, observations: Observations) -> tuple[SharedConditions, Covariance]:
    """Return the conditions about a board and their covariance."""

    def lane(unit):
        conditions, covariance, whole, _ = condense(*unit)
        return conditions, covariance.used, covariance.group, turn_noise(unit[0].gyroscope, unit[1].turns, whole)

    separate, used, group, noise = jax.lax.map(lane, (_stacked(board), observations))
    up = unit_vectors(separate.forces(first(_stacked(board)))[0])
    basis = jnp.linalg.svd(up[:, None, :])[2][:, 1:, :]
    conditions = SharedConditions(separate, basis, observations.gravity[0])
    poses, turns = observations.poses, observations.turns
    units, count, steps = (*poses.mask.shape, turns.mask.shape[1])
    pose, turn = (mask[1:] & mask[0] for mask in (poses.mask, turns.mask))
    used = jnp.concatenate([used.ravel(), pose.ravel().repeat(2), turn.ravel()]).astype(float)
    group = jnp.concatenate([group.ravel(), jnp.zeros(2 * pose.size, int), jnp.ones(turn.size, int)])

    def moved(change):
        means, rests, last = change
        changed = replace(
            separate,
            accelerometer_mean=separate.accelerometer_mean + means,
            gyroscope_mean=separate.gyroscope_mean + rests,
            rotation=multiply(separate.rotation, exponential(last)),
        )
        return replace(conditions, separate=changed)(board)

    none = jnp.zeros((units, count, 3)), jnp.zeros((units, count, 3)), jnp.zeros((units, steps, 3))
    means, rests, last = (used[:, None, None, None] * slopes for slopes in jax.jacfwd(moved)(none))
    measured, factors = 0.0, []
    for reaction, covariance, mask in (
        (means, poses.accelerometer_covariance, poses.mask),
        (last, noise, turns.mask),
        (rests, poses.gyroscope_covariance, poses.mask),
    ):
        measured += jnp.einsum("nupi,upij,mupj->nm", reaction, covariance * mask[..., None, None], reaction)
        roots = jax.vmap(mean_root)(covariance, mask)
        factors.append(jnp.einsum("nupi,uij->nupj", reaction, roots).reshape(len(used), -1))
    back = jnp.concatenate([jnp.eye(3)[None], rotation_matrix(exponential(_mountings(board))).mT])
    together = jnp.einsum("nuti,uij,jk->ntk", last, back, mean_root(noise[0], turns.mask[0]))
    return conditions, Covariance(measured, (*factors, together.reshape(len(used), -1)), used, group)
