"""Every effect against its physics, derived here anew in NumPy and SciPy from the definition, not from the code."""

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace

import equinox as eqx
import jax
import numpy as np
import pytest
from known_effects import DEMANDED
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from jaximu.model.effects import CATALOGUE
from jaximu.model.sensor import Imu, Triad
from jaximu.model.stimulus import Stimulus

G = 9.81
EARTH = 2 * np.pi / 86164.0905  # rad/s: one turn in a sidereal day
QUANTITY = {"accel": "specific_force", "gyro": "angular_rate"}
BOTH = pytest.mark.parametrize("prefix", QUANTITY)

term = eqx.filter_jit(lambda effect, true: effect.term(true))
act = eqx.filter_jit(lambda effect, true, quantity: effect.act(true, quantity))
respond = eqx.filter_jit(Triad.respond)
remembered = eqx.filter_jit(Triad.memory)


def make(name, coefficients, **inner):
    """An effect whose numbers are arrays, so that another value does not compile anew."""
    kind = CATALOGUE[name]
    full = np.broadcast_to(np.asarray(coefficients, float), (kind.size,))
    return kind(full, **{key: np.asarray(value, float) for key, value in inner.items()})


def added(name, coefficients, inner=None, **fields):
    return np.asarray(term(make(name, coefficients, **(inner or {})), Stimulus(**fields)))


def triad(prefix, *effects, gain=None, bias=None):
    """A triad that is far from a unit one, unless told."""
    gain = np.array([[1.1, 0.02, -0.03], [0.04, 0.9, 0.05], [-0.06, 0.07, 1.2]]) if gain is None else gain
    bias = np.array([0.3, -0.2, 0.1]) if bias is None else bias
    return Triad(gain, bias, effects, quantity=QUANTITY[prefix])


# Loops over samples and axes ------------------------------------------------------------------------------------------

FIRST, SECOND = (1, 2, 0), (2, 0, 1)  # the products yz, zx, xy


def along(function):
    """A term that treats each axis alike: c_i times a function of the sample and the axis."""
    return 3, lambda c, s: [c[i] * function(s, i) for i in range(3)]


def rows(c, columns):
    return [[c[columns * i + j] for j in range(columns)] for i in range(3)]


def below_diagonal(c, s):
    return [0.0, c[0] * s.warmth * s.u[0], c[1] * s.warmth * s.u[0] + c[2] * s.warmth * s.u[1]]


def off_diagonal(c, s):
    others = {0: (1, 2), 1: (0, 2), 2: (0, 1)}
    return [sum(c[2 * i + n] * s.warmth * s.u[j] for n, j in enumerate(others[i])) for i in range(3)]


def products(c, s):
    return [sum(rows(c, 3)[i][k] * s.u[FIRST[k]] * s.u[SECOND[k]] for k in range(3)) for i in range(3)]


BY_HAND = {
    "temperature": along(lambda s, i: s.warmth),
    "temperature_squared": along(lambda s, i: s.warmth * s.warmth),
    "temperature_cubed": along(lambda s, i: s.warmth * s.warmth * s.warmth),
    "temperature_rate": along(lambda s, i: s.warming),
    "temperature_rate_squared": along(lambda s, i: s.warming * s.warming),
    "temperature_times_rate": along(lambda s, i: s.warmth * s.warming),
    "scale_temperature": along(lambda s, i: s.warmth * s.u[i]),
    "bias_ramp": along(lambda s, i: s.elapsed),
    "scale_ramp": along(lambda s, i: s.elapsed * s.u[i]),
    "warm_up": along(lambda s, i: math.exp(-s.elapsed / 47.0)),
    "step": along(lambda s, i: 1.0 if s.elapsed >= 8.0 else 0.0),
    "scale_step": along(lambda s, i: s.u[i] if s.elapsed >= 8.0 else 0.0),
    "vibration_rectification": along(lambda s, i: s.power),
    "quadratic": along(lambda s, i: s.u[i] * s.u[i]),
    "cubic": along(lambda s, i: s.u[i] * s.u[i] * s.u[i]),
    "asymmetry": along(lambda s, i: s.u[i] if s.u[i] > 0 else -s.u[i]),
    "cross_coupling": (9, products),
}
PER_TRIAD = {f"{prefix}.{name}": hand for name, hand in BY_HAND.items() for prefix in QUANTITY} | {
    "accel.misalignment_temperature": (3, below_diagonal),
    "gyro.misalignment_temperature": (6, off_diagonal),
    "gyro.g_sensitivity": (9, lambda c, s: [sum(rows(c, 3)[i][j] * s.f[j] for j in range(3)) for i in range(3)]),
    "gyro.g_squared_sensitivity": along(lambda s, i: s.f[i] * s.f[i]),
}
INNER = {"warm_up": {"time_constant": 47.0}, "step": {"onset": 8.0}, "scale_step": {"onset": 8.0}}


@pytest.mark.parametrize("name", PER_TRIAD)
def test_sample_by_sample(name):
    random = np.random.default_rng(20)
    prefix, _, short = name.partition(".")
    size, hand = PER_TRIAD[name]
    coefficients = random.standard_normal(size)
    true = Stimulus(
        specific_force=G * random.uniform(-1, 1, (6, 3)),
        angular_rate=random.uniform(-4, 4, (6, 3)),
        temperature=random.uniform(-20, 60, 6),
        temperature_rate=random.uniform(-0.1, 0.1, 6),
        time=np.array([0.5, 4.0, 9.0, 10.5, 12.0, 40.0]),  # a step 8 s after 2.5 s has come at 10.5 s
        vibration_power=random.uniform(0, 5, 6),
        temperature_reference=21.5,
        time_reference=2.5,
    )
    assert CATALOGUE[name].size == size
    found = np.asarray(term(make(name, coefficients, **INNER.get(short, {})), true))
    for k in range(6):
        sample = SimpleNamespace(
            u=getattr(true, QUANTITY[prefix])[k],
            f=true.specific_force[k],
            warmth=true.temperature[k] - 21.5,
            warming=true.temperature_rate[k],
            elapsed=true.time[k] - 2.5,
            power=true.vibration_power[k],
        )
        np.testing.assert_allclose(found[k], hand(coefficients, sample), rtol=1e-13, atol=1e-15)


def test_loops_and_physics_leave_no_effect_out():
    physics = {"size_effect", "lever_arm", "thermal_lag", "thermal_hysteresis", "lag", "dead_band", "earth_rotation",
               "time_offset", "reference_delay", "clock_scale", "table_tilt", "table_axis", "table_rate_scale",
               "gravity", "hard_iron_step", "current", "field_disturbance"}  # fmt: skip
    # what else is in the catalogue is held to the laws of `test_effects` and `test_sensor`
    assert {name for name in DEMANDED if name.partition(".")[2] not in physics and name != "mag.temperature"} == set(
        PER_TRIAD
    )


# What terms of one sample mean ----------------------------------------------------------------------------------------


@BOTH
def test_gain_over_temperature(prefix):
    """Scale and misalignment over temperature are another gain matrix at every temperature."""
    random = np.random.default_rng(21)
    places = {"accel": [(1, 0), (2, 0), (2, 1)], "gyro": [(0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)]}[prefix]
    change = np.diag(random.uniform(-1e-3, 1e-3, 3))
    for i, j in places:
        change[i, j] = random.uniform(-1e-3, 1e-3)
    effects = (
        make(f"{prefix}.scale_temperature", np.diag(change)),
        make(f"{prefix}.misalignment_temperature", [change[i, j] for i, j in places]),
    )
    sensor = triad(prefix, *effects)
    value, temperature = random.standard_normal((5, 3)), np.array([-10.0, 10.0, 25.0, 40.0, 70.0])
    output = respond(sensor, Stimulus(**{QUANTITY[prefix]: value, "temperature": temperature}))
    for k in range(5):
        gain = np.asarray(sensor.gain) + (temperature[k] - 25.0) * change
        np.testing.assert_allclose(output[k], gain @ value[k] + sensor.bias, rtol=1e-13)


@BOTH
def test_asymmetry_is_another_gain_for_each_sense(prefix):
    gain, difference = np.array([2.0, 3.0, 4.0]), np.array([0.1, -0.2, 0.3])
    sensor = triad(prefix, make(f"{prefix}.asymmetry", difference), gain=np.diag(gain), bias=np.zeros(3))
    output = respond(sensor, Stimulus(**{QUANTITY[prefix]: np.array([[1.0, 2.0, 3.0], [-1.0, -2.0, -3.0]])}))
    np.testing.assert_allclose(output[0], (gain + difference) * [1.0, 2.0, 3.0], rtol=1e-14)
    np.testing.assert_allclose(output[1], (gain - difference) * [-1.0, -2.0, -3.0], rtol=1e-14)


def test_even_effects_leave_a_mean_of_opposite_poses_and_odd_ones_do_not():
    force = np.array([[3.0, -5.0, 8.0], [-3.0, 5.0, -8.0]])
    for name, even in (("quadratic", True), ("asymmetry", True), ("cross_coupling", True), ("cubic", False)):
        size = CATALOGUE[f"accel.{name}"].size
        both = added(f"accel.{name}", np.arange(1.0, size + 1), specific_force=force)
        np.testing.assert_array_equal(both[0], both[1] if even else -both[1])


def test_cross_coupling_is_that_of_a_pendulum_which_swings_aside():
    """A pendulum that swings by k f_i turns its sensing axis by that: it feels f_i cos(k f_i) + f_p sin(k f_i).

    To first order in k, f_p along the pendulum, this is f_i + k f_i f_p, the rest a quarter for half of k.
    """
    force = G * np.random.default_rng(22).uniform(-1, 1, (6, 3))
    pendulous = (1, 2, 0)  # for x the product xy, which stands third; for y yz, first; for z zx, second
    position = (2, 0, 1)
    errors = []
    for k in (2e-3, 1e-3):
        coefficients = np.zeros((3, 3))
        coefficients[range(3), position] = k
        found = force + added("accel.cross_coupling", coefficients.ravel(), specific_force=force)
        angle = k * force
        exact = force * np.cos(angle) + force[:, pendulous] * np.sin(angle)
        errors.append(np.abs(found - exact).max())
        assert errors[-1] < 0.02 * np.abs(exact - force).max()
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.02)


@BOTH
def test_vibration_is_rectified_by_an_even_nonlinearity(prefix):
    """c u² of u = A sin(νt) averages to c A²/2 over whole periods, and A²/2 is the mean square."""
    amplitude, coefficients = np.array([3.0, 0.0, 4.0]), np.array([2e-3, 5e-3, -1e-3])
    time = np.linspace(0, 1, 4000, endpoint=False)
    vibration = amplitude * np.sin(2 * np.pi * 40 * time)[:, None]
    mean = added(f"{prefix}.quadratic", coefficients, **{QUANTITY[prefix]: vibration}).mean(axis=0)
    np.testing.assert_allclose(mean, coefficients * amplitude**2 / 2, atol=1e-16)
    for axis in (0, 2):
        alone = np.eye(3)[axis] * coefficients
        power = np.mean(vibration[:, axis] ** 2)
        found = added(f"{prefix}.vibration_rectification", alone, vibration_power=np.array(power))
        np.testing.assert_allclose(found, np.eye(3)[axis] * mean, atol=1e-15)


@BOTH
def test_biases_over_time(prefix):
    time = np.array([0.0, 10.0, 20.0, 30.0, 40.0, 50.0])
    sensor = triad(prefix, make(f"{prefix}.warm_up", [1.0, 2.0, -3.0], time_constant=10.0))
    still = Stimulus(**{QUANTITY[prefix]: np.zeros((6, 3))}, time=time)
    output = respond(sensor, still) - np.asarray(sensor.bias)
    np.testing.assert_allclose(output, np.outer(np.exp(-np.arange(6.0)), [1.0, 2.0, -3.0]), rtol=1e-13)
    # a first-order decay: what is lost in any time is in proportion to what was there
    decay = solve_ivp(lambda t, x: -x / 10.0, (0, 50), [1.0], t_eval=time, rtol=1e-11, atol=1e-13).y[0]
    np.testing.assert_allclose(output[:, 0], decay, atol=1e-9)
    ramp = np.asarray(respond(triad(prefix, make(f"{prefix}.bias_ramp", [1e-3, 0.0, -2e-3])), still))
    np.testing.assert_allclose(np.diff(ramp, axis=0), np.tile([1e-2, 0.0, -2e-2], (5, 1)), atol=1e-14)
    step = respond(triad(prefix, make(f"{prefix}.step", [1.0, -2.0, 0.0], onset=20.0)), still) - sensor.bias
    np.testing.assert_allclose(step, np.outer([0, 0, 1, 1, 1, 1], [1.0, -2.0, 0.0]), atol=1e-15)


def test_a_dead_band_stops_what_is_slower_before_gain_and_bias():
    rate = np.array([[0.0, 0.01, -0.01], [0.0199, -0.0199, 0.02], [0.5, -0.021, 0.03], [-0.04, 0.04, -0.0301]])
    sensor = triad("gyro", make("gyro.dead_band", [0.02, 0.02, 0.03]))
    passed = np.array([[0, 0, 0], [0, 0, 0], [0.5, -0.021, 0.03], [-0.04, 0.04, -0.0301]])  # at the threshold: awake
    expected = [np.asarray(sensor.gain) @ each + sensor.bias for each in passed]
    np.testing.assert_allclose(respond(sensor, Stimulus(angular_rate=rate)), expected, rtol=1e-14)
    np.testing.assert_array_equal(added("gyro.dead_band", 0.0, angular_rate=rate), 0.0)


# Motion of a rigid body -----------------------------------------------------------------------------------------------


def difference(function, at, order, step=0.015):
    """First or second derivative of a function of time by differences of eighth order.

    Nine values determine a polynomial of eighth degree, whose derivative in the middle is taken.
    """
    places = np.arange(-4, 5)
    aim = np.zeros(9)
    aim[order] = math.factorial(order)
    weights = np.linalg.solve(np.vander(places, increasing=True).T, aim)
    return (
        sum(weight * function(at + place * step) for weight, place in zip(weights, places, strict=True)) / step**order
    )


def waves(seed, size=3, frequency=3.0):
    """A smooth function of time (n,) -> (n, size): four sinusoids of up to `frequency` rad/s; and its derivatives."""
    random = np.random.default_rng([23, seed])
    amplitude, phase = random.uniform(-1, 1, (4, size)), random.uniform(0, 6, (4, size))
    rate = frequency * np.array([0.3, 0.5, 0.8, 1.0])[:, None]

    def value(time, derivative=0):
        angle = rate * np.asarray(time)[..., None, None] + phase + derivative * np.pi / 2
        return np.sum(rate**derivative * amplitude * np.sin(angle), axis=-2)

    return value


def orientation(time):
    """Attitude of the body (n, 3, 3), body to level: a tumbling that visits large angles."""
    turn = Rotation.from_rotvec(0.9 * waves(1)(time)) * Rotation.from_euler("ZYX", 0.7 * waves(2)(time))
    return turn.as_matrix()


def turning(attitude, time):
    """Body rate and its derivative from attitude matrices alone: [ω]× = Rᵀ Ṙ, and its derivative Rᵀ R̈ + Ṙᵀ Ṙ."""
    first, second = difference(attitude, time, 1), difference(attitude, time, 2)
    back = np.swapaxes(attitude(time), 1, 2)

    def vector(skew):
        return np.stack([skew[:, 2, 1] - skew[:, 1, 2], skew[:, 0, 2] - skew[:, 2, 0], skew[:, 1, 0] - skew[:, 0, 1]])

    return vector(back @ first).T / 2, vector(back @ second + np.swapaxes(first, 1, 2) @ first).T / 2


TIME = np.linspace(1.0, 7.0, 6)


def felt(place):
    """Specific force at a place (m, body frame) of a body that flies about and tumbles, in the body frame."""

    def position(time):
        return 2.0 * waves(3)(time) + orientation(time) @ place

    lifted = difference(position, TIME, 2) + [0.0, 0.0, G]
    return np.einsum("kji,kj->ki", orientation(TIME), lifted)


def test_rates_of_the_tumbling_body():
    """The tools of this file against a coning motion in closed form, so that they can be believed below."""
    cone, spin, time = 0.4, 2.0, np.array([0.3, 1.1])
    vector = lambda t: cone * np.stack([np.cos(spin * t), np.sin(spin * t), 0 * t], axis=-1)  # noqa: E731
    rate, acceleration = turning(lambda t: Rotation.from_rotvec(vector(t)).as_matrix(), time)
    across = spin * np.sin(cone)
    flat = np.stack([-np.sin(spin * time), np.cos(spin * time), 0 * time], axis=-1)
    np.testing.assert_allclose(rate, across * flat + [0, 0, -spin * (1 - np.cos(cone))], atol=1e-11)
    inward = -np.stack([np.cos(spin * time), np.sin(spin * time), 0 * time], axis=-1)
    np.testing.assert_allclose(acceleration, across * spin * inward, atol=1e-9)


def test_lever_arm_is_the_force_at_another_point_of_the_body():
    arm, origin = np.array([0.11, -0.23, 0.31]), felt(np.zeros(3))
    rate, acceleration = turning(orientation, TIME)
    sensor = triad("accel", make("accel.lever_arm", arm))
    true = Stimulus(specific_force=origin, angular_rate=rate, angular_acceleration=acceleration)
    expected = felt(arm) @ np.asarray(sensor.gain).T + sensor.bias
    assert np.abs(felt(arm) - origin).max() > 0.5
    np.testing.assert_allclose(respond(sensor, true), expected, atol=1e-8)


def test_size_effect_is_the_force_at_each_accelerometer():
    arms, origin = np.array([[0.11, -0.23, 0.31], [-0.07, 0.13, 0.05], [0.02, 0.17, -0.19]]), felt(np.zeros(3))
    rate, acceleration = turning(orientation, TIME)
    sensor = triad("accel", make("accel.size_effect", arms.ravel()))
    true = Stimulus(specific_force=origin, angular_rate=rate, angular_acceleration=acceleration)
    sensed = np.stack([felt(arms[axis])[:, axis] for axis in range(3)], axis=1)
    np.testing.assert_allclose(respond(sensor, true), sensed @ np.asarray(sensor.gain).T + sensor.bias, atol=1e-8)
    common = added("accel.size_effect", np.tile(arms[0], 3), angular_rate=rate, angular_acceleration=acceleration)
    alone = added("accel.lever_arm", arms[0], angular_rate=rate, angular_acceleration=acceleration)
    np.testing.assert_allclose(common, alone, atol=1e-14)


def test_size_effect_has_the_sign_of_positions_which_a_correction_subtracts():
    """Points of a turning body, differentiated twice; then what PSINS' `imuclbt` subtracts, (ω̇× + ω×ω×) r, restores."""
    arms, step, time = np.diag([0.01, 0.05, 0.06]) + 0.02, 1e-3, np.array([0.3, 0.7])
    axis, swing = np.array([0.6, 0.0, 0.8]), 0.9  # about one axis by swing·sin t

    def place(t, arm):
        angle = swing * np.sin(t)
        return arm * np.cos(angle) + np.cross(axis, arm) * np.sin(angle) + axis * (axis @ arm) * (1 - np.cos(angle))

    def sensed(t, k):
        second = (place(t + step, arms[k]) - 2 * place(t, arms[k]) + place(t - step, arms[k])) / step**2
        return np.dot(second, place(t, np.eye(3)[k]))  # along the sensor's own axis in the room

    expected = np.array([[sensed(t, k) for k in range(3)] for t in time])
    rate, acceleration = swing * np.cos(time)[:, None] * axis, -swing * np.sin(time)[:, None] * axis
    found = added("accel.size_effect", arms.ravel(), angular_rate=rate, angular_acceleration=acceleration)
    np.testing.assert_allclose(found, expected, atol=1e-7)

    def cross(vector):
        return np.cross(np.eye(3), vector)  # rows are those of vector×

    subtracted = [[(cross(a) + cross(w) @ cross(w))[k] @ arms[k] for k in range(3)]
                  for w, a in zip(rate, acceleration, strict=True)]  # fmt: skip
    np.testing.assert_allclose(subtracted, expected, atol=1e-7)


def test_lever_arm_on_a_rate_table():
    """Even turning: ω² r towards the axis; starting up: ω̇ r along the way, against it what stands still."""
    rate, acceleration = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 5.0]])
    found = added("accel.lever_arm", [0.2, 0.0, 0.7], angular_rate=rate, angular_acceleration=acceleration)
    np.testing.assert_allclose(found, [[-9 * 0.2, 0, 0], [0, 5 * 0.2, 0]], atol=1e-15)


@pytest.mark.parametrize("latitude", [47.4, -33.0])
def test_earth_rotation_is_the_rate_against_inertial_space_less_that_against_the_ground(latitude):
    """The level frame (x east, y north, z up) rides on an Earth that turns; the body tumbles in it."""
    north, east = np.radians([latitude, 8.5])
    ground = Rotation.from_euler("ZX", [east + np.pi / 2, np.pi / 2 - north])
    np.testing.assert_allclose(ground.apply([1.0, 0, 0]), [-np.sin(east), np.cos(east), 0], atol=1e-15)
    outward = [np.cos(north) * np.cos(east), np.cos(north) * np.sin(east), np.sin(north)]
    np.testing.assert_allclose(ground.apply([0, 0, 1.0]), outward, atol=1e-15)

    def inertial(time):
        return (Rotation.from_euler("Z", EARTH * time[:, None]) * ground).as_matrix() @ orientation(time)

    against_ground, against_stars = turning(orientation, TIME)[0], turning(inertial, TIME)[0]
    attitude = Rotation.from_matrix(orientation(TIME)).as_quat(scalar_first=True)
    turned = CATALOGUE["gyro.earth_rotation"].typical * np.array([0.0, np.cos(north), np.sin(north)])
    found = added("gyro.earth_rotation", turned, attitude=attitude)
    # differences of a tumbling of some rad/s are good to 1e-12 rad/s
    np.testing.assert_allclose(found, against_stars - against_ground, atol=5e-12)
    sensor = triad("gyro", make("gyro.earth_rotation", turned))
    output = respond(sensor, Stimulus(angular_rate=against_ground, attitude=attitude))
    np.testing.assert_allclose(output, against_stars @ np.asarray(sensor.gain).T + sensor.bias, atol=1e-11)
    np.testing.assert_allclose(added("gyro.earth_rotation", turned, attitude=-attitude), found, atol=1e-20)


def test_earth_rotation_in_known_places():
    """Level and facing north at the pole: all about the vertical; at the equator: all about north."""
    level = np.array([1.0, 0.0, 0.0, 0.0])
    facing_east = Rotation.from_euler("Z", -np.pi / 2).as_quat(scalar_first=True)  # the body's y axis points east
    np.testing.assert_allclose(added("gyro.earth_rotation", [0, 0, EARTH], attitude=level), [0, 0, EARTH], atol=1e-20)
    equator = added("gyro.earth_rotation", [0, EARTH, 0], attitude=facing_east)
    np.testing.assert_allclose(equator, [-EARTH, 0, 0], atol=1e-19)  # its x axis then points south
    assert CATALOGUE["gyro.earth_rotation"].typical == pytest.approx(EARTH, rel=1e-6)


@pytest.mark.parametrize("late", ["delay", "filter"])
def test_lag_is_a_delay_to_first_order(late):
    """A late sampling and a first-order low-pass of the same group delay; what is left is a quarter for half of it."""
    time, frequency, amplitude = np.linspace(0, 1, 6), np.array([4.0, 9.0, 15.0]), np.array([2.0, -1.0, 0.5])

    def rate(time, derivative=0):
        return amplitude * frequency**derivative * np.sin(np.outer(time, frequency) + 0.3 + derivative * np.pi / 2)

    def really(lags):
        if late == "delay":
            return amplitude * np.sin(np.outer(time, frequency) + 0.3 - lags * frequency)
        shift = frequency * lags  # 1 / (1 + iντ) of each sinusoid, once its start is forgotten
        return amplitude / np.hypot(1, shift) * np.sin(np.outer(time, frequency) + 0.3 - np.arctan(shift))

    errors = []
    for lags in (np.array([2e-3, 1e-3, 3e-3]), np.array([1e-3, 0.5e-3, 1.5e-3])):
        change = added("gyro.lag", lags, angular_acceleration=rate(time, 1))
        errors.append(np.abs(rate(time) + change - really(lags)).max(axis=0))
        assert np.all(errors[-1] < 0.05 * np.abs(really(lags) - rate(time)).max(axis=0))
    np.testing.assert_allclose(errors[0] / errors[1], 4, rtol=0.05)


# Thermal memory -------------------------------------------------------------------------------------------------------

STAMPS = np.array([0.0, 3.0, 3.5, 11.0, 60.0, 61.0, 140.0, 142.0, 200.0, 330.0, 331.0, 400.0])
WARMTH = np.array([0.0, 4.0, -3.0, 10.0, 12.0, 12.0, -15.0, 20.0, 5.0, 6.0, -7.0, 1.0])


def follow(temperature, times, start, lag):
    """Solve τ x' = T(t) − x through the times, one piece after the other, so that no kink lies inside of one."""
    states = [start]
    for before, after in itertools.pairwise(times):
        piece = solve_ivp(
            lambda t, x: (temperature(t) - x) / lag, (before, after), states[-1:], "DOP853", rtol=1e-12, atol=1e-13
        )
        states.append(piece.y[0, -1])
    return np.array(states)


@BOTH
@pytest.mark.parametrize("lag", [1.5, 40.0, 3000.0])
def test_thermal_lag_solves_its_equation_at_irregular_stamps(prefix, lag):
    coefficients = np.array([1.0, -2.0, 0.5])
    found = added(f"{prefix}.thermal_lag", coefficients, {"time_constant": lag}, temperature=25 + WARMTH, time=STAMPS)
    state = follow(lambda t: np.interp(t, STAMPS, WARMTH), STAMPS, WARMTH[0], lag)
    np.testing.assert_allclose(found, np.outer(state, coefficients), atol=1e-9)


def test_the_square_of_a_thermal_lag_is_one():
    lagged = added("accel.thermal_lag", 1.0, {"time_constant": 40.0}, temperature=25 + WARMTH, time=STAMPS)
    squared = added("accel.thermal_lag_squared", 2.0, {"time_constant": 40.0}, temperature=25 + WARMTH, time=STAMPS)
    np.testing.assert_allclose(squared, 2 * lagged**2, atol=1e-13)


def test_thermal_lag_converges_for_a_smooth_temperature():
    """A curve taken linear between samples: the error falls to a quarter with twice the samples."""

    def temperature(t):
        return 8 * np.sin(t / 60) + 5 * np.cos(t / 23)

    errors = []
    for count in (41, 81, 161):
        time = np.linspace(0, 400, count)
        found = added("gyro.thermal_lag", 1.0, {"time_constant": 30.0}, temperature=25 + temperature(time), time=time)
        coarse = np.linspace(0, 400, 41)
        exact = follow(temperature, coarse, temperature(0.0), 30.0)
        errors.append(np.abs(found[:: (count - 1) // 40, 0] - exact).max())
    assert errors[0] < 0.1
    np.testing.assert_allclose([errors[0] / errors[1], errors[1] / errors[2]], 4, rtol=0.1)


@BOTH
def test_limits_of_a_thermal_lag(prefix):
    def lagged(lag, temperature):
        return added(f"{prefix}.thermal_lag", 1.0, {"time_constant": lag}, temperature=temperature, time=STAMPS)

    prompt = added(f"{prefix}.temperature", 1.0, temperature=25 + WARMTH)
    steepest = np.abs(np.diff(WARMTH) / np.diff(STAMPS)).max()
    for lag in (1e-3, 1e-6):
        error = np.abs(lagged(lag, 25 + WARMTH) - prompt).max()
        assert 0.5 * lag * steepest < error < 1.01 * lag * steepest
    # on a ramp it ends up τ Ṫ behind, from zero at the start
    ramp = 30 + 0.05 * STAMPS
    behind = 5 + 0.05 * STAMPS - 0.05 * 9.0 * (1 - np.exp(-STAMPS / 9.0))
    np.testing.assert_allclose(lagged(9.0, ramp)[:, 1], behind, atol=1e-12)
    np.testing.assert_allclose(lagged(9.0, ramp)[-1], ramp[-1] - 25 - 9.0 * 0.05, atol=1e-12)
    # what never warms stays where it was
    np.testing.assert_allclose(lagged(1e9, 25 + WARMTH), WARMTH[0], atol=1e-5)
    np.testing.assert_allclose(lagged(7.0, np.full(12, 31.0)), 6.0, atol=1e-13)


def played(warmth, half_width):
    """The play operator step by step: a piston of this half-width pushed about by the temperature."""
    position, path = warmth[0], []
    for value in warmth:
        if value - position > half_width:
            position = value - half_width
        elif position - value > half_width:
            position = value + half_width
        path.append(position)
    return np.array(path)


@BOTH
@pytest.mark.parametrize("half_width", [0.3, 2.0, 9.0])
def test_hysteresis_is_a_play(prefix, half_width):
    random, coefficients = np.random.default_rng(24), np.array([1.0, -2.0, 0.5])
    warmth = np.cumsum(random.normal(0, 3, (3, 40)), axis=1)
    inner = {"half_width": half_width}
    found = added(f"{prefix}.thermal_hysteresis", coefficients, inner, temperature=25 + warmth)
    for path, each in zip(warmth, found, strict=True):
        np.testing.assert_allclose(each, np.outer(played(path, half_width), coefficients), atol=1e-13)


def test_hysteresis_knows_no_rate():
    """Samples put in between, however many, change nothing as long as the temperature turns at the same values."""
    random = np.random.default_rng(25)
    turns = np.cumsum(random.normal(0, 4, 14))
    dense, kept = [turns[0]], [0]
    for k in range(13):
        between = np.sort(random.uniform(0, 1, 2))
        dense.extend(turns[k] + (turns[k + 1] - turns[k]) * np.array([*between, 1.0]))
        kept.append(len(dense) - 1)
    dense = np.array(dense)
    assert len(dense) == 40
    inner = {"half_width": 1.7}
    fine = added("accel.thermal_hysteresis", 1.0, inner, temperature=np.tile(25 + dense, (3, 1)))[0]
    coarse = added("accel.thermal_hysteresis", 1.0, inner, temperature=np.tile(25 + turns, (3, 1)))[0]
    np.testing.assert_allclose(fine[kept], coarse, atol=1e-13)


@BOTH
def test_loop_of_a_hysteresis(prefix):
    """Between ±A the loop is a parallelogram 2 w wide and 2 (A − w) high; as w goes to zero it closes."""
    once = np.concatenate([np.arange(0, 10, 0.5), np.arange(10, -10, -0.5), np.arange(-10, 0, 0.5)])
    warmth = np.concatenate([once, once, [0.0]])  # the second time round it has forgotten where it began

    def loop(half_width):
        inner = {"half_width": half_width}
        return added(f"{prefix}.thermal_hysteresis", [1.0, 0.0, -3.0], inner, temperature=25 + warmth)

    def area(x, y):
        return np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) / 2

    second = slice(len(once), None)
    for half_width in (1.0, 2.5, 6.0):
        found = loop(half_width)
        expected = 4 * half_width * (10 - half_width)
        assert area(warmth[second], found[second, 0]) == pytest.approx(expected, rel=1e-12)
        assert area(warmth[second], found[second, 2]) == pytest.approx(-3 * expected, rel=1e-12)
    np.testing.assert_allclose(loop(1e-9)[:, 0], warmth, atol=1.01e-9)
    np.testing.assert_allclose(loop(30.0)[:, 0], warmth[0], atol=1e-15)


@pytest.mark.parametrize(("prefix", "cuts"), [("accel", (4, 8)), ("gyro", (1, 2))])
def test_a_path_in_parts_is_the_path(prefix, cuts):
    """What the sensor remembers at the end of one part carries on in the next; without it the next part is off."""
    random = np.random.default_rng(26)
    sensor = triad(
        prefix,
        make(f"{prefix}.thermal_lag", [1e-2, -2e-2, 3e-2], time_constant=35.0),
        make(f"{prefix}.thermal_hysteresis", [3e-2, 1e-2, -2e-2], half_width=3.0),
        make(f"{prefix}.quadratic", [1e-3, 1e-3, 1e-3]),
    )
    true = Stimulus(
        **{QUANTITY[prefix]: random.standard_normal((2, 12, 3))},
        temperature=25 + np.stack([WARMTH, np.cumsum(random.normal(0, 5, 12))]),
        time=np.stack([STAMPS, 100 + np.cumsum(random.uniform(1, 60, 12))]),
    )
    whole = np.asarray(respond(sensor, true))
    kept = {f"{prefix}.thermal_lag": 3, f"{prefix}.thermal_hysteresis": 1}
    nothing = {name: np.full((2, count), np.nan) for name, count in kept.items()}  # what says that nothing was before
    memory, parts, forgetful = nothing, [], []
    for start, stop in zip((0, *cuts), (*cuts, 12), strict=True):
        piece = jax.tree.map(lambda leaf, a=start, b=stop: leaf[:, a:b], true)
        forgetful.append(respond(sensor, replace(piece, memory=nothing)))
        piece = replace(piece, memory=memory)
        parts.append(respond(sensor, piece))
        memory = remembered(sensor, piece)
        assert {name: value.shape for name, value in memory.items()} == {name: (2, kept[name]) for name in kept}
    np.testing.assert_allclose(np.concatenate(parts, axis=1), whole, atol=1e-14)
    assert np.abs(np.concatenate(forgetful, axis=1) - whole).max() > 1e-3


# Time -----------------------------------------------------------------------------------------------------------------

BAND = 12.0  # rad/s, the quickest motion of the paths below
SHIFTED = {"specific_force": 3, "angular_rate": 3, "angular_acceleration": 3, "temperature": 1, "temperature_rate": 1,
           "vibration_power": 1}  # fmt: skip


def motion(time):
    """Everything a sensor goes through, as functions of time alone."""
    fields = {field: waves(seed, size, BAND)(time) for seed, (field, size) in enumerate(SHIFTED.items(), 10)}
    fields = {field: value if SHIFTED[field] == 3 else value[..., 0] for field, value in fields.items()}
    attitude = Rotation.from_rotvec(0.5 * waves(20, 3, BAND)(time)).as_quat(scalar_first=True)
    return Stimulus(**fields, attitude=attitude, time=time)


def assert_close(found, expected, allowed, inner):
    for field in (*SHIFTED, "attitude"):
        error = np.abs(getattr(found, field) - getattr(expected, field))[inner]
        assert error.max() < allowed, field


STEP, COUNT = 0.01, 120
PATH = 5.0 + STEP * np.arange(COUNT)
THIRD = 4 * BAND**3  # a bound on the third derivative of waves: four sinusoids of amplitude one
# A cubic through two values and two slopes, which central differences get wrong by h²/6 u''', is off by
# x (1 − x) (1 − 2x) h³/6 u''', at most 0.0962 of h³/6 u'''; half as much again for the orders above
INTERPOLATION = 1.5 * 0.0962 / 6 * STEP**3 * THIRD


@pytest.mark.parametrize("shift", [0.0021, -0.0079, 0.034, -0.0563])
@pytest.mark.parametrize("name", ["setup.time_offset", "setup.reference_delay"])
def test_shifted_stamps_show_the_motion_of_another_time(name, shift):
    """A gyroscope stamped late by δ shows at t what was at t − δ; a reference stamped late shows it what is to come."""
    true, inner = motion(PATH), slice(8, -8)
    sign = {"setup.time_offset": -1, "setup.reference_delay": 1}[name]
    found = act(make(name, shift), true, "angular_rate")
    assert_close(found, motion(PATH + sign * shift), INTERPOLATION, inner)
    np.testing.assert_array_equal(found.time, PATH)
    # far above the tolerance, so that a wrong sign shows
    assert np.abs(found.angular_rate - true.angular_rate)[inner].max() > 20 * INTERPOLATION
    accelerometer = act(make(name, shift), true, "specific_force")
    moved = PATH + shift if name == "setup.reference_delay" else PATH
    assert_close(accelerometer, motion(moved), INTERPOLATION, inner)


@pytest.mark.parametrize("fast", [3e-3, -4e-3])
def test_a_fast_clock_shows_what_was_earlier(fast):
    """When a logger's clock that runs fast reads t, less than t has gone by since both clocks read zero."""
    true, inner = motion(PATH), slice(8, -8)
    for quantity in QUANTITY.values():
        found = act(make("setup.clock_scale", fast), true, quantity)
        assert_close(found, motion(PATH / (1 + fast)), INTERPOLATION, inner)


def test_interpolation_is_of_third_order_on_even_stamps():
    """At a fifth of the interval, where the third order shows: an eighth of the error for half the interval."""
    errors = []
    for step, count in ((STEP, COUNT), (STEP / 2, 2 * COUNT)):
        time = 5.0 + step * np.arange(count)
        found = act(make("setup.reference_delay", 0.21 * step), motion(time), "angular_rate")
        errors.append(np.abs(found.angular_rate - motion(time + 0.21 * step).angular_rate)[8:-8].max())
    assert errors[0] / errors[1] == pytest.approx(8, rel=0.15)


def test_interpolation_is_of_third_order_on_uneven_stamps():
    """Stamps that jitter by a fifth of an interval: third order, as is said, means an eighth here, too."""
    errors = []
    for step, count in ((STEP, COUNT), (STEP / 2, 2 * COUNT)):
        time = 5.0 + step * (np.arange(count) + 0.2 * (-1.0) ** np.arange(count))
        found = act(make("setup.reference_delay", 0.21 * step), motion(time), "angular_rate")
        errors.append(np.abs(found.angular_rate - motion(time + 0.21 * step).angular_rate)[8:-8].max())
    assert errors[0] / errors[1] == pytest.approx(8, rel=0.25)


def test_interpolation_as_accurate_as_it_says():
    """5 Hz at 100 Hz, half a sample: off by less than 1e-3 of the amplitude."""
    wave = lambda t: np.sin(10 * np.pi * t + 0.4)[:, None] * np.ones(3)  # noqa: E731
    true = replace(motion(PATH), angular_rate=wave(PATH))
    found = act(make("setup.time_offset", 0.005), true, "angular_rate")
    assert np.abs(found.angular_rate - wave(PATH - 0.005))[4:-4].max() < 1e-3


def test_beyond_its_ends_a_path_stays_where_it_was():
    true = motion(PATH)
    found = act(make("setup.reference_delay", 5 * STEP), true, "angular_rate")
    np.testing.assert_allclose(found.angular_rate[-5:], np.tile(true.angular_rate[-1], (5, 1)), atol=1e-14)
    found = act(make("setup.reference_delay", -5 * STEP), true, "angular_rate")
    np.testing.assert_allclose(found.temperature[:5], np.full(5, true.temperature[0]), atol=1e-14)


def test_the_sign_of_a_quaternion_means_nothing_to_a_shift():
    """q and −q are one attitude, and tools write either: where the sign changes between samples, nothing turns."""
    true = motion(PATH)
    signs = np.where(np.arange(COUNT) % 7 < 3, 1.0, -1.0)[:, None]
    setup = make("setup.time_offset", 0.4 * STEP)
    plain = act(setup, true, "angular_rate").attitude
    found = act(setup, replace(true, attitude=signs * true.attitude), "angular_rate").attitude
    same = np.abs(np.sum(plain * found, axis=1))
    np.testing.assert_allclose(same, 1.0, atol=1e-9)


TIME_SLOPES = {"setup.time_offset": lambda t: -1 + 0 * t, "setup.reference_delay": lambda t: 1 + 0 * t,
               "setup.clock_scale": lambda t: -t}  # fmt: skip


@pytest.mark.parametrize("name", TIME_SLOPES)
def test_derivative_by_a_shift_is_that_by_time(name):
    """At zero: −u̇ for an offset of the gyroscope, u̇ for a delay of the reference, −t u̇ for the clock."""
    true, inner = replace(motion(PATH), attitude=None), slice(2, -2)

    @jax.jit
    def slope(zero):
        return jax.jacfwd(lambda c: CATALOGUE[name](c).act(true, "angular_rate").angular_rate)(zero)

    found = np.asarray(slope(np.zeros(1)))[..., 0][inner]
    by_time = waves(11, 3, BAND)(PATH, 1)
    expected = (TIME_SLOPES[name](PATH)[:, None] * by_time)[inner]
    np.testing.assert_allclose(true.angular_rate, waves(11, 3, BAND)(PATH), atol=1e-14)
    # central differences of the samples are good to h²/6 of the third derivative
    allowed = STEP**2 / 6 * THIRD * np.abs(TIME_SLOPES[name](PATH)).max()
    assert 10 * allowed < np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=allowed)


def test_a_common_lag_is_the_reference_early():
    """To first order no gyroscope can tell them apart: the difference is a quarter for half the delay."""
    true = replace(motion(PATH), angular_acceleration=None)
    differences = []
    for delay in (2e-3, 1e-3):
        lagging = respond(triad("gyro", make("gyro.lag", delay)), true)
        early = respond(triad("gyro"), act(make("setup.reference_delay", -delay), true, "angular_rate"))
        differences.append(np.abs(np.asarray(lagging) - early)[4:-4].max())
        effect = np.abs(np.asarray(lagging) - respond(triad("gyro"), true)).max()
        assert differences[-1] < 0.05 * effect
    assert differences[0] / differences[1] == pytest.approx(4, rel=0.15)


def test_what_a_first_order_lag_smooths_is_undone():
    """Turns to and fro about one axis, whose angle behind a lag of τ is known exactly, the mean delay τ taken off.

    What is left is of fourth order in Ω τ: a sixteenth for half the lag.
    """
    axis, fast = np.array([0.6, 0.0, -0.8]), 6.0
    time, inner, errors = 5.0 + 1e-3 * np.arange(2000), slice(8, -8), []
    for lag in (0.04, 0.02):
        response = np.exp(1j * fast * lag) / (1 + 1j * fast * lag)  # of the lag, its mean delay taken off

        def turning(gain=1.0, time=time):
            """Stimulus of the angle Re(gain · e^{iΩt}) about the axis; the force is up in a body that lies level."""
            angle, rate, acceleration = ((gain * (1j * fast) ** n * np.exp(1j * fast * time)).real for n in range(3))
            body = Rotation.from_rotvec(angle[:, None] * axis)
            return Stimulus(
                specific_force=body.inv().apply([0.0, 0.0, G]), angular_rate=rate[:, None] * axis, time=time,
                angular_acceleration=acceleration[:, None] * axis, attitude=body.as_quat(scalar_first=True),
            )  # fmt: skip

        true, said = turning(), turning(response)
        found = act(make("setup.reference_filter", lag**2), said, "angular_rate")
        before, after = (
            [np.abs(getattr(each, field) - getattr(true, field))[inner].max() / np.abs(getattr(true, field)).max()
             for field in ("specific_force", "angular_rate", "attitude")]
            for each in (said, found)
        )  # fmt: skip
        assert all(new < 0.15 * old for old, new in zip(before, after, strict=True))
        errors.append(after[1])
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.25)


# The set-up -----------------------------------------------------------------------------------------------------------


def poses(count=6):
    """Attitudes at rest, body to level, and the specific force there in the body frame: gravity's reaction, up."""
    turns = Rotation.random(count, np.random.default_rng(27))
    return turns, G * turns.inv().apply([0.0, 0.0, 1.0])


def test_gravity_on_a_tilted_table():
    """The body is fixed to the table as is said; the table itself leans; up stays up."""
    turns, said = poses()
    lean = Rotation.from_rotvec([0.03, -0.05, 0.0])
    truly = lean * turns
    true = Stimulus(specific_force=said, attitude=turns.as_quat(scalar_first=True), angular_rate=np.ones((6, 3)))
    acted = act(make("setup.table_tilt", [0.03, -0.05]), true, "specific_force")
    np.testing.assert_allclose(acted.specific_force, G * truly.inv().apply([0.0, 0.0, 1.0]), atol=1e-13)
    aligned = truly.inv() * Rotation.from_quat(np.asarray(acted.attitude), scalar_first=True)
    np.testing.assert_allclose(aligned.magnitude(), 0, atol=1e-15)
    np.testing.assert_array_equal(acted.angular_rate, true.angular_rate)


def test_a_table_tilt_turns_with_the_table():
    """Turned by 180°, a level body leans the other way, so that the mean of both is free of the tilt."""
    turns = Rotation.from_euler("Z", [[0.0], [np.pi]])
    true = Stimulus(specific_force=np.tile([0, 0, G], (2, 1)), attitude=turns.as_quat(scalar_first=True))
    force = np.asarray(act(make("setup.table_tilt", [1e-3, 0.0]), true, "specific_force").specific_force)
    np.testing.assert_allclose(force[:, 1], [G * np.sin(1e-3), -G * np.sin(1e-3)], atol=1e-15)
    np.testing.assert_allclose(force[:, 2], G * np.cos(1e-3), atol=1e-14)


def test_gravity_is_added_along_the_true_up():
    """At rest its reaction grows; in motion only gravity's part of the specific force does."""
    turns, still = poses()
    lifted = np.random.default_rng(28).uniform(-5, 5, (6, 3))  # m/s² in the level frame
    moving = turns.inv().apply(lifted + [0, 0, G])
    attitude = turns.as_quat(scalar_first=True)
    setup = make("setup.gravity", 0.04)
    acted = act(setup, Stimulus(specific_force=moving, attitude=attitude), "specific_force")
    np.testing.assert_allclose(acted.specific_force, turns.inv().apply(lifted + [0, 0, G + 0.04]), atol=1e-13)
    for true in (Stimulus(specific_force=still, attitude=attitude), Stimulus(specific_force=still)):
        acted = act(setup, true, "specific_force")
        np.testing.assert_allclose(acted.specific_force, still * (G + 0.04) / G, atol=1e-13)


def test_gravity_hides_in_the_scale_of_the_accelerometer():
    _, still = poses()
    sensor = triad("accel")
    wrong = Imu(sensor, None, (make("setup.gravity", 0.04),)).respond(Stimulus(specific_force=still))[0]
    other = respond(replace(sensor, gain=sensor.gain * (1 + 0.04 / G)), Stimulus(specific_force=still))
    np.testing.assert_allclose(wrong, other, atol=1e-13)
    assert np.abs(wrong - respond(sensor, Stimulus(specific_force=still))).max() > 0.02


def table_motion():
    random = np.random.default_rng(29)
    return Stimulus(
        specific_force=G * random.standard_normal((6, 3)),
        angular_rate=random.uniform(-4, 4, (6, 3)),
        angular_acceleration=random.uniform(-9, 9, (6, 3)),
    )


def test_the_tables_rate_hides_in_the_scale_of_the_gyroscope():
    """With a lag, too, as a rate that is wrong by a factor changes quicker by as much."""
    true = table_motion()
    sensor = triad("gyro", make("gyro.lag", [1e-3, -2e-3, 3e-3]))
    quick = act(make("setup.table_rate_scale", 0.01), true, "angular_rate")
    np.testing.assert_allclose(quick.angular_rate, 1.01 * true.angular_rate, rtol=1e-15)
    np.testing.assert_allclose(quick.angular_acceleration, 1.01 * true.angular_acceleration, rtol=1e-15)
    np.testing.assert_array_equal(quick.specific_force, true.specific_force)
    other = respond(replace(sensor, gain=1.01 * sensor.gain), true)
    np.testing.assert_allclose(respond(sensor, quick), other, atol=1e-14)


def test_the_tables_axis_hides_in_the_misalignment_of_the_gyroscope():
    """Axes that are truly turned by ε: to first order what the effect says, which exactly is another gain."""
    true, errors = table_motion(), []
    for size in (4e-3, 2e-3):
        turn = size * np.array([1.0, -2.0, 0.5])
        acted = act(make("setup.table_axis", turn), true, "angular_rate")
        exact = Rotation.from_rotvec(turn)
        errors.append(np.abs(acted.angular_rate - exact.apply(true.angular_rate)).max())
        assert errors[-1] < 1e-2 * np.abs(exact.apply(true.angular_rate) - true.angular_rate).max()
        late = np.abs(acted.angular_acceleration - exact.apply(true.angular_acceleration)).max()
        assert late < 9 / 4 * 4 * np.sum(turn**2)
        sensor = triad("gyro", make("gyro.lag", 2e-3))
        across = np.array([[0, -turn[2], turn[1]], [turn[2], 0, -turn[0]], [-turn[1], turn[0], 0]])
        other = respond(replace(sensor, gain=sensor.gain @ (np.eye(3) + across)), true)
        np.testing.assert_allclose(respond(sensor, acted), other, atol=1e-14)
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.02)


# --- magnetometers ----------------------------------------------------------------------------------------------------


def test_a_field_that_stays_the_same_is_seen_late():
    """Of a body that turns at 1 rad/s the field of 3 ms ago, up to the second order of the delay."""
    time, delay = np.linspace(0.0, 1.0, 50), 3e-3
    rate = np.array([0.0, 0.6, 0.8])

    def field(at):
        return Rotation.from_rotvec(np.outer(at, rate)).inv().apply([20.0, -10.0, 40.0])

    true = Stimulus(angular_rate=np.tile(rate, (50, 1)), magnetic_field=field(time))
    late = field(time) + np.asarray(term(make("mag.lag", np.full(3, delay)), true))
    np.testing.assert_allclose(late, field(time - delay), atol=46.0 * delay**2)
    assert np.abs(field(time) - field(time - delay)).max() > 0.05


def test_a_wire_and_something_put_beside_the_unit():
    """The field of a wire is in proportion to its current; a magnet adds to the bias from one instant on."""
    true = Stimulus(time=np.array([0.0, 8.0, 12.0]), current=np.array([0.0, 2.0, -1.0]), time_reference=1.0)
    wire = term(make("mag.current", [1.0, -2.0, 0.5]), true)
    np.testing.assert_allclose(wire, [[0, 0, 0], [2, -4, 1], [-1, 2, -0.5]], atol=1e-15)
    magnet = term(make("mag.hard_iron_step", [1.0, -2.0, 0.5], onset=9.0), true)
    np.testing.assert_allclose(magnet, [[0, 0, 0], [0, 0, 0], [1, -2, 0.5]], atol=1e-15)


def test_a_disturbance_stays_where_it_is_while_the_unit_turns():
    """A change of 3 µT eastward, seen by a unit that has turned by a quarter about the vertical: along its −y."""
    quarter = Rotation.from_euler("z", 90, degrees=True).as_quat(scalar_first=True)
    true = Stimulus(time=np.array([4.0, 5.0, 9.0]), attitude=np.tile(quarter, (3, 1)), magnetic_field=np.zeros((3, 3)))
    acted = (
        CATALOGUE["setup.field_disturbance"].make([3.0, 0.0, 0.0], onset=5.0, duration=4.0).act(true, "magnetic_field")
    )
    np.testing.assert_allclose(acted.magnetic_field, [[0, 0, 0], [0, -3, 0], [0, 0, 0]], atol=1e-14)
    assert acted.specific_force is None
