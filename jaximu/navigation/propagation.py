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

    def step(state, sample):
        error, cross, inner = state
        matrix, push = sample
        push = push.T
        if matrix is not None:
            error = matrix @ error @ matrix.T
            cross = jnp.einsum("ij,ajs->ais", matrix, cross)
        with_output = jnp.einsum("as,ast->at", system.output, inner)
        mixed = jnp.einsum("ais,as,aj->ij", cross, system.output, push)
        variance = jnp.einsum("at,at->a", with_output, system.output) + jnp.sum(system.through**2, axis=-1)
        error = error + mixed + mixed.T + jnp.einsum("ai,a,aj->ij", push, variance, push)
        onward = jnp.einsum("at,ast->as", with_output, system.transition) + jnp.einsum(
            "asm,am->as", system.drive, system.through
        )
        cross = jnp.einsum("ais,ats->ait", cross, system.transition) + push[:, :, None] * onward[:, None, :]
        inner = system.transition @ inner @ jnp.swapaxes(system.transition, -1, -2)
        inner = inner + system.drive @ jnp.swapaxes(system.drive, -1, -2)
        return (error, cross, inner), jnp.diagonal(error)

    states = system.output.shape[-1]
    root = jnp.asarray(system.root)
    start = jnp.zeros((size, size)), jnp.zeros((3, size, states)), root @ jnp.swapaxes(root, -1, -2)
    (error, _, _), variances = jax.lax.scan(step, start, (transition, reaction))
    return variances, error
