"""What thermal effects put out at a steady temperature, or on a steady way of it: by their own terms."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaximu import stored
from jaximu.effects import Effect
from jaximu.estimation import derivatives_by_numbers
from jaximu.problem import Name
from jaximu.sensor import Stimulus

__all__ = ["numbers_of", "steady"]

FloatArray = NDArray[np.float64]
_LONG = 1e6  # s that a steady way has lasted
_BUCKET = 64


def steady(
    effects: Sequence[Effect], celsius: ArrayLike, rate: float, reference: float
) -> tuple[FloatArray, FloatArray]:
    """Return what effects add (m, 3) at temperatures (m,), °C, and its slopes (m, 3, q) by their numbers.

    Output units, without force or turning. **Arguments:** `rate`: K/s at which the temperature has long been going, or
    0 where it has long been what it is; `reference`: °C from which effects count. Numbers are in the order of
    `numbers_of`, effect by effect.
    """
    celsius = np.atleast_1d(np.asarray(celsius, float))
    if not effects:
        return np.zeros((len(celsius), 3)), np.zeros((len(celsius), 3, 0))
    ends = np.pad(celsius, (0, -len(celsius) % _BUCKET), "edge")
    time = np.broadcast_to([-_LONG, 0.0], (len(ends), 2))
    still = np.zeros((len(ends), 2, 3))
    path = Stimulus(specific_force=still, angular_rate=still, temperature=ends[:, None] + rate * time,
                    temperature_rate=np.full((len(ends), 2), rate), time=time,
                    temperature_reference=reference)  # pyright: ignore # fmt: skip
    names = ",".join(effect.name for effect in effects)
    value, slopes = stored.call(_evaluated, f"steady {names}", tuple(effects), path)
    return np.asarray(value)[: len(celsius)], np.asarray(slopes)[: len(celsius)]


def _evaluated(effects: tuple[Effect, ...], path: Stimulus):
    value, slopes = 0.0, []
    for effect in effects:
        value = value + effect.term(path)[:, -1]
        numbers = jnp.concatenate([effect.coefficients, jnp.array([getattr(effect, name) for name in effect.inner])])
        slopes.append(derivatives_by_numbers(type(effect), lambda each: each.term(path)[:, -1], numbers))
    return value, jnp.concatenate(slopes, axis=-1)


def numbers_of(effect: Effect, owner: str, place: int) -> list[Name]:
    """Return the names of an effect's coefficients and inner parameters."""
    coefficients = [Name(owner, "coefficients", (k,), place) for k in range(effect.size)]
    return [*coefficients, *(Name(owner, name, (), place) for name in effect.inner)]
