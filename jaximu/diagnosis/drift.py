"""Slow drift of the biases and what hands add, estimated from the recording that is diagnosed.

Poses show what noise is quicker than they last. What is slower shows between them: in the means at rest, in the turns
and in the norms. Bias instability and random walk of each triad are variance components of the conditions, whose sizes
are estimated by restricted likelihood together with what is known of the class of sensor. That the sizes are
estimated from the same data enters the law of the smallest p-value.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from jaximu.data.drift import (
    DRIFT_ESTIMATED,
    USUAL_DRIFT,
    drifting,
    power_on_text,
    restricted_likelihood,
)
from jaximu.estimation.data import Data, Handling
from jaximu.estimation.fitting import Linear
from jaximu.estimation.leave_out import off, orthonormal
from jaximu.ground.array_types import BoolArray, FloatArray
from jaximu.ground.distributions import normal_sf
from jaximu.ground.vectors import sigmas_of, submatrix
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.sensor import Imu

_USUAL = {**USUAL_DRIFT, "poses that move": (1.0, 0.5), "turns undersampled": (0.1, 1.0)}
"""Median of each kind's standard deviation and the spread of its logarithm. What hands do is relative to what the
samples show, which for poses is all, and for turns holds at half the sample rate."""
_STRANGE = 0.01
"""Share of sensors, or hands, that have a size beyond which it is not believed."""
DRAWS = 1000
"""Draws of noise that the law of the smallest p-value comes from."""


@dataclass(frozen=True)
class DriftComponents:
    """Variance components of the conditions, padding included, their log sizes (k,) and these' covariance (k, k).

    names: "gyroscope bias instability", …. components (k, n, n): covariances at a size of one, which the noise `units`
    (of the first ones) give. handling: what the samples show of poses and turns. beside (n, q): derivatives of the
    conditions by effects that were not to pass for drift.
    """

    names: tuple[str, ...]
    units: tuple[AxisNoise, ...]
    components: FloatArray
    handling: Handling | None
    log_size: FloatArray
    uncertainty: FloatArray
    beside: FloatArray

    @property
    def sizes(self) -> dict[str, tuple[float, float]]:
        """The standard deviation of each kind, relative to its unit, and the relative uncertainty of it."""
        spread = sigmas_of(self.uncertainty) / 2
        return {
            name: (float(np.exp(half)), float(relative))
            for name, half, relative in zip(self.names, self.log_size / 2, spread, strict=True)
        }

    @property
    def implausible(self) -> dict[str, float]:
        """What hardly any sensor or hand does, in sentences, and how probable: such sizes stand for another misfit."""
        sentences = {}
        for name, (size, _) in self.sizes.items():
            median, spread = next(usual for kind, usual in _USUAL.items() if name.endswith(kind))
            probability = float(normal_sf(np.log(size / median) / spread))
            if probability < _STRANGE:
                sentences[
                    f"To explain the misfit, the size of {name} would have to be {size:.3g}, where {median:g} is "
                    f"usual, and not one in {1 / _STRANGE:.0f} is as large: another cause is likelier."
                ] = probability
        return sentences

    @property
    def by_hand(self) -> FloatArray:
        """The variance (n,) that handling adds to the conditions."""
        first = len(self.units)
        added = np.einsum("k,kii->i", np.exp(self.log_size[first:]), self.components[first:])
        return np.asarray(added)

    def draws(self, weights: FloatArray, jacobian: FloatArray, used: BoolArray, seed: int) -> FloatArray:
        """Return whitened noise (n, `DRAWS`) of the real conditions, from each draw of which the sizes were estimated.

        The true log sizes are as uncertain as they are: off by ε they change noise that `weights` (n, n) whiten by
        ½ Σ ε_k A_k to first order, A_k the whitened component. What is estimated from such noise is off by δ = Cov·g, g
        the gradient of the restricted likelihood, which changes the weights by −½ Σ δ_k A_k.
        """
        random = np.random.default_rng(seed)
        drawn = random.standard_normal((len(weights), DRAWS))
        sizes, whole = np.exp(self.log_size), self.components[:, used][:, :, used]
        parts = [size * weights @ part @ weights.T for size, part in zip(sizes, whole, strict=True)]

        def changed(values: FloatArray, logarithms: FloatArray) -> FloatArray:
            change = np.clip(logarithms, -1.0, 1.0) / 2
            return values + sum(amount * (part @ values) for amount, part in zip(change, parts, strict=True))

        drawn = changed(drawn, np.linalg.cholesky(self.uncertainty) @ random.standard_normal((len(sizes), DRAWS)))
        basis = orthonormal(np.concatenate([jacobian, weights @ self.beside[used]], axis=1))
        pulled = off(basis, drawn)
        inside = [np.trace(part) - np.trace(basis.T @ part @ basis) for part in parts]
        gradient = (
            np.stack(
                [np.sum(pulled * (part @ pulled), axis=0) - mean for part, mean in zip(parts, inside, strict=True)]
            )
            / 2
        )
        return changed(drawn, -self.uncertainty @ gradient)

    @cached_property
    def notes(self) -> list[str]:
        """What was estimated, in sentences."""
        sizes = {name: size for name, (size, _) in self.sizes.items()}
        estimated = [DRIFT_ESTIMATED] if any(name.endswith("bias instability") for name in sizes) else []
        return estimated + power_on_text(dict(zip(self.names, self.units, strict=False)), sizes)


def drifted(noise: NoiseModel, drift: DriftComponents) -> NoiseModel:
    """Return a noise model with the drift that was estimated."""
    units = dict(zip(drift.names, drift.units, strict=False))
    return drifting(noise, units, {name: size for name, (size, _) in drift.sizes.items()})


def estimate_drift(
    data: Data,
    linear: Linear,
    used: BoolArray,
    imu: Imu,
    noise: NoiseModel,
    columns: FloatArray,
    within: bool = True,
) -> DriftComponents:
    """Estimate what a recording shows beyond `noise`: drift, of which that knows nothing, and what hands add.

    **Arguments:** `data`, `linear`: made with `noise`, about `imu`, a unit close to the recording's; `used` (n,): which
    conditions are real; `columns` (n, q): derivatives of the real conditions by effects that may be present and must
    not pass for drift; `within`: false where the noise comes from elsewhere and knows the drift within a recording.
    """
    units, components = data.drifts(noise, linear.details, within)
    if components is None:
        components = np.zeros((0, *linear.covariance.shape))
    names = list(units)
    hands = data.handling(imu, linear.details, noise)
    if hands is not None:
        names += ["poses that move", "turns undersampled"]
        components = np.concatenate([components, _by_hand(hands)])
    usual = [next(size for kind, size in _USUAL.items() if name.endswith(kind)) for name in names]
    mean, spread = np.array([(2 * np.log(median), 2 * wide) for median, wide in usual]).T
    log_size, uncertainty = restricted_likelihood(
        linear.conditions[used],
        np.concatenate([linear.slope[used], columns], axis=1),
        submatrix(linear.covariance, used),
        components[:, used][:, :, used],
        mean,
        spread,
    )
    beside = np.zeros((len(used), columns.shape[1]))
    beside[used] = columns
    return DriftComponents(tuple(names), tuple(units.values()), components, hands, log_size, uncertainty, beside)


def _by_hand(hands: Handling) -> FloatArray:
    return np.stack([np.diag(variance) for variance in (hands.moving, hands.sampling)])


def hands_of(
    data: Data, details: Any, used: BoolArray, imu: Imu, noise: NoiseModel, drift: DriftComponents
) -> DriftComponents:
    """Return what hands added to another recording, at the sizes that were estimated; its drift is in the noise."""
    hands = data.handling(imu, details, noise)
    first = len(drift.units)
    components = np.zeros((0, *drift.components.shape[1:])) if hands is None else _by_hand(hands)
    return DriftComponents(
        drift.names[first:],
        (),
        components,
        hands,
        drift.log_size[first:],
        drift.uncertainty[first:, first:],
        np.zeros((len(used), 0)),
    )
