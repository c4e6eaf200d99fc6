"""The formats that a calibration is exported to: one line a file."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from jaximu.ground.atomic import write_files
from jaximu.ground.errors import FilePath, InputError, nearest

if TYPE_CHECKING:
    from jaximu.report.export.base import ExportedUnit, Written


WRITERS = {
    name: f"jaximu.report.export.{name.replace('-', '_')}"
    for name in (
        "kalibr",
        "imu_tk",
        "vins",
        "openvins",
        "px4",
        "ardupilot",
        "realsense",
        "ros-yaml",
        "c-header",
        "fusion",
        "csv",
        "npz",
    )
}
"""The module of each format: `write`, `SUFFIX` and `SUMMARY`, `MAGNETIC` where it takes a magnetometer, `NOISE`
where it takes noise."""


def writer(name: str) -> ModuleType:
    """The module of a format. Raises `InputError` naming the ones there are."""
    plain = re.sub(r"[-_ .]", "", name.lower())
    for known, module in WRITERS.items():
        parts = re.split("[-_]", known)  # "c" is the C header, "ros" the YAML of ROS, "imu-tk" is imu_tk
        if plain in ("".join(parts), parts[0]):
            return import_module(module)
    raise InputError(f"--to: {name!r} is no format; {nearest(name, WRITERS)}")


def export(parameters: ExportedUnit, to: str, path: FilePath) -> tuple[Written, tuple[Path, ...]]:
    """Write a calibration for another tool, all of its files or none; return what was written, and where.

    A format of several files puts its endings before the suffix: `unit.calib` becomes `unit_acc.calib`.
    Raises `InputError` or `NotPossibleError` where the tool cannot take this calibration.
    """
    written = writer(to).write(parameters)
    target = Path(path)
    if target.is_dir():
        raise InputError(f"{target} is a folder: name the file to write, -o {target / 'FILE'}.")
    return written, write_files(
        {
            target.with_name(f"{target.stem}{ending}{target.suffix}"): content
            for ending, content in written.files.items()
        }
    )
