"""`jaximu fleet`: one row a recording whatever happens to it, and the same row whoever computes it."""

import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pyarrow.parquet as pq
import pytest
from simulated_board import board

from jaximu.calibration import fit_hand_held, nominal_imu
from jaximu.calibration.recipe import Choices, calibrate_ready
from jaximu.cli import fleet as cli_fleet
from jaximu.cli import main
from jaximu.data import residual_rms
from jaximu.data.poses import PosesAndTurns
from jaximu.estimation.fitting import fit
from jaximu.estimation.problem import flatten, names_of, without_equipment
from jaximu.fleets import FleetUnit, Job, Settings, find_jobs, fit_units, listed_jobs, rows_of, run_fleet
from jaximu.fleets import engines as engines_module
from jaximu.fleets.population import read_fleet
from jaximu.fleets.store import Store
from jaximu.ground.errors import InputError
from jaximu.ground.gravity import LocalGravity
from jaximu.recordings import write_recording
from jaximu.recordings.readers import read_recording
from jaximu.recordings.recording import Signal
from jaximu.recordings.segmentation import observed_poses, segment
from jaximu.report.attribution import common_drift
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

UNITS, POSES = 30, 12
NUMBERS = ("accel_gain", "accel_bias", "gyro_gain", "gyro_bias")


@pytest.fixture(scope="module")
def truths():
    return {f"unit{seed:03d}": draw_imu(seed) for seed in range(UNITS)}


@pytest.fixture(scope="module")
def folder(unit_logs, tmp_path_factory) -> Path:
    """Logs of all units, and one that is none."""
    path = Path(shutil.copytree(unit_logs, tmp_path_factory.mktemp("logs") / "logs"))
    (path / "broken.csv").write_text("neither this\nnor that\n")
    return path


@pytest.fixture(scope="module")
def table(folder, tmp_path_factory):
    """The table of a run that nothing disturbed."""
    path = tmp_path_factory.mktemp("table") / "fleet.parquet"
    assert main(["fleet", str(folder), "-o", str(path), "--gravity", "9.80665+-0", "--workers", "1"]) == 0
    return pq.read_table(path)


def same(first, second, tolerance=1e-9):
    """Two tables hold the same rows: texts alike, numbers to the tolerance."""
    assert first.schema.equals(second.schema)
    left, right = first.to_pylist(), second.to_pylist()
    assert [row["file"] for row in left] == [row["file"] for row in right]
    for a, b in zip(left, right, strict=True):
        for name, value in a.items():
            if isinstance(value, list) and value and isinstance(value[0], float):
                pair = (np.array(each, float) for each in (value, b[name]))  # null where it does not apply
                np.testing.assert_allclose(*pair, rtol=tolerance, atol=tolerance, err_msg=name)
            elif isinstance(value, float):
                assert value == pytest.approx(b[name], rel=tolerance, abs=tolerance), name
            else:
                assert value == b[name], name


# --- rows -------------------------------------------------------------------------------------------------------------


def test_one_row_a_recording_and_the_truth_in_it(table, truths):
    rows = {row["device"]: row for row in table.to_pylist()}
    assert len(rows) == UNITS + 1
    assert rows["broken"]["status"] == "bad input" and "broken.csv" in rows["broken"]["message"]
    assert rows["broken"]["accel_gain"] is None
    squares = []
    for name, imu in truths.items():
        row = rows[name]
        assert row["status"] == "ok" and row["message"] is None
        assert row["poses"] == POSES and row["turns"] == POSES - 1 and row["rank"] == 21
        for column, truth in zip(NUMBERS, (imu.accelerometer.gain, imu.accelerometer.bias, imu.gyroscope.gain,
                                           imu.gyroscope.bias), strict=True):  # fmt: skip
            sigma = np.array(row[f"{column}_sigma"])
            free = sigma > 0
            squares.append((((np.array(row[column]) - np.ravel(truth)) / np.where(free, sigma, 1.0)) ** 2)[free])
    z2 = np.concatenate(squares)
    assert len(z2) == 21 * UNITS
    # χ² of as many degrees: independent between units, correlated within one by at most its 21
    assert z2.mean() == pytest.approx(1.0, abs=5 * np.sqrt(2 * 21 / len(z2)))


def test_numbers_that_a_recording_leaves_open_are_reported(tmp_path):
    """Without the rows between its rests a recording shows no gain of the gyroscope."""
    recording, _ = simulate(draw_imu(0), HandHeld(12, 1.5), consumer_noise(), seed=0)
    rate = recording.gyroscope.values
    turning = np.linalg.norm(rate - np.median(rate, axis=0), axis=1) > 0.1
    kept = np.convolve(turning, np.ones(9), "same") < 1
    cut = {
        name: replace(signal, time=signal.time[kept], values=signal.values[kept])
        for name, signal in recording.signals.items()
    }
    write_recording(replace(recording, **cut), tmp_path / "cut.parquet")
    run_fleet([Job("unit", str(tmp_path / "cut.parquet"))], tmp_path / "fleet.parquet", workers=1)
    row = pq.read_table(tmp_path / "fleet.parquet").to_pylist()[0]
    assert row["gyro_gain_sigma"] == [None] * 9 and None not in row["accel_gain_sigma"]
    assert "does not determine all of gyroscope gain: numbers whose sigma is empty" in row["message"]
    assert any("1 calibrated unit: see column message" in note for note in read_fleet(tmp_path / "fleet.parquet").notes)


def test_schema_is_the_fixed_surface(table):
    types = {field.name: str(field.type) for field in table.schema}
    assert list(types)[:6] == ["device", "file", "status", "message", "verdict", "effects"]
    for triad in ("accel", "gyro"):
        for part, size in (("gain", 9), ("bias", 3)):
            for end in ("", "_sigma"):
                assert (
                    types[f"{triad}_{part}{end}"].startswith("fixed_size_list")
                    and f"[{size}]" in types[f"{triad}_{part}{end}"]
                )
    assert types["accel_rms"] == types["gyro_rms"] == "double"


def test_agrees_with_the_calibration_of_one_recording(folder, table):
    """The recipe for one unit integrates every sample in every step, and stops its excess a thirtieth short."""
    path = folder / "unit003.parquet"
    row = next(row for row in table.to_pylist() if row["device"] == "unit003")
    single, _ = calibrate_ready(
        [read_recording(path)], Choices(LocalGravity(9.80665, 0.0))
    )  # without the biases' slow drift
    for name, triad in (("accel", "accelerometer"), ("gyro", "gyroscope")):
        gain_sigma, bias_sigma = single.sigma(triad)
        for part, sigma in (("gain", np.ravel(gain_sigma)), ("bias", bias_sigma)):
            off = np.abs(np.array(row[f"{name}_{part}"]) - np.ravel(getattr(single.triads()[triad], part)))
            assert (off <= 0.1 * sigma + 1e-12).all()
            np.testing.assert_allclose(row[f"{name}_{part}_sigma"], sigma, rtol=0.05, atol=1e-12)
    assert row["gyro_rms"] == pytest.approx(single.rms["gravity_direction"][1], rel=0.05)
    assert row["accel_rms"] == pytest.approx(single.rms["gravity_norm"][1], rel=0.05)


def test_the_answer_is_where_a_step_from_it_ends(folder):
    """A step of the data evaluated anew at the answer: a thousandth of a standard deviation at most."""
    recording = read_recording(folder / "unit005.parquet")
    unit = FleetUnit(observed_poses(segment(recording), 9.80665), nominal_imu(recording), True)
    ((fitted, _),) = fit_units([unit])
    observations = PosesAndTurns.of(jax.tree.map(lambda leaf: np.asarray(leaf)[None], unit.observations))
    exact = fit(fitted.imu, observations, without_equipment, excess=fitted.excess, estimate_excess=False, max_passes=1)
    sigma = np.sqrt(np.diagonal(fitted.covariance))
    step = exact.values - flatten(fitted.imu)[[names_of(fitted.imu).index(name) for name in exact.names]]
    assert exact.names == fitted.names
    assert np.abs(step / sigma).max() < 1e-3
    np.testing.assert_allclose(exact.sigmas(), sigma, rtol=1e-3)


def test_units_of_other_scales_and_shapes_are_fitted_as_if_alone():
    """Two shapes, two output units, one without gyroscope: each as the recipe for one unit has it."""
    cases = [(seed, poses, scale, seed != 3) for seed, (poses, scale) in
             enumerate([(12, 1.0), (12, 1.0), (9, 1.0), (12, 1.0), (12, 1000.0)])]  # fmt: skip
    units = []
    for seed, poses, scale, gyroscope in cases:
        recording, _ = simulate(draw_imu(seed), HandHeld(poses, 1.5), consumer_noise(), seed=seed)
        force = recording.accelerometer
        other = Signal(force.time, force.values / 9.80665 * scale, "mg") if scale > 1 else force
        recording = replace(recording, accelerometer=other)
        observations = observed_poses(segment(recording), 9.80665)
        units.append(FleetUnit(observations, nominal_imu(recording), gyroscope))
    for unit, (fitted, rms) in zip(units, fit_units(units), strict=True):
        single = fit_hand_held(unit.nominal, unit.observations, "joint" if unit.gyroscope else "accelerometer")
        assert fitted.names == single.names and fitted.converged == single.converged
        sigma = single.sigmas()
        np.testing.assert_allclose((fitted.values - single.values) / sigma, 0.0, atol=1e-6)
        np.testing.assert_allclose(fitted.sigmas(), sigma, rtol=1e-6)
        np.testing.assert_allclose(fitted.excess, single.excess, rtol=1e-6, atol=1e-6)
        known = residual_rms(single.imu, unit.observations, unit.gyroscope)
        np.testing.assert_allclose(rms[: 1 + 2 * unit.gyroscope], [value for value, _ in known.values()], rtol=1e-6)


def test_a_row_does_not_depend_on_its_batch(folder, table):
    settings = Settings(gravity=LocalGravity(9.80665, 0.0))
    jobs = [Job(f"unit{k:03d}", str(folder / f"unit{k:03d}.parquet")) for k in (7, 2, 11)]
    together = rows_of([*jobs, Job("none", str(folder / "missing.csv"))], settings)
    assert together[-1]["status"] == "bad input"
    (alone,) = rows_of([jobs[1]], settings)
    of_table = next(row for row in table.to_pylist() if row["device"] == "unit002")
    for column in (*NUMBERS, "covariance"):
        np.testing.assert_allclose(together[1][column], alone[column], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(together[1][column], of_table[column], rtol=1e-9, atol=1e-12)


def test_raw_counts_give_the_same_unit(folder, tmp_path):
    """The same samples as counts: gains in counts, and the fit none the wiser."""
    recording = read_recording(folder / "unit001.parquet")
    counts = np.round(recording.accelerometer.values * 1e4) + 500
    rates = np.round(recording.gyroscope.values * 1e5) - 70
    raw = type(recording)(Signal(recording.accelerometer.time, counts, "count"),
                          Signal(recording.gyroscope.time, rates, "count"))  # fmt: skip
    write_recording(raw, tmp_path / "raw.csv")
    (tmp_path / "list.csv").write_text(
        "device,file,lot,options\nA,raw.csv,7,--accel-scale 1e4 --accel-offset 500 --gyro-scale 1e5 --gyro-offset=-70\n"
    )
    (job,) = find_jobs([tmp_path / "list.csv"])
    assert (job.device, job.lot) == ("A", "7")
    row, plain = rows_of([job, Job("A", str(folder / "unit001.parquet"))], Settings())
    assert row["status"] == "ok" and row["accel_unit"] == "count"
    # rounding is a hundredth of the noise
    off = np.array(row["accel_gain"]) / 1e4 - plain["accel_gain"]
    assert (np.abs(off) <= 0.1 * np.array(plain["accel_gain_sigma"]) + 1e-12).all()
    off = (np.array(row["gyro_bias"]) + 70) / 1e5 - plain["gyro_bias"]
    assert (np.abs(off) <= 0.1 * np.array(plain["gyro_bias_sigma"])).all()


def test_what_cannot_be_calibrated_says_what_to_record(folder, tmp_path):
    recording = read_recording(folder / "unit000.parquet")
    still = {name: Signal(signal.time[:120], signal.values[:120], signal.unit) for name, signal in
             (("accelerometer", recording.accelerometer), ("gyroscope", recording.gyroscope))}  # fmt: skip
    write_recording(type(recording)(**still), tmp_path / "still.csv")
    (row,) = rows_of([Job("still", str(tmp_path / "still.csv"))], Settings())
    assert row["status"] == "not possible" and "orientations" in row["message"]


def test_reasons_are_told_once_with_their_files(folder, tmp_path, capsys):
    """Two logs without poses and one that is no log: two reasons on the terminal, on the page and in the document."""
    short = tmp_path / "short"
    short.mkdir()
    recording = read_recording(folder / "unit000.parquet")
    for name, rows in (("one", 120), ("two", 140)):
        still = {each: Signal(signal.time[:rows], signal.values[:rows], signal.unit) for each, signal in
                 (("accelerometer", recording.accelerometer), ("gyroscope", recording.gyroscope))}  # fmt: skip
        write_recording(type(recording)(**still), short / f"{name}.csv")
    shutil.copy(folder / "broken.csv", short)
    assert main(["fleet", str(short), "-o", str(tmp_path / "t.parquet"), "--workers", "1"]) == 0
    said = capsys.readouterr().out
    table = said.partition("Not calibrated")[2]
    assert table.count("one.csv, two.csv") == table.count("broken.csv") == 1, table
    document = json.loads((tmp_path / "t.json").read_text())
    assert [len(each["files"]) for each in document["failed"]] == [2, 1]
    page = (tmp_path / "t.html").read_text()
    assert "Not calibrated" in page and "one.csv, two.csv" in page and "broken.csv" in page


# --- which jobs -------------------------------------------------------------------------------------------------------


def test_folders_patterns_and_names(folder, tmp_path):
    jobs = find_jobs([folder])
    assert len(jobs) == UNITS + 1 and not any("truth" in job.file for job in jobs)
    assert [job.device for job in find_jobs([str(folder / "unit00[1-3]*")])] == ["unit001", "unit002", "unit003"]
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "log.csv").write_text("x")
        (tmp_path / name / "README.txt").write_text("Recorded at the bench.\nThe unit lay on foam.\n")
    assert [job.device for job in find_jobs([tmp_path])] == ["a/log", "b/log"]
    output = tmp_path / "a" / "fleet.parquet"
    output.write_text("an older table")
    assert len(find_jobs([tmp_path], output)) == 2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("device,file\n", "empty"),
        ("device,file\nA,x.csv\nB,x.csv\n", "row 3: x.csv stands in row 2 already"),
        ("device,file\nA,\n", "row 2: the file is missing"),
        ("device,file\nA\n", "row 2: 1 cells under 2"),
        ("device,file,colour\nA,x.csv,red\n", "unknown key 'colour' in the header"),
        ("device,file,options\nA,x.csv,--rte 100\n", "row 2: the option '--rte' is not known"),
        ("device,file,options\nA,x.csv,--rate fast\n", "--rate needs a number"),
        ("device,file,options\nA,x.csv,--rate\n", "--rate needs a value"),
    ],
)
def test_manifests_that_are_refused(tmp_path, capsys, content, message):
    (tmp_path / "list.csv").write_text(content)
    assert main(["fleet", str(tmp_path / "list.csv"), "-o", str(tmp_path / "t.parquet")]) == 2
    printed = capsys.readouterr()
    assert message in printed.err and len(printed.err.splitlines()) == 1
    assert not list(tmp_path.glob("t.parquet*"))


def test_units_and_sessions_go_into_the_table_and_from_it_to_a_diagnosis(folder, tmp_path, capsys):
    logs = [os.path.relpath(path, tmp_path) for path in sorted(folder.glob("unit00[1-4].parquet"))]
    places = [("A", "1"), ("A", "2"), ("B", "1"), ("B", "2")]
    rows = [f"{unit},{session},{log},--stamp header" for (unit, session), log in zip(places, logs, strict=True)]
    (tmp_path / "list.csv").write_text("\n".join(["unit,session,file,options", *rows]), encoding="utf-8")
    output = tmp_path / "fleet.parquet"
    arguments = [str(tmp_path / "list.csv"), "-o", str(output), "--latitude", "48.1", "--axes", "x,y,z"]
    assert main(["fleet", *arguments, "--workers", "1"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert f"`jaximu diagnose {output} --latitude 48.1 -o RESULTS`" in printed and "share no drift" in printed
    table = pq.read_table(output).to_pylist()
    assert [(row["device"], row["unit"], row["session"]) for row in table] == [(u, u, s) for u, s in places]
    listed = {name: listed_jobs(path) for name, path in (("list", tmp_path / "list.csv"), ("table", output))}
    for jobs in listed.values():
        assert [(job.unit, job.session) for job in jobs] == places
        assert [Path(job.file).resolve() for job in jobs] == [(tmp_path / log).resolve() for log in logs]
    assert dict(listed["table"][0].options) == {"stamp": "header", "axes": "x,y,z"}
    assert listed_jobs(folder / "unit001.parquet") is None


def test_a_drift_that_units_of_a_session_share_is_on_the_fleets_page(tmp_path, capsys):
    for recording in board(1, 3, 2, {}, [1]):
        write_recording(recording, tmp_path / Path(recording.name).name)
    rows = [f"{unit},{session},unit{unit}_session{session}.csv" for unit in (1, 2, 3) for session in (1, 2)]
    (tmp_path / "list.csv").write_text("\n".join(["unit,session,file", *rows]), encoding="utf-8")
    output = tmp_path / "fleet.parquet"
    assert main(["fleet", str(tmp_path / "list.csv"), "-o", str(output), "--workers", "1"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "All units drift together in session 2" in printed and "supply" in printed
    alone, warm = read_fleet(output).drifts
    assert (alone.session, warm.session) == ("1", "2")
    assert warm.p_value == pytest.approx(1 / 1001) and alone.p_value > 0.05
    assert np.corrcoef(warm.curve, np.exp(-warm.times / (0.3 * 68.5)))[0, 1] > 0.98
    assert "What the gyroscopes of a session have in common in time" in output.with_suffix(".html").read_text()
    picture, *others = common_drift([replace(warm, session=str(number)) for number in range(10)], [])
    assert "Of 10 sessions the 8" in picture.caption and len(picture.draw().axes) == 8 and not others
    written = json.loads(output.with_suffix(".json").read_text())["common_drift"]
    assert [drift["session"] for drift in written] == ["1", "2"]


def test_usage_that_is_refused(folder, tmp_path, capsys):
    def refused(*arguments: str) -> str:
        assert main(["fleet", *arguments]) == 2
        return capsys.readouterr().err

    assert "-o TABLE.parquet" in refused(str(folder))
    assert ".parquet" in refused(str(folder), "-o", "x.csv")
    assert "does not exist" in refused(str(folder), "-o", str(tmp_path / "no" / "t.parquet"))
    assert "no such file" in refused(str(tmp_path / "nothing"), "-o", str(tmp_path / "t.parquet"))
    assert "named twice" in refused(str(folder), str(folder / "unit001.parquet"), "-o", str(tmp_path / "t.parquet"))
    assert "holds no logs" in refused(str(tmp_path), "-o", str(tmp_path / "t.parquet"))
    (tmp_path / "d.parquet").mkdir()
    assert "is a folder" in refused(str(folder), "-o", str(tmp_path / "d.parquet"))


# --- runs that are disturbed ------------------------------------------------------------------------------------------


def test_killed_run_continues(folder, table, tmp_path, capsys):
    """SIGKILL in mid-run: the finished rows are kept, the others follow, the table is the undisturbed one's."""
    output = tmp_path / "fleet.parquet"
    arguments = ["fleet", str(folder), "-o", str(output), "--gravity", "9.80665+-0", "--workers", "1"]
    process = subprocess.Popen([sys.executable, "-m", "jaximu", *arguments], stderr=subprocess.DEVNULL)
    parts = tmp_path / "fleet.parquet.parts"
    until = time.monotonic() + 120
    while not list(parts.glob("[0-9]*.parquet")) and process.poll() is None and time.monotonic() < until:
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert not output.exists()
    kept = sum(pq.read_metadata(path).num_rows for path in parts.glob("[0-9]*.parquet"))
    assert 0 < kept < UNITS + 1
    capsys.readouterr()
    assert main(arguments) == 0
    assert f"{kept} kept from before" in capsys.readouterr().err
    same(pq.read_table(output), table)
    written = {"fleet.parquet", "fleet.html", "fleet.json", "fleet.shrunk.parquet"}
    assert {path.name for path in tmp_path.iterdir()} == written


def test_rows_of_other_settings_or_files_are_not_kept(folder, tmp_path):
    """What was computed of another file, or with other settings, is no row of this run."""
    jobs = find_jobs([folder])[:3]
    first = Settings()
    keys = [first.key(job) for job in jobs]
    assert len(set(keys)) == 3
    other = Settings(gravity=LocalGravity(9.81, 0.0))
    assert not set(keys) & {other.key(job) for job in jobs}
    copy = tmp_path / "copy.csv"
    copy.write_text("1")
    job = Job("copy", str(copy))
    before = first.key(job)
    copy.write_text("12")
    assert first.key(job) != before


def test_a_damaged_part_is_computed_again(folder, tmp_path):
    jobs = [Job(f"unit{k:03d}", str(folder / f"unit{k:03d}.parquet")) for k in range(4)]
    settings, output = Settings(), tmp_path / "t.parquet"
    rows = rows_of(jobs, settings)
    with Store(output, [settings.key(job) for job in jobs]) as store:
        store.add([0, 1], rows[:2])
        store.add([2], rows[2:3])
    (path,) = (tmp_path / "t.parquet.parts").glob("000000002*.parquet")
    path.write_bytes(path.read_bytes()[:-100])
    with Store(output, [settings.key(job) for job in jobs]) as store:
        assert store.pending() == [2, 3]
    assert sum(run_fleet(jobs, output, settings, workers=1).values()) == 4
    assert pq.read_table(output).column("device").to_pylist() == [job.device for job in jobs]


def test_output_in_use(folder, tmp_path, capsys):
    output = tmp_path / "t.parquet"
    with Store(output, ["a"]):
        assert main(["fleet", str(folder), "-o", str(output)]) == 2
    assert "is in use" in capsys.readouterr().err


def test_full_disk_is_a_sentence_and_keeps_what_is_there(folder, tmp_path):
    """A limit on the size of files stands for the disk."""
    jobs = [Job(f"unit{k:03d}", str(folder / f"unit{k:03d}.parquet")) for k in range(2)]
    settings, output = Settings(), tmp_path / "t.parquet"
    rows = rows_of(jobs, settings)
    with Store(output, [settings.key(job) for job in jobs]) as store:
        store.add([0], rows[:1])
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
        try:
            with pytest.raises(InputError, match=r"cannot be written.*1 finished rows are kept.*same command"):
                store.add([1], rows[1:])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert store.pending() == [1]
    assert len(list((tmp_path / "t.parquet.parts").glob("[0-9]*.parquet"))) == 1
    assert not output.exists()


def _rows_or_die(jobs, settings):
    """Stands for a computation that takes its process down: every batch with a job called `deadly`."""
    if any(job.device == "deadly" for job in jobs):
        os.kill(os.getpid(), signal.SIGKILL)
    return [{"device": job.device, "status": "ok"} for job in jobs]


def test_a_job_that_kills_its_worker_costs_its_own_row(monkeypatch):
    monkeypatch.setattr(engines_module, "rows_of", _rows_or_die)
    jobs = [Job("deadly" if k == 5 else str(k), "x") for k in range(12)]
    found = {}
    for places, rows in engines_module.local(jobs, list(range(12)), Settings(), 2):
        for place, row in zip(places, rows, strict=True):
            assert place not in found
            found[place] = row["status"]
    assert found == {place: "failed" if place == 5 else "ok" for place in range(12)}


def test_two_processes_give_the_same_table(folder, table, tmp_path, capsys):
    output = tmp_path / "fleet.parquet"
    arguments = ["fleet", str(folder), "-o", str(output), "--gravity", "9.80665+-0", "--workers", "2", "--json"]
    assert main(arguments) == 0
    assert json.loads(capsys.readouterr().out)["statuses"] == {"bad input": 1, "ok": UNITS}
    same(pq.read_table(output), table)


@pytest.mark.parametrize(("start", "compiled"), [(20.0, 0.0), (5.0, 20.0)])
def test_the_time_that_is_left_is_right_within_a_factor_of_two(start, compiled, monkeypatch, capsys):
    """Two processes that start together give batches of 16 rows in 8 s, after programs were compiled."""
    clock = [0.0]
    monkeypatch.setattr(cli_fleet.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(cli_fleet, "compiling", lambda: 3 * (start < clock[0] < start + compiled))
    finished = sorted(start + compiled + 8.0 * k + shift for k in range(1, 13) for shift in (0.0, 0.3))
    total, done = 16 * len(finished), 0
    with cli_fleet._progress(total) as show:
        for moment in np.arange(0.0, finished[-1], 0.5):
            clock[0] = float(moment)
            done = 16 * sum(time <= moment for time in finished)
            show(done, 0, Counter(ok=done))
    lines = re.findall(r"(\d+) s left, (\d+) s", capsys.readouterr().err)
    assert len(lines) > 5
    for left, now in lines[1:]:
        true = finished[-1] - float(now)
        assert true < 16.0 or true / 2 < float(left) < 2 * true, (left, now, true)
