"""Score tests of everything that may be missing from a fitted model, and the verdict over all of them.

A dormant effect is in the model with coefficients of zero. Its derivatives, whitened like the residuals and freed of
what the base parameters can imitate, span a space; the residual's squared length in it is χ² with as many degrees of
freedom if the effect is absent (Rao's score test; Neyman's C(α)). No candidate needs a refit. The verdict is on the
smallest p-value of all tests together, whose own law under "nothing is missing" comes from draws of pure noise: so
tests may be as many and as alike as they please, and the rate of false alarms is still the one that was asked for.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
import scipy

from jaximu.diagnosis.drift import DRAWS
from jaximu.estimation.leave_out import off
from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.ground.distributions import chi2_isf, chi2_sf, noncentral_chi2_sf
from jaximu.ground.vectors import column_lengths, root_or_zero, sigmas_of, submatrix

BLIND = 1e-4
"""Share of an effect's reach that the base parameters must leave of it; below, it is not observable."""
_LARGE = 20.0
"""Usual sizes that an effect's coefficients may have."""
_NOTHING = 1e-9
"""Share of the longest column of a block below which another is none."""
_DRAWN = 2000
"""Recordings drawn for a detection limit."""
_ENOUGH = 20
"""Degrees of freedom from which on what lies outside every block's span can tell the noise's size."""
LIMIT_LEVEL = 0.05 / 28
"""Level of the test that strengths are counted in limits of: a fixed reference, whatever the catalogue's size."""
FAMILY_LEVEL = 0.05
"""Level of all questions together, at which detection limits hold."""
LIMIT_POWER = 0.9
FEWEST_DIMENSIONS = 12
"""Dimensions that the parameters must leave for anything to be asked."""


@dataclass(frozen=True)
class EffectBlock:
    """One question: the whitened derivatives (n, q) by the coefficients of an effect, each in units of `sizes`.

    kind: "effect" (a catalogue name), "data" (a defect of the recording) or "generic" (a shape without a cause).
    inner: the inner parameters it was asked at. position: it stands at one of many places in the recording (the onset
    of a step, a pose, a period), which takes no part in the span that the remaining misfit is measured against.
    curved: the input that alone makes the effect, see `Effect.curved`.
    """

    name: str
    columns: FloatArray
    sizes: FloatArray
    kind: str = "effect"
    inner: Mapping[str, float] = field(default_factory=dict)
    position: bool = False
    curved: str = ""

    @property
    def words(self) -> str:
        """The name, and for a swing its period."""
        period = self.inner.get("period")
        return self.name if period is None else f"{self.name}, with a period of about {period:.2g} s"


@dataclass(frozen=True)
class Scores:
    """Statistics (B,) of every block, their degrees of freedom and p-values, and of the misfit that no block explains.

    outside: statistic, degrees of freedom and p-value of what lies outside every block's span (p = 1 where there is no
    such space). unit: the factor on the noise's standard deviation that `statistic` is relative to: what lies outside
    tells it, if it is above one. So noise modelled a little too small does not pass for an effect.
    """

    statistic: FloatArray
    freedom: IntArray
    p_value: FloatArray
    outside: tuple[float, int, float]
    unit: float

    @property
    def smallest(self) -> float:
        """The least p-value."""
        return float(min(self.p_value.min(initial=1.0), self.outside[2]))

    def times(self, block: int) -> float:
        """Return a block's strength in detection limits."""
        return strength(float(self.statistic[block]), int(self.freedom[block]))


class Evidence:
    """A whitened residual (n,), the whitened Jacobian (n, p) of the base parameters, and the blocks to be asked.

    noise: whitened draws (n, `DRAWS`) of the noise, where its covariance is uncertain; else it is white.
    """

    def __init__(
        self, residual: FloatArray, jacobian: FloatArray, blocks: Sequence[EffectBlock], noise: FloatArray | None = None
    ):
        self.blocks = tuple(blocks)
        self._noise = noise
        self.jacobian = jacobian
        u, s, _ = np.linalg.svd(jacobian, full_matrices=False)
        self._base = u[:, s > 1e-10 * s[0]]
        self.residual = self.off_base(residual)
        self.freedom = len(residual) - self._base.shape[1]
        """Dimensions that the base parameters leave."""
        raw = (
            [np.concatenate([block.columns for block in blocks], axis=1)] if blocks else [np.zeros((len(residual), 0))]
        )
        self._edges = np.cumsum([0, *(block.columns.shape[1] for block in blocks)])
        self.columns = self.off_base(raw[0])
        self._reach = column_lengths(raw[0])
        self._gram = self.columns.T @ self.columns
        self._product = self.columns.T @ self.residual

    @cached_property
    def inverse(self) -> FloatArray:
        """The pseudo-inverse (p, n) of the Jacobian."""
        return np.asarray(scipy.linalg.pinv(self.jacobian))

    def off_base(self, values: FloatArray) -> FloatArray:
        """Return whitened conditions (n, …) without what the base parameters can imitate."""
        return off(self._base, values)

    def draws(self, random: np.random.Generator, count: int) -> FloatArray:
        """Return whitened conditions (n, count) of noise alone, as uncertain as its covariance is, off the base."""
        if self._noise is None:
            return self.off_base(random.standard_normal((len(self.residual), count)))
        return self.off_base(self._noise[:, random.integers(self._noise.shape[1], size=count)])

    def place(self, block: int) -> slice:
        """Return the columns of a block."""
        return slice(self._edges[block], self._edges[block + 1])

    def span(self, blocks: Iterable[int]) -> IntArray:
        """Return the columns of several blocks."""
        places = [np.arange(self._edges[block], self._edges[block + 1]) for block in blocks]
        return np.concatenate(places) if places else np.zeros(0, np.int64)

    def information(self, block: int) -> FloatArray:
        """Return AᵀA (q, q) of a block, the base projected off: coefficients in units of the block's sizes."""
        columns = self.place(block)
        return self._gram[columns, columns]

    def shared(self, block: int, other: int) -> float:
        """Return the largest share of what one block does to the conditions that another can do as well, 0 to 1."""
        spaces = [scipy.linalg.orth(self.columns[:, self.place(k)], rcond=BLIND) for k in (block, other)]
        return float(np.max(np.linalg.svd(spaces[0].T @ spaces[1], compute_uv=False), initial=0.0)) ** 2

    def observable(self, block: int) -> bool:
        """Whether the base parameters leave anything of the block that the recording reacts to."""
        largest = np.max(self._reach[self.place(block)], initial=0.0)
        return bool(largest > 0 and np.sqrt(np.max(np.diag(self.information(block)))) > BLIND * largest)

    def limit(self, blocks: Sequence[int]) -> float:
        """Return the detection limit of an effect that is asked at several places of a grid, in its own unit.

        All questions together, of which it is one, have the level 0.05.
        """
        inside = self.span(blocks)
        sizes = np.concatenate([self.blocks[k].sizes for k in blocks])
        gram = submatrix(self._gram, inside) / sizes[:, None] / sizes
        return detection_limit(gram, self._reach[inside] / sizes, len(blocks), self.critical(FAMILY_LEVEL))

    @cached_property
    def _groups(self) -> list[tuple[IntArray, IntArray, FloatArray]]:
        """Blocks of as many columns each: blocks (b,), columns (b, q), AᵀA (b, q, q)."""
        groups, size = [], np.diff(self._edges)
        for q in np.unique(size):
            blocks = np.flatnonzero(size == q)
            columns = self._edges[blocks, None] + np.arange(q)
            groups.append((blocks, columns, self._gram[columns[:, :, None], columns[:, None, :]]))
        return groups

    def scores(self, known: Sequence[int] = ()) -> Scores:
        """Return every block's score, those `known` taken into the model beforehand."""
        inside = self.span(known)
        root, _ = _roots(submatrix(self._gram, inside)[None], self._reach[inside][None])
        across = self._gram[:, inside] @ root[0]
        product = self._product - across @ (root[0].T @ self._product[inside])
        outside = self._outside(known)
        unit = float(_guard(np.array(outside[0]), outside[1]))
        statistic = np.zeros(len(self.blocks))
        ranks = np.zeros(len(self.blocks), np.int64)
        p_value = np.ones(len(self.blocks))
        for blocks, columns, gram in self._groups:
            shared = across[columns]
            quadratic, ranks[blocks] = _quadratic(
                gram - shared @ shared.transpose(0, 2, 1), product[columns], self._reach[columns]
            )
            statistic[blocks] = quadratic / unit**2
        testable = ranks > 0
        p_value[testable] = chi2_sf(statistic[testable], ranks[testable])
        return Scores(statistic, ranks, p_value, outside, unit)

    @cached_property
    def _spanned(self) -> FloatArray:
        """An orthonormal basis (n, r) of what all blocks but those at a position span together."""
        inside = self.span(k for k, block in enumerate(self.blocks) if not block.position)
        columns = self.columns[:, inside] / _safe(self._reach[inside])
        if columns.shape[1] > len(columns):
            values, vectors = np.linalg.eigh(columns @ columns.T)
            return vectors[:, values > BLIND**2]
        values, vectors = np.linalg.eigh(columns.T @ columns)
        keep = values > BLIND**2
        return columns @ (vectors[:, keep] / np.sqrt(values[keep]))

    def _outside(self, known: Sequence[int]) -> tuple[float, int, float]:
        """The misfit outside the span of all blocks but those at a position, unless given."""
        rest = off(self._spanned, self.residual)
        inside = self.span(k for k in known if self.blocks[k].position)
        columns = off(self._spanned, self.columns[:, inside])
        statistic, rank = _quadratic((columns.T @ columns)[None], (columns.T @ rest)[None], self._reach[inside][None])
        left = self.freedom - self._spanned.shape[1] - int(rank[0])
        if left < 1:
            return 0.0, 0, 1.0
        outside = max(float(rest @ rest) - float(statistic[0]), 0.0)
        return outside, left, float(chi2_sf(outside, left))

    @cached_property
    def null(self) -> FloatArray:
        """The smallest p-value (draws,), sorted, of recordings in which nothing is missing."""
        drawn = self._noise
        if drawn is None:
            drawn = np.random.default_rng(20260101).standard_normal((len(self.residual), DRAWS))
        noise = self.off_base(drawn)
        product = self.columns.T @ noise
        smallest, guard = np.ones(DRAWS), np.ones(DRAWS)
        left = self.freedom - self._spanned.shape[1]
        if left >= 1:
            rest = np.sum(noise**2, axis=0) - np.sum((self._spanned.T @ noise) ** 2, axis=0)
            guard = _guard(rest, left)
            smallest = chi2_sf(rest, left)
        for _, columns, gram in self._groups:
            root, rank = _roots(gram, self._reach[columns])
            statistic = np.sum((root.transpose(0, 2, 1) @ product[columns]) ** 2, axis=1) / guard**2
            for freedom in np.unique(rank[rank > 0]):
                best = statistic[rank == freedom].max(axis=0)
                np.minimum(smallest, chi2_sf(best, freedom), out=smallest)
        return np.sort(smallest)

    def strongest(self, blocks: Sequence[EffectBlock]) -> tuple[float, EffectBlock]:
        """Return of other blocks the one that stands out most, and the probability that one does so by chance."""
        other = Evidence(self.residual, self.jacobian, blocks, self._noise)
        p_value = other.scores().p_value
        best = int(np.argmin(p_value))
        return other.family_wise(float(p_value[best])), other.blocks[best]

    def without(self, columns: FloatArray) -> Evidence:
        """Return the same questions with more base parameters (n, k): one for every condition that is left out.

        The null law is taken over: that of the remaining tests differs by little.
        """
        rest = Evidence(self.residual, np.concatenate([self.jacobian, columns], axis=1), self.blocks)
        rest.null = self.null
        return rest

    def family_wise(self, smallest: float) -> float:
        """Return the probability that nothing is missing and yet a p-value is as small as this.

        From the draws; beyond the smallest of them as for so many independent tests as match their lower tenth.
        """
        null = self.null
        rank = int(np.searchsorted(null, smallest, side="right"))
        if rank >= 20:
            return (rank + 0.5) / (len(null) + 1)
        tenth = null[len(null) // 10]
        tests = np.log1p(-0.1) / np.log1p(-tenth)
        return float(-np.expm1(tests * np.log1p(-smallest)))

    def critical(self, level: float) -> float:
        """Return the p-value below which the smallest one means that something is missing, at this level."""
        return float(np.quantile(self.null, level))

    def coefficients(self, blocks: Sequence[int]) -> FloatArray:
        """Return the least-squares coefficients of the blocks' columns together, in units of their sizes."""
        inside = self.span(blocks)
        root, _ = _roots(submatrix(self._gram, inside)[None], self._reach[inside][None])
        return root[0] @ (root[0].T @ self._product[inside])

    def most_likely(self, blocks: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Return coefficients (k,) of the blocks' effects, in units of their sizes, and their covariance (k, k).

        They are known beforehand to be no larger than effects are, or a direction that the data hardly show could be
        anywhere: a lag that all axes have in common moves nothing to first order.
        """
        inside = self.span(blocks)
        known = submatrix(self._gram, inside) + np.eye(len(inside)) / _LARGE**2
        covariance = np.asarray(np.linalg.inv(known), np.float64)
        return covariance @ self._product[inside], covariance


def _guard(outside: FloatArray, freedom: int) -> FloatArray:
    """Return the factor, at least one, by which the noise looks too small in what no block explains."""
    return np.sqrt(np.maximum(1.0, outside / freedom)) if freedom >= _ENOUGH else np.ones_like(outside)


def _safe(lengths: FloatArray) -> FloatArray:
    """Return lengths (..., q) to divide by: what is nothing beside the others of a block is rounding."""
    least = _NOTHING * np.max(lengths, axis=-1, keepdims=True, initial=0.0)
    return np.where(least > 0, np.maximum(lengths, least), 1.0)


def _scaled(gram: FloatArray, lengths: FloatArray) -> FloatArray:
    scale = _safe(lengths)
    return gram / scale[..., :, None] / scale[..., None, :]


def _roots(gram: FloatArray, lengths: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return R (b, q, q) with R Rᵀ the pseudo-inverse of each Gram matrix, and the ranks (b,).

    What is left of a direction counts if it is more than a share of the column's whole reach: the rest is rounding, and
    what the estimated path is uncertain by.
    """
    values, vectors = np.linalg.eigh(_scaled(gram, lengths))
    keep = values > BLIND**2
    root = vectors / np.sqrt(np.where(keep, values, 1.0))[..., None, :] * keep[..., None, :]
    return root / _safe(lengths)[..., :, None], keep.sum(axis=-1)


def _quadratic(gram: FloatArray, product: FloatArray, lengths: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return bᵀ G⁺ b (b,) and the ranks."""
    root, rank = _roots(gram, lengths)
    return np.sum(np.einsum("bqr,bq->br", root, product) ** 2, axis=1), rank


@lru_cache(maxsize=32)
def _power(freedom: int, level: float) -> tuple[FloatArray, FloatArray]:
    """Power of a χ² test against noncentralities."""
    grid = np.concatenate([[0.0], np.geomspace(0.05, 2000.0, 400)])
    bound = chi2_isf(level, freedom)
    return grid, noncentral_chi2_sf(bound, freedom, np.maximum(grid, 1e-9))


def detection_limit(
    information: FloatArray, lengths: FloatArray | None = None, places: int = 1, level: float = LIMIT_LEVEL
) -> float:
    """Return the size of a coefficient vector (q,) of random direction that its own test finds with 90 % power.

    `information` (places·q, places·q): AᵀA of the effect's whitened columns with the base projected off, at every place
    of its grid, place by place. The effect is at any of them, each as likely, which the test does not know: it takes
    the best of all. `lengths` (places·q,): the columns' lengths before that, against which what is left counts or is
    rounding. `level`: the p-value that one place must reach. Infinite where too little of the effect is seen.
    """
    if places > 1:
        return _grid_limit(information, sigmas_of(information) if lengths is None else lengths, places, level)
    q = len(information)
    values = np.linalg.eigvalsh(information)
    whole = values[-1] if lengths is None else float(np.max(np.square(lengths), initial=0.0))
    rank = int(np.sum(values > BLIND**2 * max(whole, 0.0)))
    if values[-1] <= 0 or not rank:
        return float("inf")
    # whole orthogonal frames: their mean strength is that of all directions, whatever the draw
    frames = np.random.default_rng(7).standard_normal((1 + 1024 // q, q, q))
    directions = np.linalg.qr(frames)[0].reshape(-1, q)
    strength = np.einsum("di,ij,dj->d", directions, information, directions)
    grid, power = _power(rank, level)

    def mean(log_size: float) -> float:
        return float(np.interp(np.exp(2 * log_size) * strength, grid, power, right=1.0).mean()) - LIMIT_POWER

    middle = -0.5 * np.log(np.mean(strength))
    low, high = middle - 2, middle + 3
    while mean(high) < 0:
        high += 3
    while high - low > 1e-4:
        low, high = ((low + high) / 2, high) if mean((low + high) / 2) < 0 else (low, (low + high) / 2)
    return float(np.exp((low + high) / 2))


def _grid_limit(gram: FloatArray, lengths: FloatArray, places: int, level: float) -> float:
    """Draw noise n, a place and a direction, and take the size s from which on |n + s v|² passes any place's bound."""
    random, columns = np.random.default_rng(7), np.arange(len(gram)).reshape(places, -1)
    root, rank = _roots(gram[columns[:, :, None], columns[:, None, :]], lengths[columns])
    bound = np.where(rank > 0, chi2_isf(level, np.maximum(rank, 1)), np.inf)
    values, vectors = np.linalg.eigh(gram)
    # the symmetric root: the signs of eigenvectors, which are anybody's, do not change the draws
    noise = random.standard_normal((_DRAWN, len(gram))) @ (vectors * root_or_zero(values) @ vectors.T)
    direction = random.standard_normal((_DRAWN, columns.shape[1]))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    signal = np.concatenate([direction[k::places] @ gram[columns[k]] for k in range(places)])
    n, v = (drawn.reshape(_DRAWN, *columns.shape).swapaxes(0, 1) @ root for drawn in (noise, signal))
    lacking, across, strength = bound[:, None] - np.sum(n**2, axis=2), np.sum(n * v, axis=2), np.sum(v**2, axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        needed = (np.sqrt(across**2 + strength * lacking) - across) / strength
    needed = np.where(lacking <= 0, 0.0, np.where(np.isfinite(needed), needed, np.inf))
    return float(np.sort(needed.min(axis=0))[int(LIMIT_POWER * _DRAWN)])


@lru_cache(maxsize=64)
def limit_noncentrality(freedom: int) -> float:
    """Return the noncentrality that a test of so many degrees of freedom finds with 90 % power at 0.05/28."""
    grid, power = _power(freedom, LIMIT_LEVEL)
    return float(np.interp(LIMIT_POWER, power, grid))


def strength(statistic: float, freedom: int) -> float:
    """Return the size, in detection limits, that a statistic of so many degrees of freedom stands for."""
    return float(np.sqrt(max(statistic - freedom, 0.0) / limit_noncentrality(freedom))) if freedom else 0.0
