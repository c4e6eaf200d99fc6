"""What the columns of a table are where its header does not say it all: by names first, by physics second.

Names are read by `jaximu.recordings.columns.habits`. Physics knows a sensor by what it must do: an accelerometer holds
1 g at rest in every pose, a gyroscope's rates integrate to what gravity does, time rises, four numbers of norm 1 are a
quaternion. Where a column stands proves nothing. What neither settles is asked: a `?` in the line to paste.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError
from jaximu.ground.quantities import listed, unit_text
from jaximu.ground.units import SENSORS, STANDARD_GRAVITY, Unit, column_title, find_unit, parse_column
from jaximu.ground.units import unit as unit_named
from jaximu.ground.vectors import column_lengths, lengths_of
from jaximu.recordings.alignment import CORRELATED, Turning, turning
from jaximu.recordings.columns.habits import Field, fields_of, last_of, measures, sensor_of, words_of
from jaximu.recordings.columns.known import EPOCH
from jaximu.recordings.columns.names import (
    CLOCKS,
    COUNTS_ADVICE,
    GROUPS,
    SINGLE,
    TIME,
    Column,
    header_columns,
    rises,
    shuffled,
)
from jaximu.recordings.columns.nominal import fit_sphere, quiet_means
from jaximu.recordings.columns.table import LogTable
from jaximu.recordings.recording import FASTEST, SLOWEST, Signal, likeliest

ASSUMED_RATE = 100.0  # Hz, of a log that does not say it

_GRAVITY_IN = {name: STANDARD_GRAVITY / unit_named(name).factor for name in ("m/s^2", "g", "mg", "cm/s^2")}
_PLAUSIBLE = 0.5, 8000.0
_LIKELY = 5.0, 4000.0
"""Hz: sample rates that a log may have, stamps that mean another are in another unit; and that one with turns has."""
_MIDDLE_RATE = 50.0  # Hz; of two rates that stamps may mean, the nearer one on a log scale is likelier
_TIME_UNITS = [(name, unit_named(name).factor) for name in ("s", "ms", "us", "ns", "100 us")]
_DAY, _DATES = 86400.0, ((3e4, 8e4), (7.24e5, 7.74e5))
"""Seconds, and the days of the years 1982 to 2119 since 1900, as in spreadsheets, and since 0, as in MATLAB."""
_STEADY = 0.12
"""Scatter of the norm over poses, of its mean, below which a triad holds something constant."""
_PER_G = (16384, 8192, 4096, 2048, 1024, 512, 256)
_PER_DEGREE = (131, 65.5, 32.8, 16.4, 114.2857, 57.1429, 28.5714, 14.2857, 14.375, 262)
_USUAL_RATE = f"{ASSUMED_RATE:g}"
_USUAL_SCALE = "131 count/(deg/s)"  # of a range of 250 deg/s
_COUNTERS = set(
    "counter count packet index sample frame seq number id row line n no iteration loop samples packetcounter "
    "status".split()
)
_ANGLES = {name: unit_named(name).factor for name in ("rad/s", "deg/s", "mdeg/s", "mrad/s")}
_PLAIN = set("var column col field data channel ch ans unnamed imu c v x y out simout value".split())
"""Words that say nothing of a column."""
_SHOWN = 3
_UNIT_LENGTH = 2e-3  # that the norm of a quaternion may be off by, as few digits make it
_ATTITUDES = {"q", "quat", "quaternion", "orientation", "attitude"}
_ROUGH = 0.15  # logarithm by which turns may be off what a gyroscope's scale makes of them
_TURNING = 5.0  # times the scatter in them by which means of a gyroscope at rest do not differ
_ANOTHER = math.log(2.0)  # logarithm by which a level must miss 1 g or the Earth's field for its unit to be another
_COPY = 0.99  # share of an accelerometer's variance that its own values in another unit explain
_HOTTEST = 125.0  # °C that a sensor survives
_KELVIN, _EITHER = (
    (200.0, 400.0),
    (32.0, 60.0),
)  # numbers in K; from above the one to above the other: °C or °F
_DIRECTIONS = {
    "x": "longitudinal long forward fore front surge",
    "y": "lateral lat left right sway transverse sideways",
    "z": "vertical vert up down heave",
}
"""Words for the axes of a vehicle."""
_TURN = "turn gravity as the accelerometer shows"


@dataclass(frozen=True)
class OpenPoint:
    """What a table leaves open, for a person to answer.

    option: the one that it is about, as in `ReadOptions`. blank: what stands for the answer in that option's value, its
    "?" to be replaced; empty where nothing does. default: what one would take, None where nothing can be assumed.
    """

    text: str
    option: str = "columns"
    blank: str = ""
    default: str | None = None


@dataclass(frozen=True)
class Advice:
    """How to read a table: options to paste, why, what is still to be answered, and the first rows to compare with.

    accelerometer: whether one was found.
    columns, rate, accel_scale, gyro_scale: as in `ReadOptions`; None where the file says it itself. A `?` is to be
    filled in, and `questions` say what is asked. magnetometer: the columns with which a magnetometer alone is read.
    """

    columns: str | None = None
    rate: str | None = None
    accel_scale: str | None = None
    gyro_scale: str | None = None
    reasons: tuple[str, ...] = ()
    questions: tuple[OpenPoint, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    accelerometer: bool = False
    magnetometer: str | None = None

    @property
    def readable(self) -> bool:
        """Whether at most the sample rate and the scales of counts are left to ask."""
        return self.accelerometer and "?" not in (self.columns or "")

    def line(self, option: str = "--columns") -> str:
        """The options as one types them."""
        named = {
            option: self.columns,
            "--rate": self.rate,
            "--accel-scale": self.accel_scale,
            "--gyro-scale": self.gyro_scale,
        }
        return " ".join(
            f'{name} "{value}"' if name == option or " " in value else f"{name} {value}"
            for name, value in named.items()
            if value
        )

    def sentence(self, option: str = "--columns", lead: str = "") -> str:
        """The line behind what leads to it, what is asked, and why, in one line of text; no lead without a line."""
        questions = " ".join(question.text for question in self.questions)
        why = f" Why: {'; '.join(self.reasons)}." if self.reasons else ""
        if line := self.line(option):
            return f"{lead}{line}.{questions and ' Answer first: '}{questions}{why}"
        return f"{lead and '. '}{questions}{why}"


@dataclass(eq=False)
class _Triad:
    """Three columns of one sensor, and what is known of them."""

    places: Sequence[int]
    label: str
    values: FloatArray  # (n, 3), rows that are whole
    rows: np.ndarray  # their indices
    sensor: str | None = None
    unit: str | None = None
    named: bool = True  # by a word of its name, not by its unit alone
    loose: bool = False  # one of several ways to take three of some columns side by side
    plain: int = 0  # words of the name that say more than the sensor: filtered, low, noise

    def __post_init__(self) -> None:
        size = max(5, min(50, len(self.values) // 20))
        count = len(self.values) // size
        cut = self.values[: count * size].reshape(count, size, 3) if count else self.values[None]
        scatter = cut.var(axis=1).sum(axis=1)
        low = np.percentile(scatter, 10)
        every_mean = cut.mean(axis=1)
        means = every_mean[scatter <= max(4 * low, 1e-12)]
        norm = lengths_of(means)
        self.level = float(np.median(norm))
        # rms of an axis in its quiet windows
        self.noise = float(np.sqrt(np.median(np.sort(scatter)[: max(1, len(scatter) // 4)]) / 3))
        # its quiet windows are rest, seen from the size of what it holds
        self.still = self.noise < 0.03 * self.level
        self.steady = bool(self.level > 0 and norm.std() < _STEADY * self.level)
        directions = means / np.maximum(norm[:, None], 1e-300)
        self.posed = bool(len(means) > 3 and np.linalg.norm(directions.mean(axis=0)) < 0.9)
        # the norm changes where it moves, as a magnetometer's does not
        jitter = np.diff(lengths_of(cut), axis=1).std(axis=1)
        moving = scatter > 30 * max(low, 1e-12)
        self.lively = bool(moving.sum() > 2 and np.median(jitter[moving]) > 3 * np.median(jitter[~moving]))
        some = self.values[:20000]
        self.whole = bool(np.all(some == np.round(some)) and np.ptp(some) > 20)
        # its quiet means lie on a sphere
        self.round = self.whole and self.sphere(np.arange(len(self.values)) / 100.0) is not None
        # its means change by more than noise: a gyroscope turns, if only about the vertical
        self.turns = bool(count > 3 and np.std(every_mean, axis=0).max() > _TURNING * self.noise)

    def sphere(self, time: FloatArray) -> tuple[FloatArray, float] | None:
        """Centre and radius of the sphere on which the means of its quiet windows lie, if any; `time`: s."""
        return fit_sphere(quiet_means(Signal(time, self.values, "count")))

    @property
    def gravity_unit(self) -> str | None:
        """The unit in which it holds 1 g at rest, "?" where several fit; "count": something else in whole numbers."""
        if not self.steady:
            return None
        best, off = likeliest(self.level, _GRAVITY_IN)
        if off > math.log(1.15):
            return "count" if self.whole and self.level > 50 else None
        if best in ("mg", "cm/s^2"):  # 1000 mg, 981 cm/s² and 1024 counts are close together
            if not self.still:
                return "?"
            if self.whole and abs(self.level - 1024) < 8:
                return "count"
            return "mg" if abs(self.level - 1000) < 10 else "?"
        return best


def left_open(columns: str) -> tuple[OpenPoint, ...]:
    """What is asked where options alone leave it open, first what changes the answer most; `columns`: as stated."""
    return (
        OpenPoint(
            "Is the gyroscope in deg/s or rad/s?",
            "columns",
            "gyro [?]",
            "rad/s" if "accel [m/s^2]" in columns else "deg/s",
        ),
        OpenPoint("In which unit is the time?", "columns", "time [?]"),
        OpenPoint("In which unit is the accelerometer?", "columns", "accel [?]"),
        OpenPoint("How many samples a second? No column is the time.", "rate", "?", _USUAL_RATE),
        OpenPoint("Which scale have the gyroscope's counts?", "gyro_scale", "?", _USUAL_SCALE),
    )


def advise(table: LogTable, sensor: str | None = None) -> Advice:
    """Say how to read a table whose header does not say it all. `sensor`: the one that it must hold, if alone."""
    return _Guess(table, sensor).advice()


def without_gravity(table: LogTable) -> str:
    """Say what stands in a table in place of an accelerometer, where its gravity was taken out; else nothing."""
    guess = _Guess(table, None)
    guess._named_triads()
    return guess._without_gravity()


def counted_rows(table: LogTable) -> tuple[str, np.ndarray] | None:
    """The column that counts the rows and leaves a few out, and each row's number (n,) by it; None without one."""
    for at, column in enumerate(table.columns):
        if column.dtype.kind != "i" or not set(words_of(table.header[at])) & _COUNTERS:
            continue
        bits = next((bits for bits in (8, 16, 32) if column.max() < 1 << bits), 63)
        steps = np.diff(column) % (1 << bits)
        if steps.min() > 0 and 1 < steps.mean() < 2:  # more are sections put together in another order
            return table.label(at), np.cumulative_sum(steps, include_initial=True)
    return None


class _Guess:
    def __init__(self, table: LogTable, sensor: str | None):
        self.table, self.role = table, sensor
        self.width = len(table.columns)
        self.fields = fields_of(table.header)
        self.numbers = [self._numbers(at) for at in range(self.width)]
        self.reasons: list[str] = []
        self.questions: list[OpenPoint] = []
        self.chosen: dict[int, Column] = {}
        self.time: int | None = None
        self.assumed: float | None = None
        self.doubted = False  # whether the stamps are not in the unit that they state
        self.rate = self.accel_scale = self.gyro_scale = None
        self.stated = header_columns(table) or ()
        self.clocks = {CLOCKS[column.name]: at for at, column in enumerate(self.stated) if column.name in CLOCKS}
        self.unknown: list[_Triad] = []
        self.refused: list[tuple[_Triad, str]] = []  # triads that are named, and why they are no measurement
        self.attitude = False  # whether a quaternion is there: a trajectory may be beside it
        self.file, self.file_not = sensor_of(tuple(words_of(Path(table.path).stem)))

    def _numbers(self, at: int) -> FloatArray | None:
        with suppress(InputError):
            values = np.asarray(self.table.numbers(at), float)
            return values if np.isfinite(values).sum() > 1 else None
        return None

    def _triad(self, places: Sequence[int], label: str = "", **more) -> _Triad | None:
        columns = [values for at in places if (values := self.numbers[at]) is not None]
        if len(columns) < 3:
            return None
        values = np.stack(columns, axis=1)
        rows = np.flatnonzero(np.isfinite(values).all(axis=1))
        label = label or f"{self.table.label(places[0])} … {self.table.label(places[2]).removeprefix('number ')}"
        return _Triad(places, label, values[rows], rows, **more) if len(rows) > 1 else None

    def _off_unit(self, places: Collection[int]) -> FloatArray:
        """How far the length of the numbers in some columns is off one, by row."""
        return np.abs(column_lengths([np.asarray(self.numbers[at]) for at in places]) - 1)

    def _ask(self, text: str, blank: str = "", default: str | None = None, option: str = "columns") -> None:
        self.questions.append(OpenPoint(text, option, blank, default))

    def _unit_of(self, name: str) -> str | None:
        """The unit of the column that was chosen for a name; None without one."""
        return next((column.unit for column in self.chosen.values() if column.name == name), None)

    def _looked_at(self) -> Iterable[tuple[int, Field, FloatArray | None]]:
        """The number of each column, what its name says, and its numbers."""
        return zip(range(self.width), self.fields, self.numbers, strict=True)

    @property
    def columns(self) -> list[Column]:
        return [self.chosen.get(at, Column(None)) for at in range(self.width)]

    # --- the steps

    def advice(self) -> Advice:
        self.time = self._time_column()
        self._carry_on()
        triads = self._named_triads()
        accel = self._best(triads, "accel") or self._with_gravity()
        gyro = self._best(triads, "gyro")
        if self.role == "gyro":
            accel = None
        free = self._free(triads)
        role = self.role or self.file
        if role == "gyro" and gyro is None and accel is None:
            gyro = self._only(free, role)
        elif role == "accel" and accel is None:
            accel = self._only(free, role)
        if accel is None and role != "gyro":
            accel = self._by_gravity(free, gyro)
        if accel is not None and gyro is None:
            gyro = self._by_turning(free, accel)
        self._units(accel, gyro)
        if self.role == "mag" and all(triad.sensor != "mag" for triad in triads):
            rest = [triad for triad in free if self.chosen.keys().isdisjoint(triad.places)]
            if triad := self._only(rest, self.role):
                triad.sensor = self.role
                triads.append(triad)
        self._others(triads)
        return self._result(accel, gyro)

    def _time_column(self) -> int | None:
        named = [
            at
            for at, field, values in self._looked_at()
            if field.sensor == TIME and values is not None and rises(self.table.columns[at])
        ]
        if named:
            stated = [at for at in named if self.stated and self.stated[at].name == TIME]
            return min(stated or named, key=lambda at: find_unit(self.fields[at].unit, "time") is None)
        for at, field, values in self._looked_at():
            named = find_unit(field.unit, "time") or {"time", "date"} & set(field.stem) or _ends_in_time(field)
            # any other name says something else: a counter, a tick, an angle
            if values is not None and not field.sensor and (named or _plain(field)) and rises(values):
                steps = np.diff(values)
                usual = np.median(steps)
                # no counter, and no sum of something
                if (steps == 1.0).mean() <= 0.9 and (np.abs(steps - usual) < 0.5 * abs(usual)).mean() > 0.8:
                    self.reasons.append(f"column {self.table.label(at)} rises steadily, by {usual:.4g} a row: time")
                    return at
        return None

    def _without_time(self) -> str:
        """Why there are no stamps: no column has a name of time, or one has, and holds something else."""
        for at, field, values in self._looked_at():
            if field.sensor == TIME or {"time", "date", "timestamp"} & set(field.stem):
                held = "does not rise" if values is not None else f"holds {str(self.table.columns[at][0])[:30]!r}"
                return f"Column {self.table.label(at)} {held}: this was not understood as time, and no rate is stated."
        return "The file has no time column and states no rate."

    def _carry_on(self) -> None:
        """Let the time go on where a counter starts again, whatever its end is, and put rows in its order."""
        if self.time is not None and shuffled(self._clock):
            order = np.argsort(self._clock, kind="stable")
            self.table = self.table.take(order)
            self.numbers = [None if values is None else values[order] for values in self.numbers]
        elif self.time is not None and ((steps := np.diff(self._clock)) < 0).any():
            steps = np.where(steps < 0, np.median(steps[steps > 0]), steps)
            self.numbers[self.time] = self._clock[0] + np.cumulative_sum(steps, include_initial=True)

    def _named_triads(self) -> list[_Triad]:
        """The triads that names show, of whatever sensor."""
        groups: dict[tuple, dict[str, int]] = {}
        for at, field in enumerate(self.fields):
            if field.axis and field.axis in "xyz":
                group = groups.setdefault((field.stem, field.sensor, field.unit, field.why_not), {})
                group.setdefault(field.axis, at)
        quaternions = {field.stem for field in self.fields if "w" in field.stem[-1:]}
        triads = []
        for (stem, sensor, unit, why_not), axes in groups.items():
            if len(axes) != 3 or ((*stem, "w") in quaternions and not why_not):
                continue
            named = sensor is not None and bool(stem)
            if sensor is None and not stem and self.file in SENSORS:
                sensor = self.file
            if sensor is None and not measures(unit) and not stem and self.file_not:
                self._ask(f"Does this file hold an accelerometer? By its name it is {self.file_not}.")
                continue
            triad = self._triad([axes[axis] for axis in "xyz"], " ".join(stem) or "x, y, z", unit=unit)
            if triad is None:
                continue
            if why_not:
                self.refused.append((triad, why_not))
                continue
            triad.plain, triad.named = len(stem), named
            triad.sensor = sensor or measures(unit, triad.level)  # Trigno x [g]: the word is unknown, the unit not
            triads.append(triad)
        return triads

    def _with_gravity(self) -> _Triad | None:
        """The triad whose name says that gravity is gone, and which holds it all the same."""
        for triad, why in self.refused:
            if why == "gravity is taken out" and triad.gravity_unit:
                triad.sensor = "accel"
                self.reasons.append(f"{triad.label!r} holds {triad.level:.4g} at rest: gravity is in it")
                return triad
        return None

    def _without_gravity(self) -> str:
        """Say what is there in place of an accelerometer whose gravity was taken out; empty where nothing is."""
        parts = {why: triad.label for triad, why in self.refused}
        moved, alone = parts.get("gravity is taken out"), parts.get("gravity alone")
        if not moved:
            return ""
        if alone:
            return (
                f"The accelerometer stands apart in {moved!r} and {alone!r}: their sum is what it measured, gravity "
                "with it. Write a file with the sum as accel_x, accel_y, accel_z."
            )
        return (
            f"By its name {moved!r} has gravity taken out, and it holds {self.refused[0][0].level:.2g} at rest; a "
            "calibration needs the accelerometer with gravity: record that in its place."
        )

    def _best(self, triads: list[_Triad], sensor: str) -> _Triad | None:
        """The triad that is named after a sensor; of several the one that behaves like it, told with the others."""
        unsure = {None: 2, "?": 1, "count": 1}
        named = sorted(
            (triad for triad in triads if triad.sensor == sensor),
            key=lambda one: (
                sensor == "accel" and unsure.get(one.gravity_unit, 0),
                one.plain,
                "high" in one.label.split(),  # a range for impacts is coarse
                one.places,
            ),
        )
        if not named:
            return None
        first, name = named[0], GROUPS[sensor].field
        if len(named) > 1:
            others = ", ".join(repr(triad.label) for triad in named[1:])
            self.reasons.append(f"there are {len(named)} {name}s; this is {first.label!r}, not {others}")
        if self.table.names:
            self.reasons.append(f"{first.label!r} is the {name} by its {'name' if first.named else 'unit'}")
        return first

    def _free(self, triads: list[_Triad]) -> list[_Triad]:
        """Triads that nobody has named: by stems, or, in a table without names, three columns side by side."""
        unknown = self.unknown = [triad for triad in triads if triad.sensor is None]
        taken = {at for triad in triads for at in triad.places} | {self.time}
        free = []
        for at, field, values in self._looked_at():
            if at in taken or values is None or field.sensor or field.why_not or set(field.stem) & _COUNTERS:
                continue
            steps = np.diff(values[np.isfinite(values)])
            counter = rises(values) and ((steps == 1.0).mean() > 0.9 or (steps > 0).mean() > 0.98)
            if steps.any() and not counter:
                free.append(at)
        for at in [*free]:
            four = range(at, at + 4)
            if set(four) <= set(free) and self._off_unit(four).max() < _UNIT_LENGTH:
                free = [other for other in free if other not in four]
                self.attitude = True
                self.reasons.append(f"columns {self.table.label(at)} and the three after it have norm 1: a quaternion")
        if self.table.names and unknown:
            return unknown
        runs: list[list[int]] = []
        for at in free:
            if runs and runs[-1][-1] == at - 1 and _alike(self.fields[at], self.fields[at - 1]):
                runs[-1].append(at)
            else:
                runs.append([at])
        for run in runs:
            step = 3 if len(run) % 3 == 0 else 1
            three = (self._triad(run[first : first + 3], loose=step == 1) for first in range(0, len(run) - 2, step))
            unknown = [*unknown, *filter(None, three)]
        return unknown

    def _only(self, free: list[_Triad], role: str) -> _Triad | None:
        if len(free) != 1:
            return None
        why = "the file is called after it" if self.role is None else "no other triad is there"
        self.reasons.append(f"columns {free[0].label} are the {GROUPS[role].field}: {why}")
        return free[0]

    def _by_gravity(self, free: list[_Triad], gyro: _Triad | None) -> _Triad | None:
        """The one triad among the unnamed that holds 1 g at rest."""
        free = [triad for triad in free if triad.posed or not triad.loose]
        holding = [triad for triad in free if triad.gravity_unit not in (None, "count")]
        holding = holding or [triad for triad in free if self._increment(triad)]
        if len(holding) > 1:
            posed = [triad for triad in holding if triad.posed]
            physical = [triad for triad in holding if triad.gravity_unit == "m/s^2"]
            holding = posed if len(posed) == 1 else physical if len(physical) == 1 and not posed else holding
        round_ones = [triad for triad in free if triad.whole and ((triad.posed and triad.steady) or triad.round)]
        candidates = holding or round_ones
        if len(candidates) == 1:
            one, unit = candidates[0], candidates[0].gravity_unit or ""
            several = len(free) > 1
            # many things have norm 1
            clear = one not in self.unknown and (several or gyro or (one.lively and not self.attitude))
            if holding and (unit != "g" or clear):
                poses = "in all its poses" if one.posed else "at rest"
                if unit:
                    self.reasons.append(
                        f"columns {one.label} hold {one.level:.4g} {poses}, 1 g in {unit_text(unit)}: the accelerometer"
                    )
                return one
            if several and not holding:
                self.reasons.append(
                    f"columns {one.label} alone keep their norm in all poses, in counts: the accelerometer"
                )
                return one
            one.unit = "?"
            size = f"1 g in {unit_text(unit)}" if holding else "the same norm in all poses, in counts"
            self._ask(
                f"Are columns {one.label} the accelerometer? They hold {size}, but a magnetometer in some unit would "
                "look the same; write the unit if they are.",
                "accel [?]",
                unit_text(unit) if unit in _GRAVITY_IN else None,
            )
            return one
        if candidates:
            shown = " or ".join(f"{triad.label} (norm {triad.level:.4g})" for triad in candidates[:4])
            self._ask(f"Which columns are the accelerometer? {shown} could be, or could be a magnetometer.")
        elif by_unit := self._by_unit():
            return by_unit
        else:
            self._ask(
                "Which columns are the accelerometer? None are named so, and no three others hold 1 g while the unit "
                "rests."
            )
        return None

    def _by_unit(self) -> _Triad | None:
        """The only three columns in a unit of acceleration, whose names say no axes, or say them in words."""
        places = [
            at
            for at, field, _ in self._looked_at()
            if find_unit(field.unit, "acceleration") and not (field.sensor or field.why_not)
        ]
        units = {self.fields[at].unit for at in places}
        triad = self._triad(places, unit="?") if len(places) == len("xyz") and len(units) == 1 else None
        if triad is None:
            return None
        words = {word: axis for axis, names in _DIRECTIONS.items() for word in names.split()}
        axes_of = [{words[word] for word in self.fields[at].stem if word in words} for at in places]
        if sorted("".join(axes) for axes in axes_of) == [*"xyz"]:
            triad = self._triad([places[axes_of.index({axis})] for axis in "xyz"], unit="?") or triad
        shown = ", ".join(self.table.label(at) for at in triad.places)
        self._ask(
            f"Are {shown} the accelerometer along x, y and z? They alone are in {units.pop()}. Write the unit if they "
            "are; where one points the other way, to the right or down beside x forward, state --axes.",
            "accel [?]",
        )
        return triad

    def _by_turning(self, free: list[_Triad], accel: _Triad) -> _Triad | None:
        """The triad whose rates turn gravity as the accelerometer says."""
        free = [triad for triad in free if not (set(triad.places) & set(accel.places) or _copies(triad, accel))]
        fits = {triad: abs(fit.correlation) for triad in free if (fit := self._turning(accel, triad))}
        best = max(fits, key=fits.__getitem__, default=None)
        if best is not None and fits[best] > CORRELATED:
            self.reasons.append(f"columns {best.label}, integrated, {_TURN}: the gyroscope")
            return best
        unclear = [
            triad
            for triad in free
            if not self.table.names or triad in self.unknown or all(_plain(self.fields[at]) for at in triad.places)
        ]
        if unclear:
            shown = " or ".join(triad.label for triad in unclear[:3])
            none = ", or none" * (len(unclear) > 1)
            self._ask(f"Are columns {shown} the gyroscope{none}? Too little turns for physics to say.")
        return unclear[0] if len(unclear) == 1 else None

    # --- units

    def _stamps(self, triad: _Triad) -> FloatArray:
        """Seconds of a triad's rows, as good as is known: by the time column in a plausible unit, or by 100 Hz."""
        if self.time is None:
            return triad.rows / (self.table.rate or ASSUMED_RATE)
        values = np.asarray(self.numbers[self.clocks.get(triad.sensor or "", self.time)])[triad.rows]
        return (values - np.nanmin(self._clock)) * self._factor()

    @property
    def _clock(self) -> FloatArray:
        """The numbers of the time column, where there is one."""
        return np.asarray(self.numbers[self.time or 0])

    def _factor(self) -> float:
        """Seconds to one of the time column's unit, as good as is known."""
        if self.assumed is None:
            unit, options = self._stated_time(), self._time_units()
            self.assumed = unit.factor if unit else options[0][1] if options else 1e-2 / max(self._step(), 1e-300)
        return self.assumed

    def _stated_time(self) -> Unit | None:
        return None if self.time is None or self.doubted else find_unit(self.fields[self.time].unit, "time")

    def _doubt_time(self) -> None:
        self.doubted = True
        self.reasons.append(
            f"{self.table.label(self.time or 0)} rises by {self._step():.5g} a row: no rate in its unit"
        )

    def _turning(self, accel: _Triad, gyro: _Triad) -> Turning | None:
        force_time, rate_time = self._stamps(accel), self._stamps(gyro)
        if not (np.median(np.diff(force_time)) > 0 and np.median(np.diff(rate_time)) > 0):
            return None
        force = accel.values
        if accel.gravity_unit == "count" and (sphere := accel.sphere(force_time)):
            force = force - sphere[0]
        fit = turning(force_time, force, rate_time, gyro.values)
        return fit if np.isfinite(fit.sigma).any() else None

    def _step(self) -> float:
        """How far the time column rises a row."""
        steps = np.diff(self._clock[np.isfinite(self._clock)])
        return steps.sum() / max(int((steps > 0).sum()), 1)

    def _time_units(self) -> list[tuple[str, float]]:
        """The units in which the stamps mean a plausible rate, or the stated one; by name and factor."""
        low, high = _PLAUSIBLE
        first, step = np.nanmin(self._clock), self._step()
        rates = {unit: 1.0 / max(step * unit[1], 1e-300) for unit in _TIME_UNITS}
        stated = [unit for unit in rates if self.table.rate and abs(rates[unit] / self.table.rate - 1) < 0.1]
        if not stated and any(start < first < end for start, end in _DATES) and low <= 1 / (step * _DAY) <= high:
            stated = [("d", _DAY)]
        since = [unit for unit in _TIME_UNITS[:-1] if EPOCH[0] < first * unit[1] < EPOCH[1] and 0.5 < rates[unit] < 2e4]
        if surest := stated or since:
            return surest[:1]
        units = _TIME_UNITS if "fine" in self.fields[self.time or 0].stem else _TIME_UNITS[:-1]
        return [unit for unit in units if low <= rates[unit] <= high]

    def _units(self, accel: _Triad | None, gyro: _Triad | None) -> None:
        if accel is not None:
            self._accel_unit(accel)
        turned, best, stated = None, None, self._stated_time()
        rate = 1.0 / max(self._step() * stated.factor, 1e-300) if stated else math.nan
        if rate > FASTEST:
            self._doubt_time()
        if accel is not None and gyro is not None:
            unclear = self.time is not None and (rate < SLOWEST or self._stated_time() is None)
            for factor in [factor for _, factor in self._time_units()] if unclear else [None]:
                self.assumed = factor
                fit = self._turning(accel, gyro)
                if fit and (turned is None or abs(fit.correlation) > abs(turned.correlation)):
                    turned, best = fit, self.assumed
            if turned:
                self.assumed = best
        slope = abs(turned.slope) if turned and abs(turned.correlation) > CORRELATED else None
        if slope is not None and rate < SLOWEST:
            self._doubt_time()
        if self.time is not None:
            slope = self._time_unit(self.time, gyro, slope)
        elif not self.table.rate:
            self.rate = "?"
            self._ask(f"How many samples a second (--rate)? {self._without_time()}", "?", _USUAL_RATE, "rate")
        if gyro is not None:
            known = self.time is not None or self.table.rate is not None
            self._gyro_unit(gyro, accel, slope if known else None, None if known else slope)

    def _accel_unit(self, accel: _Triad) -> None:
        if accel.unit == "?":
            self._take(accel, "accel", None)
            return
        unit, shown = _fitting(accel.unit, "accel"), accel.gravity_unit
        if shown in _GRAVITY_IN:
            unit = self._kept(accel, unit, "acceleration", STANDARD_GRAVITY / accel.level, "hold 1 g at rest")
        if unit is None and shown == "?":
            self._ask(
                f"Is the accelerometer ({accel.label}) in mg, in cm/s^2, or in counts? Its norm at rest is "
                f"{accel.level:.5g}, near 1 g in each.",
                "accel [?]",
            )
        elif unit is None and shown:
            unit = shown
            if unit != "count":
                self.reasons.append(
                    f"the accelerometer holds {accel.level:.4g} at rest, which is 1 g in {unit_text(unit)}"
                )
        elif unit is None:
            counts = accel.whole and np.abs(accel.values).max() > 200
            unit = "count" if counts else "m/s" if self._increment(accel) else None
            if unit is None:
                self._ask(
                    f"In which unit is the accelerometer ({accel.label})? Its norm at rest is {accel.level:.4g}, "
                    "1 g in none that is known; is it an accelerometer?",
                    "accel [?]",
                )
        if unit == "count" and not accel.round:
            near = min(_PER_G, key=lambda scale: abs(accel.level / scale - 1))
            self.accel_scale = "?"
            if accel.steady and abs(accel.level / near - 1) < 0.08:
                self.accel_scale = f"{near} count/g"
                self.reasons.append(f"the accelerometer holds {accel.level:.5g} counts at rest: {near} to 1 g")
            else:
                self._ask(
                    f"How many counts are 1 g (--accel-scale)? The accelerometer's norm at rest is {accel.level:.5g}.",
                    "?",
                    option="accel_scale",
                )
        self._take(accel, "accel", unit)

    def _kept(self, triad: _Triad, unit: str | None, quantity: str, factor: float | None, does: str) -> str | None:
        """The unit that is stated, None where the values show another one, of which `factor` is about one in SI."""
        stated = find_unit(unit, quantity)
        if stated and factor and abs(math.log(factor / stated.factor)) >= _ANOTHER:
            self.reasons.append(f"{triad.label!r} is in {unit} by its name, in which it does not {does}")
            return None
        return unit

    def _increment(self, accel: _Triad) -> bool:
        """Whether the triad is g times the sampling interval: velocity increments."""
        rate = self.table.rate or (1.0 / self._step() if self.time is not None else None)
        if not rate or not accel.steady or abs(accel.level * rate / STANDARD_GRAVITY - 1) >= 0.1:
            return False
        reason = f"{accel.label} hold {accel.level:.4g} at rest, g over an interval of {1 / rate:.4g} s: increments"
        self.reasons += [] if reason in self.reasons else [reason]
        return True

    def _time_unit(self, time: int, gyro: _Triad | None, slope: float | None) -> float | None:
        """Decide the unit of the stamps; returns the slope of the gyroscope with these stamps."""
        if self._stated_time():
            self.chosen[time] = Column(TIME, self.fields[time].unit)
            return slope
        label, options, step = self.table.label(time), self._time_units(), self._step()
        if len(options) == 1 and (np.diff(self._clock) == 1.0).all() and not self.table.rate:
            options = []  # rows counted from the first on
        if len(options) > 1 and slope is not None and gyro is not None:
            stated = find_unit(gyro.unit, "angular rate")
            angles = [stated.factor] if stated else [_ANGLES["rad/s"], _ANGLES["deg/s"]]
            raw = slope * self._factor()
            fits = {option for option in options for angle in angles if abs(math.log(raw / option[1] / angle)) < 0.25}
            if len(fits) == 1:
                options = [*fits]
                slope = raw / options[0][1]
                self.reasons.append(f"with stamps in {options[0][0]} the integrated rates {_TURN}")
        rates = {unit: 1.0 / (step * factor) for unit, factor in options}
        shown = ", ".join(f"{rate:.4g} Hz in {unit}" for unit, rate in rates.items())
        if len(options) == 1:
            source = ", as the file states" if self.table.rate else ""
            self.reasons.append(f"{label} rises by {step:.5g} a row, {shown}{source}")
            self.chosen[time] = Column(TIME, *rates)
            return slope
        meaning = f": {shown}" if rates else ", a rate of no IMU in any unit; is it a counter?"
        likely = min(rates, key=lambda unit: abs(math.log(rates[unit] / _MIDDLE_RATE)), default=None)
        self._ask(f"In which unit is {label}? It rises by {step:.5g} a row{meaning}.", "time [?]", likely)
        self.chosen[time] = Column(TIME, "?")
        return None

    def _gyro_unit(self, gyro: _Triad, accel: _Triad | None, slope: float | None, per_sample: float | None) -> None:
        """Decide the gyroscope's unit; `per_sample`: the slope at 100 Hz where the rate is not known."""
        unit = self._kept(gyro, _fitting(gyro.unit, "gyro"), "angular rate", slope, _TURN)
        peak = np.abs(gyro.values).max()
        rest = np.abs(np.median(gyro.values, axis=0)).max()
        lying = accel is not None and accel.still and not accel.posed
        resting = lying and not gyro.turns
        accel_unit = self._unit_of("accel_x")
        if unit is None and slope is not None:
            best, off = likeliest(slope, _ANGLES)
            # counts may be anything: 16.4 to 1 deg/s are 1.06 mrad/s
            close = 0.25 if not gyro.whole else 0.1 if best in ("rad/s", "deg/s") else 0.025
            if accel_unit == "m/s":
                unit = self._angle_increment(slope)
            elif off < close:
                unit = best
                self.reasons.append(f"in {unit} the integrated rates {_TURN} (factor {slope / _ANGLES[best]:.3f})")
        if unit is None and per_sample is not None and not gyro.whole:
            rates = {name: 100 * _ANGLES[name] / per_sample for name in ("rad/s", "deg/s", "mdeg/s")}
            fits = [
                name
                for name, rate in rates.items()
                if _LIKELY[0] < rate < _LIKELY[1] and name in _plausible(peak, rest, None)
            ]
            if fits:
                shown = " or ".join(f"{rates[name]:.3g} Hz if it is in {name}" for name in fits)
                self._ask(f"The rates {_TURN} at about {shown}.", option="rate")
            if len(fits) == 1:
                unit = fits[0]
                self.reasons.append(f"at a usual sample rate the integrated rates {_TURN} only in {unit}")
        if unit is None and gyro.whole:
            unit = "count"
        elif unit is None and accel_unit != "m/s" and slope is None:
            fits = _plausible(peak, rest, gyro.noise if resting else None)
            if lying and not resting:  # about the vertical
                fits = [name for name in fits if name != "mdeg/s"]
            if len(fits) == 1:
                unit = fits[0]
                at_rest = f", and at rest {rest:.3g} with a scatter of {gyro.noise:.2g}" if resting else ""
                self.reasons.append(f"the gyroscope reads up to {peak:.4g}{at_rest}: of a sensor only in {unit}")
        if unit is None:
            self._ask(
                f"Is the gyroscope ({gyro.label}) in deg/s or rad/s? It reads up to {peak:.3g}, and "
                + ("its turns fit both." if per_sample else "does not turn gravity enough to decide."),
                "gyro [?]",
                "rad/s" if accel_unit == "m/s^2" else "deg/s",
            )
        if unit == "count":
            self._gyro_counts(slope)
        self._take(gyro, "gyro", unit)

    def _angle_increment(self, slope: float) -> str | None:
        unit = find_unit(self.chosen[self.time].unit) if self.time is not None else None
        interval = self._step() * unit.factor if unit else 1.0 / (self.table.rate or 1.0)
        if abs(math.log(slope * interval)) < 0.25:
            self.reasons.append("the gyroscope's increments, summed in rad, turn gravity as the accelerometer shows")
            return "rad"
        return None

    def _gyro_counts(self, slope: float | None) -> None:
        fitting = []
        if slope:
            per_degree = math.pi / 180 / slope
            off = {scale: abs(math.log(per_degree / scale)) for scale in _PER_DEGREE}
            best = min(_PER_DEGREE, key=lambda scale: off[scale])
            apart = min(off[scale] for scale in _PER_DEGREE if abs(scale / best - 1) > 0.01)
            if off[best] < 0.06 and apart > 2 * off[best]:
                self.gyro_scale = f"{best:g} count/(deg/s)"
                self.reasons.append(f"{per_degree:.4g} counts to 1 deg/s {_TURN}; nominal are {best:g}")
                return
            fitting = [f"{scale:g}" for scale in _PER_DEGREE if off[scale] < _ROUGH]
        usual = f" Of the usual ones {listed(fitting, 'or')} would fit." if fitting else ""
        self.gyro_scale = "?"
        self._ask(
            f"How many counts are 1 deg/s (--gyro-scale)? The data sheet says.{usual}", "?", _USUAL_SCALE, "gyro_scale"
        )

    def _take(self, triad: _Triad, sensor: str, unit: str | None) -> None:
        for at, name in zip(triad.places, GROUPS[sensor].columns, strict=True):
            self.chosen[at] = Column(name, unit or "?")

    def _others(self, triads: list[_Triad]) -> None:
        """Magnetometer and temperature, where name and unit are clear; what is not clear is left out."""
        for triad in triads:
            if triad.sensor == "mag" and not self._unit_of("mag_x"):
                unit = "count" if triad.whole and not triad.unit else _fitting(triad.unit, "mag")
                field_in = {name: 40.0 / unit_named(name).factor for name in ("uT", "G", "mG", "nT", "T")}
                nearest, off = likeliest(triad.level or 1.0, field_in)  # the Earth's field is 22 to 67 uT
                if unit is None and (self.role == "mag" or off < _ANOTHER):
                    unit = nearest
                    self.reasons.append(f"{triad.label!r} reads {triad.level:.3g}, near the Earth's field in {unit}")
                if unit:
                    self._take(triad, "mag", unit)
        for sensor, at in self.clocks.items():
            if self.time is not None and self._unit_of(f"{sensor}_x"):
                self.chosen[at] = Column(f"{sensor}_time", self.fields[at].unit or self.chosen[self.time].unit)
        self._quaternion()
        for at, field, values in self._looked_at():
            name = field.sensor or ""
            if name.startswith("attitude_"):
                self.chosen[at] = Column(name, field.unit)
            if name not in SINGLE or values is None or self._unit_of(name):
                continue
            unit = _fitting(field.unit, name)
            if unit is None and "temperature" in name:
                unit = self._temperature_unit(self.table.label(at), field.unit, values[np.isfinite(values)])
            if unit:
                self.chosen[at] = Column(name, unit)

    def _temperature_unit(self, label: str, unit: str | None, values: FloatArray) -> str | None:
        """°C, which may be asked, or K, or a chip's counts: whole numbers beside such sensors, or too many."""
        low, high, whole = values.min(), values.max(), (values == values.round()).all()
        between = f"{label} is between {low:.6g} and {high:.6g}"
        counts = whole and any(column.unit == "count" for column in self.chosen.values())
        if _KELVIN[0] < low <= high < _KELVIN[1] and not (whole or unit):  # whole ones may be tenths of °C
            self.reasons.append(f"{between} and states no unit: K")
            return "K"
        if -60 < low <= high < _HOTTEST and not counts:
            if _EITHER[0] < low and high > _EITHER[1]:
                self._ask(f"Is {label} in °C? It is between {low:.4g} and {high:.4g}; write degF in its place if not.")
            self.reasons.append(f"{label} states no unit and is taken to be in °C")
            return "degC"
        if low == high:
            return None
        self.reasons.append(
            f"{between}, which is no temperature in °C but a chip's counts: {COUNTS_ADVICE}, for jaximu thermal"
        )
        return "count"

    def _quaternion(self) -> None:
        """An attitude by name, whose four numbers have norm 1."""
        named: dict[str, dict[str, int]] = {}
        for at, name in enumerate(self.table.header):
            match = re.fullmatch(r"(.*?)[\W_]*([wxyz])", parse_column(name)[0].strip().lower())
            if match and self.numbers[at] is not None and set(words_of(match[1])) & _ATTITUDES:
                named.setdefault(match[1], {})[match[2]] = at
        for head, places in named.items():
            if len(places) == 4 and np.nanmax(self._off_unit(places.values())) < _UNIT_LENGTH:
                self.reasons.append(f"{head!r} is a quaternion of norm 1: an attitude")
                self.chosen |= {at: Column(f"attitude_{axis}") for axis, at in places.items()}
                return

    # --- the result

    def _without_triad(self) -> Advice:
        """What a table without accelerometer and gyroscope is."""
        if self._unit_of("mag_x"):
            columns = [c if (c.name or "").startswith(("mag_", "time")) else Column(None) for c in self.columns]
            known = any(column.name == "mag_x" and column.unit for column in self.stated)
            text = None if known else column_text(columns)
            option = f" --columns '{text}'" if text else ""
            alone = (
                f"This file holds a magnetometer alone: jaximu magnetometer {self.table.path}{option} calibrates it."
            )
            return Advice(reasons=tuple(self.reasons), questions=(OpenPoint(alone),), magnetometer=text)
        text = self.questions[0].text
        if self.attitude or any(why == "an estimated bias" for _, why in self.refused):
            text = (
                "This is a trajectory (attitude, and position or biases beside it), no sensor's log: give it as "
                f"--reference {self.table.path} to `jaximu reference` with the log of the same motion."
            )
        if self.table.names is None and self.width == len("xyz") + (self.time is not None):
            text += (
                f" If they are a magnetometer's, jaximu magnetometer {self.table.path} --columns calibrates it, "
                "with its columns named (mag [uT], or mag [count])."
            )
        return Advice(reasons=tuple(self.reasons), questions=(OpenPoint(text),))

    def _result(self, accel: _Triad | None, gyro: _Triad | None) -> Advice:
        if accel is None and self.role != "gyro":
            if sentence := self._without_gravity():
                self.questions = [OpenPoint(sentence)]
            elif gyro is not None:
                self._ask(_lone_gyroscope(self.table))
            elif not self.questions:
                self._ask("Which columns are the accelerometer?")
        elif gyro is None and self.role == "gyro":
            self._ask("Which columns are the gyroscope?")
        if accel is None and gyro is None:
            return self._without_triad()
        stated = [column if column.name else Column(None) for column in self.stated]
        same = self.columns == stated
        order = sorted(self.chosen)
        rows = [tuple(column_text([self.chosen[at]]) for at in order)]
        for cells in islice(zip(*(self.table.columns[at] for at in order), strict=True), _SHOWN):
            rows.append(tuple(f"{cell:.6g}" if isinstance(cell, float | np.floating) else str(cell) for cell in cells))
        return Advice(
            None if same else column_text(self.columns),
            self.rate,
            self.accel_scale,
            self.gyro_scale,
            tuple(self.reasons),
            tuple(self.questions),
            tuple(rows) if order else (),
            accel is not None,
        )


def column_text(columns: Sequence[Column]) -> str:
    """The columns as `--columns` takes them, as short as can be."""
    text = ",".join(column_title(column.name or "_", column.unit) for column in columns)
    for sensor in SENSORS:
        text = re.sub(rf"{sensor}_x((?: \[[^\]]*\])?),{sensor}_y\1,{sensor}_z\1", rf"{sensor}\1", text)
    return re.sub(r"(?<![^,])_(,_){3,}(?![^,])", lambda skipped: f"_*{skipped[0].count('_')}", text)


def _plausible(peak: float, bias: float, noise: float | None) -> list[str]:
    """The units in which a sensor may read so much: 2300 °/s at most, and at rest 25 °/s of bias, 3 °/s of scatter."""
    units = []
    for unit, noisiest in (("rad/s", 3.0), ("deg/s", 1.0), ("mdeg/s", 3.0)):
        degree = math.degrees(_ANGLES[unit])
        at_rest = noise is None or (bias * degree < 25 and 1e-4 < noise * degree < noisiest)
        if peak * degree < 2300 and at_rest and not (unit == "mdeg/s" and "deg/s" in units):
            units.append(unit)
    return units


def _fitting(unit: str | None, group: str) -> str | None:
    """A stated unit, if it is one of what the group's columns measure; "count" by whatever name."""
    stated = find_unit(unit, GROUPS[group].quantities)
    return stated and ("count" if stated.quantity == "raw count" else unit)


def _ends_in_time(field: Field) -> bool:
    """Whether the last of several words of a name is a unit of time."""
    return len(field.stem) > 1 and len(field.stem[-1]) > 1 and last_of(field.stem[-1])[1] is not None


def _plain(field: Field) -> bool:
    """Whether a name says nothing."""
    return all(word.rstrip("0123456789") in _PLAIN or word.isdigit() for word in field.stem)


def _copies(triad: _Triad, accel: _Triad) -> bool:
    """Whether a triad holds the accelerometer's values once more, in another unit."""
    if len(triad.values) != len(accel.values):
        return False
    pairs = zip(triad.values.T, accel.values.T, strict=True)
    return all(np.std(a) > 0 and np.std(b) > 0 and np.corrcoef(a, b)[0, 1] ** 2 > _COPY for a, b in pairs)


def _alike(one: Field, other: Field) -> bool:
    """Whether two names differ by a number or their last word alone, or are none: columns of one matrix."""
    words = [[word.rstrip("0123456789") for word in field.stem if not word.isdigit()] for field in (one, other)]
    same = words[0] == words[1] or (len(words[0]) == len(words[1]) > 1 and words[0][:-1] == words[1][:-1])
    return same and one.unit == other.unit


def _lone_gyroscope(table: LogTable) -> str:
    path = Path(table.path)
    others = sorted(log.name for log in path.parent.glob(f"*{path.suffix}")) if path.is_file() else []
    names = [name for name in others if "acc" in name.lower() and "linear" not in name.lower()]
    where = f"read both: {names[0]} --gyro-log {path.name}" if names else "give its file, and this one as --gyro-log"
    return (
        f"Where is the accelerometer? This file holds a gyroscope alone; {where}. Alone it can be calibrated on a "
        "table (jaximu turntable, with its turns as --reference), and at rest its noise can be seen (jaximu allan)."
    )
