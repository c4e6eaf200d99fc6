"""Calibration of a magnetometer: soft and hard iron, and how its axes lie to those of the accelerometer (S21)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Any

import jax
import numpy as np
import scipy
from numpy.typing import NDArray

from jaximu.calibration.calibration import Calibration, concluded, effect_named, provenance
from jaximu.calibration.compensation import compensate
from jaximu.calibration.nominal import as_stated
from jaximu.calibration.recipe import Choices, calibrate_ready
from jaximu.calibration.refusals import relative_covariance, require_determined
from jaximu.data.field import EXCESS_NAMES, FieldWindows, MagneticField, windows_of
from jaximu.estimation.fitting import Fit, Prior, fit, informed
from jaximu.estimation.problem import Name
from jaximu.estimation.uncertainty import UNDETERMINED, allowing_for_neighbours
from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import STANDARD, Gravity, LocalGravity, as_gravity
from jaximu.ground.magnetic_field import HIGHEST, LOWEST, FieldStrength
from jaximu.ground.precision import require_float64
from jaximu.ground.quantities import listed
from jaximu.mistakes import Prepared, prepare, prepared
from jaximu.model.effects import Effect
from jaximu.model.sensor import Imu, Triad
from jaximu.recordings.alignment import signed_permutation
from jaximu.recordings.recording import Reading, Recording, Signal

__all__ = ["FieldStrength", "Heading", "MagneticLog", "calibrate_magnetometer", "carried_headings", "ellipsoid",
           "field_advice", "field_start", "heading_errors"]  # fmt: skip

_TYPICAL = 50.0
"""µT, about what the Earth's field has in the middle latitudes: the strength where only counts are known."""
_WEAKEST, _STRONGEST = 22.0, 67.0
_OTHER_UNITS = {"gauss": 100.0, "mgauss": 0.1, "nT": 1e-3, "mT": 1e3}
"""What a magnetometer may be logged in, in µT, and between which the Earth's field lies outdoors, µT."""
_SCALE = 0.05
"""Share by which a data sheet's scale may be off, which the strength then is, too."""
_SHEET_GAIN, _SHEET_BIAS = 0.02, 0.05
"""Scale and misalignment of an accelerometer, and its bias over gravity, by a data sheet (MPU-6050: 3 %, 2 %, 50 mg on
x and y and 80 mg on z at the most)."""
_EXPLAINED = 0.5
"""Share of gravity's turning that the gyroscope must explain for its axes to be taken from it."""
_FOLDS = 5
_DISTURBED = 5.0
"""Standard deviations, by medians, of the strength from which on a stretch is left out."""
_MOST_DISTURBED = 0.3
"""Share of windows of which more are not left out: then it is the model that is wrong."""
_CALM = 0.1
"""Share of gravity by which the specific force may be off where it stands for the vertical."""
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
_GOLDEN = np.pi * (1 + np.sqrt(5))
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
_ALIKE_ERRORS = (
    "the field's strength differs from its mean for seconds at a time, as beside iron or where a sensor drifts: the "
    "intervals allow for it."
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
    whole = [replace(each.recording, magnetometer=each.magnetometer) if each.recording is not None
             else Recording(each.magnetometer, magnetometer=each.magnetometer) for each in logs]  # fmt: skip
    with prepared(whole, magnetometer=True) as ready:
        return _calibrated(
            [_ready(*each) for each in zip(logs, ready, strict=True)], strength, base, gravity, southern,
            _chosen(effects, logs),
        )  # fmt: skip


def _chosen(effects: Sequence[str | Effect], logs: Sequence[MagneticLog]) -> list[Effect]:
    """Return the effects to be fitted. Raises `InputError` for one of another sensor, or whose input logs lack."""
    chosen = [effect_named(each) for each in effects]
    for effect in chosen:
        if effect.owner != "magnetometer":
            raise InputError(f"{effect.name} is no effect of a magnetometer: `jaximu effects` lists those, mag.*.")
        for need, signal in (("temperature", "temperature"), ("current", "current"), ("angular_rate", "gyroscope")):
            lacking = [each for each in logs if each.recording is None or getattr(each.recording, signal) is None]
            if need in effect.needs and lacking:
                raise InputError(f"{lacking[0].name}: {effect.name} needs a {signal}, which this log lacks.")
        if "time" in effect.needs and len(logs) > 1:
            raise InputError(f"{effect.name} is of one recording: give one log.")
    return chosen


def _ready(log: MagneticLog, ready: Prepared) -> MagneticLog:
    """Return a log without rows that are no measurement, of the magnetometer (`ready`) and of the other sensors."""
    other = None if log.recording is None else prepare(log.recording)
    signal = ready.recording.magnetometer
    assert signal is not None
    notes = (*log.notes, *(() if other is None else other.notes), *ready.notes)
    return replace(log, magnetometer=signal, recording=None if other is None else other.recording, notes=notes)


def _calibrated(
    logs: Sequence[MagneticLog],
    strength: FieldStrength | None,
    base: Calibration | None,
    gravity: LocalGravity,
    southern: bool | None,
    effects: Sequence[Effect],
) -> tuple[Calibration, MagneticField, Heading | None]:
    where = ", ".join(each.name for each in logs)
    base, notes = _base(logs, base, gravity)
    unit = _unit(logs, base)
    origin = np.zeros(3) if unit.gyroscope is None else np.asarray(unit.gyroscope.bias, float)
    vertical = _uncertain_force(base)
    parts = [windows_of(each.magnetometer, _corrected(each.recording, unit, base), origin, vertical) for each in logs]
    windows = whole = FieldWindows.joined(parts)
    if southern is None and strength is not None and strength.dip is not None and abs(strength.dip) > _STEEP:
        southern = strength.dip < 0
    start, field, said = _start(logs, windows, strength, unit, southern)
    said += [field.note] if field.note else []
    full, known = not windows.alone, field.value
    found, windows, stretches = _undisturbed(start.with_effects(*effects), windows, field, full)
    if bool(found.finite) and field.dip is not None and _contradicted(found, windows, field):
        stated, field = field.dip, replace(field, dip=None)
        found, windows, stretches = _undisturbed(found.imu, whole, field, full)
        off = abs((_dip(windows, found)[0] or 0.0) - np.radians(stated))
        field = replace(field, sigma=float(np.hypot(field.sigma, known * off)))
        said.append(
            f"the field points {np.degrees(off):.2g}° off the stated dip of {stated:.3g}°: iron nearby bends it, or "
            "the place is another. The dip was not used, and the strength is taken to be off by as much "
            f"({known * off:.2g} µT, one standard deviation): --field states it."
        )
    if bool(found.finite):  # along directions left open a fit may creep until its steps run out
        _require_covered(found, windows, where)
    if bool(found.finite) and not bool(found.converged):
        found = _fitted(found.imu, windows, field, full, np.asarray(found.excess))
        said.append(_UNSETTLED)
    _refuse_changed(found, windows, field, where)
    if not bool(found.converged):
        raise NotPossibleError(
            f"{where}: no one field explains what was recorded, and the fit did not converge. Keep iron, magnets and "
            "currents away, check the columns' unit, and record again."
        )
    require_determined(found, where)
    measurement = _measured(windows, field)
    n = np.arange(len(windows))
    place = n if windows.alone else np.concatenate([n, np.repeat(n, 2), n])
    wider = allowing_for_neighbours(found.covariance, found.sizes, found.residual, found.jacobian, place)
    if wider is not None:
        found = replace(found, covariance=wider)
        said.append(_ALIKE_ERRORS)
    found = informed(found, _data_sheet(found, start))
    covariance = found.total_covariance(field.sigma)
    before, after, algebraic, headings = _left_out(found, start, windows, field, full, _samples(logs, parts))
    dip, dip_sigma = _dip(windows, found)
    readings = (log.reading if log.recording is None else log.recording.reading for log in logs)
    own = concluded(
        found, gravity=gravity, method="magnetometer", loss="linear", excess_names=EXCESS_NAMES,
        rms=[{"field_strength": (_spread(each, windows, known), "uT")} for each in (start, found.imu)],
        data=_data(logs, windows), nominal=start, advice=field_advice,
        notes=[*(note for each in logs for note in each.notes), *notes, *said, *stretches],
        reading=next(filter(None, readings), None if base is None else base.reading),
    )  # fmt: skip
    if headings is not None and headings["after"] > _WORSE * headings["before"]:
        own = replace(own, notes=(*own.notes, _NO_BETTER.format(**headings)))
    if dip is not None and dip < 0 and southern is None:
        own = replace(own, notes=(*own.notes, _UPWARD))
    heading = None if dip is None else heading_errors(own, start, known, dip)
    noise = windows.noise / _scale_of(start) / known
    magnetic: dict[str, Any] = {
        "field": {
            "strength": {"value": known, "sigma": field.sigma, "unit": "uT"},
            "dip": None if dip is None else {"value": np.degrees(dip), "sigma": np.degrees(dip_sigma), "unit": "deg"},
        },
        "heading_error": None if heading is None else {
            "rms": float(np.sqrt(np.mean(heading.sigma[0] ** 2) + heading.scatter**2)),
            "worst": float(np.hypot(heading.sigma.max(), heading.scatter)),
            "before": {"rms": float(np.sqrt(np.mean(heading.before[0] ** 2))), "worst": float(heading.before.max())},
            "left_out": headings,
            "unit": "deg",
        },
        "coverage": coverage(found.imu, windows),
        "norm_spread": {"before": before, "after": after, "algebraic": algebraic, "noise": noise},
        "gyroscope_bias": _gyroscope_bias(own),
        "next": None if dip is None else next_directions(own, measurement, dip),
        "disturbed": whole.time[~windows.used].tolist(),
    }  # fmt: skip
    return _with_base(replace(own, covariance=covariance, magnetic=magnetic), base), measurement, heading


# --- what is known beforehand -----------------------------------------------------------------------------------------


def _base(
    logs: Sequence[MagneticLog], base: Calibration | None, gravity: LocalGravity
) -> tuple[Calibration | None, list[str]]:
    """Return the calibration of accelerometer and gyroscope: given, or of the logs' own poses, or None."""
    recordings = [each.recording for each in logs if each.recording is not None]
    if not recordings:
        return base, []
    found, unusual = base, []
    try:
        if found is None:
            found, unusual = calibrate_ready(recordings, Choices(gravity))
    except (NotPossibleError, InputError) as error:
        reason = str(error).removeprefix(f"{recordings[0].name}: ")
    else:
        if found.rank == len(found.names):
            return found, [each.text for each in unusual]
        whose = "their own calibration" if base is None else "the calibration that was given"
        reason = f"{whose} leaves {len(found.names) - found.rank} of {len(found.names)} parameters open."
    return None, [f"accelerometer and gyroscope are taken as their data sheets say: {reason}"]


def _uncertain_force(base: Calibration | None) -> FloatArray:
    """Return how uncertain the specific force is, as `FieldWindows.vertical`: as calibrated, or by a data sheet."""
    if base is None:
        return np.diag(np.square([_SHEET_GAIN * (i >= j) for i in range(3) for j in range(3)] + 3 * [_SHEET_BIAS]))
    rows = [k for k, name in enumerate(base.names) if name.owner == "accelerometer" and name.effect is None]
    inverse = -np.linalg.inv(np.asarray(base.imu.accelerometer.gain))
    reach = np.zeros((4, 3, len(rows)))  # of a column of B, or of b
    for place, row in enumerate(rows):
        name = base.names[row]
        axis, size = (name.axes[1], 1.0) if name.part == "gain" else (3, 1 / base.gravity.value)
        reach[axis, :, place] = size * inverse[:, name.axes[0]]
    reach = np.concatenate([reach[:3].transpose(1, 0, 2).reshape(9, -1), reach[3]])
    return reach @ base.covariance[np.ix_(rows, rows)] @ reach.T


def _unit(logs: Sequence[MagneticLog], base: Calibration | None) -> Imu:
    """Return accelerometer and gyroscope as they are known: calibrated, or by the data sheet, axes as gravity shows."""
    recording = logs[0].recording
    if base is not None:
        return base.imu.transferable()
    if recording is None:
        return Imu.nominal()
    unit, found = as_stated(recording), recording.turning
    if found is None or found.explained < _EXPLAINED or unit.gyroscope is None:
        return unit
    if found.correlation > 0 and found.correlation**2 > _EXPLAINED * found.explained:
        return unit  # as the data sheet has it: an axis that hardly turned gravity must not be turned round
    gain = np.asarray(unit.gyroscope.gain) @ signed_permutation(found.matrix).T
    return replace(unit, gyroscope=replace(unit.gyroscope, gain=gain))


def _corrected(recording: Recording | None, unit: Imu, base: Calibration | None) -> Recording | None:
    """Return a recording in SI without what is known of the sensors' errors."""
    if recording is None:
        return None
    if base is not None:
        return compensate(base, recording)
    changed: dict[str, Any] = {}
    for name, si in (("accelerometer", "m/s^2"), ("gyroscope", "rad/s")):
        triad, signal = unit.triads().get(name), getattr(recording, name)
        if triad is not None and signal is not None:
            values = np.linalg.solve(np.asarray(triad.gain), (signal.values - np.asarray(triad.bias)).T).T
            changed[name] = Signal(signal.time, values, si)
    return replace(recording, **changed)


def ellipsoid(values: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return shape A (3, 3), symmetric, and centre b (3,) with |A (y − b)| ≈ 1 of points (n, 3), by linear algebra.

    The algebraic fit that most tools use: it weighs errors by their place and is biased by noise. None where the points
    lie on no ellipsoid.
    """
    centre, size = values.mean(axis=0), float(np.std(values))
    x, y, z = ((values - centre) / size).T
    design = np.stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z], axis=1)
    p = np.linalg.lstsq(design, np.ones(len(design)), rcond=None)[0]
    shape = np.array([[p[0], p[3], p[4]], [p[3], p[1], p[5]], [p[4], p[5], p[2]]])
    if np.linalg.cond(shape) > 1e6:
        return None
    middle = -np.linalg.solve(shape, p[6:])
    squares, vectors = np.linalg.eigh(shape / (1 + middle @ shape @ middle))
    if squares.min() <= 0:
        return None
    return (vectors * np.sqrt(squares)) @ vectors.T / size, centre + size * middle


def _start(
    logs: Sequence[MagneticLog], windows: FieldWindows, strength: FieldStrength | None, unit: Imu,
    southern: bool | None,
) -> tuple[Imu, FieldStrength, list[str]]:  # fmt: skip
    """Return the unit that the fit starts from, the field's strength, and what had to be chosen."""
    signal = logs[0].magnetometer
    if any(each.magnetometer.unit != signal.unit for each in logs):
        raise InputError("the logs give the magnetometer in different units; state the same for all.")
    carried = _carried_centre(windows) if windows.turn.any() else None
    scale, centre, field, said = field_start(windows.output, signal.unit, strength, logs[0].name, carried)
    turn = _axes(windows, centre, southern)
    if not np.array_equal(turn, np.eye(3)):
        names = [("+" if sum(row) > 0 else "−") + "xyz"[int(np.flatnonzero(row)[0])] for row in turn]
        said.append(
            f"the magnetometer's x, y and z lie along the unit's {', '.join(names)}: the gain says so, and nothing has "
            "to be turned."
        )
    triad = Triad(scale * turn, np.asarray(centre, float), quantity="magnetic_field", output_unit=signal.unit)
    return jax.tree.map(np.asarray, replace(unit.with_effects(), magnetometer=triad)), field, said


def field_start(
    output: FloatArray, unit: str, strength: FieldStrength | None, where: str, carried: FloatArray | None = None
) -> tuple[float, FloatArray, FieldStrength, list[str]]:
    """Return where a fit of the field's strength starts: scale (output units to a µT), hard iron (3,), field, notes.

    output (n, 3): in `unit`; `carried`: the hard iron (3,) that something else tells, for outputs on no ellipsoid.
    A strength of which nothing is known is what the data sheet's scale says, to five per cent. Raises
    `NotPossibleError` where outputs are on no sphere of the Earth's field.
    """
    shape = ellipsoid(output)
    if shape is not None and _plausible(shape, output):
        centre, radius = shape[1], 1 / np.cbrt(np.linalg.det(shape[0]))
    else:
        centre = carried if carried is not None else output.mean(axis=0)
        radius = float(np.median(np.linalg.norm(output - centre, axis=1)))
    if unit == "uT":
        if not LOWEST < radius < HIGHEST:
            _refuse_size(radius, strength, where)
        return 1.0, centre, FieldStrength(radius, _SCALE * radius) if strength is None else strength, []
    if strength is not None:
        return radius / strength.value, centre, strength, []
    said = (
        f"the field's strength is taken as {_TYPICAL:g} µT: {unit} show none. --field states it; headings do not "
        "depend on it."
    )
    return radius / _TYPICAL, centre, FieldStrength(_TYPICAL, 0.3 * _TYPICAL), [said]


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
    """Whether an ellipsoid is one that points determine: not far off, nor much longer one way than another."""
    lengths = np.linalg.eigvalsh(shape[0])
    radius = 1 / np.cbrt(np.prod(lengths))
    return bool(lengths.max() < 3 * lengths.min() and np.ptp(output, axis=0).max() > 0.8 * radius)


def _carried_centre(windows: FieldWindows) -> FloatArray:
    """Hard iron (3,) that the gyroscope tells by itself: R (y₂ − b) = y₁ − b, linear in b."""
    at = np.flatnonzero(windows.turn)
    turned = windows.carried[at]
    target = windows.output[at] - np.einsum("nij,nj->ni", turned, windows.output[at + 1])
    return np.linalg.lstsq((np.eye(3) - turned).reshape(-1, 3), target.reshape(-1), rcond=1e-6)[0]


def _axes(windows: FieldWindows, centre: FloatArray, southern: bool | None) -> FloatArray:
    """Return the signed permutation (3, 3) that takes the field in the unit's axes to the magnetometer's.

    Nothing tells a magnetometer from one with all axes turned round but the hemisphere: without it the right-handed
    one is taken.
    """
    if windows.alone:
        return np.eye(3)
    field = windows.output - centre
    choices = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            if np.linalg.det(turn) > 0:
                choices.append(turn)
    costs = []
    for turn in choices:
        body = field @ turn  # turnᵀ applied to every row
        length = np.linalg.norm(body, axis=1)
        moved = np.einsum("nij,nj->ni", windows.carried, np.roll(body, -1, axis=0)) - body
        cost = 0.0
        if windows.turn.any():
            cost += float(np.mean(np.sum(moved[windows.turn] ** 2, axis=1))) / float(np.mean(length**2))
        if windows.level.any():
            calm = windows.level & (windows.off < _CALM)
            cost += float(np.var(np.sum(windows.up[calm] * body[calm], axis=1) / length[calm])) if calm.any() else 0.0
        costs.append(cost)
    best = choices[int(np.argmin(costs))]
    if min(costs) > 0.8 * costs[[np.array_equal(each, np.eye(3)) for each in choices].index(True)]:
        best = np.eye(3)
    if southern is not None and windows.level.any():
        dip = np.median(np.sum(windows.up * (field @ best), axis=1)[windows.level])
        best = -best if (dip > 0) != southern else best
    return best


# --- the fit ----------------------------------------------------------------------------------------------------------


_UPPER = ((0, 1), (0, 2), (1, 2))


def _measured(windows: FieldWindows, field: FieldStrength) -> MagneticField:
    dip = None if field.dip is None else (float(np.radians(field.dip)), float(np.radians(field.dip_sigma)))
    return MagneticField(windows, field.value, dip)


def _fitted(
    start: Imu, windows: FieldWindows, field: FieldStrength, full: bool, excess: FloatArray | None = None,
    loss: str = "linear",
) -> Fit:  # fmt: skip
    """Fit the magnetometer, all of its gain where its axes can be told, else a lower triangle as by hand; and the
    gyroscope's bias.
    """

    def free(name: Name) -> bool:
        if name.owner == "gyroscope":  # a bias that was another on that day would turn the carried field
            return name.part == "bias" and bool(windows.turn.any())
        whole = full or name.part == "bias" or name.effect is not None or name.axes not in _UPPER
        return name.owner == "magnetometer" and whole

    return fit(start, _measured(windows, field), free, follow=True, excess=excess, loss=loss,
               estimate_excess=excess is None)  # fmt: skip


def _data_sheet(found: Fit, start: Imu) -> Prior:
    """What is known of gains beforehand: those that the fit started from, about as well as a data sheet's scale."""
    names = tuple(name for name in found.names if name.owner == "magnetometer" and name.part == "gain")
    assert start.magnetometer is not None
    gain = np.asarray(start.magnetometer.gain)
    return Prior(names, np.array([gain[name.axes] for name in names]),
                 np.eye(len(names)) / (_SCALE * _scale_of(start)))  # fmt: skip


def _scale_of(imu: Imu) -> float:
    """Output units of the magnetometer to a µT."""
    assert imu.magnetometer is not None
    return float(np.mean(np.linalg.norm(np.asarray(imu.magnetometer.gain), axis=1)))


def _strengths(imu: Imu, output: FloatArray) -> FloatArray:
    """Strength (n,) of the field, µT, that outputs (n, 3) mean."""
    assert imu.magnetometer is not None
    gain, bias = np.asarray(imu.magnetometer.gain), np.asarray(imu.magnetometer.bias)
    return np.linalg.norm(np.linalg.solve(gain, (output - bias).T), axis=0)


def _spread(imu: Imu, windows: FieldWindows, strength: float) -> float:
    return float(np.sqrt(np.mean((np.linalg.norm(windows.field(imu)[windows.used], axis=1) - strength) ** 2)))


def _contradicted(found: Fit, windows: FieldWindows, field: FieldStrength) -> bool:
    """Whether the field leaves the stated dip, which was part of the fit, by more than it may.

    Where nothing else determines it, the dip stays where it was stated: no contradiction.
    """
    dip, sigma = _dip(windows, found)
    assert field.dip is not None
    allowed = _CONTRADICTED * np.hypot(field.dip_sigma, np.degrees(sigma))
    return dip is not None and abs(np.degrees(dip) - field.dip) > allowed


def _undisturbed(
    start: Imu, windows: FieldWindows, field: FieldStrength, full: bool
) -> tuple[Fit, FieldWindows, list[str]]:
    """Return the fit, the windows without those in which something disturbs the field, and when that was."""
    whole = windows
    found = _fitted(start, windows, field, full, loss="cauchy")  # else a stretch pulls the fit to where it hides
    for number in range(1 + _ROUNDS):
        far = _disturbed(found.imu, windows, whole) if bool(found.finite) else ~windows.used
        far = far if far.mean() <= _MOST_DISTURBED else ~windows.used
        if number and np.array_equal(far, ~windows.used):
            break
        windows = whole.without(far)
        found = _fitted(start, windows, field, full)  # along what is open the first one may have crept away
    left = ~windows.used
    if not left.any():
        return found, windows, []
    return (
        found,
        windows,
        [
            f"the field is disturbed in {left.sum()} of {len(left)} windows, "
            f"{_spans(whole.time[left])}; they were left out. Iron, a magnet or a current came near."
        ],
    )


def _disturbed(imu: Imu, windows: FieldWindows, whole: FieldWindows) -> NDArray[np.bool_]:
    """Return in which of `whole` (n,) the field is another than in `windows`, by its strength or its angle to gravity.

    What is next to such a window is asked at a lower level, and what lies between two is one, too: a disturbance that
    turns past the field changes for a moment neither.
    """
    field = whole.field(imu)
    length = np.linalg.norm(field, axis=1)
    noise = whole.noise / _scale_of(imu) / np.sqrt(np.median(whole.count))
    dip = np.sum(whole.up * field, axis=1) / length
    size = np.zeros(len(whole))
    for values, known, least in ((length, whole.used, noise),
                                 (dip, whole.level & (whole.off < _CALM), noise / np.median(length))):  # fmt: skip
        usual = known & windows.used
        if usual.any():
            off = np.where(known, np.abs(values - np.median(values[usual])), 0.0)
            size = np.maximum(size, off / max(1.4826 * np.median(off[usual]), least))
    far = scipy.ndimage.binary_propagation(size > _DISTURBED, mask=size > _BESIDE)
    return far | scipy.ndimage.binary_closing(far, np.ones(_BETWEEN))


def _refuse_changed(found: Fit, windows: FieldWindows, field: FieldStrength, where: str) -> None:
    """Refuse a field that was of one strength first and of another then, as two places have it."""
    seen = np.linalg.norm(windows.field(found.imu), axis=1)[windows.used]
    least = max(len(seen) // 10, 2)
    if not np.isfinite(seen).all() or len(seen) < 4 * least:
        return
    count, total = np.arange(1, len(seen)), np.cumsum(seen)
    first, then = total[:-1] / count, (total[-1] - total[:-1]) / (len(seen) - count)
    gain = (count * (len(seen) - count) * (then - first) ** 2)[least - 1 : 1 - least]
    place = int(np.argmax(gain)) + least - 1
    scatter = np.std(seen - np.where(np.arange(len(seen)) <= place, first[place], then[place]))
    step = abs(then[place] - first[place])
    if step > max(_STEP * field.value, _CLEAR * scatter):
        raise NotPossibleError(
            f"{where}: the field is of {first[place]:.3g} µT until {windows.time[windows.used][place, 1]:.1f} s and of "
            f"{then[place]:.3g} µT after: it changed, or the unit was carried elsewhere. Calibrate on one of the parts."
        )


def _spans(times: FloatArray, shown: int = 5) -> str:
    """Name stretches (k, 2) of time, neighbours as one."""
    joined: list[list[float]] = []
    for start, stop in times:
        if joined and 0 <= start - joined[-1][1] < 1.0:
            joined[-1][1] = stop
        else:
            joined.append([start, stop])
    words = [f"{start:.1f} to {stop:.1f} s" for start, stop in joined[:shown]]
    return ", ".join(words) + (f" and {len(joined) - shown} more stretches" if len(joined) > shown else "")


def _samples(logs: Sequence[MagneticLog], parts: Sequence[FieldWindows]) -> list[FloatArray]:
    """Return the samples (m, 3) of each window, those included that no mean took."""
    found = []
    for log, part in zip(logs, parts, strict=True):
        edges = np.searchsorted(log.magnetometer.time, part.time)
        found += [log.magnetometer.values[first : last + 1] for first, last in edges]
    return found


def _require_covered(found: Fit, windows: FieldWindows, where: str) -> None:
    """Refuse what is no calibration: hard iron left open, or by itself more than a third of the parameters."""
    covariance = relative_covariance(found)
    left = int(np.sum(np.linalg.eigvalsh(covariance) > UNDETERMINED**2))
    iron = [place for place, name in enumerate(found.names) if name.owner == "magnetometer" and name.part == "bias"]
    iron_open = bool(np.linalg.eigvalsh(covariance[np.ix_(iron, iron)])[-1] > UNDETERMINED**2)
    share = 100 * coverage(found.imu, windows)
    if iron_open or (windows.alone and left > len(found.names) // 3) or (not bool(found.converged) and share < 50):
        raise NotPossibleError(
            f"{where}: the field was seen from {share:.0f} % of all directions, which leaves "
            f"{_open_words(found.names, np.diagonal(covariance) > UNDETERMINED**2)} open. {_RECORD}"
        )


def _open_words(names: Sequence[Name], wide: NDArray[np.bool_]) -> str:
    """Name what is known no better than from the data sheet; where no number is by itself, their combinations."""
    axes: dict[str, list[str]] = {}
    for name, open_ in zip(names, wide, strict=True):
        if not open_:
            continue
        first = "xyz"[name.axes[0]]
        part = "hard iron along" if name.part == "bias" else "the scale of" if name.axes[0] == name.axes[-1] else ""
        if name.owner == "gyroscope":
            part = "the gyroscope's bias about"
        axes.setdefault(part or "soft iron and alignment of", []).append(first)
    if not axes:
        return "combinations of hard iron, soft iron and scale"
    return listed([f"{part} {listed(list(dict.fromkeys(each)))}" for part, each in axes.items()])


def _left_out(
    whole: Fit, start: Imu, windows: FieldWindows, field: FieldStrength, full: bool, samples: Sequence[FloatArray]
) -> tuple[float, float, float | None, dict[str, float] | None]:
    """Spread of the samples' strength over its mean on fifths left out: raw, calibrated, by the algebraic ellipsoid;
    and by how many degrees (rms) the heading leaves the gyroscope's there, raw and calibrated.
    """
    fold = np.minimum(np.arange(len(windows)) * _FOLDS // len(windows), _FOLDS - 1)
    found: dict[str, list[FloatArray]] = {"before": [], "after": [], "algebraic": []}
    headings: dict[str, list[FloatArray]] = {"before": [], "after": []}
    extended = bool(whole.imu.all_effects())
    raw = replace(start, magnetometer=replace(start.magnetometer, bias=np.zeros(3)))  # pyright: ignore
    for place in range(_FOLDS):
        own = (fold == place) & windows.used
        rest = windows.without(fold == place)
        if not own.any() or rest.used.sum() < 12:
            continue
        fitted = _fitted(whole.imu, rest, field, full, np.asarray(whole.excess))
        own_model = informed(fitted, _data_sheet(fitted, start)).imu
        for imu, errors in zip((raw, own_model), headings.values(), strict=True):
            errors.append(carried_headings(windows, imu, np.flatnonzero(fold == place)))
        output = np.concatenate([samples[k] for k in np.flatnonzero(own).tolist()])
        shape = ellipsoid(np.concatenate([samples[k] for k in np.flatnonzero(rest.used).tolist()]))
        found["before"].append(_strengths(raw, output))
        if extended:  # what they add is known where the windows have their samples
            inside = np.asarray(windows.samples.track.observation)[own] < len(windows)
            output = (windows.samples.output - windows.added(own_model))[own][inside]
        found["after"].append(_strengths(own_model, output))
        if shape is not None:
            found["algebraic"].append(np.linalg.norm((output - shape[1]) @ shape[0], axis=1))
    spread = {name: _relative(parts) for name, parts in found.items()}
    off = {name: np.concatenate([np.zeros(0), *parts]) for name, parts in headings.items()}
    turned = {name: float(np.degrees(np.sqrt(np.mean(each**2)))) for name, each in off.items() if len(each)}
    return spread["before"] or 0.0, spread["after"] or 0.0, spread["algebraic"], turned or None


def _relative(parts: Sequence[FloatArray]) -> float | None:
    if not parts:
        return None
    values = np.concatenate(parts)
    return float(np.std(values) / np.mean(values))


def carried_headings(windows: FieldWindows, imu: Imu, rows: NDArray[np.int64]) -> FloatArray:
    """Return by how much (rad) the heading of each calm window leaves the one that the gyroscope carries.

    rows: windows in order. Less a straight line, for the gyroscope's bias, over each recording.
    """
    joints = np.flatnonzero((windows.swept[rows[:-1]] == 0).all(axis=(1, 2))) + 1  # nothing carries to another log
    field = windows.field(imu)
    found = [np.zeros(0)]
    for part in np.split(rows, joints):
        up, calm = windows.up[part], (windows.used & windows.level & (windows.off < _CALM))[part]
        if not windows.turn.any() or calm.sum() < _FEWEST_HEADINGS:
            continue
        east = np.cross(field[part], up)
        east /= np.linalg.norm(east, axis=1, keepdims=True)
        level = np.stack([east, np.cross(up, east), up], axis=1)
        carried, yaw = level[0], []
        for frame, row in zip(level, part, strict=True):
            turn = frame @ carried.T
            yaw.append(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
            carried = carried @ windows.carried[row]
        time = windows.time[part].mean(axis=1)
        design = np.stack([np.ones(len(time)), time - time.mean()], axis=1)[calm]
        angle = np.unwrap(yaw)[calm]
        found.append(angle - design @ np.linalg.lstsq(design, angle, rcond=None)[0])
    return np.concatenate(found)


# --- what it means ----------------------------------------------------------------------------------------------------


def _directions(count: int) -> FloatArray:
    """Directions (n, 3) evenly over the sphere (a spiral)."""
    k = np.arange(count) + 0.5
    height = 1 - 2 * k / count
    across = np.sqrt(1 - height**2)
    return np.stack([across * np.cos(_GOLDEN * k), across * np.sin(_GOLDEN * k), height], axis=1)


def coverage(imu: Imu, windows: FieldWindows) -> float:
    """Return the share of all directions that the field had, in the magnetometer's axes, to within 15°."""
    field = windows.field(imu)[windows.used]
    field /= np.linalg.norm(field, axis=1, keepdims=True)
    return float(np.mean((_directions(400) @ field.T).max(axis=1) > _NEAR))


def _dip(windows: FieldWindows, found: Fit) -> tuple[float | None, float]:
    """The angle (rad) of the field below the level, and its standard deviation."""
    calm = windows.level & (windows.off < _CALM)
    if not calm.any():
        return None, 0.0
    field = windows.field(found.imu)
    sine = -np.sum(windows.up * field, axis=1)[calm] / np.linalg.norm(field, axis=1)[calm]
    dip = float(np.arcsin(np.clip(np.median(sine), -1, 1)))
    spread = 1.4826 * float(np.median(np.abs(sine - np.median(sine)))) / max(np.cos(dip), 0.05)
    bent = windows.bent(field)[calm].mean(axis=0)
    common = np.sqrt(bent @ windows.vertical @ bent) / max(np.cos(dip), 0.05)
    return dip, float(np.hypot(spread / np.sqrt(max(calm.sum() / 4, 1)), common))  # neighbours share their errors


def heading_errors(calibration: Calibration, start: Imu, strength: float, dip: float) -> Heading:
    """Return how uncertain the heading is by attitude, and how wrong it was without calibration.

    Of a unit whose vertical is known: its field is turned level by the true attitude, and what is wrong of its
    horizontal part across north is the error.
    """
    from scipy.spatial.transform import Rotation

    headings = np.arange(0.0, 360.0, 15.0)
    tilts = np.array([[0.0, 0.0], [45.0, 0.0], [-45.0, 0.0], [0.0, 45.0], [0.0, -45.0], [180.0, 0.0]])
    triad = calibration.imu.magnetometer
    assert triad is not None and start.magnetometer is not None
    gain, bias = np.asarray(triad.gain), np.asarray(triad.bias)
    north = strength * np.array([0.0, np.cos(dip), -np.sin(dip)])  # x east, y north, z up
    angles = np.concatenate([np.broadcast_to(headings[:, None, None], (len(headings), len(tilts), 1)),
                             np.broadcast_to(tilts[None], (len(headings), len(tilts), 2))], axis=2)  # fmt: skip
    attitude = Rotation.from_euler("ZYX", angles.reshape(-1, 3)[:, [0, 2, 1]], degrees=True)
    body = attitude.inv().apply(north)
    output = body @ gain.T + bias
    east = attitude.inv().apply([1.0, 0.0, 0.0]) / (strength * np.cos(dip))  # of an error of the field: of the heading
    rows = [k for k, name in enumerate(calibration.names) if name.owner == "magnetometer" and name.effect is None]
    slope = np.einsum("ni,nik->nk", east, _reactions([calibration.names[row] for row in rows], body, gain))
    covariance = calibration.covariance[np.ix_(rows, rows)]
    sigma = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", slope, covariance, slope), 0.0))
    raw = np.linalg.solve(np.asarray(start.magnetometer.gain), output.T).T
    level = attitude.apply(raw)
    off = np.abs(np.arctan2(level[:, 0], level[:, 1]))
    scatter = np.sqrt(calibration.excess.get(EXCESS_NAMES[0], 0.0)) * 0.1 / (strength * np.cos(dip))
    shape = (len(headings), len(tilts))
    return Heading(
        headings,
        tilts,
        np.degrees(sigma.reshape(shape).T),
        np.degrees(off.reshape(shape).T),
        float(np.degrees(scatter)),
    )


def _reactions(names: Sequence[Name], field: FloatArray, gain: FloatArray) -> FloatArray:
    """How an output, turned back into a field (n, 3), reacts to gain and bias (n, 3, p), but for the sign."""
    change = np.zeros((len(field), 3, len(names)))
    for k, name in enumerate(names):
        change[:, name.axes[0], k] = 1.0 if name.part == "bias" else field[:, name.axes[1]]
    return np.einsum("ij,njk->nik", np.linalg.inv(gain), change)


def next_directions(own: Calibration, measurement: MagneticField, dip: float, count: int = 6) -> dict[str, Any]:
    """Return where the field should be seen next, in the unit's axes, and what that buys a level heading.

    `own`: fitted to `measurement`; `dip`: rad. One after another the direction whose strength, measured as well as the
    others, takes most off the variance of level headings, all headings alike. In the result `directions` (count, 3),
    and `heading_now`, `heading_then`, degrees, one sigma of what is uncertain of the parameters.
    """
    found, triad, strength = own.fit, own.imu.magnetometer, measurement.strength
    assert found is not None and triad is not None
    gain, windows = np.asarray(triad.gain), measurement.windows
    rows = [k for k, name in enumerate(found.names) if name.owner == "magnetometer" and name.effect is None]
    names, spread = [found.names[row] for row in rows], np.array(found.covariance)[np.ix_(rows, rows)]
    angle = np.radians(np.arange(0.0, 360.0, 15.0))
    level = np.stack([np.cos(dip) * np.sin(angle), np.cos(dip) * np.cos(angle), np.full(len(angle), -np.sin(dip))], 1)
    east = np.stack([np.cos(angle), -np.sin(angle), np.zeros(len(angle))], 1) / (strength * np.cos(dip))
    heading = np.einsum("ni,nik->nk", east, _reactions(names, strength * level, gain))
    grid = _directions(200)
    white = windows.noise / _scale_of(own.imu) / np.sqrt(np.median(windows.count))
    sigma = np.hypot(white, 0.1 * np.sqrt(own.excess.get(EXCESS_NAMES[0], 0.0)))
    seen = np.einsum("ni,nik->nk", grid, _reactions(names, strength * grid, gain)) / sigma

    def good() -> float:
        return float(np.degrees(np.sqrt(np.mean(np.einsum("np,pq,nq->n", heading, spread, heading)))))

    before, chosen = good(), []
    for _ in range(count):
        known = seen @ spread
        gains = np.sum((known @ heading.T) ** 2, axis=1) / (1 + np.sum(known * seen, axis=1))
        best = int(np.argmax(gains))
        chosen.append(grid[best].tolist())
        spread -= np.outer(known[best], known[best]) / (1 + known[best] @ seen[best])
    return {"directions": chosen, "heading_now": before, "heading_then": good(), "unit": "deg"}


def field_advice(vector: FloatArray, names: Sequence[Name], sizes: FloatArray, model: Imu) -> str:
    """Say how to hold the unit for what is open: where the field's strength changes most, or its angle to gravity."""
    assert model.magnetometer is not None
    inverse = np.linalg.inv(np.asarray(model.magnetometer.gain))
    change, shift, drift = np.zeros((3, 3)), np.zeros(3), 0.0
    for name, weight, size in zip(names, vector, np.asarray(sizes), strict=True):
        if name.effect is None and name.owner == "magnetometer":
            (change if name.part == "gain" else shift)[name.axes] += weight * size
        drift += weight**2 if name.owner == "gyroscope" else 0.0
    if drift > 0.5:
        return "half a minute at rest, for the gyroscope's bias."
    change, shift = inverse @ change, inverse @ shift / _TYPICAL
    grid = _directions(200)
    strength = np.abs(np.einsum("ni,ij,nj->n", grid, change, grid) + grid @ shift)
    turn = 0.5 * (change[[2, 0, 1], [1, 2, 0]] - change[[1, 2, 0], [2, 0, 1]])
    if np.linalg.norm(turn) > 1.5 * strength.max():  # up · (turn × field) is largest where the turn's axis points east
        return f"rests in which the unit's {_longest(turn)} axis lies level and points east, and rests with it west."
    best = _longest(grid[int(np.argmax(strength))])
    return f"turns in which the unit's {best} axis points along the field and against it."


def _longest(direction: FloatArray) -> str:
    return "xyz"[int(np.argmax(np.abs(direction)))]


def _data(logs: Sequence[MagneticLog], windows: FieldWindows) -> dict[str, Any]:
    recordings = [each.recording for each in logs if each.recording is not None]
    found = provenance(recordings) if recordings else {"file": logs[0].name}
    return found | {"windows": int(windows.used.sum())}


def _gyroscope_bias(own: Calibration) -> dict[str, Any] | None:
    """Return the gyroscope's bias (3), output units, that the carried field tells."""
    rows = [place for place, name in enumerate(own.names) if name.owner == "gyroscope"]
    if not rows or own.imu.gyroscope is None:
        return None
    sigma = np.sqrt(np.diagonal(own.covariance))[rows]
    return {"value": np.asarray(own.imu.gyroscope.bias).tolist(), "sigma": sigma.tolist(),
            "unit": own.imu.gyroscope.output_unit}  # fmt: skip


def _with_base(own: Calibration, base: Calibration | None) -> Calibration:
    """Return the magnetometer's calibration, beside that of the other sensors where it took one as known."""
    rows = [place for place, name in enumerate(own.names) if name.owner == "magnetometer"]
    names, covariance = tuple(own.names[place] for place in rows), own.covariance[np.ix_(rows, rows)]
    joined, rank = own, own.rank - (len(own.names) - len(rows))
    if base is not None:
        names, rank = (*base.names, *names), base.rank + rank
        covariance = scipy.linalg.block_diag(base.covariance, covariance)
        joined = replace(
            own,
            imu=replace(base.imu, magnetometer=own.imu.magnetometer),
            weak=(*base.weak, *own.weak),
            excess={**base.excess, **own.excess},
            rms={**base.rms, **own.rms},
            notes=tuple(dict.fromkeys((*base.notes, *own.notes))),
        )
    known = {name.owner for name in names}  # a base may be a definition, of which nothing is uncertain
    absent = tuple(name for name in joined.imu.triads() if name not in known)
    return replace(joined, names=names, covariance=covariance, rank=rank, absent=absent)
