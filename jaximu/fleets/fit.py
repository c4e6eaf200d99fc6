"""The fit of many units: those whose observations are of one kind and shape go through [`jaximu.fit`][] together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import jax
import numpy as np

from jaximu.calibration import fit_hand_held
from jaximu.data import residual_rms
from jaximu.data.poses import PosesAndTurns, condensed
from jaximu.estimation.fitting import Fit
from jaximu.ground import stored
from jaximu.ground.array_types import FloatArray
from jaximu.ground.tracing import part_of, stacked
from jaximu.model.sensor import Imu
from jaximu.planning.chunks import in_chunks
from jaximu.recordings.observations import Observations

_BATCH, _SHAPE = 256, 16
"""Units that are in memory together, and those that a compiled program takes at once."""
_KINDS = ("gravity_norm", "gravity_direction", "static_gyroscope")


@dataclass(frozen=True)
class FleetUnit:
    """One unit to be fitted: its observations in output units, and the data sheet's scales and offsets.

    gyroscope: whether it has one; its observations are then used.
    """

    observations: Observations
    nominal: Imu
    gyroscope: bool

    def alike(self) -> PosesAndTurns:
        """Return the observations, padded to one of few shapes that many units share."""
        data = PosesAndTurns.of(self.observations)
        if data.slow is not None:  # it ties intervals, of which padding would make others
            return data
        poses = np.asarray(data.poses.mask)
        interval = np.asarray(data.turns.interval)
        samples = int(np.flatnonzero(interval.any(axis=0)).max(initial=0)) + 1 if self.gyroscope else 1
        last = int(np.flatnonzero(poses).max(initial=0)) + 1
        return data.widened(_padded(last, 8), _padded(samples, 32) if self.gyroscope else 1)


def fit_units(units: Sequence[FleetUnit]) -> list[tuple[Fit, FloatArray]]:
    """Fit units of any shapes; those of one shape are fitted together, and none changes another's result.

    **Returns:** of each unit its fit, and the rms (3,) of the norm of gravity (m/s²), of carried gravity (degrees) and
    of the rate at rest (rad/s), 0 where there is none. Failures do not raise: look at `converged` and `finite`.
    """
    fits = {}
    groups = {}
    for index, unit in enumerate(units):
        data = unit.alike()
        shapes = jax.tree.structure((unit.nominal, data)), *(np.shape(leaf) for leaf in jax.tree.leaves(data))
        groups.setdefault((unit.gyroscope, shapes), []).append((index, data))
    for (gyroscope, _), group in groups.items():
        for first in range(0, len(group), _BATCH):
            indices, data = zip(*group[first : first + _BATCH], strict=True)
            fits |= zip(indices, _together([units[index].nominal for index in indices], data, gyroscope), strict=True)
    return [fits[index] for index in range(len(units))]


def _together(nominals: Sequence[Imu], data: Sequence[PosesAndTurns], gyroscope: bool) -> list[tuple[Fit, FloatArray]]:
    starts = jax.tree.map(lambda leaf: np.asarray(leaf, float), stacked(nominals))
    together = stacked(data)
    fits = fit_hand_held(starts, together, "joint" if gyroscope else "accelerometer")

    def scatter(imu: Imu, observed: PosesAndTurns) -> tuple:
        reduced = condensed(imu, observed)
        return reduced.force, reduced.angle

    compiled = partial(stored.call, scatter, "scatter", quick=False)  # without what else is condensed
    errors = in_chunks(compiled, _SHAPE, fits.imu, together)
    fitted = []
    for lane, unit in enumerate(data):
        fit, error = part_of((fits, errors), lane)
        rms = residual_rms(fit.imu, unit, gyroscope, error)
        fitted.append((fit, np.array([rms[kind][0] if kind in rms else 0.0 for kind in _KINDS])))
    return fitted


def _padded(count: int, step: int) -> int:
    """Return the next multiple of a step, or of a larger one: a quarter more at most, and few shapes to compile."""
    step = max(step, 1 << count.bit_length() >> 3)
    return -(-count // step) * step
