"""Damage to files: edits as recipes that can be kept, within compressed parts too, and what may come of reading."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import sample_logs

from jaximu.ground.errors import JaximuError
from jaximu.recordings.readers import ReadOptions, read_recording

Edit = tuple[str, int, bytes | int]
"""("set" or "insert", place, bytes); ("cut", "repeat" or "flip", place, bytes or bit); ("end", place, 0)."""
ROWS = 60  # of the files that are damaged: small ones, so that a change matters
_EXTREMES = (
    b"\0" * 8, b"\xff" * 8, b"\x7f" * 8, b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\xff\xff", b"\1\0\0\0", b"nan", b"1e999",
    b"\n", b",",
)  # fmt: skip


def damaged(data: bytes, edits: list[Edit]) -> bytes:
    for kind, at, what in edits:
        if isinstance(what, bytes):
            data = data[:at] + what + data[at + len(what) * (kind == "set") :]
        elif kind == "cut":
            data = data[:at] + data[at + what :]
        elif kind == "repeat":
            data = data[: at + what] + data[at:]
        elif kind == "flip" and at < len(data):
            data = data[:at] + bytes([data[at] ^ 1 << what]) + data[at + 1 :]
        elif kind == "end":
            data = data[: max(at, 1)]
    return data


def draw(generator: np.random.Generator, size: int) -> list[Edit]:
    """One to four edits to a file of `size` bytes, half of them in the first 512, where the headers are."""
    edits: list[Edit] = []
    for _ in range(generator.integers(1, 5)):
        at = int(generator.integers(max(min(size, 512) if generator.random() < 0.5 else size, 1)))
        at -= at % 4 if generator.random() < 0.3 else 0
        kind = generator.choice(["flip", "flip", "set", "set", "insert", "cut", "repeat", "end"])
        if kind == "flip":
            what = int(generator.integers(8))
        elif kind in ("cut", "repeat"):
            what = int(generator.integers(1, 200))
        elif kind == "end":
            if generator.random() < 0.7:  # what is cut off short is soon told
                continue
            what = 0
        elif generator.random() < 0.5:
            what = bytes(generator.bytes(generator.integers(1, 9)))
        else:
            what = _EXTREMES[generator.integers(len(_EXTREMES))]
        edits.append((str(kind), at, what))
    return edits


# --- damage within compressed parts, which outside them ends at a checksum


def _within_mat(data: bytes, damage: Callable[[bytes], bytes]) -> bytes:
    parts, at = [data[:128]], 128
    while at + 8 <= len(data):
        kind, count = struct.unpack_from("<II", data, at)
        body = data[at + 8 : at + 8 + count]
        body = zlib.compress(damage(zlib.decompress(body)), 1) if kind == 15 else damage(body)
        parts.append(struct.pack("<II", kind, len(body)) + body)
        at += 8 + count
    return b"".join(parts)


def _within_npz(data: bytes, damage: Callable[[bytes], bytes]) -> bytes:
    changed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as archive, zipfile.ZipFile(changed, "w", zipfile.ZIP_DEFLATED) as target:
        for each in archive.infolist():
            target.writestr(each.filename, damage(archive.read(each)))
    return changed.getvalue()


def _within_mcap(data: bytes, damage: Callable[[bytes], bytes]) -> bytes:
    """The records that are no chunk as they are, chunks without checksum, and no index at the end."""
    from rosbags.rosbag2.storage_mcap import zstd

    parts, at = [data[:8]], 8
    while True:
        kind, size = struct.unpack_from("<BQ", data, at)
        body = data[at + 9 : at + 9 + size]
        at += 9 + size
        if kind in (2, 15):  # the footer, the end of the data
            break
        if kind == 6:
            (length,) = struct.unpack_from("<I", body, 28)
            name, packed = body[32 : 32 + length], body[40 + length :]
            content = damage(zstd.decompress(packed) if name else packed)
            packed = zstd.compress(content) if name else content
            body = body[:16] + struct.pack("<QII", len(content), 0, length) + name
            body += struct.pack("<Q", len(packed)) + packed
        if kind != 7:
            parts.append(struct.pack("<BQ", kind, len(body)) + body)
    return b"".join([*parts, struct.pack("<BQ", 2, 20), bytes(20), data[:8]])


WITHIN = {"mat": _within_mat, "mat plain": _within_mat, "broad": _within_mat, "npz": _within_npz,
          "mcap": _within_mcap, "mcap zstd": _within_mcap}  # fmt: skip


def made(name: str, original: bytes, seed: int) -> tuple[bytes, list[Edit], bool]:
    """A damaged file, and its recipe: the edits, and whether they were made within the compressed parts."""
    generator = np.random.default_rng([seed, *name.encode()])
    within = name in WITHIN and generator.random() < 0.5
    edits = draw(generator, len(original))
    return remade(name, original, edits, within), edits, within


def remade(name: str, original: bytes, edits: list[Edit], within: bool) -> bytes:
    return WITHIN[name](original, lambda part: damaged(part, edits)) if within else damaged(original, edits)


# --- files


def originals(folder: Path) -> dict[str, Path]:
    """A file of each format; a bag that is a folder is damaged in its metadata."""
    rows, sample_logs.ROWS = sample_logs.ROWS, ROWS
    try:
        found = {name: write(folder / name.replace(" ", "_")) for name, write in sample_logs.FORMATS.items()}
        bag = sample_logs.write_bag(folder / "bag", sample_logs.imu_messages(2), storage="mcap")
    finally:
        sample_logs.ROWS = rows
    return found | {"bag folder": bag / "metadata.yaml"}


def attempt(path: Path, data: bytes) -> str:
    """Read the damaged file: "recording", where it is sound, or the sentence that came, which names file or option."""
    path.write_bytes(data)
    opened = path.parent if path.name == "metadata.yaml" else path
    try:
        recording = read_recording(opened, options=ReadOptions(check=False))
    except JaximuError as error:
        text = str(error)
        assert text and "\n" not in text and (path.name in text or opened.name in text or "--" in text)
        return text
    for signal in recording.signals.values():
        assert np.isfinite(signal.values).all() and np.isfinite(signal.time).all()
        assert (np.diff(signal.time) > 0).all()
    return "recording"
