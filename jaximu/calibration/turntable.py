"""Calibration with equipment: known poses and turns, all 24 numbers of gain and bias, and nuisance effects (S8, S9)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaximu import stored
from jaximu._types import Array
from jaximu.calibration.calibration import Calibration, provenance, same_outputs
from jaximu.calibration.fit import EXCESS_NAMES, Fit, robust_excess
from jaximu.effects import CATALOGUE, Effect
from jaximu.errors import InputError, NotPossibleError
from jaximu.gravity import STANDARD, LocalGravity
from jaximu.noise.model import NoiseModel
from jaximu.observations import Stations
from jaximu.precision import require_float64
from jaximu.problem import TOLERANCE, Parameters, Problem, unflatten
from jaximu.protocols import earth_rate
from jaximu.recording import Recording
from jaximu.reference import Entry, entries_of_columns
from jaximu.residuals.turntable import station_excess, station_weights, turntable, turntable_error
from jaximu.sensor import Imu
from jaximu.solver import Failure, solve, solve_batch
from jaximu.stations import observe_stations
from jaximu.uncertainty import UNDETERMINED, station_advice, weak_directions
from jaximu.whitening import update_excess

__all__ = ["calibrate_turntable", "fit_turntable", "keep_turntable", "refuse_blind", "station_errors", "station_rms"]

_KINDS = 3  # of excess: accelerometer poses, turns, gyroscope poses


def keep_turntable(imu: Imu, free: Sequence[str] = ()) -> Callable[[str], bool]:
    """Return which numbers of a unit are free: gains, biases, and those of the effects named in `free`."""
    stems = [f"{name}.{part}" for name in imu.triads() for part in ("gain", "bias")]
    owners = {f"{name}.effects": triad.effects for name, triad in imu.triads().items()} | {"setup": imu.setup}
    stems += [f"{owner}[{place}]." for owner, effects in owners.items()
              for place, effect in enumerate(effects) if effect.name in free]  # fmt: skip
    return lambda path: path.startswith(tuple(stems))


def _residual(imu: Imu, data) -> Array:
    return turntable(imu, *data)


class _Pass(eqx.Module):
    z: Array
    excess: Array
    residual: Array
    jacobian: Array
    covariance: Array
    gravity: Array
    cost: Array
    steps: Array
    converged: Array
    finite: Array


def _single_pass(loss: str, limit: Array, like: Imu, parameters: Parameters, unit) -> _Pass:
    stations, excess = unit
    weights = station_weights(stations, excess)
    problem = Problem(like, parameters, (stations, weights), _residual, loss)
    zero = jnp.zeros(len(parameters.index))
    solution = solve(problem, zero, limit)
    if loss == "linear":
        # axis by axis W diag(u) Wᵀ, put on one diagonal
        units = jnp.einsum("aij,kaj,alj->kail", weights, station_excess(stations), weights)
        parts = tuple(jax.scipy.linalg.block_diag(*unit) for unit in units)
        better = update_excess(solution.residual, solution.jacobian, parts, excess)
    else:
        count = len(stations.turn)
        kinds = jnp.concatenate([jnp.zeros(3 * count, int), jnp.tile(jnp.where(stations.turn, 1, 2), 3)])
        better = robust_excess(problem.residuals(solution.z), kinds, tuple(range(_KINDS)), excess)
    left, values, right = jnp.linalg.svd(solution.jacobian, full_matrices=False)  # next to no noise: keep the digits
    information = values**2 + 1 / TOLERANCE**2
    covariance = (right.T / information) @ right
    # a Newton step of the data alone: the data sheet no longer pulls, and rounding does not stop it
    z = solution.z - right.T @ (values / information * (left.T @ solution.residual))

    def of_gravity(gravity):
        force = stations.stimulus.specific_force * (gravity / stations.gravity)
        return eqx.tree_at(lambda p: p.data[0].stimulus.specific_force, problem, force).objective(solution.z)[0]

    slope = jax.jvp(of_gravity, (stations.gravity,), (jnp.ones_like(stations.gravity),))[1]
    reach = -covariance @ (solution.jacobian.T @ slope)
    return _Pass(
        z, better, solution.residual, solution.jacobian, covariance, reach, solution.cost, solution.steps,
        solution.converged, solution.finite,
    )  # fmt: skip


def fit_turntable(
    start: Imu, stations: Stations, free: Sequence[str] = (), loss: str = "linear", max_passes: int = 12
) -> Fit:
    """Fit gains and biases to known poses and turns; one unit, or a batch with one leading axis on every array.

    The body frame is the fixture's, so all nine entries of each gain are free. Passes alternate the fit with the excess
    variance of accelerometer poses, turns and gyroscope poses (restricted likelihood). Each pass starts where the one
    before ended and holds to it as loosely as the first holds to the data sheet, so that in the end what the data
    determine owes nothing to the data sheet, and what they do not stays there.

    **Arguments:**

    - `start`: the unit as its data sheet has it, with the effects to be fitted (their coefficients zero, as a rule) and
      those that are known (held fixed).
    - `free`: names of the effects of `start` that are fitted.
    - `loss`: `"linear"`, `"huber"` or `"cauchy"`.

    **Returns:** a `Fit` with the same leading axes. Look at `converged` and `finite`; nothing is raised.
    """
    require_float64()
    single = np.ndim(stations.gravity) == 0
    lift = (lambda leaf: np.asarray(leaf)[None]) if single else np.asarray
    start, stations = jax.tree.map(lift, (start, stations))
    count = stations.gravity.shape[0]
    like = jax.tree.map(lambda leaf: leaf[0], start)
    parameters = Parameters.select(like, keep_turntable(like, free))
    reference = np.concatenate([np.reshape(leaf, (count, -1)) for leaf in jax.tree.leaves(start)], axis=1)
    excess = np.zeros((count, _KINDS))
    place, size = list(parameters.index), np.asarray(parameters.size)

    def batch(limit, like, parameters, units):
        lanes = None if jax.default_backend() == "cpu" else units[0].shape[0]

        def lane(item):
            reference, *unit = item
            own = eqx.tree_at(lambda p: p.reference, parameters, reference)
            return _single_pass(loss, limit, like, own, unit)

        return jax.lax.map(lane, units, batch_size=lanes)

    def run(batched, limit):
        return _Pass(*stored.call(batch, f"turntable {loss}", np.asarray(limit), like, parameters, batched))

    result: Any = None
    active = np.arange(count)
    for done in range(max_passes):
        pick = jax.tree.map(lambda leaf: leaf[active], (reference, stations, excess))  # noqa: B023
        out = solve_batch(pick, run)
        given = excess[active]
        used = eqx.tree_at(lambda o: o.excess, out, given)
        result = used if result is None else jax.tree.map(lambda leaf, new: _put(leaf, active, new), result, used)  # noqa: B023
        reference[active[:, None], place] += size * out.z
        excess[active] = out.excess
        moved = (np.abs(out.excess - given) / (1 + given)).max(axis=1) > 0.02
        active = active if done == 0 else active[moved | ~out.converged]
        if not len(active):
            break
    model = unflatten(like, reference)
    parameters = eqx.tree_at(lambda p: (p.reference, p.size), parameters, (reference, np.tile(size, (count, 1))))
    fit = Fit(
        model, parameters, result.covariance * size[:, None] * size, result.gravity * size, result.residual,
        result.jacobian, result.excess, result.cost, result.steps, result.converged, result.finite,
    )  # fmt: skip
    if single:
        return jax.tree.map(lambda leaf: leaf[0], fit)
    return eqx.tree_at(lambda f: f.parameters.size, fit, size)


def _put(leaf, lanes, new):
    leaf = np.array(leaf)
    leaf[lanes] = new
    return leaf


@dataclass(frozen=True)
class StationErrors:
    """Errors of one kind, by station: `name`, `unit`, `place` (n,) of the stations, `error` and `sigma` (3, n)."""

    name: str
    unit: str
    place: np.ndarray
    error: np.ndarray
    sigma: np.ndarray


def station_errors(imu: Imu, stations: Stations, excess: np.ndarray) -> list[StationErrors]:
    """Return the errors of each kind in SI: force and rate in poses, and the angle of turns (degrees)."""

    def compute(imu, stations, excess):
        measured = jnp.concatenate([stations.accelerometer_covariance, stations.gyroscope_covariance])
        variance = jnp.diagonal(measured, axis1=1, axis2=2) + jnp.einsum("k,kas->as", excess, station_excess(stations))
        return turntable_error(imu, stations), jnp.sqrt(variance)

    error, sigma = (np.asarray(each) for each in stored.call(compute, "station errors", imu, stations, excess))
    scale = [np.linalg.norm(np.asarray(triad.gain), axis=1)[:, None] for triad in imu.triads().values()]
    gyroscope, turn = np.asarray(stations.gyroscope_used), np.asarray(stations.turn)
    degrees = np.degrees(np.asarray(stations.stop) - np.asarray(stations.start))
    kinds = [("specific_force", "m/s^2", np.asarray(stations.accelerometer_used), slice(3), 1.0)]
    if len(scale) > 1:
        kinds += [("rate_at_rest", "rad/s", gyroscope & ~turn, slice(3, 6), 1.0),
                  ("turn_angle", "deg", gyroscope & turn, slice(3, 6), degrees)]  # fmt: skip
    found = []
    for name, unit, used, rows, factor in kinds:
        per = factor / scale[rows.start is not None]
        place = np.flatnonzero(used)
        found.append(StationErrors(name, unit, place, (error[rows] * per)[:, place], (sigma[rows] * per)[:, place]))
    return found


def station_rms(imu: Imu, stations: Stations) -> dict[str, tuple[float, str]]:
    """Return the rms of each kind of error, as vectors, with its unit."""
    return {
        each.name: (float(np.sqrt(np.mean(np.sum(each.error**2, axis=0)))), each.unit)
        for each in station_errors(imu, stations, np.zeros(_KINDS))
        if len(each.place)
    }


def refuse_blind(start: Imu, stations: Stations, free: Sequence[str]) -> None:
    """Raise `NotPossibleError` for an effect of `free` that these stations do not tell from all else that is fitted."""
    start = jax.tree.map(np.asarray, start)
    parameters = Parameters.select(start, keep_turntable(start, free))

    def slope(start, parameters, stations):
        weights = station_weights(stations, jnp.zeros(_KINDS))
        zero = jnp.zeros(len(parameters.index))
        return (jax.jacfwd(lambda z: turntable(parameters.model(start, z), stations, weights))(zero),)

    jacobian = np.asarray(stored.call(slope, "turntable slope", start, parameters, stations)[0])
    owners = {f"{name}.effects": triad.effects for name, triad in start.triads().items()} | {"setup": start.setup}
    for owner, effects in owners.items():
        for place, effect in enumerate(effects):
            own = np.array([name.startswith(f"{owner}[{place}].") for name in parameters.names])
            if effect.name not in free or not own.any():
                continue
            columns, others = jacobian[:, own], jacobian[:, ~own]
            left = columns - others @ np.linalg.lstsq(others, columns, rcond=1e-10)[0]
            least = np.linalg.svd(left, compute_uv=False)[-1]
            if least < 1e-6 * np.linalg.norm(columns):
                raise NotPossibleError(
                    f"{effect.name} cannot be told here from bias, scale and misalignment"
                    f"{' or from the other effects' if len(free) > 1 else ''}: it is seen by {effect.excited_by}."
                )
            if 1 / least > UNDETERMINED:
                raise NotPossibleError(
                    f"{effect.name} is hidden in the noise: these poses and turns tell it only to "
                    f"±{1.96 * effect.typical / least:.2g} {effect.unit} (95 %), and {effect.typical:.2g} would be "
                    f"much; longer rests and {effect.excited_by} would tell more."
                )


def calibrate_turntable(
    recordings: Recording | Sequence[Recording],
    references: Sequence[Entry] | Sequence[Sequence[Entry]] | None = None,
    gravity: LocalGravity = STANDARD,
    static: Recording | NoiseModel | None = None,
    effects: Sequence[str | Effect] = (),
    latitude: float | None = None,
    loss: str = "linear",
) -> Calibration:
    """Calibrate a unit from recordings of known poses and turns: rate table, dividing head, six positions.

    **Arguments:**

    - `recordings`: one or several recordings of the same unit.
    - `references`: what the set-up says: the entries of a schedule for each recording (a single recording's may stand
      alone); None to take them from reference columns.
    - `gravity`: local gravity; its uncertainty goes into the accelerometer's scales.
    - `static`: a recording of the unit at rest, or the `NoiseModel` fitted to one.
    - `effects`: effects to fit beside gain and bias, by name or with a start: errors of the set-up
      (`"setup.table_tilt"`), nonlinearities (`"accel.quadratic"`), `"gyro.earth_rotation"`.
    - `latitude`: degrees; the Earth's rotation is then known and held. Headings must be stated and count from where
      `attitude_of(up, 0)` stands with x east and y north.

    Raises `InputError` where the reference does not match, `NotPossibleError` where the fit does not converge, an
    effect cannot be told, or nothing is determined. What else the scheme leaves open is in `Calibration.weak`.
    """
    require_float64()
    recordings = [recordings] if isinstance(recordings, Recording) else list(recordings)
    same_outputs(recordings)
    if references is None:
        given = [entries_of_columns(recording) for recording in recordings]
    else:
        alone = len(references) > 0 and not isinstance(references[0], Sequence)
        given = [references] if alone else list(references)
    if len(given) != len(recordings):
        raise InputError(f"{len(recordings)} recordings need as many references, found {len(given)}.")
    noise = NoiseModel.fit(static) if isinstance(static, Recording) else static
    stations, said = observe_stations(recordings, given, gravity.value, noise)  # pyright: ignore[reportArgumentType]
    nominal = _nominal(recordings[0])
    chosen = [_effect(each) for each in effects]
    if latitude is not None:
        _require_headings(recordings, given)  # pyright: ignore[reportArgumentType]
        known = CATALOGUE["gyro.earth_rotation"].make(earth_rate(np.radians(latitude)))
        chosen = [*(each for each in chosen if each.name != known.name), known]
    free = tuple(each.name for each in chosen if latitude is None or each.name != "gyro.earth_rotation")
    for each in chosen:
        if "attitude" in each.needs and stations.stimulus.attitude is None:
            raise NotPossibleError(
                f"{each.name} needs to know how the unit was turned about the vertical in every pose: state headings "
                "in the reference, or all turns between the poses."
            )
    start = jax.tree.map(np.asarray, nominal.with_effects(*chosen))
    if free:
        refuse_blind(start, stations, free)
    fit = fit_turntable(start, stations, free, loss)
    where = ", ".join(recording.name for recording in recordings)
    if not bool(fit.finite):
        raise NotPossibleError(f"{where}: {Failure.NONFINITE.value}.")
    if not bool(fit.converged):
        raise NotPossibleError(f"{where}: {Failure.MAX_STEPS.value}.")
    rank, weak = weak_directions(np.asarray(fit.jacobian), fit.parameters, fit.model, station_advice)
    if rank == 0:
        raise NotPossibleError(f"{where}: {weak[0].text}")
    used = np.asarray(stations.accelerometer_used) | np.asarray(stations.gyroscope_used)
    before, after = station_rms(start, stations), station_rms(fit.model, stations)
    groups = EXCESS_NAMES if nominal.gyroscope is not None else EXCESS_NAMES[:1]
    return Calibration(
        imu=jax.tree.map(np.asarray, fit.model),
        names=fit.parameters.names,
        covariance=fit.total_covariance(gravity.sigma),
        gravity=gravity,
        method="turntable",
        loss=loss,
        rms={name: (before[name][0], value, unit) for name, (value, unit) in after.items()},
        rank=rank,
        weak=weak,
        excess=dict(zip(groups, np.asarray(fit.excess).tolist(), strict=False)),
        solver=Failure.NONE.value,
        data=provenance(recordings)
        | {"poses": int(np.sum(used & ~stations.turn)), "turns": int(np.sum(used & stations.turn))},
        notes=tuple(dict.fromkeys((
            *(note for recording in recordings for note in recording.notes),
            *(() if noise is None else noise.notes), *said,
        ))),
        fit=fit,
        stations=stations,
        nominal=nominal,
    )  # fmt: skip


def _nominal(recording: Recording) -> Imu:
    """The data sheet's unit: with a linear model any start does."""
    accelerometer, gyroscope = recording.accelerometer, recording.gyroscope
    known = accelerometer.nominal_scale, accelerometer.nominal_offset, accelerometer.unit
    if gyroscope is None:
        return Imu(Imu.nominal(*known).accelerometer, None)
    return Imu.nominal(*known, gyroscope.nominal_scale, gyroscope.nominal_offset, gyroscope.unit)


def _effect(given: str | Effect) -> Effect:
    if isinstance(given, Effect):
        return given
    if given not in CATALOGUE:
        raise InputError(f"{given!r} is no effect; see: jaximu effects.")
    return CATALOGUE[given].dormant()


def _require_headings(recordings: Sequence[Recording], references: Sequence[Sequence[Entry]]) -> None:
    for recording, entries in zip(recordings, references, strict=True):
        if recording.attitude is None and any(e.kind == "pose" and e.heading is None for e in entries):
            raise NotPossibleError(
                f"{recording.name}: to take off the Earth's rotation at a known latitude every pose must state its "
                "heading; leave the latitude out and fit gyro.earth_rotation instead."
            )
