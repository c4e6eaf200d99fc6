"""What a hand-held unit went through, sample by sample, as its own calibration tells it.

At rest the specific force is the pose's mean and nothing rotates; in between, force and rate are what was measured.
Effects are evaluated along the whole path, at sample rate, so that those with a memory see all of it, and averaged
over poses and integrated over turns afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from jaximu.data.poses_covariance import Sensitivities
from jaximu.ground import stored
from jaximu.ground.array_types import Array, FloatArray
from jaximu.model.effects import Effect
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.observations import Observations
from jaximu.recordings.recording import Recording, Signal, smoothed_slope
from jaximu.recordings.segmentation import Segmentation

__all__ = [
    "TEMPERATURE_WINDOW",
    "Path",
    "Terms",
    "padded",
    "padded_places",
    "paths",
    "react",
    "stimuli",
    "terms",
    "with_effect",
]

TEMPERATURE_WINDOW = 20.0
"""Seconds of recorded temperature, whose steps are coarse, that a rate of temperature is taken over."""
_VIBRATION_WINDOW = 0.5
_BUCKET = 4096


class Path(eqx.Module):
    """The stimulus at the accelerometer's and at the gyroscope's samples of one recording, and whose samples they are.

    Padded at the end, where `…_pose` is P; n accelerometer samples, m of the gyroscope.
    """

    accelerometer: Stimulus
    gyroscope: Stimulus
    accelerometer_pose: Int[Array, " n"]  # the pose a sample belongs to, else P
    gyroscope_pose: Int[Array, " m"]
    turn_sample: Int[Array, "T S"]  # place of each turn's samples among the gyroscope's


@dataclass(frozen=True)
class Terms:
    """What effects add to one recording's outputs: (n, 3) at accelerometer samples, (m, 3) at the gyroscope's."""

    accelerometer: FloatArray
    gyroscope: FloatArray


def paths(
    segmentations: Sequence[Segmentation],
    observations: Observations,
    imu: Imu,
    offsets: Sequence[Terms | None],
    gyroscope_shifts: FloatArray,
    running: FloatArray,
) -> list[Path]:
    """Return the path of each recording as `imu`, without its effects, tells it.

    **Arguments:** `offsets`: what effects add to the outputs, taken off before; `gyroscope_shifts` (k, 3): what the
    observations took off each recording's gyroscope output; `running` (T, S, 4): the turns' rotations,
    sample by sample.
    """
    bare = imu.with_effects()
    found, first, heading = [], 0, np.array([1.0, 0.0, 0.0, 0.0])
    for part, offset, shift in zip(segmentations, offsets, gyroscope_shifts, strict=True):
        path = _path(part, observations, bare, offset, shift, first, running, heading)
        found.append(path)
        first += len(part.intervals)
    return found


def _path(
    part: Segmentation, observations: Observations, imu: Imu, offset, shift, first: int, running, heading
) -> Path:
    recording, intervals = part.recording, part.intervals
    accelerometer, gyroscope = recording.accelerometer, recording.gyroscope
    assert gyroscope is not None and imu.gyroscope is not None
    count = len(observations.poses.mask)
    force = imu.accelerometer.recover_on_host(accelerometer.values - (0.0 if offset is None else offset.accelerometer))
    rate = imu.gyroscope.recover_on_host(gyroscope.values - shift - (0.0 if offset is None else offset.gyroscope))
    pose_a, pose_g = (_pose_of(signal, intervals) for signal in (accelerometer, gyroscope))
    means = np.stack([force[pose_a == k].mean(axis=0) for k in range(len(intervals))])
    rate[pose_g >= 0] = 0.0

    # turns: the k-th sample of turn t, as `observe` cut them
    samples = np.zeros(observations.turns.interval.shape, np.int64)
    used = np.asarray(observations.turns.interval) > 0
    attitude = np.tile(heading, (len(gyroscope), 1))
    now = _levelled(heading, means[0])
    for k in range(len(intervals)):
        attitude[pose_g == k] = now
        turn = first + k
        if k + 1 == len(intervals):
            break
        if turn < len(used) and used[turn].any():
            inside = np.flatnonzero(_between(gyroscope, intervals[k, 1], intervals[k + 1, 0]))
            samples[turn, : len(inside)] = inside
            along = _multiply(now, running[turn, : len(inside)])
            attitude[inside] = along
            now = along[-1]
        now = _levelled(now, means[k + 1])

    def stimulus(signal: Signal, pose: NDArray[np.int64], measured: Stimulus) -> Stimulus:
        assert measured.specific_force is not None and measured.angular_acceleration is not None
        here = np.where(pose[:, None] >= 0, means[np.maximum(pose, 0)], measured.specific_force)
        acceleration = np.array(measured.angular_acceleration)
        acceleration[pose >= 0] = 0.0
        nearest = np.clip(np.searchsorted(gyroscope.time, signal.time - 0.5 / gyroscope.rate), 0, len(gyroscope) - 1)
        return replace(measured, specific_force=here, angular_acceleration=acceleration, attitude=attitude[nearest])

    poses = (pose_a, pose_g)
    both = [stimulus(s, p, m) for (s, m), p in zip(_measured(recording, force, rate), poses, strict=True)]
    places = [padded_places(np.where(pose >= 0, pose + first, count), count) for pose in poses]
    return Path(padded(both[0]), padded(both[1]), places[0], places[1], samples)


def stimuli(recording: Recording, imu: Imu) -> list[tuple[Signal, Stimulus]]:
    """Return accelerometer and gyroscope with what the unit went through at their samples as its outputs tell it.

    Force, rate and its derivative, temperature and its rate, vibration that stands out; no attitude.
    """
    accelerometer, gyroscope = recording.accelerometer, recording.gyroscope
    assert gyroscope is not None and imu.gyroscope is not None
    force = imu.accelerometer.recover_on_host(accelerometer.values)
    rate = imu.gyroscope.recover_on_host(gyroscope.values)
    return _measured(recording, force, rate)


def _measured(recording: Recording, force: FloatArray, rate: FloatArray) -> list[tuple[Signal, Stimulus]]:
    accelerometer, gyroscope = recording.accelerometer, recording.gyroscope
    assert gyroscope is not None
    found = []
    for signal in (accelerometer, gyroscope):
        time = signal.time
        turning = _at(gyroscope.time, rate, time)
        known = Stimulus(_at(accelerometer.time, force, time), turning, np.gradient(turning, time, axis=0), time=time)  # pyright: ignore[reportArgumentType]
        if recording.temperature is not None:
            kelvin = np.interp(time, recording.temperature.time, recording.temperature.values[:, 0])
            slope = smoothed_slope(time, kelvin, TEMPERATURE_WINDOW)
            known = replace(known, temperature=kelvin, temperature_rate=slope)
        vibration = _vibration(accelerometer, force, time)
        found.append((signal, known if vibration is None else replace(known, vibration_power=vibration)))
    return found


def _between(signal: Signal, start: float, stop: float) -> NDArray[np.bool_]:
    return (signal.time >= start) & (signal.time < stop)


def _pose_of(signal: Signal, intervals: FloatArray) -> NDArray[np.int64]:
    """The pose each sample lies in, −1 in between."""
    place = np.searchsorted(intervals[:, 0], signal.time, side="right") - 1
    inside = (place >= 0) & (signal.time < intervals[np.maximum(place, 0), 1])
    return np.where(inside, place, -1)


def _at(time: FloatArray, values: FloatArray, wanted: FloatArray) -> FloatArray:
    if np.array_equal(time, wanted):
        return values.copy()
    return np.stack([np.interp(wanted, time, column) for column in values.T], axis=1)


def _vibration(accelerometer: Signal, force: FloatArray, time: FloatArray) -> FloatArray | None:
    """Mean square of the vibration (n,), (m/s²)², beyond the quietest tenth; None where nothing stands out."""
    width = max(4, round(_VIBRATION_WINDOW * accelerometer.rate))
    if len(force) < 4 * width:
        return None
    kernel = np.ones(width) / width
    smooth = np.stack([np.convolve(axis, kernel, "same") for axis in force.T], axis=1)
    power = np.convolve(np.sum((force - smooth) ** 2, axis=1), kernel, "same")
    floor = np.quantile(power, 0.1)
    return np.interp(time, accelerometer.time, power - floor) if np.median(power) > 2 * floor else None


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


def _length(count: int) -> int:
    return -(-count // _BUCKET) * _BUCKET


def padded(stimulus: Stimulus) -> Stimulus:
    """Repeat the last sample, the time going on, up to a bucket's length: like shapes share compiled code."""
    assert stimulus.time is not None
    time = np.asarray(stimulus.time)
    missing = _length(len(time)) - len(time)
    step = np.median(np.diff(time))

    def pad(leaf):
        return np.concatenate([leaf, np.repeat(leaf[-1:], missing, axis=0)])

    later = np.concatenate([time, time[-1] + step * np.arange(1, missing + 1)])
    return replace(jax.tree.map(pad, stimulus), time=later)


def padded_places(place: NDArray[np.int64], none: int) -> NDArray[np.int64]:
    """Return the observation of each sample (n,) up to a bucket's length; `none` stands for no observation."""
    whole = np.full(_length(len(place)), none)
    whole[: len(place)] = place
    return whole


def with_effect(imu: Imu, effect: Effect, path: Path) -> tuple[Float[Array, "n 3"] | None, Float[Array, "m 3"] | None]:
    """Return the outputs that an effect touches, along a path, of the unit with this effect alone."""
    unit = imu.with_effects(effect)
    assert unit.gyroscope is not None
    force, rate = None, None
    if effect.owner != "gyroscope":
        force = unit.accelerometer.respond(unit.acted(path.accelerometer, "specific_force"))
    if effect.owner != "accelerometer":
        rate = unit.gyroscope.respond(unit.acted(path.gyroscope, "angular_rate"))
    return force, rate


def react(
    force: Float[Array, "n 3"] | None, rate: Float[Array, "m 3"] | None, path: Path, reaction: Sensitivities
) -> Float[Array, " rows"]:
    """Return how the conditions (norms, directions, means at rest) react to small additions to the outputs."""
    poses = reaction.norm.shape[0]

    def means(values, pose):
        count = jax.ops.segment_sum(jnp.ones_like(values[:, 0]), pose, poses + 1)[:poses]
        return jax.ops.segment_sum(values, pose, poses + 1)[:poses] / jnp.maximum(count, 1.0)[:, None]

    norm, turn, rest = jnp.zeros(poses), jnp.zeros((poses - 1, 2)), jnp.zeros((poses, 3))
    if force is not None:
        mean = means(force, path.accelerometer_pose)
        norm = jnp.sum(reaction.norm * mean, axis=-1)
        turn = jnp.einsum("tai,ti->ta", reaction.after, mean[1:]) + jnp.einsum("tai,ti->ta", reaction.before, mean[:-1])
    if rate is not None:
        rest = means(rate, path.gyroscope_pose)
        turn = turn + jnp.einsum("tasi,tsi->ta", reaction.turn, rate[path.turn_sample])
    return jnp.concatenate([norm, turn.reshape(-1), rest.reshape(-1)])


def terms(imu: Imu, path: Path, effects: Sequence[Effect], lengths: tuple[int, int]) -> Terms:
    """Return what the effects add to the outputs along a path, of the lengths given (without the padding)."""
    names = ",".join(effect.name for effect in effects)
    force, rate = stored.call(_terms, f"terms {names}", imu.with_effects(), path, tuple(effects))
    return Terms(np.asarray(force)[: lengths[0]], np.asarray(rate)[: lengths[1]])


def _terms(imu: Imu, path: Path, effects: tuple[Effect, ...]):
    assert imu.gyroscope is not None
    plain = imu.accelerometer.respond(path.accelerometer), imu.gyroscope.respond(path.gyroscope)
    sums = [jnp.zeros_like(each) for each in plain]
    for effect in effects:
        for place, output in enumerate(with_effect(imu, effect, path)):
            if output is not None:
                sums[place] = sums[place] + output - plain[place]
    return tuple(sums)
