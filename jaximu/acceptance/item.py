"""One limit on one axis of a unit, with what was found of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from jaximu.acceptance.decision import UNDECIDED
from jaximu.acceptance.limits import Limit
from jaximu.ground.document import Json, entries

_MOST = 100.0
"""Times the poses from which no recording is advised any more."""


@dataclass(frozen=True)
class Item:
    """One limit on one axis, with what was found. value, sigma, gravity, recording: SI (`unit`); None where not known.

    gravity, recording: the parts of sigma. reason: why there is no value; advice: what would decide it. stated: the
    unit in which a file states the limit, "" where none does.
    """

    name: str
    low: float
    high: float
    unit: str
    source: str
    verdict: str = UNDECIDED
    value: float | None = None
    sigma: float | None = None
    freedom: float = np.inf
    probability: float | None = None
    reason: str = ""
    advice: str = ""
    gravity: float = 0.0
    recording: float = 0.0
    stated: str = ""

    @classmethod
    def of(cls, limit: Limit, name: str, **result: Any) -> Item:
        """Return the item of a limit with what was found: undecided where that is nothing."""
        return cls(name, limit.low, limit.high, limit.unit, limit.source, stated=limit.stated, **result)

    def said(self) -> str:
        """Return why it is undecided and what would decide it, in sentences; "" where nothing is to be said."""
        return " ".join(filter(None, (self.reason and f"{self.reason[:1].upper()}{self.reason[1:]}.", self.advice)))

    def document(self) -> Json:
        """Return the item as JSON has it; uncertainty is expanded, k = 2."""
        return entries(self, "name", "value", "unit", "verdict", "probability", "source", "reason", "advice") | {
            "uncertainty": None if self.sigma is None else 2 * self.sigma,
            "low": _finite(self.low),
            "high": _finite(self.high),
            "degrees_of_freedom": _finite(self.freedom),
            "budget": entries(self, "recording", "gravity"),
        }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def deciding(needed: float, recording: float, gravity: float, gravity_sigma: float, record: str) -> str:
    """Say which measurement would decide an item, if its value stays where it is.

    **Arguments:** needed: standard uncertainty at which it is decided; recording, gravity: the two parts of the present
    one (same unit); gravity_sigma: m/s²; record: which poses tell most of it.
    """
    if gravity and needed**2 > recording**2:
        to = gravity_sigma * np.sqrt(needed**2 - recording**2) / gravity
        return f"State local gravity to ±{to:.1g} m/s² (1 σ): --gravity VALUE+-SIGMA, or --latitude and --height."
    left = needed**2 - gravity**2
    if left <= 0 and gravity > recording / np.sqrt(_MOST):
        return f"State local gravity better than ±{gravity_sigma:.1g} m/s², and record more: {record}"
    times = recording**2 / left if left > 0 else np.inf
    if not times <= _MOST:
        return "The value lies so near its limit that no recording of reasonable length decides it."
    return f"Record about {times:.2g} times as much; most useful: {record}"
