"""Poses and turns by hand while the temperature changes: bias, scale and misalignment over it, both triads at once.

The conditions are those of any hand-held recording: the norm of gravity in each pose, its direction carried over each
turn by the gyroscope, and the gyroscope at rest. Terms are taken in by the criterion of every selection of causes, and
stay where they predict parts of the recording left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from jaximu._version import __version__
from jaximu.calibration import Calibration, calibrate
from jaximu.calibration.refusals import require_solved
from jaximu.data.rest_blocks import LEAST_RANGE
from jaximu.diagnosis.diagnosis import extended, recorded_by_hand
from jaximu.diagnosis.experiment import Experiment, State
from jaximu.diagnosis.learned import left_out
from jaximu.diagnosis.noise import usual_noise
from jaximu.diagnosis.selection import criterion
from jaximu.estimation.rows import Sizes
from jaximu.ground.document import Document, Json
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.gravity import STANDARD, Gravity, as_gravity
from jaximu.ground.page import Result
from jaximu.model.effects import CATALOGUE
from jaximu.model.noise_model import NoiseModel
from jaximu.noise.at_rest import noise_of
from jaximu.recordings.recording import Recording, recordings_of
from jaximu.recordings.segmentation import segment

SCHEMA = "jaximu.thermal/1"
_PLAIN = ("temperature", "temperature_squared", "temperature_cubed", "scale_temperature", "misalignment_temperature")
ASKED = tuple(f"{prefix}.{name}" for prefix in ("accel", "gyro") for name in _PLAIN)
_FIRST = {"temperature_squared": "temperature", "temperature_cubed": "temperature_squared"}
"""Powers come one after the other, or what is kept would depend on the reference temperature."""
_POSES, _LONG = 9, 300.0  # fewest poses by hand; s, of rests that are longer than a hand is still


@dataclass(frozen=True, repr=False, eq=False)
class HandHeldThermal(Result, Document, page="thermal_hand_held"):
    """A unit calibrated by hand over temperature.

    calibration: with the effects chosen. base, state: the fits without and with them. steps: what each effect, in the
    order it was taken in, gained: statistic, and nats on parts left out. limits: by effect, what could still hide, and
    its unit. undetermined: effects that the recording does not tell, and why.
    """

    calibration: Calibration
    base: State
    state: State
    experiment: Experiment
    range: tuple[float, float]
    steps: tuple[tuple[str, float, float], ...]
    limits: Sizes
    undetermined: dict[str, str]
    notes: tuple[str, ...] = ()
    software: dict[str, str] = field(default_factory=lambda: {"name": "jaximu", "version": __version__})

    def document(self) -> Json:
        """Return everything as the JSON document of schema `jaximu.thermal/1`."""
        return {
            "schema": SCHEMA,
            "kind": "hand-held",
            "temperature_range": list(self.range),
            "effects": [
                {"name": name, "statistic": statistic, "heldout_loglik": gain} for name, statistic, gain in self.steps
            ],
            "detection_limits": {name: {"value": value, "unit": unit} for name, (value, unit) in self.limits.items()},
            "undetermined": self.undetermined,
            "rms": {
                name: {"before": before, "after": after, "unit": unit}
                for name, (before, after, unit) in self.calibration.rms.items()
            },
            "notes": list(self.notes),
            "calibration": self.calibration.document(),
            "software": self.software,
        }


def turned_by_hand(recording: Recording) -> bool:
    """Return whether a recording is poses and turns rather than rests of minutes."""
    if recording.gyroscope is None:
        return False
    try:
        intervals = segment(recording).intervals
    except NotPossibleError:
        return False
    return len(intervals) >= _POSES and float(np.median(np.diff(intervals, axis=1))) < _LONG


def calibrate_thermal_by_hand(
    recordings: Recording | Sequence[Recording],
    static: Recording | NoiseModel | None = None,
    gravity: Gravity = STANDARD,
) -> HandHeldThermal:
    """Calibrate a unit from poses and turns by hand while the temperature changes.

    **Arguments:** as for [`jaximu.calibrate`]. Bias, scale and misalignment of both triads over temperature are asked
    for; what the recording does not determine is said.

    Raises `NotPossibleError` where the recordings cannot be calibrated, have no gyroscope or temperature, the
    temperature does not change, or the fit does not converge.
    """
    gravity = as_gravity(gravity)
    logs = recordings_of(recordings)
    for recording in logs:
        if recording.gyroscope is None or recording.temperature is None:
            raise NotPossibleError(f"{recording.name}: poses by hand over temperature need gyroscope and temperature.")
    temperature = np.concatenate([log.temperature.values[:, 0] for log in logs if log.temperature is not None])
    low, high = float(temperature.min()), float(temperature.max())
    if high - low < LEAST_RANGE:
        raise NotPossibleError(
            f"{logs[0].name}: the temperature only goes from {low:.2f} to {high:.2f} °C; {LEAST_RANGE:g} K or more "
            "are needed to see what depends on it. Record poses while the unit warms or cools."
        )
    noise = noise_of(static)
    calibration = calibrate(logs, gravity)

    experiment = Experiment(recorded_by_hand(calibration), calibration.imu.with_effects(), candidates=ASKED)
    noise = usual_noise(experiment) if noise is None else noise
    experiment = replace(experiment, data=experiment.data.with_noise(noise))
    base = experiment.fit()
    state, steps = _extended(experiment, base)
    result = extended(calibration, experiment, state, noise)
    assert result.fit is not None
    require_solved(result.fit, logs[0].name)
    notes = tuple(dict.fromkeys((*calibration.notes, *noise.notes)))
    data = result.data | {"temperature_range": [low, high]}
    return HandHeldThermal(
        replace(result, data=data, notes=notes),
        base,
        state,
        experiment,
        (low, high),
        tuple(steps),
        state.limits,
        state.blind,
        notes,
    )


def _extended(experiment: Experiment, state: State) -> tuple[State, list[tuple[str, float, float]]]:
    """Take effects into a fit, one after another, while each predicts parts left out better; say what each gained."""
    steps: list[tuple[str, float, float]] = []
    refused: set[str] = set()
    while (best := _next(state, refused)) is not None:
        name, statistic = state.evidence.blocks[best].name, float(state.evidence.scores().statistic[best])
        try:
            extension = experiment.fit((*state.effects, CATALOGUE[name].dormant()), state.imu)
        except NotPossibleError:  # beside the others it comes to nothing
            refused.add(name)
            continue
        gain = left_out(experiment, state, extension).log_likelihood
        if gain > 0:
            state = extension
            steps.append((name, statistic, gain))
        else:
            refused.add(name)
    return state, steps


def _next(state: State, refused: set[str]) -> int | None:
    """Return the place of the effect that gains most by the criterion of every selection, if any does."""
    evidence, inside = state.evidence, {(effect.owner, effect.plain) for effect in state.effects}
    scores, gains = evidence.scores(), {}
    for k, block in enumerate(evidence.blocks):
        if block.kind == "effect" and block.name not in refused:
            kind = CATALOGUE[block.name]
            if kind.plain not in _FIRST or (kind.owner, _FIRST[kind.plain]) in inside:
                gains[k] = criterion(evidence, scores, k)
    best = max(gains, key=lambda k: gains[k], default=None)
    return None if best is None or gains[best] <= 0 else best
