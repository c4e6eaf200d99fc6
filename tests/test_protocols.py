"""Protocols: rates, accelerations and forces that belong together, and recipes that are what their sources say."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from jaximu.ground.errors import InputError
from jaximu.simulation.draw import draw_imu
from jaximu.simulation.engine import Case, Truth
from jaximu.simulation.protocols import (
    PROTOCOLS,
    Course,
    DividingHead,
    Environment,
    Ferraris,
    HandHeld,
    Positions,
    RateTable,
    Rotations,
    SingleAxisTable,
    SoakAndRamp,
    Static,
    Tone,
    Vibration,
    attitude_of,
    earth_rate,
)
from jaximu.simulation.protocols.positions import directions

SMALL = {
    "static": Static(12.0, (1.0, 2.0, -0.5)),
    "positions": Positions(8, 2.0, 1.0),
    "hand-held": HandHeld(8, 2.0, 1.0, displacement=0.4),
    "rate-table": RateTable((40.0, 150.0), 1.0, 1.0, 0.5, 1.0),
    "dividing-head": DividingHead(1.0),
    "ferraris": Ferraris(1.0, 360.0, 3.0),
    "rotations": Rotations("y90 x-180 z45", 1.0, 1.5),
    "single-axis-table": SingleAxisTable(1.0, 90.0, 2.0),
    "soak-and-ramp": SoakAndRamp(0.0, 20.0, (300.0, 600.0), 9.0, 4.0, 3.0, 6, 1.0),
    "vibration": Vibration((2.0, 5.0), (11.0, 170.0), 3.0, (1.0, 0.5, 0.0), 0.02, (0.0, 1.0, 1.0)),
}
EVERY = pytest.mark.parametrize("kind", PROTOCOLS)


def test_every_protocol_is_tested():
    assert set(SMALL) == set(PROTOCOLS)


def test_a_turn_whose_axis_moves():
    """Rates are means of the attitude's own, by finite differences; turns end where they would without the lean."""
    bent, straight = (HandHeld(5, 1.0, 1.2, bend=bend) for bend in (40.0, 0.0))
    rate, fine = 25.0, 3200.0
    true, other = truth_of(bent, rate).stimulus, truth_of(bent, fine).stimulus
    turned = rotations(other.attitude)
    mean = (turned[:-1].inv() * turned[1:]).as_rotvec() * fine  # between stamps
    whole = len(true.angular_rate)
    centred = np.concatenate([mean[:1], (mean[1:] + mean[:-1]) / 2, mean[-1:]])
    centred = centred[: whole * 128].reshape(whole, 128, 3).mean(axis=1)
    np.testing.assert_allclose(true.angular_rate, centred, atol=2e-4)
    held = np.linalg.norm(np.cross(true.angular_rate, true.angular_acceleration), axis=1) * 0.04**2 / 12
    assert held.max() > 5e-4  # coning that the rates do not hold
    bends = bent.plan(np.random.default_rng(0)).motion.bend
    assert np.degrees(np.linalg.norm(bends, axis=1)).max() <= 40.0
    np.testing.assert_allclose(truth_of(straight).stimulus.attitude[-1], truth_of(bent).stimulus.attitude[-1], atol=1)


def truth_of(protocol, rate=100.0, seed=3, environment=None) -> Truth:
    return Truth(Case.of(draw_imu(0), protocol, None, rate, seed, environment=environment))


def rotations(quaternions) -> Rotation:
    return Rotation.from_quat(np.asarray(quaternions), scalar_first=True)


def attitudes(motion, time) -> Rotation:
    return rotations(jax.jit(type(motion).attitude_at)(jax.tree.map(np.asarray, motion), np.asarray(time)))


@EVERY
@pytest.mark.parametrize("latitude", [None, 48.0])
def test_integrating_the_rate_returns_the_attitude(kind, latitude):
    """With SciPy's rotations. Against inertial space the level frame itself turns by ω_E t."""
    rate = 100.0
    truth = truth_of(SMALL[kind], rate, environment=Environment(latitude=latitude))
    motion, stimulus = truth.case.plan.motion, truth.stimulus
    steps = Rotation.from_rotvec(stimulus.angular_rate / rate)
    edges = attitudes(motion, np.arange(truth.case.samples + 1) / rate)
    turned = edges[0]
    for k in range(len(steps)):
        turned = turned * steps[k]
        if k % 97 == 0 or k == len(steps) - 1:
            ground = Rotation.from_rotvec(np.asarray(motion.earth) * (k + 1) / rate)
            assert (turned.inv() * ground * edges[k + 1]).magnitude() < 1e-10 * (k + 10)


@EVERY
def test_rate_acceleration_and_force_are_the_derivatives_of_attitude_and_position(kind):
    """Central differences over 1e-4 s of attitudes and positions, against what the stimulus states at its stamps."""
    truth = truth_of(SMALL[kind], environment=Environment(latitude=-30.0))
    motion, stimulus = jax.tree.map(np.asarray, truth.case.plan.motion), truth.stimulus
    time = np.asarray(stimulus.time) + 0.005
    # not where a segment or a tone's envelope begins or ends: there the fourth derivative jumps, and differences see it
    windows = [edge + each for edge in motion.window.ravel() for each in (-1.0, 0.0, 1.0)]
    ramps = np.concatenate([motion.start + f * motion.duration for f in (motion.ramp, 1 - motion.ramp)])
    ends = np.concatenate([motion.start, motion.start + motion.duration, ramps, windows])
    inner = np.abs(time[:, None] - ends).min(axis=1) > 0.02
    h = 1e-4
    before, here, after = (attitudes(motion, time + step) for step in (-h, 0.0, h))
    ground = here.inv().apply(motion.earth)
    rate_after, rate_before = ((here.inv() * after).as_rotvec() / h, (before.inv() * here).as_rotvec() / h)
    # a rotation vector over h belongs to its middle, seen from either side in nearly the same frame
    acceleration = (rate_after - rate_before) / h - np.cross((rate_after + rate_before) / 2, ground)
    scale = 1 + np.abs(acceleration).max()
    share = 3e-3 if kind == "vibration" else 2e-5  # 170 Hz over 1e-4 s: (2π·170·1e-4)²/12
    np.testing.assert_allclose(stimulus.angular_acceleration[inner], acceleration[inner], atol=share * scale)

    place = jax.jit(type(motion).displacement_at)
    moved = (place(motion, time + h) - 2 * place(motion, time) + place(motion, time - h)) / h**2
    force = here.inv().apply(np.asarray(moved) + [0, 0, motion.gravity])
    if kind == "vibration":
        tones = motion.frequency < 50.0
        assert tones.any() and not tones.all()
        stated = np.asarray(stimulus.specific_force) - force
        shaken = stimulus.vibration_power > 0
        assert np.abs(stated[~shaken]).max() < 1e-6
        assert np.ptp(stated[shaken], axis=0)[0] > 2.0
    else:
        np.testing.assert_allclose(stimulus.specific_force[inner], force[inner], atol=3e-5)


@EVERY
def test_the_schedule_is_what_happens(kind):
    rate = 100.0
    truth = truth_of(SMALL[kind], rate)
    stimulus, time = truth.stimulus, np.arange(truth.case.samples) / rate
    edges = attitudes(truth.case.plan.motion, (np.arange(truth.case.samples + 1)) / rate)
    assert truth.schedule
    for each in truth.schedule:
        inside = (time >= each.start) & (time < each.stop)
        assert abs(inside.sum() / rate - (each.stop - each.start)) < 1.01 / rate
        if kind == "vibration":
            continue
        if each.kind == "pose":
            assert np.abs(stimulus.angular_rate[inside]).max() < 1e-12
            up = stimulus.specific_force[inside].mean(axis=0) / 9.80665
            np.testing.assert_allclose(up, each.vector, atol=1e-12)
            said = attitude_of(each.vector, each.heading)
            assert (said.inv() * edges[np.flatnonzero(inside)[0]]).magnitude() < 1e-6
        else:
            total = stimulus.angular_rate[inside].sum(axis=0) / rate  # one axis: rotation vectors add up
            np.testing.assert_allclose(total, each.angle * each.vector, atol=1e-9)


@settings(max_examples=15, deadline=None)
@given(
    angle=st.floats(0.01, 40.0),
    duration=st.floats(0.2, 20.0),
    ramp=st.floats(0.01, 0.5),
    seed=st.integers(0, 2**32 - 2),
)
def test_a_turn_goes_from_rest_to_rest_at_a_constant_rate(angle, duration, ramp, seed):
    axis = Rotation.random(None, np.random.default_rng(seed)).apply([1.0, 0.0, 0.0])
    course = Course(Rotation.random(None, np.random.default_rng(seed + 1)))
    course.turn(angle * axis, duration, ramp)
    motion = course.motion(Environment(), np.random.default_rng(0))
    x = np.linspace(0, 1, 257)
    places = attitudes(motion, x * duration)
    steps = (places[:-1].inv() * places[1:]).as_rotvec()
    np.testing.assert_allclose(np.cross(steps, axis), 0, atol=1e-12)
    assert np.sum(steps @ axis) == pytest.approx(angle, rel=1e-9)
    speed, middle = steps @ axis / np.diff(x * duration), (x[1:] + x[:-1]) / 2
    flat = (middle > ramp + 0.01) & (middle < 1 - ramp - 0.01)
    np.testing.assert_allclose(speed[flat], angle / duration / (1 - ramp), rtol=1e-7)
    assert speed.min() > -1e-12 and speed.max() < angle / duration / (1 - ramp) * (1 + 1e-9)
    np.testing.assert_allclose(speed, speed[::-1], atol=1e-9 * speed.max())  # comes to rest as it left it


def test_position_schemes():
    for count, least in ((6, np.pi / 2), (8, 1.2), (12, 1.0), (26, 0.6)):
        ups = np.array([up for up, _ in directions(count)])
        assert ups.shape == (count, 3)
        np.testing.assert_allclose(np.linalg.norm(ups, axis=1), 1, atol=1e-15)
        np.testing.assert_allclose(ups.sum(axis=0), 0, atol=1e-12)
        apart = np.arccos(np.clip(ups @ ups.T, -1, 1)) + 10 * np.eye(count)
        assert apart.min() > least - 1e-6
        assert np.linalg.matrix_rank(np.column_stack([ups, np.ones(count)])) == 4
    turned = [attitude_of(up, heading).as_matrix() for up, heading in directions(24)]
    assert len(turned) == 24
    for a in range(24):  # the rotation group of the cube: signed permutations, all different
        np.testing.assert_allclose(np.sort(np.abs(turned[a]).ravel()), [0] * 6 + [1] * 3, atol=1e-12)
        assert all(np.abs(turned[a] - turned[b]).max() > 0.5 for b in range(a))
    with pytest.raises(InputError, match="6, 8, 12, 24 or 26"):
        Positions(7).plan(np.random.default_rng(0))


def test_attitude_of_points_up_and_turns_about_it():
    rng = np.random.default_rng(1)
    up, heading = rng.standard_normal((50, 3)), rng.uniform(-3, 3, 50)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    np.testing.assert_allclose(attitude_of(up, heading).apply(up), np.tile([0, 0, 1.0], (50, 1)), atol=1e-12)
    difference = attitude_of(up, heading) * attitude_of(up).inv()
    np.testing.assert_allclose(difference.as_rotvec(), heading[:, None] * [0, 0, 1.0], atol=1e-7)


def test_hand_held_poses_spread_and_repeat():
    a, b, c = (HandHeld(24, 1.0, 1.0).plan(np.random.default_rng(seed)) for seed in (1, 1, 2))
    for one, two in zip(jax.tree.leaves(a.motion), jax.tree.leaves(b.motion), strict=True):
        np.testing.assert_array_equal(one, two)
    assert np.abs(a.motion.attitude - c.motion.attitude).max() > 0.1
    ups = np.array([each.vector for each in a.intervals if each.kind == "pose"])
    apart = np.arccos(np.clip(ups @ ups.T, -1, 1)) + 10 * np.eye(24)
    assert apart.min() > 0.4  # spread evenly: a ring of 24 random directions would have pairs closer than 0.1
    assert max(each.angle for each in a.intervals if each.kind == "turn") <= np.pi + 1e-9


def test_rate_table_comes_to_its_rate_and_turns_whole_revolutions():
    truth = truth_of(SMALL["rate-table"])
    table = [each for each in truth.schedule if each.kind == "turn" and each.angle > 6]
    time = np.asarray(truth.stimulus.time)
    turning = np.any([(time >= each.start) & (time < each.stop) for each in table], axis=0)
    reached = np.degrees(np.abs(truth.stimulus.angular_rate[turning]).max())
    assert reached == pytest.approx(150.0, rel=1e-9)
    assert len(table) == 3 * 2 * 2 and all(each.angle == pytest.approx(2 * np.pi) for each in table)
    held = np.abs(np.degrees(np.linalg.norm(truth.stimulus.angular_rate, axis=1)) - 40.0) < 1e-9
    assert held.sum() / 100 == pytest.approx(6 * (360 / 40 - 0.5), abs=0.2)  # two half ramps are turned below the rate


def test_dividing_head_is_the_papers():
    """CSNC 2011: five positions, z never down; six turns below 30 °/s, done within 10 s."""
    plan = DividingHead().plan(np.random.default_rng(0))
    ups = np.array([each.vector for each in plan.intervals if each.kind == "pose"])
    assert ups[:, 2].min() > -1e-9
    assert len({tuple(np.round(up).astype(int)) for up in ups}) == 5
    turns = [each for each in plan.intervals if each.kind == "turn" and each.angle > 3]
    assert len(turns) == 6 and max(each.stop - each.start for each in turns) <= 10
    assert np.degrees(np.abs(truth_of(replace(DividingHead(), duration=1.0)).stimulus.angular_rate).max()) < 30


def test_single_axis_table_has_twelve_stations_and_a_turn_an_axis():
    plan = SingleAxisTable(1.0, 90.0).plan(np.random.default_rng(0))
    poses = [each for each in plan.intervals if each.kind == "pose"]
    assert len(poses) == 12
    for first, second in zip(poses[::2], poses[1::2], strict=True):  # 0° and 180° of the table
        np.testing.assert_allclose(first.vector, second.vector, atol=1e-12)
        assert abs(abs(first.heading - second.heading) - np.pi) < 1e-6
    whole = [each for each in plan.intervals if each.kind == "turn" and each.angle > 6]
    np.testing.assert_allclose([each.vector for each in whole], np.eye(3), atol=1e-12)


def test_soak_and_ramp():
    """The chamber by its knots; the sensor's lag against an integrated ODE."""
    protocol = SoakAndRamp(-10.0, 30.0, (20.0, 60.0), 30.0, device_lag=25.0, self_heating=3.0)
    truth = truth_of(protocol, 10.0)
    motion, stimulus = truth.case.plan.motion, truth.stimulus
    assert set(truth.case.plan.columns) == {"temperature", "ambient_temperature"}
    time = np.asarray(stimulus.time) + 0.05
    air = np.interp(time, motion.temperature_time, motion.ambient)
    assert air.min() == -10 and air.max() == 30
    rate = np.diff(air) * 10 * 60
    for speed in (20, 60):
        for sign in (1, -1):
            held = np.sum(np.abs(rate - sign * speed) < 1e-6) / 10
            assert held == pytest.approx(40 / speed * 60, abs=0.3)
    solved = solve_ivp(
        lambda t, x: (np.interp(t, motion.temperature_time, motion.ambient) - x) / 25.0,
        (0, time[-1]), [-10.0], t_eval=time, rtol=1e-9, atol=1e-9, max_step=1.0,
    )  # fmt: skip
    np.testing.assert_allclose(stimulus.temperature, solved.y[0] + 3.0, atol=0.02)
    slope = np.gradient(np.asarray(stimulus.temperature), time)
    np.testing.assert_allclose(stimulus.temperature_rate[20:-20], slope[20:-20], atol=0.05)


def test_vibration_power_is_the_mean_square_and_quick_tones_do_not_show():
    slow = Static(20.0), Environment(vibration=(Tone(7.3, (1.0, 2.0, 0.5)),))
    truth = truth_of(*slow[:1], environment=slow[1])
    shaken = np.asarray(truth.stimulus.specific_force) - [0, 0, 9.80665]
    np.testing.assert_allclose(np.mean(np.sum(shaken**2, axis=1)), 5.25 / 2, rtol=0.01)
    np.testing.assert_allclose(truth.stimulus.vibration_power, 5.25 / 2)
    quick = truth_of(Static(2.0), environment=Environment(vibration=(Tone(173.0, (1.0, 2.0, 0.5)),)))
    np.testing.assert_allclose(np.asarray(quick.stimulus.specific_force) - [0, 0, 9.80665], 0, atol=1e-12)
    np.testing.assert_allclose(quick.stimulus.vibration_power, 5.25 / 2)


def test_earth_rotation_at_rest():
    """No east component, tan(latitude) up over north, the Earth's rate in all; a resting unit feels it in its frame."""
    for latitude in (-60.0, 0.0, 48.2, 90.0):
        east, north, up = earth_rate(np.radians(latitude))
        assert east == 0 and np.hypot(north, up) == pytest.approx(2 * np.pi / 86164.0905, rel=1e-6)
        assert np.degrees(np.arctan2(up, north)) == pytest.approx(latitude)
    up = np.array([1.0, 2.0, -0.5])
    truth = truth_of(SMALL["static"], environment=Environment(latitude=48.2))
    felt = np.asarray(truth.stimulus.angular_rate).mean(axis=0)
    assert felt @ up / np.linalg.norm(up) == pytest.approx(7.292115e-5 * np.sin(np.radians(48.2)), rel=1e-9)
    assert np.linalg.norm(felt) == pytest.approx(7.292115e-5, rel=1e-9)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Static(0.0), "duration must be greater than zero"),
        (lambda: Static(1.0, (0.0, 0.0, 0.0)).plan(np.random.default_rng(0)), "zero vector"),
        (lambda: RateTable((30.0, 0.0)), "rates must be greater than zero"),
        (lambda: RateTable((30.0, -5.0)), "rates must be greater than zero, found -5"),
        (lambda: HandHeld(poses=0), "poses must be greater than zero"),
        (lambda: HandHeld(initial_rest=-1.0), "initial_rest must not be negative"),
        (lambda: SoakAndRamp(-300.0, 20.0), "absolute zero"),
        (lambda: SoakAndRamp(30.0, 20.0), "below high"),
        (lambda: SoakAndRamp(soak_duration=5.0, positions=24).plan(np.random.default_rng(0)), "too short"),
        (lambda: Vibration(frequencies=(0.0,)), "frequencies"),
        (lambda: Environment(temperature=-280.0), "absolute zero"),
        (lambda: Environment(temperature=[[0, 20], [0, 30]]), "must increase"),
        (lambda: Environment(temperature=[[0, 20]]), "knots"),
        (lambda: Environment(latitude=91.0), "latitude"),
        (lambda: Environment(gravity=-1.0), "gravity"),
        (
            lambda: SoakAndRamp().plan(np.random.default_rng(0), Environment(temperature=20.0)),
            "sets the temperature itself",
        ),
        (lambda: Case.of(draw_imu(0), Static(1.0), rate=0.0), "rate must be a positive number"),
        (lambda: Case.of(draw_imu(0), Static(0.01)), "less than two samples"),
    ],
)
def test_what_makes_no_sense_is_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()
