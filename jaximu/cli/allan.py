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
    from rich.console import Console

    from jaximu.noise.analysis import NoiseAnalysis
    from jaximu.noise.filter_noise import FilterNumbers
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
        lambda: text,
        lambda: _print(analysis),
        partial(_write, analysis, recordings),
        names,
        {"allan.json": (text + "\n").encode(), "imu.yaml": yaml},
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

    from jaximu.cli.shown import console, table
    from jaximu.ground.quantities import unit_text
    from jaximu.ground.units import SENSOR_QUANTITIES
    from jaximu.noise.filter_noise import filter_numbers
    from jaximu.report.allan import repeatability_rows, term_rows, unresolved, unseen_notes

    screen = console()
    for name, axes in analysis.axes.items():
        screen.print(
            f"\n{name}, {analysis.rates[name]:.5g} Hz. Continuous, two-sided, with 95 % intervals; mean: root "
            "mean square"
        )
        made: list[tuple[str, ...]] = []
        last = ""
        for row in term_rows(axes, SENSOR_QUANTITIES[name]):
            words = "" if row.term == last else f"{row.term} {row.meaning}"
            values, intervals = zip(*row.texts(), strict=True)
            made.append((words, unit_text(row.unit), *values))
            if row.term != last:  # the interval once: it is the same share of the value in either unit
                made.append(("", "", *intervals))
            last = row.term
        table(screen, ("term", "unit", "x", "y", "z", "mean"), made)
        for note in unseen_notes(axes, SENSOR_QUANTITIES[name]):
            screen.print(note)
    for name in analysis.axes:
        numbers = filter_numbers(analysis, name)[1]
        _print_filter(name, numbers, screen)
    for name, text in unresolved(analysis).items():
        screen.print(f"\nLength, {name}: {text}")
    if analysis.repeatability:
        screen.print("\nRepeatability: standard deviation of the bias over the recordings, with its 95 % interval")
        made = []
        for row in repeatability_rows(analysis)[::2]:
            values, intervals = zip(*row.texts(), strict=True)
            made += [(row.meaning, unit_text(row.unit), *values), ("", "", *intervals)]
        table(screen, ("", "unit", "x", "y", "z"), made)
    for note in analysis.notes:
        screen.print(f"note: {note}")


def _print_filter(name: str, numbers: FilterNumbers, screen: Console) -> None:
    """Print a filter's numbers of a triad's mean; those of the axes are in the report and in allan.json."""
    from jaximu.cli.shown import table
    from jaximu.ground.quantities import number, unit_text

    screen.print(f"\nFor a Kalman filter, {name} (mean of the axes, SI; Δt = 1/{numbers.rate:.5g} s)")
    made = []
    for key, formula, words, value, unit in numbers.rows():
        if value is not None:
            made.append((formula, words, number(value, 8 if key == "decay" else 4), unit_text(unit)))
    table(screen, ("", "", "value", "unit"), made)
