"""The generator of hidden effects against itself and against physics worked out another way; no library needed."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import hidden_effects
import numpy as np
import pyarrow.parquet as pq
import pytest
from hidden_effects import (
    EARTH_RATE,
    GRAVITY,
    KINDS,
    OUTSIDE,
    TIES,
    WHITE,
    draw_case,
    draw_effect,
    observable,
    response,
)
from scipy.integrate import solve_ivp

SMALL = {"poses": 8, "static_minutes": 2}
SENSORS = ("accel", "gyro")


def pure(case):
    return replace(case, noisy=False, quantise=False)


def added(case, effect, session="fit"):
    """What an effect adds to its sensor's output, (n, 3)."""
    sensor = KINDS[effect.name].sensor
    without, both = response(case, effect, session)
    return getattr(both, sensor) - getattr(without, sensor)


def rest_means(case, samples, margin=2):
    return np.array([samples[start + margin : stop - margin].mean(axis=0) for start, stop in case.world("fit").rests])


def test_the_generator_shares_nothing_with_the_library():
    lines = Path(hidden_effects.__file__).read_text(encoding="utf-8").splitlines()
    imported = {line.split()[1].split(".")[0] for line in lines if line.startswith(("import ", "from "))}
    assert not imported & {"jaximu", "jax", "synthetic", "equinox"}


def test_equal_seeds_give_equal_recordings_and_others_do_not():
    names = ("accel.step", "gyro.earth_rotation")
    one, same, other = (draw_case(seed, names, **SMALL) for seed in (3, 3, 4))
    for part in ("fit", "heldout", "static"):
        for sensor in SENSORS:
            values = getattr(getattr(one, part), sensor)
            np.testing.assert_array_equal(values, getattr(getattr(same, part), sensor))
            assert not np.array_equal(values, getattr(getattr(other, part), sensor))
    assert one.truth.as_dict() == same.truth.as_dict() != other.truth.as_dict()
    assert not np.array_equal(one.fit.gyro, one.heldout.gyro)


def test_files_carry_the_columns_of_the_project(tmp_path):
    case = draw_case(1, ("accel.temperature",), temperature=True, **SMALL)
    paths = case.write(tmp_path / "unit")
    assert {part: path.name for part, path in paths.items()} == {part: f"{part}.parquet" for part in paths}
    table = pq.read_table(paths["fit"])
    assert table.column_names == [
        "time [s]",
        *(f"accel_{axis} [m/s^2]" for axis in "xyz"),
        *(f"gyro_{axis} [rad/s]" for axis in "xyz"),
        "temperature [degC]",
    ]
    np.testing.assert_array_equal(table["gyro_y [rad/s]"], case.fit.gyro[:, 1])
    assert pq.read_table(paths["static"]).num_rows == 2 * 60 * 100


def test_the_protocol_is_kept():
    case = draw_case(2, poses=5, pose_duration=3.0, turn_duration=1.6, rate=50.0, first_pose_duration=10.0)
    assert len(case.fit.time) == round((10 + 4 * (1.6 + 3.0)) * 50)
    assert np.diff(case.world("fit").rests)[0, 0] >= 500
    np.testing.assert_allclose(np.diff(case.fit.time), 0.02)
    assert set(case.fit.temperature) == {25.0}


@pytest.mark.parametrize("seed", range(3))
def test_norms_at_rest_are_gravity_and_turns_integrate_to_the_attitudes(seed):
    case = draw_case(seed, static_minutes=1)
    assert hidden_effects.largest_attitude_error(case) < 1e-9
    assert hidden_effects.largest_attitude_error(case, "heldout") < 1e-9
    scores = hidden_effects.rest_norm_scores(case)
    assert abs(scores.mean()) < 1.5 and 0.6 < scores.std() < 1.6  # flicker noise adds to the white sigma
    ups = case.world("fit").poses[:, 2]
    assert np.linalg.norm(ups.mean(axis=0)) < 0.02  # spread evenly over the sphere
    np.testing.assert_allclose(ups.T @ ups / len(ups), np.eye(3) / 3, atol=0.02)
    assert np.abs(case.fit.gyro).max() < 0.95 * np.radians(500)


def test_the_units_at_rest_show_bias_gravity_and_the_stated_white_noise():
    case = replace(draw_case(5, static_minutes=5), quantise=False)
    assert abs(np.linalg.norm(pure(case).static.accel[0] - case.truth.accel_bias) - GRAVITY) < 0.05 * GRAVITY
    np.testing.assert_allclose(pure(case).static.gyro[0], case.truth.gyro_bias)
    for sensor in SENSORS:
        white = np.diff(getattr(case.static, sensor), axis=0).std(axis=0) / np.sqrt(2)
        np.testing.assert_allclose(white, WHITE[sensor] * 10, rtol=0.03)


def test_flicker_noise_has_the_floor_of_its_allan_deviation():
    noise = hidden_effects.flicker(np.random.default_rng(0), 360_000, 100.0, 1.0)
    for seconds in (5, 20):
        means = noise.reshape(-1, 100 * seconds, 3).mean(axis=1)
        floor = np.sqrt(np.mean(np.diff(means, axis=0) ** 2) / 2)
        assert abs(floor / np.sqrt(2 * np.log(2) / np.pi) - 1) < 0.15


@pytest.mark.parametrize("name", KINDS)
def test_every_effect_shows_in_its_sensor_only_and_grows_in_proportion(name):
    case = draw_case(11, (name,), temperature=True, **SMALL)
    kind, effect = KINDS[name], case.hidden[0]
    other = "gyro" if kind.sensor == "accel" else "accel"
    for session in ("fit", "heldout"):
        change, (without, both) = added(case, effect, session), response(case, effect, session)
        assert 1e-6 < np.abs(change).max() < 1.0
        np.testing.assert_array_equal(getattr(without, other), getattr(both, other))
    doubled = added(case, replace(effect, scale=2.0))
    tolerance = {"nonlinear": None, "blind": 0.1}.get(kind.suite, 0.1 if name == "gyro.lag" else 1e-9)
    if tolerance:
        assert np.abs(doubled - 2 * added(case, effect)).max() < tolerance * np.abs(doubled).max()


@pytest.mark.parametrize("name", KINDS)
def test_axes_signs_and_directions_are_drawn_from_the_seed(name):
    protocol = draw_case(0, temperature=True).protocol
    effects = [draw_effect(seed, name, protocol) for seed in range(60)]
    kind = KINDS[name]
    assert {effect.sign for effect in effects} == ({1} if kind.positive else {-1, 1})
    if len(kind.mask) == 3:
        assert {effect.axis for effect in effects} == {"xyz"[i] for i in range(3) if np.any(kind.mask[i])}
    for effect in effects:
        assert effect.size == pytest.approx(kind.unit)
        assert not np.any(effect.coefficients[kind.mask == 0])


def test_scaling_leaves_the_noise_alone():
    names = ("gyro.g_sensitivity", "accel.cubic")
    case = replace(draw_case(6, names, **SMALL), quantise=False)
    noise = {sensor: getattr(case.fit, sensor) - getattr(pure(case).fit, sensor) for sensor in SENSORS}
    sizes = {"gyro.g_sensitivity": 5.0}
    larger = case.with_size(sizes)
    assert [effect.scale for effect in larger.hidden] == [5.0, 1.0]
    assert [effect.scale for effect in larger.with_size(2.0).hidden] == [2.0, 2.0]  # from unit size, not on top
    for sensor in SENSORS:
        again = getattr(larger.fit, sensor) - getattr(pure(larger).fit, sensor)
        np.testing.assert_allclose(again, noise[sensor], atol=1e-12)
    np.testing.assert_array_equal(case.fit.accel, larger.fit.accel)
    assert not np.array_equal(case.fit.gyro, larger.fit.gyro)


def test_a_thermal_lag_obeys_its_differential_equation():
    case = draw_case(7, ("accel.thermal_lag",), temperature=True, **SMALL)
    effect, world = case.hidden[0], case.world("fit")
    constant = effect.inner["time_constant"]
    solved = solve_ivp(
        lambda t, lagged: (np.interp(t, world.time, world.warmth) - lagged) / constant,
        (world.time[0], world.time[-1]),
        world.warmth[:1],
        t_eval=world.time,
        rtol=1e-8,
        atol=1e-8,
        max_step=0.1,
    )
    np.testing.assert_allclose(effect.added(world), np.outer(solved.y[0], effect.coefficients), atol=2e-3 * effect.size)


def test_thermal_hysteresis_plays_within_its_slot_and_moves_only_when_pushed():
    case = draw_case(8, ("gyro.thermal_hysteresis",), temperature=True, **SMALL)
    effect, world = case.hidden[0], case.world("fit")
    axis = "xyz".index(effect.axis)
    pin = effect.added(world)[:, axis] / effect.coefficients[axis]
    half, gap = effect.inner["half_width"], world.warmth - pin
    assert np.abs(gap).max() == pytest.approx(half)
    moving = np.abs(np.diff(pin)) > 1e-9
    np.testing.assert_allclose(np.abs(gap[1:][moving]), half, atol=1e-9)
    assert 0.1 < moving.mean() < 0.9


def test_the_temperature_goes_up_and_down_some_ten_kelvin_apart_from_time_and_its_own_rate():
    for seed in range(5):
        world = draw_case(seed, temperature=True).world("fit")
        assert 7 < np.ptp(world.temperature) < 16
        assert np.any(world.temperature_rate > 0.05) and np.any(world.temperature_rate < -0.05)
        apart = np.corrcoef([world.temperature, world.temperature_rate, world.time])
        assert np.abs(apart[np.triu_indices(3, 1)]).max() < 0.7


def test_a_gyroscope_lag_delays_each_axis_by_its_own_time_and_loses_no_angle():
    case = draw_case(9, ("gyro.lag",), **SMALL)
    effect, world = case.hidden[0], case.world("fit")
    change = effect.added(world)
    slope = np.gradient(world.rate, world.step, axis=0)
    delays = -np.sum(change * slope, axis=0) / np.sum(slope**2, axis=0)
    # A rate that is constant in each sub-step has no delay finer than that in its gradient, hence the tolerance.
    np.testing.assert_allclose(delays, effect.coefficients, atol=2e-2 * effect.size)
    np.testing.assert_allclose(change.sum(axis=0) * world.step, 0, atol=1e-12)


def test_earth_rotation_is_one_vector_of_the_level_frame_with_another_heading_in_each_session():
    case = draw_case(10, ("gyro.earth_rotation",), **SMALL)
    effect, norths = case.hidden[0], []
    for session in ("fit", "heldout"):
        world = case.world(session)
        level = np.einsum("nij,nj->ni", world.attitude, effect.added(world))
        np.testing.assert_allclose(level, np.broadcast_to(level[0], level.shape), atol=1e-15)
        assert np.linalg.norm(level[0]) == pytest.approx(EARTH_RATE)
        assert level[0, 2] == pytest.approx(EARTH_RATE * np.sin(effect.inner["latitude"]))
        norths.append(level[0, :2])
    assert not np.allclose(*norths, atol=1e-7)


def test_a_lever_arm_adds_the_acceleration_of_its_end():
    case = draw_case(12, ("accel.lever_arm",), oversampling=32, **SMALL)
    effect, world = case.hidden[0], case.world("fit")
    place = world.attitude @ effect.coefficients
    ahead, behind = place[2:], place[:-2]
    felt = np.einsum("nji,nj->ni", world.attitude[1:-1], (ahead - 2 * place[1:-1] + behind) / world.step**2)
    change = effect.added(world)[1:-1]
    assert np.sqrt(np.mean((felt - change) ** 2)) < 0.01 * np.sqrt(np.mean(change**2))


def test_a_time_offset_shifts_the_rate_and_what_is_blind_leaves_rests_and_turns_alone():
    case = draw_case(13, ("setup.time_offset", "accel.size_effect"), **SMALL)
    offset, arms = case.hidden
    truth, rests = case.truth, case.world("fit").rests
    shifted = np.linalg.solve(truth.gyro_gain, added(case, offset).T).T
    for before, after in pairwise(rests):
        turn = shifted[before[1] - 2 : after[0] + 2] / case.protocol.rate
        np.testing.assert_allclose(turn.sum(axis=0), 0, atol=1e-12)
    rate = response(case, offset)[0].gyro
    slope = np.gradient(rate, 1 / case.protocol.rate, axis=0)
    change = added(case, offset)
    assert -np.sum(change * slope) / np.sum(slope**2) == pytest.approx(offset.coefficients[0], rel=0.02)
    for effect in (offset, arms):
        assert np.abs(added(case, effect)).max() > 1e-3
        np.testing.assert_allclose(rest_means(case, added(case, effect)), 0, atol=1e-12)


@pytest.mark.parametrize("tie", TIES, ids=lambda tie: tie.hidden[0])
def test_tied_causes_explain_each_other_up_to_the_bias(tie):
    case = draw_case(14, tie.hidden, temperature="linear", inner=tie.inner)
    effect = case.hidden[0]
    axis = "xyz".index(effect.axis)
    hidden = rest_means(case, added(case, effect)[:, axis])
    for twin in tie.twins:
        unit = draw_effect(14, twin, case.protocol)
        column = rest_means(case, added(case, unit)[:, "xyz".index(unit.axis)])
        design = np.stack([np.ones(len(column)), column], axis=-1)
        left = hidden - design @ np.linalg.lstsq(design, hidden)[0]
        assert np.std(left) < 2e-3 * np.std(hidden)


def test_suites_hold_what_they_promise():
    assert set(observable(False)) < set(observable(True)) <= set(KINDS)
    assert not any("temp" in name or "thermal" in name for name in observable(False))
    assert {"accel.thermal_lag", "gyro.thermal_hysteresis", "gyro.lag", "gyro.earth_rotation"} <= set(observable(True))
    assert not {"setup.time_offset", "accel.size_effect", "accel.lever_arm", *OUTSIDE} & set(observable(True))
    assert len(OUTSIDE) >= 4 and all(name.startswith("outside.") for name in OUTSIDE)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ({"hidden": ("accel.quartic",)}, "no effect is called"),
        ({"hidden": ("accel.temperature",)}, "temperature is constant"),
        ({"hidden": ("accel.cubic", "accel.cubic")}, "once"),
        ({"hidden": ("accel.cubic",), "inner": {"accel.step": {}}}, "not hidden"),
        ({"hidden": ("accel.cubic",), "inner": {"accel.cubic": {"time_constant": 1.0}}}, "no inner number"),
        ({"temperature": "up"}, "temperature must be"),
    ],
)
def test_what_cannot_be_drawn_is_refused(arguments, complaint):
    with pytest.raises(ValueError, match=complaint):
        draw_case(0, **arguments)


def test_scales_of_what_is_not_hidden_and_turns_too_short_are_refused():
    with pytest.raises(ValueError, match="not hidden here"):
        draw_case(0, ("accel.cubic",)).with_size({"accel.step": 2.0})
    with pytest.raises(ValueError, match="too short"):
        draw_case(0, turn_duration=0.3).world("fit")
