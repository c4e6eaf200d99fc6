"""MATLAB files: version 5 through scipy, version 7.3 (HDF5, also other HDF5 files) through h5py."""

import io
from dataclasses import replace
from typing import Any

import numpy as np

from jaximu.ground.units import column_title
from jaximu.recordings.columns.table import LogTable, Unpacking
from jaximu.recordings.readers.arrays import table_of
from jaximu.recordings.readers.mat5 import checked
from jaximu.recordings.recording import Source


def read(data: bytes, source: Source) -> LogTable:
    """The table in a MAT file of version 5; structs are opened; a row's number counts from 1."""
    import scipy.io

    data, left_out = checked(data, source)
    table = table_of(scipy.io.loadmat(io.BytesIO(data), simplify_cells=True), source)
    return replace(table, notes=(f"variables not used: {', '.join(left_out)}.",)) if left_out else table


def read_hdf5(data: bytes, source: Source) -> LogTable:
    """The table in a MAT file of version 7.3 or another HDF5 file; groups are opened, an attribute `unit` is read.

    Only what is in the file itself is read: no links to other files, and every object once.
    """
    import h5py

    variables: dict[str, Any] = {}
    unpacking = Unpacking(source, len(data))

    def take(path: str, item: Any) -> None:
        *groups, name = path.split("/")
        if not isinstance(item, h5py.Dataset) or path.startswith("#"):  # MATLAB's store of cell contents
            return
        if item.external or item.is_virtual or (item.dtype.hasobject and item.size != 1):
            return
        unpacking.take(item.size * item.dtype.itemsize)
        value = item[()]
        if item.attrs.get("MATLAB_class") == b"char":
            value = "".join(map(chr, np.ravel(value)))
        attributes = {str(key).lower(): value for key, value in item.attrs.items()}
        unit = attributes.get("unit", attributes.get("units"))
        unit = unit.decode() if isinstance(unit, bytes) else unit
        opened = variables
        for group in groups:
            opened = opened.setdefault(group, {})
        opened[column_title(name, unit)] = value.decode() if isinstance(value, bytes) else value

    rates: dict[str, Any] = {}

    def note(path: str, item: Any) -> None:
        rates.update({str(key): value for key, value in item.attrs.items() if np.size(value) == 1})

    with h5py.File(io.BytesIO(data), "r") as file:
        note("", file)
        file.visititems(note)
        file.visititems(take)
    return table_of({**rates, **variables}, source)
