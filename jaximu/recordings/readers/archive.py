"""Recordings of several files: the folder or ZIP archive in which a phone's app writes one file a sensor."""

from __future__ import annotations

import os
import re
import shlex
import tempfile
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import IO

from jaximu.ground.errors import InputError, readable
from jaximu.ground.units import SENSORS
from jaximu.recordings.columns.habits import sensor_of, words_of
from jaximu.recordings.columns.table import HEAD, Unpacking
from jaximu.recordings.recording import Source

_MOST = 1000  # files of a recording
_LETTERS = 3  # of a word that names a file's sensor
_PART = "part of a measurement"
"""In place of a sensor: gravity alone, or what is left without it."""
_WITH_GRAVITY = ("total", "acceleration")
"""The words with which Sensor Logger names its accelerometer; what it calls that has gravity taken out."""
_ABOUT = ("meta", "__macosx")
"""Folders of what is about a recording."""
_NO_LOG = set(".json .jsonc .xml .plist .yaml .yml .toml .html .md .pdf .png .jpg .svg .py .ipynb".split())
"""Suffixes of files that are logs only where there is no other."""
SUFFIXES = tuple(".csv .tsv .txt .dat .log .parquet .npz .mat .h5 .hdf5 .bag .mcap .db3 .ulg .bin .gz".split())
"""What a folder is searched for; a file that is named on its own may have any."""
_BESIDE = (".truth.json", ".schedule.csv")
_DIGITS = re.compile(rb"\d+")
_GZIP = b"\x1f\x8b"
_PACKED = set(".zip .gz .bz2 .xz .7z .rar .tar .tgz".split())


def is_log(path: Path) -> bool:
    """Whether a file may be a log, which what commands write beside one is not, nor a page of text."""
    if not path.is_file() or path.name.endswith(_BESIDE):
        return False
    text = path.suffix.lower() == ".txt" and os.access(path, os.R_OK)
    return not (text and _prose(path.name, lambda _: path.open("rb")))


def logs_below(folder: Path) -> list[Path]:
    """The logs in a folder and those below it, by their names."""
    with readable(folder):
        below = list(folder.rglob("*"))
    return sorted(
        inner
        for inner in below
        if inner.suffix.lower() in SUFFIXES
        and not any(part.startswith(".") for part in inner.relative_to(folder).parts)
        and is_log(inner)
    )


def is_archive(path: Path) -> bool:
    """Whether a path is a folder that is no ROS 2 bag, a ZIP archive that is no NPZ file, or a file packed by gzip."""
    if path.is_dir():
        return not (path / "metadata.yaml").is_file()
    with path.open("rb") as file:
        start = file.read(2)
    if start != b"PK":
        return start == _GZIP
    try:
        with zipfile.ZipFile(path) as archive:
            return not any(name.endswith(".npy") for name in archive.namelist())
    except zipfile.BadZipFile:
        return True  # a damaged one


@contextmanager
def opened(path: Path, name: str) -> Iterator[dict[str, tuple[str, Path]]]:
    """Gives the files of the one recording in a folder or archive, by sensor: how each is called, and where it lies.

    A single file stands under "". What an archive holds is unpacked into a folder that goes away afterwards.

    Raises InputError where there is no recording, or more than one, and for an archive that is too large.
    """
    if path.is_dir():
        files = {file.name: file for file in sorted(path.iterdir()) if file.is_file()}
        chosen = _chosen(files, path, name, lambda inside: files[inside].open("rb"))
        yield {sensor: (f"{name}/{inside}", files[inside]) for sensor, inside in chosen.items()}
        return
    data = path.read_bytes()
    if data.startswith(_GZIP):
        unpacked = Unpacking(Source(name, "", 0), len(data)).unpack(zlib.decompressobj(31), data)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / path.stem
            file.write_bytes(unpacked)
            yield {"": (name, file)}
        return
    with zipfile.ZipFile(path) as archive, tempfile.TemporaryDirectory() as folder:
        members = _members(archive, name)
        files = {}
        unpacking = Unpacking(Source(name, "", 0), path.stat().st_size)
        for number, (sensor, inside) in enumerate(_chosen(members, path, name, archive.open).items()):
            unpacking.take(members[inside].file_size)
            file = Path(folder) / f"{number}{PurePosixPath(inside).suffix}"  # never a path that the archive states
            file.write_bytes(archive.read(members[inside]))
            files[sensor] = f"{name}/{inside}", file
        yield files


def _members(archive: zipfile.ZipFile, name: str) -> dict[str, zipfile.ZipInfo]:
    """Return the files in an archive. Raises InputError for too many, or one that cannot be read."""
    inside = archive.infolist()
    if len(inside) > _MOST:
        raise InputError(f"{name}: is an archive of {len(inside)} files, as no recording is.")
    members = {member.filename: member for member in inside if not member.is_dir()}
    if not members:
        raise InputError(f"{name}: is an archive with nothing in it.")
    if "xl/workbook.xml" in members:
        raise InputError(f"{name}: is an Excel workbook; save its sheet as CSV.")
    if any(member.flag_bits & 1 for member in members.values()):
        raise InputError(f"{name}: is an archive with a password; unpack it and read the files in it.")
    return members


def _chosen(files: Collection[str], path: Path, name: str, open_file: Callable[[str], IO[bytes]]) -> dict[str, str]:
    """Return by sensor which of the files are the one recording. Raises InputError where there is none, or several."""
    paths = [PurePosixPath(file) for file in files]
    paths = [file for file in paths if not any(part.startswith(".") or part.lower() in _ABOUT for part in file.parts)]
    logs = [file for file in paths if file.suffix.lower() not in _NO_LOG] or paths
    logs = [file for file in logs if _rank(file)[0] != _PART]
    if sensors := by_sensor(map(str, logs)):
        return sensors
    if len(logs) > 1:
        logs = [*islice((file for file in logs if not _prose(str(file), open_file)), 2)]  # of two, none is read
    if len(logs) == 1 and logs[0].suffix.lower() not in _PACKED:
        return {"": str(logs[0])}
    raise InputError(_refusal([*files], path, name))


def _prose(name: str, open_file: Callable[[str], IO[bytes]]) -> bool:
    """Whether a file is text most of whose lines are unlike each other, whatever their numbers, such as a README."""
    with open_file(name) as file:
        head = file.read(HEAD)
    shapes = Counter(_DIGITS.sub(b"#", line.translate(None, b"-+.")) for line in head.splitlines() if line.strip())
    rows = sum(count for shape, count in shapes.items() if count > 1 and b"#" in shape)
    return b"\0" not in head and rows < shapes.total() / 2


def by_sensor(files: Iterable[str]) -> dict[str, str]:
    """Return by sensor the files of one folder that are called after an accelerometer and others; else nothing.

    A name, a time, an address that all of them have alike, and their rates, say nothing.
    """
    paths = [PurePosixPath(file) for file in files]
    words = {word for file in paths for word in _words(file)}
    of_sensors = {word for word in words if len(word) >= _LETTERS and sensor_of((word,))[0] in SENSORS}
    named = [set(_words(file)) for file in paths if of_sensors.intersection(_words(file))]
    alike = set.intersection(*named) - of_sensors if len(named) > 1 else set()
    ranks = {file: _rank(file, alike) for file in paths}
    best = {
        sensor: _best({file: words for file, (name, words) in ranks.items() if name == sensor}) for sensor in SENSORS
    }
    sensors = {sensor: file for sensor, file in best.items() if file is not None}
    if "accel" not in sensors or len(sensors) < 2 or len({file.parent for file in sensors.values()}) > 1:
        return {}
    return {sensor: str(file) for sensor, file in sensors.items()}


def _words(file: PurePosixPath) -> list[str]:
    return words_of(re.sub(r"[\d.]+ ?Hz", "", file.stem))


def _rank(file: PurePosixPath, alike: Collection[str] = ()) -> tuple[str, int]:
    """Return the sensor that a file is named after, "" for none, and how far the name is from plain.

    `alike`: words that its neighbours have, too; what is left of such a name must hold no number.
    """
    words = tuple(words_of(file.stem))
    if rest := tuple(word for word in _words(file) if word not in alike):
        words = words if len(rest) == len(words) or any(map(str.isdigit, rest)) else rest
    if words == _WITH_GRAVITY:
        return "accel", 0
    sensor, refusal = sensor_of(words)
    named = sensor if max(map(len, words), default=0) >= _LETTERS else None  # a.csv and b.csv are two logs
    return _PART if refusal else named or "", len(words)


def _best(ranks: Mapping[PurePosixPath, int]) -> PurePosixPath | None:
    """Return the file with the plainest name; None where several are as plain: they are of several recordings."""
    plainest = [file for file, rank in ranks.items() if rank == min(ranks.values())]
    return plainest[0] if len(plainest) == 1 else None


def _refusal(files: Sequence[str], path: Path, name: str) -> str:
    """Say what is there in place of one recording, and what to do."""
    held = f"it holds {', '.join(files[:3])}{f' and {len(files) - 3} more' if len(files) > 3 else ''}"
    if path.is_dir():
        folder = f"{name}: is a folder, not a file, and no ROS 2 bag (it has no metadata.yaml); "
        if not logs_below(path):
            return f"{folder}{held if files else 'no file lies in it'}, and no log. Name a log, or a folder of logs."
        return (
            f"{folder}{held if files else 'its logs lie in folders below'}. Name one log, or calibrate all: jaximu "
            f"fleet {shlex.quote(name)} -o fleet.parquet."
        )
    return (
        f"{name}: is an archive, and not of one recording: {held}. Unpack it, and name one log, or calibrate all: "
        "jaximu fleet FOLDER -o fleet.parquet."
    )
