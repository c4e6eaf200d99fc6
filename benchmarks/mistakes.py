"""Everyday mistakes put into recordings: how often each is named, what else is named, and what is named without one.

`python benchmarks/mistakes.py [--small] [--parameters] [--turns]`. Simulated units at 50, 100 and 200 Hz by the outside
simulator of the tests, and with `JAXIMU_DATA` recordings measured by hand; the mistakes are those of
`tests/mistakes_generator.py`, which shares nothing with the checks. Named is what the samples alone show, or a fit of
them (`calibrate` tells both). `--parameters` also fits each repaired recording.

In a measured recording a mistake matters where the plain fit of poses and turns, with no check at all, moves a gain or
bias by three of the standard deviations that it has without the mistake, or its turns then scatter three times as much
as without it, or it cannot be fitted any more. What changes nothing (the shaking between the poses that no turn is made
of, say) is counted apart.
"""

import os
import sys
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import hidden_effects as hidden
import jax
import mistakes_generator as generator
import numpy as np
from common import Table, arguments, finish
from real_diagnosis import MIMU4444, MPU6050, MPU9150, XSENS
from scipy.stats import binomtest

from jaximu import LocalGravity, calibrate, read_recording
from jaximu.calibration.hand_held import fit_hand_held
from jaximu.calibration.nominal import nominal_imu
from jaximu.calibration.recipe import Choices, calibrate_ready
from jaximu.data import residual_rms
from jaximu.ground.errors import JaximuError
from jaximu.mistakes import inspect, prepare
from jaximu.recordings.finding import Finding
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.segmentation import observed_poses, segment

jax.config.update("jax_enable_x64", True)

MIMU = replace(MIMU4444, check=False)
RATES = 100.0, 50.0, 200.0
GRAVITY = LocalGravity(hidden.GRAVITY, 1e-6)
BEYOND = 3.5
"""Standard deviations from the truth within which a gain counts as right."""
IN_TURNS = ("lost_in_a_turn", "lost_1_percent", "lost_5_percent", "clipped", "soft_saturation", "wrap_around")
"""Mistakes that a fit shows in the turns; `--turns` keeps them as a table of their own."""
SEED = 47
"""Draws sizes and places; the thresholds of the checks were chosen on other draws (23 and 29)."""
ONE = np.eye(3)
MOVED = 3.0
"""Standard deviations of a number, and times the turns' scatter, from which on a mistake matters."""


def simulated(seed: int) -> tuple[Recording, hidden.Truth]:
    """Return a clean recording of 30 poses and its unit."""
    case = hidden.draw_case(seed, (), poses=30, rate=RATES[seed % len(RATES)])
    made = case.fit
    return Recording(Signal(made.time, made.accel, "m/s^2"), Signal(made.time, made.gyro, "rad/s")), case.truth


def measured(folder: Path) -> list[tuple[str, Recording]]:
    """Return recordings by hand, by name."""
    force, turn = (folder / f"imu_tk_xsens/xsens_{each}.mat" for each in ("acc", "gyro"))
    found = [("Xsens", read_recording(force, turn, XSENS))]
    found += [(f"MPU-9150 {unit}", read_recording(folder / f"mikoff_mpu9150/imu{unit}.log", options=MPU9150))
              for unit in range(3)]  # fmt: skip
    path = folder / "tomisuarez_mpu6050/example_data_calibration.csv"
    found.append(("MPU-6050", read_recording(path, options=MPU6050)))
    for unit, session in ((1, 1), (3, 2), (5, 3), (7, 4)):
        path = folder / f"mimu4444/unit{unit}_session{session}.parquet"
        found.append((f"MIMU4444 {unit}.{session}", read_recording(path, options=MIMU)))
    return found


def names(recording: Recording, expected: set[str] | None = None) -> set[str]:
    """Return the names of a recording's findings: of its samples, and unless these hold one expected, of their fit."""
    found = {finding.name for finding in inspect(recording)}
    return found if expected and found & expected else found | {each.name for each in of_the_fit(recording)}


def of_the_fit(recording: Recording) -> list[Finding]:
    """Return what a fit adds to the findings of the samples."""
    try:
        return calibrate_ready([prepare(recording).recording], Choices(GRAVITY))[1]
    except JaximuError:
        return []


def plain_fit(recording: Recording) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Return gains and biases, their standard deviations, and the turns' rms, °, of poses and turns as they are."""
    try:
        observations = observed_poses(segment(recording), GRAVITY.value)
        found = fit_hand_held(nominal_imu(recording), observations)
        turns = residual_rms(found.imu, observations)["gravity_direction"][0]
    except (JaximuError, KeyError, ValueError, ArithmeticError):
        return None
    if not bool(found.converged) or not bool(found.finite):
        return None
    return np.asarray(found.values), np.asarray(found.sigmas()), turns


def matters(before: tuple[np.ndarray, np.ndarray, float] | None, recording: Recording) -> bool:
    """Return whether a mistake moves what a plain fit finds; `before`: that of the recording without it."""
    after = plain_fit(recording)
    if before is None or after is None or len(before[0]) != len(after[0]):
        return True
    moved = np.max(np.abs(after[0] - before[0]) / np.maximum(before[1], 1e-12))
    return bool(moved >= MOVED or after[2] >= MOVED * before[2])


def rate(hits: int, count: int) -> str:
    """Return a rate with its 95 % Clopper–Pearson bounds, in percent."""
    if not count:
        return "–"
    low, high = binomtest(hits, count).proportion_ci()
    return f"{100 * hits / count:.0f} ({100 * low:.0f}–{100 * high:.0f})"


def recording_of(case: generator.Planted, name: str, folder: str) -> Recording:
    """Return the recording with the mistake; where only a file can hold it, as it is read."""
    if name not in generator.FILES:
        return case.log.to_recording()
    return read_recording(case.log.write(Path(folder) / f"{name}.csv"))


def within(found, truth: hidden.Truth, case: generator.Planted) -> bool:
    """Return whether all gains lie within so many standard deviations of the truth times what was put in."""
    off = []
    for name, gain in (("accelerometer", case.accel @ truth.accel_gain), ("gyroscope", case.gyro @ truth.gyro_gain)):
        sigma = found.sigma(name)[0]
        free = sigma > 0
        off.append(np.max(np.abs(np.asarray(found.triads()[name].gain) - gain)[free] / sigma[free]))
    return bool(max(off) < BEYOND)


def main() -> None:
    """Run the trials and keep the tables."""
    with tempfile.TemporaryDirectory() as scratch:
        run(scratch)


def run(scratch: str) -> None:
    """Run the trials; files are written to a folder."""
    options = arguments(__doc__, parameters="fit repaired recordings, too", turns="those alone that turns show")
    trials = 3 if options.small else 10
    folder = os.environ.get("JAXIMU_DATA")
    real = measured(Path(folder)) if folder else []
    own = {name: names(recording) for name, recording in real}
    plain = {name: plain_fit(generator.Log.of(recording).to_recording()) for name, recording in real}
    table = Table(
        "Everyday mistakes: how often each is named, in percent with 95 % bounds",
        [
            "mistake",
            "right names",
            "simulated",
            "measured, where it matters",
            "measured, where it changes nothing",
            "gains within 3.5 σ once repaired",
            "also named (trials)",
        ],
        "Also named: beyond what the recording without the mistake is told. It matters where it moves a gain or bias "
        "of the plain fit by 3 σ, or trebles its turns' scatter; in the MIMU4444 most of it falls into shaking by hand "
        "that no turn is made of.",
    )
    figures: dict = {}
    kinds = {**generator.MISTAKES, **generator.FILES, **generator.APART}
    for name in IN_TURNS if options.turns else kinds:
        plant = kinds[name]
        hits, others, right, fitted, refused = 0, Counter(), 0, 0, 0
        expected: tuple[str, ...] = ()
        for seed in range(trials):
            (clean, truth), (other, _) = simulated(seed), simulated(seed + 500)
            case = plant(generator.Log.of(clean, other), np.random.default_rng([seed, SEED]))
            expected = case.names
            recording = recording_of(case, name, scratch)
            found = names(recording, set(expected))
            hits += bool(found & set(expected))
            others.update(found - set(expected))
            mapped = not (np.array_equal(case.accel, ONE) and np.array_equal(case.gyro, ONE))
            if options.parameters and (
                np.linalg.det(case.accel) > 0 and np.array_equal(np.abs(case.accel), case.accel)
            ):
                if prepare(recording, repair=True).spoiling:
                    refused += 1
                    continue
                fitted += 1
                try:  # axes and ranges are a part of the gain as long as nothing is repaired
                    right += within(calibrate(recording, GRAVITY, repair=not mapped), truth, case)
                except JaximuError:
                    pass
        seen = count = idle_seen = idle = 0
        missed = []
        for place, (label, recording) in enumerate(real):
            another = real[(place + 4) % len(real)][1]  # neighbours shared a board
            case = plant(generator.Log.of(recording, another), np.random.default_rng([place, SEED]))
            changed = recording_of(case, name, scratch)
            found = names(changed, set(case.names))
            named = bool(found & set(case.names))
            if name in generator.FILES or matters(plain[label], changed):  # without order there is nothing to fit
                seen, count = seen + named, count + 1
                missed += [] if named else [label]
            else:
                idle_seen, idle = idle_seen + named, idle + 1
            others.update(found - set(case.names) - own[label])
        told = ", ".join(f"{each} {count}" for each, count in others.most_common(4))
        said = rate(right, fitted) if fitted else ("not repaired" if refused else "–")
        nothing = f"{idle_seen} of {idle}" if idle else "–"
        table.add(name, " or ".join(expected), rate(hits, trials), rate(seen, count), nothing, said, told)
        figures[name] = {"expected": expected, "named": hits, "trials": trials, "measured_named": seen,
                         "measured": count, "missed": missed, "idle": idle, "idle_named": idle_seen,
                         "others": dict(others), "within": right,
                         "fitted": fitted, "not_repaired": refused}  # fmt: skip
        print(name, hits, trials, seen, count, missed, nothing, said, told, flush=True)
    clean = Table("Nothing put in: recordings of which a mistake is told", ["recordings", "any", "one that spoils it"])
    count = 10 if options.small else 60
    any_told, spoiled = 0, 0
    for seed in range(1000, 1000 + count):
        recording = simulated(seed)[0]
        findings = [*inspect(recording), *of_the_fit(recording)]
        any_told += bool(findings)
        spoiled += any(finding.spoils for finding in findings)
    clean.add("simulated", rate(any_told, count) + f" of {count}", rate(spoiled, count))
    if real:
        wrong = [label for label, recording in real
                 if any(each.spoils for each in (*inspect(recording), *of_the_fit(recording)))]  # fmt: skip
        told = sum(bool(own[label] - {"data.spikes", "data.periodic"}) for label, _ in real)
        clean.add("measured, but for knocks and lines", rate(told, len(real)) + f" of {len(real)}",
                  rate(len(wrong), len(real)))  # fmt: skip
        clean.note = "; ".join(f"{label}: {', '.join(sorted(own[label]))}" for label, _ in real if own[label])
    total = sum(each["named"] for each in figures.values())
    runs = sum(each["trials"] for each in figures.values())
    clean.note += f" All mistakes together, simulated: {rate(total, runs)} % of {runs}."
    if real:
        total, runs = (sum(each[key] for each in figures.values()) for key in ("measured_named", "measured"))
        clean.note += f" Measured: {rate(total, runs)} % of {runs}."
    name = "mistakes_in_turns" if options.turns else "mistakes"
    figures = {"mistakes": figures, "clean": {"told": any_told, "spoiled": spoiled, "count": count}}
    finish(name, [table, clean], figures, not options.small)


if __name__ == "__main__":
    main()
