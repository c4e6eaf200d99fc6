"""Which ramp to record next: each is simulated, and asked what it would tell of the effects that are tied now.

Information about an effect is what all others, levels and smooth functions of temperature leave of its shape, squared
and summed over time: with white noise it is in proportion to one over the variance of the effect's coefficient. A
recording to come is worth half the logarithm of the factor by which it grows (nats; Lindley, Ann. Math. Statist. 27,
1956, 986–1005), summed over the effects that are hardly told now.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaximu.calibration.identifiability import ENOUGH, Separation, separated
from jaximu.calibration.thermal_shapes import ThermalShapes
from jaximu.data.rest_blocks import RestBlocks, joined
from jaximu.estimation.track import Track
from jaximu.ground.differences import midpoints
from jaximu.model.stimulus import Stimulus

_BLOCKS = 60  # of each way
_RATES = {1.0: "at the same rate", 2.0: "twice as quickly", 0.5: "half as quickly", 0.25: "at a quarter of the rate"}
_SOAK = 0.2  # of a way's duration, before and after each


@dataclass(frozen=True)
class Ramp:
    """A recording that could be made next, and what it shows of each effect, together with those there are.

    gain: nats that it adds about effects that are hardly told now. duration: s.
    """

    text: str
    duration: float
    parts: dict[str, Separation]
    gain: float


def next_ramps(blocks: RestBlocks) -> tuple[dict[str, Separation], tuple[Ramp, ...]]:
    """Return what the recordings show of each effect now, and the ramps that could come next, most telling first.

    Ramps are tried over the same range from a quarter to twice the rate, one way and back; the gain is by the root
    of all recordings' duration, as what more of the same adds grows with it.
    """
    low, high = blocks.range
    legs = blocks.legs()
    rate = float(np.median([abs(leg.rate) for leg in legs]))
    length = sum(blocks.spans)
    shapes = ThermalShapes(blocks, float(np.mean(blocks.range)))
    now = separated(shapes)
    weak = [name for name, separation in now.items() if separation.apart < ENOUGH] or list(now)
    # a thousandth of its shape is nothing known of an effect: what rounding leaves is no information
    known = {name: now[name].information * max(1.0, 1e-6 / max(now[name].apart, 1e-12) ** 2) for name in weak}
    first = "cool" if legs[-1].up else "warm"
    ends = (high, low, high) if first == "cool" else (low, high, low)
    options = []
    for factor, words in _RATES.items():
        for ways in (1, 2):
            tried, duration = _with(blocks, ends[: ways + 1], rate * factor)
            text = f"{first} from {ends[0]:.0f} to {ends[1]:.0f} °C {words} ({60 * factor * rate:.2g} K/min)"
            text = text.replace("-", "−") + ", and back" * (ways == 2)
            parts = separated(ThermalShapes(tried, shapes.reference, shapes))
            gain = sum(0.5 * np.log(parts[name].information / known[name]) for name in weak)
            options.append(Ramp(text, duration, parts, float(gain)))
    return now, tuple(sorted(options, key=lambda ramp: -ramp.gain / np.sqrt(length + ramp.duration)))


def _with(blocks: RestBlocks, ends: Sequence[float], rate: float) -> tuple[RestBlocks, float]:
    """Return the blocks with those of one more recording, straight ways with a soak at each end, and its length, s."""
    steps = abs(ends[1] - ends[0]) / rate * np.tile([_SOAK, 1.0], len(ends))[: 2 * len(ends) - 1]
    knots = np.cumulative_sum(steps, include_initial=True)
    count = _BLOCKS * (len(ends) - 1)
    edges = np.linspace(0.0, knots[-1], 8 * count + 1)
    time = midpoints(edges)
    path = np.interp(time, knots, np.repeat(ends, 2))
    slope = np.gradient(path, time)
    celsius, rates = (values.reshape(count, 8).mean(axis=1) for values in (path, slope))
    means = {name: np.tile(values[-1], (count, 1)) for name, values in blocks.means.items()}
    none = np.zeros(count, np.int64)
    track = Track(Stimulus(temperature=path, temperature_rate=slope, time=time), np.arange(8 * count) // 8)
    more = RestBlocks(
        (), edges[:-1:8], edges[8::8], none, none, none, celsius, rates, means, (track,), None, blocks.duration, 0, ()
    )
    return joined([blocks, more]), float(knots[-1])
