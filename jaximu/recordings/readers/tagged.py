"""Text logs of several sensors, each row tagged with its sensor: Android's GnssLogger, RealSense's rs-data-collect.

Accelerometer and gyroscope have stamps of their own in them, and become tables of their own.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import pyarrow as pa
import pyarrow.csv as pc

from jaximu.recordings.columns.table import HEAD, LogTable, from_arrow
from jaximu.recordings.recording import ReadOptions, Source


@dataclass(frozen=True)
class _Dialect:
    """By tag, the cells of a row that are read; `time` are the cells of the header and the receive stamp."""

    program: str
    sign: re.Pattern[bytes]
    unit: str
    time: Mapping[str, int]
    tags: Mapping[str, tuple[str, int]]
    notes: Mapping[str, str]


_DIALECTS = (
    _Dialect(
        "Android's GnssLogger",
        re.compile(rb"^#?\s*Uncal(?:Accel|Gyro),utcTimeMillis,elapsedRealtimeNanos,", re.MULTILINE),
        "ns",
        {"header": 2, "receive": 2},
        {"UncalAccel": ("accel_{} [m/s^2]", 3), "UncalGyro": ("gyro_{} [rad/s]", 3), "UncalMag": ("mag_{} [uT]", 3)},
        {"header": "time is elapsedRealtimeNanos, the phone's clock since it started"},
    ),
    _Dialect(
        "RealSense's rs-data-collect",
        re.compile(rb"^Stream Type,(?:Index,)?F#,HW Timestamp \(ms\),Host Timestamp ?\(ms\),3DOF_x", re.MULTILINE),
        "ms",
        {"header": 3, "receive": 4},
        {"Accel": ("accel_{} [m/s^2]", 5), "Gyro": ("gyro_{} [rad/s]", 5)},
        {"header": "time is the hardware stamp", "receive": "time is the host's stamp"},
    ),
)


def dialect(data: bytes) -> _Dialect | None:
    """The program that wrote a text, by the header of its rows."""
    return next((dialect_of for dialect_of in _DIALECTS if dialect_of.sign.search(data[:HEAD])), None)


def read(data: bytes, source: Source, options: ReadOptions) -> tuple[LogTable, ...]:
    """The tables in a tagged text, one a sensor. Raises InputError where no row of a sensor is there."""
    log = dialect(data)
    assert log is not None
    tables = []
    shift = 0 if b"Stream Type,F#" not in data[:HEAD] else -1  # older versions write no index
    stamp = options.stamp if options.stamp in log.notes else "header"
    for tag, (name, first) in log.tags.items():
        rows = re.findall(rb"^" + tag.encode() + rb",.*$", data, re.MULTILINE)
        rows = [row for row in rows if row.partition(b",")[2][:1].isdigit()]  # not the header itself
        if not rows:
            continue
        width = rows[0].count(b",") + 1
        at = [shift + cell for cell in (log.time[stamp], first, first + 1, first + 2)]
        if width <= max(at):
            raise source.refused(f"rows of {tag} have {width} cells, fewer than {log.program} writes.")
        try:
            table = pc.read_csv(
                pa.BufferReader(b"\n".join(rows)),
                read_options=pc.ReadOptions(column_names=[str(number) for number in range(width)]),
                convert_options=pc.ConvertOptions(include_columns=[str(number) for number in at]),
            )
        except pa.ArrowInvalid as error:
            reason = str(error).splitlines()[0][:200]
            raise source.refused(f"rows of {tag} cannot be read as a table: {reason}") from None
        columns = [from_arrow(column) for column in table.columns]
        names = [f"time [{log.unit}]", *map(name.format, "xyz")]
        tables.append(LogTable(source, names, columns, messages=True))
    if not tables:
        raise source.refused(f"is a log of {log.program} without a row of accelerometer or gyroscope.")
    note = f"a log of {log.program} (m/s^2, rad/s): {log.notes[stamp]}; each sensor has its own time stamps."
    return replace(tables[0], notes=(note,)), *tables[1:]
