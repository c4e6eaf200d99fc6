"""Errors as sentences a user can act on, each with the exit status that the command line returns for it.

A sentence is written once, with the options of the command line (`--static LOG`); a Python program shows it with the
arguments that stand for these options (`static=`).
"""

import difflib
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

FilePath = str | os.PathLike[str]
_READING = "columns gyro-columns rate axes accel-scale accel-offset gyro-scale gyro-offset topic instance stamp".split()
_ARGUMENTS = {
    "--gravity, or --latitude and --height": "gravity=, such as jaximu.wgs84_gravity(latitude, height)",
    "--gravity and --latitude": "gravity=jaximu.wgs84_gravity(latitude, height)",
    "--latitude": "jaximu.wgs84_gravity(latitude)",
    "--height": "jaximu.wgs84_gravity(latitude, height)",
    "--threshold": "segmentation=SegmentationOptions(threshold=…)",
    "--minimum-duration": "segmentation=SegmentationOptions(minimum_duration=…)",
    "--effect": "effects=",
    **{f"--{name}": f"ReadOptions({name.replace('-', '_')}=…)" for name in _READING},
}
"""What stands for an option in Python, where it is not the argument of the same name."""
_PASTED = r"`[^`]*`|'--[^']*'|^  .*$|\S+\.\w+ --gyro-log \S+\.\w+|jaximu [a-z]+ .*"
_OPTION = "|".join([*(rf"{option}(?![\w-])" for option in _ARGUMENTS), r"(?<![\w-])--[a-z][a-z-]+"])
_VALUE = r"(?: (?P<value>\"[^\"]*\"|\d[\d./]*\d)| (?:LOG|HZ|REF|FILE|NAME|DIR)\b)?"
_TEXT = re.compile(rf"(?P<pasted>{_PASTED})|(?P<option>{_OPTION}){_VALUE}", re.MULTILINE)
_command_line = False


def worded(text: str) -> str:
    """Return a sentence for its reader: options become Python's arguments, unless the command line is running.

    Lines to paste into a shell stay as they are.
    """
    return text if _command_line else _TEXT.sub(_argument, text)


def _argument(match: re.Match[str]) -> str:
    option, value = match["option"], match["value"]
    if option is None:
        return match[0]
    argument = _ARGUMENTS.get(option, option[2:].replace("-", "_") + "=")
    if value is None:
        return argument
    value = value if re.fullmatch(r'"[^"]*"|[\d.]+', value) else f'"{value}"'
    return argument.replace("…", value) if "…" in argument else f"{argument}{value}"


@contextmanager
def command_line() -> Iterator[None]:
    """Word sentences for the command line while this lasts."""
    global _command_line
    before, _command_line = _command_line, True
    try:
        yield
    finally:
        _command_line = before


class JaximuError(Exception):
    """Base of the errors that jaximu raises on purpose; the message is one plain sentence (or a few)."""

    exit_status = 2

    def __str__(self) -> str:
        return worded(super().__str__())


class InputError(JaximuError):
    """Bad input or usage: the message names the file, row or column and what to change. Exit status 2."""

    exit_status = 2


class NotPossibleError(JaximuError):
    """The input was understood but does not allow the task; the message says what to record. Exit status 1."""

    exit_status = 1


def one_of(argument: str, value: object, choices: Sequence[str]) -> None:
    """Raise `InputError` for a value that is none of an argument's choices."""
    if value not in choices:
        raise InputError(f"{argument}: {value!r} is none of {', '.join(map(repr, choices))}.")


def nearest(name: object, known: Iterable[str]) -> str:
    """Return what to say to a name that is not known: which known ones are like it, else which there are."""
    known = list(known)
    near = difflib.get_close_matches(str(name), known, n=3, cutoff=0.5)
    return f"did you mean {' or '.join(map(repr, near))}?" if near else f"known are {', '.join(known)}."


def only(table: Any, known: Iterable[str], file: str, inside: str = "") -> dict[str, Any]:
    """Return a table all of whose keys are known. Raises `InputError` where it is none, or has another key."""
    if not isinstance(table, dict):
        raise InputError(f"{file}: {inside.strip('[]')} must be a table of keys, found {table!r}.")
    known = list(known)
    for key in table:
        if key not in known:
            raise InputError(f"{file}: unknown key {key!r}{inside and f' in {inside}'}; {nearest(key, known)}")
    return table


def name_of(path: object) -> str:
    """Return a path as text. Raises `InputError` for what is no path."""
    if not isinstance(path, (str, os.PathLike)):
        raise InputError(f"expected the path of a file, found a value of type {type(path).__name__}.")
    return os.fspath(path)


@contextmanager
def readable(path: FilePath) -> Iterator[None]:
    """Turn the system's refusal of a file into an `InputError` that names the file."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{os.fspath(path)} cannot be read: {error.strerror or error}.") from error
