"""A whole recording as rests and motion, filtered: attitude, velocity and drift of the biases are eliminated in time.

The recording is cut into intervals: half a second of motion or less, or part of a rest. The state at their ends is the
attitude C (body to level, z up), the velocity v and the drift d of both triads; all intervals share the numbers of the
unit and gravity g.

Motion: C and v are carried over the interval by the pre-integrated increments (`jaximu.navigation`) in the level frame,
which turns with the Earth at e (Savage, Strapdown Analytics, 2000, ch. 4):

    C′ = Exp(−e T) C ΔR,    v′ = v + (I − [e]× T/2) C Δv − (2 e × v + g ẑ) T.

Rest: C′ = C, v′ = 0, and both triads are measured: ω = Cᵀe + d_ω and f = Cᵀ g ẑ + d_f, means over the interval. Where
motion ends, v′ = 0. Drift is a sum of first-order Gauss–Markov processes, as `NoiseModel` has them.

What is measured from outside, such as attitude and velocity, holds at the end of an interval
(`jaximu.data.sightings`). Heading, free without it, is then the reference's.

`IntervalsOfMotion` linearises this about a unit and about the path that fits it best, and eliminates the states
(`jaximu.estimation.information_filter`); what is left is a triangular system in the shared numbers, which `fit` solves
with what is known beforehand, again until nothing moves. That is Gauss–Newton on all states and numbers at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float

from jaximu.data.gravity_direction import level
from jaximu.data.preintegration import preintegrate_samples, white_covariance
from jaximu.data.sightings import SIZE, AttitudeSeen, FieldSeen, Sighting, Standing, VelocitySeen
from jaximu.estimation.covariance import Covariance, inverse_cholesky
from jaximu.estimation.data import About, Conditions, OfOneUnit
from jaximu.estimation.information_filter import Knowledge, WhiteRows, estimate, run, smooth, smoothed_variances
from jaximu.estimation.problem import flatten
from jaximu.ground import stored
from jaximu.ground.array_types import Array, BoolArray, FloatArray, IntArray
from jaximu.ground.differences import midpoints, value_and_jacobian
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.rotation import (
    IDENTITY,
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
    unit_vectors,
)
from jaximu.ground.tracing import array_module, padded_size, part_of
from jaximu.ground.vectors import lengths_of, sigmas_of
from jaximu.model.effects.earth_rotation import EARTH_RATE, GyroEarthRotation
from jaximu.model.mounting import MOUNTING_EFFECTS, Mounting
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.attitude import Attitude
from jaximu.recordings.recording import Recording, Signal

_LONGEST = 0.5
"""Seconds of an interval, at most."""
_LEVEL, _HEADING, _STILL = 0.5, 1e-3, 1e-4
"""What is known of the first attitude (rad; heading is free and held) and of the velocity in a rest (m/s)."""
_RESTARTED, _GYROCOMPASS = 2.0, 0.1 * EARTH_RATE * np.sqrt(10.0)
"""rad that heading may be off after motion that was left out, where it is measured or for a gyroscope with less noise
than this, rad/√s, which shows a tenth of the Earth's rotation in ten seconds; else heading is held: both would chase
each other."""
_FLOOR = np.array([1e-9] * 3 + [1e-8] * 3)
"""rad and m/s of noise that every interval of motion has: its covariance is never singular."""
_ROUNDS, _UNMOVED = 12, 1e-7
"""Rounds in which the path is linearised anew, and the change (rad) that ends them: what it leaves is its square."""
LONGEST_MOTION = 30.0
"""Seconds of motion between rests beyond which it is left out."""
FARTHEST_UNSEEN = 0.3
"""rad that a unit may turn where samples are missing, at the rates beside them; beyond it a motion is left out."""
_SETTLING = 0.15
"""Seconds at either end of a rest that count as motion."""
_LEAST_DRIFT = 1e-4
"""Share of the white density that a process has at least: one without variance would make rows without bound."""
_UNDONE = 3
"""Rounds in which errors of the set-up are undone."""
_TOGETHER = 32
"""Intervals whose samples are in memory together."""
_LARGE = 10_000
"""Samples from which on a program that is quick, and slow to compile, is worth its time."""
_PARTS, _SHARE = 8, 0.1
"""Intervals in a rest, at least, so that they show its noise; and what drift may add to the noise of one's mean."""


class MotionIntervals(eqx.Module):
    """Intervals of a recording, padded to S samples of length zero; leading axes.

    accelerometer, gyroscope: outputs, in the unit's output units; B samples before the interval precede them, for
    effects that look at neighbours. length (s) of each sample in the interval. time: s. rest: 1 where the unit rests
    all along; arrival: 1 where motion ends and a rest follows; restart: 1 where motion before a rest was left out;
    lost: seconds without samples in it; real: 0 for padding. sightings: what was measured from outside.
    """

    accelerometer: Float[Array, "... B+S 3"]
    gyroscope: Float[Array, "... B+S 3"]
    length: Float[Array, "... S"]
    time: Float[Array, "... B+S"]
    rest: Numbers
    arrival: Numbers
    restart: Numbers
    lost: Numbers
    real: Numbers
    sightings: tuple[Sighting, ...] = ()

    @property
    def before(self) -> int:
        """Samples that precede each interval."""
        return self.time.shape[-1] - self.length.shape[-1]


class Disturbances(eqx.Module):
    """What disturbs a unit and its path, in SI; vectors (6,) are of rate, then force.

    white: densities (SI² s) in motion, rest: the same in a rest. variance (k, 6) and correlation_time (k,), s: of the
    drift. creep: density (rad² s) with which the attitude wanders in a rest. arrival: sigma (m/s) of the velocity where
    motion ends. lost (6,): sigma of the mean rate and force over a second without samples. reference (rad), velocity
    (m/s), field (µT): sigmas of each axis of what is measured from outside.
    """

    white: Float[Array, 6]
    rest: Float[Array, 6]
    variance: Float[Array, "k 6"]
    correlation_time: Float[Array, " k"]
    creep: Number
    arrival: Number
    lost: Float[Array, 6]
    reference: Number | float = 1.0
    velocity: Number | float = 1.0
    field: Number | float = 1.0

    @property
    def states(self) -> int:
        """Length of the state: attitude, velocity, drift."""
        return 6 + self.variance.size


class MotionPath(eqx.Module):
    """Attitudes (N + 1, 4), body to level, and velocities (N + 1, 3), m/s, at the ends of N intervals."""

    attitude: Quaternion
    velocity: Vector

    def moved(self, change: Float[Array, "... 6"]) -> MotionPath:
        """Return the path with its ends turned in the body frame by a rotation vector, and sped up (m/s)."""
        return MotionPath(turned(self.attitude, change[..., :3]), self.velocity + change[..., 3:])


def merged_drift(noise: NoiseModel, shortest: float, most: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return white densities (6,), variances (k, 6) and correlation times (k,) of a noise model, k ≤ `most`.

    What is quicker than `shortest` (s) counts as white. Neighbouring processes are merged, the least apart first, into
    one with the sum of their variances and the mean of their times: near zero frequency the density stays what it was.
    """
    white, parts = [], []
    for before, triad in ((0, noise.gyroscope), (3, noise.accelerometer)):
        assert triad is not None
        density, slow = triad.split(shortest)
        white.append(density)
        variances = (np.pad(variance, (before, 3 - before)) for variance in slow.variance.T)
        parts += zip(slow.correlation_time.tolist(), variances, strict=True)
    parts = sorted((part for part in parts if part[1].any()), key=lambda part: part[0])
    unit = np.repeat(np.mean(white, axis=1), 3)
    while len(parts) > most:
        times, variances = zip(*parts, strict=True)
        k = int(np.divide(times[1:], times[:-1]).argmin())
        weights = [(variance / unit).sum() for variance in variances[k : k + 2]]
        parts[k : k + 2] = [(float(np.average(times[k : k + 2], weights=weights)), variances[k] + variances[k + 1])]
    times = np.array([time for time, _ in parts])
    variance = np.array([variance for _, variance in parts]).reshape(-1, 6)
    return np.concatenate(white), np.maximum(variance, _LEAST_DRIFT * unit / times[:, None]), times


# --- one interval -----------------------------------------------------------------------------------------------------


def _carried(attitude, velocity, rotation, gained, duration, earth, gravity):
    """Return attitude and velocity after an interval of motion."""
    pushed = rotate(attitude, gained)
    pushed -= jnp.cross(earth, pushed) * duration / 2
    fallen = 2 * jnp.cross(earth, velocity) + UP * gravity
    return (
        multiply(exponential(-earth * duration), multiply(attitude, rotation)),
        velocity + pushed - fallen * duration,
    )


def _samples(like: Imu, numbers: Array, part: MotionIntervals):
    """Return rates and forces (S, 6) of an interval's samples, the Earth's rotation (3,) and the mounting's numbers.

    Errors of the set-up are undone by iteration: what they would make of the rates is taken off the rates.
    """
    imu = ravel_pytree(like)[1](numbers)
    bare = imu.without(GyroEarthRotation, *MOUNTING_EFFECTS)
    force, rate = bare.recover(part.accelerometer, part.gyroscope, Stimulus(time=part.time))
    felt = jnp.hstack([rate, force])
    true = felt
    for _ in range(_UNDONE if bare.setup else 0):
        path = Stimulus(true[:, 3:], true[:, :3], time=part.time)
        made = [getattr(bare.acted(path, name), name) for name in ("angular_rate", "specific_force")]
        true = felt - jnp.hstack(made) + true
    return true[part.before :], imu.coefficients(GyroEarthRotation), jnp.hstack(Mounting.of(imu))


class _Means(eqx.Module):
    """An interval without its samples, and how it reacts to the unit's numbers (M).

    Of motion the increments are given, of a rest the means; the others are zero.
    """

    rotation: Array
    gained: Array
    by_noise: Array  # (6, 6) covariance of the increments by white noise
    by_drift: Array  # (6, 6) of the increments
    increments: Array  # (6, M)
    mean: Array  # (6,) rate and force
    means: Array  # (6, M)
    earth: Array
    by_earth: Array  # (3, M)
    ending: Array  # (9,) rate and force in the last sample, angular acceleration
    by_ending: Array  # (9, M)
    half: Array  # of the last sample
    mounting: Array  # (q,) numbers of a `Mounting`
    by_mounting: Array  # (q, M)
    duration: Array


def _condensed(like: Imu, numbers: Array, part: MotionIntervals, white: Array) -> _Means:
    both = (kind(like, numbers, part, white) for kind in (_of_rest, _of_motion))
    return jax.tree.map(partial(jnp.where, part.rest > 0), *both)


def _of_motion(like: Imu, numbers: Array, part: MotionIntervals, white: Array) -> _Means:
    samples, earth, mounting = _samples(like, numbers, part)
    whole = preintegrate_samples(*jnp.hsplit(samples, 2), intervals=part.length)
    reaction = whole.reaction[:, :6]
    length = jnp.asarray(part.length)
    last = jnp.maximum((length > 0).sum() - 1, 0)
    before = jnp.maximum(last - 1, 0)
    apart = (length[last] + length[before]) / 2

    def ended(samples):
        return jnp.concatenate([samples[last], (samples[last] - samples[before])[:3] / jnp.maximum(apart, 1e-9)])

    def moved(numbers):  # exactly: a change of rates and forces also changes coning and sculling
        samples, earth, mounting = _samples(like, numbers, part)
        varied = preintegrate_samples(*jnp.hsplit(samples, 2), intervals=part.length)
        off = logarithm(multiply(conjugate(whole.rotation), varied.rotation))
        return jnp.concatenate([off, varied.velocity]), earth, ended(samples), mounting

    increments, by_earth, by_ending, by_mounting = jax.jacfwd(moved)(numbers)
    return _Means(
        whole.rotation,
        whole.velocity,
        white_covariance(reaction, jnp.diag(white), length),
        reaction.sum(axis=0),
        increments,
        jnp.zeros(6),
        jnp.zeros_like(increments),
        earth,
        by_earth,
        ended(samples),
        by_ending,
        length[last] / 2,
        mounting,
        by_mounting,
        _duration(part),
    )


def _of_rest(like: Imu, numbers: Array, part: MotionIntervals, white: Array) -> _Means:
    before = part.before
    few = 2 * before + 1
    share = part.length / _duration(part)
    # effects see the mean output, as they do of poses, and nothing that changes: noise is no motion
    force, rate = (
        jnp.broadcast_to(share @ output[before:], (few, 3)) for output in (part.accelerometer, part.gyroscope)
    )
    still = replace(part, accelerometer=force, gyroscope=rate, length=part.length[: few - before], time=part.time[:few])

    def of(numbers):
        samples, *beside = _samples(like, numbers, still)
        return samples[0], *beside

    (mean, earth, mounting), (means, by_earth, by_mounting) = value_and_jacobian(of, numbers)
    none = jnp.zeros((6, 6))
    return _Means(
        jnp.asarray(IDENTITY),
        jnp.zeros(3),
        none,
        none,
        jnp.zeros_like(means),
        mean,
        means,
        earth,
        by_earth,
        jnp.pad(mean, (0, 3)),
        jnp.pad(means, ((0, 3), (0, 0))),
        jnp.asarray(part.length)[0] / 2,
        mounting,
        by_mounting,
        _duration(part),
    )


def _duration(part: MotionIntervals) -> Array:
    return jnp.maximum(part.length.sum(), 1e-9)


def _rows(
    means: _Means,
    part: MotionIntervals,
    errors: Disturbances,
    gravity: Array,
    before: MotionPath,
    after: MotionPath,
    anchor: Array,
) -> WhiteRows:
    """Return the white rows of an interval about a path: 6 of attitude and velocity, the drift's, what is measured.

    anchor (4,): the attitude at the end as first reckoned, about which one that begins anew is known.
    """
    drifts, size = errors.variance.size, errors.states
    moving = (1 - part.rest) * part.real

    def off(change, attitude, velocity):
        """Return by how much attitude (rad) and velocity (m/s) miss the end of the path, moved by a change (6,)."""
        end = after.moved(change)
        return jnp.concatenate([logarithm(multiply(conjugate(end.attitude), attitude)), velocity - end.velocity])

    def both(change):
        end, increment = change[6:12], change[12:18]
        begin = before.moved(change[:6])
        moved = _carried(
            begin.attitude,
            begin.velocity,
            multiply(means.rotation, exponential(increment[:3])),
            means.gained + increment[3:],
            means.duration,
            means.earth + change[18:21],
            gravity + change[21],
        )
        return jnp.where(moving > 0, off(end, *moved), off(end, begin.attitude, jnp.zeros(3)))

    value, slopes = value_and_jacobian(both, jnp.zeros(22))
    push = slopes[:, 12:18]
    lost = (errors.lost * part.lost) ** 2
    swept = push @ (means.by_noise + jnp.diag(lost)) @ push.T + jnp.diag(jnp.asarray(_FLOOR) ** 2)
    stays = jnp.array([errors.creep * means.duration + _FLOOR[0] ** 2, _STILL**2]).repeat(3)
    weights = inverse_cholesky(jnp.where(moving > 0, swept, jnp.diag(stays)))
    by_number = push @ means.increments + slopes[:, 18:21] @ means.by_earth
    by_drift = jnp.tile(-push @ means.by_drift, (1, errors.variance.shape[0]))
    shown = sees_earth(errors) | bool(part.sightings)
    miss, by_end = _restarted(after, anchor, jnp.where(shown, _RESTARTED, _HEADING))
    beside = (0, 0), (0, drifts)
    carrying = WhiteRows(
        weights @ jnp.hstack([slopes[:, :6], by_drift]),
        weights @ jnp.pad(slopes[:, 6:12], beside),
        weights @ jnp.hstack([by_number, slopes[:, 21:]]),
        -weights @ value,
    )
    beginning = carrying._replace(before=0.0, after=jnp.pad(by_end, beside), shared=0.0, right=-miss)
    process = jax.tree.map(partial(jnp.where, (part.restart > 0) & (part.real > 0)), beginning, carrying)
    wander = _wandering(jnp.where(part.real > 0, means.duration, 1.0), errors, by_number.shape[1] + 1)
    about = errors, gravity, after, size
    rows = [process, wander, _measured(means, part, *about)]
    rows += [_sighted(means, part, sighting, *about) for sighting in part.sightings]
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *rows)


def _restarted(after: MotionPath, anchor: Array, heading: Array) -> tuple[Array, Array]:
    """Return by how much the end of a path misses (6,) where it begins anew, weighted, and the slopes over its change.

    It is level about the attitude `anchor` (4,) and rests; its heading is known to `heading`, rad.
    """
    known = jnp.array(_first_root(1.0)).at[2].set(1 / heading)

    def missed(change):
        end = after.moved(change)
        off = rotate(anchor, logarithm(multiply(conjugate(anchor), end.attitude)))  # in the level frame: heading is z
        return known * jnp.concatenate([off, end.velocity])

    return value_and_jacobian(missed, jnp.zeros(6))


def _wandering(duration: Array, errors: Disturbances, numbers: int) -> WhiteRows:
    """Return the rows of the drift, which dies away and is driven by noise over an interval."""
    drifts = errors.variance.size
    kept = jnp.exp(-duration / errors.correlation_time)
    variance = errors.variance * -jnp.expm1(-2 * duration / errors.correlation_time)[:, None]
    white = 1 / jnp.sqrt(variance).ravel()
    return WhiteRows(
        jnp.pad(jnp.diag(-white * kept.repeat(6)), ((0, 0), (6, 0))),
        jnp.pad(jnp.diag(white), ((0, 0), (6, 0))),
        jnp.zeros((drifts, numbers)),
        jnp.zeros(drifts),
    )


def _measured(
    means: _Means, part: MotionIntervals, errors: Disturbances, gravity: Array, after: MotionPath, size: int
) -> WhiteRows:
    """Return 6 rows measured at the end: rate and force of a rest, the velocity where motion ends, or nothing."""

    def still(change):  # attitude, earth, gravity
        back = conjugate(turned(after.attitude, change[:3]))
        up = rotate(back, UP)
        return means.mean - jnp.concatenate([rotate(back, means.earth + change[3:6]), up * (gravity + change[6])])

    value, slopes = value_and_jacobian(still, jnp.zeros(7))
    copies = errors.variance.shape[0]
    by_state = jnp.hstack([slopes[:, :3], jnp.zeros((6, 3)), jnp.tile(-jnp.eye(6), (1, copies))])
    by_number = jnp.hstack([means.means + slopes[:, 3:6] @ means.by_earth, slopes[:, 6:]])
    weight = part.rest * part.real * jnp.sqrt(means.duration / errors.rest)
    stopping = part.arrival * part.real / errors.arrival
    stop = jnp.zeros((6, size)).at[:3, 3:6].set(jnp.eye(3))
    return WhiteRows(
        jnp.zeros((6, size)),
        weight[:, None] * by_state + stopping * stop,
        weight[:, None] * by_number,
        -weight * value - stopping * jnp.pad(after.velocity, (0, 3)),
    )


def _sighted(
    means: _Means,
    part: MotionIntervals,
    sighting: Sighting,
    errors: Disturbances,
    gravity: Array,
    after: MotionPath,
    size: int,
) -> WhiteRows:
    """Return the rows of what was measured from outside at the end, or nothing."""
    parts = 6, 6 + SIZE, 7 + SIZE

    def off(change):  # attitude and velocity, the end, gravity, the mounting
        moved, ended, gravitated, remounted = jnp.split(change, parts)
        end = after.moved(moved)
        rate, force, acceleration = jnp.split(means.ending + ended, 3)
        standing = Standing(
            end.attitude,
            end.velocity,
            rate,
            force,
            acceleration,
            means.half,
            gravity + gravitated[0],
        )
        return sighting.off(standing, Mounting.from_numbers(means.mounting + remounted))

    value, slopes = value_and_jacobian(off, jnp.zeros(parts[-1] + len(means.mounting)))
    weight = sighting.measured * part.real / getattr(errors, sighting.noise)
    by_path, by_ending, by_gravity, by_mounting = jnp.split(slopes, parts, axis=1)
    by_state = jnp.pad(by_path, ((0, 0), (0, size - 6)))
    by_number = jnp.hstack([by_ending @ means.by_ending + by_mounting @ means.by_mounting, by_gravity])
    return WhiteRows(jnp.zeros_like(by_state), weight * by_state, weight * by_number, -weight * value)


def interval_rows(
    like: Imu,
    numbers: Float[Array, " M"],
    gravity: Number,
    part: MotionIntervals,
    errors: Disturbances,
    before: MotionPath,
    after: MotionPath,
) -> WhiteRows:
    """Return the white rows of one interval, linearised about a unit and the path's two ends.

    The state is the rotation vector in the body frame that turns the path's attitude into the true one (rad), the
    velocity less the path's (m/s), and the drift of rate and force, process after process; the shared numbers are the
    unit's less `numbers` (of `like`, in the order of `flatten`) and gravity less `gravity` (m/s²).
    """
    means = _condensed(like, numbers, part, errors.white)
    return _rows(means, part, errors, gravity, before, after, after.attitude)


def carried(
    like: Imu, numbers: Float[Array, " M"], gravity: Number, part: MotionIntervals, before: MotionPath
) -> MotionPath:
    """Return the path's end after an interval, as a unit's numbers have it: the same attitude in a rest or restart."""
    samples, earth, _ = _samples(like, numbers, part)
    whole = preintegrate_samples(*jnp.hsplit(samples, 2), intervals=part.length)
    attitude, velocity = _carried(
        before.attitude, before.velocity, whole.rotation, whole.velocity, whole.duration, earth, gravity
    )
    resting = (part.rest > 0) | (part.restart > 0)
    return MotionPath(jnp.where(resting, before.attitude, attitude), jnp.where(resting, 0.0, velocity))


def first_field(intervals: MotionIntervals, imu: Imu) -> FloatArray:
    """Return the magnetic field (3,) in the level frame, µT, as the first rest in which it is measured has it."""
    (sighting,) = (sighting for sighting in intervals.sightings if isinstance(sighting, FieldSeen))
    at = int((sighting.measured > 0).argmax())
    part = part_of(intervals, at)
    mean = part.length @ part.accelerometer[part.before :] / part.length.sum()
    attitude = level(IDENTITY, imu.with_effects().accelerometer.recover(mean))
    for other in part.sightings:
        if other.absolute and other.measured > 0:
            attitude = other.placed(attitude, Mounting.of(imu))
    return np.asarray(rotate(attitude, sighting.value[at]))


def sees_earth(errors: Disturbances) -> Bool[Array, ""]:
    """Whether a gyroscope sees the Earth's rotation in rests of a few seconds."""
    return array_module(errors).mean(errors.rest[:3]) < _GYROCOMPASS**2


def _first_root(heading: float) -> FloatArray:
    return np.array([1 / _LEVEL, 1 / _LEVEL, 1 / heading, *(3 * [1 / _STILL])])


def first_knowledge(errors: Disturbances, velocity: Vector, shared: int, turned: bool = False) -> Knowledge:
    """Return what is known of the first state, in a rest, about a path with that velocity; of shared numbers nothing.

    Tilt is as good as unknown; heading, which rests and motion do not determine, is held where the path has it, unless
    it is measured (`turned`).
    """
    drift = 1 / np.sqrt(np.ravel(errors.variance))
    root = np.concatenate([_first_root(_LEVEL if turned else _HEADING), drift, np.zeros(shared)])
    right = np.pad(-np.asarray(velocity) / _STILL, (3, len(root) - 6))
    return Knowledge(np.diag(root), right)


# --- a recording ------------------------------------------------------------------------------------------------------


def longest_rest(errors: Disturbances) -> float:
    """Return how long (s) an interval of a rest may be for drift to be taken as what it is at the end.

    Over T the mean of a process with variance σ² and correlation time τ differs from its end by 2σ²T/3τ, in variance;
    white noise of density N² by N²/T.
    """
    squared = 1.5 * _SHARE * errors.correlation_time[:, None] * errors.rest / errors.variance
    return float(np.sqrt(np.min(squared, initial=np.inf)))


def _pieces(
    recording: Recording, lost: FloatArray, rests: IntArray, marks: FloatArray, still: float
) -> tuple[list[tuple[int, int, bool, bool]], list[str]]:
    """Return the intervals between and in rests, first and last sample (P, 2), and notes on what was left out.

    Of each interval: its samples, from one to before another, and whether it is a rest or a restart.
    """
    gyroscope, name = recording.signals["gyroscope"], recording.name
    time, unseen = gyroscope.time, lost * lengths_of(gyroscope.si())
    pieces, skipped, jumped, bridged = [], 0.0, 0, lost[rests[0, 0] : rests[-1, 1]].sum()
    moved_from = None
    for start, stop in rests.tolist():
        if moved_from is not None:
            far = unseen[moved_from:start].sum() > FARTHEST_UNSEEN
            long = _unseen(marks, float(time[moved_from]), float(time[start])) > LONGEST_MOTION
            if far or long:  # nothing of the attitude is left
                pieces.append((moved_from, moved_from + 1, False, True))
                skipped += long * float(time[start] - time[moved_from])
                jumped += far and not long
                bridged -= lost[moved_from:start].sum()
            else:
                parts = _on_marks(_parts(time, moved_from, start, _LONGEST), gyroscope.edges, marks)
                pieces += [(*part, False, False) for part in parts]
        longest = max(_LONGEST, min(still, float(time[stop] - time[start]) / _PARTS))
        pieces += [(*part, True, False) for part in _parts(time, start, stop, longest)]
        moved_from = stop
    notes = []
    if skipped:
        notes.append(
            f"{name}: {skipped:.0f} s of motion without a rest for more than {LONGEST_MOTION:.0f} s were left out: "
            "attitude cannot be carried so far."
        )
    if jumped:
        notes.append(
            f"{name}: {jumped} motion{'s' if jumped > 1 else ''} in which samples are missing while the unit turned "
            "were left out: nobody knows how far it turned."
        )
    if bridged > 1e-9:
        notes.append(
            f"{name}: {bridged:.3g} s without samples were bridged by holding the neighbouring samples; the "
            "uncertainty of attitude and velocity grows there."
        )
    return pieces, notes


def cut(
    recording: Recording,
    rests: FloatArray,
    still: float = _LONGEST,
    beyond: int = 0,
    attitude: Attitude | None = None,
    mounting: Mounting | None = None,
    field: Signal | None = None,
) -> tuple[MotionIntervals, list[str]]:
    """Cut a recording into intervals, from its first rest to its last, padded in number and length; and notes.

    **Arguments:** `rests` (P, 2): start and stop, s; `still`: s, the longest interval of a rest, of which each has
    eight or more (`longest_rest`); `beyond`: samples before and after each interval that are kept, for effects that
    look at neighbours; `attitude`: measured, with its `mounting`, at whose stamps intervals of motion then end;
    `field`: magnetic, in the body frame (µT), by a calibrated magnetometer on the recording's clock, whose mean over
    each rest is used. Where the triads have stamps of their own the accelerometer is interpolated to the gyroscope's.
    """
    gyroscope, accelerometer = recording.signals["gyroscope"], recording.accelerometer
    time, period = gyroscope.time, 1 / gyroscope.rate
    force, edges = accelerometer.at(time), gyroscope.edges
    step = np.diff(time, prepend=time[0] - period, append=time[-1] + period)
    lost = midpoints(np.where(step > 2.5 * period, step - period, 0.0))
    resting = time.searchsorted(rests + np.array([_SETTLING, -_SETTLING]))
    marks = np.zeros(0) if attitude is None else np.asarray((mounting or Mounting()).on_log(attitude.time))
    pieces, notes = _pieces(recording, lost, resting, marks, still)
    begin, end, rest, restart = map(np.array, zip(*pieces, strict=True))
    if (ahead := rests[0, 0] - time[0]) > 1.0:
        notes.append(f"{recording.name}: the first {ahead:.1f} s, before the first rest, were left out.")
    samples = padded_size(int((end - begin).max()) + beyond)
    inside = begin[:, None] + np.arange(samples) < end[:, None]
    around = begin[:, None] + np.arange(-beyond, samples)
    around = around.clip(0, np.minimum(end + beyond, len(time))[:, None] - 1)
    rest_follows = np.append(rest[1:], False)
    arrival = ~rest & ~restart & rest_follows
    sightings, ends = [], _padded(edges[end])
    if field is not None:
        stretches = time[resting[:, 0]], time[resting[:, 1] - 1]
        sightings.append(_field_in_rests(field, stretches, rest & ~rest_follows, ends))
    if attitude is not None:  # in a rest any stamp will do; in motion one in the last sample
        latest = marks.searchsorted(edges[end], side="right") - 1
        since = np.where(rest, edges[begin], edges[end - 1])
        measured = (latest >= 0) & (marks[latest] > since) & ~arrival & ~restart
        at = _padded(attitude.time[latest]), ends, _padded(measured)
        sightings.append(AttitudeSeen(*at, _padded(attitude.quaternion[latest], "edge")))
        if (velocity := attitude.velocities()) is not None:
            sightings.append(VelocitySeen(*at, _padded(velocity[latest])))
    at_samples = around[:, beyond:]
    intervals = MotionIntervals(
        _padded(force[around], "edge"),
        _padded(gyroscope.values[around], "edge"),
        _padded(np.where(inside, np.diff(edges)[at_samples], 0.0)),
        _padded(time[around]),
        _padded(rest),
        _padded(arrival),
        _padded(restart),
        _padded((lost[at_samples] * inside).sum(axis=1)),
        _padded(np.ones(len(begin))),
        tuple(sightings),
    )
    return intervals, notes


def _field_in_rests(
    field: Signal, stretches: tuple[FloatArray, FloatArray], final: BoolArray, ends: FloatArray
) -> FieldSeen:
    """Return the mean field of rests, by their stretches of time, in the intervals that end one, in the same order."""
    value, known = np.zeros((len(final), 3)), np.zeros(len(final))
    value[final], known[final] = _mean_field(field, *stretches)
    return FieldSeen(ends, ends, _padded(known), _padded(value))


def _padded(values, mode: Any = "constant") -> FloatArray:
    """Return values of intervals up to a bucket's number: zeros, or with mode "edge" the last one again."""
    missing = [(0, padded_size(len(values), 2 * _TOGETHER) - len(values)), *[(0, 0)] * (np.ndim(values) - 1)]
    return np.pad(np.asarray(values, float), missing, mode=mode)


def _mean_field(field: Signal, start: FloatArray, stop: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the mean (P, 3) of a field between times (P,), and whether there are samples (P,)."""
    first, last = field.time.searchsorted((start, stop))
    means = [field.values[a:b].mean(axis=0) if b > a else np.zeros(3) for a, b in zip(first, last, strict=True)]
    return np.array(means), last > first


def _parts(time: FloatArray, start: int, stop: int, longest: float) -> list[tuple[int, int]]:
    """Return the places that cut samples `start` to before `stop` into parts of alike length."""
    if stop <= start:
        return []
    count = max(1, int(np.ceil((stop - start) * np.median(np.diff(time)) / longest - 1e-9)))
    return list(pairwise(np.linspace(start, stop, min(count, stop - start) + 1).round().astype(int).tolist()))


def _unseen(marks: FloatArray, start: float, stop: float) -> float:
    """Return how long (s) nothing says how the unit stands, between two times and a reference's stamps."""
    return float(np.diff(marks[(marks > start) & (marks < stop)], prepend=start, append=stop).max())


def _on_marks(parts: list[tuple[int, int]], edges: FloatArray, marks: FloatArray) -> list[tuple[int, int]]:
    """Return parts of samples that end with the sample in which the nearest of some stamps lies, where one is near."""
    if not len(marks) or len(parts) < 2:
        return parts
    ends = np.array([end for _, end in parts[:-1]])
    later = marks.searchsorted(edges[ends]).clip(1, len(marks) - 1)
    near = np.where(edges[ends] - marks[later - 1] < marks[later] - edges[ends], later - 1, later)
    moved = edges.searchsorted(marks[near])
    ends = np.where(abs(marks[near] - edges[ends]) < _LONGEST / 4, moved, ends)
    ends = np.unique(ends.clip(parts[0][0] + 1, parts[-1][1] - 1))
    return list(pairwise([parts[0][0], *ends.tolist(), parts[-1][1]]))


class _Triangular(Conditions):
    """What all intervals say of the unit's numbers and gravity, and what no number can explain."""

    root: Float[Array, "m m"]
    right: Float[Array, " m"]
    numbers: Float[Array, " M"]
    gravity: Number
    left: Float[Array, " k"]
    magnitude: Number

    def __call__(self, imu: Imu) -> Float[Array, " n"]:
        """Return root · change − right, and what is left."""
        change = jnp.append(ravel_pytree(imu)[0] - self.numbers, self.magnitude - self.gravity)
        return jnp.concatenate([self.root @ change - self.right, self.left])


@dataclass(frozen=True)
class Filtered:
    """Intervals filtered about a unit, nothing known of its numbers: what is known last, the path, its rows (N, r, …).

    misfit: sum of the innovations.
    """

    last: Knowledge
    path: MotionPath
    misfit: float
    rows: WhiteRows = field(repr=False)


@dataclass(frozen=True)
class FilterPass:
    """How a filter came to know the free numbers and gravity, interval after interval, and the smoothed states.

    innovations (N, 1 + k): normalised, squared, of rests and ends of motion, and of each kind of sighting given them;
    of `freedom` (N, 1 + k) degrees. values, sigmas (N, p + 1): of the numbers, from the intervals so far. states,
    state_sigmas (N, n): smoothed, at the beginning of each interval.
    """

    innovations: FloatArray
    freedom: FloatArray
    values: FloatArray
    sigmas: FloatArray
    states: FloatArray
    state_sigmas: FloatArray


@dataclass
class IntervalsOfMotion(OfOneUnit):
    """One recording of a unit, cut into intervals of rest and of motion; its states are eliminated by a filter.

    The path about which it is linearised is kept from one evaluation to the next, and its first attitudes, `anchor`.
    """

    intervals: MotionIntervals
    errors: Disturbances
    gravity: float
    path: MotionPath | None = field(default=None, repr=False)
    anchor: FloatArray | None = field(default=None, repr=False)

    effects_inside = True
    excess_names = ("innovations",)
    coarse = (0.0,)

    @property
    def freedom(self) -> FloatArray:
        """Return how many numbers (N, 1 + k) each interval measured: of rests (six) and ends of motion (three), and of
        each kind of sighting (three).
        """
        intervals = self.intervals
        sighted = [3 * (sighting.measured > 0) for sighting in intervals.sightings]
        return np.column_stack([6 * intervals.rest + 3 * intervals.arrival, *sighted]).astype(float)

    def filtered(self, imu: Imu) -> Filtered:
        """Return the intervals filtered about one unit, along the path that fits it best."""
        means = self._means(imu)
        if self.path is None:
            self.path = stored.call(_dead_reckoned, "dead reckoning", means, self.intervals, self.gravity)
            self.anchor = self.path.attitude[1:]
        states, absolute = self.errors.states, self._absolute
        for number in range(_ROUNDS):
            rows = self._rows(means)
            shared = rows.shared.shape[-1]
            start = first_knowledge(self.errors, self.path.velocity[0], shared, absolute)
            last, eliminated, innovations, _ = run(start, rows)
            state = scipy.linalg.solve_triangular(last.root[:states, :states], last.right[:states])
            earlier = smooth(eliminated, state, np.zeros(shared))
            moved = np.vstack([earlier, state])[:, :6]
            if not np.isfinite(moved).all():
                raise NotPossibleError(
                    "attitude and velocity could not be followed through this recording: the start is too far off. "
                    "Calibrate it with `jaximu calibrate` first."
                )
            if _change(self.path, moved, absolute) < _UNMOVED or number + 1 == _ROUNDS:
                break
            self.path = stored.call(MotionPath.moved, "moved path", self.path, moved)
        return Filtered(last, self.path, float(innovations.sum()), rows)

    @property
    def _absolute(self) -> bool:
        """Whether heading is measured in a frame that is not the filter's own."""
        return any(sighting.absolute for sighting in self.intervals.sightings)

    def _means(self, imu: Imu) -> _Means:
        """Return the intervals without their samples; nothing is integrated in a rest."""
        rest = self.intervals.rest > 0
        merged = None
        for kind, chosen in ((_of_motion, ~rest), (_of_rest, rest)):
            rows = np.flatnonzero(chosen)
            if not len(rows):
                continue
            part = self._part(np.resize(rows, padded_size(len(rows), 2 * _TOGETHER)))
            small = part.length.size < _LARGE
            means = stored.call(partial(_all_means, kind), kind.__name__, imu, part, self.errors, quick=small)
            if merged is None:
                merged = jax.tree.map(lambda leaf: np.zeros((len(rest), *leaf.shape[1:])), means)
            for whole, leaf in zip(jax.tree.leaves(merged), jax.tree.leaves(means), strict=True):
                whole[rows] = leaf[: len(rows)]
        assert merged is not None
        return merged

    def _part(self, rows: IntArray) -> MotionIntervals:
        """Return some of the intervals, without the samples that none of them has."""
        part = part_of(self.intervals, rows)
        before = part.before
        inside = min(padded_size(int((part.length > 0).sum(axis=1).max()) + before), part.length.shape[1])
        samples = {name: getattr(part, name)[:, : before + inside] for name in ("accelerometer", "gyroscope", "time")}
        return replace(part, length=part.length[:, :inside], **samples)

    def _rows(self, means: _Means) -> WhiteRows:
        """Return the white rows (N, r, …) of all intervals about the path."""
        return stored.call(
            _along, "intervals about a path", means, self.intervals, self.errors, self.gravity, self.path, self.anchor
        )

    def followed(self, imu: Imu, index: Sequence[int], prior: Knowledge) -> FilterPass:
        """Return how a filter would have come to know free numbers, linearised about a unit and its path.

        **Arguments:** `index`: places of the free numbers; `prior`: of them and of gravity, less the unit's.
        """
        filtered, states = self.filtered(imu), self.errors.states
        path, rows = filtered.path, filtered.rows
        rows = rows._replace(shared=rows.shared[..., np.append(np.asarray(index, int), len(flatten(imu)))])
        start = first_knowledge(self.errors, path.velocity[0], len(prior.right), self._absolute)
        start.root[states:, states:], start.right[states:] = prior.root, prior.right
        count = rows.right.shape[1]
        ends = [count - 3 * (later + 1) for later in range(len(self.intervals.sightings))][::-1]
        last, eliminated, innovations, numbers = run(start, rows, ends)
        values, covariances = zip(*(estimate(Knowledge(*known)) for known in zip(*numbers, strict=True)), strict=True)
        final, covariance = estimate(last)
        smoothed = smooth(eliminated, final[:states], final[states:])
        variances = smoothed_variances(eliminated, covariance)
        sigmas = sigmas_of(np.array(covariances))
        return FilterPass(innovations, self.freedom, np.array(values), sigmas, smoothed, np.sqrt(variances))

    def about_one(self, imu: Imu) -> About:
        """Return the triangular system about the unit."""
        filtered, states = self.filtered(imu), self.errors.states
        root, right = filtered.last.root[states:, states:], filtered.last.right[states:]
        free = max(int(self.freedom.sum()) - len(right), 1)
        real = np.arange(padded_size(free)) < free
        left, gravity = real * np.sqrt(filtered.misfit / free), np.float64(self.gravity)
        conditions = _Triangular(root, right, flatten(imu), gravity, left, gravity)
        used = np.append(np.ones(len(right)), real)
        covariance = Covariance(np.ones(len(used)), (used,), used, np.zeros(len(used), int))
        return About(conditions, covariance, np.zeros((len(used), 0)), filtered)


def _all_means(kind: Callable[..., _Means], imu: Imu, intervals: MotionIntervals, errors: Disturbances) -> _Means:
    numbers = ravel_pytree(imu)[0]
    return jax.lax.map(lambda part: kind(imu, numbers, part, errors.white), intervals, batch_size=_TOGETHER)


def _dead_reckoned(means: _Means, intervals: MotionIntervals, gravity: Array) -> MotionPath:
    """Return a first path: carried through motion, turned as a reference has it, levelled at every rest."""

    def step(sighted, attitude, part):
        means, interval = part
        resting = interval.rest > 0
        moved = _carried(attitude, jnp.zeros(3), means.rotation, means.gained, means.duration, means.earth, gravity)[0]
        moved = jnp.where(resting, attitude, moved)
        for sighting in interval.sightings if sighted else ():
            placed = sighting.placed(moved, Mounting.from_numbers(means.mounting))
            moved = jnp.where(sighting.measured > 0, placed, moved)
        attitude = jnp.where(resting, level(moved, means.mean[3:]), moved)
        return attitude, attitude

    def reckoned(start, sighted):
        return jax.lax.scan(partial(step, sighted), start, (means, intervals))[1]

    start = level(IDENTITY, means.mean[0, 3:])
    for sightings in intervals.sightings:  # the heading at the first sighting is the heading of all
        k = (sightings.measured > 0).argmax()
        sighting, numbers = part_of((sightings, means.mounting), k)
        now = reckoned(start, False)[k]
        placed = sighting.placed(now, Mounting.from_numbers(numbers))
        heading = multiply(placed, conjugate(now)) * jnp.array([1.0, 0.0, 0.0, 1.0])
        start = multiply(unit_vectors(heading), start)
    attitudes = jnp.concatenate([start[None], reckoned(start, True)])
    return MotionPath(attitudes, jnp.zeros((len(attitudes), 3)))


def _along(
    means: _Means, intervals: MotionIntervals, errors: Disturbances, gravity: Array, path: MotionPath, anchor: Array
) -> WhiteRows:
    before, after = (part_of(path, ends) for ends in (slice(-1), slice(1, None)))

    def rows(part):
        means, interval, before, after, anchor = part
        return _rows(means, interval, errors, gravity, before, after, anchor)

    return jax.lax.map(rows, (means, intervals, before, after, anchor), batch_size=_TOGETHER)


def _change(path: MotionPath, moved: FloatArray, absolute: bool) -> float:
    """Return how far attitudes move, rad, but for the heading of all unless it is measured: it is held, and creeps."""
    turned = np.array(rotate(path.attitude, moved[:, :3]))
    turned[:, 2] -= 0.0 if absolute else turned[0, 2]
    return float(abs(turned).max())


def turned(attitude: Quaternion, vector: Vector) -> Quaternion:
    """Return an attitude turned in the body frame by a rotation vector, of length one."""
    return unit_vectors(multiply(attitude, exponential(vector)))
