"""The report of a plan: the poses drawn, the turns, and what they are expected to gain."""

from __future__ import annotations

import textwrap
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from jaximu.estimation.problem import Name
from jaximu.estimation.uncertainty import describe, spoken_amount
from jaximu.ground.array_types import FloatArray
from jaximu.ground.quantities import Z95
from jaximu.planning import Proposal
from jaximu.report import figures
from jaximu.report.html import Folder, TextRows, write_page

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["gain_words", "pose_rows", "sigma_rows", "turn_rows", "write_plan"]

_COLUMNS = 3
_ABOVE = 0.08  # inches between the figure's edge and its title, for which the layout keeps a line
_ELEVATION, _SIDE = np.radians(20.0), np.radians(-15.0)  # the person looks down a little, and a little from the right
_CRITERIA = {
    "D": "the geometric mean of the standard deviations (in typical sizes)",
    "A": "the root mean square of the standard deviations (in typical sizes)",
}


def write_plan(proposal: Proposal, folder: Folder) -> Path:
    """Write `report.html`, whose path is returned, and `poses.png`. Raises `InputError` where they cannot be."""
    return write_page(
        folder,
        "plan",
        {"poses": partial(_poses_figure, proposal)},
        title=f"{len(proposal.poses)} poses to record next",
        lead=gain_words(proposal),
        number=f"{proposal.gain:.3g}×",
        meaning=f"smaller uncertainty than with {Path(proposal.source).name} alone",
        proposal=proposal,
        poses=pose_rows(proposal),
        turns=turn_rows(proposal),
        rows=sigma_rows(proposal),
        notes=proposal.notes,
        open=[("Weak" if weak.determined else "Not determined", weak.text) for weak in proposal.open],
    )


def pose_rows(proposal: Proposal) -> TextRows:
    """Return each pose's number, words and, by hand and on a robot, the turn to it."""
    turns = ["", *(turn.words for turn in proposal.turns)]
    return [
        (str(row + 1), pose.words, *([turns[row] if proposal.turns else ""] if proposal.equipment.chained else []))
        for row, pose in enumerate(proposal.poses)
    ]


def turn_rows(proposal: Proposal) -> TextRows:
    """Return each turn of a table, its number and words; else they stand beside the poses."""
    turns = () if proposal.equipment.chained else proposal.turns
    return [(str(row), turn.words) for row, turn in enumerate(turns, 1)]


def sigma_rows(proposal: Proposal) -> TextRows:
    """Return each parameter in words, its 95 % interval before and after, and how many times smaller it becomes."""
    sigmas = zip(proposal.names, proposal.before, proposal.after, strict=True)

    def interval(name: Name, sigma: float) -> str:
        return f"± {spoken_amount(name, Z95 * sigma, proposal.imu)}"

    return [
        (describe(name, proposal.imu), interval(name, before), interval(name, after), f"{before / after:.3g}")
        for name, before, after in sigmas
    ]


def gain_words(proposal: Proposal) -> str:
    """Say what the criterion was, becomes, and what rounding the angles costs."""
    criterion = proposal.criterion
    what = (
        f"the standard deviation of the {describe(criterion, proposal.imu)}"
        if isinstance(criterion, Name)
        else _CRITERIA[criterion]
    )
    loss = 100 * proposal.rounding_loss
    cost = f"makes it larger by {loss:.2g} %" if loss > 0.005 else "costs nothing"
    rounding = "" if proposal.equipment.in_sequence else f"Rounding the angles {cost}. "
    return (
        f"Expected: {what} falls from {proposal.criterion_before:.3g} to {proposal.criterion_after:.3g}, "
        f"{proposal.gain:.3g} times. {rounding}All together determine "
        f"{proposal.rank} of {len(proposal.names)} parameters."
    )


def _poses_figure(proposal: Proposal) -> Figure:
    count = len(proposal.poses)
    rows = -(-count // _COLUMNS)
    figure = figures.new_figure(0.6 + 4.2 * rows)
    grid = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    for axes in grid:
        axes.set_axis_off()
        axes.set_aspect("equal")
    for number, (axes, pose) in enumerate(zip(grid, proposal.poses, strict=False)):
        _draw_floor(axes, proposal.equipment.by_hand)
        _draw_unit(axes, Rotation.from_quat(pose.attitude, scalar_first=True).as_matrix())
        axes.set_title(f"{number + 1}", loc="left", fontsize=12, fontweight="bold")
        axes.text(0.0, -1.75, _folded(pose.words), ha="center", va="top", fontsize=9.5)
    figure.suptitle(
        f"{count} poses {proposal.equipment.words}: {proposal.equipment.rest:g} s at rest in each",
        fontsize=12,
        fontweight="bold",
        y=1 - _ABOVE / figure.get_figheight(),
    )
    return figure


def _folded(words: str, width: int = 36) -> str:
    return "\n".join(line for part in words.split("; ") for line in textwrap.wrap(part, width))


def _view(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Project level-frame points (..., 3) onto the picture (..., 2); and how far they are (...)."""
    cosine, sine = np.cos(_SIDE), np.sin(_SIDE)
    right = cosine * points[..., 0] + sine * points[..., 1]
    away = -sine * points[..., 0] + cosine * points[..., 1]
    up = points[..., 2]
    cosine, sine = np.cos(_ELEVATION), np.sin(_ELEVATION)
    return np.stack([right, cosine * up + sine * away], axis=-1), cosine * away - sine * up


def _draw_floor(axes: Axes, by_hand: bool) -> None:
    """Draw the table top below the unit, and where the person who holds it stands."""
    from matplotlib.patches import Polygon

    flat, _ = _view(1.15 * np.array([[-1, -1, -0.9], [1, -1, -0.9], [1, 1, -0.9], [-1, 1, -0.9]]))
    axes.add_patch(Polygon(flat, facecolor="#EDEDED", edgecolor="#BBBBBB", linewidth=0.8, zorder=0))
    if by_hand:
        x, y = _view(np.array([0.0, -1.4, -1.035]))[0]
        axes.text(x, y, "you", ha="center", va="center", fontsize=9)


def _draw_unit(axes: Axes, rotation: FloatArray) -> None:
    """Draw a flat box and its axes, which are the columns of `rotation`."""
    from matplotlib.patches import Polygon

    half = np.array([0.62, 0.45, 0.2])
    colors = figures.AXES
    for axis, (name, color) in enumerate(colors.items()):
        other, third = (axis + 1) % 3, (axis + 2) % 3
        for sign in (1.0, -1.0):
            corners = np.zeros((4, 3))
            corners[:, axis] = sign * half[axis]
            corners[:, other] = half[other] * np.array([1, -1, -1, 1])
            corners[:, third] = half[third] * np.array([1, 1, -1, -1])
            _, depth = _view(rotation[:, axis] * sign)
            if depth < 0:  # towards the viewer
                flat, _ = _view(corners @ rotation.T)
                face = {"facecolor": "#F6F6F6", "alpha": 0.9} if sign < 0 else {"facecolor": color, "alpha": 0.45}
                axes.add_patch(Polygon(flat, edgecolor="#444444", linewidth=0.9, zorder=2, **face))
                if sign < 0 and depth < -0.2:  # an arrow names the positive ends
                    x, y = flat.mean(axis=0)
                    axes.text(x, y, f"−{name}", color=color, ha="center", va="center", fontsize=10, zorder=3)
        start, _ = _view(rotation[:, axis] * half[axis])
        stop, depth = _view(rotation[:, axis] * 1.15)
        behind = depth > 0
        axes.annotate(
            "",
            xy=tuple(stop),
            xytext=tuple(start),
            zorder=1 if behind else 4,
            arrowprops={
                "arrowstyle": "-|>",
                "color": color,
                "linewidth": 1.8,
                "linestyle": "--" if behind else "-",
                "shrinkA": 0,
                "shrinkB": 0,
            },
        )
        axes.text(
            1.12 * stop[0], 1.12 * stop[1], name, color=color, ha="center", va="center", fontsize=10, fontweight="bold"
        )
    axes.set_xlim(-1.45, 1.45)
    axes.set_ylim(-2.6, 1.35)  # the words stand below
