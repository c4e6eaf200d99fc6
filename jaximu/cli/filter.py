"""`jaximu filter`: calibration by a Kalman filter and smoother over a whole recording, and re-estimation in use."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from jaximu.cli.calibrate import prepare_folder, print_calibration
from jaximu.cli.options import (
    GravityOptions,
    JsonFlag,
    LogOptions,
    OutputFolder,
    RepairFlag,
    StaticLog,
    progress,
    require_files,
    say,
)

if TYPE_CHECKING:
    from jaximu.calibration import Calibration, History

__all__ = ["run"]


def run(
    log_path: Annotated[
        Path, tyro.conf.Positional, tyro.conf.arg(name="log", metavar="LOG", help="A recording that begins at rest.")
    ],
    /,
    *,
    online: Annotated[
        Path | None,
        tyro.conf.arg(
            metavar="CALIBRATION",
            help="Follow this calibrated unit through LOG, sample by sample: what changes, and is it this unit?",
        ),
    ] = None,
    log: Annotated[LogOptions, tyro.conf.arg(name="")] = LogOptions(),  # noqa: B008
    local: Annotated[GravityOptions, tyro.conf.arg(name="")] = GravityOptions(),  # noqa: B008
    static: StaticLog = None,
    repair: RepairFlag = False,
    output: OutputFolder = None,
    as_json: JsonFlag = False,
) -> None:
    """Calibrate from all of a recording, motion included, by a Kalman filter; or follow a calibrated unit in use.

    For good units and sequences of positions; for a consumer unit turned by hand use `jaximu calibrate`. DIR receives
    calibration.json, report.html and pictures.

    Examples:
      jaximu filter log.csv --static rest.csv --latitude 48.1 -o results
      jaximu filter log.csv --online results/calibration.json

    """
    gravity = local.value()
    require_files(log_path, online, static)
    if output is not None:
        prepare_folder(output)
    old = None
    if online is not None:
        from jaximu.calibration import load_calibration

        old = load_calibration(online).inertial()
    with progress("reading"):
        recording = log.read(log_path, gravity)
        still = None if static is None else log.read(static, gravity, check=False)
    from jaximu.calibration import calibrate_by_filter, followed_in_use
    from jaximu.noise.model import NoiseModel

    if old is None:
        with progress("filtering"):
            calibration, history = calibrate_by_filter(
                recording, gravity, latitude=local.latitude, static=still, repair=repair
            )
    else:
        noise = None if still is None else NoiseModel.fit(still)
        stated = local.gravity is not None or local.latitude is not None
        with progress("following"):
            calibration, history = followed_in_use(old, recording, noise, gravity if stated else None)
    if as_json:
        print(calibration.text())
    else:
        _print(calibration, history)
    if output is not None:
        from jaximu.report.filter import write_filter_report

        calibration.save(output / "calibration.json")
        with progress("drawing the report"):
            report = write_filter_report(calibration, history, output)
        say(f"Written: {output / 'calibration.json'}, {report}")
    elif not as_json:
        say("Nothing was written: -o DIR writes calibration.json and report.html there.")


def _print(calibration: Calibration, history: History) -> None:
    from jaximu.cli.shown import console as screen
    from jaximu.report.filter import statements

    print_calibration(calibration)
    console = screen()
    for each in statements(calibration, history):
        console.print(f"{each.about}: {each.text}", markup=False, highlight=False)
