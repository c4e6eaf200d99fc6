"""`data.duplicate`: a block of rows that is in the log twice."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaximu.ground.quantities import counted
from jaximu.mistakes.base import Samples
from jaximu.recordings.finding import NO_ROWS, Finding, Rows
from jaximu.recordings.recording import runs_of

TITLES = {"data.duplicate": "repeated rows"}

_CHANCE = 1e-6
"""Expected number of blocks that repeat by chance, below which a repeat is none."""
_AROUND = 200
"""Rows on either side that say how alike rows are there: a sensor at rest in coarse steps shows few different ones."""
_DISTINCT = 5, 0.5
"""Different rows that a block must have, and what share of its rows, less those that usually repeat, must differ: a
sensor that stands still repeats itself."""


def find(samples: Samples) -> Iterator[Finding]:
    """Return the rows that repeat a block of earlier ones."""
    sensors = list(samples.sensors.values())
    if not sensors or (len(sensors) > 1 and not samples.shared):
        return
    values = np.hstack([sensor.signal.values for sensor in sensors])
    rows = _repeated(values)
    if not len(rows):
        return
    first = sensors[0]
    blocks = runs_of(np.isin(np.arange(len(values)), rows))
    yield Finding(
        "data.duplicate",
        first.rows(blocks[:, 0]),
        f"{counted(len(rows), 'row')} in {counted(len(blocks), 'block')} repeat earlier rows value by value, first "
        f"from {first.at(rows[0])}: they were pasted twice, or the logger wrote a buffer twice. "
        "The second copy is left out.",
        without=dict.fromkeys(samples.sensors, rows),
    )


def _repeated(values: np.ndarray) -> Rows:
    """Return the rows of every later copy of a block."""
    count = len(values)
    mixed = np.random.default_rng(0).integers(1, 2**62, values.shape[1], dtype=np.uint64) | np.uint64(1)
    # + 0.0 makes one zero of both; a sum of the bits times odd numbers separates rows
    code = (np.ascontiguousarray(values + 0.0).view(np.uint64) * mixed).sum(axis=1, dtype=np.uint64)
    code ^= code >> np.uint64(29)
    near = max(np.mean(code[lag:] == code[:-lag]) for lag in (1, 2, 3, 5, 8))
    length = int(np.clip(np.ceil(np.log(count**2 / _CHANCE) / -np.log(max(near, 1e-9))), 8, 2000)) if near < 1 else 0
    if length == 0 or 2 * length > count:
        return NO_ROWS
    block, size = code.copy(), 1
    with np.errstate(over="ignore"):
        while size < length:  # the code of a block of `size` rows, doubled
            step = min(size, length - size)
            block = block[: len(block) - step] * np.uint64(0x9E3779B97F4A7C15) + block[step:]
            size += step
    distinct = max(_DISTINCT[0], _DISTINCT[1] * (1 - near) * length)
    alike = np.sort(block)  # many times quicker than the order, and most recordings repeat nothing
    if not np.any(alike[1:] == alike[:-1]):
        return NO_ROWS
    order = np.argsort(block, kind="stable")
    same = np.flatnonzero(block[order][1:] == block[order][:-1])
    earlier, later = order[same], order[same + 1]
    good = later - earlier >= length  # copies do not overlap
    earlier, later = earlier[good], later[good]
    marked = np.zeros(count, bool)
    for start, stop in zip(earlier, later, strict=True):
        if marked[stop] and marked[min(stop + length - 1, count - 1)]:
            continue
        if len(np.unique(code[start : start + length])) >= distinct:
            marked[stop : stop + length] = True
    for first, last in runs_of(marked):
        if _by_chance(code[max(0, first - _AROUND) : last + _AROUND], last - first, count):
            marked[first:last] = False
    return np.flatnonzero(marked)


def _by_chance(codes: np.ndarray, length: int, count: int) -> bool:
    """Whether a run of rows as alike as those around it would repeat by chance somewhere among so many rows."""
    _, often = np.unique(codes, return_counts=True)
    alike = np.sum(often * (often - 1.0)) / max(len(codes) * (len(codes) - 1.0), 1.0)  # of two rows
    return length * -np.log(max(alike, 1e-12)) < np.log(count**2 / _CHANCE)
