"""Error budget: how each error of a set-up reaches each calibrated parameter, by implicit differentiation of the fit.

A specification of `jaximu simulate` names protocol, unit and noise; three tables more make it a budget. Sizes are one
standard deviation, as text with a unit or as numbers in SI; what is left out has no error.

    fitted = ["setup.table_tilt"]        # effects that the fit seeks as well, see `jaximu effects`

    [protocol]
    kind = "dividing-head"

    [environment]
    latitude = 30.5                      # the Earth turns

    [errors]
    tilt = "0.02 deg"                    # table out of level about each horizontal axis; the whole session
    angle_setting = "0.01 deg"           # of every angle that is set, anew each time
    mounting = "0.05 deg"                # unit against the table, about each axis, at every mounting
    orthogonality = "10 arcsec"          # of the axes: tilting against vertical axis, spindle against tilting axis
    gravity = "1e-4 m/s^2"               # of the value stated
    rate = "50 ppm"                      # of the angles or rates of the table, or of the logger's clock
    timing = "5 ms"                      # of the schedule against the log
    earth_rotation = "ignored"           # by the fit, the default where a latitude is stated; or "modelled"
    drift = { accelerometer = "20 ug/h", gyroscope = "2 deg/h/h" }
    temperature = { accelerometer = "0.2 mg/K", gyroscope = "0.005 deg/s/K", span = "3 K" }   # span: start to end
    vibration = { rms = "1 m/s^2", rectification = "0.01 deg/s/g^2", noise = "0.01 deg/s/sqrt(Hz)" }   # in turns

    [errors.truncated]                   # effects of the catalogue that the unit has and the fitted model has not:
    "accel.quadratic" = 1e-5             # size of each coefficient, or a list; per SI output

    [goal]                               # wanted (1 sigma): scale, misalignment, bias of a triad, or one parameter
    "accelerometer.bias" = "0.2 mg"
    "gyroscope.gain[2,2]" = "100 ppm"

How they act. A stop is where the table is set: every turn ends at a new one. `angle_setting` is that of the angle about
the vertical at each stop and, where the table sets them too, of the two others, which stay until the unit is turned
about another than the vertical axis. There, too, it is mounted anew, except on a dividing head (one mounting). Axes are
R_z(heading) R_y(−polar angle) R_z(−azimuth) of the direction that points up. The Earth's horizontal rotation has a
heading that is not known. Temperature counts from 25 °C, along the path that the environment states or by `span`. What
is constant in the noise (`bias`, `repeatability`) is the bias that is sought.

How they reach the parameters. The fit minimises |W (ȳ − model(z))|², W from the noise. Data ȳ move with an error e of
the set-up while the fit believes there is none, so dz/de = −(JᵀJ)⁻¹ Jᵀ ∂r/∂e, by differentiating the solution itself
(implicit function theorem). Independent sources add by their squares. The scatter that the errors leave in the
residuals makes the fit count up the data's variance (its excess); W is that of the excess to be expected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag

from jaximu.calibration.turntable import fit_turntable, free_on_table
from jaximu.data.station_error import turntable_error
from jaximu.data.stations import station_excess, station_weights, turntable
from jaximu.estimation.covariance import scored
from jaximu.estimation.problem import TOLERANCE, Name, Parameters, Problem, flatten, names_of
from jaximu.estimation.solver import solve
from jaximu.estimation.uncertainty import UNDETERMINED, weak_directions
from jaximu.ground import stored
from jaximu.ground.array_types import Array, BoolArray, FloatArray
from jaximu.ground.document import SOFTWARE, Document, Json, entries
from jaximu.ground.page import Result
from jaximu.ground.precision import require_float64
from jaximu.ground.vectors import column_lengths, lengths_of, root_or_zero, sigmas_of
from jaximu.model.effects import CATALOGUE
from jaximu.model.sensor import Imu, Triad
from jaximu.planning.chunks import in_chunks
from jaximu.planning.goals import goal_of, per_si, unit_of
from jaximu.planning.setup_errors import (
    ErrorScheme,
    ErrorSource,
    Task,
    scheme_and_sources,
    with_effects,
)
from jaximu.recordings.observations import Stations

SCHEMA = "jaximu.budget/1"
_OFF = 0.05  # of a total: a source whose linear share is wrong by more is said to be
_DRAWS = 32  # of each source, half of them the negatives of the others
_LOOSE = 20.0
"""The whole fit goes on from where it ended before, so that it owes nothing to the data sheet; one solve does as well
if it is held so many times less."""
_CHUNK = 64  # draws that are fitted at once


@dataclass(frozen=True)
class Need:
    """How many times smaller sources must become for a goal, together; None where they cannot reach it."""

    sources: tuple[str, ...]
    times: float | None


@dataclass(frozen=True)
class Goal:
    """A standard deviation wanted of some parameters. size: in `unit`. text: as stated. worst: the parameter farthest
    from it. needs: of each source alone, dominant first, and of the fewest dominant ones that reach it together.
    """

    name: str
    text: str
    size: float
    unit: str
    parameters: tuple[Name, ...]
    worst: Name
    reached: bool
    alone: tuple[Need, ...]
    together: Need | None

    def document(self) -> Json:
        """Return the goal as JSON has it."""
        return entries(self, "name", "unit", "reached", "worst") | {
            "goal": self.size,
            "alone": {need.sources[0]: need.times for need in self.alone},
            "together": self.together and entries(self.together, "sources", "times"),
        }


@dataclass(frozen=True)
class Trials:
    """Monte Carlo through the whole estimator. rms (p,): root mean square error of each parameter, in its unit."""

    draws: int
    rms: FloatArray
    failed: int


@dataclass(frozen=True, repr=False, eq=False)
class Budget(Result, Document, page="budget"):
    """How each of s sources reaches each of p parameters.

    names: of the parameters, `accelerometer.gain[1,0]`; units: of their standard deviations, gains being relative to
    their axis's scale. sigma (s, p): to first order. actual (s, p): by the whole nonlinear fit. determined (p,): False
    for what the scheme leaves open. open: what it leaves open or weak, in words. excess (3,): expected variance beyond
    the noise, of accelerometer poses, turns, gyroscope poses.
    """

    source: str
    protocol: str
    imu: Imu
    names: tuple[Name, ...]
    units: tuple[str, ...]
    sources: tuple[ErrorSource, ...]
    sigma: FloatArray
    actual: FloatArray
    determined: BoolArray
    excess: FloatArray
    open: tuple[str, ...]
    goals: tuple[Goal, ...]
    notes: tuple[str, ...]
    check: Trials | None = None

    @property
    def total(self) -> FloatArray:
        """Standard deviations (p,), to first order."""
        return np.sqrt(np.sum(self.sigma**2, axis=0))

    @property
    def shares(self) -> FloatArray:
        """Each source's share (s, p) of each parameter's variance, to first order."""
        return self.sigma**2 / np.maximum(np.sum(self.sigma**2, axis=0), 1e-300)

    @property
    def off(self) -> FloatArray:
        """Share (s, p) by which a parameter's total is wrong because the source's first order is."""
        total = self.total
        return root_or_zero(total**2 - self.sigma**2 + self.actual**2) / np.where(total > 0, total, 1.0) - 1

    def nonlinear(self) -> list[tuple[int, int]]:
        """Return (source, parameter) where the first order is off by more than 5 % of the total."""
        return [(int(row), int(column)) for row, column in np.argwhere((np.abs(self.off) > _OFF) & self.determined)]

    def order(self) -> list[int]:
        """Return the sources, dominant first: by their mean share of the parameters' variances."""
        return [int(row) for row in (-self.shares[:, self.determined].sum(axis=1)).argsort(kind="stable")]

    def document(self) -> Json:
        """Return the budget as the JSON document of schema `jaximu.budget/1`."""
        order, total, off = self.order(), self.total, self.nonlinear()
        parameters = []
        for index, (name, unit) in enumerate(zip(self.names, self.units, strict=True)):
            entry: Json = {"name": name, "unit": unit, "determined": bool(self.determined[index])}
            if self.determined[index]:
                ranked = sorted(order, key=lambda row: -self.sigma[row, index])
                entry |= {
                    "sigma": float(total[index]),
                    "contributions": {self.sources[row].name: float(self.sigma[row, index]) for row in ranked},
                    "nonlinear": {
                        self.sources[row].name: float(self.actual[row, index]) for row, column in off if column == index
                    },
                }
                if self.check is not None:
                    entry["monte_carlo"] = float(self.check.rms[index])
            parameters.append(entry)
        return {
            "schema": SCHEMA,
            **entries(self, "source", "protocol", "open", "notes"),
            "sources": [
                entries(self.sources[row], "name", "words", "size", "unit") | {"sigma": self.sources[row].value}
                for row in order
            ],
            "parameters": parameters,
            "goals": [goal.document() for goal in self.goals],
            "check": self.check and entries(self.check, "draws", "failed"),
            "software": SOFTWARE,
        }


# --- computing --------------------------------------------------------------------------------------------------------


def budget(task: Task, draws: int = 0, seed: int = 0) -> Budget:
    """Return the error budget of a specification.

    **Arguments:**

    - `task`: from [`read_task`].
    - `draws`: how many sessions with all errors at once are put through the whole estimator, to check the budget.
    - `seed`: of these draws.

    Raises `InputError` for a goal that is not understood, `NotPossibleError` where poses and turns are not known.
    """
    require_float64()
    scheme, sources, notes = scheme_and_sources(task)
    fitted = [CATALOGUE[name].dormant() for name in task.fitted]
    start = with_effects(scheme.unit, fitted, [np.zeros(effect.size) for effect in fitted])
    parameters = Parameters.select(start, free_on_table(start, task.fitted))
    names, per = parameters.names, np.array([per_si(name, start) for name in parameters.names])
    scale = np.asarray(parameters.size) / per  # from z to the parameters' units
    stations, moved = scheme.stations, _reaction(scheme)
    design, units = stored.call(_design, "budget design", stations, start, parameters)
    used = np.stack([stations.accelerometer_used, stations.gyroscope_used])[..., None, None]
    roots = np.concatenate([source.root for source in sources], axis=1)
    scattered = np.moveaxis((moved * used) @ roots, 2, 1).reshape(len(design), -1)
    excess, jacobian = _expected_excess(np.asarray(design), scattered, np.asarray(units), stations)
    fixed = stations, start, parameters, excess
    by_means = np.asarray(_sensitivity(*fixed)).reshape(len(names), -1)
    truth = _truth(scheme, start, names)
    slope = scale[:, None] * (by_means @ moved.reshape(by_means.shape[1], -1)) - truth
    sigma = np.stack([lengths_of(slope @ source.root) for source in sources])

    # draws and their negatives: what is odd in them then averages out of what is even
    halves = [source.draw(np.random.default_rng(0), _DRAWS // 2) for source in sources]
    errors = [np.concatenate([half, -half]) for half in halves]
    means = _recorded(scheme, np.concatenate(errors))
    solved = scale * in_chunks(lambda rows: stored.call(_lanes, "budget solutions", *fixed, rows), _CHUNK, means)
    solved -= np.concatenate(errors) @ truth.T
    actual = np.stack(
        [
            root_or_zero(linear**2 + _mean_square(whole) - _mean_square(drawn @ slope.T))
            for linear, drawn, whole in zip(sigma, errors, np.split(solved, len(errors)), strict=True)
        ]
    )
    protocol = task.case.protocol
    result = Budget(
        task.name,
        "" if protocol is None else protocol.kind,
        start,
        names,
        tuple(unit_of(name, start) for name in names),
        sources,
        sigma,
        actual,
        _determined(jacobian, scale, sigma),
        excess,
        tuple(weak.text for weak in weak_directions(jacobian, names, np.asarray(parameters.size), start)[1]),
        (),
        notes,
    )
    result = replace(result, goals=tuple(_goal(result, what, size) for what, size in task.goals))
    return replace(result, check=_check(task, result, scheme, per, truth, draws, seed)) if draws else result


def _determined(jacobian: FloatArray, scale: FloatArray, sigma: FloatArray) -> BoolArray:
    """Which parameters (p,) the scheme determines: what the data sheet's tolerance holds is as uncertain as that."""
    known = np.linalg.inv(jacobian.T @ jacobian + np.eye(len(scale)) / TOLERANCE**2)
    held = scale * lengths_of(known) / TOLERANCE
    return (sigmas_of(known) <= UNDETERMINED) & (held <= _OFF * column_lengths(sigma))


def _mean_square(values: FloatArray) -> FloatArray:
    return np.square(values).mean(axis=0)


def _residual(unit: Imu, data) -> Array:
    return turntable(unit, *data)


def _solution(start: Imu, parameters: Parameters, stations: Stations, weights, means):
    """The fit's z, from the true parameters as zero, to mean outputs (2, S, 3)."""
    observed = replace(stations, accelerometer_mean=means[0], gyroscope_mean=means[1])
    problem = Problem(start, parameters, (observed, weights), _residual, tolerance=_LOOSE * TOLERANCE)
    return solve(problem, jnp.zeros(len(parameters.index))).z


def _design(stations: Stations, start: Imu, parameters: Parameters):
    """How mean outputs, as the fit uses them, react to z (6 S, p); the units of excess."""

    def expected(z):
        return turntable_error(parameters.model(start, z), stations).ravel()

    return -jax.jacfwd(expected)(jnp.zeros(len(parameters.index))), station_excess(stations)


@jax.jit  # not stored: an implicit derivative holds a callback that says where its linear system is singular
def _sensitivity(stations: Stations, start: Imu, parameters: Parameters, excess):
    """Implicit derivative of the solution by mean outputs, backwards: there are fewer parameters than outputs."""
    weights = station_weights(stations, excess)
    means = jnp.stack([stations.accelerometer_mean, stations.gyroscope_mean])
    return jax.jacrev(lambda means: _solution(start, parameters, stations, weights, means))(means)


def _lanes(stations: Stations, start: Imu, parameters: Parameters, excess, means):
    weights = station_weights(stations, excess)
    return jax.lax.map(lambda session: _solution(start, parameters, stations, weights, session), means)


def _sessions(scheme: ErrorScheme, both):
    """Mean outputs at some errors, and their change along others: one compiled function for draws and derivatives."""
    return jax.lax.map(lambda pair: jnp.stack(jax.jvp(scheme.means, (pair[0],), (pair[1],))), both)


def _expected_excess(
    design: FloatArray, scattered: FloatArray, units: FloatArray, stations: Stations
) -> tuple[FloatArray, FloatArray]:
    """Return the excess (3,) that the estimator finds on average, and the Jacobian (6 S, p) whitened by noise alone.

    The restricted likelihood's scoring (`jaximu.estimation.covariance.scored`) with the residuals' expected
    squares: errors scatter the mean outputs by `scattered` @ standard normal draws.
    """
    measured = np.asarray(block_diag(*stations.accelerometer_covariance, *stations.gyroscope_covariance))
    units, excess = units.reshape(len(units), -1), np.zeros(len(units))

    def whitening(excess: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(measured + np.diag(excess @ units))), float)

    for _ in range(20):
        weights = whitening(excess)
        basis = np.linalg.qr(weights @ design)[0].T @ weights
        inverse = weights.T @ weights - basis.T @ basis
        gradient = units @ (((inverse @ scattered) ** 2).sum(axis=1) - np.diagonal(inverse))
        information = units @ inverse**2 @ units.T
        before = excess
        excess = np.asarray(scored(excess, gradient, information))
        if (np.abs(excess - before) <= 1e-4 * (1 + before)).all():
            break
    return excess, whitening(np.zeros(len(units))) @ design


def _check(
    task: Task, result: Budget, scheme: ErrorScheme, per: FloatArray, truth: FloatArray, draws: int, seed: int
) -> Trials:
    """Put sessions with all errors at once through `fit_turntable`, from the data sheet on."""
    rng = np.random.default_rng([seed, 1])
    errors = np.sum([source.draw(rng, draws) for source in result.sources], axis=0)
    unit = result.imu
    indices = [names_of(unit).index(name) for name in result.names]

    def sheet(triad: Triad) -> Triad:
        return replace(triad, gain=np.diag(triad.scales), bias=np.zeros(3))

    def many(leaf):
        return np.broadcast_to(np.asarray(leaf), (_CHUNK, *np.shape(leaf)))

    def fitted(means: FloatArray) -> FloatArray:
        """Errors of the parameters, and whether the fit went well, (n, p + 1)."""
        sessions = eqx.tree_at(
            lambda stations: (stations.accelerometer_mean, stations.gyroscope_mean),
            jax.tree.map(many, scheme.stations),
            (means[:, 0], means[:, 1]),
        )
        fit = fit_turntable(jax.tree.map(many, start), sessions, task.fitted)
        off = (np.asarray(fit.values) - flatten(unit)[indices]) / per
        return np.column_stack([off, np.asarray(fit.converged & fit.finite, float)])

    start = Imu(sheet(unit.accelerometer), None if unit.gyroscope is None else sheet(unit.gyroscope), unit.setup)
    *off, good = in_chunks(fitted, _CHUNK, _recorded(scheme, errors)).T
    fine = good > 0
    return Trials(draws, np.sqrt(_mean_square((np.stack(off, axis=1) - errors @ truth.T)[fine])), int(np.sum(~fine)))


def _truth(scheme: ErrorScheme, unit: Imu, names: Sequence[Name]) -> FloatArray:
    """How the true values of the parameters (p) depend on the errors (n): an effect that is fitted is to follow."""
    truth = np.zeros((len(names), sum(scheme.sizes)))
    first = sum(scheme.sizes[:2])
    for effect in scheme.effects:
        same = [key for key, fitted in unit.all_effects().items() if fitted.name == effect.name]
        for row, name in enumerate(names):
            if name.part == "coefficients" and name.key in same:
                truth[row, first + name.axes[0]] = 1.0
        first += effect.size
    return truth


def _recorded(scheme: ErrorScheme, errors: FloatArray) -> FloatArray:
    small = scheme.simulated
    wrong = errors[:, :small]
    return _simulated(scheme, np.stack([wrong, np.zeros_like(wrong)], axis=1))[:, 0] + _added(errors[:, small:])


def _reaction(scheme: ErrorScheme) -> FloatArray:
    """Return the derivatives (2, S, 3, n) of the mean outputs by all errors, where there are none."""
    single = np.eye(scheme.simulated)
    changes = _simulated(scheme, np.stack([np.zeros_like(single), single], axis=1))[:, 1]
    return np.moveaxis(np.concatenate([changes, _added(np.eye(scheme.sizes[3]))]), 0, -1)


def _simulated(scheme: ErrorScheme, both: FloatArray) -> FloatArray:
    return in_chunks(lambda rows: stored.call(_sessions, "budget sessions", scheme, rows), _CHUNK, both)


def _added(errors: FloatArray) -> FloatArray:
    """Bring what is added to mean outputs (N, 6 S) into their shape (N, 2, S, 3)."""
    return np.moveaxis(errors.reshape(len(errors), 2, 3, -1), 2, 3)


# --- parameters and goals ---------------------------------------------------------------------------------------------


def _goal(result: Budget, what: str, text: str) -> Goal:
    indices, size = goal_of(what, text, result.names, result.imu, f"{result.source}: ")
    unit = result.units[indices[0]]
    total = np.where(result.determined, result.total, np.inf)[indices]
    worst = indices[int(total.argmax())]
    names = tuple(result.names[index] for index in indices)
    reached = bool(total.max() <= size)
    alone = ()
    together = None
    if not reached and np.isfinite(total).all():
        ranked = sorted(range(len(result.sources)), key=lambda row: -result.sigma[row, worst])
        ranked = [row for row in ranked if np.any(result.sigma[row, indices] > 1e-3 * size)]
        alone = tuple(_need(result, (row,), indices, size) for row in ranked)
        several = (_need(result, tuple(ranked[: count + 1]), indices, size) for count in range(1, len(ranked)))
        if all(need.times is None for need in alone):
            together = next((need for need in several if need.times is not None), None)
    return Goal(what, text, size, unit, names, result.names[worst], reached, alone, together)


def _need(result: Budget, rows: tuple[int, ...], indices: Sequence[int], goal: float) -> Need:
    """How many times smaller these sources must become, all by the same factor, for every parameter to reach a goal."""
    names = tuple(result.sources[row].name for row in rows)
    mine = np.sum(result.sigma[list(rows)][:, indices] ** 2, axis=0)
    left = goal**2 - (result.total[indices] ** 2 - mine)
    if (left <= 0).any():
        return Need(names, None)
    return Need(names, max(1.0, float(np.sqrt((mine / left).max()))))
