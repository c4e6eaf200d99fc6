"""What the report shows about each pose and each turn: errors before and after, and what the noise explains. Pure numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jaximu import stored
from jaximu.calibration import Calibration
from jaximu.observations import Observations
from jaximu.residuals import turn_angle_errors
from jaximu.residuals.gravity_norm import recover_specific_force
from jaximu.sensor import Imu
from jaximu.whitening import condition_covariance

__all__ = ["Evidence", "evidence", "largest_gap", "nearest_angles"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Evidence:
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


def evidence(calibration: Calibration) -> Evidence | None:
    """Return the errors by pose and turn; None for a calibration that was loaded without its working."""
    fit, nominal, observations = calibration.fit, calibration.nominal, calibration.observations
    if fit is None or nominal is None or observations is None:
        return None
    poses, turns = np.asarray(observations.poses.mask), np.asarray(observations.turns.mask)
    count = len(poses)
    force_before, angle_before, *_ = _of(nominal, observations, fit.excess)
    force, angle_after, noise, total = _of(fit.model, observations, fit.excess)
    length = np.linalg.norm(force[poses], axis=1)
    gravity = float(observations.gravity)
    used = turns if calibration.imu.gyroscope is not None else np.zeros_like(turns)

    def limit(variance: FloatArray) -> FloatArray:
        # two components of equal variance: 95 % of the angles lie below sqrt(5.99) of one's sigma
        mean = variance[count:].reshape(-1, 2).mean(axis=1)[used]
        return np.degrees(np.sqrt(5.991 * mean))

    return Evidence(
        directions=force[poses] / length[:, None],
        norm_before=np.linalg.norm(force_before[poses], axis=1) - gravity,
        norm_after=length - gravity,
        norm_noise=np.sqrt(noise[:count][poses]),
        norm_sigma=np.sqrt(total[:count][poses]),
        turn=np.flatnonzero(used),
        angle_before=np.degrees(angle_before[used]),
        angle_after=np.degrees(angle_after[used]),
        angle_noise=limit(noise),
        angle_limit=limit(total),
    )


def _of(imu: Imu, observations: Observations, excess) -> list[FloatArray]:
    return [np.asarray(leaf) for leaf in stored.call(_errors, "report", imu, observations, np.asarray(excess))]


def _errors(imu: Imu, observations: Observations, excess):
    covariance = condition_covariance(imu, observations)
    total = covariance.total(excess)
    return (
        recover_specific_force(imu, observations.poses),
        turn_angle_errors(imu, observations),
        covariance.measured.diagonal(),
        total.diagonal(),
    )


def nearest_angles(points: FloatArray, directions: FloatArray) -> FloatArray:
    """Return the angle (deg) from each of the unit vectors `points` (n, 3) to the nearest of `directions` (P, 3)."""
    return np.degrees(np.arccos(np.clip((points @ directions.T).max(axis=1), -1.0, 1.0)))


def largest_gap(directions: FloatArray) -> tuple[float, FloatArray]:
    """Return how far (deg) an orientation can lie from every pose, and the direction (3,) where that is so."""
    place = np.arange(4000) + 0.5  # an even spiral over the sphere, a point every 3°
    height, turn = 1 - 2 * place / len(place), np.pi * (1 + np.sqrt(5)) * place
    across = np.sqrt(1 - height**2)
    points = np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)
    angles = nearest_angles(points, directions)
    worst = int(np.argmax(angles))
    return float(angles[worst]), points[worst]
