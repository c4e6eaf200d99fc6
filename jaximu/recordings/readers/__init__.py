"""Files in: `read_recording` finds the format from the content; one file a format."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.recordings.entry import ScheduleEntry
    from jaximu.recordings.readers.attitude import holds_attitude, read_attitude
    from jaximu.recordings.readers.reader import (
        advise_reading,
        read_frame,
        read_magnetometer,
        read_means,
        read_recording,
    )
    from jaximu.recordings.readers.schedule import read_reference, read_schedule
    from jaximu.recordings.recording import ReadOptions

__all__ = [
    "ReadOptions",
    "ScheduleEntry",
    "advise_reading",
    "holds_attitude",
    "read_attitude",
    "read_frame",
    "read_magnetometer",
    "read_means",
    "read_recording",
    "read_reference",
    "read_schedule",
]

__getattr__ = lazily(
    __name__,
    {
        "jaximu.recordings.entry": "ScheduleEntry",
        "jaximu.recordings.readers.attitude": "holds_attitude, read_attitude",
        "jaximu.recordings.readers.reader": "advise_reading, read_frame, read_magnetometer, read_means, read_recording",
        "jaximu.recordings.readers.schedule": "read_reference, read_schedule",
        "jaximu.recordings.recording": "ReadOptions",
    },
)
