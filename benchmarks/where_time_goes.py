# ruff: noqa: E402 - threads are limited before anything that counts them is imported
"""Where the time of a unit goes: each kernel against the least that its arithmetic and its memory traffic could take.

Host kernels (parse, segment, observe) work on a log of 50 000 rows, compiled ones on the observations of 40 poses and
39 turns of up to 150 samples, 32 units side by side as in the fit of a fleet. Operations of compiled kernels are
counted by XLA (`cost_analysis`, which counts a loop's body once and nothing inside LAPACK: loops are counted by their
length here), those of host kernels by hand; memory traffic is the least possible, every input read and every output
written once. The floor is the longer of operations over the measured speed of a matrix product and bytes over the
measured speed of a copy. No kernel here is a large matrix product: the distance to the floor is what scalar code,
latency and passing over arrays several times cost.
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

from jaximu.data.carried import carry, compress, matmul, moved, rotate_samples, transpose
from jaximu.fleets import FleetUnit, fit_units
from jaximu.fleets import lanes as fleet_lanes
from jaximu.fleets.fit import parameter_set
from jaximu.model.sensor import Imu
from jaximu.recordings import write_recording
from jaximu.recordings.readers import read_recording
from jaximu.recordings.segmentation import observed_poses, segment
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

jax.config.update("jax_enable_x64", True)
LANES, BLOCK = 32, 16  # units side by side, samples that slopes take together
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


def compiled(function, repetitions: int, length: int, *inputs) -> tuple[tuple[float, float, int], Any]:
    """Seconds a unit, operations and least bytes of a function of all units' arrays whose loops have a length."""
    made = jax.jit(function).lower(*inputs).compile()
    cost = made.cost_analysis()
    assert cost is not None
    seconds = least(lambda: jax.block_until_ready(made(*inputs)), repetitions) / LANES
    result = made(*inputs)
    return (seconds, length * float(cost["flops"]) / LANES, (size_of(inputs) + size_of(result)) // LANES), result


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
    seen = observed_poses(segment(recording), 9.80665)
    _, parameters = parameter_set(True)
    batch = jax.tree.map(lambda leaf: np.stack([leaf] * LANES), seen)
    z = np.zeros((len(parameters.index), LANES))
    lanes, at = fleet_lanes._seen(batch), fleet_lanes._triads(parameters, z)
    density = matmul(matmul(at.inverse_g, lanes.noise), transpose(at.inverse_g))

    def measured(name: str, function, length: int, *inputs):
        found[name], result = compiled(function, repetitions, length, *inputs)
        return result

    def prepared(interval, output):
        interval = interval.transpose(2, 1, 0)
        moments = [*(interval * output[..., i].transpose(2, 1, 0) for i in range(3)), interval]
        return moments, compress(moments, BLOCK)

    def sloped(inverse, offset, blocks, density):
        single = jax.tree.map(lambda leaf: leaf.astype(np.float32), (inverse, offset, blocks, density))
        return jax.tree.map(lambda leaf: leaf.astype(float), carry(*single, BLOCK))

    def passed(seen, carried, at, z, excess):
        return fleet_lanes._joint_pass(parameters, seen, carried, at, z, excess, 5.0)

    samples, blocks = measured("blocks of samples", prepared, 1, batch.turns.interval, batch.turns.output)
    steps, poses = len(samples[3]), lanes.pose.shape[0]
    measured("integrate turns sample by sample", rotate_samples, steps, at.inverse_g, at.offset_g, samples)
    carried = measured(f"integrate turns by blocks of {BLOCK}, with slopes", sloped, steps // BLOCK, at.inverse_g,
                       at.offset_g, blocks, density)  # fmt: skip
    measured("move rotations by their slopes", moved, 1, carried, at.inverse_g, at.offset_g)
    linear = measured("residual and Jacobian", partial(fleet_lanes._linearise, parameters), 1, lanes, at, carried)
    whitened = linear, lanes.covariance_a, carried.covariance, (lanes.pose, lanes.turn)
    measured("weights: block Cholesky, C⁻¹(J, r)", fleet_lanes._whiten, poses, *whitened)
    square = np.stack([np.eye(len(z)) + 0.1] * LANES)
    newton = partial(fleet_lanes._newton, tolerance=np.asarray(5.0))
    measured("step and covariance of the parameters", newton, 1, square, np.zeros((LANES, len(z))), z)
    measured("a whole pass without integration", passed, 1, lanes, carried, at, z, np.ones((3, LANES)))

    unit = FleetUnit(seen, jax.tree.map(np.asarray, Imu.nominal()), True)
    whole = least(lambda: fit_units([unit] * LANES), repetitions) / LANES

    table = Table(
        "Kernels of one unit, one core",
        ["kernel", "measured, µs", "operations", "bytes", "floor, µs", "bound by", "measured / floor"],
        f"Measured speeds: {peak / 1e9:.1f} · 10⁹ operations a second (matrix product of 768), "
        f"{bandwidth / 1e9:.1f} · 10⁹ bytes a second (copy of 128 MB). The whole fit of this unit in a batch takes "
        f"{1e6 * whole:.0f} µs: four to six passes, two with slopes of turns, one of these by samples as well. "
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
        {"load": load, "operations_per_second": peak, "bytes_per_second": bandwidth, "fit_seconds": whole,
         "kernels": figures}, keep=not small,
    )  # fmt: skip


if __name__ == "__main__":
    main()
