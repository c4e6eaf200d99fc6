"""Where a fit starts: the data sheet's unit, its gyroscope's axes and scales checked against gravity."""

from __future__ import annotations

import equinox as eqx
import numpy as np

from jaximu.data.poses import residual_rms
from jaximu.ground.array_types import FloatArray
from jaximu.ground.gravity import STANDARD
from jaximu.model.sensor import Imu
from jaximu.recordings.alignment import Turning, angle_of, rotation_of, signed_permutation, turning
from jaximu.recordings.observations import Observations
from jaximu.recordings.recording import Recording

_SAME = 0.2
"""Difference of a scale's logarithm from the data sheet's up to which that is where a fit starts."""
_MOUNTED = np.radians(12.0)
_BLOCK, _FEWEST = 0.5, 12  # s, and blocks at rest
_QUIET = 0.4
"""Share of the blocks, the quietest, that are taken for rest."""
_SPANNED = 30.0
"""Condition number up to which attitudes tell the accelerometer's scales apart."""
_ODD = 0.4
"""Logarithm of an accelerometer's scale beyond which it is no data sheet's tolerance."""


def as_stated(recording: Recording, factors: FloatArray | float = 1.0) -> Imu:
    """Return the unit as its data sheet says, the accelerometer's scales times `factors`; with a gyroscope always."""
    known = []
    for signal, factor in ((recording.accelerometer, factors), (recording.gyroscope, 1.0)):
        known += [] if signal is None else [signal.nominal_scale * factor, signal.nominal_offset, signal.unit]
    return Imu.nominal(*known)


def nominal_imu(recording: Recording, observations: Observations | None = None) -> Imu:
    """Return the unit as the recording's nominal scales and offsets describe it, where a fit starts.

    Axes or signs that are not what they should be, a stated gyroscope scale that is off by tens of percent (another
    range was set, or the factory corrected it) or a gyroscope mounted at an angle lead a fit over large turns into a
    wrong minimum. Gravity turning in the accelerometer shows them to some percent: the fit starts from there, unless
    the poses and turns in `observations` are carried better as stated, as behind a filter of the accelerometer.
    """
    accelerometer, gyroscope = recording.accelerometer, recording.gyroscope
    factors = _forces(recording)
    imu = as_stated(recording, factors)
    if gyroscope is None:
        return imu
    motion = recording.turning
    if (factors != 1).any():
        motion = turning(accelerometer.time, accelerometer.si() / factors, gyroscope.time, gyroscope.si())
    if motion is None or not motion.clear:
        return imu
    matrix = _start(motion)
    if np.array_equal(matrix, np.eye(3)):
        return imu
    gain = np.diag(gyroscope.nominal_scale) @ np.linalg.inv(matrix)
    shown = eqx.tree_at(lambda unit: unit.gyroscope.gain, imu, gain)
    if observations is None or not observations.turns.mask.any():
        return shown
    return min((shown, imu), key=lambda unit: residual_rms(unit, observations)["gravity_direction"][0])


def _forces(recording: Recording) -> FloatArray:
    """Return by what factors (3,) each axis of the accelerometer reads too much, where that is far from one.

    In many attitudes Σ (f_i / s_i)² = g² is linear in 1/s_i²; a unit in few attitudes keeps its data sheet's scales.
    """
    force = recording.accelerometer.si()
    size = max(1, recording.accelerometer.samples(_BLOCK))
    if (count := len(force) // size) < 2 * _FEWEST:
        return np.ones(3)
    parts = force[: count * size].reshape(count, size, 3)
    varied = parts.var(axis=1).sum(axis=1)
    squares = parts[varied <= np.quantile(varied, _QUIET)].mean(axis=1) ** 2 / STANDARD.value**2
    count = len(squares)
    if count < _FEWEST or np.linalg.cond(squares) > _SPANNED:
        return np.ones(3)
    inverse = np.linalg.lstsq(squares, np.ones(count))[0]
    if not (inverse > 0).all():
        return np.ones(3)
    factors = 1 / np.sqrt(inverse)
    return np.asarray(np.where(abs(np.log(factors)) > _ODD, factors, 1.0), np.float64)


def _start(motion: Turning) -> FloatArray:
    """Return the matrix (3, 3) from rates as read to true ones that a fit starts from."""
    arranged = signed_permutation(motion.matrix)
    rest = arranged.T @ motion.matrix
    if angle_of(rotation_of(rest)) > _MOUNTED:
        return motion.matrix
    scales = np.maximum(np.diag(rest), 1e-6)
    return np.asarray(arranged * np.where(abs(np.log(scales)) > _SAME, scales, 1.0), np.float64)
