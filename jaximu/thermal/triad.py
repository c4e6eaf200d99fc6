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
from jaximu.effects import CATALOGUE, Effect
from jaximu.effects.network import UNITS, WEIGHTS
from jaximu.leave_out import orthonormal
from jaximu.thermal import network
from jaximu.thermal.identifiability import Identifiability
from jaximu.thermal.linear import Held, Whitened
from jaximu.thermal.network import Net
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
from jaximu.thermal.shapes import GRID, ThermalShapes
from jaximu.thermal.terms import HISTORY, LEARNED, NETWORK, POWERS, RATES, SPLINES, Model, Term

__all__ = ["TriadFit", "effects_of", "fit_triad"]

FloatArray = NDArray[np.float64]
_PATTERN = 1e-3
"""Probability of what the best model leaves, were it noise, below which a network is tried."""
_ROUNDS, _POLISH = 3, 10


@dataclass(frozen=True)
class TriadFit:
    """The chosen model of a triad, in SI.

    families: of each axis's model. coefficients (3, k): by axis and term, zero where an axis has it not; level (3, L):
    by axis and rest, at the reference temperature. covariance: (3 (L + k) + i) of levels and coefficients, axis by
    axis, then the inner parameters, widened by `excess` where the residuals exceed the noise. residual (n, 3): of the
    blocks. before, after (3,): rms about the mean of each rest.
    """

    candidate: Candidate
    families: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    terms: tuple[Term, ...]
    coefficients: FloatArray
    level: FloatArray
    inner: dict[tuple[str, str], tuple[float, float]]  # (effect, name): value, sigma
    covariance: FloatArray
    residual: FloatArray
    fitted: FloatArray  # (n, 3): what temperature adds to each block
    before: FloatArray
    after: FloatArray
    excess: FloatArray  # (3,)
    chi_squared: FloatArray  # (3,) per degree of freedom
    held_before: Held = field(repr=False)


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
    model = tuned(data, completed(tuple(each.model[axis] for axis, each in enumerate(chosen))), scale)
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
    """Gauss–Newton of the weights against all of the data, each step halved until it is worth it."""

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
    """Return levels, coefficients and inner parameters of the chosen model, with their joint covariance."""
    shapes, levels, count = data.shapes, data.blocks.levels, len(data.blocks)
    model = _one_net(chosen.model)
    terms = tuple(dict.fromkeys(term for own in model for term in own))
    free = [k for k, term in enumerate(terms) if term.name in HISTORY]
    net = next((term.net for term in terms if term.net is not None), None)
    size = levels + len(terms)
    solved, residual = np.zeros((3, size)), np.zeros((3, count))
    jacobian = np.zeros((3, count + (WEIGHTS if net is not None else 0), 3 * size + len(free)))
    for axis, own in enumerate(model):
        places = [*range(levels), *(levels + terms.index(term) for term in own)]
        plain = [term for term in own if term.net is None]
        if net is not None and len(plain) < len(own):
            beside, residual[axis] = data.solve_beside(axis, plain, net)
            solved[axis, places] = np.concatenate([beside, np.reshape(net.weights, (3, WEIGHTS))[axis]])
        else:
            solved[axis, places], residual[axis] = data.solve(axis, own)
        design = data.design(axis, own)
        jacobian[axis, : len(design), [axis * size + place for place in places]] = design.T
        for place, k in enumerate(free):
            slope = _slope(data, terms[k])[axis] / terms[k].inner[0][1]
            jacobian[axis, :count, 3 * size + place] = slope * solved[axis, levels + k]
    flat = jacobian.reshape(-1, jacobian.shape[2])
    scale = np.linalg.norm(flat, axis=0)
    used = scale > 0
    information = (flat / np.where(used, scale, 1.0)).T @ (flat / np.where(used, scale, 1.0))
    inverse = np.linalg.pinv(information[np.ix_(used, used)], rcond=1e-12, hermitian=True)
    covariance = np.zeros((len(scale),) * 2)
    covariance[np.ix_(used, used)] = inverse / scale[used, None] / scale[used]
    chi = np.sum(residual**2, axis=1) / (count - levels - chosen.numbers)
    excess = np.maximum(1.0, chi)
    widen = np.sqrt(np.concatenate([np.repeat(excess, size), np.full(len(free), excess.mean())]))
    covariance = covariance * widen[:, None] * widen
    sigma = np.sqrt(np.diag(covariance))
    inner = {
        (terms[k].name, terms[k].inner[0][0]): (terms[k].inner[0][1], float(sigma[3 * size + place]))
        for place, k in enumerate(free)
    }
    added = np.zeros((count, 3)) + shapes.offset(terms).T
    for k, term in enumerate(terms):
        added += (solved[:, levels + k, None] * shapes.column(term)).T
    level = data.blocks.level
    about = data.means - np.stack([data.means[level == k].mean(axis=0) for k in range(levels)])[level]
    rest = data.means - added - solved[:, :levels].T[level]
    left = rest - np.stack([rest[level == k].mean(axis=0) for k in range(levels)])[level]
    return TriadFit(
        replace(chosen, model=model), families, candidates, terms, solved[:, levels:], solved[:, :levels], inner,
        covariance, rest, added, np.sqrt(np.mean(about**2, axis=0)), np.sqrt(np.mean(left**2, axis=0)), excess, chi,
        base,
    )  # fmt: skip


def _one_net(model: Model) -> Model:
    """Return the model with the network's weights zero on axes that do without it."""
    with_net = [any(term.net is not None for term in terms) for terms in model]
    if all(with_net) or not any(with_net):
        return model
    net = next(term.net for terms in model for term in terms if term.net is not None)
    weights = np.reshape(net.weights, (3, WEIGHTS)) * np.array(with_net)[:, None]
    masked = Net(tuple(weights.ravel().tolist()), net.prior)
    return tuple(tuple(term if term.net is None else term._replace(net=masked) for term in terms) for terms in model)


def _slope(data: Whitened, term: Term) -> FloatArray:
    """Return the change (3, n) of a term's whitened shape by the logarithm of its inner parameter."""
    value, step = term.inner[0][1], 0.01
    values = np.full(GRID, value)
    values[:2] = value * np.exp(step), value * np.exp(-step)
    up, down = data.shapes.prepare({term.name: values})[term.name][:2]
    return (data.column(up) - data.column(down)) / (2 * step)


def effects_of(fit: TriadFit, prefix: str, scale: FloatArray, shapes: ThermalShapes) -> tuple[Effect, ...]:
    """Return the fitted terms as effects of a triad with output units per SI unit `scale` (3,)."""
    bounds = {"low": np.float64(shapes.span[0]), "high": np.float64(shapes.span[1])}
    found = []
    for name in dict.fromkeys(term.name for term in fit.terms):
        kind = CATALOGUE[f"{prefix}.{name}"]
        own = [k for k, term in enumerate(fit.terms) if term.name == name]
        if name == LEARNED:
            coefficients = np.zeros((3, SPLINES))
            for k in own:
                coefficients[:, fit.terms[k].shape] = fit.coefficients[:, k] * scale
            found.append(kind(coefficients.ravel(), **bounds))  # pyright: ignore[reportCallIssue]
        elif name == NETWORK:
            coefficients = fit.coefficients[:, own].copy()
            coefficients[:, :UNITS] *= scale[:, None]
            found.append(kind(coefficients.ravel(), **bounds, reach=np.float64(shapes.reach)))  # pyright: ignore[reportCallIssue]
        else:
            inner = {key: np.float64(value) for key, value in fit.terms[own[0]].inner}
            found.append(kind(fit.coefficients[:, own[0]] * scale, **inner))
    return tuple(found)
