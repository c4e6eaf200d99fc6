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

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jaximu.calibration.calibration import Calibration
from jaximu.errors import InputError, NotPossibleError
from jaximu.thermal.calibration import steady_change
from jaximu.thermal.fit import HISTORY, NETWORK, RATES, SCALE

__all__ = ["AutopilotParameters", "ardupilot_parameters", "px4_parameters"]

FloatArray = NDArray[np.float64]
_POINTS = 401
_ARDUPILOT_REFERENCE = 35.0  # °C
_ARDUPILOT_RANGE = (-70.0, 80.0)


@dataclass(frozen=True)
class AutopilotParameters:
    """Parameters by name, the text of their file, and what they lose.

    loss: by triad the rms (3,), SI, over the temperatures seen, between the parameters' offsets and the calibration's
    at steady temperatures, a constant taken off for ArduPilot, which has none. notes: what cannot be carried over, and
    how to use the file.
    """

    name: str
    parameters: dict[str, float]
    text: str
    loss: dict[str, FloatArray]
    notes: tuple[str, ...]


def px4_parameters(
    calibration: Calibration, instance: int = 0, accelerometer_id: int = 0, gyroscope_id: int = 0
) -> AutopilotParameters:
    """Return the thermal part of a calibration as PX4's parameters of one sensor instance, 0 to 3.

    **Arguments:** `accelerometer_id`, `gyroscope_id`: device ids of the sensors (`listener sensor_accel`), without
    which PX4 does not use the parameters; axes must be those of PX4's own log.

    Raises `NotPossibleError` for a calibration that does not say over which temperatures it was made.
    """
    if instance not in range(4):
        raise InputError(f"PX4 has temperature calibrations 0 to 3 of each sensor, found {instance}.")
    low, high = _range(calibration)
    grid = np.linspace(low, high, _POINTS)
    reference = float(np.round((low + high) / 2, 2))
    parameters: dict[str, float] = {}
    loss = {}
    for name, letter, number in (("accelerometer", "A", accelerometer_id), ("gyroscope", "G", gyroscope_id)):
        if name not in calibration.triads():
            continue
        wanted = steady_change(calibration, name, grid)
        coefficients = _cubic(grid - reference, wanted)  # (4, 3), constant first
        stem = f"TC_{letter}{instance}"
        parameters |= {f"TC_{letter}_ENABLE": 1, f"{stem}_ID": number, f"{stem}_TREF": reference,
                       f"{stem}_TMIN": low, f"{stem}_TMAX": high}  # fmt: skip
        for power in range(4):
            for axis in range(3):
                parameters[f"{stem}_X{power}_{axis}"] = float(np.float32(coefficients[power, axis]))
        kept = np.array([[parameters[f"{stem}_X{power}_{axis}"] for axis in range(3)] for power in range(4)])
        loss[name] = _rms(np.vander(grid - reference, 4, increasing=True) @ kept - wanted)
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
    return AutopilotParameters("PX4", parameters, "\n".join(lines) + "\n", loss, tuple(notes))


def ardupilot_parameters(calibration: Calibration, instance: int = 1) -> AutopilotParameters:
    """Return the thermal part of a calibration as ArduPilot's parameters of one IMU, 1 to 3.

    Raises `NotPossibleError` for a calibration that does not say over which temperatures it was made, or over more than
    -70 to 80 °C.
    """
    if instance not in range(1, 4):
        raise InputError(f"ArduPilot counts its IMUs from 1 to 3, found {instance}.")
    low, high = _range(calibration)
    if low < _ARDUPILOT_RANGE[0] or high > _ARDUPILOT_RANGE[1]:
        raise NotPossibleError(f"ArduPilot takes temperatures from -70 to 80 °C, the calibration has {low:.0f} to "
                               f"{high:.0f} °C.")  # fmt: skip
    grid = np.linspace(low, high, _POINTS)
    stem = f"INS_TCAL{instance}"
    parameters: dict[str, float] = {f"{stem}_ENABLE": 1, f"{stem}_TMIN": low, f"{stem}_TMAX": high}
    loss = {}
    for name, short in (("accelerometer", "ACC"), ("gyroscope", "GYR")):
        if name not in calibration.triads():
            continue
        wanted = steady_change(calibration, name, grid)
        middle = (low + high) / 2
        about = _cubic(grid - middle, wanted)
        moved = _moved(about, _ARDUPILOT_REFERENCE - middle)
        for power in range(1, 4):
            for axis in range(3):
                parameters[f"{stem}_{short}{power}_{'XYZ'[axis]}"] = float(np.float32(1e6 * moved[power, axis]))
        kept = np.array([[0.0] * 3, *([parameters[f"{stem}_{short}{p}_{a}"] * 1e-6 for a in "XYZ"] for p in (1, 2, 3))])
        error = np.vander(grid - _ARDUPILOT_REFERENCE, 4, increasing=True) @ kept - wanted
        loss[name] = _rms(error - error.mean(axis=0))
    notes = [
        *_notes(calibration),
        "ArduPilot has no constant: calibrate the offsets afterwards on the autopilot, which keeps the temperature of "
        "that calibration itself.",
    ]
    lines = [*(f"# {note}" for note in ("ArduPilot IMU temperature calibration", *notes))]
    lines += [f"{key} {int(value) if key.endswith('_ENABLE') else f'{value:.9g}'}" for key, value in parameters.items()]
    return AutopilotParameters("ArduPilot", parameters, "\n".join(lines) + "\n", loss, tuple(notes))


def _range(calibration: Calibration) -> tuple[float, float]:
    found = calibration.data.get("temperature_range")
    if found is None:
        raise NotPossibleError(
            "the calibration does not say over which temperatures it was made: make one with jaximu thermal."
        )
    low, high = found
    return float(np.float32(low)), float(np.float32(high))


def _cubic(difference: FloatArray, wanted: FloatArray) -> FloatArray:
    """Return the cubics (4, 3), constant first, nearest to values (m, 3) in the mean square."""
    size = np.max(np.abs(difference))
    return np.polynomial.polynomial.polyfit(difference / size, wanted, 3) / size ** np.arange(4)[:, None]


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
