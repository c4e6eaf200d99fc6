"""The fleet on Ray: the same table, and every unit once although a worker is killed."""

import gc
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jaximu.cli import main
from jaximu.fleets import Settings, find_jobs, rows_of
from jaximu.recordings import write_recording
from jaximu.recordings.readers import read_recording

UNITS = 15


@pytest.fixture(scope="module")
def folder(unit_logs, tmp_path_factory) -> Path:
    """Logs of accelerometers, whose fit is compiled in an eighth of the time, and one that is none."""
    path = tmp_path_factory.mktemp("logs")
    for k in range(UNITS):
        name = f"unit{k:03d}.parquet"
        write_recording(replace(read_recording(unit_logs / name), gyroscope=None), path / name)
    (path / "broken.csv").write_text("neither this\nnor that\n")
    return path


def _workers() -> list[int]:
    """Processes of the cluster that hold the fit, by the title Ray gives them."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            title = (entry / "cmdline").read_bytes().replace(b"\0", b" ")
        except (OSError, ValueError):
            continue
        if entry.name.isdigit() and title.startswith(b"ray::") and b"Fit" in title:
            found.append(int(entry.name))
    return found


def test_without_ray_a_sentence(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    monkeypatch.delitem(__import__("sys").modules, "jaximu.fleets.cluster", raising=False)
    assert main(["fleet", str(folder), "-o", str(tmp_path / "t.parquet"), "--engine", "ray"]) == 2
    assert "jaximu[cluster]" in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore")  # Ray's own, at start and end; what is tested here is not warnings
def test_a_killed_worker_costs_nothing(folder, tmp_path, monkeypatch):
    pytest.importorskip("ray", reason="needs Ray: pip install 'jaximu[cluster]'")
    if not Path("/proc/self/cmdline").exists():
        pytest.skip("finds Ray's workers in /proc")
    from jaximu.fleets.cluster import compute

    main(["fleet", str(folder / "unit000.parquet"), "-o", str(tmp_path / "one.parquet")])  # fills the cache
    jobs = find_jobs([folder])
    settings = Settings()
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    before = set(_workers())
    found, killed = {}, None
    for places, rows in compute(jobs, list(range(len(jobs))), settings, 2):
        if killed is None:
            until = time.monotonic() + 60
            while len(alive := set(_workers()) - before) < 2 and time.monotonic() < until:
                time.sleep(0.01)
            assert len(alive) == 2
            killed = alive.pop()
            os.kill(killed, signal.SIGKILL)
        for place, row in zip(places, rows, strict=True):
            assert place not in found
            found[place] = row
    assert killed is not None
    assert sorted(found) == list(range(len(jobs)))
    here = [row for first in range(0, len(jobs), 8) for row in rows_of(jobs[first : first + 8], settings)]
    for place, row in enumerate(here):
        assert found[place]["status"] == row["status"] and found[place]["message"] == row["message"]
        for name in ("accel_gain", "accel_bias", "covariance"):
            if row[name] is None:
                assert found[place][name] is None
            else:
                np.testing.assert_allclose(found[place][name], row[name], rtol=1e-9, atol=1e-12)
    until = time.monotonic() + 20
    while set(_workers()) - before and time.monotonic() < until:
        time.sleep(0.1)
    assert not set(_workers()) - before
    gc.collect()  # Ray leaves files open, of which nobody else's test is to be warned
