"""`jaximu thermal`: bias over temperature, from recordings at rest or by hand."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.errors import InputError
from jaximu.formats.atomic import write_folder

if TYPE_CHECKING:
    from rich.console import Console

    from jaximu.calibration import Calibration
    from jaximu.diagnosis.thermal_hand_held import HandHeldThermal
    from jaximu.thermal import ThermalCalibration
    from jaximu.thermal.autopilot import AutopilotParameters

__all__ = ["run"]

_FILES = {"px4": "px4.params", "ardupilot": "ardupilot.param"}


def run(
    logs: options.Logs,
    /,
    *,
    log: options.Reading = options.READING,
    local: options.Local = options.LOCAL,
    static: options.StaticLog = None,
    calibration: Annotated[
        Path | None,
        tyro.conf.arg(metavar="CALIBRATION", help="Add the thermal part to this calibration of the unit."),
    ] = None,
    block: Annotated[
        float | None,
        tyro.conf.arg(metavar="SECONDS", help="Average over blocks this long (default: about 600 blocks)."),
    ] = None,
    to: Annotated[
        tuple[Literal["px4", "ardupilot"], ...],
        tyro.conf.UseAppendAction,
        tyro.conf.arg(
            help="Also write an autopilot's parameters into DIR, and report what they lose. May be repeated."
        ),
    ] = (),
    sensor: Annotated[
        int | None,
        tyro.conf.arg(metavar="N", help="The sensor's number on the autopilot: 0 to 3 for PX4, 1 to 3 for ArduPilot."),
    ] = None,
    accel_id: Annotated[int, tyro.conf.arg(metavar="ID", help="PX4's device ID of the accelerometer.")] = 0,
    gyro_id: Annotated[int, tyro.conf.arg(metavar="ID", help="PX4's device ID of the gyroscope.")] = 0,
    results: options.Output = options.RESULTS,
) -> None:
    """Fit bias over temperature from LOGs of a unit at rest while its temperature changes.

    LOGs of poses and turns by hand while the temperature changes give bias, scale and misalignment over temperature.
    DIR receives calibration.json, thermal.json, report.html and pictures.

    Examples:
      jaximu thermal oven.csv -o results
      jaximu thermal cold.csv warm.csv --calibration results/calibration.json -o thermal
      jaximu thermal oven.csv --to px4 --accel-id 1310988 --gyro-id 1310988 -o px4

    """
    if to and results.output is None:
        raise InputError("--to writes into a folder: name it with -o DIR.")
    gravity = local.value()
    results.prepare()
    options.require_files(calibration)
    from jaximu.calibration import load_calibration
    from jaximu.diagnosis.thermal_hand_held import calibrate_thermal_by_hand, turned_by_hand
    from jaximu.thermal import calibrate_thermal
    from jaximu.thermal.flags import without_flagged

    base = None if calibration is None else load_calibration(calibration).inertial()
    recordings, noise = log.read_unit(logs, gravity, static)
    recordings = [without_flagged(each, path) for each, path in zip(recordings, logs, strict=True)]
    by_hand = [turned_by_hand(each) for each in recordings]
    if all(by_hand):
        if base is not None or block is not None or to:
            raise InputError("these are poses by hand: --calibration, --block and --to are for a unit at rest.")
        with progress("fitting"):
            moved = calibrate_thermal_by_hand(recordings, noise, gravity)
        _give_by_hand(moved, results)
        return
    if any(by_hand):
        first = str(logs[by_hand.index(True)])
        raise InputError(f"{first} is poses by hand and others are a unit at rest: give one kind at a time.")
    with progress("fitting"):
        found = calibrate_thermal(recordings, static=noise, base=base, block=block)
        exports = [_export(each, found, sensor, accel_id, gyro_id) for each in to]

    def write(folder: Path) -> list[Path]:
        from jaximu.report.thermal import write_thermal

        texts = {_FILES[each]: parameters.text.encode() for each, parameters in zip(to, exports, strict=True)}
        return [*write_folder(folder, texts), write_thermal(found, folder, exports)]

    results.give(
        found.text, lambda: _print(found, exports), write, calibration=found.calibration, thermal=found
    )  # fmt: skip


def _print_effects(console: Console, calibration: Calibration) -> None:
    from jaximu.cli.shown import table
    from jaximu.report.thermal import effect_rows

    rows = [*effect_rows(calibration)]
    table(console, ("effect", "x", "y", "z", "unit"), rows, "Effects, ± half of the 95 % interval")


def _give_by_hand(found: HandHeldThermal, results: options.Results) -> None:
    write = options.drawn("thermal_hand_held", "write_thermal_by_hand", found)
    results.give(found.text, lambda: _print_by_hand(found), write, calibration=found.calibration, thermal=found)


def _print_by_hand(found: HandHeldThermal) -> None:
    from jaximu.cli.shown import console as screen
    from jaximu.cli.shown import table
    from jaximu.report.thermal_hand_held import headline, limit_rows

    console = screen()
    for sentence in headline(found):
        console.print(sentence, markup=False)
    if found.steps:
        _print_effects(console, found.calibration)
    if found.limits:
        title = "Smaller than this, others could hide (90 % power)"
        table(console, ("effect", "size", "at the end"), [*limit_rows(found)], title)
    said = [f"{name} stays undetermined: {why}." for name, why in found.undetermined.items()]
    for text in (*said, *(f"note: {note}" for note in found.notes)):
        console.print(text, markup=False)


def _export(to: str, found: ThermalCalibration, sensor: int | None, accel_id: int, gyro_id: int) -> AutopilotParameters:
    from jaximu.thermal.autopilot import ardupilot_parameters, px4_parameters

    if to == "px4":
        return px4_parameters(found, 0 if sensor is None else sensor, accel_id, gyro_id)
    return ardupilot_parameters(found, 1 if sensor is None else sensor)


def _print(found: ThermalCalibration, exports: list[AutopilotParameters]) -> None:
    from jaximu.cli.shown import console as screen
    from jaximu.cli.shown import table
    from jaximu.report.thermal import (
        USER_UNITS,
        ambient_words,
        candidate_rows,
        headline,
        loss_words,
        ways,
    )

    console = screen()
    for sentence in headline(found):
        console.print(sentence, markup=False)
    for name, fit in found.fits.items():
        factor, unit = USER_UNITS[name]
        rows = []
        for axis in range(3):
            cells = [fit.before[axis], fit.after[axis], fit.candidate.held.rms[axis]]
            rows.append(("xyz"[axis], *(f"{factor * each:.3g}" for each in cells)))
        table(console, ("axis", "over temperature", "left", "held out"), rows, f"{name}, rms in {unit}")
        table(console, ("model", "effects", "held out, rms", "score, nats"), [*candidate_rows(found, name)])
    _print_effects(console, found.calibration)
    said = [
        *found.identifiability.words,
        *ways(found),
        *ambient_words(found),
        *(f"note: {note}" for note in found.notes),
    ]
    said += [text for each in exports for text in (loss_words(each, found), *(f"{each.name}: {n}" for n in each.notes))]
    for text in said:
        console.print(text, markup=False)
