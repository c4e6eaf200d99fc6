"""A noise model that is wrong by a factor or a kind is found, named and put right; a right one is left alone."""

from dataclasses import replace
from types import SimpleNamespace

import hidden_effects as hidden
import numpy as np
import pytest
import scipy.stats
from scipy.signal import lfilter

from jaximu import LocalGravity, read_recording
from jaximu.cli.diagnose import give_diagnosis
from jaximu.cli.options import Results
from jaximu.diagnosis import diagnose
from jaximu.diagnosis.noise import NOISE_NAMES, _bands, quadratic_tail, quick_noise
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.noise.at_rest import fit_noise

GRAVITY = LocalGravity(hidden.GRAVITY, 0.0)
RATE, PARTS, SAMPLES = 100.0, 40, 400
LEVEL = 0.05


def drawn(noise: AxisNoise, random, parts=PARTS, samples=SAMPLES):
    """Still parts of the noise: white, and exact first-order recursions, each part with a bias of its own."""
    found = np.sqrt(noise.white * RATE) * random.standard_normal((parts, samples, 3))
    for variance, time in zip(noise.variance.T, noise.correlation_time, strict=True):
        kept = np.exp(-1 / (RATE * time))
        kicks = random.standard_normal((parts, samples, 3)) * np.sqrt(variance * (1 - kept**2))
        start = random.standard_normal((parts, 1, 3)) * np.sqrt(variance)
        found += lfilter([1], [1, -kept], np.concatenate([start, kicks], axis=1), axis=1)[:, 1:]
    return list(found + random.standard_normal((parts, 1, 3)))


def resting(accelerometer, gyroscope):
    parts = {"accelerometer": accelerometer, "gyroscope": gyroscope}
    return SimpleNamespace(still_parts=lambda triad: (parts[triad], RATE))


def model(scale=1.0):
    white = AxisNoise.of_white(scale**2 * np.array([1.0, 2.0, 3.0]))
    return replace(
        white,
        variance=scale**2 * np.array([[0.5, 2.0], [1.0, 1.0], [1.5, 4.0]]),
        correlation_time=np.array([1.0, 60.0]),
    )


BOTH = NoiseModel(model(), model())


def test_sums_of_whitened_means_are_chi_squared():
    """200 recordings: the probability integrals are uniform, and the middle part tells the variance, too."""
    random = np.random.default_rng(1)
    shares, usual = [], []
    for _ in range(200):
        bands = _bands(drawn(model(), random, 12), RATE, model())
        shares.append([scipy.stats.chi2.cdf(square, freedom) for square, freedom, _ in bands])
        usual.append([each[2] for each in bands])
    for band in np.moveaxis(np.array(shares), 1, 0):
        assert scipy.stats.kstest(band.ravel(), "uniform").pvalue > 1e-3
    np.testing.assert_allclose(np.mean(usual, axis=(0, 2)), 1.0, atol=0.05)


def test_right_noise_raises_no_finding():
    """The level is a tenth of 5 %, the thresholds in size make it less: in 300 recordings two at most."""
    random = np.random.default_rng(2)
    findings = 0
    for _ in range(300):
        found, kept = quick_noise(resting(drawn(model(), random, 10), drawn(model(), random, 10)), BOTH, LEVEL)
        findings += bool(found)
        assert found or kept is not None
    assert findings <= scipy.stats.binom.isf(1e-3, 300, LEVEL / 10)


@pytest.mark.parametrize("factor", [0.7, 1.3, 2.0])
def test_white_noise_off_by_a_factor(factor):
    random = np.random.default_rng(3)
    still = resting(drawn(model(factor), random), drawn(model(), random))
    (found,), put_right = quick_noise(still, BOTH, LEVEL)
    assert found.name == "noise.white"
    assert found.axes == tuple(f"{triad} {axis}" for triad in ("accelerometer", "gyroscope") for axis in "xyz")
    assert np.all(np.abs(found.factor - np.repeat([factor, 1.0], 3)) < 4 * found.sigma)
    assert found.sigma.max() < 0.05 * factor
    assert not found.weak
    np.testing.assert_allclose(put_right.accelerometer.white, factor**2 * BOTH.accelerometer.white, rtol=0.15)
    np.testing.assert_allclose(put_right.accelerometer.variance[:, 1], BOTH.accelerometer.variance[:, 1])
    np.testing.assert_array_equal(put_right.gyroscope.white, BOTH.gyroscope.white)


def test_correlated_noise_is_another_kind():
    random = np.random.default_rng(4)
    known = model()
    more = replace(
        known,
        variance=np.c_[known.variance, 6.0 * known.white],
        correlation_time=np.append(known.correlation_time, 0.3),
    )
    (found,), put_right = quick_noise(resting(drawn(known, random), drawn(more, random)), BOTH, LEVEL)
    assert found.name == "noise.correlated"
    assert found.factor[3:].min() > 1.3
    assert np.all(np.abs(found.factor[:3] - 1) < 4 * found.sigma[:3])
    # the model put right has the spectrum of the truth over times that a pose resolves
    taus = np.array([0.1, 0.5, 1.0])
    np.testing.assert_allclose(
        put_right.gyroscope.allan_variance(taus) / more.allan_variance(taus), 1.0, atol=0.25
    )  # fmt: skip


def test_an_effect_that_bends_some_parts_is_no_noise():
    random = np.random.default_rng(5)
    parts = drawn(model(), random)
    for part in parts[:8]:
        part += 30 * np.linspace(-1, 1, len(part))[:, None] ** 5
    found, put_right = quick_noise(resting(parts, drawn(model(), random)), BOTH, LEVEL)
    assert not found
    np.testing.assert_array_equal(put_right.accelerometer.white, BOTH.accelerometer.white)


def test_tail_of_a_quadratic_form():
    """Exact for χ² with equal sizes, against a hypoexponential sum (pairs of sizes), and against draws."""
    for freedom in (1, 3, 20):
        for value in (0.5 * freedom, 2.0 * freedom, 20.0 + 3 * freedom):
            exact = scipy.stats.chi2.sf(value, freedom)
            # one square alone is where the approximation is worst
            assert quadratic_tail(2 * value, np.full(freedom, 2.0)) == pytest.approx(exact, rel=0.15)
    rates = 1 / (2 * np.array([1.0, 3.0, 7.0]))  # b (z₁² + z₂²) is exponential of the mean 2b
    weights = [np.prod([other / (other - each) for other in rates if other != each]) for each in rates]
    for value in (10.0, 60.0, 200.0):
        exact = float(np.sum(weights * np.exp(-rates * value)))
        assert quadratic_tail(value, np.repeat([1.0, 3.0, 7.0], 2)) == pytest.approx(exact, rel=0.05)
    sizes = 0.5 ** np.arange(30)
    draws = np.random.default_rng(6).standard_normal((20000, 30)) ** 2 @ sizes
    for share in (0.3, 0.05, 0.01):
        assert quadratic_tail(float(np.quantile(draws, 1 - share)), sizes) == pytest.approx(share, rel=0.2)


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """A recording with nothing hidden and its noise model."""
    case = hidden.draw_case(1, (), static_minutes=30)
    files = case.write(tmp_path_factory.mktemp("clean"), ("fit", "static"))
    return files["fit"], fit_noise(read_recording(files["static"]))


def test_noise_doubled_against_the_static_log(clean, tmp_path):
    path, noise = clean
    half = NoiseModel(*(
        replace(each, white=each.white / 4, quantisation=each.quantisation / 4, variance=each.variance / 4)
        for each in (noise.accelerometer, noise.gyroscope)
    ))  # fmt: skip
    found = diagnose(read_recording(path), GRAVITY, static=half)
    assert found.verdict == "effects"
    (effect,) = found.effects
    assert effect.name == "noise.white"
    assert np.all(np.abs(effect.factor - 2.0) < 4 * effect.sigma)
    assert "noise.white" in found.summary().verdict[0]
    assert "recording at rest" in found.suggestion
    document = found.document()
    (entry,) = document["effects"]
    assert {"name", "indistinguishable_from", "p_value", "weak", "scope", "coefficients", "inner", "sigma", "unit",
            "improvement", "evidence"} <= set(entry)  # fmt: skip
    assert entry["scope"] == "session"
    assert found.extended_calibration().imu.accelerometer.effects == ()
    give_diagnosis(found, Results(tmp_path))
    assert "noise.white" in (tmp_path / "report.html").read_text(encoding="utf-8")
    # with the right model, nothing
    right = diagnose(read_recording(path), GRAVITY, static=noise)
    assert right.verdict == "adequate"
    assert not set(NOISE_NAMES) & set(right.not_observable)


def test_a_random_walk_of_the_gyroscope_is_no_ramp(clean):
    path, noise = clean
    recording = read_recording(path)
    random, signal = np.random.default_rng(1), recording.gyroscope
    steps = 2e-5 / np.sqrt(signal.rate) * random.standard_normal(signal.values.shape)
    signal.values[:] += np.cumsum(steps, axis=0)
    found = diagnose(recording, GRAVITY, static=noise)
    assert found.verdict == "effects"
    (effect,) = found.effects
    assert "noise.rate_random_walk" in {effect.name, *effect.rivals}
    assert set(effect.axes) == {"gyroscope x", "gyroscope y", "gyroscope z"}
    # Allan variance of a random walk at τ: K² τ / 3, beside what the model had
    tau = 0.25 * found.experiment.extent().duration
    before = noise.gyroscope.allan_variance([tau])[0]
    expected = np.sqrt((before + 4e-10 * tau / 3) / before)
    assert np.all(np.abs(np.log(effect.factor / expected)) < np.log(2))


def test_without_a_static_log_noise_cannot_be_asked(clean):
    found = diagnose(read_recording(clean[0]), GRAVITY)
    assert found.verdict == "adequate"
    assert set(NOISE_NAMES) <= set(found.not_observable)
    assert "--static" in found.not_observable["noise.white"]
