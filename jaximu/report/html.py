"""The report: one HTML file that works offline, made to be read by a person who did not make the recording."""

from __future__ import annotations

import base64
import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaximu.calibration import Calibration
from jaximu.effects import effect_title
from jaximu.formats.atomic import write_folder
from jaximu.formats.document import Document
from jaximu.quantities import probability
from jaximu.report import figures, tables, vector, words
from jaximu.report.evidence import evidence

if TYPE_CHECKING:
    import jinja2
    from matplotlib.figure import Figure

__all__ = ["page", "write_calibration", "write_page", "write_report"]


def write_report(calibration: Calibration, folder: str | os.PathLike[str], title: str | None = None) -> Path:
    """Write `report.html` and its pictures as PNGs into `folder`, which is made if it is missing.

    **Arguments:** `title`: the report's heading; the names of the recordings if None. A calibration that was loaded
    from its file gives a report without the pictures of the recording, because its working is not kept there.

    **Returns:** the path of `report.html`. Everything is drawn before anything is written, and each file is written
    whole or not at all. Raises `InputError` where the folder cannot be made or written to.
    """
    found, drawn = evidence(calibration), {}
    if found is not None:
        drawn = {"residuals": figures.residual_figure(found), "orientations": figures.orientation_figure(found)}
    if calibration.segmentations:
        drawn["recording"] = figures.recording_of(calibration)
    said = (
        "Errors of each pose and turn, before and after calibration",
        "“Before” is where the fit started: the nominal scale and offset, no misalignment. The inner band is what the "
        "noise, measured while the unit was still, explains; where a wider one surrounds it, the errors scatter more "
        "than that, and the intervals below count with the wider one.",
    )
    return write_calibration(calibration, folder, words.lead(calibration), words.trust(calibration),
                             words.limits(calibration, found), drawn, said, title)  # fmt: skip


def write_calibration(
    calibration: Calibration,
    folder: str | os.PathLike[str],
    lead: tuple[str, str, str],
    said: Sequence[words.Statement],
    unknown: Sequence[words.Statement],
    drawn: Mapping[str, Figure],
    residuals: tuple[str, str] = ("", ""),
    title: str | None = None,
) -> Path:
    """Write the report of any calibration into a folder; return its path.

    **Arguments:** `lead`: the one sentence, the one number and what it means; `said`, `unknown`: what to trust, what
    the data cannot show; `drawn`: its figures by name, `residuals` for one with these alternative text and caption.

    Raises `InputError` where the folder cannot be made or written to; nothing is then left half-written.
    """
    sources = [[str(each.get(key, "")) for key in ("file", "rows", "sha256")]
               for each in calibration.data.get("files", [])]  # fmt: skip
    triads = calibration.triads()
    return write_page(
        folder, "calibration", {**drawn, "correlation": figures.correlation_figure(calibration)},
        title=title or f"Calibration from {', '.join(Path(each[0]).name for each in sources) or 'a recording'}",
        lead=lead[0], number=lead[1], meaning=lead[2], trust=said, limits=unknown, weak=len(calibration.weak),
        warnings=[each.about for each in said if each.caution and not each.about.startswith("What")],
        residuals=residuals, shared_gravity=calibration.gravity.sigma > 0 and "accelerometer" in triads,
        equations=tables.equations(calibration), snippet=tables.snippet(calibration),
        tables=[(name, tables.rows(calibration, name, triad)) for name, triad in triads.items()],
        sources=sources, facts=tables.provenance(calibration), notes=calibration.notes,
    )[-1]  # fmt: skip


def write_page(
    folder: str | os.PathLike[str], template: str, drawn: Mapping[str, Figure], document: Document | None = None,
    **values: Any,
) -> tuple[Path, ...]:  # fmt: skip
    """Write a document as TEMPLATE.json, pictures as PNGs and the page as `report.html` into a folder: all or none.

    **Returns:** their paths, the page's last. Raises `InputError` where the folder cannot be made or written to.
    """
    text, pictures = page(template, drawn, **values)
    contents = {} if document is None else {f"{template}.json": (document.text() + "\n").encode()}
    return write_folder(folder, contents | pictures | {"report.html": text})


def page(template: str, drawn: Mapping[str, Figure], *, notes: Sequence[str] = (), **values: Any
         ) -> tuple[bytes, dict[str, bytes]]:  # fmt: skip
    """Return a page from one of this folder's templates, and its pictures by the names of their files.

    The page has no folders of the machine that made it, and its tables say in each cell what its column is. A
    template shows `title`, `lead` (a sentence or several), `number` with its `meaning`, and `notes` as all pages do.
    """
    pictures = {name: figures.png(figure) for name, figure in drawn.items()}
    sources = {name: vector.drawing(figure, name) for name, figure in drawn.items()}
    text = _environment().get_template(f"{template}.html.jinja").render(
        pictures=sources, notes=[words.sentence(each) for each in notes], **values
    )  # fmt: skip
    text = _TABLE.sub(_labelled, _FOLDERS.sub("", text))
    # names of files need not be valid text
    return text.encode("utf-8", "backslashreplace"), {f"{name}.png": each for name, each in pictures.items()}


def _file(name: str) -> str:
    return files("jaximu.report").joinpath(name).read_text(encoding="utf-8")


@cache
def _environment() -> jinja2.Environment:
    import jinja2

    made = jinja2.Environment(
        loader=jinja2.FunctionLoader(_file),
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        keep_trailing_newline=True,
    )  # fmt: skip
    script = _file("figure.js")
    made.globals |= {
        "script": script,
        "script_hash": base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    }
    made.globals |= {"title_of": effect_title, "probability": probability, "sentence": words.sentence}
    return made


_FOLDERS = re.compile(r"""(?<=[\s>("'])(?:/|[A-Za-z]:[\\/])(?:[^\s<>"'/\\;&]+[/\\])+(?=[^\s<>])""")
_TABLE = re.compile(r'<div class="scroll"><table.*?</table>', re.DOTALL)


def _labelled(found: re.Match[str]) -> str:
    """Write into each cell of a table which column it is in: a telephone shows rows one below the other."""
    head, separator, body = found[0].partition("</thead>")
    labels = [re.sub("<[^>]*>", "", each) for each in re.findall(r"<th\b[^>]*>(.*?)</th>", head, re.DOTALL)]

    def row(line: re.Match[str]) -> str:
        cells = iter(labels)
        return re.sub(r"<t([dh])\b", lambda cell: f'<t{cell[1]} data-label="{next(cells, "")}"', line[0])

    return head + separator + (re.sub(r"<tr\b.*?</tr>", row, body, flags=re.DOTALL) if labels and separator else body)
