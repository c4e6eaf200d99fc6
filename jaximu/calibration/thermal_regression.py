"""Multi-factor regression of second order on temperatures and their rates, against which a thermal model is held."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations_with_replacement

import numpy as np

from jaximu.calibration.thermal_selection import exchanged
from jaximu.estimation.leave_out import leave_out, off, orthonormal
from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import rms

_FOLDS = 5


def multifactor(factors: Mapping[str, FloatArray], truth: FloatArray) -> tuple[list[str], float]:
    """Regress `truth` (n,) on the full quadratic of factors (n,) by name (of five: 21 terms; of four: 15).

    **Returns:** the terms that the Bayesian information criterion keeps, and the rms on stretches left out in turn.
    """
    count = len(truth)
    scaled = {name: (values - values.mean()) / values.std() for name, values in factors.items()}
    columns = {"1": np.ones(count)} | scaled
    for a, b in combinations_with_replacement(scaled, 2):
        columns[f"{a}²" if a == b else f"{a}·{b}"] = scaled[a] * scaled[b]

    def matrix(terms: Sequence[str]) -> FloatArray:
        return np.column_stack([columns[term] for term in terms])

    def criterion(terms: Sequence[str]) -> float:
        left = off(orthonormal(matrix(terms)), truth)
        return count * np.log(max(float(left @ left), 1e-300) / count) + len(terms) * np.log(count)

    def stays(term: str, kept: Sequence[str]) -> bool:
        # a product keeps its factors, or what is kept would depend on where they count from
        products = (other for other in kept if other != term)
        return term == "1" or any(term in (product.removesuffix("²"), *product.split("·")) for product in products)

    kept = exchanged(tuple(columns), criterion, stays)
    parts = leave_out(np.eye(count), matrix(kept), truth, np.array_split(np.arange(count), _FOLDS))
    return kept, rms(np.concatenate([part.errors for part in parts]))
