"""Bias over temperature by generalised least squares: which terms a path determines, which hold on ways left out.

At rest each axis's output is a level (bias, and for an accelerometer gravity) for each rest, plus coefficients times
shapes that the thermal effects of the catalogue take along the temperature's path. Any path will do: what it determines
is read off the shapes themselves. Each axis has terms of its own; inner parameters (a time constant, a half-width) are
the device's, and shared. Noise ties blocks to each other, and is whitened by its covariance, so that slow bias does not
pass for temperature and a long soak counts for no more than it determines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

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
from jaximu.model.effects.network import UNITS
from jaximu.model.sensor import Imu


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
        return next(candidate.held for candidate in self.candidates if candidate.family == "constant")

    @property
    def inner(self) -> dict[tuple[str, str], tuple[float, float]]:
        """Value and standard deviation of each inner parameter, by effect and name."""
        return {
            (self.effects[name.effect].plain, name.part): (float(value), float(sigma))
            for name, value, sigma in zip(self.fit.names, self.fit.values, self.fit.sigmas(), strict=True)
            if name.effect is not None and name.part != "coefficients"
        }


def fit_triad(data: Whitened, identifiability: Identifiability, wanted: Sequence[str] | None = None) -> TriadFit:
    """Fit every family of models, choose for each axis by what was left out, and return the choice, with uncertainty.

    Inner parameters are those of the model that is best for all axes together: each axis then chooses its terms at
    them. An axis is left as it is where no model predicts what was left out better than a constant does.
    """
    folds, beyond = folds_of(identifiability.legs), beyond_bias(data, identifiability)
    scale = richest(data, identifiability)[1]
    offered = {
        family: effects
        for family, effects in families_of(identifiability.told, beyond).items()
        if family == "constant" or wanted is None or family in wanted
    }
    models: dict[str, Model] = {}
    for family, (names, fixed) in offered.items():
        model = tuned(data, (terms_of(names, data.shapes),) * 3, scale)
        models[family] = tuned(data, stepwise(data, model, fixed, scale), scale)

    def candidate(family: str) -> Candidate:
        return candidate_of(data, family, models[family], folds, scale)

    tried = {family: candidate(family) for family in models}
    if remembering := [one for one in tried.values() if memories(one.names)]:
        best = max(one.score for one in remembering)
        anchor = min((one for one in remembering if one.score > best - PAYS), key=lambda one: one.parameters)
        memory = {BESIDE.get(term.name, term.name): term for term in anchor.terms if memories([term.name])}
        for family, (names, fixed) in offered.items():
            if family != anchor.family and set(memory) & set(names):
                terms = tuple(at_inner(term, memory) for term in terms_of(names, data.shapes))
                models[family] = stepwise(data, (terms,) * 3, fixed, scale)
                tried[family] = candidate(family)
    candidates = list(tried.values())
    if wanted is None or "network" in wanted:
        best = tuple(candidates[k].model[axis] for axis, k in enumerate(best_by_axis(candidates)))
        if wanted is not None or patterned(data, best, scale):
            rated = any(name in identifiability.told for name in RATES)
            network, scale = with_network(data, beyond, rated, folds, scale)
            candidates = [*map(candidate, models), network]
    by_axis = [candidates[k] for k in best_by_axis(candidates)]
    families = tuple(chosen.family for chosen in by_axis)
    model = completed(tuple(chosen.model[axis] for axis, chosen in enumerate(by_axis)))
    title = ", ".join(dict.fromkeys(family for family in families if family != "constant")) or "constant"
    fit = _concluded(data, candidate_of(data, title, model, folds, scale), families, candidates)
    vague = memories(effect for (effect, _), (value, sigma) in fit.inner.items() if sigma > VAGUE * value)
    if not vague:
        return fit
    observable = tuple(name for name in identifiability.told if name not in vague)
    return fit_triad(data, replace(identifiability, told=observable), wanted)


def _concluded(
    data: Whitened, chosen: Candidate, families: tuple[str, ...], candidates: Sequence[Candidate]
) -> TriadFit:
    """Return the core's fit of the model chosen axis by axis, and what it leaves of the blocks."""
    blocks = data.blocks
    freedom = len(blocks) - blocks.levels - chosen.numbers
    misfit = np.array([data.misfit(axis, terms) for axis, terms in enumerate(chosen.model)])
    fitted = _fitted(data, chosen.model, np.maximum(misfit / freedom, 1.0))
    effects = tuple(fitted.imu.triad(data.name).effects)
    scale = blocks.recordings[0].signals[data.name].nominal_scale
    added = mean_terms(effects, data.shapes.tracks, len(blocks))[0] / scale
    rest = data.means - added
    level = np.stack(
        [np.linalg.lstsq(data.levels[axis], data.root[axis] @ rest[:, axis], rcond=None)[0] for axis in range(3)]
    )
    before, after = (blocks.left(data.name, output) for output in (data.means, rest))
    rest -= level.T[blocks.level]
    white = np.einsum("aij,ja->ai", data.root, rest)
    chi = (white**2).sum(axis=1) / freedom
    return TriadFit(chosen, families, tuple(candidates), fitted, effects, level, rest, added, before, after, chi)


def _fitted(data: Whitened, model: Model, scale: FloatArray) -> Fit:
    """Fit the coefficients of each axis's terms and the inner parameters that the axes share, in output units.

    The fit starts where the terms have their inner parameters. `scale` (3,): of the noise's variance, to begin with.
    """
    name, blocks, shapes = data.name, data.blocks, data.shapes
    signal = blocks.recordings[0].signals[name]
    kinds = {term.name: CATALOGUE[f"{PREFIXES[name]}.{term.name}"] for terms in model for term in terms}
    order = list(kinds)
    values = {plain: np.zeros(kind.size) for plain, kind in kinds.items()}
    inner = {
        plain: {key: shapes.bounds[key] for key in kind.inner if key in shapes.bounds} for plain, kind in kinds.items()
    }
    used, known = set(), {}
    for axis, terms in enumerate(model):
        for term, value in zip(terms, data.coefficients(axis, terms), strict=True):
            inside = term.net is not None and term.shape >= UNITS  # of tanh, where there is no unit
            unit = 1.0 if inside else signal.nominal_scale[axis]
            index = axis * kinds[term.name].size // 3 + term.shape
            number = Name(name, "coefficients", (index,), order.index(term.name))
            used.add(number)
            values[term.name][index] = value * unit
            inner[term.name] |= {key: term.inner for key in kinds[term.name].inner if key in HISTORY.values()}
            if term.net is not None:
                known[number] = term.net.prior[axis, term.shape] * np.sqrt(scale[axis]) * unit

    def free(number: Name) -> bool:
        if number.effect is None:
            return number.owner == name and number.part == "bias"
        return number.owner == name and (number in used or number.part in HISTORY.values())

    effects = [
        kind(values[plain], **{key: np.float64(value) for key, value in inner[plain].items()})
        for plain, kind in kinds.items()
    ]
    outputs = blocks.means[name] * signal.nominal_scale + signal.nominal_offset
    weights = data.root / signal.nominal_scale[:, None, None]
    measurement = RestOverTemperature(name, outputs, weights, blocks.level, shapes.tracks)
    triads: dict[str, Any] = {
        owner: replace(triad, temperature_reference=shapes.reference) for owner, triad in Imu.nominal().triads().items()
    }
    triads[name] = replace(triads[name], gain=np.diag(signal.nominal_scale), bias=outputs.mean(axis=0))
    unit = replace(Imu.nominal(), **triads).with_effects(*effects)
    # a network is solved already, and is asked for its uncertainty: full steps, as the passes take, lead it astray
    prior = Prior(tuple(known), np.zeros(len(known)), np.diag(1 / np.array(list(known.values())))) if known else None
    return fit(
        unit, measurement, free, prior=prior, excess=scale - 1, estimate_excess=not known, max_passes=1 if known else 32
    )
