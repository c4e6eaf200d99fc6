"""What a person gets to read: pictures and one HTML page."""

from jaximu.report.html import write_report

__all__ = ["write_report"]
