"""Checks of what a verb wrote: every file loads again, holds finite numbers, and agrees with what --json printed."""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from jaximu.calibration import load_calibration
from jaximu.ground.document import digest
from jaximu.ground.errors import JaximuError
from jaximu.recordings.readers import ReadOptions, read_recording

PNG = b"\x89PNG\r\n\x1a\n"
NO_NUMBER = re.compile(r"(?<![\w.])[-+]?\.?(nan|inf|infinity)(?![\w.])", re.IGNORECASE)
RUN = {"digest", "software", "path", "file", "files", "table", "seconds", "elapsed", "sha256", "output", "truth"}
"""Keys whose values belong to one run: where files lie, and how long it took."""


def faults_of_files(folder: Path, written: tuple[str, ...]) -> list[str]:
    """Return what is wrong with the files of a folder, each by itself."""
    faults = []
    for name in written:
        path = folder / name
        try:
            faults += [f"{name}: {text}" for text in _faults_of(path)]
        except (JaximuError, ValueError, KeyError, OSError) as error:
            faults.append(f"{name} does not load: {type(error).__name__}: {error}")
    return faults


def strict(text: str) -> Any:
    """Parse JSON as the standard has it. Raises `ValueError` for what is none, NaN and infinity included."""

    def refuse(constant: str) -> None:
        raise ValueError(f"JSON holds {constant}")

    return json.loads(text, parse_constant=refuse)


def faults_of_document(document: Any) -> list[str]:
    """Return what is wrong with a JSON document of the library's own."""
    if not isinstance(document, dict) or not str(document.get("schema", "")).startswith("jaximu."):
        return []
    stated = document.get("digest")
    return [] if stated in (None, digest(document)) else ["its digest is not that of its content"]


def _faults_of(path: Path) -> Iterator[str]:
    suffix = path.suffix.lower()
    if not path.stat().st_size:
        yield "is empty"
    elif suffix == ".json":
        document = strict(path.read_text(encoding="utf-8"))
        yield from faults_of_document(document)
        if isinstance(document, dict) and document.get("schema") == "jaximu.calibration/1":
            kept = strict(load_calibration(path).text())
            yield from (f"loaded and saved again, {text}" for text in differences(document, kept))
    elif suffix == ".png":
        if not path.read_bytes().startswith(PNG):
            yield "is no PNG"
    elif suffix == ".html":
        yield from _faults_of_page(path)
    elif suffix == ".parquet":
        table = pq.read_table(path)
        if not table.num_rows:
            yield "has no rows"
        if any(name.startswith("accel_x") for name in table.column_names):
            _read(path)
    elif suffix in (".mcap", ".db3"):
        read_recording(path, None, ReadOptions(topic="/imu/corrected"))
    elif suffix == ".npz":
        with np.load(path) as arrays:
            bad = [name for name in arrays if arrays[name].dtype.kind == "f" and not np.isfinite(arrays[name]).all()]
        if bad:
            yield f"{', '.join(bad)}: not finite"
    elif suffix == ".csv":
        yield from _faults_of_table(path)
    elif suffix in (".yaml", ".params", ".param", ".h", ".cfg", ".txt", ".py", ".xml", ".toml"):
        if match := NO_NUMBER.search(path.read_text(encoding="utf-8")):
            yield f"holds {match[0]}"


def _faults_of_page(path: Path) -> Iterator[str]:
    text = path.read_text(encoding="utf-8")
    if "</html>" not in text:
        yield "is cut off"
    for name in re.findall(r'src="([^":]+\.png)"', text):
        if not (path.parent / name).is_file():
            yield f"shows {name}, which is not there"
    visible = re.sub(r"<(script|style|svg)\b.*?</\1>|<[^>]*>", " ", text, flags=re.DOTALL)
    if match := NO_NUMBER.search(visible):
        yield f"says {match[0]}: {' '.join(visible[max(0, match.start() - 60) : match.end() + 20].split())}"


def _faults_of_table(path: Path) -> Iterator[str]:
    with path.open(newline="", encoding="utf-8") as file:
        lengths, first = set(), []
        for row in csv.reader(line for line in file if not line.startswith("#")):
            first = first or row
            lengths.add(len(row))
            if bad := next((cell for cell in row if NO_NUMBER.fullmatch(cell.strip())), None):
                yield f"holds {bad}"
                return
    if len(lengths) != 1:
        yield f"has rows of {sorted(lengths)} cells"
    if any(cell.startswith("accel_x") for cell in first):
        _read(path)


def _read(path: Path) -> None:
    calibration = path.parent / "calibration.json"  # where there is one, it keeps how the log beside it is read
    like = load_calibration(calibration).reading if calibration.is_file() else None
    read_recording(path, None, ReadOptions(like=like))


def differences(left: Any, right: Any, path: str = "", tolerance: float = 1e-9) -> list[str]:
    """Return where two documents differ, but for what belongs to one run."""
    if isinstance(left, dict) and isinstance(right, dict):
        found = [f"{path or 'it'} has {key} on one side only" for key in sorted((left.keys() ^ right.keys()) - RUN)]
        for key in sorted((left.keys() & right.keys()) - RUN):
            found += differences(left[key], right[key], f"{path}.{key}".strip("."), tolerance)
        return found
    if isinstance(left, list) and isinstance(right, list) and len(left) == len(right):
        pairs = enumerate(zip(left, right, strict=True))
        return [text for index, (a, b) in pairs for text in differences(a, b, f"{path}[{index}]", tolerance)]
    if isinstance(left, int | float) and isinstance(right, int | float) and not isinstance(left, bool):
        near = math.isclose(left, right, rel_tol=tolerance, abs_tol=1e-300)
        return [] if near else [f"{path} is {left!r} here and {right!r} there"]
    return [] if left == right else [f"{path} is {_short(left)} here and {_short(right)} there"]


def disagreement(folder: Path, written: tuple[str, ...], printed: dict[str, Any]) -> list[str]:
    """Return how the files of a run differ from what --json printed in another; the document of its schema counts."""
    schema = printed.get("schema")
    alike = []
    for name in written:
        if name.endswith(".json"):
            document = strict((folder / name).read_text(encoding="utf-8"))
            beside = folder / f"{name.removesuffix('.json')}.acceptance.json"
            if beside.is_file():  # what --json prints as one document is two files
                document["acceptance"] = strict(beside.read_text(encoding="utf-8"))
            if isinstance(document, dict) and document.get("schema") == schema:
                alike.append((name, differences(printed, document)))
    if schema is None or not alike:
        return []
    name, found = min(alike, key=lambda pair: len(pair[1]))
    return [f"{name} and --json: {text}" for text in found[:3]]


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) < 60 else f"{text[:57]}…"
