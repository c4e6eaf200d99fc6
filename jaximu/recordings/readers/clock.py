"""Times of day, dates, and numbers with their unit, written as text."""

import re

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.units import find_unit

_CLOCK = re.compile(r"(?:^|[\sT])(\d{1,2}):(\d{2}):(\d{2})(?:[.,:](\d{1,9}))?\s*([AaPp][Mm])?")
_MINUTES = re.compile(r"\s*(\d{1,2}):(\d{2})[.,](\d{1,9})\s*")
_MEASURED = re.compile(r"\s*([-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?)\s*([^\d\s.].*?)\s*")
DAY, HOUR = 86400 * 10**9, 3600 * 10**9
"""ns."""


def seconds_of(column: np.ndarray) -> np.ndarray | None:
    """Integer nanoseconds of texts such as "2024-05-01 12:30:15.250", "12:30:15:250", "1:30:15 PM" or "30:15.25".

    They count from the first day's midnight, minutes from the first hour; None where a text holds no time of day.
    """
    stamps = np.empty(len(column), np.int64)
    turn = DAY
    for at, cell in enumerate(column):
        if match := _MINUTES.fullmatch(str(cell)):
            turn = HOUR
            stamps[at] = (60 * int(match[1]) + int(match[2])) * 10**9 + int(match[3].ljust(9, "0"))
            continue
        match = _CLOCK.search(str(cell))
        if match is None:
            return None
        hours = int(match[1]) % 12 + 12 * (match[5].lower() == "pm") if match[5] else int(match[1])
        seconds = 3600 * hours + 60 * int(match[2]) + int(match[3])
        stamps[at] = seconds * 10**9 + int((match[4] or "").ljust(9, "0"))
    return stamps + (np.diff(stamps, prepend=stamps[:1]) < -turn // 2).cumsum() * turn


def measured(column: np.ndarray, decimal: str = ".") -> tuple[FloatArray, str] | None:
    """The numbers of a column of texts such as "0.02 sec", and their unit; None where they have no one unit."""
    matches = [_MEASURED.fullmatch(str(cell).replace(decimal, ".")) for cell in column if cell is not None]
    units = {match[2] if match else "" for match in matches}
    if len(units) != 1 or not find_unit(unit := units.pop()):
        return None
    numbers = iter(float(match[1]) for match in matches if match)
    return np.array([np.nan if cell is None else next(numbers) for cell in column]), unit
