"""What a path of temperature distinguishes, before any fit: in numbers and in words."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jaximu.calibration.thermal_shapes import ThermalShapes
from jaximu.calibration.thermal_terms import HISTORY, LEARNED, POWERS, RATES, SCALE, ThermalTerm, history
from jaximu.data.rest_blocks import Leg, RestBlocks
from jaximu.estimation.leave_out import off, orthonormal
from jaximu.ground.array_types import FloatArray
from jaximu.ground.quantities import listed, number
from jaximu.ground.vectors import column_lengths

_TOLD = 0.05
"""Share of a shape that smooth functions of temperature must leave of it."""
ENOUGH = 0.1
"""Share of a shape that must be left beside all others for its coefficient to be worth having."""
_LISTED = 6  # ways of the temperature that are listed one by one
_WORDS = {
    "temperature_rate": "the rate of temperature",
    "temperature_rate_squared": "the square of that rate",
    "temperature_times_rate": "temperature times its rate",
    "thermal_lag": "a lag",
    "thermal_hysteresis": "a hysteresis",
}


class Separation(NamedTuple):
    """What a path shows of an effect: the share of its shape that smooth functions of temperature and drift leave.

    apart: the share that all other effects leave as well; information: that part, squared and summed over time.
    """

    alone: float
    apart: float
    information: float


@dataclass(frozen=True)
class Identifiability:
    """What a path of temperature determines.

    told: effects that can be fitted. words: sentences. legs: the ways of the temperature. parts: what the path shows of
    each effect.
    """

    told: tuple[str, ...]
    words: tuple[str, ...]
    legs: tuple[Leg, ...]
    parts: dict[str, Separation]


def separated(shapes: ThermalShapes) -> dict[str, Separation]:
    """Return by effect what the path of temperature shows of it: the information that nuisance terms leave.

    Nuisance is what is free in any fit: the levels of the rests, a slow drift of each recording, and any smooth
    function of temperature; then all other effects as well. Lag and hysteresis count at the inner parameter that is
    seen best beside temperature, and beside other effects in the middle of the range of inner parameters.
    """
    blocks = shapes.blocks
    root = np.sqrt(blocks.stop - blocks.start)[:, None]
    levels = blocks.of_level
    drift = np.eye(int(blocks.log.max()) + 1)[blocks.log] * (blocks.start / abs(blocks.stop).max())[:, None]
    mean = orthonormal(root * levels)
    base = orthonormal(root * np.hstack([levels, drift, shapes.smooth()]))
    grids: dict[str, list[ThermalTerm]] = {name: [ThermalTerm(name)] for name in RATES}
    grids |= {name: [history(name, value) for value in values] for name, values in shapes.grids.items()}
    columns = {name: [root[:, 0] * shapes.column(term)[0] for term in grid] for name, grid in grids.items()}
    middle = {name: options[len(options) // 2] for name, options in columns.items()}
    separations = {}
    for name, options in columns.items():
        # a rate counts from standing still, a lag and a play, like temperature, from wherever they are
        whole = [_length(option if name in RATES else off(mean, option)) for option in options]
        alone = max(_length(off(base, option)) / size for option, size in zip(options, whole, strict=True))
        others = np.column_stack([off(base, column) for other, column in middle.items() if other != name])
        # what rounding leaves of a shape is no shape
        others = others[:, column_lengths(others) > 1e-9 * max(map(_length, middle.values()))]
        left = _length(off(orthonormal(others), off(base, middle[name])))
        separations[name] = Separation(alone, left / whole[len(options) // 2], left**2)
    return separations


def _length(column: FloatArray) -> float:
    return max(float(np.linalg.norm(column)), 1e-300)


def identifiable(blocks: RestBlocks, shapes: ThermalShapes) -> Identifiability:
    """Say before any fit which thermal effects the path of temperature distinguishes from smooth functions of it."""
    parts = separated(shapes)
    legs = blocks.legs()
    observable = [*POWERS, LEARNED, *(name for name, part in parts.items() if part.alone > _TOLD)]
    if len(legs) > _LISTED:
        low, high = blocks.range
        fast = 60 * float(abs(blocks.rate).max())
        span = f"{low:.0f} and {high:.0f} °C".replace("-", "−")
        words = [f"The temperature went {len(legs)} ways up and down between {span}, at up to {fast:.2g} K/min."]
    else:
        words = [f"The temperature went {'; '.join(map(str, legs))}."]
    share = max(part.alone for part in parts.values())
    alike = [name for name in (*RATES, *HISTORY) if name in observable and parts[name].apart < ENOUGH]
    hidden = [name for name in (*RATES, *HISTORY) if name not in observable]
    if len(hidden) == len(parts):
        words.append(
            "Over this path the rate of temperature, a lag and a hysteresis are functions of temperature, to "
            f"{number(max(100 * share, 0.1), 2)} %: this recording cannot separate them, nor the warm-up after "
            "power-on, from bias over temperature. The fit is their sum, and holds for this way and rate of change "
            "only. Record a cycle: the same range up and down, then again at another rate."
        )
    elif hidden or alike:
        separate = [_WORDS[name] for name in (*RATES, *HISTORY) if name not in hidden and name not in alike]
        sentences = [f"This path of temperature separates {listed(separate)}."] if separate else []
        if hidden:
            lacking = listed([_WORDS[name] for name in hidden], "or")
            sentences.append(f"It cannot separate {lacking} from plain temperature dependence.")
        if alike:
            share = number(100 * (1 - min(parts[name].apart for name in alike)), 2)
            sentences.append(f"The other effects imitate {listed([_WORDS[name] for name in alike])} to {share} %.")
        sentences += ["Record a cycle, then again at another rate, to separate them."] if hidden else []
        words.append(" ".join(sentences))
    else:
        words.append("This path of temperature separates every rate term, a lag and a hysteresis.")
    base, mean = orthonormal(np.hstack([blocks.of_level, shapes.smooth()])), orthonormal(blocks.of_level)
    scale = max(_length(off(base, column)) / _length(off(mean, column)) for column in shapes.column(ThermalTerm(SCALE)))
    if scale > _TOLD and blocks.several_poses:
        observable.append(SCALE)
    else:
        words.append(
            "What the accelerometer shows of temperature is bias and, along gravity, scale, and across it, "
            "tilt of the mounting: in one pose they stay unresolved. Poses with each axis up and down at the same "
            "temperatures would separate them."
        )
    return Identifiability(tuple(observable), tuple(words), tuple(legs), parts)
