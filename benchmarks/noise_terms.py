"""Terms of the noise from simulated rests of six hours: how often intervals cover, and errors against slope reading.

400 units of three accelerometer and three gyroscope axes at 100 Hz (white noise 0.019 and 0.014, random walks 5e-4 and
5e-5, SI densities), made by NumPy alone; of a term that is not seen the limit counts as its interval. Slope reading is
what imu_utils and allan_variance_ros publish: on the overlapping Allan deviation of the same samples, in log–log, N at
1 s of a line of slope −1/2 through averaging times up to 10 s, K at 3 s of a line of slope +1/2 through those beyond
the lowest. Q, B and R are looked for in shorter records, three axes of half as many units, in which each rules a decade
of averaging times; and a K that hides beneath N and B.
"""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor

import jax
import numpy as np
from common import Table, arguments, finish
from scipy.stats import binom

from jaximu.model import BiasInstability, Noise, Quantisation, RandomWalk, RateRamp, White
from jaximu.noise import identify

jax.config.update("jax_enable_x64", True)

RATE, SAMPLES = 100.0, 2_160_000
TRIADS = {"accelerometer": (0.019, 5e-4), "gyroscope": (0.014, 5e-5)}
SHORT = 1 << 16
SCENES = {  # the term rules 0.01–0.19 s, 0.6–650 s and 27–330 s; a walk that hides beneath bias instability
    "Q": (White(0.002), Quantisation(5e-4)),
    "B": (White(0.002), BiasInstability(4e-3)),
    "R": (White(0.01), RateRamp(1e-4)),
    "K": (White(0.002), BiasInstability(2e-3), RandomWalk(2e-4)),
}


def read_slopes(tau, sigma):
    """N and K of straight lines drawn through the Allan deviation."""
    short, long = (tau >= 0.1) & (tau <= 10.0), np.arange(len(tau)) >= np.argmin(sigma)
    white = np.exp(np.mean(np.log(sigma[short]) + 0.5 * np.log(tau[short])))
    walk = np.exp(np.mean(np.log(sigma[long]) - 0.5 * np.log(tau[long] / 3)))
    return white, walk


def row(found, letter, true):
    """Value over truth and whether its interval holds it; where it is not seen, NaN and whether its limit does."""
    term = found.terms[letter]
    if term is None:
        return [np.nan, float(true <= found.limits[letter])]
    return [term.value / true, float(term.low <= true <= term.high)]


def unit(number):
    """Six axes of six hours: (6, 7) N and K with their coverage, the slopes' N and K, seconds."""
    rows = []
    for triad, (white, walk) in enumerate(TRIADS.values()):
        for axis in range(3):
            rng = np.random.default_rng([2024, number, triad, axis])
            values = np.cumsum(walk / np.sqrt(RATE) * rng.standard_normal(SAMPLES))
            values += white * np.sqrt(RATE) * rng.standard_normal(SAMPLES)
            began = time.perf_counter()
            found = identify(values, RATE)
            seconds = time.perf_counter() - began
            slopes = read_slopes(found.deviation.tau, found.deviation.value)
            rows.append(
                [*row(found, "N", white), *row(found, "K", walk), slopes[0] / white, slopes[1] / walk,
                 seconds]
            )  # fmt: skip
    return rows


def scene(task):
    """Three axes of a scene: (3, 4) the term and N, with their coverage."""
    letter, number = task
    processes = SCENES[letter]
    values = Noise(processes).sample(SHORT, RATE, seed=[7, number])
    rows = []
    for axis in values.T:
        found = identify(axis, RATE)
        rows.append([x for p in processes[::-1] for x in row(found, p.letter, float(getattr(p, p.letter)))])
    return rows


def main() -> None:
    small = arguments(__doc__).small
    units = 20 if small else 400
    began = time.perf_counter()
    workers = max(1, os.cpu_count() or 1)
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        scenes = {
            letter: np.concatenate(list(pool.map(scene, [(letter, i) for i in range(units // 2)], chunksize=5)))
            for letter in SCENES
        }
        long = np.stack(list(pool.map(unit, range(units), chunksize=1)))
    print(f"{time.perf_counter() - began:.0f} s")

    table = Table(
        f"Noise terms of {units} simulated units",
        ["data", "term", "axes", "95 % interval covers", "goal", "not supported", "median error", "slope reading",
         "ratio", "goal"],
    )  # fmt: skip
    figures = {"units": units, "seconds_per_axis": float(np.median(long[..., 6]))}

    def add(data, name, values, slopes=None, goal=""):
        value, inside = values.reshape(-1, 2).T
        error = float(np.median(np.abs(np.nan_to_num(value, nan=0.0) - 1)))  # not supported: an error of 100 %
        cells = ["", "", ""]
        low, high = binom.ppf([0.0005, 0.9995], len(inside), 0.95) / len(inside)
        entry = {
            "axes": len(inside), "coverage": float(inside.mean()), "nulls": int(np.isnan(value).sum()),
            "median_error": error, "coverage_bound_99.9": [float(low), float(high)],
        }  # fmt: skip
        if slopes is not None:
            other = float(np.median(np.abs(slopes - 1)))
            cells = [f"{100 * other:.3f} %", f"{error / other:.3f}", goal]
            entry |= {"slope_median_error": other, "ratio": error / other}
        figures[f"{data} {name}"] = entry
        table.add(data, name, len(inside), f"{100 * inside.mean():.2f} %", "93–97 %", int(np.isnan(value).sum()),
                  f"{100 * error:.3f} %", *cells)  # fmt: skip

    for name, columns, slope, goal in (("N", slice(0, 2), 4, "≤ 0.5"), ("K", slice(2, 4), 5, "≤ 0.7")):
        add("six hours, all axes", name, long[:, :, columns], long[:, :, slope], goal)
        add("accelerometer", name, long[:, :3, columns], long[:, :3, slope])
        add("gyroscope", name, long[:, 3:, columns], long[:, 3:, slope])
    for letter, rows in scenes.items():
        letters = [process.letter for process in SCENES[letter][::-1]]
        for place, each in enumerate(letters):
            add(f"{SHORT / RATE:.0f} s, {' and '.join(letters[::-1])}", each, rows[:, 2 * place : 2 * place + 2])
    bounds = figures["six hours, all axes K"]["coverage_bound_99.9"]
    table.note = (
        f"99.9 % binomial bound of a true coverage of 95 %, all axes: {100 * bounds[0]:.1f} to {100 * bounds[1]:.1f} "
        "%. A term that is not seen counts as an error of 100 %; its limit is then its interval. "
        f"{figures['seconds_per_axis']:.2f} s for an axis of 2.16 million samples, {workers} at a time."
    )
    finish("noise_terms", [table], figures, keep=not small)


if __name__ == "__main__":
    main()
