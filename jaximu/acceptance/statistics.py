"""Statistics of a production line: capability, control charts, gauge studies, tolerance intervals, drift."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.ground.distributions import chi2_isf, chi2_sf, deviation_interval, f_tails, normal_isf, student_two_sided
from jaximu.ground.document import Json, entries

_WEIGHT = 0.2  # of the newest value in the moving average
_CATEGORIES = 1.41  # AIAG's √2: a category is a 97 % interval of the gauge wide
_POOLED = 0.25  # p-value from which AIAG takes an interaction for repeatability


def with_ends(numbers: tuple[float, float, float]) -> dict[str, float]:
    """Return a value and its interval as JSON has them."""
    return dict(zip(("value", "low", "high"), numbers, strict=True))


@dataclass(frozen=True)
class Capability:
    """Cp and Cpk of a quantity with their 95 % intervals; NaN for Cp where there is one limit only."""

    count: int
    mean: float
    deviation: float
    cp: tuple[float, float, float]
    cpk: tuple[float, float, float]


def capability(values: FloatArray, low: float, high: float) -> Capability:
    """Return the capability of values (n,), n ≥ 2, against limits, ±inf where there is none.

    Cp = (high − low)/6s, with the interval of χ² for s; Cpk = min(high − mean, mean − low)/3s, with Bissell's variance
    1/9n + Cpk²/2(n − 1) (Applied Statistics 39, 1990). s is that of all units, what moves in time included.
    """
    count, mean, deviation = len(values), float(values.mean()), float(values.std(ddof=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        cp = float(np.float64(high - low) / (6 * deviation)) if np.isfinite(high - low) else np.nan
        cpk = float(np.float64(min(high - mean, mean - low)) / (3 * deviation))
    low_end, high_end = deviation_interval(count - 1).tolist()
    half = float(normal_isf(0.025) * np.sqrt(1 / (9 * count) + cpk**2 / (2 * (count - 1))))
    return Capability(count, mean, deviation, (cp, cp / high_end, cp / low_end), (cpk, cpk - half, cpk + half))


@dataclass(frozen=True)
class Chart:
    """A control chart of values (n,) in their order, with their moving average (n,).

    centre, deviation: of the process; bound: limits of the values, in deviations; average_bound (n,): of the average.
    beyond, jumps, drifting: places beyond the limits of values, of ranges (the later of two), and of the average.
    """

    values: FloatArray
    average: FloatArray
    centre: float
    deviation: float
    bound: float
    average_bound: FloatArray
    beyond: IntArray
    jumps: IntArray
    drifting: IntArray


def control_chart(values: FloatArray, level: float) -> Chart:
    """Return a chart of individuals, moving ranges and exponentially weighted moving averages (ISO 7870-2, 7870-6).

    The deviation is the mean moving range over 1.128, which a shift hardly widens. `level` is the probability that one
    of the chart's three kinds of limits is crossed by chance, all points together: with 20 points and 0.05 they are
    about the usual three deviations, with thousands they are wider.
    """
    count = len(values)
    ranges = np.abs(np.diff(values))
    # two normal numbers have a mean range of 2/√π = 1.128 of their deviation
    centre = float(values.mean())
    deviation = float(ranges.mean() * np.sqrt(np.pi) / 2)
    bound = float(normal_isf(level / 2 / count))
    average = np.empty(count)
    running = centre
    for index, value in enumerate(values.tolist()):
        running += _WEIGHT * (value - running)
        average[index] = running
    steps = np.arange(1, count + 1)
    average_bound = bound * np.sqrt(_WEIGHT / (2 - _WEIGHT) * -np.expm1(2 * steps * np.log1p(-_WEIGHT)))
    return Chart(
        values,
        average,
        centre,
        deviation,
        bound,
        average_bound,
        np.flatnonzero(np.abs(values - centre) > bound * deviation),
        1 + np.flatnonzero(ranges > np.sqrt(2) * bound * deviation),
        np.flatnonzero(np.abs(average - centre) > average_bound * deviation),
    )


@dataclass(frozen=True)
class Gauge:
    """How well repeated measurements of the same parts agree (standard deviations), by analysis of variance.

    repeatability: of one part at one place, with its 95 % interval; reproducibility: between stations or occasions, 0.0
    where each part was not measured at each; parts: between parts. categories: groups of parts that can be told apart
    (ndc). explained: observed over stated standard deviation of repetitions, and the p-value of one as large.
    """

    repeatability: tuple[float, float, float]
    reproducibility: float
    parts: float
    count: int
    repetitions: int
    crossed: bool
    explained: float
    p_value: float

    @property
    def total(self) -> float:
        """Standard deviation of the gauge: repeatability and reproducibility."""
        return float(np.hypot(self.repeatability[0], self.reproducibility))

    @property
    def categories(self) -> int:
        """Number of distinct categories: 1.41 times the parts' deviation over the gauge's, cut to a whole number."""
        return int(_CATEGORIES * self.parts / self.total) if self.total > 0 else 0

    def document(self) -> Json:
        """Return it as JSON has it."""
        return entries(self, "reproducibility", "parts", "crossed", "p_value") | {
            "repeatability": with_ends(self.repeatability),
            "gauge": self.total,
            "ndc": self.categories,
            "units": self.count,
            "recordings": self.repetitions,
            "observed_over_stated": self.explained,
        }


def gauge(values: FloatArray, sigma: FloatArray, parts: Sequence[str], places: Sequence[str]) -> Gauge | None:
    """Return a gauge study of values (n,) with stated uncertainties sigma (n,); None where nothing was repeated.

    Where every part was measured equally often at every one of several places, parts and places are crossed random
    factors, and their interaction goes to repeatability unless its p-value is below 0.25 (AIAG, Measurement Systems
    Analysis, 4th edition); else parts are the only factor, with any number of repetitions.
    """
    times = Counter(parts)
    kept = np.array([times[part] > 1 for part in parts], bool)
    if len(set(np.asarray(parts)[kept])) < 2:  # a part measured once says nothing of the gauge
        return None
    values = values[kept]
    sigma = sigma[kept]
    part, site = (np.unique(np.asarray(labels)[kept], return_inverse=True)[1] for labels in (parts, places))
    size, sites, count = int(part.max()) + 1, int(site.max()) + 1, len(values)
    cell = part * sites + site
    number = np.bincount(cell, minlength=size * sites)
    crossed = sites > 1 and not np.ptp(number)

    def about_means(labels: IntArray, weight: FloatArray) -> float:
        """Return the sum of squares about the mean of each label."""
        mean = np.bincount(labels, weight * values) / np.bincount(labels, weight)
        return float(weight @ (values - mean[labels]) ** 2)

    alike = np.ones(count)
    freedom = count - size
    whole, within = about_means(np.zeros_like(part), alike), about_means(part, alike)
    error, rest, against, reproducibility = within, freedom, within / freedom, 0.0
    if crossed:
        squares, error, rest = whole - about_means(site, alike), about_means(cell, alike), count - size * sites
        interaction = max(within - squares - error, 0.0)
        degrees = (size - 1) * (sites - 1)
        against = interaction / degrees
        if rest == 0 or f_tails(against / max(error / rest, 1e-300), degrees, rest)[1] > _POOLED:
            error = error + interaction
            rest = rest + degrees
            against = error / rest
        of_place = max(squares / (sites - 1) - against, 0.0) / size + max(against - error / rest, 0.0)
        reproducibility = float(np.sqrt(of_place / number[0]))
    root = float(np.sqrt(error / rest))
    typical = (count - (np.bincount(part) ** 2).sum() / count) / (size - 1)  # repetitions, if they differ
    square = about_means(part, 1 / sigma**2)
    return Gauge(
        (root, *(root * deviation_interval(rest)).tolist()),
        reproducibility,
        float(np.sqrt(max((whole - within) / (size - 1) - against, 0.0) / typical)),
        size,
        count,
        crossed,
        float(np.sqrt(square / freedom)),
        float(chi2_sf(square, freedom)),
    )


def tolerance_factor(count: int, share: float = 0.99, confidence: float = 0.95) -> float:
    """Return k: mean ± k s of `count` normal numbers holds this share of their population with this confidence.

    Howe's approximation (Journal of the American Statistical Association 64, 1969), right to a percent from ten on.
    """
    z = normal_isf((1 - share) / 2)
    return float(z * np.sqrt((count - 1) * (1 + 1 / count) / chi2_isf(confidence, count - 1)))


@dataclass(frozen=True)
class Drift:
    """Slope of a unit's values against days (per day), its standard deviation, and the p-value of none."""

    slope: float
    sigma: float
    p_value: float


def drift(days: FloatArray, values: FloatArray) -> Drift | None:
    """Return the drift of values (n,) over days (n,), by least squares; None for fewer than four or a single day."""
    if len(values) < 4 or not np.ptp(days) > 0:
        return None
    away = days - days.mean()
    square = float(away @ away)
    slope = float(away @ values) / square
    rest = values - values.mean() - slope * away
    sigma = float(np.sqrt(rest @ rest / (len(values) - 2) / square))
    return Drift(slope, sigma, float(student_two_sided(slope / max(sigma, 1e-300), len(values) - 2)))
