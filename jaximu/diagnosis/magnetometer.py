"""Which effects of a magnetometer its recording shows: score tests about the fit, and the gain on parts left out.

The tests are those of every diagnosis (`Evidence`, `select`), asked of the conditions of the field about a calibration.
What the fit left is part of the weights there as white noise, so an effect stands out by its shape alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaximu.calibration import Calibration
from jaximu.diagnosis.evidence import Block, Evidence
from jaximu.diagnosis.selection import select
from jaximu.effects import CATALOGUE, Effect
from jaximu.effects.base import Extent
from jaximu.estimation import linearise
from jaximu.leave_out import leave_out
from jaximu.measurements.field import FieldWindows, MagneticField

__all__ = ["MagneticCause", "MagneticDiagnosis", "diagnose_magnetometer"]

FloatArray = NDArray[np.float64]
_PLACES = 40
"""Onsets at which a step is sought."""
_FOLDS = 5
_PAYS = 3.0
"""Nats that parts left out must gain for an effect to be named: a factor of 20 in likelihood."""
_LEAST_WARMING, _LEAST_CURRENT = 0.2, 1e-3  # K, A


@dataclass(frozen=True)
class MagneticCause:
    """An effect that a recording shows.

    effect: with the coefficients that the linear problem gives. rivals: names of effects that explain it as well.
    p_value: of its absence. gain: nats, and before, after: rms error of the field's strength (µT), on fifths left out.
    largest: the most (µT) that it adds in this recording.
    """

    effect: Effect
    rivals: tuple[str, ...]
    p_value: float
    gain: float
    before: float
    after: float
    largest: float

    def text(self) -> str:
        """Return what was found, and what to do."""
        words = self.effect.name.partition(".")[2].replace("_", " ")
        onset = getattr(self.effect, "onset", None)
        since, option = ("", "") if onset is None else (f" from {onset:.4g} s on", f":onset={onset:.4g}")
        rivals = f" (or {', '.join(self.rivals)}: this recording cannot tell them apart)" if self.rivals else ""
        return (
            f"Found magnetometer {words}{since} ({self.effect.name}), up to {self.largest:.2g} µT{rivals}. With "
            f"--effect {self.effect.name}{option} parts left out are predicted better, by {self.gain:.3g} nats; the "
            f"error of the strength there goes from {self.before:.2g} to {self.after:.2g} µT."
        )

    def document(self) -> dict[str, Any]:
        """Return the cause as `calibration.json` has it under `diagnosis`."""
        return {
            "name": self.effect.name, "indistinguishable_from": list(self.rivals), "p_value": self.p_value,
            "improvement": {"heldout_rms_before": self.before, "heldout_rms_after": self.after, "unit": "uT",
                            "heldout_loglik": self.gain},
        } | self.effect.document("uT")  # fmt: skip


@dataclass(frozen=True)
class MagneticDiagnosis:
    """Causes, strongest first; p_value: that nothing is missing; not_asked: effects and why they were not asked."""

    causes: tuple[MagneticCause, ...]
    p_value: float
    not_asked: dict[str, str]

    def document(self) -> dict[str, Any]:
        """Return the diagnosis as `calibration.json` has it."""
        return {
            "verdict": "effects" if self.causes else "adequate", "effects": [each.document() for each in self.causes],
            "p_value": self.p_value, "not_observable": self.not_asked,
        }  # fmt: skip


def diagnose_magnetometer(calibration: Calibration, measurement: MagneticField) -> MagneticDiagnosis:
    """Ask a recording for every effect of a magnetometer that its calibration lacks.

    **Arguments:** as [`jaximu.calibration.calibrate_magnetometer`][] returns them; a calibration from a file has no
    fit to ask.

    An effect is named where its test stands out over all tests together (5 %) and fifths of the recording that were
    left out are predicted better with it by three nats or more. An onset is chosen on the whole recording.
    """
    found, windows = calibration.fit, measurement.windows
    assert found is not None
    kept = set(found.names)
    model = jax.tree.map(np.asarray, found.model)
    linear = linearise(model, measurement, lambda name: name in kept)
    about = measurement.about(jax.tree.map(lambda leaf: leaf[None], model))
    covariance = jax.tree.map(lambda leaf: np.asarray(leaf)[0], about.covariance)
    rows = covariance.used > 0
    total = np.asarray(covariance.total(np.asarray(found.excess)))[np.ix_(rows, rows)]
    weights = np.linalg.inv(np.linalg.cholesky(total))
    columns = np.concatenate([linear.slope, linear.columns * linear.sizes[linear.slope.shape[1] :]], axis=1)
    residual, jacobian = weights @ linear.conditions[rows], weights @ columns[rows]
    asked, refused = _askable(windows, model.magnetometer)
    extent = _extent(windows)
    grids = {kind: kind.grid(extent) for kind in asked}
    bare = model.with_effects()
    scale = float(np.mean(np.linalg.norm(np.asarray(bare.magnetometer.gain), axis=1)))
    blocks = []
    for kind, slopes in measurement.dormant_columns(bare, linear.details, grids).items():
        size = np.asarray(kind.dormant().typical_sizes(scale).coefficients)
        blocks += [Block(kind.name, weights @ (each * size)[rows], size, "effect", inner, "onset" in inner)
                   for inner, each in zip(grids[kind], slopes, strict=True)]  # fmt: skip
    if not blocks:
        return MagneticDiagnosis((), 1.0, refused)
    evidence = Evidence(residual, jacobian, blocks)
    selection = select(evidence)
    touched = _touched(windows)[rows]
    strength = np.flatnonzero(np.flatnonzero(rows) < len(windows))
    causes = []
    for cause in selection.causes:
        block = evidence.blocks[cause.block]
        effect = CATALOGUE[block.name].make(evidence.coefficients([cause.block]) * block.sizes, **block.inner)
        pair = [np.asarray(jacobian), np.concatenate([jacobian, block.columns], axis=1)]
        (first, before), (second, after) = (_left_out(weights, each, residual, touched, strength) for each in pair)
        if second - first < _PAYS:
            refused[effect.name] = "it stands out, but parts left out are predicted no better with it"
            continue
        rivals = sorted({evidence.blocks[k].name for k in cause.rivals} - {effect.name})
        largest = float(np.max(np.abs(windows.added(bare.with_effects(effect))))) / scale
        causes.append(MagneticCause(effect, tuple(rivals), cause.p_value, second - first, before, after, largest))
    return MagneticDiagnosis(tuple(causes), selection.p_value, refused)


def _askable(windows: FieldWindows, triad) -> tuple[list[type[Effect]], dict[str, str]]:
    """Return the effects of a magnetometer that can be asked, and why others cannot."""
    path, fitted = windows.path, {effect.name for effect in triad.effects}
    inputs = {"temperature": (path.temperature, _LEAST_WARMING), "current": (path.current, _LEAST_CURRENT),
              "angular_rate": (path.rate, 0.0)}  # fmt: skip
    asked, refused = [], {}
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
            asked.append(kind)
    return asked, refused


def _extent(windows: FieldWindows) -> Extent:
    edges = windows.time[1:, 0]
    warm = windows.path.temperature
    span = 0.0 if warm is None else float(np.ptp(np.asarray(warm)))
    return Extent(float(np.ptp(windows.time)), tuple(edges[:: -(-len(edges) // _PLACES)].tolist()), span)


def _touched(windows: FieldWindows) -> NDArray[np.int64]:
    """The first and last window (rows, 2) that each condition involves, padding included."""
    each = np.arange(len(windows))
    single = np.stack([each, each], axis=1)
    if windows.alone:
        return single
    pairs = np.repeat(np.stack([each, (each + 1) % len(windows)], axis=1), 2, axis=0)
    return np.concatenate([single, pairs, single])


def _left_out(
    weights: FloatArray, columns: FloatArray, residual: FloatArray, touched: NDArray[np.int64],
    strength: NDArray[np.int64],
) -> tuple[float, float]:  # fmt: skip
    """Return log-likelihood and rms error of the strength (µT) of fifths, each predicted from all the rest."""
    folds = np.array_split(np.arange(int(touched.max()) + 1), _FOLDS)
    parts = [np.isin(touched, fold).any(axis=1) for fold in folds]
    likelihood, errors = 0.0, np.zeros(len(residual))
    size = 1 / np.linalg.norm(weights, axis=0)  # rows are in µT and sines: what is blind is told in units of their own
    for part in leave_out(weights * size, columns, residual, parts):
        likelihood += 0.5 * float(np.sum(np.log(part.precisions)) - part.chi_squared)
        errors[part.rows] = size[part.rows] * part.errors
    return likelihood, float(np.sqrt(np.mean(errors[strength] ** 2)))
