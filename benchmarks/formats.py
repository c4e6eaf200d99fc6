"""Reading times and memory of each format. `python benchmarks/formats.py` (damaged files: benchmarks/fuzz.py)

The yardstick of a format is its own library: pyarrow's readers with their columns as arrays, the iteration of a bag's
messages, raw and made into objects, pyulog's and pymavlink's parsing. Times are the least of four, interleaved; memory
is the growth of the resident set's peak over that before reading, in a process of its own, against the arrays of the
recording, jaximu's and that of the library reading alone.
"""

import json
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
from common import Table, arguments, finish

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

REPEATS = 4


# --- reading


def theirs(name: str, path: Path, decoded: bool = False) -> None:
    """Read with the library alone; `decoded`: a bag's messages made into objects, as its users do."""
    if name == "csv":
        import pyarrow.csv as pc

        table = pc.read_csv(path)
        _ = [column.to_numpy() for column in table.columns]
    elif name == "parquet":
        import pyarrow.parquet as pq

        _ = [column.to_numpy() for column in pq.read_table(path).columns]
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
    from jaximu.recordings.readers import ReadOptions, read_recording

    return read_recording(path, options=ReadOptions(check=False))


def peak() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))


def memory(name: str, path: Path) -> tuple[int, int]:
    """Bytes of the recording's arrays, and by how much reading it raised the peak; of no arrays, the library alone."""
    import pyarrow.csv  # noqa: F401  what importing takes is not what reading takes

    import jaximu.recordings.readers.csv
    import jaximu.recordings.readers.tagged  # noqa: F401

    for package in ("rosbags.rosbag1", "rosbags.rosbag2", "pyulog", "pymavlink.DFReader", "pyarrow.parquet"):
        __import__(package)
    Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
    before = peak()
    if name:
        theirs(name, path)
        return 0, peak() - before
    recording = ours(path)
    arrays = sum(each.nbytes for signal in recording.signals.values() for each in (signal.time, signal.values))
    return arrays, peak() - before


def write(name: str, folder: Path, rows: int) -> Path:
    import sample_logs

    sample_logs.ROWS = rows
    return sample_logs.FORMATS[name](folder / name)


def asked(*words: str) -> list[int]:
    told = subprocess.run([sys.executable, __file__, "--memory", *words], check=True, capture_output=True, text=True)
    return json.loads(told.stdout)


def reading(rows: dict[str, int]) -> tuple[Table, dict]:
    table = Table(
        "Reading samples of accelerometer and gyroscope",
        [
            "format",
            "samples",
            "library [s]",
            "library, objects [s]",
            "jaximu [s]",
            "ratio",
            "ratio to objects",
            "arrays [MB]",
            "peak / arrays",
            "library's peak / arrays",
        ],
        "jaximu hashes the file as well (SHA-256). Of bags the library's time is that of iterating raw messages, and "
        "of making objects of them, which its users do. Goals: 1.3 times the library, 3 times the arrays.",
    )
    figures = {}
    with tempfile.TemporaryDirectory() as scratch:
        for name, count in rows.items():
            path = write(name, Path(scratch), count)
            bag = name in ("ros1", "db3", "mcap")
            runs = {
                "library": partial(theirs, name, path),
                **({"objects": partial(theirs, name, path, decoded=True)} if bag else {}),
                "jaximu": partial(ours, path),
            }
            times: dict[str, float] = {}
            for _ in range(REPEATS):
                for who, run in runs.items():
                    start = time.perf_counter()
                    run()
                    times[who] = min(times.get(who, np.inf), time.perf_counter() - start)
            arrays, grown = asked("", str(path))
            _, alone = asked(name, str(path))
            ratio, ratio_objects = (times["jaximu"] / times.get(who, np.nan) for who in ("library", "objects"))
            figures[name] = {
                "samples": count, **times, "ratio": ratio, "arrays": arrays, "peak": grown, "library_peak": alone
            }  # fmt: skip
            table.add(
                name, count, f"{times['library']:.2f}", f"{times['objects']:.2f}" if bag else "",
                f"{times['jaximu']:.2f}", f"{ratio:.2f}", f"{ratio_objects:.2f}" if bag else "", f"{arrays / 1e6:.0f}",
                f"{grown / arrays:.1f}", f"{alone / arrays:.1f}",
            )  # fmt: skip
            path.unlink()
    return table, figures


def main() -> None:
    if sys.argv[1:2] == ["--memory"]:
        print(json.dumps(memory(sys.argv[2], Path(sys.argv[3]))))
        return
    small = arguments(__doc__).small
    rows = {name: 100_000 for name in ("ros1", "db3", "mcap", "ulog", "dataflash")}
    rows |= {"csv": 1_000_000, "parquet": 1_000_000}
    table, times = reading({name: count // 50 if small else count for name, count in rows.items()})
    finish("formats", [table], {"reading": times}, keep=not small)


if __name__ == "__main__":
    main()
