"""Column names by which a table shows what wrote it, and so which units it is in without saying so."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath

import numpy as np

from jaximu.ground.units import column_title, find_unit, parse_column
from jaximu.recordings.columns.habits import fields_of, last_of, words_of
from jaximu.recordings.columns.names import rises
from jaximu.recordings.columns.table import LogTable


@dataclass(frozen=True)
class _KnownLayout:
    """The names of a program's columns, lower case, without units, and what each is, with its unit."""

    program: str
    columns: Mapping[str, str]
    needed: frozenset[str] = frozenset()

    @classmethod
    def of(cls, program: str, text: str) -> _KnownLayout:
        """Read "name=what it is, …": * stands for x, y, z (and w of an attitude), ? says that it may be missing."""
        columns: dict[str, str] = {}
        needed: set[str] = set()
        for name, title in (entry.split("=") for entry in text.split(", ")):
            axes = "wxyz" if title.startswith("attitude") else "xyz" if "*" in name else "*"
            names = {name.lstrip("?").replace("*", axis): title.replace("*", axis) for axis in axes}
            columns |= names
            needed |= set() if name.startswith("?") else set(names)
        return cls(program, columns, frozenset(needed))


_LAYOUTS = [
    _KnownLayout.of(program, columns)
    for program, columns in (
        (
            "EuRoC (ASL dataset format: ns, rad/s, m/s^2)",
            "timestamp=time [ns], w_rs_s_*=gyro_* [rad/s], a_rs_s_*=accel_* [m/s^2]",
        ),
        (
            "Kalibr's bag extractor (ns, rad/s, m/s^2)",
            "timestamp=time [ns], omega_*=gyro_* [rad/s], alpha_*=accel_* [m/s^2]",
        ),
        (
            "the BROAD data set (m/s^2, rad/s, uT; opt_quat is the sensor's attitude)",
            "imu_acc_*=accel_* [m/s^2], imu_gyr_*=gyro_* [rad/s], ?imu_mag_*=mag_* [uT], ?opt_quat_*=attitude_* [1]",
        ),
        (
            "the MARS logger (ns, rad/s, m/s^2)",
            "timestamp=time [ns], g*=gyro_* [rad/s], a*=accel_* [m/s^2], unix time=",
        ),
        (
            "Physics Toolbox (gF is the specific force in g; a without gravity is not used)",
            "?time=time [s], gf*=accel_* [g], ?w*=gyro_* [rad/s], ?b*=mag_* [uT], ?a*=without_gravity_*",
        ),
        (
            "MicroStrain's SensorConnect (g, rad/s, G)",
            "?time=time [ns], scaledaccel*=accel_* [g], ?scaledgyro*=gyro_* [rad/s], ?scaledmag*=mag_* [G]",
        ),
        (
            "MicroStrain's MIP Monitor (s, g, rad/s, G)",
            "?gps tow=time [s], * accel=accel_* [g], ?* gyro=gyro_* [rad/s], ?* mag=mag_* [G]",
        ),
        (
            "VectorNav (ns, m/s^2, rad/s, G)",
            "timestartup=time [ns], uncompacc*=accel_* [m/s^2], uncompgyro*=gyro_* [rad/s], ?uncompmag*=mag_* [G]",
        ),
        (
            "VectorNav (ns, m/s^2, rad/s, G)",
            "timestartup=time [ns], accel*=accel_* [m/s^2], gyro*=gyro_* [rad/s], ?mag*=mag_* [G]",
        ),
        ("NaveGo (s, m/s^2, rad/s)", "t=time [s], fb_*=accel_* [m/s^2], wb_*=gyro_* [rad/s]"),
        (
            "MAVLink SCALED_IMU (ms, mg, mrad/s, mG)",
            "time_boot_ms=time [ms], *acc=accel_* [mg], *gyro=gyro_* [mrad/s], ?*mag=mag_* [mG]",
        ),
    )
]
_Named = tuple[Sequence[str], str]
"""Names in our words, and a note of whose they are."""
JOINED = "whole time [ns]"
"""Name of a column of stamps that was joined from two."""
REST = "joined"
"""Name of the column that was joined to it."""
_INTERVALS = set("dt delta deltat interval".split())
"""Words of the names of columns that hold the time since the row before."""
_LATEST = 2**33  # s
_PARTS = {"ms": 10**3, "us": 10**6, "ns": 10**9}
_CARRY = 10.0  # usual steps, that one to the next minute may be at the most
_DAY = 86400 * 10**9  # ns
_GAPS = 0.1  # of the seconds may begin with a row whose rest does not fall, as after a gap


def known_names(table: LogTable) -> _Named | None:
    """The names in our words, with units, for a table whose names show what wrote it, and a note; None for any other.

    What is not used keeps its name.
    """
    if table.names is None:
        return _without_header(table)
    names = [re.sub(r"\s*[\[(].*", "", name.strip('" #').rpartition(":")[2]).lower() for name in table.names]
    prefixes = {match[0] for name in names if (match := re.match(r".*\.(?=fb_x$)", name))}
    if len(prefixes) == 1:  # the structure that holds them all
        names = [name.removeprefix(*prefixes) for name in names]
    layouts = [layout for layout in _LAYOUTS if layout.needed <= set(names)]
    if not layouts and (ours := _of_message(table)):
        return ours
    file = PurePath(table.path).name.lower()
    if set(names) == {"time", "seconds_elapsed", "x", "y", "z"} and ("gyro" in file or "accel" in file):
        title = "gyro_* [rad/s]" if "gyro" in file else "accel_* [m/s^2]"  # one file a sensor, named after it
        columns = f"time=time [ns], seconds_elapsed=, *={title}"
        layouts = [_KnownLayout.of(f"Sensor Logger (ns, rad/s, m/s^2; {file})", columns)]
    if not layouts and "accelerometeraccelerationx" in names:
        return table.names, (
            "names as SensorLog for iOS has them: Apple's accelerometer reads -1 g on the axis that points up; add "
            '--axes "-f" to have specific force.'
        )
    if not layouts:
        return None
    titles = layouts[0].columns
    ours = [
        _titled(titles[name], original) if name in titles else original
        for name, original in zip(names, table.names, strict=True)
    ]
    return ours, f"columns and units as {layouts[0].program} has them."


_TRIADS = (("mag", "G"), ("accel", "m/s^2"), ("gyro", "rad/s"))
_XYZ = [f"{name}_{axis} [{unit}]" for name, unit in _TRIADS for axis in "xyz"]
_SENTENCES = {
    "$VNIMU": ("", *_XYZ, "temperature [degC]", "pressure"),
    "$VNYMR": ("", "yaw", "pitch", "roll", *_XYZ),
}


_MESSAGE = re.compile(r"(?:.*[./_])?(angular_velocity|linear_acceleration)[./_]([xyz])")
EPOCH = 1e9, 2.2e9  # s since 1970 that a log's stamps lie between


def _of_message(table: LogTable) -> _Named | None:
    """The names of a table of sensor_msgs/Imu, whatever stands before them: a topic, a message's name."""
    titles = {"angular_velocity": "gyro_{} [rad/s]", "linear_acceleration": "accel_{} [m/s^2]"}
    names = table.header
    matches = [_MESSAGE.fullmatch(name.strip().lower()) for name in names]
    known = [titles[match[1]].format(match[2]) if match else name for match, name in zip(matches, names, strict=True)]
    if sum(match is not None for match in matches) != 6 or len(set(known)) < len(known):
        return None
    stamped = any(".stamp" in name.lower() for name in names)
    for at, (name, column) in enumerate(zip(names, table.columns, strict=True)):
        plain = name.strip("_% ").lower()
        since = column.dtype.kind == "f" and EPOCH[0] < np.nanmin(column) <= np.nanmax(column) < EPOCH[1]
        if stamped and plain == "time":
            known[at] = "received"
        elif plain.endswith("header.stamp") and column.dtype.kind == "i":
            known[at] = "time [ns]"
        elif since and plain in ("time", "timestamp", "stamp"):
            known[at] = "time [s]"
    return known, (
        "columns and units as sensor_msgs/Imu has them (rad/s, m/s^2): its linear_acceleration holds gravity."
    )


def sentence_names(name: str, count: int) -> list[str] | None:
    """The names of the values after a VectorNav sentence's own name, None for another sentence or number of them."""
    names = _SENTENCES.get(name, ())[1:]
    return [*names] if len(names) == count else None


def _without_header(table: LogTable) -> _Named | None:
    """The names of rows without a header that show what wrote them: VectorNav's sentences, ROS's own CSV."""
    first = table.columns[0]
    if len(table.columns) == len(_ECHOED) and [column.dtype.kind for column in table.columns[:3]] == ["i", "i", "O"]:
        return _ECHOED, "columns as `ros2 topic echo --csv` writes sensor_msgs/Imu (rad/s, m/s^2)."
    names = _SENTENCES.get(str(first[0])) if first.dtype == object and (first == first[0]).all() else None
    if names is None or len(names) != len(table.columns):
        return None
    return names, f"columns and units as VectorNav's {first[0]} has them (G, m/s^2, rad/s)."


_NINE = [f"covariance_{number}" for number in range(9)]
_ECHOED = (
    *("header.stamp.sec", "header.stamp.nanosec", "header.frame_id"),
    *(*(f"orientation.{axis}" for axis in "xyzw"), *_NINE),
    *(*(f"gyro_{axis} [rad/s]" for axis in "xyz"), *_NINE),
    *(*(f"accel_{axis} [m/s^2]" for axis in "xyz"), *_NINE),
)


def _titled(title: str, name: str) -> str:
    """A program's title for a column, in the unit that the column's own name states where that is one of its kind."""
    (plain, usual), (_, stated) = parse_column(title), parse_column(name)
    unit = find_unit(usual)
    return column_title(plain, stated) if unit and find_unit(stated, unit.quantity) else title


def whole_stamps(table: LogTable) -> LogTable:
    """The table with its stamps as one column where they are whole seconds in one and the rest of them in another.

    They belong together by their names (sec and nanosec), or because the one falls just where the other rises. The
    column of the seconds holds both then, in nanoseconds and called `JOINED`; the other stays. So does one whose digits
    are those of a time of day, and one of intervals where there is no other time.
    """
    fields = fields_of(table.header)
    timed = any(field.sensor == "time" for field in fields)
    for at, field in enumerate(fields):
        if not timed and (stamps := _summed(table, at)) is not None:
            names = [*table.header[:at], JOINED, *table.header[at + 1 :]]
            note = f"{table.label(at)} is the interval since the row before: the time is their sum."
            return replace(table.with_column(at, stamps), names=names).noted(note)
        in_seconds = field.sensor == "time" and field.unit in (None, "s")
        if in_seconds and (stamps := _of_digits(table.columns[at])) is not None:
            names = [*table.header[:at], JOINED, *table.header[at + 1 :]]
            note = f"the digits of {table.label(at)} are hours, minutes and seconds."
            table = replace(table.with_column(at, stamps), names=names).noted(note)
    for rest, title in enumerate(table.header):
        prefix, unit = last_of(title)
        parts = _PARTS.get(fields[rest].unit or unit or "")
        if parts is None or not _between(table.columns[rest], parts):
            continue
        for at, field in enumerate(fields):
            head, seconds = last_of(table.header[at])
            written = _seconds(table.columns[at]) if at != rest else None
            alike = seconds == "s" and head == prefix
            if written is None or not (
                alike or ((field.sensor == "time" or seconds == "s") and _in_step(written, table.columns[rest]))
            ):
                continue
            names = [*table.header]
            names[at], names[rest] = JOINED, REST
            joined = table.with_column(at, written * 10**9 + table.columns[rest] * (10**9 // parts))
            return replace(joined, names=names).noted(f"time is {table.label(at)} and {table.label(rest)}.")
    return table


def _summed(table: LogTable, at: int) -> np.ndarray | None:
    """Nanoseconds of a column of intervals, by its name and unit; None for any other."""
    title, stated = parse_column(table.header[at])
    head, last = last_of(title)
    unit, words, values = find_unit(stated or last, "time"), set(words_of(head)), table.columns[at]
    named = words & _INTERVALS and words <= _INTERVALS | {"t", "time", "sample", "sampling"}
    if unit is None or not named or values.dtype.kind not in "fi" or not (values >= 0).all() or rises(values):
        return None
    return np.round(np.cumsum(values * unit.factor) * 1e9).astype(np.int64)


def _of_digits(values: np.ndarray) -> np.ndarray | None:
    """Nanoseconds of a day of numbers such as 125959.98, which 130000.00 follows; None for any others."""
    if values.dtype.kind not in "fi" or not ((values >= 0) & (values < 240000)).all():
        return None
    whole = np.floor(values).astype(np.int64)
    minutes, seconds = whole // 100 % 100, whole % 100
    stamps = (whole // 10000 * 60 + minutes) * 60 * 10**9 + np.round((values - whole + seconds) * 1e9).astype(np.int64)
    steps = np.diff(stamps) % _DAY
    if max(minutes.max(initial=0), seconds.max(initial=0)) >= 60 or not (steps > 0).any():
        return None
    carried = steps[np.diff(whole // 100) != 0]
    return stamps if len(carried) and np.median(carried) < _CARRY * np.median(steps[steps > 0]) else None


def _between(values: np.ndarray, end: int) -> bool:
    """Whether a column holds whole numbers from 0 to an end."""
    return bool(values.dtype.kind == "i" and (values >= 0).all() and (values < end).all())


def _seconds(values: np.ndarray) -> np.ndarray | None:
    """A column's whole seconds, also where they are written in nanoseconds; None for anything else."""
    if values.dtype.kind == "i" and (values % 10**9 == 0).all():
        values = values // 10**9
    return values if _between(values, _LATEST) else None


def _in_step(seconds: np.ndarray, rest: np.ndarray) -> bool:
    """Whether seconds rise where what is left of them falls, and hardly anywhere else."""
    falls, rises = np.diff(rest) < 0, np.diff(seconds) > 0
    return bool(falls.any() and rises[falls].all() and (rises & ~falls).sum() <= _GAPS * falls.sum())
