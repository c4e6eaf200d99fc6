"""The report's pictures, each with a title that says what it shows. Figures are objects; pyplot is not touched."""

from __future__ import annotations

import io
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jaximu.calibration import Calibration
from jaximu.errors import InputError
from jaximu.problem import Name
from jaximu.quantities import number as shown
from jaximu.quantities import readable, size, unit_text
from jaximu.recording import Recording, Signal
from jaximu.report.evidence import Evidence, evidence, largest_gap, nearest_angles
from jaximu.report.tables import short_name
from jaximu.report.words import how_much_smaller

if TYPE_CHECKING:  # matplotlib takes half a second to import: only drawing needs it
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "correlation_figure",
    "logarithmic",
    "new_figure",
    "orientation_figure",
    "plain_axes",
    "png",
    "recording_figure",
    "residual_figure",
]

FloatArray = NDArray[np.float64]

# Okabe and Ito's palette, which colour-blind readers can tell apart.
AXES = {"x": "#0072B2", "y": "#D55E00", "z": "#009E73"}
BEFORE, AFTER, POSE = "#8A8A8A", "#0072B2", "#F0E442"
NOISE, SCATTER = "#56B4E9", "#CFE8F7"
GAPS = ("white", "#E6E6E6", "#C4C4C4", "#9C9C9C")

SI_UNITS = {"accelerometer": "m/s^2", "gyroscope": "rad/s", "magnetometer": "uT"}
_WIDTH = 9.6  # inches
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_MOST_POINTS = 3000  # drawn of one trace: more than there are pixels


@cache
def _shown() -> type[Figure]:
    from matplotlib.figure import Figure

    from jaximu.report.layout import place_panels

    class Shown(Figure):
        """A figure whose panels have room for their words, and that a notebook shows without pyplot."""

        def draw(self, renderer) -> None:
            place_panels(self)
            super().draw(renderer)

        def _repr_png_(self) -> bytes:
            return png(self)

    return Shown


def new_figure(height: float, width: float = _WIDTH) -> Figure:
    """Return an empty figure, inches; its panels are placed when it is drawn, so that their words have room."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = _shown()(figsize=(width, height), facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def png(figure: Figure) -> bytes:
    """Return the figure as a PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120)
    return buffer.getvalue()


def plain_axes(axes: Axes) -> None:
    """Draw a panel's frame and grid as all have them."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="#E3E3E3", linewidth=0.6)
    axes.set_axisbelow(True)


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
    return f"{ahead}10{str(exponent).translate(_RAISED)}"


def _title(axes: Axes, text: str) -> None:
    axes.set_title(text, loc="left", fontsize=11, fontweight="bold")


def _legend_below(axes: Axes) -> None:
    from jaximu.report.layout import BELOW

    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles[::-1], labels[::-1], loc="upper center", ncols=4, fontsize=8, frameon=False).set_gid(BELOW)


# --- the recording ----------------------------------------------------------------------------------------------------


def envelope(time: FloatArray, values: FloatArray, most: int = _MOST_POINTS) -> tuple[FloatArray, FloatArray]:
    """Thin (n, m) samples to at most `most` rows that keep each stretch's lowest and highest value in every column."""
    count, stretches = len(time), most // 2
    if count <= most:
        return time, values
    starts = np.linspace(0, count, stretches, endpoint=False).astype(int)
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    ends = np.append(starts[1:], count) - 1
    thinned = np.stack([low, high], axis=1).reshape(-1, values.shape[1])
    return np.stack([time[starts], time[ends]], axis=1).reshape(-1), thinned


def recording_of(calibration: Calibration) -> Figure:
    """Draw the recording that a calibration was made from. Raises `InputError` where it is not kept."""
    if not calibration.segmentations:
        raise InputError("this calibration holds no recording with poses: a file does not keep it; calibrate again.")
    return recording_figure(calibration)


def residuals_of(calibration: Calibration) -> Figure:
    """Draw the errors of a calibration by pose and turn. Raises `InputError` where they are not kept."""
    found = evidence(calibration)
    if found is None:
        raise InputError("this calibration holds no errors by pose: a file does not keep them; calibrate again.")
    return residual_figure(found)


def signals_figure(recording: Recording) -> Figure:
    """Draw all signals of a recording against time, in SI units."""
    signals = recording.signals
    figure = new_figure(0.8 + 1.7 * len(signals))
    grid = figure.subplots(len(signals), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, signal) in zip(grid, signals.items(), strict=True):
        time, values = envelope(signal.time, signal.si())
        for column, (axis, color) in zip(values.T, AXES.items(), strict=False):
            axes.plot(time, column, color=color, linewidth=0.7, label=axis)
        unit = unit_text(SI_UNITS.get(name, signal.unit))
        axes.set_ylabel(f"{name.replace('_', ' ')}\n({unit})" if unit else name, fontsize=8)
        plain_axes(axes)
        axes.margins(x=0.01)
        if values.shape[1] == len(AXES):
            axes.legend(loc="upper right", ncols=3, fontsize=7, frameon=False)
    grid[-1].set_xlabel("time (s)")
    return figure


def recording_figure(calibration: Calibration) -> Figure:
    """Draw what was recorded, with the poses that were found."""
    parts = calibration.segmentations
    rows = 1 if parts[0].recording.gyroscope is None else 2
    figure = new_figure(2.0 + 2.0 * rows)
    grid = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    shift, number, still, spans = 0.0, 0, 0.0, []
    total = sum(len(part.intervals) for part in parts)
    every = next(step for step in (1, 2, 5, 10, 20, 50, 100, 1000, 10**9) if total <= 25 * step)
    for part in parts:
        recording, intervals = part.recording, part.intervals
        begin, end = recording.accelerometer.time[0], recording.accelerometer.time[-1]
        offset = shift - begin if len(parts) > 1 else 0.0
        for axes, name in zip(grid, ("accelerometer", "gyroscope"), strict=False):
            signal: Signal = getattr(recording, name)
            time, values = envelope(signal.time, signal.si())
            for column, (axis, color) in zip(values.T, AXES.items(), strict=True):
                label = axis if not shift else None
                axes.plot(time + offset, column, color=color, linewidth=0.7, label=label)
            if shift:
                axes.axvline(shift, color="black", linewidth=1.2, linestyle=":")
        spans += [(start + offset, stop - start) for start, stop in intervals]
        still += float(np.sum(intervals[:, 1] - intervals[:, 0]))
        shift += end - begin
    for axes in grid:
        axes.broken_barh(spans, (0, 1), transform=axes.get_xaxis_transform(), color=POSE, alpha=0.35, zorder=0.5,
                         linewidth=0, label="pose (at rest)")  # fmt: skip
        plain_axes(axes)
        axes.margins(x=0.01)
    for number, (start, length) in enumerate(spans, start=1):
        if number == 1 or number % every == 0:
            grid[0].text(start + length / 2, 1.01, str(number), transform=grid[0].get_xaxis_transform(), fontsize=7,
                         ha="center", va="bottom", color="#444444")  # fmt: skip
    several = f" in {len(parts)} recordings" if len(parts) > 1 else ""
    grid[0].set_title(f"{total} poses found{several}: at rest for {still:.0f} of {shift:.0f} s", loc="left",
                      fontsize=11, fontweight="bold", pad=16)  # fmt: skip
    grid[0].set_ylabel("specific force (m/s²)")
    if rows == 2:
        grid[1].set_ylabel("angular rate (rad/s)")
        right = grid[1].secondary_yaxis("right", functions=(np.degrees, np.radians))
        right.set_ylabel("(°/s)")
        right.spines["right"].set_visible(False)
    grid[-1].set_xlabel("time (s)" + (", one recording after another" if len(parts) > 1 else ""))
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=4, frameon=False, fontsize=9)
    return figure


# --- residuals --------------------------------------------------------------------------------------------------------


def residual_figure(found: Evidence) -> Figure:
    """Draw the errors by pose and by turn, before and after, with what the noise explains."""
    rows = 3 if len(found.turn) else 2
    figure = new_figure(2.35 * rows)
    grid = figure.subplots(rows, 1, sharex=True, height_ratios=(0.7, 1, 1)[:rows])
    pose = np.arange(1, len(found.norm_after) + 1)

    before, after = (float(np.sqrt(np.mean(each**2))) for each in (found.norm_before, found.norm_after))
    grid[0].stem(pose, found.norm_before, linefmt=BEFORE, markerfmt="o", basefmt=" ")
    grid[0].axhline(0, color="black", linewidth=0.8)
    grid[0].set_ylabel("before (m/s²)")
    _title(grid[0], f"At rest the accelerometer missed gravity by {size(before, 'm/s^2')} (rms) before calibration …")

    axes, (factor, unit) = grid[1], readable("m/s^2", after)
    edges = np.repeat(np.append(pose - 0.5, pose[-1] + 0.5), 2)[1:-1]
    for sigma, color, label in (
        (found.norm_sigma, SCATTER, "±2σ: noise and the scatter beyond it (“excess”)"),
        (found.norm_noise, NOISE, "±2σ: what the measured noise explains"),
    ):
        if color == NOISE or np.any(found.norm_sigma > 1.02 * found.norm_noise):
            band = 2 * factor * np.repeat(sigma, 2)
            axes.fill_between(edges, -band, band, color=color, alpha=0.7, linewidth=0, label=label)
    axes.axhline(0, color="black", linewidth=0.8)
    axes.plot(pose, factor * found.norm_after, "o", color=AFTER, markeredgecolor="white", markersize=5.5)
    axes.set_ylabel(f"after ({unit})")
    _title(axes, f"… and misses it by {size(after, 'm/s^2', 2)} after: {how_much_smaller(before, after)}")
    _legend_below(axes)

    if rows == 3:
        axes = grid[2]
        turn = found.turn + 1.5  # between its two poses
        before, after = (float(np.sqrt(np.mean(each**2))) for each in (found.angle_before, found.angle_after))
        for limit, color, label in (
            (found.angle_limit, SCATTER, "95 % of turns: noise and the scatter beyond it"),
            (found.angle_noise, NOISE, "95 % of turns: what the measured noise explains"),
        ):
            if color == NOISE or np.any(found.angle_limit > 1.02 * found.angle_noise):
                width = np.full(len(turn), 1.0)
                axes.bar(turn, limit, width, color=color, alpha=0.7, linewidth=0, label=label)
        axes.plot(turn, found.angle_before, "o", color="white", markeredgecolor=BEFORE, markersize=5, label="before")
        axes.plot(turn, found.angle_after, "o", color=AFTER, markeredgecolor="white", markersize=5.5, label="after")
        everything = np.concatenate([found.angle_before, found.angle_after, found.angle_noise])
        lowest = max(float(everything[everything > 0].min(initial=1.0)), 1e-4 * float(everything.max()))
        axes.set_ylim(0.6 * lowest, 2 * float(everything.max()))
        logarithmic(axes, "y")
        axes.set_ylabel("angle error (°)")
        lost = f"by {shown(after, 2)}° (rms), before by {shown(before)}°"
        _title(axes, f"Over a turn the gyroscope loses gravity's direction {lost}")
        _legend_below(axes)
    grid[-1].set_xlabel("pose" + (" (turns lie between two poses)" if rows == 3 else ""))
    grid[-1].set_xlim(0.4, len(pose) + 0.6)
    grid[-1].xaxis.get_major_locator().set_params(integer=True)
    for axes in grid:
        plain_axes(axes)
    return figure


# --- parameters -------------------------------------------------------------------------------------------------------


def correlations(calibration: Calibration) -> FloatArray:
    """Return the correlation matrix (p, p) of the free parameters."""
    sigma = np.sqrt(np.diagonal(calibration.covariance))
    sigma = np.where(sigma > 0, sigma, 1.0)
    return calibration.covariance / sigma[:, None] / sigma


def strongest_pair(calibration: Calibration) -> tuple[Name, Name, float] | None:
    """Return the two parameters that are correlated most, and how.

    Two scales of the accelerometer are left out: they share the uncertainty of gravity.
    """
    matrix = correlations(calibration) - np.eye(len(calibration.names))
    scales = [place for place, name in enumerate(calibration.names)
              if (name.owner, name.part) == ("accelerometer", "gain") and name.axes[0] == name.axes[1]]  # fmt: skip
    matrix[np.ix_(scales, scales)] = 0.0
    first, second = sorted(np.unravel_index(int(np.argmax(np.abs(matrix))), matrix.shape))
    if first == second:
        return None
    return calibration.names[first], calibration.names[second], float(matrix[first, second])


def correlation_figure(calibration: Calibration) -> Figure:
    """Draw which parameters the data can only tell together."""
    names = [short_name(name, calibration.imu) for name in calibration.names]
    matrix = correlations(calibration)
    count = len(names)
    height = max(4.6, 0.36 * count + 1.0)
    figure = new_figure(height)
    figure.set_figwidth(min(_WIDTH, height + 1.2))
    axes, scale = figure.subplots(1, 2, width_ratios=(1, 0.04))
    image = axes.imshow(matrix, cmap="RdBu_r", vmin=-1, vmax=1)
    axes.set_xticks(range(count), names, rotation=90, fontsize=8)
    axes.set_yticks(range(count), names, fontsize=8)
    for row, column in zip(*np.nonzero(np.abs(matrix) >= 0.3), strict=True):
        if row != column:
            value = matrix[row, column]
            text = f"{value:+.2f}".replace("-", "−").replace("0.", ".")
            color = "white" if abs(value) > 0.7 else "black"
            axes.text(column, row, text, ha="center", va="center", fontsize=6.5, color=color)
    for place in range(1, count):
        before, after = calibration.names[place - 1], calibration.names[place]
        if (before.owner, before.effect, before.part) != (after.owner, after.effect, after.part):
            heavy = before.owner != after.owner
            for line in (axes.axhline, axes.axvline):
                line(place - 0.5, color="black", linewidth=1.4 if heavy else 0.5)
    figure.colorbar(image, cax=scale, label="correlation (−1 to 1)")
    pair = strongest_pair(calibration)
    if pair is not None:
        closest = " and ".join(short_name(name, calibration.imu) for name in pair[:2])
        text = f"{closest} ({pair[2]:+.2f})".replace("-", "−")
        if abs(pair[2]) > 0.9:
            what = "Hard to tell apart"
        elif calibration.weak:
            what = "Weak combinations hold more than two parameters;\nthe closest pair"
        else:
            what = "No two parameters can be confused;\nthe closest pair"
        _title(axes, f"{what}: {text}")
    return figure


# --- orientations -----------------------------------------------------------------------------------------------------


def _flat(directions: FloatArray) -> FloatArray:
    """Map a half sphere about ±z to a disc of radius one; equal areas stay equal (Lambert)."""
    across = np.linalg.norm(directions[:, :2], axis=1)
    radius = np.sqrt(np.maximum(1 - np.abs(directions[:, 2]), 0.0))
    return directions[:, :2] * (radius / np.maximum(across, 1e-12))[:, None]


def _labels(spots: FloatArray, numbers: NDArray[np.intp]) -> list[tuple[FloatArray, str]]:
    """One label for all poses that fall on nearly the same spot: their numbers, the first three of them."""
    left, labels = list(range(len(spots))), []
    while left:
        near = [place for place in left if np.linalg.norm(spots[place] - spots[left[0]]) < 0.07]
        text = ", ".join(str(numbers[place]) for place in near[:3]) + (" …" if len(near) > 3 else "")
        labels.append((spots[left[0]], text))
        left = [place for place in left if place not in near]
    return labels


def orientation_figure(found: Evidence) -> Figure:
    """Draw which way was up in each pose, and where no pose was."""
    figure = new_figure(5.4)
    places = figure.add_gridspec(2, 2, height_ratios=(1, 0.03))
    grid = [figure.add_subplot(places[0, column]) for column in range(2)]
    span = 1000 * float(np.max(np.abs(found.norm_after)))
    gap, where = largest_gap(found.directions)
    ticks = np.linspace(-1, 1, 161)
    x, y = (each.ravel() for each in np.meshgrid(ticks, ticks))
    radius = np.hypot(x, y)
    height = 1 - np.minimum(radius, 1.0) ** 2
    scale = np.sqrt(1 - height**2) / np.maximum(radius, 1e-12)
    dots, outlined = None, {"s": 70, "edgecolors": "black", "linewidths": 0.8, "zorder": 3}
    for axes, sign in zip(grid, (1, -1), strict=True):
        points = np.stack([scale * x, scale * y, sign * height], axis=1)
        angles = np.where(radius <= 1, nearest_angles(points, found.directions), np.nan).reshape(161, 161)
        axes.contourf(ticks, ticks, angles, levels=[0, 30, 45, 60, 181], colors=GAPS)
        circle = np.linspace(0, 2 * np.pi, 200)
        axes.plot(np.cos(circle), np.sin(circle), color="black", linewidth=1)
        for tilt in (30, 60):
            ring = np.sqrt(1 - np.cos(np.radians(tilt)))
            axes.plot(ring * np.cos(circle), ring * np.sin(circle), color="#BBBBBB", linewidth=0.5)
        here = (found.directions[:, 2] >= 0) if sign > 0 else (found.directions[:, 2] < 0)
        spot = _flat(found.directions[here])
        dots = axes.scatter(*spot.T, c=1000 * found.norm_after[here], cmap="PuOr_r", vmin=-span, vmax=span, **outlined)
        for (px, py), text in _labels(spot, np.flatnonzero(here) + 1):
            axes.annotate(text, (px, py), (5, 4), textcoords="offset points", fontsize=7, color="#333333", zorder=5)
        if (where[2] >= 0) == (sign > 0):
            px, py = _flat(where[None])[0]
            axes.plot(px, py, "x", color="#CC0033", markersize=10, markeredgewidth=2.2, zorder=4)
            axes.annotate(f"{gap:.0f}°", (px, py), (8, -11), textcoords="offset points", fontsize=9, color="#CC0033",
                          fontweight="bold", zorder=4)  # fmt: skip
        for px, py, text in ((1.15, 0, "+x"), (-1.15, 0, "−x"), (0, 1.12, "+y"), (0, -1.12, "−y")):
            axes.text(px, py, text, ha="center", va="center", fontsize=9)
        axes.plot(0, 0, "+", color="#666666", markersize=7)
        middle, way = ("+z", "up") if sign > 0 else ("−z", "down")
        axes.set_title(f"{middle} in the middle: poses with z pointing {way}", fontsize=9)
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.set_xlim(-1.22, 1.22)
        axes.set_ylim(-1.18, 1.18)
    assert dots is not None
    bar = figure.colorbar(dots, cax=figure.add_subplot(places[1, :]), orientation="horizontal")
    bar.set_label("error of gravity's magnitude after calibration (mm/s²)")
    if gap < 45:
        title = f"Orientations are well spread: every direction lies within {gap:.0f}° of a pose"
    else:
        what = "Orientations are missing" if gap > 60 else "Orientations have gaps"
        title = f"{what}: the cross lies {gap:.0f}° from the nearest pose"
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, fontweight="bold")
    key = "dot: body direction that pointed up in a pose (number); grey: farther than 30°, 45°, 60° from every pose"
    figure.supxlabel(key, fontsize=8, color="#444444")
    return figure
