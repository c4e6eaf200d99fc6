"""Compensation of recordings whose unit has effects: what belongs to the device goes, what does not stays."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaximu.calibration import Calibration, compensate, load_calibration
from jaximu.estimation.problem import Name
from jaximu.ground.errors import InputError
from jaximu.ground.gravity import LocalGravity
from jaximu.model.effects import CATALOGUE
from jaximu.recordings.readers import ReadOptions, read_recording
from jaximu.recordings.recording import Recording, Signal, smoothed_slope
from jaximu.report.export import write_messages
from jaximu.simulation import draw_imu, simulate
from jaximu.simulation.protocols import Environment, HandHeld

HELD = HandHeld(8, 1.0, 0.8)
WARMING = Environment(temperature=[[0, 15], [5, 40], [14, 30]])
DEVICE = {
    "accel.quadratic": {}, "accel.cubic": {}, "accel.asymmetry": {}, "accel.cross_coupling": {},
    "accel.temperature": {}, "accel.thermal_lag": {"time_constant": 4.0}, "accel.scale_temperature": {},
    "accel.misalignment_temperature": {}, "gyro.g_sensitivity": {}, "gyro.g_squared_sensitivity": {},
    "gyro.quadratic": {}, "gyro.cross_coupling": {}, "gyro.thermal_hysteresis": {"half_width": 3.0},
    "gyro.scale_temperature": {}, "gyro.misalignment_temperature": {}, "gyro.temperature_cubed": {},
}  # fmt: skip


def unit(names, size=3.0):
    made = [CATALOGUE[name].make(size * CATALOGUE[name].typical, **DEVICE.get(name, {})) for name in names]
    return draw_imu(4).with_effects(*made)


def calibration(imu) -> Calibration:
    gravity = LocalGravity(9.80665, 0.0)
    name = (Name("accelerometer", "bias", (0,)),)
    return Calibration(imu, name, np.zeros((1, 1)), gravity, "joint", "linear", {}, 0, (), {}, "known", {})


def test_every_device_effect_of_both_triads_at_once_is_removed():
    imu = unit(DEVICE)
    recording, truth = simulate(imu, HELD, seed=1, environment=WARMING)
    done = compensate(calibration(imu), recording)
    assert (done.accelerometer.unit, done.gyroscope.unit) == ("m/s^2", "rad/s")
    np.testing.assert_allclose(done.accelerometer.values, truth.stimulus.specific_force, atol=1e-9)
    np.testing.assert_allclose(done.gyroscope.values, truth.stimulus.angular_rate, atol=1e-9)
    plain = compensate(calibration(draw_imu(4)), recording)
    assert np.abs(plain.accelerometer.values - truth.stimulus.specific_force).max() > 0.1


def test_a_size_effect_is_removed_as_far_as_samples_tell_the_angular_acceleration():
    imu = unit(["accel.size_effect", "gyro.g_sensitivity"])
    recording, truth = simulate(imu, HELD, seed=1)
    force = truth.stimulus.specific_force
    left = [
        np.abs(compensate(calibration(each), recording).accelerometer.values - force).max()
        for each in (draw_imu(4), imu)
    ]
    assert left[0] > 0.1 and left[1] < 0.05 * left[0]


def test_sensors_with_stamps_of_their_own():
    imu = unit(DEVICE)
    recording, truth = simulate(imu, HELD, seed=1, environment=WARMING, rate=200.0)
    halves = {
        "accelerometer": Signal(recording.accelerometer.time[::2], recording.accelerometer.values[::2], "m/s^2"),
        "gyroscope": Signal(recording.gyroscope.time[1::2], recording.gyroscope.values[1::2], "rad/s"),
    }
    done = compensate(calibration(imu), replace(recording, **halves))
    np.testing.assert_array_equal(done.gyroscope.time, halves["gyroscope"].time)
    # the other sensor is interpolated over 10 ms, and feels through effects of a few percent of it
    np.testing.assert_allclose(done.accelerometer.values, truth.stimulus.specific_force[::2], atol=1e-3)
    np.testing.assert_allclose(done.gyroscope.values, truth.stimulus.angular_rate[1::2], atol=1e-3)


def test_what_belongs_to_a_session_is_left_and_said():
    imu = unit(["accel.bias_ramp", "gyro.temperature"])
    recording, truth = simulate(imu, HELD, seed=1, environment=WARMING)
    done = compensate(calibration(imu), recording)
    assert any("accel.bias_ramp was not removed" in note for note in done.notes)
    ramp = 3 * 1e-4 * np.asarray(truth.stimulus.time)
    left = np.linalg.solve(np.asarray(imu.accelerometer.gain), np.tile(ramp, (3, 1))).T
    np.testing.assert_allclose(done.accelerometer.values - truth.stimulus.specific_force, left, atol=1e-9)
    np.testing.assert_allclose(done.gyroscope.values, truth.stimulus.angular_rate, atol=1e-9)


def test_effects_survive_the_file(tmp_path):
    known = calibration(unit(DEVICE))
    known.save(tmp_path / "calibration.json")
    document = json.loads((tmp_path / "calibration.json").read_text())
    lag = document["accelerometer"]["effects"]["accel.thermal_lag"]
    assert lag["inner"] == {"time_constant": {"value": 4.0, "sigma": None, "unit": "s"}}
    assert lag["unit"] == "(m/s^2)/K" and lag["scope"] == "device"
    recording, _ = simulate(known.imu, HELD, seed=1, environment=WARMING)
    again = compensate(load_calibration(tmp_path / "calibration.json"), recording)
    np.testing.assert_allclose(again.gyroscope.values, compensate(known, recording).gyroscope.values, atol=1e-13)


def test_a_recording_without_what_an_effect_needs_is_refused():
    recording, _ = simulate(draw_imu(4), HELD, seed=1)
    with pytest.raises(InputError, match=r"accel\.temperature needs the temperature, which this recording"):
        compensate(calibration(unit(["accel.temperature"])), recording)


@settings(max_examples=20)
@given(rate=st.floats(1.0, 200.0), slope=st.floats(-2.0, 2.0), seed=st.integers(0, 1000))
def test_smoothed_slope_of_a_ramp_is_its_slope(rate, slope, seed):
    time = np.sort(np.random.default_rng(seed).uniform(0, 100, int(100 * rate)))
    np.testing.assert_allclose(smoothed_slope(time, 20 + slope * time, 20.0), slope, atol=1e-6)


def test_smoothed_slope_of_a_coarse_thermometer():
    """Steps of 0.1 K make the raw difference useless; a step of h gives at most 1.5 h/window."""
    time = np.arange(30_000) / 100.0
    true = 0.05 * np.cos(2 * np.pi * time / 300)
    kelvin = 25 + 0.05 * 300 / (2 * np.pi) * np.sin(2 * np.pi * time / 300)
    found = smoothed_slope(time, np.round(kelvin, 1), 20.0)
    assert np.abs(found - true)[1000:-1000].max() < 0.0075
    step = smoothed_slope(time, np.where(time > 150, 0.1, 0.0), 20.0)
    assert step.max() == pytest.approx(1.5 * 0.1 / 20, rel=1e-3)
    assert smoothed_slope(np.array([1.0]), np.array([3.0]), 20.0) == 0.0
    np.testing.assert_allclose(smoothed_slope(np.array([0.0, 100.0]), np.array([0.0, 5.0]), 1.0), 0.05)


def test_a_recording_of_one_sensor():
    imu = replace(unit(["accel.quadratic"]), gyroscope=None)
    recording, truth = simulate(imu, HELD, seed=2)
    alone = Recording(recording.accelerometer)
    done = compensate(calibration(imu), alone)
    np.testing.assert_allclose(done.accelerometer.values, truth.stimulus.specific_force, atol=1e-9)


@pytest.mark.parametrize("name", ["unit.mcap", "unit"])
@pytest.mark.parametrize("own_stamps", [False, True])
def test_messages_hold_the_log_before_and_after(name, own_stamps, tmp_path):
    imu, gravity = draw_imu(4), 9.80665
    raw, _ = simulate(imu, HELD, seed=1, environment=WARMING)
    gyroscope = raw.gyroscope
    if own_stamps:
        gyroscope = replace(gyroscope, time=gyroscope.time[1:] - 0.004, values=gyroscope.values[1:])
    raw = replace(raw, gyroscope=gyroscope, start=-2.0)  # a phone's clock that begins at the first press
    known, path = calibration(imu), tmp_path / name
    done = compensate(known, raw)
    write_messages(known, raw, done, path)
    for topic, wanted in (("/imu/raw", raw), ("/imu/corrected", done)):
        asked = f"{topic}/accelerometer,{topic}/gyroscope" if own_stamps else topic
        read = read_recording(path, options=ReadOptions(topic=asked))
        for sensor in ("accelerometer", "gyroscope"):
            ours, theirs = getattr(wanted, sensor), getattr(read, sensor)
            np.testing.assert_array_equal(ours.values, theirs.values)
            np.testing.assert_allclose(np.diff(ours.time), np.diff(theirs.time), atol=2e-9)
        if not own_stamps:  # of two topics the reader takes these alone
            np.testing.assert_allclose(raw.temperature.values, read.temperature.values)
        shift = read.gyroscope.time[0] - read.accelerometer.time[0] - gyroscope.time[0] + raw.accelerometer.time[0]
        assert abs(shift) < 2e-9
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as bag:
        (chosen,) = [each for each in bag.connections if each.topic == "/imu/residual"]
        residuals = [(at, bag.deserialize(data, chosen.msgtype).data) for _, at, data in bag.messages([chosen])]
        stamps, left = np.array(residuals).T
        assert min(stamps) >= 0 and np.all(np.diff(stamps) > 0)
        np.testing.assert_allclose(left, np.linalg.norm(done.accelerometer.values, axis=1) - gravity)
        (status,) = [each for each in bag.connections if each.topic == "/diagnostics"]
        said = next(bag.deserialize(data, status.msgtype) for _, _, data in bag.messages([status])).status[0]
        assert (said.name, said.message) == ("jaximu calibration", "not diagnosed")


def test_messages_are_whole_or_not_there(tmp_path, monkeypatch):
    raw, _ = simulate(draw_imu(4), HELD, seed=1)
    known = calibration(draw_imu(4))
    bag = tmp_path / "bag"
    bag.mkdir()
    (tmp_path / "log.csv").touch()
    with pytest.raises(InputError, match=r"bag exists: name a new folder"):
        write_messages(known, raw, raw, bag)
    with pytest.raises(InputError, match="cannot be written"):
        write_messages(known, raw, raw, tmp_path / "log.csv" / "unit.mcap")
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(InputError, match=r"pip install 'jaximu\[formats\]'"):
        write_messages(known, raw, raw, tmp_path / "unit.mcap")
    assert sorted(each.name for each in tmp_path.iterdir()) == ["bag", "log.csv"]
