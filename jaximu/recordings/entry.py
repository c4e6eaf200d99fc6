"""`ScheduleEntry`: a pose or a turn, as a schedule, a protocol or a reference has it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaximu.ground.array_types import FloatArray


@dataclass(frozen=True)
class ScheduleEntry:
    """A pose or a turn from `start` to `stop` (s, on the log's clock).

    kind: "pose" or "turn". vector (3,): unit, body frame, "up" or the axis (right-hand rule). angle: rad, of a turn;
    NaN for a full turn whose sense nobody wrote down. heading: rad, of a pose, about "up" from an arbitrary zero, or
    None. label: where it stands, for messages.
    """

    start: float
    stop: float
    kind: str
    vector: FloatArray
    angle: float = 0.0
    heading: float | None = None
    label: str = ""


def times_of(entries: Sequence[ScheduleEntry]) -> FloatArray:
    """Return when entries start and stop, (n, 2) s."""
    return np.array([(entry.start, entry.stop) for entry in entries], float).reshape(-1, 2)
