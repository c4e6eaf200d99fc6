"""`jaximu compare`: what moved between calibrations of a unit, and how it drifts over its history."""

from __future__ import annotations

from dataclasses import MISSING
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

import jaximu
from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.cli.options import option, switch, takes_options
from jaximu.ground.errors import InputError


@takes_options
class CompareCommand:
    """Compare calibrations of a unit: what moved, what that does to the output, how each number drifts.

    DIR receives compare.json, report.html and pictures.

    Examples:
      jaximu compare old/calibration.json new/calibration.json
      jaximu compare 2024.json 2025.json 2026.json --limits limits.toml -o history
      jaximu compare a.json b.json c.json --dates 2024-03-01,2025-03-04,2026-03-02

    """

    calibrations: tuple[Path, ...] = option(
        "CALIBRATION CALIBRATION...", "Two calibration.json of a unit, or more.", MISSING, Positional
    )
    dates: str | None = option(
        "DATES", "Date of each, in their order: 2025-03-04,2026-03-02; default: those they state, else a step apart."
    )
    limits: Path | None = option("LIMITS.toml", "Limits, as for jaximu accept: when is each reached at the drift seen?")
    rate: str = option("TEXT", "Compare the gyroscope's output up to this rate.", "250 deg/s")
    level: float = option("P", "Rate of false alarms, all numbers together.", 0.05)
    fail_on: Literal["never", "moved"] = switch(
        "Whether numbers that moved end with exit status 1, for scripts.", "never"
    )
    results: options.Results = options.RESULTS

    def run(self) -> None:
        """Do what the command line says."""
        if len(self.calibrations) < 2:
            raise InputError("name two calibrations of the unit or more: jaximu compare OLD.json NEW.json.")
        options.require_files(*self.calibrations, self.limits)
        self.results.prepare()
        from jaximu.cli.accept import limits_of
        from jaximu.model.data_sheet import SI_UNITS, parse_quantity

        fastest = parse_quantity(self.rate, SI_UNITS["angular_rate"]["B"], "--rate")
        with progress("comparing"):
            history = jaximu.compare(
                *map(jaximu.load_calibration, self.calibrations),
                dates=None if self.dates is None else [text.strip() for text in self.dates.split(",")],
                limits=None if self.limits is None else limits_of(self.limits, None, None),
                rate=fastest,
                level=self.level,
                files=[str(path) for path in self.calibrations],
            )
        self.results.present(history.summary, "compare.json, report.html and pictures", compare=history)
        if self.fail_on == "moved" and history.verdict == "moved":
            raise SystemExit(1)
