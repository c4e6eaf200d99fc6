"""How far a recording tells bias at temperatures that it did not reach: a smooth function, and its widening band.

Beyond what was seen no polynomial has a reason to go on. Bias is taken as a straight line in temperature plus an
integrated random walk (whose best estimate is the cubic smoothing spline: Wahba, J. R. Statist. Soc. B 40, 1978). How
rough it is, is known no better than the recording tells: predictions are averaged over the roughness by its restricted
likelihood, with a standard deviation that is uniform beforehand (Gelman, Bayesian Analysis 1, 2006, 515–534). The band
grows with the distance to the power 3/2.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaximu.leave_out import LeftOut, leave_out
from jaximu.noise.model import NoiseModel
from jaximu.thermal.rest import RestBlocks

__all__ = ["extrapolated"]

FloatArray = NDArray[np.float64]
_STRENGTHS = np.geomspace(1e-6, 1e6, 73)
_LEAST = 1e-3
"""Weight, over the largest, from which on a roughness counts."""


def extrapolated(
    blocks: RestBlocks, name: str, noise: NoiseModel, known: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """Predict the blocks that are not `known` (n,) from those that are.

    **Returns:** predicted less measured outputs (m, 3) of triad `name`, SI, and their standard deviations, the noise of
    the blocks included. The roughness is told by the known blocks alone.
    """
    covariance, output = blocks.covariance(getattr(noise, name)), blocks.means[name]
    low, high = blocks.range
    share = (blocks.temperature - low) / (high - low)
    least, most = np.minimum.outer(share, share), np.maximum.outer(share, share)
    walk = least**3 / 3 + (most - least) * least**2 / 2
    base = np.concatenate([np.eye(blocks.levels)[blocks.level], share[:, None]], axis=1)
    inside = np.ix_(known, known)
    errors, sigmas = np.zeros((int((~known).sum()), 3)), np.zeros((int((~known).sum()), 3))
    for axis in range(3):
        size = np.mean(np.diag(covariance[axis])) / np.mean(np.diag(walk))
        own = [covariance[axis] + strength * size * walk for strength in _STRENGTHS]
        costs = np.array([_restricted(each[inside], base[known], output[known, axis]) for each in own])
        weights = np.exp((costs.min() - costs) / 2) * np.sqrt(_STRENGTHS)  # steps are of the logarithm
        weights /= weights.max()
        weights[weights < _LEAST] = 0.0
        weights /= weights.sum()
        counted = np.flatnonzero(weights)
        parts = [_left_out(own[k], base, output[:, axis], ~known) for k in counted]
        each, spread = (
            np.stack([-part.errors for part in parts]),
            np.stack([np.diag(part.covariance) for part in parts]),
        )
        errors[:, axis] = weights[counted] @ each
        sigmas[:, axis] = np.sqrt(weights[counted] @ (spread + (each - errors[:, axis]) ** 2))
    return errors, sigmas


def _left_out(covariance: FloatArray, base: FloatArray, output: FloatArray, rows: NDArray[np.bool_]) -> LeftOut:
    weights = np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), np.float64)
    return next(leave_out(weights, weights @ base, weights @ output, [rows]))


def _restricted(covariance: FloatArray, base: FloatArray, output: FloatArray) -> float:
    """Return minus twice the restricted log-likelihood, up to a constant."""
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, np.column_stack([base, output]))
    q, r = np.linalg.qr(white[:, :-1])
    left = white[:, -1] - q @ (q.T @ white[:, -1])
    used = np.abs(np.diag(r))
    return float(left @ left + 2 * np.sum(np.log(np.diag(root))) + 2 * np.sum(np.log(used[used > 1e-12 * used.max()])))
