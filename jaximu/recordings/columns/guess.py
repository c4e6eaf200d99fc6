"""What the columns of a table are where its header does not say it all: by names first, by physics second.

Names are read by `jaximu.recordings.columns.habits`. Physics knows a sensor by what it must do: an accelerometer holds
1 g at rest in every pose, a gyroscope's rates integrate to what gravity does, time rises, four numbers of norm 1 are a
quaternion. Where a column stands proves nothing. What neither settles is asked: a `?` in the line to paste.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError
from jaximu.ground.quantities import listed, unit_text
from jaximu.ground.units import STANDARD_GRAVITY, Unit, find_unit, parse_column
from jaximu.recordings.alignment import Turning, turning
from jaximu.recordings.columns.habits import QUANTITIES, Field, fields_of, sensor_of, words_of
from jaximu.recordings.columns.names import COUNTS_ADVICE, GROUPS, TIME, Column, header_columns, rises
from jaximu.recordings.columns.nominal import fit_sphere, quiet_means
from jaximu.recordings.columns.table import Table

__all__ = ["Advice", "advise", "without_gravity"]

_GRAVITY_IN = {"m/s^2": STANDARD_GRAVITY, "g": 1.0, "mg": 1000.0, "cm/s^2": 980.665}
_PLAUSIBLE = 0.5, 8000.0
_LIKELY = 5.0, 4000.0
"""Hz: sample rates that a log may have, stamps that mean another are in another unit; and that one with turns has."""
_STEADY = 0.12
"""Scatter of the norm over poses, of its mean, below which a triad holds something constant."""
_TURNS = 0.6
"""Correlation from which a triad's integral turns gravity as the accelerometer says."""
_PER_G = (16384, 8192, 4096, 2048, 1024, 512, 256)
_PER_DEGREE = (131, 65.5, 32.8, 16.4, 114.2857, 57.1429, 28.5714, 14.2857, 14.375, 262)
_COUNTERS = {"counter", "count", "packet", "index", "sample", "frame", "seq", "number", "id", "row", "line", "n", "no",
             "iteration", "loop", "samples", "packetcounter", "status"}  # fmt: skip
_ANGLES = {"rad/s": 1.0, "deg/s": math.pi / 180, "mdeg/s": math.pi / 180e3, "mrad/s": 1e-3}
_PLAIN = set("var column col field data channel ch ans unnamed imu c v x y out simout".split())
"""Words that say nothing of a column."""
_SHOWN = 3
_UNIT_LENGTH = 2e-3  # that the norm of a quaternion may be off by, as few digits make it
_ATTITUDES = {"q", "quat", "quaternion", "orientation", "attitude"}
_ROUGH = 0.15  # logarithm by which turns may be off what a gyroscope's scale makes of them
_TURNING = 5.0  # times the scatter in them by which means of a gyroscope at rest do not differ
_HOTTEST = 125.0  # °C that a sensor survives
_TURN = "turn gravity as the accelerometer shows"
_SINGLE = ("temperature", "ambient_temperature", "current", "table_angle", "table_rate")
"""Columns that are no triad's."""


@dataclass(frozen=True)
class Advice:
    """How to read a table: options to paste, why, what is still to be answered, and the first rows to compare with.

    accelerometer: whether one was found.
    columns, rate, accel_scale, gyro_scale: as in `ReadOptions`; None where the file says it itself. A `?` is to be
    filled in, and `questions` say what is asked.
    """

    columns: str | None = None
    rate: str | None = None
    accel_scale: str | None = None
    gyro_scale: str | None = None
    reasons: tuple[str, ...] = ()
    questions: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    accelerometer: bool = False

    @property
    def complete(self) -> bool:
        """Whether nothing is left to ask."""
        return not self.questions

    @property
    def readable(self) -> bool:
        """Whether at most the sample rate and the scales of counts are left to ask."""
        return self.accelerometer and "?" not in (self.columns or "")

    def line(self, option: str = "--columns") -> str:
        """The options as one types them."""
        named = {option: self.columns, "--rate": self.rate, "--accel-scale": self.accel_scale,
                 "--gyro-scale": self.gyro_scale}  # fmt: skip
        return " ".join(
            f'{name} "{value}"' if name == option or " " in value else f"{name} {value}"
            for name, value in named.items()
            if value
        )

    def sentence(self, option: str = "--columns") -> str:
        """The line, what is asked, and why, in one line of text."""
        asked = f" Answer first: {' '.join(self.questions)}" if self.questions else ""
        why = f" Why: {'; '.join(self.reasons)}." if self.reasons else ""
        return f"{self.line(option)}.{asked}{why}" if self.line(option) else f"{asked}{why}".strip()


@dataclass(eq=False)
class _Triad:
    """Three columns of one sensor, and what is known of them."""

    places: tuple[int, int, int]
    label: str
    values: FloatArray  # (n, 3), rows that are whole
    rows: np.ndarray  # their indices
    sensor: str | None = None
    unit: str | None = None
    named: bool = True  # by a word of its name, not by its unit alone
    loose: bool = False  # one of several ways to take three of some columns side by side
    plain: int = 0  # words of the name that say more than the sensor: filtered, low, noise

    level: float = field(init=False)
    steady: bool = field(init=False)
    posed: bool = field(init=False)
    whole: bool = field(init=False)
    still: bool = field(init=False)  # its quiet windows are rest, seen from the size of what it holds
    noise: float = field(init=False)  # rms of an axis in its quiet windows
    round: bool = field(init=False)  # its quiet means lie on a sphere
    lively: bool = field(init=False)  # the norm changes where it moves, as a magnetometer's does not

    def __post_init__(self) -> None:
        size = max(5, min(50, len(self.values) // 20))
        count = len(self.values) // size
        cut = self.values[: count * size].reshape(count, size, 3) if count else self.values[None]
        scatter = cut.var(axis=1).sum(axis=1)
        means = cut.mean(axis=1)[scatter <= max(4 * np.percentile(scatter, 10), 1e-12)]
        norm = np.linalg.norm(means, axis=1)
        self.level = float(np.median(norm))
        self.noise = float(np.sqrt(np.median(np.sort(scatter)[: max(1, len(scatter) // 4)]) / 3))
        self.still = self.noise < 0.03 * self.level
        self.steady = bool(self.level > 0 and np.std(norm) < _STEADY * self.level)
        directions = means / np.maximum(norm[:, None], 1e-300)
        self.posed = bool(len(means) > 3 and np.linalg.norm(directions.mean(axis=0)) < 0.9)
        jitter = np.diff(np.linalg.norm(cut, axis=2), axis=1).std(axis=1) if size > 1 else scatter
        moving = scatter > 30 * max(float(np.percentile(scatter, 10)), 1e-12)
        self.lively = bool(moving.sum() > 2 and np.median(jitter[moving]) > 3 * np.median(jitter[~moving]))
        some = self.values[:20000]
        self.whole = bool(np.all(some == np.round(some)) and np.ptp(some) > 20)
        self.round = self.whole and fit_sphere(quiet_means_of(self)) is not None

    @property
    def gravity_unit(self) -> str | None:
        """The unit in which it holds 1 g at rest, "?" where several fit; "count": something else in whole numbers."""
        if not self.steady:
            return None
        near = {unit: abs(math.log(self.level / one)) for unit, one in _GRAVITY_IN.items()}
        best = min(near, key=lambda unit: near[unit])
        if near[best] > math.log(1.15):
            return "count" if self.whole and self.level > 50 else None
        if best in ("mg", "cm/s^2"):  # 1000 mg, 981 cm/s² and 1024 counts are close together
            if not self.still:
                return "?"
            if self.whole and abs(self.level - 1024) < 8:
                return "count"
            return "mg" if abs(self.level - 1000) < 10 else "?"
        return best


def advise(table: Table, sensor: str | None = None) -> Advice:
    """Say how to read a table whose header does not say it all. `sensor`: the one that it must hold, if alone."""
    return _Guess(table, sensor).advice()


def without_gravity(table: Table) -> str:
    """Say what stands in a table in place of an accelerometer, where its gravity was taken out; else nothing."""
    guess = _Guess(table, None)
    guess._named_triads()
    return guess._without_gravity()


class _Guess:
    def __init__(self, table: Table, sensor: str | None):
        self.table, self.role = table, sensor
        self.width = len(table.columns)
        self.fields = fields_of(table.names) if table.names else [Field((), None, None, None)] * self.width
        self.numbers = [self._numbers(at) for at in range(self.width)]
        self.reasons: list[str] = []
        self.questions: list[str] = []
        self.chosen: dict[int, Column] = {}
        self.time: int | None = None
        self.assumed: float | None = None
        self.rate = self.accel_scale = self.gyro_scale = None
        self.unknown: list[_Triad] = []
        self.refused: list[tuple[_Triad, str]] = []  # triads that are named, and why they are no measurement
        self.attitude = False  # whether a quaternion is there: a trajectory may be beside it
        self.file, self.file_not = sensor_of(tuple(words_of(Path(table.path).stem)))

    def _numbers(self, at: int) -> FloatArray | None:
        try:
            values = np.asarray(self.table.numbers(at), np.float64)
        except InputError:
            return None
        return values if np.isfinite(values).sum() > 1 else None

    def _triad(self, places: tuple[int, int, int], **more) -> _Triad | None:
        columns = [self.numbers[at] for at in places]
        if any(each is None for each in columns):
            return None
        values = np.stack([each for each in columns if each is not None], axis=1)
        rows = np.flatnonzero(np.isfinite(values).all(axis=1))
        if len(rows) < 2:
            return None
        labels = [self.table.label(at) for at in places]
        label = f"{labels[0]} … {labels[2].removeprefix('number ')}"
        return _Triad(places, label, values[rows], rows, **more)

    # --- the steps

    def advice(self) -> Advice:
        self.time = self._time_column()
        triads = self._named_triads()
        accel = self._best(triads, "accel") or self._with_gravity()
        gyro = self._best(triads, "gyro")
        if self.role == "gyro":
            accel = None
        free = self._free(triads)
        role = self.role or self.file
        if role == "gyro" and gyro is None and accel is None:
            gyro = self._only(free)
        elif role == "accel" and accel is None:
            accel = self._only(free)
        if accel is None and role != "gyro":
            accel = self._by_gravity(free, gyro)
        if accel is not None and gyro is None:
            rest = [each for each in free if not set(each.places) & set(accel.places)]
            gyro = self._by_turning(rest, accel)
        self._units(accel, gyro)
        self._others(triads)
        return self._result(accel, gyro)

    def _time_column(self) -> int | None:
        named = [at for at, each in enumerate(self.fields)
                 if each.sensor == TIME and self.numbers[at] is not None and rises(self.table.columns[at])]  # fmt: skip
        if named:
            return min(named, key=lambda at: find_unit(self.fields[at].unit or "", "time") is None)
        for at, values in enumerate(self.numbers):
            each = self.fields[at]
            if values is None or each.sensor or not rises(values):
                continue
            if not _plain(each) and not find_unit(each.unit or "", "time"):
                continue  # a name that says something else: a counter, a tick, an angle
            steps = np.diff(values)
            usual = float(np.median(steps))
            if np.mean(steps == 1.0) > 0.9 or not np.mean(np.abs(steps - usual) < 0.5 * abs(usual)) > 0.8:
                continue  # a counter, or a sum of something
            self.reasons.append(f"column {self.table.label(at)} rises steadily, by {usual:.4g} a row: time")
            return at
        return None

    def _named_triads(self) -> list[_Triad]:
        """The triads that names show, of whatever sensor."""
        groups: dict[tuple, dict[str, int]] = {}
        refused: dict[tuple, dict[str, int]] = {}
        for at, each in enumerate(self.fields):
            if each.axis and each.axis in "xyz":
                kept = refused if each.why_not else groups
                kept.setdefault((each.stem, each.why_not or each.sensor, each.unit), {}).setdefault(each.axis, at)
        for (stem, why, unit), axes in refused.items():
            triad = self._triad((axes["x"], axes["y"], axes["z"]), unit=unit) if len(axes) == 3 else None
            if triad is not None:
                triad.label = " ".join(stem)
                self.refused.append((triad, why))
        quaternions = {each.stem for each in self.fields if "w" in each.stem[-1:]}
        found = []
        for (stem, sensor, unit), axes in groups.items():
            if len(axes) != 3 or (*stem, "w") in quaternions:
                continue
            named = sensor is not None and bool(stem)
            if sensor is None and not stem and self.file in ("accel", "gyro", "mag"):
                sensor = self.file
            if sensor is None and unit and unit != "G" and (measured := find_unit(unit)):
                sensor = QUANTITIES.get(measured.quantity)  # Trigno x [g]: the word is unknown, the unit is not
            if sensor is None and not stem and self.file_not:
                self.questions.append(f"Does this file hold an accelerometer? By its name it is {self.file_not}.")
                continue
            triad = self._triad(
                (axes["x"], axes["y"], axes["z"]), sensor=sensor, unit=unit, plain=len(stem), named=named
            )
            if triad is not None:
                triad.label = f"{' '.join(stem) or 'x, y, z'}"
                found.append(triad)
        return found

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
        if moved and alone:
            return (
                f"The accelerometer stands apart in {moved!r} and {alone!r}: their sum is what it measured, gravity "
                "with it. Write a file with the sum as accel_x, accel_y, accel_z."
            )
        return (
            ""
            if moved is None
            else (
                f"By its name {moved!r} has gravity taken out, and it holds {self.refused[0][0].level:.2g} at rest; a "
                "calibration needs the accelerometer with gravity: record that in its place."
            )
        )

    def _best(self, triads: list[_Triad], sensor: str) -> _Triad | None:
        """The triad that is named after a sensor; of several the one that behaves like it, told with the others."""
        named = [each for each in triads if each.sensor == sensor]
        if not named:
            return None
        named.sort(key=lambda each: (sensor == "accel" and each.gravity_unit is None, each.plain, each.places))
        if len(named) > 1:
            others = ", ".join(repr(each.label) for each in named[1:])
            what = "accelerometers" if sensor == "accel" else f"{GROUPS[sensor].field}s"
            self.reasons.append(f"there are {len(named)} {what}; this is {named[0].label!r}, not {others}")
        first = named[0]
        if self.table.names:
            said = "name" if first.named else "unit"
            self.reasons.append(f"{first.label!r} is the {GROUPS[sensor].field} by its {said}")
        return first

    def _free(self, triads: list[_Triad]) -> list[_Triad]:
        """Triads that nobody has named: by stems, or, in a table without names, three columns side by side."""
        unknown = self.unknown = [each for each in triads if each.sensor is None]
        taken = {at for each in triads for at in each.places} | {self.time}
        open_places = []
        for at, values in enumerate(self.numbers):
            each = self.fields[at]
            if at in taken or values is None or each.sensor or each.why_not or set(each.stem) & _COUNTERS:
                continue
            finite = values[np.isfinite(values)]
            steps = np.diff(finite)
            counter = rises(values) and (np.mean(steps == 1.0) > 0.9 or np.mean(steps > 0) > 0.98)
            if np.ptp(finite) > 0 and not counter:
                open_places.append(at)
        quaternion: set[int] = set()
        for at in open_places:
            four = range(at, at + 4)
            if set(four) <= set(open_places) - quaternion:
                stacked = np.stack([np.asarray(self.numbers[each]) for each in four], axis=1)
                norm = np.linalg.norm(stacked, axis=1)
                if np.nanmax(np.abs(norm - 1)) < _UNIT_LENGTH and np.abs(stacked).max() <= 1.002:
                    quaternion |= set(four)
                    self.attitude = True
                    self.reasons.append(
                        f"columns {self.table.label(at)} and the three after it have norm 1: a quaternion"
                    )
        if self.table.names and unknown:
            return unknown
        places = [at for at in open_places if at not in quaternion]
        runs, windows = [[-2]], []
        for at in places:
            if runs[-1][-1] == at - 1 and _alike(self.fields[at], self.fields[at - 1]):
                runs[-1].append(at)
            else:
                runs.append([at])
        for run in runs:
            step = 3 if len(run) % 3 == 0 else 1
            windows += [((run[k], run[k + 1], run[k + 2]), step == 1) for k in range(0, len(run) - 2, step)]
        return [*unknown, *(each for at, loose in windows if (each := self._triad(at, loose=loose)) is not None)]

    def _only(self, free: list[_Triad]) -> _Triad | None:
        if len(free) != 1:
            return None
        why = "the file is called after it" if self.role is None else "no other triad is there"
        self.reasons.append(f"columns {free[0].label} are the {GROUPS[self.role or self.file or 'accel'].field}: {why}")
        return free[0]

    def _by_gravity(self, free: list[_Triad], gyro: _Triad | None) -> _Triad | None:
        """The one triad among the unnamed that holds 1 g at rest."""
        free = [each for each in free if each.posed or not each.loose]
        holding = [each for each in free if each.gravity_unit not in (None, "count")]
        if not holding:
            holding = [each for each in free if self._increment(each)]
        whole = [each for each in free if each.whole and ((each.posed and each.steady) or each.round)]
        sure = [  # many things have norm 1
            each
            for each in holding
            if each.gravity_unit != "g"
            or (each not in self.unknown and (len(free) > 1 or gyro or (each.lively and not self.attitude)))
        ]
        if len(holding) > 1:
            posed = [each for each in holding if each.posed]
            physical = [each for each in holding if each.gravity_unit == "m/s^2"]
            holding = posed if len(posed) == 1 else physical if len(physical) == 1 and not posed else holding
        if len(holding) == 1 and holding[0] in sure:
            one = holding[0]
            poses = "in all its poses" if one.posed else "at rest"
            if one.gravity_unit:
                self.reasons.append(f"columns {one.label} hold {one.level:.4g} {poses}, 1 g in "
                                    f"{unit_text(one.gravity_unit)}: the accelerometer")  # fmt: skip
            return one
        if not holding and len(whole) == 1 and len(free) > 1:
            self.reasons.append(f"columns {whole[0].label} alone keep their norm in all poses, in counts: the "
                                "accelerometer")  # fmt: skip
            return whole[0]
        candidates = holding or whole
        if len(candidates) == 1:
            one = candidates[0]
            one.unit = "?"
            said = f"1 g in {unit_text(one.gravity_unit or '')}" if holding else "the same norm in all poses, in counts"
            self.questions.append(f"Are columns {one.label} the accelerometer? They hold {said}, but a magnetometer in "
                                  "some unit would look the same; write the unit if they are.")  # fmt: skip
            return one
        if candidates:
            told = " or ".join(f"{each.label} (norm {each.level:.4g})" for each in candidates[:4])
            self.questions.append(f"Which columns are the accelerometer? {told} could be, or could be a magnetometer.")
        else:
            self.questions.append("Which columns are the accelerometer? No three unnamed columns hold 1 g at rest.")
        return None

    def _by_turning(self, free: list[_Triad], accel: _Triad) -> _Triad | None:
        """The triad whose rates turn gravity as the accelerometer says."""
        found = [(abs(each.correlation), triad) for triad in free if (each := self._turning(accel, triad))]
        found = sorted((each for each in found if each[0] > _TURNS), key=lambda each: -each[0])
        if found:
            best = found[0][1]
            self.reasons.append(f"columns {best.label}, integrated, {_TURN}: the gyroscope")
            return best
        unclear = [each for each in free if not self.table.names or each in self.unknown
                   or all(_plain(self.fields[at]) for at in each.places)]  # fmt: skip
        told = " or ".join(each.label for each in unclear[:3])
        if len(unclear) == 1:
            self.questions.append(f"Are columns {told} the gyroscope? Too little turns for physics to say.")
            return unclear[0]
        if unclear:
            self.questions.append(f"Are columns {told} the gyroscope, or none? Too little turns for physics to say.")
        return None

    # --- units

    def _stamps(self, triad: _Triad) -> FloatArray:
        """Seconds of a triad's rows, as good as is known: by the time column in a plausible unit, or by 100 Hz."""
        if self.time is None:
            return triad.rows / (self.table.rate or 100.0)
        values = np.asarray(self.numbers[self.time])[triad.rows]
        return (values - values[0]) * self._factor()

    def _factor(self) -> float:
        """Seconds to one of the time column's unit, as good as is known."""
        if self.assumed is None:
            unit, options = self._stated_time(), self._time_units()
            self.assumed = unit.factor if unit else options[0][1] if options else 1e-2 / max(self._step(), 1e-300)
        return self.assumed

    def _stated_time(self) -> Unit | None:
        return None if self.time is None else find_unit(self.fields[self.time].unit or "", "time")

    def _turning(self, accel: _Triad, gyro: _Triad) -> Turning | None:
        force_time, rate_time = self._stamps(accel), self._stamps(gyro)
        if not (np.median(np.diff(force_time)) > 0 and np.median(np.diff(rate_time)) > 0):
            return None
        force = accel.values
        if accel.gravity_unit == "count" and (sphere := fit_sphere(quiet_means_of(accel, force_time))):
            force = force - sphere[0]
        found = turning(force_time, force, rate_time, gyro.values)
        return found if np.isfinite(found.sigma).any() else None

    def _step(self) -> float:
        """How far the time column rises a row."""
        values = np.asarray(self.numbers[self.time or 0])
        steps = np.diff(values[np.isfinite(values)])
        return float(np.sum(steps)) / max(int(np.sum(steps > 0)), 1)

    def _time_units(self) -> list[tuple[str, float]]:
        """The units in which the stamps mean a plausible rate, or the stated one; by name and factor."""
        names = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "100 us": 1e-4}
        rates = {name: 1.0 / max(self._step() * factor, 1e-300) for name, factor in names.items()}
        for name, factor in names.items():
            if self.table.rate and abs(rates[name] / self.table.rate - 1) < 0.1:
                return [(name, factor)]
        first = float(np.nanmin(np.asarray(self.numbers[self.time or 0])))
        for name, factor in names.items():
            if name != "100 us" and 1e9 < first * factor < 2.2e9 and 0.5 < rates[name] < 2e4:
                return [(name, factor)]
        if "fine" not in self.fields[self.time or 0].stem:
            rates.pop("100 us")
        return [(name, names[name]) for name, rate in rates.items() if _PLAUSIBLE[0] <= rate <= _PLAUSIBLE[1]]

    def _units(self, accel: _Triad | None, gyro: _Triad | None) -> None:
        if accel is not None:
            self._accel_unit(accel)
        turned = None
        if accel is not None and gyro is not None:
            unclear = self.time is not None and self._stated_time() is None
            tried = []
            for factor in [factor for _, factor in self._time_units()] if unclear else [None]:
                self.assumed = factor
                if found := self._turning(accel, gyro):
                    tried.append((abs(found.correlation), self.assumed, found))
            if tried:
                _, self.assumed, turned = max(tried, key=lambda each: each[0])
        slope = abs(turned.slope) if turned and abs(turned.correlation) > _TURNS else None
        if self.time is not None:
            slope = self._time_unit(self.time, gyro, slope)
        elif not self.table.rate:
            self.rate = "?"
            self.questions.append("How many samples a second (--rate)? The file has no time column and states no rate.")
        if gyro is not None:
            known = self.time is not None or self.table.rate is not None
            self._gyro_unit(gyro, accel, slope if known else None, None if known else slope)

    def _accel_unit(self, accel: _Triad) -> None:
        if accel.unit == "?":
            self._take(accel, "accel", None)
            return
        unit = accel.unit if find_unit(accel.unit or "", GROUPS["accel"].quantities) else None
        if unit is None:
            unit = accel.gravity_unit
            if unit == "?":
                unit = None
                self.questions.append(f"Is the accelerometer ({accel.label}) in mg, in cm/s^2, or in counts? Its norm "
                                      f"at rest is {accel.level:.5g}, near 1 g in each.")  # fmt: skip
            elif unit and unit != "count":
                self.reasons.append(
                    f"the accelerometer holds {accel.level:.4g} at rest, which is 1 g in {unit_text(unit)}"
                )
            elif unit is None:
                counts = accel.whole and np.abs(accel.values).max() > 200
                unit = "count" if counts else "m/s" if self._increment(accel) else None
                if unit is None:
                    self.questions.append(
                        f"In which unit is the accelerometer ({accel.label})? Its norm at rest is {accel.level:.4g}, "
                        "1 g in none that is known; is it an accelerometer?"
                    )
        if unit == "count" and not accel.round:
            near = min(_PER_G, key=lambda scale: abs(math.log(accel.level / scale))) if accel.level > 0 else 0
            if near and accel.steady and abs(accel.level / near - 1) < 0.08:
                self.accel_scale = f"{near} count/g"
                self.reasons.append(f"the accelerometer holds {accel.level:.5g} counts at rest: {near} to 1 g")
            else:
                self.accel_scale = "?"
                self.questions.append(
                    f"How many counts are 1 g (--accel-scale)? The accelerometer's norm at rest is {accel.level:.5g}."
                )
        self._take(accel, "accel", unit)

    def _increment(self, accel: _Triad) -> bool:
        """Whether the triad is g times the sampling interval: velocity increments."""
        rate = self.table.rate or (1.0 / self._step() if self.time is not None else None)
        found = bool(rate and accel.steady and abs(accel.level * rate / STANDARD_GRAVITY - 1) < 0.1)
        if found and rate:
            reason = f"{accel.label} hold {accel.level:.4g} at rest, g over an interval of {1 / rate:.4g} s: increments"
            self.reasons += [] if reason in self.reasons else [reason]
        return found

    def _time_unit(self, time: int, gyro: _Triad | None, slope: float | None) -> float | None:
        """Decide the unit of the stamps; returns the slope of the gyroscope with these stamps."""
        if self._stated_time():
            self.chosen[time] = Column(TIME, self.fields[time].unit)
            return slope
        label, options, step = self.table.label(time), self._time_units(), self._step()
        values = np.asarray(self.numbers[time])
        if len(options) == 1 and np.all(np.diff(values) == 1.0) and not self.table.rate:
            options = []  # rows counted from the first on
        if len(options) > 1 and slope is not None and gyro is not None:
            given = find_unit(gyro.unit or "", "angular rate")
            angles = [given.factor] if given else [_ANGLES["rad/s"], _ANGLES["deg/s"]]
            raw = slope * self._factor()
            fits = [(name, factor) for name, factor in options
                    for angle in angles if abs(math.log(raw / factor / angle)) < 0.25]  # fmt: skip
            if len(set(fits)) == 1:
                slope, options = raw / fits[0][1], fits[:1]
                self.reasons.append(f"with stamps in {fits[0][0]} the integrated rates {_TURN}")
        if len(options) == 1:
            unit, factor = options[0]
            said = ", as the file states" if self.table.rate else ""
            rate = 1.0 / (step * factor)
            self.reasons.append(f"{label} rises by {step:.5g} a row, {rate:.4g} Hz in {unit}{said}")
            self.chosen[time] = Column(TIME, unit)
            return slope
        told = ", ".join(f"{1 / (step * factor):.4g} Hz in {unit}" for unit, factor in options)
        said = f": {told}" if told else ", a rate of no IMU in any unit; is it a counter?"
        self.questions.append(f"In which unit is {label}? It rises by {step:.5g} a row{said}.")
        self.chosen[time] = Column(TIME, "?")
        return None

    def _gyro_unit(self, gyro: _Triad, accel: _Triad | None, slope: float | None, per_sample: float | None) -> None:
        """Decide the gyroscope's unit; `per_sample`: the slope at 100 Hz where the rate is not known."""
        unit = gyro.unit if find_unit(gyro.unit or "", GROUPS["gyro"].quantities) else None
        peak = float(np.abs(gyro.values).max())
        rest = float(np.abs(np.median(gyro.values, axis=0)).max())
        resting = accel is not None and accel.still and not accel.posed and not _turns_steadily(gyro)
        accel_unit = next((each.unit for each in self.chosen.values() if (each.name or "").startswith("accel")), None)
        if unit is None and slope is not None:
            near = {name: abs(math.log(slope / factor)) for name, factor in _ANGLES.items()}
            best = min(near, key=lambda name: near[name])
            close = 0.25
            if gyro.whole:  # counts may be anything: 16.4 to 1 deg/s are 1.06 mrad/s
                close = 0.1 if best in ("rad/s", "deg/s") else 0.025
            if accel_unit == "m/s":
                unit = self._angle_increment(slope)
            elif near[best] < close:
                unit = best
                self.reasons.append(f"in {unit} the integrated rates {_TURN} (factor {slope / _ANGLES[best]:.3f})")
        if unit is None and per_sample is not None and not gyro.whole:
            rates = {name: 100 * _ANGLES[name] / per_sample for name in ("rad/s", "deg/s", "mdeg/s")}
            fits = [name for name, rate in rates.items()
                    if _LIKELY[0] < rate < _LIKELY[1] and name in _plausible(peak, rest, None)]  # fmt: skip
            said = " or ".join(f"{rates[name]:.3g} Hz if it is in {name}" for name in fits)
            if fits:
                self.questions.append(f"The rates {_TURN} at about {said}.")
            if len(fits) == 1:
                unit = fits[0]
                self.reasons.append(f"at a usual sample rate the integrated rates {_TURN} only in {unit}")
        if unit is None and gyro.whole:
            unit = "count"
        elif unit is None and accel_unit != "m/s" and slope is None:
            fits = _plausible(peak, rest, gyro.noise if resting else None)
            if accel is not None and accel.still and not accel.posed and not resting:  # about the vertical
                fits = [name for name in ("rad/s", "deg/s") if name in fits]
            if len(fits) == 1:
                unit = fits[0]
                said = f", and at rest {rest:.3g} with a scatter of {gyro.noise:.2g}" if resting else ""
                self.reasons.append(f"the gyroscope reads up to {peak:.4g}{said}: of a sensor only in {unit}")
        if unit is None:
            self.questions.append(
                f"Is the gyroscope ({gyro.label}) in deg/s or rad/s? It reads up to {peak:.3g}, and "
                + ("its turns fit both." if per_sample else "does not turn gravity enough to decide.")
            )
        if unit == "count":
            self._gyro_counts(slope)
        self._take(gyro, "gyro", unit)

    def _angle_increment(self, slope: float) -> str | None:
        unit = find_unit(self.chosen[self.time].unit or "") if self.time is not None else None
        interval = self._step() * unit.factor if unit else 1.0 / (self.table.rate or 1.0)
        if abs(math.log(slope * interval)) < 0.25:
            self.reasons.append("the gyroscope's increments, summed in rad, turn gravity as the accelerometer shows")
            return "rad"
        return None

    def _gyro_counts(self, slope: float | None) -> None:
        if slope:
            per_degree = math.pi / 180 / slope
            near, *others = sorted(_PER_DEGREE, key=lambda scale: abs(math.log(per_degree / scale)))
            off = abs(math.log(per_degree / near))
            apart = min(abs(math.log(per_degree / each)) for each in others if abs(each / near - 1) > 0.01)
            if off < 0.06 and apart > 2 * off:
                self.gyro_scale = f"{near:g} count/(deg/s)"
                self.reasons.append(f"{per_degree:.4g} counts to 1 deg/s {_TURN}; nominal are {near:g}")
                return
        near = [] if not slope else [f"{scale:g}" for scale in _PER_DEGREE
                                     if abs(math.log(math.pi / 180 / slope / scale)) < _ROUGH]  # fmt: skip
        known = f" Of the usual ones {listed(near, 'or')} would fit." if near else ""
        self.gyro_scale = "?"
        self.questions.append(f"How many counts are 1 deg/s (--gyro-scale)? The data sheet says.{known}")

    def _take(self, triad: _Triad, sensor: str, unit: str | None) -> None:
        for at, name in zip(triad.places, GROUPS[sensor].columns, strict=True):
            self.chosen[at] = Column(name, unit or "?")

    def _others(self, triads: list[_Triad]) -> None:
        """Magnetometer and temperature, where name and unit are clear; what is not clear is left out."""
        for triad in triads:
            if triad.sensor == "mag" and not any(each.name == "mag_x" for each in self.chosen.values()):
                unit = triad.unit if find_unit(triad.unit or "", GROUPS["mag"].quantities) else None
                sizes = {"uT": 50.0, "G": 0.5, "mG": 500.0, "nT": 5e4, "T": 5e-5}
                unit = unit or next((name for name, size in sizes.items() if 0.5 < triad.level / size < 1.4), None)
                if triad.whole and not triad.unit:
                    unit = "count"
                if unit:
                    self._take(triad, "mag", unit)
        self._quaternion()
        for at, each in enumerate(self.fields):
            values, name = self.numbers[at], each.sensor or ""
            if name.startswith("attitude_"):
                self.chosen[at] = Column(name, each.unit)
            if name not in _SINGLE or values is None or any(other.name == name for other in self.chosen.values()):
                continue
            unit = each.unit if find_unit(each.unit or "", GROUPS[name].quantities) else None
            if unit is None and "temperature" in name and -60 < np.nanmin(values) <= np.nanmax(values) < _HOTTEST:
                unit = "degC"
            elif unit is None and "temperature" in name and np.ptp(values[np.isfinite(values)]) > 0:
                unit = "count"
                self.reasons.append(
                    f"{self.table.label(at)} is between {np.nanmin(values):.6g} and {np.nanmax(values):.6g}, which is "
                    f"no temperature in °C but a chip's counts: {COUNTS_ADVICE}, for jaximu thermal"
                )
            if unit:
                self.chosen[at] = Column(name, unit)

    def _quaternion(self) -> None:
        """An attitude by name, whose four numbers have norm 1."""
        named: dict[str, dict[str, int]] = {}
        for at, name in enumerate(self.table.names or ()):
            if match := re.fullmatch(r"(.*?)[\W_]*([wxyz])", parse_column(name)[0].strip().lower()):
                named.setdefault(match[1], {})[match[2]] = at
        for head, places in named.items():
            columns = [self.numbers[at] for at in places.values()]
            if len(places) < 4 or not set(words_of(head)) & _ATTITUDES or any(each is None for each in columns):
                continue
            norm = np.linalg.norm(np.stack([each for each in columns if each is not None]), axis=0)
            if np.nanmax(np.abs(norm - 1)) < _UNIT_LENGTH:
                self.reasons.append(f"{head!r} is a quaternion of norm 1: an attitude")
                for axis, at in places.items():
                    self.chosen[at] = Column(f"attitude_{axis}")
                return

    # --- the result

    def _lone_magnetometer(self) -> str:
        columns = [self.chosen.get(at, Column(None)) for at in range(self.width)]
        mine = [each if (each.name or "").startswith(("mag_", "time")) else Column(None) for each in columns]
        stated = header_columns(self.table) or ()
        known = any(each.name == "mag_x" and each.unit for each in stated)
        option = "" if known else f" --columns '{column_text(mine)}'"
        return f"This file holds a magnetometer alone: jaximu magnetometer {self.table.path}{option} calibrates it."

    def _result(self, accel: _Triad | None, gyro: _Triad | None) -> Advice:
        if accel is None and self.role != "gyro" and (said := self._without_gravity()):
            self.questions = [said]
        elif accel is None and gyro is not None and self.role != "gyro":
            self.questions.append(_lone_gyroscope(self.table))
        elif accel is None and self.role != "gyro" and not self.questions:
            self.questions.append("Which columns are the accelerometer?")
        if gyro is None and self.role == "gyro":
            self.questions.append("Which columns are the gyroscope?")
        if accel is None and gyro is None:
            if self.attitude or any(why == "an estimated bias" for _, why in self.refused):
                self.questions = [
                    f"This is a trajectory (attitude, and position or biases beside it), no sensor's log: give it as "
                    f"--reference {self.table.path} to `jaximu reference` with the log of the same motion."
                ]
            if any(each.name == "mag_x" for each in self.chosen.values()):
                self.questions = [self._lone_magnetometer()]
            elif self.table.names is None and self.width == len("xyz") + (self.time is not None):
                self.questions[:1] = [
                    f"{' '.join(self.questions[:1])} If they are a magnetometer's, jaximu magnetometer "
                    f"{self.table.path} --columns calibrates it, with its columns named (mag [uT], or mag [count])."
                ]
            self.questions = self.questions[:1]
            return Advice(None, None, None, None, tuple(self.reasons), tuple(self.questions))
        columns = [self.chosen.get(at, Column(None)) for at in range(self.width)]
        stated = header_columns(self.table)
        said = stated is not None and all(
            a == b if a.name else not b.name for a, b in zip(columns, stated, strict=True)
        )
        order = sorted(self.chosen)
        rows = [tuple(column_text([self.chosen[at]]) for at in order)]
        for row in range(min(_SHOWN, len(self.table.columns[0]))):
            cells = [self.table.columns[at][row] for at in order]
            rows.append(tuple(f"{cell:.6g}" if isinstance(cell, float | np.floating) else str(cell) for cell in cells))
        text = None if said else column_text(columns)
        return Advice(
            text, self.rate, self.accel_scale, self.gyro_scale, tuple(self.reasons), tuple(self.questions),
            tuple(rows) if order else (), accel is not None,
        )  # fmt: skip


def quiet_means_of(triad: _Triad, time: FloatArray | None = None) -> FloatArray:
    """The means of a triad's quiet windows, for its sphere."""
    from jaximu.recordings.recording import Signal

    stamps = np.arange(len(triad.values)) / 100.0 if time is None else time
    return quiet_means(Signal(stamps, triad.values, "count"))


def column_text(columns: Sequence[Column]) -> str:
    """The columns as `--columns` takes them, as short as can be."""
    entries: list[str] = []
    names, at = [column.name for column in columns], 0
    triads: dict[tuple, str] = {each.columns: key for key, each in GROUPS.items() if len(each.columns) == 3}
    while at < len(columns):
        unit = f" [{columns[at].unit}]" if columns[at].unit else ""
        triad = triads.get(tuple(names[at : at + 3]))
        skipped = sum(1 for _ in takewhile(lambda name: name is None, names[at:]))
        if skipped:
            entries += [f"_*{skipped}"] if skipped > 3 else ["_"] * skipped
        else:
            entries.append(f"{triad or names[at]}{unit}")
        at += skipped or (3 if triad else 1)
    return ",".join(entries)


def _turns_steadily(gyro: _Triad) -> bool:
    """Whether a gyroscope's means change by more than its noise: it turns, if only about the vertical."""
    size = max(5, min(50, len(gyro.values) // 20))
    count = len(gyro.values) // size
    if count < 4:
        return False
    means = gyro.values[: count * size].reshape(count, size, 3).mean(axis=1)
    return bool(np.std(means, axis=0).max() > _TURNING * gyro.noise)


def _plausible(peak: float, bias: float, noise: float | None) -> list[str]:
    """The units in which a sensor may read so much: 2300 °/s at most, and at rest 25 °/s of bias, 3 °/s of scatter."""
    found = []
    for unit in ("rad/s", "deg/s", "mdeg/s"):
        degree = math.degrees(_ANGLES[unit])
        at_rest = noise is None or (bias * degree < 25 and 1e-4 < noise * degree < (1.0 if unit == "deg/s" else 3.0))
        if peak * degree < 2300 and at_rest and not (unit == "mdeg/s" and "deg/s" in found):
            found.append(unit)
    return found


def _plain(field: Field) -> bool:
    """Whether a name says nothing."""
    return all(word.rstrip("0123456789") in _PLAIN or word.isdigit() for word in field.stem)


def _alike(one: Field, other: Field) -> bool:
    """Whether two names differ by a number alone, or are none: columns of one matrix."""
    words = [[word.rstrip("0123456789") for word in each.stem if not word.isdigit()] for each in (one, other)]
    return words[0] == words[1] and one.unit == other.unit


def _lone_gyroscope(table: Table) -> str:
    path = Path(table.path)
    others = sorted(path.parent.glob(f"*{path.suffix}")) if path.is_file() else []
    names = [each.name for each in others if "acc" in each.name.lower() and "linear" not in each.name.lower()]
    where = f"read both: {names[0]} --gyro-log {path.name}" if names else "give its file, and this one as --gyro-log"
    return (
        f"Where is the accelerometer? This file holds a gyroscope alone; {where}. Alone it can be calibrated on a "
        "table (jaximu turntable, with its turns as --reference), and at rest its noise can be seen (jaximu allan)."
    )
