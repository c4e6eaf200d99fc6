"""The page of a production line: capability, control charts, alarms, what does not pass, gauge study."""

import shlex
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from jaximu.acceptance.decision import FAIL, PASS
from jaximu.acceptance.limits import Limit
from jaximu.acceptance.line import FollowedQuantity, Line
from jaximu.acceptance.statistics import Capability, Chart
from jaximu.acceptance.words import amount, in_shown_unit, si_unit, spoken
from jaximu.ground.page import Page, Picture, Section, Table
from jaximu.ground.quantities import Z95, counted, number, sentence, with_interval
from jaximu.report import figures
from jaximu.report.canvas import Axes, Figure
from jaximu.report.certificate import item_row
from jaximu.report.figures import dressed
from jaximu.report.tables import MOST_ROWS
from jaximu.report.vector import named

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
_Able = Sequence[tuple[FollowedQuantity, Capability]]


def page_of(line: Line) -> Page:
    """Return the worst quantity's Cpk, charts with the limits, capability, alarms; what does not pass and the gauge."""
    able = _by_capability(line)
    charts = _to_draw(line)
    pictures = [
        Picture(
            "charts",
            partial(_chart_figure, line, charts),
            "Control charts",
            "Units in the order of their dates. Above: single units and their moving average, each with its control "
            "limits, which chance crosses in one table of a hundred; black: the limits that units are held to. Below: "
            "differences from the unit before.",
        )
    ]
    return Page(
        f"Production line, {Path(line.table.file).name}",
        tuple(_verdict(line, able)),
        *_number(line, able),
        (
            *(pictures if charts else []),
            _capability(line, able),
            Section("Alarms", [Table(("alarm", "what it shows"), _alarm_rows(line), brief=8)]),
        ),
        lambda: [_not_passed(line), _worst_lots(able), _gauge(line)],
        line.notes,
        _next(line),
        caution=bool(line.counts[FAIL] or (able and able[0][1].cpk[0] < _CAPABLE)),
    )


# --- the first lines --------------------------------------------------------------------------------------------------


def _by_capability(line: Line) -> _Able:
    able = [(quantity, quantity.capability) for quantity in line.followed if quantity.capability is not None]
    return sorted(able, key=lambda pair: pair[1].cpk[0])


def _number(line: Line, able: _Able) -> tuple[str, str]:
    for quantity, capability in able:
        meaning = f"Cpk of {spoken(quantity.name)}, the worst quantity (95 %); a capable line has {_CAPABLE} or more"
        return _index(capability.cpk), meaning
    if line.limits is not None:
        return f"{100 * line.counts[PASS] / line.table.total:.3g} %", "of the recordings pass"
    return "", ""


def _verdict(line: Line, able: _Able) -> Iterator[str]:
    if able and able[0][1].cpk[0] < _CAPABLE:
        yield _why_not_capable(*able[0])
    elif able:
        yield f"Every quantity is capable: Cpk is {_CAPABLE} or more."
    if line.limits is not None:
        counts = line.counts
        yield (
            f"{counts['pass']} of {line.table.total} recordings pass, {counts['fail']} fail, {counts['undecided']} are "
            "undecided."
        )
    if line.alarms:
        first = _alarm_rows(line)[0][0]
        yield f"{counted(len(line.alarms), 'alarm')}{', the first' * (len(line.alarms) > 1)}: {first.lower()}."
    elif any(quantity.charts for quantity in line.followed):
        yield "No alarm: nothing changed along the line."
    else:
        yield "Too few units for control charts."


def _why_not_capable(quantity: FollowedQuantity, capability: Capability) -> str:
    limit = quantity.limit
    assert limit is not None
    why = f"varies too much for the limits {limit.words()}"
    if not capability.cp[0] < _CAPABLE:  # or there is one limit only
        mean = amount(capability.mean, si_unit(quantity.name), 3, limit.stated)
        why = f"has a mean, {mean}, too near a limit ({limit.words()})"
    verb = "is not" if capability.cpk[2] < _CAPABLE else "may not be"  # by the interval's upper end
    return f"The line {verb} capable: {spoken(quantity.name)} {why}."


def _next(line: Line) -> str:
    if line.limits is None:
        return (
            f"`jaximu accept {shlex.quote(line.table.file)} --limits LIMITS.toml -o LINE` holds every unit to limits."
        )
    for device, item in line.items(1):
        log = shlex.quote(line.table.files[line.table.devices.index(device)])
        return f"`jaximu diagnose {log} -o RESULTS` shows what is unusual about {device} ({spoken(item.name)})."
    return ""


# --- tables -----------------------------------------------------------------------------------------------------------


def _capability(line: Line, able: _Able) -> Section:
    judged = line.judged
    failed = {} if judged is None else dict(zip(judged.names, np.sum(judged.verdict == FAIL, axis=0), strict=True))
    return Section(
        "Capability",
        [
            Table(
                ("quantity", "Cpk (95 %)", "Cp (95 %)", "mean ± standard deviation", "limits", "fail"),
                [_capability_row(*pair, failed.get(pair[0].name, 0)) for pair in able],
                "Of each device's first recording; the deviation is that of all units, drift between them included. "
                f"Marked: Cpk below {_CAPABLE}. Fail: recordings of all.",
                [row for row, (_, capability) in enumerate(able) if capability.cpk[0] < _CAPABLE],
                brief=6,
            )
        ],
    )


def _capability_row(quantity: FollowedQuantity, capability: Capability, failed: int) -> tuple[str, ...]:
    limit = quantity.limit
    assert limit is not None
    shown, factor = in_shown_unit(si_unit(quantity.name), limit.stated)
    return (
        spoken(quantity.name),
        _index(capability.cpk),
        _index(capability.cp),
        with_interval(factor * capability.mean, factor * capability.deviation / Z95, shown),  # ± one deviation
        limit.words(),
        str(failed),
    )


def _worst_lots(able: _Able) -> Section:
    rows = []
    for quantity, _ in able:
        if quantity.lots:
            worst = min(quantity.lots, key=lambda lot: quantity.lots[lot].cpk[0])
            rows.append((spoken(quantity.name), worst, _index(quantity.lots[worst].cpk)))
    return Section("Worst lots", [Table(("quantity", "lot", "Cpk of the lot (95 %)"), rows)])


def _index(ends: tuple[float, float, float]) -> str:
    """Return an index of capability with its 95 % interval; nothing where there is none."""
    return "" if np.isnan(ends[0]) else with_interval(ends[0], (ends[2] - ends[1]) / (2 * Z95))


def _alarm_rows(line: Line) -> list[tuple[str, str]]:
    stated = {quantity.name: quantity.limit.stated for quantity in line.followed if quantity.limit is not None}
    ordered = sorted(line.alarms, key=lambda alarm: _ORDER.index(alarm.kind))
    return [(_TITLES[alarm.kind], f"{sentence(alarm.words(stated.get(alarm.name, '')))}.") for alarm in ordered]


def _not_passed(line: Line) -> Section:
    cells = ("name", "value", "limits", "probability", "verdict")
    rows = [(device, *(item_row(item)[cell] for cell in cells)) for device, item in line.items(MOST_ROWS)]
    more = sum(len(line.missed(row)) for row in range(len(line.table.rows))) - len(rows)
    return Section(
        "What does not pass",
        [
            Table(
                ("device", "quantity", "value ± U (k = 2)", "limits", "conforms with probability", "verdict"),
                rows,
                f"And {more} more; the table's column `not_passed` has all." if more else "",
            )
        ],
    )


def _gauge(line: Line) -> Section:
    questions, rows, marked = max(1, len(line.followed)), [], []
    for quantity in line.followed:
        gauge, unit, stated = quantity.gauge, si_unit(quantity.name), quantity.limit.stated if quantity.limit else ""
        if gauge is None:
            continue
        shown, factor = in_shown_unit(unit, stated)
        value, low, high = (number(factor * end, 2) for end in gauge.repeatability)
        marked += [len(rows)] * (gauge.categories < _CATEGORIES)
        rows.append(
            (
                spoken(quantity.name),
                f"{value} ({low} to {high}) {shown}",
                amount(gauge.reproducibility, unit, 2, stated) if gauge.crossed else "not crossed",
                amount(gauge.parts, unit, 2, stated),
                str(gauge.categories),
                f"{gauge.explained:.2f}{' *' * (gauge.p_value * questions < _LEVEL)}",
            )
        )
    return Section(
        "Gauge: repeated recordings",
        [
            Table(
                (
                    "quantity",
                    "repeatability (95 %)",
                    "between stations",
                    "between units",
                    "ndc",
                    "observed / stated",
                ),
                rows,
                "Standard deviations by analysis of variance. ndc: groups of units that the measurement can "
                "distinguish; marked below 5 (AIAG). Observed / stated: scatter of a unit's repeated recordings, "
                "in multiples of the uncertainty that each states; 1 is expected, and * marks what chance does "
                "not explain (p < 1 %, all quantities allowed for).",
                marked,
            )
        ],
    )


# --- charts -----------------------------------------------------------------------------------------------------------


def _to_draw(line: Line) -> list[tuple[FollowedQuantity, str]]:
    """Return the charts that show most: of the least capable quantity, those with alarms, those of a low Cpk."""
    charts = [(quantity, station) for quantity in line.followed for station in quantity.charts]
    cpk = {quantity.name: capability.cpk[0] for quantity, capability in _by_capability(line)}
    worst = next(iter(cpk), "")

    def rank(entry: tuple[FollowedQuantity, str]) -> tuple[bool, int, float]:
        name, (chart, _) = entry[0].name, entry[0].charts[entry[1]]
        return name != worst, -len(chart.drifting) - len(chart.beyond) - len(chart.jumps), cpk.get(name, np.inf)

    return sorted(charts, key=rank)[:_CHARTS]


def _chart_figure(line: Line, drawn: list[tuple[FollowedQuantity, str]]) -> Figure:
    drawing, rows = figures.stacked(2 * len(drawn), 1.5, 0.6, height_ratios=[2.2, 1] * len(drawn))
    for (quantity, station), above, below in zip(drawn, rows[::2], rows[1::2], strict=True):
        chart, places = quantity.charts[station]
        unit, factor = in_shown_unit(si_unit(quantity.name), quantity.limit.stated if quantity.limit else "")
        days = line.table.days[places]
        dated = bool(np.isfinite(days).all() and np.ptp(days) > 0)
        across = (days * 86400).astype("datetime64[s]") if dated else np.arange(len(places))
        ranges = np.abs(np.diff(chart.values, prepend=np.nan))
        bound = chart.bound * chart.deviation
        for axes, values, hits, ends in (
            (above, chart.values, chart.beyond, (chart.centre - bound, chart.centre + bound)),
            (below, ranges, chart.jumps, (np.sqrt(2) * bound,)),
        ):
            size = 4 if len(places) < 200 else 2.5
            dots = axes.plot(across, factor * values, "o", color=_VALUE, ms=size, alpha=0.6, mew=0, label="unit")
            named(dots[0], [line.table.devices[row] for row in places[np.isfinite(values)]])
            axes.plot(across[hits], factor * values[hits], "D", color=_OUT, ms=5, label="beyond control limits")
            for end in ends:
                line_of_end = axes.axhline(factor * end, color="#5C5C66", linestyle="--", linewidth=1)
            line_of_end.set_label("control limits of a unit")
        above.plot(across, factor * chart.average, color=_AVERAGE, linewidth=1.5, label="moving average")
        above.plot(across[chart.drifting], factor * chart.average[chart.drifting], ".", color=_OUT, markersize=4)
        for side in (-1, 1):
            end = chart.centre + side * chart.average_bound * chart.deviation
            above.plot(across, factor * end, color=_AVERAGE, linestyle=":", linewidth=1)
        title = spoken(quantity.name) + (f", station {station}" if station else "")
        dressed(above, title + _draw_limits(above, quantity.limit, chart, factor), ylabel=f"[{unit}]")
        dressed(below, xlabel="" if dated else "unit", ylabel=f"moving range\n[{unit}]")
        below.yaxis.label.set_size(8)
    figures.legend_below(drawing, rows[0], 5)
    return drawing


def _draw_limits(axes: Axes, limit: Limit | None, chart: Chart, factor: float) -> str:
    """Draw the limits that units are held to, and return what they are; those far off are beyond the panel."""
    if limit is None:
        return ""
    farthest = 2 * chart.bound * chart.deviation
    ends = [end for end in (limit.low, limit.high) if abs(end - chart.centre) < farthest]
    for end in ends:
        axes.axhline(factor * end, color="black", linewidth=1.4, label="limit" if end == ends[0] else None)
    return f", limits {limit.words()}" + ("" if ends else " (off the panel)")
