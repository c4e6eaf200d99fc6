"""The page of a plan: the poses drawn, how to record them, the turns, and what they are expected to gain."""

import textwrap
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaximu.estimation.problem import Name
from jaximu.estimation.projection import output_uncertainty
from jaximu.estimation.uncertainty import describe, spoken_amount
from jaximu.ground.page import Page, Picture, Section, Statement, Table
from jaximu.ground.quantities import Z95, number, plain
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.planning import Proposal
from jaximu.report import figures
from jaximu.report.box import AXES_WORDS, draw_floor, draw_unit
from jaximu.report.canvas import Figure
from jaximu.report.uncertainty import Known, Rest, over_sphere, sphere_figure, steady

_COLUMNS = 3
_ABOVE = 0.08  # inches between the figure's edge and its title, for which the layout keeps a line
_CRITERIA = {
    "D": "the geometric mean of the standard deviations (in typical sizes)",
    "A": "the root mean square of the standard deviations (in typical sizes)",
}


def page_of(proposal: Proposal) -> Page:
    """Return the poses, how to record them, and what they are expected to gain."""
    equipment = proposal.equipment
    poses = f"{len(proposal.poses)} poses {equipment.words}"
    return Page(
        f"{poses} to record next, {equipment.rest:g} s each",
        tuple(_verdict(proposal)),
        f"{_times(proposal.gain)}×",
        f"smaller uncertainty expected than with {Path(proposal.source).name} alone",
        (
            Section("The poses", [_picture(proposal), *_map(proposal), *_instructions(proposal), _poses(proposal)]),
            *_turns(proposal),
            Section("What they are expected to gain", [_parameters(proposal)]),
            Section(
                "What stays open",
                [Statement("Weak" if one.determined else "Not determined", one.text, True) for one in proposal.open],
            ),
        ),
        notes=proposal.notes,
        next=_next(proposal),
    )


# --- words ------------------------------------------------------------------------------------------------------------


def _times(ratio: float) -> str:
    """Return a ratio with three digits, without a power of ten where a person would use none."""
    return plain(float(f"{ratio:.3g}"))


def _verdict(proposal: Proposal) -> Iterator[str]:
    name = _parameter(proposal)
    what = "the uncertainties" if name is None else f"the uncertainty of the {describe(name, proposal.imu)}"
    average = " on average" * (name is None)
    yield f"These {len(proposal.poses)} poses shrink {what} {_times(proposal.gain)} times{average}."
    count = len(proposal.names)
    determined = "all" if proposal.rank == count else f"{proposal.rank} of"
    yield f"Together with what is known they determine {determined} {count} parameters."


def _parameter(proposal: Proposal) -> Name | None:
    """Return the parameter whose uncertainty is the criterion; None where it is that of all."""
    return next((name for name in proposal.names if name == proposal.criterion), None)


def _criterion(proposal: Proposal) -> str:
    before, after = number(proposal.criterion_before), number(proposal.criterion_after)
    if _parameter(proposal) is None:
        text = f"The poses minimise {_CRITERIA[proposal.criterion]}, which falls from {before} to {after}."
    else:
        text = "The poses minimise the standard deviation in the first row."
    if proposal.equipment.in_sequence:
        return text
    loss = 100 * proposal.rounding_loss
    return f"{text} Rounding the angles {f'makes it larger by {loss:.2g} %' if loss > 0.005 else 'costs nothing'}."


def _instructions(proposal: Proposal) -> Iterator[str]:
    equipment = proposal.equipment
    yield f"Hold each pose for {equipment.rest:g} s, perfectly still."
    if equipment.by_hand:
        yield (
            f"From one to the next, turn the direct way in about {equipment.turn:g} s, and record without a break. "
            "A pose that is missed by some ten degrees costs little: the recording shows its true orientation."
        )
    elif equipment.robot:
        yield (
            f"From one to the next, turn about the stated axis in {equipment.turn:g} s, the rate rising in the first "
            "fifth of it and falling in the last. Record without a break, and log the robot's attitude throughout: its "
            f"noise is taken as {equipment.accuracy:g}° (1 σ, each axis) at each stamp, independent of the others. "
            "schedule.csv holds rests and turns in this order."
        )
    elif equipment.in_sequence:
        yield (
            "Start at rest in the first pose, and record all of it without a break. Each rotation takes "
            f"{equipment.turn:g} s and goes about the named axis of the unit, by the right-hand rule. schedule.csv "
            "holds positions and rotations in this order."
        )


def _next(proposal: Proposal) -> str:
    equipment = proposal.equipment
    command, earlier = "turntable LOG --reference schedule.csv", ""
    if equipment.by_hand:
        command, earlier = "calibrate LOG", " with earlier recordings beside LOG"
    elif equipment.robot:
        command = "reference LOG --reference REF"
    elif equipment.in_sequence:
        command = "filter LOG"
    return f"record the poses, then run `jaximu {command} -o RESULTS`{earlier}."


# --- tables -----------------------------------------------------------------------------------------------------------


def _poses(proposal: Proposal) -> Table:
    chained = proposal.equipment.chained
    turns = ["", *(turn.words for turn in proposal.turns)] if proposal.turns else [""] * len(proposal.poses)
    legend = "The top is the face that +z leaves, the bottom the one opposite."
    if any(" corner " in pose.words for pose in proposal.poses):
        legend += " A corner lies halfway, at 45°, between the two sides."
    return Table(
        ("", "pose", *(["turn to it"] if chained else [])),
        [
            (str(index + 1), pose.words, *([turns[index]] if chained else []))
            for index, pose in enumerate(proposal.poses)
        ],
        legend,
    )


def _turns(proposal: Proposal) -> Iterator[Section]:
    if proposal.turns and not proposal.equipment.chained:
        rows = [(str(index), turn.words) for index, turn in enumerate(proposal.turns, 1)]
        yield Section(
            f"{len(rows)} turns",
            [
                "About the vertical axis of the table, the unit mounted as the turn says. schedule.csv holds poses and "
                "turns in this order; correct its times once they are done.",
                Table(("", "turn"), rows),
            ],
        )


def _parameters(proposal: Proposal) -> Table:
    def interval(name: Name, sigma: float) -> str:
        return f"± {spoken_amount(name, Z95 * sigma, proposal.imu)}"

    first = _parameter(proposal)
    sigmas = zip(proposal.names, proposal.before, proposal.after, strict=True)
    caption = "A prediction from the noise, to first order, without errors of the set-up; ± is 95 %."
    return Table(
        ("parameter", "known", "after these poses", "times smaller"),
        [
            (describe(name, proposal.imu), interval(name, before), interval(name, after), f"{_times(before / after)}×")
            for name, before, after in sorted(sigmas, key=lambda row: (row[0] != first, -row[1] / row[2]))
        ],
        f"{_criterion(proposal)} {caption}",
        [0] if first else [],
        brief=8,
    )


# --- the picture ------------------------------------------------------------------------------------------------------


def _picture(proposal: Proposal) -> Picture:
    equipment = proposal.equipment
    if equipment.by_hand:
        view = "The unit as the person who holds it sees it, a little from above."
    elif equipment.chained:
        view = "Seen a little from above; headings are counted from an arbitrary zero."
    else:
        view = "Seen a little from above; the heading on the table does not matter."
    return Picture("poses", partial(_poses_figure, proposal), "The unit drawn in each pose", f"{view} {AXES_WORDS}")


def _map(proposal: Proposal) -> Iterator[Picture]:
    """Return how uncertain the corrected force is before the poses, or after them where it is open until then."""
    gravity = np.outer(proposal.by_gravity, proposal.by_gravity)
    rest = partial(steady, gravity=STANDARD_GRAVITY, temperature=proposal.imu.accelerometer.temperature_reference)
    for covariance, when in zip(proposal.covariances, ("Before", "After"), strict=True):
        known = partial(output_uncertainty, proposal.imu, proposal.names, covariance - gravity)
        if np.isfinite(known(rest(np.eye(3)))["accelerometer"].largest).all():
            up = np.array([pose.up for pose in proposal.poses])
            names = [f"pose {index}: {pose.words}" for index, pose in enumerate(proposal.poses, 1)]
            yield Picture(
                "orientations",
                partial(_map_figure, known, rest, up, names, f"{when} these poses, least certain"),
                "The next poses on a map of the uncertainty of the corrected specific force at rest over orientation",
                "Colours: 95 % of the corrected specific force at rest over the direction that points up in the body, "
                "without gravity's own error. Numbers: the poses to record.",
            )
            return


def _map_figure(known: Known, rest: Rest, *poses: Any) -> Figure:
    return sphere_figure(over_sphere(known, rest), *poses)


def _poses_figure(proposal: Proposal) -> Figure:
    count = len(proposal.poses)
    rows = -(-count // _COLUMNS)
    figure = figures.new_figure(0.6 + 4.2 * rows)
    grid = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    for axes in grid:
        axes.set_axis_off()
        axes.set_aspect("equal")
    for index, (axes, pose) in enumerate(zip(grid, proposal.poses, strict=False), 1):
        draw_floor(axes, proposal.equipment.by_hand)
        draw_unit(axes, Rotation.from_quat(pose.attitude, scalar_first=True).as_matrix())
        axes.set_title(f"{index}", loc="left", fontsize=12, fontweight="bold")
        axes.set_ylim(-2.6, 1.35)  # the words stand below
        folded = "\n".join(line for part in pose.words.split("; ") for line in textwrap.wrap(part, 36))
        axes.text(0.0, -1.75, folded, ha="center", va="top", fontsize=9.5)
    figure.suptitle(
        f"{count} poses {proposal.equipment.words}: {proposal.equipment.rest:g} s at rest in each",
        fontsize=12,
        fontweight="bold",
        y=1 - _ABOVE / figure.get_figheight(),
    )
    return figure
