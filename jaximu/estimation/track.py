"""The samples along which effects act, and what effects add to a unit's outputs there: one text for every kind of data.

At sample rate, so that effects with a memory see all of the path; averaged over observations afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaximu.ground import stored
from jaximu.ground.array_types import Array, BoolArray, IntArray
from jaximu.ground.differences import interpolated, slopes
from jaximu.ground.tracing import array_module
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.recording import Recording, smoothed_slope

TRIADS = ("accelerometer", "gyroscope")
TEMPERATURE_WINDOW = 20.0
"""Seconds of recorded temperature, whose steps are coarse, that a rate of temperature is taken over."""
_VIBRATION_WINDOW, _QUIETEST = 0.5, 0.1
"""Seconds over which vibration is measured, and the share of a recording, the quietest, that tells its noise."""
_BUCKET = 4096


class Track(eqx.Module):
    """The samples along which effects act: what the unit went through, and the observation that each belongs to.

    Those of no observation have the number of observations, or a larger one.
    """

    stimulus: Stimulus
    observation: Int[Array, "... n"]

    @classmethod
    def padded(cls, stimulus: Stimulus, observation: IntArray, count: int) -> Track:
        """Return a track of `count` observations up to a bucket's length: like shapes share compiled code.

        The last sample is repeated, as one of no observation; the time goes on.
        """
        assert stimulus.time is not None
        time = np.asarray(stimulus.time)
        missing = cls.length(len(time)) - len(time)
        return cls(_longer(stimulus, missing), np.pad(observation, (0, missing), constant_values=count))

    @staticmethod
    def length(samples: int) -> int:
        """Return the next bucket's length beyond so many samples."""
        return samples + _BUCKET - samples % _BUCKET

    def renumbered(self, numbers: IntArray) -> Track:
        """Return the track with other numbers of the observations, the last of them for samples of none."""
        observation = np.minimum(np.asarray(self.observation), len(numbers) - 1)
        return Track(self.stimulus, numbers[observation])

    def inside(self) -> BoolArray:
        """Return which samples (n,) lie before the last one that belongs to an observation: no padding at the end."""
        observation = np.asarray(self.observation)
        return np.arange(len(observation)) <= np.flatnonzero(observation < observation.max())[-1]

    def means(self, values: Float[Array, "... n m"], count: int) -> Float[Array, "count m"]:
        """Return the means over each observation of values at the samples; zero where it has none.

        Values of padding at the end may be left out.
        """
        values = values.reshape(-1, values.shape[-1])
        return means_by(self.observation.reshape(-1)[: len(values)], values, count)[0]


def means_by(observation: Int[Array, " n"], values: Float[Array, "n m"], count: int) -> tuple[Array, Array]:
    """Return the means (count, m) of values over the observations that they belong to, and how many each has."""
    samples = jax.ops.segment_sum(jnp.ones(len(values)), observation, count)
    return jax.ops.segment_sum(values, observation, count) / jnp.maximum(samples, 1.0)[:, None], samples


@partial(stored.compiled, quick=True)
def added(imu: Imu, tracks: Mapping[str, Track]) -> dict[str, Float[Array, "... 3"]]:
    """Return what the unit's effects, its set-up's included, add to the outputs of triads along their tracks, by name.

    Each track says what the unit went through where there are no errors of the set-up.
    """
    outputs, triads = {}, imu.triads()
    for name, track in tracks.items():
        triad, stimulus = triads[name], track.stimulus
        outputs[name] = jnp.zeros_like(getattr(stimulus, triad.quantity))
        if triad.effects or imu.setup:
            whole = triad.respond(imu.acted(stimulus, triad.quantity))
            outputs[name] = whole - replace(triad, effects=()).respond(stimulus)
    return outputs


def mean_outputs(
    tracks: Mapping[str, Track], outputs: Mapping[str, Float[Array, "n 3"]], count: int
) -> Float[Array, "count k"]:
    """Return the mean outputs of triads over each observation, one triad's beside the other's."""

    def means(tracks, outputs):
        return jnp.concatenate([track.means(outputs[name], count) for name, track in tracks.items()], axis=-1)

    return stored.call(means, f"mean outputs {count}", tracks, outputs)


def _longer(stimulus: Stimulus, missing: int) -> Stimulus:
    """Return a stimulus whose last sample is repeated so many times, while the time goes on."""
    numerics, time = array_module(stimulus), stimulus.time
    assert time is not None
    later = time[-1] + numerics.median(numerics.diff(time)) * np.arange(1, missing + 1)
    repeated = jax.tree.map(lambda leaf: numerics.concatenate([leaf, numerics.repeat(leaf[-1:], missing, 0)]), stimulus)
    return replace(repeated, time=numerics.concatenate([time, later]))


class Recorded(eqx.Module):
    """What a recording says of the samples of accelerometer and gyroscope without a unit.

    known: of each triad its stamps and temperatures. real (n,): the accelerometer's samples that are no padding.
    window: samples over which vibration is measured. shaken: whether it stands out; None where nobody needs to know.
    """

    known: dict[str, Stimulus]
    real: Bool[Array, "... n"]
    window: Int[Array, " ..."]
    shaken: Bool[Array, " ..."] | None = None

    @classmethod
    def of(cls, recording: Recording) -> Recorded:
        """Return what a recording of both says."""
        accelerometer, known = recording.accelerometer, {}
        for name in TRIADS:
            time = recording.signals[name].time
            known[name] = Stimulus(time=time)
            if recording.temperature is not None:
                celsius = np.interp(time, recording.temperature.time, recording.temperature.values[:, 0])
                slope = smoothed_slope(time, celsius, TEMPERATURE_WINDOW)
                known[name] = replace(known[name], temperature=celsius, temperature_rate=slope)
        window = np.int64(max(4, accelerometer.samples(_VIBRATION_WINDOW)))
        recorded = cls(known, np.ones(len(accelerometer), bool), window)
        if len(accelerometer) >= 4 * window:
            power = recorded.vibration(accelerometer.si())
            if np.median(power) > 2 * np.quantile(power, _QUIETEST):
                return recorded.asked_for_vibration(stands_out=True)
        return recorded

    def in_session(self, start: float) -> Recorded:
        """Return the same of a recording whose clock was at zero so many seconds after a session began."""
        known = {name: replace(of, session_time=start + self.stamps(name)) for name, of in self.known.items()}
        return replace(self, known=known)

    def asked_for_vibration(self, stands_out: bool = False) -> Recorded:
        """Return the same with vibration among what the unit went through, zero unless it stands out."""
        return self if self.shaken is not None else replace(self, shaken=np.bool_(stands_out))

    def widened(self, lengths: Mapping[str, int]) -> Recorded:
        """Return the same of one unit with padding up to so many samples of each triad."""
        known = {name: _longer(path, lengths[name] - len(self.stamps(name))) for name, path in self.known.items()}
        real = array_module(self).pad(self.real, (0, lengths["accelerometer"] - len(self.real)))
        return replace(self, known=known, real=real)

    def stamps(self, name: str) -> Float[Array, "... n"]:
        """Return a triad's stamps."""
        time = self.known[name].time
        assert time is not None
        return time

    def stimuli(self, force: Float[Array, "n 3"], rate: Float[Array, "m 3"]) -> dict[str, Stimulus]:
        """Return what the unit went through at the samples of each triad, of force and rate at those of their own."""
        sensed, turning = self.stamps("accelerometer"), self.stamps("gyroscope")
        numerics, power, stimuli = array_module(force, self), None, {}
        if self.shaken is not None:
            power = self.vibration(force)
            quiet = numerics.nanquantile(numerics.where(self.real, power, np.nan), _QUIETEST)
            power = (self.shaken * (power - quiet))[:, None]
        for name, known in self.known.items():
            sampled, turned, shaken = force, rate, power
            if name == "accelerometer":
                turned = interpolated(turning, rate, sensed)
            else:
                sampled = interpolated(sensed, force, turning)
                shaken = None if power is None else interpolated(sensed, power, turning)
            stimuli[name] = replace(
                known,
                specific_force=sampled,
                angular_rate=turned,
                angular_acceleration=slopes(turned, self.stamps(name)),
                vibration_power=None if shaken is None else shaken[:, 0],
            )
        return stimuli

    def vibration(self, force: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """Mean square of what is quicker than the window, (m/s²)²."""
        numerics, real = array_module(force, self), self.real[:, None]
        quick = real * (force - _window_means(real * force, self.window))
        return _window_means(numerics.sum(quick**2, axis=1, keepdims=True), self.window)[:, 0]


def stimuli(recording: Recording, imu: Imu) -> dict[str, Stimulus]:
    """Return what the unit went through at the samples of accelerometer and gyroscope, as its outputs tell it.

    Force, rate and its derivative, temperature and its rate, vibration that stands out; no attitude.
    """
    triads, signals = imu.triads(), recording.signals
    force, rate = (triads[name].recover_on_host(signals[name].values) for name in TRIADS)
    return Recorded.of(recording).stimuli(force, rate)


def _window_means(values: Float[Array, "n k"], window: Int[Array, ""]) -> Float[Array, "n k"]:
    """Return the mean over so many samples about each; nothing beyond both ends counts as zero."""
    numerics = array_module(values, window)
    sums = numerics.cumsum(numerics.pad(values, [(1, 0), (0, 0)]), axis=0)
    stop = np.arange(len(values)) + (window + 1) // 2
    first, last = (numerics.clip(edge, 0, len(values)) for edge in (stop - window, stop))
    return (sums[last] - sums[first]) / window
