"""Reference filter: the reference's attitude is smoothed, as a tracker's or an inertial system's is."""

from dataclasses import replace

from jaximu.ground.differences import slopes
from jaximu.ground.errors import InputError
from jaximu.ground.rotation import conjugate, exponential, multiply, rotate
from jaximu.model.effects.base import SetupEffect

_SHARP = 1e-5
"""s²; a variance around zero counts as of a lag of 3 ms in the third order, so that there is a derivative at zero."""


def behind(variance, acceleration, jerk):
    """Return the rotation vector (..., 3), body frame, by which the truth stands behind what is smoothed.

    **Arguments:** `variance`: s²; `acceleration`, `jerk`: first and second derivative of the rate, rad/s² and rad/s³.
    """
    lag = (variance**2 + _SHARP**2) ** 0.25
    return variance * (lag / 3 * jerk - acceleration / 2)


class SetupReferenceFilter(SetupEffect):
    """The reference says a weighted mean of the attitudes before each instant; v is the variance of the weights, s².

    A filter delays, which is `setup.reference_delay`, and it spreads: a first-order lag has v = τ², a mean over T has
    T²/12, a Butterworth filter zero. What is spread lies v/2 ω̇ ahead of the truth, so motion at the circular frequency
    Ω looks smaller by v Ω²/2; the term of ω̈ is a first-order lag's, and counts little. A gyroscope with a filter of its
    own looks the same with −v.
    """

    name = "setup.reference_filter"
    formula = "R = R_said exp(−v/2 ω̇ + v√v/3 ω̈)"
    unit = "s^2"
    size = 1
    needs = ("angular_rate", "angular_acceleration", "time")
    excited_by = "slow and quick turns with a reference"
    look_alikes = ("setup.reference_delay",)
    source = "definition; expansion of a filter's response by its cumulants, log H = −s δ + s² v/2 − …"
    typical = 4e-4  # a first-order lag of 20 ms
    known = 1e-2
    cause = False

    def act(self, stimulus, quantity):
        rate, acceleration, time = self.needed(stimulus)
        if time.ndim == 0 or time.shape[-1] < 2:
            raise InputError(f"the effect {self.name} needs a path in time, not one instant.")
        vector = behind(self.coefficients[0], acceleration, slopes(acceleration, time))
        turn = exponential(vector)
        true = rotate(conjugate(turn), rate) + slopes(vector, time)
        stimulus = stimulus.changed(lambda force: rotate(conjugate(turn), force), "specific_force")
        stimulus = stimulus.changed(lambda attitude: multiply(attitude, turn), "attitude")
        return replace(stimulus, angular_rate=true, angular_acceleration=acceleration + slopes(true - rate, time))


EFFECTS = (SetupReferenceFilter,)
