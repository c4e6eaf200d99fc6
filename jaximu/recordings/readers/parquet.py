"""Parquet, through pyarrow."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from jaximu.recordings.columns.table import (
    LogTable,
    Unpacking,
    from_arrow,
    mapped_axes,
    named_with_units,
    vectors_apart,
)
from jaximu.recordings.recording import Source

_BATCH = 1 << 18
"""Rows decoded at once: beside the columns themselves only so many are held."""


def read(data: bytes, source: Source) -> LogTable:
    """The table in a Parquet file; of nested columns only lists of three numbers count. A row's number is 1-based."""
    schema = pq.read_schema(pa.BufferReader(data))
    flat = [field for field in schema if not pa.types.is_nested(field.type)]
    texts = [  # each once, not once a row
        field.name
        for field in flat
        if not (pa.types.is_integer(field.type) or pa.types.is_floating(field.type) or pa.types.is_temporal(field.type))
    ]
    file = pq.ParquetFile(pa.BufferReader(data), read_dictionary=texts)
    rows = file.metadata.num_rows
    unpacking = Unpacking(source, len(data))
    unpacking.take(8 * rows * len(flat))
    unpacking.take(sum(file.metadata.row_group(at).total_byte_size for at in range(file.num_row_groups)))
    columns = [from_arrow(pa.chunked_array([], type=field.type)) for field in flat]
    filled = 0
    names = [field.name for field in flat]
    for batch in file.iter_batches(batch_size=_BATCH, columns=names, use_threads=rows > _BATCH):
        for index, part in enumerate(batch.columns):
            values = from_arrow(pa.chunked_array([part]))
            if not filled:
                columns[index] = np.empty(rows, values.dtype)
            elif values.dtype != columns[index].dtype:  # the first empty cell of a column of integers
                columns[index] = columns[index].astype(np.result_type(values, columns[index]))
            columns[index][filled : filled + len(values)] = values
        filled += batch.num_rows
    nested = [field.name for field in schema if pa.types.is_nested(field.type)]
    vectors = vectors_apart(file.read(nested)) if nested else pa.table({})
    columns += map(from_arrow, vectors.columns)
    return LogTable(source, named_with_units([*flat, *vectors.schema]), columns, axes=mapped_axes(schema))
