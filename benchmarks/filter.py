"""The Kalman filter beside the static joint fit: errors over stated uncertainty, NEES, coverage, gain and time.

`python benchmarks/filter.py [--small]`: nineteen positions, simulated; `--hour`: the time for one; `--online`: units
followed in use, simulated with drifting biases and, with `JAXIMU_DATA`, a measured board in its next session and an
Xsens; `--outside`: what a measured attitude, velocity and magnetic field add, simulated; `--psins`: the noise-free
recording of nineteen positions that PSINS simulated, against the errors PSINS gave it (needs `JAXIMU_DATA`).
"""

import os
import sys
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

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import compass  # noqa: E402
import tracker  # noqa: E402
from real_data import XSENS, XSENS_GRAVITY  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402
from scipy.stats import chi2  # noqa: E402

from jaximu import wgs84_gravity  # noqa: E402
from jaximu.calibration import FilterInUse, calibrate, calibrate_by_filter, compensate, followed_in_use  # noqa: E402
from jaximu.estimation.problem import flatten, names_of  # noqa: E402
from jaximu.ground.errors import NotPossibleError  # noqa: E402
from jaximu.ground.gravity import LocalGravity  # noqa: E402
from jaximu.model import Noise, White  # noqa: E402
from jaximu.model.effects.earth_rotation import EARTH_RATE  # noqa: E402
from jaximu.model.noise_model import AxisNoise, NoiseModel  # noqa: E402
from jaximu.recordings.readers import ReadOptions, read_recording  # noqa: E402
from jaximu.simulation import ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY, draw_imu, simulate  # noqa: E402
from jaximu.simulation.protocols import HandHeld  # noqa: E402

GRADES = {"consumer": 1.0, "tactical": 0.1, "navigation": 0.01}
"""White noise of each grade, in that of a consumer unit."""
GRAVITY = LocalGravity(9.80665, 1e-6)
DENSITIES = {"accelerometer": ACCELEROMETER_DENSITY, "gyroscope": GYROSCOPE_DENSITY}
HOUR_EFFECTS = ("accel.quadratic", "accel.cubic", "gyro.g_sensitivity", "setup.time_offset")
DRIFT, DRIFT_TIME, POWER_ON = {"accelerometer": 5e-3, "gyroscope": 5e-4}, 100.0, 0.02
"""Drift of the biases, m/s² and rad/s (one sigma), its correlation time, s, and how far power-on moves them."""

XSENS_RESTS = (182.0, 271.0)
"""Seconds at which imu_tk's Xsens rests and its recording is parted."""
LATITUDE, PSINS_GRAVITY = 34.0, LocalGravity(9.7964938, 1e-6)
"""Where PSINS simulated; gravity there by its g0 (1 + β sin²L − β1 sin²2L), β = 5m/2 − f − 17mf/14 of its `glvs`."""
PSINS_FLOOR = {"accelerometer": 5 * 9.8e-6, "gyroscope": np.radians(1e-3) / 60}
"""Noise taken for the noise-free unit: 5 µg/√Hz and 0.001 °/√h."""
_SECOND, _MICRO, _HOUR = np.radians(1 / 3600), 9.7803267714e-6, np.radians(1 / 3600)
PSINS_NUMBERS = {
    **{("accelerometer", "bias", (k,)): (f"accelerometer bias {'xyz'[k]}, µg", -10.0 * (k + 1), _MICRO)
       for k in range(3)},
    **{("gyroscope", "bias", (k,)): (f"gyroscope bias {'xyz'[k]}, °/h", -0.1 * (k + 1), _HOUR) for k in range(3)},
    **{(owner, "gain", (k, k)): (f"{owner} scale {'xyz'[k]}, ppm", -10.0 * (k + 1), 1e-6)
       for owner in ("accelerometer", "gyroscope") for k in range(3)},
    **{("accelerometer", "gain", axes): (f"accelerometer {'xyz'[axes[0]]}{'xyz'[axes[1]]}, ″", given, _SECOND)
       for axes, given in {(1, 0): 10.0, (2, 0): 20.0, (2, 1): 30.0}.items()},
    **{("gyroscope", "gain", axes): (f"gyroscope {'xyz'[axes[0]]}{'xyz'[axes[1]]}, ″", given, _SECOND)
       for axes, given in {(0, 1): 10.0, (0, 2): 20.0, (1, 0): 30.0, (1, 2): 40.0, (2, 0): 50.0, (2, 1): 60.0}.items()},
    **{("accelerometer", "accel.quadratic", (k,)): (f"quadratic {'xyz'[k]}, µg/g²", -10.0 * (k + 1), 1e-12 / _MICRO)
       for k in range(3)},
    **{("accelerometer", "accel.size_effect", (k,)): (f"inner arm {'xy'[k // 3]} from z, {'xyz'[k % 3]}, mm",
                                                      -10.0 * (k + 1), 1e-3) for k in range(6)},
    ("setup", "setup.time_offset", (0,)): ("time offset, ms", 1.0, 1e-3),
}  # fmt: skip
"""What `imuclbt` of PSINS puts in by default, by owner, part and axes: name, as it is in the outputs, unit in SI."""


def drawn_noise(share: float = 1.0) -> dict[str, Noise]:
    """Return a share of a consumer unit's white noise, to be drawn."""
    quantities = {"accelerometer": "specific_force", "gyroscope": "angular_rate"}
    return {name: Noise((White(share * density),), quantities[name]) for name, density in DENSITIES.items()}


def studied(seed: int, share: float) -> dict[str, np.ndarray | float] | None:
    """Return a unit's errors over their sigmas (p,), sigmas and NEES of both ways; the filter's NIS and seconds.

    None where the filter refuses.
    """
    found: dict[str, np.ndarray | float] = {}
    noise = NoiseModel(*(AxisNoise.of_white((share * each) ** 2) for each in DENSITIES.values()))
    imu = draw_imu(seed)
    protocol = HandHeld(poses=19, pose_duration=4.0, turn_duration=2.0)
    recording, _ = simulate(imu, protocol, drawn_noise(share), rate=50.0, seed=seed)
    truth = dict(zip(names_of(imu), flatten(imu), strict=True))
    began = time.process_time()
    try:
        by_filter, _ = calibrate_by_filter(recording, GRAVITY, static=noise)
    except NotPossibleError as error:
        return print(f"{seed}, {share}: {error}", flush=True)
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
    drawn = drawn_noise()
    white = NoiseModel(*(AxisNoise.of_white(density**2) for density in DENSITIES.values()))
    known = NoiseModel(*(
        AxisNoise(np.full(3, density**2), np.zeros(3), np.full((3, 1), DRIFT[name] ** 2), np.array([DRIFT_TIME]))
        for name, density in DENSITIES.items()))  # fmt: skip
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


def between(recording, start: float, stop: float):
    """Return a recording from `start` to `stop`, s after its first sample."""
    signals = {}
    for name in ("accelerometer", "gyroscope"):
        signal = getattr(recording, name)
        kept = (signal.time >= signal.time[0] + start) & (signal.time < signal.time[0] + stop)
        signals[name] = replace(signal, time=signal.time[kept], values=signal.values[kept])
    return replace(recording, **signals)


def board(folder: Path, unit: int):
    """Return two sessions of a unit of the board, and gravity there."""
    gravity = wgs84_gravity(59.35, 30.0)
    options = ReadOptions(accel_scale="2048 count/g", gyro_scale="16.4 count/(deg/s)", gravity=gravity)
    files = (folder / "mimu4444" / f"unit{unit}_session{session}.parquet" for session in (1, 2))
    return *(read_recording(each, None, options) for each in files), gravity


def xsens(folder: Path, middle: float):
    """Return imu_tk's Xsens before and after a time, s, at which it rests, and gravity there."""
    accelerometer, gyroscope = (folder / "imu_tk_xsens" / f"xsens_{each}.mat" for each in ("acc", "gyro"))
    whole = read_recording(accelerometer, gyroscope, XSENS)
    return between(whole, 0.0, middle), between(whole, middle, np.inf), XSENS_GRAVITY


def in_a_minute(first, second, gravity: LocalGravity) -> tuple[np.ndarray, float]:
    """Return a unit's biases (6,) after a minute of its second recording less the batch fit's, over σ; and NIS."""
    old, batch = (calibrate(each, gravity) for each in (first, second))
    after, history = followed_in_use(old, between(second, 0.0, 60.0), gravity=gravity)
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
        measured = Table(
            "Calibrated in one recording, followed through the first minute of the next",
            ["unit", "gyroscope bias less the batch fit's, over both σ", "accelerometer bias", "NIS"],
            "mimu4444: sessions 1 and 2, of another power-on. Xsens: its one recording, parted at a rest. The batch "
            "fit is of all of the second. Goal: within 1.96.",
        )  # fmt: skip
        folder = Path(os.environ["JAXIMU_DATA"])
        pairs = {f"mimu4444 {unit}": partial(board, folder, unit) for unit in range(1, 9)}
        pairs |= {f"Xsens, from {middle:.0f} s": partial(xsens, folder, middle) for middle in XSENS_RESTS}
        for name, read in list(pairs.items())[:: 8 if small else 1]:
            try:
                error, nis = in_a_minute(*read())
            except NotPossibleError as error:
                measured.add(name, f"refused: {str(error).partition(': ')[2]}", "", "")
                figures[name] = {"refused": str(error)}
                continue
            measured.add(name, *(", ".join(f"{each:.2f}" for each in error[part]) for part in
                                 (slice(3, 6), slice(0, 3))), nis)  # fmt: skip
            figures[name] = {"z": error.tolist(), "nis": nis}
        tables.append(measured)
    finish("filter_in_use", tables, figures, keep=not small, script="filter")


def averaged(recording, count: int):
    """Return a recording with each `count` samples replaced by their mean: increments of a longer interval."""
    signals = {}
    for name in ("accelerometer", "gyroscope"):
        signal = getattr(recording, name)
        kept = len(signal) // count * count
        time = signal.time[:kept].reshape(-1, count)[:, -1] - (count - 1) / 2 / signal.rate
        signals[name] = replace(signal, time=time, values=signal.values[:kept].reshape(-1, count, 3).mean(axis=1))
    return replace(recording, **signals)


def closing(corrected, offset: float, gravity: float, duration: float = 900.0) -> float:
    """Return the largest velocity, m/s, at rest of a strapdown that begins in the first rest and shares no code.

    The first attitude (3) and gravity's size are fitted: the recording holds neither.
    """
    time, force = corrected.gyroscope.time, corrected.accelerometer.values
    rate = np.stack([np.interp(time + offset, time, each) for each in corrected.gyroscope.values.T], axis=1)
    inside = (time > time[0] + 5.0) & (time < time[0] + 5.0 + duration)
    time, rate, force = time[inside], rate[inside], force[inside]
    step = float(np.median(np.diff(time)))
    turns = Rotation.from_rotvec(rate * step).as_matrix()
    attitude = np.empty_like(turns)  # at the middle of each interval, from the first body frame
    now = np.eye(3)
    for k, (turn, half) in enumerate(zip(turns, Rotation.from_rotvec(rate * step / 2).as_matrix(), strict=True)):
        attitude[k], now = now @ half, now @ turn
    felt = np.einsum("nij,nj->ni", attitude, force)
    earth = EARTH_RATE * np.array([0.0, np.cos(np.radians(LATITUDE)), np.sin(np.radians(LATITUDE))])
    ground = Rotation.from_rotvec(-earth * (np.arange(len(time)) + 0.5)[:, None] * step)
    still = np.linalg.norm(rate, axis=1) < 1e-3
    first = slice(0, 2000)
    seen = [felt[first].mean(axis=0) / gravity, rate[first].mean(axis=0) / EARTH_RATE]
    start, _ = Rotation.align_vectors([[0, 0, 1], earth / EARTH_RATE], seen)

    def velocity(change):
        level = ground.apply((Rotation.from_rotvec(change[:3]) * start).apply(felt))
        return np.cumsum(level - [0.0, 0.0, gravity + change[3]], axis=0) * step

    change = np.zeros(4)
    for _ in range(4):
        now = velocity(change)[still]
        slopes = [np.ravel(velocity(change + 1e-5 * row)[still] - now) / 1e-5 for row in np.eye(4)]
        change -= np.linalg.lstsq(np.stack(slopes, axis=1), np.ravel(now))[0]
    return float(np.linalg.norm(velocity(change)[still], axis=1).max())


def nineteen_positions(small: bool) -> None:
    """PSINS' recording: what the filter and the static joint fit make of it, against its truth."""
    path = Path(os.environ["JAXIMU_DATA"]) / "psins" / "systematic_19_positions.parquet"
    whole = read_recording(path, None, ReadOptions())
    recording = averaged(whole, 10 if small else 5)
    noise = NoiseModel(AxisNoise.of_white(PSINS_FLOOR["accelerometer"] ** 2),
                       AxisNoise.of_white(PSINS_FLOOR["gyroscope"] ** 2))  # fmt: skip
    effects = ("accel.size_effect", "accel.quadratic", "setup.time_offset")
    began = time.process_time()
    by_filter, _ = calibrate_by_filter(recording, PSINS_GRAVITY, latitude=LATITUDE, static=noise, effects=effects)
    seconds = time.process_time() - began
    joint = calibrate(recording, PSINS_GRAVITY, static=noise, effects=("accel.quadratic", "gyro.earth_rotation"))
    table = Table(
        "PSINS, nineteen positions without noise: errors given, as found, in PSINS' units",
        ["number", "given", "filter", "σ", "static joint fit", "σ"],
        "Given: minus the default constants of PSINS' `imuclbt`, to first order. `imuclbt` corrects outputs "
        "(f − db − Ka2 f² − fL(r) − tGA ω×f), and PSINS made this recording by correcting ideal outputs: every "
        "constant is in it with the opposite sign, inner lever arms too. Inner arms: of x and y from z's, their mean "
        "is open; PSINS holds z's at zero. Static: poses and turns, without inner arms and time offset. What the three "
        "scales of the accelerometer have in common cannot be told from gravity's size, taken by PSINS' formula.",
    )  # fmt: skip
    figures: dict = {"seconds": seconds, "nis": by_filter.filter["nis"], "open": by_filter.filter["open"]}
    values = {}
    for way, found in (("filter", by_filter), ("static", joint)):
        names, numbers = names_of(found.imu), flatten(found.imu)
        index = {name: place for place, name in enumerate(found.names)}
        all_effects = {each.name: at for at, each in found.imu.all_effects().items()}
        values[way] = {}

        def combined(weights, names=names, numbers=numbers, index=index, found=found):
            row = np.zeros(len(index))
            for name, weight in weights.items():
                if name in index:
                    row[index[name]] = weight
            value = sum(weight * numbers[names.index(name)] for name, weight in weights.items())
            return float(value), float(np.sqrt(row @ found.covariance @ row))

        for owner, part, axes in PSINS_NUMBERS:
            if part in {"bias", "gain"}:
                wanted = [name for name in names if (name.owner, name.part, name.effect) == (owner, part, None)
                          and name.axes == axes]  # fmt: skip
                values[way][owner, part, axes] = combined(dict.fromkeys(wanted, 1.0))
            elif part in all_effects:
                at = all_effects[part]
                places = {name.axes[0]: name for name in names if (name.owner, name.effect) == at}
                weights = {places[axes[0]]: 1.0}
                if part == "accel.size_effect":
                    weights[places[6 + axes[0] % 3]] = -1.0
                values[way][owner, part, axes] = combined(weights)
    worst = {way: 0.0 for way in values}
    for key, (label, given, unit) in PSINS_NUMBERS.items():
        cells = []
        for way in ("filter", "static"):
            value, sigma = values[way].get(key, (np.nan, np.nan))
            shown = (value - (key[1] == "gain" and key[2][0] == key[2][1])) / unit
            cells += [f"{shown:.3f}", f"{sigma / unit:.3f}"] if np.isfinite(value) else ["", ""]
            figures[f"{way} {label}"] = {"given": given, "found": shown, "sigma": sigma / unit}
        table.add(label, f"{given:g}", *cells)
    shared = [key for key in values["static"] if key in values["filter"]]
    apart = {key: abs(values["filter"][key][0] - values["static"][key][0]) for key in shared}
    worst = max(shared, key=lambda key: apart[key] / np.hypot(values["filter"][key][1], values["static"][key][1]))
    figures["apart"] = {PSINS_NUMBERS[key][0]: apart[key] / PSINS_NUMBERS[key][2] for key in shared}
    offset = values["filter"]["setup", "setup.time_offset", (0,)][0]
    end = closing(compensate(by_filter, whole), offset, PSINS_GRAVITY.value)
    raw = closing(whole, 0.0, PSINS_GRAVITY.value)
    figures |= {"closing": end, "closing_raw": raw, "worst": PSINS_NUMBERS[worst][0]}
    second = Table(
        "The whole recording", ["figure", "goal", "found"],
        "Both fits use means of the 100 Hz samples at 20 Hz. Velocity: of a "
        "strapdown at 100 Hz written for this table, "
        "with the first attitude and the size of gravity fitted to the same rests (four numbers), corrected or not.",
    )  # fmt: skip
    second.add("largest velocity at rest over 900 s, m/s (uncorrected)", "0.001", f"{end:.3g} ({raw:.3g})")
    second.add("filter and static fit furthest apart in σ", "", f"{PSINS_NUMBERS[worst][0]}: "
               f"{apart[worst] / np.hypot(values['filter'][worst][1], values['static'][worst][1]):.2f} σ")  # fmt: skip
    second.add("NIS (no noise: far below 1)", "", by_filter.filter["nis"])
    second.add("seconds of a core", "", seconds)
    finish("filter_psins", [table, second], figures, keep=not small, script="filter")


def from_outside(seed: int) -> dict[str, dict]:
    """Return a unit's errors over σ, σ, NEES and NIS, by what the filter is given beside it."""
    imu, noise = draw_imu(seed), NoiseModel(*(AxisNoise.of_white(each**2) for each in DENSITIES.values()))
    protocol = HandHeld(poses=12, pose_duration=2.5, turn_duration=2.0, displacement=1.0)
    recording, made = simulate(imu, protocol, drawn_noise(), rate=50.0, seed=seed)
    recording, known = compass.magnetic(recording, made, seed)
    attitude = tracker.tracked(recording, made, seed)
    moving = tracker.tracked(recording, made, seed, moving=True)
    truth = dict(zip(names_of(imu), flatten(imu), strict=True))
    found = {}
    for words, beside in {"nothing": {}, "magnetic field": {"magnetometer": known}, "attitude": {"attitude": attitude},
                          "attitude and velocity": {"attitude": moving}}.items():  # fmt: skip
        by_filter, _ = calibrate_by_filter(recording, GRAVITY, static=noise, **beside)
        values = dict(zip(names_of(by_filter.imu), flatten(by_filter.imu), strict=True))
        rows = [place for place, name in enumerate(by_filter.names) if name.effect is None]
        names = [by_filter.names[row] for row in rows]
        covariance = np.asarray(by_filter.covariance)[np.ix_(rows, rows)]
        sigma = np.sqrt(np.diagonal(covariance))
        z = np.array([values[name] - truth[name] for name in names]) / sigma
        found[words] = {
            "z": z, "sigma": sigma, "nis": by_filter.filter["nis"],
            "nees": float(z @ np.linalg.solve(covariance / np.outer(sigma, sigma), z)) / len(z),
            "kinds": [f"{name.owner} {name.part}" for name in names],
        }  # fmt: skip
    return found


def seen_from_outside(small: bool) -> None:
    """What is measured from outside adds to a filter: errors over stated uncertainty, and how much smaller that is."""
    units = 2 if small else 24
    kinds = ("accelerometer gain", "accelerometer bias", "gyroscope gain", "gyroscope bias")
    table = Table(
        f"Twelve positions of 2.5 s, turns of 2 s over a metre, 50 Hz, white noise alone: {units} simulated units",
        ["beside the unit", "rms error / stated σ", "95 % intervals cover", "NEES (95 % of such means)", "NIS",
         *(f"σ / σ with nothing: {each}" for each in kinds)],
        f"Tracker: 17 Hz, {1e3 * tracker.NOISE:g} mrad and {1e3 * tracker.SPEED_NOISE:g} mm/s of noise, late, askew, "
        f"tilted and beside the unit. Magnetometer: {compass.FIELD_NOISE:g} µT, each rest its own. σ: median.",
    )  # fmt: skip
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        drawn = list(pool.map(from_outside, range(units)))
    figures: dict = {"units": units}
    for words in drawn[0]:
        z, sigma, base = (np.array([each[of][name] for each in drawn])
                          for of, name in ((words, "z"), (words, "sigma"), ("nothing", "sigma")))  # fmt: skip
        low, high = (chi2.ppf(p, z.size) / z.size for p in (0.025, 0.975))
        own = np.array(drawn[0][words]["kinds"])
        smaller = {kind: float(np.median((sigma / base)[:, own == kind])) for kind in kinds}
        row = {"rms": float(np.sqrt(np.mean(z**2))), "coverage": float(np.mean(np.abs(z) < 1.96)),
               **{name: float(np.mean([each[words][name] for each in drawn])) for name in ("nees", "nis")}}  # fmt: skip
        figures[words] = row | {"smaller": smaller}
        table.add(words, row["rms"], f"{100 * row['coverage']:.1f} %", f"{row['nees']:.3f} ({low:.3f} to {high:.3f})",
                  row["nis"], *smaller.values())  # fmt: skip
    finish("filter_outside", [table], figures, keep=not small, script="filter")


def an_hour(small: bool) -> None:
    """How long the filter takes for an hour at 100 Hz, with effects until there are 40 states."""
    table = Table(
        "An hour at 100 Hz, warm", ["rests", "turns", "way", "states", "intervals", "s of a core"],
        "Goal: at most 20 s of a core with 40 states. Second calibration in one process: everything is compiled.",
    )  # fmt: skip
    figures: dict = {}
    imu, noise = draw_imu(0), NoiseModel(*(AxisNoise.of_white(each**2) for each in DENSITIES.values()))

    def timed(run):
        """What the second run returns, and the seconds of a core that it took."""
        run()
        began = time.process_time()
        return run(), time.process_time() - began

    for poses, rest in ((30, 118.0), (300, 10.0)):
        protocol = HandHeld(poses=3 if small else poses, pose_duration=rest, turn_duration=2.0)
        recording, _ = simulate(imu, protocol, drawn_noise(), rate=100.0, seed=0)
        _, seconds = timed(lambda log=recording: calibrate(log, GRAVITY, static=noise))
        table.add(f"{poses} of {rest:g} s", poses - 1, "poses and turns alone", "", "", seconds)
        figures[f"{poses} static"] = seconds
        for effects in ((), HOUR_EFFECTS):
            (found, history), seconds = timed(
                lambda log=recording, also=effects: calibrate_by_filter(log, GRAVITY, static=noise, effects=also)
            )
            vectors = sum(each in {"attitude", "velocity"} or " drift, " in each for each in found.filter["states"])
            states = len(found.filter["states"]) + 2 * vectors
            table.add(f"{poses} of {rest:g} s", poses - 1, "filter", states, len(history.time), seconds)
            figures[f"{poses} {states}"] = seconds
    finish("filter_hour", [table], figures, keep=not small, script="filter")


def main() -> None:
    asked = arguments(__doc__, hour="the time for an hour", online="units followed in use",
                      outside="what is measured from outside", psins="the recording that PSINS simulated")  # fmt: skip
    if asked.outside:
        return seen_from_outside(asked.small)
    if asked.hour:
        return an_hour(asked.small)
    if asked.psins:
        return nineteen_positions(asked.small)
    if asked.online:
        return in_use(asked.small)
    small = asked.small
    units = 2 if small else 200
    table = Table(
        f"Nineteen positions of 4 s, turns of 2 s, 50 Hz, white noise alone: {units} simulated units a grade",
        ["grade", "way", "rms error / stated σ", "95 % intervals cover", "NEES (95 % of such means)",
         "σ / σ of the static fit (median)", "refused", "NIS", "s a unit"],
        "Error over σ as stated: 1.0 is right. Goals: at most 1.05 (RMSE over the bound), 93–97 %, NEES 0.9–1.1.",
    )  # fmt: skip
    figures: dict = {"units": units}
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        for grade, share in GRADES.items():
            drawn = list(pool.map(partial(studied, share=share), range(units)))
            found = [each for each in drawn if each is not None]
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
                row["refused"] = len(drawn) - len(found) if way == "filter" else 0
                figures[f"{grade} {way}"] = row
                table.add(grade, way, row["rms"], f"{100 * row['coverage']:.1f} %",
                          f"{row['nees']:.3f} ({low:.3f} to {high:.3f})", row["sigma_ratio"],
                          row["refused"], *(row.get(name, "") for name in ("nis", "seconds")))  # fmt: skip
    finish("filter", [table], figures, keep=not small)


if __name__ == "__main__":
    main()
