"""By how much a unit's white noise must be multiplied for an estimator's covariance of increments to hold in motion.

Estimators (pre-integration in a factor graph, an autopilot's filter) know two things of a sensor: white noise N, and a
bias that walks with K. In motion the increments ΔR, Δv, Δp between two of their states err by more: scale and
misalignment that a calibration leaves open, vibration, sampling, time stamps. The multiplier m of N is the one for
which the normalised squared error (NEES) over its three degrees of freedom is one on average over stretches of the
motion (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, sec. 5.4):

    mean of eᵀ (m² P_N + P_K)⁻¹ e / 3 = 1

The gyroscope's is that of ΔR. The accelerometer's is that of Δv, in which the gyroscope's multiplied noise and walk
stand already; where these are more than Δv errs by, it is what its own errors ask for with the rotation known. The
errors e are either those of a measured attitude (`MeasuredErrors`), or the expectation eeᵀ from a calibration's
covariance, the noise and the recording itself (`ModelledErrors`).

Biases are states of the estimator, known at the start of a stretch: of a calibration's numbers, the mean over the
motion of what they change on each axis is taken off; of a bias that drifts, only what it departs by from the start of
the stretch counts. Bias instability B, which no such estimator knows, becomes the random walk that departs as far over
the interval the numbers are for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from jaximu.calibration import Calibration, calibrate_against_attitude
from jaximu.data.preintegration import preintegrate_samples
from jaximu.ground.array_types import BoolArray, FloatArray, IntArray
from jaximu.ground.differences import interpolated, midpoints
from jaximu.ground.distributions import rms
from jaximu.ground.document import SOFTWARE, Document, Json, entries
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import Gravity
from jaximu.ground.page import Result
from jaximu.ground.precision import require_float64
from jaximu.ground.quantities import number
from jaximu.ground.rotation import rotations_of
from jaximu.ground.stored import compiled
from jaximu.ground.tracing import on_host
from jaximu.ground.units import INERTIAL_QUANTITIES
from jaximu.ground.vectors import lengths_of, submatrix
from jaximu.model import BiasInstability
from jaximu.model.mounting import Mounting
from jaximu.model.sensor import Imu
from jaximu.navigation import noise_covariance
from jaximu.navigation.consequences import NOISE_WORDS, Run, kind_of, prepared
from jaximu.navigation.trajectory import Trajectory
from jaximu.noise.stated import SensorNoise
from jaximu.planning.information import root_of
from jaximu.recordings.attitude import Attitude
from jaximu.recordings.recording import Recording

SCHEMA = "jaximu.estimator-noise/1"
LENGTHS = (0.1, 1.0, 10.0)
"""Lengths of the stretches (s) for which multipliers are stated."""
_MOST, _FEWEST = 400, 4
"""Stretches of one length that are used at most, evenly spread, and needed at least."""
_BLOCKS = 10
"""Parts of a motion whose errors are taken as independent of each other's, unless the stretches are longer."""
_LEAP = 30.0
"""Times the median difference from the unit's acceleration beyond which a reference leaps; vibration reaches ten."""
_COLUMNS = {"gyroscope": slice(0, 3), "accelerometer": slice(3, 6)}
_ROWS = {"rotation": slice(0, 3), "velocity": slice(3, 6), "displacement": slice(6, 9)}
_OWN = {"gyroscope": _ROWS["rotation"], "accelerometer": _ROWS["velocity"]}
"""The increment whose error a triad's multiplier is for."""
_WORDS = {term: NOISE_WORDS[term] for term in "NBK"}


class Stretches(NamedTuple):
    """n stretches of S samples: rates, forces (n, S, 3), SI, each sample over `held` (n, S) s; `start` (n,) s.

    rows: (n, S), of the samples in the motion. errors: (n, 9) measured, or fewer columns where the reference lacks
    them; velocity_errors: (n, 3) of Δv with the rotation known, or None.
    """

    rates: FloatArray
    forces: FloatArray
    held: FloatArray
    start: FloatArray
    rows: IntArray
    errors: FloatArray | None = None
    velocity_errors: FloatArray | None = None


def _spread(rows: IntArray) -> IntArray:
    return rows if len(rows) <= _MOST else rows[np.linspace(0, len(rows) - 1, _MOST).astype(int)]


@dataclass(frozen=True)
class ModelledErrors:
    """Errors as a calibration's covariance, and the recorded samples, let expect them along a motion."""

    calibration: Calibration
    trajectory: Trajectory
    file: str = "the calibration"

    @property
    def rate(self) -> float:
        """Samples a second."""
        return 1 / self.trajectory.interval

    @property
    def duration(self) -> float:
        """Length of the motion, s."""
        return float(self.trajectory.intervals.sum())

    @property
    def words(self) -> str:
        """What it is."""
        return f"expected from the calibration's covariance along {self.trajectory.words}"

    @property
    def notes(self) -> tuple[str, ...]:
        """What its errors lack."""
        unrecorded = "vibration, sampling and time stamps are not in the multipliers: they need a recorded motion."
        return () if self.trajectory.recorded else (unrecorded,)

    def over(self, length: float) -> Stretches:
        """Return stretches of one length (s), one after the other."""
        stimulus = self.trajectory.stimulus
        intervals = self.trajectory.intervals
        size = max(2, round(length * self.rate))
        first = _spread(np.arange(0, len(intervals) - size + 1, size))
        rows = first[:, None] + np.arange(size)
        start = np.cumulative_sum(intervals, include_initial=True)[first]
        rates, forces = (np.asarray(samples)[rows] for samples in (stimulus.angular_rate, stimulus.specific_force))
        return Stretches(rates, forces, intervals[rows], start, rows)

    @cached_property
    def slopes(self) -> tuple[FloatArray, FloatArray, list[str], list[str]]:
        """How the corrected samples (S, 6: rate, force) react to the uncertain numbers, (S, 6, p).

        The mean over the motion is taken off, for the estimator's bias. With it the numbers' covariance (p, p), and
        for each number the kind that the budget calls it, and its owner.
        """
        run = prepared(self.calibration, self.trajectory, self.file)
        reacted = np.asarray(_reaction(run))
        return (
            reacted - np.average(reacted, axis=0, weights=self.trajectory.intervals),
            run.covariance,
            [kind_of(name, run.imu) for name in run.names],
            [name.owner for name in run.names],
        )


@compiled
def _reaction(run: Run) -> Any:
    return jax.jacfwd(lambda change: run.samples(run.changed(change)))(jnp.zeros(len(run.names)))


@dataclass(frozen=True)
class MeasuredErrors:
    """Errors of a unit's increments against a measured attitude, and its velocity and position where it has them.

    rates, forces: (S, 3) corrected samples, SI; since, until: (S,) s, between which each holds. stamp: (T,) of the
    reference on the recording's clock; rotation: (T, 4) quaternions w first from the unit's body to a frame whose z
    points up; velocity, position: (T, 3) or None. steady: (T,), whether the reference does not leap there.
    """

    rates: FloatArray
    forces: FloatArray
    since: FloatArray
    until: FloatArray
    stamp: FloatArray
    rotation: FloatArray
    velocity: FloatArray | None
    position: FloatArray | None
    gravity: float
    steady: BoolArray
    words: str
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, unit: Imu, recording: Recording, attitude: Attitude, gravity: Gravity) -> MeasuredErrors:
        """Correct a recording and put the reference on its clock and axes.

        The unit's gains and effects are kept; its biases over the recording, as an estimator finds them, and delay,
        mounting and vertical of the reference are fitted. Raises what [`jaximu.calibration.calibrate_against_attitude`]
        does.
        """
        require_float64()
        fitted, measurement = calibrate_against_attitude(recording, attitude, gravity, unit=unit)
        data = measurement.intervals
        known = measurement.attitude
        mounting = Mounting.of(fitted.imu)
        middle = (data.since + data.until) / 2
        beside = measurement.around(fitted.imu).beside_motion()
        force, rate = compiled(Imu.recover)(replace(fitted.imu, setup=()), data.force, data.rate, beside)
        tilt = scipy.spatial.transform.Rotation.from_rotvec(np.append(mounting.tilt, 0.0))
        whole = replace(known, quaternion=np.asarray(mounting.unit_attitude(known.quaternion))).rotation()
        velocity = known.velocities()
        stamp = np.asarray(mounting.on_log(known.time))
        felt = interpolated(middle, np.asarray(force), stamp)
        steady = np.ones(len(stamp), bool)
        notes = []
        if velocity is not None:
            velocity = tilt.apply(velocity)
            steady = steady_stamps(stamp, velocity, whole.apply(felt) - [0.0, 0.0, fitted.gravity.value])
        if not steady.all():
            notes.append(
                f"{attitude.name} leaps: at {int((~steady).sum())} of {len(stamp)} stamps its velocity changes as the "
                "unit cannot have moved. Stretches that begin or end there are left out."
            )
        if known.period > 2 * float(np.median(np.diff(middle))):
            notes.append(
                f"{attitude.name} is slower than the unit: between its stamps the rotation is interpolated, which the "
                "accelerometer's multiplier contains."
            )
        return cls(
            np.asarray(rate),
            np.asarray(force),
            data.since,
            data.until,
            stamp,
            whole.as_quat(scalar_first=True),
            velocity,
            None if known.position is None else tilt.apply(known.position),
            fitted.gravity.value,
            steady,
            f"measured against {attitude.name} along {recording.name}",
            tuple(notes),
        )

    @property
    def rate(self) -> float:
        """Samples a second."""
        return 1 / float(np.median(self.until - self.since))

    @property
    def duration(self) -> float:
        """Length of the motion, s."""
        return float(min(self.until[-1], self.stamp[-1]) - max(self.since[0], self.stamp[0]))

    def over(self, length: float) -> Stretches:
        """Return stretches from stamp to stamp of the reference, about `length` (s) each, without its gaps."""
        inside = np.flatnonzero((self.stamp > self.since[0]) & (self.stamp < self.until[-1]))
        period = float(np.median(np.diff(self.stamp)))
        step = max(1, round(length / period))
        first = inside[: max(0, len(inside) - step) : step]
        last = first + step
        start, stop = self.stamp[first], self.stamp[last]
        whole = (stop - start < (step + 1.5) * period) & _without_gaps(self.since, self.until, start, stop)
        kept = _spread(np.flatnonzero(whole & self.steady[first] & self.steady[last]))
        first, last, start, stop = (ends[kept] for ends in (first, last, start, stop))
        begin = self.until.searchsorted(start, "right")
        size = max(1, int((self.since.searchsorted(stop) - begin).max(initial=1)))
        places = begin[:, None] + np.arange(size)
        rows = np.minimum(places, len(self.until) - 1)
        held = np.minimum(self.until[rows], stop[:, None]) - np.maximum(self.since[rows], start[:, None])
        held = np.maximum(held, 0.0) * (places == rows)
        rates, forces = self.rates[rows], self.forces[rows]
        errors, velocity_errors = self._errors(rates, forces, held, first, last)
        return Stretches(rates, forces, held, start - self.since[0], rows, errors, velocity_errors)

    def _errors(self, rates: FloatArray, forces: FloatArray, held: FloatArray, first: Any, last: Any) -> Any:
        """Return errors (n, 3, 6 or 9) of ΔR, Δv, Δp and of Δv with the reference's rotation (n, 3), or None."""
        known = rotations_of(self.rotation)
        at_start = known[first]
        time = self.stamp[last] - self.stamp[first]
        integrated = _integrated(rates, forces, held)
        errors = [((at_start.inv() * known[last]).inv() * rotations_of(integrated[0])).as_rotvec()]
        if self.velocity is None:
            return errors[0], None
        up = np.array([0.0, 0.0, self.gravity])
        gained = at_start.inv().apply(self.velocity[last] - self.velocity[first] + up * time[:, None])
        errors.append(np.asarray(integrated[1]) - gained)
        if self.position is not None:
            away = self.position[last] - self.position[first] - self.velocity[first] * time[:, None]
            errors.append(np.asarray(integrated[2]) - at_start.inv().apply(away + up * time[:, None] ** 2 / 2))
        edges = self.stamp[first][:, None] + np.cumulative_sum(held, axis=1, include_initial=True)
        edges = edges.clip(self.stamp[0], self.stamp[-1])
        path = scipy.spatial.transform.Slerp(self.stamp, known)
        before, after = path(edges[:, :-1].ravel()), path(edges[:, 1:].ravel())
        turning = (before.inv() * after).as_rotvec().reshape(rates.shape) / np.where(held > 0, held, 1.0)[..., None]
        return np.hstack(errors), np.asarray(_integrated(turning, forces, held)[1]) - gained


def steady_stamps(stamp: FloatArray, velocity: FloatArray, acceleration: FloatArray) -> BoolArray:
    """Whether a reference's velocity (T, 3) changes at each stamp (T,) about as the unit's acceleration (T, 3) says."""
    off = lengths_of(np.diff(velocity, axis=0) / np.diff(stamp)[:, None] - midpoints(acceleration))
    leap = off > _LEAP * np.median(off)
    near = np.convolve(leap, np.ones(4), "full") > 0  # a difference of positions reaches two stamps
    return ~np.concatenate([near, [False]])[1 : len(stamp) + 1]


def _without_gaps(since: FloatArray, until: FloatArray, start: FloatArray, stop: FloatArray) -> BoolArray:
    """Whether no sample between two times holds far longer than others do."""
    lengths = until - since
    long = np.cumulative_sum(lengths > 2.5 * np.median(lengths), include_initial=True)
    return long[since.searchsorted(stop)] == long[until.searchsorted(start)]


@compiled
def _integrated(rates: Any, forces: Any, held: Any) -> Any:
    return preintegrate_samples(rates, forces, held)[:3]


@compiled
def _covariances(samples: tuple, interval: Any, flicker: Mapping[str, Any], slopes: Any, stamps: Any) -> Any:
    """Return what makes up errors of increments: white noise and walks of one on each axis, (n, 6, 9, 9), rate first.

    Then, by triad, the covariances (n, 9, 9) of `flicker`, systems; the reaction (n, 9, p) to `slopes` (n, S, 6, p) of
    the samples, and the sum of squares (n, 9, 9) of that to `stamps` (n, S, 6), both None if theirs are.
    """

    def one(part):
        samples, slope, change = part
        reaction = preintegrate_samples(*samples).reaction
        white = jnp.einsum("sij,skj->jik", reaction, reaction) / interval
        later = reaction[::-1].cumsum(axis=0)[::-1] - reaction  # a walk's step moves all samples after it
        walk = jnp.einsum("sij,skj->jik", later, later) * interval
        drift = {
            triad: noise_covariance(None, reaction[..., _COLUMNS[triad]], system)[1]
            for triad, system in flicker.items()
        }
        moved = None if slope is None else jnp.einsum("sij,sjp->ip", reaction, slope)
        pushed = None if change is None else jnp.einsum("sij,sj->si", reaction, change)
        return white, walk, drift, moved, None if pushed is None else pushed.T @ pushed

    return jax.vmap(one)((samples, slopes, stamps))


@dataclass(frozen=True)
class TriadNoise:
    """What an estimator is to be told of a triad.

    white: N (SI, continuous, root mean square of the axes) before any multiplier. walk: (L,) K with what covers B over
    each length. multiplier, low, high: (L,) of N by length, with its 95 % interval. terms: (L,) by what the error is
    made of, each by itself as a multiple of N.
    """

    white: float
    walk: FloatArray
    multiplier: FloatArray
    low: FloatArray
    high: FloatArray
    terms: dict[str, FloatArray]

    @property
    def applied(self) -> FloatArray:
        """The multipliers (L,), none below one: in motion a sensor is no quieter than at rest."""
        return np.maximum(self.multiplier, 1.0)


@dataclass(frozen=True, repr=False, eq=False)
class EstimatorNoise(Result, Document, page="estimator_noise"):
    """Multipliers of white noise by triad, and the NEES of increments with them.

    lengths: (L,) s; chosen: which of them the numbers are for. nees: by increment (L, 2), with the noise as it was
    stated and with the chosen multipliers, over three degrees of freedom. count: (L,) stretches. rate: Hz.
    integration: m²/s, see `jaximu.report.export.noise`.
    """

    lengths: FloatArray
    chosen: int
    triads: dict[str, TriadNoise]
    nees: dict[str, FloatArray]
    count: tuple[int, ...]
    rate: float
    integration: float
    words: str
    notes: tuple[str, ...] = ()

    def densities(self) -> dict[str, float]:
        """Return the continuous densities with the multipliers applied, by Kalibr's keys, and what GTSAM asks for."""
        densities = {"update_rate": self.rate, "integration_covariance": self.integration}
        for name, triad in self.triads.items():
            densities[f"{name}_noise_density"] = triad.white * float(triad.applied[self.chosen])
            densities[f"{name}_random_walk"] = float(triad.walk[self.chosen])
        return densities

    def headline(self) -> str:
        """Say by how much N is to be multiplied."""
        at = f"{self.lengths[self.chosen]:g} s"
        parts = [
            f"the {name}'s white noise by {number(triad.applied[self.chosen])} "
            f"({number(triad.low[self.chosen])} to {number(triad.high[self.chosen])})"
            for name, triad in self.triads.items()
        ]
        return f"For an estimator whose states are {at} apart, multiply {' and '.join(parts)}; {self.words}."

    def document(self) -> Json:
        """Return it as the JSON document of schema `jaximu.estimator-noise/1`; densities are SI and continuous."""
        return {
            "schema": SCHEMA,
            **entries(self, "lengths", "notes"),
            "interval": float(self.lengths[self.chosen]),
            "stretches": list(self.count),
            **{
                name: entries(triad, "multiplier", "low", "high")
                | {
                    "noise_density": triad.white,
                    "random_walk": triad.walk.tolist(),
                    "terms": [
                        {"term": term, "multiple": multiples.tolist()} for term, multiples in triad.terms.items()
                    ],
                }
                for name, triad in self.triads.items()
            },
            "nees": {
                name: {"stated": values[:, 0].tolist(), "multiplied": values[:, 1].tolist()}
                for name, values in self.nees.items()
            },
            "densities": self.densities(),
            "errors": self.words,
            "software": SOFTWARE,
        }


def estimator_noise(
    source: ModelledErrors | MeasuredErrors,
    noise: SensorNoise,
    *,
    interval: float = 1.0,
    lengths: Sequence[float] = LENGTHS,
    draws: int = 400,
    seed: int = 0,
) -> EstimatorNoise:
    """Return the multipliers of N for which the NEES of increments is one, for an estimator.

    **Arguments:** `source`: of the errors; `noise`: by triad and term (N, B, K), SI (`read_sensor_noise`), N of both
    triads; `interval`: s between two states of the estimator, such as keyframes, which the numbers are for;
    `lengths`: of the stretches, s; `draws`: units drawn from the calibration's covariance, from `seed`.

    Intervals (95 %): of modelled errors, over units calibrated alike; of measured ones, over stretches of the motion (a
    jackknife that leaves out blocks of it: Künsch, Annals of Statistics 17, 1989).

    Raises `InputError` without N, `NotPossibleError` where the motion is too short.
    """
    require_float64()
    if not (np.isfinite(interval) and interval > 0):
        raise InputError(f"{interval:g} s is no interval between two states of an estimator.")
    for triad in INERTIAL_QUANTITIES:
        if not np.any(noise.get(triad, {}).get("N", 0.0)):
            raise InputError(f"the noise file states no white noise N of the {triad}, which is what is multiplied.")
    wanted = sorted({*lengths, interval})
    kept = [length for length in wanted if source.duration >= _FEWEST * length]
    if interval not in kept:
        raise NotPossibleError(
            f"the motion lasts {source.duration:.3g} s, and {_FEWEST * interval:g} s are needed for an estimator whose "
            f"states are {interval:g} s apart: give a longer one."
        )
    notes = [f"the motion is too short for stretches of {length:g} s." for length in wanted if length not in kept]
    notes += [f"{interval * source.rate:.2g} samples lie between two states."] if interval * source.rate < 2 else []
    parts = {length: _part(source, noise, length) for length in kept}
    walks = {length: {triad: _walk(part, triad) for triad in INERTIAL_QUANTITIES} for length, part in parts.items()}
    notes += source.notes
    rng = np.random.default_rng(seed)
    chosen = kept.index(interval)
    triads = {}
    turned = np.ones(len(kept))
    for triad in _OWN:  # the gyroscope first
        rows = [
            _multiplier(parts[length], triad, walks[length], one, draws, rng)
            for length, one in zip(kept, turned, strict=True)
        ]
        if rows[chosen] is None:
            notes.append(f"the reference has neither velocity nor position: the {triad}'s noise is left as it is.")
            rows = [(1.0, 1.0, 1.0)] * len(kept)
        multiplier, low, high = np.array(rows, float).T
        terms = [_terms(parts[length], triad) for length in kept]
        triads[triad] = TriadNoise(
            rms(noise[triad]["N"]),
            np.array([walks[length][triad] for length in kept]),
            multiplier,
            low,
            high,
            {name: np.array([term_values[name] for term_values in terms]) for name in terms[0]},
        )
        turned = triads[triad].applied
    final = {triad: float(triad_noise.applied[chosen]) for triad, triad_noise in triads.items()}
    stated = dict.fromkeys(final, 1.0)
    rows = [[_nees(parts[length], multipliers, walks[interval]) for multipliers in (stated, final)] for length in kept]
    nees = {name: np.array([[increments[name] for increments in pair] for pair in rows]) for name in rows[0][0]}
    return EstimatorNoise(
        np.array(kept),
        chosen,
        triads,
        nees,
        tuple(len(parts[length].stretches.start) for length in kept),
        source.rate,
        _integration(parts[kept[0]].stretches),
        source.words,
        tuple(notes),
    )


def nees(
    source: ModelledErrors | MeasuredErrors,
    noise: SensorNoise,
    length: float,
    multipliers: Mapping[str, float],
) -> dict[str, float]:
    """Return the mean NEES of ΔR, Δv and Δp over stretches of one length, each over its three degrees of freedom.

    **Arguments:** as of [`estimator_noise`]; `length`: s, for which B becomes a walk, too; `multipliers`: of N by
    triad, such as those that another motion gave. Raises `NotPossibleError` where the motion is too short.
    """
    part = _part(source, noise, length)
    return _nees(part, multipliers, {triad: _walk(part, triad) for triad in INERTIAL_QUANTITIES})


class _Length(NamedTuple):
    """Of the stretches of one length: covariances (n, 9, 9), and what their errors are.

    noise: by triad and term N, B and K as stated by axis; "white": N alike on all axes; "1": a walk of one. moment: by
    triad the mean square (n, 3, 3) of its own part of the error, but for what `roots` (n, 3, p) in it times standard
    normal numbers add; whole and root: the same of all errors, (n, 9, 9) and (n, 9, p). terms: by triad and name, what
    its own part is made of, (n, 3, 3). block: (n,).
    """

    stretches: Stretches
    noise: dict[tuple[str, str], FloatArray]
    moment: dict[str, FloatArray | None]
    roots: dict[str, FloatArray | None]
    whole: FloatArray
    root: FloatArray | None
    terms: dict[str, dict[str, FloatArray]]
    block: IntArray


def _squared(root: FloatArray) -> FloatArray:
    """R Rᵀ (n, m, m) of roots R (n, m, p)."""
    return root @ root.mT


def _part(source: ModelledErrors | MeasuredErrors, noise: SensorNoise, length: float) -> _Length:
    stretches = source.over(length)
    if len(stretches.start) < _FEWEST:
        raise NotPossibleError(f"only {len(stretches.start)} stretches of {length:g} s without gaps are there.")
    interval = 1 / source.rate
    flicker = {
        triad: _known_at_start(BiasInstability(noise[triad]["B"]).system(interval))
        for triad in INERTIAL_QUANTITIES
        if np.any(noise[triad].get("B", 0.0))
    }
    modelled = isinstance(source, ModelledErrors)
    slopes = stamps = None
    if modelled:
        reacted, covariance, kinds, owners = source.slopes
        slopes = reacted[stretches.rows]
        jitter = source.trajectory.jitter
        stamps = _stamp_errors(stretches) * jitter if jitter else None
    samples = (stretches.rates, stretches.forces, stretches.held)
    white, walk, drift, moved, pushed = on_host(_covariances(samples, interval, flicker, slopes, stamps))
    spread = {(triad, "B"): covariance_of_drift for triad, covariance_of_drift in drift.items()}
    for triad, columns in _COLUMNS.items():
        sizes = noise[triad]
        spread[triad, "N"] = np.einsum("njik,j->nik", white[:, columns], np.square(sizes["N"]))
        spread[triad, "white"] = white[:, columns].sum(axis=1) * rms(sizes["N"]) ** 2
        spread[triad, "1"] = walk[:, columns].sum(axis=1)
        if np.any(sizes.get("K", 0.0)):
            spread[triad, "K"] = np.einsum("njik,j->nik", walk[:, columns], np.square(sizes["K"]))
    block = (stretches.start / max(length, source.duration / _BLOCKS)).astype(int)
    if not modelled:
        return _measured_part(stretches, spread, block)
    power = source.trajectory.excess_power({triad: noise[triad]["N"] for triad in INERTIAL_QUANTITIES})
    whole = 0.0 if pushed is None else pushed
    moment = {}
    roots = {}
    terms = {}
    for triad, rows in _OWN.items():
        parts = {words: spread[triad, term] for term, words in _WORDS.items() if (triad, term) in spread}
        if triad in power:
            parts["vibration and sampling"] = power[triad] * spread[triad, "white"]
        whole = whole + np.sum(list(parts.values()), axis=0)
        if pushed is not None:
            parts["time stamps"] = pushed
        moment[triad] = np.sum(list(parts.values()), axis=0)[:, rows, rows]
        mine = np.array([owner == triad for owner in owners])
        roots[triad] = (moved[..., mine] @ root_of(submatrix(covariance, mine)))[:, rows]
        for kind in dict.fromkeys(kinds):
            of_kind = mine & np.array([other == kind for other in kinds])
            if of_kind.any() and kind != f"{triad} bias":
                parts[kind] = _squared(moved[..., of_kind] @ root_of(submatrix(covariance, of_kind)))
        terms[triad] = {name: covariances[:, rows, rows] for name, covariances in parts.items()}
    return _Length(stretches, spread, moment, roots, np.asarray(whole), moved @ root_of(covariance), terms, block)


def _measured_part(stretches: Stretches, spread: dict[tuple[str, str], FloatArray], block: IntArray) -> _Length:
    errors = stretches.errors
    velocity_errors = stretches.velocity_errors
    assert errors is not None
    moments = {"gyroscope": errors[:, :3], "accelerometer": velocity_errors}
    squares = {name: None if error is None else _squared(error[..., None]) for name, error in moments.items()}
    return _Length(
        stretches,
        spread,
        squares,
        dict.fromkeys(squares),
        _squared(errors[..., None]),
        None,
        {triad: {} for triad in _OWN},
        block,
    )


def _known_at_start(system: Any) -> Any:
    """Return the process that starts from zero: the estimator's bias state holds what it was."""
    return replace(system, root=np.zeros_like(system.root))


def _stamp_errors(stretches: Stretches) -> FloatArray:
    """Return what a stamp that is late by 1 s does to each sample (n, S, 6), SI: its change from one to the next."""
    samples = np.concatenate([stretches.rates, stretches.forces], axis=-1)
    return np.diff(samples, axis=1, prepend=samples[:, :1]) / np.maximum(stretches.held, 1e-12)[..., None]


def _walk(part: _Length, triad: str) -> float:
    """Return the random walk that departs from its start as far as K and B do, over this length."""
    rows = _OWN[triad]
    one = part.noise[triad, "1"][:, rows, rows]
    drift = [part.noise[triad, term][:, rows, rows] for term in "KB" if (triad, term) in part.noise]
    return float(np.sqrt(_multiples(one, np.sum(drift, axis=0)))) if drift else 0.0


def _multiples(unit: FloatArray, moment: FloatArray) -> float:
    """Return the mean of tr(unit⁻¹ moment)/3: the square of how many times the one is the other."""
    return float(np.linalg.solve(unit, moment).trace(axis1=1, axis2=2).mean() / 3)


def _terms(part: _Length, triad: str) -> dict[str, float]:
    white = part.noise[triad, "white"][:, _OWN[triad], _OWN[triad]]
    return {name: float(np.sqrt(_multiples(white, moment))) for name, moment in part.terms[triad].items()}


def _multiplier(
    part: _Length, triad: str, walks: Mapping[str, float], turned: float, draws: int, rng: np.random.Generator
) -> tuple[float, float, float] | None:
    """Return the multiplier of N and its 95 % interval; None where nothing measures the error.

    turned: the gyroscope's multiplier, in what the accelerometer's stands beside.
    """
    rows = _OWN[triad]
    if (moment := part.moment[triad]) is None:
        return None
    white = part.noise[triad, "white"][:, rows, rows]
    known = walks[triad] ** 2 * part.noise[triad, "1"][:, rows, rows]
    candidates = [_with_interval(white, known, moment, part.roots[triad], part.block, draws, rng)]
    if triad == "accelerometer":
        beside = turned**2 * part.noise["gyroscope", "white"] + walks["gyroscope"] ** 2 * part.noise["gyroscope", "1"]
        root = None if part.root is None else part.root[:, rows]
        known += beside[:, rows, rows]
        candidates.append(_with_interval(white, known, part.whole[:, rows, rows], root, part.block, draws, rng))
    return max(candidates)


def _with_interval(
    white: FloatArray,
    known: FloatArray,
    moment: FloatArray,
    root: FloatArray | None,
    block: IntArray,
    draws: int,
    rng: np.random.Generator,
) -> tuple[float, float, float]:
    """Return m and its interval for which the NEES of an error is one, where m² white + known is assumed of it."""
    inverse = np.linalg.inv(np.linalg.cholesky(white))
    share, turn = np.linalg.eigh(inverse @ known @ inverse.mT)
    share = np.maximum(share, 0.0)
    basis = turn.mT @ inverse
    square = np.einsum("nai,nij,naj->na", basis, moment, basis, optimize=True)
    if root is None:
        value = float(np.sqrt(_solved(square, share)))
        blocks = np.unique(block)
        left = np.array([np.sqrt(_solved(square[block != omitted], share[block != omitted])) for omitted in blocks])
        left = np.log(np.maximum(left, 1e-3 * max(value, 1e-3)))
        count = len(blocks)
        sigma = float(np.sqrt((count - 1) / count * ((left - left.mean()) ** 2).sum()))
        wide = float(np.exp(min(scipy.special.stdtrit(count - 1, 0.975) * sigma, 50.0)))
        return value, value / wide, value * wide
    projected = basis @ root
    value = float(np.sqrt(_solved(square + (projected**2).sum(axis=2), share)))
    numbers = rng.standard_normal((draws, root.shape[2]))
    drawn = square + np.einsum("nap,dp->dna", projected, numbers, optimize=True) ** 2
    low, high = np.quantile(np.sqrt(_solved(drawn, share)), (0.025, 0.975))
    return value, float(low), float(high)


def _solved(square: FloatArray, share: FloatArray) -> FloatArray:
    """Return x = m² (...) for which the mean of square / (x + share), (..., n, 3), is one; zero where none is."""
    high = square.mean(axis=(-2, -1))
    low = np.zeros_like(high)
    for _ in range(60):
        middle = (low + high) / 2
        above = (square / np.maximum(middle[..., None, None] + share, 1e-300)).mean(axis=(-2, -1)) > 1
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return high


def _nees(part: _Length, multipliers: Mapping[str, float], walks: Mapping[str, float]) -> dict[str, float]:
    assumed = np.sum(
        [
            multipliers[triad] ** 2 * part.noise[triad, "white"] + walks[triad] ** 2 * part.noise[triad, "1"]
            for triad in INERTIAL_QUANTITIES
        ],
        axis=0,
    )
    whole = part.whole if part.root is None else part.whole + _squared(part.root)
    return {
        name: _multiples(assumed[:, rows, rows], whole[:, rows, rows])
        for name, rows in _ROWS.items()
        if whole.shape[1] >= rows.stop
    }


def _integration(stretches: Stretches) -> float:
    """Return h³ mean(Δf²)/144 an axis, m²/s: what holding a sample over its step costs the displacement."""
    change = np.diff(stretches.forces, axis=1)
    interval = np.where(stretches.held[:, 1:] > 0, stretches.held[:, 1:], np.nan)
    return float(np.nanmean(interval[..., None] ** 3 * change**2) / 144)
