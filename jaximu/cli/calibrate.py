"""`jaximu calibrate`: poses and turns, no equipment."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import jaximu
from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.cli.options import switch, takes_options
from jaximu.ground.errors import InputError


@takes_options
class CalibrateCommand(options.Fits):
    """Calibrate a unit from poses at rest and the turns between them, without equipment.

    Several LOGs are several recordings of one unit. DIR receives calibration.json, report.html and pictures.

    Examples:
      jaximu calibrate log.csv --latitude 48.1 --height 520 -o results
      jaximu calibrate log.csv --static rest.csv --gravity 9.80744+-0.0002
      jaximu calibrate log.mat --gyro-log gyro.mat --columns "time [s],accel [g],gyro [deg/s]"

    """

    logs: options.Logs
    method: Literal["joint", "two-step", "two-step-rk4", "accelerometer"] = switch(
        "Fit both sensors together, one after the other, or the accelerometer alone.", "joint"
    )
    loss: options.LossChoice = "linear"
    effect: options.EffectNames = ()
    poses: options.PoseOptions = options.POSES
    repair: options.RepairFlag = False
    means: bool = switch("LOG is a table with one row of mean outputs per pose, as papers print them.")
    traced: options.TraceOptions = options.TRACED

    def run(self) -> None:
        """Do what the command line says."""
        gravity, trace = self.local.value(), self.traced.value(self.logs)
        self.results.prepare(*options.INERTIAL[: 1 if self.method == "accelerometer" else 2])
        if self.means:
            meant = {
                "--static": self.noise.static,
                "--noise": self.noise.noise,
                "--effect": self.effect,
                "--threshold": self.poses.threshold,
                "--repair": self.repair,
                "--gyro-log": self.log.gyro_log,
                f"--method {self.method}": self.method.startswith("two-step"),
            }
            calibration = self._of_means(gravity, [name for name, stated in meant.items() if stated])
        else:
            recordings, known = self.log.read_unit(self.logs, gravity, self.noise)
            with progress("calibrating"):
                calibration = jaximu.calibrate(
                    recordings,
                    gravity,
                    static=known,
                    segmentation=self.poses.value(),
                    method=self.method,
                    loss=self.loss,
                    repair=self.repair,
                    **options.effects_of(self.effect),
                )
        calibration = replace(calibration, trace=trace)
        self.results.present(calibration.summary, calibration=calibration)

    def _of_means(self, gravity: jaximu.LocalGravity, unusable: list[str]) -> jaximu.Calibration:
        """Calibrate from a table of pose means."""
        if len(self.logs) != 1:
            raise InputError(f"--means takes one table, found {len(self.logs)} files.")
        if unusable:
            raise InputError(f"{unusable[0]} needs a recording's samples, which a table of means (--means) has not.")
        options.require_files(*self.logs)
        from jaximu.calibration import calibrate_means
        from jaximu.recordings.readers import read_means

        with progress("calibrating"):
            return calibrate_means(read_means(self.logs[0], self.log.reading(gravity)), gravity, self.loss)
