"""`jaximu check`: is an old calibration still valid for a new recording, and what moved?"""

from __future__ import annotations

from typing import Annotated, Literal

from tyro.conf import arg

from jaximu.cli import options
from jaximu.cli.messages import progress

__all__ = ["run"]


def run(
    calibration: options.CalibrationFile,
    logs: options.Logs,
    /,
    *,
    log: options.Reading = options.READING,
    local: options.Local = options.LOCAL,
    noise: options.Noise = options.NOISE,
    poses: options.Poses = options.POSES,
    fail_on: Annotated[
        Literal["never", "invalid"],
        arg(help="Whether a calibration that is no longer valid ends with exit status 1, for scripts."),
    ] = "never",
    results: options.Output = options.RESULTS,
) -> None:
    """Check whether an old calibration is still valid for a new recording, and which parameters moved.

    Without poses, the calibrated unit is followed through LOG by a filter from its first rest, whose innovations
    answer as far as the recording allows. DIR receives check.json and report.html.

    Examples:
      jaximu check results/calibration.json new.csv --static rest.csv

    """
    gravity = local.value()
    options.require_files(calibration)
    results.prepare()
    from jaximu.calibration import load_calibration
    from jaximu.diagnosis import check

    old = load_calibration(calibration).inertial()
    recordings, known = log.alike(old).read_unit(logs, gravity, noise)
    with progress("checking"):
        validity = check(old, recordings, gravity, static=known, segmentation=poses.value())
    results.present(validity.summary, "check.json and report.html", check=validity)
    if fail_on == "invalid" and validity.verdict not in ("valid", "session"):
        raise SystemExit(1)
