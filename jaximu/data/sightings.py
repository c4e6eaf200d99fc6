"""What is measured from outside at the ends of a filter's intervals: attitude and velocity, and the magnetic field.

At the end of an interval the unit has attitude C (body to level) and velocity v; ω and f are its rate and specific
force in the last sample. A reference's stamp is δ later, by the recording's clock: what it says holds of C Exp(ω δ) and
of v + (C f − g ẑ) δ. α turns the axes of the reference's body into the unit's, τ is the tilt of its vertical, r the
unit's place as seen from the point that is tracked, in the unit's axes, and ω′ the rate at the stamp, by the slope of
the last two samples:

    attitude Q    Exp(τ)ᵀ C Exp(ω δ) Exp(α)ᵀ = Q
    velocity V    Exp(τ)ᵀ (v + (C f − g ẑ) δ − C Exp(ω δ) (ω′ × r)) = V
    field m       Cᵀ h = m

m is the mean over a rest of what a calibrated magnetometer measures, in the unit's axes; h, the Earth's field in the
level frame, is the same in all of the recording.

A further kind is a subclass of `Sighting`: what it is off by, and the name of its noise. Nothing else knows of kinds.
"""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from jaximu.data.attitude import OF_REFERENCE, reference_numbers
from jaximu.ground.array_types import Array
from jaximu.ground.rotation import conjugate, exponential, logarithm, multiply, rotate
from jaximu.model.effects.lever_arm import AccelLeverArm
from jaximu.model.effects.magnetic_field import SetupMagneticField
from jaximu.model.sensor import Imu

__all__ = ["FROM_OUTSIDE", "SIZE", "AttitudeSeen", "FieldSeen", "Outside", "Sighting", "Standing", "VelocitySeen",
           "outside_numbers"]  # fmt: skip

FROM_OUTSIDE = (*OF_REFERENCE, AccelLeverArm, SetupMagneticField)
"""Effects that say how what measures from outside is placed; the unit's path is the same without them."""
SIZE = 9
"""Numbers of a `Standing` that follow from a unit's outputs: rate, specific force, angular acceleration."""


class Outside(NamedTuple):
    """How what measures from outside is placed.

    delay: s; scale: of the clocks; mounting, tilt (3,): rotation vectors, rad; arm (3,): m; field (3,): µT.
    """

    delay: Float[Array, ""]
    scale: Float[Array, ""]
    mounting: Float[Array, 3]
    tilt: Float[Array, 3]
    arm: Float[Array, 3]
    field: Float[Array, 3]

    @classmethod
    def of(cls, numbers: Float[Array, " q"]) -> Outside:
        """Return it from the numbers that `outside_numbers` returned."""
        delay, scale, *vectors = jnp.split(numbers, (1, 2, 5, 8, 11))
        return cls(delay[0], scale[0], *vectors)


def outside_numbers(imu: Imu) -> Float[Array, " q"]:
    """Return the numbers of a unit's set-up that `Outside` is made of."""
    return jnp.hstack(
        [*reference_numbers(imu), imu.coefficients(AccelLeverArm), imu.coefficients(SetupMagneticField)]
    )  # fmt: skip


class Standing(NamedTuple):
    """Where a unit is at the end of an interval: attitude (4,), body to level; velocity (3,), m/s, in the level frame.

    rate (rad/s) and force (m/s²), (3,): means over the last sample, body frame; acceleration (3,): rad/s²; half: s, of
    the last sample; gravity: m/s².
    """

    attitude: Float[Array, 4]
    velocity: Float[Array, 3]
    rate: Float[Array, 3]
    force: Float[Array, 3]
    acceleration: Float[Array, 3]
    half: Float[Array, ""]
    gravity: Float[Array, ""]

    def after(self, ahead: Float[Array, ""]) -> Standing:
        """Return where it is after some seconds, less than a sample."""
        pushed = rotate(self.attitude, self.force) - jnp.array([0.0, 0.0, 1.0]) * self.gravity
        turned = multiply(self.attitude, exponential(self.rate * ahead))
        return self._replace(attitude=turned, velocity=self.velocity + pushed * ahead)


class Sighting(eqx.Module):
    """What was measured close to the ends of intervals; leading axes.

    stamp: s, by the clock of what measured; end: s, of the interval, by the recording's. measured: 1 where there is
    one. value: what was measured. A subclass has the class attributes `noise`, the field of `Disturbances` with the
    standard deviation of each axis, and `absolute`: whether it is in a level frame of its own, whose heading counts.
    """

    stamp: Float[Array, " ..."]
    end: Float[Array, " ..."]
    measured: Float[Array, " ..."]
    value: Float[Array, "... _"]

    noise: ClassVar[str]
    absolute: ClassVar[bool] = True

    def off(self, standing: Standing, outside: Outside) -> Float[Array, 3]:
        """Return by how much a unit that stands so differs from what was measured."""
        raise NotImplementedError

    def placed(self, attitude: Float[Array, 4], outside: Outside) -> Float[Array, 4]:
        """Return the attitude that was measured, as far as it was, else the one given."""
        return attitude

    def _ahead(self, outside: Outside) -> Float[Array, ""]:
        return (self.stamp - outside.delay) * (1 + outside.scale) - self.end


class AttitudeSeen(Sighting):
    """A measured attitude: quaternion (..., 4) from its body to its level frame."""

    noise = "reference"

    def off(self, standing: Standing, outside: Outside) -> Float[Array, 3]:
        """Return the rotation vector, in the reference's body, from what was measured to what it should be (rad)."""
        unit = standing.after(self._ahead(outside)).attitude
        said = multiply(conjugate(exponential(outside.tilt)), multiply(unit, conjugate(exponential(outside.mounting))))
        return logarithm(multiply(conjugate(self.value), said))

    def placed(self, attitude: Float[Array, 4], outside: Outside) -> Float[Array, 4]:
        """Return the unit's attitude, to the level frame, as the reference has it."""
        return multiply(multiply(exponential(outside.tilt), self.value), exponential(outside.mounting))


class VelocitySeen(Sighting):
    """A measured velocity (..., 3) of the tracked point, in the reference's level frame (m/s)."""

    noise = "velocity"

    def off(self, standing: Standing, outside: Outside) -> Float[Array, 3]:
        """Return the velocity less what was measured (m/s), in the reference's level frame."""
        ahead = self._ahead(outside)
        there = standing.after(ahead)
        rate = standing.rate + standing.acceleration * (standing.half + ahead)
        swung = rotate(there.attitude, jnp.cross(rate, outside.arm))
        return rotate(conjugate(exponential(outside.tilt)), there.velocity - swung) - self.value


class FieldSeen(Sighting):
    """The magnetic field (..., 3) in the body frame (µT), as the mean over a rest that ends with the interval."""

    noise = "field"
    absolute = False

    def off(self, standing: Standing, outside: Outside) -> Float[Array, 3]:
        """Return the field less what was measured (µT), body frame."""
        return rotate(conjugate(standing.attitude), outside.field) - self.value

    def placed(self, attitude: Float[Array, 4], outside: Outside) -> Float[Array, 4]:
        """Return the attitude turned about the vertical to where the level parts of both fields point alike."""
        east, north, _ = rotate(attitude, self.value)
        along, across = (
            outside.field[0] * east + outside.field[1] * north, outside.field[1] * east - outside.field[0] * north
        )  # fmt: skip
        known = jnp.hypot(along, across) > 0
        angle = jnp.where(known, jnp.arctan2(across, jnp.where(known, along, 1.0)), 0.0)
        return multiply(exponential(jnp.array([0.0, 0.0, 1.0]) * angle), attitude)
