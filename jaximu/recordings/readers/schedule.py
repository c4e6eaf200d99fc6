"""What a set-up says of a recording: a turntable schedule, named sections, or reference columns in a file of their own.

A schedule is a CSV `start [s],stop [s],kind,x,y,z,angle [deg],heading [deg]` on the log's clock; `kind` is `pose` (x,
y, z is "up" in the body frame) or `turn` (x, y, z is the axis, right-hand rule). Sections are named as in Ferraris'
procedure: `x_p` (x up), `x_a` (x down), `x_rot` (turn about x), in a JSON document {name: {"start": row, "end": row,
"angle [deg]": …}} counting the log's samples from 0, the end not included, or in a column `part` of the log.
"""

import csv
import json
import math
import os
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from jaximu.ground.errors import FilePath, InputError, readable
from jaximu.ground.units import parse_column, unit
from jaximu.recordings.attitude import UNIT_LENGTH
from jaximu.recordings.columns.known import whole_stamps
from jaximu.recordings.columns.names import GROUPS, header_columns
from jaximu.recordings.entry import ScheduleEntry
from jaximu.recordings.readers.reader import extract, read_table
from jaximu.recordings.recording import ReadOptions, Recording

_FIELDS = "start stop kind x y z angle heading".split()
_QUANTITIES = {"start": "time", "stop": "time", "angle": "angle", "heading": "angle"}
_Columns = dict[str, tuple[int, float]]
"""The place of each column, and the factor that takes it to SI."""
_REFERENCES = ("table_angle", "table_rate", "attitude")


def read_reference(path: FilePath, recording: Recording) -> tuple[ScheduleEntry, ...] | Recording:
    """Return the entries of a schedule or of named sections; or the recording with the reference columns of the file.

    Entries are on the recording's own clock, seconds since `recording.start`. Raises InputError naming file and row.
    """
    name = os.fspath(path)
    text = _text(name)
    if text.lstrip().startswith("{"):
        return _sections(_json_sections(text, name, len(recording.accelerometer)), name, recording)
    first = next(iter(text.lstrip().splitlines()), "")
    header = [parse_column(cell)[0].lower() for cell in next(csv.reader([first]), [])]
    if "kind" in header:
        entries = read_schedule(name)
        return tuple(replace(e, start=e.start - recording.start, stop=e.stop - recording.start) for e in entries)
    if "part" in header:
        sections = _marked_sections(text, header.index("part"), name, len(recording.accelerometer))
        return _sections(sections, name, recording)
    table = whole_stamps(read_table(name))
    columns = header_columns(table) or ()
    groups = {group for group in _REFERENCES if any(c.name in GROUPS[group].columns for c in columns)}
    if not groups:
        raise InputError(
            f"{name}: is no reference: it has neither the columns of a schedule ({', '.join(_FIELDS[:6])}, …), nor a "
            "column part, nor table_angle, table_rate or attitude_w, attitude_x, attitude_y, attitude_z."
        )
    part = extract(table, columns, ReadOptions(rate=recording.accelerometer.rate), groups)
    later = float(part.origin - recording.start) if any(c.name == "time" for c in columns) else 0.0
    fields = {GROUPS[key].field: replace(signal, time=signal.time + later) for key, signal in part.signals.items()}
    return replace(recording, **fields, sources=(*recording.sources, part.source))


def _text(name: str) -> str:
    with readable(name):
        return Path(name).read_bytes().decode("utf-8-sig", errors="replace")


def read_schedule(path: FilePath) -> tuple[ScheduleEntry, ...]:
    """Return the entries of a turntable schedule, on the log's clock, in order of time.

    Raises InputError naming the row for a cell that is missing or not understood, entries that overlap, and a header
    without units.
    """
    name = os.fspath(path)
    rows = enumerate(csv.reader(_text(name).splitlines()), 1)
    lines = [(row, cells) for row, cells in rows if any(cell.strip() for cell in cells)]
    if len(lines) < 2:
        raise InputError(f"{name}: holds no poses or turns.")
    columns = _columns(lines[0][1], name)
    entries = sorted((_entry(cells, columns, f"{name}, row {row}") for row, cells in lines[1:]), key=lambda e: e.start)
    _require_apart(entries)
    return tuple(entries)


def _columns(header: Sequence[str], name: str) -> _Columns:
    """The place of each column and the factor that takes it to SI."""
    columns: _Columns = {}
    for at, cell in enumerate(header):
        title, stated = parse_column(cell)
        title = title.strip().lower()
        if title not in _FIELDS or title in columns:
            what = "stands twice" if title in columns else f"is not known; known are {', '.join(_FIELDS)}"
            raise InputError(f"{name}, row 1: the column {cell.strip()!r} {what}.")
        quantity = _QUANTITIES.get(title)
        if quantity and not stated:
            example = "s" if quantity == "time" else "deg"
            raise InputError(
                f"{name}, row 1: the column {title} states no unit; write for example {title} [{example}]."
            )
        columns[title] = at, unit(stated or "1", quantity, file=name, column=title).factor if quantity else 1.0
    missing = [title for title in _FIELDS[:6] if title not in columns]
    if missing:
        raise InputError(f"{name}, row 1: the column {missing[0]} is missing; a schedule has {', '.join(_FIELDS)}.")
    return columns


def _entry(cells: Sequence[str], columns: _Columns, where: str) -> ScheduleEntry:
    def number(title: str, optional: bool = False) -> float:
        """NaN for an optional cell that is empty."""
        at, factor = columns.get(title, (len(cells), 1.0))
        cell = cells[at].strip() if at < len(cells) else ""
        if not cell and optional:
            return math.nan
        if not cell:
            raise InputError(f"{where}: column {title} is empty.")
        try:
            value = float(cell) * factor
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"{where}: column {title} holds {cell!r}, which is not a number.")
        return value

    kind = cells[columns["kind"][0]].strip().lower() if columns["kind"][0] < len(cells) else ""
    if kind not in ("pose", "turn"):
        raise InputError(f"{where}: kind is {kind!r}; it must be pose or turn.")
    start, stop = number("start"), number("stop")
    if stop <= start:
        raise InputError(f"{where}: stop ({stop:g} s) is not after start ({start:g} s).")
    vector = np.array([number(axis) for axis in "xyz"])
    length = np.linalg.norm(vector)
    if abs(length - 1) > UNIT_LENGTH:
        raise InputError(f"{where}: x, y, z has the length {length:.4g}; a direction has the length 1.")
    angle, heading = (number(title, optional=True) for title in ("angle", "heading"))
    angle = 0.0 if math.isnan(angle) else angle
    if kind == "turn" and angle == 0.0:
        raise InputError(f"{where}: a turn needs its angle.")
    if kind == "pose" and angle != 0.0:
        raise InputError(f"{where}: a pose has no angle; its heading goes into the column heading.")
    stated = kind == "pose" and not math.isnan(heading)
    return ScheduleEntry(start, stop, kind, vector / length, angle, heading if stated else None, where)


def _require_apart(entries: Sequence[ScheduleEntry]) -> None:
    for before, after in pairwise(entries):
        if (before.start, before.stop) == (after.start, after.stop):
            raise InputError(
                f"{after.label}: says of the same time ({after.start:g} to {after.stop:g} s) what {before.label} says "
                "otherwise: one interval stands under two names."
            )
        if after.start < before.stop - 1e-6:
            raise InputError(
                f"{after.label}: begins at {after.start:g} s, before {before.label} ends ({before.stop:g} s)."
            )


# --- named sections -------------------------------------------------------------------------------------------------


_Sections = dict[str, tuple[int, int, float | None]]
"""By name: first sample, the one after the last, and the angle in rad, where it is stated."""


def _json_sections(text: str, name: str, count: int) -> _Sections:
    try:
        document: Any = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"{name}, row {error.lineno}: is no JSON document ({error.msg}).") from None
    sections: _Sections = {}
    for section, fields in document.items():
        where = f"{name}, section {section}"
        if not isinstance(fields, dict) or not all(isinstance(fields.get(key), int) for key in ("start", "end")):
            raise InputError(f"{where}: must have whole numbers start and end, the log's samples counted from 0.")
        angle = fields.get("angle [deg]")
        unknown = sorted(set(fields) - {"start", "end", "angle [deg]"})
        if unknown or not isinstance(angle, int | float | None):
            key = unknown[0] if unknown else "angle [deg]"
            raise InputError(
                f'{where}: {key!r} is not understood; a section has "start", "end" and, of a turn, "angle [deg]".'
            )
        first, last = fields["start"], fields["end"]
        if not 0 <= first < last <= count:
            raise InputError(f"{where}: {first} to {last} is no part of the log's {count} samples.")
        sections[section] = first, last, None if angle is None else math.radians(angle)
    return sections


def _marked_sections(text: str, column: int, name: str, count: int) -> _Sections:
    rows = [cells for cells in csv.reader(text.splitlines()) if cells][1:]
    if len(rows) != count:
        raise InputError(f"{name}: has {len(rows)} rows, but the log {count} samples: the column part must mark each.")
    parts = [cells[column].strip() if column < len(cells) else "" for cells in rows]
    edges = [0, *(k for k in range(1, count) if parts[k] != parts[k - 1]), count]
    sections: _Sections = {}
    for first, last in pairwise(edges):
        if not parts[first]:
            continue
        if parts[first] in sections:
            raise InputError(f"{name}, row {first + 2}: section {parts[first]} begins for the second time.")
        sections[parts[first]] = first, last, None
    return sections


def _sections(sections: _Sections, name: str, recording: Recording) -> tuple[ScheduleEntry, ...]:
    wanted = [f"{axis}_{kind}" for axis in "xyz" for kind in ("p", "a", "rot")]
    missing = [section for section in wanted if section not in sections]
    if missing:
        raise InputError(f"{name}: the section {missing[0]} is missing; Ferraris' procedure has {', '.join(wanted)}.")
    time, half = recording.accelerometer.time, 0.5 / recording.accelerometer.rate
    entries = []
    for section, (first, last, angle) in sections.items():
        where = f"{name}, section {section}"
        if section not in wanted:
            raise InputError(f"{where}: is not known; Ferraris' procedure has {', '.join(wanted)}.")
        axis = np.eye(3)["xyz".index(section[0])] * (-1 if section.endswith("a") else 1)
        kind, turned = ("turn", math.nan if angle is None else angle) if "rot" in section else ("pose", 0.0)
        span = float(time[first] - half), float(time[last - 1] + half)
        entries.append(ScheduleEntry(*span, kind, axis, turned, label=where))
    entries.sort(key=lambda entry: entry.start)
    _require_apart(entries)
    return tuple(entries)
