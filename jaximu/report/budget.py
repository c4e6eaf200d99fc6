"""The page of an error budget: what each parameter's uncertainty is made of, and what to improve."""

import re
import shlex
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from jaximu.estimation.uncertainty import describe
from jaximu.ground.array_types import FloatArray
from jaximu.ground.page import Page, Part, Picture, Section, Statement, Table
from jaximu.ground.quantities import Z95, counted, listed, number, sentence, size, unit_text
from jaximu.planning.budget import Budget, Goal, Trials
from jaximu.planning.setup_errors import ErrorSource
from jaximu.report import figures
from jaximu.report.canvas import Axes, Figure
from jaximu.report.figures import LEAST_SHARE, OTHERS, PALETTE, dressed, legend_below

_GROUPS = {"accelerometer": "Accelerometer", "gyroscope": "Gyroscope", "setup": "Set-up"}


def page_of(budget: Budget) -> Page:
    """Return which goals are reached, which source dominates, and what each parameter's uncertainty is made of."""
    return Page(
        f"Error budget of {Path(budget.source).name}",
        tuple(_verdict(budget)),
        *_number(budget),
        (
            Picture(
                "budget",
                partial(_figure, budget),
                "Shares of each source in each parameter's variance",
                "A bar is the variance of one parameter, divided among its sources; the figure beside it is its "
                "standard deviation (1σ). Independent errors add by their squares, so halving a source removes three "
                "quarters of its part.",
            ),
            Section(
                "Goals",
                [
                    Statement(f"{goal.name} to {_wanted(goal)}", sentence(goal_words(budget, goal)), not goal.reached)
                    for goal in budget.goals
                ],
            ),
            Section(
                "Sources, dominant first",
                [Table(("source", "size (1σ)", "mean share of the variances", "most of"), [*source_rows(budget)])],
            ),
            _parameters(budget),
            _limits(budget),
        ),
        notes=budget.notes,
        next=_next(budget),
    )


def _parameters(budget: Budget) -> Section:
    drawn = ("by Monte Carlo",) * (budget.check is not None)
    rows = [
        (words, sigma, *([simulated] if drawn else []), made)
        for words, sigma, made, simulated in parameter_rows(budget)
    ]
    return Section(
        "Parameters",
        [
            Table(
                ("parameter", "1σ", *drawn, "made of"),
                rows,
                "Standard deviations; scale and misalignment relative to the scale of their axis. To first order, "
                "through the whole fit.",
                [index for index, row in enumerate(rows) if not row[-1]],
            )
        ],
    )


def _limits(budget: Budget) -> Section:
    parts: list[Part] = [Statement("Not linear", text, caution=True) for text in nonlinear_words(budget)]
    if budget.check is not None:
        parts.append(Statement("Against simulated sessions", check_words(budget, budget.check)))
    parts += [Statement("Weak or open", text, caution=True) for text in budget.open]
    return Section("How far it holds", parts)


# --- words ------------------------------------------------------------------------------------------------------------


def amount(value: float, unit: str) -> str:
    """Put a standard deviation into the unit a person compares: ppm, mrad, mm/s², °/s."""
    factor, shown = {"1": (1e6, "ppm"), "rad": (1e3, "mrad")}.get(unit, (1.0, unit))
    return size(value * factor, shown, 2)


def _reading_order(budget: Budget) -> list[int]:
    """Scales, misalignments and biases of each triad together."""
    kinds = {"1": 0, "rad": 1, "m/s^2": 2, "rad/s": 3}

    def key(index: int) -> tuple[str, int]:
        name = budget.names[index]
        return name.owner, kinds.get(budget.units[index], 4) if name.effect is None else 4

    return sorted(range(len(budget.names)), key=key)


def _verdict(budget: Budget) -> Iterator[str]:
    count = len(budget.goals)
    if count:
        reached = sum(goal.reached for goal in budget.goals)
        one = f"The goal is {'' if reached else 'not '}reached."
        yield one if count == 1 else f"{reached} of {count} goals are reached."
    known = np.flatnonzero(budget.determined)
    if not len(known):
        yield "The scheme determines no parameter."
        return
    counts = Counter(budget.shares[:, known].argmax(axis=0).tolist())
    parts = [
        f"{budget.sources[row].words} for {counts[row]}" for row in sorted(counts, key=lambda row: (-counts[row], row))
    ]
    parts[0] = f"{parts[0]} of {counted(len(known), 'parameter')}"
    yield f"Largest source of uncertainty: {listed(parts)}."
    if lost := len(budget.names) - len(known):
        yield f"This scheme does not determine {counted(lost, 'other parameter')}."


def _number(budget: Budget) -> tuple[str, str]:
    shown = {goal.worst: goal for goal in budget.goals if budget.determined[budget.names.index(goal.worst)]}
    if shown:
        goal = max(shown.values(), key=lambda goal: _total(budget, goal) / goal.size)
        return amount(
            _total(budget, goal), goal.unit
        ), f"standard deviation (1σ) of the {describe(goal.worst, budget.imu)}; its goal is {_wanted(goal)}"
    if not budget.sources or not budget.determined.any():
        return "not determined", "the scheme determines no parameter"
    row = budget.order()[0]
    return _percent(float(budget.shares[row, budget.determined].mean())), (
        f"of the parameters' variances, on average, come from the {budget.sources[row].words}"
    )


def _total(budget: Budget, goal: Goal) -> float:
    return float(budget.total[budget.names.index(goal.worst)])


def _wanted(goal: Goal) -> str:
    stated = _stated(goal.text)
    shown = amount(goal.size, goal.unit)
    same = re.sub(r"^[\d.]+", "", stated) == re.sub(r"^[\d.]+", "", shown)
    return stated if same else f"{stated} ({shown})"


def _stated(size: str) -> str:
    """Return a size as it was stated, its unit as it is printed."""
    return re.sub(r" °(?!/)", "°", unit_text(re.sub("degrees?", "deg", size.strip())))


def _next(budget: Budget) -> str:
    source = shlex.quote(budget.source)
    if not all(goal.reached for goal in budget.goals):
        return f"improve the set-up in the specification and run `jaximu budget {source}` once more."
    if budget.check is None:
        return f"`jaximu budget {source} --check 2000` compares the budget with simulated sessions."
    return "`jaximu turntable LOG --reference schedule.csv -o RESULTS` calibrates a session on this set-up."


def parameter_rows(budget: Budget) -> Iterator[tuple[str, ...]]:
    """Yield each parameter in words, its 1σ, what it is made of (dominant first), and its 1σ by Monte Carlo."""
    part = budget.shares
    off = budget.nonlinear()
    for index in _reading_order(budget):
        words = describe(budget.names[index], budget.imu)
        unit = budget.units[index]
        if not budget.determined[index]:
            yield words, "not determined", "", ""
            continue
        ranked = [int(row) for row in (-part[:, index]).argsort(kind="stable") if part[row, index] >= LEAST_SHARE][:3]
        made = [f"{budget.sources[row].words} {100 * part[row, index]:.0f} %" for row in ranked]
        made += [f"not linear in {budget.sources[row].words}" for row, column in off if column == index]
        drawn = "" if budget.check is None else amount(budget.check.rms[index], unit)
        yield words, amount(budget.total[index], unit), ", ".join(made), drawn


def source_rows(budget: Budget) -> Iterator[tuple[str, ...]]:
    """Yield each source, dominant first: in words, its size, its mean share, and the parameter it has most of."""
    part = budget.shares
    known = np.flatnonzero(budget.determined)
    for row in budget.order():
        source = budget.sources[row]
        most = int(known[part[row, known].argmax()]) if len(known) else 0
        mean = part[row, known].mean() if len(known) else 0.0
        where = f"{describe(budget.names[most], budget.imu)}: {_percent(part[row, most])}"
        yield source.words, _stated(source.size), _percent(mean), where if part[row, most] >= 1e-3 else "nowhere"


def _percent(share: float) -> str:
    return "below 0.1 %" if share < 1e-3 else f"{100 * share:.{0 if share >= 0.1 else 1}f} %"


def nonlinear_words(budget: Budget) -> Iterator[str]:
    """Say where the linear budget is off by more than 5 %."""
    for row, index in budget.nonlinear():
        unit = budget.units[index]
        off = budget.off[row, index]
        wrong = f"{100 * abs(off):.0f} % too {'small' if off > 0 else 'large'}"
        if off > 1:
            wrong = f"{number(1 + off, 2)} times too small"
        yield (
            f"{describe(budget.names[index], budget.imu)}: {budget.sources[row].words} reaches it with "
            f"{amount(budget.actual[row, index], unit)} in the whole fit, {amount(budget.sigma[row, index], unit)} to "
            f"first order; its total of {amount(budget.total[index], unit)} is {wrong}."
        )


def goal_words(budget: Budget, goal: Goal) -> str:
    """Say whether a goal is reached, and if not, how good each source must become."""
    index = budget.names.index(goal.worst)
    worst = describe(goal.worst, budget.imu)
    if not budget.determined[index]:
        return f"out of reach, because the scheme does not determine the {worst}."
    known = f"the {worst} is known to {amount(budget.total[index], goal.unit)}"
    if goal.reached:
        return f"reached: {known}."
    sources = {source.name: source for source in budget.sources}
    able = [_smaller(sources[need.sources[0]], need.times) for need in goal.alone if need.times is not None]
    unable = [sources[need.sources[0]].words for need in goal.alone if need.times is None]
    text = f"not reached: {known}. "
    if able:
        text += f"{'One of these alone would do' if len(able) > 1 else 'One source alone would do'}: {'; '.join(able)}."
        return text + (f" Not enough by themselves: {', '.join(unable)}." if unable else "")
    if goal.together is None or goal.together.times is None:
        return text + "Improving all sources together is not enough."
    both = "; ".join(_smaller(sources[name], goal.together.times) for name in goal.together.sources)
    return f"{text}No single source is enough. Improve together: {both}."


def _smaller(source: ErrorSource, times: float) -> str:
    """How good a source must become, in the unit it was stated in."""
    stated = re.fullmatch(r"\s*([+\d.eE-]+)(.*)", source.size)
    if source.value is None or stated is None:
        return f"{source.words} {number(times, 3)} times smaller"
    smaller = f"{number(float(stated[1]) / times, 2)} {stated[2].strip() or source.unit.replace('1', '')}"
    return f"{source.words} {_stated(smaller)} instead of {_stated(source.size)}"


def check_words(budget: Budget, check: Trials) -> str:
    """Compare the budget with sessions put through the whole estimator."""
    known = np.flatnonzero(budget.determined)
    ratio = check.rms[known] / budget.total[known]
    worst = int(np.abs(ratio - 1).argmax())
    chance = Z95 / np.sqrt(2 * check.draws)
    failed = f" {check.failed} of them did not converge and are left out." * bool(check.failed)
    return (
        f"{check.draws} sessions with all errors at once, through the whole estimator, scatter on average "
        f"{_compared(float(np.mean(ratio)))} as the budget says; farthest from it is the "
        f"{describe(budget.names[known[worst]], budget.imu)}, {_compared(ratio[worst])}. One ratio is off by "
        f"up to {100 * chance:.1f} % by chance (95 %).{failed}"
    )


def _compared(ratio: float) -> str:
    return f"{ratio:.3f} times as much"


# --- the picture ------------------------------------------------------------------------------------------------------


def _figure(budget: Budget) -> Figure:
    owners = [name.owner for name in budget.names]
    columns = [group for group in _GROUPS if group in owners]
    part = budget.shares
    order = budget.order()
    visible = [row for row in order if (part[row, budget.determined] >= LEAST_SHARE).any()][: len(PALETTE)]
    stacked = [(budget.sources[row].words, part[row], color) for row, color in zip(visible, PALETTE, strict=False)]
    if others := [row for row in order if row not in visible]:
        stacked.append(("others", part[others].sum(axis=0), OTHERS))
    figure = figures.new_figure(1.9 + 0.3 * max(owners.count(group) for group in columns))
    if len(columns) > 2:
        figure.set_figwidth(figure.get_figwidth() * 1.35)
    for axes, group in zip(figure.subplots(1, len(columns), squeeze=False)[0], columns, strict=True):
        dressed(axes, _GROUPS[group])
        _draw_bars(axes, budget, [index for index in _reading_order(budget) if owners[index] == group], stacked)
    legend_below(figure, figure.axes[0], 4)
    dominant = budget.sources[order[0]].words if order else "nothing"
    figures.headed(figure, f"Where the uncertainty comes from: most of all {dominant}")
    return figure


def _draw_bars(axes: Axes, budget: Budget, places: list[int], stacked: list[tuple[str, FloatArray, str]]) -> None:
    known = budget.determined[places]
    rows = np.arange(len(places))
    left = np.zeros(len(places))
    for label, share, color in stacked:
        width = np.where(known, 100 * share[places], 0.0)
        axes.barh(rows, width, left=left, height=0.72, color=color, edgecolor="white", linewidth=0.6, label=label)
        left += width
    curved = {column for _, column in budget.nonlinear()}
    for row, index in enumerate(places):
        text = amount(budget.total[index], budget.units[index]) + " *" * (index in curved)
        axes.text(102 if known[row] else 2, row, text if known[row] else "not determined", va="center", fontsize=8.5)
    names = [budget.names[index] for index in places]
    note = "   (*: not linear)" if curved & set(places) else ""
    axes.set(xlim=(0, 135), ylim=(len(places) - 0.4, -0.6), xticks=[0, 25, 50, 75, 100])
    axes.set_xlabel(f"share of the variance (%); right: 1σ{note}", fontsize=9)
    axes.set_yticks(rows, [describe(name, budget.imu).removeprefix(f"{name.owner} ") for name in names], fontsize=8.5)
    axes.grid(False)
    axes.tick_params(axis="y", length=0)
