"""What a file could not carry, and what that costs over the range of a calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np

from jaximu.calibration import Calibration
from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import rms
from jaximu.ground.precision import require_float64
from jaximu.ground.quantities import size
from jaximu.ground.units import SENSOR_QUANTITIES, SENSOR_UNITS
from jaximu.ground.vectors import lengths_of
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus
from jaximu.report.export.base import ExportedUnit, Written

_SAMPLES = 1080
_NOTHING = 1e-12  # m/s² or rad/s: rounding


@dataclass(frozen=True)
class Range:
    """What costs are worked out over: gravity in every direction, turns, vibration and temperature.

    gravity: m/s². rate: greatest angular rate about any axis, rad/s. temperature: (lowest, highest), °C.
    vibration: mean square of the vibration, (m/s²)². field: strength of the magnetic field, µT; current: greatest, A.
    """

    gravity: float
    rate: float
    temperature: tuple[float, float]
    vibration: float = 1.0
    field: float | None = None
    current: float = 1.0

    @classmethod
    def of(
        cls, calibration: Calibration, rate: float | None = None, temperature: tuple[float, float] | None = None
    ) -> Range:
        """The range of a calibration: 250 °/s, and 20 K about the temperature that it holds for, unless stated."""
        about = float(calibration.data.get("temperature", calibration.imu.accelerometer.temperature_reference))
        return cls(
            calibration.gravity.value,
            rate or np.radians(250.0),
            temperature or (about - 20.0, about + 20.0),
            field=None if calibration.magnetic is None else float(calibration.magnetic["field"]["strength"]["value"]),
        )

    def text(self) -> str:
        """The range in words."""
        return (
            f"gravity ({self.gravity:.5g} m/s^2) in every direction, turns up to {np.degrees(self.rate):.4g} deg/s "
            f"about any axis, {self.temperature[0]:.4g} to {self.temperature[1]:.4g} degC"
            + ("" if self.field is None else f", {self.field:.4g} uT in every direction, {self.current:.2g} A")
        )

    def paths(self) -> tuple[Stimulus, Stimulus]:
        """A minute of turning at the middle of the temperatures; three hours in which they go up and down.

        Both go through every attitude and the whole rate about one axis after the other. They are equally long, so
        that one compiled function serves both.
        """
        time = np.arange(_SAMPLES) * (60.0 / _SAMPLES)
        tilt = np.pi * time / 60.0
        turn = 2 * np.pi * time / 3.7
        up = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], 1)
        frequency = np.array([0.31, 0.43, 0.59]) * 2 * np.pi
        share = 0.2 + 0.8 * np.eye(3)[(time // 5).astype(int) % 3]
        share *= 10.0 ** -np.maximum(time - 54.0, 0.0)[:, None]  # down to rates that a dead band swallows
        angle = frequency * time[:, None]
        force = self.gravity * up
        rate = self.rate * share * np.sin(angle)
        low, high = self.temperature
        still = np.zeros((_SAMPLES, 3))
        swing = 1.0 - np.abs(1.0 - time / 30.0)
        slope = (high - low) / 5400.0 * np.where(time < 30.0, 1.0, -1.0)
        return (
            self._stimulus(
                time,
                force,
                rate,
                self.rate * share * frequency * np.cos(angle),
                np.full(_SAMPLES, 0.5 * (low + high)),
                still[:, 0],
            ),
            self._stimulus(180.0 * time, force, rate, still, low + (high - low) * swing, slope),
        )

    def _stimulus(self, time, force, rate, acceleration, temperature, slope) -> Stimulus:
        return Stimulus(
            force,
            rate,
            acceleration,
            temperature,
            slope,
            time,
            np.tile([1.0, 0.0, 0.0, 0.0], (len(time), 1)),
            np.full(len(time), self.vibration),
            (self.field or 0.0) / self.gravity * force,
            self.current * np.sin(0.4 * np.arange(len(time))),
        )


@dataclass(frozen=True)
class Loss:
    """One thing that a file does not hold, and the greatest and rms error of the corrected values without it.

    worst, rms: by triad, in m/s² and rad/s (the length of the error vector); None where it is not determined.
    """

    what: str
    worst: Mapping[str, float | None]
    rms: Mapping[str, float | None]

    def text(self) -> str:
        """The loss as one line."""
        costs = [
            f"{size(worst, SENSOR_UNITS[name])} at worst, {size(rms, SENSOR_UNITS[name])} rms"
            if worst is not None and rms is not None
            else f"the {name} is not determined"
            for (name, worst), rms in zip(self.worst.items(), self.rms.values(), strict=True)
            if worst != 0
        ]
        return f"{self.what}: {'; '.join(costs) or 'costs nothing here'}"


def losses(parameters: ExportedUnit, written: Written, extent: Range) -> tuple[Loss, ...]:
    """What the file leaves out of the calibration, each with its cost, then all of it together, then the uncertainty.

    The whole model is simulated over `extent` and corrected as the other tool corrects; the difference from the truth
    is the loss. Effects of a session or the set-up are left out on both sides, as `compensate` leaves them alone.
    """
    require_float64()
    parameters = written.parameters or parameters
    imu = parameters.calibration.imu.transferable()
    paths = extent.paths()
    plain = [_outputs(imu.with_effects(), path) for path in paths]
    parts = [
        _loss(f"the {name}'s calibration", {name: _gap(parameters, written, name, plain, paths)})
        for name in parameters.triads
        if name not in written.corrections
    ]
    flat = {
        name: replace(correction, g_sensitivity=np.zeros((3, 3))) for name, correction in written.corrections.items()
    }
    flattened = replace(written, corrections=flat)
    parts.append(
        _loss(
            "scale, misalignment and offset, as far as the file has no place for them",
            {name: _gap(parameters, flattened, name, plain, paths) for name in flat},
        )
    )
    for name, triad in imu.triads().items():
        inverse = np.linalg.inv(np.asarray(triad.gain))
        for effect in triad.effects:
            if effect.name not in written.carried:
                one = [_outputs(imu.with_effects(effect), path) for path in paths]
                shift = [(with_[name] - without[name]) @ inverse.T for with_, without in zip(one, plain, strict=True)]
                parts.append(_loss(f"the effect {effect.name}", {name: np.concatenate(shift)}))
    parts = [part for part in parts if any((worst or 0.0) > _NOTHING for worst in part.worst.values())]
    if len(parts) > 1:
        whole = [_outputs(imu, path) for path in paths]
        gaps = {name: _gap(parameters, written, name, whole, paths) for name in parameters.triads}
        parts.append(_loss("all of this together", gaps))
    return (*parts, *(() if written.uncertainty else (_uncertainty(parameters.calibration, extent),)))


@eqx.filter_jit
def _respond(imu: Imu, stimulus: Stimulus):
    return {name: triad.respond(stimulus) for name, triad in imu.triads().items()}


def _outputs(imu: Imu, path: Stimulus) -> dict[str, FloatArray]:
    return {name: np.asarray(values) for name, values in _respond(imu, path).items()}


def _gap(
    parameters: ExportedUnit, written: Written, name: str, outputs: list[dict[str, FloatArray]], paths: tuple
) -> FloatArray:
    """(samples, 3) the tool's answer less the truth, in the tool's frame."""
    gaps = []
    for output, path in zip(outputs, paths, strict=True):
        logged = {triad: values @ parameters.maps[triad] for triad, values in output.items()}  # y_log = Aᵀ y_body
        truth = np.asarray(getattr(path, SENSOR_QUANTITIES[name])) @ parameters.frames[name]
        correction = written.corrections.get(name)
        if correction is None:  # only tools that take SI leave a triad as it is
            gaps.append(logged[name] - truth)
            continue
        force = None
        if np.any(correction.g_sensitivity):
            force = written.corrections["accelerometer"].apply(logged["accelerometer"])
        gaps.append(correction.apply(logged[name], force) - truth @ correction.frame.T)
    return np.concatenate(gaps)


def _loss(what: str, errors: dict[str, FloatArray]) -> Loss:
    """The greatest and rms length of errors (..., 3); None where one of them is not finite."""
    lengths = {name: lengths_of(error) for name, error in errors.items()}
    known = {name: bool(np.isfinite(length).all()) for name, length in lengths.items()}
    return Loss(
        what,
        {name: float(length.max()) if known[name] else None for name, length in lengths.items()},
        {name: rms(length) if known[name] else None for name, length in lengths.items()},
    )


def _uncertainty(calibration: Calibration, extent: Range) -> Loss:
    """The standard deviation of corrected values (the length of their vector) over the range."""
    still, moving = map(calibration.uncertainty_of, extent.paths())
    return _loss(
        "the uncertainty (1 sigma of corrected values; not an error of the file)",
        {name: np.stack([uncertainty.sigma, moving[name].sigma]) for name, uncertainty in still.items()},
    )
