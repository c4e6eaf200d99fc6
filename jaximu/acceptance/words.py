"""Names and amounts of what limits are put on, as a person says them."""

from __future__ import annotations

import math

import numpy as np

from jaximu.units import STANDARD_GRAVITY

__all__ = ["amount", "in_shown_unit", "spoken"]

_SHOWN = {
    "m/s^2": ("mm/s²", 1e3), "rad/s": ("°/s", 180 / math.pi), "rad": ("mrad", 1e3), "1": ("%", 100.0),
    "uT": ("µT", 1.0),
    "rad/s/sqrt(Hz)": ("°/s/√Hz", 180 / math.pi), "m/s^2/sqrt(Hz)": ("µg/√Hz", 1e6 / STANDARD_GRAVITY),
}  # fmt: skip
_PARTS = {
    "bias": "bias", "scale": "scale", "misalignment": "misalignment", "output": "corrected output",
    "raw_output": "uncorrected output", "repeatability": "bias repeatability", "N": "white noise (N)",
    "B": "bias instability (B)", "K": "rate random walk (K)", "Q": "quantisation (Q)", "R": "rate ramp (R)",
}  # fmt: skip


def spoken(name: str) -> str:
    """Turn `accelerometer.misalignment[1,0]` into "accelerometer misalignment y from x"."""
    stem, _, axes = name.rstrip("]").partition("[")
    owner, _, part = stem.partition(".")
    if part not in _PARTS:
        return name
    letters = ["xyz"[int(axis)] for axis in axes.split(",") if axis]
    return f"{owner} {_PARTS[part]} {' from '.join(letters)}".strip()


def in_shown_unit(unit: str) -> tuple[str, float]:
    """Return the unit in which amounts of an SI unit are shown, and the factor to it."""
    if unit in _SHOWN:
        return _SHOWN[unit]
    return unit.replace("^2", "²").replace("^3", "³").replace("sqrt(Hz)", "√Hz"), 1.0


def amount(value: float, unit: str, digits: int = 3) -> str:
    """Return a value of an SI unit in the one it is shown in."""
    shown, factor = in_shown_unit(unit)
    return f"{figure(factor * value, digits)} {shown}"


def figure(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits."""
    if value == 0 or not np.isfinite(value):
        return "0" if value == 0 else "−" if value < 0 else ""
    size = int(np.floor(np.log10(abs(value))))
    text = f"{value:.{max(0, digits - 1 - size)}f}" if -5 <= size < 6 else f"{value:.{digits - 1}e}"
    return text.replace("-", "−")
