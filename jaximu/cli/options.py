"""Options that mean the same on every verb, and how they are read."""

from __future__ import annotations

import json
import re
import shlex
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar, dataclass_transform, get_type_hints

from tyro.conf import Positional, Suppress, UseAppendAction, arg

import jaximu
from jaximu.cli.messages import progress, say
from jaximu.ground.atomic import write_folder
from jaximu.ground.document import Json
from jaximu.ground.errors import InputError, JaximuError, readable
from jaximu.ground.gravity import STANDARD, LocalGravity, parse_gravity, wgs84_gravity
from jaximu.ground.magnetic_field import FieldStrength
from jaximu.ground.quantities import counted, listed
from jaximu.ground.reexport import later
from jaximu.ground.units import SENSOR_QUANTITIES

if TYPE_CHECKING:
    from jaximu.ground.document import Document
    from jaximu.ground.page import Page
    from jaximu.model.noise_model import NoiseModel
    from jaximu.noise.stated import SensorNoise
    from jaximu.recordings.recording import Recording


_TYRO = "tyro"
"""Under which a field's metadata hold what tyro is to know of the option."""
Kind = TypeVar("Kind", bound=type)


def option(metavar: str, text: str, default: Any = None, *markers: Any, **more: Any) -> Any:
    """Return the field of an option: what its value is called in the help, what it does, and its default.

    `markers`, `more`: as tyro has them beside `arg` and in it.
    """
    return field(default=default, metadata={_TYRO: (arg(metavar=metavar or None, help=text, **more), *markers)})


def switch(text: str, default: Any = False, *markers: Any, **more: Any) -> Any:
    """Return the field of an option whose values need no name: a flag, or one of several words."""
    return option("", text, default, *markers, **more)


@dataclass_transform(frozen_default=True)
def takes_options(kind: Kind) -> Kind:
    """Make a class a frozen dataclass whose fields are options."""
    made = dataclass(frozen=True)(kind)
    hints = get_type_hints(made, include_extras=True)
    for part in fields(made):
        if _TYRO in part.metadata:
            made.__annotations__[part.name] = Annotated[(hints[part.name], *part.metadata[_TYRO])]
    return made


Logs = Annotated[
    tuple[Path, ...],
    Positional,
    arg(metavar="LOG [LOG ...]", help="Recordings of one unit, in any format that jaximu reads.", name="log"),
]
CalibrationFile = Annotated[Path, Positional, arg(metavar="CALIBRATION", help="A calibration.json that jaximu wrote.")]
NoiseFile = Annotated[
    Path | None,
    arg(
        metavar="FILE",
        help="Noise that is known: an allan.json, a Kalibr imu.yaml, or a SPEC as `jaximu simulate` takes it.",
        name="noise",
    ),
]
DIAGNOSIS = "DIAGNOSIS.json", "Also allow for what the recording cannot see: causes as large as their limits."
LossChoice = Annotated[Literal["linear", "huber", "cauchy"], arg(help="Least squares, or robust against outliers.")]
JsonFlag = Annotated[bool, arg(name="json", help="Print one JSON document on stdout, errors too.")]
ForceFlag = Annotated[bool, arg(help="Replace results that would be lost: a calibration of other sensors in DIR.")]
RepairFlag = Annotated[
    bool, arg(help="Repair lost samples, overflows and axes where possible; the notes say what was changed.")
]
FieldText = Annotated[str | None, arg(metavar="H[+-S]", help="Field strength in µT, if known: 48.9 or 48.9+-0.2.")]
EffectNames = Annotated[
    tuple[str, ...],
    UseAppendAction,
    arg(metavar="NAME", help="Also fit this effect; NAME+-SIGMA if its size is known to SIGMA. May be repeated."),
]

INERTIAL = ("accelerometer", "gyroscope")
"""The sensors that a calibration of poses and turns can hold."""
_LARGEST_TEXT = 1 << 20  # bytes; a specification is no longer
_PLACEHOLDER = re.compile(r"(?<![\w/.-])CALIBRATION(_\d+)?(?![\w/.-])")
"""In a page's next command: a file that is being written."""


_RATE = re.compile(r"[\d.]+ ?Hz")


@takes_options
class LogOptions:
    """How to read a log that does not say everything itself."""

    title: ClassVar[str] = "Reading"
    gyro_log: Path | None = option("LOG", "The gyroscope's own file, if it is not in LOG.")
    columns: str | None = option(
        "NAMES",
        'Names of all columns in order, with units: "time [s],accel [m/s^2],gyro [rad/s]"; "_" skips a column. '
        "Of several logs that differ, the names of each, with semicolons between them; none where its header does.",
    )
    gyro_columns: str | None = option("NAMES", "The same for the gyroscope's file.")
    rate: float | None = option("HZ", "Sample rate of a log without a time column.")
    axes: str | None = option(
        "MAP",
        'Body axes: FLU, FRD or "y,-x,z"; one sensor: "accel=…;gyro=…"; add ";-f" if the '
        "logger records minus specific force.",
    )
    accel_scale: str | None = option(
        "SCALE",
        'Scale of raw counts: "16384 count/g" or "0.061 mg/count". A bare number from 1 up '
        "is counts per m/s², below 1 m/s² per count.",
    )
    accel_offset: str | None = option("COUNTS", "Counts at zero specific force, one number or three.")
    gyro_scale: str | None = option(
        "SCALE",
        'Scale of raw counts: "131 count/(deg/s)". A bare number from 1 up is counts per '
        "rad/s, below 1 rad/s per count.",
    )
    gyro_offset: str | None = option("COUNTS", "Counts at zero rate, one number or three.")
    device: str | None = option(
        "ID", "Whose rows to take of a table in which several units write in turn; for array ID,ID,…."
    )
    topic: str | None = option(
        "TOPIC", "Topic or message of a bag or flight log; A,B if the accelerometer and the gyroscope have one each."
    )
    instance: int | None = option("N", "Which of a flight log's sensors, from 0.")
    stamp: str = option("{header,receive}", "Time of a message: the sensor's own or the logger's.", "header")
    like: Suppress[Any] = field(default=None, repr=False)  # no option: see `alike`

    def alike(self, calibration: jaximu.Calibration | None) -> LogOptions:
        """Return the options for a log that is to be read as a calibration's was."""
        if calibration is None or calibration.reading is None:
            return self
        triads = calibration.triads()
        units = {name: unit for name, unit in calibration.reading.units.items() if name in triads}
        return replace(self, like=replace(calibration.reading, units=units))

    def with_gyroscope(self, path: Path) -> LogOptions:
        """Return the options with the gyroscope's file, where an app or a logger wrote one beside the accelerometer's.

        Rates in the two names may differ.
        """
        wanted = re.sub("(Total)?Accelero?(meter|ation)", "Gyroscope", path.name)
        if wanted == path.name or self.gyro_log is not None or self.columns is not None or not path.parent.is_dir():
            return self
        alike = [other for other in path.parent.iterdir() if _RATE.sub("", other.name) == _RATE.sub("", wanted)]
        return replace(self, gyro_log=alike[0]) if len(alike) == 1 and alike[0].is_file() else self

    def read(self, path: Path, gravity: LocalGravity = STANDARD, check: bool = True, alone: bool = False) -> Recording:
        """Read one log; with `alone` it may hold a gyroscope and nothing else."""
        require_files(path, self.gyro_log)

        gyroscope = self.with_gyroscope(path).gyro_log
        if gyroscope != self.gyro_log:
            say(f"{gyroscope} is read: it lies beside the log.")
        recording = jaximu.read_recording(path, gyroscope, self.reading(gravity, check, alone))
        if self.like is not None:
            names = [name for name in ("columns", "gyro_columns", "axes") if getattr(self, name) is None]
            taken = typed(LogOptions(**{name: getattr(recording.reading, name) for name in names}))
            if taken:
                say(f"{path} is read as the calibrated log was:{taken}.")
        return recording

    def stated(self) -> tuple[tuple[str, str], ...]:
        """Return the options that were given, by name, as a fleet's jobs have them."""
        return tuple(sorted((name, str(value)) for name, value in vars(self).items() if value is not None))

    def restated(self, stated: Iterable[tuple[str, str]]) -> LogOptions:
        """Return the options with others in their place, by name, as a fleet's jobs have them."""
        kinds = {"gyro_log": Path, "rate": float, "instance": int}
        return replace(self, **{name: kinds.get(name, str)(value) for name, value in stated})

    def reading(self, gravity: LocalGravity = STANDARD, check: bool = True, alone: bool = False) -> jaximu.ReadOptions:
        """Return what the library asks for."""
        stated = {name: value for name, value in vars(self).items() if name != "gyro_log"}
        return jaximu.ReadOptions(**stated, gravity=gravity, check=check, alone=alone)

    def read_unit(
        self,
        paths: tuple[Path, ...],
        gravity: LocalGravity,
        noise: NoiseOptions | None = None,
        alone: bool = False,
        several: bool = False,
    ) -> tuple[list[Recording], Recording | NoiseModel | None]:
        """Read the logs of one unit, and its recording at rest, or the noise that is stated, if there is one.

        With `several` one log may hold several units, by their columns or by the IDs of their rows.
        """
        if self.gyro_log is not None and len(paths) > 1:
            raise InputError("--gyro-log goes with one LOG; with several, each must hold its own gyroscope.")
        with progress("reading"):
            noise = noise or NOISE
            require_files(*paths, noise.static, noise.noise)
            logs = self.spread(paths)
            if len(logs) > len(paths) and not several:
                raise InputError(
                    "--device and --columns choose one unit here; several in one log are for jaximu array."
                )
            recordings: list[Recording] = []
            for path, log in logs:
                try:
                    recordings.append(log.read(path, gravity, alone=alone))
                except InputError as error:
                    if self.columns is not None or not recordings:
                        raise
                    # the logs before this one keep what their headers say
                    before, after = ";" * len(recordings), ";" * (len(logs) - 1 - len(recordings))
                    text = re.sub(r'--columns "([^"]*)"', rf'--columns "{before}\1{after}"', str(error.args[0]))
                    raise InputError(text) from error
            return recordings, noise.value(replace(logs[0][1], gyro_log=None), gravity)  # --gyro-log is LOG's

    def spread(self, paths: tuple[Path, ...]) -> list[tuple[Path, LogOptions]]:
        """Return each log with its own columns and device, where one is given for each; one log may serve for all.

        Raises `InputError` where their numbers differ.
        """
        layouts = [None] if self.columns is None else self.columns.split(";")
        devices = [None] if self.device is None else self.device.split(",")
        count = max(map(len, (paths, layouts, devices)))
        for option, parts in (("--columns", layouts), ("--device", devices), ("LOG", paths)):
            if len(parts) not in (1, count):
                raise InputError(f"{option}: {len(parts)} are given for {count} recordings; give one, or one for each.")
        return [
            (
                paths[at % len(paths)],
                replace(self, columns=layouts[at % len(layouts)] or None, device=devices[at % len(devices)]),
            )
            for at in range(count)
        ]


@takes_options
class NoiseOptions:
    """What is known of the noise, by a recording or by a file that states it."""

    title: ClassVar[str] = "Options"
    static: Path | None = option("LOG", "A recording at rest, to measure noise and bias drift.")
    noise: NoiseFile = None

    def value(self, log: LogOptions, gravity: LocalGravity) -> Recording | NoiseModel | None:
        """Return the recording at rest, read as `log` says, or the noise that a file states."""
        if self.static is not None and self.noise is not None:
            raise InputError("give either --static or --noise, not both.")
        if self.static is not None:
            return log.read(self.static, gravity)
        if self.noise is None:
            return None
        from jaximu.noise.stated import model_of

        return model_of(stated_noise(self.noise))


@takes_options
class GravityOptions:
    """Local gravity; by default standard gravity with the spread of gravity over the Earth."""

    title: ClassVar[str] = "Gravity"
    gravity: str | None = option(
        "G[+-S]",
        "Local gravity in m/s², with its standard deviation if known: 9.81744+-0.0005; a bare 9.81 is "
        "known to half a unit of its last digit. Default: standard gravity, known to 0.015 m/s².",
    )
    latitude: float | None = option(
        "DEG", "Latitude, for gravity (WGS-84; with --gravity that one) and the Earth's rotation."
    )
    height: float = option("M", "Height above sea level, with --latitude.", 0.0)

    def value(self) -> LocalGravity:
        """Return the gravity that was asked for."""
        if self.latitude is None and self.height:
            raise InputError("--height needs --latitude.")
        normal = STANDARD if self.latitude is None else wgs84_gravity(self.latitude, self.height)
        return normal if self.gravity is None else replace(parse_gravity(self.gravity), latitude=normal.latitude)


@takes_options
class PoseOptions:
    """What counts as a pose."""

    title: ClassVar[str] = "Options"
    threshold: float | None = option(
        "X", "A window is stationary below X times the noise floor's variance (default: found)."
    )
    minimum_duration: float = option("S", "Shortest pose, in seconds.", 0.8)

    def value(self) -> jaximu.SegmentationOptions:
        """Return what the library asks for."""
        return jaximu.SegmentationOptions(threshold=self.threshold, minimum_duration=self.minimum_duration)


@takes_options
class TraceOptions:
    """Which unit it is and who calibrated it, kept in calibration.json; LOG.trace.toml is read where it is."""

    title: ClassVar[str] = "Traceability"
    trace: Path | None = option(
        "FILE", "File with serial number, operator, references and more; `jaximu accept --explain` shows one."
    )
    serial: str | None = option("TEXT", "Serial number of the unit.")
    lot: str | None = option("TEXT", "Production lot.")
    operator: str | None = option("TEXT", "Who calibrates.")
    station: str | None = option("TEXT", "Where the unit is calibrated.")
    fixture: str | None = option("TEXT", "What the unit is mounted in.")
    date: str | None = option("DATE", "Date of the calibration, such as 2026-03-04.")

    def value(self, logs: tuple[Path, ...]) -> Json | None:
        """Return what the file, the file beside the first log and the options say; None where nothing is said."""
        from jaximu.recordings.trace import read_trace, sidecar

        path = self.trace if self.trace is not None or not logs else sidecar(logs[0])
        if path is not None and self.trace is None:
            say(f"{path} is read: it lies beside the log.")
        return read_trace(path, {name: value for name, value in vars(self).items() if name != "trace"}) or None


@takes_options
class Results:
    """Where results go: to a folder, and to the terminal as prose or as one JSON document."""

    title: ClassVar[str] = "Output"
    output: Path | None = option("DIR", "Folder for the results and the report.", aliases=["-o"])
    as_json: JsonFlag = False
    force: ForceFlag = False

    @property
    def keeps(self) -> bool:
        """Whether documents beside the one to print are kept."""
        return self.output is not None

    def prepare(self, *sensors: str) -> None:
        """Fail before the work rather than after it: where the folder cannot be made or would lose something.

        `sensors`: those that the calibration to come may hold, where they are known.
        """
        if self.output is not None:
            write_folder(self.output, {})
            if sensors:
                self._require_kept(self.output / "calibration.json", dict.fromkeys(sensors, True))

    def _require_kept(self, path: Path, document: Mapping[str, Any]) -> None:
        """Raise `InputError` where a document would replace a calibration that holds a sensor which it lacks."""
        if self.force or not path.is_file():
            return
        from jaximu.ground.document import read_document

        try:
            old = read_document(path, "jaximu.calibration/1", "a calibration")
        except InputError:  # something else, or damaged
            return
        if lost := [name for name in SENSOR_QUANTITIES if old.get(name) and not document.get(name)]:
            raise InputError(
                f"{path} holds a calibration of the {listed(lost)}, which the new one lacks: replacing the file would "
                "lose it. Name another folder with -o, or replace it with --force."
            )

    def give(
        self,
        show: Callable[[], object],
        write: Callable[[Path], Path | Iterable[Path]],
        names: str = "calibration.json and report.html",
        files: Mapping[str, bytes] = MappingProxyType({}),
        text: Callable[[], str] | None = None,
        **documents: Document,
    ) -> None:
        """Write the documents, each as NAME.json, and `files`; draw the report; only then print the result.

        `write` draws into the folder; `text` makes the document to print, the first of `documents` if None. A report
        that cannot be drawn costs nothing else: a page says so in its place.
        """
        text = text or next(iter(documents.values())).text
        printed = text() if self.as_json else ""
        written: list[Path] = []
        try:
            if self.output is not None:
                written = self._write(self.output, write, files, documents)
        except JaximuError:
            if not self.as_json:
                show()  # what was computed is not lost with its files
            raise
        if self.as_json:
            print(printed)
        else:
            show()
        if self.output is not None:
            say(f"Written to {self.output}: {', '.join(path.name for path in written)}")
        elif not self.as_json:
            say(f"Nothing was written: -o DIR writes {names} there.")

    def present(
        self,
        page: Callable[[], Page],
        names: str = "calibration.json and report.html",
        files: Mapping[str, bytes] = MappingProxyType({}),
        text: Callable[[], str] | None = None,
        **documents: Document,
    ) -> None:
        """Write the documents, each as NAME.json, `files` and the page as report.html; only then print the page.

        `text` makes the document to print with --json, the first of `documents` if None. A page that cannot be drawn
        costs nothing else: another says so in its place.
        """

        @cache
        def made() -> Page:
            content = page()
            return replace(content, next=self.filled(content.next, documents))

        self.give(
            lambda: later("report.terminal", "show")(made()),
            lambda folder: later("report.html", "write_report")(made(), folder),
            names,
            files,
            text,
            **documents,
        )

    def filled(self, text: str, names: Iterable[str]) -> str:
        """Return a next command with the paths of the documents that are written; `names`: theirs, in small letters."""
        folder = self.output
        return text if folder is None else with_paths(text, {name: folder / f"{name}.json" for name in names})

    def _write(
        self,
        folder: Path,
        write: Callable[[Path], Path | Iterable[Path]],
        files: Mapping[str, bytes],
        documents: Mapping[str, Document],
    ) -> list[Path]:
        texts = {f"{name}.json": document.text() for name, document in documents.items()}
        for name, text in texts.items():
            self._require_kept(folder / name, json.loads(text))
        return [
            *write_folder(folder, {name: (text + "\n").encode() for name, text in texts.items()} | dict(files)),
            *draw(lambda: write(folder), folder / "report.html"),
        ]


def with_paths(text: str, paths: Mapping[str, Path]) -> str:
    """Return a next command with the paths of documents that it names in capitals, by their names in small letters."""

    def path(match: re.Match[str]) -> str:
        name = match[0].lower()
        return shlex.quote(str(paths[name])) if name in paths else match[0]

    return _PLACEHOLDER.sub(path, text)


def typed(group: LogOptions | GravityOptions | NoiseOptions) -> str:
    """Return the options of a group that were given, as one types them."""
    return "".join(
        f" --{option.name.replace('_', '-')} {shlex.quote(str(value))}"
        for option in fields(group)
        if option.repr and (value := getattr(group, option.name)) != option.default
    )


def draw(write: Callable[[], Path | Iterable[Path]], page: Path) -> list[Path]:
    """Draw a report and return the files; where that fails, `page` says so: results do not depend on it."""
    try:
        with progress("drawing the report"):
            files = write()
    except JaximuError:
        raise
    except Exception as error:
        files = later("report.html", "write_failure")(page, error)
    return [files] if isinstance(files, Path) else [*files]


def print_json(value: Any) -> None:
    """Print a document that is no file of its own."""
    print(json.dumps(value, indent=1, allow_nan=False))


def effects_of(stated: tuple[str, ...]) -> Json:
    """Return, as the library's arguments, the effects that options name and the deviations stated as NAME+-SIGMA."""
    names, sigmas = [], {}
    for text in stated:
        name, known, sigma = text.partition("+-")
        names.append(name.strip())
        if known:
            try:
                sigmas[name.strip()] = float(sigma)
            except ValueError:
                raise InputError(f"--effect {text}: {sigma!r} is not a number.") from None
    return {"effects": names, "effect_sigmas": sigmas}


READING, LOCAL, NOISE = LogOptions(), GravityOptions(), NoiseOptions()
POSES, TRACED, RESULTS = PoseOptions(), TraceOptions(), Results()


@dataclass(frozen=True, kw_only=True)
class Reads:
    """The options of every verb that reads logs: how, where on Earth they were recorded, and where results go."""

    log: LogOptions = READING
    local: GravityOptions = LOCAL
    results: Results = RESULTS


@dataclass(frozen=True, kw_only=True)
class Fits(Reads):
    """The options of every verb that fits a unit to logs."""

    noise: NoiseOptions = NOISE


def require_files(*paths: Path | None) -> None:
    """Refuse a file that is not there before anything that takes time is loaded."""
    for path in filter(None, paths):
        with readable(path):
            path.stat()


def require_apart(output: Path | None, *inputs: Path | None) -> None:
    """Refuse to write over what is read: it would be lost."""
    for path in filter(None, inputs):
        if output is not None and output.exists() and output.samefile(path):
            raise InputError(f"-o {output}: this is {path} itself, which would be lost. Name another file.")


def beginning(path: Path) -> bytes:
    """Return what a file begins with, as far as a text that a person wrote goes."""
    with readable(path), open(path, "rb") as file:
        return file.read(_LARGEST_TEXT)


def is_toml(path: Path) -> bool:
    """Tell a specification from a log, by content."""
    try:
        return bool(tomllib.loads(beginning(path).decode("utf-8")))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError):
        return False


def stated_noise(path: Path) -> SensorNoise:
    """Return the figures of noise that a file states, recognised by content. Raises `InputError` for any other file."""
    from jaximu.noise.stated import read_sensor_noise

    if not is_toml(path):
        return read_sensor_noise(path)
    from jaximu.simulation.specification import read_specification

    return {
        name: {process.letter: process.size for process in triad.processes if process.letter}
        for name, triad in read_specification(path).case(0).noise.items()
    }


def allowing_for(calibration: jaximu.Calibration, path: Path | None) -> tuple[jaximu.Calibration, tuple[str, ...]]:
    """Return a calibration that allows for what its recording cannot see by a diagnosis of it, and that in words.

    Raises `InputError` for the diagnosis of another recording.
    """
    if path is None:
        return calibration, ()
    from jaximu.ground.document import damage, read_document

    document = read_document(path, "jaximu.diagnosis/1", "a diagnosis.json of `jaximu diagnose LOG -o DIR`")
    with damage(path):
        recorded, causes = document["data"]["files"], document["hidden"]
        shifts = [cause["shift"] for cause in causes]
    if recorded != calibration.data.get("files"):
        others = listed([str(file["file"]) for file in recorded])
        raise InputError(f"{path} is the diagnosis of {others}, of which this calibration was not made.")
    words = (
        f"the uncertainties allow for what the recording cannot see: {counted(len(causes), 'cause')} of {path}, each "
        "as large as its detection limit."
    )
    return calibration.allowing_for(shifts), (words,)


def field_strength(text: str | None) -> FieldStrength | None:
    """Return the field as `--field` states it, µT; None where it does not. Raises `InputError` for what is no field."""
    if text is None:
        return None
    parts = re.split(r"\+/?-|±", text)
    try:
        value, sigma = map(float, parts if len(parts) > 1 else [*parts, "0"])
        return FieldStrength(value, sigma)
    except ValueError:
        raise InputError(f"--field {text!r} is not understood; write H or H+-S in µT, such as 48.9+-0.2.") from None
