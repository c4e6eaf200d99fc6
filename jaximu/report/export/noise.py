"""The noise of a unit as other estimators ask for it: file, key, unit, continuous density or a deviation per sample.

One table, `TARGETS`; a value is factor · densityᵉ · rateᵖ of a continuous, two-sided density (`KALIBR_UNITS`):

- kalibr, openvins: continuous densities (Kalibr's wiki, "IMU Noise Model"; docs.openvins.com, "IMU Propagation", which
  divides by the square root of the time step itself).
- vins (VINS-Mono, VINS-Fusion): per sample, and √2 more for white noise, because its mid-point integration takes the
  noises of neighbouring samples as independent halves of a step; derived in `jaximu.report.export.vins`.
- gtsam: continuous covariances, the squares (gtsam/navigation/PreintegrationParams.h, PreintegrationCombinedParams.h;
  `integrateMeasurement` of ImuFactor.cpp divides them by the time step). `integrationCovariance` is no noise of the
  sensor: it adds integrationCovariance · Δt to the position's variance every step, for what is lost because a sample
  is held over its step. Where the force changes by Δf from one sample to the next, Δp is off by h²/12 Δf; taken as
  independent from step to step that is h³ mean(Δf²)/144 a second (m²/s).
- lio-sam: GTSAM underneath, deviations instead of covariances; the biases' are multiplied by √Δt between two states
  (LIO-SAM, src/imuPreintegration.cpp), hence continuous too.
- px4: a step adds (σ Δt)² to the angle's and velocity's variance and (w Δt)² to the bias's (PX4-Autopilot,
  src/modules/ekf2/EKF/covariance.cpp, `predictCovariance`), so σ = N/√Δt and w = K/√Δt at the filter's own step,
  EKF2_PREDICT_US = 10 ms unless changed.
- ardupilot: the same at EKF_TARGET_DT = 12 ms (ArduPilot, libraries/AP_NavEKF3/AP_NavEKF3_core.cpp,
  `CovariancePrediction`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jaximu.ground.errors import InputError, NotPossibleError, nearest
from jaximu.recordings.readers.kalibr import KALIBR_UNITS, kalibr_yaml

_DENSITIES = _ACCEL, _GYRO, _, _ = (
    "accelerometer_noise_density",
    "gyroscope_noise_density",
    "accelerometer_random_walk",
    "gyroscope_random_walk",
)
INTEGRATION = "integration_covariance"
"""Beside the densities: what GTSAM's integrationCovariance stands for, m²/s."""


@dataclass(frozen=True)
class Key:
    """A tool's parameter: value = factor · densityᵉˣᵖᵒⁿᵉⁿᵗ · rateᵖᵒʷᵉʳ, in `unit`."""

    name: str
    density: str
    unit: str
    factor: float = 1.0
    exponent: int = 1
    power: float = 0.0


@dataclass(frozen=True)
class Target:
    """What a tool reads. rate: Hz of its own time step, None for that of the recording. kind: of its numbers.

    row: a line of the file, of {key}, {value} and {unit}; opening: the file's first line; head and tail: lines about
    the rows, of {rate} and {gravity}.
    """

    tool: str
    file: str
    keys: tuple[Key, ...]
    kind: str
    rate: float | None = None
    row: str = "{key}: {value:.6e}  # {unit}"
    opening: str = ""
    head: str = ""
    tail: str = ""


def _keys(
    names: str, units: Sequence[str], white: float = 1.0, exponent: int = 1, power: float = 0.0
) -> tuple[Key, ...]:
    return tuple(
        Key(name, density, unit, white if density in (_ACCEL, _GYRO) else 1.0, exponent, power)
        for name, density, unit in zip(names.split(), _DENSITIES, units, strict=True)
    )


_CONTINUOUS = tuple(KALIBR_UNITS[name] for name in _DENSITIES)
_SAMPLED = ("m/s^2", "rad/s", "m/s^3", "rad/s^2")
_KALIBR = _keys(" ".join(_DENSITIES), _CONTINUOUS)
TARGETS = {
    "kalibr": Target("Kalibr", "imu.yaml", _KALIBR, "continuous densities"),
    "openvins": Target(
        "OpenVINS",
        "kalibr_imu_chain.yaml",
        _KALIBR,
        "continuous densities",
        row="  {key}: {value:.6e}  # {unit}",
        opening="%YAML:1.0",
        head="imu0:",
        tail="  update_rate: {rate:.6g}  # Hz",
    ),
    "vins": Target(
        "VINS-Fusion",
        "vins.yaml",
        _keys("acc_n gyr_n acc_w gyr_w", _SAMPLED, math.sqrt(2), power=0.5),
        "standard deviations per sample, sqrt(2) more for white noise",
        opening="%YAML:1.0",
        tail="g_norm: {gravity!r}  # m/s^2",
    ),
    "gtsam": Target(
        "GTSAM",
        "gtsam_noise.py",
        _keys(
            "setAccelerometerCovariance setGyroscopeCovariance setBiasAccCovariance setBiasOmegaCovariance",
            tuple(f"({unit})^2" for unit in _CONTINUOUS),
            exponent=2,
        ),
        "continuous covariances",
    ),
    "lio-sam": Target(
        "LIO-SAM",
        "params.yaml",
        _keys("imuAccNoise imuGyrNoise imuAccBiasN imuGyrBiasN", _CONTINUOUS),
        "continuous densities",
        row="  {key}: {value:.6e}  # {unit}",
        head="lio_sam:",
        tail="  imuGravity: {gravity!r}  # m/s^2",
    ),
    "px4": Target(
        "PX4",
        "ekf2.params",
        _keys("EKF2_ACC_NOISE EKF2_GYR_NOISE EKF2_ACC_B_NOISE EKF2_GYR_B_NOISE", _SAMPLED, power=0.5),
        "standard deviations per step of 10 ms (EKF2_PREDICT_US)",
        100.0,
        row="1\t1\t{key}\t{value:.6g}\t9",
        head="# Vehicle-Id Component-Id Name Value Type",
    ),
    "ardupilot": Target(
        "ArduPilot",
        "ek3.param",
        _keys("EK3_ACC_P_NSE EK3_GYRO_P_NSE EK3_ABIAS_P_NSE EK3_GBIAS_P_NSE", _SAMPLED, power=0.5),
        "standard deviations per step of 12 ms",
        1 / 0.012,
        row="{key},{value:.6g}",
    ),
}


def target(name: str) -> str:
    """Return a tool's key in `TARGETS`. Raises `InputError` naming the ones there are."""
    plain = name.strip().lower().replace("_", "-")
    key = {"vins-fusion": "vins", "vins-mono": "vins", "liosam": "lio-sam"}.get(plain, plain)
    if key not in TARGETS:
        raise InputError(f"{name!r} is no estimator known here; {nearest(key, TARGETS)}")
    return key


def noise_values(name: str, densities: Mapping[str, float], rate: float | None) -> dict[str, float]:
    """Return a tool's numbers by its keys, from continuous densities (`KALIBR_UNITS`) and the samples' rate (Hz).

    Raises `NotPossibleError` where a density is missing or zero, or the tool's numbers are per sample and no rate is
    known.
    """
    made = TARGETS[name]
    missing = [key.density for key in made.keys if not densities.get(key.density, 0.0) > 0]
    step = made.rate or rate
    missing += ["the rate"] * (any(key.power for key in made.keys) and not step)
    if missing:
        raise NotPossibleError(
            f"{made.tool} needs {', '.join(missing)}, not known here: record the unit at rest for an hour or more and "
            "run jaximu allan LOG -o DIR, or state the data sheet's figures in a Kalibr imu.yaml."
        )
    return {
        key.name: key.factor * densities[key.density] ** key.exponent * (step or 1.0) ** key.power for key in made.keys
    }


def noise_files(
    name: str, densities: Mapping[str, float], rate: float, comments: Sequence[str] = (), gravity: float = 9.80665
) -> dict[str, bytes]:
    """Return the tool's files by name, their head saying what the numbers are; GTSAM's are Python and C++.

    **Arguments:** `densities` as for [`noise_values`], and for GTSAM "integration_covariance" (m²/s); `rate`: of the
    samples, Hz; `comments`: lines for the head; `gravity`: m/s², for tools that ask for it beside the noise.
    """
    made = TARGETS[name]
    values = noise_values(name, densities, rate)
    head = [f"{made.tool}: {made.kind}.", *comments]
    if name == "gtsam":
        return _gtsam(values, made, densities.get(INTEGRATION), head, gravity)
    if name == "kalibr":
        return {
            made.file: kalibr_yaml({key: (value, "") for key, value in values.items()}, rate, comments=head).encode()
        }
    lines = [
        made.opening,
        *(f"# {text}" for text in head),
        made.head,
        *(made.row.format(key=key.name, value=values[key.name], unit=key.unit) for key in made.keys),
        made.tail.format(rate=rate, gravity=gravity),
    ]
    return {made.file: ("\n".join(filter(None, lines)) + "\n").encode()}


_INTEGRATION = (
    "integrationCovariance is no sensor noise: it adds to the variance of position (m^2/s), for what is lost because",
    "a sample is held over its step. This value is h^3 mean(df^2)/144, df the change of force between samples.",
)


def _gtsam(
    values: Mapping[str, float], made: Target, integration: float | None, head: Sequence[str], gravity: float
) -> dict[str, bytes]:
    """Return a function in Python and one in C++ that make the parameters of combined IMU factors."""
    rows = [(key.name, values[key.name], key.unit) for key in made.keys]
    rows.append(("setIntegrationCovariance", 1e-8 if integration is None else integration, "m^2/s"))
    known = _INTEGRATION[:1] if integration is None else _INTEGRATION
    head = [
        *head,
        *known,
        "The plain ImuFactor takes the same without the two setBias lines: between two states it",
        "wants a BetweenFactor on the bias with sigma = sqrt(covariance * time).",
    ]
    python = [
        *(f"# {text}" for text in head),
        "import gtsam",
        "import numpy as np\n\n",
        f"def imu_parameters(gravity={gravity!r}):  # of a frame whose z points up",
        "    parameters = gtsam.PreintegrationCombinedParams.MakeSharedU(gravity)",
        *(f"    parameters.{key}({value:.6e} * np.eye(3))  # {unit}" for key, value, unit in rows),
        "    return parameters\n",
    ]
    cpp = [
        *(f"// {text}" for text in head),
        "#pragma once",
        "#include <gtsam/navigation/CombinedImuFactor.h>\n",
        f"inline auto imuParameters(double gravity = {gravity!r}) {{  // of a frame whose z points up",
        "  auto parameters = gtsam::PreintegrationCombinedParams::MakeSharedU(gravity);",
        *(f"  parameters->{key}({value:.6e} * gtsam::I_3x3);  // {unit}" for key, value, unit in rows),
        "  return parameters;",
        "}\n",
    ]
    return {"gtsam_noise.py": "\n".join(python).encode(), "gtsam_noise.h": "\n".join(cpp).encode()}
