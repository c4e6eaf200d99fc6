"""Solving calibration problems by Levenberg–Marquardt, with failures in words."""

import enum
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from jaximu.estimation.problem import Problem
from jaximu.ground.array_types import Array, Computed
from jaximu.ground.differences import value_and_jacobian
from jaximu.ground.precision import require_float64


class Failure(enum.Enum):
    """How a solve can end other than well; the value tells the user what to do."""

    NONE = "solved"
    MAX_STEPS = (
        "the fit did not converge in the steps allowed: outliers or a wrong unit are the usual reason; look at the "
        "residuals by pose, or use --loss cauchy"
    )
    NONFINITE = "the fit met numbers that are not finite: a channel or a start value is unusable"

    @classmethod
    def of(cls, converged: Any, finite: Any) -> "Failure":
        """Return how a solve ended that converged, or met numbers that are not finite, or neither."""
        if not finite:
            return cls.NONFINITE
        return cls.NONE if converged else cls.MAX_STEPS


class Solution(eqx.Module):
    """A solved problem: z, the whitened residuals and their Jacobian there, and how the solver ended.

    `jacobian` and `residual` are of the data alone, after the loss; `converged` is False where `steps` ran out and
    `finite` where the numbers did.
    """

    z: Float[Computed, " p"]
    residual: Float[Computed, " n"]
    jacobian: Float[Computed, "n p"]
    cost: Float[Computed, ""]
    steps: Int[Computed, ""]
    converged: Bool[Computed, ""]
    finite: Bool[Computed, ""]

    def failure(self) -> Failure:
        """Return how an unbatched solve ended."""
        return Failure.of(self.converged, self.finite)


MAX_STEPS = 256


@jax.custom_jvp
def _objective(z, problem):
    return problem.objective(z)


def _objective_jvp(primals, tangents):
    """Derive the objective as one product with its whole Jacobian.

    optimistix asks for products with the linearised objective and with its transpose, each of which would be traced,
    transposed and compiled on its own; a matrix, made once a step, halves the compile time.
    """
    z, problem = primals
    z_dot, problem_dot = tangents

    value, jacobian = value_and_jacobian(problem.objective, z)
    moved = jax.tree.map(lambda j, v: jnp.zeros_like(v) if _is_zero(z_dot) else j @ z_dot, jacobian, value)
    if not all(_is_zero(leaf) for leaf in jax.tree.leaves(problem_dot, is_leaf=_is_zero)):
        # Only implicit differentiation of a solution asks how the objective moves with the data.
        moving, fixed = eqx.partition(problem, eqx.is_inexact_array)
        filled = jax.tree.map(
            lambda leaf, dot: jnp.zeros_like(leaf) if _is_zero(dot) else dot,
            moving,
            _only(problem_dot, moving),
        )
        by_data = jax.jvp(lambda m: eqx.combine(m, fixed).objective(z), (moving,), (filled,))[1]
        moved = jax.tree.map(jnp.add, moved, by_data)
    return value, moved


def _is_zero(tangent) -> bool:
    return isinstance(tangent, jax.custom_derivatives.SymbolicZero)


def _only(tangents, moving):
    """Keep the tangents of those leaves that `moving` keeps."""
    return jax.tree.map(
        lambda leaf, dot: None if leaf is None else dot, moving, tangents, is_leaf=lambda leaf: leaf is None
    )


_objective.defjvp(_objective_jvp, symbolic_zeros=True)


def solve(
    problem: Problem | Any,
    start: Float[Array, " p"],
    limit: int | Int[Array, ""] = MAX_STEPS,
    tolerance: float = 1e-9,
    solver: Any = None,
) -> Solution:
    """Solve one problem from z = `start`; traceable, so that callers jit and vmap it.

    **Arguments:** `problem`: a `Problem`, or another module with its `objective`. `solver`: an optimistix least-squares
    solver in place of ours.

    Raises `InputError` unless JAX computes in double precision.

    `limit` is the number of steps allowed, at most `MAX_STEPS`. Parameters are of order one in `z` and residuals
    whitened, so one absolute tolerance (a billionth of a typical size) suits all.
    """
    # only tracing needs these: a command whose traces are stored does not load them
    import lineax as lx
    import optimistix as optx

    from jaximu.estimation.levenberg_marquardt import LevenbergMarquardt

    require_float64()
    # Cholesky of the normal equations: the tolerance rows keep them well conditioned, and QR costs four times as much.
    usual = LevenbergMarquardt(rtol=tolerance, atol=tolerance, linear_solver=lx.Normal(lx.Cholesky()))  # pyright: ignore[reportCallIssue]
    ended = optx.least_squares(
        _objective,
        usual if solver is None else solver,
        start,
        args=problem,
        options={"limit": jnp.asarray(limit)},
        max_steps=MAX_STEPS,
        throw=False,
    )
    z = ended.value
    (residual, beforehand), (jacobian, _) = value_and_jacobian(problem.objective, z)
    finite = jnp.isfinite(residual).all() & jnp.isfinite(jacobian).all() & jnp.isfinite(z).all()
    cost = 0.5 * (jnp.sum(residual**2) + jnp.sum(beforehand**2))
    converged = (ended.result == optx.RESULTS.successful) & (ended.stats["num_steps"] < limit) & finite
    return Solution(z, residual, jacobian, cost, ended.stats["num_steps"], converged, finite)
