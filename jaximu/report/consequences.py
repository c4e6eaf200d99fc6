"""The report of what errors do to navigation: the budget of position over time, and tracks of draws."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.quantities import number
from jaximu.navigation.consequences import Consequences, position
from jaximu.report import figures
from jaximu.report.figures import OTHERS, PALETTE, dressed
from jaximu.report.html import write_page

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["budget_rows", "headers", "headline", "statements", "total_rows", "write_consequences"]

_SHOWN = (1.0, 10.0, 60.0, 600.0)  # s
_LEAST = 0.01  # of the variance at a time that is shown: a term below it everywhere is drawn among the others
_COMMON = 0.1  # by how much the calibration's terms together may differ from their root sum of squares unsaid


def write_consequences(found: Consequences, folder: str | os.PathLike[str]) -> Path:
    """Write `report.html`, whose path is returned, `budget.png` and, with draws, `tracks.png`.

    Raises `InputError` where they cannot be written.
    """
    drawn = {"budget": partial(_budget_figure, found)}
    if found.check:
        drawn["tracks"] = partial(_tracks_figure, found)
    return write_page(
        folder, "consequences", drawn, title=f"What the errors of {Path(found.calibration_file).name} do",
        lead=headline(found), number=_metres(float(position(found.total)[-1])),
        meaning=f"error of position after {_seconds(float(found.times[-1]))} (1σ)", path=found.trajectory.words,
        statements=statements(found), headers=headers(found), rows=budget_rows(found), totals=total_rows(found),
        notes=found.notes,
    )  # fmt: skip


# --- words ------------------------------------------------------------------------------------------------------------


def _metres(value: float) -> str:
    for factor, unit in ((1e-3, "km"), (1.0, "m"), (1e3, "mm"), (1e6, "µm")):
        if value * factor >= 1.0:
            return f"{number(value * factor, 2 if value * factor < 100 else 3)} {unit}"
    return "below 1 µm"


def _seconds(value: float) -> str:
    return f"{round(value, 1):g} s"


def _places(found: Consequences) -> list[int]:
    """Rows of the times that are shown: 1, 10, 60, 600 s and the last, as far as the path goes."""
    wanted = [each for each in _SHOWN if each < found.times[-1]]
    nearest = [int(np.argmin(np.abs(found.times - each))) for each in wanted]
    return list(dict.fromkeys([*nearest, len(found.times) - 1]))


def headers(found: Consequences) -> list[str]:
    """Return the times that are shown, in words."""
    return [f"after {_seconds(float(found.times[row]))}" for row in _places(found)]


def _order(found: Consequences) -> list[str]:
    """Names of the terms, the largest at the end of the path first."""
    return sorted(found.terms, key=lambda name: -float(position(found.terms[name])[-1]))


def headline(found: Consequences) -> str:
    """Say how far position is off at the end, and why."""
    name = _order(found)[0]
    largest, total = float(position(found.terms[name])[-1]), float(position(found.total)[-1])
    return (
        f"Navigating by this unit alone, position is off by {_metres(total)} (1σ) after "
        f"{_seconds(float(found.times[-1]))}. The largest term is {name}: {_metres(largest)} by itself."
    )


def budget_rows(found: Consequences) -> list[tuple[str, ...]]:
    """Return each term and its position error at the times that are shown, the largest first, then the total."""
    rows = _places(found)

    def row(name: str, variances: FloatArray) -> tuple[str, ...]:
        return name, *(_metres(float(each)) for each in position(variances)[rows])

    shown = [row(name, found.terms[name]) for name in _order(found)]
    shown.append(row("calibration, all together", found.calibration))
    shown.append(row("everything", found.total))
    if found.check is not None:
        shown.append(row(f"everything, {len(found.check.errors)} draws", found.check.sigma**2))
    return shown


def total_rows(found: Consequences) -> list[tuple[str, ...]]:
    """Return the errors of position, velocity and attitude by direction at the times that are shown."""
    rows, sigma = _places(found), np.sqrt(found.total)
    shown = []
    for part, what in enumerate(("position", "velocity", "attitude")):
        for axis, direction in enumerate(("east", "north", "up")):
            values = sigma[rows, 3 * part + axis]
            words = [f"{number(float(np.degrees(each)), 2)}°" if part == 2 else _metres(float(each)) for each in values]
            about = "about " if part == 2 else ""
            shown.append((f"{what}, {about}{direction}", *(f"{each}/s" if part == 1 else each for each in words)))
    return shown


def statements(found: Consequences) -> list[tuple[str, str]]:
    """Return what the budget means, each with what it is about."""
    total, end = position(found.total), _seconds(float(found.times[-1]))
    last = float(total[-1])
    parts = [f"{name} from {round(start, 1):g} to {round(stop, 1):g} s" for name, start, stop in found.dominant()]
    more = f" and {len(parts) - 6} changes more" if len(parts) > 6 else ""
    said = [("What dominates when", f"{'; '.join(parts[:6])}{more}.")]

    def better(variances: FloatArray) -> float:
        return float(position(variances + found.noise)[-1])

    best = min(found.known, key=lambda name: better(found.known[name]))
    floor = better(np.zeros_like(found.noise))
    buys = (
        f"Were {best} known exactly, the error after {end} would fall from {_metres(last)} to "
        f"{_metres(better(found.known[best]))}; with the whole calibration ten times better, to "
        f"{_metres(better(found.calibration / 100))}."
    )
    if found.noise.any():
        buys += f" Noise alone leaves {_metres(floor)}, which no calibration can undo."
    said.append(("What a better calibration buys", buys))
    apart = float(np.sqrt(sum(position(found.terms[name])[-1] ** 2 for name in found.known)))
    together = float(position(found.calibration)[-1])
    if abs(together / apart - 1) > _COMMON:
        said.append((
            "Correlation",
            f"The calibration's terms are not independent: together they make {_metres(together)} after {end}, where "
            f"their root sum of squares would be {_metres(apart)}.",
        ))  # fmt: skip
    if found.left_out:
        lost = sorted(found.left_out.items(), key=lambda pair: -pair[1][-1])
        listed = "; ".join(f"{name} {_metres(float(error[-1]))}" for name, error in lost)
        said.append(
            ("What a simpler model costs", f"Left out of the correction, each by itself, after {end}: {listed}.")
        )
    if found.check is not None:
        ratio = float(position(found.check.sigma**2)[-1]) / last
        chance = 1.96 / np.sqrt(2 * len(found.check.errors))
        said.append((
            "Check",
            f"{len(found.check.errors)} draws of all errors, through the whole mechanisation, scatter {ratio:.2f} "
            f"times as much as the budget says after {end} (by chance {1 - chance:.2f} to {1 + chance:.2f}).",
        ))  # fmt: skip
    if found.against is not None and found.apart is not None:
        other = float(position(found.against.total)[-1])
        off = float(np.linalg.norm(found.apart[-1, :3]))
        said.append((
            "The other calibration",
            f"With {Path(found.against.calibration_file).name} position is off by {_metres(other)} (1σ) after {end} if "
            f"it is right, and it puts the unit {_metres(off)} from where this one does.",
        ))  # fmt: skip
    return said


# --- pictures ---------------------------------------------------------------------------------------------------------


def _budget_figure(found: Consequences) -> Figure:
    variances = {name: position(each) ** 2 for name, each in found.terms.items()}
    whole = np.maximum(np.sum(list(variances.values()), axis=0), 1e-300)
    visible = [name for name in _order(found) if np.max(variances[name] / whole) >= _LEAST]
    drawn, end = visible[: len(PALETTE)], f"after {_seconds(float(found.times[-1]))}"
    figure = figures.new_figure(7.2)
    above, below = figure.subplots(2, 1, sharex=True)
    for name, color in zip(drawn, PALETTE, strict=False):
        above.plot(found.times, np.sqrt(variances[name]), color=color, linewidth=1.4)
    above.plot(found.times, position(found.total), color="black", linewidth=2.4, linestyle="--", label="everything")
    if found.check is not None:
        above.plot(found.times, position(found.check.sigma**2), color="#8A8A8A", linewidth=1.2, label="draws")
    figures.logarithmic(above, "y")
    above.legend(frameon=False, fontsize=9, loc="lower right")
    dressed(above, f"Position is off by {_metres(float(position(found.total)[-1]))} {end}",
            ylabel="position error, 1σ (m)")  # fmt: skip
    shares = [100 * variances[name] / whole for name in drawn]
    rest = np.maximum(100 - np.sum(shares, axis=0), 0.0) if shares else 100 + 0 * whole
    below.stackplot(found.times, *shares, rest, colors=[*PALETTE[: len(drawn)], OTHERS], labels=[*drawn, "others"])
    dressed(below, "What it is made of", xlabel="time (s)", ylabel="share of the terms' squares (%)", ylim=(0, 100),
            xlim=(found.times[0], found.times[-1]))  # fmt: skip
    figure.legend(*below.get_legend_handles_labels(), loc="lower center", ncols=3, frameon=False, fontsize=9)
    return figure


def _tracks_figure(found: Consequences) -> Figure:
    check = found.check
    assert check is not None
    figure = figures.new_figure(4.6)
    plane, height = figure.subplots(1, 2)
    for track in check.errors[:100]:
        plane.plot(track[:, 0], track[:, 1], color="#0072B2", linewidth=0.6, alpha=0.4)
        height.plot(found.times, track[:, 2], color="#0072B2", linewidth=0.6, alpha=0.4)
    east, north = 2.45 * np.sqrt(found.total[-1, :2])  # of two components, 95 % lie within 2.45 standard deviations
    angle, sigma = np.linspace(0, 2 * np.pi, 100), 1.96 * np.sqrt(found.total[:, 2])
    plane.plot(east * np.cos(angle), north * np.sin(angle), color=figures.FLAGGED, linewidth=1.6)
    plane.set_aspect("equal", "datalim")
    for side in (-1, 1):
        height.plot(found.times, side * sigma, color=figures.FLAGGED, linewidth=1.6)
    title = f"{min(100, len(check.errors))} draws over {_seconds(float(found.times[-1]))}"
    dressed(plane, title, xlabel="error east (m)", ylabel="error north (m)")
    dressed(height, "and their heights", xlabel="time (s)", ylabel="error up (m)")
    return figure
