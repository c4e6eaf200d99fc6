"""`jaximu plan`: which poses and turns to record next, and what they buy."""

from __future__ import annotations

import math
from dataclasses import MISSING, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

import jaximu
from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.cli.options import option, switch, takes_options
from jaximu.ground.errors import InputError

if TYPE_CHECKING:
    from jaximu.planning import Known


@takes_options
class PlanCommand(options.Reads):
    """Plan which poses and turns to record next, to reduce the largest uncertainties.

    A LOG is calibrated first; of a SPEC, as for `jaximu simulate`, only the data sheet is known. DIR receives
    plan.json, report.html, poses.png and, for a table or a robot, schedule.csv.

    Examples:
      jaximu plan results/calibration.json -o plan
      jaximu plan log.csv --poses 8
      jaximu plan unit.toml --equipment table --poses 20
      jaximu plan unit.toml --equipment robot --accuracy 0.02 --fastest 45
      jaximu plan unit.toml --for filter --effect accel.size_effect

    """

    source: Path = option("CALIBRATION|LOG|SPEC", "What is known about the unit.", MISSING, Positional)
    equipment: Literal["hands", "table", "dividing-head", "robot"] = switch(
        "What turns the unit. robot: a robot, or anything whose attitude is tracked.", "hands"
    )
    purpose: Literal["fit", "filter"] = switch(
        "What evaluates it. filter: a sequence of positions on a table, for `jaximu filter`.", "fit", name="for"
    )
    effect: options.EffectNames = ()
    poses: int | None = option("N", "Number of poses (default: 12, and 19 positions for the filter).")
    turns: int | None = option("N", "Number of turns of the table (default: as many as poses).")
    criterion: Literal["D", "A"] = switch(
        "What to minimise. D: the volume of the uncertainty; A: the mean variance.", "D"
    )
    parameter: str | None = option(
        "NAME", "Minimise the uncertainty of this parameter instead: accelerometer.gain[1,0]."
    )
    rest: float | None = option("S", "Seconds at rest in each pose.")
    turn: float | None = option("S", "Seconds of each turn.")
    fastest: float | None = option("DEG/S", "Largest rate of the table or robot.")
    accuracy: float | None = option("DEG", "Noise (1 σ, each axis) of the attitude that the robot or tracker reports.")
    step: float | None = option("DEG", "Round angles to multiples of this.")
    seed: int = option("N", "Random seed of the search.", 0)

    def run(self) -> None:
        """Do what the command line says."""
        options.require_files(self.source)
        from jaximu.planning import EQUIPMENT, FILTERED, propose, propose_sequence

        filtered = self.purpose == "filter"
        if filtered and (
            self.equipment in ("dividing-head", "robot") or self.turns is not None or self.step is not None
        ):
            raise InputError(
                "--for filter plans rotations by 90° and 180° of a table, one after each position: leave --turns, "
                "--step and other equipment out."
            )
        if self.effect and not filtered:
            raise InputError("--effect names states of the filter: add --for filter.")
        chosen = FILTERED if filtered else EQUIPMENT[self.equipment]
        count = (19 if filtered else 12) if self.poses is None else self.poses
        stated = {name: getattr(self, name) for name in ("rest", "turn", "fastest", "step", "accuracy")}
        if self.fastest is not None and (chosen.by_hand or not 0 < self.fastest < math.inf):
            raise InputError("--fastest is the largest rate of a table, in °/s: greater than zero, and not for hands.")
        if self.accuracy is not None and chosen.accuracy is None:
            raise InputError("--accuracy is of the attitude that a robot or tracker reports: add --equipment robot.")
        if self.turns is not None and chosen.chained:
            how = "by hand" if chosen.by_hand else "on a robot"
            raise InputError(f"--turns goes with a table: {how} each pose but the first is reached by one turn.")
        chosen = replace(chosen, **{name: value for name, value in stated.items() if value is not None})
        self.results.prepare()
        known, magnetometer = _known(self.source, self.log, self.local)
        if known is None:  # a magnetometer by itself
            print(magnetometer)
            return
        with progress("planning") as report:
            if filtered:
                proposal = propose_sequence(
                    known,
                    chosen,
                    count,
                    self.criterion,
                    self.parameter,
                    options.effects_of(self.effect)["effects"],
                    report=report,
                )
            else:
                proposal = propose(known, chosen, count, self.criterion, self.parameter, self.turns, self.seed, report)
        if magnetometer is not None:
            proposal = replace(proposal, notes=(*proposal.notes, magnetometer))
        self.results.present(
            proposal.summary,
            "plan.json, report.html and the poses drawn",
            {} if chosen.by_hand else {"schedule.csv": proposal.schedule.encode()},
            plan=proposal,
        )


def _known(path: Path, log: options.LogOptions, local: options.GravityOptions) -> tuple[Known | None, str | None]:
    """Tell by content what the argument is: calibration.json, a specification, else a log.

    Second, what its magnetometer lacks, where it has one; the first is None where it has nothing else.
    """
    from jaximu.planning import Known
    from jaximu.simulation import read_specification

    if options.beginning(path).lstrip()[:1] == b"{":
        if local != options.LOCAL:
            raise InputError(f"{path} states the gravity it was made with: leave --gravity and --latitude out.")
        calibration, magnetometer = jaximu.load_calibration(path), None
        directions = (calibration.magnetic or {}).get("next")
        if directions is not None:
            from jaximu.report.magnetometer import next_words

            magnetometer = f"Magnetometer: {next_words(directions)}"
            if "accelerometer" not in calibration.triads():
                return None, magnetometer
        return Known.from_calibration(calibration.inertial(), str(path)), magnetometer
    if options.is_toml(path):
        if local != options.LOCAL:
            raise InputError(f"{path}: a specification states its gravity in [environment]; leave the option out.")
        return Known.from_specification(read_specification(path)), None
    gravity = local.value()
    try:
        recordings, _ = log.read_unit((path,), gravity)
    except InputError as error:
        raise InputError(f"{path} is neither a calibration nor a specification, and as a log: {error}") from error
    with progress("calibrating"):
        return Known.from_calibration(jaximu.calibrate(recordings, gravity), str(path)), None
