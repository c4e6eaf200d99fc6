"""`setup.time_offset`, `data.clocks`: the two sensors' stamps are apart, or run apart."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaximu.mistakes.base import Samples, with_signal
from jaximu.recordings.alignment import EXPLAINED
from jaximu.recordings.finding import Finding
from jaximu.recordings.recording import Recording

TITLES = {"data.clocks": "clocks apart"}

_SURE = 5.0
_LEAST = 0.04
"""Seconds from which on it is said: a hand's accelerations can imitate less, and poses and turns do not feel it."""
_HARMFUL = 0.3
"""Seconds from which on parts of turns pass for poses."""


def find(samples: Samples) -> Iterator[Finding]:
    """Return whether the gyroscope's stamps are late against the accelerometer's, or its clock runs otherwise."""
    clocks, gyroscope = samples.clocks, samples.gyroscope
    if clocks is None or gyroscope is None or clocks.explained < EXPLAINED:
        return
    ends = clocks.late(gyroscope.time[[0, -1]])
    drifts = abs(clocks.drift) > _SURE * clocks.drift_sigma
    delay = float(np.max(np.abs(ends))) if drifts else abs(clocks.offset)
    if delay < _LEAST or (not drifts and delay < _SURE * clocks.sigma):
        return

    right = clocks if drifts else clocks._replace(drift=0.0, drift_sigma=0.0)  # sensors of one clock

    def apply(recording: Recording) -> Recording:
        time = recording.signals["gyroscope"].time
        return with_signal(recording, "gyroscope", time=time - right.late(time), clock_sigma=right.drift_sigma)

    if drifts:
        text = (
            f"gyroscope: its clock runs {1e3 * abs(clocks.drift):.3g} ms a second "
            f"{'slow' if clocks.drift < 0 else 'fast'} against the accelerometer's: its stamps are {ends[0]:.3f} s "
            f"late at the start and {ends[1]:.3f} s at the end, as if its clock were another, or one of the two lost "
            "samples here and there. --repair puts them on the accelerometer's clock."
        )
        rivals = ("data.lost_samples",)
        yield Finding("data.clocks", (), text, "--repair", rivals, spoils=delay > _HARMFUL, apply=apply)
        return
    delayed = clocks.offset > 0
    text = (
        f"gyroscope: its stamps are {1e3 * abs(clocks.offset):.3g} ± {1.96e3 * clocks.sigma:.2g} ms "
        f"{'late' if delayed else 'early'} against the accelerometer's, or a filter delays "
        f"{'it by as much (gyro.lag)' if delayed else 'the accelerometer by as much'}. --repair shifts them."
    )
    rivals = ("gyro.lag",) if delayed else ()
    yield Finding("setup.time_offset", (), text, "--repair", rivals, spoils=delay > _HARMFUL, apply=apply)
