"""Temperature: simulated chambers, a measured cooling leg, measured wrist windows over days.

Chambers go through three cycles from -20 to 60 °C at 1, 2 and 4 K/min; every unit has its own bias over temperature,
lag, rate terms or hysteresis. The leg and the wrist windows are measured (JAXIMU_DATA names their folder). Units under
any history of temperature come from `tests/temperature_histories.py`, which shares nothing with the library;
`--histories` runs these alone, into results of their own.
"""

import os
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import numpy as np
from accelerometer_norms import calibrate_norms
from common import Table, arguments, finish, share

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import temperature_histories as histories

from jaximu.calibration import calibrate_thermal, compensate
from jaximu.calibration.identifiability import identifiable
from jaximu.calibration.thermal_linear import Whitened
from jaximu.calibration.thermal_shapes import ThermalShapes
from jaximu.calibration.thermal_triad import fit_triad
from jaximu.data.rest_blocks import own_noise, rest_blocks
from jaximu.model import Noise
from jaximu.model.effects import CATALOGUE
from jaximu.model.processes import BiasInstability, White
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.readers import ReadOptions, read_recording
from jaximu.report.export.thermal_autopilot import px4_parameters
from jaximu.simulation import simulate
from jaximu.simulation.draw import ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY, draw_imu
from jaximu.simulation.protocols import SoakAndRamp

jax.config.update("jax_enable_x64", True)

STANDARD_GRAVITY = 9.80665
COLUMNS = "time [us],gyro [rad/s],accel [m/s^2],_,temperature [degC]"
KINDS = ("thermal_lag", "temperature_rate", "thermal_hysteresis")
PROTOCOL = SoakAndRamp(rates=(1.0, 2.0, 4.0))
NOISE = {  # of consumer sensors: 100 µg/√Hz and 20 µg, 0.005 °/s/√Hz and 5 °/h
    "accelerometer": Noise((White(ACCELEROMETER_DENSITY), BiasInstability(20e-6 * STANDARD_GRAVITY)), "specific_force"),
    "gyroscope": Noise((White(GYROSCOPE_DENSITY), BiasInstability(float(np.radians(5.0 / 3600)))), "angular_rate"),
}


def hidden(rng: np.random.Generator, kind: str) -> list[Any]:
    """Draw what temperature does to a unit: bias over it, and one thing beyond, on both triads."""
    found = []
    for prefix, size in (("accel", 1.0), ("gyro", 0.1)):
        draw = lambda scale: scale * size * rng.normal(size=3)  # noqa: B023, E731
        found += [CATALOGUE[f"{prefix}.temperature"].make(draw(1e-3)),
                  CATALOGUE[f"{prefix}.temperature_squared"].make(draw(2e-5))]  # fmt: skip
        if kind == "thermal_lag":
            found.append(CATALOGUE[f"{prefix}.{kind}"].make(draw(1e-3), time_constant=float(rng.uniform(80, 400))))
        elif kind == "temperature_rate":
            found.append(CATALOGUE[f"{prefix}.{kind}"].make(draw(0.1)))
        else:
            found.append(CATALOGUE[f"{prefix}.{kind}"].make(draw(5e-4), half_width=float(rng.uniform(2.0, 6.0))))
    return found


def steady(effects: list[Any], prefix: str, kelvin: np.ndarray) -> np.ndarray:
    """The bias (m, 3) put in, at temperatures that have long been what they are, from 25 °C."""
    power = {"temperature": 1, "temperature_squared": 2, "thermal_lag": 1, "thermal_hysteresis": 1}
    warmth = kelvin[:, None] - 25.0
    return sum(
        (np.asarray(e.coefficients) * warmth ** power[e.plain]
         for e in effects if e.name.startswith(prefix) and e.plain in power),
        start=np.zeros((len(kelvin), 3)),
    )  # fmt: skip


def chambers(units: int, table: Table) -> dict[str, Any]:
    """Fit simulated chambers, and compare with what was put in and with the noise that was drawn."""
    rows: dict[str, list[dict[str, float]]] = {kind: [] for kind in KINDS}
    for unit in range(units):
        rng = np.random.default_rng([7, unit])
        kind = KINDS[unit % len(KINDS)]
        effects, imu = hidden(rng, kind), draw_imu(unit)
        given = {"noise": NOISE, "rate": 1.0, "seed": unit}
        recording, _ = simulate(imu.with_effects(*effects), PROTOCOL, **given)
        quiet, _ = simulate(imu, PROTOCOL, **given)  # the same noise, and nothing of temperature
        start = time.perf_counter()
        found = calibrate_thermal(recording)
        took = time.perf_counter() - start
        plain = rest_blocks(quiet, found.blocks.duration)
        kelvin = np.linspace(*found.blocks.range, 81)
        kelvin = kelvin[np.abs(kelvin - 25.0) > 1.0]
        for name, prefix in (("accelerometer", "accel"), ("gyroscope", "gyro")):
            fit = found.fits[name]
            noise = plain.means[name] - plain.means[name].mean(axis=0)
            floor = np.sqrt(np.mean(noise**2))
            cubic = next(each for each in fit.candidates if each.family == "cubic")
            value, sigma = found.bias(name, kelvin)
            wanted = steady(effects, prefix, kelvin)
            row = {
                "ratio": float(np.sqrt(np.mean(fit.residual**2)) / floor),
                "cubic": float(np.sqrt(np.mean(cubic.held.rms**2)) / floor),
                "held": float(np.sqrt(np.mean(fit.candidate.held.rms**2)) / floor),
                "covered": float(np.mean(np.abs(value - wanted) < 1.96 * sigma)),
                "right": float(f"{kind}" in fit.candidate.names),
                "seconds": took,
            }
            inner = [each for each in fit.inner if each[0] == kind]
            if inner:
                true = next(float(getattr(e, inner[0][1])) for e in effects if e.name == f"{prefix}.{kind}")
                value, sigma = fit.inner[inner[0]]
                row |= {"inner": abs(value / true - 1), "bound": sigma / true, "z": (value - true) / sigma}
            rows[kind].append(row)
    figures: dict[str, Any] = {}
    for kind, found_rows in rows.items():
        each = {key: np.array([row[key] for row in found_rows if key in row]) for key in
                ("ratio", "held", "cubic", "covered", "right", "inner", "bound", "z", "seconds")}  # fmt: skip
        coverage = float(each["covered"].mean())
        spread = float(each["covered"].std(ddof=1) / np.sqrt(len(each["covered"])))
        inner = each["inner"]
        figures[kind] = {
            "triads": len(found_rows), "residual_over_noise": float(each["ratio"].max()),
            "heldout_over_noise": float(np.median(each["held"])), "cubic_over_noise": float(np.median(each["cubic"])),
            "coverage": coverage, "coverage_sigma": spread, "named": float(each["right"].mean()),
            "inner_error_median": float(np.median(inner)) if len(inner) else None,
            "inner_error_largest": float(inner.max()) if len(inner) else None,
            "inner_within_5_percent": float(np.mean(inner < 0.05)) if len(inner) else None,
            "inner_bounds": each["bound"].tolist(), "inner_errors": inner.tolist(), "inner_z": each["z"].tolist(),
            "seconds": float(np.median(each["seconds"])),
        }  # fmt: skip
        own = (
            "–"
            if not len(inner)
            else f"{100 * np.median(inner):.2g} % ({np.sum(inner < 0.05)} of {len(inner)} within 5 %)"
        )
        able = each["bound"] < 0.05 / 1.96
        bound = (
            "–"
            if not len(inner)
            else f"{100 * np.median(each['bound']):.2g} %, below 2.6 % in {np.sum(able)}: of these "
            f"{np.sum(inner[able] < 0.05)} within 5 %; error over bound {np.sqrt(np.mean(each['z'] ** 2)):.2f} rms"
        )
        table.add(
            kind, f"{len(found_rows)}", f"{100 * each['right'].mean():.0f} %", f"{each['ratio'].max():.3f}",
            f"{np.median(each['held']):.3f}", f"{np.median(each['cubic']):.3g}",
            f"{100 * coverage:.1f} ± {196 * spread:.1f} %", own, bound,
        )  # fmt: skip
    whole = np.array([row["covered"] for part in rows.values() for row in part])
    figures["coverage"] = float(whole.mean())
    figures["coverage_sigma"] = float(whole.std(ddof=1) / np.sqrt(len(whole)))
    table.add("all", f"{len(whole)}", "", "", "", "",
              f"{100 * whole.mean():.1f} ± {196 * figures['coverage_sigma']:.1f} %", "", "")  # fmt: skip
    return figures


def cooling_leg(folder: Path, table: Table) -> dict[str, Any]:
    """What one leg tells; its colder half predicted from the warmer one, with the band's width and coverage."""
    recording = read_recording(folder / "tofupilot_cooling" / "cooling_leg.tsv", None, ReadOptions(columns=COLUMNS))
    found = calibrate_thermal(recording)
    px4 = px4_parameters(found)
    blocks = found.blocks
    first = np.arange(len(blocks)) < len(blocks) // 2
    half = blocks.only(first)
    own = ThermalShapes(half, found.reference)
    noise = own_noise(half, own.generous())
    told = identifiable(half, own)
    figures: dict[str, Any] = {"words": list(found.identifiability.words), "told": list(found.identifiability.told)}
    units = {"accelerometer": (1e3 / STANDARD_GRAVITY, "mg"), "gyroscope": (float(np.degrees(1.0)), "°/s")}
    for name, fit in found.fits.items():
        factor, unit = units[name]
        chosen = fit_triad(Whitened(half, name, noise, own), told, ("cubic", "polynomial")).candidate.model
        data, later = Whitened(blocks, name, noise, ThermalShapes(blocks, found.reference)), np.flatnonzero(~first)
        parts = [next(data.left_out(axis, terms, [later])) for axis, terms in enumerate(chosen)]
        errors = np.stack([part.errors for part in parts])
        sigma = np.sqrt([np.diag(part.covariance) for part in parts])
        covered = float(np.mean(np.abs(errors) < 1.96 * sigma))
        moved = blocks.means[name][~first] - blocks.means[name][first][-1]
        width = factor * float(np.sqrt(np.mean((2 * 1.96 * sigma) ** 2)))
        row = {
            "unit": unit,
            "before": factor * float(np.linalg.norm(fit.before)),
            "after": factor * float(np.linalg.norm(fit.after)),
            "heldout_stretches": factor * float(np.linalg.norm(fit.candidate.held.rms)),
            "px4_loss": factor * float(np.linalg.norm(px4.loss[name])),
            "second_half_moves": factor * float(np.sqrt(np.mean(moved**2))),
            "second_half_error": factor * float(np.sqrt(np.mean(errors**2))),
            "second_half_width": width,
            "second_half_coverage": covered,
        }
        figures[name] = row
        shown = [f"{value:.3g} {unit}" for value in list(row.values())[1:6]]
        shown.append(f"{row['second_half_error']:.3g} {unit}; {width:.3g} {unit}; {100 * covered:.0f} %")
        table.add(name, *shown)
    return figures


def ggir_errors(means, kelvin, model) -> np.ndarray:
    """Errors of the norm (g) under GGIR's scale, offset and temperature offset."""
    scale, offset, slope, middle = model
    return np.linalg.norm(means * scale + offset + np.multiply.outer(kelvin - middle, slope), axis=1) - 1.0


def ggir_fit(means, kelvin, tolerance: float) -> tuple:
    """GGIR's model by its method: each axis is regressed on itself and temperature towards the unit sphere, again and
    again, windows weighted by one over their distance, at most 100 (van Hees et al., J Appl Physiol 117, 2014)."""
    scale, offset, slope, middle = np.ones(3), np.zeros(3), np.zeros(3), float(kelvin.mean())
    weight, last = np.ones(len(means)), np.inf
    for _ in range(2000):
        now = means * scale + offset + np.multiply.outer(kelvin - middle, slope)
        target = now / np.linalg.norm(now, axis=1, keepdims=True)
        root = np.sqrt(weight)[:, None]
        for axis in range(3):
            columns = np.stack([np.ones(len(now)), now[:, axis], kelvin - middle], axis=1)
            o, s, t = np.linalg.lstsq(root * columns, root[:, 0] * target[:, axis], rcond=None)[0]
            scale[axis], offset[axis], slope[axis] = scale[axis] * s, offset[axis] * s + o, slope[axis] * s + t
        now = means * scale + offset + np.multiply.outer(kelvin - middle, slope)
        cost = float(3 * np.mean(weight[:, None] * (now - target) ** 2) / weight.sum())
        away = np.abs(np.linalg.norm(now, axis=1) - 1.0)
        weight = np.minimum(1 / np.maximum(away, 1e-12), 100.0)
        if abs(cost - last) < tolerance:
            break
        last = cost
    return scale, offset, slope, middle


def wrist(folder: Path, table: Table) -> dict[str, Any]:
    """Days left out in turn, all windows: GGIR's model and this library's, fitted on the same other days."""
    data = np.loadtxt(folder / "ggir_wrist" / "spheredata.csv", delimiter=",", skiprows=1)
    means, kelvin, day = data[:, 2:5], data[:, 8], (data[:, 0] * 10 // 86400).astype(int)
    models = {
        "none": None,
        "GGIR's, stopped as GGIR does": 1e-10,
        "GGIR's, run to its end": 1e-14,
        "bias over T, gain": ("accel.temperature",),
        "bias over T, T², gain": ("accel.temperature", "accel.temperature_squared"),
        "bias over T, T², gain over T": ("accel.temperature", "accel.temperature_squared", "accel.scale_temperature"),
    }
    figures: dict[str, Any] = {}
    for name, model in models.items():

        def errors(fit, inside, model=model):
            if model is None:
                return np.linalg.norm(means[inside], axis=1) - 1.0
            if isinstance(model, float):
                return ggir_errors(means[inside], kelvin[inside], ggir_fit(means[fit], kelvin[fit], model))
            found = calibrate_norms(means[fit] * STANDARD_GRAVITY, kelvin[fit], model, gravity=STANDARD_GRAVITY)
            windows = means[inside] * STANDARD_GRAVITY, Stimulus(temperature=kelvin[inside])
            return np.linalg.norm(found.imu.accelerometer.recover(*windows), axis=1) / STANDARD_GRAVITY - 1.0

        every = np.ones(len(day), bool)
        own = 1e3 * float(np.mean(np.abs(errors(every, every))))
        left = np.zeros(len(day))
        for each in np.unique(day):
            left[day == each] = errors(day != each, day == each)
        days = [1e3 * float(np.mean(np.abs(left[day == each]))) for each in np.unique(day)]
        held = 1e3 * float(np.mean(np.abs(left)))
        figures[name] = {"fitted": own, "heldout": held, "heldout_days": days}
        table.add(name, f"{own:.2f} mg", f"{held:.2f} mg", ", ".join(f"{each:.2f}" for each in days))
    return figures


BEYOND = ("none", "lag", "hysteresis", "both")
LEFT = 1.1  # times the noise that may be left of another recording
MEANS = 30.0  # s


def means_of(signal) -> np.ndarray:
    """Means over half a minute, about the mean of all."""
    samples = round(MEANS * signal.rate)
    count = len(signal) // samples
    found = signal.values[: count * samples].reshape(count, samples, 3).mean(axis=1)
    return found - found.mean(axis=0)


def any_history(units: int, table: Table) -> list[dict[str, Any]]:
    """Fit units under random histories; correct another recording of each, and compare inner parameters."""
    rows: list[dict[str, Any]] = []
    for number in range(units):
        kind = histories.KINDS[number % len(histories.KINDS)]
        beyond = BEYOND[number // len(histories.KINDS) % len(BEYOND)]
        unit = histories.draw_unit(np.random.default_rng([31, number]), beyond)
        recording, _ = histories.record(unit, kind, 1000 + number)
        other, quiet = histories.record(unit, kind, 5000 + number)
        began = time.process_time()
        found = calibrate_thermal(recording)
        seconds = time.process_time() - began
        left = compensate(found.calibration, other)
        row: dict[str, Any] = {"kind": kind, "beyond": beyond, "seconds": seconds, "left": [], "raw": [], "z": []}
        for name, fit in found.fits.items():
            floor = np.sqrt(np.mean(means_of(getattr(quiet, name)) ** 2, axis=0))
            for key, each in (("left", left), ("raw", other)):
                row[key] += list(np.sqrt(np.mean(means_of(getattr(each, name)) ** 2, axis=0)) / floor)
            for (effect, _), (value, sigma) in fit.inner.items():
                hidden = {"none": (), "lag": ("thermal_lag",), "hysteresis": ("thermal_hysteresis",)}.get(
                    beyond, ("thermal_lag", "thermal_hysteresis"))  # fmt: skip
                true = unit.lag if effect == "thermal_lag" else unit.width
                row["z"].append([effect, (value - true) / sigma if effect in hidden else None, value, true])
        rows.append(row)
    parts = [(kind, [row for row in rows if row["kind"] == kind]) for kind in histories.KINDS]
    for kind, some in [*parts, ("all", rows)]:
        if not some:
            continue
        worst = [max(row["left"]) for row in some]
        z = [each[1] for row in some for each in row["z"] if each[1] is not None]
        strangers = sum(each[1] is None for row in some for each in row["z"])
        table.add(
            kind, f"{len(some)}", f"{np.median([v for row in some for v in row['raw']]):.3g}",
            f"{np.median(worst):.3f}", f"{max(worst):.3f}", share(sum(each <= LEFT for each in worst), len(some)),
            share(sum(abs(each) < 1.96 for each in z), len(z)) if z else "–", f"{strangers}",
            f"{np.median([row['seconds'] for row in some]):.1f} s",
        )  # fmt: skip
    return rows


def main() -> None:
    """Run all parts."""
    given = arguments(__doc__, histories="only units under any history of temperature")
    small = given.small
    wandering = Table(
        "Any history of temperature, 3 h at 10 Hz: another recording, corrected, over the noise of its 30-s means",
        ["history", "units", "raw, median", "worst axis, median", "largest", f"worst axis up to {LEFT:g}",
         "time constants and half-widths within 95 %", "named and not there", "processor time, median"],
        "Nothing, a lag, a hysteresis or both are hidden beyond a cubic, on four axes of five; 95 % intervals.",
    )  # fmt: skip
    if given.histories:
        rows = any_history(6 if small else 100, wandering)
        finish("thermal_histories", [wandering], {"units": rows}, keep=not small, script="thermal")
        return
    tables = [
        Table("Simulated chambers, three cycles: what is left over the noise of the blocks",
              ["hidden beyond T, T²", "triads", "named", "left, largest", "ramps left out, median",
               "a cubic there, median", "95 % band covers", "inner parameter off, median",
               "its bound (one sigma), median"]),
        Table("The measured cooling leg, 52 to -18 °C",
              ["triad", "moves", "left", "stretches left out", "PX4 cubic loses", "second half moves",
               "predicted from the first: error; width of its 95 % band; covers"],
              "rms; one leg tells no rate, lag or hysteresis from temperature."),
        Table("Wrist windows over 84 h, mean size of the norm's error", ["model", "fitted", "days left out", "by day"]),
    ]  # fmt: skip
    figures: dict[str, Any] = {}
    folder = os.environ.get("JAXIMU_DATA")
    if folder:
        figures["wrist"] = wrist(Path(folder), tables[2])
        figures["leg"] = cooling_leg(Path(folder), tables[1])
    figures["chambers"] = chambers(3 if small else 24, tables[0])
    finish("thermal", tables if folder else tables[:1], figures, keep=not small)


if __name__ == "__main__":
    main()
