"""What the benchmarks share: the machine they ran on, and results as a table, JSON and Markdown."""

import argparse
import json
import os
import platform
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any

from scipy.stats import beta

RESULTS = Path(__file__).parent / "results"


def arguments(description: str | None, **flags: str) -> argparse.Namespace:
    """Parse the one option of all benchmarks, and more flags by name with what they do."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--small", action="store_true", help="fewer units or repetitions; results are not kept")
    for name, does in flags.items():
        parser.add_argument(f"--{name}", action="store_true", help=does)
    return parser.parse_args()


def _asked(*question: str) -> str:
    """Return what git says of this tree."""
    command = ["git", "-C", str(RESULTS.parent), *question]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def machine() -> dict[str, Any]:
    """Describe where and when the figures were measured."""
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    commit = {}
    with suppress(OSError, subprocess.CalledProcessError):
        commit["commit"] = _asked("rev-parse", "--short", "HEAD")
        if _asked("status", "--porcelain", "-uno", "--", ":/", f":(exclude,top)benchmarks/{RESULTS.name}"):
            commit["commit"] += "-dirty"  # but for other results
    packages = {name: version(name) for name in ("jax", "optimistix", "numpy", "scipy")}
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **packages,
        **commit,
        "date": date.today().isoformat(),
    }


def share(hits: int, count: int, digits: int = 1) -> str:
    """Return a share in percent with its 95 % interval (Clopper and Pearson)."""
    low = 0.0 if hits == 0 else beta.ppf(0.025, hits, count - hits + 1)
    high = 1.0 if hits == count else beta.ppf(0.975, hits + 1, count - hits)
    return f"{100 * hits / count:.{digits}f} % ({100 * low:.{digits}f} … {100 * high:.{digits}f})"


def least(job: Callable[[], object], repetitions: int) -> float:
    """Return the least processor time in seconds of a job that is repeated; other work on the machine adds to none."""
    times = []
    for _ in range(repetitions):
        began = time.process_time()
        job()
        times.append(time.process_time() - began)
    return min(times)


class Table:
    """Rows of text under a heading, shown on the terminal and kept as Markdown."""

    def __init__(self, title: str, columns: Sequence[str], note: str = ""):
        self.title, self.columns, self.note = title, list(columns), note
        self.rows: list[list[str]] = []

    def add(self, *cells: Any) -> None:
        """Add a row; numbers are shown to four digits."""
        self.rows.append([f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in cells])

    def markdown(self) -> str:
        """Return the table as Markdown."""
        lines = ["| " + " | ".join(row) + " |" for row in [self.columns, ["---"] * len(self.columns), *self.rows]]
        return "\n".join([f"**{self.title}**", "", *lines, *(["", self.note] if self.note else [])])

    def show(self) -> None:
        """Print the table."""
        from rich.console import Console
        from rich.table import Table as RichTable

        shown = RichTable(title=self.title, caption=self.note or None)
        for column in self.columns:
            shown.add_column(column)
        for row in self.rows:
            shown.add_row(*row)
        Console(width=None if os.isatty(1) else 160, markup=False).print(shown)


def finish(
    name: str, tables: Sequence[Table], figures: dict[str, Any], keep: bool = True, script: str | None = None
) -> None:
    """Print the tables, and keep them and the figures in `results/`; `script` where it has another name."""
    for table in tables:
        table.show()
    if not keep:
        return
    RESULTS.mkdir(exist_ok=True)
    where = machine()
    (RESULTS / f"{name}.json").write_text(
        json.dumps({"machine": where, **figures}, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
    )
    commit = f", commit {where['commit']}" if "commit" in where else ""
    measured = (
        f"Measured {where['date']} on {where['cpu']}, {where['cores']} cores, Python {where['python']}, "
        f"jax {where['jax']}{commit}, by `python benchmarks/{script or name}.py`."
    )
    text = "\n\n".join([*(table.markdown() for table in tables), measured])
    (RESULTS / f"{name}.md").write_text(text + "\n", encoding="utf-8")
