"""`jaximu diagnose`: what a calibrated model gets wrong, why, and what extending it gains."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.cli.options import option
from jaximu.ground.errors import InputError

if TYPE_CHECKING:
    from jaximu.diagnosis import Diagnosis

__all__ = ["give_diagnosis", "run"]


def run(
    logs: options.Logs,
    /,
    *,
    log: options.Reading = options.READING,
    local: options.Local = options.LOCAL,
    noise: options.Noise = options.NOISE,
    heldout: Annotated[Path | None, option("LOG", "Another recording of the unit, to measure the gain on.")] = None,
    reference: Annotated[
        Path | None,
        option(
            "REF",
            "What the turntable or fixture did, as for jaximu turntable (LOG itself if it has reference "
            "columns): errors of the set-up are then tested as well. Or a measured attitude, as for jaximu reference.",
        ),
    ] = None,
    heldout_reference: Annotated[Path | None, option("REF", "The same for the held-out recording.")] = None,
    thermal: Annotated[
        bool, arg(help="The unit was at rest while the temperature changed: test thermal effects only.")
    ] = False,
    by: Annotated[
        str | None,
        option(
            "PATTERN",
            "LOGs are of several units in several sessions, as this pattern of their names or folders says, such as "
            "'unit{unit}_session{session}': what belongs to a unit, to a session or to all of them is told apart.",
        ),
    ] = None,
    poses: options.Poses = options.POSES,
    repair: options.RepairFlag = False,
    fail_on: Annotated[
        Literal["never", "unexplained", "effects"],
        arg(help="Verdicts that end with exit status 1, for scripts: none, unexplained alone, or both."),
    ] = "never",
    results: options.Output = options.RESULTS,
) -> None:
    """Find what the model misses: name the effect, add it to the model and measure the gain on data not fitted.

    Several LOGs are several recordings of one unit, each with its own biases: what the unit does in all of them shows
    together where one hardly shows it. DIR receives diagnosis.json, the extended calibration.json, report.html and
    pictures. With --by they are recordings of several units: DIR receives diagnosis.json and report.html.

    Examples:
      jaximu diagnose log.csv --static rest.csv -o results
      jaximu diagnose monday.csv tuesday.csv friday.csv -o results
      jaximu diagnose log.csv --heldout other.csv
      jaximu diagnose log.csv --reference tracker.csv
      jaximu diagnose oven.csv --thermal
      jaximu diagnose logs/*.csv --by 'unit{unit}_session{session}' -o results

    """
    gravity = local.value()
    if thermal and reference is not None:
        raise InputError("--thermal is for recordings at rest, --reference for poses and turns: give one of them.")
    if reference is not None and len(logs) != 1:
        raise InputError(f"--reference goes with one LOG, found {len(logs)}.")
    others = {"--thermal": thermal, "--reference": reference, "--heldout": heldout}
    if by is not None and (stated := [name for name, value in others.items() if value]):
        raise InputError(f"--by compares recordings with each other: leave {stated[0]} out.")
    options.require_files(reference)
    from jaximu.recordings.readers import holds_attitude

    measured = reference is not None and holds_attitude(reference)
    if measured and (heldout is not None or heldout_reference is not None):
        raise InputError("with a measured attitude the gain is measured on parts of LOG left out: omit --heldout.")
    if reference is not None and (heldout is None) != (heldout_reference is None):
        raise InputError("with --reference, --heldout LOG and --heldout-reference REF go together.")
    if reference is None and heldout_reference is not None:
        raise InputError("--heldout-reference goes with --reference.")
    results.prepare(*(options.INERTIAL if by is None else ()))
    if by is not None:
        from jaximu.diagnosis import places_of

        places_of(list(map(str, logs)), by)
    recordings, known = log.read_unit(logs, gravity, noise)
    if by is not None:
        from jaximu.diagnosis import attribute

        with progress("diagnosing", every=0.0) as report:
            attribution = attribute(
                recordings, by, gravity, report=report, static=known, segmentation=poses.value(), repair=repair
            )
        results.present(
            attribution.summary, "diagnosis.json and report.html", {}, attribution.text, diagnosis=attribution
        )
        return end(attribution.verdict, fail_on)
    other = None if heldout is None else log.read(heldout, gravity)
    from jaximu.diagnosis import diagnose, diagnose_against_attitude, diagnose_thermal, diagnose_turntable

    held: Any = other
    if thermal:
        work = partial(diagnose_thermal, recordings)
    elif reference is None:
        work = partial(diagnose, recordings, gravity, segmentation=poses.value(), repair=repair)
    elif measured:
        from jaximu.cli.reference import read_reference

        attitude = read_reference(reference, logs[0], recordings[0])
        work = partial(diagnose_against_attitude, recordings[0], attitude, gravity, repair=repair)
    else:
        from jaximu.cli.turntable import references_of

        (entries,) = references_of(recordings, [reference])
        work = partial(diagnose_turntable, recordings[0], entries, gravity, repair=repair)
        if other is not None and heldout_reference is not None:
            others = [other]  # whose reference columns are put beside its signals
            (schedule,) = references_of(others, [heldout_reference])
            held = others[0], schedule
    with progress("diagnosing"):
        diagnosis = work(static=known, **({} if held is None else {"heldout": held}))
    if not thermal and any(effect.rivals or effect.weak for effect in diagnosis.named):
        from jaximu.planning.separation import advised

        with progress("looking for a recording that would separate the causes"):
            diagnosis = advised(diagnosis)
    give_diagnosis(diagnosis, results)
    end(diagnosis.verdict, fail_on)


def end(verdict: str, fail_on: str) -> None:
    """End with exit status 1 where a verdict is one that a script is to fail on."""
    if fail_on != "never" and verdict in ("unexplained", fail_on):
        raise SystemExit(1)


def give_diagnosis(diagnosis: Diagnosis, results: options.Results) -> None:
    """Print a diagnosis; write it, the extended calibration and the report where asked."""
    documents = {"calibration": diagnosis.extended_calibration()} if results.keeps else {}
    results.present(
        diagnosis.summary,
        "diagnosis.json, calibration.json and report.html",
        {},
        diagnosis.text,
        diagnosis=diagnosis,
        **documents,
    )
