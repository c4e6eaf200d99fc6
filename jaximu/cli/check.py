"""`jaximu check`: is an old calibration still valid for a new recording, and what moved?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from jaximu.cli.calibrate import prepare_folder
from jaximu.cli.options import (
    CalibrationFile,
    GravityOptions,
    JsonFlag,
    LogOptions,
    Logs,
    MinimumDuration,
    OutputFolder,
    StaticLog,
    Threshold,
    progress,
    require_files,
    say,
)

if TYPE_CHECKING:
    from jaximu.diagnosis import Validity

__all__ = ["run"]


def run(
    calibration: CalibrationFile,
    logs: Logs,
    /,
    *,
    log: Annotated[LogOptions, tyro.conf.arg(name="")] = LogOptions(),  # noqa: B008
    local: Annotated[GravityOptions, tyro.conf.arg(name="")] = GravityOptions(),  # noqa: B008
    static: StaticLog = None,
    threshold: Threshold = None,
    minimum_duration: MinimumDuration = 0.8,
    output: OutputFolder = None,
    as_json: JsonFlag = False,
) -> None:
    """Check whether an old calibration is still valid for a new recording, and which parameters moved.

    DIR receives check.json and report.html.

    Examples:
      jaximu check results/calibration.json new.csv --static rest.csv

    """
    gravity = local.value()
    require_files(calibration, *logs)
    from jaximu.calibration import load_calibration
    from jaximu.diagnosis import check
    from jaximu.segmentation import SegmentationOptions

    old = load_calibration(calibration).inertial()
    if output is not None:
        prepare_folder(output)
    with progress("reading"):
        recordings = log.read_all(logs, gravity)
        noise = None if static is None else log.read(static, gravity, check=False)
    options = SegmentationOptions(threshold=threshold, minimum_duration=minimum_duration)
    with progress("checking"):
        validity = check(old, recordings, gravity, static=noise, segmentation=options)
    if as_json:
        print(validity.text())
    else:
        print_validity(validity)
    if output is not None:
        write_results(validity, output)
    elif not as_json:
        say("Nothing was written: -o DIR writes check.json and report.html there.")


def write_results(validity: Validity, folder: Path) -> None:
    """Write `check.json` and the report into a folder."""
    from jaximu.report.validity import write_validity

    prepare_folder(folder)
    validity.save(folder / "check.json")
    with progress("drawing the report"):
        report = write_validity(validity, folder)
    say(f"Written: {folder / 'check.json'}, {report}")


def print_validity(validity: Validity) -> None:
    """Print the sentence, what moved, what explains it, and what using the old calibration would cost."""
    from jaximu.cli.shown import console as screen
    from jaximu.cli.shown import table
    from jaximu.effects import effect_title
    from jaximu.quantities import probability, size, with_interval

    console = screen()
    data = validity.data
    console.print(f"{data.get('file', 'recording')}: {data['poses']} poses, {data['turns']} turns", markup=False)
    console.print(f"{validity.verdict}: {validity.headline()}", markup=False)
    largest = validity.moved or sorted((s for s in validity.shifts if s.tested), key=lambda s: -abs(s.z))[:3]
    rows = [(each.words, each.amount, each.output, f"{abs(each.z):.1f}") for each in largest]
    if rows:
        title = "moved:" if validity.moved else "largest differences, none beyond what is uncertain:"
        table(console, ("parameter", "shift ± 95 %", "in the output ± 95 %", "σ"), rows, title)
    statistic, freedom, p_value = validity.difference
    if freedom:
        console.print(f"all {freedom} parameters together: χ² {statistic:.1f}, p {probability(p_value)}")
    for cause in validity.causes:
        rivals = f"; or {', '.join(map(effect_title, cause.rivals))}: this recording cannot tell them apart"
        console.print(f"explained by {cause.title}: {cause.words}{rivals if cause.rivals else ''}", markup=False)
    for name, each in validity.output_errors.items():
        where = "rotation over a turn" if name == "turns" else f"{name} output"
        console.print(f"{where}: off by up to {with_interval(each.value, each.sigma, each.unit)}", markup=False)
    console.print(validity.bias_words(), markup=False)
    words = {kind.name: kind.words for kind in validity.experiment.residual_kinds}
    for name, (before, after, unit) in validity.errors.items():
        console.print(f"{words[name]}: rms {size(before, unit)} with this calibration, "
                      f"{size(after, unit)} with a fresh one", markup=False)  # fmt: skip
    for note in validity.notes:
        console.print(f"note: {note}", markup=False)
