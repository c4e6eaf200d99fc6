"""Levenberg–Marquardt for calibration problems: optimistix's, with a stop rule for batches, and failures in words."""

import enum
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from jaximu.problem import Problem

__all__ = ["Failure", "LevenbergMarquardt", "Solution", "solve", "solve_batch"]


class Failure(enum.Enum):
    """How a solve can end other than well; the value tells the user what to do."""

    NONE = "solved"
    MAX_STEPS = (
        "the fit did not converge in the steps allowed: outliers or a wrong unit are the usual reason; look at the "
        "residuals by pose, or use --loss cauchy"
    )
    NONFINITE = "the fit met numbers that are not finite: a channel or a start value is unusable"


class LevenbergMarquardt(optx.LevenbergMarquardt):
    """optimistix's Levenberg–Marquardt that also stops when the step it proposes is below tolerance.

    The original stops on an accepted step only. At the optimum rounding decides whether a step counts as progress, so
    some lanes of a batch reject for twenty more steps while all others wait. A proposal is small also under heavy
    damping, far from any optimum: it counts only while the damping is no more than at the start.
    """

    def step(self, fn, y, args, options, state, tags):
        y, state, aux = super().step(fn, y, args, options, state, tags)
        proposed = self.norm(state.y_eval - y)
        small = proposed < self.atol + self.rtol * self.norm(y)
        done = state.terminate | (small & (state.search_state.step_size >= 1) & (state.num_accepted_steps > 0))
        return y, eqx.tree_at(lambda s: s.terminate, state, done), aux


class Solution(eqx.Module):
    """A solved problem: z, the whitened residuals and their Jacobian there, and how the solver ended.

    `jacobian` and `residual` are of the data alone, after the loss; `converged` is False where `steps` ran out and
    `finite` where the numbers did.
    """

    z: Float[Array, " p"]
    residual: Float[Array, " n"]
    jacobian: Float[Array, "n p"]
    cost: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]
    finite: Bool[Array, ""]

    def failure(self) -> Failure:
        """Return how an unbatched solve ended."""
        if not bool(self.finite):
            return Failure.NONFINITE
        return Failure.NONE if bool(self.converged) else Failure.MAX_STEPS


def solve(problem: Problem, start: Float[Array, " p"], max_steps: int = 256, tolerance: float = 1e-9) -> Solution:
    """Solve one problem from z = `start`; traceable, so that callers jit and vmap it.

    Parameters are of order one in `z` and residuals whitened, so one absolute tolerance (a billionth of a data sheet's
    tolerance) suits all.
    """
    # Cholesky of the normal equations: the tolerance rows keep them well conditioned, and QR costs four times as much.
    solver = LevenbergMarquardt(rtol=tolerance, atol=tolerance, linear_solver=lx.Normal(lx.Cholesky()))
    found = optx.least_squares(
        lambda z, problem: problem.objective(z), solver, start, args=problem, max_steps=max_steps, throw=False
    )
    z = found.value

    def data_part(z):
        value = problem.objective(z)[0]
        return value, value

    jacobian, residual = jax.jacfwd(data_part, has_aux=True)(z)
    finite = jnp.isfinite(residual).all() & jnp.isfinite(jacobian).all() & jnp.isfinite(z).all()
    cost = 0.5 * (jnp.sum(residual**2) + jnp.sum(z**2))
    converged = (found.result == optx.RESULTS.successful) & finite
    return Solution(z, residual, jacobian, cost, found.stats["num_steps"], converged, finite)


def solve_batch(batched: Any, run: Any, quick_steps: int = 12, max_steps: int = 256, chunk: int = 64) -> Any:
    """Run a batched solve in two stages: a few steps for all lanes, then only the unfinished ones.

    Under vmap every lane computes until the slowest ends, so one outlier would cost the whole batch.

    **Arguments:**

    - `batched`: PyTree whose arrays have one leading axis of N units.
    - `run`: `run(batched, max_steps)` solves a batch and returns a PyTree with a boolean leaf `converged` (N,); it is
      expected to be jitted with `max_steps` static. It sees chunks of at most `chunk` units, padded by repetition, so
      that its arrays stay in the cache and only two shapes are compiled.
    """

    def rows(tree, index):
        return jax.tree.map(lambda leaf: leaf[index], tree)

    def stage(index, steps):
        size = 1 if len(index) == 1 else min(chunk, 8 if len(index) <= 8 else chunk)
        pieces = []
        for first in range(0, len(index), size):
            part = index[first : first + size]
            padded = np.concatenate([part, np.full(size - len(part), part[-1])])
            solved = run(rows(batched, padded), steps)
            pieces.append(jax.tree.map(lambda leaf, n=len(part): np.asarray(leaf)[:n], solved))
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *pieces)

    count = jax.tree.leaves(batched)[0].shape[0]
    result = stage(np.arange(count), quick_steps)
    left = np.flatnonzero(~result.converged)
    if len(left):
        again = stage(left, max_steps)

        def put(leaf, new):
            leaf = leaf.copy()
            leaf[left] = new
            return leaf

        result = jax.tree.map(put, result, again)
    return result
