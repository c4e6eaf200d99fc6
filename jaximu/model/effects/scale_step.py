"""Scale step: the scale factor jumps at one instant."""

from types import MappingProxyType

import jax.numpy as jnp
from jaxtyping import Float

from jaximu.ground.array_types import Array
from jaximu.model.effects.base import Effect, Inner, pair

__all__ = ["EFFECTS", "AccelScaleStep", "GyroScaleStep"]


class _ScaleStep(Effect):
    """A scale factor that changes by c at the onset and stays (another range or filter, a supply that switched).

    The derivative by the onset is zero nearly everywhere: a fit searches it on a grid.
    """

    onset: Float[Array, "..."] | float

    formula = "c_i {u}_i for t ≥ t0, else 0"
    unit = "output/({SI})"
    scope = "session"
    needs = ("time", "{input}")
    excited_by = "{motions} before and after"
    source = "Heaviside step; IEEE Std 528-2019, scale factor repeatability"
    inner = MappingProxyType({
        "onset": Inner("s", 60.0, 0.0, 1e5, "when the scale jumps, from the reference time",
                       beginning=True)
    })  # fmt: skip

    @classmethod
    def grid(cls, extent):
        return tuple({"onset": time} for time in extent.boundaries)

    def term(self, stimulus):
        later = jnp.where(stimulus.elapsed(self.name) >= self.onset, 1.0, 0.0)[..., None]
        return self.coefficients * later * stimulus.need(self.needs[1], self.name)


EFFECTS = AccelScaleStep, GyroScaleStep = pair(_ScaleStep, "scale_step", (1e-3, 1e-3), "step", "scale_ramp")
