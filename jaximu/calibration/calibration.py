"""`Calibration`: what a user keeps, and the recipe that makes it from recordings of poses and turns."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import numpy as np
from numpy.typing import NDArray

from jaximu.calibration.arrangement import arrangement
from jaximu.calibration.hand_held import Method, fit_hand_held
from jaximu.calibration.lost_time import lost_share, tells_losses, without_lost_stretches
from jaximu.calibration.nominal import nominal_imu
from jaximu.calibration.saturation import saturation
from jaximu.calibration.summary import parameters_of, summary_of
from jaximu.effects.base import Effect
from jaximu.effects.earth_rotation import GyroEarthRotation
from jaximu.errors import InputError, NotPossibleError
from jaximu.estimation import Fit, Prior, fit
from jaximu.formats.document import SOFTWARE, Document, damage, read_document
from jaximu.gravity import STANDARD, Gravity, LocalGravity, as_gravity
from jaximu.measurements.drift import with_drift
from jaximu.measurements.hand_held import EXCESS_NAMES, RecordedByHand, condensed
from jaximu.measurements.path import TEMPERATURE_WINDOW
from jaximu.mistakes import Finding, prepared
from jaximu.noise.model import NoiseModel
from jaximu.observations import Observations, Stations
from jaximu.precision import require_float64
from jaximu.problem import Loss, Name, names_of, without_equipment
from jaximu.quantities import Z95, number
from jaximu.recording import Recording, Signal, recordings_of, smoothed_slope
from jaximu.reexport import later
from jaximu.segmentation import Segmentation, SegmentationOptions, observe, segment
from jaximu.sensor import Imu, Stimulus, Triad
from jaximu.solver import Failure
from jaximu.summary import Described, ParameterTable, Summary, sentence
from jaximu.uncertainty import UNDETERMINED, WeakDirection, pose_advice, weak_directions

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Calibration", "calibrate", "compensate", "forces_and_angles", "load_calibration",
           "require_spanning", "residual_rms"]  # fmt: skip

SCHEMA = "jaximu.calibration/1"
_ROUNDS = 4
"""Times that turns which lost time are looked for."""
MAGNETIC = ("field", "heading_error", "coverage", "norm_spread", "gyroscope_bias", "disturbed", "next")
"""What a document with a magnetometer says beside its triad."""
_NO_DRIFT = (
    "The intervals of the biases leave out slow drift: use the joint method with the linear loss, or add --static LOG."
)
_BEYOND = 0.5  # K outside the calibrated range from which a bias is extrapolated
FloatArray = NDArray[np.float64]


@dataclass(frozen=True, repr=False)
class Calibration(Described, Document):
    """A calibrated unit: y = gain·u + bias + Σ effects, u in SI, with uncertainty and provenance.

    imu: the model. names, covariance: the free parameters and their covariance (p, p), gravity's uncertainty included,
    in output units per SI unit (gains) and output units (biases). magnetic: what is known of a magnetometer's field and
    heading, by the keys `MAGNETIC`. rms: per residual (before, after, unit). rank, weak:
    what the data determine. excess: variance beyond the measured noise, in multiples of it. data, notes: where it comes
    from. trace: which unit it is, who calibrated it with what, see `jaximu.formats.trace`. digest: the hash of the file
    it was loaded from. fit, observations or stations, segmentations, nominal: the working behind it, absent once loaded
    from a file.
    """

    imu: Imu
    names: tuple[Name, ...]
    covariance: FloatArray
    gravity: LocalGravity
    method: str
    loss: str
    rms: dict[str, tuple[float, float, str]]
    rank: int
    weak: tuple[WeakDirection, ...]
    excess: dict[str, float]
    solver: str
    data: dict[str, Any]
    notes: tuple[str, ...] = ()
    software: dict[str, str] = field(default_factory=SOFTWARE.copy)
    fit: Fit | None = None
    observations: Observations | None = None
    stations: Stations | None = None
    segmentations: tuple[Segmentation, ...] = ()
    nominal: Imu | None = None
    diagnosis: dict[str, Any] | None = None
    reference: dict[str, Any] | None = None
    magnetic: dict[str, Any] | None = None
    trace: dict[str, Any] | None = None
    digest: str | None = None
    filter: dict[str, Any] | None = None

    def summary(self) -> Summary:
        """Return errors before and after, parameters with value, standard uncertainty and unit, and what is open."""
        return summary_of(self)

    def plot_residuals(self) -> Figure:
        """Return a figure of the errors by pose and turn, before and after, with what the noise explains.

        Raises `InputError` for a calibration that was loaded from a file, which does not keep them.
        """
        return later("report.figures", "residuals_of")(self)

    def plot_recording(self) -> Figure:
        """Return a figure of the recording with its poses. Raises `InputError` where a file does not keep it."""
        return later("report.figures", "recording_of")(self)

    @property
    def parameters(self) -> ParameterTable:
        """The fitted parameters by name, with value, standard deviation and unit, in the order of `covariance`."""
        return parameters_of(self)

    def triads(self) -> dict[str, Triad]:
        """Return the calibrated triads by name; a gyroscope or a magnetometer may have been calibrated by itself."""
        known = {name.owner for name in self.names}
        if self.magnetic is None and known != {"gyroscope"}:
            return self.imu.triads()
        return {name: triad for name, triad in self.imu.triads().items() if name in known}

    def triad_of(self, name: str, recording: Recording) -> Triad | None:
        """Return the triad that a signal of a recording was calibrated as, None where it was not.

        Raises `InputError` where the signal is in another unit.
        """
        triad, signal = self.triads().get(name), getattr(recording, name)
        if triad is not None and signal is not None and signal.unit != triad.output_unit:
            raise InputError(
                f"{recording.name}: the {name} is in {signal.unit}, but it was calibrated in {triad.output_unit}; "
                "state the columns' units as in the recording that was calibrated."
            )
        return triad

    def inertial(self) -> Calibration:
        """Return the same without its magnetometer. Raises `InputError` where it has no accelerometer."""
        known = self.triads()
        if "accelerometer" not in known:
            raise InputError(f"this calibration holds a {' and a '.join(known)} alone, and no accelerometer.")
        if self.magnetic is None:
            return self
        rows = [place for place, name in enumerate(self.names) if name.owner != "magnetometer"]
        return replace(
            self, names=tuple(self.names[row] for row in rows), covariance=self.covariance[np.ix_(rows, rows)],
            imu=replace(self.imu, magnetometer=None), magnetic=None,
        )  # fmt: skip

    def sigma(self, triad: str) -> tuple[FloatArray, FloatArray]:
        """Return the standard deviations of a triad's gain (3, 3) and bias (3,); zero where fixed by convention."""
        gain, bias = np.zeros((3, 3)), np.zeros(3)
        for name, variance in zip(self.names, np.diagonal(self.covariance), strict=True):
            if name.owner == triad and name.effect is None:
                (gain if name.part == "gain" else bias)[name.axes] = np.sqrt(variance)
        return gain, bias

    def covariance_of(self, names: Sequence[Name]) -> FloatArray:
        """Return the covariance (k, k) of some numbers, zero where fixed by convention or not calibrated."""
        there = [place for place, name in enumerate(names) if name in self.names]
        rows = [self.names.index(names[place]) for place in there]
        whole = np.zeros((len(names), len(names)))
        whole[np.ix_(there, there)] = self.covariance[np.ix_(rows, rows)]
        return whole

    def _effects(self, owner: str, model: Triad) -> dict[str, Any]:
        """Return the effects of a triad as the JSON document has them."""
        found = dict(zip(self.names, np.sqrt(np.diagonal(self.covariance)).tolist(), strict=True))

        def entry(place: int, effect: Effect) -> dict[str, Any]:
            sigma = [found.get(Name(owner, "coefficients", (i,), place)) for i in range(effect.size)]
            written = effect.document(model.output_unit)
            for name, each in written["inner"].items():
                each["sigma"] = found.get(Name(owner, name, (), place))
            return written | {"sigma": None if None in sigma else sigma}

        return {effect.name: entry(place, effect) for place, effect in enumerate(model.effects)}

    def document(self) -> dict[str, Any]:
        """Return the calibration as the JSON document of schema `jaximu.calibration/1`."""

        def triad(name: str, model: Triad) -> dict[str, Any]:
            gain_sigma, bias_sigma = self.sigma(name)
            return {
                "output_unit": model.output_unit,
                "gain": np.asarray(model.gain).tolist(),
                "bias": np.asarray(model.bias).tolist(),
                "gain_sigma": gain_sigma.tolist(),
                "bias_sigma": bias_sigma.tolist(),
                "temperature_reference": model.temperature_reference,
                "time_reference": model.time_reference,
                "effects": self._effects(name, model),
            }

        documents = {name: triad(name, model) for name, model in self.triads().items()}
        return {
            "schema": SCHEMA,
            "equation": "y = gain·u + bias + effects; u = specific force (m/s^2), angular rate (rad/s) or magnetic "
            "field (uT) in the body frame, y the output in output_unit; hence u = inverse(gain)·(y − bias) where there "
            "are no effects",
            "accelerometer": documents.get("accelerometer"),
            "gyroscope": documents.get("gyroscope"),
            **({} if self.magnetic is None else {"magnetometer": documents["magnetometer"]} | self.magnetic),
            "covariance": {"parameters": list(self.names), "matrix": self.covariance.tolist()},
            "data": self.data,
            "fit": {
                "method": self.method,
                "loss": self.loss,
                "rms": {
                    name: {"before": before, "after": after, "unit": unit}
                    for name, (before, after, unit) in self.rms.items()
                },
                "rank": self.rank,
                "parameters": len(self.names),
                "weak_directions": [
                    {
                        "text": weak.text,
                        "sigma": weak.sigma,
                        "determined": weak.determined,
                        "parameters": [{"name": name, "weight": weight} for name, weight in weak.parameters],
                    }
                    for weak in self.weak
                ],
                "excess_variance": self.excess,
                "solver": self.solver,
                "notes": list(self.notes),
            },
            "setup": {
                "gravity": {"value": self.gravity.value, "sigma": self.gravity.sigma, "unit": "m/s^2"}
                | ({} if self.gravity.latitude is None else {"latitude": self.gravity.latitude}),
                "effects": {effect.name: effect.document("") for effect in self.imu.setup},
            },
            "diagnosis": self.diagnosis,
            **({} if self.reference is None else {"reference": self.reference}),
            **({} if self.trace is None else {"trace": self.trace}),
            **({} if self.filter is None else {"filter": self.filter}),
            "software": self.software,
        }


def residual_rms(imu: Imu, observations: Observations, gyroscope: bool = True) -> dict[str, tuple[float, str]]:
    """Return the rms of each kind of residual in units a person knows: m/s², degrees, rad/s (all unweighted)."""
    poses, turns = np.asarray(observations.poses.mask), np.asarray(observations.turns.mask)
    force, angle = forces_and_angles(imu, observations)
    norm = np.linalg.norm(force[poses], axis=1) - float(observations.gravity)
    found = {"gravity_norm": (_rms(norm), "m/s^2")}
    if imu.gyroscope is None or not gyroscope:
        return found
    if turns.any():
        found["gravity_direction"] = (_rms(np.degrees(angle)[turns]), "deg")
    rest = np.asarray(observations.poses.gyroscope_mean)[poses] - np.asarray(imu.gyroscope.bias)
    scale = np.linalg.norm(np.asarray(imu.gyroscope.gain), axis=1)
    found["static_gyroscope"] = (_rms(np.linalg.norm(rest / scale, axis=1)), "rad/s")
    return found


def forces_and_angles(imu: Imu, observations: Observations) -> tuple[FloatArray, FloatArray]:
    """Return each pose's specific force (P, 3), m/s², and each turn's angle (T,), rad, from carried to measured.

    Padding included; the angles mean nothing where `imu` has no gyroscope. Effects are not looked at.
    """
    full = imu if imu.gyroscope is not None else Imu(imu.accelerometer, Imu.nominal().gyroscope)
    lifted = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (full, observations))
    found = condensed(*lifted)
    return found.force[0], found.angle[0]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


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
    - `repair`: change what [`jaximu.mistakes.make_ready`][] can put right; rows that are no measurement are left out
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
    covariance = fit.total_covariance(found.gravity.sigma)
    return replace(found, fit=fit, covariance=covariance, notes=(*found.notes, told))


def calibrate_ready(
    recordings: Sequence[Recording], choices: Choices, repair: bool = False
) -> tuple[Calibration, list[Finding]]:
    """Calibrate recordings that [`jaximu.mistakes.make_ready`][] has been over, as [`jaximu.calibrate`] does.

    **Returns:** the calibration, without turns that lost time, and what it says of lost time, axes, mounting and
    ranges; with `repair` axes are mapped.
    """
    found = _calibrated(recordings, choices)
    findings = arrangement(recordings[0], found.imu)
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
    same_outputs(recordings)
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
    noise = NoiseModel.of(static)
    observations = observe(segmentations, gravity.value, noise=noise)
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
        start = jax.tree.map(np.asarray, found.model).with_effects(*chosen)
        prior = Prior.of_effects(start, sigmas)
        found = fit(start, measurement, without_equipment_or_effects, prior=prior, loss=loss, excess=found.excess)
        require_solved(found, where)
        refuse_undetermined(found, prior)
        observations = measurement.along(found.model, tuple(found.model.all_effects().values())).observations
    notes = (*(note for recording in recordings for note in recording.notes), *notes,
             *(() if noise is None else noise.notes),
             *(note for part in segmentations for note in part.notes))  # fmt: skip
    if keep_gyroscope and not turns:
        notes += ("no turn between two poses could be used: the gyroscope's gain stays at the data sheet's.",)
    after = residual_rms(found.model.with_effects(), observations, keep_gyroscope)
    calibration = concluded(
        found if keep_gyroscope else replace(found, model=Imu(found.model.accelerometer, None)),
        gravity=gravity, method=method, loss=loss, excess_names=EXCESS_NAMES if keep_gyroscope else EXCESS_NAMES[:1],
        rms={name: (before[name][0], value, unit) for name, (value, unit) in after.items()},
        data=provenance(recordings) | {"poses": poses, "turns": turns} | _mean_temperature(recordings, observations),
        notes=notes, observations=observations, segmentations=segmentations, nominal=nominal,
    )  # fmt: skip
    known = () if prior is None else prior.names  # of what is known beforehand nobody asks whether the data tell it
    weak = tuple(each for each in calibration.weak if not {name for name, _ in each.parameters} <= set(known))
    return replace(calibration, weak=weak)


def _headings_known(segmentations: Sequence[Segmentation], observations: Observations) -> bool:
    """Whether the gyroscope carries the heading through a whole recording, and there is no other one."""
    return len(segmentations) == 1 and int(np.sum(observations.turns.mask)) == len(segmentations[0].intervals) - 1


def without_equipment_or_effects(name: Name) -> bool:
    """Whether a number is free by hand: the numbers of effects, and gain and bias but for the frame."""
    return name.effect is not None or without_equipment(name)


def concluded(
    found: Fit,
    *,
    gravity: LocalGravity,
    method: str,
    loss: str,
    excess_names: Sequence[str],
    notes: Sequence[str],
    advice: Callable[..., str] = pose_advice,
    **working: Any,
) -> Calibration:
    """Return the calibration that a fit is: rank, weak directions, excess and covariance are those of its model."""
    rank, weak = weak_directions(np.asarray(found.jacobian), found.names, found.sizes, found.model, advice)
    excess: dict[str, float] = dict(zip(excess_names, np.asarray(found.excess).tolist(), strict=False))
    return Calibration(
        imu=jax.tree.map(np.asarray, found.model), names=found.names,
        covariance=found.total_covariance(gravity.sigma), gravity=gravity, method=method, loss=loss, rank=rank,
        weak=weak, excess=excess, solver=found.failure().value, notes=tuple(dict.fromkeys(notes)), fit=found, **working,
    )  # fmt: skip


def require_solved(found: Fit, where: str) -> None:
    """Raise `NotPossibleError` where a fit did not end well."""
    if found.failure() is not Failure.NONE:
        raise NotPossibleError(f"{where}: {found.failure().value}.")


def require_excited(found: Fit, where: str, said: str, record: str) -> None:
    """Refuse what is no calibration: of every triad more than half of the parameters left open."""
    covariance = relative_covariance(found)
    parts = []
    for triad in found.model.triads():
        rows = [place for place, name in enumerate(found.names) if name.owner == triad and name.effect is None]
        if not rows:
            continue
        left = _open_directions(covariance, rows)
        if left <= len(rows) // 2:
            return
        parts.append(f"{left} of the {triad}'s {len(rows)} parameters")
    raise NotPossibleError(f"{where}: {said} leave {' and '.join(parts)} open. {record}")


def effect_named(given: str | Effect) -> Effect:
    """Return an effect of the catalogue, dormant, by its name, or the effect that was given."""
    if isinstance(given, Effect):
        return given
    from jaximu.effects.catalogue import CATALOGUE  # a tenth of a second, which a plain calibration does not need

    if given not in CATALOGUE:
        raise InputError(f"unknown effect {given!r}: run `jaximu effects` for the list.")
    return CATALOGUE[given].dormant()


def refuse_undetermined(found: Fit, prior: Prior | None = None) -> None:
    """Raise `NotPossibleError` for a fitted effect that was not told from all else that was fitted.

    An effect of which a prior says something is let through.
    """
    known = set() if prior is None else set(prior.names)
    jacobian = np.asarray(found.jacobian)
    for (owner, place), effect in found.model.all_effects().items():
        own = np.array([(name.owner, name.effect) == (owner, place) for name in found.names])
        if not own.any() or any(name in known for name, mine in zip(found.names, own, strict=True) if mine):
            continue
        columns, others = jacobian[:, own], jacobian[:, ~own]
        left = columns - others @ np.linalg.lstsq(others, columns, rcond=1e-10)[0]
        least = np.linalg.svd(left, compute_uv=False)[-1]
        if not least > 1e-6 * np.linalg.norm(columns):
            raise NotPossibleError(
                f"{sentence(effect.title)} cannot be distinguished here from bias, scale and misalignment"
                f"{' or from the other effects' if len(found.model.all_effects()) > 1 else ''}. Record "
                f"{effect.excited_by}."
            )
        if 1 / least > UNDETERMINED:
            raise NotPossibleError(
                f"{sentence(effect.title)} is hidden in the noise: this recording determines it only to "
                f"±{number(Z95 / least, 2)} times a usual size (95 %). "
                f"Record longer rests and {effect.excited_by}."
            )


def provenance(recordings: Sequence[Recording]) -> dict[str, Any]:
    """Return files and rates of recordings as `Calibration.data` has them."""
    sources = [source for recording in recordings for source in recording.sources]
    files = [{"file": str(s.path), "sha256": s.sha256, "rows": s.rows} for s in sources]
    known = {"accelerometer": "rate", "gyroscope": "gyroscope_rate"}
    rates = {known[name]: signal.rate for name, signal in recordings[0].signals.items() if name in known}
    return {**(files[0] if files else {}), **rates, "files": files}


def _mean_temperature(recordings: Sequence[Recording], observations: Observations) -> dict[str, float]:
    """The mean over the poses, °C, where every recording tells it."""
    if any(recording.temperature is None for recording in recordings):
        return {}
    poses = observations.poses
    return {"temperature": float(np.mean(np.asarray(poses.temperature)[np.asarray(poses.mask)]))}


def same_outputs(recordings: Sequence[Recording], alone: bool = False) -> None:
    """Raise `InputError` where recordings of one unit have not the same sensors and units.

    **Arguments:** `alone`: whether a gyroscope without an accelerometer will do.
    """
    if not recordings:
        raise InputError("no recording was given.")
    first = recordings[0]
    lacking = [each for each in recordings if not len(each.accelerometer)]
    if lacking and (not alone or len(lacking) < len(recordings)):
        needed = "the other recording has one" if alone else "one is needed"
        raise InputError(f"{lacking[0].name} has no accelerometer, but {needed}.")
    for other in recordings[1:]:
        for name in ("accelerometer", "gyroscope"):
            a, b = getattr(first, name), getattr(other, name)
            if (a is None) != (b is None):
                raise InputError(
                    f"{(first if a is None else other).name} has no {name}, but the other recording has one."
                )
            if a is not None and (a.unit != b.unit or not np.allclose(a.nominal_scale, b.nominal_scale, rtol=0.2)):
                raise InputError(f"{first.name} and {other.name} give the {name} in different units or scales.")


def require_spanning(covariance: FloatArray, names: Sequence[Name], poses: int, where: str) -> None:
    """Refuse what is no calibration: more than a third of the accelerometer's parameters left open.

    covariance: (p, p) of the parameters over their typical sizes.
    """
    rows = [place for place, name in enumerate(names) if name.owner == "accelerometer"]
    open_directions = _open_directions(covariance, rows)
    if open_directions > len(rows) // 3:
        raise NotPossibleError(
            f"{where}: the {poses} poses found do not span enough orientations: they leave {open_directions} of the "
            f"accelerometer's {len(rows)} parameters open. Record at least nine poses, each axis pointing up and down "
            "once and some in between, two seconds or more each."
        )


def relative_covariance(found: Fit) -> FloatArray:
    """Return the covariance (p, p) of a fit's parameters over their typical sizes."""
    return np.asarray(found.covariance) / found.sizes[:, None] / found.sizes


def _open_directions(covariance: FloatArray, rows: Sequence[int]) -> int:
    """How many directions of these parameters are known no better than from the data sheet."""
    return int(np.sum(np.linalg.eigvalsh(covariance[np.ix_(rows, rows)]) > UNDETERMINED**2))


def load_calibration(path: str | os.PathLike[str]) -> Calibration:
    """Read a `calibration.json`. Raises `InputError` naming the file and the key that is missing or wrong."""
    document = read_document(path, SCHEMA, "a calibration that this version reads")
    with damage(path):
        return _from_document(document)


def _numbers(value: Any, shape: tuple[int, ...]) -> FloatArray:
    array = np.asarray(value, float)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"expected finite numbers of shape {shape}, found shape {array.shape}")
    return array


def _from_document(document: dict[str, Any]) -> Calibration:
    from jaximu.effects.catalogue import CATALOGUE

    def effects_of(entries: dict[str, Any]) -> tuple:
        found = []
        for name, entry in entries.items():
            if name not in CATALOGUE:
                raise ValueError(f"effect {name!r} is not in the catalogue of this version")
            kind = CATALOGUE[name]
            inner = {key: float(each["value"]) for key, each in entry["inner"].items()}
            found.append(kind.make(_numbers(entry["coefficients"], (kind.size,)), **inner))
        return tuple(found)

    def triad(part: dict[str, Any], quantity: str) -> Triad:
        gain = _numbers(part["gain"], (3, 3))
        if abs(np.linalg.det(gain / np.linalg.norm(gain, axis=1, keepdims=True))) < 1e-6:
            raise ValueError("the gain is singular")
        effects = effects_of(part["effects"])
        return Triad(
            gain,
            _numbers(part["bias"], (3,)),
            effects,
            quantity,
            str(part["output_unit"]),
            temperature_reference=float(part["temperature_reference"]),
            time_reference=float(part["time_reference"]),
        )

    sensors = ("accelerometer", "gyroscope", "magnetometer")
    accelerometer, gyroscope, magnetometer = (document.get(name) for name in sensors)
    if accelerometer is None and gyroscope is None and magnetometer is None:
        raise KeyError("accelerometer")
    fit, gravity = document["fit"], document["setup"]["gravity"]
    imu = Imu(
        Imu.nominal().accelerometer if accelerometer is None else triad(accelerometer, "specific_force"),
        None if gyroscope is None else triad(gyroscope, "angular_rate"),
        effects_of(document["setup"].get("effects", {})),
        None if magnetometer is None else triad(magnetometer, "magnetic_field"),
    )
    known = {str(name): name for name in names_of(imu)}
    names = tuple(known[name] for name in document["covariance"]["parameters"])
    return Calibration(
        imu=imu,
        names=names,
        covariance=_numbers(document["covariance"]["matrix"], (len(names), len(names))),
        gravity=LocalGravity(gravity["value"], gravity["sigma"], gravity.get("latitude")),
        method=fit["method"],
        loss=fit["loss"],
        rms={name: (entry["before"], entry["after"], entry["unit"]) for name, entry in fit["rms"].items()},
        rank=fit["rank"],
        weak=tuple(
            WeakDirection(
                entry["sigma"],
                entry["determined"],
                tuple((part["name"], part["weight"]) for part in entry["parameters"]),
                entry["text"],
            )
            for entry in fit["weak_directions"]
        ),
        excess=fit["excess_variance"],
        solver=fit["solver"],
        data=document["data"],
        notes=tuple(fit["notes"]),
        software=document["software"],
        diagnosis=document.get("diagnosis"),
        reference=document.get("reference"),
        trace=document.get("trace"),
        digest=document.get("digest"),
        filter=document.get("filter"),
        magnetic=None
        if magnetometer is None
        else {key: document.get(key) if key == "next" else document[key] for key in MAGNETIC},
    )


@eqx.filter_jit
def _recover(imu: Imu, accelerometer, gyroscope, stimulus: Stimulus):
    return imu.recover(accelerometer, gyroscope, stimulus)


def compensate(calibration: Calibration, recording: Recording) -> Recording:
    """Return the recording with calibrated outputs, in m/s² and rad/s, every effect of the device removed.

    Effects of a session or of the set-up belong to the recording that was calibrated and are left alone. Where the two
    sensors have stamps of their own, what one triad's effects need of the other is interpolated. A rate of temperature
    is the slope of a line through `TEMPERATURE_WINDOW` seconds of the recorded temperature.

    Raises `InputError` if the recording's output unit is not the one that was calibrated, the gyroscope was not, or an
    effect needs what the recording lacks.
    """
    require_float64()
    imu = calibration.imu.transferable()
    known = calibration.triads()
    signals = {name: recording.signals[name] for name in ("accelerometer", "gyroscope") if name in recording.signals}
    if "accelerometer" not in known:  # a gyroscope or a magnetometer alone: the rest stays as it is
        signals = {name: signal for name, signal in signals.items() if name in known}
    elif "accelerometer" not in signals:
        raise InputError(f"{recording.name} has no accelerometer, which the calibration needs beside the gyroscope.")
    for name in signals:
        if calibration.triad_of(name, recording) is None:
            raise InputError(f"{recording.name} has a gyroscope, but the calibration has none for it.")
    crossed = [each.name for each in imu.all_effects().values() if "specific_force" in each.needs]
    if "gyroscope" in signals and "accelerometer" not in signals and crossed:
        raise InputError(f"{crossed[0]} needs the specific force, and the calibration has no accelerometer.")
    changed: dict[str, Signal] = {}
    results: dict[bytes, tuple] = {}  # sensors that share their stamps are recovered at once
    for name, signal in signals.items():
        time = signal.time
        key = time.tobytes()
        if key not in results:
            outputs = {other: _at(each, time) for other, each in signals.items()}
            stimulus = Stimulus(time=time)
            if recording.temperature is not None:
                kelvin = _at(recording.temperature, time)[:, 0]
                slope = smoothed_slope(time, kelvin, TEMPERATURE_WINDOW)
                stimulus = replace(stimulus, temperature=kelvin, temperature_rate=slope)
            force = outputs["accelerometer"] if "accelerometer" in outputs else np.zeros((len(time), 3))
            results[key] = _recover(imu, force, outputs.get("gyroscope"), stimulus)
        value = np.asarray(results[key][("accelerometer", "gyroscope").index(name)])
        changed[name] = Signal(time, value, "m/s^2" if name == "accelerometer" else "rad/s")
    if imu.magnetometer is not None and recording.magnetometer is not None:
        rate = changed.get("gyroscope", recording.gyroscope)
        calibration.triad_of("magnetometer", recording)
        changed["magnetometer"] = _field(imu.magnetometer, recording, rate)
    left = sorted({e.name for t in calibration.triads().values() for e in t.effects if e.scope != "device"})
    notes = (
        "compensated by a calibration", *(f"{name} was not removed: it belongs to a session" for name in left),
        *_extrapolated(calibration, recording),
    )  # fmt: skip
    return replace(recording, **changed, notes=(*recording.notes, *notes))


def _field(triad: Triad, recording: Recording, rate: Signal | None) -> Signal:
    """Return a magnetometer's samples as the field, µT, without its effects; rate: corrected, rad/s."""
    signal = recording.magnetometer
    assert signal is not None
    time = signal.time
    others = {"temperature": recording.temperature, "current": recording.current, "angular_rate": rate}
    known: dict[str, Any] = {name: _at(each, time) for name, each in others.items() if each is not None}
    known |= {name: known[name][:, 0] for name in ("temperature", "current") if name in known}
    field = eqx.filter_jit(Triad.recover)(triad, signal.values, Stimulus(time=time, **known))
    return Signal(time, np.asarray(field), "uT")


def _extrapolated(calibration: Calibration, recording: Recording) -> list[str]:
    """Say where the temperature leaves the range that a calibration over temperature saw."""
    seen, signal = calibration.data.get("temperature_range"), recording.temperature
    if seen is None or signal is None:
        return []
    low, high = seen
    share = float(np.mean((signal.values < low - _BEYOND) | (signal.values > high + _BEYOND)))
    if not share:
        return []
    spanned = f"{signal.values.min():.1f} to {signal.values.max():.1f} °C"
    return [
        f"extrapolated: {100 * share:.2g} % of the temperatures ({spanned}) lie outside the {low:.1f} to {high:.1f} °C "
        "that were calibrated"
    ]


def _at(signal: Signal, time: FloatArray) -> FloatArray:
    if np.array_equal(signal.time, time):
        return signal.values
    return np.stack([np.interp(time, signal.time, column) for column in signal.values.T], axis=1)
