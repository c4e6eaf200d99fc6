"""Temperature: what bias and scale do over it, from recordings at rest; what they can tell; other tools' parameters."""

from jaximu.thermal.calibration import ThermalCalibration, calibrate_thermal
from jaximu.thermal.identifiability import Identifiability
from jaximu.thermal.rest import Leg, RestBlocks, rest_blocks, without_startup
from jaximu.thermal.triad import TriadFit

__all__ = [
    "Identifiability",
    "Leg",
    "RestBlocks",
    "ThermalCalibration",
    "TriadFit",
    "calibrate_thermal",
    "rest_blocks",
    "without_startup",
]
