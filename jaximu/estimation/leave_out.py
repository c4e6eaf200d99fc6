"""What all other rows of a linear problem say of rows that are left out, without a fit for each part.

Rows y = X θ + noise of covariance C: with Q = C⁻¹ − C⁻¹X (XᵀC⁻¹X)⁻¹ XᵀC⁻¹ the rows o are predicted by all others, noise
that they share included, with the errors Q_oo⁻¹ (Q y)_o and the covariance Q_oo⁻¹. A row that is left out is one with a
free number of its own, which is then its error.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space, solve_triangular

from jaximu.ground.array_types import BoolArray, FloatArray
from jaximu.ground.vectors import column_lengths, submatrix

_RANK = 1e-9
"""Share of the largest singular value below which a combination of columns is none."""
_BLIND = 1e-7
"""Share of the largest below which a precision is zero: the other rows say nothing in this direction."""


class LeftOut(NamedTuple):
    """Rows (m,) that were left out, and how all others predict them.

    errors (m,): measured less predicted. precisions (k,), directions (m, k): of the errors; directions in which the
    others predict nothing are not among them. numbers (p,): θ as fitted to all other rows.
    """

    rows: NDArray[np.integer] | BoolArray
    errors: FloatArray
    precisions: FloatArray
    directions: FloatArray
    numbers: FloatArray

    @property
    def covariance(self) -> FloatArray:
        """Covariance (m, m) of the errors, where the others predict anything."""
        return (self.directions / self.precisions) @ self.directions.T

    @property
    def chi_squared(self) -> float:
        """Of the errors against their covariance."""
        return float(np.sum(self.precisions * (self.directions.T @ self.errors) ** 2))

    def log_likelihood(self, scale: float = 1.0) -> float:
        """Return that of the errors (nats), their variance and that of their prediction `scale` times as large."""
        sizes = self.precisions / (2 * np.pi * scale)
        return 0.5 * (float(np.sum(np.log(sizes))) - self.chi_squared / scale)

    @property
    def blind(self) -> bool:
        """Whether there is a direction in which the others predict nothing."""
        return self.directions.shape[1] < len(self.errors)

    def only(self, some: BoolArray) -> LeftOut:
        """Return the same of some (m,) of the rows; the others were left out as well."""
        known = np.eye(int(some.sum()))
        if self.blind and some.any():
            known = null_space(null_space(self.directions.T)[some].T, rcond=_BLIND)
        values, vectors = np.linalg.eigh(known.T @ submatrix(self.covariance, some) @ known)
        return LeftOut(self.rows[some], self.errors[some], 1 / values, known @ vectors, self.numbers)

    def beside(self, pull: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return errors (m,) and covariance (m, m) with further numbers in the model; no direction may be blind.

        **Arguments:** `pull` (m, q) at these rows, `step` (q,): of [`jaximu.estimation.leave_out.further`][]. With S
        the covariance so far and M = I − pullᵀ S pull the new one is S + S pull M⁻¹ pullᵀ S (Woodbury).
        """
        before = self.covariance
        spread = before @ pull
        back = np.linalg.solve(np.eye(len(step)) - pull.T @ spread, spread.T)
        return self.errors + (pull.T @ self.errors - step) @ back, before + spread @ back


def leave_out(
    weights: FloatArray,
    columns: FloatArray,
    target: FloatArray,
    parts: Sequence[NDArray[np.integer] | BoolArray],
) -> Iterator[LeftOut]:
    """Yield for each part of the rows how all others predict it.

    **Arguments:** `weights` W (n, n): W C Wᵀ = I. `columns` (n + k, p) and `target` (n + k,): W X and W y, and below
    them k rows for what is known of the numbers beforehand. `parts`: of the n rows, by place or as masks (n,).
    """
    size = np.maximum(column_lengths(columns), 1e-300)
    u, s, v = np.linalg.svd(columns / size, full_matrices=False)
    kept = s > _RANK * s[:1].max(initial=0.0)
    basis, count = u[:, kept], len(weights)
    back = weights.T @ basis[:count]
    pull = weights.T @ off(basis, target)[:count]
    for rows in parts:
        weighted = weights[:, rows]
        values, vectors = np.linalg.eigh(weighted.T @ weighted - back[rows] @ back[rows].T)
        predicted = values > _BLIND * values[-1]
        values, vectors = values[predicted], vectors[:, predicted]
        errors = vectors @ ((vectors.T @ pull[rows]) / values)
        others = basis.T @ target - basis[:count].T @ (weighted @ errors)
        yield LeftOut(rows, errors, values, vectors, v[kept].T @ (others / s[kept]) / size)


def further(
    weights: FloatArray, basis: FloatArray, target: FloatArray, columns: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return how numbers that are a priori normal, of variance one, pull at rows (n, q), and their steps (q,).

    **Arguments:** `weights`, `target` (n + k,): of `leave_out`. `basis` (n + k, r): orthonormal, of its columns.
    `columns` (n, q): whitened, of the further numbers. Q becomes Q − pull pullᵀ, and Q y becomes Q y − pull · step.
    """
    count, numbers = columns.shape
    columns = np.concatenate([columns, np.zeros((len(target) - count, numbers))])
    free = off(basis, columns)
    scaled = solve_triangular(np.linalg.cholesky(np.eye(numbers) + columns.T @ free), free.T, lower=True)
    return weights.T @ scaled[:, :count].T, scaled @ target


def orthonormal(columns: FloatArray) -> FloatArray:
    """Return orthonormal columns of what columns (n, k) span."""
    if not columns.shape[1]:
        return columns
    u, s, _ = np.linalg.svd(columns / np.maximum(column_lengths(columns), 1e-300), full_matrices=False)
    return u[:, s > _RANK * s[0]]


def off(basis: FloatArray, values: FloatArray) -> FloatArray:
    """Return values (n, …) without what orthonormal columns (n, k) span."""
    return values - basis @ (basis.T @ values)
