"""What is kept as a JSON document, sealed by its own hash so that a change can be seen, and documents read back."""

import hashlib
import json
import os
import tomllib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jaximu._version import __version__
from jaximu.ground.atomic import atomic_write
from jaximu.ground.errors import FilePath, InputError, NotPossibleError, name_of, readable

Json = dict[str, Any]
"""A JSON document, or a part of one, by its keys."""
SOFTWARE = {"name": "jaximu", "version": __version__}
"""What a document says that it was written by."""


def digest(document: Json) -> str:
    """Return the SHA-256 of a document without its key `digest`, however its JSON is laid out."""
    content = {key: value for key, value in document.items() if key != "digest"}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def entries(thing: object, *names: str) -> Json:
    """Return attributes of a thing by their names, as a document has them: arrays and tuples as lists."""

    def plain(value: Any) -> Any:
        return list(value) if isinstance(value, tuple) else getattr(value, "tolist", lambda: value)()

    return {name: plain(getattr(thing, name)) for name in names}


def file_digest(path: FilePath) -> str:
    """Return the SHA-256 of a file. Raises `InputError` where it cannot be read."""
    with readable(path), open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_document(path: FilePath, schema: str | None, what: str) -> Json:
    """Read a JSON document of a schema, or of any schema of jaximu's.

    Raises `InputError` for a file that is none; `what` says what is expected, such as "a calibration.json".
    """
    name = name_of(path)
    try:
        with readable(path):
            document = json.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{name} is not {what}: it is not JSON ({error}).") from error
    stated = document.get("schema") if isinstance(document, dict) else None
    if stated != schema if schema else not str(stated).startswith("jaximu."):
        raise InputError(f"{name} is not {what}: its schema is {stated!r}, expected {schema or 'jaximu.…'!r}.")
    return document


def read_toml(path: FilePath, what: str = "a TOML file") -> Json:
    """Read a TOML file. Raises `InputError` for a file that is none; `what` says what is expected."""
    try:
        with readable(path):
            return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:  # of TOML and of its letters
        raise InputError(f"{os.fspath(path)} is not {what}: {error}.") from error


@contextmanager
def damage(path: FilePath) -> Iterator[None]:
    """Turn what goes wrong while a document is taken apart into an `InputError` that names the file and the reason."""
    try:
        yield
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        reason = f"key {error} is missing" if isinstance(error, KeyError) else str(error)
        raise InputError(f"{os.fspath(path)} is damaged: {reason}.") from error


class Document(ABC):
    """Something that is kept as one versioned JSON document."""

    @abstractmethod
    def document(self) -> Json:
        """Return what is kept, as JSON has it."""

    def __eq__(self, other: object) -> bool:
        """Return whether another result of this kind is kept as the same document."""
        return type(other) is type(self) and self._sorted() == other._sorted()

    def __hash__(self) -> int:
        return hash(self._sorted())

    def _sorted(self) -> str:
        return json.dumps(self.document(), sort_keys=True)

    def text(self) -> str:
        """Return the document as text, with its hash as `digest`.

        Raises `NotPossibleError` instead of writing a number that is none.
        """
        document = self.document()
        try:
            return json.dumps(document | {"digest": digest(document)}, indent=1, allow_nan=False)
        except ValueError as error:
            kind = document["schema"].partition(".")[2].partition("/")[0]
            raise NotPossibleError(
                f"the {kind} holds numbers that are not finite and is not kept ({error})."
            ) from error

    def save(self, path: FilePath) -> None:
        """Write the document, whole or not at all."""
        content = self.text()
        with atomic_write(path) as temporary:
            temporary.write_text(content + "\n", encoding="utf-8")
