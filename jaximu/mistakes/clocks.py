"""`setup.time_offset`, `data.clocks`: the two sensors' stamps are apart, or run apart."""

from __future__ import annotations

import numpy as np

from jaximu.mistakes.base import Samples, with_signal
from jaximu.recordings.alignment import Clocks
from jaximu.recordings.finding import Finding
from jaximu.recordings.recording import Recording

__all__ = ["TITLES", "find"]

TITLES = {"data.clocks": "clocks apart"}

_SURE = 5.0
_LEAST = 0.04
"""Seconds from which on it is said: a hand's accelerations can imitate less, and poses and turns do not feel it."""
_HARMFUL = 0.3
"""Seconds from which on parts of turns pass for poses."""
_EXPLAINED = 0.5


def find(samples: Samples) -> list[Finding]:
    """Return whether the gyroscope's stamps are late against the accelerometer's, or its clock runs otherwise."""
    accelerometer, gyroscope = samples.accelerometer, samples.gyroscope
    if accelerometer is None or gyroscope is None:
        return []
    found = samples.clocks
    if found is None or found.explained < _EXPLAINED:
        return []
    ends = found.late(gyroscope.time[[0, -1]])
    drifts = abs(found.drift) > _SURE * found.drift_sigma and abs(float(np.diff(ends)[0])) > _LEAST
    late = max(abs(found.offset), *np.abs(ends)) if drifts else abs(found.offset)
    if not drifts and (late < _LEAST or late < _SURE * found.sigma):
        return []

    right = found if drifts else found._replace(drift=0.0, drift_sigma=0.0)  # sensors of one clock

    def apply(recording: Recording, right: Clocks = right) -> Recording:
        assert recording.gyroscope is not None
        time = recording.gyroscope.time
        return with_signal(recording, "gyroscope", time=time - right.late(time), clock_sigma=right.drift_sigma)

    if drifts:
        text = (
            f"gyroscope: its clock runs {1e3 * abs(found.drift):.3g} ms a second "
            f"{'slow' if found.drift < 0 else 'fast'} against the accelerometer's: its stamps are {ends[0]:.3f} s late "
            f"at the start and {ends[1]:.3f} s at the end. --repair puts them on the accelerometer's clock."
        )
        return [Finding("data.clocks", (), text, "--repair", spoils=late > _HARMFUL, apply=apply)]
    text = (
        f"gyroscope: its stamps are {1e3 * abs(found.offset):.3g} ± {1.96e3 * found.sigma:.2g} ms "
        f"{'late' if found.offset > 0 else 'early'} against the accelerometer's. --repair shifts them."
    )
    return [Finding("setup.time_offset", (), text, "--repair", spoils=late > _HARMFUL, apply=apply)]
