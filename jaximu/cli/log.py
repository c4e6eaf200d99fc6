"""`jaximu LOG`: all that logs allow, in one report."""

from __future__ import annotations

import json
import re
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

from jaximu.cli import options
from jaximu.cli.info import Use, describe, in_other_units, read_openly
from jaximu.cli.messages import progress, say
from jaximu.cli.options import switch, takes_options
from jaximu.cli.usage import command_of
from jaximu.ground.document import Json
from jaximu.ground.errors import InputError, JaximuError, NotPossibleError
from jaximu.ground.quantities import sentence
from jaximu.ground.reexport import later

if TYPE_CHECKING:
    from jaximu.ground.document import Document
    from jaximu.ground.page import Page
    from jaximu.recordings.columns.guess import Advice, OpenPoint


_ORDER = ("calibrate", "diagnose", "turntable", "reference", "filter", "magnetometer", "allan", "thermal")
"""Verbs that need no more than logs."""
_HELD = {"calibrate": ("diagnose", "calibration")}
"""A verb whose result another holds, as which document: it is run alone where that one gives none."""
_UNFILLED = re.compile(r"\b(NEW_)?LOG\b|\bCALIBRATION\b")
_COMMAND = re.compile(r"`(jaximu [^`]+)`")
_RECORD = (
    "For a calibration, record rests of two seconds or more in nine orientations or more, with turns between them; "
    "for its noise, the unit at rest for an hour or more."
)


@takes_options
class LogCommand(options.Fits):
    """Run all that LOGs allow, in one report: calibration, diagnosis, noise, temperature and more.

    LOGs are files, a phone's folder or its ZIP archive: recordings of one unit. One of them at rest states the noise
    for the others, and one of an attitude is their reference. DIR receives report.html, pictures, and the documents
    that each verb writes (calibration.json, diagnosis.json, allan.json …).

    Examples:
      jaximu log.csv
      jaximu phone.zip -o results
      jaximu poses.csv rest.csv --yes --latitude 48.1 -o results

    """

    logs: options.Logs
    yes: bool = switch("Ask nothing: take the default for what the logs leave open, and say so.")

    def run(self) -> None:
        """Do what the command line says."""
        if not self.logs:
            raise InputError("no log was given: name one or more files.")
        options.require_files(*self.logs, self.log.gyro_log, self.noise.static, self.noise.noise)
        self.local.value()  # a mistake in it is said before any work
        self.results.prepare()
        asker = _Asker(self.yes)
        from jaximu.recordings.readers.reader import tables_kept

        with tables_kept():
            contents, references = _contents_of(self.logs, self.log, asker)
            outcomes, refused = _run_all(_commands(contents, references, self.local, self.noise))
        if not outcomes:
            raise NotPossibleError(f"{_names(self.logs)}: {' '.join(_reasons(contents, refused))} {_RECORD}")
        _Report(self, contents, outcomes, refused, asker.assumed).give()


# --- what is in the logs


@dataclass(frozen=True)
class _Content:
    """A log, the options with which every verb reads it, what `jaximu info` says of it, and its uses."""

    path: Path
    log: options.LogOptions
    document: Json
    uses: Sequence[Use]

    def allows(self, verb: str) -> bool:
        return any(use.verb == verb and use.alone for use in self.uses)


class _Asker:
    """Asks a person at most one question, and takes the default where there is no person, or after that one.

    assumed: what was taken, as sentences.
    """

    def __init__(self, yes: bool):
        self.silent = yes or not (sys.stdin.isatty() and sys.stderr.isatty())
        self.answers: dict[str, str] = {}
        self.assumed: list[str] = []

    def answer(self, option: str, question: str, default: str) -> str:
        """Return what a person answers, or the default; the same question of another log has the same answer."""
        if question in self.answers:
            return self.answers[question]
        answer = default
        if not self.silent:
            self.silent = True
            print(f"{question} [{default}] ", end="", file=sys.stderr, flush=True)
            answer = sys.stdin.readline().strip() or default
        else:
            say(f"{question} Assumed: {default}; state it with --{option}.")
            self.assumed.append(f"{question} Assumed: {default}; `--{option}` states another.")
        self.answers[question] = answer
        return answer


def _contents_of(logs: Sequence[Path], log: options.LogOptions, asker: _Asker) -> tuple[list[_Content], list[Path]]:
    """Return what is in the logs of sensors, and which of them hold a reference's attitude alone.

    Two files that are named after an accelerometer and a gyroscope are one log.
    """
    from jaximu.recordings.readers.archive import by_sensor

    contents: list[_Content] = []
    references: list[Path] = []
    if log.gyro_log is None and len(logs) == 2 and {"accel", "gyro"} == set(pair := by_sensor(map(str, logs))):
        logs, log = [Path(pair["accel"])], replace(log, gyro_log=Path(pair["gyro"]))
    for path in logs:
        try:
            contents.append(_content(path, log.with_gyroscope(path) if len(logs) == 1 else log, asker))
        except InputError as error:
            if path.is_dir():
                raise NotPossibleError(str(error.args[0])) from None
            if (alone := _without_inertial(path, log)) is not None:
                contents.append(alone)
            elif _holds_attitude(path):
                references.append(path)
            else:
                raise
    if not contents:
        raise InputError(
            f"{_names(references)}: holds an attitude and no sensor. Give it together with the log of the same motion."
        )
    return contents, references


def _content(path: Path, log: options.LogOptions, asker: _Asker) -> _Content:
    log, advice = _settled(path, log, asker)
    with progress("looking for what it allows"):
        recording, _, notes = read_openly(log, path)
        return _Content(path, log, *describe(recording, advice, notes))


def _settled(path: Path, log: options.LogOptions, asker: _Asker) -> tuple[options.LogOptions, Advice | None]:
    """Return the options with which every verb reads a log, and how columns that it does not name were understood."""
    try:
        with progress("reading"):
            log.read(path, check=False, alone=True)
    except JaximuError:
        advice, values = _advised(path, log)
        for question in _open_points(values, advice.questions if advice else ()):
            option, default = question.option, question.default or ""
            if option == "gyro_scale":
                default = _scale_by_turning(path, replace(log, **_numbers(values) | {option: default}), default)
            answer = asker.answer(option.replace("_", "-"), question.text, default)
            values[option] = values[option].replace(question.blank, question.blank.replace("?", answer))
        if any("?" in str(value) for value in values.values()):
            read_openly(log, path)  # which says what is open
        settled = replace(log, **_numbers(values))
        if settled == log:
            raise
        stated = {name: value and str(value) for name, value in values.items() if name != "gyro_columns"}
        return settled, advice and replace(advice, **stated)
    if contradicted := in_other_units(log, path):
        settled, advice, note = contradicted
        asker.assumed.append(note)
        return settled, advice
    return log, None


def _advised(path: Path, log: options.LogOptions) -> tuple[Advice | None, Json]:
    """Return how the columns of a log can be understood, and the options that say it; a "?" is left open."""
    from jaximu.recordings.readers import advise_reading

    values: Json = {name: getattr(log, name) for name in _READ_AS}
    if log.columns is not None:
        blanks = {"rate": "time" not in log.columns, "gyro_scale": "gyro [count]" in log.columns}
        return None, values | {name: "?" for name, blank in blanks.items() if blank and values[name] is None}
    advice = advise_reading(path, log.rate, log.device)
    guesses = [(advice, "columns")]
    if log.gyro_log is not None and log.gyro_columns is None:
        guesses.append((advise_reading(log.gyro_log, log.rate), "gyro_columns"))
    for guess, columns in guesses:
        for name in ("columns", "rate", "accel_scale", "gyro_scale") if guess else ():
            option = columns if name == "columns" else name
            values[option] = values[option] or getattr(guess, name)
    return advice, values


def _numbers(values: Mapping[str, Any]) -> Json:
    """Return options with the rate as a number, where it is known."""
    rate = values["rate"]
    try:
        return {**values, "rate": None if rate in (None, "?") else float(rate)}
    except ValueError:
        raise InputError(f"--rate: {rate!r} is not a number.") from None


def _scale_by_turning(path: Path, log: options.LogOptions, default: str) -> str:
    """Return the gyroscope's scale with which its turns are those of gravity, where that shows; else the default."""
    from jaximu.recordings.alignment import CORRELATED

    try:
        turning = log.read(path, check=False, alone=True).turning
    except JaximuError:
        return default
    if turning is None or abs(turning.correlation) < CORRELATED:
        return default
    number, _, unit = default.partition(" ")
    return f"{float(number) / abs(turning.slope):.3g} {unit}"


_READ_AS = "columns", "gyro_columns", "rate", "accel_scale", "gyro_scale"


def _open_points(values: Mapping[str, Any], questions: Sequence[OpenPoint]) -> Iterator[OpenPoint]:
    """Yield what reading leaves open and can be assumed, first what changes the answer most."""
    from jaximu.recordings.columns.guess import left_open

    by_blank = {(question.option, question.blank): question for question in questions}
    for unasked in left_open(values["columns"] or ""):
        question = by_blank.get((unasked.option, unasked.blank), unasked)
        if question.default and question.blank in str(values[question.option]):
            yield question


def _without_inertial(path: Path, log: options.LogOptions) -> _Content | None:
    """Return the content of a log of a magnetometer alone; None for any other."""
    from jaximu.recordings.readers import advise_reading, read_magnetometer
    from jaximu.report.recording import signal_facts

    try:
        if log.columns is None and (advice := advise_reading(path, device=log.device)):
            log = replace(log, columns=advice.magnetometer)
        signal, _, _ = read_magnetometer(path, log.reading())
    except JaximuError:
        return None
    document = {"file": str(path), "signals": {"magnetometer": signal_facts(signal)}, "findings": []}
    use = Use("magnetometer", "soft and hard iron, where the unit is turned all round")
    return _Content(path, log, document | {"uses": [{"verb": use.verb, "why": use.why}]}, [use])


def _holds_attitude(path: Path) -> bool:
    from jaximu.recordings.readers import holds_attitude

    try:
        return holds_attitude(path)
    except JaximuError:
        return False


# --- what they allow


@dataclass(frozen=True)
class _Outcome:
    """What a verb gave: its page, files and documents, and the document that it prints."""

    page: Callable[[], Page]
    text: Callable[[], str]
    files: Mapping[str, bytes] = field(default_factory=dict)
    documents: Mapping[str, Document] = field(default_factory=dict)


@dataclass(frozen=True)
class _Collected(options.Results):
    """Takes what a verb gives, in place of the terminal and the folder."""

    outcomes: list[_Outcome] = field(default_factory=list)
    keeps: ClassVar[bool] = True

    def present(
        self,
        page: Callable[[], Page],
        names: str = "",
        files: Mapping[str, bytes] = MappingProxyType({}),
        text: Callable[[], str] | None = None,
        **documents: Document,
    ) -> None:
        """Keep the result."""
        self.outcomes.append(_Outcome(cache(page), text or next(iter(documents.values())).text, files, documents))


def _commands(
    contents: Sequence[_Content], references: Sequence[Path], local: options.GravityOptions, noise: options.NoiseOptions
) -> Json:
    """Return what the logs allow, ready to run: each verb with all the logs that allow it and are read alike."""
    by_hand = [content for content in contents if content.allows("diagnose")]
    rests = [content.path for content in contents if content not in by_hand and content.allows("allan")]
    if by_hand and rests and noise == options.NOISE:
        say(f"{rests[0]} is at rest: it states the noise of the others.")
        noise = replace(noise, static=rests[0])
    commands = {}
    for verb in _ORDER:
        logs = [content for content in contents if content.allows(verb)]
        stated: Json = {"local": local, "noise": noise}
        if verb == "reference" and references and not logs:
            logs = [content for content in contents if "gyroscope" in content.document["signals"]]
            stated["reference"] = references[0]
        if logs:
            command, stated["log"] = command_of(verb), logs[0].log
            accepted = {part.name for part in fields(command)}
            paths = tuple(content.path for content in logs if content.log == logs[0].log)
            stated = {name: value for name, value in stated.items() if name in accepted}
            commands[verb] = command(paths if "logs" in accepted else paths[0], results=_Collected(), **stated)
    return commands


def _run_all(commands: Mapping[str, Any]) -> tuple[dict[str, _Outcome], dict[str, str]]:
    """Run verbs by their functions; return what they gave, and why others gave nothing, by verb."""
    outcomes: dict[str, _Outcome] = {}
    refused: dict[str, str] = {}
    for verb in sorted(commands, key=lambda verb: verb in _HELD):
        holder, name = _HELD.get(verb, ("", ""))
        if holder in outcomes:
            document: Any = outcomes[holder].documents[name]
            outcomes[verb] = _Outcome(cache(document.summary), document.text)
            continue
        try:
            commands[verb].run()
            (outcomes[verb],) = commands[verb].results.outcomes
        except JaximuError as error:
            refused[verb] = str(error)
    return _ordered(outcomes), _ordered(refused)


def _ordered(by_verb: Mapping[str, Any]) -> Json:
    return {verb: by_verb[verb] for verb in _ORDER if verb in by_verb}


def _reasons(contents: Sequence[_Content], refused: Mapping[str, str]) -> list[str]:
    """Say why nothing could be run."""
    if refused:
        return [sentence(f"{verb}: {text}") for verb, text in refused.items()]
    documents = [content.document for content in contents]
    poses = [text for document in documents for text in document.get("refused", ())]
    poses = poses or [text for document in documents for text in document["findings"] if " pose" in text]
    return ["Nothing can be determined from it as it is.", *(f"{sentence(text).rstrip('.')}." for text in poses)]


def _names(paths: Sequence[Path]) -> str:
    return ", ".join(map(str, paths))


# --- one report


@dataclass(frozen=True)
class _Report:
    """All results in one page, one document, and one folder."""

    command: LogCommand
    contents: Sequence[_Content]
    outcomes: Mapping[str, _Outcome]
    refused: Mapping[str, str]
    assumed: Sequence[str]

    @property
    def lead(self) -> str:
        """The verb whose verdict counts."""
        return next(verb for verb in (*(holder for holder, _ in _HELD.values()), *_ORDER) if verb in self.outcomes)

    def give(self) -> None:
        """Write the documents and the report, then print the page, or all as one document."""
        files: dict[str, bytes] = {}
        documents: dict[str, Document] = {}
        for verb, outcome in self.outcomes.items():
            files |= {name if name not in files else f"{verb}_{name}": data for name, data in outcome.files.items()}
            for name, document in outcome.documents.items():
                documents[name if name not in documents else f"{verb}_{name}"] = document
        after = self._next({*documents, *(name.removesuffix(".json") for name in files)})
        self.command.results.give(
            lambda: later("report.terminal", "show")(self._page(after, whole=False)),
            lambda folder: later("report.html", "write_report")(self._page(after, whole=True), folder),
            "the report and the documents of each verb",
            files,
            lambda: json.dumps(self._document(after), indent=1, allow_nan=False),
            **documents,
        )

    def _page(self, after: str, whole: bool) -> Page:
        return later("report.log", "page_of")(
            ", ".join(path.name or str(path) for path in self.command.logs),
            {verb: outcome.page() for verb, outcome in self.outcomes.items()},
            self.lead,
            [content.document for content in self.contents],
            self.refused,
            self.assumed,
            f"`{after}`",
            whole,
        )

    def _document(self, after: str) -> Json:
        printed = {verb: json.loads(outcome.text()) for verb, outcome in self.outcomes.items()}
        verdict = printed[self.lead].get("verdict") or " ".join(self.outcomes[self.lead].page().verdict[:1])
        return {
            "schema": "jaximu.log/1",
            "verbs": [*self.outcomes],
            "verdict": verdict,
            "next": after,
            "assumed": [*self.assumed],
            "refused": dict(self.refused),
            "logs": [content.document for content in self.contents],
            **printed,
        }

    def _next(self, names: set[str]) -> str:
        """Return the next command, with the names of files that there are."""
        command = self.command
        folder = command.results.output
        if folder is None:
            stated = "".join(map(options.typed, (command.log, command.local, command.noise)))
            return f"jaximu {shlex.join(map(str, command.logs))}{stated} -o results"
        proposed = _COMMAND.search(command.results.filled(self.outcomes[self.lead].page().next, names))
        if proposed and not _UNFILLED.search(proposed[1]):
            return proposed[1]
        if "calibration" in names:
            paths = shlex.join([str(folder / "calibration.json"), str(self.contents[0].path)])
            return f"jaximu compensate {paths} -o corrected.csv"
        noise = shlex.quote(str(folder / "allan.json"))
        return f"jaximu calibrate POSES.csv --noise {noise} -o {shlex.quote(str(folder))}"
