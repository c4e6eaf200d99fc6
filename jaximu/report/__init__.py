"""What a person gets to read: pictures and one HTML page."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.report.html import write_report

__all__ = [
    "write_report",
]

__getattr__ = lazily(
    __name__,
    {
        "jaximu.report.html": "write_report",
    },
)
