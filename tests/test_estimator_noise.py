"""Multipliers of white noise for an estimator: closed forms, simulated truth, coverage, and the files of each tool."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from attitude_motion import GRAVITY, move
from scipy.spatial.transform import Rotation
from test_consequences import PLACE, calibration_of, noise_file

from jaximu import InputError, LocalGravity, NotPossibleError
from jaximu.cli.app import main
from jaximu.estimation.problem import names_of
from jaximu.model import Noise, White
from jaximu.model.sensor import Imu, Triad
from jaximu.model.stimulus import Stimulus
from jaximu.navigation.estimator_noise import MeasuredErrors, ModelledErrors, estimator_noise, nees, steady_stamps
from jaximu.navigation.trajectory import Trajectory, level_driving, of_recording
from jaximu.noise.stated import read_sensor_noise
from jaximu.recordings.attitude import Attitude
from jaximu.recordings.recording import Recording, Signal
from jaximu.report.estimator_noise import statements
from jaximu.report.export.noise import TARGETS, noise_files, noise_values
from jaximu.simulation import consumer_noise, simulate
from jaximu.simulation.protocols import HandHeld

RATE, TURN, G = 50.0, 0.5, 9.81
WHITE = {"accelerometer": {"N": np.full(3, 2e-3)}, "gyroscope": {"N": np.full(3, 2e-4)}}
WALK = {"accelerometer": {"K": np.full(3, 1e-4)}, "gyroscope": {"K": np.full(3, 1e-5)}}
BOTH = {triad: WHITE[triad] | WALK[triad] for triad in WHITE}


def turning(seconds=80.0):
    """Turns about z at 0.5 rad/s, one way and back, under gravity: on average neither rate nor force along x and y."""
    count = round(seconds * RATE)
    rate = np.zeros((count, 3))
    rate[:, 2] = np.where(np.arange(count) < count // 2, TURN, -TURN)
    force = np.tile([0.0, 0.0, G], (count, 1))
    stimulus = Stimulus(force, rate, time=np.arange(count) / RATE)
    return Trajectory(level_driving(PLACE, 20.0).start, stimulus, np.full(count, 1 / RATE), "turns").cut()


def scale_unknown(sigma):
    """A unit of which the gyroscope's scale about z alone is uncertain."""
    imu = Imu.nominal()
    calibration = calibration_of(imu)
    names = names_of(imu)
    variance = [sigma**2 if name == "gyroscope.gain[2,2]" else 0.0 for name in names]
    return replace(calibration, names=names, covariance=np.diag(variance))


def test_a_perfect_calibration_needs_no_multiplier():
    found = estimator_noise(ModelledErrors(scale_unknown(1e-12), turning()), BOTH)
    for triad in found.triads.values():
        for values in (triad.multiplier, triad.low, triad.high):
            np.testing.assert_allclose(values, 1.0, rtol=1e-6)
    for values in found.nees.values():
        np.testing.assert_allclose(values, 1.0, rtol=1e-6)
    assert found.densities()["gyroscope_random_walk"] == pytest.approx(1e-5)
    assert not list(statements(found))


def test_an_unknown_scale_adds_up_as_the_angle_does():
    # over T the angle is off by σ ω T on one of three axes, where white noise makes N √T on each
    found = estimator_noise(ModelledErrors(scale_unknown(1e-3), turning()), WHITE, lengths=(0.1, 1.0, 10.0), draws=4000)
    expected = (1e-3 * TURN) ** 2 * found.lengths / (2e-4) ** 2 / 3
    triad = found.triads["gyroscope"]
    np.testing.assert_allclose(triad.multiplier, np.sqrt(1 + expected), rtol=1e-6)
    np.testing.assert_allclose(triad.terms["gyroscope scale"], np.sqrt(expected), rtol=1e-6)
    # of one unit the scale is off by z σ, z² between 0.00098 and 5.02 in 95 of 100
    np.testing.assert_allclose(triad.low, np.sqrt(1 + 0.00098 * expected), rtol=5e-3)
    np.testing.assert_allclose(triad.high, np.sqrt(1 + 5.02 * expected), rtol=0.06)
    np.testing.assert_allclose(found.triads["accelerometer"].multiplier, 1.0, rtol=1e-6)  # gravity lies along z
    chosen = found.nees["rotation"][:, 1]
    assert chosen[1] == pytest.approx(1.0, rel=1e-6) and chosen[0] < 0.8 and chosen[2] > 1.25
    assert "No white noise makes the NEES of rotation one" in next(statements(found)).text


def test_a_bias_is_a_state_of_the_estimator():
    imu = Imu.nominal()
    sigma = {("gyroscope", "bias"): 1.0, ("accelerometer", "bias"): 1.0}
    found = estimator_noise(ModelledErrors(calibration_of(imu, sigma), turning()), WHITE)
    for triad in found.triads.values():
        np.testing.assert_allclose(triad.multiplier, 1.0, rtol=1e-9)


def test_bias_instability_becomes_the_walk_that_departs_as_far():
    noise = {triad: terms | {"B": 0.3 * terms["N"]} for triad, terms in WHITE.items()}
    found = estimator_noise(ModelledErrors(scale_unknown(1e-12), turning()), noise, interval=1.0)
    np.testing.assert_allclose(found.triads["gyroscope"].multiplier, 1.0, atol=0.02)
    assert found.nees["rotation"][1] == pytest.approx(1.0, abs=0.01)
    # flicker departs by about 2 B² ln over a stretch, a walk by W² T: of the same order, and far above K, which is none
    assert 0.1 * 0.3 * 2e-4 < found.triads["gyroscope"].walk[1] < 10 * 0.3 * 2e-4


def test_power_that_a_recording_has_beyond_its_noise():
    density = {"gyroscope": np.full(3, 2e-4), "accelerometer": np.full(3, 2e-3)}
    driven = level_driving(PLACE, 200.0, rate=RATE)
    assert driven.excess_power(density) == {}  # nothing was recorded
    smooth = replace(driven, recorded=True)
    assert smooth.excess_power(density) == {"gyroscope": 0.0, "accelerometer": 0.0}
    noise = 2 * 2e-4 * np.sqrt(RATE) * np.random.default_rng(3).standard_normal((len(driven.intervals), 3))
    rate = np.asarray(driven.stimulus.angular_rate) + noise
    loud = replace(smooth, stimulus=replace(driven.stimulus, angular_rate=rate))
    excess = loud.excess_power(density)["gyroscope"]
    assert excess == pytest.approx(3.0, rel=0.3)  # twice the noise: four times the power, one of it known
    found = estimator_noise(ModelledErrors(scale_unknown(1e-12), loud), WHITE)
    np.testing.assert_allclose(found.triads["gyroscope"].multiplier, np.sqrt(1 + excess), rtol=1e-6)
    assert "vibration and sampling" in found.triads["gyroscope"].terms


def test_late_stamps_cost_what_changes_meanwhile():
    # a rate that grows by a in a second is off by a j where a stamp is off by j: over a sample of h, a j h of angle
    count, growth, jitter = round(40 * RATE), 0.02, 2e-4
    rate = np.zeros((count, 3))
    rate[:, 2] = growth * (np.arange(count) / RATE - 20)
    stimulus = Stimulus(np.tile([0.0, 0.0, G], (count, 1)), rate, time=np.arange(count) / RATE)
    start = level_driving(PLACE, 20.0).start
    path = Trajectory(start, stimulus, np.full(count, 1 / RATE), "a ramp", (), True, jitter).cut()
    found = estimator_noise(ModelledErrors(scale_unknown(1e-12), path), WHITE)
    expected = growth * jitter / np.sqrt(RATE) / 2e-4 / np.sqrt(3)
    share = np.sqrt(1 - 1 / (found.lengths * RATE))  # the first sample of a stretch has none before it
    np.testing.assert_allclose(found.triads["gyroscope"].terms["time stamps"], expected * share, rtol=1e-3)


def test_a_recording_tells_how_its_stamps_scatter():
    recording, _ = simulate(Imu.nominal(), HandHeld(6, 2.0, initial_rest=3.0), consumer_noise(), seed=1)
    late = 1e-4 * np.random.default_rng(0).standard_normal(len(recording.gyroscope.time))
    shaken = replace(
        recording, gyroscope=replace(recording.gyroscope, time=recording.gyroscope.time + late), temperature=None
    )
    path = of_recording(shaken, calibration_of(Imu.nominal()), PLACE)
    assert path.recorded and path.jitter == pytest.approx(1e-4, rel=0.1)
    even = of_recording(replace(recording, temperature=None), calibration_of(Imu.nominal()), PLACE)
    assert even.jitter < 1e-9


def flown(seed, gyroscope=1.0, accelerometer=1.0, seconds=60.0, every=5):
    """A unit on a swinging path, with so many times its white noise, and the truth at every fifth sample."""
    count = round(seconds * RATE)
    time = np.arange(count + 1) / RATE
    angles = np.stack([0.4 * np.sin(0.9 * time), 0.3 * np.sin(1.3 * time + 1), 0.5 * time], axis=1)
    truth = Rotation.from_euler("XYZ", angles)
    rate = (truth[:-1].inv() * truth[1:]).as_rotvec() * RATE
    middle = truth[:-1] * Rotation.from_rotvec(rate / RATE / 2)
    pull = np.stack([np.sin(0.7 * time[:-1]), np.cos(1.1 * time[:-1]), 0.3 * np.sin(time[:-1])], axis=1)
    velocity = np.concatenate([np.zeros((1, 3)), np.cumsum(pull / RATE, axis=0)])
    force = middle.inv().apply(pull + [0.0, 0.0, G])
    size = {"gyroscope": gyroscope * 2e-4, "accelerometer": accelerometer * 2e-3}
    drawn = {
        triad: Noise((White(size[triad]),), quantity).sample(count, RATE, seed)
        for triad, quantity in (("gyroscope", "angular_rate"), ("accelerometer", "specific_force"))
    }
    rows = np.arange(0, count + 1, every)
    return MeasuredErrors(
        rate + drawn["gyroscope"], force + drawn["accelerometer"], time[:-1], time[1:], time[rows],
        truth[rows].as_quat(scalar_first=True), velocity[rows], None, G, np.ones(len(rows), bool), "a flight",
    )  # fmt: skip


def test_measured_errors_tell_the_noise_and_intervals_hold():
    inside, scores = [], []
    for seed in range(12):
        found = estimator_noise(flown(seed, gyroscope=3.0), WHITE, lengths=(0.1, 1.0))
        each = found.triads["gyroscope"]
        inside += list((each.low < 3.0) & (each.high > 3.0))
        scores.append(each.multiplier)
        assert found.nees["rotation"][1, 1] == pytest.approx(1.0, rel=1e-6)
    np.testing.assert_allclose(np.mean(scores, axis=0), 3.0, rtol=0.06)
    assert np.mean(inside) > 0.8


def test_the_gyroscopes_errors_are_not_the_accelerometers():
    source = flown(1, gyroscope=60.0, accelerometer=2.0, every=1)
    found = estimator_noise(source, WHITE, lengths=(1.0,))
    assert found.triads["gyroscope"].multiplier[0] == pytest.approx(60.0, rel=0.2)
    triad = found.triads["accelerometer"]
    assert triad.multiplier[0] < 15.0  # of what sixty times the gyroscope's noise does to Δv, next to nothing
    assert nees(source, WHITE, 1.0, {"gyroscope": 60.0, "accelerometer": 2.0})["velocity"] == pytest.approx(1, abs=0.3)
    assert nees(source, WHITE, 1.0, {"gyroscope": 1.0, "accelerometer": 1.0})["velocity"] > 100


def test_noise_never_falls_below_that_at_rest():
    quiet = estimator_noise(flown(2, gyroscope=0.3), WHITE, lengths=(1.0,))
    assert quiet.triads["gyroscope"].multiplier[0] < 0.5 and "no quieter than at rest" in next(statements(quiet)).text
    assert quiet.densities()["gyroscope_noise_density"] == pytest.approx(2e-4)
    found = estimator_noise(replace(flown(2), velocity=None), WHITE, lengths=(1.0,))
    assert found.triads["accelerometer"].multiplier[0] == 1.0 and set(found.nees) == {"rotation"}
    assert any("neither velocity nor position" in note for note in found.notes)


def test_against_a_tracker_the_biases_are_found_and_the_gains_kept():
    made = move(4)
    recording = Recording(Signal(made.time, made.force, "m/s^2"), Signal(made.time, made.rate, "rad/s"))
    attitude = Attitude(made.stamp - made.stamp[0], made.quaternion, made.velocity, start=float(made.stamp[0]))
    truth = made.truth
    nominal = Imu.nominal()
    exact = Imu(
        Triad(truth["gain_a"], np.zeros(3)),
        Triad(truth["gain_g"], np.zeros(3), quantity="angular_rate", output_unit="rad/s"),
    )
    gravity = LocalGravity(GRAVITY, 0.0)

    def angles(source):
        errors = source.over(2.0).errors
        return np.sqrt(np.mean(errors[:, :3] ** 2))

    # the tracker's own noise of 3e-4 rad at both ends, far below what nominal gains make of the turns
    assert angles(MeasuredErrors.of(exact, recording, attitude, gravity)) < 1e-3
    assert angles(MeasuredErrors.of(nominal, recording, attitude, gravity)) > 5e-3


def test_leaps_of_the_reference_are_left_out():
    time = np.arange(200) / 100
    velocity = np.sin(time)[:, None] * np.ones(3) + 1e-3 * np.random.default_rng(0).standard_normal((200, 3))
    acceleration = np.cos(time)[:, None] * np.ones(3)
    assert steady_stamps(time, velocity, acceleration).all()
    velocity[120] += 1.0
    kept = steady_stamps(time, velocity, acceleration)
    assert not kept[119:122].any() and kept[:115].all() and kept[126:].all()


def test_what_is_too_short_or_unstated_is_refused():
    source = ModelledErrors(scale_unknown(1e-3), turning())
    with pytest.raises(NotPossibleError, match="states are 30 s apart"):
        estimator_noise(source, WHITE, interval=30.0)
    with pytest.raises(InputError, match="no white noise N of the accelerometer"):
        estimator_noise(source, {"gyroscope": WHITE["gyroscope"]})
    with pytest.raises(InputError, match="no interval"):
        estimator_noise(source, WHITE, interval=-1.0)
    with pytest.raises(NotPossibleError, match="no covariance"):
        estimator_noise(ModelledErrors(calibration_of(Imu.nominal(), {}), turning()), WHITE)
    short = estimator_noise(ModelledErrors(scale_unknown(1e-3), turning(seconds=20.0)), WHITE)
    assert len(short.lengths) == 2 and "too short for stretches of 10 s" in short.notes[0]


# --- the files

DENSITIES = {
    "accelerometer_noise_density": 2e-3, "gyroscope_noise_density": 3e-4, "accelerometer_random_walk": 5e-4,
    "gyroscope_random_walk": 7e-6, "integration_covariance": 4e-9,
}  # fmt: skip
EXPECTED = {  # by hand: accelerometer, gyroscope, their walks
    "kalibr": (2e-3, 3e-4, 5e-4, 7e-6),
    "openvins": (2e-3, 3e-4, 5e-4, 7e-6),
    "lio-sam": (2e-3, 3e-4, 5e-4, 7e-6),
    "gtsam": (4e-6, 9e-8, 2.5e-7, 4.9e-11),
    "vins": (0.04, 0.006, 7.0710678e-3, 9.8994949e-5),  # 200 Hz: √400 = 20, √200 = 14.142
    "px4": (0.02, 0.003, 5e-3, 7e-5),  # 10 ms: √100 = 10
    "ardupilot": (0.0182574186, 2.7386128e-3, 4.5643546e-3, 6.3900965e-5),  # 12 ms: √(1/0.012) = 9.1287
}


@pytest.mark.parametrize("name", TARGETS)
def test_each_tools_numbers(name):
    values = noise_values(name, DENSITIES, 200.0)
    assert tuple(values.values()) == pytest.approx(EXPECTED[name], rel=1e-6)
    for content in noise_files(name, DENSITIES, 200.0, ("by jaximu",)).values():
        text = content.decode()
        for key, value in values.items():
            stated = re.search(rf"{key}[\W_]+([0-9.e+-]+)", text)
            assert stated and float(stated[1]) == pytest.approx(value, rel=1e-5), key
        assert TARGETS[name].kind.split()[0] in text and "by jaximu" in text


@pytest.mark.parametrize(("name", "step"), [("px4", 0.01), ("ardupilot", 0.012)])
def test_an_autopilots_filter_lets_angle_and_bias_spread_as_the_densities_say(name, step):
    """A step adds (σ Δt)² to the angle's variance and (w Δt)² to the bias's."""
    acc, gyro, acc_walk, gyro_walk = noise_values(name, DENSITIES, None).values()
    steps = round(6.0 / step)
    assert steps * (gyro * step) ** 2 == pytest.approx(DENSITIES["gyroscope_noise_density"] ** 2 * 6.0)
    assert steps * (acc * step) ** 2 == pytest.approx(DENSITIES["accelerometer_noise_density"] ** 2 * 6.0)
    assert steps * (gyro_walk * step) ** 2 == pytest.approx(DENSITIES["gyroscope_random_walk"] ** 2 * 6.0)
    assert steps * (acc_walk * step) ** 2 == pytest.approx(DENSITIES["accelerometer_random_walk"] ** 2 * 6.0)


def test_gtsams_snippets_are_whole():
    files = noise_files("gtsam", DENSITIES, 200.0)
    compile(files["gtsam_noise.py"], "gtsam_noise.py", "exec")
    for text in (each.decode() for each in files.values()):
        assert "4.000000e-09" in text and "integrationCovariance is no sensor noise" in text
    cpp = files["gtsam_noise.h"].decode()
    assert cpp.count("{") == cpp.count("}") and cpp.count("(") == cpp.count(")")


def test_what_a_tool_lacks_is_said():
    with pytest.raises(NotPossibleError, match="VINS-Fusion needs gyroscope_random_walk"):
        noise_values("vins", DENSITIES | {"gyroscope_random_walk": 0.0}, 200.0)
    with pytest.raises(NotPossibleError, match="the rate"):
        noise_values("vins", DENSITIES, None)


# --- the command

SPECIFICATION = """
rate = 50
[protocol]
kind = "hand-held"
poses = 20
pose_duration = 0.5
"""
PUBLISHED = """
accelerometer_noise_density: 2.0e-3
accelerometer_random_walk: 3.0e-3
gyroscope_noise_density: 1.7e-4
gyroscope_random_walk: 2.0e-5
"""


def test_the_command_writes_the_estimators_files(tmp_path, capsys):
    calibration_of(Imu.nominal()).save(tmp_path / "calibration.json")
    (tmp_path / "spec.toml").write_text(SPECIFICATION)
    (tmp_path / "imu.yaml").write_text(PUBLISHED)
    assert read_sensor_noise(tmp_path / "imu.yaml")["gyroscope"]["K"] == pytest.approx(2e-5)
    line = ["consequences", str(tmp_path / "calibration.json"), "--draws", "0"]
    path = [*line, "--path", str(tmp_path / "spec.toml"), "--noise", str(tmp_path / "imu.yaml")]
    assert main([*path, "--noise-for", "vins-fusion,gtsam", "--json", "-o", str(tmp_path / "out")]) == 0
    document = json.loads(capsys.readouterr().out)
    found = document["estimator_noise"]
    assert set(found["files"]) == {"vins.yaml", "gtsam_noise.py", "gtsam_noise.h"}
    assert found["gyroscope"]["multiplier"][1] > 1.0 and found["schema"] == "jaximu.estimator-noise/1"
    for name, text in found["files"].items():
        assert (tmp_path / "out" / name).read_text() == text
    assert json.loads((tmp_path / "out" / "estimator_noise.json").read_text())["nees"] == found["nees"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "multiply the gyroscope&#39;s white noise by" in page and "vins.yaml" in page
    assert document["schema"] == "jaximu.consequences/1"
    for wrong, status, said in (
        ([*line, "--noise-for", "gtsam"], 2, "--noise"),
        ([*path, "--noise-for", "gtsma"], 2, "did you mean 'gtsam'"),
        ([*path, "--noise-for", " , "], 2, "names no estimator"),
        ([*path, "--noise-for", "px4", "--noise-interval", "20"], 1, "too short|states are 20 s apart"),
        ([*path, "--reference", str(tmp_path / "imu.yaml")], 2, "--reference goes with --path LOG"),
        ([*line, "--noise-for", "px4", "--noise", str(noise_file(tmp_path / "a.json", ""))], 2, "no unit"),
        ([*line, "--noise-for", "px4", "--noise", str(noise_file(tmp_path / "b.json"))], 1, "accelerometer_noise"),
    ):
        assert main(wrong) == status
        assert re.search(said, capsys.readouterr().err), said


def test_the_command_takes_a_reference(tmp_path, capsys):
    made = move(4)
    log, tracker = tmp_path / "log.csv", tmp_path / "tracker.csv"
    columns = "time [s],accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2],gyro_x [rad/s],gyro_y [rad/s],gyro_z [rad/s]"
    np.savetxt(log, np.column_stack([made.time, made.force, made.rate]), delimiter=",", header=columns, comments="")
    columns = "time [s],qw,qx,qy,qz,velocity_x [m/s],velocity_y [m/s],velocity_z [m/s]"
    np.savetxt(tracker, np.column_stack([made.stamp, made.quaternion, made.velocity]), delimiter=",", header=columns,
               comments="")  # fmt: skip
    calibration_of(Imu.nominal()).save(tmp_path / "calibration.json")
    (tmp_path / "imu.yaml").write_text(PUBLISHED)
    line = ["consequences", str(tmp_path / "calibration.json"), "--path", str(log), "--noise",
            str(tmp_path / "imu.yaml"), "--noise-for", "px4", "--draws", "0", "--duration", "40", "--json"]  # fmt: skip
    assert main([*line, "--reference", str(tracker), "-o", str(tmp_path / "out")]) == 0
    found = json.loads(capsys.readouterr().out)["estimator_noise"]
    assert found["errors"].startswith("measured against") and found["expected"]["errors"].startswith("expected")
    # scales that are off by half a percent, which the calibration does not know of
    assert found["gyroscope"]["low"][1] > found["expected"]["gyroscope"]["multiplier"][1] > 1
    assert "EKF2_GYR_NOISE" in (tmp_path / "out" / "ekf2.params").read_text()
