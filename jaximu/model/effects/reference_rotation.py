"""Reference rotation: the unit is mounted turned against the body whose attitude the reference tells."""

from jaximu.ground.rotation import conjugate, exponential, multiply, rotate
from jaximu.model.effects.base import SetupEffect


class SetupReferenceRotation(SetupEffect):
    """The unit's axes are the reference's body axes turned by the rotation vector α, the same at all times.

    Where all of both gains is free it is inside them; by hand the accelerometer's gain is lower triangular, which sets
    the unit's axes, and then it is the mounting.
    """

    name = "setup.reference_rotation"
    formula = "u = exp(α)ᵀ u_said"
    unit = "rad"
    needs = ("specific_force", "angular_rate")
    excited_by = "rotations about two axes, with a reference"
    source = "definition"
    typical = 1e-3
    known = 0.5
    cause = False

    def act(self, stimulus, quantity):
        self.needed(stimulus)
        turn = exponential(self.coefficients)
        stimulus = stimulus.changed(lambda attitude: multiply(attitude, turn), "attitude")
        return stimulus.changed(
            lambda vectors: rotate(conjugate(turn), vectors), "specific_force", "angular_rate", "angular_acceleration"
        )


EFFECTS = (SetupReferenceRotation,)
