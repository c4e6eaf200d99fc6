"""A unit moved about by a robot, and a tracker's report of it; shares no formula with the library.

Angles and positions are sums of sines; the truth is made at 2 kHz and the unit's samples are means of it. What is
hidden in the unit is that of `hidden_effects`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import hidden_effects
import numpy as np
import scipy.signal
import scipy.spatial.transform

GRAVITY = 9.81
FINE = 2000


@dataclass(frozen=True)
class Moved:
    """Unit's samples (time, force output, rate output) and tracker's (time, quaternion w first, velocity, position).

    temperature: of the unit's samples, °C.
    """

    time: np.ndarray
    force: np.ndarray
    rate: np.ndarray
    stamp: np.ndarray
    quaternion: np.ndarray
    velocity: np.ndarray
    position: np.ndarray
    truth: dict
    temperature: np.ndarray


def move(
    seed: int, duration: float = 60.0, rate: float = 100.0, tracked: float = 50.0, delay: float = 0.03,
    drift: float = 0.0, attitude_noise: float = 3e-4, velocity_noise: float = 3e-3, white=(1e-4, 1e-3),
    swing: float = 1.0, g_sensitivity: float = 0.0, arm=(0.0, 0.0, 0.0), lag: float = 0.0, stages: int = 1,
    hidden: Sequence[hidden_effects.Hidden] = (), warming: bool = False,
) -> Moved:  # fmt: skip
    """Move a unit and track it: `delay` (s) by which the tracker's stamps are late, `drift` (1) of the log's clock.

    arm: m, in the tracked body's axes, from the tracked point to the unit. lag: s, time constant of each of the
    `stages` of the tracker's low-pass filter, through which components of its quaternion, position and velocity go; its
    mean delay is part of the true `delay`, and `variance` (s²) is that of its response. hidden: what else the unit
    does; warming: its temperature goes up and down by some 6 °C, else it is 25 °C.
    """
    random = np.random.default_rng(seed)
    time = np.arange(-2 * FINE, (duration + 2) * FINE) / FINE

    def waves(size, slowest, quickest, terms=6):
        """Amplitude, argument and circular frequency of the terms of each axis; `size` of the rate of change."""
        circular = 2 * np.pi * random.uniform(slowest, quickest, (terms, 3))
        argument = time[:, None, None] * circular + random.uniform(0, 2 * np.pi, (terms, 3))
        return size * random.normal(size=(terms, 3)) / np.sqrt(terms) / circular, argument, circular

    amplitude, argument, _ = waves(1.5, 0.03, 0.4)
    angles = swing * (amplitude * np.sin(argument)).sum(axis=1)
    body = scipy.spatial.transform.Rotation.from_euler("ZYX", angles)
    turned = (body[:-1].inv() * body[1:]).as_rotvec() * FINE
    omega = np.vstack([turned, turned[-1:]])
    amplitude, argument, circular = waves(0.3, 0.05, 0.5)
    position = (amplitude * np.sin(argument)).sum(axis=1)
    velocity = (amplitude * circular * np.cos(argument)).sum(axis=1)
    acceleration = -(amplitude * circular**2 * np.sin(argument)).sum(axis=1)
    placed = body.apply(np.asarray(arm, float))
    acceleration = acceleration + np.gradient(np.gradient(placed, 1 / FINE, axis=0), 1 / FINE, axis=0)
    sensed = body.inv().apply(acceleration + [0.0, 0.0, GRAVITY])
    sensed[:-1] = (sensed[:-1] + sensed[1:]) / 2  # means over a step, as the rates are

    mounting = scipy.spatial.transform.Rotation.from_rotvec(random.normal(size=3) * 0.3)  # unit's axes in the body's
    omega, sensed = mounting.inv().apply(omega), mounting.inv().apply(sensed)
    gain_a = np.tril(np.eye(3) + random.normal(scale=5e-3, size=(3, 3)))
    gain_g = np.eye(3) + random.normal(scale=5e-3, size=(3, 3))
    bias_a, bias_g = random.normal(scale=0.05, size=3), random.normal(scale=5e-3, size=3)
    sensitive = g_sensitivity * random.normal(size=(3, 3))
    share = time / duration
    warmth = 25.0 + warming * (6 * np.sin(5.5 * share) + 3 * np.sin(13.0 * share + 1.0))
    added = {(sensor, side): np.zeros_like(omega) for sensor in ("accel", "gyro") for side in ("input", "output")}
    if hidden:
        attitude = (body * mounting).as_matrix()
        world = hidden_effects.World("fit", 1 / FINE, time, attitude, omega, np.gradient(omega, 1 / FINE, axis=0),
                                     sensed, warmth, attitude[:0], np.zeros((0, 2)), duration)  # fmt: skip
        for effect in hidden:
            kind = hidden_effects.KINDS[effect.name]
            added[kind.sensor, kind.at] += effect.added(world)
    force = (sensed + added["accel", "input"]) @ gain_a.T + bias_a + added["accel", "output"]
    read = (omega + added["gyro", "input"]) @ gain_g.T + bias_g + sensed @ sensitive.T + added["gyro", "output"]

    def sampled(values, density):
        size = round(FINE / rate)
        inside = values[2 * FINE : 2 * FINE + round(duration * rate) * size]
        inside = inside.reshape(-1, size, inside.shape[-1]).mean(axis=1)
        return inside + density * np.sqrt(rate) * random.normal(size=inside.shape) if density else inside

    count = round(duration * rate)
    middle = (np.arange(count) + 0.5) / rate
    at = np.arange(1.0, duration - 1.0, 1 / tracked)
    place = np.round((at + 2) * FINE).astype(int)
    kept = np.exp(-1 / (FINE * lag)) if lag else 0.0  # of the filter's state, from one instant to the next

    def said(values):
        for _ in range(stages):
            values = scipy.signal.lfilter([1 - kept], [1, -kept], values - values[0], axis=0) + values[0]
        return values[place]

    quaternions = body.as_quat()
    flips = np.cumprod(np.sign(np.sum(quaternions[1:] * quaternions[:-1], axis=1)))
    quaternions[1:] *= flips[:, None]
    shaken = scipy.spatial.transform.Rotation.from_quat(
        said(quaternions)
    ) * scipy.spatial.transform.Rotation.from_rotvec(attitude_noise * random.normal(size=(len(at), 3)))
    return Moved(
        middle * (1 + drift), sampled(force, white[1]), sampled(read, white[0]), at + delay,
        shaken.as_quat(scalar_first=True), said(velocity) + velocity_noise * random.normal(size=(len(at), 3)),
        said(position) + velocity_noise * random.normal(size=(len(at), 3)),
        {"gain_a": gain_a, "gain_g": gain_g, "bias_a": bias_a, "bias_g": bias_g, "mounting": mounting,
         "delay": delay + stages * kept / (1 - kept) / FINE, "variance": stages * kept / (1 - kept) ** 2 / FINE**2,
         "drift": drift, "g_sensitivity": sensitive, "arm": np.asarray(arm, float)},
        sampled(warmth[:, None], 0.0)[:, 0],
    )  # fmt: skip
