"""Units on one rigid body calibrated together: from rest to rest all turn alike, which each of them measures anew.

What the shared motion adds to each unit's own poses and turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np

from jaximu.calibration.array_units import Array
from jaximu.calibration.hand_held import fit_hand_held
from jaximu.calibration.refusals import require_solved
from jaximu.data.array import UnitsOnOneBody
from jaximu.data.by_hand import RecordedByHand
from jaximu.data.poses import EXCESS_NAMES
from jaximu.estimation.fitting import Fit, fit
from jaximu.estimation.problem import Name, without_equipment
from jaximu.ground.precision import require_float64
from jaximu.ground.rotation import rotations_of
from jaximu.ground.tracing import part_of, stacked
from jaximu.model.effects.reference_rotation import SetupReferenceRotation
from jaximu.model.sensor import Board, Imu
from jaximu.recordings.observations import Observations
from jaximu.recordings.segmentation import observed_poses


@dataclass(frozen=True)
class Together:
    """Units of an array calibrated each by itself and together, from the same rests and turns.

    observations: of U units along a leading axis. alone: a fit of each, along that axis. together: one fit of a
    `Board`.
    """

    observations: Observations
    alone: Fit
    together: Fit

    def units_alone(self) -> tuple[Imu, ...]:
        """Return the units, each calibrated by itself."""
        return _units(self.alone)

    def units_together(self) -> tuple[Imu, ...]:
        """Return the units calibrated together; `setup.reference_rotation` says how each is turned to the first."""
        assert isinstance(self.together.imu, Board)
        return self.together.imu.units()

    @property
    def in_common(self) -> float:
        """Share of the variance of turns, beyond the noise at rest, that all units have in common."""
        _, turns, _, common = self.together.excess
        return float(common / max(turns + common, 1e-300))


def fit_together(found: Array, left_out: Sequence[int] = ()) -> Together:
    """Fit the units of an array in one problem: each one's poses and turns, and that all turn alike.

    **Arguments:** `found`: of [`jaximu.calibration.calibrate_array`][]; its rests, rotations and clocks are the start.
    `left_out`: places of turns between the first unit's rests that are not fitted.

    Noise is that of each unit's poses; slow drift that a recording at rest shows is not looked at. Raises
    `NotPossibleError` where the fit does not converge.
    """
    require_float64()
    observations = _observed(found)
    mask = np.array(observations.turns.mask)
    mask[:, list(left_out)] = False
    observations = eqx.tree_at(lambda tree: tree.turns.mask, observations, mask)
    alone = fit_hand_held(stacked([unit.calibration.imu.with_effects() for unit in found.units]), observations)
    back = rotations_of([unit.rotation for unit in found.units]).inv()
    turned = [
        unit.with_effects(SetupReferenceRotation.make(vector))
        for unit, vector in zip(_units(alone), back.as_rotvec(), strict=True)
    ]
    begin, most = np.append(np.median(alone.excess, axis=0), 1.0), np.full(4, np.inf)
    most[-1] = _most_in_common(alone, observations)
    together = fit(Board.of(turned), UnitsOnOneBody(observations), _free, excess=begin, most=most, follow=True)
    require_solved(together, ", ".join(unit.name for unit in found.units))
    return Together(observations, alone, together)


def _observed(array: Array) -> Observations:
    """Return what all units measured of the first one's rests and the turns between them, along a leading axis."""
    rests = array.units[0].calibration.segmentations[0].intervals
    for unit in array.units:
        time = unit.calibration.segmentations[0].recording.accelerometer.time - unit.time_offset
        rests = rests[(rests[:, 0] > time[0]) & (rests[:, 1] < time[-1])]
    parts = [replace(unit.calibration.segmentations[0], intervals=rests + unit.time_offset) for unit in array.units]
    gravity = array.gravity.value
    samples = max(observed_poses(part, gravity).turns.output.shape[1] for part in parts)
    observed = []
    for part, unit in zip(parts, array.units, strict=True):
        observations = observed_poses(part, gravity, bucket=(len(rests), samples))
        imu = unit.calibration.imu
        if effects := tuple(imu.all_effects().values()):
            observations = RecordedByHand((part,), observations).along(imu, effects).observations
        observed.append(observations)
    return stacked(observed)


def _units(fitted: Fit) -> tuple[Imu, ...]:
    """Return the units of a fit along a leading axis."""
    count = len(fitted.values)
    return tuple(part_of(fitted.imu, k) for k in range(count))


def _most_in_common(alone: Fit, observations: Observations) -> float:
    """Return the most that turns can have in common, in multiples of the first unit's noise: what a unit alone shows.

    A few turns would else do without a maximum of the likelihood: the gains that all units share run after this size.
    """
    back = np.linalg.inv(alone.imu.triad("gyroscope").gain)
    noise = (back @ observations.turns.noise @ back.mT).trace(axis1=1, axis2=2)
    return float((alone.excess[:, EXCESS_NAMES.index("turns")] * noise).max() / noise[0])


def _free(name: Name) -> bool:
    """Return whether a number of a board is free: each unit's as by hand, and how it is turned."""
    triad = name.owner.rpartition(".")[2]
    return triad == "setup" or without_equipment(Name(triad, name.part, name.axes))
