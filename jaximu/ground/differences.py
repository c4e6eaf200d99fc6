"""Rates of change from samples, values between them, and derivatives with the value; on the host JAX is not loaded."""

from collections.abc import Callable
from typing import Any

from jaxtyping import Float

from jaximu.ground.tracing import array_module


def slopes(values: Float[Any, "... n m"], time: Float[Any, "... n"]) -> Float[Any, "... n m"]:
    """Return dv/dt at every sample: of the parabola through it and its neighbours, one-sided at the ends.

    Second order in the interval, also where stamps are uneven; for even ones the central difference. Zero where stamps
    do not increase (padding) and for a path of one sample.
    """
    numerics = array_module(values, time)
    if time.shape[-1] < 2:
        return numerics.zeros_like(values)
    step = numerics.diff(time, axis=-1)[..., None]
    rising = step > 0
    chord = numerics.where(rising, numerics.diff(values, axis=-2) / numerics.where(rising, step, 1.0), 0.0)
    before, after = step[..., :-1, :], step[..., 1:, :]
    span = before + after
    weighted = after * chord[..., :-1, :] + before * chord[..., 1:, :]
    inner = numerics.where(span > 0, weighted / numerics.where(span > 0, span, 1.0), 0.0)
    return numerics.concatenate([chord[..., :1, :], inner, chord[..., -1:, :]], axis=-2)


def midpoints(values: Float[Any, "n ..."]) -> Float[Any, "n-1 ..."]:
    """Return the means of neighbours along the first axis."""
    return (values[1:] + values[:-1]) / 2


def interpolated(time: Float[Any, " n"], values: Float[Any, "n k"], wanted: Float[Any, "..."]) -> Float[Any, "... k"]:
    """Return values at other times, along straight lines; the first and last value beyond the ends."""
    numerics = array_module(time, values, wanted)
    return numerics.stack([numerics.interp(wanted, time, column) for column in values.T], axis=-1)


def value_and_jacobian(function: Callable[[Any], Any], at: Any) -> tuple[Any, Any]:
    """Return what a function of a vector makes of it, and its derivatives there (forward mode), traced once."""
    import jax

    def twice(vector):
        value = function(vector)
        return value, value

    jacobian, value = jax.jacfwd(twice, has_aux=True)(at)
    return value, jacobian
