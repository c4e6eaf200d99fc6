"""`jaximu array`: several units on one rigid body."""

from __future__ import annotations

import jaximu
from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.cli.options import takes_options


@takes_options
class ArrayCommand(options.Fits):
    """Calibrate several units on one rigid body: rotation, position and clock of each, and which one disturbs.

    One LOG per unit, recorded together: poses at rest with turns between them, and some quick turns for the positions.
    One LOG may hold them all: by the IDs of its rows (--device), or by its columns (--columns "…;…").
    DIR receives array.json, report.html, array.png and each unit's calibration.

    Examples:
      jaximu array unit1.csv unit2.csv unit3.csv -o results
      jaximu array rack.csv --device left,right,rear
      jaximu array unit*.parquet --accel-scale "2048 count/g" --gyro-scale "16.4 count/(deg/s)" --latitude 59.3

    """

    logs: options.Logs
    loss: options.LossChoice = "linear"
    repair: options.RepairFlag = False

    def run(self) -> None:
        """Do what the command line says."""
        gravity = self.local.value()
        self.results.prepare()
        recordings, known = self.log.read_unit(self.logs, gravity, self.noise, several=True)

        with progress("calibrating"):
            array = jaximu.array(recordings, gravity, static=known, loss=self.loss, repair=self.repair)
        units = {f"calibration_{number}": unit.calibration for number, unit in enumerate(array.units, 1)}
        self.results.present(
            array.summary, "array.json, report.html and the calibrations", {}, array.text, array=array, **units
        )
