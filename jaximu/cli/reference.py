"""`jaximu reference`: calibrate against a measured attitude that has its own clock."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from jaximu.cli.calibrate import effects_of, prepare_folder, print_calibration
from jaximu.cli.options import (
    GravityOptions,
    JsonFlag,
    LogOptions,
    LossChoice,
    OutputFolder,
    RepairFlag,
    StaticLog,
    progress,
    require_files,
    say,
)

if TYPE_CHECKING:
    from jaximu.calibration import Calibration

__all__ = ["run"]


def run(
    log_path: Annotated[
        Path, tyro.conf.Positional, tyro.conf.arg(name="log", metavar="LOG", help="The recording of the unit.")
    ],
    /,
    *,
    reference: Annotated[
        Path | None,
        tyro.conf.arg(
            metavar="REF",
            help="The reference: a table with time and quaternion, Euler angles or rotation vectors, and velocity or "
            "position if known; LOG itself if left out. Clocks, mounting and sense are found from the data.",
        ),
    ] = None,
    log: Annotated[LogOptions, tyro.conf.arg(name="")] = LogOptions(),  # noqa: B008
    local: Annotated[GravityOptions, tyro.conf.arg(name="")] = GravityOptions(),  # noqa: B008
    static: StaticLog = None,
    effect: Annotated[
        tuple[str, ...],
        tyro.conf.UseAppendAction,
        tyro.conf.arg(metavar="NAME", help="Also fit this effect, such as gyro.g_sensitivity. May be repeated."),
    ] = (),
    loss: LossChoice = "linear",
    repair: RepairFlag = False,
    output: OutputFolder = None,
    as_json: JsonFlag = False,
) -> None:
    """Calibrate a unit against a measured attitude (optics, an inertial system, a robot) that has its own clock.

    DIR receives calibration.json, report.html and pictures.

    Examples:
      jaximu reference log.csv --reference tracker.csv -o results
      jaximu reference session.mat -o results

    """
    gravity = local.value()
    require_files(log_path, reference)
    if output is not None:
        prepare_folder(output)
    from jaximu.formats import read_attitude

    with progress("reading"):
        recording = log.read(log_path, gravity)
        attitude = read_attitude(log_path if reference is None else reference)
        if reference is None or reference == log_path:  # one file, one clock
            attitude = replace(attitude, start=float(recording.start) if attitude.start == 0 else attitude.start)
        noise = None if static is None else log.read(static, gravity, check=False)
    from jaximu.calibration import calibrate_against_attitude

    with progress("calibrating"):
        calibration, measurement = calibrate_against_attitude(
            recording, attitude, gravity, static=noise, effects=effects_of(effect)[0], loss=loss, repair=repair
        )
    if as_json:
        print(calibration.text())
    else:
        _print(calibration)
    if output is not None:
        from jaximu.report.attitude import write_attitude_report

        calibration.save(output / "calibration.json")
        with progress("drawing the report"):
            report = write_attitude_report(calibration, measurement, output)
        say(f"Written: {output / 'calibration.json'}, {report}")
    elif not as_json:
        say("Nothing was written: -o DIR writes calibration.json and report.html there.")


def _print(calibration: Calibration) -> None:
    from rich.console import Console

    from jaximu.report.attitude import mounting_words, share_words

    print_calibration(replace(calibration, excess={}))
    console = Console(highlight=False)
    for text in mounting_words(calibration):
        console.print(text, markup=False)
    console.print(f"The misfit is made of: {'; '.join(share_words(calibration))}.", markup=False)
