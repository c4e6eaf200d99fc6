"""Deciding with a calibration: limits, guard bands, verdicts, and how a production line moves."""

from jaximu.acceptance.accept import Acceptance, accept
from jaximu.acceptance.decision import Rule
from jaximu.acceptance.item import Item
from jaximu.acceptance.limits import Limits, read_limits
from jaximu.acceptance.line import Line, follow

__all__ = ["Acceptance", "Item", "Limits", "Line", "Rule", "accept", "follow", "read_limits"]
