"""A random unit and its noise, of consumer grade."""

import jax.numpy as jnp
import numpy as np

from jaximu.ground.precision import require_float64
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.model import Noise, White
from jaximu.model.sensor import Imu, Triad

ACCELEROMETER_DENSITY = 100e-6 * STANDARD_GRAVITY
"""White noise of a consumer accelerometer, 100 µg/√Hz, in m/s² per √Hz, two-sided."""
GYROSCOPE_DENSITY = float(np.radians(0.005))
"""White noise of a consumer gyroscope, 0.005 °/s/√Hz, in rad/s per √Hz, two-sided."""


def draw_imu(
    seed: int, misalignment: float = 0.02, accelerometer_bias: float = 0.3, gyroscope_bias: float = 0.02
) -> Imu:
    """Return a random unit of consumer grade, its errors drawn evenly up to the sizes given.

    Scales and misalignments deviate by up to `misalignment`, biases by so many m/s² and rad/s. The accelerometer's gain
    is lower triangular, which makes its frame the body frame.
    """
    rng = np.random.default_rng((seed, 0))
    accelerometer = np.eye(3) + np.tril(rng.uniform(-misalignment, misalignment, (3, 3)))
    gyroscope = np.eye(3) + rng.uniform(-misalignment, misalignment, (3, 3))
    biases = rng.uniform(-1.0, 1.0, (2, 3)) * np.array([[accelerometer_bias], [gyroscope_bias]])
    require_float64()
    return Imu(
        Triad(jnp.asarray(accelerometer), jnp.asarray(biases[0])),
        Triad(jnp.asarray(gyroscope), jnp.asarray(biases[1]), quantity="angular_rate", output_unit="rad/s"),
    )


def consumer_noise() -> dict[str, Noise]:
    """Return white noise of 100 µg/√Hz and 0.005 °/s/√Hz (two-sided), for both triads."""
    return {
        "accelerometer": Noise((White(ACCELEROMETER_DENSITY),), "specific_force"),
        "gyroscope": Noise((White(GYROSCOPE_DENSITY),), "angular_rate"),
    }
