"""An autopilot's parameters by name: of a PX4 ULog, an ArduPilot DataFlash log, or a list of them as text.

Lists are QGroundControl's (`Vehicle-Id Component-Id Name Value Type`, its guide, "Parameters") and those of Mission
Planner and MAVProxy (`NAME,VALUE`, `NAME VALUE`).
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import FilePath, InputError, name_of, readable
from jaximu.recordings.readers import dataflash, ulog

_ROW = re.compile(r"^(?:\d+\s+\d+\s+)?([A-Z]\w*)[\s,=]+(\S+?)(?:[\s,@#].*)?$")


@dataclass(frozen=True)
class ParameterFile:
    """The parameters in a file. values: by name, all different values in the order in which they came."""

    path: str
    values: Mapping[str, tuple[float, ...]]

    def value(self, name: str, default: float | None = None) -> float:
        """The one value of a parameter.

        Raises `InputError` where it is not there and there is no `default`, it changes in the file, or is not finite.
        """
        values = list(self.values.get(name, ())) or ([] if default is None else [default])
        if not values:
            near = difflib.get_close_matches(name, self.values, 1)
            raise InputError(f"{self.path}: has no parameter {name}{f'; the nearest is {near[0]}' if near else ''}.")
        if len(values) > 1:
            listed = ", then ".join(f"{value:.7g}" for value in values)
            raise InputError(
                f"{self.path}: {name} is {listed}: which was in force is not known; give a parameter file of that time."
            )
        if not math.isfinite(values[0]):
            raise InputError(f"{self.path}: {name} is {values[0]}, not a finite number.")
        return values[0]

    def vector(self, names: Iterable[str]) -> FloatArray:
        """Their values in order. Raises as `value` does."""
        return np.array([self.value(name) for name in names])


def read_parameters(path: FilePath) -> ParameterFile:
    """Return the parameters in a log or a list. Raises `InputError` for a file that holds none, naming the row."""
    name, file = name_of(path), Path(path)
    with readable(name):
        with file.open("rb") as opened:
            head = opened.read(4)
        rows = None if head.startswith((b"ULog", b"\xa3\x95", b"FMT,")) else file.read_bytes()
    try:
        if rows is None:
            pairs = list((ulog if head.startswith(b"ULog") else dataflash).parameters(file))
        else:
            pairs = list(_of_text(name, rows.decode("utf-8", "replace")))
    except InputError:
        raise
    except ModuleNotFoundError as error:
        raise InputError(f"{name}: is a flight log: install its reader with pip install 'jaximu[formats]'.") from error
    except Exception as error:  # the libraries behind raise nearly anything on damaged files
        raise InputError(f"{name}: begins like a flight log but cannot be read; it is cut off or damaged.") from error
    values: dict[str, tuple[float, ...]] = {}
    for key, value in pairs:
        before = values.setdefault(key, (value,))
        if before[-1] != value and not math.isnan(value):
            values[key] = (*before, value)
    if not values:
        raise InputError(f"{name}: holds no parameters.")
    return ParameterFile(name, values)


def _of_text(name: str, text: str) -> Iterator[tuple[str, float]]:
    for number, line in enumerate(text.splitlines(), 1):
        if not (line.strip() and line.lstrip()[0] not in "#;"):
            continue
        try:
            ((key, value),) = _ROW.findall(line.strip())
            yield key, float(value)
        except ValueError:
            raise InputError(
                f"{name}, row {number}: expected a parameter's name and value, such as CAL_ACC0_XOFF 0.1, found "
                f"{line.strip()[:60]!r}."
            ) from None
