"""Conformity with limits under uncertainty: probability, guard bands, verdict (JCGM 106:2012).

What is known of a quantity is t-distributed about its measured value, with the standard uncertainty as scale and its
effective degrees of freedom (JCGM 106, 7.1, for a prior that says next to nothing). The probability of conformity is
what of it lies within the limits. *Guarded*: accepted where the probability of nonconformity is at most the stated
risk, rejected where that of conformity is; undecided between. At a single limit this is a guard band of t(1 − risk)
standard uncertainties to both sides (JCGM 106, 8.3.2 and 8.3.3). *Simple*: the value alone decides (8.2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import student_cdf, student_isf
from jaximu.ground.document import Json
from jaximu.ground.errors import InputError

PASS, FAIL, UNDECIDED = "pass", "fail", "undecided"
VERDICTS = (PASS, UNDECIDED, FAIL)
"""From best to worst."""


@dataclass(frozen=True)
class Rule:
    """How a value and its uncertainty become a verdict. kind: "guarded" or "simple"; risk: of a wrong decision at most.

    Raises `InputError` for another kind or a risk that is not between 0 and 0.5.
    """

    kind: str = "guarded"
    risk: float = 0.05

    def __post_init__(self) -> None:
        if self.kind not in ("guarded", "simple"):
            raise InputError(f"the decision rule is guarded or simple, not {self.kind!r}.")
        if not 0 < self.risk < 0.5:
            raise InputError(f"the risk of a wrong decision must lie between 0 and 0.5, found {self.risk:g}.")

    def multiple(self, freedom: ArrayLike = np.inf) -> FloatArray:
        """Return the guard band in standard uncertainties: t with so many degrees of freedom that exceeds the risk."""
        return np.zeros(np.shape(freedom)) if self.kind == "simple" else student_isf(self.risk, freedom)

    def verdicts(self, probability: ArrayLike, inside: ArrayLike) -> NDArray[np.str_]:
        """Return the verdicts (...) of probabilities of conformity and of whether the values lie within the limits."""
        probability = np.asarray(probability)
        inside = np.asarray(inside)
        if self.kind == "simple":
            return np.where(inside, PASS, FAIL)
        # rounding of the distribution must not decide at the very edge of the guard band
        edge = 1e-12
        decided = np.where(probability >= 1 - self.risk - edge, PASS, UNDECIDED)
        return np.where(probability <= self.risk + edge, FAIL, decided)

    def words(self) -> str:
        """Say the rule in a sentence."""
        if self.kind == "simple":
            return "Simple acceptance (JCGM 106, 8.2): a value within its limits passes, whatever its uncertainty."
        percent = f"{100 * self.risk:.3g} %"
        return (
            "Guarded acceptance (JCGM 106, 8.3): a value passes if the probability that it lies beyond its limits is "
            f"at most {percent}, fails if the probability that it lies within them is at most {percent}, and is "
            f"undecided otherwise. At a single limit the guard band is {float(self.multiple()):.2f} standard "
            "uncertainties (more with few degrees of freedom)."
        )

    def document(self) -> Json:
        """Return the rule as JSON has it."""
        return {"rule": self.kind, "risk": self.risk, "text": self.words()}


def probability_of_conformity(
    value: ArrayLike, sigma: ArrayLike, low: ArrayLike, high: ArrayLike, freedom: ArrayLike = np.inf
) -> FloatArray:
    """Return the probability (...) that quantities lie between their limits; −inf or inf where there is no limit.

    **Arguments:** value, low, high (...) in one unit; sigma (...): standard uncertainties, zero where a value is exact;
    freedom (...): effective degrees of freedom.
    """
    value, sigma, low, high = (np.asarray(array, float) for array in (value, sigma, low, high))
    with np.errstate(divide="ignore", invalid="ignore"):
        above, below = (high - value) / sigma, (low - value) / sigma
    exact = np.broadcast_to(sigma == 0, above.shape)
    inside = ((low <= value) & (value <= high)).astype(float)
    # of the two tails the lesser ones are added: their difference from one keeps its digits
    outside = student_cdf(np.where(exact, 0.0, -above), freedom) + student_cdf(np.where(exact, 0.0, below), freedom)
    return np.where(exact, inside, np.clip(1 - outside, 0.0, 1.0))


def coverage(freedom: ArrayLike, k: float = 2.0) -> FloatArray:
    """Return the probability that value ± k standard uncertainties covers, with so many degrees of freedom."""
    return 1 - 2 * student_cdf(-k, freedom)


def worst(verdicts: ArrayLike) -> str:
    """Return the verdict of a whole: fail if any fails, else undecided if any is, else pass."""
    return max(np.asarray(verdicts).ravel().tolist(), key=VERDICTS.index, default=UNDECIDED)
