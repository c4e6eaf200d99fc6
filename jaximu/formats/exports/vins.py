"""The IMU's part of a VINS-Mono or VINS-Fusion configuration: noise per sample and gravity. It has no intrinsics.

`acc_n`, `gyr_n`, `acc_w`, `gyr_w` enter the preintegration as P ← F P Fᵀ + V diag(n²) Vᵀ with V in proportion to the
time step (VINS-Mono, vins_estimator/src/factor/integration_base.h): they are standard deviations of one sample,
so a density N becomes N √rate, and a bias walk K becomes K √rate.
"""

from __future__ import annotations

import math

from jaximu.errors import NotPossibleError
from jaximu.formats.exports.base import Parameters, Written, comments
from jaximu.formats.kalibr import KALIBR_UNITS

SUFFIX = ".yaml"
SUMMARY = "VINS-Mono, VINS-Fusion: noise per sample (no intrinsics)"
KEYS = {
    "acc_n": "accelerometer_noise_density", "gyr_n": "gyroscope_noise_density",
    "acc_w": "accelerometer_random_walk", "gyr_w": "gyroscope_random_walk",
}  # fmt: skip


def write(parameters: Parameters) -> Written:
    """Write the noise at the recording's rate. Raises `NotPossibleError` without noise densities or a rate."""
    parameters.require_si("VINS")
    rate = parameters.noise.get("update_rate", parameters.calibration.data.get("rate"))
    missing = [key for key in KALIBR_UNITS if key not in parameters.noise]
    if missing or not rate:
        raise NotPossibleError(
            f"VINS's configuration holds noise alone, and {', '.join(missing) or 'the rate'} is not known: record the "
            "unit at rest for an hour or more, run jaximu allan LOG -o DIR, and give --noise DIR/imu.yaml."
        )
    numbers = {key: parameters.noise[density] * math.sqrt(rate) for key, density in KEYS.items()}
    gravity = parameters.calibration.gravity.value
    lines = [comments(parameters), f"# standard deviations of one sample at {rate:.6g} Hz: densities times sqrt(rate)"]
    lines += [f"{key}: {value:.9e}" for key, value in numbers.items()] + [f"g_norm: {gravity!r}"]
    equation = "VINS takes outputs as they are. Apply the calibration first: jaximu compensate, or the c-header.\n"
    equation += "\n".join(f"{key} = {KEYS[key]} sqrt({rate:.6g} Hz) = {value:.6g}" for key, value in numbers.items())
    convention = (
        "noise per sample, not densities; users often enlarge them several times for vibration and model error. "
        "Scale, misalignment and bias have no place in the file."
    )
    return Written({"": ("\n".join(lines) + "\n").encode()}, convention, equation, {})
