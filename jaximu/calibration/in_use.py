"""Re-estimation in use: a causal filter that follows a calibrated unit sample by sample, in constant memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaximu.calibration.attitude import Mounted, mounted_on
from jaximu.calibration.calibration import Calibration, provenance
from jaximu.calibration.filter_history import History
from jaximu.calibration.systematic import (
    FIELD,
    disturbances,
    field_of,
    known_scale,
    noise_at_rest,
    places_of,
    require_gyroscope,
    seen_from_outside,
)
from jaximu.data.gravity_direction import level
from jaximu.data.motion import (
    FARTHEST_UNSEEN,
    LONGEST_MOTION,
    Disturbances,
    MotionIntervals,
    MotionPath,
    carried,
    first_knowledge,
    interval_rows,
)
from jaximu.data.sightings import AttitudeSeen, FieldSeen, Sighting, VelocitySeen
from jaximu.estimation.information_filter import Knowledge, WhiteRows, advance, estimate
from jaximu.estimation.problem import Parameters, flatten, unflatten
from jaximu.estimation.uncertainty import describe
from jaximu.ground import stored
from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import chi2_sf
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import LocalGravity
from jaximu.ground.precision import require_float64
from jaximu.ground.rotation import IDENTITY, rotate
from jaximu.ground.tracing import on_host
from jaximu.ground.vectors import sigmas_of
from jaximu.mistakes import Prepared, prepared
from jaximu.model.effects.earth_rotation import EARTH_RATE, GyroEarthRotation
from jaximu.model.effects.magnetic_field import SetupMagneticField
from jaximu.model.mounting import MOUNTING_EFFECTS, Mounting
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.recordings.attitude import Attitude
from jaximu.recordings.observations import POWER_ON
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.segmentation import segment

INTERVAL = 0.5
"""Seconds of an interval."""
_QUIET, _LOUD, _TURNING = 3.0, 10.0, np.radians(0.5)
"""A rest: variance up to this multiple of the noise, or of the least seen so far where a sensor hums (a line above what
its density tells) up to the second one; and rad/s that the mean rate may differ by from interval to interval."""
_WINDOW, _IMPLAUSIBLE, _LARGE = 30, 1e-6, 4.0
"""Measured intervals over which innovations are tested together; they diverge where noise gives them with less than
this probability and they are so many times as large, squared: real noise is never quite what is stated."""
_SPAN = 1.5
"""Intervals that a padded interval holds, for uneven stamps."""

_NOTHING = 0.0, 0.0, IDENTITY, None
"""What a reference says where it says nothing."""


class _Sample(NamedTuple):
    """Time (s), outputs of accelerometer and gyroscope (3,), and the magnetic field in the body frame (3,), µT."""

    time: float
    accelerometer: FloatArray
    gyroscope: FloatArray
    field: FloatArray


class FilterState(NamedTuple):
    """What the filter knows at the end of an interval. time: s; rest: whether the unit rested.

    values, sigmas (p,): of the numbers that are followed, bias with its drift; innovation: normalised, squared, of
    `freedom` degrees. attitude (4,): body to level; drift, drift_sigma (6,): rad/s and m/s².
    """

    time: float
    rest: bool
    values: FloatArray
    sigmas: FloatArray
    innovation: float
    freedom: int
    attitude: FloatArray
    drift: FloatArray
    drift_sigma: FloatArray


class FilterInUse:
    """A calibrated unit followed in use.

    **Arguments:** `calibration`: of both triads; `noise`: of the unit; `rate`: Hz; `gravity`: where it is used, if it
    is known better than where it was calibrated; `mounted`: a reference that measures attitude, and velocity where it
    has one, as it roughly stands to the unit: how exactly is among the numbers that are followed;
    `magnetic`: whether a calibrated magnetometer is read, too: the Earth's field is then followed, and holds the
    heading of every rest; `changing`: by triad, how far (one sigma, rad/s or m/s²) its bias may be from the
    calibration's.

    `update` takes samples as they come and returns what each half second added. Memory does not grow. Gain and bias are
    known beforehand to the calibration's uncertainty, the biases to `changing` beside, `POWER_ON` by default. Effects
    are held. With a reference the unit is followed from the first rest in which it is seen, and motion may last as long
    as it is seen. Motion is as uncertain as the calibration's was: what its turns missed beyond the noise, motion in
    use misses, too.

    Raises `InputError` for a calibration without gyroscope, `NotPossibleError` for one that depends on temperature.
    """

    def __init__(
        self,
        calibration: Calibration,
        noise: NoiseModel,
        rate: float,
        gravity: LocalGravity | None = None,
        mounted: Mounted | None = None,
        changing: Mapping[str, float] = POWER_ON,
        magnetic: bool = False,
    ):
        require_float64()
        calibration = calibration.inertial()
        if "gyroscope" not in calibration.triads():
            raise InputError("following a unit in use needs a calibrated gyroscope, and this calibration has none.")
        gravity = gravity or calibration.gravity
        self.gravity = self._gravity = float(gravity.value)
        kept = list(calibration.imu.transferable().all_effects().values())
        for effect in kept:
            if "temperature" in " ".join(effect.needs):
                raise NotPossibleError(
                    f"following a unit in use takes no temperature into account, on which {effect.title} of this "
                    "calibration depends: give the calibration without its thermal part."
                )
        outside = () if mounted is None else mounted.effects
        outside = (*outside, SetupMagneticField.dormant()) if magnetic else outside
        self.imu: Imu = on_host(calibration.imu.with_effects(*kept, GyroEarthRotation.dormant(), *outside))
        known = calibration.of_numbers(lambda name: name.effect is None)
        beside = {
            key: EARTH_RATE if isinstance(effect, GyroEarthRotation) else effect.known
            for key, effect in self.imu.all_effects().items()
            if isinstance(effect, (GyroEarthRotation, *MOUNTING_EFFECTS))
        }
        free = Parameters.select(self.imu, lambda name: name in known.names or name.key in beside)
        self.names, self._index = free.names, np.asarray(free.index, int)
        spread = [
            changing.get(name.owner, 0.0) * np.linalg.norm(self.imu.triad(name.owner).gain[name.axes[0]])
            if name.part == "bias"
            else beside.get(name.key, 0.0)
            for name in free.names
        ]
        spread.append(max(gravity.sigma, 1e-6))
        covariance = np.pad(known.covariance_of(free.names), (0, 1)) + np.diag(np.array(spread) ** 2)
        self.prior = np.linalg.inv(np.linalg.cholesky(covariance))
        self.errors: Disturbances = seen_from_outside(disturbances(noise, known_scale(calibration)), mounted)
        self._mounted, self._magnetic = mounted, magnetic
        self._moves = mounted is not None and mounted.attitude.velocities() is not None
        self._pending: deque[tuple[float, float, FloatArray, FloatArray | None]] = deque()
        self._floor = np.asarray(disturbances(noise).white) * rate
        self._count, self._padded, self._rate = round(INTERVAL * rate), int(np.ceil(_SPAN * INTERVAL * rate)), rate
        self._numbers = flatten(self.imu)
        self.begun = self._numbers[self._index]
        self._known: Knowledge | None = None
        self._path = MotionPath(IDENTITY, np.zeros(3))
        self._waiting: list[_Sample] = []
        self._last: float | None = None
        self._quiet, self._resting, self._mean, self._moving, self._unseen = False, False, np.zeros(6), 0.0, 0.0
        self._least = np.full(2, np.inf)
        self._recent: deque[tuple[float, int]] = deque(maxlen=_WINDOW)

    def update(
        self,
        time: FloatArray,
        accelerometer: FloatArray,
        gyroscope: FloatArray,
        attitude: Attitude | None = None,
        field: FloatArray | None = None,
    ) -> list[FilterState]:
        """Take n samples, time (n,) in s rising, outputs (n, 3) in the calibration's units; return what was learnt.

        **Arguments:** `attitude`: what the reference said since the last call, by its own clock. What it says of a
        time that is past an interval already done is left out, so hand it over before the samples it belongs to.
        `field`: magnetic, (n, 3), µT, in the body frame, as the calibrated magnetometer has it; NaN where it has none.

        Raises `InputError` where stamps do not rise, outputs are not finite, or a reference or a field is handed over
        that the filter was not told of.
        """
        if attitude is not None:
            self._hand_over(attitude)
        time, accelerometer, gyroscope = (np.asarray(values, float) for values in (time, accelerometer, gyroscope))
        if not (np.diff(time, prepend=-np.inf if self._last is None else self._last) > 0).all():
            raise InputError("the stamps of a stream must rise.")
        if not (np.isfinite(accelerometer).all() and np.isfinite(gyroscope).all()):
            raise InputError("a stream holds a sample that is not finite: leave it out.")
        if field is not None and not self._magnetic:
            raise InputError("a magnetic field was handed over, and the filter follows none: see `magnetic`.")
        field = np.full((len(time), 3), np.nan) if field is None else np.asarray(field, float)
        states = []
        for sample in map(_Sample._make, zip(time.tolist(), accelerometer, gyroscope, field, strict=True)):
            self._waiting.append(sample)
            if self._due(sample.time):
                states += self._interval()
                self._waiting = []
        return states

    def diverged(self) -> str | None:
        """Say whether the last innovations are too large to be noise; None where they are not."""
        total, freedom = np.sum([(0.0, 0), *self._recent], axis=0).tolist()
        if total <= _LARGE * freedom or chi2_sf(total, freedom) > _IMPLAUSIBLE:
            return None
        return (
            f"the filter has diverged: its last {len(self._recent)} innovations are {total / freedom:.3g} times as "
            "large (squared) as their uncertainty. The calibration is of another unit or has gone stale, "
            f"{'' if self._mounted is None else 'the reference is off, '}"
            f"{'the magnetic field is disturbed there, ' if self._magnetic else ''}or a rest was no rest."
        )

    def _hand_over(self, attitude: Attitude) -> None:
        """Keep what a reference said until the samples come that it belongs to."""
        if self._mounted is None:
            raise InputError("a reference was handed over, and nothing is known of how it is mounted: see `mounted`.")
        marks = np.asarray(self._mounted.mounting.on_log(attitude.time)).tolist()
        velocities = [None] * len(marks) if attitude.velocity is None else attitude.velocity
        self._pending.extend(zip(marks, attitude.time.tolist(), attitude.quaternion, velocities, strict=True))

    def _due(self, now: float) -> bool:
        """Return whether an interval is complete: half a second, or a little more for it to end where something was
        measured.
        """
        count, half = len(self._waiting), 0.5 / self._rate
        if count < self._count or not self._pending:
            return count == self._count
        most = self._count + self._count // 4
        until = now + (most - count) / self._rate + half
        ahead = [mark for mark, *_ in self._pending if now - half < mark <= until]
        return count >= most or not ahead or ahead[0] <= now + half

    def _field_seen(self, field: FloatArray, end: float, begins: bool) -> tuple[Sighting, ...]:
        """Return the mean field of an interval; it counts where a rest begins, of which more would say no more."""
        if not self._magnetic:
            return ()
        field = field[np.isfinite(field).all(axis=1)]
        mean = field.mean(axis=0) if len(field) else np.zeros(3)
        return (_sighting(FieldSeen, end, end, begins and len(field) > 0, mean),)

    def _begin_field(self, sightings: tuple[Sighting, ...]) -> None:
        """Take the field, of which nothing was known, as it is where it is seen first; its noise is a share of it."""
        index = self._index[list(places_of(SetupMagneticField, self.imu, self.names))]
        for sighting in sightings:
            if isinstance(sighting, FieldSeen) and sighting.measured > 0 and not self._numbers[index].any():
                self._numbers[index] = np.asarray(rotate(self._path.attitude, sighting.value))
                self.errors = replace(self.errors, field=np.float64(FIELD * np.linalg.norm(sighting.value)))

    def _sightings(self, start: float, end: float, holds: bool) -> tuple[Sighting, ...]:
        """Return what a reference said last in an interval, where any of it counts (`holds`) or by its last sample."""
        if self._mounted is None:
            return ()
        latest = None
        while self._pending and self._pending[0][0] <= end:
            latest = self._pending.popleft()
        since = start if holds else end - 1 / self._rate
        counts = latest is not None and latest[0] > since
        _, stamp, quaternion, velocity = latest if latest is not None and counts else _NOTHING
        sightings = [_sighting(AttitudeSeen, stamp, end, counts, quaternion)]
        if self._moves:
            moved = np.zeros(3) if velocity is None else velocity
            sightings.append(_sighting(VelocitySeen, stamp, end, counts and velocity is not None, moved))
        return tuple(sightings)

    def _upright(self, force: FloatArray, sightings: tuple[Sighting, ...]) -> MotionPath:
        """Return the path's beginning at rest: upright as the force has it, and as was measured."""
        unit = unflatten(self.imu, self._numbers)
        attitude = level(self._path.attitude, unit.with_effects().accelerometer.recover(force.mean(axis=0)))
        for sighting in sightings:
            attitude = sighting.placed(attitude, Mounting.of(unit))
        return MotionPath(attitude, np.zeros(3))

    def _rests(self, rate: FloatArray, force: FloatArray, lost: float) -> tuple[bool, bool, bool, float]:
        """Return whether the unit rests in an interval, arrives at a rest, begins one; and its mean speed, rad/s."""
        triads = self.imu.triads()
        outputs = np.hstack([rate / triads["gyroscope"].scales, force / triads["accelerometer"].scales])
        mean = outputs.mean(axis=0)
        scatter, floor = (values.reshape(2, 3).sum(axis=1) for values in (outputs.var(axis=0, ddof=1), self._floor))
        self._least = np.minimum(self._least, scatter)
        still = np.minimum(_QUIET * np.maximum(self._least, floor), _LOUD * floor)
        quiet = bool(lost == 0 and (scatter < still).all())
        alike = np.linalg.norm(mean[:3] - self._mean[:3]) < _TURNING + 6 * np.sqrt(self._floor[:3].sum() / len(rate))
        rest, arrival = bool(quiet and self._quiet and alike), quiet and not self._quiet
        begins = rest and not self._resting
        self._quiet, self._mean, self._resting = quiet, mean, rest
        return rest, arrival, begins, float(np.linalg.norm(mean[:3]))

    def _interval(self) -> list[FilterState]:
        time, force, rate, field = (np.array(values) for values in zip(*self._waiting, strict=True))
        period = 1 / self._rate
        start, end = time[0] - period if self._last is None else self._last, float(time[-1])
        self._last = end
        step = np.diff(time, prepend=start)
        lost = float(np.where(step > 2.5 * period, step - period, 0.0).sum())
        rest, arrival, begins, speed = self._rests(rate, force, lost)
        sightings = self._sightings(start + period / 2, end + period / 2, rest or arrival)
        absolute = bool(sightings)
        measured = absolute and bool(sightings[0].measured)
        located = measured or not absolute
        sightings = (*sightings, *self._field_seen(field, end + period / 2, begins))
        if self._known is None and not (rest and located):
            return []
        self._moving = 0.0 if rest else self._moving + float(end - start)
        self._unseen = 0.0 if rest else self._unseen + lost * speed
        lost_track = self._moving > LONGEST_MOTION or self._unseen > FARTHEST_UNSEEN
        if lost_track and not (arrival and located):
            return []
        if lost_track:  # attitude is determined again; what is known of the unit stays
            self._path = self._upright(force, sightings)
        if arrival or lost_track:
            sightings = tuple(replace(sighting, measured=np.float64(0.0)) for sighting in sightings)
        if lost_track or (measured and not arrival):
            self._moving, self._unseen = 0.0, 0.0
        arrival = arrival and not lost_track
        rows = np.minimum(np.arange(self._padded), len(time) - 1)
        part = MotionIntervals(
            force[rows],
            rate[rows],
            np.pad(step, (0, self._padded - len(time))),
            time[rows],
            np.float64(rest),
            np.float64(arrival),
            np.float64(lost_track),
            np.float64(lost),
            np.float64(1.0),
            sightings,
        )
        states = self.errors.states
        if self._known is None:
            self._path = self._upright(force, sightings)
            self._known = first_knowledge(self.errors, self._path.velocity, len(self.prior), absolute)
            self._known.root[states:, states:] = np.linalg.qr(self.prior, mode="r")
        self._begin_field(sightings)
        after, rows = stored.call(
            _rows_after, "in use", self.imu, self._numbers, self.gravity, part, self.errors, self._path
        )
        columns = np.append(self._index, len(self._numbers))
        known, _, innovation = advance(self._known, rows._replace(shared=rows.shared[:, columns]))
        change, covariance = estimate(known)
        if not np.isfinite(change).all():
            raise NotPossibleError(
                f"the filter lost the unit at {end:.3g} s: begin again with a rest, or with another calibration."
            )
        moved = change.copy()
        moved[6:states] = 0.0  # drift is no part of the path
        self._known = known._replace(right=known.right - known.root @ moved)
        self._path = on_host(after.moved(change[:6]))
        self._numbers = self._numbers.copy()
        self._numbers[self._index] += change[states:-1]
        self.gravity += float(change[-1])
        summed = np.tile(np.eye(6), len(self.errors.variance))
        drift, spread = summed @ change[6:states], summed @ covariance[6:states, 6:states] @ summed.T
        freedom = 6 * rest + 3 * arrival + 3 * sum(int(sighting.measured > 0) for sighting in sightings)
        if freedom:
            self._recent.append((innovation, freedom))
        sigmas = sigmas_of(covariance)[states:-1]
        numbers = self._numbers[self._index]
        return [
            FilterState(end, rest, numbers, sigmas, innovation, freedom, self._path.attitude, drift, sigmas_of(spread))
        ]

    @property
    def change(self) -> FloatArray:
        """By how much (p + 1,) the numbers that are followed, and gravity, are other than they were at the start."""
        return np.append(self._numbers[self._index] - self.begun, self.gravity - self._gravity)

    @property
    def root(self) -> FloatArray:
        """Square-root information of attitude, velocity, drift, numbers and gravity, upper triangular."""
        assert self._known is not None
        return self._known.root

    def model(self) -> Imu:
        """Return the unit as it is known now, drift of its biases included, without the Earth's rotation and field."""
        return unflatten(self.imu, self._numbers).without(GyroEarthRotation, SetupMagneticField)


def _sighting(kind: type[Sighting], stamp: float, end: float, counts: bool, value: FloatArray) -> Sighting:
    return kind(np.float64(stamp), np.float64(end), np.float64(counts), value)


def _rows_after(imu, numbers, gravity, part, errors, path) -> tuple[MotionPath, WhiteRows]:
    """Return the path's end after an interval, and its white rows about it."""
    after = carried(imu, numbers, gravity, part, path)
    return after, interval_rows(imu, numbers, gravity, part, errors, path, after)


def followed_in_use(
    calibration: Calibration,
    recording: Recording,
    noise: NoiseModel | None = None,
    gravity: LocalGravity | None = None,
    attitude: Attitude | None = None,
    magnetometer: Calibration | None = None,
) -> tuple[Calibration, History]:
    """Follow a calibrated unit through a recording, causally.

    Samples that are no measurement (beyond the range, spikes, zeros) are left out first, and the notes say so.

    **Arguments:** `noise`: of the unit; None takes the scatter of the recording's own rests. `gravity`: where it was
    recorded, if other than where the unit was calibrated; `attitude`: measured, with its own clock, and velocity where
    it has velocities or positions. How it is mounted, and late, is found roughly from the recording as a whole
    ([`jaximu.calibration.calibrate_against_attitude`]); from there on all is causal. `magnetometer`: a calibration of
    the magnetometer that the recording holds: the Earth's field then holds the heading of every rest.

    **Returns:** the calibration as it is at the end, with `filter` {states, nis, open, converged, diverged}, and how
    it came to it.

    Raises `InputError` for other units than were calibrated, and without a magnetometer where one is to be used;
    `NotPossibleError` where the unit never rests.
    """
    require_gyroscope(recording)
    for name in calibration.inertial().triads():
        calibration.triad_of(name, recording)
    with prepared([recording]) as (ready,):
        field = None if magnetometer is None else field_of(magnetometer, ready.recording)
        return _through(calibration, ready, noise, gravity, attitude, field)


def follow(
    follower: FilterInUse, recording: Recording, said_by: Attitude | None = None, field: Signal | None = None
) -> tuple[History, str | None]:
    """Take all of a recording; return how the filter came to know the unit, and what it says if it diverged.

    **Arguments:** `said_by`: what the reference measured, with velocities, if the filter follows one; `field`:
    magnetic, in the body frame (µT), if it follows one.

    Raises `NotPossibleError` where the unit never rests.
    """
    gyroscope = recording.signals["gyroscope"]
    force = recording.accelerometer.at(gyroscope.time)
    fields, steps, diverged = None, [], None
    if field is not None:
        outside = {"left": np.nan, "right": np.nan}
        fields = np.stack([np.interp(gyroscope.time, field.time, axis, **outside) for axis in field.values.T], 1)
    for first in range(0, len(gyroscope), 1000):
        rows = slice(first, first + 1000)
        around = None if fields is None else fields[rows]
        steps += follower.update(gyroscope.time[rows], force[rows], gyroscope.values[rows], said_by, around)
        said_by = None
        if diverged is None and (reason := follower.diverged()) is not None:
            diverged = f"By {gyroscope.time[rows][-1]:.0f} s {reason}"
    if not any(step.rest for step in steps):
        raise NotPossibleError(
            f"{recording.name}: the unit never rests for a second, and the filter begins with a rest: record two "
            "seconds or more without motion first."
        )
    time, rest, values, sigmas, innovations, freedom, _, drift, spread = (
        np.array(parts) for parts in zip(*steps, strict=True)
    )
    earth = places_of(GyroEarthRotation, follower.imu, follower.names)
    history = History(time, rest, follower.names, values, sigmas, drift, spread, innovations, freedom, earth)
    return history, diverged


def _through(
    calibration: Calibration,
    ready: Prepared,
    noise: NoiseModel | None,
    gravity: LocalGravity | None,
    attitude: Attitude | None,
    field: Signal | None,
) -> tuple[Calibration, History]:
    """Return what `followed_in_use` does, of a recording whose mistakes are known."""
    recording = ready.recording
    noise = noise_at_rest(segment(recording)) if noise is None else noise
    mounted, measured = None, None
    if attitude is not None:
        mounted = mounted_on(recording, attitude, gravity or calibration.gravity, noise, calibration.inertial())
        measured = replace(mounted.attitude, velocity=mounted.attitude.velocities())
    rate = recording.signals["gyroscope"].rate
    follower = FilterInUse(calibration, noise, rate, gravity, mounted, magnetic=field is not None)
    history, diverged = follow(follower, recording, measured, field)
    rows = [row for row, name in enumerate(follower.names) if name.effect is None]
    names = tuple(follower.names[row] for row in rows)
    states = follower.errors.states
    inverse = np.linalg.inv(follower.root[states:-1, states:-1])[rows]
    converged = {name: history.converged(row) for row, name in zip(rows, names, strict=True)}
    path = ("attitude", "velocity", "drift")
    summary = {
        "states": [*path, *names, "gravity", *([] if field is None else ["magnetic field"])],
        "nis": float(history.innovations.sum() / max(history.freedom.sum(), 1)),
        "open": [
            f"{describe(name)} is known no better than before." for name, when in converged.items() if when is None
        ],
        "converged": [{"name": name, "seconds": when} for name, when in converged.items()],
        "diverged": diverged,
    }
    after = replace(
        calibration,
        imu=follower.model(),
        names=names,
        covariance=inverse @ inverse.T,
        method="filter in use",
        data=provenance([recording]),
        notes=(*ready.notes, *recording.notes, *noise.notes),
        fit=None,
        observations=None,
        rms={},
        weak=(),
        filter=summary,
        reference=None if mounted is None else mounted.summary,
    )
    return after, history
