"""The page of a fleet: its population, the units that do not belong, and what lots and dates change."""

import shlex
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from jaximu.estimation.problem import Name
from jaximu.estimation.uncertainty import describe
from jaximu.fleets.population import Difference, Fleet, Population
from jaximu.ground.array_types import FloatArray
from jaximu.ground.page import Items, Page, Part, Picture, Section, Table
from jaximu.ground.quantities import counted, number, sentence, with_interval
from jaximu.mistakes.titles import effect_title
from jaximu.report import figures
from jaximu.report.canvas import Axes, Figure
from jaximu.report.figures import dressed
from jaximu.report.tables import MOST_ROWS, p_text

_UNIT, _STRANGER, _PRIOR = figures.AXES.values()
_KINDS = (
    ("accelerometer", "gain", True, "accelerometer scale", "%", 100.0),
    ("accelerometer", "gain", False, "accelerometer misalignment", "mrad", 1e3),
    ("accelerometer", "bias", True, "accelerometer bias", "mm/s²", 1e3),
    ("gyroscope", "gain", True, "gyroscope scale", "%", 100.0),
    ("gyroscope", "gain", False, "gyroscope misalignment", "mrad", 1e3),
    ("gyroscope", "bias", True, "gyroscope bias", "°/s", float(np.degrees(1.0))),
)


def page_of(fleet: Fleet, magnetometers: Sequence[str] = (), stated: str = "") -> Page:
    """Return the population, outliers, what lots and dates change, what failed.

    `magnetometers`: sentences on these; `stated`: options of the command line that a diagnosis needs as well.
    """
    done = fleet.statuses["ok"]
    document = Path(fleet.table).with_suffix(".json").name
    picture = Picture(
        "population",
        partial(population_figure, fleet),
        "Units by parameter",
        "Each dot is a unit, as estimated from its own recording; the bar is the mean of the fleet and two standard "
        "deviations to each side, the noise of the estimates taken off. Orange: outliers.",
    )

    def rest() -> Iterator[Part]:
        lots = [difference for difference in fleet.differences if difference.kind == "lot"]
        if lots and fleet.population is not None:
            picture = Picture(
                "lots",
                partial(lot_figure, fleet, lots[0]),
                "A parameter by lot",
                "The parameter that differs most, unit by unit in each lot; lots that differ are orange.",
            )
            yield Section("Lots", [picture])
        yield from _prior(fleet)
        yield _diagnoses(fleet)

    return Page(
        f"Fleet of {counted(fleet.recordings, 'recording')}, {Path(fleet.table).name}",
        tuple(_verdict(fleet)),
        f"{done} of {fleet.recordings}",
        "recordings calibrated",
        (
            *(() if fleet.population is None else (picture,)),
            _outliers(fleet, document),
            *_differences(fleet),
            *_sessions(fleet, stated),
            _failures(fleet, document),
            Section("Magnetometers", [Items(magnetometers)]),
        ),
        rest,
        fleet.notes,
        _next(fleet),
        caution=not done,
    )


# --- words ------------------------------------------------------------------------------------------------------------


def _verdict(fleet: Fleet) -> Iterator[str]:
    failed = fleet.recordings - fleet.statuses["ok"]
    yield f"{counted(failed, 'recording')} could not be calibrated." if failed else "All recordings were calibrated."
    population = fleet.population
    if population is None:
        yield "Too few units to speak of a population."
        return
    devices = [stranger.device for stranger in fleet.strangers]
    limit = f"of {population.count} units one stands out beyond {population.farthest:.2g} times their spread"
    yield f"{counted(len(devices), 'outlier')}: {_first(devices, 3)}." if devices else f"No outliers: {limit}."
    groups = [f"{difference.kind} {difference.group}" for difference in fleet.differences if difference.kind != "date"]
    if groups := [*dict.fromkeys(groups)]:
        yield f"Different from the rest: {_first(groups, 3)}."
    if any(difference.kind == "date" for difference in fleet.differences):
        yield "Parameters drift with the date."


def _first(names: Sequence[str], most: int) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _next(fleet: Fleet) -> str:
    if fleet.population is None:
        return ""
    files = [stranger.file for stranger in fleet.strangers]
    if files:
        return f"`jaximu diagnose {shlex.quote(files[0])} -o RESULTS` shows why the first outlier differs."
    return (
        f"`jaximu accept {shlex.quote(fleet.table)} --limits LIMITS.toml -o LINE` holds every unit to limits and "
        "follows the line."
    )


def _outliers(fleet: Fleet, document: str) -> Section:
    more = len(fleet.strangers) - MOST_ROWS
    caption = "p: probability that a fleet of this size has a unit as far off as this one, if all belonged."
    if more > 0:
        caption += f" {more} more outliers are in `{document}`."
    return Section(
        "Outliers",
        [
            Table(
                ("device", "most unlike the others in", "p", "file"),
                [
                    (
                        stranger.device,
                        "; ".join(
                            f"{describe(name)} ({z:+.1f}σ)".replace("-", "−")
                            for name, _, z in stranger.parameters
                            if abs(z) > 2
                        )
                        or "no single parameter, but their combination",
                        p_text(stranger.p_value),
                        Path(stranger.file).name,
                    )
                    for stranger in fleet.strangers[:MOST_ROWS]
                ],
                caption,
                brief=10,
            )
        ],
    )


def _differences(fleet: Fleet) -> Iterator[Part]:
    names = {"lot": "lot", "date": "drift", "device": "recorded again", "effect": "effect shared by a lot"}
    rows = [
        (names[difference.kind], difference_words(difference), p_text(difference.p_value))
        for difference in fleet.differences
    ]
    if rows:
        yield Section(
            "Lots, dates, repeated recordings",
            [
                Table(
                    ("", "difference", "p"),
                    rows,
                    "± 95 %. p: probability of a difference at least as large by chance, all questions allowed for.",
                    brief=5,
                )
            ],
        )
    elif fleet.population is not None:
        lots = len({*fleet.lots} - {""})
        yield (
            f"{lots} lots were compared; none differs from the others."
            if lots > 1
            else "No difference by lot or date. A manifest states lots; logs or a manifest state dates."
        )


def difference_words(difference: Difference) -> str:
    """Say what a group changes, with 95 % intervals."""
    rate = " a year" if difference.kind == "date" else ""
    parts = [
        f"{describe(name)} by {amount(name, value, sigma)}{rate}" for name, value, sigma in difference.parameters[:5]
    ]
    more = len(difference.parameters) - 5
    if more > 0:
        parts.append(f"{more} more parameters")
    return sentence(difference.text + (f": {', '.join(parts)}" if parts else ""))


def _sessions(fleet: Fleet, stated: str) -> Iterator[Part]:
    units, sessions = (sorted({pair[index] for pair in fleet.places}) for index in (0, 1))
    if len(units) < 2 or len(sessions) < 2:
        return
    from jaximu.report.attribution import common_drift, drift_words  # most pages do without a diagnosis

    together = drift_words(fleet.common, sessions) if fleet.common else "Units of a session share no drift in time."
    yield Section(
        "Units and sessions",
        [
            f"{len(units)} units were recorded in {len(sessions)} sessions.",
            together * bool(fleet.drifts),
            f"`jaximu diagnose {shlex.quote(fleet.table)}{stated} -o RESULTS` says what belongs to a unit, to a "
            "session or to all.",
            *common_drift(fleet.drifts, fleet.common),
        ],
    )


def _failures(fleet: Fleet, document: str) -> Section:
    most = 20
    rows = [
        (sentence(reason), str(len(files)), _first([Path(file).name for file in files], 5))
        for reason, files in [*fleet.failed.items()][:most]
    ]
    if others := [*fleet.failed.values()][most:]:
        rows.append((f"{len(others)} other reasons", str(sum(map(len, others))), ""))
    statuses = ", ".join(f"{count} {status}" for status, count in fleet.statuses.most_common())
    return Section(
        "Not calibrated",
        [
            Table(
                ("reason", "recordings", "files"),
                rows,
                f"By status: {statuses}. All files are listed in `{document}`.",
                brief=5,
            )
        ],
    )


def _diagnoses(fleet: Fleet) -> Section:
    verdicts = ", ".join(f"{count} {name}" for name, count in fleet.verdicts.most_common())
    rows = [(effect_title(name), str(count)) for name, count in fleet.effects.most_common()]
    return Section("Diagnoses", [verdicts and f"Verdicts: {verdicts}.", Table(("effect", "units"), rows)])


def amount(name: Name, value: float, sigma: float = 0.0) -> str:
    """Put a relative parameter into the unit a person compares, with half its 95 % interval where it has one."""
    *_, unit, factor = _kind_of(name)
    return with_interval(factor * value, factor * sigma, unit) if sigma else f"{number(factor * value, 3)} {unit}"


def _kind_of(name: Name) -> tuple[str, str, bool, str, str, float]:
    about = name.owner, name.part, name.axes[0] == name.axes[-1]
    return next(kind for kind in _KINDS if kind[:3] == about)


# --- the population ---------------------------------------------------------------------------------------------------


def _prior(fleet: Fleet) -> Iterator[Section]:
    if fleet.population is None:
        return
    alone, prior = (np.quantile(sigma, 0.9, axis=0) for sigma in (fleet.sigma, fleet.shrunk_sigma))
    rows = []
    for k, name in enumerate(fleet.population.names):
        sizes = fleet.population.mean[k] - name.is_scale, fleet.population.spread[k], alone[k], prior[k]
        rows.append((describe(name), *(amount(name, float(size)) for size in sizes)))
    helped = np.flatnonzero(prior < 0.8 * alone).tolist()
    parts: list[Part] = [
        Table(
            (
                "parameter",
                "mean",
                "spread between units (1σ)",
                "a unit by itself (1σ)",
                "with the fleet as prior (1σ)",
            ),
            rows,
            "Scale and misalignment are relative to the data sheet's scale. The last two columns are the 90th "
            "percentile of the units' uncertainties, without gravity's part, which all units share; marked where the "
            "prior makes it a fifth smaller or more.",
            helped,
        )
    ]
    if helped:
        parts.insert(
            0,
            Picture(
                "prior",
                partial(prior_figure, fleet),
                "Uncertainty with the fleet as prior, relative to that of the unit alone",
                "Each dot is a unit: its uncertainty with the fleet as prior, in percent of that from its own "
                "recording alone. Low dots are units whose recording determines the parameter poorly, and the fleet "
                "better.",
            ),
        )
    else:
        parts.append(
            "The units' own recordings determine every parameter well: the fleet as prior makes none a fifth better."
        )
    yield Section("Parameters, and the fleet as prior", parts)


# --- pictures ---------------------------------------------------------------------------------------------------------


def _panels(population: Population, title: str) -> tuple[Figure, list[tuple[Axes, tuple, list[int]]]]:
    """Return a figure with a panel for each kind of parameter, its kind, and which parameters are of it."""
    places = {kind: [k for k, name in enumerate(population.names) if _kind_of(name) == kind] for kind in _KINDS}
    there = [(kind, columns) for kind, columns in places.items() if columns]
    rows = (len(there) + 2) // 3
    figure = figures.new_figure(0.4 + 2.9 * rows)
    figure.suptitle(title, fontsize=11)
    return figure, [(figure.add_subplot(rows, 3, position), *panel) for position, panel in enumerate(there, 1)]


def _dots(axes: Axes, column: int, values: FloatArray, color: str, opaque: float) -> None:
    """Draw the units of a column, spread out so that they do not cover each other."""
    beside = column + 0.3 * np.random.default_rng(column).uniform(-1, 1, len(values))
    axes.plot(beside, values, ".", color=color, alpha=opaque, ms=5, mew=0)


def _axis_names(axes: Axes, population: Population, columns: Sequence[int]) -> None:
    names = ["".join("xyz"[axis] for axis in dict.fromkeys(population.names[k].axes)) for k in columns]
    axes.set_xticks(range(len(columns)), names)
    axes.set_xlim(-0.6, len(columns) - 0.4)


def population_figure(fleet: Fleet) -> Figure:
    """Draw every unit in every parameter, off the mean of the fleet."""
    population = fleet.population
    assert population is not None
    figure, panels = _panels(population, f"{len(fleet.values)} units about the mean of the fleet")
    opaque = 0.7 if len(fleet.values) < 200 else 0.35
    for axes, kind, columns in panels:
        for column, k in enumerate(columns):
            values = kind[-1] * (fleet.values[:, k] - population.mean[k])
            _dots(axes, column, values, _UNIT, opaque)
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
        _axis_names(axes, population, columns)
        dressed(axes, kind[3], ylabel=f"off the mean [{kind[4]}]")
    return figure


def prior_figure(fleet: Fleet) -> Figure:
    """Draw each unit's uncertainty with the fleet as prior, in percent of that alone, parameter by parameter."""
    population = fleet.population
    assert population is not None
    figure, panels = _panels(population, "Uncertainty with the fleet as prior, in percent of that alone")
    share = 100 * fleet.shrunk_sigma / fleet.sigma
    for axes, kind, columns in panels:
        for column, k in enumerate(columns):
            _dots(axes, column, share[:, k], _PRIOR, 0.5)
        _axis_names(axes, population, columns)
        dressed(axes, kind[3], 100.0, ylabel="with prior / alone [%]", ylim=(0, 108))
    return figure


def lot_figure(fleet: Fleet, difference: Difference) -> Figure:
    """Draw the parameter that a lot changes most, lot by lot."""
    population = fleet.population
    assert population is not None
    name = difference.parameters[0][0]
    kind = _kind_of(name)
    k = population.names.index(name)
    values = kind[-1] * (fleet.values[:, k] - population.mean[k])
    lots = np.array(fleet.lots)
    names = sorted({*fleet.lots} - {""})
    different = [difference.group for difference in fleet.differences if difference.kind == "lot"]
    if len(names) > 40:
        names = [*different[:10], *[lot for lot in names if lot not in different][:30]]
    figure, (axes,) = figures.beside(1, 3.2)
    for column, lot in enumerate(names):
        points = values[lots == lot]
        _dots(axes, column, points, _STRANGER if lot in different else _UNIT, 0.5)
        axes.plot([column - 0.3, column + 0.3], [np.median(points)] * 2, color="black", linewidth=2)
    dressed(axes, ylabel=f"off the mean [{kind[4]}]")
    axes.set_xticks(range(len(names)), names, rotation=0 if len(names) < 15 else 90, fontsize=8)
    figure.suptitle(f"{describe(name)} by lot", fontsize=11)
    return figure
