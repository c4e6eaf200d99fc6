"""`data.normalised` and `data.gravity_free`: outputs of an accelerometer that are not specific forces."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.mistakes.base import Samples
from jaximu.recordings.finding import Finding

TITLES = {"data.gravity_free": "gravity taken out", "data.normalised": "directions without size"}

_CONSTANT = 0.3
"""Scatter of the norm over that of an axis, below which the norm was made constant."""
_FREE = 0.06
"""Median norm at rest over gravity, below which gravity was taken out."""


def find(samples: Samples) -> Iterator[Finding]:
    """Return an accelerometer whose norm is constant, or without gravity."""
    sensor = samples.accelerometer
    if sensor is None or len(sensor) < 100:
        return
    norm = np.linalg.norm(sensor.values, axis=1)
    middle = np.median(norm)
    low, high = np.quantile(norm, [0.1, 0.5])
    # in units of g gravity is one everywhere at rest; what is left without it varies as much as it is large
    scattered = middle < 0.11 * STANDARD_GRAVITY and high > 1.5 * low
    if 1e-4 < middle and (middle < _FREE * STANDARD_GRAVITY or scattered):
        yield Finding(
            "data.gravity_free",
            (),
            f"accelerometer: the median of its norm is {middle:.2g} m/s², far from gravity: gravity was taken out "
            "(a linear acceleration), or the unit is not m/s². Log the raw accelerometer, with its unit.",
            spoils=True,
            refuses="gravity",
        )
        return
    noise = np.min(sensor.noise)
    scatter = np.quantile(np.abs(norm - middle), 0.995) / 2.8
    rounding = np.max(sensor.step)
    turned = np.max(np.ptp(sensor.values, axis=0))
    if noise > 1e-9 * middle and turned > 0.5 * middle and scatter < max(_CONSTANT * noise, 1e-9 * middle):
        if scatter > 0.5 * noise - rounding and noise < 2 * rounding:
            return
        yield Finding(
            "data.normalised",
            (),
            f"accelerometer: the norm is constant to {100 * scatter / middle:.1g} % in every sample, also in "
            "motion: these are directions, not forces, and hold no scale. Log the raw accelerometer.",
            spoils=True,
            refuses="accelerometer",
        )
