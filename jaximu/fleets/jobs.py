"""What a fleet's run consists of: one `Job` a recording, and the `Settings` that all share."""

from __future__ import annotations

import csv
import dataclasses
import glob
import hashlib
import os
import shlex
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from importlib import import_module
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from jaximu._version import __version__
from jaximu.ground.document import Json, file_digest
from jaximu.ground.errors import FilePath, InputError, only, readable
from jaximu.ground.gravity import STANDARD, LocalGravity
from jaximu.ground.magnetic_field import FieldStrength
from jaximu.recordings.readers import ReadOptions
from jaximu.recordings.readers.archive import SUFFIXES, is_log, logs_below
from jaximu.recordings.segmentation import SegmentationOptions

Rows = tuple[Sequence[int], list[Json]]
# XLA's pool reads NPROC; a flag of XLA's would make it compile everything anew
ONE_THREAD: dict[str, str] = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC", "PJRT_NPROC"), "1"
)
PATIENCE = 1.0
"""Seconds without a row after which an engine gives an empty batch, so that its caller can say what it waits for."""

_COLUMNS = ("device", "file", "date", "lot", "unit", "session", "station", "static", "options")
_ALL = ""  # no device is called so
_NUMBERS = {"rate": float, "instance": int}
_OPTIONS = tuple(option.name for option in fields(ReadOptions) if option.name not in ("gravity", "check"))


@dataclass(frozen=True)
class Job:
    """One recording of one device. date, lot, station: for the fleet's statistics. unit, session: of a board's.

    options: how to read it, as (name, value). static: a recording at rest, which tells the noise; ""
    where there is none. copy_of: the file, of another job, that has the same bytes; "" where there is none.
    """

    device: str
    file: str
    date: str = ""
    lot: str = ""
    options: tuple[tuple[str, str], ...] = ()
    static: str = ""
    station: str = ""
    copy_of: str = ""
    unit: str = ""
    session: str = ""


@dataclass(frozen=True)
class Settings:
    """What is asked of every recording: how to read it, local gravity, whether to diagnose, how to seek poses.

    field: the magnetic field's strength, None where it is what a magnetometer's data sheet says.
    """

    options: tuple[tuple[str, str], ...] = ()
    gravity: LocalGravity = STANDARD
    diagnose: bool = False
    segmentation: SegmentationOptions = dataclasses.field(default_factory=SegmentationOptions)
    field: FieldStrength | None = None

    def key(self, job: Job) -> str:
        """Return what tells the row of a job apart from any other: job, settings, version, and the files' states."""
        stated = dict(self.options) | dict(job.options)
        stamps = [_stamp(path) for path in (job.file, stated.get("gyro_log"), job.static) if path]
        text = repr((asdict(job), asdict(self), stamps, __version__, *_added_effects()))
        return hashlib.sha256(text.encode("utf-8", "backslashreplace")).hexdigest()[:32]

    def reading(self, job: Job) -> tuple[ReadOptions, str | None]:
        """Return how a job's file is read, and its gyroscope's file where that is another."""
        stated: dict[str, str] = dict(self.options) | dict(job.options)
        gyro_log = stated.pop("gyro_log", None)
        numbers = {name: kind(stated.pop(name)) for name, kind in _NUMBERS.items() if name in stated}
        return ReadOptions(**stated, **numbers, gravity=self.gravity), gyro_log


def own_effects() -> tuple[str, ...]:
    """Return the import paths of the effects that were added to the catalogue, for the processes that do the work.

    Raises `InputError` for one that another process cannot import.
    """
    paths = _added_effects()
    for path in paths:
        if path.startswith("__main__:") or "<" in path:
            raise InputError(
                f"the effect {path} is defined where other processes cannot find it: move its class to another "
                "module, or use one worker."
            )
    return paths


def _added_effects() -> tuple[str, ...]:
    """Return the import paths of the effects that were added to this process's catalogue."""
    catalogue = sys.modules.get("jaximu.model.effects.catalogue")  # not loaded: nothing was added
    return () if catalogue is None else tuple(effect.import_path() for effect in catalogue.registered())


def register_all(paths: Sequence[str]) -> None:
    """Add the effects of these import paths to this process's catalogue."""
    if paths:
        from jaximu.model.effects import register

        for module, name in (path.split(":") for path in paths):
            register(getattr(import_module(module), name))


def _stamp(path: str) -> tuple[int, int]:
    try:
        state = os.stat(path)
    except OSError:
        return -1, -1
    return state.st_size, state.st_mtime_ns


def find_jobs(
    logs: Iterable[FilePath],
    output: FilePath | None = None,
    static: FilePath | None = None,
) -> list[Job]:
    """Return the jobs that logs, folders, patterns and manifests name, in a fixed order.

    A folder gives all logs below it, and a device is called after its file: the name without its suffix, or as much of
    the path as tells it from the others. A manifest is a CSV file with the columns `device` (or `unit`) and `file` (as
    from the manifest's folder), and if wanted `session`, `date`, `lot`, `station`, `static` and `options` (such as
    `--rate 100 --axes FRD`). `output` is never taken for a log, nor is a recording at rest. `static`: one for all whose
    manifest names none, or a folder of them, each called after its device. Raises `InputError` where nothing is found
    or a recording is named twice.
    """
    named = []
    loose = []
    arguments = [os.fspath(argument) for argument in logs]
    if not arguments:
        raise InputError("no log was given: name logs, folders of logs, patterns in quotes, or a manifest.")
    table = None if output is None else Path(output).resolve()
    at_rest = _recordings_at_rest(static)
    others = {path.resolve() for path in at_rest.values()}

    def wanted(paths: Iterable[Path]) -> list[Path]:
        return [path for path in paths if not _is_own(path, table) and path.resolve() not in others]

    for argument in arguments:
        path = Path(argument)
        if path.is_dir():
            inside = wanted(logs_below(path))
            if not inside:
                raise InputError(f"{argument}: the folder holds no logs (files ending in {', '.join(SUFFIXES)}).")
            loose += inside
        elif path.exists():
            manifest = read_manifest(path)
            if manifest is None:
                loose.append(path)
            else:
                named += manifest
        elif any(sign in argument for sign in "*?["):
            matches = wanted(filter(is_log, map(Path, sorted(glob.glob(argument, recursive=True)))))
            if not matches:
                raise InputError(f"{argument}: no file fits this pattern.")
            loose += matches
        else:
            raise InputError(f"{argument}: no such file or folder.")
    jobs = named + [Job(device, str(path)) for device, path in zip(_devices(loose), loose, strict=True)]
    _refuse_repeated(jobs)
    jobs = _with_copies(jobs)
    if at_rest:
        jobs = [
            replace(job, static=job.static or os.fspath(at_rest.get(job.device, at_rest.get(_ALL, "")))) for job in jobs
        ]
    return jobs


def _recordings_at_rest(static: FilePath | None) -> dict[str, Path]:
    """Return recordings at rest by device; one for all under the name `_ALL`."""
    if static is None:
        return {}
    path = Path(static)
    if path.is_file():
        return {_ALL: path}
    if not path.is_dir():
        raise InputError(f"--static {path}: no such file or folder.")
    recordings = {}
    for log in logs_below(path):
        device = log.relative_to(path).with_suffix("").as_posix()
        if device in recordings:
            raise InputError(
                f"--static {path}: {recordings[device].name} and {log.name} are both called after {device}."
            )
        recordings[device] = log
    if not recordings:
        raise InputError(f"--static {path}: the folder holds no logs (files ending in {', '.join(SUFFIXES)}).")
    return recordings


def _is_own(path: Path, output: Path | None) -> bool:
    """Whether it is the table that is to be written, or one of its parts."""
    if output is None:
        return False
    path = path.resolve()
    return path == output or path.parent == output.with_name(f"{output.name}.parts")


def _devices(paths: Sequence[Path]) -> list[str]:
    """Name each path by its stem, or by as many folders before it as it takes to tell all apart."""
    names = [path.stem for path in paths]
    depth = 1
    while len(set(names)) < len(set(paths)):
        depth += 1
        longer = ["/".join([*path.parts[-depth:-1], path.stem]) for path in paths]
        if longer == names:  # same names but for the suffix
            return [str(path) for path in paths]
        names = longer
    return names


def _refuse_repeated(jobs: Sequence[Job]) -> None:
    by_path = {}
    for job in jobs:
        real = os.path.realpath(job.file)
        if real in by_path:
            other = by_path[real]
            owners = job.device if job.device == other.device else f"{other.device} and {job.device}"
            raise InputError(f"{job.file} is named twice ({owners}): every recording must be named once.")
        by_path[real] = job


def _with_copies(jobs: Sequence[Job]) -> list[Job]:
    """Return the jobs, those whose file has the bytes of an earlier one's marked; only files of one size are read."""
    sizes = Counter(_stamp(job.file)[0] for job in jobs)
    first = {}
    marked = []
    for job in jobs:
        size = _stamp(job.file)[0]
        other = first.setdefault(file_digest(job.file), job.file) if size > 0 and sizes[size] > 1 else job.file
        marked.append(job if other == job.file else replace(job, copy_of=other))
    return marked


def listed_jobs(path: Path) -> list[Job] | None:
    """Return the jobs of a manifest or of a fleet's table; None for a log. Raises `InputError` naming the row."""
    if path.suffix.lower() != ".parquet":
        return read_manifest(path)
    try:
        if not {"device", "file", "static"} <= set(names := pq.read_schema(path).names):
            return None
        rows = pq.read_table(path, columns=[name for name in _COLUMNS if name in names]).to_pylist()
    except (OSError, pa.ArrowException):  # which reading it as a log explains
        return None
    jobs = []
    for row in rows:
        cells: Json = {name: text or "" for name, text in row.items()}
        cells["options"] = _parse_options(cells.get("options", ""), str(path), Path())
        jobs.append(Job(**cells))
    return jobs


def options_text(options: Iterable[tuple[str, str]]) -> str:
    """Return options as a manifest has them."""
    return shlex.join(f"--{name.replace('_', '-')}={value}" for name, value in options)


def read_manifest(path: Path) -> list[Job] | None:
    """Return the jobs of a manifest; None for what is no manifest but a log. Raises `InputError` naming the row."""
    if path.suffix.lower() != ".csv":
        return None
    try:
        with readable(path), path.open(encoding="utf-8-sig", newline="") as file:
            header = [cell.strip().lower() for cell in next(csv.reader([file.readline(65536)]), [])]
            owner = "device" if "device" in header else "unit"
            if not {owner, "file"} <= set(header):
                return None
            only(dict.fromkeys(header), _COLUMNS, str(path), "the header")
            rows = [
                (number, row) for number, row in enumerate(csv.reader(file), 2) if any(cell.strip() for cell in row)
            ]
    except (UnicodeDecodeError, csv.Error):
        return None
    if not rows:
        raise InputError(f"{path}: the manifest is empty: it needs one row a recording below its header.")
    jobs = []
    files = {}
    for number, row in rows:
        where = f"{path}, row {number}"
        if len(row) != len(header):
            raise InputError(f"{where}: {len(row)} cells under {len(header)} column names.")
        cells: Json = {name: cell.strip() for name, cell in zip(header, row, strict=True)}
        for name in (owner, "file"):
            if not cells[name]:
                raise InputError(f"{where}: the {name} is missing.")
        file = str(path.parent / cells["file"])
        if file in files:
            raise InputError(f"{where}: {cells['file']} stands in row {files[file]} already.")
        files[file] = number
        understood: Json = {
            "device": cells[owner],
            "file": file,
            "options": _parse_options(cells.get("options", ""), where, path.parent),
        }
        if cells.get("static"):
            understood["static"] = str(path.parent / cells["static"])
        jobs.append(Job(**cells | understood))
    return jobs


def _parse_options(text: str, where: str, folder: Path) -> tuple[tuple[str, str], ...]:
    known = ", ".join(f"--{name.replace('_', '-')}" for name in ("gyro_log", *_OPTIONS))
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise InputError(f"{where}: the options {text!r} have a quote that is not closed.") from error
    options = {}
    while words:
        name, _, value = words.pop(0).partition("=")
        key = name.removeprefix("--").replace("-", "_")
        if not name.startswith("--") or key not in ("gyro_log", *_OPTIONS):
            raise InputError(f"{where}: the option {name!r} is not known in a manifest; there are {known}.")
        if not value:
            if not words:
                raise InputError(f"{where}: the option {name} needs a value.")
            value = words.pop(0)
        if key == "gyro_log":
            value = str(folder / value)
        if key in _NUMBERS:
            try:
                _NUMBERS[key](value)
            except ValueError:
                raise InputError(f"{where}: {name} needs a number, found {value!r}.") from None
        options[key] = value
    return tuple(sorted(options.items()))


def batches(places: Sequence[int], settings: Settings, workers: int) -> list[list[int]]:
    """Cut places into batches: large enough for a compiled program, small enough to share and to lose."""
    size = max(1, min(8 if settings.diagnose else 64, -(-len(places) // (2 * workers))))
    return [list(places[first : first + size]) for first in range(0, len(places), size)]
