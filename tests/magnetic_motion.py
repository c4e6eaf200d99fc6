"""A unit turned about in a magnetic field, made with SciPy's rotations alone: truth for tests of magnetometers."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaximu.calibration import Calibration
from jaximu.ground.gravity import STANDARD
from jaximu.model.sensor import Imu
from jaximu.recordings.recording import Recording, Signal

GRAVITY = 9.80665
PERFECT = Calibration(
    Imu.nominal(), (), np.zeros((0, 0)), STANDARD, "definition", "linear", {}, 0, (), {}, "", {}
)  # fmt: skip
"""What is known of accelerometer and gyroscope here: they have no errors but noise."""


class Turned(NamedTuple):
    """What was recorded of a unit, and the truth: gain, bias (µT), the field's strength (µT) and dip (rad)."""

    recording: Recording
    magnetometer: Signal
    gain: np.ndarray
    bias: np.ndarray
    strength: float
    dip: float


def bent(case: Turned, seed: int, share: float = 0.01) -> Recording:
    """What an uncalibrated IMU recorded of it: scale and misalignment off by a share, drawn anew for each number."""
    gyroscope, accelerometer = np.eye(3) + share * np.random.default_rng(seed).standard_normal((2, 3, 3))
    gains = {"gyroscope": gyroscope, "accelerometer": np.tril(accelerometer)}
    signals = {
        name: replace(case.recording.signals[name], values=case.recording.signals[name].values @ gain.T)
        for name, gain in gains.items()
    }
    return replace(case.recording, **signals)


def turned(seed, duration=60.0, reach=np.pi, rate=50.0, noise=0.15, gyroscope_noise=2e-3, disturbed=None, axes=None):
    """Turn a unit by sums of sines, `reach` rad about each axis, slowly enough for gravity to show.

    axes: a signed permutation of the magnetometer's; disturbed: (start, stop) in which something adds 15 µT.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(0, duration, 1 / 200.0)
    angle = np.zeros((len(time), 3))
    for axis in range(3):
        for frequency in rng.uniform(0.01, 0.05, 4):
            wave = np.sin(2 * np.pi * frequency * time + rng.uniform(0, 2 * np.pi))
            angle[:, axis] += reach * rng.uniform(0.5, 1.0) / 2 * wave
    attitude = Rotation.from_euler("ZXY", angle)
    rate_true = (attitude[:-1].inv() * attitude[1:]).as_rotvec() * 200.0
    rate_true = np.vstack([rate_true, rate_true[-1]])
    strength, dip = 48.0, np.radians(62.0)
    field = attitude.inv().apply(strength * np.array([0.0, np.cos(dip), -np.sin(dip)]))
    if disturbed is not None:
        field[(time > disturbed[0]) & (time < disturbed[1])] += [15.0, 0.0, 0.0]
    gain = np.eye(3) + 0.05 * rng.standard_normal((3, 3))
    if axes is not None:
        gain = axes @ gain
    bias = rng.normal(0, 20.0, 3)
    step = round(200.0 / rate)
    output = field[::step] @ gain.T + bias
    output += noise * rng.standard_normal(output.shape)
    force = attitude.inv().apply([0.0, 0.0, GRAVITY])
    force += 0.02 * rng.standard_normal(force.shape)
    measured = rate_true + gyroscope_noise * rng.standard_normal(rate_true.shape)
    recording = Recording(Signal(time, force, "m/s^2"), Signal(time - 0.0025 + 0.005, measured, "rad/s"))
    return Turned(recording, Signal(time[::step], output, "uT"), gain, bias, strength, dip)
