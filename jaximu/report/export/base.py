"""What the writers of other tools' files share: the parameters they are given, and what they give back."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from jaximu.calibration import Calibration
from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.units import SENSOR_UNITS
from jaximu.model.conventions import Kalibr
from jaximu.model.effects.g_sensitivity import GyroGSensitivity
from jaximu.recordings.recording import Reading

SYMBOLS = {"accelerometer": "f", "gyroscope": "w", "magnetometer": "h"}


@dataclass(frozen=True)
class LinearTriad:
    """The linear part of a triad, y = gain·u + bias (+ g_sensitivity·f): gain (3, 3), bias (3,), unit of y.

    g_sensitivity: (3, 3) y per m/s² of true specific force; zero where the calibration has none.
    """

    gain: FloatArray
    bias: FloatArray
    unit: str
    g_sensitivity: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))

    @property
    def inverse(self) -> FloatArray:
        """(3, 3) SI units per unit of y."""
        return np.asarray(np.linalg.inv(self.gain), float)


@dataclass(frozen=True)
class Correction:
    """What a tool makes of its file: u = matrix·(y − offset − g_sensitivity·f), f the corrected specific force.

    frame: (3, 3) from the calibration's body frame to the one that the tool's answer is in.
    """

    matrix: FloatArray
    offset: FloatArray
    g_sensitivity: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    frame: FloatArray = field(default_factory=lambda: np.eye(3))

    def apply(self, output: FloatArray, force: FloatArray | None = None) -> FloatArray:
        """(n, 3) corrected values, in the tool's frame, of (n, 3) outputs."""
        known = 0.0 if force is None else force @ self.g_sensitivity.T
        return (output - self.offset - known) @ self.matrix.T


@dataclass(frozen=True)
class Logged:
    """A log's values z as the sensor's output after its temperature correction: matrix·z + offset; by default they are.

    frame: (3, 3) from the log's axes to the sensor's.
    """

    matrix: FloatArray = field(default_factory=lambda: np.eye(3))
    offset: FloatArray = field(default_factory=lambda: np.zeros(3))
    frame: FloatArray = field(default_factory=lambda: np.eye(3))

    def of_sensor(self, triad: LinearTriad) -> LinearTriad:
        """The sensor's linear part in its own axes, of that of the log's values."""
        return LinearTriad(self.matrix @ triad.gain @ self.frame.T, self.matrix @ triad.bias + self.offset, triad.unit)

    def correction(self, correction: Correction) -> Correction:
        """What a correction of the sensor's output makes of the log's values, in the log's axes."""
        return replace(
            correction,
            matrix=self.frame.T @ correction.matrix @ self.matrix,
            offset=np.linalg.solve(self.matrix, correction.offset - self.offset),
        )


@dataclass(frozen=True)
class Written:
    """What a writer made.

    files: content by the end of the file's name: "" is the name itself, "_gyro" goes before its suffix.
    convention: sentences on signs, frames and units of the file. equation: how to apply it, with the numbers in it.
    corrections: what the other tool makes of it, by triad; a triad that is missing is not corrected at all.
    carried: names of effects that the file holds. uncertainty: whether it holds standard deviations.
    parameters: what it was written from, where the tool has axes of its own. values: an autopilot's, by name.
    """

    files: Mapping[str, bytes]
    convention: str
    equation: str
    corrections: Mapping[str, Correction]
    carried: frozenset[str] = frozenset()
    uncertainty: bool = False
    parameters: ExportedUnit | None = None
    values: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ExportedUnit:
    """What a writer is given: the linear parts of a calibration, and what the user adds to them.

    maps: (3, 3) from the axes of the outputs, the logger's, to the body's, by triad; frames: the same of the answers.
    `triads` are gain and bias from the latter to the former. axes: a sentence on both.
    noise: Kalibr's four continuous densities (`KALIBR_UNITS`), as far as they are known. instance: which of several
    sensors the file is for, counted from 0; None where that was not stated. device: its identifier, where the tool
    asks for one. logged: by triad, how the log's values depend on an autopilot's parameters in force; composition: a
    sentence on that, "" where these are not known.
    """

    calibration: Calibration
    triads: Mapping[str, LinearTriad]
    maps: Mapping[str, FloatArray]
    frames: Mapping[str, FloatArray]
    axes: str
    noise: Mapping[str, float] = field(default_factory=dict)
    instance: int | None = None
    device: int | None = None
    logged: Mapping[str, Logged] = field(default_factory=dict)
    composition: str = ""

    @classmethod
    def of(
        cls,
        calibration: Calibration,
        axes: str | None = None,
        noise: Mapping[str, float] | None = None,
        instance: int | None = None,
        device: int | None = None,
    ) -> ExportedUnit:
        """Take the linear parts out of a calibration, for the outputs as the logger has them.

        Answers are in the logger's axes, too, where its sensors share right-handed ones but for the sign of an
        accelerometer that records minus specific force, else in the body's. `axes`: the map that the log was read with,
        where the calibration does not say so. Raises `InputError` where it says otherwise.
        """
        reading = Reading(axes=axes)
        if calibration.reading is not None:
            reading = calibration.reading
            reading.require_alike(None if axes is None else Reading(axes=axes), "export", calibration.triads())
        maps = reading.maps
        first, *others = (round(np.linalg.det(maps[name])) * maps[name] for name in calibration.triads())
        shared = all(np.array_equal(turn, first) for turn in others)
        words = "the log's own" if shared else "outputs in the log's own axes, answers in the calibration's body axes"
        words += "" if reading.axes is None else f" (it was read with --axes {reading.axes})"
        if calibration.reading is None and axes is None:
            words += ", if it was read without --axes, which this calibration does not say"
        if shared and "accelerometer" in calibration.triads() and not np.array_equal(maps["accelerometer"], first):
            words += "; the log's accelerometer has minus specific force, and the answer is specific force"
        return cls(calibration, {}, {}, {}, "", noise or {}, instance, device)._in(
            maps, dict.fromkeys(maps, first if shared else np.eye(3)), f"Axes: {words}."
        )

    def _in(self, maps: Mapping[str, FloatArray], frames: Mapping[str, FloatArray], axes: str) -> ExportedUnit:
        """Make them for outputs and answers in these axes: y = Aᵀ y_body and u = Fᵀ u_body, so the gain is AᵀKF."""
        sensitivity = np.asarray(self.calibration.imu.coefficients(GyroGSensitivity), float).reshape(3, 3)
        triads = {
            name: LinearTriad(
                maps[name].T @ np.asarray(triad.gain, float) @ frames[name],
                maps[name].T @ np.asarray(triad.bias, float),
                triad.output_unit,
                (name == GyroGSensitivity.owner) * maps[name].T @ sensitivity @ frames["accelerometer"],
            )
            for name, triad in self.calibration.triads().items()
        }
        return replace(self, triads=triads, maps=maps, frames=frames, axes=axes)

    def for_autopilot(self, name: str) -> ExportedUnit:
        """Return the same in the axes of an autopilot: forward, right, down; as in its own log, if it is of that.

        Raises `NotPossibleError` where the outputs are counts, which no autopilot sees.
        """
        self.require_si(name)
        reading = self.calibration.reading
        if reading is None:  # as the log was, then
            return self._in(self.maps, self.maps, self.axes)
        words = f"Axes: {name}'s own, forward, right, down, "
        if reading.frame is None:
            words += "with the calibration's body axes taken as forward, left, up."
        else:
            words += "as the log has them."
        maps = reading.autopilot_maps
        return self._in(maps, maps, words)

    @property
    def accelerometer(self) -> LinearTriad:
        """The accelerometer's linear part. Raises `InputError` where a magnetometer was calibrated alone."""
        if "accelerometer" not in self.triads:
            raise InputError("this calibration holds a magnetometer alone, and no accelerometer or gyroscope.")
        return self.triads["accelerometer"]

    def kalibr(self) -> dict[str, FloatArray]:
        """The fields of `conventions.Kalibr` on the host; an accelerometer alone gets a perfect gyroscope."""
        self._require("rotations alone", lambda turn: np.linalg.det(turn) > 0)
        gyroscope = self.triads.get("gyroscope") or LinearTriad(np.eye(3), np.zeros(3), "rad/s")
        view = Kalibr.from_gains(
            self.accelerometer.gain, self.accelerometer.bias, gyroscope.gain, gyroscope.bias, gyroscope.g_sensitivity
        )
        made = {name: np.asarray(value, float) for name, value in vars(view).items()}
        # the zeros above a triangle, where a factorisation leaves 1e-19
        made["accel_matrix"], made["gyro_matrix"] = np.tril(made["accel_matrix"]), np.tril(made["gyro_matrix"])
        return made

    @property
    def rate(self) -> float | None:
        """The samples' rate, Hz: that of the noise, or else of the calibration's recording, where one is known."""
        return self.noise.get("update_rate", self.calibration.data.get("rate"))

    def require_own_axes(self) -> None:
        """Raise `NotPossibleError` where answers are along other axes than outputs, for tools with a scale an axis."""
        self._require("a scale on each axis", lambda turn: bool(np.diagonal(turn).all()))

    def _require(self, parts: str, fits: Callable[[FloatArray], bool]) -> None:
        wrong = [name for name in self.triads if not fits(self.maps[name].T @ self.frames[name])]
        if wrong:
            raise NotPossibleError(
                f"this format consists of {parts}, which cannot bring the {wrong[0]}'s axes to those of the other "
                "sensors or turn their sense; export to c-header, ros-yaml, csv or npz, which can."
            )

    def require_si(self, tool: str) -> None:
        """Raise `NotPossibleError` where the outputs are counts, which `tool` never sees."""
        counts = [name for name, triad in self.triads.items() if triad.unit != SENSOR_UNITS[name]]
        if counts:
            raise NotPossibleError(
                f"{tool} corrects values in physical units, but this calibration is in {self.triads[counts[0]].unit} "
                f"({' and '.join(counts)}): calibrate a log that states physical units, or export to c-header, "
                "ros-yaml, csv or npz, which take counts."
            )

    def corrections(self, sensitive: bool = False) -> dict[str, Correction]:
        """The whole linear correction of each triad, u = K⁻¹ (y − b), for tools that take any 3 × 3 matrix."""
        return {
            name: Correction(t.inverse, t.bias, t.g_sensitivity if sensitive else np.zeros((3, 3)))
            for name, t in self.triads.items()
        }

    def equation(self, symbol: str = "T", sensitive: bool = False) -> str:
        """The equation u = T (y − b) of each triad, with its numbers."""
        lines = []
        for name, correction in self.corrections(sensitive).items():
            u = SYMBOLS[name]
            extra = " - G f" if np.any(correction.g_sensitivity) else ""
            lines.append(
                f"{name}: {u} [{SENSOR_UNITS[name]}] = {symbol} (y - b{extra}), y in {self.triads[name].unit}\n"
                f"{symbol} = {exact_text(correction.matrix)}\nb = {exact_text(correction.offset)}"
                + (f"\nG = {exact_text(correction.g_sensitivity)}" if extra else "")
            )
        return "\n".join(lines)


def text_file(lines: Iterable[str]) -> dict[str, bytes]:
    """The one file of a format, as `Written` takes it."""
    return {"": ("\n".join(lines) + "\n").encode()}


def exact_text(values: FloatArray) -> str:
    """A vector or a matrix as text that reads back exactly: "[1.0, 2.0, 3.0]", which YAML, JSON and Python share."""
    return str((np.asarray(values, float) + 0.0).tolist())


def yaml_matrices(named: Mapping[str, FloatArray], indent: int, rows: int) -> list[str]:
    """Named matrices as lines of YAML, lists of lists; `rows`: how far their rows are indented."""
    return [
        line
        for name, matrix in named.items()
        for line in (f"{' ' * indent}{name}:", *(f"{' ' * rows}- {exact_text(row)}" for row in matrix))
    ]


def comments(parameters: ExportedUnit, sign: str = "#") -> str:
    """Where the numbers come from and what axes they are for, for the head of a file."""
    calibration = parameters.calibration
    safe = "".join(letter if letter.isprintable() else "?" for letter in ", ".join(calibration.files) or "a recording")
    return f"{sign} Calibrated by jaximu {calibration.software.get('version', '')} from {safe}. {parameters.axes}"
