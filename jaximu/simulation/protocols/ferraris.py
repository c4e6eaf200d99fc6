"""Six positions and three turns, which a person with a box and a table can do (Ferraris, Grimaldi and Parvis, 1995)."""

from dataclasses import dataclass

import numpy as np

from jaximu.simulation.protocols.base import Protocol
from jaximu.simulation.protocols.course import Course, attitude_of


@dataclass(frozen=True)
class Ferraris(Protocol):
    """Each axis up and down, held for `duration`, and one turn by `angle` degrees about each axis while it is up.

    A turn takes `turn_duration`, and so does going to the next position.
    """

    duration: float = 10.0
    angle: float = 360.0
    turn_duration: float = 6.0

    kind = "ferraris"
    reference = ("attitude",)

    def course(self, rng):
        course = Course()
        for axis in np.eye(3):
            for up in (axis, -axis):
                course.visit(attitude_of(up), self.turn_duration)
                course.rest(self.duration)
                if up is axis:
                    course.turn(np.radians(self.angle) * axis, self.turn_duration, 0.2)
                    course.rest(1.0, mark=False)
        return course
