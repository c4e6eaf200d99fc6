"""Truth to recordings: a hand-held unit, turned from pose to pose about its accelerometer. NumPy, host side."""

from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from jaximu.gravity import STANDARD
from jaximu.recording import Recording, Signal
from jaximu.sensor import Imu, Stimulus

__all__ = ["Truth", "draw_imu", "simulate_hand_held"]

FloatArray = NDArray[np.float64]

ACCELEROMETER_DENSITY = 100e-6 * 9.80665  # 100 µg/√Hz in m/s²/√Hz, two-sided
GYROSCOPE_DENSITY = float(np.radians(0.005))  # 0.005 °/s/√Hz in rad/s/√Hz, two-sided


@dataclass(frozen=True)
class Truth:
    """What was simulated.

    imu: the unit. intervals: (P, 2) start and stop (s) of each pose on the recording's clock. up: (P, 3) unit vector of
    the specific force in each pose, body frame. stimulus: specific force (n, 3), angular rate (n, 3) and time (n,) of
    the samples.
    """

    imu: Imu
    intervals: FloatArray
    up: FloatArray
    stimulus: Stimulus


def draw_imu(seed: int, spread: float = 1.0) -> Imu:
    """Return a random unit in SI: gains off by 1 % times `spread`, biases by 0.15 m/s² and 0.01 rad/s (one sigma)."""
    generator = np.random.default_rng([seed, 1])

    def matrix() -> FloatArray:
        return np.eye(3) + spread * generator.normal(0, 0.01, (3, 3))

    nominal = Imu.nominal()
    assert nominal.gyroscope is not None
    values = (np.tril(matrix()), spread * generator.normal(0, 0.15, 3), matrix(), spread * generator.normal(0, 0.01, 3))
    structure = jax.tree.structure(nominal)
    return jax.tree.unflatten(structure, values)


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
    gravity: float = STANDARD.value,
) -> tuple[Recording, Truth]:
    """Simulate poses at rest and smooth turns between them.

    Each turn goes by 60° to 170° about a random axis, with the angle of least jerk, while the unit wobbles by up to 20°
    about another axis. The gyroscope integrates: a sample is the rotation over its interval divided by the interval,
    so the samples' rotation vectors multiply to the true rotation exactly. Specific force is that at mid-interval, which
    is also the time stamp. White noise has σ = N √rate. The same arguments give the same recording.

    **Arguments:** durations in s, `rate` in Hz, densities N two-sided in m/s²/√Hz and rad/s/√Hz (times the mean gain
    for outputs in counts), `gravity` in m/s².
    """
    generator = np.random.default_rng([seed, 2])
    still, moving = round(pose_duration * rate), round(turn_duration * rate)
    first = round(initial_rest * rate)
    attitude = Rotation.random(rng=generator)
    segments = []  # each gives the attitude at half-sample steps, without its last edge
    edges = [0]
    up = []
    for pose in range(poses):
        count = still + (first if pose == 0 else 0)
        up.append(attitude.inv().apply([0.0, 0.0, 1.0]))
        segments.append(np.tile(attitude.as_quat(), (2 * count, 1)))
        edges += [edges[-1] + count]
        if pose == poses - 1:
            break
        axis, wobble = (vector / np.linalg.norm(vector) for vector in generator.normal(size=(2, 3)))
        angle, amplitude = np.radians(generator.uniform(60, 170)), np.radians(generator.uniform(5, 20))
        s = np.arange(2 * moving + 1) / (2 * moving)
        turned = angle * (10 * s**3 - 15 * s**4 + 6 * s**5)
        shaken = amplitude * np.sin(np.pi * s) ** 4  # four: at rest with zero acceleration at both ends
        path = attitude * Rotation.from_rotvec(turned[:, None] * axis) * Rotation.from_rotvec(shaken[:, None] * wobble)
        segments.append(path.as_quat()[:-1])
        attitude = path[-1]
        edges += [edges[-1] + moving]
    at_half_steps = Rotation.from_quat(np.concatenate([*segments, attitude.as_quat()[None]]))
    at_edges, at_middle = at_half_steps[::2], at_half_steps[1::2]
    angular_rate = (at_edges[:-1].inv() * at_edges[1:]).as_rotvec() * rate
    specific_force = at_middle.inv().apply([0.0, 0.0, gravity])
    time = (np.arange(len(angular_rate)) + 0.5) / rate
    stimulus = Stimulus(specific_force=specific_force, angular_rate=angular_rate, time=time)

    signals = {}
    densities = {"accelerometer": accelerometer_density, "gyroscope": gyroscope_density}
    for name, output in zip(densities, imu.respond(stimulus), strict=True):
        if output is None:
            continue
        triad = getattr(imu, name)
        scale = np.linalg.norm(np.asarray(triad.gain), axis=1) if triad.output_unit == "count" else np.ones(3)
        noise = generator.normal(size=(len(time), 3)) * densities[name] * np.sqrt(rate) * scale
        signals[name] = Signal(time, np.asarray(output) + noise, triad.output_unit)
    intervals = np.array(edges, float).reshape(-1, 2) / rate if len(edges) % 2 == 0 else np.empty((0, 2))
    return Recording(**signals), Truth(imu, intervals, np.array(up), stimulus)
