"""Tracks: means over observations, padding, and what effects add along them for every kind of data."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jaximu.data.field import FieldSamples
from jaximu.estimation.track import Track, added, mean_outputs
from jaximu.model.effects import CATALOGUE
from jaximu.model.sensor import Imu, Triad
from jaximu.model.stimulus import Stimulus

RANDOM = np.random.default_rng(5)


def stimulus_of(count: int) -> Stimulus:
    force, rate = RANDOM.normal(size=(2, count, 3))
    return Stimulus(9.8 * force, rate, time=0.01 * np.arange(count))


def test_means_are_those_of_each_observations_samples():
    observation, values = np.array([2, 0, 3, 0, 2, 5]), RANDOM.normal(size=(6, 3))
    track = Track(stimulus_of(6), observation)
    wanted = [values[[1, 3]].mean(axis=0), np.zeros(3), values[[0, 4]].mean(axis=0)]
    np.testing.assert_allclose(track.means(values, 3), wanted)
    np.testing.assert_allclose(mean_outputs({"gyroscope": track}, {"gyroscope": values}, 3), wanted)
    pairs = Track(track.stimulus, observation.reshape(3, 2))  # samples in rows of windows
    np.testing.assert_allclose(pairs.means(values.reshape(3, 2, 3), 3), wanted)


def test_padding_is_of_no_observation_and_its_values_may_be_left_out():
    known, values = stimulus_of(5), RANDOM.normal(size=(5, 3))
    track = Track.padded(known, np.array([0, 0, 1, 2, 1]), 2)
    length = len(track.observation)
    assert length > 5 and all(leaf.shape[0] == length for leaf in jax.tree.leaves(track))
    assert (np.diff(track.stimulus.time) > 0).all() and (
        track.stimulus.specific_force[5:] == known.specific_force[4]
    ).all()
    wanted = [values[:2].mean(axis=0), values[[2, 4]].mean(axis=0)]
    whole = np.concatenate([values, np.full((length - 5, 3), 1e3)])
    for given in (values, whole):
        np.testing.assert_allclose(track.means(given, 2), wanted)


def test_other_numbers_leave_samples_of_none_without_one():
    track = Track(stimulus_of(4), np.array([0, 1, 7, 2]))
    assert track.renumbered(np.array([4, 5, 9])).observation.tolist() == [4, 5, 9, 9]


@pytest.mark.parametrize(
    ("names", "touched"),
    [
        (["accel.quadratic"], {"accelerometer"}),
        (["gyro.g_sensitivity"], {"gyroscope"}),
        (["accel.quadratic", "gyro.quadratic", "setup.table_tilt"], {"accelerometer", "gyroscope"}),
    ],
)
def test_what_effects_add_is_the_output_with_them_less_that_without(names, touched):
    effects = [CATALOGUE[name].make(np.linspace(1e-3, 2e-3, CATALOGUE[name].size)) for name in names]
    quaternion = RANDOM.normal(size=(7, 4))
    stimulus = replace(stimulus_of(7), attitude=quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))
    tracks = {name: Track(stimulus, np.zeros(7, int)) for name in ("accelerometer", "gyroscope")}
    unit = Imu.nominal((1.1, 0.9, 1.0), gyroscope_scale=(2.0, 1.0, 0.5)).with_effects(*effects)
    outputs = added(unit, tracks)
    whole, plain = unit.respond(stimulus), unit.with_effects().respond(stimulus)
    for name, output, without in zip(tracks, whole, plain, strict=True):
        np.testing.assert_allclose(outputs[name], output - without, atol=1e-13)
        assert np.any(outputs[name]) == (name in touched)


def test_samples_of_a_magnetometer_are_joined_as_windows_of_their_own():
    """Recordings whose windows differ in length, one of them without a temperature."""

    def samples(windows, size, full, **known):
        time, rate = RANDOM.normal(size=(windows, size)).cumsum(axis=1), RANDOM.normal(size=(windows, size, 3))
        observation = np.where(np.arange(size) < full[:, None], np.arange(windows)[:, None], windows)
        track = Track(Stimulus(time=time, angular_rate=rate, **known), observation)
        output, turned = 40 * RANDOM.normal(size=(windows, size, 3)), RANDOM.normal(size=(windows, size, 3, 3))
        return FieldSamples(output, turned, track)

    first = samples(2, 3, np.array([3, 2]), temperature=np.full((2, 3), 20.0))
    other = samples(3, 5, np.array([5, 4, 5]))
    whole = FieldSamples.joined([first, other])
    assert whole.track.stimulus.temperature is None and whole.output.shape == (5, 5, 3)
    unit = replace(Imu.nominal(), magnetometer=Triad(np.eye(3), np.zeros(3), quantity="magnetic_field"))
    unit = unit.with_effects(CATALOGUE["mag.lag"].make([0.02, 0.03, 0.01]))
    apart = np.concatenate([np.asarray(each.mean_added(unit)) for each in (first, other)])
    assert np.abs(apart).max() > 0
    np.testing.assert_allclose(whole.mean_added(unit), apart, atol=1e-12)
