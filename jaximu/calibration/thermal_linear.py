"""The linear problem of a triad's bias over temperature: levels and shapes against whitened blocks, axis by axis."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from jaximu.calibration.thermal_shapes import ThermalShapes
from jaximu.calibration.thermal_terms import Model, ThermalTerm, net_of
from jaximu.data.rest_blocks import RestBlocks
from jaximu.estimation.leave_out import LeftOut, leave_out, off, orthonormal
from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.ground.vectors import column_lengths
from jaximu.model.noise_model import NoiseModel


@dataclass(frozen=True)
class Held:
    """Stretches left out in turn, by axis (3,).

    rms: SI, of the outputs left out, corrected by the terms as fitted without them, about the mean of each rest.
    by_axis: log-likelihood of their prediction, nats, which knows slow noise from what lies beside.
    """

    rms: FloatArray
    by_axis: FloatArray

    @property
    def log_likelihood(self) -> float:
        """Of the three axes, nats."""
        return float(self.by_axis.sum())


class Whitened:
    """A triad's blocks, whitened by the covariance of its noise, axis by axis."""

    def __init__(self, blocks: RestBlocks, name: str, noise: NoiseModel, shapes: ThermalShapes):
        self.blocks, self.name, self.shapes = blocks, name, shapes
        self.means = blocks.means[name]
        self.root = np.linalg.inv(np.linalg.cholesky(blocks.covariance(getattr(noise, name))))  # (3, n, n)
        self.levels = self.root @ blocks.of_level
        self.output = (self.root @ self.means.T[:, :, None])[..., 0]
        self._columns: dict[ThermalTerm, FloatArray] = {}

    def column(self, term: ThermalTerm) -> FloatArray:
        """Return the whitened shape (3, n) of a term."""
        if term not in self._columns:
            self._columns[term] = (self.root @ self.shapes.column(term)[:, :, None])[..., 0]
        return self._columns[term]

    def design(self, axis: int, terms: Sequence[ThermalTerm]) -> FloatArray:
        """Return an axis's whitened levels and shapes (n + p, L + k): then a row for each weight known before."""
        data = np.column_stack([self.levels[axis], *(self.column(term)[axis] for term in terms)])
        known = [0.0 if term.net is None else 1 / term.net.prior[axis, term.shape] for term in terms]
        known = np.array([0.0] * self.blocks.levels + known)
        return np.concatenate([data, np.diag(known)[known > 0]])

    def target(self, axis: int, terms: Sequence[ThermalTerm]) -> FloatArray:
        """Return what the design times levels and coefficients should be (n + p,): weights count from the network's."""
        if (net := net_of(terms)) is None:
            return self.output[axis]
        beyond = self.output[axis] - self.root[axis] @ self.shapes.network(net)[0][axis]
        return np.concatenate([beyond, -net.weights[axis] / net.prior[axis]])

    def coefficients(self, axis: int, terms: Sequence[ThermalTerm]) -> FloatArray:
        """Return an axis's coefficients (k,); the weights of a network are those about which it is linear."""
        net, plain = net_of(terms), [term for term in terms if term.net is None]
        design = self.design(axis, plain)
        size = np.maximum(column_lengths(design), 1e-300)
        numbers = np.linalg.lstsq(design / size, self.target(axis, terms)[: len(design)], rcond=1e-10)[0] / size
        return np.concatenate([numbers[self.blocks.levels :], np.zeros(0) if net is None else net.weights[axis]])

    def residual(self, axis: int, terms: Sequence[ThermalTerm]) -> FloatArray:
        """Return what least squares leaves of an axis's whitened outputs (n,)."""
        return off(orthonormal(self.design(axis, terms)), self.target(axis, terms))[: len(self.blocks)]

    def misfit(self, axis: int, terms: Sequence[ThermalTerm]) -> float:
        """Return the sum of squares that least squares leaves of an axis."""
        return float((self.residual(axis, terms) ** 2).sum())

    def reduced(self, terms: Sequence[ThermalTerm]) -> Callable[[int, Sequence[ThermalTerm]], float]:
        """Return the misfit of any few of many terms, as a function that works on the triangle of their columns."""
        unique, levels = list(dict.fromkeys(terms)), range(self.blocks.levels)
        columns = {term: len(levels) + k for k, term in enumerate(unique)}
        both = [np.column_stack([self.design(axis, unique), self.output[axis]]) for axis in range(3)]
        triangles = [np.asarray(np.linalg.qr(one, mode="r")) for one in both]

        def misfit(axis: int, terms: Sequence[ThermalTerm]) -> float:
            inside = triangles[axis][:, [*levels, *(columns[term] for term in terms)]]
            return float((off(orthonormal(inside), triangles[axis][:, -1]) ** 2).sum())

        return misfit

    def held_out(self, model: Model, folds: Sequence[IntArray], scale: FloatArray) -> Held:
        """Predict each fold from all other blocks, noise that they share included; `scale` (3,): of its variance."""
        count, levels = len(self.blocks), self.blocks.levels
        likelihood, errors = np.zeros(3), np.full((3, count), np.nan)
        for axis, terms in enumerate(model):
            net = net_of(terms)
            about = 0.0 if net is None else self.shapes.network(net)[0][axis]
            shapes = np.array([self.shapes.column(term)[axis] for term in terms]).reshape(len(terms), count)
            for part in self.left_out(axis, terms, folds):
                left = self.means[:, axis] - about - part.numbers[levels:] @ shapes
                errors[axis, part.rows] = left[part.rows]
                likelihood[axis] += part.log_likelihood(scale[axis])
        for level in range(levels):
            inside = self.blocks.level == level
            if not np.isnan(errors[:, inside]).all():
                errors[:, inside] -= np.nanmean(errors[:, inside], axis=1)[:, None]
        return Held(np.sqrt(np.nanmean(errors**2, axis=1)), likelihood)

    def left_out(self, axis: int, terms: Sequence[ThermalTerm], folds: Sequence[IntArray]) -> Iterator[LeftOut]:
        """Yield how all other blocks predict each fold; numbers: levels, then coefficients."""
        return leave_out(self.root[axis], self.design(axis, terms), self.target(axis, terms), folds)
