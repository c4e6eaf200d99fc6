"""A measured attitude with its own clock: optics, an inertial system, a robot, a tracker. NumPy, host side."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError
from jaximu.ground.vectors import dot_rows, lengths_of
from jaximu.recordings.recording import whole_stamp

UNIT_LENGTH = 0.01  # off one, of a quaternion that is one
_JUMP = 2.0  # rad; between neighbouring stamps nothing turns so far


@dataclass(frozen=True)
class Attitude:
    """What a reference says of a body, on its own stamps.

    time: (n,) s, rising. quaternion: (n, 4) w, x, y, z, from the body to a frame whose z points up. velocity, position:
    (n, 3) in that frame, m/s and m, or None. start: absolute stamp of t = 0, s, where it has one; stamps that are
    absolute themselves are counted from the first. name: of the file. notes: what reading it had to choose.
    """

    time: FloatArray
    quaternion: FloatArray
    velocity: FloatArray | None = None
    position: FloatArray | None = None
    start: float = 0.0
    name: str = "the reference"
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        length = lengths_of(self.quaternion)
        if (np.abs(length - 1) <= UNIT_LENGTH).mean() < 0.5:
            raise InputError(
                f"{self.name}: its quaternions have the length {np.median(length):.4g} and not 1: the columns are "
                "not a quaternion, or not in this order."
            )
        if not (np.diff(self.time) > 0).all():
            raise InputError(f"{self.name}: the stamps of the reference do not rise.")
        whole = whole_stamp(self.time[0]) if len(self.time) else 0.0
        vars(self).update(time=self.time - whole, start=self.start + whole)

    def usable(self) -> Attitude:
        """Return the rows whose quaternion is one, of length one and without jumps of sign."""
        length = lengths_of(self.quaternion)
        kept = np.abs(length - 1) < UNIT_LENGTH
        vectors = {"velocity": self.velocity, "position": self.position}
        vectors = {name: values[kept] for name, values in vectors.items() if values is not None}
        notes = self.notes
        if not kept.all():
            notes += (f"{self.name}: {(~kept).sum()} of {len(kept)} rows hold no attitude and are left out.",)
        unit = self.quaternion[kept] / length[kept, None]
        flips = np.concatenate([[1.0], np.sign(dot_rows(unit[1:], unit[:-1]) + 1e-12).cumprod()])
        return replace(self, time=self.time[kept], quaternion=unit * flips[:, None], notes=notes, **vectors)

    def rotation(self) -> scipy.spatial.transform.Rotation:
        """Return the rotations from the body to the upright frame."""
        return scipy.spatial.transform.Rotation.from_quat(self.quaternion, scalar_first=True)

    @cached_property
    def at(self) -> scipy.spatial.transform.Slerp:
        """Return, of times (m,) between the first stamp and the last, the rotations from body to upright frame."""
        return scipy.spatial.transform.Slerp(self.time, self.rotation())

    def turned(self) -> FloatArray:
        """Return the rotation vector (n − 1, 3), body frame, from each stamp to the next; NaN over a jump."""
        rotation = self.rotation()
        turned = (rotation[:-1].inv() * rotation[1:]).as_rotvec()
        turned[lengths_of(turned) > _JUMP] = np.nan
        return turned

    @property
    def period(self) -> float:
        """Median time between stamps, s."""
        return float(np.median(np.diff(self.time)))

    def velocities(self) -> FloatArray | None:
        """Return the velocity (n, 3), differentiated where only positions are known; None without either."""
        if self.velocity is not None:
            return self.velocity
        return None if self.position is None else np.gradient(self.position, self.time, axis=0)
