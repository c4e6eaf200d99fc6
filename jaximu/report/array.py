"""What is said of units on one body: where each is, how it is turned, whose noise it is; the page and its picture."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import scipy

from jaximu.calibration.array_units import Array, ArrayUnit
from jaximu.ground.quantities import number, with_interval
from jaximu.report.figures import AXES, dressed, new_figure
from jaximu.report.html import Folder, TextRows, write_page

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["HEADERS", "headline", "statements", "unit_rows", "write_array"]

HEADERS = ("unit", "turned [°]", "position x, y, z [mm]", "clock late by [ms]", "scatter [°/s]", "scatter [m/s²]")


def headline(array: Array) -> str:
    """Return the answer in one sentence."""
    rate, force = (noise[0] / noise[1] for noise in (array.averaged.rate, array.averaged.force))
    return (
        f"{len(array.units)} units on one body: at rest the weighted mean of all has {rate:.2g} times less gyroscope "
        f"noise and {force:.2g} times less accelerometer noise than a typical unit."
    )


def statements(array: Array) -> Iterator[str]:
    """Return what else is to be known, a sentence each."""
    for (unit, mean, expected), words, factor, spoken in (
        (array.averaged.rate, "gyroscope", np.degrees(1.0), "°/s"),
        (array.averaged.force, "accelerometer", 1e3, "mm/s²"),
    ):
        yield (
            f"Noise of the {words} at rest, means of a quarter of a second: {factor * unit:.3g} {spoken} of a typical "
            f"unit, {factor * mean:.3g} {spoken} of the mean; {factor * expected:.3g} {spoken} if the units' noises "
            "were independent."
        )
    for unit, words, times in array.suspects():
        yield (
            f"{Path(unit.name).name} scatters {times:.2g} times as far about the shared motion as a typical unit in "
            f"{words}: look for its cause with `jaximu diagnose`, or leave it out of the mean."
        )
    if len(array.units) == 2:
        yield "Two units cannot show which of them scatters: add a third."


def unit_rows(array: Array) -> TextRows:
    """Return the table of units, with 95 % intervals."""

    def scatter(value: float | None, factor: float) -> str:
        return "" if value is None else number(factor * value, 2)

    rows = []
    for unit in array.units:
        position = ", ".join(
            with_interval(1e3 * value, 1e3 * sigma)
            for value, sigma in zip(unit.position, unit.position_sigma, strict=True)
        )
        first = unit is array.units[0]
        angle = np.degrees(2 * np.arccos(min(1.0, abs(unit.rotation[0]))))
        width = np.degrees(np.max(unit.rotation_sigma))
        delay = with_interval(1e3 * unit.time_offset, 1e3 * unit.time_offset_sigma)
        rows.append(
            (
                Path(unit.name).name,
                "the first" if first else with_interval(angle, width),
                "0" if first else position,
                "0" if first else delay,
                scatter(unit.rate_scatter, np.degrees(1.0)),
                scatter(unit.force_scatter, 1.0),
            )
        )
    return rows


def write_array(array: Array, folder: Folder) -> Path:
    """Write `report.html`, whose path is returned, and `array.png`. Raises `InputError` where they cannot be."""
    return write_page(
        folder,
        "array",
        {"array": partial(_figure, array)},
        title=f"An array of {len(array.units)} units",
        lead=headline(array),
        number=f"{array.averaged.rate[0] / array.averaged.rate[1]:.2g}×",
        meaning="less gyroscope noise in the mean of all units",
        headers=HEADERS,
        rows=unit_rows(array),
        statements=[*statements(array)],
        notes=array.notes,
    )


def _figure(array: Array) -> Figure:
    figure = new_figure(4.6)
    panels = figure.subplots(1, 2)
    extent = max(np.ptp(np.array([unit.position for unit in array.units]), axis=0).max(), 5e-3)
    for panel, (across, up), title in zip(panels, ((0, 1), (0, 2)), ("From above", "From the side"), strict=True):
        places = np.array([unit.position for unit in array.units])[:, [across, up]]
        for unit in array.units:
            _draw(panel, unit, across, up, 1e3 * 0.12 * extent, unit is array.units[0])
        for row, position in enumerate(places):  # one label for units that lie upon each other
            near = np.flatnonzero(np.linalg.norm(places - position, axis=1) < 0.1 * extent)
            if near[0] == row:
                label = ", ".join(str(other + 1) for other in near)
                panel.annotate(label, 1e3 * position, (5, -5), textcoords="offset points", va="top", fontsize=9)
        panel.set_aspect("equal", adjustable="datalim")
        panel.margins(0.2)
        labels = {f"{name}label": f"{'xyz'[axis]} of the first unit [mm]" for name, axis in (("x", across), ("y", up))}
        dressed(panel, title, **labels)
    return figure


def _draw(panel, unit: ArrayUnit, across: int, up: int, length: float, named: bool) -> None:
    """Draw a unit's place and axes; `named`: with the axes' names."""
    centre, width = 1e3 * unit.position, 1.96e3 * unit.position_sigma
    panel.errorbar(centre[across], centre[up], width[up], width[across], color="0.45", linewidth=1.0, zorder=1)
    axes = scipy.spatial.transform.Rotation.from_quat(unit.rotation, scalar_first=True).as_matrix()
    for row, (name, color) in enumerate(AXES.items()):
        tip = axes[row, [across, up]] * length
        panel.annotate(
            "",
            (centre[across] + tip[0], centre[up] + tip[1]),
            (centre[across], centre[up]),
            arrowprops={"arrowstyle": "->", "color": color, "linewidth": 1.4},
        )
        if named and np.linalg.norm(tip) > 0.3 * length:
            panel.text(centre[across] + 1.25 * tip[0], centre[up] + 1.25 * tip[1], name, color=color, ha="center")
