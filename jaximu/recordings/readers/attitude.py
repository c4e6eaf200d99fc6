"""A reference's attitude from a file: quaternions, rotation vectors or angles, with velocity or position."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import FilePath, InputError
from jaximu.ground.units import parse_column, unit
from jaximu.recordings.attitude import Attitude
from jaximu.recordings.columns.habits import fields_of, last_of
from jaximu.recordings.columns.known import whole_stamps
from jaximu.recordings.columns.names import TIME, header_columns
from jaximu.recordings.columns.table import LogTable
from jaximu.recordings.readers.reader import read_tables

_HABITS = {
    "time": (r".*(?:time|stamp).*",),
    "quaternion": (
        r".*(?:attitude|quat(?:ernion)?|orientation|rotation)_?([wxyz])",
        r"(?:.*_)?q(?:_[a-z]+)?_?([wxyz])",
    ),
    "numbered": (r"(?:.*_)?q(?:uat(?:ernion)?)?_?([0-3])",),
    "euler": (r"(?:.*_)?(roll|pitch|yaw)(?:_.*)?",),
    "rotation vector": (r".*(?:rotvec|rotation_vector)_?([xyz])",),
    "table angles": (r"table_angle_([xyz])",),
    "velocity": (r".*(?:velocity|vel)_?([xyzenu])", r"(?:.*_)?v(?:_rs_r)?_?([xyzenu])"),
    "position": (r".*(?:position|pos|translation)_?([xyzenu])", r"(?:.*_)?[pt](?:_rs_r)?_?([xyzenu])"),
}
"""Names of columns, lower case with anything else between as "_"; the group is the axis."""
_TUM = ("time [s]", "tx [m]", "ty [m]", "tz [m]", "qx", "qy", "qz", "qw")
_FACTORS = {
    "m/s": 1.0,
    "km/h": 1 / 3.6,
    "cm/s": 1e-2,
    "mm/s": 1e-3,
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "km": 1e3,
    "ft": 0.3048,
}
"""Units of velocity and position in SI."""
_Places = dict[str, dict[str, int]]
"""By kind the column of each axis."""
_EPOCHS = ((1e17, 1e-9, "ns"), (1e14, 1e-6, "µs"), (1e11, 1e-3, "ms"))
"""Stamps above these count since 1970 in the unit named."""


def read_attitude(path: FilePath) -> Attitude:
    """Read what a reference says of a body's attitude, from the body to a frame whose z points up.

    A table (CSV, Parquet, MAT, …) with a column for each of: time; a quaternion (qw … qz, attitude_w …, or q0 … q3 with
    w first), or roll, pitch and yaw (turned about z, then y, then x, by yaw, pitch, roll), or a rotation vector, or the
    angles of a table of two or three axes on which the body is mounted once (table_angle_x …, outermost axis first);
    and if known velocity or position. Eight columns without names are TUM's (time, position, quaternion with w last).
    Raises InputError naming the file and what is missing.
    """
    name = os.fspath(path)
    for table, places in _tables(path):
        return _attitude(table, places, name)
    raise InputError(
        f"{name}: holds no attitude: name columns qw, qx, qy, qz (or roll, pitch, yaw with their unit), and time [s]."
    )


def holds_attitude(path: FilePath) -> bool:
    """Return whether a file has columns of an attitude. Raises `InputError` where it cannot be read."""
    return bool(_tables(path))


def _tables(path: FilePath) -> list[tuple[LogTable, _Places]]:
    """Return the tables of a file that hold an attitude, and where their columns are."""
    tables = [(table, _places(table)) for table in map(_named, map(whole_stamps, read_tables(path)))]
    kinds = {"quaternion", "numbered", "euler", "rotation vector", "table angles"}
    return [(table, places) for table, places in tables if kinds & set(places)]


def _named(table: LogTable) -> LogTable:
    """Return the table, with TUM's names where it has none and as many columns."""
    if table.names is not None or len(table.columns) != len(_TUM):
        return table
    note = f"{table.path}: eight columns without names are taken as time, position and quaternion with w last."
    return replace(table, names=_TUM).noted(note)


def _places(table: LogTable) -> _Places:
    """Return by kind the columns of each axis, complete kinds alone."""
    kinds: _Places = {}
    for at, name in enumerate(table.header):
        plain = re.sub(r"[^a-z0-9]+", "_", re.sub(r"[\[(].*", "", name.lower())).strip("_")
        for kind, patterns in _HABITS.items():
            match = next(filter(None, (re.fullmatch(pattern, plain) for pattern in patterns)), None)
            if match is not None:
                axis = match.group(1) if match.groups() else ""
                kinds.setdefault(kind, {}).setdefault({"e": "x", "n": "y", "u": "z"}.get(axis, axis), at)
                break
    for at, column in enumerate(header_columns(table) or ()):
        if column.name == TIME:
            kinds["time"] = {"": at}
    complete = {"time": {""}, "quaternion": set("wxyz"), "numbered": set("0123"), "euler": {"roll", "pitch", "yaw"}}

    def whole(kind: str, axes: dict[str, int]) -> bool:
        # one angle leaves a body that is mounted again for each axis: that is a rate table's schedule
        return len(axes) > 1 if kind == "table angles" else set(axes) >= complete.get(kind, set("xyz"))

    return {kind: axes for kind, axes in kinds.items() if whole(kind, axes)}


def _columns(table: LogTable, places: dict[str, int], axes: Sequence[str], quantity: str = "") -> FloatArray:
    """Return the columns (n, k) of some axes in SI; a column without a unit is in SI."""
    columns = []
    for axis in axes:
        at = places[axis]
        title = table.header[at]
        stated, factor = parse_column(title)[1], 1.0
        if stated and quantity == "angle":
            factor = unit(stated, (quantity,), file=table.path, column=title).factor
        elif stated and quantity:
            if stated not in _FACTORS:
                raise InputError(f"{table.path}, column {title!r}: unknown unit; known are {', '.join(_FACTORS)}.")
            factor = _FACTORS[stated]
        columns.append(table.numbers(at) * factor)
    return np.stack(columns, axis=1)


def _attitude(table: LogTable, places: _Places, name: str) -> Attitude:
    notes = list(table.notes)
    time, start = _time(table, places, name, notes)
    if "quaternion" in places:
        quaternion = _columns(table, places["quaternion"], "wxyz")
    elif "numbered" in places:
        quaternion = _columns(table, places["numbered"], "0123")
    elif "euler" in places:
        quaternion = _from_angles(table, places["euler"], {"yaw": "z", "pitch": "y", "roll": "x"}, name)
        notes.append(f"{name}: roll, pitch and yaw are taken as turns by yaw about z, then pitch about y, then roll.")
    elif "table angles" in places:
        axes = sorted(places["table angles"], key=places["table angles"].__getitem__)
        quaternion = _from_angles(table, places["table angles"], {axis: axis for axis in axes}, name)
        notes.append(f"{name}: the table's angles are taken as turns about {', then '.join(axes)}, outermost first.")
    else:
        vector = _columns(table, places["rotation vector"], "xyz", "angle")
        quaternion = _quaternion(scipy.spatial.transform.Rotation.from_rotvec(vector))
    vectors = {kind: _columns(table, places[kind], "xyz", kind) for kind in ("velocity", "position") if kind in places}
    kept = np.isfinite(np.column_stack([time, quaternion, *vectors.values()])).all(axis=1)
    if kept.sum() < 16:
        raise InputError(f"{name}: {int(kept.sum())} rows hold an attitude, too few to compare with.")
    if not kept.all():
        notes.append(f"{name}: {np.sum(~kept)} of {kept.size} rows hold no attitude and are left out.")
    vectors = {kind: values[kept] for kind, values in vectors.items()}
    return Attitude(time[kept], quaternion[kept], **vectors, start=start, name=name, notes=tuple(notes))


def _from_angles(table: LogTable, places: dict[str, int], axes: dict[str, str], name: str) -> FloatArray:
    """Return the quaternions (n, 4) of turns by the columns named, each about its axis as the ones before left it."""
    for title in (table.header[places[column]] for column in axes):
        if parse_column(title)[1] is None:
            raise InputError(f"{name}: {title} states no unit: name it {title} [deg] or {title} [rad].")
    angles = _columns(table, places, tuple(axes), "angle")
    return _quaternion(scipy.spatial.transform.Rotation.from_euler("".join(axes.values()).upper(), angles))


def _time(table: LogTable, places: _Places, name: str, notes: list[str]) -> tuple[FloatArray, float]:
    """Return stamps (n,) in s since the first, and the first one's absolute stamp, s; zero where there is none."""
    if "time" not in places:
        if table.rate is None:
            raise InputError(f"{name}: has no time column: name it time [s].")
        return np.arange(len(table.columns[0])) / table.rate, 0.0
    at = places["time"][""]
    stamps = table.numbers(at)
    stated = fields_of(table.header)[at].unit or last_of(table.header[at])[1]
    if stated is None:
        factor, unit_name = next(
            ((factor, unit_name) for least, factor, unit_name in _EPOCHS if stamps[0] > least), (1.0, "s")
        )
        notes.append(f"{name}: the stamps state no unit and are taken as {unit_name}.")
    else:
        factor = unit(stated, ("time",), file=table.path, column="time").factor
    first = stamps[0]
    return np.asarray((stamps - first) * factor, float), float(first) * factor


def _quaternion(rotation: scipy.spatial.transform.Rotation) -> FloatArray:
    return np.asarray(rotation.as_quat(scalar_first=True), float)
