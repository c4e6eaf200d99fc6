"""The likelihood of a fleet's variance components where the fleet's own solver ended, and where `fit` does.

`--before TABLE`: of `jaximu fleet` on the first sessions of the measured board, by a version that had that solver
(c184cf3 is the last). The restricted likelihood is that of the conditions with gain and bias fitted at these
components.
"""

import argparse
import os
from pathlib import Path

import jax
import numpy as np
import pyarrow.parquet as pq
from common import Table, finish

from jaximu.calibration import nominal_imu
from jaximu.data.poses import PosesAndTurns, condense
from jaximu.estimation.fitting import Fit, fit
from jaximu.estimation.problem import TOLERANCE
from jaximu.recordings.readers import ReadOptions, read_recording
from jaximu.recordings.segmentation import observed_poses, segment

jax.config.update("jax_enable_x64", True)
OPTIONS = ReadOptions(accel_scale="2048 count/g", gyro_scale="16.4 count/(deg/s)")


def likelihood(data: PosesAndTurns, start: Fit, excess: np.ndarray) -> float:
    """Return the logarithm of the restricted likelihood, but for a constant."""
    found = fit(start.imu, data, excess=excess, estimate_excess=False)
    total = condense(found.imu, data)[1].dense().total(excess)
    information = found.jacobian.T @ found.jacobian + np.eye(len(found.names)) / TOLERANCE**2
    return -0.5 * float(np.linalg.slogdet(total)[1] + np.linalg.slogdet(information)[1]) - float(found.cost)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--before", type=Path, required=True, help="table of the version that is compared")
    before = {row["device"]: np.array(row["excess"]) for row in pq.read_table(parser.parse_args().before).to_pylist()}
    table = Table(
        "Excess of turns of eight measured units, and the likelihood there",
        ["unit", "the fleet's solver", "fit", "gain in log likelihood"],
        "Components of poses and of means at rest differ by less than 3 %, but are compared as they were.",
    )
    figures = {}
    for unit in range(1, 9):
        name = f"unit{unit}_session1"
        recording = read_recording(Path(os.environ["JAXIMU_DATA"]) / "mimu4444" / f"{name}.parquet", None, OPTIONS)
        data = PosesAndTurns.of(observed_poses(segment(recording), 9.80665))
        found = fit(nominal_imu(recording)[0], data)
        gain = likelihood(data, found, np.asarray(found.excess)) - likelihood(data, found, before[name])
        table.add(f"{unit}", f"{before[name][1]:.1f}", f"{found.excess[1]:.1f}", f"{gain:.3f}")
        figures[name] = {"before": before[name].tolist(), "now": np.asarray(found.excess).tolist(), "gain": gain}
    finish("excess", [table], figures)


if __name__ == "__main__":
    main()
