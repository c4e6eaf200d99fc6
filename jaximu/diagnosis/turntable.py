"""Known poses and turns as the linear problem that a diagnosis asks questions of: set-up errors are candidates too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaximu.calibration.turntable import calibrate_turntable, station_rms
from jaximu.data.drift import with_usual_drift
from jaximu.data.observe_stations import observe_stations
from jaximu.data.path import Path, padded, padded_places, stimuli, terms, with_effect
from jaximu.data.poses import EXCESS_NAMES
from jaximu.data.stations import KnownStations, StationConditions, station_covariances, station_rows
from jaximu.diagnosis.diagnosis import Diagnosis, Examination, examine, same_device
from jaximu.diagnosis.evidence import EffectBlock
from jaximu.diagnosis.experiment import Experiment, State
from jaximu.diagnosis.hand_held import harmonics
from jaximu.diagnosis.noise import own_noise
from jaximu.diagnosis.twin import drawn_noise
from jaximu.estimation.data import About
from jaximu.estimation.fitting import Linear
from jaximu.estimation.problem import Name
from jaximu.estimation.rows import Rows
from jaximu.estimation.uncertainty import station_advice
from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.gravity import STANDARD, Gravity, as_gravity
from jaximu.mistakes import inspect
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

_FORCE, _RATE = 0.01, 1e-3  # m/s² and rad/s: sizes of generic shapes


@dataclass(frozen=True)
class AtStations:
    """Stations with what the effects add taken off their means, and the path that the unit went, sample by sample."""

    path: Path
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
        path, stations = station_path(self.recording, self.stations, unit.with_effects()), self.stations
        effects = tuple(unit.all_effects().values())
        if effects:
            added = terms(unit.with_effects(), path, effects, self._lengths)
            stations = self._without(self._means(added.accelerometer, added.gyroscope))
        details = AtStations(path, stations)
        lifted = jax.tree.map(lambda leaf: np.asarray(leaf)[None], stations)
        columns = self.own_columns(unit, details, 6 * len(stations.turn))
        return About(StationConditions(lifted), station_covariances(lifted), columns[None], details)

    def reactions(self, details: AtStations):
        """Return how the mean outputs react to effects."""
        count = len(self.stations.turn)

        def means(values, station):
            if values is None:
                return jnp.zeros((count, 3))
            number = jax.ops.segment_sum(jnp.ones_like(values[:, 0]), station, count + 1)[:count]
            return jax.ops.segment_sum(values, station, count + 1)[:count] / jnp.maximum(number, 1.0)[:, None]

        def of(effect, imu, path):
            force, rate = with_effect(imu, effect, path)
            parts = [means(force, path.accelerometer_pose), means(rate, path.gyroscope_pose)]
            return jnp.concatenate(parts, axis=-1).reshape(-1)

        return f"stations {count}", of, [details.path]

    def generic(self, imu: Imu, linear: Linear) -> list[EffectBlock]:
        """Return shapes without a cause, and poses that were bumped."""
        stations = self.stations
        pose, still = np.asarray(stations.accelerometer_used), np.asarray(stations.gyroscope_used)
        turn = np.asarray(stations.turn)
        middle = (np.asarray(stations.start) + np.asarray(stations.stop)) / 2
        share = (middle - middle[pose | still].min()) / max(np.ptp(middle[pose | still]), 1e-9)
        waves = np.cos(np.pi * share[:, None] * np.arange(1, 6))
        force = np.asarray(stations.stimulus.specific_force).mean(axis=1)
        up = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-9)
        second, third = harmonics(up)
        found = []

        def add(name: str, shape: FloatArray, triad: int, rows: NDArray[np.bool_], size: float) -> None:
            """`shape` (S, k), for each axis of a triad."""
            columns = np.zeros((len(turn), 6, shape.shape[1], 3))
            for axis in range(3):
                columns[rows, 3 * triad + axis, :, axis] = shape[rows]
            columns = columns.reshape(6 * len(turn), -1)
            found.append(EffectBlock(name, columns * size, np.full(columns.shape[1], size), "generic"))

        add("slow change of the accelerometer", waves, 0, pose, _FORCE)
        add("slow change of the gyroscope", waves, 1, still, _RATE)
        add("the accelerometer depends on orientation (second harmonics)", second, 0, pose, _FORCE)
        add("the accelerometer depends on orientation (third harmonics)", third, 0, pose, _FORCE)
        at_rest = still & ~turn
        add("the gyroscope at rest depends on orientation", np.concatenate([up, second], 1), 1, at_rest, _RATE)
        for station in np.flatnonzero(pose & ~turn):
            columns = np.zeros((len(turn), 6, 3))
            columns[station, :3] = _FORCE * np.eye(3)
            found.append(EffectBlock("data.bumped_pose", columns.reshape(-1, 3), np.full(3, _FORCE), "data",
                               {"pose": int(station)}, True))  # fmt: skip
        return found

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

    def paths(self, linear: Linear) -> list[Path]:
        """Return what the unit went through, part by part."""
        return [linear.details.path]

    def lacks(self, linear: Linear) -> dict[str, str]:
        """Return fields of the stimulus that are not known along the path, and why."""
        why = {
            "temperature": "the recording has no temperature",
            "temperature_rate": "the recording has no temperature rate",
            "vibration_power": "the recording has no vibration that stands out",
            "attitude": "the reference does not state the attitude of every station",
        }
        return {field: text for field, text in why.items() if getattr(linear.details.path.gyroscope, field) is None}

    def largest(self, state: State, effect: Effect) -> dict[str, float]:
        """Return the most (SI) that an effect adds to each triad's mean output."""
        added = terms(state.imu, state.linear.details.path, [effect], self._lengths)
        means = np.abs(self._means(added.accelerometer, added.gyroscope)[self.used] * self.real.to_si)
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
        changed, drawn = {}, []
        for number, (name, triad) in enumerate(state.imu.triads().items()):
            signal = getattr(self.recording, name)
            true = np.asarray(getattr(getattr(state.linear.details.path, name), triad.quantity))[: len(signal)]
            drawn.append(drawn_noise(getattr(noise, name), signal, [seed, number]) * signal.nominal_scale)
            outputs = true @ np.asarray(triad.gain).T + np.asarray(triad.bias) + drawn[-1]
            changed[name] = replace(signal, values=outputs)
        stations = self._without(state.linear.conditions - self._means(*drawn, *[None] * (2 - len(drawn))))
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

    @property
    def _lengths(self) -> tuple[int, int]:
        return len(self.recording.accelerometer), len(self.recording.gyroscope or ())

    def _without(self, outputs: FloatArray) -> Stations:
        """Return the stations with mean outputs (6 S,) taken off."""
        force, rate = np.split(outputs.reshape(-1, 6), 2, axis=1)
        return replace(
            self.stations,
            accelerometer_mean=np.asarray(self.stations.accelerometer_mean) - force,
            gyroscope_mean=np.asarray(self.stations.gyroscope_mean) - rate,
        )

    def _means(self, force: FloatArray, rate: FloatArray | None) -> FloatArray:
        """Return the mean outputs (6 S,) over the stations, accelerometer and gyroscope of one after another."""
        count = len(self.stations.turn)
        means = np.zeros((count, 6))
        for place, (values, signal) in enumerate(
            ((force, self.recording.accelerometer), (rate, self.recording.gyroscope))
        ):
            if values is None or signal is None:
                continue
            station = station_of(signal.time, self.stations)
            inside = station < count
            number = np.maximum(np.bincount(station[inside], minlength=count), 1)
            for axis in range(3):
                sums = np.bincount(station[inside], values[inside, axis], minlength=count)
                means[:, 3 * place + axis] = sums / number
        return means.ravel()


def diagnose_turntable(
    recording: Recording,
    reference: Sequence[Entry] | None = None,
    gravity: Gravity = STANDARD,
    *,
    static: Recording | NoiseModel | None = None,
    heldout: tuple[Recording, Sequence[Entry] | None] | None = None,
    level: float = 0.05,
) -> Diagnosis:
    """Calibrate a unit at known poses and turns, ask for everything that model and set-up lack, measure the gain.

    **Arguments:** as for [`jaximu.calibration.calibrate_turntable`] and [`jaximu.diagnosis.diagnose`]; `heldout`:
    another recording of the unit with its reference.

    Raises what these two raise.
    """
    gravity = as_gravity(gravity)
    if recording.gyroscope is None or (heldout is not None and heldout[0].gyroscope is None):
        raise NotPossibleError("a diagnosis needs accelerometer and gyroscope.")
    noise = noise_of(static)

    def made(part: Recording, said: Sequence[Entry] | None, imu: Imu, known: NoiseModel) -> Turntable:
        entries = entries_of_columns(part) if said is None else said
        return Turntable(part, observe_stations(part, entries, gravity.value, known)[0], jax.tree.map(np.asarray, imu))

    calibration = calibrate_turntable(recording, reference, gravity)
    notes = list(calibration.notes)
    held = None
    if heldout is not None:
        notes += same_device(calibration, calibrate_turntable(*heldout, gravity))
        held = partial(made, *heldout, calibration.imu)
    remade = partial(made, recording, reference, calibration.imu)
    findings = inspect(recording)
    if noise is not None:
        return examine(Examination(calibration, noise, remade, held, tuple(findings), tuple(notes), level))
    stations = calibration.stations
    assert stations is not None
    rest = np.asarray(stations.gyroscope_used) & ~np.asarray(stations.turn)
    spans = np.stack([np.asarray(stations.start)[rest], np.asarray(stations.stop)[rest]], axis=1)
    own = own_noise(replace(calibration, segmentations=(Segmentation(recording, spans, 1.0, (), ()),)))
    plain = remade(own)
    usual = with_usual_drift(own, plain.shortest(), plain.extent().duration)
    notes += usual.notes
    return examine(Examination(
        calibration, usual, remade, held, tuple(findings), tuple(notes), level, trusted=True
    ))  # fmt: skip


def station_of(time: FloatArray, stations: Stations) -> NDArray[np.int64]:
    """Return the station (n,) that each stamp lies in, S where in none."""
    real = np.flatnonzero(np.asarray(stations.accelerometer_used) | np.asarray(stations.gyroscope_used))
    order = real[np.argsort(np.asarray(stations.start)[real])]
    start, stop = np.asarray(stations.start)[order], np.asarray(stations.stop)[order]
    place = np.maximum(np.searchsorted(start, time, side="right") - 1, 0)
    inside = (time >= start[place]) & (time < stop[place])
    return np.where(inside, order[place], len(stations.turn))


def station_path(recording: Recording, stations: Stations, imu: Imu) -> Path:
    """Return the stimulus at every sample: in a station as the set-up says, in between as `imu` measured it."""
    parts = stimuli(recording, imu)
    count = len(stations.turn)
    real = np.flatnonzero(np.asarray(stations.accelerometer_used) | np.asarray(stations.gyroscope_used))
    order = real[np.argsort(np.asarray(stations.start)[real])]
    nodes = jax.tree.map(lambda leaf: np.asarray(leaf)[order].reshape(-1, *np.shape(leaf)[2:]), stations.stimulus)
    changed, station = [], []
    for signal, known in parts:
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
        changed.append(padded(replace(known, **said, angular_acceleration=acceleration, attitude=attitude)))
        station.append(padded_places(own, count))
    return Path(changed[0], changed[1], station[0], station[1], np.zeros((0, 0), np.int64))
