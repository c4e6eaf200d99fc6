"""A tracker's report of a simulated unit, made with scipy: late, mounted askew, tilted, and noisy."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaximu.recordings.attitude import Attitude

LATE, TURNED, TILT, NOISE = 0.0423, np.array([0.4, -1.1, 0.7]), np.array([3e-3, -5e-3]), 1e-3
"""Delay of the stamps, s; rotation vector from the tracked body's axes to the unit's; tilt of its vertical; rad."""
ARM, SPEED_NOISE = np.array([0.08, -0.05, 0.12]), 5e-3
"""From the tracked point to the unit, in the unit's axes, m; noise of the velocity, m/s."""


def tracked(recording, truth, seed: int, noise: float = NOISE, stride: int = 3, moving: bool = False) -> Attitude:
    """Return the attitude of a body on which a simulated unit is mounted, at every so many of its samples.

    moving: with the velocity of the tracked point.
    """
    random = np.random.default_rng([seed, 7])
    time = np.asarray(recording.gyroscope.time)[::stride]
    unit = Rotation.from_quat(np.asarray(truth.stimulus.attitude)[::stride], scalar_first=True)
    seen = Rotation.from_rotvec([*TILT, 0.0]).inv() * unit * Rotation.from_rotvec(TURNED).inv()
    seen = seen * Rotation.from_rotvec(noise * random.standard_normal((len(time), 3)))
    velocity = None
    if moving:
        motion = jax.tree.map(jnp.asarray, truth.case.plan.motion)
        instant = jnp.asarray(time) + 0.5 / truth.case.rate  # the motion begins with the first sample
        speed = np.asarray(jax.jvp(motion.displacement_at, (instant,), (jnp.ones(len(time)),))[1])
        swung = unit.apply(np.cross(np.asarray(truth.stimulus.angular_rate)[::stride], ARM))
        velocity = Rotation.from_rotvec([*TILT, 0.0]).inv().apply(speed - swung)
        velocity += SPEED_NOISE * random.standard_normal(velocity.shape)
    return Attitude(time + LATE, seen.as_quat(scalar_first=True), velocity)
