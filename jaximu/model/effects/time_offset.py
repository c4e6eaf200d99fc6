"""Time offset: accelerometer and gyroscope are stamped apart."""

from jaximu.model.effects.base import SetupEffect
from jaximu.model.shifted_time import at_times

__all__ = ["EFFECTS", "SetupTimeOffset"]


class SetupTimeOffset(SetupEffect):
    """A gyroscope sample stamped t was taken at t − δ; the accelerometer's stamps are right. Positive: stamped late."""

    name = "setup.time_offset"
    formula = "gyroscope at t − δ, accelerometer at t"
    unit = "s"
    size = 1
    scope = "session"
    needs = ("time",)
    excited_by = "motion with an accelerating accelerometer, or with a reference"
    look_alikes = ("gyro.lag",)
    source = "definition; Rehder et al., ICRA 2016 (temporal calibration)"
    typical = 2e-3
    recovery = "not undone: it belongs to the recording, whose time stamps must be corrected"

    def act(self, stimulus, quantity):
        if quantity != "angular_rate":
            return stimulus
        return at_times(stimulus, stimulus.need("time", self.name) - self.coefficients[0], self.name)

    def reach(self, duration):
        return float(abs(self.coefficients[0]))


EFFECTS = (SetupTimeOffset,)
