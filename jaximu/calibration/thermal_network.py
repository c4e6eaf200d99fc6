"""A small neural network of temperature and its rate, fitted to bias: maximum a posteriori, as stiff as evidence says.

The weights of each axis are normal a priori: of few large steps or many flat ones, as the evidence in Laplace's
approximation says, which also chooses among several starts (MacKay, Neural Computation 4, 1992, 415–472). For that,
whitened data are projected on smooth functions of temperature and rate: what is left tells little of a network, and a
fit is ten times as quick without. The best is then fitted to all of the data.

Its covariance is that of a network. Where the truth is one, 95 % bands cover; where it is none, they cover about four
fifths in simulations, on a single axis a third to all: what a network of this size cannot follow is not in them. (The
spread of fits with stretches left out is no better: it covers, but is 2 to 30 times as wide.)
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.polynomial.chebyshev import chebvander

from jaximu.calibration.thermal_linear import Whitened
from jaximu.calibration.thermal_selection import Candidate, candidate_of, parameters_of
from jaximu.calibration.thermal_terms import NETWORK, POWERS, Model, Net, ThermalTerm
from jaximu.data.rest import padded_count
from jaximu.estimation.leave_out import off, orthonormal
from jaximu.estimation.solver import solve
from jaximu.ground import stored
from jaximu.ground.array_types import Array, FloatArray, IntArray
from jaximu.ground.distributions import chi2_sf
from jaximu.model.effects.network import UNITS, WEIGHTS, network

_PRIORS = ((0.5, 3.0), (1.5, 1.5), (5.0, 0.7))
"""Standard deviations a priori that are tried, the stiffest last: of the output's weights, over the rms that
temperature does, and of those inside tanh, whose inputs run from −1 to 1."""
_CONSTANT = 1.5
"""That of a constant inside tanh."""
_LEAST_SIZE = 1e-15  # SI, of an output that never changes
_STARTS = 4
_SEED = 7
_STEPS = 60
_MODES, _ORDERS = 64, (13, 6)  # smooth functions kept, and the highest order in temperature and in its rate
_PATTERN = 1e-3
"""Probability of what the best model leaves, were it noise, below which a network is tried."""
_ROUNDS = 3


def patterned(data: Whitened, model: Model, scale: FloatArray) -> bool:
    """Whether the best model leaves anything that a smooth function of temperature and its rate could follow."""
    for axis, terms in enumerate(model):
        free = _functions(data, axis, terms)
        statistic = float(((free.T @ data.residual(axis, terms)) ** 2).sum()) / scale[axis]
        if float(chi2_sf(np.array(statistic), free.shape[1])) < _PATTERN:
            return True
    return False


def with_network(
    data: Whitened, more: Sequence[str], rated: bool, folds: Sequence[IntArray], scales: FloatArray
) -> tuple[Candidate, FloatArray]:
    """Fit a network of temperature and, if `rated`, its rate, beside a straight line in temperature and `more`.

    Returns with it the scale of the noise's variance, where the network explains more than what `scales` came from.
    """
    plain = (ThermalTerm(POWERS[0]), *(ThermalTerm(name) for name in more))
    scale, left, freedom = float(scales.mean()), np.zeros(3), 1.0
    for _ in range(_ROUNDS):
        net = _fitted(data, plain, scale, rated)
        left = np.array([data.misfit(axis, _about(plain, net)) for axis in range(3)])
        before, freedom = scale, len(data.blocks) - data.blocks.levels - parameters_of(_about(plain, net))
        if (scale := float(np.clip(left.sum() / (3 * freedom), 1.0, scale))) > 0.7 * before:
            break
    scales = np.minimum(scales, np.maximum(left / freedom, 1.0))
    return candidate_of(data, "network", (_about(plain, net),) * 3, folds, scales), scales


def _about(plain: Sequence[ThermalTerm], net: Net) -> tuple[ThermalTerm, ...]:
    return (*plain, *(ThermalTerm(NETWORK, shape=k, net=net) for k in range(WEIGHTS)))


def _functions(data: Whitened, axis: int, terms: Sequence[ThermalTerm]) -> FloatArray:
    """Return what levels and terms leave of smooth functions of temperature and its rate, whitened, orthonormal."""
    first, second = (chebvander(data.shapes.inputs[:, k], order) for k, order in enumerate(_ORDERS))
    both = [
        first[:, i] * second[:, j]
        for i in range(_ORDERS[0] + 1)
        for j in range(_ORDERS[1] + 1)
        if i / _ORDERS[0] + j / _ORDERS[1] <= 1
    ]
    white = data.root[axis] @ np.column_stack(both)
    base = orthonormal(data.design(axis, terms))
    return off(base, orthonormal(off(base, white)))


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
        output = network(z * self.prior, *self.inputs.T) - network(z * self.prior, *self.origin)
        return self.target - self.matrix @ output, z


def _solved(matrix, target, prior, start, inputs, origin):
    def one(axis):
        matrix, target, prior, start = axis
        solution = solve(_Axis(matrix, target, prior, inputs, origin), start, _STEPS, 1e-6)
        sizes = jnp.linalg.svd(solution.jacobian, compute_uv=False) ** 2
        evidence = -solution.cost - 0.5 * jnp.log1p(sizes).sum()
        return solution.z, evidence, (sizes / (1 + sizes)).sum()

    return jax.lax.map(one, (matrix, target, prior, start))


def _fitted(data: Whitened, plain: Sequence[ThermalTerm], scale: float, rated: bool) -> Net:
    """Fit a network to each axis beside plain terms: from several starts to smooth functions, as stiff as the evidence
    says, then from the best to all of the data.
    """
    count = len(data.blocks)
    missing = padded_count(count) - count
    inputs = np.pad(data.shapes.inputs, ((0, missing), (0, 0)))

    def solved(matrices: Sequence[FloatArray], *lanes: FloatArray) -> list[FloatArray]:
        """Solve axes, each of a matrix (m, n), known a priori, from starts (k, 16): z, evidence, numbers determined."""
        stacked = np.pad(np.stack(matrices) / np.sqrt(scale), ((0, 0), (0, 0), (0, missing)))
        targets = np.einsum("amn,na->am", stacked[:, :, :count], data.means)
        starts = lanes[0].shape[1]
        problems = (values.repeat(starts, axis=0) for values in (stacked, targets))
        rows = (values.reshape(3 * starts, WEIGHTS) for values in lanes)
        solutions = stored.call(_solved, "thermal network", *problems, *rows, inputs, data.shapes.origin)
        return [values.reshape(3, starts, -1) for values in solutions]

    smooth, whole, size = [], [], []
    for axis in range(3):
        modes = _functions(data, axis, plain)[:, :_MODES]
        smooth.append(np.pad(modes.T @ data.root[axis], ((0, _MODES - modes.shape[1]), (0, 0))))
        base = orthonormal(data.design(axis, plain))
        whole.append(np.pad(off(base, data.root[axis]), ((0, missing), (0, 0))))
        columns = [data.shapes.column(term)[axis] for term in plain]
        basis = np.linalg.qr(np.column_stack([data.blocks.of_level, *columns]))[0]
        size.append(max(float(off(basis, data.means[:, axis]).std()), _LEAST_SIZE))
    starts = 0.5 * np.random.default_rng(_SEED).normal(size=(_STARTS, WEIGHTS))
    priors = np.array(
        [
            [
                np.repeat([share * rms, inside, inside if rated else 1e-6, _CONSTANT], UNITS)
                for share, inside in _PRIORS
                for _ in starts
            ]
            for rms in size
        ]
    )
    z, evidence, _ = solved(smooth, priors, np.tile(starts, (3, len(_PRIORS), 1)))
    best = range(3), evidence[..., 0].argmax(axis=1)
    z, _, determined = solved(whole, priors[best][:, None], z[best][:, None])
    return Net(priors[best] * z[:, 0], priors[best] / np.sqrt(scale), float(determined.sum()) / 3)
