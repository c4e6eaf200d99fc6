# ruff: noqa: E402 - threads are limited before anything that counts them is imported
"""Performance as a contract: ratios measured side by side, held against a committed baseline.

`python benchmarks/suite.py` measures and prints; `--gate` ends with status 1 where a metric is worse than
`baseline.json` by more than its tolerance, naming each; `--update` writes the baseline; `--profile FOLDER` keeps a
cProfile of each metric's own side, for `python -m pstats`. Every metric is our processor time over a yardstick's in the
same run, each the least of several interleaved repetitions, so that a baseline holds on another machine as far as
ratios do.
"""

import os

os.environ["JAX_PLATFORMS"] = os.environ.get("JAX_PLATFORMS") or "cpu"
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC", "PJRT_NPROC"):
    os.environ[name] = "1"

import argparse
import cProfile
import json
import math
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from common import Table, finish, machine

BASELINE = Path(__file__).parent / "baseline.json"
Pair = tuple[Callable[[], object], Callable[[], object]]


@dataclass(frozen=True)
class Metric:
    """What is promised: a ratio, in which direction it is better, and by which share it may be worse."""

    unit: str
    better: str  # "lower" or "higher"
    tolerance: float
    about: str


METRICS = {
    "fit_joint": Metric("scipy / jaximu", "higher", 0.25, "whole fit of both triads against scipy's solve"),
    "fit_accelerometer": Metric("scipy / jaximu", "higher", 0.3, "the same for the accelerometer alone"),
    "batch": Metric("in a batch / alone", "lower", 0.3, "fit of a unit in a batch of 32 against one at a time"),
    "import": Metric("jaximu / jax + optimistix", "lower", 0.15, "importing the library in a new process"),
    "command": Metric("calibrate / import jax", "lower", 0.2, "calibrate --json, 50 000 rows, compiled before"),
    "segment": Metric("segment / NumPy pass", "lower", 0.3, "finding poses against sums of squares of all samples"),
    "csv": Metric("jaximu / pyarrow", "lower", 0.3, "reading 50 000 rows of CSV"),
    "prepare": Metric("jaximu / pyarrow", "lower", 0.3, "Parquet file to observations, against reading its columns"),
}


def regressions(measured: dict[str, float], baseline: dict[str, dict]) -> list[str]:
    """Say in a sentence each what is worse than the baseline by more than its tolerance, or was not measured."""
    found = []
    for name, entry in baseline.items():
        before, value = entry["value"], measured.get(name, math.nan)
        if name not in measured:
            found.append(f"{name}: was not measured, the baseline has {before:.3g}.")
            continue
        worse = value / before - 1 if entry["better"] == "lower" else before / value - 1
        if not worse <= entry["tolerance"]:
            found.append(
                f"{name}: {value:.3g} {entry['unit']}, {100 * worse:.0f} % worse than {before:.3g} "
                f"(tolerance {100 * entry['tolerance']:.0f} %)."
            )
    return found + [f"{name}: has no baseline; --update writes one." for name in measured if name not in baseline]


# --- what is measured -------------------------------------------------------------------------------------------------


def interleaved(pair: Pair, repetitions: int, clock: Callable[[], float] = time.process_time) -> tuple[float, float]:
    """Return the least time of each of two jobs, run in turn so that a busy moment hits both."""
    times: tuple[list[float], list[float]] = [], []
    for job in pair:
        job()  # compiles, fills caches
    for _ in range(repetitions):
        for job, found in zip(pair, times, strict=True):
            began = clock()
            job()
            found.append(clock() - began)
    return min(times[0]), min(times[1])


def of_children() -> float:
    """Seconds of the processor that finished child processes took: other work on the machine disturbs them less."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def process(*arguments: str, scratch: Path) -> Callable[[], object]:
    environment = {**os.environ, "XDG_CACHE_HOME": str(scratch)}
    return lambda: subprocess.run([sys.executable, *arguments], check=True, capture_output=True, env=environment)


def measure(profiles: Path | None = None) -> dict[str, float]:
    """Measure every metric; `profiles` receives a cProfile of our side of those that run in this process."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import fleet as fleet_benchmark
    import formats as formats_benchmark
    import numpy as np
    import pyarrow.parquet as pq

    from jaximu.fleets import Job, Settings, fit_units
    from jaximu.fleets.rows import read_job
    from jaximu.recordings import write_recording
    from jaximu.recordings.segmentation import segment
    from jaximu.simulation import consumer_noise, draw_imu, simulate
    from jaximu.simulation.protocols import HandHeld

    found: dict[str, float] = {}

    def profiled(name: str, job: Callable[[], object]) -> None:
        if profiles is not None:
            profile = cProfile.Profile()
            profile.runcall(job)
            profile.dump_stats(profiles / f"{name}.prof")
        print(f"{name}: {found[name]:.3g}", file=sys.stderr)

    def ratio(name: str, ours: Callable[[], object], theirs: Callable[[], object], repetitions: int) -> None:
        mine, other = interleaved((ours, theirs), repetitions)
        found[name] = mine / other
        profiled(name, ours)

    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        recording, _ = simulate(draw_imu(0), HandHeld(40, 11.3), consumer_noise(), seed=0)
        log, text = scratch / "log.parquet", scratch / "log.csv"
        write_recording(recording, log)
        write_recording(recording, text)

        bare = process("-c", "import jax, optimistix", scratch=scratch)
        mine, other = interleaved((process("-c", "import jaximu", scratch=scratch), bare), 4, of_children)
        found["import"] = mine / other
        command = process("-m", "jaximu", "calibrate", str(log), "--json", scratch=scratch)
        mine, other = interleaved((command, process("-c", "import jax", scratch=scratch)), 4, of_children)
        found["command"] = mine / other

        def one_pass() -> None:
            for signal in recording.signals.values():
                values = signal.values - signal.values.mean(axis=0)
                np.cumsum(values, axis=0)
                np.cumsum(values**2, axis=0)

        ratio("segment", lambda: segment(recording), one_pass, 15)
        ratio("csv", lambda: formats_benchmark.ours(text), lambda: formats_benchmark.theirs("csv", text), 9)
        job = Job("log", str(log))
        columns = lambda: [column.to_numpy() for column in pq.read_table(log).columns]  # noqa: E731
        ratio("prepare", lambda: read_job(job, Settings()), columns, 15)

    made = fleet_benchmark.units(32)
    ratio("batch", lambda: fit_units(made), lambda: [fit_units([unit]) for unit in made], 3)
    seconds = fleet_benchmark.against_scipy(made * 8, 2)
    found["fit_joint"] = seconds["scipy, both triads"] / seconds["jaximu, both triads"]
    found["fit_accelerometer"] = seconds["scipy, accelerometer"] / seconds["jaximu, accelerometer"]
    profiled("fit_joint", lambda: fit_units(made))
    return {name: found[name] for name in METRICS}


# --- the command ------------------------------------------------------------------------------------------------------


def main(given: Sequence[str] | None = None) -> int:
    """Measure, show, and gate or update; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gate", action="store_true", help="status 1 where a metric is worse than the baseline")
    parser.add_argument("--update", action="store_true", help="write the baseline, and results/suite.md")
    parser.add_argument("--profile", type=Path, metavar="FOLDER", help="keep a cProfile of each metric")
    asked = parser.parse_args(given)
    baseline = json.loads(BASELINE.read_text(encoding="utf-8"))["metrics"] if BASELINE.exists() else {}
    if asked.gate and not baseline:
        print(f"{BASELINE}: there is no baseline to hold against; --update writes one.", file=sys.stderr)
        return 1
    if asked.profile is not None:
        asked.profile.mkdir(parents=True, exist_ok=True)
    load = os.getloadavg()[0]
    began = time.perf_counter()
    measured = measure(asked.profile)
    took = time.perf_counter() - began
    table = Table(
        "Performance, side by side on one core",
        ["metric", "ratio", "measured", "baseline", "better", "may be worse by", ""],
        f"Measured in {took:.0f} s, load of the machine at the start {load:.1f}.",
    )
    for name, value in measured.items():
        metric = METRICS[name]
        before = f"{baseline[name]['value']:.3g}" if name in baseline else ""
        table.add(name, metric.unit, f"{value:.3g}", before, metric.better, f"{100 * metric.tolerance:.0f} %",
                  metric.about)  # fmt: skip
    finish("suite", [table], {"load": load, "metrics": measured}, keep=asked.update)
    if asked.update:
        metrics = {name: {"value": float(f"{value:.4g}"), **asdict(METRICS[name])} for name, value in measured.items()}
        document = {"machine": machine(), "metrics": metrics}
        BASELINE.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        return 0
    worse = regressions(measured, baseline) if asked.gate else []
    for sentence in worse:
        print(sentence, file=sys.stderr)
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())
