"""What is known of units on one rigid body, as `array.json` has it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaximu.calibration.calibration import Calibration
from jaximu.ground.array_types import FloatArray
from jaximu.ground.document import Document, Json, entries
from jaximu.ground.gravity import LocalGravity
from jaximu.ground.page import Result

SCHEMA = "jaximu.array/1"
_SUSPECT = 2.0
"""Times the median scatter of the units from which on one is said to disturb the array."""


@dataclass(frozen=True)
class ArrayUnit:
    """One unit of an array, against the first.

    rotation: quaternion (w, x, y, z) from the first unit's axes to this one's; position: (3,) m, of this unit in the
    first one's axes; time_offset: s by which this unit's stamps are late; sigmas of all. clock_scale: how fast its
    clock runs against the first's, less one. rate_scatter (rad/s), force_scatter (m/s²): standard deviation of an axis
    about the motion that the units share, in short intervals; None where two units cannot tell whose it is. residual:
    rms of rate and force off the first's, per axis.
    """

    name: str
    calibration: Calibration
    rotation: FloatArray
    rotation_sigma: FloatArray
    position: FloatArray
    position_sigma: FloatArray
    time_offset: float
    time_offset_sigma: float
    clock_scale: float
    residual: tuple[float, float]
    rate_scatter: float | None = None
    force_scatter: float | None = None

    def document(self) -> Json:
        """Return the unit as `array.json` has it."""
        return {
            "file": self.name,
            **entries(self, "rotation", "rotation_sigma", "position", "position_sigma"),
            "time_offset": {"value": self.time_offset, "sigma": self.time_offset_sigma, "unit": "s"},
            "clock_scale": 1.0 + self.clock_scale,
            "residual": {"rate": self.residual[0], "force": self.residual[1]},
            "scatter": {"rate": self.rate_scatter, "force": self.force_scatter},
        }


@dataclass(frozen=True)
class Averaged:
    """What the mean of the units gains in noise at rest: of a typical unit, and of the weighted mean of all.

    Standard deviations per axis of means over a quarter of a second, rad/s and m/s²; expected: of the mean, were the
    units' noises independent.
    """

    rate: tuple[float, float, float]
    force: tuple[float, float, float]

    def document(self) -> Json:
        """Return it as `array.json` has it."""
        return {
            name: dict(zip(("unit", "mean", "expected"), values, strict=True))
            for name, values in (("rate", self.rate), ("force", self.force))
        }


@dataclass(frozen=True, repr=False, eq=False)
class Array(Result, Document, page="array"):
    """Several units on one rigid body; the first is the one that the others are measured against."""

    units: tuple[ArrayUnit, ...]
    averaged: Averaged
    gravity: LocalGravity
    notes: tuple[str, ...] = ()

    def document(self) -> Json:
        """Return the array as the JSON document of schema `jaximu.array/1`."""
        sources = [unit.calibration.data for unit in self.units]
        return {
            "schema": SCHEMA,
            "convention": "rotation: unit quaternion w, x, y, z that turns components in the first unit's axes into "
            "this unit's; position: m, of this unit in the first unit's axes; time_offset: positive if this unit's "
            "stamps are late; sigmas: rad, m, s; scatter and residual: rad/s and m/s²",
            "units": [unit.document() for unit in self.units],
            "averaging": self.averaged.document(),
            "data": [{key: data[key] for key in ("file", "sha256", "rows") if key in data} for data in sources],
            "notes": list(self.notes),
        }

    def suspects(self) -> list[tuple[ArrayUnit, str, float]]:
        """Return units that scatter about the shared motion far more than the others, in what, how many times."""
        suspects = []
        for field, words in (("rate_scatter", "rate"), ("force_scatter", "specific force")):
            values = [getattr(unit, field) for unit in self.units]
            if None in values:
                continue
            typical = float(np.median(values))
            suspects += [
                (unit, words, value / typical)
                for unit, value in zip(self.units, values, strict=True)
                if typical > 0 and value > _SUSPECT * typical
            ]
        return suspects
