"""The covariance of the conditions, from the noise of what was measured, and the weights that whiten them.

Noise is measured (the scatter at rest, averaged over a pose or a turn) or known from a model, and has an excess: what
the model misses and what does not average out, the same for every pose and every turn. The excess of the mean
accelerometer outputs, of the turns and of the mean gyroscope outputs at rest are variance components, in multiples of
their mean measured covariance.

Weights are computed at a model close to the solution and held fixed while it is sought: an error of 1 % in the model
changes them by 1 %, and the efficiency of the estimate by its square.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaximu.data.gravity_direction import unit_vectors
from jaximu.data.gravity_norm import recover_specific_force, recovery_jacobian
from jaximu.data.preintegration import turned_by_rates
from jaximu.ground.array_types import Array
from jaximu.ground.rotation import (
    conjugate,
    inverse_matrix,
    rotate,
    rotation_matrix,
    rotation_vectors,
    running_rotations,
)
from jaximu.model.sensor import Imu
from jaximu.recordings.observations import Observations, Turns

__all__ = [
    "Blocks",
    "Covariance",
    "IntegratedTurns",
    "Sensitivities",
    "component_covariance",
    "condition_covariance",
    "integrate_turns",
    "inverse_cholesky",
    "mean_root",
    "placed",
    "sensitivities",
    "update_excess",
    "whitened",
]

_SMALL = 6
"""Size of a matrix up to which it is factorised by plain operations."""


class Blocks(eqx.Module):
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

    def of_rows(self, used: Float[Array, " n"]) -> "Blocks":
        """Return the factor of the rows that are used alone."""
        return Blocks(self.rows, self.values * used[self.rows][..., None])


Factor = Float[Array, "... n _"] | Float[Array, "... n"] | Blocks


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
    if isinstance(factor, Blocks):
        return factor.component(size)
    return jnp.diag(factor**2) if factor.ndim == 1 else factor @ factor.T  # pyright: ignore[reportReturnType]


def placed(factor: Factor, first: int, size: int) -> Float[Array, "_ ..."] | Blocks:
    """Return a factor of some of the rows, the first of which has a place, among so many."""
    if isinstance(factor, Blocks):
        return Blocks(factor.rows + first, factor.values)
    return jnp.zeros((size, *factor.shape[1:])).at[first : first + len(factor)].set(factor)


class IntegratedTurns(eqx.Module):
    """Turns integrated at one gyroscope calibration.

    rotation: quaternion from the last body frame to the first; running: after every sample. transport: how the last
    body frame's rotation vector reacts to the rate of every sample (s). noise: covariance (rad²) of that rotation
    vector by white noise.
    """

    rotation: Float[Array, "T 4"]
    running: Float[Array, "T S 4"]
    transport: Float[Array, "T S 3 3"]
    noise: Float[Array, "T 3 3"]


class Sensitivities(eqx.Module):
    """How the conditions react to what was measured, to first order (the means at rest react as they are)."""

    norm: Float[Array, "P 3"]  # of a pose's norm to its mean accelerometer output
    after: Float[Array, "T 2 3"]  # of a turn's two components to the mean output of the pose after it
    before: Float[Array, "T 2 3"]  # … and before it
    turn: Float[Array, "T 2 S 3"]  # … and to every sample of the gyroscope during it


def integrate_turns(imu: Imu, turns: Turns) -> IntegratedTurns:
    """Integrate the turns with the gyroscope's gain and bias.

    How the last frame reacts to the rates: `turned_by_rates`. White rate noise of density N in each sample turns the
    end of the turn by R_k K⁻¹ n dt: the sum of R_k K⁻¹ N K⁻ᵀ R_kᵀ dt over the samples, brought to the last frame.
    """
    assert imu.gyroscope is not None
    vectors = rotation_vectors(imu.gyroscope.recover(turns.output), turns.interval)
    running = running_rotations(vectors)
    final = running[..., -1, :]
    back = rotation_matrix(conjugate(final))
    toward = back[:, None] @ rotation_matrix(running)
    inverse = inverse_matrix(imu.gyroscope.gain)
    density = inverse @ turns.noise @ inverse.T
    noise = jnp.einsum("tsij,tslj,ts->til", toward @ density, toward, turns.interval)
    transport = back[:, None] @ turned_by_rates(running, vectors, turns.interval)
    return IntegratedTurns(final, running, transport, noise)


def mean_root(covariance: Float[Array, "k n n"], mask: Bool[Array, " k"]) -> Float[Array, "n n"]:
    """Return the Cholesky factor of the mean covariance of the real entries."""
    weight = mask[:, None, None].astype(covariance.dtype)
    mean = jnp.sum(weight * covariance, axis=0) / jnp.maximum(jnp.sum(weight), 1.0)
    return jnp.linalg.cholesky(jnp.where(jnp.any(mask), mean, jnp.eye(covariance.shape[-1])))


def _pose_sensitivities(imu: Imu, observations: Observations, rotations: Float[Array, "T 4"]):
    """The norm's and the directions' reaction to mean accelerometer outputs, and each turn's carried direction."""
    poses, turns = observations.poses, observations.turns
    force = recover_specific_force(imu, poses)
    unit = unit_vectors(force)
    jacobian = recovery_jacobian(imu, poses)  # ∂f/∂y
    length = jnp.sqrt(jnp.sum(force**2, axis=-1))[:, None, None]
    direction = (jacobian - unit[..., :, None] * jnp.einsum("pi,pij->pj", unit, jacobian)[:, None, :]) / length
    back = rotation_matrix(conjugate(rotations))
    norm = -jnp.einsum("pi,pij->pj", force, jacobian) / observations.gravity
    after = jnp.einsum("tai,tij->taj", turns.basis, direction[1:])
    before = -jnp.einsum("tai,tij,tjk->tak", turns.basis, back, direction[:-1])
    # A small rotation δ of the last frame moves the carried direction u by −δ × u = u × δ.
    carried = rotate(conjugate(rotations), unit[:-1])
    lever = jnp.cross(carried[:, None, :], turns.basis)  # rows b: b·(u × δ) = (b × u)·δ = −(u × b)·δ
    return norm, after, before, lever


def sensitivities(imu: Imu, observations: Observations, integrated: IntegratedTurns) -> Sensitivities:
    """Return the derivatives of the conditions by mean accelerometer outputs and by gyroscope samples."""
    assert imu.gyroscope is not None
    norm, after, before, lever = _pose_sensitivities(imu, observations, integrated.rotation)
    inverse = inverse_matrix(imu.gyroscope.gain)
    return Sensitivities(norm, after, before, (lever[:, None] @ integrated.transport @ inverse).swapaxes(1, 2))


def condition_covariance(imu: Imu, observations: Observations, integrated: IntegratedTurns | None = None) -> Covariance:
    """Propagate the covariances of what was measured into the conditions at the given model.

    Conditions: norms of P poses, two components of each of T turns, three of each mean gyroscope output at rest.
    Components of the excess: poses, turns, means at rest. `integrated`: the turns at this model, where at hand.
    """
    poses, turns, slow = observations.poses, observations.turns, observations.slow
    count, steps = poses.mask.shape[0], turns.mask.shape[0]
    integrated = integrate_turns(imu, turns) if integrated is None else integrated
    norm, after, before, lever = _pose_sensitivities(imu, observations, integrated.rotation)

    pose, step = jnp.arange(count), jnp.arange(steps)
    rows = count + 2 * step[:, None] + jnp.arange(2)
    at_rest = count + 2 * steps + 3 * pose[:, None] + jnp.arange(3)
    size = 4 * count + 2 * steps
    used = jnp.concatenate([poses.mask, jnp.repeat(turns.mask, 2), jnp.repeat(poses.mask, 3)]).astype(norm.dtype)
    # what a pose reaches: its norm, the turn before it and the turn after it, of which the ends have one alone
    before_it, after_it = ((1, 0), (0, 0)), ((0, 1), (0, 0))
    no_axis = ((0, 0),)
    reached = Blocks(
        jnp.concatenate([pose[:, None], jnp.pad(rows, before_it), jnp.pad(rows, after_it)], axis=1),
        jnp.concatenate(
            [norm[:, None], jnp.pad(after, (*before_it, *no_axis)), jnp.pad(before, (*after_it, *no_axis))], axis=1
        ),
    ).of_rows(used)
    turned = Blocks(rows, lever).of_rows(used)
    means = Blocks(at_rest, jnp.broadcast_to(jnp.eye(3), (count, 3, 3))).of_rows(used)
    factors = tuple(
        Blocks(each.rows, each.values @ mean_root(covariance, mask))
        for each, covariance, mask in (
            (reached, poses.accelerometer_covariance, poses.mask), (turned, integrated.noise, turns.mask),
            (means, poses.gyroscope_covariance, poses.mask),
        )
    )  # fmt: skip
    group = jnp.repeat(jnp.arange(3), jnp.array([count, 2 * steps, 3 * count]), total_repeat_length=size)

    def spread(total, blocks, covariance):
        """Add to the covariance (n, n) of all conditions what blocks reach of covariances (B, 3, 3)."""
        own = blocks.values @ covariance @ blocks.values.swapaxes(1, 2)
        return total.at[blocks.rows[:, :, None], blocks.rows[:, None, :]].add(own)

    measured = spread(jnp.zeros((size, size)), turned, integrated.noise)
    if slow is None:
        own = jnp.where(poses.mask[:, None, None], poses.gyroscope_covariance, 0.0)
        measured = spread(spread(measured, means, own), reached, poses.accelerometer_covariance)
        return Covariance(measured, factors, used, group)

    intervals = slow.gyroscope.shape[-1]
    parts = (intervals - count) // steps
    inverse = inverse_matrix(imu.gyroscope.gain)  # pyright: ignore[reportOptionalMemberAccess]
    member = (slow.part[..., None] == jnp.arange(parts)).astype(norm.dtype)
    transport = jnp.einsum("tsb,tsij->tbij", member, integrated.transport)
    by_part = (lever[:, None] @ transport @ inverse).swapaxes(1, 2)

    def by_forces(matrix, axis):
        """Return what conditions (n, q) react to an axis' mean forces (P, q) with."""
        values = reached.values[..., axis, None] * matrix[:, None]
        return jnp.zeros((size, matrix.shape[1])).at[reached.rows].add(values)

    def by_rates(matrix, axis):
        """The same to an axis' mean rates (I, q), of all poses and then of the parts of each turn."""
        during = matrix[count:].reshape(steps, parts, -1)
        found = jnp.zeros((size, matrix.shape[1])).at[rows].set(jnp.einsum("tkb,tbq->tkq", by_part[..., axis], during))
        return used[:, None] * found.at[at_rest[:, axis]].set(matrix[:count])

    for axis in range(3):
        measured += by_forces(by_forces(slow.accelerometer[axis], axis).T, axis)
        measured += by_rates(by_rates(slow.gyroscope[axis], axis).T, axis)
    return Covariance(measured, factors, used, group)


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
    roots = [factor for factor in factors if not isinstance(factor, Blocks) and factor.ndim == 1]
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
        return factor.transposed(matrix) if isinstance(factor, Blocks) else whitened(factor.T, matrix)

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
