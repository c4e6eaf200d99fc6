"""Protocols: recipes of motion and temperature, one file each."""

from jaximu.protocols.base import Plan, Protocol
from jaximu.protocols.catalogue import PROTOCOLS
from jaximu.protocols.course import Course, Environment, Interval, Tone, attitude_of
from jaximu.protocols.dividing_head import DividingHead
from jaximu.protocols.ferraris import Ferraris
from jaximu.protocols.hand_held import HandHeld
from jaximu.protocols.motion import Motion, block_length, earth_rate
from jaximu.protocols.positions import Positions
from jaximu.protocols.rate_table import RateTable
from jaximu.protocols.rotations import Rotations
from jaximu.protocols.single_axis_table import SingleAxisTable
from jaximu.protocols.soak_and_ramp import SoakAndRamp
from jaximu.protocols.static import Static
from jaximu.protocols.vibration import Vibration

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
