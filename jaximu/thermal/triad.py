"""Bias over temperature by generalised least squares: which terms a path determines, which hold on ways left out.

At rest each axis's output is a level (bias, and for an accelerometer gravity) for each rest, plus coefficients times
shapes that the thermal effects of the catalogue take along the temperature's path. Any path will do: what it determines
is read off the shapes themselves. Each axis has terms of its own; inner parameters (a time constant, a half-width) are
the device's, and shared. Noise ties blocks to each other, and is whitened by its covariance, so that slow bias does not
pass for temperature and a long soak counts for no more than it determines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from jaximu.distributions import chi2_sf
from jaximu.effects import Effect
from jaximu.effects.network import WEIGHTS
from jaximu.estimation import Fit
from jaximu.leave_out import orthonormal
from jaximu.thermal import network
from jaximu.thermal.fitting import fit_effects
from jaximu.thermal.identifiability import Identifiability
from jaximu.thermal.linear import Held, Whitened
from jaximu.thermal.network import Net
from jaximu.thermal.rest import RestBlocks
from jaximu.thermal.selection import (
    PAYS,
    VAGUE,
    Candidate,
    best_by_axis,
    beyond_bias,
    candidate_of,
    completed,
    families_of,
    folds_of,
    richest,
    scored,
    stepwise,
    terms_of,
    tuned,
)
from jaximu.thermal.terms import HISTORY, NETWORK, POWERS, RATES, Model, Term

__all__ = ["TriadFit", "fit_triad"]

FloatArray = NDArray[np.float64]
_PATTERN = 1e-3
"""Probability of what the best model leaves, were it noise, below which a network is tried."""
_ROUNDS, _POLISH = 3, 10


@dataclass(frozen=True)
class TriadFit:
    """The chosen model of a triad.

    families: of each axis's model. fit: of the unit with the model's effects, in output units, whose bias is the mean
    of the rests' levels; effects: of the triad. level (3, L): by axis and rest, at the reference temperature. residual
    (n, 3): of the blocks; fitted (n, 3): what temperature adds to them. before, after (3,): rms about the mean of each
    rest. chi_squared (3,): per degree of freedom, against the noise. All but the fit in SI.
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
    held_before: Held = field(repr=False)

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
    folds, more = folds_of(data.blocks, found.legs), beyond_bias(data, found)
    scale = richest(data, found)[1]
    offered = {family: each for family, each in families_of(found.told, more).items()
               if family == "constant" or families is None or family in families}  # fmt: skip
    tried: dict[str, Model] = {}
    for family, (names, fixed) in offered.items():
        model = tuned(data, (terms_of(names, data.shapes),) * 3, scale)
        tried[family] = tuned(data, stepwise(data, model, fixed, scale), scale)
    candidates = [candidate_of(data, family, model, folds, scale) for family, model in tried.items()]
    if remembering := [each for each in candidates if set(HISTORY) & set(each.names)]:
        best = max(float(np.sum(each.scores)) for each in remembering)
        anchor = min((each for each in remembering if np.sum(each.scores) > best - PAYS), key=lambda c: c.parameters)
        own = {term.name: term for term in anchor.terms if term.name in HISTORY}
        for place, each in enumerate(candidates):
            names, fixed = offered[each.family]
            terms = tuple(own.get(term.name, term) for term in terms_of(names, data.shapes))
            if each is not anchor and set(own) & set(names):
                tried[each.family] = stepwise(data, (terms,) * 3, fixed, scale)
                candidates[place] = candidate_of(data, each.family, tried[each.family], folds, scale)
    if families is None or "network" in families:
        best = tuple(candidates[k].model[axis] for axis, k in enumerate(best_by_axis(candidates)))
        if families is not None or _patterned(data, best, scale):
            network, scale = _networks(data, found, more, folds, scale)
            candidates = [candidate_of(data, family, model, folds, scale) for family, model in tried.items()]
            candidates.append(network)
    chosen = [candidates[k] for k in best_by_axis(candidates)]
    model = completed(tuple(each.model[axis] for axis, each in enumerate(chosen)))
    held = [[getattr(each.held, key)[axis] for axis, each in enumerate(chosen)] for key in
            ("rms", "by_axis", "chi_squared")]  # fmt: skip
    held = Held(*(np.array(values) for values in held))
    numbers = np.array([each.numbers[axis] + len(model[axis]) - len(each.model[axis])
                        for axis, each in enumerate(chosen)])  # fmt: skip
    costs = np.array([each.costs[axis] for axis, each in enumerate(chosen)])
    families_chosen = tuple(each.family for each in chosen)
    named = tuple(dict.fromkeys(family for family in families_chosen if family != "constant")) or ("constant",)
    whole = Candidate(", ".join(named), model, numbers, costs, held)
    base = next(each.held for each in candidates if each.family == "constant")
    fit = _concluded(data, whole, families_chosen, tuple(candidates), base)
    vague = {effect for (effect, _), (value, sigma) in fit.inner.items() if sigma > VAGUE * value}
    if not vague:
        return fit
    told = tuple(name for name in found.told if name not in vague)
    return fit_triad(data, replace(found, told=told), families)


def _patterned(data: Whitened, model: Model, scale: FloatArray) -> bool:
    """Whether the best model leaves anything that a smooth function of temperature and its rate could follow."""
    smooth = network.smooth_functions(data.shapes.inputs)
    for axis, terms in enumerate(model):
        base = orthonormal(data.design(axis, terms))
        left = data.solve(axis, terms)[1]
        white = data.root[axis] @ smooth
        free = orthonormal(white - base @ (base.T @ white))
        statistic = float(np.sum((free.T @ left) ** 2)) / scale[axis]
        if float(chi2_sf(np.array(statistic), free.shape[1])) < _PATTERN:
            return True
    return False


def _about(plain: Sequence[Term], net: Net) -> tuple[Term, ...]:
    return (*plain, *(Term(NETWORK, (), k, net) for k in range(WEIGHTS)))


def _polished(data: Whitened, plain: Sequence[Term], net: Net) -> Net:
    """Gauss–Newton of the weights against all of the data, each step halved until it is worth it.

    Not by the core's fit, which took three times as long and did not settle: it damps a step that led astray, but
    begins each pass anew with a full one.
    """

    def cost(net: Net) -> float:
        left = [data.solve_beside(axis, plain, net)[1] for axis in range(3)]
        return float(np.sum(np.square(left)) + np.sum((np.array(net.weights) / net.prior) ** 2))

    now = cost(net)
    for _ in range(_POLISH):
        solved = [data.solve(axis, _about(plain, net))[0][-WEIGHTS:] for axis in range(3)]
        step = np.concatenate(solved) - net.weights
        tried = (Net(tuple((net.weights + share * step).tolist()), net.prior) for share in 0.5 ** np.arange(6))
        better = next(((each, new) for each in tried if (new := cost(each)) < now), None)
        if better is None:
            break
        gained, (net, now) = now - better[1], better
        if gained < 0.01:
            break
    return net


def _networks(
    data: Whitened, found: Identifiability, more: Sequence[str], folds: Sequence[NDArray[np.int64]], scales: FloatArray
) -> tuple[Candidate, FloatArray]:
    """Fit a network of temperature and, where it can be told, its rate, beside a straight line in temperature.

    Returns with it the scale of the noise's variance, where the network explains more than what `scales` came from.
    """
    shapes, count, levels = data.shapes, len(data.blocks), data.blocks.levels
    plain = (Term(POWERS[0]), *(Term(name) for name in more))
    columns = [np.broadcast_to(shapes.column(term), (3, count)) for term in plain]
    indicator = np.broadcast_to(np.eye(levels)[data.blocks.level], (3, count, levels))
    linear = np.concatenate([indicator, np.stack(columns, axis=2)], axis=2)
    given = data.covariance, data.means.T, linear, shapes.inputs, shapes.origin
    rated = any(name in found.told for name in RATES)
    scale, left, freedom = float(np.mean(scales)), np.zeros(3), 1.0
    for _ in range(_ROUNDS):
        net, told = network.search(*given, scale, rated)
        net = _polished(data, plain, net)
        left = np.array([data.misfit(axis, _about(plain, net)) for axis in range(3)])
        before, freedom = scale, count - levels - len(plain) - told / 3
        scale = float(np.clip(left.sum() / (3 * freedom), 1.0, scale))
        if scale > 0.7 * before:
            break
    model = (_about(plain, net),) * 3
    anew = [_about(plain, each) for each in network.fitted(net, folds, *given, scale)]
    scales = np.minimum(scales, np.maximum(left / freedom, 1.0))
    held = data.held_out(model, folds, scales, anew)
    return scored(data, "network", model, np.full(3, len(plain) + told / 3), held, scales), scales


def _concluded(
    data: Whitened, chosen: Candidate, families: tuple[str, ...], candidates: tuple[Candidate, ...], base: Held
) -> TriadFit:
    """Return the core's fit of the chosen model, and what it leaves of the blocks."""
    blocks, count = data.blocks, len(data.blocks)
    freedom = count - blocks.levels - chosen.numbers
    misfit = np.array([data.misfit(axis, terms) for axis, terms in enumerate(chosen.model)])
    # a network was polished before: full steps from pass to pass, which the core takes, would lead it astray
    polished = any(term.net is not None for term in chosen.terms)
    scale = np.maximum(misfit / freedom, 1.0)
    found = fit_effects(data, chosen.model, scale, polished=polished)
    assert data.measurement is not None
    effects = tuple(getattr(found.model, data.name).effects)
    added = data.measurement.added(found.model) / getattr(blocks.recordings[0], data.name).nominal_scale
    rest = data.means - added
    level = np.stack([np.linalg.lstsq(data.levels[axis], data.root[axis] @ rest[:, axis], rcond=None)[0]
                      for axis in range(3)])  # fmt: skip
    rest = rest - level.T[blocks.level]
    white = np.einsum("aij,ja->ai", data.root, rest)
    chi = np.sum(white**2, axis=1) / freedom
    before, after = (np.sqrt(np.mean(_about_rests(each, blocks) ** 2, axis=0)) for each in (data.means, rest))
    return TriadFit(chosen, families, candidates, found, effects, level, rest, added, before, after, chi, base)


def _about_rests(values: FloatArray, blocks: RestBlocks) -> FloatArray:
    """Return values (n, 3) about their mean over each rest."""
    return values - np.stack([values[blocks.level == k].mean(axis=0) for k in range(blocks.levels)])[blocks.level]
