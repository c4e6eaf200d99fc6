"""What `jaximu thermal` says and draws: bias over temperature and its rate, what is left of it, what was covered."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaximu.calibration.calibration import Calibration
from jaximu.calibration.identifiability import ENOUGH
from jaximu.calibration.thermal import ThermalCalibration
from jaximu.calibration.thermal_regression import multifactor
from jaximu.calibration.thermal_selection import CUBIC
from jaximu.data.rest_blocks import LEAST_RANGE, RATE_BANDWIDTH
from jaximu.estimation.track import TEMPERATURE_WINDOW
from jaximu.ground.quantities import listed, number, readable, size, unit_text, with_interval
from jaximu.ground.units import PREFIXES, SENSOR_UNITS
from jaximu.mistakes.titles import effect_title
from jaximu.planning.ramps import next_ramps
from jaximu.recordings.recording import smoothed_slope
from jaximu.report.figures import dressed, new_figure
from jaximu.report.html import write_page

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from jaximu.report.export.thermal_autopilot import AutopilotParameters

__all__ = ["EFFECTS", "band_figure", "candidate_rows", "effect_rows", "headline", "loss_words", "residual_figure",
           "rms_rows", "words", "write_thermal"]  # fmt: skip

EFFECTS = ("effect", "x", "y", "z", "unit")
"""Headers of `effect_rows`."""
_ROWS = 45  # three to a term of a regression
_WORTH = 1.2  # times as large a share that a ramp must leave of some effect to be proposed
_MOST_DOTS = 600  # of a surface's data


def _size(name: str, axes: np.ndarray) -> str:
    """Return the rms of three axes together, SI, in the unit in which a person reads it."""
    return size(float(np.linalg.norm(axes)), SENSOR_UNITS[name])


def _unit(found: ThermalCalibration, name: str) -> tuple[float, str]:
    """Return the factor and the unit in which a person reads what temperature does to a triad."""
    return readable(SENSOR_UNITS[name], float(np.max(found.fits[name].after)))


def headline(found: ThermalCalibration) -> list[str]:
    """Return the sentences that a person wants first: what temperature did, what is left, by which model."""
    span, said = "{:.0f} and {:.0f} °C".format(*found.blocks.range).replace("-", "−"), []
    included, apart = (", jumps included", ", jumps apart") if found.jumps else ("", "")
    for name, fit in found.fits.items():
        effects = [effect_title(f"{PREFIXES[name]}.{each}") for each in fit.candidate.names]
        said.append(
            f"The {name}'s output at rest moves by {_size(name, fit.before)} rms between {span}. "
            f"With {listed(effects) if effects else 'no effect'} modelled, {_size(name, fit.after)} remain"
            f"{included}, {_size(name, fit.candidate.held.rms)} on {_folds(found)} left out{apart}."
        )
    return said


def _folds(found: ThermalCalibration) -> str:
    return "ramps" if len(found.identifiability.legs) > 3 else "stretches"


def rms_rows(found: ThermalCalibration, name: str) -> tuple[str, list[tuple[str, ...]]]:
    """Return the unit, and a row for each axis: rms over temperature, after the model, and on what was left out."""
    (factor, unit), fit = _unit(found, name), found.fits[name]
    sizes = factor * np.stack([fit.before, fit.after, fit.candidate.held.rms], axis=1)
    return unit, [(axis, *map(number, own)) for axis, own in zip("xyz", sizes.tolist(), strict=True)]


def candidate_rows(found: ThermalCalibration, name: str) -> list[tuple[str, ...]]:
    """Return rows of family, effects, rms on what was left out and score; those chosen are marked with their axes."""
    fit = found.fits[name]
    rows = []
    best = np.max([each.scores for each in fit.candidates], axis=0)
    for each in fit.candidates:
        axes = [axis for axis, family in zip("xyz", fit.families, strict=True) if family == each.family]
        chosen = "  " if not axes else "→ " if len(axes) == 3 else f"→ {', '.join(axes)}: "
        said = f"{each.family} (as the autopilots fit it)" if each.family == CUBIC else each.family
        gap = float(np.sum(each.scores - best))
        effects = "; ".join(effect_title(f"{PREFIXES[name]}.{one}").removeprefix(f"{name} ") for one in each.names)
        rows.append((chosen + said, effects or "none", _size(name, each.held.rms), f"{gap:+.1f}".replace("-", "−")))
    return rows


def effect_rows(calibration: Calibration) -> list[tuple[str, ...]]:
    """Return rows of effects' coefficients with 95 % half-widths, three a row, and one for each inner parameter."""
    rows, document = [], calibration.document()
    for name, entry in (item for triad in calibration.triads() for item in document[triad]["effects"].items()):
        coefficients, sigma = entry["coefficients"], entry["sigma"]
        if len(coefficients) <= 6 and sigma is not None:
            factor, unit = readable(entry["unit"], max(map(abs, coefficients)))
            cells = ["–" if c == s == 0 else with_interval(factor * c, factor * s)
                     for c, s in zip(coefficients, sigma, strict=True)]  # fmt: skip
            rows += [("" if k else effect_title(name), *cells[k : k + 3], unit) for k in range(0, len(cells), 3)]
        else:
            rows.append((effect_title(name), "a curve,", "see the", "report", ""))
        for key, each in entry["inner"].items():
            spread = each.get("sigma")
            value = number(each["value"], 4) if spread is None else with_interval(each["value"], spread)
            rows.append((f"  {key.replace('_', ' ')}", value, "", "", unit_text(each["unit"])))
    return rows


def words(found: ThermalCalibration) -> list[str]:
    """Say what the path of temperature separates, what to record next, and what a regression would leave."""
    return [*found.identifiability.words, *_ways(found), *_ambient(found)]


def _ways(found: ThermalCalibration) -> list[str]:
    """Say which ramp to run next, where the path hardly separates some effect."""
    weak = [name for name, part in found.identifiability.parts.items() if part.apart < ENOUGH]
    if not weak:
        return []
    now, options = next_ramps(found.blocks)
    then = options[0].parts
    if all(then[name].apart < _WORTH * now[name].apart for name in weak):
        return []
    shares = ", ".join(
        f"{name.replace('_', ' ')} {100 * now[name].apart:.2g} → {100 * then[name].apart:.2g} %" for name in weak
    )
    return [
        f"What to record next: {options[0].text}, with a soak at each end ({options[0].duration / 60:.0f} min). It "
        f"separates most of what looks alike now. Share of each effect that no other can imitate, now → then: {shares}."
    ]


def _ambient(found: ThermalCalibration) -> list[str]:
    """Say what a regression on the sensor's and the ambient temperature and their rates would leave, where it is known.

    The full quadratic of the four has 15 terms, of which an information criterion keeps some.
    """
    blocks = found.blocks
    if blocks.ambient is None or np.ptp(blocks.ambient) < LEAST_RANGE or len(blocks) < _ROWS:
        return []
    rate = np.concatenate([
        smoothed_slope((blocks.start + blocks.stop)[own] / 2, blocks.ambient[own], 3 * blocks.duration)
        for own in (blocks.log == log for log in range(len(blocks.recordings)))
    ])  # fmt: skip
    factors = {"T": blocks.temperature, "dT": blocks.rate, "To": blocks.ambient, "dTo": rate}
    said = []
    for name, fit in found.fits.items():
        fits = [multifactor(factors, values) for values in _added(found, name).T]
        held, kept = np.array([rms for _, rms in fits]), max(len(terms) for terms, _ in fits)
        said.append(
            f"The {name} by a regression on sensor and ambient temperature and their rates, at most {kept} of 15 terms "
            f"kept: {_size(name, held)} rms on fifths left out, against {_size(name, fit.candidate.held.rms)} of the "
            f"model above on {_folds(found)}."
        )
    return said


def loss_words(parameters: AutopilotParameters, found: ThermalCalibration) -> str:
    """Say what the cubics written for an autopilot leave of the recordings, beside the full model."""
    parts = [f"{_size(name, left)} rms of the {name}'s output, the full model {_size(name, found.fits[name].after)}"
             for name, left in parameters.left.items()]  # fmt: skip
    parts = parts or [f"{_size(name, loss)} rms between them and the {name}'s full model at steady temperatures"
                      for name, loss in parameters.loss.items()]  # fmt: skip
    return f"The numbers written for {parameters.name} leave {'; '.join(parts)}."


# --- pictures ---------------------------------------------------------------------------------------------------------


def _added(found: ThermalCalibration, name: str) -> np.ndarray:
    """Return what temperature added to each block (n, 3) by the data: the output less the level of its rest, SI."""
    fit, blocks = found.fits[name], found.blocks
    return blocks.means[name] - fit.level.T[blocks.level]


def _both_ways(found: ThermalCalibration) -> list[tuple[np.ndarray, dict[str, str]]]:
    """Return the blocks while it warms and while it cools, as masks (n,), and how they are drawn."""
    up = np.zeros(len(found.blocks), bool)
    for leg in found.identifiability.legs:
        up[leg.blocks] = leg.up
    parts = [(up, {"color": "#D55E00", "label": "warming"}), (~up, {"color": "#0072B2", "label": "cooling"})]
    return [(part, style) for part, style in parts if part.any()]


def surface_figure(found: ThermalCalibration, name: str) -> Figure:
    """Draw the bias over temperature and its rate with the data on it, an axis a panel."""
    factor, unit = _unit(found, name)
    blocks = found.blocks
    figure = new_figure(4.2)
    kelvin = np.linspace(*blocks.range, 31)
    rates = np.linspace(float(blocks.rate.min()), float(blocks.rate.max()), 15)
    surface = np.stack([found.bias(name, kelvin, float(rate))[0] for rate in rates])  # (r, m, 3)
    data, parts = _added(found, name), _both_ways(found)
    for axis in range(3):
        panel = figure.add_subplot(1, 3, axis + 1, projection="3d")
        x, y = np.meshgrid(kelvin, 60 * rates)
        panel.plot_surface(x, y, factor * surface[:, :, axis], color="#BBBBBB", alpha=0.45, linewidth=0)  # pyright: ignore
        for part, style in parts:
            few = np.flatnonzero(part)[:: 1 + len(blocks) // _MOST_DOTS]
            panel.scatter(blocks.temperature[few], 60 * blocks.rate[few], factor * data[few, axis],  # pyright: ignore
                          s=4, depthshade=False, **style)  # pyright: ignore[reportArgumentType] # fmt: skip
        panel.set_title(f"{'xyz'[axis]} [{unit}]", fontsize=11, fontweight="bold")
        panel.set_xlabel("T [°C]", fontsize=8)
        panel.set_ylabel("rate [K/min]", fontsize=8)
        panel.tick_params(labelsize=7)
    return figure


def band_figure(found: ThermalCalibration, name: str) -> Figure:
    """Draw the bias over temperature with its 95 % band, the data, and the cubic that autopilots fit."""
    factor, unit = _unit(found, name)
    kelvin = np.linspace(*found.blocks.range, 201)
    value, sigma = found.bias(name, kelvin)
    data, parts = _added(found, name), _both_ways(found)
    figure = new_figure(3.4)
    for axis, panel in enumerate(figure.subplots(1, 3)):
        for part, style in parts:
            panel.plot(found.blocks.temperature[part], factor * data[part, axis], ".", ms=2.5, **style)
        low, high = (factor * (value + sign * 1.96 * sigma)[:, axis] for sign in (-1, 1))
        panel.fill_between(kelvin, low, high, color="0.5", alpha=0.35, linewidth=0)
        panel.plot(kelvin, factor * value[:, axis], color="black", lw=1.1, label="steady, with 95 % band")
        dressed(panel, f"{'xyz'[axis]} [{unit}]", xlabel="temperature [°C]")
    figure.axes[0].legend(fontsize=7, frameon=False)
    return figure


def residual_figure(found: ThermalCalibration, name: str) -> Figure:
    """Draw what the model leaves of each block against temperature and time, up and down in two colours."""
    factor, unit = _unit(found, name)
    blocks, residual = found.blocks, factor * found.fits[name].residual
    figure, parts = new_figure(6.0), _both_ways(found)
    grid = figure.subplots(3, 2, sharey="row", sharex="col")
    for axis in range(3):
        for panel, x in zip(grid[axis], (blocks.temperature, blocks.time / 3600), strict=True):
            for part, style in parts:
                panel.plot(x[part], residual[part, axis], ".", ms=3, **style)
            panel.axhline(0.0, color="0.5", lw=0.8)
            dressed(panel)
        grid[axis][0].set_ylabel(f"{'xyz'[axis]} [{unit}]")
    dressed(grid[0][0], "Left of the bias, by temperature")
    dressed(grid[0][1], "by time")
    grid[0][0].legend(fontsize=8, frameon=False, ncols=2)
    grid[2][0].set_xlabel("temperature [°C]")
    grid[2][1].set_xlabel("time [h]")
    return figure


def covered_figure(found: ThermalCalibration) -> Figure:
    """Draw the temperatures and rates that the recordings went through."""
    blocks, figure = found.blocks, new_figure(3.4)
    left, right = figure.subplots(1, 2)
    for part, style in _both_ways(found):
        left.plot(blocks.temperature[part], 60 * blocks.rate[part], ".", ms=4, **style)
        right.plot(blocks.time[part] / 3600, blocks.temperature[part], ".", ms=3, **style)
    left.axhline(0.0, color="0.6", lw=0.8)
    left.legend(fontsize=8, frameon=False)
    dressed(left, "Temperatures and rates covered", xlabel="temperature [°C]", ylabel="rate of temperature [K/min]")
    dressed(right, "Over time", xlabel="time [h]", ylabel="temperature [°C]")
    return figure


def write_thermal(
    found: ThermalCalibration, folder: str | os.PathLike[str], exports: Sequence[AutopilotParameters] = ()
) -> Path:
    """Write pictures and `report.html`, whose path is returned. Raises `InputError` where they cannot be written."""
    panels = {"bias": band_figure, "surface": surface_figure, "residual": residual_figure}
    drawn = {f"{part}_{name}": partial(draw, found, name) for name in found.fits for part, draw in panels.items()}
    low, high = found.blocks.range
    names = ", ".join(Path(source.path).name for each in found.blocks.recordings for source in each.sources)
    return write_page(
        folder,
        "thermal",
        {"covered": partial(covered_figure, found), **drawn},
        title=f"Bias over temperature of {names or 'a recording'}",
        lead=headline(found),
        words=words(found),
        effects=effect_rows(found.calibration),
        low=number(low),
        high=number(high),
        triads=[(name, *rms_rows(found, name), candidate_rows(found, name)) for name in found.fits],
        reference=f"{found.reference:g}",
        block=f"{found.blocks.duration:.3g}",
        blocks=len(found.blocks),
        window=f"{TEMPERATURE_WINDOW:g}",
        bandwidth=f"{RATE_BANDWIDTH:.2g}",
        notes=found.notes,
        exports=[(each.name, loss_words(each, found), each.notes) for each in exports],
        version=found.software["version"],
    )
