"""Scale step: the scale factor jumps at one instant."""

from types import MappingProxyType

from jaximu.model.effects.base import ScaleEffect, pair
from jaximu.model.effects.step import OnsetEffect


class _ScaleStep(OnsetEffect, ScaleEffect):
    """A scale factor that changes by c at the onset and stays (another range or filter, a supply that switched).

    The derivative by the onset is zero nearly everywhere: a fit searches it on a grid.
    """

    formula = "c_i {u}_i for t ≥ t0, else 0"
    unit = "output/({SI})"
    needs = ("time", "{input}")
    excited_by = "{motions} before and after"
    source = "Heaviside step; IEEE Std 528-2019, scale factor repeatability"
    inner = MappingProxyType(
        {"onset": OnsetEffect.inner["onset"]._replace(meaning="when the scale jumps, from the reference time")}
    )


EFFECTS = AccelScaleStep, GyroScaleStep = pair(_ScaleStep, "scale_step", (1e-3, 1e-3), "step", "scale_ramp")
