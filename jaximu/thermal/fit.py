"""Bias over temperature by generalised least squares: which terms a path determines, which hold on ways left out.

At rest each axis's output is a level (bias, and for an accelerometer gravity) for each rest, plus coefficients times
shapes that the thermal effects of the catalogue take along the temperature's path. Any path will do: what it determines
is read off the shapes themselves. Each axis has terms of its own; inner parameters (a time constant, a half-width) are
the device's, and shared. Noise ties blocks to each other, and is whitened by its covariance, so that slow bias does not
pass for temperature and a long soak counts for no more than it determines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, product
from math import comb, log
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaximu import stored
from jaximu.distributions import chi2_sf
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
    "Separation",
    "Term",
    "TriadFit",
    "Whitened",
    "fit_triad",
    "identifiable",
    "richest",
    "separated",
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
_ZOOMS = 4  # grids of inner parameters, each between the neighbours of the last one's best
_TOLD = 0.05
"""Share of a shape that smooth functions of temperature must leave of it."""
ENOUGH = 0.1
"""Share of a shape that must be left beside all others for its coefficient to be worth having."""
_PAYS = 5.0
"""Nats that a more complicated model must gain."""
_AT_ONCE = (POWERS[0], LEARNED)
_PICKED = 0.3  # numbers by nat of choice: two over the logarithm of some hundred blocks
_ALIKE = 1.1  # times the least error on what was left out, up to which a simpler model may have more
_VAGUE = 0.5  # of a time constant or a half-width: with a larger standard deviation slow noise is taken for it
_PATTERN = 1e-3
"""Probability of what the best model leaves, were it noise, below which a network is tried."""
_OTHER_POSE = 1.0  # m/s² by which the force differs between poses
_LISTED = 6  # ways of the temperature that are listed one by one
_FOLDS = 8
_ROUNDS, _POLISH = 3, 10
_WORDS = {"temperature_rate": "the rate of temperature", "temperature_rate_squared": "the square of that rate",
          "temperature_times_rate": "temperature times its rate", "thermal_lag": "a lag",
          "thermal_hysteresis": "a hysteresis"}  # fmt: skip


class Term(NamedTuple):
    """A column group of the fit: a catalogue effect without its prefix, inner parameters, and which of its shapes."""

    name: str
    inner: tuple[tuple[str, float], ...] = ()
    shape: int | None = None  # of the learned curve, or the weight of the network
    net: Net | None = None  # about which the network is linear


Model = tuple[tuple[Term, ...], ...]
"""The terms of each of three axes."""


class Separation(NamedTuple):
    """What a path shows of an effect: the share of its shape that smooth functions of temperature and drift leave.

    apart: the share that all other effects leave as well; information: that part, squared and summed over time.
    """

    alone: float
    apart: float
    information: float


@dataclass(frozen=True)
class Held:
    """Stretches left out in turn, by axis (3,).

    rms: SI, of the outputs left out, corrected by the terms as fitted without them, about the mean of each rest.
    by_axis: log-likelihood of their prediction, nats, which knows slow noise from what lies beside; χ² per block.
    """

    rms: FloatArray
    by_axis: FloatArray
    chi_squared: FloatArray

    @property
    def log_likelihood(self) -> float:
        """Of the three axes, nats."""
        return float(np.sum(self.by_axis))


@dataclass(frozen=True)
class Candidate:
    """A model that was tried: its family, terms by axis, information criterion and how it did on what was left out.

    numbers, costs (3,): how many numbers of an axis the data determine, and the information criterion.
    """

    family: str
    model: Model
    numbers: FloatArray
    costs: FloatArray
    held: Held

    @property
    def terms(self) -> tuple[Term, ...]:
        """The terms that any axis has."""
        return tuple(dict.fromkeys(term for terms in self.model for term in terms))

    @property
    def parameters(self) -> float:
        """How many numbers of the three axes the data determine."""
        return float(np.sum(self.numbers))

    @property
    def scores(self) -> FloatArray:
        """What models of an axis (3,) are compared by, nats: log-likelihood on what was left out and in sample, less
        the penalty.
        """
        return self.held.by_axis - self.costs / 2

    @property
    def names(self) -> tuple[str, ...]:
        """The effects in it, without prefix."""
        return tuple(dict.fromkeys(term.name for term in self.terms))


@dataclass(frozen=True)
class Identifiability:
    """What a path of temperature determines.

    left: by effect, the share of its shape that levels, drift and smooth functions of temperature leave. told: effects
    that can be fitted. words: sentences. legs: the ways of the temperature. parts: the same of each effect beside
    temperature whole.
    """

    left: dict[str, float]
    told: tuple[str, ...]
    words: tuple[str, ...]
    legs: tuple[Leg, ...]
    parts: dict[str, Separation]


@dataclass(frozen=True)
class TriadFit:
    """The chosen model of a triad, in SI.

    families: of each axis's model. coefficients (3, k): by axis and term, zero where an axis has it not; level (3, L):
    by axis and rest, at the reference temperature. covariance: (3 (L + k) + i) of levels and coefficients, axis by
    axis, then the inner parameters, widened by `excess` where the residuals exceed the noise. residual (n, 3): of the
    blocks. before, after (3,): rms about the mean of each rest.
    """

    candidate: Candidate
    families: tuple[str, ...]
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
        # a lag shorter than the path's own nodes is none; one as long as the recording is drift
        self.lags = np.geomspace(max(blocks.duration / 2, 1e-3 * duration), 0.4 * duration, _GRID)
        self.widths = np.geomspace(0.01, 0.45, _GRID) * (high - low)
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
        for (name, grid), columns in zip(self.grids.items(), (lagged, played), strict=True):
            self._history |= {history(name, value): each for value, each in zip(grid, columns.T, strict=True)}

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

    @property
    def grids(self) -> dict[str, FloatArray]:
        """Values (12,) of the inner parameter of each effect with memory that are tried first."""
        return {"thermal_lag": self.lags, "thermal_hysteresis": self.widths}

    def prepare(self, tried: dict[str, FloatArray]) -> dict[str, list[Term]]:
        """Return terms of effects with memory at values (12,) of their inner parameters."""
        grids = self.grids | tried
        found = self._computed(grids["thermal_lag"], grids["thermal_hysteresis"])
        terms = {name: [history(name, value) for value in values] for name, values in tried.items()}
        for name, own in terms.items():
            self._history |= dict(zip(own, found[2 if name == "thermal_lag" else 3].T, strict=True))
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
                self.prepare({term.name: np.full(_GRID, value)})
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


def separated(shapes: shapes_of) -> dict[str, Separation]:
    """Return by effect what the path of temperature shows of it: the information that nuisance terms leave.

    Nuisance is what is free in any fit: the levels of the rests, a slow drift of each recording, and any smooth
    function of temperature; then all other effects as well. Lag and hysteresis count at the inner parameter that is
    seen best beside temperature, and beside other effects in the middle of the range of inner parameters.
    """
    blocks = shapes.blocks
    root = np.sqrt(blocks.stop - blocks.start)[:, None]
    levels, drift = np.eye(blocks.levels)[blocks.level], np.eye(int(blocks.log.max()) + 1)[blocks.log]
    drift = drift * (blocks.start / np.max(np.abs(blocks.stop)))[:, None]
    mean, base = _basis(root * levels), _basis(root * np.concatenate([levels, drift, shapes.smooth()], axis=1))
    grids: dict[str, list[Term]] = {name: [Term(name)] for name in RATES}
    grids |= {"thermal_lag": [history("thermal_lag", value) for value in shapes.lags],
              "thermal_hysteresis": [history("thermal_hysteresis", value) for value in shapes.widths]}  # fmt: skip
    columns = {name: [root[:, 0] * shapes.column(term) for term in grid] for name, grid in grids.items()}
    middle = {name: found[len(found) // 2] for name, found in columns.items()}
    found = {}
    for name, options in columns.items():
        # a rate counts from standing still, a lag and a play, like temperature, from wherever they are
        whole = [_length(each if name in RATES else _off(mean, each)) for each in options]
        alone = max(_length(_off(base, each)) / size for each, size in zip(options, whole, strict=True))
        others = np.stack([_off(base, each) for other, each in middle.items() if other != name], axis=1)
        # what rounding leaves of a shape is no shape
        others = others[:, np.linalg.norm(others, axis=0) > 1e-9 * max(map(_length, middle.values()))]
        left = _length(_off(_basis(others), _off(base, middle[name])))
        found[name] = Separation(alone, left / whole[len(options) // 2], left**2)
    return found


def _length(column: FloatArray) -> float:
    return max(float(np.linalg.norm(column)), 1e-300)


def _off(basis: FloatArray, column: FloatArray) -> FloatArray:
    return column - basis @ (basis.T @ column)


def _basis(columns: FloatArray) -> FloatArray:
    """Return orthonormal columns of what columns (n, k) span."""
    if not columns.shape[1]:
        return columns
    u, s, _ = np.linalg.svd(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), full_matrices=False)
    return u[:, s > 1e-9 * s[0]]


def identifiable(blocks: RestBlocks, shapes: shapes_of) -> Identifiability:
    """Say before any fit which thermal effects the path of temperature distinguishes from smooth functions of it."""
    parts = separated(shapes)
    legs = blocks.legs()
    told = [*POWERS, LEARNED, *(name for name, part in parts.items() if part.alone > _TOLD)]
    if len(legs) > _LISTED:
        low, high = blocks.range
        fast = 60 * float(np.max(np.abs(blocks.rate)))
        words = [f"The temperature went {len(legs)} ways up and down between {low:.0f} and {high:.0f} °C, at up to "
                 f"{fast:.2g} K/min."]  # fmt: skip
    else:
        words = [f"The temperature went {'; '.join(map(str, legs))}."]
    share = max(part.alone for part in parts.values())
    alike = [name for name in (*RATES, *HISTORY) if name in told and parts[name].apart < ENOUGH]
    hidden = [name for name in (*RATES, *HISTORY) if name not in told]
    if len(hidden) == len(parts):
        words.append(
            f"Over this path the rate of temperature, a lag and a hysteresis are functions of temperature, to "
            f"{max(100 * share, 0.1):.2g} %: this recording cannot separate them, nor the warm-up after power-on, from "
            "bias over temperature. The fit is their sum, and holds for this way and rate of change only. Record a "
            "cycle: the same range up and down, then again at another rate."
        )
    elif hidden or alike:
        seen = [name for name in (*RATES, *HISTORY) if name not in hidden and name not in alike]
        said = [f"This path of temperature separates {_listed(seen)}." if seen else ""]
        said.append(f"It does not show {_listed(hidden, 'or')} beside bias over temperature." if hidden else "")
        if alike:
            share = 100 * (1 - min(parts[name].apart for name in alike))
            said.append(f"The other effects imitate {_listed(alike)} to {share:.2g} %.")
        said.append("Record a cycle, then again at another rate, to separate them." if hidden else "")
        words.append(" ".join(filter(None, said)))
    else:
        words.append("This path of temperature separates every rate term, a lag and a hysteresis.")
    shares = {name: part.alone for name, part in parts.items()}
    base = _basis(np.concatenate([np.eye(blocks.levels)[blocks.level], shapes.smooth()], axis=1))
    mean = _basis(np.eye(blocks.levels)[blocks.level])
    shares[SCALE] = max(_length(_off(base, each)) / _length(_off(mean, each)) for each in shapes.column(Term(SCALE)))
    if blocks.levels > 1 and shares[SCALE] > _TOLD and _poses(shapes):
        told.append(SCALE)
    else:
        words.append(
            "What the accelerometer shows of temperature is bias and, along gravity, scale, and across it, "
            "tilt of the mounting: in one pose they stay unresolved. Poses with each axis up and down at the same "
            "temperatures would separate them."
        )
    return Identifiability(shares, tuple(told), tuple(words), tuple(legs), parts)


def _poses(shapes: shapes_of) -> bool:
    """Whether the unit lay in more than one pose: a jump of bias is a level of its own, too."""
    return bool(np.max(np.ptp(shapes.force, axis=0)) > _OTHER_POSE)


def _listed(names: Sequence[str], last: str = "and") -> str:
    words = [_WORDS[name] for name in names]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}"


# --- the fit ----------------------------------------------------------------------------------------------------------


class Whitened:
    """A triad's blocks, whitened by the covariance of its noise, axis by axis."""

    def __init__(self, blocks: RestBlocks, name: str, noise: NoiseModel, shapes: shapes_of):
        self.covariance = blocks.covariance(getattr(noise, name))
        self.blocks, self.name, self.shapes = blocks, name, shapes
        self.means = blocks.means[name]
        self.root = np.linalg.inv(np.linalg.cholesky(self.covariance))  # (3, n, n)
        self.inverse = np.swapaxes(self.root, 1, 2) @ self.root
        self.levels = self.root @ np.eye(blocks.levels)[blocks.level]
        self.output = (self.root @ self.means.T[:, :, None])[..., 0]
        self._columns: dict[Term, FloatArray] = {}

    def column(self, term: Term) -> FloatArray:
        """Return the whitened shape (3, n) of a term."""
        if term not in self._columns:
            column = np.broadcast_to(self.shapes.column(term), (3, len(self.blocks)))
            self._columns[term] = (self.root @ column[:, :, None])[..., 0]
        return self._columns[term]

    def design(self, axis: int, terms: Sequence[Term]) -> FloatArray:
        """Return an axis's whitened levels and shapes (n + p, L + k): then a row for each weight known before."""
        data = np.column_stack([self.levels[axis], *(self.column(term)[axis] for term in terms)])
        known = [(k, term) for k, term in enumerate(terms, self.blocks.levels) if term.net is not None]
        rows = np.zeros((len(known), data.shape[1]))
        for row, (k, term) in enumerate(known):
            assert term.net is not None and term.shape is not None
            rows[row, k] = 1 / np.reshape(term.net.prior, (3, WEIGHTS))[axis, term.shape]
        return np.concatenate([data, rows])

    def target(self, axis: int, terms: Sequence[Term]) -> FloatArray:
        """Return what the design times levels and coefficients should be (n + p,)."""
        known = sum(term.net is not None for term in terms)
        output = self.output[axis]
        if known:
            output = output - self.root[axis] @ self.shapes.offset(terms)[axis]
        return np.pad(output, (0, known))

    def solve(self, axis: int, terms: Sequence[Term]) -> tuple[FloatArray, FloatArray]:
        """Return an axis's levels and coefficients (L + k,) and whitened residuals (n,)."""
        return self._solve(self.design(axis, terms), self.target(axis, terms))

    def solve_beside(self, axis: int, terms: Sequence[Term], net: Net) -> tuple[FloatArray, FloatArray]:
        """Return the same of terms beside a network whose weights stay."""
        network = self.root[axis] @ self.shapes.network(net)[0][axis]
        return self._solve(self.design(axis, terms), self.output[axis] - network)

    def misfit(self, axis: int, terms: Sequence[Term]) -> float:
        """Return the sum of squares that least squares leaves of an axis."""
        return float(np.sum(self.solve(axis, terms)[1] ** 2))

    def _solve(self, design: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
        size = np.linalg.norm(design, axis=0)
        size = np.where(size > 0, size, 1.0)
        solved = np.linalg.lstsq(design / size, target, rcond=1e-10)[0]
        return solved / size, (target - design @ (solved / size))[: len(self.blocks)]

    def held_out(
        self, model: Model, folds: Sequence[NDArray[np.int64]], scale: FloatArray,
        anew: Sequence[Sequence[Term]] | None = None,
    ) -> Held:  # fmt: skip
        """Predict each fold from all other blocks, noise that they share included.

        **Arguments:** `scale` (3,): of the noise's variance; `anew`: for each fold the terms as fitted without it.
        """
        squared, likelihood, count = np.zeros(3), np.zeros(3), np.zeros(3)
        errors = np.full((3, len(self.blocks)), np.nan)
        for axis in range(3):
            parts = [(model[axis], folds)]
            if anew is not None:
                parts = [(own, [fold]) for own, fold in zip(anew, folds, strict=True)]
            for terms, some in parts:
                for fold in some:
                    errors[axis, fold] = self._corrected(axis, terms, fold)
                for _, _, values, along, _ in self._predictions(axis, terms, some):
                    chi = float(np.sum(along**2 / values)) / scale[axis]
                    squared[axis] += chi
                    likelihood[axis] += 0.5 * (
                        float(np.sum(np.log(values))) - chi - len(values) * np.log(2 * np.pi * scale[axis])
                    )
                    count[axis] += len(values)
        for level in range(self.blocks.levels):
            own = self.blocks.level == level
            if not np.isnan(errors[:, own]).all():
                errors[:, own] -= np.nanmean(errors[:, own], axis=1)[:, None]
        return Held(np.sqrt(np.nanmean(errors**2, axis=1)), likelihood, squared / np.maximum(count, 1))

    def _corrected(self, axis: int, terms: Sequence[Term], fold: NDArray[np.int64]) -> FloatArray:
        """Return outputs (m,) that are left out less what the terms add, as fitted to all others."""
        levels, count = np.eye(self.blocks.levels)[self.blocks.level], len(self.blocks)
        shapes = [np.broadcast_to(self.shapes.column(term), (3, count))[axis] for term in terms]
        design = np.column_stack([levels, *shapes])
        output = self.means[:, axis] - np.broadcast_to(self.shapes.offset(terms), (3, count))[axis]
        rest = np.column_stack([design, output])
        rest[fold] = 0.0
        # the inverse of the others' own covariance, from that of all
        white = self.inverse[axis] @ rest
        inside = white[fold]
        known = rest.T @ white - inside.T @ np.linalg.solve(self.inverse[axis][np.ix_(fold, fold)], inside)
        information, product = known[:-1, :-1], known[:-1, -1]
        for k, term in enumerate(terms, self.blocks.levels):
            if term.net is not None and term.shape is not None:
                information[k, k] += 1 / np.reshape(term.net.prior, (3, WEIGHTS))[axis, term.shape] ** 2
        size = np.sqrt(np.maximum(np.diag(information), 1e-300))
        solved = np.linalg.pinv(information / size[:, None] / size, rcond=1e-11, hermitian=True) @ (product / size)
        solved = solved / size
        return output[fold] - design[fold, levels.shape[1] :] @ solved[levels.shape[1] :]

    def predicted(self, model: Model, fold: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
        """Return errors (3, m), SI, of predicting blocks from all others, and their standard deviations."""
        errors, sigmas = np.zeros((3, len(fold))), np.zeros((3, len(fold)))
        for axis in range(3):
            for _, error, values, _, vectors in self._predictions(axis, model[axis], [fold]):
                errors[axis], sigmas[axis] = error, np.sqrt(np.sum(vectors**2 / values, axis=1))
        return errors, sigmas

    def _predictions(self, axis: int, terms: Sequence[Term], folds: Sequence[NDArray[np.int64]]):
        """Yield each fold, its errors, and the eigenvalues of Q_oo with the score along its vectors, and these.

        With Q = V⁻¹ − V⁻¹X(XᵀV⁻¹X)⁻¹XᵀV⁻¹ the errors of a fold o are Q_oo⁻¹ (Q y)_o, of covariance Q_oo⁻¹: a fold's
        own level that no other block determines is a direction of Q_oo that vanishes, and is left out.
        """
        basis, target = _basis(self.design(axis, terms)), self.target(axis, terms)
        count = len(self.blocks)
        score = self.root[axis].T @ _off(basis, target)[:count]
        back = self.root[axis].T @ basis[:count]  # (n, p)
        for fold in folds:
            inside = self.inverse[axis][np.ix_(fold, fold)] - back[fold] @ back[fold].T
            values, vectors = np.linalg.eigh(inside)
            keep = values > 1e-7 * values[-1]
            values, vectors = values[keep], vectors[:, keep]
            along = vectors.T @ score[fold]
            yield fold, vectors @ (along / values), values, along, vectors


class _Offered:
    """Many terms' columns, reduced to a triangle: what any subset of them leaves is found from a few dozen numbers."""

    def __init__(self, data: Whitened, terms: Sequence[Term]):
        unique = list(dict.fromkeys(terms))
        self.levels = data.blocks.levels
        self.place = {term: self.levels + k for k, term in enumerate(unique)}
        self.factor, self.target, self.rest = [], [], []
        for axis in range(3):
            columns = data.design(axis, unique)
            q, r = np.linalg.qr(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))
            product = q.T @ data.output[axis]
            self.factor.append(r)
            self.target.append(product)
            self.rest.append(float(np.sum((data.output[axis] - q @ product) ** 2)))

    def misfit(self, axis: int, terms: Sequence[Term]) -> float:
        """Return the sum of squares that least squares leaves of an axis."""
        inside = [*range(self.levels), *(self.place[term] for term in terms)]
        columns = self.factor[axis][:, inside]
        solved = np.linalg.lstsq(columns, self.target[axis], rcond=1e-10)[0]
        return self.rest[axis] + float(np.sum((self.target[axis] - columns @ solved) ** 2))


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


def _parameters(terms: Sequence[Term]) -> float:
    """Coefficients of an axis and its inner parameters; that pieces of a curve were picked from all counts as well."""
    pieces = sum(term.name == LEARNED for term in terms)
    return len(terms) + sum(term.name in HISTORY for term in terms) + _PICKED * log(comb(SPLINES, pieces))


def _stepwise(data: Whitened, model: Model, fixed: Sequence[str], scale: FloatArray) -> Model:
    """Leave out terms, and take them in again, axis by axis, as the information criterion says; `fixed` stay.

    What acts at once stays beside what has a memory: without it another time constant takes its place.
    """
    offered = _Offered(data, [term for terms in model for term in terms])
    penalty = float(np.log(len(data.blocks)))
    found = []
    for axis, full in enumerate(model):

        def criterion(chosen: Sequence[Term], axis: int = axis) -> float:
            return offered.misfit(axis, chosen) / scale[axis] + penalty * _parameters(chosen)

        kept = list(full)
        now = criterion(kept)
        while True:
            stay = {*fixed, *(_AT_ONCE if any(t.name in HISTORY for t in kept) else ())}
            moves = [[t for t in kept if t != each] for each in kept if each.name not in stay]
            moves += [[t for t in full if t in kept or t == each] for each in full if each not in kept]
            costs = [criterion(move) for move in moves]
            if not costs or min(costs) >= now - 1e-9:
                break
            now, kept = min(costs), moves[int(np.argmin(costs))]
        found.append(tuple(kept))
    return tuple(found)


def _tuned(data: Whitened, model: Model, scale: FloatArray) -> Model:
    """Return the model with its inner parameters, which the axes share, at the least misfit: a grid, refined."""
    names = [name for name in HISTORY if any(term.name == name for terms in model for term in terms)]
    if not names:
        return model
    shapes = data.shapes
    bounds = {name: (grid[0], grid[-1]) for name, grid in shapes.grids.items()}
    options = {name: [history(name, value) for value in shapes.grids[name]] for name in names}
    spacing = {name: float(grid[1] / grid[0]) for name, grid in shapes.grids.items()}
    touched = [axis for axis, terms in enumerate(model) if any(term.name in names for term in terms)]
    plain = [term for axis in touched for term in model[axis] if term.name not in HISTORY]
    best: tuple[Term, ...] = ()
    for zoom in range(_ZOOMS):
        if zoom:
            tried = {}
            for term in best:
                name, value = term.name, term.inner[0][1]
                tried[name] = np.clip(value * np.geomspace(1 / spacing[name], spacing[name], _GRID), *bounds[name])
                spacing[name] **= 2 / (_GRID - 1)
            options = shapes.prepare(tried)
        offered = _Offered(data, [*plain, *(term for terms in options.values() for term in terms)])

        def cost(chosen: tuple[Term, ...], offered: _Offered = offered) -> float:
            own = {term.name: term for term in chosen}
            return sum(
                offered.misfit(axis, [own.get(term.name, term) for term in model[axis]]) / scale[axis]
                for axis in touched
            )

        best = min(product(*options.values()), key=cost)
    own = {term.name: term for term in best}
    return tuple(tuple(own.get(term.name, term) for term in terms) for terms in model)


def _families(told: Sequence[str], more: Sequence[str]) -> dict[str, tuple[list[str], tuple[str, ...]]]:
    """Return the families of models: their effects, and those that stepwise selection must keep.

    `more`: effects that all but the autopilots' cubic may have beside.
    """
    rates = [name for name in RATES if name in told]
    memory = [name for name in HISTORY if name in told]
    found: dict[str, tuple[list[str], tuple[str, ...]]] = {
        "constant": ([], ()),
        CUBIC: (list(POWERS), POWERS),
        "polynomial": ([*POWERS, *rates, *more], ()),
        "spline": ([LEARNED, *rates, *more], ()),
    }
    for name in memory:
        found[name.replace("_", " ")] = ([*POWERS, name, *more], (name,))
    if memory:
        found["all"] = ([*POWERS, *rates, *memory, *more], ())
        found["spline and memory"] = ([LEARNED, *rates, *memory, *more], ())
    return found


def _terms(names: Sequence[str], shapes: shapes_of) -> tuple[Term, ...]:
    """Return the terms of effects, those with memory at a typical inner parameter."""
    found: list[Term] = []
    for name in names:
        if name == LEARNED:
            found += [Term(LEARNED, (), k) for k in range(SPLINES)]
        else:
            found.append(history(name, shapes.grids[name][_GRID // 2]) if name in HISTORY else Term(name))
    return tuple(found)


def richest(data: Whitened, found: Identifiability) -> tuple[Model, FloatArray]:
    """Return the model with all that can be separated from temperature, and the scale (3,) of the noise beside it."""
    terms = _terms([LEARNED, *(name for name in (*RATES, *HISTORY) if name in found.told), *_more(data, found)],
                   data.shapes)  # fmt: skip
    model = _tuned(data, (terms,) * 3, np.ones(3))
    freedom = max(len(data.blocks) - data.blocks.levels - _parameters(terms), 1)
    return model, np.array([max(1.0, data.misfit(axis, model[axis]) / freedom) for axis in range(3)])


def _more(data: Whitened, found: Identifiability) -> list[str]:
    return [SCALE] if SCALE in found.told and data.name == "accelerometer" else []


def fit_triad(data: Whitened, found: Identifiability, families: Sequence[str] | None = None) -> TriadFit:
    """Fit every family of models, choose for each axis by what was left out, and return the choice, with uncertainty.

    Inner parameters are those of the model that is best for all axes together: each axis then chooses its terms at
    them. An axis is left as it is where no model predicts what was left out better than a constant does.
    """
    folds, more = folds_of(data.blocks, found.legs), _more(data, found)
    scale = richest(data, found)[1]
    offered = {family: each for family, each in _families(found.told, more).items()
               if family == "constant" or families is None or family in families}  # fmt: skip
    tried: dict[str, Model] = {}
    for family, (names, fixed) in offered.items():
        model = _tuned(data, (_terms(names, data.shapes),) * 3, scale)
        tried[family] = _tuned(data, _stepwise(data, model, fixed, scale), scale)
    candidates = [_candidate(data, family, model, folds, scale) for family, model in tried.items()]
    if remembering := [each for each in candidates if set(HISTORY) & set(each.names)]:
        best = max(float(np.sum(each.scores)) for each in remembering)
        anchor = min((each for each in remembering if np.sum(each.scores) > best - _PAYS), key=lambda c: c.parameters)
        own = {term.name: term for term in anchor.terms if term.name in HISTORY}
        for place, each in enumerate(candidates):
            names, fixed = offered[each.family]
            terms = tuple(own.get(term.name, term) for term in _terms(names, data.shapes))
            if each is not anchor and set(own) & set(names):
                tried[each.family] = _stepwise(data, (terms,) * 3, fixed, scale)
                candidates[place] = _candidate(data, each.family, tried[each.family], folds, scale)
    if families is None or "network" in families:
        best = tuple(candidates[k].model[axis] for axis, k in enumerate(_best(candidates)))
        if families is not None or _patterned(data, best, scale):
            network, scale = _networks(data, found, more, folds, scale)
            candidates = [_candidate(data, family, model, folds, scale) for family, model in tried.items()]
            candidates.append(network)
    chosen = [candidates[k] for k in _best(candidates)]
    model = _tuned(data, _completed(tuple(each.model[axis] for axis, each in enumerate(chosen))), scale)
    held = [[getattr(each.held, key)[axis] for axis, each in enumerate(chosen)] for key in
            ("rms", "by_axis", "chi_squared")]  # fmt: skip
    held = Held(*(np.array(values) for values in held))
    numbers = np.array([each.numbers[axis] + len(model[axis]) - len(each.model[axis])
                        for axis, each in enumerate(chosen)])  # fmt: skip
    costs = np.array([each.costs[axis] for axis, each in enumerate(chosen)])
    families_chosen = tuple(each.family for each in chosen)
    named = tuple(dict.fromkeys(family for family in families_chosen if family != "constant")) or ("constant",)
    whole = Candidate(", ".join(named), model, numbers, costs, held)
    base = next(each.held for each in candidates if each.family == "constant")
    fit = _concluded(data, whole, families_chosen, tuple(candidates), base)
    vague = {effect for (effect, _), (value, sigma) in fit.inner.items() if sigma > _VAGUE * value}
    if not vague:
        return fit
    told = tuple(name for name in found.told if name not in vague)
    return fit_triad(data, replace(found, told=told), families)


def _completed(model: Model) -> Model:
    """Return the model with lag and hysteresis on every axis that has one of them, if any axis has both.

    They are as much alike as their inner parameters make them: one that is left out biases the other's.
    """
    memory = dict.fromkeys(term for terms in model for term in terms if term.name in HISTORY)
    unique = {term.name: term for term in memory}
    return tuple(
        (*(term for term in terms if term.name not in HISTORY), *unique.values())
        if any(term.name in HISTORY for term in terms) else terms
        for terms in model
    )  # fmt: skip


def _best(candidates: Sequence[Candidate]) -> list[int]:
    """Return for each axis the candidate to take: the simplest of those close to the best that correct it as well.

    A slow walk predicts a stretch from its neighbours nearly as well as a model does, and only the model corrects
    another recording: what the terms alone leave of the stretches left out decides between what is about as likely.
    """
    (constant,) = (k for k, each in enumerate(candidates) if each.family == "constant")
    plain, found = candidates[constant], []
    for axis in range(3):
        known = plain.held.rms[axis], plain.costs[axis]
        helping = [k for k, each in enumerate(candidates)
                   if k == constant or (each.held.rms[axis] < known[0] and each.costs[axis] < known[1])]  # fmt: skip
        best = max(candidates[k].scores[axis] for k in helping)
        close = [k for k in helping if candidates[k].scores[axis] > best - _PAYS]
        least = min(candidates[k].held.rms[axis] for k in close)
        close = [k for k in close if candidates[k].held.rms[axis] <= _ALIKE * least]
        # a spline of few pieces is no simpler than a polynomial
        found.append(min(close, key=lambda k: (any(term.name == LEARNED for term in candidates[k].model[axis]),
                                               candidates[k].numbers[axis], -candidates[k].scores[axis])))  # fmt: skip
    return found


def _candidate(
    data: Whitened, family: str, model: Model, folds: Sequence[NDArray[np.int64]], scale: FloatArray
) -> Candidate:
    numbers = np.array([float(_parameters(terms)) for terms in model])
    return _scored(data, family, model, numbers, data.held_out(model, folds, scale), scale)


def _scored(data: Whitened, family: str, model: Model, numbers: FloatArray, held: Held, scale: FloatArray) -> Candidate:
    misfit = np.array([data.misfit(axis, terms) for axis, terms in enumerate(model)])
    return Candidate(family, model, numbers, misfit / scale + float(np.log(len(data.blocks))) * numbers, held)


def _patterned(data: Whitened, model: Model, scale: FloatArray) -> bool:
    """Whether the best model leaves anything that a smooth function of temperature and its rate could follow."""
    smooth = network.smooth_functions(data.shapes.inputs)
    for axis, terms in enumerate(model):
        base = _basis(data.design(axis, terms))
        left = data.solve(axis, terms)[1]
        white = data.root[axis] @ smooth
        free = _basis(white - base @ (base.T @ white))
        statistic = float(np.sum((free.T @ left) ** 2)) / scale[axis]
        if float(chi2_sf(np.array(statistic), free.shape[1])) < _PATTERN:
            return True
    return False


def _about(plain: Sequence[Term], net: Net) -> tuple[Term, ...]:
    return (*plain, *(Term(NETWORK, (), k, net) for k in range(WEIGHTS)))


def _polished(data: Whitened, plain: Sequence[Term], net: Net) -> Net:
    """Gauss–Newton of the weights against all of the data, each step halved until it is worth it."""

    def cost(net: Net) -> float:
        left = [data.solve_beside(axis, plain, net)[1] for axis in range(3)]
        return float(np.sum(np.square(left)) + np.sum((np.array(net.weights) / net.prior) ** 2))

    now = cost(net)
    for _ in range(_POLISH):
        solved = [data.solve(axis, _about(plain, net))[0][-WEIGHTS:] for axis in range(3)]
        step = np.concatenate(solved) - net.weights
        tried = (Net(tuple((net.weights + share * step).tolist()), net.prior) for share in 0.5 ** np.arange(6))
        better = next(((each, new) for each in tried if (new := cost(each)) < now), None)
        if better is None:
            break
        gained, (net, now) = now - better[1], better
        if gained < 0.01:
            break
    return net


def _networks(
    data: Whitened, found: Identifiability, more: Sequence[str], folds: Sequence[NDArray[np.int64]], scales: FloatArray
) -> tuple[Candidate, FloatArray]:
    """Fit a network of temperature and, where it can be told, its rate, beside a straight line in temperature.

    Returns with it the scale of the noise's variance, where the network explains more than what `scales` came from.
    """
    shapes, count, levels = data.shapes, len(data.blocks), data.blocks.levels
    plain = (Term(POWERS[0]), *(Term(name) for name in more))
    columns = [np.broadcast_to(shapes.column(term), (3, count)) for term in plain]
    indicator = np.broadcast_to(np.eye(levels)[data.blocks.level], (3, count, levels))
    linear = np.concatenate([indicator, np.stack(columns, axis=2)], axis=2)
    given = data.covariance, data.means.T, linear, shapes.inputs, shapes.origin
    rated = any(name in found.told for name in RATES)
    scale, left, freedom = float(np.mean(scales)), np.zeros(3), 1.0
    for _ in range(_ROUNDS):
        net, told = network.search(*given, scale, rated)
        net = _polished(data, plain, net)
        left = np.array([data.misfit(axis, _about(plain, net)) for axis in range(3)])
        before, freedom = scale, count - levels - len(plain) - told / 3
        scale = float(np.clip(left.sum() / (3 * freedom), 1.0, scale))
        if scale > 0.7 * before:
            break
    model = (_about(plain, net),) * 3
    anew = [_about(plain, each) for each in network.fitted(net, folds, *given, scale)]
    scales = np.minimum(scales, np.maximum(left / freedom, 1.0))
    held = data.held_out(model, folds, scales, anew)
    return _scored(data, "network", model, np.full(3, len(plain) + told / 3), held, scales), scales


def _concluded(
    data: Whitened, chosen: Candidate, families: tuple[str, ...], candidates: tuple[Candidate, ...], base: Held
) -> TriadFit:
    """Return levels, coefficients and inner parameters of the chosen model, with their joint covariance."""
    shapes, levels, count = data.shapes, data.blocks.levels, len(data.blocks)
    model = _one_net(chosen.model)
    terms = tuple(dict.fromkeys(term for own in model for term in own))
    free = [k for k, term in enumerate(terms) if term.name in HISTORY]
    net = next((term.net for term in terms if term.net is not None), None)
    size = levels + len(terms)
    solved, residual = np.zeros((3, size)), np.zeros((3, count))
    jacobian = np.zeros((3, count + (WEIGHTS if net is not None else 0), 3 * size + len(free)))
    for axis, own in enumerate(model):
        places = [*range(levels), *(levels + terms.index(term) for term in own)]
        plain = [term for term in own if term.net is None]
        if net is not None and len(plain) < len(own):
            beside, residual[axis] = data.solve_beside(axis, plain, net)
            solved[axis, places] = np.concatenate([beside, np.reshape(net.weights, (3, WEIGHTS))[axis]])
        else:
            solved[axis, places], residual[axis] = data.solve(axis, own)
        design = data.design(axis, own)
        jacobian[axis, : len(design), [axis * size + place for place in places]] = design.T
        for place, k in enumerate(free):
            slope = _slope(data, terms[k])[axis] / terms[k].inner[0][1]
            jacobian[axis, :count, 3 * size + place] = slope * solved[axis, levels + k]
    flat = jacobian.reshape(-1, jacobian.shape[2])
    scale = np.linalg.norm(flat, axis=0)
    used = scale > 0
    information = (flat / np.where(used, scale, 1.0)).T @ (flat / np.where(used, scale, 1.0))
    inverse = np.linalg.pinv(information[np.ix_(used, used)], rcond=1e-12, hermitian=True)
    covariance = np.zeros((len(scale),) * 2)
    covariance[np.ix_(used, used)] = inverse / scale[used, None] / scale[used]
    chi = np.sum(residual**2, axis=1) / (count - levels - chosen.numbers)
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
    level = data.blocks.level
    about = data.means - np.stack([data.means[level == k].mean(axis=0) for k in range(levels)])[level]
    rest = data.means - added - solved[:, :levels].T[level]
    left = rest - np.stack([rest[level == k].mean(axis=0) for k in range(levels)])[level]
    return TriadFit(
        replace(chosen, model=model), families, candidates, terms, solved[:, levels:], solved[:, :levels], inner,
        covariance, rest, added, np.sqrt(np.mean(about**2, axis=0)), np.sqrt(np.mean(left**2, axis=0)), excess, chi,
        base,
    )  # fmt: skip


def _one_net(model: Model) -> Model:
    """Return the model with the network's weights zero on axes that do without it."""
    with_net = [any(term.net is not None for term in terms) for terms in model]
    if all(with_net) or not any(with_net):
        return model
    net = next(term.net for terms in model for term in terms if term.net is not None)
    weights = np.reshape(net.weights, (3, WEIGHTS)) * np.array(with_net)[:, None]
    masked = Net(tuple(weights.ravel().tolist()), net.prior)
    return tuple(tuple(term if term.net is None else term._replace(net=masked) for term in terms) for terms in model)


def _slope(data: Whitened, term: Term) -> FloatArray:
    """Return the change (3, n) of a term's whitened shape by the logarithm of its inner parameter."""
    value, step = term.inner[0][1], 0.01
    values = np.full(_GRID, value)
    values[:2] = value * np.exp(step), value * np.exp(-step)
    up, down = data.shapes.prepare({term.name: values})[term.name][:2]
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
