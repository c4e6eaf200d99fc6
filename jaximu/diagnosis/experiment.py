"""What a diagnosis asks questions of: a recording as a linear problem about a fit, whatever it was recorded with."""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy
from jaxtyping import Float
from numpy.typing import NDArray

from jaximu.diagnosis.drift import DriftComponents
from jaximu.diagnosis.evidence import FAMILY_LEVEL, EffectBlock, Evidence
from jaximu.diagnosis.shapes import imitated_shapes, shapes_without_cause
from jaximu.estimation.data import About, Conditions, Data
from jaximu.estimation.fitting import Linear, Prior, effect_numbers, fit, linearise
from jaximu.estimation.problem import Name, flatten, names_of
from jaximu.estimation.rows import Fold, Rows, Sizes
from jaximu.estimation.track import added
from jaximu.ground.array_types import Array, BoolArray, FloatArray
from jaximu.ground.distributions import chi2_sf
from jaximu.ground.document import Json
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.vectors import submatrix
from jaximu.model.effects import CATALOGUE, Effect
from jaximu.model.effects.base import Extent, Kind
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.recordings.finding import Finding
from jaximu.recordings.recording import Recording, one_after_another

LEAST_WARMING = 0.2
"""K of change below which a recording shows nothing of temperature."""
_PLAUSIBLE = 20.0
"""Typical sizes beyond which a detection limit means that a recording does not show the effect."""
_SURE = 5.0
"""Standard deviations that samples of instants must change the conditions by to be told from means."""
_SEED = 20260101
_LACKING = {
    "vibration_power": "the recording has no vibration that stands out",
    "magnetic_field": "no magnetometer was recorded with it",
    "attitude": "the attitude is not known at all times",
}


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
    limits: Sizes
    blind: dict[str, str]
    linear: Linear
    prior: Prior | None = None

    @property
    def imu(self) -> Imu:
        """Gain and bias, without effects."""
        return self.model.with_effects()

    @property
    def fitted(self) -> NDArray[np.intp]:
        """The places (p,) among `names` of the numbers that were free, the columns of the evidence's Jacobian."""
        return np.flatnonzero(np.diag(self.covariance) > 0)

    @property
    def fitted_sizes(self) -> FloatArray:
        """The sizes (p,) that the Jacobian's columns are in units of."""
        return np.asarray(self.linear.sizes, np.float64)[self.fitted]

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects that were fitted."""
        return tuple(self.model.all_effects().values())

    @property
    def informed(self) -> tuple[FloatArray, FloatArray]:
        """Whitened columns (n + k, p) and conditions (n + k,): below the data's those of the k numbers of the prior."""
        columns, conditions = self.evidence.jacobian, self.weights @ self.conditions
        if self.prior is None:
            return columns, conditions
        names, values = names_of(self.model), np.asarray(flatten(self.model))
        known = values[[names.index(name) for name in self.prior.names]] - self.prior.mean
        rows = self.prior.rows([self.names[k] for k in self.fitted], self.fitted_sizes)
        return np.concatenate([columns, rows]), np.concatenate([conditions, self.prior.root @ known])

    def places(self, name: str, part: str = "coefficients") -> list[int]:
        """Return the places of a fitted effect's coefficients, or of an inner parameter, among the numbers."""
        (key,) = (key for key, effect in self.model.all_effects().items() if effect.name == name)
        return [
            k for k, number in enumerate(self.names) if (number.owner, number.effect) == key and number.part == part
        ]

    def differs(self, name: str, level: float) -> bool:
        """Return whether a fitted effect's coefficients differ from zero, together."""
        (effect,) = (effect for effect in self.effects if effect.name == name)
        places, values = self.places(name), np.asarray(effect.coefficients)
        known = np.linalg.pinv(submatrix(self.covariance, places), hermitian=True)
        return float(chi2_sf(float(values @ known @ values), len(places))) < level


class KnownEffect(NamedTuple):
    """An effect that is known beforehand: its most likely coefficients (q,), and a root (q, k) of their covariance."""

    effect: Effect
    root: FloatArray

    @classmethod
    def of_setup(cls, effect: Effect) -> KnownEffect:
        """Return an effect of a set-up, as calibrated, whose numbers are known to what set-ups usually are."""
        return cls(effect, np.diag(np.broadcast_to(np.asarray(effect.known, np.float64), effect.size)))


class _Shifted(Conditions):
    """Conditions with something added to each."""

    conditions: Conditions
    shift: Float[Array, " n"]

    @property
    def magnitude(self) -> Array:
        """What is known and uncertain."""
        return self.conditions.magnitude  # pyright: ignore[reportAttributeAccessIssue]

    def __call__(self, imu: Imu) -> Float[Array, " n"]:
        """Return the conditions."""
        return self.conditions(imu) + self.shift

    def at_magnitude(self, magnitude: Float[Array, ""]) -> _Shifted:
        """Return the same with another magnitude."""
        return replace(self, conditions=self.conditions.at_magnitude(magnitude))


@dataclass
class Experiment(Data):
    """Data of one unit, to be asked for all that its calibration lacks.

    data: what was recorded. start: a calibration without effects. drift: what was estimated of it from this very
    recording. candidates: names of the effects that are asked; None: all of the catalogue. known: effects that are
    taken off, of a fixture or as other recordings tell them; how well they are known is part of the covariance. excess
    (k,): of the noise, where a calibration estimated it. shift (n,): added to the conditions. reference: what is known
    of a measured attitude, as `calibration.json` has it.
    """

    data: Data
    start: Imu
    drift: DriftComponents | None = None
    candidates: tuple[str, ...] | None = None
    known: tuple[KnownEffect, ...] = ()
    excess: FloatArray | None = None
    shift: FloatArray | float = 0.0
    reference: Json | None = None

    def __post_init__(self) -> None:
        self.excess_names, self.coarse = self.data.excess_names, self.data.coarse

    # --- the data, as a fit takes them ----------------------------------------------------------------------------

    def rows(self, imu: Imu) -> Rows:
        """Return what each condition is."""
        return self.data.rows(imu)

    def free(self, name: Name) -> bool:
        """Return whether a number is free."""
        return self.data.free(name)

    def freed(self, prior: Prior | None) -> Callable[[Name], bool]:
        """Return which numbers are free beside a prior of effects: their inner parameters are held."""
        held = set() if prior is None else {(name.owner, name.effect) for name in prior.names}
        return lambda name: self.free(name) and (name.part == "coefficients" or (name.owner, name.effect) not in held)

    def reactions(self, details: Any):
        """Return how the conditions react to effects."""
        return self.data.reactions(details)

    def about(self, imu: Imu) -> About:
        """Return the conditions about one unit, the leading axis, and in their covariance all that is not known."""
        single = jax.tree.map(lambda leaf: np.asarray(leaf)[0], imu)
        unit = single.all_effects()
        whole = single.with_effects(*unit.values(), *(known.effect for known in self.known))
        about = self.data.about(jax.tree.map(lambda leaf: np.asarray(leaf)[None], whole))
        names = effect_numbers(whole)[0]
        unknown = np.zeros((about.covariance.used.shape[1], 0))
        if self.drift is None and self.excess is None and not self.known and not np.any(self.shift):
            return about
        covariance = jax.tree.map(lambda leaf: np.asarray(leaf)[0], about.covariance).dense()
        noise = np.array(covariance.measured)
        if self.excess is not None:
            noise = np.asarray(covariance.total(self.excess)) - np.diag(1 - covariance.used)
        if self.drift is not None:
            noise += np.diag(self.drift.by_hand)
        for effect, root in self.known:
            of_name = {key for key, other in whole.all_effects().items() if other.name == effect.name}
            (key,) = of_name - set(unit)
            numbers = [(name.owner, name.effect) == key and name.part == "coefficients" for name in names]
            unknown = np.concatenate([unknown, about.columns[0][:, numbers] @ root], axis=1)
        covariance = replace(covariance, measured=noise + unknown @ unknown.T)
        lifted = jax.tree.map(lambda leaf: leaf[None], covariance)
        conditions: Conditions = about.conditions
        if np.any(self.shift):
            conditions = _Shifted(conditions, np.asarray(self.shift)[None])
        mine = np.array([(name.owner, name.effect) in unit for name in names], bool)
        columns = about.columns[..., mine]
        return replace(about, conditions=conditions, covariance=lifted, columns=columns, unknown=unknown)

    # --- what was recorded ----------------------------------------------------------------------------------------

    @cached_property
    def used(self) -> BoolArray:
        """Which of the conditions are real."""
        return self.rows(self.start).used

    @cached_property
    def real(self) -> Rows:
        """What each real condition is."""
        return self.rows(self.start).real()

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """What is diagnosed, as it was recorded."""
        return self.data.recordings

    def extent(self, recording: int = 0) -> Extent:
        """Return what a recording spans, by its number, or all of them (0)."""
        return self.data.extent(recording)

    def still_parts(self, triad: str) -> tuple[list[FloatArray], float]:
        """Return what a triad put out (k, 3) in each part at rest, in SI, and its rate, Hz."""
        parts, rate = [], 1.0
        for recording, rests in zip(self.recordings, self.data.rests(), strict=True):
            signal = recording.signals[triad]
            rate, values = signal.rate, signal.si()
            parts += [values[first:last] for first, last in np.searchsorted(signal.time, rests)]
        return parts, rate

    def shortest(self) -> float:
        """Return the usual length (s) of a part at rest: noise that is slower shows between them."""
        parts, rate = self.still_parts("accelerometer")
        return float(np.median([len(part) for part in parts])) / rate

    def folds(self, count: int, interleaved: bool = False) -> list[Fold]:
        """Return what is left out in turn: stretches of the recording or, `interleaved`, every so many observations."""
        return self.real.folds(self.data.parts(self.real, count, interleaved))

    def without(self, observation: int) -> Experiment:
        """Return the experiment with an observation, and what touches it, left out."""
        return replace(self, data=self.data.without(observation))

    def averaged(self) -> Experiment:
        """Return the experiment with the gyroscope's samples of instants turned into means."""
        data = self.data.averaged()
        return self if data is None else replace(self, data=data)

    # --- what can be asked ----------------------------------------------------------------------------------------

    def lacking(self, kind: type[Effect], linear: Linear) -> str:
        """Return why what an effect depends on is not known along the path; empty where it is."""
        stimuli = [track.stimulus for tracks in self.data.tracks(linear.details) for track in tracks.values()]
        for need in kind.needs:
            if any(getattr(stimulus, need) is None for stimulus in stimuli):
                return _LACKING.get(need, f"the recording has no {need.replace('_', ' ')}")
        return ""

    def askable(self, linear: Linear) -> tuple[dict[str, type[Effect]], dict[str, str]]:
        """Return the effects that can be asked of these recordings, and why others cannot."""
        askable, refused = {}, {}
        warming, hidden = self.extent().temperature_range, self.data.hidden()
        for name, kind in CATALOGUE.items():
            if not kind.cause or kind.owner not in self.data.owners:
                continue
            kinds = {one.name: one for one in self.by_recording(kind)}
            if self.candidates is not None and name not in self.candidates:
                kinds = {one: kinds[one] for one in self.candidates if one in kinds}
            if not kinds:
                continue
            why = self.lacking(kind, linear)
            if why:
                refused[name] = why
            elif kind.scope == "fixture" and self.data.no_fixture:
                refused[name] = self.data.no_fixture
            elif "temperature" in " ".join(kind.needs) and warming < LEAST_WARMING:
                refused[name] = "the temperature stood still"
            elif name in hidden:
                refused[name] = hidden[name]
            else:
                askable |= kinds
        return askable, refused

    def by_recording(self, kind: type[Kind]) -> list[type[Kind]]:
        """Return an effect as it is asked: of a session once for each of several recordings, acting in it alone.

        Where recordings follow each other, what dies away or grows after power-on is also asked once over all of them.
        """
        count = len(self.recordings)
        if kind.scope != "session" or count < 2 or not self.data.by_hand:  # by hand each has its own time and heading
            return [kind]
        kinds = [kind.within(number) for number in range(1, count + 1)]
        follow = kind.carries_on and one_after_another(self.recordings)
        return [*kinds, kind.throughout()] if follow else kinds

    def largest(self, state: State, effect: Effect) -> dict[str, float]:
        """Return the most (SI) that an effect adds to each triad's output in these recordings."""
        triads = state.imu.triads()
        most = dict.fromkeys(triads, 0.0)
        for number, tracks in enumerate(self.data.tracks(state.linear.details), 1):
            for name, outputs in added(state.imu.with_effects(effect.in_recording(number)), tracks).items():
                scale = triads[name].scales
                values = np.abs(np.asarray(outputs)[tracks[name].inside()] / scale)
                most[name] = max(most[name], float(np.max(values)))
        return most

    def rms(self, imu: Imu, linear: Linear) -> Sizes:
        """Return the rms of each kind of residual, with its unit, as a calibration has it."""
        return self.data.rms(imu, linear.details, linear.conditions)

    def instants(self, state: State) -> bool:
        """Return whether a fit shows the gyroscope's samples to be rates at instants, and not means.

        Along what that would change of the conditions, the fit's residual is nothing or all of it.
        """
        if self.data.averaged() is None:
            return False
        change = self.data.change_by_averaging(state.linear.details)[self.used]
        white = state.evidence.off_base(state.weights @ change)
        length = float(white @ white)
        return length > _SURE**2 and abs(float(white @ state.evidence.residual) / length - 1) < 0.5

    def moved_by_hand(self) -> list[Finding]:
        """Return what is wrong with how hands moved the unit, as far as it was estimated."""
        if self.drift is None or self.drift.handling is None:
            return []
        return self.data.moved_by_hand(self.start, self.drift.handling, self.drift.sizes["turns undersampled"][0])

    def twin(self, state: State, noise: NoiseModel, seed: int) -> Experiment:
        """Return the experiment as a fit without effects would have it, along the same motion, noise included.

        Where the noise is known of the conditions alone it is drawn for them; how a reference is mounted and late was
        found, and is taken off.
        """
        made = self.data.twin(state.imu, state.linear.details, state.linear.conditions, noise, seed)
        if made is not None:
            return Experiment(made, state.imu)
        linear = self.linearise(state.imu) if state.effects else state.linear
        unknown = np.zeros((len(self.used), 0)) if linear.unknown is None else linear.unknown
        noisy = linear.covariance - unknown @ unknown.T
        root = np.linalg.cholesky(noisy + np.diag((~self.used).astype(float)))
        drawn = root @ np.random.default_rng(seed).normal(size=len(self.used)) * self.used
        return replace(self, start=state.imu, shift=self.shift + drawn - state.linear.conditions)

    def fit(
        self,
        effects: Sequence[Effect] = (),
        imu: Imu | None = None,
        prior: Prior | None = None,
        asking: Container[str] | None = None,
    ) -> State:
        """Fit gain, bias and the effects, each starting where it is given, and ask what else may be there.

        Those of the prior keep their inner parameters. `asking`: of the effects of these names alone, without
        their triads. Raises `NotPossibleError` where the fit comes to nothing that a unit can be.
        """
        start = (self.start if imu is None else imu).with_effects(*effects)
        fitted = fit(
            start,
            self,
            self.freed(prior),
            prior=prior,
            excess=np.zeros(len(self.coarse)),
            estimate_excess=False,
            max_passes=16,
        )
        if not bool(fitted.finite):
            names = " and ".join(effect.name for effect in effects) or "gain and bias"
            raise NotPossibleError(f"a fit of {names} to this recording comes to nothing that a unit can be.")
        linear, used = self.linearise(fitted.imu), self.used
        covariance = np.zeros((len(linear.names),) * 2)
        places = [linear.names.index(name) for name in fitted.names]
        covariance[np.ix_(places, places)] = fitted.covariance
        weights = scipy.linalg.solve_triangular(
            np.linalg.cholesky(submatrix(linear.covariance, used)), np.eye(int(used.sum())), lower=True
        )
        columns = np.concatenate([linear.slope, linear.columns * linear.sizes[linear.slope.shape[1] :]], axis=1)
        jacobian = weights @ columns[np.ix_(used, np.sort(places))]
        model = jax.tree.map(np.asarray, fitted.imu)
        inside = {effect.name for effect in model.all_effects().values()}
        blocks, blind = self._blocks(model.with_effects(), linear, weights, inside, asking)
        noise = None
        if self.drift is not None:
            noise = self.drift.draws(weights, jacobian, used, _SEED)
        whole = Evidence(weights @ linear.conditions[used], jacobian, blocks)
        limits = _limits(whole, model)
        # drift that was estimated may have swallowed what stands out of it all the same
        clear = [False] * len(blocks) if self.drift is None else whole.scores().p_value * len(blocks) < FAMILY_LEVEL
        visible = [
            block
            for block, stands in zip(blocks, clear, strict=True)
            if block.kind != "effect" or stands or limits[block.name][0] < _PLAUSIBLE * np.max(block.sizes)
        ]
        for name in sorted({block.name for block in blocks} - {block.name for block in visible}):
            blind[name] = (
                "bias, scale and misalignment imitate it here, or nothing excites it; it needs "
                f"{CATALOGUE[name].excited_by}"
            )
        limits = {name: limit for name, limit in limits.items() if name not in blind}
        same = noise is None and len(visible) == len(blocks)
        evidence = whole if same else Evidence(whole.residual, jacobian, visible, noise)
        return State(
            model, linear.names, covariance, evidence, linear.conditions[used], weights, limits, blind, linear, prior
        )

    def by_known(self, state: State) -> FloatArray:
        """Return what known effects, and what may lie off beforehand, most likely add to the real conditions (m,).

        That is the mean of their numbers, given the conditions. Near the level a tilted reference looks like a bias of
        the accelerometer; which of both it is, nothing tells.
        """
        parts = [] if state.linear.unknown is None else [state.linear.unknown]
        unknown = np.concatenate([*parts, self.data.allowed(len(self.used))], axis=1)[self.used]
        return unknown @ ((state.weights @ unknown).T @ (state.weights @ state.conditions))

    def errors(self, state: State) -> list[FloatArray]:
        """Return the errors (v,) of each kind of condition that a fit leaves, in its unit."""
        return self.real.errors(state.conditions - self.by_known(state))

    def beside(self, state: State) -> tuple[float, str]:
        """Return which shape, that a fit's effects may be taken for, stands out beside them, and its p-value."""
        blocks = imitated_shapes(self.data.observed(state.imu, state.linear.details))
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
        return linear.conditions[used], columns[used], submatrix(linear.covariance, used), linear.names

    def _blocks(
        self, imu: Imu, linear: Linear, weights: FloatArray, fitted: set[str], asking: Container[str] | None
    ) -> tuple[list[EffectBlock], dict[str, str]]:
        askable, refused = self.askable(linear)
        if asking is not None:
            askable = {name: kind for name, kind in askable.items() if name.partition(".")[2] in asking}
        extents = {number: self.extent(number) for number in {kind.recording for kind in askable.values()}}
        grids = {kind: kind.grid(extents[kind.recording]) for kind in askable.values()}
        reactions, blocks = self.dormant_columns(imu, linear.details, grids), []
        for name, kind in askable.items():
            if name in fitted:
                continue
            size = _sizes(kind, imu)
            for inner, columns in zip(grids[kind], reactions[kind], strict=True):
                placed = kind.beginning() in inner
                blocks.append(EffectBlock(name, columns * size, size, "effect", inner, placed, kind.curved()))
        blocks += shapes_without_cause(self.data.observed(imu, linear.details))
        if not blocks:
            return [], refused
        whitened = weights @ np.concatenate([block.columns[self.used] for block in blocks], axis=1)
        ends = np.cumsum([block.columns.shape[1] for block in blocks])
        parts = np.split(whitened, ends[:-1], axis=1)
        return [replace(block, columns=part) for block, part in zip(blocks, parts, strict=True)], refused


def _limits(evidence: Evidence, imu: Imu) -> Sizes:
    """Return each effect's detection limit, wherever on its grid it is, and its unit; infinite if it is blind."""
    limits: Sizes = {}
    triads = imu.triads()
    places: dict[str, list[int]] = {}
    for k, block in enumerate(evidence.blocks):
        if block.kind == "effect":
            places.setdefault(block.name, []).append(k)
    for name, blocks in places.items():
        triad = triads.get(CATALOGUE[name].owner, imu.accelerometer)
        visible = [k for k in blocks if evidence.observable(k)]
        limit = evidence.limit(visible) if visible else np.inf
        limits[name] = limit, CATALOGUE[name].coefficient_unit(triad.output_unit)
    return limits


def _sizes(kind: type[Effect], imu: Imu) -> FloatArray:
    """Typical sizes of an effect's coefficients, to scale columns by."""
    triad = imu.triads().get(kind.owner, imu.accelerometer)
    scale = float(np.mean(triad.scales))
    typical = {name: parameter.typical for name, parameter in kind.inner.items()}
    return np.asarray(kind(np.zeros(kind.size), **typical).typical_sizes(scale).coefficients)
