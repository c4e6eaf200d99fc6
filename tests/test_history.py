"""What moved between calibrations of a unit: drawn calibrations whose truth is known, numbers alone, and whole runs."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy import stats

import jaximu
from jaximu.acceptance.epochs import in_own_axes
from jaximu.acceptance.limits import read_limits
from jaximu.acceptance.trend import Line, sameness
from jaximu.calibration import Calibration
from jaximu.estimation.problem import Name, flatten, names_of, unflatten, without_equipment
from jaximu.ground.gravity import LocalGravity
from jaximu.model.conventions import lower_triangular_frame
from jaximu.model.sensor import Imu, Triad

GRAVITY = LocalGravity(9.81, 0.015)


def unit(bias=0.0):
    """A unit whose accelerometer's gain is lower triangular."""
    accelerometer = np.array([[1.01, 0, 0], [0.004, 0.99, 0], [-0.003, 0.002, 1.002]])
    gyroscope = np.array([[0.99, 0.003, 0.001], [0.002, 1.02, -0.004], [0.001, 0.002, 1.005]])
    return Imu(
        Triad(accelerometer, np.array([0.05, -0.02, 0.1]) + bias),
        Triad(gyroscope, np.array([0.01, 0.02, -0.01]), quantity="angular_rate", output_unit="rad/s"),
    )


def calibration(imu, random=None, size=1.0, gravity=GRAVITY, free=without_equipment, shared=0.0, **more):
    """A calibration of the unit with errors drawn from its covariance; `shared`: gravity's error, of one sigma."""
    names = [name for name in names_of(imu) if free(name)]
    places = [names_of(imu).index(name) for name in names]
    flat = np.array(flatten(imu))
    root = np.random.default_rng(1).normal(size=(len(names), len(names))) / 5 + np.eye(len(names))
    root = size * np.where([name.part == "bias" for name in names], 1e-3, 1e-4)[:, None] * root
    by_gravity = np.where([name.startswith("accelerometer.gain") for name in names], flat[places], 0.0)
    by_gravity *= gravity.sigma / gravity.value
    if random is not None:
        flat[places] += root @ random.normal(size=len(names))
    flat[places] += shared * by_gravity
    whole = root @ root.T + np.outer(by_gravity, by_gravity)
    about = {"method": "joint", "loss": "linear", "rms": {}, "rank": len(names), "weak": (), "excess": {}}
    about |= {"solver": "", "data": {"poses": 20, "turns": 19}} | more
    return Calibration(jax.tree.map(np.asarray, unflatten(imu, flat)), tuple(names), whole, gravity, **about)


def within(count, total, share, p=1e-3):
    return stats.binomtest(count, total, share).pvalue > p


# --- numbers alone ----------------------------------------------------------------------------------------------------


def test_the_joint_p_value_is_uniform_and_shared_errors_drop_out():
    random = np.random.default_rng(3)
    root = random.normal(size=(5, 5))
    shared = np.tile([100.0, 0, 0, 50.0, 0], 3)
    whole = np.kron(np.diag([1.0, 4.0, 0.25]), root @ root.T) + np.outer(shared, shared)
    draw = np.linalg.cholesky(whole)
    p_values = [sameness((draw @ random.normal(size=15)).reshape(3, 5), whole).p_value for _ in range(400)]
    assert sameness(np.zeros((3, 5)), whole).freedom == 10
    assert stats.kstest(p_values, "uniform").pvalue > 1e-3
    assert within(sum(p < 0.05 for p in p_values), 400, 0.05)


def test_two_values_are_compared_as_a_difference_is():
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    assert sameness(np.array([[1.0], [7.0]]), covariance).statistic == pytest.approx(36 / (4 + 9 - 2))


@pytest.mark.parametrize("scatter", [0.0, 5.0])
@pytest.mark.parametrize("times", [(0.0, 1.0, 2.1, 3.0, 4.2), (0.0, 0.3, 5.0, 5.1, 6.0, 9.0)])
def test_the_drift_lies_in_its_interval_as_often_as_it_says(times, scatter):
    random, times = np.random.default_rng(4), np.array(times)
    sigma = random.uniform(0.5, 2.0, len(times))
    hits = 0
    for _ in range(400):
        values = 3.0 + 0.7 * times + np.hypot(sigma, scatter) * random.normal(size=len(times))
        line = Line.through(times - times[-1], values, np.diag(sigma**2))
        hits += abs(line.slope - 0.7) < line.half
    assert hits / 400 > 0.95 or within(hits, 400, 0.95)
    assert scatter or hits < 400


def test_a_line_is_that_of_weighted_least_squares():
    times, values, sigma = np.array([-3.0, -2.0, 0.0]), np.array([1.0, 2.0, 2.5]), np.array([1.0, 2.0, 0.5])
    line = Line.through(times, values, np.diag(sigma**2))
    (slope, level), covariance = np.polyfit(times, values, 1, w=1 / sigma, cov="unscaled")
    assert (line.slope, line.level) == pytest.approx((slope, level))
    assert line.sigma == pytest.approx(np.sqrt(covariance[0, 0]))
    assert line.statistic == pytest.approx(np.sum(((values - level - slope * times) / sigma) ** 2))


@pytest.mark.parametrize("multiple", [0.0, 1.645, 6.3])
@pytest.mark.parametrize("values", [(0.0, 1.0, 2.0), (2.0, 1.0, 0.1), (0.0, 0.1, 0.0)])
def test_the_guard_band_is_reached_when_it_says(values, multiple):
    line = Line.through(np.array([-2.0, -1.0, 0.0]), np.array(values), np.diag([0.01, 0.02, 0.01]))
    after = line.until(-7.0, 5.0, multiple)
    ahead = np.linspace(0, 1000, 200001)
    sigma = np.sqrt(line.covariance[0, 0] + 2 * line.covariance[0, 1] * ahead + line.covariance[1, 1] * ahead**2)
    value = line.level + line.slope * ahead
    beyond = (value + multiple * sigma > 5.0) | (value - multiple * sigma < -7.0)
    assert (after is None) == (not beyond.any())
    if after is not None:
        assert after == pytest.approx(ahead[np.argmax(beyond)], abs=0.006)
    assert line.until(-7.0, line.level - 0.01, multiple) == 0.0


# --- calibrations -----------------------------------------------------------------------------------------------------


def test_calibrations_of_one_unit_are_the_same_as_often_as_the_level_says():
    random, p_values, moved = np.random.default_rng(5), [], 0
    for _ in range(40):
        shared = random.normal()
        history = jaximu.compare(
            calibration(unit(), random, 3.0, shared=shared), calibration(unit(), random, shared=shared)
        )
        p_values.append(history.together["all"].p_value)
        moved += bool(history.moved)
    assert stats.kstest(p_values, "uniform").pvalue > 1e-3
    assert history.together["all"].freedom == 18  # 6 + 3 + 9: the gyroscope's bias is another after every power-on
    assert within(moved, 40, 0.05) or moved < 3


def test_what_moved_is_named_and_gravity_that_both_share_hides_nothing():
    other = unit()
    scaled = np.diag([1.0, 1.0005, 1.0]) @ other.accelerometer.gain  # a third of gravity's uncertainty
    other = replace(other, accelerometer=replace(other.accelerometer, gain=scaled))
    history = jaximu.compare(calibration(unit()), calibration(other))
    assert [course.name for course in history.moved] == ["accelerometer.scale[1]"]
    assert history.verdict == "moved"
    assert history.moved[0].difference == pytest.approx(0.99 * 0.0005)
    assert history.output["accelerometer"].worst == pytest.approx(0.0005 * 9.80665, rel=0.02)
    elsewhere = jaximu.compare(calibration(unit()), calibration(other, gravity=LocalGravity(9.80, 0.015)))
    assert not elsewhere.moved


def test_the_output_moves_by_the_bias_that_moved():
    history = jaximu.compare(calibration(unit()), calibration(unit(bias=np.array([0.0, 0.2, 0.0]))))
    change = history.output["accelerometer"]
    assert change.worst == pytest.approx(0.2 / 0.99, rel=0.01)
    assert change.rms == pytest.approx(0.2 / 0.99, rel=0.01)
    assert 0 < change.expected < 0.01 and 0 < change.sigma < 0.01
    assert history.output["gyroscope"].worst < 1e-9


def test_axes_of_a_fixture_are_turned_to_the_units_own():
    """A unit on a table, in which it sits turned: gains are full; the same unit by hand is the same unit."""
    angle = 0.02
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    here = unit()
    there = replace(
        here,
        accelerometer=replace(here.accelerometer, gain=here.accelerometer.gain @ turn),
        gyroscope=replace(here.gyroscope, gain=here.gyroscope.gain @ turn),
    )
    table = calibration(there, free=lambda name: name.part in ("gain", "bias"), method="turntable")
    own, turned = in_own_axes(table)
    assert turned and len(own.names) == len(table.names) - 3
    np.testing.assert_allclose(own.imu.gyroscope.gain, here.gyroscope.gain, atol=1e-12)
    # its covariance is that of draws that are turned one by one
    random, size = np.random.default_rng(6), len(table.names)
    places = [names_of(there).index(name) for name in table.names]
    flats = np.tile(flatten(there), (2000, 1))
    flats[:, places] += random.normal(size=(2000, size)) @ np.linalg.cholesky(table.covariance).T
    units = [unflatten(there, flat) for flat in flats]
    gains = [np.stack([getattr(drawn, name).gain for drawn in units]) for name in ("accelerometer", "gyroscope")]
    draws = lower_triangular_frame(*gains)
    for owner, values in zip(("accelerometer", "gyroscope"), draws[:2], strict=True):
        ratio = np.std(values, axis=0)[own.sigma(owner)[0] > 0] / own.sigma(owner)[0][own.sigma(owner)[0] > 0]
        assert np.all(np.abs(ratio - 1) < 5 / np.sqrt(2 * 2000))
    history = jaximu.compare(calibration(here), table)
    assert history.verdict == "same" and history.together["all"].statistic < 1e-6
    assert any("accelerometer's own" in note for note in history.notes)


def test_a_history_has_a_drift_and_a_calibration_interval(tmp_path):
    path = tmp_path / "limits.toml"
    path.write_text('[limits]\n"accelerometer.bias" = "0.2 m/s^2"\n"gyroscope.N" = { high = "1 deg/s/sqrt(Hz)" }\n')
    days = ["2023-01-01", "2024-01-01", "2025-01-01", "2026-01-01"]
    random = np.random.default_rng(7)
    bias = np.array([0.02, 0.0, 0.0])
    histories = [calibration(unit(bias=k * bias), random, trace={"date": day}) for k, day in enumerate(days)]
    shuffled = [histories[k] for k in (2, 0, 3, 1)]
    history = jaximu.compare(*shuffled, limits=read_limits(path), files=["c", "a", "d", "b"])
    assert history.files == ("a", "b", "c", "d") and history.per == "year"
    course = next(course for course in history.courses if course.name == "accelerometer.bias[0]")
    assert course.moved and abs(course.line.slope - 0.02 / 1.01) < course.line.half < 0.003
    reached = {limit.name: limit.after for limit in history.limits}
    now = (0.05 + 3 * 0.02) / 1.01
    assert reached["accelerometer.bias[0]"] == pytest.approx((0.2 - now) / 0.0198, rel=0.1)
    assert history.interval == min(after for after in reached.values() if after is not None)
    assert any("gyroscope.N" in text for text in history.left_out)
    document = history.document()
    assert document["limits"]["calibration_interval"] == history.interval
    json.dumps(document, allow_nan=False)
    assert jaximu.compare(*histories, dates=days[::-1]).files[0] == "calibration 4"


def test_names_are_those_of_limits():
    history = jaximu.compare(calibration(unit()), calibration(unit(bias=1e-4)))
    assert Name("accelerometer", "bias", (0,)) in {course.name for course in history.courses}
    assert history.per == "step" and "no date is known" in history.notes[0]
