"""Warm-up: a bias that dies away after power-on."""

from types import MappingProxyType

import jax.numpy as jnp
from jaxtyping import Float

from jaximu._types import Array
from jaximu.effects.base import Effect, Inner

__all__ = ["EFFECTS", "AccelWarmUp", "GyroWarmUp"]


class _WarmUp(Effect):
    """A bias that dies away with a time constant, from c at the reference time, which is power-on."""

    time_constant: Float[Array, ""] | float

    formula = "c_i e^(−t/τ)"
    unit = "output"
    size = 3
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


class AccelWarmUp(_WarmUp):
    __doc__ = _WarmUp.__doc__
    name = "accel.warm_up"
    common_name = "warm-up"
    look_alikes = ("accel.bias_ramp", "accel.temperature")
    typical = 0.03


class GyroWarmUp(_WarmUp):
    __doc__ = _WarmUp.__doc__
    name = "gyro.warm_up"
    common_name = "warm-up"
    look_alikes = ("gyro.bias_ramp", "gyro.temperature")
    typical = 0.003


EFFECTS = (AccelWarmUp, GyroWarmUp)
