"""A tiltable dividing head used as a manual two-axis table: one mounting (S16, Wuhan University, CSNC 2011)."""

from dataclasses import dataclass

import numpy as np

from jaximu.simulation.protocols.base import Protocol
from jaximu.simulation.protocols.course import Course, attitude_of

_POSITIONS = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0))


@dataclass(frozen=True)
class DividingHead(Protocol):
    """Five positions for the accelerometer (z is never upside down) and six turns for the gyroscope.

    Every position is held for `duration`. Each axis, pointing up, is turned by `angle` degrees one way and back, below
    30 °/s and within 10 s, as by hand: in `turn_duration` with the rate rising over a fifth of it.
    """

    duration: float = 60.0
    angle: float = 180.0
    turn_duration: float = 9.0

    kind = "dividing-head"
    reference = ("attitude",)

    def course(self, rng):
        course = Course()
        for index, up in enumerate(_POSITIONS):
            course.visit(attitude_of(up), self.turn_duration)
            course.rest(self.duration)
            if index < 3:  # z, x and y are up
                for sign in (1.0, -1.0):
                    course.turn(sign * np.radians(self.angle) * np.array(up), self.turn_duration, 0.2)
                    course.rest(self.duration)
        return course
