"""Protocols: recipes of motion and temperature, one file each."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.simulation.protocols.base import Plan, Protocol
    from jaximu.simulation.protocols.catalogue import PROTOCOLS
    from jaximu.simulation.protocols.course import Course, Environment, Tone, attitude_of
    from jaximu.simulation.protocols.dividing_head import DividingHead
    from jaximu.simulation.protocols.ferraris import Ferraris
    from jaximu.simulation.protocols.hand_held import HandHeld
    from jaximu.simulation.protocols.motion import Motion, block_length, earth_rate
    from jaximu.simulation.protocols.positions import Positions
    from jaximu.simulation.protocols.rate_table import RateTable
    from jaximu.simulation.protocols.rotations import Rotations
    from jaximu.simulation.protocols.single_axis_table import SingleAxisTable
    from jaximu.simulation.protocols.soak_and_ramp import SoakAndRamp
    from jaximu.simulation.protocols.static import Static
    from jaximu.simulation.protocols.vibration import Vibration

__all__ = [
    "PROTOCOLS",
    "Course",
    "DividingHead",
    "Environment",
    "Ferraris",
    "HandHeld",
    "Motion",
    "Plan",
    "Positions",
    "Protocol",
    "RateTable",
    "Rotations",
    "SingleAxisTable",
    "SoakAndRamp",
    "Static",
    "Tone",
    "Vibration",
    "attitude_of",
    "block_length",
    "earth_rate",
]

__getattr__ = lazily(
    __name__,
    {
        "jaximu.simulation.protocols.base": "Plan, Protocol",
        "jaximu.simulation.protocols.catalogue": "PROTOCOLS",
        "jaximu.simulation.protocols.course": "Course, Environment, Tone, attitude_of",
        "jaximu.simulation.protocols.dividing_head": "DividingHead",
        "jaximu.simulation.protocols.ferraris": "Ferraris",
        "jaximu.simulation.protocols.hand_held": "HandHeld",
        "jaximu.simulation.protocols.motion": "Motion, block_length, earth_rate",
        "jaximu.simulation.protocols.positions": "Positions",
        "jaximu.simulation.protocols.rate_table": "RateTable",
        "jaximu.simulation.protocols.rotations": "Rotations",
        "jaximu.simulation.protocols.single_axis_table": "SingleAxisTable",
        "jaximu.simulation.protocols.soak_and_ramp": "SoakAndRamp",
        "jaximu.simulation.protocols.static": "Static",
        "jaximu.simulation.protocols.vibration": "Vibration",
    },
)
