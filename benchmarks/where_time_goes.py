# ruff: noqa: E402 - threads are limited before anything that counts them is imported
"""Where the time of a unit goes: each kernel against the least that its arithmetic and its memory traffic could take.

Host kernels (parse, segment, observe) work on a log of 50 000 rows, compiled ones on the observations of 40 poses and
39 turns of up to 150 samples, sixteen units one after the other as in the fit of a fleet. Operations of compiled
kernels are counted by XLA (`cost_analysis`, which counts a loop's body once and nothing inside LAPACK: the loop over
units is counted by its length here, those over poses and samples are not), those of host kernels by hand; memory
traffic is the least possible, every input read and every output written once. The floor is the longer of operations
over the measured speed of a matrix product and bytes over the measured speed of a copy. No kernel here is a large
matrix product: the distance to the floor is what scalar code, latency and passing over arrays several times cost.
"""

import os

os.environ["JAX_PLATFORMS"] = "cpu"
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC", "PJRT_NPROC"):
    os.environ[name] = "1"

import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from common import Table, arguments, finish, least

from jaximu.data.poses import PosesAndTurns, condense
from jaximu.data.poses_covariance import condition_covariance, turned_by
from jaximu.estimation.covariance import update_excess
from jaximu.estimation.problem import TOLERANCE, Parameters, without_equipment
from jaximu.fleets import FleetUnit, fit_units
from jaximu.model.sensor import Imu
from jaximu.recordings import write_recording
from jaximu.recordings.readers import read_recording
from jaximu.recordings.segmentation import observed_poses, segment
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

jax.config.update("jax_enable_x64", True)
LANES = 16
SEGMENT_OPERATIONS, OBSERVE_OPERATIONS = 6 * 5, 6 * 4
"""A row: mean off, square, two running sums and a comparison of six channels; sums and block means of six channels."""


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


def compiled(function, repetitions: int, *inputs) -> tuple[tuple[float, float, int], Any]:
    """Seconds a unit, operations and least bytes of a function of one unit, of all units one after the other."""

    def batch(*inputs):
        return jax.lax.map(lambda unit: function(*unit), inputs)

    made = jax.jit(batch).lower(*inputs).compile()
    cost = made.cost_analysis()
    assert cost is not None
    seconds = least(lambda: jax.block_until_ready(made(*inputs)), repetitions) / LANES
    result = made(*inputs)
    return (seconds, float(cost["flops"]), (size_of(inputs) + size_of(result)) // LANES), result


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
    found["observe"] = least(lambda: observed_poses(poses, 9.80665), repetitions), rows * OBSERVE_OPERATIONS, arrays

    recording, _ = simulate(draw_imu(1), HandHeld(40, 1.5), consumer_noise(), seed=1)
    seen = PosesAndTurns.of(observed_poses(segment(recording), 9.80665))
    imu = jax.tree.map(np.asarray, Imu.nominal())
    parameters = Parameters.select(imu, without_equipment)
    batch = jax.tree.map(lambda leaf: np.stack([leaf] * LANES), seen)
    z, excess = np.zeros((LANES, len(parameters.index))), np.ones((LANES, 3))

    def measured(name: str, function, *inputs):
        found[name], result = compiled(function, repetitions, *inputs)
        return result

    def whitened(weights, conditions, z):
        def twice(z):
            value = weights.whiten(conditions(parameters.model(imu, z)))
            return value, value

        return jax.jacfwd(twice, has_aux=True)(z)

    def improved(covariance, weights, residual, jacobian, excess):
        information = jacobian.T @ jacobian + np.eye(z.shape[1]) / TOLERANCE**2
        return update_excess([covariance], [weights], residual, jacobian, information, excess)

    whole = measured("integrate turns, with their reactions", partial(turned_by, imu.gyroscope), batch.turns)
    measured("condense turns", lambda data: condense(imu, data)[:2], batch)
    conditions, _ = jax.jit(jax.vmap(lambda data: condense(imu, data)[:2]))(batch)
    covariance = measured("covariance", partial(condition_covariance, imu), batch, whole)
    weights = measured("weights: Cholesky along the chain", lambda one, size: one.weights(size), covariance, excess)
    jacobian, residual = measured("whitened residual and Jacobian", whitened, weights, conditions, z)
    measured("improve the excess", improved, covariance, weights, residual, jacobian, excess)

    unit = FleetUnit(seen, imu, True)
    fitting = least(lambda: fit_units([unit] * LANES), repetitions) / LANES

    table = Table(
        "Kernels of one unit, one core",
        ["kernel", "measured, µs", "operations", "bytes", "floor, µs", "bound by", "measured / floor"],
        f"Measured speeds: {peak / 1e9:.1f} · 10⁹ operations a second (matrix product of 768), "
        f"{bandwidth / 1e9:.1f} · 10⁹ bytes a second (copy of 128 MB). The whole fit of this unit in a batch takes "
        f"{1e6 * fitting:.0f} µs: four to six passes, each of which condenses turns anew. "
        f"Load of the machine at the start: {load:.1f}.",
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
        {"load": load, "operations_per_second": peak, "bytes_per_second": bandwidth, "fit_seconds": fitting,
         "kernels": figures}, keep=not small,
    )  # fmt: skip


if __name__ == "__main__":
    main()
