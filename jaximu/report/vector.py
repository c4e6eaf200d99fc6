"""A figure as SVG for a page: its words stay words, and its panels say what a script needs to show values."""

from __future__ import annotations

import html
import io
import json
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

__all__ = ["Drawing", "drawing", "named"]

_MOST_MARKS, _MOST_OF_ALL, _MOST_VERTICES = 1500, 4000, 6000
"""Marks of one artist, marks of a figure, vertices of a line: what has more is an image, or the page would be large."""
_LONGEST_UNIT = 12


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
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(written, format="svg", dpi=150, metadata={"Date": None})
    text = written.getvalue().partition("</metadata>")[2].rpartition("</svg>")[0]
    attributes |= {f"panel {place}": {"panel": json.dumps(_panel(axes, width, height))}
                   for place, axes in enumerate(figure.axes) if axes.name != "3d"}  # fmt: skip
    text = re.sub(r"<style.*?</style>", "", text, flags=re.DOTALL).replace("xlink:href", "href")
    text = re.sub(r"font-family: [^;\"]*", "", text)
    text = re.sub(r' (?:d|x|y)="[^"]*"', lambda found: re.sub(r"(\.\d\d)\d+|\n", r"\1", found[0]), text)
    referred = {each: f"{name}-{place}" for place, each in enumerate(dict.fromkeys(_REFERENCE.findall(text)))}

    def attribute(found: re.Match[str]) -> str:
        if found[1] in referred:
            return f' id="{referred[found[1]]}"'
        said = attributes.get(html.unescape(found[1]), {})
        return "".join(f' data-{key}="{html.escape(value)}"' for key, value in said.items())

    text = re.sub(r' id="([^"]*)"', attribute, text)
    text = _REFERENCE.sub(lambda found: found[0].replace(found[1], referred[found[1]]), text)
    return Drawing(width, height, re.sub(r">\s+<", "><", text.strip()))


_REFERENCE = re.compile(r"(?:href=\"#|url\(#)([^\")]+)")


def _mark(figure: Figure) -> dict[str, dict[str, str]]:
    """Give panels and what is drawn by data an id; return what a page says of each in place of it."""
    from matplotlib.collections import PathCollection
    from matplotlib.patches import Patch

    said, counts = {}, []
    for place, axes in enumerate(figure.axes):
        axes.set_gid(f"panel {place}")
        lines = [each for each in axes.lines if each.get_transform() == axes.transData]
        dots = [each for each in axes.collections if isinstance(each, PathCollection)]
        drawn: dict[Artist, str] = {each: str(each.get_label()) for each in (*lines, *dots)}
        for bars in axes.containers:
            drawn |= {each: str(bars.get_label()) for each in bars if isinstance(each, Patch)}
        for number, (artist, label) in enumerate(drawn.items()):
            own = artist.get_gid() or ""
            key = f"marks {place} {number}"
            said[key] = {"name": "" if label.startswith("_") else label} | ({"names": own} if own[:1] == "[" else {})
            artist.set_gid(key)
        for line in axes.lines:
            bare = str(line.get_marker()) in ("None", "none", "", " ")
            line.set_rasterized(bare and np.size(line.get_xdata()) > _MOST_VERTICES)
            counts += [] if bare else [(line, np.size(line.get_xdata()))]
        if axes.name == "3d":  # hundreds of faces, and no value to read from a place
            counts += [(each, _MOST_OF_ALL) for each in axes.collections if each not in dots]
        else:
            counts += [(each, len(np.asarray(each.get_offsets()))) for each in dots]
    whole = sum(count for _, count in counts)
    for artist, count in counts:
        artist.set_rasterized(count > (_MOST_MARKS if whole <= _MOST_OF_ALL else 300))
    return said


def _panel(axes: Axes, width: float, height: float) -> dict[str, Any]:
    """Return where a panel is, in points from the top left, and what its axes are, if it shows them."""
    (left, bottom), (right, top) = axes.get_position().get_points()
    said: dict[str, Any] = {"box": [round(each, 2) for each in (left * width, height * (1 - top),
                                                                right * width, height * (1 - bottom))]}  # fmt: skip
    if not axes.axison:
        return said
    image = axes.images[0].get_array() if axes.images else None
    if image is not None and image.ndim == 2:
        said["grid"] = [[float(f"{value:.3g}") for value in row] for row in np.asarray(image)]
    title = next((axes.get_title(loc) for loc in ("left", "center") if axes.get_title(loc)), "")
    across, up = axes.get_shared_x_axes().get_siblings(axes), axes.get_shared_y_axes().get_siblings(axes)
    said["x"] = _axis(axes.xaxis, [*(each.get_xlabel() for each in (axes, *across)), ""], axes.get_xlim())
    said["y"] = _axis(axes.yaxis, [*(each.get_ylabel() for each in (axes, *up)), title], axes.get_ylim())
    return said


def _axis(axis: Axis, labels: Sequence[str], ends: tuple[float, float]) -> dict[str, Any]:
    """Return an axis' ends, kind, words and unit, and the names of its places where it has names and no numbers."""
    from matplotlib.dates import DateConverter
    from matplotlib.ticker import FixedLocator

    text = next((each for each in labels if each), "").replace("\n", " ")
    words, unit = re.fullmatch(r"(.*?)\s*(?:[(\[]([^()\[\]]*)[)\]][^()\[\]]*)?", text).groups()  # type: ignore[union-attr]
    said: dict[str, Any] = {"ends": [float(f"{each:.9g}") for each in ends], "words": words or labels[-1]}
    said |= {"unit": unit} if unit and len(unit) <= _LONGEST_UNIT and " to " not in unit else {}
    said |= {"scale": "log"} if axis.get_scale() == "log" else {}
    said |= {"scale": "date"} if isinstance(axis.get_converter(), DateConverter) else {}
    locator = axis.get_major_locator()
    if isinstance(locator, FixedLocator) or type(locator).__name__ == "StrCategoryLocator":
        places = np.asarray(locator())
        texts = axis.get_major_formatter().format_ticks(list(places))
        if np.all(places == np.arange(len(places))) and not any(map(str.isdecimal, texts)):
            said["names"] = [each.replace("\n", " ") for each in texts]
    return said
