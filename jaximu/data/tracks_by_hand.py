"""What a hand-held unit went through, sample by sample, as its own calibration tells it.

At rest the specific force is the pose's mean and nothing rotates; in between, force and rate are what was measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaximu.data.gravity_direction import level
from jaximu.estimation.track import TRIADS, Recorded, Track, means_by
from jaximu.ground import stored
from jaximu.ground.array_types import Array, FloatArray, IntArray
from jaximu.ground.rotation import IDENTITY, UP, multiply
from jaximu.ground.tracing import array_module
from jaximu.model.sensor import Imu
from jaximu.recordings.observations import Observations
from jaximu.recordings.recording import Signal, one_after_another
from jaximu.recordings.segmentation import Segmentation

_NONE = np.iinfo(np.int64).max
"""Stands for the pose or the turn of a sample that is of none, and for a sample that there is not."""


class SamplesByHand(eqx.Module):
    """The samples of one recording by hand, and the poses and turns of its unit that they belong to; padded.

    outputs: of each triad (n, 3), the gyroscope's without what the observations took off it. recorded: what is known of
    them without a unit. pose: of each triad (n,). turn, order (m,): the turn that a sample of the gyroscope lies in and
    where; sample (T, S): where the samples of each turn are among the gyroscope's. nearest: of each triad (n,), the
    gyroscope's sample at the time.
    """

    outputs: dict[str, Float[Array, "... n 3"]]
    recorded: Recorded
    pose: dict[str, Int[Array, "... n"]]
    turn: Int[Array, "... m"]
    order: Int[Array, "... m"]
    sample: Int[Array, "... T S"]
    nearest: dict[str, Int[Array, "... n"]]

    @classmethod
    def of(cls, part: Segmentation, first: int, interval: FloatArray, shift: FloatArray) -> SamplesByHand:
        """Return the samples of a recording whose poses are numbered from `first` on; `interval` (T, S): of all turns.

        **Arguments:** `shift` (3,): what the observations took off the gyroscope's output.
        """
        signals = {name: part.recording.signals[name] for name in TRIADS}
        gyroscope = signals["gyroscope"]
        turn, order = np.full((2, len(gyroscope)), _NONE)
        sample = np.full(interval.shape, _NONE)
        for number, (start, stop) in enumerate(zip(part.intervals[:-1, 1], part.intervals[1:, 0], strict=True), first):
            if (interval[number] > 0).any():
                inside = np.flatnonzero((gyroscope.time >= start) & (gyroscope.time < stop))
                sample[number, : len(inside)] = inside
                turn[inside], order[inside] = number, np.arange(len(inside))
        nearest = {
            name: gyroscope.time.searchsorted(signal.time - 0.5 / gyroscope.rate).clip(0, len(gyroscope) - 1)
            for name, signal in signals.items()
        }
        outputs = {name: signal.values - (shift if name == "gyroscope" else 0.0) for name, signal in signals.items()}
        pose = {name: _pose_of(signal, part.intervals, first) for name, signal in signals.items()}
        whole = cls(outputs, Recorded.of(part.recording), pose, turn, order, sample, nearest)
        return whole.widened({name: Track.length(len(signal)) for name, signal in signals.items()}, *interval.shape)

    def asked_for_vibration(self) -> SamplesByHand:
        """Return the same with vibration among what the unit went through."""
        return replace(self, recorded=self.recorded.asked_for_vibration())

    def lengths(self) -> dict[str, int]:
        """Return how many samples each triad has, padding included."""
        return {name: pose.shape[-1] for name, pose in self.pose.items()}

    def widened(self, lengths: Mapping[str, int], turns: int, samples: int) -> SamplesByHand:
        """Return the same of one unit with padding up to so many samples, and so many turns of so many samples."""
        numerics = array_module(self)

        def longer(values, name="gyroscope", none=False):
            missing = [(0, lengths[name] - len(values)), *[(0, 0)] * (np.ndim(values) - 1)]
            how = {"constant_values": _NONE} if none else {"mode": "edge"}
            return numerics.pad(values, missing, **how)

        sample = self.sample[:turns, :samples]
        missing = [(0, wanted - have) for wanted, have in zip((turns, samples), sample.shape, strict=True)]
        sample = numerics.pad(sample, missing, constant_values=_NONE)
        return type(self)(
            {name: longer(values, name) for name, values in self.outputs.items()},
            self.recorded.widened(lengths),
            {name: longer(values, name, none=True) for name, values in self.pose.items()},
            longer(self.turn, none=True),
            longer(self.order, none=True),
            sample,
            {name: longer(values, name) for name, values in self.nearest.items()},
        )


def during_turns(values: Float[Array, "m 3"], sample: Int[Array, "T S"]) -> Float[Array, "T S 3"]:
    """Return values at the gyroscope's samples turn by turn, which are where `sample` says; zero for none."""
    return jnp.asarray(values).at[sample].get(mode="fill", fill_value=0.0)


def samples_by_hand(segmentations: Sequence[Segmentation], observations: Observations) -> tuple[SamplesByHand, ...]:
    """Return the samples of each recording that poses and turns were cut from."""
    interval, first, samples = np.asarray(observations.turns.interval), 0, []
    for part, shift in zip(segmentations, rest_shifts(segmentations), strict=True):
        samples.append(SamplesByHand.of(part, first, interval, shift))
        first += len(part.intervals)
    if starts := one_after_another([part.recording for part in segmentations]):
        samples = [
            replace(of, recorded=of.recorded.in_session(start)) for of, start in zip(samples, starts, strict=True)
        ]
    return tuple(samples)


def rest_shifts(segmentations: Sequence[Segmentation]) -> FloatArray:
    """Return the difference (k, 3) of each recording's gyroscope output at rest to the first recording's.

    The observations have it taken off.
    """
    middles = []
    for part in segmentations:
        signal = part.recording.signals["gyroscope"]
        means = [signal.values[(signal.time >= a) & (signal.time < b)].mean(axis=0) for a, b in part.intervals]
        middles.append(np.median(means, axis=0))
    return np.array(middles) - middles[0]


@partial(stored.compiled, quick=True)
def tracks_by_hand(imu: Imu, samples: SamplesByHand, running: Float[Array, "T S 4"]) -> dict[str, Track]:
    """Return the tracks of both triads in a recording, whose observations are the poses, as `imu` tells them.

    **Arguments:** `imu`: its effects are not looked at; `samples`: without what effects add; `running`: the turns'
    rotations, sample by sample.
    """
    poses, pose = len(running) + 1, samples.pose
    triads = imu.with_effects().triads()
    force, rate = (triads[name].recover(samples.outputs[name]) for name in TRIADS)
    means, counts = means_by(pose["accelerometer"], force, poses)
    rate = jnp.where((pose["gyroscope"] < poses)[:, None], 0.0, rate)
    attitudes = _attitudes(means, counts > 0, running[:, -1])

    before = jnp.minimum(pose["gyroscope"], samples.turn)  # the pose that a sample lies in, or the one before its turn
    attitude = attitudes.at[before].get(mode="fill", fill_value=0.0)
    turned = running.at[samples.turn, samples.order].get(mode="fill", fill_value=0.0)
    attitude = multiply(attitude, jnp.where(samples.turn[:, None] < poses, turned, IDENTITY))
    attitude = jnp.where(before[:, None] < poses, attitude, IDENTITY)
    tracks = {}
    for name, known in samples.recorded.stimuli(force, rate).items():
        assert known.specific_force is not None and known.angular_acceleration is not None
        at_rest = pose[name][:, None] < poses
        of_pose = means.at[pose[name]].get(mode="fill", fill_value=0.0)
        stimulus = replace(
            known,
            specific_force=jnp.where(at_rest, of_pose, known.specific_force),
            angular_acceleration=jnp.where(at_rest, 0.0, known.angular_acceleration),
            attitude=attitude[samples.nearest[name]],
        )
        tracks[name] = Track(stimulus, pose[name])
    return tracks


def _pose_of(signal: Signal, intervals: FloatArray, first: int) -> IntArray:
    """The pose each sample lies in."""
    pose = intervals[:, 0].searchsorted(signal.time, side="right") - 1
    inside = (pose >= 0) & (signal.time < intervals[np.maximum(pose, 0), 1])
    return np.where(inside, first + pose, _NONE)


def _attitudes(force: Float[Array, "P 3"], real: Array, turned: Float[Array, "T 4"]) -> Float[Array, "P 4"]:
    """The attitude in each pose that is real: carried over the turn from the one before, and levelled by its force."""

    def step(carried, pose):
        force, real, turned = pose
        attitude = level(carried, jnp.where(real, force, UP))
        return jnp.where(real, multiply(attitude, turned), IDENTITY), attitude

    return jax.lax.scan(step, IDENTITY, (force, real, jnp.concatenate([turned, IDENTITY[None]])))[1]
