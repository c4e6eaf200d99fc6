"""The one place that iterates to an estimate: `fit` alternates Levenberg–Marquardt with the excess variance.

The way: `Data` are evaluated about a unit, samples and effects included (`about`); what comes out is small,
conditions as a function of gain and bias, their covariance, and how they react to the effects' numbers. On that the
compiled pass solves for all free numbers and improves the excess; then the data are evaluated again where the
estimate went, until nothing moves.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from jaximu.estimation.covariance import placed, update_excess, whitened
from jaximu.estimation.data import Conditions, Data
from jaximu.estimation.problem import LOSSES, TOLERANCE, Name, Parameters, flatten, names_of, unflatten
from jaximu.estimation.solver import MAX_STEPS, Failure, solve
from jaximu.ground import stored
from jaximu.ground.array_types import Array, FloatArray
from jaximu.ground.errors import InputError, one_of
from jaximu.ground.precision import require_float64
from jaximu.model.sensor import Imu

__all__ = [
    "Fit",
    "Linear",
    "Prior",
    "effect_numbers",
    "fit",
    "informed",
    "linearise",
]

_CHUNK = 64
"""Units that are in memory together, with the covariances of their conditions."""
_SPARE = (12, 36, 84)
"""Numbers of effects that share a compiled pass: rows of zeros fill up to the next."""
_STILL = 1e-2
"""Standard deviations below which a step ends the passes: what it leaves is its square."""
_CLOSE = 1e-6
"""Typical sizes below which a step ends a pass: a Newton step takes off what it leaves, and another pass may follow."""
_SWINGING = 5
"""Passes after which the excess is improved by what two changes in a row tell of the way that is left."""
_FARTHEST = 16.0
"""Times a change of the excess that is taken at once where changes in a row are alike."""
_DROWNED, _LEAP = 12, 0.3
"""Passes from which on components of the excess count by their relative change, and how much of it goes beyond."""
_SETTLED = 2e-3
"""Relative change of the excess below which it stands."""
_CREEPING, _CREEPS = 20, (1e-2, 0.1)
"""Passes from which on components that trade with each other may stand while they creep: a step of scoring (relative)
and of the numbers (standard deviations) below which the likelihood has less than a twentieth left to gain."""
_COARSE = 1.0
"""Tolerance of the data sheet in the first pass, in typical sizes: the start is percents off, and weights as sharp as
the noise would make it chase wrong minima."""
_DAMPING = 1.0
"""Of the first step after one that led astray, in typical sizes to a standard deviation."""
_MILD = 10.0
"""Damping that holds back what data do not determine and nothing else: a step that is still under it is at rest."""


@dataclass(frozen=True)
class Prior:
    """What is known of some numbers beforehand, in place of a data sheet's tolerance: root · (x − mean) is white.

    mean (k,), root (k, k): in the numbers' own units.
    """

    names: tuple[Name, ...]
    mean: FloatArray
    root: FloatArray

    @classmethod
    def of_effects(cls, imu: Imu, sigmas: Mapping[str, float | FloatArray] | None = None) -> Prior | None:
        """Return what is known of the coefficients of a unit's effects, about where they start; None where nothing is.

        **Arguments:** `sigmas`: standard deviations by effect; of the others what set-ups usually have, `Effect.known`.

        Raises `InputError` for an effect that the unit has not, or a standard deviation that is not greater than zero.
        """
        stated, effects = sigmas or {}, imu.all_effects()
        if unknown := sorted(set(stated) - {effect.name for effect in effects.values()}):
            raise InputError(f"{unknown[0]} is known beforehand but not fitted: name it as an effect, too.")
        names, values, sigma = [], [], []
        for (owner, place), effect in effects.items():
            width = stated.get(effect.name, effect.known)
            if effect.name in stated and np.min(width) <= 0:
                raise InputError(f"a standard deviation must be greater than zero, found {np.min(width):g}.")
            if np.any(width):
                names += [Name(owner, "coefficients", (k,), place) for k in range(effect.size)]
                values += np.asarray(effect.coefficients).tolist()
                sigma += np.broadcast_to(width, effect.size).tolist()
        return cls(tuple(names), np.array(values), np.diag(1 / np.array(sigma))) if names else None


class Fit(eqx.Module):
    """A solved problem, or with leading axes N a batch of them.

    `model` has the effects as fitted. `covariance` is of the free numbers `names` in their own units, without the known
    magnitude's uncertainty, to which each reacts by `magnitude_sensitivity` (per m/s², or µT). `excess` is the variance
    of each component, beyond the measured noise and in multiples of it: above zero, the model or the noise misses
    something. `residual` and `jacobian` are whitened, the latter with respect to numbers in typical `sizes`.
    """

    model: Imu
    names: tuple[Name, ...] = eqx.field(static=True)
    sizes: Float[Array, "... p"]
    values: Float[Array, "... p"]
    covariance: Float[Array, "... p p"]
    magnitude_sensitivity: Float[Array, "... p"]
    residual: Float[Array, "... n"]
    jacobian: Float[Array, "... n p"]
    excess: Float[Array, "... k"]
    cost: Float[Array, ...]
    steps: Int[Array, ...]
    converged: Bool[Array, ...]
    finite: Bool[Array, ...]

    def failure(self) -> Failure:
        """Return how an unbatched fit ended."""
        if not bool(self.finite):
            return Failure.NONFINITE
        return Failure.NONE if bool(self.converged) else Failure.MAX_STEPS

    def sigmas(self, magnitude_sigma: float = 0.0) -> Float[Array, "... p"]:
        """Return the standard deviations of the free numbers, the uncertainty of the magnitude included."""
        return np.sqrt(np.diagonal(self.total_covariance(magnitude_sigma), axis1=-2, axis2=-1))

    def total_covariance(self, magnitude_sigma: float = 0.0, clock_sigma: float = 0.0) -> Float[Array, "... p p"]:
        """Return the covariance with what an uncertain magnitude (one sigma) adds, and an uncertain gyroscope's clock.

        Rates times stamps are angles: stamps that run fast by a share make the gain K too large by it, dK = K dc.
        """
        reach = np.asarray(self.magnitude_sensitivity) * magnitude_sigma
        turning = [name.owner == "gyroscope" and name.part == "gain" for name in self.names]
        clock = np.where(turning, np.asarray(self.values), 0.0) * clock_sigma
        return sum((each[..., :, None] * each[..., None, :] for each in (reach, clock)), np.asarray(self.covariance))


def informed(found: Fit, prior: Prior) -> Fit:
    """Return an unbatched fit with what else is known of gains and biases, in the closed form of two normal laws.

    For a fit whose covariance was widened after it, beside which a prior inside `fit` would count for too little.
    """
    rows = [found.names.index(name) for name in prior.names]
    spread, values = np.asarray(found.covariance), np.asarray(found.values)
    known = np.linalg.inv(prior.root.T @ prior.root)
    share = spread[:, rows] @ np.linalg.inv(spread[np.ix_(rows, rows)] + known)
    keep = np.eye(len(values))
    keep[:, rows] -= share
    moved = values + share @ (prior.mean - values[rows])
    bare = found.model.with_effects()
    place = {name: k for k, name in enumerate(names_of(bare))}
    flat = flatten(bare)
    for name, value in zip(found.names, moved, strict=True):
        if name.effect is None:
            flat[place[name]] = value
    model = unflatten(bare, flat).with_effects(*found.model.all_effects().values())
    values = np.where([name.effect is None for name in found.names], moved, values)
    return replace(
        found, model=model, values=values, covariance=keep @ spread,
        magnitude_sensitivity=keep @ np.asarray(found.magnitude_sensitivity),
    )  # fmt: skip


# --- the effects' numbers ---------------------------------------------------------------------------------------------


def effect_numbers(imu: Imu) -> tuple[tuple[Name, ...], FloatArray, FloatArray]:
    """Return the names, values and typical sizes of the numbers of a unit's effects, effect by effect."""
    names, values, sizes = [], [], []
    for (owner, place), effect in imu.all_effects().items():
        triad = imu.triads().get(owner, imu.accelerometer)
        scale = float(np.mean(np.linalg.norm(np.asarray(triad.gain), axis=-1)))
        names += [Name(owner, "coefficients", (k,), place) for k in range(effect.size)]
        values += np.asarray(effect.coefficients).tolist()
        sizes += np.asarray(effect.typical_sizes(scale).coefficients).tolist()
        for inner in effect.inner:
            value = float(getattr(effect, inner))
            names.append(Name(owner, inner, (), place))
            values.append(value)
            sizes.append(max(abs(value), 1e-9))
    return tuple(names), np.array(values), np.array(sizes)


def _with_numbers(imu: Imu, values: FloatArray) -> Imu:
    """Return the unit with its effects' numbers; an inner parameter moves by a factor of two at most, in its range."""
    effects, first = [], 0
    for effect in imu.all_effects().values():
        inner = {}
        for place, (name, each) in enumerate(effect.inner.items()):
            old = float(getattr(effect, name))
            change = float(values[first + effect.size + place]) - old
            moved = np.clip(old + np.clip(change, -0.5 * old, old), each.low, each.high)
            inner[name] = np.float64(old if change == 0 else moved)  # one that is held may lie outside
        effects.append(type(effect)(values[first : first + effect.size], **inner))
        first += effect.size + len(effect.inner)
    return imu.with_effects(*effects)


@dataclass(frozen=True)
class Linear:
    """A measurement linearised at one unit with its effects, padding included.

    conditions (n,); slope (n, p) by the free numbers of gain and bias, in typical sizes; columns (n, q) by those of the
    effects, in their own units; names: of both, and sizes (p + q) their typical sizes. details: as in `About`.
    """

    conditions: FloatArray
    slope: FloatArray
    columns: FloatArray
    covariance: FloatArray
    names: tuple[Name, ...]
    sizes: FloatArray
    details: Any


def linearise(imu: Imu, measurement: Data, free: Callable[[Name], bool]) -> Linear:
    """Return a measurement about one unit with its effects, as a linear problem in the free numbers."""
    imu = jax.tree.map(lambda leaf: np.asarray(leaf, float), imu)
    about = measurement.about(jax.tree.map(lambda leaf: leaf[None], imu))
    like = imu if measurement.effects_inside else imu.with_effects()
    parameters = Parameters.select(like, free)
    names, _, sizes = ((), None, np.zeros(0)) if measurement.effects_inside else effect_numbers(imu)
    conditions = jax.tree.map(lambda leaf: leaf[0], about.conditions)

    def both(like, parameters, conditions):
        def twice(z):
            found = conditions(parameters.model(like, z))
            return found, found

        slope, value = jax.jacfwd(twice, has_aux=True)(jnp.zeros(len(parameters.index)))
        return value, slope

    value, slope = stored.call(both, "linearised", like, parameters, conditions)
    return Linear(
        np.asarray(value), np.asarray(slope), about.columns[0], np.asarray(about.covariance.measured[0]),
        (*parameters.names, *names), np.concatenate([np.asarray(parameters.size), sizes]), about.details,
    )  # fmt: skip


# --- a compiled pass --------------------------------------------------------------------------------------------------


class _Pass(eqx.Module):
    """What one pass returns; `start` is the cost before its step."""

    z: Array
    excess: Array
    residual: Array
    jacobian: Array
    covariance: Array
    magnitude: Array
    start: Array
    cost: Array
    steps: Array
    converged: Array
    finite: Array


class _Whitened(eqx.Module):
    """The problem of a pass: free numbers of the model first, then those that act by columns."""

    like: Imu
    parameters: Parameters
    conditions: tuple[Conditions, ...]
    weights: tuple[Array, ...]
    used: tuple[Array, ...]
    columns: Array
    mean: Array
    root: Array
    damping: Array
    loss: str = eqx.field(static=True)

    def residuals(self, z):
        count = len(self.parameters.index)
        model = self.parameters.model(self.like, z[:count])
        plain = jnp.concatenate([whitened(w, used * each(model)) for w, used, each in
                                 zip(self.weights, self.used, self.conditions, strict=True)])  # fmt: skip
        return plain + self.columns @ z[count:]

    def objective(self, z):
        beforehand = jnp.concatenate([self.root @ (z - self.mean), self.damping * z])
        return LOSSES[self.loss](self.residuals(z)), beforehand


def _robust_excess(residual: Array, groups: Array, excess: Array) -> Array:
    """Excess from the median absolute residual of each group of rows: outliers do not reach it."""
    size = jnp.where(residual == 0.0, jnp.nan, jnp.abs(residual))  # padding is exactly zero
    found = [jnp.nanmedian(jnp.where(groups == k, size, jnp.nan)) / 0.6745 for k in range(len(excess))]
    spread = jnp.stack(found)
    return jnp.where(jnp.isnan(spread), excess, jnp.maximum((1 + excess) * jnp.nan_to_num(spread) ** 2 - 1, 0.0))


def _single_pass(loss: str, like: Imu, parameters: Parameters, unit) -> _Pass:
    conditions, covariances, columns, mean, root, damping, excess = unit
    edges = np.cumsum([0, *(len(each.factors) for each in covariances)])
    parts = [excess[a:b] for a, b in pairwise(edges)]
    weights = tuple(each.weights(part) for each, part in zip(covariances, parts, strict=True))
    ends = np.cumsum([0, *(len(each.used) for each in covariances)])
    split = [slice(a, b) for a, b in pairwise(ends)]
    used = tuple(each.used for each in covariances)
    white = jnp.concatenate([whitened(w, rows[:, None] * columns[part])
                             for w, rows, part in zip(weights, used, split, strict=True)])  # fmt: skip
    problem = _Whitened(like, parameters, conditions, weights, used, white, mean, root, damping, loss)
    zero = jnp.zeros(len(mean))
    before = problem.objective(zero)
    solution = solve(problem, zero, MAX_STEPS, _CLOSE)
    information = solution.jacobian.T @ solution.jacobian + root.T @ root
    if loss == "linear":
        factors = [placed(factor, int(first), int(ends[-1]))
                   for each, first in zip(covariances, ends[:-1], strict=True) for factor in each.factors]  # fmt: skip
        if all(each.ndim == 1 for each in weights):
            whole = jnp.concatenate(weights)
        else:
            whole = jax.scipy.linalg.block_diag(*(jnp.diag(w) if w.ndim == 1 else w for w in weights))
        better = update_excess(solution.residual, solution.jacobian, information, whole, tuple(factors), excess)
    else:
        groups = jnp.concatenate([each.group + a for each, a in zip(covariances, edges[:-1], strict=True)])
        better = _robust_excess(problem.residuals(solution.z), groups, excess)
    covariance = jnp.linalg.inv(information)

    def of_magnitude(magnitude):
        moved = tuple(each.at_magnitude(magnitude) for each in conditions)
        return eqx.tree_at(lambda p: p.conditions, problem, moved).objective(solution.z)[0]

    magnitude = conditions[0].magnitude
    slope = jax.jvp(of_magnitude, (magnitude,), (jnp.ones_like(magnitude),))[1]
    reach = -covariance @ (solution.jacobian.T @ slope)
    z = solution.z
    if loss == "linear":  # what the solver's tolerance leaves, taken off by a last Newton step
        left = solution.jacobian.T @ solution.residual + root.T @ (root @ (z - mean))
        z = jnp.where(damping == 0, z - covariance @ left, z)
    return _Pass(
        z, better, solution.residual, solution.jacobian, covariance, reach,
        0.5 * sum(jnp.sum(each**2) for each in before), solution.cost, solution.steps, solution.converged,
        solution.finite,
    )  # fmt: skip


def _run(loss: str, like: Imu, parameters: Parameters, units) -> _Pass:
    """Run one pass for a batch of units; a compiled function for each loss and shape.

    On a CPU lanes run one after the other inside the compiled loop: a lane stops when it has converged, its matrices
    stay in the cache, and XLA's thread pool, which can lock up when large batched products nest in a loop on a CPU with
    few cores, is not drawn upon. On an accelerator lanes run side by side.
    """
    count = units[1][-1].shape[0]

    def batch(like, parameters, units):
        def lane(item):
            reference, unit = item
            own = eqx.tree_at(lambda p: p.reference, parameters, reference)
            return _single_pass(loss, like, own, unit)

        lanes = None if jax.default_backend() == "cpu" else count
        return jax.lax.map(lane, units, batch_size=lanes)

    description = f"pass {loss}"
    leaves = stored.call(batch, description, like, parameters, units, quick=count == 1)
    return jax.tree.map(np.asarray, _Pass(*leaves))


# --- passes -----------------------------------------------------------------------------------------------------------


def fit(
    imu: Imu,
    data: Data | Sequence[Data],
    free: Callable[[Name], bool],
    *,
    prior: Prior | None = None,
    loss: str = "linear",
    excess: Sequence[float] | FloatArray | None = None,
    estimate_excess: bool = True,
    most: Sequence[float] | FloatArray | None = None,
    follow: bool = False,
    max_passes: int = 32,
) -> Fit:
    """Fit the free numbers of a unit with its effects; with a leading axis on every array, of many units.

    **Arguments:**

    - `imu`: where the fit starts: gain and bias as the data sheet or an old calibration has them, and the effects to be
      fitted, or to be held, with their numbers.
    - `data`: what was measured; several of one unit are one problem.
    - `free`: which numbers are free, by name.
    - `prior`: what is known beforehand. A number of which it says nothing is known to five typical sizes about its
      start, so a problem is never singular; where data speak, that counts for less than a millionth.
    - `loss`: `"linear"`, `"huber"` or `"cauchy"`.
    - `excess`: of the variance components, to begin with, of all units (k,) or each (N, k).
    - `estimate_excess`: whether it is estimated (restricted likelihood; for robust losses by medians).
    - `most`: of each component (k,), the most that it can be: a likelihood of few conditions may have no maximum.
    - `follow`: what is known beforehand moves with the estimate, so that what data determine owes the start nothing.

    **Returns:** a `Fit` with the same leading axes. Look at `converged` and `finite`: failures do not raise, so that
    one bad unit does not stop a batch.
    """
    one_of("loss", loss, tuple(LOSSES))
    require_float64()
    given = (data,) if isinstance(data, Data) else tuple(data)
    single = np.ndim(imu.accelerometer.bias) == 1
    imu = jax.tree.map(lambda leaf: np.asarray(leaf, float)[None] if single else np.asarray(leaf, float), imu)
    count = len(imu.accelerometer.bias)
    pieces = []
    for first in range(0, count, _CHUNK):
        lanes = np.arange(first, min(first + _CHUNK, count))
        part = jax.tree.map(lambda leaf, lanes=lanes: leaf[lanes], imu)
        passes = _Passes(part, tuple(each.take(lanes) for each in given), free, prior, loss, estimate_excess, follow)
        begin = None if excess is None else np.asarray(excess, float)
        begin = begin if begin is None or begin.ndim < 2 else begin[lanes]
        pieces.append(passes.run(begin, np.inf if most is None else np.asarray(most, float), max_passes))
    if single:
        return jax.tree.map(lambda leaf: leaf[0], pieces[0])
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *pieces)


class _Passes:
    """The passes of up to `_CHUNK` units, and where they are."""

    def __init__(self, imu: Imu, data: tuple[Data, ...], free, prior, loss: str, estimated: bool, follow: bool):
        self.data, self.loss, self.estimated, self.follow = data, loss, estimated, follow
        self.inside = data[0].effects_inside
        like = jax.tree.map(lambda leaf: leaf[0], imu)
        self.like = like if self.inside else like.with_effects()
        self.full = like
        self.count = len(imu.accelerometer.bias)
        self.parameters = Parameters.select(self.like, free)
        none = (), np.zeros(0), np.zeros(0)
        names, self.numbers, sizes = none if self.inside else effect_numbers(like)
        self.kept = np.array([free(name) for name in names], bool)
        chosen = tuple(name for name, kept in zip(names, self.kept, strict=True) if kept)
        self.names = (*self.parameters.names, *chosen)
        self.sizes = np.concatenate([np.asarray(self.parameters.size), sizes[self.kept]])
        self.base = len(self.parameters.names)
        bare = imu if len(names) == 0 else jax.tree.map(lambda leaf: leaf[None], self.like)  # effects: of one unit
        self.reference = np.concatenate([np.reshape(leaf, (self.count, -1)) for leaf in jax.tree.leaves(bare)], axis=1)
        self.spare = 0
        if self.count == 1 and not self.inside:
            needed = len(self.names) - self.base
            self.spare = next((size for size in _SPARE if size >= needed), needed) - needed
        self.prior = prior
        self.anchor = self.values()
        for place, name in enumerate(self.names[self.base :], self.base):
            if name.part == "coefficients":  # where the data do not say, an effect is absent, wherever the fit starts
                self.anchor[:, place] = 0.0

    def values(self) -> FloatArray:
        """Return the free numbers (N, p) where the passes are."""
        base = self.reference[:, list(self.parameters.index)]
        extra = np.broadcast_to(self.numbers[self.kept], (self.count, int(self.kept.sum())))
        return np.concatenate([base, extra], axis=1)

    def model(self, lanes: NDArray[np.int64]) -> Imu:
        """Return the units where the passes are."""
        if not len(self.numbers):
            return unflatten(self.like, self.reference[lanes])
        effects = _with_numbers(self.full, self.numbers).all_effects().values()
        single = unflatten(self.like, self.reference[0]).with_effects(*effects)
        return jax.tree.map(lambda leaf: np.asarray(leaf, float)[None], single)

    def known(self, lanes: NDArray[np.int64], tolerance: float) -> tuple[FloatArray, FloatArray]:
        """Return mean (N, p) and root (p, p) of what is known beforehand, about where the passes are, scaled."""
        here = self.values()[lanes]
        width = np.full(len(self.names), tolerance)
        effects = self.full.all_effects()
        width[self.base :] = [
            effects[name.owner, name.effect].plausible if name.part == "coefficients" else TOLERANCE
            for name in self.names[self.base :]
        ]
        root = np.diag(1 / width)
        mean = np.zeros_like(here) if self.follow else (self.anchor[lanes] - here) / self.sizes
        if self.prior is not None:
            places = np.array([self.names.index(name) for name in self.prior.names], int)
            root[places] = 0.0
            root[np.ix_(places, places)] = self.prior.root * self.sizes[places]
            mean[:, places] = (self.prior.mean - here[:, places]) / self.sizes[places]
        mean = np.pad(mean, [(0, 0), (0, self.spare)])
        whole = np.eye(len(self.names) + self.spare)
        whole[: len(root), : len(root)] = root
        return mean, np.broadcast_to(whole, (len(lanes), *whole.shape)).copy()

    def once(self, lanes: NDArray[np.int64], excess: FloatArray, damping: FloatArray, tolerance: float) -> _Pass:
        """Evaluate the data where the passes are, and solve; `lanes` are padded to a shape by repetition."""
        size = 1 if len(lanes) == 1 else 8 if len(lanes) <= 8 else _CHUNK
        padded = np.concatenate([lanes, np.full(size - len(lanes), lanes[-1])])
        imu = self.model(padded)
        about = [each.take(padded).about(imu) for each in self.data]
        columns = np.concatenate([each.columns for each in about], axis=1)
        columns = columns[..., self.kept] * self.sizes[self.base :]
        columns = np.pad(columns, [(0, 0), (0, 0), (0, self.spare)])
        mean, root = self.known(padded, tolerance)
        unit = (
            tuple(each.conditions for each in about), tuple(each.covariance for each in about), columns, mean, root,
            damping[padded], excess[padded],
        )  # fmt: skip
        out = _run(self.loss, self.like, self.parameters, (self.reference[padded], unit))
        return jax.tree.map(lambda leaf: leaf[: len(lanes)], out)

    def move(self, lanes: NDArray[np.int64], z: FloatArray) -> None:
        """Take the step z (N, p) in typical sizes."""
        self.reference[lanes[:, None], list(self.parameters.index)] += self.sizes[: self.base] * z[:, : self.base]
        if self.kept.any() and len(lanes):
            changed = np.array(self.numbers)
            changed[self.kept] += self.sizes[self.base :] * z[0, self.base : len(self.names)]
            here = _with_numbers(self.full, self.numbers)
            self.numbers = effect_numbers(_with_numbers(here, changed))[1]

    def run(self, excess, most, max_passes: int) -> Fit:
        """Alternate until nothing moves, only the lanes that still do.

        A pass solves a problem that is linear in what the turns rotate by and in what effects add. Where its step made
        the sum of squares larger after all, it is taken back, and the next one is damped.
        """
        coarse = [size for each in self.data for size in each.coarse]
        begin = np.array(coarse if excess is None else excess, float)
        excess = np.tile(begin, (self.count, 1)) if begin.ndim == 1 else begin
        blunted = self.estimated and bool(begin.any())
        result: _Pass | None = None
        active, settled = np.arange(self.count), np.zeros(self.count, bool)
        used, damping, least = np.array(excess), np.zeros(self.count), np.full(self.count, np.inf)
        share, taken = np.ones(self.count), np.zeros_like(excess)
        before = np.array(self.reference), self.numbers
        for number in range(max_passes):
            first = blunted and number == 0
            out = self.once(active, excess, damping, _COARSE if first else TOLERANCE)
            worse = out.start > least[active]
            if worse.any():
                self.reference[active[worse]] = before[0][active[worse]]
                self.numbers = before[1] if self.kept.any() else self.numbers
                damping[active[worse]] = np.maximum(100 * damping[active[worse]], _DAMPING)  # ten times the last one
                least[active[worse]] = np.inf  # evaluated again from where it was
            if worse.all():
                continue
            lanes, out = active[~worse], jax.tree.map(lambda leaf, good=~worse: leaf[good], out)
            result = out if result is None else jax.tree.map(partial(_put, lanes), result, out)
            used[lanes] = excess[lanes]
            way = np.minimum(out.excess, most) - excess[lanes] if self.estimated else np.zeros_like(out.excess)
            # where a large component has drowned a small one for long, both count by their relative change
            scale = 1 + excess[lanes] if number >= _DROWNED else np.ones_like(way)
            leap = _LEAP if number >= _DROWNED else np.inf
            likely = _secant(share[lanes], taken[lanes] / scale, way / scale, leap)
            share[lanes] = 1.0 if number < _SWINGING else likely
            taken[lanes] = way
            better = np.clip(excess[lanes] + share[lanes, None] * way, 0.0, most)
            change = (np.abs(better - excess[lanes]) / (1 + excess[lanes])).max(axis=1, initial=0.0)
            length = np.linalg.norm(np.einsum("unp,up->un", out.jacobian, out.z), axis=1)
            still = (change < _SETTLED) & (length < _STILL) & (damping[lanes] <= _MILD) & (not first)
            if number >= _CREEPING:
                creep = np.abs(way / scale).max(axis=1, initial=0.0)
                still |= (creep < _CREEPS[0]) & (length < _CREEPS[1]) & (damping[lanes] <= _MILD)
            before[0][lanes], before = self.reference[lanes], (before[0], self.numbers)
            # the last pass takes no step that none after it would check
            taking = still | (number + 1 < max_passes)
            self.move(lanes[taking], out.z[taking])
            settled[lanes] = still
            # sums of squares compare where they are weighted alike
            alike = (change < _SETTLED) & (not first) & (not self.follow)
            least[lanes] = np.where(alike, 1.005 * out.start + 0.05, np.inf)
            damping[lanes] = np.where(damping[lanes] > _DAMPING / 100, damping[lanes] / 10, 0.0)
            # a result goes with the excess that it was weighted with
            excess[lanes] = np.where(still[:, None] | ~out.finite[:, None], excess[lanes], better)
            active = np.sort(np.concatenate([active[worse], lanes[~still & out.finite]]))
            if not len(active):
                break
        assert result is not None
        size = self.sizes
        keep = len(size)
        covariance = result.covariance[:, :keep, :keep] * size[:, None] * size
        return Fit(
            self.model(np.arange(self.count)), self.names, np.tile(size, (self.count, 1)), self.values(), covariance,
            result.magnitude[:, :keep] * size, result.residual, result.jacobian[..., :keep], used, result.cost,
            result.steps, result.converged & settled, result.finite,
        )  # pyright: ignore[reportCallIssue] # fmt: skip


def _secant(share: FloatArray, before: FloatArray, now: FloatArray, leap: float) -> FloatArray:
    """Return the share (N,) of the change `now` (N, k) to take, after that share of the change `before`.

    Components that trade with each other swing about the answer or creep towards it: the change shrinks by a factor
    1 − share · m along the way, and 1 / m ends it. Beyond the change itself no component goes by more than `leap`.
    """
    length = np.maximum(np.sum(before**2, axis=1), 1e-300)
    ratio = np.sum(before * now, axis=1) / length
    farthest = np.clip(leap / np.maximum(np.abs(now).max(axis=1, initial=0.0), 1e-300), 1.0, _FARTHEST)
    return np.clip(share / np.maximum(1 - ratio, share / _FARTHEST), 0.25, farthest)


def _put(lanes, leaf, new):
    leaf = np.array(leaf)
    leaf[lanes] = new
    return leaf
