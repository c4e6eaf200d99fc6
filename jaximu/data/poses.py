"""Poses and turns by hand: gravity's norm, its direction carried over each turn, and the gyroscope at rest.

Unknown are the unit and each pose's attitude; measured are the mean outputs at rest and the rotation of each turn.
Headings are fixed by nothing but the turns and take up one component of each; the direction of gravity in a pose has
two more unknowns. With the attitudes eliminated a pose leaves the norm of its specific force, and a turn two components
of carried gravity: the residuals of the two-step method, but as functions of the whole unit and, since neighbouring
turns share a pose, correlated. Whitened with their full covariance (`jaximu.data.poses_covariance`) they are the
maximum-likelihood problem to first order in the noise (Gauss–Helmert model; Förstner and Wrobel, Photogrammetric
Computer Vision, 2016, sec. 4.8); the second order is the noise squared, 1e-8.

Turns are integrated here, once for each unit that the measurement is evaluated about: the rate ω = A y + c, A = K⁻¹ and
c = −K⁻¹ b, is linear in (A, c), so a change of them turns the last body frame by a sum over the samples that is made
beforehand (pre-integration; Forster et al., IEEE Transactions on Robotics 33, 2017, sec. VI, with all of K and not the
bias alone). A turn about a fixed axis is linear in (A, c) however far it goes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaximu.data.gravity_direction import gravity_direction_error
from jaximu.data.gravity_norm import gravity_norm_error
from jaximu.data.poses_covariance import Sensitivities, condition_covariance, sensitivities, turned_by
from jaximu.data.preintegration import Turned, linear_slope
from jaximu.data.tracks_by_hand import SamplesByHand, during_turns, samples_by_hand, tracks_by_hand
from jaximu.estimation.covariance import Chain, Covariance
from jaximu.estimation.data import About, Conditions, Data
from jaximu.estimation.fitting import effect_numbers
from jaximu.estimation.problem import Name
from jaximu.estimation.rows import TEMPERATURE, TIME, ResidualKind, Rows, Sizes, by_axis
from jaximu.estimation.track import Track, added, mean_outputs, means_by
from jaximu.ground import stored
from jaximu.ground.array_types import Array, FloatArray, IntArray
from jaximu.ground.distributions import rms
from jaximu.ground.errors import InputError
from jaximu.ground.gravity import STANDARD, Gravity, as_gravity
from jaximu.ground.rotation import (
    Number,
    apply_matrix,
    conjugate,
    exponential,
    integrate_rates,
    inverse_matrix,
    multiply,
    rotate,
    unit_vectors,
)
from jaximu.ground.tracing import array_module, first, lifted, on_host, one_by_one, part_of, repeated, stacked
from jaximu.ground.vectors import dot_rows, lengths_of
from jaximu.mistakes import Prepared, one_or_several, prepared
from jaximu.model.effects.base import Effect
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.recordings.observations import Observations
from jaximu.recordings.recording import Recording
from jaximu.recordings.segmentation import observed_poses, segment

EXCESS_NAMES = ("accelerometer", "turns", "gyroscope")
NO_FIXTURE = "a hand-held recording has no set-up to compare with"
COARSE_EXCESS = (1e2, 1e4, 1e2)
"""The first pass starts at the data sheet's values, percents away: weights as sharp as the noise would make it chase
wrong minima, so they are blunted by this excess. The next pass finds the right ones."""
RESIDUALS = (
    ResidualKind("gravity_norm", "gravity norm at rest", "m/s^2", 1),
    ResidualKind("gravity_direction", "gravity carried over a turn", "deg", 2, float(np.degrees(1.0))),
    ResidualKind("static_gyroscope", "rate at rest", "rad/s", 3, centred=True),
)


_ROUNDS = 4
"""Times that tracks are taken anew with what effects add taken off: effects of a twentieth leave a millionth of it."""


class HandHeldConditions(Conditions):
    """Poses and turns without their samples: `gravity_norm`, `gravity_direction` and `static_gyroscope`, unweighted.

    rotation: of each turn, integrated where (A | c) was `linear`; slope: of its last body frame's rotation vector by
    (A | c).
    """

    accelerometer_mean: Float[Array, "P 3"]
    gyroscope_mean: Float[Array, "P 3"]
    pose: Bool[Array, " P"]
    turn: Bool[Array, " T"]
    basis: Float[Array, "T 2 3"]
    rotation: Float[Array, "T 4"]
    slope: Float[Array, "T 3 3 4"]
    linear: Float[Array, "3 4"]
    magnitude: Number

    def rotations(self, imu: Imu) -> Float[Array, "T 4"]:
        """Return the turns' rotations, quaternions from the last body frame to the first, at a unit close by."""
        moved = jnp.einsum("tijk,jk->ti", self.slope, imu.triad("gyroscope").inverse() - self.linear)
        return multiply(self.rotation, exponential(moved))

    def forces(self, imu: Imu) -> Float[Array, "P 3"]:
        """Return the specific force (m/s²) of each pose."""
        triad = imu.accelerometer
        return apply_matrix(inverse_matrix(triad.gain), self.accelerometer_mean - triad.bias)

    def __call__(self, imu: Imu) -> Float[Array, " n"]:
        """Return the norms (m/s²), two components of carried gravity a turn, and the means at rest (output units)."""
        force = self.forces(imu)
        norm = jnp.where(self.pose, gravity_norm_error(force, self.magnitude), 0.0)
        direction = gravity_direction_error(self.rotations(imu), unit_vectors(force), self.basis)
        rest = jnp.where(self.pose[:, None], self.gyroscope_mean - imu.triad("gyroscope").bias, 0.0)
        return jnp.concatenate([norm, jnp.where(self.turn[:, None], direction, 0.0).ravel(), rest.ravel()])


def condense(
    imu: Imu, observations: Observations, method: str = "exponential"
) -> tuple[HandHeldConditions, Covariance | Chain, Turned, Sensitivities]:
    """Return the conditions about a unit, without its effects, their covariance, and what both were made of."""
    imu, poses, turns = imu.with_effects(), observations.poses, observations.turns
    gyroscope = imu.triad("gyroscope")
    whole = turned_by(gyroscope, turns)
    rotation = whole.rotation
    if method != "exponential":
        rotation = integrate_rates(gyroscope.recover(turns.output), turns.interval, method)
    conditions = HandHeldConditions(
        poses.accelerometer_mean,
        poses.gyroscope_mean,
        poses.mask,
        turns.mask,
        turns.basis,
        rotation,
        jnp.einsum("tij,tjkl->tikl", whole.back, linear_slope(whole.sweep, turns.output)),
        gyroscope.inverse(),
        observations.gravity,
    )
    covariance = condition_covariance(imu, observations, whole)
    return conditions, covariance, whole, sensitivities(imu, observations, whole)


class Condensed(NamedTuple):
    """Observations condensed about units without effects, along a leading axis.

    force (N, P, 3), m/s², of each pose; angle (N, T), rad, from measured to carried gravity. Of a single unit, reaction
    and running (T, S, 4), the turns' rotations after each sample, too, without that axis.
    """

    conditions: HandHeldConditions
    covariance: Covariance | Chain
    force: FloatArray
    angle: FloatArray
    reaction: Sensitivities | None
    running: FloatArray | None


def as_observations(observations: Observations) -> Observations:
    """Return the observations alone, without what a kind of data adds to them: one structure, one program."""
    return Observations(observations.poses, observations.turns, observations.gravity, observations.slow)


def condensed(
    imu: Imu,
    observations: Observations,
    rows: str = "all",
    method: str = "exponential",
    accelerometer_excess: FloatArray | None = None,
) -> Condensed:
    """Condense observations of units, compiled; `rows` and what follows as for `PosesAndTurns`."""
    count = len(imu.accelerometer.bias)
    excess = np.zeros(count) if accelerometer_excess is None else accelerometer_excess
    observations = as_observations(observations)

    def batch(imu, observations, excess):
        def lane(unit):
            imu, observations, excess = unit
            conditions, covariance, whole, reaction = condense(imu, observations, method)
            single = (reaction, whole.running) if count == 1 else (None, None)
            return Condensed(conditions, only(covariance, rows, excess), *_errors(conditions, imu), *single)

        return jax.lax.map(lane, (imu, observations, excess))

    units: Condensed = stored.call(
        batch, f"condensed {rows} {method}", imu.with_effects(), observations, excess, quick=count == 1
    )
    reaction, running = first((units.reaction, units.running))
    return units._replace(reaction=reaction, running=running)


class Along(NamedTuple):
    """Poses and turns about one unit with effects: what was condensed (a leading axis of one), and the tracks.

    observations: with what the effects add taken off. tracks: of both triads, recording by recording.
    """

    observations: Observations
    condensed: Condensed
    tracks: list[dict[str, Track]]

    @property
    def reaction(self) -> Sensitivities:
        """How the conditions react to the outputs."""
        assert self.condensed.reaction is not None
        return self.condensed.reaction


class PosesAndTurns(Observations, Data):
    """What was observed of a unit, or of units with a leading axis on every array.

    conditions: "all"; "norm", gravity's magnitude alone; or "turning", all but that, neighbouring turns taken as
    independent and the accelerometer as known. accelerometer_excess: of its poses, with "turning". samples: of each
    recording, along which effects act; without them effects are refused. method: how rates are integrated.
    """

    accelerometer_excess: Float[Array, ...] | None = None
    samples: tuple[SamplesByHand, ...] = ()
    conditions: str = eqx.field(static=True, default="all")
    method: str = eqx.field(static=True, default="exponential")

    excess_names = EXCESS_NAMES
    coarse = COARSE_EXCESS
    no_fixture = NO_FIXTURE

    @classmethod
    def of(cls, observations: Observations, conditions: str = "all", **settings: Any) -> Self:
        """Return what was observed as data of a fit."""
        return cls(**vars(as_observations(observations)), conditions=conditions, **settings)

    def free(self, name: Name) -> bool:
        """Return whether a number is free: of the triads that the conditions tell of."""
        owners = {"norm": ("accelerometer",), "turning": ("gyroscope",)}.get(self.conditions)
        return super().free(name) and (owners is None or name.owner in owners)

    def take(self, lanes: IntArray) -> Self:
        """Return the data of some of the units."""
        return part_of(self._by_unit(), lanes)

    def widened(self, poses: int, samples: int, lengths: Sequence[Mapping[str, int]] = ()) -> Self:
        """Return the data of a unit with padding up to so many poses, and samples in a turn, and of each recording."""
        longer = partial(resized, numerics=array_module(self))
        turns = {name: longer(getattr(self.turns, name), poses - 1) for name in ("basis", "mask")}
        turns |= {name: longer(getattr(self.turns, name), poses - 1, samples) for name in ("output", "interval")}
        wider = jax.tree.map(lambda leaf: longer(leaf, poses), self.poses), replace(self.turns, **turns)
        if not self.samples:
            return eqx.tree_at(lambda data: (data.poses, data.turns), self, wider)
        lengths = lengths or [recording.lengths() for recording in self.samples]
        longest = zip(self.samples, lengths, strict=True)
        part = tuple(recording.widened(length, poses - 1, samples) for recording, length in longest)
        return eqx.tree_at(lambda data: (data.poses, data.turns, data.samples), self, (*wider, part))

    def rows(self, imu: Imu) -> Rows:
        """Return what each condition of one unit is."""
        return pose_rows(imu, self)

    def about(self, imu: Imu) -> About:
        """Return the conditions about units; raise `InputError` for effects where there are no samples."""
        data, effects = self._by_unit(), felt_by_hand(imu)
        if not effects:
            details = condensed(imu, data, self.conditions, self.method, data.accelerometer_excess)
            none = np.zeros((*details.covariance.used.shape, len(effect_numbers(imu)[0])))
            return About(details.conditions, details.covariance, none, details)
        if not self.samples:
            names = ", ".join(effect.name for effect in effects)
            raise InputError(
                f"{names} cannot be fitted to poses and turns alone, which hold no samples along which effects act: "
                "observe them with samples=True, or name the effects to jaximu.calibrate."
            )

        def one(imu: Imu, data: Self) -> tuple[Any, ...]:
            details = data.along(imu, felt_by_hand(imu))
            conditions, covariance = first((details.condensed.conditions, details.condensed.covariance))
            return conditions, covariance, data.own_columns(imu, details, len(covariance.used))

        return About(*one_by_one(one, imu, data))

    def along(self, imu: Imu, effects: Sequence[Effect]) -> Along:
        """Return what one unit went through about it, and the poses and turns without what its effects add.

        The tracks tell what effects add, and what they add changes the tracks: an error of theirs shrinks every time by
        as much as the effects are small beside what the unit measures.
        """
        bare, affected = imu.with_effects(), imu.with_effects(*effects)
        units = [affected.in_recording(number) for number in range(1, len(self.samples) + 1)]

        def tracks(data: PosesAndTurns) -> tuple[Condensed, list[dict[str, Track]]]:
            unit, of = lifted((bare, replace(data, samples=())))
            whole = condensed(unit, of, self.conditions, self.method, of.accelerometer_excess)
            return whole, [tracks_by_hand(bare, part, whole.running) for part in data.samples]

        def without(data: PosesAndTurns) -> PosesAndTurns:
            return _without_added(units, self, tracks(data)[1])

        left = repeated(without, self, _ROUNDS, imu) if effects else self
        return Along(left, *tracks(left))

    def moved(self, changes: Sequence[Mapping[str, Float[Array, "n 3"]]]) -> PosesAndTurns:
        """Return the data of one unit had the outputs of both triads differed by so much at each recording's samples.

        In the same poses and turns; so what follows from the data is differentiated by raw samples. **Arguments:**
        `changes`: of each recording and triad, as long as in `samples`, padding included.
        """
        means, turned, parts = [], self.turns.output, []
        for part, change in zip(self.samples, changes, strict=True):
            means.append([means_by(pose, change[name], len(self.poses.mask))[0] for name, pose in part.pose.items()])
            turned = turned + during_turns(change["gyroscope"], part.sample)
            parts.append(replace(part, outputs={name: part.outputs[name] + change[name] for name in part.outputs}))
        force, rate = (sum(of_part) for of_part in zip(*means, strict=True))
        poses = replace(
            self.poses,
            accelerometer_mean=self.poses.accelerometer_mean + force,
            gyroscope_mean=self.poses.gyroscope_mean + rate,
        )
        return replace(self, poses=poses, turns=replace(self.turns, output=turned), samples=tuple(parts))

    def reactions(self, details: Along):
        """Return how norms, directions and means at rest react to effects, recording by recording."""

        def of(effect, imu, part):
            tracks, samples, reaction = part
            outputs = added(imu.with_effects(effect), tracks)
            means = mean_outputs(tracks, outputs, reaction.norm.shape[0])
            force = means[:, :3]
            norm = (reaction.norm * force).sum(axis=-1)
            turn = jnp.einsum("tai,ti->ta", reaction.after, force[1:])
            turn += jnp.einsum("tai,ti->ta", reaction.before, force[:-1])
            turn += jnp.einsum("tasi,tsi->ta", reaction.turn, during_turns(outputs["gyroscope"], samples))
            return jnp.concatenate([norm, turn.ravel(), means[:, 3:].ravel()])

        parts = zip(details.tracks, self.samples, strict=True)
        return "by hand", of, [(tracks, part.sample, details.reaction) for tracks, part in parts]

    def _by_unit(self) -> Self:
        """Return the data with a leading axis."""
        return lifted(self) if np.ndim(self.gravity) == 0 else self


@partial(stored.compiled, quick=True)
def _without_added(units: Sequence[Imu], data: PosesAndTurns, tracks: Sequence[dict[str, Track]]) -> PosesAndTurns:
    """Return data without what a unit's effects add along the tracks of each recording, as it was in each."""
    outputs = [added(imu, track) for imu, track in zip(units, tracks, strict=True)]
    return data.moved([{name: -values for name, values in of.items()} for of in outputs])


def felt_by_hand(imu: Imu) -> tuple[Effect, ...]:
    """Return the effects of a unit that a recording by hand feels: none of a set-up."""
    return tuple(effect for effect in imu.all_effects().values() if effect.scope != "fixture")


def observe(
    recordings: Recording | Prepared | Sequence[Recording | Prepared],
    gravity: Gravity = STANDARD,
    noise: NoiseModel | None = None,
    samples: bool = False,
) -> PosesAndTurns:
    """Return poses and turns of recordings of one unit as data of a fit; chosen on the host, a PyTree of arrays.

    **Arguments:** `recordings`: one or several; each may have been looked over by [`jaximu.mistakes.prepare`][], which
    says what was found in it. `gravity`: local gravity, m/s². `noise`: fitted to the unit at rest; without it the
    scatter within the poses tells the noise. `samples`: keep the samples, which a fit of effects needs. A fit starts at
    the data sheet's values, [`jaximu.calibration.nominal_imu`][].

    Rows that are no measurement are left out. Raises `InputError` where gyroscopes are missing from some recordings,
    and `NotPossibleError` where there are no poses.
    """
    several = one_or_several(recordings)
    without = [one.name for one in several if "gyroscope" not in one.signals]
    if 0 < len(without) < len(several):
        raise InputError(f"{without[0]} has no gyroscope and others have: observe them apart.")
    if samples and without:
        raise InputError(f"{without[0]} has no gyroscope, without which no effect can be fitted: leave samples out.")
    with prepared(several, gyroscope=not without) as ready:
        segmentations = [segment(one.recording) for one in ready]
        observations = observed_poses(segmentations, as_gravity(gravity).value, noise=noise)
    kept = samples_by_hand(segmentations, observations) if samples else ()
    return PosesAndTurns.of(observations, "norm" if without else "all", samples=kept)


def stack(data: Sequence[PosesAndTurns]) -> PosesAndTurns:
    """Return data of units as one, with a leading axis: padded to as many poses and samples as the longest has.

    Rates may differ. Raises `InputError` where conditions or thermometers differ, samples or the number of recordings,
    and where slow noise ties intervals whose numbers differ.
    """
    if not data:
        raise InputError("nothing to stack: give the data of one unit or more.")
    if any(part.recorded.shaken is not None for unit in data for part in unit.samples):
        data = [replace(unit, samples=tuple(part.asked_for_vibration() for part in unit.samples)) for unit in data]
    poses, samples = (max(unit.turns.interval.shape[axis] for unit in data) for axis in (0, 1))
    alike, wide = {jax.tree.structure(unit) for unit in data}, data
    if len(alike) == 1:
        lengths = [
            {name: max(part.lengths()[name] for part in parts) for name in parts[0].lengths()}
            for parts in zip(*(unit.samples for unit in data), strict=True)
        ]
        wide = [unit.widened(poses + 1, samples, lengths) for unit in data]
    if len(alike) > 1 or len({tuple(map(np.shape, jax.tree.leaves(unit))) for unit in wide}) > 1:
        raise InputError(
            "these units' data differ in kind (gyroscope, thermometer, slow noise, its intervals, samples, number of "
            "recordings): stack those alike."
        )
    return stacked(wide)


def resized(leaf: Array, *lengths: int, numerics: Any = np) -> Array:
    """Return an array of observations with padding cut off or added, to one or two leading lengths."""
    leaf = leaf[tuple(slice(length) for length in lengths)]
    if leaf.shape[: len(lengths)] == lengths:
        return leaf
    missing = [(0, length - have) for length, have in zip(lengths, leaf.shape, strict=False)]
    missing += [(0, 0)] * (leaf.ndim - len(lengths))
    # masks and durations of padding are zero; whatever else it holds must be finite
    zero = leaf.dtype == bool or len(lengths) > 1
    return numerics.pad(leaf, missing) if zero else numerics.pad(leaf, missing, mode="edge")


def pose_rows(imu: Imu, observations: Observations) -> Rows:
    """Return what each of the conditions of poses and turns is, by a unit close to this one."""
    poses, turns = on_host((observations.poses, observations.turns))
    gyroscope = imu.triad("gyroscope")
    pose, turn = np.arange(len(poses.mask)), np.arange(len(turns.mask))

    def placed(of_poses, of_turns):
        return np.concatenate([of_poses, of_turns.repeat(2, axis=0), of_poses.repeat(3, axis=0)])

    unknown = np.full(len(pose), np.nan), np.full(len(turn), np.nan)
    speed = np.degrees(lengths_of(gyroscope.recover_on_host(turns.output))) * (turns.interval > 0)
    middle = (poses.start + poses.stop) / 2, (poses.stop[:-1] + poses.start[1:]) / 2
    covariates = {TIME: placed(*middle), TEMPERATURE: placed(poses.temperature, unknown[1])}
    forces = imu.accelerometer.recover_on_host(poses.accelerometer_mean)
    covariates |= by_axis("specific force", "m/s²", placed(forces, np.full((len(turn), 3), np.nan)))
    covariates |= {
        "angle [°]": placed(unknown[0], dot_rows(speed, turns.interval)),
        "rate [°/s]": placed(unknown[0], speed.max(axis=1)),
        "duration [s]": placed(unknown[0], turns.interval.sum(axis=1)),
    }
    return Rows(
        kinds=RESIDUALS,
        kind=np.repeat([0, 1, 2], [len(pose), 2 * len(turn), 3 * len(pose)]),
        first=placed(pose, turn),
        last=placed(pose, turn + 1),
        to_si=np.concatenate([np.ones(len(pose) + 2 * len(turn)), np.tile(1 / gyroscope.scales, len(pose))]),
        used=placed(poses.mask, turns.mask).astype(bool),
        covariates=covariates,
        spans=np.column_stack([poses.start, poses.stop]),
    )


def only(covariance: Covariance | Chain, rows: str, excess: Array) -> Covariance | Chain:
    """Return the covariance with rows left out; with "turning" of each turn by itself, the poses' excess given.

    Raises `InputError` for "turning" where slow noise ties turns.
    """
    if rows == "norm":
        return covariance.of_rows(covariance.used * (covariance.group == 0))
    if rows == "turning":
        return covariance.turn_by_turn(excess).of_rows(covariance.used * (covariance.group > 0))
    return covariance


def _errors(conditions: HandHeldConditions, imu: Imu) -> tuple[Array, Array]:
    """Each pose's specific force (P, 3), m/s², and each turn's angle (T,), rad, from carried to measured gravity."""
    force = conditions.forces(imu)
    directions = unit_vectors(force)
    predicted = rotate(conjugate(conditions.rotation), directions[:-1])
    chord = jnp.sqrt(((predicted - directions[1:]) ** 2).sum(axis=-1))
    return force, jnp.where(conditions.turn, 2 * jnp.arcsin((chord / 2).clip(0, 1)), 0.0)


def residual_rms(
    imu: Imu,
    observations: Observations,
    gyroscope: bool = True,
    known: tuple[FloatArray, FloatArray] | None = None,
) -> Sizes:
    """Return the rms of each kind of residual in units a person knows: m/s², degrees, rad/s (all unweighted).

    `known`: forces and angles of the unit, where at hand.
    """
    poses, turns = np.asarray(observations.poses.mask), np.asarray(observations.turns.mask)
    force, angle = forces_and_angles(imu, observations) if known is None else known
    sizes = {"gravity_norm": (rms(lengths_of(force[poses]) - float(observations.gravity)), "m/s^2")}
    if imu.gyroscope is None or not gyroscope:
        return sizes
    if turns.any():
        sizes["gravity_direction"] = (rms(np.degrees(angle)[turns]), "deg")
    rest = np.asarray(observations.poses.gyroscope_mean)[poses] - np.asarray(imu.gyroscope.bias)
    sizes["static_gyroscope"] = (rms(lengths_of(rest / imu.gyroscope.scales)), "rad/s")
    return sizes


def forces_and_angles(
    imu: Imu, observations: Observations, method: str = "exponential"
) -> tuple[FloatArray, FloatArray]:
    """Return each pose's specific force (P, 3), m/s², and each turn's angle (T,), rad, from carried to measured.

    Padding included; the angles mean nothing where `imu` has no gyroscope. Effects are not looked at.
    """
    unit = condensed(*lifted((with_gyroscope(imu).with_effects(), observations)), method=method)
    return unit.force[0], unit.angle[0]


def with_gyroscope(imu: Imu) -> Imu:
    """Return the unit; where it has no gyroscope with one that puts out rad/s, as the conditions need one."""
    return imu if "gyroscope" in imu.triads() else Imu(imu.accelerometer, Imu.nominal().gyroscope)
