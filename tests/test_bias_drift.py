"""A bias that drifts has two meanings: its mean over the recording, and what it is after it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaximu import Imu, LocalGravity, calibrate, load_calibration
from jaximu.calibration.turntable import calibrate_turntable
from jaximu.data.drift import about_biases
from jaximu.estimation.data import OutputMeans
from jaximu.estimation.problem import Name
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.model import AxisNoise, NoiseModel
from jaximu.model.noise import Noise
from jaximu.model.processes import White
from jaximu.simulation import simulate
from jaximu.simulation.protocols import HandHeld, Positions

EXACT = LocalGravity(STANDARD_GRAVITY, 0.0)
WHITE = {"accelerometer": 1e-3, "gyroscope": 1e-4}
QUIET = {
    "accelerometer": Noise((White(WHITE["accelerometer"]),), "specific_force"),
    "gyroscope": Noise((White(WHITE["gyroscope"]),), "angular_rate"),
}


def noise(variance, time):
    """White noise of `WHITE` and a Gauss-Markov bias of a variance relative to it, the same in both sensors."""
    return NoiseModel(
        *(
            AxisNoise(np.full(3, white**2), np.zeros(3), np.full((3, 1), variance * white**2), np.array([time]))
            for white in WHITE.values()
        )
    )


@pytest.fixture(scope="module")
def by_hand():
    return simulate(Imu.nominal(), HandHeld(poses=14), QUIET, rate=50.0, seed=3)[0]


@pytest.mark.parametrize(
    ("name", "factor"), [("gyroscope", np.degrees(1.0)), ("accelerometer", 10.0), ("gyroscope", 1e-2)]
)
def test_noise_that_is_not_of_the_recordings_sensors_is_noticed(by_hand, name, factor):
    """A wrong unit of one sensor, or a table that shook; and nothing is said of the right noise."""
    known = noise(1e-3, 100.0)
    wrong = replace(known, **{name: replace(getattr(known, name), white=getattr(known, name).white * factor**2)})
    for stated, times in ((known, 0), (wrong, 1)):
        notes = [note for note in calibrate(by_hand, EXACT, static=stated).notes if "rests of this log show" in note]
        assert len(notes) == times
        assert all(note.startswith(name) for note in notes)


@pytest.fixture(scope="module")
def on_table():
    protocol = Positions(6, duration=8.0)
    recording, truth = simulate(Imu.nominal(), protocol, QUIET, rate=50.0, seed=4)
    return recording, truth.schedule


@pytest.fixture(scope="module", params=["by hand", "table"])
def recipe(request, by_hand, on_table):
    """How a recording is calibrated with a noise that is known."""
    if request.param == "by hand":
        return lambda static: calibrate(by_hand, EXACT, static=static)
    recording, entries = on_table
    return lambda static: calibrate_turntable(recording, entries, EXACT, static=static)


def test_a_bias_that_stands_still_has_one_meaning(recipe):
    """A drift that takes for ever moves the bias as a whole: about what it is, nothing is added to white noise.

    But for the excess, which is estimated in multiples of noise that holds the drift.
    """
    white, still = recipe(noise(0.0, 1e9)), recipe(noise(5.0**2, 1e9))
    for triad in WHITE:
        sigma = white.sigma(triad)[1]
        assert_allclose(still.sigma(triad)[1], sigma, rtol=0.02)
        assert_allclose(still.bias_sigma_recording[triad], sigma, rtol=0.02)
        assert_allclose(still.sigma(triad)[0], white.sigma(triad)[0], rtol=0.02, atol=1e-12)


def test_what_comes_after_is_known_less_well_than_what_was_recorded(recipe):
    drifting = recipe(noise(10.0**2, 100.0))
    for triad in WHITE:
        assert np.all(drifting.sigma(triad)[1] > 1.5 * drifting.bias_sigma_recording[triad])


def test_the_covariance_about_biases_is_that_of_draws():
    """Biases are the mean outputs weighted by `share`; drift of a Gauss-Markov process, drawn at a fine grid."""
    rng = np.random.default_rng(5)
    start = np.array([0.0, 10.0, 25.0, 40.0])
    stop = np.array([6.0, 14.0, 35.0, 50.0])
    share = np.array([0.4, 0.1, 0.2, 0.3])
    gains = np.array([0.5, -0.2, 0.1, -0.4])  # a gain reacts to what is not alike in all
    scale, sigma, time = 2.0, 0.3, 40.0
    names = [Name("accelerometer", "gain", (0, 0)), Name("accelerometer", "bias", (0,))]
    reactions = np.zeros((4, 4, 3))
    reactions[:, :, 0] = np.eye(4)
    slow = AxisNoise(np.zeros(3), np.zeros(3), np.full((3, 1), sigma**2), np.array([time]))
    means = OutputMeans(
        start, stop, np.zeros(4, int), {"accelerometer": reactions}, {"accelerometer": np.full(3, scale)},
        NoiseModel(slow),
    )  # fmt: skip
    by_conditions = np.stack([gains, share])
    plain = scale**2 * by_conditions @ slow.covariance(start, stop)[0] @ by_conditions.T
    after, sigmas = about_biases(names, plain, by_conditions, means, NoiseModel(slow))

    step, draws = 0.05, 20_000
    grid = np.arange(0.0, 100.0, step) + step / 2
    decay = np.exp(-step / time)
    bias = np.empty((draws, len(grid)), np.float32)
    bias[:, 0] = rng.normal(size=draws)
    for k in range(1, len(grid)):
        bias[:, k] = decay * bias[:, k - 1] + np.sqrt(1 - decay**2) * rng.normal(size=draws)
    bias *= scale * sigma
    outputs = np.stack([bias[:, (grid > a) & (grid < b)].mean(axis=1) for a, b in zip(start, stop, strict=True)])
    estimates = by_conditions @ outputs
    later, during = (bias[:, (grid > a) & (grid < b)].mean(axis=1) for a, b in ((50.0, 100.0), (0.0, 50.0)))
    drawn = np.cov(estimates - np.stack([np.zeros(draws), later]))
    assert_allclose(after, drawn, rtol=0.03, atol=0.03 * np.sqrt(drawn[0, 0] * drawn[1, 1]))
    assert_allclose(sigmas["accelerometer"], [np.std(estimates[1] - during)], rtol=0.03)


def test_the_file_keeps_both(by_hand, tmp_path):
    calibration = calibrate(by_hand, EXACT)
    path = tmp_path / "calibration.json"
    calibration.save(path)
    document = json.loads(path.read_text())
    for triad in WHITE:
        assert document[triad]["bias_sigma_recording"] == calibration.bias_sigma_recording[triad].tolist()
        assert np.all(np.array(document[triad]["bias_sigma"]) >= document[triad]["bias_sigma_recording"])
        assert_allclose(load_calibration(path).bias_sigma_recording[triad], calibration.bias_sigma_recording[triad])
    for triad in WHITE:  # a file of an older version knows one alone
        del document[triad]["bias_sigma_recording"]
    path.write_text(json.dumps(document))
    older = load_calibration(path)
    assert older.document()["gyroscope"]["bias_sigma_recording"] == document["gyroscope"]["bias_sigma"]
    assert replace(older, bias_sigma_recording=calibration.bias_sigma_recording).document()["accelerometer"]
