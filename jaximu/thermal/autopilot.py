"""Bias over temperature as PX4's `TC_*` and ArduPilot's `INS_TCAL*` parameters: cubics without memory.

PX4 subtracts from each axis X0 + X1 d + X2 d² + X3 d³ with d = T − TREF and T held between TMIN and TMAX, and then
CAL_*_OFF as well (src/lib/sensor_calibration/Accelerometer.hpp, `Correct`: data − thermal offset − offset). So the
cubic holds only what temperature adds to the calibration's bias; the bias itself is CAL_*_OFF, which jaximu export or
the autopilot's own calibration writes: with both files loaded it is subtracted once. ArduPilot
subtracts p(T) − p(T_cal), p(T) = 1e-6 (c1 d + c2 d² + c3 d³) with d = T − 35 °C and both temperatures held between TMIN
and TMAX; T_cal is where its own offsets were calibrated (INS_ACCn_CALTEMP, INS_GYRn_CALTEMP). Neither knows a rate of
temperature, a lag, a hysteresis or a scale over temperature.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaximu.calibration.calibration import Calibration
from jaximu.errors import InputError, NotPossibleError
from jaximu.thermal.calibration import ThermalCalibration, steady_change
from jaximu.thermal.terms import HISTORY, NETWORK, RATES, SCALE

__all__ = ["AutopilotParameters", "ardupilot_parameters", "px4_parameters"]

FloatArray = NDArray[np.float64]
_POINTS = 401
_STEADY = 0.05  # weight of the calibration at steady temperatures, over that of the recordings
_ARDUPILOT_REFERENCE = 35.0  # °C
_ARDUPILOT_RANGE = (-70.0, 80.0)


@dataclass(frozen=True)
class AutopilotParameters:
    """Parameters by name, the text of their file, and what they lose.

    loss: by triad the rms (3,), SI, between the very numbers written and the calibration: along the recordings where
    these are given, else at steady temperatures over the range seen; a constant is taken off for ArduPilot, which has
    none. left: by triad the rms (3,), SI, that the numbers leave of the recordings, about the mean of each rest; empty
    without recordings. notes: what cannot be carried over, and how to use the file.
    """

    name: str
    parameters: dict[str, float]
    text: str
    loss: dict[str, FloatArray]
    notes: tuple[str, ...]
    left: dict[str, FloatArray] = field(default_factory=dict)


def px4_parameters(
    calibration: Calibration | ThermalCalibration, instance: int = 0, accelerometer_id: int = 0, gyroscope_id: int = 0
) -> AutopilotParameters:
    """Return the thermal part of a calibration as PX4's parameters of one sensor instance, 0 to 3.

    **Arguments:** `calibration`: with its working, the cubics are fitted to the recordings; else to the calibration at
    steady temperatures. `accelerometer_id`, `gyroscope_id`: device ids of the sensors (`listener sensor_accel`),
    without which PX4 does not use the parameters; axes must be those of PX4's own log.

    Raises `NotPossibleError` for a calibration that does not say over which temperatures it was made.
    """
    if instance not in range(4):
        raise InputError(f"PX4 has temperature calibrations 0 to 3 of each sensor, found {instance}.")
    working, calibration = _parts(calibration)
    low, high = _range(calibration)
    reference = float(np.round((low + high) / 2, 2))
    parameters: dict[str, float] = {}
    loss, left = {}, {}
    for name, letter, number in (("accelerometer", "A", accelerometer_id), ("gyroscope", "G", gyroscope_id)):
        if name not in calibration.triads():
            continue
        target = _target(calibration, working, name, low, high)
        coefficients = _cubic(target, reference)  # (4, 3), constant first
        stem = f"TC_{letter}{instance}"
        parameters |= {f"TC_{letter}_ENABLE": 1, f"{stem}_ID": number, f"{stem}_TREF": reference,
                       f"{stem}_TMIN": low, f"{stem}_TMAX": high}  # fmt: skip
        for power in range(4):
            for axis in range(3):
                parameters[f"{stem}_X{power}_{axis}"] = float(np.float32(coefficients[power, axis]))
        kept = np.array([[parameters[f"{stem}_X{power}_{axis}"] for axis in range(3)] for power in range(4)])
        loss[name], own = _lost(target, working, name, np.vander(target.celsius - reference, 4, increasing=True) @ kept)
        left |= own
    notes = [
        *_notes(calibration),
        "TC_… hold only what temperature adds: the constant bias is CAL_ACC…OFF and CAL_GYRO…OFF, from jaximu export "
        "--to px4 of the same calibration or from the autopilot's own calibration done afterwards.",
    ]
    if not (accelerometer_id and gyroscope_id):
        notes.append("TC_…_ID are 0: put in the sensors' device ids (listener sensor_accel, sensor_gyro).")
    lines = ["# PX4 sensor thermal compensation", *(f"# {note}" for note in notes),
             "# Vehicle-Id Component-Id Name Value Type"]  # fmt: skip
    for key, value in parameters.items():
        whole = key.endswith(("_ID", "_ENABLE"))
        lines.append(f"1\t1\t{key}\t{int(value) if whole else f'{value:.9g}'}\t{6 if whole else 9}")
    return AutopilotParameters("PX4", parameters, "\n".join(lines) + "\n", loss, tuple(notes), left)


def ardupilot_parameters(calibration: Calibration | ThermalCalibration, instance: int = 1) -> AutopilotParameters:
    """Return the thermal part of a calibration as ArduPilot's parameters of one IMU, 1 to 3.

    **Arguments:** `calibration`: as for PX4. Raises `NotPossibleError` for a calibration that does not say over which
    temperatures it was made, or over more than -70 to 80 °C.
    """
    if instance not in range(1, 4):
        raise InputError(f"ArduPilot counts its IMUs from 1 to 3, found {instance}.")
    working, calibration = _parts(calibration)
    low, high = _range(calibration)
    if low < _ARDUPILOT_RANGE[0] or high > _ARDUPILOT_RANGE[1]:
        raise NotPossibleError(f"ArduPilot takes temperatures from -70 to 80 °C, the calibration has {low:.0f} to "
                               f"{high:.0f} °C.")  # fmt: skip
    stem = f"INS_TCAL{instance}"
    parameters: dict[str, float] = {f"{stem}_ENABLE": 1, f"{stem}_TMIN": low, f"{stem}_TMAX": high}
    loss, left = {}, {}
    for name, short in (("accelerometer", "ACC"), ("gyroscope", "GYR")):
        if name not in calibration.triads():
            continue
        target, middle = _target(calibration, working, name, low, high), (low + high) / 2
        about = _cubic(target, middle)
        moved = _moved(about, _ARDUPILOT_REFERENCE - middle)
        for power in range(1, 4):
            for axis in range(3):
                parameters[f"{stem}_{short}{power}_{'XYZ'[axis]}"] = float(np.float32(1e6 * moved[power, axis]))
        kept = np.array([[0.0] * 3, *([parameters[f"{stem}_{short}{p}_{a}"] * 1e-6 for a in "XYZ"] for p in (1, 2, 3))])
        value = np.vander(target.celsius - _ARDUPILOT_REFERENCE, 4, increasing=True) @ kept
        value = value - np.mean((value - target.model)[target.counted], axis=0)
        loss[name], own = _lost(target, working, name, value)
        left |= own
    notes = [
        *_notes(calibration),
        "ArduPilot has no constant: calibrate the offsets afterwards on the autopilot, which keeps the temperature of "
        "that calibration itself.",
    ]
    lines = [*(f"# {note}" for note in ("ArduPilot IMU temperature calibration", *notes))]
    lines += [f"{key} {int(value) if key.endswith('_ENABLE') else f'{value:.9g}'}" for key, value in parameters.items()]
    return AutopilotParameters("ArduPilot", parameters, "\n".join(lines) + "\n", loss, tuple(notes), left)


def _range(calibration: Calibration) -> tuple[float, float]:
    found = calibration.data.get("temperature_range")
    if found is None:
        raise NotPossibleError(
            "the calibration does not say over which temperatures it was made: make one with jaximu thermal."
        )
    low, high = found
    return float(np.float32(low)), float(np.float32(high))


class _Target(NamedTuple):
    """What cubics are fitted to: temperatures (m,), °C, values and the calibration's own (m, 3), SI, and weights (m,).

    counted (m,): where the loss is measured.
    """

    celsius: FloatArray
    values: FloatArray
    model: FloatArray
    weight: FloatArray
    counted: NDArray[np.bool_]


def _parts(calibration: Calibration | ThermalCalibration) -> tuple[ThermalCalibration | None, Calibration]:
    return (None, calibration) if isinstance(calibration, Calibration) else (calibration, calibration.calibration)


def _target(
    calibration: Calibration, working: ThermalCalibration | None, name: str, low: float, high: float
) -> _Target:
    """Return the recordings and, lightly, the calibration at steady temperatures: a part may have been passed quickly.

    An axis that the calibration does not correct is not corrected.
    """
    grid = np.linspace(low, high, _POINTS)
    steady = steady_change(calibration, name, grid)
    if working is None:
        return _Target(grid, steady, steady, np.ones(_POINTS), np.ones(_POINTS, bool))
    blocks, fit = working.blocks, working.fits[name]
    corrected = [bool(terms) for terms in fit.candidate.model]
    data = np.where(corrected, blocks.means[name] - fit.level.T[blocks.level], 0.0)
    counted = np.arange(len(blocks) + _POINTS) < len(blocks)
    return _Target(
        np.concatenate([np.clip(blocks.temperature, low, high), grid]), np.concatenate([data, steady]),
        np.concatenate([fit.fitted, steady]), np.where(counted, 1.0, _STEADY * len(blocks) / _POINTS), counted,
    )  # fmt: skip


def _cubic(target: _Target, about: float) -> FloatArray:
    """Return the cubics (4, 3) of T − `about`, constant first, nearest to the target in the weighted mean square."""
    difference = target.celsius - about
    size = np.max(np.abs(difference))
    weight = np.sqrt(target.weight)
    found = np.polynomial.polynomial.polyfit(difference / size, target.values, 3, w=weight)
    return found / size ** np.arange(4)[:, None]


def _lost(
    target: _Target, working: ThermalCalibration | None, name: str, value: FloatArray
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return the rms (3,) between cubics' values (m, 3) and the calibration, and what they leave of the recordings."""
    loss = _rms((value - target.model)[target.counted])
    if working is None:
        return loss, {}
    level = working.blocks.level
    error = working.blocks.means[name] - value[target.counted]
    means = np.stack([error[level == k].mean(axis=0) for k in range(working.blocks.levels)])
    return loss, {name: _rms(error - means[level])}


def _moved(coefficients: FloatArray, shift: float) -> FloatArray:
    """Return the coefficients (4, 3) of the same cubics of x − shift."""
    a, b, c, d = coefficients
    return np.stack(
        [a + b * shift + c * shift**2 + d * shift**3, b + 2 * c * shift + 3 * d * shift**2, c + 3 * d * shift, d]
    )


def _rms(error: FloatArray) -> FloatArray:
    return np.sqrt(np.mean(error**2, axis=0))


def _notes(calibration: Calibration) -> list[str]:
    effects = [effect for triad in calibration.triads().values() for effect in triad.effects]
    found = []
    lost = [effect.name for effect in effects if effect.plain in (*RATES, SCALE, NETWORK)]
    lagging = [effect.name for effect in effects if effect.plain in HISTORY]
    if lost:
        found.append(f"a cubic of temperature cannot hold {', '.join(lost)}: left out.")
    if lagging:
        found.append(f"a cubic of temperature has no memory: {', '.join(lagging)} taken as if at once.")
    return [*found, "axes and units are those of the recording: it must be the autopilot's own log, in its axes."]
