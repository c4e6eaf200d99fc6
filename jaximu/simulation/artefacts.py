"""Artefacts: what a logger does to samples that the sensor has put out (`data.*` of the catalogue). NumPy, host side.

They work on one block of samples after another and keep between blocks what they need, so that a recording of any
length can be streamed. They are applied in the order in which they happen: in the sensor, its converter, the logger.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from jaximu.ground.errors import InputError
from jaximu.recordings.recording import axis_matrix

__all__ = ["ARTEFACTS", "Artefact", "LoggedRows"]

_COLUMNS = {
    f"{prefix}_{axis}": (sensor, place)
    for prefix, sensor in (("accel", "accelerometer"), ("gyro", "gyroscope"))
    for place, axis in enumerate("xyz")
}


@dataclass
class LoggedRows:
    """A block of rows: number (n,) of each row in the whole recording, time (n,) s, values by signal (n, m)."""

    row: NDArray[np.int64]
    time: NDArray[np.float64]
    values: dict[str, NDArray[np.float64]]

    def keep(self, mask: NDArray[np.bool_]) -> None:
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


def _column(name: str, artefact: str) -> tuple[str, int]:
    if name not in _COLUMNS:
        raise InputError(f"artefact {artefact}: axis must be one of {', '.join(_COLUMNS)}, found {name!r}.")
    return _COLUMNS[name]


def _not_negative(artefact: Artefact, **values: float | None) -> None:
    for name, value in values.items():
        if value is not None and not value >= 0:
            raise InputError(f"artefact {artefact.name}: {name} must not be negative, found {value}.")


@dataclass(frozen=True)
class Periodic(Artefact):
    """A line in the spectrum of one axis: amplitude (output unit) and frequency (Hz)."""

    axis: str
    amplitude: float
    frequency: float

    name = "periodic"
    catalogue = "data.periodic"

    def __post_init__(self):
        _column(self.axis, self.name)
        _not_negative(self, frequency=self.frequency)

    def apply(self, samples, rng, kept):
        sensor, place = _column(self.axis, self.name)
        phase = rng.uniform(0, 2 * np.pi) if kept is None else kept
        samples.values[sensor][:, place] += self.amplitude * np.sin(2 * np.pi * self.frequency * samples.time + phase)
        return phase


@dataclass(frozen=True)
class Clipping(Artefact):
    """Outputs stop at ± the full range (output unit); None leaves a sensor unclipped."""

    accelerometer: float | None = None
    gyroscope: float | None = None

    name = "clipping"
    catalogue = "data.clipping"

    def __post_init__(self):
        _not_negative(self, accelerometer=self.accelerometer, gyroscope=self.gyroscope)

    def apply(self, samples, rng, kept):
        counts = kept or {"accelerometer": 0, "gyroscope": 0}
        for sensor in counts:
            limit = getattr(self, sensor)
            if limit is not None and sensor in samples.values:
                values = samples.values[sensor]
                counts = counts | {sensor: counts[sensor] + int(np.sum(np.any(np.abs(values) > limit, axis=1)))}
                np.clip(values, -limit, limit, out=values)
        return counts

    def report(self, kept):
        left = [f"the {sensor} left its range of ±{getattr(self, sensor):g} in {count} samples"
                for sensor, count in (kept or {}).items() if count]  # fmt: skip
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
        _not_negative(self, accelerometer=self.accelerometer, gyroscope=self.gyroscope, temperature=self.temperature)

    def apply(self, samples, rng, kept):
        for signal in ("accelerometer", "gyroscope", "temperature"):
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
        if self.sensor not in ("accelerometer", "gyroscope"):
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
class StuckAxis(Artefact):
    """One axis repeats from `start` to `stop` (s) the last value it had before."""

    axis: str
    start: float
    stop: float = field(default=np.inf)

    name = "stuck_axis"
    catalogue = "data.stuck_axis"

    def __post_init__(self):
        _column(self.axis, self.name)
        if not self.start < self.stop:
            raise InputError(f"artefact stuck_axis: start must be before stop, found {self.start} and {self.stop}.")

    def apply(self, samples, rng, kept):
        sensor, place = _column(self.axis, self.name)
        if sensor not in samples.values or not len(samples.time):
            return kept
        values = samples.values[sensor][:, place]
        stuck = (samples.time >= self.start) & (samples.time < self.stop)
        before = values[samples.time < self.start]
        held = before[-1] if len(before) else (values[0] if kept is None else kept)
        values[stuck] = held
        return held


@dataclass(frozen=True)
class Repeated(Artefact):
    """A `share` of the samples repeat all values of the sample before (the logger was quicker than the sensor)."""

    share: float

    name = "repeated"
    catalogue = "data.stuck_axis"

    def __post_init__(self):
        _share(self)

    def apply(self, samples, rng, kept):
        repeat = rng.random(len(samples.time)) < self.share
        first = kept is None
        if first and len(repeat):
            repeat[0] = False
        source = np.maximum.accumulate(np.where(repeat, -1, np.arange(len(repeat))))
        last = {}
        for name, value in samples.values.items():
            full = value if first else np.concatenate([kept[name], value])
            samples.values[name] = full[source + (0 if first else 1)]
            last[name] = samples.values[name][-1:].copy()
        return last


@dataclass(frozen=True)
class Dropped(Artefact):
    """A `share` of the samples are lost."""

    share: float

    name = "dropped"
    catalogue = "data.gap"

    def __post_init__(self):
        _share(self)

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
        if not self.start < self.stop:
            raise InputError(f"artefact gap: start must be before stop, found {self.start} and {self.stop}.")

    def apply(self, samples, rng, kept):
        samples.keep((samples.time < self.start) | (samples.time >= self.stop))


@dataclass(frozen=True)
class Jitter(Artefact):
    """Stamps scatter by `sigma` (s) about the instants of the samples, never by more than 0.45 intervals."""

    sigma: float

    name = "jitter"
    catalogue = "data.jitter"

    def __post_init__(self):
        _not_negative(self, sigma=self.sigma)

    def apply(self, samples, rng, kept):
        if not len(samples.time):
            return kept
        # by the row numbers: other artefacts may have taken rows away
        rows = samples.row[-1] - samples.row[0]
        interval = (samples.time[-1] - samples.time[0]) / rows if rows else (kept or self.sigma)
        scatter = self.sigma * rng.standard_normal(len(samples.time))
        samples.time = samples.time + np.clip(scatter, -0.45 * interval, 0.45 * interval)
        return interval


def _share(artefact: Repeated | Dropped) -> None:
    if not 0 <= artefact.share < 1:
        raise InputError(f"artefact {artefact.name}: share must be at least 0 and below 1, found {artefact.share}.")


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
