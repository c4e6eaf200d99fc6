"""What an extended model gains on data that it was not fitted to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from jaximu.diagnosis.evidence import Evidence
from jaximu.diagnosis.experiment import Experiment, State
from jaximu.diagnosis.selection import select

__all__ = ["Gain", "Prediction", "cross_validated", "on_held_out"]

FloatArray = NDArray[np.float64]
_REPEATABILITY = 0.05
"""Spread (rad/s) that the gyroscope's bias is allowed from one power-on to the next: as good as free."""
_FOLDS = 5


@dataclass(frozen=True)
class Prediction:
    """How a model met data that it had not seen.

    rms by kind of residual, with its unit. chi_squared and count: of the conditions against their predicted covariance,
    the parameters' uncertainty included. log_likelihood: of them, nats.
    """

    rms: dict[str, tuple[float, str]]
    chi_squared: float
    count: int
    log_likelihood: float


@dataclass(frozen=True)
class Gain:
    """The base model's and the extended model's predictions, and what they were made of."""

    before: Prediction
    after: Prediction
    data: str

    @property
    def log_likelihood(self) -> float:
        """What the extension gains, nats."""
        return self.after.log_likelihood - self.before.log_likelihood

    def best_unit(self, name: str) -> str:
        """Return the kind of residual that an effect of this name improves most."""
        first, *others = self.before.rms  # the accelerometer's comes first
        kinds = [first] if name.startswith("accel.") or not others else others
        return max(kinds, key=lambda kind: self.before.rms[kind][0] / max(self.after.rms[kind][0], 1e-300))


def on_held_out(held: Experiment, before: State, after: State) -> Gain:
    """Predict another recording of the unit with both models.

    Effects of a session stay with the session. The gyroscope's bias may be another after every power-on: what is left
    of it at rest is taken off in both.
    """
    return Gain(_predict(held, before), _predict(held, after), "another recording")


def _predict(held: Experiment, state: State) -> Prediction:
    effects = tuple(effect for effect in state.effects if effect.scope == "device")
    conditions, columns, covariance, names = held.predict(state.imu, effects)
    places = [state.names.index(name) for name in names]
    spread = np.array(state.covariance[np.ix_(places, places)])
    for axis in range(3):
        spread[names.index(f"gyroscope.bias[{axis}]"), names.index(f"gyroscope.bias[{axis}]")] += _REPEATABILITY**2
    whole = covariance + columns @ spread @ columns.T
    chi_squared, likelihood = _likelihood(conditions, whole)
    return Prediction(held.summary(conditions), chi_squared, len(conditions), likelihood)


def _likelihood(conditions: FloatArray, covariance: FloatArray) -> tuple[float, float]:
    """Return χ² and the log-likelihood."""
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, conditions)
    chi_squared = float(white @ white)
    likelihood = -0.5 * (chi_squared + len(white) * np.log(2 * np.pi)) - float(np.sum(np.log(np.diag(root))))
    return chi_squared, likelihood


def cross_validated(experiment: Experiment, base: State) -> Gain:
    """Leave out every fifth of the recording in turn, select and fit on the rest, and predict what was left out.

    The whole selection is repeated inside every fold, so a term that was chosen for its luck has none here. All is
    linear about the base fit. Conditions that touch a pose left out are left out with it.
    """
    root = np.linalg.inv(base.weights)
    covariance = root @ root.T
    evidence = base.evidence
    jacobian = root @ evidence.jacobian
    raw = [root @ block.columns for block in evidence.blocks]
    touched = experiment.touched  # (n, 2): the observations that a condition involves
    count_out = 0
    count = int(touched.max()) + 1
    errors = {key: np.zeros(len(touched)) for key in ("before", "after")}
    squared, likelihood = {"before": 0.0, "after": 0.0}, {"before": 0.0, "after": 0.0}
    for fold in np.array_split(np.arange(count), _FOLDS):
        left_out = np.isin(touched, fold).any(axis=1)
        kept = ~left_out
        if not left_out.any() or kept.sum() <= jacobian.shape[1]:
            continue
        weights = np.linalg.inv(np.linalg.cholesky(covariance[np.ix_(kept, kept)]))
        blocks = [
            replace(block, columns=weights @ each[kept]) for block, each in zip(evidence.blocks, raw, strict=True)
        ]
        inside = Evidence(weights @ base.conditions[kept], weights @ jacobian[kept], blocks)
        count_out += int(left_out.sum())
        chosen = [cause.block for cause in select(inside).causes]
        for key, picked in (("before", []), ("after", chosen)):
            columns = np.concatenate([jacobian, *(-raw[k] for k in picked)], axis=1)
            training = weights @ columns[kept]
            step = -np.linalg.lstsq(training, weights @ base.conditions[kept], rcond=1e-10)[0]
            spread = np.linalg.pinv(training.T @ training, rcond=1e-12, hermitian=True)
            error = base.conditions[left_out] + columns[left_out] @ step
            whole = covariance[np.ix_(left_out, left_out)] + columns[left_out] @ spread @ columns[left_out].T
            part_squared, part_likelihood = _likelihood(error, whole)
            # a turn between two folds is left out twice; its later error is kept
            errors[key][left_out] = error
            squared[key] += part_squared
            likelihood[key] += part_likelihood
    found = {
        key: Prediction(experiment.summary(errors[key]), squared[key], count_out, likelihood[key]) for key in errors
    }
    return Gain(found["before"], found["after"], f"{_FOLDS} parts left out in turn")
