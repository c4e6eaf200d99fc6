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
from jaximu.report import figures, tables, words
from jaximu.report.evidence import Evidence, evidence

if TYPE_CHECKING:
    import jinja2
    from matplotlib.figure import Figure

__all__ = ["Picture", "template", "write_page", "write_report"]


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
    pictures = _pictures(calibration, found)
    text = _render(calibration, found, pictures, title)
    return write_page(folder, text, pictures.values())


def write_page(folder: str | os.PathLike[str], text: str, pictures: Iterable[Picture]) -> Path:
    """Write a page as `report.html` and its pictures as PNGs into `folder`; return the page's path."""
    contents = {f"{each.name}.png": each.data for each in pictures}
    contents["report.html"] = text.encode("utf-8", "backslashreplace")  # names of files need not be valid text
    return write_folder(folder, contents)[-1]


def _pictures(calibration: Calibration, found: Evidence | None) -> dict[str, Picture]:
    made: dict[str, Picture] = {}

    def add(name: str, figure: Figure, alternative: str, caption: str) -> None:
        made[name] = Picture(name, figures.png(figure), alternative, caption)

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
    caption = (
        "a: accelerometer, g: gyroscope; s_x: scale of axis x; m_yx: misalignment, input along x seen by output y; "
        "b_x: bias. Near ±1, the recording determines only the sum or difference of the two, and their single "
        "intervals "
        "are wide."
    )
    if calibration.gravity.sigma > 0:
        caption += " The accelerometer's scales go together as far as they share the uncertainty of gravity."
    alternative = "Correlation of the fitted parameters"
    add("correlation", figures.correlation_figure(calibration), alternative, caption)
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


def _render(calibration: Calibration, found: Evidence | None, pictures: dict[str, Picture], title: str | None) -> str:
    sources = [
        {"file": str(each.get("file", "")), "sha256": str(each.get("sha256", "")), "rows": each.get("rows", "")}
        for each in calibration.data.get("files", [])
    ]
    names = ", ".join(Path(each["file"]).name for each in sources) or "a recording"
    trust, limits = words.trust(calibration), words.limits(calibration, found)
    return template().render(
        title=title or f"Calibration from {names}",
        lead=words.lead(calibration),
        warnings=[each.about for each in trust if each.caution and not each.about.startswith("What")],
        weak=len(calibration.weak),
        trust=trust,
        limits=limits,
        pictures=pictures,
        equations=tables.equations(calibration),
        snippet=None if any(triad.effects for triad in calibration.triads().values()) else tables.snippet(calibration),
        tables=[(name, tables.rows(calibration, name, triad)) for name, triad in calibration.triads().items()],
        sources=sources,
        facts=tables.provenance(calibration),
        notes=[words.sentence(note) for note in calibration.notes],
        version=calibration.software.get("version", ""),
    )
