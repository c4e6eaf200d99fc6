"""Options that mean the same on every verb, and how they are read."""

from __future__ import annotations

import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from jaximu.errors import InputError
from jaximu.gravity import STANDARD, LocalGravity, parse_gravity, wgs84_gravity

if TYPE_CHECKING:
    from jaximu.formats import ReadOptions
    from jaximu.recording import Recording

__all__ = ["GravityOptions", "JsonFlag", "LogOptions", "Logs", "OutputFolder", "RepairFlag", "TraceOptions", "beginning",
           "is_toml", "progress", "require_files", "say"]  # fmt: skip

Logs = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(name="log", metavar="LOG [LOG ...]")]
JsonFlag = Annotated[bool, tyro.conf.arg(name="json", help="Print one JSON document on stdout and nothing else.")]
RepairFlag = Annotated[
    bool, tyro.conf.arg(help="Change what can be put right in the recording: lost time, overflows; said in the notes.")
]
OutputFolder = Annotated[
    Path | None, tyro.conf.arg(name="output", aliases=["-o"], metavar="DIR", help="Folder for results and report.")
]

_LARGEST_TEXT = 1 << 20  # bytes; a specification is no longer
_LONG = 2.0  # s; a stage that takes longer says how long it took


@dataclass(frozen=True)
class LogOptions:
    """How to read a log that does not say everything itself."""

    gyro_log: Path | None = None
    """The gyroscope's own file, where it is not in LOG."""
    columns: str | None = None
    """Names of all columns in order, with units: "time [s],accel [m/s^2],gyro [rad/s]"; "_" ignores a column."""
    gyro_columns: str | None = None
    """The same for the gyroscope's file."""
    rate: float | None = None
    """Sample rate in Hz, for a log without a time column."""
    axes: str | None = None
    """Map to body axes: FLU, FRD, "y,-x,z"; "accel=…;gyro=…"; "FRD;-f" for a logger of minus specific force."""
    accel_scale: str | None = None
    """Counts: "16384 count/g" or "0.061 mg/count"; bare from 1 up: counts per m/s², below: m/s² per count."""
    accel_offset: str | None = None
    """Counts at zero specific force, one number or three."""
    gyro_scale: str | None = None
    """Counts: "131 count/(deg/s)"; bare from 1 up: counts per rad/s, below: rad/s per count."""
    gyro_offset: str | None = None
    """Counts at zero rate, one number or three."""
    topic: str | None = None
    """Of a bag or flight log: the topic or message, or two, the accelerometer's and the gyroscope's: A,B."""
    instance: int | None = None
    """Which of a flight log's sensors, from 0."""
    stamp: str = "header"
    """Time of a message: "header" (the sensor's own) or "receive" (the logger's)."""

    def read(self, path: Path, gravity: LocalGravity = STANDARD, check: bool = True, alone: bool = False) -> Recording:
        """Read one log; with `alone` it may hold a gyroscope and nothing else."""
        require_files(path, self.gyro_log)
        from jaximu.formats import read_recording

        return read_recording(path, self.gyro_log, self.reading(gravity, check, alone))

    def reading(self, gravity: LocalGravity = STANDARD, check: bool = True, alone: bool = False) -> ReadOptions:
        """Return what the library asks for."""
        from jaximu.formats import ReadOptions

        return ReadOptions(
            columns=self.columns, gyro_columns=self.gyro_columns, rate=self.rate, axes=self.axes,
            accel_scale=self.accel_scale, accel_offset=self.accel_offset,
            gyro_scale=self.gyro_scale, gyro_offset=self.gyro_offset, gravity=gravity, check=check, alone=alone,
            topic=self.topic, instance=self.instance, stamp=self.stamp,
        )  # fmt: skip

    def read_all(self, paths: tuple[Path, ...], gravity: LocalGravity, alone: bool = False) -> list[Recording]:
        """Read the logs of one unit."""
        if not paths:
            raise InputError("no log was given: name one or more files.")
        if self.gyro_log is not None and len(paths) > 1:
            raise InputError("--gyro-log goes with one LOG; with several, each must hold its own gyroscope.")
        return [self.read(path, gravity, alone=alone) for path in paths]


@dataclass(frozen=True)
class GravityOptions:
    """Local gravity; by default standard gravity with the spread of gravity over the Earth."""

    gravity: str | None = None
    """Local gravity in m/s², with its standard deviation if you know it: 9.81744 or 9.81744+-0.0005."""
    latitude: float | None = None
    """Latitude in degrees, for gravity (WGS-84) and the Earth's rotation."""
    height: float = 0.0
    """Height above sea level in m, with --latitude."""

    def value(self) -> LocalGravity:
        """Return the gravity that was asked for."""
        if self.gravity is not None and self.latitude is not None:
            raise InputError("give either --gravity or --latitude, not both.")
        if self.gravity is not None:
            return parse_gravity(self.gravity)
        if self.latitude is not None:
            return wgs84_gravity(self.latitude, self.height)
        if self.height:
            raise InputError("--height needs --latitude.")
        return STANDARD


@dataclass(frozen=True)
class TraceOptions:
    """Which unit it is and who calibrated it, kept in calibration.json; LOG.trace.toml is read where it is."""

    trace: Path | None = None
    """File with serial number, operator, references and more; `jaximu accept --explain` shows one."""
    serial: str | None = None
    """Serial number of the unit."""
    lot: str | None = None
    """Production lot."""
    operator: str | None = None
    """Who calibrates."""
    station: str | None = None
    """Where it is calibrated."""
    fixture: str | None = None
    """What the unit is mounted in."""
    date: str | None = None
    """Date of the calibration, such as 2026-03-04."""

    def value(self, logs: tuple[Path, ...]) -> dict[str, Any] | None:
        """Return what the file, the file beside the first log and the options say; None where nothing is said."""
        from jaximu.formats.trace import read_trace, sidecar

        path = self.trace if self.trace is not None or not logs else sidecar(logs[0])
        if path is not None and self.trace is None:
            say(f"{path} is read: it lies beside the log.")
        stated = {each.name: getattr(self, each.name) for each in fields(self) if each.name != "trace"}
        return read_trace(path, stated) or None


def require_files(*paths: Path | None) -> None:
    """Refuse a file that is not there before anything that takes time is loaded."""
    for path in filter(None, paths):
        try:
            path.stat()
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}.") from error


def beginning(path: Path) -> bytes:
    """Return what a file begins with, as far as a text that a person wrote goes."""
    try:
        with open(path, "rb") as file:
            return file.read(_LARGEST_TEXT)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error


def is_toml(path: Path) -> bool:
    """Tell a specification from a log, by content."""
    try:
        return bool(tomllib.loads(beginning(path).decode("utf-8")))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError):
        return False


def say(text: str) -> None:
    """Write prose to stderr, out of the way of results."""
    print(text, file=sys.stderr)


@contextmanager
def progress(text: str) -> Iterator[Callable[[str], None]]:
    """Show a stage of the work on stderr, and the time it takes: live on a terminal, else in plain lines.

    **Gives** a function that takes what the stage is at, in words.
    """
    began = said = time.monotonic()
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        columns = SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn()
        with Progress(*columns, console=Console(stderr=True), transient=True, redirect_stdout=False) as shown:
            task = shown.add_task(text, total=None)
            yield lambda part: shown.update(task, description=f"{text}: {part}")
        return

    def tell(part: str) -> None:
        nonlocal said
        if (now := time.monotonic()) - said > _LONG:
            said = now
            say(f"{text}: {part}, {now - began:.0f} s")

    say(f"{text} …")
    yield tell
    if (elapsed := time.monotonic() - began) > _LONG:
        say(f"{text}: done in {elapsed:.0f} s")
