"""A calibration composed with the parameters that an autopilot has in force, and what its new ones change at rest.

With z = R S (y − t(T) − o) what the autopilot makes of a sensor's output y, and z = K' u + b' the calibration of a log
that holds z, the sensor in its own axes is y − t = S⁻¹ Rᵀ K' R v + o + S⁻¹ Rᵀ b', v = Rᵀ u. Of a log that holds y it is
K' u + b' − t, t at the calibration's temperature. Offset and scale are then chosen as of any raw log, and the
temperature correction stays in force (PX4-Autopilot issues 9736 and 14717 are about calibrations that forgot it).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from jaximu.estimation.problem import flatten, names_of, unflatten
from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError
from jaximu.ground.page import Section, Table
from jaximu.ground.quantities import Z95, number, size, with_interval
from jaximu.recordings.readers.parameters import ParameterFile
from jaximu.recordings.recording import Reading
from jaximu.report.export.autopilot import MARKS, Firmware
from jaximu.report.export.base import ExportedUnit, Logged
from jaximu.report.export.catalogue import writer

__all__ = ["Change", "Composition"]

_STEP = 1e-6  # of a gain or bias, for derivatives
_DIRECTIONS = 2000  # of gravity


@dataclass(frozen=True)
class Change:
    """A parameter in force and its new value, in its own unit, with 1 sigma (None where no recording determined it).

    force: what it changes of the specific force at rest, m/s², where that is most; horizon: of its direction, rad, at
    most; rate: of the angular rate, rad/s.
    """

    parameter: str
    in_force: float
    new: float
    sigma: float | None
    force: float = 0.0
    horizon: float = 0.0
    rate: float = 0.0

    def document(self) -> dict[str, float | str | None]:
        """As JSON has it, with half the 95 % interval."""
        half = None if self.sigma is None else Z95 * self.sigma
        return {key: value for key, value in vars(self).items() if key != "sigma"} | {"half_width": half}

    def row(self) -> tuple[str, str, str, str]:
        """As a table has it."""
        new = f"{number(self.new, 6)} (not determined)" if self.sigma is None else with_interval(self.new, self.sigma)
        return self.parameter, number(self.in_force, 6), new, _amounts(vars(self))


def _amounts(values: Mapping[str, Any]) -> str:
    """What changes at rest, in words."""
    if values["rate"]:
        return size(values["rate"], "rad/s")
    return (
        f"{size(values['force'], 'm/s^2')}, horizon {size(values['horizon'], 'rad')}" if values["force"] else "nothing"
    )


@dataclass(frozen=True)
class Composition:
    """A unit to export to an autopilot that knows the parameters in force, in `file`; to: the name of the writer."""

    unit: ExportedUnit
    to: str
    file: ParameterFile

    @classmethod
    def of(cls, unit: ExportedUnit, to: str, file: ParameterFile, corrected: bool | None = None) -> Composition:
        """Compose a unit with the parameters in force.

        **Arguments:** `corrected`: whether the calibrated log held values that the autopilot had corrected, where the
        calibration does not say so.

        Raises `InputError` for a tool without such parameters, parameters of another firmware, without those that are
        needed or with values that cannot be, and where it is not known which sensor was calibrated, in which axes, or
        whether its log was corrected.
        """
        firmware = _firmware(to)
        there = [name for name, marks in MARKS.items() if any(key.startswith(marks) for key in file.values)]
        if firmware.name not in there:
            held = f"those of {there[0]}: export --to {there[0].lower()}" if there else "none of an autopilot's sensors"
            marks = ", ".join(f"{mark}…" for mark in MARKS[firmware.name])
            raise InputError(f"{file.path}: expected parameters of {firmware.name} ({marks}), found {held}.")
        reading = unit.calibration.reading
        known = None if reading is None else reading.corrected
        if known is not None and corrected not in (None, known):
            raise InputError(f"--log-was: the calibrated log held {_words(known)}, as it shows; leave --log-was out.")
        corrected = corrected if known is None else known
        if corrected is None:
            raise InputError(
                "the calibration does not say whether its log held the sensors' raw outputs or what the autopilot had "
                "corrected by the parameters in force: state --log-was raw or corrected."
            )
        if reading is None and "does not say" in unit.axes:
            raise InputError("the calibration does not say in which axes its log was read: state --axes.")
        numbers = {name: _number(unit, firmware, file, name) for name in unit.triads}
        if len(set(numbers.values())) != 1:
            listed = ", ".join(f"{name} {at}" for name, at in numbers.items())
            raise InputError(f"{file.path}: the sensors have different numbers ({listed}): state --instance.")
        words = f"They are composed with those in force in {file.path}: the calibrated log held {_words(corrected)}"
        words += f", {'as stated' if known is None else 'as it shows'}; temperature corrections stay in force."
        composition = cls(replace(unit, instance=numbers.popitem()[1], composition=words), to, file)
        logged = {name: composition._logged(name, corrected) for name in unit.triads}
        return replace(composition, unit=replace(composition.unit, logged=logged))

    def changes(self) -> tuple[Change, ...]:
        """Return how each parameter changes, and what that amounts to at rest."""
        changes, gravity = [], self.unit.calibration.gravity.value
        data_sheet = self.unit.calibration.from_data_sheet
        for name in self.unit.triads:
            _, scale_before = self._correction(name, self._in_force)
            _, scale = self._correction(name, self._new)
            for part, parameters in zip(("bias", "gain"), self._parameters(name), strict=False):
                for axis, parameter in enumerate(parameters):
                    before, after = self.file.value(parameter), self._values[parameter]
                    sigma = None if f"{name} {part}" in data_sheet else self._sigmas[parameter]
                    if part == "gain":  # gravity along the axis; at 45° to it, half of the change is across
                        ratio = after / scale_before[axis] - 1.0
                        amounts = {"force": gravity * ratio, "horizon": abs(ratio) / 2}
                    else:
                        shift = scale[axis] * (before - after)
                        amounts = _shifted(name, shift, abs(shift) / gravity)
                    changes.append(Change(parameter, before, after, sigma, **amounts))
        return tuple(changes)

    def at_rest(self) -> dict[str, float]:
        """Return what all changes amount to together at rest, at most over all attitudes: as `Change` has it."""
        count = np.arange(_DIRECTIONS) + 0.5
        height, angle = 1.0 - 2.0 * count / _DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * count
        across = np.sqrt(1.0 - height**2)
        up = np.stack([across * np.cos(angle), across * np.sin(angle), height], 1)
        gravity = self.unit.calibration.gravity.value
        amounts: dict[str, float] = {"force": 0.0, "horizon": 0.0, "rate": 0.0}
        for name in self.unit.triads:
            (offset, scale), (new_offset, new_scale) = (
                self._correction(name, of) for of in (self._in_force, self._new)
            )
            change = gravity * (new_scale / scale - 1.0) * up + new_scale * (offset - new_offset)
            level = change - np.sum(change * up, axis=1, keepdims=True) * up
            most, tilted = (float(np.linalg.norm(part, axis=1).max()) for part in (change, level))
            amounts |= _shifted(name, most, tilted / gravity)
        return amounts

    def section(self) -> Section:
        """Return the changes as a page has them."""
        amounts = self.at_rest()
        parts = [_amounts(amounts | {"rate": 0.0}), _amounts(amounts | {"force": 0.0})]
        headers = ("Parameter", "In force", "New (± 95 %)", "Changes at rest")
        caption = f"Offsets in m/s² and rad/s. All together, at most at rest: {'; '.join(dict.fromkeys(parts))}."
        return Section("What changes:", (Table(headers, [change.row() for change in self.changes()], caption),))

    def document(self) -> dict[str, Any]:
        """Return the changes as JSON has them."""
        changes = [change.document() for change in self.changes()]
        return {
            "file": self.file.path,
            "composition": self.unit.composition,
            "changes": changes,
            "at_rest": self.at_rest(),
        }

    def _parameters(self, name: str) -> list[list[str]]:
        """The names of a triad's offsets, and of its scales if it has some."""
        tool = _firmware(self.to).tool(self.unit.instance or 0)
        words = [tool.offset, *([tool.scale] if name == "accelerometer" else [])]
        return [[tool.patterns[name].format(word=word, axis=axis) for axis in "XYZ"] for word in words]

    def _in_force(self, names: list[str]) -> FloatArray:
        return self.file.vector(names)

    def _new(self, names: list[str]) -> FloatArray:
        return np.array([self._values[name] for name in names])

    def _correction(self, name: str, take: Any) -> tuple[FloatArray, FloatArray]:
        """(3,) offset and (3,) scale of a triad, of what `take` has of their names."""
        offset, *scale = map(take, self._parameters(name))
        return offset, scale[0] if scale else np.ones(3)

    def _logged(self, name: str, corrected: bool) -> Logged:
        firmware, calibration, index = _firmware(self.to), self.unit.calibration, self.unit.instance or 0
        offset, scale = self._correction(name, self._in_force)
        turn = firmware.rotation(self.file, name, index)
        if not np.all(scale > 0):
            raise InputError(f"{self.file.path}: a scale of the {name} in force is {scale.min():g}, which is none.")
        if corrected:
            return Logged(turn.T / scale[:, None], offset, turn.T)
        board = calibration.reading is None or calibration.reading.frame is not None
        if not board and not np.allclose(turn, np.eye(3)):
            raise InputError(
                f"{self.file.path}: the board is turned, and the calibration does not say whether its axes are the "
                "board's or the vehicle's: calibrate the autopilot's own log."
            )
        triad = calibration.triads()[name]
        thermal = any("temperature" in effect.needs for effect in triad.effects)
        celsius = triad.temperature_reference if thermal else calibration.data.get("temperature")
        return Logged(offset=-firmware.thermal(self.file, name, index, celsius))

    @cached_property
    def _values(self) -> Mapping[str, float]:
        return writer(self.to).write(self.unit).values

    @cached_property
    def _sigmas(self) -> dict[str, float]:
        """One sigma of each parameter: by central differences over the calibration's gains and biases."""
        calibration, write = self.unit.calibration, writer(self.to).write
        numbers, names = np.asarray(flatten(calibration.imu), np.float64), names_of(calibration.imu)
        free = [name for name in calibration.names if name.effect is None and name.owner in self.unit.triads]

        def values(row: int, step: float) -> FloatArray:
            moved = numbers + step * (np.arange(len(numbers)) == row)
            moved_unit = replace(self.unit, calibration=replace(calibration, imu=unflatten(calibration.imu, moved)))
            return np.array(list(write(moved_unit).values.values()))

        slopes = [(values(row, _STEP) - values(row, -_STEP)) / (2 * _STEP) for row in map(names.index, free)]
        slope = np.reshape(slopes, (len(free), len(self._values)))
        variances = np.einsum("ik,ij,jk->k", slope, calibration.covariance_of(free), slope)
        return dict(zip(self._values, np.sqrt(np.maximum(variances, 0.0)).tolist(), strict=True))


def _firmware(to: str) -> Firmware:
    firmware = getattr(writer(to), "FIRMWARE", None)
    if firmware is None:
        raise InputError(f"--in-force: {to} has no parameters in force; px4 and ardupilot have.")
    return firmware


def _words(corrected: bool) -> str:
    return "what the autopilot had corrected by them" if corrected else "raw outputs"


def _shifted(name: str, change: float, horizon: float) -> dict[str, float]:
    """A change of a triad's values at rest as `Change` has it."""
    return {"force": change, "horizon": horizon} if name == "accelerometer" else {"rate": change}


def _number(unit: ExportedUnit, firmware: Firmware, file: ParameterFile, name: str) -> int:
    """Which of the autopilot's sensors a triad is."""
    identities = firmware.identities(file, name)
    sensor = (unit.calibration.reading or Reading()).sensors.get(name)
    if unit.instance is not None:
        numbers = [index for index in identities if index == unit.instance]
    elif unit.device is not None:
        numbers = [index for index, identity in identities.items() if identity == unit.device]
    elif sensor is not None:
        numbers = [index for index in identities if index == firmware.of_log(identities, sensor)]
    else:
        numbers = list(identities)
    if len(numbers) != 1:
        listed = ", ".join(f"{index} (ID {identity})" for index, identity in identities.items()) or "none"
        stated = "" if sensor is None else f" (the log says {sensor})"
        raise InputError(
            f"{file.path}: which of its sensors the {name} is{stated} is not known; those with an ID: {listed}. State "
            "it by --instance or --device."
        )
    return numbers[0]
