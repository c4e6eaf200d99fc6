"""What `jaximu thermal` says and draws of poses by hand: what temperature does to bias and scale, what is left."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaximu.calibration.thermal import change
from jaximu.calibration.thermal_terms import POWERS, SCALE
from jaximu.diagnosis.thermal_hand_held import HandHeldThermal
from jaximu.estimation.rows import TEMPERATURE
from jaximu.ground.quantities import readable, size
from jaximu.ground.summary import sentence
from jaximu.ground.units import SENSOR_UNITS
from jaximu.mistakes.titles import effect_title
from jaximu.model.effects import CATALOGUE
from jaximu.report.figures import AFTER, AXES, BEFORE, band, dressed, new_figure
from jaximu.report.html import write_page
from jaximu.report.thermal import effect_rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["headline", "limit_rows", "undetermined", "write_thermal_by_hand"]

_POWER = {name: power for power, name in enumerate(POWERS, 1)}


def headline(found: HandHeldThermal) -> list[str]:
    """Return the sentences that a person wants first: what is needed, and what it makes of each kind of error."""
    low, high = found.range
    names = ", ".join(effect_title(name) for name, *_ in found.steps)
    said = [
        f"Poses and turns by hand between {low:.0f} and {high:.0f} °C: "
        + (f"{names} improve{'s' * (len(found.steps) == 1)} the prediction of parts left out." if names else
           "nothing of temperature pays on parts left out; what may still hide is below.")
    ]  # fmt: skip
    if names:
        before, after = (found.experiment.real.rms(each.conditions) for each in (found.base, found.state))
        for kind in found.experiment.real.kinds:
            said.append(
                f"{sentence(kind.words)}: {size(before[kind.name][0], kind.unit)} rms with one bias and scale for all "
                f"temperatures, {size(after[kind.name][0], kind.unit)} with these effects."
            )
    return said


def limit_rows(found: HandHeldThermal) -> list[tuple[str, str, str]]:
    """Return by effect that was not taken in: its detection limit, and what that is at the end of the range.

    Of a scale or a misalignment in percent.
    """
    rows = []
    reach = max(abs(each - found.calibration.imu.accelerometer.temperature_reference) for each in found.range)
    for name, (value, unit) in found.limits.items():
        kind = CATALOGUE[name]
        triad = found.calibration.triads()[kind.owner]
        scale = float(np.mean(np.linalg.norm(np.asarray(triad.gain), axis=1)))
        most = value * reach ** _POWER.get(kind.plain, 1) / scale
        shown = size(most, SENSOR_UNITS[kind.owner], 2) if kind.plain in POWERS else size(100 * most, "%", 2)
        rows.append((kind.title, size(value, unit, 2), shown))
    return rows


def undetermined(found: HandHeldThermal) -> list[str]:
    """Say which effects the recordings do not tell, and why."""
    return [f"{sentence(effect_title(name))} is not determined: {why}." for name, why in found.undetermined.items()]


def _changed(found: HandHeldThermal) -> list[tuple[str, str, tuple[str, ...], float]]:
    """Return triad and number that temperature changes, the effects behind it, and the input they are drawn at."""
    kinds: list[tuple[str, tuple[str, ...], float]] = [("bias", POWERS, 0.0), ("scale", (SCALE,), 1.0)]
    return [
        (owner, word, names, force)
        for word, names, force in kinds
        for owner, triad in found.calibration.triads().items()
        if any(effect.plain in names for effect in triad.effects)
    ]


def _change_figure(found: HandHeldThermal) -> Figure:
    """Draw bias and scale over temperature with their 95 % bands."""
    kelvin, calibration = np.linspace(*found.range, 101), found.calibration
    drawn = []
    for owner, word, names, force in _changed(found):
        scale = np.linalg.norm(np.asarray(calibration.triads()[owner].gain), axis=1)
        value, sigma = (each / scale for each in change(calibration, owner, names, kelvin, force=force))
        most = float(np.max(np.abs(value)))
        factor, unit = readable(SENSOR_UNITS[owner], most) if word == "bias" else (100.0, "%")
        drawn.append((f"{sentence(owner)} {word} [{unit}]", factor * value, factor * sigma))
    rows = -(-len(drawn) // 2)
    figure = new_figure(2.9 * rows)
    panels = figure.subplots(rows, 2, squeeze=False).ravel()
    for panel in panels[len(drawn) :]:
        panel.remove()
    for panel, (title, value, sigma) in zip(panels, drawn, strict=False):
        for axis, (name, colour) in enumerate(AXES.items()):
            band(panel, kelvin, value[:, axis], 1.96 * sigma[:, axis], colour, label=name)
        panel.axhline(0.0, color="0.6", lw=0.8)
        dressed(panel, title, xlabel="temperature [°C]")
    panels[0].legend(fontsize=8, frameon=False, ncols=3)
    return figure


def _error_figure(found: HandHeldThermal) -> Figure:
    """Draw the errors of poses and turns over temperature, without and with the effects."""
    real = found.experiment.real
    poses = real.of_kind("gravity_norm")
    temperature = np.full(len(real.spans), np.nan)
    temperature[real.first[poses]] = real.covariates[TEMPERATURE][poses]
    temperature = (temperature[real.first] + temperature[real.last]) / 2
    series = [("one bias and scale for all temperatures", BEFORE, found.base)]
    series += [("with the effects", AFTER, found.state)] if found.steps else []
    figure = new_figure(3.6)
    panels = figure.subplots(1, len(real.kinds))
    for place, (panel, kind) in enumerate(zip(panels, real.kinds, strict=True)):
        errors = [np.abs(found.experiment.errors(state)[place]).max() for _, _, state in series]
        factor, unit = readable(kind.unit, float(max(errors)))
        warmth = temperature[real.kind == place][:: kind.components]
        for label, colour, state in series:
            panel.plot(warmth, factor * found.experiment.errors(state)[place], ".", ms=5, color=colour, label=label)
        panel.axhline(0.0, color="0.6", lw=0.8)
        dressed(panel, xlabel="temperature [°C]")
        panel.set_title(f"{sentence(kind.words)} [{unit}]", loc="left", fontsize=9, fontweight="bold")
    handles = panels[0].get_legend_handles_labels()
    figure.legend(*handles, loc="lower center", ncols=2, fontsize=8, frameon=False)
    return figure


def write_thermal_by_hand(found: HandHeldThermal, folder: str | os.PathLike[str]) -> Path:
    """Write pictures and `report.html`, whose path is returned. Raises `InputError` where they cannot be written."""
    drawn = {"errors": partial(_error_figure, found)}
    if _changed(found):
        drawn["over_temperature"] = partial(_change_figure, found)
    names = ", ".join(Path(source.path).name for each in found.experiment.recordings for source in each.sources)
    return write_page(
        folder,
        "thermal_hand_held",
        drawn,
        title=f"Bias and scale over temperature of {names or 'a recording'}",
        lead=headline(found),
        effects=effect_rows(found.calibration),
        limits=limit_rows(found),
        gains=[(effect_title(name), f"{statistic:.0f}", f"{gain:+.1f}") for name, statistic, gain in found.steps],
        undetermined=undetermined(found),
        low=f"{found.range[0]:.1f}",
        high=f"{found.range[1]:.1f}",
        reference=f"{found.calibration.imu.accelerometer.temperature_reference:g}",
        notes=[*found.notes, f"written by jaximu {found.software['version']}."],
    )
