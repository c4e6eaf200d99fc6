# ruff: noqa: E402 - threads are limited before anything that counts them is imported
"""Speed of a fleet: fits side by side with scipy on one core, growth with the number of units, files to rows.

Units differ in poses, in noise and in how long they rest; one in a hundred has a pose that does not belong. scipy gets
the whitened two-step problem of `scipy_problem.py` with the weights already computed; the fleet's fit is whole
(joint maximum likelihood, weights, excess variances, covariances). Times of fits are of the processor,
which other work on the machine disturbs less than the clock.
"""

import os

os.environ["JAX_PLATFORMS"] = "cpu"
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[name] = "1"
os.environ["NPROC"] = os.environ["PJRT_NPROC"] = "1"

import resource
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pyarrow.parquet as pq
from common import Table, arguments, finish, least
from scipy.optimize import least_squares
from scipy_problem import check_jacobians, numpy_problems, scipy_fit, two_step_weights

from jaximu.calibration import nominal_imu
from jaximu.data.poses import PosesAndTurns
from jaximu.estimation.fitting import fit
from jaximu.estimation.problem import flatten, names_of, without_equipment
from jaximu.fleets import FleetUnit, Settings, find_jobs, fit_units, run_fleet
from jaximu.ground import stored
from jaximu.recordings import write_recording
from jaximu.recordings.segmentation import observed_poses, segment
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

jax.config.update("jax_enable_x64", True)


def units(count: int) -> list[FleetUnit]:
    found = []
    for seed in range(count):
        imu, poses = draw_imu(seed), 40 - seed % 5
        recording, _ = simulate(imu, HandHeld(poses, 1.5 + 0.25 * (seed % 4)), consumer_noise(), seed=seed)
        if seed % 100 == 50:  # somebody touched it
            values = recording.accelerometer.values.copy()
            values[len(values) // 2 : len(values) // 2 + 150] += 0.05
            recording = replace(recording, accelerometer=replace(recording.accelerometer, values=values))
        found.append(FleetUnit(observed_poses(segment(recording), 9.80665), nominal_imu(recording), True))
    return found


def spent() -> float:
    """Seconds of the processor that finished child processes took."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def end_to_end(files: int, workers: int, folder: Path) -> dict[str, float]:
    """Units a second from Parquet files of 51 000 rows to the table, start of the processes included and not."""
    jax.config.update("jax_compilation_cache_dir", str(folder / "cache"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    (folder / "logs").mkdir()
    (folder / "cache").mkdir()
    stored.cache(folder / "cache")
    for seed in range(8):
        recording, _ = simulate(draw_imu(seed), HandHeld(40, 11.3), consumer_noise(), seed=seed)
        write_recording(recording, folder / "logs" / f"{seed:04d}.parquet")
    rows = len(recording.accelerometer)
    tables = [pq.read_table(folder / "logs" / f"{seed:04d}.parquet") for seed in range(8)]
    for copy in range(8, files):  # a file of the same bytes would be refused as a copy
        marked = tables[copy % 8].replace_schema_metadata({"copy": str(copy)})
        pq.write_table(marked, folder / "logs" / f"{copy:04d}.parquet")
    jobs = find_jobs([folder / "logs"])
    few = jobs[: 128 * workers]  # enough for batches of the same size
    run_fleet(few, folder / "first.parquet", Settings(), workers=workers)  # compiles
    at_start = spent()
    run_fleet(few, folder / "second.parquet", Settings(), workers=workers)
    for_few = spent() - at_start
    at_start, seen = spent(), []
    began = time.perf_counter()
    statuses = run_fleet(
        jobs, folder / "t.parquet", Settings(), workers=workers,
        progress=lambda done, kept, _: seen.append((time.perf_counter() - began, done)),
    )  # fmt: skip
    whole = time.perf_counter() - began
    assert statuses == {"ok": files}, statuses
    (first, at_first), (last, at_last) = seen[1], seen[-1]
    stored.cache(None)
    processor = (spent() - at_start - for_few) / (files - len(few))
    return {"rows": rows, "files": files, "workers": workers, "whole": files / whole, "processor": processor,
            "steady": (at_last - at_first) / max(last - first, 1e-9)}  # fmt: skip


def agreement(made: list[FleetUnit]) -> float:
    """Largest step, in standard deviations, of the exact path from the fleet's answers."""
    worst = 0.0
    for unit, (fitted, _) in zip(made, fit_units(made), strict=True):
        seen = PosesAndTurns.of(jax.tree.map(lambda leaf: np.asarray(leaf)[None], unit.observations))
        exact = fit(fitted.imu, seen, without_equipment, excess=fitted.excess, estimate_excess=False, max_passes=1)
        step = exact.values - flatten(fitted.imu)[[names_of(fitted.imu).index(name) for name in exact.names]]
        worst = max(worst, float(np.abs(step / np.sqrt(np.diagonal(fitted.covariance))).max()))
    return worst


def against_scipy(made: list[FleetUnit], repetitions: int) -> dict[str, float]:
    problems = [
        numpy_problems(unit.observations, two_step_weights(fitted.imu, unit.observations, fitted.excess))
        for unit, (fitted, _) in zip(made, fit_units(made), strict=True)
    ]
    check_jacobians(*problems[0])
    options = {"method": "lm", "xtol": 1e-9, "ftol": 1e-9, "gtol": 1e-9, "x_scale": 1.0}

    def accelerometers():
        for problem, _ in problems:
            least_squares(problem.residual, np.zeros(9), problem.jacobian, **options)

    alone = [replace(unit, gyroscope=False) for unit in made]
    jobs = {
        "scipy, both triads": lambda: [scipy_fit(*problem) for problem in problems],
        "jaximu, both triads": lambda: fit_units(made),
        "scipy, accelerometer": accelerometers,
        "jaximu, accelerometer": lambda: fit_units(alone),
    }
    for job in jobs.values():
        job()
    times = {name: [] for name in jobs}
    for _ in range(repetitions):
        for name, job in jobs.items():  # interleaved, so that a busy moment hits all alike
            times[name].append(least(job, 1) / len(made))
    return {name: min(values) for name, values in times.items()}


def main() -> None:
    small = arguments(__doc__).small
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as scratch:  # JAX writes to it for as long as this process lives
        measure(small, load, end_to_end(300 if small else 1000, 2, Path(scratch)))


def measure(small: bool, load: float, rows: dict[str, float]) -> None:
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    made = units(16 if small else 256)
    worst = agreement(made[: 16 if small else 64])
    seconds = against_scipy(made, 2 if small else 3)

    one = [replace(unit, gyroscope=False) for unit in made]
    growth, memory = {}, {}
    fit_units(one[:8])  # compiles the program of a remainder
    for count in (100, 1000) if small else (100, 1000, 10_000):
        many = (one * (count // len(one) + 1))[:count]
        batches = [many[first : first + 1024] for first in range(0, count, 1024)]  # as a run takes them
        growth[count] = least(lambda batches=batches: [len(fit_units(each)) for each in batches], 1) / count
        memory[count] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    fits = Table(
        f"Fit of a unit (36 to 40 poses, turns of up to 150 samples), batch of {len(made)}, one core",
        ["", "ms of one core a unit", "scipy / jaximu", "goal"],
        f"The exact path's step from the fleet's answers: at most {worst:.1e} standard deviations (goal: "
        f"1e-3). scipy solves one weighted problem. Load of the machine at the start: {load:.1f}.",
    )
    goals = {
        "jaximu, both triads": "≤ 0.8 ms, ≥ 55 times",
        "jaximu, accelerometer": "≤ 0.012 ms",
    }
    for name, value in seconds.items():
        against = "accelerometer" if name.endswith("accelerometer") else "both triads"
        ratio = "" if name.startswith("scipy") else f"{seconds[f'scipy, {against}'] / value:.2f}"
        fits.add(name, f"{1e3 * value:.3f}", ratio, goals.get(name, ""))
    counts = Table("Growth, accelerometer alone", ["units", "ms a unit", "peak memory of the process [MB]"])
    for count, value in growth.items():
        counts.add(count, f"{1e3 * value:.3f}", f"{memory[count]:.0f}")
    files = Table(
        f"From Parquet to rows: {rows['files']} logs of {rows['rows']} samples, {rows['workers']} processes",
        ["", "units a second", "goal"],
    )
    files.add("whole run, start of the processes included", f"{rows['whole']:.1f}", "")
    files.add("by processor time of a unit, were both cores free", f"{rows['workers'] / rows['processor']:.1f}", "≥ 40")
    files.add("between the first and the last batch", f"{rows['steady']:.1f}", "≥ 40")
    figures = {
        "load": load, "seconds_per_unit": seconds, "exact_step_in_sigmas": worst, "end_to_end": rows,
        "growth_seconds_per_unit": growth, "growth_memory_megabytes": memory,
    }  # fmt: skip
    finish("fleet", [fits, counts, files], figures, keep=not small)


if __name__ == "__main__":
    main()
