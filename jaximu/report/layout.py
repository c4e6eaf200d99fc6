"""Places a figure's panels by the sizes of their words, reckoned from characters and lines: nothing is drawn for it.

matplotlib's constrained layout draws every word twice before it draws the figure, which takes three times as long.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from numpy.typing import NDArray

__all__ = ["BELOW", "place_panels"]

BELOW = "below the panel"
"""A panel's legend with this `gid` is placed under its axis."""
_LINE, _LETTER = 1.2, 0.56  # height of a line, mean width of a letter, in font sizes
_EDGE, _BETWEEN, _TICK, _LABEL, _TITLE = 6.0, 6.0, 7.0, 4.0, 6.0  # points


def place_panels(figure: Figure) -> None:
    """Place the panels of a figure; its own legend stands at the bottom, its title at the top."""
    panels = [(axes, span) for axes in figure.axes if (span := axes.get_subplotspec()) is not None]
    if not panels:
        return
    width, height = 72.0 * figure.get_size_inches()
    grid = panels[0][1].get_gridspec()
    margins = [_margins(axes) for axes, _ in panels]
    above = _lines(figure.get_suptitle(), 12.0) + _EDGE
    below = _lines(figure.get_supxlabel(), 9.0) + _EDGE + sum(map(_height, figure.legends))
    columns = [(span.colspan, *margin[:2]) for (_, span), margin in zip(panels, margins, strict=True)]
    rows = [(span.rowspan, *margin[2:]) for (_, span), margin in zip(panels, margins, strict=True)]
    across = _edges(width, _EDGE, _EDGE, np.asarray(grid.get_width_ratios()), columns)
    down = _edges(height, above, below, np.asarray(grid.get_height_ratios()), rows)
    for (axes, span), (*_, bottom) in zip(panels, margins, strict=True):
        left, right = across[span.colspan.start, 0], across[span.colspan.stop - 1, 1]
        top, end = down[span.rowspan.start, 0], down[span.rowspan.stop - 1, 1]
        axes.set_position((left / width, 1 - end / height, (right - left) / width, (end - top) / height))
        legend = axes.get_legend()
        if legend is not None and legend.get_gid() == BELOW:
            legend.set_bbox_to_anchor((0.5, (_height(legend) - bottom) / (end - top)), axes.transAxes)


def _edges(
    whole: float, first: float, last: float, ratios: NDArray, panels: list[tuple[range, float, float]]
) -> NDArray[np.float64]:
    """Return where each row or column (n, 2) begins and ends, in points.

    `panels`: the rows or columns that each spans, and the room that it needs before and after.
    """
    before, after = np.zeros(len(ratios)), np.zeros(len(ratios))
    for span, leading, trailing in panels:
        before[span.start] = max(before[span.start], leading)
        after[span.stop - 1] = max(after[span.stop - 1], trailing)
    gaps = np.concatenate([[first + before[0]], after[:-1] + before[1:] + _BETWEEN, [after[-1] + last]])
    lengths = max(whole - gaps.sum(), 0.2 * whole) * ratios / ratios.sum()
    starts = np.cumsum(gaps[:-1]) + np.concatenate([[0.0], np.cumsum(lengths)[:-1]])
    return np.stack([starts, starts + lengths], axis=1)


def _margins(axes: Axes) -> tuple[float, float, float, float]:
    """Return the room that a panel needs at its left, right, top and bottom, in points."""
    heads = [axes.get_title(loc) for loc in ("left", "center", "right")]
    top = max((_lines(text, 11.0) + _TITLE for text in heads if text), default=_EDGE)
    if any(text.get_position()[1] > 1 and text.get_transform() != axes.transData for text in axes.texts):
        top += 10.0  # words above the panel
    if axes.name == "3d":
        return 0.0, 18.0, top, 6.0
    if not axes.axison:
        return 0.0, 0.0, top, 0.0
    left, right, bottom = _beside(axes.yaxis, False), 8.0, _beside(axes.xaxis, True)
    if axes.yaxis.get_label_position() == "right":
        left, right = _EDGE, left
    for child in axes.child_axes:  # a second scale, whose numbers are known when it is drawn
        right = max(right, _TICK + 30.0 + _label(child.yaxis))
    top += _LINE * 10.0 if axes.yaxis.get_major_formatter().get_offset() else 0.0
    legend = axes.get_legend()
    if legend is not None and legend.get_gid() == BELOW:
        bottom += _height(legend)
    return left, right, top, bottom


def _beside(axis: Axis, level: bool) -> float:
    """Return the room that an axis' numbers and label need; `level`: it runs from left to right."""
    room = 0.0
    for label in axis.get_ticklabels() if axis.get_visible() else ():
        size, lines = float(label.get_fontsize()), label.get_text().split("\n")
        along = _LETTER * size * max(map(len, lines)), _LINE * size * len(lines) * bool(lines[0])
        upright = bool(label.get_rotation()) == level
        room = max(room, along[0] if upright else along[1])
    return _TICK + room + _label(axis)


def _label(axis: Axis) -> float:
    text = axis.get_label_text()
    return _lines(text, float(axis.label.get_fontsize())) + _LABEL if text else 0.0


def _lines(text: str, size: float) -> float:
    return _LINE * size * (text.count("\n") + 1) if text else 0.0


def _height(legend: Legend) -> float:
    figure = legend.get_figure(root=True)
    return 72.0 * legend.get_window_extent().height / figure.dpi if figure else 0.0
