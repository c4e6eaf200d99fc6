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

from jaximu.recordings.columns.table import LogTable
from jaximu.recordings.recording import ReadOptions, Source

_ACCEL = {f"Acc{axis.upper()}": f"accel_{axis} [m/s^2]" for axis in "xyz"}
_GYRO = {f"Gyr{axis.upper()}": f"gyro_{axis} [rad/s]" for axis in "xyz"}
_LATEST = 2.0**53  # us: beyond it a double is no exact stamp
_KINDS = {"IMU": _ACCEL | _GYRO | {"T": "temperature [degC]"}, "ACC": _ACCEL, "GYR": _GYRO}


def read(path: Path, source: Source, options: ReadOptions) -> tuple[LogTable, ...]:
    """The tables in a DataFlash log. Raises InputError for a message or an instance that it does not have."""
    with _opened(path) as (log, silent):
        rows = _rows(log)
    instances = sorted({instance for _, instance in rows})
    instance = options.instance if options.instance is not None else (instances or [0])[0]
    counts = {kind: len(rows[kind, instance]) for kind in _KINDS if (kind, instance) in rows}
    raw = min(counts.get("ACC", 0), counts.get("GYR", 0))
    if not counts or (raw == 0 and "IMU" not in counts):
        remedy = "set LOG_BITMASK to log the IMU, or INS_RAW_LOG_OPT for every sample"
        if instances:
            remedy = f"there are instances {', '.join(map(str, instances))} (--instance)"
        raise source.refused(f"has no IMU messages, and no ACC with GYR, of instance {instance}; {remedy}.")
    topic = (options.topic or ("ACC" if raw > counts.get("IMU", 0) else "IMU")).upper()
    if topic not in counts:
        raise source.refused(f"--topic {options.topic}: there are {', '.join(counts)} here.")
    notes = [
        "ArduPilot axes are forward, right, down (gravity reads about -9.8 on z at rest): --axes FRD turns them.",
        f"read: {'ACC and GYR' if topic != 'IMU' else 'IMU'}, instance {instance}"
        + (f" of {', '.join(map(str, instances))} (--instance)" if len(instances) > 1 else "")
        + ("; there are also ACC and GYR, every sample (--topic ACC)" if topic == "IMU" and raw else "")
        + ".",
        "ArduPilot has corrected these values by its INS_ parameters, rotations included: they are not the raw output.",
    ]
    if "bad" in silent.getvalue().lower() or "unknown msg" in silent.getvalue():
        notes.append("parts of the file are damaged and were left out.")
    tables = []
    for kind in ("IMU",) if topic == "IMU" else ("ACC", "GYR"):
        if (kind, instance) in rows:
            received, sampled, *values = rows[kind, instance].T
            time = received if options.stamp == "receive" else sampled
            tables.append(_table(source, time, dict(zip(_KINDS[kind].values(), values, strict=True))))
    if topic != "IMU" and ("IMU", instance) in rows:  # the temperature is there alone
        heat = rows["IMU", instance]
        tables.append(_table(source, heat[:, 0], {"temperature [degC]": heat[:, -1]}))
    sensors = {"accelerometer": instance, "gyroscope": instance}
    return replace(tables[0], notes=tuple(notes), frame="FRD", corrected=True, sensors=sensors), *tables[1:]


def parameters(path: Path) -> list[tuple[str, float]]:
    """Return name and value of the parameters in a DataFlash log (`PARM`), in the order in which they came."""
    with _opened(path) as (log, _):
        return [(message.Name, float(message.Value)) for message in iter(lambda: log.recv_match(type="PARM"), None)]


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, io.StringIO]]:
    """The log, and what pymavlink prints while it is open."""
    from pymavlink.DFReader import DFReader_binary, DFReader_text

    with path.open("rb") as file:
        binary = file.read(1) == b"\xa3"
    with _silent() as silent:
        kind = DFReader_binary if binary else DFReader_text
        log: Any = kind.__new__(kind)  # in two steps: it opens the file, and may fail thereafter
        try:
            log.__init__(str(path))
            yield log, silent
        finally:
            if hasattr(log, "filehandle"):
                log.filehandle.close()


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
    known = {message.name: list(message.columns) for message in log.formats.values()}
    kinds = {f"{kind}{number}": kind for kind in _KINDS for number in ("", "1", "2", "3")}
    fields = {
        name: ("TimeUS", "SampleUS" if "SampleUS" in known[name] else "TimeUS", *_KINDS[kind])
        for name, kind in kinds.items()
        if name in known and {"TimeUS", *_KINDS[kind]} <= set(known[name])
    }
    # the fields by position: by name, each one costs as much as the whole message
    taken = {name: itemgetter(*(known[name].index(title) for title in wanted)) for name, wanted in fields.items()}
    instances = {name: known[name].index("I") for name in fields if "I" in known[name]}
    rows: dict[tuple[str, int], array[float]] = {}
    wanted = set(fields)
    while wanted and (message := log.recv_match(type=wanted, strict=True)) is not None:
        name, values = message.get_type(), message._elements
        instance = int(values[instances[name]]) if name in instances else max(int(name[3:] or 1) - 1, 0)
        rows.setdefault((kinds[name], instance), array("d")).extend(map(float, taken[name](values)))
    return {key: np.array(numbers).reshape(-1, 2 + len(_KINDS[key[0]])) for key, numbers in rows.items()}


def _table(source: Source, time: np.ndarray, values: dict[str, np.ndarray]) -> LogTable:
    if not (np.abs(time) < _LATEST).all():
        raise ValueError("a time stamp is no number of microseconds")
    columns = (time.astype(np.int64), *(np.ascontiguousarray(column, float) for column in values.values()))
    return LogTable(source, ("time [us]", *values), columns, messages=True)
