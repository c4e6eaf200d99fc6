"""Text and tables on the terminal: nothing is cut off, and square brackets are units, not markup."""

from __future__ import annotations

import os
from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table

__all__ = ["console", "table"]

_WIDTH = 150
"""Columns where there is no terminal."""


def console() -> Console:
    """Return the terminal, or standard output."""
    made = Console(highlight=False, markup=False)
    if not made.is_terminal and "COLUMNS" not in os.environ:
        made = Console(highlight=False, markup=False, width=_WIDTH)
    return made


def table(screen: Console, headers: Sequence[str], rows: Sequence[Sequence[str]], title: str = "") -> None:
    """Print rows under headers; cells are folded between words, and where even words do not fit rows are stacked."""
    words = [max((len(word) for cell in column for word in cell.split()), default=1) for column in
             zip(headers, *rows, strict=True)]  # fmt: skip
    if title:
        screen.print(title)
    if sum(words) + 2 * len(words) > screen.width:
        for row in rows:
            for header, cell in zip(headers, row, strict=True):
                if cell:
                    screen.print(f"  {header}: {cell}" if header else f"- {cell}")
        return
    made = Table(box=box.SIMPLE_HEAD if any(headers) else None, padding=(0, 1, 0, 0), show_edge=False)
    for header, width in zip(headers, words, strict=True):
        made.add_column(header, min_width=width, overflow="fold")
    for row in rows:
        made.add_row(*row)
    screen.print(made)
