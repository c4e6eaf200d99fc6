"""Noise of the sensors through a linear error model: covariances of what integrates it, sample by sample."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jaximu.ground.array_types import Array
from jaximu.model.state_space import LinearSystem


def noise_covariance(
    transition: Float[Array, "S n n"] | None, reaction: Float[Array, "S n 3"], system: LinearSystem
) -> tuple[Float[Array, "S n"], Float[Array, "n n"]]:
    """Return the variances of an error after each sample, and its covariance at the end, from a triad's noise.

    The error obeys e ← F e + Σ_a g_a y_a, and each axis's noise y is any linear system of unit white noise, as
    `Process.system` gives it (white noise, flicker, random walk): error and system are one system, whose covariance
    is propagated exactly (Maybeck, Stochastic Models, Estimation, and Control, vol. 1, 1979, sec. 4.9).

    **Arguments:** `transition`: F of every sample; None where errors only add up (pre-integration, whose reaction is
    that of the end). `reaction`: g_a in columns, per unit of noise. `system`: of the three axes, leading axis (3,).
    """
    size = reaction.shape[1]
    identity = jnp.broadcast_to(jnp.eye(size), (3, size, size))

    def step(covariance, sample):  # (3, n + s, n + s): what each axis's noise adds to the error, and its states
        matrix, push = sample
        moved = identity if matrix is None else jnp.broadcast_to(matrix, identity.shape)
        push = push.T[:, :, None]
        across = push * system.output[:, None, :]
        whole = jnp.block([[moved, across], [jnp.zeros_like(across).mT, system.transition]])
        drive = jnp.hstack([push * system.through[:, None, :], system.drive])
        covariance = whole @ covariance @ whole.mT + drive @ drive.mT
        return covariance, jnp.diagonal(covariance.sum(axis=0))[:size]

    root = jnp.pad(jnp.asarray(system.root), ((0, 0), (size, 0), (0, 0)))
    covariance, variances = jax.lax.scan(step, root @ root.mT, (transition, reaction))
    return variances, covariance.sum(axis=0)[:size, :size]
