"""Rows say what conditions are: which observations they touch, in which unit, when; for every kind of data alike."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from magnetic_motion import turned
from synthetic import GRAVITY, simulated

from jaximu.data.field import FieldConditions, MagneticField, windows_of
from jaximu.data.observe_stations import observe_stations
from jaximu.data.poses import condensed, pose_rows
from jaximu.data.station_error import turntable_error
from jaximu.data.stations import station_rows
from jaximu.estimation.rows import TIME, ResidualKind, Rows
from jaximu.model.sensor import Imu
from jaximu.simulation import simulate
from jaximu.simulation.draw import consumer_noise, draw_imu
from jaximu.simulation.protocols import Positions


def by_hand():
    """Poses and turns: their conditions as a function of the poses' mean outputs."""
    case = simulated(40, poses=10)

    def conditions(change: np.ndarray) -> np.ndarray:
        poses = case.observations.poses
        moved = replace(
            poses,
            accelerometer_mean=poses.accelerometer_mean + change,
            gyroscope_mean=poses.gyroscope_mean + change,
        )
        observations = replace(case.observations, poses=moved)
        lifted = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (case.imu, observations))
        made = condensed(*lifted)
        return np.asarray(jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], made.conditions)(case.imu))

    return pose_rows(case.imu, case.observations), conditions, len(case.observations.poses.mask)


def at_stations():
    """Known poses and turns: their errors as a function of the stations' mean outputs."""
    imu = draw_imu(3)
    recording, truth = simulate(imu, Positions(8, 4.0, 1.0), consumer_noise(), rate=25.0, seed=4)
    stations, _ = observe_stations(recording, truth.schedule, GRAVITY)

    def conditions(change: np.ndarray) -> np.ndarray:
        moved = replace(
            stations,
            accelerometer_mean=stations.accelerometer_mean + change,
            gyroscope_mean=stations.gyroscope_mean + change,
        )
        return np.asarray(turntable_error(imu, moved)).T.ravel()

    return station_rows(imu, stations), conditions, len(stations.turn)


def in_a_field():
    """Windows of a magnetometer: the conditions as a function of each window's field."""
    made = turned(3, duration=20.0)
    windows = windows_of(made.magnetometer, made.recording, np.zeros(3))
    data = MagneticField(windows, made.strength)
    imu = replace(Imu.nominal(), magnetometer=replace(Imu.nominal().accelerometer, quantity="magnetic_field"))
    about = data.about(jax.tree.map(lambda leaf: np.asarray(leaf)[None], imu))
    conditions = jax.tree.map(lambda leaf: leaf[0], about.conditions)
    assert isinstance(conditions, FieldConditions)
    field = np.asarray(conditions.field(imu))
    return data.rows(imu), lambda change: np.asarray(conditions.of(imu, field + change)), len(field)


@pytest.mark.parametrize("kind", [by_hand, at_stations, in_a_field])
def test_what_an_observation_moves_is_what_touches_it(kind):
    """Each observation moved by itself, in a direction that no condition is blind to."""
    rows, conditions, count = kind()
    still = conditions(np.zeros((count, 3)))
    assert len(rows) == len(still)
    np.testing.assert_array_equal(still[~rows.used], 0.0)
    for observation in range(count):
        change = np.zeros((count, 3))
        change[observation] = 1e-3 * np.array([0.31, -0.52, 0.79])
        moved = np.abs(conditions(change) - still) > 1e-12
        np.testing.assert_array_equal(moved, rows.touching([observation]) & rows.used)


@pytest.mark.parametrize("kind", [by_hand, at_stations, in_a_field])
def test_times_lie_in_the_observations_or_between_them(kind):
    real = kind()[0].real()
    time = real.covariates[TIME]
    assert (time > real.spans[real.first, 0]).all()
    following = real.last >= real.first  # the last window's turn leads to the first and is never used
    assert following.all() and (time < real.spans[real.last, 1]).all()


def test_what_is_used_is_what_the_covariance_uses():
    """Both are made of the masks, each by itself: rows and weights must leave out the same."""
    case = simulated(40, poses=10)
    lifted = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (case.imu, case.observations))
    by_covariance = np.asarray(condensed(*lifted).covariance.used)[0] > 0
    np.testing.assert_array_equal(pose_rows(case.imu, case.observations).used, by_covariance)
    assert not by_covariance.all()  # there is padding
    made = turned(3, duration=20.0)
    data = MagneticField(windows_of(made.magnetometer, made.recording, np.zeros(3)), made.strength)
    imu = replace(Imu.nominal(), magnetometer=replace(Imu.nominal().accelerometer, quantity="magnetic_field"))
    about = data.about(jax.tree.map(lambda leaf: np.asarray(leaf)[None], imu))
    np.testing.assert_array_equal(data.rows(imu).used, np.asarray(about.covariance.used)[0] > 0)


def test_errors_are_the_same_in_counts():
    """A gyroscope that puts out counts, 1000 to a rad/s: the rms in SI stays."""
    case = simulated(41, poses=10)
    rows = pose_rows(case.imu, case.observations).real()
    gyroscope = case.imu.gyroscope
    scaled = replace(gyroscope, gain=1000 * np.asarray(gyroscope.gain), bias=1000 * np.asarray(gyroscope.bias))
    turns, poses = case.observations.turns, case.observations.poses
    counts = replace(
        case.observations,
        poses=replace(poses, gyroscope_mean=1000 * poses.gyroscope_mean),
        turns=replace(turns, output=1000 * turns.output),
    )
    in_counts = pose_rows(replace(case.imu, gyroscope=scaled), counts).real()
    conditions = np.random.default_rng(1).standard_normal(len(rows))
    written = np.where(rows.of_kind("static_gyroscope"), 1000.0, 1.0) * conditions
    for name, (rms, unit) in rows.rms(conditions).items():
        assert in_counts.rms(written)[name] == (pytest.approx(rms, rel=1e-12), unit)
    for name, values in rows.covariates.items():
        np.testing.assert_allclose(in_counts.covariates[name], values, rtol=1e-9)


def test_errors_parts_and_dependences():
    """Written out by hand: two kinds, one of vectors whose common offset does not count."""
    kinds = (ResidualKind("one", "one", "m/s^2", 1), ResidualKind("two", "two", "deg/s", 3, 60.0, centred=True))
    rows = Rows(
        kinds=kinds,
        kind=np.array([0, 0, 1, 1, 1, 1, 1, 1, 0]),
        first=np.array([0, 1, 0, 0, 0, 1, 1, 1, 2]),
        last=np.array([0, 2, 0, 0, 0, 1, 1, 1, 2]),
        to_si=np.array([1.0, 1.0, *[0.5] * 6, 1.0]),
        used=np.arange(9) < 8,
        covariates={TIME: np.arange(9.0), "warmth [K]": np.where(np.arange(9) < 2, np.arange(9.0), np.nan)},
        spans=np.array([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]]),
    )
    real = rows.real()
    assert len(real) == 8 and real.used.all()
    errors = real.errors(np.array([1.0, -2.0, 3.0, 4.0, 0.0, 7.0, 4.0, 0.0]))
    np.testing.assert_allclose(errors[0], [1.0, -2.0])
    np.testing.assert_allclose(errors[1], [60.0, 60.0])  # 0.5 (7 − 3) about the mean: 1 each, in 60ths
    assert real.rms(np.zeros(8)) == {"one": (0.0, "m/s^2"), "two": (0.0, "deg/s")}
    assert [part.tolist() for part in real.parts(2)] == [[0, 1], [2]]
    assert real.touching([2]).tolist() == [False, True] + [False] * 6
    assert list(real.dependences(0)) == [TIME, "warmth [K]"] and list(real.dependences(1)) == [TIME]
    np.testing.assert_array_equal(real.dependences(1)[TIME], [2.0, 5.0])
    assert real.describe(1) == "the pose from 2.0 to 3.0 s"
