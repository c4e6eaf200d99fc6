"""What the errors that a calibration leaves do to position, velocity and attitude along a path.

The unit in hand is taken to be as calibrated; what is not known of it is the calibration's covariance, and the noise of
its sensors. The derivative of the mechanised path by every number of the unit (forward mode) and the error model's
transition (`jaximu.navigation`) carry both to the end: a budget by term and time, to first order. Draws of all errors
at once through the whole mechanisation stand beside it.

Position, velocity and attitude at the start are taken as known exactly. The calibration's errors stay the same along
the path; of bias that changes at a power-on it knows nothing, but for a repeatability in the noise file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaximu.calibration import Calibration
from jaximu.data.preintegration import increments
from jaximu.estimation.problem import Name, names_of
from jaximu.ground.array_types import BoolArray, FloatArray
from jaximu.ground.distributions import rms
from jaximu.ground.document import SOFTWARE, Document, Json, entries
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.page import Result
from jaximu.ground.precision import require_float64
from jaximu.ground.quantities import listed
from jaximu.ground.stored import compiled
from jaximu.ground.tracing import on_host
from jaximu.ground.units import INERTIAL_QUANTITIES
from jaximu.ground.vectors import lengths_of, submatrix
from jaximu.model import BiasRepeatability, Noise, Process
from jaximu.model.data_sheet import TERM_NAMES
from jaximu.model.processes import TERM_PROCESSES
from jaximu.model.sensor import Imu, Triad
from jaximu.model.stimulus import Stimulus
from jaximu.navigation import Navigation, deviation, linearised, mechanise, noise_covariance
from jaximu.navigation.trajectory import Trajectory
from jaximu.noise.stated import SensorNoise
from jaximu.planning.goals import group_of
from jaximu.planning.information import root_of

SCHEMA = "jaximu.consequences/1"
_PROCESSES: Mapping[str, Callable[[FloatArray], Process]] = TERM_PROCESSES | {"repeatability": BiasRepeatability}
NOISE_WORDS = {term: f"{TERM_NAMES[term]} {term}" for term in "NBK"} | {"repeatability": "bias repeatability"}
"""The terms of a noise file that navigation feels, in English."""
_TOGETHER = 25
"""Draws that are mechanised side by side; more do not fit into the caches."""


def kind_of(name: Name, model: Imu) -> str:
    """Return what a term of the budget calls a number of the unit: "accelerometer scale", or an effect's name."""
    if name.effect is not None:
        return model.all_effects()[name.key].english
    return group_of(name).replace(".", " ")


def _simplified(imu: Imu) -> dict[str, Imu]:
    """Return the unit without its misalignment, and without each of its effects, by what was left out."""
    simplified = {}
    for owner in INERTIAL_QUANTITIES:
        triad: Triad = getattr(imu, owner)
        straight = replace(triad, gain=np.diag(np.diagonal(triad.gain)))
        if not np.array_equal(straight.gain, triad.gain):
            simplified[f"{owner} misalignment"] = replace(imu, **{owner: straight})
        for index, effect in enumerate(triad.effects):
            absent = replace(effect, coefficients=np.zeros(effect.size))  # of the same structure: compiled already
            left = (*triad.effects[:index], absent, *triad.effects[index + 1 :])
            simplified[effect.english] = replace(imu, **{owner: replace(triad, effects=left)})
    return simplified


@dataclass(frozen=True)
class MonteCarlo:
    """Draws of all errors at once through the whole mechanisation: errors (draws, T, 9), as `deviation` has them."""

    errors: FloatArray
    seed: int

    @property
    def sigma(self) -> FloatArray:
        """Root mean square (T, 9) over the draws."""
        return rms(self.errors, axis=0)


@dataclass(frozen=True, repr=False, eq=False)
class Consequences(Result, Document, page="consequences"):
    """The errors (1σ) of navigation along a path.

    times: (T,) s. terms: by name the variances (T, 9) of each kind of calibrated number by itself and of each noise,
    of position (m²), velocity and attitude (rad²), east, north, up of each. calibration: (T, 9), of all calibrated
    numbers with their correlations. known: by kind, the calibration's variances (T, 9) were that kind known exactly.
    left_out: by what is left out of the model, the error of position (T,), m, that this alone makes. check: draws, or
    None. against: the same of another calibration of the unit, and `apart` (T, 9) what it takes the path for, less what
    this one does.
    """

    calibration_file: str
    trajectory: Trajectory
    reference: Navigation
    times: FloatArray
    terms: dict[str, FloatArray]
    calibration: FloatArray
    known: dict[str, FloatArray]
    left_out: dict[str, FloatArray]
    check: MonteCarlo | None = None
    against: Consequences | None = None
    apart: FloatArray | None = None
    notes: tuple[str, ...] = ()

    @property
    def noise(self) -> FloatArray:
        """Variances (T, 9) of all noise."""
        parts = [variances for name, variances in self.terms.items() if name not in self.known]
        return np.sum(parts, axis=0) if parts else np.zeros_like(self.calibration)

    @property
    def total(self) -> FloatArray:
        """Variances (T, 9) of everything."""
        return self.calibration + self.noise

    def dominant(self) -> list[tuple[str, float, float]]:
        """Return which term's position error is the largest, from when to when (s)."""
        names = list(self.terms)
        first = np.argmax([position(self.terms[name]) for name in names], axis=0)
        spans = []
        for time, index in zip(self.times, first, strict=True):
            start = spans.pop()[1] if spans and spans[-1][0] == names[index] else (spans[-1][2] if spans else 0.0)
            spans.append((names[index], start, float(time)))
        return spans

    def document(self) -> Json:
        """Return the budget as the JSON document of schema `jaximu.consequences/1`; all figures are 1σ."""

        def track(values: FloatArray, part: int) -> list[list[float]]:
            return values[:, 3 * part : 3 * part + 3].tolist()

        def tracks(sigma: FloatArray) -> Json:
            names = ("position_sigma", "velocity_sigma", "attitude_sigma")
            return {name: track(sigma, part) for part, name in enumerate(names)}

        def listed(errors: Mapping[str, FloatArray]) -> list[Json]:
            return [{"term": name, "position": values.tolist()} for name, values in errors.items()]

        check = self.check
        against = self.against
        known = self.known | {"the whole calibration": np.zeros_like(self.noise)}
        return {
            "schema": SCHEMA,
            **entries(self, "times", "calibration_file", "notes"),
            **tracks(np.sqrt(self.total)),
            "budget": listed({name: position(variances) for name, variances in self.terms.items()}),
            "calibration": {"position": position(self.calibration).tolist()},
            "dominant": [{"term": name, "start": start, "stop": stop} for name, start, stop in self.dominant()],
            "if_known_exactly": listed({name: position(variances + self.noise) for name, variances in known.items()}),
            "left_out": listed(self.left_out),
            "monte_carlo": check and {"draws": len(check.errors), "seed": check.seed, **tracks(check.sigma)},
            "against": None
            if against is None or self.apart is None
            else {
                "file": against.calibration_file,
                "position_sigma": track(np.sqrt(against.total), 0),
                "position_apart": track(self.apart, 0),
            },
            "path": self.trajectory.words,
            "software": SOFTWARE,
        }


def position(variances: FloatArray) -> FloatArray:
    """Return the error of position in space (T,), m, from variances (T, 9)."""
    return np.sqrt(variances[:, :3].sum(axis=1))


class Run(eqx.Module):
    """A unit along a path: its noise-free output, and the numbers its calibration is uncertain of, with covariance.

    beside: what a model that corrects the output knows along the path: temperature and the like, not the true force.
    places: of the uncertain numbers among all of the unit's.
    """

    imu: Imu
    start: Navigation
    beside: Stimulus
    intervals: Any
    output: tuple[Any, Any]
    covariance: Any
    places: Any
    names: tuple[Name, ...] = eqx.field(static=True)
    every: int = eqx.field(static=True)

    def samples(self, imu: Imu) -> Any:
        """Return the samples (S, 6: rate, force), SI, as this model of the unit corrects them."""
        force, rate = imu.recover(*self.output, self.beside)
        assert rate is not None
        return jnp.hstack([rate, force])

    def changed(self, change: Any) -> Imu:
        """Return the unit with its uncertain numbers changed by so much (p,)."""
        numbers, restore = ravel_pytree(self.imu)
        return restore(numbers.at[self.places].add(change))

    def corrected_by(self, imu: Imu, noise: Any = 0.0) -> Navigation:
        """Return where this model of the unit takes it to be; noise (S, 6): of rate and force, SI."""
        vectors = increments(*jnp.hsplit(self.samples(imu) + noise, 2), intervals=self.intervals)
        return mechanise(self.start, *vectors, self.intervals, self.every)

    def error(self, reference: Navigation, change: Any, noise: Any = 0.0) -> Any:
        """Return the deviation (T, 9) where the uncertain numbers are changed by so much (p,)."""
        return deviation(self.corrected_by(self.changed(change), noise), reference)


_corrected = compiled(Run.corrected_by)
_deviation = compiled(deviation)


@compiled
def _slopes(run: Run, reference: Navigation) -> Any:
    """Return the derivatives (T, 9, p) of the path by the uncertain numbers."""
    return jax.jacfwd(lambda change: run.error(reference, change))(jnp.zeros(len(run.names)))


@compiled
def _errors(run: Run, reference: Navigation, changes: Any, noise: Any) -> Any:
    """Return the deviations (n, T, 9) of draws, by changes (n, p) and noise (n, S, 6)."""
    return jax.vmap(run.error, (None, 0, 0))(reference, changes, noise)


def consequences(
    calibration: Calibration,
    trajectory: Trajectory,
    noise: SensorNoise | None = None,
    *,
    draws: int = 100,
    seed: int = 0,
    against: Calibration | None = None,
    files: tuple[str, str] = ("the calibration", "the other calibration"),
) -> Consequences:
    """Return what the errors left by a calibration, and noise, do along a path.

    **Arguments:** `noise`: by triad and term, SI (`read_sensor_noise`); `draws`: through the whole mechanisation (0:
    none), from `seed`; `against`: another calibration of the same unit; `files`: what the two are called.

    Raises `NotPossibleError` for a calibration without gyroscope or without covariance, `InputError` where the other
    calibration is in other units.
    """
    require_float64()
    run = prepared(calibration, trajectory, files[0])
    if (second := None if against is None else prepared(against, trajectory, files[1])) is not None:
        for name, triad in run.imu.triads().items():
            if triad.output_unit != second.imu.triad(name).output_unit:
                raise InputError(f"{files[1]} gives the {name} in other units than {files[0]}: not of the same unit.")
    reference = _corrected(run, run.imu)
    slopes = np.asarray(_slopes(run, reference))
    kinds = [kind_of(name, run.imu) for name in run.names]
    terms, known = {}, {}
    for kind in dict.fromkeys(kinds):
        chosen = np.array([other == kind for other in kinds])
        terms[kind] = _variances(slopes[..., chosen], submatrix(run.covariance, chosen))
        known[kind] = _variances(slopes[..., ~chosen], _given(run.covariance, chosen))
    whole = _variances(slopes, run.covariance)
    notes = *trajectory.notes, *_notes(calibration, noise)
    terms |= _noise_terms(trajectory, noise or {})
    left_out = {
        name: lengths_of(np.asarray(_deviation(_corrected(run, model), reference))[:, :3])
        for name, model in _simplified(run.imu).items()
    }
    check = _draw(run, trajectory, reference, noise or {}, draws, seed) if draws else None
    apart = None if second is None else np.asarray(_deviation(_corrected(run, second.imu), reference))
    compared = (
        None if against is None else consequences(against, trajectory, noise, draws=0, files=(files[1], files[0]))
    )
    return Consequences(
        files[0],
        trajectory,
        on_host(reference),
        trajectory.times,
        terms,
        whole,
        known,
        left_out,
        check,
        compared,
        apart,
        notes,
    )


def prepared(calibration: Calibration, trajectory: Trajectory, file: str) -> Run:
    """Return the calibrated unit, without what is of a session, along a path.

    Raises `NotPossibleError` for a calibration without gyroscope or without covariance; `file` names it.
    """
    for name in INERTIAL_QUANTITIES:
        if name not in calibration.triads():
            raise NotPossibleError(f"{file} has no {name}: navigation needs both sensors calibrated.")
    calibration = calibration.inertial()
    imu = calibration.imu.transferable()
    everything = names_of(imu)
    known = {_identity(name, imu): index for index, name in enumerate(everything)}
    rows = [row for row, name in enumerate(calibration.names) if _identity(name, calibration.imu) in known]
    indices = np.array([known[_identity(calibration.names[row], calibration.imu)] for row in rows], int)
    covariance = submatrix(calibration.covariance, rows)
    if not rows or not covariance.diagonal().any():
        raise NotPossibleError(
            f"{file} states no covariance, so what it leaves open is not known: calibrate the log again with "
            "`jaximu calibrate LOG -o DIR`."
        )
    imu = on_host(imu)
    stimulus = trajectory.stimulus
    return Run(
        imu,
        trajectory.start,
        stimulus.beside_motion(),
        trajectory.intervals,
        compiled(Imu.respond)(imu, stimulus),
        covariance,
        indices,
        tuple(everything[index] for index in indices),
        trajectory.every,
    )


def _identity(name: Name, model: Imu) -> tuple:
    effect = None if name.effect is None else model.all_effects()[name.key].name
    return name.owner, effect, name.part, name.axes


def _notes(calibration: Calibration, noise: SensorNoise | None) -> list[str]:
    notes = []
    if not noise:
        notes.append("no noise is in the budget: give --noise allan.json, which `jaximu allan LOG -o DIR` writes.")
    if calibration.from_data_sheet:
        notes.append(
            f"the calibration has the {listed(calibration.from_data_sheet)} of a data sheet, whose errors are not in "
            "the budget: calibrate from poses and turns (`jaximu calibrate`)."
        )
    effects = calibration.imu.transferable().all_effects().values()
    if not any("temperature" in effect.needs for effect in effects):
        notes.append("temperature is not in the budget: the calibration has no effect of it (see `jaximu thermal`).")
    if calibration.open_numbers:
        notes.append("the calibration leaves directions undetermined, and what they do is far from first order.")
    return notes


def _variances(slopes: FloatArray, covariance: FloatArray) -> FloatArray:
    """Variances (T, 9) of slopes (T, 9, p) and a covariance (p, p)."""
    return np.maximum(np.einsum("tip,pq,tiq->ti", slopes, covariance, slopes, optimize=True), 0.0)


def _given(covariance: FloatArray, chosen: BoolArray) -> FloatArray:
    """Covariance of the others were these known exactly (normal distribution, conditioned)."""
    cross = covariance[np.ix_(~chosen, chosen)]
    return (
        submatrix(covariance, ~chosen) - cross @ np.linalg.pinv(submatrix(covariance, chosen), hermitian=True) @ cross.T
    )


def _noise_terms(path: Trajectory, noise: SensorNoise) -> dict[str, FloatArray]:
    wanted = [(triad, term) for triad in INERTIAL_QUANTITIES for term in NOISE_WORDS if term in noise.get(triad, {})]
    if not wanted:
        return {}
    stimulus = path.stimulus
    vectors = increments(*map(jnp.asarray, (stimulus.angular_rate, stimulus.specific_force, path.intervals)))
    transition, reaction = compiled(linearised)(path.start, *vectors, jnp.asarray(path.intervals))
    terms = {}
    interval = path.interval
    propagate = compiled(noise_covariance)
    for triad, term in wanted:
        columns = reaction[..., :3] if triad == "gyroscope" else reaction[..., 3:]
        system = _PROCESSES[term](noise[triad][term]).system(interval)
        terms[f"{triad} {NOISE_WORDS[term]}"] = np.asarray(propagate(transition, columns, system)[0])[
            path.every - 1 :: path.every
        ]
    return terms


def _draw(run: Run, path: Trajectory, reference: Navigation, noise: SensorNoise, draws: int, seed: int) -> MonteCarlo:
    rng = np.random.default_rng(seed)
    root = root_of(run.covariance)
    streams = [
        Noise(
            tuple(_PROCESSES[term](figure) for term, figure in noise.get(triad, {}).items() if term in NOISE_WORDS),
            INERTIAL_QUANTITIES[triad],
        )
        for triad in ("gyroscope", "accelerometer")
    ]
    errors = []
    for first in range(0, draws, _TOGETHER):
        changes = rng.standard_normal((_TOGETHER, len(root))) @ root.T
        parts = [
            stream.sample(len(path.intervals), 1 / path.interval, (seed, first), shape=(_TOGETHER,))
            for stream in streams
        ]
        errors.append(np.asarray(_errors(run, reference, changes, np.concatenate(parts, axis=-1))))
    return MonteCarlo(np.concatenate(errors)[:draws], seed)
