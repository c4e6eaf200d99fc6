"""The fit of many units: one compiled program for each padded shape, samples touched once a pass.

The estimate is that of [`jaximu.fit_hand_held`][], joint maximum likelihood with the excess of each kind of noise.
There every solver step integrates all samples of all turns; here a pass integrates them once, with their derivatives
(`jaximu.residuals.carried`), and passes go on until what the pre-integration leaves out is nothing. A unit's passes are
a loop inside the compiled program, so units do not wait for each other on a CPU, and a result does not depend on which
units are fitted beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from numpy.typing import NDArray

from jaximu import stored
from jaximu._types import Array
from jaximu.calibration.fit import _COARSE, _joint_residual, _norm_residual, fit_hand_held, keep_free
from jaximu.observations import Observations
from jaximu.precision import require_float64
from jaximu.problem import TOLERANCE, Parameters, Problem
from jaximu.residuals import turn_angle_errors
from jaximu.residuals.carried import carry, carry_blocks, compress
from jaximu.residuals.gravity_norm import recover_specific_force
from jaximu.rotation import apply_matrix, inverse_matrix
from jaximu.sensor import Imu, Triad
from jaximu.solver import solve
from jaximu.whitening import condition_covariance, inverse_cholesky, static_covariances

__all__ = ["Fitted", "Unit", "fit_units", "parameter_set", "shape_of"]

FloatArray = NDArray[np.float64]
_CHUNK, _WIDE_CHUNK = 16, 256
"""Units that one call of a compiled program takes: one after the other, so that their samples stay in the cache, or
side by side."""
_MAX_PASSES = 16
_STILL = 5e-4
"""Change of the parameters, in typical sizes, from which a pass must be followed by another: its square, times the
angle of a turn, is what pre-integration leaves out, and 1e-8 rad is nothing."""
_ROUGHLY_STILL = 3e-3  # the same as long as turns are integrated by blocks
_UNDAMPED = 3
"""Passes that take the excess as it comes."""
_SETTLED = 0.05  # change of one plus the excess, as in the fit of one unit


@dataclass(frozen=True)
class Unit:
    """One unit to be fitted: its observations in output units, and the data sheet's scales and offsets.

    gyroscope: whether it has one; its observations are then used.
    """

    observations: Observations
    nominal: Imu
    gyroscope: bool


@dataclass(frozen=True)
class Fitted:
    """What a fit tells of one unit, in its output units.

    numbers: (24,) gain (row-major) and bias of the accelerometer, then of the gyroscope. covariance: of `names`,
    without gravity's uncertainty, to which they react by `gravity_reach` (per m/s²). information: JᵀJ in typical sizes.
    rms: of the norm of gravity (m/s²), of carried gravity (degrees) and of the rate at rest (rad/s).
    """

    nominal: Imu
    numbers: FloatArray
    names: tuple[str, ...]
    covariance: FloatArray
    gravity_reach: FloatArray
    information: FloatArray
    excess: FloatArray
    rms: FloatArray
    converged: bool
    finite: bool

    @property
    def imu(self) -> Imu:
        """The calibrated unit."""

        def triad(nominal: Triad, numbers: FloatArray) -> Triad:
            return replace(nominal, gain=numbers[:9].reshape(3, 3), bias=numbers[9:])

        gyroscope = self.nominal.gyroscope
        return Imu(
            triad(self.nominal.accelerometer, self.numbers[:12]),
            None if gyroscope is None else triad(gyroscope, self.numbers[12:]),
        )

    def total_covariance(self, gravity_sigma: float) -> FloatArray:
        """Return the covariance (p, p) with what an uncertain gravity (m/s², one sigma) adds."""
        reach = self.gravity_reach * gravity_sigma
        return self.covariance + reach[:, None] * reach


def _side_by_side(gyroscope: bool) -> bool:
    """Whether units are computed as one array: on a CPU the accelerometer alone, whose arrays are small."""
    return not gyroscope or jax.default_backend() != "cpu"


@cache
def parameter_set(gyroscope: bool) -> tuple[Imu, Parameters]:
    """Return the model that all units are brought to, unit gains and no bias, and what is free in it."""
    like = jax.tree.map(np.asarray, Imu.nominal())
    return like, Parameters.select(like, keep_free("joint" if gyroscope else "accelerometer"))


def shape_of(unit: Unit) -> tuple[bool, int, int]:
    """Return what must agree for units to share a program: gyroscope or none, padded poses and samples in a turn."""
    return unit.gyroscope, len(unit.observations.poses.mask), unit.observations.turns.interval.shape[1]


def fit_units(units: Sequence[Unit]) -> list[Fitted]:
    """Fit units of any shapes; those of one shape are fitted together, and none changes another's result.

    Failures do not raise: look at `converged` and `finite`. A unit that the passes do not settle is fitted again by
    `fit_hand_held`, which integrates in every step.
    """
    require_float64()
    found: dict[int, Fitted] = {}
    shapes: dict[tuple[bool, int, int], list[int]] = {}
    for place, unit in enumerate(units):
        shapes.setdefault(shape_of(unit), []).append(place)
    for (gyroscope, *_), places in shapes.items():
        size = _WIDE_CHUNK if _side_by_side(gyroscope) else _CHUNK
        for first in range(0, len(places), size):
            part = places[first : first + size]
            for place, fitted in zip(part, _fit_chunk([units[place] for place in part], gyroscope), strict=True):
                found[place] = fitted
    return [found[place] for place in range(len(units))]


def _fit_chunk(units: Sequence[Unit], gyroscope: bool) -> list[Fitted]:
    name = "joint" if gyroscope else "accelerometer"
    like, parameters = parameter_set(gyroscope)
    scales = [_scales(unit.nominal) for unit in units]
    seen = [unit.observations if gyroscope else _without_turns(unit.observations) for unit in units]
    batch = jax.tree.map(lambda *leaves: _filled(leaves, gyroscope), *seen)
    batch = _in_si(batch, *(_filled(each, gyroscope, 1.0) for each in zip(*scales, strict=True)))
    leaves = stored.call(partial(_program, name), f"fleet {name}", np.asarray(len(units)), like, parameters, batch)
    lanes = [np.array(leaf)[: len(units)] for leaf in leaves]
    *_, converged, finite = lanes
    for place in np.flatnonzero(finite & ~converged).tolist():
        slow = _slow_lane(_in_si(units[place].observations, *scales[place]), name)
        for leaf, new in zip(lanes, slow, strict=True):
            leaf[place] = new
    return _fitted(lanes, parameters, [np.stack(each) for each in zip(*scales, strict=True)], units)


def _without_turns(observations: Observations) -> Observations:
    turns = observations.turns
    return replace(observations, turns=replace(turns, output=turns.output[:, :0], interval=turns.interval[:, :0]))


def _filled(leaves: Sequence[np.ndarray], gyroscope: bool, rest: float = 0.0) -> np.ndarray:
    """Stack the units' arrays; the rest of a chunk repeats the last, or is `rest` where it is skipped."""
    side_by_side = _side_by_side(gyroscope)
    shape = (_WIDE_CHUNK if side_by_side else _CHUNK, *np.shape(leaves[0]))
    dtype = np.asarray(leaves[0]).dtype
    stacked = np.full(shape, rest, dtype) if rest else np.zeros(shape, dtype)  # zeros take no time until they are used
    np.stack(leaves, out=stacked[: len(leaves)])
    if side_by_side:
        stacked[len(leaves) :] = leaves[-1]
    return stacked


def _program(name: str, count, like: Imu, parameters: Parameters, batch: Observations):
    run = partial(_lane, name, like, parameters)
    if _side_by_side(name == "joint"):
        return jax.vmap(run)(batch)

    def lane(item):
        place, observations = item
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(run, observations))
        return jax.lax.cond(place < count, run, lambda _: nothing, observations)

    return jax.lax.map(lane, (jnp.arange(_CHUNK), batch))


def _lane(name: str, like: Imu, parameters: Parameters, observations: Observations):
    """Passes of pre-integration, weighting and solving, until neither the excess nor the parameters move.

    Turns are integrated by blocks until then, and sample by sample from then on.
    """
    step, blocks = (
        (_accelerometer_pass, None) if name == "accelerometer" else (_joint_pass, compress(observations.turns))
    )

    def once(z, excess, tolerance, exact):
        model = parameters.model(like, z)
        gyroscope, turns = model.gyroscope, observations.turns
        assert gyroscope is not None
        seen = observations
        if blocks is not None:
            sums = blocks
            carried = jax.lax.cond(exact, lambda: carry(gyroscope, turns), lambda: carry_blocks(gyroscope, turns, sums))
            seen = replace(observations, turns=carried)
        return step(like, parameters, seen, z, excess, tolerance)

    def body(state):
        count, _, exact, last, excess = state
        # the first pass leans on the data sheet; later ones leave it further behind
        out = once(last.z, excess, jnp.where(count == 0, 1.0, TOLERANCE), exact)
        moved = jnp.max(jnp.abs(out.excess - excess) / (1 + excess)) > _SETTLED
        still = jnp.max(jnp.abs(out.z - last.z)) <= jnp.where(exact, _STILL, _ROUGHLY_STILL)
        settled = (count > 0) & ~moved & still
        again = out.finite & ~(settled & exact)
        # scoring may jump to and fro between two values: half the way leads to the same end
        towards = jnp.where(count < _UNDAMPED, out.excess, (excess + out.excess) / 2)
        kept = jnp.where(again & ~settled, towards, excess)  # the one that the result was weighted with
        return count + 1, again, exact | settled, out, kept

    zero, coarse = jnp.zeros(len(parameters.index)), jnp.asarray(_COARSE)
    by_blocks = jnp.asarray(blocks is None)
    shapes = jax.eval_shape(once, zero, coarse, jnp.asarray(1.0), by_blocks)
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    start = (jnp.asarray(0), jnp.asarray(True), by_blocks, nothing, coarse)
    count, again, _, out, excess = jax.lax.while_loop(lambda s: s[1] & (s[0] < _MAX_PASSES), body, start)
    return (
        out.z, out.covariance, out.gravity, out.information, excess, out.rms,
        count, out.converged & ~again, out.finite,
    )  # fmt: skip


class _Pass(NamedTuple):
    """What a pass ends with; the covariance and the reach of gravity are in typical sizes."""

    z: Array
    excess: Array
    information: Array
    covariance: Array
    gravity: Array
    rms: Array
    converged: Array
    finite: Array


def _joint_pass(like: Imu, parameters: Parameters, seen: Observations, z, excess, tolerance) -> _Pass:
    """Weight at z and solve, both triads; `seen` has pre-integrated turns."""
    covariance = condition_covariance(parameters.model(like, z), seen)
    weights = inverse_cholesky(covariance.total(excess))
    measured, unit = static_covariances(seen)
    rest = inverse_cholesky(measured + excess[2] * unit)
    problem = Problem(like, parameters, (seen, weights, rest), _joint_residual, tolerance=tolerance)

    def parts(basis, left):
        split = len(weights)
        for each in (covariance.accelerometer, covariance.turns):
            whitened = weights @ each @ weights.T
            through = whitened @ basis[:split]
            yield (left[:split] @ whitened @ left[:split], jnp.trace(whitened), whitened,
                   through, basis[:split].T @ through)  # fmt: skip
        whitened = seen.poses.mask[:, None, None] * (rest @ unit @ jnp.swapaxes(rest, -1, -2))
        own, rows = basis[split:].reshape(-1, 3, basis.shape[1]), left[split:].reshape(-1, 3)
        through = jnp.einsum("pij,pjk->pik", whitened, own)
        yield (jnp.einsum("pi,pij,pj->", rows, whitened, rows), jnp.trace(whitened, axis1=1, axis2=2).sum(), whitened,
               through, jnp.einsum("pik,pil->kl", own, through))  # fmt: skip

    return _ended(problem, z, seen, excess, (0, 1, 2), parts)


def _accelerometer_pass(like: Imu, parameters: Parameters, seen: Observations, z, excess, tolerance) -> _Pass:
    """Weight at z and solve, the accelerometer alone: poses are independent."""
    model, poses = parameters.model(like, z), seen.poses
    back = inverse_matrix(model.accelerometer.gain)
    row = -apply_matrix(back.T, recover_specific_force(model, poses)) / seen.gravity
    mask = poses.mask.astype(row.dtype)
    mean = jnp.einsum("p,pij->ij", mask, poses.accelerometer_covariance) / jnp.sum(mask)
    measured = jnp.einsum("pi,pij,pj->p", row, poses.accelerometer_covariance, row)
    unit = mask * jnp.einsum("pi,ij,pj->p", row, mean, row)
    weights = 1 / jnp.sqrt(measured + excess[0] * unit)
    problem = Problem(like, parameters, (seen, weights), _norm_residual, tolerance=tolerance)

    def parts(basis, left):
        whitened = weights**2 * unit
        through = whitened[:, None] * basis
        yield jnp.sum(left**2 * whitened), jnp.sum(whitened), whitened, through, basis.T @ through

    return _ended(problem, z, seen, excess, (0,), parts)


def _ended(problem: Problem, z, seen: Observations, excess, improved: tuple[int, ...], parts) -> _Pass:
    """Solve, improve the excess by a step of Fisher scoring, and propagate.

    The step is that of `jaximu.whitening.update_excess`; with M = I − Q Qᵀ its traces need no product of two large
    matrices: tr M V = tr V − tr QᵀVQ and tr M V M W = tr V W − 2 tr (VQ)ᵀ(WQ) + tr QᵀVQ QᵀWQ. Parts of different rows
    have no product. `parts(Q, r)` gives rᵀVr, tr V, V, VQ and QᵀVQ of each.
    """
    solution = solve(problem, z)
    jacobian = solution.jacobian
    square = jacobian.T @ jacobian
    if len(improved) > 1:
        basis, _ = jnp.linalg.qr(jacobian)
    else:  # a hundred times quicker side by side, and as exact as poses span
        factor = jnp.linalg.cholesky(square + 1e-9 * jnp.trace(square) * jnp.eye(len(z)))
        basis = solve_triangular(factor, jacobian.T, lower=True).T
    left = solution.residual - basis @ (basis.T @ solution.residual)
    found = list(parts(basis, left))
    gradient = jnp.stack([square - trace + jnp.trace(inner) for square, trace, _, _, inner in found])

    def pair(a, b):
        (*_, first, first_through, first_inner), (*_, second, second_through, second_inner) = a, b
        total = jnp.sum(first_inner * second_inner)
        if first.shape != second.shape:
            return total
        return total + jnp.sum(first * second) - 2 * jnp.sum(first_through * second_through)

    information = jnp.stack([jnp.stack([pair(a, b) for b in found]) for a in found])
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(information), 1e-30))
    normal = information / scale / scale[:, None] + 1e-9 * jnp.eye(len(found))
    places = jnp.array(improved)
    step = jnp.linalg.solve(normal, gradient / scale) / scale
    better = jnp.where(jnp.diagonal(information) > 1e-20, jnp.maximum(excess[places] + step, 0.0), excess[places])

    covariance = jnp.linalg.inv(square + jnp.eye(len(z)) / problem.tolerance**2)

    def of_gravity(gravity):
        return eqx.tree_at(lambda p: p.data[0].gravity, problem, gravity).objective(solution.z)[0]

    slope = jax.jvp(of_gravity, (seen.gravity,), (jnp.ones_like(seen.gravity),))[1]
    model = problem.model(solution.z)
    return _Pass(
        solution.z, excess.at[places].set(better), square, covariance, -covariance @ (jacobian.T @ slope),
        _rms(model, seen, len(improved) > 1), solution.converged, solution.finite,
    )  # fmt: skip


def _rms(model: Imu, observations: Observations, gyroscope: bool = True):
    """Rms of the norm of gravity, of carried gravity (degrees) and of the rate at rest; zero where there is none."""
    assert model.gyroscope is not None
    poses, turns = observations.poses, observations.turns
    norm = jnp.sqrt(jnp.sum(recover_specific_force(model, poses) ** 2, axis=-1)) - observations.gravity

    def rms(values, mask):
        return jnp.sqrt(jnp.sum(jnp.where(mask, values, 0.0) ** 2) / jnp.maximum(jnp.sum(mask), 1))

    if not gyroscope:
        return jnp.stack([rms(norm, poses.mask), jnp.asarray(0.0), jnp.asarray(0.0)])
    angle = jnp.degrees(turn_angle_errors(model, observations))
    rest = jnp.sqrt(jnp.sum((poses.gyroscope_mean - model.gyroscope.bias) ** 2, axis=-1))
    rest = rest / jnp.sqrt(jnp.mean(jnp.sum(model.gyroscope.gain**2, axis=-1)))
    return jnp.stack([rms(norm, poses.mask), rms(angle, turns.mask), rms(rest, poses.mask)])


def _slow_lane(observations: Observations, name: str) -> tuple:
    like, _ = parameter_set(name == "joint")
    fit = fit_hand_held(like, observations, name)
    rms = stored.call(
        lambda model, seen: (_rms(model, seen, name == "joint"),), f"rms {name}", fit.model, observations
    )[0]
    size = np.asarray(fit.parameters.size)
    jacobian = np.asarray(fit.jacobian)
    z = (np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(fit.model)])[list(fit.parameters.index)]
         - np.asarray(fit.parameters.reference)[list(fit.parameters.index)]) / size  # fmt: skip
    return (
        z, np.asarray(fit.covariance) / size[:, None] / size, np.asarray(fit.gravity_sensitivity) / size,
        jacobian.T @ jacobian, np.asarray(fit.excess), np.asarray(rms), 0, bool(fit.converged), bool(fit.finite),
    )  # fmt: skip


def _scales(nominal: Imu) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Scale and offset of the accelerometer, then of the gyroscope, as the data sheet has them."""
    assert nominal.gyroscope is not None
    parts = []
    for triad in (nominal.accelerometer, nominal.gyroscope):
        parts += [np.linalg.norm(np.asarray(triad.gain), axis=1), np.asarray(triad.bias)]
    return tuple(parts)


def _in_si(observations: Observations, scale_a, offset_a, scale_g, offset_g) -> Observations:
    """Bring observations (and scales) with any leading axes to what the data sheet makes of them.

    All units then share one start and one scaling.
    """
    poses, turns = observations.poses, observations.turns

    def mean(values, scale, offset):
        return (values - offset[..., None, :]) / scale[..., None, :]

    def square(values, scale):
        return values / (scale[..., :, None] * scale[..., None, :])

    changed = (
        mean(poses.accelerometer_mean, scale_a, offset_a),
        square(poses.accelerometer_covariance, scale_a[..., None, :]),
        mean(poses.gyroscope_mean, scale_g, offset_g),
        square(poses.gyroscope_covariance, scale_g[..., None, :]),
        mean(turns.output, scale_g[..., None, :], offset_g[..., None, :]),
        square(turns.noise, scale_g),
    )
    return eqx.tree_at(
        lambda o: (
            o.poses.accelerometer_mean,
            o.poses.accelerometer_covariance,
            o.poses.gyroscope_mean,
            o.poses.gyroscope_covariance,
            o.turns.output,
            o.turns.noise,
        ),
        observations,
        changed,
    )


def _fitted(lanes: list[np.ndarray], parameters: Parameters, scales: list[np.ndarray], units) -> list[Fitted]:
    """Bring what a program found back into output units: row i of a gain, entry i of a bias by the scale of axis i."""
    z, covariance, gravity, information, excess, rms, _, converged, finite = lanes
    scale_a, offset_a, scale_g, offset_g = scales
    index, size, count = list(parameters.index), np.asarray(parameters.size), len(units)
    factor = np.concatenate([np.repeat(scale_a, 3, axis=1), scale_a, np.repeat(scale_g, 3, axis=1), scale_g], axis=1)
    offset = np.zeros_like(factor)
    offset[:, 9:12], offset[:, 21:] = offset_a, offset_g
    numbers = np.tile(np.asarray(parameters.reference), (count, 1))
    numbers[:, index] += size * z
    numbers = numbers * factor + offset
    factor = factor[:, index] * size
    covariance = covariance * factor[:, :, None] * factor[:, None, :]
    names = parameters.names
    return [
        Fitted(units[k].nominal if units[k].gyroscope else Imu(units[k].nominal.accelerometer, None), numbers[k], names,
               covariance[k], gravity[k] * factor[k], information[k], excess[k], rms[k], bool(converged[k]),
               bool(finite[k]))
        for k in range(count)
    ]  # fmt: skip
