"""Calibrations as other tools' files, one writer a file: `write(Parameters) -> Written`."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.formats.exports.base import Correction, Parameters, Written
    from jaximu.formats.exports.catalogue import WRITERS, export
    from jaximu.formats.exports.cost import Loss, Range, losses
    from jaximu.formats.exports.messages import is_messages, write_messages

__all__ = ["WRITERS", "Correction", "Loss", "Parameters", "Range", "Written", "export", "is_messages",
           "losses", "write_messages"]  # fmt: skip

__getattr__ = lazily(__name__)
