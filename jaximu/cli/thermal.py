"""`jaximu thermal`: bias over temperature, from recordings at rest or by hand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import UseAppendAction, arg

from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.ground.errors import InputError

if TYPE_CHECKING:
    from jaximu.calibration import ThermalCalibration
    from jaximu.diagnosis.thermal_hand_held import HandHeldThermal
    from jaximu.report.export.thermal_autopilot import AutopilotParameters

__all__ = ["run"]


def run(
    logs: options.Logs,
    /,
    *,
    log: options.Reading = options.READING,
    local: options.Local = options.LOCAL,
    static: options.StaticLog = None,
    calibration: Annotated[
        Path | None, arg(metavar="CALIBRATION", help="Add the thermal part to this calibration of the unit.")
    ] = None,
    block: Annotated[
        float | None, arg(metavar="SECONDS", help="Average over blocks this long (default: about 600 blocks).")
    ] = None,
    to: Annotated[
        tuple[Literal["px4", "ardupilot"], ...],
        UseAppendAction,
        arg(help="Also write an autopilot's parameters into DIR, and report what they lose. May be repeated."),
    ] = (),
    sensor: Annotated[
        int | None, arg(metavar="N", help="The sensor's number on the autopilot: 0 to 3 for PX4, 1 to 3 for ArduPilot.")
    ] = None,
    accel_id: Annotated[int, arg(metavar="ID", help="PX4's device ID of the accelerometer.")] = 0,
    gyro_id: Annotated[int, arg(metavar="ID", help="PX4's device ID of the gyroscope.")] = 0,
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
    results.prepare(*options.INERTIAL)
    options.require_files(calibration)
    from jaximu.calibration import calibrate_thermal, load_calibration
    from jaximu.diagnosis.thermal_hand_held import calibrate_thermal_by_hand, turned_by_hand
    from jaximu.recordings.flags import without_flagged
    from jaximu.report.export.thermal_autopilot import ardupilot_parameters, px4_parameters

    base = None if calibration is None else load_calibration(calibration).inertial()
    recordings, noise = log.alike(base).read_unit(logs, gravity, static)
    recordings = [without_flagged(recording, path) for recording, path in zip(recordings, logs, strict=True)]
    by_hand = [turned_by_hand(recording) for recording in recordings]
    if all(by_hand):
        if base is not None or block is not None or to:
            raise InputError("these are poses by hand: --calibration, --block and --to are for a unit at rest.")
        with progress("fitting"):
            moved = calibrate_thermal_by_hand(recordings, noise, gravity)
        page = options.drawn("thermal_hand_held", "write_thermal_by_hand", moved)
        results.give(moved.text, lambda: _print_by_hand(moved), page, calibration=moved.calibration, thermal=moved)
        return
    if any(by_hand):
        first = str(logs[by_hand.index(True)])
        raise InputError(f"{first} is poses by hand and others are a unit at rest: give one kind at a time.")
    with progress("fitting"):
        thermal = calibrate_thermal(recordings, static=noise, base=base, block=block)
        exports = {"px4.params": px4_parameters(thermal, sensor or 0, accel_id, gyro_id)} if "px4" in to else {}
        if "ardupilot" in to:
            exports["ardupilot.param"] = ardupilot_parameters(thermal, 1 if sensor is None else sensor)
    parameters = tuple(exports.values())

    def write(folder: Path) -> Path:
        from jaximu.report.thermal import write_thermal

        return write_thermal(thermal, folder, parameters)

    results.give(
        thermal.text,
        lambda: _print(thermal, parameters),
        write,
        files={name: export.text.encode() for name, export in exports.items()},
        calibration=thermal.calibration,
        thermal=thermal,
    )


def _print_by_hand(thermal: HandHeldThermal) -> None:
    from jaximu.cli.shown import console, table
    from jaximu.report.thermal import EFFECTS, effect_rows
    from jaximu.report.thermal_hand_held import headline, limit_rows, undetermined

    screen = console()
    for sentence in headline(thermal):
        screen.print(sentence)
    if thermal.steps:
        table(screen, EFFECTS, effect_rows(thermal.calibration), "Effects, ± half of the 95 % interval")
    if thermal.limits:
        title = "Smaller than this, others could hide (90 % power)"
        table(screen, ("effect", "size", "at the end"), limit_rows(thermal), title)
    for text in (*undetermined(thermal), *(f"note: {note}" for note in thermal.notes)):
        screen.print(text)


def _print(thermal: ThermalCalibration, exports: Sequence[AutopilotParameters]) -> None:
    from jaximu.cli.shown import console, table
    from jaximu.report import thermal as report

    screen = console()
    for sentence in report.headline(thermal):
        screen.print(sentence)
    for name in thermal.fits:
        headers = ("axis", "over temperature", "left", "held out")
        unit, rows = report.rms_rows(thermal, name)
        table(screen, headers, rows, f"{name}, rms in {unit}")
        table(screen, ("model", "effects", "held out, rms", "score, nats"), report.candidate_rows(thermal, name))
    table(screen, report.EFFECTS, report.effect_rows(thermal.calibration), "Effects, ± half of the 95 % interval")
    texts = [*report.words(thermal), *(f"note: {note}" for note in thermal.notes)]
    for export in exports:
        texts += [report.loss_words(export, thermal), *(f"{export.name}: {note}" for note in export.notes)]
    for text in texts:
        screen.print(text)
