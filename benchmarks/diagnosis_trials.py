"""What a diagnosis says of everyday recordings that statistics can trip over: drift, outliers, sway, lag and so on.

The recordings come from `tests/hidden_effects.py` and `tests/everyday.py`, which know nothing of this library. Each is
diagnosed with half an hour at rest, and without. Sizes in detection limits are those of `diagnosis.py`. `--small` runs
two of each.
"""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
import tempfile
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import jax
import numpy as np
from common import Table, arguments, finish
from diagnosis import GRAVITY, sized
from false_alarms import USUAL

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import hidden_effects as hidden
from everyday import Trial, instants, swaying, with_jitter, with_losses, with_outliers

from jaximu import JaximuError, diagnose, read_recording
from jaximu.noise.at_rest import fit_noise

jax.config.update("jax_enable_x64", True)


@dataclass(frozen=True)
class Cell:
    """A kind of recording: the options of its protocol, what is hidden, at how many detection limits or in units (by
    name), what is done to it; the names that would be right, and whether nothing else may be named."""

    options: dict
    names: tuple[tuple[str, ...], ...] = ((),)
    multiples: tuple[float, ...] = ()
    scales: dict[str, tuple[float, float]] | None = None
    change: dict | None = None
    amounts: tuple = (None,)
    right: str = "adequate"


def one_of(*kinds):
    return tuple((name,) for name in kinds)


def everyday(kind):
    return one_of(f"everyday.accel_{kind}", f"everyday.gyro_{kind}")


CALLED = {
    f"everyday.{sensor}_{kind}": f"{sensor}.{name}" for sensor in ("accel", "gyro")
    for kind, name in (("scale_jump", "scale_step"), ("scale_drift", "scale_ramp"))
}  # fmt: skip
STRONG = one_of(*(f"{s}.{kind}" for s in ("accel", "gyro") for kind in ("quadratic", "cubic", "asymmetry")))
CELLS = {
    "a: bias instability ten times": Cell({"flicker": 10 / USUAL}),
    "b: 0.1 % outliers": Cell({}, change={"logged": with_outliers, "always": True}, amounts=(1e-3,)),
    "c: sway": Cell({}, change={"moved": swaying}, amounts=(0.02, 0.05, 0.1, 0.3)),
    "c: sway, g-sensitivity": Cell(
        {}, one_of("gyro.g_sensitivity"), scales={"gyro.g_sensitivity": (20.0, 20.0)}, change={"moved": swaying},
        amounts=(0.02, 0.05, 0.1, 0.3), right="hidden",
    ),
    "d: Earth's rotation and asymmetry": Cell(
        {}, (("gyro.earth_rotation", "accel.asymmetry"),),
        scales={"gyro.earth_rotation": (1.0, 1.0), "accel.asymmetry": (1.63, 1.63)}, right="hidden",
    ),
    "e: lag, axes move, k = 4": Cell({"two_axes": True}, one_of("gyro.lag"), (4.0,), right="hidden"),
    "e: lag 0.6–3 ms, axes move": Cell(
        {"two_axes": True}, one_of("gyro.lag"), scales={"gyro.lag": (1.2, 6.0)}, right="hidden"
    ),
    "f: strong": Cell({}, STRONG, (50.0, 90.0, 130.0), right="hidden"),
    "g: slow sine": Cell({}, one_of("everyday.gyro_sine"), (8.0,), right="unexplained"),
    "h: scale jumps": Cell({}, everyday("scale_jump"), (8.0,), right="hidden"),
    "h: scale drifts": Cell({}, everyday("scale_drift"), (8.0,), right="hidden"),
    "h: 0.1 % lost": Cell({}, change={"logged": with_losses}, amounts=(1e-3,), right="data.lost_samples"),
    "i: quartic": Cell({}, everyday("quartic"), (8.0, 20.0, 60.0), right="unexplained"),
    "j: jitter": Cell({}, change={"logged": with_jitter}, amounts=(2e-3,), right="data.jitter"),
    "k: instants, 25 Hz": Cell(
        {"rate": 25.0, "oversampling": 9}, change={"moved": instants}, amounts=(9,), right="adequate"
    ),
    "k: instants, axes move, 25 Hz": Cell(
        {"rate": 25.0, "oversampling": 9, "two_axes": True}, change={"moved": instants}, amounts=(9,)
    ),
    "k: instants, axes move, 100 Hz": Cell(
        {"oversampling": 9, "two_axes": True}, change={"moved": instants}, amounts=(9,)
    ),
}  # fmt: skip


def drawn(cell, seed, folder):
    """The case of a cell: what is hidden, at its size."""
    random = np.random.default_rng([seed, 99])
    asked = CELLS[cell]
    names = asked.names[seed % len(asked.names)]
    plain = hidden.draw_case(seed, names, static_minutes=30, **asked.options)
    amount = asked.amounts[seed % len(asked.amounts)]
    hiding = list(plain.hidden)
    if "gyro.lag" in names:  # of one axis
        axis = np.zeros(3)
        axis[random.integers(3)] = 5e-4
        hiding = [replace(each, unit_coefficients=axis) for each in hiding]
    case = Trial(plain.protocol, tuple(hiding), amount=amount, **(asked.change or {}))
    if asked.scales:
        return case.with_size({name: random.uniform(*asked.scales[name]) for name in names})
    if asked.multiples:
        noise = fit_noise(read_recording(case.write(folder / "noise", ("static",))["static"]))
        case = sized(case, folder, noise, [asked.multiples[seed % len(asked.multiples)]])
        assert case is not None
    return case


def trial(task):
    """Simulate, write, diagnose with and without a recording at rest: what was said."""
    cell, seed = task
    found = []
    with tempfile.TemporaryDirectory() as name:
        case = drawn(cell, seed, Path(name))
        files = case.write(Path(name) / "case", ("fit", "static"))
        for static in (True, False):
            told = {"cell": cell, "seed": seed, "static": static, "amount": case.amount,
                    "hidden": {each.name: each.coefficients.tolist() for each in case.hidden}}  # fmt: skip
            try:
                said = diagnose(
                    read_recording(files["fit"]), GRAVITY, static=read_recording(files["static"]) if static else None
                )
            except JaximuError as error:
                found.append(told | {"verdict": "refused", "named": [], "preflight": [], "text": str(error)})
                continue
            found.append(told | {
                "verdict": said.verdict,
                "named": [each.name for each in said.effects],
                "rivals": [list(each.rivals) for each in said.effects],
                "preflight": [each.name for each in said.preflight],
                "learned": next((curve.effect.name for curve in said.curves), None),
                "p_value": said.p_value,
                "text": " ".join(said.summary().verdict),
                "notes": list(said.notes),
            })  # fmt: skip
    return found


def right(each):
    """Whether what was said is what the cell deserves."""
    wanted, named = CELLS[each["cell"]].right, set(each["named"])
    if wanted == "hidden":
        truth = {CALLED.get(name, name) for name in each["hidden"]}
        sets = [{name, *rivals} for name, rivals in zip(each["named"], each.get("rivals", []), strict=True)]
        return each["verdict"] == "effects" and len(sets) == len(truth) and all(truth & own for own in sets)
    if wanted.startswith("data."):
        return wanted in each["preflight"] and not named
    return each["verdict"] == wanted and not named


def main():
    """Run all cells in two processes and keep the table."""
    options = arguments(__doc__)
    count = 2 if options.small else 12
    todo = [(cell, 1000 * (1 + place) + number) for place, cell in enumerate(CELLS) for number in range(count)]
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        done = [each for found in pool.map(trial, todo) for each in found]
    table = tabulated(done)
    kept = [each | {"right": right(each)} for each in done]
    finish("diagnosis_trials", [table], {"trials": kept}, keep=not options.small)


def tabulated(done):
    """The table of what was said."""
    table = Table(
        "What is said of everyday recordings", ["recording", "at rest before", "right", "trials", "verdicts", "named",
                                                "said of the samples"],
    )  # fmt: skip
    for cell in CELLS:
        for static in (True, False):
            results = [each for each in done if each["cell"] == cell and each["static"] == static]
            if not results:
                continue
            listed = [
                ", ".join(f"{name} {count}" for name, count in sorted(Counter(counted).items()))
                for counted in (
                    [each["verdict"] for each in results],
                    [name for each in results for name in set(each["named"])],
                    [name for each in results for name in set(each["preflight"])],
                )
            ]
            table.add(cell, "yes" if static else "no", sum(map(right, results)), len(results), *listed)
    return table


if __name__ == "__main__":
    main()
