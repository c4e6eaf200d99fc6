"""`jaximu info`: what a log holds and what it can be used for."""

import json
from typing import Annotated, Any

import numpy as np
import tyro

from jaximu.cli.options import JsonFlag, LogOptions, Logs
from jaximu.errors import JaximuError
from jaximu.gravity import STANDARD
from jaximu.recording import Recording, plausibility
from jaximu.segmentation import segment

__all__ = ["run"]


def run(
    logs: Logs,
    /,
    *,
    log: Annotated[LogOptions, tyro.conf.arg(name="")] = LogOptions(),  # noqa: B008
    as_json: JsonFlag = False,
) -> None:
    """What is in a log: sensors, rate and jitter, units, and what it can be used for."""
    documents = [_describe(log.read(path, check=False)) for path in logs]
    if as_json:
        print(json.dumps(documents[0] if len(documents) == 1 else documents, indent=1, allow_nan=False))
        return
    for document in documents:
        _print(document)


def _describe(recording: Recording) -> dict[str, Any]:
    signals = {}
    for name, signal in recording.signals.items():
        interval = np.diff(signal.time)
        signals[name] = {
            "unit": signal.unit,
            "samples": len(signal),
            "rate": float(signal.rate),
            "jitter": float(np.std(interval)) if len(interval) else 0.0,
            "longest_gap": float(interval.max()) if len(interval) else 0.0,
            "duration": float(signal.time[-1] - signal.time[0]),
            "minimum": signal.values.min(axis=0).tolist(),
            "maximum": signal.values.max(axis=0).tolist(),
        }
    findings = list(recording.notes)
    uses = []
    try:
        findings += plausibility(recording, STANDARD)
        found = segment(recording)
        still = float(np.sum(found.intervals[:, 1] - found.intervals[:, 0]))
        findings.append(f"{len(found.intervals)} static poses, {still:.0f} s in all")
        uses.append("calibrate" if len(found.intervals) >= 9 else "calibrate, as far as its few poses allow")
    except JaximuError as error:
        findings.append(str(error))
    return {"file": recording.name, "signals": signals, "findings": findings, "uses": uses}


def _print(document: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    table = Table("signal", "unit", "samples", "rate [Hz]", "jitter [ms]", "longest gap [s]", "duration [s]",
                  "minimum", "maximum", title=document["file"])  # fmt: skip
    for name, signal in document["signals"].items():
        numbers = (" ".join(f"{value:.4g}" for value in signal[key]) for key in ("minimum", "maximum"))
        table.add_row(
            name, signal["unit"], str(signal["samples"]), f"{signal['rate']:.5g}", f"{1e3 * signal['jitter']:.3g}",
            f"{signal['longest_gap']:.3g}", f"{signal['duration']:.5g}", *numbers,
        )  # fmt: skip
    console.print(table)
    for finding in document["findings"]:
        console.print(f"- {finding}", markup=False, highlight=False)
    uses = ", ".join(document["uses"]) or "nothing that this version does"
    console.print(f"Can be used for: {uses}.", markup=False, highlight=False)
