"""Which ramp to record next: each is simulated, and asked what it would tell of the effects that are tied now.

Information about an effect is what all others, levels and smooth functions of temperature leave of its shape, squared
and summed over time: with white noise it is in proportion to one over the variance of the effect's coefficient. A
recording to come is worth half the logarithm of the factor by which it grows (nats; Lindley, Ann. Math. Statist. 27,
1956, 986–1005), summed over the effects that are hardly told now.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from jaximu.thermal.identifiability import ENOUGH, separated
from jaximu.thermal.rest import RestBlocks
from jaximu.thermal.shapes import ThermalShapes

__all__ = ["Ramp", "next_ramps"]

FloatArray = NDArray[np.float64]
_BLOCKS = 60  # of each way
_RATES = {1.0: "at the same rate", 2.0: "twice as quickly", 0.5: "half as quickly", 0.25: "at a quarter of the rate"}
_SOAK = 0.2  # of a way's duration, before and after each


@dataclass(frozen=True)
class Ramp:
    """A recording that could be made next, with what it leaves, together with those there are, of each effect's shape.

    left: by effect, the share of its shape that a smooth function of temperature and all other effects do not imitate.
    information: by effect, what is left, squared and summed over time. gain: nats that it adds about effects that are
    hardly told now. duration: s.
    """

    text: str
    duration: float
    left: dict[str, float]
    information: dict[str, float]
    gain: float = 0.0

    @property
    def least(self) -> float:
        """The share of the effect that stays hardest to tell."""
        return min(self.left.values())


def next_ramps(blocks: RestBlocks) -> tuple[Ramp, tuple[Ramp, ...]]:
    """Return what the recordings leave now, and the ramps that could come next, most telling first.

    Ramps are tried over the same range from a quarter to twice the rate, one way and back; the gain is by the root
    of all recordings' duration, as what more of the same adds grows with it.
    """
    low, high = blocks.range
    legs = blocks.legs()
    rate = float(np.median([abs(leg.rate) for leg in legs]))
    length = sum(float(np.ptp(path[0])) for path in blocks.paths)
    shapes = ThermalShapes(blocks, float(np.mean(blocks.range)))
    now = Ramp("what was recorded", length, *_left(shapes))
    weak = [name for name, share in now.left.items() if share < ENOUGH] or list(now.left)
    first = "cool" if legs[-1].up else "warm"
    ends = (high, low, high) if first == "cool" else (low, high, low)
    options = []
    for factor, words in _RATES.items():
        for ways in (1, 2):
            time, kelvin = _course(ends[: ways + 1], rate * factor)
            text = f"{first} from {ends[0]:.0f} to {ends[1]:.0f} °C {words} ({60 * factor * rate:.2g} K/min)"
            text += ", and back" if ways == 2 else ""
            left, information = _left(ThermalShapes(_with(blocks, time, kelvin), shapes.reference, shapes))
            # a thousandth of its shape is nothing known of an effect: what rounding leaves is no information
            known = {n: now.information[n] * max(1.0, 1e-6 / max(now.left[n], 1e-12) ** 2) for n in weak}
            gain = sum(0.5 * np.log(information[n] / known[n]) for n in weak)
            options.append(Ramp(text, float(time[-1]), left, information, float(gain)))
    return now, tuple(sorted(options, key=lambda each: -each.gain / np.sqrt(length + each.duration)))


def _course(knots: tuple[float, ...], rate: float) -> tuple[FloatArray, FloatArray]:
    """Straight ways with a soak before and after each."""
    way = abs(knots[1] - knots[0]) / rate
    time, kelvin = [0.0, _SOAK * way], [knots[0], knots[0]]
    for knot in knots[1:]:
        time += [time[-1] + way, time[-1] + (1 + _SOAK) * way]
        kelvin += [knot, knot]
    return np.array(time), np.array(kelvin)


def _with(blocks: RestBlocks, knots: FloatArray, kelvin: FloatArray) -> RestBlocks:
    """Return the blocks with those of one more recording that goes straight between knots (k,) s, °C."""
    count = _BLOCKS * max(1, (len(knots) - 2) // 2)
    edges = np.linspace(0.0, knots[-1], 8 * count + 1)
    time = (edges[1:] + edges[:-1]) / 2
    path = np.interp(time, knots, kelvin)
    rate = np.gradient(path, time)
    before = len(blocks)
    place = before + np.arange(8 * count) // 8
    means = {name: np.concatenate([values, np.tile(values[-1], (count, 1))]) for name, values in blocks.means.items()}
    paths = [(*each[:3], np.where(each[3] == before, before + count, each[3])) for each in blocks.paths]
    return replace(
        blocks,
        start=np.concatenate([blocks.start, edges[:-1:8]]),
        stop=np.concatenate([blocks.stop, edges[8::8]]),
        log=np.concatenate([blocks.log, np.full(count, blocks.log.max() + 1)]),
        level=np.concatenate([blocks.level, np.full(count, blocks.levels)]),
        temperature=np.concatenate([blocks.temperature, path.reshape(count, 8).mean(axis=1)]),
        rate=np.concatenate([blocks.rate, rate.reshape(count, 8).mean(axis=1)]),
        means=means,
        paths=(*paths, (time, path, rate, place)),
    )


def _left(shapes: ThermalShapes) -> tuple[dict[str, float], dict[str, float]]:
    """Return by effect the share of its shape that is left, and the information about it."""
    parts = separated(shapes)
    return {name: each.apart for name, each in parts.items()}, {name: each.information for name, each in parts.items()}
