"""Turns in which samples were lost although the stamps go on evenly, each shown by the rotation that it lacks.

A sample that is lost at t takes ω(t) Δt off its turn: a rotation of known size and direction, but for t. So a loss has
one number to meet two conditions with, and is never the other way round. Where few turns are off and each by just that,
they are left out; an effect would be in all turns.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jaximu.diagnosis.experiment import State
from jaximu.mistakes import Finding

if TYPE_CHECKING:
    from jaximu.diagnosis.hand_held import HandHeld

__all__ = ["finding", "turns_with_losses"]

FloatArray = NDArray[np.float64]
_MOST_LOST = 3
"""Samples in one place of a turn."""
_SURE = 10.0
"""Nats that a loss must gain beyond the choice of its place."""
_FEW = 0.3
"""Share of the turns that may have lost samples for the others to tell."""


def turns_with_losses(experiment: HandHeld, state: State) -> list[int]:
    """Return the turns that lost samples, the surest first; none where too many did, or they are off otherwise.

    Each is taken out of the fit before the next is looked for, which its misfit would hide.
    """
    turns = experiment.observations.turns
    interval, real = np.asarray(turns.interval), np.flatnonzero(turns.mask).tolist()
    gyroscope = state.imu.gyroscope
    assert gyroscope is not None
    lacking = -np.einsum(
        "tasi,tsi->tsa", np.asarray(state.linear.details.reaction.turn),
        (np.asarray(turns.output) - np.asarray(gyroscope.bias)) * (interval > 0)[..., None],
    )  # fmt: skip
    place = np.cumsum(experiment.used) - 1
    first = [len(experiment.observations.poses.mask) + 2 * turn for turn in real]
    columns = {turn: state.weights[:, [place[row], place[row + 1]]] for turn, row in zip(real, first, strict=True)}
    sure = _SURE + np.log(_MOST_LOST * np.sum(interval[real] > 0))
    base, found = state.evidence.jacobian, []
    while len(found) <= _FEW * len(real):
        basis = np.linalg.qr(base)[0]
        left = state.evidence.residual - basis @ (basis.T @ state.evidence.residual)
        best, chosen = sure, None
        for turn in set(real) - set(found):
            own = columns[turn] - basis @ (basis.T @ columns[turn])
            product = lacking[turn] @ (own.T @ left)
            gram = np.sum((lacking[turn] @ own.T) ** 2, axis=1)
            for count in range(1, _MOST_LOST + 1):
                gained = float(np.max(count * product - count**2 * gram / 2))
                if gained > best:
                    best, chosen = gained, turn
        if chosen is None:
            return found
        found.append(chosen)
        base = np.concatenate([base, columns[chosen]], axis=1)
    return []


def finding(experiment: HandHeld, turns: list[int]) -> Finding:
    """Return what is to be said of turns that lost samples."""
    poses = experiment.observations.poses
    start, stop = np.asarray(poses.start), np.asarray(poses.stop)
    where = [f"{stop[turn]:.1f} to {start[turn + 1]:.1f} s" for turn in sorted(turns)[:3]]
    rows = []
    for turn in sorted(turns)[:5]:
        times = [part.recording.accelerometer.time for part in experiment.segmentations
                 if np.any(part.intervals[:, 1] == stop[turn])]  # fmt: skip
        rows += [int(np.searchsorted(time, stop[turn])) + 1 for time in times[:1]]
    return Finding(
        "data.lost_samples", tuple(rows),
        f"{len(turns)} of {int(np.sum(experiment.observations.turns.mask))} turns ({', '.join(where)}"
        f"{' …' if len(turns) > 3 else ''}) lack the rotation of a sample or a few: they were lost although the stamps "
        "go on evenly. These turns are left out. Log the sensor's own stamps or a counter, and look for what holds the "
        "logger up.",
    )  # fmt: skip
