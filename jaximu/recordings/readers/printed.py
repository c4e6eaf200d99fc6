"""Text as programs print it for people: labels beside the numbers, several lines a sample, declared rows.

A line's shape is the line with its numbers taken out. Where most lines have one shape, or a few shapes follow each
other again and again, the numbers are columns, and the words before each are its name.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress

import numpy as np

from jaximu.ground.units import column_title, find_unit
from jaximu.recordings.columns.table import HEAD, LogTable
from jaximu.recordings.readers.clock import seconds_of
from jaximu.recordings.recording import Source

_LOOKED_AT = 400  # lines in which a shape is looked for
_LONGEST = 40  # lines of a sample
_MOST = 0.6  # of the lines that must have the shape
_FEWEST = 3  # numbers with a label, and numbers in all, of a sample
_NUMBER = re.compile(r"(?<![\w.^])[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?![\w.])")
_CLOCK = re.compile(r"(?<![\w:])\d{1,2}:\d{2}:\d{2}[.,]\d+")
_ADDRESS = re.compile(r"\b(?:[0-9A-Fa-f]{2}[:-]){5}[0-9A-Fa-f]{2}\b")
_TUPLE = re.compile(r"\s*[\[({]\s*#(?:[,;]?\s*#){2,}\s*[\])}],?")
_CHECKSUM = re.compile(r"\*[0-9A-Fa-f]{2,8}\s*$")
_LABELLED = re.compile(r"[A-Za-z_)\]\"]\s*[:=]\s*[\[(]?\s*#|->\s*#|^\[#\]\s*\$")
_PROTOCOL = re.compile(r"[\w.\-]+(?:,[\w.\-]+=[\w.\-]+)* (?:[\w.\-]+=#i?,?)+ #")
_DECLARED = re.compile(rb"^\$COL,IMU,(.*)$\n\$UNIT,IMU,(.*)$", re.MULTILINE)
_HEX = re.compile(r"(?:[0-9A-Fa-f]{2}|[0-9A-Fa-f]{4})(?:[\s,]+(?:[0-9A-Fa-f]{2}|[0-9A-Fa-f]{4})){5,}\s*")
_PARAMETER = re.compile(r"(?:\d+\s+\d+\s+)?[A-Z][A-Z0-9]*_\w+[\s,=]+[-+.\deE]+(?:\s.*)?$")
_ARRAY = re.compile(r"\"[-+.\deE]+(?:\|[-+.\deE]+){2,}\"")
_SENTENCE = re.compile(r"\[#\]\s*(\$\w+)")


def _text(data: bytes) -> list[str]:
    lines = data.decode("utf-8-sig", errors="replace").replace("\r\n", "\n").replace("\r", "\n").split("\n")
    return [line for line in lines if line.strip()]


def _shape(line: str) -> str:
    """The line with a # for each number, @ for a time of day, and without a device's address."""
    return _NUMBER.sub("#", _CLOCK.sub("@", _ADDRESS.sub("", _CHECKSUM.sub("", line.rstrip()))))


def _values(line: str) -> list[str]:
    line = _ADDRESS.sub("", _CHECKSUM.sub("", line.rstrip()))
    return [*_CLOCK.findall(line), *_NUMBER.findall(_CLOCK.sub("@", line))]


def _sample(shapes: list[str]) -> tuple[str, ...] | None:
    """The shapes of the lines of one sample, as most lines have them; None for none."""
    if not shapes:
        return None
    (common, count), *_ = Counter(shapes).most_common(1)
    if count >= _MOST * len(shapes):
        return (common,)
    for length in range(2, min(_LONGEST, len(shapes) // 3) + 1):
        follow = np.mean([one == other for one, other in zip(shapes, shapes[length:], strict=False)])
        first = shapes[length : 2 * length]
        if follow >= _MOST and len(set(first)) > len(first) // 2:
            start = first.index("---") + 1 if "---" in first else 0  # as YAML parts documents
            return tuple(first[start:] + first[:start])
    return None


def _of(data: bytes) -> tuple[str, ...] | None:
    """The shapes of a sample's lines in printed text, None where the text is a table or something else."""
    sample = _sample([_shape(line) for line in _text(data)[:_LOOKED_AT][:-1]])
    if sample is None or sum(line.count("#") for line in sample) < _FEWEST:
        return None
    labels = sum(len(_LABELLED.findall(line)) for line in sample)
    alone = len(sample) == 1 and (re.search(r"->\s*#|^\[#\]\s*\$", sample[0]) or _TUPLE.fullmatch(sample[0]))
    return sample if labels >= _FEWEST or alone else None


def prints(head: bytes) -> bool:
    """Whether text is printed for people, or declares its rows, rather than a table."""
    return bool(_DECLARED.search(head)) or _of(head) is not None


def explained(head: bytes) -> str:
    """Say what text is that cannot be read as it stands, and how to bring it in; empty for any other."""
    lines = _text(head)[:_LOOKED_AT]
    if sum(line.startswith(("%RAWIMU", "#RAWIMU")) for line in lines) > len(lines) / 2:
        return (
            "is a receiver's RAWIMU log (NovAtel): counts of velocity and angle increments, the y axis negated, whose "
            "scale is the IMU's. Multiply by the scales of its manual, divide by the sampling interval, and write "
            "columns time [s], accel_x [m/s^2], … gyro_z [rad/s]"
        )
    rows = [line for line in lines if not line.startswith("#")]
    if sum(bool(_PARAMETER.match(line)) for line in rows) > 0.9 * len(rows) > 0:
        return "is a list of an autopilot's parameters, not a log; `jaximu export` takes it with --in-force"
    words = [bool(_HEX.fullmatch(line)) for line in lines]
    if words and np.mean(words) > 0.9 and re.search("[A-Fa-f]", "".join(lines)):
        return (
            "holds hexadecimal words, as a sensor's registers have them. Convert each to a signed whole number (16 "
            "bits, two's complement), write one column an axis, and state counts with --columns and the scales with "
            "--accel-scale and --gyro-scale"
        )
    if sum(bool(_ARRAY.search(line)) for line in lines) > len(lines) / 2:
        return (
            "holds arrays: several samples in one cell, parted by vertical bars, as the CSV of a FIT file has them. "
            "Write each sample in a separate row, with the time that it was taken at"
        )
    return ""


def _line_names(line: str, heading: str) -> list[str]:
    """Names of the numbers of a line, one after the other: words before them, and units after them.

    heading: of the lines above that hold no number.
    """
    parts = re.split(r"[#@]", line)
    names = []
    group, axis = "", 0
    for number, text in enumerate(parts[:-1]):
        words = _label(text)
        if len(words) == 1 and words[0].lower() in tuple("wxyz") and group:
            words = [group, *words]
        elif words:
            group = " ".join(word for word in words if word.lower() not in tuple("wxyz"))
            axis = 0
            if _vector(parts, number):
                words = [*words, "x"]
        elif group and axis < 2 and "," in text:
            axis += 1
            words = [group, "xyz"[axis]]
        names.append(f"{heading}{' '.join(words)}" if words else "")
    return _with_units(names, parts)


def _vector(parts: list[str], number: int) -> bool:
    """Whether a label stands before three numbers in brackets."""
    between = [part.strip() for part in parts[number + 1 : number + 3]]
    return parts[number].rstrip().endswith(("[", "(")) and between == [",", ","]


def _label(text: str) -> list[str]:
    """The words of a label between two numbers: what follows the last unit, bracket or comma."""
    text = re.sub(r"[:=>\-]+\s*[\[(]?\s*$", "", text.rstrip().rstrip("[(").rstrip())
    last = re.split(r"[,;|\])\t]", text)[-1].strip()
    last = last.rpartition(" ")[2] if "=" in last else last  # tags of a protocol stand before its fields
    words = re.findall(r"[A-Za-z_][\w./]*", last)
    return words[1:] if len(words) > 1 and find_unit(words[0]) else words


def _with_units(names: list[str], parts: list[str]) -> list[str]:
    """The names with the unit that stands after each number, or after the last one of a line."""
    units = [re.match(r"\s*\[?\(?([^\s,;\[\]()|:=]+)", text) for text in parts[1:]]
    stated = [match[1] if match and find_unit(match[1]) else "" for match in units]
    if stated and stated[-1] and not any(stated[:-1]):
        several, head = len(names[-1].split()) > 1, names[-1].rpartition(" ")[0]
        stated = [stated[-1] if several or name.rpartition(" ")[0] == head else "" for name in names]
    return [column_title(name, name and unit) for name, unit in zip(names, stated, strict=True)]


def _names(sample: tuple[str, ...]) -> list[str]:
    """The names of a sample's numbers, under the headings of lines that hold none, as far as these are set in."""
    names = []
    headings: list[tuple[int, str]] = []
    for line in sample:
        indent = len(line) - len(line.lstrip())
        headings = [heading for heading in headings if heading[0] < indent]
        if "#" in line or "@" in line:
            names += _line_names(line, "".join(f"{name}." for _, name in headings))
        elif match := re.fullmatch(r"\s*([A-Za-z_]\w*):", line):
            headings.append((indent, match[1]))
    return names


def _rows(lines: list[str], sample: tuple[str, ...]) -> Iterator[tuple[int, list[str]]]:
    """The number of the first line, and the numbers, of each whole sample."""
    shapes, at, length = [_shape(line) for line in lines], 0, len(sample)
    while at <= len(lines) - length:
        if shapes[at] == sample[0] and tuple(shapes[at : at + length]) == sample:
            yield at + 1, [value for line in lines[at : at + length] for value in _values(line)]
            at += length
        else:
            at += 1


def _numbers(texts: Sequence[str]) -> np.ndarray:
    if all(re.fullmatch(r"[+-]?\d{1,18}", text) for text in texts[:1000]):
        with suppress(ValueError, OverflowError):
            return np.array(texts, np.int64)
    return np.array(texts, float)


def read(data: bytes, source: Source) -> LogTable:
    """The table in printed text. Raises InputError where no whole sample is there."""
    declared = _DECLARED.search(data)
    if declared is not None:
        return _declared(data, source, declared)
    sample = _of(data[:HEAD])
    rows = [] if sample is None else list(_rows(_text(data), sample))
    if sample is None or len(rows) < 2:
        raise source.refused("holds no whole samples of text with labels.")
    first, cells = zip(*rows, strict=True)
    columns, names = [], _names(sample)
    if _PROTOCOL.fullmatch(sample[0]):
        names[-1], note = "time [ns]", "InfluxDB's line protocol: fields by name, the time in ns at the end."
    elif sentence := _SENTENCE.match(sample[0]):
        from jaximu.recordings.columns.known import sentence_names

        names = ["time [s]", *(sentence_names(sentence[1], len(names) - 1) or [""] * (len(names) - 1))]
        note = f"a terminal program's time stands before each {sentence[1]} sentence."
    elif "@" in sample[0] and "->" in sample[0]:
        note = "a serial monitor's time of day and arrow (->) stand before the values."
    elif _TUPLE.fullmatch(sample[0]):
        note = "each row stands in brackets, as a program prints a list."
    elif len(sample) > 1:
        note = f"a sample is printed in {len(sample)} lines, with words and labels beside the numbers."
        note = "YAML as `ros2 topic echo` prints it." if "---" in sample else note
    else:
        note = "labels stand beside the numbers (name:value pairs), and name the columns."
    for at, texts in enumerate(zip(*cells, strict=True)):
        stamps = seconds_of(np.array(texts, object)) if _CLOCK.fullmatch(texts[0]) else None
        columns.append(_numbers(texts) if stamps is None else stamps)
        names[at] = names[at] if stamps is None else "time of day [ns]"
    return LogTable(source, names if any(names) else None, columns, np.array(first), notes=(note,))


def _declared(data: bytes, source: Source, declared: re.Match[bytes]) -> LogTable:
    """The rows of $IMU in a text that declares its columns and their units, as FlySight writes it."""
    names, units = (part.decode().strip().split(",") for part in declared.groups())
    rows = [line.split(b",")[1:] for line in data.split(b"\n") if line.startswith(b"$IMU,")]
    whole = [row for row in rows if len(row) == len(names)]
    if len(whole) < 2:
        raise source.refused("declares columns ($COL) of $IMU, and has no rows of it.")
    columns = [_numbers([cell.decode().strip() for cell in column]) for column in zip(*whole, strict=True)]
    titles = [f"{name} [{unit.replace('deg C', 'degC')}]" for name, unit in zip(names, units, strict=True)]
    note = "rows of several kinds, declared by $COL and $UNIT as FlySight writes them: those of $IMU are read."
    return LogTable(source, titles, columns, notes=(note,))
