"""ROS 1 and ROS 2 bags (sqlite3, MCAP) through rosbags: `sensor_msgs/Imu`, temperature and magnetometer beside it.

Messages are decoded by the frozen layout of these three definitions, never by the definitions in the bag: rosbags
makes Python code from those, and a bag is not trusted. In either wire format (ROS 1 serialization, and CDR with its
4-byte head) a stamp stands at byte 4 and the numbers, doubles, are the last part of the message.
"""

from __future__ import annotations

import io
import os
import tempfile
from bz2 import BZ2Decompressor
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaximu.ground.errors import InputError
from jaximu.recordings.columns.table import LogTable, Unpacking
from jaximu.recordings.recording import ReadOptions, Source

_BLOCK = 1 << 12  # messages held undecoded
_LONGEST = 1 << 12  # bytes of a message of these kinds, its frame's name included
_LONGEST_ROW = 64 << 20  # bytes of any message in an SQLite bag, pictures too
_ZSTD = b"\x28\xb5\x2f\xfd"


@dataclass(frozen=True)
class _Kind:
    """A message definition: its MD5 in ROS 1, its doubles at the end, and which of them are which columns.

    absent: by sensor the first element of a covariance; -1 says that the message does not hold this quantity.
    """

    md5: str
    doubles: int
    columns: dict[str, int]
    absent: dict[str, int] = field(default_factory=dict)

    @property
    def used(self) -> list[int]:
        """The doubles that are kept."""
        return [*self.columns.values(), *self.absent.values()]


_ACCEL = {f"accel_{axis} [m/s^2]": 25 + at for at, axis in enumerate("xyz")}
_GYRO = {f"gyro_{axis} [rad/s]": 13 + at for at, axis in enumerate("xyz")}
_MAG = {f"mag_{axis} [T]": at for at, axis in enumerate("xyz")}
_IMU = "sensor_msgs/msg/Imu"
_KINDS = {
    _IMU: _Kind("6a62c6daae103f4ff57a132d6f95cec2", 37, _GYRO | _ACCEL, {"accel": 28, "gyro": 16}),
    "sensor_msgs/msg/MagneticField": _Kind("2f3b0b43eed0c9501de0fa3ff89a45aa", 12, _MAG),
    "sensor_msgs/msg/Temperature": _Kind("ff71b307acdbe7c871a5a6d7ed359100", 2, {"temperature [degC]": 0}),
}


class _Path(type(Path())):
    """A path whose files, opened as bytes, make no room for more than they hold: bags state sizes, not all true."""

    def open(self, mode: str = "r", *more: Any, **named: Any) -> Any:
        return _File(self) if mode == "rb" else super().open(mode, *more, **named)


class _File(io.BufferedReader):
    def __init__(self, path: os.PathLike[str]):
        super().__init__(io.FileIO(path))
        self.size = os.stat(path).st_size

    def read(self, size: int | None = -1) -> bytes:
        return super().read(size if size is None else min(size, self.size))


def read_ros1(path: Path, source: Source, options: ReadOptions) -> tuple[LogTable, ...]:
    """The tables in a ROS 1 bag. Raises InputError where topics are missing or to be chosen."""
    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag1 import Reader
    from rosbags.rosbag1.reader import decompressors

    size = path.stat().st_size

    class Bounded(Reader):
        """Entries of an index are parts of the file: chunks that share one would multiply it."""

        indexed = 0

        def read_index_data(self, pos: int, indexes: Any) -> None:
            assert self.bio
            start = self.bio.tell()
            super().read_index_data(pos, indexes)
            self.indexed += self.bio.tell() - start
            if self.indexed > size:
                raise ValueError("chunks share an index")

    unpacking = Unpacking(source, size)
    with (
        _bounded(decompressors, {"bz2": BZ2Decompressor, "lz4": LZ4FrameDecompressor}, unpacking),
        Bounded(_Path(path)) as bag,
    ):
        return _read(bag, bag.messages, source, options, cdr=False)


def read_ros2(path: Path, source: Source, options: ReadOptions) -> tuple[LogTable, ...]:
    """The tables in a ROS 2 bag: its folder, or one .db3 or .mcap file."""
    import apsw
    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag2 import Reader
    from rosbags.rosbag2.storage_mcap import DECOMPRESSORS, zstd

    files = sorted(path.iterdir()) if path.is_dir() else [path]
    unpacking = Unpacking(source, sum(file.stat().st_size for file in files))
    for file in files:
        _check_packed(file, zstd, unpacking)
    methods = {"lz4": LZ4FrameDecompressor, "zstd": zstd.ZstdDecompressor}
    with _bounded(DECOMPRESSORS, methods, unpacking), _named(path) as named, Reader(_Path(named)) as bag:
        storage: Any = bag.storage
        for part in (storage, *getattr(storage, "storages", ())):
            if database := getattr(part, "dbconn", None):
                database.limit(apsw.SQLITE_LIMIT_LENGTH, _LONGEST_ROW)
        packed = bag.compression_mode == "message"
        storage.metadata = storage.metadata._replace(compression_mode=None)

        def messages(chosen: Sequence[Any]) -> Iterator[tuple[Any, int, bytes]]:
            for connection, stamp, data in bag.messages(chosen):
                yield connection, stamp, unpacking.unpack(zstd.ZstdDecompressor(), data)

        return _read(bag, messages if packed else bag.messages, source, options, cdr=True)


@contextmanager
def _bounded(
    table: dict[str, Callable[..., bytes]], methods: Mapping[str, Callable[[], Any]], unpacking: Unpacking
) -> Iterator[None]:
    """With the decompressors in a table of rosbags, which unpack all that they are given, made to stop in time."""
    kept = dict(table)
    table.update({name: lambda data, *_, make=make: unpacking.unpack(make(), data) for name, make in methods.items()})
    try:
        yield
    finally:
        table.update(kept)


def _check_packed(path: Path, zstd: Any, unpacking: Unpacking) -> None:
    """A file of a bag that is compressed as a whole, which rosbags unpacks on the disk, is counted beforehand."""
    if path.is_file():
        with path.open("rb") as file:
            if file.read(4) == _ZSTD:
                file.seek(0)
                with zstd.open(file) as content:
                    while block := content.read(1 << 20):
                        unpacking.take(len(block))


def _read(
    bag: Any, iterate: Callable[[Sequence[Any]], Iterator[Any]], source: Source, options: ReadOptions, cdr: bool
) -> tuple[LogTable, ...]:
    wanted = _wanted(bag.connections, source, options)
    kinds = {topic: kind for topic, kind, _ in wanted}
    chosen = [connection for connection in bag.connections if kinds.get(connection.topic) == connection.msgtype]
    for connection in chosen:
        if connection.digest and len(connection.digest) == 32 and connection.digest != _KINDS[connection.msgtype].md5:
            raise source.refused(f"topic {connection.topic} is a {connection.msgtype} of an unknown definition.")
    decoded = {topic: _Columns(_KINDS[kind], cdr) for topic, kind in kinds.items()}
    for connection, received, data in iterate(chosen):
        if len(data) > _LONGEST:
            raise ValueError("a message is not as its definition says")
        decoded[connection.topic].add(received, data)
    tables = (decoded[topic].table(source, topic, columns, options.stamp) for topic, _, columns in wanted)
    return tuple(table for table in tables if table)


@contextmanager
def _named(path: Path) -> Iterator[Path]:
    """The path under a suffix that rosbags takes: it goes by the name, where jaximu goes by the content."""
    suffix = None
    if path.is_file():
        with path.open("rb") as file:
            suffix = {b"SQLite": ".db3", b"\x89MCAP0": ".mcap"}.get(file.read(6))
    if suffix is None or path.suffix == suffix:
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / f"bag{suffix}"
        link.symlink_to(path.resolve())
        yield link


def _wanted(connections: Sequence[Any], source: Source, options: ReadOptions) -> list[tuple[str, str, dict[str, int]]]:
    """Topic, type and columns of each table: of the one topic of `sensor_msgs/Imu`, or of those asked for, of which
    the first has the accelerometer and the second the gyroscope; and of what goes with them.
    """
    imu = {connection.topic: connection for connection in connections if connection.msgtype == _IMU}
    listed = ", ".join(f"{topic} ({connection.msgcount} messages)" for topic, connection in imu.items()) or "none"
    if options.topic is not None:
        topics = [topic.strip() for topic in options.topic.split(",")]
        if unknown := [topic for topic in topics if topic not in imu]:
            raise source.refused(f"has no IMU topic {unknown[0]}; --topic can be {listed}.")
        if len(topics) > 2:
            raise InputError("--topic: give one topic, or the accelerometer's and the gyroscope's.")
    else:  # two may differ in nothing but these words (RealSense)
        topics = sorted(imu, key=lambda topic: "gyro" in topic)
        pair = len(topics) == 2 and "accel" in topics[0] and topics[0].replace("accel", "gyro") == topics[1]
        if len(topics) > 1 and not pair:
            raise source.refused(
                f"holds {len(imu)} IMU topics, {listed}: choose one with --topic, or the "
                "accelerometer's and the gyroscope's as --topic A,B."
            )
    if not topics:
        kinds = sorted({connection.msgtype.replace("/msg/", "/") for connection in connections})
        raise source.refused(f"holds no sensor_msgs/Imu; it holds {', '.join(kinds[:20]) or 'nothing'}.")
    parts = [_GYRO | _ACCEL] if len(topics) == 1 else [_ACCEL, _GYRO]
    wanted = [(topic, _IMU, columns) for topic, columns in zip(topics, parts, strict=True)]
    beside = topics[0].rsplit("/", 1)[0]
    for kind in tuple(_KINDS)[1:]:
        others = {
            connection.topic
            for connection in connections
            if connection.msgtype == kind and connection.topic.startswith(f"{beside}/")
        }
        wanted += [(topic, kind, _KINDS[kind].columns) for topic in others if len(others) == 1]
    return wanted


@dataclass
class _Columns:
    """The messages of a topic, decoded in blocks so that few are held as bytes."""

    kind: _Kind
    cdr: bool
    received: list[int] = field(default_factory=list)
    data: list[bytes] = field(default_factory=list)
    blocks: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=list)

    def add(self, received: int, data: bytes) -> None:
        self.received.append(received)
        self.data.append(data)
        if len(self.data) == _BLOCK:
            self.decode()

    def decode(self) -> None:
        """Take the messages held. Raises ValueError for one that is not as its definition says."""
        lengths = np.array([len(message) for message in self.data])
        stamps = np.empty((len(lengths), 2), np.int64)
        numbers = np.empty((len(lengths), len(self.kind.used)))
        for length in np.unique(lengths):  # as a rule they are all of one
            if length < 16 + 8 * self.kind.doubles:
                raise ValueError("a message is not as its definition says")
            here = lengths == length
            rows = np.frombuffer(b"".join([message for message in self.data if len(message) == length]), np.uint8)
            rows = rows.reshape(-1, length)
            head, stamp, frame = rows[:, :2], rows[:, 4:12], rows[:, 12:16]
            padding = length - 8 * self.kind.doubles - 16 - np.ascontiguousarray(frame).view("<u4").astype(np.int64)
            if ((padding < 0) | (padding >= (8 if self.cdr else 1))).any() or (self.cdr and (head != [0, 1]).any()):
                raise ValueError("a message is not as its definition says")
            stamps[here] = np.ascontiguousarray(stamp).view("<u4")
            numbers[here] = np.ascontiguousarray(rows[:, length - 8 * self.kind.doubles :]).view("<f8")[
                :, self.kind.used
            ]
        self.blocks.append((stamps[:, 0] * 10**9 + stamps[:, 1], np.array(self.received, np.int64), numbers))
        self.received, self.data = [], []

    def table(self, source: Source, topic: str, wanted: dict[str, int], stamp: str) -> LogTable | None:
        """The wanted columns under the stamps asked for; None without a message."""
        if self.data:
            self.decode()
        if not self.blocks:
            return None
        header, received, numbers = (np.concatenate(parts) for parts in zip(*self.blocks, strict=True))
        double, note = dict(zip(self.kind.used, numbers.T, strict=True)), f"{topic}: "
        if stamp == "header" and (header == header[0]).all():
            stamp, note = "receive", f"{note}the header stamps are all the same; "
        delay = (received - header) / 1e6
        clock = {
            "header": f"time is the header stamp; messages were received {np.median(delay):.3g} ms later (median), "
            f"up to {delay.max():.3g} ms",
            "receive": "time is the receive stamp",
        }
        names, columns = ["time [ns]"], [header if stamp == "header" else received]
        for name, at in wanted.items():
            absent = self.kind.absent.get(name.partition("_")[0])
            if absent is None or not (double[absent] == -1.0).all():
                names.append(name)
                columns.append(double[at])
        return LogTable(source, names, columns, notes=(f"{note}{clock[stamp]}.",), messages=True)
