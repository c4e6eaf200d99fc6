"""Poses and turns by hand: gravity's norm, its direction carried over each turn, and the gyroscope at rest.

Turns are integrated here, once for each unit that the measurement is evaluated about: the rate ω = A y + c, A = K⁻¹ and
c = −K⁻¹ b, is linear in (A, c), so a change of them turns the last body frame by a sum over the samples that is made
beforehand (pre-integration; Forster et al., IEEE Transactions on Robotics 33, 2017, sec. VI, with all of K and not the
bias alone). A turn about a fixed axis is linear in (A, c) however far it goes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from jaximu.data.gravity_direction import gravity_direction_error, unit_vectors
from jaximu.data.gravity_norm import gravity_norm_error
from jaximu.data.poses_covariance import (
    IntegratedTurns,
    Sensitivities,
    condition_covariance,
    integrate_turns,
    sensitivities,
)
from jaximu.data.track import Track, added, mean_outputs
from jaximu.data.tracks_by_hand import tracks_by_hand, turn_samples
from jaximu.estimation.covariance import Chain, Covariance
from jaximu.estimation.data import About, Conditions, Data
from jaximu.estimation.problem import Name
from jaximu.estimation.rows import TIME, ResidualKind, Rows, by_axis
from jaximu.ground import stored
from jaximu.ground.array_types import Array, FloatArray
from jaximu.ground.errors import InputError
from jaximu.ground.gravity import STANDARD, Gravity, as_gravity
from jaximu.ground.rotation import (
    apply_matrix,
    conjugate,
    exponential,
    integrate_rates,
    inverse_matrix,
    multiply,
    rotate,
)
from jaximu.ground.tracing import array_module
from jaximu.mistakes import prepared
from jaximu.model.effects.base import Effect, Extent
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu, Triad
from jaximu.recordings.observations import Observations, Turns
from jaximu.recordings.recording import Recording, recordings_of
from jaximu.recordings.segmentation import Segmentation, observed_poses, segment

__all__ = [
    "COARSE_EXCESS",
    "EXCESS_NAMES",
    "RESIDUALS",
    "Along",
    "Condensed",
    "HandHeldConditions",
    "PosesAndTurns",
    "RecordedByHand",
    "condense",
    "condensed",
    "extent_of",
    "missed_by_sampling",
    "observe",
    "only",
    "pose_rows",
    "resized",
    "rest_shifts",
    "stack",
]

EXCESS_NAMES = ("accelerometer", "turns", "gyroscope")
COARSE_EXCESS = (1e2, 1e4, 1e2)
"""The first pass starts at the data sheet's values, percents away: weights as sharp as the noise would make it chase
wrong minima, so they are blunted by this excess. The next pass finds the right ones."""
RESIDUALS = (
    ResidualKind("gravity_norm", "gravity norm at rest", "m/s^2", 1),
    ResidualKind("gravity_direction", "gravity carried over a turn", "deg", 2, float(np.degrees(1.0))),
    ResidualKind("static_gyroscope", "rate at rest", "rad/s", 3, centred=True),
)
_ROUNDS, _CHANGED = 6, 1e-3
"""Times that tracks are taken anew with what effects add taken off, and the relative change of it that ends them."""


class HandHeldConditions(Conditions):
    """Poses and turns without their samples: as `jaximu.data.joint_conditions` and the means at rest have them.

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
    magnitude: Float[Array, ""]

    def rotations(self, imu: Imu) -> Float[Array, "T 4"]:
        """Return the turns' rotations, quaternions from the last body frame to the first, at a unit close by."""
        assert imu.gyroscope is not None
        moved = jnp.einsum("tijk,jk->ti", self.slope, imu.gyroscope.inverse() - self.linear)
        return multiply(self.rotation, exponential(moved))

    def forces(self, imu: Imu) -> Float[Array, "P 3"]:
        """Return the specific force (m/s²) of each pose."""
        triad = imu.accelerometer
        return apply_matrix(inverse_matrix(triad.gain), self.accelerometer_mean - triad.bias)

    def __call__(self, imu: Imu) -> Float[Array, " n"]:
        """Return the norms (m/s²), two components of carried gravity a turn, and the means at rest (output units)."""
        assert imu.gyroscope is not None
        force = self.forces(imu)
        norm = jnp.where(self.pose, gravity_norm_error(force, self.magnitude), 0.0)
        direction = gravity_direction_error(self.rotations(imu), unit_vectors(force), self.basis)
        rest = jnp.where(self.pose[:, None], self.gyroscope_mean - imu.gyroscope.bias, 0.0)
        turned = jnp.where(self.turn[:, None], direction, 0.0)
        return jnp.concatenate([norm, turned.reshape(-1), rest.reshape(-1)])


def condense(
    imu: Imu, observations: Observations, method: str = "exponential"
) -> tuple[HandHeldConditions, Covariance | Chain, IntegratedTurns, Sensitivities]:
    """Return the conditions about a unit, without its effects, their covariance, and what both were made of."""
    imu, poses, turns = imu.with_effects(), observations.poses, observations.turns
    gyroscope = imu.gyroscope
    assert gyroscope is not None
    integrated = integrate_turns(imu, turns)
    rotation = integrated.rotation
    if method != "exponential":
        rotation = integrate_rates(gyroscope.recover(turns.output), turns.interval, method)
    conditions = HandHeldConditions(
        poses.accelerometer_mean, poses.gyroscope_mean, poses.mask, turns.mask, turns.basis, rotation,
        integrated.slope(turns.output), gyroscope.inverse(), observations.gravity,
    )  # fmt: skip
    covariance = condition_covariance(imu, observations, integrated)
    return conditions, covariance, integrated, sensitivities(imu, observations, integrated)


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
    observations = Observations(observations.poses, observations.turns, observations.gravity, observations.slow)

    def batch(imu, observations, excess):
        def lane(unit):
            imu, observations, excess = unit
            conditions, covariance, integrated, reaction = condense(imu, observations, method)
            single = (reaction, integrated.running) if count == 1 else (None, None)
            return Condensed(conditions, only(covariance, rows, excess), *_errors(conditions, imu), *single)

        return jax.lax.map(lane, (imu, observations, excess))

    found: Condensed = stored.call(
        batch, f"condensed {rows} {method}", imu.with_effects(), observations, excess, quick=count == 1
    )
    reaction, running = jax.tree.map(lambda leaf: leaf[0], (found.reaction, found.running))
    return found._replace(reaction=reaction, running=running)


class PosesAndTurns(Observations, Data):
    """What was observed of a unit, or of units with a leading axis on every array; their effects are not looked at.

    conditions: "all"; "norm", gravity's magnitude alone; or "turning", all but that, neighbouring turns taken as
    independent and the accelerometer as known. accelerometer_excess: of its poses, with "turning". method: how rates
    are integrated.
    """

    accelerometer_excess: Float[Array, ...] | None = None
    conditions: str = eqx.field(static=True, default="all")
    method: str = eqx.field(static=True, default="exponential")

    excess_names = EXCESS_NAMES
    coarse = COARSE_EXCESS

    @classmethod
    def of(cls, observations: Observations, conditions: str = "all", **settings: Any) -> Self:
        """Return what was observed as data of a fit."""
        fields = observations.poses, observations.turns, observations.gravity, observations.slow
        return cls(*fields, conditions=conditions, **settings)

    def free(self, name: Name) -> bool:
        """Return whether a number is free: of the triads that the conditions tell of."""
        owners = {"norm": ("accelerometer",), "turning": ("gyroscope",)}.get(self.conditions)
        return super().free(name) and (owners is None or name.owner in owners)

    def take(self, lanes: NDArray[np.int64]) -> Self:
        """Return the data of some of the units."""
        return jax.tree.map(lambda leaf: np.asarray(leaf)[lanes], self._by_unit())

    def widened(self, poses: int, samples: int) -> Self:
        """Return the data of a unit with padding up to so many poses, and samples in a turn."""
        longer = partial(resized, numerics=array_module(self))
        turns = {name: longer(getattr(self.turns, name), poses - 1) for name in ("basis", "mask")}
        turns |= {name: longer(getattr(self.turns, name), poses - 1, samples) for name in ("output", "interval")}
        wider = jax.tree.map(lambda leaf: longer(leaf, poses), self.poses), replace(self.turns, **turns)
        return eqx.tree_at(lambda data: (data.poses, data.turns), self, wider)

    def rows(self, imu: Imu) -> Rows:
        """Return what each condition of one unit is."""
        return pose_rows(imu, self)

    def about(self, imu: Imu) -> About:
        """Return the conditions about units without effects; raise `InputError` for a unit that has some."""
        if effects := imu.all_effects():
            names = ", ".join(effect.name for effect in effects.values())
            raise InputError(
                f"{names} cannot be fitted to poses and turns alone, which hold no samples along which effects act: "
                "name them as effects of jaximu.calibrate."
            )
        data = self._by_unit()
        found = condensed(imu, data, self.conditions, self.method, data.accelerometer_excess)
        none = np.zeros((*found.covariance.used.shape, 0))
        return About(found.conditions, found.covariance, none, found)

    def _by_unit(self) -> Self:
        """Return the data with a leading axis."""
        numerics = array_module(self)
        return jax.tree.map(lambda leaf: numerics.asarray(leaf)[None], self) if np.ndim(self.gravity) == 0 else self


def observe(
    recordings: Recording | Sequence[Recording], gravity: Gravity = STANDARD, noise: NoiseModel | None = None
) -> PosesAndTurns:
    """Return poses and turns of recordings of one unit as data of a fit; chosen on the host, a PyTree of arrays.

    **Arguments:** `gravity`: local gravity, m/s². `noise`: fitted to the unit at rest; without it the scatter within
    the poses tells the noise. A fit starts at the data sheet's values, [`jaximu.calibration.nominal_imu`][].

    Rows that are no measurement are left out. Raises `InputError` where gyroscopes are missing from some recordings,
    and `NotPossibleError` where there are no poses.
    """
    parts = recordings_of(recordings)
    without = [recording.name for recording in parts if "gyroscope" not in recording.signals]
    if 0 < len(without) < len(parts):
        raise InputError(f"{without[0]} has no gyroscope and others have: observe them apart.")
    with prepared(parts, gyroscope=not without) as ready:
        segmentations = [segment(one.recording) for one in ready]
        observations = observed_poses(segmentations, as_gravity(gravity).value, noise=noise)
    return PosesAndTurns.of(observations, "norm" if without else "all")


def stack(data: Sequence[PosesAndTurns]) -> PosesAndTurns:
    """Return data of units as one, with a leading axis: padded to as many poses and samples as the longest has.

    Raises `InputError` where conditions differ, or where slow noise ties intervals whose numbers differ.
    """
    if not data:
        raise InputError("nothing to stack: give the data of one unit or more.")
    poses, samples = (max(unit.turns.interval.shape[axis] for unit in data) for axis in (0, 1))
    wide = [unit.widened(poses + 1, samples) for unit in data]
    if len({(jax.tree.structure(unit), *map(np.shape, jax.tree.leaves(unit))) for unit in wide}) > 1:
        raise InputError("these units' data differ in kind (gyroscope, slow noise, its intervals): stack those alike.")
    return jax.tree.map(lambda *leaves: array_module(leaves).stack(leaves), *wide)


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
    poses, turns = jax.tree.map(np.asarray, (observations.poses, observations.turns))
    gyroscope = imu.gyroscope
    assert gyroscope is not None
    pose, turn = np.arange(len(poses.mask)), np.arange(len(turns.mask))

    def placed(of_poses, of_turns):
        return np.concatenate([of_poses, np.repeat(of_turns, 2, axis=0), np.repeat(of_poses, 3, axis=0)])

    unknown = np.full(len(pose), np.nan), np.full(len(turn), np.nan)
    speed = np.degrees(np.linalg.norm(gyroscope.recover_on_host(turns.output), axis=2)) * (turns.interval > 0)
    middle = (poses.start + poses.stop) / 2, (poses.stop[:-1] + poses.start[1:]) / 2
    covariates = {TIME: placed(*middle), "temperature [°C]": placed(poses.temperature, unknown[1])}
    forces = imu.accelerometer.recover_on_host(poses.accelerometer_mean)
    covariates |= by_axis("specific force", "m/s²", placed(forces, np.full((len(turn), 3), np.nan)))
    covariates |= {
        "angle [°]": placed(unknown[0], np.sum(speed * turns.interval, axis=1)),
        "rate [°/s]": placed(unknown[0], speed.max(axis=1)),
        "duration [s]": placed(unknown[0], turns.interval.sum(axis=1)),
    }
    return Rows(
        kinds=RESIDUALS,
        kind=np.repeat([0, 1, 2], [len(pose), 2 * len(turn), 3 * len(pose)]),
        first=placed(pose, turn),
        last=placed(pose, turn + 1),
        to_si=np.concatenate(
            [np.ones(len(pose) + 2 * len(turn)), np.tile(1 / np.linalg.norm(gyroscope.gain, axis=1), len(pose))]
        ),
        used=placed(poses.mask, turns.mask).astype(bool),
        covariates=covariates,
        spans=np.stack([poses.start, poses.stop], axis=1),
    )


class Along:
    """A hand-held recording about a unit: what was condensed, and the tracks of each part, made when asked for.

    observations: with what the effects add taken off.
    """

    def __init__(self, condensed: Condensed, observations: Observations, made: Callable[[], list[dict[str, Track]]]):
        self.condensed, self.observations, self._made = condensed, observations, made

    @cached_property
    def tracks(self) -> list[dict[str, Track]]:
        """What the unit went through, part by part."""
        return self._made()

    @property
    def reaction(self) -> Sensitivities:
        """How the conditions react to the outputs."""
        assert self.condensed.reaction is not None
        return self.condensed.reaction


@dataclass
class RecordedByHand(Data):
    """Poses and turns of one unit, and the recordings that they were cut from, along which effects act."""

    segmentations: tuple[Segmentation, ...]
    observations: Observations

    excess_names = EXCESS_NAMES
    coarse = COARSE_EXCESS

    @cached_property
    def shifts(self) -> FloatArray:
        """What the observations took off each recording's gyroscope output (k, 3): its bias against the first's."""
        return rest_shifts(self.segmentations)

    def rows(self, imu: Imu) -> Rows:
        """Return what each condition is: norms of poses, two components of turns, three of means at rest."""
        return pose_rows(imu, self.observations)

    @cached_property
    def turn_samples(self) -> list[NDArray[np.int64]]:
        """Where the samples (T, S) of each turn are among those of each recording's gyroscope; 0 for none."""
        return turn_samples(self.segmentations, self.observations)

    def about(self, imu: Imu) -> About:
        """Return the conditions about one unit, the leading axis of length one, and its effects' columns."""
        unit = jax.tree.map(lambda leaf: leaf[0], imu)
        along = self.along(unit, tuple(unit.all_effects().values()))
        covariance = along.condensed.covariance
        columns = self.own_columns(unit, along, covariance.used.shape[1])[None]
        return About(along.condensed.conditions, covariance, columns, along)

    def along(self, imu: Imu, effects: tuple[Effect, ...]) -> Along:
        """Return the recordings about a unit with effects: the tracks, and the observations without what they add."""
        bare = jax.tree.map(lambda leaf: np.asarray(leaf)[None], imu.with_effects())
        recorded = [
            {"accelerometer": signals["accelerometer"].values, "gyroscope": signals["gyroscope"].values - shift}
            for signals, shift in zip((part.recording.signals for part in self.segmentations), self.shifts, strict=True)
        ]
        offsets: list[Any] = [None] * len(recorded)
        outputs, observations, change = recorded, self.observations, np.inf
        for number in range(_ROUNDS):  # the tracks tell what effects add, and what they add changes the tracks
            found = condensed(bare, jax.tree.map(lambda leaf: np.asarray(leaf)[None], observations))
            assert found.running is not None
            made = partial(tracks_by_hand, self.segmentations, self.turn_samples, imu, outputs, found.running)
            if not effects or change < _CHANGED or number == _ROUNDS - 1:
                break
            before, tracks = offsets, made()
            offsets = [jax.tree.map(np.asarray, added(imu.with_effects(*effects), each)) for each in tracks]
            change = max(_change(old, new) for old, new in zip(before, offsets, strict=True))
            outputs = [
                {name: values - offset[name][: len(values)] for name, values in whole.items()}
                for whole, offset in zip(recorded, offsets, strict=True)
            ]
            observations = self._without(tracks, offsets)
        return Along(found, observations, made)

    def reactions(self, details: Along):
        """Return how norms, directions and means at rest react to effects, recording by recording."""

        def of(effect, imu, part):
            tracks, samples, reaction = part
            outputs = added(imu.with_effects(effect), tracks)
            means = mean_outputs(tracks, outputs, reaction.norm.shape[0])
            force = means[:, :3]
            norm = jnp.sum(reaction.norm * force, axis=-1)
            turn = jnp.einsum("tai,ti->ta", reaction.after, force[1:])
            turn = turn + jnp.einsum("tai,ti->ta", reaction.before, force[:-1])
            turn = turn + jnp.einsum("tasi,tsi->ta", reaction.turn, outputs["gyroscope"][samples])
            return jnp.concatenate([norm, turn.reshape(-1), means[:, 3:].reshape(-1)])

        parts = zip(details.tracks, self.turn_samples, strict=True)
        return "by hand", of, [(tracks, samples, details.reaction) for tracks, samples in parts]

    def _without(self, tracks: Sequence[dict[str, Track]], offsets: Sequence[dict[str, FloatArray]]) -> Observations:
        """Return the observations with what is added to the samples of each recording taken off."""
        poses, turns = self.observations.poses, self.observations.turns
        means, output = np.zeros((len(poses.mask), 6)), np.array(turns.output)
        for track, offset, samples in zip(tracks, offsets, self.turn_samples, strict=True):
            means += np.asarray(mean_outputs(track, offset, len(means)))
            output[samples > 0] -= offset["gyroscope"][samples[samples > 0]]
        return replace(
            self.observations,
            poses=replace(
                poses,
                accelerometer_mean=np.asarray(poses.accelerometer_mean) - means[:, :3],
                gyroscope_mean=np.asarray(poses.gyroscope_mean) - means[:, 3:],
            ),
            turns=replace(turns, output=output),
        )


def rest_shifts(segmentations: Sequence[Segmentation]) -> FloatArray:
    """Return the difference (k, 3) of each recording's gyroscope output at rest to the first recording's."""
    middles = []
    for part in segmentations:
        signal = part.recording.gyroscope
        assert signal is not None
        means = [signal.values[(signal.time >= a) & (signal.time < b)].mean(axis=0) for a, b in part.intervals]
        middles.append(np.median(means, axis=0))
    return np.array(middles) - middles[0]


def extent_of(segmentations: Sequence[Segmentation]) -> Extent:
    """Return what recordings made by hand span."""
    stops = [part.intervals for part in segmentations]
    boundaries = [float(t) for each in stops for t in (each[:-1, 1] + each[1:, 0]) / 2]
    kelvin = [part.recording.temperature.values for part in segmentations if part.recording.temperature]
    return Extent(
        max(float(each[-1, 1] - each[0, 0]) for each in stops), tuple(boundaries),
        max((float(np.ptp(each)) for each in kelvin), default=0.0),
    )  # fmt: skip


def missed_by_sampling(turns: Turns, gyroscope: Triad, running: FloatArray) -> FloatArray:
    """Return half of what rotations (T, 3), rad, from even and from odd samples differ by: Σ (−1)^i R_i ω_i Δt.

    Where sampling is dense enough it is noise. running: the turns' rotations (T, S, 4) after each sample.
    """
    rates = gyroscope.recover_on_host(turns.output)
    interval = np.asarray(turns.interval)
    sign = np.where(np.arange(interval.shape[1]) % 2 == 0, 1.0, -1.0)
    axis = running[..., 1:]
    across = 2 * np.cross(axis, rates)
    turned = rates + running[..., :1] * across + np.cross(axis, across)
    return np.sum(turned * (interval * sign)[..., None], axis=1)


def _change(before: dict[str, FloatArray] | None, after: dict[str, FloatArray]) -> float:
    """Return the largest change of what effects add, as a share of the most that they add to a triad."""
    shares = [0.0]
    for name, new in after.items():
        old, most = 0.0 if before is None else before[name], np.max(np.abs(new), initial=0.0)
        shares.append(float(np.max(np.abs(new - old), initial=0.0) / most) if most > 0 else 0.0)
    return max(shares)


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
    chord = jnp.sqrt(jnp.sum((predicted - directions[1:]) ** 2, axis=-1))
    return force, jnp.where(conditions.turn, 2 * jnp.arcsin(jnp.clip(chord / 2, 0, 1)), 0.0)
