"""Noise as a linear system driven by unit white noise: one form for every process, exact at the sample rate."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Float

from jaximu.ground.array_types import Array, FloatArray

BLOCK = 64
"""Samples that are computed by one matrix product; between blocks the state is carried step by step."""


class LinearSystem(eqx.Module):
    """x_{k+1} = A x_k + B w_k, y_k = C x_k + D w_k with w_k ~ N(0, I), x_0 = start + root v, v ~ N(0, I).

    Leading axes `...` (units, sensor axes) are independent copies. Shapes: transition A (..., s, s), drive B
    (..., s, m), output C (..., s), through D (..., m), start (..., s), root (..., s, r).
    """

    transition: Float[Array, "... s s"]
    drive: Float[Array, "... s m"]
    output: Float[Array, "... s"]
    through: Float[Array, "... m"]
    start: Float[Array, "... s"]
    root: Float[Array, "... s r"]

    def blocked(self, length: int = BLOCK) -> BlockSystem:
        """Return the system that advances by `length` samples at a time. On the host, once for a recording."""
        a, b, c = map(np.asarray, (self.transition, self.drive, self.output))
        leading, states, inputs = a.shape[:-2], a.shape[-1], b.shape[-1]
        free = np.empty((*leading, length + 1, states))  # C A^k: what a state puts out k samples later
        power = np.broadcast_to(np.eye(states), a.shape)
        pushes = np.empty((*leading, length, states, inputs))  # A^k B: what a draw does to the state k samples later
        for k in range(length + 1):
            free[..., k, :] = np.einsum("...s,...st->...t", c, power)
            if k < length:
                pushes[..., k, :, :] = power @ b
                power = power @ a
        response = np.empty((*leading, length, inputs))  # of the output to a draw, k samples later
        response[..., 0, :] = self.through
        response[..., 1:, :] = np.einsum("...s,...ksm->...km", c, pushes[..., : length - 1, :, :])
        forced = np.zeros((*leading, inputs, length, length))  # Toeplitz: output k from draw j ≤ k
        for k in range(length):
            forced[..., k, : k + 1] = np.moveaxis(response[..., k::-1, :], -1, -2)
        driven = np.moveaxis(pushes[..., ::-1, :, :], -3, -1)  # (..., s, m, length)
        return BlockSystem(power, driven.swapaxes(-3, -2), free[..., :length, :], forced)


def linear_system(
    transition, drive, output, through=None, start=None, root=None, leading: tuple[int, ...] = ()
) -> LinearSystem:
    """Return a system of its parts, their leading axes broadcast against each other and `leading`. On the host.

    Parts that are left out are zero.
    """
    states, inputs = np.shape(drive)[-2:]
    through = np.zeros(inputs) if through is None else through
    start = np.zeros(states) if start is None else start
    root = np.zeros((states, 0)) if root is None else root
    parts, ranks = (transition, drive, output, through, start, root), (2, 2, 1, 1, 1, 2)
    pairs = [(np.asarray(part, float), rank) for part, rank in zip(parts, ranks, strict=True)]
    leading = np.broadcast_shapes(leading, *(part.shape[: part.ndim - rank] for part, rank in pairs))
    whole = (np.broadcast_to(part, leading + part.shape[part.ndim - rank :]) for part, rank in pairs)
    return LinearSystem(*whole)


def combine(systems: Sequence[LinearSystem]) -> LinearSystem:
    """Return the sum of independent systems (of the same leading axes) as one system."""

    def joined(name):
        return np.concatenate([getattr(system, name) for system in systems], axis=-1)

    def blocks(name):
        return scipy.linalg.block_diag(*(getattr(system, name) for system in systems))

    return LinearSystem(
        blocks("transition"), blocks("drive"), joined("output"), joined("through"), joined("start"), blocks("root")
    )


class BlockSystem(eqx.Module):
    """A linear system that advances by b samples; see `LinearSystem.blocked`."""

    transition: Float[Array, "... s s"]
    drive: Float[Array, "... m s b"]
    output: Float[Array, "... b s"]
    through: Float[Array, "... m b b"]


def run(system: BlockSystem, state: FloatArray, draws: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the output (..., n) and the state (..., s) after it of unit white noise `draws` (..., m, n).

    n must be a multiple of the block. On the host: a program would take longer to compile than most recordings to draw.
    The local part of all blocks is one matrix product, and only the state runs from block to block, so that an hour of
    samples costs a few thousand short steps.
    """
    length = system.output.shape[-2]
    shaped = draws.reshape(*draws.shape[:-1], draws.shape[-1] // length, length)
    local = (shaped @ np.swapaxes(system.through, -1, -2)).sum(axis=-3)
    pushes = (shaped @ np.swapaxes(system.drive, -1, -2)).sum(axis=-3)
    states = np.empty((pushes.shape[-2], *state.shape))
    for block, push in enumerate(np.moveaxis(pushes, -2, 0)):
        states[block] = state
        state = (system.transition @ state[..., None])[..., 0] + push
    free = np.moveaxis(states, 0, -2) @ np.swapaxes(system.output, -1, -2)
    return (local + free).reshape(*draws.shape[:-2], -1), state
