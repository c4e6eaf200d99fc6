"""Limits in a TOML file: what a unit must keep, of which quantity, and where the limit comes from.

    rule = "guarded"                     # or "simple": the value alone decides; --rule
    risk = 0.05                          # of accepting what does not conform, and of rejecting what does; --risk
    source = "data sheet rev. 3, table 4"

    [limits]
    "accelerometer.bias" = "40 mg"       # from −40 to 40 mg, each axis; the output at zero input over its gain
    "accelerometer.scale" = "1 %"        # off its nominal value, each axis
    "gyroscope.misalignment" = "10 mrad" # cross-axis gain over the axis's own; [1,0]: output y, input x
    "gyroscope.bias[2]" = { low = "-0.5 deg/s", high = "1 deg/s", source = "customer's drawing" }
    "gyroscope.scale" = { typical = "0.5 %" }     # a data sheet's typical value, one standard deviation: limit 3 times
    "accel.temperature" = "0.01 (m/s^2)/K"        # coefficients of an effect, in its unit
    "accelerometer.output" = { within = "5 mg", over = "1 g" }        # error of the corrected output, up to 1 g
    "gyroscope.raw_output" = { within = "2 deg/s", over = "300 deg/s", temperature = ["0 degC", "50 degC"] }
    "gyroscope.N" = { high = "0.01 deg/s/sqrt(Hz)" }                  # N, B, K, Q, R of an allan.json (--noise)
    "accelerometer.repeatability" = { high = "1 mg" }                 # of the bias, of an allan.json of several logs
    "navigation.position" = { within = "50 m", after = "60 s" }       # of level driving; east, north and up each
    "navigation.heading" = { within = "0.5 deg", after = "60 s" }     # both with --noise, too, where that is given

    [nominal]                            # of a unit that is logged in counts
    accelerometer = "2048 count/g"
    accelerometer_offset = 0             # counts at zero input, one number or three

A key that names an axis, `[0]`, `[1,0]`, goes before the one that names all. Every number has its unit. In place of
such a file, a table of `jaximu fleet` will do: limits are then tolerance intervals, which hold 99 % of its population
with 95 % confidence.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaximu.acceptance.decision import Rule, probability_of_conformity
from jaximu.acceptance.words import between, parts_of, si_unit
from jaximu.ground.array_types import FloatArray
from jaximu.ground.document import Json, file_digest, read_toml
from jaximu.ground.errors import FilePath, InputError, only
from jaximu.ground.units import SENSOR_QUANTITIES, SENSOR_UNITS, unit
from jaximu.model.data_sheet import NUMBER_WITH_UNIT, SI_UNITS, parse_quantity
from jaximu.model.effects import CATALOGUE
from jaximu.recordings.columns.nominal import parse_offset, parse_scale

Scales = Mapping[str, tuple[FloatArray, FloatArray]]
"""By triad in counts, counts per SI unit (3,) and counts at zero input (3,)."""

TYPICAL = 3.0
"""Limit of what a data sheet calls typical, in typical values: 99.7 % of a normal population lie within."""
_NAMES = {"accelerometer": "acceleration", "gyroscope": "angular rate", "magnetometer": "magnetic field"}
FROM_ALLAN = ("repeatability", *"QNBKR")
"""Quantities that an allan.json tells, not a calibration."""
_NAVIGATION = {"position": "m", "heading": "deg"}
OF_ONE_UNIT = (*FROM_ALLAN, *_NAVIGATION)
"""Quantities that a fleet's table does not tell."""
OUTPUTS = ("output", "raw_output")
_PARTS = ("bias", "scale", "misalignment", *OUTPUTS, "repeatability")
_LONGEST = 3600.0  # s, of navigation
_KEY = re.compile(r"[a-z_.A-Z]+(?:\[\d(?:,\s*\d)?\])?")
_KEYS = ("within", "low", "high", "typical", "source", "over", "temperature", "after")
_TOP = ("rule", "risk", "source", "limits", "nominal")


@dataclass(frozen=True)
class Limit:
    """Bounds of one quantity, of one axis or of all. low, high: in `unit`, infinite where there is none.

    owner: the triad, or "navigation". part: "bias", "scale", "misalignment", "output", "raw_output", "repeatability", a
    noise term, an effect's name, "position" or "heading". axes: () for all. over: of outputs, the largest magnitude of
    the input, SI. temperature: °C. after: s, of navigation. stated: the unit in which a file states the limit.
    """

    key: str
    owner: str
    part: str
    axes: tuple[int, ...]
    low: float
    high: float
    unit: str
    source: str = ""
    over: float = 0.0
    temperature: tuple[float, float] | None = None
    after: float = 0.0
    stated: str = ""

    @property
    def stem(self) -> str:
        """What the names of its quantities begin with: `gyroscope.bias`, or an effect's name."""
        return self.part if "." in self.part else f"{self.owner}.{self.part}"

    def words(self) -> str:
        """Say between which values the quantity must lie."""
        return between(self.low, self.high, self.unit, self.stated)

    def nearest(self, value: float) -> float:
        """Return how far a value is from the nearer bound."""
        return min(abs(self.high - value), abs(value - self.low))

    def judged(self, rule: Rule, value: float, sigma: float) -> Json:
        """Return what an item says of a value that is normally distributed with this standard uncertainty."""
        probability = probability_of_conformity(value, sigma, self.low, self.high)
        verdict = str(rule.verdicts(probability, self.low <= value <= self.high))
        return {"value": value, "sigma": sigma, "probability": float(probability), "verdict": verdict}


@dataclass(frozen=True)
class Limits:
    """What units are held to. nominal: by triad, scale (3,) in counts per SI unit and offset (3,) in counts."""

    limits: tuple[Limit, ...]
    rule: Rule
    nominal: Scales
    file: str
    sha256: str

    def applies(self, limit: Limit, name: str) -> bool:
        """Return whether a limit is the one of a quantity such as `gyroscope.bias[2]`: one of its axis goes before."""
        stem, _, _, axes = parts_of(name)
        others = [other.axes for other in self.limits if other.stem == stem]
        return limit.stem == stem and (limit.axes == axes or (not limit.axes and axes not in others))


def read_limits(path: FilePath, rule: str | None = None, risk: float | None = None) -> Limits:
    """Read limits. Raises `InputError` naming file and key for what is no limit, has no unit or contradicts itself.

    **Arguments:** `rule`, `risk`: instead of the file's.
    """
    name = os.fspath(path)
    document = read_toml(path, "a file of limits, as `jaximu accept --explain` shows one")
    only(document, _TOP, name)
    stated = document.get("limits")
    if not isinstance(stated, dict) or not stated:
        raise InputError(f"{name}: there are no limits; they stand below [limits], see `jaximu accept --explain`.")
    source = str(document.get("source", ""))
    limits = tuple(_limit(key, value, source, f"{name}, {key}") for key, value in stated.items())
    _refuse_contradictions(limits, name)
    kind = rule or document.get("rule", "guarded")
    level = document.get("risk", 0.05) if risk is None else risk
    if isinstance(level, bool) or not isinstance(level, int | float):
        raise InputError(f"{name}: the risk is a number such as 0.05, not {level!r}.")
    return Limits(
        limits, Rule(kind, float(level)), _nominal(document.get("nominal", {}), name), name, file_digest(path)
    )


def _limit(key: str, stated: Any, source: str, where: str) -> Limit:
    owner, part, axes, base = _meaning(key, where)
    entry = stated if isinstance(stated, dict) else {"within": stated}
    only(entry, _KEYS, where)
    bounds = [name for name in ("within", "low", "high", "typical") if name in entry]
    if not bounds or (len(bounds) > 1 and bounds != ["low", "high"]):
        raise InputError(f"{where}: state one of `within`, `typical`, or `low` and `high`; found {bounds or 'none'}.")
    sizes = {name: _value(entry[name], base, f"{where}.{name}") for name in bounds}
    source = str(entry.get("source", source))
    if "typical" in sizes:
        sizes["within"] = TYPICAL * sizes["typical"]
        source = f"{source or 'data sheet'}: {TYPICAL:g} times the typical value {entry['typical']}"
    if "within" in sizes:
        if not sizes["within"] > 0:
            raise InputError(f"{where}: the limit must be greater than zero, found {sizes['within']:g} {base}.")
        sizes["high"] = sizes["within"]
        if part not in FROM_ALLAN:  # what is positive by nature has no lower limit
            sizes["low"] = -sizes["within"]
    low, high = sizes.get("low", -math.inf), sizes.get("high", math.inf)
    if low >= high:
        raise InputError(
            f"{where}: the limits contradict each other: the lower, {low:g}, is not below {high:g} {base}."
        )
    over, after, temperature = 0.0, 0.0, None
    if part in OUTPUTS:
        if "over" not in entry:
            raise InputError(f'{where}: say up to which input the output is limited: over = "1 g" (or "300 deg/s").')
        over = abs(_value(entry["over"], base, f"{where}.over"))
        if "temperature" in entry:
            temperature = _range(entry["temperature"], f"{where}.temperature")
    elif "over" in entry or "temperature" in entry:
        raise InputError(f"{where}: `over` and `temperature` belong to limits of an output.")
    if owner == "navigation":
        if "after" not in entry:
            raise InputError(f'{where}: say after how long the {part} is limited: after = "60 s".')
        after = _value(entry["after"], "s", f"{where}.after")
        if not 0 < after <= _LONGEST or low > 0 or high < 0:
            raise InputError(f"{where}: an error about zero is limited, after a time up to {_LONGEST:g} s.")
    elif "after" in entry:
        raise InputError(f"{where}: `after` belongs to limits of navigation.")
    _, stated_unit = _split(entry[bounds[0]], where, "")
    return Limit(key, owner, part, axes, low, high, base, source, over, temperature, after, stated_unit)


def _meaning(key: str, where: str) -> tuple[str, str, tuple[int, ...], str]:
    name, owner, part, axes = parts_of(key if _KEY.fullmatch(key) else "")
    if name in CATALOGUE:
        effect = CATALOGUE[name]
        if effect.scope != "device" or len(axes) > 1 or (axes and axes[0] >= effect.size):
            raise InputError(f"{where}: an effect of the device, such as {name}[{effect.size - 1}], may be limited.")
        return effect.owner, name, axes, effect.coefficient_unit(SENSOR_UNITS[effect.owner])
    if (
        owner == "navigation"
        and part in _NAVIGATION
        and all(axis <= 2 for axis in axes)
        and (len(axes) <= (part == "position"))
    ):
        return owner, part, axes, _NAVIGATION[part]
    if owner not in SENSOR_QUANTITIES or part not in (*_PARTS, *"QNBKR"):
        raise InputError(
            f"{where}: there is no such quantity; there are {', '.join(_PARTS)} and the noise terms Q, N, B, K, R of "
            "accelerometer, gyroscope and magnetometer (accelerometer.bias), effects (accel.quadratic), and "
            "navigation.position and navigation.heading."
        )
    if (
        any(axis > 2 for axis in axes)
        or (axes and len(axes) != 1 + (part == "misalignment"))
        or (part == "misalignment" and len(set(axes)) == 1)
    ):
        raise InputError(f"{where}: axes are [0], [1], [2]; of a misalignment two that differ, [1,0].")
    return owner, part, axes, SI_UNITS[SENSOR_QUANTITIES[owner]][part] if part in "QNBKR" else si_unit(key)


def _value(stated: Any, base: str, where: str) -> float:
    examples = {"1": "1 %", "rad": "10 mrad", "rad/s": "0.5 deg/s", "m/s^2": "20 mg", "deg": "0.5 deg"}
    number, text = _split(stated, where, f', such as "{examples.get(base, f"1 {base}")}"')
    if text.replace(" ", "") == base.replace(" ", ""):
        return number
    if base.startswith("("):
        raise InputError(f'{where}: write it in {base}, such as "1e-4 {base}".')
    if base == "1" and text not in ("%", "ppm"):
        raise InputError(f"{where}: {text!r} is no ratio; write %, ppm or 1.")
    return parse_quantity(stated, base, where)


def _split(stated: Any, where: str, hint: str) -> tuple[float, str]:
    match = NUMBER_WITH_UNIT.fullmatch(stated) if isinstance(stated, str) else None
    if match is None or not match[2]:
        raise InputError(f"{where}: {stated!r} needs a number with its unit{hint}.")
    return float(match[1]), match[2]


def _range(stated: Any, where: str) -> tuple[float, float]:
    temperatures = []
    for end in stated if isinstance(stated, list) else [stated]:
        number, text = _split(end, where, ': ["-10 degC", "60 degC"]')
        kind = unit(text, "temperature", file=where)
        temperatures.append(kind.factor * number + kind.offset)
    if len(temperatures) != 2 or temperatures[0] >= temperatures[1]:
        raise InputError(f'{where}: give the lowest and the highest temperature: ["-10 degC", "60 degC"].')
    return temperatures[0], temperatures[1]


def _nominal(stated: Any, name: str) -> Scales:
    if not isinstance(stated, dict):
        raise InputError(f'{name}: below [nominal] stand scales such as accelerometer = "2048 count/g".')
    only(stated, (*_NAMES, *(f"{owner}_offset" for owner in _NAMES)), f"{name}, [nominal]")
    nominal = {}
    for owner, quantity in _NAMES.items():
        if owner in stated:
            where = f"{name}, nominal.{owner}"
            scale = parse_scale(stated[owner], quantity, where)
            offset = parse_offset(stated.get(f"{owner}_offset", 0.0), f"{where}_offset")
            nominal[owner] = np.broadcast_to(scale, 3), np.broadcast_to(offset, 3)
        elif f"{owner}_offset" in stated:
            raise InputError(f"{name}: nominal.{owner}_offset needs the scale beside it, nominal.{owner}.")
    return nominal


def _refuse_contradictions(limits: tuple[Limit, ...], name: str) -> None:
    """Refuse the limit of an axis that nothing can keep together with the one of all axes."""
    whole = {(limit.owner, limit.part): limit for limit in limits if not limit.axes}
    for limit in limits:
        other = whole.get((limit.owner, limit.part), limit)
        if limit.low > other.high or limit.high < other.low:
            raise InputError(
                f"{name}: {limit.key} ({limit.low:g} to {limit.high:g} {limit.unit}) and {other.key} ({other.low:g} to "
                f"{other.high:g}) contradict each other: nothing keeps both."
            )
