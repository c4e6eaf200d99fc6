"""`Calibration`: what a user keeps of a fit, and its file."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from jaximu.estimation.fitting import Fit, Prior
from jaximu.estimation.problem import TOLERANCE, Name, flatten, names_of, typical_sizes, without_equipment
from jaximu.estimation.projection import OutputUncertainty, output_uncertainty
from jaximu.estimation.rows import Sizes
from jaximu.estimation.uncertainty import (
    WeakDirection,
    describe,
    gains_open,
    open_numbers,
    pose_advice,
    weak_directions,
)
from jaximu.ground.array_types import FloatArray
from jaximu.ground.document import SOFTWARE, Document, Json, damage, entries, read_document
from jaximu.ground.errors import FilePath, InputError, NotPossibleError
from jaximu.ground.gravity import LocalGravity
from jaximu.ground.page import Result
from jaximu.ground.parameters import Parameter, ParameterTable
from jaximu.ground.precision import require_float64
from jaximu.ground.quantities import listed, unit_text
from jaximu.ground.reexport import later
from jaximu.ground.rotation import unit_vectors
from jaximu.ground.tracing import on_host
from jaximu.ground.units import SENSOR_QUANTITIES, SENSOR_UNITS
from jaximu.ground.vectors import sigmas_of, submatrix
from jaximu.model.effects.base import Effect
from jaximu.model.sensor import Imu, Triad
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.observations import Observations, Stations
from jaximu.recordings.recording import Reading, Recording
from jaximu.recordings.segmentation import Segmentation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCHEMA = "jaximu.calibration/1"
MAGNETIC = ("field", "heading_error", "coverage", "norm_spread", "gyroscope_bias", "disturbed", "next")
"""What a document with a magnetometer says beside its triad."""
EXACT = 1e-6
"""Share of an error before the fit below which what is left is rounding: as many parameters as conditions."""
_ROUNDING = 1e-9
"""Share by which an eigenvalue of a covariance may be negative and count as zero."""
_VECTORS = ("specific_force", "angular_rate", "angular_acceleration", "magnetic_field")
_LENGTHS = (
    dict.fromkeys(_VECTORS, 3)
    | {"attitude": 4}
    | dict.fromkeys(("temperature", "temperature_rate", "time", "vibration_power", "current"), 0)
)
"""Entries along the last axis of a stimulus' fields; 0 for a number per sample."""


@dataclass(frozen=True, repr=False, eq=False)
class Calibration(Result, Document, page="calibration"):
    """A calibrated unit: y = gain·u + bias + Σ effects, u in SI, with uncertainty and provenance.

    imu: the model. names, covariance: the free parameters and their covariance (p, p), gravity's uncertainty included,
    in output units per SI unit (gains) and output units (biases). Biases are those for use after the recording: means
    over as long again as the (first) recording took, without another power-on. bias_sigma_recording: standard
    deviations (3,), by triad, of their means over it; where a triad is missing there, the two are the same.
    magnetic: what is known of a magnetometer's field and heading, by the keys `MAGNETIC`. rms: per residual
    (before, after, unit). rank, weak:
    what the data determine. excess: variance beyond the measured noise, in multiples of it. data, notes: where it comes
    from. reading: how its log, or the first of several, was read; None where that is not known.
    trace: which unit it is, who calibrated it with what, see `jaximu.recordings.trace`. digest: the hash of the file
    it was loaded from. absent: triads that `imu` has as the data sheet states them and that are no part of this. fit,
    observations or stations, segmentations, nominal: the working behind it, absent once loaded
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
    data: Json
    notes: tuple[str, ...] = ()
    software: dict[str, str] = field(default_factory=SOFTWARE.copy)
    fit: Fit | None = None
    observations: Observations | None = None
    stations: Stations | None = None
    segmentations: tuple[Segmentation, ...] = ()
    nominal: Imu | None = None
    diagnosis: Json | None = None
    reference: Json | None = None
    magnetic: Json | None = None
    trace: Json | None = None
    digest: str | None = None
    filter: Json | None = None
    absent: tuple[str, ...] = ()
    reading: Reading | None = None
    bias_sigma_recording: Mapping[str, FloatArray] = field(default_factory=dict)

    def plot_residuals(self) -> Figure:
        """Return a figure of the errors by pose and turn, before and after, with what the noise explains.

        Raises `InputError` for a calibration that was loaded from a file, which does not keep them.
        """
        return later("report.figures", "residuals_of")(self)

    def plot_recording(self) -> Figure:
        """Return a figure of the recording with its poses. Raises `InputError` where it is not kept."""
        return later("report.figures", "recording_of")(self)

    @property
    def parameters(self) -> ParameterTable:
        """The fitted parameters by name, with value, standard deviation and unit, in the order of `covariance`.

        In output units.
        """
        weak = {name for direction in self.weak for name, _ in direction.parameters}
        triads, effects = self.imu.triads(), self.imu.all_effects()

        def parameter(name: Name, sigma: float) -> Parameter:
            output = "" if name.owner == "setup" else triads[name.owner].output_unit
            if name.effect is not None:
                effect = effects[name.key]
                value = effect.coefficients[name.axes] if name.part == "coefficients" else getattr(effect, name.part)
                unit = effect.coefficient_unit(output) if name.part == "coefficients" else effect.inner[name.part].unit
            else:
                value, si = getattr(triads[name.owner], name.part)[name.axes], SENSOR_UNITS[name.owner]
                unit = output if name.part == "bias" else "1" if output == si else f"{output} per {unit_text(si)}"
            determined = name not in self.open_numbers
            return Parameter(str(name), describe(name, self.imu), float(value), sigma, unit, name in weak, determined)

        return ParameterTable(list(map(parameter, self.names, sigmas_of(self.covariance).tolist())))

    def triads(self) -> dict[str, Triad]:
        """Return the calibrated triads by name; a gyroscope or a magnetometer may have been calibrated by itself."""
        return {name: triad for name, triad in self.imu.triads().items() if name not in self.absent}

    def triad_of(self, name: str, recording: Recording) -> Triad | None:
        """Return the triad that a signal of a recording was calibrated as, None where it was not.

        Raises `InputError` where the signal is in another unit, or was read in other axes or another scale of counts.
        """
        triad, signal = self.triads().get(name), getattr(recording, name)
        if triad is not None and signal is not None and signal.unit != triad.output_unit:
            raise InputError(
                f"{recording.name}: the {name} is in {signal.unit}, but it was calibrated in {triad.output_unit}; "
                "state the columns' units as in the recording that was calibrated."
            )
        if triad is not None and self.reading is not None:
            self.reading.require_alike(recording.reading, recording.name, (name,))
        return triad

    @property
    def files(self) -> list[str]:
        """The paths of the recordings that it was made from."""
        return [str(file["file"]) for file in self.data.get("files", ())]

    @property
    def exact(self) -> tuple[str, ...]:
        """The kinds of residual that the fit passes through exactly: no degrees of freedom are left of them."""
        return tuple(name for name, (before, after, _) in self.rms.items() if after < EXACT * before)

    @property
    def open_numbers(self) -> frozenset[str]:
        """The names of the numbers that the recording does not determine; their sigmas are the data sheet's."""
        return open_numbers(self.weak)

    def gains_determined(self) -> bool:
        """Return whether the recording determined all gains that were estimated."""
        return not gains_open(self.weak)

    def inertial(self) -> Calibration:
        """Return the same without its magnetometer. Raises `InputError` where it has no accelerometer."""
        known = self.triads()
        if "accelerometer" not in known:
            raise InputError(f"this calibration holds a {' and a '.join(known)} alone, and no accelerometer.")
        if self.magnetic is None:
            return self
        imu = replace(self.imu, magnetometer=None)
        return self.of_numbers(lambda name: name.owner != "magnetometer", imu=imu, magnetic=None)

    def of_numbers(self, kept: Callable[[Name], bool], **changes: Any) -> Calibration:
        """Return the same with some of its numbers alone in the covariance, and what else changes with that."""
        rows = [row for row, name in enumerate(self.names) if kept(name)]
        names = tuple(self.names[row] for row in rows)
        return replace(self, names=names, covariance=submatrix(self.covariance, rows), **changes)

    def allowing_for(self, shifts: Iterable[Mapping[str, float]]) -> Calibration:
        """Return the same whose numbers are uncertain by what its recording cannot see, too.

        **Arguments:** `shifts`: what each cause would do at its detection limit, by the number's name in its standard
        deviations, such as `cause.shift` of `Diagnosis.hidden`. Each number takes the largest as a further standard
        deviation, independent of all others.
        """
        causes = list(shifts)
        largest = [max((shift.get(str(name), 0.0) for shift in causes), default=0.0) for name in self.names]
        hidden = np.diag(np.diagonal(self.covariance) * np.square(largest))
        return replace(self, covariance=self.covariance + hidden)

    def _of_data_sheet(self) -> tuple[Name, ...]:
        """Return the numbers of gains and biases that no recording determined; zeros that fix a frame are none."""
        lower = {Name(name, "gain", (i, j)) for name in self.triads() for i in range(3) for j in range(i + 1)}
        framed = {name.owner for name in lower} - {name.owner for name in lower.difference(self.names)}
        free = (name for name in names_of(self.imu) if without_equipment(name) and name.effect is None)
        left = (name for name in free if name.owner in self.triads() and name not in self.names)
        return tuple(name for name in left if name.part != "gain" or name.owner not in framed)

    @property
    def from_data_sheet(self) -> tuple[str, ...]:
        """Gains and biases that no recording determined, such as "gyroscope gain"; they are the data sheet's."""
        return tuple(dict.fromkeys(f"{name.owner} {name.part}" for name in self._of_data_sheet()))

    def uncertainty_of(self, stimulus: Stimulus) -> dict[str, OutputUncertainty]:
        """Return how uncertain the corrected output is at some input, by triad: of those whose input it holds.

        The covariance is J C Jᵀ, C that of the calibration's numbers and J the derivatives of `recover` by them
        (`jaximu.estimation.projection`): mrcal's projection uncertainty, for an IMU. It holds all that the calibration
        is uncertain of, gravity's error included; not the noise of the samples that are corrected, nor effects of a
        session. Numbers of the data sheet count with its tolerance, five typical sizes.

        **Arguments:** `stimulus`: the true input, such as `jaximu.Stimulus(specific_force=[0, 0, 9.8])`: force
        (..., 3) m/s², rate (..., 3) rad/s, and what effects need (temperature, °C), in the body frame.

        Raises `InputError` where it holds no calibrated triad's input, a shape is wrong or a number not finite, or an
        effect needs what it lacks.
        """
        require_float64()
        triads = self.triads()
        stimulus = _checked(stimulus, [triad.quantity for triad in triads.values()])
        stated = self._of_data_sheet()
        free = (*self.names, *stated)
        sizes = dict(zip(names_of(self.imu), flatten(typical_sizes(self.imu)), strict=True))
        tolerance = [TOLERANCE * sizes[name] if name in stated else 0.0 for name in free]
        covariance = self.covariance_of(free) + np.diag(np.square(tolerance))
        uncertainty = output_uncertainty(self.imu, free, covariance, stimulus)
        return {name: uncertainty[name] for name in triads if name in uncertainty}

    def sigma(self, triad: str) -> tuple[FloatArray, FloatArray]:
        """Return the standard deviations of a triad's gain (3, 3) and bias (3,); zero where fixed by convention."""
        gain, bias = np.zeros((3, 3)), np.zeros(3)
        for name, variance in zip(self.names, np.diagonal(self.covariance), strict=True):
            if name.owner == triad and name.effect is None:
                (gain if name.part == "gain" else bias)[name.axes] = np.sqrt(variance)
        return gain, bias

    def covariance_of(self, names: Sequence[Name]) -> FloatArray:
        """Return the covariance (k, k) of some numbers, zero where fixed by convention or not calibrated."""
        rows = [self.names.index(name) if name in self.names else -1 for name in names]  # the last is zero
        return submatrix(np.pad(self.covariance, (0, 1)), rows)

    def gravity_shift(self) -> FloatArray:
        """Return what one sigma of gravity's error, K ∝ 1/g, adds to the numbers (p,); zeros where C lacks it."""
        values = dict(zip(names_of(self.imu), flatten(self.imu).tolist(), strict=True))
        scaled = [name.owner == "accelerometer" and name.part == "gain" for name in self.names]
        shift = np.where(scaled, [values[name] for name in self.names], 0.0) * self.gravity.sigma / self.gravity.value
        scale = np.sqrt(np.maximum(np.diagonal(self.covariance), shift**2))
        scale = np.where(scale > 0, scale, 1.0)
        rest = (self.covariance - np.outer(shift, shift)) / np.outer(scale, scale)
        return shift * (np.linalg.eigvalsh(rest).min(initial=0.0) > -_ROUNDING)  # else C − s sᵀ is no covariance

    def _effects(self, owner: str, model: Triad) -> Json:
        """Return the effects of a triad as the JSON document has them."""
        sigmas = dict(zip(self.names, sigmas_of(self.covariance).tolist(), strict=True))
        sigmas = {name: sigma for name, sigma in sigmas.items() if name not in self.open_numbers}

        def entry(position: int, effect: Effect) -> Json:
            sigma = [sigmas.get(Name(owner, "coefficients", (i,), position)) for i in range(effect.size)]
            written = effect.document(model.output_unit)
            for name, entry_of_inner in written["inner"].items():
                entry_of_inner["sigma"] = sigmas.get(Name(owner, name, (), position))
            return written | {"sigma": None if None in sigma else sigma}

        return {effect.name: entry(position, effect) for position, effect in enumerate(model.effects)}

    def _known(self, sigma: FloatArray, owner: str, part: str) -> Json:
        """Return standard deviations as the JSON document has them: null where the recording leaves a number open."""
        left = [Name(owner, part, axes) in self.open_numbers for axes in np.ndindex(sigma.shape)]
        return np.ma.masked_array(sigma, np.reshape(left, sigma.shape)).tolist()

    def document(self) -> Json:
        """Return the calibration as the JSON document of schema `jaximu.calibration/1`."""

        def triad(name: str, model: Triad) -> Json:
            gain_sigma, bias_sigma = self.sigma(name)
            recorded = self.bias_sigma_recording.get(name, bias_sigma)
            return {
                **entries(model, "output_unit", "gain", "bias"),
                "gain_sigma": self._known(gain_sigma, name, "gain"),
                "bias_sigma": self._known(bias_sigma, name, "bias"),
                "bias_sigma_recording": self._known(recorded, name, "bias"),
                **entries(model, "temperature_reference", "time_reference"),
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
            **({} if self.reading is None else {"reading": asdict(self.reading)}),
            "fit": {
                **entries(self, "method", "loss", "rank", "solver", "notes"),
                "rms": {
                    name: {"before": before, "after": after, "unit": unit}
                    for name, (before, after, unit) in self.rms.items()
                },
                "parameters": len(self.names),
                "weak_directions": [
                    entries(weak, "text", "sigma", "determined")
                    | {"parameters": [{"name": name, "weight": weight} for name, weight in weak.parameters]}
                    for weak in self.weak
                ],
                "excess_variance": self.excess,
            },
            "setup": {
                "gravity": entries(self.gravity, "value", "sigma")
                | {"unit": "m/s^2"}
                | ({} if self.gravity.latitude is None else {"latitude": self.gravity.latitude}),
                "effects": {effect.name: effect.document("") for effect in self.imu.setup},
            },
            "diagnosis": self.diagnosis,
            **{name: part for name in ("reference", "trace", "filter") if (part := getattr(self, name)) is not None},
            "software": self.software,
        }


def concluded(
    fitted: Fit,
    *,
    gravity: LocalGravity,
    method: str,
    loss: str,
    excess_names: Sequence[str],
    rms: Sequence[Sizes],
    notes: Sequence[str],
    advice: Callable[..., str] = pose_advice,
    known: Collection[Name] = (),
    prior: Prior | None = None,
    **working: Any,
) -> Calibration:
    """Return the calibration that a fit is: rank, weak directions, excess and covariance are those of its model.

    **Arguments:** `rms`: the sizes of its errors before and after. `known`: numbers of which something is known
    beforehand; of these alone nobody asks whether the data tell them. `prior`: what is known of such numbers; it tells
    them as data do. `working`: fields of `Calibration`.
    """
    jacobian = np.asarray(fitted.jacobian)
    if prior is not None:
        known = {*known, *prior.names}
        jacobian = np.concatenate([jacobian, prior.rows(fitted.names, fitted.sizes)])
    rank, weak = weak_directions(jacobian, fitted.names, fitted.sizes, fitted.imu, advice)
    weak = tuple(one for one in weak if not set(known).issuperset(name for name, _ in one.parameters))
    before, after = rms
    excess: dict[str, float] = dict(zip(excess_names, np.asarray(fitted.excess).tolist(), strict=False))
    clock = clock_sigma(working.get("segmentations", ()))
    return Calibration(
        imu=on_host(fitted.imu),
        names=fitted.names,
        covariance=fitted.total_covariance(gravity.sigma, clock),
        gravity=gravity,
        method=method,
        loss=loss,
        rank=rank,
        weak=weak,
        rms={name: (before[name][0], *size) for name, size in after.items()},
        excess=excess,
        solver=fitted.failure().value,
        notes=tuple(dict.fromkeys(notes)),
        fit=fitted,
        **working,
    )


def _checked(stimulus: Stimulus, quantities: Sequence[str]) -> Stimulus:
    """Return a stimulus as arrays. Raises `InputError` where it holds none of these inputs, or what is no input."""
    if all(getattr(stimulus, quantity) is None for quantity in quantities):
        raise InputError(f"the stimulus holds no {listed([*quantities], 'or').replace('_', ' ')} to be corrected.")
    arrays, axes = {}, set()
    for name, length in _LENGTHS.items():
        if getattr(stimulus, name) is None:
            continue
        arrays[name] = values = np.asarray(getattr(stimulus, name), float)
        words = name.replace("_", " ")
        if length and values.shape[-1:] != (length,):
            raise InputError(f"the {words} has the shape {values.shape}: its last axis must have {length} entries.")
        if not np.isfinite(values).all():
            raise InputError(f"the {words} holds a number that is not finite.")
        axes.add(values.shape[:-1] if length else values.shape)
    if len(axes) > 1:
        raise InputError(f"the stimulus' arrays differ in their leading axes: {listed(sorted(map(str, axes)))}.")
    return replace(stimulus, **arrays)


def notes_of(*sources: Any) -> list[str]:
    """Return the notes of recordings, of what was found in them, of a noise model; None has none."""
    return [note for source in sources if source is not None for note in source.notes]


def clock_sigma(segmentations: Sequence[Segmentation]) -> float:
    """Return one sigma of the share by which the gyroscope's clock runs fast, the largest of all recordings."""
    gyroscopes = [part.recording.gyroscope for part in segmentations]
    return max((0.0 if gyroscope is None else gyroscope.clock_sigma for gyroscope in gyroscopes), default=0.0)


def provenance(recordings: Sequence[Recording]) -> Json:
    """Return files and rates of recordings as `Calibration.data` has them."""
    sources = [source for recording in recordings for source in recording.sources]
    files = [{"file": str(s.path), "sha256": s.sha256, "rows": s.rows} for s in sources]
    known = {"accelerometer": "rate", "gyroscope": "gyroscope_rate"}
    rates = {known[name]: signal.rate for name, signal in recordings[0].signals.items() if name in known}
    return {**(files[0] if files else {}), **rates, "files": files}


def require_another(calibration: Calibration, sources: Iterable[str]) -> None:
    """Raise `NotPossibleError` where a calibration was fitted to one of the files of these SHA-256."""
    fitted = {file.get("sha256"): file["file"] for file in calibration.data.get("files", ())}
    if same := [fitted[source] for source in sources if source and source in fitted]:
        raise NotPossibleError(
            f"{same[0]} is the recording that this calibration was fitted to: it agrees with it whatever has moved "
            "since. Record the unit again, and check by that."
        )


def effect_named(effect: str | Effect) -> Effect:
    """Return an effect of the catalogue, dormant, by its name, or the effect that was given."""
    if isinstance(effect, Effect):
        return effect
    from jaximu.model.effects.catalogue import CATALOGUE  # a tenth of a second, which a plain calibration does not need

    if effect not in CATALOGUE:
        raise InputError(
            f"unknown effect {effect!r}: run `jaximu effects` for the list; jaximu.register adds one of your own."
        )
    return CATALOGUE[effect].dormant()


def require_calibration(candidate: object) -> None:
    """Raise `InputError` for what is no calibration, saying how to read one."""
    if not isinstance(candidate, Calibration):
        raise InputError(
            f"expected a calibration, found a value of type {type(candidate).__name__}: make one with "
            "jaximu.calibrate(recording), or read one with jaximu.load_calibration(path)."
        )


def load_calibration(path: FilePath, effects: Sequence[type[Effect]] = ()) -> Calibration:
    """Read a `calibration.json`.

    **Arguments:** `effects`: of your own, that the calibration holds; they are registered.

    Raises `InputError` naming the file and the key that is missing or wrong, or the effect that is not known.
    """
    document = read_document(path, SCHEMA, "a calibration that this version reads")
    if effects:
        from jaximu.model.effects.catalogue import register

        for effect in effects:
            register(effect)
    with damage(path):
        _require_known_effects(document, os.fspath(path))
        return _from_document(document)


def _require_known_effects(document: Json, path: str) -> None:
    """Raise `InputError` for an effect that the catalogue lacks; the file is not to blame for it."""
    from jaximu.model.effects.catalogue import CATALOGUE

    holders = [document.get(name) for name in ("accelerometer", "gyroscope", "magnetometer", "setup")]
    for name, entry in (item for holder in holders if holder for item in holder.get("effects", {}).items()):
        if name not in CATALOGUE:
            kind = entry.get("class")
            raise InputError(
                f"{path} holds an effect {name!r}, which the catalogue of this version lacks. "
                + (
                    f"It was defined by {kind}: import that class, and give it to jaximu.load_calibration(path, "
                    "effects=[…]), or to jaximu.register before."
                    if kind
                    else "A later version may know it; an effect of your own is made known by jaximu.register."
                )
            )


def _numbers(value: Any, shape: tuple[int, ...]) -> FloatArray:
    array = np.asarray(value, float)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"expected finite numbers of shape {shape}, found shape {array.shape}")
    return array


def _from_document(document: Json) -> Calibration:
    triads = {name: _triad_of(document[name], name) for name in SENSOR_QUANTITIES if document.get(name) is not None}
    if not triads:
        raise KeyError("accelerometer")
    fit, gravity = document["fit"], document["setup"]["gravity"]
    imu = Imu(
        triads.get("accelerometer", Imu.nominal().accelerometer),
        triads.get("gyroscope"),
        _effects_of(document["setup"].get("effects", {})),
        triads.get("magnetometer"),
    )
    known = {str(name): name for name in names_of(imu)}
    names = tuple(known[name] for name in document["covariance"]["parameters"])
    covariance = _numbers(document["covariance"]["matrix"], (len(names), len(names)))
    sigmas = dict(zip(names, sigmas_of(covariance), strict=True))
    kept: Json = {name: fit[name] for name in ("method", "loss", "rank", "solver")}
    kept |= {name: document.get(name) for name in ("diagnosis", "reference", "trace", "digest", "filter")}

    def recorded(name: str) -> FloatArray:
        entries = enumerate(document[name]["bias_sigma_recording"])
        return _numbers([sigmas[Name(name, "bias", (i,))] if x is None else x for i, x in entries], (3,))

    return Calibration(
        imu=imu,
        names=names,
        covariance=covariance,
        gravity=LocalGravity(gravity["value"], gravity["sigma"], gravity.get("latitude")),
        **kept,
        rms={name: (entry["before"], entry["after"], entry["unit"]) for name, entry in fit["rms"].items()},
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
        data=document["data"],
        notes=tuple(fit["notes"]),
        software=document["software"],
        absent=() if "accelerometer" in triads else ("accelerometer",),
        reading=None if document.get("reading") is None else Reading.from_document(document["reading"]),
        bias_sigma_recording={name: recorded(name) for name in triads if "bias_sigma_recording" in document[name]},
        magnetic={key: document.get(key) if key == "next" else document[key] for key in MAGNETIC}
        if "magnetometer" in triads
        else None,
    )


def _effects_of(entries: Json) -> tuple[Any, ...]:
    from jaximu.model.effects.catalogue import CATALOGUE

    effects = []
    for name, entry in entries.items():
        kind = CATALOGUE[name]
        inner = {key: float(parameter["value"]) for key, parameter in entry["inner"].items()}
        effects.append(kind.make(_numbers(entry["coefficients"], (kind.size,)), **inner))
    return tuple(effects)


def _triad_of(part: Json, name: str) -> Triad:
    gain = _numbers(part["gain"], (3, 3))
    if abs(np.linalg.det(unit_vectors(gain))) < 1e-6:
        raise ValueError("the gain is singular")
    return Triad(
        gain,
        _numbers(part["bias"], (3,)),
        _effects_of(part["effects"]),
        SENSOR_QUANTITIES[name],
        str(part["output_unit"]),
        temperature_reference=float(part["temperature_reference"]),
        time_reference=float(part["time_reference"]),
    )
