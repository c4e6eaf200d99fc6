"""Parquet, through pyarrow."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from jaximu.formats.table import Table, Unpacking, from_arrow, named_with_units
from jaximu.recording import Source

_BATCH = 1 << 18
"""Rows decoded at once: beside the columns themselves only so many are held."""


def read(data: bytes, source: Source) -> Table:
    """The table in a Parquet file; a row's number counts from 1."""
    file = pq.ParquetFile(pa.BufferReader(data))
    schema, rows = file.schema_arrow, file.metadata.num_rows
    Unpacking(source, len(data)).take(8 * rows * len(schema))
    columns = [from_arrow(pa.chunked_array([], type=field.type)) for field in schema]
    filled = 0
    for batch in file.iter_batches(batch_size=_BATCH):
        for index, part in enumerate(batch.columns):
            values = from_arrow(pa.chunked_array([part]))
            if not filled:
                columns[index] = np.empty(rows, values.dtype)
            elif values.dtype != columns[index].dtype:  # the first empty cell of a column of integers
                columns[index] = columns[index].astype(np.result_type(values, columns[index]))
            columns[index][filled : filled + len(values)] = values
        filled += batch.num_rows
    return Table(source, named_with_units(schema), tuple(columns))
