"""Do the intervals of gain and bias hold in what a diagnosis gives out, whichever model its tests chose?

Units with gains and biases of their own are simulated by hand, 24 poses at 50 Hz, warming by 6 K, with white noise that
is known from half an hour at rest. Of each, one effect of the catalogue that the recording can show is hidden, at a
place of its grid and in a direction drawn by chance, at 0, 0.5, 1, 2 and 4 detection limits: the whitened length of
what it does to the conditions, gain and bias projected off, in those that a test of as many degrees of freedom finds
with 90 % power. Errors are those of the extended calibration, with its covariance and with that of the chosen model
alone. `--small` takes a tenth of the units.
"""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OMP_NUM_THREADS", "1")

from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context

import jax
import numpy as np
from common import Table, arguments, finish, share
from intervals import EXACT, RATE, WHITE, bounds, drawn_unit, resting

from jaximu.diagnosis import diagnose
from jaximu.diagnosis.diagnosis import extended
from jaximu.diagnosis.evidence import limit_noncentrality
from jaximu.ground.errors import NotPossibleError
from jaximu.model.effects import CATALOGUE
from jaximu.noise.at_rest import noise_of
from jaximu.simulation import simulate
from jaximu.simulation.protocols import Environment, HandHeld

jax.config.update("jax_enable_x64", True)

LIMITS = (0.0, 0.5, 1.0, 2.0, 4.0)
UNITS = 100
WARMING = Environment(temperature=[[0, 24], [60, 28], [160, 30]])


@cache
def static_noise():
    """The noise that all units have."""
    return noise_of(resting("none", 1.0, np.random.default_rng(1)))


def recorded(imu, seed):
    """A recording of a unit."""
    return simulate(imu, HandHeld(24), WHITE, rate=RATE, seed=seed, environment=WARMING)[0]


def drawn_effect(evidence, rng):
    """An effect that the recording can show, of one detection limit."""
    able = [k for k, block in enumerate(evidence.blocks) if block.kind == "effect" and evidence.observable(k)]
    able = [k for k in able if CATALOGUE[evidence.blocks[k].name].scope != "fixture"]
    names = sorted({evidence.blocks[k].name for k in able})
    name = names[int(rng.integers(len(names)))]
    block = int(rng.choice([k for k in able if evidence.blocks[k].name == name]))
    direction = rng.standard_normal(len(evidence.blocks[block].sizes))
    length = np.sqrt(direction @ evidence.information(block) @ direction)
    scale = np.sqrt(limit_noncentrality(len(direction))) / length
    return evidence.blocks[block], direction * scale * evidence.blocks[block].sizes


def errors(calibration, covariance, imu):
    """Errors in sigmas of gains and of biases."""
    rows = {"gains": [], "biases": []}
    for name, variance in zip(calibration.names, np.diag(covariance), strict=True):
        if name.effect is None and name.part in ("gain", "bias"):
            triad, truth = (getattr(unit, name.owner) for unit in (calibration.imu, imu))
            error = np.asarray(getattr(triad, name.part))[name.axes] - np.asarray(getattr(truth, name.part))[name.axes]
            rows["gains" if name.part == "gain" else "biases"].append(error / np.sqrt(variance))
    return rows


def unit(seed):
    """What became of one unit at every size: rows of errors by the name of the covariance, and whether it was named."""
    rng = np.random.default_rng([seed, 55])
    imu = drawn_unit(rng)
    block, coefficients = drawn_effect(diagnose(recorded(imu, seed), EXACT, static=static_noise()).base.evidence, rng)
    outcomes = []
    for multiple in LIMITS:
        hidden = CATALOGUE[block.name].make(multiple * coefficients, **block.inner)
        whole = imu.with_effects(hidden) if multiple else imu
        try:
            diagnosis = diagnose(recorded(whole, seed), EXACT, static=static_noise())
        except NotPossibleError as error:
            outcomes.append({"limits": multiple, "hidden": block.name, "refused": str(error)})
            continue
        calibration = diagnosis.extended_calibration()
        alone = extended(diagnosis.calibration, diagnosis.experiment, diagnosis.extended, diagnosis.noise)
        outcomes.append({
            "limits": multiple, "hidden": block.name, "verdict": diagnosis.verdict,
            "named": [effect.name for effect in diagnosis.effects],
            "all models": errors(calibration, calibration.covariance, imu),
            "the chosen model": errors(calibration, alone.covariance, imu),
        })  # fmt: skip
    return outcomes


def main():
    """Run all units in as many processes as there are cores and keep the table."""
    options = arguments(__doc__)
    units = UNITS // 10 if options.small else UNITS
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        done = [outcome for outcomes in pool.map(unit, range(units)) for outcome in outcomes]
    table = Table(
        "Intervals after a choice (goal: 93 to 97 % within the 99 % bounds)",
        [
            "hidden, detection limits",
            "named",
            "numbers",
            "95 % intervals that hold, 99 % bounds",
            "by the chosen model",
        ],
    )
    figures, rng = {}, np.random.default_rng(0)
    for multiple in LIMITS:
        rows = [outcome for outcome in done if outcome["limits"] == multiple and "refused" not in outcome]
        for group in ("gains", "biases"):
            _, held, low, high = bounds([np.array(row["all models"][group]) for row in rows], rng)
            _, naive, *_ = bounds([np.array(row["the chosen model"][group]) for row in rows], rng)
            missed = "" if low <= 0.97 and high >= 0.93 else " (missed)"
            named = share(sum(row["hidden"] in row["named"] for row in rows), len(rows))
            cell = f"{100 * held:.1f} % ({100 * low:.1f} … {100 * high:.1f}){missed}"
            table.add(f"{multiple:g}", named, group, cell, f"{100 * naive:.1f} %")
            figures[f"{multiple:g} limits, {group}"] = [held, low, high, naive, len(rows)]
    figures["refused"] = [outcome for outcome in done if "refused" in outcome]
    figures["units"] = [{key: outcome.get(key) for key in ("limits", "hidden", "verdict", "named")} for outcome in done]
    finish("choice", [table], figures, keep=not options.small)


if __name__ == "__main__":
    main()
