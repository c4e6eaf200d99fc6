"""Several units on one rigid body: how each is turned and placed, how late its clock is, what averaging them gains.

Each unit is calibrated by hand from its own poses and turns. Then the first unit's corrected motion is what a set-up
says to every other: a known motion, as a rate table's (`KnownStations`), with the rotation between the units, the lever
arm and the delay as effects of the set-up. Both units' calibrations are known as well as their covariances say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import scipy
from scipy.spatial.transform import Rotation

from jaximu.calibration.array_units import Array, ArrayUnit, Averaged
from jaximu.calibration.attitude import delays_of_speeds, fitted_mounting, later_zero
from jaximu.calibration.calibration import Calibration
from jaximu.calibration.compensation import compensate
from jaximu.calibration.recipe import calibrate
from jaximu.calibration.refusals import require_solved
from jaximu.data.shared_motion import shared_stations
from jaximu.data.stations import KnownStations, station_errors
from jaximu.estimation.fitting import Fit, Prior, fit
from jaximu.estimation.problem import Loss, flatten, names_of, typical_sizes
from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import rms
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import STANDARD, LocalGravity
from jaximu.ground.precision import require_float64
from jaximu.ground.rotation import IDENTITY, right_jacobian, rotations_of
from jaximu.ground.tracing import on_host
from jaximu.ground.vectors import lengths_of, means_by_group, root_or_zero, sigmas_of
from jaximu.mistakes import prepare
from jaximu.model.mounting import Mounting
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.recordings.alignment import turning_best
from jaximu.recordings.observations import Stations
from jaximu.recordings.recording import Reading, Recording
from jaximu.recordings.reference import means_over
from jaximu.recordings.segmentation import rest_statistics

_WINDOWS = 128
"""Intervals of motion in which two units are compared."""
_LENGTH = 8
"""Samples of the slower unit in such an interval: short beside a quick turn, long beside a sample's noise."""
_NEAR = 3
"""Samples from a window within which all units must have measured: what is interpolated there reaches into it."""
_SLOW = np.radians(3.0)
"""rad/s; below, an interval tells little of how units are turned and placed."""
_FEWEST = 32
"""Intervals of motion."""
_ALIKE = 0.5
"""Share of a unit's rotation that the first must explain."""
_LITTLE = 1e-6
"""Standard deviation, in typical sizes, below which no number is known: keeps a covariance regular."""
_BLOCK = 0.25  # s, of the means whose scatter at rest is the noise


def calibrate_array(
    recordings: Sequence[Recording],
    gravity: LocalGravity = STANDARD,
    *,
    static: Recording | NoiseModel | None = None,
    loss: Loss = "linear",
    repair: bool = False,
) -> Array:
    """Calibrate units that are fixed to one body and were recorded together, each with its own file and clock.

    **Arguments:** `recordings`: two or more, accelerometer and gyroscope, with poses at rest and turns as for
    [`jaximu.calibrate`][]; quick turns tell lever arms. `gravity`, `static`, `loss`, `repair` as there.

    Raises `InputError` for a single recording or one without a gyroscope, `NotPossibleError` where a unit cannot be
    calibrated, or does not move as the first does.
    """
    require_float64()
    if len(recordings) < 2:
        raise InputError("an array has two units or more: give a recording of each, made at the same time.")
    taken = [
        (source.sha256, reading.device, reading.columns)
        for recording in recordings
        for source in recording.sources
        if (reading := recording.reading or Reading())
    ]
    if len(set(taken)) < len(taken):
        raise InputError(
            "the same file is given twice: an array needs a recording of each unit. Where one file holds several, "
            'choose their rows with --device ID,ID or their columns with --columns "…;…".'
        )
    for recording in recordings:
        if recording.gyroscope is None:
            raise InputError(f"{recording.name} has no gyroscope, by which units on one body are matched.")
    calibrations = [calibrate(recording, gravity, static=static, loss=loss, repair=repair) for recording in recordings]
    ready = [prepare(recording, repair) for recording in recordings]
    recordings = [prepared.recording for prepared in ready]
    corrected = list(map(compensate, calibrations, recordings))
    delays = [0.0, *(_coarse_delay(recording, corrected[0]) for recording in corrected[1:])]
    unseen = [
        stamps + delay for prepared, delay in zip(ready, delays, strict=True) for stamps in prepared.left_out.values()
    ]
    shared = _Shared.of(corrected, delays, calibrations[0], np.sort(np.concatenate([np.zeros(0), *unseen])))
    pairs = [
        _pair(shared, calibrations[0], *unit, gravity, loss)
        for unit in zip(recordings[1:], calibrations[1:], corrected[1:], delays[1:], strict=True)
    ]
    scatter = _scatter([errors for _, errors in pairs])
    none = np.zeros(3)
    itself = ArrayUnit(recordings[0].name, calibrations[0], IDENTITY, none, none, none, 0.0, 0.0, 0.0, (0.0, 0.0))
    bare = itself, *(unit for unit, _ in pairs)
    units = tuple(
        replace(unit, rate_scatter=rate, force_scatter=force) for unit, (rate, force) in zip(bare, scatter, strict=True)
    )
    notes = tuple(f"{unit.name}: {note}" for unit in units for note in unit.calibration.notes)
    return Array(units, _averaged(shared, corrected, units), gravity, notes)


# --- what the units have in common ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Shared:
    """The first unit's corrected recording, its rests (P, 2) and short intervals of motion (S, 2), on its own clock."""

    first: Recording
    rests: FloatArray
    moving: FloatArray

    @classmethod
    def of(
        cls, corrected: Sequence[Recording], delays: Sequence[float], calibration: Calibration, unseen: FloatArray
    ) -> _Shared:
        """Choose rests and motion that all units saw; half of the motion is the quickest there is.

        unseen: stamps on the first's clock at which some unit did not measure: a gyroscope at the end of its range
        reads too little, and arms would come out too long.
        """
        first = corrected[0]
        gyroscopes = [recording.signals["gyroscope"] for recording in corrected]
        slowest = min(signal.rate for signal in gyroscopes)
        length = _LENGTH / slowest
        spans = np.array([signal.time[[0, -1]] + delay for signal, delay in zip(gyroscopes, delays, strict=True)])
        begin, end = spans[:, 0].max() + 2 * length, spans[:, 1].min() - 2 * length
        rests = calibration.segmentations[0].intervals
        rests = rests[(rests[:, 0] > begin) & (rests[:, 1] < end)]
        start = np.arange(begin, end - length, length)
        still = ((start[:, None] < rests[:, 1]) & (start[:, None] + length > rests[:, 0])).any(axis=1)
        near = _NEAR / slowest
        measured = unseen.searchsorted(start - near) == unseen.searchsorted(start + length + near)
        start = start[~still & measured]
        windows = np.column_stack([start, start + length])
        speed = lengths_of(means_over(gyroscopes[0], windows))
        windows, speed = windows[speed > _SLOW], speed[speed > _SLOW]
        if len(windows) < _FEWEST or len(rests) < 3:
            raise NotPossibleError(
                f"{first.name}: the units were at rest {len(rests)} times and turned together for "
                f"{len(windows) * length:.2g} s while all were recorded; an array needs three rests and ten seconds of "
                "turns, quick ones about all axes."
            )
        order = (-speed).argsort()
        quick, others = order[: _WINDOWS // 2], np.sort(order[_WINDOWS // 2 :])
        evenly = others[:: max(1, -(-len(others) // (_WINDOWS // 2)))]
        return cls(first, rests, windows[np.sort(np.concatenate([quick, evenly]))])

    def means(self, recording: Recording, delay: float) -> tuple[FloatArray, FloatArray]:
        """Return a unit's mean forces at rest (P, 3) and mean rates in motion (S, 3)."""
        gyroscope = recording.signals["gyroscope"]
        return means_over(recording.accelerometer, self.rests - delay), means_over(gyroscope, self.moving - delay)


def _coarse_delay(recording: Recording, first: Recording) -> float:
    """Return by how much (s) the first's stamps are late, to a sample."""
    gyroscope, later = first.signals["gyroscope"], later_zero(first.start, recording.start)
    speed = lengths_of(gyroscope.values)
    delays = delays_of_speeds(recording.signals["gyroscope"], gyroscope.time + later, speed, 1 / gyroscope.rate)
    return delays[0] - later


# --- one unit beside the first ----------------------------------------------------------------------------------------


def _pair(
    shared: _Shared,
    known: Calibration,
    recording: Recording,
    calibration: Calibration,
    corrected: Recording,
    delay: float,
    gravity: LocalGravity,
    loss: Loss,
) -> tuple[ArrayUnit, FloatArray]:
    """Return a unit of the array, and its errors (S, 6), m/s² and rad/s, less the first's, in the first's axes."""
    back = _rotation(shared, corrected, delay)
    turned = Rotation.from_matrix(back)
    setup = Mounting.effects(rotation=turned.as_rotvec(), delay=0.0, lever_arm=0.0, clock_scale=0.0)
    start = on_host(calibration.imu.with_effects(*setup))
    noise = _noise(recording, shared, start, back, delay)
    stations = [
        shared_stations(recording, shared.first, span - delay, delay, noise, gravity.value, still)
        for span, still in ((shared.rests, True), (shared.moving, False))
    ]
    measurements = list(map(KnownStations, stations))
    prior = _prior(start, calibration, known, back)
    fitted = fit(start, measurements, lambda name: name in prior.names, prior=prior, loss=loss)
    require_solved(fitted, recording.name)
    unit, errors = _unit(recording.name, calibration, fitted, delay, stations[1])
    return replace(unit, time_offset=unit.time_offset - later_zero(shared.first.start, recording.start)), errors


def _rotation(shared: _Shared, corrected: Recording, delay: float) -> FloatArray:
    """Return the matrix from a unit's axes to the first's that explains rates and gravity best."""
    force, rate = shared.means(corrected, delay)
    known_force, known_rate = shared.means(shared.first, 0.0)
    weight = (rate**2).sum() / (force**2).sum()
    back = turning_best(known_rate.T @ rate + weight * known_force.T @ force)
    if (left := ((known_rate - rate @ back.T) ** 2).sum() / (known_rate**2).sum()) > 1 - _ALIKE:
        raise NotPossibleError(
            f"{corrected.name} does not turn as {shared.first.name} does: however the one is mounted on the other, "
            f"{100 * min(left, 1):.0f} % of the rotation is left. Were both recorded at the same time, on one body?"
        )
    return back


def _noise(recording: Recording, shared: _Shared, imu: Imu, back: FloatArray, delay: float):
    """Return the white noise (3, 3), output² s, of a unit's accelerometer and gyroscope, the first's included."""
    noise = []
    for name, triad in imu.triads().items():
        of_unit = rest_statistics(recording.signals[name], shared.rests - delay)[0]
        of_first = rest_statistics(shared.first.signals[name], shared.rests)[0]
        across = triad.gain @ back.T
        noise.append(of_unit + across @ of_first @ across.T)
    return tuple(noise)


def _prior(imu: Imu, calibration: Calibration, first: Calibration, back: FloatArray) -> Prior:
    """Return what is known of a unit beside the first: its own calibration, blurred by the first's, and the set-up.

    Where the first's gain is off by δK and its bias by δb, the motion that it tells is off, and the unit looks as if
    its own were off by −T δK R and −T δb, T = K Rᵀ K₁⁻¹ with R from the unit's axes to the first's.

    The accelerometer and the gyroscope's axes were found from the same rests that tell how the units are turned: what
    was found of them counts as unknown here, or their noise would be counted twice.
    """
    bare = imu.with_effects()
    names, effects, sizes = names_of(bare), Prior.of_effects(imu), flatten(typical_sizes(bare))
    assert effects is not None
    blur = np.zeros((len(names), len(names)))
    for triad, model in imu.triads().items():
        across = model.gain @ back.T @ np.linalg.inv(first.imu.triad(triad).gain)
        for part, matrix in (("gain", np.kron(across, back.T)), ("bias", across)):
            rows = [row for row, name in enumerate(names) if (name.owner, name.part) == (triad, part)]
            blur[np.ix_(rows, rows)] = -matrix
    known = calibration.covariance_of(names)
    covariance = known + blur @ first.covariance_of(names) @ blur.T + np.diag((_LITTLE * sizes) ** 2)
    # what is not known stands: it says what is turned
    axes = np.array([name.owner == "accelerometer" or name.part == "gain" for name in names])
    covariance += np.diag(np.where(axes & (known.diagonal() > 0), sizes, 0.0) ** 2)
    root = scipy.linalg.block_diag(np.linalg.inv(np.linalg.cholesky(covariance)), effects.root)
    return Prior((*names, *effects.names), np.concatenate([flatten(bare), effects.mean]), root)


def _unit(
    name: str, calibration: Calibration, fitted: Fit, delay: float, motion: Stations
) -> tuple[ArrayUnit, FloatArray]:
    """Return what the fit says of a unit, and its errors in motion."""
    mounting, covariance = fitted_mounting(fitted.imu, fitted.names, fitted.covariance)
    turned = Rotation.from_rotvec(mounting.rotation)
    slope, back = np.asarray(right_jacobian(mounting.rotation)), turned.as_matrix()
    errors = {kind.name: kind.error for kind in station_errors(fitted.imu, motion, np.zeros(3))}
    length = np.asarray(motion.stop - motion.start)[np.asarray(motion.gyroscope_used)]
    both = np.concatenate([back @ errors["specific_force"], back @ (np.radians(errors["turn_angle"]) / length)]).T
    rate, force = (rms(both[:, columns]) for columns in (slice(3, 6), slice(3)))
    unit = ArrayUnit(
        name,
        calibration,
        turned.inv().as_quat(canonical=True, scalar_first=True),
        sigmas_of(slope @ covariance.rotation @ slope.T),
        back @ mounting.lever_arm,
        sigmas_of(back @ covariance.lever_arm @ back.T),
        -(delay + float(mounting.delay)),
        float(np.sqrt(covariance.delay[0, 0])),
        float(mounting.clock_scale),
        (rate, force),
    )
    return unit, both


# --- whose noise it is, and what averaging gains ----------------------------------------------------------------------


def _scatter(errors: Sequence[FloatArray]) -> list[tuple[float | None, float | None]]:
    """Return each unit's scatter of rate and force, the first's first, from the differences of all pairs.

    Of three units or more the variances of all differences are sums of two units' own (the three-cornered hat, Gray
    and Allan 1974), by least squares.
    """
    if (count := len(errors) + 1) < 3:
        return [(None, None)] * count
    whole = [np.zeros_like(errors[0]), *errors]
    pairs = list(combinations(range(count), 2))
    design = np.eye(count)[pairs].sum(axis=1)
    scatter = []
    for columns in (slice(3, 6), slice(3)):
        variances = [((whole[i] - whole[j])[:, columns] ** 2).mean() for i, j in pairs]
        scatter.append(root_or_zero(np.linalg.lstsq(design, np.array(variances), rcond=None)[0]).tolist())
    return list(zip(*scatter, strict=True))


def _averaged(shared: _Shared, corrected: Sequence[Recording], units: Sequence[ArrayUnit]) -> Averaged:
    """Return the scatter at rest of a typical unit and of the mean of all, each weighted by its own variance."""
    edges = [np.arange(a, b - _BLOCK, _BLOCK) for a, b in shared.rests]
    start, rest = np.concatenate(edges), np.arange(len(edges)).repeat(list(map(len, edges)))
    freedom = 3 * (len(rest) - len(edges))
    averaged = []
    for name in ("gyroscope", "accelerometer"):
        outputs = []
        for recording, unit in zip(corrected, units, strict=True):
            begin = start + unit.time_offset + later_zero(shared.first.start, recording.start)
            values = means_over(recording.signals[name], np.column_stack([begin, begin + _BLOCK]))
            values = rotations_of(unit.rotation).inv().apply(values)
            outputs.append(values - means_by_group(rest, values)[rest])
        variance = np.array([(values**2).sum() / freedom for values in outputs])
        mean = np.einsum("u,uik->ik", (1 / variance) / (1 / variance).sum(), np.array(outputs))
        averaged.append(
            (
                float(np.sqrt(np.median(variance))),
                float(np.sqrt((mean**2).sum() / freedom)),
                float(np.sqrt(1 / (1 / variance).sum())),
            )
        )
    return Averaged(*averaged)
