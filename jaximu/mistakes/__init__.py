"""Everyday mistakes that show in the samples of one recording, before any fit: named, with rows, left out or repaired.

One file for each kind: `find(samples)` returns its findings, whose names `TITLES` has in English.
`jaximu.mistakes.preparation` lists the files.
"""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.mistakes.preparation import MISTAKES, Prepared, inspect, one_or_several, prepare, prepared, without_rows

__all__ = [
    "MISTAKES",
    "Prepared",
    "inspect",
    "one_or_several",
    "prepare",
    "prepared",
    "without_rows",
]

__getattr__ = lazily(
    __name__,
    {
        "jaximu.mistakes.preparation": "MISTAKES, Prepared, inspect, one_or_several, prepare, prepared, without_rows",
    },
)
