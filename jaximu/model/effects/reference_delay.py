"""Reference delay: the reference is stamped late."""

from jaximu.model.effects.base import SetupEffect
from jaximu.model.shifted_time import at_times

__all__ = ["EFFECTS", "SetupReferenceDelay"]


class SetupReferenceDelay(SetupEffect):
    """What the reference says at t happened at t − δ, so at t the sensor is where the reference will be at t + δ.

    A gyroscope all of whose axes lag by τ looks the same with δ = −τ.
    """

    name = "setup.reference_delay"
    formula = "sensors at t + δ of the reference"
    unit = "s"
    size = 1
    needs = ("time",)
    excited_by = "motion with a reference"
    look_alikes = ("gyro.lag",)
    source = "definition"
    typical = 2e-3
    known = 0.1

    def act(self, stimulus, quantity):
        return at_times(stimulus, stimulus.need("time", self.name) + self.coefficients[0], self.name)

    def reach(self, duration):
        return float(abs(self.coefficients[0]))


EFFECTS = (SetupReferenceDelay,)
