"""`jaximu thermal`: bias over temperature, from recordings at rest or by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from tyro.conf import UseAppendAction

import jaximu
from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.cli.options import option, switch, takes_options
from jaximu.ground.errors import InputError
from jaximu.ground.reexport import later


@takes_options
class ThermalCommand(options.Fits):
    """Fit bias over temperature from LOGs of a unit at rest while its temperature changes.

    LOGs of poses and turns by hand while the temperature changes give bias, scale and misalignment over temperature.
    DIR receives calibration.json, thermal.json, report.html and pictures.

    Examples:
      jaximu thermal oven.csv -o results
      jaximu thermal cold.csv warm.csv --calibration results/calibration.json -o thermal
      jaximu thermal oven.csv --to px4 --accel-id 1310988 --gyro-id 1310988 -o px4

    """

    logs: options.Logs
    calibration: Path | None = option("CALIBRATION", "Add the thermal part to this calibration of the unit.")
    block: float | None = option("SECONDS", "Average over blocks this long (default: about 600 blocks).")
    to: tuple[Literal["px4", "ardupilot"], ...] = switch(
        "Also write an autopilot's parameters into DIR, and report what they lose. May be repeated.",
        (),
        UseAppendAction,
    )
    sensor: int | None = option("N", "The sensor's number on the autopilot: 0 to 3 for PX4, 1 to 3 for ArduPilot.")
    accel_id: int = option("ID", "PX4's device ID of the accelerometer.", 0)
    gyro_id: int = option("ID", "PX4's device ID of the gyroscope.", 0)

    def run(self) -> None:
        """Do what the command line says."""
        if self.to and self.results.output is None:
            raise InputError("--to writes into a folder: name it with -o DIR.")
        gravity = self.local.value()
        self.results.prepare(*options.INERTIAL)
        options.require_files(self.calibration)
        from jaximu.diagnosis.thermal_hand_held import calibrate_thermal_by_hand, turned_by_hand
        from jaximu.recordings.flags import without_flagged
        from jaximu.report.export.thermal_autopilot import ardupilot_parameters, px4_parameters

        base = None if self.calibration is None else jaximu.load_calibration(self.calibration).inertial()
        recordings, known = self.log.alike(base).read_unit(self.logs, gravity, self.noise)
        recordings = [without_flagged(recording, path) for recording, path in zip(recordings, self.logs, strict=True)]
        by_hand = [turned_by_hand(recording) for recording in recordings]
        if all(by_hand):
            if base is not None or self.block is not None or self.to:
                raise InputError("these are poses by hand: --calibration, --block and --to are for a unit at rest.")
            with progress("fitting"):
                turned = calibrate_thermal_by_hand(recordings, known, gravity)
            self.results.present(turned.summary, text=turned.text, calibration=turned.calibration, thermal=turned)
            return
        if any(by_hand):
            first = str(self.logs[by_hand.index(True)])
            raise InputError(f"{first} is poses by hand and others are a unit at rest: give one kind at a time.")
        with progress("fitting"):
            thermal = jaximu.thermal(recordings, static=known, base=base, block=self.block)
            exports = {}
            if "px4" in self.to:
                exports["px4.params"] = px4_parameters(thermal, self.sensor or 0, self.accel_id, self.gyro_id)
            if "ardupilot" in self.to:
                exports["ardupilot.param"] = ardupilot_parameters(thermal, 1 if self.sensor is None else self.sensor)
        self.results.present(
            lambda: later("report.thermal", "page_of")(thermal, (*exports.values(),)),
            files={name: export.text.encode() for name, export in exports.items()},
            text=thermal.text,
            calibration=thermal.calibration,
            thermal=thermal,
        )
