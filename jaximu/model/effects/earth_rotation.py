"""Earth rotation: what the gyroscope feels of it, where the motion is told against the ground."""

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.rotation import conjugate, rotate
from jaximu.model.effects.base import Effect

EARTH_RATE = 7.292115e-5
"""Rate of the Earth's rotation, rad/s (WGS 84)."""
_DEFLECTED = 1e-3
"""Share of it by which the vertical part is uncertain: plumb lines and attitudes are off by as much."""


class GyroEarthRotation(Effect):
    """Rᵀ ω_E: the Earth's rotation in the body frame.

    Coefficients: ω_E in the session's level frame, whose heading is free: (0, cos φ, sin φ) · 7.292115e-5 rad/s at
    latitude φ with x east, y north, z up. Not for a stimulus whose angular rate contains the Earth's already.
    """

    name = "gyro.earth_rotation"
    common_name = "offset by the Earth's rotation"
    formula = "Rᵀ ω_E"
    unit = "rad/s"
    scope = "session"
    needs = ("attitude",)
    excited_by = "orientations at rest"
    look_alikes = ("gyro.g_sensitivity",)
    stated_by = "--latitude"
    source = "WGS 84 (NGA.STND.0036), mean angular velocity of the Earth"
    typical = EARTH_RATE
    possible = EARTH_RATE
    refers_to = "input"

    @classmethod
    def at(cls, latitude: float) -> tuple[Effect, FloatArray]:
        """Return it at a latitude (degrees) in a level frame of unknown heading, and its standard deviations (3,).

        Upwards it is known; the horizontal part lies in any direction.
        """
        up, level = np.sin(np.radians(latitude)), np.abs(np.cos(np.radians(latitude)))
        shares = np.array([level, level, 0.0]) / np.sqrt(2) + _DEFLECTED
        return cls.make([0.0, 0.0, EARTH_RATE * up]), EARTH_RATE * shares

    def term(self, stimulus):
        return rotate(conjugate(stimulus.need("attitude", self.name)), self.coefficients)


EFFECTS = (GyroEarthRotation,)
