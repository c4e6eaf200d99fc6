"""Calibration from recordings of poses and turns by hand, the one recipe behind [`jaximu.calibrate`][]."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np

from jaximu.calibration.arrangement import arrangement
from jaximu.calibration.calibration import Calibration, clock_sigma, concluded, effect_named, provenance
from jaximu.calibration.hand_held import Method, fit_hand_held
from jaximu.calibration.lost_time import lost_share, tells_losses, without_lost_stretches
from jaximu.calibration.nominal import nominal_imu
from jaximu.calibration.refusals import refuse_undetermined, relative_covariance, require_solved, require_spanning
from jaximu.calibration.saturation import saturation
from jaximu.data.by_hand import RecordedByHand
from jaximu.data.drift import with_drift
from jaximu.data.poses import EXCESS_NAMES, residual_rms
from jaximu.estimation.fitting import Prior, fit
from jaximu.estimation.problem import Loss
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import STANDARD, Gravity, LocalGravity, as_gravity
from jaximu.ground.precision import require_float64
from jaximu.mistakes import prepared
from jaximu.model.effects.base import Effect
from jaximu.model.effects.earth_rotation import GyroEarthRotation
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.noise.at_rest import noise_of
from jaximu.recordings.finding import Finding
from jaximu.recordings.observations import Observations
from jaximu.recordings.recording import Recording, recordings_of, same_outputs
from jaximu.recordings.segmentation import Segmentation, SegmentationOptions, observed_poses, segment

__all__ = [
    "Choices",
    "calibrate",
    "calibrate_ready",
]

_ROUNDS = 4
"""Times that turns which lost time are looked for."""
_NO_DRIFT = (
    "The intervals of the biases leave out slow drift: use the joint method with the linear loss, or add --static LOG."
)


@dataclass(frozen=True)
class Choices:
    """How recordings made by hand are calibrated; the fields are the options of [`jaximu.calibrate`][]."""

    gravity: LocalGravity = STANDARD
    static: Recording | NoiseModel | None = None
    segmentation: SegmentationOptions | None = None
    effects: Sequence[str | Effect] = ()
    effect_sigmas: Mapping[str, float] | None = None
    method: Method = "joint"
    loss: Loss = "linear"


def calibrate(
    recordings: Recording | Sequence[Recording],
    gravity: Gravity = STANDARD,
    *,
    static: Recording | NoiseModel | None = None,
    segmentation: SegmentationOptions | None = None,
    effects: Sequence[str | Effect] = (),
    effect_sigmas: Mapping[str, float] | None = None,
    method: Method = "joint",
    loss: Loss = "linear",
    repair: bool = False,
) -> Calibration:
    """Calibrate a unit from recordings of static poses and the turns between them, without equipment.

    **Arguments:**

    - `recordings`: one or several recordings of the same unit, in the same units and axes.
    - `gravity`: local gravity; its uncertainty goes into the scales'. Where it states a latitude, the Earth's rotation
      is in the model, its heading free (one recording, every turn between its poses usable).
    - `static`: a recording of the same unit at rest, or the `NoiseModel` fitted to one: white noise and slow
      bias, which ties poses and turns together; else the poses' own scatter tells the noise, as if it were white, and
      of slow drift the uncertainty alone knows, by what this recording shows of it.
    - `segmentation`: what counts as a pose.
    - `effects`: effects of the catalogue to fit with gain and bias, by name or with a start; jointly only.
    - `effect_sigmas`: standard deviations, by effect, to which its coefficients are known beforehand about their start.
    - `method`: `"joint"`, `"two-step"`, `"two-step-rk4"` or `"accelerometer"`, see
      [`jaximu.calibration.fit_hand_held`]; a recording without gyroscope always uses the last.
    - `loss`: `"linear"`, `"huber"` or `"cauchy"`.
    - `repair`: change what [`jaximu.mistakes.prepare`][] can put right; rows that are no measurement are left out
      in any case. The notes say what was found.

    Raises `InputError` where a sensor holds nothing to calibrate, and `NotPossibleError` where poses are missing or do
    not span, the fit does not converge, or the recording does not determine an effect of which nothing is known
    beforehand; the message says what to record.
    """
    gravity = as_gravity(gravity)
    recordings = recordings_of(recordings)
    choices = Choices(gravity, static, segmentation, effects, effect_sigmas, method, loss)
    with prepared(recordings, repair, gyroscope=method != "accelerometer") as ready:
        found, unusual = calibrate_ready([each.recording for each in ready], choices, repair)
    told = [*(note for each in ready for note in each.notes), *(each.text for each in unusual)]
    found = replace(found, notes=tuple(dict.fromkeys((*told, *found.notes))))
    return found if static is not None else _with_drift(found)


def _with_drift(found: Calibration) -> Calibration:
    """Return a calibration by hand whose uncertainty knows the drift of the biases that its recordings show."""
    if found.loss != "linear" or found.method.startswith("two-step"):
        return replace(found, notes=(*found.notes, _NO_DRIFT))
    assert found.fit is not None and found.observations is not None
    fit, told = with_drift(found.fit, found.observations, found.segmentations)
    covariance = fit.total_covariance(found.gravity.sigma, clock_sigma(found.segmentations))
    return replace(found, fit=fit, covariance=covariance, notes=(*found.notes, *told))


def calibrate_ready(
    recordings: Sequence[Recording], choices: Choices, repair: bool = False, losses: bool = True
) -> tuple[Calibration, list[Finding]]:
    """Calibrate recordings that [`jaximu.mistakes.prepare`][] has been over, as [`jaximu.calibrate`] does.

    **Returns:** the calibration, without turns that lost time, and what it says of lost time, axes, mounting and
    ranges; with `repair` axes are mapped. `losses`: whether lost time is looked for; turns that miss for another
    reason would be taken for it.
    """
    found = _calibrated(recordings, choices)
    findings = arrangement(recordings[0], found)
    wrong = [each for each in findings if each.apply is not None]
    if wrong and not repair:  # turns about wrong axes tell nothing of what was lost in them
        return found, findings
    for each in wrong:
        assert each.apply is not None
        recordings = [each.apply(recording) for recording in recordings]
    if wrong:
        findings = [replace(each, text=f"{each.text} This was repaired.") if each in wrong else each
                    for each in findings]  # fmt: skip
        found = _calibrated(recordings, choices)
    if not losses:
        return found, findings
    found, lost = _without_losses(found, choices)
    return found, [*lost, *findings]


def _without_losses(found: Calibration, choices: Choices) -> tuple[Calibration, list[Finding]]:
    """Calibrate again without the turns that lost time, as the fit shows them, and tell it."""
    if found.loss != "linear" or found.method != "joint" or not tells_losses(found):
        return found, []
    findings: list[Finding] = []
    for _ in range(_ROUNDS):  # a gross one moves the fit, and hides others
        kept, more = without_lost_stretches(found)
        if not more:
            break
        findings += more
        found = _calibrated(kept, choices)
    return found, [*findings, *(saturation(found) or lost_share(found))]


def _calibrated(recordings: Sequence[Recording], choices: Choices) -> Calibration:
    gravity, loss, static = choices.gravity, choices.loss, choices.static
    require_float64()
    mixed = same_outputs(recordings)
    has_gyroscope = all(recording.gyroscope is not None for recording in recordings)
    method = choices.method if has_gyroscope else "accelerometer"
    chosen = [effect_named(each) for each in choices.effects]
    if chosen and method != "joint":
        raise InputError(
            f"{chosen[0].name} is fitted jointly with gain and bias of both sensors, which needs the joint method and "
            "a gyroscope."
        )
    for effect in chosen:
        if effect.scope == "fixture":
            raise NotPossibleError(
                f"{effect.name} is an error of a set-up, and a recording by hand has none: see `jaximu turntable`."
            )
    segmentations = tuple(segment(recording, choices.segmentation) for recording in recordings)
    if static is not None and method.startswith("two-step"):
        raise InputError(
            "the two-step method cannot use the bias drift that a recording at rest shows (--static): use the joint "
            "method, or leave the recording out."
        )
    noise = noise_of(static)
    observations = observed_poses(segmentations, gravity.value, noise=noise)
    nominal, notes = nominal_imu(recordings[0])
    found = fit_hand_held(nominal, observations, method, loss)
    where = ", ".join(recording.name for recording in recordings)
    poses, turns = (int(np.sum(mask)) for mask in (observations.poses.mask, observations.turns.mask))
    if bool(found.finite):  # along directions left open a fit may creep until its steps run out
        require_spanning(relative_covariance(found), found.names, poses, where)
    require_solved(found, where)
    keep_gyroscope = method != "accelerometer"
    before = residual_rms(nominal, observations, keep_gyroscope)
    sigmas, prior = dict(choices.effect_sigmas or {}), None
    if method == "joint" and gravity.latitude is not None and _headings_known(segmentations, observations):
        earth, spread = GyroEarthRotation.at(gravity.latitude)
        if earth.name not in [effect.name for effect in chosen]:
            chosen, sigmas = [*chosen, earth], sigmas | {earth.name: spread}
    if chosen:
        measurement = RecordedByHand(segmentations, observations)
        start = jax.tree.map(np.asarray, found.imu).with_effects(*chosen)
        prior = Prior.of_effects(start, sigmas)
        found = fit(start, measurement, prior=prior, loss=loss, excess=found.excess)
        require_solved(found, where)
        refuse_undetermined(found, prior)
        observations = measurement.along(found.imu, tuple(found.imu.all_effects().values())).observations
    notes = (*(note for recording in recordings for note in recording.notes), *notes, *mixed,
             *(() if noise is None else noise.notes),
             *(note for part in segmentations for note in part.notes))  # fmt: skip
    if keep_gyroscope and not turns:
        notes += ("no turn between two poses could be used: the gyroscope's gain stays at the data sheet's.",)
    after = residual_rms(found.imu.with_effects(), observations, keep_gyroscope)
    calibration = concluded(
        found if keep_gyroscope else replace(found, imu=Imu(found.imu.accelerometer, None)),
        gravity=gravity, method=method, loss=loss, excess_names=EXCESS_NAMES if keep_gyroscope else EXCESS_NAMES[:1],
        rms={name: (before[name][0], value, unit) for name, (value, unit) in after.items()},
        data=provenance(recordings) | {"poses": poses, "turns": turns} | _mean_temperature(recordings, observations),
        notes=notes, observations=observations, segmentations=segmentations, nominal=nominal,
        reading=recordings[0].reading,
    )  # fmt: skip
    known = () if prior is None else prior.names  # of what is known beforehand nobody asks whether the data tell it
    weak = tuple(each for each in calibration.weak if not {name for name, _ in each.parameters} <= set(known))
    return replace(calibration, weak=weak)


def _headings_known(segmentations: Sequence[Segmentation], observations: Observations) -> bool:
    """Whether the gyroscope carries the heading through a whole recording, and there is no other one.

    Between two rests that touch the unit did not turn.
    """
    intervals = segmentations[0].intervals
    touching = intervals[1:, 0] <= intervals[:-1, 1]
    carried = np.asarray(observations.turns.mask)[: len(touching)]
    return len(segmentations) == 1 and bool(np.all(carried | touching))


def _mean_temperature(recordings: Sequence[Recording], observations: Observations) -> dict[str, float]:
    """The mean over the poses, °C, where every recording tells it."""
    if any(recording.temperature is None for recording in recordings):
        return {}
    poses = observations.poses
    return {"temperature": float(np.mean(np.asarray(poses.temperature)[np.asarray(poses.mask)]))}
