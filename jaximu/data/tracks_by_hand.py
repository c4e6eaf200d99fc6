"""What a hand-held unit went through, sample by sample, as its own calibration tells it.

At rest the specific force is the pose's mean and nothing rotates; in between, force and rate are what was measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from jaximu.estimation.track import Track, measured
from jaximu.ground.array_types import FloatArray
from jaximu.model.sensor import Imu
from jaximu.recordings.observations import Observations
from jaximu.recordings.recording import Signal
from jaximu.recordings.segmentation import Segmentation

__all__ = ["tracks_by_hand", "turn_samples"]


def turn_samples(segmentations: Sequence[Segmentation], observations: Observations) -> list[NDArray[np.int64]]:
    """Return, of each recording, where the samples (T, S) of each turn are among its gyroscope's; 0 for none."""
    interval, first, recordings = np.asarray(observations.turns.interval), 0, []
    for part in segmentations:
        time, samples = part.recording.signals["gyroscope"].time, np.zeros(interval.shape, np.int64)
        for turn, (start, stop) in enumerate(zip(part.intervals[:-1, 1], part.intervals[1:, 0], strict=True), first):
            if (interval[turn] > 0).any():
                inside = np.flatnonzero((time >= start) & (time < stop))
                samples[turn, : len(inside)] = inside
        recordings.append(samples)
        first += len(part.intervals)
    return recordings


def tracks_by_hand(
    segmentations: Sequence[Segmentation],
    samples: Sequence[NDArray[np.int64]],
    imu: Imu,
    outputs: Sequence[Mapping[str, FloatArray]],
    running: FloatArray,
) -> list[dict[str, Track]]:
    """Return the tracks of both triads in each recording, whose observations are the poses, as `imu` tells them.

    **Arguments:** `imu`: its effects are not looked at; `samples`: as of `turn_samples`; `outputs`: of each recording
    and triad, at its samples, without what effects add; `running` (T, S, 4): the turns' rotations, sample by sample.
    """
    tracks, first = [], 0
    for part, turns, values in zip(segmentations, samples, outputs, strict=True):
        tracks.append(_tracks(part, turns, imu, values, first, running))
        first += len(part.intervals)
    return tracks


def _tracks(
    part: Segmentation,
    samples: NDArray[np.int64],
    imu: Imu,
    outputs: Mapping[str, FloatArray],
    first: int,
    running: FloatArray,
) -> dict[str, Track]:
    recording, intervals, poses = part.recording, part.intervals, len(samples) + 1
    triads = imu.triads()
    force, rate = (triads[name].recover_on_host(outputs[name]) for name in ("accelerometer", "gyroscope"))
    poses_of = {name: _pose_of(recording.signals[name], intervals) for name in outputs}
    means = np.stack([force[poses_of["accelerometer"] == k].mean(axis=0) for k in range(len(intervals))])
    rate[poses_of["gyroscope"] >= 0] = 0.0

    attitude = np.tile([1.0, 0.0, 0.0, 0.0], (len(rate), 1))
    rotation = scipy.spatial.transform.Rotation
    now = rotation.identity()
    for k, mean in enumerate(means):
        now = _levelled(now, mean)
        attitude[poses_of["gyroscope"] == k] = now.as_quat(scalar_first=True)
        inside = samples[first + k][samples[first + k] > 0] if k + 1 < len(means) else []
        if len(inside):
            turned = now * rotation.from_quat(running[first + k, : len(inside)], scalar_first=True)
            attitude[inside], now = turned.as_quat(scalar_first=True), turned[-1]

    gyroscope, tracks = recording.signals["gyroscope"], {}
    for name, known in measured(recording, force, rate).items():
        assert known.specific_force is not None
        time, pose = recording.signals[name].time, poses_of[name]
        acceleration = np.array(known.angular_acceleration)
        acceleration[pose >= 0] = 0.0
        nearest = np.clip(np.searchsorted(gyroscope.time, time - 0.5 / gyroscope.rate), 0, len(gyroscope) - 1)
        stimulus = replace(
            known,
            specific_force=np.where(pose[:, None] >= 0, means[np.maximum(pose, 0)], known.specific_force),
            angular_acceleration=acceleration,
            attitude=attitude[nearest],
        )
        tracks[name] = Track.padded(stimulus, np.where(pose >= 0, pose + first, poses), poses)
    return tracks


def _pose_of(signal: Signal, intervals: FloatArray) -> NDArray[np.int64]:
    """The pose each sample lies in, −1 in between."""
    pose = np.searchsorted(intervals[:, 0], signal.time, side="right") - 1
    inside = (pose >= 0) & (signal.time < intervals[np.maximum(pose, 0), 1])
    return np.where(inside, pose, -1)


def _levelled(attitude: scipy.spatial.transform.Rotation, force: FloatArray) -> scipy.spatial.transform.Rotation:
    """The attitude turned by the smallest rotation that brings the specific force upright."""
    x, y, z = attitude.apply(force / np.linalg.norm(force))
    half = [1 + z, y, -x, 0.0] if 1 + z > 1e-9 else [0.0, 1.0, 0.0, 0.0]  # straight down: a half turn
    return scipy.spatial.transform.Rotation.from_quat(half, scalar_first=True) * attitude
