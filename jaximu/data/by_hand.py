"""Poses and turns with the recordings that they were cut from: what a diagnosis asks of them, and the hands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from jaximu.data.drift import drift_components, mean_output_reactions, means_by_hand, recordings_of_poses
from jaximu.data.handling import bend, handling, moved_by_hand, sway
from jaximu.data.poses import (
    COARSE_EXCESS,
    EXCESS_NAMES,
    NO_FIXTURE,
    Along,
    PosesAndTurns,
    as_observations,
    felt_by_hand,
    pose_rows,
    residual_rms,
)
from jaximu.data.tracks_by_hand import rest_shifts, samples_by_hand
from jaximu.data.twin_by_hand import twin_recordings
from jaximu.estimation.data import About, Handling, Observed, OfOneUnit, OutputMeans
from jaximu.estimation.rows import Rows, Sizes
from jaximu.estimation.track import Track
from jaximu.estimation.uncertainty import pose_advice
from jaximu.ground.array_types import Array, FloatArray
from jaximu.ground.rotation import rotation_matrix, unit_vectors
from jaximu.ground.tracing import first, on_host
from jaximu.model.effects.base import Effect
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.sensor import Imu
from jaximu.recordings.finding import Finding
from jaximu.recordings.observations import Observations
from jaximu.recordings.recording import Recording
from jaximu.recordings.segmentation import Segmentation, observed_poses

Swings = Mapping[str, tuple[FloatArray, FloatArray]]
"""By triad, as in `RecordedByHand`."""


@dataclass
class RecordedByHand(OfOneUnit):
    """Poses and turns of one unit, and the recordings that they were cut from, along which effects act.

    known: the unit whose effects were taken off the observations, the Earth's rotation as a rule. swings: by triad,
    what lines of hardly any frequency add to the mean outputs (p, 3) of real poses, which is taken off them, and the
    variance (p, 3) with which that is known; output units.
    """

    segmentations: tuple[Segmentation, ...]
    observations: Observations
    known: Imu | None = None
    swings: Swings = field(default_factory=dict)

    excess_names = EXCESS_NAMES
    coarse = COARSE_EXCESS
    by_hand = sampled = True
    no_fixture = NO_FIXTURE
    advice = staticmethod(pose_advice)

    def __post_init__(self):
        self.observations = on_host(self.observations)

    @cached_property
    def data(self) -> PosesAndTurns:
        """The poses and turns with the samples along which effects act."""
        return PosesAndTurns.of(self.observations, samples=samples_by_hand(self.segmentations, self.observations))

    def rows(self, imu: Imu) -> Rows:
        """Return what each condition is: norms of poses, two components of turns, three of means at rest."""
        return pose_rows(imu, self.observations)

    def about_one(self, imu: Imu) -> About:
        """Return the conditions about the unit, and its effects' columns."""
        along = self.along(imu, felt_by_hand(imu))
        conditions, covariance = first((along.condensed.conditions, along.condensed.covariance))
        return About(conditions, covariance, self.own_columns(imu, along, len(covariance.used)), along)

    def along(self, imu: Imu, effects: tuple[Effect, ...]) -> Along:
        """Return the recordings about a unit with effects: the tracks, and the observations without what they add."""
        along = on_host(self.data.along(imu, effects))
        return along._replace(observations=as_observations(along.observations))

    def reactions(self, details: Along):
        """Return how norms, directions and means at rest react to effects, recording by recording."""
        return self.data.reactions(details)

    # --- what a diagnosis needs to know ---------------------------------------------------------------------------

    @property
    def gravity(self) -> Array:
        """Local gravity, m/s²."""
        return self.observations.gravity

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """What was recorded."""
        return tuple(part.recording for part in self.segmentations)

    def spans(self) -> list[FloatArray]:
        """Return start and stop (k, 2), s, of the poses of each recording."""
        return [part.intervals for part in self.segmentations]

    def hidden(self) -> dict[str, str]:
        """Return what is taken off beforehand: the Earth's rotation, where a latitude tells it."""
        effects = () if self.known is None else self.known.all_effects().values()
        return {effect.name: "it is known, and taken off" for effect in effects}

    def counts(self) -> dict[str, int]:
        """Return the numbers of poses and turns."""
        return {name: int(getattr(self.observations, name).mask.sum()) for name in ("poses", "turns")}

    def rate_at_rest(self) -> FloatArray:
        """Return the gyroscope's mean output (3,) over the poses."""
        poses = self.observations.poses
        return np.asarray(poses.gyroscope_mean)[np.asarray(poses.mask)].mean(axis=0)

    def rotations(self, imu: Imu) -> FloatArray:
        """Return how the rotation vector of each turn (t, 3, 3, 4), rad, reacts to K⁻¹ and −K⁻¹b of the gyroscope."""
        slope = np.asarray(self.along(imu, ()).condensed.conditions.slope)
        return slope[0, np.asarray(self.observations.turns.mask)]

    def with_noise(self, noise: NoiseModel) -> RecordedByHand:
        """Return the poses and turns with the covariance that a noise of the samples makes."""
        observations = observed_poses(self.segmentations, float(self.gravity), noise=noise)
        data = replace(self, observations=_steadied(observations, self.swings))
        if self.known is None or not self.known.all_effects():
            return data
        left = data.along(self.known, tuple(self.known.all_effects().values())).observations
        return replace(data, observations=left)

    def without_swings(self, swings: Swings) -> RecordedByHand:
        """Return the recordings with what lines add to the means at rest, see `swings`, taken off."""
        return replace(self, swings=swings, observations=_steadied(self.observations, swings))

    def rms(self, imu: Imu, details: Along, conditions: FloatArray) -> Sizes:
        """Return the rms of each kind of residual, with its unit, as a calibration has it."""
        return residual_rms(imu, details.observations)

    def without(self, observation: int) -> RecordedByHand:
        """Return the recordings with a pose, and the turns to and from it, left out."""
        poses, turns = self.observations.poses, self.observations.turns
        pose, turn = np.arange(len(poses.mask)), np.arange(len(turns.mask))
        poses = replace(poses, mask=poses.mask & (pose != observation))
        turns = replace(turns, mask=turns.mask & (turn != observation) & (turn != observation - 1))
        return replace(self, observations=replace(self.observations, poses=poses, turns=turns))

    def observed(self, imu: Imu, details: Along) -> Observed:
        """Return the real poses; what is off in a gyroscope's pose is off by the mean of its neighbours in a turn."""
        poses = self.observations.poses
        real = np.flatnonzero(poses.mask)
        by_force, by_rate = mean_output_reactions(details.reaction)

        def react(triad: str, shape: FloatArray) -> FloatArray:
            equation = "npi,pk->nki" if shape.ndim == 2 else "npi,pik->nik"
            columns = np.einsum(equation, (by_force if triad == "accelerometer" else by_rate)[:, real], shape)
            return columns.reshape(len(columns), -1)

        time = ((poses.start + poses.stop) / 2)[real]
        force = imu.accelerometer.recover_on_host(poses.accelerometer_mean)
        return Observed(
            react,
            (time - time.min()) / max(np.ptp(time), 1e-9),
            recording=recordings_of_poses(self.segmentations)[real],
            up=unit_vectors(force[real]),
            still=np.ones(len(real), bool),
            number=real,
            alone=real,
            duration=float(np.ptp(time)),
            attitude=_attitudes(details.tracks, len(poses.mask))[real],
        )

    def drifts(self, noise: NoiseModel, details: Along, within: bool) -> tuple[dict[str, AxisNoise], FloatArray]:
        """Return drifts of the biases by name, at a size of one, and the covariance (k, n, n) that each adds."""
        return drift_components(noise, self.output_means(details), within)

    def output_means(self, details: Along) -> OutputMeans:
        """Return the mean outputs in the poses."""
        return means_by_hand(self.observations, self.segmentations, details.reaction)

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
        changed = replace(turns, output=turns.output + bend(turns))
        return replace(self, observations=replace(self.observations, turns=changed))

    def change_by_averaging(self, details: Along) -> FloatArray:
        """Return how the conditions (n,) change by that."""
        turns = np.einsum("tasi,tsi->ta", details.reaction.turn, -bend(self.observations.turns)).ravel()
        count = len(self.observations.poses.mask)
        return np.pad(turns, (count, 3 * count))

    def twin(self, imu: Imu, details: Along, conditions: FloatArray, noise: NoiseModel, seed: int) -> RecordedByHand:
        """Return the recordings as a unit without effects would have them, along the same motion, noise included."""
        made = twin_recordings(
            self.segmentations, self.data, rest_shifts(self.segmentations), imu, details.tracks, noise, seed
        )
        parts = tuple(replace(part, recording=twin) for part, twin in zip(self.segmentations, made, strict=True))
        return RecordedByHand(parts, observed_poses(parts, float(self.observations.gravity), noise=noise))


def _steadied(observations: Observations, swings: Swings) -> Observations:
    """Return observations without what lines add to means at rest, and with the variance that this leaves."""
    poses, slow = observations.poses, observations.slow
    for triad, (shift, variance) in swings.items():
        mean, spread = (np.array(getattr(poses, f"{triad}_{name}")) for name in ("mean", "covariance"))
        mean[: len(shift)] -= shift
        spread[: len(shift)] += variance[:, :, None] * np.eye(3)
        poses = replace(poses, **{f"{triad}_mean": mean, f"{triad}_covariance": spread})
        if slow is not None:
            tied, rest = np.array(getattr(slow, triad)), np.arange(len(shift))
            tied[:, rest, rest] += variance.T
            slow = replace(slow, **{triad: tied})
    return replace(observations, poses=poses, slow=slow)


def _attitudes(tracks: Sequence[dict[str, Track]], poses: int) -> FloatArray:
    """Return the level frame's axes in the body's (poses, 9) in each pose, padding included, as tracks have them."""
    axes = np.zeros((poses, 9))
    for track in (pair["gyroscope"] for pair in tracks):
        pose, row = np.unique(track.observation, return_index=True)
        inside = pose < poses
        axes[pose[inside]] = rotation_matrix(np.asarray(track.stimulus.attitude)[row[inside]]).reshape(-1, 9)
    return axes
