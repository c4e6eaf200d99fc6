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
from jaxtyping import Float, Int
from numpy.typing import NDArray

from jaximu.ground import stored
from jaximu.ground.array_types import Array, FloatArray
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.recording import Recording, Signal, smoothed_slope

__all__ = ["TEMPERATURE_WINDOW", "Track", "added", "mean_outputs", "measured", "stimuli"]

TEMPERATURE_WINDOW = 20.0
"""Seconds of recorded temperature, whose steps are coarse, that a rate of temperature is taken over."""
_VIBRATION_WINDOW = 0.5
_BUCKET = 4096


class Track(eqx.Module):
    """The samples along which effects act: what the unit went through, and the observation that each belongs to.

    Those of no observation have the number of observations, or a larger one.
    """

    stimulus: Stimulus
    observation: Int[Array, "... n"]

    @classmethod
    def padded(cls, stimulus: Stimulus, observation: NDArray[np.int64], count: int) -> Track:
        """Return a track of `count` observations up to a bucket's length: like shapes share compiled code.

        The last sample is repeated, as one of no observation; the time goes on.
        """
        assert stimulus.time is not None
        time = np.asarray(stimulus.time)
        missing = _BUCKET - len(time) % _BUCKET  # one or more
        step = np.median(np.diff(time))

        def pad(leaf):
            return np.concatenate([leaf, np.repeat(leaf[-1:], missing, axis=0)])

        later = np.concatenate([time, time[-1] + step * np.arange(1, missing + 1)])
        whole = replace(jax.tree.map(pad, stimulus), time=later)
        return cls(whole, np.pad(observation, (0, missing), constant_values=count))

    def renumbered(self, numbers: NDArray[np.int64]) -> Track:
        """Return the track with other numbers of the observations, the last of them for samples of none."""
        observation = np.minimum(np.asarray(self.observation), len(numbers) - 1)
        return Track(self.stimulus, numbers[observation])

    def inside(self) -> NDArray[np.bool_]:
        """Return which samples (n,) lie before the last one that belongs to an observation: no padding at the end."""
        observation = np.asarray(self.observation)
        return np.arange(len(observation)) <= np.flatnonzero(observation < observation.max())[-1]

    def means(self, values: Float[Array, "... n m"], count: int) -> Float[Array, "count m"]:
        """Return the means over each observation of values at the samples; zero where it has none.

        Values of padding at the end may be left out.
        """
        values = values.reshape(-1, values.shape[-1])
        observation = self.observation.reshape(-1)[: len(values)]
        samples = jax.ops.segment_sum(jnp.ones(len(values)), observation, count)
        return jax.ops.segment_sum(values, observation, count) / jnp.maximum(samples, 1.0)[:, None]


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
    return _mean_outputs(tracks, outputs, np.zeros(count))


@partial(stored.compiled, quick=True)
def _mean_outputs(tracks, outputs, rows):
    return jnp.concatenate([track.means(outputs[name], len(rows)) for name, track in tracks.items()], axis=-1)


def stimuli(recording: Recording, imu: Imu) -> dict[str, Stimulus]:
    """Return what the unit went through at the samples of accelerometer and gyroscope, as its outputs tell it.

    Force, rate and its derivative, temperature and its rate, vibration that stands out; no attitude.
    """
    accelerometer, gyroscope = recording.accelerometer, recording.gyroscope
    assert gyroscope is not None and imu.gyroscope is not None
    force, rate = (
        triad.recover_on_host(signal.values)
        for triad, signal in ((imu.accelerometer, accelerometer), (imu.gyroscope, gyroscope))
    )
    return measured(recording, force, rate)


def measured(recording: Recording, force: FloatArray, rate: FloatArray) -> dict[str, Stimulus]:
    """Return the same of known forces and rates, each at the samples of its own sensor."""
    accelerometer, gyroscope = recording.accelerometer, recording.gyroscope
    assert gyroscope is not None
    known = {}
    for name, time in (("accelerometer", accelerometer.time), ("gyroscope", gyroscope.time)):
        turning = _at(gyroscope.time, rate, time)
        known[name] = Stimulus(
            _at(accelerometer.time, force, time), turning, np.gradient(turning, time, axis=0), time=time,
            vibration_power=_vibration(accelerometer, force, time),
        )  # pyright: ignore[reportArgumentType] # fmt: skip
        if recording.temperature is not None:
            celsius = np.interp(time, recording.temperature.time, recording.temperature.values[:, 0])
            slope = smoothed_slope(time, celsius, TEMPERATURE_WINDOW)
            known[name] = replace(known[name], temperature=celsius, temperature_rate=slope)
    return known


def _at(time: FloatArray, values: FloatArray, wanted: FloatArray) -> FloatArray:
    if np.array_equal(time, wanted):
        return values.copy()
    return np.stack([np.interp(wanted, time, column) for column in values.T], axis=1)


def _vibration(accelerometer: Signal, force: FloatArray, time: FloatArray) -> FloatArray | None:
    """Mean square of the vibration (n,), (m/s²)², beyond the quietest tenth; None where nothing stands out."""
    width = max(4, accelerometer.samples(_VIBRATION_WINDOW))
    if len(force) < 4 * width:
        return None
    kernel = np.ones(width) / width
    smooth = np.stack([np.convolve(axis, kernel, "same") for axis in force.T], axis=1)
    power = np.convolve(np.sum((force - smooth) ** 2, axis=1), kernel, "same")
    floor = np.quantile(power, 0.1)
    return np.interp(time, accelerometer.time, power - floor) if np.median(power) > 2 * floor else None
