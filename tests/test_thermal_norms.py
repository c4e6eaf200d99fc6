"""Windows at rest over temperature, by the norm of gravity alone."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from accelerometer_norms import calibrate_norms

from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.model.effects import CATALOGUE
from jaximu.model.sensor import Triad
from jaximu.model.stimulus import Stimulus

G = 9.81
EFFECTS = ("accel.temperature", "accel.scale_temperature")


@pytest.fixture(scope="module")
def windows():
    """Windows that the forward model makes: 600 orientations, 15 to 35 °C, with 1 mm/s² of noise."""
    rng = np.random.default_rng(8)
    up = rng.normal(size=(600, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    kelvin = rng.uniform(15, 35, 600)
    effects = (CATALOGUE["accel.temperature"].make([2e-3, -1e-3, 3e-3]),
               CATALOGUE["accel.scale_temperature"].make([3e-4, 1e-4, -2e-4]))  # fmt: skip
    gain = np.array([[1.01, 0, 0], [0.004, 0.99, 0], [-0.006, 0.003, 1.02]])
    triad = Triad(gain, np.array([0.1, -0.2, 0.05]), effects)
    outputs = triad.respond(Stimulus(specific_force=G * up, temperature=kelvin))
    return triad, np.asarray(outputs) + rng.normal(0, 1e-3, (600, 3)), kelvin


def errors_of(found, means, kelvin):
    """Gravity's norm in the windows as the fitted unit has it, less gravity."""
    force = found.imu.accelerometer.recover(means, Stimulus(temperature=kelvin))
    return np.linalg.norm(np.asarray(force), axis=1) - G


@pytest.mark.parametrize("loss", ["linear", "cauchy"])
def test_what_was_put_in_comes_out(windows, loss):
    triad, means, kelvin = windows
    found = calibrate_norms(means, kelvin, EFFECTS, loss, gravity=G)
    truth = [*(np.asarray(triad.gain)[np.tril_indices(3)]), *np.asarray(triad.bias),
             *(c for e in triad.effects for c in np.asarray(e.coefficients))]  # fmt: skip
    z = (found.values - truth) / found.sigmas()
    assert np.max(np.abs(z)) < 4 and 0.4 < np.sqrt(np.mean(z**2)) < 1.8
    assert np.sqrt(np.mean(errors_of(found, means, kelvin) ** 2)) == pytest.approx(1e-3, rel=0.1)


def test_windows_that_moved_hurt_a_robust_loss_less(windows):
    triad, means, kelvin = windows
    bad = means.copy()
    bad[::20] *= 1.05
    errors = []
    for loss in ("linear", "cauchy"):
        found = calibrate_norms(bad, kelvin, EFFECTS, loss, gravity=G)
        errors.append(np.linalg.norm(np.asarray(found.imu.accelerometer.bias) - np.asarray(triad.bias)))
    assert errors[1] < 0.3 * errors[0]


def test_too_few_orientations(windows):
    _, means, kelvin = windows
    with pytest.raises(NotPossibleError, match="do not determine"):
        calibrate_norms(np.tile(means[:3], (20, 1)), np.tile(kelvin[:3], 20), gravity=G)
    with pytest.raises(InputError, match="wind"):
        calibrate_norms(means, kelvin, ("wind",))


def test_the_published_wrist_data(data_folder):
    """GGIR publishes a mean error of 2.29 mg with bias and gain on the diagonal; all windows, fitted."""
    data = np.loadtxt(data_folder / "ggir_wrist" / "spheredata.csv", delimiter=",", skiprows=1)
    means, kelvin = 9.80665 * data[:, 2:5], data[:, 8]
    found = calibrate_norms(means, kelvin, ("accel.temperature", "accel.temperature_squared"))
    force = found.imu.accelerometer.recover(means, Stimulus(temperature=kelvin))
    assert np.mean(np.abs(np.linalg.norm(np.asarray(force), axis=1) - 9.80665)) / 9.80665e-3 < 1.8
