"""`jaximu diagnose`: what a calibrated model gets wrong, why, and what extending it gains."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import jaximu
from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.cli.options import option, switch, takes_options
from jaximu.ground.errors import InputError

if TYPE_CHECKING:
    from jaximu.diagnosis import Diagnosis
    from jaximu.fleets import Job


@takes_options
class DiagnoseCommand(options.Fits):
    """Find what the model misses: name the effect, add it to the model and measure the gain on data not fitted.

    Several LOGs are several recordings of one unit, each with its own biases: what the unit does in all of them shows
    together where one hardly shows it, and drift is tested in each by itself. DIR receives diagnosis.json, the
    extended calibration.json, report.html and pictures. With --by they are recordings of several units: DIR receives
    diagnosis.json and report.html. A manifest or a table of jaximu fleet with the columns session and unit (or device)
    in place of LOGS names them as well.

    Examples:
      jaximu diagnose log.csv --static rest.csv -o results
      jaximu diagnose monday.csv tuesday.csv friday.csv -o results
      jaximu diagnose log.csv --heldout other.csv
      jaximu diagnose log.csv --reference tracker.csv
      jaximu diagnose oven.csv --thermal
      jaximu diagnose logs/*.csv --by 'unit{unit}_session{session}' -o results
      jaximu diagnose fleet.parquet -o results

    """

    logs: options.Logs
    heldout: Path | None = option("LOG", "Another recording of the unit, to measure the gain on.")
    reference: Path | None = option(
        "REF",
        "What the turntable or fixture did, as for jaximu turntable (LOG itself if it has reference "
        "columns): errors of the set-up are then tested as well. Or a measured attitude, as for jaximu reference.",
    )
    heldout_reference: Path | None = option("REF", "The same for the held-out recording.")
    thermal: bool = switch("The unit was at rest while the temperature changed: test thermal effects only.")
    by: str | None = option(
        "PATTERN",
        "LOGs are of several units in several sessions, as this pattern of their names or folders says, such as "
        "'unit{unit}_session{session}': what belongs to a unit, to a session or to all of them is told apart.",
    )
    poses: options.PoseOptions = options.POSES
    repair: options.RepairFlag = False
    fail_on: Literal["never", "unexplained", "effects"] = switch(
        "Verdicts that end with exit status 1, for scripts: none, unexplained alone, or both.", "never"
    )

    def run(self) -> None:
        """Do what the command line says."""
        jobs = self._jobs()
        gravity, measured = self.local.value(), self._measured()
        self.results.prepare(*(options.INERTIAL if jobs is None else ()))
        if jobs is not None:
            return self._attribute(jobs, gravity)
        recordings, known = self.log.read_unit(self.logs, gravity, self.noise)
        other = None if self.heldout is None else self.log.read(self.heldout, gravity)
        from jaximu.diagnosis import diagnose, diagnose_against_attitude, diagnose_thermal, diagnose_turntable

        held: Any = other
        if self.thermal:
            work = partial(diagnose_thermal, recordings)
        elif self.reference is None:
            work = partial(diagnose, recordings, gravity, segmentation=self.poses.value(), repair=self.repair)
        elif measured:
            from jaximu.cli.reference import read_reference

            work = partial(
                diagnose_against_attitude,
                recordings[0],
                read_reference(self.reference, self.logs[0], recordings[0]),
                gravity,
                repair=self.repair,
            )
        else:
            from jaximu.cli.turntable import references_of

            (entries,) = references_of(recordings, [self.reference])
            work = partial(diagnose_turntable, recordings[0], entries, gravity, repair=self.repair)
            if other is not None and self.heldout_reference is not None:
                others = [other]  # whose reference columns are put beside its signals
                (schedule,) = references_of(others, [self.heldout_reference])
                held = others[0], schedule
        with progress("diagnosing"):
            diagnosis = work(static=known, **({} if held is None else {"heldout": held}))
        if not self.thermal and any(effect.rivals or effect.weak for effect in diagnosis.named):
            from jaximu.planning.separation import advised

            with progress("looking for a recording that would separate the causes"):
                diagnosis = advised(diagnosis)
        give_diagnosis(diagnosis, self.results)
        self._end(diagnosis.verdict)

    def _measured(self) -> bool:
        """Whether the reference is a measured attitude. Raises `InputError` where options contradict each other."""
        if self.reference is None:
            if self.heldout_reference is not None:
                raise InputError("--heldout-reference goes with --reference.")
            return False
        if self.thermal:
            raise InputError("--thermal is for recordings at rest, --reference for poses and turns: give one of them.")
        if len(self.logs) != 1:
            raise InputError(f"--reference goes with one LOG, found {len(self.logs)}.")
        options.require_files(self.reference)
        from jaximu.recordings.readers import holds_attitude

        measured = holds_attitude(self.reference)
        if measured and (self.heldout is not None or self.heldout_reference is not None):
            raise InputError("with a measured attitude the gain is measured on parts of LOG left out: omit --heldout.")
        if (self.heldout is None) != (self.heldout_reference is None):
            raise InputError("with --reference, --heldout LOG and --heldout-reference REF go together.")
        return measured

    def _jobs(self) -> list[Job] | None:
        """Return recordings of several units and sessions: those that a table lists, or LOGS with --by; else None."""
        options.require_files(*self.logs)
        from jaximu.fleets import Job, listed_jobs

        listed = listed_jobs(self.logs[0]) if len(self.logs) == 1 else None
        if listed is None and self.by is None:
            return None
        others = {"--thermal": self.thermal, "--reference": self.reference, "--heldout": self.heldout}
        if stated := [name for name, value in others.items() if value]:
            raise InputError(f"recordings of several units are compared with each other: leave {stated[0]} out.")
        jobs = [Job("", str(path)) for path in self.logs] if listed is None else listed
        from jaximu.diagnosis.attribution import places_of, require_apart

        files = [job.file for job in jobs]
        if self.by is not None:
            places = places_of(files, self.by)
        elif lacking := [job.file for job in jobs if not (job.unit or job.device) or not job.session]:
            raise InputError(f"{self.logs[0]}: {lacking[0]} has no session: fill the column, or state --by PATTERN.")
        else:
            places = require_apart(files, [(job.unit or job.device, job.session) for job in jobs])
        return [replace(job, unit=unit, session=session) for job, (unit, session) in zip(jobs, places, strict=True)]

    def _attribute(self, jobs: list[Job], gravity: jaximu.LocalGravity) -> None:
        """Tell what belongs to a unit, to a session or to all."""
        from jaximu.diagnosis import attribute
        from jaximu.fleets.rows import noise_at_rest

        logs = [self.log.restated(job.options) for job in jobs]
        if len(jobs) == len(self.logs):
            recordings, known = self.log.read_unit(self.logs, gravity, self.noise)
        else:
            with progress("reading"):
                recordings = [log.read(Path(job.file), gravity) for log, job in zip(logs, jobs, strict=True)]
                known = self.noise.value(self.log, gravity)
        statics = [
            noise_at_rest(job.static, replace(log, gyro_log=None).reading(gravity)) if job.static else known
            for log, job in zip(logs, jobs, strict=True)
        ]
        with progress("diagnosing", every=0.0) as report:
            attribution = attribute(
                recordings,
                gravity=gravity,
                places=[(job.unit, job.session) for job in jobs],
                statics=statics,
                report=report,
                segmentation=self.poses.value(),
                repair=self.repair,
            )
        self.results.present(attribution.summary, "diagnosis.json and report.html", diagnosis=attribution)
        self._end(attribution.verdict)

    def _end(self, verdict: str) -> None:
        """End with exit status 1 where a verdict is one that a script is to fail on."""
        if self.fail_on != "never" and verdict in ("unexplained", self.fail_on):
            raise SystemExit(1)


def give_diagnosis(diagnosis: Diagnosis, results: options.Results) -> None:
    """Print a diagnosis; write it, the extended calibration and the report where asked."""
    documents = {"calibration": diagnosis.extended_calibration()} if results.keeps else {}
    names = "diagnosis.json, calibration.json and report.html"
    results.present(diagnosis.summary, names, {}, diagnosis.text, diagnosis=diagnosis, **documents)
