"""Whether an old calibration still holds for a new recording: what moved, by how much, and what else may explain it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaximu import stored
from jaximu._version import __version__
from jaximu.calibration import Calibration
from jaximu.diagnosis.diagnosis import probability
from jaximu.diagnosis.evidence import Block, Evidence
from jaximu.diagnosis.hand_held import HandHeld
from jaximu.diagnosis.noise import own_noise
from jaximu.diagnosis.selection import Selection, select
from jaximu.distributions import chi2_sf, normal_sf
from jaximu.effects import CATALOGUE, Effect
from jaximu.errors import InputError
from jaximu.formats.document import Document
from jaximu.gravity import STANDARD, LocalGravity
from jaximu.noise.model import NoiseModel
from jaximu.precision import require_float64
from jaximu.problem import TOLERANCE, Parameters, unflatten, without_equipment
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

__all__ = ["Cause", "OutputError", "Shift", "Validity", "check"]

FloatArray = NDArray[np.float64]
SCHEMA = "jaximu.check/1"
GYROSCOPE_BIAS = tuple(f"gyroscope.bias[{axis}]" for axis in range(3))
_OTHER_UNIT = 0.05
"""Difference of gains, in scales, that no unit's calibration makes: it is another unit, or its axes or units are."""
_FAR_OFF = (0.05 * STANDARD_GRAVITY, 0.2)
"""Errors (m/s² of gravity's norm, rad over a turn) that no calibration's age makes, in the median."""
_COMPARABLE = 0.1
"""Uncertainty, in typical sizes (10 % of a scale, 1 m/s²), beyond which a recording tells nothing of a parameter."""
_FEWEST = 12
"""Dimensions that the parameters must leave for effects to be asked for."""
_ROUNDS = 3
"""Steps of the fresh calibration: shifts of a percent are all but linear."""
_FREE = 1e4
"""Typical sizes that the coefficients of an effect may have: as good as free."""
_WARMTH = 1.0  # K


@dataclass(frozen=True)
class Shift:
    """How a parameter differs from the calibration's: new − old in its own unit, with the difference's sigma.

    in_si, sigma_in_si: what it changes in the calibrated output, m/s² or rad/s, at the input `at`; None for an effect's
    coefficients. p_value: of no difference, corrected for the number of parameters (Holm). comparable: the recording
    tells the parameter at all. allowed: it may differ from one power-on to the next, and is not tested.
    """

    name: str
    old: float
    difference: float
    sigma: float
    unit: str
    in_si: float | None
    sigma_in_si: float | None
    si_unit: str
    at: str
    p_value: float
    moved: bool
    comparable: bool
    allowed: bool

    @property
    def z(self) -> float:
        """The difference in standard deviations."""
        return self.difference / self.sigma

    @property
    def tested(self) -> bool:
        """Whether it was tested."""
        return self.comparable and not self.allowed

    def document(self) -> dict[str, Any]:
        """Return the shift as `check.json` has it."""
        si = None if self.in_si is None else {
            "value": self.in_si, "sigma": self.sigma_in_si, "unit": self.si_unit, "at": self.at
        }  # fmt: skip
        return {
            "name": self.name, "old": self.old, "new": self.old + self.difference, "shift": self.difference,
            "sigma": self.sigma, "unit": self.unit, "z": self.z, "si": si,
            "p_value": self.p_value if self.tested else None, "moved": self.moved, "allowed": self.allowed,
        }  # fmt: skip


@dataclass(frozen=True)
class Cause:
    """What explains the difference: parameters that moved, an effect of the catalogue, or a pose that was bumped.

    scope: "parameter", or "device", "session", "fixture" of an effect, "data" of a pose. rivals: what explains the
    recording as well. p_value: of its absence, its grid allowed for.
    """

    name: str
    scope: str
    rivals: tuple[str, ...]
    p_value: float
    coefficients: FloatArray
    inner: dict[str, float]
    unit: str

    @property
    def words(self) -> str:
        """What the scope means."""
        return {
            "parameter": "moved", "device": "an effect of the unit that the calibration lacks",
            "session": "belongs to this recording",
            "fixture": "gravity is another here, or all scales of the accelerometer changed alike",
            "data": "a pose that was bumped",
        }[self.scope]  # fmt: skip

    def document(self) -> dict[str, Any]:
        """Return the cause as `check.json` has it."""
        return {
            "name": self.name, "scope": self.scope, "indistinguishable_from": list(self.rivals),
            "p_value": self.p_value, "coefficients": self.coefficients.tolist(), "inner": self.inner,
            "unit": self.unit,
        }  # fmt: skip


@dataclass(frozen=True)
class OutputError:
    """The most that the old calibration's output differs from a fresh one's in the recording, and the sigma there."""

    value: float
    sigma: float
    unit: str

    def document(self) -> dict[str, Any]:
        """Return the error as `check.json` has it."""
        return {"value": self.value, "sigma": self.sigma, "unit": self.unit}


@dataclass(frozen=True)
class Validity(Document):
    """Whether a calibration still holds for a recording.

    verdict: "valid"; "shifted" (parameters moved); "session" (the parameters hold, and what belongs to the recording
    explains the rest); "effect" (the unit has an effect that the calibration lacks, with parameters that may be off by
    it); or "unexplained" (no parameters fit the recording). p_value: family-wise, that nothing differs.
    chi_squared, freedom: of the conditions that the old calibration predicts, both its uncertainty and the recording's
    noise allowed for. difference: χ², degrees of freedom and p-value of all comparable parameters together, gyroscope
    bias apart. errors: rms by kind of residual, of the old calibration and of a fresh one, with its unit. scatter:
    factors by kind of residual on the noise, above one where the recording scatters more about any calibration.
    """

    verdict: str
    p_value: float
    chi_squared: float
    freedom: int
    difference: tuple[float, int, float]
    shifts: tuple[Shift, ...]
    causes: tuple[Cause, ...]
    output_errors: dict[str, OutputError]
    errors: dict[str, tuple[float, float, str]]
    scatter: dict[str, float]
    notes: tuple[str, ...]
    experiment: HandHeld
    conditions: tuple[FloatArray, FloatArray]  # (n,) under the old calibration and under the fresh one
    data: dict[str, Any]
    calibration: Calibration

    @property
    def moved(self) -> tuple[Shift, ...]:
        """Parameters that moved, most significant first."""
        return tuple(sorted((each for each in self.shifts if each.moved), key=lambda each: -abs(each.z)))

    def bias_words(self) -> str:
        """Say how far the gyroscope's bias is off, which is no fault of the calibration."""
        shift = np.array([each.in_si for each in self.shifts if each.allowed], float)
        return (
            f"gyroscope bias: {np.degrees(np.linalg.norm(shift)):.2g} °/s off the calibration's; it is another after "
            "every power-on, which is allowed: take it anew at rest."
        )

    def headline(self) -> str:
        """Return the one sentence a person wants first."""
        ratio = f"χ² per condition {self.chi_squared / self.freedom:.2f}, p {probability(self.p_value)}"
        if self.verdict == "valid":
            return f"The calibration is still valid: it predicts this recording to within its uncertainty ({ratio})."
        if self.verdict == "unexplained":
            return (
                f"The calibration does not predict this recording ({ratio}), and no change of its parameters would: "
                "diagnose the recording to see why."
            )
        causes = ", ".join(each.name for each in self.causes if each.scope != "parameter")
        if self.verdict == "session":
            return (
                f"The calibration still holds; what it does not predict ({ratio}) belongs to this recording: {causes}."
            )
        if self.verdict == "effect":
            what = "gain and bias, fitted without it, differ from a fresh fit's" if self.moved else "gain and bias hold"
            return (
                f"The unit shows what the calibration lacks ({ratio}): {causes}; {what}. Diagnose a recording and keep "
                "the extended calibration."
            )
        words = [_shift_words(each) for each in self.moved[:3]]
        words = words or [f"{each.name} moved" for each in self.causes if each.scope == "parameter"]
        rest = f" and {len(self.moved) - 3} more" if len(self.moved) > 3 else ""
        beyond = f"; beyond that the recording shows {causes}" if causes else ""
        return f"The calibration is no longer valid: {'; '.join(words)}{rest}{beyond} ({ratio})."

    def document(self) -> dict[str, Any]:
        """Return the JSON document of schema `jaximu.check/1`."""
        statistic, freedom, p_value = self.difference
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "sentence": self.headline(),
            "p_value": self.p_value,
            "prediction": {
                "chi_squared": self.chi_squared, "degrees_of_freedom": self.freedom,
                "p_value": float(chi2_sf(self.chi_squared, self.freedom)),
            },
            "difference": {"chi_squared": statistic, "degrees_of_freedom": freedom, "p_value": p_value},
            "parameters": [each.document() for each in self.shifts if each.comparable],
            "not_comparable": [each.name for each in self.shifts if not each.comparable],
            "causes": [each.document() for each in self.causes],
            "output_error": {name: each.document() for name, each in self.output_errors.items()},
            "errors": {
                name: {"old": old, "fresh": fresh, "unit": unit} for name, (old, fresh, unit) in self.errors.items()
            },
            "scatter": self.scatter,
            "notes": list(self.notes),
            "calibration": self.calibration.data,
            "data": self.data,
            "software": {"name": "jaximu", "version": __version__},
        }  # fmt: skip


def _shift_words(shift: Shift) -> str:
    text = f"{shift.name} moved by {shift.difference:+.3g} {shift.unit}"
    if shift.in_si is not None:
        text += f" ({shift.in_si:+.2g} {shift.si_unit}{f' at {shift.at}' if shift.at else ''}, {abs(shift.z):.1f} σ)"
    return text


# --- the way of the data ---------------------------------------------------------------------------------------------


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
    old = _Old.of(calibration, gravity)
    experiment = HandHeld(parts, observe(parts, gravity.value, noise=noise), old.imu)
    old = old.rested(experiment)
    notes += _temperatures(calibration, old.effects, experiment)
    conditions = experiment.predict(old.imu.with_effects(*old.effects))[0]
    _same_unit(experiment, conditions, recordings[0].name)

    scatter = np.ones(len(experiment.residual_kinds))
    fresh = _Fresh.fit(old, experiment, scatter)
    _same_gains(old, fresh, recordings[0].name)
    enough = len(conditions) - len(old.names) >= _FEWEST and bool(fresh.known(old).all())
    blocks = _effects(old, experiment) if enough else []
    question = _Question.ask(old, experiment, scatter, blocks)
    selection = select(question.evidence, level)
    if not selection.complete:
        scatter = _scatter(old, experiment)
        question = _Question.ask(old, experiment, scatter, blocks)
        selection = select(question.evidence, level)
    chosen = [cause.block for cause in selection.causes] if selection.complete else []
    causes = _causes(question, selection, old)
    given = [question.columns(k) for k in chosen if question.scopes[k] != "parameter"]
    fresh = _Fresh.fit(old, experiment, scatter, given)
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


def _same_gains(old: _Old, fresh: _Fresh, name: str) -> None:
    for place, each in enumerate(old.names):
        triad, _, rest = each.partition(".")
        if not rest.startswith("gain"):
            continue
        scale, shift = old.scales[place], abs(fresh.difference[place])
        if shift > _OTHER_UNIT * scale and shift > 5 * np.sqrt(fresh.covariance_of_difference[place, place]):
            raise InputError(
                f"{name}: the {triad}'s gain differs from the calibration's by {100 * shift / scale:.2g} % ({each}): "
                "is it the same unit, in the same units and axes?"
            )


def _temperatures(calibration: Calibration, effects: Sequence[Effect], experiment: HandHeld) -> list[str]:
    """Say where temperatures differ and the calibration has nothing that depends on them."""
    before = calibration.data.get("temperature")
    if before is None or any("temperature" in " ".join(effect.needs) for effect in effects):
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


@dataclass(frozen=True)
class _Old:
    """The old calibration as an experiment names it: numbers, their covariance and typical sizes.

    scales: output units per SI of the axis each belongs to. common: how the numbers react to an error of gravity that
    is the old and the new recording's (per m/s²), if it is, and how uncertain each recording's own gravity is.
    """

    imu: Imu
    effects: tuple[Effect, ...]
    names: tuple[str, ...]
    values: FloatArray
    covariance: FloatArray
    sizes: FloatArray
    scales: FloatArray
    units: tuple[str, ...]
    gravity: FloatArray
    common: bool
    local: LocalGravity
    rest: FloatArray  # what `imu` differs by from `values`

    @classmethod
    def of(cls, calibration: Calibration, local: LocalGravity) -> _Old:
        whole = jax.tree.map(np.asarray, calibration.imu)
        imu = whole.transferable()
        effects = tuple(effect for triad in imu.triads().values() for effect in triad.effects)
        imu = imu.with_effects()
        parameters = Parameters.select(imu, without_equipment)
        flat = np.asarray(parameters.reference)[list(parameters.index)]
        names, values = list(parameters.names), list(flat)
        sizes = list(np.asarray(parameters.size))
        places = {name: place for place, name in enumerate(calibration.names)}
        known = [places.get(name) for name in names]
        triads = whole.triads()
        scales, units = [], []
        for name in names:
            triad, _, rest = name.partition(".")
            axis = int(rest.partition("[")[2][0])
            scales.append(float(np.linalg.norm(np.asarray(triads[triad].gain)[axis])))
            unit = triads[triad].output_unit
            si = "(m/s^2)" if triad == "accelerometer" else "(rad/s)"
            units.append(unit if rest.startswith("bias") else f"{f'({unit})' if '/' in unit else unit}/{si}")
        for effect in effects:
            place = next(k for k, each in enumerate(triads[effect.owner].effects) if each.name == effect.name)
            stem, own = f"{effect.owner}.effects[{place}]", effect.coefficient_unit(triads[effect.owner].output_unit)
            numbers = [(f"[{k}]", f".coefficients[{k}]", float(c), own)
                       for k, c in enumerate(np.asarray(effect.coefficients))]  # fmt: skip
            numbers += [(f".{key}", f".{key}", float(getattr(effect, key)), each.unit)
                        for key, each in effect.inner.items()]  # fmt: skip
            for ending, kept, value, unit in numbers:
                names.append(effect.name + ending)
                known.append(places.get(stem + kept))
                values.append(value)
                variance = 0.0 if known[-1] is None else float(calibration.covariance[known[-1], known[-1]])
                sizes.append(10 * max(abs(value), np.sqrt(variance), 1e-12))
                scales.append(1.0)
                units.append(unit)
        covariance = np.zeros((len(names), len(names)))
        there = [k for k, place in enumerate(known) if place is not None]
        found = [place for place in known if place is not None]
        covariance[np.ix_(there, there)] = calibration.covariance[np.ix_(found, found)]
        # Gravity g too large makes the accelerometer's gain K too small: dK/dg = −K/g.
        gravity = np.array([
            -value / local.value if name.startswith("accelerometer.gain") else 0.0
            for name, value in zip(names, values, strict=True)
        ])  # fmt: skip
        common = calibration.gravity == local
        if common and local.sigma > 0:
            covariance = _without(covariance, gravity, local.sigma)
        return cls(
            imu, effects, tuple(names), np.array(values), covariance, np.array(sizes), np.array(scales), tuple(units),
            gravity, common, local, np.zeros(len(names)),
        )  # fmt: skip

    @property
    def allowed(self) -> list[int]:
        """Places of the gyroscope's bias."""
        return [self.names.index(name) for name in GYROSCOPE_BIAS]

    def rested(self, experiment: HandHeld) -> _Old:
        """Return the calibration with the gyroscope's bias taken anew at rest.

        Turns under a bias that is off by degrees a second are not linear in it.
        """
        poses = experiment.observations.poses
        rest = np.zeros(len(self.names))
        bias = np.mean(np.asarray(poses.gyroscope_mean)[np.asarray(poses.mask)], axis=0)
        rest[self.allowed] = bias - self.values[self.allowed]
        return replace(self, imu=_applied(self, rest), rest=rest)


def _without(covariance: FloatArray, slope: FloatArray, sigma: float) -> FloatArray:
    """Return the covariance less what an uncertain gravity added, no more than it holds."""
    inverse = np.linalg.pinv(covariance, rcond=1e-13, hermitian=True)
    most = 1 / max(float(slope @ inverse @ slope), 1e-300)
    return covariance - min(sigma**2, most) * slope[:, None] * slope


@dataclass(frozen=True)
class _Question:
    """The old calibration's prediction, whitened with its own uncertainty, and everything that may explain its error.

    The base is the gyroscope's bias alone. raw: each block's columns, not whitened. scopes: by block.
    """

    evidence: Evidence
    raw: list[FloatArray]
    scopes: list[str]

    def columns(self, block: int) -> FloatArray:
        """Return a block's columns, not whitened, in units of what its coefficients may be: as good as anything."""
        return self.raw[block] * (1.0 if self.scopes[block] == "fixture" else _FREE)

    @classmethod
    def ask(
        cls, old: _Old, experiment: HandHeld, scatter: FloatArray, effects: Sequence[tuple[Block, str]]
    ) -> _Question:
        conditions, columns, covariance, _ = experiment.predict(old.imu.with_effects(*old.effects))
        spread = np.array(old.covariance)
        spread[old.allowed] = 0.0
        spread[:, old.allowed] = 0.0
        wide = scatter[experiment.kinds]
        whole = covariance * wide[:, None] * wide + columns @ spread @ columns.T
        if not old.common:
            reach = columns @ old.gravity * old.local.sigma
            whole += reach[:, None] * reach
        weights = np.linalg.inv(np.linalg.cholesky(whole))
        blocks, raw, scopes = [], [], []

        def add(block: Block, scope: str) -> None:
            blocks.append(replace(block, columns=weights @ block.columns))
            raw.append(block.columns)
            scopes.append(scope)

        for name, places in _groups(old):
            moved = -columns[:, places] * old.sizes[places]
            add(Block(name, moved, old.sizes[places]), "parameter")
        bias = weights @ columns[:, old.allowed]
        if old.common and old.local.sigma > 0:  # unless the place was another one
            sigma = np.sqrt(2) * old.local.sigma  # between two places
            reach = Block("setup.gravity", (columns @ old.gravity)[:, None] * sigma, np.full(1, sigma))
            alone = Evidence(weights @ conditions, bias, [replace(reach, columns=weights @ reach.columns)])
            if abs(alone.coefficients([0])[0]) < 3:
                add(reach, "fixture")
        for block, scope in effects:
            add(block, scope)
        return cls(Evidence(weights @ conditions, bias, blocks), raw, scopes)


def _effects(old: _Old, experiment: HandHeld) -> list[tuple[Block, str]]:
    """What else a diagnosis asks the recording for, not whitened, with its scope."""
    state = experiment.fit(old.effects, old.imu)
    root = np.linalg.inv(state.weights)
    return [
        (replace(block, columns=root @ block.columns),
         CATALOGUE[block.name].scope if block.kind == "effect" else block.kind)
        for block in state.evidence.blocks
    ]  # fmt: skip


def _groups(old: _Old) -> list[tuple[str, list[int]]]:
    """Parameters that may have moved by themselves or together: single ones, each triad's, all."""
    tested = [k for k in range(len(old.names)) if k not in old.allowed]
    found = [(old.names[k], [k]) for k in tested]
    for name in ("accelerometer.bias", "accelerometer.gain", "gyroscope.gain", "accelerometer"):
        found.append((name, [k for k in tested if old.names[k].startswith(name)]))
    return [*found, ("accelerometer and gyroscope", tested)]


def _scatter(old: _Old, experiment: HandHeld) -> FloatArray:
    """Factors (kinds,), one at least, by which each kind of condition scatters about a fresh calibration."""
    scatter = np.ones(len(experiment.residual_kinds))
    for _ in range(4):
        fresh = _Fresh.fit(old, experiment, scatter)
        for place in range(len(scatter)):
            rows = experiment.kinds == place
            left = fresh.left[np.ix_(rows, rows)]
            if not rows.any():
                continue
            values, vectors = np.linalg.eigh(left)
            keep = values > 1e-6 * values[-1]
            along = vectors[:, keep].T @ fresh.conditions[rows] / np.sqrt(values[keep])
            scatter[place] = max(1.0, scatter[place] * np.sqrt(float(along @ along) / keep.sum()))
    return scatter


@dataclass(frozen=True)
class _Fresh:
    """A fresh calibration about the old one, however few the poses: difference (p,), covariance (p, p) of the new one.

    A parameter is known beforehand to some typical sizes, so what the recording does not tell stays where it was, with
    an uncertainty that says so. conditions: under it, with their covariance after the fit.
    """

    difference: FloatArray
    covariance: FloatArray
    covariance_of_difference: FloatArray
    conditions: FloatArray
    left: FloatArray

    @classmethod
    def fit(cls, old: _Old, experiment: HandHeld, scatter: FloatArray, given: Sequence[FloatArray] = ()) -> _Fresh:
        """Fit all parameters and what the recording adds by `given` columns, in units of what is known beforehand."""
        base, count = len(Parameters.select(old.imu, without_equipment).names), len(old.names)
        extra = [-columns for columns in given]
        # all in units of what is known beforehand: the parameters' own differ by orders of magnitude
        unit = np.concatenate([TOLERANCE * old.sizes, np.ones(sum(each.shape[1] for each in extra))])
        wide = scatter[experiment.kinds]

        def step(offset: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
            conditions, columns, covariance, _ = experiment.predict(_applied(old, offset).with_effects(*old.effects))
            covariance = covariance * wide[:, None] * wide
            columns = np.concatenate([columns, *extra], axis=1) * unit
            start = conditions - columns[:, :base] @ (offset / unit)[:base]
            weights = np.linalg.inv(np.linalg.cholesky(covariance))
            white = weights @ columns
            spread = np.linalg.inv(white.T @ white + np.eye(len(unit)))
            share = -spread @ (white.T @ (weights @ start))
            error, left = start + columns @ share, covariance - columns @ spread @ columns.T
            return unit * share, np.asarray(unit[:, None] * spread * unit, np.float64), error, left

        offset, spread, error, left = step(np.zeros(len(unit)))
        for _ in range(_ROUNDS - 1):
            offset, spread, error, left = step(offset)
        new = spread[:count, :count]
        if not old.common:
            new = new + np.square(old.local.sigma) * old.gravity[:, None] * old.gravity
        return cls(offset[:count], new, new + old.covariance, error, left)

    def known(self, old: _Old) -> NDArray[np.bool_]:
        """Which parameters the recording tells at all."""
        return np.sqrt(np.diag(self.covariance)) < _COMPARABLE * old.sizes


def _causes(question: _Question, selection: Selection, old: _Old) -> tuple[Cause, ...]:
    """What was selected, in words; of nested groups of parameters none is the other's rival."""
    if not selection.complete:
        return ()
    chosen = [cause.block for cause in selection.causes]
    evidence = question.evidence
    numbers = evidence.coefficients(chosen) if chosen else np.zeros(0)
    edges = np.cumsum([0, *(len(evidence.blocks[k].sizes) for k in chosen)])
    found = []
    for cause, a, b in zip(selection.causes, edges[:-1], edges[1:], strict=True):
        block, scope = evidence.blocks[cause.block], question.scopes[cause.block]
        rivals = {
            evidence.blocks[k].name for k in cause.rivals if not scope == question.scopes[k] == "parameter"
        } - {block.name}  # fmt: skip
        unit = ""
        if scope == "parameter" and block.name in old.names:
            unit = old.units[old.names.index(block.name)]
        elif block.name in CATALOGUE:
            kind = CATALOGUE[block.name]
            unit = kind.coefficient_unit(old.imu.triads().get(kind.owner, old.imu.accelerometer).output_unit)
        found.append(Cause(block.name, scope, tuple(sorted(rivals)), cause.p_value, numbers[a:b] * block.sizes,
                           dict(block.inner), unit))  # fmt: skip
    return tuple(found)


def _verdict(selection: Selection, causes: Sequence[Cause]) -> str:
    if not selection.complete:
        return "unexplained"
    if not causes:
        return "valid"
    lacking = [CATALOGUE[cause.name].owner for cause in causes if cause.scope == "device"]
    # what a triad lacks was in part taken for its gain and bias: that they are others now is no fault of theirs
    moved = any(cause.scope == "parameter" and cause.name.partition(".")[0] not in lacking for cause in causes)
    return "shifted" if moved else ("effect" if lacking else "session")


def _shifts(old: _Old, fresh: _Fresh, level: float) -> tuple[Shift, ...]:
    """Every parameter's difference; at level zero none counts as moved: the recording says nothing against them."""
    difference, sigma = fresh.difference + old.rest, np.sqrt(np.diag(fresh.covariance_of_difference))
    comparable = fresh.known(old)
    raw = 2 * normal_sf(np.abs(difference) / sigma)
    asked = [k for k in np.argsort(raw) if comparable[k] and k not in old.allowed]
    p_value = np.ones(len(raw))
    worst = 0.0
    for rank, k in enumerate(asked):
        worst = max(worst, min(1.0, float(raw[k]) * (len(asked) - rank)))
        p_value[k] = worst
    found = []
    for k, name in enumerate(old.names):
        triad, _, rest = name.partition(".")
        own = triad in ("accelerometer", "gyroscope")
        gain = rest.startswith("gain")
        unit, input_ = ("m/s^2", STANDARD_GRAVITY) if triad == "accelerometer" else ("rad/s", 1.0)
        factor = (input_ if gain else 1.0) / old.scales[k] if own else None
        found.append(Shift(
            name, float(old.values[k]), float(difference[k]), float(sigma[k]), old.units[k],
            None if factor is None else float(factor * difference[k]),
            None if factor is None else float(factor * sigma[k]), unit if own else "",
            ("1 g" if triad == "accelerometer" else "1 rad/s") if gain else "",
            float(p_value[k]), bool(p_value[k] < level), bool(comparable[k]), k in old.allowed,
        ))  # fmt: skip
    return tuple(found)


# --- what it does to the output --------------------------------------------------------------------------------------


def _output_errors(old: _Old, fresh: _Fresh, experiment: HandHeld) -> dict[str, OutputError]:
    """The largest difference of the outputs in the recording, gyroscope bias apart, and of the turns' rotations."""
    found = {}
    shifted = _applied(old, fresh.difference)
    for name, unit in (("accelerometer", "m/s^2"), ("gyroscope", "rad/s")):
        before, after = old.imu.triads()[name], shifted.triads()[name]
        places = [k for k, each in enumerate(old.names) if each.startswith(f"{name}.") and k not in old.allowed]
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
            index = [int(each) for each in old.names[k].rstrip("]").partition("[")[2].split(",")]
            columns.append(inverse[:, index[0]] * (force[index[1]] if len(index) == 2 else 1.0))
        slope = np.stack(columns, axis=1)
        spread = slope @ fresh.covariance_of_difference[np.ix_(places, places)] @ slope.T
        found[name] = OutputError(value, float(np.sqrt(np.trace(spread))), unit)
    turns = experiment.observations.turns
    real = np.asarray(turns.mask)
    if real.any():
        vectors, slope = (
            np.degrees(np.asarray(each)[real])
            for each in stored.call(_turned, "turns of two gains", old.imu, shifted, turns.output, turns.interval)
        )
        worst = int(np.argmax(np.linalg.norm(vectors, axis=1)))
        places = [old.names.index(f"gyroscope.gain[{i},{j}]") for i in range(3) for j in range(3)]
        slope = slope[worst].reshape(3, 9)
        spread = slope @ fresh.covariance_of_difference[np.ix_(places, places)] @ slope.T
        value = float(np.linalg.norm(vectors[worst]))
        found["turns"] = OutputError(value, float(np.sqrt(np.trace(spread))), "deg")
    return found


def _applied(old: _Old, difference: FloatArray) -> Imu:
    """The old unit with its gain and bias moved."""
    parameters = Parameters.select(old.imu, without_equipment)
    flat = np.array(parameters.reference)
    flat[list(parameters.index)] += difference[: len(parameters.names)]
    return unflatten(old.imu, flat)


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
