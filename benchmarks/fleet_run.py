"""A thousand logs in one command, killed in mid-run and resumed: each once, cost of a log, memory over the run.

Logs of 12 poses (2700 samples) are simulated on disk; one in ten units has a g-sensitivity, one in a hundred files is
torn. The command runs plain and with --diagnose on two processes: undisturbed, and killed (SIGKILL) half way and
started again. Memory is that of the command and its processes together, sampled four times a second while they work.
"""

import os

os.environ["JAX_PLATFORMS"] = "cpu"

import argparse
import json
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

import jax
import numpy as np
import pyarrow.parquet as pq
from common import RESULTS, Table, finish, machine

from jaximu import CATALOGUE
from jaximu.recordings import write_recording
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

jax.config.update("jax_enable_x64", True)


def write_logs(folder: Path, count: int) -> None:
    folder.mkdir()
    for seed in range(count):
        imu = draw_imu(seed)
        if seed % 10 == 5:
            size = 1e-4 * np.random.default_rng(seed).standard_normal(9)
            imu = imu.with_effects(CATALOGUE["gyro.g_sensitivity"].make(size))
        recording, _ = simulate(imu, HandHeld(12, 1.5), consumer_noise(), seed=seed)
        path = folder / f"{seed:05d}.parquet"
        write_recording(recording, path)
        if seed % 100 == 50:
            path.write_bytes(path.read_bytes()[:-40])


def resident(root: int) -> float:
    """Memory (MB) of a process and its children, what they share counted once each."""
    total = 0
    for entry in list(Path("/proc").glob("[0-9]*")):
        try:
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            if root in (parent, int(entry.name)):
                total += int((entry / "statm").read_text().split()[1])
        except (OSError, ValueError, IndexError):
            continue
    return total * os.sysconf("SC_PAGE_SIZE") / 2**20


def rows_kept(output: Path) -> int:
    found = 0
    for path in output.with_name(f"{output.name}.parts").glob("[0-9]*.parquet"):
        try:
            found += pq.read_metadata(path).num_rows
        except FileNotFoundError:  # the run has ended meanwhile
            return 0
    return found


def run(logs: Path, output: Path, more: list[str], kill_at: int | None = None) -> dict:
    """Run the command; seconds, processor seconds, and memory over time. `kill_at`: rows after which it is killed."""
    text = "from jaximu.cli import command; command()"
    began = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-c", text, "fleet", str(logs), "-o", str(output), "--workers", "2", *more],
        stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    memory, ended = [], threading.Event()

    def watch():
        while not ended.wait(0.25):
            if not output.exists():  # after that only the report is written
                memory.append((time.perf_counter() - began, resident(process.pid)))

    watcher = threading.Thread(target=watch)
    watcher.start()
    if kill_at is not None:
        while rows_kept(output) < kill_at and process.poll() is None:
            time.sleep(0.05)
        process.send_signal(signal.SIGKILL)
    _, status, used = os.wait4(process.pid, 0)
    ended.set()
    watcher.join()
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == (0 if kill_at is None else -signal.SIGKILL), process.returncode
    return {"seconds": time.perf_counter() - began, "processor": used.ru_utime + used.ru_stime, "memory": memory}


def difference(first: Path, second: Path) -> float:
    """Largest difference of two tables' parameters in standard deviations; their texts must be alike."""
    worst = 0.0
    left, right = (pq.read_table(path).to_pylist() for path in (first, second))
    for a, b in zip(left, right, strict=True):
        for name in ("device", "status", "verdict", "effects"):
            assert a[name] == b[name], (a["device"], name, a[name], b[name])
        for name in ("accel_gain", "accel_bias", "gyro_gain", "gyro_bias") if a["status"] == "ok" else ():
            sigma = np.array(a[f"{name}_sigma"])
            off = np.abs(np.array(a[name]) - b[name]) / np.where(sigma > 0, sigma, np.inf)
            worst = max(worst, float(off.max()))
    return worst


def study(scratch: Path, few: Path, logs: Path, count: int, more: list[str]) -> dict:
    name = "diagnosed" if more else "plain"
    first = run(few, scratch / f"{name}_first.parquet", more)  # compiles
    again = run(few, scratch / f"{name}_again.parquet", more)
    number = len(list(few.iterdir()))
    whole, output = scratch / f"{name}_whole.parquet", scratch / f"{name}.parquet"
    undisturbed = run(logs, whole, more)
    run(logs, output, more, kill_at=count // 2)
    kept = rows_kept(output)
    resumed = run(logs, output, more)
    rows = pq.read_table(output).to_pylist()
    assert len(rows) == len({row["device"] for row in rows}) == count
    memory = np.array(undisturbed["memory"])
    parts = [(memory[:, 0] > share * memory[-1, 0]) & (memory[:, 0] <= (share + 0.2) * memory[-1, 0])
             for share in (0.4, 0.6, 0.8)]  # fmt: skip
    hidden = [row for row in rows if int(row["device"]) % 10 == 5]
    quiet = [row for row in rows if int(row["device"]) % 10 != 5 and row["status"] == "ok"]
    return {
        "logs": count,
        "statuses": dict(Counter(row["status"] for row in rows)),
        "few": number, "few_cold": first["seconds"], "few_warm": again["seconds"],
        "seconds": undisturbed["seconds"],
        "processor_per_log": (undisturbed["processor"] - again["processor"]) / (count - number),
        "kept_after_kill": kept, "resumed_seconds": resumed["seconds"],
        "difference_in_sigmas": difference(whole, output),
        "memory_by_fifths": [float(np.median(memory[part, 1])) for part in parts],
        "peak_memory": float(memory[:, 1].max()), "peak_memory_few": max(value for _, value in again["memory"]),
        "found": sum("gyro.g_sensitivity" in (row["effects"] or ()) for row in hidden), "hidden": len(hidden),
        "false": sum(bool(row["effects"]) for row in quiet), "quiet": len(quiet),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="fewer logs; results are not kept")
    parser.add_argument("--logs", type=int, default=1000, metavar="N", help="logs; 0 keeps the last results")
    parser.add_argument("--diagnosed", type=int, default=1000, metavar="N", help="the same with --diagnose")
    asked = parser.parse_args()
    load = os.getloadavg()[0]
    counts = {"plain": (64, 16), "with --diagnose": (48, 16)} if asked.small else {
        "plain": (asked.logs, 264), "with --diagnose": (asked.diagnosed, 32)}  # fmt: skip
    found = {}
    if 0 in (asked.logs, asked.diagnosed):
        found = json.loads((RESULTS / "fleet_run.json").read_text(encoding="utf-8"))["runs"]
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        os.environ["XDG_CACHE_HOME"] = str(scratch / "cache")
        for name, both in counts.items():
            if not both[0]:
                continue
            logs, few = (scratch / f"logs{count}" for count in both)
            for folder_of, count in zip((logs, few), both, strict=True):
                if not folder_of.exists():
                    write_logs(folder_of, count)
            found[name] = study(scratch, few, logs, both[0], ["--diagnose"] if "diagnose" in name else [])
            found[name] |= {"load": load, "commit": machine().get("commit", "")}
    loads = " and ".join(f"{each.get('load', load):.1f}" for each in found.values())
    table = Table(
        "Logs on disk (12 poses, 2700 samples), two processes, killed half way and resumed",
        ["", *found],
        "A log whose turns are longer than all others' has a program of its own to compile, half a minute that few "
        f"logs do not need. Two cores, on which other work ran: load {loads} at the start.",
    )
    lines = {
        "logs": lambda f: str(f["logs"]),
        "commit": lambda f: f.get("commit", ""),
        "undisturbed run, s": lambda f: f"{f['seconds']:.0f}",
        "processor time a log, ms, start of the run taken off": lambda f: f"{1e3 * f['processor_per_log']:.0f}",
        "few logs, nothing compiled / compiled, s": lambda f: f"{f['few']}: {f['few_cold']:.0f} / {f['few_warm']:.0f}",
        "rows kept at the kill": lambda f: f"{f['kept_after_kill']}",
        "the rest, after it, s": lambda f: f"{f['resumed_seconds']:.0f}",
        "rows lost or doubled": lambda f: "0",
        "largest difference to the undisturbed run, standard deviations": lambda f: f"{f['difference_in_sigmas']:.1g}",
        "memory in the third / fourth / fifth fifth of the run, MB": lambda f: " / ".join(
            f"{value:.0f}" for value in f["memory_by_fifths"]
        ),
        "peak memory of few logs / of all, MB": lambda f: f"{f['peak_memory_few']:.0f} / {f['peak_memory']:.0f}",
        "torn files, as rows of their own": lambda f: f"{f['statuses'].get('bad input', 0)}",
        "g-sensitivity found / hidden": lambda f: f"{f['found']} / {f['hidden']}" if f["found"] else "",
        "units named without cause": lambda f: f"{f['false']} of {f['quiet']}" if f["found"] else "",
    }
    for name, cell in lines.items():
        table.add(name, *(cell(each) for each in found.values()))
    finish("fleet_run", [table], {"runs": found}, keep=not asked.small)


if __name__ == "__main__":
    main()
