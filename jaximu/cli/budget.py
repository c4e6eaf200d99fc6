"""`jaximu budget`: how each error of the set-up reaches each parameter."""

from __future__ import annotations

import inspect
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.ground.errors import InputError

if TYPE_CHECKING:
    from jaximu.planning.budget import Budget

__all__ = ["run"]


def run(
    specification_file: Annotated[Path | None, arg(metavar="SPEC", help="TOML file; --explain describes it.")] = None,
    /,
    *,
    goal: Annotated[
        tuple[str, ...],
        arg(metavar="GOAL [GOAL ...]", help='Standard deviations wanted, such as "accelerometer.bias 0.2 mg".'),
    ] = (),
    check: Annotated[int, arg(metavar="N", help="Compare with N simulated sessions, each calibrated in full.")] = 0,
    seed: Annotated[int, arg(metavar="N", help="Random seed of these sessions.")] = 0,
    explain: Annotated[bool, arg(help="Describe the specification and exit.")] = False,
    results: options.Output = options.RESULTS,
) -> None:
    """Compute an error budget: how each error of a set-up reaches each parameter, and what to improve for a goal.

    DIR receives budget.json, report.html and budget.png.

    Examples:
      jaximu budget --explain
      jaximu budget setup.toml --goal "accelerometer.bias 0.2 mg" -o budget

    """
    if specification_file is None and not explain:
        raise InputError("name a specification: jaximu budget SPEC.toml; --explain describes one.")
    if check < 0 or 0 < check < 50 or seed < 0:
        raise InputError("--check takes 50 sessions or more (2000 resolve 3 %), --seed a number from 0 up.")
    options.require_files(specification_file)
    from jaximu.planning import budget as planning

    if explain or specification_file is None:
        print(inspect.getdoc(planning))
        return
    from jaximu.planning.goals import parse_goal

    task = planning.read_task(specification_file)
    task = replace(task, goals=(*task.goals, *map(parse_goal, goal)))
    results.prepare()
    with progress("propagating errors"):
        budget = planning.budget(task, check, seed)
    write = options.drawn("budget", "write_budget", budget)
    results.give(budget.text, lambda: _print(budget), write, "budget.json, report.html and budget.png", budget=budget)


def _print(budget: Budget) -> None:
    from jaximu.cli.shown import console, table
    from jaximu.report.budget import check_words, goal_words, headline, nonlinear_words, parameter_rows, source_rows

    screen = console()
    headers = ("source", "size (1σ)", "mean share", "most of")
    table(screen, headers, [*source_rows(budget)], "Sources, dominant first")
    drawn = ["by Monte Carlo"] if budget.check else []
    rows = [
        (words, sigma, *([simulated] if budget.check else []), made)
        for words, sigma, made, simulated in parameter_rows(budget)
    ]
    table(screen, ("parameter", "1σ", *drawn, "made of"), rows, "Parameters")
    texts = [headline(budget), *(goal_words(budget, goal) for goal in budget.goals)]
    texts += [f"not linear: {text}" for text in nonlinear_words(budget)]
    texts += [check_words(budget)] if budget.check else []
    texts += [f"stays open: {text}" for text in budget.open] + [f"note: {text}" for text in budget.notes]
    for text in texts:
        screen.print(text)
