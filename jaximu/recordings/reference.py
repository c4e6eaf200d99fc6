"""Does what the set-up says fit what was recorded? And poses and turns from reference columns. NumPy, host side.

Slips of people are looked for first: another clock, degrees for radians, an axis turned the wrong way, one pose under
two names. Each is told as what it is, not as a bad fit afterwards.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any
from typing import Protocol as Interface

import numpy as np
import scipy
from numpy.typing import NDArray

from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.recordings.readers.schedule import ScheduleEntry
from jaximu.recordings.recording import Recording, Signal

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

__all__ = ["Entry", "Integral", "entries_of_columns", "match_reference", "rest_rate"]

_MOVING = np.radians(2.0)  # rad/s, mean rate over a second that no pose has
_OFF = 20.0  # degrees between a pose's "up" and what the accelerometer reads as its data sheet has it
_SHIFTS = np.arange(-60.0, 60.01, 0.05)  # s, in which another clock is sought
_STILL = np.radians(0.5)  # rad/s, of a reference at rest
_NOISY = 6.0  # times the usual rate of a reference at rest, which its noise alone does not reach
_WINDOW = 0.25  # s, over which a reference's rate is taken
_SHORTEST, _LONGEST_TURN = 1.0, 120.0  # s


class Entry(Interface):
    """A pose or a turn on the recording's clock, as a schedule or a protocol has it.

    kind: "pose" or "turn". vector (3,): unit, body frame, "up" or the axis. angle: rad. heading: rad or None.
    """

    @property
    def start(self) -> float: ...
    @property
    def stop(self) -> float: ...
    @property
    def kind(self) -> str: ...
    @property
    def vector(self) -> FloatArray: ...
    @property
    def angle(self) -> float: ...
    @property
    def heading(self) -> float | None: ...


class Integral:
    """The running integral of a signal, each sample holding from half way to the one before to half way to the next."""

    def __init__(self, signal: Signal, values: FloatArray):
        middle, period = (signal.time[1:] + signal.time[:-1]) / 2, 1 / signal.rate
        self.edges = np.concatenate([[signal.time[0] - period / 2], middle, [signal.time[-1] + period / 2]])
        self.origin = values.mean(axis=0)  # the sums of what is left lose fewer digits
        steps = (values - self.origin) * np.diff(self.edges)[:, None]
        self.sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])

    def over(self, start, stop) -> FloatArray:
        """Return the integral (..., 3) from `start` to `stop` (...)."""
        start, stop = np.asarray(start), np.asarray(stop)
        ends = [np.stack([np.interp(t, self.edges, axis) for axis in self.sums.T], axis=-1) for t in (start, stop)]
        return ends[1] - ends[0] + self.origin * (stop - start)[..., None]


def rest_rate(integral: Integral, entries: Sequence[Entry]) -> FloatArray:
    """The median of the mean outputs in poses: the gyroscope's bias, for purposes that do not ask for more."""
    rests = np.array([(each.start, each.stop) for each in entries if each.kind == "pose"])
    if not len(rests):
        return np.zeros(3)
    return np.median(integral.over(*rests.T) / np.diff(rests), axis=0)


def match_reference(recording: Recording, entries: Sequence[Entry]) -> tuple[list[Entry], tuple[str, ...]]:
    """Return the entries that can be used, turns without a stated sense given the gyroscope's, and notes.

    Raises `InputError` where the reference does not fit the recording, `NotPossibleError` where nothing is left.
    """
    notes: list[str] = []
    found = [each for each in entries if _inside(recording, each, notes)]
    if not found:
        raise NotPossibleError(f"{recording.name}: the reference names no pose or turn that can be used.")
    gyroscope, where = recording.gyroscope, recording.name
    rate = None if gyroscope is None else Integral(gyroscope, gyroscope.si())
    if rate is not None:
        bias = rest_rate(rate, found)
        found = [_with_sense(each, rate, bias, notes) for each in found]
        _require_units(found, rate, bias, where)
        _require_clock(found, rate, bias, where)
        for each in found:
            if each.kind == "turn":
                _require_turn(each, _turned(each, rate, bias), where)
    _require_poses(recording, [each for each in found if each.kind == "pose"], where)
    return found, tuple(notes)


def _label(each: Entry) -> str:
    return f"{getattr(each, 'label', 'the ' + each.kind)} ({each.start:.6g} to {each.stop:.6g} s)"


def _inside(recording: Recording, each: Entry, notes: list[str]) -> bool:
    """Whether the log holds an entry without a gap."""
    there = [signal for signal in recording.signals.values() if len(signal) > 1]
    first, last = min(signal.time[0] for signal in there), max(signal.time[-1] for signal in there)
    for signal in (recording.accelerometer, recording.gyroscope):
        if signal is None or not len(signal):
            continue
        slack = 1.5 / signal.rate
        if each.start < first - slack or each.stop > last + slack:
            raise InputError(
                f"{_label(each)} lies outside of the log ({first:.6g} to {last:.6g} s): the reference is not on the "
                "log's clock, or belongs to another log."
            )
        inside = signal.time[(signal.time > each.start) & (signal.time < each.stop)]
        stamps = np.concatenate([[each.start], inside, [each.stop]])
        if len(inside) < 3 or np.diff(stamps).max() > max(5 / signal.rate, 0.05):
            notes.append(f"{_label(each)} is left out: samples are missing there.")
            return False
    return True


def _turned(each: Entry, rate: Integral, bias: FloatArray) -> FloatArray:
    """The angle (3,), rad, that the gyroscope shows."""
    return rate.over(each.start, each.stop) - bias * (each.stop - each.start)


def _with_sense(each: Entry, rate: Integral, bias: FloatArray, notes: list[str]) -> Entry:
    if each.kind == "pose" or not math.isnan(each.angle):
        return each
    sense = math.copysign(2 * math.pi, float(_turned(each, rate, bias) @ each.vector))
    notes.append("turns whose angle is not stated are taken as 360° in the sense that the gyroscope shows.")
    assert isinstance(each, ScheduleEntry)
    return replace(each, angle=sense)


def _require_units(entries: Sequence[Entry], rate: Integral, bias: FloatArray, where: str) -> None:
    ratios = [float(_turned(e, rate, bias) @ e.vector) / e.angle for e in entries if e.kind == "turn"]
    if not ratios:
        return
    ratio = float(np.median(np.abs(ratios)))
    for slip, text in (
        (57.29578, "its angles are in rad though its header says deg, or the gyroscope is in deg/s though its columns "
                   "say rad/s"),
        (1 / 57.29578, "its angles are in deg though its header says rad, or the gyroscope is in rad/s though its "
                       "columns say deg/s"),
    ):  # fmt: skip
        if abs(math.log(max(ratio, 1e-9) / slip)) < math.log(1.4):
            raise InputError(
                f"{where}: the gyroscope turns {ratio:.3g} times as far as the reference says: {text}; correct the "
                "unit."
            )


def _require_clock(entries: Sequence[Entry], rate: Integral, bias: FloatArray, where: str) -> None:
    """Refuse a reference whose poses hold motion, and say which shift would suit better."""
    moving = []
    for each in entries:
        if each.kind == "pose":
            edges = np.linspace(each.start, each.stop, max(2, math.ceil(each.stop - each.start) + 1))
            mean = rate.over(edges[:-1], edges[1:]) / np.diff(edges)[:, None] - bias
            if np.linalg.norm(mean, axis=1).max() > _MOVING:
                moving.append(each)
    if not moving:
        return
    span = np.array([(each.start, each.stop) for each in entries])
    said = np.array([each.angle * each.vector if each.kind == "turn" else np.zeros(3) for each in entries])

    rest = ~said.any(axis=1)
    weight = np.where(rest, 100.0, 1.0)  # turns are off by the scale's error, rests by next to nothing

    def misfit(shift: float) -> float:
        start, stop = (np.clip(edge + shift, rate.edges[0], rate.edges[-1] - 1e-3) for edge in span.T)
        turned, duration = rate.over(start, stop), np.maximum(stop - start, 1e-3)[:, None]
        own = np.median(turned[rest] / duration[rest], axis=0)  # the bias, were this the right shift
        return float(np.sum(weight * np.abs(turned - own * duration - said).sum(axis=1)))

    found = [misfit(shift) for shift in _SHIFTS]
    best = float(_SHIFTS[int(np.argmin(found))])
    text = f"{where}: the unit moves in {len(moving)} of the poses, first in {_label(moving[0])}"
    if min(found) < 0.5 * misfit(0.0) and abs(best) > 0.1:
        raise InputError(
            f"{text}: the reference does not match the log in time. It would, were it about {abs(best):.1f} s "
            f"{'later' if best > 0 else 'earlier'}: add {best:+.1f} s to its times."
        )
    raise InputError(f"{text}: the reference does not match the log in time, or belongs to another log.")


def _require_turn(each: Entry, turned: FloatArray, where: str) -> None:
    along = float(turned @ each.vector)
    across = float(np.linalg.norm(turned - along * each.vector))
    if 0.7 < along / each.angle < 1.4 and across < 0.3 * abs(each.angle):
        return
    said = f"{where}: {_label(each)} says {math.degrees(each.angle):.4g}° about its axis; the gyroscope shows "
    if 0.7 < -along / each.angle < 1.4:
        raise InputError(
            f"{said}{math.degrees(along):.4g}°: the sense is turned round in the reference, or the gyroscope's axis "
            "(see --axes)."
        )
    shown = ", ".join(f"{value:.4g}°" for value in np.degrees(turned))
    raise InputError(f"{said}{shown} about x, y, z: the reference does not describe this turn, or not at this time.")


def _require_poses(recording: Recording, poses: Sequence[Entry], where: str) -> None:
    if not poses or not len(recording.accelerometer):
        return
    force = Integral(recording.accelerometer, recording.accelerometer.si())
    span = np.array([(each.start, each.stop) for each in poses])
    read = force.over(*span.T)
    read = read / np.linalg.norm(read, axis=1, keepdims=True)
    said = np.stack([each.vector for each in poses])
    off = np.degrees(np.arccos(np.clip(np.sum(read * said, axis=1), -1, 1)))
    if not (off > _OFF).any():
        return
    if (off > 180 - _OFF).all():
        raise InputError(
            f'{where}: the accelerometer reads the opposite of "up" in every pose: it records minus the specific '
            "force; say so with --axes=-f."
        )
    worst = int(np.argmax(off))
    alike = [k for k in range(len(poses)) if k != worst and read[k] @ read[worst] > math.cos(math.radians(5))
             and said[k] @ said[worst] < math.cos(math.radians(_OFF))]  # fmt: skip
    text = f"{where}: {_label(poses[worst])}: the accelerometer reads "
    if alike:
        raise InputError(
            f"{text}the same pose as in {_label(poses[alike[0]])}, which has another name: one pose stands under two "
            "names."
        )
    shown = ", ".join(f"{value:+.2f}" for value in read[worst])
    raise InputError(
        f'{text}{off[worst]:.0f}° from the stated "up" (it points to {shown}): the reference names another pose, or '
        "the axes are others (see --axes)."
    )


# --- reference columns ----------------------------------------------------------------------------------------------


def entries_of_columns(recording: Recording) -> list[Entry]:
    """Return poses (the reference at rest for a second or more) and the turns between them from reference columns.

    An attitude tells all. A table's angle or rate tells turns about the table's axis, which then must be vertical and
    along an axis of the body: the accelerometer tells which. Raises `InputError` without reference columns,
    `NotPossibleError` where there is no rest or the table's axis cannot be told.
    """
    if recording.attitude is not None:
        return _entries_of_attitude(recording, recording.attitude)
    signal = recording.table_angle or recording.table_rate
    if signal is None:
        raise InputError(
            f"{recording.name}: has no reference columns: table_angle, table_rate, or attitude_w, attitude_x, "
            "attitude_y, attitude_z; name a schedule or a file with such columns (--reference)."
        )
    if recording.table_angle is not None:
        angle = np.unwrap(signal.values[:, 0])
    else:
        integral = Integral(signal, signal.values)
        angle = integral.over(np.full(len(signal), integral.edges[0]), signal.time)[:, 0]
    return _entries_of_table(recording, signal.time, angle)


def _rests(time: FloatArray, moved: FloatArray, where: str) -> FloatArray:
    """Intervals (n, 2) over which the reference rests; `moved` (n,) is its rate at each stamp, its noise included."""
    lowest = float(np.percentile(moved, 5))
    limit = float(np.clip(_NOISY * np.median(moved[moved <= 3 * lowest]), _STILL, _MOVING))
    still = np.concatenate([[False], moved < limit, [False]])
    edges = np.flatnonzero(np.diff(still.astype(int)))
    spans = np.stack([time[edges[::2]] + _WINDOW, time[edges[1::2] - 1] - _WINDOW], axis=1)
    spans = spans[spans[:, 1] - spans[:, 0] >= _SHORTEST]
    if not len(spans):
        raise NotPossibleError(f"{where}: the reference never rests for {_SHORTEST:g} s: record rests between turns.")
    return spans


def _entries_of_attitude(recording: Recording, attitude: Signal) -> list[Entry]:
    length = np.linalg.norm(attitude.values, axis=1)
    if (np.abs(length - 1) > 0.01).any():
        place = int(np.argmax(np.abs(length - 1)))
        raise InputError(
            f"{recording.name}: the attitude at {attitude.time[place]:.6g} s has the length {length[place]:.4g}; a "
            "unit quaternion has the length 1."
        )

    def at(places: NDArray[Any]) -> Rotation:
        return scipy.spatial.transform.Rotation.from_quat(attitude.values[places], scalar_first=True)

    step = max(1, round(_WINDOW * attitude.rate / 2))
    here = np.arange(len(attitude))
    before, after = np.maximum(here - step, 0), np.minimum(here + step, len(attitude) - 1)
    angle = (at(before).inv() * at(after)).magnitude()
    spans = _rests(attitude.time, angle / (attitude.time[after] - attitude.time[before]), recording.name)
    entries: list[Entry] = []
    for place, (start, stop) in enumerate(spans):
        inside = (attitude.time >= start) & (attitude.time <= stop)
        up = at(inside).inv().apply([0.0, 0.0, 1.0]).mean(axis=0)
        entries.append(ScheduleEntry(start, stop, "pose", up / np.linalg.norm(up), label="the pose"))
        if place + 1 < len(spans) and spans[place + 1, 0] - stop < _LONGEST_TURN:
            during = np.flatnonzero((attitude.time >= stop) & (attitude.time <= spans[place + 1, 0]))
            total = (at(during[:-1]).inv() * at(during[1:])).as_rotvec().sum(axis=0)
            turned = float(np.linalg.norm(total))
            if turned > np.radians(5):
                entries.append(
                    ScheduleEntry(stop, spans[place + 1, 0], "turn", total / turned, turned, label="the turn")
                )
    return entries


def _entries_of_table(recording: Recording, time: FloatArray, angle: FloatArray) -> list[Entry]:
    step = max(1, round(_WINDOW / np.median(np.diff(time)) / 2))
    here = np.arange(len(time))
    before, after = np.maximum(here - step, 0), np.minimum(here + step, len(time) - 1)
    moved = np.abs(angle[after] - angle[before]) / (time[after] - time[before])
    if recording.gyroscope is not None:  # a unit is mounted anew while the table stands
        rate = Integral(recording.gyroscope, recording.gyroscope.si())
        mean = rate.over(time[before], time[after]) / (time[after] - time[before])[:, None]
        off = np.linalg.norm(mean - np.median(mean[moved < _STILL], axis=0), axis=1)
        moved = np.where(off > _MOVING, np.inf, moved)
    spans = _rests(time, moved, recording.name)
    if not len(recording.accelerometer):
        raise NotPossibleError(
            f"{recording.name}: holds a gyroscope alone, and table columns do not say about which of its axes the "
            "table turns; write a schedule."
        )
    force = Integral(recording.accelerometer, recording.accelerometer.si())
    entries: list[Entry] = []
    ups = []
    for start, stop in spans:
        read = force.over(start, stop)
        place = int(np.argmax(np.abs(read)))
        up = np.sign(read[place]) * np.eye(3)[place]
        off = math.degrees(math.acos(min(1.0, abs(read[place]) / float(np.linalg.norm(read)))))
        if off > _OFF:
            raise NotPossibleError(
                f"{recording.name}: from {start:.6g} to {stop:.6g} s no axis of the body is vertical ({off:.0f}° off): "
                "table columns describe only turns about a vertical body axis; write a schedule for other poses."
            )
        ups.append(up)
    for place, ((start, stop), up) in enumerate(zip(spans, ups, strict=True)):
        heading = float(np.interp((start + stop) / 2, time, angle)) if recording.table_angle is not None else None
        entries.append(ScheduleEntry(start, stop, "pose", up, heading=heading, label="the pose"))
        if place + 1 < len(spans) and up @ ups[place + 1] > 0.5:
            following = spans[place + 1, 0]
            turned = float(np.interp(following, time, angle) - np.interp(stop, time, angle))
            if abs(turned) > np.radians(5) and following - stop < _LONGEST_TURN:
                entries.append(ScheduleEntry(stop, following, "turn", up, turned, label="the turn"))
    return entries
