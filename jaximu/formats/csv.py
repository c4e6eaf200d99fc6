"""Delimited text: CSV, TSV, semicolons, and columns separated by blanks; with or without a preamble and a header."""

import csv
import re
from collections import Counter
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc

from jaximu.errors import InputError
from jaximu.formats.table import Table, from_arrow, named_with_units, parse_name
from jaximu.recording import Source

_CONTROL = bytes(set(range(32)) - set(b"\t\n\r\f"))
_LOOKED_AT = 200  # lines in which the layout is looked for
_SINGLE_BLOCK = 2**31 - 2


@dataclass(frozen=True)
class _Layout:
    delimiter: str
    names: tuple[str, ...] | None
    width: int
    first: int  # index of the first line of data


def read(data: bytes, source: Source) -> Table:
    """The table in a text file. Raises InputError for what is not a table of numbers, naming the row where it can."""
    if len(data) != len(data.translate(None, _CONTROL)):
        raise InputError(
            f"{source.path}: holds binary data of no known format; expected CSV, TSV, blank-separated text, "
            "Parquet, NPZ or MAT."
        )
    data = data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    layout = _layout(data, source.path)
    body, rows = _body(data, layout)
    try:
        table = _parse(body, layout, block=1 << 20)
    except pa.ArrowInvalid:
        # The type of a column is guessed from the first block: guess again from the whole.
        try:
            table = _parse(body, layout, block=min(len(body) + 1, _SINGLE_BLOCK))
        except pa.ArrowInvalid as error:
            raise _bad_row(body, layout, rows, source.path) or InputError(
                f"{source.path}: cannot be read as a table: {str(error).splitlines()[0][:200]}"
            ) from None
    columns = tuple(from_arrow(column) for column in table.columns)
    names = layout.names or None
    if names:  # a column of dates states its own unit
        typed = named_with_units(table.schema)
        names = tuple(
            f"{name} [{each.rpartition('[')[2]}" if each.endswith("]") and "[" not in name else name
            for name, each in zip(names, typed, strict=True)
        )
    return Table(source, names, columns, rows)


def _text(line: bytes) -> str:
    """Header text; a file that is not UTF-8 is taken for Latin-1, which has the signs ° ² µ."""
    try:
        return line.decode()
    except UnicodeDecodeError:
        return line.decode("latin-1")


def _cells(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":  # a blank before a bracket belongs to the name
        return re.split(r"\s+(?![\[(])", line.strip())
    return next(csv.reader([line], delimiter=delimiter), [])


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _layout(data: bytes, path: str) -> _Layout:
    """Delimiter, header and first line of data, from the first lines: data is what most lines look like."""
    raw = data[: 1 << 18].split(b"\n", _LOOKED_AT)
    lines = [_text(line) for line in raw[:_LOOKED_AT]]
    filled = [(at, line) for at, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")]
    if not filled:
        raise InputError(f"{path}: holds no data.")
    best: tuple[int, str, int] | None = None
    for delimiter in "\t,; ":
        split = [_cells(line, delimiter) for _, line in filled]
        widths = Counter(len(cells) for cells in split if any(map(_is_number, cells)))
        width, lines_of_it = max(widths.items(), key=lambda item: (item[1] * (item[0] > 1), item[0]), default=(0, 0))
        if width > 1 and (best is None or lines_of_it > best[0]):
            best = lines_of_it, delimiter, width
    if best is None:
        only = "a header but no rows of data" if len(filled) < 3 else "no table of numbers"
        raise InputError(f"{path}: holds {only}.")
    _, delimiter, width = best
    names = None
    for at, line in filled:
        cells = _cells(line, delimiter)
        numbers = sum(map(_is_number, cells))
        if len(cells) != width and not names and not 1 < numbers == len(cells):
            continue  # preamble; but a short row of numbers, or any after the header, is data that parsing will refuse
        if numbers or (names and len(cells) != width):
            return _Layout(delimiter, names or _commented_header(lines[:at], delimiter, width), width, at)
        names = tuple(map(parse_name, cells))
    raise AssertionError("a width is that of some line of numbers")


def _commented_header(lines: list[str], delimiter: str, width: int) -> tuple[str, ...] | None:
    """A header behind a comment sign: the last comment before the data, if it has as many cells."""
    comments = [line.lstrip(" #") for line in lines if line.lstrip().startswith("#")]
    cells = _cells(comments[-1], delimiter) if comments else []
    return tuple(map(parse_name, cells)) if len(cells) == width else None


def _body(data: bytes, layout: _Layout) -> tuple[bytes, np.ndarray | int]:
    """The lines of data alone, single-blank separated where blanks separate, and the line number of each row."""
    start = 0
    for _ in range(layout.first):
        start = data.index(b"\n", start) + 1
    body = data[start:]
    rows: np.ndarray | int = layout.first + 1
    if b"#" in body or re.search(rb"\n\s*\n", body.rstrip()):
        lines = body.split(b"\n")
        kept = [at for at, line in enumerate(lines) if line.strip() and not line.lstrip().startswith(b"#")]
        body, rows = b"\n".join(lines[at] for at in kept), np.array(kept) + layout.first + 1
    if layout.delimiter == " ":
        body = body.replace(b"\t", b" ")
        while b"  " in body:
            body = body.replace(b"  ", b" ")
        body = body.replace(b"\n ", b"\n").replace(b" \n", b"\n").strip(b" ")
    return body, rows


def _parse(body: bytes, layout: _Layout, block: int) -> pa.Table:
    return pc.read_csv(
        pa.BufferReader(body),
        read_options=pc.ReadOptions(
            column_names=[f"c{at}" for at in range(layout.width)], block_size=block, use_threads=block <= 1 << 20
        ),
        parse_options=pc.ParseOptions(delimiter=layout.delimiter),
        convert_options=pc.ConvertOptions(strings_can_be_null=True),
    )


def _bad_row(body: bytes, layout: _Layout, rows: np.ndarray | int, path: str) -> InputError | None:
    """The first row with another number of cells than the rest."""
    lines = body.rstrip(b"\n").split(b"\n")
    for at, line in enumerate(lines):
        cells = len(_cells(_text(line), layout.delimiter))
        if cells != layout.width:
            row = rows + at if isinstance(rows, int) else rows[at]
            last = "; it is the last one: the file is cut off, delete that row" if at == len(lines) - 1 else ""
            return InputError(f"{path}, row {row}: holds {cells} cells where the others hold {layout.width}{last}.")
    return None
