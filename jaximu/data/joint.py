"""Joint maximum likelihood of accelerometer, gyroscope and all attitudes, the attitudes eliminated.

Unknown are the sensor's parameters and each pose's attitude; measured are the mean outputs at rest and the rotation of
each turn. Headings are fixed by nothing but the turns and take up one component of each; the direction of gravity in a
pose has two more unknowns. Eliminating them leaves, per pose, the norm of the specific force and, per turn, two
components of carried gravity: the residuals of the two-step method, but now functions of all parameters and, since
neighbouring turns share a pose, correlated. Whitened with their full covariance (`jaximu.data.poses_covariance`) they
are the maximum-likelihood problem to first order in the noise (Gauss–Helmert model; Förstner and Wrobel,
Photogrammetric Computer Vision, 2016, sec. 4.8); the second order is the noise squared, 1e-8.
"""

import jax.numpy as jnp
from jaxtyping import Float

from jaximu.data.gravity_direction import gravity_direction_error, turn_rotations, unit_vectors
from jaximu.data.gravity_norm import gravity_norm_error, recover_specific_force
from jaximu.ground.array_types import Array
from jaximu.model.sensor import Imu
from jaximu.recordings.observations import Observations

__all__ = ["joint_conditions"]


def joint_conditions(imu: Imu, observations: Observations, method: str = "exponential") -> Float[Array, " n"]:
    """Return the norm conditions (m/s²) of all poses, then the direction conditions (rad) of all turns, unwhitened."""
    poses, turns = observations.poses, observations.turns
    force = recover_specific_force(imu, poses)
    norm = jnp.where(poses.mask, gravity_norm_error(force, observations.gravity), 0.0)
    direction = gravity_direction_error(turn_rotations(imu, turns, method), unit_vectors(force), turns.basis)
    direction = jnp.where(turns.mask[..., None], direction, 0.0)
    return jnp.concatenate([norm, direction.reshape(-1)])
