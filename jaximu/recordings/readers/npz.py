"""NPZ: named NumPy arrays, one a column, or n × 3 for a triad."""

import io
import math
import zipfile
from dataclasses import replace

import numpy as np
from numpy.lib import format as npy

from jaximu.recordings.columns.table import LogTable, Unpacking
from jaximu.recordings.readers.arrays import table_of
from jaximu.recordings.recording import Source


def read(data: bytes, source: Source) -> LogTable:
    """The table in an NPZ file; a row's number counts from 1."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = archive.infolist()
        Unpacking(source, len(data)).take(sum(member.file_size for member in members))
        return table_of(
            {member.filename.removesuffix(".npy"): _array(archive.read(member)) for member in members}, source
        )


def read_array(data: bytes, source: Source) -> LogTable:
    """The table in an NPY file: the columns of one array without names, or its named fields."""
    table = table_of({"": _array(data)}, source)
    return table if any(not name.strip("_").isdigit() for name in table.names or ()) else replace(table, names=None)


def _array(member: bytes) -> np.ndarray:
    """The array in an NPY file, on the file's own memory: a shape of more numbers than are there takes none."""
    file = io.BytesIO(member)
    header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(npy.read_magic(file))
    if header is None:
        raise ValueError("an array is of an unknown version")
    shape, by_columns, dtype = header(file)
    if dtype.hasobject:
        raise ValueError("Python objects are not read")
    values = np.frombuffer(member, dtype, math.prod(shape), file.tell())
    return values.reshape(shape, order="F" if by_columns else "C")
