"""The page of a fleet: its population, the units that do not belong, and what lots and dates change."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaximu.estimation.problem import Name
from jaximu.estimation.uncertainty import describe
from jaximu.fleets.population import Difference, Fleet, Population, write_shrunk
from jaximu.ground.atomic import write_files
from jaximu.ground.quantities import Z95, number, probability
from jaximu.ground.summary import sentence
from jaximu.mistakes.titles import effect_title
from jaximu.report import figures
from jaximu.report.figures import dressed
from jaximu.report.html import MOST_ROWS
from jaximu.report.html import page as page_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "amount",
    "difference_words",
    "failure_words",
    "headline",
    "lot_figure",
    "population_figure",
    "prior_figure",
    "write_fleet",
]

_UNIT, _STRANGER, _PRIOR = figures.AXES.values()
_KINDS = (
    ("accelerometer", "gain", True, "accelerometer scale", "%", 100.0),
    ("accelerometer", "gain", False, "accelerometer misalignment", "mrad", 1e3),
    ("accelerometer", "bias", True, "accelerometer bias", "mm/s²", 1e3),
    ("gyroscope", "gain", True, "gyroscope scale", "%", 100.0),
    ("gyroscope", "gain", False, "gyroscope misalignment", "mrad", 1e3),
    ("gyroscope", "bias", True, "gyroscope bias", "°/s", float(np.degrees(1.0))),
)


def write_fleet(fleet: Fleet, table: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Write, beside the table, its page (`.html`), its findings (`.json`) and its units with the fleet as prior.

    **Returns:** the paths written; the last, `.shrunk.parquet`, only where there is a population. Raises `InputError`
    where they cannot be written.
    """
    base = Path(table)
    page, document = base.with_suffix(".html"), base.with_suffix(".json")
    fleet.save(document)
    shrunk = () if fleet.population is None else (base.with_suffix(".shrunk.parquet"),)
    for path in shrunk:
        write_shrunk(fleet, path)
    write_files({page: _page(fleet, document.name)})  # drawn when all else is there
    return page, document, *shrunk


def _page(fleet: Fleet, document: str) -> bytes:
    drawn = {}
    if fleet.population is not None:
        drawn = {"population": partial(population_figure, fleet), "prior": partial(prior_figure, fleet)}
        if lots := [difference for difference in fleet.differences if difference.kind == "lot"]:
            drawn["lots"] = partial(lot_figure, fleet, lots[0])
    strangers = [
        (
            stranger.device,
            "; ".join(f"{describe(name)} ({z:+.1f}σ)" for name, _, z in stranger.parameters if abs(z) > 2)
            or "no single parameter: in how they go together",
            probability(stranger.p_value).removeprefix("= "),
            stranger.file,
        )
        for stranger in fleet.strangers[:MOST_ROWS]
    ]
    statuses = sorted(fleet.statuses.items(), key=lambda item: (item[0] != "ok", -item[1]))
    return page_of(
        "fleet",
        drawn,
        title=f"Fleet of {fleet.recordings} recordings, {Path(fleet.table).name}",
        lead=headline(fleet),
        number=f"{fleet.statuses['ok']} of {fleet.recordings}",
        meaning="recordings calibrated",
        statuses=[(status, count, status != "ok") for status, count in statuses],
        failures=[(reason, count, files, True) for reason, files, count in failure_words(fleet, 20, 10)],
        verdicts=", ".join(f"{count} {name}" for name, count in fleet.verdicts.most_common()),
        effects=[(effect_title(name), count) for name, count in fleet.effects.most_common()],
        differences=[(_about(difference), difference_words(difference), True) for difference in fleet.differences]
        or [("Lots, dates, devices recorded again", _nothing(fleet))],
        strangers=strangers,
        more=max(0, len(fleet.strangers) - MOST_ROWS),
        document=document,
        rows=_rows(fleet),
        notes=fleet.notes,
    )[0]


# --- words ------------------------------------------------------------------------------------------------------------


def headline(fleet: Fleet) -> str:
    """Say in a sentence what the fleet tells."""
    done = fleet.statuses["ok"]
    text = f"{done} of {fleet.recordings} recordings were calibrated"
    if fleet.population is None:
        return f"{text}; too few to speak of a population."
    count = len(fleet.strangers)
    text += (
        "; no unit falls out of the population"
        if not count
        else (f"; {count} unit{'s do' if count > 1 else ' does'} not belong to the population")
    )
    groups = list(
        dict.fromkeys(
            f"{difference.kind} {difference.group}" for difference in fleet.differences if difference.kind != "date"
        )
    )
    if groups:
        text += f"; different from the rest: {_first(groups, 3)}"
    if any(difference.kind == "date" for difference in fleet.differences):
        text += "; parameters drift with the date"
    return f"{text}."


def _first(names: Sequence[str], most: int) -> str:
    """Return the first of some names, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def failure_words(fleet: Fleet, reasons: int, files: int) -> list[tuple[str, str, int]]:
    """Return, for the commonest reasons why recordings failed, the reason, files that it met, and how many those are.

    What is left out is counted, too.
    """
    rows = []
    for reason, met in list(fleet.failed.items())[:reasons]:
        rows.append((sentence(reason), _first(met, files), len(met)))
    rest = list(fleet.failed.values())[reasons:]
    if rest:
        rows.append((f"{len(rest)} other reasons, in the table's column `message`.", "", sum(map(len, rest))))
    return rows


def _about(difference: Difference) -> str:
    names = {"lot": "Lot", "date": "Drift", "device": "Recorded again", "effect": "Effect shared by a lot"}
    return f"{names[difference.kind]}, p {probability(difference.p_value)}"


def difference_words(difference: Difference) -> str:
    """Say what a group changes, with 95 % intervals."""
    rate = " a year" if difference.kind == "date" else ""
    parts = [
        f"{describe(name)} by {amount(name, value, Z95 * sigma)}{rate}"
        for name, value, sigma in difference.parameters[:5]
    ]
    more = len(difference.parameters) - 5
    if more > 0:
        parts.append(f"{more} more parameters")
    return sentence(difference.text + (f": {', '.join(parts)}" if parts else ""))


def _nothing(fleet: Fleet) -> str:
    lots = len({lot for lot in fleet.lots if lot})
    if lots < 2:
        return "Nothing. Lots are compared if a manifest states them, dates if logs or a manifest do."
    return f"Nothing: {lots} lots were compared, and none differs from the others."


def amount(name: Name, value: float, half: float | None = None) -> str:
    """Put a relative parameter into the unit a person compares, with half its 95 % interval."""
    *_, unit, factor = next(kind for kind in _KINDS if _is(name, kind))
    text = f"{number(factor * value, 3)}"
    return f"{text} {unit}" if half is None else f"{text} ± {number(factor * half, 2)} {unit}"


def _is(name: Name, kind) -> bool:
    return kind[:3] == (name.owner, name.part, name.axes[0] == name.axes[-1])


def _rows(fleet: Fleet) -> list[tuple[str, str, str, str, str, bool]]:
    if fleet.population is None:
        return []
    rows = []
    alone, prior = (np.quantile(sigma, 0.9, axis=0) for sigma in (fleet.sigma, fleet.shrunk_sigma))
    for k, name in enumerate(fleet.population.names):
        scale = name.part == "gain" and name.axes[0] == name.axes[1]
        mean = fleet.population.mean[k] - (1.0 if scale else 0.0)
        rows.append(
            (
                describe(name),
                amount(name, mean),
                amount(name, fleet.population.spread[k]),
                amount(name, alone[k]),
                amount(name, prior[k]),
                bool(prior[k] < 0.8 * alone[k]),
            )
        )
    return rows


# --- pictures ---------------------------------------------------------------------------------------------------------


def _panels(population: Population, title: str) -> tuple[Figure, list[tuple[Axes, tuple, list[int]]]]:
    """Return a figure with a panel for each kind of parameter, its kind, and which parameters are of it."""
    places = {kind: [k for k, name in enumerate(population.names) if _is(name, kind)] for kind in _KINDS}
    there = [(kind, columns) for kind, columns in places.items() if columns]
    rows = (len(there) + 2) // 3
    figure = figures.new_figure(0.4 + 2.9 * rows)
    figure.suptitle(title, fontsize=11)
    return figure, [(figure.add_subplot(rows, 3, position), *panel) for position, panel in enumerate(there, 1)]


def population_figure(fleet: Fleet) -> Figure:
    """Draw every unit in every parameter, off the mean of the fleet."""
    population = fleet.population
    assert population is not None
    figure, panels = _panels(population, f"{len(fleet.values)} units about the mean of the fleet")
    spread_out, opaque = np.random.default_rng(0), 0.7 if len(fleet.values) < 200 else 0.35
    for axes, kind, columns in panels:
        for column, k in enumerate(columns):
            values = kind[-1] * (fleet.values[:, k] - population.mean[k])
            width = 0.3 * spread_out.uniform(-1, 1, len(values))
            axes.plot(column + width, values, ".", color=_UNIT, alpha=opaque, markersize=5, markeredgewidth=0)
            two = 2 * kind[-1] * population.spread[k]
            axes.plot([column, column], [-two, two], color="black", linewidth=2.2, solid_capstyle="butt")
            axes.plot([column - 0.12, column + 0.12], [0, 0], color="black", linewidth=2.2)
            marked = [
                (kind[-1] * (value - population.mean[k]), stranger.device)
                for stranger in fleet.strangers
                for name, value, _ in stranger.parameters[:1]
                if name == population.names[k]
            ]
            for value, device in marked[:5]:
                axes.plot(column, value, "D", color=_STRANGER, markersize=5)
                last = column == len(columns) - 1  # its name goes towards the middle of the panel
                axes.annotate(
                    device,
                    (column, value),
                    (5 - 10 * last, 0),
                    textcoords="offset points",
                    fontsize=7,
                    color=_STRANGER,
                    va="center",
                    ha="right" if last else "left",
                )
        axes.set_xticks(
            range(len(columns)),
            ["".join("xyz"[axis] for axis in dict.fromkeys(population.names[k].axes)) for k in columns],
        )
        axes.set_xlim(-0.6, len(columns) - 0.4)
        dressed(axes, kind[3], ylabel=f"off the mean [{kind[4]}]")
    return figure


def prior_figure(fleet: Fleet) -> Figure:
    """Draw each unit's uncertainty alone and with the fleet as prior."""
    population = fleet.population
    assert population is not None
    figure, panels = _panels(population, "How well a unit is known, alone and with the fleet as prior")
    for axes, kind, columns in panels:
        alone, prior = (kind[-1] * sigma[:, columns].ravel() for sigma in (fleet.sigma, fleet.shrunk_sigma))
        ends = min(alone.min(), prior.min()) / 1.3, alone.max() * 1.3
        axes.plot(ends, ends, color="#8A8A8A", linewidth=1)
        axes.plot(alone, prior, ".", color=_PRIOR, alpha=0.4, markersize=4, markeredgewidth=0)
        figures.logarithmic(axes)
        dressed(axes, kind[3], xlabel=f"alone, 1σ [{kind[4]}]", ylabel=f"with prior, 1σ [{kind[4]}]")
    return figure


def lot_figure(fleet: Fleet, difference: Difference) -> Figure:
    """Draw the parameter that a lot changes most, lot by lot."""
    population = fleet.population
    assert population is not None
    name = difference.parameters[0][0]
    kind = next(kind for kind in _KINDS if _is(name, kind))
    values = kind[-1] * (fleet.values[:, population.names.index(name)] - population.mean[population.names.index(name)])
    lots = np.array(fleet.lots)
    names = [lot for lot in sorted(set(fleet.lots)) if lot]
    different = [difference.group for difference in fleet.differences if difference.kind == "lot"]
    if len(names) > 40:
        names = [*different[:10], *[lot for lot in names if lot not in different][:30]]
    figure = figures.new_figure(3.2)
    axes = figure.add_subplot()
    spread_out = np.random.default_rng(0)
    for column, lot in enumerate(names):
        points = values[lots == lot]
        color = _STRANGER if lot in different else _UNIT
        axes.plot(
            column + 0.25 * spread_out.uniform(-1, 1, len(points)),
            points,
            ".",
            color=color,
            alpha=0.5,
            markersize=5,
            markeredgewidth=0,
        )
        axes.plot([column - 0.3, column + 0.3], [np.median(points)] * 2, color="black", linewidth=2)
    dressed(axes, ylabel=f"off the mean [{kind[4]}]")
    axes.set_xticks(range(len(names)), names, rotation=0 if len(names) < 15 else 90, fontsize=8)
    figure.suptitle(f"{describe(name)} by lot", fontsize=11)
    return figure
