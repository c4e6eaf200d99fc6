"""A recording into a file, in the canonical columns, so that `read_recording` and other tools read it back."""

import os
from collections.abc import Callable, Iterable
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaximu.ground.atomic import atomic_write
from jaximu.ground.errors import FilePath, InputError
from jaximu.ground.units import column_title
from jaximu.recordings.columns.names import GROUPS
from jaximu.recordings.recording import Recording

if TYPE_CHECKING:
    import pyarrow as pa

_LONG_AGO = 2.0**20
"""Start in seconds from which float seconds resolve stamps worse than 0.1 ns; then integer nanoseconds are written."""

Blocks = dict[str, tuple[str, np.ndarray]]
"""By group ("time", "accel", …): the unit and the (rows, m) values, NaN where the sensor has no sample."""


def write_recording(recording: Recording, path: FilePath) -> None:
    """Writes the recording by the suffix of `path` (.csv, .tsv, .txt, .parquet, .npz, .mat), whole or not at all.

    Sensors with stamps of their own are written at the union of the stamps, with empty cells in between. Raw counts
    are written as counts: their nominal scale is not part of the file and is stated again when reading. A recording
    that was put in body axes is written in these; Parquet alone keeps from which (`Reading.axes`).
    Raises InputError for another suffix or a path that cannot be written.
    """
    writer = check_suffix(path)
    with atomic_write(path) as temporary:
        writer(recording, temporary)


def arrow_table(recording: Recording) -> "pa.Table":
    """Return the recording in the canonical columns, as its Parquet file would have them; pandas and polars read it."""
    import pyarrow as pa

    from jaximu.recordings.columns.table import AXES, to_arrow

    table = pa.table({name: to_arrow(values) for name, values in _columns(recording).items()})
    axes = None if recording.reading is None else recording.reading.axes
    return table if axes is None else table.replace_schema_metadata({AXES: axes})


def check_suffix(path: FilePath) -> "Callable[[Recording, Path], None]":
    """The writer of this suffix. Raises InputError if there is none."""
    writer = _WRITERS.get(Path(path).suffix.lower())
    if writer is None:
        raise InputError(f"{os.fspath(path)}: the suffix must be one of {', '.join(_WRITERS)}.")
    return writer


def write_parts(parts: Iterable[Recording], path: FilePath) -> None:
    """Writes the parts of one recording to Parquet one after the other, in bounded memory, whole or not at all.

    The parts must have the same signals and `start`. Raises InputError for a path that cannot be written.
    """
    import pyarrow.parquet as pq

    with atomic_write(path) as temporary:
        writer = None
        try:
            for part in parts:
                table = arrow_table(part)
                writer = writer or pq.ParquetWriter(temporary, table.schema)
                writer.write_table(table)
        finally:
            if writer is not None:
                writer.close()
        if writer is None:
            raise InputError(f"{os.fspath(path)}: the recording has no samples.")


def _blocks(recording: Recording) -> Blocks:
    known = recording.signals
    signals = {key: known[group.field] for key, group in GROUPS.items() if group.field in known}
    stamps = next(iter(signals.values())).time
    if not all(np.array_equal(signal.time, stamps) for signal in signals.values()):
        stamps = np.unique(np.concatenate([signal.time for signal in signals.values()]))
    blocks: Blocks = {"time": ("s", (recording.start + stamps)[:, None])}
    if abs(recording.start) >= _LONG_AGO:
        since = (stamps * 1e9).round().astype(np.int64)
        blocks["time"] = "ns", (round(Fraction(recording.start) * 10**9) + since)[:, None]
    for key, signal in signals.items():
        values = np.full((len(stamps), signal.values.shape[1]), np.nan)
        values[np.searchsorted(stamps, signal.time)] = signal.values
        blocks[key] = signal.unit, values
    return blocks


def _columns(recording: Recording) -> dict[str, np.ndarray]:
    """One array a column, by its canonical name with the unit in brackets."""
    named: dict[str, np.ndarray] = {}
    for key, (unit, values) in _blocks(recording).items():
        names = GROUPS[key].columns if key in GROUPS else (key,)
        stated = None if unit == "1" else unit
        named |= {column_title(name, stated): values[:, at] for at, name in enumerate(names)}
    return named


def _text(delimiter: str) -> Callable[[Recording, Path], None]:
    def write(recording: Recording, path: Path) -> None:
        import pyarrow as pa
        import pyarrow.csv as pc

        from jaximu.recordings.columns.table import to_arrow

        columns = _columns(recording)
        blanks = delimiter == " "  # there an empty cell cannot be told: it becomes nan
        table = pa.table({name: to_arrow(values, nulls=not blanks) for name, values in columns.items()})
        header = delimiter.join(name.replace(" ", "") if blanks else name for name in columns)
        with path.open("wb") as file:
            file.write((f"# {header}\n" if blanks else f"{header}\n").encode())
            pc.write_csv(table, file, pc.WriteOptions(include_header=False, delimiter=delimiter))

    return write


def _parquet(recording: Recording, path: Path) -> None:
    import pyarrow.parquet as pq

    pq.write_table(arrow_table(recording), path)


def _npz(recording: Recording, path: Path) -> None:
    with path.open("wb") as file:
        np.savez_compressed(file, **_columns(recording))  # pyright: ignore[reportArgumentType]


def _mat(recording: Recording, path: Path) -> None:
    """One n × m variable a sensor (brackets are no MATLAB names) and a struct `units` of their units."""
    import scipy.io

    blocks = _blocks(recording)
    variables = {key: values for key, (_, values) in blocks.items()}
    units = {key: unit for key, (unit, _) in blocks.items()}
    with path.open("wb") as file:
        scipy.io.savemat(file, {**variables, "units": units}, do_compression=True)


_WRITERS: dict[str, Callable[[Recording, Path], None]] = {
    ".csv": _text(","),
    ".tsv": _text("\t"),
    ".txt": _text(" "),
    ".parquet": _parquet,
    ".npz": _npz,
    ".mat": _mat,
}
