"""ArduPilot's DataFlash logs (binary, and their text form) through pymavlink: `IMU`, or the raw `ACC` and `GYR`.

Units and axes as ArduPilot's log documentation states them: µs, m/s², rad/s, °C, axes forward, right, down. Older logs
name instances IMU2, ACC1 …, newer ones hold them in the field I.
"""

from __future__ import annotations

import io
import os
from array import array
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from jaximu.ground.errors import InputError
from jaximu.recordings.columns.table import MessageSelection, Table
from jaximu.recordings.recording import Source

_ACCEL = {f"Acc{axis.upper()}": f"accel_{axis} [m/s^2]" for axis in "xyz"}
_GYRO = {f"Gyr{axis.upper()}": f"gyro_{axis} [rad/s]" for axis in "xyz"}
_LATEST = 2.0**53  # us: beyond it a double is no exact stamp
_KINDS = {"IMU": _ACCEL | _GYRO | {"T": "temperature [degC]"}, "ACC": _ACCEL, "GYR": _GYRO}


def read(path: Path, source: Source, selection: MessageSelection) -> tuple[Table, ...]:
    """The tables in a DataFlash log. Raises InputError for a message or an instance that it does not have."""
    from pymavlink.DFReader import DFReader_binary, DFReader_text

    with path.open("rb") as file:
        binary = file.read(1) == b"\xa3"
    with _silent() as silent:
        kind = DFReader_binary if binary else DFReader_text
        log: Any = kind.__new__(kind)  # in two steps: it opens the file, and may fail thereafter
        try:
            log.__init__(str(path))
            rows = _rows(log)
        finally:
            if hasattr(log, "filehandle"):
                log.filehandle.close()
    places = sorted({place for _, place in rows})
    place = selection.instance if selection.instance is not None else (places or [0])[0]
    counts = {kind: len(rows[kind, place]) for kind in _KINDS if (kind, place) in rows}
    raw = min(counts.get("ACC", 0), counts.get("GYR", 0))
    if not counts or (raw == 0 and "IMU" not in counts):
        raise InputError(
            f"{source.path}: has no IMU messages, and no ACC with GYR, of instance {place}"
            + (f"; there are instances {', '.join(map(str, places))} (--instance)." if places else
               "; set LOG_BITMASK to log the IMU, or INS_RAW_LOG_OPT for every sample.")
        )  # fmt: skip
    topic = (selection.topic or ("ACC" if raw > counts.get("IMU", 0) else "IMU")).upper()
    if topic not in counts:
        raise InputError(f"{source.path}: --topic {selection.topic}: there are {', '.join(counts)} here.")
    notes = [
        "ArduPilot axes are forward, right, down (gravity reads about -9.8 on z at rest): --axes FRD turns them.",
        f"read: {'ACC and GYR' if topic != 'IMU' else 'IMU'}, instance {place}"
        + (f" of {', '.join(map(str, places))} (--instance)" if len(places) > 1 else "")
        + ("; there are also ACC and GYR, every sample (--topic ACC)" if topic == "IMU" and raw else "")
        + ".",
        "ArduPilot has corrected these values by its INS_ parameters, rotations included: they are not the raw output.",
    ]
    if "bad" in silent.getvalue().lower() or "unknown msg" in silent.getvalue():
        notes.append("parts of the file are damaged and were left out.")
    kinds = ("IMU",) if topic == "IMU" else ("ACC", "GYR")
    tables = []
    for kind in kinds:
        if (kind, place) in rows:
            time, values = rows[kind, place][:, 0 if selection.stamp == "receive" else 1], rows[kind, place][:, 2:].T
            tables.append(_table(source, time, dict(zip(_KINDS[kind].values(), values, strict=True))))
    if topic != "IMU" and ("IMU", place) in rows:  # the temperature is there alone
        heat = rows["IMU", place]
        tables.append(_table(source, heat[:, 0], {"temperature [degC]": heat[:, -1]}))
    return replace(tables[0], notes=tuple(notes), frame="FRD"), *tables[1:]


@contextmanager
def _silent() -> Iterator[io.StringIO]:
    """What pymavlink prints about corrupt parts; its compiled indexer, which prints past Python, goes unheard."""
    text = io.StringIO()
    with redirect_stdout(text), redirect_stderr(text):
        kept, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, 2)
        try:
            yield text
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            os.close(nothing)


def _rows(log: Any) -> dict[tuple[str, int], np.ndarray]:
    """By kind and instance, the rows: TimeUS, SampleUS (or TimeUS), then the fields of `_KINDS`."""
    known = {each.name: list(each.columns) for each in log.formats.values()}
    kinds = {f"{kind}{number}": kind for kind in _KINDS for number in ("", "1", "2", "3")}
    fields = {
        name: ("TimeUS", "SampleUS" if "SampleUS" in known[name] else "TimeUS", *_KINDS[kind])
        for name, kind in kinds.items()
        if name in known and {"TimeUS", *_KINDS[kind]} <= set(known[name])
    }
    # the fields by place: by name, each one costs as much as the whole message
    taken = {name: itemgetter(*(known[name].index(each) for each in wanted)) for name, wanted in fields.items()}
    instance = {name: known[name].index("I") for name in fields if "I" in known[name]}
    found: dict[tuple[str, int], array[float]] = {}
    wanted = set(fields)
    while wanted and (message := log.recv_match(type=wanted, strict=True)) is not None:
        name, values = message.get_type(), message._elements
        place = int(values[instance[name]]) if name in instance else max(int(name[3:] or 1) - 1, 0)
        found.setdefault((kinds[name], place), array("d")).extend(map(float, taken[name](values)))
    return {(kind, place): np.array(rows).reshape(-1, 2 + len(_KINDS[kind])) for (kind, place), rows in found.items()}


def _table(source: Source, time: np.ndarray, values: dict[str, np.ndarray]) -> Table:
    if not (np.abs(time) < _LATEST).all():
        raise ValueError("a time stamp is no number of microseconds")
    columns = (time.astype(np.int64), *(np.ascontiguousarray(each, np.float64) for each in values.values()))
    return Table(source, ("time [us]", *values), columns, messages=True)
