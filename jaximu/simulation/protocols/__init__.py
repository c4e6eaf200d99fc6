"""Protocols: recipes of motion and temperature, one file each."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.simulation.protocols.base import Plan, Protocol
    from jaximu.simulation.protocols.catalogue import PROTOCOLS
    from jaximu.simulation.protocols.course import Course, Environment, Interval, Tone, attitude_of
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
    "Interval",
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

__getattr__ = lazily(__name__)
