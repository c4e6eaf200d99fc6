"""Calibration with equipment: schemes, references, closed forms, nuisance effects, and what bad references get told."""

import csv
import json
from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
import pytest
import scipy.signal
import scipy.spatial.transform
from numpy.testing import assert_allclose

from jaximu.calibration import load_calibration
from jaximu.calibration.closed_form import (
    ferraris,
    linear_least_squares,
    remove_curvature,
    six_position,
    turn_pairs,
)
from jaximu.calibration.scheme import describe_scheme
from jaximu.calibration.turntable import calibrate_turntable, fit_turntable
from jaximu.cli.app import main
from jaximu.data.observe_stations import attitudes, observe_stations, scheme_stations
from jaximu.data.stations import station_rms
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import LocalGravity
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.model import AxisNoise, NoiseModel
from jaximu.model.effects import CATALOGUE
from jaximu.model.sensor import Imu
from jaximu.recordings import write_recording
from jaximu.recordings.readers import ReadOptions, ScheduleEntry, read_recording, read_reference, read_schedule
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.reference import entries_of_columns
from jaximu.simulation import consumer_noise, simulate
from jaximu.simulation.protocols import (
    DividingHead,
    Environment,
    Ferraris,
    HandHeld,
    Positions,
    RateTable,
    SingleAxisTable,
    Static,
    earth_rate,
)

EXACT = LocalGravity(STANDARD_GRAVITY, 0.0)
SCHEMES = [Positions(6), Positions(8), Positions(12), DividingHead(), SingleAxisTable(), Ferraris()]


def unit(seed=0, misalignment=0.03):
    """A unit whose axes are off in all nine ways: the fixture's frame is not the accelerometer's."""
    rng = np.random.default_rng(seed)
    gains = np.eye(3) + misalignment * rng.uniform(-1, 1, (2, 3, 3))
    biases = rng.uniform(-1, 1, (2, 3)) * np.array([[0.3], [0.02]])
    return eqx.tree_at(
        lambda i: (i.accelerometer.gain, i.accelerometer.bias, i.gyroscope.gain, i.gyroscope.bias),
        Imu.nominal(),
        (gains[0], biases[0], gains[1], biases[1]),
    )


def numbers(imu):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(imu)])


def used_means(stations):
    """Mean inputs and outputs of the stations that each triad uses."""
    found = []
    for quantity, mean, used in (
        (stations.stimulus.specific_force, stations.accelerometer_mean, stations.accelerometer_used),
        (stations.stimulus.angular_rate, stations.gyroscope_mean, stations.gyroscope_used),
    ):
        found += [np.mean(np.asarray(quantity)[used], axis=1), np.asarray(mean)[used]]
    return found


@pytest.fixture(scope="module")
def box():
    """Six positions and three turns of one unit, with noise: recording, truth."""
    return simulate(unit(3), Ferraris(duration=4.0), consumer_noise(), seed=3)


@pytest.fixture
def schedule(box, tmp_path):
    path = tmp_path / "log.schedule.csv"
    box[1].save_schedule(path)
    return path


# --- exact data -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", SCHEMES, ids=lambda protocol: f"{protocol.kind}-{getattr(protocol, 'count', '')}")
def test_all_solutions_agree_with_the_truth_to_rounding(protocol):
    imu = unit(1)
    stations = scheme_stations(protocol, imu)
    fit = fit_turntable(Imu.nominal(), stations)
    assert fit.converged and fit.finite
    assert_allclose(numbers(fit.imu), numbers(imu), rtol=0, atol=1e-12)
    force, accelerometer, rate, gyroscope = used_means(stations)
    for (gain, bias), triad in (
        (linear_least_squares(force, accelerometer), imu.accelerometer),
        (linear_least_squares(rate, gyroscope), imu.gyroscope),
    ):
        assert_allclose(gain, triad.gain, rtol=0, atol=1e-12)
        assert_allclose(bias, triad.bias, rtol=0, atol=1e-12)


def test_pairs_agree_with_least_squares():
    imu = unit(2)
    outputs = used_means(scheme_stations(Positions(6), imu))[1]
    gain, bias = six_position(outputs[0::2], outputs[1::2], STANDARD_GRAVITY)
    assert_allclose(gain, imu.accelerometer.gain, rtol=0, atol=1e-14)
    assert_allclose(bias, imu.accelerometer.bias, rtol=0, atol=1e-14)

    stations = scheme_stations(RateTable(rates=(90.0,)), imu)
    turns = np.asarray(stations.turn) & (np.abs(np.asarray(stations.stop - stations.start) - 5.0) < 1e-9)
    integral = (np.asarray(stations.gyroscope_mean) * np.asarray(stations.stop - stations.start)[:, None])[turns]
    assert_allclose(turn_pairs(integral[0::2], integral[1::2], 2 * np.pi), imu.gyroscope.gain, rtol=0, atol=1e-14)
    # another duration of the way back: the bias no longer cancels and is taken off
    longer = integral[1::2] + 2.0 * np.asarray(imu.gyroscope.bias)
    durations = np.tile([5.0, 7.0], (3, 1))
    found = turn_pairs(integral[0::2], longer, 2 * np.pi, durations, imu.gyroscope.bias)
    assert_allclose(found, imu.gyroscope.gain, rtol=0, atol=1e-14)


def test_least_squares_is_numpys_also_weighted_and_in_batches():
    rng = np.random.default_rng(0)
    inputs, outputs = rng.normal(size=(2, 5, 12, 3)), rng.normal(size=(2, 5, 12, 3))
    weights = rng.uniform(0.1, 3.0, (2, 5, 12))
    gain, bias = jax.jit(linear_least_squares)(inputs, outputs, weights)
    for place in np.ndindex(2, 5):
        design = np.column_stack([inputs[place], np.ones(12)]) * weights[place][:, None]
        expected = np.linalg.lstsq(design, outputs[place] * weights[place][:, None], rcond=None)[0]
        assert_allclose(gain[place], expected[:3].T, rtol=1e-11, atol=1e-12)
        assert_allclose(bias[place], expected[3], rtol=1e-11, atol=1e-12)


def test_covariance_is_that_of_generalised_least_squares():
    # slow bias ties the stations together: (Xᵀ C⁻¹ X)⁻¹ with the full C, built here from G(h) of a Gauss-Markov bias
    sigma2, time, white = 1e-6, 50.0, 1e-6
    slow = AxisNoise(np.full(3, white), np.zeros(3), np.full((3, 1), sigma2), np.array([time]))
    stations = scheme_stations(Positions(8, duration=20.0), unit(5), NoiseModel(slow, slow))
    fit = fit_turntable(Imu.nominal(), stations)
    used = np.asarray(stations.accelerometer_used)
    middle = ((np.asarray(stations.start) + np.asarray(stations.stop)) / 2)[used]
    lag = np.abs(middle[:, None] - middle) / time
    half = 10.0 / time
    covariance = sigma2 * np.exp(-lag) * (np.sinh(half) / half) ** 2  # of means over 20 s, apart by more than that
    inside = 2 * sigma2 * time / 20.0 * (1 - time / 20.0 * -np.expm1(-20.0 / time))
    np.fill_diagonal(covariance, inside + white / 20.0)
    design = np.column_stack([used_means(stations)[0], np.ones(used.sum())])
    scale = np.linalg.norm(unit(5).accelerometer.gain[0])  # the noise is stated in SI
    expected = scale**2 * np.linalg.inv(design.T @ np.linalg.solve(covariance, design))
    rows = [fit.names.index(f"accelerometer.gain[0,{k}]") for k in range(3)]
    rows.append(fit.names.index("accelerometer.bias[0]"))
    assert_allclose(np.asarray(fit.covariance)[np.ix_(rows, rows)], expected, rtol=1e-5, atol=1e-5 * expected.max())


# --- statistics on means --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def many():
    """300 units in eight positions, noise drawn on the means; the poses' is three times what is stated."""
    units, rng = 300, np.random.default_rng(11)
    exact, made = scheme_stations(Positions(8), unit(1)), []
    for _ in range(units):
        drawn = {}
        for name, size in (("accelerometer", 3.0), ("gyroscope", 1.0)):
            sigma = np.sqrt(np.diagonal(getattr(exact, f"{name}_covariance"), axis1=1, axis2=2)).T
            drawn[f"{name}_mean"] = getattr(exact, f"{name}_mean") + size * sigma * rng.standard_normal(sigma.shape)
        made.append(replace(exact, **drawn))
    stack = lambda trees: jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *trees)  # noqa: E731
    return made, fit_turntable(stack([Imu.nominal()] * units), stack(made))


def test_intervals_cover_the_truth(many):
    made, fit = many
    assert fit.converged.all()
    found = np.concatenate([np.reshape(leaf, (len(made), -1)) for leaf in jax.tree.leaves(fit.imu)], axis=1)
    inside = np.abs(found - numbers(unit(1))) <= 1.96 * fit.sigmas()
    assert 0.93 < inside.mean() < 0.97
    # three times the noise is an excess of 3² − 1 = 8; 3 axes of 8 − 4 degrees each leave it open to 41 % a unit
    assert abs(fit.excess[:, 0].mean() - 8) < 4 * 9 * np.sqrt(2 / 12) / np.sqrt(len(made))
    assert fit.excess[:, 1:].mean() < 0.5


def test_a_batch_is_its_units(many):
    made, fit = many
    alone = fit_turntable(Imu.nominal(), made[7])
    assert_allclose(alone.imu.gyroscope.gain, fit.imu.gyroscope.gain[7], rtol=0, atol=1e-9)
    assert_allclose(alone.sigmas(), fit.sigmas()[7], rtol=1e-3)


# --- schemes in words -----------------------------------------------------------------------------------------------


def test_rank_and_condition_of_schemes():
    for protocol in SCHEMES:
        assert [each.rank for each in describe_scheme(scheme_stations(protocol))] == [12, 12]
    accelerometer, _ = describe_scheme(scheme_stations(Positions(6)))
    assert_allclose(accelerometer.condition, np.sqrt(3))  # singular values √2 (three times) and √6
    accelerometer, gyroscope = describe_scheme(scheme_stations(Static(duration=10.0)))
    assert accelerometer.rank == gyroscope.rank == 3
    assert "accelerometer.gain[1,0]" in accelerometer.undetermined
    assert (
        "nothing determines the response to x" in accelerometer.text
        and "the bias cannot be told apart" in accelerometer.text
    )
    assert accelerometer.remedy[0] == "a pose with −z up" and len(accelerometer.remedy) == 3
    assert gyroscope.remedy == ("a turn about +x", "a turn about +y", "a turn about +z")
    assert not any(name.startswith("gyroscope.bias") for name in gyroscope.undetermined)


def test_the_remedy_helps():
    stations = scheme_stations(RateTable(rates=(90.0,)))
    accelerometer, _ = describe_scheme(stations)
    assert accelerometer.rank == 9 and accelerometer.remedy == ("a pose with −x up",)
    force = np.array(stations.stimulus.specific_force)
    force[np.flatnonzero(stations.accelerometer_used)[0]] = [-STANDARD_GRAVITY, 0.0, 0.0]  # one of two with x up
    mended = eqx.tree_at(lambda s: s.stimulus.specific_force, stations, force)
    assert describe_scheme(mended)[0].rank == 12


def test_a_deficient_scheme_reports_what_it_determines():
    recording, truth = simulate(unit(4), Positions(6), consumer_noise(), seed=1)
    two = [each for each in truth.schedule if each.kind == "pose" and abs(each.vector[2]) > 0.9]
    found = calibrate_turntable(recording, two, EXACT)
    assert found.rank == 9  # K_:z and b, and the gyroscope's bias: three numbers each
    nominal = found.nominal
    assert_allclose(found.imu.gyroscope.gain, nominal.gyroscope.gain, atol=1e-9)  # nothing told it: the data sheet's
    assert_allclose(found.imu.accelerometer.gain[:, :2], nominal.accelerometer.gain[:, :2], atol=1e-9)
    assert {weak.determined for weak in found.weak} == {False}
    texts = " ".join(weak.text for weak in found.weak)
    assert "a pose with this body direction up" in texts and "a full turn each way about the" in texts
    assert np.isfinite(found.covariance).all()
    left = {str(name) for name in found.names} - found.open_numbers
    assert left == {f"{one}.bias[{i}]" for one in found.triads() for i in range(3)} | {
        f"accelerometer.gain[{i},2]" for i in range(3)
    }
    written = found.document()
    assert np.equal(written["accelerometer"]["gain_sigma"], None).tolist() == [[True, True, False]] * 3
    assert np.equal(written["gyroscope"]["gain_sigma"], None).all() and None not in written["gyroscope"]["bias_sigma"]
    assert all("not determined" in row for row in found.parameters.block().rows if "misalignment x from y" in row[0])
    assert "not determined" in str(found.summary())
    bias, sigma = found.imu.gyroscope.bias, found.sigma("gyroscope")[1]
    assert (np.abs(bias - unit(4).gyroscope.bias) < 4 * sigma).all() and (sigma < 1e-3).all()


def test_a_rate_table_leaves_the_accelerometer_open_and_says_so_in_the_file(tmp_path):
    """Each axis up, none down: three combinations are open, and every number of the accelerometer is in one."""
    recording, truth = simulate(unit(4), RateTable(rates=(45.0, 90.0)), consumer_noise(), seed=2)
    found = calibrate_turntable(recording, truth.schedule, EXACT)
    assert found.open_numbers == {str(name) for name in found.names if name.owner == "accelerometer"}
    found.save(tmp_path / "calibration.json")
    again = load_calibration(tmp_path / "calibration.json")
    written = json.loads((tmp_path / "calibration.json").read_text())
    assert written["accelerometer"]["bias_sigma"] == written["accelerometer"]["bias_sigma_recording"] == [None] * 3
    assert np.asarray(written["gyroscope"]["gain_sigma"], float).max() < 1e-3
    assert again.open_numbers == found.open_numbers and again.document()["accelerometer"] == written["accelerometer"]
    assert "(accelerometer)" not in str(found.summary()).partition("As means over the recording")[2].partition(".\n")[0]


def test_rest_is_found_in_a_noisy_reference(box):
    recording, _ = box
    attitude = recording.attitude
    quaternions = scipy.spatial.transform.Rotation.from_quat(attitude.values, scalar_first=True)
    noise = np.random.default_rng(5).normal(0, np.radians(0.05), (len(attitude), 3))  # 0.8 °/s over a quarter second
    shaken = quaternions * scipy.spatial.transform.Rotation.from_rotvec(noise)
    noisy = replace(recording, attitude=replace(attitude, values=shaken.as_quat(scalar_first=True)))
    plain, found = ([each for each in entries_of_columns(one) if each.kind == "pose"] for one in (recording, noisy))
    for pose in plain:
        assert any(abs(pose.start - each.start) < 0.5 and abs(pose.stop - each.stop) < 0.5 for each in found)


def test_one_orientation_is_no_calibration():
    recording, truth = simulate(unit(4), RateTable(rates=(90.0,)), consumer_noise(), seed=1)
    two = [each for each in truth.schedule if each.kind == "pose" and abs(each.vector[2]) > 0.9]
    with pytest.raises(NotPossibleError, match=r"poses and 0 turns .* 9 of the accelerometer's 12 parameters .* open"):
        calibrate_turntable(recording, two, EXACT)


# --- from recordings ------------------------------------------------------------------------------------------------


def within(calibration, truth, sigmas=4.5):
    found = numbers(Imu(*(replace(t, effects=()) for t in calibration.triads().values())))
    return (np.abs(found - numbers(truth)) < sigmas * np.sqrt(np.diagonal(calibration.covariance))[:24]).all()


def test_schedule_is_read_back_and_calibrates(box, schedule):
    recording, truth = box
    entries = read_schedule(schedule)
    assert [each.kind for each in entries] == [each.kind for each in truth.schedule]
    for given, said in zip(entries, truth.schedule, strict=True):
        assert_allclose([given.start, given.stop, given.angle], [said.start, said.stop, said.angle], atol=1e-8)
        assert_allclose(given.vector, said.vector, atol=1e-11)
    # without the log's own attitude: the schedule alone
    bare = calibrate_turntable(replace(recording, attitude=None), entries, EXACT)
    assert bare.rank == 24 and not bare.weak and within(bare, truth.imu)
    assert bare.data["poses"] == 6 and bare.data["turns"] == 8
    for before, after, _ in bare.rms.values():
        assert after < 0.05 * before
    assert station_rms(truth.imu, bare.stations)["turn_angle"][0] < 0.05  # degrees


def test_gravity_reaches_the_scale(box):
    recording, truth = box
    found = [calibrate_turntable(recording, truth.schedule, LocalGravity(STANDARD_GRAVITY, s)) for s in (0.0, 0.01)]
    scale = [each.covariance[0, 0] for each in found]
    assert_allclose(np.sqrt(scale[1] - scale[0]), 0.01 / STANDARD_GRAVITY, rtol=0.05)


def test_reference_columns(box, tmp_path):
    recording, truth = box
    by_attitude = calibrate_turntable(recording, None, EXACT)
    assert within(by_attitude, truth.imu) and by_attitude.rank == 24
    # the same in a file of its own, on another clock's zero
    attitude = recording.attitude
    with open(tmp_path / "reference.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time [s]", "attitude_w", "attitude_x", "attitude_y", "attitude_z"])
        writer.writerows(np.column_stack([attitude.time + 100.0, attitude.values]))
    later = replace(recording, attitude=None, start=100.0)
    read = read_reference(tmp_path / "reference.csv", later)
    assert_allclose(read.attitude.time, attitude.time, atol=1e-9)
    assert within(calibrate_turntable(read, None, EXACT), truth.imu)


def test_table_rate_alone():
    recording, truth = simulate(unit(6), SingleAxisTable(duration=5.0), consumer_noise(), seed=2)
    found = calibrate_turntable(replace(recording, attitude=None), None, EXACT)
    assert found.rank == 24 and within(found, truth.imu)
    rate = recording.table_rate
    angle = Signal(rate.time, np.cumsum(rate.values[:, 0]) / recording.accelerometer.rate, "rad")
    found = calibrate_turntable(replace(recording, attitude=None, table_rate=None, table_angle=angle), None, EXACT)
    assert found.rank == 24 and within(found, truth.imu)


def test_several_recordings_of_one_unit():
    imu = unit(8)
    made = [simulate(imu, Positions(6, duration=4.0), consumer_noise(), seed=(5, k)) for k in range(2)]
    shifted = made[1][0]
    moved = replace(shifted.gyroscope, values=shifted.gyroscope.values + 0.01)  # another power-on, another bias
    found = calibrate_turntable(
        [made[0][0], replace(shifted, gyroscope=moved)], [truth.schedule for _, truth in made], EXACT
    )
    assert found.data["poses"] == 12 and within(found, imu)


def test_nonlinear_gyroscope_in_turns():
    # the nodes' mean square rate must be the samples': a quadratic axis, turns at several rates, no noise
    effect = CATALOGUE["gyro.quadratic"].make([2e-3, -1e-3, 3e-3])
    recording, truth = simulate(unit(9).with_effects(effect), RateTable(rates=(60.0, 180.0)), seed=1)
    stations, _ = observe_stations(replace(recording, attitude=None), truth.schedule, STANDARD_GRAVITY)
    start = Imu.nominal().with_effects(CATALOGUE["gyro.quadratic"].dormant())
    fit = fit_turntable(start, stations, ("gyro.quadratic",))
    assert_allclose(fit.imu.gyroscope.effects[0].coefficients, effect.coefficients, rtol=0.02)
    assert_allclose(fit.imu.gyroscope.gain, unit(9).gyroscope.gain, atol=2e-5)


def test_linearising_first_is_as_good_in_pairs_and_not_elsewhere():
    effect = CATALOGUE["accel.quadratic"].make(1e-3)
    errors = []
    for protocol in (Positions(6), HandHeld(12)):
        stations = scheme_stations(protocol, unit(1, 0.05).with_effects(effect))
        force, outputs, *_ = used_means(stations)
        straight, coefficients = remove_curvature(force, outputs)
        errors.append(np.abs(linear_least_squares(force, straight)[0] - unit(1, 0.05).accelerometer.gain).max())
        assert coefficients.shape == (3, 1)
    assert errors[0] < 1e-12 and errors[1] > 1e-4


# --- nuisance parameters --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tilted():
    """A single-axis table that is not level and does not know north, at 48°: S17."""
    tilt = CATALOGUE["setup.table_tilt"].make([2e-3, -1e-3])
    imu = unit(7).with_effects(tilt)
    noise = {name: replace(each, processes=()) for name, each in consumer_noise().items()}
    quiet = NoiseModel(AxisNoise.of_white(1e-10), AxisNoise.of_white(1e-12))
    recording, truth = simulate(
        imu, SingleAxisTable(duration=10.0), noise, rate=50.0, seed=4, environment=Environment(latitude=48.0)
    )
    return replace(recording, attitude=None, table_rate=None), truth, quiet


def test_tilt_and_earth_rotation_are_found(tilted):
    recording, truth, noise = tilted
    effects = ["setup.table_tilt", "gyro.earth_rotation"]
    found = calibrate_turntable(recording, truth.schedule, EXACT, static=noise, effects=effects)
    assert_allclose(found.imu.setup[0].coefficients, [2e-3, -1e-3], atol=2e-6)
    assert_allclose(found.imu.gyroscope.effects[0].coefficients, earth_rate(np.radians(48.0)), atol=2e-7)
    assert_allclose(found.imu.accelerometer.gain, unit(7).accelerometer.gain, atol=2e-6)
    assert found.rank == 29
    document = found.document()
    assert set(document["setup"]["effects"]) == {"setup.table_tilt"}
    assert set(document["gyroscope"]["effects"]) == {"gyro.earth_rotation"}


def test_averaging_over_the_table_cancels_tilt_and_earth(tilted):
    recording, truth, noise = tilted
    found = calibrate_turntable(recording, truth.schedule, EXACT, static=noise)
    assert found.excess["accelerometer"] > 100  # it is there, and told as scatter
    assert_allclose(found.imu.accelerometer.gain, unit(7).accelerometer.gain, atol=1e-5)
    assert_allclose(found.imu.gyroscope.bias, unit(7).gyroscope.bias, atol=1e-5)


def test_known_earth_rotation_is_held(tilted):
    recording, truth, noise = tilted
    known = calibrate_turntable(recording, truth.schedule, EXACT, static=noise, latitude=48.0)
    assert len(known.names) == 24
    assert_allclose(known.imu.gyroscope.effects[0].coefficients, earth_rate(np.radians(48.0)))
    ignored = calibrate_turntable(recording, truth.schedule, EXACT, static=noise)
    assert known.rms["rate_at_rest"][1] < 0.02 * ignored.rms["rate_at_rest"][1]
    entries = [replace(each, heading=None) for each in truth.schedule]
    with pytest.raises(NotPossibleError, match="every pose must state its heading"):
        calibrate_turntable(recording, entries, EXACT, static=noise, latitude=48.0)


@pytest.mark.parametrize("name", ["setup.table_axis", "setup.table_rate_scale", "setup.gravity"])
def test_what_gain_imitates_is_refused(box, name):
    recording, truth = box
    with pytest.raises(NotPossibleError, match=rf"\({name}\) cannot be distinguished here from bias, scale.*blind"):
        calibrate_turntable(recording, truth.schedule, EXACT, effects=[name])


def test_what_noise_hides_is_refused(box):
    recording, truth = box
    with pytest.raises(NotPossibleError, match=r"\(gyro.earth_rotation\) is hidden in the noise"):
        loud = NoiseModel(AxisNoise.of_white(1e-4), AxisNoise.of_white(1e-4))
        calibrate_turntable(recording, truth.schedule, EXACT, static=loud, effects=["gyro.earth_rotation"])
    with pytest.raises(InputError, match="unknown effect"):
        calibrate_turntable(recording, truth.schedule, EXACT, effects=["setup.nothing"])


def test_headings_follow_through_turns():
    entries = [
        ScheduleEntry(0, 5, "pose", np.array([0.0, 0, 1])),
        ScheduleEntry(5, 9, "turn", np.array([0.0, 0, 1]), np.pi / 2),
        ScheduleEntry(9, 15, "pose", np.array([0.0, 0, 1])),
        ScheduleEntry(30, 35, "pose", np.array([1.0, 0, 0])),  # after a gap nobody knows how it was turned
    ]
    found = attitudes(entries)
    assert found[3] is None
    assert_allclose((found[0].inv() * found[2]).as_rotvec(), [0, 0, np.pi / 2], atol=1e-12)
    told = attitudes([*entries[:2], replace(entries[2], heading=1.0)])
    assert_allclose(told[0].as_rotvec(), [0, 0, 1.0 - np.pi / 2], atol=1e-12)  # and backwards


# --- references that do not match -----------------------------------------------------------------------------------


def shifted(entries, seconds):
    return [replace(each, start=each.start + seconds, stop=each.stop + seconds) for each in entries]


def test_another_clock_is_told_with_its_shift(box):
    recording, truth = box
    entries = [each for each in truth.schedule if 10 < each.start < 50]
    with pytest.raises(InputError, match=r"does not match the log in time.*add \+2\.[3-7]"):
        calibrate_turntable(recording, shifted(entries, -2.5), EXACT)
    with pytest.raises(InputError, match="lies outside of the log"):
        calibrate_turntable(recording, shifted(entries, 500.0), EXACT)


def test_degrees_called_radians(box, schedule):
    recording, _ = box
    text = schedule.read_text()
    schedule.write_text(text.replace("angle [deg]", "angle [rad]"))
    with pytest.raises(InputError, match="its angles are in deg though its header says rad"):
        calibrate_turntable(recording, read_schedule(schedule), EXACT)
    entries = [replace(e, angle=np.radians(e.angle)) for e in box[1].schedule]
    with pytest.raises(InputError, match="angles are in rad though its header says deg"):
        calibrate_turntable(recording, entries, EXACT)


def test_exchanged_axes_are_no_radians(box):
    """What an axis shows of turns about another was 1/57 of the angle: "correct the unit"."""
    recording, truth = box
    leak = np.eye(3) + (np.ones((3, 3)) - np.eye(3)) / 57.3
    gyroscope = recording.gyroscope
    leaking = replace(recording, gyroscope=replace(gyroscope, values=gyroscope.values @ leak.T))
    entries = [replace(e, vector=np.asarray(e.vector)[[1, 2, 0]]) for e in truth.schedule]
    with pytest.raises(InputError, match="does not describe this turn"):
        calibrate_turntable(leaking, entries, EXACT)


def test_wrong_turns_and_poses(box):
    recording, truth = box
    entries = truth.schedule
    turned = [replace(e, angle=-e.angle) if e.angle > 6 else e for e in entries]
    with pytest.raises(InputError, match="the sense is turned round"):
        calibrate_turntable(recording, turned, EXACT)
    other = [replace(e, vector=np.roll(e.vector, 1)) if e.angle > 6 else e for e in entries]
    with pytest.raises(InputError, match="does not describe this turn"):
        calibrate_turntable(recording, other, EXACT)
    poses = [e for e in entries if e.kind == "pose"]
    with pytest.raises(InputError, match="records minus the specific force"):
        calibrate_turntable(recording, [replace(e, vector=-e.vector) for e in poses], EXACT)
    wrong = [replace(poses[0], vector=np.array([0.0, 1, 0])), *poses[1:]]
    with pytest.raises(InputError, match="the reference names another pose"):
        calibrate_turntable(recording, wrong, EXACT)
    half = (poses[0].start + poses[0].stop) / 2
    twice = [replace(poses[0], stop=half), replace(poses[0], start=half, vector=-poses[0].vector), *poses[1:]]
    with pytest.raises(InputError, match="one pose stands under two names"):
        calibrate_turntable(recording, twice, EXACT)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (",pose,", ",rest,", "row 2: kind is 'rest'; it must be pose or turn"),
        ("start [s]", "start", "row 1: the column start states no unit"),
        ("start [s]", "start [deg]", "'deg' is one of angle, expected one of time"),
        ("stop [s],", "", "row 1: the column stop is missing"),
        ("kind,x", "kind,w", "row 1: the column 'w' is not known"),
        ("0,pose,1", "0,pose,2", "has the length 2"),
        ("pose,1,0", "pose,one,0", "column x holds 'one', which is not a number"),
        ("turn,1,0,0,360", "turn,1,0,0,", "row 3: a turn needs its angle"),
    ],
)
def test_schedules_that_cannot_be_read(schedule, old, new, message):
    text = schedule.read_text().replace("3.995,pose,", "4.000,pose,")
    assert old in text
    schedule.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        read_schedule(schedule)


def test_schedules_that_contradict_themselves(schedule):
    lines = schedule.read_text().splitlines()
    schedule.write_text("\n".join([*lines, lines[1].replace(",1,0,0,", ",0,1,0,")]))
    with pytest.raises(InputError, match="one interval stands under two names"):
        read_schedule(schedule)
    schedule.write_text("\n".join([*lines, "1,2,pose,0,0,1,,"]))
    with pytest.raises(InputError, match=r"row \d+: begins at 1 s, before .*row 2 ends"):
        read_schedule(schedule)
    schedule.write_text(lines[0])
    with pytest.raises(InputError, match="holds no poses or turns"):
        read_schedule(schedule)


def sections(truth, rate=100.0):
    """The Ferraris schedule of `box` as named sections."""
    found = {}
    for each in truth.schedule:
        if each.kind == "turn" and each.angle < 6:
            continue
        axis = int(np.argmax(np.abs(each.vector)))
        kind = "rot" if each.kind == "turn" else "p" if each.vector[axis] > 0 else "a"
        found[f"{'xyz'[axis]}_{kind}"] = {"start": round(each.start * rate + 0.5), "end": round(each.stop * rate + 0.5)}
    return found


def test_named_sections(box, tmp_path):
    recording, truth = box
    path = tmp_path / "sections.json"
    named = sections(truth)
    path.write_text(json.dumps(named))
    found = calibrate_turntable(replace(recording, attitude=None), read_reference(path, recording), EXACT)
    assert within(found, truth.imu) and found.data["turns"] == 3
    assert any("in the sense that the gyroscope shows" in note for note in found.notes)
    for change, message in (
        ({"z_rot": None}, "section z_rot: must have whole numbers"),
        ({"y_a": {"start": 5, "end": 10**9}}, "is no part of the log"),
        ({"y_a": named["y_p"]}, "one interval stands under two names"),
        ({"up": {"start": 0, "end": 3}}, "section up: is not known"),
        ({"x_rot": named["x_rot"] | {"angel": 3}}, "'angel' is not understood"),
    ):
        path.write_text(json.dumps(named | change))
        with pytest.raises(InputError, match=message):
            read_reference(path, recording)
    path.write_text(json.dumps({name: each for name, each in named.items() if name != "y_rot"}))
    with pytest.raises(InputError, match="the section y_rot is missing"):
        read_reference(path, recording)
    path.write_text("{")
    with pytest.raises(InputError, match="is no JSON document"):
        read_reference(path, recording)


def test_files_that_are_no_reference(box, tmp_path):
    recording, _ = box
    path = tmp_path / "other.csv"
    path.write_text("time [s],accel_x [g]\n0,1\n1,2\n")
    with pytest.raises(InputError, match="is no reference"):
        read_reference(path, recording)
    with pytest.raises(InputError, match="cannot be read: No such file"):
        read_reference(tmp_path / "missing.csv", recording)
    with pytest.raises(InputError, match="has no reference columns"):
        calibrate_turntable(replace(recording, attitude=None), None, EXACT)


# --- imucal ---------------------------------------------------------------------------------------------------------


def test_imucals_calibration_is_reproduced(data_folder):
    folder = data_folder / "imucal"
    published = json.loads((folder / "example_cal.json").read_text())
    parts: dict[str, list] = {}
    with open(folder / "annotated_session.csv") as file:
        for row in csv.DictReader(file):
            values = [float(row[f"{sensor}_{axis}"]) for sensor in ("acc", "gyr") for axis in "xyz"]
            parts.setdefault(row["part"], []).append(values)
    means = {name: np.mean(values, axis=0) for name, values in parts.items()}

    def rows(kind):
        found = np.array([means[f"{axis}_{kind}"] for axis in "xyz"])
        return found[:, :3], found[:, 3:]

    (up, rest_up), (down, rest_down), (force, rate) = rows("p"), rows("a"), rows("rot")
    durations = np.array([len(parts[f"{axis}_rot"]) for axis in "xyz"]) / 204.8
    still = np.concatenate([parts[f"{axis}_{kind}"] for axis in "xyz" for kind in "pa"])[:, 3:].mean(axis=0)
    found = ferraris(
        up, down, rest_up, rest_down, rate * durations[:, None], force * durations[:, None], durations,
        np.full(3, -360.0), 9.81, still,
    )  # fmt: skip
    theirs = {name: np.array(value) for name, value in published.items() if isinstance(value, list)}
    assert_allclose(found["accelerometer_gain"], theirs["K_a"] @ theirs["R_a"], rtol=1e-6)
    assert_allclose(found["gyroscope_gain"], theirs["K_g"] @ theirs["R_g"], rtol=1e-6)
    assert_allclose(found["accelerometer_bias"], theirs["b_a"], rtol=1e-6)
    assert_allclose(found["gyroscope_bias"], theirs["b_g"], rtol=1e-6)
    assert_allclose(found["cross"], theirs["K_ga"], rtol=1e-6)


def test_imucals_session_from_its_files(data_folder):
    path = data_folder / "imucal" / "annotated_session.csv"
    options = ReadOptions(columns="_,_,accel [count],gyro [count]", rate=204.8, gyro_scale="16.4 count/(deg/s)")
    recording = read_recording(path, options=options)
    found = calibrate_turntable(recording, read_reference(path, recording), LocalGravity(9.81, 0.0))
    published = json.loads((data_folder / "imucal" / "example_cal.json").read_text())
    gain = np.array(published["K_a"]) @ np.array(published["R_a"])
    assert_allclose(found.imu.accelerometer.gain, gain, atol=1e-6 * 208)  # opposite pairs: least squares is the same
    assert found.rank == 24 and found.excess["accelerometer"] > 100


# --- command line ---------------------------------------------------------------------------------------------------


def test_command(box, schedule, tmp_path, capsys):
    recording, truth = box
    log = tmp_path / "log.csv"
    write_recording(replace(recording, attitude=None), log)
    given = ["turntable", str(log), "--reference", str(schedule), "--gravity", "9.80665"]
    assert main([*given, "-o", str(tmp_path / "out")]) == 0
    shown = capsys.readouterr().out
    assert "6 poses, 8 turns" in " ".join(shown.split()) and "Error of the angle of turns:" in shown
    loaded = load_calibration(tmp_path / "out" / "calibration.json")
    assert loaded.method == "turntable" and within(loaded, truth.imu)
    assert loaded.reading is not None and loaded.reading.units["accelerometer"] == "m/s^2"
    assert (tmp_path / "out" / "residuals.png").exists()
    page = (tmp_path / "out" / "report.html").read_text()
    assert "6 poses, 8 turns" in page and "not square" in page
    assert main([*given, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["fit"]["rank"] == 24
    assert main([*given, "--fit", "setup.table_axis"]) == 1
    assert "cannot be distinguished" in capsys.readouterr().err
    assert main([*given, "--earth-rotation", "known"]) == 2
    assert "needs --latitude" in capsys.readouterr().err
    assert main(["turntable", str(log), "--reference", str(tmp_path / "none.csv")]) == 2
    assert main(["turntable", str(log)]) == 2
    assert "has no reference columns" in capsys.readouterr().err


@pytest.mark.parametrize("column", ["table_rate", "table_angle"])
def test_a_table_that_turns_to_and_fro_turns_each_time(column):
    time = np.arange(3000) / 100.0
    rate = np.where((time > 5) & (time < 25), np.radians(200) * scipy.signal.sawtooth(time * 2 * np.pi / 8, 0.5), 0.0)
    gyroscope = rate[:, None] * [0.0, 0.0, 1.0] + 1e-4 * np.random.default_rng(0).standard_normal((3000, 3))
    table = {"table_rate": rate, "table_angle": np.cumsum(rate) / 100}[column]
    recording = Recording(
        Signal(time, np.tile([0.0, 0.0, 9.8], (3000, 1)), "m/s^2"),
        Signal(time, gyroscope, "rad/s"),
        **{column: Signal(time, table[:, None], "rad/s" if column == "table_rate" else "rad")},
    )
    turns = [entry for entry in entries_of_columns(recording) if entry.kind == "turn"]
    shown = [np.sum(gyroscope[(time >= turn.start) & (time < turn.stop), 2]) / 100 for turn in turns]
    assert len(turns) >= 4 and {np.sign(turn.angle) for turn in turns} == {-1.0, 1.0}
    np.testing.assert_allclose([turn.angle * turn.vector[2] for turn in turns], shown, atol=0.02)
    assert max(abs(turn.angle) for turn in turns) > np.radians(300)
