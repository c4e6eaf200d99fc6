"""`jaximu calibrate`: poses and turns, no equipment."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from jaximu.cli.options import (
    GravityOptions,
    JsonFlag,
    LogOptions,
    Logs,
    LossChoice,
    MinimumDuration,
    OutputFolder,
    RepairFlag,
    StaticLog,
    Threshold,
    TraceOptions,
    progress,
    require_files,
    say,
)

if TYPE_CHECKING:
    from jaximu.calibration import Calibration
    from jaximu.gravity import LocalGravity
    from jaximu.problem import Loss

__all__ = ["effects_of", "prepare_folder", "print_calibration", "run", "write_results"]


def run(
    logs: Logs,
    /,
    *,
    log: Annotated[LogOptions, tyro.conf.arg(name="")] = LogOptions(),  # noqa: B008
    local: Annotated[GravityOptions, tyro.conf.arg(name="")] = GravityOptions(),  # noqa: B008
    static: StaticLog = None,
    method: Annotated[
        Literal["joint", "two-step", "two-step-rk4", "accelerometer"],
        tyro.conf.arg(help="Fit both sensors together, one after the other, or the accelerometer alone."),
    ] = "joint",
    loss: LossChoice = "linear",
    effect: Annotated[
        tuple[str, ...],
        tyro.conf.UseAppendAction,
        tyro.conf.arg(
            metavar="NAME", help="Also fit this effect; NAME+-SIGMA if its size is known to SIGMA. May be repeated."
        ),
    ] = (),
    threshold: Threshold = None,
    minimum_duration: MinimumDuration = 0.8,
    repair: RepairFlag = False,
    means: Annotated[
        bool, tyro.conf.arg(help="LOG is a table with one row of mean outputs per pose, as papers print them.")
    ] = False,
    traced: Annotated[TraceOptions, tyro.conf.arg(name="")] = TraceOptions(),  # noqa: B008
    output: OutputFolder = None,
    as_json: JsonFlag = False,
) -> None:
    """Calibrate a unit from poses at rest and the turns between them, without equipment.

    Several LOGs are several recordings of one unit. DIR receives calibration.json, report.html and pictures.

    Examples:
      jaximu calibrate log.csv --latitude 48.1 --height 520 -o results
      jaximu calibrate log.csv --static rest.csv --gravity 9.80744+-0.0002
      jaximu calibrate log.mat --gyro-log gyro.mat --columns "time [s],accel [g],gyro [deg/s]"

    """
    gravity, trace = local.value(), traced.value(logs)
    if output is not None:
        prepare_folder(output)
    if means:
        meant = {"--static": static, "--effect": effect, "--threshold": threshold, "--repair": repair,
                 "--gyro-log": log.gyro_log, f"--method {method}": method.startswith("two-step")}  # fmt: skip
        unusable = [name for name, asked in meant.items() if asked]
        _show(replace(_calibrated_means(logs, log, gravity, loss, unusable), trace=trace), output, as_json)
        return
    with progress("reading"):
        recordings = log.read_all(logs, gravity)
        noise = None if static is None else log.read(static, gravity, check=False)
    with progress("calibrating"):
        from jaximu.calibration import calibrate
        from jaximu.segmentation import SegmentationOptions

        options = SegmentationOptions(threshold=threshold, minimum_duration=minimum_duration)
        names, sigmas = effects_of(effect)
        calibration = calibrate(
            recordings, gravity, static=noise, segmentation=options, effects=names, effect_sigmas=sigmas,
            method=method, loss=loss, repair=repair,
        )  # fmt: skip
    _show(replace(calibration, trace=trace), output, as_json)


def _calibrated_means(
    logs: tuple[Path, ...], log: LogOptions, gravity: LocalGravity, loss: Loss, unusable: list[str]
) -> Calibration:
    """Calibrate from a table of pose means."""
    from jaximu.errors import InputError

    if len(logs) != 1:
        raise InputError(f"--means takes one table, found {len(logs)} files.")
    if unusable:
        raise InputError(f"{unusable[0]} needs a recording's samples, which a table of means (--means) has not.")
    require_files(*logs)
    from jaximu.calibration import calibrate_means
    from jaximu.formats import read_means

    with progress("calibrating"):
        return calibrate_means(read_means(logs[0], log.reading(gravity)), gravity, loss)


def _show(calibration: Calibration, output: Path | None, as_json: bool) -> None:
    """Print a calibration and write it where asked."""
    if as_json:
        print(calibration.text())
    else:
        print_calibration(calibration)
    if output is not None:
        write_results(calibration, output)
    elif not as_json:
        say("Nothing was written: -o DIR writes calibration.json and report.html there.")


def effects_of(given: tuple[str, ...]) -> tuple[list[str], dict[str, float]]:
    """Return the effects that options name, and the standard deviations of those stated as NAME+-SIGMA."""
    from jaximu.errors import InputError

    names, sigmas = [], {}
    for text in given:
        name, stated, sigma = text.partition("+-")
        names.append(name.strip())
        if stated:
            try:
                sigmas[name.strip()] = float(sigma)
            except ValueError:
                raise InputError(f"--effect {text}: {sigma!r} is not a number.") from None
    return names, sigmas


def prepare_folder(folder: Path) -> None:
    """Fail before the work rather than after it where the folder cannot be made."""
    from jaximu.errors import InputError

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be made a folder for results: {error.strerror}.") from error


def write_results(calibration: Calibration, folder: Path) -> None:
    """Write `calibration.json` and the report into a folder."""
    from jaximu.report import write_report

    prepare_folder(folder)
    calibration.save(folder / "calibration.json")
    with progress("drawing the report"):
        report = write_report(calibration, folder)
    say(f"Written: {folder / 'calibration.json'}, {report}")


def print_calibration(calibration: Calibration) -> None:
    """Print what a person wants to see first."""
    from jaximu.cli.shown import show

    show(calibration.summary())
    print("Output y = gain·u + bias (+ effects), hence u = inverse(gain)·(y − bias): `jaximu compensate` applies it.")
