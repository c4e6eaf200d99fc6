"""Calibration with equipment: imucal's session, simulated units for each scheme, nonlinearity, and batches of units."""

import csv
import json
import os
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import jax.numpy as jnp
import numpy as np
from common import Table, arguments, finish

from jaximu.calibration.calibration import Calibration
from jaximu.calibration.closed_form import ferraris, linear_least_squares, remove_curvature
from jaximu.calibration.turntable import calibrate_turntable, fit_turntable
from jaximu.data.observe_stations import observe_stations, scheme_stations
from jaximu.estimation.problem import Parameters, Problem, flatten
from jaximu.estimation.solver import solve
from jaximu.ground.gravity import LocalGravity
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.model import AxisNoise, NoiseModel
from jaximu.model.effects import CATALOGUE
from jaximu.model.sensor import Imu
from jaximu.recordings.readers import ReadOptions, read_recording, read_reference
from jaximu.simulation import ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY, consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import DividingHead, Ferraris, HandHeld, Positions, SingleAxisTable

jax.config.update("jax_enable_x64", True)

NOISE = NoiseModel(AxisNoise.of_white(ACCELEROMETER_DENSITY**2), AxisNoise.of_white(GYROSCOPE_DENSITY**2))


def stack(trees):
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *trees)


# --- imucal ---------------------------------------------------------------------------------------------------------


def imucal_session(folder: Path):
    """Reproduce `example_cal.json` by Ferraris' equations, and fit the same data by maximum likelihood."""
    path = folder / "imucal" / "annotated_session.csv"
    with open(path, encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = [f"{sensor}_{axis}" for sensor in ("acc", "gyr") for axis in "xyz"]
    parts = {}
    for row in rows:
        parts.setdefault(row["part"], []).append([float(row[name]) for name in names])
    parts = {name: np.array(values) for name, values in parts.items()}
    rate, gravity = 204.8, 9.81

    def means(kind):
        found = np.array([parts[f"{axis}_{kind}"].mean(axis=0) for axis in "xyz"])
        return found[:, :3], found[:, 3:]

    (up, rest_up), (down, rest_down) = means("p"), means("a")
    sums = np.array([parts[f"{axis}_rot"].sum(axis=0) for axis in "xyz"]) / rate
    still = np.concatenate([parts[f"{axis}_{kind}"] for axis in "xyz" for kind in "pa"])[:, 3:]
    found = ferraris(
        up, down, rest_up, rest_down, sums[:, 3:], sums[:, :3],
        np.array([len(parts[f"{axis}_rot"]) for axis in "xyz"]) / rate, np.full(3, -360.0), gravity, still.mean(axis=0),
    )  # fmt: skip
    published = json.loads((folder / "imucal" / "example_cal.json").read_text(encoding="utf-8"))
    theirs = {name: np.array(value) for name, value in published.items() if isinstance(value, list)}

    def split(gain):
        scale = np.linalg.norm(np.asarray(gain), axis=1)
        return np.diag(scale), np.asarray(gain) / scale[:, None]

    ours = dict(zip(("K_a", "R_a"), split(found["accelerometer_gain"]), strict=True))
    ours |= dict(zip(("K_g", "R_g"), split(found["gyroscope_gain"]), strict=True))
    ours |= {"b_a": found["accelerometer_bias"], "b_g": found["gyroscope_bias"], "K_ga": found["cross"]}
    table = Table(
        "imucal's annotated session: its own calibration by Ferraris' equations",
        ["number", "largest relative difference", "target"],
    )
    differences = {}
    for name, value in ours.items():
        known = theirs[name]
        differences[name] = float(np.max(np.abs(np.asarray(value) - known)[known != 0] / np.abs(known[known != 0])))
        table.add(name, f"{differences[name]:.1e}", "≤ 1e-6")

    options = ReadOptions(columns="_,_,accel [count],gyro [count]", rate=rate, gyro_scale="16.4 count/(deg/s)")
    recording = read_recording(path, options=options)
    entries = read_reference(path, recording)
    calibration = calibrate_turntable(recording, entries, LocalGravity(gravity, 0.0))
    beside = Table(
        "The same session by maximum likelihood, in imucal's units",
        ["parameter", "imucal", "jaximu ± 95 %", "difference / sigma"],
        "Counts per m/s², counts per °/s, counts. Errors of the positions themselves, some tenths of a degree, scatter "
        "far beyond noise and are in the accelerometer's intervals. The gyroscope's three turns leave nothing to "
        "check: its intervals hold noise alone, and imucal takes off what the gyroscope reads under gravity. imucal "
        "takes the turns as −360°, jaximu the sense the gyroscope shows.",
    )  # fmt: skip
    compare(beside, calibration, theirs)
    return [table, beside], {"relative_differences": differences, "excess": calibration.excess}


def compare(table: Table, calibration: Calibration, theirs) -> None:
    for triad, short, factor in (("accelerometer", "a", 1.0), ("gyroscope", "g", np.pi / 180)):
        model = calibration.triads()[triad]
        sigma = calibration.sigma(triad)
        gain = theirs[f"K_{short}"] @ theirs[f"R_{short}"] * (1 if short == "a" else -1)
        for row in range(3):
            for column in range(3):
                ours = (float(np.asarray(model.gain)[row, column]) * factor, float(sigma[0][row, column]) * factor)
                line(table, f"{triad} gain[{row},{column}]", gain[row, column], *ours)
        for row in range(3):
            ours = float(np.asarray(model.bias)[row]), float(sigma[1][row])
            line(table, f"{triad} bias[{row}]", theirs[f"b_{short}"][row], *ours)


def line(table: Table, name: str, theirs: float, ours: float, sigma: float) -> None:
    table.add(name, f"{theirs:.5g}", f"{ours:.5g} ± {1.96 * sigma:.2g}", f"{(theirs - ours) / sigma:.1f}")


# --- schemes --------------------------------------------------------------------------------------------------------

SCHEMES = {
    "six positions": Positions(6),
    "eight positions": Positions(8),
    "twelve positions": Positions(12),
    "twenty-four positions": Positions(24),
    "dividing head": DividingHead(duration=20.0),
    "single-axis rate table": SingleAxisTable(duration=20.0),
    "Ferraris": Ferraris(),
    "twenty-six positions": Positions(26),
}


def schemes(units: int):
    """RMSE over the Cramér–Rao bound, and coverage of the intervals, of units simulated sample by sample."""
    table = Table(
        f"Recovery of {units} simulated units a scheme (100 Hz, 100 µg/√Hz, 0.005 °/s/√Hz, noise not given)",
        ["scheme", "poses", "turns", "RMSE / bound", "target", "95 % intervals cover", "target "],
        "The bound is the inverse Fisher information at the true unit with the true noise; pooled over 24 parameters.",
    )  # fmt: skip
    figures, covered = {}, []
    nominal = Imu.nominal()
    for name, protocol in SCHEMES.items():
        stations, truths = [], [draw_imu(unit) for unit in range(units)]
        for unit, imu in enumerate(truths):
            recording, truth = simulate(imu, protocol, consumer_noise(), seed=unit)
            stations.append(observe_stations(recording, truth.schedule, STANDARD_GRAVITY)[0])
        fit = fit_turntable(stack([nominal] * units), stack(stations))
        found = np.concatenate([np.reshape(leaf, (units, -1)) for leaf in jax.tree.leaves(fit.imu)], axis=1)
        errors = found - np.stack([flatten(imu) for imu in truths])
        bound = fit_turntable(truths[0], scheme_stations(protocol, truths[0], NOISE)).sigmas()
        ratio = float(np.sqrt(np.mean((errors / bound) ** 2)))
        inside = np.abs(errors) <= 1.96 * fit.sigmas()
        used = stations[0].gyroscope_used
        poses, turns = int(np.sum(used & ~stations[0].turn)), int(np.sum(used & stations[0].turn))
        table.add(name, poses, turns, f"{ratio:.3f}", "≤ 1.05", f"{100 * inside.mean():.2f} %", "93–97 %")
        figures[name] = {
            "rmse_over_bound": ratio,
            "coverage": float(inside.mean()),
            "converged": int(fit.converged.sum()),
        }
        covered.append(inside)
        print(name, figures[name], flush=True)
    figures["pooled_coverage"] = float(np.mean([each.mean() for each in covered]))
    return [table], figures


# --- scale-factor nonlinearity (S7) ---------------------------------------------------------------------------------


def nonlinearity(units: int):
    """Linearise first, or fit jointly: errors of gain, bias and curvature over the joint fit's bound."""
    table = Table(
        f"Quadratic accelerometer (1e-4 per m/s²), {units} units: RMSE over the joint fit's bound",
        ["scheme", "misalignment", "ignored", "linearised first", "fitted jointly", "target"],
        "Pooled over gain and bias. Linearising first, axis by axis, is as good as the joint fit in the classical "
        "schemes, whose poses come in opposite pairs; elsewhere it takes misalignment for curvature.",
    )  # fmt: skip
    figures = {}
    rng = np.random.default_rng(7)
    given = {name: SCHEMES[name] for name in ("six positions", "twelve positions", "twenty-four positions")}
    for name, protocol in (given | {"twelve random poses": HandHeld(poses=12)}).items():
        for misalignment in (0.0, 0.02):
            effect = CATALOGUE["accel.quadratic"].make(1e-4)
            imus = [draw_imu(unit, misalignment).with_effects(effect) for unit in range(units)]
            made = []
            for imu in imus:
                exact = scheme_stations(protocol, imu, NOISE)
                sigma = np.sqrt(np.diagonal(exact.accelerometer_covariance, axis1=1, axis2=2)).T
                noisy = exact.accelerometer_mean + sigma * rng.standard_normal(sigma.shape)
                made.append(replace(exact, accelerometer_mean=noisy))
            start = Imu.nominal().with_effects(CATALOGUE["accel.quadratic"].dormant())
            joint = fit_turntable(stack([start] * units), stack(made), ("accel.quadratic",))
            truth = np.stack([np.concatenate([np.ravel(i.accelerometer.gain), i.accelerometer.bias]) for i in imus])
            free_of_noise = scheme_stations(protocol, imus[0], NOISE)
            bound = fit_turntable(imus[0], free_of_noise, ("accel.quadratic",)).sigmas()[:12]
            used = np.asarray(made[0].accelerometer_used)
            force = np.stack([np.asarray(each.stimulus.specific_force)[used].mean(axis=1) for each in made])
            means = np.stack([np.asarray(each.accelerometer_mean)[used] for each in made])
            curved = linear_least_squares(force, means)
            first = linear_least_squares(force, remove_curvature(force, means)[0])
            ratios = []
            for gain, bias in (curved, first, (joint.imu.accelerometer.gain, joint.imu.accelerometer.bias)):
                flat = np.concatenate([np.reshape(gain, (units, 9)), np.asarray(bias)], axis=1)
                ratios.append(float(np.sqrt(np.mean(((flat - truth) / bound) ** 2))))
            table.add(name, f"{misalignment:g}", *(f"{each:.2f}" for each in ratios), "jointly ≤ 1.05")
            figures[f"{name}, {misalignment:g}"] = dict(zip(("ignored", "first", "jointly"), ratios, strict=True))
    return [table], figures


# --- batches --------------------------------------------------------------------------------------------------------


def batches(units: int):
    """Time a unit of 24 positions, 12 parameters: closed form against numpy, and Levenberg–Marquardt."""
    rng = np.random.default_rng(0)
    exact = scheme_stations(Positions(24), noise=NOISE)
    used = np.asarray(exact.accelerometer_used)
    force = np.asarray(exact.stimulus.specific_force)[used].mean(axis=1)
    gains = np.eye(3) + 0.02 * rng.uniform(-1, 1, (units, 3, 3))
    biases = 0.3 * rng.uniform(-1, 1, (units, 3))
    inputs = force + 1e-4 * rng.standard_normal((units, *force.shape))  # every unit has poses of its own
    outputs = np.einsum("nij,nsj->nsi", gains, inputs) + biases[:, None] + 3e-4 * rng.standard_normal(inputs.shape)
    design = np.concatenate([inputs, np.ones((units, len(force), 1))], axis=2)

    def loop():
        return np.stack([np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(design, outputs, strict=True)])

    def batched():
        basis, upper = np.linalg.qr(design)
        return np.linalg.solve(upper, np.swapaxes(basis, 1, 2) @ outputs)

    compiled = jax.jit(linear_least_squares)
    given = jnp.asarray(inputs), jnp.asarray(outputs)

    def ours():
        gain, bias = jax.block_until_ready(compiled(*given))
        return gain, bias

    parameters = Parameters.select(Imu(Imu.nominal().accelerometer, None), lambda name: True)  # pyright: ignore
    like = Imu(Imu.nominal().accelerometer, None)

    def residual(imu, data):
        u, y = data
        return ((y - u @ imu.accelerometer.gain.T - imu.accelerometer.bias) / 3e-4).ravel()

    @jax.jit
    def marquardt(inputs, outputs):
        def lane(data):
            found = solve(Problem(like, parameters, data, residual, tolerance=1e4), jnp.zeros(12), 64, 1e-11)
            return parameters.model(like, found.z)

        return jax.lax.map(lane, (inputs, outputs))

    def levenberg():
        return jax.block_until_ready(marquardt(*given))

    def best(function, repeats=5):
        function()
        found = []
        for _ in range(repeats):
            begin = time.perf_counter()
            result = function()
            found.append(time.perf_counter() - begin)
        return min(found), result

    seconds, results = {}, {}
    for name, function in (("loop", loop), ("batched", batched), ("ours", ours), ("levenberg", levenberg)):
        seconds[name], results[name] = best(function, 2 if name == "loop" else 5)
    gain, bias = results["ours"]
    reference = results["batched"]
    against = max(float(np.abs(np.swapaxes(np.asarray(gain), 1, 2) - reference[:, :3]).max()),
                  float(np.abs(np.asarray(bias) - reference[:, 3]).max()))  # fmt: skip
    model = results["levenberg"]
    lm = max(float(np.abs(np.asarray(model.accelerometer.gain) - np.asarray(gain)).max()),
             float(np.abs(np.asarray(model.accelerometer.bias) - np.asarray(bias)).max()))  # fmt: skip
    table = Table(
        f"{units} units of 24 positions, 12 parameters each",
        ["solution", "µs a unit", "ours is faster by", "target", "largest difference to ours"],
    )
    micro = {name: 1e6 * each / units for name, each in seconds.items()}
    table.add("numpy lstsq, one after the other", micro["loop"], f"{seconds['loop'] / seconds['ours']:.1f}", "≥ 10", "")
    table.add("numpy batched QR", micro["batched"], f"{seconds['batched'] / seconds['ours']:.2f}", "≥ 1.5",
              f"{against:.1e}")  # fmt: skip
    table.add("ours, closed form", micro["ours"], "", "", "")
    table.add("ours, Levenberg–Marquardt", micro["levenberg"], "", "", f"{lm:.1e} (target ≤ 1e-10)")
    return [table], {"microseconds": micro, "difference": against, "difference_levenberg_marquardt": lm}


def main() -> None:
    small = arguments(__doc__).small
    tables, figures = [], {}
    parts = {
        "schemes": lambda: schemes(10 if small else 200),
        "nonlinearity": lambda: nonlinearity(20 if small else 300),
        "batches": lambda: batches(1000 if small else 10_000),
    }
    folder = os.environ.get("JAXIMU_DATA")
    if folder:
        parts = {"imucal": lambda: imucal_session(Path(folder))} | parts
    for name, part in parts.items():
        made, figures[name] = part()
        tables += made
    finish("turntable", tables, figures, keep=not small)


if __name__ == "__main__":
    main()
