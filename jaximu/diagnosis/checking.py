"""Whether an old calibration still holds for a new recording: the questions, and what their answers say."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import Any

import equinox as eqx
import numpy as np

from jaximu.calibration import Calibration
from jaximu.calibration.arrangement import axes_unlike
from jaximu.calibration.calibration import provenance, require_another, require_calibration
from jaximu.calibration.filter_history import History
from jaximu.calibration.in_use import INTERVAL, FilterInUse, follow
from jaximu.calibration.recipe import Choices, calibrate_ready, carried_error, require_gravity
from jaximu.calibration.systematic import noise_at_rest
from jaximu.data.by_hand import RecordedByHand
from jaximu.data.motion import LONGEST_MOTION
from jaximu.diagnosis.comparison import (
    Explanation,
    FollowedUnit,
    Fresh,
    Old,
    Question,
    Widened,
    candidates,
    scatter_about_a_fit,
)
from jaximu.diagnosis.evidence import FEWEST_DIMENSIONS
from jaximu.diagnosis.experiment import Experiment
from jaximu.diagnosis.noise import usual_noise
from jaximu.diagnosis.selection import Selection, select
from jaximu.diagnosis.validity import Cause, OutputError, Shift, Validity
from jaximu.estimation.data import Data
from jaximu.estimation.rows import TEMPERATURE
from jaximu.estimation.uncertainty import describe, label
from jaximu.ground.array_types import FloatArray
from jaximu.ground.differences import interpolated
from jaximu.ground.distributions import chi2_sf, holm, normal_sf
from jaximu.ground.errors import InputError, JaximuError, NotPossibleError
from jaximu.ground.gravity import STANDARD, Gravity, LocalGravity, as_gravity
from jaximu.ground.precision import require_float64
from jaximu.ground.quantities import listed, size
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.ground.vectors import lengths_of, sigmas_of, submatrix
from jaximu.mistakes import prepared
from jaximu.model.effects import CATALOGUE
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.noise.at_rest import noise_of
from jaximu.recordings.finding import Finding
from jaximu.recordings.observations import POWER_ON
from jaximu.recordings.recording import Recording, recordings_of
from jaximu.recordings.segmentation import SegmentationOptions, observed_poses, segment

_OTHER_UNIT = 0.05
"""Difference of gains, in scales, that no unit's calibration makes: it is another unit, or its axes or units are."""
_FAR_OFF = (0.05 * STANDARD_GRAVITY, 0.2)
"""Errors (m/s² of gravity's norm, rad over a turn) that no calibration's age makes, in the median."""
_FEWEST_POSES = 3
"""Poses below which motion between them tells more."""
_WARMTH = 1.0  # K
_LARGE, _IMPLAUSIBLE = 4.0, 1e-6
"""Times its expectation that what no parameter explains of squared innovations may be, and the probability that noise
gives more: beyond both it is not the unit, or no rest was one."""
_BY_NOISE = 1.0
"""Information in typical sizes squared, an update, up to which a direction may be told by noise alone: noise gives a
gain's number, whose typical size is a tenth, a hundredth of it."""
_TOLD, _ROUNDING = 1e-9, 1e-9
"""Share of what is known beforehand below which what a recording adds is rounding; and of a variance that is none."""
_SI = {"accelerometer": ("m/s^2", "1 g", STANDARD_GRAVITY), "gyroscope": ("rad/s", "1 rad/s", 1.0)}
"""Of each triad: the unit of its output, and the input at which a gain's shift is told, in words and in SI."""


def check(
    calibration: Calibration,
    recordings: Recording | Data | Sequence[Recording],
    gravity: Gravity = STANDARD,
    *,
    static: Recording | NoiseModel | None = None,
    segmentation: SegmentationOptions | None = None,
    level: float = 0.05,
) -> Validity:
    """Ask whether an old calibration still holds for new recordings of poses and turns.

    The old calibration, its uncertainty included, predicts what the new recording should satisfy. If it fails, single
    parameters, whole triads, effects of the session and effects of the unit that it lacks are tried as explanations,
    with a family-wise level. A fresh calibration, about the old one, tells each parameter's difference. The
    gyroscope's bias is another after every power-on: it is told, but not tested. Where no calibration fits the
    recording to its noise, the noise is widened, kind by kind, to what it scatters about a fresh one.

    **Arguments:** `recordings`, `gravity`, `static`, `segmentation` as for [`jaximu.diagnosis.diagnose`]; gravity
    stated as it was for the old calibration is taken for the same place, whose uncertainty is common to both. Where it
    states a latitude, the Earth's rotation is no finding: it is taken off.
    Recordings may be data that hold them, such as `jaximu.data.RecordedStations`. `level`: rate of false alarms.

    A recording with too few poses is followed by the filter in use (`jaximu.calibration.followed_in_use`) from its
    first rest: its innovations say whether the calibration holds, and which parameters moved, as far as they tell.

    Raises `InputError` where output units differ, one of the two has no gyroscope, or the outputs are so far off that
    it is hardly the same unit; `NotPossibleError` where the unit never rests or never moves, a mistake in the
    recording stands that may be all that differs, or the calibration was fitted to this very recording.
    """
    require_float64()
    require_calibration(calibration)
    gravity, noise = as_gravity(gravity), noise_of(static)
    if isinstance(recordings, Data):
        data, several = recordings, recordings.recordings
        if segmentation is not None or not several:
            raise InputError("a check takes data that hold their recordings, and no segmentation beside them.")
        require_gravity(data, gravity)
    else:
        data, several = None, recordings_of(recordings)
    _same_sensors(calibration, several)
    require_another(calibration, [source.sha256 for recording in several for source in recording.sources])
    if data is not None:
        return _compared(calibration, Old.of(calibration, gravity, data.free), data, noise, level)
    choices = Choices(gravity, noise, segmentation)
    with prepared(several, misfit=partial(carried_error, choices=choices)) as ready:
        validity = _checked(calibration, [one.recording for one in ready], choices, level)
        if validity.verdict != "valid" and any(one.spoiling for one in ready):
            raise NotPossibleError("this recording cannot show whether the calibration is still valid.")
    notes = [note for one in ready for note in one.notes]
    return replace(validity, notes=tuple(dict.fromkeys((*notes, *validity.notes))))


def _checked(
    calibration: Calibration,
    recordings: Sequence[Recording],
    choices: Choices,
    level: float,
) -> Validity:
    """Compare with recordings that were looked over: by their poses, or by a filter where there are too few."""
    gravity, noise = choices.gravity, noise_of(choices.static)
    old = Old.of(calibration, gravity)
    recordings, findings, known = _as_fitted_anew(recordings, choices)
    try:
        parts = tuple(segment(recording, choices.segmentation) for recording in recordings)
        if len(recordings) == 1 and len(parts[0].intervals) < _FEWEST_POSES:
            raise NotPossibleError(
                f"{recordings[0].name} has two poses and no motion between them to check anything by."
            )
    except NotPossibleError as error:
        return _followed(calibration, old, recordings, gravity, noise, level, error)
    data = RecordedByHand(parts, observed_poses(parts, gravity.value), known)
    data = data if noise is None else data.with_noise(noise)
    notes = [finding.text for finding in findings]
    notes += [note for source in (*recordings, *parts) for note in source.notes]
    validity = _compared(calibration, old, data, noise, level, notes)
    spoiling = [finding.text for finding in findings if finding.spoils]
    if validity.verdict != "valid" and spoiling:
        raise NotPossibleError(f"this recording cannot show whether the calibration is still valid. {spoiling[0]}")
    return validity


def _as_fitted_anew(
    recordings: Sequence[Recording], choices: Choices
) -> tuple[Sequence[Recording], Sequence[Finding], Imu | None]:
    """Return what a fresh fit shows: recordings without turns that lost time, what else it finds, and known effects.

    These are the Earth's rotation, where a latitude is stated.
    """
    try:
        fresh, findings = calibrate_ready(recordings, choices)
    except JaximuError:  # too few poses for a calibration, which may do for a check
        return recordings, (), None
    return [part.recording for part in fresh.segmentations], findings, fresh.imu


def _compared(
    calibration: Calibration, old: Old, data: Data, noise: NoiseModel | None, level: float, notes: Sequence[str] = ()
) -> Validity:
    """Compare what the old calibration predicts of data with what was measured."""
    notes, name = list(notes), data.recordings[0].name
    experiment = Experiment(data, old.imu.with_effects())
    if noise is None and data.sampled:
        usual = usual_noise(experiment)
        notes += usual.notes
        experiment = replace(experiment, data=data.with_noise(usual))
    old = old.rested(data.rate_at_rest())
    notes += _temperatures(calibration, old, experiment)
    conditions = experiment.predict(old.imu)[0]
    unlike = axes_unlike(data.recordings[0], old.imu)
    notes += filter(None, [unlike.strip()])
    _same_unit(experiment, conditions, name, unlike)

    scatter = np.ones(len(experiment.real.kinds))
    fresh = Fresh.fit(old, experiment, scatter)
    _same_gains(old, fresh, name, unlike)
    enough = len(conditions) - len(old.names) >= FEWEST_DIMENSIONS and bool(fresh.known(old).all())
    others = candidates(old, experiment) if enough else []
    question, selection = _questioned(old, Widened(experiment, scatter), others, level)
    if not selection.complete:
        scatter = scatter_about_a_fit(old, experiment, fresh)
        question, selection = _questioned(old, Widened(experiment, scatter), others, level)
    known = fresh.known(old)
    causes = tuple(
        cause
        for cause in _causes(question, selection, old)  # of what cannot be compared none is named
        if cause.scope != "parameter" or known[[old.names.index(name) for name in cause.parameters]].any()
    )
    chosen = [question.candidates[cause.block] for cause in selection.causes] if selection.complete else []
    explained = [candidate.columns for candidate in chosen if candidate.scope != "parameter"]
    if explained or scatter.max() > 1:
        fresh = Fresh.fit(old, experiment, scatter, explained, fresh.imu)
    if not fresh.converged and fresh.known(old).all():
        notes.append("the new calibration did not converge: differences from it may be less certain than stated.")
    wide = {kind.name: float(value) for kind, value in zip(experiment.real.kinds, scatter, strict=True)}
    before, after = (experiment.real.rms(errors) for errors in (conditions, fresh.conditions))
    validity = _validity(
        calibration,
        old,
        question,
        selection,
        fresh,
        causes,
        _verdict(selection, causes),
        level,
        experiment=experiment,
        errors={name: (value, after[name][0], unit) for name, (value, unit) in before.items()},
        scatter=wide,
        conditions=(conditions, fresh.conditions),
        data=provenance(data.recordings) | data.counts(),
    )
    notes += _limits_of_comparison(validity, enough)
    comparable = all(shift.comparable for shift in validity.shifts)
    errors = _output_errors(old, fresh, data) if comparable else {}
    return replace(validity, output_errors=errors, notes=tuple(dict.fromkeys(notes)))


def _questioned(old: Old, predicting: Widened, others: list[Explanation], level: float) -> tuple[Question, Selection]:
    question = Question.ask(old, predicting.predict(old.imu), others)
    return question, select(question.evidence, level)


def _limits_of_comparison(validity: Validity, enough: bool) -> Iterator[str]:
    """Say what the recording could not tell, `enough` where its freedom suffices to ask for effects."""
    unknown = [shift.name for shift in validity.shifts if not shift.comparable]
    if unknown:
        yield (
            f"the recording's poses and turns are too few or too alike to determine {len(unknown)} of "
            f"{len(validity.shifts)} parameters, which were not compared: {', '.join(unknown)}."
        )
    if not enough:
        yield (
            "too few poses and turns to ask for effects of the session: record twenty poses or more to separate them "
            "from parameters that moved."
        )
    wide = [f"{name.replace('_', ' ')} {value:.1f}" for name, value in validity.scatter.items() if value > 1]
    if wide:
        yield (
            f"the recording scatters more than its noise about any calibration ({', '.join(wide)} times): the noise "
            "was widened by it. `jaximu diagnose` seeks the reason."
        )


def _validity(
    calibration: Calibration,
    old: Old,
    question: Question,
    selection: Selection,
    fresh: Fresh,
    causes: tuple[Cause, ...],
    verdict: str,
    level: float,
    **about: Any,
) -> Validity:
    """Return the answer to a question; `about`: what else a `Validity` says."""
    shifts = _shifts(old, fresh, 0.0 if verdict == "valid" else level)
    compared = [k for k, shift in enumerate(shifts) if shift.tested]
    difference, spread = fresh.difference[compared], submatrix(fresh.covariance_of_difference, compared)
    square = float(difference @ np.linalg.solve(spread, difference))
    residual = question.evidence.residual
    return Validity(
        verdict,
        selection.p_value,
        float(residual @ residual),
        question.evidence.freedom,
        (square, len(compared), float(chi2_sf(square, len(compared))) if compared else 1.0),
        shifts,
        causes,
        calibration=calibration,
        **about,
    )


def _followed(
    calibration: Calibration,
    old: Old,
    recordings: Sequence[Recording],
    gravity: LocalGravity,
    noise: NoiseModel | None,
    level: float,
    why: NotPossibleError,
) -> Validity:
    """Return the answer of a filter in use, for a recording in which no poses are found because of `why`."""
    if len(recordings) > 1:
        raise why
    (recording,) = recordings
    assert recording.gyroscope is not None
    if noise is None:
        try:
            noise = noise_at_rest(segment(recording, SegmentationOptions(fewest=1)))
        except NotPossibleError:
            raise why from None
    # what is common to both places is no error of the new one, as it is none of the old calibration's numbers
    there = LocalGravity(gravity.value, old.own)
    changing = {"gyroscope": POWER_ON["gyroscope"]}
    follower = FilterInUse(_without_place(calibration, old), noise, recording.gyroscope.rate, there, changing=changing)
    history, diverged = follow(follower, recording)
    if np.sum(~history.rest) < 2:
        raise why
    _upright(old, recording, history, gravity)
    updates = int(np.sum(history.freedom > 0))
    followed, explained = _told(follower, old, updates)
    free = int(history.freedom.sum()) - len(followed.conditions)
    left = max(float(history.innovations.sum()) - explained, 0.0) / max(free, 1)
    scatter = max(1.0, float(np.sqrt(left)))
    question = Question.ask(old, followed.predict(scatter))
    selection = select(question.evidence, level)
    fresh = Fresh.of_linear(old, followed, scatter)
    strange = left > _LARGE and chi2_sf(left * free, free) < _IMPLAUSIBLE
    causes = () if strange else _causes(question, selection, old)
    verdict = "unexplained" if strange else _verdict(selection, causes)
    validity = _validity(
        calibration,
        old,
        question,
        selection,
        fresh,
        causes,
        verdict,
        level,
        history=history,
        scatter={"innovations": scatter},
        conditions=(followed.conditions, fresh.conditions),
        data=provenance([recording]) | {"updates": updates},
        alone={cause.name: _alone(question, cause) for cause in causes if len(cause.parameters) == 1},
    )
    notes = recording.notes, noise.notes, _remarks(validity, updates, scatter, diverged, len(old.tested))
    return replace(validity, notes=tuple(dict.fromkeys(chain.from_iterable(notes))))


def _remarks(validity: Validity, updates: int, scatter: float, diverged: str | None, tested: int) -> Iterator[str]:
    """What is to be said of an answer that a filter gave; `tested`: how many numbers of the calibration are."""
    yield (
        "the recording has too few poses, so a filter followed the calibrated unit through it, which measures in rests "
        f"and where motion ends: {updates} updates."
    )
    assert validity.history is not None
    longest = float(np.diff(validity.history.time[validity.history.rest]).max(initial=0.0))
    if longest > LONGEST_MOTION:
        yield (
            f"{longest:.0f} s of motion without a rest show nothing of the gyroscope's scales: attitude cannot be "
            "carried so far."
        )
    if unknown := [shift.words for shift in validity.shifts if not shift.comparable]:
        names = ", ".join(unknown)
        yield f"not determined without poses, each by itself: {names}. Record twenty poses to compare them."
    if diverged is not None and validity.verdict != "valid":
        yield diverged
    if validity.verdict == "shifted" and any(len(cause.parameters) == tested for cause in validity.causes):
        yield "so much differs that the calibration may be another unit's."
    if scatter > 1:
        yield f"innovations scatter {scatter:.2g} times their noise: the noise was widened by it."


def _without_place(calibration: Calibration, old: Old) -> Calibration:
    """Return the calibration with the covariance that has no share of the gravity that both places have in common."""
    known = [k for k, name in enumerate(calibration.names) if name.effect is None and name in old.names]
    places = [old.names.index(calibration.names[k]) for k in known]
    covariance = np.array(calibration.covariance)
    covariance[np.ix_(known, known)] = submatrix(old.covariance, places)
    covariance += _ROUNDING * np.diag(np.diagonal(covariance))  # it stays positive definite without gravity's share
    return replace(calibration, covariance=covariance)


def _told(follower: FilterInUse, old: Old, updates: int) -> tuple[FollowedUnit, float]:
    """Return what a recording says of the old calibration's numbers, and how much of the innovations they explain.

    What a gain is multiplied by is measured, with noise that is the residual's, too. Where nothing but that noise
    varies, the data seem to say something, and it is the noise itself: such directions are left out.
    """
    states, names = follower.errors.states, follower.names
    root = follower.root[states:, states:]
    information, prior = root.T @ root, follower.prior.T @ follower.prior
    # the change is from what was known beforehand, which pulls by nothing there
    pull = information @ follower.change
    kept = [k for k, name in enumerate(names) if name.effect is None and name in old.names]
    beside = [k for k in range(len(pull)) if k not in kept]
    alone = submatrix(information, kept) - submatrix(prior, kept)
    across = information[np.ix_(kept, beside)]
    away = np.linalg.solve(submatrix(information, beside), np.column_stack([across.T, pull[beside]]))
    alone, pull = alone - across @ away[:, :-1], pull[kept] - across @ away[:, -1]
    places = [old.names.index(names[k]) for k in kept]
    size = old.sizes[places]
    values, vectors = np.linalg.eigh(alone * size[:, None] * size)
    determined = values > max(_TOLD * np.max(np.diagonal(prior)[kept] * size**2), updates * _BY_NOISE)
    lengths = np.sqrt(values[determined])
    columns = np.zeros((len(lengths), len(old.names)))
    columns[:, places] = lengths[:, None] * vectors[:, determined].T / size
    conditions = -(vectors[:, determined].T @ (pull * size)) / lengths
    spread = np.eye(len(lengths)) + columns @ _beforehand(follower, old, kept, places) @ columns.T
    return FollowedUnit(conditions, columns), float(conditions @ np.linalg.solve(spread, conditions))


def _beforehand(follower: FilterInUse, old: Old, kept: list[int], places: list[int]) -> FloatArray:
    """Return the covariance (p, p) of the old numbers as the filter began with it."""
    covariance = np.zeros((len(old.names), len(old.names)))
    inverse = np.linalg.inv(follower.prior)
    covariance[np.ix_(places, places)] = submatrix(inverse @ inverse.T, kept)
    return covariance


def _alone(question: Question, cause: Cause) -> tuple[float, float]:
    """Return how far the single parameter of a cause moved if it alone did, and the sigma of that."""
    (index,) = (k for k, candidate in enumerate(question.candidates) if candidate.block.name == cause.name)
    size, evidence = float(question.evidence.blocks[index].sizes[0]), question.evidence
    sigma = 1 / np.sqrt(float(evidence.information(index)[0, 0]))
    return size * float(evidence.coefficients([index])[0]), float(size * sigma)


def _upright(old: Old, recording: Recording, history: History, gravity: LocalGravity) -> None:
    """Raise `InputError` where gravity is far off in rests, which no calibration's age makes."""
    signal = recording.accelerometer
    force = np.asarray(old.imu.with_effects().accelerometer.recover(signal.values))
    size = lengths_of(interpolated(signal.time, force, history.time[history.rest] - INTERVAL / 2))
    off = float(np.median(np.abs(size - gravity.value)))
    if off > _FAR_OFF[0]:
        raise InputError(
            f"{recording.name}: with this calibration gravity is off by {1e3 * off:.0f} mm/s² in the median of the "
            "rests: is it the same unit, in the same units and axes?"
        )


def _same_sensors(calibration: Calibration, recordings: Sequence[Recording]) -> None:
    if not recordings:
        raise InputError("no recording was given.")
    for recording in recordings:
        for name in ("accelerometer", "gyroscope"):
            triad = calibration.triad_of(name, recording)
            if triad is None:
                raise InputError(
                    "the calibration has no gyroscope, and a check needs one: turns tell most causes apart. Calibrate "
                    "both sensors first."
                )
            if getattr(recording, name) is None:
                raise InputError(
                    f"{recording.name} has no gyroscope, but the calibration has one: add its log (--gyro-log)."
                )
    if calibration.from_data_sheet:
        raise NotPossibleError(
            f"the calibration has the {listed(calibration.from_data_sheet)} of a data sheet, so there is nothing to "
            "check: calibrate from poses and turns first. `jaximu thermal LOG --calibration CALIBRATION` adds a "
            "thermal part to such a calibration."
        )


def _same_unit(experiment: Experiment, conditions: FloatArray, name: str, unlike: str) -> None:
    real = experiment.real
    for index, (kind, limit) in enumerate(zip(real.kinds, _FAR_OFF, strict=False)):
        vectors = (conditions * real.to_si)[real.kind == index].reshape(-1, kind.components)
        if len(vectors) and (median := float(np.median(lengths_of(vectors)))) > limit:
            raise InputError(
                f"{name}: with this calibration the {kind.name.replace('_', ' ')} is off by "
                f"{size(kind.factor * median, kind.unit)} in the median: is it the same unit, in the same units and "
                f"axes?{unlike}"
            )


def _same_gains(old: Old, fresh: Fresh, name: str, unlike: str) -> None:
    for index, parameter in enumerate(old.names):
        if parameter.part != "gain":
            continue
        scale, shift = old.scales[index], abs(fresh.difference[index])
        if shift > _OTHER_UNIT * scale and shift > 5 * np.sqrt(fresh.covariance_of_difference[index, index]):
            raise InputError(
                f"{name}: the {parameter.owner}'s gain differs from the calibration's by {100 * shift / scale:.2g} % "
                f"({parameter}): is it the same unit, in the same units and axes?{unlike}"
            )


def _temperatures(calibration: Calibration, old: Old, experiment: Experiment) -> list[str]:
    """Say where temperatures differ and the calibration has nothing that depends on them."""
    before, warmth = calibration.data.get("temperature"), experiment.real.covariates.get(TEMPERATURE)
    if before is None or any("temperature" in " ".join(effect.needs) for effect in old.imu.all_effects().values()):
        return []
    if warmth is None or any(recording.temperature is None for recording in experiment.recordings):
        return []
    after = float(np.mean(warmth[experiment.real.kind == 0]))
    if abs(after - before) < _WARMTH:
        return []
    return [
        f"the calibration was made at {before:.1f} °C and this recording at {after:.1f} °C in the mean, and nothing in "
        "the calibration depends on temperature: what moved may be that."
    ]


def _causes(question: Question, selection: Selection, old: Old) -> tuple[Cause, ...]:
    """What was selected, in words; of nested groups of parameters none is the other's rival."""
    if not selection.complete or not selection.causes:
        return ()
    taken = [question.candidates[cause.block] for cause in selection.causes]
    numbers = question.evidence.coefficients([cause.block for cause in selection.causes])
    parts = np.split(numbers, np.cumsum([len(candidate.block.sizes) for candidate in taken])[:-1])
    causes = []
    for cause, candidate, part in zip(selection.causes, taken, parts, strict=True):
        block, others = candidate.block, [question.candidates[k] for k in cause.rivals]
        rivals = {k.block.name for k in others if not candidate.scope == k.scope == "parameter"} - {block.name}
        unit = old.units[candidate.places[0]] if len(candidate.places) == 1 else ""
        if block.name in CATALOGUE:
            kind = CATALOGUE[block.name]
            unit = kind.coefficient_unit(old.imu.triads().get(kind.owner, old.imu.accelerometer).output_unit)
        causes.append(
            Cause(
                block.name,
                candidate.scope,
                tuple(old.names[k] for k in candidate.places),
                tuple(sorted(rivals)),
                cause.p_value,
                part * block.sizes,
                dict(block.inner),
                unit,
            )
        )
    return tuple(causes)


def _verdict(selection: Selection, causes: Sequence[Cause]) -> str:
    if not selection.complete:
        return "unexplained"
    if not selection.causes:
        return "valid"
    if not causes:
        return "shifted"
    lacking = [CATALOGUE[cause.name].owner for cause in causes if cause.scope == "device"]
    # what a triad lacks was in part taken for its gain and bias: that they are others now is no fault of theirs
    moved = any(name.effect is not None or name.owner not in lacking for cause in causes for name in cause.parameters)
    return "shifted" if moved else ("effect" if lacking else "session")


def _shifts(old: Old, fresh: Fresh, level: float) -> tuple[Shift, ...]:
    """Every parameter's difference; at level zero none counts as moved: the recording says nothing against them."""
    difference, sigma = fresh.difference, sigmas_of(fresh.covariance_of_difference)
    comparable = fresh.known(old)
    raw = 2 * normal_sf(np.abs(difference) / sigma)
    tested = [k for k in range(len(raw)) if comparable[k] and k not in old.allowed]
    p_value = np.ones(len(raw))
    p_value[tested] = holm(raw[tested])
    shifts = []
    for k, name in enumerate(old.names):
        gain = name.part == "gain"
        unit, at, size = _SI[name.owner]
        factor = float((size if gain else 1.0) / old.scales[k]) if name.effect is None else None
        shifts.append(
            Shift(
                label(name, old.imu),
                describe(name, old.imu),
                name,
                float(old.values[k]),
                float(difference[k]),
                float(sigma[k]),
                old.units[k],
                None if factor is None else factor * float(difference[k]),
                None if factor is None else factor * float(sigma[k]),
                "" if factor is None else unit,
                at if gain else "",
                float(p_value[k]),
                bool(p_value[k] < level),
                bool(comparable[k]),
                k in old.allowed,
            )
        )
    return tuple(shifts)


def _output_errors(old: Old, fresh: Fresh, data: Data) -> dict[str, OutputError]:
    """The largest difference of the outputs in the recording, gyroscope bias apart, and of the turns' rotations."""
    errors = {}

    def error(value: float, slope: FloatArray, places: list[int], unit: str) -> OutputError:
        spread = slope @ submatrix(fresh.covariance_of_difference, places) @ slope.T
        return OutputError(value, float(np.sqrt(np.trace(spread))), unit)

    for name, unit in (("accelerometer", "m/s^2"), ("gyroscope", "rad/s")):
        before, after = old.imu.triads()[name], fresh.imu.triads()[name]
        inverse, places = np.linalg.inv(before.gain), old.places(name, "gain", "bias")
        values = np.concatenate([recording.signals[name].values for recording in data.recordings])
        true = (values - after.bias) @ np.linalg.inv(after.gain).T
        output = (values - (after if name == "gyroscope" else before).bias) @ inverse.T
        size = lengths_of(output - true)
        worst = int(np.argmax(size))
        axes = [old.names[k].axes for k in places]  # (output, input) of a gain, (output,) of a bias
        columns = [inverse[:, entry[0]] * np.prod([true[worst, k] for k in entry[1:]]) for entry in axes]
        errors[name] = error(float(size[worst]), np.stack(columns, axis=1), places, unit)
    before, after = old.imu.triads()["gyroscope"], fresh.imu.triads()["gyroscope"]
    by = data.rotations(eqx.tree_at(lambda imu: imu.gyroscope.bias, old.imu.with_effects(), after.bias))
    if len(by):
        # how each turn's rotation vector reacts to A = K⁻¹, the bias held: c = −A b
        by = np.degrees(by[..., :3] - by[..., 3:] * np.asarray(after.bias))
        inverse = np.linalg.inv(before.gain)
        vectors = np.einsum("tijk,jk->ti", by, np.linalg.inv(after.gain) - inverse)
        worst = int(np.argmax(lengths_of(vectors)))
        slope = -np.einsum("ijk,ja,bk->iab", by[worst], inverse, inverse).reshape(3, 9)
        errors["turns"] = error(float(np.linalg.norm(vectors[worst])), slope, old.places("gyroscope", "gain"), "deg")
    return errors
