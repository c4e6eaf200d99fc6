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

from jaximu.ground.array_types import Array
from jaximu.ground.rotation import (
    UP,
    Number,
    Numbers,
    Quaternion,
    Vector,
    conjugate,
    exponential,
    logarithm,
    multiply,
    rotate,
)
from jaximu.model.mounting import Mounting

SIZE = 9
"""Numbers of a `Standing` that follow from a unit's outputs: rate, specific force, angular acceleration."""


class Standing(NamedTuple):
    """Where a unit is at the end of an interval: attitude (4,), body to level; velocity (3,), m/s, in the level frame.

    rate (rad/s) and force (m/s²), (3,): means over the last sample, body frame; acceleration (3,): rad/s²; half: s, of
    the last sample; gravity: m/s².
    """

    attitude: Quaternion
    velocity: Vector
    rate: Vector
    force: Vector
    acceleration: Vector
    half: Number
    gravity: Number

    def after(self, ahead: Number) -> Standing:
        """Return where it is after some seconds, less than a sample."""
        pushed = rotate(self.attitude, self.force) - UP * self.gravity
        turned = multiply(self.attitude, exponential(self.rate * ahead))
        return self._replace(attitude=turned, velocity=self.velocity + pushed * ahead)


class Sighting(eqx.Module):
    """What was measured close to the ends of intervals; leading axes.

    stamp: s, by the clock of what measured; end: s, of the interval, by the recording's. measured: 1 where there is
    one. value: what was measured. A subclass has the class attributes `noise`, the field of `Disturbances` with the
    standard deviation of each axis, and `absolute`: whether it is in a level frame of its own, whose heading counts.
    """

    stamp: Numbers
    end: Numbers
    measured: Numbers
    value: Float[Array, "... _"]

    noise: ClassVar[str]
    absolute: ClassVar[bool] = True

    def off(self, standing: Standing, mounting: Mounting) -> Vector:
        """Return by how much a unit that stands so differs from what was measured."""
        raise NotImplementedError

    def placed(self, attitude: Quaternion, mounting: Mounting) -> Quaternion:
        """Return the attitude that was measured, as far as it was, else the one given."""
        return attitude

    def _ahead(self, mounting: Mounting) -> Number:
        return mounting.on_log(self.stamp) - self.end


class AttitudeSeen(Sighting):
    """A measured attitude: quaternion (..., 4) from its body to its level frame."""

    noise = "reference"

    def off(self, standing: Standing, mounting: Mounting) -> Vector:
        """Return the rotation vector, in the reference's body, from what was measured to what it should be (rad)."""
        expected = mounting.reported(standing.after(self._ahead(mounting)).attitude)
        return logarithm(multiply(conjugate(self.value), expected))

    def placed(self, attitude: Quaternion, mounting: Mounting) -> Quaternion:
        """Return the unit's attitude, to the level frame, as the reference has it."""
        return mounting.unit_attitude(self.value)


class VelocitySeen(Sighting):
    """A measured velocity (..., 3) of the tracked point, in the reference's level frame (m/s)."""

    noise = "velocity"

    def off(self, standing: Standing, mounting: Mounting) -> Vector:
        """Return the velocity less what was measured (m/s), in the reference's level frame."""
        ahead = self._ahead(mounting)
        there = standing.after(ahead)
        rate = standing.rate + standing.acceleration * (standing.half + ahead)
        swung = rotate(there.attitude, jnp.cross(rate, mounting.lever_arm))
        return rotate(conjugate(mounting.tilted), there.velocity - swung) - self.value


class FieldSeen(Sighting):
    """The magnetic field (..., 3) in the body frame (µT), as the mean over a rest that ends with the interval."""

    noise = "field"
    absolute = False

    def off(self, standing: Standing, mounting: Mounting) -> Vector:
        """Return the field less what was measured (µT), body frame."""
        return rotate(conjugate(standing.attitude), mounting.field) - self.value

    def placed(self, attitude: Quaternion, mounting: Mounting) -> Quaternion:
        """Return the attitude turned about the vertical to where the level parts of both fields point alike."""
        east, north, _ = rotate(attitude, self.value)
        eastward, northward, _ = mounting.field
        along, across = eastward * east + northward * north, northward * east - eastward * north
        known = jnp.hypot(along, across) > 0
        angle = jnp.where(known, jnp.arctan2(across, jnp.where(known, along, 1.0)), 0.0)
        return multiply(exponential(UP * angle), attitude)
