"""Clock scale: the logger's clock runs fast or slow against the reference's."""

from jaximu.model.effects.time_offset import ShiftedTime


class SetupClockScale(ShiftedTime):
    """A sample stamped t was taken at t / (1 + c) of the reference's time: positive, and the logger's clock runs fast.

    Without a reference on a clock of its own it cannot be seen: rates times stamps are angles, so it is the
    gyroscope's scale.
    """

    name = "setup.clock_scale"
    formula = "sensors at t / (1 + c) of the reference"
    unit = "1"
    excited_by = "a long recording with a reference on its own clock; blind inside the gyroscope's scale without one"
    look_alikes = ("setup.reference_delay", "setup.table_rate_scale")
    source = "definition; frequency offset of an oscillator, IEEE Std 1139-2022"
    typical = 1e-4
    known = 1e-3
    recovery = "not undone: it belongs to the recording, whose time stamps must be corrected"

    def taken(self, stamps):
        return stamps / (1 + self.coefficients[0])

    def reach(self, duration):
        return super().reach(duration) * duration


EFFECTS = (SetupClockScale,)
