"""At rest the gyroscope gives its bias (and what effects add to it): all poses are used, not the first one alone."""

import jax.numpy as jnp
from jaxtyping import Float

from jaximu.ground.array_types import Array
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.observations import Observations


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
