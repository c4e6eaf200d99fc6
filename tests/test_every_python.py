"""What a user does first, on every Python and both ends of the stack: `.ci/run` tries the newest versions, too."""

import json

import numpy as np
import pyarrow.parquet
import pytest

from jaximu.cli import main
from jaximu.recordings import write_recording
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

UNITS = 4


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Recordings of four units, and what they are."""
    folder = tmp_path_factory.mktemp("units")
    units = []
    for seed in range(UNITS):
        unit = draw_imu(seed)
        recording, _ = simulate(unit, HandHeld(12, 1.5), consumer_noise(), seed=seed)
        write_recording(recording, folder / f"unit{seed}.parquet")
        units.append(unit)
    return folder, units


@pytest.fixture(scope="module")
def calibration(logs, tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibration")
    assert main(["calibrate", str(logs[0] / "unit0.parquet"), "--gravity", "9.80665+-0", "-o", str(folder)]) == 0
    return folder


def test_demo_names_what_it_hid(tmp_path, capsys):
    assert main(["demo", "-o", str(tmp_path)]) == 0
    document = json.loads((tmp_path / "diagnosis.json").read_text(encoding="utf-8"))
    assert document["verdict"] == "effects"
    assert document["effects"][0]["name"] in capsys.readouterr().out
    assert (tmp_path / "report.html").stat().st_size > 10_000


def test_calibrate_holds_the_truth(logs, calibration):
    document = json.loads((calibration / "calibration.json").read_text(encoding="utf-8"))
    for triad in ("accelerometer", "gyroscope"):
        truth, part = getattr(logs[1][0], triad), document[triad]
        off = (np.array(part["gain"]) - truth.gain)[np.array(part["gain_sigma"]) > 0]
        sigma = np.array(part["gain_sigma"])[np.array(part["gain_sigma"]) > 0]
        assert np.abs(off / sigma).max() < 5


def test_diagnose_finds_nothing_where_nothing_is_hidden(logs, tmp_path):
    assert main(["diagnose", str(logs[0] / "unit0.parquet"), "-o", str(tmp_path)]) == 0
    assert json.loads((tmp_path / "diagnosis.json").read_text(encoding="utf-8"))["verdict"] == "adequate"


def test_fleet_of_four(logs, tmp_path):
    table = tmp_path / "fleet.parquet"
    assert main(["fleet", str(logs[0]), "-o", str(table)]) == 0
    rows = pyarrow.parquet.read_table(table).to_pylist()
    assert [row["status"] for row in rows] == ["ok"] * UNITS
    for row, unit in zip(sorted(rows, key=lambda row: row["file"]), logs[1], strict=True):
        np.testing.assert_allclose(np.reshape(row["accel_gain"], (3, 3)), unit.accelerometer.gain, atol=2e-3)


@pytest.mark.parametrize("target", ["kalibr", "px4", "c-header", "imu_tk"])
def test_export(calibration, target, tmp_path):
    path = tmp_path / "exported"
    assert main(["export", str(calibration / "calibration.json"), "--to", target, "-o", str(path)]) == 0
    written = list(tmp_path.iterdir())
    assert written and all(file.read_text(encoding="utf-8").strip() for file in written)
