"""Delimited text: CSV, TSV, semicolons, and columns separated by blanks; with or without a preamble and a header."""

import csv
import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate, pairwise
from os import SEEK_END
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc

from jaximu.ground.errors import InputError
from jaximu.ground.quantities import counted
from jaximu.ground.units import column_title, find_unit, parse_column
from jaximu.recordings.columns.habits import fields_of, sensor_of, stated_rate, words_of
from jaximu.recordings.columns.table import HEAD, LogTable, from_arrow, parse_name
from jaximu.recordings.readers.clock import DAY, measured, seconds_of
from jaximu.recordings.recording import Source

_CONTROL = bytes(set(range(32)) - set(b"\t\n\r\f"))
_PIECE = 1 << 22  # bytes parsed at once
_LOOKED_AT = 200  # lines in which the layout is looked for
_CUT_OFF = "the file ends in zero bytes, as after a power loss: its last row is left out."
_NUMBER = r"\s*([-+]?\d*\.?\d+(?:[eE][-+]?\d+)?)\s*"
_VECTOR = re.compile(rf"[\[(]{_NUMBER}[,; ]{_NUMBER}[,; ]{_NUMBER}[\])]|{_NUMBER}\|{_NUMBER}\|{_NUMBER}")
_SINGLE_BLOCK = 2**31 - 2
_QUOTED, _FEW_NOTES = 60, 5


@dataclass(frozen=True)
class _Layout:
    delimiter: str
    names: tuple[str, ...] | None
    width: int
    first: int  # index of the first line of data
    decimal: str = "."
    rate: float | None = None  # Hz, where the lines before the data state it
    remarks: tuple[str, ...] = ()


def read(path: Path, source: Source) -> LogTable:
    """The table in a text file. Raises InputError for what is not a table of numbers, naming the row where it can."""
    with path.open("rb") as file:
        head = file.read(HEAD)
    wide = head[:2] in (b"\xff\xfe", b"\xfe\xff")  # UTF-16, as Excel's "Unicode text"
    if wide:
        with suppress(UnicodeDecodeError):
            head = path.read_bytes().decode("utf-16").encode()
    whole = head if wide else _without_zeros(path)  # None where the file stands as it is read
    head = head if wide or whole is None else whole[:HEAD]
    if len(head) != len(head.translate(None, _CONTROL)):
        raise source.refused(
            "holds binary data of no known format; expected CSV, TSV, blank-separated text, Parquet, NPZ or MAT."
        )
    layout = _layout(_lines(head), source.path)
    if grouping := _grouping(_lines(head), layout):
        layout = replace(layout, decimal=".,".replace(grouping, ""))
        whole = _ungrouped(_lines(path.read_bytes() if whole is None else whole), layout, grouping.encode())
    rows: np.ndarray | int = layout.first + 1
    remarks = layout.remarks
    parsed = _read_straight(path, layout) if whole is None and layout.delimiter != " " else None
    if parsed is None:
        data = _lines(path.read_bytes() if whole is None else whole)
        table, rows, more = _read_cleaned(data, layout, source.path)
        remarks += more
        parsed = [from_arrow(column) for column in table.columns], table.schema
    columns, schema = parsed
    names = [  # a column of dates states its own unit
        f"{name} [{kind.type.unit}]" if pa.types.is_timestamp(kind.type) and "[" not in name else name
        for name, kind in zip(layout.names or [""] * len(columns), schema, strict=True)
    ]
    if layout.names:
        names, columns = _vectors_apart(names, columns)
    midnight = 0
    for at, column in enumerate(columns):
        if column.dtype != object:
            continue
        unit = ""
        if at == len(columns) - 1 and str(columns[0][0]).startswith("$"):
            columns[at] = np.array([str(cell).partition("*")[0] for cell in column], object)  # NMEA's checksum
        elif all(str(cell).endswith(";") for cell in column):
            columns[at] = np.array([cell[:-1] for cell in column], object)
        elif (stamps := seconds_of(column)) is not None:
            columns[at], unit = stamps, "ns"
            midnight = int((np.diff(stamps // DAY, prepend=stamps[:1] // DAY) > 0).argmax())
        elif with_unit := measured(column, layout.decimal):
            columns[at], unit = with_unit
        if unit:
            names[at] = f"{parse_column(names[at])[0]} [{unit}]"
    table = LogTable(source, names if layout.names else None, columns, rows, layout.rate, remarks)
    if not (wide or whole is None):
        table = table.noted(_CUT_OFF)
    if midnight:
        table = table.noted(f"the time of day passes midnight (row {table.row(midnight)}): it goes on from there.")
    return table


def _vectors_apart(names: Sequence[str], columns: Sequence[np.ndarray]) -> tuple[list[str], list[np.ndarray]]:
    """The columns, with x, y and z of their own where each cell holds three numbers, in brackets or with bars."""
    titles = []
    parts = []
    for name, column in zip(names, columns, strict=True):
        vector = column.dtype == object and _VECTOR.fullmatch(str(column[0]))
        matches = [_VECTOR.fullmatch(str(cell)) for cell in column] if vector else [None]
        if not all(matches):
            titles, parts = [*titles, name], [*parts, column]
            continue
        title, unit = parse_column(name)
        titles += [column_title(f"{title}.{axis}", unit) for axis in "xyz"]
        parts += [*np.array([[number for number in match.groups() if number] for match in matches if match], float).T]
    return titles, parts


def _without_zeros(path: Path) -> bytes | None:
    """The whole rows of a file that ends in zero bytes, which an interrupted write leaves; None for any other."""
    with path.open("rb") as file:
        file.seek(max(0, file.seek(0, SEEK_END) - 1))
        if file.read(1) != b"\0":
            return None
    data = path.read_bytes().rstrip(b"\0")
    return data[: data.rfind(b"\n") + 1]


def _lines(data: bytes) -> bytes:
    """Text without a byte order mark, its lines ended by line feeds."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    return data.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in data else data


def _grouping(head: bytes, layout: _Layout) -> str:
    """The sign that groups thousands, as in "1,234.5" or 1.234,5; "" where none does.

    Every cell that holds it is grouped so, and the same column has numbers without it.
    """
    text = _text(b"\n".join(head.split(b"\n")[layout.first : -1]))
    if layout.delimiter == "," and '"' not in text:
        return ""
    for sign, decimal in (",.", ".,"):
        if sign in text and (sign == "," or decimal in text):
            grouped = re.compile(rf"\s*[-+]?[1-9]\d{{0,2}}(\{sign}\d{{3}})+(\{decimal}\d+)?\s*")
            rows = [_cells(line, layout.delimiter) for line in text.split("\n")]
            holding = [[cell for cell in column if sign in cell] for column in zip(*rows, strict=False)]
            mixed = any(0 < len(cells) < len(rows) for cells in holding)
            if mixed and all(grouped.fullmatch(cell) for cells in holding for cell in cells):
                return sign
    return ""


def _ungrouped(data: bytes, layout: _Layout, sign: bytes) -> bytes:
    """The text without the sign that groups thousands in its rows of data."""
    above = data.split(b"\n", layout.first)
    below = above.pop()
    if layout.delimiter.encode() == sign:
        return b"\n".join([*above, re.sub(rb'"[^"\n]*"', lambda cell: cell[0].replace(sign, b""), below)])
    return b"\n".join([*above, below.replace(sign, b"")])


def _read_straight(path: Path, layout: _Layout) -> tuple[list[np.ndarray], pa.Schema] | None:
    """The columns and their types, parsed piece by piece as the file stands, so that little text is held.

    None where lines are empty, are comments, or have cells of another type than others.
    """
    parts: list[list[np.ndarray]] = []
    schemas = []
    with suppress(pa.ArrowInvalid), path.open("rb") as file:
        above = [file.readline().strip() for _ in range(layout.first)]
        while piece := file.read(_PIECE):
            table = _parse(piece + file.readline(), layout, 1 << 20)
            schemas.append(table.schema)
            parts.append([from_arrow(column) for column in table.columns])
        fields = [_common(kinds) for kinds in zip(*schemas, strict=True)]
        texts = any(pa.types.is_string(schema_field.type) for schema_field in fields if schema_field)
        if fields and all(fields) and not (texts and _interrupted(path, above)):
            # one after the other, so that a long file is not held twice
            columns = [np.concatenate([part.pop(0) for part in parts]) for _ in fields]
            return columns, pa.schema([schema_field for schema_field in fields if schema_field])
    return None


def _common(fields: Sequence[pa.Field]) -> pa.Field | None:
    """The field whose type a column's pieces share, all numbers being alike; None for more than one."""
    filled = [kind for kind in fields if not pa.types.is_null(kind.type)] or [*fields]
    numbers = [pa.types.is_integer(kind.type) or pa.types.is_floating(kind.type) for kind in filled]
    return filled[0] if all(numbers) or all(kind.type == filled[0].type for kind in filled) else None


def _interrupted(path: Path, above: Sequence[bytes]) -> bool:
    """Whether comments, or a line from above the data once more, may stand between its rows."""
    with path.open("rb") as file:
        blocks = iter(partial(file.read, HEAD), b"")
        marks = [mark.encode() for mark in _MARKS]
        counts = np.array([[*map(block.count, marks), block.count(above[-1] if above else b"\0")] for block in blocks])
    return bool(counts[:, :-1].any() or counts[:, -1].sum() > 1)


def _read_cleaned(data: bytes, layout: _Layout, path: str) -> tuple[pa.Table, np.ndarray, tuple[str, ...]]:
    """The table, the line of each row, and notes: without comments, empty lines, and what is no row.

    A column may be of any types.
    """
    body, rows, notes = _body(data, layout)
    with suppress(pa.ArrowInvalid):
        return _parse(body, layout, min(len(body) + 1, _SINGLE_BLOCK)), rows, notes
    body, rows, remarks = _without_remarks(body, layout, rows, path, not data.endswith(b"\n"))
    try:
        return _parse(body, layout, min(len(body) + 1, _SINGLE_BLOCK)), rows, notes + remarks
    except pa.ArrowInvalid as error:
        raise InputError(f"{path}: cannot be read as a table: {str(error).splitlines()[0][:200]}") from None


def _text(line: bytes) -> str:
    """Header text; one that is not UTF-8 is in the encoding in which it names most sensors, else in Latin-1 (° ² µ)."""
    try:
        return line.decode()
    except UnicodeDecodeError:
        texts = [line.decode(code, "replace") for code in _ENCODINGS]
        return max(texts, key=lambda text: sum(bool(sensor_of((word,))[0]) for word in words_of(text)))


def _cells(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":  # a blank before a bracket belongs to the name
        return re.split(r"\s+(?![\[(])", line.strip())
    return next(csv.reader([line], delimiter=delimiter), [])


def _is_number(cell: str, decimal: str = ".") -> bool:
    if _VECTOR.fullmatch(cell.strip()):
        return True
    if decimal == "," and "." in cell:
        return False
    text = cell.replace(decimal, ".")
    try:
        float(text)
    except ValueError:
        return measured(np.array([text], object)) is not None
    return True


def _is_word(cell: str, decimal: str) -> bool:
    return bool(cell.strip()) and not _is_number(cell, decimal)


_ENCODINGS = ("latin-1", "gb18030", "shift_jis", "cp1251")
_MARKS = ("#", "//", "%")
"""Signs that a line is a remark, or the header behind such a sign."""
_TEXTS = set("comment comments remark remarks note notes marker markers annotation annotations kommentar".split())
"""Words of the names of columns that may be missing behind the last cell."""
_RULE = re.compile(r"[-=_+|\s]*")
"""A line that only separates others, or an empty one."""
_STYLES = [(delimiter, decimal) for decimal, order in ((".", "\t,; |"), (",", ";\t, |")) for delimiter in order]
"""Delimiters and decimal signs, the likelier first."""


def _layout(data: bytes, path: str) -> _Layout:
    """Delimiter, decimal sign, header and first line of data: data is what most of the first lines look like."""
    lines = [_text(line) for line in data[:HEAD].split(b"\n", _LOOKED_AT)[:_LOOKED_AT]]
    ruled = [(at, line) for at, line in enumerate(lines) if not _RULE.fullmatch(line)]
    filled = [(at, line) for at, line in ruled if not line.lstrip().startswith(_MARKS)]
    if not filled:
        raise InputError(f"{path}: holds no data.")
    best: tuple[float, str, str, int] | None = None
    for delimiter, decimal in _STYLES:
        split = [_cells(line, delimiter) for _, line in filled]
        numbers = [sum(_is_number(cell, decimal) for cell in cells) for cells in split]
        widths = Counter(len(cells) for cells, count in zip(split, numbers, strict=True) if count)
        width, rows = max(widths.items(), key=lambda item: (item[1] * (item[0] > 1), item[0]), default=(0, 0))
        if width < 2:
            continue
        filled_in = sum(
            count + sum(not cell.strip() for cell in cells)
            for cells, count in zip(split, numbers, strict=True)
            if len(cells) == width and count
        )
        score = rows * max(0.1, filled_in / (width * rows))
        if best is None or score > 1.05 * best[0]:
            best = score, delimiter, decimal, width
    if best is None:
        only = "a header but no rows of data" if len(filled) < 3 else "no table of numbers"
        if np.mean([_is_number(line.strip()) for _, line in filled]) > 0.5:
            only = "one column of numbers; a triad has three axes, a column each, and time beside them or --rate"
        raise InputError(f"{path}: holds {only}.")
    _, delimiter, decimal, width = best
    rows = [_cells(line, delimiter) for _, line in filled]
    holding = [cells for cells in rows if len(cells) == width and any(_is_number(cell, decimal) for cell in cells)]
    trailing = all(not cells[-1].strip() for cells in holding)
    worded = 2 * sum(_is_word(cells[0], decimal) for cells in holding) > len(holding)
    headers: list[list[str]] = []
    remarks: tuple[str, ...] = ()
    for (at, _), cells in zip(filled, rows, strict=True):
        numbers = sum(_is_number(cell, decimal) for cell in cells)
        if not numbers and (len(cells) == width - 1 and trailing):
            cells = [*cells, ""]  # data ends in a delimiter that the header has not, or the other way round
        elif (
            not numbers and len(cells) > width and delimiter != " " and set(words_of(" ".join(cells[width:]))) <= _TEXTS
        ):
            cells = cells[:width]
        elif not numbers and len(cells) > width and sum(bool(field.canonical) for field in fields_of(cells)) > 2:
            remarks = (f"row {at + 1} has {len(cells)} names and the rows below it have {width} cells: not used.",)
        if numbers and _is_word(cells[0], decimal) and not worded:
            continue  # a key with its values, above the names or below them
        if len(cells) != width and not headers and not 1 < numbers == len(cells):
            continue  # preamble; but a short row of numbers, or any after the header, is data that parsing will refuse
        if numbers or (headers and len(cells) != width):
            rate = stated_rate("\n".join(lines[:at]))
            names = _named(headers) or _commented_header(lines[:at], delimiter, width)
            return _Layout(delimiter, names, width, at, decimal, rate, () if names else remarks)
        headers.append(cells)
    raise AssertionError("a width is that of some line of numbers")


def _named(headers: list[list[str]]) -> tuple[str, ...] | None:
    """The names in the lines above the data, with the units that a line of units gives them."""
    if not headers:
        return None
    rows = [[parse_name(cell) for cell in cells] for cells in headers]
    for above, below in list(pairwise(rows)):  # X, Y, Z under each sensor's name, which stands over the first
        over = accumulate(above, lambda before, cell: cell or before)
        rows.append([f"{sensor} {cell}" for sensor, cell in zip(over, below, strict=True)])
    known = [sum(field.canonical is not None for field in fields_of(cells)) for cells in rows]
    last = len(headers) - 1
    best = max(range(len(rows)), key=lambda at: (known[at], -abs(at - last)))
    names = rows[best]
    for at, units in enumerate(rows):
        stated = [bool(find_unit(cell.strip("[]()"))) for cell in units]
        if at != best and sum(stated) >= 3 and sum(stated) >= 0.3 * len(units):
            names = [
                f"{name} [{cell.strip('[]()')}]" if good and not parse_column(name)[1] else name
                for name, cell, good in zip(names, units, stated, strict=True)
            ]
    return tuple(names)


def _commented_header(lines: list[str], delimiter: str, width: int) -> tuple[str, ...] | None:
    """A header behind a comment sign: the last comment before the data, if it has as many cells."""
    comments = [line.lstrip(" #%/") for line in lines if line.lstrip().startswith(_MARKS)]
    cells = _cells(comments[-1], delimiter) if comments else []
    return tuple(map(parse_name, cells)) if len(cells) == width else None


def _body(data: bytes, layout: _Layout) -> tuple[bytes, np.ndarray, tuple[str, ...]]:
    """The lines of data alone, single-blank separated where blanks separate, the line number of each row, and a note.

    Lines from above the data, such as its header, may be there again.
    """
    lines = data.split(b"\n")
    marks = tuple(mark.encode() for mark in _MARKS)
    above = set(map(bytes.strip, lines[: layout.first])) - {b""}
    filled = [
        at for at in range(layout.first, len(lines)) if (line := lines[at].strip()) and not line.startswith(marks)
    ]
    kept = [at for at in filled if lines[at].strip() not in above]
    repeated = len(filled) - len(kept)
    notes = (f"{counted(repeated, 'line')} between rows repeated the header: left out.",) * (repeated > 0)
    data = b"\n".join(lines[at] for at in kept)
    if layout.delimiter == " ":
        data = data.replace(b"\t", b" ")
        while b"  " in data:
            data = data.replace(b"  ", b" ")
        data = data.replace(b"\n ", b"\n").replace(b" \n", b"\n").strip(b" ")
    return data, np.array(kept) + 1, notes


def _parse(data: bytes, layout: _Layout, block: int) -> pa.Table:
    return pc.read_csv(
        pa.BufferReader(data),
        read_options=pc.ReadOptions(
            column_names=[f"c{at}" for at in range(layout.width)],
            block_size=block,
            use_threads=block <= 1 << 20,
        ),
        parse_options=pc.ParseOptions(delimiter=layout.delimiter, ignore_empty_lines=False),
        convert_options=pc.ConvertOptions(strings_can_be_null=True, decimal_point=layout.decimal),
    )


def _without_remarks(
    body: bytes, layout: _Layout, rows: np.ndarray, path: str, cut_off: bool
) -> tuple[bytes, np.ndarray, tuple[str, ...]]:
    """The lines that have as many cells as the rest and their numbers, without remarks.

    What follows the last whole row may hold numbers behind a word, and be a row that is `cut_off` where the file ends.
    Raises InputError for any other row of numbers with another number of cells.
    """
    lines = body.rstrip(b"\n").split(b"\n")
    whole = np.array([len(_cells(_text(line), layout.delimiter)) == layout.width for line in lines])
    kept, notes = np.flatnonzero(whole), []
    for at in np.flatnonzero(~whole):
        line, cells = lines[at], _cells(_text(lines[at]), layout.delimiter)
        footer = at > kept.max(initial=-1) and _is_word(cells[0], layout.decimal)
        if footer or not any(_is_number(cell, layout.decimal) for cell in cells):
            notes.append(f"row {rows[at]} is a remark and left out: {_text(line)[:_QUOTED]!r}.")
        elif cut_off and at == len(lines) - 1 and len(cells) < layout.width:
            notes.append(f"row {rows[at]}, with which the file ends, is cut off and left out.")
        else:
            last = "; it is the last one: the file is cut off, delete that row" if at == len(lines) - 1 else ""
            raise InputError(
                f"{path}, row {rows[at]}: holds {len(cells)} cells where the others hold {layout.width}{last}."
            )
    return b"\n".join(lines[at] for at in kept), rows[kept], tuple(notes[:_FEW_NOTES])
