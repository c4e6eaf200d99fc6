"""`jaximu array`: several units on one rigid body."""

from __future__ import annotations

from typing import Annotated

import tyro

from jaximu.cli.calibrate import prepare_folder
from jaximu.cli.options import (
    GravityOptions,
    JsonFlag,
    LogOptions,
    Logs,
    LossChoice,
    OutputFolder,
    RepairFlag,
    StaticLog,
    progress,
    require_files,
    say,
)

__all__ = ["run"]


def run(
    logs: Logs,
    /,
    *,
    log: Annotated[LogOptions, tyro.conf.arg(name="")] = LogOptions(),  # noqa: B008
    local: Annotated[GravityOptions, tyro.conf.arg(name="")] = GravityOptions(),  # noqa: B008
    static: StaticLog = None,
    loss: LossChoice = "linear",
    repair: RepairFlag = False,
    output: OutputFolder = None,
    as_json: JsonFlag = False,
) -> None:
    """Calibrate several units on one rigid body: rotation, position and clock of each, and which one disturbs.

    One LOG per unit, recorded together: poses at rest with turns between them, and some quick turns for the positions.
    DIR receives array.json, report.html, array.png and each unit's calibration.

    Examples:
      jaximu array unit1.csv unit2.csv unit3.csv -o results
      jaximu array unit*.parquet --accel-scale "2048 count/g" --gyro-scale "16.4 count/(deg/s)" --latitude 59.3

    """
    gravity = local.value()
    require_files(*logs, static)
    if output is not None:
        prepare_folder(output)
    with progress("reading"):
        recordings = log.read_all(logs, gravity)
        noise = None if static is None else log.read(static, gravity, check=False)
    with progress("calibrating"):
        from jaximu.calibration import calibrate_array

        found = calibrate_array(recordings, gravity, static=noise, loss=loss, repair=repair)
    from jaximu.report.array import HEADERS, headline, statements, unit_rows, write_array

    if as_json:
        print(found.text())
    else:
        from jaximu.cli.shown import console, table

        screen = console()
        screen.print(headline(found))
        table(screen, HEADERS, unit_rows(found), "± is 95 %; positions in the first unit's axes")
        for text in statements(found):
            screen.print(text)
    if output is not None:
        with progress("drawing the report"):
            written = write_array(found, output)
        for number, unit in enumerate(found.units, 1):
            unit.calibration.save(output / f"calibration_{number}.json")
        say(f"Written to {output}: {', '.join(path.name for path in written)}, calibration_1.json …")
    elif not as_json:
        say("Nothing was written: -o DIR writes array.json, report.html and the calibrations there.")
