"""Magnetic field: the Earth's, where the set-up says nothing of it."""

from dataclasses import replace

from jaximu.ground.rotation import conjugate, rotate
from jaximu.model.effects.base import SetupEffect


class FieldEffect(SetupEffect):
    """The field is another than the set-up says."""

    unit = "uT"
    needs = ("magnetic_field", "attitude")
    source = "definition"
    recovery = "not undone: it belongs to the place"

    def added(self, stimulus):
        """Return by how much (..., 3), µT, in the body frame: by the coefficients, in the level frame."""
        return rotate(conjugate(stimulus.need("attitude", self.name)), self.coefficients)

    def act(self, stimulus, quantity):
        if quantity != "magnetic_field":
            return stimulus
        field = stimulus.need("magnetic_field", self.name)
        return replace(stimulus, magnetic_field=field + self.added(stimulus))


class SetupMagneticField(FieldEffect):
    """The field of the place is h_0 beyond what the set-up says, the same at all times, in the level frame.

    Where the set-up says nothing of it, it is the Earth's field itself: its direction tells the heading.
    """

    name = "setup.magnetic_field"
    formula = "h = h_said + Rᵀ h_0"
    excited_by = "rests in several headings"
    look_alikes = ("setup.field_disturbance",)
    typical = 50.0
    known = 100.0
    cause = False


EFFECTS = (SetupMagneticField,)
