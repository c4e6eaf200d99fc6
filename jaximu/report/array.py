"""The page of units on one body: what averaging gains, which one disturbs, where each is and how it is turned."""

import shlex
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import scipy

from jaximu.calibration.array_units import Array, ArrayUnit
from jaximu.ground.page import Page, Picture, Statement, Table
from jaximu.ground.quantities import number, with_interval
from jaximu.report.canvas import Figure
from jaximu.report.figures import AXES, beside, dressed


def page_of(array: Array) -> Page:
    """Return what averaging gains, which unit disturbs, and where each unit is."""
    rate, force = (noise[0] / noise[1] for noise in (array.averaged.rate, array.averaged.force))
    return Page(
        f"An array of {len(array.units)} units",
        (
            *(
                f"{label} disturbs the array."
                for label in dict.fromkeys(_label(array, unit) for unit, *_ in array.suspects())
            ),
            f"At rest the weighted mean of all {len(array.units)} units has {rate:.2g} times less gyroscope noise and "
            f"{force:.2g} times less accelerometer noise than a typical unit.",
        ),
        f"{rate:.2g}×",
        "less gyroscope noise in the mean of all units",
        (
            Picture(
                "array",
                partial(_figure, array),
                "The units' positions and axes",
                "The units as the first one sees them, from above and from the side: positions with 95 % intervals, "
                "and the directions of their axes. Numbers: units in the order of the files.",
            ),
            *_suspects(array),
            _table(array),
            *_noise(array),
        ),
        notes=array.notes,
        next=_next(array),
    )


def _label(array: Array, unit: ArrayUnit) -> str:
    """Return a unit's file, and its number where several are in one file, by columns or IDs."""
    name, number = Path(unit.name).name, 1 + [other is unit for other in array.units].index(True)
    return f"{name} ({number})" if [other.name for other in array.units].count(unit.name) > 1 else name


def _next(array: Array) -> str:
    for unit, *_ in array.suspects():
        return f"`jaximu diagnose {shlex.quote(unit.name)} -o RESULTS` looks for the cause of its scatter."
    log = shlex.quote(array.units[0].name)
    return f"`jaximu compensate CALIBRATION_1 {log} -o CORRECTED.csv` applies the first unit's calibration."


def _suspects(array: Array) -> Iterator[Statement]:
    for unit, words, times in array.suspects():
        yield Statement(
            _label(array, unit),
            f"It scatters {times:.2g} times as far about the shared motion as a typical unit in {words}: look for the "
            "cause with `jaximu diagnose`, or leave it out of the mean.",
            True,
        )
    if len(array.units) == 2:
        yield Statement("Scatter", "Two units cannot show which of them scatters: add a third.")


def _noise(array: Array) -> Iterator[Statement]:
    for (unit, mean, expected), words, factor, printed in (
        (array.averaged.rate, "gyroscope", np.degrees(1.0), "°/s"),
        (array.averaged.force, "accelerometer", 1e3, "mm/s²"),
    ):
        yield Statement(
            f"Noise of the {words} at rest",
            f"Means of a quarter of a second: {factor * unit:.3g} {printed} of a typical unit, {factor * mean:.3g} "
            f"{printed} of the mean; {factor * expected:.3g} {printed} if the units' noises were independent.",
        )


def _table(array: Array) -> Table:
    suspects = [unit for unit, *_ in array.suspects()]
    marked = [index for index, unit in enumerate(array.units) if any(unit is suspect for suspect in suspects)]
    return Table(
        ("unit", "turned [°]", "position x, y, z [mm]", "clock late by [ms]", "scatter [°/s]", "scatter [m/s²]"),
        [(_label(array, unit), *_row(unit, unit is array.units[0])) for unit in array.units],
        "± is 95 %; positions in the first unit's axes. Scatter: standard deviation of an axis about the motion that "
        "all units share, over eight samples.",
        marked,
        brief=max([12, *(index + 1 for index in marked)]),
    )


def _row(unit: ArrayUnit, first: bool) -> tuple[str, ...]:
    position = ", ".join(map(with_interval, 1e3 * unit.position, 1e3 * unit.position_sigma))
    angle = np.degrees(2 * np.arccos(min(1.0, abs(unit.rotation[0]))))
    return (
        "the first" if first else with_interval(angle, np.degrees(unit.rotation_sigma.max())),
        "0" if first else position,
        "0" if first else with_interval(1e3 * unit.time_offset, 1e3 * unit.time_offset_sigma),
        _scatter(unit.rate_scatter, np.degrees(1.0)),
        _scatter(unit.force_scatter, 1.0),
    )


def _scatter(value: float | None, factor: float) -> str:
    """Return a unit's scatter; zero is what the other units' hides."""
    return "" if value is None else number(factor * value, 2) if value else "≈ 0"


def _figure(array: Array) -> Figure:
    figure, panels = beside(2, 4.6)
    positions = np.array([unit.position for unit in array.units])
    extent = max(np.ptp(positions, axis=0).max(), 5e-3)
    for panel, (across, up), title in zip(panels, ((0, 1), (0, 2)), ("From above", "From the side"), strict=True):
        places = positions[:, [across, up]]
        for unit in array.units:
            _draw(panel, unit, across, up, 1e3 * 0.12 * extent, unit is array.units[0])
        for row, position in enumerate(places):  # one label for units that lie upon each other
            near = np.flatnonzero(np.linalg.norm(places - position, axis=1) < 0.1 * extent)
            if near[0] == row:
                label = ", ".join(str(other + 1) for other in near)
                panel.annotate(label, 1e3 * position, (5, -5), textcoords="offset points", va="top", fontsize=9)
        panel.set_aspect("equal", adjustable="datalim")
        panel.margins(0.2)
        horizontal, vertical = (f"{'xyz'[axis]} of the first unit [mm]" for axis in (across, up))
        dressed(panel, title, xlabel=horizontal, ylabel=vertical)
    return figure


def _draw(panel, unit: ArrayUnit, across: int, up: int, length: float, named: bool) -> None:
    centre = 1e3 * unit.position
    width = 1.96e3 * unit.position_sigma
    x, y = centre[[across, up]]
    panel.errorbar(x, y, width[up], width[across], color="0.45", linewidth=1.0, zorder=1)
    axes = scipy.spatial.transform.Rotation.from_quat(unit.rotation, scalar_first=True).as_matrix()
    for row, (name, color) in enumerate(AXES.items()):
        tip = axes[row, [across, up]] * length
        panel.annotate(
            "",
            (x + tip[0], y + tip[1]),
            (x, y),
            arrowprops={"arrowstyle": "->", "color": color, "linewidth": 1.4},
        )
        if named and np.linalg.norm(tip) > 0.3 * length:
            panel.text(x + 1.25 * tip[0], y + 1.25 * tip[1], name, color=color, ha="center")
