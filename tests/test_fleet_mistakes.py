"""What is no measurement is left out of a fleet's rows, and a unit in wrong axes is none of the population."""

from dataclasses import replace

import numpy as np
import pytest

from jaximu.calibration import calibrate
from jaximu.fleets import Settings, find_jobs, rows_of
from jaximu.recordings import write_recording
from jaximu.recordings.readers import read_recording
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

UNIT = draw_imu(3)


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Three logs of one unit: as it is, with a range too small for its quick turns, and with an axis turned round."""
    folder = tmp_path_factory.mktemp("fleet")
    log, _ = simulate(UNIT, HandHeld(20, 2.0), consumer_noise(), rate=100.0, seed=3)
    rate, force = log.gyroscope.values, log.accelerometer.values
    limit = 0.85 * np.abs(rate).max()
    made = {
        "clipped": replace(log, gyroscope=replace(log.gyroscope, values=np.clip(rate, -limit, limit))),
        "good": log,
        "mirrored": replace(log, accelerometer=replace(log.accelerometer, values=force * [1, -1, 1])),
    }
    for name, recording in made.items():
        write_recording(recording, folder / f"{name}.parquet")
    return folder


@pytest.fixture(scope="module")
def rows(logs):
    """The rows of the three, by device."""
    return {row["device"]: row for row in rows_of(find_jobs([logs]), Settings())}


def test_clipped_turns_are_left_out_and_said(rows):
    row = rows["clipped"]
    assert row["status"] == "ok"
    assert any("samples stop at" in note for note in row["notes"])
    off = (np.array(row["gyro_gain"]) - np.ravel(UNIT.gyroscope.gain)) / row["gyro_gain_sigma"]
    assert np.abs(off).max() < 5
    assert row["turns"] < rows["good"]["turns"]


def test_the_row_is_what_calibrate_says(rows, logs):
    for name in ("clipped", "good"):
        found = calibrate(read_recording(logs / f"{name}.parquet"))
        off = (np.array(rows[name]["gyro_gain"]) - np.ravel(found.imu.gyroscope.gain)) / rows[name]["gyro_gain_sigma"]
        assert np.abs(off).max() < 0.05
        assert set(rows[name]["notes"]) <= set(found.notes)


def test_a_unit_in_wrong_axes_is_refused_with_the_option_that_puts_it_right(rows):
    row = rows["mirrored"]
    assert row["status"] == "not possible"
    assert row["gyro_gain"] is None and row["verdict"] is None
    assert 'its y axis has the wrong sign. --axes "accel=x,-y,z" puts it right.' in row["message"]
    assert "includes it" not in row["message"]


def test_nothing_is_said_of_a_good_one(rows):
    assert rows["good"]["status"] == "ok"
    assert rows["good"]["notes"] == []
