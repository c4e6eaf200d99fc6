"""What moved between calibrations of one unit: each number, each kind together, and what it does to the output.

Calibrations are put on one footing (`jaximu.acceptance.epochs`); what all of them determine is compared. Recordings are
independent, so the covariance of n calibrations is block diagonal, but for gravity's error, which those share that
state the same gravity: it drops out of their differences. χ² of values being the same, of every number, every kind and
all together; every number's p-value with all of them allowed for (Holm). Over dates each number has a line, whose slope
is its drift (`jaximu.acceptance.trend`), and which says when a limit's guard band is reached.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date, timedelta
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaximu.acceptance.decision import Rule
from jaximu.acceptance.epochs import Epoch, epochs_of, over_temperature, owner_of, require_apart
from jaximu.acceptance.limits import OF_ONE_UNIT, OUTPUTS, Limit, Limits, Scales
from jaximu.acceptance.quantities import output_stimulus
from jaximu.acceptance.trend import Sameness, StraightLine, sameness
from jaximu.acceptance.words import parts_of, si_unit
from jaximu.calibration import Calibration
from jaximu.calibration.calibration import require_calibration
from jaximu.estimation.problem import flatten, names_of
from jaximu.estimation.projection import output_error
from jaximu.ground import stored
from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import holm, rms
from jaximu.ground.document import SOFTWARE, Document, Json, entries
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.page import Result
from jaximu.ground.precision import require_float64
from jaximu.ground.quantities import listed
from jaximu.ground.units import INERTIAL_QUANTITIES, SENSOR_QUANTITIES, SENSOR_UNITS, STANDARD_GRAVITY
from jaximu.ground.vectors import lengths_of, submatrix
from jaximu.model.effects import CATALOGUE, Effect
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus

SCHEMA = "jaximu.compare/1"
RATE = float(np.radians(250.0))
"""Angular rate, rad/s, up to which a gyroscope's output is compared unless another is stated; as exports have it."""
_YEAR = 365.25  # days


@dataclass(frozen=True)
class Movement:
    """One number through all calibrations, in SI.

    values, sigmas: (n,) with all uncertainty. apart: (n,) the same without an error of gravity that all share.
    difference, sigma: last − first, without what both share. tested: False for a gyroscope's bias, another after every
    power-on. p_value: of one and the same value in all; adjusted: with all numbers that are tested allowed for. line:
    over time.
    """

    name: str
    unit: str
    values: tuple[float, ...]
    sigmas: tuple[float, ...]
    apart: tuple[float, ...]
    difference: float
    sigma: float
    p_value: float
    line: StraightLine
    tested: bool = True
    adjusted: float = 1.0
    moved: bool = False

    @property
    def z(self) -> float:
        """The difference in standard deviations."""
        return self.difference / self.sigma

    def document(self, per: str) -> Json:
        """Return it as JSON has it; `per`: unit of time."""
        return {
            **entries(self, "name", "unit", "values", "sigmas", "difference", "sigma", "z", "p_value"),
            **entries(self, "moved", "tested"),
            "p_value_all_allowed_for": self.adjusted if self.tested else None,
            "drift": self.line.document() | {"unit": f"{self.unit} per {per}"},
        }


@dataclass(frozen=True)
class OutputChange:
    """What the first calibration makes of the output of the unit as the last has it, less the truth; SI.

    worst, sigma: largest in any direction at an input of `over`, and its uncertainty along it; rms: over directions;
    expected: what the uncertainty of both alone makes of the rms.
    """

    worst: float
    sigma: float
    rms: float
    expected: float
    over: float
    unit: str


@dataclass(frozen=True)
class LimitReached:
    """After how long since the last calibration a number is within the guard band of a limit; None: it never is."""

    name: str
    limit: Limit
    after: float | None


@dataclass(frozen=True, repr=False, eq=False)
class UnitHistory(Result, Document, page="history"):
    """Calibrations of one unit in order, and what moved.

    times: (n,) since the last, in `per` ("year", or "step" where dates are not known). dates: of each, None where not
    known. together: χ² of each kind of number, and "all" of those that are tested. output: by triad. left_out: what was
    not compared, and why, in sentences. level: rate of false alarms where nothing moved, half of it for each number by
    itself (all allowed for), half for all together.
    """

    files: tuple[str, ...]
    times: FloatArray
    per: str
    dates: tuple[date | None, ...]
    temperatures: tuple[float | None, ...]
    movements: tuple[Movement, ...]
    together: dict[str, Sameness]
    output: dict[str, OutputChange]
    limits: tuple[LimitReached, ...] = ()
    limits_file: str = ""
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    level: float = 0.05

    @property
    def moved(self) -> tuple[Movement, ...]:
        """The numbers that moved, the surest first."""
        moved = (movement for movement in self.movements if movement.moved)
        return tuple(sorted(moved, key=lambda movement: movement.p_value))

    @property
    def verdict(self) -> str:
        """`moved` where any number did or all together did; `same` where nothing shows."""
        return "moved" if self.moved or self.together["all"].p_value < self.level / 2 else "same"

    @property
    def interval(self) -> float | None:
        """The time until the first limit's guard band is reached, None where none ever is or none was stated."""
        return min((limit.after for limit in self.limits if limit.after is not None), default=None)

    def due(self, after: float) -> date | None:
        """Return the date a time after the last calibration, None where dates are not known or it is beyond them."""
        last = self.dates[-1]
        try:
            return None if last is None or self.per != "year" else last + timedelta(days=_YEAR * after)
        except OverflowError:
            return None

    def document(self) -> Json:
        """Return the comparison as the JSON document of schema `jaximu.compare/1`."""

        def reached(limit: LimitReached) -> Json:
            low, high = (end if np.isfinite(end) else None for end in (limit.limit.low, limit.limit.high))
            due = None if limit.after is None else self.due(limit.after)
            about = {"low": low, "high": high, "unit": limit.limit.unit, "date": due and due.isoformat()}
            return entries(limit, "name", "after") | about

        columns = zip(self.files, self.times.tolist(), self.dates, self.temperatures, strict=True)
        return {
            "schema": SCHEMA,
            **entries(self, "verdict", "level", "notes"),
            "calibrations": [
                {"file": file, "time": time, "date": day and day.isoformat(), "temperature": temperature}
                for file, time, day, temperature in columns
            ],
            "time_unit": self.per,
            "together": {name: test.document() for name, test in self.together.items()},
            "moved": [movement.name for movement in self.moved],
            "parameters": [movement.document(self.per) for movement in self.movements],
            "output": {name: vars(change) for name, change in self.output.items()},
            "limits": {
                "file": self.limits_file or None,
                "calibration_interval": self.interval,
                "items": [reached(limit) for limit in self.limits],
            },
            "not_compared": list(self.left_out),
            "software": SOFTWARE,
        }


def compare(
    *calibrations: Calibration,
    dates: Sequence[str | date] | None = None,
    limits: Limits | None = None,
    rate: float = RATE,
    level: float = 0.05,
    files: Sequence[str] = (),
) -> UnitHistory:
    """Return what moved between two calibrations of a unit, or over its history.

    **Arguments:**

    - `dates`: of each calibration, as "2026-03-04"; those that calibrations state (`trace`) otherwise. Without dates
      they are a step apart, in the order given.
    - `limits`: as `read_limits` reads them; of each the time is worked out until its guard band is reached.
    - `rate`: angular rate up to which the gyroscope's output is compared, rad/s; the accelerometer's is at 1 g.
    - `level`: rate of false alarms where nothing moved.
    - `files`: what the calibrations are called.

    Raises `InputError` for fewer than two calibrations, one given twice, or dates that do not fit them;
    `NotPossibleError` where two rest on one recording or nothing can be compared.
    """
    require_float64()
    for calibration in calibrations:
        require_calibration(calibration)
    if len(calibrations) < 2:
        raise InputError("a comparison takes two calibrations of the unit or more.")
    if not 0 < level < 1 or not 0 < rate < np.inf:
        raise InputError(f"the level, {level:g}, must lie between 0 and 1, and the rate, {rate:g} rad/s, above 0.")
    files = tuple(files) or tuple(f"calibration {number}" for number in range(1, len(calibrations) + 1))
    require_apart(calibrations, files)
    order, days, times, per, notes = _in_order(calibrations, files, dates)
    ordered = [calibrations[index] for index in order]
    files = tuple(files[index] for index in order)
    limits = limits or Limits((), Rule(), {}, "", "")
    epochs = epochs_of(ordered, files, limits.nominal)
    names, left_out = _comparable(epochs)
    covariance = _covariance(epochs, names)
    movements = _courses(epochs, names, covariance, times, level)
    together = _together(movements, covariance)
    output, silent = _outputs(epochs[0], epochs[-1], names, rate)
    reached, unknown = _limits_reached(movements, limits, epochs[0].calibration)
    return UnitHistory(
        files,
        times,
        per,
        days,
        tuple(epoch.temperature for epoch in epochs),
        movements,
        together,
        output,
        reached,
        limits.file,
        (*left_out, *silent, *unknown),
        (*notes, *_notes(epochs, limits.nominal)),
        level,
    )


def _in_order(
    calibrations: Sequence[Calibration], files: Sequence[str], stated: Sequence[str | date] | None
) -> tuple[list[int], tuple[date | None, ...], FloatArray, str, list[str]]:
    """Return the order in time, dates and times since the last in it, their unit, and notes."""
    count = len(calibrations)
    if stated is not None and len(stated) != count:
        raise InputError(f"{len(stated)} dates for {count} calibrations: state one for each, in their order.")
    texts = stated or [(calibration.trace or {}).get("date") for calibration in calibrations]
    try:
        days = [None if text is None else date.fromisoformat(str(text)[:10]) for text in texts]
    except ValueError as error:
        raise InputError(f"{error}: a date is written as 2026-03-04.") from None
    known = [day for day in days if day is not None]
    if len(known) == count and len(set(known)) > 1:
        order = sorted(range(count), key=lambda index: known[index])
        times = np.array([(known[index] - max(known)).days / _YEAR for index in order])
        return order, tuple(known[index] for index in order), times, "year", []
    without = [file for file, day in zip(files, days, strict=True) if day is None]
    whose = f" of {listed(without)}" if 0 < len(without) < count else ""
    why = f"no date is known{whose}" if without else "all are of one day"
    note = f"{why}: calibrations are taken in the order given, a step apart; state them with --dates."
    return list(range(count)), tuple(days), np.arange(1.0 - count, 1.0), "step", [note]


# --- what is compared -------------------------------------------------------------------------------------------------


def _comparable(epochs: Sequence[Epoch]) -> tuple[list[str], list[str]]:
    """Return the quantities that all calibrations determine, and what is left out, in sentences.

    Raises `NotPossibleError` where there is none.
    """
    apart = {}
    for epoch in epochs[1:]:
        apart |= _apart(epochs[0], epoch)
    names = []
    left_out = {}
    for name in dict.fromkeys(name for epoch in epochs for name in epoch.quantities):
        stem = parts_of(name).stem
        owner = owner_of(name)
        lacking = [epoch.file for epoch in epochs if name not in epoch.quantities]
        unless = [epoch.quantities[name].unless for epoch in epochs if name in epoch.quantities]
        if owner in apart:
            left_out[owner] = apart[owner]
        elif lacking:
            left_out[stem if stem in CATALOGUE else owner] = (
                f"{listed(lacking)} {'holds' if len(lacking) == 1 else 'hold'} none"
            )
        elif all(text == "fixed" for text in unless):
            continue  # by convention, or of a data sheet
        elif any(unless):
            fixed = [epoch.file for epoch, text in zip(epochs, unless, strict=True) if text == "fixed"]
            why = f"{fixed[0]} holds a data sheet's value or zero" if fixed else next(filter(None, unless))
            left_out[stem if stem in CATALOGUE else name] = why
        elif _kind(name) in apart:
            left_out[name] = apart[_kind(name)]
        elif stem in CATALOGUE and _has_axes(CATALOGUE[stem]) and any(epoch.turned for epoch in epochs):
            left_out[stem] = "its axes are a set-up's in one calibration"
        else:
            names.append(name)
    sentences = _not_compared(left_out, names)
    if not names:
        raise NotPossibleError(f"these calibrations have nothing in common to compare. {' '.join(sentences)}".strip())
    return names, sentences


def _not_compared(left_out: Mapping[str, str], names: Sequence[str]) -> list[str]:
    """Return what is left out in sentences, one for each reason; axes stand together where none is compared."""
    stems = {parts_of(name).stem for name in names}
    by_reason = {}
    for what, why in left_out.items():
        stem = parts_of(what).stem
        by_reason.setdefault(why, {})[what if stem in stems else stem] = None
    return [f"not compared: {listed([*whats])}, because {why}." for why, whats in by_reason.items()]


def _has_axes(effect: Effect | type[Effect]) -> bool:
    """Whether an effect's coefficients belong to axes of the body: it takes in a vector."""
    return bool({*SENSOR_QUANTITIES.values(), "angular_acceleration"} & set(effect.needs))


def _apart(first: Epoch, other: Epoch) -> dict[str, str]:
    """Return why triads, or their gains, of two calibrations are not of one kind."""
    reasons = {}
    triads = first.calibration.triads()
    others = other.calibration.triads()
    readings = first.calibration.reading, other.calibration.reading
    for owner in triads.keys() & others.keys():
        units = triads[owner].output_unit, others[owner].output_unit
        if units[0] != units[1]:
            reasons[owner] = f"{first.file} has it in {units[0]}, {other.file} in {units[1]}"
        elif readings[0] is not None:
            try:
                readings[0].require_alike(readings[1], other.file, (owner,))
            except InputError:
                reasons[owner] = (
                    f"the logs of {first.file} and {other.file} were read in other axes or scales of counts"
                )
    if ("accelerometer" in triads) != ("accelerometer" in others):
        reasons["gyroscope gain"] = "its axes are the accelerometer's, which one calibration lacks"
    return reasons


def _covariance(epochs: Sequence[Epoch], names: Sequence[str]) -> FloatArray:
    """Return the covariance (n q, n q) of quantities in all calibrations, with what gravity's error makes of it."""
    size = len(names)
    covariance = np.zeros((len(epochs) * size,) * 2)
    by_gravity = []
    for index, epoch in enumerate(epochs):
        slope = np.array([epoch.quantities[name].slope for name in names])
        rows = slice(index * size, (index + 1) * size)
        covariance[rows, rows] = slope @ epoch.covariance @ slope.T
        by_gravity.append(slope @ epoch.by_gravity)
    for gravity in {epoch.gravity for epoch in epochs}:
        shared = np.concatenate(
            [part * (epoch.gravity == gravity) for epoch, part in zip(epochs, by_gravity, strict=True)]
        )
        covariance += np.outer(shared, shared)
    return covariance


def _courses(
    epochs: Sequence[Epoch], names: Sequence[str], covariance: FloatArray, times: FloatArray, level: float
) -> tuple[Movement, ...]:
    movements = []
    for index, name in enumerate(names):
        values = np.array([epoch.quantities[name].value for epoch in epochs])
        part = covariance[index :: len(names), index :: len(names)]
        movements.append(
            Movement(
                name,
                _unit(name, epochs[0].calibration),
                tuple(values.tolist()),
                tuple(epoch.sigma(name) for epoch in epochs),
                tuple(epoch.sigma(name, len({other.gravity for other in epochs}) > 1) for epoch in epochs),
                float(values[-1] - values[0]),
                float(np.sqrt(part[0, 0] + part[-1, -1] - 2 * part[0, -1])),
                sameness(values[:, None], part).p_value,
                StraightLine.through(times, values, part),
                not name.startswith("gyroscope.bias"),
            )
        )
    tested = [index for index, movement in enumerate(movements) if movement.tested]
    for index, adjusted in zip(tested, holm([movements[index].p_value for index in tested]).tolist(), strict=True):
        movements[index] = replace(movements[index], adjusted=adjusted, moved=adjusted < level / 2)
    return tuple(movements)


def _unit(name: str, calibration: Calibration) -> str:
    stem = parts_of(name).stem
    if stem not in CATALOGUE:
        return si_unit(name)
    return CATALOGUE[stem].coefficient_unit(calibration.triads()[owner_of(name)].output_unit)


def _kind(name: str) -> str:
    """Return which numbers one is tested with: a triad's bias, its gain, or effects."""
    stem, owner, part, _ = parts_of(name)
    return "effects" if stem in CATALOGUE else f"{owner} {'bias' if part == 'bias' else 'gain'}"


def _together(movements: Sequence[Movement], covariance: FloatArray) -> dict[str, Sameness]:
    values = np.array([movement.values for movement in movements]).T
    count, size = values.shape

    def test(chosen: list[int]) -> Sameness:
        rows = [epoch * size + column for epoch in range(count) for column in chosen]
        return sameness(values[:, chosen], submatrix(covariance, rows))

    kinds = [_kind(movement.name) for movement in movements]
    groups = {kind: [index for index, other in enumerate(kinds) if other == kind] for kind in dict.fromkeys(kinds)}
    tested = [index for index, movement in enumerate(movements) if movement.tested]
    if tested:
        groups["all"] = tested
    return {name: test(chosen) for name, chosen in groups.items()} | ({} if tested else {"all": Sameness(0.0, 0, 1.0)})


# --- the output -------------------------------------------------------------------------------------------------------


def _outputs(first: Epoch, last: Epoch, names: Sequence[str], rate: float) -> tuple[dict[str, OutputChange], list[str]]:
    """Return what the change does to each triad's corrected output, and why that is not known of others."""
    changes = {}
    silent = []
    for owner in dict.fromkeys(map(owner_of, names)):
        missing = [
            name
            for epoch in (first, last)
            for name, quantity in epoch.quantities.items()
            if name.startswith(f"{owner}.") and quantity.unless != "fixed" and name not in names
        ]
        try:
            if missing:
                raise InputError(f"{missing[0]} is not known in both.")
            effects = [effect for epoch in (first, last) for effect in epoch.calibration.imu.triads()[owner].effects]
            if (first.turned or last.turned) and any(map(_has_axes, effects)):
                raise InputError("an effect's axes are a set-up's in one calibration.")
            if owner in INERTIAL_QUANTITIES:
                changes[owner] = _output(first, last, owner, STANDARD_GRAVITY if owner == "accelerometer" else rate)
        except InputError as problem:
            silent.append(f"not compared: the output of the {owner}, because {problem}")
    return changes, silent


def _output(first: Epoch, last: Epoch, owner: str, over: float) -> OutputChange:
    """Return what the change does to a triad's corrected output up to an input of `over`.

    Raises `InputError` where an effect needs what is not known of the input.
    """
    unit = first.calibration.imu
    quantity = SENSOR_QUANTITIES[owner]
    limit = Limit(owner, owner, "output", (), -np.inf, np.inf, SENSOR_UNITS[owner], over=over)
    directions = getattr(output_stimulus(limit, unit.with_effects()), quantity)
    celsius = np.full(len(directions), unit.triads()[owner].temperature_reference)
    stimulus = Stimulus(**{quantity: directions, "temperature": celsius})
    models = [epoch.calibration.imu for epoch in (first, last)]

    def both(flats, models, stimulus):
        """Return the error (points, 3) and its slopes (points, 3, m) by all numbers of each calibration."""

        def error(before, after):
            restored = ravel_pytree(models[0])[1](before), ravel_pytree(models[1])[1](after)
            return _error(*restored, stimulus, owner)

        return error(*flats), jax.jacfwd(error, (0, 1))(*flats)

    values, slopes = stored.call(both, f"compare {owner}", [flatten(model) for model in models], models, stimulus)
    spread = np.zeros((len(values), 3, 3))
    common = []
    for epoch, slope in zip((first, last), slopes, strict=True):
        every = names_of(epoch.calibration.imu)
        free = slope[..., [every.index(name) for name in epoch.calibration.names]]
        spread += np.einsum("nip,pq,njq->nij", free, epoch.covariance, free)
        common.append(free @ epoch.by_gravity)
    for shift in [common[0] + common[1]] if first.gravity == last.gravity else common:
        spread += shift[:, :, None] * shift[:, None, :]
    length = lengths_of(values)
    worst = int(length.argmax())
    along = values[worst] / (length[worst] or 1.0)
    return OutputChange(
        float(length[worst]),
        float(np.sqrt(along @ spread[worst] @ along)),
        rms(length),
        float(np.sqrt(np.mean(spread.trace(axis1=1, axis2=2)))),
        over,
        SENSOR_UNITS[owner],
    )


def _error(first: Imu, last: Imu, stimulus: Stimulus, owner: str) -> Any:
    """Return what a triad of the first makes of an input that the last puts out, less that input."""

    def of_any_power_on(imu: Imu) -> Imu:
        """Return the unit without the gyroscope's bias, which is another after every power-on."""
        return imu if imu.gyroscope is None else replace(imu, gyroscope=replace(imu.gyroscope, bias=jnp.zeros(3)))

    return output_error(of_any_power_on(first), of_any_power_on(last), stimulus)[owner]


# --- limits and words -------------------------------------------------------------------------------------------------


def _limits_reached(
    movements: Sequence[Movement], limits: Limits, first: Calibration
) -> tuple[tuple[LimitReached, ...], list[str]]:
    reached = []
    unknown = []
    for limit in limits.limits:
        triad = first.triads().get(limit.owner)
        followed = [movement for movement in movements if limits.applies(limit, movement.name)]
        if limit.part in (*OF_ONE_UNIT, *OUTPUTS):
            unknown.append(f"{limit.key} is not followed: limits of parameters alone are followed over time.")
        elif triad is None or not followed:
            unknown.append(f"{limit.key} is not followed: no such number was compared.")
        elif triad.output_unit == "count" and (limit.part in CATALOGUE or limit.owner not in limits.nominal):
            unknown.append(
                f"{limit.key} is not followed: the {limit.owner} was logged in counts; limit its bias, scale or "
                "misalignment, and state its nominal scale below [nominal]."
            )
        else:
            for movement in followed:
                multiple = float(limits.rule.multiple(movement.line.freedom))
                reached.append(LimitReached(movement.name, limit, movement.line.until(limit.low, limit.high, multiple)))
    return tuple(reached), unknown


def _notes(epochs: Sequence[Epoch], nominal: Scales) -> Iterator[str]:
    for name, triad in epochs[0].calibration.triads().items():
        if triad.output_unit == "count" and name not in nominal:
            yield f"the {name} was logged in counts: its scale and bias are relative to the first calibration's."
    if len(epochs) == 2:
        yield "two calibrations cannot distinguish a steady drift from a single jump."
    serials = {str((epoch.calibration.trace or {}).get("serial", "")) for epoch in epochs} - {""}
    if len(serials) > 1:
        yield f"the calibrations state different serial numbers, {listed(sorted(serials))}: is it one unit?"
    if any(epoch.turned for epoch in epochs):
        yield (
            "axes of a set-up were turned to the accelerometer's own, so that the unit may sit another way each time."
        )
    if all("accelerometer" not in epoch.calibration.triads() for epoch in epochs):
        yield "without an accelerometer axes are the set-up's: a unit that sits turned has other misalignments."
    effects = [
        {e.name for e in epoch.calibration.imu.all_effects().values() if e.scope == "device"} for epoch in epochs
    ]
    if odd := sorted(set.union(*effects) - set.intersection(*effects)):
        yield f"not all calibrations have {listed(odd)}: gain and bias that were fitted without it hold a part of it."
    stated = {epoch.gravity for epoch in epochs}
    if len(stated) < len(epochs) and any(epoch.by_gravity.any() for epoch in epochs):
        sigma = max(gravity.sigma / gravity.value for gravity in stated)
        yield (
            "gravity's error is common to calibrations that state the same gravity; were they made at different "
            f"places, all scales of the accelerometer might differ by {100 * 2 * np.sqrt(2) * sigma:.2g} %."
        )
    known = [epoch.temperature for epoch in epochs if epoch.temperature is not None]
    constant = not any(over_temperature(epoch.calibration) for epoch in epochs)
    if constant and len(known) == len(epochs) and max(known) > min(known):
        yield (
            f"the recordings were at {min(known):.1f} to {max(known):.1f} °C: what follows temperature looks like "
            "movement."
        )
