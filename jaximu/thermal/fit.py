"""Bias over temperature by generalised least squares: which terms a recording can tell, which pay on ramps left out.

At rest each axis's output is a level (bias, and for an accelerometer gravity) for each rest, plus coefficients times
shapes that the thermal effects of the catalogue take along the temperature's path. All axes share the shapes; noise
ties blocks to each other, and is whitened by its covariance, so that slow bias does not pass for temperature and a long
soak counts for no more than it tells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaximu import stored
from jaximu.effects import CATALOGUE, Effect
from jaximu.effects.learned import SHAPES, ZERO_CELSIUS, AccelLearnedTemperature
from jaximu.effects.network import UNITS, WEIGHTS
from jaximu.noise.model import NoiseModel
from jaximu.sensor import Stimulus
from jaximu.thermal import network
from jaximu.thermal.network import Net
from jaximu.thermal.rest import Leg, RestBlocks

__all__ = [
    "Candidate",
    "Held",
    "Identifiability",
    "Term",
    "TriadFit",
    "Whitened",
    "fit_triad",
    "identifiable",
    "shapes_of",
]

FloatArray = NDArray[np.float64]
POWERS = ("temperature", "temperature_squared", "temperature_cubed")
RATES = ("temperature_rate", "temperature_rate_squared", "temperature_times_rate")
HISTORY = {"thermal_lag": "time_constant", "thermal_hysteresis": "half_width"}
LEARNED = "learned_temperature"
SPLINES = len(SHAPES) - 1
SCALE = "scale_temperature"
NETWORK = "learned_network"
CUBIC = "cubic"
_GRID = 12  # values of an inner parameter tried at once
_BUCKET = 8192
_TOLD = 0.05
"""Share of a shape that smooth functions of temperature must leave of it."""
_OVERLAP, _OTHER_RATE = 0.5, 0.2
"""Share of the range that two legs must have in common, and by which their rates must differ, to tell rates apart."""
_PAYS = 3.0
"""Nats that a more complicated model must gain."""
_FOLDS = 8
_ROUNDS, _POLISH = 3, 10


class Term(NamedTuple):
    """A column group of the fit: a catalogue effect without its prefix, inner parameters, and which of its shapes."""

    name: str
    inner: tuple[tuple[str, float], ...] = ()
    shape: int | None = None  # of the learned curve, or the weight of the network
    net: Net | None = None  # about which the network is linear


@dataclass(frozen=True)
class Held:
    """Errors on stretches left out in turn: rms by axis (3,), SI, log-likelihood in nats, χ² per block and axis."""

    rms: FloatArray
    log_likelihood: float
    chi_squared: float


@dataclass(frozen=True)
class Candidate:
    """A model that was tried: its family, terms, information criterion and how it did on what was left out.

    parameters: how many numbers of the three axes the data determine.
    """

    family: str
    terms: tuple[Term, ...]
    parameters: float
    criterion: float
    held: Held

    @property
    def score(self) -> float:
        """What models are compared by, nats: log-likelihood on what was left out, and in sample less the penalty."""
        return self.held.log_likelihood - self.criterion / 2

    @property
    def names(self) -> tuple[str, ...]:
        """The effects in it, without prefix."""
        return tuple(dict.fromkeys(term.name for term in self.terms))


@dataclass(frozen=True)
class Identifiability:
    """What a path of temperature can tell apart.

    left: by effect, the share of its shape that levels and smooth functions of temperature leave. told: effects that
    can be fitted. words: sentences. legs: the ways of the temperature.
    """

    left: dict[str, float]
    told: tuple[str, ...]
    words: tuple[str, ...]
    legs: tuple[Leg, ...]


@dataclass(frozen=True)
class TriadFit:
    """The chosen model of a triad, in SI.

    coefficients (3, k): by axis and term; level (3, L): by axis and rest, at the reference temperature. covariance:
    (3 (L + k) + i) of levels and coefficients, axis by axis, then the inner parameters, widened by `excess` where the
    residuals exceed the noise. residual (n, 3): of the blocks. before, after (3,): rms about the levels.
    """

    candidate: Candidate
    candidates: tuple[Candidate, ...]
    terms: tuple[Term, ...]
    coefficients: FloatArray
    level: FloatArray
    inner: dict[tuple[str, str], tuple[float, float]]  # (effect, name): value, sigma
    covariance: FloatArray
    residual: FloatArray
    fitted: FloatArray  # (n, 3): what temperature adds to each block
    before: FloatArray
    after: FloatArray
    excess: FloatArray  # (3,)
    chi_squared: FloatArray  # (3,) per degree of freedom
    held_before: Held = field(repr=False)


# --- shapes -----------------------------------------------------------------------------------------------------------


class _Path(NamedTuple):
    stimulus: Stimulus
    place: NDArray[np.int64]


def _paths(blocks: RestBlocks, reference: float) -> list[_Path]:
    found = []
    for time, kelvin, rate, place in blocks.paths:
        missing = -len(time) % _BUCKET
        step = float(time[1] - time[0])
        later = np.concatenate([time, time[-1] + step * np.arange(1, missing + 1)])
        stimulus = Stimulus(
            temperature=np.pad(kelvin - reference, (0, missing), "edge"),  # pyright: ignore[reportArgumentType]
            temperature_rate=np.pad(rate, (0, missing)),  # pyright: ignore[reportArgumentType]
            time=later,  # pyright: ignore[reportArgumentType]
            temperature_reference=0.0,  # whatever it is: one compiled function
        )
        found.append(_Path(stimulus, np.pad(place, (0, missing), constant_values=len(blocks))))
    return found


def _shapes(stimulus: Stimulus, place, lags, widths, span, reference, counter):
    """Mean shapes over the blocks: (n, 6) powers and rates, (n, 9) of the curve, (n, G) lags, (n, G) plays."""
    count = len(counter)

    def means(values):
        number = jax.ops.segment_sum(jnp.ones(len(place)), place, count)
        return jax.ops.segment_sum(values, place, count) / jnp.maximum(number, 1.0)[:, None]

    def shape(name, **inner):
        kind = CATALOGUE[f"accel.{name}"]
        return kind(jnp.ones(kind.size), **inner).term(stimulus)[:, 0]

    plain = jnp.stack([shape(name) for name in (*POWERS, *RATES)], axis=1)
    curve = AccelLearnedTemperature(jnp.zeros(3 * SPLINES), low=span[0], high=span[1])
    absolute = reference + ZERO_CELSIUS
    curves = curve.shapes(stimulus.temperature + absolute) - curve.shapes(absolute)
    lagged = jax.lax.map(lambda value: shape("thermal_lag", time_constant=value), lags).T
    played = jax.lax.map(lambda value: shape("thermal_hysteresis", half_width=value), widths).T
    return tuple(means(each) for each in (plain, curves, lagged, played))


class shapes_of:
    """The shapes of all thermal effects over the blocks of a recording.

    **Arguments:** `reference`: °C from which they count; `like`: shapes whose inner parameters are tried here, too.
    """

    def __init__(self, blocks: RestBlocks, reference: float, like: shapes_of | None = None):
        self.blocks, self.reference = blocks, reference
        self._paths = _paths(blocks, reference)
        low, high = (float(bound) for bound in blocks.range)
        self.span = np.array([low, high]) + ZERO_CELSIUS
        duration = max(float(np.ptp(path[0])) for path in blocks.paths)
        self.lags = np.geomspace(max(blocks.duration, 0.002 * duration), 0.7 * duration, _GRID)
        self.widths = np.geomspace(0.02, 0.45, _GRID) * (high - low)
        if like is not None:
            self.lags, self.widths = like.lags, like.widths
        self._plain, self._curves, lagged, played = self._computed(self.lags, self.widths)
        level = blocks.level
        poses = np.stack([blocks.means["accelerometer"][level == k].mean(axis=0) for k in range(blocks.levels)])
        self.force = poses[level]  # (n, 3): gravity along each axis, near enough for what changes it by a share
        self.reach = float(np.max(np.abs(blocks.rate)))
        self.inputs, self.origin = self._scaled(blocks.temperature, blocks.rate), self._scaled(reference, 0.0)
        self._nets: dict[Net, tuple[FloatArray, FloatArray]] = {}
        self._history: dict[Term, FloatArray] = {}
        for name, grid, columns in (("thermal_lag", self.lags, lagged), ("thermal_hysteresis", self.widths, played)):
            for value, column in zip(grid, columns.T, strict=True):
                self._history[history(name, value)] = column

    def _computed(self, lags: FloatArray, widths: FloatArray) -> list[FloatArray]:
        count = len(self.blocks)
        counter = np.zeros(count + 1 + -(count + 1) % 1024)
        total: list[FloatArray] = []
        for stimulus, place in self._paths:
            found = stored.call(_shapes, "thermal shapes", stimulus, place, lags, widths, self.span,
                                np.asarray(self.reference), counter)  # fmt: skip
            parts = [np.asarray(each)[:count] for each in found]
            total = parts if not total else [a + b for a, b in zip(total, parts, strict=True)]
        return total

    def _scaled(self, kelvin, rate) -> FloatArray:
        """Return a network's inputs (..., 2) at temperatures (...), °C, and rates, K/s."""
        low, high = self.span - ZERO_CELSIUS
        both = np.broadcast_arrays((2 * np.asarray(kelvin) - low - high) / (high - low), rate / max(self.reach, 1e-12))
        return np.clip(np.stack(both, axis=-1), -1.0, 1.0)

    def network(self, net: Net) -> tuple[FloatArray, FloatArray]:
        """Return a network's outputs (3, n) over the blocks and their derivatives (3, n, 16) by its weights."""
        if net not in self._nets:
            self._nets[net] = network.values(net, self.inputs, self.origin)
        return self._nets[net]

    def offset(self, terms: Sequence[Term], place: tuple[FloatArray, float] | None = None) -> FloatArray:
        """Return what a network linearised among the terms is beside weights times shapes, (3, n), SI.

        Over the blocks, or at a place: temperatures (m,), °C, and a rate, K/s.
        """
        net = next((term.net for term in terms if term.net is not None), None)
        if net is None:
            return np.zeros((3, 1))
        value, slope = self.network(net) if place is None else network.values(net, self._scaled(*place), self.origin)
        return value - np.einsum("ank,ak->an", slope, np.reshape(net.weights, (3, WEIGHTS)))

    def prepare(self, name: str, values: FloatArray) -> list[Term]:
        """Return terms of an effect with memory at values (12,) of its inner parameter."""
        grids = {"thermal_lag": self.lags, "thermal_hysteresis": self.widths} | {name: values}
        found = self._computed(grids["thermal_lag"], grids["thermal_hysteresis"])
        columns = found[2] if name == "thermal_lag" else found[3]
        terms = [history(name, value) for value in values]
        self._history |= dict(zip(terms, columns.T, strict=True))
        return terms

    def column(self, term: Term) -> FloatArray:
        """Return the shape (n,) of a term; of one that is not the same for all axes, (3, n)."""
        if term.name == SCALE:
            return self._plain[:, 0] * self.force.T
        if term.net is not None:
            return self.network(term.net)[1][:, :, term.shape]
        if term.name == LEARNED:
            assert term.shape is not None
            return self._curves[:, term.shape]
        if term.name in HISTORY:
            if term not in self._history:
                value = term.inner[0][1]
                self.prepare(term.name, np.full(_GRID, value))
            return self._history[term]
        return self._plain[:, (*POWERS, *RATES).index(term.name)]

    def smooth(self) -> FloatArray:
        """Return what a smooth function of temperature may be (n, 9)."""
        return self._curves

    def generous(self) -> FloatArray:
        """Return what temperature may plausibly do (n, 15), to tell noise from it.

        Not more: over a cycle or two some thirty shapes would swallow all slow noise there is.
        """
        few = [history("thermal_lag", self.lags[k]) for k in (_GRID // 3, 2 * _GRID // 3)]
        few.append(history("thermal_hysteresis", self.widths[_GRID // 2]))
        rates = self._plain[:, len(POWERS) :]
        return np.column_stack([self._curves, rates, *(self._history[term] for term in few)])

    def steady(self, term: Term, kelvin: FloatArray, rate: float = 0.0) -> FloatArray:
        """Return the shape (m,) or (3, m) of a term on a steady way of `rate`, K/s, at temperatures (m,), °C."""
        warmth = kelvin - self.reference
        if term.net is not None:
            return network.values(term.net, self._scaled(kelvin, rate), self.origin)[1][:, :, term.shape]
        if term.name in POWERS:
            return warmth ** (1 + POWERS.index(term.name))
        if term.name in RATES:
            return (rate, rate**2, rate * warmth)[RATES.index(term.name)] + np.zeros_like(kelvin)
        if term.name == SCALE:  # no force: what is left is bias
            return np.zeros_like(kelvin)
        if term.name in HISTORY:
            return warmth - (rate * term.inner[0][1] if term.name == "thermal_lag" else 0.0)
        assert term.shape is not None
        curve = AccelLearnedTemperature(np.zeros(3 * SPLINES), low=self.span[0], high=self.span[1])
        both = np.concatenate([kelvin, [self.reference]]) + ZERO_CELSIUS
        shapes = np.asarray(curve.shapes(both))  # pyright: ignore[reportAttributeAccessIssue]
        return (shapes[:-1] - shapes[-1])[:, term.shape]


def history(name: str, value: float) -> Term:
    """Return the term of an effect with memory at a value of its inner parameter."""
    return Term(name, ((HISTORY[name], float(value)),))


# --- what can be told -------------------------------------------------------------------------------------------------


def identifiable(blocks: RestBlocks, shapes: shapes_of) -> Identifiability:
    """Say before any fit which thermal effects the path of temperature can tell from smooth functions of it."""
    legs = blocks.legs()
    low, high = blocks.range
    indicator = np.eye(blocks.levels)[blocks.level]
    base = np.linalg.qr(np.concatenate([indicator, shapes.smooth()], axis=1))[0]
    mean = np.linalg.qr(indicator)[0]

    def left(column: FloatArray) -> float:
        whole = np.linalg.norm(column - mean @ (mean.T @ column))
        return float(np.linalg.norm(column - base @ (base.T @ column)) / whole) if whole > 0 else 0.0

    shares = {name: left(shapes.column(Term(name))) for name in RATES}
    for name, grid in (("thermal_lag", shapes.lags), ("thermal_hysteresis", shapes.widths)):
        shares[name] = max(left(shapes.column(history(name, value))) for value in grid)
    shares["warm_up"] = max(left(np.exp(-blocks.start / tau)) for tau in shapes.lags[_GRID // 2 :])

    def beside(a: Leg, b: Leg) -> bool:
        common = min(max(a.begin, a.end), max(b.begin, b.end)) - max(min(a.begin, a.end), min(b.begin, b.end))
        return common > _OVERLAP * (high - low) and abs(a.rate - b.rate) > _OTHER_RATE * max(abs(a.rate), abs(b.rate))

    several = any(beside(a, b) for k, a in enumerate(legs) for b in legs[:k])
    both_ways = several and len({leg.up for leg in legs}) == 2
    quick = {round(float(np.log(max(abs(leg.rate), 1e-9))) / np.log(1.4)) for leg in legs}
    told = [*POWERS, LEARNED]
    words = [f"The temperature went {'; '.join(map(str, legs))}."]
    if several:
        told += [name for name in RATES if shares[name] > _TOLD]
        if both_ways:
            told += [name for name in HISTORY if shares[name] > _TOLD]
        if len(quick) < 2 and both_ways:
            words.append(
                "All ways were about as quick: a lag, a hysteresis and the rate of temperature look alike at one rate. "
                "A ramp at half or twice the rate would tell them apart."
            )
        if not both_ways:
            words.append(
                "The temperature only went one way: a lag and a hysteresis cannot be told from the rest. Come back the "
                "same way, too."
            )
    else:
        words.append(
            "Each temperature was passed once, at one rate: the rate of temperature, a lag, a hysteresis and the "
            "warm-up after power-on are functions of temperature in this recording, and nothing in it tells them from "
            "bias over temperature. What is fitted is their sum, and holds for this way and rate of change only. "
            "Record a cycle: the same range up and down, then again at another rate."
        )
    scale = shapes.column(Term(SCALE))
    shares[SCALE] = max(left(column) for column in scale)
    if blocks.levels > 1 and shares[SCALE] > _TOLD:
        told.append(SCALE)
    else:
        words.append(
            "What the accelerometer shows of temperature is bias and, along gravity, scale, and across it, "
            "tilt of the mounting: in one pose they stay unresolved. Poses with each axis up and down at the same "
            "temperatures would tell them apart."
        )
    return Identifiability(shares, tuple(told), tuple(words), tuple(legs))


# --- the fit ----------------------------------------------------------------------------------------------------------


class Whitened:
    """A triad's blocks, whitened by the covariance of its noise, the levels of the rests projected off."""

    def __init__(self, blocks: RestBlocks, name: str, noise: NoiseModel, shapes: shapes_of):
        own = getattr(noise, name)
        covariance = blocks.covariance(own)
        self.blocks, self.name, self.shapes, self.covariance = blocks, name, shapes, covariance
        self.means = blocks.means[name]
        self.root = np.linalg.inv(np.linalg.cholesky(covariance))  # (3, n, n)
        self.inverse = np.swapaxes(self.root, 1, 2) @ self.root
        indicator = np.eye(blocks.levels)[blocks.level]
        self.levels = self.root @ indicator
        self.output = np.einsum("aij,ja->ai", self.root, self.means)
        self._columns: dict[Term, FloatArray] = {}

    def column(self, term: Term) -> FloatArray:
        """Return the whitened shape (3, n) of a term."""
        if term not in self._columns:
            column = np.broadcast_to(self.shapes.column(term), (3, len(self.blocks)))
            self._columns[term] = np.einsum("aij,aj->ai", self.root, column)
        return self._columns[term]

    def design(self, terms: Sequence[Term]) -> FloatArray:
        """Return whitened levels and shapes (3, n + p, L + k): below the data a row for each weight known a priori."""
        data = np.concatenate([self.levels, *(self.column(term)[:, :, None] for term in terms)], axis=2)
        known = [(k, term) for k, term in enumerate(terms, self.blocks.levels) if term.net is not None]
        rows = np.zeros((3, len(known), data.shape[2]))
        for row, (k, term) in enumerate(known):
            assert term.net is not None and term.shape is not None
            rows[:, row, k] = 1 / np.reshape(term.net.prior, (3, WEIGHTS))[:, term.shape]
        return np.concatenate([data, rows], axis=1)

    def target(self, terms: Sequence[Term]) -> FloatArray:
        """Return what the design times levels and coefficients should be (3, n + p)."""
        known = sum(term.net is not None for term in terms)
        output = self.output
        if known:
            output = output - np.einsum("aij,aj->ai", self.root, self.shapes.offset(terms))
        return np.pad(output, ((0, 0), (0, known)))

    def misfit(self, terms: Sequence[Term]) -> float:
        """Return the sum of squares that least squares leaves, all axes together."""
        return float(np.sum(self.solve(terms)[1] ** 2))

    def solve(self, terms: Sequence[Term]) -> tuple[FloatArray, FloatArray]:
        """Return levels and coefficients (3, L + k) and whitened residuals (3, n)."""
        return self._solve(self.design(terms), self.target(terms))

    def solve_beside(self, terms: Sequence[Term], net: Net) -> tuple[FloatArray, FloatArray]:
        """Return the same of terms beside a network whose weights stay."""
        network = np.einsum("aij,aj->ai", self.root, self.shapes.network(net)[0])
        return self._solve(self.design(terms), self.output - network)

    def _solve(self, design: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
        size = np.linalg.norm(design, axis=1, keepdims=True)
        size = np.where(size > 0, size, 1.0)
        q, r = np.linalg.qr(design / size)
        product = np.swapaxes(q, 1, 2) @ target[:, :, None]
        solved = np.stack([np.linalg.lstsq(a, b, rcond=1e-10)[0] for a, b in zip(r, product, strict=True)])
        left = target - (q @ product)[..., 0]
        return solved[..., 0] / size[:, 0], left[:, : len(self.blocks)]

    def held_out(
        self, terms: Sequence[Term], folds: Sequence[NDArray[np.int64]], scale: float = 1.0,
        anew: Sequence[Sequence[Term]] | None = None,
    ) -> Held:  # fmt: skip
        """Predict each fold from all other blocks, noise that they share included.

        **Arguments:** `scale`: of the noise's variance; `anew`: for each fold the terms as fitted without it.
        """
        squared, likelihood, count = 0.0, 0.0, 0
        errors = np.full((3, len(self.blocks)), np.nan)
        parts = [(terms, folds)] if anew is None else [(own, [fold]) for own, fold in zip(anew, folds, strict=True)]
        for own, some in parts:
            for axis, fold, error, values, along, _ in self._predictions(own, some):
                errors[axis, fold] = error
                chi = float(np.sum(along**2 / values)) / scale
                squared += chi
                likelihood += 0.5 * (float(np.sum(np.log(values))) - chi - len(values) * np.log(2 * np.pi * scale))
                count += len(values)
        return Held(np.sqrt(np.nanmean(errors**2, axis=1)), likelihood, squared / max(count, 1))

    def predicted(self, terms: Sequence[Term], fold: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
        """Return errors (3, m), SI, of predicting blocks from all others, and their standard deviations."""
        errors, sigmas = np.zeros((3, len(fold))), np.zeros((3, len(fold)))
        for axis, _, error, values, _, vectors in self._predictions(terms, [fold]):
            errors[axis], sigmas[axis] = error, np.sqrt(np.sum(vectors**2 / values, axis=1))
        return errors, sigmas

    def _predictions(self, terms: Sequence[Term], folds: Sequence[NDArray[np.int64]]):
        """Yield axis, fold, errors, and the eigenvalues of Q_oo with the score along its vectors, and these.

        With Q = V⁻¹ − V⁻¹X(XᵀV⁻¹X)⁻¹XᵀV⁻¹ the errors of a fold o are Q_oo⁻¹ (Q y)_o, of covariance Q_oo⁻¹: a fold's
        own level that no other block tells is a direction of Q_oo that vanishes, and is left out.
        """
        design = self.design(terms)
        basis = np.linalg.qr(design / np.maximum(np.linalg.norm(design, axis=1, keepdims=True), 1e-300))[0]
        target, count = self.target(terms), len(self.blocks)
        residual = target - np.einsum("anp,amp,am->an", basis, basis, target)
        for axis in range(3):
            back = self.root[axis].T @ basis[axis, :count]  # (n, p)
            score = self.root[axis].T @ residual[axis, :count]
            for fold in folds:
                inside = self.inverse[axis][np.ix_(fold, fold)] - back[fold] @ back[fold].T
                values, vectors = np.linalg.eigh(inside)
                keep = values > 1e-7 * values[-1]
                values, vectors = values[keep], vectors[:, keep]
                along = vectors.T @ score[fold]
                yield axis, fold, vectors @ (along / values), values, along, vectors


def folds_of(blocks: RestBlocks, legs: Sequence[Leg]) -> list[NDArray[np.int64]]:
    """Return what is left out in turn: whole legs where there are four or more, else stretches of them."""
    parts = [leg.blocks for leg in legs]
    if len(parts) < 4:
        pieces = -(-4 // len(parts)) if len(parts) > 1 else 5
        parts = [piece for part in parts for piece in np.array_split(part, pieces) if len(piece)]
        return parts[1:-1] if len(legs) == 1 else parts  # the ends of one leg could only be extrapolated to
    while len(parts) > _FOLDS:
        shortest = int(np.argmin([len(a) + len(b) for a, b in pairwise(parts)]))
        parts[shortest : shortest + 2] = [np.concatenate(parts[shortest : shortest + 2])]
    return parts


def _parameters(terms: Sequence[Term]) -> int:
    """Coefficients of the three axes and inner parameters."""
    return 3 * len(terms) + sum(term.name in HISTORY for term in terms)


def _stepwise(data: Whitened, terms: Sequence[Term], fixed: Sequence[str], scale: float) -> list[Term]:
    """Leave out terms, and take them in again, as the information criterion says; `fixed` stay."""
    full = list(terms)
    kept = list(terms)
    count = len(data.blocks)

    def criterion(chosen: Sequence[Term]) -> float:
        return data.misfit(chosen) / scale + float(np.log(count)) * _parameters(chosen)

    now = criterion(kept)
    while True:
        moves = [[t for t in kept if t != each] for each in kept if each.name not in fixed]
        moves += [[t for t in full if t in kept or t == each] for each in full if each not in kept]
        costs = [criterion(move) for move in moves]
        if not costs or min(costs) >= now - 1e-9:
            return kept
        now, kept = min(costs), moves[int(np.argmin(costs))]


def _tuned(data: Whitened, terms: list[Term], grids: dict[str, FloatArray]) -> list[Term]:
    """Return the terms with the inner parameters of those with memory at the least misfit."""
    shapes = data.shapes
    for round_ in range(2):
        for name in [term.name for term in terms if term.name in HISTORY]:
            others = [term for term in terms if term.name != name]
            options = [history(name, value) for value in grids[name]] if round_ == 0 else []
            if round_ == 1:
                (now,) = (term.inner[0][1] for term in terms if term.name == name)
                options = shapes.prepare(name, now * np.geomspace(0.7, 1.43, _GRID))
            best = min(options, key=lambda term: data.misfit([*others, term]))
            terms = [*others, best]
    return terms


def _families(told: Sequence[str], more: Sequence[str]) -> dict[str, tuple[list[str], tuple[str, ...]]]:
    """Return the families of models: their effects, and those that stepwise selection must keep.

    `more`: effects that all but the autopilots' cubic may have beside.
    """
    rates = [name for name in RATES if name in told]
    found: dict[str, tuple[list[str], tuple[str, ...]]] = {
        "constant": ([], ()),
        CUBIC: (list(POWERS), POWERS),
        "polynomial": ([*POWERS, *rates, *more], ()),
        "spline": ([LEARNED, *rates, *more], ()),
    }
    for name in HISTORY:
        if name in told:
            found[name.replace("_", " ")] = ([*POWERS, name, *more], (name,))
    if all(name in told for name in HISTORY):
        found["all"] = ([*POWERS, *rates, *HISTORY, *more], ())
    return found


def fit_triad(data: Whitened, found: Identifiability, families: Sequence[str] | None = None) -> TriadFit:
    """Fit every family of models, choose by what was left out, and return the choice with its uncertainty."""
    shapes, count = data.shapes, len(data.blocks)
    grids = {"thermal_lag": shapes.lags, "thermal_hysteresis": shapes.widths}
    folds = folds_of(data.blocks, found.legs)
    more = [SCALE] if SCALE in found.told and data.name == "accelerometer" else []
    richest = [Term(LEARNED, (), k) for k in range(SPLINES)] + [Term(n) for n in (*RATES, *more) if n in found.told]
    if "thermal_lag" in found.told:
        richest = _tuned(data, [*richest, history("thermal_lag", shapes.lags[_GRID // 2])], grids)
    freedom = 3 * (count - data.blocks.levels - len(richest))
    scale = max(1.0, data.misfit(richest) / max(freedom, 1))
    networks = None
    if families is None or "network" in families:
        networks = _networks(data, found, more, folds, scale)
        scale = networks[1]
    candidates = []
    for family, (names, fixed) in _families(found.told, more).items():
        if families is not None and family not in families:
            continue
        terms: list[Term] = []
        for name in names:
            if name == LEARNED:
                terms += [Term(LEARNED, (), k) for k in range(SPLINES)]
            else:
                terms.append(history(name, grids[name][_GRID // 2]) if name in HISTORY else Term(name))
        terms = _tuned(data, terms, grids)
        terms = _stepwise(data, terms, fixed, scale)
        terms = _tuned(data, terms, grids)
        held = data.held_out(terms, folds, scale)
        candidates.append(_candidate(data, family, terms, _parameters(terms), held, scale))
    if networks is not None:
        candidates.append(networks[0])
    # A slow walk predicts a stretch from its neighbours nearly as well as a model does: what was left out is a
    # check that the information criterion, which sees the whole way, does not replace.
    best = max(each.score for each in candidates)
    close = [each for each in candidates if each.score > best - _PAYS]
    # a spline that is left with its straight line is that of temperature
    chosen = min(close, key=lambda each: (each.parameters, LEARNED in each.names, -each.score))
    base = next((each.held for each in candidates if each.family == "constant"), candidates[0].held)
    return _refined(data, chosen, tuple(candidates), base)


def _candidate(
    data: Whitened, family: str, terms: Sequence[Term], parameters: float, held: Held, scale: float
) -> Candidate:
    criterion = data.misfit(terms) / scale + float(np.log(len(data.blocks))) * parameters
    return Candidate(family, tuple(terms), parameters, criterion, held)


def _about(plain: Sequence[Term], net: Net) -> list[Term]:
    return [*plain, *(Term(NETWORK, (), k, net) for k in range(WEIGHTS))]


def _polished(data: Whitened, plain: Sequence[Term], net: Net) -> Net:
    """Gauss–Newton of the weights against all of the data, each step halved until it is worth it."""

    def cost(net: Net) -> float:
        left = data.solve_beside(plain, net)[1]
        return float(np.sum(left**2) + np.sum((np.array(net.weights) / net.prior) ** 2))

    now = cost(net)
    for _ in range(_POLISH):
        step = data.solve(_about(plain, net))[0][:, -WEIGHTS:].ravel() - net.weights
        tried = (Net(tuple((net.weights + share * step).tolist()), net.prior) for share in 0.5 ** np.arange(6))
        better = next(((each, new) for each in tried if (new := cost(each)) < now), None)
        if better is None:
            break
        gained, (net, now) = now - better[1], better
        if gained < 0.01:
            break
    return net


def _networks(
    data: Whitened, found: Identifiability, more: Sequence[str], folds: Sequence[NDArray[np.int64]], scale: float
) -> tuple[Candidate, float]:
    """Fit a network of temperature and, where it can be told, its rate, beside a straight line in temperature.

    Returns with it the scale of the noise's variance, where the network explains more than what `scale` was told by.
    """
    shapes, count, levels = data.shapes, len(data.blocks), data.blocks.levels
    plain = [Term(POWERS[0]), *(Term(name) for name in more)]
    columns = [np.broadcast_to(shapes.column(term), (3, count)) for term in plain]
    indicator = np.broadcast_to(np.eye(levels)[data.blocks.level], (3, count, levels))
    linear = np.concatenate([indicator, np.stack(columns, axis=2)], axis=2)
    given = data.covariance, data.means.T, linear, shapes.inputs, shapes.origin
    rated = any(name in found.told for name in RATES)

    def about(net: Net) -> list[Term]:
        return _about(plain, net)

    for _ in range(_ROUNDS):
        net, told = network.search(*given, scale, rated)
        net = _polished(data, plain, net)
        before, parameters = scale, 3 * len(plain) + told
        own = data.misfit(about(net)) / (3 * (count - levels) - parameters)
        scale = float(np.clip(own, 1.0, scale))
        if scale > 0.7 * before:
            break
    anew = [about(each) for each in network.fitted(net, folds, *given, scale)]
    held = data.held_out(about(net), folds, scale, anew)
    return _candidate(data, "network", about(net), parameters, held, scale), scale


def _refined(data: Whitened, chosen: Candidate, candidates: tuple[Candidate, ...], base: Held) -> TriadFit:
    """Gauss–Newton over coefficients and inner parameters together, and their joint covariance."""
    shapes, terms = data.shapes, list(chosen.terms)
    free = [k for k, term in enumerate(terms) if term.name in HISTORY]
    bounds = {name: (float(grid[0]), float(grid[-1])) for name, grid in
              (("thermal_lag", shapes.lags), ("thermal_hysteresis", shapes.widths))}  # fmt: skip
    levels = data.blocks.levels
    for _ in range(6):
        solved, residual = data.solve(terms)
        if not free:
            break
        slopes = [_slope(data, terms[k]) * solved[:, levels + k, None] for k in free]  # (3, n) by ln of the parameter
        design = data.design(terms)
        basis = np.linalg.qr(design)[0]
        off = [each - np.einsum("anp,amp,am->an", basis, basis, each) for each in slopes]
        matrix = np.stack([each.ravel() for each in off], axis=1)
        step = np.clip(np.linalg.lstsq(matrix, residual.ravel(), rcond=1e-10)[0], -0.3, 0.3)
        for k, change in zip(free, step, strict=True):
            name, value = terms[k].name, terms[k].inner[0][1]
            terms[k] = history(name, float(np.clip(value * np.exp(change), *bounds[name])))
        if np.max(np.abs(step)) < 1e-3:
            break
    solved, residual = data.solve(terms)
    if terms and (net := terms[-1].net) is not None:
        beside, residual = data.solve_beside([term for term in terms if term.net is None], net)
        solved = np.concatenate([beside, np.reshape(net.weights, (3, WEIGHTS))], axis=1)
    size = levels + len(terms)
    count = len(data.blocks)
    design = data.design(terms)
    jacobian = np.zeros((3, design.shape[1], 3 * size + len(free)))
    for axis in range(3):
        jacobian[axis, :, axis * size : (axis + 1) * size] = design[axis]
    for place, k in enumerate(free):
        value = terms[k].inner[0][1]
        jacobian[:, :count, 3 * size + place] = _slope(data, terms[k]) * solved[:, levels + k, None] / value
    flat = jacobian.reshape(-1, jacobian.shape[2])
    scale = np.maximum(np.linalg.norm(flat, axis=0), 1e-300)
    information = (flat / scale).T @ (flat / scale)
    covariance = np.linalg.pinv(information, rcond=1e-12, hermitian=True) / scale[:, None] / scale
    freedom = count - levels - chosen.parameters / 3
    chi = np.sum(residual**2, axis=1) / freedom
    excess = np.maximum(1.0, chi)
    widen = np.sqrt(np.concatenate([np.repeat(excess, size), np.full(len(free), excess.mean())]))
    covariance = covariance * widen[:, None] * widen
    sigma = np.sqrt(np.diag(covariance))
    inner = {
        (terms[k].name, terms[k].inner[0][0]): (terms[k].inner[0][1], float(sigma[3 * size + place]))
        for place, k in enumerate(free)
    }
    added = np.zeros((count, 3)) + shapes.offset(terms).T
    for k, term in enumerate(terms):
        added += (solved[:, levels + k, None] * shapes.column(term)).T
    rest = data.means - added - solved[:, :levels].T[data.blocks.level]
    about = data.means - np.stack([data.means[data.blocks.level == k].mean(axis=0) for k in range(levels)])[
        data.blocks.level
    ]  # fmt: skip
    return TriadFit(
        replace(chosen, terms=tuple(terms)), candidates, tuple(terms), solved[:, levels:], solved[:, :levels], inner,
        covariance, rest, added, np.sqrt(np.mean(about**2, axis=0)), np.sqrt(np.mean(rest**2, axis=0)), excess, chi,
        base,
    )  # fmt: skip


def _slope(data: Whitened, term: Term) -> FloatArray:
    """Return the change (3, n) of a term's whitened shape by the logarithm of its inner parameter."""
    value, step = term.inner[0][1], 0.01
    up, down = (history(term.name, value * np.exp(sign * step)) for sign in (1, -1))
    values = np.full(_GRID, value)
    values[:2] = up.inner[0][1], down.inner[0][1]
    data.shapes.prepare(term.name, values)
    return (data.column(up) - data.column(down)) / (2 * step)


def effects_of(fit: TriadFit, prefix: str, scale: FloatArray, shapes: shapes_of) -> tuple[Effect, ...]:
    """Return the fitted terms as effects of a triad with output units per SI unit `scale` (3,)."""
    bounds = {"low": np.float64(shapes.span[0]), "high": np.float64(shapes.span[1])}
    found = []
    for name in dict.fromkeys(term.name for term in fit.terms):
        kind = CATALOGUE[f"{prefix}.{name}"]
        own = [k for k, term in enumerate(fit.terms) if term.name == name]
        if name == LEARNED:
            coefficients = np.zeros((3, SPLINES))
            for k in own:
                coefficients[:, fit.terms[k].shape] = fit.coefficients[:, k] * scale
            found.append(kind(coefficients.ravel(), **bounds))  # pyright: ignore[reportCallIssue]
        elif name == NETWORK:
            coefficients = fit.coefficients[:, own].copy()
            coefficients[:, :UNITS] *= scale[:, None]
            found.append(kind(coefficients.ravel(), **bounds, reach=np.float64(shapes.reach)))  # pyright: ignore[reportCallIssue]
        else:
            inner = {key: np.float64(value) for key, value in fit.terms[own[0]].inner}
            found.append(kind(fit.coefficients[:, own[0]] * scale, **inner))
    return tuple(found)
