"""A single-axis rate table without north and without levelling (S17)."""

from dataclasses import dataclass

import numpy as np

from jaximu.simulation.protocols.base import Protocol
from jaximu.simulation.protocols.course import Course, attitude_of
from jaximu.simulation.protocols.rate_table import turn

__all__ = ["SingleAxisTable"]


@dataclass(frozen=True)
class SingleAxisTable(Protocol):
    """Twelve stations: each axis up and down, the table at 0° and at 180°; and one full turn about each axis.

    The mean over 0° and 180° cancels the table's tilt and the horizontal part of the Earth's rotation. A station is
    held for `duration`; the full turn goes at `rate` (°/s) while the axis points up; mounting the unit anew takes
    `mounting_duration`.
    """

    duration: float = 60.0
    rate: float = 36.0
    mounting_duration: float = 5.0

    kind = "single-axis-table"
    reference = ("attitude", "table_rate")

    def course(self, rng):
        course = Course(attitude_of(np.eye(3)[0]))
        for axis in range(3):
            for sign in (1.0, -1.0):
                up = sign * np.eye(3)[axis]
                if course.time:
                    course.to(attitude_of(up), self.mounting_duration)
                course.rest(self.duration)
                turn(course, up, np.pi, np.radians(self.rate), 1.0)
                course.rest(self.duration)
                if sign > 0:
                    turn(course, up, 2 * np.pi, np.radians(self.rate), 1.0)
                    course.rest(self.duration, mark=False)
        return course
