"""`jaximu turntable`: known poses and turns, from a rate table, a dividing head or six positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import UseAppendAction

import jaximu
from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.cli.options import option, switch, takes_options
from jaximu.ground.errors import InputError

if TYPE_CHECKING:
    from jaximu.recordings.entry import ScheduleEntry


@takes_options
class TurntableCommand(options.Fits):
    """Calibrate a unit on a rate table, a dividing head or in known positions.

    Several LOGs are several recordings of one unit. DIR receives calibration.json, report.html and pictures.

    Examples:
      jaximu turntable log.csv --reference schedule.csv -o results
      jaximu turntable log.csv --reference schedule.csv --latitude 48.1 --earth-rotation known
      jaximu turntable log.csv --reference schedule.csv --fit setup.table_tilt

    """

    logs: options.Logs
    reference: tuple[Path, ...] = option(
        "REF",
        "A schedule (CSV), named sections (JSON, or a column part), or a file with "
        "reference columns; once for each LOG. Without it the log's own reference columns are used.",
        (),
        UseAppendAction,
    )
    fit: tuple[str, ...] = option(
        "EFFECT",
        "Also fit this effect, such as setup.table_tilt or accel.quadratic. May be repeated.",
        (),
        UseAppendAction,
    )
    earth_rotation: Literal["known", "fit"] | None = switch(
        "Earth rotation: known from --latitude and the headings (x east, y north), or fitted (default: not modelled).",
        None,
    )
    loss: options.LossChoice = "linear"
    repair: options.RepairFlag = False
    traced: options.TraceOptions = options.TRACED

    def run(self) -> None:
        """Do what the command line says."""
        gravity, trace = self.local.value(), self.traced.value(self.logs)
        if self.earth_rotation == "known" and self.local.latitude is None:
            raise InputError("--earth-rotation known needs --latitude.")
        if self.reference and len(self.reference) != len(self.logs):
            raise InputError(f"{len(self.logs)} logs need as many --reference, found {len(self.reference)}.")
        self.results.prepare(*options.INERTIAL)
        recordings, known = self.log.read_unit(self.logs, gravity, self.noise, alone=True)
        references = references_of(recordings, self.reference)
        with progress("calibrating"):
            from jaximu.model.effects.earth_rotation import GyroEarthRotation

            wanted = (*self.fit, GyroEarthRotation.name) if self.earth_rotation == "fit" else self.fit
            calibration = jaximu.turntable(
                recordings,
                references,
                gravity,
                static=known,
                effects=list(dict.fromkeys(wanted)),
                latitude=self.local.latitude if self.earth_rotation == "known" else None,
                loss=self.loss,
                repair=self.repair,
            )
        calibration = replace(calibration, trace=trace)
        self.results.present(calibration.summary, calibration=calibration)


def references_of(recordings: list[jaximu.Recording], paths: Sequence[Path]) -> list[Sequence[ScheduleEntry]]:
    """Return the entries of each recording; a file of reference columns is put beside its recording's signals."""
    from jaximu.recordings.readers import read_reference
    from jaximu.recordings.reference import entries_of_columns

    entries = []
    for index, recording in enumerate(recordings):
        read = read_reference(paths[index], recording) if paths else recording
        if isinstance(read, jaximu.Recording):
            recordings[index] = read
            read = entries_of_columns(read)
        entries.append(read)
    return entries
