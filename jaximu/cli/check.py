"""`jaximu check`: is an old calibration still valid for a new recording, and what moved?"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import jaximu
from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.cli.options import switch, takes_options

if TYPE_CHECKING:
    from jaximu.ground.page import Page


@takes_options
class CheckCommand(options.Fits):
    """Check whether an old calibration is still valid for a new recording, and which parameters moved.

    Without poses, the calibrated unit is followed through LOG by a filter from its first rest, whose innovations
    answer as far as the recording allows. DIR receives check.json and report.html.

    Examples:
      jaximu check results/calibration.json new.csv --static rest.csv

    """

    calibration: options.CalibrationFile
    logs: options.Logs
    poses: options.PoseOptions = options.POSES
    fail_on: Literal["never", "invalid"] = switch(
        "Whether a calibration that is no longer valid ends with exit status 1, for scripts.", "never"
    )

    def run(self) -> None:
        """Do what the command line says."""
        gravity = self.local.value()
        options.require_files(self.calibration)
        self.results.prepare()

        old = jaximu.load_calibration(self.calibration).inertial()
        recordings, known = self.log.alike(old).read_unit(self.logs, gravity, self.noise)
        with progress("checking"):
            validity = jaximu.check(old, recordings, gravity, static=known, segmentation=self.poses.value())

        def page() -> Page:
            content = validity.summary()
            return replace(content, next=options.with_paths(content.next, {"calibration": self.calibration}))

        self.results.present(page, "check.json and report.html", check=validity)
        if self.fail_on == "invalid" and validity.verdict not in ("valid", "session"):
            raise SystemExit(1)
