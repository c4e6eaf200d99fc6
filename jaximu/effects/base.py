"""The interface of an effect: one term of the forward model, written once and used four ways."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from jaximu._types import Array
from jaximu.sensor import Stimulus

__all__ = ["Effect"]


class Effect(eqx.Module):
    """One term of y = K u + b + Σ effects: absent when its coefficients are zero.

    A subclass states itself in class attributes and implements `term`. Coefficients are in output units per the stated
    SI quantity, so that they read alike for outputs in SI and in counts.
    """

    coefficients: Float[Array, " q"]

    name: ClassVar[str]  # catalogue name, "accel.…", "gyro.…" or "setup.…"
    formula: ClassVar[str]
    unit: ClassVar[str]  # of a coefficient; "output" stands for the triad's output unit
    size: ClassVar[int]  # number of coefficients q
    scope: ClassVar[str]  # "device", "session" or "fixture"
    excited_by: ClassVar[str]
    look_alikes: ClassVar[tuple[str, ...]]
    source: ClassVar[str]
    typical: ClassVar[float]  # a plausible size of a coefficient of an SI output, to scale it in a fit

    @classmethod
    def dormant(cls) -> Effect:
        """Return the effect with all coefficients zero."""
        return cls(jnp.zeros(cls.size))

    def term(self, stimulus: Stimulus) -> Float[Array, "... 3"]:
        """Return the term (..., 3), in output units, of stimuli with any leading axes."""
        raise NotImplementedError
