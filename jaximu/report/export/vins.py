"""The IMU's part of a VINS-Mono or VINS-Fusion configuration: noise per sample and gravity. It has no intrinsics.

`acc_n`, `gyr_n`, `acc_w`, `gyr_w` enter the preintegration as P ← F P Fᵀ + V diag(n²) Vᵀ (VINS-Mono,
vins_estimator/src/factor/integration_base.h, `midPointIntegration`). A step integrates the mean of two neighbouring
samples, and V takes their noises as independent, half a time step each: the angle's variance grows by
2 (n Δt/2)² = n² Δt²/2 a step. But every sample ends one step and begins the next, so that its noise enters the angle
with a whole Δt, and the true growth is σ² Δt² = N² Δt with σ = N √rate of one sample. Hence n = √2 N √rate. The bias
walk enters once a step, with variance (w Δt)², which is K² Δt for w = K √rate.
"""

from __future__ import annotations

from jaximu.report.export.base import ExportedUnit, Written, comments
from jaximu.report.export.noise import TARGETS, noise_files, noise_values

SUFFIX = ".yaml"
NOISE = True
SUMMARY = "VINS-Mono, VINS-Fusion: noise per sample (no intrinsics)"


def write(parameters: ExportedUnit) -> Written:
    """Write the noise at the recording's rate. Raises `NotPossibleError` without noise densities or a rate."""
    parameters.require_si("VINS")
    rate = parameters.rate
    numbers = noise_values("vins", parameters.noise, rate)
    assert rate  # or it had been refused
    head = (
        comments(parameters, "").strip(),
        f"For mid-point integration at {rate:.6g} Hz: densities times sqrt(2 rate), walks times sqrt(rate).",
    )
    (content,) = noise_files("vins", parameters.noise, rate, head, parameters.calibration.gravity.value).values()
    equation = "VINS takes outputs as they are. Apply the calibration first: jaximu compensate, or the c-header.\n"
    equation += "\n".join(
        f"{key.name} = {key.density} sqrt({key.factor**2 * rate:.6g} Hz) = {numbers[key.name]:.6g}"
        for key in TARGETS["vins"].keys
    )
    return Written(
        {"": content},
        "noise per sample at the recording's rate, not densities; in motion they must be larger, and `jaximu "
        "consequences --noise-for vins` states by how much. Scale, misalignment and bias have no place in the file.",
        equation,
        {},
    )
