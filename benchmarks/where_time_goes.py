# ruff: noqa: E402 - threads are limited before anything that counts them is imported
"""Where the time of a unit goes: each kernel against the least that its arithmetic and its memory traffic could take.

Host kernels (parse, segment, observe) work on a log of 50 000 rows, compiled ones on the observations of 40 poses and
39 turns of 150 samples, sixteen units one after the other in one program as in the fit. Operations of compiled kernels
are counted by XLA (`cost_analysis`, which counts nothing inside LAPACK's factorisations), those of host kernels by
hand; memory traffic is the least possible, every input read and every output written once. The floor is the longer of
operations over the measured speed of a matrix product and bytes over the measured speed of a copy. No kernel here is a
matrix product: the distance to the floor is what scalar code, latency and passing over arrays several times cost.
"""

import os

os.environ["JAX_PLATFORMS"] = "cpu"
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC", "PJRT_NPROC"):
    os.environ[name] = "1"

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from common import Table, arguments, finish

from jaximu.calibration.fit import _joint_residual
from jaximu.fleet import Unit, fit_units
from jaximu.fleet.fit import parameter_set
from jaximu.formats import read_recording, write_recording
from jaximu.problem import Problem
from jaximu.protocols import HandHeld
from jaximu.residuals.carried import carry
from jaximu.segmentation import observe, segment
from jaximu.sensor import Imu
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.whitening import condition_covariance, inverse_cholesky, static_covariances

jax.config.update("jax_enable_x64", True)
LANES = 16
SEGMENT_OPERATIONS, OBSERVE_OPERATIONS = 6 * 5, 6 * 4
"""A row: mean off, square, two running sums and a comparison of six channels; sums and block means of six channels."""


def least(job: Callable[[], object], repetitions: int) -> float:
    job()
    times = []
    for _ in range(repetitions):
        began = time.process_time()
        job()
        times.append(time.process_time() - began)
    return min(times)


def speeds(repetitions: int) -> tuple[float, float]:
    """Operations a second of a matrix product, bytes a second of a copy that no cache holds."""
    size = 768
    a, b = np.random.default_rng(0).standard_normal((2, size, size))
    source, target = np.ones(2**24), np.empty(2**24)
    product = least(lambda: a @ b, repetitions)
    copy = least(lambda: np.copyto(target, source), repetitions)
    return 2 * size**3 / product, 2 * source.nbytes / copy


def size_of(tree) -> int:
    return sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(tree))


def compiled(function, inputs, repetitions: int) -> tuple[float, float, int]:
    """Seconds a unit, operations and least bytes of a function of one unit's arrays."""
    one = jax.jit(function).lower(inputs).compile()
    cost = one.cost_analysis()
    assert cost is not None
    operations = float(cost["flops"])
    many = jax.tree.map(lambda leaf: np.stack([np.asarray(leaf)] * LANES), inputs)
    mapped = jax.jit(lambda batch: jax.lax.map(function, batch))
    seconds = least(lambda: jax.block_until_ready(mapped(many)), repetitions) / LANES
    return seconds, operations, size_of(inputs) + size_of(one(inputs))


def main() -> None:
    small = arguments(__doc__).small
    repetitions = 3 if small else 9
    load = os.getloadavg()[0]
    peak, bandwidth = speeds(repetitions)
    found: dict[str, tuple[float, float, float]] = {}

    long_log, _ = simulate(draw_imu(0), HandHeld(40, 11.3), consumer_noise(), seed=0)
    arrays = sum(each.time.nbytes + each.values.nbytes for each in long_log.signals.values())
    rows = len(long_log.accelerometer)
    with tempfile.TemporaryDirectory() as folder:
        for name in ("parquet", "csv"):
            path = Path(folder) / f"log.{name}"
            write_recording(long_log, path)
            seconds = least(lambda path=path: read_recording(path), repetitions)
            found[f"parse {'Parquet' if name == 'parquet' else 'CSV'}"] = seconds, 0.0, path.stat().st_size + arrays
    poses = segment(long_log)
    found["segment"] = least(lambda: segment(long_log), repetitions), rows * SEGMENT_OPERATIONS, arrays
    found["observe"] = least(lambda: observe(poses, 9.80665), repetitions), rows * OBSERVE_OPERATIONS, arrays

    imu = draw_imu(1)
    recording, _ = simulate(imu, HandHeld(40, 1.5), consumer_noise(), seed=1)
    seen = observe(segment(recording), 9.80665)
    like, parameters = parameter_set(True)
    imu = jax.tree.map(np.asarray, imu)

    def turned(inputs):
        model, observations = inputs
        return carry(model.gyroscope, observations.turns)

    def weighted(inputs):
        model, observations = inputs
        measured, unit = static_covariances(observations)
        excess = jnp.zeros(3)
        return inverse_cholesky(condition_covariance(model, observations).total(excess)), inverse_cholesky(
            measured + excess[2] * unit
        )

    def step(inputs):
        z, data = inputs
        problem = Problem(like, parameters, data, _joint_residual)
        residual, jacobian = problem.residuals(z), jax.jacfwd(problem.residuals)(z)
        square = jacobian.T @ jacobian + jnp.eye(len(z)) / 25
        return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(square), jacobian.T @ residual + z / 25), square

    carried = jax.jit(turned)((imu, seen))
    moved = jax.tree_util.tree_map(np.asarray, type(seen)(seen.poses, carried, seen.gravity, None))
    weights, rest = jax.jit(weighted)((imu, moved))
    z = np.zeros(len(parameters.index))
    inputs = z, (moved, np.asarray(weights), np.asarray(rest))
    found["integrate turns, with derivatives"] = compiled(turned, (imu, seen), repetitions)
    found["covariance of the conditions, weights"] = compiled(weighted, (imu, moved), repetitions)
    found["solver step: residual, Jacobian, Cholesky"] = compiled(step, inputs, repetitions)
    square = np.asarray(jax.jit(step)(inputs)[1])
    found["covariance of the parameters"] = compiled(jnp.linalg.inv, square, repetitions)

    unit = Unit(seen, jax.tree.map(np.asarray, Imu.nominal()), True)
    whole = least(lambda: fit_units([unit] * LANES), repetitions) / LANES

    table = Table(
        "Kernels of one unit, one core",
        ["kernel", "measured, µs", "operations", "bytes", "floor, µs", "bound by", "measured / floor"],
        f"Measured speeds: {peak / 1e9:.1f} · 10⁹ operations a second (matrix product of 768), "
        f"{bandwidth / 1e9:.1f} · 10⁹ bytes a second (copy of 128 MB). The whole fit of this unit in a batch takes "
        f"{1e6 * whole:.0f} µs: integration and weights once a pass, several solver steps in each. Load of the machine "
        f"at the start: {load:.1f}.",
    )
    figures = {}
    for name, (seconds, operations, size) in found.items():
        by_arithmetic, by_memory = operations / peak, size / bandwidth
        floor = max(by_arithmetic, by_memory)
        bound = "arithmetic" if by_arithmetic > by_memory else "memory"
        table.add(name, f"{1e6 * seconds:.3g}", f"{operations:.3g}", f"{size:.3g}", f"{1e6 * floor:.3g}", bound,
                  f"{seconds / floor:.0f}")  # fmt: skip
        figures[name] = {"seconds": seconds, "operations": operations, "bytes": size, "floor_seconds": floor}
    finish(
        "where_time_goes", [table],
        {"load": load, "operations_per_second": peak, "bytes_per_second": bandwidth, "fit_seconds": whole,
         "kernels": figures}, keep=not small,
    )  # fmt: skip


if __name__ == "__main__":
    main()
