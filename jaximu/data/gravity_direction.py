"""The gyroscope, integrated over a turn, must carry the direction of gravity from one pose to the next.

r = u_{k+1} − R(b_{k+1} ← b_k) u_k with unit vectors u of the accelerometer (Tedaldi, Pretto, Menegatti, ICRA 2014,
eq. 18). The difference of unit vectors has rank two, so its two components across gravity are kept.
"""

import jax.numpy as jnp
from jaxtyping import Float

from jaximu.ground.array_types import Array
from jaximu.ground.rotation import Quaternion, Vector, conjugate, multiply, rotate, unit_vectors


def level(attitude: Quaternion, force: Vector) -> Quaternion:
    """Return the attitude turned the shortest way so that a specific force measured at rest points up."""
    x, y, z = rotate(attitude, unit_vectors(force))
    half_turn = jnp.array([0.0, 1.0, 0.0, 0.0])  # where it points straight down
    turned = jnp.where(1 + z > 1e-9, jnp.stack([1 + z, y, -x, 0 * z]), half_turn)
    return multiply(unit_vectors(turned), attitude)


def across(basis: Float[Array, "T 2 3"], vectors: Float[Array, "T 3"]) -> Float[Array, "T 2"]:
    """Return the two components of each vector along the rows of `basis`."""
    return jnp.sum(basis * vectors[..., None, :], axis=-1)


def gravity_direction_error(
    rotations: Float[Array, "T 4"], directions: Float[Array, "P 3"], basis: Float[Array, "T 2 3"]
) -> Float[Array, "T 2"]:
    """Return the components across gravity (rad, for small errors) of u_{k+1} − R u_k."""
    return across(basis, directions[..., 1:, :] - rotate(conjugate(rotations), directions[..., :-1, :]))
