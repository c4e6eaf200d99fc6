"""Small logs of every format that jaximu reads, of the same samples, by the formats' own writers or by hand."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from jaximu.recordings import write_recording
from jaximu.recordings.recording import Recording, Signal

START = 1_700_000_000_000_000_000  # ns
RATE = 200.0
ROWS = 400


def samples(rows: int | None = None, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps in ns, specific force (m/s²) and rate (rad/s), (rows, 3) each: at rest, with noise."""
    rows = rows or ROWS
    generator = np.random.default_rng(seed)
    time = START + np.arange(rows) * round(1e9 / RATE)
    return time, generator.normal([0.1, 0.2, 9.8], 0.02, (rows, 3)), generator.normal(0.01, 0.002, (rows, 3))


# --- ROS


def _store(version: int):
    typesys = pytest.importorskip("rosbags.typesys")
    return typesys.get_typestore(typesys.Stores.ROS1_NOETIC if version == 1 else typesys.Stores.ROS2_HUMBLE)


def message_types(version: int) -> dict:
    """The message classes of a ROS version, by name."""
    return _store(version).types


def imu_message(types: dict, version: int, stamp: int, force, rate, frame: str = "imu", absent: str = ""):
    """A sensor_msgs/Imu; `absent` ("accel", "gyro") marks a quantity that it does not hold."""
    more = {"seq": 0} if version == 1 else {}
    header = types["std_msgs/msg/Header"](
        stamp=types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id=frame, **more
    )
    vector, none = types["geometry_msgs/msg/Vector3"], np.array([-1.0, *[0.0] * 8])
    return types["sensor_msgs/msg/Imu"](
        header=header,
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=none,
        angular_velocity=vector(*map(float, rate)),
        angular_velocity_covariance=none if absent == "gyro" else np.zeros(9),
        linear_acceleration=vector(*map(float, force)),
        linear_acceleration_covariance=none if absent == "accel" else np.zeros(9),
    )


def write_bag(path: Path, messages, version: int = 2, storage: str = "sqlite3", compression: str = "") -> Path:
    """Messages (topic, type, receive stamp in ns, message) as a bag; ROS 2 makes a folder."""
    store = _store(version)
    if version == 1:
        from rosbags.rosbag1 import Writer

        writer = Writer(path)
        if compression:
            writer.set_compression(Writer.CompressionFormat[compression.upper()])
    else:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2

        writer = Writer2(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
        if compression:
            writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, kind, received, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            data = store.serialize_ros1(message, kind) if version == 1 else store.serialize_cdr(message, kind)
            writer.write(connections[topic], received, data)
    return path


def imu_messages(
    version: int, topic: str = "/imu/data", rows: int | None = None, late: int = 2_000_000, **more
) -> list:
    """The samples as messages of one topic, received `late` ns after their stamps."""
    types = _store(version).types
    kind = "sensor_msgs/msg/Imu"
    return [
        (topic, kind, int(stamp) + late, imu_message(types, version, int(stamp), force, rate, **more))
        for stamp, force, rate in zip(*samples(rows), strict=True)
    ]


# --- PX4


def write_ulog(
    path: Path,
    messages: dict[str, list[tuple[str, str]]],
    rows: list[tuple[str, int, tuple]],
    parameters: dict[str, float] | None = None,
    changed: dict[str, float] | None = None,
) -> Path:
    """A ULog: formats {name: [(type, field)]}, then rows (name, instance, values), by the published file format.

    parameters: those that it begins with; changed: those that change after the rows.
    """
    codes = {"uint64_t": "Q", "float": "f", "float[3]": "3f", "int32_t": "i", "uint32_t": "I", "uint16_t": "H",
             "uint8_t": "B", "int16_t[32]": "32h"}  # fmt: skip

    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), kind[0]) + body

    out = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message(b"B", bytes(40))]
    for name, fields in messages.items():
        out.append(message(b"F", f"{name}:{''.join(f'{kind} {field};' for kind, field in fields)}".encode()))

    def parameter(name: str, value: float) -> bytes:
        key, code = (f"int32_t {name}", "i") if isinstance(value, int) else (f"float {name}", "f")
        return message(b"P", struct.pack("<B", len(key)) + key.encode() + struct.pack(f"<{code}", value))

    out += [parameter(*pair) for pair in (parameters or {}).items()]
    ids: dict[tuple[str, int], int] = {}
    for name, place, values in rows:
        if (name, place) not in ids:
            ids[name, place] = len(ids)
            out.append(message(b"A", struct.pack("<BH", place, ids[name, place]) + name.encode()))
        layout = "<H" + "".join(codes[kind] for kind, _ in messages[name])
        out.append(message(b"D", struct.pack(layout, ids[name, place], *values)))
    out += [parameter(*pair) for pair in (changed or {}).items()]
    path.write_bytes(b"".join(out))
    return path


RAW = [("uint64_t", "timestamp"), ("uint64_t", "timestamp_sample"), *(("float", axis) for axis in "xyz"),
       ("float", "temperature")]  # fmt: skip


def px4(path: Path) -> Path:
    """Dense sensor_accel and sensor_gyro, the gyroscope's stamps 1 ms later."""
    rows = []
    for stamp, force, rate in zip(*samples(), strict=True):
        at = int(stamp - START) // 1000 + 10**6
        rows += [
            ("sensor_accel", 0, (at + 300, at, *force, 31.5)),
            ("sensor_gyro", 0, (at + 1300, at + 1000, *rate, 31.5)),
        ]
    return write_ulog(path, {"sensor_accel": RAW, "sensor_gyro": RAW}, rows)


# --- ArduPilot


def write_dataflash(path: Path, formats: dict[str, tuple[str, str]], rows: list[tuple[str, tuple]]) -> Path:
    """A DataFlash log: formats {name: (letters, columns)}, then rows, by the published layout of its messages."""
    struct_of = {"Q": "Q", "f": "f", "I": "I", "B": "B", "H": "H", "N": "16s"}
    head = b"\xa3\x95"

    def form(kind: int, length: int, name: str, letters: str, columns: str) -> bytes:
        return head + bytes([128]) + struct.pack(
            "<BB4s16s64s", kind, length, name.encode(), letters.encode(), columns.encode()
        )  # fmt: skip

    out = [form(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")]
    numbers = {}
    for at, (name, (letters, columns)) in enumerate(formats.items()):
        layout = "<" + "".join(struct_of[letter] for letter in letters)
        numbers[name] = 140 + at, layout
        out.append(form(140 + at, 3 + struct.calcsize(layout), name, letters, columns))
    for name, values in rows:
        kind, layout = numbers[name]
        out.append(head + bytes([kind]) + struct.pack(layout, *values))
    path.write_bytes(b"".join(out))
    return path


IMU = ("QBffffff" + "f", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,T")


def ardupilot(path: Path) -> Path:
    """Two instances of IMU, the second turned upside down."""
    rows = []
    for stamp, force, rate in zip(*samples(), strict=True):
        at = int(stamp - START) // 1000 + 10**6
        rows += [("IMU", (at, 0, *rate, *force, 40.25)), ("IMU", (at, 1, *-rate, *-force, 41.5))]
    return write_dataflash(path, {"IMU": IMU}, rows)


# --- text


def _lines(path: Path, head: str, rows) -> Path:
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


def euroc(path: Path) -> Path:
    axes = "xyz"
    head = ",".join(
        ["#timestamp [ns]", *(f"w_RS_S_{a} [rad s^-1]" for a in axes), *(f"a_RS_S_{a} [m s^-2]" for a in axes)]
    )
    return _lines(
        path, head, (f"{t}," + ",".join(map(repr, map(float, (*w, *f)))) for t, f, w in zip(*samples(), strict=True))
    )


def kalibr(path: Path) -> Path:
    head = "timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z"
    return _lines(
        path, head, (f"{t}," + ",".join(map(repr, map(float, (*w, *f)))) for t, f, w in zip(*samples(), strict=True))
    )


def android(path: Path) -> Path:
    head = (
        "# UncalAccel,utcTimeMillis,elapsedRealtimeNanos,UncalAccelXMps2,UncalAccelYMps2,UncalAccelZMps2,BiasXMps2,"
        "BiasYMps2,BiasZMps2\n# UncalGyro,utcTimeMillis,elapsedRealtimeNanos,UncalGyroXRadPerSec,UncalGyroYRadPerSec,"
        "UncalGyroZRadPerSec,DriftXRadPerSec,DriftYRadPerSec,DriftZRadPerSec\n#"
    )
    rows = []
    for t, f, w in zip(*samples(), strict=True):
        clock = int(t - START) + 10**12
        rows.append(f"UncalAccel,{t // 10**6},{clock}," + ",".join(f"{float(v)!r}" for v in f) + ",0,0,0")
        rows.append(f"UncalGyro,{t // 10**6},{clock + 1_000_000}," + ",".join(f"{float(v)!r}" for v in w) + ",0,0,0")
        rows.append(f"Status,{t // 10**6},1")
    return _lines(path, head, rows)


def realsense(path: Path) -> Path:
    blocks = ["Configuration:", "Stream Type,Stream Name,Format,FPS,Width,Height", "Accel,Accel,MOTION_XYZ32F,200,0,0"]
    time, force, rate = samples()
    for tag, values, shift in (("Gyro", rate, 1.0), ("Accel", force, 0.0)):
        blocks += ["", "", "Stream Type,Index,F#,HW Timestamp (ms),Host Timestamp(ms),3DOF_x,3DOF_y,3DOF_z"]
        for at, (t, row) in enumerate(zip(time, values, strict=True)):
            stamp = float(t - START) / 1e6 + shift
            blocks.append(f"{tag},0,{at},{stamp!r},{stamp + 7.5!r}," + ",".join(f"{float(v)!r}" for v in row))
    return _lines(path, blocks[0], blocks[1:])


def broad(path: Path) -> Path:
    import scipy.io

    _, force, rate = samples()
    turn = np.tile([1.0, 0.0, 0.0, 0.0], (ROWS, 1))
    turn[50:60] = np.nan  # the cameras lost it
    scipy.io.savemat(path, {"imu_acc": force, "imu_gyr": rate, "imu_mag": np.tile([20.0, 1, -40], (ROWS, 1)) + force,
                            "opt_quat": turn, "sampling_rate": RATE, "movement": np.ones((ROWS, 1))})  # fmt: skip
    return path


UNITS = {"time": "s", "accel": "m/s^2", "gyro": "rad/s"}


def _plain(suffix: str) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        time, force, rate = samples()
        named = path.with_suffix(suffix)
        seconds = (time - START) / 1e9
        write_recording(Recording(Signal(seconds, force, "m/s^2"), Signal(seconds, rate, "rad/s")), named)
        return named

    return write


def mat_plain(path: Path) -> Path:
    """Uncompressed, with what else such files hold."""
    import scipy.io

    time, force, rate = samples()
    extra = {"notes": np.array(["warm", np.arange(3), time / 1e9], object), "spectrum": force[:, 0] * 1j}
    log = {
        "time": (time - START) / 1e9,
        "accel": force,
        "gyro": rate,
        "units": UNITS,
        "label": "unit 7",
        "extra": extra,
    }
    scipy.io.savemat(path, log)
    return path


def hdf5(path: Path) -> Path:
    """As MATLAB 7.3 writes it: compressed in chunks, in a group."""
    import h5py

    time, force, rate = samples()
    with h5py.File(path, "w", userblock_size=512) as file:
        imu = file.create_group("imu")
        for name, values in {"time": (time - START) / 1e9, "accel": force.T, "gyro": rate.T}.items():
            imu.create_dataset(name, data=values, compression="gzip").attrs["unit"] = UNITS[name]
    return path


def _ros1(compression: str = "") -> Callable[[Path], Path]:
    return lambda path: write_bag(path, imu_messages(1), 1, compression=compression)


def _mcap(compression: str = "") -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        folder = write_bag(path, imu_messages(2), storage="mcap", compression=compression)
        (file,) = folder.glob("*.mcap")
        return file

    return write


def _db3(path: Path) -> Path:
    folder = write_bag(path, imu_messages(2))
    (file,) = folder.glob("*.db3")
    return file


FORMATS: dict[str, Callable[[Path], Path]] = {
    "csv": _plain(".csv"), "tsv": _plain(".tsv"), "txt": _plain(".txt"), "parquet": _plain(".parquet"),
    "npz": _plain(".npz"), "mat": _plain(".mat"), "broad": broad, "euroc": euroc, "kalibr": kalibr,
    "android": android, "realsense": realsense, "ros1": _ros1(), "ros1 bz2": _ros1("bz2"), "ros1 lz4": _ros1("lz4"),
    "db3": _db3, "mcap": _mcap(), "mcap zstd": _mcap("storage"),
    "mat plain": mat_plain, "hdf5": hdf5, "ulog": px4, "dataflash": ardupilot,
}  # fmt: skip
"""A writer of each format: it is given a path, may change its suffix, and returns the file."""
