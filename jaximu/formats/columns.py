"""Which column is which: canonical names, their aliases, and the `--columns` option."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaximu.errors import InputError
from jaximu.formats.table import Table
from jaximu.units import BASE_UNITS, Unit, find_unit, parse_column, unit


@dataclass(frozen=True)
class Group:
    """Columns that are sampled together: their canonical names, the field of `Recording`, what they may measure."""

    field: str
    columns: tuple[str, ...]
    quantities: tuple[str, ...]


def _triad(field: str, prefix: str, quantity: str) -> Group:
    return Group(field, tuple(f"{prefix}_{axis}" for axis in "xyz"), (quantity, "raw count"))


TIME = "time"
GROUPS = {
    "accel": _triad("accelerometer", "accel", "acceleration"),
    "gyro": _triad("gyroscope", "gyro", "angular rate"),
    "mag": _triad("magnetometer", "mag", "magnetic field"),
    "temperature": Group("temperature", ("temperature",), ("temperature",)),
    "ambient_temperature": Group("ambient_temperature", ("ambient_temperature",), ("temperature",)),
    "table_angle": Group("table_angle", ("table_angle",), ("angle",)),
    "table_rate": Group("table_rate", ("table_rate",), ("angular rate",)),
    "attitude": Group("attitude", tuple(f"attitude_{axis}" for axis in "wxyz"), ("ratio",)),
}
_QUANTITIES = {TIME: ("time",)} | {name: group.quantities for group in GROUPS.values() for name in group.columns}
_IGNORED = {"", "_", "-", "skip"}
_ALIASES = (
    (r"(?:t|time|timestamp|time_?stamp|stamp)", TIME),
    (r"(?:a|acc|accel|accelerometer|acceleration)_?([xyz])", "accel_{}"),
    (r"(?:g|gyr|gyro|gyroscope|w|omega|angular_velocity|angular_rate)_?([xyz])", "gyro_{}"),
    (r"(?:m|mag|magnetometer|magnetic_field)_?([xyz])", "mag_{}"),
    (r"(?:temp|temperature|gyro_temperature|gyro_temp|acc_temp|accel_temp)", "temperature"),
    (r"(?:ambient|ambient_temp|ambient_temperature)", "ambient_temperature"),
    (r"(table_angle|table_rate|attitude_[wxyz])", "{}"),
)
_PREFIX = r"(?:(?:imu|raw|sensor|data)\d*_)*"


def canonical(name: str) -> str | None:
    """The canonical name of a column called `name` ("imu.acc.x", "ax" → "accel_x"); None if it is none of ours."""
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    for pattern, title in _ALIASES:
        if match := re.fullmatch(_PREFIX + pattern, plain):
            return title.format(*match.groups())
    return None


@dataclass(frozen=True)
class Column:
    """What one column of a file is: its canonical name (None: not used) and the unit it states, if any."""

    name: str | None
    unit: str | None = None


def parse_columns(text: str | Sequence[str]) -> tuple[Column, ...]:
    """The columns of a `--columns` text, in order: names with units in brackets, separated by commas.

    "_", "-" or "skip" ignores a column; a bare triad ("accel [g]", "gyro [dps]", "mag [uT]", "attitude") stands for
    its three (four) columns. Raises InputError for a name that is not known.
    """
    found: list[Column] = []
    for entry in text.split(",") if isinstance(text, str) else text:
        name, stated = parse_column(entry)
        if name.lower() in _IGNORED:
            found.append(Column(None))
        elif name in GROUPS and len(GROUPS[name].columns) > 1:
            found.extend(Column(each, stated) for each in GROUPS[name].columns)
        elif title := canonical(name):
            found.append(Column(title, stated))
        else:
            raise InputError(
                f"--columns: {name!r} is not known; known are {', '.join(_QUANTITIES)}, and _ to ignore a column."
            )
    return tuple(found)


def column_units(table: Table, columns: Sequence[Column], option: str = "--columns") -> dict[str, tuple[int, Unit]]:
    """The used columns of a table by canonical name: their index and unit.

    Raises InputError for a doubled name, a triad without one of its axes, a unit that is missing (with a line to
    copy), unknown, or one of another quantity.
    """
    found: dict[str, tuple[int, Unit]] = {}
    for index, column in enumerate(columns):
        if column.name is None:
            continue
        if column.name in found:
            first = table.label(found[column.name][0])
            raise InputError(
                f"{table.path}: the columns {first} and {table.label(index)} are both {column.name}; "
                f"ignore one of them: {ready_line(table, columns, option)}"
            )
        wanted = _QUANTITIES[column.name]
        stated = column.unit or ("1" if wanted == ("ratio",) else None)
        if stated is None:
            raise InputError(
                f"{table.path}: column {table.label(index)} states no unit. State the units with {option}, after "
                f"checking those guessed here: {ready_line(table, columns, option)}"
            )
        found[column.name] = index, unit(stated, wanted, file=table.path, column=column.name)
    for group in GROUPS.values():
        missing = [name for name in group.columns if name not in found]
        if missing and len(missing) < len(group.columns):
            raise InputError(f"{table.path}: column {missing[0]} is missing beside {_present(group, found)}.")
        units = {found[name][1].quantity for name in group.columns} if not missing else set()
        if len(units) > 1:
            raise InputError(f"{table.path}: columns {', '.join(group.columns)} mix raw counts with physical units.")
    return found


def _present(group: Group, found: dict[str, tuple[int, Unit]]) -> str:
    return ", ".join(name for name in group.columns if name in found)


def header_columns(table: Table) -> tuple[Column, ...] | None:
    """The columns that the file's own header names, or None without one that names any of ours."""
    if table.names is None:
        return None
    parsed = [parse_column(name) for name in table.names]
    columns = tuple(Column(canonical(name), stated) for name, stated in parsed)
    return columns if any(column.name for column in columns) else None


def ready_line(
    table: Table, columns: Sequence[Column] | None = None, option: str = "--columns", gyro: bool = False
) -> str:
    """A `--columns` option to copy: the columns that are known, with units guessed from the numbers; _ for the rest.

    Without known columns they are guessed from their count: time if the first one rises throughout, then
    accelerometer, then gyroscope (`gyro`: the gyroscope alone).
    """
    width = len(table.columns)
    if columns is None:
        rising = width > 3 and _rises(table.columns[0])
        triads = ["gyro"] if gyro else ["accel", "gyro"]
        order = [TIME] * rising + [name for triad in triads for name in GROUPS[triad].columns]
        columns = tuple(Column(name) for name in [*order, *([None] * width)][:width])
    used: set[str] = set()
    entries: list[str] = []
    for column in columns:
        name = None if column.name in used else column.name
        used.add(name or "")
        stated = column.unit if column.unit and find_unit(column.unit) else None
        alike = [table.columns[at] for at, other in enumerate(columns) if _group(other.name) == _group(name)]
        entries.append(f"{name} [{stated or _likely_unit(name, alike)}]" if name else "_")
    return f'{option} "{",".join(entries)}"'


def _group(name: str | None) -> str | None:
    """The group that a canonical name belongs to; time is its own."""
    return next((key for key, group in GROUPS.items() if name in group.columns), name)


def _rises(column: np.ndarray) -> bool:
    return column.dtype != object and bool(np.all(np.diff(column) > 0))


def _likely_unit(name: str, columns: Sequence[np.ndarray]) -> str:
    """A guess from the numbers of all columns of a sensor, only ever offered for the user to check."""
    values = np.concatenate([np.asarray(each, np.float64) for each in columns if each.dtype != object] or [np.empty(0)])
    values = values[np.isfinite(values)]
    quantity = _QUANTITIES[name][0]
    size = float(np.percentile(np.abs(values), 90.0)) if len(values) else 0.0
    if "raw count" in _QUANTITIES[name] and size > 20.0 and np.all(values == np.round(values)):
        return "count"
    if quantity == "time":
        step = float(np.median(np.abs(np.diff(values)))) if len(values) > 1 else 0.0
        return "s" if step < 1.0 else "ms" if step < 100.0 else "us" if step < 1e6 else "ns"
    if quantity == "acceleration":
        return "g" if size < 4.0 else "m/s^2" if size < 400.0 else "mg"
    if quantity == "angular rate":
        return "deg/s" if np.max(np.abs(values), initial=0.0) > 35.0 else "rad/s"
    return "deg" if quantity == "angle" else BASE_UNITS[quantity]


def choose_columns(
    table: Table, columns: str | Sequence[str] | None, sensor: str = "accel", option: str = "--columns"
) -> tuple[Column, ...]:
    """The columns of a file that must hold `sensor`: from `columns` (naming all columns), else from its header."""
    if columns is not None:
        chosen = parse_columns(columns)
        if len(chosen) != len(table.columns):
            raise _wrong_count(table, len(chosen), option)
        return chosen
    named = header_columns(table)
    if named is None or not any(_is(column, sensor) for column in named):
        raise _unnamed(table, named, sensor, option)
    return named


def _wrong_count(table: Table, given: int, option: str) -> InputError:
    return InputError(
        f"{table.path}: {option} names {given} columns, the file has {len(table.columns)}; "
        f"name each one, for example {ready_line(table, header_columns(table), option)}"
    )


def _unnamed(table: Table, named: Sequence[Column] | None, sensor: str, option: str) -> InputError:
    """The error for a file in which nobody has named the columns of a sensor that it must hold."""
    needed = ", ".join(GROUPS[sensor].columns)
    if table.names:
        found = ", ".join(table.label(index) for index in range(len(table.names)))
        text = f"{table.path}: columns {needed} are missing; it has {found}. If these hold them, name all columns"
    else:
        text = f"{table.path}: has no column names ({len(table.columns)} columns). Name them all"
    guess = ready_line(table, named, option, gyro=sensor == "gyro")
    return InputError(f"{text} in order with {option}, after checking order and units of this guess: {guess}")


def choose_pair(
    accel: Table, gyro: Table, columns: str | Sequence[str] | None, gyro_columns: str | Sequence[str] | None
) -> tuple[tuple[Column, ...], tuple[Column, ...]]:
    """The columns of an accelerometer file and a gyroscope file.

    `columns` may name both files' columns at once (time, accelerometer, gyroscope): each file takes the list without
    the other's sensor. A list without a gyroscope, in raw counts, is used for the gyroscope's file as well.
    `gyro_columns` names those of the second file alone. Columns not given are read from the headers.
    """
    given = parse_columns(columns) if columns is not None else ()
    first = choose_columns(accel, None) if not given else _fit(accel, given, _without(given, "gyro"))
    if gyro_columns is not None:
        return first, choose_columns(gyro, gyro_columns, "gyro", "--gyro-columns")
    if not given or (not any(_is(column, "gyro") for column in given) and header_columns(gyro)):
        return first, choose_columns(gyro, None, "gyro", "--gyro-columns")
    if any(_is(column, "gyro") for column in given):
        only = tuple(column for column in given if column.name == TIME or _is(column, "gyro"))
        return first, _fit(gyro, given, _without(given, "accel"), only)
    swapped = tuple(Column((column.name or "").replace("accel_", "gyro_") or None, column.unit) for column in given)
    counts = all(
        (found := find_unit(column.unit or "")) and found.quantity == "raw count"
        for column in given
        if _is(column, "accel")
    )
    if not counts or len(swapped) != len(gyro.columns):
        raise _unnamed(gyro, None, "gyro", "--gyro-columns")
    return first, swapped


def _is(column: Column, group: str) -> bool:
    return column.name in GROUPS[group].columns


def _without(columns: Sequence[Column], group: str) -> tuple[Column, ...]:
    return tuple(column for column in columns if not _is(column, group))


def _fit(table: Table, *choices: tuple[Column, ...]) -> tuple[Column, ...]:
    """The first choice that has as many columns as the table."""
    for choice in choices:
        if len(choice) == len(table.columns):
            return choice
    raise _wrong_count(table, len(choices[0]), "--columns")
