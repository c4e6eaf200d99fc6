"""A log of a gyroscope and nothing else, turned by a table's schedule."""

import json
from dataclasses import replace

import equinox as eqx
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaximu import InputError, NotPossibleError, Recording, Signal, calibrate, compensate, load_calibration
from jaximu.calibration.turntable import calibrate_turntable
from jaximu.cli.app import main
from jaximu.model.sensor import Imu
from jaximu.recordings.readers import ReadOptions, read_recording
from jaximu.recordings.reference import entries_of_columns
from jaximu.simulation import consumer_noise, simulate
from jaximu.simulation.protocols import Ferraris

ALONE = ReadOptions(alone=True)


@pytest.fixture(scope="module")
def box():
    """Both sensors' recording without its attitude, and the truth."""
    random = np.random.default_rng(0)
    imu = eqx.tree_at(
        lambda imu: (imu.gyroscope.gain, imu.gyroscope.bias),
        Imu.nominal(),
        (np.eye(3) + 0.03 * random.uniform(-1, 1, (3, 3)), 0.02 * random.uniform(-1, 1, 3)),
    )
    recording, truth = simulate(imu, Ferraris(duration=4.0), consumer_noise(), seed=3)
    return replace(recording, attitude=None), truth


@pytest.fixture
def files(box, tmp_path):
    """The log of the gyroscope alone, and the schedule."""
    recording, truth = box
    truth.save_schedule(tmp_path / "schedule.csv")
    rows = np.column_stack([recording.gyroscope.time, np.degrees(recording.gyroscope.values)])
    header = "time [s],gyro_x [deg/s],gyro_y [deg/s],gyro_z [deg/s]"
    np.savetxt(tmp_path / "log.csv", rows, "%.12g", ",", header=header, comments="")
    return tmp_path / "log.csv", tmp_path / "schedule.csv"


def test_the_gyroscope_is_that_of_both_sensors(box, files, tmp_path):
    recording, truth = box
    both = calibrate_turntable(recording, truth.schedule)
    found = calibrate_turntable(read_recording(files[0], options=ALONE), truth.schedule)
    assert list(found.triads()) == ["gyroscope"] and all(name.owner == "gyroscope" for name in found.names)
    assert_allclose(found.imu.gyroscope.gain, both.imu.gyroscope.gain, atol=1e-8)
    assert_allclose(found.imu.gyroscope.bias, both.imu.gyroscope.bias, atol=1e-9)
    for mine, theirs in zip(found.sigma("gyroscope"), both.sigma("gyroscope"), strict=True):
        assert_allclose(mine, theirs, rtol=1e-3)
    gain_sigma, bias_sigma = found.sigma("gyroscope")
    assert np.max(np.abs(found.imu.gyroscope.gain - truth.imu.gyroscope.gain) / gain_sigma) < 4
    assert np.max(np.abs(found.imu.gyroscope.bias - truth.imu.gyroscope.bias) / bias_sigma) < 4
    assert not found.weak and set(found.rms) == {"rate_at_rest", "turn_angle"}


def test_the_file_has_no_accelerometer_and_compensates(box, files, tmp_path, capsys):
    recording, _ = box
    log, schedule = files
    assert main(["turntable", str(log), "--reference", str(schedule), "-o", str(tmp_path / "out")]) == 0
    path = tmp_path / "out" / "calibration.json"
    assert "accelerometer" not in capsys.readouterr().out
    document = json.loads(path.read_text())
    assert document["accelerometer"] is None and document["fit"]["rank"] == 12 and "rate" not in document["data"]
    found = load_calibration(path)
    assert main(["compensate", str(path), str(log), "-o", str(tmp_path / "corrected.csv")]) == 0
    corrected = read_recording(tmp_path / "corrected.csv", options=ALONE).gyroscope
    wanted = found.imu.gyroscope.recover(recording.gyroscope.values)
    assert_allclose(corrected.values, wanted, atol=1e-8)
    beside = compensate(found, recording)  # an accelerometer that nobody calibrated stays as it is
    assert_allclose(beside.gyroscope.values, wanted, atol=1e-12)
    assert beside.accelerometer is recording.accelerometer
    for verb in (["export", str(path), "--to", "kalibr"], ["check", str(path), str(log)], ["plan", str(path)]):
        capsys.readouterr()
        assert main(verb) == 2
        assert "gyroscope alone" in capsys.readouterr().err


def test_info_says_what_it_is_good_for(files, capsys):
    assert main(["info", str(files[0])]) == 0
    said = capsys.readouterr().out
    assert "jaximu turntable" in said and "No accelerometer" in said and "jaximu calibrate" not in said


def test_other_verbs_ask_for_an_accelerometer(box, files, capsys):
    assert main(["calibrate", str(files[0])]) == 2
    assert "accel_x" in capsys.readouterr().err
    alone = read_recording(files[0], options=ALONE)
    with pytest.raises(InputError, match="has no accelerometer, but one is needed"):
        calibrate(alone)
    with pytest.raises(InputError, match="has no accelerometer, but the other recording has one"):
        calibrate_turntable([box[0], alone], [box[1].schedule] * 2)
    known = calibrate_turntable(*(box[0], box[1].schedule))
    with pytest.raises(InputError, match="has no accelerometer, which the calibration needs"):
        compensate(known, alone)


def test_bad_references_are_told_as_with_both(box, files):
    alone, schedule = read_recording(files[0], options=ALONE), box[1].schedule
    with pytest.raises(InputError, match="does not match the log in time"):
        calibrate_turntable(alone, [replace(each, start=each.start - 3, stop=each.stop - 3) for each in schedule[1:]])
    turned = [replace(each, angle=-each.angle) if each.kind == "turn" else each for each in schedule]
    with pytest.raises(InputError, match="the sense is turned round"):
        calibrate_turntable(alone, turned)
    one = [each for each in schedule if each.kind == "pose"]
    with pytest.raises(NotPossibleError, match="9 of the gyroscope's 12 parameters open"):
        calibrate_turntable(alone, one)
    time = alone.gyroscope.time
    table = replace(alone, table_angle=Signal(time, np.zeros(len(time)), "rad"))
    with pytest.raises(NotPossibleError, match="a gyroscope alone"):
        entries_of_columns(table)
    with pytest.raises(NotPossibleError, match=r"\(accel\.quadratic\) cannot be distinguished here"):
        calibrate_turntable(alone, schedule, effects=["accel.quadratic"])


def test_a_file_without_either_sensor_is_refused(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("time [s],temperature [degC]\n0,20\n1,21\n2,22\n")
    with pytest.raises(InputError, match="accel_x"):
        read_recording(path, options=ALONE)


def test_signals_leave_an_absent_accelerometer_out(files):
    alone = read_recording(files[0], options=replace(ALONE, axes="y,-x,z"))
    assert set(alone.signals) == {"gyroscope"} and isinstance(alone, Recording)
