"""A gyroscope whose output bends towards a limit, as the turns of a calibrated recording show it.

Below a soft limit L an output y stands for the rate L artanh(y/L). Where the turns fit far better so, with one limit
for all axes a little above what was reached, and far better than with the cube that such a curve begins with, it is
the range that is too small, and no nonlinearity of the sensor's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaximu.calibration.calibration import Calibration
from jaximu.calibration.hand_held import fit_hand_held
from jaximu.recordings.finding import Finding

_LIMITS = 1.01, 1.03, 1.08, 1.2, 1.4
"""Limits that are tried, over the greatest rate of all turns."""
_COARSE = 500.0
"""Variance of turns, in multiples of their noise, below which nothing saturates."""
_TIMES, _RIVAL = 10.0, 2.0
"""Times by which that variance must fall with a limit, and be below that with a cube."""


def saturation(calibration: Calibration) -> list[Finding]:
    """Return whether the gyroscope's output saturates softly."""
    fitted, observations, nominal = calibration.fit, calibration.observations, calibration.nominal
    assert fitted is not None and observations is not None and nominal is not None
    turns, variance = observations.turns, 1.0 + float(fitted.excess[1])
    if variance < _COARSE:
        return []
    # the limit is the output's: the fitted gain is wrong by what it bends
    scale = nominal.triad("gyroscope").scales
    bias, inside = calibration.imu.triad("gyroscope").bias, turns.interval > 0
    rate = np.where(inside[..., None], (turns.output - bias) / scale, 0.0)
    greatest = float(abs(rate).max())

    def scatter(changed) -> float:
        turned = replace(turns, output=bias + scale * changed)
        bent = fit_hand_held(nominal, replace(observations, turns=turned))
        return 1.0 + float(bent.excess[1]) if bent.converged and bent.finite else np.inf

    limits = greatest * np.array(_LIMITS)
    bent = [scatter(limit * np.arctanh(rate / limit)) for limit in limits]
    best = int(np.argmin(bent))
    if bent[best] * _TIMES > variance:
        return []
    cubes = [scatter(rate + rate**3 / (3 * limit**2)) for limit in greatest * np.array([0.6, 0.8, 1.0, 1.3])]
    if bent[best] * _RIVAL > min(cubes):
        return []
    return [
        Finding(
            "data.saturation",
            (),
            f"gyroscope: its output bends towards a limit of about {np.degrees(limits[best]):.3g} °/s: straightened, "
            f"it carries gravity over the turns {np.sqrt(variance / bent[best]):.2g} times better. Quick turns read "
            "too little, and the gain is wrong. A gyroscope that is as nonlinear itself (gyro.cubic) looks alike. "
            "Choose a larger range, or turn more slowly, and record again.",
            rivals=("gyro.cubic",),
            spoils=True,
        )
    ]
