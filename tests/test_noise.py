"""The noise processes against statements made without them: spectra integrated, covariances, counts of samples.

Densities are two-sided. Where samples are judged, the interval follows from the known number of degrees of freedom of
the estimate and the chance of a false alarm is stated; seeds are fixed, so that an outcome never changes by itself.
"""

import itertools
import math
import zlib
from decimal import Decimal, localcontext
from functools import lru_cache

import numpy as np
import pytest
import scipy.linalg
import scipy.stats
from hypothesis import example, given
from hypothesis import strategies as st

from jaximu.ground.errors import InputError
from jaximu.model import (
    BiasInstability,
    BiasRepeatability,
    FirstOrderGaussMarkov,
    LinearSystem,
    Noise,
    Quantisation,
    RandomConstant,
    RandomWalk,
    RateRamp,
    SecondOrderGaussMarkov,
    White,
    convert,
    from_discrete,
    parse_quantity,
    to_discrete,
)
from jaximu.model.data_sheet import DATASHEET_UNITS, SI_UNITS, DensityUnit, parse_unit
from jaximu.model.state_space import combine, run

FLICKER_LEVEL = math.sqrt(2 * math.log(2) / math.pi)  # Allan deviation of flicker noise of B = 1


legendre = lru_cache(np.polynomial.legendre.leggauss)


class Parts:
    """The matrices of a process sampled at an interval, as NumPy arrays."""

    def __init__(self, process, interval):
        system = process.system(interval)
        self.transition, self.drive, self.output, self.through, self.start, self.root = (
            np.asarray(getattr(system, name)) for name in ("transition", "drive", "output", "through", "start", "root")
        )

    @property
    def pushed(self):
        """Covariance of what one step's draws add to the state."""
        return self.drive @ self.drive.T

    @property
    def initial(self):
        """Covariance of the state at the start."""
        return self.root @ self.root.T

    def autocovariance(self, count, state=None):
        """Autocovariance of the output at lags 0 … count − 1, the state having its covariance of the start."""
        state = self.initial if state is None else state
        found = np.empty(count)
        found[0] = self.output @ state @ self.output + self.through @ self.through
        ahead = self.transition @ state @ self.output + self.drive @ self.through  # of the next state with this output
        for lag in range(1, count):
            found[lag] = self.output @ ahead
            ahead = self.transition @ ahead
        return found


# --- theory: the Allan variance is what the spectrum says


def integrated_allan_variance(density, tau):
    """4 ∫_0^∞ S(f) sin⁴(πfτ)/(πfτ)² df, by Gauss–Legendre between the zeros of the sine; u = πfτ."""
    nodes, weights = legendre(40)
    last = 400 * np.pi
    edges = np.concatenate([np.geomspace(1e-10, np.pi, 60), np.pi * np.arange(2, 401)])
    half = np.diff(edges)[:, None] / 2
    u = (edges[:-1, None] + half + half * nodes).ravel()
    within = ((half * weights).ravel() * density(u / (np.pi * tau)) * np.sin(u) ** 4 / u**2).sum()
    # beyond, sin⁴ = 3/8 on average (what oscillates leaves 1/last³); there u = last/t
    nodes, weights = legendre(300)
    t = (nodes + 1) / 2
    beyond = 3 / 8 / last * (weights / 2 * density(last / t / (np.pi * tau))).sum()
    return 4 / (np.pi * tau) * (within + beyond)


@pytest.mark.parametrize("tau", [0.01, 1.0, 700.0])
@pytest.mark.parametrize("process", [White(0.3), RandomWalk(0.02), BiasInstability(0.5)], ids=lambda p: p.letter)
def test_allan_variance_is_the_integral_of_the_spectrum(process, tau):
    expected = integrated_allan_variance(process.density, tau)
    np.testing.assert_allclose(process.allan_variance([tau]), expected, rtol=1e-7)


@pytest.mark.parametrize("tau", [0.1, 50.0])
@pytest.mark.parametrize("product", [1e-3, 0.1, 1.0, 30.0, 1e3])  # beta · tau
@pytest.mark.parametrize("kind", [FirstOrderGaussMarkov, SecondOrderGaussMarkov])
def test_allan_variance_of_gauss_markov_is_the_integral_of_its_spectrum(kind, product, tau):
    process = kind(0.7, product / tau)
    expected = integrated_allan_variance(process.density, tau)
    np.testing.assert_allclose(process.allan_variance([tau]), expected, rtol=1e-7)


def test_allan_variance_of_quantisation_is_the_integral_of_its_sampled_spectrum():
    """It exists sampled only: |1 − e^{−iω}|² Q²/Δt within the Nyquist band, at averages of m whole samples."""
    size, interval = 3e-4, 0.02
    nodes, weights = legendre(400)
    phase = (nodes + 1) * np.pi / 4  # πfΔt from 0 to π/2
    density = 4 * size**2 / interval * np.sin(phase) ** 2
    frequency = phase / (np.pi * interval)
    # at low frequency it is (2πf)² Q² Δt
    low = frequency < 1e-3 / interval
    np.testing.assert_allclose(density[low], (2 * np.pi * frequency[low] * size) ** 2 * interval, rtol=1e-5)
    for m in (1, 2, 7, 50):
        response = 2 * np.sin(m * phase) ** 4 / (m * np.sin(phase)) ** 2
        expected = 2 * (np.pi / 4 * weights * density * response).sum() / (np.pi * interval)
        np.testing.assert_allclose(Quantisation(size).allan_variance([m * interval]), expected, rtol=1e-10)
    with pytest.raises(NotImplementedError):
        Quantisation(size).density([1.0])
    # its samples have that spectrum: the autocovariance of the system summed as a cosine series
    covariance = Parts(Quantisation(size), interval).autocovariance(4)
    np.testing.assert_allclose(covariance[2:], 0.0, atol=1e-20)
    series = interval * (covariance[0] + 2 * covariance[1] * np.cos(2 * phase))
    np.testing.assert_allclose(series, density, rtol=1e-9, atol=1e-12 * density.max())


def test_allan_variance_against_the_table():
    """IEEE Std 952: √3 Q/τ, N/√τ, √(2 ln 2/π) B, K √(τ/3), R τ/√2."""
    tau = np.array([0.5, 2.0, 60.0])
    for process, expected in (
        (Quantisation(0.1), math.sqrt(3) * 0.1 / tau),
        (White(0.1), 0.1 / np.sqrt(tau)),
        (BiasInstability(0.1), 0.0664282 * np.ones(3)),
        (RandomWalk(0.1), 0.1 * np.sqrt(tau / 3)),
        (RateRamp(0.1), 0.1 * tau / math.sqrt(2)),
        (RandomConstant(0.1), np.zeros(3)),
        (BiasRepeatability(0.1), np.zeros(3)),
    ):
        np.testing.assert_allclose(np.sqrt(process.allan_variance(tau)), expected, rtol=1e-6)


def test_spectra_against_the_table():
    """White N², flicker B²/(2πf), random walk K²/(2πf)², nothing for what does not fluctuate."""
    frequency = np.array([0.01, 1.0, 30.0])
    omega = 2 * np.pi * frequency
    for process, expected in (
        (White(0.1), 0.01 * np.ones(3)),
        (BiasInstability(0.1), 0.01 / omega),
        (RandomWalk(0.1), 0.01 / omega**2),
        (FirstOrderGaussMarkov(0.1, 3.0), 0.01 / (9.0 + omega**2)),
        (SecondOrderGaussMarkov(0.1, 3.0), 0.01 / (9.0 + omega**2) ** 2),
        (RandomConstant(0.1), np.zeros(3)),
        (BiasRepeatability(0.1), np.zeros(3)),
        (RateRamp(0.1), np.zeros(3)),
    ):
        np.testing.assert_allclose(process.density(frequency), expected, rtol=1e-14)


def test_allan_variance_of_a_ramp_is_that_of_its_samples():
    ramp, interval = 2e-3, 0.1
    samples = Noise((RateRamp(ramp),)).sample(256, 1 / interval)[:, 0]
    np.testing.assert_allclose(samples, ramp * interval * np.arange(256), rtol=1e-12)
    for m in (1, 10, 64):
        np.testing.assert_allclose(allan_variance(samples, m), RateRamp(ramp).allan_variance([m * interval]), rtol=1e-9)


GRID = np.unique(np.concatenate([np.geomspace(1e-8, 1e3, 331), 1e-2 * (1 + np.linspace(-1e-9, 1e-9, 5)), [1e-3, 0.1]]))


def first_order_reference(x):
    """Allan variance over q²τ with sixty digits, βτ = x."""
    return (1 - (3 - 4 * (-x).exp() + (-2 * x).exp()) / (2 * x)) / x**2


def second_order_reference(x):
    """Allan variance over σ², from V = 2 ∫ (τ − s)(1 + βs) e^{−βs} ds: (4 V(τ) − V(2τ))/2τ²."""

    def spread(x):  # V β²/2
        return 2 * x - 3 + (-x).exp() * (3 + x)

    return (4 * spread(x) - spread(2 * x)) / x**2


@pytest.mark.parametrize("kind", [FirstOrderGaussMarkov, SecondOrderGaussMarkov])
def test_allan_variance_of_gauss_markov_at_any_product(kind):
    """To 1e-9 of sixty-digit arithmetic at all βτ, so continuous across the switch from series to closed form."""
    first = kind is FirstOrderGaussMarkov
    reference = first_order_reference if first else second_order_reference
    with localcontext() as context:
        context.prec = 60
        expected = [float(reference(Decimal(float(x)))) for x in GRID]
    found = kind(1.0, 1.0).allan_variance(GRID)
    np.testing.assert_allclose(found / GRID if first else 4 * found, expected, rtol=1e-9)


# --- exact sampling

PRODUCTS = [1e-6, 1e-4, 9e-3, 1.1e-2, 0.3, 1.0, 3.0, 10.0]  # beta · interval


def scaled(covariance, by):
    """A covariance over the standard deviations of another: its elements against one."""
    deviation = np.sqrt(np.diag(by))
    return covariance / np.outer(deviation, deviation)


@pytest.mark.parametrize("interval", [1e-4, 0.01, 1.0])
@pytest.mark.parametrize("product", PRODUCTS)
def test_first_order_is_sampled_exactly(product, interval):
    """σ² e^{−β|t|}, with the variance of the increments by itself: it is what cancels at small β Δt."""
    sigma, beta = 0.4, product / interval
    process = FirstOrderGaussMarkov.of(sigma, 1 / beta)
    parts = Parts(process, interval)
    lags = np.arange(200)
    np.testing.assert_allclose(parts.autocovariance(200), sigma**2 * np.exp(-product * lags), rtol=1e-11, atol=1e-300)
    np.testing.assert_allclose(parts.pushed, sigma**2 * -np.expm1(-2 * product), rtol=1e-13)
    # stationary from the start on
    stationary = parts.transition @ parts.initial @ parts.transition.T + parts.pushed
    np.testing.assert_allclose(stationary, parts.initial, rtol=1e-14)


@pytest.mark.parametrize("interval", [1e-4, 0.01, 1.0])
@pytest.mark.parametrize("product", PRODUCTS)
def test_second_order_is_sampled_exactly(product, interval):
    """σ²(1 + β|t|)e^{−β|t|}; what a step adds is the quadrature of the matrix exponential, element by element."""
    sigma, beta = 0.4, product / interval
    process = SecondOrderGaussMarkov.of(sigma, 1 / beta)
    parts = Parts(process, interval)
    lags = np.arange(200) * product
    np.testing.assert_allclose(
        parts.autocovariance(200), sigma**2 * (1 + lags) * np.exp(-lags), rtol=1e-9, atol=1e-12 * sigma**2
    )
    # second column of e^{As} by hand: an impulse of velocity makes s e^{−βs} of position
    q = 2 * sigma * beta**1.5
    nodes, weights = legendre(80)
    s = (nodes + 1) * interval / 2
    impulse = np.array([s * np.exp(-beta * s), (1 - beta * s) * np.exp(-beta * s)])
    expected = q**2 * (impulse * weights * interval / 2) @ impulse.T
    np.testing.assert_allclose(scaled(parts.pushed, expected), scaled(expected, expected), rtol=1e-9, atol=1e-12)
    # the drive is lower triangular; its second diagonal is what remains once the position is known
    remaining = expected[1, 1] - expected[0, 1] ** 2 / expected[0, 0]
    np.testing.assert_allclose(parts.drive[1, 1] ** 2, remaining, rtol=1e-8)
    # Van Loan's block exponential as a third derivation, in units of the interval so that it is balanced
    rate = np.array([[0.0, 1.0], [-(product**2), -2 * product]])
    block = scipy.linalg.expm(np.block([[-rate, np.diag([0.0, 1.0])], [np.zeros((2, 2)), rate.T]]))
    units = np.array([interval**1.5, interval**0.5])
    van_loan = q**2 * np.outer(units, units) * (block[2:, 2:].T @ block[:2, 2:])
    np.testing.assert_allclose(scaled(parts.pushed, expected), scaled(van_loan, expected), rtol=1e-9, atol=1e-9)
    # stationary from the start on
    stationary = parts.transition @ parts.initial @ parts.transition.T + parts.pushed
    np.testing.assert_allclose(scaled(stationary, parts.initial), np.eye(2), atol=1e-13)


def test_stationary_spread_of_gauss_markov():
    """Of x and ẋ, as the docstrings have it; `of` states σ and 1/β."""
    q, beta = 0.3, 0.25
    np.testing.assert_allclose(Parts(FirstOrderGaussMarkov(q, beta), 0.1).initial, [[q**2 / (2 * beta)]], rtol=1e-14)
    expected = np.diag([(q / (2 * beta**1.5)) ** 2, (q / (2 * beta**0.5)) ** 2])
    np.testing.assert_allclose(Parts(SecondOrderGaussMarkov(q, beta), 0.1).initial, expected, rtol=1e-14)
    for kind in (FirstOrderGaussMarkov, SecondOrderGaussMarkov):
        process = kind.of(0.7, 4.0)
        assert process.beta == 0.25
        np.testing.assert_allclose(Parts(process, 0.1).initial[0, 0], 0.49, rtol=1e-14)
        # the variance is the spectrum's area: ∫ S df over both signs
        frequency = np.sinh(np.linspace(-30, 30, 60001))
        area = np.trapezoid(process.density(frequency) * np.cosh(np.linspace(-30, 30, 60001)), dx=1e-3)
        np.testing.assert_allclose(area, 0.49, rtol=1e-9)


def test_random_walk_is_sampled_exactly():
    """From zero, with variance K² t."""
    parts = Parts(RandomWalk(0.02), 0.04)
    assert parts.initial.item() == 0.0
    variance = np.zeros((1, 1))
    for k in range(50):
        np.testing.assert_allclose(variance, 0.02**2 * 0.04 * k, rtol=1e-12)
        variance = parts.transition @ variance @ parts.transition.T + parts.pushed


@pytest.mark.parametrize(
    "process",
    [
        RandomWalk(0.3),
        FirstOrderGaussMarkov(0.3, 1e-5),
        FirstOrderGaussMarkov(0.3, 7.0),
        SecondOrderGaussMarkov(0.3, 1e-3),
        SecondOrderGaussMarkov(0.3, 0.7),  # β h below the switch of the covariance's formula, 2 β h above
        SecondOrderGaussMarkov(0.3, 400.0),
    ],
)
def test_two_steps_of_half_the_interval(process):
    half, whole = Parts(process, 0.01), Parts(process, 0.02)
    # elements of the transition that are far below the others differ by the rounding of those
    np.testing.assert_allclose(half.transition @ half.transition, whole.transition, rtol=1e-12, atol=1e-14)
    twice = half.transition @ half.pushed @ half.transition.T + half.pushed
    np.testing.assert_allclose(scaled(twice, whole.pushed), scaled(whole.pushed, whole.pushed), rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(half.initial, whole.initial)


@pytest.mark.parametrize("rate", [1.0, 100.0])
def test_white_noise_is_averaged_over_the_interval(rate):
    parts = Parts(White(0.3), 1 / rate)
    np.testing.assert_allclose(parts.autocovariance(3), [0.09 * rate, 0.0, 0.0], rtol=1e-14)


def test_parameters_by_axis_broadcast():
    """Each axis is sampled as if it were alone, also where only one of two parameters differs between the axes."""
    sizes = np.array([1.0, 2.0, 3.0])
    for of_three, of_one in (
        (White(sizes), White),
        (RandomWalk(sizes), RandomWalk),
        (Quantisation(sizes), Quantisation),
        (RateRamp(sizes), RateRamp),
        (BiasRepeatability(sizes), BiasRepeatability),
        (BiasInstability(sizes, 10.0), lambda size: BiasInstability(size, 10.0)),
        (FirstOrderGaussMarkov(sizes, 0.2), lambda size: FirstOrderGaussMarkov(size, 0.2)),
        (FirstOrderGaussMarkov(0.2, sizes - 1), lambda size: FirstOrderGaussMarkov(0.2, size - 1)),
        (SecondOrderGaussMarkov(0.2, sizes), lambda size: SecondOrderGaussMarkov(0.2, size)),
    ):
        whole = Parts(of_three, 0.1)
        for axis in range(3):
            alone = Parts(of_one(sizes[axis]), 0.1)
            for name, value in vars(alone).items():
                together = getattr(whole, name)
                assert together.shape == (3, *value.shape)
                np.testing.assert_allclose(together[axis], value, rtol=1e-14, atol=1e-300)
        variance = of_three.allan_variance([1.0, 5.0])
        assert variance.shape == (3, 2)
        np.testing.assert_allclose(variance[1], of_one(sizes[1]).allan_variance([1.0, 5.0]), rtol=1e-14)


# --- limits of the first-order process


def test_first_order_without_decay_is_the_random_walk():
    walk, still = RandomWalk(0.3), FirstOrderGaussMarkov(0.3, 0.0)
    for name, value in vars(Parts(walk, 0.01)).items():
        other = getattr(Parts(still, 0.01), name)
        if name != "root":  # the walk has none; the process has one of zero
            np.testing.assert_allclose(other, value, rtol=1e-15)
    np.testing.assert_array_equal(Parts(still, 0.01).initial, 0.0)
    tau, frequency = np.array([0.1, 10.0]), np.array([0.1, 10.0])
    np.testing.assert_allclose(still.allan_variance(tau), walk.allan_variance(tau), rtol=1e-15)
    np.testing.assert_allclose(still.density(frequency), walk.density(frequency), rtol=1e-15)
    # on the way there, with the same draws and from zero
    draws, start = np.random.default_rng(0).standard_normal((1, 1024)), np.zeros(1)
    reference = run(walk.system(0.01).blocked(), start, draws)[0]
    apart = []
    for beta in (1e-2, 1e-4, 1e-6):
        found = run(FirstOrderGaussMarkov(0.3, beta).system(0.01).blocked(), start, draws)[0]
        apart.append(np.abs(found - reference).max() / np.abs(reference).max())
    assert apart[0] > 1e-3  # they do differ
    np.testing.assert_allclose(np.divide(apart[1:], apart[:-1]), 1e-2, rtol=0.1)  # by β T


def test_first_order_of_fast_decay_is_white_noise():
    """q/β = N held: white to what averages over many 1/β. Its samples are not N/√Δt: they are those of the instant."""
    density, beta = 0.2, 1e5
    process = FirstOrderGaussMarkov(density * beta, beta)
    frequency, tau = np.array([0.1, 1.0, 10.0]), np.array([0.1, 1.0, 10.0])
    np.testing.assert_allclose(process.density(frequency), White(density).density(frequency), rtol=1e-6)
    ratio = process.allan_variance(tau) / White(density).allan_variance(tau)
    np.testing.assert_allclose(ratio, 1 - 1.5 / (beta * tau), rtol=1e-9)
    # averaged over T = 1000/β, from samples at 0.02/β: variance N²/T (1 − 1/βT)
    interval, count = 0.02 / beta, 50000
    parts = Parts(process, interval)
    covariance = parts.initial.item() * parts.transition.item() ** np.arange(count)
    average = (covariance[0] + 2 * ((1 - np.arange(1, count) / count) * covariance[1:]).sum()) / count
    np.testing.assert_allclose(average, density**2 / (count * interval) * (1 - 1e-3), rtol=1e-4)


# --- flicker noise as one filter


def bank_covariance(process, interval, lags):
    """Autocovariance of independent first-order processes of variance B² ln 4/π each, at lags in samples."""
    times = process.bank(interval)
    return np.log(4) / np.pi * np.exp(-np.multiply.outer(lags, interval / times)).sum(axis=-1)


def test_bank_of_correlation_times():
    for interval, longest in ((0.01, 1e3), (0.0025, 1e5), (1.0, 60.0)):
        times = BiasInstability(1.0, longest).bank(interval)
        np.testing.assert_allclose(times[0], 0.7 * interval, rtol=1e-14)
        np.testing.assert_allclose(times[1:] / times[:-1], 4.0, rtol=1e-14)
        assert longest <= times[-1] < 4 * longest


@pytest.mark.parametrize(
    ("interval", "longest"), [(1.0, 60.0), (0.01, 1e3), (0.1, 1e4), (0.01, 1e5), (0.005, 1e5), (0.0025, 1e6)]
)
def test_one_filter_has_the_law_of_the_bank(interval, longest):
    """The innovations form "has the same law exactly": to 1e-6 in every lag up to the longest correlation time."""
    process = BiasInstability(1.0, longest)
    parts = Parts(process, interval)
    state = scipy.linalg.solve_discrete_lyapunov(parts.transition, parts.pushed)
    lags = np.unique(np.geomspace(1, longest / interval, 60).astype(int))
    decay = np.exp(-interval / process.bank(interval))
    np.testing.assert_allclose(parts.transition, np.diag(decay), rtol=1e-15)
    ahead = parts.transition @ state @ parts.output + parts.drive @ parts.through
    found = (decay ** (lags[:, None] - 1) * ahead) @ parts.output
    none = parts.output @ state @ parts.output + parts.through @ parts.through
    np.testing.assert_allclose(none, bank_covariance(process, interval, 0), rtol=1e-6)
    np.testing.assert_allclose(found, bank_covariance(process, interval, lags), rtol=1e-6)
    # it starts in that law as well: no transient
    np.testing.assert_allclose(parts.initial, state, atol=1e-6 * np.abs(state).max())


@pytest.mark.parametrize(("interval", "longest"), [(0.01, 1e3), (0.1, 1e4), (1.0, 300.0), (0.01, 1e5)])
def test_sampled_allan_deviation_of_flicker_is_flat(interval, longest):
    """Exact for the sampled process: 0.664 B within 2 % from two samples to longest/20, within 9 % at one."""
    process = BiasInstability(1.0, longest)
    most = int(longest / 20 / interval)
    covariance = bank_covariance(process, interval, np.arange(min(2 * most, 400_000) + 1))
    m = np.unique(np.geomspace(1, (len(covariance) - 1) // 2, 40).astype(int))
    deviation = np.sqrt(sampled_allan_variance(covariance, m)) / FLICKER_LEVEL
    assert abs(deviation[0] - 1) < 0.09
    assert deviation[0] > 1.07  # as documented: point samples alias
    np.testing.assert_allclose(deviation[1:], 1.0, atol=0.02)
    np.testing.assert_allclose(process.allan_variance([1.0, 7.0]), FLICKER_LEVEL**2, rtol=1e-14)


def sampled_allan_variance(covariance, m):
    """Allan variance of a stationary sequence at averages of m samples, from its autocovariance."""
    lag = np.arange(len(covariance))
    totals, moments = np.cumsum(covariance), np.cumsum(lag * covariance)

    def spread(m):  # variance of the sum of m samples
        return m * covariance[0] + 2 * (m * (totals[m - 1] - covariance[0]) - moments[m - 1])

    return (4 * spread(m) - spread(2 * m)) / (2.0 * m**2)


@pytest.mark.parametrize(("interval", "longest"), [(0.01, 1e5), (0.1, 1e6)])
def test_spectra_of_the_bank_add_up_to_flicker(interval, longest):
    process = BiasInstability(0.3, longest)
    times = process.bank(interval)
    bank = FirstOrderGaussMarkov.of(0.3 * math.sqrt(math.log(4) / math.pi), times)
    omega = np.geomspace(60 / times[-1], 1 / (60 * times[0]), 300)
    assert omega[-1] / omega[0] > 1e3
    found = bank.density(omega / (2 * np.pi)).sum(axis=0) / (0.3**2 / omega)
    np.testing.assert_allclose(found, 1.0, atol=0.01)
    # beyond the ends of the bank the sum falls short of flicker noise: flat below, steeper above
    ends = np.array([0.1 / times[-1], 10 / times[0]])
    assert np.all(bank.density(ends / (2 * np.pi)).sum(axis=0) / (0.3**2 / ends) < 0.5)


# --- the filter


def random_system(seed, leading, states, inputs):
    generator = np.random.default_rng(seed)
    transition = generator.standard_normal((*leading, states, states))
    if states:
        transition *= 0.97 / np.abs(np.linalg.eigvals(transition)).max(axis=-1)[..., None, None]
    return LinearSystem(
        transition,
        *(
            generator.standard_normal((*leading, *shape))
            for shape in ((states, inputs), (states,), (inputs,), (states,), (states, 2))
        ),
    )


def stepped(system, state, draws):
    """The output, by the state equations one sample after another."""
    a, b, c, d = (np.asarray(each) for each in (system.transition, system.drive, system.output, system.through))
    output = np.empty((*draws.shape[:-2], draws.shape[-1]))
    for k in range(draws.shape[-1]):
        now = draws[..., k]
        output[..., k] = (c * state).sum(axis=-1) + (d * now).sum(axis=-1)
        state = np.einsum("...st,...t->...s", a, state) + np.einsum("...sm,...m->...s", b, now)
    return output, state


@pytest.mark.parametrize(
    ("leading", "states", "inputs", "length", "blocks"),
    [
        ((), 1, 1, 64, 3),
        ((3,), 2, 2, 64, 3),
        ((2, 3), 3, 2, 64, 2),
        ((2, 1, 3), 4, 3, 7, 5),
        ((3,), 2, 0, 64, 2),  # nothing drawn: a ramp
        ((3,), 2, 1, 1, 9),
    ],
)
def test_block_filter_is_the_loop_over_samples(leading, states, inputs, length, blocks):
    system = random_system(states, leading, states, inputs)
    generator = np.random.default_rng(5)
    draws = generator.standard_normal((*leading, inputs, length * blocks))
    state = generator.standard_normal((*leading, states))
    expected, final = stepped(system, state, draws)
    found, after = run(system.blocked(length), state, draws)
    assert found.shape == (*leading, length * blocks)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_allclose(after, final, rtol=1e-12, atol=1e-12 * np.abs(final).max())


@pytest.mark.parametrize("leading", [(), (2, 3)])
def test_combined_system_is_the_sum(leading):
    sizes = [(1, 1), (3, 2), (2, 0), (0, 1)]  # states, inputs
    systems = [random_system(seed, leading, *size) for seed, size in enumerate(sizes)]
    generator = np.random.default_rng(9)
    draws = [generator.standard_normal((*leading, inputs, 128)) for _, inputs in sizes]
    starts = [generator.standard_normal((*leading, states)) for states, _ in sizes]
    expected = sum(stepped(*each)[0] for each in zip(systems, starts, draws, strict=True))
    whole = combine(systems)
    joined = np.concatenate(draws, axis=-2), np.concatenate(starts, axis=-1)
    found, _ = run(whole.blocked(), joined[1], joined[0])
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    # the start: mean joined, spread independent
    np.testing.assert_array_equal(whole.start, np.concatenate([each.start for each in systems], axis=-1))
    spread = np.asarray(whole.root) @ np.swapaxes(whole.root, -1, -2)
    first = np.asarray(systems[1].root) @ np.swapaxes(systems[1].root, -1, -2)
    np.testing.assert_allclose(spread[..., 1:4, 1:4], first, rtol=1e-14)
    np.testing.assert_array_equal(spread[..., 0, 1:], 0.0)


# --- samples

COUNT, UNITS, INTERVAL = 2**15, 16, 0.05


def integral(samples):
    return np.concatenate([np.zeros((*samples.shape[:-1], 1)), np.cumsum(samples, axis=-1)], axis=-1)


def allan_variance(samples, m):
    """Overlapping Allan variance of sequences (..., n) at averages of m samples."""
    return allan_variance_of_integral(integral(samples), m)


def allan_variance_of_integral(totals, m, stride=1):
    """The same from the sums; every `stride`-th difference is used."""
    second = totals[..., 2 * m :: stride] - 2 * totals[..., m:-m:stride] + totals[..., : -2 * m : stride]
    return (second**2).mean(axis=-1) / (2.0 * m**2)


def expected_allan(process, m):
    """Exact Allan variance of the sampled process at averages of m samples, and degrees of freedom of one record.

    z is the difference of two neighbouring averages, of autocovariance g. The estimate is the mean of M values z²/2:
    its mean is g(0)/2, its variance Σ (1 − |l|/M) g(l)²/2M, and that of a χ²-variable of ν degrees scaled to the same
    mean is twice the mean squared over ν.
    """
    window = np.concatenate([np.full(m, -1 / m), np.full(m, 1 / m)])
    furthest = 10 * m
    if isinstance(process, RandomWalk):  # the sum over its independent increments; its own autocovariance grows
        response = -np.cumsum(window)[:-1]
        g = np.correlate(response, response, "full")[len(response) - 1 :] * float(process.K) ** 2 * INTERVAL
        assert len(g) < furthest + 2 * m
    else:
        covariance = Parts(process, INTERVAL).autocovariance(furthest + 2 * m)
        both = np.concatenate([covariance[:0:-1], covariance])
        pair = np.correlate(window, window, "full")
        g = np.convolve(both, pair, "valid")
        g = g[len(g) // 2 :]
    values = COUNT - 2 * m + 1
    lag = np.arange(len(g))
    variance = (g[0] ** 2 + 2 * ((1 - lag / values) * g**2)[1:].sum()) / (2 * values)
    return g[0] / 2, 2 * (g[0] / 2) ** 2 / variance


SIMULATED = [
    White(0.3),
    RandomWalk(0.02),
    FirstOrderGaussMarkov.of(0.1, 40 * INTERVAL),
    SecondOrderGaussMarkov.of(0.1, 20 * INTERVAL),
    Quantisation(1e-3),
    BiasInstability(0.2, 1e3),
]


@pytest.mark.parametrize("process", SIMULATED, ids=lambda p: type(p).__name__)
def test_simulated_allan_deviation(process):
    """48 records pooled against χ²: two-sided 1e-5 for each of the 6 × 6 comparisons, a false alarm in 2800 runs.

    The degrees of freedom pooled are from about 1e6 at one sample to 2800 at 512 (random walk), so that the intervals
    are from 0.5 % to 12 % of the variance.
    """
    samples = np.moveaxis(Noise((process,)).sample(COUNT, 1 / INTERVAL, seed=2024, shape=(UNITS,)), -1, -2)
    assert samples.shape == (UNITS, 3, COUNT)
    for m in (1, 2, 8, 32, 128, 512):
        expected, freedom = expected_allan(process, m)
        freedom *= UNITS * 3
        assert freedom > 2500
        found = allan_variance(samples, m).mean()
        low, high = scipy.stats.chi2.ppf([5e-6, 1 - 5e-6], freedom) / freedom
        assert low < found / expected < high, (m, found / expected, low, high)


@pytest.mark.parametrize(
    ("process", "tolerance"),
    [
        (SIMULATED[0], 1e-9),
        (SIMULATED[1], 1e-4),  # sampled it is 1 + 1/2m² times as much: 3e-5 at 128
        (SIMULATED[2], 1e-3),  # the sum of samples for an integral: (β Δt)²
        (SIMULATED[3], 1e-3),
        (SIMULATED[4], 1e-9),
        (SIMULATED[5], 0.02),  # ripple and ends of the bank
    ],
    ids=lambda p: type(p).__name__,
)
def test_expectation_of_the_samples_is_the_theory(process, tolerance):
    """What the samples are compared with above is, at averages of many samples, the continuous Allan variance."""
    for m in (128, 512):
        expected = process.allan_variance([m * INTERVAL])
        np.testing.assert_allclose(expected_allan(process, m)[0], expected, rtol=tolerance)


def test_expectation_of_a_sampled_random_walk():
    """The figures that are compared with, where they are known by hand: K²τ/3 (1 + 1/2m²)."""
    for m in (1, 2, 30):
        expected = 0.02**2 * m * INTERVAL / 3 * (1 + 1 / (2 * m**2))
        np.testing.assert_allclose(expected_allan(RandomWalk(0.02), m)[0], expected, rtol=1e-12)
    # white noise at one sample: neighbours' difference squared has 3/2 the variance, so ν = 2/3 of their number
    np.testing.assert_allclose(expected_allan(White(0.3), 1)[1], (COUNT - 1) * 2 / 3, rtol=1e-4)


@pytest.mark.parametrize("process", SIMULATED, ids=lambda p: type(p).__name__)
def test_variance_of_the_first_samples(process):
    """The start is in the stationary law (a walk's at zero): 900 first, and 900 hundredth, samples against χ².

    Two-sided 1e-5 for each of 12, a false alarm in 8000 runs; the interval is ±22 %.
    """
    samples = Noise((process,)).sample(128, 1 / INTERVAL, seed=5, shape=(300,))
    for at in (0, 100):
        if isinstance(process, RandomWalk):
            expected = 0.02**2 * INTERVAL * at
        elif isinstance(process, BiasInstability):
            expected = 0.2**2 * bank_covariance(process, INTERVAL, 0)
        else:
            expected = Parts(process, INTERVAL).autocovariance(1)[0]
        squares = (samples[:, at] ** 2).sum()
        if expected == 0:
            assert squares == 0.0
        else:
            low, high = scipy.stats.chi2.ppf([5e-6, 1 - 5e-6], 900)
            assert low < squares / expected < high, at


def test_constants_have_no_allan_deviation():
    samples = Noise((RandomConstant(0.3), BiasRepeatability(0.2))).sample(1024, 100.0, seed=1)
    assert np.abs(samples).min() > 0
    for m in (1, 16, 256):
        np.testing.assert_allclose(allan_variance(samples.T, m), 0.0, atol=1e-25)


@pytest.mark.parametrize(
    ("quantity", "white", "walk", "seed"),
    [("specific_force", 0.019, 5e-4, 11), ("angular_rate", 0.014, 5e-5, 12)],
    ids=["accelerometer", "gyroscope"],
)
def test_white_noise_and_random_walk_are_recovered(quantity, white, walk, seed):
    """N and K (SI) from the Allan variance of simulated samples at 100 Hz, N²/τ + K²τ/3 by weighted least squares.

    Twelve records of 87 minutes each give one estimate; the intervals are Student's over those, 99.9 %: a false alarm
    in 250 runs over the four figures. The known mistake with these figures is to read K, in m/s³/√Hz (rad/s²/√Hz), as
    the bias instability B, which would be flat at 0.664 B: the end of the test excludes it.
    """
    rate, count = 100.0, 2**19
    noise = Noise((White(white), RandomWalk(walk)), quantity)
    samples = np.moveaxis(noise.sample(count, rate, seed=seed, shape=(4,)), -1, -2).reshape(12, count)
    m = np.unique(np.geomspace(1, count // 5, 26).astype(int))
    tau = m / rate
    totals = integral(samples)
    found = np.stack([allan_variance_of_integral(totals, each, max(1, each // 16)) for each in m], axis=-1)
    model = np.stack([1 / tau, tau / 3], axis=-1)
    # an estimate's relative variance goes with τ; the level comes from a first fit to the mean of all records
    level = np.ones_like(tau)
    for _ in range(4):
        weights = 1 / (level * np.sqrt(tau))
        pooled = np.linalg.lstsq(model * weights[:, None], found.mean(axis=0) * weights)[0]
        level = model @ pooled
    each = np.linalg.lstsq(model * weights[:, None], (found * weights).T)[0]  # (2, 12): N² and K² of every record
    mean, error = each.mean(axis=1), each.std(axis=1, ddof=1) / math.sqrt(12)
    margin = scipy.stats.t.ppf(0.9995, 11) * error
    truth = np.array([white**2, walk**2])
    assert np.all(np.abs(mean - truth) < margin), (np.sqrt(np.abs(mean)), margin / truth)
    # the intervals say something: a standard error of 0.03 % of N, of 4 % (accelerometer) and 10 % (gyroscope) of K
    assert np.all(error < [1e-3 * truth[0], 0.35 * truth[1]])
    # theory of the whole: variances add up
    np.testing.assert_allclose(noise.allan_deviation(tau) ** 2, model @ truth, rtol=1e-12)
    mistaken = white**2 / tau[-1] + FLICKER_LEVEL**2 * walk**2
    assert found[:, -1].mean() > 2 * mistaken


# --- the same samples again


def all_processes():
    return (
        White(0.3),
        RandomWalk(0.2),
        FirstOrderGaussMarkov(0.5, 0.3),
        SecondOrderGaussMarkov(0.5, 0.3),
        Quantisation(0.01),
        BiasInstability(0.1, 20.0),
        RateRamp(0.05),
        RandomConstant(0.4),
        BiasRepeatability(0.3),
    )


def test_same_arguments_same_samples():
    noise = Noise(all_processes())
    first = noise.sample(300, 100.0, seed=7, power_on=2, shape=(2,))
    np.testing.assert_array_equal(first, Noise(all_processes()).sample(300, 100.0, seed=7, power_on=2, shape=(2,)))
    # a seed may be several numbers, and one in a sequence is that one
    several = noise.sample(300, 100.0, seed=[7, 1], power_on=2, shape=(2,))
    assert np.abs(several - first).min(axis=1).max() > 0
    np.testing.assert_array_equal(noise.sample(300, 100.0, seed=(7,), power_on=2, shape=(2,)), first)


def test_samples_do_not_change_between_versions():
    """White noise worked out by hand from its key: seed, quantity.kind.count, power-on, unit, axis."""
    found = Noise((White(0.3),)).sample(5, 100.0, seed=7, power_on=2, shape=(2,))
    key = zlib.crc32(b"angular_rate.White.1")
    for unit, axis in itertools.product(range(2), range(3)):
        draws = np.random.default_rng([7, key, 3, unit, axis]).standard_normal(5)
        np.testing.assert_allclose(found[unit, :, axis], 0.3 * math.sqrt(100.0) * draws, rtol=1e-12)


def correlation(first, second):
    return float(np.corrcoef(first, second)[0, 1])


@pytest.mark.parametrize("process", [White(1.0), RandomWalk(1.0)])
def test_other_seeds_power_ons_axes_units_and_quantities_are_independent(process):
    """Whitened, sequences of n = 4096 correlate by 1/√n: within 5.7 of that.

    111 sequences make 6105 pairs for each process, of 1.2e-8 each: a false alarm in 7e3 runs.
    """
    sequences = []
    for quantity, seed, power_on, shape in itertools.product(SI_UNITS, (0, 1), (0, 1), ((), (2,))):
        samples = Noise((process,), quantity).sample(4097, 100.0, seed=seed, power_on=power_on, shape=shape)
        samples = np.moveaxis(samples, -1, -2).reshape(-1, 4097)
        sequences.extend(np.diff(samples) if isinstance(process, RandomWalk) else samples[:, 1:])
    # a second process of the same kind is another one: what it adds is independent of the first
    twice = Noise((process, process)).sample(4097, 100.0) - Noise((process,)).sample(4097, 100.0)
    sequences.extend(np.diff(twice.T) if isinstance(process, RandomWalk) else twice.T[:, 1:])
    table = np.corrcoef(sequences)
    assert len(table) == len(SI_UNITS) * 4 * 9 + 3
    assert np.abs(table - np.eye(len(table))).max() < 5.7 / 64


def test_constant_belongs_to_the_unit_and_repeatability_to_the_power_on():
    """Spreads of 900 values each against χ², two-sided 1e-6: a false alarm in 2e5 runs; the interval is ±23 %."""
    low, high = scipy.stats.chi2.ppf([5e-7, 1 - 5e-7], 900) / 900
    constant, repeated = Noise((RandomConstant(0.4),)), Noise((BiasRepeatability(0.3),))
    first, second = (constant.sample(3, 100.0, seed=3, power_on=at, shape=(300,)) for at in (0, 1))
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(first[:, 0], first[:, 2])
    assert low < (first[:, 0] ** 2).mean() / 0.16 < high
    assert not np.array_equal(first, constant.sample(3, 100.0, seed=4, power_on=0, shape=(300,)))
    assert len(np.unique(first)) == 900  # every axis of every unit has its own
    first, second = (repeated.sample(3, 100.0, seed=3, power_on=at, shape=(300,))[:, 0] for at in (0, 1))
    assert low < (first**2).mean() / 0.09 < high
    assert low < (second**2).mean() / 0.09 < high
    assert low < ((second - first) ** 2).mean() / 0.18 < high
    assert abs(correlation(first.ravel(), second.ravel())) < 5.5 / 30


def test_another_process_leaves_the_samples_of_the_others():
    processes = all_processes()
    together, some, others, backwards = (
        Noise(each).sample(192, 100.0, seed=3)
        for each in (processes, processes[:4], processes[4:], processes[::-1])  # order does not matter between kinds
    )
    np.testing.assert_allclose(together, some + others, rtol=1e-12, atol=1e-12 * np.abs(together).max())
    np.testing.assert_allclose(together, backwards, rtol=1e-12, atol=1e-12 * np.abs(together).max())
    np.testing.assert_array_equal(Noise(()).sample(5, 100.0, shape=(2,)), np.zeros((2, 5, 3)))


@given(
    pieces=st.lists(st.sampled_from((64, 128)), min_size=1, max_size=2),
    last=st.sampled_from((1, 50, 64)),
    rate=st.floats(1.0, 1000.0),
    seed=st.integers(0, 2**64),
)
@example(pieces=[64], last=64, rate=100.0, seed=0)
def test_pieces_are_the_whole(pieces, last, rate, seed):
    # as many processes in the bank at any rate, so that the shapes stay
    flicker = BiasInstability(0.1, 20 / rate)
    noise = Noise((White(0.3), SecondOrderGaussMarkov(0.5, 0.3), Quantisation(0.01), flicker, RandomConstant(0.4)))
    whole = noise.sample(sum(pieces) + last, rate, seed=seed)
    stream = noise.stream(rate, seed)
    found = np.concatenate([np.asarray(stream.take(count)) for count in (*pieces, last)])
    np.testing.assert_allclose(found, whole, rtol=1e-12, atol=1e-12 * np.abs(whole).max())
    if last % 64:
        with pytest.raises(ValueError, match="ended"):
            stream.take(64)


@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2)])
def test_units_with_parameters_of_their_own(shape):
    """Each unit and axis as if it had been given its parameters for all: the draws belong to the place."""
    generator = np.random.default_rng(0)
    sizes = generator.uniform(0.5, 2.0, (*shape, 3))
    rates = generator.uniform(0.1, 1.0, (*shape, 3))

    def noise(size, beta):
        return Noise(
            (
                White(size),
                RandomWalk(size),
                Quantisation(0.01 * size),
                BiasInstability(size, 5.0),
                RateRamp(size),
                RandomConstant(size),
                BiasRepeatability(size),
                FirstOrderGaussMarkov(1.0, beta),
                SecondOrderGaussMarkov(size, beta),
            )
        )

    whole = noise(sizes, rates).sample(100, 50.0, seed=1, shape=shape)
    assert whole.shape == (*shape, 100, 3)
    assert noise(sizes, rates).allan_deviation([1.0, 2.0]).shape == (*shape, 3, 2)
    for place in [(0,) * len(shape) + (2,), (*(length - 1 for length in shape), 0)]:
        alike = noise(sizes[place], rates[place]).sample(100, 50.0, seed=1, shape=shape)
        column = (*place[:-1], slice(None), place[-1])
        np.testing.assert_allclose(whole[column], alike[column], rtol=1e-12, atol=1e-12)


# --- data sheets

DEGREE = math.pi / 180
KINDS = {
    "white noise of a gyroscope": {
        "rad/s/sqrt(Hz)": 1.0,
        "rad/sqrt(s)": 1.0,
        "rad*s^-1/2": 1.0,
        "deg/sqrt(h)": DEGREE / 60,
        "°/√h": DEGREE / 60,
        "deg/√(hr)": DEGREE / 60,
        "deg/h^0.5": DEGREE / 60,
        "deg/h^(1/2)": DEGREE / 60,
        "deg/s/√Hz": DEGREE,
        "dps/sqrt(Hz)": DEGREE,
        "mdps/√Hz": DEGREE / 1000,
        "deg/h/sqrt(Hz)": DEGREE / 3600,
        "dph/√Hz": DEGREE / 3600,
        "arcsec/√s": DEGREE / 3600,
        "urad/sqrt(s)": 1e-6,
    },
    "white noise of an accelerometer": {
        "m/s^2/sqrt(Hz)": 1.0,
        "m/s²/√Hz": 1.0,
        "m/s^3/2": 1.0,
        "m/s/sqrt(s)": 1.0,
        "m/s/sqrt(h)": 1 / 60,
        "m/s/√h": 1 / 60,
        "ug/sqrt(Hz)": 9.80665e-6,
        "µg/√Hz": 9.80665e-6,  # micro sign
        "μg/√Hz": 9.80665e-6,  # Greek mu
        "mg/√Hz": 9.80665e-3,
        "mGal/sqrt(Hz)": 1e-5,
    },
    "bias of a gyroscope": {
        "rad/s": 1.0,
        "deg/h": DEGREE / 3600,
        "°/h": DEGREE / 3600,
        "deg/hr": DEGREE / 3600,
        "deg/s": DEGREE,
        "mdps": DEGREE / 1000,
        "arcsec/s": DEGREE / 3600,
        "mrad/min": 1e-3 / 60,
    },
    "bias of an accelerometer": {"m/s^2": 1.0, "mm/s²": 1e-3, "g": 9.80665, "mg": 9.80665e-3, "ug": 9.80665e-6},
    "random walk of a gyroscope": {
        "rad/s^2/sqrt(Hz)": 1.0,
        "rad/s/sqrt(s)": 1.0,
        "deg/h/sqrt(h)": DEGREE / 3600 / 60,
        "deg/h/h/sqrt(Hz)": DEGREE / 3600**2,
        "deg/s/√h": DEGREE / 60,
    },
    "random walk of an accelerometer": {
        "m/s^3/sqrt(Hz)": 1.0,
        "ug/sqrt(h)": 9.80665e-6 / 60,
        "mg/√h": 9.80665e-3 / 60,
        "ug/s/√Hz": 9.80665e-6,
    },
    "ramp of a gyroscope": {"rad/s^2": 1.0, "deg/h/h": DEGREE / 3600**2, "deg/h^2": DEGREE / 3600**2},
    "ramp of an accelerometer": {"m/s^3": 1.0, "ug/h": 9.80665e-6 / 3600, "mg/s": 9.80665e-3},
    "angle": {"rad": 1.0, "arcsec": DEGREE / 3600, "arcmin": DEGREE / 60, "mdeg": DEGREE / 1000},
    "speed": {"m/s": 1.0, "mm/s": 1e-3},
}


@pytest.mark.parametrize("kind", KINDS)
def test_units_of_a_kind(kind):
    units = KINDS[kind]
    base = next(iter(units))
    for unit, factor in units.items():
        np.testing.assert_allclose(convert(1.0, unit, base), factor, rtol=1e-13)
        np.testing.assert_allclose(convert([1.0, 2.0], base, unit), [1 / factor, 2 / factor], rtol=1e-13)
    # and no other kind's
    for other in KINDS.keys() - {kind}:
        with pytest.raises(InputError, match="different quantities"):
            convert(1.0, base, next(iter(KINDS[other])))


@given(st.sampled_from(sorted(KINDS)), st.data(), st.floats(1e-12, 1e12))
def test_conversion_there_and_back(kind, data, value):
    first, second, third = (data.draw(st.sampled_from(sorted(KINDS[kind]))) for _ in range(3))
    there = convert(value, first, second)
    np.testing.assert_allclose(convert(there, second, first), value, rtol=1e-14)
    np.testing.assert_allclose(convert(there, second, third), convert(value, first, third), rtol=1e-14)
    assert isinstance(there, float)
    np.testing.assert_allclose(parse_quantity(f"{value!r} {first}", second), there, rtol=1e-14)


@pytest.mark.parametrize(
    ("value", "unit", "to", "expected"),
    [
        (0.66, "deg/sqrt(h)", "rad/s/sqrt(Hz)", 1.9199e-4),  # 0.66 · π/180 / √3600
        (0.11, "m/s/sqrt(h)", "m/s^2/sqrt(Hz)", 1.8333e-3),  # 0.11/60
        (14.5, "deg/h", "rad/s", 7.0298e-5),
        (100.0, "ug/sqrt(Hz)", "m/s^2/sqrt(Hz)", 9.80665e-4),
        (5.0, "mdps/sqrt(Hz)", "rad/s/sqrt(Hz)", 8.7266e-5),
        (5.0, "mdps/sqrt(Hz)", "deg/sqrt(h)", 0.3),  # 0.005 °/s/√Hz · 60 √s/√h
        (1.0, "deg/h/sqrt(h)", "rad/s^2/sqrt(Hz)", 8.0802e-8),
        (100.0, "ug/sqrt(Hz)", "m/s/sqrt(h)", 0.0588399),
        (9.0, "deg/h/sqrt(Hz)", "deg/sqrt(h)", 0.15),  # the rule of thumb: °/√h = °/h/√Hz / 60
    ],
)
def test_known_figures(value, unit, to, expected):
    assert convert(value, unit, to) == pytest.approx(expected, rel=1e-4)
    assert convert(expected, to, unit) == pytest.approx(value, rel=1e-4)


def only(noise):
    (process,) = noise.processes
    return process


def test_white_noise_from_a_data_sheet():
    gyroscope, accelerometer = "angular_rate", "specific_force"
    sheet = Noise.from_datasheet
    found = only(sheet(gyroscope, white="0.66 deg/sqrt(h)"))
    assert isinstance(found, White)
    assert found.N == pytest.approx(1.9199e-4, rel=1e-4)
    assert only(sheet(accelerometer, white="0.11 m/s/√h")).N == pytest.approx(1.8333e-3, rel=1e-4)
    assert only(sheet(gyroscope, white=2e-4)).N == 2e-4  # a number is in SI
    assert only(sheet(gyroscope, white="2e-4")).N == 2e-4
    two = sheet(accelerometer, white="100 ug/sqrt(Hz)", density="two-sided")
    one = sheet(accelerometer, white="100 ug/√Hz", density="one-sided")
    assert only(two).N == pytest.approx(9.80665e-4, rel=1e-12)
    assert only(one).N == pytest.approx(9.80665e-4 / math.sqrt(2), rel=1e-12)
    # an angle random walk is N itself; which side a density counts has nothing to do with it
    walk = sheet(gyroscope, white="0.66 deg/sqrt(h)", density="one-sided")
    assert only(walk).N == pytest.approx(1.9199e-4, rel=1e-4)
    # per sample: 0.05 °/s at 100 Hz is 0.005 °/s/√Hz
    assert only(sheet(gyroscope, white="0.05 deg/s", rate=100.0)).N == pytest.approx(0.005 * DEGREE, rel=1e-12)
    assert only(sheet(accelerometer, white="3 mg", rate=400.0)).N == pytest.approx(9.80665e-3 * 3 / 20, rel=1e-12)


def test_bias_stability_means_two_things():
    sheet = Noise.from_datasheet
    as_b = only(sheet("angular_rate", bias_instability="14.5 deg/h", bias_instability_is="B"))
    as_minimum = only(sheet("angular_rate", bias_instability="14.5 deg/h", bias_instability_is="allan-minimum"))
    assert isinstance(as_b, BiasInstability)
    assert as_b.B == pytest.approx(7.0298e-5, rel=1e-4)
    assert as_minimum.B == pytest.approx(7.0298e-5 / 0.66428, rel=1e-4)
    np.testing.assert_allclose(np.sqrt(as_minimum.allan_variance([100.0])), 7.0298e-5, rtol=1e-4)


def test_other_figures_from_a_data_sheet():
    noise = Noise.from_datasheet(
        "specific_force",
        rate_random_walk="6 ug/sqrt(h)",
        quantisation="2 mm/s",
        rate_ramp="3.6 ug/h",
        repeatability="2 mg",
        bias="10 mg",
    )
    found = {type(each): each for each in noise.processes}
    assert len(found) == len(noise.processes) == 5
    assert found[RandomWalk].K == pytest.approx(9.80665e-7, rel=1e-12)
    assert found[Quantisation].Q == pytest.approx(2e-3, rel=1e-12)
    assert found[RateRamp].R == pytest.approx(9.80665e-9, rel=1e-12)
    assert found[BiasRepeatability].sigma == pytest.approx(2 * 9.80665e-3, rel=1e-12)
    assert found[RandomConstant].sigma == pytest.approx(10 * 9.80665e-3, rel=1e-12)
    assert Noise.from_datasheet("angular_rate").processes == ()


@given(st.sampled_from("NK"), st.floats(1e-9, 1e3), st.floats(1e-2, 1e5))
def test_continuous_and_discrete(term, value, rate):
    sigma = to_discrete(term, value, rate)
    expected = value * math.sqrt(rate) if term == "N" else value / math.sqrt(rate)
    np.testing.assert_allclose(sigma, expected, rtol=1e-14)
    np.testing.assert_allclose(from_discrete(term, sigma, rate), value, rtol=1e-14)
    # the same that the processes are sampled with
    parts = Parts(White(value) if term == "N" else RandomWalk(value), 1 / rate)
    np.testing.assert_allclose(parts.through[0] if term == "N" else parts.drive[0, 0], sigma, rtol=1e-12)


def test_discrete_by_axis():
    np.testing.assert_allclose(to_discrete("N", [1.0, 2.0, 3.0], 100.0), [10.0, 20.0, 30.0], rtol=1e-15)
    np.testing.assert_allclose(from_discrete("K", [1.0, 2.0, 3.0], 100.0), [10.0, 20.0, 30.0], rtol=1e-15)


def test_figures_as_a_data_sheet_would_state_them():
    noise = Noise.from_datasheet(
        "angular_rate",
        white="0.66 deg/sqrt(h)",
        bias_instability="14.5 deg/h",
        bias_instability_is="B",
        rate_random_walk="3 deg/h/sqrt(h)",
        quantisation="2 arcsec",
        rate_ramp="1 deg/h/h",
        repeatability="5 deg/h",  # no term of the Allan deviation: not listed
    )
    rows = {row["term"]: row for row in noise.figures(100.0)}
    assert list(rows) == ["N", "B", "K", "Q", "R"]
    customary = {"N": 0.66, "B": 14.5, "K": 3.0, "Q": 2.0, "R": 1.0}
    meanings = ["white noise", "bias instability", "rate random walk", "quantisation", "rate ramp"]
    assert [row["meaning"] for row in rows.values()] == meanings
    for term, row in rows.items():
        assert row["customary"] == pytest.approx(customary[term], rel=1e-12)
        assert row["unit"] == SI_UNITS["angular_rate"][term]
        assert row["customary_unit"] == DATASHEET_UNITS["angular_rate"][term]
        assert row["value"] == pytest.approx(convert(customary[term], row["customary_unit"], row["unit"]), rel=1e-12)
        assert ("per_sample" in row) == (term in "NK")
    assert rows["N"]["per_sample"] == pytest.approx(1.9199e-3, rel=1e-4)
    assert rows["K"]["per_sample"] == pytest.approx(3 * 8.0802e-8 / 10, rel=1e-4)
    assert all("per_sample" not in row for row in noise.figures())
    # an accelerometer's, by axis
    (row,) = Noise((RandomWalk([1e-3, 2e-3, 3e-3]),), "specific_force").figures(100.0)
    assert (row["unit"], row["customary_unit"]) == ("m/s^3/sqrt(Hz)", "ug/sqrt(h)")
    assert row["value"] == [1e-3, 2e-3, 3e-3]
    np.testing.assert_allclose(row["customary"], np.array([1e-3, 2e-3, 3e-3]) * 60 / 9.80665e-6, rtol=1e-12)
    np.testing.assert_allclose(row["per_sample"], [1e-4, 2e-4, 3e-4], rtol=1e-12)


@pytest.mark.parametrize("quantity", SI_UNITS)
def test_customary_units_are_of_the_terms(quantity):
    assert list(SI_UNITS[quantity]) == list(DATASHEET_UNITS[quantity]) == list("QNBKR")
    for term, unit in SI_UNITS[quantity].items():
        assert parse_unit(unit).factor == 1.0
        assert parse_unit(unit).dimension == parse_unit(DATASHEET_UNITS[quantity][term]).dimension


def test_theory_of_several_processes_adds_up_variances():
    noise = Noise((White([1.0, 2.0, 3.0]), RandomWalk(0.5), RandomConstant(9.0)))
    tau = np.array([0.5, 4.0])
    expected = np.sqrt(np.array([1.0, 4.0, 9.0])[:, None] / tau + 0.25 * tau / 3)
    np.testing.assert_allclose(noise.allan_deviation(tau), expected, rtol=1e-14)
    np.testing.assert_array_equal(Noise().allan_deviation(tau), 0.0)


# --- bad input


def refused(call, *words):
    """The call raises InputError with a plain sentence that has these words in it."""
    with pytest.raises(InputError) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith(".")
    for word in words:
        assert word in message, message
    assert caught.value.exit_status == 2


@pytest.mark.parametrize(
    ("figures", "words"),
    [
        ({"white": "-1 deg/sqrt(h)"}, ["negative"]),
        ({"white": -1.0}, ["negative"]),
        ({"white": math.nan}, ["N", "nan"]),
        ({"white": math.inf}, ["N", "inf"]),
        ({"white": "nan deg/sqrt(h)"}, ["nan deg/sqrt(h)"]),
        ({"white": "much"}, ["much"]),
        ({"white": "1 furlong/sqrt(h)"}, ["furlong"]),
        ({"white": "1 deg/sqrt(fortnight)"}, ["fortnight"]),
        ({"white": "1 ug/sqrt(Hz)", "density": "two-sided"}, ["white", "ug/sqrt(Hz)", "rad/s/sqrt(Hz)"]),
        ({"white": "1 deg"}, ["white", "deg"]),
        ({"white": "1 deg/h"}, ["white", "1 deg/h", "rate"]),  # per sample, were it meant; its rate is missing
        ({"white": "1 deg/h/sqrt(h)"}, ["white", "deg/h/sqrt(h)"]),
        ({"white": "5 mdps/√Hz"}, ["density", "one-sided", "two-sided"]),
        ({"white": "5 mdps/√Hz", "density": "both"}, ["density", "one-sided", "two-sided"]),
        ({"white": "0.05 deg/s", "rate": 0.0}, ["rate", "positive"]),
        ({"white": "0.05 deg/s", "rate": -100.0}, ["rate", "positive"]),
        ({"white": "0.05 deg/s", "rate": math.nan}, ["rate", "positive"]),
        ({"bias_instability": "14.5 deg/h"}, ["bias_instability_is", "allan-minimum"]),
        ({"bias_instability": "14.5 deg/h", "bias_instability_is": "minimum"}, ["bias_instability_is", "B"]),
        ({"bias_instability": "14.5 deg/sqrt(h)", "bias_instability_is": "B"}, ["bias_instability", "deg/sqrt(h)"]),
        ({"bias_instability": "-14.5 deg/h", "bias_instability_is": "B"}, ["negative"]),
        ({"rate_random_walk": "1 deg/sqrt(h)"}, ["rate_random_walk", "deg/sqrt(h)"]),
        ({"quantisation": "1 deg/h"}, ["quantisation", "deg/h"]),
        ({"rate_ramp": "1 deg/h"}, ["rate_ramp", "deg/h"]),
        ({"repeatability": "1 mg"}, ["repeatability", "mg"]),
        ({"bias": "1 m/s^2"}, ["bias", "m/s^2"]),
        ({"bias": True}, ["bias", "True"]),
    ],
    ids=str,
)
def test_bad_data_sheets(figures, words):
    refused(lambda: Noise.from_datasheet("angular_rate", **figures), *words)


def test_unknown_quantity():
    refused(lambda: Noise((White(1.0),), "temperature"), "temperature", "angular_rate", "specific_force")
    refused(lambda: Noise.from_datasheet("temperature", white=1.0), "temperature", "angular_rate")


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf, [1.0, -1.0, 1.0]])
def test_bad_parameters(value):
    for kind in (White, RandomWalk, Quantisation, RateRamp, RandomConstant, BiasRepeatability, BiasInstability):
        refused(lambda kind=kind: kind(value), kind.__name__)
    for kind in (FirstOrderGaussMarkov, SecondOrderGaussMarkov):
        refused(lambda kind=kind: kind(value, 1.0), kind.__name__, "q")
        refused(lambda kind=kind: kind(1.0, value), kind.__name__, "beta")
    refused(lambda: BiasInstability(1.0, value), "BiasInstability", "longest")


def test_second_order_needs_decay():
    refused(lambda: SecondOrderGaussMarkov(1.0, 0.0), "SecondOrderGaussMarkov", "beta", "positive")
    refused(lambda: SecondOrderGaussMarkov(1.0, [1.0, 0.0, 1.0]), "SecondOrderGaussMarkov", "beta", "positive")


@pytest.mark.parametrize("kind", [FirstOrderGaussMarkov, SecondOrderGaussMarkov])
def test_correlation_time_of_zero(kind):
    refused(lambda: kind.of(1.0, 0.0), kind.__name__)


def test_flicker_needs_a_longest_time():
    refused(lambda: Noise((BiasInstability(1.0, 0.0),)).sample(64, 100.0), "BiasInstability", "longest")


@pytest.mark.parametrize("rate", [0.0, -100.0, math.nan])
def test_bad_rates(rate):
    refused(lambda: Noise((White(1.0),)).stream(rate), "rate", "positive")
    refused(lambda: Noise((White(1.0),)).figures(rate), "rate", "positive")
    for conversion in (to_discrete, from_discrete):
        refused(lambda conversion=conversion: conversion("N", 1.0, rate), "rate", "positive")


def test_only_white_noise_and_random_walk_are_discrete():
    refused(lambda: to_discrete("B", 1.0, 100.0), "'B'", "N", "K")


@pytest.mark.parametrize(
    "unit",
    ["/h", "deg/", "deg h", "deg//h", "deg√h", "sqrt()", "√", "^2", "m/s^", "(deg/h)", "deg/s/rtHz", "Deg/h"]
    + ["m/s^1.2.3", "m/s^.", "m/s^1/0", "g^400"],  # powers that are no numbers, and one that is no float
)
def test_units_that_are_not_understood(unit):
    refused(lambda: parse_unit(unit), repr(unit))


FRAGMENTS = ["deg", "rad", "m", "g", "ug", "s", "h", "Hz", "1", "/", "*", "·", "^", "²", "sqrt(", "√", "(", ")", "-"]


@given(st.one_of(st.lists(st.sampled_from([*FRAGMENTS, "2", "3", ".", " ", "/0"]), max_size=8).map("".join), st.text()))
@example("m^1/0")
@example("s^..")
def test_any_text_is_a_unit_or_refused(text):
    try:
        unit = parse_unit(text)
    except InputError:
        refused(lambda: parse_unit(text), repr(text))
    else:
        assert isinstance(unit, DensityUnit)
        assert unit.factor > 0


@pytest.mark.parametrize("text", ["", "abc", "deg/h", "1,5 deg/h", "1e5e deg/h", "--1 deg/h", None, True])
def test_quantities_that_are_not_understood(text):
    refused(lambda: parse_quantity(text, "rad/s", "bias"), "bias")


@pytest.mark.parametrize(
    ("text", "expected"),
    [("7", 7.0), (" 1.5e-3 rad/s ", 1.5e-3), ("1.5e-3rad/s", 1.5e-3), ("+.5 rad/s", 0.5), ("5. rad/s", 5.0), (3, 3.0)],
)
def test_quantities(text, expected):
    assert parse_quantity(text, "rad/s") == expected
