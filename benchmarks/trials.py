"""Small recordings of what went wrong on other people's logs: how many are answered rightly, by kind.

`python benchmarks/trials.py FILE`: what the runner of the outside trials, which are not part of this repository, wrote
with `--json FILE`. Each trial is one file or a few, the commands for it, and what must and must not be said.
"""

import argparse
import json
from collections import defaultdict
from pathlib import Path

from common import Table, finish


def main() -> None:
    """Keep the table of a run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path, help="what the runner wrote with --json")
    kinds = defaultdict(list)
    for trial in json.loads(parser.parse_args().file.read_text(encoding="utf-8")):
        kinds[trial["kind"]].append(trial)
    table = Table("Trials of other people's logs", ["kind", "right", "of", "wrong"])
    for kind, trials in kinds.items():
        wrong = [f"{trial['name']}: {'; '.join(trial['wrong'])}" for trial in trials if trial["wrong"]]
        table.add(kind, len(trials) - len(wrong), len(trials), "; ".join(wrong))
    everything = [trial for trials in kinds.values() for trial in trials]
    right = sum(not trial["wrong"] for trial in everything)
    table.add("all", right, len(everything), "")
    finish("trials", [table], {"right": right, "trials": everything})


if __name__ == "__main__":
    main()
