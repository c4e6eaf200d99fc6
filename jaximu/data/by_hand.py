"""Poses and turns with the recordings that they were cut from: the samples along which effects act, and the hands.

What effects add to the samples is taken off the means and turns; what they would add is how the conditions react.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from jaximu.data.drift import drift_components, mean_output_reactions
from jaximu.data.handling import bend, handling, moved_by_hand, sway
from jaximu.data.poses import COARSE_EXCESS, EXCESS_NAMES, Condensed, condensed, pose_rows, residual_rms
from jaximu.data.poses_covariance import Sensitivities
from jaximu.data.tracks_by_hand import tracks_by_hand, turn_samples
from jaximu.data.twin_by_hand import twin_recordings
from jaximu.estimation.data import About, Data, Handling, Observed
from jaximu.estimation.rows import Rows
from jaximu.estimation.track import Track, added, mean_outputs
from jaximu.estimation.uncertainty import pose_advice
from jaximu.ground.array_types import FloatArray
from jaximu.model.effects.base import Effect
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.sensor import Imu
from jaximu.recordings.finding import Finding
from jaximu.recordings.observations import Observations
from jaximu.recordings.recording import Recording
from jaximu.recordings.segmentation import Segmentation, observed_poses

__all__ = ["Along", "RecordedByHand"]

_ROUNDS, _CHANGED = 6, 1e-3
"""Times that tracks are taken anew with what effects add taken off, and the relative change of it that ends them."""


class Along:
    """A hand-held recording about a unit: what was condensed, and the tracks of each part, made when asked for.

    observations: with what the effects add taken off.
    """

    def __init__(self, condensed: Condensed, observations: Observations, made: Callable[[], list[dict[str, Track]]]):
        self.condensed, self.observations, self._made = condensed, observations, made

    @cached_property
    def tracks(self) -> list[dict[str, Track]]:
        """What the unit went through, part by part."""
        return self._made()

    @property
    def reaction(self) -> Sensitivities:
        """How the conditions react to the outputs."""
        assert self.condensed.reaction is not None
        return self.condensed.reaction


@dataclass
class RecordedByHand(Data):
    """Poses and turns of one unit, and the recordings that they were cut from, along which effects act."""

    segmentations: tuple[Segmentation, ...]
    observations: Observations

    excess_names = EXCESS_NAMES
    coarse = COARSE_EXCESS
    by_hand = True
    no_fixture = "a hand-held recording has no set-up to compare with"
    advice = staticmethod(pose_advice)

    @cached_property
    def shifts(self) -> FloatArray:
        """What the observations took off each recording's gyroscope output (k, 3): its bias against the first's."""
        return _rest_shifts(self.segmentations)

    def rows(self, imu: Imu) -> Rows:
        """Return what each condition is: norms of poses, two components of turns, three of means at rest."""
        return pose_rows(imu, self.observations)

    @cached_property
    def turn_samples(self) -> list[NDArray[np.int64]]:
        """Where the samples (T, S) of each turn are among those of each recording's gyroscope; 0 for none."""
        return turn_samples(self.segmentations, self.observations)

    def about(self, imu: Imu) -> About:
        """Return the conditions about one unit, the leading axis of length one, and its effects' columns."""
        unit = jax.tree.map(lambda leaf: leaf[0], imu)
        along = self.along(unit, tuple(unit.all_effects().values()))
        covariance = along.condensed.covariance
        columns = self.own_columns(unit, along, covariance.used.shape[1])[None]
        return About(along.condensed.conditions, covariance, columns, along)

    def along(self, imu: Imu, effects: tuple[Effect, ...]) -> Along:
        """Return the recordings about a unit with effects: the tracks, and the observations without what they add."""
        bare = jax.tree.map(lambda leaf: np.asarray(leaf)[None], imu.with_effects())
        recorded = [
            {"accelerometer": signals["accelerometer"].values, "gyroscope": signals["gyroscope"].values - shift}
            for signals, shift in zip((part.recording.signals for part in self.segmentations), self.shifts, strict=True)
        ]
        offsets: list[Any] = [None] * len(recorded)
        outputs, observations, change = recorded, self.observations, np.inf
        for number in range(_ROUNDS):  # the tracks tell what effects add, and what they add changes the tracks
            whole = condensed(bare, jax.tree.map(lambda leaf: np.asarray(leaf)[None], observations))
            assert whole.running is not None
            made = partial(tracks_by_hand, self.segmentations, self.turn_samples, imu, outputs, whole.running)
            if not effects or change < _CHANGED or number == _ROUNDS - 1:
                break
            before, tracks = offsets, made()
            offsets = [jax.tree.map(np.asarray, added(imu.with_effects(*effects), track)) for track in tracks]
            change = max(_change(old, new) for old, new in zip(before, offsets, strict=True))
            outputs = [
                {name: values - offset[name][: len(values)] for name, values in signals.items()}
                for signals, offset in zip(recorded, offsets, strict=True)
            ]
            observations = self._without_outputs(tracks, offsets)
        return Along(whole, observations, made)

    def reactions(self, details: Along):
        """Return how norms, directions and means at rest react to effects, recording by recording."""

        def of(effect, imu, part):
            tracks, samples, reaction = part
            outputs = added(imu.with_effects(effect), tracks)
            means = mean_outputs(tracks, outputs, reaction.norm.shape[0])
            force = means[:, :3]
            norm = jnp.sum(reaction.norm * force, axis=-1)
            turn = jnp.einsum("tai,ti->ta", reaction.after, force[1:])
            turn = turn + jnp.einsum("tai,ti->ta", reaction.before, force[:-1])
            turn = turn + jnp.einsum("tasi,tsi->ta", reaction.turn, outputs["gyroscope"][samples])
            return jnp.concatenate([norm, turn.reshape(-1), means[:, 3:].reshape(-1)])

        parts = zip(details.tracks, self.turn_samples, strict=True)
        return "by hand", of, [(tracks, samples, details.reaction) for tracks, samples in parts]

    def _without_outputs(
        self, tracks: Sequence[dict[str, Track]], offsets: Sequence[dict[str, FloatArray]]
    ) -> Observations:
        """Return the observations with what is added to the samples of each recording taken off."""
        poses, turns = self.observations.poses, self.observations.turns
        means, output = np.zeros((len(poses.mask), 6)), np.array(turns.output)
        for track, offset, samples in zip(tracks, offsets, self.turn_samples, strict=True):
            means += np.asarray(mean_outputs(track, offset, len(means)))
            output[samples > 0] -= offset["gyroscope"][samples[samples > 0]]
        return replace(
            self.observations,
            poses=replace(
                poses,
                accelerometer_mean=np.asarray(poses.accelerometer_mean) - means[:, :3],
                gyroscope_mean=np.asarray(poses.gyroscope_mean) - means[:, 3:],
            ),
            turns=replace(turns, output=output),
        )

    # --- what a diagnosis needs to know ---------------------------------------------------------------------------

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """What was recorded."""
        return tuple(part.recording for part in self.segmentations)

    def spans(self) -> list[FloatArray]:
        """Return start and stop (k, 2), s, of the poses of each recording."""
        return [part.intervals for part in self.segmentations]

    def rms(self, imu: Imu, details: Along, conditions: FloatArray) -> dict[str, tuple[float, str]]:
        """Return the rms of each kind of residual, with its unit, as a calibration has it."""
        return residual_rms(imu, details.observations)

    def without(self, observation: int) -> RecordedByHand:
        """Return the recordings with a pose, and the turns to and from it, left out."""
        poses, turns = np.array(self.observations.poses.mask), np.array(self.observations.turns.mask)
        poses[observation] = False
        turns[max(observation - 1, 0) : observation + 1] = False
        observations = replace(
            self.observations,
            poses=replace(self.observations.poses, mask=poses),
            turns=replace(self.observations.turns, mask=turns),
        )
        return replace(self, observations=observations)

    def observed(self, imu: Imu, details: Along) -> Observed:
        """Return the real poses; what is off in a gyroscope's pose is off by the mean of its neighbours in a turn."""
        poses = self.observations.poses
        real = np.flatnonzero(poses.mask)
        by_force, by_rate = mean_output_reactions(details.reaction)

        def react(triad: str, shape: FloatArray) -> FloatArray:
            equation = "npi,pk->nki" if shape.ndim == 2 else "npi,pik->nik"
            columns = np.einsum(equation, (by_force if triad == "accelerometer" else by_rate)[:, real], shape)
            return columns.reshape(len(columns), -1)

        time = ((np.asarray(poses.start) + np.asarray(poses.stop)) / 2)[real]
        force = imu.accelerometer.recover_on_host(poses.accelerometer_mean)
        return Observed(
            react,
            (time - time.min()) / max(np.ptp(time), 1e-9),
            up=(force / np.linalg.norm(force, axis=1, keepdims=True))[real],
            still=np.ones(len(real), bool),
            number=real,
            alone=real,
            duration=float(np.ptp(time)),
            attitude=_attitudes(details.tracks, len(poses.mask))[real],
        )

    def drifts(self, noise: NoiseModel, details: Along, within: bool) -> tuple[dict[str, AxisNoise], FloatArray]:
        """Return drifts of the biases by name, at a size of one, and the covariance (k, n, n) that each adds."""
        return drift_components(noise, self.observations, self.segmentations, details.reaction, within)

    def handling(self, imu: Imu, details: Along, noise: NoiseModel) -> Handling:
        """Return what the samples show of poses that move and turns that are too quick."""
        return handling(self.segmentations, self.observations, imu, details.condensed.running, noise)

    def moved_by_hand(self, imu: Imu, handling: Handling, undersampling: float) -> list[Finding]:
        """Return poses that move and turns that are too quick."""
        return moved_by_hand(self.segmentations, self.observations, imu, handling, undersampling)

    def sway(self, imu: Imu, noise: NoiseModel) -> list[Finding]:
        """Return whether hands turn the unit in its poses."""
        return sway(self.segmentations, imu, noise)

    def averaged(self) -> RecordedByHand:
        """Return the recordings with samples of instants turned into means over their intervals."""
        turns = self.observations.turns
        changed = replace(turns, output=np.asarray(turns.output) + bend(turns))
        return replace(self, observations=replace(self.observations, turns=changed))

    def change_by_averaging(self, details: Along) -> FloatArray:
        """Return how the conditions (n,) change by that."""
        turns = np.einsum("tasi,tsi->ta", np.asarray(details.reaction.turn), -bend(self.observations.turns)).ravel()
        count = len(self.observations.poses.mask)
        return np.concatenate([np.zeros(count), turns, np.zeros(3 * count)])

    def twin(self, imu: Imu, details: Along, conditions: FloatArray, noise: NoiseModel, seed: int) -> RecordedByHand:
        """Return the recordings as a unit without effects would have them, along the same motion, noise included."""
        made = twin_recordings(
            self.segmentations, self.observations, self.turn_samples, self.shifts, imu, details.tracks, noise, seed
        )
        parts = tuple(replace(part, recording=twin) for part, twin in zip(self.segmentations, made, strict=True))
        return RecordedByHand(parts, observed_poses(parts, float(self.observations.gravity), noise=noise))


def _rest_shifts(segmentations: Sequence[Segmentation]) -> FloatArray:
    """Return the difference (k, 3) of each recording's gyroscope output at rest to the first recording's."""
    middles = []
    for part in segmentations:
        signal = part.recording.gyroscope
        assert signal is not None
        means = [signal.values[(signal.time >= a) & (signal.time < b)].mean(axis=0) for a, b in part.intervals]
        middles.append(np.median(means, axis=0))
    return np.array(middles) - middles[0]


def _change(before: dict[str, FloatArray] | None, after: dict[str, FloatArray]) -> float:
    """Return the largest change of what effects add, as a share of the most that they add to a triad."""
    shares = [0.0]
    for name, new in after.items():
        old, most = 0.0 if before is None else before[name], np.max(np.abs(new), initial=0.0)
        shares.append(float(np.max(np.abs(new - old), initial=0.0) / most) if most > 0 else 0.0)
    return max(shares)


def _attitudes(tracks: Sequence[dict[str, Track]], poses: int) -> FloatArray:
    """Return the level frame's axes in the body's (poses, 9) in each pose, padding included, as tracks have them."""
    axes = np.zeros((poses, 9))
    for track in (pair["gyroscope"] for pair in tracks):
        pose, first = np.unique(np.asarray(track.observation), return_index=True)
        inside = pose < poses
        attitude = np.asarray(track.stimulus.attitude)[first[inside]]
        axes[pose[inside]] = Rotation.from_quat(attitude, scalar_first=True).as_matrix().reshape(-1, 9)
    return axes
