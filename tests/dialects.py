"""Small simulated recordings written in the habits of many makers, and what `jaximu` makes of each.

The habits (names, units, separators, preambles) are those of the makers' own exports; every file is generated here. A
dialect is read right, answered with a line that reads it right, or asked about; anything else is wrong.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import scipy.io
from sample_logs import FORMATS, samples
from scipy.spatial.transform import Rotation

from jaximu.ground.errors import JaximuError
from jaximu.recordings.readers import ReadOptions, advise_reading, read_recording
from jaximu.recordings.recording import Recording

G = 9.80665
DEG = np.degrees(1.0)
RATE = 100.0


class Log(NamedTuple):
    """A simulated recording: time s, force m/s², rate rad/s, field uT, temperature degC; attitude w, x, y, z."""

    time: np.ndarray
    force: np.ndarray
    rate: np.ndarray
    field: np.ndarray
    heat: np.ndarray
    attitude: np.ndarray


@cache
def simulate(kind: str = "poses", seed: int = 0, rows: int = 4000) -> Log:
    """`poses`: rests with turns by hand between them; `rest`: one pose; `walk`: turns and steps that never rest."""
    random = np.random.default_rng([seed, len(kind)])
    time = np.arange(rows) / RATE
    rate = np.zeros((rows, 3))
    if kind == "poses":
        for first in range(150, rows - 150, 300):
            axis = random.normal(size=3)
            angle = random.uniform(1.2, 2.4)
            shape = np.sin(np.pi * np.arange(120) / 120) ** 2
            rate[first : first + 120] = axis / np.linalg.norm(axis) * angle * (shape / shape.sum() * RATE)[:, None]
    shaken = np.linalg.norm(rate, axis=1)[:, None] * 0.3 * random.normal(size=(rows, 3))  # by the hand that turns it
    if kind == "walk":
        for axis in range(3):
            rate[:, axis] = (1.6, 0.7, 1.1)[axis] * np.sin(2 * np.pi * (0.9, 0.45, 0.31)[axis] * time + axis)
    turn = Rotation.identity()
    attitudes = np.empty((rows, 4))
    for at in range(rows):
        attitudes[at] = turn.as_quat(scalar_first=True)
        turn = turn * Rotation.from_rotvec(rate[at] / RATE)
    body = Rotation.from_quat(attitudes, scalar_first=True).inv()
    force = body.apply([0.0, 0.0, G]) + (shaken if kind == "poses" else 0.0)
    if kind == "walk":
        force = force + 2.0 * np.sin(2 * np.pi * np.outer(time, [1.8, 0.9, 1.8]) + [0, 1, 2])
    field = body.apply([18.0, 2.0, -42.0]) + random.normal(0, 0.3, (rows, 3))
    return Log(
        time,
        force + random.normal(0, 0.02, (rows, 3)) + [0.05, -0.04, 0.06],
        rate + random.normal(0, 0.003, (rows, 3)) + [0.004, -0.006, 0.003],
        field,
        24.5 + 0.8 * time / time[-1] + random.normal(0, 0.02, rows),
        attitudes,
    )


@dataclass(frozen=True)
class Dialect:
    """A maker's file: how it is written, what is in it, and what fills the blanks of a line that asks."""

    name: str
    write: Callable[[Path, Log], Path]
    log: Log
    sensors: frozenset[str]
    answers: tuple[str, ...] = ()
    rate: float | None = None
    must: tuple[str, ...] = ()  # outcomes that are right
    rough: float = 0.0  # of the size, by which counts may be off


class Outcome(NamedTuple):
    """kind: read, line, asked or wrong. said: the line, the message, or what is wrong."""

    kind: str
    said: str


def attempt(dialect: Dialect, folder: Path) -> Outcome:
    """Read a dialect as a user does: as it is, else with the line that is offered."""
    folder.mkdir(exist_ok=True)
    path = dialect.write(folder, dialect.log)
    try:
        recording = read_recording(path)
    except JaximuError as error:
        refusal = error
    else:
        wrong = off(dialect, recording)
        return Outcome("wrong", f"read, but {wrong}") if wrong else Outcome("read", "")
    try:
        advice = advise_reading(path)
    except JaximuError as error:
        return Outcome("asked" if "accel" not in dialect.sensors else "wrong", str(error))
    if advice is None:
        return Outcome("wrong", str(refusal))
    stated = {name: getattr(advice, name) for name in ("columns", "rate", "accel_scale", "gyro_scale")}
    answers = [*dialect.answers]
    for name, text in stated.items():
        while text and "?" in text and answers:
            text = text.replace("?", answers.pop(0), 1)
        stated[name] = text
    asked = bool(advice.questions)
    if "accel" not in dialect.sensors:
        return Outcome("asked", str(refusal)) if asked or not advice.line() else Outcome("wrong", advice.line())
    if asked and (
        not advice.accelerometer
        or any("?" in (text or "") for text in stated.values())
        or "accel" not in (advice.columns or "accel")
    ):
        return Outcome("unanswerable", advice.sentence())
    try:
        rate = float(stated.pop("rate") or 0) or None
        recording = read_recording(path, options=ReadOptions(**stated, rate=rate, check=False))
    except JaximuError as error:
        return Outcome("wrong", f"{advice.line()}: {error}")
    if wrong := off(dialect, recording):
        return Outcome("wrong", f"{advice.line()}: {wrong}")
    return Outcome("asked" if asked else "line", advice.sentence())


def off(dialect: Dialect, recording: Recording) -> str:
    """What is wrong with a recording's SI values and stamps; nothing where they are the truth."""
    if "accel" not in dialect.sensors:
        return "it holds no accelerometer"
    log = dialect.log
    for name, truth in (("accelerometer", log.force), ("gyroscope", log.rate)):
        signal = getattr(recording, name)
        wanted = name[:4].replace("acce", "accel") in dialect.sensors
        if wanted and signal is None:
            return f"the {name} is missing"
        if signal is None or not wanted:
            if signal is not None:
                return f"it has no {name}"
            continue
        values = signal.si()
        if len(values) != len(truth):
            return f"the {name} has {len(values)} of {len(truth)} samples"
        size = float(np.sqrt(np.mean(truth**2)))
        offset = np.median(values - truth, axis=0) if dialect.rough and name == "gyroscope" else 0.0
        error = float(np.sqrt(np.mean((values - truth - offset) ** 2)))
        if error > (0.004 + dialect.rough) * size + 2e-3:
            return f"the {name} is off by {error:.3g} of {size:.3g}"
        if abs(signal.rate / (dialect.rate or RATE) - 1) > 0.02:
            return f"{signal.rate:.4g} Hz instead of {dialect.rate or RATE:g}"
    for name, truth in (("temperature", log.heat[:, None]), ("magnetometer", log.field)):
        signal = getattr(recording, name)
        if signal is not None and len(signal) == len(truth) and signal.unit != "count":
            scatter = np.std(signal.si() - truth, axis=0).max()  # a fixture may be at another temperature
            if scatter > 0.01 * np.std(truth, axis=0).max() + 1e-3:
                return f"the {name} scatters by {scatter:.3g} about the truth"
    return ""


# --- writers


def cells(values: np.ndarray, digits: int = 6) -> list[str]:
    return [f"{value:.{digits}f}" if isinstance(value, float | np.floating) else str(value) for value in values]


def text(
    folder: Path, names: Sequence[str] | None, columns: Sequence[Any], *, file: str = "log.csv", sep: str = ",",
    before: str = "", decimal: str = ".", end: str = "", digits: int = 6, after_names: str = "",
) -> Path:  # fmt: skip
    """Columns (n,) or (n, k) of numbers or texts as delimited text."""
    parts = []
    for column in columns:
        array = np.asarray(column)
        parts += [array] if array.ndim == 1 else list(array.T)
    rows = zip(*(cells(part, digits) for part in parts), strict=True)
    lines = [sep.join(row).replace(".", decimal) if decimal != "." else sep.join(row) for row in rows]
    head = before + (sep.join(names) + "\n" if names else "") + after_names
    path = folder / file
    path.write_text(head + "\n".join(line + end for line in lines) + "\n", encoding="utf-8")
    return path


def xyz(pattern: str) -> list[str]:
    return [pattern.format(axis) for axis in "xyz"]


def XYZ(pattern: str) -> list[str]:
    return [pattern.format(axis) for axis in "XYZ"]


def whole(values: np.ndarray) -> np.ndarray:
    return np.round(values).astype(np.int64)


def clock(time: np.ndarray, form: str = "{:02d}:{:02d}:{:02d}.{:03d}", day: str = "") -> list[str]:
    total = whole(time * 1000) + (13 * 3600 + 59 * 60 + 50) * 1000
    return [day + form.format(t // 3600000, t // 60000 % 60, t // 1000 % 60, t % 1000) for t in total]


EPOCH = 1_700_000_000
ALL: dict[str, Dialect] = {}
BOTH = frozenset({"accel", "gyro"})


def dialect(
    name: str, kind: str = "poses", sensors: Sequence[str] = ("accel", "gyro"), answers: Sequence[str] = (),
    rough: float = 0.0, must: Sequence[str] = ("read", "line"),
) -> Callable:  # fmt: skip
    """Register a writer under its maker's name."""

    def register(write: Callable[[Path, Log], Path]) -> Callable:
        log = simulate(kind, seed=len(ALL) % 5)
        ALL[name] = Dialect(name, write, log, frozenset(sensors), tuple(answers), None, tuple(must), rough)
        return write

    return register


# --- phones


@dialect("phyphox, all sensors")
def _(folder: Path, log: Log) -> Path:
    names = ["Time (s)", *xyz("Acceleration {} (m/s^2)"), *xyz("Gyroscope {} (rad/s)"), "Absolute acceleration (m/s^2)"]
    total = np.linalg.norm(log.force, axis=1)
    return text(folder, [f'"{each}"' for each in names], [log.time, log.force, log.rate, total])


@dialect("phyphox, one sensor: X (m/s^2)", sensors=["accel"])
def _(folder: Path, log: Log) -> Path:
    text(folder, ["Time (s)", *XYZ("{} (rad/s)")], [log.time, log.rate], file="Gyroscope.csv")
    return text(folder, ["Time (s)", *XYZ("{} (m/s^2)")], [log.time, log.force], file="Accelerometer.csv")


@dialect("phyphox, semicolons and decimal commas", sensors=["accel"])
def _(folder: Path, log: Log) -> Path:
    names = [f'"{each}"' for each in ("Time (s)", *xyz("Acceleration {} (m/s^2)"))]
    return text(folder, names, [log.time, log.force], sep=";", decimal=",")


@dialect("phyphox, tabs and decimal commas", sensors=["accel"])
def _(folder: Path, log: Log) -> Path:
    return text(folder, ["Time (s)", *XYZ("{} (m/s^2)")], [log.time, log.force], sep="\t", decimal=",")


@dialect("phyphox, Gyroscope.csv alone", sensors=["gyro"], must=["asked"])
def _(folder: Path, log: Log) -> Path:
    text(folder, ["Time (s)", *XYZ("{} (m/s^2)")], [log.time, log.force], file="Accelerometer.csv")
    return text(folder, ["Time (s)", *XYZ("{} (rad/s)")], [log.time, log.rate], file="Gyroscope.csv")


@dialect("phyphox, Magnetometer.csv", sensors=[], must=["asked"])
def _(folder: Path, log: Log) -> Path:
    return text(folder, ["Time (s)", *XYZ("{} (µT)")], [log.time, log.field], file="Magnetometer.csv")


@dialect("Physics Toolbox, gF", sensors=["accel", "gyro"])
def _(folder: Path, log: Log) -> Path:
    names = ["time", *xyz("gF{}"), *xyz("a{}"), *xyz("w{}"), *xyz("B{}")]
    linear = log.force - log.force.mean(0) * 0 - np.sign(log.force) * 9.7
    return text(folder, names, [log.time, log.force / G, linear, log.rate, log.field])


@dialect("Physics Toolbox, time of day with colons", sensors=["accel"])
def _(folder: Path, log: Log) -> Path:
    names = ["time", *xyz("gF{}"), "TgF"]
    stamps = clock(log.time, "{:02d}:{:02d}:{:02d}:{:03d}")
    return text(folder, names, [stamps, log.force / G, np.linalg.norm(log.force, axis=1) / G])


@dialect("SensorLog for iOS")
def _(folder: Path, log: Log) -> Path:
    names = ["loggingTime(txt)", "loggingSample(N)", "accelerometerTimestamp_sinceReboot(s)",
             *XYZ("accelerometerAcceleration{}(G)"), "gyroTimestamp_sinceReboot(s)", *XYZ("gyroRotation{}(rad/s)"),
             "motionTimestamp_sinceReboot(s)", "motionYaw(rad)", *XYZ("motionUserAcceleration{}(G)"),
             *XYZ("motionGravity{}(G)"), *XYZ("motionQuaternion{}(R)"), "motionQuaternionW(R)"]  # fmt: skip
    count = np.arange(len(log.time))
    uptime = log.time + 81234.5
    stamps = [f"{each} +0100" for each in clock(log.time, day="2024-05-01 ")]
    gravity = log.force / G
    return text(folder, names, [stamps, count, uptime, log.force / G, uptime + 0.001, log.rate, uptime, count * 0.001,
                                gravity * 0.01, gravity, log.attitude[:, 1:], log.attitude[:, 0]])  # fmt: skip


@dialect("SensorLog for iOS, several rates of rotation")
def _(folder: Path, log: Log) -> Path:
    names = ["loggingTime(txt)", "accelerometerTimestamp_sinceReboot(s)", *XYZ("accelerometerAcceleration{}(G)"),
             "motionTimestamp_sinceReboot(s)", *XYZ("motionRotationRate{}(rad/s)"),
             *XYZ("motionUserAcceleration{}(G)")]  # fmt: skip
    stamps = [f"{each} +0100" for each in clock(log.time, day="2024-05-01 ")]
    return text(folder, names, [stamps, log.time + 99.0, log.force / G, log.time + 99.0, log.rate, log.force * 0.001])


@dialect("AndroSensor")
def _(folder: Path, log: Log) -> Path:
    names = [*XYZ("ACCELEROMETER {} (m/s²)"), *XYZ("GRAVITY {} (m/s²)"), *XYZ("LINEAR ACCELERATION {} (m/s²)"),
             *XYZ("GYROSCOPE {} (rad/s)"), *XYZ("MAGNETIC FIELD {} (µT)"), "Time since start in ms ",
             "YYYY-MO-DD HH-MI-SS_SSS"]  # fmt: skip
    dates = [f"2024-05-01 13-59-{int(t):02d}_{int(1000 * t) % 1000:03d}" for t in log.time]
    return text(folder, names, [log.force, log.force, log.force * 0.01, log.rate, log.field, whole(log.time * 1e3),
                                dates], sep=";")  # fmt: skip


@dialect("Sensor Logger, JSON")
def _(folder: Path, log: Log) -> Path:
    rows: list[dict[str, str]] = [{"sensor": "Metadata", "version": "3", "platform": "android", "appVersion": "1"}]
    for at, time in enumerate(log.time):
        stamp = str(EPOCH * 10**9 + round(time * 1e9))
        for sensor, values in (("Accelerometer", log.force), ("Gyroscope", log.rate)):
            rows.append({"sensor": sensor, "time": stamp, "seconds_elapsed": f"{time:.4f}",
                         **{axis: f"{v:.7f}" for axis, v in zip("zyx", values[at][::-1], strict=True)}})  # fmt: skip
    path = folder / "log.json"
    path.write_text(json.dumps(rows))
    return path


@dialect("MATLAB Mobile, exported table", sensors=["accel"])
def _(folder: Path, log: Log) -> Path:
    stamps = clock(log.time, day="01-May-2024 ")
    return text(folder, ["Timestamp", "X", "Y", "Z"], [stamps, log.force], file="Acceleration.csv")


@dialect("iPhone watch app, JSON lines")
def _(folder: Path, log: Log) -> Path:
    lines = [
        json.dumps({"ts": round(1000 * t) + EPOCH * 1000, "acc": [*map(float, f / G)], "gyro": [*map(float, w)]})
        for t, f, w in zip(log.time, log.force, log.rate, strict=True)
    ]
    path = folder / "log.jsonl"
    path.write_text("\n".join(lines))
    return path


# --- inertial units


@dialect("x-io NGIMU")
def _(folder: Path, log: Log) -> Path:
    names = ["Time (s)", *XYZ("Gyroscope {} (deg/s)"), *XYZ("Accelerometer {} (g)"), *XYZ("Magnetometer {} (uT)"),
             "Barometer (hPa)"]  # fmt: skip
    return text(folder, names, [log.time, log.rate * DEG, log.force / G, log.field, log.heat + 990])


@dialect("x-io 3")
def _(folder: Path, log: Log) -> Path:
    names = ["Timestamp (us)", *XYZ("Gyroscope {} (deg/s)"), *XYZ("Accelerometer {} (g)")]
    return text(folder, names, [whole(log.time * 1e6) + 10**9, log.rate * DEG, log.force / G])


def _mt_manager(folder: Path, log: Log, before: str, sep: str, fine: np.ndarray, rate: np.ndarray) -> Path:
    names = ["PacketCounter", "SampleTimeFine", *XYZ("Acc_{}"), *XYZ("Gyr_{}"), *XYZ("Mag_{}"),
             *(f"Quat_q{k}" for k in range(4))]  # fmt: skip
    count = (np.arange(len(log.time)) + 65000) % 65536
    return text(folder, names, [count, fine, log.force, rate, log.field / 48, log.attitude], sep=sep, before=before,
                file="MT_0001.txt")  # fmt: skip


@dialect("Xsens MT Manager, rate in the preamble")
def _(folder: Path, log: Log) -> Path:
    before = "// General information:\n// MT Manager version: 2021.4\n// Sample rate: 100.0Hz\n// Option flags: none\n"
    return _mt_manager(folder, log, before, "\t", whole(log.time * 1e4) + 5_000_000, log.rate)


@dialect("Xsens MT Manager, stamps of 0.1 ms")
def _(folder: Path, log: Log) -> Path:
    return _mt_manager(folder, log, "", "\t", whole(log.time * 1e4) + 5_000_000, log.rate)


@dialect("Xsens DOT, degrees and microseconds")
def _(folder: Path, log: Log) -> Path:
    return _mt_manager(folder, log, "DeviceTag:,Xsens DOT\nFirmwareVersion:,2.0.0\nOutputRate:,100Hz\n\n", ",",
                       whole(log.time * 1e6) + 3_000_000_000, log.rate * DEG)  # fmt: skip


@dialect("Xsens, counter and rate only")
def _(folder: Path, log: Log) -> Path:
    names = ["Counter", *XYZ("Acc_{}"), *XYZ("Gyr_{}")]
    return text(folder, names, [np.arange(len(log.time)), log.force, log.rate], sep="\t",
                before="// Start Time: Unknown\n// Sample rate: 100.0Hz\n// Scenario: 4.9\n")  # fmt: skip


@dialect("a counter and no rate anywhere", answers=["100"], must=["asked"])
def _(folder: Path, log: Log) -> Path:
    return text(folder, ["Counter", *XYZ("Acc_{} (m/s^2)"), *XYZ("Gyr_{} (rad/s)")],
                [np.arange(len(log.time)), log.force, log.rate])  # fmt: skip


@dialect("MicroStrain SensorConnect")
def _(folder: Path, log: Log) -> Path:
    names = ["Time", *XYZ("inertial-6284.60012:scaledAccel{}"), *XYZ("inertial-6284.60012:scaledGyro{}"),
             *XYZ("inertial-6284.60012:deltaTheta{}")]  # fmt: skip
    stamps = [f"{each}000000" for each in clock(log.time, day="05/01/2024 ")]
    before = "FILE_INFO,SensorConnect\nExported,05/01/2024\nNode,inertial-6284.60012\nSample Rate,100 Hz\nDATA_START\n"
    return text(folder, names, [stamps, log.force / G, log.rate, log.rate / RATE], before=before)


@dialect("MicroStrain MIP Monitor")
def _(folder: Path, log: Log) -> Path:
    names = ["GPS TFlags", "GPS Week", "GPS TOW", *XYZ("{} Accel [x8004]"), *XYZ("{} Gyro [x8005]")]
    one = np.ones(len(log.time), int)
    return text(folder, names, [one, one * 2200, log.time + 302400, log.force / G, log.rate], before="DATA_START\n")


@dialect("VectorNav Control Center")
def _(folder: Path, log: Log) -> Path:
    names = ["TimeStartup", *XYZ("UncompMag{}"), *XYZ("UncompAcc{}"), *XYZ("UncompGyro{}"), "Temp"]
    return text(folder, names, [whole(log.time * 1e9) + 10**10, log.field / 100, log.force, log.rate, log.heat])


@dialect("VectorNav, $VNIMU sentences", answers=["100"], must=["asked"])
def _(folder: Path, log: Log) -> Path:
    lines = []
    for m, f, w, t in zip(log.field / 100, log.force, log.rate, log.heat, strict=True):
        body = "VNIMU," + ",".join(f"{v:+010.6f}" for v in (*m, *f, *w, t, 101.3))
        sum_of = 0
        for sign in body:
            sum_of ^= ord(sign)
        lines.append(f"${body}*{sum_of:02X}")
    path = folder / "log.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def _shimmer(log: Log) -> tuple[list[str], list[Any]]:
    names = ["Shimmer_D3A1_Timestamp_Unix_CAL", *XYZ("Shimmer_D3A1_Accel_LN_{}_CAL"), *XYZ("Shimmer_D3A1_Gyro_{}_CAL"),
             *XYZ("Shimmer_D3A1_Mag_{}_CAL")]  # fmt: skip
    return names, [whole(log.time * 1e3) + EPOCH * 1000, log.force, log.rate * DEG, log.field]


@dialect("Shimmer, unit row under the names")
def _(folder: Path, log: Log) -> Path:
    names, columns = _shimmer(log)
    units = "\t".join(["ms", *["m/(s^2)"] * 3, *["deg/s"] * 3, *["local_flux"] * 3]) + "\n"
    return text(folder, names, columns, sep="\t", before='"sep=\t"\n', after_names=units)


@dialect("Shimmer, older: unit row and CAL row, trailing tab")
def _(folder: Path, log: Log) -> Path:
    names, columns = _shimmer(log)
    names = [each.removeprefix("Shimmer_D3A1_").removesuffix("_CAL").replace("_", " ") for each in names]
    cal = "\t".join(["CAL"] * 10) + "\t\n"
    units = "\t".join(["mSecs", *["m/(sec^2)"] * 3, *["deg/sec"] * 3, *["local"] * 3]) + "\t\n"
    return text(folder, names, columns, sep="\t", end="\t", before="\t".join(["Shimmer"] * 10) + "\t\n",
                after_names=cal + units)  # fmt: skip


@dialect("Shimmer, two accelerometers")
def _(folder: Path, log: Log) -> Path:
    names, columns = _shimmer(log)
    units = "\t".join(["ms", *["m/(s^2)"] * 3, *["deg/s"] * 3, *["local_flux"] * 3, *["m/(s^2)"] * 3]) + "\n"
    names += XYZ("Shimmer_D3A1_Accel_WR_{}_CAL")
    return text(folder, names, [*columns, log.force * 1.03 + 0.4], sep="\t", after_names=units)


@dialect("APDM Opal, HDF5")
def _(folder: Path, log: Log) -> Path:
    path = folder / "opal.h5"
    with h5py.File(path, "w") as file:
        group = file.create_group("Sensors/XI-000123")
        group.attrs["Sample Rate"] = 100.0
        for name, values, unit in (("Accelerometer", log.force, "m/s^2"), ("Gyroscope", log.rate, "rad/s"),
                                   ("Magnetometer", log.field, "µT")):  # fmt: skip
            group[name] = values
            group[name].attrs["Units"] = unit
    return path


@dialect("HDF5 with units and rate as attributes of the file")
def _(folder: Path, log: Log) -> Path:
    path = folder / "log.h5"
    with h5py.File(path, "w") as file:
        file.attrs["sampling_rate"] = 100.0
        for name, values, unit in (("acc", log.force / G, "g"), ("gyr", log.rate * DEG, "dps")):
            file[name] = values
            file[name].attrs["unit"] = unit
    return path


@dialect("HDF5, one compound data set")
def _(folder: Path, log: Log) -> Path:
    names = ["timestamp_us", *xyz("acc_{}"), *xyz("gyro_{}")]
    values = np.column_stack([log.time * 1e6, log.force, log.rate])
    records = np.array([*map(tuple, values)], dtype=[(name, "f8") for name in names])
    with h5py.File(folder / "log.h5", "w") as file:
        file["imu"] = records
    return folder / "log.h5"


@dialect("Movella/Noraxon: preamble Fs,100", sensors=["accel"])
def _(folder: Path, log: Log) -> Path:
    before = "Device,Unit 7\nFs,100\nRange,8\n\n"
    return text(folder, xyz("Acc {} [mg]"), [log.force / G * 1e3], before=before)


@dialect("Movisens: tagged rows of several sensors")
def _(folder: Path, log: Log) -> Path:
    lines = ["sensor,timestamp_ms,x,y,z"]
    for t, f, w in zip(whole(log.time * 1e3), log.force, log.rate, strict=True):
        lines += [f"accelerometer,{t}," + ",".join(cells(f)), f"gyroscope,{t}," + ",".join(cells(w))]
    (folder / "log.csv").write_text("\n".join(lines) + "\n")
    return folder / "log.csv"


@dialect("GENEActiv", sensors=["accel"])
def _(folder: Path, log: Log) -> Path:
    before = "Device Type,GENEActiv\nMeasurement Frequency,100 Hz\nStart Time,2024-05-01 13:59:50:000\n"
    stamps = clock(log.time, "{:02d}:{:02d}:{:02d}:{:03d}", "2024-05-01 ")
    return text(folder, None, [stamps, log.force / G, whole(log.time * 0 + 300), whole(log.time * 0), log.heat],
                before=before, digits=4)  # fmt: skip


@dialect("Axivity AX3", sensors=["accel"])
def _(folder: Path, log: Log) -> Path:
    return text(folder, None, [clock(log.time, day="2024-05-01 "), log.force / G])


@dialect("ActiGraph, rate in the first line", sensors=["accel"])
def _(folder: Path, log: Log) -> Path:
    before = ("------------ Data File Created By ActiGraph GT3X+ ActiLife v6.13 at 100 Hz  Filter Normal -----------\n"
              "Serial Number: MOS2A\nStart Time 13:59:50\nStart Date 5/1/2024\nEpoch Period (hh:mm:ss) 00:00:00\n"
              "--------------------------------------------------\n")  # fmt: skip
    return text(folder, [f"Accelerometer {axis}" for axis in "XYZ"], [log.force / G], before=before)


@dialect("Movesense, JSON")
def _(folder: Path, log: Log) -> Path:
    rows = [{"timestamp": round(1000 * t), "acc": dict(zip("xyz", map(float, f), strict=True)),
             "gyro": dict(zip("xyz", map(float, w * DEG), strict=True))}
            for t, f, w in zip(log.time, log.force, log.rate, strict=True)]  # fmt: skip
    (folder / "log.json").write_text(json.dumps({"data": rows}))
    return folder / "log.json"


@dialect("Edge Impulse acquisition, JSON", sensors=["accel"])
def _(folder: Path, log: Log) -> Path:
    sensors = [{"name": f"acc{axis}", "units": "m/s2"} for axis in "XYZ"]
    payload = {"device_type": "X", "interval_ms": 10, "sensors": sensors, "values": log.force.tolist()}
    (folder / "log.json").write_text(json.dumps({"protected": {"ver": "v1"}, "signature": "0", "payload": payload}))
    return folder / "log.json"


@dialect("JSON of columns")
def _(folder: Path, log: Log) -> Path:
    document = {"time": log.time.tolist(), "accelerometer": dict(zip("xyz", log.force.T.tolist(), strict=True)),
                "gyroscope": dict(zip("xyz", log.rate.T.tolist(), strict=True))}  # fmt: skip
    (folder / "log.json").write_text(json.dumps(document))
    return folder / "log.json"


# --- flight


@dialect("Betaflight blackbox, decoded")
def _(folder: Path, log: Log) -> Path:
    names = ["loopIteration", " time (us)", *(f" axisP[{k}]" for k in range(3)), *(f" axisI[{k}]" for k in range(3)),
             *(f" gyroADC[{k}]" for k in range(3)), *(f" accSmooth[{k}]" for k in range(3)), " motor[0]"]  # fmt: skip
    count = np.arange(len(log.time))
    gyro = whole(log.rate * DEG)
    return text(folder, names, [count * 32, whole(log.time * 1e6) + 7_000_000, gyro, gyro * 2, gyro,
                                whole(log.force / G * 2048), count % 2000], sep=", ")  # fmt: skip


ALL["Betaflight blackbox, decoded"] = Dialect(
    **{**ALL["Betaflight blackbox, decoded"].__dict__, "rough": 0.05, "answers": ()}
)


@dialect("MAVLink SCALED_IMU")
def _(folder: Path, log: Log) -> Path:
    names = ["time_boot_ms", *xyz("{}acc"), *xyz("{}gyro"), *xyz("{}mag")]
    return text(folder, names, [whole(log.time * 1e3), whole(log.force / G * 1e3), whole(log.rate * 1e3),
                                whole(log.field * 10)])  # fmt: skip


@dialect("ArduPilot IMU message as CSV")
def _(folder: Path, log: Log) -> Path:
    names = ["TimeUS", "I", *(f"Gyr{axis}" for axis in "XYZ"), *(f"Acc{axis}" for axis in "XYZ"), "T"]
    return text(folder, names, [whole(log.time * 1e6), whole(log.time * 0), log.rate, log.force, log.heat])


@dialect("PX4 sensor_combined as CSV (ulog2csv)")
def _(folder: Path, log: Log) -> Path:
    names = ["timestamp", *(f"gyro_rad[{k}]" for k in range(3)), "gyro_integral_dt",
             *(f"accelerometer_m_s2[{k}]" for k in range(3)), "accelerometer_integral_dt"]  # fmt: skip
    dt = whole(log.time * 0 + 5000)
    return text(folder, names, [whole(log.time * 1e6), log.rate, dt, log.force, dt])


# --- research


@dialect("NaveGo, MAT structure with parameters")
def _(folder: Path, log: Log) -> Path:
    vector = np.array([0.1, 0.2, 0.3])
    imu = {"arw": vector, "vrw": vector, "ab_sta": vector, "gb_sta": vector, "ab_dyn": vector, "gb_dyn": vector,
           "ab_std": vector, "gb_std": vector, "ini_align": vector, "freq": 100.0, "t": log.time[:, None],
           "fb": log.force, "wb": log.rate}  # fmt: skip
    scipy.io.savemat(folder / "imu1.mat", {"imu1": imu})
    return folder / "imu1.mat"


@dialect("PSINS, increments [wm vm t] in a structure with parameters")
def _(folder: Path, log: Log) -> Path:
    imu = np.column_stack([log.rate / RATE, log.force / RATE, log.time + 1 / RATE])
    error = {name: np.array([0.1, 0.2, 0.3]) for name in ("eb", "db", "web", "wdb", "sqg", "sqa")}
    scipy.io.savemat(folder / "trj.mat", {"trj": {"imu": imu, "ts": 0.01, "avp0": np.arange(9.0), "imuerr": error}})
    return folder / "trj.mat"


@dialect("Simulink, structure with time")
def _(folder: Path, log: Log) -> Path:
    def signal(values: np.ndarray, label: str) -> dict[str, Any]:
        return {"values": values, "dimensions": 3.0, "label": label}

    out = {"time": log.time[:, None], "signals": np.array([signal(log.force, "accel"), signal(log.rate, "gyro")])}
    scipy.io.savemat(folder / "simout.mat", {"simout": out})
    return folder / "simout.mat"


@dialect("Simulink To File: a matrix without names")
def _(folder: Path, log: Log) -> Path:
    scipy.io.savemat(folder / "ans.mat", {"ans": np.vstack([log.time, log.force.T, log.rate.T])})
    return folder / "ans.mat"


@dialect("Simulink To File: gyroscope first")
def _(folder: Path, log: Log) -> Path:
    scipy.io.savemat(folder / "ans.mat", {"ans": np.vstack([log.time, log.rate.T, log.force.T])})
    return folder / "ans.mat"


@dialect("MAT of Gyr_noise, Acc_noise")
def _(folder: Path, log: Log) -> Path:
    scipy.io.savemat(folder / "log.mat", {"Gyr_noise": log.rate, "Acc_noise": log.force, "Fs": 100.0})
    return folder / "log.mat"


@dialect("BROAD, MAT")
def _(folder: Path, log: Log) -> Path:
    scipy.io.savemat(folder / "log.mat", {"imu_acc": log.force, "imu_gyr": log.rate, "imu_mag": log.field,
                                          "opt_quat": log.attitude, "sampling_rate": 100.0})  # fmt: skip
    return folder / "log.mat"


@dialect("EuRoC")
def _(folder: Path, log: Log) -> Path:
    names = ["#timestamp [ns]", *xyz("w_RS_S_{} [rad s^-1]"), *xyz("a_RS_S_{} [m s^-2]")]
    return text(folder, names, [whole(log.time * 1e9) + EPOCH * 10**9, log.rate, log.force])


@dialect("TUM VI / Kalibr without names: gyroscope first")
def _(folder: Path, log: Log) -> Path:
    return text(folder, None, [whole(log.time * 1e9) + EPOCH * 10**9, log.rate, log.force])


@dialect("RepoIMU: time and quaternion before the sensors")
def _(folder: Path, log: Log) -> Path:
    return text(folder, None, [log.time, log.attitude, log.force, log.rate], sep=";")


@dialect("OxIOD: attitude, rotation rate, gravity, user acceleration", sensors=[], must=["asked"])
def _(folder: Path, log: Log) -> Path:
    names = ["Time", "attitude_roll", "attitude_pitch", "attitude_yaw", *xyz("rotation_rate_{}"), *xyz("gravity_{}"),
             *xyz("user_acc_{}")]  # fmt: skip
    return text(folder, names, [log.time, log.attitude[:, 1:], log.rate, log.force / G, log.force * 0.002])


@dialect("x_rotation and x_acceleration")
def _(folder: Path, log: Log) -> Path:
    return text(folder, ["timestamp", *xyz("{}_rotation"), *xyz("{}_acceleration")], [log.time, log.rate, log.force])


@dialect("Accel (X), Gyro (X): axes in brackets")
def _(folder: Path, log: Log) -> Path:
    return text(folder, ["t", *XYZ("Accel ({})"), *XYZ("Gyro ({})")], [log.time, log.force / G, log.rate * DEG])


@dialect("p, q, r and fx, fy, fz")
def _(folder: Path, log: Log) -> Path:
    return text(folder, ["t", "p", "q", "r", "fx", "fy", "fz"], [log.time, log.rate, log.force], sep="\t")


@dialect("roll, pitch and yaw rate")
def _(folder: Path, log: Log) -> Path:
    names = ["millis", "roll_rate", "pitch_rate", "yaw_rate", *xyz("accel_{}")]
    return text(folder, names, [whole(log.time * 1e3), log.rate * DEG, log.force / G])


@dialect("units at the end of names")
def _(folder: Path, log: Log) -> Path:
    return text(folder, ["time_ms", *xyz("acc_{}_g"), *xyz("gyro_{}_dps")],
                [whole(log.time * 1e3), log.force / G, log.rate * DEG])  # fmt: skip


@dialect("camel case with units")
def _(folder: Path, log: Log) -> Path:
    return text(folder, ["timestampUs", *XYZ("accel{}Mps2"), *XYZ("gyro{}Radps")],
                [whole(log.time * 1e6), log.force, log.rate])  # fmt: skip


@dialect("T(°) beside the sensors")
def _(folder: Path, log: Log) -> Path:
    return text(folder, ["Chip Time ms", *xyz("a{}(g)"), *xyz("w{}(deg/s)"), "T(°)"],
                [whole(log.time * 1e3), log.force / G, log.rate * DEG, log.heat], sep="\t")  # fmt: skip


@dialect("WitMotion")
def _(folder: Path, log: Log) -> Path:
    names = ["Time(s)", *xyz("a{}(g)"), *xyz("w{}(deg/s)"), "AngleX(deg)", "AngleY(deg)", "AngleZ(deg)", "T(°)",
             *xyz("h{}")]  # fmt: skip
    return text(folder, names, [clock(log.time), log.force / G, log.rate * DEG, log.rate, log.heat,
                                whole(log.field * 10)], sep="\t")  # fmt: skip


@dialect("MPU-6050 sketch: raw counts with temperature between")
def _(folder: Path, log: Log) -> Path:
    names = ["millis", "AcX", "AcY", "AcZ", "Tmp", "GyX", "GyY", "GyZ"]
    counts = whole(log.force / G * 16384), whole((log.heat - 36.53) * 340), whole(log.rate * DEG * 131)
    return text(folder, names, [whole(log.time * 1e3), *counts])


@dialect("MPU-6050 sketch, no names, tabs")
def _(folder: Path, log: Log) -> Path:
    return text(folder, None, [whole(log.time * 1e3) + 512, whole(log.force / G * 16384),
                               whole(log.rate * DEG * 131)], sep="\t")  # fmt: skip


for _name in ("MPU-6050 sketch: raw counts with temperature between", "MPU-6050 sketch, no names, tabs"):
    ALL[_name] = Dialect(**{**ALL[_name].__dict__, "rough": 0.03})


@dialect("microseconds, no names, gyroscope first in deg/s")
def _(folder: Path, log: Log) -> Path:
    return text(folder, None, [whole(log.time * 1e6), log.rate * DEG, log.force / G], sep=" ")


@dialect("no names, at rest", kind="rest", answers=["rad/s"], must=["asked"])
def _(folder: Path, log: Log) -> Path:
    return text(folder, None, [log.time, log.rate, log.force])


@dialect("degrees at rest, no units", kind="rest", answers=["deg/s"], must=["asked", "line"])
def _(folder: Path, log: Log) -> Path:
    return text(folder, ["time", *xyz("acc_{}"), *xyz("gyro_{}")], [log.time, log.force, log.rate * DEG])


@dialect("radians at rest, no units", kind="rest", answers=["rad/s"], must=["asked"])
def _(folder: Path, log: Log) -> Path:
    return text(folder, ["time", *xyz("acc_{}"), *xyz("gyro_{}")], [log.time, log.force, log.rate])


@dialect("walking, no units", kind="walk", answers=["rad/s"], must=["line", "asked"])
def _(folder: Path, log: Log) -> Path:
    return text(folder, ["time", *xyz("acc_{}"), *xyz("gyro_{}")], [log.time, log.force, log.rate])


@dialect("magnetometer alone, no names", sensors=[], must=["asked"])
def _(folder: Path, log: Log) -> Path:
    return text(folder, None, [log.time, log.field])


@dialect("magnetometer alone, counts", sensors=[], must=["asked"])
def _(folder: Path, log: Log) -> Path:
    return text(folder, ["X", "Y", "Z"], [whole(log.field * 30)])


@dialect("magnetometer of norm 1 alone, no names", sensors=[], must=["asked"])
def _(folder: Path, log: Log) -> Path:
    return text(folder, None, [log.time, log.field / 45.74])


@dialect("quaternion and nothing else", sensors=[], must=["asked"])
def _(folder: Path, log: Log) -> Path:
    return text(folder, None, [log.time, log.attitude])


@dialect("rosbag as CSV (rostopic echo -p)")
def _(folder: Path, log: Log) -> Path:
    names = ["%time", "field.header.seq", "field.header.stamp", "field.header.frame_id",
             *(f"field.orientation.{axis}" for axis in "xyzw"), *xyz("field.angular_velocity.{}"),
             *xyz("field.linear_acceleration.{}")]  # fmt: skip
    stamps = whole(log.time * 1e9) + EPOCH * 10**9
    frame = ["imu"] * len(log.time)
    return text(folder, names, [stamps + 10**6, np.arange(len(stamps)), stamps, frame, log.attitude, log.rate,
                                log.force])  # fmt: skip


@dialect("NumPy array without names")
def _(folder: Path, log: Log) -> Path:
    np.save(folder / "log.npy", np.column_stack([log.time, log.force, log.rate]))
    return folder / "log.npy"


@dialect("NumPy record array")
def _(folder: Path, log: Log) -> Path:
    names = ["t", *xyz("a{}"), *xyz("w{}")]
    values = np.column_stack([log.time, log.force, log.rate])
    np.save(folder / "log.npy", np.array([*map(tuple, values)], dtype=[(name, "f8") for name in names]))
    return folder / "log.npy"


@dialect("NPZ of acc, gyr, fs")
def _(folder: Path, log: Log) -> Path:
    np.savez(folder / "log.npz", acc=log.force / G, gyr=log.rate * DEG, fs=100)
    return folder / "log.npz"


# --- binary formats of samples of their own

_SAMPLES = Log(*samples(), *(np.zeros(1) for _ in range(3)))
for _name, _form in (("ROS 1 bag", "ros1"), ("ROS 2 bag", "db3"), ("ULog", "ulog"), ("DataFlash", "dataflash")):
    ALL[_name] = Dialect(_name, lambda folder, _, form=_form: FORMATS[form](folder / "log"), _SAMPLES, BOTH, (), 200.0,
                         ("read",))  # fmt: skip


# --- more habits


@dialect("phyphox, linear acceleration", sensors=[], must=["asked"])
def _(folder: Path, log: Log) -> Path:
    names = ["Time (s)", *xyz("Linear Acceleration {} (m/s^2)")]
    return text(folder, names, [log.time, log.force - log.force], file="Raw Data.csv")


@dialect("phyphox in German", sensors=["accel", "gyro"])
def _(folder: Path, log: Log) -> Path:
    names = [f'"{each}"' for each in ("Zeit (s)", *xyz("Beschleunigung {} (m/s^2)"), *xyz("Gyroskop {} (rad/s)"))]
    return text(folder, names, [log.time, log.force, log.rate], sep=";", decimal=",")


@dialect("Sensor Logger, TotalAcceleration.csv", sensors=["accel"])
def _(folder: Path, log: Log) -> Path:
    stamps = whole(log.time * 1e9) + EPOCH * 10**9
    return text(folder, ["time", "seconds_elapsed", "z", "y", "x"], [stamps, log.time, log.force[:, ::-1]],
                file="TotalAcceleration.csv")  # fmt: skip


@dialect("Sensor Logger, Gravity.csv", sensors=[], must=["asked"])
def _(folder: Path, log: Log) -> Path:
    stamps = whole(log.time * 1e9) + EPOCH * 10**9
    return text(folder, ["time", "seconds_elapsed", "z", "y", "x"], [stamps, log.time, log.force[:, ::-1]],
                file="Gravity.csv")  # fmt: skip


@dialect("DJI, IMU_ATTI(0):accelX")
def _(folder: Path, log: Log) -> Path:
    names = ["Tick#", "offsetTime", *XYZ("IMU_ATTI(0):accel{}"), *XYZ("IMU_ATTI(0):gyro{}"), *XYZ("IMU_ATTI(0):mag{}"),
             "IMU_ATTI(0):accelComposite"]  # fmt: skip
    total = np.linalg.norm(log.force, axis=1) / G
    return text(folder, names, [whole(log.time * 4.5e6) + 10**8, log.time, log.force / G, log.rate * DEG,
                                log.field * 20, total])  # fmt: skip


@dialect("ST, mg and mdps", sensors=["accel", "gyro"])
def _(folder: Path, log: Log) -> Path:
    names = ["Timestamp [ms]", *XYZ("ACC_{} [mg]"), *XYZ("GYRO_{} [mdps]"), *XYZ("MAG_{} [mgauss]")]
    return text(folder, names, [whole(log.time * 1e3), log.force / G * 1e3, log.rate * DEG * 1e3, log.field * 10])


@dialect("ST BLE Sensor", sensors=["accel"])
def _(folder: Path, log: Log) -> Path:
    names = ["Date", "HostTimestamp", "NodeName", "NodeTimestamp", *XYZ("{} (mg)")]
    before = "Log start on,01/05/24 13:59:50\nFeature,Accelerometer\nNodes,BCN-002\n"
    return text(folder, names, [clock(log.time, day="01/05/2024 "), whole(log.time * 1e3), ["BCN"] * len(log.time),
                                whole(log.time * 1e3) + 5000, whole(log.force / G * 1e3)], before=before)  # fmt: skip


@dialect("LP-Research OpenMAT")
def _(folder: Path, log: Log) -> Path:
    names = ["SensorId", " TimeStamp (s)", " FrameNumber", *XYZ(" Acc{} (g)"), *XYZ(" Gyro{} (deg/s)"),
             *XYZ(" Mag{} (uT)"), *XYZ(" Euler{} (deg)"), " QuatW", *XYZ(" Quat{}"), *XYZ(" LinAcc{} (g)")]  # fmt: skip
    count = np.arange(len(log.time))
    return text(folder, names, [count * 0 + 1, log.time, count, log.force / G, log.rate * DEG, log.field, log.rate,
                                log.attitude, log.force * 0.01])  # fmt: skip


@dialect("MbientLab", sensors=["accel"])
def _(folder: Path, log: Log) -> Path:
    names = ["epoc (ms)", "timestamp (+0100)", "elapsed (s)", *xyz("{}-axis (g)")]
    stamps = [each.replace(":", ".") for each in clock(log.time, day="2024-05-01T")]
    return text(folder, names, [whole(log.time * 1e3) + EPOCH * 1000, stamps, log.time, log.force / G],
                file="unit_Accelerometer_100.000Hz.csv")  # fmt: skip


@dialect("WitMotion, newer")
def _(folder: Path, log: Log) -> Path:
    names = ["time", "DeviceName", "Chip Time()", *XYZ("Acc{}(g)"), *XYZ("As{}(°/s)"), *XYZ("Angle{}(°)"),
             "Temperature(°C)"]  # fmt: skip
    stamps = clock(log.time, day="2024-5-1 ")
    return text(folder, names, [stamps, ["WT901"] * len(log.time), stamps, log.force / G, log.rate * DEG, log.rate,
                                log.heat])  # fmt: skip


@dialect("Delsys Trigno: X[s] before every channel", sensors=["accel"])
def _(folder: Path, log: Log) -> Path:
    names = []
    for axis in "XYZ":
        names += ["X[s]", f"Avanti sensor 1: Acc 1.{axis} [g]"]
    columns = [part for axis in range(3) for part in (log.time, log.force[:, axis] / G)]
    return text(folder, names, columns)


@dialect("Polar, sensor timestamp [ns]", sensors=["accel"])
def _(folder: Path, log: Log) -> Path:
    names = ["Phone timestamp", "sensor timestamp [ns]", *XYZ("{} [mg]")]
    return text(folder, names, [clock(log.time, day="2024-05-01T"), whole(log.time * 1e9) + 599_000_000_000_000_000,
                                whole(log.force / G * 1e3)], sep=";")  # fmt: skip


@dialect("Vicon Blue Trident")
def _(folder: Path, log: Log) -> Path:
    return text(folder, ["time_s", *xyz("a{}_m/s/s"), *xyz("g{}_deg/s")], [log.time, log.force, log.rate * DEG])


@dialect("Empatica E4: start and rate as rows of data", sensors=[], must=["asked"])
def _(folder: Path, log: Log) -> Path:
    before = f"{EPOCH}.0, {EPOCH}.0, {EPOCH}.0\n100.0, 100.0, 100.0\n"
    return text(folder, None, [whole(log.force / G * 64)], before=before, file="ACC.csv")


@dialect("pandas, index first")
def _(folder: Path, log: Log) -> Path:
    names = ["", "timestamp", "accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z"]
    return text(folder, names, [np.arange(len(log.time)), log.time + EPOCH, log.force, log.rate])


@dialect("MATLAB writetable: Var1 … Var7")
def _(folder: Path, log: Log) -> Path:
    return text(folder, [f"Var{k + 1}" for k in range(7)], [log.time, log.rate, log.force])


@dialect("pandas without names: 0 … 6 as header")
def _(folder: Path, log: Log) -> Path:
    return text(folder, [f"column {k}" for k in range(7)], [whole(log.time * 1e6), log.rate * DEG, log.force / G])


@dialect("German dates and decimal commas", sensors=["accel"])
def _(folder: Path, log: Log) -> Path:
    stamps = [each.replace(".", ",") for each in clock(log.time)]
    stamps = [f"01.05.2024 {each}" for each in stamps]
    lines = [";".join([s, *(f"{v:.4f}".replace(".", ",") for v in f)]) for s, f in zip(stamps, log.force, strict=True)]
    (folder / "log.csv").write_text("Zeit;AccX [m/s²];AccY [m/s²];AccZ [m/s²]\n" + "\n".join(lines) + "\n")
    return folder / "log.csv"


@dialect("GY-85 sketch: counts, blanks")
def _(folder: Path, log: Log) -> Path:
    names = ["millis", *xyz("a{}"), *xyz("g{}")]
    return text(folder, names, [whole(log.time * 1e3), whole(log.force / G * 256), whole(log.rate * DEG * 14.375)],
                sep=" ")  # fmt: skip


ALL["GY-85 sketch: counts, blanks"] = Dialect(**{**ALL["GY-85 sketch: counts, blanks"].__dict__, "rough": 0.03})


@dialect("WISDM: a semicolon after every row", sensors=["accel"], answers=["g"], must=["line", "asked"])
def _(folder: Path, log: Log) -> Path:
    stamps = whole(log.time * 1e9) + 49_105_962_326_000
    return text(folder, None, [whole(log.time * 0 + 33), ["Jogging"] * len(log.time), stamps, log.force], end=";")


@dialect("OpenSense .sto-like preamble: DataRate=100.0", sensors=["accel"])
def _(folder: Path, log: Log) -> Path:
    return text(folder, [*xyz("imu_acc_{}")], [log.force], sep="\t",
                before="DataRate=100.000000\nDataType=double\nversion=3\nendheader\n")  # fmt: skip


@dialect("gravity vector named gx, gy, gz", sensors=[], must=["asked"])
def _(folder: Path, log: Log) -> Path:
    return text(folder, ["time", *xyz("g{}")], [log.time, log.force / G])


@dialect("roll, pitch, yaw and positions only", sensors=[], must=["asked"])
def _(folder: Path, log: Log) -> Path:
    return text(folder, ["time", "roll", "pitch", "yaw", *xyz("p_{}"), *xyz("v_{}")],
                [log.time, log.rate * DEG, log.force * 0.3, log.rate])  # fmt: skip


@dialect("camera trajectory (TUM): t, position, quaternion", sensors=[], must=["asked"])
def _(folder: Path, log: Log) -> Path:
    return text(folder, None, [log.time + EPOCH, log.force * 0.1, log.attitude], sep=" ")


@dialect("JSON lines of a microcontroller")
def _(folder: Path, log: Log) -> Path:
    lines = [json.dumps({"t": int(t * 1e6), "ax": f[0] / G, "ay": f[1] / G, "az": f[2] / G, "gx": w[0] * DEG,
                         "gy": w[1] * DEG, "gz": w[2] * DEG})
             for t, f, w in zip(log.time, log.force, log.rate, strict=True)]  # fmt: skip
    (folder / "log.json").write_text("\n".join(lines))
    return folder / "log.json"


@dialect("phyphox, remote JSON of buffers", sensors=["accel"])
def _(folder: Path, log: Log) -> Path:
    parts = {"acc_time": log.time, "accX": log.force[:, 0], "accY": log.force[:, 1], "accZ": log.force[:, 2]}
    buffer = {name: {"size": 0, "updateMode": "full", "buffer": values.tolist()} for name, values in parts.items()}
    (folder / "get.json").write_text(json.dumps({"buffer": buffer, "status": {"measuring": True, "countDown": 0}}))
    return folder / "get.json"


@dialect("two units in one table", answers=[], must=["line", "asked"])
def _(folder: Path, log: Log) -> Path:
    names = ["time", *xyz("imu1_acc_{}"), *xyz("imu1_gyr_{}"), *xyz("imu2_acc_{}"), *xyz("imu2_gyr_{}")]
    return text(folder, names, [log.time, log.force, log.rate, -log.force[:, [1, 0, 2]], -log.rate[:, [1, 0, 2]]])


@dialect("WitMotion in Chinese")
def _(folder: Path, log: Log) -> Path:
    names = ["时间", "设备名称", *XYZ("加速度{}(g)"), *XYZ("角速度{}(°/s)"), *XYZ("角度{}(°)"), "温度(°C)"]
    return text(folder, names, [clock(log.time, day="2024-5-1 "), ["WT"] * len(log.time), log.force / G,
                                log.rate * DEG, log.rate, log.heat], sep="\t")  # fmt: skip


@dialect("Excel's Unicode text (UTF-16)")
def _(folder: Path, log: Log) -> Path:
    path = text(folder, ["time [s]", *xyz("acc_{} [g]"), *xyz("gyr_{} [dps]")],
                [log.time, log.force / G, log.rate * DEG], sep="\t")  # fmt: skip
    path.write_text(path.read_text(encoding="utf-8"), encoding="utf-16")
    return path


@dialect("sensors above, axes below")
def _(folder: Path, log: Log) -> Path:
    return text(folder, ["s", *XYZ("{}"), *XYZ("{}")], [log.time, log.force, log.rate],
                before="Time,Accelerometer,,,Gyroscope,,\n")  # fmt: skip


# --- tables of random make

_FORCES = {"m/s^2": 1.0, "g": 1 / G, "mg": 1e3 / G, "count": 16384 / G}
_RATES = {"rad/s": 1.0, "deg/s": DEG, "mdeg/s": 1e3 * DEG, "count": 131 * DEG}
_TIMES = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_HABITS = (("acc_{}", "gyr_{}"), ("a{}", "g{}"), ("Accel_{}", "Gyro_{}"), ("accel{}", "omega{}"),
           ("specific_force_{}", "rot_{}"), ("chan_a_{}", "chan_b_{}"))  # fmt: skip


def random_table(seed: int) -> Dialect:
    """Any order of any columns in any units, with or without names and stamps; answers fill a line's blanks."""
    random = np.random.default_rng(seed)

    def one(choices: Sequence[Any]) -> Any:
        return choices[int(random.integers(len(choices)))]

    log = simulate(one(("poses", "poses", "rest", "walk")), int(random.integers(5)))
    force, rate, stamp = one([*_FORCES]), one([*_RATES]), one([*_TIMES])
    parts: dict[str, Any] = {"accel": log.force * _FORCES[force], "gyro": log.rate * _RATES[rate]}
    parts = {name: whole(values) if unit == "count" else values
             for (name, values), unit in zip(parts.items(), (force, rate), strict=True)}  # fmt: skip
    more = {"mag": log.field * one((1, 0.01, 10)), "temp": log.heat, "quat": log.attitude,
            "packet": np.arange(len(log.time)), "lin_acc": log.force * 0.02}  # fmt: skip
    parts |= {name: values for name, values in more.items() if random.random() < 0.3}
    order = [*parts]
    random.shuffle(order)
    if random.random() < 0.85:
        time = (log.time + one((0, EPOCH))) * _TIMES[stamp]
        parts["time"] = time if stamp == "s" else whole(time)
        order.insert(0, "time")
    accel, gyro = one(_HABITS)
    titles = {"accel": xyz(accel), "gyro": xyz(gyro), "mag": xyz("mag_{}"), "quat": [f"q{k}" for k in range(4)],
              "lin_acc": xyz("lin_acc_{}")}  # fmt: skip
    names = [title for name in order for title in titles.get(name, [name])] if random.random() < 0.5 else None
    units = {"accel": force, "gyro": rate, "time": stamp}
    said = tuple(f"{name} [{units[name]}]" for name in order if name in units)
    return Dialect(f"table {seed}", lambda folder, _: text(folder, names, [parts[name] for name in order]), log, BOTH,
                   said, None, (), 0.03 if "count" in (force, rate) else 0.0)  # fmt: skip


def wrong_line(dialect: Dialect, folder: Path) -> str:
    """What is wrong with the line offered for a random table, blanks filled in by the truth; nothing where it is right.

    A line that leaves the accelerometer open is none; one that leaves the gyroscope out must have asked for it.
    """
    path = dialect.write(folder, dialect.log)
    advice = advise_reading(path)
    assert advice is not None
    if not advice.accelerometer:
        return "" if advice.questions else "nothing is found and nothing asked"
    columns = advice.columns or ""
    for entry in dialect.answers:
        columns = columns.replace(f"{entry.partition(' ')[0]} [?]", entry)
    held = dialect
    if columns and "gyro" not in columns:
        if not any("gyroscope" in question.text for question in advice.questions):
            return f"{advice.line()}: the gyroscope is left out"
        held = Dialect(**{**dialect.__dict__, "sensors": frozenset({"accel"})})
    scales = {"accel_scale": advice.accel_scale, "gyro_scale": advice.gyro_scale}
    truth = {"accel_scale": "16384 count/g", "gyro_scale": "131 count/(deg/s)"}
    stated = {name: truth[name] if text == "?" else text for name, text in scales.items()}
    rate = RATE if advice.rate == "?" else None
    options = ReadOptions(columns=columns or None, rate=rate, check=False, **stated)
    wrong = off(held, read_recording(path, options=options))
    return f"{advice.line()}: {wrong}" if wrong else ""
