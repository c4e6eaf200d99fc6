"""A calibrated magnetometer beside a simulated unit: the field of the place, off by its own error in each rest."""

from dataclasses import replace

import numpy as np

from jaximu.calibration import Calibration
from jaximu.ground.gravity import STANDARD
from jaximu.model.sensor import Imu, Triad
from jaximu.recordings.recording import Signal

FIELD_NOISE = 0.2
"""µT, of the mean over a rest, each axis."""
MAGNETOMETER = Triad(np.eye(3) + 0.05 * np.sin(np.arange(9.0)).reshape(3, 3), np.array([12.0, -7.0, 20.0]), (),
                     "magnetic_field", "uT")  # fmt: skip


def magnetic(recording, truth, seed: int = 3):
    """Return a simulated recording with a magnetometer, and the calibration of that; errors are each rest's own."""
    random = np.random.default_rng(seed)
    field, time = np.array(truth.stimulus.magnetic_field), recording.accelerometer.time
    for start, stop in truth.intervals:
        field[(time >= start) & (time < stop)] += FIELD_NOISE * random.standard_normal(3)
    imu = replace(Imu.nominal(), magnetometer=MAGNETOMETER)
    known = Calibration(imu, (), np.zeros((0, 0)), STANDARD, "definition", "linear", {}, 0, (), {}, "", {})
    output = field @ MAGNETOMETER.gain.T + MAGNETOMETER.bias
    return replace(recording, magnetometer=Signal(time, output, "uT")), known
