"""Files of other makers: how many `jaximu` reads, answers with a line to paste, asks about, or reads wrong.

`python benchmarks/dialects.py`. The files are those of `tests/dialects.py` and `tests/makers.py`: simulated
recordings written in each maker's habit of names, units, separators and preambles, so that what is read can be compared
with the truth.
"""

import os
import sys
import tempfile
from collections import Counter
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from common import Table, arguments, finish
from dialects import attempt, random_table, wrong_line
from makers import ALL

WORDS = {"read": "read", "line": "line to paste", "asked": "asked", "unanswerable": "asked, without a line"}


def main() -> None:
    """Try every dialect and keep the table."""
    options = arguments(__doc__)
    table = Table("Files of other makers", ["file", "outcome", "line offered"])
    counts: Counter[str] = Counter()
    right = 0
    for name, dialect in ALL.items():
        with tempfile.TemporaryDirectory() as folder:
            kind, said = attempt(dialect, Path(folder) / "logs")
        counts[kind] += 1
        right += kind in dialect.must
        line = said.partition(". Answer first")[0].partition(". Why")[0] if said.startswith("--") else ""
        table.add(name, WORDS.get(kind, f"WRONG: {said}"), f"`{line}`" if line else "")
    seeds = range(1000, 1050 if options.small else 1500)
    with tempfile.TemporaryDirectory() as folder:
        mistaken = sum(bool(wrong_line(random_table(seed), Path(folder))) for seed in seeds)
    wrong = len(ALL) - sum(counts[kind] for kind in WORDS)
    table.note = (
        f"{len(ALL)} files: {counts['read']} read as they are, {counts['line']} with the line that is offered, "
        f"{counts['asked'] + counts['unanswerable']} asked about (the file does not say, or has no accelerometer), "
        f"{wrong} wrong. Right are values in SI within 0.4 % (counts: 3 %) and stamps within 2 %. "
        f"Of {len(seeds)} tables of random order, units and names {mistaken} get a wrong line."
    )
    finish(
        "dialects",
        [table],
        {"files": len(ALL), "right": right, "wrong": wrong, "random": len(seeds), "random_wrong": mistaken, **counts},
        not options.small,
    )


if __name__ == "__main__":
    main()
