"""Standard output and standard error of the command: neither a closed pipe nor an encoding makes it fail."""

import codecs
import errno
import io
import os
import sys
import unicodedata

_SPELLED = {
    "−": "-",
    "–": "-",
    "—": "-",
    "·": "*",
    "×": "x",
    "±": "+-",
    "°": "deg",
    "µ": "u",
    "√": "sqrt ",
    "→": "->",
    "²": "^2",
    "³": "^3",
    "⁴": "^4",
    "⁻": "^-",
    "“": '"',
    "”": '"',
    "’": "'",
    "≥": ">=",
    "≤": "<=",
    "∞": "inf",
    "≈": "~",
    "∂": "d",
}
"""What stands for a character that an encoding lacks, where its decomposition does not say it."""

_CLOSED = (errno.EPIPE, errno.EINVAL) if os.name == "nt" else (errno.EPIPE,)
"""What a system says of a pipe that nobody reads."""


class _Pipe(io.FileIO):
    """A file or pipe to which output goes. What nobody reads any more is dropped, and the work goes on."""

    def write(self, data, /) -> int:
        try:
            return super().write(data)
        except OSError as error:
            if error.errno not in _CLOSED:
                raise
            return memoryview(data).nbytes


def _spelled(error: UnicodeError) -> tuple[str, int]:
    """Spell what an encoding lacks: σ is sigma, √ is sqrt, and what has no spelling is a question mark."""
    assert isinstance(error, UnicodeEncodeError)
    return "".join(map(_letter, error.object[error.start : error.end])), error.end


def _letter(character: str) -> str:
    words = unicodedata.name(character, "").split()
    if words[:1] == ["GREEK"]:
        return words[-1].lower()
    if words[:1] == ["COMBINING"]:
        return "'"
    plain = unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode()
    return _SPELLED.get(character) or plain or "?"


def open_streams() -> None:
    """Make the process' streams take any text, and a pipe that closes no reason to stop."""
    codecs.register_error("spelled", _spelled)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if not isinstance(stream, io.TextIOWrapper):  # closed, or not ours
            continue
        if not stream.isatty():
            prompt = stream.line_buffering or stream.write_through
            pipe = io.BufferedWriter(_Pipe(stream.fileno(), "wb", closefd=False))
            stream = io.TextIOWrapper(pipe, stream.encoding, line_buffering=prompt)
            setattr(sys, name, stream)
        stream.reconfigure(errors="spelled")
