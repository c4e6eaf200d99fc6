"""Covariances of averages against integrals and simulated processes, and the bank fitted to a unit at rest."""

import numpy as np
import pytest
import scipy.integrate
import scipy.signal
import scipy.stats
from synthetic import recording as posed

from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.model import Noise
from jaximu.model.noise_model import AxisNoise, NoiseModel, fit_bank
from jaximu.model.processes import BiasInstability, FirstOrderGaussMarkov, Quantisation, RandomWalk, White
from jaximu.noise.at_rest import fit_noise
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.segmentation import Segmentation, observed_poses

G = 9.80665


def bank(sigma, time, white=0.0, quantisation=0.0):
    """All axes alike."""
    sigma = np.atleast_1d(np.asarray(sigma, float))
    return AxisNoise(
        np.full(3, float(white)), np.full(3, float(quantisation)), np.tile(sigma**2, (3, 1)),
        np.atleast_1d(np.asarray(time, float)),
    )  # fmt: skip


def markov(random, sigma, time, interval, shape):
    """Samples (*shape) of a stationary Gauss–Markov process along the last axis, by its exact recursion."""
    decay = np.exp(-interval / time)
    drive = sigma * np.sqrt(-np.expm1(-2 * interval / time)) * random.standard_normal(shape)
    drive[..., 0] = sigma * random.standard_normal(shape[:-1])
    return scipy.signal.lfilter([1.0], [1.0, -decay], drive, axis=-1)


def at_rest(force, rate=None, frequency=100.0):
    time = np.arange(len(force)) / frequency
    turning = None if rate is None else Signal(time, rate, "rad/s")
    return Recording(Signal(time, force, "m/s^2"), turning)


def white_poses(frequency=100.0, unit=1.0, scale=1.0):
    """Poses with white noise, and a segmentation of them that is the truth; outputs times `scale`."""
    made, rests = posed(3, poses=9, rates=(frequency, frequency), density=(1e-6, 1e-9))
    if scale != 1.0:
        made = Recording(*(
            Signal(each.time, each.values * scale, "count", np.full(3, scale))
            for each in (made.accelerometer, made.gyroscope)
        ))  # fmt: skip
    return Segmentation(made, rests, 1.0, {}, ())


# --- the integral and the covariance of means ------------------------------------------------------------------------


@pytest.mark.parametrize("time", [0.05, 1.0, 40.0])
@pytest.mark.parametrize("length", [0.1, 3.0, 20.0])
def test_the_integrals_variance_is_the_double_integral_of_the_autocovariance(time, length):
    noise = bank([0.7, 0.2], [time, 3 * time], white=0.09)

    def autocovariance(lag):
        return 0.49 * np.exp(-abs(lag) / time) + 0.04 * np.exp(-abs(lag) / (3 * time))

    inner = scipy.integrate.dblquad(lambda s, t: autocovariance(t - s), 0, length, 0, lambda t: t, epsrel=1e-9)[0]
    found = noise.integrated(length)
    np.testing.assert_allclose(2 * found, 2 * inner + 0.09 * length, rtol=1e-6)
    np.testing.assert_array_equal(noise.integrated(-length), found)
    np.testing.assert_array_equal(noise.integrated(0.0), 0.0)


@pytest.mark.parametrize(
    "intervals", [((0, 2), (2, 5)), ((0, 2), (1, 4)), ((0, 2), (7, 8)), ((0, 9), (2, 3)), ((1, 4), (1, 4))]
)
def test_the_covariance_of_two_means_is_a_double_integral(intervals):
    (a, b), (c, d) = intervals
    noise = bank(0.5, 3.0, white=0.04)
    found = noise.covariance([a, c], [b, d])
    expected = scipy.integrate.dblquad(lambda s, t: 0.25 * np.exp(-abs(t - s) / 3), a, b, c, d, epsabs=1e-8)[0]
    shared = max(min(b, d) - max(a, c), 0) * 0.04
    assert found[0, 0, 1] == pytest.approx((expected + shared) / ((b - a) * (d - c)), rel=1e-5)
    assert found[0, 1, 0] == pytest.approx(found[0, 0, 1], rel=1e-12)


def test_the_covariance_of_means_against_drawn_processes():
    """Adjacent, overlapping, nested and distant intervals; claimed and drawn covariance compared by eigenvalues."""
    random = np.random.default_rng(0)
    interval, samples, draws = 0.02, 1500, 4000
    start = np.array([0.0, 2.0, 4.0, 5.0, 5.5, 20.0, 29.0])
    stop = np.array([2.0, 4.0, 6.0, 10.0, 6.5, 28.0, 30.0])
    values = np.zeros((draws, samples))
    for sigma, time in ((0.5, 1.0), (0.3, 8.0), (0.6, 200.0)):
        values += markov(random, sigma, time, interval, (draws, samples))
    values += 0.2 / np.sqrt(interval) * random.standard_normal((draws, samples))
    centre = (np.arange(samples) + 0.5) * interval
    means = np.stack([values[:, (centre > a) & (centre < b)].mean(axis=1) for a, b in zip(start, stop, strict=True)])
    noise = bank([0.5, 0.3, 0.6], [1.0, 8.0, 200.0], white=0.04)
    weights = noise.whitening(start, stop)[0]
    white = weights @ (means @ means.T / draws) @ weights.T
    edge = np.sqrt(len(white) / draws)
    eigenvalues = np.linalg.eigvalsh(white)
    assert (1 - edge) ** 2 - 0.04 < eigenvalues[0]
    assert eigenvalues[-1] < (1 + edge) ** 2 + 0.04
    # and without the ties between intervals it would not pass
    alone = np.diag(1 / np.sqrt(np.diag(noise.covariance(start, stop)[0])))
    assert np.linalg.eigvalsh(alone @ (means @ means.T / draws) @ alone)[-1] > 2


def test_whitening_is_lower_triangular_and_whitens():
    noise = AxisNoise(
        np.array([1.0, 2, 3]), np.array([0.1, 0, 0]), np.array([[1.0, 2], [0, 4], [5, 0]]), np.array([3.0, 50.0])
    )
    start = np.arange(12) * 5.5
    weights = noise.whitening(start, start + 4)
    covariance = noise.covariance(start, start + 4)
    np.testing.assert_array_equal(weights, np.tril(weights))
    np.testing.assert_allclose(
        weights @ covariance @ weights.transpose(0, 2, 1), np.tile(np.eye(12), (3, 1, 1)), atol=1e-10
    )
    assert not np.allclose(covariance[0], covariance[1])  # axes are told apart


# --- limits ----------------------------------------------------------------------------------------------------------


def test_short_correlation_is_white_noise():
    """σ² 2τ held, τ → 0: the density of white noise."""
    start = np.array([0.0, 4.0, 8.0, 30.0])
    white = AxisNoise.of_white(0.5).covariance(start, start + 4)
    np.testing.assert_allclose(white, np.tile(np.eye(4) * 0.5 / 4, (3, 1, 1)), atol=1e-15)
    for time, off in ((1e-2, 3e-3), (1e-4, 3e-5)):
        fast = bank(np.sqrt(0.5 / (2 * time)), time).covariance(start, start + 4)
        np.testing.assert_allclose(fast, white, atol=off * 0.125)


def test_long_correlation_is_a_random_walk_to_differences():
    """σ² = K² τ/2, τ → ∞: differences of means are those of a random walk of K."""
    start, length, walk = np.array([0.0, 5.0, 12.0, 60.0]), 4.0, 0.3
    stop = start + length
    noise = bank(walk * np.sqrt(1e6 / 2), 1e6).covariance(start, stop)[0]
    contrast = np.eye(4)[1:] - np.eye(4)[0]
    # cov of means of a walk from zero: K² min(s, t) averaged over both intervals
    expected = np.empty((4, 4))
    grid = (np.arange(400) + 0.5) / 400 * length
    for i in range(4):
        for j in range(4):
            expected[i, j] = walk**2 * np.minimum.outer(start[i] + grid, start[j] + grid).mean()
    np.testing.assert_allclose(contrast @ noise @ contrast.T, contrast @ expected @ contrast.T, rtol=5e-4)


def test_covariance_keeps_its_digits_for_long_correlation():
    """Minutes against years: differences of means must not cancel away, nor the matrix lose its definiteness."""
    start = np.arange(40) * 5.5
    noise = bank(1e-3, 1e8, white=1e-6)
    covariance = noise.covariance(start, start + 4)[0]
    assert np.linalg.eigvalsh(covariance)[0] > 0
    contrast = np.eye(40)[1:] - np.eye(40)[0]
    drift = contrast @ (covariance - np.eye(40) * 1e-6 / 4) @ contrast.T
    # a walk of K² = 2σ²/τ over the time between, in variance 2·10⁻¹⁴ s⁻¹ · t: far below the white part
    assert np.abs(drift).max() < 1e-8


def test_allan_variance_is_that_of_the_processes():
    tau = np.geomspace(0.02, 1000, 30)
    axis = np.array([1.0, 2.0, 0.5])
    noise = AxisNoise(0.04 * axis, 9e-4 * axis, np.stack([0.5 * axis, 0.3 * axis], axis=1), np.array([2.0, 70.0]))
    expected = sum(
        process.allan_variance(tau)
        for process in (
            White(0.2 * np.sqrt(axis)), Quantisation(0.03 * np.sqrt(axis)),
            FirstOrderGaussMarkov.of(np.sqrt(0.5 * axis), 2.0), FirstOrderGaussMarkov.of(np.sqrt(0.3 * axis), 70.0),
        )
    )  # fmt: skip
    np.testing.assert_allclose(noise.allan_variance(tau), expected.T, rtol=1e-9)


def test_split_keeps_the_covariance_of_long_means():
    noise = bank([0.3, 0.2, 0.1], [0.01, 0.1, 30.0], white=0.01)
    density, slow = noise.split(0.25)
    np.testing.assert_allclose(density, 0.01 + 2 * (0.09 * 0.01 + 0.04 * 0.1))
    assert slow.correlation_time.tolist() == [30.0]
    start = np.arange(5) * 6.0
    whole = noise.covariance(start, start + 5)
    parts = slow.covariance(start, start + 5) + np.eye(5) * density[:, None, None] / 5
    np.testing.assert_allclose(parts, whole, rtol=0.03, atol=1e-5)


def test_split_keeps_quantisation_noise():
    """Of an integrating gyroscope it may be all the noise a short pose has: 2 Q²/T² must not be lost."""
    noise = bank(np.zeros(0), np.zeros(0), white=1e-8, quantisation=1e-6)
    density, slow = noise.split(0.25)
    found = slow.covariance([0.0], [1.0])[:, 0, 0] + density
    np.testing.assert_allclose(found, noise.covariance([0.0], [1.0])[:, 0, 0], rtol=0.05)


# --- the fit ---------------------------------------------------------------------------------------------------------

_WHITE, _FLICKER = 1e-3, 5e-4
STARTS = np.arange(50) * 5.5


def flicker(seconds, seed, frequency=20.0, longest=300.0):
    noise = Noise((White(_WHITE), BiasInstability(_FLICKER, longest)), "specific_force")
    return noise.sample(int(seconds * frequency), frequency, seed=seed)


def means_of(values, frequency):
    edges = np.round(STARTS * frequency).astype(int)
    return np.stack([values[a : a + int(4 * frequency)].mean(axis=0) for a in edges], axis=1)  # (3, poses)


def test_a_fitted_model_whitens_other_recordings():
    """χ²/dof of differences between pose means, of recordings that were not fitted, over several units."""
    whole, white_only, freedom = 0.0, 0.0, 0
    one = np.ones((len(STARTS), 1))
    for seed in range(6):
        model = fit_noise(at_rest(flicker(3600, [seed, 0]) + [0, 0, G], frequency=20.0)).accelerometer
        assert model.duration == pytest.approx(3600, rel=1e-6)
        weights = model.whitening(STARTS, STARTS + 4)
        for other in (1, 2):
            means = means_of(flicker(STARTS[-1] + 4, [seed, other]), 20.0)
            for axis in range(3):
                for weight in (weights[axis], np.eye(len(STARTS)) / (_WHITE / 2)):
                    q = np.linalg.qr(weight @ one)[0]
                    rest = weight @ means[axis]
                    rest = rest - q @ (q.T @ rest)
                    if np.shares_memory(weight, weights):
                        whole += rest @ rest
                        freedom += len(rest) - 1
                    else:
                        white_only += rest @ rest
    assert whole / freedom == pytest.approx(1.0, abs=4 * np.sqrt(2 / freedom) + 0.03)
    assert white_only / freedom > 1.5  # white noise alone would not do


def test_a_fit_gives_the_allan_variance_of_theory():
    tau = np.array([1.0, 10.0, 60.0])
    theory = Noise((White(_WHITE), BiasInstability(_FLICKER, 300.0)), "specific_force").allan_deviation(tau) ** 2
    found = [
        fit_noise(at_rest(flicker(3600, [seed, 0]) + [0, 0, G], frequency=20.0)).accelerometer.allan_variance(tau)
        for seed in range(4)
    ]
    # B is flat but for its end at 300 s; the mean of twelve axes
    np.testing.assert_allclose(np.mean(found, axis=(0, 2)), theory, rtol=0.15)


@pytest.mark.parametrize("process", [RandomWalk(2e-5), FirstOrderGaussMarkov.of(5e-4, 20.0)])
def test_other_slow_processes_are_modelled_too(process):
    noise = Noise((White(_WHITE), process), "specific_force")
    ratios = []
    for seed in range(4):
        model = fit_noise(at_rest(noise.sample(3600 * 20, 20.0, seed=seed), frequency=20.0)).accelerometer
        other = means_of(noise.sample(int(20 * (STARTS[-1] + 4)), 20.0, seed=[seed, 1]), 20.0)
        weights = model.whitening(STARTS, STARTS + 4)
        for axis in range(3):
            q = np.linalg.qr(weights[axis] @ np.ones((len(STARTS), 1)))[0]
            rest = weights[axis] @ other[axis]
            ratios.append(np.sum((rest - q @ (q.T @ rest)) ** 2) / (len(rest) - 1))
    assert np.mean(ratios) == pytest.approx(1.0, abs=4 * np.sqrt(2 / (12 * 49)) + 0.03)


def test_half_an_hour_at_rest_tells_how_large_a_random_walk_is():
    """By the change of a mean from one quarter of an hour to the next, of which few ordinates of the spectrum know."""
    random, frequency, density = np.random.default_rng(6), 4.0, 0.05
    steps = random.standard_normal((40, 3, 7200)) / np.sqrt(frequency)
    values = density * np.cumsum(steps, axis=-1) + random.standard_normal(steps.shape) * np.sqrt(frequency)
    stated = np.stack([2 * fit_bank(unit, frequency).drift().allan_variance(900.0) for unit in values])
    truth = density**2 * 2 * 900 / 3
    assert 0.65 < np.exp(np.mean(np.log(stated / truth)) / 2) < 1.3  # 0.38 where a walk is taken for flicker noise


@pytest.mark.parametrize(
    ("top", "bottom"),
    [([0.3], [1, -0.7]), (np.ones(4) / 4, [1]), scipy.signal.butter(2, 0.3)],
    ids=["first order", "moving average", "second order"],
)
def test_low_pass_filtered_output(top, bottom):
    """Sensors filter their output: a pose's mean has the density at frequency zero, whatever happens near Nyquist's."""
    random = np.random.default_rng(1)
    gain = float(np.sum(top) / np.sum(bottom))
    values = 0.01 * scipy.signal.lfilter(top, bottom, random.standard_normal((100 * 1200, 3)), axis=0)
    model = fit_noise(at_rest(values + [0, 0, G]))
    expected = 0.01**2 * gain**2 / 100 / 4
    found = model.accelerometer.covariance([0.0], [4.0])[:, 0, 0]
    # 300 independent means of 4 s tell their variance to 8 %: three times that, of nine draws
    np.testing.assert_allclose(found, expected, rtol=0.25)


def test_low_pass_filtered_output_is_not_taken_for_a_wrong_unit():
    random = np.random.default_rng(2)
    values = scipy.signal.lfilter([0.3], [1, -0.7], random.standard_normal((100 * 1800, 6)), axis=0)
    model = fit_noise(at_rest(0.01 * values[:, :3] + [0, 0, G], 3e-4 * values[:, 3:]))
    observations = observed_poses(white_poses(), G, noise=model)
    variance = np.asarray(observations.poses.accelerometer_covariance)[0, 0, 0]
    assert variance == pytest.approx(model.accelerometer.covariance([0.0], [2.0])[0, 0, 0], rel=0.15)


@pytest.mark.parametrize(("amplitude", "frequency"), [(0.02, 23.7), (0.005, 1.3)])
def test_a_periodic_line_is_no_noise(amplitude, frequency):
    """Mains or a motor on the bench where the unit rested: `jaximu allan` takes it out, and so must the model."""
    random = np.random.default_rng(4)
    values = 0.01 * random.standard_normal((100 * 1200, 3))
    line = amplitude * np.sin(2 * np.pi * frequency * np.arange(len(values)) / 100)
    model = fit_noise(at_rest(values + line[:, None] + [0, 0, G])).accelerometer
    np.testing.assert_allclose(model.covariance([0.0], [4.0])[:, 0, 0], 1e-6 / 4, rtol=0.15)


def test_gaps_leave_the_longest_whole_part():
    values = flicker(1200, 5) + [0, 0, G]
    time = np.arange(len(values)) / 20.0
    keep = np.ones(len(values), bool)
    keep[6000:6100] = False  # five seconds: the longest part is what follows
    keep[12000:12003] = False  # three samples are bridged
    model = fit_noise(Recording(Signal(time[keep], values[keep], "m/s^2")))
    assert model.accelerometer.duration == pytest.approx((len(values) - 6100) / 20, rel=1e-6)
    assert model.gyroscope is None
    assert len(model.notes) == 1
    assert "gaps" in model.notes[0]
    whole = fit_noise(Recording(Signal(time[6100:], values[6100:], "m/s^2")))
    assert not whole.notes
    np.testing.assert_allclose(
        model.accelerometer.allan_variance([1.0, 10.0]), whole.accelerometer.allan_variance([1.0, 10.0]), rtol=0.02
    )


@pytest.mark.parametrize("count", [2, 6])
def test_outliers_do_not_make_noise(count):
    """Single samples far off are no motion, either: a lost bit now and then in twenty minutes."""
    values = flicker(1200, 6)
    spiked = values.copy()
    spiked[3000 + 3000 * np.arange(count), np.arange(count) % 3] += 1.0
    clean, found = (fit_noise(at_rest(v + [0, 0, G], frequency=20.0)).accelerometer for v in (values, spiked))
    np.testing.assert_allclose(found.allan_variance([1.0]), clean.allan_variance([1.0]), rtol=0.02)


def test_what_cannot_be_fitted_is_said():
    random = np.random.default_rng(3)
    noise = 0.01 * random.standard_normal((30000, 3))
    with pytest.raises(NotPossibleError, match="too few"):
        fit_noise(at_rest(noise[:900]))
    with pytest.raises(NotPossibleError, match="did not rest"):
        moving = noise.copy()
        moving[10000:10500] += 3 * np.sin(np.arange(500) / 10)[:, None]
        fit_noise(at_rest(moving))
    with pytest.raises(NotPossibleError, match="never changes"):
        fit_noise(at_rest(noise * [1, 1, 0]))
    with pytest.raises(InputError, match="gyroscope: every row reads"):
        fit_noise(at_rest(noise, 0 * noise))
    with pytest.raises(InputError, match="unevenly"):
        time = np.cumsum(random.uniform(0.005, 0.02, 30000))
        fit_noise(Recording(Signal(time, noise, "m/s^2")))


def test_counts_are_turned_into_si():
    values = flicker(600, 7)
    time = np.arange(len(values)) / 20.0
    scale = np.array([1000.0, 2000.0, 500.0])
    plain = fit_noise(Recording(Signal(time, values, "m/s^2"))).accelerometer
    counted = fit_noise(Recording(Signal(time, values * scale + 300, "count", scale, np.full(3, 300.0))))
    np.testing.assert_allclose(counted.accelerometer.allan_variance([1.0]), plain.allan_variance([1.0]), rtol=1e-6)


# --- in the observations ---------------------------------------------------------------------------------------------


def test_observations_carry_the_model():
    """Pose covariances, ties between poses and turns' parts, and the density are those of the model."""
    part = white_poses()
    slow = bank([0.02, 0.05], [30.0, 0.05], white=1e-5)
    rates = bank([3e-4], [20.0], white=1e-8)
    observations = observed_poses(part, G, noise=NoiseModel(slow, rates))
    a, b = part.intervals.T
    count = len(a)
    expected = slow.covariance(a, b)
    np.testing.assert_allclose(np.asarray(observations.slow.accelerometer)[:, :count, :count], expected, rtol=0.06)
    covariance = np.asarray(observations.poses.accelerometer_covariance)
    np.testing.assert_allclose(covariance[:count, 0, 0], expected[0].diagonal(), rtol=0.06)
    np.testing.assert_array_equal(covariance[count:], np.tile(np.eye(3), (len(covariance) - count, 1, 1)))
    np.testing.assert_allclose(np.asarray(observations.turns.noise), np.eye(3) * 1e-8)
    # the gyroscope: poses, then four parts of every turn, in time
    padded, steps = len(observations.poses.mask), len(observations.turns.mask)
    ties = np.asarray(observations.slow.gyroscope)
    assert ties.shape == (3, padded + 4 * steps, padded + 4 * steps)
    quarter = (a[1:] - b[:-1]) / 4
    start = np.concatenate([a, (b[:-1, None] + quarter[:, None] * np.arange(4)).ravel()])
    stop = np.concatenate([b, (b[:-1, None] + quarter[:, None] * np.arange(1, 5)).ravel()])
    places = np.concatenate([np.arange(count), padded + np.arange(4 * (count - 1))])
    whole = bank([3e-4], [20.0]).covariance(start, stop)
    whole[:, np.arange(count), np.arange(count)] += 1e-8 / (b - a)
    np.testing.assert_allclose(ties[:, places[:, None], places], whole, rtol=1e-9)
    part_of = np.asarray(observations.slow.part)
    used = np.asarray(observations.turns.interval) > 0
    for k in range(count - 1):
        sizes = np.bincount(part_of[k][used[k]], minlength=4)
        assert np.all(np.diff(part_of[k][used[k]]) >= 0)
        assert sizes.max() - sizes.min() <= 2


def test_counts_in_the_observations():
    """Outputs a hundred times as large have covariances ten thousand times as large."""
    model = NoiseModel(bank(0.02, 30.0, white=1e-5), bank(3e-4, 20.0, white=1e-8))
    plain, counted = (observed_poses(white_poses(scale=scale), G, noise=model) for scale in (1.0, 100.0))
    count = int(np.sum(plain.poses.mask))
    for name in ("accelerometer", "gyroscope"):
        first, second = (np.asarray(getattr(each.slow, name))[:, :count, :count] for each in (plain, counted))
        np.testing.assert_allclose(second, 1e4 * first, rtol=1e-9)
        first, second = (np.asarray(getattr(each.poses, f"{name}_covariance"))[:count] for each in (plain, counted))
        np.testing.assert_allclose(second, 1e4 * first, rtol=1e-9)
    np.testing.assert_allclose(counted.turns.noise, 1e4 * plain.turns.noise, rtol=1e-12)


def test_two_recordings_are_not_tied_to_each_other():
    model = NoiseModel(bank(0.02, 300.0, white=1e-5), bank(3e-4, 200.0, white=1e-8))
    part = white_poses()
    observations = observed_poses([part, part], G, noise=model)
    count = len(part.intervals)
    ties = np.asarray(observations.slow.accelerometer)
    np.testing.assert_array_equal(ties[:, :count, count : 2 * count], 0.0)
    np.testing.assert_allclose(ties[:, :count, :count], ties[:, count : 2 * count, count : 2 * count])
    single = np.asarray(observed_poses(part, G, noise=model).slow.gyroscope)
    both = np.asarray(observations.slow.gyroscope)
    padded, alone = len(observations.poses.mask), single.shape[-1] - 4 * (count_turns(single, count) - 1)
    assert alone >= count
    # the second recording's first turn stands after the empty one between the recordings
    first = padded + 4 * count + np.arange(4)
    # but for the second's bias, which is free
    np.testing.assert_allclose(both[0][np.ix_(first, np.arange(count, 2 * count))] - 0.05**2,
                               both[0][np.ix_(padded + np.arange(4), np.arange(count))], rtol=1e-6)  # fmt: skip
    np.testing.assert_array_equal(both[0][np.ix_(first, np.arange(count))], 0.0)
    between = padded + 4 * (count - 1) + np.arange(4)
    np.testing.assert_array_equal(both[0][np.ix_(between, between)], np.eye(4))
    assert not np.asarray(observations.turns.mask)[count - 1]


def test_a_recording_shifted_onto_the_first_does_not_tell_the_bias_again():
    """`observe` takes each recording's mean rate off against the first one's: its slow bias is that of the first."""
    model = NoiseModel(bank(0.02, 300.0, white=1e-5), bank(3e-4, 500.0, white=1e-9))
    part = white_poses()
    count = len(part.intervals)
    observations = observed_poses([part, part], G, noise=model)
    claimed = np.asarray(observations.slow.gyroscope)[0, : 2 * count, : 2 * count]
    one = np.ones(2 * count)
    estimator = np.linalg.solve(claimed, one) / (one @ np.linalg.solve(claimed, one))
    single = model.gyroscope.covariance(*part.intervals.T)[0]
    draws = np.random.default_rng(0).standard_normal((2, 4000, count)) @ np.linalg.cholesky(single).T
    draws[1] += (np.median(draws[0], axis=1) - np.median(draws[1], axis=1))[:, None]
    true = np.var(np.concatenate(list(draws), axis=1) @ estimator)
    assert 1 / (one @ np.linalg.solve(claimed, one)) == pytest.approx(true, rel=0.15)


def count_turns(ties, poses):
    """Poses P of a padding with P + 4 (P − 1) intervals."""
    assert poses > 0
    return (ties.shape[-1] + 4) // 5


def test_a_model_that_does_not_fit_the_recording_is_refused():
    part = white_poses()
    good = NoiseModel(bank(0.02, 30.0, white=1e-6), bank(3e-4, 20.0, white=1e-9))
    observed_poses(part, G, noise=good)
    with pytest.raises(InputError, match="no gyroscope"):
        observed_poses(part, G, noise=NoiseModel(good.accelerometer))
    # rounded to 1 mm/s² while the noise is said to be of nanometres: a noise in other units
    made = part.recording
    rounded = Signal(made.accelerometer.time, np.round(made.accelerometer.values, 3), "m/s^2")
    coarse = Segmentation(Recording(rounded, made.gyroscope), part.intervals, 1.0, {}, ())
    observed_poses(coarse, G, noise=good)
    with pytest.raises(InputError, match="other units"):
        observed_poses(coarse, G, noise=NoiseModel(bank(0.0, 30.0, white=1e-18), good.gyroscope))


def test_without_a_gyroscope_poses_alone_are_tied():
    part = white_poses()
    alone = Segmentation(Recording(part.recording.accelerometer), part.intervals, 1.0, {}, ())
    observations = observed_poses(alone, G, noise=NoiseModel(bank(0.02, 30.0, white=1e-6)))
    a, b = part.intervals.T
    np.testing.assert_allclose(
        np.asarray(observations.slow.accelerometer)[:, : len(a), : len(a)],
        bank(0.02, 30.0, white=1e-6).covariance(a, b), rtol=1e-9,
    )  # fmt: skip
