"""What `jaximu thermal` says and draws of poses by hand: what temperature does to bias and scale, what is left."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaximu.calibration.thermal import change
from jaximu.calibration.thermal_terms import POWERS, SCALE
from jaximu.diagnosis.thermal_hand_held import HandHeldThermal
from jaximu.estimation.rows import TEMPERATURE
from jaximu.ground.quantities import Z95, readable, size
from jaximu.ground.summary import sentence
from jaximu.ground.units import SENSOR_UNITS
from jaximu.mistakes.titles import effect_title
from jaximu.model.effects import CATALOGUE
from jaximu.report.figures import AFTER, AXES, BEFORE, band, dressed, legend, legend_below, new_figure, zero_line
from jaximu.report.html import Folder, TextRows, write_page
from jaximu.report.thermal import effect_rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["headline", "limit_rows", "undetermined", "write_thermal_by_hand"]

_POWER = {name: power for power, name in enumerate(POWERS, 1)}


def headline(thermal: HandHeldThermal) -> list[str]:
    """Return the sentences that a person wants first: what is needed, and what it makes of each kind of error."""
    low, high = thermal.range
    names = ", ".join(effect_title(name) for name, *_ in thermal.steps)
    texts = [
        f"Poses and turns by hand between {low:.0f} and {high:.0f} °C: "
        + (
            f"{names} improve{'s' * (len(thermal.steps) == 1)} the prediction of parts left out."
            if names
            else "nothing of temperature pays on parts left out; what may still hide is below."
        )
    ]
    if names:
        before, after = (thermal.experiment.real.rms(state.conditions) for state in (thermal.base, thermal.state))
        for kind in thermal.experiment.real.kinds:
            texts.append(
                f"{sentence(kind.words)}: {size(before[kind.name][0], kind.unit)} rms with one bias and scale for all "
                f"temperatures, {size(after[kind.name][0], kind.unit)} with these effects."
            )
    return texts


def limit_rows(thermal: HandHeldThermal) -> TextRows:
    """Return by effect that was not taken in: its detection limit, and what that is at the end of the range.

    Of a scale or a misalignment in percent.
    """
    rows = []
    extent = max(abs(end - thermal.calibration.imu.accelerometer.temperature_reference) for end in thermal.range)
    for name, (value, unit) in thermal.limits.items():
        kind = CATALOGUE[name]
        triad = thermal.calibration.triads()[kind.owner]
        scale = np.mean(np.linalg.norm(np.asarray(triad.gain), axis=1))
        most = value * extent ** _POWER.get(kind.plain, 1) / scale
        shown = size(most, SENSOR_UNITS[kind.owner], 2) if kind.plain in POWERS else size(100 * most, "%", 2)
        rows.append((kind.title, size(value, unit, 2), shown))
    return rows


def undetermined(thermal: HandHeldThermal) -> list[str]:
    """Say which effects the recordings do not tell, and why."""
    return [f"{sentence(effect_title(name))} is not determined: {why}." for name, why in thermal.undetermined.items()]


def _changed(thermal: HandHeldThermal) -> list[tuple[str, str, tuple[str, ...], float]]:
    """Return triad and number that temperature changes, the effects behind it, and the input they are drawn at."""
    kinds: list[tuple[str, tuple[str, ...], float]] = [("bias", POWERS, 0.0), ("scale", (SCALE,), 1.0)]
    return [
        (owner, word, names, force)
        for word, names, force in kinds
        for owner, triad in thermal.calibration.triads().items()
        if any(effect.plain in names for effect in triad.effects)
    ]


def _change_figure(thermal: HandHeldThermal) -> Figure:
    """Draw bias and scale over temperature with their 95 % bands."""
    temperature, calibration = np.linspace(*thermal.range, 101), thermal.calibration
    drawn = []
    for owner, word, names, force in _changed(thermal):
        scale = np.linalg.norm(np.asarray(calibration.triads()[owner].gain), axis=1)
        value, sigma = (values / scale for values in change(calibration, owner, names, temperature, force=force))
        most = np.max(np.abs(value))
        factor, unit = readable(SENSOR_UNITS[owner], most) if word == "bias" else (100.0, "%")
        drawn.append((f"{sentence(owner)} {word} [{unit}]", factor * value, factor * sigma))
    rows = -(-len(drawn) // 2)
    figure = new_figure(2.9 * rows)
    panels = figure.subplots(rows, 2, squeeze=False).ravel()
    for panel in panels[len(drawn) :]:
        panel.remove()
    for panel, (title, value, sigma) in zip(panels, drawn, strict=False):
        for axis, (name, colour) in enumerate(AXES.items()):
            band(panel, temperature, value[:, axis], Z95 * sigma[:, axis], colour, label=name)
        zero_line(panel)
        dressed(panel, title, xlabel="temperature [°C]")
    legend(panels[0], 3)
    return figure


def _error_figure(thermal: HandHeldThermal) -> Figure:
    """Draw the errors of poses and turns over temperature, without and with the effects."""
    real = thermal.experiment.real
    poses = real.of_kind("gravity_norm")
    temperature = np.full(len(real.spans), np.nan)
    temperature[real.first[poses]] = real.covariates[TEMPERATURE][poses]
    temperature = (temperature[real.first] + temperature[real.last]) / 2
    series = [("one bias and scale for all temperatures", BEFORE, thermal.base)]
    series += [("with the effects", AFTER, thermal.state)] if thermal.steps else []
    figure = new_figure(3.6)
    panels = figure.subplots(1, len(real.kinds))
    for index, (panel, kind) in enumerate(zip(panels, real.kinds, strict=True)):
        errors = [np.abs(thermal.experiment.errors(state)[index]).max() for _, _, state in series]
        factor, unit = readable(kind.unit, max(errors))
        warmth = temperature[real.kind == index][:: kind.components]
        for label, colour, state in series:
            panel.plot(warmth, factor * thermal.experiment.errors(state)[index], ".", ms=5, color=colour, label=label)
        zero_line(panel)
        dressed(panel, xlabel="temperature [°C]")
        panel.set_title(f"{sentence(kind.words)} [{unit}]", loc="left", fontsize=9, fontweight="bold")
    legend_below(figure, panels[0], 2)
    return figure


def write_thermal_by_hand(thermal: HandHeldThermal, folder: Folder) -> Path:
    """Write pictures and `report.html`, whose path is returned. Raises `InputError` where they cannot be written."""
    drawn = {"errors": partial(_error_figure, thermal)}
    if _changed(thermal):
        drawn["over_temperature"] = partial(_change_figure, thermal)
    names = ", ".join(
        Path(source.path).name for recording in thermal.experiment.recordings for source in recording.sources
    )
    return write_page(
        folder,
        "thermal_hand_held",
        drawn,
        title=f"Bias and scale over temperature of {names or 'a recording'}",
        lead=headline(thermal),
        effects=effect_rows(thermal.calibration),
        limits=limit_rows(thermal),
        gains=[(effect_title(name), f"{statistic:.0f}", f"{gain:+.1f}") for name, statistic, gain in thermal.steps],
        undetermined=undetermined(thermal),
        low=f"{thermal.range[0]:.1f}",
        high=f"{thermal.range[1]:.1f}",
        reference=f"{thermal.calibration.imu.accelerometer.temperature_reference:g}",
        notes=[*thermal.notes, f"written by jaximu {thermal.software['version']}."],
    )
