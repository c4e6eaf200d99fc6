"""From recordings at rest over temperature to a calibration whose biases know the temperature.

The way: `rest_blocks` makes means over blocks of time, `ThermalShapes` what every effect would add to them. Noise that
is not known is what no function of temperature explains (`own_noise`), and blocks are parted where what is left jumps.
`identifiable` says which effects the path of temperature tells apart. `fit_triad` tries families of terms on the
whitened blocks, chooses for each axis by what `leave_out` says of ways left out, and gives the choice to the one `fit`.
Effects and covariance then join the unit, the data sheet's or that of a calibration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

from jaximu.calibration.calibration import Calibration, provenance
from jaximu.calibration.identifiability import Identifiability, identifiable
from jaximu.calibration.nominal import nominal_imu
from jaximu.calibration.thermal_linear import Whitened
from jaximu.calibration.thermal_selection import richest
from jaximu.calibration.thermal_shapes import ThermalShapes
from jaximu.calibration.thermal_terms import BESIDE, HISTORY, LEARNED, NETWORK, POWERS, RATES, SCALE
from jaximu.calibration.thermal_triad import TriadFit, fit_triad
from jaximu.data.rest import mean_terms, padded_count
from jaximu.data.rest_blocks import RATE_BANDWIDTH, WAYS, RestBlocks, own_noise, rest_blocks
from jaximu.estimation.fitting import effect_numbers
from jaximu.estimation.problem import Name
from jaximu.estimation.solver import Failure
from jaximu.estimation.track import TEMPERATURE_WINDOW, Track
from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.ground.document import SOFTWARE, Document, Json, entries
from jaximu.ground.errors import InputError
from jaximu.ground.gravity import STANDARD
from jaximu.ground.page import Result
from jaximu.ground.precision import require_float64
from jaximu.ground.quantities import listed, size
from jaximu.ground.tracing import on_host
from jaximu.ground.units import PREFIXES, SENSOR_UNITS
from jaximu.ground.vectors import root_or_zero, submatrix
from jaximu.model.effects import Effect
from jaximu.model.noise_model import NoiseModel
from jaximu.model.stimulus import REFERENCE_TEMPERATURE, Stimulus
from jaximu.noise.at_rest import noise_of
from jaximu.recordings.recording import Recording, Signal

SCHEMA = "jaximu.thermal/1"
THERMAL = (*POWERS, *RATES, *HISTORY, *BESIDE, LEARNED, NETWORK, SCALE)
_GRID = 41
_LONG = 1e6  # s that a steady way has lasted
_BESIDE, _FEWEST = 4, 40  # blocks on each side of a jump; edges from which on jumps are sought
_JUMP = 10.0  # times the standard deviation of such changes; another axis beside it jumps from half as much on
_SHARP = 0.75  # share of the change that two blocks must see of it
_MOST_JUMPS = 8
_MISFIT = 1.5
"""χ² per degree of freedom from which on a model is said not to explain the recordings to their noise."""


@dataclass(frozen=True, repr=False, eq=False)
class ThermalCalibration(Result, Document, page="thermal"):
    """A unit whose bias depends on temperature: the calibration, and the working behind it.

    reference: °C at which the effects count as zero. fits: by triad. identifiability: what the path of temperature can
    tell, found before any fit. noise: of the blocks.
    """

    calibration: Calibration
    blocks: RestBlocks
    noise: NoiseModel
    identifiability: Identifiability
    fits: dict[str, TriadFit]
    reference: float
    notes: tuple[str, ...] = ()
    jumps: tuple[tuple[int, float], ...] = ()  # recording, and time on its clock, s
    software: dict[str, str] = field(default_factory=SOFTWARE.copy)

    def bias(self, triad: str, temperature: FloatArray, rate: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Return the change of bias (m, 3) from the reference temperature to temperatures (m,) °C, and its sigma, SI.

        At a temperature that has long been what it is, or (`rate`, K/s) with what the rate terms add.
        """
        scale = getattr(self.blocks.recordings[0], triad).nominal_scale
        value, sigma = change(self.calibration, triad, THERMAL, temperature, rate=rate)
        return value / scale, sigma / scale

    def document(self) -> Json:
        """Return everything as the JSON document of schema `jaximu.thermal/1`."""
        grid = np.linspace(*self.blocks.range, _GRID)

        def triad(name: str, fit: TriadFit) -> Json:
            value, sigma = self.bias(name, grid)
            return {
                "unit": SENSOR_UNITS[name],
                "model": fit.candidate.family,
                "model_by_axis": list(fit.families),
                "effects": fit.candidate.effects(name),
                "inner": {
                    f"{PREFIXES[name]}.{effect}.{key}": {"value": value, "sigma": spread}
                    for (effect, key), (value, spread) in fit.inner.items()
                },
                "rms": entries(fit, "before", "after"),
                "heldout_rms": {"before": fit.held_before.rms.tolist(), "after": fit.candidate.held.rms.tolist()},
                "chi_squared_per_freedom": fit.chi_squared.tolist(),
                "candidates": [
                    {
                        "family": candidate.family,
                        "effects": candidate.effects(name),
                        "terms": len(candidate.terms),
                        "heldout_rms": candidate.held.rms.tolist(),
                        "heldout_loglik": candidate.held.log_likelihood,
                        "criterion": float(candidate.costs.sum()),
                        "score": candidate.score,
                        "score_by_axis": candidate.scores.tolist(),
                    }
                    for candidate in fit.candidates
                ],
                "bias_over_temperature": {
                    "temperature": grid.tolist(),
                    "value": value.tolist(),
                    "sigma": sigma.tolist(),
                },
            }

        return {
            "schema": SCHEMA,
            **_ranges(self.blocks),
            "temperature_reference": self.reference,
            "block": self.blocks.duration,
            "rate_window": TEMPERATURE_WINDOW,
            "rate_bandwidth": RATE_BANDWIDTH,
            "legs": [
                entries(leg, "begin", "end", "rate") | {"blocks": len(leg.blocks)} for leg in self.identifiability.legs
            ],
            "told": list(self.identifiability.told),
            "separable": {
                name: {"from_temperature": part.alone, "from_all": part.apart}
                for name, part in self.identifiability.parts.items()
            },
            "words": list(self.identifiability.words),
            **{name: triad(name, fit) for name, fit in self.fits.items()},
            "notes": list(self.notes),
            "calibration": self.calibration.document(),
            "software": self.software,
        }


def calibrate_thermal(
    recordings: Recording | Sequence[Recording],
    *,
    static: Recording | NoiseModel | None = None,
    base: Calibration | None = None,
    block: float | None = None,
    families: Sequence[str] | None = None,
) -> ThermalCalibration:
    """Fit what a unit's outputs at rest do over temperature, and choose the model that pays on ramps left out.

    **Arguments:**

    - `recordings`: one or several recordings of one unit at rest in one or a few poses while the temperature changes.
    - `static`: a recording at rest at one temperature, or the `NoiseModel` fitted to one; else the noise is told by
      what no function of temperature explains.
    - `base`: a calibration of the unit at one temperature, to which the thermal part is added; without it gain (and the
      accelerometer's bias, which one pose does not tell from gravity) stay at the data sheet's.
    - `block`: s, see [`jaximu.data.rest_blocks.rest_blocks`].
    - `families`: of models to choose among, such as `("constant",)`; all that the recordings can tell if None.

    Raises `NotPossibleError` where the recordings cannot tell anything of temperature, `InputError` where columns are
    not in their stated units or `base` is another unit's.
    """
    require_float64()
    blocks = rest_blocks(recordings, block)
    reference = _reference(blocks, base)
    known = noise_of(static)
    missing = [] if known is None else [name for name in blocks.means if getattr(known, name) is None]
    if missing:
        raise InputError(f"the recording at rest has no {missing[0]}, whose noise is needed.")
    shapes = ThermalShapes(blocks, reference)
    noise, residuals = _noise(blocks, shapes, known)
    edges, whole = _jumps(blocks, residuals), blocks
    if edges:  # what comes after a jump has a level of its own
        blocks = blocks.parted(edges)
        shapes = ThermalShapes(blocks, reference, shapes)
        noise, _ = _noise(blocks, shapes, known)
    identifiability = identifiable(blocks, shapes)

    def fitted(noise: NoiseModel) -> dict[str, TriadFit]:
        return {
            name: fit_triad(Whitened(blocks, name, noise, shapes), identifiability, families) for name in blocks.means
        }

    fits = fitted(noise)
    nets = [shapes.column(term) for fit in fits.values() for term in fit.candidate.terms if term.net is not None]
    if nets and known is None:  # what a network follows passed for slow noise
        noise = own_noise(blocks, np.concatenate([shapes.generous().T, *nets]).T)
        fits = fitted(noise)
    fits = {name: _from_reference(fit, blocks.recordings[0].signals[name], reference) for name, fit in fits.items()}
    calibration, notes = _calibration(blocks, fits, base, reference)
    notes = [*blocks.notes, *noise.notes, *notes]
    for name, fit in fits.items():
        notes += _notes(name, fit, "stretches" if len(identifiability.legs) < WAYS else "ways")
    notes = tuple(dict.fromkeys((*notes, *_told_jumps(whole, fits, edges))))
    times = tuple((int(blocks.log[edge]), float(blocks.start[edge])) for edge in edges)
    calibration = replace(calibration, notes=notes)
    return ThermalCalibration(calibration, blocks, noise, identifiability, fits, reference, notes, times)


def _reference(blocks: RestBlocks, base: Calibration | None) -> float:
    """Return the °C from which effects count: the calibration's, if it is of this unit, or one of the recordings'."""
    if base is None:
        low, high = blocks.range
        return REFERENCE_TEMPERATURE if low <= REFERENCE_TEMPERATURE <= high else float(np.round((low + high) / 2))
    if base.imu.gyroscope is None and "gyroscope" in blocks.means:
        raise InputError("the calibration has no gyroscope, but the recording has one.")
    for name in base.triads().keys() & blocks.means:
        base.triad_of(name, blocks.recordings[0])
    return base.imu.accelerometer.temperature_reference


def _notes(name: str, fit: TriadFit, parts: str) -> list[str]:
    """Say where a triad's model is to be taken with care; `parts`: what was left out in turn."""
    notes = []
    if NETWORK in fit.candidate.names:
        notes.append(
            f"the {name}'s model is a neural network, whose 95 % band holds a network's uncertainty only: where "
            "the truth is another curve it covers less, about four fifths in simulations. Check it on another ramp."
        )
    if (worst := float(fit.chi_squared.max())) > _MISFIT:
        notes.append(
            f"the {name}'s residuals are {np.sqrt(worst):.2g} times what the noise explains: something depends on "
            "more than this model has (a field of temperatures in the device, tilt, another cause); intervals are "
            "widened by as much."
        )
    if plain := ["xyz"[axis] for axis, family in enumerate(fit.families) if family == "constant"]:
        notes.append(
            f"the {name}'s {', '.join(plain)} output is left as it is: no model of temperature corrects it on {parts} "
            "left out."
        )
    return notes


def _ranges(blocks: RestBlocks) -> dict[str, list[float]]:
    return {
        "temperature_range": list(blocks.range),
        "temperature_rate_range": [float(blocks.rate.min()), float(blocks.rate.max())],
    }


def _noise(
    blocks: RestBlocks, shapes: ThermalShapes, known: NoiseModel | None
) -> tuple[NoiseModel, dict[str, FloatArray]]:
    """Return the noise, and by triad what the richest model leaves of the blocks (n, 3), SI.

    Noise that is not known is what no function of temperature explains; it is estimated again with lag and hysteresis
    taken off as they are.
    """
    identifiability, columns = identifiable(blocks, shapes), [shapes.generous().T]
    noise = own_noise(blocks, columns[0].T) if known is None else known
    residuals = {}
    for name in blocks.means:
        data = Whitened(blocks, name, noise, shapes)
        model = richest(data, identifiability)[0]
        columns += [shapes.column(term) for term in model[0] if term.name in (*HISTORY, SCALE)]
        white = np.stack([data.residual(axis, terms) for axis, terms in enumerate(model)])
        residuals[name] = np.linalg.solve(data.root, white[:, :, None])[:, :, 0].T
    return own_noise(blocks, np.concatenate(columns).T) if known is None else noise, residuals


def _jumps(blocks: RestBlocks, residuals: dict[str, FloatArray]) -> list[int]:
    """Return the blocks before which what a model leaves jumps inside a rest, by far more than elsewhere.

    **Arguments:** `residuals`: by triad (n, 3), SI.
    """
    jumps: list[int] = []
    for residual in residuals.values():
        edges, change, usual = _changes(blocks, residual)
        if len(edges) < _FEWEST:
            return []
        times = abs(change) / usual
        # a jump is over within two blocks; what takes longer is a lag that was not in equilibrium
        near = [abs(residual[edges + b] - residual[edges + a]) for a, b in ((-1, 0), (-1, 1), (-2, 0))]
        times[np.max(near, axis=0) < _SHARP * abs(change)] = 0.0
        while len(jumps) < _MOST_JUMPS and times.max() > _JUMP:
            block = int(edges[int(times.max(axis=1).argmax())])
            jumps.append(block)
            times[abs(edges - block) < 2 * _BESIDE] = 0.0
    jumps.sort()
    return [after for before, after in pairwise([-2 * _BESIDE, *jumps]) if after - before >= 2 * _BESIDE]


def _changes(blocks: RestBlocks, values: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the blocks (k,) inside rests, how values (n, 3) change before each, and a usual change of an axis (3,)."""
    edges = np.arange(_BESIDE, len(blocks) - _BESIDE + 1)
    edges = edges[blocks.level[edges - _BESIDE] == blocks.level[edges + _BESIDE - 1]]
    if not len(edges):
        return edges, np.zeros((0, 3)), np.ones(3)
    around = edges[:, None] + np.arange(_BESIDE)
    change = np.median(values[around], axis=1) - np.median(values[around - _BESIDE], axis=1)
    usual = np.maximum(np.median(abs(change), axis=0) / 0.6745, 0.05 * change.std(axis=0))  # coarse steps
    return edges, change, np.maximum(usual, 1e-300)


def _told_jumps(blocks: RestBlocks, fits: Mapping[str, TriadFit], jumps: Sequence[int]) -> list[str]:
    """Say by how much outputs jump before some blocks, with what temperature adds taken off as it was fitted beside."""
    notes = []
    for name, fit in fits.items():
        edges, change, usual = _changes(blocks, blocks.means[name] - fit.fitted)
        for block in jumps:
            by_axis = change[edges.searchsorted(block)]
            times = abs(by_axis) / usual
            axes = np.flatnonzero(times > _JUMP / 2)
            if len(axes):
                by = [f"{size(float(by_axis[axis]), SENSOR_UNITS[name], 2)} ({'xyz'[axis]})" for axis in axes]
                notes.append(
                    f"the {name}'s output jumps by {listed(by)} at "
                    f"{blocks.start[block]:.0f} s, {blocks.temperature[block]:.1f} °C, {times.max():.0f} times the "
                    "usual change: a knock, or a part that gave way. It was kept apart from temperature: what comes "
                    "after has its own bias. `compensate` leaves the jump in."
                )
    return notes


def _from_reference(fit: TriadFit, signal: Signal, reference: float) -> TriadFit:
    """Count levels and what temperature adds from the reference temperature: a learned curve need not be zero there."""
    there = steady(fit.effects, reference, 0.0, reference)[0][0] / signal.nominal_scale
    return replace(fit, level=fit.level + there[:, None], fitted=fit.fitted - there)


def _calibration(
    blocks: RestBlocks, fits: dict[str, TriadFit], base: Calibration | None, reference: float
) -> tuple[Calibration, list[str]]:
    """Put the fitted terms into a unit: the base calibration's, or the data sheet's."""
    recording, notes = blocks.recordings[0], []
    unit = nominal_imu(recording) if base is None else base.imu
    names, covariance = ([], np.zeros((0, 0))) if base is None else _kept_numbers(base, fits)
    covariances = [covariance]
    triads: dict[str, Any] = {}
    for name, fit in fits.items():
        triad, of_fit = unit.triad(name), base is None and name == "gyroscope"  # its bias is that of the fit
        kept = tuple(effect for effect in triad.effects if effect.plain not in THERMAL)
        bias, temperature = fit.fit.imu.triad(name).bias, reference
        if not of_fit:
            if base is not None and len(kept) == len(triad.effects):
                temperature = float(base.data.get("temperature", reference))
                if "temperature" not in base.data:
                    notes.append(
                        "the calibration does not say at which temperature its biases hold: "
                        f"{reference:g} °C is assumed."
                    )
            bias = triad.bias - steady(fit.effects, temperature, 0.0, reference)[0][0]
        triads[name] = replace(triad, bias=bias, effects=(*kept, *fit.effects), temperature_reference=reference)
        numbers, covariance = _numbers(fit, of_fit, recording.signals[name], blocks.levels)
        names += [
            number if number.effect is None else Name(name, number.part, number.axes, len(kept) + number.effect)
            for number in numbers
        ]
        covariances.append(covariance)
    if base is None:
        triads.setdefault("gyroscope", None)
        notes.append(
            "gain and the accelerometer's bias are the data sheet's: a recording at rest does not determine them. "
            "--calibration CALIBRATION adds the thermal part to a calibration of the unit."
        )
    norms = {
        name: (float(np.linalg.norm(fit.before)), float(np.linalg.norm(fit.after)), SENSOR_UNITS[name])
        for name, fit in fits.items()
    }
    ended = [fit.fit.failure() for fit in fits.values() if NETWORK not in fit.candidate.names]  # they are solved before
    return Calibration(
        imu=on_host(replace(unit, **triads)),
        names=tuple(names),
        covariance=scipy.linalg.block_diag(*covariances),
        gravity=STANDARD if base is None else base.gravity,
        method="thermal",
        loss="linear",
        rms=norms if base is None else base.rms | norms,
        rank=len(names),
        weak=() if base is None else base.weak,
        excess={name: float(fit.fit.excess.max()) for name, fit in fits.items()},
        solver=next((failure for failure in ended if failure is not Failure.NONE), Failure.NONE).value,
        data=_data(blocks, base),
        reading=recording.reading if base is None or base.reading is None else base.reading,
    ), notes


def _data(blocks: RestBlocks, base: Calibration | None) -> Json:
    """Return where a calibration comes from, as `Calibration.data` has it."""
    signals = blocks.recordings[0].signals
    data = provenance(blocks.recordings) | {
        "nominal_offset": {name: signals[name].nominal_offset.tolist() for name in blocks.means},
        "poses": blocks.levels,
        "turns": 0,
        "blocks": len(blocks),
        **_ranges(blocks),
    }
    if base is not None:
        data["base"] = {key: base.data[key] for key in ("file", "sha256", "temperature") if key in base.data}
    return data


def _kept_numbers(base: Calibration, fits: Mapping[str, TriadFit]) -> tuple[list[Name], FloatArray]:
    """Return the numbers of a calibration that thermal fits do not replace, and their covariance.

    Effects that stay move up to where those before them are gone.
    """
    places: dict[tuple[str, int | None], int] = {
        (owner, index): position
        for owner, triad in base.imu.triads().items()
        for position, index in enumerate(k for k, effect in enumerate(triad.effects) if effect.plain not in THERMAL)
    }

    def fixed(name: Name) -> bool:
        return name.owner not in fits or name.effect is None

    rest = base.of_numbers(lambda name: fixed(name) or name.key in places)
    names = [name if fixed(name) else Name(name.owner, name.part, name.axes, places[name.key]) for name in rest.names]
    return names, rest.covariance


def _numbers(fit: TriadFit, with_bias: bool, signal: Signal, levels: int) -> tuple[list[Name], FloatArray]:
    """Return a triad's numbers that are known with its fit, and their covariance, output units.

    A coefficient that its axis does without is zero, and known to be. The rests of a gyroscope (`with_bias`) are off
    by what their `levels` differ by.
    """
    fitted = {name: row for row, name in enumerate(fit.fit.names) if with_bias or name.part != "bias"}
    coefficients = [name for name in effect_numbers(fit.fit.imu)[0] if name in fitted or name.part == "coefficients"]
    names = list(dict.fromkeys((*coefficients, *fitted)))
    covariance = submatrix(np.pad(fit.fit.covariance, (0, 1)), [fitted.get(name, -1) for name in names])
    if with_bias and levels > 1:
        covariance[-3:, -3:] += np.diag(fit.level.var(axis=1, ddof=1) * signal.nominal_scale**2 / levels)
    return names, covariance


def steady_change(calibration: Calibration, name: str, celsius: FloatArray) -> FloatArray:
    """Return what steady temperatures (m,) °C add to a triad's bias, (m, 3), SI: the calibration's `bias` left out."""
    triad = calibration.triads()[name]
    scale = triad.scales if triad.output_unit == "count" else np.ones(3)
    effects = [effect for effect in triad.effects if effect.plain in THERMAL]
    return steady(effects, celsius, 0.0, triad.temperature_reference)[0] / scale


def change(
    calibration: Calibration,
    owner: str,
    names: Sequence[str],
    celsius: FloatArray,
    *,
    rate: float = 0.0,
    force: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Return what a triad's effects of these plain names add (m, 3) from the reference temperature on, and its sigma.

    In output units, at steady temperatures (m,), °C, with what a `rate` of it, K/s, adds. `force`: m/s² along each axis
    of an accelerometer, or as many rad/s about a gyroscope's.
    """
    triad = calibration.triads()[owner]
    rows = [row for row, effect in enumerate(triad.effects) if effect.plain in names]
    effects, reference = [triad.effects[row] for row in rows], triad.temperature_reference
    values, slopes = steady(effects, celsius, rate, reference, force)
    origin, origin_slopes = steady(effects, reference, 0.0, reference, force)
    alone = effect_numbers(calibration.imu.with_effects(*effects))[0]
    numbers = [Name(owner, name.part, name.axes, rows[name.effect]) for name in alone if name.effect is not None]
    slopes -= origin_slopes
    variance = np.einsum("mak,kl,mal->ma", slopes, calibration.covariance_of(numbers), slopes)
    return values - origin, root_or_zero(variance)


def steady(
    effects: Sequence[Effect], celsius: ArrayLike, rate: float, reference: float, force: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Return what effects add (m, 3) at temperatures (m,), °C, and its slopes (m, 3, q) by their numbers.

    Output units. **Arguments:** `rate`: K/s at which the temperature has long been going, or 0 where it has long been
    what it is; `reference`: °C from which effects count; `force`: along each axis.
    """
    celsius = np.atleast_1d(np.asarray(celsius, float))
    count = len(celsius)
    ends = np.pad(celsius, (0, padded_count(count) - count), "edge")
    time = np.broadcast_to([-_LONG, 0.0], (len(ends), 2))
    stimulus = Stimulus(
        specific_force=np.full((len(ends), 2, 3), force),
        temperature=ends[:, None] + rate * time,
        temperature_rate=np.full((len(ends), 2), rate),
        time=time,
        temperature_reference=reference,
    )
    now = np.minimum(np.arange(len(ends)), count)
    return mean_terms(effects, [Track(stimulus, np.column_stack([np.full(len(ends), count), now]))], count)
