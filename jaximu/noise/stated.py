"""Noise that a file states: the figures of its terms by triad, and the `NoiseModel` that they make."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.document import damage
from jaximu.ground.errors import FilePath, InputError
from jaximu.ground.units import INERTIAL_QUANTITIES
from jaximu.model import BiasInstability
from jaximu.model.data_sheet import SI_UNITS, convert
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.processes import MEMBER_VARIANCE
from jaximu.noise.analysis import read_analysis
from jaximu.recordings.readers.kalibr import read_noise

SensorNoise = Mapping[str, Mapping[str, FloatArray]]
"""By triad and term (Q, N, B, K, repeatability), the figure of each axis (3,), SI, two-sided."""
_LASTING = 1e5
"""s: correlation time of the process that stands for a random walk; no recording of poses lasts as long."""
_SHORTEST = 0.1
"""s: flicker noise that is quicker is white noise to means over poses."""


def read_sensor_noise(path: FilePath) -> SensorNoise:
    """Read Q, N, B, K and repeatability from an `allan.json`, or N and K from an `imu.yaml`, whose keys fix units.

    Raises `InputError` for anything else, or without units.
    """
    name = os.fspath(path)
    if name.lower().endswith((".yaml", ".yml")):
        known = read_noise(path)
        return {
            triad: {
                term: np.full(3, known[f"{triad}_{key}"])
                for term, key in (("N", "noise_density"), ("K", "random_walk"))
                if f"{triad}_{key}" in known
            }
            for triad in INERTIAL_QUANTITIES
        }
    return sensor_noise(read_analysis(path), name)


def sensor_noise(document: Mapping[str, Any], name: str) -> SensorNoise:
    """Return Q, N, B, K and repeatability of an `allan.json` as a dictionary called `name`; as `read_sensor_noise`."""
    figures = {}
    for triad, quantity in INERTIAL_QUANTITIES.items():
        if (axes := document.get(triad)) is None:
            continue
        units = SI_UNITS[quantity]
        terms = {}
        with damage(name):
            for term in ("Q", "N", "B", "K"):
                entries = [axis["terms"].get(term) for axis in axes]
                values = [
                    0.0 if entry is None else _in_si(entry, units[term], f"{name}: {triad} {term}") for entry in entries
                ]
                terms[term] = np.array(values, float).reshape(3)
            if (spread := (document.get("repeatability") or {}).get(triad)) is not None:
                terms["repeatability"] = np.reshape(_in_si(spread, units["B"], f"{name}: {triad} repeatability"), 3)
        figures[triad] = {term: values for term, values in terms.items() if np.any(values)}
    return figures


def _in_si(entry: Any, unit: str, what: str) -> Any:
    stated = entry.get("unit")
    if not isinstance(stated, str):
        raise InputError(f"{what} has no unit: state it, such as {unit}.")
    return convert(entry["value"], stated, unit)


def model_of(figures: SensorNoise) -> NoiseModel:
    """Return the noise that figures make: a ramp and the spread over power-ons are no part of it.

    Raises `InputError` where a triad has no white noise: then its uncertainty would be made up.
    """
    for triad, terms in figures.items():
        if not np.all(terms.get("N", 0.0)):
            raise InputError(f"the {triad}'s white noise N is not stated for each axis: without it no fit has weights.")
    if "accelerometer" not in figures:
        raise InputError("the file states no noise of an accelerometer.")
    noise = {triad: _axis_noise(terms) for triad, terms in figures.items()}
    return NoiseModel(noise["accelerometer"], noise.get("gyroscope"))


def _axis_noise(terms: Mapping[str, FloatArray]) -> AxisNoise:
    quantisation, white, flicker, walk = (terms.get(letter, np.zeros(3)) for letter in "QNBK")
    times = BiasInstability(1.0).bank(_SHORTEST)
    variance = np.column_stack([np.outer(MEMBER_VARIANCE * flicker**2, np.ones(len(times))), walk**2 * _LASTING / 2])
    return AxisNoise(white**2, quantisation**2, variance, np.append(times, _LASTING))
