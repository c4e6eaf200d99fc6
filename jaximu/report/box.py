"""A unit drawn as a flat box with its axes, as the person who holds it sees it."""

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.report import figures
from jaximu.report.canvas import Axes

AXES_WORDS = (
    "Arrows are its axes, coloured faces their positive ends; dashed arrows point away from you. A minus marks the "
    "negative ends."
)
"""What a reader needs to read the drawing."""
_ELEVATION, _SIDE = np.radians(20.0), np.radians(-15.0)  # the person looks down a little, and a little from the right


def _view(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Project level-frame points (..., 3) onto the picture (..., 2); and how far they are (...)."""
    cosine, sine = np.cos(_SIDE), np.sin(_SIDE)
    right = cosine * points[..., 0] + sine * points[..., 1]
    away = -sine * points[..., 0] + cosine * points[..., 1]
    up = points[..., 2]
    cosine, sine = np.cos(_ELEVATION), np.sin(_ELEVATION)
    return np.stack([right, cosine * up + sine * away], axis=-1), cosine * away - sine * up


def draw_floor(axes: Axes, by_hand: bool) -> None:
    """Draw the table top below the unit, and where the person who holds it stands; `axes`: without a frame."""
    from matplotlib.patches import Polygon

    flat, _ = _view(1.15 * np.array([[-1, -1, -0.9], [1, -1, -0.9], [1, 1, -0.9], [-1, 1, -0.9]]))
    axes.add_patch(Polygon(flat, facecolor="#EDEDED", edgecolor="#BBBBBB", linewidth=0.8, zorder=0))
    if by_hand:
        x, y = _view(np.array([0.0, -1.4, -1.035]))[0]
        axes.text(x, y, "you", ha="center", va="center", fontsize=9)


def draw_unit(axes: Axes, rotation: FloatArray) -> None:
    """Draw a flat box and its axes, which are the columns of `rotation` (3, 3), body to level frame."""
    from matplotlib.patches import Polygon

    half = np.array([0.62, 0.45, 0.2])
    for axis, (name, color) in enumerate(figures.AXES.items()):
        other = (axis + 1) % 3
        third = (axis + 2) % 3
        direction = rotation[:, axis]
        for sign in (1.0, -1.0):
            corners = np.zeros((4, 3))
            corners[:, axis] = sign * half[axis]
            corners[:, other] = half[other] * np.array([1, -1, -1, 1])
            corners[:, third] = half[third] * np.array([1, 1, -1, -1])
            _, depth = _view(direction * sign)
            if depth < 0:  # towards the viewer
                flat, _ = _view(corners @ rotation.T)
                face = {"facecolor": "#F6F6F6", "alpha": 0.9} if sign < 0 else {"facecolor": color, "alpha": 0.45}
                axes.add_patch(Polygon(flat, edgecolor="#444444", linewidth=0.9, zorder=2, **face))
                if sign < 0 and depth < -0.2:  # an arrow names the positive ends
                    x, y = flat.mean(axis=0)
                    axes.text(x, y, f"−{name}", color=color, ha="center", va="center", fontsize=10, zorder=3)
        start, _ = _view(direction * half[axis])
        stop, depth = _view(direction * 1.15)
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
