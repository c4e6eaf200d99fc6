"""From a file of any known format to a `Recording`."""

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import numpy as np

from jaximu.errors import InputError
from jaximu.formats import nominal
from jaximu.formats.columns import GROUPS, TIME, Column, choose_columns, choose_pair, column_units
from jaximu.formats.table import Table
from jaximu.gravity import STANDARD, LocalGravity
from jaximu.recording import FloatArray, Recording, Signal, Source, apply_axes, parse_axes, plausibility
from jaximu.units import Unit


@dataclass(frozen=True)
class ReadOptions:
    """What a file does not say about itself.

    columns: names in order for all columns of the file, with units in brackets, separated by commas; replaces the
        header. "_" ignores a column, "accel [g]" stands for three. With a gyroscope file it may name both files'.
    gyro_columns: the same for the gyroscope's file.
    rate: sample rate in Hz, for files without a time column.
    axes: map to body axes, see `jaximu.recording.parse_axes`.
    accel_scale, gyro_scale: nominal scale of raw counts, see `jaximu.formats.nominal.parse_scale`.
    accel_offset, gyro_offset: counts at zero input.
    gravity: local gravity, from which the scale of a raw accelerometer is found.
    check: refuse what is not plausible, see `jaximu.recording.plausibility`.
    """

    columns: str | Sequence[str] | None = None
    gyro_columns: str | Sequence[str] | None = None
    rate: float | None = None
    axes: str | None = None
    accel_scale: nominal.Stated | None = None
    accel_offset: nominal.Stated | None = None
    gyro_scale: nominal.Stated | None = None
    gyro_offset: nominal.Stated | None = None
    gravity: LocalGravity = STANDARD
    check: bool = True


def read_recording(
    path: str | os.PathLike[str],
    gyro_log: str | os.PathLike[str] | None = None,
    options: ReadOptions | None = None,
    require_gyroscope: bool = False,
) -> Recording:
    """The recording in a file, the format found from its content; the gyroscope from `gyro_log` where given.

    Raises InputError naming the file and, where there is one, the row or column; NotPossibleError if the accelerometer
    is in raw counts whose scale is not given and cannot be found.
    """
    options = options or ReadOptions()
    if options.axes:
        parse_axes(options.axes)  # a mistake in an option is told before the file is read
    if options.rate is not None and not 0.0 < options.rate < 1e6:
        raise InputError(f"--rate: {options.rate:g} is no sample rate in Hz.")
    table = read_table(path)
    if gyro_log is None:
        parts = [_extract(table, choose_columns(table, options.columns), options, set(GROUPS))]
    else:
        second = read_table(gyro_log)
        first_columns, second_columns = choose_pair(table, second, options.columns, options.gyro_columns)
        parts = [
            _extract(table, first_columns, options, set(GROUPS) - {"gyro"}),
            _extract(second, second_columns, options, set(GROUPS) - {"accel"}, "--gyro-columns"),
        ]
        if "gyro" not in parts[1].signals:
            raise InputError(f"{second.path}: columns gyro_x, gyro_y, gyro_z are missing.")
    recording = _assemble(parts, options)
    if require_gyroscope and recording.gyroscope is None:
        raise InputError(
            f"{recording.name}: columns gyro_x, gyro_y, gyro_z are missing; a gyroscope is needed here "
            "(it may be in a file of its own: --gyro-log)."
        )
    if options.axes:
        recording = apply_axes(recording, options.axes)
    if options.check:
        recording = replace(recording, notes=(*recording.notes, *plausibility(recording, options.gravity)))
    return recording


# --- file → table ---------------------------------------------------------------------------------------------------


def _parquet(data: bytes, source: Source) -> Table:
    from jaximu.formats import parquet

    return parquet.read(data, source)


def _npz(data: bytes, source: Source) -> Table:
    from jaximu.formats import npz

    return npz.read(data, source)


def _mat(data: bytes, source: Source) -> Table:
    from jaximu.formats import mat

    return mat.read(data, source)


def _hdf5(data: bytes, source: Source) -> Table:
    from jaximu.formats import mat

    return mat.read_hdf5(data, source)


def _text(data: bytes, source: Source) -> Table:
    from jaximu.formats import csv

    return csv.read(data, source)


def _reader(data: bytes) -> tuple[str, Callable[[bytes, Source], Table]]:
    """The format that the first bytes tell; suffixes lie."""
    if data[:4] == b"PAR1":
        return "Parquet", _parquet
    if data[:4] == b"PK\x03\x04":
        return "NPZ", _npz
    if data[:4] == b"\x89HDF" or data[512:516] == b"\x89HDF":  # MATLAB puts 512 bytes of text before the HDF5
        return "HDF5", _hdf5
    if data[:10] == b"MATLAB 5.0":
        return "MAT", _mat
    return "text", _text


def read_table(path: str | os.PathLike[str]) -> Table:
    """The columns of a file, its format found from the content. Raises InputError naming the file."""
    name = os.fspath(path)
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError(f"{name}: no such file.") from None
    except IsADirectoryError:
        raise InputError(f"{name}: is a folder, not a file.") from None
    except OSError as error:
        raise InputError(f"{name}: cannot be read: {error.strerror or error}.") from None
    if not data.strip():
        raise InputError(f"{name}: is empty.")
    kind, reader = _reader(data)
    source = Source(name, hashlib.sha256(data).hexdigest(), 0)
    try:
        table = reader(data, source)
    except InputError:
        raise
    except Exception as error:  # the libraries behind raise nearly anything on damaged files
        reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise InputError(
            f"{name}: begins like {kind} but cannot be read; it is cut off or damaged ({reason})."
        ) from error
    rows = len(table.columns[0]) if table.columns else 0
    if rows < 2:
        raise InputError(f"{name}: holds {rows} row{'s' * (rows != 1)} of data; a recording needs more.")
    return replace(table, source=replace(source, rows=rows))


# --- table → recording ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Part:
    """The signals of one file by group, time in seconds since its own first stamp `origin`, seconds."""

    source: Source
    signals: dict[str, Signal]
    origin: Fraction | float
    notes: tuple[str, ...]


def _extract(
    table: Table, columns: Sequence[Column], options: ReadOptions, groups: set[str], option: str = "--columns"
) -> _Part:
    """The signals of the wanted groups in a table, checked sample by sample."""
    group_of = {name: key for key, group in GROUPS.items() for name in group.columns}
    wanted = [
        each if each.name == TIME or group_of.get(each.name or "") in groups else Column(None) for each in columns
    ]
    found = column_units(table, wanted, option)
    stamps, origin, notes = _stamps(table, found, options)
    signals: dict[str, Signal] = {}
    for key in sorted(groups & {group_of[name] for name in found if name != TIME}, key=list(GROUPS).index):
        values = [(table.numbers(found[name][0]), *found[name]) for name in GROUPS[key].columns]
        signal, dropped = _signal(table, values, stamps)
        if dropped == len(stamps):
            if key in ("accel", "gyro"):
                raise InputError(f"{table.path}: column {table.label(values[0][1])} is empty.")
            notes.append(f"{GROUPS[key].field}: the columns are empty.")
            continue
        if dropped:
            notes.append(f"{GROUPS[key].field}: {dropped} of {len(stamps)} rows hold no sample of it.")
        signals[key] = signal
    unused = [table.label(index) for index, each in enumerate(columns) if each.name is None]
    if unused and table.names and options.columns is None:
        notes.append(f"columns not used: {', '.join(unused)}.")
    return _Part(table.source, signals, origin, tuple(notes))


def _stamps(
    table: Table, found: dict[str, tuple[int, Unit]], options: ReadOptions
) -> tuple[FloatArray, Fraction | float, list[str]]:
    """(rows,) seconds since the first stamp (NaN where it is missing), that stamp in seconds, notes.

    Integer stamps (nanoseconds since 1970 do not fit a float64) are subtracted before they become floats.
    """
    if TIME not in found:
        rate, said = (options.rate, "--rate") if options.rate else (table.rate, "the file's sampling rate")
        if not rate:
            raise InputError(f"{table.path}: has no time column; state the sample rate with --rate HZ.")
        notes = [f"no time column: stamps from {said}, {rate:g} Hz."]
        return np.arange(table.source.rows) / rate, Fraction(0), notes
    index, unit = found[TIME]
    stamps = table.numbers(index)
    notes = ["--rate not used: the file has a time column."] if options.rate else []
    if np.isnan(stamps[0]):
        raise InputError(f"{table.path}, row {table.row(0)}: column {table.label(index)} is empty or NaN.")
    if stamps.dtype.kind == "i":
        exact = int(stamps[0]) * Fraction(unit.factor).limit_denominator(10**9)
        return (stamps - stamps[0]) * unit.factor, exact, notes
    return (stamps - stamps[0]) * unit.factor, float(stamps[0]) * unit.factor, notes


def _signal(table: Table, columns: Sequence[tuple[np.ndarray, int, Unit]], stamps: FloatArray) -> tuple[Signal, int]:
    """The signal of one sensor in its base unit, and how many rows hold no sample of it.

    Raises InputError for a sample of which only a part is there, a missing stamp, time that does not rise, and a
    triad's axis that never changes.
    """
    base = columns[0][2].base
    values = np.stack([each * unit.factor + unit.offset for each, _, unit in columns], 1)
    missing = np.isnan(values)
    absent = missing.all(1)
    if (broken := missing.any(1) & ~absent).any():
        row = int(np.argmax(broken))
        label = table.label(columns[int(np.argmax(missing[row]))][1])
        raise InputError(
            f"{table.path}, row {table.row(row)}: column {label} is empty or NaN beside the sensor's other axes."
        )
    kept = np.flatnonzero(~absent) if absent.any() else range(len(stamps))
    time = stamps
    if len(kept) < len(stamps):  # no copy of a long log for nothing
        time, values = stamps[kept], values[kept]
    if np.isnan(time).any():
        raise InputError(
            f"{table.path}, row {table.row(kept[np.argmax(np.isnan(time))])}: the time stamp is empty or NaN."
        )
    steps = np.diff(time)
    if (steps <= 0.0).any():
        at = int(np.argmax(steps <= 0.0)) + 1
        what = "repeats that of the row before" if steps[at - 1] == 0.0 else f"goes back by {-steps[at - 1]:.6g} s"
        raise InputError(
            f"{table.path}, row {table.row(kept[at])}: the time stamp {what}; delete such rows, or if the stamps are "
            "unusable but the rate is steady, ignore the column (_ in --columns) and give --rate."
        )
    if values.shape[1] == 3 and len(values) > 1 and (flat := np.ptp(values, axis=0) == 0.0).any():
        label = table.label(columns[int(np.argmax(flat))][1])
        raise InputError(f"{table.path}: column {label} never changes; the sensor's axis is dead or not recorded.")
    return Signal(time, values, base), int(absent.sum())


def _assemble(parts: Sequence[_Part], options: ReadOptions) -> Recording:
    """One recording from the signals of its files, on a common start; counts get their nominal scales."""
    start = min(part.origin for part in parts)
    notes = [note for part in parts for note in part.notes]
    signals: dict[str, Signal] = {}
    for part in parts:
        later = float(part.origin - start)
        for key, signal in part.signals.items():
            signals.setdefault(key, replace(signal, time=signal.time + later) if later else signal)
    accel_file, gyro_file = parts[0].source.path, parts[-1].source.path
    if "accel" not in signals:
        raise InputError(f"{accel_file}: columns accel_x, accel_y, accel_z are missing.")
    accel, said = _scaled(signals["accel"], "accel", accel_file, options)
    signals["accel"] = accel
    notes += said
    if "gyro" in signals:
        gyro, said = _scaled(signals["gyro"], "gyro", gyro_file, options)
        signals["gyro"] = gyro
        notes += said
        if gyro.time[0] > accel.time[-1] or gyro.time[-1] < accel.time[0]:
            raise InputError(
                f"{' and '.join({accel_file: 0, gyro_file: 0})}: accelerometer and gyroscope do not overlap in time "
                f"({accel.time[0]:.6g} to {accel.time[-1]:.6g} s and {gyro.time[0]:.6g} to {gyro.time[-1]:.6g} s); "
                "the stamps must be of one clock."
            )
        if not np.array_equal(gyro.time, accel.time):
            notes.append(
                f"accelerometer and gyroscope have stamps of their own: {len(accel)} at {accel.rate:.5g} Hz, "
                f"{len(gyro)} at {gyro.rate:.5g} Hz."
            )
    fields = {GROUPS[key].field: signal for key, signal in signals.items()}
    sources = tuple(part.source for part in parts)
    return Recording(**fields, start=float(start), sources=sources, notes=tuple(dict.fromkeys(notes)))


def _scaled(signal: Signal, sensor: str, file: str, options: ReadOptions) -> tuple[Signal, tuple[str, ...]]:
    """A triad with its nominal scale, if it is in raw counts. Raises InputError for too few samples or odd options."""
    if len(signal) < 2:
        raise InputError(f"{file}: columns {sensor}_x, {sensor}_y, {sensor}_z hold only one sample.")
    scale, offset = getattr(options, f"{sensor}_scale"), getattr(options, f"{sensor}_offset")
    if signal.unit == "count":
        if sensor == "accel":
            return nominal.scaled_accelerometer(signal, scale, offset, options.gravity, file)
        return nominal.scaled_gyroscope(signal, scale, offset, file)
    if scale is not None or offset is not None:
        option = f"--{sensor}-{'offset' if scale is None else 'scale'}"
        raise InputError(f"{file}: {option} is for raw counts, but column {sensor}_x is in physical units.")
    return signal, ()
