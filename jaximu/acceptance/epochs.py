"""Calibrations of one unit on one footing: the same axes, the same temperature, the same quantities.

The axes are the accelerometer's own, in which its gain is lower triangular: those of a fit by hand already are, those
of a fixture, in which a unit may sit turned another way each time, are turned there with their covariance. Quantities
are those that limits are put on (`jaximu.acceptance.quantities`). Gravity's error, K ∝ 1/g, is common to calibrations
that state the same gravity; it is taken out of the covariance where that holds it, and kept beside.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaximu.acceptance.limits import Scales
from jaximu.acceptance.quantities import measure, of_calibration
from jaximu.acceptance.words import parts_of
from jaximu.calibration import Calibration
from jaximu.estimation.fitting import effect_numbers
from jaximu.estimation.problem import Name, without_equipment_or_effects
from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import LocalGravity
from jaximu.ground.units import SENSOR_QUANTITIES
from jaximu.model.conventions import lower_triangular_frame
from jaximu.model.effects import CATALOGUE


class Measurand(NamedTuple):
    """A quantity of a calibration: its value in SI, its slope (p,) by the free numbers, and why it is not compared."""

    value: float
    slope: FloatArray
    unless: str


@dataclass(frozen=True)
class Epoch:
    """A calibration in its own axes. file: what it is called. turned: whether its axes were others.

    covariance (p, p): of its free numbers, without gravity's error; by_gravity (p,): what one sigma of that adds, zero
    where it stays in the covariance. quantities: by name.
    """

    file: str
    calibration: Calibration
    turned: bool
    covariance: FloatArray
    by_gravity: FloatArray
    quantities: dict[str, Measurand]

    @property
    def gravity(self) -> LocalGravity:
        """Local gravity as it was stated."""
        return self.calibration.gravity

    @property
    def temperature(self) -> float | None:
        """The temperature of the recording, °C, where it is known."""
        temperature = self.calibration.data.get("temperature")
        return None if temperature is None else float(temperature)

    def sigma(self, name: str, gravity: bool = True) -> float:
        """Return the standard uncertainty of a quantity, with gravity's part or without."""
        slope = self.quantities[name].slope
        return float(np.sqrt(slope @ self.covariance @ slope + gravity * (slope @ self.by_gravity) ** 2))


def without_gravity(calibration: Calibration) -> Calibration:
    """Return a calibration without the part of its covariance that is gravity's."""
    shift = calibration.gravity_shift()
    return replace(calibration, covariance=calibration.covariance - np.outer(shift, shift))


def owner_of(name: str) -> str:
    """Return the triad that a quantity is of: `gyroscope.bias[2]`, `accel.temperature[0]`."""
    stem, owner, *_ = parts_of(name)
    return CATALOGUE[stem].owner if stem in CATALOGUE else owner


def in_own_axes(calibration: Calibration) -> tuple[Calibration, bool]:
    """Return a calibration in axes in which the accelerometer's gain is lower triangular, and whether it was turned.

    One without an accelerometer stays as it is. Raises `InputError` for a gain that no rotation makes so.
    """
    triads = calibration.triads()
    if "accelerometer" not in triads or not np.triu(triads["accelerometer"].gain, 1).any():
        return calibration, False
    owners = [name for name in ("accelerometer", "gyroscope") if name in triads]
    gains = np.stack([triads[name].gain for name in owners])

    def turned(gains):
        change = lower_triangular_frame(gains[0], gains[1] if len(owners) > 1 else jnp.eye(3))
        return jnp.stack([change.gain_accel, change.gain_gyro][: len(owners)])

    free = [Name(owner, "gain", axes) for owner in owners for axes in np.ndindex(3, 3)]
    names = (*free, *(name for name in calibration.names if name not in free))
    count = len(free)
    slope = np.eye(len(names))
    slope[:count, :count] = np.asarray(jax.jacfwd(turned)(gains)).reshape(count, count)
    covariance = slope @ calibration.covariance_of(names) @ slope.T
    fitted = {name.owner for name in calibration.names if name.part == "gain"}
    new = zip(owners, np.asarray(turned(gains)), strict=True)
    imu = replace(calibration.imu, **{owner: replace(triads[owner], gain=gain) for owner, gain in new})
    return replace(calibration, imu=imu, names=names, covariance=covariance).of_numbers(
        lambda name: without_equipment_or_effects(name) and (name.part != "gain" or name.owner in fitted)
    ), True


def epochs_of(calibrations: Sequence[Calibration], files: Sequence[str], nominal: Scales) -> list[Epoch]:
    """Put calibrations on one footing. **Arguments:** `nominal`: by triad, where counts are held to stated scales.

    Raises `NotPossibleError` where they hold at temperatures that cannot be brought together.
    """
    pairs = [in_own_axes(calibration) for calibration in calibrations]
    common = _temperatures([calibration for calibration, _ in pairs], files)
    first = pairs[0][0].triads().items()
    scales = {name: (np.diagonal(triad.gain), triad.bias) for name, triad in first} | dict(nominal)
    return [
        _epoch(*_at_temperatures(calibration, common), file, turned, scales)
        for (calibration, turned), file in zip(pairs, files, strict=True)
    ]


def _epoch(calibration: Calibration, reasons: Mapping[str, str], file: str, turned: bool, scales: Scales) -> Epoch:
    measured = measure(of_calibration(calibration), scales, ())
    quantities = {}
    for column, name in enumerate(measured.names):
        stem = parts_of(name).stem
        owner = owner_of(name)
        if owner not in calibration.triads() or (stem in CATALOGUE and CATALOGUE[stem].scope != "device"):
            continue
        unless = reasons.get(stem, "") or reasons.get(owner, "")
        if measured.fixed[column]:
            unless = "fixed"
        elif not measured.determined[0, column]:
            unless = f"{file} does not determine all of that"
        quantities[name] = Measurand(float(measured.value[0, column]), measured.slope[0, column], unless)
    covariance = without_gravity(calibration).covariance
    return Epoch(file, calibration, turned, covariance, calibration.gravity_shift(), quantities)


# --- temperature ------------------------------------------------------------------------------------------------------


def over_temperature(calibration: Calibration) -> set[str]:
    """Return the triads that have an effect of temperature."""
    return {
        name
        for name, triad in calibration.triads().items()
        if any("temperature" in effect.needs for effect in triad.effects)
    }


def _temperatures(calibrations: Sequence[Calibration], files: Sequence[str]) -> dict[str, float]:
    """Return the temperature, °C, at which triads are compared of which one holds over temperature."""
    common = {}
    for owner in sorted(set.union(*map(over_temperature, calibrations))):
        holders = [pair for pair in zip(calibrations, files, strict=True) if owner in pair[0].triads()]
        constant = [pair for pair in holders if owner not in over_temperature(pair[0])]
        for calibration, file in constant:
            if "temperature" not in calibration.data:
                raise NotPossibleError(
                    f"{file} holds at one temperature, which its recording did not state, and another of these "
                    "calibrations over temperature: they cannot be compared. Record the unit with its temperature, and "
                    "calibrate again."
                )
        first = holders[0][0].triads()[owner].temperature_reference
        common[owner] = float(constant[0][0].data["temperature"]) if constant else first
    return common


def _at_temperatures(calibration: Calibration, common: Mapping[str, float]) -> tuple[Calibration, dict[str, str]]:
    """Return a calibration whose biases are those at steady temperatures, and what is not compared because of it."""
    reasons = {}
    for owner, celsius in common.items():
        triad = calibration.triads().get(owner)
        if triad is None or triad.temperature_reference == celsius:
            continue
        reference = triad.temperature_reference
        from jaximu.calibration.thermal import steady

        rows = [row for row, effect in enumerate(triad.effects) if "temperature" in effect.needs]
        reasons |= {triad.effects[row].name: f"one counts it from {reference:g} °C, another not" for row in rows}
        still = [row for row in rows if SENSOR_QUANTITIES[owner] not in triad.effects[row].needs]
        if still != rows:
            reasons |= {
                f"{owner}.{part}": f"one holds it at {reference:g} °C, another not"
                for part in ("scale", "misalignment")
            }
        rows = still
        effects = [triad.effects[row] for row in still]
        (there, here), (slope, origin) = steady(effects, [celsius, reference], 0.0, reference)
        alone = [name for name in effect_numbers(calibration.imu.with_effects(*effects))[0] if name.effect is not None]
        numbers = [Name(owner, name.part, name.axes, rows[name.effect or 0]) for name in alone]
        shift = np.eye(len(calibration.names))
        for column, number in enumerate(numbers):
            for axis in range(3):
                bias = Name(owner, "bias", (axis,))
                if number in calibration.names and bias in calibration.names:
                    index = calibration.names.index(bias), calibration.names.index(number)
                    shift[index] = (slope - origin)[axis, column]
        changed = replace(triad, bias=triad.bias + there - here, temperature_reference=celsius)
        calibration = replace(
            calibration,
            imu=replace(calibration.imu, **{owner: changed}),
            covariance=shift @ calibration.covariance @ shift.T,
        )
    return calibration, reasons


def require_apart(calibrations: Sequence[Calibration], files: Sequence[str]) -> None:
    """Raise `InputError` for a calibration given twice, `NotPossibleError` where two rest on one recording."""
    hashes = {}
    for calibration, file in zip(calibrations, files, strict=True):
        recordings = {part["sha256"]: part for part in calibration.data.get("files", ()) if part.get("sha256")}
        for sha256, recording in recordings.items():
            if sha256 in hashes:
                raise NotPossibleError(
                    f"{hashes[sha256]} and {file} rest on the same recording, {recording['file']}: their errors are "
                    "not independent, so a difference shows nothing of the unit. Calibrate each recording once."
                )
        hashes |= dict.fromkeys(recordings, file)
        if sum(calibration == other for other in calibrations) > 1:
            raise InputError(f"{file} is given twice: name different calibrations of the unit.")
