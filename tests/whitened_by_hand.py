"""The residuals of poses and turns one by one and whitened, as a function of the unit and of all samples: the slow way.

The library condenses the samples first (`jaximu.data.poses`); these say what its conditions must be.
"""

import jax.numpy as jnp
from jaxtyping import Float

from jaximu.data.gravity_direction import gravity_direction_error
from jaximu.data.gravity_norm import recover_specific_force
from jaximu.ground.array_types import Array
from jaximu.ground.rotation import integrate_rates, unit_vectors
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.observations import Observations, Turns


def turn_rotations(
    imu: Imu, turns: Turns, method: str = "exponential", stimulus: Stimulus | None = None
) -> Float[Array, "T 4"]:
    """Return the rotation of each turn, a quaternion from the later body frame to the earlier one.

    `stimulus` (T, S): what else the gyroscope's effects need at the samples.
    """
    return integrate_rates(imu.triads()["gyroscope"].recover(turns.output, stimulus), turns.interval, method)


def gravity_direction(
    imu: Imu,
    observations: Observations,
    directions: Float[Array, "P 3"] | None,
    weights: Float[Array, "T 2 2"],
    method: str = "exponential",
    stimulus: Stimulus | None = None,
    during: Stimulus | None = None,
) -> Float[Array, " 2*T"]:
    """Return the whitened residual of each turn, two components after another, zero for padding.

    **Arguments:**

    - `directions`: unit vectors of gravity in the poses if the accelerometer is calibrated already (the two-step
      method), else None to take them from `imu`.
    - `weights`: the inverse Cholesky factor of each turn's covariance.
    - `method`: how rates are integrated, see `jaximu.ground.rotation.integrate_rates`.
    - `stimulus` (P,), `during` (T, S): what else effects need, in the poses and at the samples of the turns.
    """
    if directions is None:
        directions = unit_vectors(recover_specific_force(imu, observations.poses, stimulus))
    turns = observations.turns
    error = gravity_direction_error(turn_rotations(imu, turns, method, during), directions, turns.basis)
    whitened = jnp.sum(weights * error[..., None, :], axis=-1)
    return jnp.where(turns.mask[..., None], whitened, 0.0).reshape(-1)


def static_gyroscope(
    imu: Imu, observations: Observations, weights: Float[Array, "P 3 3"], stimulus: Stimulus | None = None
) -> Float[Array, " 3*P"]:
    """Return the whitened difference of the mean output at rest to the model's, three components after another.

    **Arguments:** `weights`: the inverse Cholesky factor of each mean's covariance. `stimulus` (P,): what the effects
    need in the poses, angular rate included; without it, no rate and the temperature.
    """
    poses = observations.poses
    if stimulus is None:
        stimulus = Stimulus(angular_rate=jnp.zeros_like(poses.gyroscope_mean), temperature=poses.temperature)
    error = jnp.where(poses.mask[..., None], poses.gyroscope_mean - imu.triads()["gyroscope"].respond(stimulus), 0.0)
    return jnp.sum(weights * error[..., None, :], axis=-1).reshape(-1)
