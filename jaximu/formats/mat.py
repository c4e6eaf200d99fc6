"""MATLAB files: version 5 through scipy, version 7.3 (HDF5, also other HDF5 files) through h5py."""

import io
from typing import Any

import numpy as np

from jaximu.formats.arrays import table_of
from jaximu.formats.table import Table
from jaximu.recording import Source


def read(data: bytes, source: Source) -> Table:
    """The table in a MAT file of version 5 or older; structs are opened; a row's number counts from 1."""
    import scipy.io

    return table_of(scipy.io.loadmat(io.BytesIO(data), simplify_cells=True), source)


def read_hdf5(data: bytes, source: Source) -> Table:
    """The table in a MAT file of version 7.3 or another HDF5 file; groups are opened, an attribute `unit` is read."""
    import h5py

    def opened(group: Any) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, each in group.items():
            if name.startswith("#"):  # MATLAB's store of cell contents
                continue
            if isinstance(each, h5py.Group):
                found[name] = opened(each)
                continue
            value = each[()]
            if each.attrs.get("MATLAB_class") == b"char":
                value = "".join(map(chr, np.ravel(value)))
            unit = each.attrs.get("unit", each.attrs.get("units"))
            unit = unit.decode() if isinstance(unit, bytes) else unit
            found[f"{name} [{unit}]" if unit else name] = value.decode() if isinstance(value, bytes) else value
        return found

    with h5py.File(io.BytesIO(data), "r") as file:
        return table_of(opened(file), source)
