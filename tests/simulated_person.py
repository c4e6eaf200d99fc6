"""A person who turns a unit by hand, with the mistakes that people make: written without the library's motion or noise.

Attitudes are followed sample by sample: a turn about a fixed axis with a smooth rate, a rest with a trembling hand. The
unit's output is K u + b with white noise and a bias that walks. Some rests are too short, and in some the unit still
turns slowly; `moved` says by how much, for every rest.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from jaximu.recordings.recording import Recording, Signal

GRAVITY = 9.80665


@dataclass
class Person:
    """Who holds the unit. careless: share of the rests that are too short, and as many in which the unit turns."""

    seed: int
    careless: float = 0.12
    rate: float = 100.0
    tremble: float = 0.03  # degrees, rms
    off: float = 6.0  # degrees, rms, by which a pose misses what was asked
    rest: float = 4.0
    moved: list[tuple[float, float, float]] = field(default_factory=list)  # start, stop, degrees turned in between

    def __post_init__(self):
        self.rng = np.random.default_rng([self.seed, 5])
        self.gains = [np.eye(3) + 0.02 * self.rng.standard_normal((3, 3)) for _ in range(2)]
        self.gains[0] = np.tril(self.gains[0])
        self.bias = [0.2 * self.rng.standard_normal(3), np.radians(1.0) * self.rng.standard_normal(3)]
        self.attitude = Rotation.random(rng=self.rng)  # body to level frame
        self.parts: list[tuple[np.ndarray, np.ndarray]] = []
        self.time = 0.0

    def pose(self, up):
        """Turn the unit until about this body direction points up, and rest."""
        self.turn_to(np.asarray(up, float))
        fate = self.rng.random()
        duration = self.rest + 0.5 + self.rng.exponential(0.5)
        slow = 0.0
        if fate < self.careless:
            duration = self.rng.uniform(1.0, 0.8 * self.rest)
        elif fate < 2 * self.careless:
            slow = 10 ** self.rng.uniform(np.log10(0.2), np.log10(5.0))
        start = self.time
        self.hold(duration, slow)
        self.moved.append((start, self.time, slow * duration))

    def turn_to(self, up):
        now = self.attitude.inv().apply([0.0, 0.0, 1.0])
        wanted = Rotation.from_rotvec(np.radians(self.off) * self.rng.standard_normal(3)).apply(up)
        cross = np.cross(now, wanted)
        axis = cross / max(np.linalg.norm(cross), 1e-9)
        about = Rotation.from_rotvec(self.rng.uniform(-0.6, 0.6) * wanted)  # and a twist about the new vertical
        step = Rotation.from_rotvec(-np.arctan2(np.linalg.norm(cross), now @ wanted) * axis) * about
        vector, duration = step.as_rotvec(), self.rng.uniform(1.0, 2.0)
        count = round(duration * self.rate)
        share = (np.arange(count + 1) / count)[:, None]
        self.follow(self.attitude * Rotation.from_rotvec((10 * share**3 - 15 * share**4 + 6 * share**5) * vector))

    def hold(self, duration, slow):
        count = round(duration * self.rate)
        seconds = np.arange(count + 1)[:, None] / self.rate
        shake = np.zeros((count + 1, 3))
        for frequency in (2.0, 5.0, 9.0):  # a trembling hand, starting and ending at rest
            phase = self.rng.uniform(0, 2 * np.pi, 3)
            shake += np.sin(2 * np.pi * frequency * seconds + phase) * self.rng.standard_normal(3)
        fade = np.minimum(1.0, np.minimum(seconds, seconds[::-1]) / 0.3)
        axis = self.rng.standard_normal(3)
        vectors = np.radians(self.tremble) * fade * shake / 2 + np.radians(slow) * seconds * axis / np.linalg.norm(axis)
        self.follow(self.attitude * Rotation.from_rotvec(vectors))

    def follow(self, attitudes):
        """Add the samples of a motion: rates are means over a sample, forces those at its middle."""
        rates = (attitudes[:-1].inv() * attitudes[1:]).as_rotvec() * self.rate
        middle = attitudes[:-1] * Rotation.from_rotvec(rates / self.rate / 2)
        self.parts.append((middle.inv().apply([0.0, 0.0, GRAVITY]), rates))
        self.time += len(rates) / self.rate
        self.attitude = attitudes[-1]

    def recording(self):
        """Return what the logger has by now. The same samples keep the same noise."""
        force, rates = (np.concatenate([part[k] for part in self.parts]) for k in range(2))
        time = np.arange(len(force)) / self.rate
        rng = np.random.default_rng([self.seed, 6])
        noise = rng.standard_normal((len(force), 12))
        signals = []
        for u, gain, bias, white, walk, at, unit in (
            (force, *self._unit(0), 1e-3, 2e-5, 0, "m/s^2"),
            (rates, *self._unit(1), 1e-4, 1e-6, 6, "rad/s"),
        ):
            y = u @ gain.T + bias + white * np.sqrt(self.rate) * noise[:, at : at + 3]
            y += walk / np.sqrt(self.rate) * np.cumsum(noise[:, at + 3 : at + 6], axis=0)
            signals.append(Signal(time, y, unit))
        return Recording(*signals)

    def _unit(self, place):
        return self.gains[place], self.bias[place]
