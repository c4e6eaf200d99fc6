"""`jaximu demo`: the main job on a simulated unit, no input needed."""

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from jaximu.cli.calibrate import prepare_folder
from jaximu.cli.diagnose import print_diagnosis, write_results
from jaximu.cli.options import progress
from jaximu.diagnosis import diagnose
from jaximu.effects import CATALOGUE, Effect
from jaximu.errors import InputError
from jaximu.formats import read_recording, write_recording
from jaximu.gravity import LocalGravity
from jaximu.protocols import Environment, HandHeld, Static
from jaximu.simulation import consumer_noise, draw_imu, simulate

__all__ = ["run"]

_HIDDEN = {
    "accel.quadratic": 3e-4,
    "accel.asymmetry": 2e-3,
    "accel.cross_coupling": 2e-4,
    "accel.temperature": 4e-3,
    "gyro.g_sensitivity": 2e-4,
    "gyro.temperature": 3e-4,
}
"""Effects that the demonstration may hide, and the largest coefficient: a few times what the noise would cover."""


def run(
    *,
    seed: int = 0,
    effect: Annotated[
        str | None, tyro.conf.arg(metavar="NAME", help="Effect to hide; by default the seed chooses one.")
    ] = None,
    output: Annotated[
        Path, tyro.conf.arg(name="output", aliases=["-o"], metavar="DIR", help="Folder for recording and report.")
    ] = Path("jaximu-demo"),
) -> None:
    """Simulate a unit with a hidden flaw, calibrate it, name the flaw and measure what extending the model gains."""
    from rich.console import Console

    if seed < 0:
        raise InputError(f"--seed must not be negative, found {seed}.")
    console = Console()
    gravity = LocalGravity(9.80665, 0.0)
    flaw = _draw_flaw(seed, effect)
    imu = draw_imu(seed).with_effects(flaw)
    prepare_folder(output)
    with progress("simulating"):
        for place, name in enumerate(("recording", "heldout")):
            # up and down: on a straight line temperature and time would be one cause
            warming = Environment(temperature=[[0, 22 - 4 * place], [120, 34 + 4 * place], [220, 27]])
            simulated, truth = simulate(
                imu, HandHeld(), consumer_noise(), seed=seed, power_on=place, environment=warming
            )
            write_recording(simulated, output / f"{name}.parquet")
            truth.save(output / f"{name}.parquet.truth.json")
        resting, _ = simulate(imu.with_effects(), Static(1200.0), consumer_noise(), seed=seed, power_on=2)
        write_recording(resting, output / "rest.parquet")
    recording, heldout, rest = (read_recording(output / f"{n}.parquet") for n in ("recording", "heldout", "rest"))
    with progress("diagnosing"):
        diagnosis = diagnose(recording, gravity, static=rest, heldout=heldout)
    print_diagnosis(diagnosis)
    coefficients = ", ".join(f"{value:.2e}" for value in np.asarray(flaw.coefficients))
    (triad,) = (triad for triad in imu.triads().values() if triad.effects)
    console.print(
        f"\nHidden in this unit was {flaw.name}, {flaw.formula} with c = ({coefficients}) "
        f"{flaw.coefficient_unit(triad.output_unit)}; see jaximu effects {flaw.name}.",
        highlight=False,
    )
    write_results(diagnosis, output)


def _draw_flaw(seed: int, name: str | None) -> Effect:
    generator = np.random.default_rng([seed, 3])
    chosen = str(generator.choice(sorted(_HIDDEN))) if name is None else name
    if chosen not in _HIDDEN:
        raise InputError(f"the demonstration hides one of {', '.join(_HIDDEN)}, not {chosen!r}.")
    size = CATALOGUE[chosen].size
    return CATALOGUE[chosen].make(_HIDDEN[chosen] * generator.choice([-1, 1], size) * generator.uniform(0.3, 1, size))
