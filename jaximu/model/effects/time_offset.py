"""Time offset: accelerometer and gyroscope are stamped apart."""

from jaximu.model.effects.base import SetupEffect
from jaximu.model.shifted_time import at_times


class ShiftedTime(SetupEffect):
    """Samples that were taken at other times than the set-up's clock says."""

    size = 1
    needs = ("time",)

    def taken(self, stamps):
        """Return when samples of these stamps were taken, on the set-up's clock, s."""
        raise NotImplementedError

    def act(self, stimulus, quantity):
        return at_times(stimulus, self.taken(stimulus.need("time", self.name)), self.name)

    def reach(self, duration):
        return float(abs(self.coefficients[0]))


class SetupTimeOffset(ShiftedTime):
    """A gyroscope sample stamped t was taken at t − δ; the accelerometer's stamps are right. Positive: stamped late."""

    name = "setup.time_offset"
    formula = "gyroscope at t − δ, accelerometer at t"
    unit = "s"
    scope = "session"
    excited_by = "motion with an accelerating accelerometer, or with a reference"
    look_alikes = ("gyro.lag",)
    source = "definition; Rehder et al., ICRA 2016 (temporal calibration)"
    typical = 2e-3
    recovery = "not undone: it belongs to the recording, whose time stamps must be corrected"

    def taken(self, stamps):
        return stamps - self.coefficients[0]

    def act(self, stimulus, quantity):
        return super().act(stimulus, quantity) if quantity == "angular_rate" else stimulus


EFFECTS = (SetupTimeOffset,)
