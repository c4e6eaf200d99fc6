"""Accelerometer windows at rest in many poses over temperature, by the norm of gravity alone: wearables, mostly.

Each window's mean output y and temperature T say |f| = g with f = (K + diag(s) ΔT)⁻¹ (y − b − c₁ ΔT − c₂ ΔT² − …), K
lower-triangular as no attitude is known. Bias, gain and what temperature does to both are fitted together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from jaximu import stored
from jaximu.effects import CATALOGUE
from jaximu.errors import InputError, NotPossibleError
from jaximu.gravity import STANDARD
from jaximu.precision import require_float64
from jaximu.sensor import REFERENCE_TEMPERATURE, Triad

__all__ = ["NormFit", "calibrate_norms"]

FloatArray = NDArray[np.float64]
_LOWER = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))
_POWERS = ("temperature", "temperature_squared", "temperature_cubed")
_SCALE = "scale_temperature"
_ROUNDS = 60
_CAP = 0.01  # of the usual error: below, the weight of an error no longer grows


@dataclass(frozen=True)
class NormFit:
    """A fitted accelerometer (m/s²), the norm errors of the windows before and after (n,), m/s², and the covariance.

    covariance (p, p): of the six of the gain, three of the bias, and three of each effect, in SI.
    """

    triad: Triad
    before: FloatArray
    after: FloatArray
    covariance: FloatArray
    gravity: float

    def errors(self, means: FloatArray, kelvin: FloatArray) -> FloatArray:
        """Return the norm errors (n,), m/s², of other windows."""
        effects = tuple(effect.plain for effect in self.triad.effects)
        numbers = [np.asarray(self.triad.gain)[place] for place in _LOWER] + list(np.asarray(self.triad.bias))
        numbers += [value for effect in self.triad.effects for value in np.asarray(effect.coefficients)]
        warmth = np.asarray(kelvin, float) - self.triad.temperature_reference
        return _linearised(effects, np.array(numbers), np.asarray(means, float), warmth, self.gravity)[0]


def calibrate_norms(
    means: Float[np.ndarray, "n 3"],
    kelvin: Float[np.ndarray, " n"],
    effects: Sequence[str] = ("temperature",),
    loss: str = "absolute",
    gravity: float = STANDARD.value,
    reference: float = REFERENCE_TEMPERATURE,
) -> NormFit:
    """Fit an accelerometer to windows at rest: means (n, 3), m/s², and temperatures (n,), °C.

    **Arguments:** `effects`: of "temperature", "temperature_squared", "temperature_cubed" and "scale_temperature";
    `loss`: "linear" for the least mean square of the norms' errors, "absolute" for the least mean size, which windows
    that moved hurt less; `reference`: °C.

    Raises `NotPossibleError` where the windows do not determine all that is asked.
    """
    require_float64()
    unknown = [name for name in effects if name not in (*_POWERS, _SCALE)]
    if unknown or loss not in ("linear", "absolute"):
        raise InputError(f"{unknown[0] if unknown else loss} is not known here.")
    means, warmth = np.asarray(means, float), np.asarray(kelvin, float) - reference
    numbers = np.zeros(9 + 3 * len(effects))
    numbers[[0, 2, 5]] = 1.0
    before = _linearised(tuple(effects), numbers, means, warmth, gravity)[0]
    size = np.concatenate([np.ones(6), np.ones(3), *(_size(name, warmth) * np.ones(3) for name in effects)])
    weight = np.ones(len(means))
    for _ in range(_ROUNDS):
        error, slope = _linearised(tuple(effects), numbers, means, warmth, gravity)
        if loss == "absolute":
            usual = np.median(np.abs(error))
            weight = 1 / np.sqrt(np.maximum(np.abs(error), _CAP * usual))
        scaled = weight[:, None] * slope * size
        u, s, v = np.linalg.svd(scaled, full_matrices=False)
        if s[-1] < 1e-7 * s[0]:
            raise NotPossibleError(
                "the windows do not determine bias, gain and what temperature does to them: more poses at more "
                "temperatures are needed, each axis up and down."
            )
        step = size * (v.T @ ((u.T @ (-weight * error)) / s))
        numbers = numbers + step
        if np.max(np.abs(step / size)) < 1e-9:
            break
    after, slope = _linearised(tuple(effects), numbers, means, warmth, gravity)
    bread = np.linalg.inv(slope.T @ slope)
    score = after[:, None] * slope
    if loss == "absolute":  # of least absolute errors, by the density of the errors at zero
        near = np.median(np.abs(after)) / 2
        score = slope / (2 * np.mean(np.abs(after) < near) / (2 * near))
    gain = np.zeros((3, 3))
    for value, place in zip(numbers[:6], _LOWER, strict=True):
        gain[place] = value
    found = tuple(CATALOGUE[f"accel.{name}"](numbers[9 + 3 * k : 12 + 3 * k]) for k, name in enumerate(effects))
    triad = Triad(gain, numbers[6:9], found, temperature_reference=reference)  # pyright: ignore[reportArgumentType]
    return NormFit(triad, before, after, bread @ (score.T @ score) @ bread, gravity)


def _size(name: str, warmth: FloatArray) -> float:
    spread = max(float(np.std(warmth)), 1e-3)
    return 1 / spread ** (1 + _POWERS.index(name)) if name in _POWERS else 1 / spread


def _linearised(
    effects: tuple[str, ...], numbers: FloatArray, means: FloatArray, warmth: FloatArray, gravity: float
) -> tuple[FloatArray, FloatArray]:
    """Return norm errors (n,) and their derivatives (n, p)."""
    called = stored.call(_errors(effects), f"norms {effects}", numbers, means, warmth, np.asarray(gravity))
    return np.asarray(called[0]), np.asarray(called[1]).T


def _errors(effects: tuple[str, ...]):
    def of(numbers, means, warmth, gravity):
        places = dict(zip(_LOWER, numbers[:6], strict=True))
        left = [means[:, axis] - numbers[6 + axis] for axis in range(3)]
        diagonal = [places[axis, axis] * jnp.ones_like(warmth) for axis in range(3)]
        for k, name in enumerate(effects):
            own = numbers[9 + 3 * k : 12 + 3 * k]
            for axis in range(3):
                if name == _SCALE:
                    diagonal[axis] = diagonal[axis] + own[axis] * warmth
                else:
                    left[axis] = left[axis] - own[axis] * warmth ** (1 + _POWERS.index(name))
        x = left[0] / diagonal[0]
        y = (left[1] - places[1, 0] * x) / diagonal[1]
        z = (left[2] - places[2, 0] * x - places[2, 1] * y) / diagonal[2]
        return jnp.sqrt(x * x + y * y + z * z) - gravity

    def both(numbers, means, warmth, gravity):
        error, push = jax.linearize(lambda each: of(each, means, warmth, gravity), numbers)
        return error, jax.vmap(push)(jnp.eye(len(numbers)))

    return both
