"""What a diagnosis asks questions of: a recording as a linear problem about a fit, whatever it was recorded with."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Self

import jax
import numpy as np
import scipy
from numpy.typing import NDArray

from jaximu.diagnosis.evidence import Block, Evidence, detection_limit
from jaximu.effects import CATALOGUE, Effect
from jaximu.effects.base import Extent
from jaximu.noise.model import NoiseModel
from jaximu.problem import Parameters, unflatten
from jaximu.recording import Recording
from jaximu.sensor import Imu

__all__ = ["Experiment", "Linear", "ResidualKind", "State"]

FloatArray = NDArray[np.float64]
_ROUNDS = 6
"""Steps of a refit at most; the conditions are all but linear in what is left after the calibration."""
_PLAUSIBLE = 20.0
"""Typical sizes beyond which a detection limit means that a recording does not show the effect."""
_LEAST_WARMING = 0.2  # K


class ResidualKind(NamedTuple):
    """A kind of condition: its name, in words, the unit its rms is told in, how many components make one vector.

    `factor` turns the condition's SI into that unit; `centred`: a common offset is taken off before the rms.
    """

    name: str
    words: str
    unit: str
    components: int
    factor: float = 1.0
    centred: bool = False


@dataclass(frozen=True)
class Linear:
    """The conditions (n,) of a unit, their derivatives (n, p) by its free parameters in typical sizes, and their
    covariance (n, n), padding included. Subclasses add what the effects' columns are computed from.
    """

    conditions: FloatArray
    slope: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class State:
    """A fit of the unit with effects: the unit, the effects with their covariance, and the problem linearised there.

    imu: gain and bias, without effects. effects: fitted, strongest first. covariance: of all free numbers (gain, bias,
    coefficients, inner parameters), in their own units, in the order of `names`. evidence: what else can be asked.
    conditions (n,), weights (n, n): of the real conditions, not whitened and whitening. limits: detection limit by
    effect, and its unit. blind: effects that cannot be asked, and why.
    """

    imu: Imu
    effects: tuple[Effect, ...]
    names: tuple[str, ...]
    covariance: FloatArray
    evidence: Evidence
    conditions: FloatArray
    weights: FloatArray
    limits: dict[str, tuple[float, str]]
    blind: dict[str, str]
    linear: Any  # of the experiment's own kind

    @property
    def model(self) -> Imu:
        """The unit with its effects."""
        return self.imu.with_effects(*self.effects)


class Experiment(ABC):
    """A recording of one unit as conditions that its parameters and effects should bring to zero.

    A subclass says how conditions and the effects' columns are computed; fitting, asking and predicting are the same
    for all. `start` is a calibration without effects.
    """

    start: Imu
    residual_kinds: ClassVar[tuple[ResidualKind, ...]]
    no_fixture: ClassVar[str] = ""  # why effects of a set-up cannot be asked; empty where they can

    # --- what a kind of recording says of itself ------------------------------------------------------------------

    @abstractmethod
    def free(self, imu: Imu) -> Parameters:
        """Return the free parameters, about `imu`."""

    @abstractmethod
    def linearise(self, imu: Imu, effects: tuple[Effect, ...]) -> Linear:
        """Return the conditions of the unit with these effects, linearised."""

    @abstractmethod
    def columns(
        self, imu: Imu, linear: Any, kind: type[Effect], coefficients: FloatArray, inner: FloatArray
    ) -> FloatArray:
        """Return the derivatives (G, n, q + inner parameters) of what an effect adds to the outputs.

        At G coefficients (G, q) and inner parameters (G, i); as the conditions feel it with the opposite sign.
        """

    @abstractmethod
    def generic(self, imu: Imu, linear: Any) -> list[Block]:
        """Return shapes without a cause and defects of single observations, not whitened, padding included."""

    @abstractmethod
    def extent(self) -> Extent:
        """Return what the recordings span."""

    @abstractmethod
    def lacks(self, linear: Any) -> Mapping[str, str]:
        """Return fields of the stimulus that are not known along the path, and why."""

    @abstractmethod
    def largest(self, state: State, effect: Effect) -> dict[str, float]:
        """Return the most (SI) that an effect adds to each triad's output in these recordings."""

    @abstractmethod
    def without(self, place: int) -> Self:
        """Return the recording with an observation, and what touches it, left out."""

    @abstractmethod
    def describe(self, place: int) -> str:
        """Name an observation by its time."""

    @abstractmethod
    def rms(self, imu: Imu, linear: Any) -> dict[str, tuple[float, str]]:
        """Return the rms of each kind of residual, with its unit, as a calibration has it."""

    @abstractmethod
    def twin(self, state: State, noise: NoiseModel, seed: int) -> Self:
        """Return the recording as a fit without effects would have it, along the same motion, noise included."""

    @abstractmethod
    def covariates(self, kind: int) -> dict[str, FloatArray]:
        """Return what errors of a kind may depend on: for each of its vectors (v,), by name with unit, time first."""

    @abstractmethod
    def still_parts(self, triad: str) -> tuple[list[FloatArray], float]:
        """Return what a triad put out (k, 3) in each still part, in SI, and its rate, Hz."""

    @property
    @abstractmethod
    def recordings(self) -> tuple[Recording, ...]:
        """What is diagnosed, as it was recorded."""

    @property
    @abstractmethod
    def used(self) -> NDArray[np.bool_]:
        """Which of the conditions are real."""

    @property
    @abstractmethod
    def kinds(self) -> NDArray[np.int64]:
        """What each real condition is: a place in `residual_kinds`."""

    @property
    @abstractmethod
    def touched(self) -> NDArray[np.int64]:
        """The first and last observation (n, 2) that each real condition involves."""

    @abstractmethod
    def in_si(self, conditions: FloatArray) -> FloatArray:
        """Return real conditions (n,) with those that are in output units in SI."""

    # --- the same for all ----------------------------------------------------------------------------------------

    def askable(self, linear: Any) -> tuple[dict[str, type[Effect]], dict[str, str]]:
        """Return the effects that can be asked of these recordings, and why others cannot."""
        asked, refused = {}, {}
        lacking, warming = self.lacks(linear), self.extent().temperature_range
        for name, kind in CATALOGUE.items():
            if not kind.cause:
                continue
            missing = [need for need in kind.needs if need in lacking]
            if missing:
                refused[name] = lacking[missing[0]]
            elif kind.scope == "fixture" and self.no_fixture:
                refused[name] = self.no_fixture
            elif "temperature" in " ".join(kind.needs) and warming < _LEAST_WARMING:
                refused[name] = "the temperature stood still"
            else:
                asked[name] = kind
        return asked, refused

    def fit(self, effects: Sequence[Effect] = (), imu: Imu | None = None) -> State:
        """Fit gain, bias and the effects, each starting where it is given, and linearise there."""
        imu = jax.tree.map(np.asarray, (self.start if imu is None else imu).with_effects())
        assert isinstance(imu, Imu)
        effects = tuple(jax.tree.map(np.asarray, effect) for effect in effects)
        used = self.used
        sizes = [_sizes(effect, imu) for effect in effects]
        rounds = 0
        while True:
            linear = self.linearise(imu, effects)
            weights = scipy.linalg.solve_triangular(
                np.linalg.cholesky(linear.covariance[np.ix_(used, used)]), np.eye(int(used.sum())), lower=True
            )
            columns = [linear.slope, *(-self._own(imu, linear, e) * s for e, s in zip(effects, sizes, strict=True))]
            jacobian = weights @ np.concatenate(columns, axis=1)[used]
            residual = weights @ linear.conditions[used]
            step = np.linalg.lstsq(jacobian, -residual, rcond=1e-10)[0]
            moved = float(np.linalg.norm(jacobian @ step))
            parameters = self.free(imu)
            imu = _stepped(imu, parameters, step[: linear.slope.shape[1]])
            edges = linear.slope.shape[1] + np.cumsum([0, *map(len, sizes)])
            effects = tuple(
                _moved(effect, size * step[a:b])
                for effect, size, a, b in zip(effects, sizes, edges[:-1], edges[1:], strict=True)
            )
            rounds += 1
            if moved < 1e-2 or rounds == _ROUNDS:
                break
        size = np.concatenate([np.asarray(parameters.size), *sizes])
        covariance = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-12, hermitian=True) * size[:, None] * size
        names = (*parameters.names, *(name for effect in effects for name in _names(effect)))
        blocks, blind = self._blocks(imu, linear, weights, effects)
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
        return State(imu, effects, names, covariance, evidence, linear.conditions[used], weights, limits, blind, linear)

    def predict(self, imu: Imu, effects: tuple[Effect, ...]) -> tuple[FloatArray, FloatArray, FloatArray, list[str]]:
        """Return the conditions (n,) of a unit that is not fitted to them, their columns (n, p) and covariance (n, n).

        Columns are derivatives by the numbers whose names are returned, in their own units.
        """
        imu = jax.tree.map(np.asarray, imu.with_effects())
        linear, parameters = self.linearise(imu, effects), self.free(imu)
        columns = [linear.slope / np.asarray(parameters.size), *(-self._own(imu, linear, each) for each in effects)]
        names = [*parameters.names, *(name for effect in effects for name in _names(effect))]
        used = self.used
        return (
            linear.conditions[used],
            np.concatenate(columns, axis=1)[used],
            linear.covariance[np.ix_(used, used)],
            names,
        )

    def summary(self, conditions: FloatArray) -> dict[str, tuple[float, str]]:
        """Return the rms of each kind of real conditions (n,), as vectors, with its unit."""
        return {
            kind.name: (float(np.sqrt(np.mean(errors**2))), kind.unit)
            for kind, errors in zip(self.residual_kinds, self.errors(conditions), strict=True)
            if len(errors)
        }

    def errors(self, conditions: FloatArray) -> list[FloatArray]:
        """Return the errors (v,) of each kind of real conditions (n,), in its unit: lengths, or scalars with a sign."""
        kinds, values, found = self.kinds, self.in_si(conditions), []
        for place, kind in enumerate(self.residual_kinds):
            own = values[kinds == place].reshape(-1, kind.components)
            own = own - own.mean(axis=0) if kind.centred and len(own) else own
            found.append(kind.factor * (own[:, 0] if kind.components == 1 else np.linalg.norm(own, axis=1)))
        return found

    def _own(self, imu: Imu, linear: Any, effect: Effect) -> FloatArray:
        """Columns (n, q + inner parameters) of an effect where it is."""
        inner = np.array([[float(getattr(effect, name)) for name in effect.inner]]).reshape(1, len(effect.inner))
        return self.columns(imu, linear, type(effect), np.asarray(effect.coefficients)[None], inner)[0]

    def _blocks(
        self, imu: Imu, linear: Any, weights, effects: tuple[Effect, ...]
    ) -> tuple[list[Block], dict[str, str]]:
        fitted = {effect.name for effect in effects}
        asked, refused = self.askable(linear)
        extent, used, blocks = self.extent(), self.used, []
        for name, kind in asked.items():
            if name in fitted:
                continue
            size = _sizes(kind.dormant(), imu)[: kind.size]
            grid = kind.grid(extent)
            zero = np.zeros((len(grid), kind.size))
            inner = np.array([[each[name] for name in kind.inner] for each in grid]).reshape(len(grid), len(kind.inner))
            found = self.columns(imu, linear, kind, zero, inner)[..., : kind.size]
            for given, columns in zip(grid, found, strict=True):
                blocks.append(Block(name, weights @ (columns * size)[used], size, "effect", given, "onset" in given))
        generic = [replace(b, columns=weights @ b.columns[used]) for b in self.generic(imu, linear)]
        return blocks + generic, refused


def _limits(evidence: Evidence, imu: Imu) -> dict[str, tuple[float, str]]:
    """Return each effect's detection limit, the best of its grid, and its unit; infinite if it is blind."""
    found: dict[str, tuple[float, str]] = {}
    triads = imu.triads()
    places: dict[str, list[int]] = {}
    for k, block in enumerate(evidence.blocks):
        if block.kind == "effect":
            places.setdefault(block.name, []).append(k)
    for name, blocks in places.items():
        triad = triads.get(CATALOGUE[name].owner, imu.accelerometer)
        if evidence.blocks[blocks[0]].position:  # about the same everywhere but near the ends
            blocks = blocks[len(blocks) // 2 :][:1]
        values = [
            detection_limit(evidence.information(k) / evidence.blocks[k].sizes[:, None] / evidence.blocks[k].sizes)
            if evidence.observable(k) else np.inf for k in blocks
        ]  # fmt: skip
        found[name] = min(values), CATALOGUE[name].coefficient_unit(triad.output_unit)
    return found


def _stepped(imu: Imu, parameters: Parameters, step: FloatArray) -> Imu:
    flat = np.array(parameters.reference)
    flat[list(parameters.index)] += np.asarray(parameters.size) * step
    return unflatten(imu, flat)


def _names(effect: Effect) -> list[str]:
    return [f"{effect.name}[{k}]" for k in range(effect.size)] + [f"{effect.name}.{inner}" for inner in effect.inner]


def _sizes(effect: Effect, imu: Imu) -> FloatArray:
    """Sizes of the coefficients and inner parameters, to scale columns by."""
    triad = imu.triads().get(effect.owner, imu.accelerometer)
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
