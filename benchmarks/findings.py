"""Which named findings good recordings have, where they should have none: simulated ones by kind, and measured ones.

First what the samples show, then what only a fit does: lost time, axes, ranges, saturation, scatter beyond the noise,
and refusals. What `jaximu diagnose` says of good recordings: `false_alarms.py`.

Poses by hand come from `tests/hidden_effects.py`, which shares nothing with the library; rests and tables from the
library's own simulation. Coarse steps are of 1/256 g and 1/14 °/s, as of chips of ten bits: there `data.quantisation`
is true, as is scatter beyond the white noise, of rounding, or where biases drift: neither is counted. Of good
recordings one in a hundred may have a finding by chance. `--measured`: what is found in measured recordings, beside
what is known of them.
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

from jaximu import NotPossibleError, read_recording
from jaximu.calibration.recipe import Choices, calibrate_ready
from jaximu.calibration.turntable import calibrate_turntable
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.mistakes import inspect, prepare
from jaximu.recordings.readers import ReadOptions
from jaximu.report.words import scatter_statements
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import DividingHead, Positions, RateTable, Static

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
    "at rest, 12.5 Hz, an hour": (12.5, Static(3600.0)),
    "at rest, 100 Hz, ten minutes": (100.0, Static(600.0)),
    "at rest, 400 Hz, a minute": (400.0, Static(60.0)),
}
TABLE = {
    "rate table, 100 Hz": (100.0, RateTable(rates=(45.0, 90.0))),
    "rate table, 25 Hz, one slow rate": (25.0, RateTable(rates=(10.0,))),
    "rate table, 100 Hz, slowly mounted": (100.0, RateTable(rates=(90.0,), mounting_duration=8.0)),
    "rate table, 200 Hz, three rates": (200.0, RateTable()),
    "six positions, 100 Hz": (100.0, Positions()),
    "24 positions of 2 s, 100 Hz, coarse steps": (100.0, Positions(24, 2.0)),
    "dividing head, 50 Hz": (50.0, DividingHead(duration=10.0)),
}
DRIFTING = {"it warms up", "B/N 2"}
POSED = ("imu_tk", "mikoff", "tomisuarez", "mimu4444", "psins/systematic")
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
KNOWN = {
    "imu_tk_xsens/xsens_acc.mat": (
        "data.spikes, data.saturation, data.range, scatter",
        "good but for four turns, in which x stops at 64485 counts and y at 65352; a knock at 285 s, 230 counts in one "
        "row after a rest; the scale stated is imu_tk's, the factory's is 0.76 of it",
    ),
    "mikoff_mpu9150/imu0.log": ("data.spikes, scatter", "good: knocks where it is put down (30 m/s² in one row)"),
    "mikoff_mpu9150/imu1.log": (
        "data.spikes, data.periodic, scatter",
        "good: knocks as in imu0; a line at 35.5 Hz in 38 of 41 rests of two seconds, gyroscope z",
    ),
    "mikoff_mpu9150/imu2.log": ("data.spikes, scatter", "good: knocks as in imu0"),
    "tomisuarez_mpu6050/example_data_calibration.csv": (
        "data.spikes, data.clipping, scatter",
        "a fault: 16 rows of the gyroscope are −32768, up to ten in a row",
    ),
    "imucal/annotated_session.csv": ("", "good"),
    "tofupilot_cooling/cooling_leg.tsv": ("", "good, after rows of its start-up"),
    "psins/mems.parquet": (
        "data.periodic",
        "good: a vehicle's engine, lines at 12.7, 24 and 48 Hz of 7 to 23 times the power",
    ),
    "psins/systematic_19_positions.parquet": (
        "data.stuck_axis, scatter",
        "simulated by others without noise: three rows in four repeat the one before, and nothing scatters",
    ),
    "euroc/MH03.imu.txt": ("data.periodic", "good: rotors, at 82 to 90 Hz in all its flight"),
    "euroc/V102.imu.txt": ("", "good"),
    "adis16405_static/run1.parquet": (
        "data.periodic",
        "good: a line that wanders, 19.9 to 20.5 Hz, 20 to 30 times the power",
    ),
    "adis16405_static/run2.parquet": ("data.periodic", "good: as run 1, 19.8 to 20.3 Hz"),
    "broad/02_undisturbed_slow_rotation_B.mat": (
        "data.spikes, data.periodic",
        "good: one knock at 115.2 s (4.5 m/s² in one row), a weak line at 22.3 Hz",
    ),
    "mpu6050_hmc5883l/full_sphere.parquet": (
        "data.bursts, data.spikes, data.clipping, data.bandwidth",
        "a fault: x stops at ±250.1 °/s; stamps of arrival, half of them 1.3 ms apart and a tenth 32 ms or more. From "
        "10 Hz on its noise falls, to 0.06 of its density at 20 to 30 Hz",
    ),
    "mpu6050_hmc5883l/unmoved_with_x_pointing_forward_10min.parquet": (
        "data.bursts, data.periodic",
        "good: stamps of arrival as in full_sphere; a line at 31.3 Hz, 23 times the power; noise is white",
    ),
    "px4/sample_log_small.ulg": ("data.gap", "a fault: 0.16 s are missing at the start"),
    "px4/sample_px4_events.ulg": ("", "good"),
    "mimu4444": (
        "data.spikes, data.clipping, data.periodic, scatter",
        "good up to the fast phase, where counts stop at ±32767; knocks where it is put down (7065 counts in one row, "
        "of 2048); lines of the gyroscopes' drives; drift in common",
    ),
}
"""Of each measured recording the findings that are true, and why: checked in its columns by NumPy alone."""
BOARD = {"accel_scale": "2048 count/g", "gyro_scale": "16.4 count/(deg/s)"}


def trial(task):
    """Return the findings of a recording that has no mistake: in its samples, and in its fit."""
    cell, seed, fits = task
    if cell in HAND:
        options = {key: value for key, value in HAND[cell].items() if key != "coarse"}
        case = hidden.draw_case(seed, (), **{"temperature": False, "static_minutes": 1, **options})
        with tempfile.TemporaryDirectory() as folder:
            recording = read_recording(case.write(Path(folder), ("fit",))["fit"])
    else:
        rate, protocol = (REST | TABLE)[cell]
        recording, _ = simulate(draw_imu(seed), protocol, consumer_noise(), rate=rate, seed=seed)
    true = {"scatter"} if cell in DRIFTING else set()
    if "coarse" in cell:
        steps = {name: replace(recording.signals[name], values=_stepped(recording, name)) for name in STEPS}
        recording, true = replace(recording, **steps), {"data.quantisation", "scatter"}
    samples = [(finding.name, finding.text) for finding in inspect(recording)]
    fitted = by_fit(recording, cell in TABLE) if fits else []
    return [[finding for finding in findings if finding[0] not in true] for findings in (samples, fitted)]


def by_fit(recording, on_table: bool = False) -> list[tuple[str, str]]:
    """Return what only a fit shows of a recording by hand, or on a table: names and texts."""
    try:
        if on_table:
            calibration, findings = calibrate_turntable(recording), []
        else:
            calibration, findings = calibrate_ready([prepare(recording).recording], Choices())
    except NotPossibleError as refusal:
        return [("refused", str(refusal))]
    scatter = [("scatter", statement.text) for statement in scatter_statements(calibration) if statement.caution]
    return [(finding.name, finding.text) for finding in findings] + scatter[:-1]  # the last explains the others


def _stepped(recording, name):
    step = STEPS[name] / np.median(recording.signals[name].nominal_scale)
    return step * np.round(recording.signals[name].values / step)


def measured(folder: Path) -> dict[str, list[list[tuple[str, str]]]]:
    """Return by file the findings of measured recordings and their texts, in the samples and in the fit."""
    board = {str(path.relative_to(folder)): BOARD for path in sorted((folder / "mimu4444").rglob("*.parquet"))}
    findings = {}
    for name, options in (MEASURED | board).items():
        logs = [folder / path for path in (name, options.get("gyro_log")) if path]
        stated = {key: value for key, value in options.items() if key != "gyro_log"}
        recording = read_recording(*logs, options=ReadOptions(**stated))
        samples = [(finding.name, finding.text) for finding in inspect(recording)]
        findings[name] = [samples, by_fit(recording) if name.startswith(POSED) else []]
    return findings


def shares(title: str, results: dict[str, list[list]]) -> tuple[Table, dict]:
    """Return the table of the findings (names and texts) of recordings by kind, and its counts."""
    table, figures = Table(title, ["recording", "with any finding", "findings"]), {}
    everything = [findings for of_kind in results.values() for findings in of_kind]
    for kind, of_kind in [*results.items(), ("all", everything)]:
        names = Counter(name for findings in of_kind for name in {name for name, _ in findings})
        any_of = sum(map(bool, of_kind))
        by_name = (f"{name} {share(count, len(of_kind))}" for name, count in names.items())
        table.add(kind, share(any_of, len(of_kind)), ", ".join(by_name))
        figures[kind] = {"recordings": len(of_kind), "any": any_of, **names}
    return table, figures


def of_measured(by_file: dict[str, list[list[tuple[str, str]]]]) -> Table:
    """Return what is found in measured recordings beside what is known of them, a board's counted together."""
    table = Table(
        "Findings in measured recordings",
        ["recording", "what is known of it", "in the samples", "in the fit", "found wrongly", "missed"],
        "What is known: checked in the columns of each file by NumPy alone.",
    )
    for known, (true, why) in KNOWN.items():
        of_each = [both for name, both in by_file.items() if name.startswith(known)]
        counters = [
            Counter(name for both in of_each for name in sorted({name for name, _ in both[part]})) for part in (0, 1)
        ]
        several = len(of_each) > 1
        texts = (", ".join(f"{name} {count}" if several else name for name, count in one.items()) for one in counters)
        names, expected = set(counters[0] | counters[1]), set(true.split(", ")) - {""}
        wrong, missed = (", ".join(sorted(some)) for some in (names - expected, expected - names))
        table.add(f"{known}, {len(of_each)} recordings" if several else known, why, *texts, wrong, missed)
    return table


def main() -> None:
    """Measure, and keep the tables."""
    options = arguments(__doc__, measured="measured recordings (needs JAXIMU_DATA), and nothing else")
    if options.measured:
        by_file = measured(Path(os.environ["JAXIMU_DATA"]))
        return finish("findings_measured", [of_measured(by_file)], {"measured": by_file}, script="findings")
    units, fits = (2, 2) if options.small else (40, 20)
    fitted = [*HAND, *TABLE]
    tasks = [(kind, seed, seed < fits and kind in fitted) for kind in (*fitted, *REST) for seed in range(units)]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        results = list(zip(tasks, pool.map(trial, tasks), strict=True))
    tables, figures = [], {}
    for part, (title, count) in enumerate((("samples", units), ("fits", fits))):
        by_kind = {}
        for (kind, _, with_fit), both in results:
            if part == 0 or with_fit:
                by_kind.setdefault(kind, []).append(both[part])
        table, figures[title] = shares(f"Findings in the {title} of good recordings, {count} of a kind", by_kind)
        tables.append(table)
    figures["texts"] = [[*task[:2], *map(list, [*both[0], *both[1]])] for task, both in results if any(both)]
    finish("findings", tables, figures, keep=not options.small)


if __name__ == "__main__":
    main()
