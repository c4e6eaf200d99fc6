"""A result in parts, before anyone has decided how to show it: on the terminal, as an HTML file, in a notebook.

A part that holds nothing is false, and no renderer shows it: a section of nothing needs no condition where it is made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

from jaximu.ground.reexport import later

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Statement:
    """A sentence or a few, with what it is about; `caution` where a reader should act on it."""

    kind: ClassVar[str] = "statement"
    about: str
    text: str
    caution: bool = False


class Shown:
    """A part that shows itself: printed as text, in a notebook as HTML."""

    def __str__(self) -> str:
        return later("report.terminal", "text")(self)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return later("report.html", "fragment")(self)


@dataclass(frozen=True, repr=False)
class Table(Shown):
    """Texts in rows under headers; without headers the first cell of a row is its name.

    caption: a sentence below it. marked: the rows that a reader should look at. brief: how many of the rows the first
    screen shows.
    """

    kind: ClassVar[str] = "table"
    headers: tuple[str, ...]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    marked: Sequence[int] = ()
    brief: int | None = None

    def __bool__(self) -> bool:
        return bool(self.rows)


@dataclass(frozen=True)
class Picture:
    """A figure that is drawn when its turn comes, kept as NAME.png; `alternative`: in words for who cannot see it."""

    kind: ClassVar[str] = "picture"
    name: str
    draw: Callable[[], Figure]
    alternative: str
    caption: str = ""


@dataclass(frozen=True)
class Items:
    """A list of sentences, each shown with a capital at its start."""

    kind: ClassVar[str] = "items"
    texts: Sequence[str]

    def __bool__(self) -> bool:
        return bool(self.texts)


@dataclass(frozen=True)
class Code:
    """Lines to copy."""

    kind: ClassVar[str] = "code"
    text: str


@dataclass(frozen=True)
class Matrices:
    """An equation on one line: texts, and matrices as rows of texts."""

    kind: ClassVar[str] = "matrices"
    pieces: Sequence[str | Sequence[Sequence[str]]]


@dataclass(frozen=True)
class Section:
    """Parts under a heading."""

    kind: ClassVar[str] = "section"
    title: str
    parts: Sequence[Part]
    level: int = 2

    def __bool__(self) -> bool:
        return any(self.parts)


Part = str | Statement | Table | Picture | Items | Code | Matrices | Section


@dataclass(frozen=True, repr=False)
class Page(Shown):
    """A result in parts. Text between backticks is code.

    verdict: sentences. number, meaning: the one number, with its interval, and what it is of. first: what the first
    screen shows below them, everywhere (the terminal leaves pictures out). rest: what only the HTML file goes on with,
    made when it is written. next: what to run next, in a sentence. caution: the number is bad news, and coloured so.
    """

    title: str
    verdict: Sequence[str]
    number: str = ""
    meaning: str = ""
    first: Sequence[Part] = ()
    rest: Callable[[], Iterable[Part]] = tuple
    notes: Sequence[str] = ()
    next: str = ""
    caution: bool = False

    def summary(self) -> Page:
        """Return the page itself: a function that takes a result takes its page, too."""
        return self

    def section(self) -> Section:
        """Return the first screen as one section."""
        return Section(self.title, (*self._headline(), *self.first, Items(self.notes)), 4)

    def chapter(self, name: str, whole: bool) -> Section:
        """Return the page as a section of another, its pictures kept as NAME_….png.

        whole: with all that the HTML file shows, not the first screen alone.
        """
        rest = self.rest() if whole else ()
        parts = (*self._headline(), *self.first, *rest, Section("Notes", [Items(self.notes)]))
        return Section(self.title, [_inside(part, name) for part in parts])

    def _headline(self) -> list[str]:
        return [*self.verdict, *([f"{self.number}: {self.meaning}"] if self.number else [])]


def _inside(part: Part, name: str) -> Part:
    """Return a part as it stands in a chapter: its headings a level lower, its pictures under the chapter's name."""
    match part:
        case Section(parts=parts, level=level):
            return replace(part, parts=[_inside(inner, name) for inner in parts], level=level + 1)
        case Picture():
            return replace(part, name=f"{name}_{part.name}")
    return part


class Result:
    """What a verb returns: it has a page, which a module of `report` makes of it when it is asked for.

    A class names the module: `class Validity(Result, page="validity")`.
    """

    _page: ClassVar[str]

    def __init_subclass__(cls, page: str = "", **more: object):
        super().__init_subclass__(**more)
        if page:
            cls._page = page

    def summary(self) -> Page:
        """Return what a person wants to know of this: printed it is text, in a notebook HTML."""
        return later(f"report.{self._page}", "page_of")(self)

    def __repr__(self) -> str:
        page = self.summary()
        return f"<{type(self).__name__}: {'. '.join((page.title, *page.verdict[:1]))}>"

    def _repr_html_(self) -> str:
        return self.summary()._repr_html_()
