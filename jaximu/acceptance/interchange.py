"""Verdicts as test systems take them: a CSV of measurements, JUnit's XML, or records as OpenHTF writes them.

Each limit of each unit is one measurement with its value, expanded uncertainty (k = 2), limits and verdict, in SI. Test
systems know pass and fail alone. What is undecided was not shown to conform and never counts as passed: an *error* in
JUnit's words, in OpenHTF's a failure that is *marginal*, or *UNSET* where there is no value.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc

from jaximu.acceptance.acceptance import Acceptance
from jaximu.acceptance.decision import FAIL, PASS, UNDECIDED, worst
from jaximu.acceptance.item import Item
from jaximu.acceptance.line import Line
from jaximu.acceptance.words import between
from jaximu.ground.atomic import atomic_write
from jaximu.ground.document import Json
from jaximu.ground.errors import FilePath, InputError

_COLUMNS = (
    "device",
    "file",
    "name",
    "value",
    "uncertainty",
    "unit",
    "low",
    "high",
    "verdict",
    "probability",
    "source",
    "reason",
)
_NOT_CALIBRATED = Item("calibration", -np.inf, np.inf, "", "", reason="the unit was not calibrated")


def check_measurements(path: FilePath) -> str:
    """Return the suffix of a file for measurements. Raises `InputError` for another."""
    suffix = Path(path).suffix.lower()
    if suffix not in _WRITERS:
        raise InputError(f"{os.fspath(path)}: measurements go to {', '.join(_WRITERS)}: CSV, JUnit or OpenHTF.")
    return suffix


def write_measurements(verdicts: Sequence[Acceptance] | Line, path: FilePath) -> None:
    """Write verdicts by the suffix of `path`, whole or not at all: `.csv`, `.xml` (JUnit) or `.json` (OpenHTF).

    Raises `InputError` for another suffix, or where it cannot be written.
    """
    writer = _WRITERS[check_measurements(path)]
    rows = list(_of_line(verdicts) if isinstance(verdicts, Line) else _of_units(verdicts))
    with atomic_write(path) as temporary:
        temporary.write_bytes(writer(rows))


def _row(item: Item, device: str, file: str, date: str) -> Json:
    return item.document() | {"device": device, "file": file, "date": date, "item": item}


def _of_units(verdicts: Sequence[Acceptance]) -> Iterator[Json]:
    for acceptance in verdicts:
        day = str((acceptance.trace or {}).get("date", ""))
        for item in acceptance.items:
            yield _row(item, acceptance.serial or acceptance.file, acceptance.file, day)


def _of_line(line: Line) -> Iterator[Json]:
    table = line.table
    for row, (device, file, day) in enumerate(zip(table.devices, table.files, table.days.tolist(), strict=True)):
        date = "" if np.isnan(day) else str(np.datetime64(int(day), "D"))
        for item in line.judgement(row):
            yield _row(item, device, file, date)
    for missing in sorted(set(range(table.total)) - set(table.rows.tolist())):
        yield _row(_NOT_CALIBRATED, f"row {missing + 1} of {table.file}", table.file, "")


def _by_unit(rows: list[Json]) -> Iterator[tuple[str, list[Json]]]:
    for (device, _), some in groupby(rows, lambda row: (row["device"], row["file"])):
        yield device, list(some)


def _csv(rows: list[Json]) -> bytes:
    sink = pa.BufferOutputStream()
    pc.write_csv(pa.table({name: [row[name] for row in rows] for name in _COLUMNS}), sink)
    return sink.getvalue().to_pybytes()


def _said(row: Json) -> str:
    item: Item = row["item"]
    if item.value is None:
        return item.said() or "no value"
    text = f"{item.value:.6g} ± {2 * (item.sigma or 0.0):.2g} {item.unit} (k = 2)"
    return f"{text}; the limits are {between(item.low, item.high, item.unit)}. {item.said()}".strip()


def _junit(rows: list[Json]) -> bytes:
    suites = ElementTree.Element("testsuites", name="jaximu accept")
    for device, some in _by_unit(rows):
        count = {verdict: str(sum(row["verdict"] == verdict for row in some)) for verdict in (FAIL, UNDECIDED)}
        suite = ElementTree.SubElement(
            suites,
            "testsuite",
            name=device,
            tests=str(len(some)),
            failures=count[FAIL],
            errors=count[UNDECIDED],
            **({"timestamp": some[0]["date"]} if some[0]["date"] else {}),
        )
        for row in some:
            case = ElementTree.SubElement(suite, "testcase", classname=device, name=row["name"])
            if row["verdict"] == PASS:
                ElementTree.SubElement(case, "system-out").text = _said(row)
            else:
                kind = "failure" if row["verdict"] == FAIL else "error"
                ElementTree.SubElement(case, kind, type=row["verdict"], message=_said(row))
    ElementTree.indent(suites)
    return ElementTree.tostring(suites, encoding="utf-8", xml_declaration=True)


def _openhtf(rows: list[Json]) -> bytes:
    records = []
    for device, some in _by_unit(rows):
        verdict = worst([row["verdict"] for row in some])
        day = some[0]["date"]
        stamp = round(1000 * datetime.fromisoformat(day).replace(tzinfo=UTC).timestamp()) if day else None
        outcome = "PASS" if verdict == PASS else "FAIL"
        marginal = verdict == UNDECIDED
        missed = [row for row in some if row["verdict"] != PASS]
        details = [{"code": verdict, "description": f"{row['name']}: {_said(row)}"} for row in missed]
        times = {"start_time_millis": stamp, "end_time_millis": stamp}
        phase = {
            "name": "calibration",
            "outcome": outcome,
            "marginal": marginal,
            **times,
            "measurements": {row["name"]: _measurement(row) for row in some},
        }
        records.append(
            {
                "dut_id": device,
                "outcome": outcome,
                "marginal": marginal,
                "outcome_details": details,
                **times,
                "metadata": {"test_name": "jaximu accept", "file": some[0]["file"]},
                "phases": [phase],
            }
        )
    return json.dumps(records[0] if len(records) == 1 else records, indent=1, allow_nan=False).encode()


def _measurement(row: Json) -> Json:
    low, high = row["low"], row["high"]
    bound = (
        f"{low:g} <= x <= {high:g}" if None not in (low, high) else f"x <= {high:g}" if low is None else f"x >= {low:g}"
    )
    record = {
        "name": row["name"],
        "validators": [bound],
        "units": {"suffix": row["unit"]},
        "docstring": f"{row['verdict']}: {_said(row)}",
    }
    if row["value"] is None:
        return record | {"outcome": "UNSET"}
    return record | {
        "outcome": "PASS" if row["verdict"] == PASS else "FAIL",
        "marginal": row["verdict"] == UNDECIDED,
        "measured_value": row["value"],
        "uncertainty": row["uncertainty"],
    }


_WRITERS = {".csv": _csv, ".xml": _junit, ".json": _openhtf}
