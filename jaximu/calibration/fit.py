"""`Fit`: the solved problem of one unit, and the recipe's solver for one or many."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaximu import stored
from jaximu._types import Array
from jaximu.observations import Observations
from jaximu.precision import require_float64
from jaximu.problem import TOLERANCE, Parameters, Problem, unflatten
from jaximu.residuals import (
    gravity_direction,
    gravity_norm,
    joint_conditions,
    joint_gravity,
    static_gyroscope,
    static_gyroscope_error,
)
from jaximu.residuals.gravity_direction import unit_vectors
from jaximu.residuals.gravity_norm import recover_specific_force
from jaximu.sensor import Imu
from jaximu.solver import solve, solve_batch
from jaximu.whitening import (
    condition_covariance,
    inverse_cholesky,
    pose_weights,
    static_covariances,
    turn_weights,
    update_excess,
)

__all__ = ["METHODS", "Fit", "fit_hand_held", "keep_free", "robust_excess"]

EXCESS_NAMES = ("accelerometer", "turns", "gyroscope")


class Fit(eqx.Module):
    """A solved problem, or with leading axes N a batch of them.

    `covariance` is of the free parameters in their own units, without gravity's uncertainty, to which each parameter
    reacts by `gravity_sensitivity` (per m/s²). `excess` is the variance, beyond the measured noise and in multiples of
    it, of accelerometer means, turns and gyroscope means at rest: above zero, the model or the noise misses something.
    `residual` and `jacobian` are whitened, the latter with respect to parameters in typical sizes.
    """

    model: Imu
    parameters: Parameters
    covariance: Float[Array, "... p p"]
    gravity_sensitivity: Float[Array, "... p"]
    residual: Float[Array, "... n"]
    jacobian: Float[Array, "... n p"]
    excess: Float[Array, "... 3"]
    cost: Float[Array, ...]
    steps: Int[Array, ...]
    converged: Bool[Array, ...]
    finite: Bool[Array, ...]

    def sigmas(self, gravity_sigma: float = 0.0) -> Float[Array, "... p"]:
        """Return the standard deviations of the free parameters, the uncertainty of gravity included."""
        return np.sqrt(np.diagonal(self.total_covariance(gravity_sigma), axis1=-2, axis2=-1))

    def total_covariance(self, gravity_sigma: float = 0.0) -> Float[Array, "... p p"]:
        """Return the covariance with what an uncertain gravity (m/s², one sigma) adds."""
        reach = np.asarray(self.gravity_sensitivity) * gravity_sigma
        return np.asarray(self.covariance) + reach[..., :, None] * reach[..., None, :]


class _Pass(eqx.Module):
    """What one pass returns."""

    z: Array
    excess: Array
    residual: Array
    jacobian: Array
    covariance: Array
    gravity: Array
    cost: Array
    steps: Array
    converged: Array
    finite: Array


def _norm_residual(imu: Imu, data) -> Array:
    observations, weights = data
    return gravity_norm(imu, observations, weights)


def _joint_residual(imu: Imu, data) -> Array:
    observations, weights, rest = data
    if rest is None:  # a noise model ties the means at rest to the turns: one matrix of weights for all
        at_rest = static_gyroscope_error(imu, observations).reshape(-1)
        return weights @ jnp.concatenate([joint_conditions(imu, observations), at_rest])
    return jnp.concatenate([joint_gravity(imu, observations, weights), static_gyroscope(imu, observations, rest)])


def _gyroscope_residual(imu: Imu, data) -> Array:
    observations, weights, rest, directions = data
    turned = gravity_direction(imu, observations, directions, weights)
    return jnp.concatenate([turned, static_gyroscope(imu, observations, rest)])


def _gyroscope_residual_rk4(imu: Imu, data) -> Array:
    observations, weights, rest, directions = data
    turned = gravity_direction(imu, observations, directions, weights, "rk4")
    return jnp.concatenate([turned, static_gyroscope(imu, observations, rest)])


def _blocks(*parts: Array) -> Array:
    """Put blocks (k, m, m) and square matrices on one diagonal."""
    matrices = [jax.scipy.linalg.block_diag(*part) if part.ndim == 3 else part for part in parts]
    return jax.scipy.linalg.block_diag(*matrices)


def _static(observations: Observations, excess: Array) -> tuple[Array, Array]:
    """Weights of the means at rest, and the whitened unit excess as one matrix."""
    measured, unit = static_covariances(observations)
    weights = inverse_cholesky(measured + excess * unit)
    whitened = observations.poses.mask[:, None, None] * (weights @ unit @ jnp.swapaxes(weights, -1, -2))
    return weights, _blocks(whitened)


def _joint_problem(model: Imu, observations: Observations, excess: Array):
    covariance = condition_covariance(model, observations)
    weights = inverse_cholesky(covariance.total(excess))
    poses, turns = len(observations.poses.mask), len(observations.turns.mask)
    groups = np.repeat([0, 1, 2], [poses, 2 * turns, 3 * poses])
    if covariance.gyroscope is not None:
        units = (covariance.accelerometer, covariance.turns, covariance.gyroscope)
        return (observations, weights, None), lambda: tuple(weights @ each @ weights.T for each in units), groups
    rest_weights, rest = _static(observations, excess[2])
    zero, none = jnp.zeros_like(weights), jnp.zeros_like(rest)

    def parts():
        own = [weights @ part @ weights.T for part in (covariance.accelerometer, covariance.turns)]
        return (*(_blocks(part, none) for part in own), _blocks(zero, rest))

    return (observations, weights, rest_weights), parts, groups


def _norm_problem(model: Imu, observations: Observations, excess: Array):
    covariance = condition_covariance(model, observations)
    poses = len(observations.poses.mask)
    weights = pose_weights(covariance, poses, excess)
    unit = jnp.diag(weights**2 * jnp.diagonal(covariance.accelerometer)[:poses])
    return (observations, weights), lambda: (unit,), np.zeros(poses)


def _gyroscope_problem(model: Imu, observations: Observations, excess: Array):
    covariance = condition_covariance(model, observations)
    poses, turns = len(observations.poses.mask), len(observations.turns.mask)
    directions = unit_vectors(recover_specific_force(model, observations.poses))
    weights = turn_weights(covariance, poses, excess)
    rest_weights, rest = _static(observations, excess[2])

    def parts():
        rows = jnp.arange(poses, poses + 2 * turns).reshape(-1, 2)
        unit = covariance.turns[rows[:, :, None], rows[:, None, :]]
        turning = _blocks(weights @ unit @ jnp.swapaxes(weights, -1, -2))
        return _blocks(turning, jnp.zeros_like(rest)), _blocks(jnp.zeros_like(turning), rest)

    groups = np.repeat([1, 2], [2 * turns, 3 * poses])
    return (observations, weights, rest_weights, directions), parts, groups


_PROBLEMS: dict[str, tuple[Callable[..., Any], Callable[..., Any], tuple[int, ...]]] = {
    # name: residual, its data at a model, which kinds of excess it can improve
    "joint": (_joint_residual, _joint_problem, (0, 1, 2)),
    "accelerometer": (_norm_residual, _norm_problem, (0,)),
    "gyroscope": (_gyroscope_residual, _gyroscope_problem, (1, 2)),
    "gyroscope_rk4": (_gyroscope_residual_rk4, _gyroscope_problem, (1, 2)),
}


def robust_excess(residual: Array, groups: np.ndarray | Array, improved: tuple[int, ...], excess: Array) -> Array:
    """Excess from the median absolute residual of each group of rows: outliers do not reach it."""
    size = jnp.where(residual == 0.0, jnp.nan, jnp.abs(residual))  # padding is exactly zero
    found = [jnp.nanmedian(jnp.where(groups == group, size, jnp.nan)) / 0.6745 for group in improved]
    return jnp.maximum((1 + excess) * jnp.nan_to_num(jnp.stack(found), nan=1.0) ** 2 - 1, 0.0)


def _single_pass(name: str, loss: str, limit: Array, like: Imu, parameters: Parameters, unit) -> _Pass:
    observations, z, excess, tolerance = unit
    residual, build, improved = _PROBLEMS[name]
    model = parameters.model(like, z)
    data, parts, groups = build(model, observations, excess)
    problem = Problem(like, parameters, data, residual, loss, tolerance)
    solution = solve(problem, z, limit)
    places = jnp.array(improved)
    if loss == "linear":
        better = update_excess(solution.residual, solution.jacobian, parts(), excess[places])
    else:
        better = robust_excess(problem.residuals(solution.z), groups, improved, excess[places])
    information = solution.jacobian.T @ solution.jacobian + jnp.eye(len(z)) / tolerance**2
    covariance = jnp.linalg.inv(information)

    def of_gravity(gravity):
        shifted = eqx.tree_at(lambda p: p.data[0].gravity, problem, gravity)
        return shifted.objective(solution.z)[0]

    slope = jax.jvp(of_gravity, (observations.gravity,), (jnp.ones_like(observations.gravity),))[1]
    reach = -covariance @ (solution.jacobian.T @ slope)
    return _Pass(
        solution.z, excess.at[places].set(better), solution.residual, solution.jacobian,
        covariance, reach, solution.cost, solution.steps, solution.converged, solution.finite,
    )  # fmt: skip


def _run(name: str, loss: str, limit: int, like: Imu, parameters: Parameters, units) -> _Pass:
    """Run one pass for a batch of units; a compiled function for each problem, loss and shape."""

    def batch(limit, like, parameters, units):
        def one(parameters, unit):
            return _single_pass(name, loss, limit, like, parameters, unit)

        # Lanes run one after the other inside the compiled loop: a lane stops when it has converged, its matrices stay
        # in the cache, and XLA's thread pool, which can lock up when large batched products nest in a loop on a CPU
        # with few cores, is not drawn upon. On an accelerator lanes run side by side.
        lanes = None if jax.default_backend() == "cpu" else units[1].shape[0]

        def lane(item):
            reference, unit = item
            return one(eqx.tree_at(lambda p: p.reference, parameters, reference), unit)

        return jax.lax.map(lane, (parameters.reference, units), batch_size=lanes)

    return _Pass(*stored.call(batch, f"{name} {loss}", np.asarray(limit), like, parameters, units))


def keep_free(name: str) -> Callable[[str], bool]:
    """Which numbers are free: the accelerometer's gain is lower triangular, which fixes the body frame (S6)."""
    upper = ("accelerometer.gain[0,1]", "accelerometer.gain[0,2]", "accelerometer.gain[1,2]")
    triads = {"joint": ("accelerometer", "gyroscope"), "accelerometer": ("accelerometer",)}.get(name, ("gyroscope",))
    return lambda path: path.split(".")[0] in triads and path not in upper


def _solve_passes(
    name: str, nominal: Imu, observations: Observations, excess, loss: str, max_passes: int
) -> tuple[Parameters, _Pass]:
    """Alternate solving and reweighting until the excess stands still, only the lanes that still move."""
    parameters = Parameters.select(jax.tree.map(lambda leaf: leaf[0], nominal), keep_free(name))
    count = excess.shape[0]
    reference = np.concatenate([np.reshape(leaf, (count, -1)) for leaf in jax.tree.leaves(nominal)], axis=1)
    parameters = eqx.tree_at(lambda p: p.reference, parameters, reference)
    like = jax.tree.map(lambda leaf: leaf[0], nominal)
    z = np.zeros((count, len(parameters.names)))
    tolerance = np.ones(count)  # for the first pass; later ones leave the data sheet further behind

    def run(batched, steps):
        reference, units = batched
        return _run(name, loss, steps, like, eqx.tree_at(lambda p: p.reference, parameters, reference), units)

    result, used = None, None
    active = np.arange(count)
    for _ in range(max_passes):
        pick = lambda tree, lanes=active: jax.tree.map(lambda leaf: leaf[lanes], tree)  # noqa: E731
        given = np.asarray(excess)[active]
        out = solve_batch(pick((parameters.reference, (observations, z, np.asarray(excess), tolerance))), run)
        if result is None:
            result, used = out, given.copy()
        else:
            assert used is not None
            result = jax.tree.map(lambda leaf, new, lanes=active: _put(leaf, lanes, new), result, out)
            used[active] = given
        moved = (np.abs(np.asarray(out.excess) - given) / (1 + given)).max(axis=1) > 0.05
        first = bool(tolerance[0] < TOLERANCE)  # it was weighted at the data sheet's values: weight once more
        tolerance = np.full(count, TOLERANCE)
        z, excess = np.asarray(result.z), np.asarray(result.excess)
        active = active if first else active[moved]
        if not len(active):
            break
    assert result is not None and used is not None
    return parameters, eqx.tree_at(lambda r: r.excess, result, used)


def _put(leaf, lanes, new):
    leaf = np.array(leaf)
    leaf[lanes] = new
    return leaf


# The first pass starts at the data sheet's values, percents away: weights as sharp as the noise would make it chase
# wrong minima, so they are blunted by this excess. The next pass finds the right ones.
COARSE_EXCESS = np.array([1e2, 1e4, 1e2])

METHODS = ("joint", "two-step", "two-step-rk4", "accelerometer")


def fit_hand_held(
    nominal: Imu, observations: Observations, method: str = "joint", loss: str = "linear", max_passes: int = 8
) -> Fit:
    """Fit poses and turns without equipment; one unit, or a batch with one leading axis on every array.

    **Arguments:**

    - `nominal`: the unit as its data sheet has it: where the fit starts, and the frame (accelerometer gain lower
      triangular).
    - `method`: `"joint"` maximum likelihood of both triads; `"two-step"`, accelerometer by the gravity norm and then
      the gyroscope by the direction of gravity (Tedaldi et al. 2014; `"two-step-rk4"` with their integration);
      `"accelerometer"` alone.
    - `loss`: `"linear"`, `"huber"` or `"cauchy"`.

    **Returns:** a `Fit` with the same leading axes. Look at `converged` and `finite`: failures do not raise, so that
    one bad unit does not stop a batch.
    """
    require_float64()
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}: use one of {', '.join(METHODS)}")
    single = observations.gravity.ndim == 0
    # NumPy from here on: slicing lanes out of JAX arrays compiles a program for every shape
    lift = (lambda leaf: np.asarray(leaf)[None]) if single else np.asarray
    nominal, observations = jax.tree.map(lift, (nominal, observations))
    count = observations.gravity.shape[0]
    excess = np.tile(COARSE_EXCESS, (count, 1))
    if method in ("joint", "accelerometer"):
        fit = _finish(nominal, *_solve_passes(method, nominal, observations, excess, loss, max_passes))
    else:
        first = _finish(nominal, *_solve_passes("accelerometer", nominal, observations, excess, loss, max_passes))
        name = "gyroscope" if method == "two-step" else "gyroscope_rk4"
        solved = _solve_passes(name, first.model, observations, first.excess, loss, max_passes)
        fit = _merge(first, _finish(first.model, *solved))
        fit = eqx.tree_at(lambda f: f.covariance, fit, _two_step_covariance(fit, observations))
    return jax.tree.map(lambda leaf: leaf[0], _squeezable(fit)) if single else fit


def _finish(nominal: Imu, parameters: Parameters, result: _Pass) -> Fit:
    like = jax.tree.map(lambda leaf: np.asarray(leaf)[0], nominal)
    size = np.asarray(parameters.size)
    flat = np.array(parameters.reference)
    flat[:, list(parameters.index)] += size * np.asarray(result.z)
    model = unflatten(like, flat)
    covariance = np.asarray(result.covariance) * size[:, None] * size
    return Fit(
        model, parameters, covariance, np.asarray(result.gravity) * size, np.asarray(result.residual),
        np.asarray(result.jacobian), np.asarray(result.excess), np.asarray(result.cost), np.asarray(result.steps),
        np.asarray(result.converged), np.asarray(result.finite),
    )  # fmt: skip


def _squeezable(fit: Fit) -> Fit:
    """Give the shared sizes a batch axis, so that one index takes a lane of everything."""
    return eqx.tree_at(lambda f: f.parameters.size, fit, np.asarray(fit.parameters.size)[None])


def _merge(first: Fit, second: Fit) -> Fit:
    """Put the two steps' parameters side by side."""

    def block(a, b):
        rows, columns = a.shape[1] + b.shape[1], a.shape[2] + b.shape[2]
        out = np.zeros((len(a), rows, columns))
        out[:, : a.shape[1], : a.shape[2]], out[:, a.shape[1] :, a.shape[2] :] = a, b
        return out

    a, b = first.parameters, second.parameters
    parameters = Parameters(
        b.reference, np.concatenate([np.asarray(a.size), np.asarray(b.size)]), a.index + b.index, a.names + b.names
    )
    return Fit(
        second.model, parameters, block(first.covariance, second.covariance),
        np.concatenate([first.gravity_sensitivity, second.gravity_sensitivity], axis=1),
        np.concatenate([first.residual, second.residual], axis=1), block(first.jacobian, second.jacobian),
        np.concatenate([first.excess[:, :1], second.excess[:, 1:]], axis=1), first.cost + second.cost,
        np.maximum(first.steps, second.steps), first.converged & second.converged, first.finite & second.finite,
    )  # fmt: skip


def _two_step_covariance(fit: Fit, observations: Observations) -> np.ndarray:
    """Return the covariance (N, p, p) of both steps together, in the parameters' units.

    The second step takes the accelerometer as known and neighbouring turns as independent. Neither is true: its own
    (JᵀJ)⁻¹ is too small by a tenth in the misalignments. With c the joint conditions, C their covariance and D
    how the directions react to the accelerometer's parameters, both steps are linear in c to first order:
    δa = L c_norm, δg = G (c_direction + D L c_norm), so the covariance is T C Tᵀ, T = [[L, 0], [G D L, G]], and what
    the means at rest add to g.
    """
    parameters, count = fit.parameters, len(fit.cost)
    reference = np.concatenate([np.reshape(leaf, (count, -1)) for leaf in jax.tree.leaves(fit.model)], axis=1)
    like = jax.tree.map(lambda leaf: leaf[0], fit.model)
    accelerometer = sum(name.startswith("accelerometer") for name in parameters.names)

    def batch(like, parameters, units):
        def lane(unit):
            reference, observations, excess, gyroscope_jacobian = unit
            own = eqx.tree_at(lambda p: p.reference, parameters, reference)
            zero = jnp.zeros(len(parameters.index))
            model = own.model(like, zero)
            covariance = condition_covariance(model, observations)
            poses, turns = len(observations.poses.mask), len(observations.turns.mask)
            slope = jax.jacfwd(lambda z: joint_conditions(own.model(like, z), observations))(zero)
            norm = pose_weights(covariance, poses, excess)
            whitened = norm[:, None] * slope[:poses, :accelerometer]
            tolerance = jnp.eye(accelerometer) / TOLERANCE**2
            first = -jnp.linalg.solve(whitened.T @ whitened + tolerance, whitened.T * norm)

            weights = turn_weights(covariance, poses, excess)
            by_gyroscope = slope[poses:, accelerometer:].reshape(turns, 2, -1)
            direction = jnp.einsum("tab,tbp->tap", weights, by_gyroscope)
            size = len(zero) - accelerometer
            information = gyroscope_jacobian.T @ gyroscope_jacobian + jnp.eye(size) / TOLERANCE**2
            spread = jnp.linalg.inv(information)
            second = -spread @ jnp.einsum("tap,tab->ptb", direction, weights).reshape(size, -1)

            none = jnp.zeros((accelerometer, 2 * turns))
            total = jnp.concatenate([
                jnp.concatenate([first, none], axis=1),
                jnp.concatenate([second @ slope[poses:, :accelerometer] @ first, second], axis=1),
            ])  # fmt: skip
            rest = gyroscope_jacobian[2 * turns :]
            of_rest = spread @ (rest.T @ rest) @ spread
            conditions = total.shape[1]  # a noise model's rows of the means at rest follow these
            found = total @ covariance.total(excess)[:conditions, :conditions] @ total.T
            return (found.at[accelerometer:, accelerometer:].add(of_rest),)

        return jax.lax.map(lane, units)

    rows = fit.jacobian.shape[1] - 2 * observations.turns.mask.shape[1] - 3 * observations.poses.mask.shape[1]
    units = (reference, observations, fit.excess, fit.jacobian[:, rows:, accelerometer:])
    size = np.asarray(parameters.size)
    return np.asarray(stored.call(batch, "two-step covariance", like, parameters, units)[0]) * size[:, None] * size
