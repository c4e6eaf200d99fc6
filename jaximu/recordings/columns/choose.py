"""The columns of a file as its header or the options name them, else an error with a line to paste."""

from collections.abc import Sequence

from jaximu.ground.errors import InputError
from jaximu.ground.units import Unit, find_unit, unit
from jaximu.recordings.columns.guess import advise
from jaximu.recordings.columns.names import GROUPS, QUANTITIES, TIME, Column, header_columns, parse_columns
from jaximu.recordings.columns.table import LogTable

_LISTED = 30
Used = dict[str, tuple[int, Unit]]
"""By canonical name, the columns that are used: their index and unit."""


def column_units(table: LogTable, columns: Sequence[Column], option: str, sensor: str | None) -> Used:
    """The used columns of a table by canonical name: their index and unit.

    Raises InputError for a doubled name, a triad without one of its axes, a unit that is missing (with a line to
    copy), unknown, or one of another quantity. `sensor`: the one that the file must hold, where it is for one alone.
    """
    used: Used = {}
    for index, column in enumerate(columns):
        if column.name is None:
            continue
        if column.name in used:
            first = table.label(used[column.name][0])
            raise table.refused(
                f"the columns {first} and {table.label(index)} are both {column.name}; "
                "ignore one of them (of two units on one body jaximu array takes both lists, with a ; between)"
                f"{advise(table).sentence(option, ': ')}"
            )
        wanted = QUANTITIES[column.name]
        stated = column.unit or ("1" if wanted == ("ratio",) else None)
        if stated is None:
            raise table.refused(
                f"column {table.label(index)} states no unit. State the units with {option}"
                f"{advise(table, sensor).sentence(option, ', after checking those guessed here: ')}"
            )
        used[column.name] = index, unit(stated, wanted, file=table.path, column=column.name)
    for group in GROUPS.values():
        missing = [name for name in group.columns if name not in used]
        if missing and len(missing) < len(group.columns):
            present = ", ".join(name for name in group.columns if name in used)
            raise table.refused(f"column {missing[0]} is missing beside {present}.")
        if not missing and len({used[name][1].quantity for name in group.columns}) > 1:
            raise table.refused(f"columns {', '.join(group.columns)} mix raw counts with physical units.")
    return used


def choose_columns(
    table: LogTable, columns: str | Sequence[str] | None, sensor: str = "accel", option: str = "--columns"
) -> tuple[Column, ...]:
    """The columns of a file that must hold `sensor`: from `columns` (naming all columns), else from its header."""
    if columns is not None:
        chosen = parse_columns(columns)
        if len(chosen) != len(table.columns):
            raise _wrong_count(table, len(chosen), option)
        return chosen
    named = header_columns(table)
    if named is None or not any(_is(column, sensor) for column in named):
        raise _unnamed(table, sensor, option)
    return named


def _wrong_count(table: LogTable, count: int, option: str) -> InputError:
    return table.refused(
        f"{option} names {count} columns, the file has {len(table.columns)}; "
        f"name each one{advise(table).sentence(option, ', for example ')}"
    )


def _unnamed(table: LogTable, sensor: str, option: str) -> InputError:
    """The error for a file in which nobody has named the columns of a sensor that it must hold."""
    needed = ", ".join(GROUPS[sensor].columns)
    if table.names:
        present = ", ".join(table.label(index) for index in range(min(len(table.names), _LISTED)))
        more = f" and {len(table.names) - _LISTED} more" if len(table.names) > _LISTED else ""
        text = (
            f"{table.path}: columns {needed} are missing; it has {present}{more}. If these hold them, name all columns"
        )
    else:
        text = f"{table.path}: has no column names ({len(table.columns)} columns). Name them all"
    advice = advise(table, None if sensor == "accel" else sensor)
    if not (advice.line(option) or advice.questions):  # the header names all that it has
        file = f"; a separate file is given with --{sensor}-log" if sensor != "accel" else ""
        return InputError(f"{text} in order with {option}{file}.")
    guess = advice.sentence(option, ", after checking order and units of this guess: ")
    return InputError(f"{text} in order with {option}{guess}")


def choose_pair(
    accel: LogTable, gyro: LogTable, columns: str | Sequence[str] | None, gyro_columns: str | Sequence[str] | None
) -> tuple[tuple[Column, ...], tuple[Column, ...]]:
    """The columns of an accelerometer file and a gyroscope file.

    `columns` may name both files' columns at once (time, accelerometer, gyroscope): each file takes the list without
    the other's sensor. A list without a gyroscope, in raw counts, is used for the gyroscope's file as well.
    `gyro_columns` names those of the second file alone. Columns not given are read from the headers.
    """
    named = parse_columns(columns) if columns is not None else ()
    of_gyro = [column for column in named if _is(column, "gyro")]
    first = choose_columns(accel, None) if not named else _fit(accel, named, _without(named, "gyro"))
    if gyro_columns is not None or not named or (not of_gyro and header_columns(gyro)):
        return first, choose_columns(gyro, gyro_columns, "gyro", "--gyro-columns")
    if of_gyro:
        only = tuple(column for column in named if column.name == TIME or column in of_gyro)
        return first, _fit(gyro, named, _without(named, "accel"), only)
    swapped = tuple(Column((column.name or "").replace("accel_", "gyro_") or None, column.unit) for column in named)
    counts = all(find_unit(column.unit, "raw count") for column in named if _is(column, "accel"))
    if not counts or len(swapped) != len(gyro.columns):
        raise _unnamed(gyro, "gyro", "--gyro-columns")
    return first, swapped


def _is(column: Column, group: str) -> bool:
    return column.name in GROUPS[group].columns


def _without(columns: Sequence[Column], group: str) -> tuple[Column, ...]:
    return tuple(column for column in columns if not _is(column, group))


def _fit(table: LogTable, *choices: tuple[Column, ...]) -> tuple[Column, ...]:
    """The first choice that has as many columns as the table."""
    if fitting := [choice for choice in choices if len(choice) == len(table.columns)]:
        return fitting[0]
    raise _wrong_count(table, len(choices[0]), "--columns")
