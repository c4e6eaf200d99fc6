"""The page of a production line: verdicts, alarms, control charts, capability, gauge study."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaximu.acceptance.line import Followed, Line, write_verdicts
from jaximu.acceptance.words import figure, in_shown_unit, spoken
from jaximu.formats.atomic import write_files
from jaximu.report import figures
from jaximu.report.certificate import item_row
from jaximu.report.html import Picture, template
from jaximu.report.words import sentence

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["chart_figure", "headline", "write_line"]

_SHOWN = 50  # items in the table
_CHARTS = 4  # drawn
_CAPABLE, _CATEGORIES, _LEVEL = 1.33, 5, 0.01
_TITLES = {"value": "A unit off the others", "jump": "A jump", "average": "The line has moved",
           "station": "Stations differ", "golden": "The golden unit drifts"}  # fmt: skip
_ORDER = ("golden", "station", "average", "value", "jump")
_VALUE, _AVERAGE, _OUT = "#0072B2", "#009E73", "#D55E00"


def headline(line: Line) -> str:
    """Say in a sentence or two what came out."""
    text = ""
    if line.limits is not None:
        counts = line.counts
        text = f"{counts['pass']} of {line.table.total} recordings pass, "
        text += f"{counts['fail']} fail, {counts['undecided']} are undecided. "
    if not line.alarms:
        drawn = any(each.charts for each in line.followed)
        return text + ("No alarm on the line." if drawn else "Too few units for control charts.")
    return text + f"{len(line.alarms)} alarm{'s' if len(line.alarms) > 1 else ''}: {line_alarms(line)[0][1]}."


def line_alarms(line: Line) -> list[tuple[str, str]]:
    """Return title and sentence of each alarm, those of the whole line first."""
    ordered = sorted(line.alarms, key=lambda each: _ORDER.index(each.kind))
    return [(_TITLES[each.kind], sentence(each.text)) for each in ordered]


def write_line(line: Line, page: Path, document: Path, table: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Write the page, its findings as JSON, and, where there are limits, the table with a verdict in every row.

    **Returns:** the paths written. Raises `InputError` where one cannot be written.
    """
    text = _render(line).encode("utf-8", "backslashreplace")
    write_files({page: text, document: (line.text() + "\n").encode()})
    if line.limits is None:
        return page, document
    write_verdicts(line, table)
    return page, document, Path(table)


def _render(line: Line) -> str:
    items = line.items(_SHOWN + 1)
    total = sum(len(line.missed(row)) for row in range(len(line.table.rows)))
    drawn = _to_draw(line)
    pictures = []
    if drawn:
        caption = (
            "Units in the order of their dates. Dots: single units, with the limits of single values (dashed); green: "
            "the moving average, with its limits (dotted). Vermilion is beyond the limits, which chance crosses in one "
            "table of a hundred."
        )
        pictures.append(Picture("charts", figures.png(chart_figure(line, drawn)), "Control charts", caption))
    counts = line.counts
    questions = max(1, len(line.followed))
    return template("line.html.jinja").render(
        title=f"Production line, {Path(line.table.file).name}",
        lead=headline(line),
        number=f"{100 * counts['pass'] / line.table.total:.3g} %" if line.limits else "",
        meaning="of the recordings pass",
        alarms=line_alarms(line),
        quiet="No control chart, station or golden unit shows more than chance."
        if drawn else "There is nothing to chart: too few units.",
        pictures=pictures,
        items=[(device, item_row(item)) for device, item in items[:_SHOWN]],
        more=max(0, total - _SHOWN),
        capability=[_capability(each) for each in line.followed if each.capability],
        gauge=[_gauge(each, questions) for each in line.followed if each.gauge],
        notes=[sentence(note) for note in line.notes],
    )  # fmt: skip


def _unit(each: Followed) -> tuple[str, float]:
    owner, _, part = each.name.partition("[")[0].partition(".")
    return in_shown_unit(
        {"scale": "1", "misalignment": "rad"}.get(part, "m/s^2" if owner == "accelerometer" else "rad/s")
    )


def _capability(each: Followed) -> tuple[str, str, str, str, str, bool]:
    found, limit = each.capability, each.limit
    assert found is not None and limit is not None
    unit, factor = _unit(each)

    def said(index: tuple[float, float, float]) -> str:
        return "" if np.isnan(index[0]) else f"{index[0]:.2f} ({index[1]:.2f} to {index[2]:.2f})".replace("-", "−")

    mean = f"{figure(factor * found.mean)} ± {figure(factor * found.deviation, 2)} {unit}"
    limits = f"{figure(factor * limit.low)} to {figure(factor * limit.high)} {unit}"
    return spoken(each.name), mean, limits, said(found.cp), said(found.cpk), found.cpk[0] < _CAPABLE


def _gauge(each: Followed, questions: int) -> tuple[str, str, str, str, str, str, bool]:
    found = each.gauge
    assert found is not None
    unit, factor = _unit(each)
    value, low, high = (factor * end for end in found.repeatability)
    mark = " *" if found.p_value * questions < _LEVEL else ""
    between = f"{figure(factor * found.reproducibility, 2)} {unit}" if found.crossed else "not crossed"
    return (spoken(each.name), f"{figure(value, 2)} ({figure(low, 2)} to {figure(high, 2)}) {unit}", between,
            f"{figure(factor * found.parts, 2)} {unit}", str(found.categories), f"{found.explained:.2f}{mark}",
            found.categories < _CATEGORIES)  # fmt: skip


def _to_draw(line: Line) -> list[tuple[Followed, str]]:
    """Return the charts that show most: those with alarms, else the first ones."""
    charts = [(each, station) for each in line.followed for station in each.charts]

    def shows(entry: tuple[Followed, str]) -> int:
        chart, _ = entry[0].charts[entry[1]]
        return len(chart.drifting) + len(chart.beyond) + len(chart.jumps)

    return sorted(charts, key=shows, reverse=True)[:_CHARTS]


def chart_figure(line: Line, drawn: list[tuple[Followed, str]]) -> Figure:
    """Draw control charts: values and moving average above, moving ranges below."""
    figure_ = figures.new_figure(0.3 + 3.0 * len(drawn))
    rows = figure_.subplots(2 * len(drawn), 1, height_ratios=[2.2, 1] * len(drawn), squeeze=False)[:, 0]
    for place, (each, station) in enumerate(drawn):
        chart, places = each.charts[station]
        unit, factor = _unit(each)
        days = line.table.days[places]
        dated = bool(np.isfinite(days).all() and np.ptp(days) > 0)
        across = (days * 86400).astype("datetime64[s]") if dated else np.arange(len(places))
        ranges = np.abs(np.diff(chart.values))
        limits = chart.reach * chart.deviation
        for axes, values, hits, centre, reach in (
            (rows[2 * place], chart.values, chart.beyond, chart.centre, limits),
            (rows[2 * place + 1], np.concatenate([[np.nan], ranges]), chart.jumps, None, np.sqrt(2) * limits),
        ):
            small = 4 if len(places) < 200 else 1.5
            axes.plot(across, factor * values, "o", color=_VALUE, markersize=small, alpha=0.6, markeredgewidth=0)
            axes.plot(across[hits], factor * values[hits], "D", color=_OUT, markersize=5)
            for end in (reach,) if centre is None else (centre - reach, centre + reach):
                axes.axhline(factor * end, color="#5C5C66", linestyle="--", linewidth=1)
            axes.grid(color="#E3E3E3", linewidth=0.6)
            axes.tick_params(labelsize=8)
        above = rows[2 * place]
        above.plot(across, factor * chart.average, color=_AVERAGE, linewidth=1.5)
        above.plot(across[chart.drifting], factor * chart.average[chart.drifting], ".", color=_OUT, markersize=4)
        for side in (-1, 1):
            end = chart.centre + side * chart.average_reach * chart.deviation
            above.plot(across, factor * end, color=_AVERAGE, linestyle=":", linewidth=1)
        above.set_title(spoken(each.name) + (f", station {station}" if station else ""), loc="left", fontsize=10)
        above.set_ylabel(f"[{unit}]", fontsize=8)
        rows[2 * place + 1].set_ylabel(f"moving range\n[{unit}]", fontsize=8)
        if not dated:
            rows[2 * place + 1].set_xlabel("unit", fontsize=8)
    return figure_
