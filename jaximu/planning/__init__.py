"""The next poses and turns: which of them most reduce a stated uncertainty."""

from jaximu.planning.information import Accuracy, Design, hand_held_information, table_information
from jaximu.planning.plan import EQUIPMENT, Equipment, Known, Pose, Proposal, Turn, propose

__all__ = ["EQUIPMENT", "Accuracy", "Design", "Equipment", "Known", "Pose", "Proposal", "Turn", "hand_held_information",
           "propose", "table_information"]  # fmt: skip
