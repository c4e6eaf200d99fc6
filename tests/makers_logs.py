"""`jaximu LOG --yes` on logs of makers: the verbs that it runs, what it has to assume, and how it reads them."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from dialects import ALL, Dialect, off, simulate
from makers import habit

from jaximu.cli import main
from jaximu.cli.usage import command_of
from jaximu.ground.page import Page

__all__ = ["THIRTY", "Answer", "answer"]

assert habit  # which registers the makers
VERBS = "calibrate", "diagnose", "turntable", "reference", "magnetometer", "allan", "thermal"
POSES = [simulate("poses", seed=seed) for seed in range(5)]
_BY_HAND = [
    name
    for name, dialect in ALL.items()
    if "accel" in dialect.sensors and "unanswerable" not in dialect.must and any(dialect.log is log for log in POSES)
]
THIRTY = _BY_HAND[:: len(_BY_HAND) // 30][:30]
"""Every so many-th of the makers' files with poses by hand that say which columns are the accelerometer."""


class Answer(NamedTuple):
    """verbs: those that were run. questions: what was assumed. wrong: what is wrong with what was read, if anything.

    refused: why nothing was run.
    """

    verbs: tuple[str, ...]
    questions: tuple[str, ...]
    wrong: str
    refused: str = ""

    def right(self, dialect: Dialect) -> bool:
        """Whether the verbs are those for poses by hand of these sensors, on samples that were read right."""
        wanted = ("calibrate", "diagnose")[: len(dialect.sensors & {"accel", "gyro"})]
        return self.verbs[: len(wanted)] == wanted and not self.wrong


class _Document:
    def text(self) -> str:
        return json.dumps({"schema": "a"})

    def summary(self) -> Page:
        return Page("It", ["It is known."])


@contextlib.contextmanager
def _noted(read: list[Any]) -> Iterator[None]:
    """In place of what verbs compute, keep what they read."""
    with pytest.MonkeyPatch.context() as patch:
        for verb in VERBS:

            def run(command):
                arguments = vars(command)
                logs = arguments.get("logs") or arguments["log_path"]
                path = logs[0] if isinstance(logs, tuple) else logs
                read.append(command.log.with_gyroscope(path).read(path, check=False, alone=True))
                command.results.present(
                    lambda: Page("It", ["It is done."]), calibration=_Document(), diagnosis=_Document()
                )

            patch.setattr(command_of(verb), "run", run)
        yield


def answer(dialect: Dialect, folder: Path) -> Answer:
    """Run `jaximu LOG --yes` on a maker's file."""
    folder.mkdir(exist_ok=True)
    path = dialect.write(folder, dialect.log)
    read: list[Any] = []
    out, err = io.StringIO(), io.StringIO()
    with _noted(read), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main([str(path), "--yes", "--json"])
    document = json.loads(out.getvalue())
    if status:
        return Answer((), (), "", document["error"])
    wrong = [text for recording in read if (text := off(dialect, recording))]
    return Answer(tuple(document["verbs"]), tuple(document["assumed"]), "; ".join(dict.fromkeys(wrong)))
