"""Which named findings good recordings have, where they should have none: simulated ones by kind, and measured ones.

Poses by hand come from `tests/hidden_effects.py`, which shares nothing with the library; rests and rate tables from the
library's own simulation. Coarse steps are of 1/256 g and 1/14 °/s, as of chips of ten bits: there `data.quantisation`
is true, and not counted. What is found in measured recordings is listed, and may be true.
"""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
import tempfile
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import jax
import numpy as np
from common import Table, arguments, finish, share

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import hidden_effects as hidden

from jaximu import read_recording
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.mistakes import inspect
from jaximu.recordings.readers import ReadOptions
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import RateTable, Static

jax.config.update("jax_enable_x64", True)

STEPS = {"accelerometer": STANDARD_GRAVITY / 256, "gyroscope": np.radians(1 / 14)}
HAND = {
    "12.5 Hz": {"rate": 12.5},
    "25 Hz": {"rate": 25.0},
    "50 Hz": {"rate": 50.0},
    "100 Hz": {},
    "200 Hz": {"rate": 200.0},
    "400 Hz": {"rate": 400.0, "poses": 20},
    "1000 Hz": {"rate": 1000.0, "poses": 12},
    "100 Hz, coarse steps": {"coarse": True},
    "25 Hz, coarse steps": {"rate": 25.0, "coarse": True},
    "100 Hz, no steps, a tenth of the noise": {"noise": 0.1, "quantise": False},
    "9 poses of 1.5 s": {"poses": 9, "pose_duration": 1.5},
    "80 poses of 6 s": {"poses": 80, "pose_duration": 6.0},
    "slow turns": {"turn_duration": 4.0},
    "turns of 1.4 s": {"turn_duration": 1.4},
    "it warms up": {"temperature": True},
    "B/N 2": {"flicker": 7.2},
}
REST = {
    "at rest, 12.5 Hz, an hour": (12.5, 3600.0),
    "at rest, 100 Hz, ten minutes": (100.0, 600.0),
    "at rest, 400 Hz, a minute": (400.0, 60.0),
    "rate table, 100 Hz": (100.0, None),
}
MEASURED = {
    "imu_tk_xsens/xsens_acc.mat": {
        "gyro_log": "imu_tk_xsens/xsens_gyro.mat",
        "columns": "time [s],accel [count],gyro [count]",
        "accel_offset": "32768",
        "gyro_scale": "6258 count/(rad/s)",
    },
    "mikoff_mpu9150/imu0.log": {"columns": "accel [m/s^2],gyro [rad/s]", "rate": 100.0},
    "mikoff_mpu9150/imu1.log": {"columns": "accel [m/s^2],gyro [rad/s]", "rate": 100.0},
    "mikoff_mpu9150/imu2.log": {"columns": "accel [m/s^2],gyro [rad/s]", "rate": 100.0},
    "tomisuarez_mpu6050/example_data_calibration.csv": {
        "columns": "accel [count],gyro [count]",
        "rate": 100.0,
        "accel_scale": "16384 count/g",
        "gyro_scale": "131 count/(deg/s)",
    },
    "imucal/annotated_session.csv": {
        "columns": "_,_,accel [count],gyro [count]",
        "rate": 204.8,
        "gyro_scale": "16.4 count/(deg/s)",
    },
    "tofupilot_cooling/cooling_leg.tsv": {"columns": "time [us],gyro [rad/s],accel [m/s^2],_,temperature [degC]"},
    "psins/mems.parquet": {},
    "psins/systematic_19_positions.parquet": {},
    "euroc/MH03.imu.txt": {},
    "euroc/V102.imu.txt": {},
    "adis16405_static/run1.parquet": {},
    "adis16405_static/run2.parquet": {},
    "broad/02_undisturbed_slow_rotation_B.mat": {},
    "mpu6050_hmc5883l/full_sphere.parquet": {},
    "mpu6050_hmc5883l/unmoved_with_x_pointing_forward_10min.parquet": {},
    "px4/sample_log_small.ulg": {},
    "px4/sample_px4_events.ulg": {},
}
BOARD = {"accel_scale": "2048 count/g", "gyro_scale": "16.4 count/(deg/s)"}


def trial(task):
    """Return the findings of a recording that has no mistake."""
    cell, seed = task
    if cell in REST:
        rate, duration = REST[cell]
        protocol = RateTable(rates=(45.0, 90.0)) if duration is None else Static(duration)
        recording, _ = simulate(draw_imu(seed), protocol, consumer_noise(), rate=rate, seed=seed)
        return [(finding.name, finding.text) for finding in inspect(recording)]
    options = dict(HAND[cell])
    coarse = options.pop("coarse", False)
    case = hidden.draw_case(seed, (), **{"temperature": False, "static_minutes": 1, **options})
    with tempfile.TemporaryDirectory() as folder:
        recording = read_recording(case.write(Path(folder), ("fit",))["fit"])
    if coarse:
        steps = {name: replace(recording.signals[name], values=_stepped(recording, name)) for name in STEPS}
        recording = replace(recording, **steps)
    true = {"data.quantisation"} if coarse else set()
    return [(finding.name, finding.text) for finding in inspect(recording) if finding.name not in true]


def _stepped(recording, name):
    step = STEPS[name] / np.median(recording.signals[name].nominal_scale)
    return step * np.round(recording.signals[name].values / step)


def measured(folder: Path) -> dict[str, list[tuple[str, str]]]:
    """Return by file the findings of measured recordings and their texts."""
    board = {str(path.relative_to(folder)): BOARD for path in sorted((folder / "mimu4444").rglob("*.parquet"))}
    findings = {}
    for name, options in (MEASURED | board).items():
        logs = [folder / path for path in (name, options.get("gyro_log")) if path]
        stated = {key: value for key, value in options.items() if key != "gyro_log"}
        recording = read_recording(*logs, options=ReadOptions(**stated))
        findings[name] = [(finding.name, finding.text) for finding in inspect(recording)]
    return findings


def main() -> None:
    """Measure, and keep the tables."""
    options = arguments(__doc__)
    units = 2 if options.small else 40
    tasks = [(cell, seed) for cell in (*HAND, *REST) for seed in range(units)]
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        results = list(zip(tasks, pool.map(trial, tasks), strict=True))
    table = Table(f"Findings in good recordings, {units} of a kind", ["recording", "with any finding", "findings"])
    figures = {}
    for cell in (*HAND, *REST):
        of_cell = [findings for (name, _), findings in results if name == cell]
        names = Counter(name for findings in of_cell for name in {name for name, _ in findings})
        any_of = sum(bool(findings) for findings in of_cell)
        table.add(cell, share(any_of, len(of_cell)), ", ".join(f"{name} {count}" for name, count in names.items()))
        figures[cell] = {"recordings": len(of_cell), "any": any_of, **names}
    everything = [findings for _, findings in results]
    any_of = sum(map(bool, everything))
    table.add("all", share(any_of, len(everything)), "")
    figures["all"] = {"recordings": len(everything), "any": any_of}
    figures["texts"] = [[*task, *map(list, findings)] for task, findings in results if findings]
    tables = [table]
    if folder := os.environ.get("JAXIMU_DATA"):
        by_file = measured(Path(folder))
        listed = Table("Findings in measured recordings", ["recording", "findings"])
        board = Counter()
        for name, findings in by_file.items():
            names = list(dict.fromkeys(name for name, _ in findings))
            if name.startswith("mimu4444"):
                board.update(names)
            else:
                listed.add(name, ", ".join(names))
        listed.add("mimu4444, 32 recordings", ", ".join(f"{name} {count}" for name, count in board.items()))
        tables.append(listed)
        figures["measured"] = by_file
    finish("findings", tables, figures, keep=not options.small)


if __name__ == "__main__":
    main()
