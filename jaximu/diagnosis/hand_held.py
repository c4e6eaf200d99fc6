"""A hand-held recording as the linear problem that a diagnosis asks questions of, and the refit with effects in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from jaximu import stored
from jaximu.calibration.fit import keep_free
from jaximu.diagnosis.evidence import Block, Evidence, detection_limit
from jaximu.diagnosis.path import Path, Terms, paths, react, terms, with_effect
from jaximu.effects import CATALOGUE, Effect
from jaximu.effects.base import Extent
from jaximu.observations import Observations
from jaximu.problem import Parameters, unflatten
from jaximu.residuals import joint_conditions, static_gyroscope_error
from jaximu.segmentation import Segmentation
from jaximu.sensor import Imu
from jaximu.whitening import Sensitivities, condition_covariance, sensitivities

__all__ = ["HandHeld", "State"]

FloatArray = NDArray[np.float64]
_ROUNDS = 6
"""Steps of a refit at most; the conditions are all but linear in what is left after the calibration."""


@dataclass(frozen=True)
class State:
    """A fit of the unit with effects: the unit, the effects with their covariance, and the problem linearised there.

    imu: gain and bias, without effects. effects: fitted, strongest first. covariance: of all free numbers (gain, bias,
    coefficients, inner parameters), in their own units, in the order of `names`. evidence: what else can be asked.
    """

    imu: Imu
    effects: tuple[Effect, ...]
    names: tuple[str, ...]
    covariance: FloatArray
    evidence: Evidence
    observations: Observations  # with what the effects add taken off
    conditions: FloatArray  # (n,) not whitened, real rows only
    weights: FloatArray  # (n, n)
    path: list[Path]
    limits: dict[str, tuple[float, str]]  # detection limit by effect, and its unit
    blind: dict[str, str]  # effects that cannot be asked, and why

    @property
    def model(self) -> Imu:
        """The unit with its effects."""
        return self.imu.with_effects(*self.effects)


@dataclass
class HandHeld:
    """Poses and turns of one unit, their noise known (`observations.slow`), and where they were cut from."""

    segmentations: tuple[Segmentation, ...]
    observations: Observations
    start: Imu  # a calibration without effects

    # --- what can be asked -------------------------------------------------------------------------------------------

    def extent(self) -> Extent:
        """Return what the recordings span."""
        stops = [part.intervals for part in self.segmentations]
        boundaries = [float(t) for each in stops for t in (each[:-1, 1] + each[1:, 0]) / 2]
        kelvin = [part.recording.temperature.values for part in self.segmentations if part.recording.temperature]
        return Extent(
            max(float(each[-1, 1] - each[0, 0]) for each in stops),
            tuple(boundaries),
            max((float(np.ptp(each)) for each in kelvin), default=0.0),
        )

    def askable(self, path: Sequence[Path]) -> tuple[dict[str, type[Effect]], dict[str, str]]:
        """Return the effects that can be asked of these recordings along their paths, and why others cannot."""
        asked, refused = {}, {}
        for name, kind in CATALOGUE.items():
            missing = [
                need for need in kind.needs
                if any(getattr(getattr(each, triad), need) is None for each in path for triad in
                       ("accelerometer", "gyroscope"))
            ]  # fmt: skip
            if missing:
                said = "vibration that stands out" if missing[0] == "vibration_power" else missing[0].replace("_", " ")
                refused[name] = f"the recording has no {said}"
            elif kind.scope == "fixture":
                refused[name] = "a hand-held recording has no set-up to compare with"
            elif "temperature" in " ".join(kind.needs) and self.extent().temperature_range < _LEAST_WARMING:
                refused[name] = "the temperature stood still"
            else:
                asked[name] = kind
        return asked, refused

    # --- fits --------------------------------------------------------------------------------------------------------

    def fit(self, effects: Sequence[Effect] = (), imu: Imu | None = None) -> State:
        """Fit gain, bias and the effects, each starting where it is given, and linearise there."""
        imu = jax.tree.map(np.asarray, (self.start if imu is None else imu).with_effects())
        assert isinstance(imu, Imu)
        effects = tuple(jax.tree.map(np.asarray, effect) for effect in effects)
        used = self.used
        sizes = [_sizes(effect, imu) for effect in effects]
        rounds = 0
        while True:
            path, modified = self._along(imu, effects)
            conditions, slope, covariance, reaction = _linearised(imu, modified)
            weights = scipy.linalg.solve_triangular(
                np.linalg.cholesky(covariance[np.ix_(used, used)]), np.eye(int(used.sum())), lower=True
            )
            columns = [slope, *(-_own(imu, path, reaction, e) * s for e, s in zip(effects, sizes, strict=True))]
            jacobian = weights @ np.concatenate(columns, axis=1)[used]
            residual = weights @ conditions[used]
            step = np.linalg.lstsq(jacobian, -residual, rcond=1e-10)[0]
            moved = float(np.linalg.norm(jacobian @ step))
            imu = _stepped(imu, step[: slope.shape[1]])
            edges = slope.shape[1] + np.cumsum([0, *map(len, sizes)])
            effects = tuple(
                _moved(effect, size * step[a:b])
                for effect, size, a, b in zip(effects, sizes, edges[:-1], edges[1:], strict=True)
            )
            rounds += 1
            if moved < 1e-2 or rounds == _ROUNDS:
                break
        parameters = _parameters(imu)
        size = np.concatenate([np.asarray(parameters.size), *sizes])
        covariance = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-12, hermitian=True) * size[:, None] * size
        names = (*parameters.names, *(name for effect in effects for name in _names(effect)))
        blocks, blind = self._blocks(imu, path, reaction, weights, effects)
        whole = Evidence(residual + jacobian @ step, jacobian, blocks)
        limits = _limits(whole, imu)
        seen = [b for b in blocks if b.kind != "effect" or limits[b.name][0] < _PLAUSIBLE * np.max(b.sizes)]
        for name in sorted({block.name for block in blocks} - {block.name for block in seen}):
            blind[name] = (
                "bias, scale and misalignment imitate it here, or nothing excites it; it needs "
                f"{CATALOGUE[name].excited_by}"
            )
        limits = {name: each for name, each in limits.items() if name not in blind}
        evidence = Evidence(whole.residual, jacobian, seen)
        return State(
            imu, effects, names, covariance, evidence, modified, conditions[used], weights, path, limits, blind
        )

    def predict(self, imu: Imu, effects: tuple[Effect, ...]) -> tuple[FloatArray, FloatArray, FloatArray, list[str]]:
        """Return the conditions (n,) of a unit that is not fitted to them, their columns (n, p) and covariance (n, n).

        Columns are derivatives by the numbers whose names are returned, in their own units.
        """
        imu = jax.tree.map(np.asarray, imu.with_effects())
        path, modified = self._along(imu, effects)
        conditions, slope, covariance, reaction = _linearised(imu, modified)
        parameters = _parameters(imu)
        columns = [slope / np.asarray(parameters.size), *(-_own(imu, path, reaction, effect) for effect in effects)]
        names = [*parameters.names, *(name for effect in effects for name in _names(effect))]
        used = self.used
        return conditions[used], np.concatenate(columns, axis=1)[used], covariance[np.ix_(used, used)], names

    @property
    def kinds(self) -> NDArray[np.int64]:
        """What each real condition is: 0 the norm of a pose, 1 a component of a turn, 2 of a mean at rest."""
        poses, turns = len(self.observations.poses.mask), len(self.observations.turns.mask)
        return np.repeat([0, 1, 2], [poses, 2 * turns, 3 * poses])[self.used]

    def in_si(self, conditions: FloatArray) -> FloatArray:
        """Return real conditions (n,) with those of the means at rest, which are in output units, in rad/s."""
        gyroscope = self.start.gyroscope
        assert gyroscope is not None
        scale = np.linalg.norm(np.asarray(gyroscope.gain), axis=1)
        rest = self.kinds == 2
        changed = np.array(conditions)
        changed[rest] = (changed[rest].reshape(-1, 3) / scale).ravel()
        return changed

    @property
    def poses_touched(self) -> NDArray[np.int64]:
        """The first and last pose (n, 2) that each real condition involves."""
        poses, turns = (np.arange(len(mask)) for mask in (self.observations.poses.mask, self.observations.turns.mask))
        first = np.concatenate([poses, np.repeat(turns, 2), np.repeat(poses, 3)])
        last = np.concatenate([poses, np.repeat(turns + 1, 2), np.repeat(poses, 3)])
        return np.stack([first, last], axis=1)[self.used]

    def without_pose(self, pose: int) -> HandHeld:
        """Return the recording with a pose, and the turns to and from it, left out."""
        poses, turns = np.array(self.observations.poses.mask), np.array(self.observations.turns.mask)
        poses[pose] = False
        turns[max(pose - 1, 0) : pose + 1] = False
        observations = replace(
            self.observations,
            poses=replace(self.observations.poses, mask=poses),
            turns=replace(self.observations.turns, mask=turns),
        )
        return replace(self, observations=observations)

    @property
    def used(self) -> NDArray[np.bool_]:
        """Which of the conditions are real: norms of poses, two components of turns, three of means at rest."""
        poses, turns = np.asarray(self.observations.poses.mask), np.asarray(self.observations.turns.mask)
        return np.concatenate([poses, np.repeat(turns, 2), np.repeat(poses, 3)])

    def _along(self, imu: Imu, effects: tuple[Effect, ...]) -> tuple[list[Path], Observations]:
        """Return the paths, and the observations with what the effects add along them taken off."""
        lengths = [
            (len(part.recording.accelerometer), len(part.recording.gyroscope or ())) for part in self.segmentations
        ]
        none = [None] * len(self.segmentations)
        path = paths(self.segmentations, self.observations, imu, none, self.shifts)
        if not effects:
            return path, self.observations
        for _ in range(2):  # effects are small: the path is as good as it gets after one correction
            offsets = [terms(imu, each, effects, size) for each, size in zip(path, lengths, strict=True)]
            modified = self._without(path, offsets)
            path = paths(self.segmentations, modified, imu, offsets, self.shifts)
        return path, modified

    def _without(self, path: Sequence[Path], offsets: Sequence[Terms]) -> Observations:
        poses, turns = self.observations.poses, self.observations.turns
        padded = len(poses.mask)
        force, rate = np.zeros((padded, 3)), np.zeros((padded, 3))
        output = np.array(turns.output)
        for each, offset in zip(path, offsets, strict=True):
            for total, values, pose in ((force, offset.accelerometer, each.accelerometer_pose),
                                        (rate, offset.gyroscope, each.gyroscope_pose)):  # fmt: skip
                pose = np.asarray(pose)[: len(values)]
                count = np.maximum(np.bincount(pose, minlength=padded + 1)[:padded], 1)
                for axis in range(3):
                    total[:, axis] += np.bincount(pose, values[:, axis], minlength=padded + 1)[:padded] / count
            inside = np.asarray(each.turn_sample) > 0
            output[inside] -= offset.gyroscope[np.asarray(each.turn_sample)[inside]]
        return replace(
            self.observations,
            poses=replace(
                poses,
                accelerometer_mean=np.asarray(poses.accelerometer_mean) - force,
                gyroscope_mean=np.asarray(poses.gyroscope_mean) - rate,
            ),
            turns=replace(turns, output=output),
        )

    @property
    def shifts(self) -> FloatArray:
        """What the observations took off each recording's gyroscope output (k, 3): its bias against the first's."""
        return rest_shifts(self.segmentations)

    # --- questions ---------------------------------------------------------------------------------------------------

    def _blocks(self, imu, path, reaction, weights, effects: tuple[Effect, ...]) -> tuple[list[Block], dict[str, str]]:
        fitted = {effect.name for effect in effects}
        asked, refused = self.askable(path)
        extent, used, blocks = self.extent(), self.used, []
        for name, kind in asked.items():
            if name in fitted:
                continue
            size = _sizes(kind.dormant(), imu)[: kind.size]
            grid = kind.grid(extent)
            for inner, columns in zip(grid, _asked(imu, path, reaction, kind, grid), strict=True):
                position = "onset" in inner
                blocks.append(Block(name, weights @ (columns * size)[used], size, "effect", inner, position))
        generic = [replace(b, columns=weights @ b.columns[used]) for b in self._generic(imu, reaction)]
        return blocks + generic, refused

    def largest(self, state: State, effect: Effect) -> float:
        """Return the most (SI) that an effect adds to an output in these recordings."""
        triads = state.imu.triads()
        most = 0.0
        for part, each in zip(self.segmentations, state.path, strict=True):
            size = len(part.recording.accelerometer), len(part.recording.gyroscope or ())
            added = terms(state.imu, each, [effect], size)
            for triad, values in (
                (triads["accelerometer"], added.accelerometer),
                (triads["gyroscope"], added.gyroscope),
            ):
                scale = np.linalg.norm(np.asarray(triad.gain), axis=1)
                most = max(most, float(np.max(np.abs(values / scale))))
        return most

    def _generic(self, imu: Imu, reaction: Sensitivities) -> list[Block]:
        """Shapes without a cause, and poses that were bumped."""
        poses = self.observations.poses
        real = np.flatnonzero(poses.mask)
        by_force, by_rate = _reactions(reaction)
        time = (np.asarray(poses.start)[real] + np.asarray(poses.stop)[real]) / 2
        share = (time - time.min()) / max(np.ptp(time), 1e-9)
        up = _directions(imu, poses.accelerometer_mean)[real]
        found = []

        def add(name: str, shape: FloatArray, reach: FloatArray, size: float) -> None:
            """`shape` (poses, k), for each axis of a triad."""
            columns = np.einsum("npi,pk->nki", reach[:, real], shape).reshape(len(reach), -1)
            found.append(Block(name, columns * size, np.full(columns.shape[1], size), "generic"))

        waves = np.cos(np.pi * share[:, None] * np.arange(1, 6))
        add("slow change of the accelerometer", waves, by_force, _FORCE)
        add("slow change of the gyroscope", waves, by_rate, _RATE)
        second, third = _harmonics(up)
        add("the accelerometer depends on orientation (second harmonics)", second, by_force, _FORCE)
        add("the accelerometer depends on orientation (third harmonics)", third, by_force, _FORCE)
        add("the gyroscope at rest depends on orientation", np.concatenate([up, second], axis=1), by_rate, _RATE)
        for pose in real:
            found.append(Block("data.bumped_pose", by_force[:, pose] * _FORCE, np.full(3, _FORCE), "data",
                               {"pose": int(pose)}, True))  # fmt: skip
        return found


_FORCE, _RATE = 0.01, 1e-3  # m/s² and rad/s: sizes of generic shapes
_LEAST_WARMING = 0.2  # K
_PLAUSIBLE = 20.0
"""Typical sizes beyond which a detection limit means that a recording does not show the effect."""


def _limits(evidence: Evidence, imu: Imu) -> dict[str, tuple[float, str]]:
    """Return each effect's detection limit, the best of its grid, and its unit; infinite if it is blind."""
    found: dict[str, tuple[float, str]] = {}
    triads = imu.triads()
    places: dict[str, list[int]] = {}
    for k, block in enumerate(evidence.blocks):
        if block.kind == "effect":
            places.setdefault(block.name, []).append(k)
    for name, blocks in places.items():
        triad = triads["gyroscope"] if name.startswith("gyro.") else triads["accelerometer"]
        if evidence.blocks[blocks[0]].position:  # about the same everywhere but near the ends
            blocks = blocks[len(blocks) // 2 :][:1]
        values = [
            detection_limit(evidence.information(k) / evidence.blocks[k].sizes[:, None] / evidence.blocks[k].sizes)
            if evidence.observable(k) else np.inf for k in blocks
        ]  # fmt: skip
        found[name] = min(values), CATALOGUE[name].coefficient_unit(triad.output_unit)
    return found


def rest_shifts(segmentations: Sequence[Segmentation]) -> FloatArray:
    """Return the difference (k, 3) of each recording's gyroscope output at rest to the first recording's."""
    middles = []
    for part in segmentations:
        signal = part.recording.gyroscope
        assert signal is not None
        means = [signal.values[(signal.time >= a) & (signal.time < b)].mean(axis=0) for a, b in part.intervals]
        middles.append(np.median(means, axis=0))
    return np.array(middles) - middles[0]


def _reactions(reaction: Sensitivities) -> tuple[FloatArray, FloatArray]:
    """Reaction (n, P, 3) of all conditions to the mean outputs of both triads, the gyroscope's bias held over turns.

    A gyroscope's output that is off in a pose is taken to be off by the mean of its neighbours in the turn between.
    """
    norm, after, before, turn = (np.asarray(each) for each in
                                 (reaction.norm, reaction.after, reaction.before, reaction.turn))  # fmt: skip
    poses = len(norm)
    size = poses + 2 * (poses - 1) + 3 * poses
    by_force, by_rate = np.zeros((size, poses, 3)), np.zeros((size, poses, 3))
    pose, step = np.arange(poses), np.arange(poses - 1)
    by_force[pose, pose] = norm
    half = turn.sum(axis=2) / 2
    for component in range(2):
        rows = poses + 2 * step + component
        by_force[rows, step + 1] = after[:, component]
        by_force[rows, step] = before[:, component]
        by_rate[rows, step + 1] = by_rate[rows, step] = half[:, component]
    rest = poses + 2 * (poses - 1) + 3 * pose[:, None] + np.arange(3)
    by_rate[rest, pose[:, None]] = np.eye(3)
    return by_force, by_rate


def _directions(imu: Imu, output) -> FloatArray:
    triad = imu.accelerometer
    force = (np.asarray(output) - np.asarray(triad.bias)) @ np.linalg.inv(np.asarray(triad.gain)).T
    return force / np.linalg.norm(force, axis=1, keepdims=True)


def _harmonics(up: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Real spherical harmonics (n, 5) of degree two and (n, 7) of degree three, up to factors."""
    x, y, z = up.T
    second = [x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1]
    third = [y * (3 * x * x - y * y), x * y * z, y * (5 * z * z - 1), z * (5 * z * z - 3), x * (5 * z * z - 1),
             z * (x * x - y * y), x * (x * x - 3 * y * y)]  # fmt: skip
    return np.stack(second, axis=1), np.stack(third, axis=1)


# --- the free numbers -----------------------------------------------------------------------------------------------


def _parameters(imu: Imu) -> Parameters:
    return Parameters.select(imu, keep_free("joint"))


def _stepped(imu: Imu, step: FloatArray) -> Imu:
    parameters = _parameters(imu)
    flat = np.array(parameters.reference)
    flat[list(parameters.index)] += np.asarray(parameters.size) * step
    return unflatten(imu, flat)


def _names(effect: Effect) -> list[str]:
    return [f"{effect.name}[{k}]" for k in range(effect.size)] + [f"{effect.name}.{inner}" for inner in effect.inner]


def _sizes(effect: Effect, imu: Imu) -> FloatArray:
    """Sizes of the coefficients and inner parameters, to scale columns by."""
    triads = imu.triads()
    triad = triads["gyroscope"] if effect.name.startswith("gyro.") else triads["accelerometer"]
    scale = float(np.mean(np.linalg.norm(np.asarray(triad.gain), axis=-1)))
    typical = np.asarray(effect.typical_sizes(scale).coefficients)
    return np.concatenate([typical, [max(abs(float(getattr(effect, name))), 1e-9) for name in effect.inner]])


def _moved(effect: Effect, step: FloatArray) -> Effect:
    """Return the effect with its numbers changed; an inner parameter by a factor of two at most, inside its range."""
    inner = {}
    for (name, each), change in zip(effect.inner.items(), step[effect.size :], strict=True):
        value = float(getattr(effect, name))
        inner[name] = float(np.clip(value + np.clip(change, -0.5 * value, value), each.low, each.high))
    return jax.tree.map(np.asarray, type(effect)(np.asarray(effect.coefficients) + step[: effect.size], **inner))


# --- compiled -------------------------------------------------------------------------------------------------------


def _linearised(imu: Imu, observations: Observations) -> tuple[FloatArray, FloatArray, FloatArray, Sensitivities]:
    parameters = _parameters(imu)
    conditions, slope, covariance, *reaction = stored.call(_linearise, "linearised", imu, parameters, observations)
    return np.asarray(conditions), np.asarray(slope), np.asarray(covariance), Sensitivities(*map(np.asarray, reaction))


def _linearise(imu: Imu, parameters: Parameters, observations: Observations):
    def conditions(z):
        model = parameters.model(imu, z)
        at_rest = static_gyroscope_error(model, observations).reshape(-1)
        return jnp.concatenate([joint_conditions(model, observations), at_rest])

    zero = jnp.zeros(len(parameters.index))
    reaction = sensitivities(imu, observations)
    covariance = condition_covariance(imu, observations).total(jnp.zeros(3))
    return (
        conditions(zero), jax.jacfwd(conditions)(zero), covariance,
        reaction.norm, reaction.after, reaction.before, reaction.turn,
    )  # fmt: skip


def _asked(imu: Imu, path, reaction, kind: type[Effect], grid: Sequence[Mapping[str, float]]) -> FloatArray:
    """Columns (G, n, q) of an effect at zero, for each of its inner parameters."""
    coefficients = np.zeros((len(grid), kind.size))
    inner = np.array([[each[name] for name in kind.inner] for each in grid]).reshape(len(grid), len(kind.inner))
    return _columns(imu, path, reaction, kind, coefficients, inner)[..., : kind.size]


def _own(imu: Imu, path, reaction, effect: Effect) -> FloatArray:
    """Columns (n, q + inner parameters) of an effect where it is."""
    inner = np.array([[float(getattr(effect, name)) for name in effect.inner]]).reshape(1, len(effect.inner))
    return _columns(imu, path, reaction, type(effect), np.asarray(effect.coefficients)[None], inner)[0]


def _columns(imu: Imu, path, reaction, kind: type[Effect], coefficients, inner) -> FloatArray:
    def derivatives(imu, path, reaction, coefficients, inner):
        def of(numbers):
            effect = kind(numbers[: kind.size], **dict(zip(kind.inner, numbers[kind.size :], strict=True)))
            return react(*with_effect(imu, effect, path), path, reaction)

        def one(given):
            numbers = jnp.concatenate(given)
            if not kind.probes:
                return jax.jacfwd(of)(numbers)
            # the derivative vanishes nearly everywhere: the change over a quarter of what there is, or the least probe
            reach = jnp.maximum(jnp.abs(numbers) / 4, kind.probes[0])
            return jax.vmap(lambda e, h: (of(numbers + h * e) - of(numbers - h * e)) / (2 * h), out_axes=1)(
                jnp.eye(len(numbers)), reach
            )

        return (jax.lax.map(one, (coefficients, inner)),)

    def total(each):
        return stored.call(derivatives, f"columns {kind.name}", imu, each, reaction, coefficients, inner)[0]

    return np.sum([np.asarray(total(each)) for each in path], axis=0)
