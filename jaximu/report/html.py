"""The report: one HTML file that works offline, made to be read by a person who did not make the recording."""

from __future__ import annotations

import base64
import hashlib
import os
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaximu.calibration import Calibration
from jaximu.ground.atomic import write_files, write_folder
from jaximu.ground.errors import InputError
from jaximu.ground.quantities import probability
from jaximu.mistakes.titles import effect_title
from jaximu.report import figures, tables, vector, words
from jaximu.report.evidence import evidence

if TYPE_CHECKING:
    import jinja2
    from matplotlib.figure import Figure

    Drawn = Mapping[str, Callable[[], Figure]]
    """Figures by name, each drawn when its turn comes: one that fails takes nothing else with it."""

__all__ = [
    "MOST_ROWS",
    "Folder",
    "TextRows",
    "page",
    "write_calibration",
    "write_failure",
    "write_page",
    "write_report",
]


Folder = str | os.PathLike[str]
"""Where the files of a report go; made if it is missing."""
TextRows = list[tuple[str, ...]]
"""The rows of a table, as texts."""
MOST_ROWS = 50
"""Rows of a table that may grow with the number of units: what is beyond is counted."""


def write_report(calibration: Calibration, folder: Folder, title: str | None = None) -> Path:
    """Write `report.html` and its pictures as PNGs into `folder`, which is made if it is missing.

    **Arguments:** `title`: the report's heading; the names of the recordings if None. A calibration that was loaded
    from its file gives a report without the pictures of the recording, because its working is not kept there.

    **Returns:** the path of `report.html`. Everything is drawn before anything is written, and each file is written
    whole or not at all. Raises `InputError` where the folder cannot be made or written to.
    """
    if "poses" not in calibration.data:
        raise InputError("a calibration of several kinds of data has no page: its summary() says what was found.")
    errors, drawn = evidence(calibration), {}
    if errors is not None:
        drawn["residuals"] = partial(figures.residual_figure, errors)
        drawn["orientations"] = partial(figures.orientation_figure, errors)
    if calibration.segmentations:
        drawn["recording"] = partial(figures.recording_of, calibration)
    picture = (
        "Errors of each pose and turn, before and after calibration",
        "“Before” is where the fit started: the nominal scale and offset, no misalignment. The inner band is what the "
        "noise, measured while the unit was still, explains; where a wider one surrounds it, the errors scatter more "
        "than that, and the intervals below count with the wider one.",
    )
    return write_calibration(
        calibration,
        folder,
        words.lead(calibration),
        words.trust(calibration),
        words.limits(calibration, errors),
        drawn,
        picture,
        title,
    )


def write_calibration(
    calibration: Calibration,
    folder: Folder,
    lead: tuple[str, str, str],
    trust: Iterable[words.Statement],
    unknown: Iterable[words.Statement],
    drawn: Drawn,
    residuals: tuple[str, str] = ("", ""),
    title: str | None = None,
) -> Path:
    """Write the report of any calibration into a folder; return its path.

    **Arguments:** `lead`: the one sentence, the one number and what it means; `trust`, `unknown`: what to trust, what
    the data cannot show; `drawn`: its figures by name, `residuals` for one with these alternative text and caption.

    Raises `InputError` where the folder cannot be made or written to; nothing is then left half-written.
    """
    sources = [
        [str(file.get(key, "")) for key in ("file", "rows", "sha256")] for file in calibration.data.get("files", [])
    ]
    triads, trust = calibration.triads(), [*trust]
    return write_page(
        folder,
        "calibration",
        {**drawn, "correlation": partial(figures.correlation_figure, calibration)},
        title=title or f"Calibration from {', '.join(Path(source[0]).name for source in sources) or 'a recording'}",
        lead=lead[0],
        number=lead[1],
        meaning=lead[2],
        trust=trust,
        limits=[*unknown],
        weak=len(calibration.weak),
        warnings=[
            statement.about for statement in trust if statement.caution and not statement.about.startswith("What")
        ],
        residuals=residuals,
        shared_gravity=calibration.gravity.sigma > 0 and "accelerometer" in triads,
        equations=tables.equations(calibration),
        snippet=tables.snippet(calibration),
        tables=[(name, tables.rows(calibration, name, triad)) for name, triad in triads.items()],
        sources=sources,
        facts=tables.provenance(calibration),
        notes=calibration.notes,
    )


def write_page(folder: Folder, template: str, drawn: Drawn, **values: Any) -> Path:
    """Write a page as `report.html` and its pictures as PNGs into a folder, all or none; return the page's path.

    Raises `InputError` where the folder cannot be made or written to.
    """
    text, pictures = page(template, drawn, **values)
    return write_folder(folder, pictures | {"report.html": text})[-1]


def page(template: str, drawn: Drawn, *, notes: Sequence[str] = (), **values: Any) -> tuple[bytes, dict[str, bytes]]:
    """Return a page from one of this folder's templates, and its pictures by the names of their files.

    The page has no folders of the machine that made it, and its tables say in each cell what its column is. A
    template shows `title`, `lead` (a sentence or several), `number` with its `meaning`, and `notes` as all pages do.
    In place of a figure that cannot be drawn the page says so.
    """
    pictures: dict[str, bytes] = {}
    sources: dict[str, vector.Drawing | str] = {}
    for name, draw in drawn.items():
        try:
            figure = draw()
            pictures[f"{name}.png"] = figures.png(figure)
            sources[name] = vector.drawing(figure, name)
        except Exception as error:
            sources[name] = _failure(f"The figure “{name}”", error)
    text = (
        _environment()
        .get_template(f"{template}.html.jinja")
        .render(pictures=sources, notes=[words.sentence(note) for note in notes], **values)
    )
    text = _TABLE.sub(_labelled, _FOLDERS.sub("", text))
    return text.encode("utf-8", "backslashreplace"), pictures  # names of files need not be valid text


def write_failure(path: Path, error: Exception) -> tuple[Path, ...]:
    """Write a page that says why a report could not be drawn, in place of the report; return its path."""
    text = escape(_failure("The report", error))
    page = f"<!DOCTYPE html>\n<meta charset=utf-8>\n<title>Report</title>\n<p>{text}</p>\n"
    return write_files({path: page.encode("utf-8", "backslashreplace")})


def _failure(part: str, error: Exception) -> str:
    """Warn of a part that could not be drawn, a defect of ours; return what the page says in its place."""
    if os.environ.get("JAXIMU_DEBUG"):
        raise error
    text = (
        f"{part} could not be drawn ({type(error).__name__}: {error}). The results do not depend on it. Please report "
        "this."
    )
    warnings.warn(text, stacklevel=3)
    return text


def _file(name: str) -> str:
    return files("jaximu.report").joinpath(name).read_text(encoding="utf-8")


@cache
def _environment() -> jinja2.Environment:
    import jinja2

    made = jinja2.Environment(
        loader=jinja2.FunctionLoader(_file),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    script = _file("figure.js")
    made.globals |= {
        "script": script,
        "script_hash": base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    }
    made.globals |= {"title_of": effect_title, "probability": probability, "sentence": words.sentence}
    return made


_FOLDERS = re.compile(r"""(?<=[\s>("'])(?:/|[A-Za-z]:[\\/])(?:[^\s<>"'/\\;&]+[/\\])+(?=[^\s<>])""")
_TABLE = re.compile(r'<div class="scroll"><table.*?</table>', re.DOTALL)


def _labelled(match: re.Match[str]) -> str:
    """Write into each cell of a table which column it is in: a telephone shows rows one below the other."""
    head, separator, body = match[0].partition("</thead>")
    labels = [re.sub("<[^>]*>", "", label) for label in re.findall(r"<th\b[^>]*>(.*?)</th>", head, re.DOTALL)]

    def row(line: re.Match[str]) -> str:
        cells = iter(labels)
        return re.sub(r"<t([dh])\b", lambda cell: f'<t{cell[1]} data-label="{next(cells, "")}"', line[0])

    return head + separator + (re.sub(r"<tr\b.*?</tr>", row, body, flags=re.DOTALL) if labels and separator else body)
