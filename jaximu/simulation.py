"""The smallest honest simulation: a unit held still by hand in many orientations, turned in between. NumPy, host side.

`draw_imu` draws a unit, `simulate_hand_held` what it would log and the truth behind it. The motion is what a
calibration by hand needs and nothing else: no vibration, no lever arm, a gravity that does not vary, no Earth rotation.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from jaximu.errors import InputError
from jaximu.problem import require_float64
from jaximu.recording import Recording, Signal
from jaximu.sensor import Imu, Stimulus, Triad
from jaximu.units import STANDARD_GRAVITY

__all__ = ["Truth", "draw_imu", "simulate_hand_held"]

FloatArray = NDArray[np.float64]

ACCELEROMETER_DENSITY = 100e-6 * STANDARD_GRAVITY
"""White noise of a consumer accelerometer, 100 µg/√Hz, in m/s² per √Hz."""
GYROSCOPE_DENSITY = float(np.radians(0.005))
"""White noise of a consumer gyroscope, 0.005 °/s/√Hz, in rad/s per √Hz."""


@dataclass(frozen=True)
class Truth:
    """What a simulated recording was made from.

    intervals: (P, 2) start and stop of each rest (s, on the recording's clock), at the edges of samples.
    attitudes: (P, 4) unit quaternion w, x, y, z of each rest, body to a frame with z up.
    stimulus: what the sensors went through, at sample rate.
    """

    imu: Imu
    intervals: FloatArray
    attitudes: FloatArray
    stimulus: Stimulus


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


def simulate_hand_held(
    imu: Imu,
    seed: int,
    poses: int = 40,
    pose_duration: float = 4.0,
    turn_duration: float = 1.5,
    initial_rest: float = 0.0,
    rate: float = 100.0,
    accelerometer_density: float = ACCELEROMETER_DENSITY,
    gyroscope_density: float = GYROSCOPE_DENSITY,
    gravity: float = STANDARD_GRAVITY,
    temperature: float | Callable[[FloatArray], FloatArray] | None = None,
) -> tuple[Recording, Truth]:
    """Simulate a unit (outputs in SI) that rests in `poses` spread orientations and is turned from one to the next.

    The directions of "up" are spread evenly over the sphere, headings and the order are random. A turn goes about one
    axis, by up to 180°, from rest to rest with the angle of least jerk, s(x) = 10 x³ − 15 x⁴ + 6 x⁵. Sample k stands
    for the time from half a period before its stamp to half a period after. Its angular rate is the mean over that
    time, Log(R_kᵀ R_{k+1})/Δt with the attitudes at both ends, as a gyroscope that integrates gives it; its specific
    force belongs to the stamp. The outputs are `imu.respond` of these, effects included, plus white noise of standard
    deviation N/√Δt. The same arguments give the same recording, bit for bit.

    **Arguments:**

    - `initial_rest`: seconds that the first rest is longer than the others.
    - `accelerometer_density`, `gyroscope_density`: N of the outputs, in m/s² and rad/s per √Hz.
    - `temperature`: °C, a number or a function of the time stamps (n,); None leaves it out of the recording.

    **Returns** the recording and its truth.
    """
    require_float64()
    assert imu.gyroscope is not None
    if (imu.accelerometer.output_unit, imu.gyroscope.output_unit) != ("m/s^2", "rad/s"):
        raise InputError("the simulation knows units whose outputs are in m/s^2 and rad/s only.")
    motion, noise = np.random.default_rng((seed, 1)), np.random.default_rng((seed, 2))
    attitudes = _spread_attitudes(poses, motion)
    turns = (attitudes[:-1].inv() * attitudes[1:]).as_rotvec()  # the axis is the same in the body before and after

    rest, turning = max(1, round(pose_duration * rate)), max(1, round(turn_duration * rate))
    first = np.arange(poses) * (rest + turning) + round(initial_rest * rate)  # first sample of each rest
    last = first + rest  # one past its last sample
    first[0], count = 0, int(last[-1])
    time = np.arange(count) / rate
    angle, angular_rate, angular_acceleration = np.zeros((3, count, 3))  # angle: since the rest before
    edges = np.arange(turning + 1) / turning
    middle = (edges[1:] + edges[:-1]) / 2
    speed = np.diff(_least_jerk(edges)) * rate
    acceleration = (60 * middle - 180 * middle**2 + 120 * middle**3) * (rate / turning) ** 2
    for start, stop, turn in zip(last[:-1], first[1:], turns, strict=True):
        for array, course in (
            (angle, _least_jerk(middle)),
            (angular_rate, speed),
            (angular_acceleration, acceleration),
        ):
            array[start:stop] = course[:, None] * turn
    before = np.searchsorted(first, np.arange(count), side="right") - 1
    at_rest = Rotation.from_quat(attitudes.as_quat()[before])
    force = (at_rest * Rotation.from_rotvec(angle)).inv().apply([0.0, 0.0, gravity])

    warmth = temperature(time) if callable(temperature) else temperature
    warmth = None if warmth is None else np.broadcast_to(warmth, time.shape)
    change = None if warmth is None else np.gradient(warmth, time)
    names = ("specific_force", "angular_rate", "angular_acceleration", "temperature", "temperature_rate", "time")
    fields = zip(names, (force, angular_rate, angular_acceleration, warmth, change, time), strict=True)
    stimulus = Stimulus(**{name: jnp.asarray(field) for name, field in fields if field is not None})  # pyright: ignore[reportArgumentType]
    clean = imu.respond(stimulus)
    accelerometer = np.asarray(clean[0]) + accelerometer_density * np.sqrt(rate) * noise.standard_normal((count, 3))
    gyroscope = np.asarray(clean[1]) + gyroscope_density * np.sqrt(rate) * noise.standard_normal((count, 3))
    recording = Recording(
        Signal(time, accelerometer, "m/s^2"),
        Signal(time, gyroscope, "rad/s"),
        None if warmth is None else Signal(time, warmth, "degC"),
    )
    intervals = np.asarray((np.stack([first, last], axis=1) - 0.5) / rate, np.float64)
    return recording, Truth(imu, intervals, attitudes.as_quat(scalar_first=True), stimulus)


def _least_jerk(x: FloatArray) -> FloatArray:
    return x**3 * (10 - 15 * x + 6 * x**2)


def _spread_attitudes(count: int, rng: np.random.Generator) -> Rotation:
    """Attitudes whose "up" in the body lies on a spiral of equal areas, turned at random, in random order."""
    k = np.arange(count) + 0.5
    height, azimuth = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    across = np.sqrt(1 - height**2)
    spiral = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), height], axis=1)
    up = Rotation.random(None, rng).apply(spiral)
    x, y, z = rng.permutation(up).T
    heading = rng.uniform(-np.pi, np.pi, count)
    # Rz(heading) Ry(−polar angle) Rz(−azimuth) takes `up` to z
    return Rotation.from_euler("ZYZ", np.stack([heading, -np.arccos(np.clip(z, -1, 1)), -np.arctan2(y, x)], axis=1))
