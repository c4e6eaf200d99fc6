"""Everyday mistakes that show in the samples of one recording, before any fit: named, with rows, left out or repaired.

One file for each kind: `find(samples)` returns its findings, whose names `TITLES` has in English.
`jaximu.mistakes.prepare` lists the files.
"""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.mistakes.base import Finding
    from jaximu.mistakes.prepare import MISTAKES, Ready, inspect, make_ready, prepared, without_rows

__all__ = [
    "MISTAKES",
    "Finding",
    "Ready",
    "inspect",
    "make_ready",
    "prepared",
    "without_rows",
]

__getattr__ = lazily(__name__)
