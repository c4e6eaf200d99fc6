"""Prose for a person on stderr: how much of it a user wants, and how long the stages of the work take."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

level = 1
"""0: errors alone; 1: stages, and how long those that are slow took; 2: how long every stage took."""
_LONG = 2.0  # s; a stage that takes longer says how long it took


def say(text: str) -> None:
    """Write prose to stderr, out of the way of results."""
    if level:
        print(text, file=sys.stderr)


@contextmanager
def progress(text: str, every: float | None = None) -> Iterator[Callable[[str], None]]:
    """Show a stage of the work on stderr, and its time: live on a terminal, else in lines `every` (two) seconds.

    **Gives** a function that takes what the stage is at, in words.
    """
    began = spoken = time.monotonic()
    if level == 1 and sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        columns = SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn()
        with Progress(*columns, console=Console(stderr=True), transient=True, redirect_stdout=False) as shown:
            task = shown.add_task(text, total=None)
            yield lambda part: shown.update(task, description=f"{text}: {part}")
        return

    def tell(part: str) -> None:
        nonlocal spoken
        if (now := time.monotonic()) - spoken > (_LONG if every is None else every):
            spoken = now
            say(f"{text}: {part}, {now - began:.0f} s")

    say(f"{text} …")
    yield tell
    if (elapsed := time.monotonic() - began) > _LONG or level > 1:
        say(f"{text}: done in {elapsed:.{0 if elapsed > _LONG else 1}f} s")
