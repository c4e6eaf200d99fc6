"""Deciding with a calibration: limits, guard bands, verdicts, and how a production line moves."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.acceptance.acceptance import Acceptance, accept
    from jaximu.acceptance.decision import Rule
    from jaximu.acceptance.item import Item
    from jaximu.acceptance.limits import Limits, read_limits
    from jaximu.acceptance.line import Line, follow

__all__ = [
    "Acceptance",
    "Item",
    "Limits",
    "Line",
    "Rule",
    "accept",
    "follow",
    "read_limits",
]

__getattr__ = lazily(
    __name__,
    {
        "jaximu.acceptance.acceptance": "Acceptance, accept",
        "jaximu.acceptance.decision": "Rule",
        "jaximu.acceptance.item": "Item",
        "jaximu.acceptance.limits": "Limits, read_limits",
        "jaximu.acceptance.line": "Line, follow",
    },
)
