"""The Kalman filter beside the static joint fit: errors over stated uncertainty, NEES, coverage, gain and time."""

import os
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from common import Table, arguments, finish  # noqa: E402
from scipy.stats import chi2  # noqa: E402

from jaximu.calibration import calibrate, calibrate_by_filter  # noqa: E402
from jaximu.gravity import LocalGravity  # noqa: E402
from jaximu.noise import Noise, White  # noqa: E402
from jaximu.noise.model import AxisNoise, NoiseModel  # noqa: E402
from jaximu.problem import flatten, names_of  # noqa: E402
from jaximu.protocols import HandHeld  # noqa: E402
from jaximu.simulation import ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY, draw_imu, simulate  # noqa: E402

GRADES = {"consumer": 1.0, "tactical": 0.1, "navigation": 0.01}
"""White noise of each grade, in that of a consumer unit."""
GRAVITY = LocalGravity(9.80665, 1e-6)


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


def main() -> None:
    small = arguments(__doc__).small
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
