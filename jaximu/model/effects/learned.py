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
from jaximu.ground.rotation import Number, Numbers
from jaximu.model.effects.base import Effect, Inner, Scalar, pair

ZERO_CELSIUS = 273.15
SPLINES = 10
ROUGHNESS, SHAPES = np.linalg.eigh(np.diff(np.eye(SPLINES), 2, axis=0).T @ np.diff(np.eye(SPLINES), 2, axis=0))
"""Sum of squared second differences (10,) of each combination of splines, the columns of (10, 10)."""
SHAPES *= np.where(SHAPES[-1] < 0, -1.0, 1.0)  # an eigenvector's sign is anybody's choice, and files keep coefficients
# the two without roughness: a constant, and a straight line from −1 to 1
SHAPES[:, 0], SHAPES[:, 1] = 1.0, (2 * np.arange(SPLINES) - SPLINES + 1) / (SPLINES - 3)


def splines(share: Numbers) -> Float[Array, "... 10"]:
    """Return the values of the uniform cubic B-splines at shares (...) of the range, from 0 to 1; they add up to one.

    b(s) = ((2 − |s|)₊³ − 4 (1 − |s|)₊³) / 6, s counted in knots from the middle of each spline.
    """
    distance = jnp.abs(share[..., None] * (SPLINES - 3) + 1 - np.arange(SPLINES))
    return (jnp.maximum(2 - distance, 0) ** 3 - 4 * jnp.maximum(1 - distance, 0) ** 3) / 6


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
    called: ClassVar[str] = ""  # where it has a name of its own
    first: ClassVar[int] = 1  # of the shapes that are used: without the constant; 2: and without the straight line

    def __init_subclass__(cls, **kwargs):
        cls.common_name = cls.called or f"curve over {getattr(cls, 'words', '')}"
        cls.size = 3 * (SPLINES - cls.first)
        cls.__doc__ = Learned.__doc__
        super().__init_subclass__(**kwargs)

    def covariate(self, stimulus) -> Numbers:
        """Return what the curve depends on: (..., 1) for all axes alike, or (..., 3), each axis its own."""
        raise NotImplementedError

    def interval(self) -> tuple[Number | float, Number | float]:
        """Return the range that the curve was learned in, in the covariate's unit."""
        raise NotImplementedError

    @classmethod
    def spanning(cls, low: float, high: float) -> dict[str, float]:
        """Return the inner parameters of a curve whose covariate lies between these."""
        raise NotImplementedError

    @classmethod
    def roughness(cls) -> np.ndarray:
        """Return the sum of squared second differences of each shape (k,); a straight line is taken like the next."""
        return np.maximum(ROUGHNESS, ROUGHNESS[2])[cls.first :]

    def shapes(self, value: Numbers) -> Float[Array, "... k"]:
        """Return the curves (..., k) that an axis's coefficients multiply, at values (...) of the covariate."""
        # the range is where the data was, and not for a fit to move
        low, high = jax.lax.stop_gradient(self.interval())
        return splines(jnp.clip((value - low) / (high - low), 0.0, 1.0)) @ SHAPES[:, self.first :]

    def term(self, stimulus):
        return jnp.sum(self.shapes(self.covariate(stimulus)) * self.coefficients.reshape(3, -1), axis=-1)


class _Between(Learned):
    low: Scalar
    high: Scalar

    def interval(self):
        return self.low, self.high

    @classmethod
    def spanning(cls, low, high):
        return {"low": low, "high": high}


class _Around(Learned):
    reach: Scalar

    def interval(self):
        return -self.reach, self.reach

    @classmethod
    def spanning(cls, low, high):
        return {"reach": max(abs(low), abs(high))}


class _LearnedTemperature(_Between):
    formula = "s_i(T), a smooth curve between two temperatures"
    needs = ("temperature",)
    excited_by = "a change of temperature, up and down"
    words, covariate_unit = "temperature", "K"
    inner = MappingProxyType(
        {
            "low": Inner("K", 283.15, 200.0, 300.0, "absolute temperature below which the curve is constant"),
            "high": Inner("K", 313.15, 280.0, 420.0, "absolute temperature above which the curve is constant"),
        }
    )

    def covariate(self, stimulus):
        return stimulus.need("temperature", self.name)[..., None] + ZERO_CELSIUS


class _LearnedTime(_Between):
    formula = "s_i(t), a smooth curve between two times"
    scope = "session"
    needs = ("time",)
    excited_by = "time"
    words, covariate_unit, called = "time", "s", "bias drift along a curve"
    inner = MappingProxyType(
        {
            "low": Inner("s", 0.5, 0.0, 1e6, "time, from the reference time, before which the curve is constant"),
            "high": Inner("s", 300.0, 0.1, 1e7, "time, from the reference time, after which the curve is constant"),
        }
    )

    def covariate(self, stimulus):
        return stimulus.elapsed(self.name)[..., None]


class _LearnedTemperatureRate(_Around):
    formula = "s_i(dT/dt), a smooth curve"
    needs = ("temperature_rate",)
    excited_by = "ramps of temperature of several rates, up and down"
    words, covariate_unit = "the rate of temperature", "K/s"
    inner = MappingProxyType(
        {
            "reach": Inner(
                "K/s", 0.05, 1e-6, 10.0, "rate of temperature, of either sign, from which the curve is constant"
            )
        }
    )

    def covariate(self, stimulus):
        return stimulus.need("temperature_rate", self.name)[..., None]


class _LearnedForce(_Around):
    formula = "s_i(f_i), a smooth curve of the force along each axis"
    needs = ("specific_force",)
    excited_by = "many orientations"
    words, covariate_unit, first = "the specific force along each axis", "m/s^2", 2
    inner = MappingProxyType(
        {"reach": Inner("m/s^2", 10.0, 1.0, 1000.0, "force, of either sign, from which the curve is constant")}
    )

    def covariate(self, stimulus):
        return stimulus.need("specific_force", self.name)


class _ForceAlong(_LearnedForce):
    axis: ClassVar[int]

    def covariate(self, stimulus):
        return stimulus.need("specific_force", self.name)[..., self.axis, None]


class GyroLearnedRate(_Around):
    name = "gyro.learned_rate"
    formula = "s_i(ω_i), a smooth curve of the rate about each axis"
    needs = ("angular_rate",)
    excited_by = "turns at several rates, both ways"
    look_alikes = ("gyro.quadratic", "gyro.cubic", "gyro.asymmetry")
    typical = 1e-4
    words, covariate_unit, first = "the rate about each axis", "rad/s", 2
    inner = MappingProxyType(
        {"reach": Inner("rad/s", 5.0, 0.01, 1000.0, "rate, of either sign, from which the curve is constant")}
    )

    def covariate(self, stimulus):
        return stimulus.need("angular_rate", self.name)


AccelLearnedTemperature, GyroLearnedTemperature = pair(
    _LearnedTemperature, "learned_temperature", (1e-3, 1e-4), "temperature_squared", "temperature_cubed", "thermal_lag"
)
AccelLearnedTemperatureRate, GyroLearnedTemperatureRate = pair(
    _LearnedTemperatureRate, "learned_temperature_rate", (1e-3, 1e-4), "temperature_rate", "temperature_rate_squared"
)
AccelLearnedTime, GyroLearnedTime = pair(_LearnedTime, "learned_time", (1e-3, 1e-4), "bias_ramp", "warm_up", "step")


def _of_force(shape: type[_LearnedForce], name: str, *accelerometer_alike: str, **changes):
    """An effect on both triads; the gain of a gyroscope takes no force, so that a straight line is not left out."""
    alike = accelerometer_alike, ("g_sensitivity", "g_squared_sensitivity")
    both = {attribute: (value, value) for attribute, value in changes.items()}
    return pair(shape, name, (1e-3, 1e-4), alike=alike, first=(2, 1), **both)


def _of_force_along(axis: int):
    letter = "xyz"[axis]
    return _of_force(
        _ForceAlong,
        f"learned_force_{letter}",
        "cross_coupling",
        formula=f"s_i(f_{letter}), a smooth curve of the force along {letter}, on every axis",
        words=f"the specific force along {letter}",
        axis=axis,
    )


AccelLearnedForce, GyroLearnedForce = _of_force(_LearnedForce, "learned_force", "quadratic", "cubic", "asymmetry")
AccelLearnedForceX, GyroLearnedForceX = _of_force_along(0)
AccelLearnedForceY, GyroLearnedForceY = _of_force_along(1)
AccelLearnedForceZ, GyroLearnedForceZ = _of_force_along(2)

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
