"""Known poses and turns as the linear problem that a diagnosis asks questions of: set-up errors are candidates too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax
import numpy as np
from numpy.typing import NDArray

from jaximu.calibration.turntable import calibrate_table_ready, station_rms
from jaximu.data.drift import with_usual_drift
from jaximu.data.observe_stations import observe_stations
from jaximu.data.poses import EXCESS_NAMES
from jaximu.data.stations import KnownStations, StationConditions, station_covariances, station_rows
from jaximu.data.track import Track, added, mean_outputs, stimuli
from jaximu.diagnosis.diagnosis import Diagnosis, Examination, examine, same_device, without_effects
from jaximu.diagnosis.evidence import EffectBlock
from jaximu.diagnosis.experiment import Experiment, State
from jaximu.diagnosis.noise import own_noise
from jaximu.diagnosis.shapes import Shapes, placed
from jaximu.diagnosis.twin import drawn_noise
from jaximu.estimation.data import About
from jaximu.estimation.fitting import Linear
from jaximu.estimation.problem import Name
from jaximu.estimation.rows import Rows
from jaximu.estimation.uncertainty import station_advice
from jaximu.ground.array_types import Array, FloatArray
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.gravity import STANDARD, Gravity, LocalGravity, as_gravity
from jaximu.mistakes import Prepared, prepare, prepared
from jaximu.model.effects import Effect
from jaximu.model.effects.base import Extent
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.noise.at_rest import noise_of
from jaximu.recordings.observations import Stations
from jaximu.recordings.recording import Recording
from jaximu.recordings.reference import Entry, entries_of_columns
from jaximu.recordings.segmentation import Segmentation

__all__ = ["AtStations", "Turntable", "diagnose_turntable"]


@dataclass(frozen=True)
class AtStations:
    """Stations with what the effects add taken off their means, and what the unit went through, sample by sample."""

    tracks: dict[str, Track]
    stations: Stations


@dataclass
class Turntable(Experiment):
    """A recording whose set-up says what the unit went through, its noise known."""

    recording: Recording
    stations: Stations
    start: Imu  # a calibration without effects

    excess_names = EXCESS_NAMES
    coarse = KnownStations.coarse
    advice = staticmethod(station_advice)

    def free(self, name: Name) -> bool:
        """Return whether a number is free: all are, for the body frame is the fixture's."""
        return True

    def rows(self, imu: Imu) -> Rows:
        """Return what each condition is."""
        return station_rows(imu, self.stations)

    def about(self, imu: Imu) -> About:
        """Return the errors of the mean outputs of one unit, the leading axis, and its effects' columns."""
        unit = jax.tree.map(lambda leaf: leaf[0], imu)
        tracks, stations = station_tracks(self.recording, self.stations, unit), self.stations
        if unit.all_effects():
            stations = self._without(self._means(tracks, added(unit, tracks)))
        details = AtStations(tracks, stations)
        lifted = jax.tree.map(lambda leaf: np.asarray(leaf)[None], stations)
        columns = self.own_columns(unit, details, 6 * len(stations.turn))
        return About(StationConditions(lifted), station_covariances(lifted), columns[None], details)

    def reactions(self, details: AtStations):
        """Return how the mean outputs react to effects."""
        count = len(self.stations.turn)

        def of(effect, imu, tracks):
            return mean_outputs(tracks, added(imu.with_effects(effect), tracks), count).reshape(-1)

        return f"stations {count}", of, [details.tracks]

    def generic(self, imu: Imu, linear: Linear) -> list[EffectBlock]:
        """Return shapes without a cause, and poses that were bumped."""
        stations, turn = self.stations, np.asarray(self.stations.turn)
        used = {"accelerometer": np.asarray(stations.accelerometer_used),
                "gyroscope": np.asarray(stations.gyroscope_used)}  # fmt: skip
        middle = (np.asarray(stations.start) + np.asarray(stations.stop)) / 2
        share = (middle - middle[self._real].min()) / max(np.ptp(middle[self._real]), 1e-9)
        force = np.asarray(stations.stimulus.specific_force).mean(axis=1)
        up = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-9)
        shapes = Shapes(lambda triad, shape: placed(triad, shape, used[triad]))
        return (
            shapes.slow_changes(share)
            + shapes.orientations(up, ~turn)
            + shapes.bumped(np.flatnonzero(used["accelerometer"] & ~turn), np.arange(len(turn)))
        )

    def extent(self) -> Extent:
        """Return what the recording spans."""
        real = self._real
        start, stop = np.asarray(self.stations.start)[real], np.asarray(self.stations.stop)[real]
        kelvin = self.recording.temperature
        return Extent(
            float(stop.max() - start.min()),
            tuple(float(t) for t in (stop[:-1] + start[1:]) / 2),
            0.0 if kelvin is None else float(np.ptp(kelvin.values)),
        )

    def tracks(self, linear: Linear) -> list[dict[str, Track]]:
        """Return what the unit went through, part by part."""
        return [linear.details.tracks]

    def lacks(self, linear: Linear) -> dict[str, str]:
        """Return fields of the stimulus that are not known along the path, and why."""
        why = {
            "temperature": "the recording has no temperature",
            "temperature_rate": "the recording has no temperature rate",
            "vibration_power": "the recording has no vibration that stands out",
            "attitude": "the reference does not state the attitude of every station",
        }
        stimulus = linear.details.tracks["gyroscope"].stimulus
        return {field: text for field, text in why.items() if getattr(stimulus, field) is None}

    def largest(self, state: State, effect: Effect) -> dict[str, float]:
        """Return the most (SI) that an effect adds to each triad's mean output."""
        tracks = state.linear.details.tracks
        means = self._means(tracks, added(state.imu.with_effects(effect), tracks))
        means = np.abs(means[self.used] * self.real.to_si)
        force = self.real.kind == 0
        return {
            "accelerometer": float(np.max(means[force], initial=0.0)),
            "gyroscope": float(np.max(means[~force], initial=0.0)),
        }

    def without(self, place: int) -> Turntable:
        """Return the recording with a station left out."""
        kept = np.arange(len(self.stations.turn)) != place
        return replace(
            self,
            stations=replace(
                self.stations,
                accelerometer_used=np.asarray(self.stations.accelerometer_used) & kept,
                gyroscope_used=np.asarray(self.stations.gyroscope_used) & kept,
            ),
        )

    def rms(self, imu: Imu, linear: Linear) -> dict[str, tuple[float, str]]:
        """Return the rms of each kind of residual, with its unit, as a calibration has it."""
        return station_rms(imu, linear.details.stations)

    def twin(self, state: State, noise: NoiseModel, seed: int) -> Turntable:
        """Return the recording as a fit without effects would have it, along the set-up's motion, noise included."""
        changed, drawn, tracks = {}, {}, state.linear.details.tracks
        for number, (name, triad) in enumerate(state.imu.triads().items()):
            signal = getattr(self.recording, name)
            true = np.asarray(getattr(tracks[name].stimulus, triad.quantity))[: len(signal)]
            drawn[name] = drawn_noise(getattr(noise, name), signal, [seed, number]) * signal.nominal_scale
            outputs = true @ np.asarray(triad.gain).T + np.asarray(triad.bias) + drawn[name]
            changed[name] = replace(signal, values=outputs)
        stations = self._without(state.linear.conditions - self._means(tracks, drawn))
        return Turntable(replace(self.recording, **changed, notes=()), stations, state.imu)

    def still_parts(self, triad: str) -> tuple[list[FloatArray], float]:
        """Return what a triad put out (k, 3) in each pose, in SI, and its rate, Hz."""
        signal = getattr(self.recording, triad)
        values = signal.si()
        rest = self._real & ~np.asarray(self.stations.turn)
        spans = zip(np.asarray(self.stations.start)[rest], np.asarray(self.stations.stop)[rest], strict=True)
        return [values[(signal.time >= a) & (signal.time < b)] for a, b in spans], signal.rate

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """What is diagnosed, as it was recorded."""
        return (self.recording,)

    @property
    def _real(self) -> NDArray[np.bool_]:
        return np.asarray(self.stations.accelerometer_used) | np.asarray(self.stations.gyroscope_used)

    def _without(self, outputs: FloatArray) -> Stations:
        """Return the stations with mean outputs (6 S,) taken off."""
        force, rate = np.split(outputs.reshape(-1, 6), 2, axis=1)
        return replace(
            self.stations,
            accelerometer_mean=np.asarray(self.stations.accelerometer_mean) - force,
            gyroscope_mean=np.asarray(self.stations.gyroscope_mean) - rate,
        )

    def _means(self, tracks: dict[str, Track], outputs: Mapping[str, Array | FloatArray]) -> FloatArray:
        """Return the mean outputs (6 S,) over the stations, accelerometer and gyroscope of one after another."""
        return np.asarray(mean_outputs(tracks, outputs, len(self.stations.turn)), np.float64).ravel()


def diagnose_turntable(
    recording: Recording,
    reference: Sequence[Entry] | None = None,
    gravity: Gravity = STANDARD,
    *,
    static: Recording | NoiseModel | None = None,
    heldout: tuple[Recording, Sequence[Entry] | None] | None = None,
    level: float = 0.05,
    repair: bool = False,
) -> Diagnosis:
    """Calibrate a unit at known poses and turns, ask for everything that model and set-up lack, measure the gain.

    **Arguments:** as for [`jaximu.calibration.calibrate_turntable`][] and [`jaximu.diagnosis.diagnose`]; `heldout`:
    another recording of the unit with its reference.

    No effect is named while a mistake in the recording stands that could imitate it. Raises what these two raise.
    """
    with prepared([recording], repair) as (ready,):
        diagnosis = _of_ready(ready, reference, as_gravity(gravity), noise_of(static), heldout, level, repair)
    return without_effects(diagnosis, ready.spoiling) if ready.spoiling else diagnosis


def _of_ready(
    ready: Prepared,
    reference: Sequence[Entry] | None,
    gravity: LocalGravity,
    noise: NoiseModel | None,
    heldout: tuple[Recording, Sequence[Entry] | None] | None,
    level: float,
    repair: bool,
) -> Diagnosis:
    """Diagnose a recording that was looked over."""
    recording = ready.recording
    if recording.gyroscope is None or (heldout is not None and heldout[0].gyroscope is None):
        raise NotPossibleError("a diagnosis needs accelerometer and gyroscope.")

    def made(part: Recording, entries: Sequence[Entry], imu: Imu, known: NoiseModel) -> Turntable:
        return Turntable(part, observe_stations(part, entries, gravity.value, known)[0], jax.tree.map(np.asarray, imu))

    entries = entries_of_columns(recording) if reference is None else reference
    calibration = calibrate_table_ready([ready], [entries], gravity)
    notes = list(calibration.notes)
    held = None
    if heldout is not None:
        other = prepare(heldout[0], repair)
        stated = entries_of_columns(other.recording) if heldout[1] is None else heldout[1]
        notes += same_device(calibration, calibrate_table_ready([other], [stated], gravity))
        held = partial(made, other.recording, stated, calibration.imu)
    remade = partial(made, recording, entries, calibration.imu)
    if noise is not None:
        return examine(
            Examination(
                calibration, noise, remade, held, ready.findings, tuple(notes), level, naming=not ready.spoiling
            )
        )
    stations = calibration.stations
    assert stations is not None
    rest = np.asarray(stations.gyroscope_used) & ~np.asarray(stations.turn)
    spans = np.stack([np.asarray(stations.start)[rest], np.asarray(stations.stop)[rest]], axis=1)
    own = own_noise(replace(calibration, segmentations=(Segmentation(recording, spans, 1.0, (), ()),)))
    plain = remade(own)
    usual = with_usual_drift(own, plain.shortest(), plain.extent().duration)
    notes += usual.notes
    return examine(Examination(
        calibration, usual, remade, held, ready.findings, tuple(notes), level, trusted=True, naming=not ready.spoiling
    ))  # fmt: skip


def station_of(time: FloatArray, stations: Stations) -> NDArray[np.int64]:
    """Return the station (n,) that each stamp lies in, S where in none."""
    real = np.flatnonzero(np.asarray(stations.accelerometer_used) | np.asarray(stations.gyroscope_used))
    order = real[np.argsort(np.asarray(stations.start)[real])]
    start, stop = np.asarray(stations.start)[order], np.asarray(stations.stop)[order]
    place = np.maximum(np.searchsorted(start, time, side="right") - 1, 0)
    inside = (time >= start[place]) & (time < stop[place])
    return np.where(inside, order[place], len(stations.turn))


def station_tracks(recording: Recording, stations: Stations, imu: Imu) -> dict[str, Track]:
    """Return the stimulus at every sample: in a station as the set-up says, in between as `imu` measured it."""
    count = len(stations.turn)
    real = np.flatnonzero(np.asarray(stations.accelerometer_used) | np.asarray(stations.gyroscope_used))
    order = real[np.argsort(np.asarray(stations.start)[real])]
    nodes = jax.tree.map(lambda leaf: np.asarray(leaf)[order].reshape(-1, *np.shape(leaf)[2:]), stations.stimulus)
    tracks = {}
    for name, known in stimuli(recording, imu).items():
        signal = recording.signals[name]
        own = station_of(signal.time, stations)
        inside = own < count
        nearest = np.clip(np.searchsorted((nodes.time[1:] + nodes.time[:-1]) / 2, signal.time), 0, len(nodes.time) - 1)
        said = {field: np.array(getattr(known, field)) for field in ("specific_force", "angular_rate")}
        for field, values in said.items():
            stated = getattr(nodes, field)
            for axis in range(3):
                values[inside, axis] = np.interp(signal.time[inside], nodes.time, stated[:, axis])
        pose = inside & ~np.asarray(stations.turn)[np.minimum(own, count - 1)]
        first = np.asarray(stations.stimulus.specific_force)[:, 0]
        said["specific_force"][pose] = first[own[pose]]
        said["angular_rate"][pose] = 0.0
        acceleration = np.gradient(said["angular_rate"], signal.time, axis=0)
        acceleration[pose] = 0.0
        attitude = None if nodes.attitude is None else nodes.attitude[nearest]
        stimulus = replace(known, **said, angular_acceleration=acceleration, attitude=attitude)
        tracks[name] = Track.padded(stimulus, own, count)
    return tracks
