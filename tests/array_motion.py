"""Units on one rigid body, moved by hand from rest to rest; shares no formula with the library.

Each turn is about one axis of the body with a quintic course, so orientation and rates are exact at every instant; the
truth is made at 2 kHz, and a sample is the mean over its interval.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.spatial.transform

GRAVITY = 9.81
FINE = 2000


@dataclass(frozen=True)
class Unit:
    """A unit's samples (time, force, rate) and how it stands: turned from the body's axes, placed, its clock late.

    gains: (3, 3) of its accelerometer and of its gyroscope.
    """

    time: np.ndarray
    force: np.ndarray
    rate: np.ndarray
    turned: scipy.spatial.transform.Rotation
    place: np.ndarray
    late: float
    gains: tuple[np.ndarray, np.ndarray]


def _course(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Share of a turn that is done, its rate and acceleration per turn time, at `count` instants."""
    x = (np.arange(count) + 0.5) / count
    return x**3 * (10 - 15 * x + 6 * x**2), 30 * x**2 * (1 - x) ** 2, 60 * x * (1 - x) * (1 - 2 * x)


def array(
    seed: int, units: int = 3, poses: int = 16, rest: float = 2.0, turn: float = 1.0, rate: float = 100.0,
    white=(5e-5, 1e-3), late: float = 0.03, together: bool = True,
) -> list[Unit]:  # fmt: skip
    """Move an array about; units' clocks are late by up to `late` s. Not `together`: the last unit moves by itself."""
    random = np.random.default_rng(seed)

    def motion():
        """Orientation (scipy), rate and angular acceleration at 2 kHz."""
        now = scipy.spatial.transform.Rotation.random(random_state=seed)
        quaternions, rates, accelerations = [], [], []
        for _ in range(poses):
            still = round(rest * FINE)
            quaternions.append(np.tile(now.as_quat(), (still, 1)))
            rates.append(np.zeros((still, 3)))
            accelerations.append(np.zeros((still, 3)))
            axis = random.normal(size=3)
            vector = axis / np.linalg.norm(axis) * random.uniform(1.2, 2.6)
            count = round(turn * FINE)
            done, speed, change = _course(count)
            quaternions.append((now * scipy.spatial.transform.Rotation.from_rotvec(done[:, None] * vector)).as_quat())
            rates.append(speed[:, None] * vector / turn)
            accelerations.append(change[:, None] * vector / turn**2)
            now = now * scipy.spatial.transform.Rotation.from_rotvec(vector)
        still = round(2 * rest * FINE)
        quaternions.append(np.tile(now.as_quat(), (still, 1)))
        body = scipy.spatial.transform.Rotation.from_quat(np.concatenate(quaternions))
        none = np.zeros((still, 3))
        return body, np.concatenate([*rates, none]), np.concatenate([*accelerations, none])

    body, omega, alpha = motion()
    found = []
    for number in range(units):
        if number == units - 1 and not together:
            body, omega, alpha = motion()
        turned = scipy.spatial.transform.Rotation.from_rotvec(random.normal(size=3) * (number > 0))
        place = 0.03 * random.normal(size=3) * (number > 0)
        delay = round(late * random.uniform(-1, 1) * FINE) / FINE * (number > 0)
        up = body.inv().apply([0.0, 0.0, GRAVITY])
        sensed = up + np.cross(omega, np.cross(omega, place)) + np.cross(alpha, place)
        force, speed = turned.inv().apply(sensed), turned.inv().apply(omega)
        gain = [np.eye(3) + random.normal(scale=5e-3, size=(3, 3)) for _ in range(2)]
        gain[0] = np.tril(gain[0])
        output = force @ gain[0].T + 0.05 * random.normal(size=3), speed @ gain[1].T + 5e-3 * random.normal(size=3)
        size, shift = round(FINE / rate), round(FINE * 0.5)
        begin = shift - round(delay * FINE)  # stamps are late: at stamp t it was t − delay
        count = (len(omega) - 2 * shift) // size
        samples = [
            each[begin : begin + count * size].reshape(count, size, 3).mean(axis=1)
            + density * np.sqrt(rate) * random.normal(size=(count, 3))
            for each, density in zip(output, white[::-1], strict=True)
        ]
        found.append(Unit((np.arange(count) + 0.5) / rate, *samples, turned, place, delay, (gain[0], gain[1])))
    return found
