"""Named arrays (NPZ, MAT, HDF5) as one table: what the formats that store variables rather than rows share."""

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from jaximu.errors import InputError
from jaximu.formats.table import Table
from jaximu.recording import Source
from jaximu.units import parse_column

_WIDEST = 16  # an array with more columns than this is no sensor
_RATES = {"sampling_rate", "sample_rate", "samplerate", "rate", "fs", "frequency"}
SUFFIXES = {3: ("x", "y", "z"), 4: ("w", "x", "y", "z")}
"""Axis names of n × 3 and n × 4 arrays."""


def table_of(variables: Mapping[str, Any], source: Source) -> Table:
    """The columns among named variables: n values, n × k or k × n, n being the length that most of them have.

    Mappings in it are opened (names joined by a dot); a mapping `units` {name: unit} gives units to names without
    brackets; a scalar named like a sampling rate is the rate in Hz. Raises InputError where nothing is a column.
    """
    units = variables.get("units")
    stated = {name: str(text) for name, text in units.items()} if isinstance(units, Mapping) else {}
    arrays: list[tuple[str, np.ndarray]] = []
    rate = None
    for name, value in _opened(variables):
        array = np.asarray(value)
        if array.size == 1 and parse_column(name)[0].lower().rpartition(".")[2] in _RATES:
            rate = float(array.reshape(()))
        elif array.ndim <= 2 and array.size > 1 and array.dtype.kind in "iufb":
            arrays.append((name, array))
    if not arrays:
        raise InputError(f"{source.path}: holds no columns of numbers.")
    rows = Counter(max(array.shape) for _, array in arrays).most_common(1)[0][0]
    names: list[str] = []
    columns: list[np.ndarray] = []
    for name, array in arrays:
        array = array.reshape(-1, 1) if array.ndim == 1 or 1 in array.shape else array
        array = array.T if array.shape[0] != rows and array.shape[-1] == rows else array
        if array.shape[0] != rows or array.shape[1] > _WIDEST:
            continue
        base, unit = parse_column(name)
        unit = unit or stated.get(base)
        count = array.shape[1]
        axes = SUFFIXES.get(count, tuple(map(str, range(count))))
        for axis, column in zip(axes, array.T, strict=True):
            title = base if count == 1 else f"{base}_{axis}"
            names.append(f"{title} [{unit}]" if unit else title)
            columns.append(np.ascontiguousarray(column, np.float64 if column.dtype.kind == "f" else np.int64))
    return Table(source, tuple(names), tuple(columns), rate=rate)


def _opened(variables: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in variables.items():
        if name.startswith("__") or (name == "units" and isinstance(value, Mapping)):
            continue
        if isinstance(value, Mapping):
            yield from _opened(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
