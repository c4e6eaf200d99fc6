"""`jaximu record`: a recording is made pose by pose, guided, until the calibration is as good as wanted."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import MISSING, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import UseAppendAction

import jaximu
from jaximu.cli import options
from jaximu.cli.messages import progress, say
from jaximu.cli.options import option, switch, takes_options
from jaximu.ground.errors import InputError, JaximuError

if TYPE_CHECKING:
    from jaximu.planning.guide import Guide, Moment
    from jaximu.recordings.readers.stream import Lines


_FIRST = 100  # lines before the log is read for the first time
_EARLY = 1000  # lines from which on a log that cannot be read is a mistake
_EVERY = 0.5  # s of recording between two looks at it
_LOG = "log.csv"


@takes_options
class RecordCommand(options.Reads):
    """Record with guidance: which way to hold the unit next, which poses count, and when it is enough.

    Lines are CSV with a header, or described by --columns. DIR receives log.csv line by line, then calibration.json and
    report.html, as of `jaximu calibrate`. Ctrl-C ends the recording and calibrates what there is. --page also draws the
    next pose, what counts and what is still uncertain in the browser; nothing leaves this machine.

    Examples:
      jaximu record --from /dev/ttyUSB0 --columns "time [us],accel [g],gyro [deg/s]" -o results
      jaximu record --from "nc -l 5555" --goal "accelerometer.bias 0.5 mg" -o results
      jaximu record --from old/log.csv -o again
      jaximu record --from /dev/ttyUSB0 --page -o results

    """

    source: str = option(
        "COMMAND|PORT|FILE|-",
        "Where lines come from: a command's output, a serial port, a file to play again, or standard input.",
        MISSING,
        name="from",
    )
    baud: int = option("N", "Speed of a serial port.", 115200)
    goal: tuple[str, ...] = option(
        "GOAL",
        'Record until this standard uncertainty is reached, as "accelerometer.bias 0.2 mg" or '
        '"gyroscope.scale 0.1 %"; may be repeated. Default: a dozen poses.',
        (),
        UseAppendAction,
    )
    rest: float = option("S", "How long a pose must rest to count, in seconds.", 4.0)
    page: bool = switch("Also show the pose to take next, and what counts, on a page in the browser.")
    page_port: int = option("N", "Port of the page, on this machine alone (default: one that is free).", 0)
    traced: options.TraceOptions = options.TRACED

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
        with self._page() as show, Lines(self.source, self.baud) as lines:
            self.results.prepare(*options.INERTIAL)
            say(f"Hold the unit still for {self.rest:g} s in each pose, then turn it to the next.")
            try:
                done = _record(lines, path, self.log, guide, show)
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
            show(end="The recording has ended. Calibrating …")
            with progress("calibrating"):
                calibration = jaximu.calibrate(self.log.read(path, gravity), gravity)
            calibration = replace(calibration, trace=self.traced.value((path,)))
            self.results.present(calibration.summary, calibration=calibration)
            show(end=f"Calibrated: the report is {self.results.output / 'report.html'}")

    @contextmanager
    def _page(self) -> Iterator[Callable[..., None]]:
        """Give what shows changes of a `Capture` on the page; a page that ends with an error says so."""
        if not self.page:
            if self.page_port:
                raise InputError("--page-port goes with --page.")
            yield lambda **_: None
            return
        from jaximu.cli.server import PageServer, open_in_browser
        from jaximu.report.guide import LivePage

        live = LivePage(self.rest)

        def show(**changes: Any) -> None:
            live.capture = replace(live.capture, **changes, since=time.monotonic())
            server.changed()

        with PageServer(live, self.page_port) as server:
            say(f"The page is {server.address}")
            open_in_browser(server.address)
            try:
                yield show
            except JaximuError as error:
                show(end=f"The recording has ended: {error.args[0]}")
                raise


def _record(lines: Lines, path: Path, log: options.LogOptions, guide: Guide, show: Callable[..., None]) -> bool:
    """Write lines to the log and follow it; return whether the goal was reached before they ended.

    `show`: takes what a `Capture` is to hold by now, by name.
    """
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
            show(stage="Computing …")
            moment = guide.update(recording)
            news = _news(moment, last, guide.rest)
            if news:
                counts = len(moment.taken) > (0 if last is None else len(last.taken))
                say("\a" * (counts and sys.stderr.isatty()) + news)
            show(moment=moment, stage="Waiting for lines …", **({"news": news} if news else {}))
            last = moment
            if moment.done:
                return all(goal.reached for goal in moment.goals)
    return False


def _so_far(path: Path, log: options.LogOptions, count: int) -> jaximu.Recording | None:
    """Read the log as it is by now; None while it is too short to be read."""
    try:
        return log.read(path, check=False)
    except InputError:
        if count >= _EARLY:
            raise
        return None


def _news(moment: Moment, last: Moment | None, rest: float) -> str:
    """Return what has changed since the last look, in words."""
    before, count = 0 if last is None else len(last.taken), len(moment.taken)
    if count > before:
        goals = "".join(f" {goal.text}: {goal.words}." for goal in moment.goals)
        return f"Pose {count} counts.{goals}" + ("" if moment.done else f" Next: {moment.words}.")
    if count < before:
        return f"The unit moved in a pose: {count} count. Next: {moment.words or 'hold it still'}."
    if moment.short and (last is None or last.still):
        return f"Not long enough: {moment.short:.1f} s at rest, {rest:g} s are needed."
    return ""
