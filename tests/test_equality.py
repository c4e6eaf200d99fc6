"""Results compare with `==`: equal where all numbers are, and never an error about arrays."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import recording

import jaximu
from jaximu.mistakes import prepare


@pytest.fixture(scope="module")
def log():
    """A recording of a simulated unit."""
    return recording(3, poses=14)[0]


def test_recordings(log):
    again = recording(3, poses=14)[0]
    assert log == again
    changed = np.array(log.accelerometer.values)
    changed[5, 1] += 1e-12
    assert log != replace(log, accelerometer=replace(log.accelerometer, values=changed))
    gap = np.where(np.arange(len(changed))[:, None] == 4, np.nan, changed)
    one, other = (replace(log.accelerometer, values=gap.copy()) for _ in range(2))
    assert one == other
    assert log != "a recording"
    assert jaximu.segment(log) == jaximu.segment(again)


def test_calibrations_and_their_files(log, tmp_path):
    calibration = jaximu.calibrate(log)
    assert calibration == jaximu.calibrate(log)
    calibration.save(tmp_path / "calibration.json")
    assert jaximu.load_calibration(tmp_path / "calibration.json") == calibration
    assert hash(jaximu.load_calibration(tmp_path / "calibration.json")) == hash(calibration)
    other = replace(calibration, covariance=calibration.covariance * 1.0000001)
    assert calibration != other
    assert calibration != calibration.document()


def test_fits_and_data(log):
    data = jaximu.observe(log)
    assert data == jaximu.observe(log)
    assert data == jaximu.observe(prepare(log)) == jaximu.observe([prepare(log)])
    fit = jaximu.fit(jaximu.Imu.nominal(), data)
    assert fit == jaximu.fit(jaximu.Imu.nominal(), data)
    assert fit.imu == jaximu.fit(jaximu.Imu.nominal(), data).imu


def test_diagnoses(log):
    found = jaximu.diagnose(log)
    assert found == jaximu.diagnose(log)
    assert found != replace(found, p_value=found.p_value / 2)
