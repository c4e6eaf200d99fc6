"""Column names by which a table shows what wrote it, and so which units it is in without saying so."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import PurePath

import numpy as np

from jaximu.formats.table import Table
from jaximu.units import find_unit, parse_column

__all__ = ["known_names", "whole_stamps"]


@dataclass(frozen=True)
class _Layout:
    """The names of a program's columns, lower case, without units, and what each is, with its unit."""

    program: str
    columns: Mapping[str, str]
    optional: frozenset[str] = frozenset()

    def fits(self, names: list[str]) -> bool:
        return set(self.columns) - self.optional <= set(names)


def _triads(pattern: str, title: str, axes: str = "xyz") -> dict[str, str]:
    name, _, unit = title.partition(" ")
    return {pattern.format(axis): f"{name}_{axis} {unit}" for axis in axes}


_OPTICAL = _triads("opt_quat_{}", "attitude [1]", "wxyz")
_LAYOUTS = (
    _Layout(
        "EuRoC (ASL dataset format: ns, rad/s, m/s^2)",
        {"timestamp": "time [ns]"} | _triads("w_rs_s_{}", "gyro [rad/s]") | _triads("a_rs_s_{}", "accel [m/s^2]"),
    ),
    _Layout(
        "Kalibr's bag extractor (ns, rad/s, m/s^2)",
        {"timestamp": "time [ns]"} | _triads("omega_{}", "gyro [rad/s]") | _triads("alpha_{}", "accel [m/s^2]"),
    ),
    _Layout(
        "the BROAD data set (m/s^2, rad/s, uT; opt_quat is the sensor's attitude)",
        _triads("imu_acc_{}", "accel [m/s^2]") | _triads("imu_gyr_{}", "gyro [rad/s]")
        | _triads("imu_mag_{}", "mag [uT]") | _OPTICAL,
        frozenset({*_OPTICAL, *_triads("imu_mag_{}", "")}),
    ),
    _Layout(
        "the MARS logger (ns, rad/s, m/s^2)",
        {"timestamp": "time [ns]"} | _triads("g{}", "gyro [rad/s]") | _triads("a{}", "accel [m/s^2]")
        | {"unix time": ""},
    ),
    _Layout(
        "Physics Toolbox (gF is the specific force in g; a without gravity is not used)",
        {"time": "time [s]"} | _triads("gf{}", "accel [g]") | _triads("w{}", "gyro [rad/s]")
        | _triads("b{}", "mag [uT]") | _triads("a{}", "without_gravity"),
        frozenset({"time", *_triads("w{}", ""), *_triads("b{}", ""), *_triads("a{}", "")}),
    ),
    _Layout(
        "MicroStrain's SensorConnect (g, rad/s, G)",
        {"time": "time [ns]"} | _triads("scaledaccel{}", "accel [g]") | _triads("scaledgyro{}", "gyro [rad/s]")
        | _triads("scaledmag{}", "mag [G]"),
        frozenset({"time", *_triads("scaledgyro{}", ""), *_triads("scaledmag{}", "")}),
    ),
    _Layout(
        "MicroStrain's MIP Monitor (s, g, rad/s, G)",
        {"gps tow": "time [s]"} | _triads("{} accel", "accel [g]") | _triads("{} gyro", "gyro [rad/s]")
        | _triads("{} mag", "mag [G]"),
        frozenset({"gps tow", *_triads("{} gyro", ""), *_triads("{} mag", "")}),
    ),
    _Layout(
        "VectorNav (ns, m/s^2, rad/s, G)",
        {"timestartup": "time [ns]"} | _triads("uncompacc{}", "accel [m/s^2]")
        | _triads("uncompgyro{}", "gyro [rad/s]") | _triads("uncompmag{}", "mag [G]"),
        frozenset(_triads("uncompmag{}", "")),
    ),
    _Layout(
        "VectorNav (ns, m/s^2, rad/s, G)",
        {"timestartup": "time [ns]"} | _triads("accel{}", "accel [m/s^2]") | _triads("gyro{}", "gyro [rad/s]")
        | _triads("mag{}", "mag [G]"),
        frozenset(_triads("mag{}", "")),
    ),
    _Layout(
        "NaveGo (s, m/s^2, rad/s)",
        {"t": "time [s]"} | _triads("fb_{}", "accel [m/s^2]") | _triads("wb_{}", "gyro [rad/s]"),
    ),
    _Layout(
        "MAVLink SCALED_IMU (ms, mg, mrad/s, mG)",
        {"time_boot_ms": "time [ms]"} | _triads("{}acc", "accel [mg]") | _triads("{}gyro", "gyro [mrad/s]")
        | _triads("{}mag", "mag [mG]"),
        frozenset(_triads("{}mag", "")),
    ),
)  # fmt: skip
_ROS = _triads("angular_velocity.{}", "gyro [rad/s]") | _triads("linear_acceleration.{}", "accel [m/s^2]")
_ROS_STAMPS: tuple[dict[str, str], ...] = (
    {"header.stamp.sec": "", "header.stamp.nanosec": ""},
    {"header.stamp.secs": "", "header.stamp.nsecs": ""},
    {"header.stamp": "time [ns]"},
)
_LAYOUTS += tuple(
    _Layout(
        "a table of sensor_msgs/Imu (rad/s, m/s^2), time being the header's stamp",
        {f"{prefix}{name}": unit for name, unit in (stamp | _ROS).items()} | {"time": "received", "%time": "received"},
        frozenset({"time", "%time"}),
    )
    for stamp in _ROS_STAMPS
    for prefix in ("", "field.", "msg.")
)
_LATEST = 2**33  # s
_PAIRS = (("sec", "nanosec"), ("secs", "nsecs"), ("seconds", "nanoseconds"), ("sec", "nsec"))
_SENSOR_LOGGER = {"time": "time [ns]", "seconds_elapsed": "", "x": "", "y": "", "z": ""}


def known_names(table: Table) -> tuple[tuple[str, ...], str] | None:
    """The names in our words, with units, for a table whose names show what wrote it, and a note; None for any other.

    What is not used keeps its name.
    """
    if table.names is None:
        return _sentences(table)
    names = [re.sub(r"\s*[\[(].*", "", name.strip('" #').rpartition(":")[2]).lower() for name in table.names]
    prefixes = {match[0] for name in names if (match := re.match(r".*\.(?=fb_x$)", name))}
    if len(prefixes) == 1:  # the structure that holds them all
        names = [name.removeprefix(*prefixes) for name in names]
    layout = next((each for each in _LAYOUTS if each.fits(names)), None)
    if layout is None and set(_SENSOR_LOGGER) == set(names):  # one file a sensor, named after it
        file = PurePath(table.path).name.lower()
        if "gyro" in file or "accel" in file:
            title = "gyro_{} [rad/s]" if "gyro" in file else "accel_{} [m/s^2]"
            columns = _SENSOR_LOGGER | {axis: title.format(axis) for axis in "xyz"}
            layout = _Layout(f"Sensor Logger (ns, rad/s, m/s^2; {file})", columns)
    if layout is None and "accelerometeraccelerationx" in names:
        return table.names, (
            "names as SensorLog for iOS has them: Apple's accelerometer reads -1 g on the axis that points up; add "
            '--axes "-f" to have specific force.'
        )
    if layout is None:
        return None
    ours = tuple(
        title if (title := layout.columns.get(name)) and not (title.startswith("time") and _stated(given)) else given
        for name, given in zip(names, table.names, strict=True)
    )
    return ours, f"columns and units as {layout.program} has them."


_SENTENCES = {
    "$VNIMU": ("", *_triads("{}", "mag [G]").values(), *_triads("{}", "accel [m/s^2]").values(),
               *_triads("{}", "gyro [rad/s]").values(), "temperature [degC]", "pressure"),
    "$VNYMR": ("", "yaw", "pitch", "roll", *_triads("{}", "mag [G]").values(),
               *_triads("{}", "accel [m/s^2]").values(), *_triads("{}", "gyro [rad/s]").values()),
}  # fmt: skip


def _sentences(table: Table) -> tuple[tuple[str, ...], str] | None:
    """The names of rows that begin with the name of a VectorNav sentence."""
    first = table.columns[0]
    names = _SENTENCES.get(str(first[0])) if first.dtype == object and (first == first[0]).all() else None
    if names is None or len(names) != len(table.columns):
        return None
    return names, f"columns and units as VectorNav's {first[0]} has them (G, m/s^2, rad/s)."


def _stated(name: str) -> bool:
    unit = parse_column(name)[1]
    return bool(unit and find_unit(unit, "time"))


def whole_stamps(table: Table) -> Table:
    """The table with its stamps as one column where its header has them as seconds and nanoseconds, as ROS writes them.

    The column of the seconds holds them then, as `time [ns]`; that of the nanoseconds stays.
    """
    plain = [name.strip('" #').lower() for name in table.names or ()]
    for seconds, rest in _PAIRS:
        for at, name in enumerate(plain):
            prefix, found, _ = name.rpartition(seconds)
            if not found or name != prefix + seconds or plain.count(prefix + rest) != 1 or prefix[-1:].isalnum():
                continue
            parts = [np.asarray(table.columns[each]) for each in (at, plain.index(prefix + rest))]
            if any(each.dtype.kind != "i" or (each < 0).any() or (each > _LATEST).any() for each in parts):
                continue
            names = [*(table.names or ())]
            names[at] = "time [ns]"
            columns = [*table.columns]
            columns[at] = parts[0] * 10**9 + parts[1]
            note = f"time is {name} and {prefix + rest}."
            return replace(table, names=tuple(names), columns=tuple(columns), notes=(*table.notes, note))
    return table
