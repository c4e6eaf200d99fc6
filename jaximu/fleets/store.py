"""Finished rows, kept in part files beside the table until it is whole: a killed run goes on where it stopped."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from jaximu.fleets.rows import SCHEMA
from jaximu.ground.atomic import atomic_write
from jaximu.ground.document import Json
from jaximu.ground.errors import InputError

_PART = SCHEMA.insert(0, pa.field("key", pa.string()))
_GROUP = 1024
"""Rows of the table written at once."""


def kept_rows(output: Path) -> int:
    """Return how many rows of a run that was stopped are on the disk beside its output."""
    parts = output.with_name(f"{output.name}.parts").glob("[0-9]*.parquet")
    return sum(pq.read_metadata(path).num_rows for path in parts)


class Store:
    """The rows of a run, by key; each part file is written whole or not at all, and holds the rows of one batch."""

    def __init__(self, output: Path, keys: Sequence[str]):
        self.output, self.keys = Path(output), list(keys)
        self.folder = self.output.with_name(f"{self.output.name}.parts")
        self._place = {key: index for index, key in enumerate(self.keys)}
        self._owner = np.full(len(self.keys), -1)  # which part holds a row
        self._parts: list[Path] = []
        self._lock: BinaryIO | None = None

    def __enter__(self) -> Store:
        if self.output.is_dir():
            raise InputError(f"{self.output}: cannot be written: it is a folder.")
        try:
            self.folder.mkdir(exist_ok=True)
            lock = (self.folder / "in_use").open("ab")
        except OSError as error:
            raise InputError(f"{self.output}: cannot be written: {error.strerror or error}.") from error
        if not _locked(lock):
            lock.close()
            raise InputError(
                f"{self.output} is in use: another run is writing it. Wait for it, stop it, or choose another output."
            )
        self._lock = lock
        target = Path(os.path.realpath(self.output))
        for torn in target.parent.glob(f".{target.stem}.{8 * '[0-9a-f]'}{target.suffix}"):  # of a run that was killed
            torn.unlink(missing_ok=True)
        for path in sorted(self.folder.glob("*.parquet")):
            self._take(path)
        return self

    def __exit__(self, *_: object) -> None:
        assert self._lock is not None
        self._lock.close()

    def pending(self) -> list[int]:
        """Return the places whose rows are not there yet."""
        return np.flatnonzero(self._owner < 0).tolist()

    def _take(self, path: Path) -> None:
        try:
            keys = pq.read_table(path, columns=["key"]).column("key").to_pylist()
        except (OSError, pa.ArrowException):
            keys = []  # a disk that filled up, or another program's file: these rows are computed again
        indices = [index for index in map(self._place.get, keys) if index is not None and self._owner[index] < 0]
        if indices:
            self._owner[indices] = len(self._parts)
            self._parts.append(path)

    def add(self, places: Sequence[int], rows: Sequence[Json]) -> None:
        """Keep the rows of some places. Raises `InputError` where they cannot be written."""
        fresh = [(index, row) for index, row in zip(places, rows, strict=True) if self._owner[index] < 0]
        if not fresh:
            return
        table = _table([{"key": self.keys[index]} | row for index, row in fresh], _PART)
        digest = hashlib.sha256("".join(self.keys[index] for index, _ in fresh).encode()).hexdigest()[:16]
        path = self.folder / f"{fresh[0][0]:09d}-{digest}.parquet"
        with self._told(), atomic_write(path) as temporary:
            pq.write_table(table, temporary)
        self._owner[[index for index, _ in fresh]] = len(self._parts)
        self._parts.append(path)

    @contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
        except InputError as error:
            raise InputError(
                f"{error} {int(np.sum(self._owner >= 0))} finished rows are kept in {self.folder}: free space or "
                "repair it, and give the same command again."
            ) from error

    def rows(self) -> Iterator[list[Json]]:
        """Give all rows in the order of the jobs, some at a time; parts are opened when they are needed."""
        left = np.bincount(self._owner, minlength=len(self._parts))
        opened = {}
        group = []
        for index, part in enumerate(self._owner.tolist()):
            if part not in opened:
                opened[part] = {row.pop("key"): row for row in pq.read_table(self._parts[part]).to_pylist()}
            group.append(opened[part][self.keys[index]])
            left[part] -= 1
            if not left[part]:
                del opened[part]
            if len(group) == _GROUP:
                yield group
                group = []
        if group:
            yield group

    def close(self) -> None:
        """Write the table, whole, and remove the parts."""
        with self._told(), atomic_write(self.output) as temporary, pq.ParquetWriter(temporary, SCHEMA) as writer:
            for group in self.rows():
                writer.write_table(_table(group, SCHEMA))
        assert self._lock is not None
        self._lock.close()
        shutil.rmtree(self.folder, ignore_errors=True)


def _table(rows: Sequence[Json], schema: pa.Schema) -> pa.Table:
    return pa.table([pa.array([row[field.name] for row in rows], field.type) for field in schema], schema=schema)


def _locked(file: BinaryIO) -> bool:
    """Lock a file for this process, until it is closed or the process ends; False where another holds it."""
    try:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
