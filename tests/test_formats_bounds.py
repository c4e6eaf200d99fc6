"""Small files that unpack to giants, and headers that count what is not there: refused, in little memory."""

import io
import json
import os
import sqlite3
import struct
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import damage
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import sample_logs

GIANT = 160 << 20  # bytes, more than table.UNPACKED
ROOM = 600 << 20  # bytes of address space that reading may take beyond what the process has
KIND = "sensor_msgs/msg/Imu"


def zeros() -> bytes:
    return bytes(GIANT)


def mat(path: Path) -> None:
    def element(kind: int, body: bytes) -> bytes:
        return struct.pack("<II", kind, len(body)) + body + bytes(-len(body) % 8)

    head = element(6, struct.pack("<II", 9, 0)) + element(5, struct.pack("<ii", GIANT, 1)) + element(1, b"accel")
    packer = zlib.compressobj(1)
    packed = packer.compress(struct.pack("<II", 14, len(head) + 8 + GIANT) + head + struct.pack("<II", 2, GIANT))
    packed += packer.compress(zeros()) + packer.flush()
    text = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    path.write_bytes(text + struct.pack("<II", 15, len(packed)) + packed)


def npz(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        array = io.BytesIO()
        np.save(array, np.zeros((10, 3)))
        archive.writestr("accel.npy", array.getvalue() + zeros())


def npz_shape(path: Path) -> None:
    array = io.BytesIO()
    np.lib.format.write_array_header_1_0(array, {"descr": "<f8", "fortran_order": False, "shape": (1 << 40, 3)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("accel.npy", array.getvalue())


def parquet(path: Path) -> None:
    table = pa.table({f"accel_{axis} [m/s^2]": pa.array(np.zeros(GIANT // 20, np.int8)) for axis in "xyz"})
    pq.write_table(table, path, compression="zstd")


def parquet_text(path: Path) -> None:
    """A long text in every row, stored once."""
    rows = 100_000
    table = pa.table({
        "accel_x [m/s^2]": np.zeros(rows),
        "note": pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, np.int32)), pa.array(["x" * 100_000])),
    })  # fmt: skip
    pq.write_table(table, path)


def hdf5(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        file.create_dataset("accel", (1 << 34, 3), "f8", chunks=True)


def hdf5_ring(path: Path) -> None:
    """Groups that hold themselves twice over: as a tree, 2 to the power of its depth."""
    import h5py

    with h5py.File(path, "w") as file:
        file["a"] = file["b"] = file["/"]


def ros1(compression: str):
    def write(path: Path) -> None:
        from rosbags.rosbag1 import Writer

        bag = Writer(path)
        bag.set_compression(Writer.CompressionFormat[compression])
        with bag:
            topic = bag.add_connection("/imu", KIND, typestore=sample_logs._store(1))
            bag.write(topic, 1, zeros())

    return write


def ros2(storage: str, mode: str):
    def write(path: Path) -> None:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        bag = Writer(path, version=9, storage_plugin=StoragePlugin[storage])
        bag.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
        with bag:
            topic = bag.add_connection("/imu", KIND, typestore=sample_logs._store(2))
            bag.write(topic, 1, zeros())

    return write


def mcap_lz4(path: Path) -> None:
    """Without an index, so that it is unpacked to be opened."""
    import lz4.frame

    def record(kind: int, body: bytes) -> bytes:
        return struct.pack("<BQ", kind, len(body)) + body

    def text(value: str | bytes) -> bytes:
        value = value.encode() if isinstance(value, str) else value
        return struct.pack("<I", len(value)) + value

    packed = lz4.frame.compress(zeros())
    chunk = struct.pack("<QQQI", 0, 1, GIANT, 0) + text("lz4") + struct.pack("<Q", len(packed)) + packed
    parts = [record(1, text("ros2") + text("")), record(6, chunk), record(2, bytes(20))]
    path.write_bytes(b"\x89MCAP0\r\n" + b"".join(parts) + b"\x89MCAP0\r\n")


def sqlite_column(path: Path) -> None:
    """Messages that are computed when they are read."""
    sample_logs._db3(path)
    (file,) = path.glob("*.db3")
    with sqlite3.connect(file) as database:
        database.executescript(
            "PRAGMA writable_schema=ON;"
            "UPDATE sqlite_master SET sql='CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp "
            f"INTEGER, data BLOB AS (zeroblob({GIANT})))' WHERE name='messages';"
        )
    database.close()
    path.joinpath("metadata.yaml").unlink()
    file.rename(path / "metadata.db3")


def ulog(path: Path) -> None:
    """Definitions within definitions, 200 to the power of six fields."""
    formats = {f"level{at}": [(f"level{at + 1}[200]", "x")] for at in range(5)} | {"level5": [("float[200]", "x")]}
    sample_logs.write_ulog(path, formats, [])
    path.write_bytes(path.read_bytes() + struct.pack("<HB", 9, ord("A")) + bytes(3) + b"level0")


def broken(name: str, edits: list[damage.Edit]):
    """A file whose damage makes a size in it large: rosbags makes room before it reads."""

    def write(path: Path) -> None:
        (path.parent / f"of-{path.name}").mkdir()
        original = damage.originals(path.parent / f"of-{path.name}")[name]
        path.write_bytes(damage.damaged(original.read_bytes(), edits))

    return write


FILES = {
    "mat": mat, "npz": npz, "npz shape": npz_shape, "parquet": parquet, "parquet text": parquet_text, "hdf5": hdf5,
    "hdf5 ring": hdf5_ring, "ros1 bz2": ros1("BZ2"), "ros1 lz4": ros1("LZ4"), "mcap chunk": ros2("MCAP", "STORAGE"),
    "mcap message": ros2("MCAP", "MESSAGE"), "mcap file": ros2("MCAP", "FILE"),
    "sqlite message": ros2("SQLITE3", "MESSAGE"), "mcap lz4": mcap_lz4, "sqlite column": sqlite_column, "ulog": ulog,
    "ros1 size": broken("ros1", [("repeat", 23040, 35), ("flip", 23399, 2)]),
    "mcap size": broken("mcap", [("set", 776, bytes(8)), ("cut", 464, 146)]),
    "mcap zstd size": broken("mcap zstd", [("set", 300, b"\x7f" * 8), ("repeat", 16, 45)]),
}  # fmt: skip
UNPACKED = {"mat", "npz", "parquet", "hdf5", "ros1 bz2", "ros1 lz4", "mcap chunk", "mcap message", "mcap file",
            "sqlite message", "mcap lz4"}  # fmt: skip
"""Those of which the sentence says that they unpack to more than any recording."""

READ = """
import json, resource, sys, time
from pathlib import Path
import pymavlink.DFReader, pyulog, rosbags.rosbag1, rosbags.rosbag2, scipy.io, h5py, pyarrow.parquet
from jaximu.ground.errors import JaximuError
from jaximu.recordings.readers import ReadOptions, read_recording
room, *files = sys.argv[1:]
size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (size + int(room), resource.RLIM_INFINITY))
told = {}
for path in files:
    start = time.perf_counter()
    try:
        text = f"read {len(read_recording(path, options=ReadOptions(check=False)).accelerometer)}"
    except JaximuError as error:
        text = str(error)
    except BaseException as error:
        text = f"{type(error).__name__}: {error}"
    told[path] = text, time.perf_counter() - start
print(json.dumps(told))
"""


@pytest.fixture(scope="module")
def told(tmp_path_factory) -> dict[str, tuple[str, float, Path]]:
    """What reading each file says and how long it takes, one after the other in a process of little memory."""
    folder = tmp_path_factory.mktemp("giants")
    paths = {name: folder / name.replace(" ", "-") for name in FILES}
    for name, write in FILES.items():
        write(paths[name])
    opened = {name: next(iter(path.glob("*.db3")), path) if name == "sqlite column" else path
              for name, path in paths.items()}  # fmt: skip
    command = [sys.executable, "-c", READ, str(ROOM), *map(str, opened.values())]
    # address space that threads set aside and do not use is none of the reader's
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "1"}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    found = json.loads(done.stdout)
    return {name: (*found[str(path)], path) for name, path in opened.items()}


@pytest.mark.parametrize("name", FILES)
def test_a_giant_is_refused_in_a_sentence(told, name):
    text, took, path = told[name]
    size = sum(each.stat().st_size for each in ([path] if path.is_file() else path.iterdir()))
    assert size < GIANT / 100, "no bomb: the file is as large as what it holds"
    assert text.startswith(str(path)) and "\n" not in text
    assert ("as no recording does" in text) == (name in UNPACKED), text
    assert "MemoryError" not in text
    assert took < 10.0
