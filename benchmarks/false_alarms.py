"""How often a diagnosis finds something in recordings with nothing hidden, by noise, rate, poses and kind of turn.

The recordings come from `tests/hidden_effects.py`, which shares nothing with the library. Without a recording at rest
the noise and the drift are estimated from the recording itself. A round is a unit of each cell: `--minutes` ends after
one, `--more` goes on where the kept ones end, and a new cell catches up first.
"""

import argparse
import json
import os
import time

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import jax
import numpy as np
from common import RESULTS, Table, finish, share

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import hidden_effects as hidden

from jaximu import LocalGravity, calibrate, diagnose, read_recording
from jaximu.noise.at_rest import fit_noise

jax.config.update("jax_enable_x64", True)

GRAVITY = LocalGravity(hidden.GRAVITY, 0.0)
USUAL = 0.278
"""B over N, in 1/√s, of the generator's usual noise: 5 °/h with 0.005 °/s/√Hz."""
CELLS = {
    "B/N 0.1": {"flicker": 0.1 / USUAL},
    "B/N 0.28": {},
    "B/N 1": {"flicker": 1 / USUAL},
    "B/N 2": {"flicker": 2 / USUAL},
    "B/N 0.28, with a recording at rest": {"static": True},
    "B/N 1, with a recording at rest": {"static": True, "flicker": 1 / USUAL},
    "25 Hz": {"rate": 25.0},
    "25 Hz, axes move in turns": {"rate": 25.0, "two_axes": True},
    "100 Hz, axes move in turns": {"two_axes": True},
    "400 Hz": {"rate": 400.0, "pose_duration": 2.0},
    "20 poses": {"poses": 20},
    "80 poses of 2 s": {"poses": 80, "pose_duration": 2.0},
    "20 poses of 15 s": {"poses": 20, "pose_duration": 15.0},
    "12 poses of 30 s": {"poses": 12, "pose_duration": 30.0},
    "120 poses of 1 s": {"poses": 120, "pose_duration": 1.0},
    "tactical grade: a tenth of the noise": {"noise": 0.1, "quantise": False},
    "navigation grade: a thousandth": {"noise": 1e-3, "quantise": False},
    "two recordings together": {"together": True},
}


ROUNDS = 90


def trial(task):
    """Simulate, write, diagnose: what was said."""
    cell, seed = task
    options = dict(CELLS[cell])
    static, together = options.pop("static", False), options.pop("together", False)
    parts = ["fit"] + ["static"] * static + ["heldout"] * together
    with tempfile.TemporaryDirectory() as name:
        case = hidden.draw_case(seed, (), temperature=bool(seed % 2), static_minutes=30, **options)
        logs = {part: read_recording(file) for part, file in case.write(Path(name), tuple(parts)).items()}
        known = fit_noise(logs.pop("static")) if static else None
        recordings = list(logs.values())
        found, plain = diagnose(recordings, GRAVITY, static=known), calibrate(recordings, GRAVITY, static=known)
    inside = {}
    for name, calibration in (("calibrate", plain), ("diagnose", found.extended_calibration())):
        for triad, truth in (("accelerometer", case.truth.accel_bias), ("gyroscope", case.truth.gyro_bias)):
            error = np.abs(np.asarray(calibration.triads()[triad].bias) - truth)
            inside[f"{name} {triad}"] = int(np.sum(error < 1.96 * calibration.sigma(triad)[1]))
    return {
        "cell": cell, "seed": seed, "verdict": found.verdict, "named": [each.name for each in found.effects],
        "preflight": [each.name for each in found.preflight], "p_value": found.p_value, "inside": inside,
    }  # fmt: skip


def main():
    """Run rounds of all cells, a process for each core, and keep the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="four rounds; results are not kept")
    parser.add_argument("--more", action="store_true", help="go on where the kept trials end")
    parser.add_argument("--minutes", type=float, default=np.inf, help="begin no round after so many")
    options = parser.parse_args()
    kept = RESULTS / "false_alarms.json"
    done = json.loads(kept.read_text(encoding="utf-8"))["trials"] if options.more else []
    begun, most = time.monotonic(), 4 if options.small else ROUNDS
    rounds = {cell: sum(each["cell"] == cell for each in done) for cell in CELLS}
    tasks = sorted((number, place, cell) for place, cell in enumerate(CELLS, 1) for number in range(rounds[cell], most))
    with ProcessPoolExecutor(len(os.sched_getaffinity(0)), mp_context=get_context("spawn")) as pool:
        while tasks and time.monotonic() - begun < 60 * options.minutes:
            part, tasks = tasks[: len(CELLS)], tasks[len(CELLS) :]
            done += pool.map(trial, [(cell, 10_000 * place + number) for number, place, cell in part])
    table = Table(
        "Nothing hidden: how often something is found, and how often 95 % intervals of the biases hold the truth",
        ["recording", "false alarms, 95 % bounds", "trials", "named or unexplained", "said of the samples",
         "accelerometer's bias: calibrate, diagnose", "gyroscope's bias: calibrate, diagnose"],
        "Calibrate, diagnose: intervals of `jaximu calibrate` and of `jaximu diagnose`; both know the recording at "
        "rest where there is one, and else estimate the drift.",
    )  # fmt: skip
    for cell in [*CELLS, "all"]:
        results = [each for each in done if cell in (each["cell"], "all")]
        alarms = [each for each in results if each["verdict"] != "adequate"]
        named = sorted({name for each in alarms for name in each["named"] or ["unexplained"]})
        said = sorted({name for each in results for name in each["preflight"]})
        held = [
            ", ".join(f"{100 * sum(each['inside'][f'{verb} {triad}'] for each in results) / 3 / len(results):.0f} %"
                      for verb in ("calibrate", "diagnose"))
            for triad in ("accelerometer", "gyroscope")
        ]  # fmt: skip
        table.add(cell, share(len(alarms), len(results)), len(results), ", ".join(named), ", ".join(said), *held)
    finish("false_alarms", [table], {"trials": done}, keep=not options.small)


if __name__ == "__main__":
    main()
