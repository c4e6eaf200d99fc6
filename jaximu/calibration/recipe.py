"""Calibration from recordings of poses and turns by hand, the one recipe behind [`jaximu.calibrate`][]."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from jaximu.calibration.arrangement import arrangement
from jaximu.calibration.bias_drift import knowing_drift
from jaximu.calibration.calibration import Calibration, clock_sigma, concluded, effect_named, notes_of, provenance
from jaximu.calibration.hand_held import (
    MISALIGNMENTS_HELD,
    Method,
    fit_hand_held,
    with_open_misalignments_held,
)
from jaximu.calibration.lost_time import lost_share, tells_losses, without_lost_stretches
from jaximu.calibration.nominal import nominal_imu
from jaximu.calibration.refusals import require_carried, require_determined
from jaximu.calibration.saturation import saturation
from jaximu.data.by_hand import RecordedByHand
from jaximu.data.drift import means_by_hand
from jaximu.data.poses import EXCESS_NAMES, condensed, residual_rms, with_gyroscope
from jaximu.estimation.data import Data
from jaximu.estimation.fitting import Prior, fit, linearise
from jaximu.estimation.problem import Loss
from jaximu.estimation.rows import Sizes
from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import STANDARD, Gravity, LocalGravity, as_gravity
from jaximu.ground.precision import require_float64
from jaximu.ground.quantities import counted
from jaximu.ground.tracing import first, lifted, on_host
from jaximu.mistakes import Prepared, one_or_several, prepared
from jaximu.model.effects.base import Effect
from jaximu.model.effects.earth_rotation import GyroEarthRotation
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.noise.at_rest import noise_of, unlike_rests
from jaximu.recordings.finding import Finding
from jaximu.recordings.observations import Observations
from jaximu.recordings.recording import Recording, same_outputs
from jaximu.recordings.segmentation import Segmentation, SegmentationOptions, find_stops, observed_poses, segment

_SAME = 1e-9
"""Share by which two statements of one gravity may differ."""
_ROUNDS = 4
"""Times that turns which lost time are looked for."""
_RECORD = "Rest in six orientations or more, each axis up and down, and turn about each axis between rests."
_NO_DRIFT = "The intervals of the biases leave out slow drift"


@dataclass(frozen=True)
class Choices:
    """How recordings made by hand are calibrated; the fields are the options of [`jaximu.calibrate`][]."""

    gravity: LocalGravity = STANDARD
    static: Recording | NoiseModel | None = None
    segmentation: SegmentationOptions | None = None
    effects: Sequence[str | Effect] = ()
    effect_sigmas: Mapping[str, float] | None = None
    method: Method = "joint"
    loss: Loss = "linear"


def calibrate(
    recordings: Recording | Prepared | Data | Sequence[Recording | Prepared | Data],
    gravity: Gravity = STANDARD,
    *,
    start: Imu | None = None,
    static: Recording | NoiseModel | None = None,
    segmentation: SegmentationOptions | None = None,
    effects: Sequence[str | Effect] = (),
    effect_sigmas: Mapping[str, float] | None = None,
    method: Method = "joint",
    loss: Loss = "linear",
    repair: bool = False,
) -> Calibration:
    """Calibrate a unit from recordings of static poses and the turns between them, without equipment.

    **Arguments:**

    - `recordings`: one or several recordings of the same unit, in the same units and axes. Data of other kinds may
      stand beside them, `jaximu.data.RecordedStations` of a table or `jaximu.data.AgainstAttitude` of optics:
      one fit then knows what each of them tells. Biases are one unit's in all of them, no new power-on between, and
      their intervals leave out slow drift without `static`.
    - `start`: with such data, the unit where the fit starts, and the effects of their set-ups; the data sheet's values
      if left out.
    - `gravity`: local gravity; its uncertainty goes into the scales'. Where it states a latitude, the Earth's rotation
      is in the model, the heading of each recording free where every turn between its poses is usable, else its
      vertical part alone; not with other data.
    - `static`: a recording of the same unit at rest, or the `NoiseModel` fitted to one: white noise and slow
      bias, which ties poses and turns together. Otherwise noise is estimated from the scatter within poses and assumed
      white; drift only widens the uncertainty.
    - `segmentation`: what counts as a pose.
    - `effects`: effects of the catalogue to fit with gain and bias, by name or with a start; jointly only.
    - `effect_sigmas`: standard deviations, by effect, to which its coefficients are known beforehand about their start.
    - `method`: `"joint"`, `"two-step"`, `"two-step-rk4"` or `"accelerometer"`, see
      [`jaximu.calibration.fit_hand_held`]; a recording without gyroscope always uses the last.
    - `loss`: `"linear"`, `"huber"` or `"cauchy"`.
    - `repair`: change what [`jaximu.mistakes.prepare`][] can put right; rows that are no measurement are left out
      in any case. The notes say what was found.

    Raises `InputError` where a sensor holds nothing to calibrate, and `NotPossibleError` where poses are missing or do
    not span, the fit does not converge, or the recording does not determine an effect of which nothing is known
    beforehand; the message says what to record.
    """
    gravity = as_gravity(gravity)
    by_hand, data = [], []
    for one in one_or_several(recordings, Data):
        (data if isinstance(one, Data) else by_hand).append(one)
    choices = Choices(gravity, static, segmentation, effects, effect_sigmas, method, loss)
    if data:
        return _calibrated_jointly(by_hand, data, choices, start, repair)
    if start is not None:
        raise InputError("a start is for data of several kinds: recordings by hand begin at the data sheet's values.")
    turned = method != "accelerometer"
    misfit = partial(carried_error, choices=choices) if turned else None
    with prepared(by_hand, repair, gyroscope=turned, misfit=misfit) as ready:
        calibration, unusual = calibrate_ready([one.recording for one in ready], choices, repair)
    notes = [*notes_of(*ready), *(item.text for item in unusual)]
    calibration = replace(calibration, notes=tuple(dict.fromkeys((*notes, *calibration.notes))))
    return _with_drift(calibration, noise_of(static))


def _calibrated_jointly(
    recordings: Sequence[Recording | Prepared], data: Sequence[Data], choices: Choices, start: Imu | None, repair: bool
) -> Calibration:
    """Return the calibration of one fit to several kinds of data, recordings by hand among them."""
    require_float64()
    if choices.method != "joint":
        raise InputError(f"data of several kinds are fitted jointly: leave the method {choices.method!r} out.")
    for one in data:
        if not hasattr(one, "gravity"):
            raise InputError(f"{type(one).__name__} cannot be fitted with other data: use jaximu.fit.")
        if np.shape(one.gravity):
            raise InputError("data of several units make no calibration of one: take one unit's, or use jaximu.fit.")
        require_gravity(one, choices.gravity)
    kinds, noise, parts = list(data), noise_of(choices.static), ()
    with prepared(recordings, repair) as ready:
        if ready:
            if any("gyroscope" not in one.recording.signals for one in ready):
                raise InputError("a recording without gyroscope cannot stand beside data of other kinds.")
            parts = tuple(segment(one.recording, choices.segmentation) for one in ready)
            kinds = [RecordedByHand(parts, observed_poses(parts, choices.gravity.value, noise=noise)), *kinds]
    recorded = [recording for kind in kinds for recording in kind.recordings]
    mixed = same_outputs(recorded) if recorded else ()
    notes = [*notes_of(*ready), *mixed, *notes_of(*recorded, *parts, noise)]
    if noise is None and recorded:
        notes.append(f"{_NO_DRIFT}, unless data were observed with a noise model.")
    unit = start or (nominal_imu(recorded[0]) if recorded else Imu.nominal())
    if "magnetometer" in unit.triads():
        raise InputError("the start has a magnetometer, which these data do not determine: start without it.")
    if unit.setup and sum(not one.no_fixture for one in data) > 1:
        raise InputError("the start has effects of one set-up, and two of the data have separate ones: fit them apart.")
    effects = {effect.name: effect for effect in (*map(effect_named, choices.effects), *unit.all_effects().values())}
    unit = on_host(unit.with_effects(*effects.values()))
    prior = Prior.of_effects(unit, choices.effect_sigmas)
    fitted = fit(unit, kinds, prior=prior, loss=choices.loss)
    where = ", ".join(recording.name for recording in recorded) or "these data"
    require_determined(fitted, where, "these data together", _RECORD, prior)
    calibration = concluded(
        fitted,
        gravity=choices.gravity,
        method="joint",
        loss=choices.loss,
        excess_names=_distinct([name for kind in kinds for name in kind.excess_names]),
        rms=[errors_of(kinds, imu) for imu in (unit, fitted.imu)],
        notes=notes,
        advice=kinds[0].advice,
        prior=prior,
        data=provenance(recorded) if recorded else {},
        nominal=unit,
        reading=recorded[0].reading if recorded else None,
    )
    return replace(calibration, covariance=fitted.total_covariance(choices.gravity.sigma, clock_sigma(parts)))


def require_gravity(data: Data, gravity: LocalGravity) -> None:
    """Raise `InputError` where data of one unit were observed at another gravity."""
    known, stated = float(data.gravity), gravity.value
    if abs(known / stated - 1) > _SAME:
        raise InputError(
            f"some data were observed at a gravity of {known:.6g} m/s² and {stated:.6g} m/s² was given: state the "
            "same, gravity=…, for all."
        )


def errors_of(kinds: Sequence[Data], imu: Imu) -> Sizes:
    """Return the rms of each kind of residual of all data, with its unit."""
    sizes: list[tuple[str, tuple[float, str]]] = []
    for kind in kinds:
        linear = linearise(imu, kind, kind.free)
        sizes += kind.rms(imu.with_effects(), linear.details, linear.conditions).items()
    return dict(zip(_distinct([name for name, _ in sizes]), (size for _, size in sizes), strict=True))


def _distinct(names: Sequence[str]) -> list[str]:
    """Return names with a number after those that were there before."""
    before = [names[:number].count(name) for number, name in enumerate(names)]
    return [f"{name} {count + 1}" if count else name for name, count in zip(names, before, strict=True)]


def _with_drift(calibration: Calibration, noise: NoiseModel | None) -> Calibration:
    """Return a calibration by hand whose uncertainty knows how biases drift: as `noise` says, or as its poses show."""
    if calibration.loss != "linear" or calibration.method.startswith("two-step"):
        advice = f"{_NO_DRIFT}: use the joint method with the linear loss, or add --static LOG."
        return calibration if noise else replace(calibration, notes=(*calibration.notes, advice))
    fitted, observations, parts = calibration.fit, calibration.observations, calibration.segmentations
    assert fitted is not None and observations is not None
    rows = "all" if "gyroscope" in fitted.imu.triads() else "norm"
    about = condensed(*lifted((with_gyroscope(fitted.imu).with_effects(), observations)), rows)
    assert about.reaction is not None
    means = means_by_hand(observations, parts, about.reaction)
    return knowing_drift(calibration, first(about.covariance), means, noise, clock_sigma(parts))


def calibrate_ready(
    recordings: Sequence[Recording], choices: Choices, repair: bool = False, losses: bool = True
) -> tuple[Calibration, list[Finding]]:
    """Calibrate recordings that [`jaximu.mistakes.prepare`][] has been over, as [`jaximu.calibrate`] does.

    **Returns:** the calibration, without turns that lost time, and what it says of lost time, axes, mounting and
    ranges; with `repair` axes are mapped. `losses`: whether lost time is looked for; turns that miss for another
    reason would be taken for it.
    """
    try:
        calibration, findings = _calibrated_in_axes(recordings, choices, repair, losses)
    except NotPossibleError as error:
        raise NotPossibleError(f"{error}{''.join(map(_of_a_vehicle, recordings))}") from None
    if "gravity_direction" in calibration.rms and calibration.gains_determined():
        require_carried(calibration.rms["gravity_direction"][1], ", ".join(one.name for one in recordings))
    return calibration, findings


def carried_error(recording: Recording, choices: Choices) -> float:
    """Return by how much (°, rms) gravity misses the next pose, carried over the turns of a calibrated recording."""
    return _calibrated([recording], choices).rms["gravity_direction"][1]


def _of_a_vehicle(recording: Recording) -> str:
    """Name the verb for a vehicle that stops; nothing for other recordings."""
    with suppress(NotPossibleError):
        if "gyroscope" in recording.signals and (stops := find_stops(recording)):
            return (
                f" It looks like a vehicle, on the ground or in the air, with {counted(len(stops.intervals), 'stop')}: "
                "`jaximu filter LOG` determines the gyroscope's bias and the mounting from them."
            )
    return ""


def _calibrated_in_axes(
    recordings: Sequence[Recording], choices: Choices, repair: bool, losses: bool
) -> tuple[Calibration, list[Finding]]:
    calibration = _calibrated(recordings, choices)
    findings = arrangement(recordings[0], calibration)
    wrong = [finding for finding in findings if finding.apply is not None]
    if wrong and not repair:  # turns about wrong axes tell nothing of what was lost in them
        return calibration, findings
    for finding in wrong:
        assert finding.apply is not None
        recordings = [finding.apply(recording) for recording in recordings]
    if wrong:
        findings = [
            replace(finding, text=f"{finding.text} This was repaired.") if finding in wrong else finding
            for finding in findings
        ]
        calibration = _calibrated(recordings, choices)
    if not losses:
        return calibration, findings
    calibration, lost = _without_losses(calibration, choices)
    return calibration, [*lost, *findings]


def _without_losses(calibration: Calibration, choices: Choices) -> tuple[Calibration, list[Finding]]:
    """Calibrate again without the turns that lost time, as the fit shows them, and tell it."""
    if calibration.loss != "linear" or calibration.method != "joint" or not tells_losses(calibration):
        return calibration, []
    findings: list[Finding] = []
    for _ in range(_ROUNDS):  # a gross one moves the fit, and hides others
        kept, more = without_lost_stretches(calibration)
        if not more:
            break
        findings += more
        calibration = _calibrated(kept, choices)
    return calibration, [*findings, *(saturation(calibration) or lost_share(calibration))]


def _calibrated(recordings: Sequence[Recording], choices: Choices) -> Calibration:
    gravity, loss, static = choices.gravity, choices.loss, choices.static
    require_float64()
    mixed = same_outputs(recordings)
    method = choices.method if all(one.gyroscope is not None for one in recordings) else "accelerometer"
    chosen = _effects_by_hand(choices, method)
    segmentations = tuple(segment(recording, choices.segmentation) for recording in recordings)
    if static is not None and method.startswith("two-step"):
        raise InputError(
            "the two-step method cannot use the bias drift that a recording at rest shows (--static): use the joint "
            "method, or leave the recording out."
        )
    noise = noise_of(static)
    observations = observed_poses(segmentations, gravity.value, noise=noise)
    nominal = nominal_imu(recordings[0], observations)
    fitted = fit_hand_held(nominal, observations, method, loss)
    where = ", ".join(recording.name for recording in recordings)
    poses, turns = (int(part.mask.sum()) for part in (observations.poses, observations.turns))
    require_determined(fitted, where, poses=poses)
    fitted, held = with_open_misalignments_held(fitted, nominal, observations, method, loss)
    require_determined(fitted, where, prior=held)
    keep_gyroscope = method != "accelerometer"
    before = residual_rms(nominal, observations, keep_gyroscope)
    sigmas, prior = dict(choices.effect_sigmas or {}), held
    known = {effect.name for effect in chosen}
    if method == "joint" and gravity.latitude is not None and GyroEarthRotation.name not in known:
        earth = _earth_rotations(gravity.latitude, _headings_carried(segmentations, observations))
        chosen += [effect for effect, _ in earth]
        sigmas |= {effect.name: spread for effect, spread in earth}
    if chosen:
        measurement = RecordedByHand(segmentations, observations)
        start = on_host(fitted.imu).with_effects(*chosen)
        prior = Prior.joined(held, Prior.of_effects(start, sigmas))
        fitted = fit(start, measurement, prior=prior, loss=loss, excess=fitted.excess)
        require_determined(fitted, where, prior=prior)
        observations = measurement.along(fitted.imu, tuple(fitted.imu.all_effects().values())).observations
    unlike = () if noise is None else unlike_rests(noise, segmentations)
    notes = *unlike, *notes_of(*recordings), *mixed, *notes_of(noise, *segmentations)
    if held is not None:
        notes += (MISALIGNMENTS_HELD.format(poses),)
    if keep_gyroscope and not turns:
        notes += ("no turn between two poses could be used: the gyroscope's gain stays at the data sheet's.",)
    return concluded(
        fitted if keep_gyroscope else replace(fitted, imu=Imu(fitted.imu.accelerometer, None)),
        gravity=gravity,
        method=method,
        loss=loss,
        excess_names=EXCESS_NAMES if keep_gyroscope else EXCESS_NAMES[:1],
        rms=[before, residual_rms(fitted.imu.with_effects(), observations, keep_gyroscope)],
        prior=prior,
        data=provenance(recordings) | {"poses": poses, "turns": turns} | _mean_temperature(recordings, observations),
        notes=notes,
        observations=observations,
        segmentations=segmentations,
        nominal=nominal,
        reading=recordings[0].reading,
    )


def _effects_by_hand(choices: Choices, method: str) -> list[Effect]:
    """Return the effects that are to be fitted; refuse those that a recording by hand, or the method, cannot tell."""
    chosen = list(map(effect_named, choices.effects))
    if chosen and method != "joint":
        raise InputError(
            f"{chosen[0].name} is fitted jointly with gain and bias of both sensors, which needs the joint method and "
            "a gyroscope."
        )
    if of_set_up := [effect.name for effect in chosen if effect.scope == "fixture"]:
        raise NotPossibleError(
            f"{of_set_up[0]} is an error of a set-up, and a recording by hand has none: see `jaximu turntable`."
        )
    return chosen


def _headings_carried(segmentations: Sequence[Segmentation], observations: Observations) -> list[bool]:
    """Return of each recording whether the gyroscope carries the heading through the whole of it.

    Between two rests that touch the unit did not turn.
    """
    usable, carried = np.asarray(observations.turns.mask), []
    for part in segmentations:
        touching = part.intervals[1:, 0] <= part.intervals[:-1, 1]
        carried.append(bool((usable[: len(touching)] | touching).all()))
        usable = usable[len(part.intervals) :]
    return carried


def _earth_rotations(latitude: float, carried: Sequence[bool]) -> list[tuple[Effect, FloatArray]]:
    """Return the Earth's rotation in each recording, whose heading is its own, and its standard deviations (3,).

    Where turns do not carry the heading only the vertical part is taken, which needs none.
    """
    earth = []
    for number, whole in enumerate(carried, 1):
        effect, spread = GyroEarthRotation.within(number if len(carried) > 1 else 0).at(latitude)
        earth.append((effect, spread if whole else np.full(3, spread[2])))
    return earth


def _mean_temperature(recordings: Sequence[Recording], observations: Observations) -> dict[str, float]:
    """The mean over the poses, °C, where every recording tells it."""
    if any(recording.temperature is None for recording in recordings):
        return {}
    poses = observations.poses
    return {"temperature": float(np.asarray(poses.temperature)[np.asarray(poses.mask)].mean())}
