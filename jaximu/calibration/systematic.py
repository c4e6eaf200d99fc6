"""System-level calibration: a filter over a whole recording of rests and motion, iterated to convergence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaximu.calibration.attitude import Mounted, mounted_on, reference_summary
from jaximu.calibration.calibration import Calibration, concluded, effect_named
from jaximu.calibration.compensation import compensate
from jaximu.calibration.recipe import Choices, calibrate_ready
from jaximu.calibration.refusals import refuse_undetermined, require_solved
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
from jaximu.estimation.solver import Failure
from jaximu.estimation.uncertainty import label, pose_advice
from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import STANDARD, LocalGravity
from jaximu.ground.precision import require_float64
from jaximu.ground.summary import sentence
from jaximu.mistakes import prepared
from jaximu.model.effects.base import Effect
from jaximu.model.effects.earth_rotation import EARTH_RATE, GyroEarthRotation
from jaximu.model.effects.magnetic_field import SetupMagneticField
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.sensor import Imu
from jaximu.noise.at_rest import noise_of
from jaximu.recordings.attitude import Attitude
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.segmentation import Segmentation, SegmentationOptions, rest_statistics

__all__ = ["FIELD", "NEIGHBOURS", "History", "calibrate_by_filter", "disturbances", "field_of", "known_scale",
           "noise_at_rest", "places_of", "plausible_sizes", "seen_from_outside", "state_advice",
           "state_effect"]  # fmt: skip

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


@dataclass(frozen=True)
class History:
    """What the filter knew when. time (N,): s, at the end of each interval; rest (N,).

    names: of the free numbers; values, sigmas (N, p) of them, in their own units. drift, drift_sigma (N, 6): of rate
    (rad/s) and force (m/s²), smoothed. innovations (N,): normalised, squared, of `freedom` (N,) degrees. earth: places
    of the Earth's rotation among the numbers.
    """

    time: FloatArray
    rest: NDArray[np.bool_]
    names: tuple[Name, ...]
    values: FloatArray
    sigmas: FloatArray
    drift: FloatArray
    drift_sigma: FloatArray
    innovations: FloatArray
    freedom: FloatArray
    earth: tuple[int, ...]

    def converged(self, place: int) -> float | None:
        """Return after how many seconds a number's uncertainty came within twice its last; None if it never halved."""
        sigma = self.sigmas[:, place]
        if sigma[-1] > sigma[0] / 2:
            return None
        return float(self.time[np.argmax(sigma <= 2 * sigma[-1])] - self.time[0])


def noise_at_rest(segmentation: Segmentation) -> NoiseModel:
    """Return white noise as a recording's rests show it, and the drift that is usual of such sensors."""
    recording, rests = segmentation.recording, segmentation.intervals
    assert recording.gyroscope is not None
    white = [
        AxisNoise.of_white(np.diagonal(rest_statistics(signal, rests)[0]) / signal.nominal_scale**2)
        for signal in (recording.accelerometer, recording.gyroscope)
    ]
    duration = float(rests[-1, 1] - rests[0, 0])
    return with_usual_drift(NoiseModel(white[0], white[1]), float(np.median(np.diff(rests, axis=1))), duration)


def known_scale(calibration: Calibration) -> Mapping[str, float]:
    """Return how much larger variances in a rest and in motion are than the noise says, as a calibration found them.

    One by poses and turns knows it of motion: what its turns missed beyond the noise.
    """
    found = (calibration.filter or {}).get("noise")
    return found or {"rest": 1.0, "motion": 1.0 + calibration.excess.get("turns", 0.0)}


def disturbances(noise: NoiseModel, scale: Mapping[str, float] | None = None) -> Disturbances:
    """Return what disturbs a unit with some noise; in a rest it may turn by what its gyroscope cannot tell.

    **Arguments:** `scale`: of the variances in a rest and in motion, as a filter found them (`filter.noise`).
    """
    white, variance, times = merged_drift(noise, SHORTEST, DRIFTS)
    creep = 1e-2 * np.min(white[:3])
    rest, motion = (1.0, 1.0) if scale is None else (scale["rest"], scale["motion"])
    arrival = np.float64(_ARRIVAL * np.sqrt(motion))
    return Disturbances(motion * white, rest * white, variance, times, creep, arrival, _LOST)  # pyright: ignore


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
    field = compensate(calibration, recording).magnetometer
    assert field is not None
    return field


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

    **Returns:** the calibration, with `filter` {states, nis, open}, and how the filter came to it. What it leaves open
    of an effect stays at the start and is among `open`.

    Raises `InputError` without a gyroscope, and as [`jaximu.calibrate`] does, and where the measured attitude does not
    fit the recording; `NotPossibleError` for an effect of which
    the sequence tells nothing, or that the filter cannot follow, and where the rotations leave so much open that the
    filter does not converge.
    """
    require_float64()
    if recording.gyroscope is None:
        raise InputError(f"{recording.name}: the filter needs a gyroscope beside the accelerometer, and there is none.")
    chosen = [state_effect(effect_named(each)) for each in effects]
    with prepared([recording], repair) as (ready,):
        known = noise_of(static)
        choices = Choices(gravity, known, segmentation)
        start, findings = calibrate_ready([ready.recording], choices, repair, losses=not chosen)
        rests = start.segmentations[0]
        noise = noise_at_rest(rests) if known is None else known
        if not chosen and sees_earth(disturbances(noise)):  # or turns would count it as noise of motion
            with suppress(NotPossibleError):
                turning = replace(choices, effects=(GyroEarthRotation.name,))
                start, findings = calibrate_ready([ready.recording], turning, repair)
        errors = disturbances(noise, None if chosen else known_scale(start))
        still, beyond = longest_rest(errors), NEIGHBOURS if chosen else 0
        mounted = None if attitude is None else mounted_on(rests.recording, attitude, gravity, noise, start)
        errors = seen_from_outside(errors, mounted)
        seen: dict[str, Any] = {} if mounted is None else {"attitude": mounted.attitude, "mounting": mounted.mounting}
        outside = () if mounted is None else mounted.effects
        seen["field"] = None if magnetometer is None else field_of(magnetometer, rests.recording)
        intervals, notes = cut(rests.recording, rests.intervals, still, beyond, **seen)
        if magnetometer is not None:
            place = first_field(intervals, start.imu.with_effects(*outside))
            outside = (*outside, SetupMagneticField.make(place))
            errors = replace(errors, field=np.float64(FIELD * np.linalg.norm(place)))
        measurement = IntervalsOfMotion(intervals, errors, gravity.value)
        unknown = GyroEarthRotation.dormant(), np.full(3, EARTH_RATE)
        earth, spread = unknown if latitude is None else GyroEarthRotation.at(latitude)
        chosen = [each for each in chosen if each.name != earth.name]
        imu = jax.tree.map(np.asarray, start.imu.with_effects(earth, *chosen, *outside))
        usual = {each.name: each.known for each in outside}
        stated = {**usual, **(effect_sigmas or {}), earth.name: spread}
        known_before, prior = Prior.of_effects(imu, stated), Prior.of_effects(imu, plausible_sizes(imu) | stated)
        assert known_before is not None and prior is not None
        for _ in range(_ROUNDS):
            found = fit(imu, measurement, prior=prior, follow=True)
            if mounted is None:  # else the attitude tells what poses and turns leave open
                _require_enough_turned(found, start, recording.name)
            require_solved(found, recording.name)
            imu = jax.tree.map(np.asarray, found.imu)
            followed, names = _followed(measurement, imu, prior, gravity, start)
            matched = _matched(measurement, followed)
            if matched is None:
                break
            measurement = matched
    refuse_undetermined(found, known_before, wholly=True)
    assert start.observations is not None and start.nominal is not None
    before = residual_rms(start.nominal, start.observations)
    cleaned = start.observations
    if chosen:
        names_chosen = {each.name for each in chosen}
        terms = tuple(each for each in imu.all_effects().values() if each.name in names_chosen)
        cleaned = RecordedByHand(start.segmentations, start.observations).along(imu, terms).observations
    calibration = concluded(
        found, advice=state_advice, gravity=gravity, method="filter", loss="linear",
        excess_names=measurement.excess_names,
        rms=[before, residual_rms(imu.with_effects(), cleaned)], known=known_before.names, data=start.data,
        notes=[*ready.notes, *(() if mounted is None else mounted.attitude.notes), *(each.text for each in findings),
               *start.notes, *notes, *noise.notes],
        observations=start.observations, segmentations=start.segmentations, nominal=start.nominal,
        reading=start.reading,
    )  # fmt: skip
    if mounted is not None:
        smoothed = {"filter": mounted.summary["filter"]}  # as it was found first
        calibration = replace(calibration, reference=reference_summary(calibration) | smoothed)
    history = _history(measurement, followed, names, imu)
    states = ["attitude", "velocity", *(f"{triad} drift, {time:.3g} s" for time in measurement.errors.correlation_time
                                        for triad in ("gyroscope", "accelerometer"))]  # fmt: skip
    of_effects = {name for name in names if name.effect is not None}
    summary = {  # of effects, weak directions that are determined all the same are no open states
        "states": [*states, *(label(name, imu) for name in names), "gravity"],
        "noise": _scaled_noise(measurement.errors, noise, float(found.excess[0])),
        "nis": float(history.innovations.sum() / history.freedom.sum()),
        "open": [
            each.text
            for each in calibration.weak
            if not (each.determined and {name for name, _ in each.parameters} <= of_effects)
        ],
    }
    return replace(calibration, filter=summary), history


def _require_enough_turned(found: Fit, start: Calibration, where: str) -> None:
    """Refuse a filter that does not converge where poses and turns left open what its path depends on."""
    left = [sentence(each.text) for each in start.weak if not each.determined]
    if left and found.failure() is Failure.MAX_STEPS:
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
    return {each.name: each.plausible * np.asarray(sizes[at].coefficients) for at, each in imu.all_effects().items()}


def state_advice(vector: FloatArray, names: Sequence[Name], sizes: FloatArray, model: Imu) -> str:
    """Say what excites a direction most: where it is one of effects, what they are excited by."""
    share: dict[str, float] = {}
    for name, weight in zip(names, vector, strict=True):
        if name.effect is not None:
            effect = model.all_effects()[name.owner, name.effect]
            share[effect.excited_by] = share.get(effect.excited_by, 0.0) + float(weight) ** 2
    if sum(share.values()) < 0.5:
        return pose_advice(vector, names, sizes, model)
    return f"{max(share, key=share.__getitem__)}."


def _scaled_noise(errors: Disturbances, noise: NoiseModel, excess: float) -> dict[str, float]:
    """Return how much larger the variances in rests and in motion were than the noise says, misfit included."""
    white = merged_drift(noise, SHORTEST, DRIFTS)[0]
    return {
        "rest": (1 + excess) * float(np.mean(np.asarray(errors.rest) / white)),
        "motion": (1 + excess) * float(np.mean(np.asarray(errors.white) / white)),
    }


def _followed(
    measurement: IntervalsOfMotion, imu: Imu, prior: Prior, gravity: LocalGravity, start: Calibration
) -> tuple[FilterPass, tuple[Name, ...]]:
    """Return how a filter that begins with the data sheet comes to know the free numbers."""
    free = Parameters.select(imu, without_equipment_or_effects)
    assert start.nominal is not None
    nominal = start.nominal.with_effects(*imu.all_effects().values())
    index = list(free.index)
    mean = (flatten(nominal) - flatten(imu))[index]
    sigma = TOLERANCE * flatten(typical_sizes(imu))[index]
    for name, value, root in zip(prior.names, prior.mean, np.diagonal(prior.root), strict=True):
        place = free.names.index(name)
        mean[place], sigma[place] = value - flatten(imu)[index[place]], 1 / root
    sigma = np.append(sigma, max(gravity.sigma, 1e-6))
    known = Knowledge(np.diag(1 / sigma), np.append(mean, 0.0) / sigma)  # pyright: ignore[reportArgumentType]
    return measurement.followed(imu, index, known), free.names


def _matched(measurement: IntervalsOfMotion, followed: FilterPass) -> IntervalsOfMotion | None:
    """Return the measurement with the noise that innovations show, in rests, where motion ends, and from outside; or
    None.

    The noise within rests may not tell what differs from rest to rest, nor how far velocity is off where motion ends.
    """
    rest, arrival = (np.asarray(each) > 0 for each in (measurement.intervals.rest, measurement.intervals.arrival))
    parts = [(rest & ~np.roll(arrival, 1), 0), (arrival, 0)]
    parts += [(np.ones_like(rest), place + 1) for place in range(len(measurement.intervals.sightings))]
    shares = []
    for intervals, kind in parts:
        innovations, freedom = (each[intervals, kind].sum() for each in (followed.innovations, followed.freedom))
        shares.append(max(float(innovations / freedom), 0.25) if freedom else 1.0)
    if all(abs(each - 1) < _MATCHED for each in shares):
        return None
    errors = measurement.errors
    seen = {each.noise: getattr(errors, each.noise) * np.sqrt(share)
            for each, share in zip(measurement.intervals.sightings, shares[2:], strict=True)}  # fmt: skip
    scaled = replace(errors, rest=errors.rest * shares[0], arrival=errors.arrival * np.sqrt(shares[1]), **seen)
    return replace(measurement, errors=scaled)


def _history(measurement: IntervalsOfMotion, followed: FilterPass, names: tuple[Name, ...], imu: Imu) -> History:
    intervals = measurement.intervals
    real = np.asarray(intervals.real) > 0
    inside = np.asarray(intervals.length) > 0
    time = np.where(inside, np.asarray(intervals.time)[:, -inside.shape[1] :], -np.inf).max(axis=1)[real]
    index = list(Parameters.select(imu, without_equipment_or_effects).index)
    values = followed.values[real, :-1] + flatten(imu)[index]
    drift = followed.states[real, 6:].reshape(len(time), -1, 6).sum(axis=1)
    spread = np.sqrt((followed.state_sigmas[real, 6:] ** 2).reshape(len(time), -1, 6).sum(axis=1))
    innovations, freedom = (each[real].sum(axis=1) for each in (followed.innovations, followed.freedom))
    return History(
        time, (np.asarray(intervals.rest) > 0)[real], names, values, followed.sigmas[real, :-1], drift, spread,
        innovations, freedom, places_of(GyroEarthRotation, imu, names),
    )  # fmt: skip


def places_of(kind: type[Effect], imu: Imu, names: Sequence[Name]) -> tuple[int, ...]:
    """Return where the numbers of a unit's effect are among some names."""
    own = {at for at, effect in imu.all_effects().items() if isinstance(effect, kind)}
    return tuple(place for place, name in enumerate(names) if (name.owner, name.effect) in own)
