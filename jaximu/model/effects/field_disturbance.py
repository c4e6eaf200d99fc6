"""Field disturbance: for a while the field is another."""

from types import MappingProxyType

import jax.numpy as jnp

from jaximu.model.effects.base import Inner, Scalar
from jaximu.model.effects.magnetic_field import FieldEffect


class SetupFieldDisturbance(FieldEffect):
    """From the onset on, for the duration, the field of the place changes by c, in the level frame.

    Strength and dip change with it: something magnetic came near, or the unit came near it. The derivatives by onset
    and duration are zero nearly everywhere.
    """

    onset: Scalar
    duration: Scalar

    name = "setup.field_disturbance"
    formula = "h = h_said + Rᵀ c for t0 ≤ t < t0 + d"
    needs = ("magnetic_field", "attitude", "time")
    excited_by = "time, and many directions before and after"
    look_alikes = ("mag.hard_iron_step",)
    typical = 5.0
    inner = MappingProxyType(
        {
            "onset": Inner("s", 60.0, 0.0, 1e5, "when the field changes, from the recording's start", beginning=True),
            "duration": Inner("s", 60.0, 0.0, 1e5, "how long it stays changed"),
        }
    )

    def added(self, stimulus):
        since = stimulus.need("time", self.name) - self.onset
        inside = jnp.where((since >= 0) & (since < self.duration), 1.0, 0.0)[..., None]
        return inside * super().added(stimulus)


EFFECTS = (SetupFieldDisturbance,)
