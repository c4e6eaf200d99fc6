"""A thermal model of a triad as effects of a unit, and their fit by the one core."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from jaximu.effects import CATALOGUE, Effect
from jaximu.effects.network import UNITS, WEIGHTS
from jaximu.estimation import Fit, Prior, fit
from jaximu.measurements.rest import BlockPath, RestOverTemperature
from jaximu.problem import Name
from jaximu.sensor import Imu
from jaximu.thermal.linear import Whitened
from jaximu.thermal.terms import HISTORY, NETWORK, Model, Term

__all__ = ["fit_effects"]

FloatArray = NDArray[np.float64]
_PREFIXES = {"accelerometer": "accel", "gyroscope": "gyro"}


def fit_effects(data: Whitened, model: Model, scale: FloatArray, polished: bool = False) -> Fit:
    """Fit the coefficients of each axis's terms and the inner parameters that the axes share, in output units.

    The fit starts where the terms have their inner parameters.

    **Arguments:** `scale` (3,): of the noise's variance, to begin with. `polished`: whether the terms are at the best
    fit already, and stay there with that scale; only their uncertainty is asked.
    """
    name, blocks, shapes = data.name, data.blocks, data.shapes
    signal = getattr(blocks.recordings[0], name)
    outputs = blocks.means[name] * signal.nominal_scale + signal.nominal_offset
    if data.measurement is None:
        weights = data.root / signal.nominal_scale[:, None, None]
        data.measurement = RestOverTemperature(name, outputs, weights, blocks.level, _paths(data))
    effects = _effects(model, data, signal.nominal_scale)
    places = dict(enumerate(effects))

    def free(number: Name) -> bool:
        if number.owner != name or number.part == "gain":
            return False
        if number.effect is None:
            return True
        kind = places[number.effect]
        if number.part != "coefficients":
            return number.part == HISTORY.get(kind.plain)
        axis, shape = divmod(number.axes[0], kind.size // 3)
        return any(term.name == kind.plain and term.shape in (None, shape) for term in model[axis])

    unit = Imu.nominal()
    triads = {owner: replace(triad, temperature_reference=shapes.reference) for owner, triad in unit.triads().items()}
    triads[name] = replace(triads[name], gain=np.diag(signal.nominal_scale), bias=outputs.mean(axis=0))
    unit = Imu(triads["accelerometer"], triads["gyroscope"]).with_effects(*effects)
    prior = _prior(model, name, effects, scale, signal.nominal_scale)
    return fit(unit, data.measurement, free, prior=prior, excess=scale - 1, estimate_excess=not polished,
               max_passes=1 if polished else 32)  # fmt: skip


def _paths(data: Whitened) -> list[BlockPath]:
    """Return what the unit went through: the temperatures, at the force of each rest."""
    found, count = [], len(data.blocks)
    for stimulus, place in data.shapes.paths:
        force = data.shapes.force[np.minimum(place, count - 1)]
        celsius = np.asarray(stimulus.temperature) + data.shapes.reference
        found.append((replace(stimulus, temperature=celsius, specific_force=force,
                              temperature_reference=data.shapes.reference), place))  # fmt: skip
    return found


def _effects(model: Model, data: Whitened, output_scale: FloatArray) -> tuple[Effect, ...]:
    """Return the terms as effects with the coefficients that least squares gives them."""
    found = []
    solved = [dict(zip(terms, data.coefficients(axis, terms), strict=True)) for axis, terms in enumerate(model)]
    for name in dict.fromkeys(term.name for terms in model for term in terms):
        kind = CATALOGUE[f"{_PREFIXES[data.name]}.{name}"]
        numbers, inner = np.zeros((3, kind.size // 3)), data.shapes.bounds(kind)
        for axis, own in enumerate(solved):
            for term, value in own.items():
                if term.name == name:
                    numbers[axis, term.shape or 0] = value * _unit(term, output_scale[axis])
                    inner |= {key: np.float64(each) for key, each in term.inner}
        found.append(kind(numbers.ravel(), **inner))
    return tuple(found)


def _unit(term: Term, output_scale: float) -> float:
    """Return output units per SI unit of a coefficient; weights inside tanh have none."""
    return 1.0 if term.name == NETWORK and (term.shape or 0) >= UNITS else output_scale


def _prior(
    model: Model, owner: str, effects: Sequence[Effect], scale: FloatArray, output_scale: FloatArray
) -> Prior | None:
    """Return what is known beforehand of a network's weights."""
    names, sigmas = [], []
    for axis, terms in enumerate(model):
        for term in terms:
            if term.net is None or term.shape is None:
                continue
            place = next(k for k, effect in enumerate(effects) if effect.plain == NETWORK)
            names.append(Name(owner, "coefficients", (axis * WEIGHTS + term.shape,), place))
            own = np.reshape(term.net.prior, (3, WEIGHTS))[axis, term.shape]
            sigmas.append(own * np.sqrt(scale[axis]) * _unit(term, output_scale[axis]))
    return Prior(tuple(names), np.zeros(len(names)), np.diag(1 / np.array(sigmas))) if names else None
