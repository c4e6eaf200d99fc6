"""`jaximu export`: a calibration as another tool's file, with the equation to apply and what the file leaves out."""

from __future__ import annotations

import math
from dataclasses import MISSING
from pathlib import Path
from typing import Literal

import jaximu
from jaximu.cli import options
from jaximu.cli.messages import say
from jaximu.cli.options import option, takes_options
from jaximu.ground.errors import InputError
from jaximu.ground.page import Code, Items, Page, Part, Section
from jaximu.ground.reexport import later
from jaximu.report.export.catalogue import WRITERS, writer
from jaximu.report.export.noise import TARGETS


@takes_options
class ExportCommand:
    """Write a calibration for another tool, with the equation to apply and what the file cannot carry.

    Examples:
      jaximu export results/calibration.json --to px4
      jaximu export results/calibration.json --to px4 --in-force flight.ulg
      jaximu export results/calibration.json --to kalibr --noise noise/imu.yaml

    """

    calibration: options.CalibrationFile
    to: str = option("FORMAT", f"One of {', '.join(WRITERS)}.", MISSING)
    output: Path | None = option("FILE", "Default: beside CALIBRATION.", aliases=["-o"])
    noise: Path | None = option("IMU.YAML", "Noise densities, as jaximu allan -o DIR writes them.")
    axes: str | None = option("MAP", "The --axes used for calibration, where CALIBRATION does not say how it was read.")
    in_force: Path | None = option(
        "FILE", "The autopilot's parameters during the log (.ulg, .bin, .params …): compose, and show what changes."
    )
    log_was: Literal["raw", "corrected"] | None = option(
        "{raw,corrected}", "Whether the calibrated log was corrected by these parameters, if it does not show."
    )
    instance: int | None = option("N", "Which of the autopilot's sensors, from 0 (default: 0).")
    device: int | None = option("ID", "The sensor's ID in PX4's parameters CAL_ACCn_ID.")
    rate_range: float = option("DEG/S", "State the error of what the file leaves out up to this rate.", 250)
    temperature_range: str | None = option("LOW,HIGH", "State it between these temperatures in °C (default: ±20 K).")
    as_json: options.JsonFlag = False

    def run(self) -> None:
        """Do what the command line says."""
        options.require_files(self.calibration, self.noise, self.in_force)
        options.require_apart(self.output, self.calibration, self.noise, self.in_force)
        if (self.instance or 0) < 0:
            raise InputError(f"--instance: sensors count from 0, found {self.instance}.")
        rate, temperatures = _rate(self.rate_range), _temperatures(self.temperature_range)
        from jaximu.recordings.readers.kalibr import read_noise
        from jaximu.recordings.readers.parameters import read_parameters
        from jaximu.report.export import Composition, ExportedUnit, Range, export, losses

        model = jaximu.load_calibration(self.calibration)
        noise = None if self.noise is None else read_noise(self.noise)
        to, tool = self.to, writer(self.to)
        if self.noise is not None and not getattr(tool, "NOISE", False):
            also = "; `jaximu consequences --noise-for` writes the filter's parameters" if to in TARGETS else ""
            say(f"{self.noise} is not used: the {to} file holds a calibration and no noise{also}.")
        if self.in_force is not None or not getattr(tool, "MAGNETIC", False):
            model = model.inertial()
        extent = Range.of(model, rate, temperatures)
        parameters = ExportedUnit.of(model, self.axes, noise, self.instance, self.device)
        composition = None
        if self.in_force is not None:
            composition = Composition.of(parameters, to, read_parameters(self.in_force), self.log_was)
            parameters = composition.unit
        elif model.reading is not None and model.reading.corrected and hasattr(tool, "FIRMWARE"):
            say(
                "The calibrated log was corrected by the autopilot's parameters: give those in force (--in-force FILE)."
            )
        path = self.output or self.calibration.with_name(f"{self.calibration.stem}_{to}{tool.SUFFIX}")
        options.require_apart(path, self.in_force)
        written, paths = export(parameters, to, path)
        lost = losses(parameters, written, extent)
        axes_words = (written.parameters or parameters).axes
        left = [
            effect.title
            for triad in model.imu.triads().values()
            for effect in triad.effects
            if effect.scope != "device"
        ]
        if self.as_json:
            document = {
                "format": to,
                "files": [str(path) for path in paths],
                "axes": axes_words,
                "convention": written.convention,
                "equation": written.equation,
                "range": extent.text(),
                "losses": [vars(loss) for loss in lost],
            }
            return options.print_json(document | ({} if composition is None else {"in_force": composition.document()}))
        costs = [loss.text() for loss in lost]
        costs += [f"{', '.join(left)}: of one session, not of the unit, and never exported."] if left else []
        parts: list[Part] = [f"Convention: {written.convention}", Section("Apply:", (Code(written.equation),))]
        if composition is not None:
            parts.append(composition.section())
        parts.append(Section(f"Not in the file, and what that costs over {extent.text()}:", (Items(costs),)))
        later("report.terminal", "show")(Page(f"Calibration for {to}", (axes_words,), first=parts))
        say(f"Written: {', '.join(map(str, paths))}")


def _rate(value: float) -> float:
    if not (math.isfinite(value) and 0.0 < value < 1e5):
        raise InputError(f"--rate-range: {value:g} is no angular rate in deg/s.")
    return math.radians(value)


def _temperatures(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        low, high = map(float, text.split(","))
    except ValueError:
        raise InputError(f"--temperature-range: {text!r} is not LOW,HIGH in degC, such as -10,50.") from None
    if not -273.15 < low < high < 1000.0:
        raise InputError(f"--temperature-range: {text!r} is no range of temperatures, lowest first.")
    return low, high
