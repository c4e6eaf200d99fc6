"""NPZ: named NumPy arrays, one a column, or n × 3 for a triad."""

import io
import zipfile

import numpy as np

from jaximu.formats.arrays import table_of
from jaximu.formats.table import Table, check_unpacked
from jaximu.recording import Source


def read(data: bytes, source: Source) -> Table:
    """The table in an NPZ file; a row's number counts from 1."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        check_unpacked(sum(each.file_size for each in archive.infolist()), len(data), source)
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        return table_of({name: archive[name] for name in archive.files}, source)
