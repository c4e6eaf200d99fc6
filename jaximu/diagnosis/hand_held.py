"""A hand-held recording as the linear problem that a diagnosis asks questions of, and the refit with effects in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from jaximu.calibration.recipe import residual_rms
from jaximu.data.drift import drift_components, mean_output_reactions
from jaximu.data.poses import RecordedByHand, extent_of
from jaximu.data.track import Track
from jaximu.diagnosis.drift import DriftComponents
from jaximu.diagnosis.evidence import EffectBlock
from jaximu.diagnosis.experiment import Experiment, State
from jaximu.diagnosis.handling import Handling, averaged, findings, handling, instants, sway
from jaximu.diagnosis.shapes import SIZES, Shapes, harmonics
from jaximu.diagnosis.twin import twin_recordings
from jaximu.estimation.data import About
from jaximu.estimation.fitting import Linear
from jaximu.ground.array_types import FloatArray
from jaximu.model.effects.base import Extent
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.sensor import Imu
from jaximu.recordings.finding import Finding
from jaximu.recordings.recording import Recording
from jaximu.recordings.segmentation import observed_poses

__all__ = ["HandHeldExperiment"]


@dataclass
class HandHeldExperiment(RecordedByHand, Experiment):
    """Poses and turns of one unit, their noise known (`observations.slow`), and where they were cut from."""

    start: Imu  # a calibration without effects
    drift: DriftComponents | None = None
    candidates: tuple[str, ...] | None = None

    by_hand = True
    no_fixture = "a hand-held recording has no set-up to compare with"

    @property
    def no_session(self) -> str:
        """Why effects of a single recording cannot be asked: several have each its own time and heading."""
        return "it belongs to one recording, and these are several" if len(self.segmentations) > 1 else ""

    def extent(self) -> Extent:
        """Return what the recordings span."""
        return extent_of(self.segmentations)

    def about(self, imu: Imu) -> About:
        """Return the conditions about one unit, as without a diagnosis, and in their covariance what hands add."""
        found = super().about(imu)
        if self.drift is None:
            return found
        covariance = jax.tree.map(lambda leaf: leaf[0], found.covariance).dense()
        covariance = replace(covariance, measured=covariance.measured + np.diag(self.drift.by_hand))
        return replace(found, covariance=jax.tree.map(lambda leaf: leaf[None], covariance))

    def drifts(self, noise: NoiseModel, linear: Linear, within: bool) -> tuple[dict[str, AxisNoise], FloatArray]:
        """Return drifts of the biases by name, at a size of one, and the covariance (k, n, n) that each adds."""
        return drift_components(noise, self.observations, self.segmentations, linear.details.reaction, within)

    def handling(self, imu: Imu, noise: NoiseModel) -> Handling:
        """Return what the samples show of poses that move and turns that are too quick."""
        return handling(self, imu, noise)

    def sway(self, noise: NoiseModel) -> list[Finding]:
        """Return whether hands turn the unit in its poses."""
        return sway(self, noise)

    def found_by_hand(self) -> list[Finding]:
        """Return poses that move and turns that are too quick."""
        drift = self.drift
        return [] if drift is None or drift.handling is None else findings(self, drift.handling, drift.sizes)

    def rms(self, imu: Imu, linear: Linear) -> dict[str, tuple[float, str]]:
        """Return the rms of each kind of residual, with its unit, as a calibration has it."""
        return residual_rms(imu, linear.details.observations)

    def without(self, pose: int) -> HandHeldExperiment:
        """Return the recording with a pose, and the turns to and from it, left out."""
        poses, turns = np.array(self.observations.poses.mask), np.array(self.observations.turns.mask)
        poses[pose] = False
        turns[max(pose - 1, 0) : pose + 1] = False
        observations = replace(
            self.observations,
            poses=replace(self.observations.poses, mask=poses),
            turns=replace(self.observations.turns, mask=turns),
        )
        return replace(self, observations=observations)

    def instants(self, state: State) -> bool:
        """Return whether a fit shows the gyroscope's samples to be rates at instants, and not means."""
        return instants(self, state)

    def averaged(self) -> HandHeldExperiment:
        """Return the recording with the gyroscope's samples of instants turned into means."""
        return averaged(self)

    def twin(self, state: State, noise: NoiseModel, seed: int) -> HandHeldExperiment:
        """Return the recording as a fit without effects would have it, along the same motion, noise included."""
        made = twin_recordings(self, state, noise, seed)
        parts = tuple(replace(part, recording=each) for part, each in zip(self.segmentations, made, strict=True))
        return HandHeldExperiment(
            parts, observed_poses(parts, float(self.observations.gravity), noise=noise), state.imu
        )

    def still_parts(self, triad: str) -> tuple[list[FloatArray], float]:
        """Return what a triad put out (k, 3) in each still part, in SI, and its rate, Hz."""
        parts: list[FloatArray] = []
        rate = 1.0
        for part in self.segmentations:
            signal = getattr(part.recording, triad)
            rate, values = signal.rate, signal.si()
            parts += [values[(signal.time >= a) & (signal.time < b)] for a, b in part.intervals]
        return parts, rate

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """What is diagnosed, as it was recorded."""
        return tuple(part.recording for part in self.segmentations)

    def generic(self, imu: Imu, linear: Linear) -> list[EffectBlock]:
        """Return shapes without a cause, and poses that were bumped."""
        poses, shapes = self.observations.poses, self._shapes(linear)
        real = np.flatnonzero(poses.mask)
        time = (np.asarray(poses.start)[real] + np.asarray(poses.stop)[real]) / 2
        share = (time - time.min()) / max(np.ptp(time), 1e-9)
        up = _directions(imu, poses.accelerometer_mean)[real]
        blocks = [*shapes.slow_changes(share), *shapes.orientations(up, np.ones(len(real), bool))]
        for cycles in np.arange(_CYCLES[0], min(_CYCLES[1], len(real) / 2), 0.5):
            phase, period = 2 * np.pi * cycles * share, np.ptp(time) / cycles
            wave = np.stack([np.cos(phase), np.sin(phase)], axis=1)
            for triad in SIZES:
                blocks.append(shapes.block(triad, f"the {triad}'s bias swings to and fro", wave, period=period))
        return blocks + shapes.bumped(real, real)

    def nearly(self, imu: Imu, linear: Linear) -> list[EffectBlock]:
        """Return shapes that a cause may be taken for: higher harmonics, a heading, curves of an axis's own force."""
        poses, shapes = self.observations.poses, self._shapes(linear)
        real = np.asarray(poses.mask)
        up = _directions(imu, poses.accelerometer_mean)[real]
        curves = np.asarray(np.polynomial.legendre.legvander(up, 7)[..., 4:], np.float64)
        return [
            shapes.block(
                "gyroscope",
                "the gyroscope at rest depends on its heading",
                _attitudes(self.tracks(linear), len(real))[real],
            ),
            shapes.block(
                "gyroscope", "the gyroscope at rest depends on orientation (third harmonics)", harmonics(up)[1]
            ),
            shapes.block("accelerometer", "the accelerometer's axes are curved (even powers)", curves[..., ::2]),
            shapes.block("accelerometer", "the accelerometer's axes are curved (odd powers)", curves[..., 1::2]),
        ]

    def _shapes(self, linear: Linear) -> Shapes:
        """Return what makes blocks of shapes over the real poses; (poses, 3, k) are of each axis by itself."""
        real = np.asarray(self.observations.poses.mask)
        reactions = dict(zip(SIZES, mean_output_reactions(linear.details.reaction), strict=True))

        def react(triad: str, shape: FloatArray) -> FloatArray:
            equation = "npi,pk->nki" if shape.ndim == 2 else "npi,pik->nik"
            columns = np.einsum(equation, reactions[triad][:, real], shape)
            return columns.reshape(len(columns), -1)

        return Shapes(react)


_CYCLES = 2.0, 20.0
"""Periods in a recording, between which a swing of the bias is asked for; half a period apart, none is missed."""


def _directions(imu: Imu, output) -> FloatArray:
    force = imu.accelerometer.recover_on_host(output)
    return force / np.linalg.norm(force, axis=1, keepdims=True)


def _attitudes(tracks: Sequence[dict[str, Track]], poses: int) -> FloatArray:
    """Return the level frame's axes in the body's (poses, 9) in each pose, padding included, as tracks have them."""
    found = np.zeros((poses, 9))
    for track in (each["gyroscope"] for each in tracks):
        pose, first = np.unique(np.asarray(track.observation), return_index=True)
        inside = pose < poses
        attitude = np.asarray(track.stimulus.attitude)[first[inside]]
        found[pose[inside]] = Rotation.from_quat(attitude, scalar_first=True).as_matrix().reshape(-1, 9)
    return found
