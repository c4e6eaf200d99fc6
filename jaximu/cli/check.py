"""`jaximu check`: is an old calibration still valid for a new recording, and what moved?"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from jaximu.cli import options
from jaximu.cli.messages import progress

if TYPE_CHECKING:
    from jaximu.diagnosis import Validity

__all__ = ["run"]


def run(
    calibration: options.CalibrationFile,
    logs: options.Logs,
    /,
    *,
    log: options.Reading = options.READING,
    local: options.Local = options.LOCAL,
    static: options.StaticLog = None,
    poses: options.Poses = options.POSES,
    fail_on: Annotated[
        Literal["never", "invalid"],
        arg(help="Whether a calibration that is no longer valid ends with exit status 1, for scripts."),
    ] = "never",
    results: options.Output = options.RESULTS,
) -> None:
    """Check whether an old calibration is still valid for a new recording, and which parameters moved.

    Without poses, the calibrated unit is followed through LOG by a filter from its first rest, whose innovations
    answer as far as the recording allows. DIR receives check.json and report.html.

    Examples:
      jaximu check results/calibration.json new.csv --static rest.csv

    """
    gravity = local.value()
    options.require_files(calibration)
    results.prepare()
    from jaximu.calibration import load_calibration
    from jaximu.diagnosis import check

    old = load_calibration(calibration).inertial()
    recordings, noise = log.alike(old).read_unit(logs, gravity, static)
    with progress("checking"):
        validity = check(old, recordings, gravity, static=noise, segmentation=poses.value())
    write = options.drawn("validity", "write_validity", validity)
    results.give(lambda: _print(validity), write, "check.json and report.html", check=validity)
    if fail_on == "invalid" and validity.verdict not in ("valid", "session"):
        raise SystemExit(1)


def _print(validity: Validity) -> None:
    """Print the sentence, what moved, what explains it, and what using the old calibration would cost."""
    from jaximu.cli.shown import print_all
    from jaximu.ground.quantities import probability, size, with_interval
    from jaximu.mistakes.titles import effect_title
    from jaximu.report.validity import kind_words

    data = validity.data
    held = f"{data['poses']} poses, {data['turns']} turns" if validity.history is None else f"{data['updates']} updates"
    print_all(f"{data.get('file', 'recording')}: {held}", f"{validity.verdict}: {validity.headline()}")
    largest = validity.moved or sorted((s for s in validity.shifts if s.tested), key=lambda s: -abs(s.z))[:3]
    if largest:
        headers = ("parameter", "shift ± 95 %", "in the output ± 95 %", "σ")
        rows = [(shift.words, shift.amount, shift.output, f"{abs(shift.z):.1f}") for shift in largest]
        title = "moved:" if validity.moved else "largest differences, none beyond what is uncertain:"
        print_all((headers, rows, title))
    texts = []
    statistic, freedom, p_value = validity.difference
    if freedom:
        texts.append(f"all {freedom} parameters together: χ² {statistic:.1f}, p {probability(p_value)}")
    for cause in validity.causes:
        rivals = f"; or {', '.join(map(effect_title, cause.rivals))}: this recording cannot tell them apart"
        texts.append(f"explanation: {cause.sentence}{rivals if cause.rivals else ''}")
    for name, error in validity.output_errors.items():
        where = "rotation over a turn" if name == "turns" else f"{name} output"
        texts.append(f"{where}: off by up to {with_interval(error.value, error.sigma, error.unit)}")
    texts.append(validity.bias_words())
    if validity.nis is not None:
        texts.append(f"squared innovations of the filter: {validity.nis:.2f} times what their uncertainty expects")
    words = kind_words(validity)
    for name, (before, after, unit) in validity.errors.items():
        texts.append(
            f"{words[name]}: rms {size(before, unit)} with this calibration, {size(after, unit)} with a fresh one"
        )
    print_all(*texts, notes=validity.notes)
