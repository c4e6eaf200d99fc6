"""The page of what moved between calibrations: numbers in their uncertainties, over time, and what the output does."""

import shlex
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaximu.acceptance.history import LimitReached, Movement, UnitHistory
from jaximu.acceptance.words import in_shown_unit, spoken
from jaximu.ground.distributions import student_isf
from jaximu.ground.page import Page, Part, Picture, Statement, Table
from jaximu.ground.quantities import Z95, counted, number, probability, sentence, size, with_interval
from jaximu.ground.vectors import root_or_zero
from jaximu.report import figures
from jaximu.report.canvas import Axes, Figure
from jaximu.report.tables import p_text

_DRAWN = 4
"""Numbers that are drawn over time and temperature: those whose change is surest."""


def page_of(history: UnitHistory) -> Page:
    """Return what moved, in uncertainties and in the output, each number's drift, and when limits are reached."""
    return Page(
        f"What moved over {counted(len(history.files), 'calibration')} of a unit?",
        tuple(_verdict(history)),
        *_number(history),
        tuple(_first(history)),
        partial(_rest, history),
        (*history.notes, *history.left_out),
        _next(history),
        caution=history.verdict == "moved",
    )


# --- words ------------------------------------------------------------------------------------------------------------


def _amount(movement: Movement, value: float, sigma: float, sign: bool = True) -> str:
    """Return an amount of a number with its 95 % interval, in the unit in which its kind is shown."""
    shown, factor = in_shown_unit(movement.unit)
    return with_interval(factor * value, factor * sigma, movement.unit if factor == 1.0 else shown, sign)


def _drift(movement: Movement) -> str:
    return _amount(movement, movement.line.slope, movement.line.half / Z95)


def _duration(history: UnitHistory, time: float) -> str:
    due = history.due(time)
    return _time(time, history.per) + (f" ({due.isoformat()})" if due else "")


def _time(time: float, per: str) -> str:
    return f"{number(time, 2)} {per}s"


def _verdict(history: UnitHistory) -> Iterator[str]:
    test = history.together["all"]
    moved = history.moved
    ratio = (
        f"χ² {number(test.statistic)} of {counted(test.freedom, 'degree')} of freedom, p {probability(test.p_value)}"
    )
    tested = sum(movement.tested for movement in history.movements)
    if moved:
        words = "; ".join(map(_words, moved[:3]))
        rest = f"; and {len(moved) - 3} more" if len(moved) > 3 else ""
        yield f"{len(moved)} of {tested} numbers moved: {words}{rest}. All together: {ratio}."
    elif history.verdict == "moved":
        yield f"All numbers together differ by more than their uncertainty ({ratio}), but no single one stands out."
    else:
        yield f"Nothing moved: all differences are within their uncertainty ({ratio})."
    if history.limits:
        yield _due(history)


def _words(movement: Movement) -> str:
    """Say how far a number moved, or that it did so in between and came back."""
    if abs(movement.z) < Z95:
        return f"{spoken(movement.name)} in between and back (p {probability(movement.adjusted)})"
    amount = _amount(movement, movement.difference, movement.sigma)
    return f"{spoken(movement.name)} by {amount} ({abs(movement.z):.1f} σ)"


def _due(history: UnitHistory) -> str:
    if history.interval is None:
        return "At the drift seen, no limit is ever reached."
    first = next(limit for limit in history.limits if limit.after == history.interval)
    if not first.after:
        return f"{sentence(spoken(first.name))} is already within the guard band of its limit: calibrate now."
    return (
        f"Calibrate again within {_duration(history, first.after)}: {spoken(first.name)} may then reach its limit, "
        f"{first.limit.words()}."
    )


def _number(history: UnitHistory) -> tuple[str, str]:
    if history.interval is not None:
        return _time(history.interval, history.per), "until the first limit's guard band is reached"
    for owner, change in history.output.items():
        return (
            with_interval(change.worst, change.sigma, change.unit),
            f"largest error of the {owner}, up to {size(change.over, change.unit)}, with the first calibration on the "
            "unit as it is in the last, 95 % interval",
        )
    return f"p {probability(history.together['all'].p_value)}", "probability of differences as large if nothing moved"


def _next(history: UnitHistory) -> str:
    if not history.limits:
        return f"`jaximu compare {shlex.join(history.files)} --limits LIMITS.toml` works out when limits are reached."
    return (
        f"`jaximu accept {shlex.quote(history.files[-1])} --limits {shlex.quote(history.limits_file)}` holds the last "
        "calibration to the limits."
    )


# --- parts ------------------------------------------------------------------------------------------------------------


def _first(history: UnitHistory) -> Iterator[Part]:
    yield (
        Picture(
            "history",
            partial(_history_figure, history),
            "The numbers that changed most surely, over time, with their drift",
            "The numbers whose change is surest, with their 95 % intervals, without an error of gravity that all "
            "share. The line is the drift, with its 95 % band.",
        )
        if len(history.files) > 2
        else _pictured_changes(history)
    )
    yield _numbers_table(history)
    yield _together_table(history)
    for owner, change in history.output.items():
        zeroed = ", its bias re-zeroed" if owner == "gyroscope" else ""
        yield Statement(
            f"{sentence(owner)} output",
            f"With the first calibration, corrected output of the unit as it is in the last is off by "
            f"{with_interval(change.worst, change.sigma, change.unit)} at worst (95 %) and "
            f"{size(change.rms, change.unit)} rms over all directions, at {size(change.over, change.unit)}{zeroed}. "
            f"The uncertainty of both calibrations alone makes {size(change.expected, change.unit)} rms.",
        )
    yield _limits_table(history)


def _rest(history: UnitHistory) -> Iterator[Part]:
    if len(history.files) > 2:
        yield _pictured_changes(history)
    known = [temperature for temperature in history.temperatures if temperature is not None]
    if len(known) == len(history.files) and max(known) > min(known):
        yield Picture(
            "temperature",
            lambda: _drawn(history, np.array(history.temperatures, float), "temperature [°C]")[0],
            "The numbers that changed most surely, over the temperatures of their recordings",
            "The same numbers over the temperature of their recordings: what follows it has not aged.",
        )
    columns = zip(history.files, history.dates, history.times, history.temperatures, strict=True)
    yield Table(
        ("calibration", "date", f"time [{history.per}s]", "temperature"),
        [
            (file, day.isoformat() if day else "", f"{time:.2f}".replace("-", "−"), "" if t is None else f"{t:.1f} °C")
            for file, day, time, t in columns
        ],
        "In the order of time, counted from the last.",
    )


def _numbers_table(history: UnitHistory) -> Table:
    straight = len(history.files) > 2
    over_time = straight or history.per == "year"  # a difference over one step is its own drift
    headers = ["number", "first ± 95 %", "last − first ± 95 %", "σ", "p, all allowed for"]
    headers += [f"drift per {history.per}"] * over_time + ["p, straight"] * straight
    movements = sorted(
        history.movements, key=lambda movement: (not movement.moved, not movement.tested, movement.p_value)
    )
    rows = [
        [
            spoken(movement.name),
            _amount(movement, movement.values[0], movement.sigmas[0], False),
            _amount(movement, movement.difference, movement.sigma),
            f"{abs(movement.z):.1f}",
            p_text(movement.adjusted) if movement.tested else "differs after every power-on",
            *[_drift(movement)] * over_time,
            *[p_text(movement.line.p_value)] * straight,
        ]
        for movement in movements
    ]
    caption = (
        f"p: of no change in all {len(history.files)} calibrations, with all numbers allowed for (Holm). Moved is "
        f"below {history.level / 2:g}: half the rate of false alarms, the other half is for all numbers together"
        + ". Drift: of the line through all values, ± 95 %" * over_time
        + "; p, straight: of scatter as large about it; below 0.05 the interval is widened by that scatter" * straight
    )
    count = len(history.moved)
    return Table(tuple(headers), rows, f"{caption}.", range(count), brief=max(6, count))


def _together_table(history: UnitHistory) -> Table:
    rows = [
        (
            "all, without gyroscope bias" if name == "all" else name,
            number(test.statistic),
            str(test.freedom),
            p_text(test.p_value),
        )
        for name, test in history.together.items()
    ]
    marked = [len(rows) - 1] if history.together["all"].p_value < history.level / 2 else []
    return Table(
        ("together", "χ²", "degrees of freedom", "p"), rows, "Jointly, with all correlations: χ² of no change.", marked
    )


def _limits_table(history: UnitHistory) -> Table:
    movements = {movement.name: movement for movement in history.movements}

    def row(reached: LimitReached) -> tuple[str, ...]:
        movement = movements[reached.name]
        return (
            spoken(reached.name),
            reached.limit.words(),
            _amount(movement, movement.line.level, float(np.sqrt(movement.line.covariance[0, 0]))),
            f"{_drift(movement)}/{history.per}",
            "never, at this drift" if reached.after is None else _duration(history, reached.after),
        )

    ordered = sorted(history.limits, key=lambda limit: np.inf if limit.after is None else limit.after)
    return Table(
        ("limit on", "bounds", "now ± 95 %", "drift ± 95 %", "guard band reached after"),
        [row(reached) for reached in ordered],
        "The time from the last calibration until the line, with its uncertainty and the guard band of the decision "
        "rule, leaves the bounds: the calibration interval is the shortest. It assumes that the drift goes on.",
        [0] * bool(ordered),
        brief=6,
    )


# --- pictures ---------------------------------------------------------------------------------------------------------


def _pictured_changes(history: UnitHistory) -> Picture:
    return Picture(
        "changes",
        partial(_changes_figure, history),
        "Change of every number from the first calibration to the last, in standard deviations",
        "Last calibration less the first, in standard deviations of that difference. Within the grey band a single "
        "number has not changed (95 %). Orange: moved, with all numbers allowed for; grey: not tested.",
    )


def _changes_figure(history: UnitHistory) -> Figure:
    rows = history.movements[::-1]
    figure, (panel,) = figures.beside(1, 1.0 + 0.17 * len(rows))
    panel.axvspan(-Z95, Z95, color="#E6E6E6", linewidth=0)
    for row, movement in enumerate(rows):
        colour = figures.FLAGGED if movement.moved else figures.AFTER if movement.tested else figures.BEFORE
        panel.plot(movement.z, row, "o", color=colour, markersize=5)
    panel.axvline(0.0, color="0.5", linewidth=0.8)
    figures.dressed(panel, "last − first", xlabel="standard deviations of the difference")
    panel.set_yticks(range(len(rows)), [spoken(movement.name) for movement in rows], fontsize=8)
    return figure


def _drawn(history: UnitHistory, at: NDArray[Any], across: str) -> tuple[Figure, list[tuple[Axes, Movement, float]]]:
    """Draw the numbers whose change is surest, with their intervals; return panels, numbers, and factors to units."""
    surest = sorted(history.movements, key=lambda movement: (not movement.tested, movement.p_value))[:_DRAWN]
    figure, panels = figures.stacked(len(surest), across=across, sharex=True)
    drawn = []
    for panel, movement in zip(panels, surest, strict=True):
        shown, factor = in_shown_unit(movement.unit)
        panel.errorbar(
            at,
            factor * np.array(movement.values),
            factor * Z95 * np.array(movement.apart),
            fmt="o",
            color=figures.FLAGGED,
            markersize=4,
            zorder=3,
        )
        figures.dressed(panel, spoken(movement.name), ylabel=shown)
        drawn.append((panel, movement, factor))
    return figure, drawn


def _history_figure(history: UnitHistory) -> Figure:
    dated = history.per == "year"
    at = np.array(history.dates, "datetime64[D]") if dated else history.times
    figure, drawn = _drawn(history, at, "" if dated else "steps before the last")
    for panel, movement, factor in drawn:
        line = movement.line
        ahead = np.linspace(history.times[0], 0.0, 100)
        shared = movement.sigmas[-1] ** 2 - movement.apart[-1] ** 2
        variance = line.covariance[0, 0] - shared + (2 * line.covariance[0, 1] + line.covariance[1, 1] * ahead) * ahead
        half = float(student_isf(0.025, line.freedom)) * root_or_zero(variance)
        level = line.level + line.slope * ahead
        days = (history.times[-1] - ahead) / np.ptp(history.times) * (at[-1] - at[0])
        figures.band(panel, at[-1] - days, factor * level, factor * half, figures.AFTER)
    return figure
