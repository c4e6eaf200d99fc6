"""Act one: what the fitted model's twin gets right and wrong, each with a statistic, its p-value and a sentence."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jaximu.diagnosis.evidence import EffectBlock, Evidence
from jaximu.diagnosis.experiment import LEAST_WARMING, Experiment, State
from jaximu.estimation.leave_out import off
from jaximu.estimation.problem import Name
from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import chi2_sf, holm, kolmogorov_sf
from jaximu.ground.document import Json, entries
from jaximu.ground.vectors import submatrix

_KINDS = {
    "gravity_norm": ("gravity norm at rest", "the magnitude of the specific force in the poses"),
    "gravity_direction": ("gravity direction over turns", "the direction of gravity carried over the turns"),
    "static_gyroscope": ("rate at rest", "the gyroscope's mean output in the poses"),
}
_STILL = 1e-3
"""Share of a covariate's size that it must vary by for anything to be seen to depend on it."""


@dataclass(frozen=True)
class Check:
    """One comparison of the recording with what model and noise predict: χ² per degree of freedom, or as named.

    adjusted: its p-value with all checks of the fit allowed for (Holm, Scandinavian Journal of Statistics 6, 1979).
    """

    name: str
    statistic: float
    p_value: float
    text: str
    adjusted: float = 1.0

    def document(self) -> Json:
        """Return the check as `diagnosis.json` has it."""
        return entries(self, "name", "statistic", "p_value", "adjusted", "text")


def checks_of(state: State, experiment: Experiment) -> tuple[Check, ...]:
    """Return all checks of a fit: by kind of residual, by what it may depend on, distribution, odd against even."""
    checks = [*_by_kind(state, experiment)]
    scores = state.evidence.scores()
    generic: dict[str, list[int]] = {}
    for k, block in enumerate(state.evidence.blocks):
        if block.kind == "generic" and scores.freedom[k]:
            generic.setdefault(block.name, []).append(k)
    for name, blocks in generic.items():
        best = min(blocks, key=lambda k: scores.p_value[k])
        ratio = float(scores.statistic[best] / scores.freedom[best])
        p_value = float(-np.expm1(len(blocks) * np.log1p(-min(scores.p_value[best], 1 - 1e-16))))  # Šidák
        text = f"{state.evidence.blocks[best].words}: χ²/dof {ratio:.2f} with {scores.freedom[best]} degrees of freedom"
        checks.append(Check(name, ratio, p_value, text))
    statistic, freedom, p_value = scores.outside
    if freedom:
        text = f"what no candidate can explain: χ²/dof {statistic / freedom:.2f} with {freedom} degrees of freedom"
        checks.append(Check("outside the catalogue", statistic / freedom, p_value, text))
    if experiment.data.by_hand:
        checks += _dependences(state, experiment)
    checks += [_distribution(state), _odd_even(state, experiment)]
    adjusted = holm([check.p_value for check in checks]).tolist()
    return tuple(replace(check, adjusted=value) for check, value in zip(checks, adjusted, strict=True))


def _by_kind(state: State, experiment: Experiment) -> list[Check]:
    """χ² of each kind of residual against what noise and the fit leave of it."""
    root = np.linalg.inv(state.weights)
    evidence = state.evidence
    residual = root @ evidence.residual
    left = root @ evidence.off_base(root.T)
    checks = []
    for index, kind in enumerate(experiment.real.kinds):
        plain = kind.name.replace("_", " ")
        name, words = _KINDS.get(kind.name, (plain, plain))
        rows = experiment.real.kind == index
        if not rows.any():
            continue
        values, vectors = np.linalg.eigh(submatrix(left, rows))
        keep = values > 1e-9 * values[-1]
        along = vectors[:, keep].T @ residual[rows] / np.sqrt(values[keep])
        statistic, freedom = float(along @ along), int(keep.sum())
        checks.append(
            Check(
                name,
                statistic / freedom,
                float(chi2_sf(statistic, freedom)),
                f"{words}: χ²/dof {statistic / freedom:.2f} with {freedom} degrees of freedom",
            )
        )
    return checks


def _dependences(state: State, experiment: Experiment) -> list[Check]:
    """Whether a kind of residual depends on time, temperature, specific force, or on a turn's angle, rate, duration.

    A score test of a few polynomials of the covariate: of the norms and of each axis of the means at rest by
    themselves, of a turn as a share of its rotation about each axis, as if the gyroscope's scale changed with it.
    Whitened, and freed of what the parameters imitate, the residual's squared length in their span is χ². It is not
    rescaled by what lies outside: noise taken too small is model error, too.
    """
    jacobian = np.linalg.inv(state.weights) @ state.evidence.jacobian
    real = experiment.rows(state.imu).real()
    kinds, steady = real.kind, experiment.extent().temperature_range <= LEAST_WARMING
    names = ("gravity norm at rest", "gravity direction over turns", "rate at rest")
    scales = [state.names.index(Name("gyroscope", "gain", (axis, axis))) for axis in range(3)]
    blocks = []

    def add(kind: int, name: str, degree: int, shapes: FloatArray) -> None:
        """`shapes` (n, k) of all conditions, taken where they are of this kind."""
        rows = kinds == kind
        used = real.covariates[name][rows]
        if not rows.any() or not np.ptp(used) > _STILL * np.max(np.abs(used)):  # nor where a kind has no such covariate
            return
        basis = np.polynomial.legendre.legvander(2 * (used - used.min()) / np.ptp(used) - 1, degree)[:, 1:]
        columns = np.zeros((len(rows), degree * shapes.shape[1]))
        columns[rows] = (basis[:, :, None] * shapes[rows, None, :]).reshape(len(used), -1)
        blocks.append(
            EffectBlock(
                f"{names[kind]} against {name.partition(' [')[0]}", state.weights @ columns, np.ones(columns.shape[1])
            )
        )

    axes = np.zeros((len(kinds), 3))
    axes[kinds == 2] = np.tile(np.eye(3), (int(np.sum(kinds == 2)) // 3, 1))
    covariates = [name for name in real.covariates if not (steady and name.startswith("temperature"))]
    for name in covariates:
        degree = 4 if name.startswith("specific force") else 3  # bias and scale take the first two degrees of force
        add(0, name, degree, np.ones((len(kinds), 1)))
        add(2, name, degree, axes)
    for name in covariates:
        add(1, name, 2, jacobian[:, scales])
    scores = Evidence(state.evidence.residual, state.evidence.jacobian, blocks).scores()
    checks = []
    for block, scaled, freedom in zip(blocks, scores.statistic, scores.freedom, strict=True):
        if freedom:
            statistic = float(scaled) * scores.unit**2
            text = f"{block.name}: χ²/dof {statistic / freedom:.2f} with {freedom} degrees of freedom"
            p_value = float(chi2_sf(statistic, freedom))
            checks.append(Check(block.name, statistic / int(freedom), p_value, text))
    return checks


def _distribution(state: State) -> Check:
    """Whitened residuals, turned so that they are independent, against the normal law (Kolmogorov and Smirnov)."""
    complement = np.linalg.svd(state.evidence.jacobian)[0][:, len(state.evidence.residual) - state.evidence.freedom :]
    white = complement.T @ state.evidence.residual
    distance, p_value = kolmogorov_sf(white)
    text = f"distribution of the whitened residuals against the normal law: largest difference {distance:.3f}"
    return Check("distribution of the residuals", distance, p_value, text)


def _odd_even(state: State, experiment: Experiment) -> Check:
    """Parameters from every second observation predict the others: error against its predicted size.

    Its square is what the misfit of all exceeds that of the one half by; a direction that the one half leaves open
    costs a degree of freedom.
    """
    root = np.linalg.inv(state.weights)
    covariance, jacobian = root @ root.T, root @ state.evidence.jacobian
    first, kinds = experiment.real.first, experiment.real.kind
    alone = first == experiment.real.last  # a turn may join an odd and an even pose
    parity = np.zeros(len(kinds), np.int64)
    for kind in np.unique(kinds[alone]):
        members = alone & (kinds == kind)
        parity[members] = np.unique(first[members], return_inverse=True)[1] % 2
    even = alone & (parity == 0)

    def misfit(rows) -> tuple[float, int]:
        """χ² of some conditions by themselves, and its degrees of freedom."""
        white = np.linalg.cholesky(submatrix(covariance, rows))
        basis, values, _ = np.linalg.svd(np.linalg.solve(white, jacobian[rows]), full_matrices=False)
        basis = basis[:, values > 1e-8 * values[0]]
        error = np.linalg.solve(white, state.conditions[rows])
        error = off(basis, error)
        return float(error @ error), len(error) - basis.shape[1]

    (whole, whole_freedom), (half, half_freedom) = misfit(alone), misfit(even)
    statistic, freedom = whole - half, whole_freedom - half_freedom
    text = f"odd poses predicted from even ones: χ²/dof {statistic / freedom:.2f} of {freedom} conditions"
    return Check("odd against even poses", statistic / freedom, float(chi2_sf(statistic, freedom)), text)
