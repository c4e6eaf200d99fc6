"""NPZ: named NumPy arrays, one a column, or n × 3 for a triad."""

import io
import math
import zipfile

import numpy as np
from numpy.lib import format as npy

from jaximu.formats.arrays import table_of
from jaximu.formats.table import Table, Unpacking
from jaximu.recording import Source


def read(data: bytes, source: Source) -> Table:
    """The table in an NPZ file; a row's number counts from 1."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = archive.infolist()
        Unpacking(source, len(data)).take(sum(each.file_size for each in members))
        return table_of({each.filename.removesuffix(".npy"): _array(archive.read(each)) for each in members}, source)


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
