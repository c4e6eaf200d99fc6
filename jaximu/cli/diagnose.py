"""`jaximu diagnose`: what a calibrated model gets wrong, why, and what extending it gains."""

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from jaximu.calibration import Calibration
from jaximu.cli.calibrate import prepare_folder
from jaximu.cli.options import GravityOptions, JsonFlag, LogOptions, Logs, OutputFolder, progress, say
from jaximu.diagnosis import Diagnosis, diagnose
from jaximu.diagnosis.diagnosis import probability
from jaximu.segmentation import SegmentationOptions

__all__ = ["run"]


def run(
    logs: Logs,
    /,
    *,
    log: Annotated[LogOptions, tyro.conf.arg(name="")] = LogOptions(),  # noqa: B008
    local: Annotated[GravityOptions, tyro.conf.arg(name="")] = GravityOptions(),  # noqa: B008
    static: Annotated[
        Path | None, tyro.conf.arg(metavar="LOG", help="Take the noise from this recording at rest.")
    ] = None,
    heldout: Annotated[
        Path | None, tyro.conf.arg(metavar="LOG", help="Measure the gain on this other recording of the unit.")
    ] = None,
    threshold: Annotated[float | None, tyro.conf.arg(help="Still: variance up to this multiple of the floor.")] = None,
    minimum_duration: Annotated[float, tyro.conf.arg(help="Shortest pose in s.")] = 0.8,
    output: OutputFolder = None,
    as_json: JsonFlag = False,
) -> None:
    """Calibrate a unit, name what its model lacks, extend the model and measure the gain on data not fitted."""
    gravity = local.value()
    if output is not None:
        prepare_folder(output)
    with progress("reading"):
        recordings = log.read_all(logs, gravity)
        noise = None if static is None else log.read(static, gravity, check=False)
        other = None if heldout is None else log.read(heldout, gravity)
    options = SegmentationOptions(threshold=threshold, minimum_duration=minimum_duration)
    with progress("diagnosing"):
        diagnosis = diagnose(recordings, gravity, noise, other, options)
    if as_json:
        print(diagnosis.text())
    else:
        print_diagnosis(diagnosis)
    if output is not None:
        write_results(diagnosis, output)
    elif not as_json:
        say("Nothing was written: -o DIR writes diagnosis.json, calibration.json and report.html there.")


def write_results(diagnosis: Diagnosis, folder: Path) -> Calibration:
    """Write `diagnosis.json`, the extended `calibration.json` and the report into a folder."""
    from jaximu.report.diagnosis import write_diagnosis

    prepare_folder(folder)
    calibration = diagnosis.extended_calibration()
    diagnosis.save(folder / "diagnosis.json")
    calibration.save(folder / "calibration.json")
    with progress("drawing the report"):
        report = write_diagnosis(diagnosis, folder)
    say(f"Written: {folder / 'diagnosis.json'}, {folder / 'calibration.json'}, {report}")
    return calibration


def print_diagnosis(diagnosis: Diagnosis) -> None:
    """Print the sentence, the effects with their evidence, and what else a person should know."""
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    data = diagnosis.calibration.data
    console.print(f"{data.get('file', 'recording')}: {data['poses']} poses, {data['turns']} turns", markup=False)
    console.print(f"{diagnosis.verdict}: {diagnosis.headline()}", markup=False)
    if diagnosis.effects:
        table = Table()
        for column in ("effect", "coefficients ± 95 %", "unit", "evidence", "or"):
            table.add_column(column, overflow="fold")
        for each in diagnosis.effects:
            numbers = zip(np.asarray(each.effect.coefficients), each.sigma, strict=True)
            text = "\n".join(f"{value:.3g} ± {1.96 * sigma:.2g}" for value, sigma in numbers)
            inner = [f"{name.replace('_', ' ')} {float(getattr(each.effect, name)):.4g} {known.unit}"
                     for name, known in each.effect.inner.items()]  # fmt: skip
            table.add_row(
                each.name, "\n".join([text, *inner]), each.unit, each.evidence + (" (weak)" if each.weak else ""),
                "\n".join(each.rivals),
            )  # fmt: skip
        console.print(table)
    gain = diagnosis.gain
    if gain is not None:
        before, after = (part.chi_squared / part.count for part in (gain.before, gain.after))
        console.print(
            f"On data not fitted ({gain.data}): χ² per condition {before:.2f} → {after:.2f}, log-likelihood "
            f"{gain.log_likelihood:+.1f}.", markup=False,
        )  # fmt: skip
        for kind, (value, unit) in gain.before.rms.items():
            console.print(f"  {kind.replace('_', ' ')}: rms {value:.3g} → {gain.after.rms[kind][0]:.3g} {unit}")
    wrong = [check for check in diagnosis.checks if check.p_value < 1e-3]
    for check in wrong[:6]:
        console.print(f"base model: {check.text} (p {probability(check.p_value)})", markup=False)
    for finding in diagnosis.preflight:
        console.print(f"{finding.name}: {finding.text}", markup=False)
    if not diagnosis.effects:
        limits = sorted(diagnosis.detection_limits.items())
        table = Table("could still hide", "up to (found with 90 % power)", title="Detection limits", title_style="")
        for name, (value, unit) in limits:
            table.add_row(name, f"{value:.2g} {unit}")
        console.print(table)
    if diagnosis.unit > 1.05:
        console.print(
            f"note: what no effect can explain scatters {diagnosis.unit:.2f} times the noise; tests were widened by it."
        )
    if diagnosis.suggestion:
        console.print(f"next: {diagnosis.suggestion}", markup=False)
    for note in diagnosis.notes:
        console.print(f"note: {note}", markup=False)
