"""`Trajectory`: a path that a unit is taken along, as its sensors would feel it, with where it starts.

It is level driving by default, the motion of a specification, or a recorded motion: then what the calibrated unit felt
is taken for the truth. The rates contain the Earth's rotation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaximu.calibration import Calibration, compensate
from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import rms
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import LocalGravity
from jaximu.ground.precision import require_float64
from jaximu.ground.rotation import UP, conjugate, rotate
from jaximu.ground.stored import compiled
from jaximu.ground.tracing import part_of
from jaximu.ground.units import INERTIAL_QUANTITIES
from jaximu.ground.vectors import lengths_of, means_by_group, root_or_zero
from jaximu.model.stimulus import REFERENCE_TEMPERATURE, Stimulus
from jaximu.navigation import Navigation
from jaximu.recordings.recording import Recording
from jaximu.simulation import Specification
from jaximu.simulation.protocols.course import attitude_of
from jaximu.simulation.protocols.motion import earth_rate, smooth_course

_MOST = 120_000
"""Samples of a path: the derivatives of all of them are held at once."""
_SPEED, _REST, _RISE = 15.0, 5.0, 10.0  # m/s; s at rest, and until the speed is reached
_FIRST_TURN, _TURN_EVERY, _TURN_TIME = 30.0, 60.0, 6.0  # s
_STILL = (0.5, 0.05)
"""m/s² and rad/s: scatter over a second, and distance from gravity and from no rate, below which a unit is at rest."""
_WINDOW = 64  # samples in which even and odd ones are compared
_LEVELLED = 10.0  # s of a rest at the most, from which a recorded motion is levelled


@dataclass(frozen=True)
class Place:
    """Where on the Earth: latitude (degrees), height (m), gravity."""

    latitude: float
    height: float
    gravity: LocalGravity

    def __post_init__(self) -> None:
        if not -85 <= self.latitude <= 85:
            raise InputError(f"navigation is by longitude and takes latitudes up to ±85°, not {self.latitude:g}°.")


@dataclass(frozen=True)
class Trajectory:
    """What a unit goes through, sample by sample, from a start that is known exactly.

    stimulus: (S,) samples, means over `intervals` (S,), s. words: what it is. notes: what had to be assumed. recorded:
    whether the samples are a unit's own, noise included; jitter: standard deviation of its stamps, s. every: samples
    from one reported time to the next; divides S.
    """

    start: Navigation
    stimulus: Stimulus
    intervals: FloatArray
    words: str
    notes: tuple[str, ...] = ()
    recorded: bool = False
    jitter: float = 0.0
    every: int = 1

    def cut(self) -> Trajectory:
        """Cut a path to a whole number of reported times, a second or a twentieth of it apart.

        Raises `NotPossibleError` for one that is too short or too long.
        """
        require_float64()
        count = len(self.intervals)
        total = float(self.intervals.sum())
        if count > _MOST:
            raise NotPossibleError(
                f"the path has {count} samples, and {_MOST} are the most: shorten it with --duration "
                f"{_MOST * total / count:.0f}."
            )
        apart = 10 * max(1, round(min(1.0, total / 20) * count / total / 10))  # tens are quick to mechanise
        if (kept := count // apart * apart) < 2 * apart:
            raise NotPossibleError(f"the path lasts only {total:.2g} s ({count} samples): give a longer one.")
        stimulus, intervals = part_of((self.stimulus, self.intervals), slice(kept))
        return replace(self, stimulus=stimulus, intervals=intervals, every=apart)

    @property
    def times(self) -> FloatArray:
        """The reported times (T,), s from the start."""
        return self.intervals.cumsum()[self.every - 1 :: self.every].round(9)  # not 0.99…

    @property
    def interval(self) -> float:
        """Mean interval of the samples, s."""
        return float(self.intervals.mean())

    def excess_power(self, density: Mapping[str, FloatArray]) -> dict[str, float]:
        """Return by triad how much more power the samples have at half their rate than white noise of a density N has.

        What even and odd samples differ by, Σ (−1)^k w_k u_k over windows w without a step at their ends: smooth motion
        cancels there, and what does not is noise, vibration and what sampling folds down (compare `data.sampling` of
        hand-held turns). A multiple of N², zero where there is none, of no triad where nothing was recorded.
        """
        if not self.recorded or len(self.intervals) < 2 * _WINDOW:
            return {}
        weight = np.hanning(_WINDOW) * np.where(np.arange(_WINDOW) % 2 == 0, 1.0, -1.0)
        excess = {}
        for triad, quantity in INERTIAL_QUANTITIES.items():
            whole = np.asarray(getattr(self.stimulus, quantity))[: len(self.intervals) // _WINDOW * _WINDOW].reshape(
                -1, _WINDOW, 3
            )
            measured = (np.einsum("k,nki->ni", weight, whole) ** 2).mean() / (weight**2).sum()
            white = np.square(density[triad]).mean() / self.interval
            excess[triad] = max(float(measured / white) - 1.0, 0.0)
        return excess

    def require_range(self, limits: Mapping[str, float]) -> None:
        """Raise `NotPossibleError` where the path leaves a sensor's range, by triad in m/s² and rad/s."""
        for triad, limit in limits.items():
            felt = np.asarray(getattr(self.stimulus, INERTIAL_QUANTITIES[triad]))
            beyond = abs(felt) > limit
            if beyond.any():
                row, axis = (int(index[0]) for index in beyond.nonzero())
                factor, unit = (np.degrees(1.0), "°/s") if triad == "gyroscope" else (1.0, "m/s²")
                raise NotPossibleError(
                    f"the path leaves the {triad}'s range of ±{factor * limit:.4g} {unit}: {'xyz'[axis]} feels "
                    f"{factor * felt[row, axis]:.4g} {unit} {self.intervals[:row].sum():.2f} s after the start. Take "
                    "a gentler path or a sensor with more range."
                )


def level_driving(
    site: Place, duration: float = 600.0, temperature: float = REFERENCE_TEMPERATURE, rate: float = 100.0
) -> Trajectory:
    """Return level driving: at rest for 5 s, in 10 s up to 15 m/s, and from 30 s on a turn of 90° every minute.

    **Arguments:** `duration` in s, `temperature` in °C all along, `rate` in Hz.
    """
    time = (np.arange(round(duration * rate)) + 0.5) / rate
    turns = np.arange(_FIRST_TURN, duration, _TURN_EVERY)
    latitude = np.radians(site.latitude)
    force, turned, attitude = _felt_on_the_road(time, turns, earth_rate(latitude), latitude, site.gravity.value)
    warm = np.full(len(time), float(temperature))
    stimulus = Stimulus(force, turned, time=time, temperature=warm, temperature_rate=0 * warm, attitude=attitude)
    start = _start(np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]), site, site.gravity.value)
    return Trajectory(
        start,
        stimulus,
        np.full(len(time), 1 / rate),
        f"{duration:g} s of level driving at {site.latitude:g}° latitude: at rest for {_REST:g} s, then up to "
        f"{_SPEED:g} m/s in {_RISE:g} s, a turn of 90° every {_TURN_EVERY:g} s from {_FIRST_TURN:g} s on",
    ).cut()


@compiled
def _felt_on_the_road(time, turns, earth, latitude, gravity):
    """Specific force and angular rate (S, 3) in the body frame, and attitude (S, 4), of level driving at some times."""
    senses = jnp.where(jnp.arange(len(turns)) % 2, -1.0, 1.0)
    radius = 6371e3  # of the transport rate: what the path is, not how it is navigated

    def heading(time):
        done = ((time - turns) / _TURN_TIME).clip(0.0, 1.0)
        return jnp.pi / 2 * (1 + (senses * smooth_course(done, 0.5)).sum())  # from north, to the left and right

    def velocity(time):
        speed = _SPEED * smooth_course(((time - _REST) / _RISE).clip(0.0, 1.0), 0.5)
        return speed * jnp.stack([jnp.cos(heading(time)), jnp.sin(heading(time)), 0.0])

    def felt(time):
        (v, change), (angle, turning) = (jax.jvp(course, (time,), (1.0,)) for course in (velocity, heading))
        moving = jnp.stack([-v[1], v[0], v[0] * jnp.tan(latitude)]) / radius
        attitude = jnp.stack([jnp.cos(angle / 2), 0.0, 0.0, jnp.sin(angle / 2)])
        force = change + jnp.cross(2 * earth + moving, v) + UP * gravity
        rate = earth + moving + turning * UP
        back = conjugate(attitude)
        return rotate(back, force), rotate(back, rate), attitude

    return jax.vmap(felt)(time)


def _start(attitude: FloatArray, site: Place, gravity: float) -> Navigation:
    return Navigation.at(attitude, np.zeros(3), np.radians(site.latitude), site.height, gravity)


def of_specification(
    specification: Specification, site: Place, duration: float | None = None
) -> tuple[Trajectory, dict[str, float]]:
    """Return the motion of a specification's first unit, and the ranges that its clipping states, by triad in SI.

    Its latitude and gravity hold where it states them, else those of `site`.
    """
    document = specification.document
    stated = document.get("environment", {})
    site = replace(site, latitude=float(stated.get("latitude", site.latitude)))
    environment = {"gravity": site.gravity.value} | stated | {"latitude": site.latitude}
    case = Specification(document | {"environment": environment}, specification.name).case(0)
    motion = case.plan.motion
    longest = motion.samples(case.rate)
    count = longest if duration is None else min(longest, round(duration * case.rate))
    stimulus = part_of(motion.stimulus(case.rate), slice(count))
    start = _start(motion.attitude[0], site, float(motion.gravity))
    limits = {
        name: float(getattr(artefact, name) / case.imu.triad(name).scales.max())
        for artefact in case.artefacts
        for name in INERTIAL_QUANTITIES
        if artefact.name == "clipping" and getattr(artefact, name) is not None
    }
    words = f"the motion of {Path(specification.name).name}, {count / case.rate:g} s at {site.latitude:g}° latitude"
    return Trajectory(start, stimulus, np.full(count, 1 / case.rate), words).cut(), limits


def of_recording(recording: Recording, calibration: Calibration, site: Place, duration: float = 60.0) -> Trajectory:
    """Return a recorded motion as the calibrated unit felt it, from its first rest or its first attitude on.

    At rest the accelerometer tells the level, and what it reads is gravity; the gyroscope's mean there is taken off,
    all but the Earth's rotation. Heading is taken as zero.

    Raises `NotPossibleError` for a log without gyroscope, or without rest or attitude to start from.
    """
    if recording.gyroscope is None:
        raise NotPossibleError(f"{recording.name} has no gyroscope: record a motion with both sensors.")
    ready = compensate(calibration, recording)
    gyroscope = ready.signals["gyroscope"]
    time, rate = gyroscope.time, gyroscope.values
    force = ready.accelerometer.at(time)
    notes = []
    if recording.attitude is not None:
        first = float(recording.attitude.time[0])
        attitude = recording.attitude.values[0]
        gravity = site.gravity.value
        notes.append("the motion starts at the log's first attitude, and its velocity there is taken as zero.")
    else:
        first, end = _first_rest(time, force, rate, site.gravity.value, recording.name)
        resting = (time >= first) & (time <= min(end, first + _LEVELLED))
        up = force[resting].mean(axis=0)
        attitude = attitude_of(up).as_quat(scalar_first=True)
        gravity = float(lengths_of(up))
        rate = rate - rate[resting].mean(axis=0) + attitude_of(up).inv().apply(earth_rate(np.radians(site.latitude)))
        notes.append(f"the motion starts at the log's first rest, {first:.1f} s in, levelled there; heading unknown.")
    kept = (time >= first) & (time < first + duration)
    temperature = ready.temperature
    warm = None if temperature is None else np.interp(time, temperature.time, temperature.values[:, 0])[kept]
    stimulus = Stimulus(force[kept], rate[kept], time=time[kept] - first, temperature=warm)
    words = f"{min(duration, float(time[-1]) - first):.4g} s of the motion recorded in {Path(recording.name).name}"
    steps = np.diff(time[kept])
    bend = np.diff(steps[steps < 2.5 * np.median(steps)])  # of white jitter its variance is six times
    jitter = float(rms(bend) / np.sqrt(6)) if len(bend) else 0.0
    start = _start(attitude, site, gravity)
    return Trajectory(start, stimulus, np.gradient(time)[kept], words, tuple(notes), True, jitter).cut()


def _first_rest(
    time: FloatArray, force: FloatArray, rate: FloatArray, gravity: float, where: str
) -> tuple[float, float]:
    """Begin and end (s) of the first rest: whole seconds in which corrected samples stay near gravity and no rate."""
    means = partial(means_by_group, np.floor(time - time[0]).astype(int))
    force_mean, rate_mean = means(force), means(rate)
    spread = np.stack([means(values**2) - mean**2 for values, mean in ((force, force_mean), (rate, rate_mean))])
    still = root_or_zero(spread.sum(axis=-1)).T < _STILL
    level = abs(lengths_of(force_mean) - gravity) < _STILL[0]
    calm = still.all(axis=1) & level & (lengths_of(rate_mean) < _STILL[1])
    if not calm.any():
        quiet = int(spread.sum(axis=(0, 2)).argmin())
        raise NotPossibleError(
            f"{where} has neither a rest of a second to start from nor an attitude (attitude_w, …): hold the unit "
            "still before it moves, or log its attitude. In its quietest second the calibrated unit reads "
            f"{lengths_of(force_mean[quiet]):.2f} m/s² and {np.degrees(lengths_of(rate_mean[quiet])):.2f} °/s; "
            "if it was at rest then, the calibration is not this unit's."
        )
    first = int(calm.argmax())
    length = int(np.append(calm[first:], False).argmin())
    return float(time[0] + first), float(time[0] + first + length)
