"""Held still by hand in many orientations, turned in between (S10)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy

from jaximu.simulation.protocols.base import Protocol, may_be_zero
from jaximu.simulation.protocols.course import Course, attitude_of
from jaximu.simulation.protocols.positions import spiral

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class HandHeld(Protocol):
    """`poses` orientations spread evenly over the sphere, headings and order at random.

    Each is held for `pose_duration`, the first for `initial_rest` longer. A turn goes about one axis by up to 180°,
    from rest to rest, in `turn_duration`; meanwhile the unit moves by up to `displacement` (m) in any direction and
    leans aside by up to `bend` (degrees), so that the axis of the turn moves.
    """

    poses: int = 40
    pose_duration: float = 4.0
    turn_duration: float = 1.5
    initial_rest: float = may_be_zero()
    displacement: float = may_be_zero()
    bend: float = may_be_zero()

    kind = "hand-held"

    def course(self, rng):
        first, *others = self._attitudes(rng)
        course = Course(first)
        course.rest(self.pose_duration + self.initial_rest)
        for attitude in others:
            moved = rng.uniform(-1, 1, 3) * self.displacement / np.sqrt(3)
            aside = rng.uniform(-1, 1, 3) * np.radians(self.bend) / np.sqrt(3) if self.bend else np.zeros(3)
            course.to(attitude, self.turn_duration, moved, aside)
            course.rest(self.pose_duration)
        return course

    def _attitudes(self, rng) -> Rotation:
        """Attitudes whose "up" in the body lies on a spiral of equal areas, turned at random, in random order."""
        up = rng.permutation(scipy.spatial.transform.Rotation.random(None, rng).apply(spiral(self.poses)))
        return attitude_of(up, rng.uniform(-np.pi, np.pi, self.poses))
