"""Magnetic field: the Earth's, where the set-up says nothing of it."""

from dataclasses import replace

import jax.numpy as jnp

from jaximu.ground.rotation import conjugate, rotate
from jaximu.model.effects.base import SetupEffect

__all__ = ["EFFECTS", "SetupMagneticField"]


class SetupMagneticField(SetupEffect):
    """The field of the place is h_0 beyond what the set-up says, the same at all times, in the level frame.

    Where the set-up says nothing of it, it is the Earth's field itself: its direction tells the heading.
    """

    name = "setup.magnetic_field"
    formula = "h = h_said + Rᵀ h_0"
    unit = "uT"
    needs = ("magnetic_field", "attitude")
    excited_by = "rests in several headings"
    look_alikes = ("setup.field_disturbance",)
    source = "definition"
    typical = 50.0
    known = 100.0
    recovery = "not undone: it belongs to the place"
    cause = False

    def act(self, stimulus, quantity):
        if quantity != "magnetic_field":
            return stimulus
        attitude = stimulus.need("attitude", self.name)
        added = rotate(conjugate(attitude), jnp.broadcast_to(self.coefficients, (*attitude.shape[:-1], 3)))
        return replace(stimulus, magnetic_field=stimulus.need("magnetic_field", self.name) + added)


EFFECTS = (SetupMagneticField,)
