"""The families of thermal models, the terms that the data determine, and which of them hold on ways left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from math import comb, log
from typing import TypeVar

import numpy as np

from jaximu.calibration.identifiability import Identifiability
from jaximu.calibration.thermal_linear import Held, Whitened
from jaximu.calibration.thermal_shapes import GRID, ThermalShapes
from jaximu.calibration.thermal_terms import (
    BESIDE,
    HISTORY,
    LEARNED,
    POWERS,
    RATES,
    SCALE,
    SPLINES,
    Model,
    ThermalTerm,
    at_inner,
    history,
    memories,
    net_of,
)
from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.ground.units import PREFIXES
from jaximu.model.effects.network import WEIGHTS

T = TypeVar("T")
CUBIC = "cubic"
_ZOOMS = 4  # grids of inner parameters, each between the neighbours of the last one's best
PAYS = 5.0
"""Nats that a more complicated model must gain."""
_AT_ONCE = (POWERS[0], LEARNED)
_PICKED = 0.3  # numbers by nat of choice: two over the logarithm of some hundred blocks
_ALIKE = 1.1  # times the least error on what was left out, up to which a simpler model may have more
VAGUE = 0.5  # of a time constant or a half-width: with a larger standard deviation slow noise is taken for it


@dataclass(frozen=True)
class Candidate:
    """A model that was tried: its family, terms by axis, information criterion and how it did on what was left out.

    numbers, costs (3,): how many numbers of an axis the data determine, and the information criterion.
    """

    family: str
    model: Model
    numbers: FloatArray
    costs: FloatArray
    held: Held

    @property
    def terms(self) -> tuple[ThermalTerm, ...]:
        """The terms that any axis has."""
        return tuple(dict.fromkeys(term for terms in self.model for term in terms))

    @property
    def parameters(self) -> float:
        """How many numbers of the three axes the data determine."""
        return float(self.numbers.sum())

    @property
    def scores(self) -> FloatArray:
        """What models of an axis (3,) are compared by, nats: log-likelihood on what was left out and in sample, less
        the penalty.
        """
        return self.held.by_axis - self.costs / 2

    @property
    def score(self) -> float:
        """That of the three axes together."""
        return float(self.scores.sum())

    @property
    def names(self) -> tuple[str, ...]:
        """The effects in it, without prefix."""
        return tuple(dict.fromkeys(term.name for term in self.terms))

    def effects(self, triad: str) -> list[str]:
        """Return the effects in it as the catalogue names those of a triad."""
        return [f"{PREFIXES[triad]}.{name}" for name in self.names]


def parameters_of(terms: Sequence[ThermalTerm]) -> float:
    """Return how many numbers of an axis the data determine: coefficients, inner parameters, weights of a network.

    That pieces of a curve were picked from all counts as well.
    """
    pieces, net = sum(term.name == LEARNED for term in terms), net_of(terms)
    weights = 0.0 if net is None else WEIGHTS - net.determined
    return len(terms) - weights + len(memories(term.name for term in terms)) + _PICKED * log(comb(SPLINES, pieces))


def stepwise(data: Whitened, model: Model, fixed: Sequence[str], scale: FloatArray) -> Model:
    """Leave out terms, and take them in again, axis by axis, as the information criterion says; `fixed` stay.

    What acts at once stays beside what has a memory: without it another time constant takes its place.
    """
    misfit = data.reduced([term for terms in model for term in terms])
    penalty = float(np.log(len(data.blocks)))
    kept = []
    for axis, full in enumerate(model):

        def criterion(chosen: Sequence[ThermalTerm], axis: int = axis) -> float:
            return misfit(axis, chosen) / scale[axis] + penalty * parameters_of(chosen)

        def stays(term: ThermalTerm, kept: Sequence[ThermalTerm]) -> bool:
            return term.name in fixed or (term.name in _AT_ONCE and bool(memories(other.name for other in kept)))

        kept.append(tuple(exchanged(full, criterion, stays)))
    return tuple(kept)


def exchanged(
    full: Sequence[T], criterion: Callable[[Sequence[T]], float], stays: Callable[[T, Sequence[T]], bool]
) -> list[T]:
    """Take terms out of `full`, and in again, one at a time, while that lowers the criterion; some may have to stay."""
    kept = list(full)
    now = criterion(kept)
    while True:
        moves = [[term for term in kept if term != old] for old in kept if not stays(old, kept)]
        moves += [[term for term in full if term in kept or term == new] for new in full if new not in kept]
        costs = [criterion(move) for move in moves]
        if not costs or min(costs) >= now - 1e-9:
            return kept
        now, kept = min(costs), moves[int(np.argmin(costs))]


def tuned(data: Whitened, model: Model, scale: FloatArray) -> Model:
    """Return the model with its inner parameters, which the axes share, at the least misfit: a grid, refined."""
    used = memories(term.name for terms in model for term in terms)
    if not (grids := {name: grid for name, grid in data.shapes.grids.items() if name in used}):
        return model
    spacing = {name: float(grid[1] / grid[0]) for name, grid in grids.items()}
    touched = [axis for axis, terms in enumerate(model) if memories(term.name for term in terms)]
    terms = [term for axis in touched for term in model[axis]]
    best: tuple[ThermalTerm, ...] = ()

    def at(chosen: tuple[ThermalTerm, ...]) -> Model:
        by_name = {term.name: term for term in chosen}
        return tuple(tuple(at_inner(term, by_name) for term in terms) for terms in model)

    for _ in range(_ZOOMS):
        options = data.shapes.prepare(grids)
        offered = [(term, options.get(BESIDE.get(term.name, term.name), [term])) for term in terms]
        misfit = data.reduced([term._replace(inner=one.inner) for term, values in offered for one in values])

        def cost(chosen: tuple[ThermalTerm, ...], misfit=misfit) -> float:
            tuned_model = at(chosen)
            return sum(misfit(axis, tuned_model[axis]) / scale[axis] for axis in touched)

        best = min(product(*options.values()), key=cost)
        for term in best:
            name, bounds = term.name, data.shapes.grids[term.name][[0, -1]]
            grids[name] = (term.inner * np.geomspace(1 / spacing[name], spacing[name], GRID)).clip(*bounds)
            spacing[name] **= 2 / (GRID - 1)
    return at(best)


def families_of(observable: Sequence[str], more: Sequence[str]) -> dict[str, tuple[list[str], tuple[str, ...]]]:
    """Return the families of models: their effects, and those that stepwise selection must keep.

    `more`: effects that all but the autopilots' cubic may have beside.
    """
    rates = [name for name in RATES if name in observable]
    memory = [name for name in HISTORY if name in observable]
    beside = [name for name, leader in BESIDE.items() if leader in memory]
    families: dict[str, tuple[list[str], tuple[str, ...]]] = {
        "constant": ([], ()),
        CUBIC: (list(POWERS), POWERS),
        "polynomial": ([*POWERS, *rates, *more], ()),
        "spline": ([LEARNED, *rates, *more], ()),
    }
    for name in memory:
        with_it = [other for other in beside if BESIDE[other] == name]
        families[name.replace("_", " ")] = ([*POWERS, name, *with_it, *more], (name,))
    if memory:
        families["all"] = ([*POWERS, *rates, *memory, *beside, *more], ())
        families["spline and memory"] = ([LEARNED, *rates, *memory, *beside, *more], ())
    return families


def terms_of(names: Sequence[str], shapes: ThermalShapes) -> tuple[ThermalTerm, ...]:
    """Return the terms of effects, those with memory at a typical inner parameter."""
    terms: list[ThermalTerm] = []
    for name in names:
        leader = BESIDE.get(name, name)
        if name == LEARNED:
            terms += [ThermalTerm(LEARNED, shape=k) for k in range(SPLINES)]
        elif leader in HISTORY:
            terms.append(history(name, shapes.grids[leader][GRID // 2]))
        else:
            terms.append(ThermalTerm(name))
    return tuple(terms)


def richest(data: Whitened, identifiability: Identifiability) -> tuple[Model, FloatArray]:
    """Return the model with all that can be separated from temperature, and the scale (3,) of the noise beside it."""
    separable = [name for name in (*RATES, *HISTORY) if name in identifiability.told]
    terms = terms_of([LEARNED, *separable, *beyond_bias(data, identifiability)], data.shapes)
    model = tuned(data, (terms,) * 3, np.ones(3))
    freedom = max(len(data.blocks) - data.blocks.levels - parameters_of(terms), 1)
    return model, np.array([max(1.0, data.misfit(axis, model[axis]) / freedom) for axis in range(3)])


def beyond_bias(data: Whitened, identifiability: Identifiability) -> list[str]:
    return [SCALE] if SCALE in identifiability.told and data.name == "accelerometer" else []


def completed(model: Model) -> Model:
    """Return the model with lag and hysteresis on every axis that has one of them, if any axis has both.

    They are as much alike as their inner parameters make them: one that is left out biases the other's.
    """
    memory = dict.fromkeys(term for terms in model for term in terms if term.name in HISTORY)
    unique = {term.name: term for term in memory}
    return tuple(
        (*(term for term in terms if term.name not in HISTORY), *unique.values())
        if any(term.name in HISTORY for term in terms)
        else terms
        for terms in model
    )


def best_by_axis(candidates: Sequence[Candidate]) -> list[int]:
    """Return for each axis the candidate to take: the simplest of those close to the best that correct it as well.

    A slow walk predicts a stretch from its neighbours nearly as well as a model does, and only the model corrects
    another recording: what the terms alone leave of the stretches left out decides between what is about as likely.
    None is taken that leaves as much there as a simpler one does.
    """
    (plain,) = (k for k, candidate in enumerate(candidates) if candidate.family == "constant")
    measures = np.array([(one.held.rms, one.costs, one.scores, one.numbers) for one in candidates])
    chosen = []
    for axis in range(3):
        rms, costs, scores, numbers = measures[:, :, axis].T
        helps = (rms < rms[plain]) & (costs < costs[plain])
        # a spline of few pieces is no simpler than a polynomial
        learned = np.array([any(term.name == LEARNED for term in one.model[axis]) for one in candidates])
        simplest = np.lexsort((-scores, numbers, learned))
        helps[simplest[1:]] &= rms[simplest[1:]] < np.minimum.accumulate(rms[simplest])[:-1]
        helps[plain] = True
        close = helps & (scores > scores[helps].max() - PAYS)
        close &= rms <= _ALIKE * rms[close].min()
        chosen.append(int(simplest[close[simplest]][0]))
    return chosen


def candidate_of(data: Whitened, family: str, model: Model, folds: Sequence[IntArray], scale: FloatArray) -> Candidate:
    """Return a model with how it did where folds were left out; `scale` (3,): of the noise's variance."""
    numbers = np.array([parameters_of(terms) for terms in model])
    misfit = np.array([data.misfit(axis, terms) for axis, terms in enumerate(model)])
    costs = misfit / scale + float(np.log(len(data.blocks))) * numbers
    return Candidate(family, model, numbers, costs, data.held_out(model, folds, scale))
