"""`Course`: a motion written down segment by segment, on the host; what it happens in (`Environment`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import ArrayLike

from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError
from jaximu.ground.rotation import unit_vectors
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.recordings.entry import ScheduleEntry
from jaximu.simulation.protocols.motion import Motion, earth_rate, field_of

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Tone:
    """A sinusoidal vibration from `start` to `stop` (s): frequency (Hz); amplitudes of acceleration (m/s²) and of
    rocking (rad), body frame. One above half of the sample rate does not show in the samples, only in its power.
    """

    frequency: float
    acceleration: Sequence[float] = (0.0, 0.0, 0.0)
    rocking: Sequence[float] = (0.0, 0.0, 0.0)
    start: float = -np.inf
    stop: float = np.inf


@dataclass(frozen=True)
class Environment:
    """Where a protocol takes place.

    gravity: m/s². latitude: degrees; None leaves the Earth's rotation out. temperature, ambient: °C, a number or
    knots [[s, °C], …] between which it runs straight; None where the protocol sets it (else 25 °C). vibration: tones.
    field: strength of the Earth's magnetic field, µT; dip: degrees below the level. current: A, a number or knots
    [[s, A], …]; None where none is logged.
    """

    gravity: float = STANDARD_GRAVITY
    latitude: float | None = None
    temperature: float | Sequence[Sequence[float]] | None = None
    ambient: float | Sequence[Sequence[float]] | None = None
    vibration: Sequence[Tone] = ()
    field: float = 48.0
    dip: float = 62.0
    current: float | Sequence[Sequence[float]] | None = None

    def __post_init__(self) -> None:
        if not self.gravity >= 0:
            raise InputError(f"gravity must not be negative, found {self.gravity} m/s².")
        if self.latitude is not None and not -90 <= self.latitude <= 90:
            raise InputError(f"latitude must lie between -90 and 90 degrees, found {self.latitude}.")
        if not self.field >= 0:
            raise InputError(f"the strength of the field must not be negative, found {self.field} µT.")
        if not -90 <= self.dip <= 90:
            raise InputError(f"the dip must lie between -90 and 90 degrees, found {self.dip}.")
        for name in ("temperature", "ambient", "current"):
            knots(getattr(self, name), name)


def knots(
    value: float | Sequence[Sequence[float]] | None, name: str = "temperature", default: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Return times (s) and values (°C or A) of a number or of knots [[s, value], …]. Raises InputError."""
    unit = "A" if name == "current" else "degC"
    value = default if value is None else value
    if isinstance(value, int | float):
        value = [[0.0, value], [1.0, value]]
    table = np.asarray(value, float)
    if table.ndim != 2 or table.shape[1] != 2 or len(table) < 2 or not np.isfinite(table).all():
        raise InputError(f"{name} must be a number ({unit}) or at least two knots [[seconds, {unit}], ...].")
    if (np.diff(table[:, 0]) <= 0).any():
        raise InputError(f"{name}: the times of its knots must increase, found {table[:, 0].tolist()}.")
    if (table[:, 1] < -273.15).any():
        raise InputError(f"{name}: {table[:, 1].min()} degC is below absolute zero (-273.15 degC).")
    return table[:, 0], table[:, 1]


def attitude_of(up: ArrayLike, heading: ArrayLike = 0.0) -> Rotation:
    """Return the attitude (body to level frame) in which the body vector `up` (..., 3) points up, turned by `heading`
    (rad) about it.
    """
    up = np.asarray(up, float)
    x, y, z = np.moveaxis(unit_vectors(up), -1, 0)
    azimuth = np.where(np.hypot(x, y) < 1e-9, 0.0, np.arctan2(y, x))  # where z is up or down, rounding has none
    angles = [np.broadcast_to(heading, z.shape), -np.arccos(np.clip(z, -1, 1)), -azimuth]
    # Rz(heading) Ry(−polar angle) Rz(−azimuth)
    return scipy.spatial.transform.Rotation.from_euler("ZYZ", np.stack(angles, axis=-1))


@dataclass
class Course:
    """A motion in the making: rests and turns one after the other, each exactly as long as said."""

    attitude: Rotation = field(default_factory=lambda: scipy.spatial.transform.Rotation.identity())
    intervals: list[ScheduleEntry] = field(default_factory=list)
    time: float = 0.0
    _segments: list[tuple] = field(default_factory=list)

    def rest(self, duration: float, mark: bool = True) -> None:
        """Stay for `duration` seconds; a marked rest is a pose."""
        if duration <= 0:
            return
        start = self._add(duration, np.zeros(3))
        if mark:
            up = self.attitude.inv().apply([0.0, 0.0, 1.0])
            heading = (self.attitude * attitude_of(up).inv()).as_rotvec()[2]
            self.intervals.append(ScheduleEntry(start, self.time, "pose", up, 0.0, float(heading)))

    def turn(
        self,
        rotation: ArrayLike,
        duration: float,
        ramp: float = 0.5,
        displacement: ArrayLike = (0.0, 0.0, 0.0),
        mark: bool = True,
        bend: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        """Turn by a rotation vector (body frame, rad; any number of revolutions), moving by `displacement` (m) and
        leaning aside by `bend` (body frame, rad) half way.
        """
        rotation = np.asarray(rotation, float)
        angle = float(np.linalg.norm(rotation))
        start = self._add(duration, rotation, ramp, displacement, bend)
        self.attitude = self.attitude * scipy.spatial.transform.Rotation.from_rotvec(rotation)
        if mark and angle > 0:
            self.intervals.append(ScheduleEntry(start, self.time, "turn", rotation / angle, angle))

    def spin(self, axis: FloatArray, angle: float, rate: float, ramp_duration: float) -> None:
        """Turn by `angle` (rad) about `axis` at the constant `rate` (rad/s), reached in `ramp_duration` (s).

        Where the angle is too small to reach the rate, the ramps meet.
        """
        duration = max(angle / rate + ramp_duration, 2 * ramp_duration)
        self.turn(angle * axis, duration, ramp_duration / duration)

    def to(
        self,
        attitude: Rotation,
        duration: float,
        displacement: ArrayLike = (0.0, 0.0, 0.0),
        bend: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        """Turn the shortest way to an attitude, but for `bend`."""
        self.turn((self.attitude.inv() * attitude).as_rotvec(), duration, 0.5, displacement, bend=bend)
        self.attitude = attitude  # exactly

    def visit(self, attitude: Rotation, duration: float) -> None:
        """Turn the shortest way to an attitude, or begin in it."""
        if self._segments:
            self.to(attitude, duration)
        self.attitude = attitude

    def _add(
        self,
        duration: float,
        rotation: FloatArray,
        ramp: float = 0.5,
        displacement: ArrayLike = (0.0, 0.0, 0.0),
        bend: ArrayLike = (0.0, 0.0, 0.0),
    ) -> float:
        attitude = self.attitude.as_quat(scalar_first=True)
        self._segments.append((self.time, duration, attitude, rotation, ramp, displacement, bend))
        start, self.time = self.time, self.time + duration
        return start

    def motion(self, environment: Environment, rng: np.random.Generator) -> Motion:
        """Return the motion in an environment; `rng` draws the phases of the vibration."""
        *columns, bend = (np.asarray(column, float) for column in zip(*self._segments, strict=True))
        columns.append(bend if bend.any() else bend[:0])
        time, sensor = knots(environment.temperature, default=25.0)
        around, ambient = (time, sensor) if environment.ambient is None else knots(environment.ambient)
        union = np.union1d(time, around)
        tones = environment.vibration
        current_time, current = knots(environment.current)
        return Motion(
            *columns,
            temperature_time=union,
            temperature=np.interp(union, time, sensor),
            ambient=np.interp(union, around, ambient),
            frequency=np.array([tone.frequency for tone in tones]),
            acceleration=np.reshape([tone.acceleration for tone in tones], (-1, 3)),
            rocking=np.reshape([tone.rocking for tone in tones], (-1, 3)),
            phase=rng.uniform(0, 2 * np.pi, (len(tones), 2)),
            window=np.reshape([(tone.start, tone.stop) for tone in tones], (-1, 2)).clip(-1e9, 1e9),
            gravity=np.asarray(environment.gravity, float),
            earth=np.zeros(3) if environment.latitude is None else earth_rate(np.radians(environment.latitude)),
            field=field_of(environment.field, environment.dip),
            current_time=current_time,
            current=current,
        )
