"""What `jaximu thermal` says and draws: bias over temperature and its rate, what is left of it, what was covered."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaximu.calibration.calibration import Calibration
from jaximu.calibration.identifiability import ENOUGH
from jaximu.calibration.thermal import ThermalCalibration
from jaximu.calibration.thermal_regression import multifactor
from jaximu.calibration.thermal_selection import CUBIC
from jaximu.data.rest_blocks import LEAST_RANGE, RATE_BANDWIDTH
from jaximu.estimation.track import TEMPERATURE_WINDOW
from jaximu.ground.quantities import Z95, listed, number, readable, size, unit_text, with_interval
from jaximu.ground.units import PREFIXES, SENSOR_UNITS
from jaximu.mistakes.titles import effect_title
from jaximu.planning.ramps import next_ramps
from jaximu.recordings.recording import smoothed_slope
from jaximu.report.figures import dressed, legend, new_figure, zero_line
from jaximu.report.html import Folder, TextRows, write_page

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from jaximu.report.export.thermal_autopilot import AutopilotParameters

__all__ = [
    "EFFECTS",
    "band_figure",
    "candidate_rows",
    "effect_rows",
    "headline",
    "loss_words",
    "residual_figure",
    "rms_rows",
    "words",
    "write_thermal",
]

EFFECTS = ("effect", "x", "y", "z", "unit")
"""Headers of `effect_rows`."""
_ROWS = 45  # three to a term of a regression
_WORTH = 1.2  # times as large a share that a ramp must leave of some effect to be proposed
_MOST_DOTS = 600  # of a surface's data


def _size(name: str, axes: np.ndarray) -> str:
    """Return the rms of three axes together, SI, in the unit in which a person reads it."""
    return size(float(np.linalg.norm(axes)), SENSOR_UNITS[name])


def _unit(thermal: ThermalCalibration, name: str) -> tuple[float, str]:
    """Return the factor and the unit in which a person reads what temperature does to a triad."""
    return readable(SENSOR_UNITS[name], np.max(thermal.fits[name].after))


def headline(thermal: ThermalCalibration) -> Iterator[str]:
    """Return the sentences that a person wants first: what temperature did, what is left, by which model."""
    span = "{:.0f} and {:.0f} °C".format(*thermal.blocks.range).replace("-", "−")
    included, apart = (", jumps included", ", jumps apart") if thermal.jumps else ("", "")
    for name, fit in thermal.fits.items():
        effects = [effect_title(f"{PREFIXES[name]}.{effect}") for effect in fit.candidate.names]
        yield (
            f"The {name}'s output at rest moves by {_size(name, fit.before)} rms between {span}. "
            f"With {listed(effects) if effects else 'no effect'} modelled, {_size(name, fit.after)} remain"
            f"{included}, {_size(name, fit.candidate.held.rms)} on {_folds(thermal)} left out{apart}."
        )


def _folds(thermal: ThermalCalibration) -> str:
    return "ramps" if len(thermal.identifiability.legs) > 3 else "stretches"


def rms_rows(thermal: ThermalCalibration, name: str) -> tuple[str, TextRows]:
    """Return the unit, and a row for each axis: rms over temperature, after the model, and on what was left out."""
    (factor, unit), fit = _unit(thermal, name), thermal.fits[name]
    sizes = factor * np.stack([fit.before, fit.after, fit.candidate.held.rms], axis=1)
    return unit, [(axis, *map(number, row)) for axis, row in zip("xyz", sizes.tolist(), strict=True)]


def candidate_rows(thermal: ThermalCalibration, name: str) -> TextRows:
    """Return rows of family, effects, rms on what was left out and score; those chosen are marked with their axes."""
    fit = thermal.fits[name]
    rows = []
    best = np.max([candidate.scores for candidate in fit.candidates], axis=0)
    for candidate in fit.candidates:
        axes = [axis for axis, family in zip("xyz", fit.families, strict=True) if family == candidate.family]
        chosen = "  " if not axes else "→ " if len(axes) == 3 else f"→ {', '.join(axes)}: "
        title = f"{candidate.family} (as the autopilots fit it)" if candidate.family == CUBIC else candidate.family
        gap = np.sum(candidate.scores - best)
        effects = "; ".join(effect_title(f"{PREFIXES[name]}.{one}").removeprefix(f"{name} ") for one in candidate.names)
        rows.append(
            (chosen + title, effects or "none", _size(name, candidate.held.rms), f"{gap:+.1f}".replace("-", "−"))
        )
    return rows


def effect_rows(calibration: Calibration) -> TextRows:
    """Return rows of effects' coefficients with 95 % half-widths, three a row, and one for each inner parameter."""
    rows, document = [], calibration.document()
    for name, entry in (item for triad in calibration.triads() for item in document[triad]["effects"].items()):
        coefficients, sigma = entry["coefficients"], entry["sigma"]
        if len(coefficients) <= 6 and sigma is not None:
            factor, unit = readable(entry["unit"], max(map(abs, coefficients)))
            cells = [
                "–" if c == s == 0 else with_interval(factor * c, factor * s)
                for c, s in zip(coefficients, sigma, strict=True)
            ]
            rows += [("" if k else effect_title(name), *cells[k : k + 3], unit) for k in range(0, len(cells), 3)]
        else:
            rows.append((effect_title(name), "a curve,", "see the", "report", ""))
        for key, parameter in entry["inner"].items():
            spread = parameter.get("sigma")
            value = number(parameter["value"], 4) if spread is None else with_interval(parameter["value"], spread)
            rows.append((f"  {key.replace('_', ' ')}", value, "", "", unit_text(parameter["unit"])))
    return rows


def words(thermal: ThermalCalibration) -> list[str]:
    """Say what the path of temperature separates, what to record next, and what a regression would leave."""
    return [*thermal.identifiability.words, *_ways(thermal), *_ambient(thermal)]


def _ways(thermal: ThermalCalibration) -> list[str]:
    """Say which ramp to run next, where the path hardly separates some effect."""
    weak = [name for name, part in thermal.identifiability.parts.items() if part.apart < ENOUGH]
    if not weak:
        return []
    now, options = next_ramps(thermal.blocks)
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


def _ambient(thermal: ThermalCalibration) -> Iterator[str]:
    """Say what a regression on the sensor's and the ambient temperature and their rates would leave, where it is known.

    The full quadratic of the four has 15 terms, of which an information criterion keeps some.
    """
    blocks = thermal.blocks
    if blocks.ambient is None or np.ptp(blocks.ambient) < LEAST_RANGE or len(blocks) < _ROWS:
        return
    rate = np.concatenate(
        [
            smoothed_slope((blocks.start + blocks.stop)[rows] / 2, blocks.ambient[rows], 3 * blocks.duration)
            for rows in (blocks.log == log for log in range(len(blocks.recordings)))
        ]
    )
    factors = {"T": blocks.temperature, "dT": blocks.rate, "To": blocks.ambient, "dTo": rate}
    for name, fit in thermal.fits.items():
        fits = [multifactor(factors, values) for values in _added(thermal, name).T]
        held, kept = np.array([rms for _, rms in fits]), max(len(terms) for terms, _ in fits)
        yield (
            f"The {name} by a regression on sensor and ambient temperature and their rates, at most {kept} of 15 terms "
            f"kept: {_size(name, held)} rms on fifths left out, against {_size(name, fit.candidate.held.rms)} of the "
            f"model above on {_folds(thermal)}."
        )


def loss_words(parameters: AutopilotParameters, thermal: ThermalCalibration) -> str:
    """Say what the cubics written for an autopilot leave of the recordings, beside the full model."""
    parts = [
        f"{_size(name, left)} rms of the {name}'s output, the full model {_size(name, thermal.fits[name].after)}"
        for name, left in parameters.left.items()
    ]
    parts = parts or [
        f"{_size(name, loss)} rms between them and the {name}'s full model at steady temperatures"
        for name, loss in parameters.loss.items()
    ]
    return f"The numbers written for {parameters.name} leave {'; '.join(parts)}."


# --- pictures ---------------------------------------------------------------------------------------------------------


def _added(thermal: ThermalCalibration, name: str) -> np.ndarray:
    """Return what temperature added to each block (n, 3) by the data: the output less the level of its rest, SI."""
    fit, blocks = thermal.fits[name], thermal.blocks
    return blocks.means[name] - fit.level.T[blocks.level]


def _both_ways(thermal: ThermalCalibration) -> list[tuple[np.ndarray, dict[str, str]]]:
    """Return the blocks while it warms and while it cools, as masks (n,), and how they are drawn."""
    up = np.zeros(len(thermal.blocks), bool)
    for leg in thermal.identifiability.legs:
        up[leg.blocks] = leg.up
    parts = [(up, {"color": "#D55E00", "label": "warming"}), (~up, {"color": "#0072B2", "label": "cooling"})]
    return [(part, style) for part, style in parts if part.any()]


def surface_figure(thermal: ThermalCalibration, name: str) -> Figure:
    """Draw the bias over temperature and its rate with the data on it, an axis a panel."""
    factor, unit = _unit(thermal, name)
    blocks = thermal.blocks
    figure = new_figure(4.2)
    temperature = np.linspace(*blocks.range, 31)
    rates = np.linspace(blocks.rate.min(), blocks.rate.max(), 15)
    surface = np.stack([thermal.bias(name, temperature, rate)[0] for rate in rates])  # (r, m, 3)
    data, parts = _added(thermal, name), _both_ways(thermal)
    for axis in range(3):
        panel: Any = figure.add_subplot(1, 3, axis + 1, projection="3d")
        x, y = np.meshgrid(temperature, 60 * rates)
        panel.plot_surface(x, y, factor * surface[:, :, axis], color="#BBBBBB", alpha=0.45, linewidth=0)
        for part, style in parts:
            few = np.flatnonzero(part)[:: 1 + len(blocks) // _MOST_DOTS]
            panel.scatter(
                blocks.temperature[few],
                60 * blocks.rate[few],
                factor * data[few, axis],
                s=4,
                depthshade=False,
                **style,
            )
        panel.set_title(f"{'xyz'[axis]} [{unit}]", fontsize=11, fontweight="bold")
        panel.set_xlabel("T [°C]", fontsize=8)
        panel.set_ylabel("rate [K/min]", fontsize=8)
        panel.tick_params(labelsize=7)
    return figure


def band_figure(thermal: ThermalCalibration, name: str) -> Figure:
    """Draw the bias over temperature with its 95 % band, the data, and the cubic that autopilots fit."""
    factor, unit = _unit(thermal, name)
    temperature = np.linspace(*thermal.blocks.range, 201)
    value, sigma = thermal.bias(name, temperature)
    data, parts = _added(thermal, name), _both_ways(thermal)
    figure = new_figure(3.4)
    for axis, panel in enumerate(figure.subplots(1, 3)):
        for part, style in parts:
            panel.plot(thermal.blocks.temperature[part], factor * data[part, axis], ".", ms=2.5, **style)
        low, high = (factor * (value + sign * Z95 * sigma)[:, axis] for sign in (-1, 1))
        panel.fill_between(temperature, low, high, color="0.5", alpha=0.35, linewidth=0)
        panel.plot(temperature, factor * value[:, axis], color="black", lw=1.1, label="steady, with 95 % band")
        dressed(panel, f"{'xyz'[axis]} [{unit}]", xlabel="temperature [°C]")
    legend(figure.axes[0])
    return figure


def residual_figure(thermal: ThermalCalibration, name: str) -> Figure:
    """Draw what the model leaves of each block against temperature and time, up and down in two colours."""
    factor, unit = _unit(thermal, name)
    blocks, residual = thermal.blocks, factor * thermal.fits[name].residual
    figure, parts = new_figure(6.0), _both_ways(thermal)
    grid = figure.subplots(3, 2, sharey="row", sharex="col")
    for axis in range(3):
        for panel, x in zip(grid[axis], (blocks.temperature, blocks.time / 3600), strict=True):
            for part, style in parts:
                panel.plot(x[part], residual[part, axis], ".", ms=3, **style)
            zero_line(panel)
            dressed(panel)
        grid[axis][0].set_ylabel(f"{'xyz'[axis]} [{unit}]")
    dressed(grid[0][0], "Left of the bias, by temperature")
    dressed(grid[0][1], "by time")
    legend(grid[0][0], 2)
    grid[2][0].set_xlabel("temperature [°C]")
    grid[2][1].set_xlabel("time [h]")
    return figure


def covered_figure(thermal: ThermalCalibration) -> Figure:
    """Draw the temperatures and rates that the recordings went through."""
    blocks, figure = thermal.blocks, new_figure(3.4)
    left, right = figure.subplots(1, 2)
    for part, style in _both_ways(thermal):
        left.plot(blocks.temperature[part], 60 * blocks.rate[part], ".", ms=4, **style)
        right.plot(blocks.time[part] / 3600, blocks.temperature[part], ".", ms=3, **style)
    zero_line(left)
    legend(left)
    dressed(left, "Temperatures and rates covered", xlabel="temperature [°C]", ylabel="rate of temperature [K/min]")
    dressed(right, "Over time", xlabel="time [h]", ylabel="temperature [°C]")
    return figure


def write_thermal(thermal: ThermalCalibration, folder: Folder, exports: Sequence[AutopilotParameters] = ()) -> Path:
    """Write pictures and `report.html`, whose path is returned. Raises `InputError` where they cannot be written."""
    panels = {"bias": band_figure, "surface": surface_figure, "residual": residual_figure}
    drawn = {f"{part}_{name}": partial(draw, thermal, name) for name in thermal.fits for part, draw in panels.items()}
    low, high = thermal.blocks.range
    names = ", ".join(Path(source.path).name for recording in thermal.blocks.recordings for source in recording.sources)
    return write_page(
        folder,
        "thermal",
        {"covered": partial(covered_figure, thermal), **drawn},
        title=f"Bias over temperature of {names or 'a recording'}",
        lead=[*headline(thermal)],
        words=words(thermal),
        effects=effect_rows(thermal.calibration),
        low=number(low),
        high=number(high),
        triads=[(name, *rms_rows(thermal, name), candidate_rows(thermal, name)) for name in thermal.fits],
        reference=f"{thermal.reference:g}",
        block=f"{thermal.blocks.duration:.3g}",
        blocks=len(thermal.blocks),
        window=f"{TEMPERATURE_WINDOW:g}",
        bandwidth=f"{RATE_BANDWIDTH:.2g}",
        notes=thermal.notes,
        exports=[(export.name, loss_words(export, thermal), export.notes) for export in exports],
        version=thermal.software["version"],
    )
