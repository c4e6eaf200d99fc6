"""What a hand-held unit went through, sample by sample, as its own calibration tells it.

At rest the specific force is the pose's mean and nothing rotates; in between, force and rate are what was measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from jaximu.data.track import Track, measured, recovered
from jaximu.ground.array_types import FloatArray
from jaximu.model.sensor import Imu
from jaximu.recordings.observations import Observations
from jaximu.recordings.recording import Signal
from jaximu.recordings.segmentation import Segmentation

__all__ = ["tracks_by_hand", "turn_samples"]


def turn_samples(segmentations: Sequence[Segmentation], observations: Observations) -> list[NDArray[np.int64]]:
    """Return, of each recording, where the samples (T, S) of each turn are among its gyroscope's; 0 for none."""
    interval, first, places = np.asarray(observations.turns.interval), 0, []
    for part in segmentations:
        time, samples = part.recording.signals["gyroscope"].time, np.zeros(interval.shape, np.int64)
        for turn, (start, stop) in enumerate(zip(part.intervals[:-1, 1], part.intervals[1:, 0], strict=True), first):
            if (interval[turn] > 0).any():
                inside = np.flatnonzero((time >= start) & (time < stop))
                samples[turn, : len(inside)] = inside
        places.append(samples)
        first += len(part.intervals)
    return places


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
    for part, places, values in zip(segmentations, samples, outputs, strict=True):
        tracks.append(_tracks(part, places, imu, values, first, running))
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
    force, rate = (recovered(triads[name], outputs[name]) for name in ("accelerometer", "gyroscope"))
    own = {name: _pose_of(recording.signals[name], intervals) for name in outputs}
    means = np.stack([force[own["accelerometer"] == k].mean(axis=0) for k in range(len(intervals))])
    rate[own["gyroscope"] >= 0] = 0.0

    heading = np.array([1.0, 0.0, 0.0, 0.0])
    attitude = np.tile(heading, (len(rate), 1))
    now = _levelled(heading, means[0])
    for k in range(len(intervals)):
        attitude[own["gyroscope"] == k] = now
        if k + 1 == len(intervals):
            break
        inside = samples[first + k][samples[first + k] > 0]
        if len(inside):
            attitude[inside] = _multiply(now, running[first + k, : len(inside)])
            now = attitude[inside[-1]]
        now = _levelled(now, means[k + 1])

    gyroscope, tracks = recording.signals["gyroscope"], {}
    for name, known in measured(recording, force, rate).items():
        assert known.specific_force is not None
        time, pose = recording.signals[name].time, own[name]
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


def _multiply(p: FloatArray, q: FloatArray) -> FloatArray:
    (a, b, c, d), (w, x, y, z) = p, q.T
    return np.stack(
        [a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y, a * y - b * z + c * w + d * x,
         a * z + b * y - c * x + d * w], axis=1)  # fmt: skip


def _levelled(attitude: FloatArray, force: FloatArray) -> FloatArray:
    """The attitude turned by the smallest rotation that brings the specific force upright."""
    w, x, y, z = attitude.tolist()
    a, b, c = (force / np.linalg.norm(force)).tolist()
    lab = (  # the force's direction in the level frame
        (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c,
        2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * c,
        2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c,
    )
    half = np.array([1 + lab[2], lab[1], -lab[0], 0.0])  # from `lab` to z: 1 + cosine, and the cross product
    if np.linalg.norm(half) < 1e-9:
        half = np.array([0.0, 1.0, 0.0, 0.0])
    return _multiply(half / np.linalg.norm(half), attitude[None])[0]
