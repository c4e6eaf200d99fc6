"""At rest in one pose."""

from dataclasses import dataclass

from jaximu.ground.errors import InputError
from jaximu.simulation.protocols.base import Protocol, signed
from jaximu.simulation.protocols.course import Course, attitude_of


@dataclass(frozen=True)
class Static(Protocol):
    """At rest for `duration`, with the body vector `up` pointing up: what an Allan deviation is computed from."""

    duration: float = 3600.0
    up: tuple[float, float, float] = signed((0.0, 0.0, 1.0))

    kind = "static"

    def course(self, rng):
        if not any(self.up):
            raise InputError("protocol static: up must not be the zero vector.")
        course = Course(attitude_of(self.up))
        course.rest(self.duration)
        return course
