"""`jaximu record`: a recording is made pose by pose, guided, until the calibration is as good as wanted."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import UseAppendAction

from jaximu.cli import options
from jaximu.cli.messages import progress, say
from jaximu.cli.options import option
from jaximu.ground.errors import InputError

if TYPE_CHECKING:
    from jaximu.planning.guide import GoalProgress, Guide, Moment
    from jaximu.recordings.readers.stream import Lines
    from jaximu.recordings.recording import Recording

__all__ = ["RecordCommand"]

_FIRST = 100  # lines before the log is read for the first time
_EARLY = 1000  # lines from which on a log that cannot be read is a mistake
_EVERY = 0.5  # s of recording between two looks at it
_LOG = "log.csv"


@dataclass(frozen=True)
class RecordCommand:
    """Record with guidance: which way to hold the unit next, which poses count, and when it is enough.

    Lines are CSV with a header, or described by --columns. DIR receives log.csv line by line, then calibration.json and
    report.html, as of `jaximu calibrate`. Ctrl-C ends the recording and calibrates what there is.

    Examples:
      jaximu record --from /dev/ttyUSB0 --columns "time [us],accel [g],gyro [deg/s]" -o results
      jaximu record --from "nc -l 5555" --goal "accelerometer.bias 0.5 mg" -o results
      jaximu record --from old/log.csv -o again

    """

    source: Annotated[
        str,
        option(
            "COMMAND|PORT|FILE|-",
            "Where lines come from: a command's output, a serial port, a file to play again, or standard input.",
            name="from",
        ),
    ]
    baud: Annotated[int, option("N", "Speed of a serial port.")] = 115200
    goal: Annotated[
        tuple[str, ...],
        UseAppendAction,
        option(
            "GOAL",
            'Record until this standard uncertainty is reached, as "accelerometer.bias 0.2 mg" or '
            '"gyroscope.scale 0.1 %"; may be repeated. Default: a dozen poses.',
        ),
    ] = ()
    rest: Annotated[float, option("S", "How long a pose must rest to count, in seconds.")] = 4.0
    log: options.Reading = options.READING
    local: options.Local = options.LOCAL
    traced: options.Traced = options.TRACED
    results: options.Output = options.RESULTS

    def run(self) -> None:
        """Do what the command line says."""
        if self.results.output is None:
            raise InputError("name a folder for the recording and its calibration: -o DIR.")
        path = self.results.output / _LOG
        if path.exists():
            raise InputError(f"{path} exists; name another folder.")
        gravity = self.local.value()
        from jaximu.planning.guide import Guide
        from jaximu.recordings.readers.stream import Lines

        guide = Guide(self.goal, gravity, self.rest)
        with Lines(self.source, self.baud) as lines:
            self.results.prepare(*options.INERTIAL)
            say(f"Hold the unit still for {self.rest:g} s in each pose, then turn it to the next.")
            try:
                done = _record(lines, path, self.log, guide)
            except KeyboardInterrupt:
                say("Stopped.")
                done = False
            except InputError as error:
                kept = (
                    f" {path} has what was recorded: `jaximu calibrate {path}`."
                    if path.exists() and path.stat().st_size
                    else ""
                )
                raise InputError(f"{error.args[0]}{kept}") from None
        for text in (lines.stopped, f"{lines.garbled} garbled lines were left out." if lines.garbled else ""):
            if text:
                say(text)
        if not done:
            say("The recording ended before the goal was reached; what there is is calibrated.")
        with progress("calibrating"):
            from jaximu.calibration import calibrate

            calibration = calibrate(self.log.read(path, gravity), gravity)
        calibration = replace(calibration, trace=self.traced.value((path,)))
        self.results.present(calibration.summary, calibration=calibration)


def _record(lines: Lines, path: Path, log: options.LogOptions, guide: Guide) -> bool:
    """Write lines to the log and follow it; return whether the goal was reached before they ended."""
    count, wanted, last = 0, _FIRST, None
    with path.open("wb") as file:
        while some := lines.take(wanted):
            file.writelines(some)
            file.flush()
            count += len(some)
            recording = _so_far(path, log, count)
            if recording is None:
                continue
            wanted = max(1, round(_EVERY * recording.accelerometer.rate))
            moment = guide.update(recording)
            _tell(moment, last, guide.rest)
            last = moment
            if moment.done:
                return all(goal.reached for goal in moment.goals)
    return False


def _so_far(path: Path, log: options.LogOptions, count: int) -> Recording | None:
    """Read the log as it is by now; None while it is too short to be read."""
    try:
        return log.read(path, check=False)
    except InputError:
        if count >= _EARLY:
            raise
        return None


def _tell(moment: Moment, last: Moment | None, rest: float) -> None:
    """Say what has changed since the last look."""
    before = 0 if last is None else len(last.taken)
    if len(moment.taken) > before:
        bell = "\a" if sys.stderr.isatty() else ""
        goals = "".join(f" {_goal_words(goal)}." for goal in moment.goals)
        say(f"{bell}Pose {len(moment.taken)} counts.{goals}" + ("" if moment.done else f" Next: {moment.words}."))
    elif len(moment.taken) < before:
        say(f"The unit moved in a pose: {len(moment.taken)} count. Next: {moment.words or 'hold it still'}.")
    elif moment.short and (last is None or last.still):
        say(f"Not long enough: {moment.short:.1f} s at rest, {rest:g} s are needed.")


def _goal_words(goal: GoalProgress) -> str:
    import math

    if goal.now == math.inf:
        return f"{goal.text}: open"
    return f"{goal.text}: {'reached' if goal.reached else f'{goal.now / goal.size:.2g} times that'}"
