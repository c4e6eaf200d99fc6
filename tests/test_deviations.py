"""Deviations of the Allan family: published figures, an independent reference, gaps, batches, coverage of intervals."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom

from jaximu.errors import InputError, NotPossibleError
from jaximu.noise import Noise, Quantisation, RandomWalk, White, averaging_factors, deviation
from jaximu.noise.deviations import KINDS, degrees_of_freedom, power_law

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
    found = power_law(signal, [1, 10, 100, 500])
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
