"""Random units, each with one verb or chain of verbs: exit statuses, failures by kind, and seconds.

`python benchmarks/random_units.py --draws 2000 --start 0`. Each draw that ended stands in a line of `--kept FILE`, so
that a run that was stopped goes on; a failure is printed as it comes, with the seed that repeats it:
`python tests/random_units.py SEED`.
"""

import argparse
import json
import multiprocessing
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from environment import environment

os.environ.update(environment())

from common import Table, finish, machine, share

MET = (
    (
        "1935",
        "diagnose: Found zero norm quaternions",
        "a fit with gyro.lag began at −91 ms, which all axes have in common "
        "and turns do not show to first order, and came to nothing",
    ),
    (
        "1265",
        "diagnose --reference: a gyroscope's gain off by 44 sigma",
        "most likely a fit with a step of the scale that did not converge; it begins elsewhere now",
    ),
    ("507", "calibrate: division by zero", "turns that fit exactly leave no variance to compare"),
    ("several", "check: an empty picture", "no parameter was told by itself"),
    (
        "several",
        "other numbers on another machine",
        "what rounding decided: the statistic of odd poses, draws of a limit, the sign of a weak direction",
    ),
)
"""Seeds and failures of draws before the version that ends without one."""


def options() -> argparse.Namespace:
    """Parse what is to be run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=2000, help="number of draws")
    parser.add_argument("--start", type=int, default=0, help="seed of the first")
    parser.add_argument("--processes", type=int, default=2, help="number of processes")
    parser.add_argument("--kept", type=Path, help="file of finished draws, to go on with (default: a temporary one)")
    parser.add_argument("--small", action="store_true", help="twenty draws; results are not kept")
    return parser.parse_args()


@cache
def code() -> str:
    """Return the commit whose code this process runs, else the version; asked once, when the process starts."""
    from jaximu import __version__

    return machine().get("commit", __version__)


def prepare() -> None:
    """Get a process ready."""
    from random_units import prepare_process

    prepare_process()
    code()


def result_of(seed: int) -> dict:
    """Run one draw; return what is kept of it."""
    from random_units import run_draw

    with tempfile.TemporaryDirectory(prefix="random-unit-") as folder:
        draw = run_draw(seed, Path(folder) / "draw")
    return {
        "seed": seed,
        "recipe": draw.settings["recipe"],
        "line": draw.line,
        "plain": draw.plain,
        "refused": "refused" in draw.settings,
        "statuses": draw.statuses,
        "seconds": draw.seconds,
        "failures": [[failure.kind, failure.run, failure.text] for failure in draw.failures],
        "command": "jaximu " + " ".join(draw.last),
        "code": code(),
    }


def finished(path: Path) -> dict[int, dict]:
    """Return the draws that a file keeps, by seed; a line that was cut off does not count."""
    draws = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            draw = json.loads(line)
        except ValueError:
            continue
        draws[draw["seed"]] = draw
    return draws


def results(seeds: list[int], processes: int) -> Iterator[dict]:
    """Give the results of draws as they end; a process is replaced after two hundred, to give its memory back."""
    if processes == 1:
        prepare()
        yield from map(result_of, seeds)
        return
    context = multiprocessing.get_context("spawn")
    with context.Pool(processes, prepare, maxtasksperchild=200) as pool:
        yield from pool.imap_unordered(result_of, seeds)


def tables(draws: list[dict]) -> list[Table]:
    """Return draws by verb or chain, and failures by kind."""
    codes = Counter(draw.get("code", "not stated") for draw in draws)
    by_recipe = Table(
        "Random units: draws by verb or chain",
        ["verb or chain", "draws", "runs", "exit 0", "1", "2", "3, 4", "refused", "if plain", "failed", "s a draw"],
        "A draw is one unit with one verb or chain, each verb run plain, with --json and with -o. Refused: the last "
        "verb ended with 1 or 2; if plain: of settings without a hidden effect, poor poses or missing sensors. "
        "Processor seconds, all runs of a draw together, of a process that keeps what it compiled. "
        f"Draws by commit: {', '.join(f'{name} {count}' for name, count in codes.most_common())}.",
    )
    names = sorted({draw["recipe"] for draw in draws})
    for name in [*names, "all"]:
        some = [draw for draw in draws if name in (draw["recipe"], "all")]
        statuses = Counter(status for draw in some for _, status in draw["statuses"])
        plain = [draw for draw in some if draw["plain"]]
        refused = sum(draw["refused"] for draw in plain)
        by_recipe.add(
            name.replace("_", " "),
            len(some),
            statuses.total(),
            statuses[0],
            statuses[1],
            statuses[2],
            statuses[3] + statuses[4],
            sum(draw["refused"] for draw in some),
            f"{refused} of {len(plain)}",
            sum(bool(draw["failures"]) for draw in some),
            f"{sum(draw['seconds']['processor'] for draw in some) / len(some):.1f}",
        )
    by_kind = Table("Random units: failures by kind", ["kind", "draws", "share", "seeds", "the first"])
    kinds: dict[str, list[dict]] = {}
    for draw in draws:
        for kind in dict.fromkeys(kind for kind, *_ in draw["failures"]):
            kinds.setdefault(kind, []).append(draw)
    for kind, some in sorted(kinds.items(), key=lambda pair: -len(pair[1])):
        first = next(text for name, _, text in some[0]["failures"] if name == kind)
        seeds = ", ".join(str(draw["seed"]) for draw in some[:8])
        by_kind.add(
            kind, len(some), share(len(some), len(draws)), seeds, " ".join(first.replace("|", "/").split())[:160]
        )
    if not kinds:
        by_kind.add("none", 0, share(0, len(draws)), "", "")
    met = Table("Random units: failures met on the way, and mended", ["seed", "what happened", "its cause"])
    for row in MET:
        met.add(*row)
    return [by_recipe, by_kind, met]


def main() -> None:
    """Run what is not yet in the file, and keep the tables."""
    given = options()
    with tempfile.TemporaryDirectory() as folder:
        path = given.kept or Path(folder) / "draws.jsonl"
        wanted = range(given.start, given.start + (min(given.draws, 20) if given.small else given.draws))
        draws = {seed: draw for seed, draw in finished(path).items() if seed in wanted}
        missing = [seed for seed in wanted if seed not in draws]
        with path.open("a", encoding="utf-8") as file:
            for draw in results(missing, given.processes):
                draws[draw["seed"]] = draw
                file.write(json.dumps(draw) + "\n")
                file.flush()
                for kind, run, text in draw["failures"]:
                    print(f"{draw['line']}\n  {kind}: {run}: {text}\n  {draw['command']}", flush=True)
    ordered = [draws[seed] for seed in sorted(draws)]
    finish(
        "random_units",
        tables(ordered),
        {"draws": len(ordered), "start": given.start, "failures": [draw for draw in ordered if draw["failures"]]},
        keep=not given.small,
    )


if __name__ == "__main__":
    main()
