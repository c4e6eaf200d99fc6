"""A page as text: on the terminal with its colours, or as a string; square brackets are units, not markup."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from dataclasses import replace
from textwrap import indent

from rich import box
from rich.console import Console
from rich.table import Table as Grid

from jaximu.ground.errors import worded
from jaximu.ground.page import Code, Items, Page, Part, Section, Statement, Table
from jaximu.ground.quantities import sentence

_WIDTH = 100


def console() -> Console:
    """Return the terminal, or standard output with a hundred columns where it is none."""
    colors = None if os.environ.get("NO_COLOR") else "auto"  # None: no bold type either
    terminal = Console(highlight=False, markup=False, color_system=colors)
    return terminal if terminal.is_terminal else _screen(color_system=colors)


def _screen(**options) -> Console:
    return Console(highlight=False, markup=False, width=_WIDTH, force_jupyter=False, **options)  # not into the notebook


def text(content: Page | Part) -> str:
    """Return a page, or a part of one, as lines of text."""
    lines = io.StringIO()
    show(content, _screen(file=lines, color_system=None))
    return "\n".join(line.rstrip() for line in lines.getvalue().rstrip().split("\n"))


def show(content: Page | Part, screen: Console | None = None) -> None:
    """Print a page's first screen, or a part of one; pictures and equations are left to the HTML file."""
    screen = screen or console()
    match content:
        case str():
            screen.print(worded(content))
        case Statement(about=about, text=words, caution=caution):
            show(f"{'! ' if caution else ''}{about}: {words}", screen)
        case Table(rows=rows, brief=brief):
            _print_table(replace(content, rows=rows[:brief]), screen)
            if brief is not None and len(rows) > brief:
                screen.print(f"… and {len(rows) - brief} more in the report")
        case Items(texts=texts):
            grid = Grid.grid(padding=(0, 1, 0, 0))
            for words in texts:  # lines are indented below their bullets
                grid.add_row("-", worded(sentence(words)))
            screen.print(grid)
        case Code(text=lines):
            screen.print(indent(lines, "  "), soft_wrap=True)  # a folded line is no longer what is to be copied
        case Section(title=title, parts=parts):
            screen.print(f"\n{title}", style="bold")
            _print_parts(parts, screen)
        case Page():
            screen.print(content.title, style="bold")
            for verdict in content.verdict:
                show(verdict, screen)
            if content.number:
                screen.print(f"{content.number}  {content.meaning}")
            _print_parts((*content.first, Section("Notes", (Items(content.notes),))), screen)
            if content.next:
                show(f"\nNext: {content.next}", screen)


def _print_parts(parts: Sequence[Part], screen: Console) -> None:
    for part in filter(None, parts):
        show(part, screen)


def _print_table(table: Table, screen: Console) -> None:
    """Print rows under headers; cells are folded between words, and where even words do not fit rows are stacked."""
    columns = list(zip(*([table.headers] if table.headers else []), *table.rows, strict=True))
    words = [max((len(word) for cell in column for word in cell.split()), default=1) for column in columns]
    widths = [max((len(line) for cell in column for line in cell.split("\n")), default=1) for column in columns]
    if sum(words) > screen.width - 2 * len(widths):
        _print_stacked(table, screen)
    else:
        _print_grid(table, words, widths, screen)
    if table.caption:
        show(table.caption, screen)


def _print_grid(table: Table, words: Sequence[int], widths: list[int], screen: Console) -> None:
    """Print a table whose columns are as wide as stated, or narrower where that is more than there is room for."""
    room = screen.width - 2 * len(widths)
    while sum(widths) > room:
        widths[max(range(len(widths)), key=lambda at: widths[at] - words[at])] -= 1
    grid = Grid(box=box.SIMPLE_HEAD if any(table.headers) else None, padding=(0, 1, 0, 0), show_edge=False)
    for index, width in enumerate(widths):
        grid.add_column(table.headers[index] if table.headers else "", width=width, overflow="fold")
    for index, row in enumerate(table.rows):
        grid.add_row(*row, style="bold" if index in table.marked else None)
    screen.print(grid)


def _print_stacked(table: Table, screen: Console) -> None:
    for row in table.rows:
        for header, cell in zip(table.headers or ("",) * len(row), row, strict=True):
            if cell:
                screen.print(f"  {header}: {cell}" if header else f"- {cell}")
