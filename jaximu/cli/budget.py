"""`jaximu budget`: how each error of the set-up reaches each parameter."""

from __future__ import annotations

import inspect
from dataclasses import replace
from pathlib import Path

from tyro.conf import Positional

from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.cli.options import option, switch, takes_options
from jaximu.ground.errors import InputError


@takes_options
class BudgetCommand:
    """Compute an error budget: how each error of a set-up reaches each parameter, and what to improve for a goal.

    DIR receives budget.json, report.html and budget.png.

    Examples:
      jaximu budget --explain
      jaximu budget setup.toml --goal "accelerometer.bias 0.2 mg" -o budget

    """

    specification_file: Path | None = option("SPEC", "TOML file; --explain describes it.", None, Positional)
    goal: tuple[str, ...] = option(
        "GOAL [GOAL ...]", 'Standard deviations wanted, such as "accelerometer.bias 0.2 mg".', ()
    )
    check: int = option("N", "Compare with N simulated sessions, each calibrated in full.", 0)
    seed: int = option("N", "Random seed of these sessions.", 0)
    explain: bool = switch("Describe the specification and exit.")
    results: options.Results = options.RESULTS

    def run(self) -> None:
        """Do what the command line says."""
        if self.specification_file is None and not self.explain:
            raise InputError("name a specification: jaximu budget SPEC.toml; --explain describes one.")
        if self.check < 0 or 0 < self.check < 50 or self.seed < 0:
            raise InputError("--check takes 50 sessions or more (2000 resolve 3 %), --seed a number from 0 up.")
        options.require_files(self.specification_file)
        from jaximu.planning import budget as planning

        if self.explain or self.specification_file is None:
            print(inspect.getdoc(planning))
            return
        from jaximu.planning.goals import parse_goal
        from jaximu.planning.setup_errors import read_task

        task = read_task(self.specification_file)
        task = replace(task, goals=(*task.goals, *map(parse_goal, self.goal)))
        self.results.prepare()
        with progress("propagating errors"):
            budget = planning.budget(task, self.check, self.seed)
        self.results.present(budget.summary, "budget.json, report.html and budget.png", budget=budget)
