"""`Motion`: what a unit goes through, as a function of time that can be looked up anywhere.

A motion is a sequence of segments, in each of which the body turns about one axis fixed in it (or rests), or about an
axis that moves, and its rotation centre may move along a straight line; temperature runs along knots; vibration is a
sum of tones. Rates, angular accelerations and specific force are derivatives of attitude and position, taken by
automatic differentiation in time, so that they belong together whatever is put into a motion.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaximu.ground import stored
from jaximu.ground.array_types import Array, FloatArray
from jaximu.ground.errors import InputError
from jaximu.ground.rotation import conjugate, exponential, logarithm, multiply, rotate
from jaximu.ground.tracing import padded_size, part_of
from jaximu.model.effects.earth_rotation import EARTH_RATE
from jaximu.model.stimulus import Stimulus

BLOCKS = (4096, 16384, 65536)
_OF_SEGMENTS = ("start", "duration", "attitude", "rotation", "ramp", "displacement", "bend")


def earth_rate(latitude: float) -> FloatArray:
    """Return the Earth's rotation (3,), rad/s, at a latitude (rad) in the level frame x east, y north, z up."""
    return EARTH_RATE * np.array([0.0, np.cos(latitude), np.sin(latitude)])


def field_of(strength: float, dip: float) -> FloatArray:
    """Return the Earth's field (3,), µT, of a strength (µT) and dip (degrees), in the level frame, y magnetic north."""
    return strength * np.array([0.0, np.cos(np.radians(dip)), -np.sin(np.radians(dip))])


class Motion(eqx.Module):
    """A motion; arrays are padded alike within one protocol, so motions stack into a batch.

    Segments m: start (m,) s, duration (m,) s, attitude (m, 4) at its start (body to level frame), rotation (m, 3) the
    rotation vector turned through (body frame, rad), ramp (m,) the share of the duration in which the rate rises, and
    again falls (1/2: no constant part), displacement (m, 3) of the rotation centre (level frame, m). bend (m, 3), or
    (0, 3) where no segment has any: the rotation vector (rad) by which the body leans aside half way, so that the axis
    of its rate moves. Knots k:
    temperature_time (k,) s, temperature (k,) °C, ambient (k,) °C. Tones v: frequency (v,) Hz, acceleration (v, 3) and
    rocking (v, 3) amplitudes in the body frame (m/s², rad), phase (v, 2) rad, window (v, 2) s with edges of one second.
    gravity () m/s², earth (3,) rad/s and field (3,) µT in the level frame. Knots j: current_time (j,) s and
    current (j,) A.
    """

    start: Float[Array, " m"]
    duration: Float[Array, " m"]
    attitude: Float[Array, "m 4"]
    rotation: Float[Array, "m 3"]
    ramp: Float[Array, " m"]
    displacement: Float[Array, "m 3"]
    bend: Float[Array, "n 3"]
    temperature_time: Float[Array, " k"]
    temperature: Float[Array, " k"]
    ambient: Float[Array, " k"]
    frequency: Float[Array, " v"]
    acceleration: Float[Array, "v 3"]
    rocking: Float[Array, "v 3"]
    phase: Float[Array, "v 2"]
    window: Float[Array, "v 2"]
    gravity: Float[Array, ""]
    earth: Float[Array, 3]
    field: Float[Array, 3]
    current_time: Float[Array, " j"]
    current: Float[Array, " j"]

    @property
    def length(self) -> float:
        """Duration in seconds."""
        return float(np.sum(self.duration))

    def samples(self, rate: float) -> int:
        """Return the number of samples at `rate` (Hz). Raises `InputError` for what is no rate."""
        if not (np.isfinite(rate) and rate > 0):
            raise InputError(f"the sample rate must be a positive number of Hz, found {rate}.")
        return round(self.length * rate)

    def padded(self) -> Motion:
        """Return the motion with segments that never begin: few numbers of segments, and few programs."""
        rows, count = np.arange(padded_size(len(self.start))), len(self.start)
        segments = {name: values for name in _OF_SEGMENTS if len(values := getattr(self, name))}
        longer = part_of(segments, np.minimum(rows, count - 1))
        return replace(self, **longer | {"start": np.where(rows < count, longer["start"], np.inf)})

    def block(self, first, rate, length: int) -> Stimulus:
        """Return `length` samples from number `first` on, stamped number/rate.

        A stamp is in the middle of its sample, and the motion begins with sample 0: half an interval before its stamp.
        """
        time = (first + jnp.arange(length)) / rate
        return replace(self.at(time + 0.5 / rate, 1 / rate), time=time)

    def stimulus(self, rate: float) -> Stimulus:
        """Return the whole motion at `rate` (Hz), as NumPy arrays."""
        samples = self.samples(rate)
        length, motion = block_length(samples), self.padded()
        block = partial(Motion.block, length=length)
        blocks = [stored.call(block, f"motion {length}", motion, float(k), rate) for k in range(0, samples, length)]
        return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:samples], *blocks)

    def attitude_at(self, time: Float[Array, " n"]) -> Float[Array, "n 4"]:
        """Return the attitude (n, 4), body to level frame."""
        segment, x = self._segment(time)
        turned = exponential(smooth_course(x, self.ramp[segment])[:, None] * self.rotation[segment])
        attitude = multiply(self.attitude[segment], turned)
        if self.bend.shape[0]:
            aside = 64 * (x * (1 - x)) ** 3  # with its first two derivatives zero at both ends, and one half way
            attitude = multiply(attitude, exponential(aside[:, None] * self.bend[segment]))
        if self.frequency.shape[0]:
            envelope, phase = self._tone(time)
            rocking = jnp.sum((envelope * jnp.sin(phase + self.phase[:, 1]))[..., None] * self.rocking, axis=1)
            attitude = multiply(attitude, exponential(rocking))
        return attitude

    def displacement_at(self, time: Float[Array, " n"]) -> Float[Array, "n 3"]:
        """Return how far the rotation centre is (level frame, m) from where its segment began."""
        segment, x = self._segment(time)
        return smooth_course(x, self.ramp[segment])[:, None] * self.displacement[segment]

    def at(self, time: Float[Array, " n"], interval: Float[Array, ""] | float) -> Stimulus:
        """Return what the sensor goes through at the stamps `time` of samples `interval` seconds long.

        A sample stands for the time from half an interval before its stamp to half an interval after. Its angular rate
        is the mean over that time, as a gyroscope that integrates gives it (against inertial space where the Earth
        turns): Log(R(before)ᵀ R(after))/interval less coning, interval²/12 ω × dω/dt, which is zero where the axis
        stays. All else belongs to the stamp.
        """
        half = interval / 2
        edges = jnp.concatenate([time[:1] - half, time + half])
        # the barriers keep XLA from recomputing an attitude for every number that depends on it (five times faster)
        attitudes, attitude = jax.lax.optimization_barrier((self.attitude_at(edges), self.attitude_at(time)))
        turning = exponential(self.earth * interval)
        step = multiply(conjugate(attitudes[:-1]), multiply(turning, attitudes[1:]))
        turned = logarithm(jax.lax.optimization_barrier(step)) / interval
        angular_acceleration = _rate(self._inertial_rate)(time)
        moving = _rate(_rate(self.displacement_at))(time)
        upward = jax.lax.optimization_barrier(moving.at[:, 2].add(self.gravity))
        force = rotate(conjugate(attitude), upward)
        power = jnp.zeros_like(time)
        if self.frequency.shape[0]:
            envelope, phase = self._tone(time)
            power = jnp.sum(envelope**2 * jnp.sum(self.acceleration**2, axis=1), axis=1) / 2
            felt = jnp.where(self.frequency < 0.5 / interval, envelope * jnp.sin(phase + self.phase[:, 0]), 0.0)
            force = force + jnp.sum(felt[..., None] * self.acceleration, axis=1)
        knot = jnp.clip(jnp.searchsorted(self.temperature_time, time, side="right") - 1, 0, len(self.temperature) - 2)
        span = self.temperature_time[knot + 1] - self.temperature_time[knot]
        rise = self.temperature[knot + 1] - self.temperature[knot]
        inside = (time >= self.temperature_time[0]) & (time < self.temperature_time[-1])
        return Stimulus(
            specific_force=force,
            angular_rate=turned - interval**2 / 12 * jnp.cross(turned, angular_acceleration),
            angular_acceleration=angular_acceleration,
            temperature=jnp.interp(time, self.temperature_time, self.temperature),
            temperature_rate=jnp.where(inside, rise / span, 0.0),
            time=time,
            attitude=attitude,
            vibration_power=power,
            magnetic_field=rotate(conjugate(attitude), self.field),
            current=jnp.interp(time, self.current_time, self.current),
        )

    def ambient_at(self, time: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the ambient temperature (n,), °C."""
        return jnp.interp(time, self.temperature_time, self.ambient)

    def _segment(self, time):
        """Segment of each instant and how far through it is, in [0, 1]."""
        segment = jnp.clip(jnp.searchsorted(self.start, time, side="right") - 1, 0, len(self.start) - 1)
        return segment, jnp.clip((time - self.start[segment]) / self.duration[segment], 0.0, 1.0)

    def _tone(self, time):
        """Envelope and phase (n, v) of the tones: smooth edges, so that rocking has a rate."""
        rise = _smooth(jnp.clip(time[:, None] - self.window[:, 0], 0.0, 1.0))
        fall = _smooth(jnp.clip(self.window[:, 1] - time[:, None], 0.0, 1.0))
        return rise * fall, 2 * jnp.pi * self.frequency * time[:, None]

    def _inertial_rate(self, time):
        """Angular rate (n, 3) against inertial space, in the body frame, at an instant: 2 q* ⊗ dq/dt + Rᵀ ω_E."""
        attitude, change = jax.jvp(self.attitude_at, (time,), (jnp.ones_like(time),))
        return 2 * multiply(conjugate(attitude), change)[:, 1:] + rotate(conjugate(attitude), self.earth)


def _rate(function):
    """The derivative of a function of instants (n,) by each of them."""
    return lambda time: jax.jvp(function, (time,), (jnp.ones_like(time),))[1]


def block_length(samples: int) -> int:
    """Return how many samples to compute at once: few sizes, so that other recordings reuse compiled code."""
    return next((size for size in BLOCKS if size >= samples), BLOCKS[-1])


def _smooth(x):
    return x**3 * (10 - 15 * x + 6 * x**2)


def smooth_course(x, ramp):
    """How much of a turn is done at x in [0, 1]: the rate rises over the share `ramp`, is constant, and falls.

    The rate rises as 10u³ − 15u⁴ + 6u⁵ (no jerk at either end), whose integral over its share is a half; so the
    constant rate is 1/(1 − ramp).
    """

    def risen(u):
        return ramp * u**4 * (2.5 - 3 * u + u**2)

    # each branch is kept inside its own range, and its derivative is its own also where the ranges meet
    falling = jnp.where(x < 1 - ramp, 1.0, (1 - x) / ramp)
    done = jnp.where(x < 1 - ramp, x - ramp / 2, 1 - ramp - risen(falling))
    return jnp.where(x < ramp, risen(jnp.where(x < ramp, x / ramp, 1.0)), done) / (1 - ramp)
