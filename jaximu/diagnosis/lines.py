"""Spectral lines that move, of all rests of recordings: in words, and what they add to the means at rest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from jaximu.estimation.track import TRIADS
from jaximu.ground.array_types import FloatArray
from jaximu.ground.quantities import counted, size
from jaximu.ground.units import SENSOR_UNITS
from jaximu.mistakes.base import Sensor
from jaximu.mistakes.preparation import of_one
from jaximu.noise.lines import SpectralLine, follow, spectra, swing, windows_at_rest
from jaximu.recordings.finding import Finding
from jaximu.recordings.recording import Signal
from jaximu.recordings.segmentation import Segmentation

MOVING_LINE = "data.moving_line"
_NAMED = 3
"""Lines of an axis that are described; the others are counted."""


@dataclass(frozen=True)
class MovingLine:
    """A spectral line that moves: of which recording, by number, and of which triad; size in SI."""

    recording: int
    triad: str
    line: SpectralLine

    @property
    def axis(self) -> str:
        """The triad's axis."""
        return f"{self.triad} {'xyz'[self.line.axis]}"

    @property
    def middle(self) -> float:
        """The frequency that it is recorded at, Hz, in the median of the time in which it shows."""
        return float(np.median(self.line.recorded[self.line.visible]))

    @property
    def words(self) -> str:
        """From where to where it moves, and where it folds."""
        line = self.line
        shown = line.recorded[line.visible]
        ends = (shown.min(), shown.max()) if line.returns else shown[[0, -1]]
        decimals = max(0, int(np.ceil(-np.log10(line.resolution))))
        first, last = (f"{frequency:.{decimals}f}" for frequency in ends)
        course = f"wanders between {first} and {last} Hz" if line.returns else f"moves from {first} to {last} Hz"
        text = f"a line of {size(line.size, SENSOR_UNITS[self.triad], 2)} {course}"
        if len(zero := line.folds(0.0)):
            text += f", crosses zero frequency at t = {zero[0]:.0f} s, where it looks like bias drift and is none"
        if len(half := line.folds(0.5)):
            text += (
                f", and passes half the sample rate ({line.rate / 2:.4g} Hz) at t = {half[0]:.0f} s: on one side of it "
                "its alias is recorded"
            )
        return text


def moving_lines(segmentations: Sequence[Segmentation]) -> tuple[MovingLine, ...]:
    """Return the lines at rest that move, recording by recording, those that cross zero frequency first.

    Axes whose noise is finer than their steps are left out: rounding makes lines.
    """
    return tuple(sorted(_moving(segmentations), key=lambda one: (one.recording, not one.line.slow)))


def _moving(segmentations: Sequence[Segmentation]) -> Iterator[MovingLine]:
    for number, part in enumerate(segmentations):
        for triad in TRIADS:
            signal = part.recording.signals.get(triad)
            if signal is None:
                continue
            coarse = Sensor(triad, signal, np.arange(len(signal))).coarse
            for line in follow(*_windows(signal, part), signal.rate):
                if line.moves and coarse[line.axis] is None:
                    yield MovingLine(number, triad, line)


def _windows(signal: Signal, part: Segmentation) -> tuple[FloatArray, FloatArray]:
    """Return windows at rest (k, w, 3), SI, and their middles (k,), s."""
    first, width = windows_at_rest(signal.time, part.intervals, signal.rate)
    return signal.si()[first[:, None] + np.arange(width)], signal.time[first] + (width - 1) / 2 / signal.rate


def spectrum_at_rest(part: Segmentation, triad: str, axis: int) -> tuple[FloatArray, FloatArray]:
    """Return times (k,), s, and power (k, f) over the noise beside it, from zero to half the rate, of an axis."""
    windows, times = _windows(part.recording.signals[triad], part)
    _, power, noise = spectra(windows[:, :, axis])
    return times, np.maximum(power / noise, 1e-3)


def swings_of(
    segmentations: Sequence[Segmentation], lines: Sequence[MovingLine]
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return what lines that come close to zero frequency add to the means at rest, see `RecordedByHand.swings`."""
    poses = np.cumsum([0, *(len(part.intervals) for part in segmentations)])
    swings: dict[str, tuple[FloatArray, FloatArray]] = {}
    for one in lines:
        if not one.line.slow:
            continue
        part, axis = segmentations[one.recording], one.line.axis
        signal = part.recording.signals[one.triad]
        values, scale = signal.si()[:, axis], signal.nominal_scale[axis]
        shift, variance = swings.setdefault(one.triad, (np.zeros((poses[-1], 3)), np.zeros((poses[-1], 3))))
        for pose, (start, stop) in enumerate(np.searchsorted(signal.time, part.intervals), poses[one.recording]):
            mean, spread = swing(values[start:stop], signal.time[start:stop], one.line)
            shift[pose, axis] += scale * mean
            variance[pose, axis] += scale**2 * spread
    return swings


def line_findings(lines: Sequence[MovingLine], segmentations: Sequence[Segmentation], gain: str = "") -> list[Finding]:
    """Return a finding for each axis with lines that move, of several recordings with the file of its own.

    `gain`: what taking off those near zero frequency gained.
    """
    findings = []
    for recording, axis in dict.fromkeys((one.recording, one.axis) for one in lines):
        mine = [one for one in lines if (one.recording, one.axis) == (recording, axis)]
        texts = [one.words for one in mine[:_NAMED]]
        more = f"; and {counted(len(mine) - _NAMED, 'more line')}" if len(mine) > _NAMED else ""
        slow = any(one.line.slow for one in mine)
        text = f"{axis}: {'; '.join(texts)}{more}. {gain if slow else ''}".rstrip()
        finding, part = Finding(MOVING_LINE, (), text), segmentations[recording].recording
        findings.append(finding if len(segmentations) == 1 else of_one(finding, part, recording + 1))
    return findings


def coincident(labels: Sequence[str], frequencies: FloatArray, highest: float) -> tuple[list[int], float]:
    """Return which lines, of different units or sessions, lie closest together, and the probability of it by chance.

    By chance lines lie anywhere up to the highest frequency: the range of n of them is below r of that with the
    probability n rⁿ⁻¹ − (n − 1) rⁿ, for each of the groups that could be made of them.

    **Arguments:** `labels` (k,): their units or sessions; `frequencies` (k, q): at q times, Hz; `highest`: Hz.
    """
    groups = np.prod([1.0 + labels.count(label) for label in set(labels)]) - len(labels) - 1  # of two or more
    best: tuple[list[int], float] = [], 1.0
    order = np.argsort(frequencies.mean(axis=1)).tolist()
    for start in range(len(order)):
        for stop in range(start + 2, len(order) + 1):
            group = order[start:stop]
            if len({labels[index] for index in group}) < len(group):
                break
            share, count = min(float(np.ptp(frequencies[group], axis=0).max()) / highest, 1.0), len(group)
            p_value = groups * (count * share ** (count - 1) - (count - 1) * share**count)
            if p_value < best[1]:
                best = group, float(p_value)
    return best
