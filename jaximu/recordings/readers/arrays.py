"""Named arrays (NPZ, MAT, HDF5) as one table: what the formats that store variables rather than rows share."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from jaximu.ground.quantities import listed
from jaximu.ground.units import SENSORS, column_title, parse_column
from jaximu.recordings.columns.habits import Field, sensor_of, words_of
from jaximu.recordings.columns.names import TIME
from jaximu.recordings.columns.table import LogTable
from jaximu.recordings.recording import Source

_WIDEST = 16  # an array with more columns than this is no sensor
_RATES = set("samplingrate samplerate rate fs frequency freq samplingfrequency odr".split())
_INTERVALS = dict.fromkeys(("ts", "dt", "sampletime", "sampleinterval", "samplinginterval"), 1.0) | {"intervalms": 1e3}
_AXES = {3: ("x", "y", "z"), 4: ("w", "x", "y", "z")}


def table_of(variables: Mapping[str, Any], source: Source) -> LogTable:
    """The columns among named variables: n values, n × k or k × n, n being the length that most numbers have.

    Mappings in it are opened (names joined by a dot); a mapping `units` {name: unit} gives units to names without
    brackets; a scalar named like a sampling rate is the rate in Hz. Raises InputError where nothing is a column.
    """
    units = variables.get("units")
    stated = {name: str(text) for name, text in units.items()} if isinstance(units, Mapping) else {}
    arrays: list[tuple[str, np.ndarray]] = []
    rate = None
    for name, value in _opened(variables):
        array = np.asarray(value)
        last = re.sub(r"[ _-]", "", parse_column(name)[0].lower().rpartition(".")[2])
        if array.size == 1 and array.dtype.kind in "iuf" and (last in _RATES or last in _INTERVALS):
            number = float(array.reshape(()))
            if number > 0:
                rate = rate or (number if last in _RATES else _INTERVALS[last] / number)
        elif array.ndim <= 2 and array.size > 1 and array.dtype.kind in "iufb":
            arrays.append((name, array))
    if not arrays:
        raise source.refused("holds no columns of numbers.")
    sizes: Counter[int] = Counter()
    for _, array in arrays:  # parameters are many and short, the samples are where the numbers are
        sizes[max(array.shape)] += array.size
    clocks = _own_clocks(arrays)
    rows = clocks["accel"][1].size if clocks else sizes.most_common(1)[0][0]
    names = []
    columns = []
    unused = []
    for name, array in arrays:
        array = array.reshape(-1, 1) if array.ndim == 1 or 1 in array.shape else array
        base, unit = parse_column(name)
        sensor = _triad(name, array)
        title, stamps = clocks.get(sensor or "", ("", None))
        size = rows if stamps is None else stamps.size
        array = array.T if array.shape[0] != size and array.shape[-1] == size else array
        if array.shape[0] != size or array.shape[1] > _WIDEST:
            if sensor:
                unused.append(f"{base!r} has {max(array.shape)}")
            continue
        if stamps is not None:
            names.append(column_title(f"{sensor}_time", parse_column(title)[1] or stated.get(title)))
            columns.append(stamps)
        elif clocks and Field.of(name).sensor == TIME:
            continue
        unit = unit or stated.get(base)
        count = array.shape[1]
        axes = _AXES.get(count, tuple(map(str, range(count))))
        for axis, column in zip(axes, array.T, strict=True):
            names.append(column_title(base if count == 1 else f"{base}_{axis}", unit))
            columns.append(np.ascontiguousarray(column, np.float64 if column.dtype.kind == "f" else np.int64))
    longest = max(map(len, columns))
    columns = [
        column if len(column) == longest else np.concatenate([column, np.full(longest - len(column), np.nan)])
        for column in columns
    ]
    table = LogTable(source, names, columns, rate=rate)
    advice = "A sensor with its own clock needs its stamps beside it, as many as its samples (gyro_time)."
    return table.noted(f"not used: {listed(unused)} rows where others have {rows}. {advice}") if unused else table


def _triad(name: str, array: np.ndarray) -> str | None:
    """The sensor whose three axes an array holds, by its name."""
    sensor = sensor_of(tuple(words_of(parse_column(name)[0])))[0] if 3 in array.shape else None
    return sensor if sensor in SENSORS else None


def _own_clocks(arrays: Sequence[tuple[str, np.ndarray]]) -> dict[str, tuple[str, np.ndarray]]:
    """By sensor, name and values of the stamps that are as many as its samples; none where all have equally many.

    Of one clock with the accelerometer's: sensors whose stamps do not overlap with those are left out.
    """
    counts = {sensor: max(array.shape) for name, array in arrays if (sensor := _triad(name, array))}
    times = {array.size: (name, array.ravel()) for name, array in arrays if Field.of(name).sensor == TIME}
    clocks = {sensor: times[count] for sensor, count in counts.items() if count in times}
    if "accel" not in clocks or len(set(counts.values())) == 1:
        return {}
    first, last = clocks["accel"][1][[0, -1]]
    return {sensor: clock for sensor, clock in clocks.items() if clock[1][0] < last and clock[1][-1] > first}


def _opened(variables: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The arrays in mappings, in lists of mappings (by their `label`), and in the fields of records."""
    for name, value in variables.items():
        if name.startswith("__") or (name == "units" and isinstance(value, Mapping)):
            continue
        if isinstance(value, list) and value and all(isinstance(entry, Mapping) for entry in value):
            value = {str(entry.get("label") or entry.get("name") or at): entry for at, entry in enumerate(value)}
        fields = getattr(getattr(value, "dtype", None), "names", None)
        if fields:
            value = {field: value[field] for field in fields}
        if isinstance(value, Mapping):
            label = value.get("label")  # a signal that Simulink logged
            name = str(label) if isinstance(label, str) and label else name
            yield from _opened(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
