"""Every protocol by the name it has in a specification."""

from jaximu.simulation.protocols.base import Protocol
from jaximu.simulation.protocols.dividing_head import DividingHead
from jaximu.simulation.protocols.ferraris import Ferraris
from jaximu.simulation.protocols.hand_held import HandHeld
from jaximu.simulation.protocols.positions import Positions
from jaximu.simulation.protocols.rate_table import RateTable
from jaximu.simulation.protocols.rotations import Rotations
from jaximu.simulation.protocols.single_axis_table import SingleAxisTable
from jaximu.simulation.protocols.soak_and_ramp import SoakAndRamp
from jaximu.simulation.protocols.static import Static
from jaximu.simulation.protocols.vibration import Vibration

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
