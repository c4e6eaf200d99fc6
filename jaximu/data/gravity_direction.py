"""The gyroscope, integrated over a turn, must carry the direction of gravity from one pose to the next.

r = u_{k+1} − R(b_{k+1} ← b_k) u_k with unit vectors u of the accelerometer (Tedaldi, Pretto, Menegatti, ICRA 2014,
eq. 18). The difference of unit vectors has rank two, so its two components across gravity are kept.
"""

import jax.numpy as jnp
from jaxtyping import Float

from jaximu.data.gravity_norm import recover_specific_force
from jaximu.ground.array_types import Array
from jaximu.ground.rotation import conjugate, integrate_rates, multiply, rotate, unit_vectors
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.observations import Observations, Turns


def level(attitude: Float[Array, "4"], force: Float[Array, "3"]) -> Float[Array, "4"]:
    """Return the attitude turned the shortest way so that a specific force measured at rest points up."""
    x, y, z = rotate(attitude, unit_vectors(force))
    half_turn = jnp.array([0.0, 1.0, 0.0, 0.0])  # where it points straight down
    turned = jnp.where(1 + z > 1e-9, jnp.stack([1 + z, y, -x, 0 * z]), half_turn)
    return multiply(unit_vectors(turned), attitude)


def turn_rotations(
    imu: Imu, turns: Turns, method: str = "exponential", stimulus: Stimulus | None = None
) -> Float[Array, "T 4"]:
    """Return the rotation of each turn, a quaternion from the later body frame to the earlier one.

    `stimulus` (T, S): what else the gyroscope's effects need at the samples.
    """
    return integrate_rates(imu.triads()["gyroscope"].recover(turns.output, stimulus), turns.interval, method)


def across(basis: Float[Array, "T 2 3"], vectors: Float[Array, "T 3"]) -> Float[Array, "T 2"]:
    """Return the two components of each vector along the rows of `basis`."""
    return jnp.sum(basis * vectors[..., None, :], axis=-1)


def gravity_direction_error(
    rotations: Float[Array, "T 4"], directions: Float[Array, "P 3"], basis: Float[Array, "T 2 3"]
) -> Float[Array, "T 2"]:
    """Return the components across gravity (rad, for small errors) of u_{k+1} − R u_k."""
    predicted = rotate(conjugate(rotations), directions[..., :-1, :])
    return across(basis, directions[..., 1:, :] - predicted)


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
