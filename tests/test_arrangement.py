"""Axes, signs, mounting, ranges and clocks of the two sensors against each other."""

from dataclasses import replace
from itertools import permutations, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaximu import calibrate, diagnose
from jaximu.calibration.arrangement import arrangement
from jaximu.estimation.uncertainty import WeakDirection
from jaximu.mistakes import prepare
from jaximu.recordings.alignment import Clocks, angle_of, clocks, rotation_of, signed_permutation, turning
from jaximu.recordings.readers import read_recording
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld, RateTable

ONE = np.eye(3)
AXES = [np.diag(signs) @ ONE[list(order)] for order in permutations(range(3)) for signs in product((1, -1), repeat=3)]


@pytest.fixture(scope="module")
def recording(unit_logs):
    return read_recording(unit_logs / "unit003.parquet")


@pytest.fixture(scope="module")
def long():
    return simulate(draw_imu(3), HandHeld(24, 3.0), consumer_noise(), seed=3)[0]


def mapped(recording, accelerometer=ONE, gyroscope=ONE):
    """The recording of somebody whose outputs are these matrices times what they should be."""
    changed = {}
    for name, matrix in (("accelerometer", accelerometer), ("gyroscope", gyroscope)):
        signal = getattr(recording, name)
        changed[name] = replace(signal, values=signal.values @ np.asarray(matrix).T)
    return replace(recording, **changed)


def arguments(recording, late=0.0, drift=0.0):
    accelerometer, gyroscope = recording.accelerometer, recording.gyroscope
    time = gyroscope.time * (1 + drift) + late
    return accelerometer.time, accelerometer.si(), time, gyroscope.si()


@pytest.mark.parametrize("matrix", AXES[1::5], ids=lambda matrix: "".join(f"{each:.0f}" for each in matrix.sum(axis=1)))
def test_any_signed_permutation_is_named_and_repaired(recording, matrix):
    truth = calibrate(recording)
    wrong = mapped(recording, gyroscope=matrix)
    found = calibrate(wrong)
    assert found.rms["gravity_direction"][1] == pytest.approx(truth.rms["gravity_direction"][1], rel=1e-2)
    assert np.asarray(found.imu.gyroscope.gain) == pytest.approx(
        matrix @ np.asarray(truth.imu.gyroscope.gain), abs=1e-4
    )
    (finding,) = arrangement(wrong, found)
    assert finding.name == "data.swapped_axes"
    assert finding.text in found.notes
    assert ("setup.mounting" in finding.rivals) == (np.linalg.det(matrix) > 0)
    repaired = calibrate(wrong, repair=True)
    assert arrangement(finding.apply(wrong), repaired) == []
    assert any("This was repaired" in note for note in repaired.notes)


@pytest.mark.parametrize(
    ("accelerometer", "gyroscope", "option"),
    [
        (np.diag([-1.0, 1, 1]), ONE, "accel=-x,y,z"),
        (ONE[[1, 0, 2]], ONE, "accel=y,x,z"),
        (ONE, -ONE, "gyro=-x,-y,-z"),
        (np.diag([1.0, 1, -1]), np.diag([1.0, 1, -1]), "gyro=-x,-y,-z"),  # both left-handed
        (ONE, np.diag([1.0, 1, -1]), "gyro=x,y,-z"),
    ],
)
def test_the_simplest_of_what_looks_the_same_is_offered(recording, accelerometer, gyroscope, option):
    wrong = mapped(recording, accelerometer, gyroscope)
    (finding,) = arrangement(wrong, calibrate(wrong))
    assert finding.repair == f'--axes "{option}"'


@pytest.mark.parametrize("vector", [(0.0, 0.0, np.pi / 4), (0.3, 0.3, -0.2), (0.15, 0.0, 0.0)])
def test_a_mounting_is_told_by_its_angle(recording, vector):
    wrong = mapped(recording, gyroscope=Rotation.from_rotvec(vector).as_matrix())
    found = calibrate(wrong)
    (finding,) = arrangement(wrong, found)
    assert finding.name == "setup.mounting"
    part = "gyroscope.gain[1,0]"
    unknown = WeakDirection(2.0, False, ((part, 1.0),), "")
    assert arrangement(wrong, replace(found, weak=(unknown,))) == []  # a gain that is open says nothing
    assert arrangement(wrong, replace(found, weak=(replace(unknown, determined=True),))) == [finding]
    angle = float(finding.text.partition("turned by ")[2].partition("°")[0])
    assert angle == pytest.approx(np.degrees(np.linalg.norm(vector)), abs=1.5)
    assert found.rms["gravity_direction"][1] < 0.1


@pytest.mark.parametrize(
    ("name", "factors", "said"),
    [
        ("gyroscope", (2, 2, 2), "on all axes"),
        ("gyroscope", (1, 0.5, 1), "gyroscope y"),
        ("accelerometer", (2, 2, 2), "on all axes"),
        ("accelerometer", (1, 1, 4), "accelerometer z"),
        ("gyroscope", (1.4, 1.4, 1.4), "more than such sensors differ"),
    ],
)
def test_a_range_is_named(recording, name, factors, said):
    wrong = mapped(recording, **{name: np.diag(factors)})
    findings = arrangement(wrong, calibrate(wrong))
    assert {each.name for each in findings} == {"data.range"}
    assert said in findings[0].text


def test_all_rates_alike_leave_the_clock_in_doubt():
    """A unit whose scales are exactly one, logged with a clock that is two per cent off."""
    imu = draw_imu(1)
    imu = replace(imu, gyroscope=replace(imu.gyroscope, gain=1.02 * ONE))
    recording, _ = simulate(imu, HandHeld(20, 3.0), consumer_noise(), seed=1)
    findings = arrangement(recording, replace(calibrate(recording), imu=imu))
    assert [each.name for each in findings] == ["data.time_scale"]


def test_nothing_is_said_of_what_is_right(unit_logs):
    for unit in range(8):
        recording = read_recording(unit_logs / f"unit{unit:03d}.parquet")
        assert arrangement(recording, calibrate(recording)) == []


@pytest.mark.parametrize(("late", "drift"), [(0.05, 0.0), (-0.4, 0.0), (1.0, 0.0), (0.0, 5e-3), (0.2, -1e-2)])
def test_clocks_that_are_apart_are_measured_and_repaired(long, late, drift):
    recording = long
    found = clocks(*arguments(recording, late, drift))
    middle = recording.gyroscope.time.mean()
    assert found.late(np.array([middle])) == pytest.approx(late + drift * middle, abs=0.015)
    assert found.drift == pytest.approx(drift, abs=5e-4)
    gyroscope = replace(recording.gyroscope, time=recording.gyroscope.time * (1 + drift) + late)
    wrong = replace(recording, gyroscope=gyroscope)
    ready = prepare(wrong, repair=True)
    assert [each.name for each in ready.findings] == ["data.clocks" if drift else "setup.time_offset"]
    again = clocks(*arguments(ready.recording))
    assert abs(again.offset) < 0.01
    repaired, right = calibrate(wrong, repair=True), calibrate(recording)
    assert repaired.rms["gravity_direction"][1] < 0.1
    gain, change = np.asarray(right.imu.gyroscope.gain), repaired.imu.gyroscope.gain - right.imu.gyroscope.gain
    share = float(np.trace(np.linalg.solve(gain, change))) / 3
    sigma = ready.recording.gyroscope.clock_sigma
    assert (sigma > 0) == (drift != 0)  # the sensors of one clock do not drift apart
    assert abs(share) < (3.5 * sigma if drift else 1e-5)
    added = repaired.sigma("gyroscope")[0].diagonal() ** 2 - (gain.diagonal() * sigma) ** 2
    assert np.sqrt(added) == pytest.approx(right.sigma("gyroscope")[0].diagonal(), rel=0.4)
    assert sigma < 1e-4


def test_stamps_of_a_clock_that_drifts_are_put_right_exactly():
    true = np.linspace(0.0, 300.0, 7)
    line = Clocks(0.2, 1e-3, -1e-2, 1e-5, 140.0, 1.0)
    stamps = true + line.offset + line.drift * (true - line.middle)
    assert stamps - line.late(stamps) == pytest.approx(true, abs=1e-10)


def test_clocks_that_agree_are_not_mentioned(unit_logs):
    for unit in range(8):
        recording = read_recording(unit_logs / f"unit{unit:03d}.parquet")
        assert prepare(recording).findings == ()


@pytest.mark.parametrize("seed", [5, 8, 13])
@pytest.mark.parametrize("late", [0.0, 0.15])
def test_errors_of_an_accelerometer_on_a_rate_table_are_no_lag(seed, late):
    """Gravity lies along the axis of the table: the rate changes, and nothing turns but by the sensors' errors."""
    recording, _ = simulate(draw_imu(seed), RateTable(rates=(45.0, 90.0)), consumer_noise(), rate=100.0, seed=seed)
    measured = clocks(*arguments(recording, late))
    assert measured.offset == pytest.approx(late, abs=0.005)
    assert abs(measured.drift) < 3 * measured.drift_sigma


def test_a_negated_gyroscope_is_adequate_and_said(recording):
    found = diagnose(mapped(recording, gyroscope=-ONE))
    assert found.verdict == "adequate"
    (entry,) = [each.document() for each in found.preflight]
    assert entry["name"] == "data.swapped_axes"
    assert entry["repair"] == '--axes "gyro=-x,-y,-z"'
    assert "data.order" in entry["indistinguishable_from"]


@given(st.sampled_from(AXES), st.tuples(*[st.floats(0.1, 10.0)] * 3), st.integers(0, 2**31))
def test_the_nearest_axes_of_a_matrix_close_to_them(matrix, scales, seed):
    tilt = Rotation.from_rotvec(np.random.default_rng(seed).uniform(-0.15, 0.15, 3)).as_matrix()
    assert np.array_equal(signed_permutation(tilt @ matrix * scales), matrix)


@given(st.tuples(*[st.floats(-1.5, 1.5)] * 3), st.tuples(*[st.floats(0.1, 10.0)] * 3))
def test_the_rotation_of_a_matrix_is_free_of_its_scales(vector, scales):
    rotation = Rotation.from_rotvec(vector).as_matrix()
    assert rotation_of(rotation * scales) == pytest.approx(rotation, abs=1e-9)
    assert angle_of(rotation) == pytest.approx(np.linalg.norm(vector), abs=1e-6)


def test_a_unit_that_does_not_turn_has_no_matrix(recording):
    time, force, _, rate = arguments(recording)
    still = turning(time, np.tile([0.0, 0.0, 9.8], (len(force), 1)), time, rate)
    assert still.explained == 0.0 and np.isinf(still.sigma).all()
    assert turning(time[:50], force[:50], time[:50], rate[:50]).explained == 0.0


def test_measured_units_agree_with_gravity(data_folder):
    """Three MPU-9150: their data sheet's axes and scales, to what hands accelerate them by."""
    from jaximu import ReadOptions

    for unit in range(3):
        path = data_folder / "mikoff_mpu9150" / f"imu{unit}.log"
        recording = read_recording(path, options=ReadOptions(columns="accel [m/s^2],gyro [rad/s]", rate=100))
        assert recording.turning.matrix == pytest.approx(ONE, abs=0.12)
