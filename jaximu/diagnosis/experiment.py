"""What a diagnosis asks questions of: a recording as a linear problem about a fit, whatever it was recorded with."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import jax
import numpy as np
import scipy
from numpy.typing import NDArray

from jaximu.data.track import Track, added
from jaximu.diagnosis.drift import DriftComponents
from jaximu.diagnosis.evidence import EffectBlock, Evidence
from jaximu.diagnosis.handling import Handling
from jaximu.estimation.data import Data
from jaximu.estimation.fitting import Linear, Prior, fit, linearise
from jaximu.estimation.problem import Name
from jaximu.estimation.rows import Rows
from jaximu.estimation.uncertainty import pose_advice
from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import NotPossibleError
from jaximu.model.effects import CATALOGUE, Effect
from jaximu.model.effects.base import Extent
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.sensor import Imu
from jaximu.recordings.finding import Finding
from jaximu.recordings.recording import Recording

__all__ = ["Experiment", "State"]

_PLAUSIBLE = 20.0
"""Typical sizes beyond which a detection limit means that a recording does not show the effect."""
_LEAST_WARMING = 0.2  # K
_SEED = 20260101
_PARTS = 8  # left out in turn


@dataclass(frozen=True)
class State:
    """A fit of the unit with effects: the unit, the effects with their covariance, and the problem linearised there.

    model: the unit with its effects. covariance: of all free numbers (gain, bias, coefficients, inner parameters), in
    their own units, in the order of `names`. evidence: what else can be asked. conditions (n,), weights (n, n): of the
    real conditions, not whitened and whitening. limits: detection limit by effect, and its unit. blind: effects that
    cannot be asked, and why. prior: what was known of effects beforehand.
    """

    model: Imu
    names: tuple[Name, ...]
    covariance: FloatArray
    evidence: Evidence
    conditions: FloatArray
    weights: FloatArray
    limits: dict[str, tuple[float, str]]
    blind: dict[str, str]
    linear: Linear
    prior: Prior | None = None

    @property
    def imu(self) -> Imu:
        """Gain and bias, without effects."""
        return self.model.with_effects()

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects that were fitted."""
        return tuple(self.model.all_effects().values())

    def places(self, name: str, part: str = "coefficients") -> list[int]:
        """Return the places of a fitted effect's coefficients, or of an inner parameter, among the numbers."""
        (key,) = (key for key, effect in self.model.all_effects().items() if effect.name == name)
        return [k for k, each in enumerate(self.names) if (each.owner, each.effect) == key and each.part == part]


class Experiment(Data):
    """A recording of one unit as conditions that its parameters and effects should bring to zero.

    A subclass says how conditions and the effects' columns are computed; fitting, asking and predicting are the same
    for all. `start` is a calibration without effects.
    """

    start: Imu
    drift: DriftComponents | None = None  # that was estimated from this very recording
    candidates: tuple[str, ...] | None = None  # names of the effects that are asked; None: all of the catalogue
    reference: dict[str, Any] | None = None  # what is known of a measured attitude, as `calibration.json` has it
    advice: ClassVar[Callable[..., str]] = staticmethod(pose_advice)
    owners: ClassVar[tuple[str, ...]] = ("accelerometer", "gyroscope", "setup")  # whose effects are asked
    by_hand: ClassVar[bool] = False  # hands moved the unit
    no_fixture: ClassVar[str] = ""  # why effects of a set-up cannot be asked; empty where they can
    no_session: str = ""  # why effects of a single recording cannot be asked; empty where they can

    # --- what a kind of recording says of itself ------------------------------------------------------------------

    @cached_property
    def used(self) -> NDArray[np.bool_]:
        """Which of the conditions are real."""
        return self.rows(self.start).used

    @cached_property
    def real(self) -> Rows:
        """What each real condition is."""
        return self.rows(self.start).real()

    @abstractmethod
    def generic(self, imu: Imu, linear: Linear) -> list[EffectBlock]:
        """Return shapes without a cause and defects of single observations, not whitened, padding included."""

    def nearly(self, imu: Imu, linear: Linear) -> list[EffectBlock]:
        """Return shapes, as `generic` does, that named causes may be taken for: asked of what these leave."""
        return []

    @abstractmethod
    def extent(self) -> Extent:
        """Return what the recordings span."""

    def tracks(self, linear: Linear) -> list[dict[str, Track]]:
        """Return what the unit went through, part by part, at the samples of each triad."""
        return linear.details.tracks

    def lacks(self, linear: Linear) -> Mapping[str, str]:
        """Return fields of the stimulus that are not known along the path, and why."""
        found = {}
        for field in ("temperature", "temperature_rate", "vibration_power"):
            stimuli = (track.stimulus for tracks in self.tracks(linear) for track in tracks.values())
            if any(getattr(stimulus, field) is None for stimulus in stimuli):
                said = "vibration that stands out" if field == "vibration_power" else field.replace("_", " ")
                found[field] = f"the recording has no {said}"
        return found

    def largest(self, state: State, effect: Effect) -> dict[str, float]:
        """Return the most (SI) that an effect adds to each triad's output in these recordings."""
        triads = state.imu.triads()
        most = dict.fromkeys(triads, 0.0)
        for recording, tracks in zip(self.recordings, self.tracks(state.linear), strict=True):
            for name, outputs in added(state.imu.with_effects(effect), tracks).items():
                values = np.asarray(outputs)[: len(recording.signals[name])]
                scale = np.linalg.norm(np.asarray(triads[name].gain), axis=1)
                most[name] = max(most[name], float(np.max(np.abs(values / scale))))
        return most

    @abstractmethod
    def without(self, place: int) -> Self:
        """Return the recording with an observation, and what touches it, left out."""

    @abstractmethod
    def rms(self, imu: Imu, linear: Linear) -> dict[str, tuple[float, str]]:
        """Return the rms of each kind of residual, with its unit, as a calibration has it."""

    @abstractmethod
    def twin(self, state: State, noise: NoiseModel, seed: int) -> Self:
        """Return the recording as a fit without effects would have it, along the same motion, noise included."""

    @abstractmethod
    def still_parts(self, triad: str) -> tuple[list[FloatArray], float]:
        """Return what a triad put out (k, 3) in each still part, in SI, and its rate, Hz."""

    @property
    @abstractmethod
    def recordings(self) -> tuple[Recording, ...]:
        """What is diagnosed, as it was recorded."""

    def shortest(self) -> float:
        """Return the usual length (s) of a still part: noise that is slower shows between them."""
        parts, rate = self.still_parts("accelerometer")
        return float(np.median([len(part) for part in parts])) / rate

    def parts(self) -> list[NDArray[np.int64]]:
        """Return the observations that are left out in turn, in the order of time."""
        return self.real.parts(_PARTS)

    def drifts(self, noise: NoiseModel, linear: Linear, within: bool) -> tuple[dict[str, AxisNoise], FloatArray]:
        """Return drifts of the biases by name, at a size of one, and the covariance (k, n, n) that each adds.

        `within`: false where `noise` knows the drift in a recording; what changes between several is asked in any case.
        """
        return {}, np.zeros((0, *linear.covariance.shape))

    def handling(self, imu: Imu, noise: NoiseModel) -> Handling | None:
        """Return what hands add to the conditions, where hands moved the unit."""
        return None

    def sway(self, noise: NoiseModel) -> list[Finding]:
        """Return whether hands turn the unit while it should be at rest, which looks like noise."""
        return []

    def instants(self, state: State) -> bool:
        """Return whether a fit shows the gyroscope's samples to be rates at instants, and not means."""
        return False

    def averaged(self) -> Self:
        """Return the recording with the gyroscope's samples of instants turned into means."""
        return self

    def found_by_hand(self) -> list[Finding]:
        """Return what is wrong with how hands moved the unit."""
        return []

    # --- the same for all ----------------------------------------------------------------------------------------

    def askable(self, linear: Linear) -> tuple[dict[str, type[Effect]], dict[str, str]]:
        """Return the effects that can be asked of these recordings, and why others cannot."""
        asked, refused = {}, {}
        lacking, warming = self.lacks(linear), self.extent().temperature_range
        if "magnetometer" not in self.owners:
            lacking = {"magnetic_field": "no magnetometer was recorded with it"} | dict(lacking)
        for name, kind in CATALOGUE.items():
            if not kind.cause or kind.owner not in self.owners:
                continue
            if self.candidates is not None and name not in self.candidates:
                continue
            missing = [need for need in kind.needs if need in lacking]
            if missing:
                refused[name] = lacking[missing[0]]
            elif kind.scope == "fixture" and self.no_fixture:
                refused[name] = self.no_fixture
            elif kind.scope == "session" and self.no_session:
                refused[name] = self.no_session
            elif "temperature" in " ".join(kind.needs) and warming < _LEAST_WARMING:
                refused[name] = "the temperature stood still"
            else:
                asked[name] = kind
        return asked, refused

    def fit(
        self,
        effects: Sequence[Effect] = (),
        imu: Imu | None = None,
        prior: Prior | None = None,
        asking: Container[str] | None = None,
    ) -> State:
        """Fit gain, bias and the effects, each starting where it is given, and ask what else may be there.

        With a prior the effects' inner parameters are held. `asking`: of the effects of these names alone, without
        their triads. Raises `NotPossibleError` where the fit comes to nothing that a unit can be.
        """
        start = (self.start if imu is None else imu).with_effects(*effects)

        def free(name: Name) -> bool:
            held = prior is not None and name.effect is not None and name.part != "coefficients"
            return self.free(name) and not held

        found = fit(start, self, free, prior=prior, excess=np.zeros(len(self.coarse)), estimate_excess=False,
                    max_passes=16)  # fmt: skip
        if not bool(found.finite):
            names = " and ".join(effect.name for effect in effects) or "gain and bias"
            raise NotPossibleError(f"a fit of {names} to this recording comes to nothing that a unit can be.")
        linear, used = self.linearise(found.imu), self.used
        covariance = np.zeros((len(linear.names),) * 2)
        places = [linear.names.index(name) for name in found.names]
        covariance[np.ix_(places, places)] = found.covariance
        weights = scipy.linalg.solve_triangular(
            np.linalg.cholesky(linear.covariance[np.ix_(used, used)]), np.eye(int(used.sum())), lower=True
        )
        columns = np.concatenate([linear.slope, linear.columns * linear.sizes[linear.slope.shape[1] :]], axis=1)
        jacobian = weights @ columns[np.ix_(used, np.sort(places))]
        model = jax.tree.map(np.asarray, found.imu)
        fitted = {effect.name for effect in model.all_effects().values()}
        blocks, blind = self._blocks(model.with_effects(), linear, weights, fitted, asking)
        noise = None
        if self.drift is not None:
            noise = self.drift.draws(weights, jacobian, used, _SEED)
        whole = Evidence(weights @ linear.conditions[used], jacobian, blocks)
        limits = _limits(whole, model)
        seen = [b for b in blocks if b.kind != "effect" or limits[b.name][0] < _PLAUSIBLE * np.max(b.sizes)]
        for name in sorted({block.name for block in blocks} - {block.name for block in seen}):
            blind[name] = (
                "bias, scale and misalignment imitate it here, or nothing excites it; it needs "
                f"{CATALOGUE[name].excited_by}"
            )
        limits = {name: each for name, each in limits.items() if name not in blind}
        evidence = Evidence(whole.residual, jacobian, seen, noise)
        return State(
            model, linear.names, covariance, evidence, linear.conditions[used], weights, limits, blind, linear, prior
        )

    def by_setup(self, state: State) -> FloatArray:
        """Return what the set-up most likely adds to the real conditions (m,), where their covariance allows for it."""
        return np.zeros(len(state.conditions))

    def errors(self, state: State) -> list[FloatArray]:
        """Return the errors (v,) of each kind of condition that a fit leaves, in its unit."""
        return self.real.errors(state.conditions - self.by_setup(state))

    def beside(self, state: State) -> tuple[float, str]:
        """Return which shape, that a fit's effects may be taken for, stands out beside them, and its p-value."""
        blocks = self.nearly(state.imu, state.linear)
        if not blocks:
            return 1.0, ""
        blocks = [replace(b, columns=state.weights @ b.columns[self.used]) for b in blocks]
        p_value, block = state.evidence.strongest(blocks)
        return p_value, block.name

    def linearise(self, imu: Imu) -> Linear:
        """Return the conditions of the unit with its effects, linearised."""
        return linearise(imu, self, self.free)

    def predict(self, imu: Imu) -> tuple[FloatArray, FloatArray, FloatArray, tuple[Name, ...]]:
        """Return the conditions (n,) of a unit that is not fitted to them, their columns (n, p) and covariance (n, n).

        Columns are derivatives by the numbers whose names are returned, in their own units.
        """
        linear, used = self.linearise(imu), self.used
        columns = np.concatenate([linear.slope / linear.sizes[: linear.slope.shape[1]], linear.columns], axis=1)
        return linear.conditions[used], columns[used], linear.covariance[np.ix_(used, used)], linear.names

    def _blocks(
        self, imu: Imu, linear: Linear, weights: FloatArray, fitted: set[str], asking: Container[str] | None
    ) -> tuple[list[EffectBlock], dict[str, str]]:
        asked, refused = self.askable(linear)
        if asking is not None:
            asked = {name: kind for name, kind in asked.items() if kind.plain in asking}
        extent, used, blocks = self.extent(), self.used, []
        grids = {kind: kind.grid(extent) for kind in asked.values()}
        found = self.dormant_columns(imu, linear.details, grids)
        for name, kind in asked.items():
            if name in fitted:
                continue
            size = _sizes(kind, imu)
            for given, columns in zip(grids[kind], found[kind], strict=True):
                placed = kind.beginning() in given
                blocks.append(
                    EffectBlock(name, weights @ (columns * size)[used], size, "effect", given, placed, kind.curved())
                )
        generic = [replace(b, columns=weights @ b.columns[used]) for b in self.generic(imu, linear)]
        return blocks + generic, refused


def _limits(evidence: Evidence, imu: Imu) -> dict[str, tuple[float, str]]:
    """Return each effect's detection limit, wherever on its grid it is, and its unit; infinite if it is blind."""
    found: dict[str, tuple[float, str]] = {}
    triads = imu.triads()
    places: dict[str, list[int]] = {}
    for k, block in enumerate(evidence.blocks):
        if block.kind == "effect":
            places.setdefault(block.name, []).append(k)
    for name, blocks in places.items():
        triad = triads.get(CATALOGUE[name].owner, imu.accelerometer)
        seen = [k for k in blocks if evidence.observable(k)]
        limit = evidence.limit(seen) if seen else np.inf
        found[name] = limit, CATALOGUE[name].coefficient_unit(triad.output_unit)
    return found


def _sizes(kind: type[Effect], imu: Imu) -> FloatArray:
    """Typical sizes of an effect's coefficients, to scale columns by."""
    triad = imu.triads().get(kind.owner, imu.accelerometer)
    scale = float(np.mean(np.linalg.norm(np.asarray(triad.gain), axis=-1)))
    typical = {name: each.typical for name, each in kind.inner.items()}
    return np.asarray(kind(np.zeros(kind.size), **typical).typical_sizes(scale).coefficients)
