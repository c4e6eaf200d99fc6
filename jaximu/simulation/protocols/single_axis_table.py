"""A single-axis rate table without north and without levelling (S17)."""

from dataclasses import dataclass

import numpy as np

from jaximu.simulation.protocols.base import Protocol
from jaximu.simulation.protocols.course import Course, attitude_of


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
        course = Course()
        for axis in np.eye(3):
            for up in (axis, -axis):
                course.visit(attitude_of(up), self.mounting_duration)
                course.rest(self.duration)
                course.spin(up, np.pi, np.radians(self.rate), 1.0)
                course.rest(self.duration)
                if up is axis:
                    course.spin(up, 2 * np.pi, np.radians(self.rate), 1.0)
                    course.rest(self.duration, mark=False)
        return course
