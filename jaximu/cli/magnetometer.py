"""`jaximu magnetometer`: soft and hard iron, alignment to the accelerometer, and how good a heading becomes."""

from __future__ import annotations

from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import UseAppendAction

import jaximu
from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.cli.options import option, takes_options
from jaximu.ground.document import Json
from jaximu.ground.errors import InputError
from jaximu.ground.reexport import later

if TYPE_CHECKING:
    from jaximu.calibration import FieldStrength, MagneticLog


_NEAR_THE_EQUATOR = 20.0  # degrees of latitude within which the field may point up or down


@takes_options
class MagnetometerCommand(options.Reads):
    """Calibrate a magnetometer while the unit is turned about: scale, hard and soft iron, alignment.

    Several LOGs are several recordings of one unit. DIR receives calibration.json, report.html and pictures.

    Examples:
      jaximu magnetometer log.csv -o results
      jaximu magnetometer log.csv --mag-log mag.csv --field 48.9+-0.2
      jaximu magnetometer log.csv --latitude 52.5 --longitude 13.4 --date 2026-03-04
      jaximu magnetometer new.csv --check results/calibration.json

    """

    logs: options.Logs
    mag_log: tuple[Path, ...] = option(
        "LOG", "The magnetometer's own file, if it is not in LOG; once per LOG.", (), UseAppendAction
    )
    mag_columns: str | None = option("NAMES", "Its columns in order, as for --columns.")
    field: options.FieldText = None
    longitude: float | None = option(
        "DEG", "With --latitude and --date: strength and dip of the World Magnetic Model, instead of --field."
    )
    calibration: Path | None = option(
        "FILE", "Calibration of accelerometer and gyroscope (default: estimated from LOG if possible)."
    )
    check: Path | None = option("FILE", "Check whether this old calibration is still valid.")
    effect: tuple[str, ...] = option(
        "NAME[:onset=S]", "Also fit this effect: mag.lag, mag.temperature … May be repeated.", (), UseAppendAction
    )
    traced: options.TraceOptions = options.TRACED

    def run(self) -> None:
        """Do what the command line says."""
        options.require_files(*self.logs, *self.mag_log, self.calibration, self.check)
        if self.mag_log and len(self.mag_log) != len(self.logs):
            raise InputError(f"{len(self.logs)} logs need as many --mag-log, found {len(self.mag_log)}.")
        effects = [_effect(text) for text in self.effect]
        gravity, trace = self.local.value(), self.traced.value(self.logs)
        strength = _strength(self.field, self.local, self.longitude, trace)
        self.results.prepare()
        from jaximu.diagnosis import check_magnetometer, diagnose_magnetometer

        with progress("reading"):
            old = None if self.check is None else jaximu.load_calibration(self.check)
            base = None if self.calibration is None else jaximu.load_calibration(self.calibration).inertial()
            magnetic_logs = [
                _read(stated, path, self.mag_log[k] if self.mag_log else None, self.mag_columns)
                for k, (path, stated) in enumerate(self.log.alike(base or old).spread(self.logs))
            ]
        southern = (
            None
            if self.local.latitude is None or abs(self.local.latitude) < _NEAR_THE_EQUATOR
            else self.local.latitude < 0
        )
        with progress("calibrating"):
            result, measurement, heading = jaximu.magnetometer(
                magnetic_logs, strength, base, gravity, southern, effects
            )
        shift = None if old is None else check_magnetometer(old, result)
        with progress("asking for effects"):
            diagnosis = diagnose_magnetometer(result, measurement)
        result = replace(
            result, trace=trace, diagnosis=diagnosis.document() | ({} if shift is None else {"check": shift.document()})
        )

        remarks = [part.text() for part in filter(None, (shift, *diagnosis.causes))]
        self.results.present(
            lambda: later("report.magnetometer", "page_of")(result, measurement, heading, remarks), calibration=result
        )


def _strength(
    text: str | None, local: options.GravityOptions, longitude: float | None, trace: Json | None
) -> FieldStrength | None:
    """Return the field as it was stated, or of the World Magnetic Model, or None where nothing is known."""
    if longitude is not None:
        if text is not None:
            raise InputError("give either --field or --longitude, not both.")
        if local.latitude is None or "date" not in (trace or {}):
            raise InputError("--longitude needs --latitude and --date, such as --date 2026-03-04: the field changes.")
        from jaximu.ground.magnetic_field import world_magnetic_model

        return world_magnetic_model(local.latitude, longitude, date.fromisoformat((trace or {})["date"]), local.height)
    return options.field_strength(text)


def _effect(text: str) -> jaximu.Effect:
    from jaximu.calibration.calibration import effect_named

    name, _, inner = text.partition(":")
    kind = type(effect_named(name))
    try:
        values = {
            key.strip(): float(value) for key, _, value in (pair.partition("=") for pair in inner.split(",") if pair)
        }
    except ValueError:
        raise InputError(f"--effect {text!r} is not understood; write NAME or NAME:onset=30.") from None
    return kind.make(0.0, **values)


def _read(log: options.LogOptions, path: Path, mag_log: Path | None, mag_columns: str | None) -> MagneticLog:
    """Read one log; a file with a magnetometer alone is one, too."""
    from jaximu.calibration import MagneticLog
    from jaximu.recordings.readers import read_magnetometer
    from jaximu.recordings.recording import Reading

    reading = log.reading()
    if mag_log is not None:
        recording = log.read(path)
        signal, start, _ = read_magnetometer(mag_log, replace(reading, columns=mag_columns))
        shifted = replace(signal, time=signal.time + (start - float(recording.start)))
        _require_overlap(shifted.time, recording.accelerometer.time, mag_log, path)
        return MagneticLog(shifted, recording, str(path))
    signal, start, _ = read_magnetometer(path, replace(reading, columns=mag_columns or log.columns))
    try:
        recording = log.read(path)
    except InputError as error:
        reason = str(error).removeprefix(f"{path}: ").partition(";")[0]
        notes = (f"the magnetometer stands alone: {reason}.".replace("..", "."),)
        axes = log.axes if log.axes is not None or log.like is None else log.like.axes
        return MagneticLog(signal, None, str(path), notes, Reading(axes=axes, units={"magnetometer": signal.unit}))
    return MagneticLog(signal if recording.magnetometer is None else recording.magnetometer, recording, str(path))


def _require_overlap(first, second, mag_log: Path, path: Path) -> None:
    if first[0] > second[-1] or first[-1] < second[0]:
        raise InputError(
            f"{mag_log} lies from {first[0]:.6g} to {first[-1]:.6g} s on the clock of {path}, which lies from "
            f"{second[0]:.6g} to {second[-1]:.6g} s: they do not overlap. The stamps must be of one clock."
        )
