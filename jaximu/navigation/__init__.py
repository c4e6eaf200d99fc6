"""Navigation: strapdown mechanisation, pre-integration, and how errors run through both."""

from jaximu.navigation.mechanisation import Navigation, deviation, linearised, mechanise, mechanise_increments
from jaximu.navigation.preintegration import Preintegrated, increments, preintegrate
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
