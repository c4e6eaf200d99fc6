"""The shapes that thermal effects take over the blocks of a recording, as their own terms give them along its path."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import jax
import jax.numpy as jnp
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
    net_of,
)
from jaximu.data.rest import mean_terms, padded_count
from jaximu.data.rest_blocks import RestBlocks
from jaximu.estimation.track import Track
from jaximu.ground import stored
from jaximu.ground.array_types import FloatArray
from jaximu.model.effects import CATALOGUE
from jaximu.model.effects.learned import ZERO_CELSIUS
from jaximu.model.effects.network import WEIGHTS
from jaximu.model.stimulus import Stimulus

__all__ = ["GRID", "ThermalShapes"]

GRID = 12
"""Values of an inner parameter that are tried at once."""


def _shapes(names: Sequence[str], count: int, track: Track, *grids):
    """Return of each effect the mean shapes over `count` blocks, (G, n, 3, k), at inner parameters (G, i).

    They count from the reference temperature, those of a curve, too.
    """
    celsius = track.stimulus.temperature_reference
    reference = Stimulus(
        jnp.zeros(3),
        temperature=jnp.asarray(celsius),
        temperature_rate=jnp.zeros(()),
        time=jnp.zeros(()),
        temperature_reference=celsius,
    )

    def at(kind, values):
        def of(share):
            effect = kind(jnp.tile(share, 3), **dict(zip(kind.inner, values, strict=True)))
            return track.means(effect.term(track.stimulus) - effect.term(reference), count)

        return jax.vmap(of, out_axes=-1)(jnp.eye(kind.size // 3))

    kinds = [CATALOGUE[f"accel.{name}"] for name in names]
    return tuple(
        at(kind, grid[0])[None] if len(grid) == 1 else jax.lax.map(partial(at, kind), grid)
        for kind, grid in zip(kinds, grids, strict=True)
    )


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
        fastest = float(np.max(np.abs(blocks.rate)))
        self.bounds = {"low": low + ZERO_CELSIUS, "high": high + ZERO_CELSIUS, "reach": fastest}
        self.force = blocks.by_rest(blocks.means["accelerometer"])
        self.tracks = blocks.tracks(self.force, reference)
        self._columns: dict[ThermalTerm, FloatArray] = {}
        none, curve = np.zeros((1, 0)), np.array([[self.bounds["low"], self.bounds["high"]]])
        self._add(dict.fromkeys((*POWERS, *RATES, SCALE), none) | {LEARNED: curve})
        self.prepare({})
        celsius, rates = np.append(blocks.temperature, reference), np.append(blocks.rate, 0.0)
        inputs = np.stack([(2 * celsius - low - high) / (high - low), rates / max(fastest, 1e-12)], axis=1)
        inputs = np.clip(inputs, -1.0, 1.0)
        self.inputs, self.origin = inputs[:-1], inputs[-1]
        self._nets: dict[Net, tuple[FloatArray, FloatArray]] = {}

    def prepare(self, tried: Mapping[str, FloatArray]) -> dict[str, list[ThermalTerm]]:
        """Return terms of effects with memory at values (12,) of their inner parameters."""
        values = {**self.grids, **tried}
        values |= {name: values[leader] for name, leader in BESIDE.items()}
        self._add({name: grid[:, None] for name, grid in values.items()})
        return {name: [history(name, value) for value in values] for name, values in tried.items()}

    def _add(self, grids: Mapping[str, FloatArray]) -> None:
        """Take the shapes of effects at inner parameters (G, i)."""
        count, names = len(self.blocks), tuple(grids)
        rows = padded_count(count)
        of, key = partial(_shapes, names, rows), f"thermal {','.join(names)} {rows}"
        recordings = [stored.call(of, key, track, *grids.values()) for track in self.tracks]
        for name, grid, *parts in zip(names, grids.values(), *recordings, strict=True):
            for values, columns in zip(grid, np.sum([part[:, :count] for part in parts], axis=0), strict=True):
                term = history(name, values[0]) if memories([name]) else ThermalTerm(name)
                for shape, column in enumerate(columns.T):  # (3, n)
                    self._columns[term._replace(shape=shape) if name == LEARNED else term] = column

    def column(self, term: ThermalTerm) -> FloatArray:
        """Return the shape (3, n) of a term, axis by axis."""
        if term.net is not None:
            return self.network(term.net)[1][:, :, term.shape]
        if term not in self._columns:
            self.prepare({BESIDE.get(term.name, term.name): np.full(GRID, term.inner[0][1])})
        return self._columns[term]

    def network(self, net: Net) -> tuple[FloatArray, FloatArray]:
        """Return a network's outputs (3, n) over the blocks and their derivatives (3, n, 16) by its weights."""
        if net not in self._nets:
            blocks, missing = self.blocks, padded_count(len(self.blocks)) - len(self.blocks)
            celsius, rate = (np.pad(values, (0, missing), "edge") for values in (blocks.temperature, blocks.rate))
            stimulus = Stimulus(temperature=celsius, temperature_rate=rate, temperature_reference=self.reference)
            effect = CATALOGUE[f"accel.{NETWORK}"](np.array(net.weights), **self.bounds)
            track = Track(stimulus, np.arange(len(celsius)))
            value, slopes = mean_terms([effect], [track], len(blocks))
            by_axis = [slopes[:, axis, axis * WEIGHTS : (axis + 1) * WEIGHTS] for axis in range(3)]
            self._nets[net] = value.T, np.stack(by_axis)
        return self._nets[net]

    def offset(self, terms: Sequence[ThermalTerm]) -> FloatArray:
        """Return what a network linearised among the terms is beside weights times shapes, (3, n), SI."""
        net = net_of(terms)
        if net is None:
            return np.zeros((3, len(self.blocks)))
        value, slope = self.network(net)
        return value - np.einsum("ank,ak->an", slope, np.reshape(net.weights, (3, WEIGHTS)))

    def smooth(self) -> FloatArray:
        """Return what a smooth function of temperature may be (n, 9)."""
        return np.stack([self.column(ThermalTerm(LEARNED, (), k))[0] for k in range(SPLINES)], axis=1)

    def generous(self) -> FloatArray:
        """Return what temperature may plausibly do (n, 15), to tell noise from it.

        Not more: over a cycle or two some thirty shapes would swallow all slow noise there is.
        """
        few = [ThermalTerm(name) for name in RATES]
        few += [history("thermal_lag", self.grids["thermal_lag"][k]) for k in (GRID // 3, 2 * GRID // 3)]
        few.append(history("thermal_hysteresis", self.grids["thermal_hysteresis"][GRID // 2]))
        return np.column_stack([self.smooth(), *(self.column(term)[0] for term in few)])
