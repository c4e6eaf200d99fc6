"""What recordings say about a unit, one file a kind of data, and the residuals that they share."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.data.attitude import AgainstAttitude
    from jaximu.data.poses import forces_and_angles, residual_rms
    from jaximu.data.recorded_stations import RecordedStations
    from jaximu.data.rest_blocks import Leg, RestBlocks, without_startup
    from jaximu.data.station_error import turntable_error

__all__ = [
    "AgainstAttitude",
    "Leg",
    "RecordedStations",
    "RestBlocks",
    "forces_and_angles",
    "residual_rms",
    "turntable_error",
    "without_startup",
]

__getattr__ = lazily(
    __name__,
    {
        "jaximu.data.attitude": "AgainstAttitude",
        "jaximu.data.poses": "forces_and_angles, residual_rms",
        "jaximu.data.recorded_stations": "RecordedStations",
        "jaximu.data.rest_blocks": "Leg, RestBlocks, without_startup",
        "jaximu.data.station_error": "turntable_error",
    },
)
