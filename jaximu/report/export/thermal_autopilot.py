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

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from jaximu.calibration.calibration import Calibration
from jaximu.calibration.thermal import ThermalCalibration, steady_change
from jaximu.calibration.thermal_terms import NETWORK, RATES, SCALE, memories
from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError, NotPossibleError

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
    without which PX4 does not use the parameters.

    Raises `NotPossibleError` for a calibration that does not say over which temperatures it was made.
    """
    if instance not in range(4):
        raise InputError(f"PX4 has temperature calibrations 0 to 3 of each sensor, found {instance}.")
    targets = _Targets(calibration)
    reference = float(np.round((targets.low + targets.high) / 2, 2))
    parameters = {}
    for name, letter, number in (("accelerometer", "A", accelerometer_id), ("gyroscope", "G", gyroscope_id)):
        if name not in targets.calibration.triads():
            continue
        cubic = targets.cubic(name, reference, 1.0)
        stem = f"TC_{letter}{instance}"
        parameters |= {
            f"TC_{letter}_ENABLE": 1,
            f"{stem}_ID": number,
            f"{stem}_TREF": reference,
            f"{stem}_TMIN": targets.low,
            f"{stem}_TMAX": targets.high,
        }
        parameters |= {f"{stem}_X{power}_{axis}": float(cubic[power, axis]) for power in range(4) for axis in range(3)}
    notes = [
        *targets.notes(),
        "TC_… hold only what temperature adds: the constant bias is CAL_ACC…OFF and CAL_GYRO…OFF, from jaximu export "
        "--to px4 of the same calibration or from the autopilot's own calibration done afterwards.",
    ]
    if not (accelerometer_id and gyroscope_id):
        notes.append("TC_…_ID are 0: put in the sensors' device ids (listener sensor_accel, sensor_gyro).")
    lines = [
        "# PX4 sensor thermal compensation",
        *(f"# {note}" for note in notes),
        "# Vehicle-Id Component-Id Name Value Type",
    ]
    for key, value in parameters.items():
        whole = key.endswith(("_ID", "_ENABLE"))
        lines.append(f"1\t1\t{key}\t{int(value) if whole else f'{value:.9g}'}\t{6 if whole else 9}")
    return targets.parameters("PX4", parameters, lines, notes)


def ardupilot_parameters(calibration: Calibration | ThermalCalibration, instance: int = 1) -> AutopilotParameters:
    """Return the thermal part of a calibration as ArduPilot's parameters of one IMU, 1 to 3.

    **Arguments:** `calibration`: as for PX4. Raises `NotPossibleError` for a calibration that does not say over which
    temperatures it was made, or over more than -70 to 80 °C.
    """
    if instance not in range(1, 4):
        raise InputError(f"ArduPilot counts its IMUs from 1 to 3, found {instance}.")
    targets = _Targets(calibration)
    low, high = targets.low, targets.high
    if low < _ARDUPILOT_RANGE[0] or high > _ARDUPILOT_RANGE[1]:
        raise NotPossibleError(
            f"ArduPilot takes temperatures from -70 to 80 °C, the calibration has {low:.0f} to {high:.0f} °C."
        )
    stem = f"INS_TCAL{instance}"
    parameters: dict[str, float] = {f"{stem}_ENABLE": 1, f"{stem}_TMIN": low, f"{stem}_TMAX": high}
    for name, short in (("accelerometer", "ACC"), ("gyroscope", "GYR")):
        if name not in targets.calibration.triads():
            continue
        cubic = targets.cubic(name, _ARDUPILOT_REFERENCE, 1e-6, constant=False)
        parameters |= {
            f"{stem}_{short}{power}_{axis}": float(cubic[power, k])
            for power in range(1, 4)
            for k, axis in enumerate("XYZ")
        }
    notes = [
        *targets.notes(),
        "ArduPilot has no constant: calibrate the offsets afterwards on the autopilot, which keeps the temperature of "
        "that calibration itself.",
    ]
    lines = [*(f"# {note}" for note in ("ArduPilot IMU temperature calibration", *notes))]
    lines += [f"{key} {int(value) if key.endswith('_ENABLE') else f'{value:.9g}'}" for key, value in parameters.items()]
    return targets.parameters("ArduPilot", parameters, lines, notes)


class _Targets:
    """What cubics are fitted to, and what they lose of it.

    That is the recordings and, lightly, the calibration at steady temperatures: a part may have been passed quickly. An
    axis that the calibration does not correct is not corrected.
    """

    def __init__(self, calibration: Calibration | ThermalCalibration):
        self.working, self.calibration = (
            (None, calibration) if isinstance(calibration, Calibration) else (calibration, calibration.calibration)
        )
        span = self.calibration.data.get("temperature_range")
        if span is None:
            raise NotPossibleError(
                "the calibration does not say over which temperatures it was made: make one with jaximu thermal."
            )
        self.low, self.high = (float(np.float32(end)) for end in span)
        self.loss: dict[str, FloatArray] = {}
        self.left: dict[str, FloatArray] = {}

    def cubic(self, name: str, about: float, unit: float, constant: bool = True) -> FloatArray:
        """Return the cubics (4, 3) of T − `about`, constant first, as the file has them: in `unit`, single precision.

        They are in the autopilot's axes. What they lose is noted, in body axes; without a constant, about the mean.
        """
        celsius = np.linspace(self.low, self.high, _POINTS)
        values = model = steady_change(self.calibration, name, celsius)
        counted = slice(None)
        weight = np.ones(_POINTS)
        if self.working is not None:
            blocks = self.working.blocks
            fit = self.working.fits[name]
            corrected = [bool(terms) for terms in fit.candidate.model]
            data = np.where(corrected, blocks.means[name] - fit.level.T[blocks.level], 0.0)
            celsius = np.concatenate([np.clip(blocks.temperature, self.low, self.high), celsius])
            values = np.concatenate([data, values])
            model = np.concatenate([fit.fitted, model])
            counted = slice(len(blocks))
            weight = np.concatenate([np.ones(len(blocks)), weight * _STEADY * len(blocks) / _POINTS])
        size = np.abs(celsius - about).max()
        fitted = np.polynomial.polynomial.polyfit((celsius - about) / size, values, 3, w=np.sqrt(weight))
        cubic = np.float32(fitted / size ** np.arange(4)[:, None] / unit).astype(float)
        written = np.vander((celsius - about)[counted], 4, increasing=True) @ (cubic * unit)
        error = written - model[counted]
        shift = 0.0 if constant else error.mean(axis=0)
        self.loss[name] = np.sqrt(((error - shift) ** 2).mean(axis=0))
        if self.working is not None:
            self.left[name] = self.working.blocks.left(name, self.working.blocks.means[name] - (written - shift))
        reading = self.calibration.reading
        return cubic if reading is None else cubic @ reading.autopilot_maps[name]

    def notes(self) -> Iterator[str]:
        """Say what a cubic of temperature cannot hold."""
        effects = [effect for triad in self.calibration.triads().values() for effect in triad.effects]
        lost = [effect.name for effect in effects if effect.plain in (*RATES, SCALE, NETWORK)]
        lagging = [effect.name for effect in effects if memories([effect.plain])]
        if lost:
            yield f"a cubic of temperature cannot hold {', '.join(lost)}: left out."
        if lagging:
            yield f"a cubic of temperature has no memory: {', '.join(lagging)} taken as if at once."
        yield (
            "axes and units are those of the recording: it must be the autopilot's own log, in its axes."
            if self.calibration.reading is None
            else "axes are the autopilot's own: forward, right, down; units must be those of its log."
        )

    def parameters(
        self, name: str, parameters: dict[str, float], lines: list[str], notes: list[str]
    ) -> AutopilotParameters:
        return AutopilotParameters(name, parameters, "\n".join(lines) + "\n", self.loss, tuple(notes), self.left)
