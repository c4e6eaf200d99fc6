"""`jaximu info`: what a log holds and what it can be used for."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from jaximu.cli import options
from jaximu.cli.messages import progress
from jaximu.cli.options import takes_options
from jaximu.ground.document import Json
from jaximu.ground.errors import InputError, JaximuError, NotPossibleError
from jaximu.ground.gravity import STANDARD
from jaximu.ground.quantities import Z95, listed, sentence, with_interval

if TYPE_CHECKING:
    from jaximu.ground.array_types import BoolArray, FloatArray
    from jaximu.recordings.columns.guess import Advice
    from jaximu.recordings.recording import Recording


_STILL = {"accelerometer": (0.2, "m/s²"), "gyroscope": (0.03, "rad/s")}
"""Rms about its mean below which a second counts as still, and the unit."""
_PARTS = 8  # of a rest, by which the interval of its mean is told
_BIAS = 0.5  # rad/s: largest bias of a gyroscope that is taken for rest
_MIDDLE = 0.1  # m/s²: how far that mean may lie from the second before
_BUMPS = 0.002  # share of the seconds that may move where noise is to be identified
_CUT = 600.0  # s at rest that are worth cutting out of a log
_TABLE, _NEAR_GRAVITY = 200, 0.15
"""Rows, and how far off gravity each of them may be, up to which a file without time may be a table of pose means."""
_TILTED = 25.0  # degrees from their mean that poses must lie at least to be several orientations
_STATIONS = 6  # poses from which on a turntable fit tells all of an accelerometer


@dataclass(frozen=True)
class Use:
    """A verb that a log allows.

    why: what it gives. before, after: what its command line has before and after the log. alone: whether the log, as
    it is, is all that it needs.
    """

    verb: str
    why: str
    after: str = " -o results"
    before: str = ""
    alone: bool = True

    def line(self, path: Path, stated: str) -> str:
        """Return the command line; `stated`: the options with which the log is read."""
        return f"jaximu {self.verb}{self.before} {shlex.quote(str(path))}{stated}{self.after}"


@takes_options
class InfoCommand:
    """Show what is in a log: sensors, units, rate, rests, what it can be used for, and which command to run next.

    Examples:
      jaximu info log.csv
      jaximu info flight.ulg
      jaximu info raw.txt --columns "time [ms],accel [mg],gyro [mdps]"

    """

    logs: options.Logs
    log: options.LogOptions = options.READING
    as_json: options.JsonFlag = False

    def run(self) -> None:
        """Do what the command line says."""
        stated = [self.log.with_gyroscope(path) for path in self.logs]
        options.require_files(*self.logs)
        with progress("looking at what is in it"):
            described = [describe(*read_openly(*pair)) for pair in zip(stated, self.logs, strict=True)]
        for path, (document, _) in zip(self.logs, described, strict=True):
            document["findings"] += [] if "accelerometer" in document["signals"] else _of_the_other(path)
        if self.as_json:
            documents = [document for document, _ in described]
            options.print_json(documents[0] if len(documents) == 1 else documents)
            return
        from jaximu.report.recording import log_page
        from jaximu.report.terminal import show

        for path, (document, uses), reading in zip(self.logs, described, stated, strict=True):
            guess = f" {document['guess']['line']}" if "guess" in document else ""
            guessed = {name: None for name in ("accel_scale", "gyro_scale") if f"--{name.replace('_', '-')} " in guess}
            line = guess + options.typed(replace(reading, **guessed))
            show(log_page(document, [use.line(path, line) for use in uses]))


def read_openly(log: options.LogOptions, path: Path) -> tuple[Recording, Advice | None, list[str]]:
    """The recording, how its columns were understood where the file does not say it, and what other verbs would ask."""
    from jaximu.recordings.columns.guess import ASSUMED_RATE

    options.require_files(path)
    try:
        recording = log.read(path, check=False, alone=True)
        if contradicted := in_other_units(log, path):
            other, advice, note = contradicted
            return other.read(path, check=False, alone=True), advice, [note]
        return recording, None, []
    except JaximuError:
        from jaximu.recordings.readers import advise_reading

        advice = advise_reading(path, log.rate, log.device) if log.columns is None and log.gyro_log is None else None
        if advice is not None and not advice.readable:
            raise InputError(f"{path}: {advice.sentence()}{_shown(advice)}") from None
        columns = log.columns or (advice.columns if advice else None)
        scales = {
            name: getattr(log, name) or (stated if stated and stated != "?" else "1")
            for name in ("accel_scale", "gyro_scale")
            if (stated := getattr(advice, name, None)) or (advice is None and "count]" in (columns or ""))
        }
        recording = None
        for rate in [log.rate] if log.rate or (advice and advice.rate is None) else [None, ASSUMED_RATE]:
            try:
                recording = recording or replace(log, columns=columns, rate=rate, **scales).read(path, check=False)
            except JaximuError:
                continue
        if recording is None or (log.rate is not None and not (advice and advice.line()) and not scales):
            raise
    notes = []
    if log.rate is None and any("stamps from --rate" in note for note in recording.notes):
        notes.append(f"no time column: {ASSUMED_RATE:g} Hz assumed here, state it with --rate HZ")
    if any(scale == "1" for scale in scales.values()):
        notes.append(
            "raw counts: state scales with --accel-scale and --gyro-scale (the accelerometer's is also found "
            "from gravity, given poses all around)"
        )
    return recording, advice, notes


def _of_the_other(path: Path) -> Iterator[str]:
    """Name the accelerometer's file that lies beside a gyroscope's, and the line that reads both."""
    for other in sorted(path.parent.iterdir()):
        if options.LogOptions().with_gyroscope(other).gyro_log == path:
            both = f"{shlex.quote(str(other))} --gyro-log {shlex.quote(str(path))}"
            yield f"its accelerometer's file lies beside it; both are one log: jaximu info {both}"


def in_other_units(log: options.LogOptions, path: Path) -> tuple[options.LogOptions, Advice, str] | None:
    """The options that read a log in the units of its values where these contradict the ones it states, how its columns
    are understood then, and a sentence; None where they do not, or no other units are offered.
    """
    from jaximu.recordings.readers import advise_reading

    if log.columns is not None or log.gyro_log is not None:
        return None
    try:
        log.read(path, alone=True)
    except JaximuError as error:
        advice = advise_reading(path, log.rate, log.device)
        if advice is None or not advice.readable or "?" in advice.line():
            return None
        scales = {name: getattr(advice, name) or getattr(log, name) for name in ("accel_scale", "gyro_scale")}
        other = replace(log, columns=advice.columns, **scales)
        try:
            other.read(path, alone=True)
        except JaximuError:
            return None
        text = str(error).removeprefix(f"{path}: ").partition("Or, after")[0].strip()
        return other, advice, f"{sentence(text)} Read as {advice.line()}."
    return None


def _shown(advice: Advice) -> str:
    """The first rows of the columns that are used, under what they are taken for; as lines of text."""
    if not advice.rows:
        return ""
    widths = [max(map(len, column)) for column in zip(*advice.rows, strict=True)]
    return "".join(
        "\n  " + "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in advice.rows
    )


def describe(
    recording: Recording, advice: Advice | None = None, guessed: list[str] | None = None
) -> tuple[Json, list[Use]]:
    """Return what the log holds, what was noticed, and what it can be used for, as `--json` prints it; and its uses."""
    from jaximu.mistakes import prepare
    from jaximu.report.recording import signal_facts

    def misfit(tried: Recording) -> float:
        from jaximu.calibration.recipe import Choices, carried_error  # only where a repair is to be tried

        return carried_error(tried, Choices())

    ready = prepare(recording, misfit=misfit)
    used, guessed = ready.recording.signals, guessed or []
    signals = {name: signal_facts(signal, used[name]) for name, signal in recording.signals.items()}
    guessing = guessed or advice is not None
    notes = [note for note in recording.remarks if not guessing or "--" not in note]  # options that only this verb gave
    findings = [*guessed, *notes, *ready.notes]
    if "accelerometer" in signals:
        physical = not guessed or recording.accelerometer.unit != "count"
        uses = [*allowed(recording, ready.recording, findings, physical)]
    else:
        findings.append("no accelerometer: poses cannot be found")
        uses = [
            *(_noise_uses(*_at_rest(recording, ready.recording, findings)) if not guessed else ()),
            Use("turntable", "with a schedule of rests and turns (--reference)", _WITH_SCHEDULE, alone=False),
            replace(_COMPENSATE, why="with a calibration of this gyroscope"),
        ]
        advice = None
    document = {"file": recording.name, "signals": signals, "findings": list(dict.fromkeys(findings))}
    if refused := [finding.text for finding in ready.findings if finding.refuses]:
        document["refused"] = refused
        uses = [use for use in uses if use.verb in _WHATEVER]
    document["uses"] = [{"verb": use.verb, "why": use.why} for use in uses]
    if advice is not None:
        document["guess"] = {
            "line": advice.line(),
            "reasons": advice.reasons,
            "questions": [question.text for question in advice.questions],
            "rows": advice.rows,
        }
    return document, uses


_WHATEVER = ("allan", "thermal", "magnetometer", "compensate")
"""Verbs that a sensor which cannot be calibrated does not stop."""
_OLD = " results/calibration.json"
_WITH_SCHEDULE = " --reference REF -o results"
_COMPENSATE = Use("compensate", "to correct it with a calibration of this unit", " -o corrected.csv", _OLD, alone=False)


def allowed(recording: Recording, repaired: Recording, findings: list[str], physical: bool) -> Iterator[Use]:
    """Yield what can be run on a log with an accelerometer, and why; what is noticed is added to `findings`.

    `physical`: the outputs are in physical units, or their scale is known.
    """
    import numpy as np

    from jaximu.ground.vectors import lengths_of
    from jaximu.recordings.recording import plausibility

    signals, poses = recording.signals, 0
    force = lengths_of(recording.accelerometer.si())
    timeless = any("stamps from --rate" in note for note in recording.notes)
    near = bool((np.abs(force / STANDARD.value - 1) < _NEAR_GRAVITY).all())
    means = timeless and physical and len(force) <= _TABLE and near
    try:
        findings += plausibility(recording, STANDARD) if physical else ()
        poses = _poses(repaired, findings)
    except JaximuError as error:
        if not means:
            findings.append(str(error).removeprefix(f"{recording.name}: ").partition(" (intervals")[0])
    at_rest = _at_rest(recording, repaired, findings) if physical else (0.0,) * 4
    if 1 < poses < _STATIONS:
        findings.append(
            f"{poses} poses are too few for a calibration: record nine or more, all around, two seconds or more each"
        )
    if means:
        yield Use("calibrate --means", f"if each of the {len(force)} rows is the mean of a pose at rest", alone=False)
    if poses >= 9:
        yield Use("calibrate", f"{poses} poses" + (" and the turns between them" if "gyroscope" in signals else ""))
        if "gyroscope" in signals:
            yield Use("diagnose", "the same, and what the model gets wrong")
    elif poses >= _STATIONS:
        yield Use("calibrate", f"as far as {poses} poses allow: nine or more, all around, are needed for a whole one")
    table = [name for name in ("table_angle", "table_rate") if getattr(recording, name) is not None]
    if table or (recording.attitude is not None and poses >= _STATIONS):
        yield Use("turntable", f"it holds a reference: {', '.join(table) or 'attitude'}")
    if recording.attitude is not None and "gyroscope" in signals:
        yield Use("reference", "the attitude beside it calibrates both sensors in any motion that turns about all axes")
    if physical and not poses and (stops := _stops(repaired)) > 1:
        why = f"{stops} stops of a vehicle: gyroscope bias, mounting against the horizontal, direction of driving"
        yield Use("filter", why)
    if "magnetometer" in signals:
        yield Use(
            "magnetometer", "soft and hard iron, and how good a heading becomes, where the unit is turned all round"
        )
    yield from _noise_uses(*at_rest)
    heat = recording.temperature
    if heat is not None and (span := np.ptp(heat.values)) >= 5.0:
        yield Use("thermal", f"the temperature spans {span:.0f} K")
    yield _COMPENSATE
    if poses > 1 and "gyroscope" in signals:
        yield Use("check", "whether an older calibration of this unit is still valid", "", " CALIBRATION", alone=False)


def _at_rest(recording: Recording, repaired: Recording, findings: list[str]) -> tuple[float, float, float, float]:
    """Seconds of a recording, those at rest in all and at a stretch, and when that begins; said among `findings`."""
    from jaximu.ground.vectors import lengths_of
    from jaximu.recordings.recording import runs_of
    from jaximu.report.recording import signal_facts

    names = [name for name in _STILL if name in recording.signals]
    begins, still, rates = _still_seconds(repaired)
    length = signal_facts(recording.signals[names[0]], repaired.signals[names[0]])["duration"]
    if not still.any():
        return length, 0.0, 0.0, 0.0
    first, stop = max(runs_of(still), key=lambda run: run[1] - run[0])
    rest, longest = float(still.sum()), float(stop - first)
    limits = [f"{limit:g} {unit}" for limit, unit in map(_STILL.__getitem__, names)]
    findings.append(
        f"still for {rest:.0f} s of {length:.0f} s, {longest:.0f} s at a stretch (seconds with less than "
        f"{' and '.join(limits)} rms)"
    )
    rates = rates[still] if recording.gyroscope is not None and recording.gyroscope.unit != "count" else rates[:0]
    size = lengths_of(rates)
    if len(rates) >= _PARTS and size.min() < _BIAS:  # a table's steady turn looks like a rest: the slowest is one
        near = lengths_of(rates - rates[size.argmin()]) < _STILL["gyroscope"][0]
        findings += [_offset(rates[near])] if near.sum() >= _PARTS else []
    return length, rest, longest, float(begins[first])


def _offset(rates: FloatArray) -> str:
    """Say what the gyroscope reads at rest, from its means (n, 3) over seconds, rad/s.

    Its interval is Student's, of the means over parts of the rest: drift is in it as far as the parts differ by it.
    """
    import numpy as np

    from jaximu.ground.distributions import student_isf

    parts = np.stack([part.mean(axis=0) for part in np.array_split(rates, _PARTS)])
    sigma = parts.std(axis=0, ddof=1) / np.sqrt(_PARTS) * student_isf(0.025, _PARTS - 1) / Z95
    words = [with_interval(*pair, "rad/s") for pair in zip(parts.mean(axis=0), sigma, strict=True)]
    named = listed([f"{axis} {text}" for axis, text in zip("xyz", words, strict=True)])
    return f"at rest the gyroscope reads {named}: its offset, and up to 0.0042 °/s of the Earth's rotation"


def _noise_uses(length: float, rest: float, longest: float, begin: float) -> Iterator[Use]:
    """Yield what a log of `length` seconds, `rest` of them at rest, `longest` at a stretch, shows of the noise."""
    moved = length - rest
    if rest >= 60.0 and moved <= 2.0 + _BUMPS * length:
        apart = f" but for {moved:.0f} s" * (moved > 2.0)
        why = f"at rest for {length:.0f} s{apart}: noise up to some {length / 10:.0f} s of averaging"
        yield Use("allan", why, " -o noise")
    elif longest >= _CUT:
        why = (
            f"once cut to the {longest:.0f} s at rest from {begin:.0f} s on: noise up to some {longest / 10:.0f} s of "
            "averaging"
        )
        yield Use("allan", why, " -o noise", alone=False)


def _poses(recording: Recording, findings: list[str]) -> int:
    """Return how many poses there are, 0 where all are alike; what is noticed is added to `findings`."""
    import numpy as np

    from jaximu.recordings.segmentation import Moments, segment

    intervals = segment(recording).intervals
    poses, still = len(intervals), (intervals[:, 1] - intervals[:, 0]).sum()
    findings.append(f"{poses} static poses, {still:.0f} s in all")
    force = Moments(recording.accelerometer).between(*intervals.T)[0]
    axis = int(np.abs(force[0]).argmax())
    findings.append(
        f"in the first of them {'xyz'[axis]} points {'up' if force[0, axis] > 0 else 'down'}, as the accelerometer has "
        "it; poses and turns look the same with all its signs turned round: if it was the other way, add --axes=-f"
    )
    tilt = _tilt(force)
    if poses > 1 and tilt < _TILTED:
        findings.append(
            f"{'both' if poses == 2 else f'all {poses}'} poses are of one orientation, within {tilt:.2g}°: a "
            "calibration by poses needs nine or more, all around"
        )
        return 0
    return poses


def _stops(recording: Recording) -> int:
    """Return how often a vehicle stops; 0 for any other recording."""
    from jaximu.recordings.segmentation import find_stops

    try:
        stops = None if recording.gyroscope is None else find_stops(recording)
    except NotPossibleError:
        return 0
    return 0 if stops is None else len(stops.intervals)


def _tilt(force: FloatArray) -> float:
    """Return the largest angle, degrees, of the force (P, 3) in a pose from its mean over all poses."""
    import numpy as np

    from jaximu.ground.rotation import unit_vectors

    up = unit_vectors(force)
    middle = up.mean(axis=0)
    return float(np.degrees(np.arccos(np.clip(up @ middle / max(np.linalg.norm(middle), 1e-9), -1.0, 1.0))).max())


def _still_seconds(recording: Recording) -> tuple[FloatArray, BoolArray, FloatArray]:
    """When the seconds (n,) begin; which are at rest, by their scatter and how their means move; and the means (n, 3)
    in them of the gyroscope, rad/s, or none.
    """
    import numpy as np

    from jaximu.ground.vectors import lengths_of
    from jaximu.recordings.segmentation import Moments, windows_with_samples

    sensors = [(signal, _STILL[name][0]) for name, signal in recording.signals.items() if name in _STILL]
    start, rates = max(signal.time[0] for signal, _ in sensors), np.zeros((0, 3))
    last = int(min(signal.time[-1] for signal, _ in sensors) - start) - 1.0
    begins = start + windows_with_samples(sensors[0][0].time - start, last)
    still = np.ones(len(begins), bool)
    for signal, limit in sensors:
        mean, variance, count = Moments(signal).between(begins, begins + 1)
        still &= (np.sqrt(variance.sum(axis=1)) < limit) & (count > 1)
        if signal is recording.accelerometer:
            still[1:] &= lengths_of(np.diff(mean, axis=0)) < _MIDDLE
        if len(sensors) == 1 and signal is recording.gyroscope:  # a table's steady turn scatters as little
            still &= lengths_of(mean) < _BIAS
        rates = mean if signal is recording.gyroscope else rates
    return begins, still, rates
