"""What loggers wrote: recordings, their poses and turns, and what reference or unit is told of them beside."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.recordings.finding import Finding
    from jaximu.recordings.write import arrow_table, write_recording

__all__ = [
    "Finding",
    "arrow_table",
    "write_recording",
]

__getattr__ = lazily(
    __name__,
    {
        "jaximu.recordings.finding": "Finding",
        "jaximu.recordings.write": "arrow_table, write_recording",
    },
)
