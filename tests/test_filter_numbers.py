"""What a filter takes of the noise: against theory, Monte Carlo and a filter's own consistency; Kalibr's file."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
import scipy.signal
import scipy.stats

from jaximu.ground.errors import InputError
from jaximu.model import BiasInstability, FirstOrderGaussMarkov, Noise, RandomWalk, White
from jaximu.noise import Term, deviation, identify
from jaximu.noise.analysis import NoiseAnalysis
from jaximu.noise.filter_noise import (
    PEAK,
    FilterNumbers,
    filter_document,
    filter_numbers,
    flat_part,
    mean_terms,
    random_walk_only,
    recorded_seconds,
    white_noise_only,
)
from jaximu.recordings.readers.kalibr import KALIBR_UNITS, kalibr_yaml
from jaximu.report.allan import kalibr_text

RATE = 50.0
NUMBERS = FilterNumbers("angular_rate", RATE, white=0.02, walk=3e-3, sigma=0.01, correlation_time=8.0)


@pytest.fixture(scope="module")
def axes():
    """Three axes whose terms the tests set themselves."""
    values = Noise((White(0.02), RandomWalk(3e-3))).sample(20_000, RATE, seed=3).T
    return identify(values, RATE)


def having(found, **terms):
    made = dict.fromkeys("QNBKR") | {name: Term(*values) for name, values in terms.items()}
    return replace(found, terms=made, limits={name: 1e-3 for name, each in made.items() if each is None})


def analysis(axes, name="gyroscope"):
    return NoiseAnalysis({name: axes}, {name: RATE}, ("log.csv",))


# The discrete recursion -----------------------------------------------------------------------------------------------


def recursion(numbers, samples, rows, seed):
    """Samples (rows, samples) as a filter would draw them from its numbers, and nothing else."""
    rng = np.random.default_rng(seed)
    white = math.sqrt(numbers.measurement_variance) * rng.standard_normal((rows, samples))
    walk = np.cumsum(math.sqrt(numbers.walk_variance) * rng.standard_normal((rows, samples)), axis=1)
    drive = math.sqrt(numbers.driving_variance) * rng.standard_normal((rows, samples))
    drive[:, 0] = numbers.sigma * rng.standard_normal(rows)  # starts in its stationary spread
    return white, walk, scipy.signal.lfilter([1.0], [1.0, -numbers.decay], drive, axis=1)


def test_the_recursion_has_the_allan_variance_of_the_terms():
    rows, factors = 40, [20, 40, 200, 800]  # from 20: a sampled walk has 1/2m² more than a continuous one
    white, walk, markov = recursion(NUMBERS, 20_000, rows, seed=1)
    tau = np.array(factors) / RATE
    x = tau / NUMBERS.correlation_time
    theory = {
        "N": NUMBERS.white**2 / tau,
        "K": NUMBERS.walk**2 * tau / 3,
        # IEEE Std 952, exponentially correlated noise of variance σ²
        "B": 2 * NUMBERS.sigma**2 / x * (1 - (3 - 4 * np.exp(-x) + np.exp(-2 * x)) / (2 * x)),
    }
    for name, values in (("N", white), ("K", walk), ("B", markov)):
        found = deviation(values, RATE, "overlapping", factors).value ** 2
        error = found.std(axis=0, ddof=1) / math.sqrt(rows)
        assert (np.abs(found.mean(axis=0) - theory[name]) < 4 * error).all(), name
        assert (error < 0.1 * theory[name]).all()  # or the bound above says little


def test_variances_against_monte_carlo():
    """Of the library's own continuous processes, sampled and integrated."""
    units, samples = 3000, 50
    time = samples / RATE
    noise = Noise((White(NUMBERS.white),)).sample(samples, RATE, seed=2, shape=(units,))
    walk = Noise((RandomWalk(NUMBERS.walk),)).sample(samples + 1, RATE, seed=3, shape=(units,))
    markov = Noise((FirstOrderGaussMarkov.of(NUMBERS.sigma, NUMBERS.correlation_time),))
    markov = markov.sample(2, RATE, seed=4, shape=(units,))
    for draws, variance in (
        (noise[:, 7], NUMBERS.measurement_variance),
        (noise.sum(axis=1) / RATE, samples * NUMBERS.integral_variance),
        (noise.sum(axis=1) / RATE, NUMBERS.white**2 * time),
        (walk[:, -1], samples * NUMBERS.walk_variance),
        (walk[:, -1], NUMBERS.walk**2 * time),
        (markov[:, 1], NUMBERS.sigma**2),
        (markov[:, 1] - NUMBERS.decay * markov[:, 0], NUMBERS.driving_variance),
    ):
        low, high = scipy.stats.chi2.ppf([1e-5, 1 - 1e-5], draws.size) / draws.size
        assert low < np.mean(draws**2) / variance < high


def test_a_filter_with_these_numbers_is_consistent():
    """Normalised innovations squared of a Kalman filter for a bias walk seen through white noise average to one."""
    noise = Noise((White(0.02), RandomWalk(3e-3))).sample(6000, RATE, seed=5, shape=(20,))
    values = np.moveaxis(noise, 1, -1).reshape(60, -1)
    right = FilterNumbers("angular_rate", RATE, 0.02, 3e-3, 0.0)
    for numbers, consistent in ((right, True), (replace(right, walk=3e-5), False), (replace(right, white=0.03), False)):
        bias, variance, squares = np.zeros(60), 0.0, []
        for sample in values.T:
            innovation = variance + numbers.measurement_variance
            squares.append((sample - bias) ** 2 / innovation)
            gain = variance / innovation
            bias = bias + gain * (sample - bias)
            variance = (1 - gain) * variance + numbers.walk_variance
        low, high = scipy.stats.chi2.ppf([1e-5, 1 - 1e-5], values.size) / values.size
        assert (low < np.mean(squares) < high) == consistent


def test_short_steps_keep_their_digits():
    numbers = replace(NUMBERS, rate=1e6, correlation_time=1e5)
    assert numbers.driving_variance == pytest.approx(2 * NUMBERS.sigma**2 / 1e11, rel=1e-9)
    assert numbers.driving_variance == pytest.approx(numbers.driving_density / numbers.rate, rel=1e-9)


# The correlation time -------------------------------------------------------------------------------------------------


def test_a_gauss_markov_process_peaks_where_is_said():
    process = FirstOrderGaussMarkov.of(1.0, 1.0)
    tau = np.linspace(1.5, 2.5, 10_001)
    variance = process.allan_variance(tau)
    assert tau[np.argmax(variance)] == pytest.approx(PEAK, abs=1e-3)
    assert math.sqrt(variance.max()) == pytest.approx(0.617, abs=1e-3)
    assert math.sqrt(variance.max()) / BiasInstability(1.0).allan_variance([1.0])[0] ** 0.5 == pytest.approx(
        0.93, abs=0.01
    )


@pytest.mark.parametrize(
    "terms",
    [{"N": 0.02, "B": 0.01, "K": 1e-4}, {"Q": 1e-3, "N": 0.001, "B": 0.01, "K": 1e-4, "R": 1e-5},
     {"Q": 1e-3, "B": 0.01, "R": 1e-5}],
)  # fmt: skip
def test_the_ends_of_the_flat_part(terms):
    left, right = flat_part(terms, 1e-6, 1e9)
    level = 2 * math.log(2) / math.pi * terms["B"] ** 2
    q, n, k, r = (terms.get(letter, 0.0) for letter in "QNKR")
    assert 3 * q**2 / left**2 + n**2 / left == pytest.approx(level, rel=1e-9)
    assert k**2 * right / 3 + r**2 * right**2 / 2 == pytest.approx(level, rel=1e-9)


def test_the_centre_is_the_lowest_place_and_stays_in_the_recording():
    left, right = flat_part({"N": 0.02, "B": 0.01, "K": 1e-4}, 1e-6, 1e9)
    lowest = scipy.optimize.minimize_scalar(lambda x: 0.02**2 / math.exp(x) + 1e-4**2 * math.exp(x) / 3).x
    assert math.log(left * right) / 2 == pytest.approx(lowest, abs=1e-3)
    assert flat_part({"N": 0.02, "B": 0.01}, 0.02, 300.0)[1] == 300.0  # no end was seen
    assert flat_part({"B": 0.01}, 0.02, 300.0) == (0.02, 300.0)
    with pytest.raises(InputError, match="no flat part"):
        flat_part({"N": 0.02}, 0.02, 300.0)


def test_the_correlation_time_of_a_triad(axes):
    terms = {"N": (0.02, 0.019, 0.021), "B": (0.01, 0.008, 0.012), "K": (3e-3, 2e-3, 4e-3)}
    each, mean = filter_numbers(analysis([having(axis, **terms) for axis in axes]), "gyroscope")
    assert mean == each[0] and mean.correlation_time == pytest.approx(math.sqrt(3) * 0.02 / 3e-3 / 1.8926, rel=1e-3)


# The mean over the axes -----------------------------------------------------------------------------------------------


def test_the_mean_has_the_mean_allan_variance(axes):
    found = [
        having(axes[0], N=(0.02, 0.019, 0.021), K=(3e-3, 2e-3, 4e-3)),
        having(axes[1], N=(0.03, 0.028, 0.032), B=(0.01, 0.005, 0.02)),
        having(axes[2], N=(0.01, 0.009, 0.011)),
    ]
    mean = mean_terms(found)
    assert mean["K"].axes == "x" and mean["B"].axes == "y" and mean["N"].axes == "xyz" and mean["R"] is None
    tau = np.array([0.1, 3.0, 90.0])
    whole = replace(axes[0], terms={k: v and Term(v.value, v.low, v.high) for k, v in mean.items()})
    expected = np.mean([axis.allan_deviation(tau) ** 2 for axis in found], axis=0)
    np.testing.assert_allclose(whole.allan_deviation(tau) ** 2, expected, rtol=1e-12)


def test_the_interval_of_the_mean_covers(axes):
    """Estimates of equal and of different spread scatter about the truth; the mean's intervals hold it at 95 %."""
    rng = np.random.default_rng(6)
    for spreads in ((0.05, 0.05, 0.05), (0.02, 0.1, 0.2)):
        true = np.array([1.0, 2.0, 3.0])
        mean = math.sqrt(np.mean(true**2))
        inside = 0
        for _ in range(1000):
            drawn = true * np.exp(np.array(spreads) * rng.standard_normal(3))
            sides = np.exp(1.96 * np.array(spreads))
            found = mean_terms([having(axes[0], N=(v, v / s, v * s)) for v, s in zip(drawn, sides, strict=True)])["N"]
            inside += found.low <= mean <= found.high
        assert 0.92 < inside / 1000 < 0.98


def test_an_open_interval_stays_finite(axes):
    found = mean_terms([having(axes[0], K=(1e-3, 0.0, math.inf))])["K"]
    assert 0 <= found.low < found.value < found.high < math.inf


# Programs that know no other bias -------------------------------------------------------------------------------------


def test_one_random_walk_from_whatever_there_is(axes):
    found = [
        having(axes[0], N=(0.02, 0.019, 0.021), K=(3e-3, 2e-3, 4e-3)),
        having(axes[1], N=(0.02, 0.019, 0.021), B=(0.01, 0.005, 0.02)),
        having(axes[2], N=(0.02, 0.019, 0.021)),
    ]
    each = filter_numbers(analysis(found), "gyroscope")[0]
    walk = random_walk_only(analysis(found), "gyroscope")
    assert walk.origin == ("measured", "from B", "upper limit")
    from_b = 0.01 * math.sqrt(2 / each[1].correlation_time)
    assert walk.value == pytest.approx(math.sqrt((3e-3**2 + from_b**2 + found[2].limits["K"] ** 2) / 3))
    # what is taken for B: over times well below T the Gauss–Markov bias is that walk
    process = FirstOrderGaussMarkov.of(0.01, each[1].correlation_time)
    short = each[1].correlation_time / 100
    assert process.allan_variance([short])[0] == pytest.approx(from_b**2 * short / 3, rel=0.02)
    none = [having(axes[0], K=(3e-3, 2e-3, 4e-3))] * 3
    assert white_noise_only(analysis(none), "gyroscope").origin == ("upper limit",) * 3


def test_upper_limits_hold():
    """K of 60 axes with a walk too small to be seen: the upper end of a 95 % interval may fail for few of them."""
    true = 2e-4
    values = Noise((White(0.02), RandomWalk(true))).sample(4096, RATE, seed=7, shape=(20,))
    found = identify(np.moveaxis(values, 1, -1).reshape(60, -1), RATE)
    unseen = [axis for axis in found if axis.terms["K"] is None]
    assert len(unseen) > 40
    assert np.mean([axis.limits["K"] < true for axis in unseen]) <= 0.1
    band = [axis.deviation.high[-1] * math.sqrt(3 / axis.deviation.tau[-1]) for axis in unseen]
    assert np.median([axis.limits["K"] for axis in unseen]) < np.median(band) / 2  # says more than the curve's end
    for axis in found:
        assert set(axis.limits) == {term for term, each in axis.terms.items() if each is None}
        assert all(0 < limit < math.inf for limit in axis.limits.values())
    assert recorded_seconds(found[0]) == pytest.approx(4096 / RATE)


def test_a_walk_hidden_beneath_bias_instability_is_within_its_limit():
    """Half an hour of N, B and a K that shows in one axis of four: value, interval and limit hold what is there."""
    truth = {"N": 0.002, "B": 0.002, "K": 1.2e-4}
    noise = Noise((White(truth["N"]), BiasInstability(truth["B"]), RandomWalk(truth["K"])))
    found = identify(noise.sample(180_000, 100.0, seed=11, shape=(4,)).reshape(4, -1, 3)[..., 0], 100.0)
    for term, size in truth.items():
        ends = [(0.0, axis.limits[term]) if each is None else (each.low, each.high)
                for axis in found for each in [axis.terms[term]]]  # fmt: skip
        assert sum(low <= size <= high for low, high in ends) >= 3, term
    unseen = [axis.limits["K"] for axis in found if axis.terms["K"] is None]
    assert unseen and max(unseen) < 4 * truth["K"]


# Words, JSON, bad input -----------------------------------------------------------------------------------------------


def test_the_document_is_json_with_units(axes):
    made = filter_document(analysis([having(axis, N=(0.02, 0.019, 0.021)) for axis in axes], "accelerometer"))
    assert made["gyroscope"] is None and len(made["accelerometer"]["axes"]) == 3
    mean = json.loads(json.dumps(made, allow_nan=False))["accelerometer"]["mean"]
    assert mean["white_density"] == {"value": pytest.approx(4e-4), "unit": "(m/s^2)^2/Hz"}
    assert mean["measurement_variance"] == {"value": pytest.approx(4e-4 * RATE), "unit": "(m/s^2)^2"}
    assert mean["integral_variance"]["unit"] == "(m/s)^2"
    assert mean["walk_density"] is None and mean["bias_sigma"] is None and mean["decay"] is None
    whole = NUMBERS.document()
    assert whole["integral_variance"]["unit"] == "rad^2" and whole["walk_density"]["unit"] == "(rad/s^2)^2/Hz"
    assert all(each["value"] > 0 for each in whole.values())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rate": 0.0}, "sample rate must be positive"),
        ({"rate": math.nan}, "rate must be finite"),
        ({"white": -1.0}, "white must be finite"),
        ({"walk": math.inf}, "walk must be finite"),
        ({"correlation_time": None}, "needs a positive correlation time"),
        ({"correlation_time": 0.0}, "needs a positive correlation time"),
        ({"quantity": "speed"}, "not to 'speed'"),
    ],
)
def test_bad_numbers_are_refused(change, words):
    with pytest.raises(InputError, match=words):
        replace(NUMBERS, **change)


def parsed(text):
    """Numbers and text of an imu.yaml: by a YAML parser where there is one, and by its simple lines in any case."""
    lines = [line.split("#")[0].strip() for line in text.splitlines()]
    simple = dict(line.split(": ") for line in lines if line)
    try:
        import yaml
    except ImportError:
        return {key: value if key == "rostopic" else float(value) for key, value in simple.items()}
    made = yaml.safe_load(text)
    assert {key: str(value) for key, value in made.items() if key == "rostopic"} == {"rostopic": simple["rostopic"]}
    assert all(isinstance(value, float) for key, value in made.items() if key != "rostopic")
    assert all(made[key] == float(simple[key]) for key in made if key != "rostopic")
    return made


def test_kalibr_reads_what_is_written():
    numbers = {key: (10.0 ** -(place + 3), "x: as measured") for place, key in enumerate(KALIBR_UNITS)}
    text = kalibr_yaml(numbers, 200, "/imu0", ["from a\nlog: {evil}\r\u2028x: 1"])
    made = parsed(text)
    assert made == {key: value for key, (value, _) in numbers.items()} | {"rostopic": "/imu0", "update_rate": 200.0}
    assert "gyroscope_random_walk: 1.00000e-06  # rad/s^2/sqrt(Hz)" in text
    without = kalibr_yaml({key: numbers[key] for key in list(KALIBR_UNITS)[:2]}, 200)
    assert set(parsed(without)) == {*list(KALIBR_UNITS)[:2], "rostopic", "update_rate"}
    assert "# gyroscope_noise_density: not known" in without


@pytest.mark.parametrize(
    ("numbers", "rate", "topic", "words"),
    [
        ({"gyroscope_noise_density": (0.0, "")}, 100, "/imu0", "positive gyroscope_noise_density"),
        ({"gyroscope_noise_density": (math.nan, "")}, 100, "/imu0", "positive gyroscope_noise_density"),
        ({"gyro_noise": (1.0, "")}, 100, "/imu0", "no key gyro_noise"),
        ({}, 0.0, "/imu0", "positive update_rate"),
        ({}, 100, "/imu0\nx: 1", "ROS topic"),
        ({}, 100, "", "ROS topic"),
    ],
)
def test_what_kalibr_could_not_use_is_refused(numbers, rate, topic, words):
    with pytest.raises(InputError, match=words):
        kalibr_yaml(numbers, rate, topic)


def test_kalibr_is_told_where_its_numbers_come_from(axes):
    seen = [having(axis, N=(0.02, 0.019, 0.021), K=(3e-3, 2e-3, 4e-3)) for axis in axes]
    text = kalibr_text(analysis(seen))
    assert parsed(text)["gyroscope_noise_density"] == pytest.approx(0.02)
    assert parsed(text)["gyroscope_random_walk"] == pytest.approx(3e-3)
    assert "NOT SEEN" not in text and "accelerometer_noise_density: not known" in text
    unseen = [having(axis, N=(0.02, 0.019, 0.021)) for axis in axes]
    text = kalibr_text(analysis(unseen))
    assert "NOT SEEN in the data, an upper limit" in text and parsed(text)["gyroscope_random_walk"] > 0
    assert "B sqrt(2/T)" in kalibr_text(analysis([*unseen[:2], having(axes[2], B=(0.01, 0.005, 0.02))]))
