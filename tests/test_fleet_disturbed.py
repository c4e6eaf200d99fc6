"""Runs of `jaximu fleet` that are killed, stopped, robbed of a worker or of room: nothing lost, nothing doubled."""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.stats import binom
from test_fleet import same

from jaximu import CATALOGUE
from jaximu.cli import main
from jaximu.fleets import Job, Settings, engines, find_jobs, rows_of
from jaximu.recordings import write_recording
from jaximu.recordings.readers import read_recording
from jaximu.recordings.recording import Recording, Signal
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

UNITS = 8
pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")


@pytest.fixture(scope="module")
def folder(unit_logs, tmp_path_factory) -> Path:
    """Logs, the last of an accelerometer alone, and one file that is none."""
    path = tmp_path_factory.mktemp("logs")
    for k in range(UNITS - 1):
        shutil.copy(unit_logs / f"unit{k:03d}.parquet", path / f"unit{k}.parquet")
    alone = replace(read_recording(unit_logs / f"unit{UNITS - 1:03d}.parquet"), gyroscope=None)
    write_recording(alone, path / f"unit{UNITS - 1}.parquet")
    (path / "torn.parquet").write_bytes((path / "unit0.parquet").read_bytes()[:-40])
    return path


def command(folder, output, *more):
    """The arguments, and a process of its own that runs them."""
    arguments = ["fleet", str(folder), "-o", str(output), *more]
    text = "from jaximu.cli import command; command()"
    process = subprocess.Popen([sys.executable, "-c", text, *arguments], stderr=subprocess.PIPE, text=True)
    return arguments, process


def wait_for_rows(process, output):
    """Wait until the first rows are kept."""
    parts, until = output.with_name(f"{output.name}.parts"), time.monotonic() + 240
    while not list(parts.glob("[0-9]*.parquet")) and process.poll() is None and time.monotonic() < until:
        time.sleep(0.005)
    assert process.poll() is None


def children(parent: int) -> list[int]:
    """Processes whose parent it is."""
    found = []
    for entry in list(Path("/proc").glob("[0-9]*/stat")):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == parent and fields[0] != "Z":
            found.append(int(entry.parent.name))
    return found


def kept_rows(output) -> int:
    parts = output.with_name(f"{output.name}.parts")
    return sum(pq.read_metadata(path).num_rows for path in parts.glob("[0-9]*.parquet"))


@pytest.fixture(scope="module")
def diagnosed(folder, tmp_path_factory):
    """A run with diagnoses that is killed in mid-run: what it left, and the arguments to go on."""
    output = tmp_path_factory.mktemp("diagnosed") / "t.parquet"
    arguments, process = command(folder, output, "--diagnose", "--workers", "1")
    wait_for_rows(process, output)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    return output, arguments, kept_rows(output)


def test_killed_run_with_diagnoses_continues(folder, diagnosed, tmp_path, capsys):
    """Each log once, and the rows of a run that nothing disturbed."""
    output, arguments, kept = diagnosed
    assert not output.exists() and 0 < kept < UNITS + 1
    assert main(arguments) == 0
    assert f"{kept} kept from before" in capsys.readouterr().err
    whole = tmp_path / "whole.parquet"
    assert main(["fleet", str(folder), "-o", str(whole), "--diagnose", "--workers", "1"]) == 0
    same(pq.read_table(output), pq.read_table(whole))
    rows = {row["device"]: row for row in pq.read_table(output).to_pylist()}
    assert len(rows) == UNITS + 1
    assert [rows[f"unit{k}"]["verdict"] for k in range(UNITS - 1)].count("adequate") >= UNITS - 2
    alone = rows[f"unit{UNITS - 1}"]
    assert alone["status"] == "ok" and alone["verdict"] is None
    assert alone["message"].startswith("not diagnosed: a diagnosis needs accelerometer and gyroscope")
    assert rows["torn"]["status"] == "bad input" and "torn.parquet" in rows["torn"]["message"]


@pytest.mark.slow
def test_a_thousand_logs_killed_half_way_and_resumed(tmp_path):
    """Calibrated and diagnosed by two processes: each log once, and the rows of a run that nothing disturbed.

    One file in a hundred is torn; one unit in ten feels gravity in its gyroscope.
    """
    count, logs = 1000, tmp_path / "logs"
    logs.mkdir()
    effect = CATALOGUE["gyro.g_sensitivity"].make(2e-4 * np.array([1.0, -0.5, 0.3, 0.2, 0.8, -0.4, 0.1, 0.6, -0.9]))
    for seed in range(count):
        imu = draw_imu(seed).with_effects(effect) if seed % 10 == 5 else draw_imu(seed)
        recording, _ = simulate(imu, HandHeld(12, 1.5), consumer_noise(), seed=seed)
        path = logs / f"unit{seed:04d}.parquet"
        write_recording(recording, path)
        if seed % 100 == 50:
            path.write_bytes(path.read_bytes()[:-40])
    whole, output = tmp_path / "whole.parquet", tmp_path / "t.parquet"
    more = ("--diagnose", "--workers", "2")
    _, process = command(logs, whole, *more)
    _, said = process.communicate()
    assert process.returncode == 0, said

    _, process = command(logs, output, *more)
    while kept_rows(output) < count // 2 and process.poll() is None:
        time.sleep(0.1)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL and not output.exists()
    kept = kept_rows(output)
    assert count // 2 <= kept < count
    _, process = command(logs, output, *more)
    _, said = process.communicate()
    assert process.returncode == 0 and f"({kept} kept from before)" in said

    table = pq.read_table(output)
    same(table, pq.read_table(whole))
    rows = {row["device"]: row for row in table.to_pylist()}
    assert table.num_rows == len(rows) == count
    statuses = [rows[f"unit{seed:04d}"]["status"] for seed in range(count)]
    assert statuses == ["bad input" if seed % 100 == 50 else "ok" for seed in range(count)]
    told = [place for place in range(count) if "gyro.g_sensitivity" in (rows[f"unit{place:04d}"]["effects"] or ())]
    hidden = [place for place in told if place % 10 == 5]
    # a cause is refused at a tenth of the diagnosis' level
    assert len(hidden) >= 95 and len(told) - len(hidden) <= binom.isf(1e-3, 890, 0.005)


def test_interrupted_run_says_what_is_kept(folder, tmp_path):
    """Ctrl-C: one sentence, no table, no process left; the same command ends the work."""
    output = tmp_path / "t.parquet"
    (tmp_path / ".t.0123abcd.parquet").write_text("what a killed run left of a table")
    signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # tests run in the background would hand on that it is ignored
    # a diagnosis takes long enough to be interrupted
    arguments, process = command(folder, output, "--diagnose", "--workers", "2")
    wait_for_rows(process, output)
    workers = children(process.pid)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130, said
    kept = kept_rows(output)
    assert f"{kept} of {UNITS + 1} rows are kept" in said and "Traceback" not in said
    assert not output.exists()
    until = time.monotonic() + 20
    while any(Path(f"/proc/{worker}").exists() for worker in workers) and time.monotonic() < until:
        time.sleep(0.05)
    assert workers and not any(Path(f"/proc/{worker}").exists() for worker in workers)
    assert main(arguments[:-2]) == 0
    assert pq.read_table(output).num_rows == UNITS + 1
    assert {path.name for path in tmp_path.iterdir()} == {"t.parquet", "t.html", "t.json"}  # too few to shrink


def test_killed_worker_costs_no_row(folder, tmp_path):
    output = tmp_path / "t.parquet"
    _, process = command(folder, output, "--workers", "2")
    until = time.monotonic() + 60
    while len(found := children(process.pid)) < 2 and time.monotonic() < until:
        time.sleep(0.005)
    os.kill(found[-1], signal.SIGKILL)
    _, said = process.communicate(timeout=240)
    assert process.returncode == 0, said
    rows = pq.read_table(output).to_pylist()
    assert [row["status"] for row in rows].count("ok") == UNITS and len(rows) == UNITS + 1


@pytest.mark.parametrize("times", [1, 99])
def test_processes_that_do_not_start_are_started_again_and_not_for_ever(monkeypatch, times):
    """A worker that dies while the next is being started leaves that one pipes that are closed."""
    left = [times]

    class Pool(ThreadPoolExecutor):
        _processes: dict = {}  # noqa: RUF012

        def __init__(self, workers, *_, **__):
            super().__init__(workers)

        def submit(self, *given):
            left[0] -= 1
            if left[0] >= 0:
                raise ValueError("bad value(s) in fds_to_keep")
            return super().submit(*given)

    monkeypatch.setattr(engines, "ProcessPoolExecutor", Pool)
    monkeypatch.setattr(engines, "rows_of", lambda jobs, settings: [{"device": job.device} for job in jobs])
    jobs = [Job(str(number), "log.csv") for number in range(6)]
    if times > 1:
        with pytest.raises(ValueError, match="fds_to_keep"):
            list(engines.local(jobs, range(6), Settings(), 2))
        return
    found = [row["device"] for _, rows in engines.local(jobs, range(6), Settings(), 2) for row in rows]
    assert sorted(found) == [job.device for job in jobs]


def test_full_disk_is_one_sentence_and_the_same_command_ends_the_work(folder, tmp_path, capsys):
    """A limit on the size of files stands for the disk; what was compiled before is kept elsewhere."""
    arguments = ["fleet", str(folder), "-o", str(tmp_path / "t.parquet"), "--workers", "1", "--json"]
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, limits[1]))
    try:
        assert main(arguments) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    printed = capsys.readouterr()
    (sentence,) = [line for line in printed.err.splitlines() if line.startswith("jaximu: ")]
    assert "cannot be written" in sentence and "give the same command again" in sentence
    assert json.loads(printed.out)["error"] in sentence
    assert [path.name for path in tmp_path.iterdir()] == ["t.parquet.parts"]
    assert main(arguments) == 0
    assert sum(json.loads(capsys.readouterr().out)["statuses"].values()) == UNITS + 1


def test_mixed_rates_and_units_are_one_fleet(folder, tmp_path):
    """One unit in SI, in g and °/s, and recorded again at another rate, all under one name: each row by itself."""
    recording = read_recording(folder / "unit0.parquet")
    accelerometer, gyroscope = recording.accelerometer, recording.gyroscope
    assert gyroscope is not None
    other = Recording(
        Signal(accelerometer.time, accelerometer.values / 9.80665, "g"),
        Signal(gyroscope.time, np.degrees(gyroscope.values), "deg/s"),
    )
    slow, _ = simulate(draw_imu(0), HandHeld(12, 1.5), consumer_noise(), rate=90.0, seed=1)
    for name, each in (("si", recording), ("other", other), ("slow", slow)):
        write_recording(each, tmp_path / f"{name}.csv")
    (tmp_path / "list.csv").write_text("device,file\nA,si.csv\nA,other.csv\nA,slow.csv\nA,none.csv\n")
    rows = rows_of(find_jobs([tmp_path / "list.csv"]), Settings())
    assert [row["device"] for row in rows] == ["A"] * 4
    assert [row["status"] for row in rows] == ["ok", "ok", "ok", "bad input"]
    si, g, slower, _ = rows
    for name in ("accel_gain", "accel_bias", "gyro_gain", "gyro_bias"):
        sigma = np.array(si[f"{name}_sigma"])
        assert (np.abs(np.array(g[name]) - si[name]) <= 1e-4 * sigma + 1e-12).all()
        off = np.abs(np.array(slower[name]) - si[name])
        assert (off <= 5 * np.hypot(sigma, slower[f"{name}_sigma"]) + 1e-12).all()
