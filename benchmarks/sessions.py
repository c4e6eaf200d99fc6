"""Whether a unit's numbers scatter between its sessions as their stated uncertainty says, and what each session hides.

The eight units of the MIMU4444, four sessions each. Every session is calibrated by itself, without and with a
sensitivity of the gyroscope to specific force: one session hardly shows it, but what is the same in four sessions is no
accident of one. Then the four sessions of each unit are diagnosed together. Last, the same is simulated: three
sessions of twenty poses, biases set anew (30 mm/s², 0.17 °/s) before each, with nothing hidden and with a sensitivity
of the gyroscope to specific force that one session hardly shows.
"""

import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import numpy as np
from common import Table, arguments, finish, share
from real_diagnosis import MIMU4444, STOCKHOLM
from scipy.stats import chi2

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import hidden_effects as hidden

from jaximu import LocalGravity, calibrate, diagnose, read_recording
from jaximu.calibration import Calibration
from jaximu.estimation.problem import flatten, names_of

jax.config.update("jax_enable_x64", True)

MIMU = replace(MIMU4444, check=False)
EFFECT = "gyro.g_sensitivity"
KINDS = {
    "accelerometer's gain": ("accelerometer", "gain"),
    "accelerometer's bias": ("accelerometer", "bias"),
    "gyroscope's gain": ("gyroscope", "gain"),
    "gyroscope's bias": ("gyroscope", "bias"),
}
SENSITIVITY = "gyroscope", "coefficients"
TRIALS = 40
SIZES = (0.5,)
UNIT_SIZE = 10.0
"""Size of the simulated sensitivity at one, root of the sum of squares, in thousandths of °/s/g."""
COUNT = 1e3 * 9.80665 / 16.4
"""Thousandths of a degree per second and g in a count per m/s²."""


def numbers(found: Calibration, owner: str, part: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the estimates (p,) of one kind, and their covariance (p, p)."""
    values = dict(zip(names_of(found.imu), flatten(found.imu), strict=True))
    rows = [k for k, name in enumerate(found.names) if (name.owner, name.part) == (owner, part)]
    return np.array([values[found.names[row]] for row in rows]), found.covariance[np.ix_(rows, rows)]


def scatter(sessions: list[tuple[np.ndarray, np.ndarray]]) -> tuple[float, int, np.ndarray, np.ndarray, float]:
    """Return χ² about the common mean and its degrees of freedom, that mean (p,), its sigmas, and its χ² from zero."""
    weights = [np.linalg.inv(covariance) for _, covariance in sessions]
    covariance = np.linalg.inv(sum(weights))
    mean = covariance @ sum(weight @ value for weight, (value, _) in zip(weights, sessions, strict=True))
    about = sum((value - mean) @ weight @ (value - mean) for weight, (value, _) in zip(weights, sessions, strict=True))
    from_zero = mean @ np.linalg.solve(covariance, mean)
    return float(about), (len(sessions) - 1) * len(mean), mean, np.sqrt(np.diagonal(covariance)), float(from_zero)


def simulated(trials: int, figures: dict) -> Table:
    """Return what is said of simulated units, of one session and of three."""
    gravity, spread = LocalGravity(hidden.GRAVITY, 0.0), {"accel": 0.03, "gyro": 0.003}
    table = Table(
        "Simulated units: one session of twenty poses, and three of them together",
        ["hidden", "claim", "one session", "three sessions"],
        "95 % bounds in brackets.",
    )
    for size in (0.0, *SIZES):
        said: dict[str, list[tuple[bool, bool]]] = {"adequate": [], "named": [], "a wrong name": []}
        for seed in range(7000, 7000 + trials):
            case = hidden.draw_case(seed, (EFFECT,) if size else (), poses=20)
            case = case.with_size(size) if size else case
            with tempfile.TemporaryDirectory() as folder:
                made = [each.write(Path(folder) / f"{k}.parquet") for k, each in enumerate(case.powered_on(spread))]
                recordings = [read_recording(each) for each in made]
                found = [diagnose(recordings[0], gravity), diagnose(recordings, gravity)]
            named = [{each.name for each in one.effects} for one in found]
            said["adequate"].append(tuple(one.verdict == "adequate" for one in found))
            said["named"].append(tuple(each == {EFFECT} for each in named))
            said["a wrong name"].append(tuple(bool(each - {EFFECT}) for each in named))
        worst = f"{EFFECT}, {size * UNIT_SIZE:.2g} thousandths of °/s/g" if size else "nothing"
        for claim, hits in said.items():
            if claim != "named" or size:
                table.add(worst, claim, *(share(sum(each), trials) for each in zip(*hits, strict=True)))
        figures[f"simulated, {size}"] = {claim: np.sum(hits, axis=0).tolist() for claim, hits in said.items()}
    return table


def together(folder: Path, units: list[int], figures: dict) -> Table:
    """Return what a diagnosis of all sessions of a unit says."""
    table = Table(
        "Four sessions of a unit diagnosed together",
        ["unit", "verdict", "named", "χ² per condition, left out in turn", "log-likelihood", "depends on",
         "accelerometer's bias between sessions"],
        "Noise, drift within sessions and the change of the accelerometer's bias between them are estimated from the "
        "recordings. What belongs to one session, such as a step or a ramp, is asked in that session alone.",
    )  # fmt: skip
    for unit in units:
        paths = [folder / f"unit{unit}_session{session}.parquet" for session in range(1, 5)]
        found = diagnose([read_recording(path, options=MIMU) for path in paths], STOCKHOLM, repair=True)
        gain, shown = found.gain, ["", ""]
        if gain is not None:
            ratios = [each.chi_squared / each.count for each in (gain.before, gain.after)]
            shown = [f"{ratios[0]:.2f} → {ratios[1]:.2f}", f"{gain.log_likelihood:+.0f}"]
        (changes,) = [note for note in found.notes if "power is switched on" in note]
        table.add(unit, found.verdict, ", ".join(each.name for each in found.effects), *shown,
                  next((curve.covariate for curve in found.curves), ""),
                  changes.partition("about ")[2].partition(" (")[0])  # fmt: skip
        figures[f"unit {unit} together"] = {
            "verdict": found.verdict, "effects": [each.name for each in found.effects], "p_value": found.p_value,
        }  # fmt: skip
    return table


def main() -> None:
    """Calibrate all sessions and keep all tables."""
    options = arguments(__doc__)
    folder = Path(os.environ["JAXIMU_DATA"]) / "mimu4444"
    found: dict[tuple[int, int, bool], Calibration] = {}
    for unit in range(1, 3 if options.small else 9):
        for session in range(1, 5):
            recording = read_recording(folder / f"unit{unit}_session{session}.parquet", options=MIMU)
            for with_effect in (False, True):
                effects = (EFFECT,) if with_effect else ()
                found[unit, session, with_effect] = calibrate(recording, STOCKHOLM, effects=effects)
    units = sorted({unit for unit, _, _ in found})
    kinds = Table(
        "Scatter of a unit's numbers between its four sessions, over what is stated (χ² per degree of freedom)",
        ["kind", "numbers", "gain and bias fitted", "with the gyroscope's sensitivity to specific force", "by chance"],
        "By chance: 95 % of such values where numbers do not change and their uncertainty is right. Biases change when "
        "the power is switched on.",
    )
    figures: dict = {}
    for kind, which in KINDS.items():
        ratios = {}
        for with_effect in (False, True):
            each = [scatter([numbers(found[unit, s, with_effect], *which) for s in range(1, 5)])[:2] for unit in units]
            total, freedom = map(sum, zip(*each, strict=True))
            ratios[with_effect] = total / freedom
        low, high = (chi2.ppf(p, freedom) / freedom for p in (0.025, 0.975))
        kinds.add(kind, f"{freedom * 4 // 3}", *(f"{each:.2f}" for each in ratios.values()), f"{low:.2f} … {high:.2f}")
        figures[kind] = {"with effect" if k else "plain": value for k, value in ratios.items()}
    common = Table(
        "The gyroscope's sensitivity to specific force that four sessions of a unit have in common",
        ["unit", "largest, thousandths of °/s/g", "χ² from zero (9 numbers)", "by session (9 numbers each)",
         "scatter between sessions, χ² per degree of freedom"],
        "± is 95 %. χ² of 9 numbers that are zero is above 22 once in a hundred.",
    )  # fmt: skip
    for unit in units:
        sessions = [numbers(found[unit, s, True], *SENSITIVITY) for s in range(1, 5)]
        about, freedom, mean, sigma, from_zero = scatter(sessions)
        single = [float(value @ np.linalg.solve(covariance, value)) for value, covariance in sessions]
        row = int(np.argmax(np.abs(mean) / sigma))
        place = "xyz"[row // 3] + " by " + "xyz"[row % 3]
        common.add(unit, f"{COUNT * mean[row]:+.1f} ± {1.96 * COUNT * sigma[row]:.1f} ({place})", f"{from_zero:.0f}",
                   ", ".join(f"{each:.0f}" for each in single), f"{about / freedom:.2f}")  # fmt: skip
        figures[f"unit {unit}"] = {"mean": (COUNT * mean).tolist(), "sigma": (COUNT * sigma).tolist(),
                                   "chi2": from_zero, "by session": single, "scatter": about / freedom}  # fmt: skip
    joint = together(folder, units, figures)
    made = simulated(4 if options.small else TRIALS, figures)
    finish("sessions", [kinds, common, joint, made], figures, keep=not options.small)


if __name__ == "__main__":
    main()
