"""What a misfit that no effect explains depends on: a smooth curve of one covariate, scored on parts left out.

The curve's coefficients c are a priori normal, of variance τ²/ρ with the roughness ρ of their shapes, and of the base
model's parameters nothing is known a priori. Parts are left out as in `jaximu.estimation.leave_out`: no refit for a
fold, and slow bias, which ties parts to their neighbours, is carried over in both models. τ is chosen by the same
score.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import jax
import numpy as np
from scipy.linalg import solve_triangular

from jaximu.diagnosis.experiment import LEAST_WARMING, Experiment, State
from jaximu.diagnosis.extension import Extension, extend
from jaximu.diagnosis.improvement import Gain, Prediction, on_held_out, parts_left_out
from jaximu.diagnosis.selection import LEVEL, Selection, select
from jaximu.estimation.fitting import Prior
from jaximu.estimation.leave_out import LeftOut, further, leave_out, orthonormal
from jaximu.estimation.problem import Name
from jaximu.ground.array_types import BoolArray, FloatArray
from jaximu.ground.distributions import chi2_sf
from jaximu.ground.document import Json
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.quantities import Z95
from jaximu.ground.vectors import submatrix
from jaximu.model.effects import CATALOGUE
from jaximu.model.effects.learned import Learned as Curve

_PARTS = 8  # left out in turn
_STRENGTHS = 10.0 ** np.arange(7)
"""Prior variances tried, of what the data tells best, in variances that the data tells it with."""
_PAYS = 10.0
"""Nats that a curve must gain on parts left out: with nothing hidden, the best of all does so in 0.2 % of draws."""
_POINTS = 101


@dataclass(frozen=True)
class LearnedTerm:
    """A smooth term that the misfit depends on: it says on what, and not why.

    effect: the curve. gain: on data that was not fitted; where that is parts of the recording left out, the noise of
    either model is widened to fit what was left out, if it looks too small. x (101,): the covariate, in its unit; y
    (101, 3): what the axes of the triad put out by it, SI; half_width (101, 3): of its 95 % band. state: the fit with
    the curve in it. statistic: by which χ² falls.
    """

    effect: Curve
    gain: Gain
    x: FloatArray
    y: FloatArray
    half_width: FloatArray
    state: State
    statistic: float

    @property
    def evidence(self) -> tuple[float, float, int]:
        """The p-value of its absence, its statistic and its degrees of freedom."""
        return float(chi2_sf(self.statistic, self.effect.size)), self.statistic, self.effect.size

    @property
    def of_recording(self) -> bool:
        """Whether it belongs to the recording, and makes errors left out smaller."""
        return self.effect.scope == "session" and self.gain.smaller([self.effect])

    @property
    def covariate(self) -> str:
        """What the misfit depends on, in words."""
        return self.effect.words

    @property
    def triad(self) -> str:
        """Whose output it is: the accelerometer's or the gyroscope's."""
        return self.effect.owner

    def document(self) -> Json:
        """Return the term as `diagnosis.json` has it."""
        kinds = {kind: (before, self.gain.after.rms[kind]) for kind, before in self.gain.before.rms.items()}
        output = getattr(self.state.imu, self.triad).output_unit
        return {
            "name": self.effect.acting().name,
            "covariate": self.covariate,
            "triad": self.triad,
            **self.effect.document(output),
            "improvement": {
                **self.gain.document(),
                "heldout_rms": [
                    {"residual": kind, "before": before, "after": after, "unit": unit}
                    for kind, ((before, unit), (after, _)) in kinds.items()
                ],
            },
            "curve": {
                "x": self.x.tolist(),
                "x_unit": self.effect.covariate_unit,
                "y": self.y.tolist(),
                "half_width": self.half_width.tolist(),
                "y_unit": "m/s^2" if self.triad == "accelerometer" else "rad/s",
            },
        }


@dataclass(frozen=True)
class PromisingCurve:
    """A curve that predicts what is left out better than a fit without it does; it is not fitted yet.

    state: that fit. effect: the dormant curve. spread (q,): what its coefficients are a priori. gain: on parts left
    out.
    """

    state: State
    effect: Curve
    spread: FloatArray
    gain: Gain


def promising(experiment: Experiment, state: State, of_recording: bool = False) -> PromisingCurve | None:
    """Return the smooth curve of one covariate, on one triad, that predicts best what was left out; None if none pays.

    **Arguments:** `state`: a fit that leaves something unexplained; `of_recording`: whether only curves over the time
    of a recording are asked.
    """
    for interleaved in (True,) if of_recording else (False, True):
        best = _best(experiment, state, interleaved)
        if best is not None and best.gain.log_likelihood > (0 if interleaved else _PAYS):
            return best
    return None


def learn(
    experiment: Experiment, candidate: PromisingCurve, held: Experiment | None = None, level: float = LEVEL
) -> LearnedTerm | None:
    """Return a curve as it is fitted; None where it does not pay after all.

    **Arguments:** `held`: another recording of the unit, on which the gain is measured (and must be one) where the
    curve belongs to the unit; `level`: of what a curve leaves.
    """
    effect, gain = candidate.effect, candidate.gain
    try:
        fitted = _fitted(experiment, candidate)
    except NotPossibleError:  # a curve that leads a fit to nothing explains nothing
        return None
    if held is not None and effect.scope == "device":
        gain = on_held_out(held, candidate.state, fitted)
        if gain.log_likelihood <= 0:
            return None
    before, after = (float(np.sum(fit.evidence.residual**2)) for fit in (candidate.state, fitted))
    term = _term(fitted, effect.name, gain, before - after)
    if candidate.gain.log_likelihood >= _PAYS:
        return term
    explained = [select(fit.evidence, level).explained for fit in (candidate.state, fitted)]
    return term if term.of_recording and explained == [False, True] else None


def drifts(
    experiment: Experiment, first: LearnedTerm, level: float = LEVEL
) -> tuple[tuple[LearnedTerm, ...], Extension | None]:
    """Return curves over time, each of a sensor in a recording, and the extension of a fit with them by causes.

    They are as many as leave nothing unexplained, or as pay. One that leaves something, and beside which nothing is
    found, is a shape and no drift: then there are no curves, and no extension.

    **Arguments:** `first`: the curve that explains most; `level`: of what all leave.
    """
    terms = [first]
    while terms[-1].of_recording:
        state = terms[-1].state
        selection = select(state.evidence, level)
        beside = _causes_beside(experiment, state, selection, level) if selection.complete else None
        if beside is None or not beside.complete:
            candidate = promising(experiment, state, of_recording=True)
            term = candidate and learn(experiment, candidate, None, level)
            if term is not None:
                terms.append(term)
                continue
            beside = beside or _causes_beside(experiment, state, selection, level)
        if not (beside.complete or beside.found or len(terms) > 1):
            break
        return tuple(_term(state, term.effect.name, term.gain, term.statistic) for term in terms), beside
    return (), None


def _causes_beside(experiment: Experiment, state: State, selection: Selection, level: float) -> Extension:
    """Return the causes beside curves: those that predict better, together, what is left out."""
    extension = extend(experiment, state, selection, level)
    worse = extension.found and left_out(experiment, state, extension.state, True).log_likelihood <= 0
    return Extension([], state, experiment, state, False, []) if worse or extension.findings else extension


def _best(experiment: Experiment, state: State, interleaved: bool) -> PromisingCurve | None:
    """Return the curve that predicts best what is left out.

    Where that is `interleaved`, only curves that belong to the recording are asked: all others are used beyond it.
    None where there is none, or one that is to be asked in the other way.
    """
    parts = {way: _Parts.of(experiment, way, state)[0] for way in {False, interleaved}}
    if not parts[interleaved].parts:
        return None

    def gain(columns: FloatArray, way: bool) -> Gain:
        left = parts[way]
        return Gain(left.plain, left.with_curve(columns), parts_left_out(len(left.parts), experiment.real, way))

    best: tuple[Curve, FloatArray, FloatArray, Gain] | None = None
    for effect, columns, root in curves(experiment, state):
        if interleaved and effect.scope != "session":
            continue
        for size in np.sqrt(_STRENGTHS / max(np.linalg.eigvalsh(columns.T @ columns)[-1], 1e-300)):
            gained = gain(size * columns, interleaved)
            if best is None or gained.log_likelihood > best[3].log_likelihood:
                best = effect, size * root, size * columns, gained
    if best is None or (best[0].scope == "session") != interleaved:
        return None
    effect, spread, columns, gained = best
    both = interleaved and parts[False].parts
    return PromisingCurve(state, effect, spread, replace(gained, otherwise=gain(columns, False) if both else None))


def left_out(experiment: Experiment, before: State, after: State, interleaved: bool = False) -> Gain:
    """Return what one fit gains over another where the experiment's parts are left out in turn.

    Only the numbers are fitted without a part; the effects, and their inner parameters, were chosen with all of it.
    """
    one, other = _Parts.of(experiment, interleaved, before, after)
    return Gain(one.plain, other.plain, parts_left_out(len(one.parts), experiment.real, interleaved))


def curves(experiment: Experiment, state: State) -> Iterator[tuple[Curve, FloatArray, FloatArray]]:
    """Return the smooth terms whose covariates are known along the path and change, dormant, with their columns.

    Columns (n, q) are whitened and those of coefficients that are a priori of variance one; the roots (q,) are these
    coefficients' unit.
    """
    warming, inside = experiment.extent().temperature_range, {effect.name for effect in state.effects}
    effects = []
    for kind in (one for whole in CATALOGUE.values() for one in experiment.by_recording(whole)):
        if not issubclass(kind, Curve) or kind.owner not in state.imu.triads() or kind.name in inside:
            continue
        if experiment.lacking(kind, state.linear):
            continue
        still = "temperature" in kind.needs[0] and warming < LEAST_WARMING
        effect = None if still else _spanned(experiment, kind, state)
        effects += [] if effect is None else [effect]
    grids = {type(effect): [{name: float(getattr(effect, name)) for name in effect.inner}] for effect in effects}
    columns = experiment.dormant_columns(state.imu, state.linear.details, grids)
    for effect in effects:
        root = np.tile(1 / np.sqrt(effect.roughness()), 3)
        yield effect, state.weights @ (columns[type(effect)][0] * root)[experiment.used], root


def _spanned(experiment: Experiment, kind: type[Curve], state: State) -> Curve | None:
    """Return the dormant curve over what its covariate was in what is compared; None where it stood still."""
    name = kind.owner
    typical = {name: parameter.typical for name, parameter in kind.inner.items()}
    values = []
    tracks = experiment.data.tracks(state.linear.details)
    chosen = tracks[kind.recording - 1 : kind.recording] if kind.recording else tracks
    for track in (part[name] for part in chosen):
        rows = track.inside()
        if name == "accelerometer":  # which is compared at rest alone
            rows &= np.asarray(track.observation) < np.max(track.observation)
        true = jax.tree.map(lambda leaf, rows=rows: np.asarray(leaf)[rows], track.stimulus)
        true = replace(true, time_reference=state.imu.triads()[name].time_reference)
        values.append(np.asarray(kind(np.zeros(kind.size), **typical).covariate(true)))
    low, high = min(float(part.min()) for part in values), max(float(part.max()) for part in values)
    if high - low <= 1e-6 * max(abs(low), abs(high)):
        return None
    effect = kind.dormant(**kind.spanning(low, high))
    assert isinstance(effect, Curve)
    return effect


@dataclass(frozen=True)
class _Parts:
    """Parts of a recording left out in turn, about a fit: whatever does not depend on a curve, computed once.

    basis: orthonormal, of the fit's columns; target: its whitened conditions; both with what is known beforehand.
    parts: rows left out together as the rest predicts them, and which of them count.
    """

    experiment: Experiment
    state: State
    basis: FloatArray
    target: FloatArray
    parts: list[tuple[LeftOut, BoolArray]]

    @classmethod
    def of(cls, experiment: Experiment, interleaved: bool, *states: State) -> list[_Parts]:
        """Return the parts that all fits predict from the others: the rest are no comparison."""
        folds = experiment.folds(_PARTS, interleaved)
        problems = [state.informed for state in states]
        fits = [
            list(leave_out(state.weights, *problem, [rows for rows, _ in folds]))
            for state, problem in zip(states, problems, strict=True)
        ]
        predicted = [k for k in range(len(folds)) if not any(parts[k].blind for parts in fits)]
        return [
            cls(experiment, state, orthonormal(columns), target, [(parts[k], folds[k][1]) for k in predicted])
            for state, (columns, target), parts in zip(states, problems, fits, strict=True)
        ]

    @cached_property
    def plain(self) -> Prediction:
        """The parts as the fit predicts them."""
        return self.with_curve(np.zeros((len(self.state.weights), 0)))

    def with_curve(self, columns: FloatArray) -> Prediction:
        """Predict the parts beside columns (n, q) of numbers that are a priori of variance one."""
        squared, count, volume = 0.0, 0, 0.0
        pull, step = further(self.state.weights, self.basis, self.target, columns)
        errors = np.zeros(len(columns))
        for part, scored in self.parts:
            error, covariance = part.beside(pull[part.rows], step)
            root = np.linalg.cholesky(submatrix(covariance, scored))
            errors[part.rows[scored]] = error[scored]
            squared += float(np.sum(solve_triangular(root, error[scored], lower=True) ** 2))
            count += len(root)
            volume += float(np.sum(np.log(np.diag(root))))
        # noise that looks too small is widened, or any term that makes predictions uncertain would pay
        unit = max(1.0, squared / max(count, 1))
        likelihood = -0.5 * (count * np.log(2 * np.pi * unit) + squared / unit) - volume
        return Prediction(self.experiment.real.rms(errors), squared / unit, count, likelihood)


def _fitted(experiment: Experiment, candidate: PromisingCurve) -> State:
    """Fit all parameters and the curve, with what is known of its coefficients beforehand."""
    state, effect = candidate.state, candidate.effect
    effects = (*state.effects, effect)
    owned = state.imu.with_effects(*effects).all_effects()
    ((owner, index),) = (key for key, fitted in owned.items() if fitted.name == effect.name)
    names = tuple(Name(owner, "coefficients", (k,), index) for k in range(effect.size))
    prior = Prior(names, np.zeros(effect.size), np.diag(1 / candidate.spread))
    return experiment.fit(effects, state.imu, Prior.joined(state.prior, prior))


def _term(state: State, name: str, gain: Gain, statistic: float) -> LearnedTerm:
    """Return the curve of this name as it is fitted."""
    effect = next(effect for effect in state.effects if effect.name == name)
    assert isinstance(effect, Curve)
    scale = state.imu.triads()[effect.owner].scales
    low, high = map(float, effect.interval())
    x = np.linspace(low, high, _POINTS)
    shapes = np.asarray(effect.shapes(x))
    places = state.places(effect.name)
    known = submatrix(state.covariance, places)
    count = shapes.shape[1]
    y = shapes @ np.asarray(effect.coefficients).reshape(3, count).T / scale
    blocks = [known[a : a + count, a : a + count] for a in range(0, 3 * count, count)]
    sigma = np.sqrt(np.stack([np.einsum("xk,kl,xl->x", shapes, block, shapes) for block in blocks], axis=1))
    return LearnedTerm(effect, gain, x, y, Z95 * sigma / scale, state, statistic)
