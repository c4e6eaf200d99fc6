"""A rate table with a vertical axis: each sensor axis up, several rates, both senses (S9)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaximu.simulation.protocols.base import Protocol
from jaximu.simulation.protocols.course import Course, attitude_of


@dataclass(frozen=True)
class RateTable(Protocol):
    """Each axis of the unit along the table's vertical axis in turn; at every rate so many `revolutions` each way.

    `rates` in °/s. The table needs `ramp_duration` to come up to its rate and as long to stop, stands for
    `rest_duration` in between, and mounting the unit anew takes `mounting_duration`.
    """

    rates: Sequence[float] = (30.0, 90.0, 180.0)
    revolutions: float = 1.0
    rest_duration: float = 5.0
    ramp_duration: float = 1.0
    mounting_duration: float = 3.0

    kind = "rate-table"
    reference = ("attitude", "table_rate")

    def course(self, rng):
        course = Course()
        for axis in np.eye(3):
            course.visit(attitude_of(axis), self.mounting_duration)
            course.rest(self.rest_duration)
            for rate in np.radians(self.rates):
                for up in (axis, -axis):
                    course.spin(up, 2 * np.pi * self.revolutions, rate, self.ramp_duration)
                    course.rest(self.rest_duration)
        return course
