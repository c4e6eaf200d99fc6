"""A small neural network of temperature and its rate, fitted to bias: maximum a posteriori, as stiff as evidence says.

The weights of each axis are normal a priori: of few large steps or many flat ones, as the evidence in Laplace's
approximation says, which also chooses among several starts (MacKay, Neural Computation 4, 1992, 415–472). Whitened data
are first projected on smooth functions of temperature and rate: what is left tells nothing of a network, and the fit is
ten times as quick without.

Its covariance is that of a network. Where the truth is one, 95 % bands cover; where it is none, they cover about four
fifths in simulations, on a single axis a third to all: what a network of this size cannot follow is not in them. (The
spread of fits with stretches left out is no better: it covers, but is 2 to 30 times as wide.)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from jaximu import stored
from jaximu._types import Array
from jaximu.effects.network import UNITS, WEIGHTS, network
from jaximu.solver import solve

__all__ = ["Net", "fitted", "search", "smooth_functions", "values"]

FloatArray = NDArray[np.float64]
_PRIORS = ((0.5, 3.0), (1.5, 1.5), (5.0, 0.7))
"""Standard deviations a priori that are tried, the stiffest last: of the output's weights, over the rms that
temperature does, and of those inside tanh, whose inputs run from −1 to 1."""
_CONSTANT = 1.5
"""That of a constant inside tanh."""
_LEAST_SIZE = 1e-15  # SI, of an output that never changes
_STARTS = 4
_LANES = 3 * len(_PRIORS) * _STARTS
_SEED = 7
_STEPS = 60
_BUCKET = 256
_MODES, _ORDERS = 64, (13, 6)  # smooth functions kept, and the highest order in temperature and in its rate


class Net(NamedTuple):
    """Weights of three axes (48 numbers, SI), and standard deviations a priori over the root of the noise's scale."""

    weights: tuple[float, ...]
    prior: tuple[float, ...]


class _Axis(eqx.Module):
    """An axis's network, a priori of variance one in z, against compressed data (m,) = matrix (m, n) · outputs."""

    matrix: Float[Array, "m n"]
    target: Float[Array, " m"]
    prior: Float[Array, " 16"]
    inputs: Float[Array, "n 2"]
    origin: Float[Array, " 2"]
    tolerance: float = 1.0

    def objective(self, z: Float[Array, " 16"]) -> tuple[Float[Array, " m"], Float[Array, " 16"]]:
        """Return the residuals of the data and of the prior."""
        return self.target - self.matrix @ _outputs(z * self.prior, self.inputs, self.origin), z


def _outputs(weights, inputs, origin):
    of = network(weights)
    return jax.vmap(of)(inputs) - of(origin)


def _solved(matrix, target, prior, start, inputs, origin):
    def one(matrix, target, prior, start):
        found = solve(_Axis(matrix, target, prior, inputs, origin), start, _STEPS, 1e-6)
        sizes = jnp.linalg.svd(found.jacobian, compute_uv=False) ** 2
        evidence = -found.cost - 0.5 * jnp.sum(jnp.log1p(sizes))
        return found.z, evidence, jnp.sum(sizes / (1 + sizes))

    return jax.vmap(one)(matrix, target, prior, start)


def _values(weights, inputs, origin):
    """Outputs (3, n) and their derivatives (3, n, 16) by each axis's own weights."""
    of = jax.vmap(lambda own: _outputs(own, inputs, origin))
    slope = jax.vmap(jax.jacfwd(lambda own: _outputs(own, inputs, origin)))
    return of(weights), slope(weights)


def _padded(inputs: FloatArray) -> FloatArray:
    return np.pad(inputs, ((0, -len(inputs) % _BUCKET), (0, 0)))


def values(net: Net, inputs: FloatArray, origin: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return outputs (3, n), SI, at inputs (n, 2) less those at `origin` (2,), and derivatives (3, n, 16) by weight."""
    weights = np.reshape(net.weights, (3, WEIGHTS))
    value, slope = stored.call(_values, "thermal network values", weights, _padded(inputs), origin)
    return np.asarray(value)[:, : len(inputs)], np.asarray(slope)[:, : len(inputs)]


def smooth_functions(inputs: FloatArray) -> FloatArray:
    """Return smooth functions (n, k) of temperature and its rate, inputs (n, 2) from -1 to 1."""
    first, second = (chebvander(inputs[:, k], _ORDERS[k]) for k in range(2))
    both = [first[:, i] * second[:, j] for i in range(_ORDERS[0] + 1) for j in range(_ORDERS[1] + 1)
            if i / _ORDERS[0] + j / _ORDERS[1] <= 1]  # fmt: skip
    return np.stack(both, axis=1)


def _compressed(covariance: FloatArray, output: FloatArray, linear: FloatArray, smooth: FloatArray, scale: float):
    """Return matrix (64, n) and target (64,) of outputs (n,) with this covariance (n, n), `linear` (n, k) free."""
    root = np.linalg.cholesky(scale * covariance)
    free, both = (solve_triangular(root, each, lower=True) for each in (linear, smooth))
    u, s, _ = np.linalg.svd(free / np.maximum(np.linalg.norm(free, axis=0), 1e-300), full_matrices=False)
    u = u[:, s > 1e-9 * s[0]]
    both = both - u @ (u.T @ both)
    v, s, _ = np.linalg.svd(both / np.maximum(np.linalg.norm(both, axis=0), 1e-300), full_matrices=False)
    v = v[:, s > 1e-8 * max(s[0], 1e-300)][:, :_MODES]
    v = v - u @ (u.T @ v)
    found = solve_triangular(root, v, lower=True, trans=1).T
    matrix = np.zeros((_MODES, len(output)))
    matrix[: len(found)] = found
    return matrix, matrix @ output


def _run(matrices, targets, priors, starts, inputs, origin):
    """Solve any number of lanes, as one compiled function has them."""
    padded = _padded(inputs)
    matrices = np.pad(np.stack(matrices), ((0, 0), (0, 0), (0, len(padded) - len(inputs))))
    count = len(matrices)
    place = np.arange(_LANES) % count  # fold refits are at most 24 lanes
    lanes = (each[place] for each in (matrices, np.stack(targets), np.stack(priors), np.stack(starts)))
    found = stored.call(_solved, "thermal network", *lanes, padded, origin)
    return [np.asarray(each)[:count] for each in found]


def search(
    covariance: FloatArray, outputs: FloatArray, linear: FloatArray, inputs: FloatArray, origin: FloatArray,
    scale: float, rated: bool,
) -> tuple[Net, float]:  # fmt: skip
    """Fit a network to each axis from several starts, as stiff as the evidence says.

    **Arguments:** `covariance` (3, n, n) and `outputs` (3, n), SI; `linear` (3, n, k): what is free beside; `inputs`
    (n, 2): temperature and rate, from −1 to 1; `origin` (2,): those at which the network is zero; `scale`: of the
    covariance; `rated`: whether the rate may be asked.

    **Returns:** the networks, and how many numbers the data determine.
    """
    rng, smooth = np.random.default_rng(_SEED), smooth_functions(inputs)
    starts = rng.normal(size=(_STARTS, WEIGHTS))
    matrices, targets, priors, begun = [], [], [], []
    for axis in range(3):
        matrix, target = _compressed(covariance[axis], outputs[axis], linear[axis], smooth, scale)
        basis = np.linalg.qr(linear[axis])[0]
        size = max(float(np.std(outputs[axis] - basis @ (basis.T @ outputs[axis]))), _LEAST_SIZE)
        for share, inside in _PRIORS:
            prior = np.repeat([share * size, inside, inside if rated else 1e-6, _CONSTANT], UNITS)
            for start in starts:
                matrices.append(matrix)
                targets.append(target)
                priors.append(prior)
                begun.append(0.5 * start)
    z, evidence, told = _run(matrices, targets, priors, begun, inputs, origin)
    best = [axis * _LANES // 3 + int(np.argmax(part)) for axis, part in enumerate(np.split(evidence, 3))]
    prior = np.stack([priors[k] for k in best])
    return _net(prior * z[best], prior / np.sqrt(scale)), float(np.sum(told[best]))


def fitted(
    net: Net, folds: Sequence[NDArray[np.int64]], covariance: FloatArray, outputs: FloatArray, linear: FloatArray,
    inputs: FloatArray, origin: FloatArray, scale: float,
) -> list[Net]:  # fmt: skip
    """Fit the networks anew without each fold, from where they were; arguments as of `search`."""
    smooth, prior = smooth_functions(inputs), np.sqrt(scale) * np.reshape(net.prior, (3, WEIGHTS))
    begun = np.reshape(net.weights, (3, WEIGHTS)) / prior
    matrices, targets = [], []
    for fold in folds:
        kept = np.setdiff1d(np.arange(len(inputs)), fold)
        for axis in range(3):
            matrix, target = _compressed(covariance[axis][np.ix_(kept, kept)], outputs[axis, kept],
                                         linear[axis][kept], smooth[kept], scale)  # fmt: skip
            whole = np.zeros((_MODES, len(inputs)))
            whole[:, kept] = matrix
            matrices.append(whole)
            targets.append(target)
    lanes = np.tile(prior, (len(folds), 1)), np.tile(begun, (len(folds), 1))
    z = _run(matrices, targets, *lanes, inputs, origin)[0]
    return [_net(prior * each, np.asarray(net.prior)) for each in z.reshape(len(folds), 3, WEIGHTS)]


def _net(weights: FloatArray, prior: FloatArray) -> Net:
    return Net(*(tuple(float(each) for each in given.ravel()) for given in (weights, prior)))
