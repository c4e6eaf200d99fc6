"""Diagnosis of chambers: false alarms with nothing hidden, and what is said of thermal effects of known size.

Size is in multiples of the detection limit: the noncentrality of the effect's own test, at its true inner parameters.
"""

import time
from functools import cache
from typing import Any

import jax
import numpy as np
from common import Table, arguments, finish, share

from jaximu.diagnosis.evidence import limit_noncentrality
from jaximu.diagnosis.thermal import diagnose_thermal
from jaximu.model import NoiseModel
from jaximu.model.effects import CATALOGUE
from jaximu.noise.at_rest import fit_noise
from jaximu.simulation import simulate
from jaximu.simulation.draw import consumer_noise, draw_imu
from jaximu.simulation.protocols import Environment, SoakAndRamp, Static

jax.config.update("jax_enable_x64", True)
CYCLES = SoakAndRamp(low=0.0, high=50.0, rates=(3.0, 6.0), soak_duration=200.0)
WARMING = Environment(temperature=[[0, 20.0], [200, 27.0], [500, 33.0], [1000, 38.0], [1800, 41.0]])
INNER = {"thermal_lag": ("time_constant", 60.0, 400.0), "thermal_hysteresis": ("half_width", 2.0, 8.0),
         "warm_up": ("time_constant", 100.0, 600.0)}  # fmt: skip
HIDDEN = ("thermal_lag", "thermal_hysteresis", "warm_up", "bias_ramp", "temperature")
MULTIPLE = 2.0
MINUTES = 25.0
"""After which no further trial is begun: the tables say how many there were."""


def recorded(seed: int, effects=(), warming: bool = False):
    """A chamber of two cycles, or a warm-up that goes one way."""
    unit = draw_imu(seed).with_effects(*effects)
    if warming:
        return simulate(unit, Static(1800.0), consumer_noise(), rate=1.0, seed=seed, environment=WARMING)[0]
    return simulate(unit, CYCLES, consumer_noise(), rate=1.0, seed=seed)[0]


@cache
def noise_of(seed: int) -> NoiseModel:
    """The noise that an hour at rest at one temperature tells."""
    return fit_noise(simulate(draw_imu(seed), Static(3600.0), consumer_noise(), rate=1.0, seed=seed + 500_000)[0])


@cache
def asked(seed: int, warming: bool):
    """The same recording without anything hidden, as an experiment, and its base fit."""
    quiet = diagnose_thermal(recorded(seed, (), warming), static=noise_of(seed))
    return quiet.experiment, quiet.base


def drawn(seed: int, name: str, warming: bool):
    """An effect at twice its detection limit in this recording, in a random direction."""
    rng, kind = np.random.default_rng([seed, HIDDEN.index(CATALOGUE[name].plain)]), CATALOGUE[name]
    inner = {}
    if kind.plain in INNER:
        key, low, high = INNER[kind.plain]
        inner = {key: float(np.exp(rng.uniform(np.log(low), np.log(high))))}
    direction = rng.normal(size=kind.size)
    experiment, state = asked(seed, warming)
    columns = experiment.dormant_columns(state.imu, state.linear.details, {kind: [inner]})[kind][0]
    change = state.weights @ (columns @ direction)
    basis = np.linalg.svd(state.evidence.jacobian, full_matrices=False)[0]
    length = float(np.linalg.norm(change - basis @ (basis.T @ change)))
    return kind.make(MULTIPLE * np.sqrt(limit_noncentrality(kind.size)) / length * direction, **inner)


def trial(seed: int, name: str = "", warming: bool = False, known: bool = True) -> dict[str, Any]:
    """Hide, record, diagnose: what was said of it."""
    effects = [drawn(seed, name, warming)] if name else []
    start = time.perf_counter()
    found = diagnose_thermal(recorded(seed, effects, warming), static=noise_of(seed) if known else None)
    first = found.effects[0] if found.effects else None
    return {
        "seed": seed, "hidden": name, "warming": warming, "known": known, "verdict": found.verdict,
        "alarm": found.verdict != "adequate",
        "named": [each.name for each in found.effects], "first": first is not None and first.name == name,
        "in_set": any(name in (each.name, *each.rivals) for each in found.effects),
        "rivals": [] if first is None else list(first.rivals), "cycle": "cycle" in found.suggestion,
        "seconds": time.perf_counter() - start,
    }  # fmt: skip


def main() -> None:
    """Run all parts."""
    small = arguments(__doc__).small
    quiet = [(False, True, 200), (False, False, 20), (True, True, 60)]
    hide = [(False, plain) for plain in HIDDEN] + [(True, "temperature"), (True, "warm_up")]
    each_of = 1 if small else 20
    tasks = [(10_000 + 1000 * warming + 2000 * known + k, "", warming, known)
             for warming, known, count in quiet for k in range(1 if small else count)]  # fmt: skip
    tasks += [(50_000 + 1000 * warming + k, f"{('accel', 'gyro')[k % 2]}.{plain}", warming, True)
              for warming, plain in hide for k in range(each_of)]  # fmt: skip
    rows, order = [], np.random.default_rng(0).permutation(len(tasks))  # so that what fits is a share of each
    started = time.perf_counter()
    for k in order:
        rows.append(trial(*tasks[k]))
        if time.perf_counter() - started > 60 * MINUTES:
            break
    alarms = Table("Nothing hidden: false alarms, 95 % interval", ["recording", "noise from", "trials", "alarms"])
    power = Table(f"One effect at {MULTIPLE:g} times its detection limit",
                  ["recording", "effect", "trials", "detected", "named first", "in the set", "tied",
                   "asks for a cycle"],
                  "With 95 % intervals; tied: with a rival in the set.")  # fmt: skip
    where = {False: "two cycles", True: "warm-up, one way"}
    for warming, known, _ in quiet:
        found = [row for row in rows if (row["hidden"], row["warming"], row["known"]) == ("", warming, known)]
        if not found:
            continue
        alarms.add(where[warming], "an hour at rest" if known else "itself", f"{len(found)}",
                   share(sum(each["alarm"] for each in found), len(found)))  # fmt: skip
    for warming, plain in hide:
        found = [row for row in rows if row["hidden"].endswith(f".{plain}") and row["warming"] == warming]
        if not (total := len(found)):
            continue
        shares = [share(sum(each[key] for each in found), total) for key in ("alarm", "first", "in_set")]
        power.add(where[warming], plain, f"{total}", *shares, f"{sum(bool(each['rivals']) for each in found)}",
                  f"{sum(each['cycle'] for each in found)}")  # fmt: skip
    finish("thermal_diagnosis", [alarms, power], {"trials": rows}, keep=not small)


if __name__ == "__main__":
    main()
