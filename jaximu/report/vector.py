"""A figure as SVG for a page: its words stay words, and its panels say what a script needs to show values."""

from __future__ import annotations

import html
import io
import json
import re
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaximu.ground.document import Json

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure


_MOST_MARKS, _MOST_OF_ALL, _MOST_VERTICES = 1500, 4000, 6000
"""Marks of one artist, marks of a figure, vertices of a line: what has more is an image, or the page would be large."""
_LONGEST_UNIT = 12


_ONE_AT_A_TIME = threading.Lock()
"""Settings of matplotlib are those of the whole process."""


class Drawing(NamedTuple):
    """A figure's width and height in points, and what stands inside its `<svg>` element."""

    width: float
    height: float
    inner: str


def named(artist: Artist, names: Sequence[str]) -> None:
    """Give each of an artist's points the words that a page shows beside it."""
    artist.set_gid(json.dumps(list(names)))


def drawing(figure: Figure, name: str) -> Drawing:
    """Return a figure as SVG whose ids begin with `name`: several stand in one page. Equal figures give equal text."""
    import matplotlib as mpl

    width, height = map(float, 72.0 * figure.get_size_inches())
    attributes = _mark(figure)
    written = io.StringIO()
    with _ONE_AT_A_TIME, mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(written, format="svg", dpi=150, metadata={"Date": None})
    text = written.getvalue().partition("</metadata>")[2].rpartition("</svg>")[0]
    attributes |= {
        f"panel {number}": {"panel": json.dumps(_panel(axes, width, height))}
        for number, axes in enumerate(figure.axes)
        if axes.name != "3d"
    }
    text = re.sub(r"<style.*?</style>", "", text, flags=re.DOTALL).replace("xlink:href", "href")
    text = re.sub(r"font-family: [^;\"]*", "", text)
    text = re.sub(r' (?:d|x|y)="[^"]*"', lambda match: re.sub(r"(\.\d\d)\d+|\n", r"\1", match[0]), text)
    referred = {
        reference: f"{name}-{number}" for number, reference in enumerate(dict.fromkeys(_REFERENCE.findall(text)))
    }

    def attribute(match: re.Match[str]) -> str:
        if match[1] in referred:
            return f' id="{referred[match[1]]}"'
        values = attributes.get(html.unescape(match[1]), {})
        return "".join(f' data-{key}="{html.escape(value)}"' for key, value in values.items())

    text = re.sub(r' id="([^"]*)"', attribute, text)
    text = _REFERENCE.sub(lambda match: match[0].replace(match[1], referred[match[1]]), text)
    return Drawing(width, height, re.sub(r">\s+<", "><", text.strip()))


_REFERENCE = re.compile(r"(?:href=\"#|url\(#)([^\")]+)")


def _mark(figure: Figure) -> dict[str, dict[str, str]]:
    """Give panels and what is drawn by data an id; return what a page says of each in place of it."""
    from matplotlib.collections import PathCollection
    from matplotlib.patches import Patch

    attributes = {}
    counts = []
    for panel, axes in enumerate(figure.axes):
        axes.set_gid(f"panel {panel}")
        lines = [line for line in axes.lines if line.get_transform() == axes.transData]
        dots = [collection for collection in axes.collections if isinstance(collection, PathCollection)]
        drawn: dict[Artist, str] = {artist: str(artist.get_label()) for artist in (*lines, *dots)}
        for bars in axes.containers:
            drawn |= {bar: str(bars.get_label()) for bar in bars if isinstance(bar, Patch)}
        for number, (artist, label) in enumerate(drawn.items()):
            gid = artist.get_gid() or ""
            key = f"marks {panel} {number}"
            attributes[key] = {"name": "" if label.startswith("_") else label} | (
                {"names": gid} if gid[:1] == "[" else {}
            )
            artist.set_gid(key)
        for line in axes.lines:
            bare = str(line.get_marker()) in ("None", "none", "", " ")
            line.set_rasterized(bare and np.size(line.get_xdata()) > _MOST_VERTICES)
            counts += [] if bare else [(line, np.size(line.get_xdata()))]
        if axes.name == "3d":  # hundreds of faces, and no value to read from a place
            counts += [(collection, _MOST_OF_ALL) for collection in axes.collections if collection not in dots]
        else:
            counts += [(dot, len(np.asarray(dot.get_offsets()))) for dot in dots]
    whole = sum(count for _, count in counts)
    for artist, count in counts:
        artist.set_rasterized(count > (_MOST_MARKS if whole <= _MOST_OF_ALL else 300))
    return attributes


def _panel(axes: Axes, width: float, height: float) -> Json:
    """Return where a panel is, in points from the top left, and what its axes are, if it shows them."""
    (left, bottom), (right, top) = axes.get_position().get_points()
    panel: Json = {
        "box": [round(edge, 2) for edge in (left * width, height * (1 - top), right * width, height * (1 - bottom))]
    }
    if not axes.axison:
        return panel
    image = axes.images[0].get_array() if axes.images else None
    if image is not None and image.ndim == 2:
        panel["grid"] = [[float(f"{value:.3g}") for value in row] for row in np.asarray(image)]
    title = next((axes.get_title(loc) for loc in ("left", "center") if axes.get_title(loc)), "")
    across, up = axes.get_shared_x_axes().get_siblings(axes), axes.get_shared_y_axes().get_siblings(axes)
    panel["x"] = _axis(axes.xaxis, [*(sibling.get_xlabel() for sibling in (axes, *across)), ""], axes.get_xlim())
    panel["y"] = _axis(axes.yaxis, [*(sibling.get_ylabel() for sibling in (axes, *up)), title], axes.get_ylim())
    return panel


def _axis(axis: Axis, labels: Sequence[str], ends: tuple[float, float]) -> Json:
    """Return an axis' ends, kind, words and unit, and the names of its places where it has names and no numbers."""
    from matplotlib.dates import DateConverter
    from matplotlib.ticker import FixedLocator

    text = next((label for label in labels if label), "").replace("\n", " ")
    words, unit = re.fullmatch(r"(.*?)\s*(?:[(\[]([^()\[\]]*)[)\]][^()\[\]]*)?", text).groups()  # type: ignore[union-attr]
    attributes: Json = {"ends": [float(f"{end:.9g}") for end in ends], "words": words or labels[-1]}
    attributes |= {"unit": unit} if unit and len(unit) <= _LONGEST_UNIT and " to " not in unit else {}
    attributes |= {"scale": "log"} if axis.get_scale() == "log" else {}
    attributes |= {"scale": "date"} if isinstance(axis.get_converter(), DateConverter) else {}
    locator = axis.get_major_locator()
    if isinstance(locator, FixedLocator) or type(locator).__name__ == "StrCategoryLocator":
        places = np.asarray(locator())
        texts = axis.get_major_formatter().format_ticks(list(places))
        if np.array_equal(places, np.arange(len(places))) and not any(map(str.isdecimal, texts)):
            attributes["names"] = [name.replace("\n", " ") for name in texts]
    return attributes
