"""Reading times and memory of each format, and damaged inputs tried. `python benchmarks/formats.py`

The yardstick of a format is its own library: pyarrow's CSV reader with its columns as arrays, the iteration of a bag's
raw messages, pyulog's and pymavlink's parsing. Times are the least of three, interleaved; memory is the growth of the
resident set's peak over that before reading, in a process of its own, against the arrays of the recording.
"""

import json
import multiprocessing
import queue
import resource
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
from common import Table, arguments, finish

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

SMALL_FUZZ, FUZZ = 60, 6000  # damaged inputs a format
LIMIT = 2 << 30  # bytes that reading a damaged file of some kilobytes may take in all


# --- reading


def theirs(name: str, path: Path, decoded: bool = False) -> None:
    """Read with the library alone; `decoded`: a bag's messages made into objects, as its users do."""
    if name == "csv":
        import pyarrow.csv as pc

        table = pc.read_csv(path)
        _ = [column.to_numpy() for column in table.columns]
    elif name in ("ros1", "db3", "mcap"):
        from rosbags.typesys import Stores, get_typestore

        if name == "ros1":
            from rosbags.rosbag1 import Reader

            make = get_typestore(Stores.ROS1_NOETIC).deserialize_ros1
        else:
            from rosbags.rosbag2 import Reader

            make = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr
        with Reader(path) as bag:
            for connection, _, data in bag.messages(bag.connections):
                if decoded:
                    make(data, connection.msgtype)
    elif name == "ulog":
        from pyulog import ULog

        ULog(str(path), ["sensor_accel", "sensor_gyro"])
    elif name == "dataflash":
        from pymavlink.DFReader import DFReader_binary

        log = DFReader_binary(str(path))
        while log.recv_match(type={"IMU"}, strict=True) is not None:
            pass
        log.close()


def ours(path: Path):
    from jaximu.formats import ReadOptions, read_recording

    return read_recording(path, options=ReadOptions(check=False))


def peak() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))


def memory(path: Path) -> tuple[int, int]:
    """Bytes of the recording's arrays, and by how much reading it raised the peak."""
    import pyarrow.csv  # noqa: F401  what importing takes is not what reading takes

    import jaximu.formats.csv
    import jaximu.formats.tagged  # noqa: F401

    for package in ("rosbags.rosbag1", "rosbags.rosbag2", "pyulog", "pymavlink.DFReader"):
        __import__(package)
    Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
    before = peak()
    recording = ours(path)
    arrays = sum(each.nbytes for signal in recording.signals.values() for each in (signal.time, signal.values))
    return arrays, peak() - before


def write(name: str, folder: Path, rows: int) -> Path:
    import sample_logs

    sample_logs.ROWS = rows
    return sample_logs.FORMATS[name](folder / name)


def reading(rows: dict[str, int]) -> tuple[Table, dict]:
    table = Table(
        "Reading samples of accelerometer and gyroscope",
        [
            "format",
            "samples",
            "library [s]",
            "library, decoded [s]",
            "jaximu [s]",
            "ratio",
            "arrays [MB]",
            "peak / arrays",
        ],
        "jaximu hashes the file as well (SHA-256). For bags the library's time is that of iterating messages, raw and "
        "decoded; the ratio is to the decoded ones. Goals: 1.3 times the library, 3 times the arrays.",
    )
    figures = {}
    with tempfile.TemporaryDirectory() as scratch:
        for name, count in rows.items():
            path = write(name, Path(scratch), count)
            bag = name in ("ros1", "db3", "mcap")
            runs = {
                "library": partial(theirs, name, path),
                **({"decoded": partial(theirs, name, path, decoded=True)} if bag else {}),
                "jaximu": partial(ours, path),
            }
            times: dict[str, float] = {}
            for _ in range(3):
                for who, run in runs.items():
                    start = time.perf_counter()
                    run()
                    times[who] = min(times.get(who, np.inf), time.perf_counter() - start)
            command = [sys.executable, __file__, "--memory", str(path)]
            told = subprocess.run(command, check=True, capture_output=True, text=True)
            arrays, grown = json.loads(told.stdout)
            ratio = times["jaximu"] / times.get("decoded", times["library"])
            figures[name] = {"samples": count, **times, "ratio": ratio, "arrays": arrays, "peak": grown}
            decoded = f"{times['decoded']:.2f}" if bag else ""
            table.add(
                name, count, f"{times['library']:.2f}", decoded, f"{times['jaximu']:.2f}", f"{ratio:.2f}",
                f"{arrays / 1e6:.0f}", f"{grown / arrays:.1f}",
            )  # fmt: skip
            path.unlink()
    return table, figures


# --- damaged inputs


def change(data: bytes, generator: np.random.Generator) -> bytes:
    """One to four changes: bytes set, extreme numbers, insertions, cuts, repeats; half of them at the beginning."""
    extremes = [b"\0" * 8, b"\xff" * 8, b"\x7f" * 8, b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\xff\xff", b"nan", b"1e999"]
    for _ in range(generator.integers(1, 5)):
        at = int(generator.integers(min(len(data), 512) if generator.random() < 0.5 else len(data)) if data else 0)
        kind = generator.integers(6)
        what = (
            generator.bytes(generator.integers(1, 9))
            if generator.random() < 0.5
            else extremes[generator.integers(len(extremes))]
        )
        if kind <= 1:
            data = data[:at] + what + data[at + len(what) :]
        elif kind == 2:
            data = data[:at] + what + data[at:]
        elif kind == 3:
            data = data[:at] + data[at + int(generator.integers(1, 200)) :]
        elif kind == 4:
            data = data[: at + int(generator.integers(1, 200))] + data[at:]
        elif generator.random() < 0.2:
            data = data[: max(at, 1)]
    return data


def fuzz(name: str, count: int, results) -> None:
    """Read `count` damaged copies under a limit of memory; tell how they ended, the slowest, and the peak."""
    from jaximu.errors import JaximuError
    from jaximu.formats import ReadOptions, read_recording

    generator = np.random.default_rng([7, *name.encode()])
    ended, slowest, broken = {"recording": 0, "sentence": 0, "traceback": 0}, 0.0, []
    with tempfile.TemporaryDirectory() as scratch:
        path = write(name, Path(scratch), 60)
        original = path.read_bytes()
        read_recording(path, options=ReadOptions(check=False))
        resource.setrlimit(resource.RLIMIT_AS, (LIMIT + (4 << 30), resource.RLIM_INFINITY))
        for _ in range(count):
            data = change(original, generator)
            path.write_bytes(data)
            start = time.perf_counter()
            try:
                recording = read_recording(path, options=ReadOptions(check=False))
                sound = all(np.isfinite(each.values).all() for each in recording.signals.values())
                ended["recording" if sound else "traceback"] += 1
            except JaximuError:
                ended["sentence"] += 1
            except BaseException as error:
                ended["traceback"] += 1
                broken.append(f"{type(error).__name__}: {error}"[:200])
                Path(tempfile.gettempdir(), f"broke-{name.replace(' ', '-')}-{len(broken)}").write_bytes(data)
            slowest = max(slowest, time.perf_counter() - start)
    results.put((name, ended, slowest, peak(), broken[:5]))


def damaged(count: int) -> tuple[Table, dict]:
    import sample_logs

    table = Table(
        "Damaged inputs", ["format", "inputs", "recordings", "sentences", "tracebacks", "slowest [s]", "peak [MB]"],
        "One to four changes each to a file of 60 samples; goals: no traceback, at most 10 s, at most 2 GiB.",
    )  # fmt: skip
    figures = {}
    for name in sample_logs.FORMATS:
        context = multiprocessing.get_context("spawn")
        results = context.Queue()
        process = context.Process(target=fuzz, args=(name, count, results))
        process.start()
        told = None
        while told is None and (process.is_alive() or not results.empty()):
            with suppress(queue.Empty):
                told = results.get(timeout=1.0)
        process.join()
        died = {"recording": 0, "sentence": 0, "traceback": 1}, float("nan"), 0, [f"ended with {process.exitcode}"]
        ended, slowest, top, broken = died if told is None else told[1:]
        figures[name] = {**ended, "slowest": slowest, "peak": top, "broken": broken}
        table.add(name, count, *ended.values(), f"{slowest:.2f}", f"{top / 1e6:.0f}")
    total = sum(sum(each[key] for key in ("recording", "sentence", "traceback")) for each in figures.values())
    table.add(
        "all",
        total,
        *(sum(each[key] for each in figures.values()) for key in ("recording", "sentence", "traceback")),
        "",
        "",
    )
    return table, figures


def main() -> None:
    if sys.argv[1:2] == ["--memory"]:
        print(json.dumps(memory(Path(sys.argv[2]))))
        return
    small = arguments(__doc__).small
    rows = {name: 200_000 for name in ("ros1", "db3", "mcap", "ulog", "dataflash")} | {"csv": 1_000_000}
    read, times = reading({name: count // 50 if small else count for name, count in rows.items()})
    broken, counts = damaged(SMALL_FUZZ if small else FUZZ)
    finish("formats", [read, broken], {"reading": times, "damaged": counts}, keep=not small)


if __name__ == "__main__":
    main()
