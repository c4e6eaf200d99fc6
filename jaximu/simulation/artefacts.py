"""Artefacts: what a logger does to samples that the sensor has put out (`data.*` of the catalogue). NumPy, host side.

They work on one block of samples after another and keep between blocks what they need, so that a recording of any
length can be streamed. They are applied in the order in which they happen: in the sensor, its converter, the logger.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from jaximu.ground.array_types import BoolArray, FloatArray, IntArray
from jaximu.ground.errors import InputError
from jaximu.ground.units import INERTIAL_QUANTITIES, PREFIXES
from jaximu.recordings.recording import axis_matrix

_SENSORS = tuple(INERTIAL_QUANTITIES)
_COLUMNS = {f"{PREFIXES[sensor]}_{axis}": (sensor, index) for sensor in _SENSORS for index, axis in enumerate("xyz")}


@dataclass
class LoggedRows:
    """A block of rows: number (n,) of each row in the whole recording, time (n,) s, values by signal (n, m)."""

    row: IntArray
    time: FloatArray
    values: dict[str, FloatArray]

    def keep(self, mask: BoolArray) -> None:
        """Drop the rows where the mask is false."""
        self.row, self.time = self.row[mask], self.time[mask]
        self.values = {name: value[mask] for name, value in self.values.items()}


@dataclass(frozen=True)
class Artefact:
    """One thing that happens to samples: `apply` changes a block in place and returns what it keeps for the next."""

    name: ClassVar[str]  # in a specification
    catalogue: ClassVar[str]  # the `data.*` name under which a pre-flight check reports it

    def apply(self, samples: LoggedRows, rng: np.random.Generator, kept: Any) -> Any:
        """Change a block; `kept` is None for the first and else what the block before returned."""
        raise NotImplementedError

    def report(self, kept: Any) -> str | None:
        """Return a sentence about what happened over the whole recording, or None."""
        return None


def _not_negative(artefact: Artefact, *names: str) -> None:
    for name in names:
        value = getattr(artefact, name)
        if value is not None and not value >= 0:
            raise InputError(f"artefact {artefact.name}: {name} must not be negative, found {value}.")


@dataclass(frozen=True)
class _OfAnAxis(Artefact):
    axis: str

    def __post_init__(self):
        if self.axis not in _COLUMNS:
            raise InputError(f"artefact {self.name}: axis must be one of {', '.join(_COLUMNS)}, found {self.axis!r}.")

    def values(self, samples: LoggedRows) -> FloatArray:
        """The axis's values (n,), a view."""
        sensor, index = _COLUMNS[self.axis]
        return samples.values[sensor][:, index]


@dataclass(frozen=True)
class _OfAShare(Artefact):
    share: float

    def __post_init__(self):
        if not 0 <= self.share < 1:
            raise InputError(f"artefact {self.name}: share must be at least 0 and below 1, found {self.share}.")


@dataclass(frozen=True)
class Periodic(_OfAnAxis):
    """A line in the spectrum of one axis: amplitude (output unit) and frequency (Hz)."""

    amplitude: float
    frequency: float

    name = "periodic"
    catalogue = "data.periodic"

    def __post_init__(self):
        super().__post_init__()
        _not_negative(self, "frequency")

    def apply(self, samples, rng, kept):
        phase = rng.uniform(0, 2 * np.pi) if kept is None else kept
        values = self.values(samples)
        values += self.amplitude * np.sin(2 * np.pi * self.frequency * samples.time + phase)
        return phase


@dataclass(frozen=True)
class Clipping(Artefact):
    """Outputs stop at ± the full range (output unit); None leaves a sensor unclipped."""

    accelerometer: float | None = None
    gyroscope: float | None = None

    name = "clipping"
    catalogue = "data.clipping"

    def __post_init__(self):
        _not_negative(self, *_SENSORS)

    def apply(self, samples, rng, kept):
        counts = Counter(kept)
        for sensor in _SENSORS:
            limit = getattr(self, sensor)
            if limit is not None and sensor in samples.values:
                values = samples.values[sensor]
                counts[sensor] += int(np.sum((np.abs(values) > limit).any(axis=1)))
                np.clip(values, -limit, limit, out=values)
        return counts

    def report(self, kept):
        left = [
            f"the {sensor} left its range of ±{getattr(self, sensor):g} in {count} samples"
            for sensor, count in (kept or {}).items()
            if count
        ]
        return "; ".join(left) + " and was clipped." if left else None


@dataclass(frozen=True)
class QuantisedOutput(Artefact):
    """Outputs are whole multiples of a step (output unit; °C); None leaves a signal as it is."""

    accelerometer: float | None = None
    gyroscope: float | None = None
    temperature: float | None = None

    name = "quantisation"
    catalogue = "data.quantisation"

    def __post_init__(self):
        _not_negative(self, *_SENSORS, "temperature")

    def apply(self, samples, rng, kept):
        for signal in (*_SENSORS, "temperature"):
            step = getattr(self, signal)
            if step and signal in samples.values:
                samples.values[signal] = np.round(samples.values[signal] / step) * step


@dataclass(frozen=True)
class SwappedAxes(Artefact):
    """A sensor's axes exchanged or turned over: `axes` says which true axis each column holds, such as "y,x,z"."""

    sensor: str
    axes: str

    name = "swapped_axes"
    catalogue = "data.swapped_axes"

    def __post_init__(self):
        if self.sensor not in _SENSORS:
            raise InputError(
                f"artefact swapped_axes: sensor must be accelerometer or gyroscope, found {self.sensor!r}."
            )
        try:
            axis_matrix(self.axes)
        except InputError as error:
            raise InputError(f"artefact swapped_axes: axes {self.axes!r}: write signed axes such as y,-x,z.") from error

    def apply(self, samples, rng, kept):
        if self.sensor in samples.values:
            samples.values[self.sensor] = samples.values[self.sensor] @ axis_matrix(self.axes).T


@dataclass(frozen=True)
class StuckAxis(_OfAnAxis):
    """One axis repeats from `start` to `stop` (s) the last value it had before."""

    start: float
    stop: float = np.inf

    name = "stuck_axis"
    catalogue = "data.stuck_axis"

    def __post_init__(self):
        super().__post_init__()
        _in_order(self)

    def apply(self, samples, rng, kept):
        if _COLUMNS[self.axis][0] not in samples.values or not len(samples.time):
            return kept
        values = self.values(samples)
        stuck = (samples.time >= self.start) & (samples.time < self.stop)
        before = values[samples.time < self.start]
        held = before[-1] if len(before) else (values[0] if kept is None else kept)
        values[stuck] = held
        return held


@dataclass(frozen=True)
class Repeated(_OfAShare):
    """A `share` of the samples repeat all values of the sample before (the logger was quicker than the sensor)."""

    name = "repeated"
    catalogue = "data.stuck_axis"

    def apply(self, samples, rng, kept):
        repeat = rng.random(len(samples.time)) < self.share
        if kept is None:
            repeat[:1] = False
            kept = {name: value[:1] for name, value in samples.values.items()}
        source = np.maximum.accumulate(np.where(repeat, 0, 1 + np.arange(len(repeat))))
        for name, value in samples.values.items():
            samples.values[name] = np.concatenate([kept[name], value])[source]
        return {name: value[-1:].copy() for name, value in samples.values.items()}


@dataclass(frozen=True)
class Dropped(_OfAShare):
    """A `share` of the samples are lost."""

    name = "dropped"
    catalogue = "data.gap"

    def apply(self, samples, rng, kept):
        samples.keep(rng.random(len(samples.time)) >= self.share)


@dataclass(frozen=True)
class Gap(Artefact):
    """Nothing was logged from `start` to `stop` (s)."""

    start: float
    stop: float

    name = "gap"
    catalogue = "data.gap"

    def __post_init__(self):
        _in_order(self)

    def apply(self, samples, rng, kept):
        samples.keep((samples.time < self.start) | (samples.time >= self.stop))


@dataclass(frozen=True)
class Jitter(Artefact):
    """Stamps scatter by `sigma` (s) about the instants of the samples, never by more than 0.45 intervals."""

    sigma: float

    name = "jitter"
    catalogue = "data.jitter"

    def __post_init__(self):
        _not_negative(self, "sigma")

    def apply(self, samples, rng, kept):
        if not len(samples.time):
            return kept
        # by the row numbers: other artefacts may have taken rows away
        rows = samples.row[-1] - samples.row[0]
        interval = np.ptp(samples.time) / rows if rows else (kept or self.sigma)
        scatter = self.sigma * rng.standard_normal(len(samples.time))
        samples.time = samples.time + np.clip(scatter, -0.45 * interval, 0.45 * interval)
        return interval


def _in_order(artefact: StuckAxis | Gap) -> None:
    if not artefact.start < artefact.stop:
        raise InputError(
            f"artefact {artefact.name}: start must be before stop, found {artefact.start} and {artefact.stop}."
        )


ARTEFACTS: dict[str, type[Artefact]] = {
    artefact.name: artefact
    for artefact in (
        Periodic,
        Clipping,
        QuantisedOutput,
        SwappedAxes,
        StuckAxis,
        Repeated,
        Dropped,
        Gap,
        Jitter,
    )
}
"""Every artefact by its name in a specification, in the order in which they are applied."""
