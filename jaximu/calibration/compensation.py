"""Recordings corrected by a calibration."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import numpy as np

from jaximu.calibration.arrangement import axes_unlike
from jaximu.calibration.calibration import Calibration, require_calibration
from jaximu.estimation.track import TEMPERATURE_WINDOW, TRIADS
from jaximu.ground.errors import InputError
from jaximu.ground.precision import require_float64
from jaximu.ground.quantities import listed, number
from jaximu.ground.units import SENSOR_UNITS
from jaximu.model.sensor import Imu, Triad
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.recording import Recording, Signal, recordings_of, smoothed_slope
from jaximu.recordings.thermometer import course

_BEYOND = 0.5  # K outside the calibrated range from which a bias is extrapolated


_recover = eqx.filter_jit(Imu.recover)


def compensate(calibration: Calibration, recording: Recording) -> Recording:
    """Return the recording with calibrated outputs, in m/s² and rad/s, every effect of the device removed.

    Effects of a session or of the set-up belong to the recording that was calibrated and are left alone. Where the two
    sensors have stamps of their own, what one triad's effects need of the other is interpolated. A rate of temperature
    is the slope of a line through `TEMPERATURE_WINDOW` seconds of the recorded temperature, whose steps and noise are
    smoothed where they are coarse.

    Raises `InputError` if the recording's output unit is not the one that was calibrated, the gyroscope was not, or an
    effect needs what the recording lacks.
    """
    require_float64()
    require_calibration(calibration)
    (recording,) = recordings_of([recording])
    imu = calibration.imu.transferable()
    known = calibration.triads()
    signals = {name: recording.signals[name] for name in TRIADS if name in recording.signals}
    if "accelerometer" not in known:  # a gyroscope or a magnetometer alone: the rest stays as it is
        signals = {name: signal for name, signal in signals.items() if name in known}
    elif "accelerometer" not in signals:
        raise InputError(f"{recording.name} has no accelerometer, which the calibration needs beside the gyroscope.")
    for name in signals:
        if calibration.triad_of(name, recording) is None:
            raise InputError(f"{recording.name} has a gyroscope, but the calibration has none for it.")
    crossed = [effect.name for effect in imu.all_effects().values() if "specific_force" in effect.needs]
    if "gyroscope" in signals and "accelerometer" not in signals and crossed:
        raise InputError(f"{crossed[0]} needs the specific force, and the calibration has no accelerometer.")
    changed: dict[str, Signal] = {}
    results: dict[bytes, tuple] = {}  # sensors that share their stamps are recovered at once
    for name, signal in signals.items():
        time = signal.time
        if (key := time.tobytes()) not in results:
            outputs = {other: signal.at(time) for other, signal in signals.items()}
            stimulus = Stimulus(time=time)
            if recording.temperature is not None:
                temperature = course(recording.temperature).at(time)[:, 0]
                slope = smoothed_slope(time, temperature, TEMPERATURE_WINDOW)
                stimulus = replace(stimulus, temperature=temperature, temperature_rate=slope)
            force = outputs["accelerometer"] if "accelerometer" in outputs else np.zeros((len(time), 3))
            results[key] = _recover(imu, force, outputs.get("gyroscope"), stimulus)
        value = np.asarray(results[key][TRIADS.index(name)])
        changed[name] = Signal(time, value, SENSOR_UNITS[name])
    if imu.magnetometer is not None and recording.magnetometer is not None:
        rate = changed.get("gyroscope", recording.gyroscope)
        calibration.triad_of("magnetometer", recording)
        changed["magnetometer"] = _field(imu.magnetometer, recording, rate)
    if not changed:
        raise InputError(
            f"{recording.name} has no {listed([*known], 'or')}, and the calibration is of nothing else: nothing would "
            "be corrected."
        )
    left = sorted({e.name for t in calibration.triads().values() for e in t.effects if e.scope != "device"})
    notes = (
        "compensated by a calibration",
        *(f"{name} was not removed: it belongs to a session" for name in left),
        *_extrapolated(calibration, recording),
        *filter(None, [axes_unlike(recording, imu).strip()]),
    )
    return replace(recording, **changed, notes=(*recording.notes, *notes))


def _field(triad: Triad, recording: Recording, rate: Signal | None) -> Signal:
    """Return a magnetometer's samples as the field, µT, without its effects; rate: corrected, rad/s."""
    signal = recording.signals["magnetometer"]
    time = signal.time
    others = {"temperature": recording.temperature, "current": recording.current, "angular_rate": rate}
    known: dict[str, Any] = {name: signal.at(time) for name, signal in others.items() if signal is not None}
    known |= {name: known[name][:, 0] for name in ("temperature", "current") if name in known}
    field = eqx.filter_jit(Triad.recover)(triad, signal.values, Stimulus(time=time, **known))
    return Signal(time, np.asarray(field), "uT")


def _extrapolated(calibration: Calibration, recording: Recording) -> list[str]:
    """Say where the temperature leaves the range that a calibration over temperature saw."""
    covered, signal = calibration.data.get("temperature_range"), recording.temperature
    if covered is None or signal is None:
        return []
    low, high = covered
    share = float(((signal.values < low - _BEYOND) | (signal.values > high + _BEYOND)).mean())
    if not share:
        return []
    spanned = f"{signal.values.min():.1f} to {signal.values.max():.1f} °C"
    return [
        f"extrapolated: {number(100 * share, 2)} % of the temperatures ({spanned}) lie outside the {low:.1f} to "
        f"{high:.1f} °C that were calibrated"
    ]
