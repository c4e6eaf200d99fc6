"""Slow drift of the biases and what hands add, estimated from the recording that is diagnosed.

Poses show what noise is quicker than they last. What is slower shows between them: in the means at rest, in the turns
and in the norms. Bias instability and random walk of each triad are variance components of the conditions, whose sizes
are estimated by restricted likelihood together with what is known of the class of sensor. That the sizes are
estimated from the same data enters the law of the smallest p-value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jaximu.diagnosis.handling import Handling
from jaximu.noise.model import AxisNoise, NoiseModel

if TYPE_CHECKING:
    from jaximu.diagnosis.experiment import Experiment
    from jaximu.sensor import Imu

__all__ = ["DRAWS", "Drift", "drifted", "estimate_drift", "hands_of", "with_usual_drift"]

FloatArray = NDArray[np.float64]
_USUAL = {
    "bias instability": (0.4, 1.2),
    "random walk": (0.1, 1.0),
    "poses that move": (1.0, 0.5),
    "turns undersampled": (0.1, 1.0),
}
"""Median of each kind's standard deviation and the spread of its logarithm. What MEMS sensors do: bias instability B
over white noise N, in 1/√s, and the standard deviation that a random walk gains over the recording, over N √(1/s). What
hands do: relative to what the samples show, which for poses is all, and for turns holds at half the sample rate."""
_ASSUMED = (
    "Noise was estimated from the poses of this recording. Poses cannot show slow drift of the bias, so a typical "
    "drift was assumed; add --static LOG to measure it."
)
_LONGEST = 4.0
"""Correlation time of a random walk's stand-in, in lengths of the recording."""
_SLOWEST = 16.0
"""Correlation time of the slowest part of flicker noise: what is slower still changes a recording by a hundredth."""
_RATIO = 4.0
_STRANGE = 3.0
"""Spreads beyond the usual from which on a size is not believed."""
_STEPS, _STILL = 40, 1e-3
DRAWS = 1000
"""Draws of noise that the law of the smallest p-value comes from."""


@dataclass(frozen=True)
class Drift:
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
        spread = np.sqrt(np.diag(self.uncertainty)) / 2
        return {
            name: (float(np.exp(half)), float(each))
            for name, half, each in zip(self.names, self.log_size / 2, spread, strict=True)
        }

    @property
    def implausible(self) -> list[str]:
        """What no sensor or hand of this class does, in sentences: such sizes stand for a misfit of another kind."""
        found = []
        for name, (size, _) in self.sizes.items():
            median, spread = next(each for kind, each in _USUAL.items() if name.endswith(kind))
            if np.log(size / median) > _STRANGE * spread:
                found.append(
                    f"To explain the misfit, the size of {name} would have to be {size:.3g}, where {median:g} is "
                    "usual: the cause is another."
                )
        return found

    @property
    def by_hand(self) -> FloatArray:
        """The variance (n,) that handling adds to the conditions."""
        first = len(self.units)
        added = np.einsum("k,kii->i", np.exp(self.log_size[first:]), self.components[first:])
        return np.asarray(added)

    def draws(self, weights: FloatArray, jacobian: FloatArray, used: NDArray[np.bool_], seed: int) -> FloatArray:
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
            return values + sum(own * (part @ values) for own, part in zip(change, parts, strict=True))

        drawn = changed(drawn, np.linalg.cholesky(self.uncertainty) @ random.standard_normal((len(sizes), DRAWS)))
        basis = _basis(np.concatenate([jacobian, weights @ self.beside[used]], axis=1))
        pulled = drawn - basis @ (basis.T @ drawn)
        inside = [np.trace(part) - np.trace(basis.T @ part @ basis) for part in parts]
        gradient = np.stack([np.sum(pulled * (part @ pulled), axis=0) - mean
                             for part, mean in zip(parts, inside, strict=True)]) / 2  # fmt: skip
        return changed(drawn, -self.uncertainty @ gradient)

    @cached_property
    def text(self) -> str:
        """What was estimated, in a sentence."""
        told = [f"{name} {size:.2g}" for name, (size, _) in self.sizes.items() if name.endswith("bias instability")]
        return (
            "Noise and bias drift were estimated from this recording (relative to white noise over a second: "
            f"{', '.join(told)}). A recording at rest (--static LOG) would determine them better."
        )


def _slow_units(known: AxisNoise, shortest: float, duration: float) -> dict[str, AxisNoise]:
    """Return the slow noise of a triad at a size of one: bias instability and random walk, as `_USUAL` relates them.

    Flicker noise of bias instability B has the variance B² ln(r)/π in each of Gauss–Markov processes whose correlation
    times stand r apart, from `shortest` (s) on; a random walk is one slow process with the growth 2σ²/τ.
    """
    size = known.covariance([0.0], [1.0])[:, 0]
    octaves = 1 + int(np.ceil(np.log(max(_SLOWEST * duration / shortest, 1.0)) / np.log(_RATIO)))
    times = np.asarray(shortest * _RATIO ** np.arange(octaves), np.float64)
    longest = np.array([_LONGEST * duration])

    def of(times: FloatArray, variance: FloatArray) -> AxisNoise:
        return AxisNoise(np.zeros(3), np.zeros(3), size * variance, np.asarray(times, np.float64))

    return {
        "bias instability": of(times, np.full(octaves, np.log(_RATIO) / np.pi)),
        "random walk": of(longest, longest / (2 * duration)),
    }


def drifted(noise: NoiseModel, drift: Drift) -> NoiseModel:
    """Return a noise model with the drift that was estimated."""
    for name, unit, size in zip(drift.names, drift.units, np.exp(drift.log_size), strict=False):
        noise = _with(noise, name.partition(" ")[0], replace(unit, variance=size * unit.variance))
    return noise


def with_usual_drift(noise: NoiseModel, shortest: float, duration: float) -> NoiseModel:
    """Return a noise model with the drift that is usual of MEMS sensors, slower than `shortest` (s)."""
    for triad in ("accelerometer", "gyroscope"):
        known = getattr(noise, triad)
        for name, unit in _slow_units(known, shortest, duration).items() if known is not None else ():
            noise = _with(noise, triad, replace(unit, variance=_USUAL[name][0] ** 2 * unit.variance))
    return replace(noise, notes=(*noise.notes, _ASSUMED))


def _with(noise: NoiseModel, triad: str, more: AxisNoise) -> NoiseModel:
    known = getattr(noise, triad)
    joined = replace(
        known, variance=np.concatenate([known.variance, more.variance], axis=1),
        correlation_time=np.concatenate([known.correlation_time, more.correlation_time]),
    )  # fmt: skip
    return replace(noise, **{triad: joined})


def estimate_drift(
    imu: Imu,
    noise: NoiseModel,
    remade: Callable[[NoiseModel], Experiment],
    columns: FloatArray,
    drifting: bool = True,
) -> Drift:
    """Estimate what a recording shows beyond `noise`: drift, of which that knows nothing, and what hands add.

    **Arguments:** `imu`: a unit close to the recording's; `remade`: makes the experiment with another noise; `columns`
    (n, q): derivatives of the real conditions by effects that may be present and must not pass for drift; `drifting`:
    false where the noise comes from elsewhere and knows the drift.
    """
    experiment = remade(noise)
    bare, used = experiment.linearise(imu), experiment.used
    shortest, duration = experiment.shortest(), experiment.extent().duration
    names, units, components = [], [], []
    for triad in ("accelerometer", "gyroscope") if drifting else ():
        known = getattr(noise, triad)
        for name, unit in _slow_units(known, shortest, duration).items() if known is not None else ():
            names.append(f"{triad} {name}")
            units.append(unit)
            components.append(remade(_with(noise, triad, unit)).linearise(imu).covariance - bare.covariance)
    hands = experiment.handling(imu, noise)
    if hands is not None:
        names += ["poses that move", "turns undersampled"]
        components += list(_by_hand(hands))
    whole = np.stack(components)
    usual = [next(each for kind, each in _USUAL.items() if name.endswith(kind)) for name in names]
    mean, spread = np.array([(2 * np.log(median), 2 * wide) for median, wide in usual]).T
    log_size, uncertainty = _restricted(
        bare.conditions[used], np.concatenate([bare.slope[used], columns], axis=1), bare.covariance[np.ix_(used, used)],
        whole[:, used][:, :, used], mean, spread,
    )  # fmt: skip
    beside = np.zeros((len(used), columns.shape[1]))
    beside[used] = columns
    return Drift(tuple(names), tuple(units), whole, hands, log_size, uncertainty, beside)


def _by_hand(hands: Handling) -> tuple[FloatArray, FloatArray]:
    return np.asarray(np.diag(hands.moving), np.float64), np.asarray(np.diag(hands.sampling), np.float64)


def hands_of(experiment: Experiment, imu: Imu, noise: NoiseModel, drift: Drift) -> Drift:
    """Return what hands added to another recording, at the sizes that were estimated; its drift is in the noise."""
    hands = experiment.handling(imu, noise)
    first = len(drift.units)
    components = np.zeros((0, *drift.components.shape[1:]))
    if hands is not None:
        components = np.stack(_by_hand(hands))
    return Drift(
        drift.names[first:], (), components, hands, drift.log_size[first:], drift.uncertainty[first:, first:],
        np.zeros((len(experiment.used), 0)),
    )  # fmt: skip


def _restricted(
    residual: FloatArray, jacobian: FloatArray, bare: FloatArray, components: FloatArray, mean: FloatArray,
    spread: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return the log sizes (k,) that are likeliest a posteriori, and their covariance (k, k), by Fisher scoring.

    With P = C⁻¹ − C⁻¹J(JᵀC⁻¹J)⁻¹JᵀC⁻¹ the restricted likelihood has by a size v_i the gradient
    ½ (rᵀPV_iPr − tr PV_i) and the information ½ tr PV_iPV_j (Förstner and Wrobel, Photogrammetric Computer Vision,
    2016, sec. 4.2.4); by its logarithm both gain factors of v_i.
    """
    log_size = mean.copy()
    jacobian = _basis(jacobian)
    information = np.eye(len(mean))
    for _ in range(_STEPS):
        sizes = np.exp(log_size)
        inverse = np.linalg.inv(bare + np.einsum("k,kij->ij", sizes, components))
        seen = inverse @ jacobian
        projector = inverse - seen @ np.linalg.solve(jacobian.T @ seen, seen.T)
        pulled = projector @ residual
        parts = sizes[:, None, None] * (projector @ components)
        gradient = 0.5 * (np.einsum("i,kij,j->k", pulled, components, pulled) * sizes - np.einsum("kii->k", parts))
        gradient -= (log_size - mean) / spread**2
        information = 0.5 * np.einsum("kij,lji->kl", parts, parts) + np.diag(1 / spread**2)
        step = np.linalg.solve(information, gradient)
        step /= max(1.0, float(np.max(np.abs(step))) / 1.5)  # an e-fold and a half of the variance at most
        log_size = log_size + step
        if np.max(np.abs(step)) < _STILL:
            break
    return log_size, np.asarray(np.linalg.inv(information), np.float64)


def _basis(columns: FloatArray) -> FloatArray:
    """Return an orthonormal basis (n, r) of what columns (n, q) span, whatever their lengths."""
    u, s, _ = np.linalg.svd(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), full_matrices=False)
    return np.asarray(u[:, s > 1e-9 * s[0]], np.float64)
