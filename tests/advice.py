"""The commands that outputs suggest, and what comes of running them on the file that they were suggested for."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import every_verb

VERBS = (
    "accept allan array budget calibrate check compare compensate consequences diagnose effects export filter fleet "
    "info magnetometer plan record reference simulate thermal turntable verify"
).split()
_INLINE = re.compile(r"`(jaximu [^`]+)`")
_LINE = re.compile(r"^\s*(jaximu .+?)\s*$", re.MULTILINE)
_BARE = re.compile(rf"(?<!`)(jaximu (?:{'|'.join(VERBS)}) [^`;]*?)(?:[.;,](?:\s|$)|\s+(?:Or|and)\s)")
_BLANK = re.compile(r"\?|\b[A-Z_]{3,}(\.\w+)?\b|…|\bFILE\b")
"""What is to be filled in, which a command on its own does not have: a reference, a limit, another log."""
_KNOWN = {"CALIBRATION": "calibration.json", "CORRECTED.csv": "corrected.csv"}


@dataclass(frozen=True)
class Advice:
    """A command that the output of another suggested, and how running it ended."""

    after: str
    command: str
    status: int
    said: str
    suggests: tuple[str, ...]

    @property
    def leads_on(self) -> bool:
        """Whether it ran, or refused and sent on to something else than what had been run before it."""
        return self.status == 0 or (bool(self.suggests) and self.after not in self.suggests)


def commands_in(stdout: str, stderr: str) -> list[str]:
    """The whole commands in what was printed, in their order, each once; those with something to fill in are left out.

    A page wraps lines where words end, so that a command within a sentence may stand on two.
    """
    text = " ".join(stdout.split())
    try:
        document = json.loads(stdout)
    except ValueError:
        document = None
    if isinstance(document, dict):
        text = "" if not document.get("next") else f"`{document['next']}`"
    refusal = " ".join(stderr.split())
    commands = [*_INLINE.findall(text), *_INLINE.findall(refusal), *_BARE.findall(refusal)]
    commands += _LINE.findall(stdout) if document is None else []
    whole: list[str] = []
    for command in commands:
        for blank, value in _KNOWN.items():
            command = re.sub(rf"\b{blank}\b", value, command)
        if not _BLANK.search(re.sub(r'"[^"?]*"', "", command)) and len(command.split()) > 2:
            whole.append(command)
    return list(dict.fromkeys(whole))


def _run(command: str) -> every_verb.Outcome:
    return every_verb.run(shlex.split(command)[1:], None, False)


def followed(command: str, folder: Path) -> Iterator[Advice]:
    """Run a command in a folder that is the working one, then everything that it suggests.

    Commands that need a calibration which is not there (that of another recording) are left out.
    """
    first = _run(command)
    for advised in commands_in(first.stdout, first.stderr):
        files = re.findall(r"[\w./-]*calibration\.json", advised)
        if any(not (folder / file).is_file() for file in files):
            continue  # which another command of the same page writes, or needs
        outcome = _run(advised)
        yield Advice(
            command, advised, outcome.status, outcome.short, tuple(commands_in(outcome.stdout, outcome.stderr))
        )
