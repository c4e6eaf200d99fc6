"""The shapes that thermal effects take over the blocks of a recording, as their own terms give them along its path."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaximu import stored
from jaximu.effects import CATALOGUE, Effect
from jaximu.effects.learned import ZERO_CELSIUS, AccelLearnedTemperature
from jaximu.effects.network import WEIGHTS
from jaximu.sensor import Stimulus
from jaximu.thermal import network
from jaximu.thermal.network import Net
from jaximu.thermal.rest import RestBlocks
from jaximu.thermal.terms import HISTORY, LEARNED, POWERS, RATES, SCALE, SPLINES, Term, history

__all__ = ["GRID", "ThermalShapes"]

FloatArray = NDArray[np.float64]
GRID = 12
"""Values of an inner parameter that are tried at once."""
_BUCKET = 8192


class _Path(NamedTuple):
    stimulus: Stimulus
    place: NDArray[np.int64]


def _paths(blocks: RestBlocks, reference: float) -> list[_Path]:
    found = []
    for time, kelvin, rate, place in blocks.paths:
        missing = -len(time) % _BUCKET
        step = float(time[1] - time[0])
        later = np.concatenate([time, time[-1] + step * np.arange(1, missing + 1)])
        stimulus = Stimulus(
            temperature=np.pad(kelvin - reference, (0, missing), "edge"),  # pyright: ignore[reportArgumentType]
            temperature_rate=np.pad(rate, (0, missing)),  # pyright: ignore[reportArgumentType]
            time=later,  # pyright: ignore[reportArgumentType]
            temperature_reference=0.0,  # whatever it is: one compiled function
        )
        found.append(_Path(stimulus, np.pad(place, (0, missing), constant_values=len(blocks))))
    return found


def _shapes(stimulus: Stimulus, place, lags, widths, span, reference, counter):
    """Mean shapes over the blocks: (n, 6) powers and rates, (n, 9) of the curve, (n, G) lags, (n, G) plays."""
    count = len(counter)

    def means(values):
        number = jax.ops.segment_sum(jnp.ones(len(place)), place, count)
        return jax.ops.segment_sum(values, place, count) / jnp.maximum(number, 1.0)[:, None]

    def shape(name, **inner):
        kind = CATALOGUE[f"accel.{name}"]
        return kind(jnp.ones(kind.size), **inner).term(stimulus)[:, 0]

    plain = jnp.stack([shape(name) for name in (*POWERS, *RATES)], axis=1)
    curve = AccelLearnedTemperature(jnp.zeros(3 * SPLINES), low=span[0], high=span[1])
    absolute = reference + ZERO_CELSIUS
    curves = curve.shapes(stimulus.temperature + absolute) - curve.shapes(absolute)
    lagged = jax.lax.map(lambda value: shape("thermal_lag", time_constant=value), lags).T
    played = jax.lax.map(lambda value: shape("thermal_hysteresis", half_width=value), widths).T
    return tuple(means(each) for each in (plain, curves, lagged, played))


class ThermalShapes:
    """The shapes of all thermal effects over the blocks of a recording.

    **Arguments:** `reference`: °C from which they count; `like`: shapes whose inner parameters are tried here, too.
    """

    def __init__(self, blocks: RestBlocks, reference: float, like: ThermalShapes | None = None):
        self.blocks, self.reference = blocks, reference
        self.paths = _paths(blocks, reference)
        low, high = (float(bound) for bound in blocks.range)
        self.span = np.array([low, high]) + ZERO_CELSIUS
        duration = max(float(np.ptp(path[0])) for path in blocks.paths)
        # a lag shorter than the path's own nodes is none; one as long as the recording is drift
        self.lags = np.geomspace(max(blocks.duration / 2, 1e-3 * duration), 0.4 * duration, GRID)
        self.widths = np.geomspace(0.01, 0.45, GRID) * (high - low)
        if like is not None:
            self.lags, self.widths = like.lags, like.widths
        self._plain, self._curves, lagged, played = self._computed(self.lags, self.widths)
        level = blocks.level
        poses = np.stack([blocks.means["accelerometer"][level == k].mean(axis=0) for k in range(blocks.levels)])
        self.force = poses[level]  # (n, 3): gravity along each axis, near enough for what changes it by a share
        self.reach = float(np.max(np.abs(blocks.rate)))
        self.inputs, self.origin = self._scaled(blocks.temperature, blocks.rate), self._scaled(reference, 0.0)
        self._nets: dict[Net, tuple[FloatArray, FloatArray]] = {}
        self._history: dict[Term, FloatArray] = {}
        for (name, grid), columns in zip(self.grids.items(), (lagged, played), strict=True):
            self._history |= {history(name, value): each for value, each in zip(grid, columns.T, strict=True)}

    def _computed(self, lags: FloatArray, widths: FloatArray) -> list[FloatArray]:
        count = len(self.blocks)
        counter = np.zeros(count + 1 + -(count + 1) % 1024)
        total: list[FloatArray] = []
        for stimulus, place in self.paths:
            found = stored.call(_shapes, "thermal shapes", stimulus, place, lags, widths, self.span,
                                np.asarray(self.reference), counter)  # fmt: skip
            parts = [np.asarray(each)[:count] for each in found]
            total = parts if not total else [a + b for a, b in zip(total, parts, strict=True)]
        return total

    def _scaled(self, kelvin, rate) -> FloatArray:
        """Return a network's inputs (..., 2) at temperatures (...), °C, and rates, K/s."""
        low, high = self.span - ZERO_CELSIUS
        both = np.broadcast_arrays((2 * np.asarray(kelvin) - low - high) / (high - low), rate / max(self.reach, 1e-12))
        return np.clip(np.stack(both, axis=-1), -1.0, 1.0)

    def network(self, net: Net) -> tuple[FloatArray, FloatArray]:
        """Return a network's outputs (3, n) over the blocks and their derivatives (3, n, 16) by its weights."""
        if net not in self._nets:
            self._nets[net] = network.values(net, self.inputs, self.origin)
        return self._nets[net]

    def offset(self, terms: Sequence[Term], place: tuple[FloatArray, float] | None = None) -> FloatArray:
        """Return what a network linearised among the terms is beside weights times shapes, (3, n), SI.

        Over the blocks, or at a place: temperatures (m,), °C, and a rate, K/s.
        """
        net = next((term.net for term in terms if term.net is not None), None)
        if net is None:
            return np.zeros((3, 1))
        value, slope = self.network(net) if place is None else network.values(net, self._scaled(*place), self.origin)
        return value - np.einsum("ank,ak->an", slope, np.reshape(net.weights, (3, WEIGHTS)))

    @property
    def grids(self) -> dict[str, FloatArray]:
        """Values (12,) of the inner parameter of each effect with memory that are tried first."""
        return {"thermal_lag": self.lags, "thermal_hysteresis": self.widths}

    def bounds(self, kind: type[Effect]) -> dict[str, np.float64]:
        """Return the inner parameters of a learned effect that say where it was learned: K, and K/s."""
        given = {"low": self.span[0], "high": self.span[1], "reach": self.reach}
        return {name: np.float64(given[name]) for name in kind.inner if name in given}

    def prepare(self, tried: dict[str, FloatArray]) -> dict[str, list[Term]]:
        """Return terms of effects with memory at values (12,) of their inner parameters."""
        grids = self.grids | tried
        found = self._computed(grids["thermal_lag"], grids["thermal_hysteresis"])
        terms = {name: [history(name, value) for value in values] for name, values in tried.items()}
        for name, own in terms.items():
            self._history |= dict(zip(own, found[2 if name == "thermal_lag" else 3].T, strict=True))
        return terms

    def column(self, term: Term) -> FloatArray:
        """Return the shape (n,) of a term; of one that is not the same for all axes, (3, n)."""
        if term.name == SCALE:
            return self._plain[:, 0] * self.force.T
        if term.net is not None:
            return self.network(term.net)[1][:, :, term.shape]
        if term.name == LEARNED:
            assert term.shape is not None
            return self._curves[:, term.shape]
        if term.name in HISTORY:
            if term not in self._history:
                value = term.inner[0][1]
                self.prepare({term.name: np.full(GRID, value)})
            return self._history[term]
        return self._plain[:, (*POWERS, *RATES).index(term.name)]

    def smooth(self) -> FloatArray:
        """Return what a smooth function of temperature may be (n, 9)."""
        return self._curves

    def generous(self) -> FloatArray:
        """Return what temperature may plausibly do (n, 15), to tell noise from it.

        Not more: over a cycle or two some thirty shapes would swallow all slow noise there is.
        """
        few = [history("thermal_lag", self.lags[k]) for k in (GRID // 3, 2 * GRID // 3)]
        few.append(history("thermal_hysteresis", self.widths[GRID // 2]))
        rates = self._plain[:, len(POWERS) :]
        return np.column_stack([self._curves, rates, *(self._history[term] for term in few)])
