"""`jaximu export`: a calibration as another tool's file, with the equation to apply and what the file leaves out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from jaximu.cli import options
from jaximu.cli.messages import say
from jaximu.cli.options import option
from jaximu.ground.errors import InputError
from jaximu.ground.page import Code, Items, Page, Part, Section
from jaximu.ground.reexport import later
from jaximu.report.export.catalogue import WRITERS, writer
from jaximu.report.export.noise import TARGETS

__all__ = ["ExportCommand"]


@dataclass(frozen=True)
class ExportCommand:
    """Write a calibration for another tool, with the equation to apply and what the file cannot carry.

    Examples:
      jaximu export results/calibration.json --to px4
      jaximu export results/calibration.json --to kalibr --noise noise/imu.yaml

    """

    calibration: options.CalibrationFile
    to: Annotated[str, option("FORMAT", f"One of {', '.join(WRITERS)}.")]
    output: Annotated[Path | None, option("FILE", "Default: beside CALIBRATION.", name="output", aliases=["-o"])] = None
    noise: Annotated[Path | None, option("IMU.YAML", "Noise densities, as jaximu allan -o DIR writes them.")] = None
    axes: Annotated[
        str | None,
        option("MAP", "The --axes used for calibration, where CALIBRATION does not say how it was read."),
    ] = None
    instance: Annotated[int, option("N", "Which of the autopilot's sensors, from 0.")] = 0
    device: Annotated[int | None, option("ID", "The sensor's ID in PX4's parameters CAL_ACCn_ID.")] = None
    rate_range: Annotated[float, option("DEG/S", "State the error of what the file leaves out up to this rate.")] = 250
    temperature_range: Annotated[
        str | None, option("LOW,HIGH", "State it between these temperatures in °C (default: ±20 K).")
    ] = None
    as_json: options.JsonFlag = False

    def run(self) -> None:
        """Do what the command line says."""
        options.require_files(self.calibration, self.noise)
        options.require_apart(self.output, self.calibration, self.noise)
        if self.instance < 0:
            raise InputError(f"--instance: sensors count from 0, found {self.instance}.")
        rate, temperatures = _rate(self.rate_range), _temperatures(self.temperature_range)
        from jaximu.calibration import load_calibration
        from jaximu.recordings.readers.kalibr import read_noise
        from jaximu.report.export import ExportedUnit, Range, export, losses

        model = load_calibration(self.calibration)
        if self.noise is not None and not getattr(writer(self.to), "NOISE", False):
            also = "; `jaximu consequences --noise-for` writes the filter's parameters" if self.to in TARGETS else ""
            say(f"{self.noise} is not used: the {self.to} file holds a calibration and no noise{also}.")
        if not getattr(writer(self.to), "MAGNETIC", False):
            model = model.inertial()
        extent = Range.of(model, rate, temperatures)
        parameters = ExportedUnit.of(
            model, self.axes, None if self.noise is None else read_noise(self.noise), self.instance, self.device
        )
        path = self.output or self.calibration.with_name(f"{self.calibration.stem}_{self.to}{writer(self.to).SUFFIX}")
        written, paths = export(parameters, self.to, path)
        lost = losses(parameters, written, extent)
        equation = (written.parameters or parameters).axes
        left = [
            effect.title
            for triad in model.imu.triads().values()
            for effect in triad.effects
            if effect.scope != "device"
        ]
        if self.as_json:
            options.print_json(
                {
                    "format": self.to,
                    "files": [str(path) for path in paths],
                    "axes": equation,
                    "convention": written.convention,
                    "equation": written.equation,
                    "range": extent.text(),
                    "losses": [vars(loss) for loss in lost],
                }
            )
            return
        costs = [loss.text() for loss in lost]
        costs += [f"{', '.join(left)}: of one session, not of the unit, and never exported."] if left else []
        parts: list[Part] = [f"Convention: {written.convention}", Section("Apply:", (Code(written.equation),))]
        if costs:
            parts.append(Section(f"Not in the file, and what that costs over {extent.text()}:", (Items(costs),)))
        later("report.terminal", "show")(Page(f"Calibration for {self.to}", (equation,), first=parts))
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
