"""The linear problems of a check: what an old calibration predicts of a recording, and a fresh one about it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import numpy as np

from jaximu.calibration import Calibration
from jaximu.diagnosis.evidence import EffectBlock, Evidence
from jaximu.diagnosis.experiment import Experiment
from jaximu.estimation.data import About, Data
from jaximu.estimation.fitting import Prior, effect_numbers, fit
from jaximu.estimation.problem import TOLERANCE, Name, Parameters, flatten, without_equipment
from jaximu.estimation.uncertainty import label
from jaximu.ground.array_types import BoolArray, FloatArray
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.gravity import LocalGravity
from jaximu.ground.vectors import sigmas_of, submatrix
from jaximu.model.effects import CATALOGUE
from jaximu.model.sensor import Imu

_COMPARABLE = 0.1
"""Uncertainty, in typical sizes (10 % of a scale, 1 m/s²), beyond which a recording tells nothing of a parameter."""
_FREE = 100.0
"""Typical sizes that the coefficients of a cause may have: as good as free."""
_PASSES = 8
"""Of a fresh calibration, which starts close by: what creeps after them is what the recording does not tell."""


@dataclass(frozen=True)
class Old:
    """The old calibration as an experiment names it: numbers (p,), their covariance (p, p) and typical sizes (p,).

    imu: the unit with its effects, from which a fresh fit starts; start (p,): its numbers, which are `values` but for
    the gyroscope's bias. scales: output units per SI of the axis each number belongs to. units: each number's own.
    gravity: how the numbers react to an error of gravity (per m/s²). shared, own: one sigma of the error that is the
    old recording's and the new one's alike, and of the new one's own; one of them is zero.
    """

    imu: Imu
    names: tuple[Name, ...]
    values: FloatArray
    start: FloatArray
    covariance: FloatArray
    sizes: FloatArray
    scales: FloatArray
    units: tuple[str, ...]
    gravity: FloatArray
    shared: float
    own: float

    @classmethod
    def of(cls, calibration: Calibration, local: LocalGravity, free: Callable[[Name], bool] = without_equipment) -> Old:
        """Return a calibration without what was its recording's or its set-up's, and without gravity's common error.

        `free`: which numbers of gain and bias the data tell. Raises `NotPossibleError` where the calibration lacks one.
        """
        imu = jax.tree.map(np.asarray, calibration.imu.transferable())
        triads, effects, bare = imu.triads(), imu.all_effects(), imu.with_effects()
        parameters = Parameters.select(bare, free)
        effect_names, numbers, _ = effect_numbers(imu)
        names = (*parameters.names, *effect_names)
        values = np.concatenate([flatten(bare)[list(parameters.index)], numbers])
        # what the calibration lost of its effects has moved the others: they are found by what they are shown as
        places = {label(name, calibration.imu): index for index, name in enumerate(calibration.names)}
        known = [places.get(label(name, imu)) for name in names]
        there, columns = [k for k, index in enumerate(known) if index is not None], [k for k in known if k is not None]
        if calibration.names and None in known[: len(parameters.names)]:
            raise NotPossibleError(
                "the calibration's axes are the accelerometer's, and these data's are a set-up's, in which the unit "
                "may sit turned. Check a calibration that was made in the set-up."
            )
        covariance = np.zeros((len(names), len(names)))
        covariance[np.ix_(there, there)] = submatrix(calibration.covariance, columns)
        of_effects = 10 * np.maximum(np.maximum(np.abs(values), sigmas_of(covariance)), 1e-12)
        sizes = np.concatenate([np.asarray(parameters.size), of_effects[len(parameters.names) :]])
        scales, units = np.ones(len(names)), []
        for k, name in enumerate(names):
            unit = triads[name.owner].output_unit
            if name.effect is None:
                scales[k] = np.linalg.norm(triads[name.owner].gain[name.axes[0]])
                si = "(m/s^2)" if name.owner == "accelerometer" else "(rad/s)"
                units.append(unit if name.part == "bias" else f"{f'({unit})' if '/' in unit else unit}/{si}")
            else:
                effect = effects[name.owner, name.effect]
                plain = name.part == "coefficients"
                units.append(effect.coefficient_unit(unit) if plain else effect.inner[name.part].unit)
        # Gravity g too large makes the accelerometer's gain K too small: dK/dg = −K/g.
        scaled = np.array([name.owner == "accelerometer" and name.part == "gain" for name in names])
        gravity = np.where(scaled, -values / local.value, 0.0)
        shared, apart = (local.sigma, 0.0) if calibration.gravity == local else (0.0, local.sigma)
        covariance = _without(covariance, gravity, shared)
        return cls(imu, names, values, values, covariance, sizes, scales, tuple(units), gravity, shared, apart)

    @property
    def allowed(self) -> list[int]:
        """Places of the gyroscope's bias, another after every power-on."""
        return [k for k, name in enumerate(self.names) if name.owner == "gyroscope" and name.part == "bias"]

    @property
    def tested(self) -> list[int]:
        """Places of all other parameters."""
        return sorted({*range(len(self.names))} - {*self.allowed})

    def places(self, owner: str, *parts: str) -> list[int]:
        """Return the places of a triad's gain, bias or both, without what is allowed to change."""
        return [k for k in self.tested if self.names[k].owner == owner and self.names[k].part in parts]

    def rested(self, bias: FloatArray | None) -> Old:
        """Return the calibration with the gyroscope's bias (3,) of the start as it is at rest in new data, if known.

        Turns under a bias that is off by degrees a second are not linear in it.
        """
        if bias is None:
            return self
        start = np.array(self.values)
        start[self.allowed] = bias
        return replace(self, imu=eqx.tree_at(lambda imu: imu.gyroscope.bias, self.imu, bias), start=start)


def _without(covariance: FloatArray, slope: FloatArray, sigma: float) -> FloatArray:
    """Return the covariance less what an uncertain gravity added, no more than it holds."""
    inverse = np.linalg.pinv(covariance, rcond=1e-13, hermitian=True)
    most = 1 / max(float(slope @ inverse @ slope), 1e-300)
    return covariance - min(sigma**2, most) * slope[:, None] * slope


@dataclass(frozen=True)
class FollowedUnit:
    """What a recording without poses says of a unit, as a filter in use has it: conditions (n,), linear in its numbers.

    They are white, of variance one, at the old calibration; columns (n, p): their derivatives by its numbers.
    """

    conditions: FloatArray
    columns: FloatArray

    def predict(self, scatter: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the conditions, their columns and covariance, as wide as they scatter."""
        return self.conditions, self.columns, scatter**2 * np.eye(len(self.conditions))


class Widened(Data):
    """A recording by hand whose noise is wider by factors `scatter` (kinds,), with causes of unknown size in it.

    causes (n, q): what they add to the real conditions at sizes that they may have (one sigma). Their sizes are free
    numbers that are solved for at once with all others; as nobody asks for them, they stand in the covariance.
    """

    def __init__(self, experiment: Experiment, scatter: FloatArray, causes: Sequence[FloatArray] = ()):
        self.experiment, self.used = experiment, experiment.used
        self.excess_names, self.coarse = experiment.excess_names, experiment.coarse
        self.wide = scatter[experiment.real.kind]
        self.causes = np.concatenate([np.zeros((len(self.wide), 0)), *causes], axis=1)

    def widen(self, covariance: FloatArray) -> FloatArray:
        """Return the covariance (n, n) of the real conditions, causes included."""
        return covariance * self.wide[:, None] * self.wide + self.causes @ self.causes.T

    def about(self, imu: Imu) -> About:
        """Return the recording about the unit."""
        evaluated, real = self.experiment.about(imu), np.ix_(self.used, self.used)
        covariance = jax.tree.map(lambda leaf: leaf[0], evaluated.covariance).dense()
        measured = np.array(covariance.measured)
        measured[real] = self.widen(measured[real])
        covariance = replace(covariance, measured=measured)
        return replace(evaluated, covariance=jax.tree.map(lambda leaf: leaf[None], covariance))

    def predict(self, imu: Imu) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the conditions (n,) of a unit with its effects, their columns (n, p) and covariance (n, n)."""
        conditions, columns, covariance, _ = self.experiment.predict(imu)
        return conditions, columns, self.widen(covariance)


@dataclass(frozen=True)
class Fresh:
    """A fresh calibration about the old one, however few the poses: new − old (p,), the new one's covariance (p, p).

    A parameter is known beforehand to some typical sizes, so what the recording does not tell stays where it was, with
    an uncertainty that says so. conditions (n,): under it, less the causes given, with their covariance `left` (n, n)
    after the fit.
    """

    imu: Imu
    difference: FloatArray
    covariance: FloatArray
    covariance_of_difference: FloatArray
    conditions: FloatArray
    left: FloatArray
    converged: bool

    @classmethod
    def fit(
        cls,
        old: Old,
        experiment: Experiment,
        scatter: FloatArray,
        causes: Sequence[FloatArray] = (),
        begin: Imu | None = None,
    ) -> Fresh:
        """Fit all parameters, known beforehand about the old ones, in a recording with `causes`; begin at a unit."""
        measurement = Widened(experiment, scatter, causes)
        prior = Prior(old.names, old.start, np.diag(1 / (TOLERANCE * old.sizes)))
        fitted = fit(
            old.imu if begin is None else begin,
            measurement,
            experiment.free,
            prior=prior,
            excess=np.zeros(len(measurement.coarse)),
            estimate_excess=False,
            max_passes=_PASSES,
        )
        imu, spread = jax.tree.map(np.asarray, fitted.imu), np.asarray(fitted.covariance)
        conditions, columns, covariance = measurement.predict(imu)
        # the share that is no cause's, of the conditions and of their covariance
        share = np.eye(len(conditions)) - measurement.causes @ np.linalg.solve(covariance, measurement.causes).T
        left = share @ (covariance - columns @ spread @ columns.T) @ share.T
        new = spread + old.own**2 * old.gravity[:, None] * old.gravity
        difference = np.asarray(fitted.values) - old.values
        return cls(imu, difference, new, new + old.covariance, share @ conditions, left, bool(fitted.converged))

    @classmethod
    def of_linear(cls, old: Old, followed: FollowedUnit, scatter: float) -> Fresh:
        """Solve for all parameters at once, which linear conditions allow; their noise is wider by `scatter`."""
        slope, right = followed.columns / scatter, followed.conditions / scatter
        scaled = slope * old.sizes
        inverse = np.linalg.inv(scaled.T @ scaled + np.eye(len(old.sizes)) / TOLERANCE**2)
        covariance = inverse * np.outer(old.sizes, old.sizes)
        difference = -covariance @ slope.T @ right
        new = covariance + old.own**2 * old.gravity[:, None] * old.gravity
        left = np.eye(len(right)) - slope @ covariance @ slope.T
        return cls(old.imu, difference, new, new + old.covariance, right + slope @ difference, left, True)

    def known(self, old: Old) -> BoolArray:
        """Which parameters (p,) the recording tells at all."""
        return sigmas_of(self.covariance) < _COMPARABLE * old.sizes


def scatter_about_a_fit(old: Old, experiment: Experiment, fresh: Fresh) -> FloatArray:
    """Return factors (kinds,), one at least, by which each kind of condition scatters about a fresh calibration.

    `fresh`: the calibration with factors of one.
    """
    scatter = np.ones(len(experiment.real.kinds))
    for number in range(4):
        fresh = fresh if number == 0 else Fresh.fit(old, experiment, scatter, begin=fresh.imu)
        for kind in np.unique(experiment.real.kind):
            rows = experiment.real.kind == kind
            values, vectors = np.linalg.eigh(submatrix(fresh.left, rows))
            keep = values > 1e-6 * values[-1]
            along = vectors[:, keep].T @ fresh.conditions[rows] / np.sqrt(values[keep])
            scatter[kind] = max(1.0, scatter[kind] * np.sqrt(float(along @ along) / keep.sum()))
    return scatter


@dataclass(frozen=True)
class Explanation:
    """What may explain that a prediction fails, its columns (n, q) not whitened.

    scope: as in `Cause`. places: of the parameters that would have moved.
    """

    block: EffectBlock
    scope: str
    places: tuple[int, ...] = ()

    @property
    def columns(self) -> FloatArray:
        """Its columns at sizes that it may have (one sigma): as good as anything, but for gravity."""
        return self.block.columns * (1.0 if self.scope == "fixture" else _FREE)


def candidates(old: Old, experiment: Experiment) -> list[Explanation]:
    """Return what else a diagnosis asks the recording for: effects, shapes without a cause, poses that were bumped."""
    state = experiment.fit(tuple(old.imu.all_effects().values()), old.imu.with_effects())
    root = np.linalg.inv(state.weights)
    return [
        Explanation(
            replace(block, columns=root @ block.columns),
            CATALOGUE[block.name].scope if block.kind == "effect" else block.kind,
        )
        for block in state.evidence.blocks
    ]


@dataclass(frozen=True)
class Question:
    """The old calibration's prediction, whitened with its own uncertainty, and everything that may explain its error.

    The base is the gyroscope's bias alone. candidates: those of the evidence's blocks, in their order.
    """

    evidence: Evidence
    candidates: tuple[Explanation, ...]

    @classmethod
    def ask(
        cls,
        old: Old,
        predicted: tuple[FloatArray, FloatArray, FloatArray],
        others: Sequence[Explanation] = (),
    ) -> Question:
        """Gather what may explain a prediction's error: parameters, another gravity, and `others`.

        **Arguments:** `predicted`: conditions (n,), columns (n, p) and covariance (n, n), as `Widened.predict` returns
        them.
        """
        conditions, columns, whole = predicted
        tested = old.tested
        whole = whole + columns[:, tested] @ submatrix(old.covariance, tested) @ columns[:, tested].T
        by_gravity = columns @ old.gravity
        whole += old.own**2 * by_gravity[:, None] * by_gravity
        weights = np.linalg.inv(np.linalg.cholesky(whole))
        bias = columns[:, old.allowed]

        def evidence(of: Sequence[Explanation]) -> Evidence:
            blocks = [replace(explanation.block, columns=weights @ explanation.block.columns) for explanation in of]
            return Evidence(weights @ conditions, weights @ bias, blocks)

        explanations = [
            Explanation(
                EffectBlock(name, -columns[:, places] * old.sizes[places], old.sizes[places]),
                "parameter",
                tuple(places),
            )
            for name, places in _groups(old)
        ]
        if old.shared > 0:  # unless the place was another one
            sigma = np.sqrt(2) * old.shared  # between two places
            gravity = Explanation(
                EffectBlock("setup.gravity", sigma * by_gravity[:, None], np.full(1, sigma)), "fixture"
            )
            if abs(evidence([gravity]).coefficients([0])[0]) < 3:
                explanations.append(gravity)
        explanations += others
        return cls(evidence(explanations), tuple(explanations))


def _groups(old: Old) -> list[tuple[str, list[int]]]:
    """Parameters that may have moved by themselves or together: single ones, each triad's, all."""
    return [
        *((label(old.names[k], old.imu), [k]) for k in old.tested),
        ("accelerometer.bias", old.places("accelerometer", "bias")),
        ("accelerometer.gain", old.places("accelerometer", "gain")),
        ("gyroscope.gain", old.places("gyroscope", "gain")),
        ("accelerometer", old.places("accelerometer", "gain", "bias")),
        ("accelerometer and gyroscope", old.tested),
    ]
