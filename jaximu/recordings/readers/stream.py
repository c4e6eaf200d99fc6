"""Lines as they come: from a command's output, a serial port, standard input, or a file that is played again."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import IO, Any

from jaximu.ground.errors import InputError

_PATIENCE = 10.0  # s without a line after which a source is taken for dead
_LONGEST = 1 << 12  # bytes of a line


class Lines:
    """A source of text lines, closed at the end of a `with`.

    garbled: how many lines were left out. stopped: why it ended too early, in a sentence, "" where it did not.

    A source is `-` (standard input), a file, a serial port (/dev/ttyUSB0, COM3) or a command. Of a port the first line
    is left out, as it may have begun before. Lines that are cut short or garbled, with another number of fields than
    a table's first lines, are left out everywhere. A file comes as fast as it is asked for, everything else as it does.

    Raises `InputError` where there is no such source, or pyserial is not installed for a port.
    """

    def __init__(self, source: str, baud: int = 115200, patience: float = _PATIENCE) -> None:
        self.name, self.garbled, self.stopped = "standard input" if source == "-" else source, 0, ""
        self._patience, self._fields, self._before = patience, 0, 0
        self._process: subprocess.Popen[bytes] | None = None
        self._port: Any = None
        path = Path(source)
        if path.is_file():
            self._file: Iterator[bytes] | None = iter(path.read_bytes().splitlines(keepends=True))
            return
        self._file, self._queue = None, SimpleQueue[bytes | None]()
        threading.Thread(target=self._listen, args=(self._open(source, baud),), daemon=True).start()

    def _open(self, source: str, baud: int) -> Iterable[bytes]:
        if source == "-":
            return sys.stdin.buffer
        if Path(source).is_char_device() or source.upper().startswith("COM"):
            self._port = _port(source, baud)
            self._port.readline(_LONGEST)
            return iter(lambda: self._port.readline(_LONGEST), None)  # no line within its time is b"", not the end
        words = shlex.split(source)
        if not words or shutil.which(words[0]) is None:
            raise InputError(f"--from {source}: there is no file, port or command of this name.")
        self._process = subprocess.Popen(words, stdout=subprocess.PIPE)
        output: IO[bytes] | None = self._process.stdout
        assert output is not None
        return output

    def _listen(self, lines: Iterable[bytes]) -> None:
        try:
            for line in lines:
                self._queue.put(line)
        except (OSError, ValueError, TypeError) as error:  # a port that was pulled out, or closed by us
            self.stopped = f"{self.name} was interrupted ({error})."
        self._queue.put(None)

    def take(self, count: int) -> list[bytes]:
        """Return about `count` lines: those that have come, at least one, and of a file just so many; none at its end.

        Raises `InputError` where a source that is still open has been silent for ten seconds.
        """
        if self._file is not None:
            return list(islice(self._sound(self._file), count))
        lines = []
        until = time.monotonic() + self._patience
        while len(lines) < count or not self._queue.empty():
            try:
                line = self._queue.get(timeout=max(0.0, until - time.monotonic()))
            except Empty:
                if lines:
                    return lines
                advice = "Is the sensor on, and --baud right?" if self._port is not None else "Is the sensor on?"
                raise InputError(f"{self.name}: no line has come for {self._patience:g} s. {advice}") from None
            if line is None:
                self._queue.put(None)  # the end is found again
                return lines
            lines += self._sound([line] if line else [])
        return lines

    def _sound(self, lines: Iterable[bytes]) -> Iterator[bytes]:
        """Yield the whole lines: text, ended, with as many fields as the first two alike; and what is above those."""
        for line in lines:
            mark = next((mark for mark in (b"\t", b";", b",") if mark in line), None)
            fields = len(line.split(mark))
            if not self._fields and fields == self._before > 1:
                self._fields = fields
            self._before = fields
            kept = fields == self._fields or not self._fields or line.startswith((b"#", b"%"))
            if line.endswith(b"\n") and line.isascii() and kept:
                yield line
            elif line.strip():
                self.garbled += 1

    def __enter__(self) -> Lines:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.terminate()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(2.0)
            if self._process.stdout is not None:
                self._process.stdout.close()
        if self._port is not None:
            self._port.close()


def _port(name: str, baud: int) -> Any:
    try:
        import serial
    except ModuleNotFoundError:
        raise InputError(f"--from {name}: a serial port needs pyserial: pip install 'jaximu[serial]'.") from None
    try:
        return serial.Serial(name, baud, timeout=1.0)
    except (serial.SerialException, ValueError) as error:
        raise InputError(f"--from {name}: the port cannot be opened: {error}.") from error
