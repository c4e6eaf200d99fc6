"""Bias over temperature by generalised least squares: which terms a path determines, which hold on ways left out.

At rest each axis's output is a level (bias, and for an accelerometer gravity) for each rest, plus coefficients times
shapes that the thermal effects of the catalogue take along the temperature's path. Any path will do: what it determines
is read off the shapes themselves. Each axis has terms of its own; inner parameters (a time constant, a half-width) are
the device's, and shared. Noise ties blocks to each other, and is whitened by its covariance, so that slow bias does not
pass for temperature and a long soak counts for no more than it determines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaximu.calibration.identifiability import Identifiability
from jaximu.calibration.thermal_linear import Held, Whitened
from jaximu.calibration.thermal_network import patterned, with_network
from jaximu.calibration.thermal_selection import (
    PAYS,
    VAGUE,
    Candidate,
    best_by_axis,
    beyond_bias,
    candidate_of,
    completed,
    families_of,
    richest,
    stepwise,
    terms_of,
    tuned,
)
from jaximu.calibration.thermal_terms import BESIDE, HISTORY, RATES, Model, at_inner, memories
from jaximu.data.rest import RestOverTemperature, mean_terms
from jaximu.data.rest_blocks import folds_of
from jaximu.estimation.fitting import Fit, Prior, fit
from jaximu.estimation.problem import Name
from jaximu.ground.array_types import FloatArray
from jaximu.ground.units import PREFIXES
from jaximu.model.effects import CATALOGUE, Effect
from jaximu.model.effects.network import UNITS, WEIGHTS
from jaximu.model.sensor import Imu

__all__ = ["TriadFit", "fit_triad"]


@dataclass(frozen=True)
class TriadFit:
    """The chosen model of a triad.

    families: of each axis's model. fit: of the unit with the model's effects, in output units, whose bias is the mean
    of the rests' levels; effects: of the triad. level (3, L): by axis and rest, at the reference temperature. residual
    (n, 3): of the blocks; fitted (n, 3): what temperature adds to them. before, after (3,): rms, as `compensate` leaves
    it, of `RestBlocks.left`. chi_squared (3,): per degree of freedom, against the noise. All but the fit in SI.
    """

    candidate: Candidate
    families: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    fit: Fit
    effects: tuple[Effect, ...]
    level: FloatArray
    residual: FloatArray
    fitted: FloatArray
    before: FloatArray
    after: FloatArray
    chi_squared: FloatArray

    @property
    def held_before(self) -> Held:
        """What was left out, without a model."""
        return next(each.held for each in self.candidates if each.family == "constant")

    @property
    def inner(self) -> dict[tuple[str, str], tuple[float, float]]:
        """Value and standard deviation of each inner parameter, by effect and name."""
        sigmas = self.fit.sigmas()
        return {
            (self.effects[name.effect].plain, name.part): (float(self.fit.values[place]), float(sigmas[place]))
            for place, name in enumerate(self.fit.names)
            if name.effect is not None and name.part != "coefficients"
        }


def fit_triad(data: Whitened, found: Identifiability, families: Sequence[str] | None = None) -> TriadFit:
    """Fit every family of models, choose for each axis by what was left out, and return the choice, with uncertainty.

    Inner parameters are those of the model that is best for all axes together: each axis then chooses its terms at
    them. An axis is left as it is where no model predicts what was left out better than a constant does.
    """
    folds, beyond = folds_of(found.legs), beyond_bias(data, found)
    scale = richest(data, found)[1]
    offered = {family: each for family, each in families_of(found.told, beyond).items()
               if family == "constant" or families is None or family in families}  # fmt: skip
    tried: dict[str, Model] = {}
    for family, (names, fixed) in offered.items():
        model = tuned(data, (terms_of(names, data.shapes),) * 3, scale)
        tried[family] = tuned(data, stepwise(data, model, fixed, scale), scale)
    candidates = [candidate_of(data, family, model, folds, scale) for family, model in tried.items()]
    if remembering := [each for each in candidates if memories(each.names)]:
        best = max(float(np.sum(each.scores)) for each in remembering)
        anchor = min((each for each in remembering if np.sum(each.scores) > best - PAYS), key=lambda c: c.parameters)
        own = {BESIDE.get(term.name, term.name): term for term in anchor.terms if memories([term.name])}
        for place, each in enumerate(candidates):
            names, fixed = offered[each.family]
            terms = tuple(at_inner(term, own) for term in terms_of(names, data.shapes))
            if each is not anchor and set(own) & set(names):
                tried[each.family] = stepwise(data, (terms,) * 3, fixed, scale)
                candidates[place] = candidate_of(data, each.family, tried[each.family], folds, scale)
    if families is None or "network" in families:
        best = tuple(candidates[k].model[axis] for axis, k in enumerate(best_by_axis(candidates)))
        if families is not None or patterned(data, best, scale):
            rated = any(name in found.told for name in RATES)
            network, scale = with_network(data, beyond, rated, folds, scale)
            candidates = [candidate_of(data, family, model, folds, scale) for family, model in tried.items()]
            candidates.append(network)
    chosen = [candidates[k] for k in best_by_axis(candidates)]
    model = completed(tuple(each.model[axis] for axis, each in enumerate(chosen)))

    def of(values: Callable[[Candidate], Sequence[float] | FloatArray]) -> FloatArray:
        return np.array([values(each)[axis] for axis, each in enumerate(chosen)])

    more = [len(terms) - len(each.model[axis]) for axis, (terms, each) in enumerate(zip(model, chosen, strict=True))]
    families_chosen = tuple(each.family for each in chosen)
    named = tuple(dict.fromkeys(family for family in families_chosen if family != "constant")) or ("constant",)
    held = Held(of(lambda each: each.held.rms), of(lambda each: each.held.by_axis))
    numbers = of(lambda each: each.numbers) + more
    whole = Candidate(", ".join(named), model, numbers, of(lambda each: each.costs), held)
    fit = _concluded(data, whole, families_chosen, tuple(candidates))
    vague = memories(effect for (effect, _), (value, sigma) in fit.inner.items() if sigma > VAGUE * value)
    if not vague:
        return fit
    told = tuple(name for name in found.told if name not in vague)
    return fit_triad(data, replace(found, told=told), families)


def _concluded(
    data: Whitened, chosen: Candidate, families: tuple[str, ...], candidates: tuple[Candidate, ...]
) -> TriadFit:
    """Return the core's fit of the chosen model, and what it leaves of the blocks."""
    blocks, count = data.blocks, len(data.blocks)
    freedom = count - blocks.levels - chosen.numbers
    misfit = np.array([data.misfit(axis, terms) for axis, terms in enumerate(chosen.model)])
    found = _fitted(data, chosen.model, np.maximum(misfit / freedom, 1.0))
    effects = tuple(getattr(found.imu, data.name).effects)
    added = mean_terms(effects, data.shapes.tracks, count)[0] / getattr(blocks.recordings[0], data.name).nominal_scale
    rest = data.means - added
    level = np.stack([np.linalg.lstsq(data.levels[axis], data.root[axis] @ rest[:, axis], rcond=None)[0]
                      for axis in range(3)])  # fmt: skip
    before, after = (blocks.left(data.name, output) for output in (data.means, rest))
    rest = rest - level.T[blocks.level]
    white = np.einsum("aij,ja->ai", data.root, rest)
    chi = np.sum(white**2, axis=1) / freedom
    return TriadFit(chosen, families, candidates, found, effects, level, rest, added, before, after, chi)


def _fitted(data: Whitened, model: Model, scale: FloatArray) -> Fit:
    """Fit the coefficients of each axis's terms and the inner parameters that the axes share, in output units.

    The fit starts where the terms have their inner parameters. `scale` (3,): of the noise's variance, to begin with.
    """
    name, blocks, shapes = data.name, data.blocks, data.shapes
    signal = getattr(blocks.recordings[0], name)
    kinds = {term.name: CATALOGUE[f"{PREFIXES[name]}.{term.name}"] for terms in model for term in terms}
    places = {plain: place for place, plain in enumerate(kinds)}
    numbers = {plain: np.zeros(kind.size) for plain, kind in kinds.items()}
    inner = {plain: {key: shapes.bounds[key] for key in kind.inner if key in shapes.bounds}
             for plain, kind in kinds.items()}  # fmt: skip
    told, known = set(), {}
    for axis, terms in enumerate(model):
        for term, value in zip(terms, data.coefficients(axis, terms), strict=True):
            shape = term.shape or 0
            unit = signal.nominal_scale[axis] if term.net is None or shape < UNITS else 1.0  # inside tanh there is none
            place = axis * kinds[term.name].size // 3 + shape
            number = Name(name, "coefficients", (place,), places[term.name])
            told.add(number)
            numbers[term.name][place] = value * unit
            inner[term.name] |= dict(term.inner)
            if term.net is not None:
                known[number] = np.reshape(term.net.prior, (3, WEIGHTS))[axis, shape] * np.sqrt(scale[axis]) * unit

    def free(number: Name) -> bool:
        if number.effect is None:
            return number.owner == name and number.part == "bias"
        return number.owner == name and (number in told or number.part in HISTORY.values())

    effects = [kind(numbers[plain], **{key: np.float64(each) for key, each in inner[plain].items()})
               for plain, kind in kinds.items()]  # fmt: skip
    outputs = blocks.means[name] * signal.nominal_scale + signal.nominal_offset
    weights = data.root / signal.nominal_scale[:, None, None]
    measurement = RestOverTemperature(name, outputs, weights, blocks.level, shapes.tracks)
    triads = {owner: replace(triad, temperature_reference=shapes.reference)
              for owner, triad in Imu.nominal().triads().items()}  # fmt: skip
    triads[name] = replace(triads[name], gain=np.diag(signal.nominal_scale), bias=outputs.mean(axis=0))
    unit = Imu(triads["accelerometer"], triads["gyroscope"]).with_effects(*effects)
    # a network is solved already, and is asked for its uncertainty: full steps, as the passes take, lead it astray
    prior = Prior(tuple(known), np.zeros(len(known)), np.diag(1 / np.array(list(known.values())))) if known else None
    return fit(unit, measurement, free, prior=prior, excess=scale - 1, estimate_excess=not known,
               max_passes=1 if known else 32)  # fmt: skip
