"""Act one: what the fitted model's twin gets right and wrong, each with a statistic, its p-value and a sentence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.stats
from numpy.typing import NDArray

from jaximu.diagnosis.hand_held import HandHeld, State

__all__ = ["Check", "checks_of"]

FloatArray = NDArray[np.float64]
_GROUPS = (
    ("gravity norm at rest", "the magnitude of the specific force in the poses"),
    ("gravity direction over turns", "the direction of gravity carried over the turns"),
    ("rate at rest", "the gyroscope's mean output in the poses"),
)


@dataclass(frozen=True)
class Check:
    """One comparison of the recording with what model and noise predict: χ² per degree of freedom, or as named."""

    name: str
    statistic: float
    p_value: float
    text: str

    def document(self) -> dict[str, Any]:
        """Return the check as `diagnosis.json` has it."""
        return {"name": self.name, "statistic": self.statistic, "p_value": self.p_value, "text": self.text}


def checks_of(state: State, experiment: HandHeld) -> tuple[Check, ...]:
    """Return all checks of a fit: by kind of residual, by what it may depend on, distribution, odd against even."""
    found = [*_by_kind(state, experiment.kinds)]
    scores = state.evidence.scores()
    for k, block in enumerate(state.evidence.blocks):
        if block.kind == "generic" and scores.freedom[k]:
            ratio, p_value = float(scores.statistic[k] / scores.freedom[k]), float(scores.p_value[k])
            text = f"{block.name}: χ²/dof {ratio:.2f} with {scores.freedom[k]} degrees of freedom"
            found.append(Check(block.name, ratio, p_value, text))
    statistic, freedom, p_value = scores.outside
    if freedom:
        text = f"what no candidate can explain: χ²/dof {statistic / freedom:.2f} with {freedom} degrees of freedom"
        found.append(Check("outside the catalogue", statistic / freedom, p_value, text))
    found += [_distribution(state), _odd_even(state, experiment)]
    return tuple(found)


def _by_kind(state: State, kinds: NDArray[np.int64]) -> list[Check]:
    """χ² of each kind of residual against what noise and the fit leave of it."""
    root = np.linalg.inv(state.weights)
    evidence = state.evidence
    residual = root @ evidence.residual
    basis = np.linalg.svd(evidence.jacobian, full_matrices=False)[0]
    left = root @ (np.eye(len(residual)) - basis @ basis.T) @ root.T
    found = []
    for kind, (name, words) in enumerate(_GROUPS):
        rows = kinds == kind
        if not rows.any():
            continue
        values, vectors = np.linalg.eigh(left[np.ix_(rows, rows)])
        keep = values > 1e-9 * values[-1]
        along = vectors[:, keep].T @ residual[rows] / np.sqrt(values[keep])
        statistic, freedom = float(along @ along), int(keep.sum())
        found.append(Check(name, statistic / freedom, float(scipy.stats.chi2.sf(statistic, freedom)),
                           f"{words}: χ²/dof {statistic / freedom:.2f} with {freedom} degrees of freedom"))  # fmt: skip
    return found


def _distribution(state: State) -> Check:
    """Whitened residuals, turned so that they are independent, against the normal law (Kolmogorov and Smirnov)."""
    complement = np.linalg.svd(state.evidence.jacobian)[0][:, len(state.evidence.residual) - state.evidence.freedom :]
    white = complement.T @ state.evidence.residual
    result = scipy.stats.kstest(white, "norm")
    text = f"distribution of the whitened residuals against the normal law: largest difference {result.statistic:.3f}"
    return Check("distribution of the residuals", float(result.statistic), float(result.pvalue), text)


def _odd_even(state: State, experiment: HandHeld) -> Check:
    """Parameters from the even poses predict the odd ones: error against its predicted size."""
    root = np.linalg.inv(state.weights)
    covariance, jacobian = root @ root.T, root @ state.evidence.jacobian
    touched = experiment.poses_touched
    rows = experiment.kinds != 1  # a turn joins an odd and an even pose
    even, odd = (rows & (touched[:, 0] % 2 == parity) for parity in (0, 1))
    name = "odd against even poses"
    seen = np.linalg.matrix_rank(jacobian[even])
    weights = np.linalg.inv(np.linalg.cholesky(covariance[np.ix_(even, even)]))
    u, s, vt = np.linalg.svd(weights @ jacobian[even], full_matrices=False)
    inverse = (vt[:seen].T / s[:seen]) @ u[:, :seen].T
    error = state.conditions[odd] - jacobian[odd] @ inverse @ weights @ state.conditions[even]
    gain = jacobian[odd] @ inverse @ weights
    cross = covariance[np.ix_(odd, even)] @ gain.T
    spread = covariance[np.ix_(odd, odd)] + gain @ covariance[np.ix_(even, even)] @ gain.T - cross - cross.T
    white = np.linalg.solve(np.linalg.cholesky(spread), error)
    statistic, freedom = float(white @ white), len(white)
    text = f"odd poses predicted from even ones: χ²/dof {statistic / freedom:.2f} of {freedom} conditions"
    return Check(name, statistic / freedom, float(scipy.stats.chi2.sf(statistic, freedom)), text)
