"""The twin: the recording as the model would have it, along the motion that was estimated, noise included."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from jaximu.data.poses import RecordedByHand
from jaximu.diagnosis.experiment import Experiment, State
from jaximu.ground.array_types import FloatArray
from jaximu.model.noise import Noise
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.processes import FirstOrderGaussMarkov, White
from jaximu.recordings.recording import Recording, Signal

if TYPE_CHECKING:
    from jaximu.diagnosis.diagnosis import Diagnosis

__all__ = ["drawn_noise", "twin_of", "twin_recordings"]


def twin_of(diagnosis: Diagnosis, seed: int = 0) -> Experiment:
    """Return the twin of a diagnosed recording's base fit, ready to be asked what the recording was asked."""
    return diagnosis.experiment.twin(diagnosis.base, diagnosis.noise, seed)


def twin_recordings(recorded: RecordedByHand, state: State, noise: NoiseModel, seed: int) -> list[Recording]:
    """Return hand-held recordings as a fit would have them.

    At rest the unit lies in the estimated orientation, under exactly local gravity; in a turn it rotates as measured,
    corrected by what carries gravity from the one orientation exactly to the other. What it puts out is the base model
    without effects and noise drawn from the noise model, on the recording's own stamps. What noise the measured rates
    of a turn held is motion to the twin.
    """
    first = np.cumsum([0, *(len(part.intervals) for part in recorded.segmentations)])
    return [
        _simulated(recorded, place, int(first[place]), state, noise, seed)
        for place in range(len(recorded.segmentations))
    ]


def _simulated(
    recorded: RecordedByHand, place: int, first: int, state: State, noise: NoiseModel, seed: int
) -> Recording:
    part, observations = recorded.segmentations[place], recorded.observations
    recording, tracks = part.recording, state.linear.details.tracks[place]
    accelerometer, gyroscope = recording.accelerometer, recording.gyroscope
    assert gyroscope is not None and noise.gyroscope is not None and state.imu.gyroscope is not None
    gravity = float(observations.gravity)
    force = np.array(tracks["accelerometer"].stimulus.specific_force)[: len(accelerometer)]
    pose = np.asarray(tracks["accelerometer"].observation)[: len(accelerometer)]
    padded = len(observations.poses.mask)
    at_rest = pose < padded
    force[at_rest] *= gravity / np.linalg.norm(force[at_rest], axis=1, keepdims=True)
    rate = np.array(tracks["gyroscope"].stimulus.angular_rate)[: len(gyroscope)]
    attitude = np.asarray(tracks["gyroscope"].stimulus.attitude)[: len(gyroscope)]
    up = np.zeros((padded, 3))
    for k in range(padded):
        if (pose == k).any():
            up[k] = force[pose == k][0] / gravity
    turns = observations.turns
    for k in range(first, first + len(part.intervals) - 1):
        if np.asarray(turns.mask)[k]:
            inside = recorded.turn_samples[place][k][np.asarray(turns.interval)[k] > 0]
            rate[inside] += _correction(attitude[inside], up[k + 1], float(np.sum(turns.interval[k])))
    drawn = [
        drawn_noise(axis_noise, signal, [seed, place, number])
        for number, (axis_noise, signal) in enumerate(
            ((noise.accelerometer, accelerometer), (noise.gyroscope, gyroscope))
        )
    ]
    outputs = [
        np.asarray(values @ np.asarray(triad.gain).T + np.asarray(triad.bias) + each * signal.nominal_scale)
        for triad, values, each, signal in (
            (state.imu.accelerometer, force, drawn[0], accelerometer),
            (state.imu.gyroscope, rate, drawn[1], gyroscope),
        )
    ]
    return replace(
        recording,
        accelerometer=replace(accelerometer, values=outputs[0]),
        gyroscope=replace(gyroscope, values=outputs[1] + recorded.shifts[place]),
        notes=(),
    )


def _correction(attitude: FloatArray, after: FloatArray, duration: float) -> FloatArray:
    """Return the rates (n, 3) that turn gravity's carried direction into the measured one, spread over a turn.

    `attitude` (n, 4) is the body's after each sample, level at the start; to first order a rotation δ of the last frame
    is the sum of the rates' parts brought there.
    """
    matrix = Rotation.from_quat(attitude, scalar_first=True).as_matrix()  # body to level
    lab = np.array([0.0, 0.0, 1.0])
    carried = matrix[-1].T @ lab
    delta = np.cross(after, carried)  # turning the frame by δ moves a fixed direction by −δ × u
    # δ in the last frame is R_kᵀ-transported to each sample's own frame
    back = np.einsum("nji,jk,k->ni", matrix, matrix[-1], delta)
    return back / max(duration, 1e-9)


def drawn_noise(noise: AxisNoise, signal: Signal, seed: list[int]) -> FloatArray:
    """Return noise (n, 3), SI, on a signal's samples."""
    processes = [White(np.sqrt(noise.white))]
    processes += [
        FirstOrderGaussMarkov.of(np.sqrt(variance), time)
        for variance, time in zip(noise.variance.T, noise.correlation_time, strict=True)
        if variance.any()
    ]
    return np.asarray(Noise(tuple(processes), "specific_force").sample(len(signal), signal.rate, seed))
