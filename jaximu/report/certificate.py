"""The certificate of a unit: one printable page with what ISO/IEC 17025, 7.8.2 and 7.8.4, asks for."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaximu.acceptance.acceptance import Acceptance
from jaximu.acceptance.decision import coverage
from jaximu.acceptance.item import Item
from jaximu.acceptance.words import amount, between, in_shown_unit, spoken
from jaximu.calibration import Calibration
from jaximu.ground.atomic import write_files
from jaximu.ground.document import digest
from jaximu.ground.summary import sentence
from jaximu.report.html import page
from jaximu.report.tables import provenance

__all__ = ["item_row", "remarks", "sources", "write_certificate"]

_COLUMNS = ("name", "value", "limits", "probability", "verdict", "coverage", "freedom", "recording", "gravity")
_MEANINGS = {
    "pass": "all items conform with their limits",
    "fail": "at least one item does not conform with its limits",
    "undecided": "no item fails, and at least one cannot be decided by this calibration",
}


def write_certificate(acceptance: Acceptance, calibration: Calibration, path: Path) -> Path:
    """Write the certificate of a unit of which nothing is `missing` and return its path.

    Raises `InputError` where it cannot be written.
    """
    return write_files({path: _certificate(acceptance, calibration)})[0]


def _certificate(acceptance: Acceptance, calibration: Calibration) -> bytes:
    trace = acceptance.trace or {}
    stated = trace["certificate"]
    known = dict(provenance(calibration))
    issued = known.pop("Report written")
    conditions = "; ".join(f"{key.replace('_', ' ')} {text}" for key, text in trace["environment"].items())
    facts = [("Customer", stated["customer"]), ("Item", f"{trace['model']}, serial number {trace['serial']}")]
    facts += [(key.capitalize(), trace[key]) for key in ("lot", "station", "fixture") if key in trace]
    facts += [("Received", trace["received"])] if "received" in trace else []
    facts += [("Calibrated", f"{trace['date']} by {trace['operator']}"), ("Conditions", conditions)]
    facts += [(name, known[name]) for name in ("Method", "Gravity", "Used", "Sample rate", "Software") if name in known]
    hashes = [
        (f"Recording {Path(str(file.get('file', ''))).name}", str(file.get("sha256", "")))
        for file in calibration.data.get("files", ())
    ]
    hashes += [("Calibration", acceptance.digest or "not sealed"), ("Limits", acceptance.limits["sha256"])]
    hashes += [("Verdict (acceptance.json)", digest(acceptance.document()))]
    return page(
        "certificate",
        {},
        title=f"Certificate of calibration {stated['number']}",
        laboratory=f"{stated['laboratory']}, {stated['address']}",
        verdict=acceptance.verdict.capitalize(),
        meaning=_MEANINGS[acceptance.verdict],
        facts=facts,
        rows=[(*(row[key] for key in _COLUMNS), row["verdict"] != "pass") for row in map(item_row, acceptance.items)],
        open=[(sentence(", ".join(names)), text) for text, names in remarks(acceptance).items()],
        remarks=" ".join(sentence(note) for note in acceptance.notes),
        rule=acceptance.rule.words(),
        limits=f"{sources(acceptance) or 'as stated'} ({Path(acceptance.limits['file']).name})",
        statement="The accelerometer's scale is traced to the local gravity stated above, the gyroscope's scale to the "
        "angles of turns, as gravity or a table shows them, and to the clock of the recording, by the references below;"
        " the results are in SI units. The hashes let anyone check with `jaximu verify` that no file was changed.",
        references=[
            (
                reference["name"],
                ", ".join(
                    filter(
                        None,
                        (
                            f"certificate {reference['certificate']}",
                            f"valid to {reference['expires']}" if "expires" in reference else "",
                            reference.get("value", ""),
                            reference.get("uncertainty", ""),
                        ),
                    )
                ),
            )
            for reference in trace["reference"]
        ],
        hashes=hashes,
        closing=f"Issued {issued}. Authorised by {stated['authorised_by']}. The results hold for this item as it was "
        "calibrated. The certificate may not be reproduced except in full without approval of the laboratory.",
    )[0]


def remarks(acceptance: Acceptance) -> dict[str, list[str]]:
    """Return what is to be said of items beside their row, each text with the items that it is about."""
    texts: dict[str, list[str]] = {}
    for item in acceptance.items:
        if text := item.said():
            texts.setdefault(text, []).append(spoken(item.name))
    return texts


def sources(acceptance: Acceptance) -> str:
    """Return where the limits come from, as far as they say it."""
    return "; ".join(dict.fromkeys(item.source for item in acceptance.items if item.source))


def item_row(item: Item) -> dict[str, str]:
    """Return an item's cells: value and expanded uncertainty to the latter's second digit, in one unit."""
    shown, factor = in_shown_unit(item.unit)
    limits = between(item.low, item.high, item.unit)
    row = {"name": spoken(item.name), "limits": limits, "verdict": item.verdict}
    if item.value is None or item.sigma is None:
        return dict.fromkeys(_COLUMNS, "") | {"value": "not determined"} | row
    expanded = 2 * factor * item.sigma
    digits = max(0, 1 - int(np.floor(np.log10(expanded)))) if expanded > 0 else 6
    value = f"{factor * item.value:z.{digits}f} ± {expanded:.{digits}f} {shown}".replace("-", "−")
    return row | {
        "value": value,
        "coverage": f"{100 * coverage(item.freedom):.1f} %",
        "freedom": f"{item.freedom:.0f}" if item.freedom < 1e4 else "∞",
        "probability": probability_words(item.probability),
        "recording": amount(2 * item.recording, item.unit, 2),
        "gravity": amount(2 * item.gravity, item.unit, 2) if item.gravity else "0",
    }


def probability_words(probability: float | None) -> str:
    """Return a probability in percent; never 0 or 100, which no measurement shows."""
    if probability is None:
        return ""
    percent = 100 * probability
    return "> 99.9 %" if percent > 99.9 else "< 0.1 %" if percent < 0.1 else f"{percent:.1f} %"
