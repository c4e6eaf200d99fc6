"""The page of a recording: which signals it holds, how they were sampled, and what was noticed."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaximu.ground.document import Json
from jaximu.ground.page import Code, Items, Page, Part, Picture, Section, Table
from jaximu.ground.quantities import listed, number, sentence, unit_text
from jaximu.ground.units import SENSORS
from jaximu.recordings.recording import Recording, Signal


def page_of(recording: Recording) -> Page:
    """Return which sensors are in a recording, how they were sampled, and what reading it had to assume."""
    names = [source.path for source in recording.sources]
    signals = {name: signal_facts(signal) for name, signal in recording.signals.items()}
    after = f"`jaximu info {shlex.quote(names[0])}` shows what it can be used for." if names else ""
    return _page(
        ", ".join(Path(name).name for name in names) or "recording",
        signals,
        (Picture("signals", recording.plot, "All signals against time", "As recorded, in SI units."), _table(signals)),
        recording.notes,
        after,
    )


def log_page(document: Mapping[str, Any], commands: Sequence[str]) -> Page:
    """Return the page of a log that `jaximu info` described; `commands`: a line to paste for each use, or none."""
    uses = []
    for use, command in zip(document["uses"] if commands else (), commands, strict=True):
        uses += [f"{sentence(use['why'])}:", Code(command)]
    return _page(
        document["file"],
        document["signals"],
        [
            _table(document["signals"]),
            *_guess(document.get("guess")),
            Section("What was noticed", [Items(document["findings"])]),
            Section("What it can be used for", uses),
        ],
    )


def signal_facts(signal: Signal, used: Signal | None = None) -> Json:
    """Return how a signal was sampled and between which values it lies.

    **Arguments:** `used`: the signal as every other verb takes it; where its stamps were put right, those count.
    """
    used = used if used is not None and len(used) == len(signal) else signal  # rows left out are no gap of the log
    interval = np.diff(used.time)
    several = len(interval) > 0
    return {
        "unit": signal.unit,
        "samples": len(signal),
        "rate": float(used.rate) if several else 0.0,
        "jitter": float(interval.std()) if several else 0.0,
        "longest_gap": float(interval.max()) if several else 0.0,
        "duration": float(np.ptp(used.time)) if several else 0.0,
        "minimum": signal.values.min(axis=0).tolist() if len(signal) else [],
        "maximum": signal.values.max(axis=0).tolist() if len(signal) else [],
    }


def _page(
    title: str,
    signals: Mapping[str, Mapping[str, Any]],
    parts: Sequence[Part],
    notes: Sequence[str] = (),
    after: str = "",
) -> Page:
    sensors = [name for name in signals if name in SENSORS.values()] or [*signals] or ["no signal"]
    longest = max(signals.values(), key=lambda facts: facts["samples"], default={"samples": 0})
    rate = duration = meaning = ""
    if longest["samples"] > 1:
        rate = f" at {longest['rate']:.5g} Hz"
        duration = f"{longest['duration']:.5g} s"
        meaning = f"from the first to the last of {longest['samples']} samples"
    return Page(title, (sentence(f"{listed(sensors)}{rate}."),), duration, meaning, parts, notes=notes, next=after)


def _table(signals: Mapping[str, Mapping[str, Any]]) -> Table:
    return Table(
        (
            "signal",
            "unit",
            "samples",
            "rate [Hz]",
            "jitter [ms]",
            "longest gap [s]",
            "duration [s]",
            "minimum",
            "maximum",
        ),
        [
            (
                name.replace("_", " "),
                unit_text(facts["unit"]),
                str(facts["samples"]),
                f"{facts['rate']:.5g}",
                number(round(1e3 * facts["jitter"], 6)),
                f"{facts['longest_gap']:.3g}",
                f"{facts['duration']:.5g}",
                *(" ".join(f"{value:.4g}" for value in facts[key]).replace("-", "−") for key in ("minimum", "maximum")),
            )
            for name, facts in signals.items()
        ],
    )


def _guess(guess: Mapping[str, Any] | None) -> Iterator[Part]:
    if guess is None:
        return
    blanks = ", fill in the ?" if "?" in guess["line"] else ""
    parts: list[Part] = [
        f"The file does not say all of this. Check it{blanks}, then paste:",
        Code(guess["line"]),
        Items((*guess["reasons"], *guess["questions"])),
    ]
    if guess["rows"]:
        columns = list(zip(*guess["rows"], strict=True))
        parts.append(Table(("column", *(f"row {row}" for row in range(1, len(columns[0])))), columns))
    yield Section("How the columns were understood", parts)
