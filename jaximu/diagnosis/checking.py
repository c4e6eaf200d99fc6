"""Whether an old calibration still holds for a new recording: the questions, and what their answers say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax
import numpy as np
from numpy.typing import NDArray

from jaximu import stored
from jaximu.calibration import Calibration
from jaximu.diagnosis.comparison import Fresh, Old, Question, candidates, label, scatter_about_a_fit
from jaximu.diagnosis.hand_held import HandHeld
from jaximu.diagnosis.noise import own_noise
from jaximu.diagnosis.selection import Selection, select
from jaximu.diagnosis.validity import Cause, OutputError, Shift, Validity
from jaximu.distributions import chi2_sf, normal_sf
from jaximu.effects import CATALOGUE
from jaximu.errors import InputError
from jaximu.gravity import STANDARD, LocalGravity
from jaximu.noise.model import NoiseModel
from jaximu.precision import require_float64
from jaximu.recording import Recording
from jaximu.rotation import (
    apply_matrix,
    compose_rotation_vectors,
    conjugate,
    inverse_matrix,
    logarithm,
    multiply,
)
from jaximu.segmentation import SegmentationOptions, observe, segment
from jaximu.sensor import Imu
from jaximu.units import STANDARD_GRAVITY

__all__ = ["check"]

FloatArray = NDArray[np.float64]
_OTHER_UNIT = 0.05
"""Difference of gains, in scales, that no unit's calibration makes: it is another unit, or its axes or units are."""
_FAR_OFF = (0.05 * STANDARD_GRAVITY, 0.2)
"""Errors (m/s² of gravity's norm, rad over a turn) that no calibration's age makes, in the median."""
_FEWEST = 12
"""Dimensions that the parameters must leave for effects to be asked for."""
_WARMTH = 1.0  # K


def check(
    calibration: Calibration,
    recordings: Recording | Sequence[Recording],
    gravity: LocalGravity = STANDARD,
    static: Recording | NoiseModel | None = None,
    segmentation: SegmentationOptions | None = None,
    level: float = 0.05,
) -> Validity:
    """Ask whether an old calibration still holds for new recordings of poses and turns.

    The old calibration, its uncertainty included, predicts what the new recording should satisfy. If it fails, single
    parameters, whole triads, effects of the session and effects of the unit that it lacks are tried as explanations,
    with a family-wise level. A fresh calibration, about the old one, tells each parameter's difference. The
    gyroscope's bias is another after every power-on: it is told, but not tested. Where no calibration fits the
    recording to its noise, the noise is widened, kind by kind, to what it scatters about a fresh one.

    **Arguments:** `recordings`, `gravity`, `static`, `segmentation` as for [`jaximu.diagnosis.diagnose`]; gravity
    stated as it was for the old calibration is taken for the same place, whose uncertainty is common to both. `level`:
    rate of false alarms.

    Raises `InputError` where output units differ, one of the two has no gyroscope, or the outputs are so far off that
    it is hardly the same unit; `NotPossibleError` where no poses are found.
    """
    require_float64()
    recordings = [recordings] if isinstance(recordings, Recording) else list(recordings)
    _same_sensors(calibration, recordings)
    parts = tuple(segment(recording, segmentation) for recording in recordings)
    noise = NoiseModel.fit(static) if isinstance(static, Recording) else static
    notes = [note for recording in recordings for note in recording.notes] + [n for part in parts for n in part.notes]
    if noise is None:
        noise = own_noise(replace(calibration, segmentations=parts))
        notes += noise.notes
    old = Old.of(calibration, gravity)
    experiment = HandHeld(parts, observe(parts, gravity.value, noise=noise), old.imu.with_effects())
    old = old.rested(experiment)
    notes += _temperatures(calibration, old, experiment)
    conditions = experiment.predict(old.imu)[0]
    _same_unit(experiment, conditions, recordings[0].name)

    scatter = np.ones(len(experiment.residual_kinds))
    fresh = Fresh.fit(old, experiment, scatter)
    _same_gains(old, fresh, recordings[0].name)
    enough = len(conditions) - len(old.names) >= _FEWEST and bool(fresh.known(old).all())
    others = candidates(old, experiment) if enough else []
    question = Question.ask(old, experiment, scatter, others)
    selection = select(question.evidence, level)
    if not selection.complete:
        scatter = scatter_about_a_fit(old, experiment, fresh)
        question = Question.ask(old, experiment, scatter, others)
        selection = select(question.evidence, level)
    causes = _causes(question, selection, old)
    chosen = [question.candidates[cause.block] for cause in selection.causes] if selection.complete else []
    given = [each.columns for each in chosen if each.scope != "parameter"]
    if given or scatter.max() > 1:
        fresh = Fresh.fit(old, experiment, scatter, given, fresh.imu)
    if not fresh.converged:
        notes.append(
            "the fresh calibration did not come to rest: the differences from it may be off by more than told."
        )
    verdict = _verdict(selection, causes)
    shifts = _shifts(old, fresh, 0.0 if verdict == "valid" else level)
    compared = [k for k, each in enumerate(shifts) if each.tested]
    square = 0.0
    if compared:
        spread = fresh.covariance_of_difference[np.ix_(compared, compared)]
        square = float(fresh.difference[compared] @ np.linalg.solve(spread, fresh.difference[compared]))
    unknown = [each.name for each in shifts if not each.comparable]
    if unknown:
        notes.append(
            f"the recording's poses and turns are too few or too alike to tell {len(unknown)} of {len(shifts)} "
            f"parameters, which were not compared: {', '.join(unknown)}."
        )
    if not enough:
        notes.append(
            "too few poses and turns to ask for effects of the session: record twenty poses or more to tell them from "
            "parameters that moved."
        )
    kinds = [kind.name for kind in experiment.residual_kinds]
    wide = {name: float(value) for name, value in zip(kinds, scatter, strict=True)}
    if scatter.max() > 1:
        said = ", ".join(f"{name.replace('_', ' ')} {value:.1f}" for name, value in wide.items() if value > 1)
        notes.append(
            f"the recording scatters more than its noise about any calibration ({said} times): the noise was widened "
            "by it. `jaximu diagnose` seeks the reason."
        )
    before, after = (experiment.summary(each) for each in (conditions, fresh.conditions))
    poses = int(np.sum(experiment.observations.poses.mask))
    turns = int(np.sum(experiment.observations.turns.mask))
    sources = [source for recording in recordings for source in recording.sources]
    files = [{"file": str(s.path), "sha256": s.sha256, "rows": s.rows} for s in sources]
    return Validity(
        verdict=verdict,
        p_value=selection.p_value,
        chi_squared=float(question.evidence.residual @ question.evidence.residual),
        freedom=question.evidence.freedom,
        difference=(square, len(compared), float(chi2_sf(square, len(compared))) if compared else 1.0),
        shifts=shifts,
        causes=causes,
        output_errors={} if unknown else _output_errors(old, fresh, experiment),
        errors={name: (value, after[name][0], unit) for name, (value, unit) in before.items()},
        scatter=wide,
        notes=tuple(dict.fromkeys(notes)),
        experiment=experiment,
        conditions=(conditions, fresh.conditions),
        data={**(files[0] if files else {}), "poses": poses, "turns": turns, "files": files},
        calibration=calibration,
    )


def _same_sensors(calibration: Calibration, recordings: Sequence[Recording]) -> None:
    if not recordings:
        raise InputError("no recording was given.")
    for recording in recordings:
        for name in ("accelerometer", "gyroscope"):
            triad, signal = calibration.triads().get(name), getattr(recording, name)
            if triad is None:
                raise InputError(
                    "the calibration has no gyroscope, and a check needs one: turns tell most causes apart. Calibrate "
                    "both sensors first."
                )
            if signal is None:
                raise InputError(
                    f"{recording.name} has no gyroscope, but the calibration has one: add its log (--gyro-log)."
                )
            if signal.unit != triad.output_unit:
                raise InputError(
                    f"{recording.name}: the {name} is in {signal.unit}, but it was calibrated in {triad.output_unit}; "
                    "state the columns' units as in the recording that was calibrated."
                )


def _same_unit(experiment: HandHeld, conditions: FloatArray, name: str) -> None:
    values, kinds = experiment.in_si(conditions), experiment.kinds
    for place, (kind, limit) in enumerate(zip(experiment.residual_kinds, _FAR_OFF, strict=False)):
        own = values[kinds == place].reshape(-1, kind.components)
        if not len(own):
            continue
        size = float(np.median(np.linalg.norm(own, axis=1)))
        if size > limit:
            raise InputError(
                f"{name}: with this calibration the {kind.name.replace('_', ' ')} is off by {kind.factor * size:.3g} "
                f"{kind.unit} in the median: is it the same unit, in the same units and axes?"
            )


def _same_gains(old: Old, fresh: Fresh, name: str) -> None:
    for place, each in enumerate(old.names):
        if each.part != "gain":
            continue
        scale, shift = old.scales[place], abs(fresh.difference[place])
        if shift > _OTHER_UNIT * scale and shift > 5 * np.sqrt(fresh.covariance_of_difference[place, place]):
            raise InputError(
                f"{name}: the {each.owner}'s gain differs from the calibration's by {100 * shift / scale:.2g} % ({each}): "
                "is it the same unit, in the same units and axes?"
            )


def _temperatures(calibration: Calibration, old: Old, experiment: HandHeld) -> list[str]:
    """Say where temperatures differ and the calibration has nothing that depends on them."""
    before = calibration.data.get("temperature")
    if before is None or any("temperature" in " ".join(effect.needs) for effect in old.imu.all_effects().values()):
        return []
    if any(part.recording.temperature is None for part in experiment.segmentations):
        return []
    poses = experiment.observations.poses
    after = float(np.mean(np.asarray(poses.temperature)[np.asarray(poses.mask)]))
    if abs(after - before) < _WARMTH:
        return []
    return [
        f"the calibration was made at {before:.1f} °C and this recording at {after:.1f} °C in the mean, and nothing in "
        "the calibration depends on temperature: what moved may be that."
    ]


def _causes(question: Question, selection: Selection, old: Old) -> tuple[Cause, ...]:
    """What was selected, in words; of nested groups of parameters none is the other's rival."""
    if not selection.complete:
        return ()
    chosen = [cause.block for cause in selection.causes]
    evidence = question.evidence
    numbers = evidence.coefficients(chosen) if chosen else np.zeros(0)
    edges = np.cumsum([0, *(len(evidence.blocks[k].sizes) for k in chosen)])
    found = []
    for cause, a, b in zip(selection.causes, edges[:-1], edges[1:], strict=True):
        taken = question.candidates[cause.block]
        block, scope, places = taken.block, taken.scope, taken.places
        others = [question.candidates[k] for k in cause.rivals]
        rivals = {each.block.name for each in others if not scope == each.scope == "parameter"} - {block.name}
        unit = ""
        if len(places) == 1:
            unit = old.units[places[0]]
        elif block.name in CATALOGUE:
            kind = CATALOGUE[block.name]
            unit = kind.coefficient_unit(old.imu.triads().get(kind.owner, old.imu.accelerometer).output_unit)
        found.append(Cause(block.name, scope, tuple(old.names[k] for k in places), tuple(sorted(rivals)),
                           cause.p_value, numbers[a:b] * block.sizes, dict(block.inner), unit))  # fmt: skip
    return tuple(found)


def _verdict(selection: Selection, causes: Sequence[Cause]) -> str:
    if not selection.complete:
        return "unexplained"
    if not causes:
        return "valid"
    lacking = [CATALOGUE[cause.name].owner for cause in causes if cause.scope == "device"]
    # what a triad lacks was in part taken for its gain and bias: that they are others now is no fault of theirs
    moved = any(name.effect is not None or name.owner not in lacking for cause in causes for name in cause.parameters)
    return "shifted" if moved else ("effect" if lacking else "session")


def _shifts(old: Old, fresh: Fresh, level: float) -> tuple[Shift, ...]:
    """Every parameter's difference; at level zero none counts as moved: the recording says nothing against them."""
    difference, sigma = fresh.difference, np.sqrt(np.diag(fresh.covariance_of_difference))
    comparable = fresh.known(old)
    raw = 2 * normal_sf(np.abs(difference) / sigma)
    asked = [k for k in np.argsort(raw) if comparable[k] and k in old.tested]
    p_value = np.ones(len(raw))
    worst = 0.0
    for rank, k in enumerate(asked):
        worst = max(worst, min(1.0, float(raw[k]) * (len(asked) - rank)))
        p_value[k] = worst
    found = []
    for k, name in enumerate(old.names):
        gain = name.part == "gain"
        unit, at, size = (
            ("m/s^2", "1 g", STANDARD_GRAVITY) if name.owner == "accelerometer" else ("rad/s", "1 rad/s", 1.0)
        )
        factor = float((size if gain else 1.0) / old.scales[k]) if name.effect is None else None
        found.append(Shift(
            label(name, old.imu), name, float(old.values[k]), float(difference[k]), float(sigma[k]), old.units[k],
            None if factor is None else factor * float(difference[k]),
            None if factor is None else factor * float(sigma[k]), "" if factor is None else unit, at if gain else "",
            float(p_value[k]), bool(p_value[k] < level), bool(comparable[k]), k in old.allowed,
        ))  # fmt: skip
    return tuple(found)


# --- what it does to the output --------------------------------------------------------------------------------------


def _output_errors(old: Old, fresh: Fresh, experiment: HandHeld) -> dict[str, OutputError]:
    """The largest difference of the outputs in the recording, gyroscope bias apart, and of the turns' rotations."""
    found = {}
    for name, unit in (("accelerometer", "m/s^2"), ("gyroscope", "rad/s")):
        before, after = old.imu.triads()[name], fresh.imu.triads()[name]
        places = old.places(name, "gain", "bias")
        best = (-1.0, np.zeros(3))
        for part in experiment.segmentations:
            values = getattr(part.recording, name).values
            true = (values - np.asarray(after.bias)) @ np.linalg.inv(np.asarray(after.gain)).T
            bias = np.asarray(after.bias if name == "gyroscope" else before.bias)
            told = (values - bias) @ np.linalg.inv(np.asarray(before.gain)).T
            size = np.linalg.norm(told - true, axis=1)
            place = int(np.argmax(size))
            best = max(best, (float(size[place]), true[place]), key=lambda pair: pair[0])
        value, force = best
        inverse = np.linalg.inv(np.asarray(before.gain))
        columns = []
        for k in places:
            row, *column = old.names[k].axes
            columns.append(inverse[:, row] * (force[column[0]] if column else 1.0))
        slope = np.stack(columns, axis=1)
        spread = slope @ fresh.covariance_of_difference[np.ix_(places, places)] @ slope.T
        found[name] = OutputError(value, float(np.sqrt(np.trace(spread))), unit)
    turns = experiment.observations.turns
    real = np.asarray(turns.mask)
    if real.any():
        vectors, slope = (
            np.degrees(np.asarray(each)[real])
            for each in stored.call(
                _turned,
                "turns of two gains",
                old.imu.with_effects(),
                fresh.imu.with_effects(),
                turns.output,
                turns.interval,
            )
        )
        worst = int(np.argmax(np.linalg.norm(vectors, axis=1)))
        places = old.places("gyroscope", "gain")
        slope = slope[worst].reshape(3, 9)
        spread = slope @ fresh.covariance_of_difference[np.ix_(places, places)] @ slope.T
        value = float(np.linalg.norm(vectors[worst]))
        found["turns"] = OutputError(value, float(np.sqrt(np.trace(spread))), "deg")
    return found


def _turned(old: Imu, new: Imu, output, interval):
    """Rotation vectors (T, 3), rad, from each turn as the old gain tells it to the new one's, and their derivatives.

    With the new bias in both; derivatives (T, 3, 3, 3) by the gain.
    """
    assert old.gyroscope is not None and new.gyroscope is not None
    bias = new.gyroscope.bias

    def told(gain):
        rates = apply_matrix(inverse_matrix(gain), output - bias)
        return compose_rotation_vectors(rates * interval[..., None])

    before = conjugate(told(old.gyroscope.gain))

    def vectors(gain):
        return logarithm(multiply(before, told(gain)))

    return vectors(new.gyroscope.gain), jax.jacfwd(vectors)(new.gyroscope.gain)
