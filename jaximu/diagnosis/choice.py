"""What the choice of effects leaves open: models that the data do not exclude, and what they do to gain and bias.

Testing and then estimating is one estimator, which scatters more than that of the model it ends with (Teunissen,
J. Geod. 92, 2018).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jaximu.calibration import Calibration
from jaximu.diagnosis.evidence import Evidence
from jaximu.diagnosis.experiment import State
from jaximu.diagnosis.selection import causes_of, criterion
from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import normal_sf
from jaximu.ground.quantities import Z95, number

_NEGLIGIBLE = 1e-4
"""Weight, relative to the likeliest model's, below which a model is left out."""

_HALVINGS = 40
"""Of an interval of half the width: to 1e-12."""


def with_open_choice(calibration: Calibration, base: State, effects: Sequence[str]) -> Calibration:
    """Return a calibration whose uncertainties allow for the models that its recording does not exclude.

    `base`: the fit without effects; `effects`: names of those that were chosen, which the calibration has.
    """
    variances = open_choice(base.evidence, effects) * base.fitted_sizes**2
    added = dict(zip([base.names[row] for row in base.fitted], variances, strict=True))
    more = np.array([added.get(name, 0.0) for name in calibration.names])
    before = np.diag(calibration.covariance)
    wider = np.sqrt(1 + more / np.where(before > 0, before, 1.0))
    biases = {
        triad: [added[name] for name in added if (name.owner, name.part) == (triad, "bias")]
        for triad in calibration.bias_sigma_recording
    }
    note = (
        f"The uncertainties of gain and bias are up to {number(100 * (max(wider, default=1.0) - 1), 2)} % larger than "
        "the fit's: they allow for other effects that this recording does not exclude."
    )
    return replace(
        calibration,
        covariance=calibration.covariance * wider[:, None] * wider,
        bias_sigma_recording={
            triad: np.sqrt(np.square(sigma) + biases[triad])
            for triad, sigma in calibration.bias_sigma_recording.items()
        },
        notes=(*calibration.notes, note),
    )


def open_choice(evidence: Evidence, effects: Sequence[str]) -> FloatArray:
    """Return what the choice of effects adds to the variances (p,) of the base's numbers, as its Jacobian scales them.

    Around the model with the chosen effects stand those with one more, one fewer, and another in the place of one. To
    first order about the base fit, each model's numbers follow from the same conditions. A model has the weight
    exp(criterion / 2) of Schwarz's approximation (Raftery, Sociological Methodology 25, 1995), which the places of an
    effect's grid share. About the chosen model's numbers, the intervals that hold 95 % of all models together are taken
    for those of a normal distribution; that another model may know a number better does not narrow them.
    """
    kept = tuple(cause.block for cause in causes_of(evidence, effects))
    models = _one_change_away(evidence, kept)
    best = max(models.values())
    models = {blocks: weight - best for blocks, weight in models.items() if weight - best > np.log(_NEGLIGIBLE)}
    chosen, sigma = _numbers(evidence, kept)
    changes, sigmas = zip(*[_numbers(evidence, blocks) for blocks in models], strict=True)
    half = _half_width(np.exp(list(models.values())), np.array(changes) - chosen, np.array(sigmas))
    return np.maximum((half / Z95) ** 2 - sigma**2, 0.0)


def _half_width(weights: FloatArray, centres: FloatArray, sigmas: FloatArray) -> FloatArray:
    """Return half the widths (p,) of intervals about zero that hold 95 % of a mixture.

    Of normal distributions with `weights` (m,), `centres` (m, p) and `sigmas` (m, p); found by halving.
    """
    low, high = np.zeros(centres.shape[1]), np.max(np.abs(centres) + 2 * Z95 * sigmas, axis=0)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        outside = weights @ (normal_sf((middle - centres) / sigmas) + normal_sf((middle + centres) / sigmas))
        wide = outside < 2 * normal_sf(Z95) * weights.sum()
        low, high = np.where(wide, low, middle), np.where(wide, middle, high)
    return high


def _one_change_away(evidence: Evidence, kept: tuple[int, ...]) -> dict[tuple[int, ...], float]:
    """Return the log weights of models, as blocks that are in them, relative to the one that has the blocks `kept`."""
    blocks = evidence.blocks
    names = [block.name for block in blocks]
    models = {kept: 0.0}

    def add(among: tuple[int, ...], without: float) -> None:
        scores, inside = evidence.scores(among), {names[k] for k in among}
        for k, block in enumerate(blocks):
            if block.kind == "effect" and scores.freedom[k] and block.name not in inside:
                shared = 0.0 if block.position else 2 * np.log(names.count(block.name))
                models.setdefault((*among, k), without + (criterion(evidence, scores, k) - shared) / 2)

    add(kept, 0.0)
    for one in kept:
        rest = tuple(k for k in kept if k != one)
        models[rest] = -criterion(evidence, evidence.scores(rest), one) / 2
        add(rest, models[rest])
    return models


def _numbers(evidence: Evidence, blocks: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Return the base's numbers (p,) in a model with these blocks, relative to those without, and their sigmas (p,)."""
    coefficients, uncertainty = evidence.most_likely(blocks)
    columns = [evidence.blocks[k].columns for k in blocks]
    reaction = evidence.inverse @ np.concatenate([np.zeros((len(evidence.residual), 0)), *columns], axis=1)
    variances = np.sum(evidence.inverse**2, axis=1) + np.einsum("pq,qr,pr->p", reaction, uncertainty, reaction)
    return reaction @ coefficients, np.sqrt(variances)
