"""The shapes that thermal effects take over the blocks of a recording, as their own terms give them along its path."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from jaximu.calibration.thermal_terms import (
    BESIDE,
    HISTORY,
    LEARNED,
    NETWORK,
    POWERS,
    RATES,
    SCALE,
    SPLINES,
    Net,
    ThermalTerm,
    history,
    memories,
)
from jaximu.data.rest import mean_terms, over_blocks, padded_count
from jaximu.data.rest_blocks import RestBlocks
from jaximu.estimation.track import Track
from jaximu.ground.array_types import FloatArray
from jaximu.model.effects import CATALOGUE
from jaximu.model.effects.learned import ZERO_CELSIUS, AccelLearnedTemperature
from jaximu.model.effects.network import WEIGHTS
from jaximu.model.stimulus import Stimulus

GRID = 12
"""Values of an inner parameter that are tried at once."""


class ThermalShapes:
    """The shapes of all thermal effects over the blocks of a recording.

    **Arguments:** `reference`: °C from which they count; `like`: shapes whose inner parameters are tried here, too.

    grids: values (12,) of the inner parameter of each effect with memory that are tried first. bounds: inner parameters
    of a learned effect that say where it was learned, K and K/s. force (n, 3): gravity, near enough for what changes it
    by a share. inputs (n, 2), origin (2,): a network's, in the blocks and at the reference.
    """

    def __init__(self, blocks: RestBlocks, reference: float, like: ThermalShapes | None = None):
        self.blocks, self.reference = blocks, reference
        low, high = blocks.range
        duration = max(blocks.spans)
        # a lag shorter than the path's own nodes is none; one as long as the recording is drift
        spans = {
            "s": np.geomspace(max(blocks.duration / 2, 1e-3 * duration), 0.4 * duration, GRID),
            "K": np.geomspace(0.01, 0.45, GRID) * (high - low),
        }
        units = {name: CATALOGUE[f"accel.{name}"].inner[inner].unit for name, inner in HISTORY.items()}
        self.grids = {name: spans[unit] for name, unit in units.items()} if like is None else like.grids
        fastest = float(abs(blocks.rate).max())
        self.bounds = {"low": low + ZERO_CELSIUS, "high": high + ZERO_CELSIUS, "reach": fastest}
        self.force = blocks.by_rest(blocks.means["accelerometer"])
        self.tracks = blocks.tracks(self.force, reference)
        self._columns: dict[ThermalTerm, FloatArray] = {}
        none, curve = np.zeros((1, 0)), np.array([[self.bounds["low"], self.bounds["high"]]])
        self._add(dict.fromkeys((*POWERS, *RATES, SCALE), none) | {LEARNED: curve})
        learned = AccelLearnedTemperature(np.zeros(3 * SPLINES), *curve[0])
        there = np.asarray(learned.shapes(np.asarray(reference + ZERO_CELSIUS)))
        for k, value in enumerate(there):  # a curve need not be zero at the reference
            self._columns[ThermalTerm(LEARNED, shape=k)] -= value
        self.prepare(self.grids)
        celsius, rates = np.append(blocks.temperature, reference), np.append(blocks.rate, 0.0)
        inputs = np.column_stack([(2 * celsius - low - high) / (high - low), rates / max(fastest, 1e-12)])
        inputs = inputs.clip(-1.0, 1.0)
        self.inputs, self.origin = inputs[:-1], inputs[-1]
        self._nets: dict[Net, tuple[FloatArray, FloatArray]] = {}

    def prepare(self, tried: Mapping[str, FloatArray]) -> dict[str, list[ThermalTerm]]:
        """Return terms of effects with memory at values (12,) of their inner parameters."""
        values = {**tried, **{name: tried[leader] for name, leader in BESIDE.items() if leader in tried}}
        missing = {name: grid for name, grid in values.items() if history(name, grid[GRID // 2]) not in self._columns}
        self._add({name: grid[:, None] for name, grid in missing.items()})
        return {name: [history(name, value) for value in values] for name, values in tried.items()}

    def _add(self, grids: Mapping[str, FloatArray]) -> None:
        """Take the shapes of effects at inner parameters (G, i)."""
        for name, grid in grids.items():
            for shape, coefficients in enumerate(np.tile(np.eye(CATALOGUE[f"accel.{name}"].size // 3), 3)):
                numbers = np.column_stack([np.tile(coefficients, (len(grid), 1)), grid])
                (values,) = over_blocks(name, numbers, self.tracks, len(self.blocks))
                for inner, column in zip(grid, values, strict=True):
                    term = history(name, inner[0]) if memories([name]) else ThermalTerm(name)
                    self._columns[term._replace(shape=shape)] = column.T

    def column(self, term: ThermalTerm) -> FloatArray:
        """Return the shape (3, n) of a term, axis by axis."""
        if term.net is not None:
            return self.network(term.net)[1][:, :, term.shape]
        if term not in self._columns:
            self.prepare({BESIDE.get(term.name, term.name): np.full(GRID, term.inner)})
        return self._columns[term]

    def network(self, net: Net) -> tuple[FloatArray, FloatArray]:
        """Return a network's outputs (3, n) over the blocks and their derivatives (3, n, 16) by its weights."""
        if net not in self._nets:
            blocks, missing = self.blocks, padded_count(len(self.blocks)) - len(self.blocks)
            celsius, rate = (np.pad(values, (0, missing), "edge") for values in (blocks.temperature, blocks.rate))
            stimulus = Stimulus(temperature=celsius, temperature_rate=rate, temperature_reference=self.reference)
            effect = CATALOGUE[f"accel.{NETWORK}"](net.weights.ravel(), **self.bounds)
            value, slopes = mean_terms([effect], [Track(stimulus, np.arange(len(celsius)))], len(blocks))
            by_axis = [slopes[:, axis, axis * WEIGHTS : (axis + 1) * WEIGHTS] for axis in range(3)]
            self._nets[net] = value.T, np.stack(by_axis)
        return self._nets[net]

    def smooth(self) -> FloatArray:
        """Return what a smooth function of temperature may be (n, 9)."""
        return np.column_stack([self.column(ThermalTerm(LEARNED, shape=k))[0] for k in range(SPLINES)])

    def generous(self) -> FloatArray:
        """Return what temperature may plausibly do (n, 15), to tell noise from it.

        Not more: over a cycle or two some thirty shapes would swallow all slow noise there is.
        """
        few = [ThermalTerm(name) for name in RATES]
        few += [history("thermal_lag", self.grids["thermal_lag"][k]) for k in (GRID // 3, 2 * GRID // 3)]
        few.append(history("thermal_hysteresis", self.grids["thermal_hysteresis"][GRID // 2]))
        return np.column_stack([self.smooth(), *(self.column(term)[0] for term in few)])
