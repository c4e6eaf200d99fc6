"""Fits of poses and turns without equipment: jointly, or in the two steps of Tedaldi, Pretto and Menegatti (2014)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from jaximu.data.poses import PosesAndTurns, condense, only
from jaximu.estimation.covariance import inverse_cholesky
from jaximu.estimation.fitting import Fit, Prior, fit
from jaximu.estimation.problem import TOLERANCE, Loss, Name, Parameters, without_equipment
from jaximu.ground import stored
from jaximu.ground.array_types import Array
from jaximu.ground.errors import one_of
from jaximu.ground.tracing import first as first_of
from jaximu.ground.tracing import lifted
from jaximu.model.sensor import Imu
from jaximu.recordings.observations import Observations

Method = Literal["joint", "two-step", "two-step-rk4", "accelerometer"]
_ACROSS = 0.01
"""Standard deviation of a misalignment, rad: data sheets of MEMS sensors state a cross-axis sensitivity of ±2 %
(InvenSense, MPU-6000 and MPU-6050 Product Specification, rev. 3.4, 2013, sec. 6.2)."""
MISALIGNMENTS_HELD = (
    f"{{}} poses leave misalignments open: they were taken to be zero within ±{200 * _ACROSS:g} % (95 %), as data "
    "sheets state the cross-axis sensitivity."
)
"""What is said where they are, with the number of poses."""


def fit_hand_held(nominal: Imu, observations: Observations, method: Method = "joint", loss: Loss = "linear") -> Fit:
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
    one_of("method", method, get_args(Method))
    if method == "joint":
        return fit(nominal, PosesAndTurns.of(observations), loss=loss)
    single = np.ndim(observations.gravity) == 0
    nominal, observations = lifted((nominal, observations)) if single else (nominal, observations)
    fitted = fit(nominal, PosesAndTurns.of(observations, "norm"), loss=loss)
    if method != "accelerometer":
        fitted = _second_step(fitted, observations, "rk4" if method.endswith("rk4") else "exponential", loss)
    return first_of(fitted) if single else fitted


def known_misalignments(nominal: Imu, free: Sequence[Name]) -> Prior:
    """Return what is known of an accelerometer's misalignments beforehand: they are zero within what sensors have."""
    across = tuple(
        name for name in free if name.owner == "accelerometer" and name.part == "gain" and len({*name.axes}) > 1
    )
    sigma = _ACROSS * nominal.accelerometer.scales[[name.axes[0] for name in across]]
    return Prior(across, np.zeros(len(across)), np.diag(1 / sigma))


def with_open_misalignments_held(
    fitted: Fit, nominal: Imu, observations: Observations, method: Method, loss: Loss
) -> tuple[Fit, Prior | None]:
    """Return a unit's fit, made again with what sensors have as a prior where its misalignments are known less well."""
    prior = known_misalignments(nominal, fitted.names)
    sigma = fitted.sigmas()[[fitted.names.index(name) for name in prior.names]]
    if method.startswith("two-step") or not (sigma * np.diag(prior.root) > 1).any():
        return fitted, None
    data = PosesAndTurns.of(observations, "norm" if method == "accelerometer" else "all")
    return fit(nominal, data, prior=prior, loss=loss, excess=fitted.excess), prior


def _second_step(first: Fit, observations: Observations, method: str, loss: str) -> Fit:
    """Fit the gyroscope with the accelerometer as known, and put the two steps' numbers side by side.

    The second step takes the accelerometer as known and neighbouring turns as independent. Neither is true: its own
    (JᵀJ)⁻¹ is too small by a tenth in the misalignments. With c the conditions, C their covariance and D their
    derivatives by the accelerometer's numbers, both steps are linear in c to first order: δa = L c, δg = G (c + D L c),
    so the covariance is T C Tᵀ, T = [L; G (1 + D L)].
    """
    turning = PosesAndTurns.of(observations, "turning", accelerometer_excess=first.excess[:, 0], method=method)
    second = fit(first.imu, turning, loss=loss)

    def beside(one: Array, other: Array) -> Array:
        return np.hstack([one, other])

    fields = "sizes", "values", "magnitude_sensitivity", "residual"
    excess = beside(first.excess[:, :1], second.excess[:, 1:])
    return Fit(
        imu=second.imu,
        names=(*first.names, *second.names),
        covariance=_two_step_covariance(second.imu, observations, excess),
        jacobian=scipy.linalg.block_diag(first.jacobian, second.jacobian),
        excess=excess,
        cost=first.cost + second.cost,
        steps=beside(first.steps[:, None], second.steps[:, None]).max(axis=1),
        converged=first.converged & second.converged,
        finite=first.finite & second.finite,
        **{name: beside(getattr(first, name), getattr(second, name)) for name in fields},
    )


def _two_step_covariance(model: Imu, observations: Observations, excess: Array) -> Array:
    """Return the covariance (N, p, p) of both steps together, in the numbers' units."""
    like = first_of(model)
    parameters = Parameters.select(like, without_equipment)
    first = sum(name.owner == "accelerometer" for name in parameters.names)
    count = len(excess)
    reference = np.hstack([np.reshape(leaf, (count, -1)) for leaf in jax.tree.leaves(model)])

    def batch(like, parameters, units):
        def lane(unit):
            reference, observations, excess = unit
            of_unit = eqx.tree_at(lambda p: p.reference, parameters, reference)
            zero = jnp.zeros(len(of_unit.index))
            conditions, covariance, *_ = condense(of_unit.model(like, zero), observations)
            slope = jax.jacfwd(lambda z: conditions(of_unit.model(like, z)))(zero)

            def step(rows, columns):
                """How numbers react to the conditions in a step that looks at some rows only."""
                part = only(covariance, rows, excess[0]).dense()
                weights = inverse_cholesky(part.total(excess)) * part.used
                jacobian = weights @ slope[:, columns]
                known = jnp.eye(jacobian.shape[1]) / TOLERANCE**2
                return -jnp.linalg.solve(jacobian.T @ jacobian + known, jacobian.T @ weights)

            one, two = step("norm", slice(first)), step("turning", slice(first, None))
            both = jnp.concatenate([one, two + two @ slope[:, :first] @ one])
            return both @ (covariance.used[:, None] * covariance.used * covariance.dense().total(excess)) @ both.T

        return jax.lax.map(lane, units)

    units = (reference, observations, excess)
    size = np.asarray(parameters.size)
    covariance = stored.call(batch, "two-step covariance", like, parameters, units, quick=count == 1)
    return covariance * np.outer(size, size)
