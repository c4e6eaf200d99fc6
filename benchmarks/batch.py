# ruff: noqa: E402 - threads are limited before anything that counts them is imported
"""Batches of units by `jax.vmap` and `jax.lax.map`: three residuals with `solve`, and the whole `fit`.

Units have forty poses by hand and turns of up to 150 samples; the excess is estimated. On a CPU one core does all and
times are of the processor; on an accelerator they are by the clock, and batches are read there from 64 units again and
again. scipy gets the same residual and the same Jacobian, compiled. `--large 1000 10000`: large batches alone.
"""

import os

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC"):
    os.environ.setdefault(name, "1")

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from common import Table, finish
from scipy.optimize import least_squares
from scipy_problem import two_step_weights

import jaximu
from jaximu.data.gravity_norm import gravity_norm
from jaximu.data.poses import PosesAndTurns
from jaximu.estimation.problem import without_equipment
from jaximu.recordings.segmentation import observed_poses, segment
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from whitened_by_hand import gravity_direction, static_gyroscope

jax.config.update("jax_enable_x64", True)
NOMINAL = jax.tree.map(np.asarray, jaximu.Imu.nominal())
PARAMETERS = jaximu.Parameters.select(NOMINAL, without_equipment)


def options() -> argparse.Namespace:
    """Parse what is to be run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="few units; results are not kept")
    parser.add_argument("--large", type=int, nargs="+", default=[], help="numbers of units, of large batches alone")
    parser.add_argument("--name", default="batch", help="name of the results")
    parser.add_argument("--together", type=int, nargs="+", default=[32], help="units side by side, to try")
    return parser.parse_args()


def observed(count: int) -> list[PosesAndTurns]:
    """Return data of simulated units."""
    found = []
    for seed in range(count):
        recording, _ = simulate(draw_imu(seed), HandHeld(40, 1.5 + 0.25 * (seed % 4)), consumer_noise(), seed=seed)
        found.append(PosesAndTurns.of(observed_poses(segment(recording), 9.80665)))
    return found


def three_residuals(imu, known):
    """Return gravity's norm, its direction carried over turns, and the gyroscope at rest, whitened."""
    data, (norm, turned, rest) = known
    return jnp.concatenate([
        gravity_norm(imu, data, norm), gravity_direction(imu, data, None, turned), static_gyroscope(imu, data, rest)
    ])  # fmt: skip


def problem(known) -> jaximu.Problem:
    """Return the problem of the three residuals."""
    return jaximu.Problem(NOMINAL, PARAMETERS, known, three_residuals)


def solved(known):
    """Solve one unit's problem."""
    return jaximu.solve(problem(known), jnp.zeros(len(PARAMETERS.index))).z


def scipy_solved(unit, residual: Callable, jacobian: Callable) -> np.ndarray:
    """Solve one unit's problem with scipy."""
    settings = {"method": "lm", "xtol": 1e-9, "ftol": 1e-9, "gtol": 1e-9}
    return least_squares(
        lambda z: np.asarray(residual(z, unit)), np.zeros(len(PARAMETERS.index)),
        lambda z: np.asarray(jacobian(z, unit)), **settings,
    ).x  # fmt: skip


def fitted(data: PosesAndTurns):
    """Return what a user keeps of a fit."""
    found = jaximu.fit(NOMINAL, data)
    return found.values, found.covariance, found.excess, found.converged


def timed(job: Callable[[], object], repetitions: int = 3) -> tuple[float, float]:
    """Return the seconds of the first time, compilation included, and the least of those after it."""
    clock = time.process_time if jax.default_backend() == "cpu" else time.perf_counter
    times = []
    for _ in range(1 + repetitions):
        began = clock()
        jax.block_until_ready(job())
        times.append(clock() - began)
    print(f"{times[0]:.2f} s the first time, {min(times[1:]):.3f} s later", file=sys.stderr, flush=True)
    return times[0], min(times[1:])


def main() -> None:
    """Measure the rows."""
    asked, on_cpu = options(), jax.default_backend() == "cpu"
    if on_cpu and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    device = jax.local_devices()[0].device_kind
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        data = observed(8 if asked.small else 64)
        many = jaximu.stack(data)
        hosts = [jaximu.fit(NOMINAL, each) for each in data]
        weights = [two_step_weights(fit.imu, each, fit.excess)[:3] for fit, each in zip(hosts, data, strict=True)]
    known = (many, jax.tree.map(lambda *leaves: np.stack(leaves), *weights))
    count = len(data)
    single = [jax.tree.map(lambda leaf, unit=unit: leaf[unit], known) for unit in range(count)]
    everything = jax.device_put(known)

    rows, worst = {}, 0.0
    sizes = asked.large or ([count] if asked.small else [count, 1000])
    if not asked.large:
        residual = jax.jit(lambda z, unit: jnp.concatenate(problem(unit).objective(z)))
        jacobian = jax.jit(jax.jacfwd(lambda z, unit: jnp.concatenate(problem(unit).objective(z))))
        rows["three residuals, scipy, the same Jacobian", count] = timed(
            lambda: [scipy_solved(unit, residual, jacobian) for unit in single], 2
        )
        jobs = {"vmap(solve)": jax.jit(jax.vmap(solved)), "lax.map(solve)": jax.jit(partial(jax.lax.map, solved))}
        for name, job in jobs.items():
            rows[f"three residuals, {name}", count] = timed(partial(job, everything), 2)
        one = data[0]
        rows["fit on the host, one unit", 1] = timed(lambda: jaximu.fit(NOMINAL, one).values, 5)
        compiled, there = jax.jit(fitted), jax.device_put(one)
        rows["jit(fit), one unit", 1] = timed(lambda: compiled(there), 5)
        lifted = jax.tree.map(lambda leaf: np.stack([leaf] * count), NOMINAL)
        rows["fit on the host, a leading axis", count] = timed(lambda: jaximu.fit(lifted, many).values, 1)
    for together in asked.together:
        chunk = jax.jit(jax.vmap(lambda place: fitted(jax.tree.map(lambda leaf: leaf[place], everything[0]))))

        def run(number, chunk=chunk, together=together):
            """Fit so many units, those that are there again and again."""
            places = [np.arange(first, first + together) % count for first in range(0, number, together)]
            return [jax.tree.map(np.asarray, chunk(each)) for each in places]

        for number in sizes:
            rows[f"vmap(fit), {together} side by side", number] = timed(partial(run, number), 1)
        values, *_ = run(max(count, together))[0]
        off = [np.abs((values[k] - hosts[k % count].values) / hosts[k % count].sigmas()).max() for k in range(together)]
        worst = max(worst, float(np.max(off)))
    title = f"Batches of units with 40 poses on {'one core' if on_cpu else device}"
    table = Table(
        title, ["", "units", "ms a unit", "the first time, s"],
        f"Processor time of a core on a CPU, else by the clock. Largest difference from the fits on the host: "
        f"{worst:.1e} standard deviations. Load at the end: {os.getloadavg()[0]:.1f}.",
    )  # fmt: skip
    for (name, number), (first, later) in rows.items():
        table.add(name, number, f"{1e3 * later / number:.3g}", f"{first:.3g}")
    figures = {f"{name}, {number}": each for (name, number), each in rows.items()}
    finish(asked.name, [table], {"device": device, "seconds": figures, "worst": worst}, keep=not asked.small,
           script="batch")  # fmt: skip


if __name__ == "__main__":
    main()
