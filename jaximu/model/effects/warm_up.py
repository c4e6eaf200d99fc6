"""Warm-up: a bias that dies away after power-on."""

from types import MappingProxyType

import jax.numpy as jnp
from jaxtyping import Float

from jaximu.ground.array_types import Array
from jaximu.model.effects.base import Effect, Inner, pair

__all__ = ["EFFECTS", "AccelWarmUp", "GyroWarmUp"]


class _WarmUp(Effect):
    """A bias that dies away with a time constant, from c at the reference time, which is power-on."""

    time_constant: Float[Array, "..."] | float

    common_name = "warm-up"
    formula = "c_i e^(−t/τ)"
    unit = "output"
    scope = "session"
    needs = ("time",)
    excited_by = "time from power-on"
    source = "IEEE Std 528-2019, warm-up time"
    inner = MappingProxyType({"time_constant": Inner("s", 120.0, 5.0, 5e3, "time in which it falls to 1/e")})

    @classmethod
    def grid(cls, extent):
        return tuple({"time_constant": extent.duration * share} for share in (0.03, 0.08, 0.2, 0.5, 1.2))

    def term(self, stimulus):
        return self.coefficients * jnp.exp(-stimulus.elapsed(self.name) / self.time_constant)[..., None]


EFFECTS = AccelWarmUp, GyroWarmUp = pair(_WarmUp, "warm_up", (0.03, 0.003), "bias_ramp", "temperature")
