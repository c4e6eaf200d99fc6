"""What the report shows of each pose and each turn: errors before and after, and what the noise explains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jaximu.calibration import Calibration
from jaximu.data import forces_and_angles
from jaximu.data.poses import EXCESS_NAMES
from jaximu.ground.array_types import FloatArray
from jaximu.ground.vectors import lengths_of
from jaximu.simulation.protocols.positions import spiral


@dataclass(frozen=True)
class PoseAndTurnErrors:
    """Errors of P poses and T turns, padding removed; turns are numbered by the pose they start from.

    directions: (P, 3) unit vectors of the specific force ("up") in the body. norm_before, norm_after: (P,) magnitude of
    the specific force minus gravity, m/s². norm_noise, norm_sigma: (P,) its standard deviation from the measured noise
    alone, and with the excess. turn: (T,) the pose before. angle_before, angle_after: (T,) deg. angle_noise,
    angle_limit: (T,) deg, below which 95 % of the turns stay by the measured noise alone, and with the excess.
    """

    directions: FloatArray
    norm_before: FloatArray
    norm_after: FloatArray
    norm_noise: FloatArray
    norm_sigma: FloatArray
    turn: NDArray[np.intp]
    angle_before: FloatArray
    angle_after: FloatArray
    angle_noise: FloatArray
    angle_limit: FloatArray


def evidence(calibration: Calibration) -> PoseAndTurnErrors | None:
    """Return the errors by pose and turn; None for a calibration that was loaded without its working."""
    fit, nominal, observations = calibration.fit, calibration.nominal, calibration.observations
    if fit is None or nominal is None or observations is None:
        return None
    poses = np.asarray(observations.poses.mask)
    turns = np.asarray(observations.turns.mask)
    used = turns if "gyroscope" in calibration.triads() else np.zeros_like(turns)
    force_before, angle_before = forces_and_angles(nominal, observations)
    force, angle_after = forces_and_angles(fit.imu, observations)
    length = lengths_of(force)
    directions = force / length[:, None]
    gravity = float(observations.gravity)
    of_poses, of_turns = (calibration.excess.get(name, 0.0) for name in EXCESS_NAMES[:2])

    # noise of each mean in m/s²: along gravity it reaches the norm, across gravity the direction
    inverse = np.linalg.inv(np.asarray(fit.imu.accelerometer.gain))
    covariance = inverse @ np.asarray(observations.poses.accelerometer_covariance) @ inverse.T
    extended = covariance + of_poses * covariance[poses].mean(axis=0)

    def along(matrices: FloatArray) -> FloatArray:
        return np.einsum("pi,pij,pj->p", directions, matrices, directions)

    def tilts(matrices: FloatArray) -> FloatArray:
        tilt = (matrices.trace(axis1=1, axis2=2) - along(matrices)) / 2 / gravity**2
        return tilt[1:] + tilt[:-1]

    noise = tilts(covariance)
    total = tilts(extended)
    if used.any():
        # rotating the rate's white noise along the turn keeps its mean over the three axes
        inverse = np.linalg.inv(np.asarray(fit.imu.triads()["gyroscope"].gain))
        density = (inverse @ np.asarray(observations.turns.noise) @ inverse.T).trace() / 3
        turned = density * np.asarray(observations.turns.interval).sum(axis=1)
        noise = noise + turned
        total = total + turned + of_turns * turned[used].mean()

    def limit(variance: FloatArray) -> FloatArray:
        # two components of equal variance: 95 % of the angles lie below sqrt(5.99) of one's sigma
        return np.degrees(np.sqrt(5.991 * variance[used]))

    return PoseAndTurnErrors(
        directions=directions[poses],
        norm_before=lengths_of(force_before[poses]) - gravity,
        norm_after=length[poses] - gravity,
        norm_noise=np.sqrt(along(covariance)[poses]),
        norm_sigma=np.sqrt(along(extended)[poses]),
        turn=np.flatnonzero(used),
        angle_before=np.degrees(angle_before[used]),
        angle_after=np.degrees(angle_after[used]),
        angle_noise=limit(noise),
        angle_limit=limit(total),
    )


def largest_gap(directions: FloatArray) -> tuple[float, FloatArray]:
    """Return how far (deg) an orientation can lie from every pose, and the direction (3,) where that is so."""
    points = spiral(4000)  # one every 3°
    angles = np.degrees(np.arccos((points @ directions.T).max(axis=1).clip(-1.0, 1.0)))
    worst = int(angles.argmax())
    return angles[worst], points[worst]
