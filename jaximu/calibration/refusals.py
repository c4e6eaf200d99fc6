"""What is no calibration, and is refused in a sentence that says what to record."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaximu.estimation.fitting import Fit, Prior
from jaximu.estimation.problem import Name
from jaximu.estimation.solver import Failure
from jaximu.estimation.uncertainty import UNDETERMINED
from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.quantities import Z95, number
from jaximu.ground.summary import sentence
from jaximu.recordings.recording import Recording

__all__ = ["refuse_undetermined", "relative_covariance", "require_excited", "require_solved", "require_spanning",
           "same_outputs"]  # fmt: skip


def same_outputs(recordings: Sequence[Recording], alone: bool = False) -> tuple[str, ...]:
    """Raise `InputError` where recordings of one unit have not the same sensors and units.

    Return notes of those that were read in other axes than the first, whose reading a calibration keeps.

    **Arguments:** `alone`: whether a gyroscope without an accelerometer will do.
    """
    if not recordings:
        raise InputError("no recording was given.")
    first = recordings[0]
    lacking = [each for each in recordings if not len(each.accelerometer)]
    if lacking and (not alone or len(lacking) < len(recordings)):
        needed = "the other recording has one" if alone else "one is needed"
        raise InputError(f"{lacking[0].name} has no accelerometer, but {needed}.")
    for other in recordings[1:]:
        for name in ("accelerometer", "gyroscope"):
            a, b = getattr(first, name), getattr(other, name)
            if (a is None) != (b is None):
                raise InputError(
                    f"{(first if a is None else other).name} has no {name}, but the other recording has one."
                )
            if a is not None and (a.unit != b.unit or not np.allclose(a.nominal_scale, b.nominal_scale, rtol=0.2)):
                raise InputError(f"{first.name} and {other.name} give the {name} in different units or scales.")
    axes = [None if recording.reading is None else str(recording.reading.maps) for recording in recordings]
    return tuple(
        f"{recording.name} was read in other axes than {first.name}, whose reading the calibration keeps."
        for recording, other in zip(recordings, axes, strict=True)
        if None not in (axes[0], other) and other != axes[0]
    )


def require_solved(found: Fit, where: str) -> None:
    """Raise `NotPossibleError` where a fit did not end well."""
    if found.failure() is not Failure.NONE:
        raise NotPossibleError(f"{where}: {found.failure().value}.")


def require_excited(found: Fit, where: str, said: str, record: str) -> None:
    """Refuse what is no calibration: of every triad more than half of the parameters left open."""
    covariance = relative_covariance(found)
    parts = []
    for triad in found.model.triads():
        rows = [place for place, name in enumerate(found.names) if name.owner == triad and name.effect is None]
        if not rows:
            continue
        left = _open_directions(covariance, rows)
        if left <= len(rows) // 2:
            return
        parts.append(f"{left} of the {triad}'s {len(rows)} parameters")
    raise NotPossibleError(f"{where}: {said} leave {' and '.join(parts)} open. {record}")


def require_spanning(
    covariance: FloatArray, names: Sequence[Name], poses: int, where: str, sensor: str = "accelerometer"
) -> None:
    """Refuse what is no calibration: more than a third of the accelerometer's parameters left open.

    covariance: (p, p) of the parameters over their typical sizes. sensor: what stands in the accelerometer's place.
    """
    rows = [place for place, name in enumerate(names) if name.owner == "accelerometer"]
    open_directions = _open_directions(covariance, rows)
    if open_directions > len(rows) // 3:
        raise NotPossibleError(
            f"{where}: the {poses} poses found do not span enough orientations: they leave {open_directions} of the "
            f"{sensor}'s {len(rows)} parameters open. Record at least nine poses, each axis pointing up and down "
            "once and some in between, two seconds or more each."
        )


def refuse_undetermined(found: Fit, prior: Prior | None = None, wholly: bool = False) -> None:
    """Raise `NotPossibleError` for a fitted effect that was not told from all else that was fitted.

    An effect of which a prior says something is let through; with `wholly` one of which a part is determined, too.
    """
    known = set() if prior is None else set(prior.names)
    jacobian = np.asarray(found.jacobian)
    for (owner, place), effect in found.model.all_effects().items():
        own = np.array([(name.owner, name.effect) == (owner, place) for name in found.names])
        if not own.any() or any(name in known for name, mine in zip(found.names, own, strict=True) if mine):
            continue
        columns, others = jacobian[:, own], jacobian[:, ~own]
        left = columns - others @ np.linalg.lstsq(others, columns, rcond=1e-10)[0]
        least = np.linalg.svd(left, compute_uv=False)[0 if wholly else -1]
        if not least > 1e-6 * np.linalg.norm(columns):
            raise NotPossibleError(
                f"{sentence(effect.title)} cannot be distinguished here from bias, scale and misalignment"
                f"{' or from the other effects' if len(found.model.all_effects()) > 1 else ''}. Record "
                f"{effect.excited_by}."
            )
        if 1 / least > UNDETERMINED:
            raise NotPossibleError(
                f"{sentence(effect.title)} is hidden in the noise: this recording determines it only to "
                f"±{number(Z95 / least, 2)} times a usual size (95 %). "
                f"Record longer rests and {effect.excited_by}."
            )


def relative_covariance(found: Fit) -> FloatArray:
    """Return the covariance (p, p) of a fit's parameters over their typical sizes."""
    return np.asarray(found.covariance) / found.sizes[:, None] / found.sizes


def _open_directions(covariance: FloatArray, rows: Sequence[int]) -> int:
    """How many directions of these parameters are known no better than from the data sheet."""
    return int(np.sum(np.linalg.eigvalsh(covariance[np.ix_(rows, rows)]) > UNDETERMINED**2))
