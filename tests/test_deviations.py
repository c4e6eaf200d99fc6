"""Deviations of the Allan family: published figures, an independent reference, gaps, batches, coverage of intervals."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom

from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.model import Noise, Quantisation, RandomWalk, White
from jaximu.noise import averaging_factors, deviation
from jaximu.noise.deviations import _BLOCK, KINDS, degrees_of_freedom

EVERY = pytest.mark.parametrize("kind", KINDS)
FILES = {
    "allan": ("adev_octave", "adev"), "overlapping": ("oadev_octave", "oadev"), "modified": ("mdev_octave",),
    "hadamard": ("hdev_octave",), "overlapping-hadamard": ("ohdev_octave",), "total": ("totdev_octave",),
}  # fmt: skip


def reference(phase, m, kind) -> tuple[float, int]:
    """A deviation written out as SP 1065 defines it, one difference at a time (τ0 = 1), and how many there are."""
    n = len(phase)
    step = m if kind in ("allan", "hadamard") else 1
    if kind in ("allan", "overlapping"):
        found = [phase[i + 2 * m] - 2 * phase[i + m] + phase[i] for i in range(0, n - 2 * m, step)]
    elif kind in ("hadamard", "overlapping-hadamard"):
        found = [
            phase[i + 3 * m] - 3 * phase[i + 2 * m] + 3 * phase[i + m] - phase[i] for i in range(0, n - 3 * m, step)
        ]
    elif kind == "modified":
        found = [
            np.mean([phase[i + j + 2 * m] - 2 * phase[i + j + m] + phase[i + j] for j in range(m)])
            for i in range(n - 3 * m + 1)
        ]
    else:

        def mirrored(i):
            if i < 0:
                return 2 * phase[0] - phase[-i]
            return 2 * phase[-1] - phase[2 * (n - 1) - i] if i > n - 1 else phase[i]

        found = [mirrored(i - m) - 2 * mirrored(i) + mirrored(i + m) for i in range(1, n - 1)]
    return np.sqrt(np.mean(np.square(found)) / (6 if "hadamard" in kind else 2)) / m, len(found)


def nbs14() -> np.ndarray:
    """The 1000 test points of NIST SP 1065, a linear congruential generator."""
    numbers = [1234567890]
    for _ in range(999):
        numbers.append(16807 * numbers[-1] % 2147483647)
    return np.array(numbers) / 2147483647


@EVERY
def test_stable32_on_phase_dat(kind, data_folder):
    """Stable32's printed figures: sigma to its five digits, counts; its 68.3 % limits to a few parts in a thousand.

    The limits from eight averaged samples on: Stable32 takes phase points for means over a sample, which matters below.
    """
    folder = data_folder / "allan_reference"
    phase = np.loadtxt(folder / "PHASE.DAT")
    for name in FILES[kind]:
        table = np.loadtxt(folder / f"phase_dat_{name}.txt")
        factors = table[:, 0].astype(int)
        found = deviation(phase, 1.0, kind, factors, phase=True, confidence=0.683, exponent=0)
        assert (np.abs(found.value - table[:, 5]) <= 0.5001 * 10.0 ** (np.floor(np.log10(table[:, 5])) - 4)).all()
        np.testing.assert_array_equal(found.count, table[:, 2])
        if name.endswith("octave"):
            several = factors >= 8
            np.testing.assert_allclose(found.low[several], table[several, 4], rtol=3e-3)
            np.testing.assert_allclose(found.high[several], table[several, 6], rtol=3e-3)


NBS14 = {  # NIST SP 1065, table 31; τ = 1, 10, 100
    "allan": (2.922319e-1, 9.965736e-2, 3.897804e-2),
    "overlapping": (2.922319e-1, 9.159953e-2, 3.241343e-2),
    "modified": (2.922319e-1, 6.172376e-2, 2.170921e-2),
    "hadamard": (2.943883e-1, 1.052754e-1, 3.910861e-2),
    "overlapping-hadamard": (None, 9.581083e-2, 3.237638e-2),
    "total": (None, 9.134743e-2, 3.406530e-2),
}


@EVERY
def test_nbs14_to_all_printed_digits(kind):
    found = deviation(nbs14(), 1.0, kind, [1, 10, 100]).value
    for value, printed in zip(found, NBS14[kind], strict=True):
        if printed is not None:
            assert f"{value:.6e}" == f"{printed:.6e}"


@EVERY
def test_definitions_written_out(kind):
    rng = np.random.default_rng(3)
    signal = rng.standard_normal((2, 61)) + np.cumsum(rng.standard_normal((2, 61)), axis=1) + 50.0
    factors = averaging_factors(61, kind, 100)
    found = deviation(signal, 4.0, kind, factors)
    for axis in range(2):
        phase = np.concatenate([[0], np.cumsum(signal[axis])]) / 4.0
        for k, m in enumerate(factors):
            value, count = reference(phase * 4.0, int(m), kind)  # in units of the sample interval
            assert found.value[axis, k] == pytest.approx(value, rel=1e-9)
            assert found.count[axis, k] == count
    integral = np.concatenate([np.zeros((2, 1)), np.cumsum(signal, axis=1)], axis=1) / 4.0
    np.testing.assert_allclose(deviation(integral, 4.0, kind, factors, phase=True).value, found.value, rtol=1e-8)
    np.testing.assert_allclose(found.tau, factors / 4.0)


@EVERY
@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2)])
def test_batches_and_straight_lines(kind, shape):
    """Leading axes are axes and units; an offset changes nothing, a ramp nothing of the Hadamard deviations."""
    signal = np.random.default_rng(1).standard_normal((*shape, 64))
    found = deviation(signal, 10.0, kind, [1, 4, 8])
    assert found.value.shape == found.low.shape == found.exponent.shape == (*shape, 3)
    for place in np.ndindex(*shape):
        alone = deviation(signal[place], 10.0, kind, [1, 4, 8])
        np.testing.assert_allclose(found.value[place], alone.value, rtol=1e-9)
        np.testing.assert_allclose(found.high[place], alone.high, rtol=1e-9)
    ramp = 1e3 + (0.1 * np.arange(64) if "hadamard" in kind else 0.0)
    np.testing.assert_allclose(deviation(signal + ramp, 10.0, kind, [1, 4, 8]).value, found.value, rtol=1e-7)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), kind=st.sampled_from([kind for kind in KINDS if kind != "total"]))
def test_gaps_leave_out_what_would_reach_over_them(seed, kind):
    rng = np.random.default_rng(seed)
    signal = rng.standard_normal(256)
    signal[rng.integers(10, 246, 3)] = np.nan
    found = deviation(signal, 1.0, kind, [1, 2, 4])
    edges = np.concatenate([[-1], np.flatnonzero(np.isnan(signal)), [256]])
    step = 1
    for k, m in enumerate((1, 2, 4)):
        squares, count = 0.0, 0
        for first, last in pairwise(edges):
            part = signal[first + 1 : last]
            span = (3 if "hadamard" in kind else 2) * m + (m - 1 if kind == "modified" else 0)
            if kind in ("allan", "hadamard"):  # on one grid through the whole recording
                step = m
            starts = [i for i in range(first + 1, last - span + 1) if i % step == 0]
            phase = np.concatenate([[0], np.cumsum(part)])
            for i in starts:
                value, number = reference(phase[i - first - 1 : i - first + span], m, kind)
                assert number == 1
                squares, count = squares + value**2, count + 1
        # the modified deviation may leave out one place beside a gap
        slack = 2 * (len(edges) - 2) if kind == "modified" else 0
        assert count - slack <= found.count[k] <= count
        if not slack:
            assert found.value[k] == pytest.approx(np.sqrt(squares / count), rel=1e-9)


def test_white_noise_and_walk_have_their_slopes_and_exponents():
    rate, samples = 50.0, 1 << 15
    for process, exponent, slope in ((White(1e-3), 0, -0.5), (RandomWalk(1e-4), -2, 0.5), (Quantisation(1e-4), 2, -1)):
        signal = Noise((process,)).sample(samples, rate, seed=2).T
        found = deviation(signal, rate, "overlapping", [4, 16, 64])
        np.testing.assert_array_equal(found.exponent, exponent)
        measured = np.polyfit(np.log(found.tau), np.log(found.value.mean(axis=0)), 1)[0]
        assert measured == pytest.approx(slope, abs=0.06)
        np.testing.assert_allclose(found.value.mean(axis=0), np.sqrt(process.allan_variance(found.tau)), rtol=0.08)


@pytest.mark.parametrize(("process", "exponent"), [(White(1.0), 0), (RandomWalk(1.0), -2)], ids=["white", "walk"])
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "hadamard"])
def test_intervals_cover_at_their_rate(kind, process, exponent):
    """400 records of 512 samples: coverage of 90 % intervals within its 99.99 % binomial bound, each averaging time."""
    if kind == "modified" or (kind == "total" and exponent):
        truth = None  # the modified deviation has another constant, the total one a bias: against the records' mean
    else:
        truth = process.allan_variance(np.array([4.0, 16.0, 64.0]))
    records = Noise((process,)).sample(512, 1.0, seed=7, shape=(134,)).transpose(0, 2, 1).reshape(-1, 512)[:400]
    found = deviation(records, 1.0, kind, [4, 16, 64], confidence=0.9, exponent=exponent)
    if truth is None or "hadamard" in kind:
        truth = np.mean(found.value**2, axis=0)
    covered = np.sum((found.low**2 <= truth) & (truth <= found.high**2), axis=0)
    low, high = binom.ppf([5e-5, 1 - 5e-5], 400, 0.9)
    # the mean of 400 stands for the truth in some cases, and chi-squared is an approximation: two records of leeway
    assert ((low - 2 <= covered) & (covered <= high + 2)).all(), covered


def test_degrees_of_freedom_by_published_examples():
    """White noise: two thirds of the differences of neighbours; the closed form for overlapping ones."""
    assert degrees_of_freedom("overlapping", 1001, 1, 0) == pytest.approx(2 / 3 * 999, rel=1e-3)
    for points, factor in ((1001, 1), (1001, 8), (4097, 32)):
        n, m = points, factor
        closed = (3 * (n - 1) / (2 * m) - 2 * (n - 2) / n) * 4 * m**2 / (4 * m**2 + 5)  # SP 1065, table 6, white FM
        assert degrees_of_freedom("overlapping", points, factor, 0) == pytest.approx(closed, rel=0.025)
    assert degrees_of_freedom("overlapping", 100_001, 1000, 0) == pytest.approx(
        degrees_of_freedom("overlapping", 1001, 10, 0), rel=0.02
    )


def test_the_exponent_of_a_short_tail_is_the_last_that_could_be_told():
    signal = np.random.default_rng(0).standard_normal(1000)
    found = deviation(signal, 1.0, factors=[1, 10, 100, 499]).exponent
    assert found[2] == found[3] == found[1]


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: deviation([1.0, 2.0], 1.0), NotPossibleError, "at least three samples"),
        (lambda: deviation(np.ones(10), 0.0), InputError, "rate must be a positive"),
        (lambda: deviation(np.ones(10), np.nan), InputError, "rate must be a positive"),
        (lambda: deviation(np.ones(10), 1.0, "alan"), InputError, "must be one of allan"),
        (lambda: deviation(np.ones(10), 1.0, factors=[6]), NotPossibleError, "allow averaging over 1 to 4"),
        (lambda: deviation(np.ones(10), 1.0, factors=[0]), NotPossibleError, "allow averaging over 1 to 4"),
        (lambda: deviation(np.ones(10), 1.0, confidence=1.0), InputError, "confidence"),
        (lambda: deviation([1.0, np.inf, 2.0, 3.0], 1.0), InputError, "infinite"),
        (lambda: deviation([1.0, np.nan, 2.0, 3.0, 4.0], 1.0, "total"), InputError, "mirrors the recording"),
        (lambda: deviation([1.0, np.nan, 2.0, 3.0, 4.0], 1.0, phase=True), InputError, "one curve"),
        (lambda: deviation([1.0, np.nan] * 10, 1.0, factors=[1]), NotPossibleError, "fewer than two differences"),
        (lambda: averaging_factors(10, spacing="third"), InputError, "spacing must be"),
        (lambda: averaging_factors(2), NotPossibleError, "too few"),
    ],
)
def test_what_makes_no_sense_is_refused(make, error, words):
    with pytest.raises(error, match=words):
        make()


def test_a_constant_signal_has_no_deviation():
    found = deviation(np.full(100, 3.0), 1.0)
    assert (found.value == 0).all() and np.isfinite(found.high).all()


@EVERY
def test_averaging_factors(kind):
    for spacing in ("octave", "decade", 20):
        found = averaging_factors(1000, kind, spacing)
        assert found[0] == 1 and (np.diff(found) > 0).all()
        assert (deviation(np.random.default_rng(0).standard_normal(1000), 1.0, kind, found[-1:]).count >= 2).all()


# --- blocks, threads, few phase points ----------------------------------------------------------


def plain(phase, factors, spoiled=None):
    """Overlapping Allan variances (τ0 = 1) and counts of a phase (n,), written out with arrays."""
    found, counts = [], []
    for m in factors:
        difference = phase[2 * m :] - 2 * phase[m:-m] + phase[: -2 * m]
        if spoiled is not None:
            difference = difference[spoiled[2 * m :] == spoiled[: -2 * m]]
        found.append(np.mean(difference**2) / 2 / m**2)
        counts.append(len(difference))
    return np.array(found), np.array(counts)


def integrated(signal):
    """The phase of a signal (n,) about its mean, and what is missing before each of its points."""
    lost = np.isnan(signal)
    phase = np.concatenate([[0.0], np.cumsum(np.where(lost, 0.0, signal - np.nanmean(signal)))])
    return phase, np.concatenate([[0], np.cumsum(lost)])


EDGES = [2047, _BLOCK - 1, _BLOCK, _BLOCK + 2, 2 * _BLOCK + 1, 4 * _BLOCK + 2053]


@pytest.mark.parametrize("samples", EDGES)
@pytest.mark.parametrize("gaps", [False, True])
def test_blocks_hold_every_difference_once(samples, gaps):
    """At the edges of blocks, of several axes with more than there are threads; gaps in some axes."""
    rng = np.random.default_rng(samples)
    signal = rng.standard_normal((5, samples)) + 0.01 * np.cumsum(rng.standard_normal((5, samples)), axis=1)
    if gaps:
        signal[1, [0, samples // 2, -1]] = np.nan
        signal[3, samples // 3 : samples // 3 + 7] = np.nan
    longest = samples // 8 if gaps else (samples - 1) // 2
    factors = np.unique(np.round(np.geomspace(1, longest, 12)).astype(int))
    for resolution in ("full", "multi"):
        found = deviation(signal, 1.0, factors=factors, exponent=0, resolution=resolution)
        for axis, series in enumerate(signal):
            phase, spoiled = integrated(series)
            for k, m in enumerate(found.factor):
                step = 1 if resolution == "full" else step_of(m)
                variance, count = plain(phase[::step], [m // step], spoiled[::step])
                assert found.value[axis, k] ** 2 == pytest.approx(variance[0] / step**2, rel=1e-10)
                assert found.count[axis, k] == count[0]


def step_of(factor):
    """The distance of the phase points that an average is taken of: a power of two that leaves 32 to 64 of them."""
    return max(1, 1 << int(np.floor(np.log2(factor / 32)))) if factor >= 32 else 1


def test_multi_resolution_reports_the_times_it_took():
    samples = 40_000
    asked = averaging_factors(samples, spacing=60)
    found = deviation(np.random.default_rng(0).standard_normal(samples), 20.0, factors=asked, resolution="multi")
    assert (found.factor[found.factor < 64] == asked[asked < 64]).all()
    nearest = np.abs(asked[:, None] / found.factor - 1).min(axis=1)
    assert nearest[:-1].max() <= 1 / 64 and nearest[-1] <= 1 / 32  # the last average must leave two differences
    steps = np.array([step_of(m) for m in found.factor])
    assert (found.factor % steps == 0).all()
    np.testing.assert_allclose(found.tau, found.factor / 20.0)
    np.testing.assert_array_equal(found.count, samples // steps + 1 - 2 * (found.factor // steps))
    # neighbours that come to the same multiple are told once
    dense = deviation(
        np.random.default_rng(0).standard_normal(4000), 1.0, factors=range(1000, 1017), resolution="multi"
    )
    np.testing.assert_array_equal(dense.factor, [1008, 1024])


def covariance_of_differences(alpha, factor, lags):
    """Autocovariance of second differences of the phase of white noise (α = 0) or a random walk (−2), by definition.

    A difference is a sum of the process's innovations with known weights: the covariance is that of the weights.
    """
    weights = np.concatenate([-np.ones(factor), np.ones(factor)])
    if alpha == -2:
        weights = np.cumsum(weights[::-1])[::-1]  # a step enters all samples after it
    whole = np.correlate(weights, weights, "full")[len(weights) - 1 :]
    return np.array([whole[k] if k < len(whole) else 0.0 for k in lags])


def spread(alpha, samples, factor, step):
    """Relative variance of the estimated variance: 2/n² Σ (n − |k|) ρ_k²; exact for Gaussian noise."""
    n = (samples - 2 * factor) // step + 1
    lags = np.arange(min(n, 2 * factor // step + 1))
    rho = covariance_of_differences(alpha, factor, lags * step) / covariance_of_differences(alpha, factor, [0])
    terms = (n - lags) * rho**2
    return 2 * (2 * terms.sum() - terms[0]) / n**2


@pytest.mark.parametrize(("alpha", "limit"), [(0, 1.3e-3), (-2, 1e-4)])
@pytest.mark.parametrize("factor", [64, 96, 126, 128, 512])
def test_the_loss_by_few_points_is_small(alpha, limit, factor):
    step, samples = step_of(factor), 400 * factor
    lost = spread(alpha, samples, factor, step) / spread(alpha, samples, factor, 1) - 1
    assert -1e-3 < lost < limit
    if alpha == 0:
        closed = 5 / 4 * ((step / factor) ** 2 - 1 / factor**2)
        assert lost == pytest.approx(closed, rel=0.25)


@pytest.mark.parametrize(("process", "alpha"), [(White(1.0), 0), (RandomWalk(1.0), -2)], ids=["white", "walk"])
def test_multi_resolution_is_close_to_full_as_theory_says(process, alpha):
    """200 records: the two variances differ by no more than Var(few) − Var(all) allows, and their means agree.

    The full estimator is nearly the best of its kind, so that the difference has about the variance that is lost; that
    of the difference is computed here from the innovations' weights without assuming so.
    """
    samples, factor = 2048, 192
    step = step_of(factor)
    records = Noise((process,)).sample(samples, 1.0, seed=5, shape=(67,)).transpose(0, 2, 1).reshape(-1, samples)[:200]
    full, multi = (
        deviation(records, 1.0, factors=[factor], exponent=alpha, resolution=each) for each in ("full", "multi")
    )
    assert multi.factor[0] == factor
    ratio = (multi.value**2 - full.value**2)[:, 0] / process.allan_variance(np.array([float(factor)]))
    # Var(a − b) = 2 Σ_ij (w_i − v_i)(w_j − v_j) ρ_ij² with the weights of both means on all places
    places = samples - 2 * factor + 1
    weight = np.full(places, -1 / places)
    weight[::step] += 1 / len(weight[::step])
    lags = np.arange(places)
    rho = covariance_of_differences(alpha, factor, lags) / covariance_of_differences(alpha, factor, [0])
    across = np.abs(lags[:, None] - lags)
    expected = np.sqrt(2 * weight @ (rho[across] ** 2) @ weight)
    assert abs(ratio.mean()) < 4 * expected / np.sqrt(200)
    # chi-squared of 200 records; the differences are quadratic in normal numbers: twice the normal spread of a variance
    assert ratio.std() == pytest.approx(expected, rel=4 * 2 / np.sqrt(2 * 200))


@pytest.mark.parametrize("alpha", [0, -1, -2])
def test_freedom_of_few_points_is_that_of_many(alpha):
    """Few points lose as little of the degrees of freedom as of the variance."""
    signal = np.random.default_rng(0).standard_normal(100_000)
    full, multi = (
        deviation(signal, 1.0, factors=[64, 1024, 8192], exponent=alpha, resolution=each) for each in ("full", "multi")
    )
    np.testing.assert_allclose(multi.freedom, full.freedom, rtol=5e-3)
    # white phase noise: every phase point is independent, and those left out are lost
    quantised = deviation(signal, 1.0, factors=[1024], exponent=2, resolution="multi")
    assert quantised.freedom[0] <= quantised.count[0] == 100_000 // 32 + 1 - 64


def test_exponents_by_the_averages_written_out():
    """The lag-1 autocorrelation of averages taken one after the other, as SP 1065 defines it."""
    rng = np.random.default_rng(4)
    white = rng.standard_normal(20_000)
    for signal in (white, np.cumsum(white), np.diff(white, prepend=0.0), white + 0.02 * np.cumsum(white[::-1])):
        factors = averaging_factors(len(signal), spacing=30)
        expected: list[int] = []
        for m in factors:
            series = signal[: len(signal) // m * m].reshape(-1, m).mean(axis=1)
            if len(series) < 30:
                expected.append(expected[-1])
                continue
            order = 0
            while True:
                centred = series - series.mean()
                r = centred[1:] @ centred[:-1] / (centred @ centred)
                delta = r / (1 + r)
                if delta < 0.25 or order == 2:
                    break
                series, order = np.diff(series), order + 1
            expected.append(int(np.clip(np.round(-2 * (delta + order)), -4, 2)))
        np.testing.assert_array_equal(deviation(signal, 1.0, factors=factors).exponent, expected)


def test_multi_resolution_is_refused_where_it_is_not_defined():
    for kind in KINDS:
        if kind != "overlapping":
            with pytest.raises(InputError, match="multi-resolution deviation is the overlapping"):
                deviation(np.ones(100), 1.0, kind, resolution="multi")
    with pytest.raises(InputError, match="resolution must be one of full, multi"):
        deviation(np.ones(100), 1.0, resolution="half")
    with pytest.raises(NotPossibleError, match="fewer than two differences"):
        deviation(np.where(np.arange(1000) % 100 == 50, np.nan, 1.0), 1.0, factors=[100], resolution="multi")


@pytest.mark.parametrize(
    ("kind", "count"), [("overlapping", 2000), ("overlapping", 450), ("overlapping-hadamard", 2000)]
)
def test_freedom_of_white_phase_is_that_of_its_draws(kind, count):
    """Twice the squared mean over the variance of what 4000 recordings give; 7 % is three sigmas of that ratio."""
    factor, order = 120, 2 if kind == "overlapping" else 3
    phase = np.random.default_rng(5).normal(size=(4000, count))
    differences = phase
    for _ in range(order):
        differences = differences[:, factor:] - differences[:, :-factor]
    squares = np.mean(differences**2, axis=1)
    drawn = 2 * squares.mean() ** 2 / squares.var()
    assert degrees_of_freedom(kind, count, factor, 2) == pytest.approx(drawn, rel=0.07)
