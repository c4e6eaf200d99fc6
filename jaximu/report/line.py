"""The page of a production line: verdicts, alarms, control charts, capability, gauge study."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaximu.acceptance.line import FollowedQuantity, Line, write_verdicts
from jaximu.acceptance.words import amount, between, in_shown_unit, si_unit, spoken
from jaximu.ground.atomic import write_files
from jaximu.ground.quantities import number
from jaximu.ground.summary import sentence
from jaximu.report import figures
from jaximu.report.certificate import item_row
from jaximu.report.figures import dressed
from jaximu.report.html import MOST_ROWS
from jaximu.report.html import page as page_of
from jaximu.report.vector import named

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["headline", "line_alarms", "write_line"]

_CHARTS = 4  # drawn
_CAPABLE, _CATEGORIES, _LEVEL = 1.33, 5, 0.01
_TITLES = {
    "value": "A unit off the others",
    "jump": "A jump",
    "average": "The line has moved",
    "station": "Stations differ",
    "lot": "Lots differ",
    "golden": "The golden unit drifts",
}
_ORDER = ("golden", "station", "lot", "average", "value", "jump")
_VALUE, _OUT, _AVERAGE = figures.AXES.values()


def headline(line: Line) -> str:
    """Say in a sentence or two what came out."""
    text = ""
    if line.limits is not None:
        counts = line.counts
        text = f"{counts['pass']} of {line.table.total} recordings pass, "
        text += f"{counts['fail']} fail, {counts['undecided']} are undecided. "
    if not line.alarms:
        drawn = any(quantity.charts for quantity in line.followed)
        return text + ("No alarm on the line." if drawn else "Too few units for control charts.")
    return text + f"{len(line.alarms)} alarm{'s' if len(line.alarms) > 1 else ''}: {line_alarms(line)[0][1]}."


def line_alarms(line: Line) -> list[tuple[str, str]]:
    """Return title and sentence of each alarm, those of the whole line first."""
    ordered = sorted(line.alarms, key=lambda alarm: _ORDER.index(alarm.kind))
    return [(_TITLES[alarm.kind], sentence(alarm.text)) for alarm in ordered]


def write_line(line: Line, page: Path, table: Path) -> tuple[Path, ...]:
    """Write, where there are limits, the table with a verdict in every row, and the page; return their paths.

    Raises `InputError` where one cannot be written.
    """
    tables = () if line.limits is None else (table,)
    for path in tables:
        write_verdicts(line, path)
    return *tables, *write_files({page: _page(line)})


def _page(line: Line) -> bytes:
    total = sum(len(line.missed(row)) for row in range(len(line.table.rows)))
    drawn, counts, questions = _to_draw(line), line.counts, max(1, len(line.followed))
    quiet = "No control chart, station or golden unit shows more than chance."
    alarms: dict[str, list[str]] = {}
    for about, text in line_alarms(line):
        alarms.setdefault(about, []).append(text)
    items = []
    for device, item in line.items(MOST_ROWS):
        row = item_row(item)
        items.append((device, *(row[key] for key in ("name", "value", "limits", "probability", "verdict")), True))
    return page_of(
        "line",
        {"charts": partial(_chart_figure, line, drawn)} if drawn else {},
        lead=headline(line),
        title=f"Production line, {Path(line.table.file).name}",
        meaning="of the recordings pass",
        number=f"{100 * counts['pass'] / line.table.total:.3g} %" if line.limits else "",
        alarms=alarms,
        quiet=quiet if drawn else "There is nothing to chart: too few units.",
        items=items,
        more=max(0, total - MOST_ROWS),
        notes=line.notes,
        capability=[_capability(quantity) for quantity in line.followed if quantity.capability],
        gauge=[_gauge(quantity, questions) for quantity in line.followed if quantity.gauge],
    )[0]


def _capability(quantity: FollowedQuantity) -> tuple[str, str, str, str, str, str, bool]:
    capability, limit, unit = quantity.capability, quantity.limit, si_unit(quantity.name)
    assert capability is not None and limit is not None

    def said(index: tuple[float, float, float]) -> str:
        return "" if np.isnan(index[0]) else f"{index[0]:.2f} ({index[1]:.2f} to {index[2]:.2f})".replace("-", "−")

    worst = min(quantity.lots, key=lambda lot: quantity.lots[lot].cpk[0], default="")
    shown, factor = in_shown_unit(unit)
    mean = f"{number(factor * capability.mean)} ± {number(factor * capability.deviation, 2)} {shown}"
    return (
        spoken(quantity.name),
        mean,
        between(limit.low, limit.high, unit),
        said(capability.cp),
        said(capability.cpk),
        f"{worst}: {said(quantity.lots[worst].cpk).partition(' ')[0]}" if worst else "",
        capability.cpk[0] < _CAPABLE,
    )


def _gauge(quantity: FollowedQuantity, questions: int) -> tuple[str, str, str, str, str, str, bool]:
    gauge, unit = quantity.gauge, si_unit(quantity.name)
    assert gauge is not None
    shown, factor = in_shown_unit(unit)
    value, low, high = (number(factor * end, 2) for end in gauge.repeatability)
    mark = " *" if gauge.p_value * questions < _LEVEL else ""
    stations = amount(gauge.reproducibility, unit, 2) if gauge.crossed else "not crossed"
    return (
        spoken(quantity.name),
        f"{value} ({low} to {high}) {shown}",
        stations,
        amount(gauge.parts, unit, 2),
        str(gauge.categories),
        f"{gauge.explained:.2f}{mark}",
        gauge.categories < _CATEGORIES,
    )


def _to_draw(line: Line) -> list[tuple[FollowedQuantity, str]]:
    """Return the charts that show most: those with alarms, else the first ones."""
    charts = [(quantity, station) for quantity in line.followed for station in quantity.charts]

    def shows(entry: tuple[FollowedQuantity, str]) -> int:
        chart, _ = entry[0].charts[entry[1]]
        return len(chart.drifting) + len(chart.beyond) + len(chart.jumps)

    return sorted(charts, key=shows, reverse=True)[:_CHARTS]


def _chart_figure(line: Line, drawn: list[tuple[FollowedQuantity, str]]) -> Figure:
    """Draw control charts: values and moving average above, moving ranges below."""
    drawing = figures.new_figure(0.3 + 3.0 * len(drawn))
    rows = drawing.subplots(2 * len(drawn), 1, height_ratios=[2.2, 1] * len(drawn), squeeze=False)[:, 0]
    for (quantity, station), above, below in zip(drawn, rows[::2], rows[1::2], strict=True):
        chart, places = quantity.charts[station]
        unit, factor = in_shown_unit(si_unit(quantity.name))
        days = line.table.days[places]
        dated = bool(np.isfinite(days).all() and np.ptp(days) > 0)
        across = (days * 86400).astype("datetime64[s]") if dated else np.arange(len(places))
        ranges = np.abs(np.diff(chart.values, prepend=np.nan))
        limit = chart.bound * chart.deviation
        for axes, values, hits, ends in (
            (above, chart.values, chart.beyond, (chart.centre - limit, chart.centre + limit)),
            (below, ranges, chart.jumps, (np.sqrt(2) * limit,)),
        ):
            small = 4 if len(places) < 200 else 1.5
            dots = axes.plot(across, factor * values, "o", color=_VALUE, markersize=small, alpha=0.6, markeredgewidth=0)
            finite = np.isfinite(values)
            named(dots[0], [line.table.devices[row] for row in places[finite]])
            axes.plot(across[hits], factor * values[hits], "D", color=_OUT, markersize=5)
            for end in ends:
                axes.axhline(factor * end, color="#5C5C66", linestyle="--", linewidth=1)
        above.plot(across, factor * chart.average, color=_AVERAGE, linewidth=1.5)
        above.plot(across[chart.drifting], factor * chart.average[chart.drifting], ".", color=_OUT, markersize=4)
        for side in (-1, 1):
            end = chart.centre + side * chart.average_bound * chart.deviation
            above.plot(across, factor * end, color=_AVERAGE, linestyle=":", linewidth=1)
        dressed(above, spoken(quantity.name) + (f", station {station}" if station else ""), ylabel=f"[{unit}]")
        dressed(below, xlabel="" if dated else "unit", ylabel=f"moving range\n[{unit}]")
        below.yaxis.label.set_size(8)
    return drawing
