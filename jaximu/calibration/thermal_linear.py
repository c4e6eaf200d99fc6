"""The linear problem of a triad's bias over temperature: levels and shapes against whitened blocks, axis by axis."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jaximu.calibration.thermal_shapes import ThermalShapes
from jaximu.calibration.thermal_terms import Model, ThermalTerm, net_of
from jaximu.data.rest_blocks import RestBlocks
from jaximu.estimation.leave_out import LeftOut, leave_out
from jaximu.ground.array_types import FloatArray
from jaximu.model.effects.network import WEIGHTS
from jaximu.model.noise_model import NoiseModel

__all__ = ["Held", "ReducedTerms", "Whitened"]


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
        return float(np.sum(self.by_axis))


class Whitened:
    """A triad's blocks, whitened by the covariance of its noise, axis by axis."""

    def __init__(self, blocks: RestBlocks, name: str, noise: NoiseModel, shapes: ThermalShapes):
        self.covariance = blocks.covariance(getattr(noise, name))
        self.blocks, self.name, self.shapes = blocks, name, shapes
        self.means = blocks.means[name]
        self.root = np.linalg.inv(np.linalg.cholesky(self.covariance))  # (3, n, n)
        self.levels = self.root @ np.eye(blocks.levels)[blocks.level]
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
        known = [(k, term) for k, term in enumerate(terms, self.blocks.levels) if term.net is not None]
        rows = np.zeros((len(known), data.shape[1]))
        for row, (k, term) in enumerate(known):
            assert term.net is not None and term.shape is not None
            rows[row, k] = 1 / np.reshape(term.net.prior, (3, WEIGHTS))[axis, term.shape]
        return np.concatenate([data, rows])

    def target(self, axis: int, terms: Sequence[ThermalTerm]) -> FloatArray:
        """Return what the design times levels and coefficients should be (n + p,)."""
        known = sum(term.net is not None for term in terms)
        output = self.output[axis]
        if known:
            output = output - self.root[axis] @ self.shapes.offset(terms)[axis]
        return np.pad(output, (0, known))

    def solve(self, axis: int, terms: Sequence[ThermalTerm]) -> tuple[FloatArray, FloatArray]:
        """Return an axis's levels and coefficients (L + k,) and whitened residuals (n,)."""
        return self._solve(self.design(axis, terms), self.target(axis, terms))

    def coefficients(self, axis: int, terms: Sequence[ThermalTerm]) -> FloatArray:
        """Return an axis's coefficients (k,); the weights of a network are those about which it is linear."""
        net = net_of(terms)
        if net is None:
            return self.solve(axis, terms)[0][self.blocks.levels :]
        output = self.output[axis] - self.root[axis] @ self.shapes.network(net)[0][axis]
        beside = self._solve(self.design(axis, terms[:-WEIGHTS]), output)[0][self.blocks.levels :]
        return np.concatenate([beside, np.reshape(net.weights, (3, WEIGHTS))[axis]])

    def misfit(self, axis: int, terms: Sequence[ThermalTerm]) -> float:
        """Return the sum of squares that least squares leaves of an axis."""
        return float(np.sum(self.solve(axis, terms)[1] ** 2))

    def _solve(self, design: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
        size = np.linalg.norm(design, axis=0)
        size = np.where(size > 0, size, 1.0)
        solved = np.linalg.lstsq(design / size, target, rcond=1e-10)[0]
        return solved / size, (target - design @ (solved / size))[: len(self.blocks)]

    def held_out(self, model: Model, folds: Sequence[NDArray[np.int64]], scale: FloatArray) -> Held:
        """Predict each fold from all other blocks, noise that they share included; `scale` (3,): of its variance."""
        likelihood = np.zeros(3)
        errors = np.full((3, len(self.blocks)), np.nan)
        for axis, terms in enumerate(model):
            offset = self.shapes.offset(terms)[axis]
            shapes = np.array([self.shapes.column(term)[axis] for term in terms]).reshape(len(terms), len(offset))
            for part in self.left_out(axis, terms, folds):
                added = offset[part.rows] + part.numbers[self.blocks.levels :] @ shapes[:, part.rows]
                errors[axis, part.rows] = self.means[part.rows, axis] - added
                chi, values = part.chi_squared / scale[axis], part.precisions
                likelihood[axis] += 0.5 * (
                    float(np.sum(np.log(values))) - chi - len(values) * np.log(2 * np.pi * scale[axis])
                )
        for level in range(self.blocks.levels):
            inside = self.blocks.level == level
            if not np.isnan(errors[:, inside]).all():
                errors[:, inside] -= np.nanmean(errors[:, inside], axis=1)[:, None]
        return Held(np.sqrt(np.nanmean(errors**2, axis=1)), likelihood)

    def left_out(
        self, axis: int, terms: Sequence[ThermalTerm], folds: Sequence[NDArray[np.int64]]
    ) -> Iterator[LeftOut]:
        """Yield how all other blocks predict each fold; numbers: levels, then coefficients."""
        return leave_out(self.root[axis], self.design(axis, terms), self.target(axis, terms), folds)


class ReducedTerms:
    """Many terms' columns, reduced to a triangle: what any subset of them leaves is found from a few dozen numbers."""

    def __init__(self, data: Whitened, terms: Sequence[ThermalTerm]):
        unique = list(dict.fromkeys(terms))
        self.levels = data.blocks.levels
        self.place = {term: self.levels + k for k, term in enumerate(unique)}
        self.factor, self.target, self.rest = [], [], []
        for axis in range(3):
            columns = data.design(axis, unique)
            q, r = np.linalg.qr(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))
            product = q.T @ data.output[axis]
            self.factor.append(r)
            self.target.append(product)
            self.rest.append(float(np.sum((data.output[axis] - q @ product) ** 2)))

    def misfit(self, axis: int, terms: Sequence[ThermalTerm]) -> float:
        """Return the sum of squares that least squares leaves of an axis."""
        inside = [*range(self.levels), *(self.place[term] for term in terms)]
        columns = self.factor[axis][:, inside]
        solved = np.linalg.lstsq(columns, self.target[axis], rcond=1e-10)[0]
        return self.rest[axis] + float(np.sum((self.target[axis] - columns @ solved) ** 2))
