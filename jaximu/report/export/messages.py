"""A corrected recording as messages of ROS 2: one MCAP file, which Foxglove, PlotJuggler and rerun open, or a bag.

Topics: `/imu/raw` and `/imu/corrected` (`sensor_msgs/Imu`), temperature and field where they were recorded;
`/imu/residual` (`std_msgs/Float64`), the corrected specific force's magnitude less local gravity, m/s², which is zero
at rest; and `/diagnostics`, once, what calibration it is and what was found with it. A quantity that a message does not
hold has −1 at the head of its covariance, as `sensor_msgs/Imu` asks; a triad in raw counts is a `Vector3Stamped`. What
began before the clock's zero is moved to begin there: stamps of ROS are not negative.
"""

from __future__ import annotations

import heapq
import os
import secrets
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from jaximu.calibration import Calibration
from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import FilePath, InputError
from jaximu.ground.vectors import lengths_of
from jaximu.recordings.recording import Recording, Signal

_NOT_HELD = -1.0
_RATE, _FORCE = 13, 25  # places of a sensor_msgs/Imu's quantities among its 37 doubles; each is followed by covariance
_TESLA = 1e-6
_CDR, _FRAME = b"\0\1\0\0", b"\4\0\0\0imu\0"
"""How a little-endian message begins, and the frame "imu" as a header has it."""


@dataclass(frozen=True)
class _Stream:
    """Messages of one topic. numbers (n, k): the doubles a message ends with, its covariances included."""

    topic: str
    kind: str
    time: FloatArray
    numbers: FloatArray


def is_messages(path: FilePath) -> bool:
    """Whether a path asks for messages: an .mcap file, or a folder, which a bag of ROS 2 is."""
    return Path(path).suffix.lower() in (".mcap", "")


def write_messages(calibration: Calibration, raw: Recording, corrected: Recording, path: FilePath) -> None:
    """Write a recording before and after its correction, whole or not at all: `NAME.mcap`, or NAME, a bag's folder.

    Raises `InputError` where rosbags is not installed, the folder exists, or the path cannot be written.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError:
        raise InputError(
            f"{os.fspath(path)}: messages of ROS need the package rosbags: pip install 'jaximu[formats]'."
        ) from None
    types = get_typestore(Stores.ROS2_HUMBLE)
    target = Path(path)
    one_file = bool(target.suffix)
    if not one_file and target.exists():
        raise InputError(f"{target} exists: name a new folder for the bag, or a file NAME.mcap.")
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(4)}")
    streams = [*_streams("/imu/raw", raw), *_streams("/imu/corrected", corrected), *_residual(calibration, corrected)]
    start = round(Fraction(raw.start) * 10**9)
    first = round(1e9 * min(float(stream.time[0]) for stream in streams))
    start = max(start, -first)  # stamps of ROS are not negative
    first += start
    try:
        with Writer(temporary, version=8, storage_plugin=StoragePlugin.MCAP) as bag:
            kinds = {stream.topic: stream.kind for stream in streams} | {"/diagnostics": _STATUS}
            topics = {topic: bag.add_connection(topic, kind, typestore=types) for topic, kind in kinds.items()}
            bag.write(topics["/diagnostics"], first, _status(calibration, types, first))
            messages = (_messages(stream, start) for stream in streams)
            for stamp, topic, content in heapq.merge(*messages, key=itemgetter(0)):
                bag.write(topics[topic], stamp, content)
        (next(temporary.glob("*.mcap")) if one_file else temporary).replace(target)
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error.strerror or error}.") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


_STATUS = "diagnostic_msgs/msg/DiagnosticArray"


def _streams(topic: str, recording: Recording) -> Iterator[_Stream]:
    held = []
    for name in ("accelerometer", "gyroscope"):
        signal = recording.signals.get(name)
        if signal is not None and signal.unit == "count":
            yield _Stream(f"{topic}/{name}", "geometry_msgs/msg/Vector3Stamped", signal.time, signal.values)
        elif signal is not None:
            held.append((name, signal))
    if len(held) == 2 and np.array_equal(held[0][1].time, held[1][1].time):
        yield _imu(topic, dict(held))
    else:
        for name, signal in held:
            yield _imu(topic if len(held) == 1 else f"{topic}/{name}", {name: signal})
    field = recording.magnetometer
    temperature = recording.temperature
    if field is not None and field.unit == "uT":
        numbers = np.hstack([_TESLA * field.values, np.zeros((len(field), 9))])
        yield _Stream(f"{topic}/field", "sensor_msgs/msg/MagneticField", field.time, numbers)
    if temperature is not None and topic == "/imu/raw":
        numbers = np.hstack([temperature.values, np.zeros((len(temperature), 1))])
        yield _Stream("/imu/temperature", "sensor_msgs/msg/Temperature", temperature.time, numbers)


def _imu(topic: str, signals: dict[str, Signal]) -> _Stream:
    time = next(iter(signals.values())).time
    numbers = np.zeros((len(time), 37))
    numbers[:, 3], numbers[:, 4] = 1.0, _NOT_HELD  # no attitude
    for name, column in (("gyroscope", _RATE), ("accelerometer", _FORCE)):
        if name in signals:
            numbers[:, column : column + 3] = signals[name].values
        else:
            numbers[:, column + 3] = _NOT_HELD
    return _Stream(topic, "sensor_msgs/msg/Imu", time, numbers)


def _residual(calibration: Calibration, corrected: Recording) -> Iterator[_Stream]:
    signal = corrected.signals.get("accelerometer")
    if signal is not None and signal.unit == "m/s^2":
        off = lengths_of(signal.values) - calibration.gravity.value
        yield _Stream("/imu/residual", "std_msgs/msg/Float64", signal.time, off[:, None])


def _messages(stream: _Stream, start: int) -> Iterator[tuple[int, str, bytes]]:
    """Yield stamp (ns), topic and bytes (CDR) of each message: its stamp and the name of the frame, then numbers."""
    stamps = start + np.round(1e9 * stream.time).astype(np.int64)
    seconds = np.stack(np.divmod(stamps, 10**9), axis=1).astype("<u4")
    headed = stream.kind != "std_msgs/msg/Float64"
    for stamp, second, row in zip(stamps, seconds, stream.numbers.astype("<f8"), strict=True):
        yield int(stamp), stream.topic, _CDR + (second.tobytes() + _FRAME) * headed + row.tobytes()


def _status(calibration: Calibration, types: Any, stamp: int) -> bytes:
    known = types.types
    verdict = str((calibration.diagnosis or {}).get("verdict", "not diagnosed"))
    level = 0 if verdict in ("adequate", "effects") else 1
    facts = {
        "verdict": verdict,
        "method": calibration.method,
        "local gravity, m/s^2": calibration.gravity.value,
        "hash of calibration.json": calibration.digest,
        **(calibration.trace or {}),
    }
    values = [known["diagnostic_msgs/msg/KeyValue"](key, str(value)) for key, value in facts.items() if value]
    serial = str((calibration.trace or {}).get("serial", ""))
    header = known["std_msgs/msg/Header"](known["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9)), "imu")
    status = known["diagnostic_msgs/msg/DiagnosticStatus"](level, "jaximu calibration", verdict, serial, values)
    return bytes(types.serialize_cdr(known[_STATUS](header, [status]), _STATUS))
