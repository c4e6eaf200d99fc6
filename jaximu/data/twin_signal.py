"""What a unit without effects would put out, with noise of its own, in place of a recorded signal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.model.noise import drawn_noise
from jaximu.model.noise_model import AxisNoise
from jaximu.model.sensor import Triad
from jaximu.recordings.recording import Signal


def twin_signal(signal: Signal, triad: Triad, true: FloatArray, noise: AxisNoise, seed: Sequence[int]) -> Signal:
    """Return a signal as a triad without effects would put it out where it goes through `true` (n, 3), SI."""
    drawn = drawn_noise(noise, len(signal), signal.rate, seed) * signal.nominal_scale
    return replace(signal, values=true @ np.asarray(triad.gain).T + np.asarray(triad.bias) + drawn)
