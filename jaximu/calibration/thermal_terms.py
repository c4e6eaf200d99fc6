"""The terms of a thermal model: effects of the catalogue by name, with inner parameters, and one shape of many."""

from __future__ import annotations

from typing import NamedTuple

from jaximu.model.effects.learned import SHAPES

__all__ = ["HISTORY", "LEARNED", "NETWORK", "POWERS", "RATES", "SCALE", "SPLINES", "Model", "Net", "ThermalTerm",
           "history"]  # fmt: skip

POWERS = ("temperature", "temperature_squared", "temperature_cubed")
RATES = ("temperature_rate", "temperature_rate_squared", "temperature_times_rate")
HISTORY = {"thermal_lag": "time_constant", "thermal_hysteresis": "half_width"}
LEARNED = "learned_temperature"
SPLINES = len(SHAPES) - 1
SCALE = "scale_temperature"
NETWORK = "learned_network"


class Net(NamedTuple):
    """Weights of three axes (48 numbers, SI), and standard deviations a priori over the root of the noise's scale."""

    weights: tuple[float, ...]
    prior: tuple[float, ...]


class ThermalTerm(NamedTuple):
    """A column group of the fit: a catalogue effect without its prefix, inner parameters, and which of its shapes."""

    name: str
    inner: tuple[tuple[str, float], ...] = ()
    shape: int | None = None  # of the learned curve, or the weight of the network
    net: Net | None = None  # about which the network is linear


Model = tuple[tuple[ThermalTerm, ...], ...]
"""The terms of each of three axes."""


def history(name: str, value: float) -> ThermalTerm:
    """Return the term of an effect with memory at a value of its inner parameter."""
    return ThermalTerm(name, ((HISTORY[name], float(value)),))
