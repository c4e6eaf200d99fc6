"""Calibration of a magnetometer: soft and hard iron, and how its axes lie to those of the accelerometer (S21)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from jaximu.calibration.calibration import Calibration, concluded, effect_named, notes_of, provenance
from jaximu.calibration.compensation import compensate
from jaximu.calibration.nominal import as_stated
from jaximu.calibration.recipe import Choices, calibrate_ready
from jaximu.calibration.refusals import relative_covariance, require_determined
from jaximu.data.field import EXCESS_NAMES, FieldWindows, MagneticField, windows_of
from jaximu.estimation.fitting import Fit, Prior, fit, informed
from jaximu.estimation.problem import Name
from jaximu.estimation.uncertainty import UNDETERMINED, allowing_for_neighbours
from jaximu.ground.array_types import BoolArray, FloatArray, IntArray
from jaximu.ground.distributions import rms, robust_sigma
from jaximu.ground.document import Json
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import STANDARD, Gravity, LocalGravity, as_gravity
from jaximu.ground.magnetic_field import HIGHEST, LOWEST, FieldStrength
from jaximu.ground.precision import require_float64
from jaximu.ground.quantities import listed
from jaximu.ground.rotation import unit_vectors
from jaximu.ground.tracing import on_host
from jaximu.ground.units import SENSOR_UNITS
from jaximu.ground.vectors import dot_rows, lengths_of, root_or_zero, submatrix
from jaximu.mistakes import Prepared, prepare, prepared
from jaximu.model.effects import Effect
from jaximu.model.sensor import Imu, Triad
from jaximu.recordings.alignment import ARRANGEMENTS, EXPLAINED, signed_permutation
from jaximu.recordings.recording import Reading, Recording, Signal
from jaximu.simulation.protocols.positions import spiral

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_TYPICAL = 50.0
"""µT, about what the Earth's field has in the middle latitudes: the strength where only counts are known."""
_FLAT, _OPEN = 0.1, 0.3
"""Share of an ellipsoid's radius by which points must be thick, and share of the field by which a gyroscope may leave
the hard iron open, for either to show the strength."""
_WEAKEST, _STRONGEST = 22.0, 67.0
_OTHER_UNITS = {"gauss": 100.0, "mgauss": 0.1, "nT": 1e-3, "mT": 1e3}
"""What a magnetometer may be logged in, in µT, and between which the Earth's field lies outdoors, µT."""
_SCALE = 0.05
"""Share by which a data sheet's scale may be off, which the strength then is, too."""
_SHEET_GAIN, _SHEET_BIAS = 0.02, 0.05
"""Scale and misalignment of an accelerometer or a gyroscope, and an accelerometer's bias over gravity, by a data sheet
(MPU-6050: 3 %, 2 %, 50 mg on x and y and 80 mg on z at the most)."""
_FOLDS = 5
_DISTURBED = 5.0
"""Standard deviations, by medians, of the strength from which on a stretch is left out."""
_MOST_DISTURBED = 0.3
"""Share of windows of which more are not left out: then it is the model that is wrong."""
_BESIDE, _BETWEEN = 3.0, 3
"""The same beside a stretch, and how many windows from one such window the next is for all between to be left out."""
_ROUNDS = 3
_STEP, _CLEAR = 0.05, 4.0
"""Share of the field, and multiples of the scatter, by which two parts of a recording differ if they are of two fields.

A step of the hard iron changes the strength, too, but by as much up as down, by direction.
"""
_STEEP = 10.0
"""Degrees of dip from which on it says in which magnetic hemisphere the unit was."""
_CONTRADICTED = 3.0
"""Standard deviations of a stated dip by which the recording may leave it."""
_NEAR = np.cos(np.radians(15.0))
_RECORD = (
    "Turn the unit slowly until each of its axes has pointed up, down and to all sides: about each axis once round, "
    "and once round again tilted by 45°."
)
_UPWARD = (
    "the field points upward, as it does south of the magnetic equator: north of it an axis of one of the sensors has "
    "the wrong sign (--axes), and headings are turned round. --latitude decides which."
)
_UNSETTLED = "what the model leaves does not look like noise, and its size did not converge: intervals are approximate."
_WORSE, _FEWEST_HEADINGS = 1.1, 8
_NO_BETTER = (
    "on parts left out the heading is {after:.2g}° off the gyroscope's with this calibration and {before:.2g}° as "
    "logged (rms): it does not improve the heading. Turn the unit through more directions, away from iron."
)
_OPEN_HEADING = (
    "a level heading is uncertain by {:.2g}° with this calibration (one standard deviation), which changes it by "
    "{:.2g}° (rms): whether that improves it is open. Turn the unit through more directions{}."
)
_CALIBRATED = ", or state a calibration of its accelerometer and gyroscope (--calibration)"
_ALIKE_ERRORS = (
    "the field's strength differs from its mean for seconds at a time, as beside iron or where a sensor drifts: the "
    "intervals allow for it."
)
_NO_ONE_FIELD = (
    "after calibration the field's strength still scatters by {:.2g} % (rms): the field was not the same throughout. "
    "Iron, a magnet or a current was near for much of the recording, the unit was carried elsewhere, or the sensor "
    "drifts. Record again in one place, away from them."
)
_OTHER_DIP = (
    "the field points {off:.2g}° off the stated dip of {dip:.3g}°: iron nearby bends it, or the place is another. The "
    "dip was not used, and the strength is taken to be off by as much ({strength:.2g} µT, one standard deviation): "
    "--field states it."
)


@dataclass(frozen=True)
class MagneticLog:
    """One recording for a magnetometer: its samples, and the recording of the other sensors on the same clock.

    reading: how a log without other sensors was read.
    """

    magnetometer: Signal
    recording: Recording | None = None
    name: str = "recording"
    notes: tuple[str, ...] = ()
    reading: Reading | None = None


@dataclass(frozen=True)
class Heading:
    """Error of the heading (degrees, one sigma) by attitude, of a unit that knows its vertical.

    heading (h,): degrees; tilts (t, 2): roll and pitch, degrees; sigma (t, h): with what is uncertain of the
    parameters; before (t, h): how far off the heading is without calibration; scatter: of a single reading, by what
    the model leaves.
    """

    heading: FloatArray
    tilts: FloatArray
    sigma: FloatArray
    before: FloatArray
    scatter: float

    def document(self) -> Json:
        """Return root mean squares over the headings of a level unit and largest errors of any attitude, degrees."""
        return {
            "rms": float(np.hypot(rms(self.sigma[0]), self.scatter)),
            "worst": float(np.hypot(self.sigma.max(), self.scatter)),
            "before": {"rms": rms(self.before[0]), "worst": float(self.before.max())},
        }


def calibrate_magnetometer(
    logs: Sequence[MagneticLog],
    strength: FieldStrength | None = None,
    base: Calibration | None = None,
    gravity: Gravity = STANDARD,
    southern: bool | None = None,
    effects: Sequence[str | Effect] = (),
) -> tuple[Calibration, MagneticField, Heading | None]:
    """Calibrate a unit's magnetometer while it is turned about in a field that stays the same.

    **Arguments:**

    - `logs`: one or several recordings of the unit. With an accelerometer the magnetometer's axes are found against the
      accelerometer's; with a gyroscope any motion counts, however little of the sphere it covers.
    - `strength`: of the field, and its dip where it is known (`jaximu.ground.magnetic_field.world_magnetic_model`);
      None where nothing is: then the strength is what the data sheet's scale says, to five per cent. A dip that the
      recording contradicts is not used, and the strength then is uncertain by as much as the direction is off.
    - `base`: calibration of accelerometer and gyroscope; None to take it from the logs, where poses tell it.
    - `southern`: whether the field points up (south of the magnetic equator), which tells a mirrored magnetometer from
      the other hemisphere; None where nobody knows.
    - `effects`: of the magnetometer, to be fitted besides, by name or with a start.

    **Returns:** the calibration, with `field`, `heading_error`, `coverage` and `norm_spread` in `magnetic`; what it was
    fitted to; and the error of the heading by attitude, None without an accelerometer. Raises `InputError` where units
    differ, `NotPossibleError` where the directions that were measured do not determine hard and soft iron, or an
    effect.
    """
    require_float64()
    gravity = as_gravity(gravity)
    whole = [replace(log.recording or Recording(log.magnetometer), magnetometer=log.magnetometer) for log in logs]
    with prepared(whole, magnetometer=True) as ready:
        logs = list(map(_ready, logs, ready))
        return _calibrated(logs, strength, base, gravity, southern, _chosen(effects, logs))


def _chosen(effects: Sequence[str | Effect], logs: Sequence[MagneticLog]) -> list[Effect]:
    """Return the effects to be fitted. Raises `InputError` for one of another sensor, or whose input logs lack."""
    chosen = list(map(effect_named, effects))
    for effect in chosen:
        if effect.owner != "magnetometer":
            raise InputError(f"{effect.name} is no effect of a magnetometer: `jaximu effects` lists those, mag.*.")
        for need, signal in (("temperature", "temperature"), ("current", "current"), ("angular_rate", "gyroscope")):
            lacking = [log for log in logs if log.recording is None or signal not in log.recording.signals]
            if need in effect.needs and lacking:
                raise InputError(f"{lacking[0].name}: {effect.name} needs a {signal}, which this log lacks.")
        if "time" in effect.needs and len(logs) > 1:
            raise InputError(f"{effect.name} is of one recording: give one log.")
    return chosen


def _ready(log: MagneticLog, ready: Prepared) -> MagneticLog:
    """Return a log without rows that are no measurement, of the magnetometer (`ready`) and of the other sensors."""
    other = None if log.recording is None else prepare(log.recording)
    signal = ready.signals["magnetometer"]
    notes = tuple(notes_of(log, other, ready))
    return replace(log, magnetometer=signal, recording=None if other is None else other.recording, notes=notes)


def _calibrated(
    logs: Sequence[MagneticLog],
    strength: FieldStrength | None,
    base: Calibration | None,
    gravity: LocalGravity,
    southern: bool | None,
    effects: Sequence[Effect],
) -> tuple[Calibration, MagneticField, Heading | None]:
    where = ", ".join(log.name for log in logs)
    base, notes = _base(logs, base, gravity)
    unit = _unit(logs, base)
    origin = np.zeros(3) if unit.gyroscope is None else np.asarray(unit.gyroscope.bias, float)
    vertical = _uncertain_force(base)
    motions = [_corrected(log.recording, unit, base) for log in logs]
    parts = _windows(logs, motions, origin, vertical)
    windows = whole = FieldWindows.joined(parts)
    if southern is None and strength is not None and strength.dip is not None and abs(strength.dip) > _STEEP:
        southern = strength.dip < 0
    start, field, choices = _start(logs, windows, strength, unit, southern)
    notes += [*choices, *([field.note] if field.note else [])]
    full, known = not windows.alone, field.value
    fit, windows, stretches = _undisturbed(start.with_effects(*effects), windows, field, full)
    if fit.finite and field.dip is not None and _contradicted(fit, windows, field):
        stated, field = field.dip, replace(field, dip=None)
        fit, windows, stretches = _undisturbed(fit.imu, whole, field, full)
        off = abs((_dip(windows, fit)[0] or 0.0) - np.radians(stated))
        field = replace(field, sigma=float(np.hypot(field.sigma, known * off)))
        notes.append(_OTHER_DIP.format(off=np.degrees(off), dip=stated, strength=known * off))
    if fit.finite:  # along directions left open a fit may creep until its steps run out
        _require_covered(fit, windows, where)
        if not fit.converged:
            fit = _fitted(fit.imu, windows, field, full, np.asarray(fit.excess))
            notes.append(_UNSETTLED)
    _refuse_changed(fit, windows, field, where)
    if not fit.converged:
        raise NotPossibleError(
            f"{where}: no one field explains what was recorded, and the fit did not converge. Keep iron, magnets and "
            "currents away, check the columns' unit, and record again."
        )
    require_determined(fit, where)
    window = np.arange(len(windows))
    rows = windows.placed(window, window, window)
    wider = allowing_for_neighbours(fit.covariance, fit.sizes, fit.residual, fit.jacobian, rows)
    if wider is not None:
        fit = replace(fit, covariance=wider)
        notes.append(_ALIKE_ERRORS)
    known_gains = _data_sheet(fit, start)
    uncertain = _uncertain_turns(unit, base) if windows.turn.any() else np.zeros((0, 3, 3))
    shifts = _wrong_turns(fit, known_gains, windows, field, full, logs, motions, uncertain)
    fit = informed(fit, known_gains)
    fit = replace(fit, covariance=fit.covariance + shifts.T @ shifts)
    spreads, headings = _left_out(fit, start, windows, field, full, _samples(logs, parts))
    dip, dip_sigma = _dip(windows, fit)
    notes += stretches
    if (scatter := _spread(fit.imu, windows, known) / known) > _STEP:
        notes.append(_NO_ONE_FIELD.format(100 * scatter))
    if headings is not None and headings["after"] > _WORSE * headings["before"]:
        notes.append(_NO_BETTER.format(**headings))
    if dip is not None and dip < 0 and southern is None:
        notes.append(_UPWARD)
    readings = (log.reading if log.recording is None else log.recording.reading for log in logs)
    calibration = concluded(
        fit,
        gravity=gravity,
        method="magnetometer",
        loss="linear",
        excess_names=EXCESS_NAMES,
        rms=[{"field_strength": (_spread(imu, windows, known), "uT")} for imu in (_with_iron(start), fit.imu)],
        data=_data(logs, windows),
        nominal=Imu.nominal() if logs[0].recording is None else as_stated(logs[0].recording),
        advice=field_advice,
        notes=[*notes_of(*logs), *notes],
        reading=next(filter(None, readings), None if base is None else base.reading),
    )
    heading = None if dip is None else heading_errors(calibration, start, known, dip)
    measurement = _measured(windows, field)
    magnetic: Json = {
        "field": {
            "strength": {"value": known, "sigma": field.sigma, "unit": "uT"},
            "dip": None if dip is None else {"value": np.degrees(dip), "sigma": np.degrees(dip_sigma), "unit": "deg"},
        },
        "heading_error": None if heading is None else heading.document() | {"left_out": headings, "unit": "deg"},
        "coverage": coverage(fit.imu, windows),
        "norm_spread": {**spreads, "noise": windows.noise / _scale_of(start) / known},
        "gyroscope_bias": _gyroscope_bias(calibration),
        "next": None if dip is None else next_directions(calibration, measurement, dip),
        "disturbed": whole.time[~windows.used].tolist(),
    }
    if (error := magnetic["heading_error"]) is not None and open_heading(error):
        text = _OPEN_HEADING.format(error["rms"], error["before"]["rms"], _CALIBRATED if base is None else "")
        calibration = replace(calibration, notes=(*calibration.notes, text))
    calibration = replace(calibration, covariance=fit.total_covariance(field.sigma), magnetic=magnetic)
    return _with_base(calibration, base), measurement, heading


# --- what is known beforehand -----------------------------------------------------------------------------------------


def _base(
    logs: Sequence[MagneticLog], base: Calibration | None, gravity: LocalGravity
) -> tuple[Calibration | None, list[str]]:
    """Return the calibration of accelerometer and gyroscope: given, or of the logs' own poses, or None."""
    if not (recordings := [log.recording for log in logs if log.recording is not None]):
        return base, []
    calibration, findings, whose = base, [], "the calibration that was given"
    try:
        if calibration is None:
            calibration, findings = calibrate_ready(recordings, Choices(gravity))
            whose = "their own calibration"
    except (NotPossibleError, InputError) as error:
        reason = str(error).removeprefix(f"{recordings[0].name}: ")
    else:
        count = len(calibration.names)
        if calibration.rank == count:
            return calibration, [finding.text for finding in findings]
        reason = f"{whose} leaves {count - calibration.rank} of {count} parameters open."
    return None, [f"accelerometer and gyroscope are taken as their data sheets say: {reason}"]


def _uncertain_force(base: Calibration | None) -> FloatArray:
    """Return how uncertain the specific force is, as `FieldWindows.vertical`: as calibrated, or by a data sheet."""
    if base is None:
        return np.diag(np.square([_SHEET_GAIN * (i >= j) for i in range(3) for j in range(3)] + 3 * [_SHEET_BIAS]))
    known = base.of_numbers(lambda name: name.owner == "accelerometer" and name.effect is None)
    changes = np.zeros((len(known.names), 3, 4))  # of the gain and, over gravity, of the bias
    for change, name in zip(changes, known.names, strict=True):
        change[(*name.axes, 3)[:2]] = 1.0 if name.part == "gain" else 1 / base.gravity.value
    bent = -np.linalg.inv(base.imu.accelerometer.gain) @ changes
    bent = np.hstack([bent[:, :, :3].reshape(-1, 9), bent[:, :, 3]])
    return bent.T @ known.covariance @ bent


def _uncertain_turns(unit: Imu, base: Calibration | None) -> FloatArray:
    """Return by what share (k, 3, 3) of itself the rate may be off, one standard deviation each, as calibrated or by a
    data sheet.
    """
    if base is None or "gyroscope" not in base.imu.triads():
        return _SHEET_GAIN * np.eye(9).reshape(9, 3, 3)
    known = base.of_numbers(lambda name: (name.owner, name.part) == ("gyroscope", "gain"))
    values, vectors = np.linalg.eigh(known.covariance)
    errors = np.zeros((len(values), 3, 3))
    for name, row in zip(known.names, vectors * root_or_zero(values), strict=True):
        errors[:, *name.axes] = row
    return np.linalg.inv(unit.triad("gyroscope").gain) @ errors


def _wrong_turns(
    fit: Fit,
    known: Prior,
    windows: FieldWindows,
    field: FieldStrength,
    full: bool,
    logs: Sequence[MagneticLog],
    motions: Sequence[Recording | None],
    errors: FloatArray,
) -> FloatArray:
    """Return how the numbers (k, p) of an informed fit change where rates are off by shares (k, 3, 3) of themselves.

    They turn the field that is carried, and with it the magnetometer's axes. They are no part of what the fit weighs:
    beside strengths, which they do not reach, turns would hardly count.
    """
    used = {name: getattr(windows, name) for name in ("used", "turn", "level")}
    changes = np.zeros((len(errors), len(fit.names)))
    for change, error in zip(changes, errors, strict=True):
        wrong = [_turned(motion, error) for motion in motions]
        other = replace(FieldWindows.joined(_windows(logs, wrong, windows.origin, windows.vertical)), **used)
        refitted = replace(_fitted(fit.imu, other, field, full, np.asarray(fit.excess)), covariance=fit.covariance)
        change[:] = informed(refitted, known).values - informed(fit, known).values
    return changes


def _turned(motion: Recording | None, error: FloatArray) -> Recording | None:
    """Return a recording whose angular rate, if it has one, is off by a share (3, 3) of itself."""
    if motion is None or "gyroscope" not in motion.signals:
        return motion
    rate = motion.signals["gyroscope"]
    return replace(motion, gyroscope=replace(rate, values=rate.values @ (np.eye(3) + error).T))


def _windows(
    logs: Sequence[MagneticLog], motions: Sequence[Recording | None], origin: FloatArray, vertical: FloatArray
) -> list[FieldWindows]:
    return [windows_of(log.magnetometer, motion, origin, vertical) for log, motion in zip(logs, motions, strict=True)]


def _unit(logs: Sequence[MagneticLog], base: Calibration | None) -> Imu:
    """Return accelerometer and gyroscope as they are known: calibrated, or by the data sheet, axes as gravity shows."""
    recording = logs[0].recording
    if base is not None:
        return base.imu.transferable()
    if recording is None:
        return Imu.nominal()
    unit, turning = as_stated(recording), recording.turning
    if turning is None or turning.explained < EXPLAINED or unit.gyroscope is None:
        return unit
    if turning.correlation > 0 and turning.correlation**2 > EXPLAINED * turning.explained:
        return unit  # as the data sheet has it: an axis that hardly turned gravity must not be turned round
    gain = unit.gyroscope.gain @ signed_permutation(turning.matrix).T
    return replace(unit, gyroscope=replace(unit.gyroscope, gain=gain))


def _corrected(recording: Recording | None, unit: Imu, base: Calibration | None) -> Recording | None:
    """Return a recording in SI without what is known of the sensors' errors."""
    if recording is None:
        return None
    if base is not None:
        return compensate(base, recording)
    changed: dict[str, Any] = {
        name: Signal(signal.time, unit.triad(name).recover_on_host(signal.values), SENSOR_UNITS[name])
        for name, signal in recording.signals.items()
        if name in unit.triads()
    }
    return replace(recording, **changed)


def ellipsoid(values: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return shape A (3, 3), symmetric, and centre b (3,) with |A (y − b)| ≈ 1 of points (n, 3), by linear algebra.

    The algebraic fit that most tools use: it weighs errors by their place and is biased by noise. None where the points
    lie on no ellipsoid.
    """
    centre, size = values.mean(axis=0), float(values.std())
    x, y, z = ((values - centre) / size).T
    design = np.column_stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z])
    p = np.linalg.lstsq(design, np.ones(len(design)), rcond=None)[0]
    shape = p[np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])]
    if np.linalg.cond(shape) > 1e6:
        return None
    middle = -np.linalg.solve(shape, p[6:])
    squares, vectors = np.linalg.eigh(shape / (1 + middle @ shape @ middle))
    if squares.min() <= 0:
        return None
    return (vectors * np.sqrt(squares)) @ vectors.T / size, centre + size * middle


def _start(
    logs: Sequence[MagneticLog],
    windows: FieldWindows,
    strength: FieldStrength | None,
    unit: Imu,
    southern: bool | None,
) -> tuple[Imu, FieldStrength, list[str]]:
    """Return the unit that the fit starts from, the field's strength, and what had to be chosen."""
    signal = logs[0].magnetometer
    if any(log.magnetometer.unit != signal.unit for log in logs):
        raise InputError("the logs give the magnetometer in different units; state the same for all.")
    carried = _carried_centre(windows) if windows.turn.any() else None
    scale, centre, field, notes = field_start(windows.output, signal.unit, strength, logs[0].name, carried)
    turn = _axes(windows, centre, southern)
    if not np.array_equal(turn, np.eye(3)):
        names = [("+" if sum(row) > 0 else "−") + _longest(row) for row in turn]
        notes.append(
            f"the magnetometer's x, y and z lie along the unit's {', '.join(names)}: the gain says so, and nothing has "
            "to be turned."
        )
    triad = Triad(scale * turn, np.asarray(centre, float), quantity="magnetic_field", output_unit=signal.unit)
    return on_host(replace(unit.with_effects(), magnetometer=triad)), field, notes


def field_start(
    output: FloatArray,
    unit: str,
    strength: FieldStrength | None,
    where: str,
    carried: tuple[FloatArray, float] | None = None,
) -> tuple[float, FloatArray, FieldStrength, list[str]]:
    """Return where a fit of the field's strength starts: scale (output units to a µT), hard iron (3,), field, notes.

    output (n, 3): in `unit`; `carried`: the hard iron (3,) that something else tells, for outputs on no ellipsoid,
    and the share of the field by which that may be off. A strength of which nothing is known is what the data sheet's
    scale says, to five per cent. Raises `NotPossibleError` where outputs are on no sphere of the Earth's field, or do
    not show which.
    """
    shape = ellipsoid(output)
    if shape is not None and _plausible(shape, output):
        centre, radius = shape[1], 1 / np.cbrt(np.linalg.det(shape[0]))
    else:
        centre, open_share = carried if carried is not None else (output.mean(axis=0), 0.0)
        if strength is None and open_share > _OPEN:
            raise NotPossibleError(
                f"{where}: the unit was turned about nearly one axis, which does not determine the field's strength. "
                f"State it (--field), or record again. {_RECORD}"
            )
        radius = float(np.median(lengths_of(output - centre)))
    if unit == "uT":
        if not LOWEST < radius < HIGHEST:
            _refuse_size(radius, strength, where)
        return 1.0, centre, FieldStrength(radius, _SCALE * radius) if strength is None else strength, []
    if strength is not None:
        return radius / strength.value, centre, strength, []
    note = (
        f"the field's strength is taken as {_TYPICAL:g} µT: {unit} show none. --field states it; headings do not "
        "depend on it."
    )
    return radius / _TYPICAL, centre, FieldStrength(_TYPICAL, 0.3 * _TYPICAL), [note]


def _refuse_size(radius: float, strength: FieldStrength | None, where: str) -> None:
    """Refuse a sphere (µT) that is not the Earth's field; with a known field only where another unit explains it."""
    for unit, factor in _OTHER_UNITS.items():
        if _WEAKEST < factor * radius < _STRONGEST:
            raise NotPossibleError(
                f"{where}: the magnetometer's output moves on a sphere of {radius:.2g} µT, which is not the Earth's "
                f"field; in {unit} it would be one of {factor * radius:.2g} µT. State the unit: --columns, [{unit}]."
            )
    if strength is None:
        raise NotPossibleError(
            f"{where}: the magnetometer's output moves on a sphere of {radius:.2g} µT, which is not the "
            f"Earth's field: the unit hardly turned, or the unit of the columns is another. {_RECORD}"
        )


def _plausible(shape: tuple[FloatArray, FloatArray], output: FloatArray) -> bool:
    """Whether an ellipsoid is one that points determine: not far off, nor of a flat set, nor much longer one way."""
    lengths = np.linalg.eigvalsh(shape[0])
    radius = 1 / np.cbrt(lengths.prod())
    thickness = np.sqrt(12 * np.linalg.eigvalsh(np.cov(output.T))[0])  # of points spread evenly
    wide = np.ptp(output, axis=0).max() > 0.8 * radius and thickness > _FLAT * radius
    return bool(lengths.max() < 3 * lengths.min() and wide)


def _carried_centre(windows: FieldWindows) -> tuple[FloatArray, float]:
    """Hard iron (3,) by the gyroscope alone: R (y₂ − b) = y₁ − b, linear in b.

    And the share of the field by which it is off at the most if every turn is off by as much as a data sheet's gain.
    """
    rows = np.flatnonzero(windows.turn)
    turned = windows.carried[rows]
    target = windows.output[rows] - np.einsum("nij,nj->ni", turned, windows.output[rows + 1])
    centre, _, _, sizes = np.linalg.lstsq((np.eye(3) - turned).reshape(-1, 3), target.ravel(), rcond=1e-6)
    return centre, float(_SHEET_GAIN * lengths_of(windows.angle[rows]) / max(sizes[-1], 1e-12))


def _axes(windows: FieldWindows, centre: FloatArray, southern: bool | None) -> FloatArray:
    """Return the signed permutation (3, 3) that takes the field in the unit's axes to the magnetometer's.

    Nothing tells a magnetometer from one with all axes turned round but the hemisphere: without it the right-handed
    one is taken.
    """
    if windows.alone:
        return np.eye(3)
    field, calm, costs = windows.output - centre, windows.calm, []
    for turn in ARRANGEMENTS:
        body = field @ turn  # turnᵀ applied to every row
        length = lengths_of(body)
        cost = 0.0
        if windows.turn.any():
            moved = (np.einsum("nij,nj->ni", windows.carried, np.roll(body, -1, axis=0)) - body)[windows.turn]
            cost += float((moved**2).sum(axis=1).mean()) / float((length**2).mean())
        if calm.any():
            cost += float((dot_rows(windows.up[calm], body[calm]) / length[calm]).var())
        costs.append(cost)
    best = ARRANGEMENTS[0 if min(costs) > 0.8 * costs[0] else int(np.argmin(costs))]
    if southern is not None and windows.level.any():
        dip = np.median(dot_rows(windows.up, field @ best)[windows.level])
        best = -best if (dip > 0) != southern else best
    return best


# --- the fit ----------------------------------------------------------------------------------------------------------


def _measured(windows: FieldWindows, field: FieldStrength) -> MagneticField:
    dip = None if field.dip is None else (float(np.radians(field.dip)), float(np.radians(field.dip_sigma)))
    return MagneticField(windows, field.value, dip)


def _fitted(
    start: Imu,
    windows: FieldWindows,
    field: FieldStrength,
    full: bool,
    excess: FloatArray | None = None,
    loss: str = "linear",
) -> Fit:
    """Fit the magnetometer, all of its gain where its axes can be told, else a lower triangle as by hand; and the
    gyroscope's bias.
    """

    def free(name: Name) -> bool:
        if name.owner == "gyroscope":  # a bias that was another on that day would turn the carried field
            return name.part == "bias" and bool(windows.turn.any())
        whole = full or name.part == "bias" or name.effect is not None or name.axes[0] >= name.axes[1]
        return name.owner == "magnetometer" and whole

    return fit(
        start, _measured(windows, field), free, follow=True, excess=excess, loss=loss, estimate_excess=excess is None
    )


def _data_sheet(fit: Fit, start: Imu) -> Prior:
    """What is known of gains beforehand: those that the fit started from, about as well as a data sheet's scale."""
    names = tuple(name for name in fit.names if name.owner == "magnetometer" and name.part == "gain")
    gain = _magnetometer(start).gain
    return Prior(names, np.array([gain[name.axes] for name in names]), np.eye(len(names)) / (_SCALE * _scale_of(start)))


def _magnetometer(imu: Imu) -> Triad:
    assert imu.magnetometer is not None
    return imu.magnetometer


def _scale_of(imu: Imu) -> float:
    """Output units of the magnetometer to a µT."""
    return float(_magnetometer(imu).scales.mean())


def _strengths(imu: Imu, output: FloatArray) -> FloatArray:
    """Strength (n,) of the field, µT, that outputs (n, 3) mean."""
    return lengths_of(_magnetometer(imu).recover_on_host(output))


def _white(imu: Imu, windows: FieldWindows) -> float:
    """Standard deviation, µT, of a typical window's mean by white noise."""
    return windows.noise / _scale_of(imu) / np.sqrt(np.median(windows.count))


def _spread(imu: Imu, windows: FieldWindows, strength: float) -> float:
    return rms(lengths_of(windows.field(imu)[windows.used]) - strength)


def _contradicted(fit: Fit, windows: FieldWindows, field: FieldStrength) -> bool:
    """Whether the field leaves the stated dip, which was part of the fit, by more than it may.

    Where nothing else determines it, the dip stays where it was stated: no contradiction.
    """
    dip, sigma = _dip(windows, fit)
    assert field.dip is not None
    allowed = _CONTRADICTED * np.hypot(field.dip_sigma, np.degrees(sigma))
    return dip is not None and abs(np.degrees(dip) - field.dip) > allowed


def _undisturbed(
    start: Imu, windows: FieldWindows, field: FieldStrength, full: bool
) -> tuple[Fit, FieldWindows, list[str]]:
    """Return the fit, the windows without those in which something disturbs the field, and when that was."""
    whole = windows
    fit = _fitted(start, windows, field, full, loss="cauchy")  # else a stretch pulls the fit to where it hides
    for number in range(1 + _ROUNDS):
        far = _disturbed(fit.imu, windows, whole) if fit.finite else ~windows.used
        far = far if far.mean() <= _MOST_DISTURBED else ~windows.used
        if number and np.array_equal(far, ~windows.used):
            break
        windows = whole.without(far)
        fit = _fitted(start, windows, field, full)  # along what is open the first one may have crept away
    left = ~windows.used
    if not left.any():
        return fit, windows, []
    note = (
        f"the field is disturbed in {left.sum()} of {len(left)} windows, {_spans(whole.time[left])}; they were left "
        "out. Iron, a magnet or a current came near, or a jerk tilted the measured vertical."
    )
    return fit, windows, [note]


def _disturbed(imu: Imu, windows: FieldWindows, whole: FieldWindows) -> BoolArray:
    """Return in which of `whole` (n,) the field is another than in `windows`, by its strength or its angle to gravity.

    What is next to such a window is asked at a lower level, and what lies between two is one, too: a disturbance that
    turns past the field changes for a moment neither. Where the vertical leaves the one that the gyroscope carries from
    the windows beside it, it is the hand that shakes, and the angle may be off by as much.
    """
    field, noise, size = whole.field(imu), _white(imu, whole), np.zeros(len(whole))
    length = lengths_of(field)
    dip = dot_rows(whole.up, field) / length
    moved = whole.turn * lengths_of(np.einsum("nij,nj->ni", whole.carried, np.roll(whole.up, -1, axis=0)) - whole.up)
    shaken = np.maximum(moved, np.roll(moved, 1))
    for values, known, least in ((length, whole.used, noise), (dip, whole.calm, shaken + noise / np.median(length))):
        usual = known & windows.used
        if usual.any():
            off = np.where(known, abs(values - np.median(values[usual])), 0.0)
            size = np.maximum(size, off / np.maximum(robust_sigma(off[usual]), least))
    far = scipy.ndimage.binary_propagation(size > _DISTURBED, mask=size > _BESIDE)
    return far | scipy.ndimage.binary_closing(far, np.ones(_BETWEEN))


def _refuse_changed(fit: Fit, windows: FieldWindows, field: FieldStrength, where: str) -> None:
    """Refuse a field that was of one strength first and of another then, as two places have it."""
    strength = lengths_of(windows.field(fit.imu))[windows.used]
    least = max(len(strength) // 10, 2)
    if not np.isfinite(strength).all() or len(strength) < 4 * least:
        return
    count, total = np.arange(1, len(strength)), strength.cumsum()
    rest = count[::-1]
    before, after = total[:-1] / count, (total[-1] - total[:-1]) / rest
    gain = (count * rest * (after - before) ** 2)[least - 1 : 1 - least]
    last = int(gain.argmax()) + least - 1
    scatter = np.concatenate([strength[: last + 1] - before[last], strength[last + 1 :] - after[last]]).std()
    if abs(after[last] - before[last]) > max(_STEP * field.value, _CLEAR * scatter):
        raise NotPossibleError(
            f"{where}: the field is of {before[last]:.3g} µT until {windows.time[windows.used][last, 1]:.1f} s and of "
            f"{after[last]:.3g} µT after: it changed, or the unit was carried elsewhere. Calibrate on one of the parts."
        )


def _spans(times: FloatArray, shown: int = 5) -> str:
    """Name stretches (k, 2) of time, neighbours as one."""
    gaps = times[1:, 0] - times[:-1, 1]
    joined = np.split(times, 1 + np.flatnonzero((gaps < 0) | (gaps >= 1.0)))
    words = [f"{stretch[0, 0]:.1f} to {stretch[-1, 1]:.1f} s" for stretch in joined[:shown]]
    return ", ".join(words) + (f" and {len(joined) - shown} more stretches" if len(joined) > shown else "")


def _samples(logs: Sequence[MagneticLog], parts: Sequence[FieldWindows]) -> list[FloatArray]:
    """Return the samples (m, 3) of each window, those included that no mean took."""
    samples = []
    for log, part in zip(logs, parts, strict=True):
        edges = log.magnetometer.time.searchsorted(part.time)
        samples += [log.magnetometer.values[first : last + 1] for first, last in edges]
    return samples


def _require_covered(fit: Fit, windows: FieldWindows, where: str) -> None:
    """Refuse what is no calibration: hard iron left open, or by itself more than a third of the parameters."""
    covariance = relative_covariance(fit)
    iron = [(name.owner, name.part) == ("magnetometer", "bias") for name in fit.names]
    iron_open, left = (
        int((np.linalg.eigvalsh(part) > UNDETERMINED**2).sum()) for part in (submatrix(covariance, iron), covariance)
    )
    share = 100 * coverage(fit.imu, windows)
    if iron_open or (windows.alone and left > len(fit.names) // 3) or (not fit.converged and share < 50):
        raise NotPossibleError(
            f"{where}: the field was seen from {share:.0f} % of all directions, which leaves "
            f"{_open_words(fit.names, np.diagonal(covariance) > UNDETERMINED**2)} open. {_RECORD}"
        )


def _open_words(names: Sequence[Name], wide: BoolArray) -> str:
    """Name what is known no better than from the data sheet; where no number is by itself, their combinations."""
    axes: dict[str, list[str]] = {}
    for name, open_ in zip(names, wide, strict=True):
        if open_ and name.effect is None:
            gain = "the scale of" if name.axes[0] == name.axes[-1] else "soft iron and alignment of"
            bias = "the gyroscope's bias about" if name.owner == "gyroscope" else "hard iron along"
            axes.setdefault(bias if name.part == "bias" else gain, []).append("xyz"[name.axes[0]])
    if not axes:
        return "combinations of hard iron, soft iron and scale"
    return listed([f"{part} {listed(list(dict.fromkeys(letters)))}" for part, letters in axes.items()])


def _left_out(
    whole: Fit, start: Imu, windows: FieldWindows, field: FieldStrength, full: bool, samples: Sequence[FloatArray]
) -> tuple[dict[str, float | None], dict[str, float] | None]:
    """Spread of the samples' strength over its mean on fifths left out: raw, calibrated, by the algebraic ellipsoid;
    and by how many degrees (rms) the heading leaves the gyroscope's there, raw and calibrated.
    """
    fold = np.minimum(np.arange(len(windows)) * _FOLDS // len(windows), _FOLDS - 1)
    strengths: dict[str, list[FloatArray]] = {"before": [], "after": [], "algebraic": []}
    headings: dict[str, list[FloatArray]] = {"before": [], "after": []}
    raw = _with_iron(start)
    for number in range(_FOLDS):
        inside = (fold == number) & windows.used
        rest = windows.without(fold == number)
        if not inside.any() or rest.used.sum() < 12:
            continue
        fitted = _fitted(whole.imu, rest, field, full, np.asarray(whole.excess))
        model = informed(fitted, _data_sheet(fitted, start)).imu
        for imu, errors in zip((raw, model), headings.values(), strict=True):
            errors.append(carried_headings(windows, imu, np.flatnonzero(fold == number)))
        output, others = (
            np.concatenate([samples[k] for k in np.flatnonzero(rows).tolist()]) for rows in (inside, rest.used)
        )
        strengths["before"].append(_strengths(raw, output))
        if whole.imu.all_effects():  # what they add is known where the windows have their samples
            measured = np.asarray(windows.samples.track.observation)[inside] < len(windows)
            output = (windows.samples.output - windows.added(model))[inside][measured]
        strengths["after"].append(_strengths(model, output))
        if (shape := ellipsoid(others)) is not None:
            strengths["algebraic"].append(lengths_of((output - shape[1]) @ shape[0]))
    spreads: dict[str, float | None] = {"before": 0.0, "after": 0.0, "algebraic": None}
    for name, parts in strengths.items():
        if parts:
            values = np.concatenate(parts)
            spreads[name] = float(values.std() / values.mean())
    off = {name: np.concatenate([np.zeros(0), *parts]) for name, parts in headings.items()}
    turned = {name: rms(np.degrees(errors)) for name, errors in off.items() if len(errors)}
    return spreads, turned or None


def _with_iron(imu: Imu) -> Imu:
    """Return a unit whose hard iron is left in what it puts out."""
    return replace(imu, magnetometer=replace(_magnetometer(imu), bias=np.zeros(3)))


def carried_headings(windows: FieldWindows, imu: Imu, rows: IntArray) -> FloatArray:
    """Return by how much (rad) the heading of each calm window leaves the one that the gyroscope carries.

    rows: windows in order. Less a straight line, for the gyroscope's bias, over each recording.
    """
    joints = np.flatnonzero((windows.swept[rows[:-1]] == 0).all(axis=(1, 2))) + 1  # nothing carries to another log
    field, errors = windows.field(imu), [np.zeros(0)]
    for part in np.split(rows, joints):
        up, calm = windows.up[part], (windows.used & windows.calm)[part]
        if not windows.turn.any() or calm.sum() < _FEWEST_HEADINGS:
            continue
        east = unit_vectors(np.cross(field[part], up))
        level = np.stack([east, np.cross(up, east), up], axis=1)
        carried, yaw = level[0], []
        for frame, row in zip(level, part, strict=True):
            turn = frame @ carried.T
            yaw.append(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
            carried = carried @ windows.carried[row]
        time = windows.time[part].mean(axis=1)
        design = np.column_stack([np.ones(len(time)), time - time.mean()])[calm]
        angle = np.unwrap(yaw)[calm]
        errors.append(angle - design @ np.linalg.lstsq(design, angle, rcond=None)[0])
    return np.concatenate(errors)


# --- what it means ----------------------------------------------------------------------------------------------------


def coverage(imu: Imu, windows: FieldWindows) -> float:
    """Return the share of all directions that the field had, in the magnetometer's axes, to within 15°."""
    return float(((spiral(400) @ unit_vectors(windows.field(imu)[windows.used]).T).max(axis=1) > _NEAR).mean())


def _dip(windows: FieldWindows, fit: Fit) -> tuple[float | None, float]:
    """The angle (rad) of the field below the level, and its standard deviation."""
    calm = windows.calm
    if not calm.any():
        return None, 0.0
    field = windows.field(fit.imu)
    sine = -dot_rows(windows.up, field)[calm] / lengths_of(field)[calm]
    middle = np.median(sine)
    dip = float(np.arcsin(np.clip(middle, -1, 1)))
    spread = robust_sigma(sine - middle) / np.sqrt(max(calm.sum() / 4, 1))  # neighbours share their errors
    bent = windows.bent(field)[calm].mean(axis=0)
    return dip, float(np.hypot(spread, root_or_zero(bent @ windows.vertical @ bent)) / max(np.cos(dip), 0.05))


def heading_errors(calibration: Calibration, start: Imu, strength: float, dip: float) -> Heading:
    """Return how uncertain the heading is by attitude, and how wrong it was without calibration.

    Of a unit whose vertical is known: its field is turned level by the true attitude, and what is wrong of its
    horizontal part across north is the error.
    """
    headings = np.arange(0.0, 360.0, 15.0)
    tilts = np.array([[0.0, 0.0], [45.0, 0.0], [-45.0, 0.0], [0.0, 45.0], [0.0, -45.0], [180.0, 0.0]])
    triad, before = _magnetometer(calibration.imu), _magnetometer(start)
    angles = np.array([[heading, pitch, roll] for roll, pitch in tilts for heading in headings])
    attitude = scipy.spatial.transform.Rotation.from_euler("ZYX", angles, degrees=True)
    known = calibration.of_numbers(_of_iron)
    body, slope = _heading_slopes(known.names, triad, attitude, strength, dip)
    sigma = root_or_zero(dot_rows(slope @ known.covariance, slope))
    level = attitude.apply(np.linalg.solve(before.gain, (body @ triad.gain.T + triad.bias).T).T)
    off = abs(np.arctan2(level[:, 0], level[:, 1]))
    scatter = np.sqrt(calibration.excess.get(EXCESS_NAMES[0], 0.0)) * 0.1 / (strength * np.cos(dip))
    sigma, off = (np.degrees(values).reshape(len(tilts), len(headings)) for values in (sigma, off))
    return Heading(headings, tilts, sigma, off, float(np.degrees(scatter)))


def open_heading(error: Json) -> bool:
    """Whether a calibrated heading is less certain than what the calibration changes; error: `heading_error`."""
    return error["rms"] > error["before"]["rms"]


def _of_iron(name: Name) -> bool:
    return name.owner == "magnetometer" and name.effect is None


def _heading_slopes(
    names: Sequence[Name], triad: Triad, attitude: Rotation, strength: float, dip: float
) -> tuple[FloatArray, FloatArray]:
    """Return the field (n, 3), µT, at attitudes (body to x east, y north, z up), and how headings react to numbers.

    The reactions (n, p) are in rad, but for the sign: an error of the field across north is one of the heading.
    """
    back = attitude.inv()
    body = back.apply(strength * np.array([0.0, np.cos(dip), -np.sin(dip)]))
    east = back.apply([1.0, 0.0, 0.0]) / (strength * np.cos(dip))
    return body, np.einsum("ni,nik->nk", east, _reactions(names, body, triad.gain))


def hard_iron(calibration: Calibration) -> tuple[float, float]:
    """Return the size of the hard iron, µT, and its standard deviation, to first order."""
    gain, bias = _magnetometer(calibration.imu).gain, _magnetometer(calibration.imu).bias
    iron = np.linalg.solve(gain, bias)
    known = calibration.of_numbers(_of_iron)
    slope = unit_vectors(iron) @ _reactions(known.names, -iron[None], gain)[0]
    return float(lengths_of(iron)), float(root_or_zero(slope @ known.covariance @ slope))


def _reactions(names: Sequence[Name], field: FloatArray, gain: FloatArray) -> FloatArray:
    """How an output, turned back into a field (n, 3), reacts to gain and bias (n, 3, p), but for the sign."""
    change = np.zeros((len(field), 3, len(names)))
    for k, name in enumerate(names):
        change[:, name.axes[0], k] = 1.0 if name.part == "bias" else field[:, name.axes[1]]
    return np.linalg.inv(gain) @ change


def next_directions(calibration: Calibration, measurement: MagneticField, dip: float, count: int = 6) -> Json:
    """Return where the field should be seen next, in the unit's axes, and what that buys a level heading.

    `calibration`: fitted to `measurement`; `dip`: rad. One after another the direction whose strength, measured as well
    as the others, takes most off the variance of level headings, all headings alike. In the result `directions` (count,
    3), and `heading_now`, `heading_then`, degrees, one sigma of what is uncertain of the parameters.
    """
    fit, triad, windows = calibration.fit, _magnetometer(calibration.imu), measurement.windows
    assert fit is not None
    known = replace(calibration, covariance=np.asarray(fit.covariance)).of_numbers(_of_iron)
    spread = known.covariance
    attitude = scipy.spatial.transform.Rotation.from_euler("z", np.arange(0.0, 360.0, 15.0)[:, None], degrees=True)
    heading = _heading_slopes(known.names, triad, attitude, measurement.strength, dip)[1]
    grid = spiral(200)
    sigma = np.hypot(_white(calibration.imu, windows), 0.1 * np.sqrt(calibration.excess.get(EXCESS_NAMES[0], 0.0)))
    reaction = np.einsum("ni,nik->nk", grid, _reactions(known.names, measurement.strength * grid, triad.gain)) / sigma

    def accuracy() -> float:
        return float(np.degrees(np.sqrt(dot_rows(heading @ spread, heading).mean())))

    before, chosen = accuracy(), []
    for _ in range(count):
        moved = reaction @ spread
        gains = ((moved @ heading.T) ** 2).sum(axis=1) / (1 + dot_rows(moved, reaction))
        best = int(gains.argmax())
        chosen.append(grid[best].tolist())
        spread -= np.outer(moved[best], moved[best]) / (1 + moved[best] @ reaction[best])
    return {"directions": chosen, "heading_now": before, "heading_then": accuracy(), "unit": "deg"}


def field_advice(vector: FloatArray, names: Sequence[Name], sizes: FloatArray, model: Imu) -> str:
    """Say how to hold the unit for what is open: where the field's strength changes most, or its angle to gravity."""
    inverse = np.linalg.inv(_magnetometer(model).gain)
    change, shift, drift = np.zeros((3, 3)), np.zeros(3), 0.0
    for name, weight, size in zip(names, vector, np.asarray(sizes), strict=True):
        if name.effect is None and name.owner == "magnetometer":
            (change if name.part == "gain" else shift)[name.axes] += weight * size
        drift += weight**2 if name.owner == "gyroscope" else 0.0
    if drift > 0.5:
        return "half a minute at rest, for the gyroscope's bias."
    change, shift = inverse @ change, inverse @ shift / _TYPICAL
    grid = spiral(200)
    strength = abs(dot_rows(grid @ change, grid) + grid @ shift)
    turn = 0.5 * (change[[2, 0, 1], [1, 2, 0]] - change[[1, 2, 0], [2, 0, 1]])
    if lengths_of(turn) > 1.5 * strength.max():  # up · (turn × field) is largest where the turn's axis points east
        return f"rests in which the unit's {_longest(turn)} axis lies level and points east, and rests with it west."
    best = _longest(grid[int(strength.argmax())])
    return f"turns in which the unit's {best} axis points along the field and against it."


def _longest(direction: FloatArray) -> str:
    return "xyz"[int(abs(direction).argmax())]


def _data(logs: Sequence[MagneticLog], windows: FieldWindows) -> Json:
    recordings = [log.recording for log in logs if log.recording is not None]
    source = provenance(recordings) if recordings else {"file": logs[0].name}
    return source | {"windows": int(windows.used.sum())}


def _gyroscope_bias(calibration: Calibration) -> Json | None:
    """Return the gyroscope's bias (3), output units, that the carried field tells."""
    if not any(name.owner == "gyroscope" for name in calibration.names):
        return None
    triad = calibration.imu.triad("gyroscope")
    sigma = calibration.sigma("gyroscope")[1]
    return {"value": triad.bias.tolist(), "sigma": sigma.tolist(), "unit": triad.output_unit}


def _with_base(calibration: Calibration, base: Calibration | None) -> Calibration:
    """Return the magnetometer's calibration, beside that of the other sensors where it took one as known."""
    alone = calibration.of_numbers(lambda name: name.owner == "magnetometer")
    joined = replace(alone, rank=alone.rank - (len(calibration.names) - len(alone.names)))
    if base is not None:
        joined = replace(
            joined,
            imu=replace(base.imu, magnetometer=alone.imu.magnetometer),
            names=(*base.names, *alone.names),
            covariance=scipy.linalg.block_diag(base.covariance, alone.covariance),
            rank=base.rank + joined.rank,
            weak=(*base.weak, *alone.weak),
            excess={**base.excess, **alone.excess},
            rms={**base.rms, **alone.rms},
            notes=tuple(dict.fromkeys((*base.notes, *alone.notes))),
        )
    known = {name.owner for name in joined.names}  # a base may be a definition, of which nothing is uncertain
    return replace(joined, absent=tuple(name for name in joined.imu.triads() if name not in known))
