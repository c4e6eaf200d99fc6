"""Temperature: what bias and scale do over it, from recordings at rest; what they can tell; other tools' parameters."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.thermal.calibration import ThermalCalibration, calibrate_thermal
    from jaximu.thermal.identifiability import Identifiability
    from jaximu.thermal.triad import TriadFit

__all__ = [
    "Identifiability",
    "ThermalCalibration",
    "TriadFit",
    "calibrate_thermal",
]

__getattr__ = lazily(__name__)
