"""The noise of a recording at rest: every axis's deviation and terms, as a person or another program reads them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import deviation_interval
from jaximu.ground.document import SOFTWARE, Json, entries, read_document
from jaximu.ground.equality import Comparable
from jaximu.ground.errors import FilePath, InputError, NotPossibleError
from jaximu.ground.page import Result
from jaximu.ground.quantities import listed, size
from jaximu.ground.units import SENSOR_QUANTITIES
from jaximu.ground.vectors import column_lengths
from jaximu.mistakes import Prepared, prepared
from jaximu.model.data_sheet import SI_UNITS
from jaximu.noise.cleaning import PeriodicLine, fillable, without_outliers
from jaximu.noise.identification import Identified, identify
from jaximu.recordings.recording import Recording, Signal, recordings_of
from jaximu.recordings.stamps import stretches_of_one_rate

SCHEMA = "jaximu.allan/1"
_UNEVEN = 0.25
"""Share of a sample interval that stamps may be off the even grid before they count as uneven."""
_MOVING = 30.0
"""Variance of a second over the median second's above which the unit is taken to have moved."""
_STEP = {"accelerometer": 0.1, "gyroscope": 0.01, "magnetometer": 1.0}
"""Difference (m/s², rad/s, µT) of the means of neighbouring seconds that no drift makes."""


def read_analysis(path: FilePath) -> Json:
    """Read an `allan.json`. Raises `InputError` for any other file."""
    return read_document(path, SCHEMA, "an allan.json of `jaximu allan LOG -o DIR`: a noise file must state its units")


@dataclass(frozen=True, repr=False, eq=False)
class NoiseAnalysis(Result, Comparable, page="allan"):
    """Identified noise by triad (three axes each), its sample rate, and the spread of the bias over several logs.

    repeatability: by triad, standard deviation of the recordings' means with its 95 % interval, (3, 3) value, low, high
    by axis, SI; empty for one recording. unusable: sensors that were recorded, but whose noise a finding hides.
    """

    axes: dict[str, list[Identified]]
    rates: dict[str, float]
    files: tuple[str, ...] = ()
    repeatability: dict[str, FloatArray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    unusable: frozenset[str] = frozenset()

    @property
    def lines(self) -> dict[str, list[tuple[PeriodicLine, ...]]]:
        """The periodic lines found, by triad and axis: frequency (Hz) and amplitude (SI)."""
        return {name: [axis.lines for axis in axes] for name, axes in self.axes.items()}

    def document(self) -> Json:
        """Return the analysis as the JSON document of schema `jaximu.allan/1`: SI, continuous, two-sided, 95 %."""

        def document(axis: Identified, units: Mapping[str, str]) -> Json:
            return {
                "terms": {name: term and term.document(units[name]) for name, term in axis.terms.items()},
                "limits": {name: {"value": size, "unit": units[name]} for name, size in axis.limits.items()},
                "taus": axis.deviation.tau.tolist(),
                "deviation": axis.deviation.value.tolist(),
                "deviation_low": axis.deviation.low.tolist(),
                "deviation_high": axis.deviation.high.tolist(),
            } | ({} if axis.high_pass is None else {"high_pass": axis.high_pass.document("s")})

        return {
            "schema": SCHEMA,
            **{
                name: [document(axis, SI_UNITS[quantity]) for axis in self.axes[name]] if name in self.axes else None
                for name, quantity in SENSOR_QUANTITIES.items()
            },
            "rate": self.rates,
            "repeatability": {
                name: dict(zip(("value", "low", "high"), table.T.tolist(), strict=True))
                | {"unit": SI_UNITS[SENSOR_QUANTITIES[name]]["B"]}
                for name, table in self.repeatability.items()
            }
            or None,
            **entries(self, "files", "notes"),
            "software": SOFTWARE,
        }


def analyse_noise(recordings: Recording | Sequence[Recording]) -> NoiseAnalysis:
    """Identify the noise of a unit at rest; several recordings are power-ons of the same unit.

    The terms are those of the longest recording; the spread of all recordings' means is the bias's repeatability.
    What is wrong with the samples is found as for a calibration, and said. Raises `NotPossibleError` for a recording
    that is too short or moves, `InputError` for uneven stamps and for a sensor that holds no measurement; a gyroscope
    that holds none is left out beside an accelerometer, with a note.
    """
    if not (recordings := recordings_of(recordings)):
        raise InputError("no recording was given.")
    alone = not any(len(recording.accelerometer) for recording in recordings)
    with prepared(recordings, gyroscope=alone, gravity=False) as ready:
        return _of_ready(ready)


_OF_ITS_OWN = {"data.periodic", "data.gap", "data.quantisation"}
"""Findings that the analysis makes itself, with numbers: lines, missing samples, quantisation."""
_SLOW = 200
"""Means over the recording in which what is slow shows."""
_WARMED, _FOLLOWS = 1.0, 0.8
"""K by which the temperature must change, and the share that must follow it, to be said."""
_BELOW = 0.1
"""Times a filter's corner up to which it leaves the spectrum as it was: one per cent of the power of one pole."""


def _of_ready(ready: Sequence[Prepared]) -> NoiseAnalysis:
    findings = [finding for one in ready for finding in one.findings]
    notes = list(dict.fromkeys(finding.text for finding in findings if finding.name not in _OF_ITS_OWN))
    unusable = {finding.refuses for finding in findings if finding.refuses}
    recordings = [one.recording for one in ready]
    chosen = max(ready, key=lambda one: max(len(signal) for signal in one.recording.signals.values()))
    longest = chosen.recording
    axes = {}
    rates = {}
    corners = [finding.numbers for finding in chosen.findings if finding.name == "data.bandwidth"]
    for name in SENSOR_QUANTITIES:
        if not getattr(longest, name) or name in unusable:
            continue
        corner = min((corner[name] for corner in corners if name in corner), default=None)
        try:
            triad, rates[name], its_notes = _analysed(recordings, longest, name, corner and _BELOW * corner)
        except (InputError, NotPossibleError) as error:
            if name != "magnetometer":  # which may lie in a field that changes, or be logged in another way
                raise
            notes.append(f"{error} The magnetometer was left out.")
            continue
        axes[name] = triad
        notes += [*its_notes, *_by_temperature(longest, name), *_taken_out(name, triad)]
        open_axes = {
            axis: [letter for letter, term in it.terms.items() if term is not None and term.low == 0]
            for axis, it in zip("xyz", triad, strict=True)
        }
        if doubtful := [f"{axis} ({', '.join(letters)})" for axis, letters in open_axes.items() if letters]:
            notes.append(
                f"{name} {', '.join(doubtful)}: other terms describe what is slow there about as well, so that its "
                "interval begins at zero. Record longer to know which it is."
            )
        strange = [f"{axis} ({100 * it.excess:.0f} %)" for axis, it in zip("xyz", triad, strict=True) if it.excess]
        if strange:
            notes.append(
                f"{name} {', '.join(strange)}: no combination of the five terms describes the deviation, by this "
                "share of its variance: a correlated process or a drift beside them. The intervals are widened for "
                "it; look at the picture."
            )
    repeatability = {}
    if len(recordings) > 1:
        if len(recordings) < len({recording.name for recording in recordings}):
            raise InputError("a recording was given twice.")
        for name in axes:
            signals = [getattr(recording, name) for recording in recordings]
            means = np.array([signal.si().mean(axis=0) for signal in signals if signal])
            if len(means) > 1:
                times = np.append(1.0, deviation_interval(len(means) - 1))
                repeatability[name] = np.outer(means.std(axis=0, ddof=1), times)
        notes.append(
            f"noise is that of {longest.name}, the longest recording; all {len(recordings)} together show the "
            "repeatability of the bias. The unit must have lain alike in all, or gravity enters its spread."
        )
    files = tuple(source.path for recording in recordings for source in recording.sources)
    return NoiseAnalysis(axes, rates, files, repeatability, tuple(notes), frozenset(unusable - {"gravity"}))


def _by_temperature(recording: Recording, name: str) -> list[str]:
    """Say how much of what is slow in a sensor's output a straight line of the logged temperature accounts for."""
    signal = getattr(recording, name)
    celsius = recording.temperature
    edges = np.linspace(0, len(signal), _SLOW + 1).astype(int)
    if celsius is None or len(signal) < 2 * _SLOW:
        return []
    values = np.column_stack([signal.si(), np.interp(signal.time, celsius.time, celsius.values[:, 0])])
    *means, warmth = (np.add.reduceat(values, edges[:-1], axis=0) / np.diff(edges)[:, None]).T
    if np.ptp(warmth) < _WARMED:
        return []
    share = [float(np.corrcoef(warmth, axis)[0, 1] ** 2) for axis in means]
    if max(share) < _FOLLOWS:
        return []
    shares = ", ".join(f"{axis} {100 * part:.0f} %" for axis, part in zip("xyz", share, strict=True))
    return [
        f"the temperature changed by {np.ptp(warmth):.3g} K meanwhile, and what is slow in the {name} follows it "
        f"(share of its variance by a straight line: {shares}): it is no noise of the sensor alone. `jaximu thermal` "
        "models it."
    ]


def _analysed(
    recordings: Sequence[Recording], longest: Recording, name: str, highest: float | None
) -> tuple[list[Identified], float, list[str]]:
    """Return the noise of a triad's axes in the longest recording, up to a frequency (Hz), its rate (Hz), and notes."""
    what = f"{longest.name}: the {name}"
    notes = []
    values, rate, start, paused = evenly_sampled(getattr(longest, name), what)
    for recording in recordings:
        if getattr(recording, name) is not None:
            at_rest(recording, name)
    if paused:
        notes.append(
            f"{what} has pauses longer than what lies before them: its noise is that of the longest part between them, "
            f"{values.shape[1] / rate:.0f} s that begin {start:.0f} s in."
        )
    if (lost := np.isnan(values[0])).any():
        notes.append(
            f"{longest.name}: {lost.sum()} samples of the {name} are missing; they are filled in by what lies "
            "before them, mirrored, and no difference of the deviation reaches over more than five in a row."
        )
    try:
        axes = identify(values, rate, highest=highest)
    except NotPossibleError as error:
        raise NotPossibleError(f"{what}: {error}") from error
    assert isinstance(axes, list)
    axes = [replace(it, steps=tuple(replace(step, time=start + step.time) for step in it.steps)) for it in axes]
    if highest is not None:
        notes.append(
            f"{name}: its terms are those of the spectrum below {highest:.2g} Hz, where the filter does nothing."
        )
    return axes, rate, notes


class EvenSamples(NamedTuple):
    """Samples (3, n) in SI on an even grid, NaN where one is missing, the rate (Hz), and when they begin (s after the
    first stamp). paused: a pause longer than what lies before it left out what is on its other side.
    """

    values: FloatArray
    rate: float
    start: float
    paused: bool


def evenly_sampled(signal: Signal, what: str = "the signal") -> EvenSamples:
    """Return the samples of the longest part of a signal that has one rate and no pause longer than what lies before.

    Raises `InputError` where the stamps do not lie near a grid.
    """
    if len(signal) < 3:
        raise NotPossibleError(f"{what} has only {len(signal)} samples.")
    stretch = max(stretches_of_one_rate(signal.time), key=lambda part: part.stop - part.start)
    time = signal.time[stretch]
    interval = np.diff(time)
    steps = np.maximum(1, (interval / np.median(interval)).round()).astype(np.int64)
    index = np.cumulative_sum(steps, include_initial=True)
    part = fillable(index)
    time, index = time[part], index[part] - index[part.start]
    slope, start = np.polyfit(index, time, 1)
    off = abs(time - start - slope * index) / slope
    if (off > _UNEVEN).mean() > 0.01:
        raise InputError(
            f"{what} is sampled unevenly: {100 * (off > _UNEVEN).mean():.0f} % of its stamps are more than a quarter "
            "of an interval off an even grid. If the rate is steady and only the stamps are not, ignore their column "
            "(_ in --columns) and give --rate."
        )
    values = np.full((signal.values.shape[1], index[-1] + 1), np.nan)
    values[:, index] = signal.si()[stretch][part].T
    paused = len(time) < len(interval) + 1
    return EvenSamples(values, float(1 / slope), float(time[0] - signal.time[0]), paused)


def _taken_out(name: str, axes: Sequence[Identified]) -> list[str]:
    unit = SI_UNITS[SENSOR_QUANTITIES[name]]["B"]
    notes = []
    spikes = [f"{axis} ({it.outliers})" for axis, it in zip("xyz", axes, strict=True) if it.outliers]
    if spikes:
        notes.append(f"{name} {', '.join(spikes)}: samples far off their neighbours are outliers and were replaced.")
    for axis, it in zip("xyz", axes, strict=True):
        if it.lines:
            lines = ", ".join(f"{line.frequency:.4g} Hz ({size(line.amplitude, unit, 2)})" for line in it.lines)
            notes.append(
                f"{name} {axis}: periodic at {lines}, frequency after aliasing and amplitude; taken out. It is "
                "vibration, the mains or a clock, and no noise of the sensor."
            )
        if it.steps:
            steps = listed([f"{size(step.size, unit, 2)} after {step.time:.4g} s" for step in it.steps])
            notes.append(
                f"{name} {axis}: its level steps by {steps}, and stays there: taken out, for a step is no random walk. "
                "A knock, a switch of supply or range, or a unit that was put down may be behind it."
            )
        if it.high_pass is not None:
            time = it.high_pass
            notes.append(
                f"{name} {axis}: what is slow was taken out before it was logged, as by a high pass of "
                f"{time.value:.2g} s ({time.low:.2g} to {time.high:.2g}): a driver that subtracts a running mean of "
                "the bias, or zeroes it. A bias that is drawn back to its mean by itself looks alike. The terms are "
                "those before it; the bias that is left wanders no further with time."
            )
        if it.warm_up is not None:
            notes.append(
                f"{name} {axis}: a warm-up of {size(it.warm_up.amplitude, unit, 2)} that decays in "
                f"{it.warm_up.time_constant:.3g} s was taken out; let the unit run that long before it is used."
            )
    return notes


def at_rest(recording: Recording, triad: str) -> tuple[FloatArray, float]:
    """Return `evenly_sampled` values, outliers missing too, and the rate; `NotPossibleError` unless it rested."""
    what = f"{recording.name}: the {triad}"
    values, rate, *_ = evenly_sampled(getattr(recording, triad), what)
    values = np.stack([without_outliers(axis)[0] for axis in values])
    _require_rest(values, rate, _STEP[triad], what)
    return values, rate


def _require_rest(values: FloatArray, rate: float, step: float, what: str) -> None:
    """Raise unless the unit rested.

    No seconds scatter far more than the rest, and means of neighbouring seconds differ by no more than their scatter
    lets expect, or than `step`, which a unit at rest stays below for all its drift.
    """
    length = max(8, round(rate))
    seconds = values[:, : values.shape[1] // length * length].reshape(len(values), -1, length)
    if seconds.shape[1] < 8:
        return
    whole = seconds[:, ~np.isnan(seconds[0]).any(axis=1)]
    scatter = whole.var(axis=2).sum(axis=0)
    if not (scatter > 0).any():
        return
    usual = float(np.median(scatter[scatter > 0]))
    moving = scatter > _MOVING * usual
    why = f"{moving.sum()} of {len(moving)} seconds scatter more than {_MOVING:g} times the median one"
    limit = 0.002
    if moving.mean() <= limit:
        steps = column_lengths(np.diff(whole.mean(axis=2), axis=1))
        moving = steps > max(6 * np.sqrt(2 * usual / length), step)
        why = f"the means of {moving.sum()} of {len(moving)} pairs of seconds differ by far more than their scatter"
        limit = 0.01
    if moving.mean() > limit:
        raise NotPossibleError(
            f"{what} did not rest: {why}, the first about {moving.argmax() * length / rate:.0f} s in. Record the "
            "unit at rest, on something heavy, for an hour or more, and cut off the ends."
        )
