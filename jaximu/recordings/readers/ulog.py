"""PX4's ULog through pyulog: the densest of `sensor_accel` with `sensor_gyro` (every sample where their FIFOs are
logged), `sensor_combined`, and `vehicle_imu`.

Units and axes as PX4's message definitions state them: µs, m/s², rad/s, °C, axes forward, right, down.
"""

from __future__ import annotations

import io
from collections.abc import Collection, Iterator, Mapping
from contextlib import redirect_stdout
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jaximu.ground.quantities import counted
from jaximu.ground.units import SENSORS
from jaximu.recordings.columns.table import LogTable
from jaximu.recordings.recording import ReadOptions, Source

_Fields = Mapping[str, np.ndarray]
_DEEPEST_FIFO = 32  # samples of a message
_FIELDS, _DEEPEST = 4096, 16  # that a message's definition may have, and levels of those within it


_Samples = tuple[np.ndarray, list[np.ndarray]]
"""Time, and the columns of x, y and z."""


def _stamps(data: _Fields, stamp: str) -> np.ndarray:
    return data.get("timestamp_sample", data["timestamp"]) if stamp == "header" else data["timestamp"]


def _raw(data: _Fields, stamp: str) -> _Samples:
    return _stamps(data, stamp), [data[axis] for axis in "xyz"]


def _combined_gyro(data: _Fields, stamp: str) -> _Samples:
    return data["timestamp"], [data[f"gyro_rad[{at}]"] for at in range(3)]


def _combined_accel(data: _Fields, stamp: str) -> _Samples:
    """The accelerometer's stamp is relative to the gyroscope's; INT32_MAX says that there is no sample."""
    offset = data["accelerometer_timestamp_relative"].astype(np.int64)
    valid = offset != 2**31 - 1
    values = [data[f"accelerometer_m_s2[{at}]"][valid] for at in range(3)]
    return (data["timestamp"].astype(np.int64) + offset)[valid], values


def _increments(data: _Fields, stamp: str, kind: str) -> _Samples:
    """The means over the interval of each increment."""
    interval = data[f"{kind}_dt"] * 1e-6
    valid = interval > 0.0
    return _stamps(data, stamp)[valid], [data[f"{kind}[{at}]"][valid] / interval[valid] for at in range(3)]


def _fifo(data: _Fields, stamp: str) -> _Samples:
    """All samples since the message before, `dt` µs apart, the last one at the message's stamp (PX4-Autopilot,
    src/lib/drivers/gyroscope/PX4Gyroscope.cpp: what it averages into `sensor_gyro` ends with it). Time is in ns.
    """
    index = np.arange(_DEEPEST_FIFO)
    count, step, scale = (data[name][:, None] for name in ("samples", "dt", "scale"))
    valid = index < count
    time = data["timestamp_sample" if stamp == "header" else "timestamp"].astype(np.int64)
    before = (count.astype(np.int64) - 1 - index) * step.astype(float)
    samples = (np.stack([data[f"{axis}[{at}]"] for at in index], 1) for axis in "xyz")
    values = [(output * scale.astype(float))[valid] for output in samples]
    return (time[:, None] * 1000 - np.rint(1e3 * before).astype(np.int64))[valid], values


_SOURCES = {
    "sensor_accel_fifo": (("sensor_accel_fifo", _fifo), ("sensor_gyro_fifo", _fifo)),
    "sensor_accel": (("sensor_accel", _raw), ("sensor_gyro", _raw)),
    "sensor_combined": (("sensor_combined", _combined_accel), ("sensor_combined", _combined_gyro)),
    "vehicle_imu": (
        ("vehicle_imu", partial(_increments, kind="delta_velocity")),
        ("vehicle_imu", partial(_increments, kind="delta_angle")),
    ),
}
"""By `--topic`: the messages of accelerometer and gyroscope, the raw ones first."""


def read(path: Path, source: Source, options: ReadOptions) -> tuple[LogTable, ...]:
    """The tables in a ULog. Raises InputError for a topic or an instance that it does not have."""
    log = _opened(path, {name for messages in _SOURCES.values() for name, _ in messages})
    logged = {
        (dataset.name, dataset.multi_id): dataset.data
        for dataset in log.data_list
        if len(dataset.data.get("timestamp", ())) > 1
    }
    first_names = {accel for (accel, _), _ in _SOURCES.values()}
    instances = sorted({instance for name, instance in logged if name in first_names})
    instance = options.instance if options.instance is not None else (instances or [0])[0]
    usable = {
        topic: min(_samples(logged[name, instance]) for name, _ in messages)
        for topic, messages in _SOURCES.items()
        if all((name, instance) in logged for name, _ in messages)
    }
    usable = {topic: count for topic, count in usable.items() if count > 1}
    if not usable:
        held = f"instances {', '.join(map(str, instances))}" if instances else "no such message"
        raise source.refused(
            f"has no sensor_accel with sensor_gyro (as they are, or _fifo), no sensor_combined and no "
            f"vehicle_imu of instance {instance} ({held}); choose with --instance, or log them (SDLOG_PROFILE, high "
            "rate sensors)."
        )
    if options.topic is not None and options.topic not in usable:
        raise source.refused(f"--topic {options.topic}: there are {', '.join(usable)} here.")
    topic = options.topic or max(usable, key=lambda name: usable[name])
    notes = ["PX4 axes are forward, right, down (gravity reads about -9.8 on z at rest): --axes FRD turns them."]
    others = [f"{name} ({count} samples)" for name, count in usable.items() if name != topic]
    more = f"; there are also {', '.join(others)} (--topic)" if others else ""
    more += f"; instances {', '.join(map(str, instances))} (--instance)" if len(instances) > 1 else ""
    notes.append(f"read: {topic}, instance {instance}, {usable[topic]} samples{more}.")
    if topic == "sensor_combined":
        notes.append("sensor_combined is what PX4 has corrected by its CAL_ and TC_ parameters, not the raw output.")
    elif topic == "vehicle_imu":
        notes.append("vehicle_imu holds increments, corrected by PX4: values are their means over each interval.")
    if log.dropouts:
        lost = sum(dropout.duration for dropout in log.dropouts)
        notes.append(f"the logger dropped messages for {lost / 1e3:.3g} s, in {counted(len(log.dropouts), 'dropout')}.")
    if log.file_corruption:
        notes.append("parts of the file are damaged and were left out.")
    tables = []
    for title, (name, samples) in zip(("accel_{} [m/s^2]", "gyro_{} [rad/s]"), _SOURCES[topic], strict=True):
        time, values = samples(logged[name, instance], options.stamp)
        unit = "ns" if name.endswith("_fifo") else "us"
        tables.append(_table(source, time, dict(zip(map(title.format, "xyz"), values, strict=True)), unit))
    heat = logged.get(("sensor_accel", instance), {})
    if "temperature" in heat:
        tables.append(_table(source, heat["timestamp"], {"temperature [degC]": heat["temperature"]}))
    sensors = {
        sensor: int(logged[name, instance][field][-1])
        for (prefix, sensor), (name, _) in zip(SENSORS.items(), _SOURCES[topic], strict=False)
        for field in ("device_id", f"{prefix}_device_id")
        if field in logged[name, instance]
    }
    corrected = topic in ("sensor_combined", "vehicle_imu")
    return replace(tables[0], notes=tuple(notes), frame="FRD", corrected=corrected, sensors=sensors), *tables[1:]


def parameters(path: Path) -> Iterator[tuple[str, float]]:
    """Yield name and value of the parameters that a ULog began with, and of those that changed in it."""
    log = _opened(path, {"parameter_update"})
    yield from log.initial_parameters.items()
    yield from ((name, value) for _, name, value in log.changed_parameters)


def _opened(path: Path, names: Collection[str]) -> Any:
    from pyulog import ULog

    with path.open("rb") as head, path.open("rb") as file, redirect_stdout(io.StringIO()):  # pyulog prints its findings
        _check_formats(ULog(head, parse_header_only=True).message_formats)
        return ULog(file, list(names))


def _samples(data: _Fields) -> int:
    """How many samples the messages of a sensor hold; of a FIFO without its scale, which old versions lack, none."""
    if "x[0]" not in data:
        return len(data["timestamp"])
    return int(np.minimum(data["samples"], _DEEPEST_FIFO).sum(dtype=np.int64)) if "scale" in data else 0


def _check_formats(formats: Mapping[str, Any]) -> None:
    """Raise ValueError for a definition of more fields than a message has bytes: pyulog makes an object of each."""
    counts: dict[str, int] = {}

    def count(name: str, depth: int) -> int:
        if depth > _DEEPEST:
            raise ValueError("definitions of messages are nested too deeply")
        if name not in counts:
            fields = formats[name].fields if name in formats else ()
            counts[name] = sum(max(size, 1) * count(kind, depth + 1) for kind, size, _ in fields) if fields else 1
        return counts[name]

    if max((count(name, 0) for name in formats), default=0) > _FIELDS:
        raise ValueError("a message is defined to have more fields than any has")


def _table(source: Source, time: np.ndarray, values: Mapping[str, np.ndarray], unit: str = "us") -> LogTable:
    if time.dtype.kind not in "iu":
        raise ValueError("a time stamp is no number of microseconds")
    with np.errstate(invalid="ignore"):  # of a NaN that signals
        columns = (time.astype(np.int64), *(column.astype(float, copy=False) for column in values.values()))
    return LogTable(source, (f"time [{unit}]", *values), columns, messages=True)
