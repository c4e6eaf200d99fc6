"""Calibrations as other tools' files, one writer a file: `write(Parameters) -> Written`."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.report.export.base import Correction, ExportedUnit, Written
    from jaximu.report.export.catalogue import WRITERS, export
    from jaximu.report.export.cost import Loss, Range, losses
    from jaximu.report.export.in_force import Composition
    from jaximu.report.export.messages import is_messages, write_messages

__all__ = [
    "WRITERS",
    "Composition",
    "Correction",
    "ExportedUnit",
    "Loss",
    "Range",
    "Written",
    "export",
    "is_messages",
    "losses",
    "write_messages",
]

__getattr__ = lazily(
    __name__,
    {
        "jaximu.report.export.base": "Correction, ExportedUnit, Written",
        "jaximu.report.export.catalogue": "WRITERS, export",
        "jaximu.report.export.cost": "Loss, Range, losses",
        "jaximu.report.export.in_force": "Composition",
        "jaximu.report.export.messages": "is_messages, write_messages",
    },
)
