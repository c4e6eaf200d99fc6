"""Turns of units on one body that were not fitted: how well units calibrated alone and together carry them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from jaximu.calibration import Array, Together, fit_together
from jaximu.data.poses import condensed
from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import rms
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.tracing import stacked
from jaximu.model.effects.reference_rotation import SetupReferenceRotation
from jaximu.model.sensor import Imu
from jaximu.recordings.observations import Observations

FEWEST = 6
"""Turns that all units measured, without which nothing is left to fit once half of them are left out."""


@dataclass(frozen=True)
class LeftOutTurns:
    """Errors (rms, rad) in turns that were not fitted, of units calibrated alone and of units calibrated together.

    count: turns times units. gravity: angle between gravity as carried over a turn and as measured after it. apart:
    angle between a turn as the first unit measured it and as another did. in_common: as of `Together`, the parts' mean.
    """

    count: int
    gravity: tuple[float, float]
    apart: tuple[float, float]
    in_common: float


def leave_out_turns(array: Array, whole: Together, parts: int = 2) -> LeftOutTurns:
    """Fit an array's units alone and together with every second turn left out, and compare both on these; then others.

    **Arguments:** `whole`: the units fitted to all turns; `parts`: of which each is left out once, its turns spread
    evenly in time.

    Raises `NotPossibleError` where less than six turns are measured by all units, or a fit does not converge.
    """
    observations = whole.observations
    measured = np.flatnonzero(np.all(observations.turns.mask, axis=0))
    if len(measured) < FEWEST:
        raise NotPossibleError(
            f"{array.units[0].name}: all units measured {len(measured)} turns from rest to rest; leaving some out "
            f"takes {FEWEST} or more."
        )
    known = np.array([unit.rotation for unit in array.units[1:]])
    errors, common = [], []
    for part in range(parts):
        turns = measured[part::parts]
        fitted = fit_together(array, turns.tolist())
        together = fitted.units_together()
        met = (*_met(fitted.units_alone(), known, observations), *_met(together, _mountings(together), observations))
        errors.append([angle[:, turns].ravel() for angle in met])
        common.append(fitted.in_common)
    joined = [np.concatenate(angles) for angles in zip(*errors, strict=True)]
    alone, apart_alone, together, apart = map(rms, joined)
    return LeftOutTurns(len(joined[0]), (alone, together), (apart_alone, apart), float(np.mean(common)))


def _met(units: Sequence[Imu], mounted: FloatArray, observations: Observations) -> tuple[FloatArray, FloatArray]:
    """By how much (rad) gravity as carried over turns is off (U, T), and turns are off the first's (U − 1, T).

    mounted: quaternions (U − 1, 4), w first, from the first unit's axes to the others'.
    """
    carried = condensed(stacked([unit.with_effects() for unit in units]), observations)
    turned = [Rotation.from_quat(turns, scalar_first=True) for turns in np.asarray(carried.conditions.rotation)]
    apart = []
    for other, quaternion in zip(turned[1:], mounted, strict=True):
        back = Rotation.from_quat(quaternion, scalar_first=True)
        apart.append(((back * turned[0] * back.inv()).inv() * other).magnitude())
    return carried.angle, np.stack(apart)


def _mountings(units: Sequence[Imu]) -> FloatArray:
    """Quaternions (U − 1, 4), w first, from the first unit's axes to the others'."""
    vectors = [unit.coefficients(SetupReferenceRotation) for unit in units[1:]]
    return Rotation.from_rotvec(vectors).inv().as_quat(scalar_first=True)
