"""Lag: a gyroscope that answers late, axis by axis."""

from jaximu.effects.base import Effect

__all__ = ["EFFECTS", "GyroLag"]


class GyroLag(Effect):
    """−τ_i ω̇_i: each axis's output is late by τ_i, to first order in the delay; a positive τ is a delay.

    A filter of small group delay and a late sampling are alike in this. Over a turn from rest to rest a lag common to
    all axes moves no angle but the order in which it is turned.
    """

    name = "gyro.lag"
    formula = "−τ_i ω̇_i"
    unit = "s"
    size = 3
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


EFFECTS = (GyroLag,)
