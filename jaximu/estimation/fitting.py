"""The one place that iterates to an estimate: `fit` alternates Levenberg–Marquardt with the excess variance.

The way: `Data` are evaluated about a unit, samples and effects included (`about`); what comes out is small,
conditions as a function of gain and bias, their covariance, and how they react to the effects' numbers. On that the
compiled pass solves for all free numbers and improves the excess; then the data are evaluated again where the
estimate went, until nothing moves.
"""

from __future__ import annotations

import hashlib
import pickle
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float, Int

from jaximu.estimation.covariance import Chain, ChainWeights, Covariance, Weights, parts_of, update_excess
from jaximu.estimation.data import Conditions, Data
from jaximu.estimation.problem import LOSSES, TOLERANCE, Name, Parameters, flatten, names_of, typical_sizes, unflatten
from jaximu.estimation.solver import MAX_STEPS, Failure, Solution, solve
from jaximu.ground import stored
from jaximu.ground.array_types import Array, BoolArray, Computed, FloatArray, IntArray
from jaximu.ground.differences import value_and_jacobian
from jaximu.ground.errors import InputError, one_of
from jaximu.ground.precision import require_float64
from jaximu.ground.tracing import array_module, first, is_traced, lifted, part_of
from jaximu.ground.vectors import sigmas_of, submatrix
from jaximu.model.effects.base import inner_owners
from jaximu.model.sensor import Imu

_CHUNK = 16
"""Units of a batch that a compiled pass takes: as many as make calling it cheap, and no more are fitted in vain."""
_SPARE = (12, 36, 84)
"""Numbers of effects that share a compiled pass: rows of zeros fill up to the next."""
_STILL = 1e-2
"""Standard deviations below which a step ends the passes: what it leaves is its square."""
_LINEAR = 3e-4
"""Typical sizes, times the step's standard deviations where they are more than one, within which a problem is linear: a
Newton step is enough, and data evaluated before it hold after it. A solver's last steps are a tenth of it."""
_SWINGING = 5
"""After this many passes, the excess is extrapolated from its last two changes."""
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


class Prior(eqx.Module):
    """What is known of some numbers beforehand, in place of a data sheet's tolerance: root · (x − mean) is white.

    mean, root: in the numbers' own units.
    """

    names: tuple[Name, ...] = eqx.field(static=True)
    mean: Float[Array, " k"]
    root: Float[Array, "k k"]

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
        for (owner, number), effect in effects.items():
            width = stated.get(effect.name, effect.known)
            if effect.name in stated and np.min(width) <= 0:
                raise InputError(f"a standard deviation must be greater than zero, found {np.min(width):g}.")
            if np.any(width):
                names += [Name(owner, "coefficients", (k,), number) for k in range(effect.size)]
                values += np.asarray(effect.coefficients).tolist()
                sigma += np.broadcast_to(width, effect.size).tolist()
        return cls(tuple(names), np.array(values), np.diag(1 / np.array(sigma))) if names else None

    def rows(self, names: Sequence[Name], sizes: Array) -> FloatArray:
        """Return what is known as whitened conditions (k, p) of numbers `names` in typical `sizes` (p,)."""
        places = [names.index(name) for name in self.names]
        conditions = np.zeros((len(places), len(names)))
        conditions[:, places] = np.asarray(self.root) * np.asarray(sizes)[places]
        return conditions

    @classmethod
    def joined(cls, *priors: Prior | None) -> Prior | None:
        """Return what several state of different numbers as one; None where nothing is known."""
        known = [prior for prior in priors if prior is not None]
        if len(known) < 2:
            return known[0] if known else None
        names = tuple(name for prior in known for name in prior.names)
        root = scipy.linalg.block_diag(*(prior.root for prior in known))
        return cls(names, np.concatenate([prior.mean for prior in known]), root)


class Fit(eqx.Module):
    """A solved problem, or with leading axes N a batch of them.

    `imu` has the effects as fitted. `covariance` is of the free numbers `names` in their own units, without the known
    magnitude's uncertainty, to which each reacts by `magnitude_sensitivity` (per m/s², or µT). `excess` is the variance
    of each component, beyond the measured noise and in multiples of it: above zero, the model or the noise misses
    something. `residual` and `jacobian` are whitened, the latter with respect to numbers in typical `sizes`.
    """

    imu: Imu
    names: tuple[Name, ...] = eqx.field(static=True)
    sizes: Float[Computed, "... p"]
    values: Float[Computed, "... p"]
    covariance: Float[Computed, "... p p"]
    magnitude_sensitivity: Float[Computed, "... p"]
    residual: Float[Computed, "... n"]
    jacobian: Float[Computed, "... n p"]
    excess: Float[Computed, "... k"]
    cost: Float[Computed, ...]
    steps: Int[Computed, ...]
    converged: Bool[Computed, ...]
    finite: Bool[Computed, ...]

    def failure(self) -> Failure:
        """Return how an unbatched fit ended."""
        return Failure.of(self.converged, self.finite)

    def sigmas(self, magnitude_sigma: float = 0.0) -> Float[Array, "... p"]:
        """Return the standard deviations of the free numbers, the uncertainty of the magnitude included."""
        return sigmas_of(self.total_covariance(magnitude_sigma))

    def total_covariance(self, magnitude_sigma: float = 0.0, clock_sigma: float = 0.0) -> Float[Array, "... p p"]:
        """Return the covariance with what an uncertain magnitude (one sigma) adds, and an uncertain gyroscope's clock.

        Rates times stamps are angles: stamps that run fast by a share make the gain K too large by it, dK = K dc.
        """
        magnitude = np.asarray(self.magnitude_sensitivity) * magnitude_sigma
        turning = [name.owner == "gyroscope" and name.part == "gain" for name in self.names]
        clock = np.where(turning, np.asarray(self.values), 0.0) * clock_sigma
        shifts = (shift[..., :, None] * shift[..., None, :] for shift in (magnitude, clock))
        return sum(shifts, np.asarray(self.covariance))


def unwhitened(fitted: Fit, covariance: Covariance | Chain) -> tuple[FloatArray, FloatArray]:
    """Return the residual (n,) and Jacobian (n, p) of an unbatched fit of one kind of data, in its conditions' units.

    **Arguments:** `covariance`: of the conditions, close to where the fit ended.
    """

    def rows(covariance, excess, white):
        return covariance.weights(excess).unwhiten(white)

    white = np.concatenate([np.asarray(fitted.residual)[:, None], fitted.jacobian], axis=1)
    conditions = np.asarray(stored.call(rows, "unwhitened", covariance, np.asarray(fitted.excess), white))
    return conditions[:, 0], conditions[:, 1:]


def informed(fitted: Fit, prior: Prior) -> Fit:
    """Return an unbatched fit with what else is known of gains and biases, in the closed form of two normal laws.

    For a fit whose covariance was widened after it, beside which a prior inside `fit` would count for too little.
    """
    rows = [fitted.names.index(name) for name in prior.names]
    covariance, values = np.asarray(fitted.covariance), np.asarray(fitted.values)
    known = np.linalg.inv(prior.root.T @ prior.root)
    share = covariance[:, rows] @ np.linalg.inv(submatrix(covariance, rows) + known)
    keep = np.eye(len(values))
    keep[:, rows] -= share
    moved = values + share @ (prior.mean - values[rows])
    base = np.array([name.effect is None for name in fitted.names])
    bare = fitted.imu.with_effects()
    flat = flatten(bare)
    flat[[name in fitted.names for name in names_of(bare)]] = moved[base]
    return replace(
        fitted,
        imu=unflatten(bare, flat).with_effects(*fitted.imu.all_effects().values()),
        values=np.where(base, moved, values),
        covariance=keep @ covariance,
        magnitude_sensitivity=keep @ np.asarray(fitted.magnitude_sensitivity),
    )


# --- the effects' numbers ---------------------------------------------------------------------------------------------


def effect_numbers(imu: Imu) -> tuple[tuple[Name, ...], Float[Array, "... q"], Float[Array, "... q"]]:
    """Return the names, values and typical sizes of the free numbers of units' effects, effect by effect.

    An inner parameter that effects share is a number of the one that it belongs to.
    """
    numerics, effects = array_module(imu), imu.all_effects()
    owners = inner_owners(effects)
    names, values, sizes = [], [numerics.zeros((*np.shape(imu.accelerometer.bias)[:-1], 0))], []
    for (owner, number), effect in effects.items():
        gain = imu.triads().get(owner, imu.accelerometer).gain
        scale = numerics.mean(numerics.linalg.norm(gain, axis=-1), axis=-1, keepdims=True)
        typical = effect.typical_sizes(scale).coefficients
        names += [Name(owner, "coefficients", (k,), number) for k in range(effect.size)]
        values.append(effect.coefficients)
        sizes.append(numerics.broadcast_to(typical, np.shape(effect.coefficients)))
        for inner in effect.inner if owners[owner, number] == (owner, number) else ():
            value = numerics.asarray(getattr(effect, inner))[..., None]
            names.append(Name(owner, inner, (), number))
            values.append(value)
            sizes.append(numerics.maximum(numerics.abs(value), 1e-9))
    together = numerics.concatenate(values, axis=-1)
    return tuple(names), together, numerics.concatenate([together[..., :0], *sizes], axis=-1)


def _with_numbers(imu: Imu, values: Float[Array, "... q"]) -> Imu:
    """Return units with their effects' numbers; an inner parameter moves by a factor of two at most, in its range."""
    numerics, effects, first = array_module(imu, values), imu.all_effects(), 0
    owners, coefficients, inner = inner_owners(effects), {}, {}
    for at, effect in effects.items():
        coefficients[at] = values[..., first : first + effect.size]
        first += effect.size
        if owners[at] != at:
            continue
        inner[at] = {}
        for name, limits in effect.inner.items():
            old = numerics.asarray(getattr(effect, name))
            change = values[..., first] - old
            moved = numerics.clip(old + numerics.clip(change, -0.5 * old, old), limits.low, limits.high)
            inner[at][name] = numerics.where(change == 0, old, moved)  # one that is held may lie outside
            first += 1
    moved_to = (type(effect)(coefficients[at], **inner[owners[at]]) for at, effect in effects.items())
    return imu.with_effects(*moved_to)


@dataclass(frozen=True)
class Linear:
    """A measurement linearised at one unit with its effects, padding included.

    conditions (n,); slope (n, p) by the free numbers of gain and bias, in typical sizes; columns (n, q) by those of the
    effects, in their own units; names: of both, and sizes (p + q) their typical sizes. details, unknown: as in `About`.
    """

    conditions: FloatArray
    slope: FloatArray
    columns: FloatArray
    covariance: FloatArray
    names: tuple[Name, ...]
    sizes: FloatArray
    details: Any
    unknown: FloatArray | None = None


def linearise(imu: Imu, measurement: Data, free: Callable[[Name], bool]) -> Linear:
    """Return a measurement about one unit with its effects, as a linear problem in the free numbers."""
    imu = jax.tree.map(lambda leaf: np.asarray(leaf, float), imu)
    about = measurement.about(lifted(imu))
    like = imu if measurement.effects_inside else imu.with_effects()
    parameters = Parameters.select(like, free)
    names, _, sizes = ((), None, np.zeros(0)) if measurement.effects_inside else effect_numbers(imu)

    def both(like, parameters, conditions):
        zero = jnp.zeros(len(parameters.index))
        return value_and_jacobian(lambda z: conditions(parameters.model(like, z)), zero)

    value, slope = stored.call(both, "linearised", like, parameters, first(about.conditions))
    return Linear(
        value,
        slope,
        about.columns[0],
        first(about.covariance).dense().measured,
        (*parameters.names, *names),
        np.concatenate([np.asarray(parameters.size), sizes]),
        about.details,
        about.unknown,
    )


# --- a compiled pass --------------------------------------------------------------------------------------------------


class _Evaluated(eqx.Module):
    """A problem at a place: whitened residual and Jacobian, after the loss; what follows from them to first order.

    gradient: of half the sum of squares; excess: improved once. magnitude: how the numbers react to what is known and
    uncertain.
    """

    residual: Array
    jacobian: Array
    gradient: Array
    covariance: Array
    excess: Array
    magnitude: Array


class _Pass(eqx.Module):
    """What one pass returns: its step, and the problem there; `start` is the cost before it."""

    z: Array
    there: _Evaluated
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
    weights: tuple[Weights | ChainWeights, ...]
    used: tuple[Array, ...]
    columns: Array
    shift: Array
    mean: Array
    root: Array
    damping: Array
    loss: str = eqx.field(static=True)

    def residuals(self, z):
        count = len(self.parameters.index)
        model = self.parameters.model(self.like, z[:count])
        kinds = zip(self.weights, self.used, self.conditions, strict=True)
        plain = jnp.concatenate(
            [weights.whiten(used * conditions(model)[: len(used)]) for weights, used, conditions in kinds]
        )
        return plain + self.columns @ (z[count:] + self.shift)

    def objective(self, z):
        beforehand = jnp.concatenate([self.root @ (z - self.mean), self.damping * z])
        return LOSSES[self.loss](self.residuals(z)), beforehand


def _robust_excess(residual: Array, groups: Array, excess: Array) -> Array:
    """Excess from the median absolute residual of each group of rows: outliers do not reach it."""
    size = jnp.where(residual == 0.0, jnp.nan, jnp.abs(residual))  # padding is exactly zero
    medians = jnp.stack([jnp.nanmedian(jnp.where(groups == k, size, jnp.nan)) for k in range(len(excess))])
    spread = medians / 0.6745
    return jnp.where(jnp.isnan(spread), excess, jnp.maximum((1 + excess) * jnp.nan_to_num(spread) ** 2 - 1, 0.0))


class _Unit(NamedTuple):
    """What a pass knows of one unit: what was measured, and what is known beforehand.

    shift: of the numbers that act by columns, since the data were evaluated.
    """

    conditions: tuple[Conditions, ...]
    covariances: tuple[Covariance | Chain, ...]
    columns: Array
    shift: Array
    mean: Array
    root: Array
    damping: Array
    excess: Array

    def problem(self, loss: str, like: Imu, parameters: Parameters) -> _Whitened:
        """Return the problem of a pass."""
        weights, white = [], []
        for kind, (rows, numbers) in zip(self.covariances, parts_of(self.covariances), strict=True):
            weights.append(kind.weights(self.excess[numbers]))
            white.append(weights[-1].whiten(kind.used[:, None] * self.columns[rows]))
        used = tuple(kind.used for kind in self.covariances)
        return _Whitened(
            like,
            parameters,
            self.conditions,
            tuple(weights),
            used,
            jnp.concatenate(white),
            self.shift,
            self.mean,
            self.root,
            self.damping,
            loss,
        )

    def evaluated(self, problem: _Whitened, estimated: bool, z: Array, residual: Array, jacobian: Array) -> _Evaluated:
        """Return what follows from residual and Jacobian at z; the excess is improved where it is estimated."""
        information = jacobian.T @ jacobian + self.root.T @ self.root
        if not estimated:
            better = self.excess
        elif problem.loss == "linear":
            better = update_excess(self.covariances, problem.weights, residual, jacobian, information, self.excess)
        else:
            kinds = zip(self.covariances, parts_of(self.covariances), strict=True)
            groups = jnp.concatenate([kind.group + numbers.start for kind, (_, numbers) in kinds])
            better = _robust_excess(problem.residuals(z), groups, self.excess)
        covariance = jnp.linalg.inv(information)
        gradient = jacobian.T @ residual + self.root.T @ (self.root @ (z - self.mean))

        def of_magnitude(magnitude):
            moved = tuple(kind.at_magnitude(magnitude) for kind in self.conditions)
            return replace(problem, conditions=moved).objective(z)[0]

        magnitude = self.conditions[0].magnitude  # pyright: ignore[reportAttributeAccessIssue]
        slope = jax.jvp(of_magnitude, (magnitude,), (jnp.ones_like(magnitude),))[1]
        return _Evaluated(residual, jacobian, gradient, covariance, better, -covariance @ (jacobian.T @ slope))


class _Solving(NamedTuple):
    """How the problem of a pass is solved: `solver`, where it is not ours, and what tells it apart from every other.

    estimated: whether the excess is.
    """

    loss: str
    estimated: bool
    solver: Any
    name: str

    @classmethod
    def by(cls, loss: str, estimated: bool, solver: Any) -> _Solving:
        """Return the way of solving by a loss and an optimistix solver, or None."""
        try:
            name = "" if solver is None else hashlib.sha256(pickle.dumps(solver)).hexdigest()
        except (pickle.PicklingError, AttributeError, TypeError):  # a function without a name inside
            name = secrets.token_hex()
        return cls(loss, estimated, solver, f"{loss} {estimated} {name}")


def _single_pass(how: _Solving, like: Imu, parameters: Parameters, unit: _Unit) -> _Pass:
    problem = unit.problem(how.loss, like, parameters)
    zero = jnp.zeros(len(unit.mean))
    linear = how.loss == "linear"
    (residual, known), (jacobian, by) = value_and_jacobian(problem.objective, zero)
    start = 0.5 * (jnp.sum(residual**2) + jnp.sum(known**2))
    step = jnp.linalg.solve(jacobian.T @ jacobian + by.T @ by, jacobian.T @ residual + by.T @ known)
    usual = linear and how.solver is None
    near = usual & (unit.damping == 0) & (_leaves(jnp, step, jnp.linalg.norm(jacobian @ step)) < _LINEAR)
    finite = jnp.isfinite(jacobian).all() & jnp.isfinite(start)
    solution = jax.lax.cond(
        near,
        lambda: Solution(zero, residual, jacobian, start, jnp.array(1), finite, finite),
        lambda: solve(problem, zero, MAX_STEPS, _LINEAR / 10 if linear else _LINEAR**2, how.solver),
    )
    there = unit.evaluated(problem, how.estimated, solution.z, solution.residual, solution.jacobian)
    z = solution.z
    if linear:  # what the solver's tolerance leaves, taken off by a last Newton step
        z = jnp.where(unit.damping == 0, z - there.covariance @ there.gradient, z)
    return _Pass(z, there, start, solution.cost, solution.steps, solution.converged, solution.finite)


def _leaves(numerics: Any, step: Array, length: Array) -> Array:
    """Return what a linear problem leaves after a step (..., p), in typical sizes; `length`: standard deviations."""
    return numerics.abs(step).max(axis=-1, initial=0.0) * numerics.maximum(1.0, length)


def _no_step(how: _Solving, like: Imu, parameters: Parameters, unit: _Unit) -> _Evaluated:
    """Return the problem where the passes are."""
    problem = unit.problem(how.loss, like, parameters)
    zero = jnp.zeros(len(unit.mean))
    residual, jacobian = value_and_jacobian(lambda z: problem.objective(z)[0], zero)
    return unit.evaluated(problem, how.estimated, zero, residual, jacobian)


def _run(
    one: Callable, how: _Solving, like: Imu, parameters: Parameters, references: Array, sizes: Array, units: _Unit
) -> Any:
    """Run `_single_pass` or `_no_step` for a batch of units; a compiled function for each loss and shape.

    On a CPU lanes run one after the other inside the compiled loop: a lane stops when it has converged, its matrices
    stay in the cache, and XLA's thread pool, which can lock up when large batched products nest in a loop on a CPU with
    few cores, is not drawn upon. On an accelerator lanes run side by side.
    """
    count = units.mean.shape[0]

    def batch(like, parameters, references, sizes, units):
        def lane(item):
            reference, size, unit = item
            return one(how, like, replace(parameters, reference=reference, size=size), unit)

        lanes = None if jax.default_backend() == "cpu" else count
        return jax.lax.map(lane, (references, sizes, units), batch_size=lanes)

    return stored.call(
        batch, f"{one.__name__} {how.name}", like, parameters, references, sizes, units, quick=count == 1
    )


# --- passes -----------------------------------------------------------------------------------------------------------


def fit(
    imu: Imu,
    data: Data | Sequence[Data],
    free: Callable[[Name], bool] | None = None,
    *,
    prior: Prior | None = None,
    loss: str = "linear",
    excess: Sequence[float] | Array | None = None,
    estimate_excess: bool = True,
    most: Sequence[float] | FloatArray | None = None,
    follow: bool = False,
    max_passes: int = 32,
    solver: Any = None,
) -> Fit:
    """Fit the free numbers of a unit with its effects; with a leading axis on every array, of many units.

    **Arguments:**

    - `imu`: where the fit starts: gain and bias as the data sheet or an old calibration has them, and the effects to be
      fitted, or to be held, with their numbers.
    - `data`: what was measured; several of one unit are one problem.
    - `free`: which numbers are free, by name; what any of the data may tell, if left out. When an effect begins is
      held: no derivative tells it.
    - `prior`: what is known beforehand. A number of which it says nothing is known to five typical sizes about its
      start, so a problem is never singular; where data speak, that counts for less than a millionth.
    - `loss`: `"linear"`, `"huber"` or `"cauchy"`.
    - `excess`: of the variance components, to begin with, of all units (k,) or each (N, k).
    - `estimate_excess`: whether it is estimated (restricted likelihood; for robust losses by medians).
    - `most`: of each component (k,), the most that it can be: a likelihood of few conditions may have no maximum.
    - `follow`: what is known beforehand moves with the estimate, so that what data determine owes the start nothing.
    - `solver`: an optimistix least-squares solver for the problem of each pass, in place of ours.

    **Returns:** a `Fit` with the same leading axes. Look at `converged` and `finite`: failures do not raise, so that
    one bad unit does not stop a batch.
    """
    one_of("loss", loss, tuple(LOSSES))
    require_float64()
    measured = (data,) if isinstance(data, Data) else tuple(data)
    numerics = array_module(imu, measured, prior, excess, most)
    single = np.ndim(imu.accelerometer.bias) == 1
    imu = jax.tree.map(lambda leaf: numerics.asarray(leaf, float), lifted(imu) if single else imu)
    farthest = np.inf if most is None else numerics.asarray(most, float)
    begin = [size for kind in measured for size in kind.coarse] if excess is None else excess
    blunted = estimate_excess and (is_traced(begin) or bool(np.any(begin)))
    how = _Solving.by(loss, estimate_excess, solver)
    passes = _Passes(imu, measured, free, prior, how, follow, farthest, max_passes, blunted, numerics)
    begin = numerics.asarray(begin, float)
    begin = numerics.broadcast_to(begin, (len(imu.accelerometer.bias), begin.shape[-1]))
    fitted = passes.traced(begin) if numerics is jnp else passes.run(begin)
    return first(fitted) if single else fitted


class _State(eqx.Module):
    """Where the passes of units are, the leading axis N of every array.

    reference: all numbers of gain and bias; numbers: of the effects; excess: to weight with next, used: the last one.
    damping: of the next step. least: cost above which a step led astray, and before: where it began. share, taken: of
    the last change of the excess. active: units whose passes go on; settled: those that stand; moved: those that went
    farther than data evaluated before hold.
    """

    reference: Float[Array, "N m"]
    numbers: Float[Array, "N q"]
    excess: Float[Array, "N k"]
    used: Float[Array, "N k"]
    damping: Float[Array, " N"]
    least: Float[Array, " N"]
    before: tuple[Float[Array, "N m"], Float[Array, "N q"]]
    share: Float[Array, " N"]
    taken: Float[Array, "N k"]
    active: Bool[Array, " N"]
    settled: Bool[Array, " N"]
    moved: Bool[Array, " N"]


@dataclass(eq=False)
class _Passes:
    """What stays the same in the passes of units: free numbers, data, what is known beforehand.

    The same text runs on the host, pass by pass and with the units that still move, and under a trace, where a loop of
    JAX does. There the result is differentiated as what solves the equations that it solves, not as what led to it.
    """

    full: Imu
    data: tuple[Data, ...]
    free: Callable[[Name], bool] | None
    prior: Prior | None
    how: _Solving
    follow: bool
    most: FloatArray | float
    max_passes: int
    blunted: bool
    numerics: Any

    def __post_init__(self):
        numerics, imu, free = self.numerics, self.full, self.free or self._free
        inside = self.data[0].effects_inside
        bare = imu if inside else imu.with_effects()
        self.like = first(bare)
        self.count = len(imu.accelerometer.bias)
        self.parameters = Parameters.select(self.like, free)
        nothing = (), numerics.zeros((self.count, 0)), numerics.zeros((self.count, 0))
        names, self.numbers, sizes = nothing if inside else effect_numbers(imu)
        effects = imu.all_effects()
        self.kept = np.array([free(name) and name.part != effects[name.key].beginning() for name in names], bool)
        chosen = tuple(name for name, kept in zip(names, self.kept, strict=True) if kept)
        self.names = (*self.parameters.names, *chosen)
        self.base = len(self.parameters.names)
        self.index = np.array(self.parameters.index, int)
        self.reference = self._beside(bare)
        of_base = numerics.tile(self.parameters.size, (self.count, 1))
        if not bare.all_effects():  # units may have other scales
            of_base = self._beside(typical_sizes(bare))[:, self.index]
        self.sizes = numerics.concatenate([of_base, sizes[:, self.kept]], axis=1)
        self.spare = 0
        if self.count == 1 and not inside:
            self.spare = next((size for size in _SPARE if size >= len(chosen)), len(chosen)) - len(chosen)
        # where the data do not say, an effect is absent, wherever the fit starts
        absent = np.array([False] * self.base + [name.part == "coefficients" for name in chosen], bool)
        self.anchor = numerics.where(absent, 0.0, self.values(self.reference, self.numbers))

    def _free(self, name: Name) -> bool:
        return any(kind.free(name) for kind in self.data)

    def _beside(self, imu: Imu) -> Array:
        """Return the numbers (N, m) of units."""
        leaves = [self.numerics.reshape(leaf, (self.count, -1)) for leaf in jax.tree.leaves(imu)]
        return self.numerics.concatenate(leaves, axis=1)

    def values(self, reference: Array, numbers: Array) -> Array:
        """Return the free numbers (N, p)."""
        return self.numerics.concatenate([reference[:, self.index], numbers[:, self.kept]], axis=1)

    def model(self, state: _State, lanes: IntArray) -> Imu:
        """Return units where the passes are; `state` is of `lanes`."""
        bare = unflatten(self.like, state.reference)
        if not self.numbers.shape[1]:
            return bare
        start = part_of(self.full, lanes)
        return bare.with_effects(*_with_numbers(start, state.numbers).all_effects().values())

    def known(self, state: _State, lanes: IntArray, blunt: bool | Array) -> tuple[Array, Array]:
        """Return mean (N, p) and root (N, p, p) of what is known beforehand, about where the passes are, scaled."""
        numerics, here = self.numerics, self.values(state.reference, state.numbers)
        effects = self.full.all_effects()
        width = np.full(len(self.names), TOLERANCE)
        width[self.base :] = [
            effects[name.key].plausible if name.part == "coefficients" else TOLERANCE
            for name in self.names[self.base :]
        ]
        of_base = np.arange(len(width)) < self.base
        root = numerics.diag(1 / numerics.where(of_base & numerics.asarray(blunt), _COARSE, width))
        mean = numerics.zeros_like(here) if self.follow else (self.anchor[lanes] - here) / self.sizes[lanes]
        if self.prior is not None:
            chosen = np.zeros((len(self.prior.names), len(self.names)))
            chosen[np.arange(len(chosen)), [self.names.index(name) for name in self.prior.names]] = 1.0
            stated = chosen.sum(axis=0) > 0
            sizes = self.sizes[lanes] @ chosen.T
            known = chosen.T @ (self.prior.root * sizes[:, None]) @ chosen
            root = numerics.where(stated[:, None], 0.0, root) + known
            mean = numerics.where(stated, ((self.prior.mean - here @ chosen.T) / sizes) @ chosen, mean)
        mean = numerics.pad(mean, [(0, 0), (0, self.spare)])
        count = len(self.names)
        root = numerics.broadcast_to(root, (len(mean), count, count))
        whole = numerics.pad(root, [(0, 0), (0, self.spare), (0, self.spare)])
        whole = whole + np.diag(np.arange(count + self.spare) >= count).astype(float)
        return mean, whole

    def evaluated(self, state: _State, lanes: IntArray) -> tuple[Any, ...]:
        """Evaluate the data where the passes are: conditions, covariances and columns, and the effects' numbers."""
        imu = self.model(state, lanes)
        data = self.data if self.numerics is jnp else [kind.take(lanes) for kind in self.data]
        about = [kind.about(imu) for kind in data]
        columns = self.numerics.concatenate([kind.columns for kind in about], axis=1)
        self.rows = columns.shape[1]
        covariances = tuple(kind.covariance for kind in about)
        if len(about) == 1:
            covariances = (covariances[0].shortened(),)
            columns = columns[:, : covariances[0].used.shape[1]]
        columns = columns[..., self.kept] * self.sizes[lanes][:, None, self.base :]
        columns = self.numerics.pad(columns, [(0, 0), (0, 0), (0, self.spare)])
        return tuple(kind.conditions for kind in about), covariances, columns, state.numbers

    def once(
        self, one: Callable, state: _State, lanes: IntArray, evaluated: tuple[Any, ...], blunt: bool | Array = False
    ) -> Any:
        """Run `_single_pass` or `_no_step` on data that were evaluated; `state` and they are of `lanes`."""
        conditions, covariances, columns, numbers = evaluated
        sizes = self.sizes[lanes]
        shift = (state.numbers - numbers)[:, self.kept] / sizes[:, self.base :]
        shift = self.numerics.pad(shift, [(0, 0), (0, self.spare)])
        unit = _Unit(
            conditions, covariances, columns, shift, *self.known(state, lanes, blunt), state.damping, state.excess
        )
        return _run(one, self.how, self.like, self.parameters, state.reference, sizes[:, : self.base], unit)

    def start(self, excess: Array) -> _State:
        """Return where the passes begin."""
        many, numerics = (self.count,), self.numerics
        none, far, yes = numerics.zeros(many), numerics.full(many, np.inf), numerics.ones(many, bool)
        return _State(
            self.reference,
            self.numbers,
            excess,
            excess,
            none,
            far,
            (self.reference, self.numbers),
            none + 1.0,
            numerics.zeros_like(excess),
            yes,
            ~yes,
            yes,
        )

    def advanced(self, state: _State, lanes: IntArray, out: _Pass, number: int | Array) -> tuple[_State, Array]:
        """Return where the passes go from units that all are active, and which of them keep what a pass found.

        A pass solves a problem that is linear in what the turns rotate by and in what effects add. Where its step made
        the sum of squares larger after all, it is taken back, and the next one is damped.
        """
        numerics = self.numerics
        blunt = numerics.asarray((number == 0) & self.blunted)
        worse = out.start > state.least
        fine, excess = ~worse, state.excess
        way = numerics.minimum(out.there.excess, self.most) - excess if self.how.estimated else 0.0 * excess
        # where a large component has drowned a small one for long, both count by their relative change
        drowning = number >= _DROWNED
        scale = numerics.where(drowning, 1 + excess, 1.0)
        likely = _secant(state.share, state.taken / scale, way / scale, numerics.where(drowning, _LEAP, np.inf))
        share = numerics.where(number < _SWINGING, 1.0, likely)
        better = numerics.clip(excess + share[:, None] * way, 0.0, self.most)
        change = (numerics.abs(better - excess) / (1 + excess)).max(axis=1, initial=0.0)
        length = numerics.linalg.norm(numerics.einsum("unp,up->un", out.there.jacobian, out.z), axis=1)
        sharper = numerics.sqrt(((1 + excess) / (1 + better)).max(axis=1, initial=1.0))
        creep = numerics.abs(way / scale).max(axis=1, initial=0.0)
        still = (change < _SETTLED) & (length < _STILL)
        still = still | ((number >= _CREEPING) & (creep < _CREEPS[0]) & (length < _CREEPS[1]))
        still = still & (state.damping <= _MILD) & ~blunt
        # the last pass takes no step that none after it would check
        taking = fine & (still | (number + 1 < self.max_passes))
        reference, numbers = self.moved(state, lanes, numerics.where(taking[:, None], out.z, 0.0))
        # sums of squares compare where they are weighted alike
        alike = (change < _SETTLED) & (not self.follow) & ~blunt
        damped = numerics.where(state.damping > _DAMPING / 100, state.damping / 10, 0.0)
        pick = partial(_where, numerics)
        return _State(
            pick(worse, state.before[0], reference),
            pick(worse, state.before[1], numbers),
            # a result goes with the excess that it was weighted with
            pick(worse | still | ~out.finite, excess, better),
            pick(worse, state.used, excess),
            pick(worse, numerics.maximum(100 * state.damping, _DAMPING), damped),  # ten times the last one
            pick(~worse & alike, 1.005 * out.start + 0.05, numerics.full_like(state.least, np.inf)),
            (pick(worse, state.before[0], state.reference), pick(worse, state.before[1], state.numbers)),
            pick(worse, state.share, share),
            pick(worse, state.taken, way),
            worse | (~still & out.finite),
            fine & still,
            worse | blunt | ~(_leaves(numerics, out.z, length * sharper) < _LINEAR),
        ), fine

    def moved(self, state: _State, lanes: IntArray, z: Array) -> tuple[Array, Array]:
        """Return reference and numbers after a step z (N, p) in typical sizes."""
        base, wide = self.base, len(self.names)
        step = self.sizes[lanes] * z[:, :wide]
        spread = np.zeros((base, state.reference.shape[1]))
        spread[np.arange(base), self.index] = 1.0
        reference = state.reference + step[:, :base] @ spread
        if not self.kept.any():
            return reference, state.numbers
        spread = np.zeros((wide - base, len(self.kept)))
        spread[np.arange(wide - base), np.flatnonzero(self.kept)] = 1.0
        here = _with_numbers(part_of(self.full, lanes), state.numbers)
        return reference, effect_numbers(_with_numbers(here, state.numbers + step[:, base:] @ spread))[1]

    def run(self, excess: FloatArray) -> Fit:
        """Alternate until nothing moves, a chunk of the units that still do after the other, and only those."""
        state, result, about = jax.tree.map(np.array, self.start(excess)), None, None
        for number in range(self.max_passes):
            for part, padded in self.chunks(state.active & state.moved):
                new = part_of(self.evaluated(part_of(state, padded), padded), slice(len(part)))
                about = jax.tree.map(partial(_room, self.count), new) if about is None else about
                jax.tree.map(partial(_put, part), about, new)
            for part, padded in self.chunks(state.active):
                here = part_of(state, padded)
                out = self.once(_single_pass, here, padded, part_of(about, padded), self.blunted and number == 0)
                here, out = part_of((here, out), slice(len(part)))
                after, fine = self.advanced(here, part, out, number)
                jax.tree.map(partial(_put, part), state, after)
                result = jax.tree.map(partial(_room, self.count), out) if result is None else result
                jax.tree.map(partial(_put, part[fine]), result, part_of(out, fine))
            if not state.active.any():
                break
        assert result is not None
        return self.fit(state, result.there, result.cost, result.steps, result.converged, result.finite)

    def chunks(self, chosen: BoolArray) -> Iterator[tuple[IntArray, IntArray]]:
        """Yield the units that are chosen, a chunk after the other, and the same filled up with the last of them."""
        lanes, size = np.flatnonzero(chosen), 1 if self.count == 1 else _CHUNK
        for part in np.split(lanes, range(size, len(lanes), size)):
            if len(part):
                yield part, np.concatenate([part, np.full(size - len(part), part[-1])])

    def traced(self, excess: Array) -> Fit:
        """Alternate until nothing moves, all units side by side, in a loop that JAX traces."""
        lanes, start = np.arange(self.count), self.start(excess)

        def at(x: tuple[Array, Array, Array]) -> _State:
            free, numbers, sizes = x
            changed = self.reference.at[:, self.index].set(free)
            return replace(start, reference=changed, numbers=numbers, excess=sizes, used=sizes)

        def left(x):
            """Return what a fit brings to zero: a Newton step, and the change of the excess."""
            there = self.once(_no_step, at(x), lanes, self.evaluated(at(x), lanes))
            step = jnp.einsum("upq,uq->up", there.covariance, there.gradient)[:, : len(self.names)] * self.sizes
            numbers = (x[1] - self.numbers).at[:, np.flatnonzero(self.kept)].set(step[:, self.base :])
            way = x[2] - (jnp.clip(there.excess, 0.0, self.most) if self.how.estimated else excess)
            return step[:, : self.base], numbers, way

        def passes(_, x):
            def step(loop):
                state, number, ended, about = loop
                about = jax.lax.cond(
                    (state.active & state.moved).any(),
                    lambda: jax.tree.map(partial(_where, jnp, state.moved), self.evaluated(state, lanes), about),
                    lambda: about,
                )
                out = self.once(_single_pass, state, lanes, about, (number == 0) & self.blunted)
                after, fine = self.advanced(state, lanes, out, number)
                after = jax.tree.map(partial(_where, jnp, state.active), after, state)
                after = replace(after, active=state.active & after.active)
                ended = jax.tree.map(
                    partial(_where, jnp, state.active & fine), (out.steps, out.converged, out.finite), ended
                )
                return after, number + 1, ended, about

            def on(loop):
                return loop[0].active.any() & (loop[1] < self.max_passes)

            none = jnp.zeros(self.count, int), jnp.zeros(self.count, bool), jnp.ones(self.count, bool)
            state, _, ended, _ = jax.lax.while_loop(on, step, (at(x), 0, none, self.evaluated(at(x), lanes)))
            about = jax.tree.map(lambda leaf: leaf.astype(float), (*ended, state.settled))  # as derivatives need them
            return (state.reference[:, self.index], state.numbers, state.used), about

        def undo(linear, target):
            flat, restore = ravel_pytree(target)
            matrix = jax.vmap(lambda row: ravel_pytree(linear(restore(row)))[0], out_axes=1)(jnp.eye(len(flat)))
            return restore(jnp.linalg.solve(matrix, flat))

        begin = self.reference[:, self.index], self.numbers, excess
        x, about = jax.lax.custom_root(left, begin, passes, undo, has_aux=True)
        steps, (converged, finite, settled) = about[0].astype(int), (leaf > 0 for leaf in about[1:])
        state = replace(at(x), settled=settled)
        there = self.once(_no_step, state, lanes, self.evaluated(state, lanes))
        cost = 0.5 * jnp.sum(there.residual**2, axis=-1)
        return self.fit(state, there, cost, steps, converged, finite)

    def fit(self, state: _State, there: _Evaluated, cost: Array, steps: Array, converged: Array, finite: Array) -> Fit:
        """Return the fit of units whose passes have ended."""
        size, keep = self.sizes, len(self.names)
        missing = (0, 0), (0, self.rows - there.residual.shape[1])
        covariance = there.covariance[:, :keep, :keep] * size[:, :, None] * size[:, None]
        return Fit(
            self.model(state, np.arange(self.count)),
            self.names,
            size,
            self.values(state.reference, state.numbers),
            covariance,
            there.magnitude[:, :keep] * size,
            self.numerics.pad(there.residual, missing),
            self.numerics.pad(there.jacobian[..., :keep], (*missing, (0, 0))),
            state.used,
            cost,
            steps,
            converged & state.settled,
            finite,
        )


def _secant(share: Array, before: Array, now: Array, leap: Array | float) -> Array:
    """Return the share (N,) of the change `now` (N, k) to take, after that share of the change `before`.

    Components that trade with each other swing about the answer or creep towards it: the change shrinks by a factor
    1 − share · m along the way, and 1 / m ends it. Beyond the change itself no component goes by more than `leap`.
    """
    numerics = array_module(share, now)
    length = numerics.maximum(numerics.sum(before**2, axis=1), 1e-300)
    ratio = numerics.sum(before * now, axis=1) / length
    most = numerics.maximum(numerics.abs(now).max(axis=1, initial=0.0), 1e-300)
    farthest = numerics.clip(leap / most, 1.0, _FARTHEST)
    return numerics.clip(share / numerics.maximum(1 - ratio, share / _FARTHEST), 0.25, farthest)


def _where(numerics: Any, chosen: Array, one: Array, other: Array) -> Array:
    """Return arrays unit by unit: `one` where the unit is chosen, else `other`."""
    return numerics.where(chosen.reshape(-1, *[1] * (np.ndim(one) - 1)), one, other)


def _room(count: int, leaf: FloatArray) -> FloatArray:
    """Return room for what so many units find."""
    return np.zeros((count, *leaf.shape[1:]), leaf.dtype)


def _put(lanes: IntArray, leaf: FloatArray, new: FloatArray) -> None:
    leaf[lanes] = new
