"""The noise of a unit from its own poses, where there is no recording at rest."""

from __future__ import annotations

import numpy as np

from jaximu.calibration import Calibration
from jaximu.noise.model import AxisNoise, NoiseModel, fit_bank
from jaximu.segmentation import Segmentation

__all__ = ["own_noise"]

_SHORTEST = 64
"""Samples that a pose must hold for its spectrum to count."""
_FLICKER = 0.25
"""Bias instability that is assumed, in √s of the white noise's density: consumer sensors have 0.1 to 0.4 (20 µg with
100 µg/√Hz, 5 °/h with 0.005 °/s/√Hz)."""
_RATIO = 4.0


def own_noise(calibration: Calibration) -> NoiseModel:
    """Fit a noise model to the scatter inside the poses, and assume a usual flicker for what is slower than a pose."""
    found: dict[str, AxisNoise] = {}
    for name in ("accelerometer", "gyroscope"):
        parts = [_parts(part, name) for part in calibration.segmentations]
        segments = [values for part, _ in parts for values in part]
        length = int(np.median([len(values) for values in segments]))
        whole = [values[:length] for values in segments if len(values) >= max(length, _SHORTEST)]
        rate = parts[0][1]
        if len(whole) >= 4:
            found[name] = fit_bank(np.stack([values.T for values in whole]), rate)
        else:
            scatter = np.mean([values.var(axis=0) for values in segments if len(values) > 1], axis=0)
            found[name] = AxisNoise.of_white(scatter / rate)
        found[name] = _with_flicker(
            found[name], length / rate, 4 * float(np.ptp(calibration.segmentations[0].intervals))
        )
    return NoiseModel(
        found["accelerometer"],
        found["gyroscope"],
        ("the noise was taken from the poses themselves; of bias that is slower than a pose they tell little, and a "
         f"usual bias instability ({_FLICKER:g} of the white noise over a second) was assumed. If it is more, it may "
         "pass for an effect of time: a recording at rest (--static) tells it.",),
    )  # fmt: skip


def _with_flicker(noise: AxisNoise, shortest: float, longest: float) -> AxisNoise:
    """Add flicker noise slower than a pose, as Gauss–Markov processes of variance B² ln 4/π each."""
    times = shortest * _RATIO ** np.arange(1 + int(np.log(max(longest / shortest, 1)) / np.log(_RATIO)))
    variance = _FLICKER**2 * noise.covariance([0.0], [1.0])[:, 0] * np.log(_RATIO) / np.pi * np.ones(len(times))
    kept = noise.correlation_time < shortest
    return AxisNoise(
        noise.white, noise.quantisation, np.concatenate([noise.variance[:, kept], variance], axis=1),
        np.asarray(np.concatenate([noise.correlation_time[kept], times]), np.float64), noise.duration,
    )  # fmt: skip


def _parts(part: Segmentation, name: str) -> tuple[list[np.ndarray], float]:
    signal = getattr(part.recording, name)
    values = signal.si()
    inside = [values[(signal.time >= a) & (signal.time < b)] for a, b in part.intervals]
    return [each for each in inside if len(each) > 8], signal.rate
