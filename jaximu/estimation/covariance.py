"""Covariances of conditions, the weights that whiten them, and the likelihood of their variance components.

Noise is measured or known from a model, and has an excess: what the model misses and what does not average out. Each
component of the excess is a variance, in multiples of a mean measured covariance.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations_with_replacement, pairwise
from math import prod
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaximu.ground.array_types import Array
from jaximu.ground.differences import value_and_jacobian
from jaximu.ground.errors import InputError
from jaximu.ground.rotation import inverse_matrix
from jaximu.ground.tracing import array_module, is_traced

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
        return jnp.einsum("bmc,bmq->bcq", self.values, matrix[self.rows]).reshape(-1, matrix.shape[1])

    def times(self, matrix: Float[Array, "_ q"], size: int) -> Float[Array, "n q"]:
        """Return F, of so many rows, times a matrix."""
        reached = self.values @ matrix.reshape(len(self.values), self.values.shape[-1], -1)
        return jnp.zeros((size, matrix.shape[1])).at[self.rows].add(reached)

    def component(self, size: int) -> Float[Array, "n n"]:
        """Return F Fᵀ, of so many rows; of NumPy's arrays one of NumPy's."""
        return _placed(self.rows, self.rows, _squared(self.values), size)

    def of_rows(self, used: Float[Array, " n"]) -> "BlockFactor":
        """Return the factor of the rows that are used alone."""
        return BlockFactor(self.rows, self.values * used[self.rows][..., None])


Factor = Float[Array, "... n _"] | Float[Array, "... n"] | BlockFactor


def _transposed(factor: Factor, matrix: Float[Array, "n q"]) -> Float[Array, "_ q"]:
    """Return Fᵀ times a matrix."""
    if isinstance(factor, BlockFactor):
        return factor.transposed(matrix)
    return (factor * matrix.T).T if factor.ndim == 1 else factor.T @ matrix


class Weights(eqx.Module):
    """A root W of an inverse covariance, W C Wᵀ = I: a matrix, or its diagonal where conditions are independent."""

    root: Float[Array, "n n"] | Float[Array, " n"]

    def whiten(self, rows: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        """Return W times rows."""
        return jnp.tensordot(self.root, rows, axes=1) if self.root.ndim == 2 else (self.root * rows.T).T

    def back(self, rows: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        """Return Wᵀ times whitened rows."""
        return self.root.T @ rows if self.root.ndim == 2 else (self.root * rows.T).T

    def unwhiten(self, rows: Float[Array, "n q"]) -> Float[Array, "n q"]:
        """Return the rows that were whitened."""
        return jnp.linalg.solve(self.root, rows) if self.root.ndim == 2 else rows / self.root[:, None]


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

    @property
    def components(self) -> int:
        """How many components there are."""
        return len(self.factors)

    def dense(self) -> "Covariance":
        """Return the same with whole matrices."""
        return self

    def shortened(self) -> "Covariance":
        """Return the same without rows of the end that no unit uses: there are none."""
        return self

    def of_rows(self, used: Float[Array, " n"]) -> "Covariance":
        """Return the covariance with only these rows used; factors by blocks."""
        factors = tuple(factor.of_rows(used) for factor in self.factors)
        return Covariance(used[:, None] * used * self.measured, factors, used, self.group)

    def turn_by_turn(self, excess: Float[Array, ""]) -> "Covariance":
        """Raise `InputError`: slow noise ties turns that are not neighbours."""
        raise InputError("turns that slow noise ties cannot be taken one by one: fit them jointly.")

    def component(self, number: int) -> Float[Array, "n n"]:
        """Return the covariance of a component at a size of one."""
        factor = self.factors[number]
        if isinstance(factor, BlockFactor):
            return factor.component(len(self.used))
        return array_module(factor).diag(factor**2) if factor.ndim == 1 else factor @ factor.T

    def total(self, excess: Float[Array, " k"]) -> Float[Array, "n n"]:
        """Return the covariance at the given excess, with ones on the diagonal of padding rows."""
        total = self.measured + array_module(self.used).diag(1 - self.used)
        for number, size in enumerate(excess):
            total = total + size * self.component(number)
        return total

    def weights(self, excess: Float[Array, " k"]) -> Weights:
        """Return what whitens the conditions at the given excess."""
        if self.measured.ndim == 2:
            return Weights(inverse_cholesky(self.total(excess)))
        variance = self.measured + sum(size * root**2 for size, root in zip(excess, self.factors, strict=True))  # pyright: ignore[reportOperatorIssue]
        return Weights(1 / jnp.sqrt(variance))

    def spread(self, number: int, rows: Float[Array, "n q"]) -> Float[Array, "n q"]:
        """Return the covariance of a component, at an excess of one, times rows."""
        factor = self.factors[number]
        product = _transposed(factor, rows)
        if isinstance(factor, BlockFactor):
            return factor.times(product, len(rows))
        return (factor * product.T).T if factor.ndim == 1 else factor @ product

    def traces(self, excess: Float[Array, " k"], weights: Weights) -> tuple[Float[Array, " k"], Float[Array, "k k"]]:
        """Return tr C⁻¹V_i and tr C⁻¹V_i C⁻¹V_j of the components V_i at the excess that the weights are of."""
        roots = [factor for factor in self.factors if not isinstance(factor, BlockFactor) and factor.ndim == 1]
        if weights.root.ndim == 1:
            squares = jnp.stack(roots) ** 2 * weights.root**2
            return jnp.sum(squares, axis=1), squares @ squares.T
        inverse = weights.root.T @ weights.root
        if len(roots) == len(self.factors):
            squares = jnp.stack(roots) ** 2
            return squares @ jnp.diagonal(inverse), squares @ inverse**2 @ squares.T

        beside = [_transposed(factor, inverse).T for factor in self.factors]  # C⁻¹ F_i
        first, second = jnp.zeros(len(beside)), jnp.zeros((len(beside),) * 2)
        # the wider of two factors first: it is diagonal, and its product next to nothing
        order = sorted(range(len(beside)), key=lambda k: -beside[k].shape[1])
        for i, j in combinations_with_replacement(order, 2):
            entry = _transposed(self.factors[i], beside[j])
            first = first.at[i].set(jnp.trace(entry)) if i == j else first
            second = second.at[jnp.array([i, j]), jnp.array([j, i])].set(jnp.sum(entry**2))
        return first, second


class ChainWeights(eqx.Module):
    """Weights of a chain: the inverses of the diagonal blocks of its Cholesky factor, and the blocks below them."""

    inverse: Float[Array, "P 3 3"]
    below: Float[Array, "P 3 3"]
    means: Float[Array, "P 3 3"]

    def whiten(self, rows: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        """Return W times rows."""
        chain, means = _blocks(rows.reshape(len(rows), prod(rows.shape[1:])), len(self.means))

        def step(before, block):
            inverse, below, right = block
            white = _product(inverse, right - _product(below, before))
            return white, white

        white = jax.lax.scan(step, jnp.zeros_like(chain[0]), (self.inverse, self.below, chain))[1]
        return in_order(white, self.means @ means).reshape(rows.shape)

    def back(self, rows: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        """Return Wᵀ times whitened rows."""
        chain, means = _blocks(rows.reshape(len(rows), prod(rows.shape[1:])), len(self.means))

        def step(after, block):
            inverse, below, right = block
            solved = _product(inverse.T, right - after)
            return _product(below.T, solved), solved

        solved = jax.lax.scan(step, jnp.zeros_like(chain[0]), (self.inverse, self.below, chain), reverse=True)[1]
        return in_order(solved, self.means.swapaxes(1, 2) @ means).reshape(rows.shape)

    def unwhiten(self, rows: Float[Array, "n q"]) -> Float[Array, "n q"]:
        """Return the rows that were whitened."""
        chain, means = _blocks(rows, len(self.means))
        chain = inverse_matrix(self.inverse) @ chain + self.below @ _preceding(chain)
        return in_order(chain, inverse_matrix(self.means) @ means)


class Chain(eqx.Module):
    """Covariance of conditions along P poses of which neighbours share noise: block tridiagonal, never n × n.

    A block has a pose's norm and the two components of the turn after it, beside it three means at rest that are
    independent of all others. Components: a pose's noise reaches its own block and the one before it; a turn's its own;
    the means' theirs. In the order of conditions norms come first, then turns, then means at rest.

    diagonal, below: what was measured, a block and its covariance with the block before it. pose, earlier, turned,
    rested: roots of the components, of which `earlier` is that of a pose's noise in the block before.
    """

    diagonal: Float[Array, "... P 3 3"]
    below: Float[Array, "... P 3 3"]
    means: Float[Array, "... P 3 3"]
    pose: Float[Array, "... P 3 3"]
    earlier: Float[Array, "... P 3 3"]
    turned: Float[Array, "... P 3 3"]
    rested: Float[Array, "... P 3 3"]
    used: Float[Array, "... n"]
    group: Int[Array, "... n"]

    components: ClassVar[int] = 3

    def _total(self, excess) -> tuple[Array, Array]:
        """Return the blocks of the chain at an excess of poses and turns, ones on the diagonal of padding."""
        padding = 1 - _blocks(self.used[:, None], len(self.means))[0]
        reached = _squared(self.pose) + following(_squared(self.earlier))
        diagonal = self.diagonal + excess[0] * reached + excess[1] * _squared(self.turned) + padding * jnp.eye(3)
        return diagonal, self.below + excess[0] * self.pose @ self.earlier.swapaxes(1, 2)

    def _factored(self, excess) -> tuple[Array, Array]:
        def step(before, block):
            diagonal, below = block
            below = below @ before.T
            inverse = inverse_cholesky(diagonal - below @ below.T)
            return inverse, (inverse, below)

        return jax.lax.scan(step, jnp.eye(3), self._total(excess))[1]

    def _rest(self, excess) -> Array:
        padding = 1 - _blocks(self.used[:, None], len(self.means))[1]
        return inverse_cholesky(self.means + excess[2] * _squared(self.rested) + padding * jnp.eye(3))

    def weights(self, excess: Float[Array, " k"]) -> ChainWeights:
        """Return what whitens the conditions at the given excess."""
        return ChainWeights(*self._factored(excess), self._rest(excess))

    def dense(self) -> Covariance:
        """Return the same with whole matrices."""
        poses = self.means.shape[-3]
        norm = np.arange(poses)[:, None]
        turn = np.where(norm + 1 < poses, poses + 2 * norm, 0)  # the last pose's turn is none, and zero
        block = np.concatenate([norm, turn, turn + 1], axis=1)
        before = np.concatenate([block[:1], block[:-1]])
        rest = 3 * poses - 2 + 3 * norm + np.arange(3)
        values = array_module(self).concatenate([self.pose, self.earlier], axis=1)
        factors = (
            BlockFactor(np.concatenate([block, before], axis=1), values),
            BlockFactor(block, self.turned),
            BlockFactor(rest, self.rested),
        )
        size = len(self.used)
        measured = _placed(block, block, self.diagonal, size) + _placed(rest, rest, self.means, size)
        beside = _placed(block, before, self.below, size)
        return Covariance(measured + beside + beside.T, factors, self.used, self.group)

    def shortened(self) -> "Chain | Covariance":
        """Return the norms alone, which are independent, where no unit uses any other row; of NumPy's arrays."""
        norms = self.means.shape[-3]
        if is_traced(self) or self.used[..., norms:].any():
            return self
        used, root = self.used[..., :norms], np.linalg.norm(self.pose[..., 0, :], axis=-1)
        measured = self.diagonal[..., 0, 0] + 1 - used
        return Covariance(measured, (root, 0 * root, 0 * root), used, self.group[..., :norms])

    def of_rows(self, used: Float[Array, " n"]) -> "Chain":
        """Return the covariance with only these rows used."""
        chain, means = _blocks(used[:, None], len(self.means))
        before = _preceding(chain)
        return Chain(
            chain * self.diagonal * chain.swapaxes(1, 2),
            chain * self.below * before.swapaxes(1, 2),
            means * self.means * means.swapaxes(1, 2),
            chain * self.pose,
            before * self.earlier,
            chain * self.turned,
            means * self.rested,
            used,
            self.group,
        )

    def turn_by_turn(self, excess: Float[Array, ""]) -> "Chain":
        """Return the covariance with turns independent of each other, the excess of the poses known."""
        none = jnp.zeros_like(self.pose)
        diagonal = self._total(excess * jnp.array([1.0, 0.0]))[0]
        return replace(self, diagonal=diagonal, below=none, pose=none, earlier=none)

    def spread(self, number: int, rows: Float[Array, "n q"]) -> Float[Array, "n q"]:
        """Return the covariance of a component, at an excess of one, times rows."""
        chain, means = _blocks(rows, len(self.means))
        if number == 2:
            return in_order(jnp.zeros_like(chain), _squared(self.rested) @ means)
        if number == 1:
            return in_order(_squared(self.turned) @ chain, jnp.zeros_like(means))
        noise = self.pose.swapaxes(1, 2) @ chain + self.earlier.swapaxes(1, 2) @ _preceding(chain)
        return in_order(self.pose @ noise + following(self.earlier @ noise), jnp.zeros_like(means))

    def traces(
        self, excess: Float[Array, " k"], weights: ChainWeights
    ) -> tuple[Float[Array, " k"], Float[Array, "k k"]]:
        """Return tr C⁻¹V_i and tr C⁻¹V_i C⁻¹V_j of the components V_i at the excess that the weights are of.

        They are the slopes and, but for the sign, the curvature of log |C| by the excess.
        """

        def volume(sizes):
            inverse, _ = self._factored(sizes)
            return -2 * jnp.sum(jnp.log(jnp.diagonal(inverse, axis1=1, axis2=2)))

        slopes, curvature = value_and_jacobian(jax.jacfwd(volume), excess[:2])
        white = weights.means @ self.rested
        rest = jnp.sum(white**2)
        first = jnp.concatenate([slopes, rest[None]])
        second = jnp.zeros((3, 3)).at[:2, :2].set(-curvature).at[2, 2].set(jnp.sum((white.swapaxes(1, 2) @ white) ** 2))
        return first, second


def _placed(rows: Int[Array, "B m"], columns: Int[Array, "B k"], values: Float[Array, "B m k"], size: int) -> Array:
    """Return a matrix of so many rows to which blocks add up; of NumPy's arrays one of NumPy's."""
    at = rows[:, :, None], columns[:, None, :]
    if isinstance(values, np.ndarray):
        whole = np.zeros((size, size))
        np.add.at(whole, at, values)
        return whole
    return jnp.zeros((size, size)).at[at].add(values)


def _product(one: Float[Array, "m k"], other: Float[Array, "k q"]) -> Float[Array, "m q"]:
    """Return the product of small matrices, element by element: calls take longer than products inside a scan."""
    return jnp.sum(one[:, :, None] * other, axis=1)


def _squared(factor: Float[Array, "... m q"]) -> Float[Array, "... m m"]:
    return factor @ factor.swapaxes(-1, -2)


def _blocks(rows: Float[Array, "n q"], poses: int) -> tuple[Float[Array, "P 3 q"], Float[Array, "P 3 q"]]:
    """Return rows of a chain's conditions as blocks, the last of which has no turn, and as means at rest."""
    norms, turns, means = jnp.split(rows, [poses, 3 * poses - 2])
    turns = jnp.concatenate([turns, jnp.zeros_like(turns[:2])]).reshape(poses, 2, rows.shape[1])
    return jnp.concatenate([norms[:, None], turns], axis=1), means.reshape(poses, 3, rows.shape[1])


def _preceding(blocks: Float[Array, "P m q"]) -> Float[Array, "P m q"]:
    return jnp.concatenate([jnp.zeros_like(blocks[:1]), blocks[:-1]])


def following(blocks: Float[Array, "P m q"]) -> Float[Array, "P m q"]:
    """Return of each block what the next one has; of the last, zeros."""
    return jnp.concatenate([blocks[1:], jnp.zeros_like(blocks[:1])])


def in_order(chain: Float[Array, "P 3 q"], means: Float[Array, "P 3 q"]) -> Float[Array, "n q"]:
    """Return blocks as rows in the order of conditions."""
    turns, columns = chain[:-1, 1:], chain.shape[-1]
    return jnp.concatenate(
        [chain[:, 0], turns.reshape(2 * len(turns), columns), means.reshape(3 * len(means), columns)]
    )


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
    for k in range(size):
        pivot = rows[..., k, :] / jnp.sqrt(rows[..., k, k])[..., None]
        below = jnp.where(jnp.arange(size) > k, pivot[..., :size], 0.0)
        rows = (rows - below[..., None] * pivot[..., None, :]).at[..., k, :].set(pivot)
    return rows[..., size:]


def parts_of(covariances: Sequence[Covariance | Chain]) -> list[tuple[slice, slice]]:
    """Return where the rows of each covariance are among those of all, and its components among all components."""
    edges = np.cumsum([(0, 0), *((len(kind.used), kind.components) for kind in covariances)], axis=0).tolist()
    return [(slice(row, end), slice(number, last)) for (row, number), (end, last) in pairwise(edges)]


def update_excess(
    covariances: Sequence[Covariance | Chain],
    weights: Sequence[Weights | ChainWeights],
    residual: Float[Array, " n"],
    jacobian: Float[Array, "n p"],
    information: Float[Array, "p p"],
    excess: Float[Array, " k"],
) -> Float[Array, " k"]:
    """Return improved variance components, none below zero, by one step of Fisher scoring.

    With residual r and Jacobian J whitened by W, information N of the parameters (JᵀJ and what is known beforehand) and
    components V_i, the restricted likelihood has the gradient ½ (uᵀ V_i u − tr P V_i) and the information
    ½ tr(P V_i P V_j), P = Wᵀ M W, u = Wᵀ M r, M = I − J N⁻¹ Jᵀ (variance components; Förstner and Wrobel,
    Photogrammetric Computer Vision, 2016, sec. 4.2.4). With Q Qᵀ = Wᵀ J N⁻¹ Jᵀ W, that is P = C⁻¹ − Q Qᵀ, no matrix of
    all conditions is needed.
    """
    basis = jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(information), jacobian.T, lower=True)
    left = residual - basis.T @ (basis @ residual)
    gradient, within, scoring = [], [], jnp.zeros((len(excess),) * 2)
    for kind, root, (part, numbers) in zip(covariances, weights, parts_of(covariances), strict=True):
        back = root.back(jnp.concatenate([left[part, None], basis[:, part].T], axis=1))
        pull, pulled = back[:, 0], back[:, 1:]
        first, second = kind.traces(excess[numbers], root)  # pyright: ignore[reportArgumentType]
        moved = [kind.spread(number, back) for number in range(kind.components)]
        inner = [pulled.T @ rows[:, 1:] for rows in moved]
        gradient += [
            pull @ rows[:, 0] - trace + jnp.trace(product)
            for rows, trace, product in zip(moved, first, inner, strict=True)
        ]
        white = root.whiten(jnp.stack([rows[:, 1:] for rows in moved], axis=1))
        second = second - 2 * jnp.einsum("nip,njp->ij", white, white)
        scoring = scoring.at[numbers, numbers].add(second)
        within += inner
    products = jnp.stack(within)
    return scored(excess, jnp.stack(gradient), scoring + jnp.einsum("ipq,jqp->ij", products, products))


def scored(
    excess: Float[Array, " k"], gradient: Float[Array, " k"], scoring: Float[Array, "k k"]
) -> Float[Array, " k"]:
    """Take a step of scoring; a component without rows (no turns, say) has no information, and stays.

    One at zero that would go below it has no part in the step: it would hold the others off their maximum.
    """
    free = (excess > 0) | (gradient > 0)
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(scoring), 1e-30))
    normal = jnp.where(free & free[:, None], scoring / scale / scale[:, None], jnp.diag(1.0 - free))
    normal = normal + 1e-9 * jnp.eye(len(excess))
    step = jnp.linalg.solve(normal, jnp.where(free, gradient / scale, 0.0)) / scale
    return jnp.where(jnp.diagonal(scoring) > 1e-20, jnp.maximum(excess + step, 0.0), excess)
