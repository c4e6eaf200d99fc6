"""How a reference is mounted on a unit: turned, late, on another clock, tilted, smoothed, and away from it."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import ArrayLike, Float

from jaximu.ground.array_types import Array
from jaximu.ground.rotation import Number, Numbers, Quaternion, conjugate, exponential, multiply
from jaximu.ground.stored import compiled
from jaximu.model.effects.base import Effect
from jaximu.model.effects.clock_scale import SetupClockScale
from jaximu.model.effects.lever_arm import AccelLeverArm
from jaximu.model.effects.magnetic_field import SetupMagneticField
from jaximu.model.effects.reference_delay import SetupReferenceDelay
from jaximu.model.effects.reference_filter import SetupReferenceFilter
from jaximu.model.effects.reference_rotation import SetupReferenceRotation
from jaximu.model.effects.table_tilt import SetupTableTilt
from jaximu.model.sensor import Imu

MOUNTING_EFFECTS = (
    SetupReferenceRotation,
    SetupReferenceDelay,
    SetupTableTilt,
    SetupReferenceFilter,
    AccelLeverArm,
    SetupClockScale,
    SetupMagneticField,
)
"""Effects that say how what measures from outside is mounted, in the order of the fields of `Mounting`; the unit's path
is the same without them."""


class Mounting(NamedTuple):
    """How a reference is mounted on a unit; each field has the coefficients of one effect, and is zero without it."""

    rotation: Float[Array, 3] = np.zeros(3)  # rad: the unit's axes are the reference's turned by this rotation vector
    delay: Number = 0.0  # s, by which the reference's stamps are late
    tilt: Float[Array, 2] = np.zeros(2)  # rad, of the reference's level frame about its x and y axes
    filter_variance: Number = 0.0  # s², of the weights by which the reference is smoothed
    lever_arm: Float[Array, 3] = np.zeros(3)  # m, from the point that is tracked to the unit, in the unit's axes
    clock_scale: Number = 0.0  # by which the log's clock runs fast against the reference's
    field: Float[Array, 3] = np.zeros(3)  # µT, the magnetic field in the level frame

    @classmethod
    def of(cls, imu: Imu) -> Mounting:
        """Return what the effects of a unit say."""
        coefficients = map(imu.coefficients, MOUNTING_EFFECTS)
        return cls(*(numbers[0] if len(numbers) == 1 else numbers for numbers in coefficients))

    @classmethod
    def from_numbers(cls, numbers: Float[Array, " q"]) -> Mounting:
        """Return it from its numbers in one vector, as `jnp.hstack` puts them."""
        return ravel_pytree(cls())[1](numbers)

    @staticmethod
    def effects(**start: ArrayLike) -> tuple[Effect, ...]:
        """Return the effects of these fields, from start values."""
        kinds = zip(Mounting._fields, MOUNTING_EFFECTS, strict=True)
        return tuple(kind.make(start[name]) for name, kind in kinds if name in start)

    def on_log(self, stamps: Numbers) -> Numbers:
        """Return stamps of the reference on the log's clock."""
        return (stamps - self.delay) * (1 + self.clock_scale)

    def on_reference(self, times: Numbers) -> Numbers:
        """Return times of the log as the reference stamps them."""
        return times / (1 + self.clock_scale) + self.delay

    @property
    def turned(self) -> Float[Array, 4]:
        """The rotation from the unit's axes to the reference's."""
        return exponential(self.rotation)

    @property
    def tilted(self) -> Float[Array, 4]:
        """The rotation from the reference's level frame to the one that is level."""
        return exponential(jnp.append(self.tilt, 0.0))

    @compiled
    def unit_attitude(self, reported: Quaternion) -> Quaternion:
        """Return the unit's attitude, to the level frame, from the one that the reference reports."""
        return multiply(self.tilted, multiply(reported, self.turned))

    @compiled
    def reported(self, attitude: Quaternion) -> Quaternion:
        """Return what a reference reports of a unit that stands so."""
        return multiply(conjugate(self.tilted), multiply(attitude, conjugate(self.turned)))
