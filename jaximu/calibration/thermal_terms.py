"""The terms of a thermal model: effects of the catalogue by name, with inner parameters, and one shape of many."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from jaximu.ground.array_types import FloatArray
from jaximu.model.effects import CATALOGUE
from jaximu.model.effects.learned import SHAPES

POWERS = ("temperature", "temperature_squared", "temperature_cubed")
RATES = ("temperature_rate", "temperature_rate_squared", "temperature_times_rate")
HISTORY = {"thermal_lag": "time_constant", "thermal_hysteresis": "half_width"}
BESIDE = {kind.plain: kind.shares for kind in CATALOGUE.values() if kind.shares}
"""Effects that share the inner parameter of the one that they stand beside."""
LEARNED = "learned_temperature"
SPLINES = len(SHAPES) - 1
SCALE = "scale_temperature"
NETWORK = "learned_network"


@dataclass(frozen=True, eq=False)
class Net:
    """Weights (3, 16) of each axis, SI, and standard deviations a priori (3, 16) over the root of the noise's scale.

    determined: how many numbers of an axis the data determine.
    """

    weights: FloatArray
    prior: FloatArray
    determined: float


class ThermalTerm(NamedTuple):
    """A column group of the fit: a catalogue effect without its prefix, inner parameter, and which of its shapes."""

    name: str
    inner: float = 0.0  # of what has a memory
    shape: int = 0  # of an axis: of the learned curve, or the weight of the network
    net: Net | None = None  # about which the network is linear


Model = tuple[tuple[ThermalTerm, ...], ...]
"""The terms of each of three axes."""


def history(name: str, value: float) -> ThermalTerm:
    """Return the term of an effect with memory at a value of its inner parameter."""
    return ThermalTerm(name, float(value))


def memories(names: Iterable[str]) -> set[str]:
    """Return whose inner parameters effects have, by name."""
    return {BESIDE.get(name, name) for name in names} & set(HISTORY)


def net_of(terms: Iterable[ThermalTerm]) -> Net | None:
    """Return the network that is linearised among terms, if any is."""
    return next((term.net for term in terms if term.net is not None), None)


def at_inner(term: ThermalTerm, chosen: Mapping[str, ThermalTerm]) -> ThermalTerm:
    """Return a term at the inner parameter that is chosen, by name, for its effect or the one that it stands beside."""
    like = chosen.get(BESIDE.get(term.name, term.name))
    return term if like is None else term._replace(inner=like.inner)
