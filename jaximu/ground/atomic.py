"""Output that is either whole or not there."""

import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from jaximu.ground.errors import FilePath, InputError


@contextmanager
def atomic_write(path: FilePath) -> Iterator[Path]:
    """Gives a temporary path beside `path`, with the same suffix, to write to; renames it to `path` at the end.

    If the body raises, `path` is left as it was and the temporary file is removed. A link is followed.
    Raises InputError where the folder is missing or cannot be written to.
    """
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
    try:
        if target.is_dir():
            raise IsADirectoryError(21, "it is a folder")
        temporary.touch(exist_ok=False)  # found out before anything is computed
        yield temporary
        temporary.replace(target)
    except OSError as error:
        raise InputError(f"{os.fspath(path)}: cannot be written: {error.strerror or error}.") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_folder(folder: FilePath, contents: Mapping[str, bytes]) -> tuple[Path, ...]:
    """Write files by name into a folder, which is made if it is missing: all of them or none.

    **Returns:** their paths. Raises InputError where the folder cannot be made or written to.
    """
    target = Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{target} cannot be made a folder for results: {error.strerror}.") from error
    return write_files({target / name: content for name, content in contents.items()})


def write_files(contents: Mapping[Path, bytes]) -> tuple[Path, ...]:
    """Write files, all of them or none, and return their paths. Raises InputError where one cannot be written."""
    with ExitStack() as stack:
        for path, content in contents.items():
            stack.enter_context(atomic_write(path)).write_bytes(content)
    return tuple(contents)
