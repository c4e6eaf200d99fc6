"""Names and amounts of what limits are put on, as a person says them."""

from __future__ import annotations

import math
import re
from typing import NamedTuple

import numpy as np

from jaximu.ground.quantities import number, plain, unit_text
from jaximu.ground.units import SENSOR_UNITS, STANDARD_GRAVITY
from jaximu.model.data_sheet import parse_quantity

_SHOWN = {
    "m/s^2": ("mm/s²", 1e3),
    "rad/s": ("°/s", 180 / math.pi),
    "rad": ("mrad", 1e3),
    "1": ("%", 100.0),
    "uT": ("µT", 1.0),
    "rad/s/sqrt(Hz)": ("°/s/√Hz", 180 / math.pi),
    "m/s^2/sqrt(Hz)": ("µg/√Hz", 1e6 / STANDARD_GRAVITY),
}
_PARTS = {
    "bias": "bias",
    "scale": "scale",
    "misalignment": "misalignment",
    "output": "corrected output",
    "raw_output": "uncorrected output",
    "repeatability": "bias repeatability",
    "N": "white noise (N)",
    "B": "bias instability (B)",
    "K": "rate random walk (K)",
    "Q": "quantisation (Q)",
    "R": "rate ramp (R)",
    "position": "position",
    "heading": "heading",
}


class NameParts(NamedTuple):
    """What the name of a quantity says: of `gyroscope.bias[2]` the stem, `gyroscope.bias`, its two words, the axes."""

    stem: str
    owner: str
    part: str
    axes: tuple[int, ...]


def parts_of(name: str) -> NameParts:
    """Take the name of a quantity apart; one of all axes has none."""
    stem, _, axes = name.partition("[")
    owner, _, part = stem.partition(".")
    return NameParts(stem, owner, part, tuple(map(int, re.findall(r"\d+", axes))))


def spoken(name: str) -> str:
    """Turn `accelerometer.misalignment[1,0]` into "accelerometer misalignment y from x"."""
    _, owner, part, axes = parts_of(name)
    if part not in _PARTS:
        return name
    directions = ("east", "north", "up") if owner == "navigation" else "xyz"
    return f"{owner} {_PARTS[part]} {' from '.join(directions[axis] for axis in axes)}".strip()


def in_shown_unit(unit: str, stated: str = "") -> tuple[str, float]:
    """Return the unit in which amounts of an SI unit are shown, whatever their size, and the factor to it.

    **Arguments:** `stated`: the unit that a file of limits states, which is then the one.
    """
    if stated.replace(" ", "") == unit.replace(" ", ""):
        return unit_text(unit), 1.0
    if stated:
        return unit_text(stated), 1.0 / parse_quantity(f"1 {stated}", unit)
    return _SHOWN.get(unit) or (unit_text(unit), 1.0)


def amount(value: float, unit: str, digits: int = 3, stated: str = "") -> str:
    """Return a value of an SI unit in the one it is shown in."""
    shown, factor = in_shown_unit(unit, stated)
    return f"{number(factor * value, digits)} {shown}"


def between(low: float, high: float, unit: str, stated: str = "") -> str:
    """Say between which values of an SI unit something must lie."""
    shown, factor = in_shown_unit(unit, stated)
    below, above = ((plain if stated else number)(factor * end) for end in (low, high))
    if low == -high:
        return f"±{above} {shown}"
    if not np.isfinite(low):
        return f"at most {above} {shown}"
    return f"{below} to {above} {shown}" if np.isfinite(high) else f"at least {below} {shown}"


def si_unit(name: str) -> str:
    """Return the unit in tables of a bias, scale or misalignment by its name, such as `gyroscope.bias[0]`."""
    _, owner, part, _ = parts_of(name)
    return {"scale": "1", "misalignment": "rad"}.get(part) or SENSOR_UNITS[owner]
