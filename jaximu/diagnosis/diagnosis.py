"""`Diagnosis`: what a fitted model gets wrong, why, the extended model, and what it gains."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaximu.calibration import Calibration
from jaximu.calibration.bias_drift import with_gravity
from jaximu.calibration.calibration import clock_sigma, concluded
from jaximu.calibration.recipe import Choices, calibrate, calibrate_ready, carried_error
from jaximu.data.by_hand import RecordedByHand
from jaximu.data.drift import about_biases, with_usual_drift
from jaximu.diagnosis.checks import Check, checks_of
from jaximu.diagnosis.choice import with_open_choice
from jaximu.diagnosis.drift import DriftComponents, drifted, estimate_drift, hands_of
from jaximu.diagnosis.evidence import FEWEST_DIMENSIONS, LIMIT_POWER
from jaximu.diagnosis.experiment import Experiment, KnownEffect, State
from jaximu.diagnosis.extension import Extension, Found, extend, settled
from jaximu.diagnosis.hidden import Hidden, hidden_causes
from jaximu.diagnosis.improvement import Gain, cross_validated, on_held_out
from jaximu.diagnosis.learned import (
    LearnedTerm,
    PromisingCurve,
    drifts,
    learn,
    left_out,
    promising,
)
from jaximu.diagnosis.lines import MovingLine, line_findings, moving_lines, swings_of
from jaximu.diagnosis.noise import NOISE_NAMES, NoiseFinding, own_noise, quick_noise, slow_noise, usual_noise
from jaximu.diagnosis.selection import Selection, select, shape_of, slow_change, standing_out
from jaximu.estimation.data import Data
from jaximu.estimation.fitting import fit
from jaximu.estimation.rows import ResidualKind, Sizes
from jaximu.ground.array_types import BoolArray, FloatArray
from jaximu.ground.document import SOFTWARE, Document, Json, entries
from jaximu.ground.errors import InputError, NotPossibleError, nearest
from jaximu.ground.gravity import STANDARD, Gravity, LocalGravity, as_gravity
from jaximu.ground.page import Result
from jaximu.ground.quantities import Z95, change, listed, probability, sentence, size, with_interval, with_intervals
from jaximu.ground.vectors import column_lengths, lengths_of, root_or_zero, submatrix
from jaximu.mistakes import prepare, prepared
from jaximu.mistakes.titles import effect_title
from jaximu.model.effects import CATALOGUE, Effect, register
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.noise.at_rest import noise_of
from jaximu.recordings.finding import Finding
from jaximu.recordings.recording import Recording, recordings_of
from jaximu.recordings.segmentation import SegmentationOptions

SCHEMA = "jaximu.diagnosis/1"
_OTHER_UNIT = 0.005
"""Difference of gains, in scales, from which two recordings are hardly of one unit."""
_STEADY = ("bias_ramp", "temperature")
"""Effects that change as slowly as drift does."""
_ROUNDS = 4
"""How often drift and hands are estimated at most, beside the effects that stand out the time before."""
_GUESSED = 10.0
"""Nats that effects must gain, having been chosen on the same data: those that explain a part of a misfit, beyond a
smooth term, and those with which no error of what was left out is smaller."""
_LESS = 0.05
"""Share by which taking off a line must lessen the error of the rate at rest: less is what a refit does by chance."""
_NOT_ASKED = "the noise was taken from this recording itself: it needs a recording at rest (--static) to compare with"

_INSTANTS = Finding(
    "data.sampling",
    (),
    "The gyroscope's samples are rates at instants and not means over the sample interval, as a log thinned without a "
    "filter has them. Turns were integrated accordingly. Log at the sensor's own rate, or let it filter.",
)
_SWAYING = "the unit moved in its poses, which looks like noise: put it down, or hold it against something solid"


@dataclass(frozen=True)
class Named:
    """An effect that the recording shows: fitted, with its rivals, its evidence and what it gains.

    p_value: of its absence, by its own test, its grid allowed for. weak: below twice its detection limit. sigma: of the
    coefficients. gain: of the whole extension, on data that was not fitted. file: of the recording where it acts in one
    of several alone, else empty.
    """

    effect: Effect
    rivals: tuple[str, ...]
    p_value: float
    weak: bool
    sigma: FloatArray
    inner_sigma: dict[str, float]
    unit: str
    triad: str  # that it changes most
    largest: float  # that it adds to that triad's output in this recording, SI
    evidence: str
    gain: Gain | None
    file: str = ""

    @property
    def name(self) -> str:
        """The catalogue's name, with the number of the recording where it acts in one of several."""
        return self.effect.name

    @property
    def scope(self) -> str:
        """What it belongs to: "device", "session" or "fixture"."""
        return self.effect.scope

    def numbers(self) -> list[str]:
        """Return coefficients and inner parameters, with half their 95 % intervals; a curve is drawn instead."""
        if not self.effect.cause:
            return [f"a curve of {self.effect.size} coefficients, drawn in the report"]
        values = np.asarray(self.effect.coefficients)
        texts = [
            text + (" (not different from zero)" if abs(value) <= Z95 * sigma else "")
            for text, value, sigma in zip(
                with_intervals(values, self.sigma, self.unit), values, self.sigma, strict=True
            )
        ]
        for name, parameter in self.effect.inner.items():
            value, sigma = float(getattr(self.effect, name)), self.inner_sigma.get(name)
            text = size(value, parameter.unit, 4) if sigma is None else with_interval(value, sigma, parameter.unit)
            texts.append(f"{name.replace('_', ' ')} {text}")
        return texts

    def impossible(self) -> str:
        """Say by how much the effect is larger than nature has it, three sigmas allowed for; empty where it may be."""
        values = np.asarray(self.effect.coefficients)
        length = float(np.linalg.norm(values))
        if length - 3 * float(np.linalg.norm(values * self.sigma)) / max(length, 1e-300) <= self.effect.possible:
            return ""
        alike = listed([effect_title(name) for name in dict.fromkeys((*self.rivals, *self.effect.look_alikes))], "or")
        return (
            f"{sentence(self.effect.title)} comes out {length / self.effect.possible:.2g} times as large as it can be: "
            f"something else looks like it here, such as {alike}."
        )

    def sentence(self) -> str:
        """Return what it adds, for the verdict."""
        start = self.effect.since()
        since = "" if start is None else f", from {start:.4g} s on"
        file = f" of {self.file}" if self.file else ""
        return f"{self.effect.title}{file}, up to {self.size()}{since}"

    def size(self) -> str:
        """Return the most that it adds, with its unit."""
        return size(self.largest, "m/s^2" if self.triad == "accelerometer" else "rad/s")

    def document(self) -> Json:
        """Return the effect as `diagnosis.json` has it."""
        inner = {
            name: {
                "value": float(getattr(self.effect, name)),
                "sigma": self.inner_sigma.get(name),
                "unit": parameter.unit,
            }
            for name, parameter in self.effect.inner.items()
        }
        return {
            "name": self.effect.acting().name,
            **({"recording": self.effect.recording} if self.effect.recording else {}),
            **entries(self, "p_value", "weak", "sigma", "unit", "evidence"),
            "indistinguishable_from": list(self.rivals),
            "scope": self.effect.scope,
            "coefficients": np.asarray(self.effect.coefficients).tolist(),
            "inner": inner,
            "improvement": None if self.gain is None else self._improvement(self.gain),
        }

    def _improvement(self, gain: Gain) -> Json:
        kind = gain.best_kind(self.effect)
        (before, unit), (after, _) = gain.before.rms[kind], gain.after.rms[kind]
        return {
            "heldout_rms_before": before,
            "heldout_rms_after": after,
            "unit": unit,
            "residual": kind,
            **gain.document(),
        }


@dataclass(frozen=True)
class Option:
    """A recording that could be made next.

    text: what to do. powers: by rival, with which it tells the cause from it; by the cause's own name, with which it
    finds it, where it has no rivals. before: the same of the recording that was diagnosed.
    """

    text: str
    powers: dict[str, float]
    before: dict[str, float]

    @property
    def told(self) -> list[str]:
        """The rivals that it tells apart with 90 % power."""
        return [name for name, power in self.powers.items() if power >= LIMIT_POWER]

    @property
    def better(self) -> bool:
        """Whether it shows more than the recording that was diagnosed, by a percent at least, as both are stated."""
        return any(round(100 * power) > round(100 * self.before[name]) for name, power in self.powers.items())


@dataclass(frozen=True, repr=False, eq=False)
class Diagnosis(Result, Document, page="diagnosis"):
    """What a recording says of its model.

    verdict: "adequate", "effects" or "unexplained". effects: causes jointly present, strongest first; what is wrong
    with the noise model among them. p_value: family-wise, that nothing is missing. detection_limits: by effect, what
    could hide in this recording. not_observable: effects that it cannot show, and why. noise: put right where it was
    wrong. base, extended: the fits. unit: factor by which the noise looked too small. learned: where something stays
    unexplained, a smooth term of what it depends on, which `extended` contains. drifts: among `effects`, biases that
    drift along curves. options: recordings that would settle a cause, where [`jaximu.planning.separation.advised`][]
    was asked. shape: where something stays unexplained, what it looks like if one shape without a cause describes it.
    """

    verdict: str
    effects: tuple[Named | NoiseFinding, ...]
    preflight: tuple[Finding, ...]
    p_value: float
    unit: float
    detection_limits: Sizes
    not_observable: dict[str, str]
    checks: tuple[Check, ...]
    suggestion: str
    notes: tuple[str, ...]
    calibration: Calibration
    experiment: Experiment
    noise: NoiseModel
    base: State
    extended: State
    gain: Gain | None = None
    learned: LearnedTerm | None = None
    drifts: tuple[LearnedTerm, ...] = ()
    options: tuple[Option, ...] = ()
    shape: str | None = None
    lines: tuple[MovingLine, ...] = ()

    @property
    def curves(self) -> tuple[LearnedTerm, ...]:
        """All curves that the extended model contains, the one that explains most first."""
        return self.drifts or (() if self.learned is None else (self.learned,))

    @property
    def named(self) -> tuple[Named, ...]:
        """The effects that are terms of the model."""
        return tuple(effect for effect in self.effects if isinstance(effect, Named))

    def document(self) -> Json:
        """Return the diagnosis as the JSON document of schema `jaximu.diagnosis/1`."""
        return {
            "schema": SCHEMA,
            **entries(self, "verdict", "not_observable", "suggestion", "p_value", "notes", "shape"),
            "effects": [effect.document() for effect in self.effects],
            "preflight": [finding.document() for finding in self.preflight],
            "detection_limits": {
                name: {"value": value, "unit": unit} for name, (value, unit) in self.detection_limits.items()
            },
            "hidden": [
                entries(cause, "name", "limit", "unit", "shift")
                | {"weakest": {"combination": weights.tolist(), "limit": limit if np.isfinite(limit) else None}}
                for cause in self.hidden
                for weights, limit in [cause.weakest]
            ],
            "checks": [check.document() for check in self.checks],
            "next": [
                {"record": option.text, "power": option.powers, "power_now": option.before} for option in self.options
            ],
            "noise_scale": self.unit,
            "learned": next((curve.document() for curve in self.curves), None),
            "data": self.calibration.data,
            "software": SOFTWARE,
        }

    @cached_property
    def hidden(self) -> list[Hidden]:
        """What each cause at its detection limit would do to the numbers of the extended fit, the worst first."""
        return hidden_causes(self.extended)

    def extended_calibration(self) -> Calibration:
        """Return the calibration with the effects that were found: it is used and saved like any other.

        Its covariance allows for other effects that the recording does not exclude.
        """
        diagnosis = {
            "verdict": self.verdict,
            "effects": [effect.name for effect in self.effects],
            "learned": next((curve.effect.name for curve in self.curves), None),
            "p_value": self.p_value,
            "suggestion": self.suggestion,
        }
        with_effects = extended(self.calibration, self.experiment, self.extended, self.noise)
        chosen = [effect.name for effect in self.extended.effects]
        base = self.drifts[0].state if self.drifts else self.base
        return replace(with_open_choice(with_effects, base, chosen), diagnosis=diagnosis)


def extended(calibration: Calibration, experiment: Experiment, state: State, noise: NoiseModel) -> Calibration:
    """Return the calibration that a fit with effects is: its own rank, excess, weak directions and rms.

    Without effects it is, by hand, one whose weights and intervals know the slow noise, and what hands added where
    that was estimated. `noise`: of the samples, as it is in the covariance of the conditions.
    """
    if not state.effects and not experiment.data.by_hand:
        return calibration
    fitted = fit(
        state.model,
        experiment,
        experiment.freed(state.prior),
        prior=state.prior,
        excess=np.zeros(len(experiment.coarse)),
    )
    beyond = np.asarray(fitted.excess) + (0.0 if experiment.excess is None else experiment.excess)
    linear = replace(experiment, excess=beyond).linearise(fitted.imu)  # the fit's weights know its excess
    after = experiment.rms(fitted.imu.with_effects(), linear)
    known = {name: (size, unit) for name, (size, _, unit) in calibration.rms.items() if name in after}
    before = (
        known if len(known) == len(after) else experiment.rms(experiment.start, experiment.linearise(experiment.start))
    )
    calibrated = concluded(
        fitted,
        gravity=calibration.gravity,
        method=calibration.method,
        loss="linear",
        advice=experiment.data.advice,
        excess_names=experiment.excess_names,
        rms=[before, after],
        data=calibration.data,
        notes=calibration.notes,
        segmentations=calibration.segmentations,
        nominal=calibration.nominal,
        reading=calibration.reading,
    )
    calibrated = replace(calibrated, reference=experiment.reference)
    means = experiment.data.output_means(linear.details)
    if means is None:
        return calibrated
    slope, columns = linear.slope / linear.sizes[: linear.slope.shape[1]], linear.columns
    places = [linear.names.index(name) for name in fitted.names]
    jacobian, used = np.concatenate([slope, columns], axis=1)[:, places], experiment.used
    by_conditions = np.zeros(jacobian.T.shape)
    total = np.asarray(fitted.covariance, np.float64)
    by_conditions[:, used] = -total @ np.linalg.solve(submatrix(linear.covariance, used), jacobian[used]).T
    total, sigmas = about_biases(fitted.names, total, by_conditions, means, noise)
    fitted = replace(fitted, covariance=total)
    return replace(
        calibrated,
        fit=fitted,
        covariance=fitted.total_covariance(calibration.gravity.sigma, clock_sigma(calibration.segmentations)),
        bias_sigma_recording=with_gravity(fitted, sigmas, calibration.gravity),
    )


def diagnose(
    recordings: Recording | Data | Sequence[Recording],
    gravity: Gravity = STANDARD,
    *,
    start: Imu | None = None,
    static: Recording | NoiseModel | None = None,
    heldout: Recording | None = None,
    segmentation: SegmentationOptions | None = None,
    level: float = 0.05,
    repair: bool = False,
    candidates: Sequence[str | type[Effect]] | None = None,
    known: Sequence[KnownEffect] = (),
) -> Diagnosis:
    """Calibrate a unit, ask its recording for everything the model lacks, extend the model and measure the gain.

    **Arguments:** as for [`jaximu.calibrate`], and

    - `recordings`: several of one unit show together what one hardly does. Each has its own biases, as after another
      power-on; effects that belong to one recording (steps, ramps, warm-up, a drift along a curve) are tested in each
      and act in that one alone: "gyro.bias_ramp@2" is a ramp in the second. Where absolute stamps tell that recordings
      follow each other, ramps and warm-up are also tested over all of them: "gyro.warm_up@all". Or data of another
      kind, such as `jaximu.data.RecordedStations`, as [`jaximu.calibrate`][] takes them.
    - `start`: with data, as for [`jaximu.calibrate`][].
    - `gravity`: where it states a latitude, the Earth's rotation is no finding: it is taken off.
    - `static`: a recording of the unit at rest, or its `NoiseModel`. Without one the noise is taken from the poses
      themselves, which tells slow bias less surely.
    - `heldout`: another recording of the same unit, to measure the gain on; else parts of the recording are left out in
      turn.
    - `level`: rate of false alarms over all tests together.
    - `repair`: change what [`jaximu.mistakes.prepare`][] can put right; rows that are no measurement are left out
      in any case.
    - `candidates`: the only effects to test, by name or class; a class that the catalogue lacks is registered. None
      asks for all of the catalogue. Noise, mistakes and shapes without a cause are asked for in any case.
    - `known`: effects that other recordings of the unit tell. They are taken off recordings, and are no findings.

    No effect is named while a mistake in the recording stands that could imitate it. Raises `NotPossibleError` where
    the recording cannot be calibrated, has no gyroscope, or has too few poses to ask anything; `InputError` where a
    sensor holds nothing to calibrate.
    """
    gravity = as_gravity(gravity)
    names = None if candidates is None else tuple(map(_candidate, candidates))
    if isinstance(recordings, Data):
        if heldout is not None or segmentation is not None or repair or known:
            raise InputError("heldout, segmentation, repair and known are for recordings, and data were given.")
        return _of_data(recordings, gravity, start, noise_of(static), names, level)
    if start is not None:
        raise InputError("a start is for data: recordings by hand begin at the data sheet's values.")
    recordings = recordings_of(recordings)
    if any(recording.gyroscope is None for recording in recordings):
        raise NotPossibleError(
            "a diagnosis needs accelerometer and gyroscope: the turns between poses tell most causes apart."
        )
    choices = Choices(gravity, segmentation=segmentation)
    with prepared(recordings, repair, misfit=partial(carried_error, choices=choices)) as ready:
        findings = [finding for one in ready for finding in one.findings]
        calibration, unusual = calibrate_ready([one.recording for one in ready], choices, repair)
        notes, held = [*calibration.notes, *_only(names)], None
        if heldout is not None:
            other, _ = calibrate_ready([prepare(heldout, repair).recording], choices, repair)
            notes += same_device(calibration, other)
            held = recorded_by_hand(other)
        data = recorded_by_hand(calibration)
        lines = moving_lines(data.segmentations)

        def examined(data: Data) -> Diagnosis:
            examination = Examination.of(
                calibration,
                data,
                noise_of(static),
                held,
                names,
                tuple(notes),
                tuple(known),
                findings=(*findings, *unusual),
                level=level,
            )
            return examine(examination)

        diagnosis, before = examined(data), None
        if swings := swings_of(data.segmentations, lines):
            diagnosis, before = examined(data.without_swings(swings)), diagnosis
        return _with_lines(diagnosis, before, lines)


def _with_lines(diagnosis: Diagnosis, before: Diagnosis | None, lines: tuple[MovingLine, ...]) -> Diagnosis:
    """Return a diagnosis with lines that move; `before`: with those that pass for drift in the means at rest."""
    text, notes = "", diagnosis.notes
    if before is not None:
        old, new = (cross_validated(one.experiment, one.base).before for one in (before, diagnosis))
        gone = [effect.name for effect in before.effects if effect.name not in {one.name for one in diagnosis.effects}]
        (rest_before, unit), (rest, _) = (one.rms["static_gyroscope"] for one in (old, new))
        gain = (
            f"on parts left out, rate at rest {change(rest_before, rest, unit)}, χ² per condition "
            f"{old.chi_squared / old.count:.2f} → {new.chi_squared / new.count:.2f}."
        )
        if gone or rest < (1 - _LESS) * rest_before:
            text = f"What it adds to the means at rest was fitted and taken off: {gain}"
        else:
            diagnosis, text = before, f"Taking off what it adds to the means at rest gains nothing: {gain}"
        if gone:
            named = listed([effect_title(name) for name in gone])
            notes = (*notes, f"with the line that looks like bias drift left in, {named} would have been named.")
    findings = (*diagnosis.preflight, *line_findings(lines, diagnosis.calibration.segmentations, text))
    return replace(diagnosis, preflight=findings, notes=notes, lines=lines)


def _only(candidates: Sequence[str] | None) -> list[str]:
    """Say which effects alone were asked for."""
    if candidates is None:
        return []
    return [f"of all effects only these were asked for: {', '.join(candidates) or 'none'}."]


def _of_data(
    data: Data,
    gravity: LocalGravity,
    start: Imu | None,
    noise: NoiseModel | None,
    names: tuple[str, ...] | None,
    level: float,
) -> Diagnosis:
    """Calibrate data of whatever kind, and ask them for all that the model lacks."""
    if type(data).observed is Data.observed:
        raise InputError(f"{type(data).__name__} cannot be diagnosed: give the recording that they were taken from.")
    calibrated = partial(calibrate, data, gravity, start=start, static=noise)
    calibration = calibrated()
    notes = (*calibration.notes, *_only(names))
    if data.sampled:
        return examine(Examination.of(calibration, data, noise, None, names, notes, level=level))
    noise = noise or data.white_noise(calibration.excess)
    return diagnose_data(
        calibration, data, noise, lambda effects: calibrated(effects=effects), names, notes=notes, level=level
    )


def diagnose_data(
    calibration: Calibration,
    data: Data,
    noise: NoiseModel,
    recalibrated: Callable[[Sequence[Effect]], Calibration],
    candidates: Sequence[str] | None = None,
    **about: Any,
) -> Diagnosis:
    """Ask calibrated data, of whatever kind, the noise of whose samples is not known apart from what a fit leaves.

    How a set-up stands is known to what set-ups usually are, and no more: that is part of the conditions' covariance,
    and so is what the fit says of the noise. What explains the misfit is taken out of it, and the rest is asked again.

    **Arguments:** `noise`: what the samples' is shown as. `recalibrated`: returns the calibration with effects that
    were named. `about`: fields of `Examination`.
    """

    def examined(fitted: Calibration) -> Diagnosis:
        setup = (effect for effect in fitted.imu.all_effects().values() if effect.scope == "fixture")
        start = jax.tree.map(np.asarray, calibration.imu.with_effects())
        excess = np.array([fitted.excess[name] for name in data.excess_names])
        names = None if candidates is None else tuple(candidates)
        known = tuple(map(KnownEffect.of_setup, setup))
        experiment = Experiment(data, start, None, names, known, excess, reference=fitted.reference)
        return examine(Examination(calibration, noise, lambda noise: experiment, trusted=True, **about))

    diagnosis = examined(calibration)
    if not diagnosis.named:
        return diagnosis
    try:
        fitted = recalibrated([named.effect for named in diagnosis.named])
    except NotPossibleError:  # beside noise that is estimated with them they may be open: the first answer stands
        return diagnosis
    return examined(fitted)


def twin_of(diagnosis: Diagnosis, seed: int = 0) -> Experiment:
    """Return the twin of a diagnosed recording's base fit, ready to be asked what the recording was asked."""
    return diagnosis.experiment.twin(diagnosis.base, diagnosis.noise, seed)


@dataclass(frozen=True)
class Examination:
    """What a diagnosis starts from: a recording of whatever kind, calibrated, and what is known of it beforehand.

    remade: makes the experiment, the calibrated recording, with a noise model; held: the same of another recording of
    the unit, to measure the gain on. findings, notes: what was found before. level: rate of false alarms over all tests
    together. drifting: the noise was taken from the recording and knows no drift, which is estimated. trusted: the
    noise is not asked. taken: effects that another selection has chosen, which are named and kept. measured: how the
    gain is measured without another recording, where not by selecting anew without parts of this one.
    """

    calibration: Calibration
    noise: NoiseModel
    remade: Callable[[NoiseModel], Experiment]
    held: Callable[[NoiseModel], Experiment] | None = None
    findings: tuple[Finding, ...] = ()
    notes: tuple[str, ...] = ()
    level: float = 0.05
    drifting: bool = False
    trusted: bool = False
    taken: tuple[Effect, ...] = ()
    measured: Callable[[Experiment, State, State], Gain] | None = None

    @classmethod
    def of(
        cls,
        calibration: Calibration,
        data: Data,
        noise: NoiseModel | None,
        held: Data | None = None,
        candidates: tuple[str, ...] | None = None,
        notes: tuple[str, ...] = (),
        known: tuple[KnownEffect, ...] = (),
        **about: Any,
    ) -> Examination:
        """Return the examination of data whose covariance the noise of samples makes; None takes it from their rests.

        Rests know nothing of what is slower. By hand the drift is estimated; else it is the usual one, and not asked.
        """
        start = jax.tree.map(np.asarray, calibration.imu.with_effects())

        def remade(part: Data, model: NoiseModel) -> Experiment:
            return Experiment(part.with_noise(model), start, candidates=candidates, known=known)

        if noise is None:
            plain = Experiment(data, start)
            noise = own_noise(plain) if data.by_hand else usual_noise(plain)
            notes = (*notes, *noise.notes)
            about |= {"drifting": data.by_hand, "trusted": not data.by_hand}
        other = None if held is None else partial(remade, held)
        return cls(calibration, noise, partial(remade, data), other, notes=notes, **about)

    @property
    def naming(self) -> bool:
        """Whether effects are looked for: not while a mistake in the recording stands that imitates them."""
        return not any(finding.spoils for finding in self.findings)

    @cached_property
    def first(self) -> tuple[Experiment, State]:
        """The recording with the noise as it is before it is asked, usual drift in it where it knows none; its fit.

        Raises `NotPossibleError` where too little is left to ask anything.
        """
        experiment, asking = self.remade(self.noise), None
        if self.drifting:  # all is asked once the drift is known, and until then what may pass for it
            asking = _STEADY
            usual = with_usual_drift(self.noise, experiment.shortest(), experiment.extent().duration)
            experiment = self.remade(usual)
        base = experiment.fit(asking=asking)
        _require_freedom(base, self.calibration)
        return experiment, base


def examine(examination: Examination) -> Diagnosis:
    """Ask a recording, of whatever kind, for everything that its calibration lacks, extend the model, measure the gain.

    No effect is named while a mistake in the recording stands that could imitate it. Raises `NotPossibleError` where
    too little is left to ask anything.
    """
    diagnosis = _of_instants_too(examination)
    spoiling = [finding for finding in examination.findings if finding.spoils]
    if diagnosis.verdict != "adequate" and not spoiling:  # what a repair could not find may look like an effect
        spoiling = [finding for finding in examination.findings if finding.partial]
    return _without_effects(diagnosis, spoiling) if spoiling else diagnosis


def _of_instants_too(examination: Examination) -> Diagnosis:
    """Ask once more, as samples of instants, where the recording is better explained so."""
    diagnosis = _examined(examination)
    coarse = any(finding.name == "data.sampling" for finding in diagnosis.preflight)
    if not examination.naming or (
        diagnosis.verdict != "unexplained" and diagnosis.p_value >= examination.level and not coarse
    ):
        return diagnosis
    # the samples themselves may do what looks like effects, or like turns that are too quick
    experiment, state = examination.first
    if experiment.instants(state):
        examination = replace(
            examination,
            remade=_averaged(examination.remade),
            findings=(*examination.findings, _INSTANTS),
            held=None if examination.held is None else _averaged(examination.held),
        )
        return _examined(examination)
    return diagnosis


def _averaged(remade: Callable[[NoiseModel], Experiment]) -> Callable[[NoiseModel], Experiment]:
    return lambda noise: remade(noise).averaged()


def _examined(examination: Examination) -> Diagnosis:
    course = _with_noise_put_right(examination)
    course.extend()
    course.confirm()
    course.doubt()
    course.describe()
    return course.diagnosis()


def _with_noise_put_right(examination: Examination) -> _Course:
    """Ask the noise first, for a wrong model of it makes false effects, and what hands and drift add."""
    noise, level, notes = examination.noise, examination.level, list(examination.notes)
    if examination.drifting:
        experiment, noise, base, first = _with_hands(examination, noise)
        assert experiment.drift is not None
        return _Course(examination, experiment, noise, base, first, [*notes, *experiment.drift.notes], [], [])
    noises, swaying, remade = [], [], examination.remade
    if not examination.trusted:
        experiment = examination.remade(noise)
        noises, right = quick_noise(experiment, noise, level)
        swaying = experiment.data.sway(experiment.start, noise) if noises else []
        if noises:
            examination, noise = replace(examination, noise=right), right
        noises = [] if swaying else noises  # it is the hand's, and not the unit's
    experiment, base = examination.first
    first = select(base.evidence, level)
    if experiment.data.by_hand and not (examination.trusted or first.explained):  # what hands do is in the samples
        experiment, noise, base, first = _with_hands(examination, noise, (base, first))
        notes += experiment.drift.notes if experiment.drift is not None else []
        remade = partial(_moved, examination.remade, experiment.drift)
    if examination.naming and not (examination.trusted or first.explained):
        slow, noise, remark = slow_noise(experiment, base, first, noise, remade, level)
        notes += [remark] if remark else []
        if slow is not None:
            noises.append(slow)
            experiment = remade(noise)
            base = experiment.fit()
            first = select(base.evidence, level)
    return _Course(examination, experiment, noise, base, first, notes, noises, swaying)


@dataclass
class _Course:
    """An examination on its way: `experiment` with the noise put right, `base`, its fit, and what stands out there.

    notes: for the user, so far. noises: what is wrong with the noise. swaying: that hands turn the unit in its poses,
    which looks like noise. chosen: whether effects that another selection has chosen are in the model. The others as in
    `Diagnosis`.
    """

    examination: Examination
    experiment: Experiment
    noise: NoiseModel
    base: State
    first: Selection
    notes: list[str]
    noises: list[NoiseFinding]
    swaying: list[Finding]
    chosen: bool = False
    gain: Gain | None = None
    learned: LearnedTerm | None = None
    drifts: tuple[LearnedTerm, ...] = ()
    strange: Mapping[str, float] = field(default_factory=dict)
    shape: str | None = None

    def __post_init__(self):
        self.extension = Extension([], self.base, self.experiment, self.base, True, [])

    @cached_property
    def other(self) -> Experiment | None:
        """Another recording of the unit, where there is one, with what hands added to it."""
        held, drift, imu = self.examination.held, self.experiment.drift, self.examination.calibration.imu
        other = None if held is None else held(self.noise)
        if held is None or other is None or drift is None:
            return other
        hands = hands_of(other.data, other.linearise(imu).details, other.used, imu, self.noise, drift)
        return _moved(held, hands, self.noise)

    def extend(self) -> None:
        """Take causes into the model; another recording chooses among those that this one cannot tell apart."""
        taken = self.examination.taken
        if self.examination.naming:
            self.extension = extend(self.experiment, self.base, self.first, self.examination.level, taken)
        self.chosen = bool(taken and self.extension.found)
        if self.other is not None and not self.chosen:
            self.extension, remarks = settled(self.extension, self.other)
            self.notes += remarks
        if self.extension.beside:
            beyond = self.extension.beside
            self.notes.append(f"{self._names()} looks like the cause and is not all of it: beyond it {beyond}.")

    def confirm(self) -> None:
        """Measure the gain on what was not fitted; what gains nothing is not kept."""
        experiment, base, state = self.extension.experiment, self.extension.base, self.extension.state
        if not self.extension.found:
            return
        measured = self.examination.measured
        if self.other is not None and any(effect.scope == "device" for effect in state.effects):
            gain = on_held_out(self.other, base, state)
        else:
            gain = (measured or cross_validated)(experiment, base, state)
            if self.other is not None:
                self.notes.append(
                    "the effects found belong to this recording and not to the unit, so the held-out one cannot "
                    "confirm them: their gain was measured on parts of this recording left out."
                )
        self.gain = gain
        full = _saturated(experiment, state)
        # of these nothing but what was left out can confirm anything
        larger = next((kind for kind in full if gain.after.rms[kind.name][0] > gain.before.rms[kind.name][0]), None)
        # where no error is smaller, the likelihood must say it beyond the nat that each number may gain by chance
        least = 0.0 if full or gain.smaller(state.effects) else _GUESSED + sum(effect.size for effect in state.effects)
        if (larger or gain.log_likelihood <= least) and not self.chosen:
            shown = larger.name if larger else gain.best_kind(*state.effects)
            errors = f"{gain.errors(shown)}, log-likelihood {gain.log_likelihood:+.1f}"
            if larger:
                gained = (
                    f"has as many parameters as there are conditions of {larger.words}, and predicts those worse "
                    f"that were not fitted ({gain.data}: {errors})"
                )
            elif gain.log_likelihood > 0:
                gained = f"gains no more than chance may on data that was not fitted ({gain.data}: {errors})"
            elif gain.smaller(state.effects):
                gained = (
                    "makes errors smaller on data that was not fitted, but that data less probable "
                    f"({gain.data}: {errors})"
                )
            else:
                gained = f"does not improve data that was not fitted ({gain.data}: {errors})"
            self.notes.append(f"{self._names()} would explain part of this recording but {gained}, and was not kept.")
            self._settle(found=[], state=base, complete=False)
        elif full := _saturated(experiment, state, beside=True):
            self._settle(complete=False)
            self.notes.append(
                f"with {self._names()} the model has as many parameters as there are conditions of {full[0].words}: it "
                "would fit anything, so nothing confirms it. Record more poses."
            )

    def doubt(self) -> None:
        """Let drift that hardly any sensor has explain nothing; what an effect leaves to second order may be in it."""
        drift = self.experiment.drift
        if drift is not None and not self.extension.found:
            self.strange = drift.implausible
            self._settle(complete=self.extension.complete and not self.strange)
            self.notes += self.strange

    def describe(self) -> None:
        """Say on what depends that which no cause explains: a shape in words, or a smooth term."""
        experiment, base, state = self.extension.experiment, self.extension.base, self.extension.state
        if self.extension.complete:
            return
        level = self.examination.level
        shape = shape_of(base.evidence, level)
        candidate = promising(experiment, state if self.chosen else base)
        imitated = shape if shape and candidate and shape[1] > candidate.gain.log_likelihood else None
        curves, beside = self._followed(candidate)
        if candidate is not None and not self.chosen:
            curves, beside = self._compared(candidate, curves, beside)
        if imitated and curves and not (beside and imitated[0].curved in curves[0].effect.needs):
            curves, beside = (), None
        if beside is not None:
            self._drifts(curves, beside)
        elif curves:
            self.learned = curves[0]
            self._settle(state=curves[0].state)
        elif shape is not None:
            self.shape = shape[0].words

    def _followed(self, candidate: PromisingCurve | None) -> _Curves:
        """Return a curve as it is fitted, or it and all others that drift, as `drifts` does."""
        experiment, level = self.extension.experiment, self.examination.level
        learned = candidate and learn(experiment, candidate, self.other, level)
        if learned is None:
            return (), None
        curves, beside = drifts(experiment, learned, level)
        return curves or (learned,), beside

    def _compared(self, candidate: PromisingCurve, curves: Sequence[LearnedTerm], beside: Extension | None) -> _Curves:
        """Return curves in place of what was named, or others beside it, whichever predict better what is left out.

        Where nothing was named, the others are drift of the recordings, beside which causes may show.
        """
        experiment, state, named = self.extension.experiment, self.extension.state, self.extension.found
        if not named and candidate.effect.scope == "session":
            return curves, beside
        further = promising(experiment, state, of_recording=not named)
        others = self._followed(further)
        before, after = _ended(self.extension.base, curves, beside), _ended(state, *others)
        # drift cannot be predicted beyond the time in which it was seen
        drifting = any(effect.scope == "session" for effect in (*before.effects, *after.effects))
        gained = left_out(experiment, before, after, drifting).log_likelihood
        inputs = {(kind.owner, kind.curved()) for kind in (CATALOGUE[entry.name] for entry in named) if kind.curved()}
        # and not two of the same input
        one_curve = further is not None and (further.effect.owner, further.effect.curved()) in inputs
        # what was named in part was a guess at the same misfit, or the curve is of what it leaves
        if gained > _GUESSED and not one_curve:
            return others
        if curves:
            self._settle(found=[])
        return curves, beside

    def _drifts(self, curves: Sequence[LearnedTerm], beside: Extension) -> None:
        """Take curves over the time of recordings for what they are, drift of biases, and the causes beside them."""
        causes = [Found(curve.effect.name, (), *curve.evidence) for curve in curves]
        together = [*self.extension.found, *causes, *beside.found]
        self._settle(found=together, state=beside.state, complete=beside.complete)
        gain, otherwise = (left_out(beside.experiment, self.extension.base, beside.state, way) for way in (True, False))
        self.drifts, self.gain = tuple(curves), replace(gain, otherwise=otherwise if otherwise.before.count else None)

    def _names(self) -> str:
        return ", ".join(effect_title(entry.name) for entry in self.extension.found)

    def _settle(self, **changes: Any) -> None:
        """Change what was taken into the model; where that is nothing any more, nothing is gained."""
        self.extension = replace(self.extension, **changes)
        self.gain = self.gain if self.extension.found else None

    def diagnosis(self) -> Diagnosis:
        """Return the diagnosis, causes strongest first."""
        examination, extension, noises = self.examination, self.extension, self.noises
        moved = self.experiment.moved_by_hand() or self.swaying
        findings = [*examination.findings, *moved, *extension.findings]
        named = tuple(_named(extension.experiment, extension.state, entry, self.gain) for entry in extension.found)
        notes = [*self.notes, *(cause.impossible() for cause in named if cause.impossible())]
        strongest = min((cause.p_value for cause in named), default=1.0)
        effects = (
            *(noise for noise in noises if noise.p_value < strongest),
            *named,
            *(noise for noise in noises if noise.p_value >= strongest),
        )
        verdict = "unexplained" if not extension.complete else ("effects" if effects else "adequate")
        texts = {finding.text.casefold().rstrip(".") for finding in findings}
        blind = dict(extension.base.blind)
        if examination.drifting or examination.trusted:
            blind |= dict.fromkeys(NOISE_NAMES, _NOT_ASKED)
        if self.swaying:
            blind |= dict.fromkeys(("noise.white", "noise.correlated"), _SWAYING)
        return Diagnosis(
            verdict,
            effects,
            tuple(findings),
            min([self.first.p_value, *(noise.p_value for noise in noises), *self.strange.values()]),
            self.first.scores.unit,
            extension.base.limits,
            dict(sorted(blind.items())),
            checks_of(extension.base, extension.experiment),
            _to_state(named, extension.base.limits) or _suggestion(verdict, named, noises, self.learned, self.shape),
            tuple(note for note in dict.fromkeys(notes) if note.casefold().rstrip(".") not in texts),
            examination.calibration,
            extension.experiment,
            self.noise,
            extension.base,
            extension.state,
            self.gain,
            self.learned,
            self.drifts,
            shape=self.shape,
        )


_Curves = tuple[Sequence[LearnedTerm], Extension | None]
"""Curves of a fit, and what was found beside them where they are drift."""


def _ended(state: State, curves: Sequence[LearnedTerm], beside: Extension | None) -> State:
    """Return the fit with curves and what was found beside them; the one without, where there are none."""
    if beside is not None:
        return beside.state
    return curves[-1].state if curves else state


def _with_hands(
    examination: Examination, noise: NoiseModel, known: tuple[State, Selection] | None = None
) -> tuple[Experiment, NoiseModel, State, Selection]:
    """Return the experiment with what hands add, and where the noise knows no drift with the drift that it shows.

    Its fit and the causes that stand out are returned as well. A ramp and what temperature does must not pass for
    drift; of several recordings a ramp in one of them may, until it stands out, for the others show what drift is
    usual. Nor must effects that stand out, however many, nor slow change of one of several recordings: drift and hands
    are estimated again beside them, until they are the same. `known`: a fit and its causes where the noise knows the
    drift.
    """
    calibration, remade, level = examination.calibration, examination.remade, examination.level
    if known is None:
        base, causes = examination.first[1], []
    else:
        base, first = known
        causes = [base.evidence.blocks[cause.block] for cause in first.causes]
    for count in range(_ROUNDS):
        before = {block.name for block in causes}
        steady = [block for block in base.evidence.blocks if block.name.partition(".")[2] in _STEADY]
        none = np.zeros((len(base.weights), 0))
        columns = np.concatenate([none, *(block.columns for block in (*steady, *causes))], axis=1)
        columns = np.asarray(np.linalg.solve(base.weights, columns), np.float64)
        experiment = remade(noise)
        linear = experiment.linearise(calibration.imu)
        drift = estimate_drift(experiment.data, linear, experiment.used, calibration.imu, noise, columns, known is None)
        experiment = _moved(remade, drift, drifted(noise, drift))
        base = experiment.fit()
        selection = select(base.evidence, level)
        causes = [base.evidence.blocks[k] for k in standing_out(base.evidence, selection, level)]
        causes += slow_change(base.evidence, level) if len(experiment.recordings) > 1 else []
        if {block.name for block in causes} <= before or count == _ROUNDS - 1:
            return experiment, drifted(noise, drift), base, selection
    raise AssertionError


def _moved(remade: Callable[[NoiseModel], Experiment], drift: DriftComponents | None, noise: NoiseModel) -> Experiment:
    """Return the experiment with a noise model, and what drift and hands add."""
    return replace(remade(noise), drift=drift)


def _require_freedom(base: State, calibration: Calibration) -> None:
    if base.evidence.freedom < FEWEST_DIMENSIONS:
        raise NotPossibleError(
            f"{calibration.data.get('file', 'the recording')}: its observations leave {base.evidence.freedom} "
            "dimensions beyond the parameters of bias, scale and misalignment, too few to test anything: record twenty "
            "poses or more."
        )


def _without_effects(diagnosis: Diagnosis, spoiling: Sequence[Finding]) -> Diagnosis:
    """Return the diagnosis of a recording with mistakes that stand: what they imitate is not named."""
    options = list(dict.fromkeys(finding.repair for finding in spoiling if finding.repair and finding.spoils))
    names = ", ".join(dict.fromkeys(effect_title(finding.name) for finding in spoiling))
    if options and all(finding.repair for finding in spoiling):
        suggestion = f"Repair the recording first: run again with {' '.join(options)} ({names})."
    elif options:
        suggestion = f"Run again with {' '.join(options)}, and record again what that cannot repair ({names})."
    else:
        suggestion = f"Correct the recording, or record again: {names} cannot be repaired afterwards."
    return replace(
        diagnosis,
        verdict="unexplained",
        effects=(),
        extended=diagnosis.base,
        gain=None,
        learned=None,
        suggestion=suggestion,
    )


def _candidate(effect: str | type[Effect]) -> str:
    """Return the name of an effect to ask for; a class is registered."""
    name = effect if isinstance(effect, str) else register(effect).name
    if name not in CATALOGUE:
        raise InputError(f"candidates: there is no effect {name!r}; {nearest(name, CATALOGUE)}")
    return name


def recorded_by_hand(calibration: Calibration) -> RecordedByHand:
    """Return the poses and turns that a calibration was fitted to; its effects are taken off: the Earth's rotation."""
    assert calibration.observations is not None
    return RecordedByHand(calibration.segmentations, calibration.observations, calibration.imu)


def same_device(first: Calibration, other: Calibration) -> list[str]:
    """Say where the held-out recording's gains are too far off to be the same unit's."""
    notes = []
    for name, triad in first.triads().items():
        gains = [np.asarray(gain) for gain in (triad.gain, other.triads()[name].gain)]
        jump = float(np.max(np.abs(gains[0] - gains[1])) / np.mean(lengths_of(gains[0])))
        if jump > _OTHER_UNIT:
            notes.append(
                f"the held-out recording's {name} gain differs by {100 * jump:.2g} %: is it the same unit, in the same "
                "units and axes?"
            )
    return notes


def _saturated(experiment: Experiment, state: State, beside: bool = False) -> list[ResidualKind]:
    """Return the kinds of conditions of which the parameters leave none over, `beside` all others, or by themselves."""
    jacobian = np.linalg.solve(state.weights, state.evidence.jacobian)
    jacobian /= np.maximum(column_lengths(jacobian), 1e-300)

    def rank(rows: BoolArray) -> int:
        return int(np.linalg.matrix_rank(jacobian[rows], 1e-6)) if rows.any() else 0

    parts = [(kind, experiment.real.kind == k) for k, kind in enumerate(experiment.real.kinds)]
    known = [rank(part) if not beside else rank(part | ~part) - rank(~part) for _, part in parts]
    return [kind for (kind, part), size in zip(parts, known, strict=True) if part.any() and size == part.sum()]


def _named(experiment: Experiment, state: State, entry: Found, gain: Gain | None) -> Named:
    (effect,) = (fitted for fitted in state.effects if fitted.name == entry.name)
    sigma = root_or_zero(np.diag(state.covariance))
    places = state.places(entry.name)
    inner = {name: float(sigma[index]) for name in effect.inner for index in state.places(entry.name, name)}
    triads, largest = state.imu.triads(), experiment.largest(state, effect)
    owner = effect.owner if effect.owner in triads else "accelerometer"
    if effect.scope == "fixture" and gain is not None and gain.best_kind(effect) != next(iter(gain.before.rms)):
        owner = "gyroscope"
    if not largest[owner]:  # a fixture's that does nothing to that triad
        owner = max(largest, key=lambda triad: largest[triad])
    evidence = (
        f"χ² = {entry.statistic:.1f} with {entry.freedom} degrees of freedom, p {probability(entry.p_value)}: "
        f"{entry.times:.1f} times its detection limit"
    )
    return Named(
        effect,
        entry.rivals,
        entry.p_value,
        entry.weak,
        sigma[places],
        {k: v for k, v in inner.items() if v > 0},
        effect.coefficient_unit(triads[owner].output_unit),
        owner,
        largest[owner],
        evidence,
        gain,
        Path(experiment.recordings[effect.recording - 1].name).name if effect.recording else "",
    )


def stated_instead(name: str) -> list[tuple[type[Effect], str]]:
    """Return what an option states, of an effect and its look-alikes, and the sentence that asks for the option."""
    plain, rivals = name.partition("@")[0], CATALOGUE[name].look_alikes
    stated = [CATALOGUE[other] for other in (plain, *rivals) if CATALOGUE[other].stated_by]
    alike = f" looks like {listed([*map(effect_title, rivals)], 'or')}" if rivals else " can be stated"
    return [
        (
            effect,
            f"{sentence(effect_title(plain))}{alike}. State {effect.stated_by}: {effect.english} is then taken off.",
        )
        for effect in stated
    ]


def _to_state(effects: Sequence[Named], limits: Sizes) -> str:
    """Ask for what an option states and an effect looks like; empty where nothing is or the recording cannot see it."""
    visible = {name.partition("@")[0] for name, (limit, _) in limits.items() if limit < CATALOGUE[name].possible}
    options = (option for effect in effects for option in stated_instead(effect.name))
    return next((text for kind, text in options if kind.name in visible), "")


def _suggestion(
    verdict: str,
    effects: Sequence[Named],
    noises: Sequence[NoiseFinding],
    learned: LearnedTerm | None,
    shape: str | None,
) -> str:
    tied = [effect for effect in effects if effect.rivals]
    if tied:
        kinds = [CATALOGUE[name] for name in (tied[0].name, *tied[0].rivals) if name in CATALOGUE]
        wanted = "; ".join(dict.fromkeys(f"{kind.english}: {kind.excited_by}" for kind in kinds))
        rivals = " or ".join(map(effect_title, tied[0].rivals))
        return f"To distinguish {tied[0].effect.title} from {rivals}, record what excites one alone ({wanted})."
    weak = [effect for effect in effects if effect.weak]
    if weak:
        return (
            f"{sentence(weak[0].effect.title)} is below twice its detection limit: record again with more of what "
            f"excites it ({weak[0].effect.excited_by}), and twice as many poses, before relying on it."
        )
    if any(not CATALOGUE[effect.name].cause for effect in effects):
        return (
            "The drift belongs to this recording, and no calibration takes it off the next one. Let the unit warm up "
            "before the first pose, record its temperature, which may be the cause, or follow the bias in use (`jaximu "
            "filter LOG --online CALIBRATION`)."
        )
    if learned is not None:
        return (
            f"The misfit depends on {learned.covariate}: the extended calibration takes a smooth curve of it off "
            f"({learned.effect.title}), which says how much and not why. Look at the curve in the report, and record "
            f"again with more of it ({learned.effect.excited_by}) to see whether it repeats."
        )
    if shape is not None and "swings" in shape:
        return (
            "Look for what switches or runs in cycles of this length near the unit (a heater, a fan, air conditioning, "
            "its supply), and record again without it."
        )
    if verdict == "unexplained":
        return (
            "Look at the residuals by time, temperature and orientation in the report; record the unit at rest for "
            "half an hour (--static) if you have not, and repeat this recording to see whether the misfit repeats."
        )
    if noises:
        return (
            "The recording at rest and this one do not have the same noise: were they recorded with the same unit, "
            "rate, filter and range, and was the unit as still?"
        )
    return ""
