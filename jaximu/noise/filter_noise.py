"""What a Kalman filter takes of a sensor's noise: Q and R as numbers, continuous and at one sample rate.

A filter has no flicker noise. Its bias is the sum of a random walk (density K) and of a first-order Gauss–Markov
process of standard deviation B, whose correlation time must be stated: flicker noise has none. It is chosen here so
that the process does most where the Allan deviation is flat. The Allan deviation of a first-order Gauss–Markov process
peaks at 1.89 correlation times (IEEE Std 952-2020, the exponentially correlated process), at 0.617 of its standard
deviation; that of flicker noise is 0.664 B everywhere. The correlation time is therefore the centre of the
flat part over 1.89, and the standard deviation is B.

White noise of density N enters twice, and filters differ in which they need: a filter that takes a sample as a
measurement has R = N²/Δt; one that integrates samples (a strapdown navigation filter) lets the angle or velocity
spread by N²Δt a step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import rms
from jaximu.ground.document import Json
from jaximu.ground.errors import InputError
from jaximu.ground.units import SENSOR_QUANTITIES
from jaximu.model.data_sheet import SI_UNITS
from jaximu.model.processes import FLICKER_VARIANCE
from jaximu.noise.analysis import NoiseAnalysis
from jaximu.noise.identification import Identified, Term

PEAK = 1.8926
"""Averaging time, in correlation times, at which the Allan deviation of a first-order Gauss–Markov process peaks."""


@dataclass(frozen=True)
class MeanTerm(Term):
    """A term's root mean square over a triad's axes with its interval (SI), and the axes whose data supports it."""

    axes: str


def mean_terms(axes: Sequence[Identified]) -> dict[str, MeanTerm | None]:
    """Return each term's mean over the axes of a triad, for a user who gives a filter one number a triad.

    Variances are averaged, because variances are what a filter adds up. A term that an axis does not support counts
    as zero there: the terms of an axis are fitted together, so the others already hold all of its deviation, and with
    zero the mean's Allan variance is the mean of the axes' fitted Allan variances. To leave the axis out would state
    a drift for the triad that only one axis has. `MeanTerm.axes` says which axes count. The interval is propagated
    from those of the axes, taken to be independent, each side of its own; what an axis without the term may hide is not
    in it.
    """
    return {name: _mean_term([axis.terms[name] for axis in axes]) for name in (axes[0].terms if axes else ())}


def _mean_term(terms: Sequence[Term | None]) -> MeanTerm | None:
    present = {axis: term for axis, term in zip("xyz", terms, strict=False) if term is not None and term.value > 0}
    if not present:
        return None
    squares = np.array([(t.low, t.value, min(t.high, 1e20 * t.value)) for t in present.values()]) ** 2  # finite if open
    mean = float(squares[:, 1].sum() / len(terms))
    below, above = (np.sqrt(((squares[:, 1] - squares[:, end]) ** 2).sum()) / len(terms) for end in (0, 2))
    low = math.sqrt(max(mean - below, 0.0)) if squares[:, 0].any() else 0.0  # doubted on all axes for one reason
    return MeanTerm(math.sqrt(mean), low, math.sqrt(mean + above), "".join(present))


@dataclass(frozen=True)
class FilterNumbers:
    """The numbers of one axis (or of a triad's mean) in a Kalman filter, in SI.

    white: N, signal unit · √s; walk: K, signal unit/√s; sigma: B, signal unit, the standard deviation of a first-order
    Gauss–Markov bias with `correlation_time` (s). 0 for a term that the data does not support. rate: Hz.
    flat: the averaging times (s) between which B rules; the correlation time is their geometric mean over 1.89.
    """

    quantity: str
    rate: float
    white: float
    walk: float
    sigma: float
    correlation_time: float | None = None
    flat: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for name, value in {"rate": self.rate, "white": self.white, "walk": self.walk, "sigma": self.sigma}.items():
            if not (math.isfinite(value) and value >= 0):
                raise InputError(f"{name} must be finite and must not be negative, found {value}.")
        if self.quantity not in SI_UNITS:
            raise InputError(f"noise belongs to one of {', '.join(SI_UNITS)}, not to {self.quantity!r}.")
        if not self.rate > 0:
            raise InputError(f"the sample rate must be positive, found {self.rate}.")
        time = self.correlation_time
        if self.sigma > 0 and (time is None or not (math.isfinite(time) and time > 0)):
            raise InputError(f"a Gauss–Markov bias needs a positive correlation time in s, found {time}.")

    @property
    def interval(self) -> float:
        """Δt, s."""
        return 1 / self.rate

    @property
    def measurement_variance(self) -> float:
        """R = N²/Δt: variance of one sample taken as a measurement."""
        return self.white**2 / self.interval

    @property
    def integral_variance(self) -> float:
        """N²Δt: by how much the variance of the integral (angle or velocity) grows a step."""
        return self.white**2 * self.interval

    @property
    def walk_variance(self) -> float:
        """K²Δt: by how much the variance of the bias walk grows a step."""
        return self.walk**2 * self.interval

    @property
    def decay(self) -> float | None:
        """φ = exp(−Δt/T): the Gauss–Markov bias of the next step over that of this one; None without one."""
        return math.exp(-self.interval / self.correlation_time) if self.sigma and self.correlation_time else None

    @property
    def driving_variance(self) -> float | None:
        """B²(1 − φ²): variance of what drives the Gauss–Markov bias each step; None without one."""
        if not (self.sigma and self.correlation_time):
            return None
        return -(self.sigma**2) * math.expm1(-2 * self.interval / self.correlation_time)

    @property
    def driving_density(self) -> float | None:
        """2B²/T: the continuous density that drives the Gauss–Markov bias; None without one."""
        return 2 * self.sigma**2 / self.correlation_time if self.sigma and self.correlation_time else None

    def rows(self) -> list[tuple[str, str, str, float | None, str]]:
        """Return (key, formula, words, value, unit) of every number; value None where the data supports none."""
        signal, walk, integral = (SI_UNITS[self.quantity][term] for term in "BRQ")
        word = {"angular_rate": "angle", "specific_force": "velocity"}.get(self.quantity)
        squared = f"({signal})^2"
        return [
            ("white_density", "N²", "white noise, continuous", self.white**2 or None, f"{squared}/Hz"),
            ("walk_density", "K²", "bias random walk, continuous", self.walk**2 or None, f"({walk})^2/Hz"),
            ("driving_density", "2B²/T", "Gauss–Markov drive, continuous", self.driving_density, f"({walk})^2/Hz"),
            (
                "measurement_variance",
                "R = N²/Δt",
                "one sample as a measurement",
                self.measurement_variance or None,
                squared,
            ),
            *(
                []
                if word is None
                else [
                    (
                        "integral_variance",
                        "Q = N²Δt",
                        f"{word} a step, if integrated",
                        self.integral_variance or None,
                        f"({integral})^2" if "/" in integral else f"{integral}^2",
                    )
                ]
            ),
            ("walk_variance", "Q = K²Δt", "bias random walk a step", self.walk_variance or None, squared),
            ("bias_sigma", "B", "Gauss–Markov bias, std. deviation", self.sigma or None, signal),
            (
                "correlation_time",
                "T",
                "its correlation time, chosen",
                self.correlation_time if self.sigma else None,
                "s",
            ),
            ("decay", "φ = exp(−Δt/T)", "its decay a step", self.decay, "1"),
            ("driving_variance", "Q = B²(1−φ²)", "its drive a step", self.driving_variance, squared),
        ]

    def document(self) -> Json:
        """Return the numbers with their units for JSON; null where the data supports no such term."""
        return {
            key: None if value is None else {"value": value, "unit": unit} for key, _, _, value, unit in self.rows()
        }


def flat_part(terms: Mapping[str, float], shortest: float, longest: float) -> tuple[float, float]:
    """Return the averaging times (s) between which bias instability rules the Allan variance.

    `terms`: sizes by letter, 0 or missing where there is none; B must be positive. To the left of the flat part Q and
    N together exceed B's 0.664² B², to the right K and R do; both ends are kept within `shortest` and `longest`, the
    averaging times that the recording resolves. Where B never rules, the ends are in reverse order, and their geometric
    mean is still the lowest place of the curve (for N and K: √3 N/K).
    """
    size = {letter: float(terms.get(letter, 0.0)) for letter in "QNBKR"}
    if not size["B"] > 0:
        raise InputError("there is no flat part without bias instability.")
    level = FLICKER_VARIANCE * size["B"] ** 2
    root = math.sqrt(size["N"] ** 4 + 12 * size["Q"] ** 2 * level)  # 3Q²/τ² + N²/τ = level
    left = (size["N"] ** 2 + root) / (2 * level)
    root = math.sqrt(size["K"] ** 4 / 9 + 2 * size["R"] ** 2 * level)  # K²τ/3 + R²τ²/2 = level
    right = 2 * level / (size["K"] ** 2 / 3 + root) if root > 0 else math.inf
    return min(max(left, shortest), longest), min(max(right, shortest), longest)


def filter_numbers(analysis: NoiseAnalysis, name: str) -> tuple[list[FilterNumbers], FilterNumbers]:
    """Return a triad's numbers by axis, and of its mean (see `mean_terms`). `name`: of the triad.

    They are of the five terms; Gauss–Markov processes that `identify` was asked for are not among them.
    """
    axes = analysis.axes[name]
    by_axis = [{k: term.value for k, term in axis.terms.items() if term is not None} for axis in axes]
    mean = {k: term.value for k, term in mean_terms(axes).items() if term is not None}
    tau = axes[0].deviation.tau
    *numbers, of_mean = (
        _numbers(sizes, tau, SENSOR_QUANTITIES[name], analysis.rates[name]) for sizes in (*by_axis, mean)
    )
    return numbers, of_mean


def _numbers(sizes: Mapping[str, float], tau: FloatArray, quantity: str, rate: float) -> FilterNumbers:
    flat = time = None
    if sizes.get("B", 0.0) > 0:
        flat = flat_part(sizes, float(tau[0]), float(tau[-1]))
        time = math.sqrt(flat[0] * flat[1]) / PEAK
    white, walk, sigma = (sizes.get(letter, 0.0) for letter in "NKB")
    return FilterNumbers(quantity, rate, white, walk, sigma, time, flat)


def filter_document(analysis: NoiseAnalysis) -> Json:
    """Return the key `filter` of `allan.json`: by triad the rate, the numbers of three axes and of their mean."""

    def of_triad(name: str) -> Json:
        axes, mean = filter_numbers(analysis, name)
        return {
            "rate": analysis.rates[name],
            "axes": [numbers.document() for numbers in axes],
            "mean": mean.document(),
        }

    return {name: of_triad(name) if name in analysis.axes else None for name in SENSOR_QUANTITIES}


def recorded_seconds(axis: Identified) -> float:
    """Return the length (s) that the deviation was computed from, long gaps not counted."""
    deviation = axis.deviation
    samples = int(deviation.count[0]) + 2 * int(deviation.factor[0]) - 1
    return samples * float(deviation.tau[0]) / int(deviation.factor[0])


@dataclass(frozen=True)
class Walk:
    """A number for a program that needs one where the data may support none: SI, and by axis where it comes from.

    origin: for each axis `measured`, `from B` or `upper limit`.
    """

    value: float
    origin: tuple[str, ...]


def random_walk_only(analysis: NoiseAnalysis, name: str) -> Walk:
    """Return one bias random walk for a triad (signal unit/√s), for filters that know no other bias (Kalibr's).

    By axis: K where the data supports it. Otherwise, where it supports B, the walk that a Gauss–Markov bias of that
    B makes over times shorter than its correlation time T: B √(2/T). Otherwise the upper limit of K. The axes' root
    mean square is returned.
    """

    def walk(axis: Identified, numbers: FilterNumbers) -> tuple[float, str]:
        if numbers.walk > 0:
            return numbers.walk, "measured"
        if numbers.driving_density:
            return math.sqrt(numbers.driving_density), "from B"
        return axis.limits["K"], "upper limit"

    return _root_mean_square(
        [
            walk(axis, numbers)
            for axis, numbers in zip(analysis.axes[name], filter_numbers(analysis, name)[0], strict=True)
        ]
    )


def _root_mean_square(axes: Sequence[tuple[float, str]]) -> Walk:
    values, origin = zip(*axes, strict=True)
    return Walk(rms(values), origin)


def white_noise_only(analysis: NoiseAnalysis, name: str) -> Walk:
    """Return one white-noise density for a triad (signal unit · √s): root mean square of N, or of its upper limit."""
    terms = [(axis, axis.terms.get("N")) for axis in analysis.axes[name]]
    return _root_mean_square(
        [(axis.limits["N"], "upper limit") if term is None else (term.value, "measured") for axis, term in terms]
    )
