"""System-level calibration: a filter over a whole recording of rests and motion, iterated to convergence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from jaximu.calibration.attitude import Mounted, mounted_on, reference_summary
from jaximu.calibration.calibration import Calibration, concluded, effect_named, notes_of
from jaximu.calibration.compensation import compensate
from jaximu.calibration.filter_history import History
from jaximu.calibration.recipe import Choices, calibrate_ready
from jaximu.calibration.refusals import refuse_undetermined, require_solved
from jaximu.calibration.vehicle import calibrate_at_stops
from jaximu.data.by_hand import RecordedByHand
from jaximu.data.drift import with_usual_drift
from jaximu.data.motion import (
    Disturbances,
    FilterPass,
    IntervalsOfMotion,
    cut,
    first_field,
    longest_rest,
    merged_drift,
    sees_earth,
)
from jaximu.data.poses import residual_rms
from jaximu.estimation.fitting import Fit, Prior, fit
from jaximu.estimation.information_filter import Knowledge
from jaximu.estimation.problem import TOLERANCE, Name, Parameters, flatten, typical_sizes, without_equipment_or_effects
from jaximu.estimation.rows import Sizes
from jaximu.estimation.solver import Failure
from jaximu.estimation.uncertainty import label, pose_advice
from jaximu.ground.array_types import FloatArray
from jaximu.ground.document import Json
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import STANDARD, LocalGravity
from jaximu.ground.precision import require_float64
from jaximu.ground.quantities import sentence
from jaximu.ground.tracing import on_host
from jaximu.mistakes import prepared
from jaximu.model.effects.base import Effect
from jaximu.model.effects.earth_rotation import EARTH_RATE, GyroEarthRotation
from jaximu.model.effects.magnetic_field import SetupMagneticField
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.sensor import Imu
from jaximu.noise.at_rest import noise_of, white_in_rests
from jaximu.recordings.attitude import Attitude
from jaximu.recordings.finding import Finding
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.segmentation import Segmentation, SegmentationOptions, find_stops

DRIFTS = 2
"""Gauss–Markov processes an axis that stand for all of a noise model's."""
SHORTEST = 1.0
"""Seconds below which correlated noise is white to the filter."""
_ARRIVAL = 2e-3
"""m/s that a unit may still move by where a rest is found to begin."""
_LOST = np.array([1.0] * 3 + [2.0] * 3)
"""rad/s and m/s²: how far rate and force may be, where samples are missing, from their neighbours'."""
_LEAST_REFERENCE = 1e-5, 1e-4
"""rad and m/s of noise that a reference's attitude and velocity have at the least."""
FIELD = 0.01
"""Share of the field by which its mean over a rest is off at first, until innovations tell."""
_MATCHED, _ROUNDS = 0.1, 3
_CARRIED = {"specific_force", "angular_rate", "angular_acceleration", "time", "attitude"}
"""What the filter knows of a path: an effect that needs more is not its."""
NEIGHBOURS = 3
"""Samples about an interval that effects see: derivatives, and delays of up to a sample and a half."""


def noise_at_rest(segmentation: Segmentation) -> NoiseModel:
    """Return white noise as a recording's rests show it, and the drift that is usual of such sensors."""
    rests = segmentation.intervals
    white = {name: AxisNoise.of_white(density) for name, density in white_in_rests(segmentation).items()}
    duration = float(rests[-1, 1] - rests[0, 0])
    return with_usual_drift(
        NoiseModel(white["accelerometer"], white["gyroscope"]), float(np.median(np.diff(rests, axis=1))), duration
    )


def known_scale(calibration: Calibration) -> Mapping[str, float]:
    """Return how much larger variances in a rest and in motion are than the noise says, as a calibration found them.

    One by poses and turns knows it of motion: what its turns missed beyond the noise.
    """
    noise = (calibration.filter or {}).get("noise")
    return noise or {"rest": 1.0, "motion": 1.0 + calibration.excess.get("turns", 0.0)}


def disturbances(noise: NoiseModel, scale: Mapping[str, float] | None = None) -> Disturbances:
    """Return what disturbs a unit with some noise; in a rest it may turn by what its gyroscope cannot tell.

    **Arguments:** `scale`: of the variances in a rest and in motion, as a filter found them (`filter.noise`).
    """
    white, variance, times = merged_drift(noise, SHORTEST, DRIFTS)
    creep = 1e-2 * white[:3].min()
    rest, motion = (1.0, 1.0) if scale is None else (scale["rest"], scale["motion"])
    arrival = np.float64(_ARRIVAL * np.sqrt(motion))
    return Disturbances(motion * white, rest * white, variance, times, creep, arrival, _LOST)


def seen_from_outside(errors: Disturbances, mounted: Mounted | None) -> Disturbances:
    """Return the same disturbances with the noise of a reference."""
    if mounted is None:
        return errors
    attitude, velocity = (np.float64(max(pair)) for pair in zip(mounted.sigmas, _LEAST_REFERENCE, strict=True))
    return replace(errors, reference=attitude, velocity=velocity)


def field_of(calibration: Calibration, recording: Recording) -> Signal:
    """Return the magnetic field in the body frame (µT) that a recording's magnetometer shows, by its calibration.

    Raises `InputError` without a magnetometer in either.
    """
    if recording.magnetometer is None:
        raise InputError(
            f"{recording.name}: there is no magnetometer in it, and its calibration was given: leave it out, or log "
            "the magnetometer, too."
        )
    if "magnetometer" not in calibration.triads():
        raise InputError("the calibration given for the magnetometer holds none: make one with `jaximu magnetometer`.")
    return compensate(calibration, recording).signals["magnetometer"]


def require_gyroscope(recording: Recording) -> None:
    """Raise `InputError` for a recording that a filter cannot follow."""
    if recording.gyroscope is None:
        raise InputError(f"{recording.name}: the filter needs a gyroscope beside the accelerometer, and there is none.")


def calibrate_by_filter(
    recording: Recording,
    gravity: LocalGravity = STANDARD,
    *,
    attitude: Attitude | None = None,
    latitude: float | None = None,
    static: Recording | NoiseModel | None = None,
    segmentation: SegmentationOptions | None = None,
    effects: Sequence[str | Effect] = (),
    effect_sigmas: Mapping[str, float] | None = None,
    repair: bool = False,
    magnetometer: Calibration | None = None,
) -> tuple[Calibration, History]:
    """Calibrate a unit from all of a recording of rests and motion, by a Kalman filter and smoother.

    Beside what [`jaximu.calibrate`] uses, velocity ties both triads together: it is zero where motion ends. Drift of
    the biases is followed in time, and the Earth's rotation is estimated. The start is the calibration by poses and
    turns; then filter and smoother are repeated about the result until nothing moves.

    **Arguments:** `attitude`: measured, by optics, a robot or a rate table, with its own clock, and velocity where it
    has velocities or positions: how it is mounted, late and tilted, and where the unit lies from the tracked point, is
    found first ([`jaximu.calibration.calibrate_against_attitude`]) and is then among the states; where
    there is one, motion need not end within half a minute. `magnetometer`: a calibration of this unit's
    magnetometer, which the recording holds: the Earth's field, the same in all of it and unknown, then tells the
    heading of every rest. `latitude`: degrees, where known: what the Earth's rotation
    is about the vertical; `effects`: of the catalogue, states beside gain and bias, those included that only motion
    excites; the others as for [`jaximu.calibrate`].

    A recording of a vehicle that stops shows the gyroscope's bias alone, and how the unit is mounted in the vehicle
    ([`jaximu.calibration.vehicle.calibrate_at_stops`]): the calibration is then of that bias, and `filter` has a part
    `vehicle`.

    **Returns:** the calibration, with `filter` {states, nis, open}, and how the filter came to it. What it leaves open
    of an effect stays at the start and is among `open`.

    Raises `InputError` without a gyroscope, and as [`jaximu.calibrate`] does, and where the measured attitude does not
    fit the recording; `NotPossibleError` for an effect of which
    the sequence tells nothing, or that the filter cannot follow, and where the rotations leave so much open that the
    filter does not converge.
    """
    require_float64()
    require_gyroscope(recording)
    chosen = [state_effect(effect_named(effect)) for effect in effects]
    with prepared([recording], repair) as (ready,):
        known = noise_of(static)
        stops = find_stops(ready.recording) if attitude is None and segmentation is None else None
        if stops is not None:
            if chosen or magnetometer is not None:
                raise NotPossibleError(
                    f"{recording.name}: this is a vehicle that stops, which determines neither effects nor more with a "
                    "magnetometer: leave --effect and --magnetometer out."
                )
            calibration, history = calibrate_at_stops(stops, replace(gravity, latitude=latitude), known)
            return replace(calibration, notes=(*ready.notes, *calibration.notes)), history
        choices = Choices(gravity, known, segmentation)
        start, findings, noise = _start(ready.recording, choices, known, repair, bool(chosen))
        rests = start.segmentations[0]
        errors = disturbances(noise, None if chosen else known_scale(start))
        mounted = None if attitude is None else mounted_on(rests.recording, attitude, gravity, noise, start)
        field = None if magnetometer is None else field_of(magnetometer, rests.recording)
        beyond = NEIGHBOURS if chosen else 0
        measurement, outside, notes = _measured(start, errors, mounted, field, beyond, gravity)
        unknown = GyroEarthRotation.dormant(), np.full(3, EARTH_RATE)
        earth, spread = unknown if latitude is None else GyroEarthRotation.at(latitude)
        chosen = [effect for effect in chosen if effect.name != earth.name]
        imu = on_host(start.imu.with_effects(earth, *chosen, *outside))
        stated = {**{effect.name: effect.known for effect in outside}, **(effect_sigmas or {}), earth.name: spread}
        known_before, prior = Prior.of_effects(imu, stated), Prior.of_effects(imu, plausible_sizes(imu) | stated)
        assert known_before is not None and prior is not None
        fitted, followed, measurement = _settled(imu, measurement, prior, start, gravity, mounted)
    refuse_undetermined(fitted, known_before, wholly=True)
    imu = on_host(fitted.imu)
    calibration = concluded(
        fitted,
        advice=state_advice,
        gravity=gravity,
        method="filter",
        loss="linear",
        excess_names=measurement.excess_names,
        rms=_errors_of_poses(start, imu, {effect.name for effect in chosen}),
        known=known_before.names,
        data=start.data,
        notes=[
            *notes_of(ready, mounted and mounted.attitude),
            *(finding.text for finding in findings),
            *start.notes,
            *notes,
            *noise.notes,
        ],
        observations=start.observations,
        segmentations=start.segmentations,
        nominal=start.nominal,
        reading=start.reading,
    )
    if mounted is not None:
        smoothed = {"filter": mounted.summary["filter"]}  # as it was found first
        calibration = replace(calibration, reference=reference_summary(calibration) | smoothed)
    history = _history(measurement, followed, imu)
    scale = _scaled_noise(measurement.errors, noise, float(fitted.excess[0]))
    summary = _summary(calibration, history, measurement.errors.correlation_time, scale)
    return replace(calibration, filter=summary), history


def _settled(
    imu: Imu,
    measurement: IntervalsOfMotion,
    prior: Prior,
    start: Calibration,
    gravity: LocalGravity,
    mounted: Mounted | None,
) -> tuple[Fit, FilterPass, IntervalsOfMotion]:
    """Repeat fit and filter until innovations are what the noise says, or `_ROUNDS` times."""
    name = start.segmentations[0].recording.name
    for _ in range(_ROUNDS):
        fitted = fit(imu, measurement, prior=prior, follow=True)
        if mounted is None:  # else the attitude tells what poses and turns leave open
            _require_enough_turned(fitted, start, name)
        require_solved(fitted, name)
        imu = on_host(fitted.imu)
        followed = _followed(measurement, imu, prior, gravity, start)
        if (matched := _matched(measurement, followed)) is None:
            break
        measurement = matched
    return fitted, followed, measurement


def _errors_of_poses(start: Calibration, imu: Imu, effects: set[str]) -> list[Sizes]:
    """Return the errors of poses and turns by the data sheet, and by the unit with its effects of those names."""
    assert start.observations is not None and start.nominal is not None
    terms = tuple(effect for effect in imu.all_effects().values() if effect.name in effects)
    cleaned = RecordedByHand(start.segmentations, start.observations)
    if terms:
        cleaned = cleaned.along(imu, terms)
    return [residual_rms(start.nominal, start.observations), residual_rms(imu.with_effects(), cleaned.observations)]


def _summary(
    calibration: Calibration,
    history: History,
    correlation_time: FloatArray,
    scale: Mapping[str, float],
) -> Json:
    """Return the states of the filter, the scale of its noise, how large innovations were, and what it leaves open.

    Of effects, weak directions that are determined all the same are no open states.
    """
    drifts = [f"{triad} drift, {time:.3g} s" for time in correlation_time for triad in ("gyroscope", "accelerometer")]
    names = history.names
    of_effects = {name for name in names if name.effect is not None}
    return {
        "states": ["attitude", "velocity", *drifts, *(label(name, calibration.imu) for name in names), "gravity"],
        "noise": scale,
        "nis": float(history.innovations.sum() / history.freedom.sum()),
        "open": [
            weak.text
            for weak in calibration.weak
            if not (weak.determined and {name for name, _ in weak.parameters} <= of_effects)
        ],
    }


def _start(
    recording: Recording, choices: Choices, known: NoiseModel | None, repair: bool, extended: bool
) -> tuple[Calibration, Sequence[Finding], NoiseModel]:
    """Return the calibration by poses and turns, what is unusual, and the noise; `extended`: effects are to follow."""
    start, findings = calibrate_ready([recording], choices, repair, losses=not extended)
    noise = noise_at_rest(start.segmentations[0]) if known is None else known
    if not extended and sees_earth(disturbances(noise)):  # or turns would count it as noise of motion
        with suppress(NotPossibleError):
            turning = replace(choices, effects=(GyroEarthRotation.name,))
            start, findings = calibrate_ready([recording], turning, repair)
    return start, findings, noise


def _measured(
    start: Calibration,
    errors: Disturbances,
    mounted: Mounted | None,
    field: Signal | None,
    beyond: int,
    gravity: LocalGravity,
) -> tuple[IntervalsOfMotion, tuple[Effect, ...], list[str]]:
    """Return the recording in intervals, the effects of what was measured from outside, and notes.

    **Arguments:** `field`: magnetic, in the body frame, µT; `beyond`: samples about an interval that are kept.
    """
    rests, outside, reference = start.segmentations[0], (), {}
    if mounted is not None:
        errors, outside = seen_from_outside(errors, mounted), mounted.effects
        reference = {"attitude": mounted.attitude, "mounting": mounted.mounting}
    intervals, notes = cut(rests.recording, rests.intervals, longest_rest(errors), beyond, field=field, **reference)
    if field is not None:
        first = first_field(intervals, start.imu.with_effects(*outside))
        outside = (*outside, SetupMagneticField.make(first))
        errors = replace(errors, field=np.float64(FIELD * np.linalg.norm(first)))
    return IntervalsOfMotion(intervals, errors, gravity.value), outside, notes


def _require_enough_turned(fitted: Fit, start: Calibration, where: str) -> None:
    """Refuse a filter that does not converge where poses and turns left open what its path depends on."""
    left = [sentence(weak.text) for weak in start.weak if not weak.determined]
    if left and fitted.failure() is Failure.MAX_STEPS:
        raise NotPossibleError(
            f"{where}: the filter did not converge, most likely because these rotations leave too much open. "
            f"{' '.join(left)} `jaximu plan --for filter` proposes rotations; `jaximu calibrate` gives what these "
            "determine."
        )


def state_effect(effect: Effect) -> Effect:
    """Return an effect that the filter can have as states. Raises `NotPossibleError` for others."""
    if effect.scope == "fixture":
        raise NotPossibleError(
            f"{effect.name} is an error of a set-up, and the filter knows of none: see `jaximu turntable`."
        )
    if effect.owner == "magnetometer" or not set(effect.needs) <= _CARRIED:
        raise NotPossibleError(
            f"{effect.name} needs more than the filter follows, which is force, rate and attitude: fit it with "
            "`jaximu calibrate --effect`, or `jaximu thermal` for what depends on temperature."
        )
    if effect.inner or effect.probes or effect.memory:
        raise NotPossibleError(
            f"{effect.name} is not proportional to its numbers, as states of the filter must be: fit it with "
            "`jaximu calibrate --effect`."
        )
    return effect


def plausible_sizes(imu: Imu) -> dict[str, FloatArray]:
    """Return how large the coefficients of a unit's effects may be, by effect: what is open stays where it starts."""
    sizes = typical_sizes(imu).all_effects()
    return {effect.name: effect.plausible * sizes[key].coefficients for key, effect in imu.all_effects().items()}


def state_advice(vector: FloatArray, names: Sequence[Name], sizes: FloatArray, model: Imu) -> str:
    """Say what excites a direction most: where it is one of effects, what they are excited by."""
    share: dict[str, float] = {}
    for name, weight in zip(names, vector, strict=True):
        if name.effect is not None:
            effect = model.all_effects()[name.key]
            share[effect.excited_by] = share.get(effect.excited_by, 0.0) + float(weight) ** 2
    if sum(share.values()) < 0.5:
        return pose_advice(vector, names, sizes, model)
    return f"{max(share, key=share.__getitem__)}."


def _scaled_noise(errors: Disturbances, noise: NoiseModel, excess: float) -> dict[str, float]:
    """Return how much larger the variances in rests and in motion were than the noise says, misfit included."""
    white = disturbances(noise).white
    return {
        name: (1 + excess) * float((density / white).mean())
        for name, density in (("rest", errors.rest), ("motion", errors.white))
    }


def _followed(
    measurement: IntervalsOfMotion, imu: Imu, prior: Prior, gravity: LocalGravity, start: Calibration
) -> FilterPass:
    """Return how a filter that begins with the data sheet comes to know the free numbers."""
    assert start.nominal is not None
    free = Parameters.select(imu, without_equipment_or_effects)
    nominal = start.nominal.with_effects(*imu.all_effects().values())
    index = list(free.index)
    reference = flatten(imu)[index]
    mean = flatten(nominal)[index] - reference
    sigma = TOLERANCE * flatten(typical_sizes(imu))[index]
    rows = [free.names.index(name) for name in prior.names]
    mean[rows], sigma[rows] = prior.mean - reference[rows], 1 / np.diagonal(prior.root)
    sigma = np.append(sigma, max(gravity.sigma, 1e-6))
    return measurement.followed(imu, index, Knowledge(np.diag(1 / sigma), np.append(mean, 0.0) / sigma))


def _matched(measurement: IntervalsOfMotion, followed: FilterPass) -> IntervalsOfMotion | None:
    """Return the measurement with the noise that innovations show, in rests, where motion ends, and from outside; or
    None.

    The noise within rests may not tell what differs from rest to rest, nor how far velocity is off where motion ends.
    """
    intervals, errors = measurement.intervals, measurement.errors
    rest, arrival = intervals.rest > 0, intervals.arrival > 0
    parts = [(rest & ~np.roll(arrival, 1), 0), (arrival, 0)]
    parts += [(np.ones_like(rest), column + 1) for column in range(len(intervals.sightings))]
    shares = []
    for chosen, column in parts:
        innovations, freedom = (values[chosen, column].sum() for values in (followed.innovations, followed.freedom))
        shares.append(max(float(innovations / freedom), 0.25) if freedom else 1.0)
    if all(abs(share - 1) < _MATCHED for share in shares):
        return None
    outside = {
        sighting.noise: getattr(errors, sighting.noise) * np.sqrt(share)
        for sighting, share in zip(intervals.sightings, shares[2:], strict=True)
    }
    scaled = replace(errors, rest=errors.rest * shares[0], arrival=errors.arrival * np.sqrt(shares[1]), **outside)
    return replace(measurement, errors=scaled)


def _history(measurement: IntervalsOfMotion, followed: FilterPass, imu: Imu) -> History:
    intervals, free = measurement.intervals, Parameters.select(imu, without_equipment_or_effects)
    real = intervals.real > 0
    inside = intervals.length > 0
    time = np.where(inside, intervals.time[:, -inside.shape[1] :], -np.inf).max(axis=1)[real]
    values = followed.values[real, :-1] + flatten(imu)[list(free.index)]
    drift = followed.states[real, 6:].reshape(len(time), -1, 6).sum(axis=1)
    spread = np.sqrt((followed.state_sigmas[real, 6:] ** 2).reshape(len(time), -1, 6).sum(axis=1))
    innovations, freedom = (counts[real].sum(axis=1) for counts in (followed.innovations, followed.freedom))
    return History(
        time,
        (intervals.rest > 0)[real],
        free.names,
        values,
        followed.sigmas[real, :-1],
        drift,
        spread,
        innovations,
        freedom,
        places_of(GyroEarthRotation, imu, free.names),
    )


def places_of(kind: type[Effect], imu: Imu, names: Sequence[Name]) -> tuple[int, ...]:
    """Return where the numbers of a unit's effect are among some names."""
    keys = {key for key, effect in imu.all_effects().items() if isinstance(effect, kind)}
    return tuple(row for row, name in enumerate(names) if name.key in keys)
