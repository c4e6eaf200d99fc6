"""Warm-up: a bias that dies away after power-on."""

from types import MappingProxyType

import jax.numpy as jnp

from jaximu.model.effects.base import BiasEffect, Inner, Scalar, pair


class _WarmUp(BiasEffect):
    """A bias that dies away with a time constant, from c at the reference time, which is power-on."""

    time_constant: Scalar

    common_name = "warm-up"
    formula = "c_i e^(−t/τ)"
    unit = "output"
    scope = "session"
    carries_on = True
    needs = ("time",)
    excited_by = "time from power-on"
    source = "IEEE Std 528-2019, warm-up time"
    inner = MappingProxyType(
        {
            "time_constant": Inner(
                "s", 120.0, 5.0, 5e3, "time in which it falls to 1/e", shares=(0.03, 0.08, 0.2, 0.5, 1.2)
            )
        }
    )

    def factor(self, stimulus):
        return jnp.exp(-stimulus.elapsed(self.name) / self.time_constant)


EFFECTS = AccelWarmUp, GyroWarmUp = pair(_WarmUp, "warm_up", (0.03, 0.003), "bias_ramp", "temperature")
