"""Damaged files of every format, read in processes of bounded memory and time. `python benchmarks/fuzz.py`

Each input is a file of 60 samples with one to four edits, drawn from its number, so that what breaks can be made again
(tests/damage.py); where a format compresses, half of the edits are made within what is compressed. An input may end in
a sound recording or in one sentence; all else counts: a traceback, the end of the process, more than 10 s of processor
time (or 300 s without a word), more than 2 GiB beyond what the process has before it reads.

`--guided SECONDS` instead lets Atheris (libFuzzer) look for inputs that reach new lines, so long for each format.
"""

import argparse
import json
import multiprocessing
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import nullcontext, suppress
from importlib import import_module
from pathlib import Path

from common import Table, finish

INPUTS, SMALL = 5000, 60  # damaged inputs a format
MEMORY, LONGEST = 2 << 30, 10.0  # bytes, s of processor time
STALLED = 300.0  # s without a word, after which a process is ended
INSTRUMENTED = (
    "jaximu.recordings.readers",
    "jaximu.recordings.columns",
    "jaximu.recordings.recording",
    "pyulog",
    "pymavlink.DFReader",
    "rosbags",
)
ENDS = ("recording", "sentence", "traceback", "died", "hung", "memory")


def watched():
    """A context in which what is imported tells Atheris where it goes, in a process that runs it."""
    if "--folder" not in sys.argv:
        return nullcontext()
    try:
        import atheris
    except ModuleNotFoundError:
        sys.exit("--guided needs Atheris: pip install atheris")
    return atheris.instrument_imports(include=list(INSTRUMENTED))


sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
with watched():
    import damage


class TooLong(BaseException):
    """Not an Exception, which readers may catch."""


def too_long(*_) -> None:
    raise TooLong


def prepared(folder: Path, name: str) -> tuple[Path, bytes]:
    """A file of the format and its bytes, read once, under the limit of memory from there on."""
    path = damage.originals(folder)[name]
    original = path.read_bytes()
    assert damage.attempt(path, original) == "recording"
    for module in ("h5py", "scipy.io", "pyulog", "pymavlink.DFReader", "rosbags.rosbag1", "rosbags.rosbag2"):
        import_module(module)  # what importing takes is not what reading takes
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, resource.RLIM_INFINITY))
    return path, original


def work(name: str, first: int, last: int, connection) -> None:
    """Read the inputs of these numbers, telling after each how it ended, and at the end the peak of memory."""
    signal.signal(signal.SIGPROF, too_long)
    with tempfile.TemporaryDirectory() as scratch:
        path, original = prepared(Path(scratch), name)
        Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
        connection.send(None)
        for seed in range(first, last):
            data, _, _ = damage.made(name, original, seed)
            start, text = time.process_time(), ""  # on a machine with others at work, time of the wall says little
            signal.setitimer(signal.ITIMER_PROF, LONGEST)
            try:
                text = damage.attempt(path, data)
                end = "recording" if text == "recording" else "memory" if "MemoryError" in text else "sentence"
            except TooLong:
                end = "hung"
            except BaseException as error:
                end, text = "traceback", f"{type(error).__name__}: {error}"[:200]
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            connection.send((seed, end, time.process_time() - start, text if end in ENDS[2:] else ""))
        lines = Path("/proc/self/status").read_text().splitlines()
        connection.send(next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM")))


def fuzz(name: str, count: int) -> dict:
    """How `count` damaged inputs of a format end; a process that dies or hangs is followed by another."""
    context = multiprocessing.get_context("spawn")
    found = {**dict.fromkeys(ENDS, 0), "slowest": 0.0, "peak": 0, "broken": []}
    done = 0
    while done < count:
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=work, args=(name, done, count, theirs))
        process.start()
        theirs.close()
        assert ours.poll(STALLED) and ours.recv() is None, "the process does not start"
        while True:
            try:
                told = ours.recv() if ours.poll(STALLED) else (done, "hung", STALLED, "in compiled code")
            except EOFError:
                process.join()
                told = (done, "died", 0.0, f"exit status {process.exitcode}")
            if isinstance(told, int):
                found["peak"] = max(found["peak"], told)
                break
            seed, end, seconds, text = told
            found[end] += 1
            found["slowest"] = max(found["slowest"], seconds)
            if end in ENDS[2:]:
                found["broken"].append({"seed": seed, "end": end, "text": text})
            done = seed + 1
            if end == "died" or text == "in compiled code":
                process.kill()
                break
        process.join()
    return found


def guide(name: str, seconds: int, folder: Path) -> None:
    """Run libFuzzer on a format; it ends the process."""
    import atheris

    with watched():
        for module in ("pyulog", "pymavlink.DFReader", "rosbags.rosbag1", "rosbags.rosbag2"):
            import_module(module)
        for module in ("csv", "dataflash", "mat", "mat5", "npz", "parquet", "rosbag", "tagged", "ulog"):
            import_module(f"jaximu.recordings.readers.{module}")
    path, original = prepared(folder, name)
    corpus = folder / "corpus"
    corpus.mkdir()
    (corpus / "original").write_bytes(original)
    options = {
        "max_total_time": seconds,
        "timeout": 10,
        "max_len": 2 * len(original),
        "print_final_stats": 1,
        "rss_limit_mb": 4096,
        "seed": 1,
        "artifact_prefix": f"{tempfile.gettempdir()}/broke-{path.name}-",
    }
    atheris.Setup(
        [sys.argv[0], *(f"-{key}={value}" for key, value in options.items()), str(corpus)],
        lambda data: damage.attempt(path, data),
    )
    atheris.Fuzz()


def guided(name: str, seconds: int) -> dict:
    with tempfile.TemporaryDirectory() as scratch:
        command = [sys.executable, __file__, "--guided", str(seconds), "--format", name, "--folder", scratch]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace")
    figures = dict(re.findall(r"stat::(\w+):\s+(\d+)", done.stderr))
    reached = re.findall(r"cov: (\d+) ft: (\d+) corp: (\d+)", done.stderr)
    lines = [line for line in done.stderr.splitlines() if "Error" in line or "ERROR" in line]
    return {
        "executed": int(figures.get("number_of_executed_units", 0)),
        "covered": [int(each[0]) for each in (reached[:1] + reached[-1:])],
        "kept": int(reached[-1][2]) if reached else 0,
        "status": done.returncode,
        "broken": lines[:5] if done.returncode else [],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--small", action="store_true", help="fewer inputs; results are not kept")
    parser.add_argument("--guided", type=int, metavar="SECONDS", help="search by coverage, so long for each format")
    parser.add_argument("--format", help="this one alone; results are not kept")
    parser.add_argument("--seed", type=int, help="with --format: make this one input again and read it")
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.folder:
        guide(given.format, given.guided, given.folder)
    if given.seed is not None:
        with tempfile.TemporaryDirectory() as scratch:
            path = damage.originals(Path(scratch))[given.format]
            data, edits, within = damage.made(given.format, path.read_bytes(), given.seed)
            print((given.format, within, edits))
            print(damage.attempt(path, data))
        return
    names = [given.format] if given.format else [*damage.sample_logs.FORMATS, "bag folder"]
    keep = not given.small and not given.format
    figures: dict[str, dict] = {}
    if given.guided:
        table = Table("Inputs found by coverage", ["format", "inputs", "reached at first", "reached", "kept", "broken"],
                      f"Atheris, {given.guided} s a format, from one file of 60 samples.")  # fmt: skip
        for name in names:
            found = figures[name] = guided(name, given.guided)
            first, last = (found["covered"] * 2)[:2] if len(found["covered"]) < 2 else found["covered"]
            table.add(name, found["executed"], first, last, found["kept"], len(found["broken"]))
            print(name, json.dumps(found), file=sys.stderr)
        table.add("all", sum(each["executed"] for each in figures.values()), "", "", "",
                  sum(len(each["broken"]) for each in figures.values()))  # fmt: skip
        finish("fuzz_guided", [table], {"guided": figures}, keep, "fuzz")
        return
    table = Table(
        "Damaged inputs",
        ["format", "inputs", *ENDS, "slowest [s]", "peak [MB]"],
        f"One to four edits each to a file of {damage.ROWS} samples. Wanted are recordings and sentences alone; "
        "hung is more than 10 s, memory more than 2 GiB asked for; the peak is that of the whole process, JAX and all.",
    )
    for name in names:
        found = figures[name] = fuzz(name, SMALL if given.small else INPUTS)
        table.add(name, sum(found[end] for end in ENDS), *(found[end] for end in ENDS), f"{found['slowest']:.2f}",
                  f"{found['peak'] / 1e6:.0f}")  # fmt: skip
        if found["broken"]:
            print(name, json.dumps(found["broken"][:5]), file=sys.stderr)
    totals = {end: sum(each[end] for each in figures.values()) for end in ENDS}
    table.add("all", sum(totals.values()), *totals.values(), "", "")
    with suppress(KeyboardInterrupt):
        finish("fuzz", [table], {"total": totals, "formats": figures}, keep)


if __name__ == "__main__":
    main()
