"""What the report of a calibration with equipment says and draws: errors by pose and turn, what the set-up adds."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaximu.calibration import Calibration
from jaximu.data.stations import station_errors
from jaximu.ground.quantities import Z95, number
from jaximu.report.figures import AXES, dressed, legend, new_figure, zero_line
from jaximu.report.html import Folder, write_calibration
from jaximu.report.words import (
    Lead,
    Statement,
    counts,
    gravity_statement,
    how_much_smaller,
    scatter_statements,
    weak_statements,
    without_freedom,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["write_station_report"]

_WORDS = {
    "specific_force": "specific force in the poses",
    "rate_at_rest": "rate in the poses",
    "turn_angle": "angle over the turns",
}


def _lead(calibration: Calibration) -> Lead:
    if calibration.exact:
        return without_freedom(calibration)
    parts = [
        f"{_WORDS[name]} from {number(before)} to {number(after, 2)} {unit}"
        for name, (before, after, unit) in calibration.rms.items()
    ]
    name, (before, after, unit) = next(iter(calibration.rms.items()))
    poses, turns = counts(calibration)
    return Lead(
        f"Against what the set-up says of {poses} poses and {turns} turns the errors fall (rms): {'; '.join(parts)}.",
        f"{number(after, 2)} {unit}",
        f"rms error of the {_WORDS[name]} after calibration, {how_much_smaller(before, after)} than before",
    )


def _trust(calibration: Calibration) -> Iterator[Statement]:
    """Say what to trust: where noise explains the errors, and what no interval contains."""
    yield from [*scatter_statements(calibration), gravity_statement(calibration)]
    text = (
        "The intervals are sampling error and the uncertainty of gravity. What the set-up gets wrong every time (a "
        "table that is not level, axes that are not square, a wrong angle) shifts the parameters by as much and is in "
        "no interval; `jaximu budget` computes how much."
    )
    yield Statement("The set-up", text, not calibration.imu.setup)


def _limits(calibration: Calibration) -> Iterator[Statement]:
    """Say what the data cannot tell."""
    yield from weak_statements(
        calibration.weak,
        f"All {len(calibration.names)} parameters are determined by these poses and turns; none is weak.",
    )
    text = (
        "The body frame is the fixture's, in which the reference states its directions; how the fixture is turned "
        "against the table cannot be distinguished from misalignment."
    )
    yield Statement("The fixture", text)


def _figure(calibration: Calibration) -> Figure:
    """Draw each station's errors after calibration, by axis, with the standard deviation of its mean."""
    fit, stations = calibration.fit, calibration.stations
    assert fit is not None and stations is not None
    panels = [panel for panel in station_errors(fit.imu, stations, np.asarray(fit.excess)) if len(panel.station)]
    figure = new_figure(2.3 * len(panels))
    grid = figure.subplots(len(panels), 1, squeeze=False)[:, 0]
    for axes, panel in zip(grid, panels, strict=True):
        for shift, (axis, color), error, sigma in zip(
            (-0.2, 0.0, 0.2), AXES.items(), panel.error, panel.sigma, strict=True
        ):
            axes.errorbar(panel.station + shift, error, Z95 * sigma, fmt="o", ms=3.5, lw=0.8, color=color, label=axis)
        zero_line(axes)
        dressed(axes, f"Error of the {_WORDS[panel.name]}", ylabel=panel.unit)
    legend(grid[0], 3, "upper right")
    grid[-1].set_xlabel("pose or turn, in order of time (bars: 95 % of the noise)")
    return figure


def write_station_report(calibration: Calibration, folder: Folder) -> Path:
    """Write pictures and `report.html`, whose path is returned. Raises `InputError` where they cannot be written."""
    working = calibration.fit is not None and calibration.stations is not None
    picture = (
        "Errors of each pose and turn after calibration",
        "Mean outputs less what the calibrated model makes of what the set-up says, by axis, in SI.",
    )
    return write_calibration(
        calibration,
        folder,
        _lead(calibration),
        _trust(calibration),
        _limits(calibration),
        {"residuals": partial(_figure, calibration)} if working else {},
        picture,
    )
