"""A sequence of positions, each reached from the one before by a rotation about one axis of the unit (S12)."""

import re
from dataclasses import dataclass

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError
from jaximu.simulation.protocols.base import Protocol
from jaximu.simulation.protocols.course import Course, attitude_of

NINETEEN = "y90 y90 y90 y-90 y-90 y-90 z90 x90 x90 x90 x-90 x-90 x-90 z90 z90 z-90 z-90 z-90"
"""The rotations between nineteen positions from which a filter determines a unit."""


def rotation_vector(word: str) -> FloatArray:
    """Return the rotation vector (3,), body frame, rad, of a word such as "x-90". Raises `InputError` for another."""
    match = re.fullmatch(r"([xyz])([+-]?\d+(?:\.\d+)?)", word)
    if match is None or not 0 < abs(float(match[2])) <= 360:
        raise InputError(f"protocol rotations: {word!r} is not an axis and degrees up to 360, such as x-90.")
    return np.radians(float(match[2])) * np.eye(3)["xyz".index(match[1])]


@dataclass(frozen=True)
class Rotations(Protocol):
    """Positions, the first with z up, each held for `duration`, and rotations in between, one word each: axis of the
    unit and degrees about it, "y90 x-180".

    A rotation takes `turn_duration`. The default is the sequence of nineteen positions that PSINS (Yan Gongmin, a
    toolbox for MATLAB) simulates to calibrate a strapdown system as a whole.
    """

    rotations: str = NINETEEN
    duration: float = 20.0
    turn_duration: float = 8.0

    kind = "rotations"
    reference = ("attitude",)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.rotations.split():
            raise InputError('protocol rotations: there is none; write, say, rotations = "y90 x-90".')
        self._vectors()

    def _vectors(self) -> list[FloatArray]:
        return [rotation_vector(word) for word in self.rotations.split()]

    def course(self, rng):
        course = Course(attitude_of(np.array([0.0, 0.0, 1.0])))
        course.rest(self.duration)
        for vector in self._vectors():
            course.turn(vector, self.turn_duration)
            course.rest(self.duration)
        return course
