"""Files in and out: `read_recording` finds the format from the content, `write_recording` from the suffix."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.formats.attitude import holds_attitude, read_attitude
    from jaximu.formats.reader import (
        ReadOptions,
        advise_reading,
        read_frame,
        read_magnetometer,
        read_means,
        read_recording,
    )
    from jaximu.formats.schedule import ScheduleEntry, read_reference, read_schedule
    from jaximu.formats.write import arrow_table, write_recording

__all__ = [
    "ReadOptions",
    "ScheduleEntry",
    "advise_reading",
    "arrow_table",
    "holds_attitude",
    "read_attitude",
    "read_frame",
    "read_magnetometer",
    "read_means",
    "read_recording",
    "read_reference",
    "read_schedule",
    "write_recording",
]

__getattr__ = lazily(__name__)
