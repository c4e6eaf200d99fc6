"""The report's pictures, each with a title that says what it shows, and what all panels are drawn with.

Figures are objects; pyplot is not touched.
"""

import io
from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaximu.calibration import Calibration
from jaximu.ground.array_types import BoolArray, FloatArray
from jaximu.ground.distributions import rms
from jaximu.ground.errors import InputError
from jaximu.ground.quantities import number, raised, readable, size, unit_text
from jaximu.ground.units import SENSOR_UNITS
from jaximu.ground.vectors import lengths_of, root_or_zero, sigmas_of
from jaximu.recordings.recording import Recording, Signal
from jaximu.report.canvas import Axes, Figure
from jaximu.report.evidence import PoseAndTurnErrors, evidence
from jaximu.report.tables import short_name
from jaximu.report.vector import named
from jaximu.report.words import how_much_smaller

# Okabe and Ito's palette, which colour-blind readers can tell apart.
AXES = {"x": "#0072B2", "y": "#D55E00", "z": "#009E73"}
BEFORE, AFTER, FLAGGED, POSE = "#8A8A8A", "#0072B2", "#D55E00", "#F0E442"
PALETTE, OTHERS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#000000"), "#B8B8B8"
NOISE, SCATTER = "#56B4E9", "#CFE8F7"

LEAST_SHARE = 0.01
"""Of a variance: what is below it everywhere is drawn among the others."""
_WIDTH = 9.6  # inches
_MOST_POINTS = 3000  # drawn of one trace: more than there are pixels


@cache
def _shown() -> type[Figure]:
    from matplotlib.figure import Figure

    class Shown(Figure):
        """A figure that a notebook shows without pyplot."""

        def _repr_png_(self) -> bytes:
            return png(self)

    return Shown


def new_figure(height: float, width: float = _WIDTH) -> Figure:
    """Return an empty figure, inches, whose panels have room for their words."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = _shown()(figsize=(width, height), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def stacked(
    count: int, height: float = 1.7, more: float = 0.8, width: float = _WIDTH, across: str = "", **shared: Any
) -> tuple[Figure, list[Any]]:
    """Return a figure with so many panels below each other, each so many inches high, and `more` for what is beside.

    `across`: words of the lowest panel's axis.
    """
    figure = new_figure(more + height * count, width)
    panels = figure.subplots(count, 1, squeeze=False, **shared)[:, 0].tolist()
    panels[-1].set_xlabel(across)
    return figure, panels


def png(figure: Figure) -> bytes:
    """Return the figure as a PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120)
    return buffer.getvalue()


def beside(count: int, height: float, **shared: Any) -> tuple[Figure, list[Any]]:
    """Return a figure with so many panels beside each other."""
    figure = new_figure(height)
    return figure, figure.subplots(1, count, squeeze=False, **shared)[0].tolist()


def dressed(axes: Axes, title: str = "", level: float | None = None, key: int = 0, **labels: Any) -> None:
    """Draw a panel's frame, grid, title and labels as all have them.

    **Arguments:** `level`: the one that errors lie about; `key`: how many columns its key has, where it shows one.
    """
    if level is not None:
        axes.axhline(level, color="0.6", linewidth=0.8)
    if key:
        legend(axes, key)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="#E3E3E3", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8)
    if title:
        axes.set_title(title, loc="left", fontsize=11, fontweight="bold")
    axes.set(**labels)


def headed(figure: Figure, title: str) -> None:
    """Write the title of a whole figure."""
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold")


def legend(axes: Axes, columns: int = 1, where: Any = "best") -> None:
    """Draw the key of a panel in it."""
    axes.legend(loc=where, ncols=columns, fontsize=8, frameon=False)


def legend_below(figure: Figure, axes: Axes, columns: int) -> None:
    """Draw the key of a panel at the bottom of its figure."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=9, frameon=False)


def band(axes: Axes, x: FloatArray, value: FloatArray, half: FloatArray, color: str, **style: Any) -> None:
    """Draw a line and its 95 % band, by at most one value for each point of its width."""
    kept = np.unique(np.linspace(0, len(x) - 1, 72 * round(_WIDTH)).astype(int))
    x, value, half = x[kept], value[kept], half[kept]
    axes.fill_between(x, value - half, value + half, color=color, alpha=0.25, linewidth=0)
    axes.plot(x, value, color=color, linewidth=1.2, **style)


def logarithmic(axes: Axes, which: str = "xy") -> None:
    """Make scales logarithmic once all is drawn; powers of ten are plain text, which need no typesetting."""
    from matplotlib.ticker import LogLocator, NullLocator

    for name in which:
        axes.set(**{f"{name}scale": "log"})
        axis = getattr(axes, f"{name}axis")
        low, high = axis.get_view_interval()
        axis.set_major_locator(LogLocator(subs=(1.0,) if high > 100 * low else (1.0, 2.0, 5.0)))
        axis.set_major_formatter(_power_of_ten)
        axis.set_minor_locator(NullLocator())


def _power_of_ten(value: float, _: int | None = None) -> str:
    exponent = int(np.floor(np.log10(value) + 1e-9))
    if -3 < exponent < 4:
        return f"{value:g}"
    ahead = f"{value / 10.0**exponent:.0f}·".removeprefix("1·")
    return f"{ahead}10{raised(exponent)}"


# --- the recording ----------------------------------------------------------------------------------------------------


def envelope(time: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Thin (n, m) samples to a trace's rows, which keep each stretch's lowest and highest value in every column."""
    count = len(time)
    if count <= _MOST_POINTS:
        return time, values
    starts = np.linspace(0, count, _MOST_POINTS // 2, endpoint=False).astype(int)
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    return np.stack([time[starts], time[np.append(starts[1:], count) - 1]], axis=1).reshape(-1), np.stack(
        [low, high], axis=1
    ).reshape(-1, values.shape[1])


def _traces(axes: Axes, signal: Signal, offset: float = 0.0, named: bool = True) -> None:
    time, values = envelope(signal.time, signal.si())
    for column, (axis, color) in zip(values.T, AXES.items(), strict=False):
        axes.plot(time + offset, column, color=color, linewidth=0.7, label=axis if named else None)
    axes.margins(x=0.01)


def signals_figure(recording: Recording) -> Figure:
    """Draw all signals of a recording against time, in SI units."""
    signals = recording.signals
    figure, grid = stacked(len(signals), across="time (s)", sharex=True)
    for axes, (name, signal) in zip(grid, signals.items(), strict=True):
        _traces(axes, signal)
        unit = unit_text(SENSOR_UNITS.get(name, signal.unit))
        dressed(axes)
        axes.set_ylabel(f"{name.replace('_', ' ')}\n({unit})" if unit else name, fontsize=8)
        if signal.values.shape[1] == len(AXES):
            legend(axes, 3, "upper right")
    return figure


def recording_of(calibration: Calibration) -> Figure:
    """Draw what a calibration was made from, with the poses found. Raises `InputError` where it is not kept."""
    parts = calibration.segmentations
    if not parts:
        raise InputError(
            "this calibration holds no recording with poses: files and fits to several kinds of data do not keep it."
        )
    rows = 1 + ("gyroscope" in parts[0].recording.signals)
    figure, grid = stacked(rows, 2.0, 2.0, sharex=True)
    shift, still, spans = 0.0, 0.0, []
    for part in parts:
        time = part.recording.accelerometer.time
        intervals = part.intervals
        offset = shift - time[0] if len(parts) > 1 else 0.0
        for axes, name in zip(grid, ("accelerometer", "gyroscope"), strict=False):
            _traces(axes, getattr(part.recording, name), offset, not shift)
            if shift:
                axes.axvline(shift, color="black", linewidth=1.2, linestyle=":")
        spans += [(start + offset, stop - start) for start, stop in intervals]
        still += np.sum(intervals[:, 1] - intervals[:, 0])
        shift += np.ptp(time)
    for axes, label in zip(grid, ("specific force (m/s²)", "angular rate (rad/s)"), strict=False):
        axes.broken_barh(
            spans,
            (0, 1),
            transform=axes.get_xaxis_transform(),
            color=POSE,
            alpha=0.35,
            zorder=0.5,
            linewidth=0,
            label="pose (at rest)",
        )
        dressed(axes, ylabel=label)
    _number_poses(grid[0], spans)
    several = f" in {len(parts)} recordings" if len(parts) > 1 else ""
    grid[0].set_title(
        f"{len(spans)} poses found{several}: at rest for {still:.0f} of {shift:.0f} s",
        loc="left",
        fontsize=11,
        fontweight="bold",
        pad=16,
    )
    if rows == 2:
        right = grid[1].secondary_yaxis("right", functions=(np.degrees, np.radians))
        right.set_ylabel("(°/s)")
        right.spines["right"].set_visible(False)
    grid[-1].set_xlabel("time (s)" + (", one recording after another" if several else ""))
    legend_below(figure, grid[0], 4)
    return figure


def _number_poses(axes: Axes, spans: Sequence[tuple[float, float]]) -> None:
    every = next(step for step in (1, 2, 5, 10, 20, 50, 100, 1000, 10**9) if len(spans) <= 25 * step)
    style = {"fontsize": 7, "ha": "center", "va": "bottom", "color": "#444444"}
    for pose, (start, length) in enumerate(spans, start=1):
        if pose == 1 or pose % every == 0:
            axes.text(start + length / 2, 1.01, str(pose), transform=axes.get_xaxis_transform(), **style)


# --- residuals --------------------------------------------------------------------------------------------------------


def residuals_of(calibration: Calibration) -> Figure:
    """Draw the errors of a calibration by pose and turn. Raises `InputError` where they are not kept."""
    errors = evidence(calibration)
    if errors is None:
        raise InputError(
            "this calibration holds no errors by pose: files and fits to several kinds of data do not keep them."
        )
    return residual_figure(errors)


def residual_figure(errors: PoseAndTurnErrors) -> Figure:
    """Draw the errors by pose and by turn, before and after, with what the noise explains."""
    rows = 3 if len(errors.turn) else 2
    figure, grid = stacked(rows, 2.35, 0.0, sharex=True, height_ratios=(0.7, 1, 1)[:rows])
    pose, turn = np.arange(1, len(errors.norm_after) + 1), errors.turn + 1.5  # a turn lies between its two poses

    before, after = rms(errors.norm_before), rms(errors.norm_after)
    grid[0].stem(pose, errors.norm_before, linefmt=BEFORE, markerfmt="o", basefmt=" ")
    title = f"At rest the accelerometer missed gravity by {size(before, 'm/s^2')} (rms) before calibration …"
    dressed(grid[0], title, 0.0, ylabel="before (m/s²)")

    factor, unit = readable("m/s^2", after)
    edges = np.append(pose - 0.5, pose[-1] + 0.5).repeat(2)[1:-1]
    for sigma, color, label in _explained(errors.norm_noise, errors.norm_sigma, "±2σ", " (“excess”)"):
        half = 2 * factor * np.repeat(sigma, 2)
        grid[1].fill_between(edges, -half, half, color=color, alpha=0.7, linewidth=0, label=label)
    grid[1].plot(pose, factor * errors.norm_after, "o", color=AFTER, markeredgecolor="white", markersize=5.5)
    title = f"… and misses it by {size(after, 'm/s^2', 2)} after: {how_much_smaller(before, after)}"
    dressed(grid[1], title, 0.0, ylabel=f"after ({unit})")

    if rows == 3:
        axes = grid[2]
        for limit, color, label in _explained(errors.angle_noise, errors.angle_limit, "95 % of turns"):
            axes.bar(turn, limit, 1.0, color=color, alpha=0.7, linewidth=0, label=label)
        axes.plot(turn, errors.angle_before, "o", color="white", markeredgecolor=BEFORE, markersize=5, label="before")
        axes.plot(turn, errors.angle_after, "o", color=AFTER, markeredgecolor="white", markersize=5.5, label="after")
        everything = np.concatenate([errors.angle_before, errors.angle_after, errors.angle_noise])
        lowest = max(everything[everything > 0].min(initial=1.0), 1e-4 * everything.max())
        axes.set_ylim(0.6 * lowest, 2 * everything.max())
        logarithmic(axes, "y")
        lost = f"by {number(rms(errors.angle_after), 2)}° (rms), before by {number(rms(errors.angle_before))}°"
        dressed(axes, f"Over a turn the gyroscope loses gravity's direction {lost}", ylabel="angle error (°)")
        legend(grid[1], 2)
    legend_below(figure, grid[-1], 4)
    grid[-1].set(xlabel="pose" + (" (turns lie between two poses)" if rows == 3 else ""), xlim=(0.4, len(pose) + 0.6))
    grid[-1].xaxis.get_major_locator().set_params(integer=True)
    return figure


def _explained(noise: FloatArray, scatter: FloatArray, share: str, called: str = "") -> list[tuple]:
    """Return the bands of what scatter and noise explain, each with its colour and label; one where they are alike."""
    bands = [(noise, NOISE, f"{share}: what the measured noise explains")]
    if (scatter > 1.02 * noise).any():
        bands.insert(0, (scatter, SCATTER, f"{share}: noise and the scatter beyond it{called}"))
    return bands


# --- parameters -------------------------------------------------------------------------------------------------------


def correlation_figure(calibration: Calibration) -> Figure:
    """Draw which parameters the data can only tell together."""
    parameters = calibration.names
    names = [short_name(name, calibration.imu) for name in parameters]
    sigma = sigmas_of(calibration.covariance)
    sigma = np.where(sigma > 0, sigma, 1.0)
    matrix = calibration.covariance / sigma[:, None] / sigma
    count = len(names)
    height = max(4.6, 0.36 * count + 1.0)
    figure = new_figure(height, min(_WIDTH, height + 1.2))
    axes, scale = figure.subplots(1, 2, width_ratios=(1, 0.04))
    image = axes.imshow(matrix, cmap="RdBu_r", vmin=-1, vmax=1)
    axes.set_xticks(range(count), names, rotation=90, fontsize=8)
    axes.set_yticks(range(count), names, fontsize=8)
    for row, column in zip(*(np.abs(matrix) >= 0.3).nonzero(), strict=True):
        if row != column:
            color = "white" if abs(matrix[row, column]) > 0.7 else "black"
            text = f"{matrix[row, column]:+.2f}".replace("-", "−").replace("0.", ".")
            axes.text(column, row, text, ha="center", va="center", fontsize=6.5, color=color)
    for index, (before, after) in enumerate(pairwise(parameters)):
        if (before.owner, before.effect, before.part) != (after.owner, after.effect, after.part):
            for line in (axes.axhline, axes.axvline):
                line(index + 0.5, color="black", linewidth=1.4 if before.owner != after.owner else 0.5)
    figure.colorbar(image, cax=scale, label="correlation (−1 to 1)")
    # scales of the accelerometer share the uncertainty of gravity: no pair of them is named as the closest
    scales = [index for index, name in enumerate(parameters) if name.owner == "accelerometer" and name.is_scale]
    others = matrix - np.eye(count)
    others[np.ix_(scales, scales)] = 0.0
    first, second = sorted(np.unravel_index(int(np.abs(others).argmax()), others.shape))
    if first != second:
        value = matrix[first, second]
        what = (
            "Weak combinations hold more than two parameters"
            if calibration.weak
            else "No two parameters can be confused"
        )
        what = "Hard to tell apart" if abs(value) > 0.9 else f"{what};\nthe closest pair"
        text = f"{what}: {names[first]} and {names[second]} ({value:+.2f})".replace("-", "−")
        axes.set_title(text, loc="left", fontsize=11, fontweight="bold")
    return figure


# --- orientations -----------------------------------------------------------------------------------------------------


def _flat(directions: FloatArray) -> FloatArray:
    """Map a half sphere about ±z to a disc of radius one; equal areas stay equal (Lambert)."""
    across = lengths_of(directions[:, :2])
    return directions[:, :2] * (root_or_zero(1 - np.abs(directions[:, 2])) / np.maximum(across, 1e-12))[:, None]


def raised_to_sphere(x: FloatArray, y: FloatArray, sign: int) -> FloatArray:
    """Return the directions (..., 3) of points of a disc of radius one, the inverse of that map; its edge beyond."""
    radius = np.hypot(x, y)
    height = 1 - np.minimum(radius, 1.0) ** 2
    scale = np.sqrt(1 - height**2) / np.maximum(radius, 1e-12)
    return np.stack([scale * x, scale * y, sign * height], axis=-1)


def hemispheres(
    figure: Figure, columns: int, directions: FloatArray, names: Sequence[str], colors: Any, **dots: Any
) -> tuple[list[tuple[Axes, int, BoolArray, FloatArray]], Any]:
    """Draw directions (n, 3), called by their names, on the two half spheres about ±z; `colors` (n,): values.

    **Returns:** the two panels, each with the sign of its z, which directions (n,) lie in it, and where (m, 2); and
    the figure's grid, in whose `columns` the panels are the first two, with room for a colour bar below.
    """
    grid = figure.add_gridspec(2, columns, height_ratios=(1, 0.03))
    circle = np.linspace(0, 2 * np.pi, 200)
    panels = []
    for column, sign in enumerate((1, -1)):
        axes = figure.add_subplot(grid[0, column])
        here = directions[:, 2] >= 0 if sign > 0 else directions[:, 2] < 0
        spot = _flat(directions[here])
        drawn = axes.scatter(*spot.T, c=colors[here], zorder=3, **dots)
        named(drawn, [name for name, inside in zip(names, here, strict=True) if inside])
        axes.plot(np.cos(circle), np.sin(circle), color="black", linewidth=1)
        for px, py, text in ((1.14, 0, "+x"), (-1.14, 0, "−x"), (0, 1.12, "+y"), (0, -1.12, "−y")):
            axes.text(px, py, text, ha="center", va="center", fontsize=9)
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.set(xlim=(-1.22, 1.22), ylim=(-1.18, 1.18))
        panels.append((axes, sign, here, spot))
    return panels, grid


def number_dots(axes: Axes, spots: FloatArray, numbers: NDArray[np.intp]) -> None:
    """Write one label for all poses on nearly the same spot: their numbers, the first three of them."""
    left = list(range(len(spots)))
    while left:
        near = [dot for dot in left if np.linalg.norm(spots[dot] - spots[left[0]]) < 0.07]
        text = ", ".join(map(str, numbers[near[:3]])) + (" …" if len(near) > 3 else "")
        axes.annotate(text, spots[left[0]], (5, 4), textcoords="offset points", fontsize=7, color="#333333", zorder=5)
        left = [dot for dot in left if dot not in near]
