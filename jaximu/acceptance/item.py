"""One limit on one axis of a unit, with what was found of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from jaximu.acceptance.decision import UNDECIDED
from jaximu.acceptance.limits import Limit

__all__ = ["Item"]


@dataclass(frozen=True)
class Item:
    """One limit on one axis, with what was found. value, sigma, gravity, recording: SI (`unit`); None where not known.

    gravity, recording: the parts of sigma. reason: why there is no value; advice: what would decide it.
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

    @classmethod
    def of(cls, limit: Limit, name: str, **found: Any) -> Item:
        """Return the item of a limit with what was found: undecided where that is nothing."""
        return cls(name, limit.low, limit.high, limit.unit, limit.source, **found)

    def said(self) -> str:
        """Return why it is undecided and what would decide it, in sentences; "" where nothing is to be said."""
        return " ".join(filter(None, (self.reason and f"{self.reason[:1].upper()}{self.reason[1:]}.", self.advice)))

    def document(self) -> dict[str, Any]:
        """Return the item as JSON has it; uncertainty is expanded, k = 2."""
        return {
            "name": self.name, "value": self.value, "uncertainty": None if self.sigma is None else 2 * self.sigma,
            "low": _finite(self.low), "high": _finite(self.high), "unit": self.unit, "verdict": self.verdict,
            "probability": self.probability, "degrees_of_freedom": _finite(self.freedom), "source": self.source,
            "reason": self.reason, "advice": self.advice,
            "budget": {"recording": self.recording, "gravity": self.gravity},
        }  # fmt: skip


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
