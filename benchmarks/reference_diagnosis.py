"""Diagnosis against a measured attitude: nothing hidden, and effects hidden at multiples of the detection limit.

Unit, motion and tracker come from `tests/attitude_motion.py`, what is hidden from `tests/hidden_effects.py`; neither
shares a formula with the library. The limit is that of the same recording with nothing hidden. `--small` runs a tenth.
"""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import jax
import numpy as np
from common import Table, arguments, finish, share

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import attitude_motion
import hidden_effects

from jaximu import LocalGravity, Recording
from jaximu.diagnosis import diagnose_against_attitude
from jaximu.ground import stored
from jaximu.recordings.attitude import Attitude
from jaximu.recordings.recording import Signal

jax.config.update("jax_enable_x64", True)

GRAVITY = LocalGravity(attitude_motion.GRAVITY, 0.0)
SECONDS, TRACKED, TIMES = 30.0, 10.0, (2.0, 4.0)
SEEDS, EACH, OFFSETS = 24, 1, 12
"""Recordings with nothing hidden; trials of each effect and size, and of the time offset between the triads."""
OFFSET = "setup.time_offset"
HIDDEN = (
    "gyro.quadratic", "gyro.cubic", "gyro.asymmetry", "gyro.cross_coupling", "gyro.g_sensitivity",
    "gyro.g_squared_sensitivity", "gyro.lag", "gyro.bias_ramp", "gyro.step", "gyro.temperature",
    "gyro.scale_temperature", "accel.quadratic", "accel.cubic", "accel.asymmetry", "accel.cross_coupling",
    "accel.bias_ramp", "accel.step", "accel.temperature", "accel.scale_temperature",
)  # fmt: skip


def diagnosed(seed, hidden=()):
    """What a diagnosis of a unit says, and how late the reference truly is."""
    made = attitude_motion.move(seed, duration=SECONDS, tracked=TRACKED, hidden=hidden, warming=True)
    warm = Signal(made.time, made.temperature[:, None], "degC")
    recording = Recording(Signal(made.time, made.force, "m/s^2"), Signal(made.time, made.rate, "rad/s"), warm)
    attitude = Attitude(made.stamp - made.stamp[0], made.quaternion, made.velocity, start=float(made.stamp[0]))
    return diagnose_against_attitude(recording, attitude, GRAVITY), made.truth["delay"]


def trial(task):
    """Hide, diagnose: what was said. No name: nothing is hidden. size: norm of the effect's coefficients."""
    seed, name, size, cache = task
    begun = time.process_time()
    stored.cache(Path(cache))
    hidden, row = (), {"seed": seed, "hidden": name}
    if name:
        effect = hidden_effects.draw_effect(seed, name, hidden_effects.Protocol(seed, temperature=True))
        hidden = (replace(effect, scale=size / effect.size),)
    found, late = diagnosed(seed, hidden)
    row |= {"verdict": found.verdict, "named": [each.name for each in found.effects],
            "rivals": [list(each.rivals) for each in found.effects]}  # fmt: skip
    if name:  # the noise is estimated with what is hidden in it, and so is the limit
        row["over_its_limit"] = size / float(found.detection_limits.get(name, (np.inf, ""))[0])
    else:
        row["limits"] = {key: float(value) for key, (value, _) in found.detection_limits.items()}
    if name == OFFSET and row["named"] == [OFFSET]:
        (effect,) = found.named
        offset = found.extended_calibration().reference["time_offset"]
        row["offset"] = float((effect.effect.coefficients[0] - hidden[0].coefficients[0]) / effect.sigma[0])
        row["delay"] = (offset["value"] - late) / offset["sigma"]
    return row | {"seconds": time.process_time() - begun}


def main():
    """Diagnose units with nothing hidden, then with effects as large as these say; keep the table."""
    small = arguments(__doc__).small
    seeds, each, offsets = (3, 1, 1) if small else (SEEDS, EACH, OFFSETS)
    names = HIDDEN[::7] if small else HIDDEN
    with (
        tempfile.TemporaryDirectory() as cache,
        ProcessPoolExecutor(len(os.sched_getaffinity(0)), mp_context=get_context("spawn")) as pool,
    ):
        quiet = list(said(pool.map(trial, [(seed, None, 0.0, cache) for seed in range(1, seeds + 1)])))
        limits = {row["seed"]: row["limits"] for row in quiet}
        tasks, times = [], []
        for place, name in enumerate([*[name for name in names for _ in range(each)], *[OFFSET] * offsets]):
            seed = next(s for k in range(seeds) if name in limits[s := 1 + (place + k) % seeds])
            tasks += [(seed, name, size * limits[seed][name], cache) for size in TIMES]
            times += TIMES
        rows = said(pool.map(trial, tasks))
        found = [row | {"times": size} for row, size in zip(rows, times, strict=True)]
    alarms = [row for row in quiet if row["verdict"] != "adequate"]
    first = Table(
        "Diagnosis against a measured attitude: 30 s at 100 Hz, a tracker of 10 Hz, temperature going up and down",
        ["hidden", "trials of each size",
         *(f"{words}, {size:g} times" for size in TIMES
           for words in ("noticed", "named first", "first or a rival of the first")), "taken for"],
        "Hidden: so many times the detection limit that a diagnosis of the same recording with nothing hidden prints, "
        "in a random direction or on a single axis. Shares with 95 % bounds.",
    )  # fmt: skip
    first.add("nothing", len(quiet), share(len(alarms), len(quiet)), *[""] * (3 * len(TIMES) - 1),
              ", ".join(sorted({name for row in alarms for name in row["named"] or ["unexplained"]})))  # fmt: skip
    for title, chosen in (
        *((name, [name]) for name in (*names, OFFSET)), ("all of the gyroscope", of_sensor(names, "gyro")),
        ("all of the accelerometer", of_sensor(names, "accel")), ("all", [*names, OFFSET]),
    ):  # fmt: skip
        cells, own = [], [row for row in found if row["hidden"] in chosen]
        for size in TIMES:
            rows = [row for row in own if row["times"] == size]
            hits = [[row["verdict"] != "adequate" for row in rows], [named_first(row) for row in rows],
                    [row["hidden"] in [*row["named"][:1], *(row["rivals"] or [[]])[0]] for row in rows]]  # fmt: skip
            cells += [str(sum(each)) if len(rows) < 8 else share(sum(each), len(rows)) for each in hits]
        wrong = {row["named"][0] if row["named"] else row["verdict"] for row in own if not named_first(row)}
        first.add(title, len(own) // len(TIMES), *cells, ", ".join(sorted(wrong)) if len(chosen) == 1 else "")
    missed = [row["over_its_limit"] for row in found if row["verdict"] == "adequate"]
    if missed:
        first.note += (f" An effect that was not noticed is {max(missed):.2g} times the limit that its own diagnosis "
                       f"prints at the most, {float(np.median(missed)):.2g} times in the median.")  # fmt: skip
    second = Table(
        "The gyroscope stamped late against the accelerometer, hidden: its number, and the reference's delay",
        ["number", "trials that name it alone", "95 % intervals hold", "error over its σ, rms"],
    )
    for key, words in (("offset", OFFSET), ("delay", "the reference's delay, with it fitted")):
        errors = np.array([row[key] for row in found if key in row])
        if len(errors):
            second.add(words, len(errors), share(int(np.sum(np.abs(errors) < 1.96)), len(errors)),
                       float(np.sqrt(np.mean(errors**2))))  # fmt: skip
    finish("reference_diagnosis", [first, second], {"nothing": quiet, "hidden": found}, keep=not small)


def named_first(row):
    """Whether what was hidden is what was named first."""
    return row["named"][:1] == [row["hidden"]]


def of_sensor(names, sensor):
    """Effects of a sensor."""
    return [name for name in names if name.startswith(f"{sensor}.")]


def said(rows):
    """Yield each row, printed as it comes."""
    for row in rows:
        print({key: value for key, value in row.items() if key != "limits"}, flush=True)
        yield row


if __name__ == "__main__":
    main()
