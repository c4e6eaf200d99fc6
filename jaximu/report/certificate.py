"""The verdict on a unit as a page, and its certificate with what ISO/IEC 17025, 7.8.2 and 7.8.4, asks for."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaximu.acceptance.acceptance import Acceptance
from jaximu.acceptance.decision import FAIL, PASS, UNDECIDED, coverage
from jaximu.acceptance.item import Item
from jaximu.acceptance.words import amount, between, in_shown_unit, spoken
from jaximu.calibration import Calibration
from jaximu.ground.document import digest
from jaximu.ground.page import Page, Part, Section, Statement, Table
from jaximu.ground.quantities import counted, sentence, unit_text
from jaximu.recordings.trace import missing
from jaximu.report.tables import provenance

_COLUMNS = ("name", "value", "limits", "probability", "verdict", "coverage", "freedom", "recording", "gravity")


def page_of(acceptance: Acceptance) -> Page:
    """Return the verdict with the items that decide it, every item beside its limits, and the decision rule."""
    items = sorted(acceptance.items, key=lambda item: (item.verdict != FAIL, item.verdict == PASS))
    counts = Counter(item.verdict for item in items)
    serial = f", serial number {acceptance.serial}" if acceptance.serial else ""
    table = Table(
        ("quantity", "value ± U (k = 2)", "limits", "conforms with probability", "verdict"),
        [tuple(row[column] for column in _COLUMNS[:5]) for row in map(item_row, items)],
        marked=[index for index, item in enumerate(items) if item.verdict != PASS],
    )
    return Page(
        f"Acceptance of {Path(acceptance.file).name}{serial}",
        tuple(_verdict(acceptance.verdict, items)),
        acceptance.verdict.capitalize(),
        ", ".join(f"{counts[verdict]} {verdict}" for verdict in (PASS, FAIL, UNDECIDED))
        + f" of {counted(len(items), 'item')}",
        (Section("Results", [table, *_remarks(items), *_rule(acceptance)]),),
        lambda: [_uncertainty(items)],
        acceptance.notes,
        _next(acceptance),
        caution=acceptance.verdict != PASS,
    )


def certificate_of(acceptance: Acceptance, calibration: Calibration) -> Page:
    """Return the page of a verdict as the certificate of a unit of which nothing is `missing`."""
    page = page_of(acceptance)
    trace = acceptance.trace or {}
    stated = trace["certificate"]
    facts = provenance(calibration)
    return replace(
        page,
        title=f"Certificate of calibration {stated['number']}, serial number {acceptance.serial}",
        first=(f"{stated['laboratory']}, {stated['address']}", _item(trace, dict(facts)), *page.first),
        rest=lambda: [*page.rest(), *_traceability(acceptance, calibration, dict(facts)["Report written"])],
        next="",
    )


# --- the verdict ------------------------------------------------------------------------------------------------------


def _verdict(verdict: str, items: Sequence[Item]) -> Iterator[str]:
    deciding = [item for item in items if item.verdict == verdict]
    if verdict == PASS:
        yield "Every item conforms with its limits."
        return
    named = "; ".join(f"{row['name']} is {row['value']}, limits {row['limits']}" for row in map(item_row, deciding[:3]))
    also = f"; and {counted(len(deciding) - 3, 'more item')}" if len(deciding) > 3 else ""
    subject = "Fails" if verdict == FAIL else "Cannot be decided"
    yield f"{subject}: {named}{also}."


def _next(acceptance: Acceptance) -> str:
    file, limits = (shlex.quote(str(name)) for name in (acceptance.file, acceptance.limits["file"]))
    if acceptance.verdict == PASS and missing(acceptance.trace):
        return f"`jaximu accept {file} --limits {limits} --trace TRACE.toml -o RESULTS` writes the certificate."
    if acceptance.verdict == PASS:
        return "`jaximu verify RESULTS/acceptance.json` checks at any time that no file was changed."
    if acceptance.verdict == FAIL:
        return "`jaximu diagnose LOG -o RESULTS` shows, before the unit is rejected, whether the model fits its log."
    return "`jaximu calibrate LOG MORE -o RESULTS` calibrates with another recording; what to record is stated above."


# --- tables -----------------------------------------------------------------------------------------------------------


def _uncertainty(items: Sequence[Item]) -> Section:
    return Section(
        "Uncertainty",
        [
            Table(
                ("quantity", "U covers", "degrees of freedom", "U from the recording", "U from gravity"),
                [
                    (row["name"], *(row[column] for column in _COLUMNS[5:]))
                    for row in map(item_row, items)
                    if row["coverage"]
                ],
                "U is the expanded uncertainty, k = 2 times the standard uncertainty; how probably it covers follows "
                "from the effective degrees of freedom. The last two columns are its budget: the recording (noise, "
                "drift and scatter) and the local gravity; they add by their squares.",
            )
        ],
    )


def _remarks(items: Sequence[Item]) -> Iterator[Statement]:
    texts = {}
    for item in items:
        if text := item.said():
            texts.setdefault(text, []).append(spoken(item.name))
    for text, names in texts.items():
        yield Statement(sentence(", ".join(names)), text, caution=True)


def _rule(acceptance: Acceptance) -> Iterator[Statement]:
    yield Statement("Decision rule", f"{acceptance.rule.words()} Each item is decided by itself.")
    sources = "; ".join(dict.fromkeys(item.source for item in acceptance.items if item.source)) or "As stated"
    yield Statement("Limits", f"{sentence(sources)} ({Path(acceptance.limits['file']).name}).")


def item_row(item: Item) -> dict[str, str]:
    """Return an item's cells, in the unit of its limits; value and U to the second digit of U."""
    shown, factor = in_shown_unit(item.unit, item.stated)
    row = {
        "name": spoken(item.name),
        "limits": between(item.low, item.high, item.unit, item.stated),
        "verdict": item.verdict,
    }
    if item.value is None or item.sigma is None:
        return dict.fromkeys(_COLUMNS, "") | {"value": "not determined"} | row
    expanded = 2 * factor * item.sigma
    digits = max(0, 1 - int(np.floor(np.log10(expanded)))) if expanded > 0 else 6
    return row | {
        "value": f"{factor * item.value:z.{digits}f} ± {expanded:.{digits}f} {shown}".replace("-", "−"),
        "coverage": f"{100 * coverage(item.freedom):.1f} %",
        "freedom": f"{item.freedom:.0f}" if item.freedom < 1e4 else "∞",
        "probability": probability_words(item.probability),
        "recording": amount(2 * item.recording, item.unit, 2, item.stated),
        "gravity": amount(2 * item.gravity, item.unit, 2, item.stated) if item.gravity else "0",
    }


def probability_words(probability: float | None) -> str:
    """Return a probability in percent; never 0 or 100, which no measurement shows."""
    if probability is None:
        return ""
    percent = 100 * probability
    return "> 99.9 %" if percent > 99.9 else "< 0.1 %" if percent < 0.1 else f"{percent:.1f} %"


# --- the certificate --------------------------------------------------------------------------------------------------


def _item(trace: dict, facts: dict[str, str]) -> Section:
    stated = trace["certificate"]
    conditions = "; ".join(
        f"{key.replace('_', ' ')} {unit_text(str(text))}" for key, text in trace["environment"].items()
    )
    rows = [("Customer", stated["customer"]), ("Item", f"{trace['model']}, serial number {trace['serial']}")]
    rows += [(key.capitalize(), str(trace[key])) for key in ("lot", "station", "fixture", "received") if key in trace]
    rows += [("Calibrated", f"{trace['date']} by {trace['operator']}"), ("Conditions", conditions)]
    rows += [(name, facts[name]) for name in ("Method", "Gravity", "Used", "Sample rate", "Software") if name in facts]
    return Section("Item and calibration", [Table((), rows)])


def _traceability(acceptance: Acceptance, calibration: Calibration, issued: str) -> Iterator[Part]:
    trace = acceptance.trace or {}
    hashes = [
        (f"Recording {Path(str(file.get('file', ''))).name}", str(file.get("sha256", "")))
        for file in calibration.data.get("files", ())
    ]
    hashes += [("Calibration", acceptance.digest or "not sealed"), ("Limits", acceptance.limits["sha256"])]
    hashes += [("Verdict (acceptance.json)", digest(acceptance.document()))]
    yield Section(
        "Traceability",
        [
            "The accelerometer's scale is traced to the local gravity stated above, the gyroscope's scale to the "
            "angles of turns, as gravity or a table shows them, and to the clock of the recording, by the references "
            "below; the results are traceable to the SI (1 g is 9.80665 m/s²). The hashes let anyone check with "
            "`jaximu verify` that no file was changed.",
            Table((), [(reference["name"], _reference(reference)) for reference in trace["reference"]]),
            Table((), hashes),
            f"Issued {issued}. Authorised by {trace['certificate']['authorised_by']}. The results hold for this item "
            "as it was calibrated. The certificate may not be reproduced except in full without approval of the "
            "laboratory.",
        ],
    )


def _reference(reference: dict[str, str]) -> str:
    validity = f"valid to {reference['expires']}" if "expires" in reference else ""
    parts = (f"certificate {reference['certificate']}", validity, reference.get("value"), reference.get("uncertainty"))
    return ", ".join(filter(None, parts))
