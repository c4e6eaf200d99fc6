"""Magnetometers of a fleet: at rest the field is to a magnetometer what gravity is to an accelerometer.

The mean outputs of a unit's rests, with the field's strength as gravity, are poses of an accelerometer:
hard and soft iron are fitted by its recipe and in its programs, beside all other units. Motion between the rests and
the angle to gravity are not used, so the gain (lower triangle) is in the magnetometer's own axes.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import pyarrow.parquet as pq

from jaximu.calibration.magnetometer import FieldStrength, field_start
from jaximu.estimation.fitting import Fit
from jaximu.estimation.problem import names_of
from jaximu.fleets.fit import FleetUnit
from jaximu.ground.document import Json
from jaximu.ground.errors import FilePath, NotPossibleError
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.model.sensor import Imu
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.segmentation import Segmentation, observed_poses, rest_statistics

_FEWEST = 2
"""Samples of a rest: of fewer nothing tells the noise."""


@dataclass(frozen=True)
class FieldUnit:
    """A magnetometer to be fitted as an accelerometer in a field of gravity's size, and the field's true strength."""

    unit: FleetUnit
    field: FieldStrength
    output_unit: str
    poses: int


def field_unit(signal: Signal, segmentation: Segmentation, strength: FieldStrength | None, where: str) -> FieldUnit:
    """Reduce a magnetometer's samples to the means of a recording's rests.

    `strength`: of the field; None where it is what the data sheet's scale says. Raises `NotPossibleError` where there
    are no samples at rest, or outputs are on no sphere of the Earth's field.
    """
    first, stop = np.searchsorted(signal.time, segmentation.intervals).T
    rests = segmentation.intervals[stop - first >= _FEWEST]
    if not len(rests):
        raise NotPossibleError(f"{where}: the magnetometer has no samples while the unit is at rest.")
    _, means, _ = rest_statistics(signal, rests)
    scale, centre, field, _ = field_start(means, signal.unit, strength, where)
    per_gravity = np.full(3, scale * field.value / STANDARD_GRAVITY)
    observations = observed_poses(replace(segmentation, recording=Recording(signal), intervals=rests), STANDARD_GRAVITY)
    nominal = Imu.nominal(tuple(per_gravity), tuple(centre), signal.unit)
    return FieldUnit(FleetUnit(observations, nominal, False), field, signal.unit, len(rests))


def field_row(magnetometer: FieldUnit, fit: Fit, rms: float) -> Json:
    """Return what a table says of a fitted magnetometer, per µT; `rms`: of its norm, m/s²."""
    factor = STANDARD_GRAVITY / magnetometer.field.value
    sigma = np.zeros(12)
    triad = fit.imu.accelerometer
    every = names_of(fit.imu)
    sigma[[every.index(name) for name in fit.names]] = fit.sigmas(factor * magnetometer.field.sigma)
    return {
        "mag_gain": factor * np.ravel(triad.gain),
        "mag_gain_sigma": factor * sigma[:9],
        "mag_bias": triad.bias,
        "mag_bias_sigma": sigma[9:],
        "mag_rms": rms / factor,
        "mag_field": magnetometer.field.value,
        "mag_field_sigma": magnetometer.field.sigma,
        "mag_unit": magnetometer.output_unit,
    }


def field_words(table: FilePath) -> list[str]:
    """Say how many magnetometers of a table are calibrated, and why others are not; nothing where there is none."""
    rows = pq.read_table(table, columns=["file", "mag_unit", "mag_message"]).to_pylist()
    done = sum(row["mag_unit"] is not None for row in rows)
    reasons = Counter(row["mag_message"].removeprefix(f"{row['file']}: ") for row in rows if row["mag_message"])
    if not done and not reasons:
        return []
    return [
        f"{done} of {done + reasons.total()} calibrated.",
        *(f"{count} not calibrated: {reason}" for reason, count in reasons.most_common(3)),
    ]
