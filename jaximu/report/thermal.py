"""What `jaximu thermal` says and draws: bias over temperature and its rate, what is left of it, what was covered."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaximu.calibration.calibration import TEMPERATURE_WINDOW, Calibration
from jaximu.quantities import number
from jaximu.recording import smoothed_slope
from jaximu.report.figures import new_figure, png
from jaximu.report.html import Picture, template, write_page
from jaximu.summary import sentence
from jaximu.thermal.calibration import PREFIXES, ThermalCalibration
from jaximu.thermal.identifiability import ENOUGH
from jaximu.thermal.ramps import next_ramps
from jaximu.thermal.regression import multifactor
from jaximu.thermal.rest import LEAST_RANGE, RATE_BANDWIDTH
from jaximu.thermal.selection import CUBIC

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from jaximu.thermal.autopilot import AutopilotParameters

__all__ = [
    "USER_UNITS",
    "ambient_words",
    "candidate_rows",
    "dressed",
    "effect_rows",
    "headline",
    "loss_words",
    "ways",
    "write_thermal",
]

USER_UNITS = {"accelerometer": (1e3 / 9.80665, "mg"), "gyroscope": (float(np.degrees(1.0)), "°/s")}
_WORTH = 1.2  # times as large a share that a ramp must leave of some effect to be proposed
_UP, _DOWN = "#D55E00", "#0072B2"


def headline(found: ThermalCalibration) -> list[str]:
    """Return the sentences that a person wants first: what temperature did, what is left, by which model."""
    low, high = found.blocks.range
    said = []
    for name, fit in found.fits.items():
        factor, unit = USER_UNITS[name]
        before, after, held = (
            factor * float(np.linalg.norm(each)) for each in (fit.before, fit.after, fit.candidate.held.rms)
        )
        effects = ", ".join(f"{PREFIXES[name]}.{each}" for each in fit.candidate.names) or "nothing"
        said.append(
            f"The {name}'s output at rest moves by {number(before)} {unit} rms between {low:.0f} and {high:.0f} °C; "
            f"{number(after, 2)} {unit} are left by {effects}, {number(held, 2)} {unit} on {_folds(found)} left out."
        )
    return said


def _folds(found: ThermalCalibration) -> str:
    return "ramps" if len(found.identifiability.legs) > 3 else "stretches"


def candidate_rows(found: ThermalCalibration, name: str) -> list[tuple[str, ...]]:
    """Return rows of family, effects, rms on what was left out and score; those chosen are marked with their axes."""
    factor, unit = USER_UNITS[name]
    fit = found.fits[name]
    rows = []
    best = np.max([each.scores for each in fit.candidates], axis=0)
    for each in fit.candidates:
        axes = [axis for axis, family in zip("xyz", fit.families, strict=True) if family == each.family]
        chosen = "  " if not axes else "→ " if len(axes) == 3 else f"→ {', '.join(axes)}: "
        said = f"{each.family} (as the autopilots fit it)" if each.family == CUBIC else each.family
        held = factor * float(np.linalg.norm(each.held.rms))
        gap = float(np.sum(each.scores - best))
        rows.append((chosen + said, ", ".join(each.names) or "none", f"{held:.3g} {unit}", f"{gap:+.1f}"))
    return rows


def effect_rows(calibration: Calibration) -> list[tuple[str, ...]]:
    """Return rows of effects' coefficients with 95 % half-widths, three a row, and one for each inner parameter."""
    rows = []
    for triad in calibration.triads():
        for name, entry in calibration.document()[triad]["effects"].items():
            coefficients, sigma = entry["coefficients"], entry["sigma"]
            if len(coefficients) <= 6 and sigma is not None:
                cells = ["–" if c == s == 0 else f"{c:.4g} ± {1.96 * s:.2g}"
                         for c, s in zip(coefficients, sigma, strict=True)]  # fmt: skip
                for k in range(0, len(cells), 3):
                    rows.append(("" if k else name, *cells[k : k + 3], entry["unit"]))
            else:
                rows.append((name, "a curve,", "see the", "report", ""))
            for key, each in entry["inner"].items():
                spread = each.get("sigma")
                value = f"{each['value']:.4g}" + ("" if spread is None else f" ± {1.96 * spread:.2g}")
                rows.append((f"  {key.replace('_', ' ')}", value, "", "", each["unit"]))
    return rows


def ways(found: ThermalCalibration) -> list[str]:
    """Say which ramp to run next, where the path hardly separates some effect."""
    weak = [name for name, part in found.identifiability.parts.items() if part.apart < ENOUGH]
    if not weak:
        return []
    now, options = next_ramps(found.blocks)
    best = options[0]
    if all(best.left[name] < _WORTH * now.left[name] for name in weak):
        return []
    shares = ", ".join(f"{name} {100 * now.left[name]:.2g} → {100 * best.left[name]:.2g} %" for name in weak)
    return [
        f"What to record next: {best.text}, with a soak at each end ({best.duration / 60:.0f} min). It separates most "
        f"of what looks alike now. Share of each effect that no other can imitate, now → then: {shares}."
    ]


def ambient_words(found: ThermalCalibration) -> list[str]:
    """Say what a regression on the sensor's and the ambient temperature and their rates would leave, where it is known.

    The full quadratic of the four has 15 terms, of which an information criterion keeps some.
    """
    blocks = found.blocks
    if blocks.ambient is None or np.ptp(blocks.ambient) < LEAST_RANGE:
        return []
    rate = np.concatenate([
        smoothed_slope((blocks.start + blocks.stop)[own] / 2, blocks.ambient[own], 3 * blocks.duration)
        for own in (blocks.log == log for log in range(len(blocks.recordings)))
    ])  # fmt: skip
    factors = {"T": blocks.temperature, "dT": blocks.rate, "To": blocks.ambient, "dTo": rate}
    said = []
    for name, fit in found.fits.items():
        factor, unit = USER_UNITS[name]
        fits = [multifactor(factors, values) for values in _added(found, name).T]
        held, kept = float(np.linalg.norm([each.held_out for each in fits])), max(len(each.terms) for each in fits)
        said.append(
            f"The {name} by a regression on sensor and ambient temperature and their rates, at most {kept} of 15 terms "
            f"kept: {number(factor * held, 2)} {unit} rms on fifths left out, against "
            f"{number(factor * float(np.linalg.norm(fit.candidate.held.rms)), 2)} {unit} of the model above on "
            f"{_folds(found)}."
        )
    return said


def loss_words(parameters: AutopilotParameters, found: ThermalCalibration) -> str:
    """Say what the cubics written for an autopilot leave of the recordings, beside the full model."""
    parts = []
    for name, loss in parameters.loss.items():
        factor, unit = USER_UNITS[name]
        full = factor * float(np.linalg.norm(found.fits[name].after))
        if name in parameters.left:
            left = factor * float(np.linalg.norm(parameters.left[name]))
            parts.append(
                f"{number(left, 2)} {unit} rms of the {name}'s output, the full model {number(full, 2)} {unit}"
            )
        else:
            lost = factor * float(np.linalg.norm(loss))
            parts.append(
                f"{number(lost, 2)} {unit} rms between them and the {name}'s full model at steady temperatures"
            )
    return f"The numbers written for {parameters.name} leave {'; '.join(parts)}."


# --- pictures ---------------------------------------------------------------------------------------------------------


def _added(found: ThermalCalibration, name: str) -> np.ndarray:
    """Return what temperature added to each block (n, 3) by the data: the output less the level of its rest, SI."""
    fit, blocks = found.fits[name], found.blocks
    return blocks.means[name] - fit.level.T[blocks.level]


def _up(found: ThermalCalibration) -> np.ndarray:
    up = np.zeros(len(found.blocks), bool)
    for leg in found.identifiability.legs:
        up[leg.blocks] = leg.up
    return up


def surface_figure(found: ThermalCalibration, name: str) -> Figure:
    """Draw the bias over temperature and its rate with the data on it, an axis a panel."""
    factor, unit = USER_UNITS[name]
    blocks = found.blocks
    figure = new_figure(4.2)
    kelvin = np.linspace(*blocks.range, 31)
    rates = np.linspace(float(blocks.rate.min()), float(blocks.rate.max()), 15)
    surface = np.stack([found.bias(name, kelvin, float(rate))[0] for rate in rates])  # (r, m, 3)
    data, up = _added(found, name), _up(found)
    for axis in range(3):
        panel = figure.add_subplot(1, 3, axis + 1, projection="3d")
        x, y = np.meshgrid(kelvin, 60 * rates)
        panel.plot_surface(x, y, factor * surface[:, :, axis], color="#BBBBBB", alpha=0.45, linewidth=0)  # pyright: ignore
        for part, colour in ((up, _UP), (~up, _DOWN)):
            panel.scatter(blocks.temperature[part], 60 * blocks.rate[part], factor * data[part, axis],  # pyright: ignore
                          s=4, color=colour, depthshade=False)  # fmt: skip
        panel.set_title(f"{'xyz'[axis]} [{unit}]", fontsize=11, fontweight="bold")
        panel.set_xlabel("T [°C]", fontsize=8)
        panel.set_ylabel("rate [K/min]", fontsize=8)
        panel.tick_params(labelsize=7)
    return figure


def band_figure(found: ThermalCalibration, name: str) -> Figure:
    """Draw the bias over temperature with its 95 % band, the data, and the cubic that autopilots fit."""
    factor, unit = USER_UNITS[name]
    blocks = found.blocks
    kelvin = np.linspace(*blocks.range, 201)
    value, sigma = found.bias(name, kelvin)
    data, up = _added(found, name), _up(found)
    figure = new_figure(3.4)
    for axis, panel in enumerate(figure.subplots(1, 3)):
        for part, colour, label in ((up, _UP, "warming"), (~up, _DOWN, "cooling")):
            if part.any():
                panel.plot(blocks.temperature[part], factor * data[part, axis], ".", ms=2.5, color=colour, label=label)
        low, high = (factor * (value + sign * 1.96 * sigma)[:, axis] for sign in (-1, 1))
        panel.fill_between(kelvin, low, high, color="0.5", alpha=0.35, linewidth=0)
        panel.plot(kelvin, factor * value[:, axis], color="black", lw=1.1, label="steady, with 95 % band")
        panel.set_title(f"{'xyz'[axis]} [{unit}]", loc="left", fontsize=11, fontweight="bold")
        panel.set_xlabel("temperature [°C]")
        dressed(panel)
    figure.axes[0].legend(fontsize=7, frameon=False)
    return figure


def residual_figure(found: ThermalCalibration, name: str) -> Figure:
    """Draw what the model leaves of each block against temperature and time, up and down in two colours."""
    factor, unit = USER_UNITS[name]
    blocks, fit = found.blocks, found.fits[name]
    hours = blocks.time / 3600
    up = _up(found)
    figure = new_figure(6.0)
    grid = figure.subplots(3, 2, sharey="row", sharex="col")
    for axis in range(3):
        for panel, x in zip(grid[axis], (blocks.temperature, hours), strict=True):
            for part, colour, label in ((up, _UP, "warming"), (~up, _DOWN, "cooling")):
                if part.any():
                    panel.plot(x[part], factor * fit.residual[part, axis], ".", ms=3, color=colour, label=label)
            panel.axhline(0.0, color="0.5", lw=0.8)
            dressed(panel)
        grid[axis][0].set_ylabel(f"{'xyz'[axis]} [{unit}]")
    grid[0][0].set_title("Left of the bias, by temperature", loc="left", fontsize=11, fontweight="bold")
    grid[0][1].set_title("by time", loc="left", fontsize=11, fontweight="bold")
    grid[0][0].legend(fontsize=8, frameon=False, ncols=2)
    grid[2][0].set_xlabel("temperature [°C]")
    grid[2][1].set_xlabel("time [h]")
    return figure


def covered_figure(found: ThermalCalibration) -> Figure:
    """Draw the temperatures and rates that the recordings went through."""
    blocks, up = found.blocks, _up(found)
    figure = new_figure(3.4)
    left, right = figure.subplots(1, 2)
    for part, colour, label in ((up, _UP, "warming"), (~up, _DOWN, "cooling")):
        if part.any():
            left.plot(blocks.temperature[part], 60 * blocks.rate[part], ".", ms=4, color=colour, label=label)
            right.plot(blocks.time[part] / 3600, blocks.temperature[part], ".", ms=3, color=colour)
    left.axhline(0.0, color="0.6", lw=0.8)
    left.set(xlabel="temperature [°C]", ylabel="rate of temperature [K/min]")
    left.set_title("Temperatures and rates covered", loc="left", fontsize=11, fontweight="bold")
    left.legend(fontsize=8, frameon=False)
    right.set(xlabel="time [h]", ylabel="temperature [°C]")
    right.set_title("Over time", loc="left", fontsize=11, fontweight="bold")
    for panel in (left, right):
        dressed(panel)
    return figure


def dressed(panel) -> None:
    """Draw a panel's frame and grid as the others have them."""
    panel.spines[["top", "right"]].set_visible(False)
    panel.grid(True, color="0.92", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.tick_params(labelsize=8)


def _pictures(found: ThermalCalibration) -> list[Picture]:
    caption = (
        "Each dot is a block of the recording. Where dots lie on one line only, temperature and its rate go together, "
        "and their effects cannot be separated."
    )
    made = [Picture("covered", png(covered_figure(found)), "Temperatures and rates covered", caption)]
    for name in found.fits:
        caption = f"The {name}'s bias, counted from {found.reference:g} °C: the model as a surface, the data as dots."
        made.append(Picture(f"surface_{name}", png(surface_figure(found, name)), f"Bias of the {name} over temperature "
                            "and its rate", caption))  # fmt: skip
        caption = (
            f"The {name}'s bias where the temperature has long been what it is, with its 95 % band; dots that lie off "
            "it, warming above and cooling below or the other way round, show a rate, a lag or a hysteresis."
        )
        alternative = f"Bias of the {name} over temperature with its band"
        made.append(Picture(f"bias_{name}", png(band_figure(found, name)), alternative, caption))
        caption = "Residuals of the model; a slope, a curve or two colours apart would be something it misses."
        alternative = f"Residuals of the {name}"
        made.append(Picture(f"residual_{name}", png(residual_figure(found, name)), alternative, caption))
    return made


def write_thermal(
    found: ThermalCalibration, folder: str | os.PathLike[str], exports: Sequence[AutopilotParameters] = ()
) -> Path:
    """Write `report.html` and its pictures as PNGs into `folder`, which is made if missing; return the page's path.

    Raises `InputError` where the folder cannot be made or written to; nothing is then left half-written.
    """
    pictures = _pictures(found)
    low, high = found.blocks.range
    names = ", ".join(Path(source.path).name for each in found.blocks.recordings for source in each.sources)
    sides = [
        (name, USER_UNITS[name][1], [[f"{USER_UNITS[name][0] * value:.3g}" for value in
                                     (fit.before[axis], fit.after[axis], fit.candidate.held.rms[axis])]
                                    for axis in range(3)], candidate_rows(found, name))
        for name, fit in found.fits.items()
    ]  # fmt: skip
    text = template("thermal.html.jinja").render(
        title=f"Bias over temperature of {names or 'a recording'}",
        headline=headline(found),
        words=[*found.identifiability.words, *ways(found), *ambient_words(found)],
        pictures={each.name: each for each in pictures},
        triads=sides,
        effects=effect_rows(found.calibration),
        low=f"{low:.1f}",
        high=f"{high:.1f}",
        reference=f"{found.reference:g}",
        block=f"{found.blocks.duration:.3g}",
        blocks=len(found.blocks),
        window=f"{TEMPERATURE_WINDOW:g}",
        bandwidth=f"{RATE_BANDWIDTH:.2g}",
        exports=[(each.name, loss_words(each, found), each.notes) for each in exports],
        notes=[sentence(note) for note in found.notes],
        version=found.software["version"],
    )
    return write_page(folder, text, pictures)[-1]
