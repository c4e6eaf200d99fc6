"""Text and tables on the terminal: nothing is cut off, and square brackets are units, not markup."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from rich import box
from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from jaximu.ground.summary import Summary

__all__ = ["console", "print_all", "show", "table"]


def console(width: int = 100) -> Console:
    """Return the terminal, or standard output with so many columns where it is none."""
    colors = None if os.environ.get("NO_COLOR") else "auto"  # None: no bold type either
    made = Console(highlight=False, markup=False, color_system=colors)
    return made if made.is_terminal else Console(highlight=False, markup=False, width=width, color_system=colors)


def print_all(*parts: str | tuple, notes: Iterable[str] = (), width: int = 100) -> None:
    """Print sentences and tables, each as (headers, rows) or (headers, rows, title), in their order; then the notes."""
    screen = console(width)
    for part in (*parts, *(f"note: {note}" for note in notes)):
        if isinstance(part, str):
            screen.print(part)
        else:
            table(screen, *part)


def show(summary: Summary) -> None:
    """Print a summary: its title, the verdict, the table, and notes."""
    console().print(summary.title, style="bold")
    tables = [] if summary.table is None else [(summary.table.headers, summary.table.rows)]
    print_all(*summary.verdict, *tables, *(f"- {note}" for note in summary.notes))


def table(screen: Console, headers: Sequence[str], rows: Sequence[Sequence[str]], title: str = "") -> None:
    """Print rows under headers; cells are folded between words, and where even words do not fit rows are stacked."""
    columns = list(zip(headers, *rows, strict=True))
    words = [max((len(word) for cell in column for word in cell.split()), default=1) for column in columns]
    widths = [max((len(line) for cell in column for line in cell.split("\n")), default=1) for column in columns]
    if title:
        screen.print(title)
    room = screen.width - 2 * len(widths)
    if sum(words) > room:
        for row in rows:
            for header, cell in zip(headers, row, strict=True):
                if cell:
                    screen.print(f"  {header}: {cell}" if header else f"- {cell}")
        return
    while sum(widths) > room:
        widest = max(range(len(widths)), key=lambda at: widths[at] - words[at])
        widths[widest] -= 1
    made = Table(box=box.SIMPLE_HEAD if any(headers) else None, padding=(0, 1, 0, 0), show_edge=False)
    for header, width in zip(headers, widths, strict=True):
        made.add_column(header, width=width, overflow="fold")
    for row in rows:
        made.add_row(*row)
    screen.print(made)
