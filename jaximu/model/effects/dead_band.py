"""Dead band: a gyroscope that does not answer to slow rates."""

import jax.numpy as jnp

from jaximu.model.effects.base import Effect


class GyroDeadBand(Effect):
    """No output of an axis while |ω_i| < δ_i (lock-in, stiction of a digital threshold).

    ω is the true rate, before a lag or anything else. The derivative by δ is zero nearly everywhere, also at δ = 0: a
    fit searches δ on a grid.
    """

    name = "gyro.dead_band"
    formula = "−ω_i for |ω_i| < δ_i, else 0"
    unit = "rad/s"
    scope = "device"
    needs = ("angular_rate",)
    excited_by = "rates slower than the band"
    source = "IEEE Std 528-2019, dead band"
    typical = 2e-3
    probes = (3e-4, 1e-3, 3e-3, 1e-2, 3e-2)
    refers_to = "input"
    invertible = False
    recovery = "outside of the band exactly; inside, what was not put out is lost and reads as no rotation"

    def term(self, stimulus):
        rate = stimulus.need("angular_rate", self.name)
        return jnp.where(jnp.abs(rate) < self.coefficients, -rate, 0.0)


EFFECTS = (GyroDeadBand,)
