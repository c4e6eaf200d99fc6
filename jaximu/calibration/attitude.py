"""Calibration against a measured attitude on its own clock: optics, an inertial system, a robot, a tracker."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy

from jaximu.calibration.arrangement import arrangement
from jaximu.calibration.calibration import Calibration, concluded, effect_named, notes_of, provenance
from jaximu.calibration.nominal import as_stated
from jaximu.calibration.recipe import errors_of
from jaximu.calibration.refusals import require_determined
from jaximu.data.attitude import EXCESS_NAMES, AgainstAttitude, reference_sigmas
from jaximu.data.field import white_noise
from jaximu.estimation.fitting import Prior, fit
from jaximu.estimation.problem import Loss, Name, without_equipment_or_effects
from jaximu.estimation.uncertainty import station_advice
from jaximu.ground.array_types import Array, FloatArray
from jaximu.ground.differences import interpolated, midpoints
from jaximu.ground.document import Json
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import STANDARD, Gravity, as_gravity
from jaximu.ground.rotation import UP
from jaximu.ground.tracing import on_host
from jaximu.ground.vectors import column_lengths, dot_rows, lengths_of, sigmas_of, submatrix
from jaximu.mistakes import Prepared, prepared
from jaximu.model.effects import Effect
from jaximu.model.effects.reference_delay import SetupReferenceDelay
from jaximu.model.effects.reference_filter import SetupReferenceFilter
from jaximu.model.mounting import MOUNTING_EFFECTS, Mounting
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.noise.at_rest import noise_of
from jaximu.recordings.alignment import signed_permutation, turning_best
from jaximu.recordings.attitude import Attitude
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.reference import Integral

_NEAR = 10.0
"""Seconds within which the reference's clock is believed, unless another offset explains far more."""
_APART = 1e6
"""Seconds between both first stamps from which on one does not count from the same zero: both begin together."""
_NEARLY, _SEPARATE, _DELAYS = 0.8, 0.5, 8
"""Share of the best likeness that another delay may have, seconds between two, and how many are tried besides."""
_ALIKE = 0.5
"""Share of the unit's rotation that the reference must explain."""
_CLEAR = 0.9
"""Share of rotation and gravity from which on no other way of reading a reference is tried."""
_BACK, _LAST = np.array([1.0, -1.0, -1.0, -1.0]), [3, 0, 1, 2]
_LEAST = np.radians(3.0)
"""rad/s, rms: a reference that turns less stands still."""
_AGAINST, _CHANCE = 0.5, 4.0
"""Correlation beyond which velocities that run against the felt force are taken to be turned round, and how many of its
standard deviations by chance that must be."""
_BLOCK, _LONGER, _FEWEST = 16, 32, 8
"""Mean rates and samples to a block, and blocks that are needed to see how much noise is left in the quiet ones."""
_CLOSER = 0.3
"""Share of the noise's variance below which a reference is no other than the unit itself."""


@dataclass(frozen=True)
class _Start:
    """A coarse alignment: the reference as it is to be read, its delay (s), the matrix from its body to the unit.

    explained: share of the unit's rotation; upright: cosine between the forces measured and the reference's vertical.
    arranged (3, 3): the gyroscope's axes as read, in multiples of the accelerometer's.
    """

    attitude: Attitude
    delay: float
    matrix: FloatArray
    explained: float
    upright: float
    arranged: FloatArray = field(default_factory=lambda: np.eye(3))

    @property
    def score(self) -> float:
        """Share of the rotation and of gravity that this reading explains."""
        return self.explained * max(self.upright, 0.0)


def calibrate_against_attitude(
    recording: Recording | Prepared,
    attitude: Attitude,
    gravity: Gravity = STANDARD,
    *,
    static: Recording | NoiseModel | None = None,
    effects: Sequence[str | Effect] = (),
    effect_sigmas: Mapping[str, float] | None = None,
    loss: Loss = "linear",
    repair: bool = False,
    unit: Imu | None = None,
) -> tuple[Calibration, AgainstAttitude]:
    """Calibrate a unit against a measured attitude; how the reference is mounted, and late, is estimated with it.

    **Arguments:** `recording`: accelerometer and gyroscope; `attitude`: on its own stamps, counted from
    `recording.start` where both are absolute; `gravity`, `static`, `effects`, `effect_sigmas`, `loss`, `repair` as
    for [`jaximu.calibrate`]; `unit`: to keep its gains and effects, so that its biases alone, and how the reference is
    mounted, are estimated.

    **Returns:** the calibration, in axes in which the accelerometer's gain is lower triangular, and what it was fitted
    to. Its `reference` has rotation, time offset, clock scale and what stays open.

    Raises `InputError` where the reference does not overlap the recording or is none, `NotPossibleError` where it
    stands still, moves otherwise than the unit, or determines next to nothing.
    """
    gravity = as_gravity(gravity)
    if "gyroscope" not in recording.signals:
        raise InputError(f"{recording.name}: a reference attitude calibrates a gyroscope, and there is none.")
    noise = noise_of(static)
    with prepared_against(recording, attitude, repair) as (ready,):
        recording = ready.recording
        start = _coarse(recording, attitude.usable())
        start = replace(start, attitude=_right_handed(recording, start))
        measurement = AgainstAttitude(recording, start.attitude, gravity.value, noise)
        imu = _begin(recording, start, list(map(effect_named, effects)), unit)
        prior, of_setup = Prior.of_effects(imu, effect_sigmas), _of_setup(imu)

        def free(name: Name) -> bool:
            return without_equipment_or_effects(name) if unit is None else name.part == "bias" or of_setup(name)

        fitted = fit(imu, measurement, free, prior=prior, loss=loss)
        require_determined(fitted, recording.name, f"{attitude.name} shows too few turns, which", _RECORD, prior)
    calibration = concluded(
        fitted,
        gravity=gravity,
        method="reference",
        loss=loss,
        advice=station_advice,
        excess_names=EXCESS_NAMES,
        rms=[errors_of([measurement], unit) for unit in (imu, fitted.imu)],
        known=list(filter(of_setup, fitted.names)),
        data=provenance([recording]) | {"reference": attitude.name, "intervals": int(measurement.intervals.used.sum())},
        notes=[*_same_unit(recording, start, fitted.imu), *notes_of(ready, recording, start.attitude, noise)],
        nominal=imu.with_effects(),
        reading=recording.reading,
    )
    calibration = replace(calibration, covariance=calibration.covariance + _of_shape(calibration, measurement))
    notes = (*(finding.text for finding in arrangement(recording, calibration)), *calibration.notes)
    calibration = replace(calibration, notes=tuple(dict.fromkeys(notes)), reference=reference_summary(calibration))
    return calibration, measurement


def prepared_against(
    recording: Recording | Prepared, attitude: Attitude, repair: bool
) -> AbstractContextManager[tuple[Prepared, ...]]:
    """Return a recording that was looked over; its repairs are tried by how well it turns as the reference does."""
    return prepared([recording], repair, misfit=lambda tried: 1 - _coarse(tried, attitude.usable()).explained)


@dataclass(frozen=True)
class Mounted:
    """A reference as it stands to a unit.

    attitude: as it is to be read, without its own smoothing, on the recording's zero of time. mounting: of it, and
    effects: that say so to a unit. sigmas: of its attitude (rad) and velocity (m/s), each axis. summary: what
    `calibration.json` says of it.
    """

    attitude: Attitude
    mounting: Mounting
    effects: tuple[Effect, ...]
    sigmas: tuple[float, float]
    summary: Mapping[str, Any]


def mounted_on(
    recording: Recording, attitude: Attitude, gravity: Gravity, noise: NoiseModel | None, known: Calibration
) -> Mounted:
    """Return how a reference stands to a unit, as `calibrate_against_attitude` finds it, with its gains where known.

    Raises as that does.
    """
    unit = known.imu if known.gains_determined() else None
    calibration, how = calibrate_against_attitude(recording, attitude, gravity, static=noise, unit=unit)
    sharp_unit = calibration.imu.without(SetupReferenceFilter)
    effects = tuple(effect for effect in sharp_unit.all_effects().values() if isinstance(effect, MOUNTING_EFFECTS))
    assert calibration.reference is not None
    still, fast = reference_sigmas(calibration.excess)
    sharp = how.unsmoothed(calibration.imu)
    if (velocity := sharp.velocities()) is not None:  # few windows of force show it, its samples more
        fast = max(fast, white_noise(Signal(sharp.time, velocity, "m/s")))
    return Mounted(sharp, Mounting.of(sharp_unit), effects, (still, fast), calibration.reference)


_RECORD = "Turn the unit about each of its axes, both ways, and hold each axis up and down for a while."


def _of_setup(imu: Imu) -> Callable[[Name], bool]:
    """Return whether a number is the set-up's, the lever arm included."""
    fixture = {key for key, effect in imu.all_effects().items() if effect.scope == "fixture"}
    return lambda name: name.owner == "setup" or name.key in fixture


def _of_shape(calibration: Calibration, measurement: AgainstAttitude) -> FloatArray:
    """Return what the covariance (p, p) of the numbers lacks: filters of one variance are not late by one time.

    In the third order a filter's delay depends on the motion, and on more than its variance: the delay is uncertain by
    what a first-order lag of that variance has.
    """
    data, imu = measurement.intervals, calibration.imu
    matrix = np.asarray(imu.triad("gyroscope").inverse())
    rate, slope = data.rate @ matrix[:, :3].T + matrix[:, 3], data.slope @ matrix[:, :3].T
    delay = abs(float(Mounting.of(imu).filter_variance)) ** 1.5 / 3 * (slope**2).sum() / (rate**2).sum()
    effects = imu.all_effects()
    delayed = [isinstance(effects.get(name.key), SetupReferenceDelay) for name in calibration.names]
    return delay**2 * np.diag(delayed)


def _begin(recording: Recording, start: _Start, effects: Sequence[Effect], unit: Imu | None) -> Imu:
    """Return the unit, the data sheet's if None, under the reference as it was coarsely aligned."""
    turned = scipy.spatial.transform.Rotation.from_matrix(start.matrix.T).as_rotvec()
    arm = {} if start.attitude.velocities() is None else {"lever_arm": 0.0}
    setup = Mounting.effects(rotation=turned, delay=start.delay, tilt=0.0, filter_variance=0.0, clock_scale=0.0, **arm)
    imu = as_stated(recording) if unit is None else unit.transferable()
    if unit is None and imu.gyroscope is not None:
        imu = replace(imu, gyroscope=replace(imu.gyroscope, gain=np.asarray(imu.gyroscope.gain) @ start.arranged))
    by_name = {effect.name: effect for effect in (*setup, *imu.all_effects().values(), *effects)}
    return on_host(imu.with_effects(*by_name.values()))


def later_zero(start: float, other: float) -> float:
    """Return how much later (s) one zero of time is than another; none where the two are not on one clock."""
    later = start - other
    return later if abs(later) < _APART else 0.0


def fitted_mounting(imu: Imu, names: Sequence[Name], covariance: Array) -> tuple[Mounting, Mounting]:
    """Return a unit's mounting, and the covariance (q, q) of each of its fields; zero where it was not fitted."""
    effects = imu.all_effects()

    def of(kind):
        rows = [row for row, name in enumerate(names) if isinstance(effects.get(name.key), kind)]
        return submatrix(covariance, rows) if rows else np.zeros((kind.size, kind.size))

    return Mounting.of(imu), Mounting(*map(of, MOUNTING_EFFECTS))


def reference_summary(calibration: Calibration) -> Json:
    """Return what `calibration.json` says of the reference; the lever arm is from it to the unit, in its axes."""
    mounting, covariance = fitted_mounting(calibration.imu, calibration.names, calibration.covariance)
    turned = scipy.spatial.transform.Rotation.from_rotvec(mounting.rotation)
    matrix = turned.as_matrix()
    arm = {
        "value": (matrix @ mounting.lever_arm).tolist(),
        "sigma": sigmas_of(matrix @ covariance.lever_arm @ matrix.T).tolist(),
        "unit": "m",
    }
    return {
        "rotation": turned.inv().as_quat(canonical=True, scalar_first=True).tolist(),
        "time_offset": {"value": float(mounting.delay), "sigma": float(np.sqrt(covariance.delay[0, 0])), "unit": "s"},
        "clock_scale": 1.0 + float(mounting.clock_scale),
        "filter": {
            "variance": float(mounting.filter_variance),
            "sigma": float(np.sqrt(covariance.filter_variance[0, 0])),
            "unit": "s^2",
        },
        "lever_arm": arm if covariance.lever_arm.any() else None,
        "residual_rms": {name: {"value": after, "unit": unit} for name, (_, after, unit) in calibration.rms.items()},
        "open": [weak.text for weak in calibration.weak],
    }


# --- coarse alignment -------------------------------------------------------------------------------------------------


def _coarse(recording: Recording, attitude: Attitude) -> _Start:
    """Find the reference's delay and mounting, and whether its quaternions run the other way or have w last."""
    gyroscope = recording.signals["gyroscope"]
    name = recording.name
    attitude = replace(attitude, time=attitude.time + later_zero(attitude.start, recording.start))
    span = gyroscope.time[[0, -1]]
    if attitude.time[0] > span[1] or attitude.time[-1] < span[0]:
        raise InputError(
            f"{attitude.name} lies from {attitude.time[0]:.6g} to {attitude.time[-1]:.6g} s and {name} from "
            f"{span[0]:.6g} to {span[1]:.6g} s: they do not overlap. Put both on one clock, or let both begin at zero."
        )
    speeds = lengths_of(attitude.turned()) / np.diff(attitude.time)
    rate, good = np.sqrt(np.nanmean(speeds**2)), ~np.isnan(speeds)
    if rate < _LEAST:
        raise NotPossibleError(f"{attitude.name} hardly turns ({np.degrees(rate):.2g} °/s, rms): {_RECORD}")
    delay, *others = delays_of_speeds(gyroscope, midpoints(attitude.time)[good], speeds[good], attitude.period)
    plain = _matched(recording, attitude, delay)
    for other in others:  # turns at regular times, as a robot makes them, look alike but for their axes
        if plain.score > _CLEAR:
            break
        match = _matched(recording, attitude, other)
        delay, plain = (other, match) if match.score > plain.score + 0.02 else (delay, plain)
    if plain.score > _CLEAR:
        return plain
    q, last = attitude.quaternion, attitude.quaternion[:, _LAST]
    readings = {
        "": q,
        "its quaternions run from the upright frame to the body and were taken so": q * _BACK,
        "its quaternions have w last and were taken so": last,
        "its quaternions have w last and run from the upright frame to the body, and were taken so": last * _BACK,
    }
    best = plain
    for text, values in readings.items():
        notes = attitude.notes + ((f"{attitude.name}: {text}.",) if text else ())
        changed = replace(attitude, quaternion=values, notes=notes).usable()
        for reading in (changed, _turned_up(changed)):
            match = _matched(recording, reading, delay)
            best = match if match.score > best.score + 0.02 else best
    if best.score < _CLEAR:
        best = _rearranged(recording, attitude, delay) or best
    if best.explained > _ALIKE > best.score:
        raise NotPossibleError(
            f"{attitude.name} turns as {name} does, but its frame's z axis does not point up: gravity lies "
            f"{np.degrees(np.arccos(best.upright)):.0f}° off. Turn the reference's frame, or see --axes."
        )
    if best.explained < _ALIKE:
        raise NotPossibleError(
            f"{attitude.name} and {name} do not turn alike: however the one is mounted on the other, "
            f"{100 * (1 - best.explained):.0f} % of the rotation is left. Are they of one recording, in the units and "
            "axes that their columns say (a left-handed frame explains nothing)?"
        )
    return best


def _turned_up(attitude: Attitude) -> Attitude:
    """Return a reference whose frame's z points down (north, east, down) with x, −y, −z for its axes."""
    w, x, y, z = attitude.quaternion.T
    turned = replace(attitude, quaternion=np.column_stack([-x, w, -z, y]))
    return _mirrored(
        turned, np.array([1.0, -1.0, -1.0]), "its frame's z points down; its axes were taken as x, −y, −z."
    )


def _mirrored(attitude: Attitude, signs: FloatArray, note: str) -> Attitude:
    """Return a reference whose velocity and position have some axes turned round, and say why."""
    paths = {name: getattr(attitude, name) for name in ("velocity", "position")}
    changed = {name: values * signs for name, values in paths.items() if values is not None}
    return replace(attitude, notes=(*attitude.notes, f"{attitude.name}: {note}"), **changed)


def _right_handed(recording: Recording, start: _Start) -> Attitude:
    """Return the reference with axes of its velocity and position turned round that run against the attitude's.

    Over half a second the specific force, upright, is gravity and the change of velocity; in a left-handed frame one
    axis of that has the opposite sign.
    """
    attitude = start.attitude
    if (velocity := attitude.velocities()) is None:
        return attitude
    rows = np.arange(0, len(attitude.time), max(1, round(0.5 / attitude.period)))
    inside = attitude.time[rows] - start.delay
    force = Integral(recording.accelerometer)
    rows = rows[(inside > force.edges[0]) & (inside < force.edges[-1])]
    inner = np.linspace(attitude.time[rows[:-1]], attitude.time[rows[1:]], 9, axis=1)
    stood = attitude.at(inner[:, 1:].ravel())
    parts = force.over(inner[:, :-1] - start.delay, inner[:, 1:] - start.delay).reshape(-1, 3) @ start.matrix
    felt = stood.apply(parts).reshape(len(inner), -1, 3).sum(axis=1)
    gained = np.diff(velocity[rows], axis=0)
    felt, gained = (vectors - vectors.mean(axis=0) for vectors in (felt, gained))
    alike = (felt * gained).sum(axis=0) / np.maximum(column_lengths(felt) * column_lengths(gained), 1e-300)
    signs = np.where(alike < -max(_AGAINST, _CHANCE / np.sqrt(len(inner))), -1.0, 1.0)
    if (signs > 0).all():
        return attitude
    axes = " and ".join(axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0)
    note = (
        f"its velocity or position runs against its attitude along {axes}, as in a left-handed frame; it was turned "
        "round there."
    )
    return _mirrored(attitude, signs, note)


def _same_unit(recording: Recording, start: _Start, imu: Imu) -> list[str]:
    """Warn of a reference that follows the gyroscope closer than the gyroscope's own noise would let another.

    Compared are second differences of the mean rates over a few samples, where the unit moves least: there what both
    share is noise.
    """
    gyroscope = recording.signals["gyroscope"]
    mounting = Mounting.of(imu)
    turned = scipy.spatial.transform.Rotation.from_rotvec(mounting.rotation).as_matrix()
    unit, reference, time = _rates(recording, start.attitude, float(mounting.delay))
    unit = unit @ np.linalg.inv(start.arranged).T
    count = (len(unit) - 2) // _BLOCK
    samples = np.diff(gyroscope.si(), 3, axis=0)
    quiet = len(samples) // _LONGER
    if min(count, quiet) < _FEWEST:
        return []
    moved, apart = (
        (np.diff(values, 2, axis=0)[: count * _BLOCK].reshape(count, -1) ** 2).mean(axis=1)
        for values in (unit, unit - reference @ turned)
    )
    still = moved.argsort()[: max(_FEWEST // 2, count // 10)]
    powers = (samples[: quiet * _LONGER].reshape(quiet, -1) ** 2).mean(axis=1)
    white = np.quantile(powers, 0.1) / (20 * gyroscope.rate)  # density; a third difference has 20 times the variance
    if (ratio := float(apart[still].mean() / (6 * white / np.median(np.diff(time))))) > _CLOSER:
        return []
    return [
        f"{start.attitude.name} follows the noise of the gyroscope itself ({100 * np.sqrt(ratio):.2g} % of it is left "
        "between the two): it seems to be computed from this very unit. Its errors are then the unit's own, and scales "
        "and biases found against it prove nothing: use an independent reference."
    ]


def _rates(recording: Recording, attitude: Attitude, delay: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the unit's and the reference's mean rates (n, 3) between the latter's stamps, and when (n,)."""
    gyroscope = recording.signals["gyroscope"]
    stride = max(1, round(4 / gyroscope.rate / attitude.period))
    thin = replace(
        attitude, time=attitude.time[::stride], quaternion=attitude.quaternion[::stride], velocity=None, position=None
    )
    stamps = thin.time - delay
    length = np.diff(stamps)[:, None]
    good = (stamps[:-1] > gyroscope.time[0]) & (stamps[1:] < gyroscope.time[-1])
    good &= length[:, 0] < 2.5 * stride * attitude.period
    turned = thin.turned() / length
    good &= ~np.isnan(turned).any(axis=1)
    unit = Integral(gyroscope).over(stamps[:-1], stamps[1:]) / length
    return unit[good], turned[good], midpoints(stamps)[good]


def delays_of_speeds(gyroscope: Signal, stamps: FloatArray, speeds: FloatArray, period: float) -> list[float]:
    """Return by how much (s) the stamps of another's angular speed (n,), rad/s, are late against a gyroscope's.

    The likeliest first, then others at which both are nearly as much alike.
    """
    rate = gyroscope.si()
    size = lengths_of(rate - np.median(rate, axis=0))
    step = max(period, 1 / gyroscope.rate, 5e-3)
    first, last = min(gyroscope.time[0], stamps[0]), max(gyroscope.time[-1], stamps[-1])
    grid = np.arange(first, last, step)
    count = max(1, round(step * gyroscope.rate))
    unit = np.interp(grid, gyroscope.time, np.convolve(size, np.ones(count) / count, "same"), 0.0, 0.0)
    shifted = np.interp(grid, stamps, speeds, 0.0, 0.0)
    inside = [(grid >= time[0]) & (grid <= time[-1]) for time in (gyroscope.time, stamps)]
    a, b = (
        np.where(here, values - values[here].mean(), 0.0) for values, here in zip((unit, shifted), inside, strict=True)
    )

    def against(x, y):
        return scipy.signal.correlate(y, x, mode="full", method="fft")

    measured, known = (here.astype(float) for here in inside)
    power, together = against(a**2, known) * against(measured, b**2), against(measured, known)
    enough = together > 0.3 * min(here.sum() for here in inside)
    score = np.where(enough, against(a, b) / np.sqrt(np.maximum(power, 1e-30)), -1.0)
    lags = (np.arange(len(score)) - (len(grid) - 1)) * step
    near = np.where(abs(lags) <= _NEAR, score, -1.0)
    chosen = near if near.max() > 0.7 * score.max() else score
    peaks, _ = scipy.signal.find_peaks(chosen, _NEARLY * chosen.max(), distance=max(1, round(_SEPARATE / step)))
    best = int(chosen.argmax())
    beside = sorted(peaks[abs(peaks - best) * step > _SEPARATE], key=lambda peak: -chosen[peak])
    return [float(lags[lag]) for lag in (best, *beside[:_DELAYS])]


def _matched(recording: Recording, attitude: Attitude, delay: float) -> _Start:
    """Return mounting, and delay to a fraction of a sample, that explain the unit's rates and gravity best."""
    step = max(attitude.period, 1 / recording.accelerometer.rate) / 2
    best: _Start | None = None
    for shift in np.arange(-4, 4.5) * step:
        if (common := _in_common(recording, attitude, delay + shift)) is None:
            continue
        turning, rotating, force, up = common
        weight = (turning**2).sum() / (force**2).sum()
        matrix = turning_best(turning.T @ rotating + weight * STANDARD.value * (force.T @ up))
        explained = 1 - ((turning - rotating @ matrix.T) ** 2).sum() / (turning**2).sum()
        upright = dot_rows(force, up @ matrix.T).mean() / lengths_of(force).mean()
        if best is None or explained > best.explained:
            best = _Start(attitude, float(delay + shift), matrix, float(explained), float(upright))
    if best is None:
        raise InputError(
            f"{attitude.name} and {recording.name} have less than sixteen stamps in common at the delay that fits best "
            f"({delay:.3g} s)."
        )
    return best


def _in_common(recording: Recording, attitude: Attitude, delay: float) -> tuple[FloatArray, ...] | None:
    """Return the unit's and the reference's rates about their means, the accelerometer's output and upwards in the
    reference's body, (n, 3) each, at the stamps in common; None where these are fewer than sixteen.
    """
    unit, reference, time = _rates(recording, attitude, delay)
    if len(unit) < 16:
        return None
    force = interpolated(recording.accelerometer.time, _smooth(recording), time)
    up = attitude.at(time + delay).inv().apply(UP)
    return unit - unit.mean(axis=0), reference - reference.mean(axis=0), force, up


def _rearranged(recording: Recording, attitude: Attitude, delay: float) -> _Start | None:
    """Return the alignment with the gyroscope's axes exchanged or turned round, where rates of any axes fit well.

    The accelerometer alone says how the reference is mounted, the gyroscope alone how its rates hang together with the
    reference's.
    """
    gyroscope = recording.signals["gyroscope"]
    if (common := _in_common(recording, attitude, delay)) is None:
        return None
    turning, rotating, force, up = common
    read = np.linalg.lstsq(rotating, turning, rcond=None)[0].T
    if ((turning - rotating @ read.T) ** 2).sum() > (1 - _CLEAR) * (turning**2).sum():
        return None
    mounting = turning_best(force.T @ up)
    arranged = signed_permutation((read @ mounting.T).T).T
    mapped = replace(recording, gyroscope=Signal(gyroscope.time, gyroscope.si() @ arranged, "rad/s"))
    match = _matched(mapped, attitude, delay)
    return replace(match, arranged=arranged) if match.score > _CLEAR else None


def _smooth(recording: Recording) -> FloatArray:
    """Return the accelerometer's output in SI, means over a second."""
    accelerometer = recording.accelerometer
    return scipy.ndimage.uniform_filter1d(accelerometer.si(), max(1, round(accelerometer.rate)), axis=0)
