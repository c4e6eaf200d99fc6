"""Which column is which: canonical names, and the `--columns` option."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaximu.ground.errors import InputError
from jaximu.ground.units import SENSORS, find_unit, parse_column
from jaximu.recordings.columns.habits import Field, fields_of, measures
from jaximu.recordings.columns.table import LogTable


@dataclass(frozen=True)
class Group:
    """Columns that are sampled together: their canonical names, the field of `Recording`, what they may measure."""

    field: str
    columns: tuple[str, ...]
    quantities: tuple[str, ...]


_TRIADS = {  # in counts, and in increments over each sampling interval, too
    "accel": ("acceleration", "raw count", "velocity increment"),
    "gyro": ("angular rate", "raw count", "angle"),
    "mag": ("magnetic field", "raw count"),
}
SINGLE = {
    "temperature": ("temperature", "raw count"),
    "ambient_temperature": ("temperature", "raw count"),
    "current": ("electric current",),
    "table_angle": ("angle",),
    "table_rate": ("angular rate",),
}
"""Columns that are no triad's, and what they measure."""
TIME = "time"
GROUPS = {
    **{key: Group(SENSORS[key], tuple(f"{key}_{axis}" for axis in "xyz"), what) for key, what in _TRIADS.items()},
    **{name: Group(name, (name,), quantities) for name, quantities in SINGLE.items()},
    "attitude": Group("attitude", tuple(f"attitude_{axis}" for axis in "wxyz"), ("ratio",)),
}
COUNTS_ADVICE = (
    "state the data sheet's formula as its unit, such as temperature [count/340+36.53] (MPU-6050) or "
    "[count/333.87+21] (MPU-9250)"
)
CLOCKS = {f"{sensor}_time": sensor for sensor in ("gyro", "mag")}
"""Columns of stamps that one sensor has for its own, and that sensor; `TIME` is the accelerometer's beside them."""
QUANTITIES = dict.fromkeys((TIME, *CLOCKS), ("time",)) | {
    name: group.quantities for group in GROUPS.values() for name in group.columns
}
_SAME = 0.01  # of the step, that two clocks of the same samples may differ by
_NEAR, _EVEN = 64, 0.9  # places that rows may be off their own, and share of sorted steps that are alike
_SKIPPED = re.compile(r"(?:_|-|skip|)(?:\*(\d{1,4}))?")


def canonical(name: str) -> str | None:
    """The canonical name of a column called `name` ("imu.acc.x", "ax" → "accel_x"); None if it is none of ours."""
    return Field.of(name).canonical


@dataclass(frozen=True)
class Column:
    """What one column of a file is: its canonical name (None: not used) and the unit it states, if any."""

    name: str | None
    unit: str | None = None


def parse_columns(text: str | Sequence[str]) -> tuple[Column, ...]:
    """The columns of a `--columns` text, in order: names with units in brackets, separated by commas.

    "_", "-" or "skip" ignores a column, "_*5" five of them; a bare triad ("accel [g]", "gyro [dps]", "mag [uT]",
    "attitude") stands for its three (four) columns. Raises InputError for a name that is not known.
    """
    columns = []
    for entry in text.split(",") if isinstance(text, str) else text:
        name, stated = parse_column(entry)
        if match := _SKIPPED.fullmatch(name.lower()):
            columns += [Column(None)] * int(match[1] or 1)
        elif stated is not None and "?" in stated:
            raise InputError(f"--columns: the unit of {name} is for you to fill in; write it in place of the ?.")
        elif name in GROUPS and len(GROUPS[name].columns) > 1:
            columns.extend(Column(title, stated) for title in GROUPS[name].columns)
        elif title := name if name in CLOCKS else canonical(name):
            columns.append(Column(title, stated))
        else:
            raise InputError(
                f"--columns: {name!r} is not known; known are {', '.join(QUANTITIES)}, and _ to ignore a column."
            )
    return tuple(columns)


def header_columns(table: LogTable) -> tuple[Column, ...] | None:
    """The columns that the file's own header names, or None without one that names any of ours.

    Of several columns of time the first that states its unit and rises counts. Beside a named accelerometer, three
    columns in a unit of angular rate are the gyroscope by whatever name.
    """
    fields = fields_of(table.header)
    columns = [Column(field.canonical, field.unit) for field in fields]
    rates = {
        at: Column(f"gyro_{field.axis}", field.unit)
        for at, field in enumerate(fields)
        if field.axis and not (field.sensor or field.why_not) and measures(field.unit) == "gyro"
    }
    gyro, known = GROUPS["gyro"].columns, {column.name for column in columns}
    if (
        sorted(column.name or "" for column in rates.values()) == [*gyro]
        and "accel_x" in known
        and known.isdisjoint(gyro)
    ):
        columns = [rates.get(at, column) for at, column in enumerate(columns)]
    times = [at for at, column in enumerate(columns) if column.name == TIME]
    if len(times) > 1:  # a unit alone names a part of a time of day, most likely
        whole = [at for at in times if not fields[at].bare_time]
        best = max(whole, key=lambda at: (rises(table.columns[at]), columns[at].unit is not None, -at), default=None)
        owners = {_owner(fields, columns, at): at for at in reversed(whole) if rises(table.columns[at])}
        if "accel" in owners and owners.keys() & CLOCKS.values():
            best = owners["accel"]
        titles = {owners[sensor]: title for title, sensor in CLOCKS.items() if sensor in owners}
        for at in times:
            if at != best:
                apart = at in titles and best is not None and _of_one_clock(table, columns, best, at)
                columns[at] = Column(titles[at], columns[at].unit) if apart else Column(None)
    return tuple(columns) if any(column.name for column in columns) else None


def _owner(fields: Sequence[Field], columns: Sequence[Column], at: int) -> str | None:
    """The sensor whose stamps a column of time holds, by its name or as it stands right before its x axis."""
    follows = columns[at + 1].name or "" if at + 1 < len(columns) else ""
    return fields[at].clock_of or (follows.removesuffix("_x") if follows.endswith("_x") else None)


def _of_one_clock(table: LogTable, columns: Sequence[Column], first: int, second: int) -> bool:
    """Whether two columns of stamps count one time, and are not those of the same samples."""
    stamps = []
    for at in (first, second):
        unit = find_unit(columns[at].unit, "time")
        stamps.append(np.asarray(table.numbers(at), float) * (unit.factor if unit else 1.0))
    one, other = stamps
    span = np.nanmax(one) - np.nanmin(one)
    overlap = min(np.nanmax(one), np.nanmax(other)) - max(np.nanmin(one), np.nanmin(other))
    return bool(overlap > span / 2 and np.nanmax(np.abs(one - other)) > _SAME * span / len(one))


def rises(values: np.ndarray) -> bool:
    """Whether a column's numbers rise, with repeats and a few steps back, such as a counter's at its end.

    Numbers of rows that are `shuffled` rise, too.
    """
    if values.dtype == object or len(values) < 3:
        return False
    finite = values[np.isfinite(values)]
    steps = np.diff(finite)
    back = steps[steps < 0]
    ended = steps.sum() > 0 or (len(back) and back.max() < -np.ptp(finite) / 2)
    rising = len(steps) and (steps > 0).mean() > 0.2 and ended
    return bool(rising and (len(back) < 0.02 * len(steps) or shuffled(finite)))


def shuffled(values: np.ndarray) -> bool:
    """Whether numbers go back in places and rise evenly once sorted, each within a few places of its own."""
    order = np.argsort(values, kind="stable")
    moved, steps = order - np.arange(len(order)), np.diff(values[order])
    usual = np.median(steps) if len(steps) else 0.0
    even = (np.abs(steps - usual) < 0.5 * usual).mean() > _EVEN if usual > 0 else False
    return bool(moved.any() and np.abs(moved).max() <= _NEAR and even)
