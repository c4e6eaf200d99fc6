"""Which effects of a magnetometer its recording shows: score tests about the fit, and the gain on parts left out.

The tests are those of every diagnosis (`Evidence`, `select`), asked of the conditions of the field about a calibration.
What the fit left is part of the weights there as white noise, so an effect stands out by its shape alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np

from jaximu.calibration import Calibration
from jaximu.calibration.calibration import require_another
from jaximu.data.field import FieldWindows, MagneticField
from jaximu.diagnosis.evidence import EffectBlock, Evidence
from jaximu.diagnosis.selection import select
from jaximu.estimation.fitting import linearise
from jaximu.estimation.leave_out import leave_out
from jaximu.estimation.rows import ResidualKind, Rows, Sizes
from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import chi2_sf, rms
from jaximu.ground.document import Json
from jaximu.ground.errors import InputError
from jaximu.ground.vectors import column_lengths, sigmas_of, submatrix
from jaximu.mistakes.titles import effect_title
from jaximu.model.effects import CATALOGUE, Effect
from jaximu.model.effects.base import Extent

_ONSETS = 40
"""Onsets at which a step is sought."""
_FOLDS = 5
_PAYS = 3.0
"""Nats that parts left out must gain for an effect to be named: a factor of 20 in likelihood."""
_NOTICEABLE = 0.05
"""Share by which the error of one kind of condition there must fall, and by which that of no kind may rise."""
_MOVED = 0.01
_LEAST_WARMING, _LEAST_CURRENT = 0.2, 1e-3  # K, A


@dataclass(frozen=True)
class MagneticCause:
    """An effect that a recording shows.

    effect: with the coefficients that the linear problem gives. rivals: names of effects that explain it as well.
    p_value: of its absence. gain: nats on fifths left out, and before, after: rms error there of the kind of condition
    that it improves most, in the kind's unit. largest: the most (µT) that it adds in this recording.
    """

    effect: Effect
    rivals: tuple[str, ...]
    p_value: float
    gain: float
    kind: ResidualKind
    before: float
    after: float
    largest: float

    def text(self) -> str:
        """Return what was found, and what to do."""
        onset, name = self.effect.since(), self.effect.beginning()
        since, option = ("", "") if onset is None else (f", from {onset:.4g} s on", f":{name}={onset:.4g}")
        unit = " µT" if self.kind.unit == "uT" else ""
        rivals = ", or " + " or ".join(map(effect_title, self.rivals)) if self.rivals else ""
        rivals += " (this recording cannot tell them apart)" if rivals else ""
        return (
            f"Found {self.effect.title}, up to {self.largest:.2g} µT{since}{rivals}. "
            f"Modelling it (--effect {self.effect.name}{option}) cuts the error of the {self.kind.words} on parts left "
            f"out from {self.before:.2g} to {self.after:.2g}{unit} (log-likelihood {self.gain:+.3g})."
        )

    def document(self) -> Json:
        """Return the cause as `calibration.json` has it under `diagnosis`."""
        return {
            "name": self.effect.name,
            "indistinguishable_from": list(self.rivals),
            "p_value": self.p_value,
            "improvement": {
                "heldout_rms_before": self.before,
                "heldout_rms_after": self.after,
                "quantity": self.kind.name,
                "unit": self.kind.unit,
                "heldout_loglik": self.gain,
            },
        } | self.effect.document("uT")


@dataclass(frozen=True)
class MagneticDiagnosis:
    """Causes, strongest first; p_value: that nothing is missing; not_asked: effects and why they were not asked."""

    causes: tuple[MagneticCause, ...]
    p_value: float
    not_asked: dict[str, str]

    def document(self) -> Json:
        """Return the diagnosis as `calibration.json` has it."""
        return {
            "verdict": "effects" if self.causes else "adequate",
            "effects": [cause.document() for cause in self.causes],
            "p_value": self.p_value,
            "not_observable": self.not_asked,
        }


def diagnose_magnetometer(calibration: Calibration, measurement: MagneticField) -> MagneticDiagnosis:
    """Ask a recording for every effect of a magnetometer that its calibration lacks.

    **Arguments:** as [`jaximu.calibration.calibrate_magnetometer`][] returns them; a calibration from a file has no
    fit to ask.

    An effect is named where its test stands out over all tests together (5 %) and fifths of the recording that were
    left out are predicted better with it: by three nats or more, and one of strength, carried field and dip with an
    error at least 5 % smaller, none with one 5 % larger. An onset is chosen on the whole recording.
    """
    fit, windows = calibration.fit, measurement.windows
    assert fit is not None
    model = jax.tree.map(np.asarray, fit.imu)
    linear = linearise(model, measurement, set(fit.names).__contains__)
    about = measurement.about(jax.tree.map(lambda leaf: leaf[None], model))
    covariance = jax.tree.map(lambda leaf: np.asarray(leaf)[0], about.covariance)
    rows = covariance.used > 0
    total = submatrix(np.asarray(covariance.total(np.asarray(fit.excess))), rows)
    weights = np.asarray(np.linalg.inv(np.linalg.cholesky(total)), np.float64)
    columns = np.concatenate([linear.slope, linear.columns * linear.sizes[linear.slope.shape[1] :]], axis=1)
    residual, jacobian = weights @ linear.conditions[rows], weights @ columns[rows]
    kinds, refused = _askable(windows, model.magnetometer)
    extent = _extent(windows)
    grids = {kind: kind.grid(extent) for kind in kinds}
    bare = model.with_effects()
    scale = float(np.mean(bare.magnetometer.scales))
    blocks = []
    for kind, slopes in measurement.dormant_columns(bare, linear.details, grids).items():
        size = np.asarray(kind.dormant().typical_sizes(scale).coefficients)
        blocks += [
            EffectBlock(kind.name, weights @ (slope * size)[rows], size, "effect", inner, kind.beginning() in inner)
            for inner, slope in zip(grids[kind], slopes, strict=True)
        ]
    if not blocks:
        return MagneticDiagnosis((), 1.0, refused)
    evidence = Evidence(residual, jacobian, blocks)
    selection = select(evidence)
    real = measurement.rows(model).real()
    causes = []
    for cause in selection.causes:
        block = evidence.blocks[cause.block]
        effect = CATALOGUE[block.name].make(evidence.coefficients([cause.block]) * block.sizes, **block.inner)
        extended = np.concatenate([jacobian, block.columns], axis=1)
        first, before = _left_out(weights, jacobian, residual, real)
        second, after = _left_out(weights, extended, residual, real)
        shares = [after[kind.name][0] / before[kind.name][0] if kind.name in before else 1.0 for kind in real.kinds]
        most = real.kinds[int(np.argmin(shares))]
        if second - first < _PAYS or min(shares) > 1 - _NOTICEABLE or max(shares) > 1 + _NOTICEABLE:
            refused[effect.name] = "it stands out, but parts left out are predicted no better with it"
            continue
        rivals = sorted({evidence.blocks[k].name for k in cause.rivals} - {effect.name})
        largest = float(np.max(np.abs(windows.added(bare.with_effects(effect))))) / scale
        errors = (second - first, most, before[most.name][0], after[most.name][0])
        causes.append(MagneticCause(effect, tuple(rivals), cause.p_value, *errors, largest))
    return MagneticDiagnosis(tuple(causes), selection.p_value, refused)


@dataclass(frozen=True)
class MagneticShift:
    """How a magnetometer differs from its old calibration.

    statistic, freedom, p_value: of all parameters together, if none had moved. iron (3,), iron_sigma (3,): change of
    the hard iron as a field, µT. heading: degrees, rms over level headings, that the old calibration is off by now;
    None without a dip.
    """

    statistic: float
    freedom: int
    p_value: float
    iron: FloatArray
    iron_sigma: FloatArray
    heading: float | None

    @property
    def holds(self) -> bool:
        """Whether nothing moved beyond what is uncertain (1 %)."""
        return self.p_value >= _MOVED

    def text(self) -> str:
        """Return the verdict, the reason and the next step."""
        size = float(np.linalg.norm(self.iron))
        cost = (
            "" if self.heading is None else f" With the old calibration a level heading is off by {self.heading:.2g}°."
        )
        chance = "< 1e-6" if self.p_value < 1e-6 else f"= {self.p_value:.2g}"
        if self.holds:
            return (
                f"The old calibration still holds: hard iron moved by {size:.2g} µT, no more than is uncertain "
                f"(p = {self.p_value:.2g}).{cost}"
            )
        return (
            f"The old calibration no longer holds (p {chance}): hard iron moved by {size:.2g} µT.{cost} Something "
            "magnetic was added, taken off or magnetised: use the new one."
        )

    def document(self) -> Json:
        """Return the comparison as `calibration.json` has it under `check`."""
        return {
            "verdict": "valid" if self.holds else "moved",
            "statistic": self.statistic,
            "freedom": self.freedom,
            "p_value": self.p_value,
            "hard_iron_shift": self.iron.tolist(),
            "sigma": self.iron_sigma.tolist(),
            "heading_off": self.heading,
            "unit": "uT",
        }


def check_magnetometer(old: Calibration, new: Calibration) -> MagneticShift:
    """Ask whether an old calibration of a magnetometer still holds, given a new one of another recording.

    Gains are compared up to one common factor, the strength of the field, which is another at another place. Raises
    `InputError` where one of them has no magnetometer, or outputs are in different units, `NotPossibleError` where both
    are of one recording.
    """
    require_another(old, [file.get("sha256", "") for file in new.data.get("files", ())])
    triads = [one.imu.magnetometer for one in (old, new) if one.magnetic is not None and one.imu.magnetometer]
    if len(triads) < 2:
        raise InputError("there is no magnetometer in one of the two calibrations that are to be compared.")
    if triads[0].output_unit != triads[1].output_unit:
        raise InputError(
            f"the old calibration is of a magnetometer in {triads[0].output_unit}, the new one in "
            f"{triads[1].output_unit}: state the columns' units as in the recording that was calibrated."
        )
    gains = [np.asarray(triad.gain) for triad in triads]
    factor = float(np.sum(gains[0] * gains[1]) / np.sum(gains[1] ** 2))
    names = [name for name in new.names if name.owner == "magnetometer" and name.effect is None and name in old.names]
    spreads, values = [], []
    for calibration, triad, scale in zip((old, new), triads, (1.0, factor), strict=True):
        rows = [calibration.names.index(name) for name in names]
        size = np.array([scale if name.part == "gain" else 1.0 for name in names])
        spreads.append(submatrix(calibration.covariance, rows) * size * size[:, None])
        values.append(size * np.array([np.asarray(getattr(triad, name.part))[name.axes] for name in names]))
    shift, spread = values[1] - values[0], spreads[0] + spreads[1]
    # along the common factor nothing can be told
    common = np.array([gains[0][name.axes] if name.part == "gain" else 0.0 for name in names])
    across = np.eye(len(names)) - np.outer(common, common) / max(float(common @ common), 1e-300)
    basis = np.linalg.svd(across)[0][:, : len(names) - 1]
    left, root = basis.T @ shift, np.linalg.cholesky(basis.T @ spread @ basis)
    statistic = float(np.sum(np.linalg.solve(root, left) ** 2))
    iron = [k for k, name in enumerate(names) if name.part == "bias"]
    inverse = np.linalg.inv(gains[0])
    return MagneticShift(
        statistic,
        len(left),
        float(chi2_sf(statistic, len(left))),
        inverse @ shift[iron],
        sigmas_of(inverse @ submatrix(spread, iron) @ inverse.T),
        _heading_off(triads, new.magnetic or {}),
    )


def _heading_off(triads, magnetic: Json) -> float | None:
    """Degrees, rms over level headings, that the first triad's heading is off in the field that the second was in."""
    field = magnetic["field"]
    if field["dip"] is None:
        return None
    dip, strength = np.radians(field["dip"]["value"]), field["strength"]["value"]
    angle = np.radians(np.arange(0.0, 360.0, 15.0))
    east, north, up = -np.cos(dip) * np.sin(angle), np.cos(dip) * np.cos(angle), -np.sin(dip)
    body = strength * np.stack([east, north, np.full(len(angle), up)], axis=1)
    old, new = triads
    output = body @ np.asarray(new.gain).T + np.asarray(new.bias)
    corrected = np.linalg.solve(np.asarray(old.gain), (output - np.asarray(old.bias)).T).T
    off = np.angle((corrected[:, 0] + 1j * corrected[:, 1]) / (body[:, 0] + 1j * body[:, 1]))
    return float(np.degrees(rms(off)))


def _askable(windows: FieldWindows, triad) -> tuple[list[type[Effect]], dict[str, str]]:
    """Return the effects of a magnetometer that can be asked, and why others cannot."""
    stimulus, fitted = windows.samples.track.stimulus, {effect.name for effect in triad.effects}
    inputs = {
        "temperature": (stimulus.temperature, _LEAST_WARMING),
        "current": (stimulus.current, _LEAST_CURRENT),
        "angular_rate": (stimulus.angular_rate, 0.0),
    }
    kinds, refused = [], {}
    for kind in CATALOGUE.values():
        if kind.owner != "magnetometer" or kind.name in fitted:
            continue
        reason = ""
        for name, (values, least) in inputs.items():
            if name in kind.needs and values is None:
                reason = f"no {name.replace('_', ' ')} was recorded"
            elif name in kind.needs and float(np.ptp(np.asarray(values))) < least:
                reason = f"the {name} stood still"
        if "time" in kind.needs and (np.diff(windows.time[:, 0]) < 0).any():
            reason = "it is of one recording, and several were given"
        if reason:
            refused[kind.name] = reason
        else:
            kinds.append(kind)
    return kinds, refused


def _extent(windows: FieldWindows) -> Extent:
    edges = windows.time[1:, 0]
    warm = windows.samples.track.stimulus.temperature
    span = 0.0 if warm is None else float(np.ptp(np.asarray(warm)))
    return Extent(float(np.ptp(windows.time)), tuple(edges[:: -(-len(edges) // _ONSETS)].tolist()), span)


def _left_out(weights: FloatArray, columns: FloatArray, residual: FloatArray, real: Rows) -> tuple[float, Sizes]:
    """Return log-likelihood and rms errors of fifths, each predicted from all the rest."""
    parts = [real.touching(part) for part in real.parts(_FOLDS)]
    likelihood, errors = 0.0, np.zeros(len(residual))
    size = 1 / column_lengths(weights)  # rows are in µT and sines: what is blind is told in units of their own
    for part in leave_out(weights * size, columns, residual, parts):
        likelihood += part.log_likelihood()
        errors[part.rows] = size[part.rows] * part.errors
    return likelihood, real.rms(errors)
