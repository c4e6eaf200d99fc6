"""A recording made ready for a fit: what is no measurement left out, what can be repaired repaired where asked."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
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
from jaximu.mistakes.base import BRIDGED, Samples
from jaximu.recordings.finding import Finding, Rows
from jaximu.recordings.recording import Defect, Recording, Signal, recordings_of, runs_of, steps_of

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
        return tuple(finding for finding in self.findings if finding.spoils)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for a calibration's notes."""
        return tuple(dict.fromkeys(finding.text for finding in self.findings))


def one_or_several(recordings: Any, *others: type) -> list[Any]:
    """Return one recording or several, each of which may have been looked over, as a list; else raise `InputError`.

    **Arguments:** `others`: what may stand among them.
    """
    several = recordings_of(recordings, Prepared, *others)
    if not several:
        raise InputError("no recording was given.")
    return several


def inspect(recording: Recording) -> list[Finding]:
    """Return what is wrong with a recording's samples, before any fit, and what reading it put right."""
    return list(prepare(recording).findings)


def prepare(
    recording: Recording,
    repair: bool = False,
    magnetometer: bool = False,
    misfit: Callable[[Recording], float] | None = None,
) -> Prepared:
    """Leave out what is no measurement, and with `repair` change what can be put right; look again until nothing comes.

    Each kind of mistake of a sensor is handled once, in at most four rounds. `magnetometer`: look at the magnetometer's
    samples, and not at the other sensors'. `misfit`: what a fit leaves of a recording; what looks like a mistake that
    spoils it, and whose repair fits worse, is none.
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
        new = [finding for finding in new if (finding.name, _subject(finding)) not in handled]
        without: dict[str, list[Rows]] = {}
        changed = False
        for finding in new:
            if _repeats(finding, findings):
                continue
            handled.add((finding.name, _subject(finding)))
            if misfit is not None and finding.spoils and finding.repair and _fits_worse(recording, finding, misfit):
                continue
            if finding.apply is not None and (repair or not finding.repair):
                recording = finding.apply(recording)
                changed = True
                if finding.repair:
                    finding = replace(finding, text=f"{finding.text} {_REPAIRED}", spoils=False)
            else:
                for name, rows in finding.without.items():
                    without.setdefault(name, []).append(rows)
            findings.append(finding)
        for name, parts in without.items():
            rows = np.unique(np.concatenate(parts))
            signal = recording.signals[name]
            if len(rows) > len(signal) - 32:
                continue
            fixed, kept = _without(signal, rows, bridge=all(finding.name != "data.resampled" for finding in new))
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
    # what spoils the recording first, else in the order in which it was found
    return Prepared(recording, tuple(sorted(findings, key=lambda finding: not finding.spoils)), left_out)


@contextmanager
def prepared(
    recordings: Sequence[Recording | Prepared],
    repair: bool = False,
    gyroscope: bool = True,
    magnetometer: bool = False,
    gravity: bool = True,
    misfit: Callable[[Recording], float] | None = None,
) -> Iterator[tuple[Prepared, ...]]:
    """Make recordings ready; an error on the way begins with the mistake found in them, which is the likelier cause.

    One that was looked over is taken as it is.
    `gyroscope`, `gravity`: whether they are needed; `misfit` as for `prepare`. Raises InputError where what is needed
    is not there, with the finding's own sentence.
    """
    unneeded = {name for name, needed in (("gyroscope", gyroscope), ("gravity", gravity)) if not needed}
    ready = tuple(
        recording if isinstance(recording, Prepared) else prepare(recording, repair, magnetometer, misfit)
        for recording in recordings
    )
    for one in ready:
        for finding in one.findings:
            if finding.refuses and finding.refuses not in unneeded:
                raise InputError(f"{one.name}: {finding.text} ({finding.name})")
    if len(ready) > 1:
        ready = tuple(_named(one, number) for number, one in enumerate(ready, 1))
    try:
        yield ready
    except (JaximuError, ArithmeticError, ValueError) as error:
        standing = [finding for one in ready for finding in one.spoiling if finding.refuses not in unneeded]
        if not isinstance(error, JaximuError):  # numbers that no recording gives whose rests scatter
            standing = standing or [finding for one in ready for finding in one.findings]
        if not standing:
            emptied = [finding for one in ready for finding in one.findings if _leaves_out_much(one, finding)]
            if not emptied:
                raise
            sentences = " ".join(finding.text for finding in emptied[:3])
            raise type(error)(f"{error} Found in the recording: {sentences}") from error
        texts = {finding.name: f"{finding.text} ({finding.name})" for finding in reversed(standing)}
        reason = str(error) if isinstance(error, JaximuError) else "nothing can be estimated from it."
        raise NotPossibleError(f"{' '.join(list(texts.values())[::-1][:3])} Hence: {reason}") from error


def _fits_worse(recording: Recording, finding: Finding, misfit: Callable[[Recording], float]) -> bool:
    """Whether a recording fits worse once a finding is repaired; one that cannot be fitted fits worst."""
    misfits = []
    for tried in (recording, recording if finding.apply is None else finding.apply(recording)):
        try:
            misfits.append(misfit(tried))
        except JaximuError:
            misfits.append(np.inf)
    return misfits[1] > misfits[0]


def _leaves_out_much(ready: Prepared, finding: Finding) -> bool:
    """Whether a finding left out enough of a recording for what is left to be too little."""
    return any(len(rows) > _MUCH * len(getattr(ready.recording, name)) for name, rows in finding.without.items())


def _named(ready: Prepared, number: int) -> Prepared:
    """Return one of several recordings, its name or number in all that was found in it."""
    findings = (of_one(finding, ready.recording, number) for finding in ready.findings)
    return replace(ready, findings=tuple(findings))


def of_one(finding: Finding, recording: Recording, number: int) -> Finding:
    """Return a finding in one of several recordings, which its text names by their files or else by its number."""
    files = " and ".join(Path(source.path).name for source in recording.sources) or f"recording {number}"
    return replace(finding, text=f"In {files}: {finding.text}")


def without_rows(recording: Recording, rows: Mapping[str, Rows]) -> Recording:
    """Return the recording without rows (k,) of some of its sensors, by name."""
    changed = {name: _without(recording.signals[name], gone, bridge=False)[0] for name, gone in rows.items()}
    return replace(recording, **changed)


def _subject(finding: Finding) -> str:
    """What a finding is about: its sentence up to the colon, a sensor and an axis or a place."""
    return finding.text.partition(":")[0]


def _repeats(finding: Finding, before: Sequence[Finding]) -> bool:
    """Whether a finding only repeats what an earlier one says: gaps that were made, lines that a filter makes."""
    if finding.name == "data.dead_axis":
        return any(other.name == "data.stuck_axis" and _subject(other) == _subject(finding) for other in before)
    same_row = finding.name == "data.lost_samples" and not finding.repair
    if same_row and any(other.name == "data.mixed_devices" for other in before):
        return True
    filled_in = finding.name in ("data.bandwidth", "data.lost_samples")
    return filled_in and any("repeat the row before" in other.text for other in before)


def _on_steps(signal: Signal, values: np.ndarray) -> np.ndarray:
    """Values rounded to the steps that the output comes in, so that a few made ones do not hide the steps."""
    rounded = values.copy()
    for axis, known in enumerate(signal.values[:20000].T):
        steps = steps_of(known)
        if 0 < len(steps) < 0.8 * len(known):
            step = steps.min()
            offset = known[0] - step * np.round(known[0] / step)
            rounded[:, axis] = step * np.round((values[:, axis] - offset) / step) + offset
    return rounded


def _without(signal: Signal, rows: Rows, bridge: bool) -> tuple[Signal, Rows]:
    """Return the signal without rows, and the rows kept; up to three in a row are bridged by a cubic."""
    bad = np.zeros(len(signal), bool)
    bad[rows] = True
    values = np.array(signal.values)
    for start, stop in runs_of(bad) if bridge else ():
        around = np.array([start - 2, start - 1, stop, stop + 1])  # a cubic goes through two samples on either side
        if stop - start > BRIDGED or start < 2 or stop + 2 > len(signal) or bad[around].any():
            continue
        before, *_, last = time = signal.time[around] - signal.time[start]
        if last - before > 1.5 * (len(around) + stop - start) * (time[1] - before):
            continue
        inside = (signal.time[start:stop] - signal.time[start]) / last
        cubic = np.linalg.solve(np.vander(time / last, 4), signal.values[around])
        values[start:stop] = _on_steps(signal, np.vander(inside, 4) @ cubic)
        bad[start:stop] = False
    kept = np.flatnonzero(~bad)
    return replace(signal, time=signal.time[kept], values=values[kept]), kept
