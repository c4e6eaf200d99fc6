"""Hand-held recordings as the model would have them, along the motion that was estimated, noise included."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jaximu.data.poses import PosesAndTurns
from jaximu.data.twin_signal import twin_signal
from jaximu.estimation.track import Track
from jaximu.ground.array_types import FloatArray
from jaximu.ground.rotation import UP, rotation_matrix, unit_vectors
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.recordings.recording import Recording
from jaximu.recordings.segmentation import Segmentation


def twin_recordings(
    segmentations: Sequence[Segmentation],
    data: PosesAndTurns,
    shifts: FloatArray,
    imu: Imu,
    tracks: Sequence[dict[str, Track]],
    noise: NoiseModel,
    seed: int,
) -> list[Recording]:
    """Return hand-held recordings as a unit without effects would have them.

    At rest the unit lies in the estimated orientation, under exactly local gravity; in a turn it rotates as measured,
    corrected by what carries gravity from the one orientation exactly to the other. What it puts out is the model
    without effects and noise drawn from the noise model, on the recording's own stamps. What noise the measured rates
    of a turn held is motion to the twin.

    **Arguments:** `shifts` (k, 3): what the data took off each recording's gyroscope output; `tracks`: of each.
    """
    gravity, turns, count = float(data.gravity), data.turns, len(data.poses.mask)
    first, made = 0, []
    for number, (part, samples, shift, track) in enumerate(
        zip(segmentations, data.samples, shifts, tracks, strict=True)
    ):
        signals = part.recording.signals
        force, pose = (
            np.array(values)[: len(signals["accelerometer"])]
            for values in (track["accelerometer"].stimulus.specific_force, track["accelerometer"].observation)
        )
        at_rest = pose < count
        force[at_rest] = gravity * unit_vectors(force[at_rest])
        rate, attitude = (
            np.array(getattr(track["gyroscope"].stimulus, name))[: len(signals["gyroscope"])]
            for name in ("angular_rate", "attitude")
        )
        up = {int(k): force[row] / gravity for k, row in zip(*np.unique(pose, return_index=True), strict=True)}
        for k in range(first, first + len(part.intervals) - 1):
            if turns.mask[k]:
                inside = samples.sample[k][turns.interval[k] > 0]
                rate[inside] += _correction(attitude[inside], up[k + 1], float(turns.interval[k].sum()))
        first += len(part.intervals)
        changed = {}
        for order, ((name, triad), values) in enumerate(zip(imu.triads().items(), (force, rate), strict=True)):
            twin = twin_signal(signals[name], triad, values, getattr(noise, name), [seed, number, order])
            changed[name] = replace(twin, values=twin.values + (shift if name == "gyroscope" else 0.0))
        made.append(replace(part.recording, **changed, notes=()))
    return made


def _correction(attitude: FloatArray, after: FloatArray, duration: float) -> FloatArray:
    """Return the rates (n, 3) that turn gravity's carried direction into the measured one, spread over a turn.

    `attitude` (n, 4) is the body's after each sample, level at the start; to first order a rotation δ of the last frame
    is the sum of the rates' parts brought there.
    """
    matrix = rotation_matrix(attitude)  # body to level
    delta = np.cross(after, matrix[-1].T @ UP)  # turning the frame by δ moves a fixed direction by −δ × u
    # δ in the last frame is R_kᵀ-transported to each sample's own frame
    return np.einsum("nji,jk,k->ni", matrix, matrix[-1], delta) / max(duration, 1e-9)
