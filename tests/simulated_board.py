"""Recordings of a board: several units that make the same motion in several sessions, with faults of known owners."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from jaximu.model.effects import CATALOGUE
from jaximu.recordings.recording import Recording, Source
from jaximu.simulation import draw_imu, simulate
from jaximu.simulation.protocols import Environment, HandHeld

WHITE = {"accelerometer": 1.0e-3, "gyroscope": 1.0e-4}
"""Density of the noise, m/s²/√Hz and rad/s/√Hz."""
PATTERN = "unit{unit}_session{session}"


def board(
    seed: int,
    units: int,
    sessions: int,
    sensitive: Mapping[int, float],
    warming: Sequence[int],
    *,
    poses: int = 20,
    rest: float = 2.0,
    rate: float = 50.0,
    warm_up: float = 2e-3,
    walk: float = 2e-5,
    latitude: float | None = None,
) -> list[Recording]:
    """Return recordings, session by session, of units from 0 on.

    **Arguments:** `sensitive`: by unit, the size of its g-sensitivity (rad/s per m/s²); `warming`: sessions in which
    all gyroscope axes share a time course of size `warm_up` (rad/s), each with a part of its own; `walk`: random walk
    of each gyroscope axis, rad/s/√s.
    """
    random = np.random.default_rng([seed, 54])
    units_drawn = {}
    for unit in range(units):
        imu = draw_imu(1000 * seed + unit)
        if unit in sensitive:
            matrix = sensitive[unit] * random.standard_normal((3, 3))
            effect = CATALOGUE["gyro.g_sensitivity"].make((np.asarray(imu.gyroscope.gain) @ matrix).ravel())
            imu = replace(imu, gyroscope=replace(imu.gyroscope, effects=(effect,)))
        units_drawn[unit] = imu
    recordings = []
    for session in range(sessions):
        for unit, imu in units_drawn.items():
            silent, _ = simulate(
                imu,
                HandHeld(poses, rest, 1.5),
                None,
                rate=rate,
                seed=[seed, session],
                environment=Environment(latitude=latitude),
            )
            changed = {}
            for name, density in WHITE.items():
                signal = silent.signals[name]
                added = density * np.sqrt(rate) * random.standard_normal(signal.values.shape)
                if name == "gyroscope":
                    added += np.cumsum(walk / np.sqrt(rate) * random.standard_normal(signal.values.shape), axis=0)
                    if session in warming:
                        course = np.exp(-signal.time / (0.3 * signal.time[-1]))
                        added += warm_up * course[:, None] * random.uniform(0.5, 1.5, 3) * random.choice([-1, 1], 3)
                changed[name] = replace(signal, values=signal.values + added)
            source = Source(f"unit{unit + 1}_session{session + 1}.csv", "", len(silent.accelerometer))
            recordings.append(replace(silent, sources=(source,), **changed))
    return recordings
