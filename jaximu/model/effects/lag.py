"""Lag: a gyroscope or magnetometer that answers late, axis by axis."""

import jax.numpy as jnp

from jaximu.model.effects.base import Effect


class GyroLag(Effect):
    """−τ_i ω̇_i: each axis's output is late by τ_i, to first order in the delay; a positive τ is a delay.

    A filter of small group delay and a late sampling are alike in this. Over a turn from rest to rest a lag common to
    all axes moves no angle but the order in which it is turned.
    """

    name = "gyro.lag"
    formula = "−τ_i ω̇_i"
    unit = "s"
    scope = "device"
    needs = ("angular_acceleration",)
    excited_by = "quick turns about changing axes"
    look_alikes = ("gyro.cross_coupling", "setup.reference_delay", "setup.time_offset")
    source = "IEEE Std 528-2019, frequency response and group delay; first-order expansion of a delay"
    typical = 1e-3
    plausible = 2.0  # from rest to rest a common lag is open to tens of ms, where this first order of it fails
    refers_to = "input"
    recovery = (
        "exactly where ω̇ is known; else ω̇ is taken by central differences of the samples, which lose (2πfΔt)²/6 of the "
        "term at frequency f: 1 % at a twenty-fifth of the sample rate, 7 % at a tenth; noise grows by up to τ/Δt"
    )

    def term(self, stimulus):
        return -self.coefficients * stimulus.need("angular_acceleration", self.name)


class MagLag(Effect):
    """τ_i (ω × h)_i: each axis's output is late by τ_i, to first order in the delay; a positive τ is a delay.

    A field that stays the same turns in the body frame as ḣ = −ω × h. Stamps that are late are a lag common to all
    axes.
    """

    name = "mag.lag"
    formula = "τ_i (ω × h)_i"
    unit = "s"
    scope = "device"
    needs = ("magnetic_field", "angular_rate")
    excited_by = "quick turns about changing axes"
    source = "first-order expansion of a delay; Troni and Whitcomb, IEEE/RSJ IROS 2013, ḣ = −ω × h"
    typical = 3e-3
    refers_to = "input"

    def term(self, stimulus):
        field, rate = self.needed(stimulus)
        return self.coefficients * jnp.cross(rate, field)


EFFECTS = (GyroLag, MagLag)
