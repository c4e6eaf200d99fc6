"""`jaximu filter`: calibration by a Kalman filter and smoother over a whole recording, and re-estimation in use."""

from __future__ import annotations

from dataclasses import MISSING
from pathlib import Path

from tyro.conf import Positional

from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.cli.options import option, takes_options
from jaximu.cli.reference import read_reference
from jaximu.ground.errors import InputError
from jaximu.ground.reexport import later


@takes_options
class FilterCommand(options.Fits):
    """Calibrate from all of a recording, motion included, by a Kalman filter; or follow a calibrated unit in use.

    For good units and sequences of positions; for a consumer unit turned by hand use `jaximu calibrate`. Of a vehicle
    that stops it finds the gyroscope's bias, how the unit is mounted against the horizontal, and where forward is. DIR
    receives calibration.json, report.html and pictures.

    Examples:
      jaximu filter log.csv --static rest.csv --latitude 48.1 -o results
      jaximu filter drive.csv --latitude 48.1 -o results
      jaximu filter log.csv --effect accel.size_effect --effect setup.time_offset
      jaximu filter log.csv --reference tracker.csv
      jaximu filter log.csv --magnetometer results/magnetometer/calibration.json
      jaximu filter log.csv --online results/calibration.json
      jaximu filter log.csv --online results/calibration.json --reference tracker.csv
      jaximu filter log.csv --online results/calibration.json --magnetometer results/magnetometer/calibration.json

    """

    log_path: Path = option("LOG", "A recording that begins at rest.", MISSING, Positional, name="log")
    online: Path | None = option(
        "CALIBRATION", "Follow this calibrated unit through LOG, sample by sample: what changes, and is it this unit?"
    )
    reference: Path | None = option(
        "REF",
        "A measured attitude as a further measurement, with its own clock: a table with time and quaternion, "
        "Euler angles, rotation vectors or a table's angles (table_angle_z, table_angle_x …, outermost axis first) "
        "and velocity or position if known; may be LOG itself.",
    )
    magnetometer: Path | None = option(
        "CALIBRATION",
        "A calibration of the magnetometer in LOG (`jaximu magnetometer`): the Earth's field as a further "
        "measurement, which shows the heading of every rest.",
    )
    effect: options.EffectNames = ()
    repair: options.RepairFlag = False

    def run(self) -> None:
        """Do what the command line says."""
        gravity = self.local.value()
        if self.online is not None and self.effect:
            raise InputError("--effect is for a calibration: with --online the effects are those of CALIBRATION.")
        options.require_files(self.online, self.reference, self.magnetometer)
        self.results.prepare(*options.INERTIAL)
        from jaximu.calibration import calibrate_by_filter, followed_in_use, load_calibration
        from jaximu.noise.at_rest import noise_of

        old = None if self.online is None else load_calibration(self.online).inertial()
        compass = None if self.magnetometer is None else load_calibration(self.magnetometer)
        (recording,), known = self.log.alike(old or compass).read_unit((self.log_path,), gravity, self.noise)
        attitude = None if self.reference is None else read_reference(self.reference, self.log_path, recording)
        with progress("filtering" if old is None else "following"):
            if old is None:
                calibration, history = calibrate_by_filter(
                    recording,
                    gravity,
                    attitude=attitude,
                    latitude=self.local.latitude,
                    static=known,
                    repair=self.repair,
                    magnetometer=compass,
                    **options.effects_of(self.effect),
                )
            else:
                stated = gravity if self.local != options.LOCAL else None
                calibration, history = followed_in_use(old, recording, noise_of(known), stated, attitude, compass)
        self.results.present(lambda: later("report.filter", "page_of")(calibration, history), calibration=calibration)
