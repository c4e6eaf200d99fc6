"""JSON: an object of columns, a list of records, one record a line, or a list of names beside a list of rows.

Records that name their sensor (`"sensor": "Accelerometer"`) become tables of their own, each with its own stamps.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from jaximu.ground.distributions import robust_sigma
from jaximu.ground.document import Json
from jaximu.ground.errors import InputError
from jaximu.ground.units import SENSORS, column_title, parse_column
from jaximu.recordings.columns.habits import fields_of, sensor_of, words_of
from jaximu.recordings.columns.names import GROUPS, TIME, Column, header_columns, rises
from jaximu.recordings.columns.table import LogTable
from jaximu.recordings.readers.arrays import table_of
from jaximu.recordings.readers.clock import seconds_of
from jaximu.recordings.recording import Source

_TAGS = ("sensor", "sensorname", "sensor_name", "type", "name", "topic")
_ANDROID = {"accel": "m/s^2", "gyro": "rad/s", "mag": "uT"}


def read(data: bytes, source: Source) -> LogTable | tuple[LogTable, ...]:
    """The tables in a JSON document. Raises InputError naming the line that is no JSON, or what is missing."""
    text = data.decode("utf-8-sig", errors="replace").strip()
    try:
        document = json.loads(text)
    except json.JSONDecodeError as error:
        try:  # one record a line
            document = [json.loads(line) for line in text.splitlines() if line.strip()]
        except json.JSONDecodeError:
            raise InputError(f"{source.path}, row {error.lineno}: is no JSON ({error.msg}).") from None
    records = _records(document)
    if records is not None:
        tables = list(_by_sensor(records, source))
        if tables:
            return _joined(tables)
        about = dict(_leaves(document)) if isinstance(document, Mapping) else {}
        about = {name: value for name, value in about.items() if isinstance(value, int | float)}
        return _table({**about, **_columns(records)}, source)
    if isinstance(document, Mapping):
        return _table(dict(_leaves(document)), source)
    raise source.refused("holds no columns of numbers.")


def _records(document: Any) -> list[Json] | None:
    """The longest list of records, or of rows under a list of names, in a document."""
    if isinstance(document, list):
        records = [record for record in document if isinstance(record, dict)]
        return records if any(len(record) > 1 for record in records) else None
    if not isinstance(document, Mapping):
        return None
    rows, sensors = document.get("values"), document.get("sensors")
    if isinstance(rows, list) and isinstance(sensors, list) and rows and isinstance(rows[0], list):
        columns = [sensor for sensor in sensors if isinstance(sensor, Mapping) and "name" in sensor]
        names = [column_title(column["name"], column.get("units")) for column in columns]
        return [dict(zip(names, row, strict=False)) for row in rows]
    lists = [records for value in document.values() if (records := _records(value))]
    return max(lists, key=len) if lists else None


def _leaves(value: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The values in nested objects, names joined by dots; a list of three or four numbers is a vector."""
    for name, item in value.items():
        if isinstance(item, Mapping):
            yield from _leaves(item, f"{prefix}{name}.")
        elif isinstance(item, list) and len(item) in (3, 4) and all(isinstance(v, int | float) for v in item):
            yield from ((f"{prefix}{name}.{axis}", v) for axis, v in zip("xyz" if len(item) == 3 else "wxyz", item))  # noqa: B905
        else:
            yield prefix + name, item


def _columns(records: list[Json]) -> dict[str, list[Any]]:
    flat = [dict(_leaves(record)) for record in records]
    names = dict.fromkeys(name for record in flat for name in record)
    return {name: [record.get(name) for record in flat] for name in names}


def _table(columns: Mapping[str, Any], source: Source) -> LogTable:
    """The columns as arrays: numbers also where they are written as text, times of day as stamps."""
    arrays: dict[str, Any] = {}
    for name, values in columns.items():
        if not isinstance(values, list):
            arrays[name] = values
            continue
        try:
            array = np.array([np.nan if value is None else value for value in values], dtype=object)
            numbers = array.astype(float)
            whole = all(isinstance(value, int) or (isinstance(value, str) and value.isdigit()) for value in array)
            arrays[name] = array.astype(np.int64) if whole else numbers
        except (TypeError, ValueError, OverflowError):
            kinds = set(map(type, values))
            if kinds == {str} and (stamps := seconds_of(np.array(values, dtype=object))) is not None:
                arrays[f"{name} [ns]"] = stamps
            elif kinds == {list} and len(set(map(np.shape, values))) == 1:
                arrays[name] = np.array(values, dtype=float)
    return table_of(arrays, source)


def _by_sensor(records: list[Json], source: Source) -> Iterator[LogTable]:
    """A table for each sensor that the records name."""
    tag = next((key for key in records[0] if key.lower() in _TAGS and isinstance(records[0][key], str)), None)
    if tag is None:
        return
    parts: dict[str, list[Json]] = {}
    for record in records:
        if (sensor := _sensor(record.get(tag, ""))) and len(record) > 3:
            parts.setdefault(sensor, []).append(record)
    android = str(records[0][tag]).startswith("android.sensor.")  # whose units are Android's, and stamps in ns
    for sensor, rows in parts.items():
        columns = _columns([{k: v for k, v in record.items() if k != tag} for record in rows])
        named = {}
        for name, values in columns.items():
            last = name.rpartition(".")[2].lower()
            title, unit = (f"{sensor}_{last}", _ANDROID[sensor]) if last in ("x", "y", "z") else (name, "")
            unit = "ns" if name == "timestamp" else unit
            named[column_title(title, unit if android else "")] = values
        table = _table(named, source)
        yield table.noted('units are those of Android\'s sensors, by "type" in each line.') if android else table


def of_sensor(table: LogTable, sensor: str) -> LogTable:
    """The time and one sensor's columns of a file that is called after it, named and with their units.

    Raises InputError where they are not there, or their unit is not known.
    """
    columns, wanted = header_columns(table) or (), (TIME, *GROUPS[sensor].columns)
    if "seconds_elapsed" in table.header:  # Sensor Logger's, in Android's units
        axes = {axis: Column(f"{sensor}_{axis}", _ANDROID[sensor]) for axis in "xyz"}
        columns = [axes.get(name, column) for name, column in zip(table.header, columns, strict=True)]
    if missing := set(wanted[1:]) - {column.name for column in columns}:
        raise table.refused(f"columns {', '.join(sorted(missing))} are missing; it has {table.header}.")
    places = {column.name: at for at, column in enumerate(columns)}
    kept = {name: columns[places[name]].unit for name in wanted if name in places}
    names = [column_title(name, unit) for name, unit in kept.items()]
    return replace(table, names=names, columns=[table.columns[places[name]] for name in kept])


def apart(table: LogTable) -> LogTable:
    """A table whose rows name their sensor, as columns x, y, z, with columns for each sensor; any other as it is."""
    for at, column in enumerate(table.columns):
        if column.dtype != object or len(tags := dict.fromkeys(column[:10000].tolist())) > 40:
            continue
        sensors = {tag: sensor for tag in tags if (sensor := _sensor(tag))}
        axes = {field.axis: index for index, field in enumerate(fields_of(table.header)) if not field.stem}
        if "accel" not in sensors.values() or not {"x", "y", "z"} <= set(axes):
            continue
        parts = []
        for tag, sensor in sensors.items():
            part, names = table.take(np.flatnonzero(column == tag)), [*table.header]
            for axis in "xyz":
                names[axes[axis]] = column_title(f"{sensor}_{axis}", parse_column(names[axes[axis]])[1])
            kept = [index for index in range(len(names)) if index != at and part.columns[index].dtype != object]
            columns = [part.columns[index] for index in kept]
            parts.append(replace(part, names=[names[index] for index in kept], rows=1, columns=columns))
        return _joined(parts).noted(f"each row is one sensor's, by {table.label(at)}.")
    return table


_COUNTED = {"i", "index"}
"""Names of columns that say which unit a row is of, or count something else: the rows show it."""
_DEVICE = set("id ids device devices dev sensor unit imu node serial sn mac address addr source instance".split())
"""Words of the names of columns that say which unit a row is of."""
_FEWEST, _MOST_DEVICES, _IN_TURN = 0.02, 64, 0.02
"""Share of the rows that a unit has at the least, number of units, and share of rows after which another one writes."""


def of_device(table: LogTable, device: str | None, usual: str | None = None) -> LogTable:
    """A table with the rows of one unit where a column names several that write in turn; any other as it is.

    usual: the unit to take where none is chosen and it is there. Raises `InputError` where none of them, or one that is
    not there, was chosen.
    """
    fields = fields_of(table.header)
    triads = {field.sensor for field in fields if field.axis} & SENSORS.keys()
    for at, field in enumerate(fields if triads else ()):
        words = set(words_of(table.header[at]))
        if field.canonical or not words or not words <= _DEVICE | _COUNTED or (field.axis and field.sensor):
            continue
        names = np.array(list(map(str, table.columns[at].tolist())))
        units, counts = np.unique(names, return_counts=True)
        in_turn = (names[1:] != names[:-1]).mean()
        if not 1 < len(units) <= _MOST_DEVICES or counts.min() < _FEWEST * len(names) or in_turn < _IN_TURN:
            continue
        if not _alike(table, [names == unit for unit in units]):  # rows of several sensors of one unit
            continue
        if words <= _COUNTED and _units_in_turn(table) != len(units):
            continue
        device = usual if device is None and usual in units else device
        if device is None:
            raise table.refused(
                f"its rows are of {len(units)} units, which write in turn, by column {table.label(at)}: "
                f"choose one of them, {', '.join(units[:8])}, with --device. {_all_of(table, units.tolist())}"
            )
        if device not in units:
            raise table.refused(f"--device {device}: column {table.label(at)} holds {', '.join(units[:8])}.")
        note = f"the rows are those of {device}, by column {table.label(at)}."
        return replace(table.take(np.flatnonzero(names == device)), device=device).noted(note)
    return _unnamed_device(table, device or usual)


def _all_of(table: LogTable, units: Sequence[str]) -> str:
    """Say which verb takes all units of a table."""
    names = f"{','.join(units[:8])}{',…' if len(units) > 8 else ''}"
    return f"`jaximu array {shlex.quote(table.path)} --device {shlex.quote(names)}` takes all, on one rigid body."


_ROWS, _PARTS, _FEWEST_A_PART, _MOST_IN_TURN = 20000, 20, 12, 6
"""Rows that are looked at, parts of them that must agree, a unit's rows in each, and units in turn at the most."""
_DISTINCT, _PLAIN, _AGREE = 5.0, 0.5, 2
"""Times its scatter from part to part, and of a sample's about its neighbours, that rows in turn must differ by;
columns that must agree."""


def _unnamed_device(table: LogTable, device: str | None) -> LogTable:
    """A table with the rows of one unit where several write in turn and no column says which; any other as it is."""
    count = _units_in_turn(table)
    units = list(map(str, range(1, count + 1)))
    if count == 1:
        if device is not None:
            raise table.refused(f"--device {device}: no column says which of several units a row is of.")
        return table
    if device not in units:
        raise table.refused(
            f"its rows are of {count} units, which write in turn, though no column says so: every "
            f"{_ORDINALS[count]} row is alike and its neighbours differ, all along. Choose one of them with --device "
            f"1 … --device {count} (as the first rows come). {_all_of(table, units)}"
        )
    taken = table.take(np.arange(int(device) - 1, len(table.columns[0]), count))
    return replace(taken, device=device).noted(f"the rows are those of unit {device} of {count} that write in turn.")


_ORDINALS = ("", "", "second", "third", "fourth", "fifth", "sixth")


def _units_in_turn(table: LogTable) -> int:
    """How many units write in turn: the least period with which rows differ from their neighbours.

    Biases of two units differ all along; whatever else swings as quickly drifts against the rows.
    """
    columns = []
    for at, field in enumerate(fields_of(table.header)):
        if not table.names or field.sensor in SENSORS:
            with suppress(InputError):
                values = np.asarray(table.numbers(at)[:_ROWS], float)
                if np.isfinite(values).all() and not rises(values):
                    columns.append(values)
    rows = min(map(len, columns), default=0)
    for count in range(2, min(_MOST_IN_TURN, rows // (_PARTS * _FEWEST_A_PART)) + 1):
        if sum(_differ_in_turn(values, count) for values in columns) >= _AGREE:
            return count
    return 1


def _differ_in_turn(values: np.ndarray, count: int) -> bool:
    """Whether every `count`th value (n,) is off the mean of those around it by as much, all along."""
    around = np.ones(count) if count % 2 else np.concatenate([[0.5], np.ones(count - 1), [0.5]])
    off = values - np.convolve(values, around / around.sum(), "same")
    size = len(off) // (_PARTS * count) * count
    parts = off[count : count + (_PARTS - 1) * size].reshape(_PARTS - 1, -1, count)
    fourth = parts.shape[1] // 4
    pattern = np.sort(parts, axis=1)[:, fourth : parts.shape[1] - fourth].mean(axis=1)
    middle = np.median(pattern, axis=0)
    scatter, usual = robust_sigma(pattern - middle, axis=0).max(), robust_sigma(parts - pattern[:, None])
    apart = np.ptp(middle)  # rows that repeat themselves to the last digit were made
    return bool(apart > max(_DISTINCT * scatter, _PLAIN * usual) and scatter > 1e-9 * apart)


def _alike(table: LogTable, groups: Sequence[np.ndarray]) -> bool:
    """Whether the same columns are filled in the rows of each group."""
    filled = [~np.isnan(column) for column in table.columns if column.dtype.kind == "f"]
    shares = [[column[group].mean() for group in groups] for column in filled]
    return all(max(share) <= 2 * min(share) + 0.1 for share in shares)


def _sensor(tag: Any) -> str | None:
    """The sensor of three axes that a row's tag names."""
    return sensor if (sensor := sensor_of(tuple(words_of(str(tag))))[0]) in SENSORS else None


def _joined(tables: list[LogTable]) -> LogTable:
    """The sensors' tables as one, in the order of their stamps."""
    first = tables[0]
    if len(tables) == 1:
        return first
    held = [dict(zip(table.header, table.columns, strict=True)) for table in tables]
    names = list(dict.fromkeys(name for part in held for name in part))
    clock = next((name for name in names if all(name in part and rises(part[name]) for part in held)), None)
    if clock is None:
        raise first.refused("the rows of its sensors share no column of time.")
    stamps = np.unique(np.concatenate([part[clock] for part in held]))
    columns = {name: np.full(len(stamps), np.nan) for name in names}
    for part in held:
        places = np.searchsorted(stamps, part[clock])
        for name, values in part.items():
            columns[name][places] = values
    columns[clock] = stamps
    return LogTable(replace(first.source, rows=len(stamps)), names, [*columns.values()], notes=first.notes)
