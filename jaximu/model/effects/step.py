"""Step: the bias jumps at one instant."""

from types import MappingProxyType

import jax.numpy as jnp

from jaximu.model.effects.base import BiasEffect, Inner, Scalar, pair


class OnsetEffect(BiasEffect):
    """An error that begins at one instant and stays.

    The derivative by the onset is zero nearly everywhere: a fit searches it on a grid.
    """

    onset: Scalar

    scope = "session"
    inner = MappingProxyType(
        {"onset": Inner("s", 60.0, 0.0, 1e5, "when the bias jumps, from the reference time", beginning=True)}
    )

    @classmethod
    def grid(cls, extent):
        return tuple({"onset": time} for time in extent.boundaries)

    def factor(self, stimulus):
        return jnp.where(stimulus.elapsed(self.name) >= self.onset, 1.0, 0.0)


class _Step(OnsetEffect):
    """A bias that jumps by c at the onset and stays (a knock, a supply that switched, a popcorn defect).

    The derivative by the onset is zero nearly everywhere: a fit searches it on a grid.
    """

    common_name = "bias step"
    formula = "c_i for t ≥ t0, else 0"
    unit = "output"
    needs = ("time",)
    excited_by = "time"
    source = "Heaviside step; IEEE Std 528-2019, bias repeatability within a run"


AccelStep, GyroStep = pair(_Step, "step", (0.03, 0.003), "bias_ramp")


class MagHardIronStep(_Step):
    """Hard iron that jumps by c at the onset and stays: iron or a magnet was put to the unit, or taken off it.

    The derivative by the onset is zero nearly everywhere: a fit searches it on a grid.
    """

    name = "mag.hard_iron_step"
    common_name = "hard-iron step"
    look_alikes = ("mag.current", "mag.temperature", "setup.field_disturbance")
    excited_by = "time, and many directions before and after"
    source = "Heaviside step; hard iron as in Gebre-Egziabher et al., J. Aerospace Eng. 19 (2006)"
    typical = 5.0


EFFECTS = (AccelStep, GyroStep, MagHardIronStep)
