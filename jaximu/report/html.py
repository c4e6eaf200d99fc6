"""The report: one HTML file that works offline, made to be read by a person who did not make the recording."""

from __future__ import annotations

import base64
import hashlib
import os
import re
import warnings
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup, escape

from jaximu.ground.atomic import write_files, write_folder
from jaximu.ground.errors import FilePath, worded
from jaximu.ground.page import Page, Part, Picture, Result, Section
from jaximu.ground.quantities import sentence

if TYPE_CHECKING:
    import jinja2
    from matplotlib.figure import Figure

    from jaximu.report.vector import Drawing


_LONG_WORD = 40  # letters from which on a cell's word is broken


def write_report(result: Result | Page, folder: FilePath) -> Path:
    """Write a result's page as `report.html` and its pictures as PNGs into `folder`, which is made if it is missing.

    **Returns:** the path of `report.html`. Everything is drawn before anything is written, and each file is written
    whole or not at all. Raises `InputError` where the folder cannot be made or written to.
    """
    text, pictures = encoded(result.summary())
    return write_folder(folder, pictures | {"report.html": text})[-1]


def encoded(page: Page) -> tuple[bytes, dict[str, bytes]]:
    """Return a page as HTML, and its pictures by the names of their files.

    The page has no folders of the machine that made it. In place of a figure that cannot be drawn the page says so.
    """
    first = [*page.first]
    rest = [*page.rest()]
    pictures = {}
    drawings = {}
    for picture in _pictures([*first, *rest]):
        try:
            drawings[picture.name], pictures[f"{picture.name}.png"] = _drawn(picture.draw(), picture.name)
        except Exception as error:
            drawings[picture.name] = failure(f"The figure “{picture.name}”", error)
    text = _FOLDERS.sub(
        "", environment().get_template("page.html.jinja").render(page=page, first=first, rest=rest, drawings=drawings)
    )
    return text.encode("utf-8", "backslashreplace"), pictures  # names of files need not be valid text


def _drawn(figure: Figure, name: str) -> tuple[Drawing, bytes]:
    """Return a figure as a drawing and as a PNG; a fragment without pictures need not load what draws."""
    from jaximu.report import figures, vector

    return vector.drawing(figure, name), figures.png(figure)


def _pictures(parts: Iterable[Part]) -> Iterator[Picture]:
    for part in parts:
        match part:
            case Picture():
                yield part
            case Section(parts=inner):
                yield from _pictures(inner)


def fragment(content: Page | Part) -> str:
    """Return a page's first screen, or a part of one, as HTML for a notebook, without pictures."""
    macros: Any = environment().get_template("page_parts.html.jinja").module
    return worded(str(macros.all([content.section() if isinstance(content, Page) else content], {})))


def _inline(text: str) -> Markup:
    """Return a text as HTML: what stands between backticks is code."""
    return Markup(re.sub("`([^`]+)`", r"<code>\1</code>", str(escape(text))).replace("\n", "<br>"))


def _kind_of_cell(text: str) -> Markup:
    """Return the attribute of a cell that is a number, and stays on one line, or a long word, which is broken."""
    if max(map(len, text.split()), default=0) > _LONG_WORD:
        return Markup(' class="long"')
    return Markup(' class="value"') if re.match("([<>] )?[-+−±]?[0-9]", text) and len(text) < _LONG_WORD else Markup("")


def write_failure(path: Path, error: Exception) -> tuple[Path, ...]:
    """Write a page that says why a report could not be drawn, in place of the report; return its path."""
    text = escape(failure("The report", error))
    page = f"<!DOCTYPE html>\n<meta charset=utf-8>\n<title>Report</title>\n<p>{text}</p>\n"
    return write_files({path: page.encode("utf-8", "backslashreplace")})


def failure(part: str, error: Exception) -> str:
    """Warn of a part that could not be drawn, a defect of ours; return what the page says in its place."""
    if os.environ.get("JAXIMU_DEBUG"):
        raise error
    text = (
        f"{part} could not be drawn ({type(error).__name__}: {error}). The results do not depend on it. Please report "
        "this."
    )
    warnings.warn(text, stacklevel=3)
    return text


def packaged(name: str) -> str:
    """Return a text file of this folder."""
    return files("jaximu.report").joinpath(name).read_text(encoding="utf-8")


@cache
def environment() -> jinja2.Environment:
    """Return what renders the templates of this folder."""
    import jinja2

    made = jinja2.Environment(
        loader=jinja2.FunctionLoader(packaged),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    script = packaged("figure.js")
    made.globals |= {
        "script": script,
        "script_hash": base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    }
    made.filters |= {
        "inline": _inline,
        "sentence": sentence,
        "kind_of_cell": _kind_of_cell,
        "anchor": lambda title: re.sub(r"\W+", "-", title.lower()).strip("-"),
    }
    return made


_FOLDERS = re.compile(r"""(?<=[\s>("'])(?:/|[A-Za-z]:[\\/])(?:[^\s<>"'/\\;&]+[/\\])+(?=[^\s<>])""")
