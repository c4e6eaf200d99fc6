"""The intermediate of all readers: columns as the file has them, before names, units and sensors are understood."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pyarrow as pa

from jaximu.ground.array_types import BoolArray, FloatArray
from jaximu.ground.errors import InputError
from jaximu.ground.quantities import counted
from jaximu.ground.units import column_title, parse_column
from jaximu.recordings.recording import Source

HEAD = 1 << 18
"""Bytes in which a format shows."""
UNPACKED, RATIO = 128 << 20, 200
"""A compressed file may unpack to so many bytes, or to so many times its own size: no recording compresses better."""
AXES = b"jaximu.axes"
"""Key of Arrow's metadata: the map by which a writer has put a log in body axes."""
FEW = 0.01
"""Share of the rows up to which one that holds no whole sample costs itself, and not the recording."""
_MISSING = set("- -- --- * ? none err error missing overflow ovf inv invalid".split())
"""Words that programs write for a reading that is not there, beside those that Arrow knows."""
_LARGEST = 1e30  # beyond it no unit makes a reading, and squares overflow
_NINES = re.compile(r"9[9.]{2,}")
"""Numbers such as 999 and 9999.99, which programs write for a reading that is not there."""


@dataclass(frozen=True)
class LogTable:
    """A file's columns.

    names: the header, with units in brackets where the file states them; None where it has no header.
    columns: equally long arrays, one a column; int64 or float64 with NaN for an empty cell, or object for text cells.
    rows: number that each row has in the file (in text its line), or that of the first one if they are consecutive.
    rate: sample rate in Hz where the file states one beside its columns.
    notes: sentences about what reading it had to choose or assume.
    messages: whether the rows are messages as they came in, in which repeats and small disorder are no defect of the
        file. In a table of samples rows out of order and repeated ones are put right, too; the clock is one clock.
    frame: "FRD" where the format defines its axes as an autopilot's. axes: the map that its writer has applied already.
    device: whose rows these are, where several units wrote into the file.
    corrected, sensors: as `Reading` has them.
    """

    source: Source
    names: Sequence[str] | None
    columns: Sequence[np.ndarray]
    rows: np.ndarray | int = 1
    rate: float | None = None
    notes: tuple[str, ...] = ()
    messages: bool = False
    frame: str | None = None
    axes: str | None = None
    device: str | None = None
    corrected: bool | None = None
    sensors: Mapping[str, int] = field(default_factory=dict)

    @property
    def path(self) -> str:
        return self.source.path

    @property
    def header(self) -> tuple[str, ...]:
        """The names in the file, a text a column: empty ones where it has no header."""
        return tuple(self.names or ("",) * len(self.columns))

    def row(self, index: int | np.integer) -> int:
        """The number in the file, 1-based, of the row at `index`."""
        return self.rows + int(index) if isinstance(self.rows, int) else int(self.rows[index])

    def refused(self, why: str) -> InputError:
        """What is raised where the file cannot be used, and why."""
        return self.source.refused(why)

    def where(self, index: int | np.integer) -> str:
        """The file and the number of a row, for messages."""
        return f"{self.path}, row {self.row(index)}"

    def take(self, kept: np.ndarray) -> "LogTable":
        """The rows of these indices."""
        rows = np.arange(self.source.rows) + self.rows if isinstance(self.rows, int) else self.rows
        columns = [column[kept] for column in self.columns]
        return replace(self, columns=columns, rows=rows[kept], source=replace(self.source, rows=len(kept)))

    def with_column(self, index: int, values: np.ndarray) -> "LogTable":
        """The table with other values in one column."""
        return replace(self, columns=(*self.columns[:index], values, *self.columns[index + 1 :]))

    def noted(self, *notes: str) -> "LogTable":
        """The table with more notes."""
        return replace(self, notes=(*self.notes, *notes))

    def without_markers(self) -> "LogTable":
        """The table without the number, such as −9999, that stands for a missing reading on several axes at once."""
        marks: dict[float, dict[int, BoolArray]] = {}
        for index, column in enumerate(self.columns):
            if column.dtype.kind in "fi":
                largest = np.nanmax(np.abs(column), initial=0.0)
                if _NINES.fullmatch(f"{largest:.10g}"):
                    marked = np.abs(column) == largest
                    marks.setdefault(float(column[np.argmax(marked)]), {})[index] = marked
        table = self
        for mark, where in marks.items():
            together = np.all(list(where.values()), axis=0)
            if len(where) > 2 < together.sum() and all(np.array_equal(marked, together) for marked in where.values()):
                for index, marked in where.items():
                    table = table.with_column(index, np.where(marked, np.nan, self.columns[index]))
                rows, columns = counted(int(together.sum()), "row"), counted(len(where), "column")
                table = table.noted(
                    f"{rows} hold {mark:.6g} in {columns}, first row {self.row(np.argmax(together))}: it stands for a "
                    "missing reading. They are left out."
                )
        return table

    def label(self, index: int) -> str:
        """The column's name in the file, or its 1-based number."""
        name = parse_name(self.header[index])
        return repr(name) if name else f"number {index + 1}"

    def numbers(self, index: int) -> np.ndarray:
        """The column as int64 or float64 (NaN where empty).

        Of readings that are infinite, or larger than any is, a few count as empty. Raises InputError for more of them,
        and for a cell that is neither a number nor a word for a missing one.
        """
        column = self.columns[index]
        if column.dtype == object:
            column = self._parse(index)
        if column.dtype.kind == "f" and (absurd := np.abs(column) > _LARGEST).any():
            if absurd.mean() <= FEW:
                return np.where(absurd, np.nan, column)
            raise InputError(
                f"{self.where(np.argmax(absurd))}: column {self.label(index)} is infinite, or too large for a reading."
            )
        return column

    def _parse(self, index: int) -> FloatArray:
        values = np.empty(len(self.columns[index]))
        for at, cell in enumerate(self.columns[index]):
            try:
                values[at] = np.nan if cell is None or str(cell).strip().lower() in _MISSING else float(cell)
            except (TypeError, ValueError):
                text = repr((cell.decode(errors="replace") if isinstance(cell, bytes) else str(cell))[:40])
                raise InputError(
                    f"{self.where(at)}: column {self.label(index)} holds {text}, which is not a number."
                ) from None
        return values


class Unpacking:
    """What is left of the bytes that a compressed file may unpack to, `UNPACKED` or `RATIO` times its own."""

    def __init__(self, source: Source, packed: int):
        self.source, self.packed = source, packed
        self.left = max(UNPACKED, RATIO * packed)

    def take(self, size: int) -> None:
        """Count `size` bytes. Raises InputError, before the memory is taken, where they are more than are left."""
        if size > self.left:
            raise InputError(
                f"{self.source.path}: unpacks to {max(UNPACKED, RATIO * self.packed) / 1e6:.3g} MB and more from its "
                f"{self.packed / 1e6:.3g} MB, as no recording does."
            )
        self.left -= size

    def unpack(self, decompressor: Any, data: bytes) -> bytes:
        """The data unpacked by a decompressor of zlib, bz2, lz4 or zstd. Raises ValueError where its end is missing."""
        unpacked = decompressor.decompress(data, self.left + 1)
        self.take(len(unpacked))
        if not decompressor.eof:
            raise ValueError("a compressed part is cut off")
        return unpacked


def parse_name(text: str) -> str:
    """A header cell without stray blanks and quotes."""
    return " ".join(text.strip().strip('"').split())


def from_arrow(column: pa.ChunkedArray) -> np.ndarray:
    """An Arrow column as int64 or float64 with NaN for null, or as objects.

    Past Arrow's own conversion, which imports pandas where that is installed, 0.2 s.
    """
    kind: Any = column.type
    if pa.types.is_dictionary(kind):
        return np.concatenate([np.empty(0, object), *map(_looked_up, column.chunks)])
    if pa.types.is_timestamp(kind) or pa.types.is_integer(kind):
        wanted = pa.int64()
    elif pa.types.is_floating(kind) or pa.types.is_decimal(kind) or pa.types.is_null(kind):
        wanted = pa.float64()
    else:
        return np.array(column.to_pylist(), dtype=object)
    column = column if kind == wanted else column.cast(wanted)
    if column.null_count:
        column = column.cast(pa.float64(), safe=False).fill_null(np.nan)
    parts = [np.from_dlpack(chunk) for chunk in column.chunks if len(chunk)]
    return np.concatenate(parts) if parts else np.empty(0, wanted.to_pandas_dtype())


def vectors_apart(table: pa.Table) -> pa.Table:
    """The table without nested columns, but with x, y, z in place of each whose cells are lists of three numbers."""
    for at, (name, cells) in reversed([*enumerate(zip(table.column_names, table.columns, strict=True))]):
        kind: Any = cells.type
        if not pa.types.is_nested(kind):
            continue
        table = table.remove_column(at)
        listed = pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
        if not listed or pa.types.is_nested(kind.value_type) or cells.null_count or not len(cells):
            continue
        from pyarrow import compute  # loaded by these files alone

        numbers = from_arrow(pa.chunked_array([chunk.flatten() for chunk in cells.chunks]))
        sizes = set(compute.call_function("list_value_length", [cells]).unique().to_pylist())
        if sizes == {len("xyz")} and numbers.dtype != object:
            title, unit = parse_column(name)
            for axis, values in zip("zyx", numbers.reshape(-1, len("xyz")).T[::-1], strict=True):
                table = table.add_column(at, column_title(f"{title}_{axis}", unit), to_arrow(values))
    return table


def to_arrow(values: np.ndarray, nulls: bool = True) -> pa.Array:
    """Numbers (n,) of eight bytes as an Arrow column, NaN as null if `nulls`; past Arrow's own way, as `from_arrow`."""
    values = np.ascontiguousarray(values)
    kind, missing = pa.from_numpy_dtype(values.dtype), np.isnan(values)
    valid = pa.py_buffer(np.packbits(~missing, bitorder="little")) if nulls and missing.any() else None
    return pa.Array.from_buffers(kind, len(values), [valid, pa.py_buffer(values)])


def _looked_up(chunk: Any) -> np.ndarray:
    """Texts that are stored once are held once."""
    words = np.array([*chunk.dictionary.to_pylist(), None], dtype=object)
    places = from_arrow(pa.chunked_array([chunk.indices]))
    return words[np.where(np.isnan(places), len(words) - 1, places).astype(np.int64)]


def named_with_units(fields: Sequence[Any]) -> tuple[str, ...]:
    """Arrow field names; a time-stamp type states its own unit."""
    return tuple(
        f"{field.name} [{field.type.unit}]" if pa.types.is_timestamp(field.type) else field.name for field in fields
    )


def mapped_axes(schema: pa.Schema) -> str | None:
    """The map by which the writer of an Arrow table has put it in body axes, as its metadata say."""
    axes = (schema.metadata or {}).get(AXES)
    return None if axes is None else axes.decode()
