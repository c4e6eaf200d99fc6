"""The next poses and turns: which of them most reduce a stated uncertainty."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.planning.information import Accuracy, Design, hand_held_information, table_information
    from jaximu.planning.plan import EQUIPMENT, Equipment, Known, Pose, Proposal, Turn, propose
    from jaximu.planning.sequences import FILTERED, Filter, propose_sequence

__all__ = [
    "EQUIPMENT",
    "FILTERED",
    "Accuracy",
    "Design",
    "Equipment",
    "Filter",
    "Known",
    "Pose",
    "Proposal",
    "Turn",
    "hand_held_information",
    "propose",
    "propose_sequence",
    "table_information",
]

__getattr__ = lazily(
    __name__,
    {
        "jaximu.planning.information": "Accuracy, Design, hand_held_information, table_information",
        "jaximu.planning.plan": "EQUIPMENT, Equipment, Known, Pose, Proposal, Turn, propose",
        "jaximu.planning.sequences": "FILTERED, Filter, propose_sequence",
    },
)
