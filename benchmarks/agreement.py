"""Compare two versions of the library: the same results, by every recipe, of measured and simulated inputs?

`python benchmarks/agreement.py [--quick]` runs the command lines of `agreement.toml` and compares all that they print
and write (JSON documents, tables, exit status) with the committed records; `--write` records again, `--against FILE`
takes other records. It exits with 1 where something differs. Nothing of the library is used but its command line, so
the script runs unchanged on versions whose modules lie elsewhere.

What is compared, and how closely:

- a number beside a standard deviation or an interval: in the record's standard deviations, 1e-3;
- a standard deviation, and any other number (statistics, p-values, root mean squares, limits): 1e-3 of itself, since
  they follow from numbers that are known no better; whole numbers: exactly;
- a matrix or a long list: its norm and four fixed combinations, 1e-3 of the norm; a covariance: its correlations;
- the columns of a long table (samples that were simulated or corrected): the same, 1e-6 of the norm;
- verdicts, names of effects, findings and parameters, units, booleans, the exit status, the keys: exactly; a new key or
  file is printed but does not count as a difference;
- sentences, paths, hashes, dates and versions: not at all.
"""

import argparse
import contextlib
import io
import itertools
import json
import os
import queue
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np
from agreement_cases import Case, cases, make_inputs, with_needed
from common import RESULTS, Table, finish, machine

TOLERANCE = 1e-3
IN_SAMPLES = 1e-6
"""The same for samples, relative to the norm of their column."""
SMALL = 1e-12
"""Numbers below this part of the largest of their list, or below it by themselves, count as zero."""
SHOWN = 4
"""Changes of a case that the table names."""
LONGEST = 36
"""Numbers of a list that are kept as they are."""
FACTORS = 2654435761, 2246822519, 3266489917, 668265263
"""What the fixed signs of the combinations of many numbers are made with."""
FINE, ROUGH = 10, 6
"""Digits of a number that is known by a standard deviation or in samples, and of any other."""
FEW = 6
"""Objects without a name up to which a list of them is kept as it is, else by columns."""
PROSE = "…"
LEFT_OUT = {"software", "digest", "sha256", "file", "truth", "specification", "date", "version", "seconds", "source"}
"""Keys whose contents depend on the machine, the day or the version."""
NAMES = ("name", "parameter", "term", "device")
"""Keys by which an element of a list is known."""
BESIDE_SIGMA = ("value", "values", "coefficients", "estimate", "mean", "rotation", "position")
TIMEOUT = 900.0
MAPS = 25_000
"""Memory maps from which on a process is replaced: compiled code lies in them, and Linux gives 65 530."""
TABLE_ROWS = 64
"""Rows up to which a table is recorded row by row, else column by column."""


# --- record ----------------------------------------------------------------------------------------------------------


def rounded(value: float, digits: int = ROUGH) -> float:
    """A number to so many digits."""
    return float(f"{value:.{digits}g}") if np.isfinite(value) else value


def digest(values: np.ndarray, digits: int = ROUGH) -> dict[str, Any]:
    """The norm of many numbers and combinations of them with fixed signs."""
    finite = np.where(np.isfinite(values), values, 0.0).ravel()
    index = np.arange(1, finite.size + 1, dtype=np.uint64)
    bits = [(index * np.uint64(factor) >> np.uint64(17)) & np.uint64(1) for factor in FACTORS]
    scale = float(np.max(np.abs(finite), initial=0.0)) or 1.0
    return {
        "shape": list(values.shape),
        "missing": int(np.sum(~np.isfinite(values))),
        "norm": rounded(scale * float(np.linalg.norm(finite / scale)), digits),
        "combinations": [rounded(float(np.sum(np.where(bit, finite, -finite))), digits) for bit in bits],
    }


def of_numbers(values: np.ndarray, digits: int = ROUGH) -> Any:
    """A list of numbers for the record; a covariance as correlations."""
    square = values.ndim == 2 and values.shape[0] == values.shape[1] > 3
    if square and np.allclose(values, values.T, rtol=1e-6, atol=0) and np.all(np.diagonal(values) > 0):
        sigma = np.sqrt(np.diagonal(values))
        return {"correlations": digest(values / np.outer(sigma, sigma)), "sigma": of_numbers(sigma)}
    if values.size > LONGEST:
        return digest(values, digits)
    return json.loads(json.dumps(values.tolist()), parse_float=lambda text: rounded(float(text), digits))


NO_WORD = re.compile(
    r"\s|^/|[0-9a-f]{16}|^\d{4}-\d\d-\d\d|\.(parquet|csv|json|toml|html|png|mat|log|tsv|yaml|txt|ulg|BIN|md)$"
)


def is_word(text: str) -> bool:
    """Whether a string is a name or a unit; sentences, paths, hashes and dates are none."""
    return len(text) <= 64 and not NO_WORD.search(text)


def of_document(value: Any, key: str = "", digits: int = ROUGH) -> Any:
    """What of a JSON value is recorded; numbers to so many digits."""
    if key in LEFT_OUT or (isinstance(value, str) and key not in NAMES and not is_word(value)):
        return PROSE
    if isinstance(value, dict):
        fine = {name: FINE if _sigma_beside(value, name) is not None else ROUGH for name in value}
        return {name: of_document(part, name, fine[name]) for name, part in value.items()}
    if isinstance(value, float):
        return rounded(value, digits)
    if not isinstance(value, list):
        return value
    with contextlib.suppress(ValueError, TypeError):
        array = np.array([] if not value else value)
        if array.size and array.dtype.kind in "iuf":
            return of_numbers(array, digits)
    if value and all(isinstance(part, str) and not is_word(part) for part in value):
        return PROSE
    if len(value) > FEW and all(isinstance(part, dict) and part.keys() == value[0].keys() for part in value):
        if not any(name in value[0] for name in NAMES):
            columns = {name: [part[name] for part in value] for name in value[0]}
            return {"elements": len(value), **{name: of_document(column, name) for name, column in columns.items()}}
    return [of_document(part, key, digits) for part in value]


def of_table(path: Path) -> Any:
    """A table's rows, or its columns where there are many rows."""
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    if table.num_rows <= TABLE_ROWS:
        return [of_document(row) for row in json.loads(json.dumps(table.to_pylist(), default=lambda _: PROSE))]
    columns = {name: np.asarray(table[name]) for name in table.column_names}
    return {name: digest(column.astype(float), FINE) for name, column in columns.items() if column.dtype.kind in "iuf"}


def bare(message: str) -> str:
    """The words of a message, without numbers and paths."""
    words = re.sub(r"\S*/\S*", PROSE, message)
    return " ".join(re.sub(r"[-+]?\d[\d.e+-]*", "#", words).split())[:300]


def entry() -> Callable[[list[str]], int]:
    """The command line as a function, wherever this version has it; else as a process."""
    for module in ("jaximu.cli", "jaximu.cli.app"):
        with contextlib.suppress(ImportError, AttributeError):
            return import_module(module).main

    def process(arguments: list[str]) -> int:
        done = subprocess.run([sys.executable, "-m", "jaximu", *arguments], capture_output=True, text=True, check=False)
        print(done.stdout, end="")
        print(done.stderr, end="", file=sys.stderr)
        return done.returncode

    return process


def run(case: Case, folders: dict[str, Path], main: Callable[[list[str]], int]) -> dict[str, Any]:
    """Run a case in this process; return its record."""
    here = folders["OUT"] / case.name
    here.mkdir(parents=True, exist_ok=True)
    out, err = io.StringIO(), io.StringIO()
    start = time.perf_counter(), time.process_time()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        words = case.arguments(folders)
        status = main([*words, *([] if words[0] == "compensate" else ["--json"])])
    taken = {"seconds": round(time.perf_counter() - start[0], 2), "cpu": round(time.process_time() - start[1], 2)}
    record: dict[str, Any] = {"status": status}
    if status:
        messages = [line for line in err.getvalue().splitlines() if line.startswith("jaximu:")]
        record["message"] = bare(messages[0]) if messages else ""
    written = Path(words[words.index("-o") + 1]) if "-o" in words else here
    if words[0] == "simulate":
        files = sorted(path for path in written.parent.glob(f"{written.stem}*") if path.suffix != ".toml")
    else:
        files = sorted(path for path in here.rglob("*") if path.is_file())
    documents: dict[str, Any] = {}
    for path in files:
        if path.suffix == ".json":
            documents[path.name] = of_document(json.loads(path.read_text(encoding="utf-8")))
        elif path.suffix == ".parquet":
            documents[path.name] = of_table(path)
    with contextlib.suppress(ValueError):
        printed = json.loads(out.getvalue())
        shown = of_document(printed)
        same = [name for name, document in documents.items() if document == shown]
        documents["printed"] = f"as {same[0]}" if same else shown
        schema = printed.get("schema") if isinstance(printed, dict) else None
        if schema and status == 0 and not same:
            kept = here / f"{schema.partition('.')[2].partition('/')[0]}.json"
            if not kept.exists():
                kept.write_text(out.getvalue(), encoding="utf-8")
    record["files"] = [path.name for path in files]
    record["documents"] = documents
    return record | {"taken": taken}


def work(folder: Path) -> None:
    """Run cases whose names come by standard input, each answered by a line of JSON."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what is printed past Python goes elsewhere
    main, known = entry(), {case.name: case for case in cases()}
    folders = folders_of(folder)
    for line in sys.stdin:
        name = line.strip()
        try:
            record = run(known[name], folders, main)
        except BaseException as error:  # a record of it, whatever it is
            record = {"crashed": f"{type(error).__name__}: {bare(str(error))}"}
        maps = Path("/proc/self/maps")
        full = maps.exists() and maps.read_bytes().count(b"\n") > MAPS
        print(json.dumps({"record": record, "full": full}), file=answers, flush=True)


def folders_of(folder: Path) -> dict[str, Path]:
    """The folders that the command lines name."""
    return {"DATA": Path(os.environ["JAXIMU_DATA"]), "MADE": folder / "made", "OUT": folder / "out"}


class Worker:
    """A process that runs cases; another takes its place where it dies, hangs or has compiled too much."""

    def __init__(self, folder: Path, log: Path):
        self.folder, self.log = folder, log
        self.process: subprocess.Popen | None = None

    def run(self, case: Case) -> dict[str, Any]:
        """Return the record of a case."""
        if self.process is None:
            with self.log.open("a", encoding="utf-8") as log:
                command = [sys.executable, str(Path(__file__)), "--worker", str(self.folder)]
                pipe = subprocess.PIPE
                self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=log, text=True)
        process = self.process
        assert process.stdin is not None and process.stdout is not None
        clock = threading.Timer(TIMEOUT, process.kill)
        clock.start()
        with contextlib.suppress(BrokenPipeError):
            print(case.name, file=process.stdin, flush=True)
        answer = process.stdout.readline()
        clock.cancel()
        if not answer:
            status = process.wait()
            self.process = None
            return {"crashed": f"the process ended with {status}"}
        content = json.loads(answer)
        if content["full"]:
            self.close()
        return content["record"]

    def close(self) -> None:
        """End the process."""
        if self.process is not None and self.process.stdin is not None:
            self.process.stdin.close()
            self.process.wait()
        self.process = None


def recorded(chosen: list[Case], folder: Path, jobs: int, save: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
    """Run cases, groups side by side in `jobs` processes, and return their records; `save` gets those there are."""
    make_inputs(folders_of(folder)["MADE"])
    records: dict[str, Any] = {}
    saving = threading.Lock()
    workers = [Worker(folder, folder / f"worker {number}.txt") for number in range(jobs)]
    simulated = [case for case in chosen if case.simulates]
    others = [case for case in chosen if not case.simulates]
    for stage in (simulated, others):
        groups = [list(group) for _, group in itertools.groupby(stage, lambda case: case.group)]
        waiting: queue.SimpleQueue[list[Case]] = queue.SimpleQueue()
        for group in groups:
            waiting.put(group)

        def serve(worker: Worker, waiting=waiting) -> None:
            with contextlib.suppress(queue.Empty):
                while True:
                    for case in waiting.get_nowait():
                        record = worker.run(case)
                        with saving:
                            records[case.name] = record
                            save(records)
                        print(case.name, records[case.name].get("taken", "crashed"), file=sys.stderr, flush=True)

        threads = [threading.Thread(target=serve, args=(worker,)) for worker in workers]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    for worker in workers:
        worker.close()
    return {case.name: records[case.name] for case in chosen}


# --- comparison ------------------------------------------------------------------------------------------------------


@dataclass
class Difference:
    """How far a case is from its record: the largest difference, where it is, and what else changed."""

    size: float = 0.0
    where: str = ""
    changed: list[str] = field(default_factory=list)
    new: list[str] = field(default_factory=list)

    def measure(self, size: float, where: str) -> None:
        """Take in the difference of a number."""
        if not size <= self.size:
            self.size, self.where = size, where

    @property
    def fails(self) -> bool:
        """Whether it is more than the tolerance allows."""
        return bool(self.changed) or not self.size <= TOLERANCE


def compared(ours: dict[str, Any], theirs: dict[str, Any]) -> Difference:
    """Compare the record of a case with an older one."""
    difference = Difference()
    for key in ("crashed", "status"):
        if ours.get(key) != theirs.get(key):
            difference.changed.append(f"{key}: {theirs.get(key)} → {ours.get(key)}")
    if difference.changed:
        words = ours.get("message", "")
        difference.changed += [words] if words else []
        return difference
    lost = sorted(set(theirs.get("files", ())) - set(ours.get("files", ())))
    difference.changed += [f"file {name} is missing" for name in lost]
    difference.new += sorted(set(ours.get("files", ())) - set(theirs.get("files", ())))
    for name in theirs.get("documents", {}):
        if name not in ours["documents"]:
            difference.changed.append(f"document {name} is missing")
            continue
        new, old = _resolved(ours, name), _resolved(theirs, name)
        if name.endswith(".parquet") and isinstance(old, dict) and isinstance(new, dict):
            _compare_columns(new, old, name, difference)
        else:
            _compare(new, old, name, difference)
    return difference


def _resolved(record: dict[str, Any], name: str) -> Any:
    """A document; one that is printed as another is that other."""
    document = record["documents"][name]
    if name == "printed" and isinstance(document, str) and document.startswith("as "):
        return record["documents"][document.removeprefix("as ")]
    return document


def _compare(ours: Any, theirs: Any, path: str, difference: Difference, sigma: Any = None, key: str = "") -> None:
    """Compare two recorded values; `sigma` is the standard deviation beside the older one, where there is one."""
    if _is_prose(ours) and _is_prose(theirs):
        return
    if isinstance(theirs, dict) and isinstance(ours, dict):
        _compare_tables(ours, theirs, path, difference)
    elif isinstance(theirs, list) and isinstance(ours, list):
        _compare_lists(ours, theirs, path, difference, sigma, key)
    elif _is_number(theirs) and _is_number(ours):
        _compare_numbers(np.array([ours]), np.array([theirs]), path, difference, sigma)
    elif ours != theirs:
        difference.changed.append(f"{path}: {_short(theirs)} → {_short(ours)}")


def _is_prose(value: Any) -> bool:
    """Whether a value is a sentence, or may be where there is one."""
    return value in (PROSE, "", []) or (isinstance(value, list) and set(map(str, value)) == {PROSE})


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}…"


def _compare_tables(ours: dict, theirs: dict, path: str, difference: Difference) -> None:
    """Two objects with keys."""
    if "combinations" in theirs and "combinations" in ours:
        _compare_digests(ours, theirs, path, difference)
        return
    for key in theirs:
        if key not in ours:
            difference.changed.append(f"{path}/{key} is missing")
    for key in ours:
        if key not in theirs:  # a name of an effect or a parameter has a dot, a key of a document has none
            (difference.changed if "." in key else difference.new).append(f"{path}/{key} is new")
    for key, value in theirs.items():
        if key in ours:
            _compare(ours[key], value, f"{path}/{key}", difference, _sigma_beside(theirs, key), key)


def _compare_columns(ours: dict, theirs: dict, path: str, difference: Difference) -> None:
    """The columns of a table of samples."""
    for name, column in theirs.items():
        if name in ours:
            _compare_digests(ours[name], column, f"{path}/{name}", difference, IN_SAMPLES)
        else:
            difference.changed.append(f"{path}/{name} is missing")
    difference.new += [f"{path}/{name} is new" for name in ours if name not in theirs]


def _compare_digests(ours: dict, theirs: dict, path: str, difference: Difference, within: float = TOLERANCE) -> None:
    """What was made of many numbers; they may differ by this part of their norm."""
    for key in ("shape", "missing"):
        if ours[key] != theirs[key]:
            difference.changed.append(f"{path}/{key}: {theirs[key]} → {ours[key]}")
    scale = theirs["norm"] * within / TOLERANCE
    new, old = (np.array([record["norm"], *record["combinations"]]) for record in (ours, theirs))
    _compare_numbers(new, old, path, difference, [scale] * len(old))


def _sigma_beside(table: dict, key: str) -> Any:
    """The standard deviation of the number under `key`, from the keys beside it; None where there is none."""
    sigma = table.get(f"{key}_sigma")
    if sigma is None and key in BESIDE_SIGMA:
        sigma = table.get("sigma")
        if sigma is None and _is_number(table.get("uncertainty")):
            sigma = table["uncertainty"] / 2
        elif sigma is None and _is_number(table.get("low")) and _is_number(table.get("high")):
            sigma = (table["high"] - table["low"]) / 3.92
    return sigma


def _compare_lists(ours: list, theirs: list, path: str, difference: Difference, sigma: Any, key: str) -> None:
    """Two lists: of numbers, of words, or of objects that are known by their names."""
    numbers = _array(ours), _array(theirs)
    if numbers[0] is not None and numbers[1] is not None:
        _compare_numbers(*numbers, path, difference, sigma)
        return
    names = _names_of(ours), _names_of(theirs)
    if names[0] is not None and names[1] is not None:
        if names[0] != names[1]:
            lost = [f"−{name}" for name in names[1] if name not in names[0]]
            more = [f"+{name}" for name in names[0] if name not in names[1]]
            difference.changed.append(f"{path}: {' '.join(lost + more) or 'another order'}")
        old = dict(zip(names[1], theirs, strict=True))
        for name, part in zip(names[0], ours, strict=True):
            if name in old:
                _compare(part, old[name], f"{path}/{name}", difference, None, key)
        return
    if len(ours) != len(theirs):
        difference.changed.append(f"{path}: {_short(theirs)} → {_short(ours)}")
        return
    for index, (part, old) in enumerate(zip(ours, theirs, strict=True)):
        beside = sigma[index] if isinstance(sigma, list) and len(sigma) == len(theirs) else None
        _compare(part, old, f"{path}[{index}]", difference, beside, key)


def _array(values: list) -> np.ndarray | None:
    with contextlib.suppress(ValueError, TypeError):
        array = np.array(values)
        if array.size and array.dtype.kind in "iuf":
            return array
    return None


def _names_of(values: list) -> list[str] | None:
    """The names of a list's elements, numbered where one comes more than once; None where they have none."""
    if not values or not all(isinstance(part, dict) for part in values):
        return [] if not values else None
    key = next((key for key in NAMES if all(isinstance(part.get(key), str) for part in values)), None)
    if key is None:
        return None
    names: list[str] = []
    for part in values:
        count = sum(name.partition("#")[0] == part[key] for name in names)
        names.append(f"{part[key]}#{count + 1}" if count else part[key])
    return names


def _compare_numbers(ours: np.ndarray, theirs: np.ndarray, path: str, difference: Difference, sigma: Any) -> None:
    """Numbers in standard deviations; without any, relative to themselves; whole ones exactly."""
    if ours.shape != theirs.shape:
        difference.changed.append(f"{path}: shape {theirs.shape} → {ours.shape}")
        return
    off = np.where(np.isnan(ours) & np.isnan(theirs), 0.0, np.abs(ours - theirs))
    if not np.any(off):
        return
    if ours.dtype.kind in "iu" and theirs.dtype.kind in "iu":
        difference.changed.append(f"{path}: {_short(theirs.tolist())} → {_short(ours.tolist())}")
        return
    scale = np.nanmax([np.abs(theirs), np.abs(ours)], axis=0)
    floor = max(SMALL * float(np.max(scale)), SMALL)
    spread = None if sigma is None else _array(sigma if isinstance(sigma, list) else [sigma])
    if spread is not None and spread.shape == theirs.shape:
        scale = np.where(spread > 0, spread, scale)
    size = np.where(off <= floor * (spread is None), 0.0, off / np.maximum(scale, np.finfo(float).tiny))
    worst = np.unravel_index(np.argmax(size), size.shape)
    index = f"[{','.join(map(str, worst))}]" if size.size > 1 else ""
    difference.measure(float(size[worst]), f"{path}{index}")


# --- command ---------------------------------------------------------------------------------------------------------


def committed(quick: bool) -> Path:
    """The record of the quick cases, or that of the others."""
    return RESULTS / f"agreement_{'quick' if quick else 'full'}.json"


def write(path: Path, records: dict[str, Any]) -> None:
    """Write a record, a line for each case, without the time that it took."""
    lines = []
    for name, record in records.items():
        kept = {key: value for key, value in record.items() if key != "taken"}
        lines.append(f" {json.dumps(name)}: {json.dumps(kept, ensure_ascii=False, separators=(',', ':'))}")
    head = json.dumps(machine(), ensure_ascii=False)
    part = path.with_suffix(".part")
    part.write_text(f'{{"machine": {head},\n"cases": {{\n' + ",\n".join(lines) + "\n}}\n", encoding="utf-8")
    part.replace(path)


def write_committed(records: dict[str, Any], sizes: list[bool]) -> None:
    """Write the committed records of these sizes; what was not run stays as it is recorded."""
    for quick in sizes:
        path = committed(quick)
        old = read(path) if path.exists() else {}
        names = [case.name for case in cases() if case.quick == quick]
        if records.keys().isdisjoint(names):
            continue
        write(path, {name: records.get(name, old.get(name)) for name in names if name in records or name in old})


def read(*paths: Path) -> dict[str, Any]:
    """The cases of records."""
    found: dict[str, Any] = {}
    for path in paths:
        found |= json.loads(path.read_text(encoding="utf-8"))["cases"]
    return found


def table_of(ours: dict[str, Any], theirs: dict[str, Any], note: str = "") -> tuple[Table, list[str]]:
    """The table of differences, and the cases that differ."""
    table = Table(
        f"Largest difference of each case from the record, in standard deviations (goal ≤ {TOLERANCE:g})",
        ["case", "difference", "where", "changed", "seconds"],
        f"Relative where a number has no standard deviation. Seconds of processor time. {note}".strip(),
    )
    failed = []
    for name in [*theirs, *(name for name in ours if name not in theirs)]:
        if name not in ours or name not in theirs:
            table.add(name, "", "", "not run" if name not in ours else "not in the record", "")
            failed += [name] * (name not in ours)
            continue
        difference = compared(ours[name], theirs[name])
        changed = difference.changed[:SHOWN] + [f"and {len(difference.changed) - SHOWN} more"]
        words = "; ".join(changed[: len(difference.changed)] if len(difference.changed) <= SHOWN else changed)
        words += f" ({', '.join(difference.new[:SHOWN])})" if difference.new else ""
        seconds = ours[name].get("taken", {}).get("cpu", "")
        where = difference.where.replace("[", "(").replace("]", ")")  # brackets would be links
        table.add(name, f"{difference.size:.1e}", where, words.replace("|", "/"), str(seconds))
        failed += [name] * difference.fails
    return table, failed


def crashes(records: dict[str, Any]) -> Iterator[str]:
    """The cases that ended otherwise than a command may."""
    for name, record in records.items():
        if "crashed" in record:
            yield f"{name}: {record['crashed']}"
        elif "should not happen" in record.get("message", ""):
            yield f"{name}: {record['message']}"


def options_given() -> argparse.Namespace:
    """The options of this script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="only the cases that every change of code runs")
    parser.add_argument(
        "--only", nargs="+", default=[""], help="only cases or groups whose name contains one of these words"
    )
    parser.add_argument("--write", type=Path, nargs="?", const=Path(), help="record again; into FILE if there is one")
    parser.add_argument("--against", type=Path, nargs="+", help="compare with these records, not the committed ones")
    parser.add_argument("--recorded", type=Path, nargs="+", help="compare these records and run nothing")
    parser.add_argument("--cold", action="store_true", help="begin with an empty cache of compiled code")
    parser.add_argument("--jobs", type=int, default=2, help="processes side by side (default 2)")
    parser.add_argument("--note", default="", help="a remark under the table")
    parser.add_argument("--keep", type=Path, help="folder in which inputs and outputs stay")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    return parser.parse_args()


def results(chosen: list[Case], options: argparse.Namespace) -> dict[str, Any]:
    """Run the cases, and those that make their files, in a separate folder; return the records of the cases alone."""
    names = [case.name for case in chosen]

    def saved(records: dict[str, Any]) -> dict[str, Any]:
        kept = {name: records[name] for name in names if name in records}
        save(kept, options)
        return kept

    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        for part in ("made", "out", "cache"):
            (folder / part).mkdir(parents=True, exist_ok=True, mode=0o700)
        if options.cold:
            os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
        return saved(recorded(with_needed(chosen), folder, options.jobs, saved))


def save(records: dict[str, Any], options: argparse.Namespace) -> None:
    """Write what `--write` asks for; after every case, so that a run that is stopped keeps what it has."""
    if options.write == Path():
        write_committed(records, [True] if options.quick else [True, False])
    elif options.write:
        write(options.write, records)


def main() -> int:
    """Run the cases; write the record, or compare with one."""
    options = options_given()
    if options.worker:
        work(options.worker)
        return 0
    chosen = [case for case in cases() if case.quick or not options.quick]
    chosen = [case for case in chosen if any(text in f"{case.name} {case.group}" for text in options.only)]
    start = time.perf_counter()
    ours = read(*options.recorded) if options.recorded else results(chosen, options)
    seconds = time.perf_counter() - start
    print(f"{len(ours)} cases in {seconds:.0f} s", file=sys.stderr)
    for text in crashes(ours):
        print(f"crashed: {text}", file=sys.stderr)
    save(ours, options)
    if options.write:
        return 0
    theirs = read(*(options.against or map(committed, [True] if options.quick else [True, False])))
    names = {case.name for case in chosen}
    table, failed = table_of(ours, {name: record for name, record in theirs.items() if name in names}, options.note)
    whole = not (any(options.only) or options.quick or options.recorded)
    finish("agreement", [table], {"seconds": round(seconds), "differ": failed}, keep=whole)
    for name in failed:
        print(f"differs: {name}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
