"""A vehicle that stops: the gyroscope's bias, how the unit is mounted against the horizontal, and where forward is.

At a stop the gyroscope's mean is its bias and the Earth's rotation, and the mean force points up but for the slope of
the road. Slopes differ from stop to stop, and their scatter is the uncertainty of the mean. In the seconds after a stop
and before one the force less that at the stop adds up to a speed along the vehicle, forward after most stops: the
direction in the horizontal plane along which these speeds lie best, in the sense of least squares, is the vehicle's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from jaximu.calibration.calibration import Calibration, provenance
from jaximu.calibration.filter_history import History
from jaximu.calibration.nominal import as_stated
from jaximu.data.drift import about_biases, estimated_drift
from jaximu.estimation.data import OutputMeans
from jaximu.estimation.information_filter import Knowledge, WhiteRows, advance, estimate
from jaximu.estimation.problem import Name
from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.ground.distributions import rms, student_isf
from jaximu.ground.document import Json
from jaximu.ground.gravity import LocalGravity
from jaximu.ground.quantities import Z95
from jaximu.ground.rotation import unit_vectors
from jaximu.ground.tracing import on_host
from jaximu.ground.vectors import lengths_of, means_by_group, sigmas_of, variances_of
from jaximu.model.effects.earth_rotation import EARTH_RATE, GyroEarthRotation
from jaximu.model.noise_model import NoiseModel
from jaximu.recordings.recording import Signal
from jaximu.recordings.segmentation import Segmentation, rest_statistics

_SECONDS, _STRAIGHT = 4.0, np.radians(30.0)
"""Seconds after and before a stop whose speeds show where forward is, while the vehicle turns by less than this."""
_FEWEST_STOPS, _WIDEST, _ONE_WAY = 3, np.radians(20.0), 0.5
"""Stops that a direction needs, half its 95 % interval up to which it counts as determined, and the least by
which squared speeds one way exceed those the other way, over all, for it to be called forward."""
_ELSEWHERE = 15.0
"""Seconds of motion after which the slope of the road counts as another one."""
_BROAD = 0.5
"""rad/s: one sigma of the gyroscope's bias before the first stop."""
_MOST = 200
"""Stops, the longest, of which the bias is estimated: more take minutes and show little more."""
_SHORTEST = 1e-9
"""Share of a drift's size that a step drives it by at the least."""
_STEP = 1e-5
"""rad by which axes are turned to see how their angles follow."""
_OPEN = (
    "Gyroscope scale and misalignment: a vehicle turns about the vertical, and nothing here measures how far.",
    "Accelerometer scale, misalignment and bias: all stops have one orientation. A bias tilts the mounting, by 0.6° "
    "for 0.1 m/s², which its interval does not contain.",
)


@dataclass(frozen=True)
class _Rate:
    """The gyroscope's bias (3,) and its covariance after the recording, in output units; and what goes with it.

    change, change_sigma (3,): of the bias over the recording, rad/s. left (P, 3): of each stop's mean, rad/s.
    """

    bias: FloatArray
    covariance: FloatArray
    sigma_recording: FloatArray
    change: FloatArray
    change_sigma: FloatArray
    left: FloatArray
    excess: FloatArray
    notes: tuple[str, ...]


def calibrate_at_stops(
    stops: Segmentation, gravity: LocalGravity, known: NoiseModel | None = None
) -> tuple[Calibration, History]:
    """Calibrate a gyroscope by the stops of a vehicle, and find how the unit is mounted in it.

    **Arguments:** `gravity`: with its latitude where that is known, which takes the vertical part of the Earth's
    rotation off the bias. `known`: the unit's noise; else noise and drift are estimated from the stops.

    **Returns:** a calibration of the gyroscope's bias alone, with `filter` {states, nis, open, vehicle}, and how a
    filter comes to know the bias from stop to stop.
    """
    recording, signals = stops.recording, stops.recording.signals
    accelerometer, gyroscope = recording.accelerometer, signals["gyroscope"]
    force = rest_statistics(accelerometer, stops.intervals)[1] - accelerometer.nominal_offset
    force /= accelerometer.nominal_scale
    # after a few seconds of motion a vehicle stands on the same slope again
    sites = np.append(0, (stops.intervals[1:, 0] - stops.intervals[:-1, 1] > _ELSEWHERE).cumsum())
    up = unit_vectors(unit_vectors(means_by_group(sites, force)).mean(axis=0))
    earth, spread = _earth(up, gravity.latitude)
    longest = np.sort((-np.diff(stops.intervals)[:, 0]).argsort()[:_MOST])
    rate, history = _rate(gyroscope, stops.intervals[longest], earth, known)
    scale = gyroscope.nominal_scale
    felt = scale[:, None] * spread * scale  # of the Earth's rotation, the same throughout
    nominal = as_stated(recording)
    unit = replace(nominal, gyroscope=replace(nominal.triad("gyroscope"), bias=rate.bias))
    bias = (rate.bias - gyroscope.nominal_offset) / scale
    calibration = Calibration(
        imu=on_host(unit),
        names=history.names,
        covariance=rate.covariance + felt,
        gravity=gravity,
        method="filter",
        loss="linear",
        rms={"static_gyroscope": (rms(rate.left + bias), rms(rate.left), "rad/s")},
        rank=3,
        weak=(),
        excess={"gyroscope": float(rate.excess[0])},
        solver="",
        data=provenance([recording]) | {"stops": len(force)},
        notes=tuple(dict.fromkeys((*recording.notes, *stops.notes, *rate.notes))),
        segmentations=(stops,),
        nominal=nominal,
        absent=("accelerometer",),
        reading=recording.reading,
        bias_sigma_recording={"gyroscope": np.sqrt(rate.sigma_recording**2 + np.diag(felt))},
    )
    vehicle = _mounted(stops, sites, force, up, bias, gravity)
    vehicle["bias_change"] = _entry(rate.change, rate.change_sigma, "rad/s")
    vehicle["earth_rotation"] = {"vertical_removed": gravity.latitude is not None}
    summary = {
        "states": ["gyroscope drift", *map(str, history.names)],
        "nis": float(history.innovations.sum() / history.freedom.sum()) if len(force) > 1 else None,
        "open": [*_OPEN, *_undetermined(vehicle)],
        "vehicle": vehicle,
    }
    return replace(calibration, filter=summary), history


def _undetermined(vehicle: Json) -> list[str]:
    slope = "Slope of the road: stops at one site do not show it, so the mounting has no interval. Stop elsewhere, too."
    direction = (
        "Direction of driving: what the unit felt in driving off and braking does not agree on one. Drive off and "
        "brake briskly on straight, level road, forwards, five times or more."
    )
    return [slope] * (vehicle["roll"]["sigma"] is None) + [direction] * (vehicle["forward"] is None)


# --- the gyroscope ----------------------------------------------------------------------------------------------------


def _earth(up: FloatArray, latitude: float | None) -> tuple[FloatArray, FloatArray]:
    """Return the Earth's rotation (3,) that a unit of unknown heading feels, and its covariance (3, 3), rad/s."""
    if latitude is None:
        return np.zeros(3), EARTH_RATE**2 / 3 * np.eye(3)
    effect, spread = GyroEarthRotation.at(latitude)
    along = np.outer(up, up)
    covariance = spread[0] ** 2 * (np.eye(3) - along) + spread[2] ** 2 * along
    return float(effect.coefficients[2]) * up, covariance


def _rate(
    gyroscope: Signal, intervals: FloatArray, earth: FloatArray, known: NoiseModel | None
) -> tuple[_Rate, History]:
    """Return the bias by generalised least squares over the stops (P, 2), and a filter's way to it."""
    start, stop = intervals.T
    count, scale = len(start), gyroscope.nominal_scale
    _, mean, measured = rest_statistics(gyroscope, intervals)
    names = tuple(Name("gyroscope", "bias", (axis,)) for axis in range(3))
    ones = np.tile(np.eye(3), (count, 1))
    reaction = {"gyroscope": np.eye(3 * count).reshape(3 * count, count, 3)}
    variance = {"gyroscope": variances_of(measured)}
    means = OutputMeans.of(start, stop, np.zeros(count, int), reaction, {"gyroscope": scale}, variance)
    values = (mean - scale * earth).ravel()
    white = scipy.linalg.block_diag(*measured)
    notes: tuple[str, ...] = ()
    if known is None:
        shown = estimated_drift(values, ones, white, [np.diag(np.diag(white))], means)
        covariance, noise, excess, notes = shown.covariance, shown.noise, shown.excess, shown.notes
    else:
        assert known.gyroscope is not None
        slow = known.gyroscope.covariance(start, stop) * (scale**2)[:, None, None]
        covariance, noise, excess = np.zeros((count, 3, count, 3)), known, np.zeros(1)
        covariance[:, range(3), :, range(3)] = slow
        covariance, notes = covariance.reshape(3 * count, -1), known.notes
    bias, inverse, reactions = _least_squares(values, ones, covariance)
    after, sigmas = about_biases(names, inverse, reactions, means, noise)
    left = (values - ones @ bias).reshape(-1, 3) / scale
    middle = ((start + stop) / 2).repeat(3)[:, None]
    moved, moved_covariance, _ = _least_squares(values, np.hstack([ones, ones * (middle - middle.mean())]), covariance)
    length = float(stop[-1] - start[0])
    change, change_sigma = (length * part / scale for part in (moved[3:], sigmas_of(moved_covariance)[3:]))
    if count < 3:
        change, change_sigma = np.full((2, 3), np.nan)
    trend = scale**2 * np.maximum(change**2 - (Z95 * change_sigma) ** 2, 0.0)
    after += np.diag(np.nan_to_num(trend))  # what changed beyond chance may go on changing
    rate = _Rate(bias, after, sigmas["gyroscope"], change, change_sigma, left, excess, notes)
    return rate, _followed(names, start, stop, values.reshape(-1, 3), variance["gyroscope"], noise, scale)


def _least_squares(
    values: FloatArray, design: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the numbers (p,) that explain values (n,) best, their covariance, and how they react to values (p, n)."""
    weighted = np.linalg.solve(covariance, design).T
    inverse = np.linalg.pinv(weighted @ design)
    reactions = inverse @ weighted
    return reactions @ values, np.asarray(inverse, float), reactions


def _followed(
    names: tuple[Name, ...],
    start: FloatArray,
    stop: FloatArray,
    values: FloatArray,
    variance: FloatArray,
    noise: NoiseModel,
    scale: FloatArray,
) -> History:
    """Return how a filter follows the bias with its drift from stop to stop, by their means `values` (P, 3)."""
    assert noise.gyroscope is not None
    drift, count = noise.gyroscope.drift(), len(start)
    size = 3 * len(drift.correlation_time)
    spread = np.maximum(np.sqrt(drift.variance.T) * scale, _SHORTEST * scale).ravel()
    states = np.tile(np.eye(3), size // 3)
    known = Knowledge(np.diag([*1 / spread, *1 / (_BROAD * scale)]), np.zeros(size + 3))
    estimates, sigmas, drifts, innovations = [], [], [], []
    gaps = np.diff((start + stop) / 2, prepend=-np.inf)
    for gap, value, sigma in zip(gaps, values, np.sqrt(variance), strict=True):
        kept = np.exp(-gap / drift.correlation_time).repeat(3)
        driven = 1 / (spread * np.sqrt(np.maximum(1 - kept**2, _SHORTEST)))
        rows = WhiteRows(
            np.pad(np.diag(-driven * kept), ((0, 3), (0, 0))),
            np.vstack([np.diag(driven), states / sigma[:, None]]),
            np.pad(np.diag(1 / sigma), ((size, 0), (0, 0))),
            np.pad(value / sigma, (size, 0)),
        )
        known, _, innovation = advance(known, rows)
        estimated, covariance = estimate(known)
        whole = np.hstack([states, np.eye(3)])
        estimates.append(whole @ estimated)
        sigmas.append(sigmas_of(whole @ covariance @ whole.T))
        drifts.append([states @ estimated[:size], sigmas_of(states @ covariance[:size, :size] @ states.T)])
        innovations.append(innovation)
    of_rate = np.pad(np.array(drifts).swapaxes(0, 1) / scale, ((0, 0), (0, 0), (0, 3)))
    resting, freedom = np.ones(count, bool), np.where(np.arange(count) > 0, 3.0, 0.0)
    innovations = np.where(freedom > 0, innovations, 0.0)
    return History(
        stop, resting, names, np.array(estimates), np.array(sigmas), of_rate[0], of_rate[1], innovations, freedom, ()
    )


# --- the mounting -----------------------------------------------------------------------------------------------------


def _mounted(
    stops: Segmentation,
    sites: IntArray,
    force: FloatArray,
    up: FloatArray,
    bias: FloatArray,
    gravity: LocalGravity,
) -> Json:
    """Return how a unit is mounted in the vehicle, by the force (P, 3) at its stops and the speeds beside these.

    **Arguments:** `sites` (P,): of the stops; `bias` (3,): of the gyroscope, rad/s.
    """
    across = np.linalg.svd(up[None])[2][1:]
    across[1] = np.cross(up, across[0])
    tilts = unit_vectors(force) @ across.T
    different = means_by_group(sites, tilts)
    covariance = _of_mean(different)
    sides, speeds = _speeds(stops, force, across, up, bias)
    forward, sigma, alike = _forward(sides, speeds)
    determined = Z95 * sigma < _WIDEST and alike > _ONE_WAY
    ahead = forward @ across
    axes = np.stack([ahead, np.cross(up, ahead), up])  # the vehicle's, in the unit: Rz(yaw) Ry(pitch) Rx(roll)
    rotation = scipy.spatial.transform.Rotation
    turns = rotation.from_rotvec(_STEP * np.vstack([np.zeros(3), across, up, -across, -up]))
    angles, *moved = (rotation.from_matrix(axes) * turns).as_euler("ZYX")[:, ::-1]
    slopes = (np.array(moved[:3]) - moved[3:]).T / (2 * _STEP)
    quarter = np.array([[0.0, 1.0], [-1.0, 0.0]])  # a turn about one direction moves up along the other
    whole = scipy.linalg.block_diag(quarter @ covariance @ quarter.T, np.nan_to_num(sigma) ** 2)
    sigmas = sigmas_of(slopes @ whole @ slopes.T)
    roll, pitch, yaw = (_entry(*pair, "rad") for pair in zip(angles, sigmas, strict=True))
    norm = lengths_of(force)
    scatter = _of_mean(norm[:, None])
    return {
        "stops": [
            {"start": float(begin), "stop": float(end), "tilt": tilt.tolist()}
            for (begin, end), tilt in zip(stops.intervals, tilts @ (axes[:2] @ across.T).T, strict=True)
        ],
        "seconds": float(np.diff(stops.intervals).sum()),
        "up": up.tolist(),
        "forward": ahead.tolist() if determined else None,
        "roll": roll,
        "pitch": pitch,
        "yaw": yaw if determined else None,
        "slope": None if len(different) < 2 else float(np.sqrt(different.var(axis=0, ddof=1).sum())),
        "speeds": [
            {"stop": int(side), "along": float(along), "left": float(left)}
            for side, (along, left) in zip(sides, speeds @ across @ axes[:2].T, strict=True)
        ],
        "forward_share": (1 + alike) / 2 if determined else None,
        "norm_error": _entry(norm.mean() - gravity.value, np.hypot(np.sqrt(scatter[0, 0]), gravity.sigma), "m/s^2"),
    }


def _of_mean(values: FloatArray) -> FloatArray:
    """Return the covariance of the mean of values (n, k), widened so that 1.96 of its sigmas hold 95 %; NaN of one."""
    count, size = values.shape
    if count < 2:
        return np.full((size, size), np.nan)
    widened = student_isf(0.025, count - 1) / Z95
    return widened**2 / count * np.atleast_2d(np.cov(values.T))


def _speeds(
    stops: Segmentation, force: FloatArray, across: FloatArray, up: FloatArray, bias: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Return the stop beside each speed (n,), and speeds (n, 2), m/s, along `across` (2, 3), as if driven forwards.

    Speeds are gained after a stop and lost before one. The gyroscope carries the axes in which they add up, so that
    turning is no speed to the side.
    """
    recording, intervals = stops.recording, stops.intervals
    accelerometer, gyroscope = recording.accelerometer, recording.signals["gyroscope"]
    time, sensed = accelerometer.time, accelerometer.si()
    heading = ((gyroscope.si() - bias) @ up * np.gradient(gyroscope.time)).cumsum()
    course = np.exp(1j * np.interp(time, gyroscope.time, heading))
    step = np.gradient(time)
    edges = [time[0], *((intervals[1:, 0] + intervals[:-1, 1]) / 2), time[-1]]
    sides, speeds = [], []
    for number, (start, stop) in enumerate(intervals):
        before = -1, max(edges[number], start - _SECONDS), start
        after = 1, stop, min(edges[number + 1], stop + _SECONDS)
        for sign, first, last in (before, after):
            rows = np.flatnonzero((time >= first) & (time < last))[::sign]
            turned = abs(np.angle(course[rows] / course[rows[:1]])) > _STRAIGHT
            rows = rows[: int(turned.argmax()) if turned.any() else None]
            if last - first > 1.0 and len(rows):
                gained = (sensed[rows] - force[number]) @ across.T @ np.array([1.0, 1j])
                speed = sign * (gained * step[rows] * course[rows]).sum() / course[rows[-1]]
                sides.append(number)
                speeds.append([speed.real, speed.imag])
    return np.array(sides, int), np.array(speeds).reshape(-1, 2)


def _forward(sides: IntArray, speeds: FloatArray) -> tuple[FloatArray, float, float]:
    """Return the direction (2,) along which speeds (n, 2) lie, its sigma (rad) or NaN, and how one-sided they are.

    The last is the sum of squared speeds one way less that of those the other way, over that of all: backwards is
    slow. Speeds beside one stop share its slope, so the scatter that counts is that of stops.
    """
    if not len(speeds):
        return np.array([1.0, 0.0]), np.nan, 0.0
    direction = np.linalg.svd(speeds, full_matrices=False)[2][0]
    direction *= np.sign(speeds.sum(axis=0) @ direction) or 1.0
    along, across = speeds @ direction, speeds @ np.array([-direction[1], direction[0]])
    alike = float((along * abs(along)).sum() / (along**2).sum())
    pulls = np.bincount(sides, along * across)[np.unique(sides)]
    if (count := len(pulls)) < _FEWEST_STOPS:
        return direction, np.nan, alike
    scatter = np.sqrt((pulls**2).sum() * count / (count - 1)) / (along**2).sum()
    return direction, float(scatter * student_isf(0.025, count - 1) / Z95), alike


def _entry(value: Any, sigma: Any, unit: str) -> Json:
    """Return a number, or several, with what it is known to, as the JSON document has it; not finite ones are null."""

    def plain(number: Any) -> Any:
        return np.asarray(number, float).tolist() if np.isfinite(number).all() else None

    return {"value": plain(value), "sigma": plain(sigma), "unit": unit}
