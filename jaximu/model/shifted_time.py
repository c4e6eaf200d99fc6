"""A stimulus looked up at other times than its samples'."""

from dataclasses import replace

import jax.numpy as jnp

from jaximu.ground.differences import slopes
from jaximu.ground.errors import InputError
from jaximu.model.stimulus import Stimulus

__all__ = ["at_times"]

_FIELDS = ("specific_force", "angular_rate", "angular_acceleration", "attitude", "temperature", "temperature_rate",
           "vibration_power")  # fmt: skip


def _look_up(time, values, at):
    """Cubic Hermite interpolation of (n, m) values: smooth, so that it has a derivative by `at` also at a sample.

    Beyond the ends it stays at the outermost value.
    """
    last = time.shape[0] - 1
    # not `clip`, whose derivative is halved where `at` is the first or last sample
    at = jnp.where(at < time[0], time[0], jnp.where(at > time[-1], time[-1], at))
    place = jnp.clip(jnp.searchsorted(time, at, side="right") - 1, 0, last - 1)
    slope, step = slopes(values, time), (time[place + 1] - time[place])[:, None]
    x = (at - time[place])[:, None] / jnp.where(step > 0, step, 1.0)
    start, stop = values[place], values[place + 1]
    rise, fall = slope[place] * step, slope[place + 1] * step
    curve = (2 * x**3 - 3 * x**2 + 1) * start + (3 * x**2 - 2 * x**3) * stop
    return curve + (x**3 - 2 * x**2 + x) * rise + (x**3 - x**2) * fall


_look_up = jnp.vectorize(_look_up, signature="(n),(n,m),(k)->(k,m)")


def at_times(stimulus: Stimulus, at, name: str) -> Stimulus:
    """Return the stimulus at the times `at` (..., n) of its path, stamped as before.

    To third order in the interval between samples: half a sample's shift of a 5 Hz motion at 100 Hz is off by 1e-3 of
    its amplitude. Raises `InputError` for a stimulus that is no path.
    """
    time = stimulus.need("time", name)
    if time.ndim == 0 or time.shape[-1] < 2:
        raise InputError(f"the effect {name} needs a path in time, not one instant.")
    changed = {}
    for field in _FIELDS:
        value = getattr(stimulus, field)
        if value is not None:
            flat = value[..., None] if value.ndim == time.ndim else value
            if field == "attitude":  # q and −q are the same: neighbours of one sign
                along = jnp.sum(flat[..., 1:, :] * flat[..., :-1, :], axis=-1)
                sign = jnp.cumprod(jnp.where(along < 0, -1.0, 1.0), axis=-1)
                flat = jnp.concatenate([flat[..., :1, :], sign[..., None] * flat[..., 1:, :]], axis=-2)
            found = _look_up(time, flat, at)
            if field == "attitude":
                found = found / jnp.sqrt(jnp.sum(found**2, axis=-1, keepdims=True))
            changed[field] = found[..., 0] if value.ndim == time.ndim else found
    return replace(stimulus, **changed)
