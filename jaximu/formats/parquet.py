"""Parquet, through pyarrow."""

import pyarrow as pa
import pyarrow.parquet as pq

from jaximu.formats.table import Table, from_arrow, named_with_units
from jaximu.recording import Source


def read(data: bytes, source: Source) -> Table:
    """The table in a Parquet file; a row's number counts from 1."""
    table = pq.read_table(pa.BufferReader(data))
    return Table(source, named_with_units(table.schema), tuple(from_arrow(column) for column in table.columns))
