"""The Kalman filter beside the static joint fit: errors over stated uncertainty, NEES, coverage, gain and time.

`python benchmarks/filter.py [--small]`: nineteen positions, simulated; `--online`: units followed in use,
simulated with drifting biases and, with `JAXIMU_DATA`, a measured board in its next session.
"""

import os
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from common import Table, arguments, finish  # noqa: E402
from scipy.stats import chi2  # noqa: E402

from jaximu import wgs84_gravity  # noqa: E402
from jaximu.calibration import FilterInUse, calibrate, calibrate_by_filter, followed_in_use  # noqa: E402
from jaximu.formats import ReadOptions, read_recording  # noqa: E402
from jaximu.gravity import LocalGravity  # noqa: E402
from jaximu.noise import Noise, White  # noqa: E402
from jaximu.noise.model import AxisNoise, NoiseModel  # noqa: E402
from jaximu.problem import flatten, names_of  # noqa: E402
from jaximu.protocols import HandHeld  # noqa: E402
from jaximu.simulation import ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY, draw_imu, simulate  # noqa: E402

GRADES = {"consumer": 1.0, "tactical": 0.1, "navigation": 0.01}
"""White noise of each grade, in that of a consumer unit."""
GRAVITY = LocalGravity(9.80665, 1e-6)
DRIFT, DRIFT_TIME, POWER_ON = {"accelerometer": 5e-3, "gyroscope": 5e-4}, 100.0, 0.02
"""Drift of the biases, m/s² and rad/s (one sigma), its correlation time, s, and how far power-on moves them."""


def studied(seed: int, share: float) -> dict[str, np.ndarray | float]:
    """Return a unit's errors over their sigmas (p,), sigmas and NEES of both ways; the filter's NIS and seconds."""
    found: dict[str, np.ndarray | float] = {}
    noise = NoiseModel(
        *(AxisNoise.of_white((share * each) ** 2) for each in (ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY))
    )
    drawn = {"accelerometer": Noise((White(share * ACCELEROMETER_DENSITY),), "specific_force"),
             "gyroscope": Noise((White(share * GYROSCOPE_DENSITY),), "angular_rate")}  # fmt: skip
    imu = draw_imu(seed)
    protocol = HandHeld(poses=19, pose_duration=4.0, turn_duration=2.0)
    recording, _ = simulate(imu, protocol, drawn, rate=50.0, seed=seed)
    truth = dict(zip(names_of(imu), flatten(imu), strict=True))
    began = time.process_time()
    by_filter, _ = calibrate_by_filter(recording, GRAVITY, static=noise)
    found["seconds"] = time.process_time() - began
    assert by_filter.filter is not None
    found["nis"] = by_filter.filter["nis"]
    for name, each in (("static", calibrate(recording, GRAVITY, static=noise)), ("filter", by_filter)):
        values = dict(zip(names_of(each.imu), flatten(each.imu), strict=True))
        rows = [place for place, known in enumerate(each.names) if known.effect is None]
        error = np.array([values[each.names[row]] - truth[each.names[row]] for row in rows])
        covariance = np.asarray(each.covariance)[np.ix_(rows, rows)]
        sigma = np.sqrt(np.diagonal(covariance))
        scaled = covariance / np.outer(sigma, sigma)
        z = error / sigma
        found |= {name: z, f"{name}_sigma": sigma, f"{name}_nees": float(z @ np.linalg.solve(scaled, z)) / len(z)}
    return found


def followed(seed: int) -> dict[str, np.ndarray | float]:
    """Return NEES and NIS of a unit followed in use, and errors (6,) of its biases at the end, followed and held."""
    densities = {"accelerometer": ACCELEROMETER_DENSITY, "gyroscope": GYROSCOPE_DENSITY}
    quantities = {"accelerometer": "specific_force", "gyroscope": "angular_rate"}
    drawn = {name: Noise((White(density),), quantities[name]) for name, density in densities.items()}
    white = NoiseModel(*(AxisNoise.of_white(density**2) for density in densities.values()))
    known = NoiseModel(*(
        AxisNoise(np.full(3, density**2), np.zeros(3), np.full((3, 1), DRIFT[name] ** 2), np.array([DRIFT_TIME]))
        for name, density in densities.items()))  # fmt: skip
    imu, protocol = draw_imu(seed), HandHeld(poses=16, pose_duration=3.0, turn_duration=1.5)
    old = calibrate(simulate(imu, protocol, drawn, rate=50.0, seed=seed)[0], GRAVITY, static=white)
    recording, _ = simulate(imu, protocol, drawn, rate=50.0, seed=10_000 + seed)
    random, changed, last = np.random.default_rng([seed, 1]), {}, {}
    for name in ("gyroscope", "accelerometer"):
        signal = getattr(recording, name)
        steps = random.standard_normal((len(signal), 3)) * DRIFT[name]
        kept = np.exp(-np.diff(signal.time, prepend=signal.time[0]) / DRIFT_TIME)
        path = np.empty_like(steps)
        value = steps[0]
        for place, share in enumerate(kept):
            value = share * value + np.sqrt(1 - share**2) * steps[place]
            path[place] = value
        path += POWER_ON * random.standard_normal(3)
        gain = np.asarray(getattr(imu, name).gain)
        changed[name], last[name] = replace(signal, values=signal.values + path @ gain.T), gain @ path[-1]
    follower = FilterInUse(old, known, recording.gyroscope.rate, GRAVITY)
    steps = follower.update(recording.gyroscope.time, changed["accelerometer"].values, changed["gyroscope"].values)
    states, names = follower.errors.states, follower.names
    spread = np.linalg.inv(follower.root)
    covariance = spread @ spread.T
    rows = [place for place, name in enumerate(names) if name.effect is None]
    chosen = np.zeros((len(rows), len(covariance)))
    error, held, biases = np.zeros(len(rows)), [], []
    truth = dict(zip(names_of(imu), flatten(imu), strict=True))
    stated = dict(zip(names_of(old.imu), flatten(old.imu), strict=True))
    for k, row in enumerate(rows):
        name = names[row]
        chosen[k, states + row] = 1.0
        error[k] = steps[-1].values[row] - truth[name]
        if name.part == "bias":
            gain, first = np.asarray(getattr(imu, name.owner).gain)[name.axes[0]], 3 * (name.owner == "accelerometer")
            for copy in range(6, states, 6):
                chosen[k, copy + first : copy + first + 3] = gain
            error[k] += gain @ steps[-1].drift[first : first + 3] - last[name.owner][name.axes[0]]
            held.append(stated[name] - truth[name] - last[name.owner][name.axes[0]])
            biases.append(k)
    part = chosen @ covariance @ chosen.T
    scale = np.sqrt(np.diagonal(part))
    z = error / scale
    freedom = sum(step.freedom for step in steps)
    return {"nees": float(z @ np.linalg.solve(part / np.outer(scale, scale), z)) / len(z), "numbers": len(z),
            "nis": sum(step.innovation for step in steps) / freedom, "freedom": freedom, "z": z[biases],
            "followed": error[biases], "held": np.array(held)}  # fmt: skip


def next_session(folder: Path, unit: int) -> tuple[np.ndarray, float]:
    """Return a unit's biases (6,) after a minute of its second session less the batch fit's, over σ; and NIS."""
    gravity = wgs84_gravity(59.35, 30.0)
    options = ReadOptions(accel_scale="2048 count/g", gyro_scale="16.4 count/(deg/s)", gravity=gravity)
    first, second = (read_recording(folder / f"unit{unit}_session{session}.parquet", None, options)
                     for session in (1, 2))  # fmt: skip
    old, batch = (calibrate(each, gravity) for each in (first, second))
    signals = {}
    for name in ("accelerometer", "gyroscope"):
        signal = getattr(second, name)
        kept = signal.time < signal.time[0] + 60.0
        signals[name] = replace(signal, time=signal.time[kept], values=signal.values[kept])
    after, history = followed_in_use(old, replace(second, **signals), gravity=gravity)
    values = [dict(zip(names_of(each.imu), flatten(each.imu), strict=True)) for each in (after, batch)]
    biases = [name for name in batch.names if name.part == "bias"]
    variance = sum(np.diagonal(each.covariance_of(biases)) for each in (after, batch))
    drift = np.concatenate([history.drift_sigma[-1, 3:], history.drift_sigma[-1, :3]])
    gains = np.concatenate([np.linalg.norm(np.asarray(each.gain), axis=1) for each in after.triads().values()])
    own = np.concatenate([history.drift[-1, 3:], history.drift[-1, :3]]) * gains
    error = np.array([values[0][name] - values[1][name] for name in biases]) + own
    return error / np.sqrt(variance + (drift * gains) ** 2), float(after.filter["nis"])


def in_use(small: bool) -> None:
    """Units followed in use."""
    units = 2 if small else 8
    found = [followed(seed) for seed in range(units)]
    table = Table(
        f"Followed in use through 16 rests of 3 s and turns between: {units} simulated consumer units, biases moved by "
        "0.02 m/s² and rad/s at power-on, drifting by 5 mm/s² and 0.5 mrad/s with τ = 100 s",
        ["NEES, all numbers (95 % of such means)", "NIS (95 %)", "rms bias error / σ",
         "gyroscope bias, mrad/s: followed", "held", "accelerometer bias, mm/s²: followed", "held"],
        "At the end of the recording. Goal: NEES and NIS 0.9–1.1. Held: the calibration's bias, of another power-on.",
    )  # fmt: skip
    nees, nis = np.mean([each["nees"] for each in found]), np.mean([each["nis"] for each in found])
    freedom = units * found[0]["numbers"], sum(each["freedom"] for each in found)
    low = [[chi2.ppf(p, each) / each for p in (0.025, 0.975)] for each in freedom]
    z = np.sqrt(np.mean(np.square([each["z"] for each in found])))
    rms = {way: np.sqrt(np.mean(np.square([each[way] for each in found]).reshape(units, 2, 3), axis=(0, 2)))
           for way in ("followed", "held")}  # fmt: skip
    table.add(f"{nees:.3f} ({low[0][0]:.3f} to {low[0][1]:.3f})", f"{nis:.3f} ({low[1][0]:.3f} to {low[1][1]:.3f})",
              float(z), *(float(1e3 * rms[way][k]) for k in (1, 0) for way in ("followed", "held")))  # fmt: skip
    figures = {"units": units, "nees": float(nees), "nis": float(nis), "z": float(z),
               **{way: each.tolist() for way, each in rms.items()}}  # fmt: skip
    tables = [table]
    if "JAXIMU_DATA" in os.environ:
        board = Table("mimu4444: calibrated in session 1, followed through the first minute of session 2",
                      ["unit", "gyroscope bias less the batch fit's, over both σ", "accelerometer bias", "NIS"],
                      "The batch fit is of all of session 2. Goal: within 1.96.")  # fmt: skip
        for unit in (1,) if small else (1, 4):
            error, nis = next_session(Path(os.environ["JAXIMU_DATA"]) / "mimu4444", unit)
            board.add(unit, *(", ".join(f"{each:.2f}" for each in error[part]) for part in (slice(3, 6), slice(0, 3))),
                      nis)  # fmt: skip
            figures[f"unit {unit}"] = {"z": error.tolist(), "nis": nis}
        tables.append(board)
    finish("filter_in_use", tables, figures, keep=not small, script="filter")


def main() -> None:
    asked = arguments(__doc__, online="units followed in use")
    if asked.online:
        return in_use(asked.small)
    small = asked.small
    units = 2 if small else 100
    table = Table(
        f"Nineteen positions of 4 s, turns of 2 s, 50 Hz, white noise alone: {units} simulated units a grade",
        ["grade", "way", "rms error / stated σ", "95 % intervals cover", "NEES (95 % of such means)",
         "σ / σ of the static fit (median)", "NIS", "s a unit"],
        "Error over σ as stated: 1.0 is right. Goals: at most 1.05 (RMSE over the bound), 93–97 %, NEES 0.9–1.1.",
    )  # fmt: skip
    figures: dict = {"units": units}
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        for grade, share in GRADES.items():
            found = list(pool.map(partial(studied, share=share), range(units)))
            for way in ("static", "filter"):
                z, own, base = (np.array([each[name] for each in found])
                                for name in (way, f"{way}_sigma", "static_sigma"))  # fmt: skip
                freedom = z.size
                low, high = (chi2.ppf(p, freedom) / freedom for p in (0.025, 0.975))
                row = {"rms": float(np.sqrt(np.mean(z**2))), "coverage": float(np.mean(np.abs(z) < 1.96)),
                       "nees": float(np.mean([each[f"{way}_nees"] for each in found])),
                       "sigma_ratio": float(np.median(own / base))}  # fmt: skip
                if way == "filter":
                    row |= {"nis": float(np.mean([each["nis"] for each in found])),
                            "seconds": float(np.median([each["seconds"] for each in found]))}  # fmt: skip
                figures[f"{grade} {way}"] = row
                table.add(grade, way, row["rms"], f"{100 * row['coverage']:.1f} %",
                          f"{row['nees']:.3f} ({low:.3f} to {high:.3f})", row["sigma_ratio"],
                          *(row.get(name, "") for name in ("nis", "seconds")))  # fmt: skip
    finish("filter", [table], figures, keep=not small)


if __name__ == "__main__":
    main()
