"""Thermal hysteresis: the bias on the way up is not the bias on the way down."""

from types import MappingProxyType

import jax.numpy as jnp

from jaximu.ground.prefixes import running
from jaximu.model.effects.base import BiasEffect, Inner, Scalar, pair


class _ThermalHysteresis(BiasEffect):
    """A bias in proportion to a play of half-width w on T − T_ref: it moves only once the temperature has pushed it.

    The play follows p_k = min(max(p_{k−1}, u_k − w), u_k + w), whatever the rate of temperature, and starts in the
    middle. As w → 0 this is a bias in proportion to temperature.
    """

    half_width: Scalar

    formula = "c_i p, p the play of half-width w on T − T_ref"
    unit = "output/K"
    needs = ("temperature",)
    excited_by = "up and down ramps of temperature"
    source = "play operator: Visintin, Differential Models of Hysteresis, 1994; IEEE Std 528-2019, hysteresis error"
    memory = 1
    inner = MappingProxyType(
        {
            "half_width": Inner(
                "K", 2.0, 0.1, 20.0, "half of the width of the loop", shares=(0.03, 0.06, 0.12, 0.24, 0.4)
            )
        }
    )

    def factor(self, stimulus):
        """Return the play (...), K, along the last axis."""
        warmth = stimulus.warmth(self.name)
        if warmth.ndim == 0:
            return warmth
        start = (stimulus.memory or {}).get(self.name)
        start = warmth[..., :1] if start is None else jnp.where(jnp.isnan(start), warmth[..., :1], start)

        def after(first, second):  # two clippings, one after the other, are a clipping
            return tuple(jnp.clip(bound, second[0], second[1]) for bound in first)

        forward = jnp.moveaxis(warmth, -1, 0)
        bounds = running(after, (forward - self.half_width, forward + self.half_width))
        return jnp.clip(start, *(jnp.moveaxis(bound, 0, -1) for bound in bounds))

    def remember(self, stimulus):
        return jnp.atleast_1d(self.factor(stimulus))[..., -1:]


EFFECTS = AccelThermalHysteresis, GyroThermalHysteresis = pair(
    _ThermalHysteresis, "thermal_hysteresis", (1e-3, 1e-4), "thermal_lag", "temperature"
)
