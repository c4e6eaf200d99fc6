"""Mechanisation, pre-integration and noise through both, against closed forms and independent integrations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st
from jax.flatten_util import ravel_pytree
from scipy.spatial.transform import Rotation

from jaximu import InputError, LocalGravity
from jaximu.data.preintegration import preintegrate_samples
from jaximu.model import BiasInstability, RandomConstant, RandomWalk, White
from jaximu.model.effects import CATALOGUE
from jaximu.model.sensor import Imu
from jaximu.navigation import (
    Navigation,
    deviation,
    increments,
    linearised,
    mechanise,
    mechanise_increments,
    noise_covariance,
    preintegrate,
)
from jaximu.navigation.trajectory import Place, level_driving
from jaximu.simulation import draw_imu

EARTH = 7.292115e-5  # rad/s
SEMI_MAJOR, SEMI_MINOR = 6378137.0, 6356752.3142  # m
EQUATOR, POLE = 9.7803253359, 9.8321849378  # m/s²; NIMA TR8350.2, table 3.4

integrated = jax.jit(preintegrate_samples)
moving = jax.jit(mechanise, static_argnames="every")


def gravity_on_ellipsoid(latitude):
    """Somigliana's formula as TR8350.2 states it first, by the two half axes and the gravity at equator and pole."""
    c, s = np.cos(latitude) ** 2, np.sin(latitude) ** 2
    return (SEMI_MAJOR * EQUATOR * c + SEMI_MINOR * POLE * s) / np.sqrt(SEMI_MAJOR**2 * c + SEMI_MINOR**2 * s)


def start_of(latitude, attitude=(1.0, 0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0), height=0.0):
    return Navigation.at(np.array(attitude), np.array(velocity), latitude, height, gravity_on_ellipsoid(latitude))


def at_rest(latitude, count, interval, attitude=None):
    attitude = attitude or Rotation.identity()
    earth = EARTH * np.array([0.0, np.cos(latitude), np.sin(latitude)])
    rate = np.tile(attitude.inv().apply(earth), (count, 1))
    force = np.tile(attitude.inv().apply([0.0, 0.0, gravity_on_ellipsoid(latitude)]), (count, 1))
    return rate, force, np.full(count, interval)


@pytest.mark.parametrize("latitude", [-70.0, 0.0, 45.0])
def test_a_unit_at_rest_stays_where_it_is(latitude):
    attitude = Rotation.from_rotvec([0.3, -1.0, 2.0])
    rate, force, intervals = at_rest(np.radians(latitude), 6000, 0.1, attitude)
    start = start_of(np.radians(latitude), attitude.as_quat(scalar_first=True))
    end = moving(start, *increments(rate, force, intervals), intervals, every=6000)
    error = np.asarray(deviation(jax.tree.map(lambda leaf: leaf[0], end), start))
    assert np.abs(error[:3]).max() < 1e-3 and np.abs(error[6:]).max() < 1e-9


def test_a_tilt_swings_at_schulers_period():
    # to the north at the equator, where the Earth's rotation couples least: (Ω/ω)² = 0.35 %
    rate, force, intervals = at_rest(0.0, 5100, 1.0)
    bias = 1e-3
    vectors = increments(rate, force + [0.0, bias, 0.0], intervals)
    reference = moving(start_of(0.0), *increments(rate, force, intervals), intervals)
    found = np.asarray(deviation(mechanise(start_of(0.0), *vectors, intervals), reference))[:, 1]
    meridian = SEMI_MINOR**2 / SEMI_MAJOR
    frequency = np.sqrt(EQUATOR / meridian)
    expected = bias / frequency**2 * (1 - np.cos(frequency * np.arange(1, 5101)))
    assert np.abs(found - expected).max() < 0.01 * expected.max()


def motion(time):
    """Rate (rad/s) and force (m/s²) that no axis is spared of, smooth in time."""
    rate = np.stack([0.4 * np.sin(1.1 * time), 0.3 * np.cos(0.7 * time) - 0.1, 0.2 * np.sin(0.4 * time + 1)], axis=-1)
    force = np.stack([3 * np.sin(0.5 * time), 2 * np.cos(0.9 * time), 9.5 + np.sin(1.3 * time)], axis=-1)
    return rate, force


def samples(duration, interval):
    """The motion's means over samples, by Gauss's quadrature."""
    count = round(duration / interval)
    nodes, weights = np.polynomial.legendre.leggauss(5)
    time = interval * (np.arange(count)[:, None] + (nodes + 1) / 2)
    rate, force = motion(time)
    return *(np.einsum("tni,n->ti", each, weights / 2) for each in (rate, force)), np.full(count, interval)


def test_a_path_agrees_with_an_integration_in_the_frame_fixed_to_the_earth():
    latitude, height, velocity, duration = 0.8, 500.0, np.array([120.0, -60.0, 3.0]), 60.0

    def to_earth(latitude, longitude):
        east = [-np.sin(longitude), np.cos(longitude), 0.0]
        up = [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
        return np.stack([east, np.cross(up, east), up], axis=1)

    squared = 1 - SEMI_MINOR**2 / SEMI_MAJOR**2

    def geodetic(place):
        radius = np.hypot(*place[:2])
        found = np.arctan2(place[2], radius)
        for _ in range(8):
            across = SEMI_MAJOR / np.sqrt(1 - squared * np.sin(found) ** 2)
            found = np.arctan2(place[2] + squared * across * np.sin(found), radius)
        return found, np.arctan2(place[1], place[0]), radius / np.cos(found) - across

    flattening = 1 - SEMI_MINOR / SEMI_MAJOR
    ratio = EARTH**2 * SEMI_MAJOR**2 * SEMI_MINOR / 3.986004418e14

    def gravity(latitude, height):
        along = 1 + flattening + ratio - 2 * flattening * np.sin(latitude) ** 2
        return gravity_on_ellipsoid(latitude) * (1 - 2 * along * height / SEMI_MAJOR + 3 * (height / SEMI_MAJOR) ** 2)

    spin = np.array([0.0, 0.0, EARTH])

    def slope(time, state):
        place, speed, quaternion = state[:3], state[3:6], state[6:]
        phi, longitude, h = geodetic(place)
        rate, force = motion(time)
        body = Rotation.from_quat(quaternion, scalar_first=True)
        pull = to_earth(phi, longitude) @ [0.0, 0.0, -gravity(phi, h)]
        change = body.apply(force) + pull - 2 * np.cross(spin, speed)
        relative = rate - body.inv().apply(spin)
        w, v = quaternion[0], quaternion[1:]
        turned = np.concatenate([[-v @ relative], w * relative + np.cross(v, relative)]) / 2
        return np.concatenate([speed, change, turned])

    across = SEMI_MAJOR / np.sqrt(1 - squared * np.sin(latitude) ** 2)
    place = [(across + height) * np.cos(latitude), 0.0, (across * (1 - squared) + height) * np.sin(latitude)]
    frame = to_earth(latitude, 0.0)
    begin = np.concatenate([place, frame @ velocity, Rotation.from_matrix(frame).as_quat(scalar_first=True)])
    end = scipy.integrate.solve_ivp(slope, (0, duration), begin, method="DOP853", rtol=1e-12, atol=1e-9).y[:, -1]

    start = Navigation.at(np.array([1.0, 0, 0, 0]), velocity, latitude, height, gravity(latitude, height))
    rate, force, intervals = samples(duration, 0.01)
    found = moving(start, *increments(rate, force, intervals), intervals, every=len(intervals))
    phi, longitude, h = geodetic(end[:3])
    frame = to_earth(phi, longitude)
    attitude = Rotation.from_matrix(frame.T) * Rotation.from_quat(end[6:], scalar_first=True)
    truth = Navigation(attitude.as_quat(scalar_first=True), frame.T @ end[3:6], phi, longitude, h, 0.0)
    error = np.asarray(deviation(jax.tree.map(lambda leaf: leaf[0], found), jax.tree.map(jnp.asarray, truth)))
    assert np.abs(error[:3]).max() < 5e-4  # m, after a fall of 17 km
    assert np.abs(error[3:6]).max() < 2e-5
    assert np.abs(error[6:]).max() < 3e-8


def test_draws_side_by_side_are_those_one_by_one():
    rate, force, intervals = samples(2.0, 0.01)
    several = rate + 1e-3 * np.random.default_rng(0).standard_normal((4, 1, 3))
    start = start_of(0.5)
    lanes = jnp.broadcast_to(intervals, (4, len(intervals)))
    together = moving(start, *increments(several, jnp.broadcast_to(force, several.shape), lanes), intervals, every=100)
    assert together.velocity.shape == (4, 2, 3)
    for lane in range(4):
        alone = moving(start, *increments(several[lane], force, intervals), intervals, every=100)
        np.testing.assert_allclose(together.velocity[lane], alone.velocity, atol=1e-10)
        np.testing.assert_allclose(together.attitude[lane], alone.attitude, atol=1e-12)


def test_increments_of_a_second_stand_for_their_samples():
    imu, (rate, force, intervals) = draw_imu(3), samples(6.0, 0.01)
    output = (
        force @ imu.accelerometer.gain.T + imu.accelerometer.bias,
        rate @ imu.gyroscope.gain.T + imu.gyroscope.bias,
    )
    numbers, restore = ravel_pytree(imu)
    changes = 1e-4 * np.random.default_rng(2).standard_normal((3, len(numbers)))
    stretches = jax.jit(jax.vmap(lambda f, w, h: preintegrate(imu, f, w, h)))(
        *(each.reshape(6, 100, 3) for each in output), intervals.reshape(6, 100)
    )
    moved = stretches.moved(changes[:, None])
    start = start_of(0.5, velocity=(30.0, -20.0, 5.0))
    found = mechanise_increments(start, moved.rotation, moved.velocity, moved.displacement, stretches.duration)
    for place, change in enumerate(changes):
        felt = restore(numbers + change).recover(*output)
        end = moving(start, *increments(felt[1], felt[0], intervals), intervals, every=100)
        error = np.asarray(deviation(jax.tree.map(lambda leaf, place=place: leaf[place], found), end))
        assert np.abs(error[:, :3]).max() < 5e-4  # m; the draws scatter by 20 mm
        assert np.abs(error[:, 6:]).max() < 1e-5


def test_the_error_model_is_the_derivative_of_the_path():
    rate, force, intervals = samples(3.0, 0.01)
    start = start_of(0.5, velocity=(30.0, -200.0, 5.0))
    transition, reaction = linearised(start, *increments(rate, force, intervals), intervals)
    changes = 1e-6 * np.random.default_rng(1).standard_normal((len(rate), 6))
    reference = moving(start, *increments(rate, force, intervals), intervals, every=len(rate))
    moved = moving(
        start, *increments(rate + changes[:, :3], force + changes[:, 3:], intervals), intervals, every=len(rate)
    )
    error = np.zeros(9)
    for matrix, push, change in zip(np.asarray(transition), np.asarray(reaction), changes, strict=True):
        error = matrix @ error + push @ change
    found = np.asarray(deviation(moved, reference))[0]
    np.testing.assert_allclose(found, error, atol=2e-3 * np.abs(error).max(), rtol=1e-2)


@pytest.mark.parametrize(("process", "expected"), [
    (White(0.02), lambda t: (0.02**2 * t**3 / 3, 0.02**2 * t)),
    (RandomWalk(0.02), lambda t: (0.02**2 * t**5 / 20, 0.02**2 * t**3 / 3)),
    (RandomConstant(0.02), lambda t: (0.02**2 * t**4 / 4, 0.02**2 * t**2)),
])  # fmt: skip
def test_noise_integrated_twice_has_its_closed_form(process, expected):
    interval, count = 0.01, 1000
    step = np.array([[1.0, interval], [0.0, 1.0]])
    push = np.zeros((2, 3))
    push[:, 0] = interval**2 / 2, interval
    system = type(process)(np.full(3, float(next(iter(vars(process).values()))))).system(interval)
    variances, whole = noise_covariance(np.tile(step, (count, 1, 1)), np.tile(push, (count, 1, 1)), system)
    np.testing.assert_allclose(variances[-1], expected(interval * count), rtol=5e-3)
    np.testing.assert_allclose(np.diagonal(whole), variances[-1], rtol=1e-12)


def test_flicker_integrated_twice_is_that_of_its_samples():
    interval, count = 0.1, 300
    system = BiasInstability(np.full(3, 1.0)).system(interval)
    push = np.zeros((count, 2, 3))
    push[:, :, 1] = interval**2 / 2, interval
    step = np.tile(np.array([[1.0, interval], [0.0, 1.0]]), (count, 1, 1))
    _, covariance = noise_covariance(step, push, system)
    # the covariance of the samples by brute force: the response of each sample to each draw
    state, rows = np.asarray(system.root)[1], []
    drawn = np.zeros((len(state), 0))
    for _ in range(count):
        rows.append(np.concatenate([system.output[1] @ state, system.output[1] @ drawn, system.through[1]]))
        state = system.transition[1] @ state
        drawn = np.concatenate([system.transition[1] @ drawn, system.drive[1]], axis=1)
    response = np.zeros((count, len(rows[-1])))
    for place, row in enumerate(rows):
        response[place, : len(row)] = row
    velocity = interval * np.cumsum(response, axis=0)
    position = np.sum(interval * (velocity - interval * response / 2), axis=0)
    end = np.stack([position, velocity[-1]])
    np.testing.assert_allclose(covariance, end @ end.T, rtol=1e-9)


@given(st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3), st.lists(st.floats(-20, 20), min_size=3, max_size=3))
def test_a_steady_motion_is_preintegrated_exactly(rate, force):
    count, interval = 50, 0.01
    found = integrated(np.tile(rate, (count, 1)), np.tile(force, (count, 1)), np.full(count, interval))
    time = count * interval
    turn = np.array([[0, -rate[2], rate[1]], [rate[2], 0, -rate[0]], [-rate[1], rate[0], 0]])
    flow = scipy.linalg.expm(time * np.block([[turn, np.array(force)[:, None]], [np.zeros((1, 4))]]))
    np.testing.assert_allclose(found.velocity, flow[:3, 3], atol=1e-12)
    np.testing.assert_allclose(
        Rotation.from_quat(found.rotation, scalar_first=True).as_matrix(), flow[:3, :3], atol=1e-12
    )
    assert float(found.duration) == pytest.approx(time)


def test_a_motion_is_preintegrated_with_coning_and_sculling():
    rate, force, intervals = samples(2.0, 0.01)
    found = preintegrate_samples(rate, force, intervals)

    def slope(time, state):
        rate, force = motion(time)
        body = Rotation.from_quat(state[:4], scalar_first=True)
        w, v = state[0], state[1:4]
        turned = np.concatenate([[-v @ rate], w * rate + np.cross(v, rate)]) / 2
        return np.concatenate([turned, body.apply(force), state[4:7]])

    begin = np.eye(10)[0]
    end = scipy.integrate.solve_ivp(slope, (0, 2.0), begin, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(found.rotation, end[:4], atol=2e-7)  # the ends are taken as rests, and are none
    np.testing.assert_allclose(found.velocity, end[4:7], atol=3e-6)
    np.testing.assert_allclose(found.displacement, end[7:], atol=1e-4)  # h²/12 of how much the force changes


def unit_with_effects():
    return draw_imu(3).with_effects(
        CATALOGUE["gyro.g_sensitivity"].make(1e-4), CATALOGUE["accel.quadratic"].make(1e-4),
        CATALOGUE["gyro.quadratic"].make(1e-3),
    )  # fmt: skip


def error_of(found, base):
    turned = Rotation.from_quat(base.rotation, scalar_first=True).inv() * Rotation.from_quat(
        found.rotation, scalar_first=True
    )
    moved = (
        np.asarray(getattr(found, each)) - np.asarray(getattr(base, each)) for each in ("velocity", "displacement")
    )
    return np.concatenate([turned.as_rotvec(), *moved])


def test_increments_react_to_samples_and_to_every_number_of_the_unit():
    rate, force, intervals = samples(1.0, 0.02)
    base = integrated(rate, force, intervals)
    for place in (1, 17, 45):  # at the very ends coning has a neighbour less
        for column in range(6):
            change = np.zeros((len(rate), 6))
            change[place, column] = 1e-5
            moved = integrated(rate + change[:, :3], force + change[:, 3:], intervals)
            # a sample's part in the coning of its neighbours is left out: some thousandths of its own
            expected = np.asarray(base.reaction)[place, :, column] * 1e-5
            np.testing.assert_allclose(error_of(moved, base), expected, atol=5e-3 * np.abs(expected).max())

    imu = unit_with_effects()
    output = (force + 0.1, rate + 0.02)
    found = preintegrate(imu, *output, intervals)
    numbers, restore = ravel_pytree(imu)
    assert found.parameters.shape == (9, len(numbers))
    preintegrated = jax.jit(lambda numbers: preintegrate(restore(numbers), *output, intervals))
    for place in range(len(numbers)):
        size = 1e-5 * max(1.0, float(abs(numbers[place])))
        ends = [preintegrated(numbers.at[place].add(sign * size)) for sign in (1, -1)]
        slope = error_of(*ends) / (2 * size)
        np.testing.assert_allclose(found.parameters[:, place], slope, atol=5e-4 * max(1.0, np.abs(slope).max()))


def test_a_unit_without_gyroscope_is_refused():
    with pytest.raises(InputError, match="gyroscope"):
        preintegrate(Imu(draw_imu(0).accelerometer, None), np.zeros((5, 3)), np.zeros((5, 3)), np.full(5, 0.01))


def test_level_driving_is_the_path_that_it_says():
    path = level_driving(Place(45.0, 0.0, LocalGravity(9.80665, 0.0)), 60.0)
    vectors = increments(*map(jnp.asarray, (path.stimulus.angular_rate, path.stimulus.specific_force, path.intervals)))
    state = moving(path.start, *vectors, path.intervals, path.every)
    velocity = np.asarray(state.velocity)
    assert np.abs(velocity[:4]).max() < 1e-4  # at rest
    np.testing.assert_allclose(velocity[20], [0.0, 15.0, 0.0], atol=5e-3)  # north
    np.testing.assert_allclose(velocity[-1], [-15.0, 0.0, 0.0], atol=2e-2)  # after a turn to the left
    assert path.times[0] == 1.0 and path.times[-1] == 60.0
