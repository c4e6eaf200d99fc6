"""Temperature: what bias and scale do over it, from recordings at rest; what they can tell; other tools' parameters."""

from jaximu.thermal.calibration import ThermalCalibration, calibrate_thermal
from jaximu.thermal.fit import Identifiability, TriadFit
from jaximu.thermal.rest import Leg, RestBlocks, rest_blocks, without_startup

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
