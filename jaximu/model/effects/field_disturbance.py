"""Field disturbance: for a while the field is another."""

from dataclasses import replace
from types import MappingProxyType

import jax.numpy as jnp
from jaxtyping import Float

from jaximu.ground.array_types import Array
from jaximu.ground.rotation import conjugate, rotate
from jaximu.model.effects.base import Inner, SetupEffect

__all__ = ["EFFECTS", "SetupFieldDisturbance"]


class SetupFieldDisturbance(SetupEffect):
    """From the onset on, for the duration, the field of the place changes by c, in the level frame.

    Strength and dip change with it: something magnetic came near, or the unit came near it. The derivatives by onset
    and duration are zero nearly everywhere.
    """

    onset: Float[Array, "..."] | float
    duration: Float[Array, "..."] | float

    name = "setup.field_disturbance"
    formula = "h = h_said + Rᵀ c for t0 ≤ t < t0 + d"
    unit = "uT"
    needs = ("magnetic_field", "attitude", "time")
    excited_by = "time, and many directions before and after"
    look_alikes = ("mag.hard_iron_step",)
    source = "definition"
    typical = 5.0
    recovery = "not undone: it belongs to the place"
    inner = MappingProxyType({
        "onset": Inner("s", 60.0, 0.0, 1e5, "when the field changes, from the recording's start", beginning=True),
        "duration": Inner("s", 60.0, 0.0, 1e5, "how long it stays changed"),
    })  # fmt: skip

    def act(self, stimulus, quantity):
        if quantity != "magnetic_field":
            return stimulus
        attitude, since = stimulus.need("attitude", self.name), stimulus.need("time", self.name) - self.onset
        inside = jnp.where((since >= 0) & (since < self.duration), 1.0, 0.0)[..., None]
        added = rotate(conjugate(attitude), jnp.broadcast_to(self.coefficients, (*attitude.shape[:-1], 3)))
        return replace(stimulus, magnetic_field=stimulus.need("magnetic_field", self.name) + inside * added)


EFFECTS = (SetupFieldDisturbance,)
