"""A rate table with a vertical axis: each sensor axis up, several rates, both senses (S9)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaximu.simulation.protocols.base import Protocol
from jaximu.simulation.protocols.course import Course, attitude_of

__all__ = ["RateTable"]


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
        course = Course(attitude_of(np.eye(3)[0]))
        for axis in range(3):
            if axis:
                course.to(attitude_of(np.eye(3)[axis]), self.mounting_duration)
            course.rest(self.rest_duration)
            for rate in self.rates:
                for sign in (1.0, -1.0):
                    turn(
                        course,
                        sign * np.eye(3)[axis],
                        2 * np.pi * self.revolutions,
                        np.radians(rate),
                        self.ramp_duration,
                    )
                    course.rest(self.rest_duration)
        return course


def turn(course: Course, axis: np.ndarray, angle: float, rate: float, ramp_duration: float) -> None:
    """Turn by `angle` (rad) about `axis` at the constant `rate` (rad/s), coming up to it within `ramp_duration` (s).

    Where the angle is too small to reach the rate, the ramps meet.
    """
    duration = max(angle / rate + ramp_duration, 2 * ramp_duration)
    course.turn(angle * axis, duration, ramp_duration / duration)
