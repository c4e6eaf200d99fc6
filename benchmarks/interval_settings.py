"""Do the intervals of `calibrate` hold, whatever the setting: rate, poses, noise, sway of the hand, warming, six faces?

Units, motion and samples come from `tests/hidden_effects.py`, which shares nothing with the library, but for poses on
faces, which its own simulation draws. Gravity is exact; noise and drift are estimated from the recording. Errors are
those of gains, of biases as means over the recording, and as means over as long again after it; numbers that a
recording leaves open are left out. `--minutes` begins no round of units after so many.
"""

import argparse
import os
import time

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import jax
import numpy as np
from common import Table, finish
from intervals import bounds, in_sigmas
from scipy.signal import butter, sosfilt

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import hidden_effects as hidden

from jaximu import LocalGravity, NotPossibleError, Recording, Signal, calibrate
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.model.noise import Noise
from jaximu.model.processes import White
from jaximu.simulation import draw_imu, simulate
from jaximu.simulation.protocols import HandHeld
from jaximu.simulation.protocols.course import attitude_of

jax.config.update("jax_enable_x64", True)

GRAVITY = LocalGravity(STANDARD_GRAVITY, 0.0)
SETTINGS = {
    "100 Hz, 40 poses": {},
    "12.5 Hz": {"rate": 12.5},
    "25 Hz": {"rate": 25.0},
    "400 Hz, 20 poses": {"rate": 400.0, "poses": 20},
    "20 poses": {"poses": 20},
    "10 poses": {"poses": 10},
    "9 poses of 1.5 s": {"poses": 9, "pose_duration": 1.5},
    "80 poses of 2 s": {"poses": 80, "pose_duration": 2.0},
    "a first pose of a minute": {"first_pose_duration": 60.0},
    "axes move in turns": {"two_axes": True},
    "white noise alone": {"flicker": 0.0},
    "B/N 1": {"flicker": 3.6},
    "no steps, a tenth of the noise": {"noise": 0.1, "quantise": False},
    "stamps off by a fifth of an interval": {"jitter": 0.2},
    "a hand that sways by 2 mrad": {"sway": (2e-3, (0.2, 2.0))},
    "a hand that trembles by 1 mrad": {"sway": (1e-3, (6.0, 12.0))},
    "the unit warms by some 10 K": {"temperature": "linear", "hidden": ("accel.temperature", "gyro.temperature")},
}
FACES = {"six faces once": 1, "six faces twice": 2}
"""How often each face is up, in random order."""
DENSITY = {"specific_force": 1e-3, "angular_rate": 1.7e-4}
WHITE = {
    "accelerometer": Noise((White(DENSITY["specific_force"]),), "specific_force"),
    "gyroscope": Noise((White(DENSITY["angular_rate"]),), "angular_rate"),
}
TEMPERATURE_EFFECTS = 0.3
"""Size of the biases' dependence on temperature beside the plausible size."""
ROUNDS = 200


@dataclass(frozen=True)
class Faces(HandHeld):
    """Each face up `times` over, in random order and headings, each off by some degrees as a hand puts it."""

    times: int = 1

    def _attitudes(self, rng):
        up = np.tile(np.concatenate([np.eye(3), -np.eye(3)]), (self.times, 1))
        up = rng.permutation(up + 0.03 * rng.standard_normal(up.shape))
        return attitude_of(up, rng.uniform(-np.pi, np.pi, len(up)))


def swayed(case, size, band, rng):
    """Return what swaying by `size` (rad, rms) adds to both outputs: (n, 3) each, to first order in the angle."""
    made, rate, truth = case.fit, case.protocol.rate, case.truth
    angle = sosfilt(butter(2, band, "bandpass", fs=rate, output="sos"), rng.standard_normal(made.accel.shape), axis=0)
    angle *= size / np.std(angle)
    force = (made.accel - truth.accel_bias) @ np.linalg.inv(truth.accel_gain).T
    turn = (made.gyro - truth.gyro_bias) @ np.linalg.inv(truth.gyro_gain).T
    rate_added = np.gradient(angle, 1 / rate, axis=0) - np.cross(angle, turn)
    return -np.cross(angle, force) @ truth.accel_gain.T, rate_added @ truth.gyro_gain.T


def recorded(setting, seed):
    """Return a unit's recording, and by triad its gain and its biases as means over it and over as long again."""
    if setting in FACES:
        imu, protocol = draw_imu(seed), Faces(poses=6 * FACES[setting], times=FACES[setting])
        recording, _ = simulate(imu, protocol, WHITE, rate=100.0, seed=seed)
        bias = {name: np.asarray(triad.bias) for name, triad in imu.triads().items()}
        return recording, {name: np.asarray(triad.gain) for name, triad in imu.triads().items()}, bias, bias
    options, rng = dict(SETTINGS[setting]), np.random.default_rng([seed, 1])
    jitter, sway, effects = options.pop("jitter", 0.0), options.pop("sway", None), options.pop("hidden", ())
    case = hidden.draw_case(seed, effects, **options)
    if effects:
        case = case.with_size(TEMPERATURE_EFFECTS)
    made, added = case.fit, (0.0, 0.0) if sway is None else swayed(case, *sway, rng)
    stamps = made.time + jitter / case.protocol.rate * rng.uniform(-1, 1, len(made.time))
    recording = Recording(Signal(stamps, made.accel + added[0], "m/s^2"), Signal(stamps, made.gyro + added[1], "rad/s"))
    sensors = {"accelerometer": "accel", "gyroscope": "gyro"}
    gains = {name: getattr(case.truth, f"{sensor}_gain") for name, sensor in sensors.items()}
    during, after = (
        {name: getattr(case.truth, f"{sensor}_bias") + made.drift[sensor][when] for name, sensor in sensors.items()}
        for when in (0, 1)
    )
    return recording, gains, during, after


def trial(task):
    """Return the errors in stated sigmas by group of numbers, the share that is open, or why it was refused."""
    setting, seed = task
    recording, *truth = recorded(setting, seed)
    row = {"setting": setting, "seed": seed}
    try:
        calibration = calibrate(recording, GRAVITY)
    except NotPossibleError as error:
        return row | {"refused": str(error)}
    return row | {"errors": in_sigmas(calibration, *truth), "open": len(calibration.open_numbers)}


def main():
    """Run rounds of all settings, a process for each core, and keep the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="four rounds; results are not kept")
    parser.add_argument("--minutes", type=float, default=np.inf, help="begin no round after so many")
    options = parser.parse_args()
    settings, done, begun = [*SETTINGS, *FACES], [], time.monotonic()
    tasks = [(name, seed) for seed in range(4 if options.small else ROUNDS) for name in settings]
    with ProcessPoolExecutor(len(os.sched_getaffinity(0)), mp_context=get_context("spawn")) as pool:
        while tasks and time.monotonic() - begun < 60 * options.minutes:
            part, tasks = tasks[: len(settings)], tasks[len(settings) :]
            done += pool.map(trial, part)
    table = Table(
        "Intervals of `calibrate` by setting (goal: 93 to 97 % within the 99 % bounds)",
        ["recording", "units (refused)", "numbers", "rms of error / sigma", "95 % intervals that hold, 99 % bounds"],
        "Bounds by resampling units. Numbers that a recording leaves open are not counted. Flicker noise goes on for "
        "as long again as the recording took: a bias is its mean over the recording, and over the time after it. Where "
        "the unit warms, its bias is the one at the reference temperature, and the drift beside it.",
    )
    figures, rng = {}, np.random.default_rng(0)
    for setting in settings:
        units = [row for row in done if row["setting"] == setting]
        refused = sum("refused" in row for row in units)
        fitted = [row["errors"] for row in units if "errors" in row]
        for group in sorted({group for errors in fitted for group in errors}):
            rows = [errors[group] for errors in fitted if group in errors]
            rms, held, low, high = figures[f"{setting}, {group}"] = bounds(rows, rng)
            missed = "" if low <= 0.97 and high >= 0.93 else " (missed)"
            table.add(setting, f"{len(units)} ({refused})", group, f"{rms:.2f}",
                      f"{100 * held:.1f} % ({100 * low:.1f} … {100 * high:.1f}){missed}")  # fmt: skip
    finish("interval_settings", [table], figures, keep=not options.small)


if __name__ == "__main__":
    main()
