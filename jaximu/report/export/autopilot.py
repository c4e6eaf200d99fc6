"""What the autopilots' parameters have in common: offsets, the accelerometer's scale, a magnetometer's matrix."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

import numpy as np
import scipy

from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError
from jaximu.recordings.readers.parameters import ParameterFile
from jaximu.report.export.base import Correction, ExportedUnit, LinearTriad, Logged, exact_text

_ROTATIONS = (
    "0 0 0,0 0 45,0 0 90,0 0 135,0 0 180,0 0 225,0 0 270,0 0 315,180 0 0,180 0 45,180 0 90,180 0 135,0 180 0,180 0 225,"
    "180 0 270,180 0 315,90 0 0,90 0 45,90 0 90,90 0 135,270 0 0,270 0 45,270 0 90,270 0 135,0 90 0,0 270 0,0 180 90,"
    "0 180 270,90 90 0,180 90 0,270 90 0,90 180 0,270 180 0,90 270 0,180 270 0,270 270 0,90 180 90,90 0 270,90 68 293,"
    "0 315 0,90 315 0"
)
"""Roll, pitch and yaw in degrees of the rotations that both firmwares number as MAVLink's MAV_SENSOR_ORIENTATION."""
MARKS = {"PX4": ("CAL_ACC", "CAL_GYRO", "SENS_BOARD"), "ArduPilot": ("INS_ACC", "INS_GYR", "AHRS_")}
"""How the names of a firmware's own parameters begin."""


def rotation_of(roll: float, pitch: float, yaw: float) -> FloatArray:
    """(3, 3) Rz(yaw) Ry(pitch) Rx(roll), degrees: from the board's axes to the vehicle's."""
    return scipy.spatial.transform.Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()


class Firmware(ABC):
    """How a firmware names its parameters, and in what order it corrects and turns.

    u = R S (y − t(T) − o): o the offset, S the accelerometer's scale on its diagonal, R the board's rotation, t the
    temperature correction. name: as people call it. sensors: how many of a kind it names; logs_numbers: whether its
    logs call a sensor by its number, not by its ID. rotations: roll, pitch and yaw in degrees of those that it numbers
    in another way than MAVLink, by number.

    short: its word for each triad. patterns: of the names of a triad's parameters; identity: of the one with a sensor's
    device ID; orientation: of the one that turns the magnetometer. offset, scale: the words in them. matrix: those of
    the magnetometer's offset, and of the diagonal and the rest (xy, xz, yz) of its matrix. unit: the name of the
    magnetometer's unit and how many are a µT. rotated: whether its offset and matrix come after the rotation, and the
    offset is then added.
    """

    name: str
    sensors: int
    logs_numbers: bool
    rotations: Mapping[int, tuple[float, float, float]] = {}
    short: Mapping[str, str]
    patterns: Mapping[str, str]
    identity: str
    orientation: str
    offset: str
    scale: str
    matrix: tuple[str, str, str]
    unit: tuple[str, float]
    rotated: bool

    def label(self, number: int) -> str:
        """What stands for a sensor's number, from 0, in the names of its parameters."""
        return str(number)

    def parameter(self, pattern: str, triad: str, number: int, **parts: str) -> str:
        """The name of a parameter of a sensor."""
        return pattern.format(sensor=self.short[triad], number=self.label(number), **parts)

    @abstractmethod
    def rotation(self, file: ParameterFile, triad: str, number: int) -> FloatArray:
        """(3, 3) R. Raises `InputError` where the parameters do not say it."""

    @abstractmethod
    def thermal(self, file: ParameterFile, triad: str, number: int, celsius: float | None) -> FloatArray:
        """(3,) t at a temperature, SI; zero unless enabled. Raises `InputError` where it must be known and is not."""

    def identities(self, file: ParameterFile, triad: str) -> dict[int, int]:
        """The device IDs of a triad's sensors, by number; those that are not there have none."""
        names = [self.parameter(self.identity, triad, number) for number in range(self.sensors)]
        ids = {number: int(file.value(name, 0.0)) for number, name in enumerate(names)}
        return {number: identity for number, identity in ids.items() if identity}

    def numbered(self, file: ParameterFile, parameter: str, number: float) -> FloatArray:
        """(3, 3) the rotation of a number. Raises `InputError` for one that the firmware does not list."""
        known = dict(enumerate(tuple(map(float, angles.split())) for angles in _ROTATIONS.split(",")))
        angles = (known | dict(self.rotations)).get(int(number))
        if angles is None or number != int(number):
            raise InputError(f"{file.path}: {parameter} is {number:g}, which is no rotation that {self.name} lists.")
        return rotation_of(*angles)

    def values(self, parameters: ExportedUnit) -> tuple[dict[str, float], str, dict[str, Correction], str]:
        """The named values, the equation that applies them, what is left of the correction, and words on the rotation.

        accelerometer: u = (y − offset) ∘ scale; gyroscope: u = y − offset; magnetometer: h = S (y − offset).
        """
        values, equation, corrections, words = {}, [], {}, ""
        number = parameters.instance or 0
        for name, of_log in parameters.triads.items():
            logged = parameters.logged.get(name, Logged())
            triad = logged.of_sensor(of_log)
            if name == "magnetometer":
                axes = signed_axes(triad)
                matrix = symmetric_matrix(triad, axes)
                shift = self.unit[1] * triad.bias
                corrections[name] = Correction(matrix, triad.bias, frame=axes.T)
                if self.rotated:
                    matrix = axes @ matrix @ axes.T
                    shift = -axes @ shift
                parts = (shift, np.diag(matrix), matrix[[0, 0, 1], [1, 2, 2]])
                written = dict(zip(self.matrix, parts, strict=True))
                word = self.matrix[0]
                sign = "+" if self.rotated else "-"
                equation += [f"h [{self.unit[0]}] = S (y {sign} {word}), S = {exact_text(matrix)}"]
                equation += [f"{word} = {exact_text(shift)}"]
                if not np.array_equal(axes, np.eye(3)):
                    along = ["+-"[int(sum(column) < 0)] + "xyz"[int(np.flatnonzero(column)[0])] for column in axes.T]
                    words = (
                        f" The magnetometer's x, y, z lie along {', '.join(along)} of the unit: set "
                        f"{self.parameter(self.orientation, name, number)} to say so."
                    )
            elif name == "accelerometer":
                written = {self.offset: triad.bias, self.scale: diagonal_scale(triad)}
                corrections[name] = Correction(np.diag(written[self.scale]), triad.bias)
                equation += [f"a = (y - {self.offset}) * {self.scale}, axis by axis"]
            else:
                written = {self.offset: triad.bias}
                corrections[name] = Correction(np.eye(3), triad.bias)
                equation += [f"w = y - {self.offset}"]
            corrections[name] = logged.correction(corrections[name])
            if name != "magnetometer":
                equation += [f"{word} = {exact_text(part)}" for word, part in written.items()]
            values |= {
                self.parameter(self.patterns[name], name, number, word=word, axis=axis): float(value)
                for word, part in written.items()
                for axis, value in zip("XYZ", part, strict=True)
            }
        return values, "\n".join(equation), corrections, words


def cubic(coefficients: FloatArray, about: float, celsius: float, low: float, high: float) -> FloatArray:
    """(3,) the cubic of each axis, coefficients (4, 3) constant first, the temperature held between `low`, `high`."""
    return np.vander([np.clip(celsius, low, high) - about], 4, increasing=True)[0] @ coefficients


def need_temperature(file: ParameterFile, parameter: str, celsius: float | None) -> float:
    """The calibration's temperature. Raises `InputError` where it is not known."""
    if celsius is None:
        raise InputError(
            f"{file.path}: {parameter} is on, and the calibration does not say its temperature: calibrate a log that "
            "has it, or calibrate what the autopilot has corrected (sensor_combined, vehicle_imu, IMU)."
        )
    return celsius


def diagonal_scale(triad: LinearTriad) -> np.ndarray:
    """(3,) the scale s that leaves the least mean square error of s ∘ K u against u, u in every direction alike."""
    return np.diag(triad.gain) / np.sum(triad.gain**2, axis=1)


def signed_axes(triad: LinearTriad) -> np.ndarray:
    """(3, 3) the signed permutation P that is nearest to the direction of the axes: a field u is seen as about Pᵀu."""
    share = (triad.gain / np.linalg.norm(triad.gain, axis=1, keepdims=True)).T
    rows, columns = scipy.optimize.linear_sum_assignment(-np.abs(share))
    axes = np.zeros((3, 3))
    axes[rows, columns] = np.sign(share[rows, columns])
    return axes


def symmetric_matrix(triad: LinearTriad, axes: np.ndarray) -> np.ndarray:
    """(3, 3) the symmetric S with the least mean square error of S K u against axesᵀ u, u in every direction alike.

    Its normal equation is S A + A S = axesᵀ Kᵀ + K axes with A = K Kᵀ.
    """
    known = triad.gain @ axes
    matrix = scipy.linalg.solve_continuous_lyapunov(triad.gain @ triad.gain.T, known + known.T)
    return 0.5 * (matrix + matrix.T)
