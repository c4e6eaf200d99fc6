"""What could hide in a recording without being noticed, and by how much it would shift what was calibrated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaximu.diagnosis.evidence import BLIND, EffectBlock, Evidence
from jaximu.diagnosis.experiment import State
from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import rms
from jaximu.ground.vectors import sigmas_of

_NOTHING = 0.05
"""Standard deviations below which a shift is not listed."""
_LEAST = 10.0
"""Detection limits from which on a combination of coefficients that hardly shows is stated by itself."""


@dataclass(frozen=True)
class Hidden:
    """A cause as large as its detection limit: `limit` in `unit`, and the shift of each number that it would move.

    shift: by the number's name, in its standard deviations, root mean square over the directions of the coefficients.
    weakest: the combination (q,) of coefficients, of length one, that shows least, and its own limit, infinite where
    nothing shows it. The limit is that of random combinations, and says nothing of this one.
    """

    name: str
    limit: float
    unit: str
    shift: dict[str, float]
    weakest: tuple[FloatArray, float]

    @property
    def combination(self) -> str:
        """The combination that shows least, in words, where its limit is another than that of the others."""
        weights, limit = self.weakest
        if limit < _LEAST * self.limit:
            return ""
        alike = weights.min() > 0.5 * weights.max()
        return "on all axes alike" if alike else f"in the combination ({', '.join(f'{w:.2f}' for w in weights)})"

    @property
    def worst(self) -> tuple[str, float]:
        """The number that would be shifted most, and by how many standard deviations; ("", 0) where none would."""
        return max(self.shift.items(), key=lambda item: item[1], default=("", 0.0))


def shift_by(state: State, block: EffectBlock) -> FloatArray:
    """Return the shift (p, q) of each fitted number by each coefficient of an effect that the model lacks.

    Both in their own units. The effect adds its whitened column C to the conditions, and a fit without it makes up for
    that, to first order by −(JᵀJ)⁻¹JᵀC (the minimal detectable bias carried to the parameters: Baarda 1968; Teunissen
    2006).
    """
    moved = -state.evidence.inverse @ block.columns
    return np.asarray(moved * state.fitted_sizes[:, None] / block.sizes, np.float64)


def hidden_causes(state: State) -> list[Hidden]:
    """Return each cause at its detection limit and what it would do, the worst first."""
    causes = [
        Hidden(name, limit, unit, _shifts(state, name, limit), _weakest(state.evidence, name, limit))
        for name, (limit, unit) in state.limits.items()
    ]
    return sorted(causes, key=lambda cause: -cause.worst[1])


def _shifts(state: State, name: str, limit: float) -> dict[str, float]:
    """Return the shifts by a cause, wherever on its grid it does most."""
    sigmas = sigmas_of(state.covariance)[state.fitted]
    largest = np.max([_spread(shift_by(state, block)) for block in state.evidence.blocks if block.name == name], axis=0)
    sizes = zip(state.fitted, limit * largest / sigmas, strict=True)
    return {str(state.names[row]): float(size) for row, size in sizes if size >= _NOTHING}


def _weakest(evidence: Evidence, name: str, limit: float) -> tuple[FloatArray, float]:
    """Return the combination of an effect's coefficients that shows least, where on its grid it shows most."""
    informations = [
        evidence.information(k) / block.sizes[:, None] / block.sizes
        for k, block in enumerate(evidence.blocks)
        if block.name == name
    ]
    values, vectors = np.linalg.eigh(max(informations, key=np.trace))
    shows = values[0] > BLIND**2 * values[-1]
    # of several that nothing shows, the one nearest the first axis that is none of the others
    least = vectors[:, :1] if shows else vectors[:, values <= BLIND**2 * values[-1]]
    alike = least @ least.T
    weights = alike[:, np.argmax(np.diagonal(alike).round(6))]
    weights = weights / np.linalg.norm(weights)
    return weights, float(limit * np.sqrt(values.mean() / values[0])) if shows else float("inf")


def _spread(shift: FloatArray) -> FloatArray:
    """Return the root mean square (p,) over coefficient vectors of length one and random direction."""
    return rms(shift, axis=1)
