"""`jaximu allan`: the noise of a unit at rest, its terms with intervals, and the numbers that a filter takes."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.ground.gravity import STANDARD

if TYPE_CHECKING:
    from jaximu.noise.analysis import NoiseAnalysis
    from jaximu.recordings.recording import Recording

__all__ = ["document", "run"]


def run(
    logs: options.Logs,
    /,
    *,
    log: options.Reading = options.READING,
    results: options.Output = options.RESULTS,
) -> None:
    """Identify the noise of a unit at rest from its Allan deviation; several LOGs show how repeatable its bias is.

    DIR receives allan.json, allan.png, report.html and imu.yaml for Kalibr.

    Examples:
      jaximu allan rest.csv -o noise
      jaximu allan monday.csv tuesday.csv wednesday.csv --json

    """
    with progress("reading"):
        recordings = [log.read(path, STANDARD, alone=True) for path in logs]
    with progress("identifying the noise"):
        from jaximu.noise.analysis import analyse_noise

        analysis = analyse_noise(recordings)
        from jaximu.report.allan import kalibr_text

        text = json.dumps(document(analysis), indent=1, allow_nan=False)
        yaml = kalibr_text(analysis).encode("utf-8", "backslashreplace")
    names = "allan.json, allan.png, report.html and Kalibr's imu.yaml"
    results.give(
        lambda: _print(analysis),
        partial(_write, analysis, recordings),
        names,
        {"allan.json": (text + "\n").encode(), "imu.yaml": yaml},
        lambda: text,
    )


def document(analysis: NoiseAnalysis) -> dict[str, Any]:
    """Return `allan.json`: the analysis, `mean` (each term over a triad's axes, see `mean_terms`), and `filter`."""
    from jaximu.ground.units import SENSOR_QUANTITIES
    from jaximu.model.data_sheet import SI_UNITS
    from jaximu.noise.filter_noise import filter_document, mean_terms

    mean: dict[str, Any] = {}
    for name, quantity in SENSOR_QUANTITIES.items():
        terms = mean_terms(analysis.axes[name]) if name in analysis.axes else None
        mean[name] = terms and {
            term: estimate and estimate.document(SI_UNITS[quantity][term]) for term, estimate in terms.items()
        }
    return analysis.document() | {"mean": mean, "filter": filter_document(analysis)}


def _write(analysis: NoiseAnalysis, recordings: list[Recording], folder: Path) -> tuple[Path, ...]:
    """Write the page and its picture."""
    from jaximu.ground.atomic import write_folder
    from jaximu.report.allan import noise_report

    page, pictures = noise_report(analysis, [source for recording in recordings for source in recording.sources])
    return write_folder(folder, pictures | {"report.html": page})


def _print(analysis: NoiseAnalysis) -> None:
    from jaximu.cli.shown import print_all
    from jaximu.ground.quantities import unit_text
    from jaximu.ground.units import SENSOR_QUANTITIES
    from jaximu.noise.filter_noise import filter_numbers
    from jaximu.report.allan import filter_rows, repeatability_rows, term_rows, unresolved, unseen_notes

    for name, axes in analysis.axes.items():
        rows: list[tuple[str, ...]] = []
        for row in term_rows(axes, SENSOR_QUANTITIES[name]):
            values, intervals = zip(*row.texts(), strict=True)
            rows.append((f"{row.term} {row.meaning}" if row.first else "", unit_text(row.unit), *values))
            if row.first:  # the interval once: it is the same share of the value in either unit
                rows.append(("", "", *intervals))
        print_all(
            f"\n{name}, {analysis.rates[name]:.5g} Hz. Continuous, two-sided, with 95 % intervals; mean: root "
            "mean square",
            (("term", "unit", "x", "y", "z", "mean"), rows),
            *unseen_notes(axes, SENSOR_QUANTITIES[name]),
        )
    for name in analysis.axes:
        mean = filter_numbers(analysis, name)[1]  # those of the axes are in the report and in allan.json
        print_all(
            f"\nFor a Kalman filter, {name} (mean of the axes, SI; Δt = 1/{mean.rate:.5g} s)",
            (("", "", "value", "unit"), [row for row in filter_rows(mean) if None not in row]),
        )
    print_all(*(f"\nLength, {name}: {text}" for name, text in unresolved(analysis).items()))
    if analysis.repeatability:
        rows = []
        for row in repeatability_rows(analysis):
            if row.first:
                values, intervals = zip(*row.texts(), strict=True)
                rows += [(row.meaning, unit_text(row.unit), *values), ("", "", *intervals)]
        print_all(
            "\nRepeatability: standard deviation of the bias over the recordings, with its 95 % interval",
            (("", "unit", "x", "y", "z"), rows),
        )
    print_all(notes=analysis.notes)
