"""On a shaker: vibration of several strengths at rest (S22)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaximu.ground.errors import InputError
from jaximu.simulation.protocols.base import Protocol, may_be_zero, signed
from jaximu.simulation.protocols.course import Course, Tone, attitude_of


@dataclass(frozen=True)
class Vibration(Protocol):
    """Each strength in `levels` (rms, m/s²) for `duration`, each after as long a quiet time.

    The shaker moves along the body vector `direction` with equal parts at `frequencies` (Hz), and rocks the unit by
    `rocking` degrees for each m/s² about the same direction. z is up, or the body vector `up`.
    """

    levels: Sequence[float] = (2.0, 5.0, 10.0)
    frequencies: Sequence[float] = (80.0, 230.0)
    duration: float = 60.0
    direction: tuple[float, float, float] = signed((0.0, 0.0, 1.0))
    rocking: float = may_be_zero()
    up: tuple[float, float, float] = signed((0.0, 0.0, 1.0))

    kind = "vibration"

    def course(self, rng):
        if not any(self.up) or not any(self.direction):
            raise InputError("protocol vibration: up and direction must not be the zero vector.")
        course = Course(attitude_of(self.up))
        course.rest((2 * len(self.levels) + 1) * self.duration)
        return course

    def environment(self, environment):
        direction = np.array(self.direction) / np.linalg.norm(self.direction)
        tones = []
        for index, level in enumerate(self.levels):
            amplitude = level * np.sqrt(2 / len(self.frequencies))
            start = (2 * index + 1) * self.duration
            for frequency in self.frequencies:
                rocking = np.radians(self.rocking) * amplitude * direction
                tones.append(Tone(frequency, amplitude * direction, rocking, start, start + self.duration))
        return self._own(environment, vibration=tuple(tones))
