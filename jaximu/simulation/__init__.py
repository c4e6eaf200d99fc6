"""Simulation: protocol + unit + effects + noise + artefacts + seed → recording and its truth."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.simulation.artefacts import ARTEFACTS, Artefact
    from jaximu.simulation.draw import ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY, consumer_noise, draw_imu
    from jaximu.simulation.engine import Case, Stream, Truth, simulate, simulate_cases, write_case
    from jaximu.simulation.specification import Specification, read_specification

__all__ = [
    "ACCELEROMETER_DENSITY",
    "ARTEFACTS",
    "GYROSCOPE_DENSITY",
    "Artefact",
    "Case",
    "Specification",
    "Stream",
    "Truth",
    "consumer_noise",
    "draw_imu",
    "read_specification",
    "simulate",
    "simulate_cases",
    "write_case",
]

__getattr__ = lazily(
    __name__,
    {
        "jaximu.simulation.artefacts": "ARTEFACTS, Artefact",
        "jaximu.simulation.draw": "ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY, consumer_noise, draw_imu",
        "jaximu.simulation.engine": "Case, Stream, Truth, simulate, simulate_cases, write_case",
        "jaximu.simulation.specification": "Specification, read_specification",
    },
)
