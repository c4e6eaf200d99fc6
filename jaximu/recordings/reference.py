"""Does what the set-up says fit what was recorded? And poses and turns from reference columns. NumPy, host side.

Slips of people are looked for first: another clock, degrees for radians, an axis turned the wrong way, one pose under
two names. Each is told as what it is, not as a bad fit afterwards.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import scipy

from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.ground.differences import interpolated
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.rotation import unit_vectors
from jaximu.ground.vectors import dot_rows, lengths_of
from jaximu.recordings.attitude import UNIT_LENGTH
from jaximu.recordings.entry import ScheduleEntry, times_of
from jaximu.recordings.recording import Recording, Signal, floor_of, runs_of

_MOVING = np.radians(2.0)  # rad/s, mean rate over a second that no pose has
_OFF = 20.0  # degrees between a pose's "up" and what the accelerometer reads as its data sheet has it
_SHIFTS = np.arange(-60.0, 60.01, 0.05)  # s, in which another clock is sought
_STILL = np.radians(0.5)  # rad/s, of a reference at rest
_NOISY = 6.0  # times the usual rate of a reference at rest, which its noise alone does not reach
_WINDOW = 0.25  # s, over which a reference's rate is taken
_SHORTEST, _LONGEST_TURN = 1.0, 120.0  # s
_SMALLEST_TURN = np.radians(5)


class Integral:
    """The running integral of a signal, each sample holding from half way to the one before to half way to the next.

    values: (n, m) of its samples; its output in SI by default.
    """

    def __init__(self, signal: Signal, values: FloatArray | None = None):
        values = signal.si() if values is None else values
        self.edges = signal.edges
        self.origin = values.mean(axis=0)  # the sums of what is left lose fewer digits
        steps = (values - self.origin) * np.diff(self.edges)[:, None]
        self.sums = np.cumulative_sum(steps, axis=0, include_initial=True)

    def over(self, start, stop) -> FloatArray:
        """Return the integral (..., 3) from `start` to `stop` (...)."""
        start, stop = np.asarray(start), np.asarray(stop)
        ends = [interpolated(self.edges, self.sums, t) for t in (start, stop)]
        return ends[1] - ends[0] + self.origin * (stop - start)[..., None]


def means_over(signal: Signal, span: FloatArray) -> FloatArray:
    """Return the means (n, m) of a signal between times (n, 2), in its unit."""
    return Integral(signal, signal.values).over(*span.T) / np.diff(span)


def rest_rate(integral: Integral, entries: Sequence[ScheduleEntry]) -> FloatArray:
    """The median of the mean outputs in poses: the gyroscope's bias, for purposes that do not ask for more."""
    rests = times_of([entry for entry in entries if entry.kind == "pose"])
    if not len(rests):
        return np.zeros(3)
    return np.median(integral.over(*rests.T) / np.diff(rests), axis=0)


def match_reference(
    recording: Recording, entries: Sequence[ScheduleEntry]
) -> tuple[list[ScheduleEntry], tuple[str, ...]]:
    """Return the entries that can be used, turns without a stated sense given the gyroscope's, and notes.

    Raises `InputError` where the reference does not fit the recording, `NotPossibleError` where nothing is left.
    """
    notes = []
    usable = [entry for entry in entries if _inside(recording, entry, notes)]
    where, gyroscope = recording.name, recording.gyroscope
    if not usable:
        raise NotPossibleError(f"{where}: the reference names no pose or turn that can be used.")
    if gyroscope is not None:
        rate = Integral(gyroscope)
        bias = rest_rate(rate, usable)
        usable = [_with_sense(entry, rate, bias, notes) for entry in usable]
        turns = [(entry, _turned(entry, rate, bias)) for entry in usable if entry.kind == "turn"]
        _require_units(turns, where)
        _require_clock(usable, rate, bias, where)
        for entry, turned in turns:
            _require_turn(entry, turned, where)
    _require_poses(recording, [entry for entry in usable if entry.kind == "pose"], where)
    return usable, tuple(notes)


def _label(entry: ScheduleEntry) -> str:
    return f"{entry.label or f'the {entry.kind}'} ({entry.start:.6g} to {entry.stop:.6g} s)"


def _inside(recording: Recording, entry: ScheduleEntry, notes: list[str]) -> bool:
    """Whether the log holds an entry without a gap."""
    there = [signal for signal in recording.signals.values() if len(signal) > 1]
    first, last = min(signal.time[0] for signal in there), max(signal.time[-1] for signal in there)
    for signal in (recording.accelerometer, recording.gyroscope):
        if signal is None or not len(signal):
            continue
        slack = 1.5 / signal.rate
        if entry.start < first - slack or entry.stop > last + slack:
            raise InputError(
                f"{_label(entry)} lies outside of the log ({first:.6g} to {last:.6g} s): the reference is not on the "
                "log's clock, or belongs to another log."
            )
        inside = signal.time[(signal.time > entry.start) & (signal.time < entry.stop)]
        stamps = np.concatenate([[entry.start], inside, [entry.stop]])
        if len(inside) < 3 or np.diff(stamps).max() > max(5 / signal.rate, 0.05):
            notes.append(f"{_label(entry)} is left out: samples are missing there.")
            return False
    return True


def _turned(entry: ScheduleEntry, rate: Integral, bias: FloatArray) -> FloatArray:
    """The angle (3,), rad, that the gyroscope shows."""
    return rate.over(entry.start, entry.stop) - bias * (entry.stop - entry.start)


def _with_sense(entry: ScheduleEntry, rate: Integral, bias: FloatArray, notes: list[str]) -> ScheduleEntry:
    if entry.kind == "pose" or not math.isnan(entry.angle):
        return entry
    sense = math.copysign(2 * math.pi, _turned(entry, rate, bias) @ entry.vector)
    notes.append("turns whose angle is not stated are taken as 360° in the sense that the gyroscope shows.")
    return replace(entry, angle=sense)


def _require_units(turns: Sequence[tuple[ScheduleEntry, FloatArray]], where: str) -> None:
    """Refuse angles in another unit than the gyroscope's; `turns`: with the angle (3,) that the gyroscope shows."""
    ratio = np.median([np.linalg.norm(turned) / abs(entry.angle) for entry, turned in turns] or [1.0])
    for slip, unit, other in ((57.29578, "rad", "deg"), (1 / 57.29578, "deg", "rad")):
        if abs(math.log(max(ratio, 1e-9) / slip)) < math.log(1.4):
            raise InputError(
                f"{where}: the gyroscope turns {ratio:.3g} times as far as the reference says: its angles are in "
                f"{unit} though its header says {other}, or the gyroscope is in {other}/s though its columns say "
                f"{unit}/s; correct the unit."
            )


def _require_clock(entries: Sequence[ScheduleEntry], rate: Integral, bias: FloatArray, where: str) -> None:
    """Refuse a reference whose poses hold motion, and say which shift would suit better."""
    moving = []
    for entry in entries:
        if entry.kind == "pose":
            edges = np.linspace(entry.start, entry.stop, max(2, math.ceil(entry.stop - entry.start) + 1))
            mean = rate.over(edges[:-1], edges[1:]) / np.diff(edges)[:, None] - bias
            if lengths_of(mean).max() > _MOVING:
                moving.append(entry)
    if not moving:
        return
    span = times_of(entries)
    stated = np.array([entry.angle * entry.vector if entry.kind == "turn" else np.zeros(3) for entry in entries])
    rest = ~stated.any(axis=1)
    weight = np.where(rest, 100.0, 1.0)  # turns are off by the scale's error, rests by next to nothing

    def misfit(shift: float) -> float:
        start, stop = (np.clip(edge + shift, rate.edges[0], rate.edges[-1] - 1e-3) for edge in span.T)
        turned, duration = rate.over(start, stop), np.maximum(stop - start, 1e-3)[:, None]
        shifted_bias = np.median(turned[rest] / duration[rest], axis=0)
        return float((weight * np.abs(turned - shifted_bias * duration - stated).sum(axis=1)).sum())

    misfits = [misfit(shift) for shift in _SHIFTS]
    best = _SHIFTS[np.argmin(misfits)]
    text = f"{where}: the unit moves in {len(moving)} of the poses, first in {_label(moving[0])}"
    if min(misfits) < 0.5 * misfit(0.0) and abs(best) > 0.1:
        raise InputError(
            f"{text}: the reference does not match the log in time. It would, were it about {abs(best):.1f} s "
            f"{'later' if best > 0 else 'earlier'}: add {best:+.1f} s to its times."
        )
    raise InputError(f"{text}: the reference does not match the log in time, or belongs to another log.")


def _require_turn(entry: ScheduleEntry, turned: FloatArray, where: str) -> None:
    along = turned @ entry.vector
    across = np.linalg.norm(turned - along * entry.vector)
    if 0.7 < along / entry.angle < 1.4 and across < 0.3 * abs(entry.angle):
        return
    text = f"{where}: {_label(entry)} says {math.degrees(entry.angle):.4g}° about its axis; the gyroscope shows "
    if 0.7 < -along / entry.angle < 1.4:
        raise InputError(
            f"{text}{math.degrees(along):.4g}°: the sense is turned round in the reference, or the gyroscope's axis "
            "(see --axes)."
        )
    shown = ", ".join(f"{value:.4g}°" for value in np.degrees(turned))
    raise InputError(f"{text}{shown} about x, y, z: the reference does not describe this turn, or not at this time.")


def _require_poses(recording: Recording, poses: Sequence[ScheduleEntry], where: str) -> None:
    if not poses or not len(recording.accelerometer):
        return
    read = unit_vectors(Integral(recording.accelerometer).over(*times_of(poses).T))
    stated = np.stack([pose.vector for pose in poses])
    off = np.degrees(np.arccos(dot_rows(read, stated).clip(-1, 1)))
    if not (off > _OFF).any():
        return
    if (off > 180 - _OFF).all():
        raise InputError(
            f'{where}: the accelerometer reads the opposite of "up" in every pose: it records minus the specific '
            "force; say so with --axes=-f."
        )
    worst = int(off.argmax())
    same = (read @ read[worst] > math.cos(math.radians(5))) & (stated @ stated[worst] < math.cos(math.radians(_OFF)))
    alike = np.flatnonzero(same)
    text = f"{where}: {_label(poses[worst])}: the accelerometer reads "
    if len(alike):
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


def entries_of_columns(recording: Recording) -> list[ScheduleEntry]:
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
        integral = Integral(signal)
        angle = integral.over(np.full(len(signal), integral.edges[0]), signal.time)[:, 0]
    return _entries_of_table(recording, signal.time, angle)


def _rests(time: FloatArray, moved: FloatArray, where: str) -> FloatArray:
    """Intervals (n, 2) over which the reference rests; `moved` (n,) is its rate at each stamp, its noise included."""
    runs = runs_of(moved < np.clip(_NOISY * floor_of(moved), _STILL, _MOVING))
    spans = np.stack([time[runs[:, 0]] + _WINDOW, time[runs[:, 1] - 1] - _WINDOW], axis=1)
    spans = spans[spans[:, 1] - spans[:, 0] >= _SHORTEST]
    if not len(spans):
        raise NotPossibleError(f"{where}: the reference never rests for {_SHORTEST:g} s: record rests between turns.")
    return spans


def _neighbours(count: int, samples: float) -> tuple[IntArray, IntArray]:
    """The samples so many before and after each of `count`, as far as there are any."""
    step, index = max(1, round(samples)), np.arange(count)
    return np.maximum(index - step, 0), np.minimum(index + step, count - 1)


def _entries_of_attitude(recording: Recording, attitude: Signal) -> list[ScheduleEntry]:
    length = lengths_of(attitude.values)
    if (np.abs(length - 1) > UNIT_LENGTH).any():
        worst = np.abs(length - 1).argmax()
        raise InputError(
            f"{recording.name}: the attitude at {attitude.time[worst]:.6g} s has the length {length[worst]:.4g}; a "
            "unit quaternion has the length 1."
        )

    rotation = scipy.spatial.transform.Rotation.from_quat(attitude.values, scalar_first=True)
    before, after = _neighbours(len(attitude), _WINDOW * attitude.rate / 2)
    angle = (rotation[before].inv() * rotation[after]).magnitude()
    spans = _rests(attitude.time, angle / (attitude.time[after] - attitude.time[before]), recording.name)
    entries = []
    for index, (start, stop) in enumerate(spans):
        up = rotation[(attitude.time >= start) & (attitude.time <= stop)].inv().apply([0.0, 0.0, 1.0]).mean(axis=0)
        entries.append(ScheduleEntry(start, stop, "pose", up / np.linalg.norm(up)))
        if index + 1 < len(spans) and (following := spans[index + 1, 0]) - stop < _LONGEST_TURN:
            during = rotation[(attitude.time >= stop) & (attitude.time <= following)]
            total = (during[:-1].inv() * during[1:]).as_rotvec().sum(axis=0)
            turned = float(np.linalg.norm(total))
            if turned > _SMALLEST_TURN:
                entries.append(ScheduleEntry(stop, following, "turn", total / turned, turned))
    return entries


def _entries_of_table(recording: Recording, time: FloatArray, angle: FloatArray) -> list[ScheduleEntry]:
    before, after = _neighbours(len(time), _WINDOW / np.median(np.diff(time)) / 2)
    moved = np.abs(angle[after] - angle[before]) / (time[after] - time[before])
    if recording.gyroscope is not None:  # a unit is mounted again while the table stands
        mean = Integral(recording.gyroscope).over(time[before], time[after]) / (time[after] - time[before])[:, None]
        off = lengths_of(mean - np.median(mean[moved < _STILL], axis=0))
        moved = np.where(off > _MOVING, np.inf, moved)
    spans = _rests(time, moved, recording.name)
    if not len(recording.accelerometer):
        raise NotPossibleError(
            f"{recording.name}: holds a gyroscope alone, and table columns do not say about which of its axes the "
            "table turns; write a schedule."
        )
    read = Integral(recording.accelerometer).over(*spans.T)
    size = np.abs(read)
    axis = size.argmax(axis=1)
    ups = np.sign(np.take_along_axis(read, axis[:, None], 1)) * np.eye(3)[axis]
    off = np.degrees(np.arccos(np.minimum(1.0, size.max(axis=1) / lengths_of(read))))
    if len(tilted := np.flatnonzero(off > _OFF)):
        first = tilted[0]
        start, stop = spans[first]
        raise NotPossibleError(
            f"{recording.name}: from {start:.6g} to {stop:.6g} s no axis of the body is vertical ({off[first]:.0f}° "
            "off): table columns describe only turns about a vertical body axis; write a schedule for other poses."
        )
    entries = []
    for index, ((start, stop), up) in enumerate(zip(spans, ups, strict=True)):
        heading = np.interp((start + stop) / 2, time, angle) if recording.table_angle is not None else None
        entries.append(ScheduleEntry(start, stop, "pose", up, heading=heading))
        if index + 1 < len(spans) and up @ ups[index + 1] > 0.5:
            edges = np.array([stop, *_turned_back(time, angle, stop, spans[index + 1, 0]), spans[index + 1, 0]])
            for (begin, end), turned in zip(pairwise(edges), np.diff(np.interp(edges, time, angle)), strict=True):
                if abs(turned) > _SMALLEST_TURN and end - begin < _LONGEST_TURN:
                    entries.append(ScheduleEntry(begin, end, "turn", up, float(turned)))
    return entries


def _turned_back(time: FloatArray, angle: FloatArray, start: float, stop: float) -> FloatArray:
    """Return when between two rests a table's angle (n,) turns back: what it turns to and fro is no turn in all."""
    during = (time > start) & (time < stop)
    back = [scipy.signal.find_peaks(sign * angle[during], prominence=_SMALLEST_TURN)[0] for sign in (1, -1)]
    return time[during][np.sort(np.concatenate(back))]
