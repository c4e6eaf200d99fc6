"""Known positions on a level table: six, eight, twelve, twenty-four, twenty-six (S8)."""

import itertools
from dataclasses import dataclass

import numpy as np

from jaximu.ground.errors import InputError
from jaximu.simulation.protocols.base import Protocol
from jaximu.simulation.protocols.course import Course, attitude_of

FACES = [sign * np.eye(3)[axis] for axis in range(3) for sign in (1.0, -1.0)]
"""Directions of the axes, up and down."""
_CORNERS = [np.array(signs) / np.sqrt(3) for signs in itertools.product((1.0, -1.0), repeat=3)]
_EDGES = [
    np.array(signs) / np.sqrt(2)
    for signs in itertools.product((1.0, -1.0, 0.0), repeat=3)
    if np.count_nonzero(signs) == 2
]


def directions(count: int) -> list[tuple[np.ndarray, float]]:
    """Return "up" in the body frame and the heading (rad) of each position.

    6: the faces of a cube up; 8: its corners; 12: its edges; 24: each face at four headings; 26: faces, edges, corners.
    """
    schemes = {6: FACES, 8: _CORNERS, 12: _EDGES, 26: FACES + _EDGES + _CORNERS}
    if count == 24:
        return [(up, quarter * np.pi / 2) for up in FACES for quarter in range(4)]
    if count not in schemes:
        raise InputError(f"protocol positions: count must be 6, 8, 12, 24 or 26, found {count}.")
    return [(up, 0.0) for up in schemes[count]]


def spiral(count: int) -> np.ndarray:
    """Return unit vectors (count, 3) spread evenly over the sphere: a spiral that passes equal areas."""
    turn = np.arange(count) + 0.5
    height, azimuth = 1 - 2 * turn / max(count, 1), np.pi * (1 + np.sqrt(5)) * turn
    across = np.sqrt(1 - height**2)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), height], axis=1)


@dataclass(frozen=True)
class Positions(Protocol):
    """`count` known positions, each held for `duration`, reached the shortest way within `turn_duration`."""

    count: int = 6
    duration: float = 10.0
    turn_duration: float = 2.0

    kind = "positions"
    reference = ("attitude",)

    def course(self, rng):
        course = Course()
        for up, heading in directions(self.count):
            course.visit(attitude_of(up, heading), self.turn_duration)
            course.rest(self.duration)
        return course
