"""The noise of a recording at rest: deviations, terms with intervals, and what does not belong to it."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.noise.cleaning import PeriodicLine
    from jaximu.noise.deviations import Deviation, averaging_factors, deviation
    from jaximu.noise.identification import GaussMarkov, Identified, Term, WarmUp, identify

__all__ = [
    "Deviation",
    "GaussMarkov",
    "Identified",
    "PeriodicLine",
    "Term",
    "WarmUp",
    "averaging_factors",
    "deviation",
    "identify",
]

__getattr__ = lazily(
    __name__,
    {
        "jaximu.noise.cleaning": "PeriodicLine",
        "jaximu.noise.deviations": "Deviation, averaging_factors, deviation",
        "jaximu.noise.identification": "GaussMarkov, Identified, Term, WarmUp, identify",
    },
)
