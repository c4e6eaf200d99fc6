"""Learned effects: a smooth curve of one covariate on each axis, where no effect with a cause explains a misfit.

The curve is a cubic B-spline on a uniform grid of knots over the covariate's range. Its coefficients are not those of
the single splines but of their combinations in order of roughness (eigenvectors of the squared second differences,
Eilers and Marx, Statistical Science 11, 1996): the first two, a constant and a straight line, can be told from bias and
gain, and are left out where those stand for them.
"""

from types import MappingProxyType
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaximu.ground.array_types import Array
from jaximu.model.effects.base import Effect, Inner, on_triad, pair

__all__ = [
    "EFFECTS",
    "SHAPES",
    "AccelLearnedForce",
    "AccelLearnedForceX",
    "AccelLearnedForceY",
    "AccelLearnedForceZ",
    "AccelLearnedTemperature",
    "AccelLearnedTemperatureRate",
    "AccelLearnedTime",
    "GyroLearnedForce",
    "GyroLearnedForceX",
    "GyroLearnedForceY",
    "GyroLearnedForceZ",
    "GyroLearnedRate",
    "GyroLearnedTemperature",
    "GyroLearnedTemperatureRate",
    "GyroLearnedTime",
    "Learned",
]

ZERO_CELSIUS = 273.15
SPLINES = 10
ROUGHNESS, SHAPES = np.linalg.eigh(np.diff(np.eye(SPLINES), 2, axis=0).T @ np.diff(np.eye(SPLINES), 2, axis=0))
"""Sum of squared second differences (10,) of each combination of splines, the columns of (10, 10)."""
SHAPES *= np.where(SHAPES[-1] < 0, -1.0, 1.0)  # an eigenvector's sign is anybody's choice, and files keep coefficients
# the two without roughness: a constant, and a straight line from −1 to 1
SHAPES[:, 0], SHAPES[:, 1] = 1.0, (2 * np.arange(SPLINES) - SPLINES + 1) / (SPLINES - 3)


def splines(share: Float[Array, " ..."]) -> Float[Array, "... 10"]:
    """Return the values of the uniform cubic B-splines at shares (...) of the range, from 0 to 1; they add up to one.

    b(s) = ((2 − |s|)₊³ − 4 (1 − |s|)₊³) / 6, s counted in knots from the middle of each spline.
    """
    place = jnp.abs(share[..., None] * (SPLINES - 3) + 1 - np.arange(SPLINES))
    return (jnp.maximum(2 - place, 0) ** 3 - 4 * jnp.maximum(1 - place, 0) ** 3) / 6


class Learned(Effect):
    """A smooth curve of one covariate on each axis, without a cause: a cubic spline over the range it was learned in.

    Outside that range the curve goes on as the constant that it ends with. It is a bias that changes, or along an
    axis's own input a gain: what these cannot be told from is left out.
    """

    cause = False
    unit = "output"
    scope = "device"
    source = "P-splines: Eilers and Marx, Statistical Science 11, 1996, 89–121"
    words: ClassVar[str]  # what the curve depends on
    covariate_unit: ClassVar[str]
    first: ClassVar[int] = 1  # of the shapes that are used: without the constant; 2: and without the straight line

    def __init_subclass__(cls, **kwargs):
        cls.common_name = f"curve over {getattr(cls, 'words', '')}"
        super().__init_subclass__(**kwargs)

    def covariate(self, stimulus) -> Float[Array, "..."]:
        """Return what the curve depends on: (..., 1) for all axes alike, or (..., 3), each axis its own."""
        raise NotImplementedError

    def interval(self) -> tuple[Float[Array, ""] | float, Float[Array, ""] | float]:
        """Return the range that the curve was learned in, in the covariate's unit."""
        raise NotImplementedError

    @classmethod
    def spanning(cls, low: float, high: float) -> dict[str, float]:
        """Return the inner parameters of a curve whose covariate lies between these."""
        raise NotImplementedError

    @classmethod
    def roughness(cls) -> np.ndarray:
        """Return the sum of squared second differences of each shape (k,); a straight line is taken like the next."""
        found = ROUGHNESS[cls.first :].copy()
        found[: 2 - cls.first] = ROUGHNESS[2]
        return found

    def shapes(self, value: Float[Array, " ..."]) -> Float[Array, "... k"]:
        """Return the curves (..., k) that an axis's coefficients multiply, at values (...) of the covariate."""
        # the range is where the data was, and not for a fit to move
        low, high = jax.lax.stop_gradient(self.interval())
        return splines(jnp.clip((value - low) / (high - low), 0.0, 1.0)) @ SHAPES[:, self.first :]

    def term(self, stimulus):
        return jnp.sum(self.shapes(self.covariate(stimulus)) * self.coefficients.reshape(3, -1), axis=-1)


class _Between(Learned):
    low: Float[Array, "..."] | float
    high: Float[Array, "..."] | float

    size = 3 * (SPLINES - 1)

    def interval(self):
        return self.low, self.high

    @classmethod
    def spanning(cls, low, high):
        return {"low": low, "high": high}


class _Around(Learned):
    reach: Float[Array, "..."] | float

    def interval(self):
        return -self.reach, self.reach

    @classmethod
    def spanning(cls, low, high):
        return {"reach": max(abs(low), abs(high))}


class _LearnedTemperature(_Between):
    __doc__ = Learned.__doc__
    formula = "s_i(T), a smooth curve between two temperatures"
    needs = ("temperature",)
    excited_by = "a change of temperature, up and down"
    words, covariate_unit = "temperature", "K"
    inner = MappingProxyType({
        "low": Inner("K", 283.15, 200.0, 300.0, "absolute temperature below which the curve is constant"),
        "high": Inner("K", 313.15, 280.0, 420.0, "absolute temperature above which the curve is constant"),
    })  # fmt: skip

    def covariate(self, stimulus):
        return stimulus.need("temperature", self.name)[..., None] + ZERO_CELSIUS


class _LearnedTime(_Between):
    __doc__ = Learned.__doc__
    formula = "s_i(t), a smooth curve between two times"
    scope = "session"
    needs = ("time",)
    excited_by = "time"
    words, covariate_unit = "time", "s"
    inner = MappingProxyType({
        "low": Inner("s", 0.5, 0.0, 1e6, "time, from the reference time, before which the curve is constant"),
        "high": Inner("s", 300.0, 0.1, 1e7, "time, from the reference time, after which the curve is constant"),
    })  # fmt: skip

    def covariate(self, stimulus):
        return stimulus.elapsed(self.name)[..., None]


class _LearnedTemperatureRate(_Around):
    __doc__ = Learned.__doc__
    formula = "s_i(dT/dt), a smooth curve"
    size = 3 * (SPLINES - 1)
    needs = ("temperature_rate",)
    excited_by = "ramps of temperature of several rates, up and down"
    words, covariate_unit = "the rate of temperature", "K/s"
    inner = MappingProxyType({
        "reach": Inner("K/s", 0.05, 1e-6, 10.0, "rate of temperature, of either sign, from which the curve is constant")
    })  # fmt: skip

    def covariate(self, stimulus):
        return stimulus.need("temperature_rate", self.name)[..., None]


class _LearnedForce(_Around):
    __doc__ = Learned.__doc__
    formula = "s_i(f_i), a smooth curve of the force along each axis"
    size = 3 * (SPLINES - 2)
    needs = ("specific_force",)
    excited_by = "many orientations"
    words, covariate_unit, first = "the specific force along each axis", "m/s^2", 2
    inner = MappingProxyType({
        "reach": Inner("m/s^2", 10.0, 1.0, 1000.0, "force, of either sign, from which the curve is constant")
    })  # fmt: skip

    def covariate(self, stimulus):
        return stimulus.need("specific_force", self.name)


class _ForceAlong(_LearnedForce):
    axis: ClassVar[int]

    def covariate(self, stimulus):
        return stimulus.need("specific_force", self.name)[..., self.axis, None]


class _LearnedForceX(_ForceAlong):
    __doc__ = Learned.__doc__
    formula = "s_i(f_x), a smooth curve of the force along x, on every axis"
    words, axis = "the specific force along x", 0


class _LearnedForceY(_ForceAlong):
    __doc__ = Learned.__doc__
    formula = "s_i(f_y), a smooth curve of the force along y, on every axis"
    words, axis = "the specific force along y", 1


class _LearnedForceZ(_ForceAlong):
    __doc__ = Learned.__doc__
    formula = "s_i(f_z), a smooth curve of the force along z, on every axis"
    words, axis = "the specific force along z", 2


class GyroLearnedRate(_Around):
    __doc__ = Learned.__doc__
    name = "gyro.learned_rate"
    formula = "s_i(ω_i), a smooth curve of the rate about each axis"
    size = 3 * (SPLINES - 2)
    needs = ("angular_rate",)
    excited_by = "turns at several rates, both ways"
    look_alikes = ("gyro.quadratic", "gyro.cubic", "gyro.asymmetry")
    typical = 1e-4
    words, covariate_unit, first = "the rate about each axis", "rad/s", 2
    inner = MappingProxyType({
        "reach": Inner("rad/s", 5.0, 0.01, 1000.0, "rate, of either sign, from which the curve is constant")
    })  # fmt: skip

    def covariate(self, stimulus):
        return stimulus.need("angular_rate", self.name)


AccelLearnedTemperature, GyroLearnedTemperature = pair(
    _LearnedTemperature, "learned_temperature", (1e-3, 1e-4), "temperature_squared", "temperature_cubed", "thermal_lag"
)
AccelLearnedTemperatureRate, GyroLearnedTemperatureRate = pair(
    _LearnedTemperatureRate, "learned_temperature_rate", (1e-3, 1e-4), "temperature_rate", "temperature_rate_squared"
)
AccelLearnedTime, GyroLearnedTime = pair(_LearnedTime, "learned_time", (1e-3, 1e-4), "bias_ramp", "warm_up", "step")
AccelLearnedForce = on_triad(_LearnedForce, "accel.learned_force", 1e-3, ("quadratic", "cubic", "asymmetry"))
AccelLearnedForceX = on_triad(_LearnedForceX, "accel.learned_force_x", 1e-3, ("cross_coupling",))
AccelLearnedForceY = on_triad(_LearnedForceY, "accel.learned_force_y", 1e-3, ("cross_coupling",))
AccelLearnedForceZ = on_triad(_LearnedForceZ, "accel.learned_force_z", 1e-3, ("cross_coupling",))
# the gain of a gyroscope takes no force
_UNLIKE_GAIN = {"size": 3 * (SPLINES - 1), "first": 1}
_FORCES = ("g_sensitivity", "g_squared_sensitivity")
GyroLearnedForce = on_triad(_LearnedForce, "gyro.learned_force", 1e-4, _FORCES, **_UNLIKE_GAIN)
GyroLearnedForceX = on_triad(_LearnedForceX, "gyro.learned_force_x", 1e-4, _FORCES, **_UNLIKE_GAIN)
GyroLearnedForceY = on_triad(_LearnedForceY, "gyro.learned_force_y", 1e-4, _FORCES, **_UNLIKE_GAIN)
GyroLearnedForceZ = on_triad(_LearnedForceZ, "gyro.learned_force_z", 1e-4, _FORCES, **_UNLIKE_GAIN)

EFFECTS = (
    AccelLearnedTemperature,
    AccelLearnedTemperatureRate,
    AccelLearnedTime,
    AccelLearnedForce,
    AccelLearnedForceX,
    AccelLearnedForceY,
    AccelLearnedForceZ,
    GyroLearnedTemperature,
    GyroLearnedTemperatureRate,
    GyroLearnedTime,
    GyroLearnedForce,
    GyroLearnedForceX,
    GyroLearnedForceY,
    GyroLearnedForceZ,
    GyroLearnedRate,
)
