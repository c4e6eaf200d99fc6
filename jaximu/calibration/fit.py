"""`Fit`: the solved problem of one unit, and the recipe's solver for one or many."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaximu.observations import Observations
from jaximu.problem import TOLERANCE, Parameters, Problem, require_float64
from jaximu.residuals import gravity_direction, gravity_norm, joint_gravity, static_gyroscope
from jaximu.residuals.gravity_direction import unit_vectors
from jaximu.residuals.gravity_norm import recover_specific_force
from jaximu.sensor import Imu
from jaximu.solver import solve, solve_batch
from jaximu.whitening import (
    condition_covariance,
    inverse_cholesky,
    pose_weights,
    static_weights,
    turn_weights,
    variance_scales,
)

__all__ = ["METHODS", "Fit", "fit_hand_held"]

SCALE_NAMES = ("accelerometer", "turns", "gyroscope")


class Fit(eqx.Module):
    """A solved problem, or with leading axes N a batch of them.

    `covariance` is of the free parameters in their own units, without gravity's uncertainty, to which each parameter
    reacts by `gravity_sensitivity` (per m/s²). `scales` are the variance scales of accelerometer means, turns and
    gyroscope means at rest: above one, the model or the noise misses something there. `residual` and `jacobian` are
    whitened, the latter with respect to parameters in typical sizes.
    """

    model: Imu
    parameters: Parameters
    covariance: Float[Array, "... p p"]
    gravity_sensitivity: Float[Array, "... p"]
    residual: Float[Array, "... n"]
    jacobian: Float[Array, "... n p"]
    scales: Float[Array, "... 3"]
    cost: Float[Array, "..."]
    steps: Int[Array, "..."]
    converged: Bool[Array, "..."]
    finite: Bool[Array, "..."]

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
    scales: Array
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
    return jnp.concatenate([joint_gravity(imu, observations, weights), static_gyroscope(imu, observations, rest)])


def _gyroscope_residual(imu: Imu, data) -> Array:
    observations, weights, rest, directions = data
    turned = gravity_direction(imu, observations, directions, weights)
    return jnp.concatenate([turned, static_gyroscope(imu, observations, rest)])


def _gyroscope_residual_rk4(imu: Imu, data) -> Array:
    observations, weights, rest, directions = data
    turned = gravity_direction(imu, observations, directions, weights, "rk4")
    return jnp.concatenate([turned, static_gyroscope(imu, observations, rest)])


def _diagonals(*groups: tuple[Array, Array]) -> tuple[Array, ...]:
    """Return diagonal parts, one for each group of rows: its mask over its scale, zero elsewhere."""
    sizes = [len(mask) for mask, _ in groups]
    parts = []
    for index, (mask, scale) in enumerate(groups):
        before, after = sum(sizes[:index]), sum(sizes[index + 1 :])
        parts.append(jnp.diag(jnp.concatenate([jnp.zeros(before), mask / scale, jnp.zeros(after)])))
    return tuple(parts)


def _joint_problem(model: Imu, observations: Observations, scales: Array):
    covariance = condition_covariance(model, observations)
    weights = inverse_cholesky(covariance.total(scales))
    data = (observations, weights, static_weights(observations, scales[2]))
    rest = jnp.repeat(observations.poses.mask, 3).astype(weights.dtype)
    count = len(rest)

    def parts():
        both = covariance.used[:, None] * covariance.used
        own = [weights @ (both * part) @ weights.T for part in (covariance.accelerometer, covariance.turns)]
        return (*(jnp.pad(part, (0, count)) for part in own), jnp.diag(jnp.pad(rest / scales[2], (len(weights), 0))))

    groups = jnp.concatenate([jnp.zeros(len(observations.poses.mask)), jnp.ones(2 * len(observations.turns.mask)),
                              jnp.full(count, 2.0)])  # fmt: skip
    return data, parts, groups


def _norm_problem(model: Imu, observations: Observations, scales: Array):
    if model.gyroscope is None:
        raise AssertionError("the caller gives a nominal gyroscope")
    covariance = condition_covariance(model, observations)
    mask = observations.poses.mask
    data = (observations, pose_weights(covariance, len(mask), scales[0]))
    return data, lambda: _diagonals((mask.astype(scales.dtype), scales[0])), jnp.zeros(len(mask))


def _gyroscope_problem(model: Imu, observations: Observations, scales: Array):
    covariance = condition_covariance(model, observations)
    poses, turns = observations.poses.mask, observations.turns.mask
    directions = unit_vectors(recover_specific_force(model, observations.poses))
    data = (
        observations,
        turn_weights(covariance, len(poses), scales.at[0].set(1.0)),
        static_weights(observations, scales[2]),
        directions,
    )
    masks = (jnp.repeat(turns, 2).astype(scales.dtype), scales[1]), (jnp.repeat(poses, 3).astype(scales.dtype), scales[2])
    groups = jnp.concatenate([jnp.ones(2 * len(turns)), jnp.full(3 * len(poses), 2.0)])
    return data, lambda: _diagonals(*masks), groups


_PROBLEMS: dict[str, tuple[Callable[..., Any], Callable[..., Any], tuple[int, ...]]] = {
    # name: residual, its data at a model, which scales it can improve
    "joint": (_joint_residual, _joint_problem, (0, 1, 2)),
    "accelerometer": (_norm_residual, _norm_problem, (0,)),
    "gyroscope": (_gyroscope_residual, _gyroscope_problem, (1, 2)),
    "gyroscope_rk4": (_gyroscope_residual_rk4, _gyroscope_problem, (1, 2)),
}


def _robust_scales(residual: Array, groups: Array, improved: tuple[int, ...], scales: Array) -> Array:
    """Scales from the median absolute residual of each group of rows: outliers do not reach them."""
    size = jnp.where(residual == 0.0, jnp.nan, jnp.abs(residual))  # padding is exactly zero
    found = [jnp.nanmedian(jnp.where(groups == group, size, jnp.nan)) / 0.6745 for group in improved]
    return jnp.maximum(scales[jnp.array(improved)] * jnp.nan_to_num(jnp.stack(found), nan=1.0) ** 2, 1.0)


def _single_pass(name: str, loss: str, limit: Array, like: Imu, parameters: Parameters, unit) -> _Pass:
    observations, z, scales = unit
    residual, build, improved = _PROBLEMS[name]
    model = parameters.model(like, z)
    data, parts, groups = build(model, observations, scales)
    problem = Problem(like, parameters, data, residual, loss)
    solution = solve(problem, z, limit)
    if loss == "linear":
        places = jnp.array(improved)
        better = variance_scales(solution.residual, solution.jacobian, parts(), scales[places])
    else:
        better = _robust_scales(problem.residuals(solution.z), groups, improved, scales)
    information = solution.jacobian.T @ solution.jacobian + jnp.eye(len(z)) / TOLERANCE**2
    covariance = jnp.linalg.inv(information)

    def of_gravity(gravity):
        shifted = eqx.tree_at(lambda p: p.data[0].gravity, problem, gravity)
        return shifted.objective(solution.z)[0]

    slope = jax.jvp(of_gravity, (observations.gravity,), (jnp.ones_like(observations.gravity),))[1]
    reach = -covariance @ (solution.jacobian.T @ slope)
    return _Pass(
        solution.z, scales.at[jnp.array(improved)].set(better), solution.residual, solution.jacobian,
        covariance, reach, solution.cost, solution.steps, solution.converged, solution.finite,
    )  # fmt: skip


@eqx.filter_jit
def _run(name: str, loss: str, limit: Array, like: Imu, parameters: Parameters, units) -> _Pass:
    def one(parameters, unit):
        return _single_pass(name, loss, limit, like, parameters, unit)

    # a unit's reference (its nominal scale and offset) is its own, the sizes and structure are shared
    axes = eqx.tree_at(lambda p: p.reference, jax.tree.map(lambda _: None, parameters), 0, is_leaf=lambda x: x is None)
    return jax.vmap(one, in_axes=(axes, 0))(parameters, units)


def _keep(name: str) -> Callable[[str], bool]:
    """Which numbers are free: the accelerometer's gain is lower triangular, which fixes the body frame (S6)."""
    upper = ("accelerometer.gain[0,1]", "accelerometer.gain[0,2]", "accelerometer.gain[1,2]")
    triads = {"joint": ("accelerometer", "gyroscope"), "accelerometer": ("accelerometer",)}.get(name, ("gyroscope",))
    return lambda path: path.split(".")[0] in triads and path not in upper


def _solve_passes(
    name: str, nominal: Imu, observations: Observations, scales, loss: str, max_passes: int
) -> tuple[Parameters, _Pass]:
    """Alternate solving and reweighting until the variance scales stand still, only the lanes that still move."""
    parameters = Parameters.select(jax.tree.map(lambda leaf: leaf[0], nominal), _keep(name))
    ravel = jax.vmap(lambda imu: jax.flatten_util.ravel_pytree(imu)[0])
    parameters = eqx.tree_at(lambda p: p.reference, parameters, ravel(nominal))
    like = jax.tree.map(lambda leaf: leaf[0], nominal)
    count = scales.shape[0]
    z = np.zeros((count, len(parameters.names)))

    def run(batched, steps):
        reference, units = batched
        return _run(name, loss, jnp.asarray(steps), like, eqx.tree_at(lambda p: p.reference, parameters, reference), units)

    result, used = None, None
    active = np.arange(count)
    for _ in range(max_passes):
        pick = lambda tree, lanes=active: jax.tree.map(lambda leaf: leaf[lanes], tree)  # noqa: E731
        given = np.asarray(scales)[active]
        out = solve_batch(pick((parameters.reference, (observations, z, np.asarray(scales)))), run)
        if result is None:
            result, used = out, given.copy()
        else:
            assert used is not None
            result = jax.tree.map(lambda leaf, new, lanes=active: _put(leaf, lanes, new), result, out)
            used[active] = given
        moved = np.abs(np.log(np.asarray(out.scales) / given)).max(axis=1) > 0.05
        first = bool((z == 0).all())  # the first pass was weighted at the data sheet's values: weight once more
        z, scales = np.asarray(result.z), np.asarray(result.scales)
        active = active if first else active[moved]
        if not len(active):
            break
    assert result is not None and used is not None
    return parameters, eqx.tree_at(lambda r: r.scales, result, used)


def _put(leaf, lanes, new):
    leaf = np.array(leaf)
    leaf[lanes] = new
    return leaf


# The first pass starts at the data sheet's values, percents away: weights as sharp as the noise would make it chase
# wrong minima, so they are blunted by these variance scales. The next pass finds the right ones.
_COARSE = np.array([1e2, 1e4, 1e2])

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

    **Returns:** a `Fit` with the same leading axes. Look at `converged` and `finite`: failures do not raise, so that one
    bad unit does not stop a batch.
    """
    require_float64()
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}: use one of {', '.join(METHODS)}")
    single = observations.gravity.ndim == 0
    if single:
        nominal, observations = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (nominal, observations))
    count = observations.gravity.shape[0]
    scales = np.tile(_COARSE, (count, 1))
    if method in ("joint", "accelerometer"):
        fit = _finish(nominal, *_solve_passes(method, nominal, observations, scales, loss, max_passes))
    else:
        first = _finish(nominal, *_solve_passes("accelerometer", nominal, observations, scales, loss, max_passes))
        name = "gyroscope" if method == "two-step" else "gyroscope_rk4"
        solved = _solve_passes(name, first.model, observations, first.scales, loss, max_passes)
        fit = _merge(first, _finish(first.model, *solved))
    return jax.tree.map(lambda leaf: leaf[0], _squeezable(fit)) if single else fit


def _finish(nominal: Imu, parameters: Parameters, result: _Pass) -> Fit:
    like = jax.tree.map(lambda leaf: np.asarray(leaf)[0], nominal)
    size = np.asarray(parameters.size)
    flat = np.array(parameters.reference)
    flat[:, list(parameters.index)] += size * np.asarray(result.z)
    unravel = jax.flatten_util.ravel_pytree(like)[1]
    leaves = [unravel(row) for row in flat] if len(flat) == 1 else None
    model = (
        jax.tree.map(lambda *rows: np.stack(rows), *leaves) if leaves else jax.tree.map(np.asarray, jax.vmap(unravel)(flat))
    )
    covariance = np.asarray(result.covariance) * size[:, None] * size
    return Fit(
        model, parameters, covariance, np.asarray(result.gravity) * size, np.asarray(result.residual),
        np.asarray(result.jacobian), np.asarray(result.scales), np.asarray(result.cost), np.asarray(result.steps),
        np.asarray(result.converged), np.asarray(result.finite),
    )  # fmt: skip


def _squeezable(fit: Fit) -> Fit:
    """Give the shared sizes a batch axis, so that one index takes a lane of everything."""
    return eqx.tree_at(lambda f: f.parameters.size, fit, np.asarray(fit.parameters.size)[None])


def _merge(first: Fit, second: Fit) -> Fit:
    """Put the two steps' parameters side by side; their correlation is not part of the two-step method."""

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
        np.concatenate([first.scales[:, :1], second.scales[:, 1:]], axis=1), first.cost + second.cost,
        np.maximum(first.steps, second.steps), first.converged & second.converged, first.finite & second.finite,
    )  # fmt: skip
