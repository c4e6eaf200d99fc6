"""The report: one HTML file that works offline, made to be read by a person who did not make the recording."""

from __future__ import annotations

import base64
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaximu.calibration import Calibration
from jaximu.formats.atomic import write_folder
from jaximu.formats.document import Document
from jaximu.report import figures, tables, words
from jaximu.report.evidence import Evidence, evidence

if TYPE_CHECKING:
    import jinja2
    from matplotlib.figure import Figure

__all__ = ["Picture", "template", "write_calibration", "write_page", "write_report"]


@dataclass(frozen=True)
class Picture:
    """A figure with its file name, its alternative text and its caption."""

    name: str
    data: bytes
    alternative: str
    caption: str

    def __html__(self) -> str:
        """Return the picture with its caption as a page has it; a tap enlarges it, without a script."""
        from markupsafe import Markup

        return Markup(
            '<figure>\n<label class="zoom"><input type="checkbox" aria-label="enlarge">'
            '<img src="{}" alt="{}"></label>\n'
            "<figcaption>{}</figcaption>\n</figure>"
        ).format("data:image/png;base64," + base64.b64encode(self.data).decode("ascii"), self.alternative, self.caption)


def write_report(calibration: Calibration, folder: str | os.PathLike[str], title: str | None = None) -> Path:
    """Write `report.html` and its pictures as PNGs into `folder`, which is made if it is missing.

    **Arguments:** `title`: the report's heading; the names of the recordings if None. A calibration that was loaded
    from its file gives a report without the pictures of the recording, because its working is not kept there.

    **Returns:** the path of `report.html`. Everything is drawn before anything is written, and each file is written
    whole or not at all. Raises `InputError` where the folder cannot be made or written to.
    """
    found = evidence(calibration)
    said, unknown = words.trust(calibration), words.limits(calibration, found)
    return write_calibration(
        calibration, folder, words.lead(calibration), said, unknown, _pictures(calibration, found), title
    )


def write_calibration(
    calibration: Calibration,
    folder: str | os.PathLike[str],
    lead: dict[str, str],
    said: list[words.Statement],
    unknown: list[words.Statement],
    pictures: Iterable[Picture] = (),
    title: str | None = None,
) -> Path:
    """Write the report of any calibration: its lead, what to trust, what is not known, its pictures and tables."""
    caption = (
        "a: accelerometer, g: gyroscope; s_x: scale of axis x; m_yx: misalignment, input along x seen by output y; "
        "b_x: bias. Near ±1, the recording determines only the sum or difference of the two, and their single "
        "intervals are wide."
    )
    if calibration.gravity.sigma > 0 and "accelerometer" in calibration.triads():
        caption += " The accelerometer's scales go together as far as they share the uncertainty of gravity."
    correlation = Picture(
        "correlation", figures.png(figures.correlation_figure(calibration)), "Correlation of the fitted parameters",
        caption,
    )  # fmt: skip
    sources = [{key: str(each.get(key, "")) for key in ("file", "sha256", "rows")}
               for each in calibration.data.get("files", [])]  # fmt: skip
    triads = calibration.triads()
    pictures = [*pictures, correlation]
    page = template().render(
        title=title or f"Calibration from {', '.join(Path(each['file']).name for each in sources) or 'a recording'}",
        lead=lead,
        warnings=[each.about for each in said if each.caution and not each.about.startswith("What")],
        weak=len(calibration.weak),
        trust=said,
        limits=unknown,
        pictures={each.name: each for each in pictures},
        equations=tables.equations(calibration),
        snippet=None if any(triad.effects for triad in triads.values()) else tables.snippet(calibration),
        tables=[(name, tables.rows(calibration, name, triad)) for name, triad in triads.items()],
        sources=sources,
        facts=tables.provenance(calibration),
        notes=[words.sentence(note) for note in calibration.notes],
        version=calibration.software.get("version", ""),
    )
    return write_page(folder, page, pictures)[-1]


def write_page(
    folder: str | os.PathLike[str], page: str, pictures: Iterable[Picture], **documents: Document
) -> tuple[Path, ...]:
    """Write documents as NAME.json, pictures as PNGs and the page as `report.html` into a folder: all of them or none.

    **Returns:** their paths, the page's last. Raises `InputError` where the folder cannot be made or written to.
    """
    contents = {f"{name}.json": (document.text() + "\n").encode() for name, document in documents.items()}
    contents |= {f"{picture.name}.png": picture.data for picture in pictures}
    contents["report.html"] = page.encode("utf-8", "backslashreplace")  # names of files need not be valid text
    return write_folder(folder, contents)


def _pictures(calibration: Calibration, found: Evidence | None) -> list[Picture]:
    made: list[Picture] = []

    def add(name: str, figure: Figure, alternative: str, caption: str) -> None:
        made.append(Picture(name, figures.png(figure), alternative, caption))

    if found is not None:
        caption = (
            "“Before” is where the fit started: the nominal scale and offset, no misalignment. The inner band is "
            "what the noise, measured while the unit was still, explains; where a wider one surrounds it, the errors "
            "scatter more than that, and the intervals below count with the wider one."
        )
        alternative = "Errors of each pose and turn, before and after calibration"
        add("residuals", figures.residual_figure(found), alternative, caption)
        caption = (
            "The two halves of the sphere of orientations, seen along z, areas true. A calibration speaks best for "
            "orientations near its poses; colours that go with the direction point to a cause that the model lacks."
        )
        alternative = "Map of the directions that pointed up in each pose"
        add("orientations", figures.orientation_figure(found), alternative, caption)
    if calibration.segmentations:
        caption = "As recorded, turned into SI units by the nominal scale and offset. Numbers count the poses."
        alternative = "Accelerometer and gyroscope against time, poses shaded"
        add("recording", figures.recording_figure(calibration), alternative, caption)
    return made


@cache
def template(name: str = "template.html.jinja") -> jinja2.Template:
    """Return one of this folder's templates; they share the page of `base.html.jinja`."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda each: files("jaximu.report").joinpath(each).read_text(encoding="utf-8")),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.template_class = _page()
    return environment.get_template(name)


@cache
def _page() -> type[jinja2.Template]:
    import jinja2

    class Page(jinja2.Template):
        """A page without the folders of the machine that made it, whose tables say in each cell what its column is."""

        def render(self, *values: Any, **named: Any) -> str:
            text = _FOLDERS.sub("", super().render(*values, **named))
            return _TABLE.sub(_labelled, text)

    return Page


_FOLDERS = re.compile(r"""(?<=[\s>("'])(?:/|[A-Za-z]:[\\/])(?:[^\s<>"'/\\;&]+[/\\])+(?=[^\s<>])""")
_TABLE = re.compile(r'<div class="scroll"><table.*?</table>', re.DOTALL)


def _labelled(found: re.Match[str]) -> str:
    """Write into each cell of a table which column it is in: a telephone shows rows one below the other."""
    head, separator, body = found[0].partition("</thead>")
    labels = [re.sub("<[^>]*>", "", each) for each in re.findall(r"<th\b[^>]*>(.*?)</th>", head, re.DOTALL)]

    def row(line: re.Match[str]) -> str:
        cells = iter(labels)
        return re.sub(r"<t([dh])\b", lambda cell: f'<t{cell[1]} data-label="{next(cells, "")}"', line[0])

    return head + separator + (re.sub(r"<tr\b.*?</tr>", row, body, flags=re.DOTALL) if labels else body)
