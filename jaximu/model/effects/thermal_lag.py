"""Thermal lag: the bias follows the temperature of a part that warms later than the thermometer."""

from types import MappingProxyType

import jax.numpy as jnp

from jaximu.ground.prefixes import running
from jaximu.model.effects.base import BiasEffect, Inner, Scalar, pair


class _ThermalLag(BiasEffect):
    """A bias in proportion to T_lag, which follows T − T_ref with a time constant: τ dT_lag/dt = (T − T_ref) − T_lag.

    The temperature is taken linear between samples, for which the state is exact. A recording starts in equilibrium.
    As τ → 0 this is a bias in proportion to temperature; for ramps it is that and one in proportion to −τ Ṫ.
    """

    time_constant: Scalar

    formula = "c_i T_lag, τ Ṫ_lag = (T − T_ref) − T_lag"
    unit = "output/K"
    needs = ("temperature", "time")
    excited_by = "up and down ramps of temperature"
    source = "first-order lag of a lumped thermal mass (Newton's law of cooling)"
    memory = 3
    inner = MappingProxyType(
        {
            "time_constant": Inner(
                "s", 120.0, 1.0, 1e4, "time the warming part lags behind", shares=(0.01, 0.03, 0.08, 0.2, 0.5, 1.2)
            )
        }
    )

    def lagged(self, stimulus):
        """Return T_lag (...), K, along the last axis."""
        warmth = stimulus.warmth(self.name)
        if warmth.ndim == 0:
            return warmth
        start = (stimulus.memory or {}).get(self.name)
        time = stimulus.need("time", self.name)
        # what is carried over is (state, temperature, time) of the sample before this path
        before = jnp.stack([warmth[..., 0], warmth[..., 0], time[..., 0]], axis=-1)
        before = before if start is None else jnp.where(jnp.isnan(start), before, start)
        temperature = jnp.concatenate([before[..., 1:2], warmth], axis=-1)
        share = jnp.diff(time, axis=-1, prepend=before[..., 2:3]) / self.time_constant
        tiny = share < 1e-6
        safe = jnp.where(tiny, 1.0, share)
        held = jnp.where(tiny, 1 - share / 2, -jnp.expm1(-safe) / safe)  # (1 − e^{−h/τ}) τ/h
        decay = jnp.exp(-share)
        drive = (1 - decay) * temperature[..., :-1] + (1 - held) * jnp.diff(temperature, axis=-1)

        def after(first, second):
            return first[0] * second[0], second[0] * first[1] + second[1]

        results = running(after, (jnp.moveaxis(decay, -1, 0), jnp.moveaxis(drive, -1, 0)))
        total_decay, total_drive = (jnp.moveaxis(result, 0, -1) for result in results)
        return total_decay * before[..., :1] + total_drive

    def factor(self, stimulus):
        return self.lagged(stimulus)

    def remember(self, stimulus):
        now = (self.lagged(stimulus), stimulus.warmth(self.name), stimulus.need("time", self.name))
        return jnp.stack([jnp.atleast_1d(path)[..., -1] for path in now], axis=-1)


class _ThermalLagSquared(_ThermalLag):
    """A bias in proportion to the square of T_lag: what bends beside a thermal lag, at the same time constant."""

    formula = "c_i T_lag², τ Ṫ_lag = (T − T_ref) − T_lag"
    unit = "output/K^2"
    excited_by = "up and down ramps over a wide range of temperature"
    cause = False
    shares = "thermal_lag"

    def factor(self, stimulus):
        return self.lagged(stimulus) ** 2


AccelThermalLag, GyroThermalLag = pair(_ThermalLag, "thermal_lag", (1e-3, 1e-4), "temperature", "thermal_hysteresis")
AccelThermalLagSquared, GyroThermalLagSquared = pair(
    _ThermalLagSquared, "thermal_lag_squared", (3e-5, 3e-6), "temperature_squared", "thermal_lag"
)
EFFECTS = AccelThermalLag, GyroThermalLag, AccelThermalLagSquared, GyroThermalLagSquared
