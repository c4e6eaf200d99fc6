"""`jaximu reference`: calibrate against a measured attitude that has its own clock."""

from __future__ import annotations

from dataclasses import MISSING, replace
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

import jaximu
from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.cli.options import option, takes_options
from jaximu.ground.reexport import later

if TYPE_CHECKING:
    from jaximu.recordings.attitude import Attitude


@takes_options
class ReferenceCommand(options.Fits):
    """Calibrate a unit against a measured attitude (optics, an inertial system, a robot) that has its own clock.

    DIR receives calibration.json, report.html and pictures.

    Examples:
      jaximu reference log.csv --reference tracker.csv -o results
      jaximu reference session.mat -o results

    """

    log_path: Path = option("LOG", "The recording of the unit.", MISSING, Positional, name="log")
    reference: Path | None = option(
        "REF",
        "The reference: a table with time and quaternion, Euler angles, rotation vectors or a table's angles "
        "(table_angle_z, table_angle_x …, outermost axis first), and velocity or position if known; LOG itself if "
        "left out. Clocks, mounting and sense are found from the data.",
    )
    effect: options.EffectNames = ()
    loss: options.LossChoice = "linear"
    repair: options.RepairFlag = False

    def run(self) -> None:
        """Do what the command line says."""
        gravity = self.local.value()
        options.require_files(self.reference)
        self.results.prepare(*options.INERTIAL)
        (recording,), known = self.log.read_unit((self.log_path,), gravity, self.noise)

        attitude = read_reference(self.log_path if self.reference is None else self.reference, self.log_path, recording)
        with progress("calibrating"):
            calibration, measurement = jaximu.reference(
                recording,
                attitude,
                gravity,
                static=known,
                loss=self.loss,
                repair=self.repair,
                **options.effects_of(self.effect),
            )
        self.results.present(
            lambda: later("report.attitude", "page_of")(calibration, measurement), calibration=calibration
        )


def read_reference(path: Path, log_path: Path, recording: jaximu.Recording) -> Attitude:
    """Read a measured attitude; one that is in the log itself is on its clock."""
    from jaximu.recordings.readers import read_attitude

    with progress("reading the reference"):
        attitude = read_attitude(path)
    return replace(attitude, start=float(recording.start)) if path == log_path and attitude.start == 0 else attitude
