"""Covariances of conditions, the weights that whiten them, and the likelihood of their variance components.

Noise is measured or known from a model, and has an excess: what the model misses and what does not average out. Each
component of the excess is a variance, in multiples of a mean measured covariance.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaximu.ground.array_types import Array

__all__ = [
    "BlockFactor",
    "Covariance",
    "component_covariance",
    "inverse_cholesky",
    "mean_root",
    "placed",
    "update_excess",
    "whitened",
]

_SMALL = 6
"""Size of a matrix up to which it is factorised by plain operations."""


class BlockFactor(eqx.Module):
    """A factor F (n, B c) of which a block of c columns reaches m rows alone; a row that is not reached is named twice.

    rows: of each block; values: of them.
    """

    rows: Int[Array, "... B m"]
    values: Float[Array, "... B m c"]

    def transposed(self, matrix: Float[Array, "n q"]) -> Float[Array, "_ q"]:
        """Return Fᵀ times a matrix."""
        found = jnp.einsum("bmc,bmq->bcq", self.values, matrix[self.rows])
        return found.reshape(-1, matrix.shape[1])

    def component(self, size: int) -> Float[Array, "n n"]:
        """Return F Fᵀ, of so many rows; of NumPy's arrays one of NumPy's."""
        own, at = self.values @ self.values.swapaxes(1, 2), (self.rows[:, :, None], self.rows[:, None, :])
        if isinstance(own, np.ndarray):
            whole = np.zeros((size, size))
            np.add.at(whole, at, own)
            return whole  # pyright: ignore[reportReturnType]
        return jnp.zeros((size, size)).at[at].add(own)

    def of_rows(self, used: Float[Array, " n"]) -> "BlockFactor":
        """Return the factor of the rows that are used alone."""
        return BlockFactor(self.rows, self.values * used[self.rows][..., None])


Factor = Float[Array, "... n _"] | Float[Array, "... n"] | BlockFactor


class Covariance(eqx.Module):
    """Covariance of conditions: what was measured, and variance components whose sizes, the excess, are estimated.

    measured: where conditions are independent and all components diagonal, the variances alone. factors: of each
    component, F (n, k) with F Fᵀ its covariance at an excess of one; the roots (n,) of one that is diagonal; or blocks.
    used: 1 for real rows, 0 for padding.
    """

    measured: Float[Array, "... n n"] | Float[Array, "... n"]  # leading axes: a batch of units
    factors: tuple[Factor, ...]
    used: Float[Array, "... n"]
    group: Int[Array, "... n"]  # the component whose size a row's scatter tells

    def total(self, excess: Float[Array, " k"]) -> Float[Array, "n n"]:
        """Return the covariance at the given excess, with ones on the diagonal of padding rows."""
        total = self.measured + jnp.diag(1 - self.used)
        for size, factor in zip(excess, self.factors, strict=True):
            total = total + size * component_covariance(factor, len(self.used))
        return total

    def weights(self, excess: Float[Array, " k"]) -> Float[Array, "n n"] | Float[Array, " n"]:
        """Return W with W C Wᵀ = I at the given excess, of independent conditions its diagonal."""
        if self.measured.ndim == 2:
            return inverse_cholesky(self.total(excess))
        return 1 / jnp.sqrt(
            self.measured + sum(size * root**2 for size, root in zip(excess, self.factors, strict=True))  # pyright: ignore[reportOperatorIssue]
        )


def component_covariance(factor: Factor, size: int) -> Float[Array, "n n"]:
    """Return the covariance of a variance component at a size of one, of so many rows."""
    if isinstance(factor, BlockFactor):
        return factor.component(size)
    return jnp.diag(factor**2) if factor.ndim == 1 else factor @ factor.T  # pyright: ignore[reportReturnType]


def placed(factor: Factor, first: int, size: int) -> Float[Array, "_ ..."] | BlockFactor:
    """Return a factor of some of the rows, the first of which has a place, among so many."""
    if isinstance(factor, BlockFactor):
        return BlockFactor(factor.rows + first, factor.values)
    return jnp.zeros((size, *factor.shape[1:])).at[first : first + len(factor)].set(factor)


def mean_root(covariance: Float[Array, "k n n"], mask: Bool[Array, " k"]) -> Float[Array, "n n"]:
    """Return the Cholesky factor of the mean covariance of the real entries."""
    weight = mask[:, None, None].astype(covariance.dtype)
    mean = jnp.sum(weight * covariance, axis=0) / jnp.maximum(jnp.sum(weight), 1.0)
    return jnp.linalg.cholesky(jnp.where(jnp.any(mask), mean, jnp.eye(covariance.shape[-1])))


def inverse_cholesky(covariance: Float[Array, "... n n"]) -> Float[Array, "... n n"]:
    """Return W with W C Wᵀ = I, lower triangular.

    Small matrices are eliminated by plain operations: LAPACK shares a batch out to XLA's threads and waits for them,
    for ever where as many batches wait side by side as there are threads (jaxlib 0.10, two cores).
    """
    if covariance.shape[-1] <= _SMALL:
        return _eliminated(covariance)
    factor = jnp.linalg.cholesky(covariance)
    identity = jnp.broadcast_to(jnp.eye(covariance.shape[-1]), covariance.shape)
    return jax.scipy.linalg.solve_triangular(factor, identity, lower=True)


def _eliminated(covariance: Float[Array, "... n n"]) -> Float[Array, "... n n"]:
    """Return the inverse of the Cholesky factor by Gauss's elimination of the matrix with the identity beside it."""
    size = covariance.shape[-1]
    beside = jnp.broadcast_to(jnp.eye(size), covariance.shape)
    rows = jnp.concatenate([covariance, beside], axis=-1)
    for place in range(size):
        own = rows[..., place, :] / jnp.sqrt(rows[..., place, place])[..., None]
        below = jnp.where(jnp.arange(size) > place, own[..., :size], 0.0)
        rows = (rows - below[..., None] * own[..., None, :]).at[..., place, :].set(own)
    return rows[..., size:]


def whitened(weights: Float[Array, "m n"] | Float[Array, " n"], rows: Float[Array, "n ..."]) -> Float[Array, "_ ..."]:
    """Return W times rows (n, …); `weights`: W, or its diagonal."""
    return weights @ rows if weights.ndim == 2 else (weights * rows.T).T


def update_excess(
    residual: Float[Array, " n"],
    jacobian: Float[Array, "n p"],
    information: Float[Array, "p p"],
    weights: Float[Array, "n n"] | Float[Array, " n"],
    factors: tuple[Factor, ...],
    excess: Float[Array, " k"],
) -> Float[Array, " k"]:
    """Return improved variance components, none below zero, by one step of Fisher scoring.

    With residual r and Jacobian J whitened by W, information N of the parameters (JᵀJ and what is known beforehand) and
    components V_i = F_i F_iᵀ, the restricted likelihood has the gradient ½ (uᵀ V_i u − tr P V_i) and the information
    ½ tr(P V_i P V_j), P = Wᵀ M W, u = Wᵀ M r, M = I − J N⁻¹ Jᵀ (variance components; Förstner and Wrobel,
    Photogrammetric Computer Vision, 2016, sec. 4.2.4). Of a component that is diagonal, F_i is its roots (n,), and so
    is W its diagonal where conditions are independent.
    """
    basis = jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(information), jacobian.T, lower=True)
    left = residual - basis.T @ (basis @ residual)
    roots = [factor for factor in factors if not isinstance(factor, BlockFactor) and factor.ndim == 1]
    if weights.ndim == 1:  # no matrix of all conditions: P = W² − SᵀS
        squares, seen = jnp.stack(roots) ** 2 * weights**2, basis
        within = jnp.einsum("kn,pn,qn->kpq", squares, seen, seen)
        gradient = squares @ (left**2 - 1 + jnp.sum(seen**2, axis=0))
        scoring = jnp.einsum("kpq,lpq->kl", within, within)
        scoring += (squares * (1 - 2 * jnp.sum(seen**2, axis=0))) @ squares.T
        return _scored(excess, gradient, scoring)
    seen = basis @ weights
    inverse = weights.T @ weights - seen.T @ seen
    pull = weights.T @ left
    if len(roots) == len(factors):
        squares = jnp.stack(roots) ** 2
        gradient = squares @ (pull**2 - jnp.diagonal(inverse))
        scoring = squares @ inverse**2 @ squares.T
        return _scored(excess, gradient, scoring)

    def transposed(factor, matrix):
        """Return Fᵀ times a matrix (n, q)."""
        return factor.transposed(matrix) if isinstance(factor, BlockFactor) else whitened(factor.T, matrix)

    pulled = [transposed(factor, pull[:, None]) for factor in factors]
    beside = [transposed(factor, inverse).T for factor in factors]  # P F_i
    gradient, entries = [], {}
    for k, factor in enumerate(factors):
        for other in range(k + 1):  # of tr(P V_i P V_j) = |F_iᵀ P F_j|² one half is enough
            product = transposed(factor, beside[other])
            entries[k, other] = entries[other, k] = jnp.sum(product**2)
        gradient.append(jnp.sum(pulled[k] ** 2) - jnp.trace(product))
    count = range(len(factors))
    scoring = jnp.stack([jnp.stack([entries[k, other] for other in count]) for k in count])
    return _scored(excess, jnp.stack(gradient), scoring)


def _scored(excess: Float[Array, " k"], gradient: Float[Array, " k"], scoring: Float[Array, "k k"]):
    """Take a step of scoring; a component without rows (no turns, say) has no information, and stays."""
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(scoring), 1e-30))
    normal = scoring / scale / scale[:, None] + 1e-9 * jnp.eye(len(excess))
    step = jnp.linalg.solve(normal, gradient / scale) / scale
    return jnp.where(jnp.diagonal(scoring) > 1e-20, jnp.maximum(excess + step, 0.0), excess)
