"""A recording made ready for a fit: what is no measurement left out, what can be repaired repaired where asked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError, JaximuError, NotPossibleError
from jaximu.mistakes import (
    base,
    clipping,
    clocks,
    duplicate,
    held_at_rest,
    knocks,
    lost_axis,
    lost_samples,
    mixed_devices,
    no_force,
    periodic,
    quantisation,
    resampled,
    spikes,
    stuck_axis,
    timing,
    wrap,
    zeros,
)
from jaximu.mistakes.base import BRIDGED, Samples, runs_of
from jaximu.recordings.finding import Finding, Rows
from jaximu.recordings.recording import Defect, Recording, Signal, recordings_of

__all__ = ["MISTAKES", "Prepared", "inspect", "one_or_several", "prepare", "prepared", "without_rows"]

_ROUNDS = 4
_MUCH = 0.01  # share of a sensor's rows left out that may be why a calibration is not possible
_REPAIRED = "This was repaired."
_STAGES = (
    (timing,),
    (duplicate, resampled),
    (zeros, knocks),
    (wrap,),
    (spikes,),
    (stuck_axis, clipping, quantisation, held_at_rest, no_force, lost_axis),
    (clocks,),
    (mixed_devices, lost_samples, periodic),
)
"""Checks in the order in which they can be trusted: rows that are no measurement would look like other mistakes."""
_MAGNETIC = ((timing,), (duplicate, resampled), (zeros,), (spikes,), (stuck_axis, clipping))
"""The same of a magnetometer, whose samples are compared with no other sensor's."""

MISTAKES: dict[str, str] = base.TITLES | {
    name: title for stage in _STAGES for check in stage for name, title in check.TITLES.items()
}
"""Every mistake by name, in English."""


@dataclass(frozen=True)
class Prepared:
    """A recording without the rows that are no measurement, and the mistakes that were found on the way.

    findings: those that were repaired say so, and spoil nothing any more. left_out: of each
    sensor the stamps (s) of its rows that were no measurement, gone or bridged.
    """

    recording: Recording
    findings: tuple[Finding, ...]
    left_out: dict[str, FloatArray]

    @property
    def name(self) -> str:
        """The recording's name."""
        return self.recording.name

    @property
    def signals(self) -> dict[str, Signal]:
        """The recording's signals, by name."""
        return self.recording.signals

    @property
    def spoiling(self) -> tuple[Finding, ...]:
        """The findings that stand, and while they stand no effect can be named."""
        return tuple(each for each in self.findings if each.spoils)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for a calibration's notes."""
        return tuple(dict.fromkeys(each.text for each in self.findings))


def one_or_several(given: Any, *others: type) -> list[Any]:
    """Return one recording or several, each of which may have been looked over, as a list; else raise `InputError`.

    **Arguments:** `others`: what may stand among them.
    """
    several = list(given) if isinstance(given, (list, tuple)) else [given]
    if not several:
        raise InputError("no recording was given.")
    return [one if isinstance(one, (Prepared, *others)) else recordings_of(one)[0] for one in several]


def inspect(recording: Recording) -> list[Finding]:
    """Return what is wrong with a recording's samples, before any fit, and what reading it put right."""
    return list(prepare(recording).findings)


def prepare(recording: Recording, repair: bool = False, magnetometer: bool = False) -> Prepared:
    """Leave out what is no measurement, and with `repair` change what can be put right; look again until nothing comes.

    Each kind of mistake of a sensor is handled once, in at most four rounds. `magnetometer`: look at the magnetometer's
    samples, and not at the other sensors'.
    """
    findings = [Finding(note.name, (), str(note)) for note in recording.notes if isinstance(note, Defect)]
    origin: dict[str, Rows] = {name: np.arange(len(signal)) for name, signal in recording.signals.items()}
    handled: set[tuple[str, str]] = set()
    left_out: dict[str, FloatArray] = {}
    stage = 0
    stages = _MAGNETIC if magnetometer else _STAGES
    samples = Samples(recording, origin, magnetometer=magnetometer)
    for _ in range(_ROUNDS + len(stages)):
        new = [finding for check in stages[stage] for finding in check.find(samples)]
        new = [each for each in new if (each.name, each.text.partition(":")[0]) not in handled]
        new = [each for k, each in enumerate(new) if not _told(each, [*findings, *new[:k]])]
        handled |= {(each.name, each.text.partition(":")[0]) for each in new}
        findings += new
        without: dict[str, list[Rows]] = {}
        changed = False
        for finding in new:
            if finding.apply is not None and (repair or not finding.repair):
                recording = finding.apply(recording)
                changed = True
                if finding.repair:
                    place = findings.index(finding)
                    findings[place] = replace(finding, text=f"{finding.text} {_REPAIRED}", spoils=False)
                continue
            for name, rows in finding.without.items():
                without.setdefault(name, []).append(rows)
        for name, parts in without.items():
            rows = np.unique(np.concatenate(parts))
            signal: Signal = getattr(recording, name)
            if len(rows) > len(signal) - 32:
                continue
            fixed, kept = _without(signal, rows, bridge=not any(each.name == "data.resampled" for each in new))
            recording = replace(recording, **{name: fixed})
            origin[name] = origin[name][kept]
            left_out[name] = np.sort(np.concatenate([left_out.get(name, np.zeros(0)), signal.time[rows]]))
            changed = True
        if changed:
            samples = Samples(recording, origin, samples, magnetometer)
        else:
            stage += 1
            if stage == len(stages):
                break
    return Prepared(recording, tuple(_sorted(findings)), left_out)


@contextmanager
def prepared(
    recordings: Sequence[Recording | Prepared],
    repair: bool = False,
    gyroscope: bool = True,
    magnetometer: bool = False,
    gravity: bool = True,
) -> Iterator[tuple[Prepared, ...]]:
    """Make recordings ready; an error on the way begins with the mistake found in them, which is the likelier cause.

    One that was looked over is taken as it is.
    `gyroscope`, `gravity`: whether they are needed. Raises InputError where what is needed is not there, with the
    finding's own sentence.
    """
    unneeded = {name for name, needed in (("gyroscope", gyroscope), ("gravity", gravity)) if not needed}
    ready = tuple(
        recording if isinstance(recording, Prepared) else prepare(recording, repair, magnetometer)
        for recording in recordings
    )
    for each in ready:
        for finding in each.findings:
            if finding.refuses and finding.refuses not in unneeded:
                raise InputError(f"{each.recording.name}: {finding.text} ({finding.name})")
    if len(ready) > 1:
        ready = tuple(_named(each, number) for number, each in enumerate(ready, 1))
    try:
        yield ready
    except (JaximuError, ArithmeticError, ValueError) as error:
        standing = [finding for each in ready for finding in each.spoiling if finding.refuses not in unneeded]
        if not isinstance(error, JaximuError):  # numbers that no recording gives whose rests scatter
            standing = standing or [finding for each in ready for finding in each.findings]
        if not standing:
            emptied = [finding for one in ready for finding in one.findings if _leaves_out_much(one, finding)]
            if not emptied:
                raise
            texts = " ".join(finding.text for finding in emptied[:3])
            raise type(error)(f"{error} Found in the recording: {texts}") from error
        said = {finding.name: f"{finding.text} ({finding.name})" for finding in reversed(standing)}
        reason = str(error) if isinstance(error, JaximuError) else "nothing can be estimated from it."
        raise NotPossibleError(f"{' '.join(list(said.values())[::-1][:3])} Hence: {reason}") from error


def _leaves_out_much(ready: Prepared, finding: Finding) -> bool:
    """Whether a finding left out enough of a recording for what is left to be too little."""
    return any(len(rows) > _MUCH * len(getattr(ready.recording, name)) for name, rows in finding.without.items())


def _named(ready: Prepared, number: int) -> Prepared:
    """Return one of several recordings, its name or number in all that was found in it."""
    files = " and ".join(Path(source.path).name for source in ready.recording.sources) or f"recording {number}"
    return replace(ready, findings=tuple(replace(each, text=f"In {files}: {each.text}") for each in ready.findings))


def without_rows(recording: Recording, rows: Mapping[str, Rows]) -> Recording:
    """Return the recording without rows (k,) of some of its sensors, by name."""
    return replace(recording, **{name: _without(getattr(recording, name), gone, bridge=False)[0]
                                 for name, gone in rows.items()})  # fmt: skip


def _told(finding: Finding, before: Sequence[Finding]) -> bool:
    """Whether a finding only repeats what an earlier one says: gaps that were made, lines that a filter makes."""
    names = {each.name for each in before}
    if finding.name == "data.lost_samples" and not finding.repair and "data.mixed_devices" in names:
        return True  # the same row
    if finding.name == "data.dead_axis":
        stuck = {each.text.partition(":")[0] for each in before if each.name == "data.stuck_axis"}
        return finding.text.partition(":")[0] in stuck
    if finding.name in ("data.bandwidth", "data.lost_samples") and any(
        "repeat the row before" in e.text for e in before
    ):
        return True
    return False


def _sorted(findings: Sequence[Finding]) -> list[Finding]:
    """What spoils the recording first, else in the order in which it was found."""
    return sorted(findings, key=lambda each: not each.spoils)


def _on_steps(signal: Signal, values: np.ndarray) -> np.ndarray:
    """Values rounded to the steps that the output comes in, so that a few made ones do not hide the steps."""
    rounded = values.copy()
    for axis in range(values.shape[1]):
        known = signal.values[:20000, axis]
        steps = np.diff(np.unique(known))
        steps = steps[steps > 1e-10 * np.ptp(known)] if len(steps) else steps
        if len(steps) and len(steps) < 0.8 * len(known):
            step = float(steps.min())
            offset = known[0] - step * np.round(known[0] / step)
            rounded[:, axis] = step * np.round((values[:, axis] - offset) / step) + offset
    return rounded


def _without(signal: Signal, rows: Rows, bridge: bool) -> tuple[Signal, Rows]:
    """Return the signal without rows, and the rows kept; up to three in a row are bridged by a cubic."""
    bad = np.zeros(len(signal), bool)
    bad[rows] = True
    values = np.array(signal.values)
    if bridge:
        for start, stop in runs_of(bad):
            before, after = np.arange(start - 2, start), np.arange(stop, stop + 2)
            around = np.concatenate([before, after])
            if stop - start > BRIDGED or before[0] < 0 or after[-1] >= len(signal) or bad[around].any():
                continue
            time = signal.time[around] - signal.time[start]
            if time[-1] - time[0] > 1.5 * (len(around) + stop - start) * np.median(np.diff(signal.time[before])):
                continue
            place = signal.time[start:stop] - signal.time[start]
            for k, other in enumerate(around):  # Lagrange's cubic through two samples on either side
                factor = np.ones(stop - start)
                for m in range(4):
                    if m != k:
                        factor *= (place - time[m]) / (time[k] - time[m])
                values[start:stop] = (values[start:stop] if k else 0.0) + factor[:, None] * signal.values[other]
            values[start:stop] = _on_steps(signal, values[start:stop])
            bad[start:stop] = False
    kept = np.flatnonzero(~bad)
    return replace(signal, time=signal.time[kept], values=values[kept]), kept
