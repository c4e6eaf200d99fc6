"""Multi-factor regression: from output, temperatures and their rates to truth, of second order.

With five factors the full quadratic has 21 terms, with four 15. Terms are taken out and in by the Bayesian information
criterion, and what is kept is measured on stretches left out in turn.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from jaximu.errors import InputError, NotPossibleError

__all__ = ["Multifactor", "multifactor"]

FloatArray = NDArray[np.float64]
_FOLDS = 5


@dataclass(frozen=True)
class Multifactor:
    """A second-order regression: which terms it kept, of which, and how well it does.

    coefficients (k,) of `terms`, in the factors' own units; before, after, held_out: rms about the mean, of what is
    left, and on stretches left out, in the truth's unit.
    """

    terms: tuple[str, ...]
    coefficients: FloatArray
    offered: tuple[str, ...]
    before: float
    after: float
    held_out: float

    def predict(self, factors: Mapping[str, FloatArray]) -> FloatArray:
        """Return the truth (n,) that factors (n,) by name predict."""
        columns = _columns(factors)
        return np.stack([columns[term] for term in self.terms], axis=1) @ self.coefficients


def multifactor(factors: Mapping[str, FloatArray], truth: FloatArray) -> Multifactor:
    """Regress `truth` (n,) on the full quadratic of factors (n,) by name, keeping what contributes.

    Raises `InputError` for unlike lengths, `NotPossibleError` for too few rows or a factor that never changes.
    """
    truth = np.asarray(truth, float)
    for name, values in factors.items():
        if np.shape(values) != truth.shape:
            raise InputError(f"factor {name} has {np.shape(values)} values, the truth has {truth.shape}.")
        if np.ptp(values) == 0:
            raise NotPossibleError(f"factor {name} never changes: its effect cannot be determined.")
    scaled = {name: (np.asarray(v, float) - np.mean(v)) / np.std(v) for name, v in factors.items()}
    standard, columns = _columns(scaled), _columns(factors)
    offered = tuple(columns)
    if len(truth) < 3 * len(offered):
        raise NotPossibleError(f"{len(truth)} rows are too few for a regression with {len(offered)} terms.")

    def left(terms: list[str], rows: NDArray[np.bool_] | slice = slice(None)) -> FloatArray:
        matrix = np.stack([standard[term] for term in terms], axis=1)
        solved = np.linalg.lstsq(matrix[rows], truth[rows], rcond=1e-10)[0]
        return truth - matrix @ solved

    count = len(truth)

    def criterion(terms: list[str]) -> float:
        squares = max(float(np.sum(left(terms) ** 2)), 1e-300)
        return count * np.log(squares / count) + len(terms) * np.log(count)

    kept = list(offered)
    now = criterion(kept)
    while True:
        # a product keeps its factors, or what is kept would depend on where they count from
        moves = [[t for t in kept if t != each] for each in kept if each != "1" and not _needed(each, kept)]
        moves += [[t for t in offered if t in kept or t == each] for each in offered if each not in kept]
        costs = [criterion(move) for move in moves]
        if not costs or min(costs) >= now - 1e-9:
            break
        now, kept = min(costs), moves[int(np.argmin(costs))]
    errors = np.zeros(count)
    for part in np.array_split(np.arange(count), _FOLDS):
        rows = np.ones(count, bool)
        rows[part] = False
        errors[part] = left(kept, rows)[part]
    matrix = np.stack([columns[term] for term in kept], axis=1)
    size = np.linalg.norm(matrix, axis=0)
    coefficients = np.linalg.lstsq(matrix / size, truth, rcond=1e-13)[0] / size
    rms = [float(np.sqrt(np.mean(each**2))) for each in (truth - truth.mean(), left(kept), errors)]
    return Multifactor(tuple(kept), coefficients, offered, *rms)


def _columns(factors: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    names = list(factors)
    found = {"1": np.ones(len(factors[names[0]]))} | {name: np.asarray(factors[name], float) for name in names}
    for a, b in combinations_with_replacement(names, 2):
        found[f"{a}²" if a == b else f"{a}·{b}"] = found[a] * found[b]
    return found


def _needed(term: str, kept: list[str]) -> bool:
    return any(term in (other.removesuffix("²"), *other.split("·")) for other in kept if other != term)
