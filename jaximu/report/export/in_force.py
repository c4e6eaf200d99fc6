"""A calibration composed with the parameters that an autopilot has in force, and what its new ones change at rest.

With z = R S (y − t(T) − o) what the autopilot makes of a sensor's output y, and z = K' u + b' the calibration of a log
that holds z, the sensor in its own axes is y − t = S⁻¹ Rᵀ K' R v + o + S⁻¹ Rᵀ b', v = Rᵀ u. Of a log that holds y it is
K' u + b' − t, t at the calibration's temperature. Offset and scale are then chosen as of any raw log, and the
temperature correction stays in force (PX4-Autopilot issues 9736 and 14717 are about calibrations that forgot it).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from jaximu.acceptance.epochs import over_temperature
from jaximu.estimation.problem import flatten, names_of, unflatten
from jaximu.ground.array_types import FloatArray
from jaximu.ground.document import Json
from jaximu.ground.errors import InputError
from jaximu.ground.page import Section, Table
from jaximu.ground.quantities import Z95, plain, size, with_interval
from jaximu.ground.vectors import lengths_of, root_or_zero
from jaximu.recordings.readers.parameters import ParameterFile
from jaximu.recordings.recording import Reading
from jaximu.report.export.autopilot import MARKS, Firmware
from jaximu.report.export.base import ExportedUnit, Logged
from jaximu.report.export.catalogue import writer
from jaximu.report.export.cost import Range

_HELD = {True: "what the autopilot had corrected by them", False: "raw outputs"}


@dataclass(frozen=True)
class Composition:
    """A unit to export to an autopilot that knows the parameters in force, in `file`; to: the name of the writer."""

    unit: ExportedUnit
    to: str
    file: ParameterFile

    @classmethod
    def of(
        cls, unit: ExportedUnit, to: str, file: ParameterFile, log_was: Literal["raw", "corrected"] | None = None
    ) -> Composition:
        """Compose a unit with the parameters in force.

        **Arguments:** `log_was`: whether the calibrated log held values that the autopilot had corrected, where the
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
        stated = None if log_was is None else log_was == "corrected"
        known = None if reading is None else reading.corrected
        if known is not None and stated not in (None, known):
            raise InputError(f"--log-was: the calibrated log held {_HELD[known]}, as it shows; leave --log-was out.")
        corrected = stated if known is None else known
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
        words = f"They are composed with those in force in {file.path}: the calibrated log held {_HELD[corrected]}"
        words += f", {'as stated' if known is None else 'as it shows'}; temperature corrections stay in force."
        composition = cls(replace(unit, instance=numbers.popitem()[1], composition=words), to, file)
        logged = {name: composition._logged(name, corrected) for name in unit.triads}
        return replace(composition, unit=replace(composition.unit, logged=logged))

    def changes(self) -> list[Json]:
        """Return how each parameter changes, as JSON has it: `parameter`, `in_force`, `new`, `half_width`, `at_rest`.

        half_width: of the 95 % interval of `new`; None where no recording determined it. at_rest: what it changes at
        rest, where that is most: `force` (m/s²) and `horizon` (rad), or `rate` (rad/s).
        """
        changes = []
        gravity = self.unit.calibration.gravity.value
        data_sheet = self.unit.calibration.from_data_sheet
        for name in self.unit.triads:
            (_, scale_before), (_, scale) = self._correction(name, self.file), self._correction(name, self._new)
            for part, parameters in zip(("bias", "gain"), self._parameters(name), strict=False):
                for axis, parameter in enumerate(parameters):
                    before, after = self.file.value(parameter), self._new.value(parameter)
                    if part == "gain":  # gravity along the axis; at 45° to it, half of the change is across
                        ratio = after / scale_before[axis] - 1.0
                        at_rest = _at_rest(name, gravity * ratio, abs(ratio) / 2)
                    else:
                        shift = scale[axis] * (before - after)
                        at_rest = _at_rest(name, shift, abs(shift) / gravity)
                    changes.append(
                        {
                            "parameter": parameter,
                            "in_force": before,
                            "new": after,
                            "half_width": None if f"{name} {part}" in data_sheet else Z95 * self._sigmas[parameter],
                            "at_rest": at_rest,
                        }
                    )
        return changes

    def at_rest(self) -> dict[str, float]:
        """Return what all changes amount to together at rest, at most over all attitudes, as in `changes`."""
        gravity = self.unit.calibration.gravity.value
        amounts = {}
        up = np.asarray(Range.of(self.unit.calibration).paths()[0].specific_force) / gravity
        for name in self.unit.triads:
            (offset, scale), (new_offset, new_scale) = (self._correction(name, of) for of in (self.file, self._new))
            change = gravity * (new_scale / scale - 1.0) * up + new_scale * (offset - new_offset)
            level = change - (change * up).sum(axis=1, keepdims=True) * up
            most, tilted = (float(lengths_of(part).max()) for part in (change, level))
            amounts |= _at_rest(name, most, tilted / gravity)
        return amounts

    def section(self) -> Section:
        """Return the changes as a page has them."""
        return Section(
            "What changes:",
            (
                Table(
                    ("Parameter", "In force", "New (± 95 %)", "Changes at rest"),
                    [
                        (
                            change["parameter"],
                            plain(change["in_force"]),
                            with_interval(change["new"], change["half_width"] / Z95)
                            if change["half_width"]
                            else f"{plain(change['new'])} (not determined)",
                            _words(change["at_rest"]),
                        )
                        for change in self.changes()
                    ],
                    f"Offsets in m/s² and rad/s. All together, at most at rest: {_words(self.at_rest())}.",
                ),
            ),
        )

    def document(self) -> Json:
        """Return the changes as JSON has them."""
        return {
            "file": self.file.path,
            "composition": self.unit.composition,
            "changes": self.changes(),
            "at_rest": self.at_rest(),
        }

    def _parameters(self, name: str) -> list[list[str]]:
        """The names of a triad's offsets, and of its scales if it has some."""
        firmware, number = _firmware(self.to), self.unit.instance or 0
        return [
            [firmware.parameter(firmware.patterns[name], name, number, word=word, axis=axis) for axis in "XYZ"]
            for word in [firmware.offset, *([firmware.scale] if name == "accelerometer" else [])]
        ]

    def _correction(self, name: str, file: ParameterFile) -> tuple[FloatArray, FloatArray]:
        """(3,) offset and (3,) scale of a triad."""
        offset, *scale = map(file.vector, self._parameters(name))
        return offset, scale[0] if scale else np.ones(3)

    def _logged(self, name: str, corrected: bool) -> Logged:
        firmware, calibration, index = _firmware(self.to), self.unit.calibration, self.unit.instance or 0
        offset, scale = self._correction(name, self.file)
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
        thermal = name in over_temperature(calibration)
        celsius = triad.temperature_reference if thermal else calibration.data.get("temperature")
        return Logged(offset=-firmware.thermal(self.file, name, index, celsius))

    @cached_property
    def _new(self) -> ParameterFile:
        return ParameterFile("new", {name: (value,) for name, value in writer(self.to).write(self.unit).values.items()})

    @cached_property
    def _sigmas(self) -> dict[str, float]:
        """One sigma of each parameter: by central differences over the calibration's gains and biases."""
        calibration, write, small = self.unit.calibration, writer(self.to).write, 1e-6
        numbers = np.asarray(flatten(calibration.imu), float)
        names = names_of(calibration.imu)
        free = [name for name in calibration.names if name.effect is None and name.owner in self.unit.triads]

        def values(row: int, step: float) -> FloatArray:
            moved = numbers + step * (np.arange(len(numbers)) == row)
            moved_unit = replace(self.unit, calibration=replace(calibration, imu=unflatten(calibration.imu, moved)))
            return np.array(list(write(moved_unit).values.values()))

        slopes = [(values(row, small) - values(row, -small)) / (2 * small) for row in map(names.index, free)]
        slope = np.reshape(slopes, (len(free), len(self._new.values)))
        variances = np.einsum("ik,ij,jk->k", slope, calibration.covariance_of(free), slope)
        return dict(zip(self._new.values, root_or_zero(variances).tolist(), strict=True))


def _firmware(to: str) -> Firmware:
    firmware = getattr(writer(to), "FIRMWARE", None)
    if firmware is None:
        raise InputError(f"--in-force: {to} has no parameters in force; px4 and ardupilot have.")
    return firmware


def _at_rest(name: str, change: float, horizon: float) -> dict[str, float]:
    """A change of a triad's values at rest."""
    return {"force": change, "horizon": horizon} if name == "accelerometer" else {"rate": change}


def _words(at_rest: dict[str, float]) -> str:
    units = {"force": "m/s^2", "horizon": "rad", "rate": "rad/s"}
    return ", ".join("horizon " * (key == "horizon") + size(value, units[key]) for key, value in at_rest.items())


def _number(unit: ExportedUnit, firmware: Firmware, file: ParameterFile, name: str) -> int:
    """Which of the autopilot's sensors a triad is."""
    identities = firmware.identities(file, name)
    sensor = (unit.calibration.reading or Reading()).sensors.get(name)
    by_number, by_identity = (sensor, None) if firmware.logs_numbers else (None, sensor)
    if unit.instance is not None or unit.device is not None:
        by_number, by_identity = unit.instance, None if unit.instance is not None else unit.device
    numbers = [
        index
        for index, identity in identities.items()
        if by_number in (None, index) and by_identity in (None, identity)
    ]
    if len(numbers) != 1:
        listed = ", ".join(f"{index} (ID {identity})" for index, identity in identities.items()) or "none"
        stated = "" if sensor is None else f" (the log says {sensor})"
        raise InputError(
            f"{file.path} has several sensors, and it is not known which of them the {name} is{stated}; those with an "
            f"ID: {listed}. State it by --instance or --device."
        )
    return numbers[0]
