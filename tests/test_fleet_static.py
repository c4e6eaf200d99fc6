"""Recordings at rest for a fleet: whose is whose, and that fit and diagnosis take their noise from them."""

import numpy as np
import pytest

from jaximu.calibration import calibrate
from jaximu.cli import main
from jaximu.fleets import Job, Settings, find_jobs, rows_of
from jaximu.ground.errors import InputError
from jaximu.ground.gravity import LocalGravity
from jaximu.model.noise_model import NoiseModel
from jaximu.recordings import write_recording
from jaximu.recordings.readers import read_recording
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld, Static

GRAVITY = LocalGravity(9.80665, 0.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two units' logs, one's recording at rest in a folder beside them, and one that is none."""
    path = tmp_path_factory.mktemp("logs")
    (path / "rest").mkdir()
    for seed, name in enumerate("ab"):
        imu = draw_imu(seed)
        write_recording(simulate(imu, HandHeld(12, 1.5), consumer_noise(), seed=seed)[0], path / f"{name}.parquet")
        if name == "a":
            still, _ = simulate(imu, Static(600.0), consumer_noise(), seed=seed, power_on=1)
            write_recording(still, path / "rest" / "a.parquet")
    (path / "rest" / "c.csv").write_text("neither this\nnor that\n")
    return path


def test_whose_is_whose(folder, tmp_path):
    files = {job.device: job.static for job in find_jobs([folder], static=folder / "rest")}
    assert files == {"a": str(folder / "rest" / "a.parquet"), "b": ""}  # and those at rest are no logs of the fleet
    one = folder / "rest" / "a.parquet"
    assert {job.static for job in find_jobs([str(folder / "*.parquet")], static=one)} == {str(one)}
    manifest = folder / "list.csv"
    manifest.write_text("device,file,static\na,a.parquet,rest/c.csv\nb,b.parquet,\n")
    files = {job.device: job.static for job in find_jobs([manifest], static=one)}
    assert files == {"a": str(folder / "rest" / "c.csv"), "b": str(one)}
    manifest.unlink()
    with pytest.raises(InputError, match="no such file or folder"):
        find_jobs([folder], static=folder / "nothing")
    with pytest.raises(InputError, match="holds no logs"):
        find_jobs([folder], static=tmp_path)
    for name in ("a.csv", "a.parquet"):
        (tmp_path / name).write_text("x")
    with pytest.raises(InputError, match="both called after a"):
        find_jobs([folder], static=tmp_path)


def test_a_changed_recording_at_rest_makes_another_row(folder, tmp_path):
    still = tmp_path / "still.csv"
    still.write_text("1")
    job = Job("a", str(folder / "a.parquet"), static=str(still))
    before = Settings().key(job)
    assert before != Settings().key(Job("a", str(folder / "a.parquet")))
    still.write_text("12")
    assert Settings().key(job) != before


def test_the_fit_takes_its_noise_from_it(folder):
    """The row is the calibration of that unit with `static`, and not that without; beside it others are fitted."""
    still = folder / "rest" / "a.parquet"
    jobs = [
        Job("a", str(folder / "a.parquet"), static=str(still)),
        Job("b", str(folder / "b.parquet")),
        Job("a again", str(folder / "a.parquet")),
        Job("bad", str(folder / "b.parquet"), static=str(folder / "rest" / "c.csv")),
        Job("moving", str(folder / "b.parquet"), static=str(folder / "a.parquet")),
    ]
    tied, other, alone, bad, moving = rows_of(jobs, Settings(gravity=GRAVITY))
    assert [row["status"] for row in (tied, other, alone)] == ["ok"] * 3
    assert tied["static"] == str(still) and other["static"] is None
    single = calibrate(read_recording(folder / "a.parquet"), GRAVITY, static=read_recording(still))
    for start, (name, triad) in zip(("accel", "gyro"), single.triads().items(), strict=True):
        gain_sigma, bias_sigma = single.sigma(name)
        np.testing.assert_allclose(tied[f"{start}_gain"], np.ravel(triad.gain), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(tied[f"{start}_bias"], triad.bias, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(tied[f"{start}_gain_sigma"], np.ravel(gain_sigma), rtol=1e-9, atol=1e-12)
        # of a fleet it is about the mean of the process that the bias follows, not about its mean after the recording
        np.testing.assert_allclose(tied[f"{start}_bias_sigma"], bias_sigma, rtol=0.05)
    assert tied["rank"] == single.rank == 21
    assert tied["gyro_rms"] == pytest.approx(single.rms["gravity_direction"][1], rel=1e-9)
    # white noise alone: both say the same to the accuracy of the poses' scatter
    np.testing.assert_allclose(tied["accel_gain_sigma"], alone["accel_gain_sigma"], rtol=0.5, atol=1e-12)
    assert np.abs(np.array(tied["accel_gain"]) - alone["accel_gain"]).max() > 1e-9
    assert bad["status"] == "bad input" and "c.csv" in bad["message"]
    assert moving["status"] == "not possible" and "a.parquet" in moving["message"]


def test_the_diagnosis_gets_it(folder, monkeypatch):
    import jaximu.diagnosis

    given = []

    def record(recording, gravity, static=None, **_):
        given.append(static)
        raise InputError("asked.")

    monkeypatch.setattr(jaximu.diagnosis, "diagnose", record)
    jobs = [Job("a", str(folder / "a.parquet"), static=str(folder / "rest" / "a.parquet")),
            Job("b", str(folder / "b.parquet"))]  # fmt: skip
    rows = rows_of(jobs, Settings(gravity=GRAVITY, diagnose=True))
    assert isinstance(given[0], NoiseModel) and given[1] is None
    assert [row["message"] for row in rows] == ["not diagnosed: asked."] * 2


def test_the_command(folder, tmp_path, capsys):
    arguments = ["fleet", str(folder), "-o", str(tmp_path / "t.parquet"), "--workers", "1", "--static"]
    assert main([*arguments, str(folder / "rest")]) == 0
    printed = capsys.readouterr()
    assert "1 of 2 have no recording at rest" in printed.err and "All recordings were calibrated" in printed.out
    assert main([*arguments, str(folder / "nothing")]) == 2
    assert "no such file or folder" in capsys.readouterr().err
