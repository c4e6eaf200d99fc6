"""`jaximu accept`: pass, fail or undecided, with guard bands; a certificate; how a line moves."""

from __future__ import annotations

import inspect
import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

import jaximu
from jaximu.cli import options
from jaximu.cli.messages import progress, say
from jaximu.cli.options import option, switch, takes_options
from jaximu.ground.document import Json
from jaximu.ground.errors import InputError

if TYPE_CHECKING:
    from jaximu.acceptance import Acceptance, Limits, Line


_STATUS = {"pass": 0, "fail": 3, "undecided": 4}


@takes_options
class AcceptCommand:
    """Hold calibrations to limits: pass, fail or undecided, with guard bands from the stated uncertainty; certificate.

    DIR receives acceptance.json and, if nothing that it needs is missing, certificate.html; of a fleet's table
    acceptance.json, report.html with control charts, capability and gauge study, and the table with a verdict in every
    row. The exit status is 0 for pass, 3 for fail, 4 for undecided.

    Examples:
      jaximu accept results/calibration.json --limits limits.toml
      jaximu accept results/calibration.json --limits limits.toml --diagnosis results/diagnosis.json
      jaximu accept results/calibration.json --limits limits.toml --trace trace.toml -o accepted
      jaximu accept fleet.parquet --limits limits.toml --golden UNIT7 -o line
      jaximu accept results/calibration.json --limits limits.toml --measurements junit.xml

    """

    calibrations: tuple[Path, ...] = option(
        "CALIBRATION...", "calibration.json, or a fleet's TABLE.parquet.", (), Positional
    )
    limits: Path | None = option("LIMITS.toml", "Limits; or TABLE.parquet of a fleet, whose population sets them.")
    noise: Path | None = option("ALLAN.json", "From jaximu allan, for limits of noise and repeatability.")
    diagnosis: Path | None = option(*options.DIAGNOSIS)
    trace: Path | None = option("TRACE.toml", "Serial number, operator, references …, beside what a calibration says.")
    rule: Literal["guarded", "simple"] | None = switch("Decision rule, instead of that of LIMITS.", None)
    risk: float | None = option("NUMBER", "Probability of a wrong decision at most, instead of that of LIMITS (0.05).")
    fail_on: Literal["undecided", "fail", "never"] = switch(
        "Which verdicts end with another exit status than 0: both, fail alone, or none.", "undecided"
    )
    golden: str = option("DEVICE", "Of a table: the unit recorded again and again to watch the line.", "")
    measurements: Path | None = option(
        "FILE", "Also write each limit with value and verdict for a test system: .csv, .xml (JUnit), .json (OpenHTF)."
    )
    without_certificate: bool = switch("Write the verdict alone to DIR.")
    explain: bool = switch("Explain LIMITS.toml and TRACE.toml, and do nothing else.")
    results: options.Results = options.RESULTS

    def run(self) -> None:
        """Do what the command line says."""
        if self.explain:
            from jaximu.acceptance import limits
            from jaximu.recordings import trace

            print(inspect.getdoc(limits), inspect.getdoc(trace), sep="\n\n")
            return
        if not self.calibrations:
            raise InputError(
                "name a calibration.json, or a table of jaximu fleet, and its limits: --limits LIMITS.toml."
            )
        options.require_files(*self.calibrations, self.limits, self.noise, self.diagnosis, self.trace)
        if self.measurements is not None:
            from jaximu.acceptance.interchange import check_measurements

            if self.limits is None:
                raise InputError("--measurements lists what was held to limits: --limits LIMITS.toml.")
            check_measurements(self.measurements)
        tables = [path for path in self.calibrations if path.suffix.lower() == ".parquet"]
        if tables and len(self.calibrations) > 1:
            raise InputError(f"{tables[0]} is a fleet's table: give one table alone, or calibrations.")
        verdict = self._line(tables[0]) if tables else self._units()
        ends = {"undecided": ("fail", "undecided"), "fail": ("fail",), "never": ()}[self.fail_on]
        if verdict in ends:
            raise SystemExit(_STATUS[verdict])

    def _units(self) -> str:
        """Hold single units to limits; return the worst verdict."""
        if self.limits is None:
            raise InputError("name the limits: --limits LIMITS.toml; --explain shows such a file.")
        if self.golden:
            raise InputError("--golden names a device of a fleet's table; these are calibrations.")
        limits = limits_of(self.limits, self.rule, self.risk)
        from jaximu.acceptance.decision import worst
        from jaximu.noise.analysis import read_analysis

        known = None if self.noise is None else read_analysis(self.noise)
        loaded = [_loaded(path, self.trace) for path in self.calibrations]
        _refuse_doubled(loaded, self.calibrations)
        self.results.prepare()
        acceptances: list[Acceptance] = []
        with progress("deciding"):
            for calibration, path in zip(loaded, self.calibrations, strict=True):
                wider, hidden = options.allowing_for(calibration, self.diagnosis)
                acceptance = jaximu.accept(wider, limits, known, path)
                acceptances.append(replace(acceptance, notes=(*acceptance.notes, *hidden)))
        certificate = not self.without_certificate
        if self.results.output is not None and certificate:
            acceptances = [_with_what_is_missing(acceptance) for acceptance in acceptances]
        verdict = worst([acceptance.verdict for acceptance in acceptances])
        self.results.give(
            lambda: _show(*acceptances),
            partial(_write, acceptances, loaded if certificate else ()),
            "acceptance.json and certificate.html",
            {
                f"{stem}acceptance.json": (acceptance.text() + "\n").encode()
                for stem, acceptance in _stems(acceptances).items()
            },
            acceptances[0].text
            if len(acceptances) == 1
            else partial(json.dumps, _together(acceptances, verdict), indent=1),
        )
        self._measurements(acceptances)
        return verdict

    def _line(self, path: Path) -> str:
        """Follow the line that a fleet's table is of; return its verdict."""
        for name, value in (("--noise", self.noise), ("--diagnosis", self.diagnosis), ("--trace", self.trace)):
            if value is not None:
                raise InputError(f"{name} belongs to single calibrations, not to a fleet's table.")
        limits, output = self.limits and limits_of(self.limits, self.rule, self.risk), self.results.output
        from jaximu.acceptance.line import follow, read_table

        if output is not None and (output / path.name).resolve() == path.resolve():
            raise InputError(f"-o {output}: the table {path.name} lies there; name another folder.")
        self.results.prepare()
        with progress("following the line"):
            line = follow(read_table(path), limits, self.golden)
        self.results.give(
            lambda: _show(line),
            lambda folder: write_line(line, folder / "report.html", folder / path.name),
            "acceptance.json, report.html and the table with verdicts",
            acceptance=line,
        )
        self._measurements(line)
        return "pass" if limits is None else line.verdict

    def _measurements(self, judged: Sequence[Acceptance] | Line) -> None:
        if self.measurements is not None:
            from jaximu.acceptance.interchange import write_measurements

            write_measurements(judged, self.measurements)
            say(f"Written: {self.measurements}")


def limits_of(path: Path, rule: str | None, risk: float | None) -> Limits:
    """Read limits from a file of limits or from a fleet's table."""
    if path.suffix.lower() == ".parquet":
        from jaximu.acceptance.decision import Rule
        from jaximu.acceptance.line import population_limits

        return population_limits(path, Rule(rule or "guarded", 0.05 if risk is None else risk))
    from jaximu.acceptance import read_limits

    return read_limits(path, rule, risk)


# --- single units -----------------------------------------------------------------------------------------------------


def _loaded(path: Path, trace: Path | None) -> jaximu.Calibration:
    """Load a calibration that nobody has changed, with what a file says of it beside its own trace."""
    from jaximu.acceptance.verify import CHANGED, state_of
    from jaximu.recordings.trace import read_trace

    calibration = jaximu.load_calibration(path)
    if state_of(path) == CHANGED:
        raise InputError(
            f"{path} was changed after it was written: its content does not have the hash that it states. Take the "
            "original, or calibrate again."
        )
    if trace is not None:
        calibration = replace(calibration, trace={**(calibration.trace or {}), **read_trace(trace)})
    return calibration


def _refuse_doubled(calibrations: Sequence[jaximu.Calibration], paths: Sequence[Path]) -> None:
    earlier: dict[str, Path] = {}
    for calibration, path in zip(calibrations, paths, strict=True):
        serial = (calibration.trace or {}).get("serial", "")
        if serial and serial in earlier:
            raise InputError(f"{earlier[serial]} and {path} have the same serial number, {serial}: each unit once.")
        earlier[serial] = path


def _together(acceptances: Sequence[Acceptance], verdict: str) -> Json:
    """Return one document of several units, whose items say which unit they are of."""
    documents = [acceptance.document() for acceptance in acceptances]
    items = [
        item | {"serial": document["serial"], "file": document["calibration"]["file"]}
        for document in documents
        for item in document["items"]
    ]
    units = [{key: document[key] for key in ("verdict", "serial", "calibration")} for document in documents]
    shared = {key: documents[0][key] for key in ("schema", "limits", "decision", "software")}
    return {**shared, "verdict": verdict, "units": units, "items": items}


def _with_what_is_missing(acceptance: Acceptance) -> Acceptance:
    """Return a verdict with a note of what a certificate of it lacks."""
    from jaximu.recordings.trace import missing

    lacking = missing(acceptance.trace)
    if not lacking:
        return acceptance
    text = (
        f"no certificate without {', '.join(lacking)}: write them into a file and name it (--trace TRACE.toml, shown "
        "by `jaximu accept --explain`), or leave the certificate out (--without-certificate)."
    )
    return replace(acceptance, notes=(*acceptance.notes, text))


def _stems(acceptances: Sequence[Acceptance]) -> dict[str, Acceptance]:
    """Return units by what their files' names begin with."""
    if len(acceptances) == 1:
        return {"": acceptances[0]}
    serials = [
        "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in acceptance.serial)
        for acceptance in acceptances
    ]
    return {
        f"{serial or number}-": acceptance
        for number, (serial, acceptance) in enumerate(zip(serials, acceptances, strict=True), 1)
    }


def _write(acceptances: Sequence[Acceptance], loaded: Sequence[jaximu.Calibration], output: Path) -> tuple[Path, ...]:
    """Write the certificates of units of which nothing is missing; none where no calibrations are given."""
    from jaximu.ground.atomic import write_files
    from jaximu.recordings.trace import missing
    from jaximu.report.certificate import certificate_of
    from jaximu.report.html import encoded

    return write_files(
        {
            output / f"{stem}certificate.html": encoded(certificate_of(acceptance, calibration))[0]
            for (stem, acceptance), calibration in zip(_stems(acceptances).items(), loaded, strict=False)
            if not missing(acceptance.trace)
        }
    )


def _show(*results: Acceptance | Line) -> None:
    from jaximu.report.terminal import show

    for result in results:
        show(result.summary())


# --- a fleet's table --------------------------------------------------------------------------------------------------


def write_line(line: Line, page: Path, table: Path) -> tuple[Path, ...]:
    """Write, where there are limits, the table with a verdict in every row, and the page; return their paths.

    Raises `InputError` where one cannot be written.
    """
    from jaximu.acceptance.line import write_verdicts
    from jaximu.ground.atomic import write_files
    from jaximu.report.html import encoded

    tables = () if line.limits is None else (table,)
    for path in tables:
        write_verdicts(line, path)
    return *tables, *write_files({page: encoded(line.summary())[0]})
