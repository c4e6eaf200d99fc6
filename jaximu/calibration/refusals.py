"""What is no calibration, and is refused in a sentence that says what to record."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaximu.estimation.fitting import Fit, Prior
from jaximu.estimation.leave_out import off, orthonormal
from jaximu.estimation.problem import Name
from jaximu.estimation.solver import Failure
from jaximu.estimation.uncertainty import UNDETERMINED
from jaximu.ground.array_types import Array, FloatArray
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.quantities import Z95, number, sentence
from jaximu.ground.vectors import submatrix

_LOST = 45.0
"""Degrees, rms, by which a gyroscope that turned with the accelerometer cannot lose gravity over turns."""


def require_determined(
    fitted: Fit, where: str, shown: str = "", record: str = "", prior: Prior | None = None, poses: int | None = None
) -> None:
    """Raise `NotPossibleError` for a fit that is no calibration: left open, not solved, effects not told.

    **Arguments:** `shown`, `record`: what was seen and what to record, for the message; or `poses`, by hand. `prior`:
    what is known of effects beforehand.
    """
    if fitted.finite:  # along directions left open a fit may creep until its steps run out
        if poses is not None:
            require_spanning(relative_covariance(fitted), fitted.names, poses, where)
        elif shown:
            require_excited(fitted, where, shown, record)
    require_solved(fitted, where)
    refuse_undetermined(fitted, prior)


def require_carried(error: float, where: str) -> None:
    """Raise `NotPossibleError` where the fitted gyroscope loses gravity over the turns; `error`: degrees, rms."""
    if error > _LOST:
        raise NotPossibleError(
            f"{where}: no gyroscope explains the turns: gravity carried over them is still off by {error:.0f}° (rms) "
            "after the fit. Check the gyroscope's scale or unit (--gyro-scale, --columns), its axes (--axes) and "
            "its clock, and whether motion between the poses was cut out or the accelerometer smoothed; or leave the "
            "gyroscope out (--method accelerometer)."
        )


def require_solved(fitted: Fit, where: str) -> None:
    """Raise `NotPossibleError` where a fit did not end well."""
    if fitted.failure() is not Failure.NONE:
        raise NotPossibleError(f"{where}: {fitted.failure().value}.")


def require_excited(fitted: Fit, where: str, shown: str, record: str) -> None:
    """Refuse what is no calibration: of every triad more than half of the parameters left open."""
    covariance = relative_covariance(fitted)
    parts = []
    for triad in fitted.imu.triads():
        rows = [index for index, name in enumerate(fitted.names) if name.owner == triad and name.effect is None]
        if not rows:
            continue
        if (left := _open_directions(covariance, rows)) <= len(rows) // 2:
            return
        parts.append(f"{left} of the {triad}'s {len(rows)} parameters")
    raise NotPossibleError(f"{where}: {shown} leave {' and '.join(parts)} open. {record}")


def require_spanning(
    covariance: Array, names: Sequence[Name], poses: int, where: str, sensor: str = "accelerometer"
) -> None:
    """Refuse what is no calibration: more than a third of the accelerometer's parameters left open.

    covariance: (p, p) of the parameters over their typical sizes. sensor: what stands in the accelerometer's place.
    """
    rows = [index for index, name in enumerate(names) if name.owner == "accelerometer"]
    if (open_directions := _open_directions(covariance, rows)) > len(rows) // 3:
        raise NotPossibleError(
            f"{where}: the {poses} poses found do not span enough orientations: they leave {open_directions} of the "
            f"{sensor}'s {len(rows)} parameters open. Record at least nine poses, each axis pointing up and down "
            "once and some in between, two seconds or more each."
        )


def refuse_undetermined(fitted: Fit, prior: Prior | None, wholly: bool = False) -> None:
    """Raise `NotPossibleError` for a fitted effect that was not told from all else that was fitted.

    An effect of which a prior says something is let through; with `wholly` one of which a part is determined, too.
    """
    known = set() if prior is None else set(prior.names)
    jacobian = np.asarray(fitted.jacobian)
    for (owner, position), effect in fitted.imu.all_effects().items():
        members = np.array([name.key == (owner, position) for name in fitted.names])
        if not members.any() or any(name in known for name, mine in zip(fitted.names, members, strict=True) if mine):
            continue
        columns, others = jacobian[:, members], jacobian[:, ~members]
        least = np.linalg.svd(off(orthonormal(others), columns), compute_uv=False)[0 if wholly else -1]
        if not least > 1e-6 * np.linalg.norm(columns):
            raise NotPossibleError(
                f"{sentence(effect.title)} cannot be distinguished here from bias, scale and misalignment"
                f"{' or from the other effects' if len(fitted.imu.all_effects()) > 1 else ''}. Record "
                f"{effect.excited_by}."
            )
        if 1 / least > UNDETERMINED:
            raise NotPossibleError(
                f"{sentence(effect.title)} is hidden in the noise: this recording determines it only to "
                f"±{number(Z95 / least, 2)} times a usual size (95 %). "
                f"Record longer rests and {effect.excited_by}."
            )


def relative_covariance(fitted: Fit) -> FloatArray:
    """Return the covariance (p, p) of a fit's parameters over their typical sizes."""
    return np.asarray(fitted.covariance) / np.outer(fitted.sizes, fitted.sizes)


def _open_directions(covariance: FloatArray, rows: Sequence[int]) -> int:
    """How many directions of these parameters are known no better than from the data sheet."""
    return int((np.linalg.eigvalsh(submatrix(covariance, rows)) > UNDETERMINED**2).sum())
