"""System-level calibration: a filter over a whole recording of rests and motion, iterated to convergence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import jax
import numpy as np
from numpy.typing import NDArray

from jaximu._types import FloatArray
from jaximu.calibration.calibration import Calibration, concluded
from jaximu.calibration.recipe import Choices, calibrate_ready, residual_rms, without_equipment_or_effects
from jaximu.calibration.refusals import require_solved
from jaximu.effects.earth_rotation import EARTH_RATE, GyroEarthRotation
from jaximu.errors import InputError
from jaximu.estimation import Prior, fit
from jaximu.gravity import STANDARD, LocalGravity
from jaximu.information_filter import Knowledge
from jaximu.measurements.drift import with_usual_drift
from jaximu.measurements.intervals import Disturbances, Followed, IntervalsOfMotion, cut, merged_drift
from jaximu.mistakes import prepared
from jaximu.noise.model import AxisNoise, NoiseModel
from jaximu.precision import require_float64
from jaximu.problem import TOLERANCE, Name, Parameters, flatten, typical_sizes
from jaximu.recording import Recording
from jaximu.segmentation import Segmentation, SegmentationOptions, rest_statistics
from jaximu.sensor import Imu

__all__ = ["History", "calibrate_by_filter", "disturbances", "noise_at_rest"]

DRIFTS = 2
"""Gauss–Markov processes an axis that stand for all of a noise model's."""
SHORTEST = 1.0
"""Seconds below which correlated noise is white to the filter."""
_ARRIVAL = 2e-3
"""m/s that a unit may still move by where a rest is found to begin."""
_LOST = np.array([1.0] * 3 + [2.0] * 3)
"""rad/s and m/s²: how far rate and force may be, where samples are missing, from their neighbours'."""
_MATCHED, _ROUNDS = 0.1, 3


@dataclass(frozen=True)
class History:
    """What the filter knew when. time (N,): s, at the end of each interval; rest (N,).

    names: of the free numbers; values, sigmas (N, p) of them, in their own units. drift, drift_sigma (N, 6): of rate
    (rad/s) and force (m/s²), smoothed. innovations (N,): normalised, squared, of `freedom` (N,) degrees.
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


def disturbances(noise: NoiseModel, scale: Mapping[str, float] | None = None) -> Disturbances:
    """Return what disturbs a unit with some noise; in a rest it may turn by what its gyroscope cannot tell.

    **Arguments:** `scale`: of the variances in a rest and in motion, as a filter found them (`filter.noise`).
    """
    white, variance, times = merged_drift(noise, SHORTEST, DRIFTS)
    creep = 1e-2 * np.min(white[:3])
    rest, motion = (1.0, 1.0) if scale is None else (scale["rest"], scale["motion"])
    arrival = np.float64(_ARRIVAL * np.sqrt(motion))
    return Disturbances(motion * white, rest * white, variance, times, creep, arrival, _LOST)  # pyright: ignore


def calibrate_by_filter(
    recording: Recording,
    gravity: LocalGravity = STANDARD,
    *,
    latitude: float | None = None,
    static: Recording | NoiseModel | None = None,
    segmentation: SegmentationOptions | None = None,
    repair: bool = False,
) -> tuple[Calibration, History]:
    """Calibrate a unit from all of a recording of rests and motion, by a Kalman filter and smoother.

    Beside what [`jaximu.calibrate`] uses, velocity ties both triads together: it is zero where motion ends. Drift of
    the biases is followed in time, and the Earth's rotation is estimated. The start is the calibration by poses and
    turns; then filter and smoother are repeated about the result until nothing moves.

    **Arguments:** `latitude`: degrees, where known: what the Earth's rotation is about the vertical; the others as for
    [`jaximu.calibrate`].

    **Returns:** the calibration, with `filter` {states, nis, open}, and how the filter came to it.

    Raises `InputError` without a gyroscope, and as [`jaximu.calibrate`] does.
    """
    require_float64()
    if recording.gyroscope is None:
        raise InputError(f"{recording.name}: the filter needs a gyroscope beside the accelerometer, and there is none.")
    with prepared([recording], repair) as (ready,):
        known = NoiseModel.fit(static) if isinstance(static, Recording) else static
        start, findings = calibrate_ready([ready.recording], Choices(gravity, known, segmentation), repair)
        rests = start.segmentations[0]
        noise = noise_at_rest(rests) if known is None else known
        intervals, notes = cut(rests.recording, rests.intervals)
        # what turns miss beyond the noise is known from the calibration by poses and turns
        known_scale = {"rest": 1.0, "motion": 1.0 + start.excess.get("turns", 0.0)}
        measurement = IntervalsOfMotion(intervals, disturbances(noise, known_scale), gravity.value)
        unknown = GyroEarthRotation.dormant(), np.full(3, EARTH_RATE)
        earth, spread = unknown if latitude is None else GyroEarthRotation.at(latitude)
        imu = jax.tree.map(np.asarray, start.imu).with_effects(earth)
        prior = Prior.of_effects(imu, {earth.name: spread})
        assert prior is not None
        for _ in range(_ROUNDS):
            found = fit(imu, measurement, without_equipment_or_effects, prior=prior, follow=True)
            require_solved(found, recording.name)
            imu = jax.tree.map(np.asarray, found.model)
            followed, names = _followed(measurement, imu, prior, gravity, start)
            matched = _matched(measurement, followed)
            if matched is None:
                break
            measurement = matched
    assert start.observations is not None and start.nominal is not None
    before = residual_rms(start.nominal, start.observations)
    after = residual_rms(imu.with_effects(), start.observations)
    calibration = concluded(
        found, gravity=gravity, method="filter", loss="linear", excess_names=measurement.excess_names,
        rms={name: (before[name][0], value, unit) for name, (value, unit) in after.items()}, data=start.data,
        notes=[*ready.notes, *(each.text for each in findings), *start.notes, *notes, *noise.notes],
        observations=start.observations, segmentations=start.segmentations, nominal=start.nominal,
    )  # fmt: skip
    weak = tuple(
        each
        for each in calibration.weak
        if not all(str(name).startswith("gyroscope.effects") for name, _ in each.parameters)
    )
    history = _history(measurement, followed, names, imu)
    states = ["attitude", "velocity", *(f"{triad} drift, {time:.3g} s" for time in measurement.errors.correlation_time
                                        for triad in ("gyroscope", "accelerometer"))]  # fmt: skip
    summary = {
        "states": [*states, *names, "gravity"],
        "noise": _scaled_noise(measurement.errors, noise, float(found.excess[0])),
        "nis": float(history.innovations.sum() / history.freedom.sum()),
        "open": [each.text for each in weak],
    }
    return replace(calibration, weak=weak, filter=summary), history


def _scaled_noise(errors: Disturbances, noise: NoiseModel, excess: float) -> dict[str, float]:
    """Return how much larger the variances in rests and in motion were than the noise says, misfit included."""
    white = merged_drift(noise, SHORTEST, DRIFTS)[0]
    return {
        "rest": (1 + excess) * float(np.mean(np.asarray(errors.rest) / white)),
        "motion": (1 + excess) * float(np.mean(np.asarray(errors.white) / white)),
    }


def _followed(
    measurement: IntervalsOfMotion, imu: Imu, prior: Prior, gravity: LocalGravity, start: Calibration
) -> tuple[Followed, tuple[Name, ...]]:
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


def _matched(measurement: IntervalsOfMotion, followed: Followed) -> IntervalsOfMotion | None:
    """Return the measurement with the noise that innovations show, in rests and of velocity after motion, or None.

    The noise within rests may not tell what differs from rest to rest, nor how far velocity is off where motion ends.
    """
    rest, arrival = (np.asarray(each) > 0 for each in (measurement.intervals.rest, measurement.intervals.arrival))
    first = np.roll(arrival, 1)
    shares = []
    for kind in (rest & ~first, arrival):
        freedom = max(followed.freedom[kind].sum(), 1.0)
        shares.append(float(followed.innovations[kind].sum() / freedom))
    shares = [max(each, 0.25) for each in shares]
    if all(abs(each - 1) < _MATCHED for each in shares):
        return None
    errors = measurement.errors
    scaled = replace(errors, rest=errors.rest * shares[0], arrival=errors.arrival * np.sqrt(shares[1]))
    return replace(measurement, errors=scaled)


def _history(measurement: IntervalsOfMotion, followed: Followed, names: tuple[Name, ...], imu: Imu) -> History:
    intervals = measurement.intervals
    real = np.asarray(intervals.real) > 0
    time = (np.asarray(intervals.time).max(axis=1))[real]
    index = list(Parameters.select(imu, without_equipment_or_effects).index)
    values = followed.values[real, :-1] + flatten(imu)[index]
    drift = followed.states[real, 6:].reshape(len(time), -1, 6).sum(axis=1)
    spread = np.sqrt((followed.state_sigmas[real, 6:] ** 2).reshape(len(time), -1, 6).sum(axis=1))
    return History(
        time, (np.asarray(intervals.rest) > 0)[real], names, values, followed.sigmas[real, :-1], drift, spread,
        followed.innovations[real], followed.freedom[real],
    )  # fmt: skip
