"""`jaximu demo`: the main job on a simulated unit, no input needed."""

from __future__ import annotations

from pathlib import Path

import jaximu
from jaximu.cli import options
from jaximu.cli.diagnose import give_diagnosis
from jaximu.cli.messages import progress
from jaximu.cli.options import option, takes_options
from jaximu.ground.errors import InputError
from jaximu.ground.gravity import LocalGravity

_HIDDEN = {
    "accel.quadratic": 3e-4,
    "accel.asymmetry": 2e-3,
    "accel.cross_coupling": 2e-4,
    "accel.temperature": 4e-3,
    "gyro.g_sensitivity": 2e-4,
    "gyro.temperature": 3e-4,
}
"""Effects that the demonstration may hide, and the largest coefficient: a few times what the noise would cover."""


@takes_options
class DemoCommand:
    """Simulate a unit with a hidden flaw, diagnose it and write a report: no recording needed.

    Examples:
      jaximu demo
      jaximu demo --effect gyro.g_sensitivity -o demo
      jaximu demo --data phone

    """

    seed: int = option("N", "Random seed of the unit and its noise.", 0)
    effect: str | None = option("NAME", "Effect to hide (default: the seed chooses one).")
    data: Path | None = option("DIR", "Only write a simulated phone's recording there, to try commands on.")
    output: Path = option("DIR", "Folder for recording and report.", Path("jaximu-demo"), aliases=["-o"])
    force: options.ForceFlag = False

    def run(self) -> None:
        """Do what the command line says."""
        if self.data is not None:
            _write_phone(self.data)
            return
        if self.seed < 0:
            raise InputError(f"--seed must not be negative, found {self.seed}.")
        if self.effect is not None and self.effect not in _HIDDEN:
            raise InputError(f"the demonstration hides one of {', '.join(_HIDDEN)}, not {self.effect!r}.")
        results = options.Results(self.output, force=self.force)
        results.prepare(*options.INERTIAL)
        with progress("simulating"):
            from jaximu.simulation import draw_imu

            flaw = _draw_flaw(self.seed, self.effect)
            imu = draw_imu(self.seed).with_effects(flaw)
            _simulate(imu, self.seed, self.output)
        with progress("diagnosing"):
            recording, heldout, rest = (
                jaximu.read_recording(self.output / f"{n}.parquet") for n in ("recording", "heldout", "rest")
            )
            diagnosis = jaximu.diagnose(recording, LocalGravity(9.80665, 0.0), static=rest, heldout=heldout)
        give_diagnosis(diagnosis, results)
        _print_truth(imu, flaw)


def _write_phone(folder: Path) -> None:
    """Write the recording that comes with the package, as phyphox exports one; notebooks/phone.py made it."""
    import zipfile
    from importlib.resources import files

    from jaximu.ground.atomic import write_folder

    with files("jaximu.simulation").joinpath("phone.zip").open("rb") as file, zipfile.ZipFile(file) as archive:
        accelerometer, _ = write_folder(folder, {name: archive.read(name) for name in archive.namelist()})
    print(f"Written to {folder}: a simulated phone's recording. Next: jaximu info {accelerometer}")


def _simulate(imu: jaximu.Imu, seed: int, output: Path) -> None:
    """Write three recordings of a unit: two of poses while it warms up, one at rest without its flaw."""
    from jaximu.simulation import consumer_noise, simulate
    from jaximu.simulation.protocols import Environment, HandHeld, Static

    for number, name in enumerate(("recording", "heldout")):
        # up and down: on a straight line temperature and time would be one cause
        warming = Environment(temperature=[[0, 22 - 4 * number], [120, 34 + 4 * number], [220, 27]])
        simulated, truth = simulate(imu, HandHeld(), consumer_noise(), seed=seed, power_on=number, environment=warming)
        jaximu.write_recording(simulated, output / f"{name}.parquet")
        truth.save(output / f"{name}.parquet.truth.json")
    resting, _ = simulate(imu.with_effects(), Static(1200.0), consumer_noise(), seed=seed, power_on=2)
    jaximu.write_recording(resting, output / "rest.parquet")


def _print_truth(imu: jaximu.Imu, flaw: jaximu.Effect) -> None:
    import numpy as np

    from jaximu.ground.quantities import number, readable
    from jaximu.report.terminal import show

    (triad,) = (triad for triad in imu.triads().values() if triad.effects)
    values = np.asarray(flaw.coefficients)
    factor, unit = readable(flaw.coefficient_unit(triad.output_unit), float(np.abs(values).max()))
    coefficients = ", ".join(number(factor * value) for value in values)
    show(
        f"\nHidden in this unit was {flaw.title}: {flaw.formula} with c = ({coefficients}) {unit}. "
        f"`jaximu effects {flaw.name}` explains it."
    )


def _draw_flaw(seed: int, name: str | None) -> jaximu.Effect:
    import numpy as np

    generator = np.random.default_rng([seed, 3])
    chosen = str(generator.choice(sorted(_HIDDEN))) if name is None else name
    size = jaximu.CATALOGUE[chosen].size
    return jaximu.CATALOGUE[chosen].make(
        _HIDDEN[chosen] * generator.choice([-1, 1], size) * generator.uniform(0.3, 1, size)
    )
