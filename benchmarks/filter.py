"""The Kalman filter beside the static joint fit: errors over stated uncertainty, coverage, gain and time."""

import time

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from common import Table, arguments, finish  # noqa: E402

from jaximu.calibration import calibrate, calibrate_by_filter  # noqa: E402
from jaximu.gravity import LocalGravity  # noqa: E402
from jaximu.noise import Noise, White  # noqa: E402
from jaximu.noise.model import AxisNoise, NoiseModel  # noqa: E402
from jaximu.problem import flatten, names_of  # noqa: E402
from jaximu.protocols import HandHeld  # noqa: E402
from jaximu.simulation import ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY, draw_imu, simulate  # noqa: E402

GRADES = {"consumer": 1.0, "tactical": 0.1}
"""White noise of each grade, in that of a consumer unit."""
GRAVITY = LocalGravity(9.80665, 1e-6)


def studied(share: float, units: int) -> dict[str, np.ndarray]:
    """Return errors over their sigmas (units, p), and sigmas, of both ways; and the filter's seconds of processor."""
    found: dict[str, list] = {
        name: [] for name in ("static", "filter", "static_sigma", "filter_sigma", "seconds", "nis")
    }
    noise = NoiseModel(
        *(AxisNoise.of_white((share * each) ** 2) for each in (ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY))
    )
    drawn = {"accelerometer": Noise((White(share * ACCELEROMETER_DENSITY),), "specific_force"),
             "gyroscope": Noise((White(share * GYROSCOPE_DENSITY),), "angular_rate")}  # fmt: skip
    for seed in range(units):
        imu = draw_imu(seed)
        protocol = HandHeld(poses=19, pose_duration=4.0, turn_duration=2.0)
        recording, _ = simulate(imu, protocol, drawn, rate=50.0, seed=seed)
        truth = dict(zip(names_of(imu), flatten(imu), strict=True))
        began = time.process_time()
        by_filter, _ = calibrate_by_filter(recording, GRAVITY, static=noise)
        found["seconds"].append(time.process_time() - began)
        assert by_filter.filter is not None
        found["nis"].append(by_filter.filter["nis"])
        for name, each in (("static", calibrate(recording, GRAVITY, static=noise)), ("filter", by_filter)):
            values = dict(zip(names_of(each.imu), flatten(each.imu), strict=True))
            sigma = np.sqrt(np.diagonal(each.covariance))
            rows = [place for place, known in enumerate(each.names) if known.effect is None]
            error = np.array([values[each.names[row]] - truth[each.names[row]] for row in rows])
            found[name].append(error / sigma[rows])
            found[f"{name}_sigma"].append(sigma[rows])
    return {name: np.array(each) for name, each in found.items()}


def main() -> None:
    small = arguments(__doc__).small
    units = 2 if small else 12
    table = Table(
        f"Nineteen positions of 4 s, turns of 2 s, 50 Hz, white noise alone: {units} simulated units a grade",
        [
            "grade",
            "way",
            "rms error / stated σ",
            "95 % intervals cover",
            "σ / σ of the static fit (median)",
            "NIS",
            "s a unit",
        ],
        "Error over σ as stated: 1.0 is right. Goals: at most 1.05 (RMSE over the bound), 93–97 %.",
    )
    figures: dict = {"units": units}
    for grade, share in GRADES.items():
        found = studied(share, units)
        for way in ("static", "filter"):
            z = found[way]
            ratio = float(np.median(found[f"{way}_sigma"] / found["static_sigma"]))
            row = {
                "rms": float(np.sqrt(np.mean(z**2))),
                "coverage": float(np.mean(np.abs(z) < 1.96)),
                "sigma_ratio": ratio,
            }
            if way == "filter":
                row |= {"nis": float(found["nis"].mean()), "seconds": float(np.median(found["seconds"]))}
            figures[f"{grade} {way}"] = row
            table.add(grade, way, row["rms"], f"{100 * row['coverage']:.1f} %", row["sigma_ratio"],
                      *(row.get(name, "") for name in ("nis", "seconds")))  # fmt: skip
    finish("filter", [table], figures, keep=not small)


if __name__ == "__main__":
    main()
