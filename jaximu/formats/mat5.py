"""MAT 5 files looked through before SciPy reads them: its compiled reader trusts the sizes in a file and can crash.

Layout: MathWorks, "MAT-File Format", level 5: elements of a tag (type, bytes) and data, matrices being elements of
elements: flags and class, dimensions, name, and the numbers, or the matrices of cells and of the fields of structs.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

from jaximu.formats.table import Unpacking
from jaximu.recording import Source

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
    parts, left_out, names = [data[:_HEADER]], [], set()
    for variable in _variables(data, order, Unpacking(source, len(data))):
        walk = _Walk(variable, order)
        kind, _, end = walk.tag(len(variable))
        if kind != _MATRIX or end != len(variable) or end == walk.at:
            raise ValueError("a variable is no matrix")
        try:
            name = walk.matrix(end, 0)
        except _UnsupportedClass as error:
            left_out.append(str(error))
            continue
        if name in names:
            raise ValueError("two variables are of one name")
        names.add(name)
        parts.append(variable)
    return b"".join(parts), tuple(left_out)


def _variables(data: bytes, order: str, unpacking: Unpacking) -> Iterator[bytes]:
    """The elements of the file, tag and data, uncompressed."""
    at = _HEADER
    while at < len(data):
        kind, count = struct.unpack_from(f"{order}II", data, at)
        end = at + 8 + count
        if end > len(data):
            raise ValueError("a variable is cut off")
        yield unpacking.unpack(zlib.decompressobj(), data[at + 8 : end]) if kind == _COMPRESSED else data[at:end]
        at = end


@dataclass
class _Walk:
    """A place in the elements of a variable, as SciPy's reader goes through them."""

    data: bytes
    order: str
    at: int = 0

    def tag(self, limit: int) -> tuple[int, int, int]:
        """Type, start and end of the data of the element here, at whose data the place is then."""
        if self.at + 8 > limit:
            raise ValueError("an element is cut off")
        kind, count = struct.unpack_from(f"{self.order}II", self.data, self.at)
        self.at += 8
        if kind >> 16:  # four bytes or fewer stand in the tag
            kind, count, start = kind & 0xFFFF, kind >> 16, self.at - 4
            if count > 4:
                raise ValueError("a short element is too long")
        else:
            start = self.at
        if start + count > limit:
            raise ValueError("an element is longer than what holds it")
        return kind, start, start + count

    def element(self, limit: int) -> tuple[int, bytes]:
        """Type and data of the element here, and go past it."""
        kind, start, end = self.tag(limit)
        if start == self.at:
            self.at = end + -(end - start) % 8
            if self.at > limit:
                raise ValueError("an element is cut off")
        return kind, self.data[start:end]

    def integers(self, kind: int, limit: int) -> tuple[int, ...]:
        found, data = self.element(limit)
        if found not in (_UINT32, kind) or len(data) % 4:  # some write sizes without sign
            raise ValueError("a matrix has no head")
        return struct.unpack(f"{self.order}{len(data) // 4}{'I' if kind == _UINT32 else 'i'}", data)

    def matrix(self, end: int, depth: int) -> bytes:
        """Go through the matrix whose data starts here, to its name. Raises ValueError where a size is not right."""
        if depth > _DEEPEST:
            raise ValueError("structs are nested too deeply")
        flags = self.integers(_UINT32, end)
        shape = self.integers(_INT32, end)
        kind, name = self.element(end)
        if len(flags) != 2 or kind not in (_INT8, _UTF8):
            raise ValueError("a matrix has no head")
        count = math.prod(shape)
        if not 2 <= len(shape) <= _DIMENSIONS or min(shape) < 0 or max(count, *shape) > len(self.data):
            raise ValueError("a matrix has impossible dimensions")
        of = flags[0] & 0xFF
        if of in _NUMERIC or of == _CHAR:
            sizes = _SIZES if of != _CHAR else _TEXT
            for _ in range(2 if flags[0] & _COMPLEX else 1):
                kind, data = self.element(end)
                # of text, a sign takes one to four bytes, and blanks may be left out
                encoded = of == _CHAR and (kind == _UTF8 or not data)
                if kind not in sizes or (len(data) != sizes[kind] * count and not encoded):
                    raise ValueError("a matrix holds another number of values than its dimensions say")
        elif of == _CELL:
            self.matrices(count, end, depth)
        elif of == _STRUCT:
            width = self.integers(_INT32, end)
            kind, names = self.element(end)
            if len(width) != 1 or not 1 <= width[0] <= _LONGEST_NAME or kind != _INT8 or len(names) % width[0]:
                raise ValueError("a struct has no names of its fields")
            self.matrices(count * (len(names) // width[0]), end, depth)
        else:
            raise _UnsupportedClass(name.decode("latin-1") or "without a name")
        if self.at != end:
            raise ValueError("a matrix is not as long as it says")
        return name

    def matrices(self, count: int, limit: int, depth: int) -> None:
        for _ in range(count):
            kind, start, end = self.tag(limit)
            if kind != _MATRIX or start != self.at:
                raise ValueError("a cell or a field is no matrix")
            if end > start:
                self.matrix(end, depth + 1)
