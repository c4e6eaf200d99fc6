"""Known poses and turns with the recording that was made there: the samples along which effects act.

In a station the unit goes through what the set-up says, in between through what it measured itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np

from jaximu.data.observe_stations import observe_stations
from jaximu.data.poses import EXCESS_NAMES
from jaximu.data.stations import KnownStations, StationConditions, station_covariances, station_rms, station_rows
from jaximu.data.twin_signal import twin_signal
from jaximu.estimation.data import About, Observed, OfOneUnit, OutputMeans
from jaximu.estimation.problem import Name
from jaximu.estimation.rows import Rows, Sizes
from jaximu.estimation.track import TRIADS, Track, added, mean_outputs, stimuli
from jaximu.ground.array_types import Array, BoolArray, FloatArray, IntArray
from jaximu.ground.differences import interpolated, midpoints
from jaximu.ground.gravity import STANDARD, Gravity, as_gravity
from jaximu.ground.tracing import first, lifted, on_host
from jaximu.ground.vectors import variances_of
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.recordings.entry import ScheduleEntry
from jaximu.recordings.observations import Stations
from jaximu.recordings.recording import Recording
from jaximu.recordings.reference import entries_of_columns


@dataclass(frozen=True)
class AtStations:
    """Stations with what the effects add taken off their means, and what the unit went through, sample by sample."""

    path: dict[str, Track]
    stations: Stations

    @property
    def tracks(self) -> list[dict[str, Track]]:
        """What the unit went through, part by part."""
        return [self.path]


@dataclass
class RecordedStations(OfOneUnit):
    """A recording of one unit whose set-up says what the unit went through; `entries`: what it says, where known."""

    recording: Recording
    stations: Stations
    entries: Sequence[ScheduleEntry] = ()

    excess_names = EXCESS_NAMES
    coarse = KnownStations.coarse

    def __post_init__(self):
        self.stations = on_host(self.stations)

    @classmethod
    def of(
        cls,
        recording: Recording,
        references: Sequence[ScheduleEntry] | None = None,
        gravity: Gravity = STANDARD,
        noise: NoiseModel | None = None,
    ) -> RecordedStations:
        """Return a recording at known poses and turns; `references`: what the set-up says, or its columns, if None.

        Raises what `jaximu.data.observe_stations.observe_stations` raises.
        """
        entries = entries_of_columns(recording) if references is None else references
        return cls(recording, observe_stations(recording, entries, as_gravity(gravity).value, noise)[0], entries)

    def free(self, name: Name) -> bool:
        """Return whether a number is free: all are, for the body frame is the fixture's."""
        return True

    def rows(self, imu: Imu) -> Rows:
        """Return what each condition is."""
        return station_rows(imu, self.stations)

    def about_one(self, imu: Imu) -> About:
        """Return the errors of the mean outputs of the unit, and its effects' columns."""
        path, stations = _path(self.recording, self.stations, imu), self.stations
        if imu.all_effects():
            stations = self._without_outputs(self._means(path, added(imu, path)))
        details = AtStations(path, stations)
        columns = self.own_columns(imu, details, 6 * len(stations.turn))
        return About(StationConditions(stations), first(station_covariances(lifted(stations))), columns, details)

    def reactions(self, details: AtStations):
        """Return how the mean outputs react to effects."""
        count = len(self.stations.turn)

        def of(effect, imu, tracks):
            return mean_outputs(tracks, added(imu.with_effects(effect), tracks), count).ravel()

        return f"stations {count}", of, details.tracks

    @property
    def gravity(self) -> Array:
        """Local gravity, m/s²."""
        return self.stations.gravity

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """What was recorded."""
        return (self.recording,)

    def spans(self) -> list[FloatArray]:
        """Return start and stop (k, 2), s, of the stations that are used."""
        return [_spans(self.stations, _used(self.stations))]

    def rests(self) -> list[FloatArray]:
        """Return the spans of the poses alone."""
        return [_spans(self.stations, _used(self.stations) & ~self.stations.turn)]

    @property
    def sampled(self) -> bool:
        """Whether the noise of samples makes the covariance: the entries say what the samples are compared with."""
        return len(self.entries) > 0

    def counts(self) -> dict[str, int]:
        """Return the numbers of poses and turns that are used."""
        turn, used = np.asarray(self.stations.turn), _used(self.stations)
        return {"poses": int((used & ~turn).sum()), "turns": int((used & turn).sum())}

    def rate_at_rest(self) -> FloatArray | None:
        """Return the gyroscope's mean output (3,) over the poses in which it is used, where there are some."""
        at_rest = np.asarray(self.stations.gyroscope_used) & ~np.asarray(self.stations.turn)
        return np.asarray(self.stations.gyroscope_mean)[at_rest].mean(axis=0) if at_rest.any() else None

    def output_means(self, details: AtStations) -> OutputMeans:
        """Return the mean outputs in the stations."""
        return station_means(self.stations, (self.recording,))

    def with_noise(self, noise: NoiseModel) -> RecordedStations:
        """Return the stations with the covariance that a noise of the samples makes."""
        if not self.sampled:
            return self
        stations, _ = observe_stations(self.recording, self.entries, float(self.gravity), noise)
        return replace(self, stations=stations)

    def observed(self, imu: Imu, details: AtStations) -> Observed:
        """Return the stations, padding included; orientation is compared in poses."""
        stations, turn = self.stations, self.stations.turn
        used = {"accelerometer": stations.accelerometer_used, "gyroscope": stations.gyroscope_used}
        middle, real = (stations.start + stations.stop) / 2, _used(stations)
        force = np.asarray(stations.stimulus.specific_force).mean(axis=1)
        return Observed(
            lambda triad, shape: output_reaction(triad, shape, used[triad]),
            (middle - middle[real].min()) / max(np.ptp(middle[real]), 1e-9),
            up=force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-9),
            still=~turn,
            number=np.arange(len(turn)),
            alone=np.flatnonzero(used["accelerometer"] & ~turn),
        )

    def without(self, observation: int) -> RecordedStations:
        """Return the recording with a station left out."""
        stations, kept = self.stations, np.arange(len(self.stations.turn)) != observation
        used = {name: getattr(stations, name) & kept for name in ("accelerometer_used", "gyroscope_used")}
        return replace(self, stations=replace(stations, **used))

    def rms(self, imu: Imu, details: AtStations, conditions: FloatArray) -> Sizes:
        """Return the rms of each kind of residual, with its unit, as a calibration has it."""
        return station_rms(imu, details.stations)

    def twin(
        self, imu: Imu, details: AtStations, conditions: FloatArray, noise: NoiseModel, seed: int
    ) -> RecordedStations:
        """Return the recording of a unit without effects, along the set-up's motion, noise included."""
        changed, drawn, path = {}, {}, details.path
        for number, (name, triad) in enumerate(imu.triads().items()):
            signal = self.recording.signals[name]
            true = np.asarray(getattr(path[name].stimulus, triad.quantity))[: len(signal)]
            changed[name] = twin_signal(signal, triad, true, getattr(noise, name), [seed, number])
            drawn[name] = changed[name].values - true @ np.asarray(triad.gain).T - np.asarray(triad.bias)
        stations = self._without_outputs(conditions - self._means(path, drawn))
        return RecordedStations(replace(self.recording, **changed, notes=()), stations)

    def _without_outputs(self, outputs: FloatArray) -> Stations:
        """Return the stations with mean outputs (6 S,) taken off."""
        force, rate = np.split(outputs.reshape(-1, 6), 2, axis=1)
        return replace(
            self.stations,
            accelerometer_mean=self.stations.accelerometer_mean - force,
            gyroscope_mean=self.stations.gyroscope_mean - rate,
        )

    def _means(self, path: dict[str, Track], outputs: Mapping[str, Array | FloatArray]) -> FloatArray:
        """Return the mean outputs (6 S,) over the stations, accelerometer and gyroscope of one after another."""
        return np.asarray(mean_outputs(path, outputs, len(self.stations.turn)), np.float64).ravel()


def output_reaction(triad: str, shape: FloatArray, used: BoolArray) -> FloatArray:
    """Return the reaction (6 o, 3 k) of mean outputs, accelerometer and gyroscope of one observation after another.

    **Arguments:** `shape`: (o, k) of each axis alike; `used` (o,): observations in which the triad counts.
    """
    columns = np.zeros((len(shape), 6, shape.shape[1], 3))
    for axis in range(3):
        columns[used, 3 * TRIADS.index(triad) + axis, :, axis] = shape[used]
    return columns.reshape(6 * len(shape), -1)


def station_means(stations: Stations, recordings: Sequence[Recording]) -> OutputMeans:
    """Return the mean outputs in the stations that are used, of which the conditions are; `recordings`: theirs."""
    kept = np.flatnonzero(_used(stations))
    unit, used, variances = np.eye(len(stations.turn))[:, kept], {}, {}
    scales = {name: signal.nominal_scale for name, signal in recordings[0].signals.items() if name in TRIADS}
    for name in scales:
        used[name] = np.asarray(getattr(stations, f"{name}_used"))
        measured = variances_of(getattr(stations, f"{name}_covariance")).T
        variances[name] = np.where(used[name][kept, None], measured[kept], np.nan)
    reactions = {name: output_reaction(name, unit, used[name]).reshape(-1, len(kept), 3) for name in scales}
    start, stop, which = (np.asarray(part)[kept] for part in (stations.start, stations.stop, stations.recording))
    return OutputMeans.of(start, stop, which, reactions, scales, variances)


def _used(stations: Stations) -> BoolArray:
    return stations.accelerometer_used | stations.gyroscope_used


def _spans(stations: Stations, chosen: BoolArray) -> FloatArray:
    return np.column_stack([stations.start[chosen], stations.stop[chosen]])


def _in_order(stations: Stations) -> IntArray:
    """Return the places of the stations that are used, in the order of time."""
    real = np.flatnonzero(_used(stations))
    return real[stations.start[real].argsort()]


def station_of(time: FloatArray, stations: Stations) -> IntArray:
    """Return the station (n,) that each stamp lies in, S where in none."""
    order = _in_order(stations)
    start, stop = stations.start[order], stations.stop[order]
    latest = np.maximum(start.searchsorted(time, side="right") - 1, 0)
    return np.where((time >= start[latest]) & (time < stop[latest]), order[latest], len(stations.turn))


def _path(recording: Recording, stations: Stations, imu: Imu) -> dict[str, Track]:
    """Return the stimulus at every sample: in a station as the set-up says, in between as `imu` measured it."""
    count, order = len(stations.turn), _in_order(stations)
    nodes = jax.tree.map(lambda leaf: leaf[order].reshape(-1, *np.shape(leaf)[2:]), stations.stimulus)
    tracks = {}
    for name, known in stimuli(recording, imu).items():
        signal = recording.signals[name]
        station = station_of(signal.time, stations)
        inside = station < count
        nearest = midpoints(nodes.time).searchsorted(signal.time).clip(0, len(nodes.time) - 1)
        motion = {field: np.array(getattr(known, field)) for field in ("specific_force", "angular_rate")}
        for field, values in motion.items():
            values[inside] = interpolated(nodes.time, getattr(nodes, field), signal.time[inside])
        pose = inside & ~stations.turn[np.minimum(station, count - 1)]
        motion["specific_force"][pose] = np.asarray(stations.stimulus.specific_force)[station[pose], 0]
        motion["angular_rate"][pose] = 0.0
        acceleration = np.gradient(motion["angular_rate"], signal.time, axis=0)
        acceleration[pose] = 0.0
        attitude = None if nodes.attitude is None else nodes.attitude[nearest]
        stimulus = replace(known, **motion, angular_acceleration=acceleration, attitude=attitude)
        tracks[name] = Track.padded(stimulus, station, count)
    return tracks
