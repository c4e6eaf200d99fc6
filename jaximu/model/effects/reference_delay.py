"""Reference delay: the reference is stamped late."""

from jaximu.model.effects.time_offset import ShiftedTime


class SetupReferenceDelay(ShiftedTime):
    """What the reference says at t happened at t − δ, so at t the sensor is where the reference will be at t + δ.

    A gyroscope all of whose axes lag by τ looks the same with δ = −τ.
    """

    name = "setup.reference_delay"
    formula = "sensors at t + δ of the reference"
    unit = "s"
    excited_by = "motion with a reference"
    look_alikes = ("gyro.lag",)
    source = "definition"
    typical = 2e-3
    known = 0.1

    def taken(self, stamps):
        return stamps + self.coefficients[0]


EFFECTS = (SetupReferenceDelay,)
