"""From a file of any known format to a `Recording`."""

import hashlib
import os
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from fractions import Fraction
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import FilePath, InputError, name_of, readable
from jaximu.ground.quantities import counted
from jaximu.ground.units import INERTIAL_QUANTITIES, PREFIXES, SENSORS, Unit, parse_column
from jaximu.ground.units import unit as unit_named
from jaximu.recordings.columns import nominal
from jaximu.recordings.columns.choose import Used, choose_columns, choose_pair, column_units
from jaximu.recordings.columns.guess import Advice, advise, counted_rows, without_gravity
from jaximu.recordings.columns.known import JOINED, REST, known_names, whole_stamps
from jaximu.recordings.columns.names import (
    CLOCKS,
    COUNTS_ADVICE,
    GROUPS,
    TIME,
    Column,
    header_columns,
    parse_columns,
    shuffled,
)
from jaximu.recordings.columns.table import (
    FEW,
    HEAD,
    LogTable,
    from_arrow,
    mapped_axes,
    named_with_units,
    vectors_apart,
)
from jaximu.recordings.readers.archive import is_archive, opened
from jaximu.recordings.readers.records import apart, of_device, of_sensor
from jaximu.recordings.recording import (
    Defect,
    PoseMeans,
    Reading,
    ReadOptions,
    Recording,
    Signal,
    Source,
    Stated,
    apply_axes,
    map_signal,
    parse_axes,
    plausibility,
)

_SMALL = 1 << 24  # bytes
_TABLE = 200  # rows, up to which a file without time may be a table of pose means
_SET_BACK = 1.0  # s: more than this is a clock that was set, not disorder
_SET_FORWARD = 180 * 86400.0  # s: no logger rests so long within a recording
_STRAY = 1000.0  # usual steps that a single stamp must be off both neighbours to be none
_JITTER = 2.0  # sample periods that stamps may be off a steady clock for their rows to be in order
_UNEVEN = 0.1  # of the period, that sorted stamps scatter by where they jitter
_SETTINGS = {1800.0 * count for count in range(1, 24 + 1)}
"""Seconds by which a clock of the day is set back: as summer time ends, as a zone is set, or without AM and PM."""
_ENDS = sorted({2.0**bits * unit for bits in (16, 24, 32) for unit in (1e-9, 1e-6, 1e-3)} | {86400.0, 604800.0})
"""Seconds after which clocks start again: counters of 16, 24 and 32 bits, a day, a week of GPS."""
_COUNTED, _FEW_COUNTED = 64.0, 4.0  # samples that a counter tells apart, and at the least
_EVENLY = 0.8, 1.25  # sample intervals across the end of a counter of few samples
_SET = 3.0  # sample intervals between the last stamp before a clock was set back and the first after
_CARRIED = 10.0  # sample intervals between the last stamp before a clock started again and the first after
_HALVED = 0.6  # of the usual step, and less: two rows where one is due
_FEW_SHARED, _FEW_SHARES = 10, 0.02  # rows, and share of them, from which on repeated stamps are a habit
_SHARED = 0.1  # of the messages may share a stamp


def read_recording(
    path: FilePath,
    gyro_log: FilePath | None = None,
    options: ReadOptions | None = None,
    require_gyroscope: bool = False,
) -> Recording:
    """The recording in a file, the format found from its content; the gyroscope from `gyro_log` where given.

    Raises InputError naming the file and, where there is one, the row or column; NotPossibleError if the accelerometer
    is in raw counts whose scale is not given and cannot be found.
    """
    options = _sound(options)
    tables = _read(path, options)
    if tables[0].messages and options.columns is not None:
        raise tables[0].refused("names its columns and units itself; --columns is for tables.")
    open_columns = options.columns is None and options.gyro_columns is None
    options = _alike(options, tables[0])
    if gyro_log is None:
        named = len(parse_columns(options.columns or ()))
        if open_columns and (options.gyro_columns is not None or named > len(tables[0].columns)):
            raise tables[0].refused(
                "the calibrated log had its gyroscope in a separate file: name this log's, too (--gyro-log)."
            )
        try:
            parts = _parts(tables, options)
        except InputError as error:
            text = error.args[0]  # as it was written, before it is worded for its reader
            assumed = [note[:1].upper() + note[1:] for note in tables[0].notes if note not in text]
            raise InputError(" ".join([text, *assumed])) from error
    else:
        table, second = whole_stamps(tables[0]), whole_stamps(_read(gyro_log, options)[0])
        first_columns, second_columns = choose_pair(table, second, options.columns, options.gyro_columns)
        parts = [
            extract(table, first_columns, options, set(GROUPS) - {"gyro"}),
            extract(second, second_columns, options, set(GROUPS) - {"accel"}, "--gyro-columns"),
        ]
        if "gyro" not in parts[1].signals:
            raise second.refused("columns gyro_x, gyro_y, gyro_z are missing.")
    recording = _finished(parts, tables[0], options)
    if require_gyroscope and recording.gyroscope is None:
        raise InputError(
            f"{recording.name}: columns gyro_x, gyro_y, gyro_z are missing; a gyroscope is needed here "
            "(if it is in another file: --gyro-log)."
        )
    return recording


def _read(path: FilePath, options: ReadOptions) -> list[LogTable]:
    """The tables of a file, with the rows of one unit where several write into it in turn."""
    tables = read_tables(path, options)
    usual = options.known.device
    return [table if table.messages else of_device(table, options.device, usual) for table in tables]


def read_frame(frame: Any, options: ReadOptions | None = None) -> Recording:
    """Return the recording in a data frame of pandas or polars, an Arrow table, or a mapping of columns by name.

    Columns are named, and their units stated, as in files. Raises as `read_recording` does, and `InputError` for what
    is no table.
    """
    options = _sound(options)
    try:
        table = vectors_apart(pa.table(frame))
    except (TypeError, ValueError, pa.ArrowException) as error:
        raise InputError(
            f"expected a data frame of pandas or polars, an Arrow table or a mapping of equally long columns, found a "
            f"value of type {type(frame).__name__} ({str(error).splitlines()[0][:200]})."
        ) from error
    columns = [from_arrow(column) for column in table.columns]
    read = LogTable(
        Source("data frame", "", 0), named_with_units(table.schema), columns, axes=mapped_axes(table.schema)
    )
    read = _checked(read, read.source)
    options = _alike(options, read)
    return _finished(_parts((read,), options), read, options)


def _sound(options: ReadOptions | None) -> ReadOptions:
    """Return the options; a mistake in them is told before anything is read."""
    options = options or ReadOptions()
    if options.axes:
        parse_axes(options.axes)
    if options.rate is not None and not 0.0 < options.rate < 1e6:
        raise InputError(f"--rate: {options.rate:g} is no sample rate in Hz.")
    like = options.known
    options = replace(
        options,
        topic=options.topic or like.topic,
        instance=like.instance if options.instance is None else options.instance,
        stamp=like.stamp if options.stamp == "header" else options.stamp,
    )
    if options.stamp not in ("header", "receive"):
        raise InputError(f"--stamp: {options.stamp!r} is neither header nor receive.")
    if options.instance is not None and options.instance < 0:
        raise InputError(f"--instance: sensors count from 0, found {options.instance}.")
    return options


def _alike(options: ReadOptions, table: LogTable) -> ReadOptions:
    """Return the options, with what `like` knows of a file of this header and options leave open."""
    like = options.known
    if options.columns is None and options.gyro_columns is None and table.header == tuple(like.header):
        options = replace(options, columns=like.columns, gyro_columns=like.gyro_columns)
    options = replace(options, axes=like.axes if options.axes is None and table.axes is None else options.axes)
    mapped = Reading(axes=table.axes)
    like.require_alike(mapped if options.axes is None else mapped.mapped(options.axes), table.path, like.units)
    return options


def _counts(options: ReadOptions, name: str) -> tuple[Stated | None, Stated | None]:
    """Return scale and offset of a triad in counts, as options or else the calibrated log state them."""
    like = options.known
    scale, offset = (getattr(options, f"{PREFIXES[name]}_{part}") for part in ("scale", "offset"))
    return like.scales.get(name) if scale is None else scale, like.offsets.get(name) if offset is None else offset


def _read_as(
    options: ReadOptions, table: LogTable, parts: "Sequence[_FilePart]", signals: Mapping[str, Signal]
) -> Reading:
    """Return how signals, in the log's axes still, were read; `table` is the file's first."""
    counts = [name for name in INERTIAL_QUANTITIES if name in signals and signals[name].unit == "count"]
    # a gyroscope's offset changes with every power-on: where it is not stated, each log shows its own
    zeros = [name for name in counts if name == "accelerometer" or _counts(options, name)[1] is not None]
    columns, of_gyroscope = (
        (text if isinstance(text, str) else ",".join(text or ())) or None
        for text in (options.columns, options.gyro_columns)
    )
    return Reading(
        columns=columns,
        gyro_columns=of_gyroscope,
        header=table.header if columns or of_gyroscope else (),
        rate=options.rate or options.known.rate,
        axes=table.axes,
        frame=table.frame,
        units={name: unit for part in parts for name, unit in part.units.items()},
        scales={name: signals[name].nominal_scale.tolist() for name in counts},
        offsets={name: signals[name].nominal_offset.tolist() for name in zeros},
        topic=options.topic,
        instance=options.instance,
        stamp=options.stamp,
        device=table.device,
        corrected=table.corrected,
        sensors=table.sensors,
    )


def _parts(tables: Sequence[LogTable], options: ReadOptions) -> "list[_FilePart]":
    """Return the signals of one file's tables."""
    first = whole_stamps(tables[0])
    named = {column.name for column in header_columns(first) or ()}
    alone = options.alone and GROUPS["accel"].columns[0] not in named and GROUPS["gyro"].columns[0] in named
    # an accelerometer under a name that says too little is asked about, and not left out
    sensor = "gyro" if alone and (options.columns is not None or not advise(first).accelerometer) else "accel"
    named = [(first, choose_columns(first, options.columns, sensor))]
    named += [(table, header_columns(table) or ()) for table in tables[1:]]
    return [extract(*part, options, set(GROUPS)) for pair in named for part in _by_clock(*pair)]


def _by_clock(table: LogTable, columns: Sequence[Column]) -> Iterator[tuple[LogTable, Sequence[Column]]]:
    """The columns of each clock: a sensor with stamps of its own comes after the rest, and each without empty rows."""
    names = [column.name or "" for column in columns]
    owned = {title: {title, *GROUPS[CLOCKS[title]].columns} for title in CLOCKS if title in names}
    if not owned:
        yield table, columns
        return
    for clock, members in ({TIME: set(names).difference(*owned.values())} | owned).items():
        places = [at for at, name in enumerate(names) if name in members]
        headings = [table.header[at] or str(at + 1) for at in places]
        part = replace(table, names=headings, columns=[table.columns[at] for at in places])
        titles = [replace(columns[at], name=TIME) if names[at] == clock else columns[at] for at in places]
        stamps = [part.numbers(at) for at, column in enumerate(titles) if column.name == TIME]
        yield part.take(np.flatnonzero(~np.isnan(stamps).any(axis=0))) if stamps else part, titles


def _finished(parts: "Sequence[_FilePart]", table: LogTable, options: ReadOptions) -> Recording:
    """Return the recording of all parts in body axes, checked; `table` is the file's first."""
    recording = _assemble(parts, table, options)
    if options.axes:
        recording = apply_axes(recording, options.axes)
    options.known.require_alike(recording.reading, recording.name, options.known.units)
    try:
        notes = plausibility(recording, options.gravity) if options.check else ()
    except InputError as error:
        advice = None if options.columns or table.messages else advise(whole_stamps(table))
        if advice is None or not (advice.columns and advice.readable):
            raise
        raise InputError(f"{error.args[0]} Or, after checking: {advice.sentence()}") from None
    return replace(recording, notes=(*recording.notes, *notes))


def read_magnetometer(path: FilePath, options: ReadOptions | None = None) -> tuple[Signal, float, Source]:
    """Return the magnetometer of a file that may hold nothing else, the absolute stamp of its t = 0, and its source.

    A field needs no clock: where neither stamps nor a rate are known, a row counts as a second. Raises InputError
    naming the file where it has no such columns.
    """
    options = _sound(options)
    parts, tables = [], _read(path, options)
    for at, table in enumerate(tables):
        options = options if at else _alike(options, table)
        table = whole_stamps(table)
        named = table.messages or len(tables) > 1
        columns = header_columns(table) or () if named else choose_columns(table, options.columns, "mag")
        if options.rate is None and table.rate is None and not any(column.name == TIME for column in columns):
            options = replace(options, rate=1.0)
        parts += [extract(*part, options, {"mag"}) for part in _by_clock(table, columns)]
    part = next((candidate for candidate in parts if "mag" in candidate.signals), None)
    if part is None:
        raise InputError(f"{os.fspath(path)}: columns mag_x, mag_y, mag_z are missing.")
    signal = part.signals["mag"]
    if options.axes:
        signal = map_signal(signal, parse_axes(options.axes)["magnetometer"])
    return signal, float(part.origin), part.source


def read_means(path: FilePath, options: ReadOptions | None = None) -> PoseMeans:
    """Return the poses of a table with a row of mean outputs a pose, as papers print them.

    Columns `accel_x [m/s^2]`, … and perhaps `gyro_x [deg/s]`, … hold the means; `accel_sigma_x [m/s^2]`, … the samples'
    standard deviations, and `samples` their number. Time is not looked at.

    Raises InputError naming the file and the row or column.
    """
    options = replace(options or ReadOptions(), rate=1.0)
    table = read_table(path)
    columns = [Column(None) if column.name == TIME else column for column in choose_columns(table, options.columns)]
    part = extract(table, columns, options, {"accel", "gyro"})
    recording = _finished([replace(part, notes=table.notes)], table, replace(options, rate=None))
    triads = {"accel": recording.accelerometer, "gyro": recording.gyroscope}
    for signal in triads.values():
        if signal is not None and len(signal) != len(table.columns[0]):
            raise table.refused("a row holds no mean of a sensor that others have; leave such rows out.")
    maps = parse_axes(options.axes or "FLU")
    sigma = {
        f"{GROUPS[key].field}_sigma": known @ np.abs(maps[GROUPS[key].field]).T
        for key, signal in triads.items()
        if signal is not None and (known := _sigma_of_means(table, key, signal.unit)) is not None
    }
    return PoseMeans(recording, **sigma)


def _sigma_of_means(table: LogTable, sensor: str, base: str) -> FloatArray | None:
    """The standard deviations (P, 3) of a triad's means, from those of its samples and their number."""
    named = {name: (at, stated) for at, (name, stated) in enumerate(map(parse_column, table.header))}
    names = [f"{sensor}_sigma_{axis}" for axis in "xyz"]
    there = [name for name in names if name in named]
    if not there:
        return None
    if missing := [name for name in (*names, "samples") if name not in named]:
        raise table.refused(f"column {missing[0]} is missing beside {there[0]}.")

    def positive(name: str, factor: float = 1.0) -> FloatArray:
        values = np.asarray(table.numbers(named[name][0]), float) * factor
        if (wrong := ~(values > 0)).any():
            raise InputError(f"{table.where(np.argmax(wrong))}: column {name!r} must be greater than zero.")
        return values

    deviations = []
    for name in names:
        stated = named[name][1]
        if stated is None:
            raise table.refused(f"column {name!r} states no unit.")
        known = unit_named(stated, file=table.path, column=name)
        if known.base != base:
            raise table.refused(f"column {name!r} is in {stated}, but the means beside it are in {base}.")
        deviations.append(positive(name, known.factor))
    return np.stack(deviations, axis=1) / np.sqrt(positive("samples"))[:, None]


# --- file → table ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Format:
    """A format: its name for messages, module and function of its reader, the package that this needs beyond jaximu's.

    A reader takes the file's bytes, or its path where files are large: text, and formats of messages.
    """

    name: str
    module: str
    function: str = "read"
    needs: str | None = None


_TEXT = _Format("text", "csv")
_TAGGED = _Format("tagged text", "tagged")
_PRINTED = _Format("printed text", "printed")
_ROS1 = _Format("ROS 1 bag", "rosbag", "read_ros1", "rosbags")
_ROS2 = _Format("ROS 2 bag", "rosbag", "read_ros2", "rosbags")
_JSON = _Format("JSON", "records")
_DATAFLASH = _Format("DataFlash log", "dataflash", needs="pymavlink")
_MAGIC: tuple[tuple[int, bytes, _Format], ...] = (
    (0, b"PAR1", _Format("Parquet", "parquet")),
    (0, b"PK\x03\x04", _Format("NPZ", "npz")),
    (0, b"\x93NUMPY", _Format("NPY", "npz", "read_array")),
    (0, b"\x89HDF", _Format("HDF5", "mat", "read_hdf5")),
    (512, b"\x89HDF", _Format("HDF5", "mat", "read_hdf5")),  # MATLAB puts 512 bytes of text before it
    (0, b"MATLAB 5.0", _Format("MAT", "mat")),
    (0, b"#ROSBAG V2.0", _ROS1),
    (0, b"SQLite format 3\x00", _ROS2),
    (0, b"\x89MCAP0\r\n", _ROS2),
    (0, b"ULog\x01\x12\x35", _Format("ULog", "ulog", needs="pyulog")),
    (0, b"\xa3\x95\x80", _DATAFLASH),  # the message FMT, which describes the others and comes first
    (0, b"FMT, 128, 89, FMT", _DATAFLASH),
)
"""By the first bytes, the formats; suffixes lie."""


def _recognise(path: Path, name: str) -> _Format:
    """The format of a file, or of the folder of a bag. Raises InputError for an empty file."""
    if path.is_dir():
        return _ROS2
    with path.open("rb") as file:
        head = file.read(HEAD)
    if not head or head.isspace():
        raise InputError(f"{name}: is empty.")
    kind = next((kind for at, magic, kind in _MAGIC if head[at : at + len(magic)] == magic), _TEXT)
    return _of_text(head, name) if kind is _TEXT else kind


def _of_text(head: bytes, name: str) -> _Format:
    """The format of text. Raises InputError for text that cannot be read as it stands, saying what it is."""
    from jaximu.recordings.readers.printed import explained, prints
    from jaximu.recordings.readers.tagged import dialect

    if dialect(head):
        return _TAGGED
    start = head.lstrip(b"\xef\xbb\xbf \r\n\t")
    if start[:1] == b"{" or (re.match(rb"\[\s*[\[{\d\-\"]", start) and b"] $" not in start[:100]):
        return _JSON
    if why := explained(head):
        raise InputError(f"{name}: {why}.")
    return _PRINTED if prints(head) else _TEXT


def read_table(path: FilePath) -> LogTable:
    """The columns of a file that is one table. Raises InputError naming the file."""
    first, *others = read_tables(path)
    if others:
        raise first.refused("is a log of several sensors, not a table.")
    return first


_ANY = ReadOptions()
_KEPT: ContextVar[dict[Any, tuple[LogTable, ...]] | None] = ContextVar("tables that are kept", default=None)


@contextmanager
def tables_kept() -> Iterator[None]:
    """Keep the tables of files while this lasts: a file that several verbs read is parsed once."""
    token = _KEPT.set({})
    try:
        yield
    finally:
        _KEPT.reset(token)


def read_tables(path: FilePath, options: ReadOptions = _ANY) -> tuple[LogTable, ...]:
    """The tables of a file, the accelerometer's first; the format is found from the content.

    Of `options` topic, instance and stamp count. Raises InputError naming the file, and the package to install where
    one is missing.
    """
    kept, key = _KEPT.get(), (name_of(path), options.topic, options.instance, options.stamp)
    if kept is None:
        return _tables_of(path, options)
    if key not in kept:
        kept[key] = _tables_of(path, options)
    return kept[key]


def _tables_of(path: FilePath, options: ReadOptions) -> tuple[LogTable, ...]:
    name, file = name_of(path), Path(path)
    with readable(file):
        archive = is_archive(file)
    if not archive:
        return _tables_of_file(file, name, options)
    with _whole(name, "a ZIP archive"), opened(file, name) as files:
        parts = {sensor: _tables_of_file(inner, inside, options) for sensor, (inside, inner) in files.items()}
        source = Source(name, _hash(file), 0)
    tables = parts.get("") or _of_sensors({sensor: first for sensor, (first, *_) in parts.items()})
    if "" in parts and file.is_dir():  # of a folder with one log in it
        tables = [table.noted(f"read from {files[''][0]}.") for table in tables]
    return tuple(replace(table, source=replace(source, rows=table.source.rows)) for table in tables)


def _of_sensors(tables: Mapping[str, LogTable]) -> list[LogTable]:
    """The sensors of a recording of several files; what cannot be used beside the accelerometer is left out."""
    whole, notes = [], []
    for sensor, table in tables.items():
        try:
            whole.append(of_sensor(table, sensor))
        except InputError as error:
            if not whole:
                files = " --gyro-log ".join(shlex.quote(tables[key].path) for key in ("accel", "gyro") if key in tables)
                raise InputError(
                    f"{error.args[0]} Give its files themselves, unpacked; then units can be stated, and a guess of "
                    f"them is made: jaximu info {files}"
                ) from None
            notes.append(f"not used: {error.args[0]}")
    return [whole[0].noted(*notes), *whole[1:]]


@contextmanager
def _whole(name: str, kind: str, needs: str | None = None) -> Iterator[None]:
    """Say of a file that it is damaged, or lacks the package that it `needs`, where reading it fails."""
    try:
        yield
    except InputError:
        raise
    except ModuleNotFoundError as error:
        raise InputError(
            f"{name}: is a {kind}, which needs the package {needs}: install it with pip install 'jaximu[formats]'."
        ) from error
    except Exception as error:  # the libraries behind raise nearly anything on damaged files
        reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise InputError(
            f"{name}: begins like {kind} but cannot be read; it is cut off or damaged ({reason})."
        ) from error


def _tables_of_file(file: Path, name: str, options: ReadOptions) -> tuple[LogTable, ...]:
    """The tables of one file, which messages call `name`."""
    with readable(name):
        kind = _recognise(file, name)
        data = file if kind is _TEXT or kind.needs else file.read_bytes()
    more = (options,) if kind.needs or kind is _TAGGED else ()
    with _whole(name, kind.name, kind.needs), ThreadPoolExecutor(1) as beside:
        # a thread costs a small file more than it saves
        if isinstance(data, bytes) and len(data) < _SMALL:
            sha256 = hashlib.sha256(data).hexdigest
        else:
            sha256 = beside.submit(_hash, file).result
        read = getattr(import_module(f"jaximu.recordings.readers.{kind.module}"), kind.function)
        tables = read(data, Source(name, "", 0), *more)
        source = Source(name, sha256(), 0)
    if tables == ():
        raise InputError(f"{name}: holds no message of these sensors; it is cut off or damaged.")
    whole = tables if isinstance(tables, tuple) else (tables,)
    return tuple(_checked(table.without_markers(), source) for table in whole)


def advise_reading(path: FilePath, rate: float | None = None, device: str | None = None) -> Advice | None:
    """How to read a table whose header does not say it all; None for a log that names its columns itself.

    `rate`: Hz, where it is known. `device`: whose rows, where several units write in turn. Raises InputError as
    `read_tables` does, and where the unit is to be chosen.
    """
    table = _read(path, ReadOptions(device=device))[0]
    table = replace(table, rate=rate or table.rate)
    return None if table.messages else advise(whole_stamps(table))


def _checked(table: LogTable, source: Source) -> LogTable:
    """The table with its source and number of rows, in our names where its own show what wrote it."""
    rows = len(table.columns[0]) if table.columns else 0
    if rows < 2:
        raise table.refused(f"holds {counted(rows, 'row')} of data; a recording needs more.")
    table = apart(replace(table, source=replace(source, rows=rows)))
    known = known_names(table)
    return table if known is None else replace(table, names=known[0]).noted(known[1])


def _hash(path: Path) -> str:
    """The SHA-256 of a file, or of a folder's files one after the other, without holding them."""
    total = hashlib.sha256()
    for file_path in sorted(path.iterdir()) if path.is_dir() else [path]:
        if file_path.is_file():
            with file_path.open("rb") as file:
                hashlib.file_digest(file, lambda: total)
    return total.hexdigest()


# --- table → recording ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _FilePart:
    """The signals of one file by group, time in seconds since its own first stamp `origin`, seconds."""

    source: Source
    signals: dict[str, Signal]
    origin: Fraction | float
    notes: tuple[str, ...]
    units: Mapping[str, str]


def extract(
    table: LogTable, columns: Sequence[Column], options: ReadOptions, groups: set[str], option: str = "--columns"
) -> _FilePart:
    """The signals of the wanted groups in a table, checked sample by sample."""
    group_of = {name: key for key, group in GROUPS.items() for name in group.columns}
    wanted = [
        Column(TIME, "ns")
        if column.name == TIME and title == JOINED
        else column
        if column.name == TIME or group_of.get(column.name or "") in groups
        else Column(None)
        for column, title in zip(columns, table.header, strict=True)
    ]
    sensor = "gyro" if option == "--gyro-columns" else "mag" if groups == {"mag"} else None
    used = column_units(table, wanted, option, sensor)
    for put_right in (
        (_stamped, _set_forward, _carried_on, _ordered if table.messages else _rising) if TIME in used else ()
    ):
        table = put_right(table, *used[TIME])
    stamps, origin, notes = _stamps(table, used, options)
    notes = [*table.notes, *notes]
    signals: dict[str, Signal] = {}
    units: dict[str, str] = {}
    for key, group in GROUPS.items():
        if group.columns[0] not in used:
            continue
        places = [used[name] for name in group.columns]
        values = [(table.numbers(at), at, _per_second(unit, key, stamps)) for at, unit in places]
        if key == "mag" and len(groups) > 1 and any(np.unique(axis[~np.isnan(axis)]).size == 1 for axis, *_ in values):
            notes.append("the magnetometer, or an axis of it, never changes: it is left out.")
            continue
        if "temperature" in key and places[0][1].quantity == "raw count":
            notes.append(f"the {key.replace('_', ' ')} is in counts and left out: {COUNTS_ADVICE}.")
            continue
        signal, dropped = _signal(table, values, stamps)
        if dropped == len(stamps):
            if key in ("accel", "gyro"):
                raise table.refused(f"column {table.label(values[0][1])} is empty.")
            notes.append(f"{group.field}: the columns are empty.")
            continue
        if dropped:
            notes.append(f"{group.field}: {dropped} of {len(stamps)} rows hold no whole sample of it.")
        signals[key], units[group.field] = signal, places[0][1].name
    left = [index for index, column in enumerate(columns) if column.name is None]
    unused = [table.label(index) for index in left if table.header[index] != REST]
    unused = [label for label in unused if not any(label in note for note in notes)]  # a counter's that shows the time
    if unused and table.names and options.columns is None and not table.messages:
        notes.append(f"columns not used: {', '.join(unused)}.")
    return _FilePart(table.source, signals, origin, tuple(notes), units)


_INCREMENTS = {("accel", "velocity increment"): "acceleration", ("gyro", "angle"): "angular rate"}


def _per_second(unit: Unit, sensor: str, stamps: FloatArray) -> Unit:
    """The unit of a rate for increments over the sampling interval, any other unit as it is."""
    quantity = _INCREMENTS.get((sensor, unit.quantity))
    return Unit(unit.name, quantity, unit.factor / np.median(np.diff(stamps))) if quantity else unit


def _stamped(table: LogTable, clock: int, unit: Unit) -> LogTable:
    """The rows without a few that have no time in the column `clock`, or one far from both neighbours'; with a note."""
    stamps = table.numbers(clock)
    missing = np.isnan(stamps)
    if 0 < missing.mean() <= FEW:
        note = f"{counted(int(missing.sum()), 'row')} without a time left out (row {table.row(missing.argmax())})."
        return _stamped(table.take(np.flatnonzero(~missing)).noted(note), clock, unit)
    steps = np.diff(stamps)
    before, after, far = steps[:-1], steps[1:], _STRAY * np.median(np.abs(steps)) if len(steps) else 0.0
    stray = np.flatnonzero((np.abs(before) > far) & (np.abs(after) > far) & (np.abs(before + after) <= far)) + 1
    if not 0 < len(stray) <= FEW * len(stamps):
        return table
    rows = "row whose stamp is" if len(stray) == 1 else "rows whose stamps are"
    note = f"{len(stray)} {rows} far from those around left out (row {table.row(stray[0])})."
    return table.take(np.delete(np.arange(len(stamps)), stray)).noted(Defect("data.order", note))


def _set_forward(table: LogTable, clock: int, unit: Unit) -> LogTable:
    """The rows with a time that goes on where the clock was set forward by months, as from 1970 to now; and a note."""
    stamps = table.numbers(clock)
    steps = np.diff(stamps)
    if not len(forward := np.flatnonzero(steps * unit.factor > _SET_FORWARD)):
        return table
    shift = np.zeros(len(stamps), stamps.dtype)
    shift[forward + 1] = steps[forward] - np.median(steps).astype(stamps.dtype)
    note = (
        f"the clock is set forward by {steps[forward].max() * unit.factor:.6g} s in "
        f"{counted(len(forward), 'place')} (row {table.row(forward[0] + 1)}): its time goes on from there."
    )
    return table.with_column(clock, stamps - shift.cumsum()).noted(note)


def _carried_on(table: LogTable, clock: int, unit: Unit) -> LogTable:
    """The rows with a time that goes on where a counter passed its end, or a day or a week of GPS began, and a note.

    So does a time of day, which is held in whole numbers, where its clock was set back.
    """
    stamps = table.numbers(clock)
    steps = np.diff(stamps)
    if not (steps < 0).any() or not (steps > 0).any():  # NaN is neither
        return table
    usual = np.median(steps[steps > 0])
    of_day = stamps.dtype.kind == "i" and unit.factor in (1e-9, 1.0)
    for seconds in sorted(_SETTINGS.union(_ENDS)) if of_day else _ENDS:
        span = seconds / unit.factor
        if span < _FEW_COUNTED * usual:
            continue
        # one that ends after a few samples must go on as evenly as they come
        nearest, farthest = (0.0, _CARRIED) if span > _COUNTED * usual else _EVENLY
        farthest = min(farthest, _SET) if seconds in _SETTINGS else farthest
        full = stamps.dtype.type(round(span) if stamps.dtype.kind == "i" else span)
        back = np.flatnonzero(steps < -full / 2)
        after = (steps[back] + full) / usual
        if not len(back) or not ((after > nearest) & (after < farthest)).all():
            continue
        turns = np.zeros(len(stamps), stamps.dtype)
        turns[back + 1] = full
        places = f"{counted(len(back), 'place')} (row {table.row(back[0] + 1)})"
        happened = "is set back by" if seconds in _SETTINGS else "starts again after"
        note = f"the clock {happened} {seconds:.10g} s in {places}: its time goes on from there."
        return table.with_column(clock, stamps + turns.cumsum()).noted(note)
    return table


def _ordered(table: LogTable, clock: int, unit: Unit) -> LogTable:
    """The messages in the order of their stamps, each stamp once, with notes of what was put right.

    Raises InputError where the clock was set back, or many messages share stamps.
    """
    stamps = table.numbers(clock)
    steps = np.diff(stamps)
    if not (steps <= 0).any():
        return table
    back = (np.maximum.accumulate(stamps) - stamps).max() * unit.factor
    if back > _SET_BACK:
        first = (steps < 0).argmax() + 1
        raise InputError(
            f"{table.path}, message {table.row(first)}: the clock goes back, by up to {back:.6g} s; cut the log there, "
            "or use the receive stamps (--stamp receive)."
        )
    order = np.argsort(stamps, kind="stable")
    kept = order[np.concatenate([[True], np.diff(stamps[order]) > 0])]
    shared = len(order) - len(kept)
    if shared > _SHARED * len(order):
        raise table.refused(
            f"{shared} of {len(order)} messages share the stamp of another; use the other stamps "
            "(--stamp receive, or --stamp header)."
        )
    table = table.take(kept)
    if out_of_order := int((steps < 0).sum()):
        text = (
            f"{out_of_order} messages came out of order, by up to {1e3 * back:.3g} ms, and were sorted by their stamps."
        )
        table = table.noted(Defect("data.order", text))
    if shared:
        table = table.noted(
            Defect("data.duplicate", f"{shared} messages repeat the stamp of another and were left out.")
        )
    return table


def _rising(table: LogTable, clock: int, unit: Unit) -> LogTable:
    """The rows of a table in the order of their stamps, each row once, with notes of what was put right.

    Rows that share a stamp but differ keep it, unless so many do that the stamps are times of arrival in bursts: then
    they follow each other by nothing. Raises InputError where the clock starts again within the file.
    """
    stamps = table.numbers(clock)
    steps = np.diff(stamps)
    if not (steps <= 0).any() or np.isnan(stamps).any():
        return table
    back = np.flatnonzero(steps < 0) + 1
    alone = np.diff(np.sort(stamps)) if shuffled(stamps) else steps  # rows that lie in no order say no step
    usual = np.median(np.abs(alone[alone != 0])) if alone.any() else 0.0
    if len(back) and (even := _even_clock(stamps)) is not None:
        spread = np.std(stamps - even) * unit.factor
        text = (
            f"The stamps jitter by {1e3 * spread:.2g} ms and go back in {counted(len(back), 'place')}, and "
            "the rows are in order: a steady clock fitted to the stamps replaces them."
        )
        return table.with_column(clock, even).noted(Defect("data.jitter", text))
    order, notes = _by_stamp(table, stamps, back, unit)
    repeats = _repeats(table, order, stamps)
    kept = np.delete(order, repeats)
    if len(repeats):
        block = "" if len(back) else " one after the other"
        text = (
            f"{counted(len(repeats), 'row')} repeat others with the same stamp{block} "
            f"({_rows(table, np.sort(order[repeats]))} …). They were left out."
        )
        if (np.diff(stamps[np.sort(kept)]) >= 0).all():
            notes = []  # the rows that are kept are in order
        notes.append(Defect("data.duplicate", text))
    kept_steps = np.diff(stamps[kept])
    # of two runs that are sorted into each other every other step is at most half of the usual one
    close, before = (int(np.sum((gaps >= 0) & (gaps < _HALVED * usual))) for gaps in (kept_steps, steps))
    if len(back) and close > max(20, 0.02 * len(stamps)) + before:
        row = back[steps[back - 1].argmin()]
        raise InputError(
            f"{table.where(row)}: the clock goes back by {-steps[row - 1] * unit.factor:.6g} s, and the rows "
            "from there on are not those of the same times before: two recordings in one file, or a clock that was set "
            "back (data.order). Cut it there."
        )
    if len(back) and ((kept_steps == 0).any() or close > before):
        return table  # sorting does not help: stamps are wrong, and which, the refusal says
    return _apart(table.take(kept).noted(*notes), clock, unit, usual, in_order=not len(back))


def _rows(table: LogTable, rows: np.ndarray) -> str:
    return "row " + ", ".join(str(table.row(row)) for row in rows[:5])


def _by_stamp(table: LogTable, stamps: np.ndarray, back: np.ndarray, unit: Unit) -> tuple[np.ndarray, list[Defect]]:
    """Return the order of the rows by their stamps, which go back at rows `back`, and what is to be said of it."""
    count = len(stamps)
    if not len(back):
        return np.arange(count), []
    if len(back) > 0.9 * (count - 1):
        text = "The rows run backwards in time. They were sorted by their stamps."
        # rows of one stamp keep the order that they have when the file is read backwards
        return count - 1 - np.argsort(stamps[::-1], kind="stable"), [Defect("data.order", text)]
    farthest = np.max(np.maximum.accumulate(stamps) - stamps) * unit.factor
    text = (
        f"The rows are out of order in {counted(len(back), 'place')} ({_rows(table, back)}), by up to "
        f"{farthest:.6g} s. They were sorted by their stamps."
    )
    return np.argsort(stamps, kind="stable"), [Defect("data.order", text)]


def _repeats(table: LogTable, order: np.ndarray, stamps: np.ndarray) -> np.ndarray:
    """Return which of the ordered rows are like the one before, stamp and all: one of them was written twice."""
    repeats = np.flatnonzero(np.diff(stamps[order]) == 0) + 1
    for column in table.columns:
        values, before = column[order[repeats]], column[order[repeats - 1]]
        repeats = repeats[(values == before) | ((values != values) & (before != before))]
    return repeats


def _apart(table: LogTable, clock: int, unit: Unit, usual: float, in_order: bool) -> LogTable:
    """Put apart rows that share a stamp, `usual` being the step between others: by a steady clock, or by nothing."""
    stamps = table.numbers(clock)
    shared = np.diff(stamps) == 0
    often = in_order and shared.sum() >= _FEW_SHARED and _FEW_SHARES < shared.mean() <= 0.25
    if often and (even := _even_clock(stamps)) is not None:
        rate = (len(even) - 1) / ((even[-1] - even[0]) * unit.factor)
        text = (
            f"{shared.sum()} stamps repeat the one before, and the rows are in order: a steady clock of "
            f"{rate:.5g} Hz fitted to the stamps replaces them."
        )
        return table.with_column(clock, even).noted(Defect("data.jitter", text))
    if shared.mean() > 0.25:  # bursts with one time of arrival for all their rows
        number = np.arange(len(stamps))
        position = number - np.maximum.accumulate(np.where(np.concatenate([[True], ~shared]), number, 0))
        table = table.with_column(clock, stamps.astype(float) + 1e-4 * usual * position)
    return table


def _even_clock(stamps: np.ndarray) -> np.ndarray | None:
    """Return the stamps (rows,) of a steady clock that the rows follow in their order, where stamps jitter about it.

    Rows out of order have stamps that are even once sorted.
    """
    number = np.arange(len(stamps), dtype=float)
    since = (stamps - stamps[0]).astype(float)
    period, start = np.polyfit(number, since, 1) if len(stamps) > 32 else (0.0, 0.0)
    whole = stamps.dtype.kind != "f"
    if period <= (2.0 if whole else 0.0) or np.abs(since - start - period * number).max() > _JITTER * period:
        return None
    if np.diff(np.sort(since)).std() < _UNEVEN * period:
        return None
    even = start + period * number
    return stamps[0] + (even.round().astype(stamps.dtype) if whole else even)


def _stamps(table: LogTable, used: Used, options: ReadOptions) -> tuple[FloatArray, Fraction | float, list[str]]:
    """(rows,) seconds since the first stamp (NaN where it is missing), that stamp in seconds, notes.

    Integer stamps (nanoseconds since 1970 do not fit a float64) are subtracted before they become floats.
    """
    if TIME not in used:
        alike = options.known.rate
        rates = ((options.rate, "--rate"), (table.rate, "the file's sampling rate"), (alike, "the calibrated log"))
        rate, origin = next((pair for pair in rates if pair[0]), (None, ""))
        if not rate:
            means = " A table with a row of means a pose is for `jaximu calibrate --means`."
            means = means if table.source.rows <= _TABLE else ""
            raise table.refused(f"has no time column; state the sample rate with --rate HZ.{means}")
        number, by = np.arange(table.source.rows), ""
        if counter := counted_rows(table):
            label, number = counter
            by = f", and {label}, by which {number[-1] + 1 - len(number)} rows are missing"
        return number / rate, Fraction(0), [f"no time column: stamps from {origin}, {rate:g} Hz{by}."]
    index, unit = used[TIME]
    stamps = table.numbers(index)
    notes = ["--rate not used: the file has a time column."] if options.rate else []
    if np.isnan(stamps[0]):
        raise InputError(f"{table.where(0)}: column {table.label(index)} is empty or NaN.")
    whole = stamps.dtype.kind == "i"
    exact = int(stamps[0]) * Fraction(unit.factor).limit_denominator(10**9) if whole else float(stamps[0]) * unit.factor
    return (stamps - stamps[0]) * unit.factor, exact, notes


def _signal(table: LogTable, columns: Sequence[tuple[np.ndarray, int, Unit]], stamps: FloatArray) -> tuple[Signal, int]:
    """The signal of one sensor in its base unit, and how many rows hold no sample of it.

    Raises InputError for a sample of which only a part is there, a missing stamp, time that does not rise, and a
    triad's axis that never changes.
    """
    rows, kept = len(stamps), range(len(stamps))
    values = np.empty((rows, len(columns)))
    for at, (column, _, unit) in enumerate(columns):  # column by column: passes over rows of three are slow
        plain = unit.factor == 1.0 and unit.offset == 0.0
        values[:, at] = column if plain else column * unit.factor + unit.offset
    if (missing := np.isnan(values)).any():
        absent = missing.all(1)
        broken = missing.any(1) & ~absent
        if 0 < broken.mean() <= FEW:
            absent |= broken
        elif broken.any():
            row = np.argmax(broken)
            label = table.label(columns[int(np.argmax(missing[row]))][1])
            raise InputError(f"{table.where(row)}: column {label} is empty or NaN beside the sensor's other axes.")
        kept = np.flatnonzero(~absent)
        stamps, values = stamps[kept], values[kept]
    if (missing := np.isnan(stamps)).any():
        raise InputError(f"{table.where(kept[np.argmax(missing)])}: the time stamp is empty or NaN.")
    steps = np.diff(stamps)
    if (steps <= 0.0).any():
        at = (steps <= 0.0).argmax() + 1
        what = "repeats that of the row before" if steps[at - 1] == 0.0 else f"goes back by {-steps[at - 1]:.6g} s"
        raise InputError(
            f"{table.where(kept[at])}: the time stamp {what}; delete such rows, or if the stamps are "
            "unusable but the rate is steady, ignore the column (_ in --columns) and give --rate."
        )
    if values.shape[1] == 3 and len(values) > 1:
        for axis, (_, index, _) in zip(values.T, columns, strict=True):
            if axis[0] == axis[-1] and (axis == axis[0]).all():
                raise table.refused(
                    f"column {table.label(index)} never changes from {axis[0]:.6g}: nothing was "
                    "measured, or its steps are coarser than all that the sensor saw. Log more digits."
                )
    return Signal(stamps, values, columns[0][2].base), rows - len(kept)


def _assemble(parts: Sequence[_FilePart], table: LogTable, options: ReadOptions) -> Recording:
    """One recording from the signals of its files, on a common start; counts get their nominal scales."""
    start = min(part.origin for part in parts)
    notes = [note for part in parts for note in part.notes]
    signals: dict[str, Signal] = {}
    for part in parts:
        later = float(part.origin - start)
        for key, signal in part.signals.items():
            signals.setdefault(key, replace(signal, time=signal.time + later) if later else signal)
    accel_file, gyro_file = parts[0].source.path, parts[-1].source.path
    alone = options.alone and "accel" not in signals and "gyro" in signals
    if alone:
        signals["accel"] = Signal(np.empty(0), np.empty((0, 3)), "m/s^2")
        notes += [why] if (why := without_gravity(table)) else []
    elif "accel" not in signals:
        raise InputError(f"{accel_file}: columns accel_x, accel_y, accel_z are missing.")
    for key, file in (("accel", accel_file), ("gyro", gyro_file))[alone:]:
        if key in signals:
            signals[key], remarks = _scaled(signals[key], key, file, options)
            notes += remarks
    if "gyro" in signals and not alone:
        accel, gyro = signals["accel"], signals["gyro"]
        if gyro.time[0] > accel.time[-1] or gyro.time[-1] < accel.time[0]:
            raise InputError(
                f"{' and '.join({accel_file: 0, gyro_file: 0})}: accelerometer and gyroscope do not overlap in time "
                f"({accel.time[0]:.6g} to {accel.time[-1]:.6g} s and {gyro.time[0]:.6g} to {gyro.time[-1]:.6g} s); "
                "the stamps must be of one clock."
            )
        if not np.array_equal(gyro.time, accel.time):
            text = (
                f"accelerometer and gyroscope have separate time stamps: {len(accel)} at {accel.rate:.5g} Hz, "
                f"{len(gyro)} at {gyro.rate:.5g} Hz."
            )
            notes.append(Defect("data.clocks", f"{text} One clock is assumed.") if len(parts) > 1 else text)
    fields = {GROUPS[key].field: signal for key, signal in signals.items()}
    sources = tuple({part.source.path: part.source for part in reversed(parts)}.values())[::-1]
    reading = _read_as(options, table, parts, fields)
    return Recording(**fields, start=float(start), sources=sources, notes=tuple(dict.fromkeys(notes)), reading=reading)


def _scaled(signal: Signal, sensor: str, file: str, options: ReadOptions) -> tuple[Signal, tuple[str, ...]]:
    """A triad with its nominal scale, if it is in raw counts. Raises InputError for too few samples or odd options."""
    if len(signal) < 2:
        raise InputError(f"{file}: columns {sensor}_x, {sensor}_y, {sensor}_z hold only one sample.")
    if signal.unit == "count":
        scale, offset = _counts(options, SENSORS[sensor])
        if sensor == "accel":
            return nominal.scaled_accelerometer(signal, scale, offset, options.gravity, file)
        return nominal.scaled_gyroscope(signal, scale, offset, file)
    scale, offset = getattr(options, f"{sensor}_scale"), getattr(options, f"{sensor}_offset")
    if scale is not None or offset is not None:
        option = f"--{sensor}-{'offset' if scale is None else 'scale'}"
        raise InputError(f"{file}: {option} is for raw counts, but column {sensor}_x is in physical units.")
    return signal, ()
