"""Noise figures as data sheets state them: units with roots in them, and continuous against discrete.

A continuous density (N in rad/s/√Hz) belongs to the sensor. A discrete standard deviation (σ in rad/s) belongs to the
sensor at one sample rate: σ = N √rate for white noise, σ = K/√rate for the step of a random walk.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike

from jaximu.ground.errors import InputError
from jaximu.ground.units import DEGREE, STANDARD_GRAVITY

SI_UNITS = {
    "angular_rate": {"Q": "rad", "N": "rad/s/sqrt(Hz)", "B": "rad/s", "K": "rad/s^2/sqrt(Hz)", "R": "rad/s^2"},
    "specific_force": {"Q": "m/s", "N": "m/s^2/sqrt(Hz)", "B": "m/s^2", "K": "m/s^3/sqrt(Hz)", "R": "m/s^3"},
    "magnetic_field": {"Q": "uT*s", "N": "uT/sqrt(Hz)", "B": "uT", "K": "uT/s/sqrt(Hz)", "R": "uT/s"},
}
"""The SI unit of each term, of a field in µT; rad/s/√Hz is rad/√s, and m/s²/√Hz is m/s^(3/2)."""

TERM_NAMES = {
    "Q": "quantisation",
    "N": "white noise",
    "B": "bias instability",
    "K": "rate random walk",
    "R": "rate ramp",
}

NOISE_KINDS = {
    "noise.white": TERM_NAMES["N"],
    "noise.correlated": "correlated noise",
    "noise.bias_instability": TERM_NAMES["B"],
    "noise.rate_random_walk": TERM_NAMES["K"],
}
"""In English, the kinds of noise that a recording can show to be wrong in a noise model."""

DATASHEET_UNITS = {
    "angular_rate": {"Q": "arcsec", "N": "deg/sqrt(h)", "B": "deg/h", "K": "deg/h/sqrt(h)", "R": "deg/h/h"},
    "specific_force": {"Q": "m/s", "N": "m/s/sqrt(h)", "B": "ug", "K": "ug/sqrt(h)", "R": "ug/h"},
    "magnetic_field": {"Q": "nT*s", "N": "nT/sqrt(Hz)", "B": "nT", "K": "nT/sqrt(h)", "R": "nT/h"},
}
"""The unit that data sheets mostly state a term in."""

# by powers of metre, radian, second, µT, kelvin: names, and the factor to SI (of a field: µT)
_UNITS = {
    (0, 0, 0, 0, 0): {"1": 1.0, "%": 1e-2, "ppm": 1e-6},
    (0, 0, 0, 0, 1): {"K degC °C": 1.0},
    (1, 0, 0, 0, 0): {"m": 1.0, "mm": 1e-3},
    (0, 0, 1, 0, 0): {"s sec": 1.0, "ms": 1e-3, "us µs μs": 1e-6, "min": 60.0, "h hr hour": 3600.0},
    (0, 0, -1, 0, 0): {"Hz": 1.0},
    (0, 1, 0, 0, 0): {
        "rad": 1.0,
        "mrad": 1e-3,
        "urad µrad μrad": 1e-6,
        "deg ° degree": DEGREE,
        "mdeg m°": DEGREE * 1e-3,
        "arcmin": DEGREE / 60,
        "arcsec": DEGREE / 3600,
    },
    (0, 1, -1, 0, 0): {"dps": DEGREE, "mdps": DEGREE * 1e-3, "dph": DEGREE / 3600},
    (1, 0, -2, 0, 0): {
        "g": STANDARD_GRAVITY,
        "mg": STANDARD_GRAVITY * 1e-3,
        "ug µg μg": STANDARD_GRAVITY * 1e-6,
        "mGal": 1e-5,
    },
    (0, 0, 0, 1, 0): {"uT µT μT": 1.0, "nT": 1e-3, "mG mgauss": 0.1},
}
_ATOMS = {
    name: (factor, powers)
    for powers, units in _UNITS.items()
    for names, factor in units.items()
    for name in names.split()
}
_FACTOR = re.compile(r"(?:(sqrt|√)\s*\(?\s*([^\s()^*/·]+)\s*\)?|([^\s()^*/·√]+))(?:\^\(?(-?[0-9.]+(?:/[0-9]+)?)\)?)?")
NUMBER_WITH_UNIT = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*")
"""A number, and the text of its unit, which may be empty."""
_SUPERSCRIPTS = str.maketrans({"²": "^2", "³": "^3"})


@dataclass(frozen=True)
class DensityUnit:
    """A unit with any powers: SI value = factor · value; dimension by powers of metre, radian, second, µT, kelvin."""

    text: str
    factor: float
    dimension: tuple[Fraction, ...]


def parse_unit(text: str) -> DensityUnit:
    """Return the unit written as `text`: "deg/sqrt(h)", "m/s/√h", "ug/sqrt(Hz)", "rad/s^2/sqrt(Hz)", "mdps/√Hz" ….

    Factors are joined by * and /, each / dividing by the one factor that follows. Raises InputError.
    """
    if text.count("(") != text.count(")"):
        raise InputError(f"unit {text!r} has a parenthesis without its partner.")
    factor, dimension, rest, sign = 1.0, [Fraction(0)] * 5, text.strip().translate(_SUPERSCRIPTS), 1
    while rest:
        match = _FACTOR.match(rest)
        atom = match and _ATOMS.get(match[2] or match[3])
        if not match or not atom:
            raise InputError(
                f"unit {text!r} is not understood at {rest!r}; write e.g. deg/sqrt(h), ug/sqrt(Hz), deg/h."
            )
        try:
            power = Fraction(match[4]) if match[4] else Fraction(1)
            power = sign * (power / 2 if match[1] else power)
            factor *= atom[0] ** float(power)
            if not (0 < factor < math.inf):
                raise OverflowError
        except (ValueError, ArithmeticError):
            raise InputError(f"unit {text!r} has a power that is not understood: {match[4]!r}.") from None
        dimension = [a + power * b for a, b in zip(dimension, atom[1], strict=True)]
        rest = rest[match.end() :].strip()
        if rest and rest[0] not in "/*·":
            raise InputError(f"unit {text!r} is not understood at {rest!r}: factors are joined by * or /.")
        sign = -1 if rest[:1] == "/" else 1
        if rest and not rest[1:].strip():
            raise InputError(f"unit {text!r} ends with {rest!r}.")
        rest = rest[1:].strip()
    return DensityUnit(text, factor, tuple(dimension))


def convert(value: ArrayLike, unit: str, to: str) -> np.ndarray | float:
    """Return a value in another unit: `convert(0.66, "deg/sqrt(h)", "rad/s/sqrt(Hz)")`.

    Raises InputError for units of different kinds, naming both.
    """
    source, target = parse_unit(unit), parse_unit(to)
    if source.dimension != target.dimension:
        raise InputError(f"{unit!r} and {to!r} are units of different quantities.")
    converted = np.asarray(value, float) * (source.factor / target.factor)
    return float(converted) if converted.ndim == 0 else converted


def parse_quantity(text: str | float, unit: str, what: str = "value") -> float:
    """Return a number in `unit` from "100 ug/sqrt(Hz)", or from a plain number, which is in `unit` already.

    Raises InputError, naming `what`, for text that is no number with a unit of that kind.
    """
    if isinstance(text, int | float) and not isinstance(text, bool):
        return float(text)
    match = NUMBER_WITH_UNIT.fullmatch(str(text))
    if not match:
        raise InputError(f"{what}: {text!r} is not a number with a unit such as {unit}.")
    if not match[2]:
        return float(match[1])
    try:
        return float(convert(float(match[1]), match[2], unit))
    except InputError as error:
        raise InputError(f"{what}: {error}") from error


def to_discrete(term: str, value: ArrayLike, rate: float) -> np.ndarray:
    """Return the standard deviation per sample at `rate` (Hz) of a continuous N (white noise) or K (random walk)."""
    return np.asarray(value) * _per_sample(term, rate)


def from_discrete(term: str, sigma: ArrayLike, rate: float) -> np.ndarray:
    """Return the continuous N or K from the standard deviation per sample (N) or per step (K) at `rate` (Hz)."""
    return np.asarray(sigma) / _per_sample(term, rate)


def _per_sample(term: str, rate: float) -> float:
    if not rate > 0:
        raise InputError(f"the sample rate must be positive, found {rate}.")
    if term not in ("N", "K"):
        raise InputError(
            f"only N (white noise) and K (random walk) have a standard deviation per sample, not {term!r}."
        )
    return math.sqrt(rate) if term == "N" else 1 / math.sqrt(rate)
