"""Every protocol by the name it has in a specification."""

from jaximu.protocols.base import Protocol
from jaximu.protocols.dividing_head import DividingHead
from jaximu.protocols.ferraris import Ferraris
from jaximu.protocols.hand_held import HandHeld
from jaximu.protocols.positions import Positions
from jaximu.protocols.rate_table import RateTable
from jaximu.protocols.rotations import Rotations
from jaximu.protocols.single_axis_table import SingleAxisTable
from jaximu.protocols.soak_and_ramp import SoakAndRamp
from jaximu.protocols.static import Static
from jaximu.protocols.vibration import Vibration

__all__ = ["PROTOCOLS"]

_KINDS = (
    Static,
    Positions,
    HandHeld,
    RateTable,
    DividingHead,
    SingleAxisTable,
    Ferraris,
    Rotations,
    SoakAndRamp,
    Vibration,
)
PROTOCOLS: dict[str, type[Protocol]] = {protocol.kind: protocol for protocol in _KINDS}
"""Every protocol by the name it has in a specification."""
