"""What an extended model gains on data that it was not fitted to."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space

from jaximu.diagnosis.evidence import Evidence
from jaximu.diagnosis.experiment import Experiment, State
from jaximu.diagnosis.selection import select
from jaximu.estimation.leave_out import LeftOut, leave_out
from jaximu.estimation.problem import Name
from jaximu.estimation.rows import Rows, Sizes
from jaximu.estimation.uncertainty import describe
from jaximu.ground.array_types import BoolArray, FloatArray, IntArray
from jaximu.ground.document import Json
from jaximu.ground.quantities import change
from jaximu.ground.vectors import root_or_zero, submatrix
from jaximu.model.effects import Effect
from jaximu.model.sensor import Imu
from jaximu.recordings.observations import POWER_ON

_FOLDS = 5
_SIMILAR = 10.0
"""Difference of χ² up to which another inner parameter counts in a prediction: beyond, its weight is below 0.7 %."""


@dataclass(frozen=True)
class Prediction:
    """How a model met data that it had not seen.

    rms by kind of residual, with its unit. chi_squared and count: of the conditions against their predicted covariance,
    the parameters' uncertainty included. log_likelihood: of them, nats.
    """

    rms: Sizes
    chi_squared: float
    count: int
    log_likelihood: float


@dataclass(frozen=True)
class Gain:
    """The base model's and the extended model's predictions, and what they were made of.

    otherwise: the same with parts of the recording left out in another way.
    """

    before: Prediction
    after: Prediction
    data: str
    otherwise: Gain | None = None

    @property
    def log_likelihood(self) -> float:
        """What the extension gains, nats."""
        return self.after.log_likelihood - self.before.log_likelihood

    def document(self) -> Json:
        """Return the likelihoods as `diagnosis.json` has them."""
        return {
            "heldout_loglik": self.log_likelihood,
            "heldout_chi_squared_before": self.before.chi_squared / self.before.count,
            "heldout_chi_squared_after": self.after.chi_squared / self.after.count,
            "data": self.data,
            "otherwise": None if self.otherwise is None else self.otherwise.document(),
        }

    def smaller(self, effects: Sequence[Effect]) -> bool:
        """Return whether some error of what was left out is smaller with the extension."""
        kind = self.best_kind(*effects)
        return self.after.rms[kind][0] < self.before.rms[kind][0]

    def errors(self, kind: str) -> str:
        """Return the rms errors of a kind of residual without and with the extension, as a person reads them."""
        return change(self.before.rms[kind][0], *self.after.rms[kind])

    def best_kind(self, *effects: Effect) -> str:
        """Return the kind of residual that effects improve most, among those of their sensors."""
        first, *others = self.before.rms  # the accelerometer's comes first
        by_owner = {"accelerometer": [first], "gyroscope": others}
        kinds = [kind for effect in effects for kind in by_owner.get(effect.owner) or [first, *others]]
        return max(kinds, key=lambda kind: self.before.rms[kind][0] / max(self.after.rms[kind][0], 1e-300))


def on_held_out(held: Experiment, before: State, after: State) -> Gain:
    """Predict another recording of the unit with both models.

    Effects of a session stay with the session. Biases may be others after every power-on (`POWER_ON`): the gyroscope's
    is taken anew at rest in both.
    """
    return Gain(_predict(held, before), _predict(held, after), "another recording")


def _predict(held: Experiment, state: State) -> Prediction:
    effects = tuple(effect for effect in state.effects if effect.scope == "device")
    imu = _rested(held, state.imu.with_effects(*effects))
    conditions, columns, covariance, names = held.predict(imu)
    labels = [describe(name, state.model) for name in state.names]
    places = [labels.index(describe(name, imu)) for name in names]
    spread = np.array(submatrix(state.covariance, places))
    for name, size in POWER_ON.items():
        if bias := _biases(names, name):
            spread[bias, bias] += (size * imu.triads()[name].scales) ** 2
    chi_squared, likelihood = _beside_open(conditions, covariance, columns, spread)
    return Prediction(held.real.rms(conditions), chi_squared, len(conditions), likelihood)


def _biases(names: Sequence[Name], triad: str) -> list[int]:
    """Return the places of a triad's bias."""
    return [index for index, name in enumerate(names) if (name.owner, name.part) == (triad, "bias")]


def _rested(held: Experiment, imu: Imu) -> Imu:
    """Return the unit with the gyroscope bias that the recording has at rest; turns are not linear in one far off."""
    conditions, columns, _, names = held.predict(imu)
    rest = held.real.of_kind("static_gyroscope")
    slope = columns[rest][:, _biases(names, "gyroscope")]
    gyroscope = imu.gyroscope
    assert gyroscope is not None
    bias = np.asarray(gyroscope.bias) - np.linalg.lstsq(slope, conditions[rest], rcond=None)[0]
    return replace(imu, gyroscope=replace(gyroscope, bias=bias))


def _beside_open(
    conditions: FloatArray, covariance: FloatArray, columns: FloatArray, spread: FloatArray
) -> tuple[float, float]:
    """Return χ² and the log-likelihood where numbers of covariance `spread` (p, p) move the conditions by `columns`.

    What a fit leaves open is so large that the noise would be lost in the sum of both.
    """
    values, vectors = np.linalg.eigh(spread)
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, conditions)
    moved, sizes, _ = np.linalg.svd(
        np.linalg.solve(root, columns @ (vectors * root_or_zero(values))), full_matrices=False
    )
    along = moved.T @ white
    chi_squared = float(np.sum((white - moved @ along) ** 2) + np.sum(along**2 / (1 + sizes**2)))
    volume = float(np.sum(np.log(np.diag(root))) + 0.5 * np.sum(np.log1p(sizes**2)))
    likelihood = -0.5 * (chi_squared + len(white) * np.log(2 * np.pi)) - volume
    return chi_squared, likelihood


def cross_validated(experiment: Experiment, base: State, extended: State | None = None) -> Gain:
    """Leave out a fifth of the recording at a time, select and fit on the rest, and predict what was left out.

    A fifth is one stretch of it: what belongs to a unit holds beyond what it was fitted to. Effects of the `extended`
    fit that belong to the recording are only ever used within it: of these it is every fifth pose. The other way stands
    beside it, or for it where that leaves too little to predict anything from.
    """
    if extended is None:
        return _by_parts(experiment, base, interleaved=False)
    within = all(effect.scope == "session" for effect in extended.effects)
    gains = [_by_parts(experiment, base, interleaved) for interleaved in (within, not within)]
    gain, *others = [gain for gain in gains if gain.before.count] or gains[:1]
    return replace(gain, otherwise=others[0] if others else None)


def _by_parts(experiment: Experiment, base: State, interleaved: bool) -> Gain:
    """Return the gain on parts left out in turn, one stretch each or `interleaved`.

    The whole selection is repeated inside every fold, so a term that was chosen for its luck has none here. All is
    linear about the base fit. Conditions that touch a pose left out are left out with it, and predicted from all
    others, slow bias that they share included (`jaximu.estimation.leave_out`). Where several inner parameters fit the
    rest about as well, the prediction is their average, and its covariance counts their spread. What the rest does not
    determine, for it holds too few poses, is not predicted and does not count.
    """
    evidence = base.evidence
    real = experiment.real
    count_out, errors, sums = 0, np.zeros((2, len(real))), np.zeros((2, 2))  # before and after: χ² and log-likelihood
    for rows, scored in experiment.folds(_FOLDS, interleaved):
        if len(real) - len(rows) <= evidence.jacobian.shape[1]:
            continue
        models = [(1.0, ())], _models(evidence.without(base.weights[:, rows]))
        parts = [[(share, _left_out(base, blocks, rows, scored)) for share, blocks in options] for options in models]
        blind = [null_space(part.directions.T) for options in parts for _, part in options if part.blind]
        determined = null_space(np.concatenate(blind, axis=1).T, rcond=1e-6) if blind else np.eye(int(scored.sum()))
        count_out += determined.shape[1]
        for after, options in enumerate(parts):
            estimate = np.sum([share * part.errors for share, part in options], axis=0)
            spread = sum(
                share * (part.covariance + np.outer(part.errors - estimate, part.errors - estimate))
                for share, part in options
            )
            shown = determined.T @ estimate
            sums[after] += _beside_open(
                shown, determined.T @ np.asarray(spread) @ determined, np.zeros((len(shown), 0)), np.eye(0)
            )
            errors[after, rows[scored]] = determined @ shown
    before, after = (
        Prediction(real.rms(error), float(squared), count_out, float(likelihood))
        for error, (squared, likelihood) in zip(errors, sums, strict=True)
    )
    return Gain(before, after, parts_left_out(_FOLDS, real, interleaved))


def parts_left_out(count: int, real: Rows, interleaved: bool) -> str:
    """Say what a gain was measured on."""
    return f"every {count}th {real.observation} left out in turn" if interleaved else f"{count} parts left out in turn"


def _models(evidence: Evidence) -> list[tuple[float, tuple[int, ...]]]:
    """Return what is selected, at all inner parameters that fit about as well: their weights, and the blocks.

    Between observations that are left out, a step may stand anywhere.
    """
    causes = [cause.block for cause in select(evidence).causes]
    options = []
    for cause in causes:
        statistic = evidence.scores([k for k in causes if k != cause]).statistic
        name = evidence.blocks[cause].name
        options.append(
            [
                (float(np.exp((statistic[k] - statistic[cause]) / 2)), k)
                for k, block in enumerate(evidence.blocks)
                if block.name == name and statistic[k] > statistic[cause] - _SIMILAR
            ]
        )
    models = [
        (float(np.prod([w for w, _ in combination])), tuple(k for _, k in combination))
        for combination in itertools.product(*options)
    ]
    total = sum(weight for weight, _ in models)
    return [(weight / total, blocks) for weight, blocks in models]


def _left_out(base: State, blocks: Sequence[int], rows: IntArray, scored: BoolArray) -> LeftOut:
    """Predict those `scored` (m,) of conditions left out, by place (m,), with blocks in the model."""
    evidence = base.evidence
    columns = np.concatenate([evidence.jacobian, *(evidence.blocks[k].columns for k in blocks)], axis=1)
    (part,) = leave_out(base.weights, columns, evidence.residual, [rows])
    return part.only(scored)
