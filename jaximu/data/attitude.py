"""Against a measured attitude: the rotation over intervals between two of its stamps, and gravity in the means.

Over an interval the unit's integrated rotation is compared with the reference's, so nothing is differentiated; the
reference is never interpolated: the unit is integrated from stamp to stamp, parts of samples at both ends. The specific
force, turned into the reference's upright frame by its attitude and by the gyroscope in between, has the mean g plus
the change of velocity over the time, known where the reference has velocities, else part of the noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaximu.data.preintegration import increments, linear_slope, preintegrate_samples, white_covariance
from jaximu.estimation.covariance import BlockFactor, Covariance
from jaximu.estimation.data import About, Conditions, Observed, OfOneUnit, free_columns
from jaximu.estimation.problem import Parameters
from jaximu.estimation.rows import TEMPERATURE, TIME, ResidualKind, Rows, Sizes, by_axis
from jaximu.estimation.track import TRIADS, Track, added, stimuli
from jaximu.ground import stored
from jaximu.ground.array_types import Array, FloatArray, IntArray
from jaximu.ground.differences import interpolated, midpoints
from jaximu.ground.rotation import (
    UP,
    Matrix,
    Number,
    conjugate,
    exponential,
    inverse_matrix,
    logarithm,
    multiply,
    right_jacobian,
    rotate,
    rotation_matrix,
    unit_vectors,
)
from jaximu.ground.tracing import array_module
from jaximu.ground.vectors import root_or_zero
from jaximu.model.effects import Effect
from jaximu.model.effects.reference_filter import behind
from jaximu.model.mounting import MOUNTING_EFFECTS, Mounting
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.attitude import Attitude
from jaximu.recordings.recording import Recording, smoothed_slope

EXCESS_NAMES = ("gyroscope", "reference attitude", "gyroscope bias walk", "accelerometer", "reference velocity")
_UNITS = (1e-4, 1e-3, 1e-5, 1e-3, 1e-2)
"""Standard deviation of each component at an excess of one: rad/√s, rad, rad/s/√s, m/s²·√s, m/s."""
RESIDUALS = (
    ResidualKind("specific_force", "specific force against gravity", "m/s^2", 3),
    ResidualKind("rotation", "rate against the reference", "rad/s", 3),
)
_KNOWN = 0.03
"""Share of `_UNITS` that white noise has at the least, where no recording at rest tells it."""
INTERVALS = 192
"""Intervals that a recording is cut into, at the most."""
WINDOW, _WITH_VELOCITY = 2.0, 1.0
"""Seconds of a window of the specific force: long where changes of velocity are to average out, shorter where they are
known, as few windows cannot tell their noise from what an accelerometer does wrong. With windows of 0.5 s intervals
came out a tenth too small in recordings of 30 s, which show too little of the noise that does not average out."""
_MARGIN, _BUCKET = 3, 32
"""Samples beside an interval, for the delay to move; and multiples that its samples are padded to: few programs."""
_SMOOTH = 0.05
"""Seconds over which the slope of the rate is taken."""
_MOVING = ("delay", "clock_scale")
"""Fields of `Mounting` that move the reference's stamps, and with them the ends of the integrals."""
_WINDOWS = 4
"""Their number is padded to a multiple of this: few programs, and few rows for nothing in matrices of conditions."""


class AttitudeConditions(Conditions):
    """Rotations over T intervals against the reference's (rad), and mean specific forces over W windows less gravity's.

    rotation, target: the unit's and the reference's, from the frame at an interval's end to that at its start; the
    former at (A | c) = `linear`, A = K⁻¹ and c = −K⁻¹ b, by which its last frame turns with `slope`. force: slope of a
    window's mean force (m/s², upright frame) by the accelerometer's (A | c); swung: by the gyroscope's, which turns the
    frames in between; gain: the velocity gained, less what sculling adds, over the time.
    """

    rotation: Float[Array, "T 4"]
    target: Float[Array, "T 4"]
    slope: Float[Array, "T 3 3 4"]
    linear: Float[Array, "3 4"]
    force: Float[Array, "W 3 3 4"]
    swung: Float[Array, "W 3 3 4"]
    gain: Float[Array, "W 3"]
    turn: Bool[Array, " T"]
    window: Bool[Array, " W"]
    magnitude: Number

    def __call__(self, imu: Imu) -> Float[Array, " n"]:
        """Return the errors of the rotations (rad) and of the mean forces (m/s²)."""
        change = imu.triad("gyroscope").inverse() - self.linear
        moved = jnp.einsum("tijk,jk->ti", self.slope, change)
        error = logarithm(multiply(conjugate(self.target), multiply(self.rotation, exponential(moved))))
        force = jnp.einsum("wijk,jk->wi", self.force, imu.accelerometer.inverse()) - self.gain
        force += jnp.einsum("wijk,jk->wi", self.swung, change) - self.magnitude * UP
        error, force = error * self.turn[:, None], force * self.window[:, None]
        return jnp.concatenate([error.ravel(), force.ravel()])


class Reactions(eqx.Module):
    """How an interval's rotation and its part of a window's mean force react to the samples of a triad, in SI.

    by_triad: all samples' axes in a row, which makes the reaction one product. sample: their places.
    """

    by_triad: dict[str, Float[Array, "T 6 3*S"]]
    sample: Int[Array, "T S"]

    def react(self, changes: Mapping[str, Float[Array, "m 3 k"]], windows: int) -> Float[Array, "n k"]:
        """Return how the conditions react to additions to every sample of triads."""
        return self.react_inside({name: change[self.sample] for name, change in changes.items()}, windows)

    def react_inside(self, changes: Mapping[str, Float[Array, "T S 3 k"]], windows: int) -> Float[Array, "n k"]:
        """Return how they react to additions to triads at the samples of each interval."""
        numerics = array_module(self, changes)
        rows = {
            name: change.reshape(len(change), 3 * change.shape[1], change.shape[-1]) for name, change in changes.items()
        }
        both = numerics.sum(numerics.stack([self.by_triad[name] @ change for name, change in rows.items()]), axis=0)
        turned, pushed = both[:, :3], both[:, 3:]
        summed = pushed.reshape(windows, len(pushed) // windows, *pushed.shape[1:]).sum(axis=1)
        return numerics.concatenate([turned, summed]).reshape(3 * (len(turned) + windows), both.shape[-1])


@dataclass(frozen=True)
class AttitudeDetails:
    """What a measured attitude is about: the intervals' lengths (T,), s, and how the conditions react to samples.

    measurement: the recording and its reference; imu: the unit, how the reference is mounted included.
    """

    duration: FloatArray
    reactions: Reactions
    measurement: AgainstAttitude
    imu: Imu

    @cached_property
    def tracks(self) -> list[dict[str, Track]]:
        """What the unit went through at the gyroscope's samples, the accelerometer's included: one observation."""
        stimulus = self.measurement.around(self.imu)
        return [dict.fromkeys(TRIADS, Track.padded(stimulus, np.zeros(len(np.asarray(stimulus.time)), np.int64), 1))]


class Intervals(eqx.Module):
    """What was recorded: the unit at its gyroscope's m samples, the reference at T + 1 of its stamps.

    since, until: between which a sample holds, s. slope, curve: first and second derivative of the rate's output.
    force: the accelerometer's output at the same times. stamp: of the reference, on its own clock; velocity: gained
    over each interval (m/s), zero where unknown.
    """

    rate: Float[Array, "m 3"]
    slope: Float[Array, "m 3"]
    curve: Float[Array, "m 3"]
    force: Float[Array, "m 3"]
    since: Float[Array, " m"]
    until: Float[Array, " m"]
    stamp: Float[Array, " T+1"]
    attitude: Float[Array, "T+1 4"]
    velocity: Float[Array, "T 3"]
    used: Bool[Array, " T"]
    gravity: Number


def _smoothed(imu: Imu, mounting: Mounting, data: Intervals, stamps: Float[Array, " k"]) -> Float[Array, "k 4"]:
    """Return the rotations by which the unit stands behind what a smoothed reference says, at times of the log."""
    time, matrix = (data.since + data.until) / 2, imu.triad("gyroscope").inverse()[:, :3]
    acceleration, jerk = (interpolated(time, slope, stamps) @ matrix.T for slope in (data.slope, data.curve))
    return exponential(behind(mounting.filter_variance, acceleration, jerk))


def reference_sigmas(excess: Mapping[str, float]) -> tuple[float, float]:
    """Return the noise of a reference's attitude (rad) and velocity (m/s), each axis, from a fit's excess by name."""
    attitude, velocity = (_UNITS[k] * float(np.sqrt(excess[EXCESS_NAMES[k]])) for k in (1, 4))
    return attitude, velocity


def _added(imu: Imu, data: Intervals, around: Stimulus) -> dict[str, Float[Array, "m 3"]]:
    """Return what effects add to both outputs, along the path that the unit without them tells, taken twice.

    around: what else the unit went through.
    """
    bare, time = imu.with_effects(), (data.since + data.until) / 2
    outputs = {"accelerometer": jnp.zeros_like(data.force), "gyroscope": jnp.zeros_like(data.rate)}
    for _ in range(2):
        turning = bare.triad("gyroscope").recover(data.rate - outputs["gyroscope"])
        inner = (turning[2:] - turning[:-2]) / (time[2:] - time[:-2])[:, None]
        stimulus = replace(
            around,
            specific_force=bare.accelerometer.recover(data.force - outputs["accelerometer"]),
            angular_rate=turning,
            time=time,
            angular_acceleration=jnp.concatenate([inner[:1], inner, inner[-1:]]),
        )
        outputs = added(imu, dict.fromkeys(TRIADS, Track(stimulus, jnp.zeros(len(time), int))))
    return outputs


def _stands(effect: Effect) -> bool:
    """Whether an effect says how the reference stands, and adds nothing to the unit's outputs."""
    return effect.owner == "setup" and effect.scope == "fixture"


def _held(mounting: Mounting, data: Intervals, samples: Int[Array, "T S"]) -> Float[Array, "T S"]:
    """Return how long the samples hold inside their interval, s of the reference's time, in which rates are meant."""
    stamps = mounting.on_log(data.stamp)
    held = jnp.minimum(data.until[samples], stamps[1:, None]) - jnp.maximum(data.since[samples], stamps[:-1, None])
    return jnp.maximum(held, 0.0) / (1 + mounting.clock_scale)


def evaluated(
    imu: Imu,
    mounting: Mounting,
    data: Intervals,
    samples: Int[Array, "T S"],
    noise: Matrix,
    group: int,
):
    """Return the conditions about a unit, rotations' white noise (T, 3, 3), times (T,), and reactions.

    Reactions: of a window's mean force to the rotation vector by which the reference stands wrong at an interval's
    start (T, 3, 3), and of all conditions to samples.

    **Arguments:** `imu`: without effects; `mounting`: of the reference; `samples`: samples of each interval, with some
    beside it; `noise`: density of the gyroscope's, output² s; `group`: intervals to a window of the force.
    """
    gyroscope, accelerometer = imu.triad("gyroscope"), imu.accelerometer
    held = _held(mounting, data, samples)
    turning, sensed = data.rate[samples], data.force[samples]
    whole = preintegrate_samples(gyroscope.recover(turning), accelerometer.recover(sensed), held)
    inverse = gyroscope.inverse()[:, :3]
    spread = white_covariance(whole.reaction[..., :3, :3], inverse @ noise @ inverse.T, held)
    true = multiply(
        multiply(data.attitude, mounting.turned), _smoothed(imu, mounting, data, mounting.on_log(data.stamp))
    )
    before, after = true[:-1], true[1:]
    target = multiply(conjugate(before), after)
    turn_slope, swung = jnp.split(linear_slope(whole.reaction[..., :6, :3], turning), 2, axis=1)
    slope = linear_slope(whole.reaction[..., 3:6, 3:], sensed)
    sculled = whole.velocity - jnp.einsum("tijk,jk->ti", slope, accelerometer.inverse())
    upright = rotation_matrix(multiply(mounting.tilted, before))
    duration = held.sum(axis=1) * data.used
    windows = len(samples) // group
    total = duration.reshape(windows, group).sum(axis=1)
    complete = data.used.reshape(windows, group).all(axis=1) & (total > 0)
    safe = jnp.where(complete, total, 1.0)
    share = upright * ((complete / safe).repeat(group) * data.used)[:, None, None]

    def by_window(parts):
        return jnp.einsum("tai,ti...->ta...", share, parts).reshape(windows, group, *parts.shape[1:]).sum(axis=1)

    gained = rotate(mounting.tilted, data.velocity.reshape(windows, group, 3).sum(axis=1))
    conditions = AttitudeConditions(
        whole.rotation,
        target,
        turn_slope,
        gyroscope.inverse(),
        by_window(slope),
        by_window(swung),
        gained / safe[:, None] - by_window(sculled),
        data.used,
        complete,
        data.gravity,
    )
    leaning = share @ jnp.cross(jnp.eye(3), whole.velocity[:, None]).mT
    turned = whole.reaction[..., :3, :] * data.used[:, None, None, None]
    reaction = jnp.concatenate([turned, share[:, None] @ whole.reaction[..., 3:6, :]], axis=-2)
    rows = [part.swapaxes(1, 2).reshape(len(samples), 6, -1) for part in jnp.split(reaction, 2, axis=-1)]
    return conditions, spread, duration, leaning, Reactions(dict(zip(reversed(TRIADS), rows, strict=True)), samples)


def shared_ends(back: Float[Array, "T 3 3"], leaning: Float[Array, "T 3 3"], windows: int) -> BlockFactor:
    """Return how errors (rad) of T + 1 attitudes in a row, each in its body's frame, enter rotations and mean forces.

    Neighbouring intervals share an end, and where the reference stands wrong there the force of the window leans.

    **Arguments:** `back`: from the frame at an interval's start to that at its end. `leaning`: of the window's force.
    """
    count = len(back)
    rotation = np.arange(3 * count).reshape(count, 3)
    force = 3 * count + 3 * (np.arange(count) * windows // count)[:, None] + np.arange(3)
    ends = -np.broadcast_to(np.eye(3), back.shape)
    return _of_ends([(rotation, ends)], [(rotation, back), (force, leaning)])


def _of_ends(ends: Sequence[tuple[IntArray, Array]], starts: Sequence[tuple[IntArray, Array]]) -> BlockFactor:
    """Return how T + 1 errors in a row enter rows (T, 3) of the T intervals between, as their ends and as starts."""
    parts, beside = [*ends, *starts], [(1, 0)] * len(ends) + [(0, 1)] * len(starts)
    rows = [np.pad(rows, (there, (0, 0)), mode="edge") for (rows, _), there in zip(parts, beside, strict=True)]
    numerics = array_module([values for _, values in parts])
    values = [numerics.pad(part, (there, (0, 0), (0, 0))) for (_, part), there in zip(parts, beside, strict=True)]
    return BlockFactor(np.hstack(rows), numerics.hstack(values))


@dataclass(frozen=True)
class AgainstAttitude(OfOneUnit):
    """One recording of a unit against a measured attitude, whose zero of time is the recording's (`offset`, s, later).

    noise: of the unit at rest, where known. left_out: windows of the force that do not count, with their rotations.
    """

    recording: Recording
    attitude: Attitude
    gravity: float
    noise: NoiseModel | None = None
    offset: float = 0.0
    left_out: tuple[int, ...] = ()

    excess_names = EXCESS_NAMES
    coarse = (1.0, 1.0, 1.0, 1.0, 1e2)
    no_fixture = "how the reference is mounted, late and smoothed is estimated in any case"

    @cached_property
    def intervals(self) -> Intervals:
        """What was recorded, the reference thinned to some two hundred intervals."""
        attitude, (accelerometer, gyroscope) = self.attitude, map(self.recording.signals.__getitem__, TRIADS)
        time, edges = gyroscope.time, gyroscope.edges
        stamps = attitude.time + self.offset
        knots, group = self._knots
        count = len(knots) - 1
        size = -(-count // (_WINDOWS * group)) * _WINDOWS * group
        gaps = np.cumulative_sum(np.diff(time) > 2.5 / gyroscope.rate, include_initial=True)
        missing = (np.diff(attitude.time) > 2.5 * attitude.period) | np.isnan(attitude.turned()).any(axis=1)
        holes = np.cumulative_sum(missing, include_initial=True)
        used = (np.diff(np.interp(stamps[knots], time, gaps)) == 0) & (np.diff(holes[knots]) == 0)
        used &= ~np.isin(np.arange(count) // group, self.left_out)
        gained = np.zeros((size, 3))
        if (velocity := attitude.velocities()) is not None:
            gained[:count] = np.diff(velocity[knots], axis=0)
        knots = np.pad(knots, (0, size - count), mode="edge")
        slope, curve = _slopes(time, gyroscope.values)
        return Intervals(
            gyroscope.values,
            slope,
            curve,
            accelerometer.at(time),
            edges[:-1],
            edges[1:],
            stamps[knots],
            attitude.quaternion[knots],
            gained,
            np.pad(used, (0, size - count)),
            np.float64(self.gravity),
        )

    @cached_property
    def _knots(self) -> tuple[IntArray, int]:
        """Rows of the reference between which the intervals lie, and how many intervals make a window of the force."""
        gyroscope, attitude = self.recording.signals["gyroscope"], self.attitude
        margin, stamps = 3 / gyroscope.rate, attitude.time + self.offset
        rows = np.flatnonzero((stamps > gyroscope.time[0] + margin) & (stamps < gyroscope.time[-1] - margin))
        stride = max(1, int(np.ceil(len(rows) / INTERVALS)), int(np.ceil(4 / gyroscope.rate / attitude.period)))
        window = WINDOW if attitude.velocities() is None else _WITH_VELOCITY
        return rows[::stride], max(1, round(window / (stride * attitude.period)))

    @property
    def group(self) -> int:
        """Intervals to a window of the specific force."""
        return self._knots[1]

    def _places(self, mounting: Mounting) -> IntArray:
        """Samples (T, S) of each interval, with some more on either side for the delay to move."""
        data = self.intervals
        stamps = mounting.on_log(data.stamp)
        first = data.until.searchsorted(stamps[:-1]) - _MARGIN
        longest = data.until.searchsorted(stamps[1:]) - first + _MARGIN
        size = -(-int(longest[data.used].max()) // _BUCKET) * _BUCKET
        return (first[:, None] + np.arange(size)).clip(0, len(data.until) - 1)

    def unsmoothed(self, imu: Imu) -> Attitude:
        """Return the reference as it would be without the filter that a fitted unit's set-up says it has."""
        mounting = Mounting.of(imu)
        smoothed = _smoothed(imu, mounting, self.intervals, mounting.on_log(self.attitude.time + self.offset))
        sharp = mounting.reported(multiply(mounting.unit_attitude(self.attitude.quaternion), smoothed))
        return replace(self.attitude, quaternion=np.asarray(sharp))

    def densities(self) -> tuple[FloatArray, float]:
        """White noise of the gyroscope (3, 3), output² s, and of the accelerometer, (m/s²)² s."""
        white, force = np.full(3, (_KNOWN * _UNITS[0]) ** 2), (_KNOWN * _UNITS[3]) ** 2
        if self.noise is not None and self.noise.gyroscope is not None:
            white, force = self.noise.gyroscope.split(0.25)[0], float(self.noise.accelerometer.split(0.25)[0].mean())
        return np.diag(white * self.recording.signals["gyroscope"].nominal_scale ** 2), force

    def white_noise(self, excess: Mapping[str, float]) -> NoiseModel:
        """Return the white noise of accelerometer and gyroscope that a fit shows, which is all that motion shows."""
        rate, force = self.densities()
        rate = np.diag(rate) / self.recording.signals["gyroscope"].nominal_scale ** 2
        return NoiseModel(
            AxisNoise.of_white(force + excess["accelerometer"] * _UNITS[3] ** 2),
            AxisNoise.of_white(rate + excess["gyroscope"] * _UNITS[0] ** 2),
        )

    def around(self, imu: Imu) -> Stimulus:
        """Return what the unit went through at the gyroscope's samples as it measured it, standing as was measured."""
        known = stimuli(self.recording, imu)["gyroscope"]
        mounting = Mounting.of(imu)
        stamps = mounting.on_reference(np.asarray(known.time)) - self.offset
        stood = self.attitude.at(np.clip(stamps, *self.attitude.time[[0, -1]])).as_quat(scalar_first=True)
        return replace(known, attitude=np.asarray(multiply(stood, mounting.turned)))

    def rows(self, imu: Imu) -> Rows:
        """Return what each condition is: three of each rotation, then three of each window's mean force."""
        stamps, used, group = self.intervals.stamp, self.intervals.used, self.group
        ends = stamps[::group]
        window = np.arange(len(ends) - 1)
        observation = np.concatenate([window.repeat(group), window]).repeat(3)
        middle = np.concatenate([midpoints(stamps), midpoints(ends)])
        rotations = (np.arange(len(middle)) < len(used))[:, None]
        signals = self.recording.signals
        force, rate = (interpolated(signals[name].time, signals[name].si(), middle) for name in TRIADS)
        covariates = {TIME: middle} | by_axis("rate", "°/s", np.where(rotations, np.degrees(rate), np.nan))
        covariates |= by_axis("specific force", "m/s²", np.where(rotations, np.nan, force))
        if warmth := signals.get("temperature"):
            covariates[TEMPERATURE] = warmth.at(middle)[:, 0]
        length = np.concatenate([np.where(used, np.diff(stamps), 1.0), np.ones(len(window))])
        return Rows(
            kinds=RESIDUALS,
            kind=np.repeat([1, 0], [3 * len(used), 3 * len(window)]),
            first=observation,
            last=observation,
            to_si=(1 / length).repeat(3),
            used=np.concatenate([used, used.reshape(-1, group).all(axis=1)]).repeat(3),
            covariates={name: values.repeat(3) for name, values in covariates.items()},
            spans=self.spans()[0],
            observation="motion",
        )

    def about_one(self, imu: Imu) -> About:
        """Return the conditions about the unit, their covariance, and columns of effects, of the set-up's included."""
        group, bare, mounting, effects = self.group, imu.with_effects(), Mounting.of(imu), imu.all_effects()
        data, slopes = self._freed(imu)
        noise, white = self.densities()

        def compute(imu, mounting, data, samples, noise):
            def of(numbers):
                parts = evaluated(imu, mounting._replace(**numbers), data, samples, noise, group)
                return parts[0](imu), parts

            fields = {name: jnp.asarray(values) for name, values in mounting._asdict().items()}
            delays = {name: fields.pop(name) for name in _MOVING}  # apart: derivatives of the integrals take long
            by_delay, parts = jax.jacfwd(of, has_aux=True)(delays)
            return *parts, by_delay | jax.jacfwd(lambda numbers: of(numbers)[0])(fields)

        def by_samples(imu, mounting, data, conditions, reactions, slopes):
            held, triads = _held(mounting, data, reactions.sample), imu.triads()
            rates = triads["gyroscope"].recover(data.rate[reactions.sample])

            def bent(change):  # coning and sculling change with it
                return increments(rates, change, held)[1] / jnp.where(held > 0, held, 1.0)[..., None]

            changes = {name: inverse_matrix(triads[name].gain) @ slopes[name] for name in TRIADS}
            inside = {name: jax.vmap(bent, -1, -1)(change[reactions.sample]) for name, change in changes.items()}
            columns = -reactions.react_inside(inside, len(conditions.window))
            turns = 3 * len(conditions.turn)
            error = conditions(imu)[:turns].reshape(-1, 3)
            turned = jnp.linalg.solve(right_jacobian(error), columns[:turns].reshape(*error.shape, columns.shape[1]))
            return jnp.concatenate([turned.reshape(turns, columns.shape[1]), columns[turns:]])

        conditions, spread, duration, leaning, reactions, by_mounting = stored.call(
            compute, f"against attitude {group}", bare, mounting, data, self._places(mounting), noise, quick=False
        )
        columns = stored.call(
            by_samples, "against attitude by samples", bare, mounting, data, conditions, reactions, slopes, quick=False
        )
        kinds: list[type[Effect]] = [*MOUNTING_EFFECTS]
        by_kind = {kind: by_mounting[field] for kind, field in zip(kinds, Mounting._fields, strict=True)}
        parted: list[Any] = [columns[:, :0]]
        for effect in effects.values():
            size = effect.size + len(effect.inner)
            mine = by_kind.get(type(effect), np.zeros((len(columns), size))).reshape(len(columns), size)
            if not _stands(effect):
                mine, columns = np.split(columns, [size], axis=1)
            parted.append(mine)
        columns = free_columns(effects, np.hstack(parted))
        covariance = self._covariance(conditions, spread, duration, leaning, white)
        return About(conditions, covariance, columns, details=AttitudeDetails(duration, reactions, self, imu))

    def _freed(self, imu: Imu) -> tuple[Intervals, dict[str, Array]]:
        """Return what was recorded without what effects add, and the slopes (m, 3, q) of that by their numbers.

        How the reference stands adds nothing.
        """
        data, bare = self.intervals, imu.with_effects()
        adding = bare.with_effects(*(effect for effect in imu.all_effects().values() if not _stands(effect)))
        parameters = Parameters.select(adding, lambda name: name.effect is not None)
        if not parameters.names:
            return data, dict.fromkeys(TRIADS, np.zeros((*data.rate.shape, 0)))

        def compute(imu, parameters, data, around):
            count = len(parameters.index)
            outputs, push = jax.linearize(lambda z: _added(parameters.model(imu, z), data, around), jnp.zeros(count))
            slopes = jax.lax.map(push, jnp.diag(1 / parameters.size))  # one by one they stay in the processor's cache
            return outputs, {name: jnp.moveaxis(slope, 0, -1) for name, slope in slopes.items()}

        outputs, slopes = stored.call(
            compute, "added against attitude", adding, parameters, data, self.around(imu), quick=False
        )
        force, rate = (values - outputs[name] for name, values in zip(TRIADS, (data.force, data.rate), strict=True))
        return eqx.tree_at(lambda data: (data.force, data.rate), data, (force, rate)), slopes

    def reactions(self, details: AttitudeDetails):
        """Return how rotations and mean forces react to effects of a unit that stands as the reference says."""
        windows = len(details.duration) // self.group

        def of(effect, imu, part):
            tracks, reactions = part
            acting = {name: track for name, track in tracks.items() if effect.owner in (name, "setup")}
            outputs, triads = added(imu.with_effects(effect), acting), imu.triads()
            felt = {name: (values @ inverse_matrix(triads[name].gain).T)[..., None] for name, values in outputs.items()}
            return reactions.react(felt, windows)[:, 0]

        return f"against attitude {windows}", of, [(tracks, details.reactions) for tracks in details.tracks]

    # --- what a diagnosis needs to know ---------------------------------------------------------------------------

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """What was recorded."""
        return (self.recording,)

    def spans(self) -> list[FloatArray]:
        """Return start and stop (k, 2), s, of the windows of the specific force."""
        ends = self.intervals.stamp[:: self.group]
        return [np.column_stack([ends[:-1], ends[1:]])]

    def rests(self) -> list[FloatArray]:
        """Return none: the unit is in motion, and its noise is the fit's."""
        return [np.zeros((0, 2))]

    def observed(self, imu: Imu, details: AttitudeDetails) -> Observed:
        """Return the samples, along which shapes act: slow changes, and what depends on orientation."""
        (tracks,), stamps = details.tracks, self.intervals.stamp
        stimulus, windows = tracks["gyroscope"].stimulus, len(details.duration) // self.group
        force = np.asarray(stimulus.specific_force)

        def react(triad: str, shape: FloatArray) -> FloatArray:
            along = np.einsum("ij,mk->mijk", np.eye(3), shape).reshape(len(shape), 3, -1)
            return np.asarray(details.reactions.react({triad: along}, windows))

        return Observed(react, (np.asarray(stimulus.time) - stamps[0]) / np.ptp(stamps), up=unit_vectors(force))

    def without(self, observation: int) -> AgainstAttitude:
        """Return the recording with a window of the force left out, and the rotations in it."""
        return replace(self, left_out=(*self.left_out, observation))

    def rms(self, imu: Imu, details: AttitudeDetails, conditions: FloatArray) -> Sizes:
        """Return the rms of each kind of residual, with its unit, as a calibration has it."""
        sizes = super().rms(imu, details, conditions)
        return sizes | {"rotation": (float(np.degrees(sizes["rotation"][0])), "deg/s")}

    def _covariance(
        self, conditions, spread: FloatArray, duration: FloatArray, leaning: FloatArray, white: float
    ) -> Covariance:
        """White noise that is known, and the components of what is not."""
        turn, window = conditions.turn, conditions.window
        turns, windows = len(turn), len(window)
        total = np.where(window, duration.reshape(windows, -1).sum(axis=1), 1.0)
        n = 3 * (turns + windows)
        rows, later = np.arange(3 * turns).reshape(turns, 3), 3 * turns + np.arange(3 * windows).reshape(windows, 3)
        measured = np.zeros((n, n))
        measured[rows[:, :, None], rows[:, None, :]] = spread
        measured[later, later] = (white / total)[:, None]
        used = np.concatenate([turn.repeat(3), window.repeat(3)]).astype(float)
        measured *= np.outer(used, used)

        def placed(rows, factor):
            whole = np.zeros((n, *factor.shape[1:]))
            whole[rows.ravel()] = factor
            return (whole.T * used).T

        back = np.asarray(rotation_matrix(conditions.target)).mT
        step = root_or_zero(duration)
        walk = np.kron(np.tril(np.ones((turns, turns))) * step * duration[:, None], np.eye(3))
        mean = np.eye(3) / total[:, None, None]
        factors = (
            placed(rows, step.repeat(3)) * _UNITS[0],
            shared_ends(back, leaning, windows).of_rows(_UNITS[1] * used),
            placed(rows, walk) * _UNITS[2],
            placed(later, (total**-0.5).repeat(3)) * _UNITS[3],
            _of_ends([(later, mean)], [(later, -mean)]).of_rows(_UNITS[4] * used),
        )
        return Covariance(measured, factors, used, np.repeat([0, 3], [3 * turns, 3 * windows]))

    def errors(self, imu: Imu) -> dict[str, tuple[FloatArray, FloatArray, str]]:
        """Return times (k,), errors (k, 3) and unit of the rotations, over their time, and of the mean forces."""
        about = self.about_one(imu)
        conditions: Any = about.conditions
        values = np.asarray(conditions(imu.with_effects()))
        turn, window = conditions.turn, conditions.window
        rate = values[: 3 * len(turn)].reshape(-1, 3)[turn] / about.details.duration[turn, None]
        middle = midpoints(self.intervals.stamp)
        forces = values[3 * len(turn) :].reshape(-1, 3)[window]
        return {
            "rotation": (middle[turn], np.degrees(rate), "deg/s"),
            "specific_force": (middle.reshape(len(window), -1).mean(axis=1)[window], forces, "m/s^2"),
        }


def _slopes(time: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return first and second derivative of values (m, 3), each of lines through `_SMOOTH` seconds."""
    slope = np.column_stack([smoothed_slope(time, axis, _SMOOTH) for axis in values.T])
    return slope, np.column_stack([smoothed_slope(time, axis, _SMOOTH) for axis in slope.T])
