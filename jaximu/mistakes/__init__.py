"""Everyday mistakes that show in the samples of one recording, before any fit: named, with rows, left out or repaired.

One file for each kind: `find(samples)` returns its findings, whose names `TITLES` has in English.
`jaximu.mistakes.ready` lists the files.
"""

from jaximu.mistakes.base import Finding
from jaximu.mistakes.ready import MISTAKES, Ready, inspect, make_ready, prepared, without_rows

__all__ = ["MISTAKES", "Finding", "Ready", "inspect", "make_ready", "prepared", "without_rows"]
