"""Rows that a sensor itself flags: a status column is read, and rows off its usual value are left out."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from jaximu.ground.errors import FilePath, InputError
from jaximu.recordings.readers.reader import read_table
from jaximu.recordings.recording import Recording

_STATUS = re.compile(r"(?:^|[^a-z])(?:status|flags?|errors?|faults?)(?:$|[^a-z])", re.IGNORECASE)


def without_flagged(recording: Recording, path: FilePath) -> Recording:
    """Return a recording without the rows of its file in which a status column is not as usual, and say so.

    A column whose name holds status, flag, error or fault counts. Only rows of sensors that share the file's stamps are
    left out; where more than half of the rows would go, nothing is.
    """
    try:
        table = read_table(path)
    except InputError:  # a format that is no table of columns
        return recording
    notes, bad = [], np.zeros(table.source.rows, bool)
    for at, name in enumerate(table.header):
        if not _STATUS.search(name) or table.columns[at].dtype == object:
            continue
        values, counts = np.unique(table.columns[at], return_counts=True)
        usual = values[np.argmax(counts)]
        off = table.columns[at] != usual
        if off.mean() > 0.5:
            notes.append(f"{path}: column {name} has no usual value and was not used.")
        elif off.any():
            bad |= off
            notes.append(f"{path}: {int(off.sum())} rows whose {name} is not {usual:g} were left out.")
    changed = {
        name: replace(signal, time=signal.time[~bad], values=signal.values[~bad])
        for name, signal in recording.signals.items()
        if bad.any() and len(signal) == len(bad)
    }
    return replace(recording, **changed, notes=(*recording.notes, *notes))
