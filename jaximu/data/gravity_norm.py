"""At rest the specific force has the magnitude of gravity, whatever the orientation (turntable-free, accelerometer).

Tedaldi, Pretto, Menegatti, ICRA 2014, eq. 10: r = g0² − |f̂|², here over 2 g0, which makes it metres per second
squared: to first order the error of the norm.
"""

import jax.numpy as jnp
from jaxtyping import Float

from jaximu.ground.array_types import Array
from jaximu.ground.rotation import Number
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.observations import Observations, Poses


def recover_specific_force(imu: Imu, poses: Poses, stimulus: Stimulus | None = None) -> Float[Array, "P 3"]:
    """Return each pose's specific force (m/s²) from its mean output; `stimulus` (P,): what else its effects need."""
    known = Stimulus(temperature=poses.temperature) if stimulus is None else stimulus
    return imu.accelerometer.recover(poses.accelerometer_mean, known)


def gravity_norm_error(force: Float[Array, "P 3"], gravity: Number) -> Float[Array, " P"]:
    """Return (g0² − |f̂|²) / 2 g0 in m/s²."""
    return (gravity**2 - jnp.sum(force**2, axis=-1)) / (2 * gravity)


def gravity_norm(
    imu: Imu, observations: Observations, weights: Float[Array, " P"], stimulus: Stimulus | None = None
) -> Float[Array, " P"]:
    """Return the whitened residual of each pose, zero for padding.

    **Arguments:** `weights`: one over the standard deviation of each pose's norm. `stimulus` (P,): what the effects
    need in the poses; without it, the temperature alone.
    """
    error = gravity_norm_error(recover_specific_force(imu, observations.poses, stimulus), observations.gravity)
    return jnp.where(observations.poses.mask, error * weights, 0.0)
