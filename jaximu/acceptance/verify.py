"""Whether a calibration or a verdict is what was written, and the files it rests on are what they were.

Every document carries its own hash (`digest`) and the hashes of what it was made from: a verdict those of its limits
and its calibration, a calibration those of its recordings and its references' certificates. A change of any breaks the
chain at that place. There is no secret in it: whoever can change all files can make a new chain, and what proves a
chain is its last hash, kept elsewhere (on the printed certificate).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from jaximu.ground.document import digest, file_digest, read_document
from jaximu.ground.errors import FilePath

INTACT, CHANGED, MISSING, UNSEALED = "intact", "changed", "not found", "without a hash"


@dataclass(frozen=True)
class Link:
    """One file of a chain. what: its part in it; state: "intact", "changed", "not found" or "without a hash"."""

    what: str
    file: str
    state: str


def verify(path: FilePath, folder: FilePath | None = None) -> list[Link]:
    """Check a document of jaximu and everything that it names by its hash.

    **Arguments:** `folder`: where files are looked for as well that are not where they were; the document's own folder
    always is.

    Raises `InputError` where the document cannot be read.
    """
    return list(_links(Path(path), [Path(path).parent, *([Path(folder)] if folder is not None else [])], "document"))


def state_of(path: FilePath) -> str:
    """Return the state of a document by itself, without the files behind it."""
    return next(_links(Path(path), [], "document")).state


def _links(path: Path, folders: list[Path], what: str, expected: str | None = None) -> Iterator[Link]:
    document = read_document(path, None, "a calibration.json or an acceptance.json")
    stated = document.get("digest")
    sealed = INTACT if stated == digest(document) and expected in (None, stated) else CHANGED
    yield Link(what, str(path), UNSEALED if stated is None else sealed)
    calibration = document.get("calibration")
    if isinstance(calibration, dict) and calibration.get("digest"):
        file = _find(str(calibration["file"]), folders)
        if file is None:
            yield Link("calibration", str(calibration["file"]), MISSING)
        else:
            yield from _links(file, [*folders, file.parent], "calibration", str(calibration["digest"]))
    named = [("limits", document.get("limits"))]
    data = document.get("data")
    named += [("recording", recording) for recording in (data.get("files") or () if isinstance(data, dict) else ())]
    trace = document.get("trace")
    if calibration is None and isinstance(trace, dict):
        named += [(f"certificate of {reference['name']}", reference) for reference in trace.get("reference", ())]
    for part, entry in named:
        if isinstance(entry, dict) and entry.get("sha256") and entry.get("file"):
            file = _find(str(entry["file"]), folders)
            same = file is not None and file_digest(file) == entry["sha256"]
            yield Link(part, str(entry["file"]), MISSING if file is None else INTACT if same else CHANGED)


def _find(name: str, folders: list[Path]) -> Path | None:
    """Return a file where it was, or of the same name in one of the folders."""
    paths = [Path(name), *(folder / name for folder in folders), *(folder / Path(name).name for folder in folders)]
    return next((path for path in paths if path.is_file()), None)
