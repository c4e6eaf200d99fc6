"""Navigation: strapdown mechanisation, trajectories, and what the errors of a calibration do along them."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.data.preintegration import Preintegrated, increments, preintegrate
    from jaximu.navigation.mechanisation import Navigation, deviation, linearised, mechanise, mechanise_increments
    from jaximu.navigation.propagation import noise_covariance

__all__ = [
    "Navigation",
    "Preintegrated",
    "deviation",
    "increments",
    "linearised",
    "mechanise",
    "mechanise_increments",
    "noise_covariance",
    "preintegrate",
]

__getattr__ = lazily(
    __name__,
    {
        "jaximu.data.preintegration": "Preintegrated, increments, preintegrate",
        "jaximu.navigation.mechanisation": "Navigation, deviation, linearised, mechanise, mechanise_increments",
        "jaximu.navigation.propagation": "noise_covariance",
    },
)
