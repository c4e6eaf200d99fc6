"""Column names by which a table shows what wrote it, and so which units it is in without saying so."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePath

from jaximu.formats.table import Table

__all__ = ["known_names"]


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
)  # fmt: skip
_SENSOR_LOGGER = {"time": "time [ns]", "seconds_elapsed": "", "x": "", "y": "", "z": ""}


def known_names(table: Table) -> tuple[tuple[str, ...], str] | None:
    """The names in our words, with units, for a table whose names show what wrote it, and a note; None for any other.

    What is not used keeps its name.
    """
    if table.names is None:
        return None
    names = [re.sub(r"\s*[\[(].*", "", name.strip('" #')).lower() for name in table.names]
    layout = next((each for each in _LAYOUTS if each.fits(names)), None)
    if layout is None and set(_SENSOR_LOGGER) == set(names):  # one file a sensor, named after it
        file = PurePath(table.path).name.lower()
        if "gyro" in file or "accel" in file:
            title = "gyro_{} [rad/s]" if "gyro" in file else "accel_{} [m/s^2]"
            columns = _SENSOR_LOGGER | {axis: title.format(axis) for axis in "xyz"}
            layout = _Layout(f"Sensor Logger (ns, rad/s, m/s^2; {file})", columns)
    if layout is None:
        return None
    ours = tuple(layout.columns.get(name) or given for name, given in zip(names, table.names, strict=True))
    return ours, f"columns and units as {layout.program} has them."
