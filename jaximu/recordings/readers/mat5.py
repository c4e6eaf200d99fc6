"""MAT 5 files looked through before SciPy reads them: its compiled reader trusts the sizes in a file and can crash.

Layout: MathWorks, "MAT-File Format", level 5: elements of a tag (type, bytes) and data, matrices being elements of
elements: flags and class, dimensions, name, and the numbers, or the matrices of cells and of the fields of structs.
"""

import math
import struct
import zlib

from jaximu.recordings.columns.table import Unpacking
from jaximu.recordings.recording import Source

_HEADER = 128  # bytes
_INT8, _INT32, _UINT32, _MATRIX, _COMPRESSED, _UTF8 = 1, 5, 6, 14, 15, 16
_SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8}
"""Bytes of a number by type: int8, uint8, int16, uint16, int32, uint32, single, double, int64, uint64."""
_CELL, _STRUCT, _CHAR, _NUMERIC = 1, 2, 4, range(6, 16)
_TEXT = {1: 1, 2: 1, 4: 2, _UTF8: 1, 17: 2}
_COMPLEX = 0x800
_DEEPEST, _DIMENSIONS, _LONGEST_NAME = 16, 32, 64


class _UnsupportedClass(Exception):
    """A variable of a class that holds no columns: objects, function handles, sparse matrices."""


def checked(data: bytes, source: Source) -> tuple[bytes, tuple[str, ...]]:
    """The file with its variables uncompressed and nothing in them that is not as the format says, and the names of
    variables left out for their class.

    Raises ValueError for a file that is damaged, InputError for one that unpacks to more than `Unpacking` allows.
    """
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None or struct.unpack_from(f"{order}H", data, 124) != (0x0100,):
        raise ValueError("its head is not that of version 5")
    unpacking = Unpacking(source, len(data))
    variables: dict[bytes, bytes] = {}
    left_out = []
    for kind, content in _elements(memoryview(data)[_HEADER:], order):
        if kind == _COMPRESSED:
            ((kind, content),) = _elements(unpacking.unpack(zlib.decompressobj(), bytes(content)), order)
        if kind != _MATRIX or not content:
            raise ValueError("a variable is no matrix")
        try:
            name = _check(content, order, len(content))
        except _UnsupportedClass as error:
            left_out.append(str(error))
            continue
        if name in variables:
            raise ValueError("two variables are of one name")
        variables[name] = struct.pack(f"{order}II", _MATRIX, len(content)) + content
    return b"".join([data[:_HEADER], *variables.values()]), tuple(left_out)


def _elements(data: bytes | memoryview, order: str) -> list[tuple[int, memoryview]]:
    """Type and data of the elements that make up `data`."""
    data, elements, at = memoryview(data), [], 0
    while at < len(data):
        if at + 8 > len(data):
            raise ValueError("an element is cut off")
        kind, count = struct.unpack_from(f"{order}II", data, at)
        start = at = at + 8
        if kind >> 16:  # four bytes or fewer stand in the tag
            kind, count, start = kind & 0xFFFF, kind >> 16, at - 4
        else:
            at += count + (-count % 8 if kind not in (_MATRIX, _COMPRESSED) else 0)
        if start + count > at or at > len(data):
            raise ValueError("an element is longer than what holds it")
        elements.append((kind, data[start : start + count]))
    return elements


def _integers(element: tuple[int, memoryview], order: str) -> tuple[int, ...]:
    kind, data = element
    if kind not in (_INT32, _UINT32) or len(data) % 4:  # some write sizes without sign
        raise ValueError("a matrix has no head")
    return struct.unpack(f"{order}{len(data) // 4}{'I' if kind == _UINT32 else 'i'}", data)


def _check(matrix: memoryview, order: str, most: int, depth: int = 0) -> bytes:
    """Return the name of a matrix of at most so many values. Raises ValueError where a size in it is not right."""
    if depth > _DEEPEST:
        raise ValueError("structs are nested too deeply")
    head, parts = (elements := _elements(matrix, order))[:3], elements[3:]
    if len(head) < 3 or head[2][0] not in (_INT8, _UTF8) or len(flags := _integers(head[0], order)) != 2:
        raise ValueError("a matrix has no head")
    shape, name, of = _integers(head[1], order), bytes(head[2][1]), flags[0] & 0xFF
    count = math.prod(shape)
    if not 2 <= len(shape) <= _DIMENSIONS or min(shape) < 0 or max(count, *shape) > most:
        raise ValueError("a matrix has impossible dimensions")
    if of in _NUMERIC or of == _CHAR:
        sizes = _TEXT if of == _CHAR else _SIZES
        for kind, data in parts:
            # of text, a sign takes one to four bytes, and blanks may be left out
            encoded = of == _CHAR and (kind == _UTF8 or not data)
            if kind not in sizes or (len(data) != sizes[kind] * count and not encoded):
                raise ValueError("a matrix holds another number of values than its dimensions say")
        count = 2 if flags[0] & _COMPLEX else 1
    elif of in (_CELL, _STRUCT):
        if of == _STRUCT:
            if len(parts) < 2:
                raise ValueError("a struct has no names of its fields")
            width, (kind, names) = _integers(parts[0], order), parts[1]
            if len(width) != 1 or not 1 <= width[0] <= _LONGEST_NAME or kind != _INT8 or len(names) % width[0]:
                raise ValueError("a struct has no names of its fields")
            count, parts = count * (len(names) // width[0]), parts[2:]
        for kind, content in parts:
            if kind != _MATRIX:
                raise ValueError("a cell or a field is no matrix")
            if content:
                _check(content, order, most, depth + 1)
    else:
        raise _UnsupportedClass(name.decode("latin-1") or "without a name")
    if len(parts) != count:
        raise ValueError("a matrix has another number of parts than it says")
    return name
