"""The page of a noise model: how much a sample scatters, and how far the bias wanders."""

from __future__ import annotations

import numpy as np

from jaximu.ground.page import Page, Table
from jaximu.ground.quantities import number, readable, size
from jaximu.ground.units import INERTIAL_QUANTITIES, SENSOR_UNITS
from jaximu.model.noise_model import NoiseModel


def page_of(model: NoiseModel) -> Page:
    """Return each axis's white noise and the spread of its slow bias."""
    rows = []
    triads = {name: noise for name in INERTIAL_QUANTITIES if (noise := getattr(model, name)) is not None}
    for name, noise in triads.items():
        for axis, white, slow in zip("xyz", noise.white, noise.variance.sum(axis=1), strict=True):
            rows.append((f"{name} {axis}", _density(name, white), size(float(np.sqrt(slow)), SENSOR_UNITS[name])))
    name, noise = triads.popitem()
    duration = model.accelerometer.duration
    return Page(
        "Noise model",
        (f"Fitted to {duration:.0f} s at rest." if duration else "Stated, not fitted.",),
        _density(name, np.mean(noise.white)),
        f"white noise of the {name}, root mean square of its axes",
        [Table(("axis", "white noise", "slow bias (standard deviation)"), rows)],
        notes=model.notes,
    )


def _density(name: str, squared: float) -> str:
    """Return white noise as a person reads it, of its squared density in SI."""
    white = float(np.sqrt(squared))
    factor, unit = readable(SENSOR_UNITS[name], white)
    return f"{number(factor * white)} {unit}/√Hz"
